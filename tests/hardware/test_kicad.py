"""The KiCad projects without KiCad: they agree with the boards, and faults put in are found.

What needs KiCad is in ``pcb.py``, which ``make pcb`` runs.
"""

from __future__ import annotations

import math
import re
import shutil
from dataclasses import replace
from typing import TYPE_CHECKING

import pytest

from hardware import kicad, schematic
from hardware.boards import BOARDS, Terminal
from hardware.committed import check_committed, read_drills, read_layout
from hardware.layout import Pad, Router, Track, UnroutableError
from hardware.mount import mechanics
from hardware.schematic import read, write

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from hardware.boards import Board

Point = tuple[float, float]


def text_of(board: Board, suffix: str) -> str:
    path = kicad.COMMITTED / board.name / f"{board.name}{suffix}"
    return path.read_text(encoding="utf-8")


# --- committed files ------------------------------------------------------------------------------


@pytest.mark.parametrize("name", BOARDS)
def test_committed_project_is_its_board(name: str) -> None:
    assert [str(finding) for finding in check_committed(BOARDS[name])] == []


def test_every_board_has_a_project_and_nothing_else_has() -> None:
    assert {path.name for path in kicad.COMMITTED.iterdir()} == set(BOARDS)


@pytest.mark.parametrize("name", BOARDS)
def test_no_file_has_a_date(name: str) -> None:
    """Writing it again gives the same bytes."""
    for path in (kicad.COMMITTED / name).rglob("*"):
        if path.is_file():
            content = path.read_bytes()
            assert b"TF.CreationDate" not in content
            for date in re.findall(rb"CreationDate \(D:(\d{4})|\b(20[2-9]\d-\d\d-\d\d)", content):
                assert date == (b"2000", b"")


def swap(old: str, new: str) -> Callable[[str], str]:
    def change(text: str) -> str:
        assert old in text
        return text.replace(old, new, 1)

    return change


def first_net(reference: str, number: str, net: str) -> Callable[[str], str]:
    """Put another net on a pad."""

    def change(text: str) -> str:
        start = text.index(f'(property "Reference" "{reference}"')
        start = text.index(f'(pad "{number}"', start)
        head, tail = text[:start], text[start:]
        return head + re.sub(r'\(net \d+ "[^"]*"\)', f'(net 1 "{net}")', tail, count=1)

    return change


