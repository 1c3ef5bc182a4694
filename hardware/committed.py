"""The committed KiCad projects, read back and compared with the boards; needs no KiCad.

What KiCad alone can tell (rules, parity, copper that joins every net) is in `hardware.kicad`.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from typing import TYPE_CHECKING, Any, NamedTuple

from hardware import kicad, schematic
from hardware.boards import Terminal
from hardware.findings import Finding
from hardware.layout import VIA
from hardware.schematic import read

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping
    from pathlib import Path

    from hardware.boards import Board

Point = tuple[float, float]


class LaidPad(NamedTuple):
    """A pad on a board: its net as KiCad calls it, its place (mm, board's frame), its hole or 0."""

    terminal: Terminal
    net: str
    at: Point
    hole: float


class Footprint(NamedTuple):
    """A part on a board."""

    name: str
    value: str
    path: str
    front: bool
    fitted: bool
    pads: tuple[LaidPad, ...]


class Layout(NamedTuple):
    """What a ``.kicad_pcb`` holds, in the board's frame; mm.

    Parameters
    ----------
    parts : mapping of str to Footprint
        By reference; screw holes are not among them.
    holes : list of (float, float, float)
        Screw holes: x, y, diameter.
    edge : tuple of tuple of float
        Lower left and upper right corner of the outline.
    tracks : list of (str, float)
        Net and width of every piece.
    vias : list of tuple of float
    zones : mapping of str to str
        Net by layer.
    """

    parts: Mapping[str, Footprint]
    holes: list[tuple[float, float, float]]
    edge: tuple[Point, Point]
    tracks: list[tuple[str, float]]
    vias: list[Point]
    zones: Mapping[str, str]


def _all(node: list[Any], name: str) -> list[list[Any]]:
    return [item for item in node if isinstance(item, list) and item[0] == name]


def _one(node: list[Any], name: str) -> list[Any]:
    return next(iter(_all(node, name)), [])


def _numbers(node: list[Any]) -> list[float]:
    return [float(word) for word in node[1:]]


def _framed(x: float, y: float) -> Point:
    return (round(x - kicad.ORIGIN[0], 4) + 0.0, round(kicad.ORIGIN[1] - y, 4) + 0.0)


def read_layout(text: str) -> Layout:
    """Read the text of a ``.kicad_pcb``.

    Raises
    ------
    ValueError
        If its brackets do not match.
    """
    board = read(text)
    names = {net[1]: net[2] for net in _all(board, "net")}
    parts, holes = {}, []
    for item in _all(board, "footprint"):
        x, y, *rest = _numbers(_one(item, "at"))
        turn = math.radians(rest[0] if rest else 0.0)
        fields = {field[1]: field[2] for field in _all(item, "property")}
        pads = []
        for pad in _all(item, "pad"):
            u, v = _numbers(_one(pad, "at"))[:2]
            at = _framed(
                x + u * math.cos(turn) + v * math.sin(turn),
                y - u * math.sin(turn) + v * math.cos(turn),
            )
            drill = _one(pad, "drill")
            hole = float(drill[1]) if drill else 0.0
            if pad[2] == "np_thru_hole":
                holes.append((*at, hole))
                continue
            end = Terminal(fields["Reference"], pad[1])
            net = _one(pad, "net")
            pads.append(LaidPad(end, net[2] if net else "", at, hole))
        attributes = _one(item, "attr")
        if "board_only" not in attributes:
            parts[fields["Reference"]] = Footprint(
                item[1],
                fields["Value"],
                _one(item, "path")[1],
                _one(item, "layer")[1] == "F.Cu",
                "dnp" not in attributes,
                tuple(pads),
            )
    (box,) = [box for box in _all(board, "gr_rect") if _one(box, "layer")[1] == "Edge.Cuts"]
    corners = [_framed(*_numbers(_one(box, end))) for end in ("start", "end")]
    xs, ys = zip(*corners, strict=True)
    return Layout(
        parts,
        sorted(holes),
        ((min(xs), min(ys)), (max(xs), max(ys))),
        [
            (names[_one(track, "net")[1]], float(_one(track, "width")[1]))
            for track in _all(board, "segment")
        ],
        [_framed(*_numbers(_one(via, "at"))) for via in _all(board, "via")],
        {_one(zone, "layer")[1]: _one(zone, "net_name")[1] for zone in _all(board, "zone")},
    )


def read_drills(text: str) -> Counter[tuple[float, float, float]]:
    """Return x, y and diameter of every hole of an Excellon file, mm."""
    sizes = {
        name: float(size) for name, size in re.findall(r"^(T\d+)C([\d.]+)$", text, re.MULTILINE)
    }
    found: Counter[tuple[float, float, float]] = Counter()
    size = 0.0
    for line in text.partition("%")[2].splitlines():
        size = sizes.get(line, size)
        if place := re.fullmatch(r"X(-?[\d.]+)Y(-?[\d.]+)", line):
            found[float(place[1]), float(place[2]), size] += 1
    return found


def read_flashes(text: str) -> dict[Terminal, tuple[str, Point]]:
    """Return net and place of the pads in a copper layer's Gerber file, mm."""
    net, end, found = "", None, {}
    for line in text.splitlines():
        if match := re.fullmatch(r"%TO\.P,([^,]+),([^,*]+).*\*%", line):
            end = Terminal(match[1], match[2])
        elif match := re.fullmatch(r"%TO\.N,(.*)\*%", line):
            net = match[1]
        elif line.startswith("%TD"):
            end, net = None, ""
        elif end and (match := re.fullmatch(r"X(-?\d+)Y(-?\d+)D03\*", line)):
            found[end] = (net, (int(match[1]) / 1e6, int(match[2]) / 1e6))
    return found


def _gerber_size(text: str) -> tuple[Point, Point]:
    places = re.findall(r"^X(-?\d+)Y(-?\d+)D0[12]\*$", text, re.MULTILINE)
    xs, ys = zip(*((int(x) / 1e6, int(y) / 1e6) for x, y in places), strict=True)
    return (min(xs), min(ys)), (max(xs), max(ys))


def _near(a: Iterable[float], b: Iterable[float]) -> bool:
    return all(abs(p - q) < 2e-3 for p, q in zip(a, b, strict=True))


def check_committed(board: Board, folder: Path | None = None) -> list[Finding]:
    """Compare a written project with its board.

    Parameters
    ----------
    board : Board
    folder : Path, optional
        Of the project; left out, the committed one.
    """
    folder = kicad.COMMITTED / board.name if folder is None else folder
    files = {path.name: path for path in (*folder.glob("*"), *folder.glob("gerbers/*"))}
    wanted = {
        f"{board.name}.kicad_pcb",
        f"{board.name}.pdf",
        "gerbers",
        kicad.SUMS,
        *kicad.sources(board),
    }
    wanted |= {f"{board.name}-{side}.svg" for side in ("front", "back")}
    wanted |= {
        f"{board.name}-{layer.replace('.', '_')}.{end}" for layer, end in kicad.LAYERS.items()
    }
    wanted |= {f"{board.name}-{kind}.drl" for kind in ("PTH", "NPTH")}
    found = [Finding("file", name, "is missing") for name in sorted(wanted - files.keys())]
    found += [Finding("file", name, "belongs to nothing") for name in sorted(files.keys() - wanted)]
    if wanted - files.keys():
        return found
    texts = {
        name: path.read_text(encoding="utf-8")
        for name, path in files.items()
        if path.suffix not in {"", ".pdf"} or name == "sym-lib-table"
    }
    written = (folder / kicad.SUMS).read_text(encoding="utf-8").splitlines()
    differing = set(written) ^ set(kicad.sums(folder).splitlines())
    for name in sorted({line.partition("  ")[2] for line in differing}):
        found.append(Finding("sum", name, "is not as KiCad wrote it"))
    for name, text in kicad.sources(board).items():
        if texts[name] != text:
            found.append(Finding("source", name, "is not what the board's data give"))
    laid = read_layout(texts[f"{board.name}.kicad_pcb"])
    placed = kicad.layout_of(board)
    found += _check_layout(board, placed, laid)
    found += _check_plots(board, laid, texts)
    return found


def _check_layout(board: Board, placed: Mapping[str, Any], laid: Layout) -> Iterator[Finding]:
    rules, frame = placed["board"], kicad.outline(placed)
    nets = schematic.net_names(board)
    for reference in sorted(board.parts.keys() ^ laid.parts.keys()):
        where = "board" if reference in board.parts else "layout"
        yield Finding("part", reference, f"only the {where} has it")
    for reference in sorted(board.parts.keys() & laid.parts.keys()):
        part, footprint = board.parts[reference], laid.parts[reference]
        expected = (
            part.type.footprint,
            schematic.value(board, part),
            f"/{schematic.part_identity(board, part)}",
            rules["front"] == "all" or reference in rules["front"],
            schematic.fitted(board, part),
        )
        if footprint[:5] != expected:
            yield Finding("part", reference, f"is {footprint[:5]}, should be {expected}")
        numbers = Counter(pad.terminal.number for pad in footprint.pads)
        if numbers != Counter(str(n + 1) for n in range(len(part.type.pins))):
            yield Finding("part", reference, f"has the pads {sorted(numbers)}")
        for pad in footprint.pads:
            net = nets.get(pad.terminal, "")
            if pad.net != net:
                yield Finding("net", str(pad.terminal), f"is on {pad.net}, should be on {net}")
        at = next(pad.at for pad in footprint.pads if pad.terminal.number == "1")
        if not _near(at, rules["parts"][reference][:2]):
            yield Finding("place", reference, f"pin 1 is at {at}")
    left, low = frame["corner"]
    right, top = (a + b for a, b in zip(frame["corner"], frame["size"], strict=True))
    if not _near((left, low, right, top), (*laid.edge[0], *laid.edge[1])):
        yield Finding("outline", "edge", f"from {laid.edge[0]} to {laid.edge[1]}")
    if laid.holes != sorted((x, y, frame["hole_diameter"]) for x, y in frame["holes"]):
        yield Finding("outline", "holes", f"at {laid.holes}")
    names = {nets[ends[0]]: net for net, ends in board.nets.items()}
    for net, width in sorted(set(laid.tracks)):
        if net not in names or width < kicad.width(rules, names[net]):
            yield Finding("width", net, f"has a track of {width} mm")
    if list(laid.zones.values()) != [rules["zones"][side] for side in ("front", "back")]:
        yield Finding("net", "zones", f"are {laid.zones}")


def _check_plots(board: Board, laid: Layout, texts: Mapping[str, str]) -> Iterator[Finding]:
    pads = [pad for part in laid.parts.values() for pad in part.pads]
    holes = Counter((*pad.at, pad.hole) for pad in pads if pad.hole)
    holes.update((*at, VIA[1]) for at in laid.vias)
    for kind, expected in (("PTH", holes), ("NPTH", Counter(laid.holes))):
        drilled = sorted(read_drills(texts[f"{board.name}-{kind}.drl"]).elements())
        places = sorted(expected.elements())
        same = len(drilled) == len(places)
        if not same or not all(_near(a, b) for a, b in zip(drilled, places, strict=True)):
            yield Finding("drill", kind, f"{len(drilled)} holes are not the layout's {len(places)}")
    for layer, front in (("F_Cu.gtl", True), ("B_Cu.gbl", False)):
        flashed = read_flashes(texts[f"{board.name}-{layer}"])
        for pad in pads:
            if not pad.hole and laid.parts[pad.terminal.reference].front != front:
                continue
            net, at = flashed.pop(pad.terminal, ("nothing", (math.nan, math.nan)))
            if net != pad.net:
                yield Finding("plot", layer, f"{pad.terminal} is on {net}, not on {pad.net}")
            if not _near(at, pad.at):
                yield Finding("plot", layer, f"{pad.terminal} is at {at}, not at {pad.at}")
        for end in flashed:
            yield Finding("plot", layer, f"{end} is not in the layout")
    edge = _gerber_size(texts[f"{board.name}-Edge_Cuts.gm1"])
    if not _near((*edge[0], *edge[1]), (*laid.edge[0], *laid.edge[1])):
        yield Finding("plot", "Edge_Cuts.gm1", f"from {edge[0]} to {edge[1]}")
