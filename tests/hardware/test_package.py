"""The build package: what is in it, that it is the same every time, and what stops it."""

from __future__ import annotations

import csv
import hashlib
import io
import json
import os
import re
import shutil
import sys
import zipfile
from dataclasses import replace
from decimal import Decimal
from html.parser import HTMLParser
from importlib.util import find_spec
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np
import pytest
import trimesh

from acquisition import wiring
from hardware import circuits, instructions, kicad, package
from hardware.boards import BOARDS, SURROUNDINGS, Terminal
from hardware.mount import LensMount, lens_mount, mechanics
from hardware.package import FaultsError, Package, build_package, make_plan
from hardware.solids import Placed
from raytransfer.designs import DESIGNS, load_design
from raytransfer.lenses import Lens
from raytransfer.systems import OpticalSystem

if TYPE_CHECKING:
    from collections.abc import Callable

    from raytransfer.sensors import LineSensor

THESIS = DESIGNS["thesis"].system

needs_ngspice = pytest.mark.skipif(shutil.which("ngspice") is None, reason="ngspice is missing")


@pytest.fixture(scope="session")
def built(tmp_path_factory: pytest.TempPathFactory) -> Package:
    """Everything that can be made here."""
    return build_package(THESIS, tmp_path_factory.mktemp("built") / "package")


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without build123d and ngspice, and with small pictures: the rest is as always."""
    monkeypatch.setitem(sys.modules, "build123d", None)
    monkeypatch.setattr(shutil, "which", lambda *_, **__: None)
    blank = np.zeros((2, 2, 3), dtype=np.uint8)
    monkeypatch.setattr(instructions, "picture", lambda *_, **__: blank)


def contents(folder: Path) -> dict[str, bytes]:
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file()
    }


# --- content --------------------------------------------------------------------------------------


def test_every_file_is_there(built: Package) -> None:
    names = set(contents(built.folder))
    printed = ["lens-mount-lower", "lens-mount-upper", "base", "lens-holder", "foot"]
    printed += ["led-board-holder", "led-mount"]
    boards = ["tcd1304-improved", "led-driver-improved"]
    wanted = {f"print/{name}.stl" for name in printed}
    wanted |= {f"boards/{b}-{what}" for b in boards for what in ("gerbers.zip", "schematic.pdf")}
    wanted |= {f"bill/{name}.csv" for name in (*boards, "lens-head", "leds", "stand")}
    wanted |= {"bill/bill.md", "wiring/wiring.md", "wiring/wiring.h", "wiring/firmware.md"}
    wanted |= {"design.toml", "assembly.html", "manifest.json"}
    if find_spec("build123d"):
        bodies = ("lens-mount", "stand", "led-mount")
        wanted |= {f"cad/{name}.{end}" for name in bodies for end in ("step", "svg")}
    assert names == wanted
    assert not list(built.folder.parent.glob(".*"))


def test_manifest_lists_every_other_file(built: Package) -> None:
    manifest = json.loads((built.folder / "manifest.json").read_text())
    assert manifest == built.manifest
    there = contents(built.folder)
    listed = {entry["path"]: entry for entry in manifest["files"]}
    assert listed.keys() == there.keys() - {"manifest.json"}
    for name, entry in listed.items():
        assert entry["size"] == len(there[name])
        assert entry["sha256"] == hashlib.sha256(there[name]).hexdigest()
    assert manifest["variant"] == "improved"
    assert manifest["hazards"] == []
    assert manifest["fabricated"] is False
    figures = manifest["figures"]
    assert figures["mount_size_mm"] == pytest.approx([45, 45, 59], abs=0.05)
    heights = figures["lens_heights_above_cover_mm"].values()
    assert {25.4, 40.0, 3.0} <= {round(height, 6) for height in heights}


def test_parts_lie_on_the_bed_and_are_those_of_the_plan(built: Package) -> None:
    for part in built.plan.printed:
        surface = trimesh.load_mesh(built.folder / part.path)
        assert surface.is_watertight
        assert surface.bounds[0, 2] == pytest.approx(0.0, abs=1e-4)
        assert surface.volume == pytest.approx(
            built.manifest["figures"]["printed_volume_mm3"][part.name], rel=1e-4
        )
        low = surface.triangles[:, :, 2].max(axis=1) < 0.01
        assert surface.area_faces[low].sum() > 300
    amounts = {part.name: part.amount for part in built.plan.printed}
    assert amounts["LED mount"] == 2  # the thesis's table 4.8


def test_gerbers_are_the_committed_ones(built: Package) -> None:
    for board in built.plan.boards:
        with zipfile.ZipFile(built.folder / f"boards/{board.name}-gerbers.zip") as archive:
            inside = {name: archive.read(name) for name in archive.namelist()}
        assert inside == contents(kicad.COMMITTED / board.name / "gerbers")


def test_bill_adds_up(built: Package) -> None:
    total = Decimal(0)
    for path in (built.folder / "bill").glob("*.csv"):
        rows = csv.DictReader(io.StringIO(path.read_text()))
        total += sum(Decimal(row["total"]) for row in rows if row["total"])
    assert str(total) == built.manifest["figures"]["priced_total_euro"]
    assert f"{total} €" in (built.folder / "bill/bill.md").read_text()
    assert f"{total} €" in built.page.read_text()


def test_screws_fit(built: Package) -> None:
    """They go through what they hold, and do not meet the end of their holes."""
    plan, lines = built.plan, {line.type: line.amount for line in built.plan.bills["stand"].lines}
    for name, through, depth in (
        (plan.board_screw, 1.6, plan.stand.rules["core_depth"]),
        (plan.foot_screw, plan.stand.rules["plate"], plan.stand.rules["core_depth"]),
    ):
        length = float(name.split()[2])
        assert through + 4 <= length < through + depth
    assert lines[plan.board_screw] == 7 + 4  # section 4.4.1: seven for the computers; LED board
    assert lines["M3 x 55 screw"] == 4
    assert "M3 screw" not in {line.type for line in plan.bills["lens-head"].lines}


@pytest.mark.usefixtures("quick")
def test_screws_are_as_long_as_the_mount_is_high(monkeypatch: pytest.MonkeyPatch) -> None:
    lenses = [
        replace(lens, length=50.0) if isinstance(lens, Lens) and lens.height > 20 else lens
        for lens in THESIS.elements
    ]
    high = make_plan(replace(THESIS, elements=tuple(lenses)))
    assert high.mount.size[1] > 50
    needed = high.mount.size[1] + high.stand.rules["plate"] + 2 * 0.5 + 2.4
    length = float(high.mount_screw.split()[2])
    assert needed <= length < needed + 10
    assert high.bills["stand"].lines
    known = mechanics()
    monkeypatch.setattr(
        package, "mechanics", lambda: {**known, "screws": {**known["screws"], "lengths": [10, 55]}}
    )
    with pytest.raises(ValueError, match="no M3 screw of 62 mm is sold"):
        _ = high.mount_screw


def test_wiring_and_design_are_the_project_s(built: Package) -> None:
    assert (built.folder / "wiring/wiring.md").read_text() == wiring.markdown()
    assert (built.folder / "wiring/wiring.h").read_text() == wiring.c_header()
    assert load_design(built.folder / "design.toml").system == THESIS


@pytest.mark.skipif(find_spec("build123d") is None, reason="build123d is not installed")
def test_step_files_have_no_date_of_today(built: Package) -> None:
    for path in (built.folder / "cad").glob("*.step"):
        assert re.findall(r"\d{4}-\d\d-\d\dT[\d:]+", path.read_text()) == ["2000-01-01T00:00:00"]


class Links(HTMLParser):
    """All that a page loads, its open elements and its text."""

    def __init__(self) -> None:
        super().__init__()
        self.loads: list[str] = []
        self.open: list[str] = []
        self.tags: list[str] = []
        self.text = ""

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.loads += [value or "" for name, value in attrs if name in ("src", "href")]
        if tag not in ("meta", "img", "br"):
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        pass

    def handle_data(self, data: str) -> None:
        self.text += data


def test_page_stands_alone(built: Package) -> None:
    text = built.page.read_text(encoding="utf-8")
    page = Links()
    page.feed(text)
    assert page.open == []
    assert all(link.startswith(("data:image/", "#")) for link in page.loads)
    assert "@import" not in text
    assert "url(" not in text
    assert not {"script", "link", "iframe"} & set(page.tags)
    assert page.tags.count("img") == 7
    for words in (
        "0.15 mm",
        "45.0 × 45.0 × 59.0 mm",
        "never made",
        "Nothing has been fabricated",
        "PB13",
        "25.40",
        "PCX_30_32_60 (1)",
        "connector P1 at the right seen from behind",
        "All but U1 go on the back.",
    ):
        assert words in page.text
    for board in built.plan.boards:
        for change in board.changes:
            assert change.removes in page.text
            assert change.why in page.text
    for part in built.plan.printed:
        assert part.path in page.text
    for socket in (
        ("J1", "LED 1", "led1", "anode", "cathode"),
        ("J2", "LED 2", "led0", "anode", "cathode"),
        ("J7", "supply of the LEDs", "", "+LED", "GND"),
    ):
        assert "".join(f"<td>{words}</td>" for words in socket) in text.replace("\n", "")


def test_pictures_are_png() -> None:
    image = np.random.default_rng(1).integers(0, 256, (7, 5, 3), dtype=np.uint8)
    pil = pytest.importorskip("PIL.Image")
    assert np.array_equal(np.asarray(pil.open(io.BytesIO(instructions.png(image)))), image)


def test_twice_the_same_bytes(built: Package, tmp_path: Path) -> None:
    again = build_package(THESIS, tmp_path / "elsewhere")
    assert contents(again.folder) == contents(built.folder)


@needs_ngspice
def test_hazards_of_the_thesis_are_listed_and_do_not_stop(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setitem(sys.modules, "build123d", None)
    made = build_package(THESIS, tmp_path / "package", variant="thesis")
    hazards = {(entry["board"], entry["check"]) for entry in made.manifest["hazards"]}
    assert hazards == {
        (BOARDS[board.base].title, change.removes)
        for board in BOARDS.values()
        for change in board.changes
    }
    page = Links()
    page.feed(made.page.read_text(encoding="utf-8"))
    for board in BOARDS.values():
        for change in board.changes:
            assert change.why in page.text
    assert "What removes it" in page.text


@pytest.mark.usefixtures("quick")
@pytest.mark.parametrize("name", sorted(DESIGNS.keys() - {"thesis"}))
def test_other_heads(name: str, tmp_path: Path) -> None:
    made = build_package(DESIGNS[name].system, tmp_path / "package")
    assert len(made.manifest["figures"]["lens_heights_above_cover_mm"]) == 2


# --- what is not installed ------------------------------------------------------------------------


@pytest.mark.usefixtures("quick")
def test_without_ngspice_and_build123d_it_says_so(tmp_path: Path) -> None:
    made = build_package(THESIS, tmp_path / "package")
    assert made.manifest["simulated_circuits"] is False
    assert [line.partition(":")[0] for line in made.manifest["left_out"]] == [
        "STEP files and drawings",
        "circuit simulation",
    ]
    assert not (made.folder / "cad").exists()
    page = made.page.read_text(encoding="utf-8")
    assert "ngspice was not installed" in page
    assert "pip install linetrack[cad]" in page
    assert "simulated with ngspice" not in page


# --- faults stop it -------------------------------------------------------------------------------


def stopped(tmp_path: Path, system: OpticalSystem = THESIS) -> list[tuple[str, str]]:
    with pytest.raises(FaultsError) as caught:
        build_package(system, tmp_path / "package")
    assert list(tmp_path.glob("*package*")) == []
    assert str(caught.value).count("\n") == len(caught.value.faults)
    return [(fault.part, fault.finding.check) for fault in caught.value.faults]


@pytest.mark.usefixtures("quick")
def test_colliding_lenses(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:

    def moved(system: OpticalSystem, sensor: LineSensor) -> LensMount:
        """The second of the pair stands 0.5 mm nearer to the first."""
        mount = lens_mount(system, sensor)
        second = mount.lenses[2]
        glass = Placed(second.glass, (0.0, 0.0, -0.5))
        lenses = (*mount.lenses[:2], replace(second, glass=glass), *mount.lenses[3:])
        return replace(mount, lenses=lenses)

    monkeypatch.setattr(package, "lens_mount", moved)
    assert ("lens mount", "collision") in stopped(tmp_path)


@pytest.mark.usefixtures("quick")
def test_a_part_larger_than_a_printer(tmp_path: Path) -> None:
    long = replace(THESIS, gaps=(THESIS.gaps[0], 200.0, *THESIS.gaps[2:]))
    assert {("lens mount lower", "printer"), ("lens mount upper", "printer")} <= {
        *stopped(tmp_path, long)
    }


def with_boards(monkeypatch: pytest.MonkeyPatch, name: str, **changes: object) -> None:
    board = replace(BOARDS[name], **changes)  # type: ignore[arg-type]
    monkeypatch.setattr(package, "BOARDS", MappingProxyType({**BOARDS, name: board}))


@pytest.mark.usefixtures("quick")
def test_a_short_on_a_board(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    nets = dict(BOARDS["tcd1304-improved"].nets)
    nets["fM"] = (*nets["fM"], Terminal("P1", "2"))
    with_boards(monkeypatch, "tcd1304-improved", nets=MappingProxyType(nets))
    assert ("TCD1304 board, improved", "short") in stopped(tmp_path)


@pytest.mark.usefixtures("quick")
def test_a_hazard_that_the_variant_should_not_have(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """The thesis's inverter on the improved board."""
    board = BOARDS["tcd1304-improved"]
    parts = {**board.parts, "U2": BOARDS["tcd1304"].parts["U2"]}
    with_boards(monkeypatch, board.name, parts=MappingProxyType(parts))
    assert (board.title, "logic level") in stopped(tmp_path)


