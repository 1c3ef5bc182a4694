"""KiCad projects of the boards: schematic, layout, and the files that a manufacturer wants.

What is written is committed in ``hardware/kicad``, so that ordering needs no KiCad. Writing it again,
``python -m hardware.kicad``, needs KiCad 9: ``kicad-cli`` and, for the layout, the module ``pcbnew``
of the system's Python.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import re
import shutil
import subprocess
import tempfile
import tomllib
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from hardware import layout, schematic
from hardware.boards import BOARDS, DATA, Terminal
from hardware.mount import mechanics
from hardware.schematic import identity

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from hardware.boards import Board

COMMITTED: Final = Path(__file__).parent / "kicad"
"""Where the written projects are, a folder a board."""

LAYERS: Final = {
    "F.Cu": "gtl",
    "B.Cu": "gbl",
    "F.Paste": "gtp",
    "B.Paste": "gbp",
    "F.Silkscreen": "gto",
    "B.Silkscreen": "gbo",
    "F.Mask": "gts",
    "B.Mask": "gbs",
    "Edge.Cuts": "gm1",
}
"""Layers of which there is a Gerber file, and its suffix."""

SUMS: Final = "SHA256SUMS"
"""File of a project in which the others' sums are, as ``sha256sum`` writes and reads them."""

PYTHON: Final = "/usr/bin/python3"
"""The interpreter that has ``pcbnew``."""

SHARE: Final = Path("/usr/share/kicad")
"""KiCad's own files, as Debian has them."""

ORIGIN: Final = (100.0, 100.0)
"""Where a board's frame has its origin on KiCad's page, mm."""


class KicadError(RuntimeError):
    """KiCad is not there, or refuses."""


def layout_of(board: Board) -> dict[str, Any]:
    """Return the places of a board's parts: that of its base if it is a variant."""
    path = DATA / "layout" / f"{board.base or board.name}.toml"
    return tomllib.loads(path.read_text(encoding="utf-8"))


def outline(placed: Mapping[str, Any]) -> dict[str, Any]:
    """Return size, corner, holes and thickness of a board, mm; frame as in its layout."""
    data = mechanics()
    sensor, where = data["sensor_board"], placed["board"]["outline"]
    if where == "sensor_board":
        return {**sensor, "corner": tuple(-side / 2 for side in sensor["size"])}
    alike = {name: sensor[name] for name in ("thickness", "hole_diameter")}
    return {**alike, **data["boards"][where], "corner": (0.0, 0.0)}


def job(board: Board, placed: Mapping[str, Any], output: Path) -> dict[str, Any]:
    """Return what `hardware.layout` needs to lay a board out.

    Parameters
    ----------
    board : Board
    placed : mapping
        Its file of ``data/layout``.
    output : Path
        Of the board's file.

    Raises
    ------
    KeyError
        If the layout lacks a part.
    """
    rules, frame = placed["board"], outline(placed)
    nets = schematic.net_names(board)
    named = {net: nets[ends[0]] for net, ends in board.nets.items()}
    zones = [rules["zones"][side] for side in ("front", "back")]
    parts = []
    for reference, part in board.parts.items():
        x, y, toward = rules["parts"][reference]
        pins = [str(n + 1) for n in range(len(part.type.pins))]
        ends = {pin: nets[Terminal(reference, pin)] for pin in pins}
        parts.append(
            {
                "reference": reference,
                "value": schematic.value(board, part),
                "footprint": part.type.footprint,
                "path": f"/{schematic.part_identity(board, part)}",
                "pins": pins,
                "nets": ends,
                "at": [x, y],
                "toward": toward,
                "back": rules["front"] != "all" and reference not in rules["front"],
                "fitted": schematic.fitted(board, part),
            }
        )
    return {
        "seed": int(identity(board.name)[:7], 16),
        "title": board.title,
        "output": str(output),
        "footprints": str(SHARE / "footprints"),
        "hole_footprint": [
            "MountingHole",
            f"MountingHole_{frame['hole_diameter']:g}mm_M2.5",
        ],
        "origin": ORIGIN,
        "corner": frame["corner"],
        "size": frame["size"],
        "holes": frame["holes"],
        "thickness": frame["thickness"],
        "grid": rules["grid"],
        # KiCad measures what the router rounds
        "clearance": rules["clearance"] + 0.02,
        "nets": list(named.values()),
        "zones": zones,
        "spoke": rules["spoke"],
        "widths": {name: width(rules, net) for net, name in named.items() if net not in zones},
        "parts": parts,
        "texts": list(_texts(board, rules, parts)),
    }


def width(rules: Mapping[str, Any], net: str) -> float:
    """Return a net's width, mm: its own, its kind's (cathode3: cathode) or the default."""
    widths: dict[str, float] = rules["width"]
    kind = net.rstrip("0123456789")
    return widths.get(net, widths.get(kind, widths["default"]))


