"""The build package: everything that making a head takes, in one folder.

`build_package` lays out mount, stand and boards of a lens system, checks them, and writes what a
printer, a board maker and a person at a bench need. What a check finds stops it, and nothing is
written. The same head gives the same bytes.
"""

from __future__ import annotations

import errno
import hashlib
import itertools
import json
import os
import re
import shutil
import tempfile
import zipfile
from collections import Counter
from dataclasses import dataclass, replace
from decimal import Decimal
from functools import cached_property
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from acquisition import wiring
from hardware import circuits, kicad
from hardware.bill import Bill, Line, board_bill, head_bill, led_bill, summary
from hardware.boards import BOARDS
from hardware.checks import check_led_mount, check_mount, check_stand
from hardware.committed import check_committed
from hardware.electrical import check_board
from hardware.findings import Finding
from hardware.mesh import bounds, mesh, stl, volume
from hardware.mount import lens_mount, mechanics
from hardware.solids import Placed
from hardware.stand import led_mount, stand
from raytransfer.designs import Design, design_text
from raytransfer.sensors import TCD1304, LineSensor

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence

    from hardware.boards import Board
    from hardware.circuits import Measurement
    from hardware.mount import LensMount
    from hardware.solids import Axis, Solid
    from hardware.stand import LedMount, Stand
    from raytransfer.systems import OpticalSystem

VARIANTS: Final = ("improved", "thesis")
"""Of the boards: without the hazards of the thesis's, or as the thesis has them."""

FORMAT: Final = "linetrack build package"
"""What a manifest says it is of."""

MANIFEST: Final = "manifest.json"
PAGE: Final = "assembly.html"

LEDS: Final = len(
    {pin.net for pin in wiring.WIRING.leds.gpio}
    & {net for plug in wiring.WIRING.connectors if plug.table for net, _ in plug.wires}
)
"""LEDs of the prototype: those that the thesis's tables have wires for."""

_BOARDS: Final = ("tcd1304", "led-driver")
_EPOCH: Final = (1980, 1, 1, 0, 0, 0)  # of files in archives: the first that zip knows
_TURNS: Final[tuple[tuple[Axis, int], ...]] = (
    ("x", 0), ("x", 1), ("x", 2), ("x", 3), ("y", 1), ("y", 3),
)  # fmt: skip


class Fault(NamedTuple):
    """What a check found.

    Parameters
    ----------
    part : str
        What was checked: ``lens mount``, or the title of a board.
    finding : Finding
    """

    part: str
    finding: Finding

    def __str__(self) -> str:
        """One line for a person."""
        return f"{self.part}: {self.finding}"


class FaultsError(ValueError):
    """Checks found faults, so that nothing was written.

    Parameters
    ----------
    faults : sequence of Fault
    """

    def __init__(self, faults: Sequence[Fault]) -> None:
        self.faults = tuple(faults)
        count = f"{len(faults)} fault{'' if len(faults) == 1 else 's'}"
        super().__init__("\n".join([f"{count}, nothing was written", *map(str, faults)]))


class PrintedPart(NamedTuple):
    """A part for the printer.

    Parameters
    ----------
    name : str
    solid : Solid
        As it is printed: z up, from the bed at 0.
    amount : int
    """

    name: str
    solid: Solid
    amount: int

    @property
    def path(self) -> str:
        """Of its file in the package."""
        return f"print/{self.name.replace(' ', '-').lower()}.stl"