FAULTS: dict[str, tuple[str, Callable[[str], str], str]] = {
    "a net renamed on the sheet": (".kicad_sch", swap('(label "fM"', '(label "SH"'), "source"),
    "a rule relaxed": (
        ".kicad_pro",
        swap('"min_clearance": 0.2', '"min_clearance": 0.1'),
        "source",
    ),
    "a pad on another net": (".kicad_pcb", first_net("Q1", "1", "GND"), "net"),
    "a footprint swapped": (
        ".kicad_pcb",
        swap('"Package_TO_SOT_THT:TO-92_Inline"', '"Package_TO_SOT_THT:TO-92"'),
        "part",
    ),
    "a part renamed": (".kicad_pcb", swap('"Reference" "C2"', '"Reference" "C20"'), "part"),
    "a value changed": (".kicad_pcb", swap('"Value" "150 Ω"', '"Value" "1500 Ω"'), "part"),
    "a thin track": (".kicad_pcb", swap("(width 0.4)", "(width 0.1)"), "width"),
    "a smaller board": (".kicad_pcb", swap("(end 122.5 122.5)", "(end 120 122.5)"), "outline"),
    "a screw hole moved": (".kicad_pcb", swap("(at 81 119)", "(at 82 119)"), "outline"),
    "a hole not drilled": ("-PTH.drl", swap("X-12.7Y5.08\n", ""), "drill"),
    "a hole drilled elsewhere": ("-NPTH.drl", swap("X-19.0Y19.0", "X-18.0Y19.0"), "drill"),
    "a pad's copper moved": ("-F_Cu.gtl", swap("X-12700000Y-5080000D03", "X0Y0D03"), "plot"),
    "a pad's copper gone": ("-B_Cu.gbl", swap("X-12700000Y-5080000D03*", ""), "plot"),
    "copper between two nets": ("-F_Cu.gtl", swap("M02*", "X0Y0D02*\nX9000000Y0D01*\nM02*"), "sum"),
    "a pad under solder mask": ("-B_Mask.gbs", swap("D03*", "D02*"), "sum"),
    "a name on the wrong part": ("-F_Silkscreen.gto", swap("D01*", "D02*"), "sum"),
    "another outline": ("-Edge_Cuts.gm1", swap("X22500000Y22500000", "X32500000Y22500000"), "plot"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_faults_in_written_files_are_found(fault: str, tmp_path: Path) -> None:
    suffix, change, check = FAULTS[fault]
    board = BOARDS["tcd1304"]
    folder = shutil.copytree(kicad.COMMITTED / board.name, tmp_path / board.name)
    (path,) = folder.rglob(f"{board.name}{suffix}")
    path.write_text(change(path.read_text(encoding="utf-8")), encoding="utf-8")
    assert check in {finding.check for finding in check_committed(board, folder)}


def test_missing_and_foreign_files_are_found(tmp_path: Path) -> None:
    board = BOARDS["tcd1304"]
    folder = shutil.copytree(kicad.COMMITTED / board.name, tmp_path / board.name)
    gerber = folder / "gerbers" / "tcd1304-B_Mask.gbs"
    gerber.rename(gerber.with_suffix(".old"))
    assert [finding.where for finding in check_committed(board, folder)] == [
        "tcd1304-B_Mask.gbs",
        "tcd1304-B_Mask.old",
    ]


def test_a_change_of_the_board_is_found() -> None:
    """A board that was changed, and not written again."""
    board = BOARDS["tcd1304"]
    legs = {"OS": ("Q1.1", "Q1.2"), "collector": ("Q1.2", "Q1.1")}
    nets = dict(board.nets)
    for net, (old, new) in legs.items():
        ends = [Terminal.read(new) if str(end) == old else end for end in nets[net]]
        nets[net] = tuple(ends)
    found = {
        (finding.check, finding.where) for finding in check_committed(replace(board, nets=nets))
    }
    assert {("source", "tcd1304.kicad_sch"), ("net", "Q1.1"), ("net", "Q1.2")} <= found


# --- the boards as they are laid out --------------------------------------------------------------


@pytest.mark.parametrize("name", ["tcd1304", "tcd1304-improved"])
def test_sensor_board_fits_the_mount(name: str) -> None:
    """Section 4.4.2: the sensor in the middle of one side, all other parts on the other."""
    rules = mechanics()["sensor_board"]
    laid = read_layout(text_of(BOARDS[name], ".kicad_pcb"))
    assert [reference for reference, part in laid.parts.items() if part.front] == ["U1"]
    sensor = [pad.at for pad in laid.parts["U1"].pads]
    assert [math.fsum(at[i] for at in sensor) for i in (0, 1)] == pytest.approx([0, 0], abs=1e-9)
    assert {abs(at[1]) for at in sensor} == {mechanics()["package"]["TCD1304"]["row_distance"] / 2}
    assert max(at[0] for at in sensor) == pytest.approx(5 * 2.54)
    joint = 0.8  # half a pad
    for part in laid.parts.values():
        for pad in part.pads:
            assert pad.hole == 0 or any(
                abs(pad.at[0]) + joint <= x and abs(pad.at[1]) + joint <= y
                for x, y in rules["joints"]
            ), pad


@pytest.mark.parametrize("name", ["led-driver", "led-driver-improved"])
def test_led_currents_have_wide_tracks(name: str) -> None:
    """1.4 A in 35 µm of copper."""
    board = BOARDS[name]
    laid = read_layout(text_of(board, ".kicad_pcb"))
    widths = {net: width for net, width in laid.tracks if net.startswith(("/anode", "/cathode"))}
    assert len(widths) == (12 if board.base else 6)
    assert min(widths.values()) >= 1.5
    assert laid.zones == {"F.Cu": "+LED", "B.Cu": "GND"}


@pytest.mark.parametrize("name", ["tcd1304", "led-driver"])
def test_variants_share_the_places_of_what_they_share(name: str) -> None:
    base, variant = (
        read_layout(text_of(BOARDS[board], ".kicad_pcb")) for board in (name, f"{name}-improved")
    )
    assert (base.edge, base.holes) == (variant.edge, variant.holes)
    for reference in base.parts.keys() & variant.parts.keys():
        pads = [part.parts[reference].pads for part in (base, variant)]
        if len(pads[0]) == len(pads[1]):
            assert [pad.at for pad in pads[0]] == [pad.at for pad in pads[1]], reference


@pytest.mark.parametrize("name", BOARDS)
def test_every_part_has_a_hole_for_every_pin(name: str) -> None:
    board = BOARDS[name]
    drilled = read_drills((kicad.COMMITTED / name / "gerbers" / f"{name}-PTH.drl").read_text())
    pins = sum(len(part.type.pins) for part in board.parts.values() if part.reference != "U3")
    vias = sum(number for (_, _, size), number in drilled.items() if size == 0.4)
    assert drilled.total() - vias == pins


# --- the schematic, traced as KiCad does ----------------------------------------------------------


def traced(board: Board) -> set[frozenset[Terminal]]:
    """Return which pins the drawn wires and names join."""
    sheet = read(text_of(board, ".kicad_sch"))
    group: dict[object, object] = {}

    def root(item: object) -> object:
        while group.setdefault(item, item) != item:
            item = group[item]
        return item

    def at(node: list[str]) -> Point:
        return (round(float(node[1]), 3), round(float(node[2]), 3))

    kinds: dict[str, list[list[list[str]]]] = {}
    for item in sheet[1:]:
        kinds.setdefault(item[0], []).append(item)

    def part(item: list[list[str]], name: str) -> list[str]:
        return next(field for field in item[1:] if field[0] == name)

    wires = [tuple(at(end) for end in part(wire, "pts")[1:]) for wire in kinds["wire"]]  # type: ignore[arg-type]
    for a, b in wires:
        group[root(a)] = root(b)
    named = [(at(part(label, "at")), str(label[1])) for label in kinds["label"]]
    for symbol in kinds["symbol"]:
        fields = {field[1]: field[2] for field in symbol[1:] if field[0] == "property"}
        if fields["Reference"].startswith("#PWR"):
            named.append((at(part(symbol, "at")), fields["Value"]))
    for place, name in named:
        ends = [
            wire
            for wire in wires
            if math.isclose(
                math.dist(wire[0], place) + math.dist(place, wire[1]),
                math.dist(*wire),
                abs_tol=1e-6,
            )
        ]
        assert ends, f"{name} lies on no wire"
        group[root(ends[0][0])] = root(name)
    joined: dict[object, set[Terminal]] = {}
    for unit in schematic.units(board, kicad.layout_of(board)):
        for pin in unit.pins(board):
            joined.setdefault(root((round(pin.at[0], 3), round(pin.at[1], 3))), set()).add(
                pin.terminal
            )
    return {frozenset(ends) for ends in joined.values()}


@pytest.mark.parametrize("name", BOARDS)
def test_schematic_joins_the_pins_that_the_board_joins(name: str) -> None:
    board = BOARDS[name]
    nets = {frozenset(ends) for ends in board.nets.values()}
    assert traced(board) == nets | {frozenset([end]) for end in board.no_connect}


def test_parts_of_the_sheet_do_not_lie_on_each_other() -> None:
    for board in BOARDS.values():
        places = [unit.at for unit in schematic.units(board, kicad.layout_of(board))]
        nearest = min(math.dist(a, b) for n, a in enumerate(places) for b in places[:n])
        assert nearest >= 10.0


def test_symbols_have_the_pins_of_their_parts() -> None:
    for board in BOARDS.values():
        for part in board.parts.values():
            pins = [pin for unit in schematic.drawings(part.type) for pin in unit.pins]
            drawn = sorted((int(pin.number), pin.name) for pin in pins)
            assert drawn == list(enumerate((pin.name for pin in part.type.pins), start=1))


def test_a_part_without_a_place_is_an_error() -> None:
    board = BOARDS["tcd1304"]
    placed = kicad.layout_of(board)
    del placed["schematic"]["R1"]
    with pytest.raises(KeyError, match="R1"):
        schematic.draw(board, placed)
    placed = kicad.layout_of(board)
    placed["schematic"]["U2"].pop()
    with pytest.raises(ValueError, match="U2 has 7 units, 6 are placed"):
        schematic.draw(board, placed)


# --- files ----------------------------------------------------------------------------------------


def test_nested_lists_survive_writing() -> None:
    tree = ["a", ["b", 'quote " and \\ and\nline', ["c", "Ω"]], ["d"]]
    assert read(write([schematic.Symbol("a"), *tree[1:]])) == tree


@pytest.mark.parametrize(
    "text",
    ["(a (b)", "(a))", '(a "b)', "", "(a)(b)"],
    ids=["open", "closed", "quote", "none", "two"],
)
def test_broken_files_are_refused(text: str) -> None:
    with pytest.raises(ValueError, match=r"bracket|quote"):
        read(text)


def test_numbers_are_written_short() -> None:
    numbers = [1.27, -0.0, -2.54, 100.0, 0.00001, -10.5]
    assert [write(number) for number in numbers] == ["1.27", "0", "-2.54", "100", "0", "-10.5"]


# --- the router -----------------------------------------------------------------------------------


def pin(net: str, x: float, y: float) -> Pad:
    return Pad(f"{net}{x},{y}", net, (x, y), (0.8, 0.8), 0.8, (0, 1))


def router(pads: list[Pad], width: float = 0.5, clearance: float = 0.25) -> Router:
    widths = dict.fromkeys(sorted({pad.net for pad in pads}), width)
    return Router(pads, (30.0, 20.0), (0.0, 0.0), [(3.0, 3.0)], 0.635, clearance, widths)


def gap(a: Track, b: Track) -> float:
    """Distance of two tracks' edges: sampled every 0.05 mm."""

    def points(track: Track) -> list[Point]:
        steps = int(math.dist(track.start, track.end) / 0.05) + 1
        (x, y), (u, v) = track.start, track.end
        return [(x + (u - x) * n / steps, y + (v - y) * n / steps) for n in range(steps + 1)]

    nearest = min(math.dist(p, q) for p in points(a) for q in points(b))
    return nearest - (a.width + b.width) / 2


CROSSING = [
    *(pin("across", x, 10.16) for x in (5.08, 25.4)),
    *(pin("along", 15.24, y) for y in (2.54, 17.78)),
    *(pin("slanting", x, y) for x, y in ((7.62, 5.08), (22.86, 15.24), (22.86, 5.08))),
]


@pytest.mark.parametrize("width", [0.4, 1.0, 2.0])
def test_tracks_join_their_pads_and_keep_clear_of_others(width: float) -> None:
    tracks = router(CROSSING, width).run()
    for n, a in enumerate(tracks):
        for b in tracks[:n]:
            if a.net != b.net and (a.layer == b.layer or -1 in {a.layer, b.layer}):
                assert gap(a, b) >= 0.25 - 0.01
        for pad in CROSSING:
            if pad.net != a.net:
                edge = min(pad.distance(*at) for at in (a.start, a.end)) - a.width / 2
                assert edge >= 0.25 - 1e-9
    for net in {pad.net for pad in CROSSING}:
        own = [track for track in tracks if track.net == net]
        reached, places = 0, {next(pad.at for pad in CROSSING if pad.net == net)}
        while reached != len(places):
            reached = len(places)
            for track in own:
                ends = {track.start, track.end}
                if any(math.dist(p, q) < 1e-3 for p in ends for q in places):
                    places |= ends
        for pad in CROSSING:
            assert pad.net != net or any(math.dist(pad.at, place) < 1e-3 for place in places)


def test_the_same_pads_give_the_same_tracks() -> None:
    assert router(CROSSING).run() == router(CROSSING).run()


def test_a_pad_behind_a_wall_cannot_be_reached() -> None:
    wall = Pad("wall", "other", (12.7, 10.0), (0.5, 10.0), 0.0, (0, 1))
    with pytest.raises(UnroutableError, match="net"):
        router([pin("net", 5.08, 10.16), pin("net", 20.32, 10.16), wall]).run()


def test_tracks_keep_off_edge_and_screws() -> None:
    tracks = router([pin("net", x, y) for x, y in ((1.27, 8.89), (8.89, 1.27))]).run()
    for track in tracks:
        for x, y in (track.start, track.end):
            assert min(x, y, 30 - x, 20 - y) >= 0.5 + track.width / 2 - 1e-9
            if track.start != track.end and (x, y) not in {(1.27, 8.89), (8.89, 1.27)}:
                assert math.dist((x, y), (3.0, 3.0)) >= 2.8 + track.width / 2 - 1e-9