def _texts(
    board: Board, rules: Mapping[str, Any], parts: Sequence[Mapping[str, Any]]
) -> list[dict[str, Any]]:
    """Names of connectors' pins, and the board's."""
    way = {"right": (1, 0), "up": (0, 1), "left": (-1, 0), "down": (0, -1)}
    texts = []
    for part in parts:
        offset = rules["labels"].get(part["reference"])
        if offset is None:
            continue
        plug = board.connectors[part["reference"]]
        short = {"anode": "A", "cathode": "K"}
        for n, (name, _) in enumerate(plug.pins):
            x, y = (part["at"][i] + 2.54 * n * way[part["toward"]][i] + offset[i] for i in (0, 1))
            text = short.get(name, name)
            upright = len(text) > 2 and part["toward"] in {"left", "right"}
            style = {"size": 0.8, "degrees": 90.0 if upright else 0.0}
            texts.append({"text": text, "at": (x, y), "side": int(part["back"]), **style})
    texts.append({"text": board.title, "at": rules["title"], "side": 0, "size": 1.0})
    return texts


# --- files --------------------------------------------------------------------------------------


def project(board: Board, placed: Mapping[str, Any]) -> str:
    """Return the text of a project's file: the rules that the layout must keep."""
    rules = placed["board"]
    net_class = {
        "name": "Default",
        "clearance": rules["clearance"],
        "track_width": rules["width"]["default"],
        "via_diameter": layout.VIA[0],
        "via_drill": layout.VIA[1],
    }
    content = {
        "board": {
            "design_settings": {
                "rules": {
                    "min_clearance": rules["clearance"],
                    "min_copper_edge_clearance": layout.EDGE,
                    "min_hole_clearance": 0.25,
                    "min_hole_to_hole": 0.25,
                    "min_through_hole_diameter": 0.3,
                    "min_track_width": 0.2,
                    "min_via_diameter": 0.6,
                }
            }
        },
        "meta": {"filename": f"{board.name}.kicad_pro", "version": 3},
        "net_settings": {"classes": [net_class], "meta": {"version": 4}},
    }
    return json.dumps(content, indent=2) + "\n"


TABLE: Final = (
    "(sym_lib_table\n\t(version 7)\n"
    f'\t(lib (name "{schematic.LIBRARY}") (type "KiCad") '
    f'(uri "${{KIPRJMOD}}/{schematic.LIBRARY}.kicad_sym") (options "") (descr ""))\n)\n'
)
"""Where a project finds its symbols."""


def sources(board: Board, placed: Mapping[str, Any] | None = None) -> dict[str, str]:
    """Return the project's files that need no KiCad, by name.

    Parameters
    ----------
    board : Board
    placed : mapping, optional
        Left out, `layout_of` the board.
    """
    placed = layout_of(board) if placed is None else placed
    sheet, symbols = schematic.draw(board, placed)
    return {
        f"{board.name}.kicad_sch": sheet,
        f"{board.name}.kicad_pro": project(board, placed),
        f"{schematic.LIBRARY}.kicad_sym": symbols,
        "sym-lib-table": TABLE,
    }


def sums(folder: Path) -> str:
    """Return what `SUMS` of a project says as long as its files are as KiCad wrote them."""
    names = sorted(
        path.relative_to(folder).as_posix()
        for path in folder.rglob("*")
        if path.is_file() and path.name != SUMS
    )
    return "".join(
        f"{hashlib.sha256((folder / name).read_bytes()).hexdigest()}  {name}\n" for name in names
    )