@dataclass(frozen=True)
class Plan:
    """All that a package is made from.

    Parameters
    ----------
    design : Design
    variant : str
        One of `VARIANTS`.
    mount : LensMount
    stand : Stand
    led : LedMount
    boards : tuple of Board
        The sensor's, and that of the LEDs.
    measurements : mapping of str to list of Measurement, or None
        By name of the board, as built; None without ngspice.
    hazards : tuple of Fault
        What the boards do beyond a part's limits, as the variant's boards are known to.
    """

    design: Design
    variant: str
    mount: LensMount
    stand: Stand
    led: LedMount
    boards: tuple[Board, ...]
    measurements: Mapping[str, Sequence[Measurement]] | None
    hazards: tuple[Fault, ...]

    @cached_property
    def printed(self) -> tuple[PrintedPart, ...]:
        """Every part that is printed."""
        halves = self.mount.printed().items()
        return (
            *(PrintedPart(f"lens mount {half}", _on_bed(solid), 1) for half, solid in halves),
            *(PrintedPart(name, _lying(part), 1) for name, part in self.stand.parts.items()),
            PrintedPart("LED mount", _lying(self.led.solid), LEDS),
        )

    @property
    def bills(self) -> dict[str, Bill]:
        """Bills of materials, by the names of their files."""
        head = head_bill(self.design.system)
        # on the stand, those with a length
        head = replace(head, lines=tuple(line for line in head.lines if line.type != "M3 screw"))
        return {
            "lens-head": head,
            **{board.name: board_bill(board) for board in self.boards},
            "leds": led_bill(LEDS),
            "stand": Bill(
                "Stand, computers and what joins them",
                tuple(Line(name, amount) for name, amount in self._joining().items()),
            ),
        }

    def _joining(self) -> dict[str, int]:
        pins = mechanics()["package"][self.design.sensor.name]["pins_in_a_row"]
        screws = Counter({self.mount_screw: len(self.mount.screws)})
        screws[self.board_screw] += sum(len(board.holes) for board in self.stand.boards)
        screws[self.foot_screw] += len(self.stand.foot_screws)
        return {
            "Raspberry Pi": 1,
            f"Nucleo board with {wiring.WIRING.mcu.part}": 1,
            f"supply of the LEDs, {self.led_supply:g} V": 1,
            f"socket strip, {pins} pins, for the sensor": 2,
            "jumper wire": sum(len(plug.wires) for plug in wiring.WIRING.connectors if plug.table),
            **screws,
            f"{self.clamp_screw}, clamps the LED mount": LEDS,
            "M3 nut": LEDS,
            "M3 screw for LED and heat sink": LEDS * len(self.led.screws),
        }

    @property
    def board_screw(self) -> str:
        """Screw that holds a board on the stand."""
        through = mechanics()["sensor_board"]["thickness"]
        return _screw("M2.5", through, self.stand.rules["core_depth"])

    @property
    def foot_screw(self) -> str:
        """Screw between base and feet."""
        return _screw("M2.5", self.stand.rules["plate"], self.stand.rules["core_depth"])

    @property
    def clamp_screw(self) -> str:
        """Screw that closes the LED's mount around its pole, with a nut."""
        rules = self.led.rules
        return _bolt(2 * rules["ear"][0] + rules["slit"])

    @property
    def mount_screw(self) -> str:
        """Screw through both halves and the stand, with two washers and a nut."""
        washers = 2 * mechanics()["screws"]["washer"]
        return _bolt(self.mount.size[1] + self.stand.rules["plate"] + washers)

    @property
    def led_supply(self) -> float:
        """V that the LEDs' board wants."""
        return max(self.boards[-1].supplies.values())

    def figures(self) -> dict[str, Any]:
        """Return the sizes and sums that a manifest has; lengths in mm, prices in euro."""
        return {
            "mount_size_mm": [round(side, 4) for side in self.mount.size],
            "lens_heights_above_cover_mm": {
                name: round(height, 4) for name, height in self.mount.heights().items()
            },
            "printed_volume_mm3": {
                part.name: round(volume(part.solid), 1) for part in self.printed
            },
            "led_supply_volt": self.led_supply,
            "leds": LEDS,
            "priced_total_euro": str(sum((bill.total for bill in self.bills.values()), Decimal(0))),
        }

    def left_out(self) -> tuple[str, ...]:
        """Say what could not be done here, and what to install for it."""
        missing = []
        if not _has_cad():
            missing.append(
                "STEP files and drawings: build123d is not installed, pip install linetrack[cad]"
            )
        if self.measurements is None:
            missing.append("circuit simulation: ngspice is not installed, apt install ngspice")
        return tuple(missing)


@dataclass(frozen=True)
class Package:
    """A package that was written.

    Parameters
    ----------
    folder : Path
    plan : Plan
        What it was made from.
    manifest : mapping
        As in its ``manifest.json``.
    """

    folder: Path
    plan: Plan
    manifest: Mapping[str, Any]

    @property
    def page(self) -> Path:
        """The instructions, a web page that needs nothing else."""
        return self.folder / PAGE


