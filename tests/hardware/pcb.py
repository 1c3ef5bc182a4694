"""The KiCad projects with KiCad 9: written again byte for byte, without violations, faults found.

Not collected with the other tests: ``make pcb`` runs it.
"""

from __future__ import annotations

import re
import shutil
from typing import TYPE_CHECKING

import pytest

from hardware import kicad
from hardware.boards import BOARDS
from hardware.kicad import Kicad

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path


@pytest.fixture(scope="session")
def tool(tmp_path_factory: pytest.TempPathFactory) -> Kicad:
    return Kicad(tmp_path_factory.mktemp("settings"))


@pytest.mark.parametrize("name", BOARDS)
def test_writing_again_gives_the_committed_files(name: str, tool: Kicad, tmp_path: Path) -> None:
    tool.write(BOARDS[name], tmp_path / name)
    for folder in (tmp_path, kicad.COMMITTED):
        files = {path.relative_to(folder) for path in (folder / name).rglob("*") if path.is_file()}
        for path in files:
            assert (tmp_path / path).read_bytes() == (kicad.COMMITTED / path).read_bytes(), path


@pytest.mark.parametrize("name", BOARDS)
def test_kicad_finds_nothing(name: str, tool: Kicad, tmp_path: Path) -> None:
    """Rules of schematic and layout, no net open, the same parts and nets in both."""
    assert tool.check(shutil.copytree(kicad.COMMITTED / name, tmp_path / name)) == []


def swap(old: str, new: str) -> Callable[[str], str]:
    def change(text: str) -> str:
        assert old in text
        return text.replace(old, new, 1)

    return change


def without_tracks(net: str) -> Callable[[str], str]:
    def change(text: str) -> str:
        (number,) = set(re.findall(rf'^\t\(net (\d+) "{net}"\)', text, re.MULTILINE))
        track = rf"\t\((?:segment|via)\n(?:(?!\t\)\n).*\n)*?\t\t\(net {number}\)\n.*\n\t\)\n"
        changed, count = re.subn(track, "", text)
        assert count
        return changed

    return change


def moved_track(text: str) -> str:
    """Move one end of the first track across the board."""
    return re.sub(
        r"(\t\(segment\n\t\t\(start \S+ \S+\)\n\t\t)\(end \S+ \S+\)",
        r"\1(end 110 90)",
        text,
        count=1,
    )


FAULTS: dict[str, tuple[str, Callable[[str], str], set[str]]] = {
    "a net is not laid": (".kicad_pcb", without_tracks("/OS"), {"unconnected_items"}),
    "a track is moved over others": (".kicad_pcb", moved_track, {"shorting_items", "tracks_crossing"}),
    "a footprint is swapped": (
        ".kicad_pcb",
        swap("Resistor_THT:R_Axial_DIN0207_L6.3mm_D2.5mm_P10.16mm_Horizontal",
             "Resistor_THT:R_Axial_DIN0204_L3.6mm_D1.6mm_P7.62mm_Horizontal"),
        {"footprint_symbol_mismatch"},
    ),
    "the sheet joins other nets": (".kicad_sch", swap('(label "fM"', '(label "SH"'), {"net_conflict"}),
    "a supply has no source": (
        ".kicad_sch", swap('(lib_id "linetrack:PWR_FLAG")', '(lib_id "linetrack:GND")'), {"power_pin_not_driven"},
    ),
    "a part is not on the board": (
        ".kicad_sch", swap('(reference "C2")', '(reference "C9")'), {"missing_footprint"},
    ),
    "a screw hole cuts copper": (".kicad_pcb", swap("(at 81 119)", "(at 87.3 104)"), {"hole_clearance"}),
    "the edge cuts copper": (
        ".kicad_pcb", swap("(end 122.5 122.5)", "(end 113 122.5)"), {"copper_edge_clearance"},
    ),
}  # fmt: skip


@pytest.mark.parametrize("fault", FAULTS)
def test_faults_are_found(fault: str, tool: Kicad, tmp_path: Path) -> None:
    suffix, change, expected = FAULTS[fault]
    folder = shutil.copytree(kicad.COMMITTED / "tcd1304", tmp_path / "tcd1304")
    path = folder / f"tcd1304{suffix}"
    path.write_text(change(path.read_text(encoding="utf-8")), encoding="utf-8")
    found = {violation.partition(":")[0] for violation in tool.check(folder)}
    assert expected <= found, found