@pytest.mark.usefixtures("quick")
def test_a_tampered_gerber(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    copy = shutil.copytree(kicad.COMMITTED, tmp_path / "kicad")
    (drills,) = copy.rglob("led-driver-improved-NPTH.drl")
    text = drills.read_text()
    place = re.search(r"^X.*Y.*\n", text, re.MULTILINE)
    assert place is not None
    drills.write_text(text.replace(place[0], "", 1))
    monkeypatch.setattr(kicad, "COMMITTED", copy)
    assert ("LED control board, improved", "drill") in stopped(tmp_path)


@needs_ngspice
def test_a_simulated_hazard(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Only the simulation sees an LED current above the LED's limit."""
    monkeypatch.setitem(sys.modules, "build123d", None)
    led = {**SURROUNDINGS["led"], "ampere": 1.0}
    surroundings = MappingProxyType({**SURROUNDINGS, "led": led})
    monkeypatch.setattr(circuits, "SURROUNDINGS", surroundings)
    assert stopped(tmp_path) == [("LED control board, improved", "series resistor")]


@pytest.mark.usefixtures("quick")
def test_every_fault_is_listed(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Those of all parts together, not of the first alone."""
    nets = dict(BOARDS["tcd1304-improved"].nets)
    nets["fM"] = (*nets["fM"], Terminal("P1", "2"))
    with_boards(monkeypatch, "tcd1304-improved", nets=MappingProxyType(nets))
    copy = shutil.copytree(kicad.COMMITTED, tmp_path / "kicad")
    (copy / "led-driver-improved" / "led-driver-improved.pdf").unlink()
    monkeypatch.setattr(kicad, "COMMITTED", copy)
    parts = {part for part, _ in stopped(tmp_path)}
    assert parts == {"TCD1304 board, improved", "LED control board, improved"}


def test_no_mount_can_be_made(tmp_path: Path) -> None:
    bare = OpticalSystem("bare", (THESIS.elements[-1],), (), 1.0)
    with pytest.raises(ValueError, match="there is no lens to mount"):
        build_package(bare, tmp_path / "package")
    with pytest.raises(ValueError, match="sensor_distance"):
        build_package(replace(THESIS, sensor_distance=None), tmp_path / "package")
    with pytest.raises(ValueError, match="allowed are improved and thesis"):
        make_plan(THESIS, variant="better")
    assert list(tmp_path.iterdir()) == []


# --- the folder -----------------------------------------------------------------------------------


@pytest.fixture
def unchecked(monkeypatch: pytest.MonkeyPatch, built: Package) -> Package:
    """Take a plan that is there, and write only a few small files."""
    monkeypatch.setattr(package, "make_plan", lambda *_, **__: built.plan)
    monkeypatch.setattr(package, "_has_cad", lambda: False)
    monkeypatch.setattr(package, "_contents", lambda _: iter([("bill/bill.md", b"bill")]))
    monkeypatch.setattr(instructions, "page", lambda *_: "page")
    return built


@pytest.mark.usefixtures("unchecked")
def test_an_earlier_package_is_replaced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    target = tmp_path / "package"
    target.mkdir()  # empty: may be there
    build_package(THESIS, target)
    monkeypatch.setattr(package, "_contents", lambda _: iter([("other.txt", b"new")]))
    build_package(THESIS, target)
    assert set(contents(target)) == {"other.txt", "assembly.html", "manifest.json"}
    assert [path.name for path in tmp_path.iterdir()] == ["package"]


def foreign(target: Path) -> None:
    shutil.rmtree(target)
    target.mkdir()
    (target / "thesis.pdf").write_text("mine")


def forged(target: Path) -> None:
    (target / "manifest.json").write_text("[]")


def noted(target: Path) -> None:
    (target / "notes.txt").write_text("mine")


def edited(target: Path) -> None:
    (target / "bill" / "bill.md").write_text("cheaper")


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("change", "message"),
    [
        (foreign, "no earlier package"),
        (forged, "no earlier package"),
        (noted, r"notes\.txt is not of the package"),
        (edited, r"bill/bill\.md was changed"),
    ],
)
def test_nothing_of_others_is_lost(
    tmp_path: Path, change: Callable[[Path], None], message: str
) -> None:
    target = build_package(THESIS, tmp_path / "package").folder
    change(target)
    before = contents(tmp_path)
    with pytest.raises(FileExistsError, match=message):
        build_package(THESIS, target)
    assert contents(tmp_path) == before


def test_folders_that_cannot_be(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_text("mine")
    with pytest.raises(NotADirectoryError, match="it is a file"):
        build_package(THESIS, tmp_path / "file")
    with pytest.raises(FileNotFoundError, match="there is no folder"):
        build_package(THESIS, tmp_path / "no" / "package")
    monkeypatch.setattr(os, "access", lambda *_: False)  # root may write anywhere
    with pytest.raises(PermissionError, match="cannot be written to"):
        build_package(THESIS, tmp_path / "package")
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("earlier", [False, True])
@pytest.mark.parametrize("where", ["while it is written", "at the very end"])
def test_an_error_leaves_the_folder_as_it_was(
    where: str, earlier: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    target = tmp_path / "package"
    if earlier:
        build_package(THESIS, target)
    before = contents(tmp_path)
    rename = Path.rename

    def full(*_: object) -> str:
        raise KeyboardInterrupt

    def once(path: Path, to: Path) -> Path:
        if path.name == "new":
            raise OSError("the disk is gone")
        return rename(path, to)

    if where == "at the very end":
        monkeypatch.setattr(Path, "rename", once)
    else:
        monkeypatch.setattr(instructions, "page", full)
    with pytest.raises((KeyboardInterrupt, OSError)):
        build_package(THESIS, target)
    assert contents(tmp_path) == before
    assert [path.name for path in tmp_path.iterdir()] == ["package"] * earlier