def build_package(
    system: OpticalSystem,
    folder: str | os.PathLike[str],
    *,
    sensor: LineSensor = TCD1304,
    variant: str = "improved",
    notes: str = "",
) -> Package:
    """Check a head and write all that making it takes.

    Parameters
    ----------
    system : OpticalSystem
        As `hardware.mount.lens_mount` takes it.
    folder : str or path-like
        Made by this; its parent is there. If it is an earlier package, it is replaced once the new
        one is complete.
    sensor : LineSensor
    variant : {"improved", "thesis"}
        Which boards. The thesis's have known hazards, which the package lists.
    notes : str
        Of the design.

    Returns
    -------
    Package

    Raises
    ------
    FaultsError
        If a check found a fault; nothing is written.
    ValueError
        If no mount can be made of the system, or there is no such variant.
    OSError
        If the folder cannot be made, or has anything but an unchanged earlier package in it.
    ModuleNotFoundError
        If manifold3d or trimesh is not installed.
    """
    target = Path(folder).resolve()
    _check_target(target)
    plan = make_plan(system, sensor=sensor, variant=variant, notes=notes)
    prefix = f".{target.name}-"
    try:
        staging = Path(tempfile.mkdtemp(dir=target.parent, prefix=prefix, suffix=".part"))
    except OSError as error:  # it names the temporary folder
        raise OSError(error.errno, error.strerror, str(target)) from error
    new, old = staging / "new", staging / "old"
    try:
        new.mkdir()
        manifest = _write(plan, new)
        _check_target(target)  # it took a while
        if target.exists():
            target.rename(old)
        new.rename(target)
    finally:
        if old.exists() and not target.exists():
            old.rename(target)
        shutil.rmtree(staging, ignore_errors=True)
    return Package(target, plan, manifest)


def make_plan(
    system: OpticalSystem,
    *,
    sensor: LineSensor = TCD1304,
    variant: str = "improved",
    notes: str = "",
) -> Plan:
    """Lay out and check all that a package holds, and write nothing.

    Parameters
    ----------
    system, sensor, variant, notes
        As for `build_package`.

    Returns
    -------
    Plan

    Raises
    ------
    FaultsError, ValueError, ModuleNotFoundError
        As `build_package`.
    """
    if variant not in VARIANTS:
        raise ValueError(f"variant {variant!r}: allowed are {' and '.join(VARIANTS)}")
    mount = lens_mount(system, sensor)
    design = Design(system, sensor, notes)
    around, led = stand(mount), led_mount()
    suffix = "" if variant == "thesis" else f"-{variant}"
    boards = tuple(BOARDS[f"{name}{suffix}"] for name in _BOARDS)
    found = [Fault("lens mount", finding) for finding in check_mount(mount)]
    found += [Fault("stand", finding) for finding in check_stand(around)]
    found += [Fault("LED mount", finding) for finding in check_led_mount(led)]
    plan = Plan(design, variant, mount, around, led, boards, None, ())
    found += _check_sizes(plan.printed)
    for board in boards:
        found += [
            Fault(board.title, finding)
            for finding in (*check_board(board), *check_committed(board))
        ]
    faults = [fault for fault in found if not _known(fault, boards)]
    measurements: dict[str, Sequence[Measurement]] | None = None
    try:
        if not faults:  # a board that is wrong need not be one that can be simulated
            for board in boards:
                found += [Fault(board.title, finding) for finding in circuits.check_circuits(board)]
            measurements = {board.name: circuits.measure(board) for board in boards}
    except circuits.NoSimulatorError:
        pass  # Plan.left_out says so
    faults = [fault for fault in found if not _known(fault, boards)]
    if faults:
        raise FaultsError(faults)
    return replace(plan, measurements=measurements, hazards=tuple(found))


def _check_sizes(parts: Iterable[PrintedPart]) -> Iterator[Fault]:
    bed = mechanics()["printer"]["size"]
    for part in parts:
        low, high = bounds(part.solid)
        size = high - low
        if (size > bed).any():
            words = " × ".join(f"{side:.0f}" for side in size)
            room = " × ".join(f"{side:g}" for side in bed)
            finding = Finding("printer", "size", f"{words} mm; {room} mm can be printed")
            yield Fault(part.name, finding)


def _known(fault: Fault, boards: Sequence[Board]) -> bool:
    """Whether it is a hazard of a board of which another variant is free."""
    named = [board for board in boards if board.title == fault.part]
    return fault.finding.hazard and any(
        change.removes == fault.finding.check
        for board in named
        for other in BOARDS.values()
        if other.base == board.name
        for change in other.changes
    )


# --- the folder -----------------------------------------------------------------------------------