def _run(command: Sequence[str | Path], config: Path, text: str = "") -> str:
    environment = {**os.environ, "KICAD_CONFIG_HOME": str(config)}
    done = subprocess.run(  # noqa: S603
        [str(word) for word in command],
        input=text,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        raise KicadError(f"{command[0]} {command[1]}: {done.stdout}{done.stderr}")
    return done.stdout


class Kicad:
    """KiCad's tools, with settings of their own.

    Parameters
    ----------
    config : Path
        An empty folder for them.

    Raises
    ------
    KicadError
        If there is no KiCad 9 here.
    """

    def __init__(self, config: Path) -> None:
        self.config = config
        version = self._cli("version").strip() if shutil.which("kicad-cli") else "none"
        if not version.startswith("9."):
            raise KicadError(
                f"KiCad 9 is needed, here is {version}; Debian 12: add bookworm-backports and "
                "apt install -t bookworm-backports kicad kicad-symbols kicad-footprints"
            )
        for table in ("fp-lib-table", "sym-lib-table"):
            shutil.copy(SHARE / "template" / table, self.config)

    def _cli(self, *words: str | Path) -> str:
        return _run(["kicad-cli", *words], self.config)

    def lay_out(self, job: Mapping[str, Any]) -> None:
        """Write a board's layout."""
        _run([PYTHON, layout.__file__], self.config, json.dumps(job))

    def check(self, folder: Path) -> list[str]:
        """Return what KiCad finds wrong with a project: rules of schematic, layout, their parity.

        Parameters
        ----------
        folder : Path
            It is named like the project.

        Returns
        -------
        list of str
            "type: description: items" each.
        """
        found = []
        with tempfile.TemporaryDirectory() as scratch:
            report = Path(scratch) / "report.json"
            common: list[str | Path] = ["--format", "json", "--severity-all", "-o", report]
            base = folder / folder.name
            self._cli("sch", "erc", *common, f"{base}.kicad_sch")
            for sheet in json.loads(report.read_text(encoding="utf-8"))["sheets"]:
                found += sheet["violations"]
            self._cli("pcb", "drc", "--schematic-parity", *common, f"{base}.kicad_pcb")
            result = json.loads(report.read_text(encoding="utf-8"))
            for table in ("violations", "unconnected_items", "schematic_parity"):
                found += result[table]
        return [
            f"{one['type']}: {one['description']}: "
            + "; ".join(item["description"] for item in one["items"])
            for one in found
        ]

    def plot(self, folder: Path) -> None:
        """Write Gerber and drill files (folder ``gerbers``) and pictures; no dates in them."""
        board = folder / f"{folder.name}.kicad_pcb"
        picture = folder / f"{folder.name}.pdf"
        self._cli("sch", "export", "pdf", "-o", picture, board.with_suffix(".kicad_sch"))
        date = re.compile(
            rb"(?<=/CreationDate \(D:)\d{14}"
        )  # as long as before: a PDF counts bytes
        picture.write_bytes(date.sub(b"20000101000000", picture.read_bytes()))
        for side, name in (("F", "front"), ("B", "back")):
            picture = folder / f"{folder.name}-{name}.svg"
            layers = f"{side}.Cu,{side}.Mask,{side}.Silkscreen,Edge.Cuts"
            self._cli(
                *("pcb", "export", "svg", "--mode-single", "--page-size-mode", "2"),
                *("--exclude-drawing-sheet", "--layers", layers, "-o", picture, board),
            )
            text = picture.read_text(encoding="utf-8")
            picture.write_text(re.sub(r" date [^<]*(?=</title>)", "", text), encoding="utf-8")
        output = folder / "gerbers"
        shutil.rmtree(output, ignore_errors=True)
        output.mkdir()
        self._cli(
            *("pcb", "export", "gerbers", "--use-drill-file-origin", "--layers", ",".join(LAYERS)),
            *("-o", f"{output}/", board),
        )
        self._cli(
            *("pcb", "export", "drill", "--drill-origin", "plot", "--excellon-units", "mm"),
            *("--excellon-separate-th", "-o", f"{output}/", board),
        )
        for path in output.iterdir():
            text = path.read_text(encoding="utf-8")
            if path.suffix == ".gbrjob":
                path.unlink()  # a copy of what the other files say, with a date
                continue
            text = re.sub(
                r"^(%TF\.CreationDate|; #@! TF\.CreationDate).*\n", "", text, flags=re.MULTILINE
            )
            text = re.sub(
                r"^(G04 Created by KiCad.*?|; DRILL file .*?) date .*?(\*?)$",
                r"\1\2",
                text,
                flags=re.MULTILINE,
            )
            path.write_text(text, encoding="utf-8")

    def write(self, board: Board, folder: Path, placed: Mapping[str, Any] | None = None) -> None:
        """Write a board's whole project, files for its manufacturer included.

        Parameters
        ----------
        board : Board
        folder : Path
            It is made; its name must be the board's.
        placed : mapping, optional
            Left out, `layout_of` the board.
        """
        placed = layout_of(board) if placed is None else placed
        folder.mkdir(parents=True, exist_ok=True)
        for name, text in sources(board, placed).items():
            (folder / name).write_text(text, encoding="utf-8")
        self.lay_out(job(board, placed, folder / f"{board.name}.kicad_pcb"))
        self.plot(folder)
        (folder / SUMS).write_text(sums(folder), encoding="utf-8")


def main() -> None:
    """Write every board's project and say what KiCad finds wrong."""
    parser = argparse.ArgumentParser(prog="python -m hardware.kicad", description=main.__doc__)
    parser.add_argument("boards", nargs="*", help=f"of {', '.join(BOARDS)}; left out, all")
    parser.add_argument("--output", type=Path, default=COMMITTED)
    arguments = parser.parse_args()
    if unknown := set(arguments.boards) - BOARDS.keys():
        parser.error(f"no board is called {', '.join(sorted(unknown))}")
    bad = 0
    with tempfile.TemporaryDirectory() as config:
        kicad = Kicad(Path(config))
        for name in arguments.boards or BOARDS:
            folder = arguments.output / name
            kicad.write(BOARDS[name], folder)
            found = kicad.check(folder)
            bad += len(found)
            print(f"{name}: {len(found)} violations", *found, sep="\n  ")  # noqa: T201
    raise SystemExit(bool(bad))


if __name__ == "__main__":
    main()