def _check_target(target: Path) -> None:
    """Refuse a folder that cannot be made or replaced without loss."""
    parent = target.parent
    if not parent.is_dir():
        raise FileNotFoundError(errno.ENOENT, f"there is no folder {parent}; make it", str(target))
    if not os.access(parent, os.W_OK | os.X_OK):
        raise PermissionError(errno.EACCES, f"{parent} cannot be written to", str(target))
    if not target.exists():
        return
    if not target.is_dir():
        raise NotADirectoryError(errno.ENOTDIR, "it is a file; name a new folder", str(target))
    there = _files(target)
    if not there:
        return
    listed = _listed(target / MANIFEST)
    if listed is None:
        raise FileExistsError(
            errno.EEXIST, "it is no earlier package and not empty; name a new folder", str(target)
        )
    for name in there:
        if name == MANIFEST:
            continue
        same = name in listed and listed[name] == _digest((target / name).read_bytes())
        if not same:
            what = "was changed since it was written" if name in listed else "is not of the package"
            raise FileExistsError(errno.EEXIST, f"{name} {what}; move it away", str(target))


def _listed(manifest: Path) -> dict[str, str] | None:
    """Return what an earlier package's manifest lists, or None if it is none."""
    try:
        data = json.loads(manifest.read_text(encoding="utf-8"))
        if data["format"] != FORMAT:
            return None
        return {entry["path"]: entry["sha256"] for entry in data["files"]}
    except (OSError, ValueError, TypeError, KeyError):
        return None


def _files(folder: Path) -> list[str]:
    """Return the paths of all files (and links) in a folder, from there on."""
    return sorted(
        path.relative_to(folder).as_posix()
        for path in folder.rglob("*")
        if path.is_symlink() or not path.is_dir()
    )


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def _write(plan: Plan, folder: Path) -> dict[str, Any]:
    """Write everything; return the manifest."""
    from hardware.instructions import page

    for name, content in _contents(plan):
        path = folder / name
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(content)
    if _has_cad():
        _write_cad(plan, folder / "cad")
    (folder / PAGE).write_text(page(plan, _files(folder)), encoding="utf-8", newline="\n")
    manifest = _manifest(plan, folder)
    text = json.dumps(manifest, indent=2, ensure_ascii=False) + "\n"
    (folder / MANIFEST).write_text(text, encoding="utf-8", newline="\n")
    return manifest


def _contents(plan: Plan) -> Iterator[tuple[str, bytes]]:
    for part in plan.printed:
        yield part.path, stl(mesh(part.solid))
    for board in plan.boards:
        project = kicad.COMMITTED / board.name
        yield f"boards/{board.name}-gerbers.zip", _zip(project / "gerbers")
        yield f"boards/{board.name}-schematic.pdf", (project / f"{board.name}.pdf").read_bytes()
    for name, bill in plan.bills.items():
        yield f"bill/{name}.csv", bill.csv().encode()
    yield "bill/bill.md", summary(plan.bills.values()).encode()
    yield "wiring/wiring.md", wiring.markdown().encode()
    yield "wiring/wiring.h", wiring.c_header().encode()
    yield "wiring/firmware.md", firmware_note().encode()
    yield "design.toml", design_text(plan.design).encode()


def _zip(folder: Path) -> bytes:
    """Return all files of a folder as an archive without dates."""
    with tempfile.SpooledTemporaryFile() as file:
        with zipfile.ZipFile(file, "w") as archive:
            for name in _files(folder):
                entry = zipfile.ZipInfo(name, _EPOCH)
                entry.compress_type = zipfile.ZIP_DEFLATED
                entry.external_attr = 0o644 << 16
                entry.create_system = 3
                archive.writestr(entry, (folder / name).read_bytes())
        file.seek(0)
        return file.read()


def firmware_note() -> str:
    """Return how the firmware comes onto the board, in Markdown."""
    mcu = wiring.WIRING.mcu
    return f"""\
# Firmware

The {mcu.part} runs linetrack's firmware. `wiring.h`, beside this file, has the pins and constants it
is compiled with; they are those of the wiring table. Another `wiring.h` is another wiring.

1. Take `F401_FW_TCD1304.bin`: a wheel of linetrack has it in its folder `twin`, and in a checkout
   `make setup` compiles `firmware/build/F401_FW_TCD1304.bin`.
2. Plug the Nucleo board into a computer. It shows itself as a drive; copy the file there. In a
   checkout `make flash` does the same.
3. On the Raspberry Pi switch SPI on (`dtparam=spi=on`), then run `linetrack capture -n 2`. A line
   that is all 0 or all 65535 means a wrong or loose wire; a saturated one means room light.

It has run in a simulator of the microcontroller, not yet on a board.
"""


# --- solids ---------------------------------------------------------------------------------------


def _on_bed(solid: Solid) -> Placed:
    return Placed(solid, (0.0, 0.0, -float(bounds(solid)[0, 2])))


def _lying(solid: Solid) -> Placed:
    """Turn a part so that as little as can be hangs in the air while it is printed."""
    turned = [Placed(solid, axis=axis, quarters=quarters) for axis, quarters in _TURNS]
    return _on_bed(min(turned, key=lambda solid: round(overhang(solid))))


def overhang(solid: Solid) -> float:
    """Area that faces down by more than 45° and is not on the bed, mm²; z is up."""
    surface = mesh(solid)
    low = surface.bounds[0, 2]
    on_bed = surface.triangles[:, :, 2].max(axis=1) < low + 1e-3
    down = surface.face_normals[:, 2] < -0.7072
    return float(surface.area_faces[down & ~on_bed].sum())


def _screw(thread: str, through: float, core: float) -> str:
    """Name the longest screw that goes through a thing into a core hole without meeting its end."""
    lengths = mechanics()["screws"]["lengths"]
    return f"{thread} x {max(length for length in lengths if length < through + core)} screw"


def _bolt(through: float) -> str:
    """Name the shortest M3 screw that goes through a thing and its nut."""
    screws = mechanics()["screws"]
    needed = through + screws["nut"]
    length = next((length for length in screws["lengths"] if length >= needed), None)
    if length is None:
        raise ValueError(f"no M3 screw of {needed:.0f} mm is sold: the lenses are too high")
    return f"M3 x {length} screw"


def _has_cad() -> bool:
    return find_spec("build123d") is not None


def _write_cad(plan: Plan, folder: Path) -> None:
    from hardware import brep

    folder.mkdir()
    bodies: dict[str, Mapping[str, Solid]] = {
        "lens-mount": plan.mount.halves,
        "stand": plan.stand.parts,
        "led-mount": {"LED mount": plan.led.solid},
    }
    for name, parts in bodies.items():
        path = brep.write_step(parts, folder / f"{name}.step")
        path.write_text(_undated(path.read_text()), newline="\n")
        brep.write_drawing(parts, folder / f"{name}.svg")


def _undated(step: str) -> str:
    """Return a STEP file without its date, and with its parts counted from 1.

    OpenCASCADE counts them over all files that a process writes, and breaks lines by the length.
    """
    text, dates = re.subn(r"(FILE_NAME\('[^']*',)'[^']*'", r"\1'2000-01-01T00:00:00'", step)
    if dates != 1:
        raise RuntimeError(f"{dates} dates in the header of a STEP file, not one")
    numbers = itertools.count(1)

    def numbered(use: re.Match[str]) -> str:
        rest = re.sub(r"\n *", "", use[2])
        return f"{use[1]}'{next(numbers)}'{rest}"

    return re.sub(r"(NEXT_ASSEMBLY_USAGE_OCCURRENCE\()\s*'\d+'([^;]*;)", numbered, text)


# --- the manifest ---------------------------------------------------------------------------------


def _manifest(plan: Plan, folder: Path) -> dict[str, Any]:
    tools = ("linetrack", "manifold3d", "trimesh", "build123d")
    return {
        "format": FORMAT,
        "version": 1,
        "head": plan.design.system.name,
        "sensor": plan.design.sensor.name,
        "variant": plan.variant,
        "boards": [board.name for board in plan.boards],
        "made_with": {tool: _version(tool) for tool in tools},
        "fabricated": False,
        "simulated_circuits": plan.measurements is not None,
        "left_out": list(plan.left_out()),
        "figures": plan.figures(),
        "hazards": [{"board": fault.part, **fault.finding._asdict()} for fault in plan.hazards],
        "files": [
            {"path": name, "size": len(content), "sha256": _digest(content)}
            for name in _files(folder)
            for content in [(folder / name).read_bytes()]
        ],
    }


def _version(tool: str) -> str | None:
    try:
        return version(tool)
    except PackageNotFoundError:
        return None
