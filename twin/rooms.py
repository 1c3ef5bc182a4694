"""A room is a file: LEDs, the tracker and its way, light, walls, who stands between, the head.

Lengths are in mm, angles in rad, times in s. A file is TOML::

    format = "linetrack room"
    version = 1
    name = "two LEDs and a walk"
    head = "slit-4mm"           # one of the designs, or a design file beside this one
    seed = 1304                 # of the sensor specimen, its noise, and where LEDs really are
    ambient = 100.0             # lx on the pixels

    [tracker]
    path = "line"
    start = [-500.0, 2000.0]
    end = [500.0, 2000.0]
    speed = 1000.0
    heading = { amplitude = 0.2, frequency = 0.1 }

    [every_led]                 # what the entries below do not say
    power = 1.0

    [[led]]
    channel = 0
    position = [-250.0, 0.0, 0.0]

    [[led]]
    channel = 1
    position = [250.0, 0.0, 0.0]

Besides there may be ``notes``, ``placement_error`` (mm), ``[mount]`` (``roll``, ``offset``),
``[[wall]]`` (``start``, ``end``, ``reflectivity``), ``[[occlusion]]`` (``begin``, ``end``,
``channels``) or ``[random_occlusions]`` (``share``, ``duration``). Keys mean what the arguments of
`World`, `Led`, `Wall`, `Occlusion` and so on mean. ``path`` is one of

=========  =====================================================================================
fixed      ``position``
line       ``start``, ``end``, ``speed``: to and fro, fastest in the middle
circle     ``centre``, ``radius``, ``speed``: counter-clockwise seen from above
lissajous  ``centre``, ``amplitude``, ``frequency``, maybe ``phase``: one of each for x, y and z
waypoints  ``times``, ``points``: through these smoothly, at rest before the first and after the last
=========  =====================================================================================

with points of two or three coordinates, and ``heading``, ``pitch`` and ``roll``: numbers, or tables
``{ mean, amplitude, frequency, phase }`` of a sine. `ROOMS` names the rooms of the package.
"""

from __future__ import annotations

import math
import tomllib
from dataclasses import dataclass, replace
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Self

import numpy as np

from raytransfer import _checks as check
from raytransfer.designs import Table, find_design
from twin.world import STRAIGHT, Led, Mount, Occlusion, Pose, RandomOcclusions, Wall, World

if TYPE_CHECKING:
    import os
    from collections.abc import Callable, Sequence
    from collections.abc import Set as AbstractSet

    from numpy.typing import NDArray

    from twin.world import Trajectory

FORMAT = "linetrack room"
"""What a room file says it is."""

VERSION = 1
"""Of the format, the only one so far."""

_FOLDER = files("twin") / "data"

ROOMS = tuple(
    sorted(f.name.removesuffix(".toml") for f in _FOLDER.iterdir() if f.name.endswith(".toml"))
)
"""Rooms of the package."""


class KnownLeds(NamedTuple):
    """Where a tracker is told that LEDs are.

    Attributes
    ----------
    channels : tuple of int
    positions : ndarray, shape (N, 3)
        mm.
    facings : ndarray, shape (N,)
        rad.
    """

    channels: tuple[int, ...]
    positions: NDArray[np.float64]
    facings: NDArray[np.float64]

    @classmethod
    def of(cls, leds: Sequence[Led]) -> Self:
        """Of these LEDs, as ``LedMap(*…)`` takes it."""
        return cls(
            tuple(led.channel for led in leds),
            np.array([led.position for led in leds], dtype=float).reshape(-1, 3),
            np.array([led.facing for led in leds], dtype=float),
        )


@dataclass(frozen=True)
class Room:
    """What a room file holds.

    Parameters
    ----------
    name : str
    nominal : sequence of Led
        LEDs where the file has them.
    world : World
        With the LEDs where they really are.
    seed : int
        Of the sensor, too: `TwinLink`'s.
    notes : str
    """

    name: str
    nominal: Sequence[Led]
    world: World
    seed: int = 1304
    notes: str = ""

    def known_leds(self) -> KnownLeds:
        """Where a tracker is told that the LEDs are."""
        return KnownLeds.of(self.nominal)


def load_room(room: str | os.PathLike[str]) -> Room:
    """Read a room file.

    Parameters
    ----------
    room : str or path-like
        The file, or one of `ROOMS`.

    Raises
    ------
    ValueError
        If it is no room file, of an unknown version, names what is unknown, lacks a key or has one
        too many, or a number is out of its range. The message begins with the path and says where.
    OSError
        If it cannot be read.
    """
    file = _FOLDER / f"{room}.toml" if room in ROOMS else Path(room)
    data = file.read_bytes()
    try:
        return _room(tomllib.loads(data.decode("utf-8")), Path(str(file)).parent)
    except tomllib.TOMLDecodeError as error:
        raise ValueError(f"{file}: no room file, which is TOML ({error})") from error
    except (ValueError, TypeError) as error:
        raise ValueError(f"{file}: {error}") from error


@dataclass(frozen=True)
class Swing:
    """A number that swings: mean + amplitude · sin(2π frequency · t + phase)."""

    mean: float = 0.0
    amplitude: float = 0.0
    frequency: float = 0.0
    phase: float = 0.0

    def __call__(self, seconds: float) -> float:
        """Return the number at a time in s."""
        return self.mean + self.amplitude * math.sin(
            2 * math.pi * self.frequency * seconds + self.phase
        )


STILL = Swing()


@dataclass(frozen=True)
class Tour:
    """A trajectory: a way through the room and how the tracker turns on it.

    Parameters
    ----------
    path : callable
        From seconds to room x, y and z, mm.
    heading, pitch, roll : Swing
        rad.
    """

    path: Callable[[float], tuple[float, float, float]]
    heading: Swing = STILL
    pitch: Swing = STILL
    roll: Swing = STILL

    def __call__(self, seconds: float) -> Pose:
        """Return the pose at a time in s."""
        x, y, z = self.path(seconds)
        return Pose(x, y, self.heading(seconds), z, self.pitch(seconds), self.roll(seconds))


def line(
    start: Sequence[float], end: Sequence[float], speed: float
) -> Callable[[float], tuple[float, float, float]]:
    """To and fro between two points, as a sine: fastest (`speed`, mm/s) in the middle."""
    first, last = _point("start", start), _point("end", end)
    length = float(np.linalg.norm(last - first))
    if length == 0:
        raise ValueError(f"a line from {list(start)} to itself: its ends must differ")
    rate = 2 * check.positive("speed", speed, "mm/s") / length

    def path(seconds: float) -> tuple[float, float, float]:
        x, y, z = (first + (last - first) * ((1 - math.cos(rate * seconds)) / 2)).tolist()
        return x, y, z

    return path


def circle(
    centre: Sequence[float], radius: float, speed: float
) -> Callable[[float], tuple[float, float, float]]:
    """Round a centre, counter-clockwise seen from above, from +x on; `speed` in mm/s."""
    x, y, z = _point("centre", centre).tolist()
    radius = check.positive("radius", radius, "mm")
    rate = check.positive("speed", speed, "mm/s") / radius

    def path(seconds: float) -> tuple[float, float, float]:
        turn = rate * seconds
        return x + radius * math.cos(turn), y + radius * math.sin(turn), z

    return path


def lissajous(
    centre: Sequence[float],
    amplitude: Sequence[float],
    frequency: Sequence[float],
    phase: Sequence[float] = (0.0, 0.0, 0.0),
) -> Callable[[float], tuple[float, float, float]]:
    """Every coordinate swings on its own; mm, Hz and rad."""
    parts = (centre, amplitude, frequency, phase)
    names = ("centre", "amplitude", "frequency", "phase")
    columns = np.stack([_point(name, part) for name, part in zip(names, parts, strict=True)])
    swings = [Swing(*column) for column in columns.T.tolist()]

    def path(seconds: float) -> tuple[float, float, float]:
        x, y, z = (swing(seconds) for swing in swings)
        return x, y, z

    return path


def waypoints(
    times: Sequence[float], points: Sequence[Sequence[float]]
) -> Callable[[float], tuple[float, float, float]]:
    """Through points at given times by a cubic spline that begins and ends at rest."""
    from scipy.interpolate import CubicSpline  # type: ignore[import-untyped]

    if len(times) != len(points) or len(times) < 2:
        raise ValueError(
            f"{len(times)} times and {len(points)} points: as many of both are needed, 2 or more"
        )
    at = check.array("times", times)
    if (np.diff(at) <= 0).any():
        raise ValueError(f"times = {list(times)}: each must be later than the one before")
    spline = CubicSpline(at, [_point("points", point) for point in points], bc_type="clamped")

    def path(seconds: float) -> tuple[float, float, float]:
        x, y, z = spline(min(max(seconds, at[0]), at[-1])).tolist()
        return x, y, z

    return path


def _point(name: str, values: Sequence[float]) -> NDArray[np.float64]:
    """Three coordinates; z may be left out."""
    point = check.array(name, values, "mm")
    if point.shape not in ((2,), (3,)):
        raise ValueError(f"{name} = {list(values)}: two or three coordinates are needed")
    return point if len(point) == 3 else np.append(point, 0.0)


PATHS: dict[str, tuple[Callable[..., Any], set[str], set[str]]] = {
    "line": (line, {"start", "end", "speed"}, set()),
    "circle": (circle, {"centre", "radius", "speed"}, set()),
    "lissajous": (lissajous, {"centre", "amplitude", "frequency"}, {"phase"}),
    "waypoints": (waypoints, {"times", "points"}, set()),
}
"""Ways through the room by name: what makes them, keys needed, keys allowed."""

_TURNS = ("heading", "pitch", "roll")


def _room(data: dict[str, Any], folder: Path) -> Room:
    if data.get("format") != FORMAT:
        raise ValueError(f"this is no room file: it does not begin with format = {FORMAT!r}")
    version = data.get("version")
    if version != VERSION or isinstance(version, bool):
        raise ValueError(
            f"version = {version!r}: this program reads version {VERSION}; "
            "was the file written by a later one?"
        )
    table = Table("", data)
    table.of({"format", "version", "name", "head", "tracker", "led"})
    table.and_maybe(
        {"notes", "seed", "ambient", "placement_error", "every_led", "mount", "wall"}
        | {"occlusion", "random_occlusions"}
    )
    seed = table.get("seed", int) if "seed" in data else 1304
    if seed < 0 or isinstance(seed, bool):
        raise ValueError(f"seed = {seed!r}: allowed are whole numbers from 0 on")
    try:
        design = find_design(table.get("head", str), folder)
    except LookupError as unknown:
        raise ValueError(f"head = {unknown} (in {folder})") from unknown
    nominal = _leds(table)
    error = table.number("placement_error") if "placement_error" in data else 0.0
    world = World(
        leds=_placed(nominal, check.not_negative("placement_error", error, "mm"), seed),
        tracker=_tracker(Table("tracker, ", data["tracker"])),
        ambient=table.number("ambient") if "ambient" in data else 0.0,
        head=design.system,
        sensor=design.sensor,
        mount=_mount(table),
        walls=[
            _made(Wall, entry, {"start", "end", "reflectivity"}) for entry in _all(table, "wall")
        ],
        occlusions=_occlusions(table, seed),
    )
    notes = table.get("notes", str) if "notes" in data else ""
    return Room(table.get("name", str), nominal, world, seed, notes)


def _all(table: Table, key: str) -> list[Table]:
    entries = table.get(key, list) if key in table.data else []
    return [Table(f"{key} {number}, ", entry) for number, entry in enumerate(entries, start=1)]


def _made(
    make: Callable[..., Any],
    table: Table,
    needed: set[str],
    more: AbstractSet[str] = frozenset(),
) -> Any:
    """What a table describes, its keys being arguments; errors say which table."""
    table.of(needed)
    table.and_maybe(set(more))
    arguments = {k: tuple(v) if isinstance(v, list) else v for k, v in table.data.items()}
    try:
        return make(**arguments)
    except (ValueError, TypeError) as error:
        raise ValueError(f"{table.where}{error}") from error


def _leds(table: Table) -> list[Led]:
    common = {"power", "wavelength", "facing", "extent"}
    every = table.inner("every_led")
    if every is not None:
        every.of(set())
        every.and_maybe(common)
    leds = []
    for entry in _all(table, "led"):
        entry.data = {**(every.data if every else {}), **entry.data}
        leds.append(_made(Led, entry, {"channel", "position"}, common))
    return leds


def _placed(leds: Sequence[Led], error: float, seed: int) -> list[Led]:
    """LEDs where they really are: off by a normal error in each coordinate."""
    off = np.random.default_rng([seed, len(leds)]).normal(0.0, 1.0, (len(leds), 3)) * error
    return [
        replace(led, position=tuple((np.array(led.position) + by).tolist())) if error else led
        for led, by in zip(leds, off, strict=True)
    ]


def _tracker(table: Table) -> Pose | Trajectory:
    known = ("fixed", *PATHS)
    kind = table.data.get("path")
    if kind not in known:
        raise ValueError(f"{table.where}path = {kind!r}: known are {', '.join(known)}")
    turns = {name: _swing(table, name) for name in _TURNS}
    if kind == "fixed":
        table.of({"path", "position"})
        table.and_maybe(set(_TURNS))
        position = _point(f"{table.where}position", table.get("position", list)).tolist()
        still = Tour(lambda _: (position[0], position[1], position[2]), **turns)
        return still if any(turn.amplitude for turn in turns.values()) else still(0.0)
    make, needed, more = PATHS[kind]
    way = Table(table.where, {k: v for k, v in table.data.items() if k not in ("path", *_TURNS)})
    return Tour(_made(make, way, needed, more), **turns)


def _swing(table: Table, name: str) -> Swing:
    value = table.data.get(name, 0.0)
    if not isinstance(value, dict):
        return Swing(check.number(f"{table.where}{name}", value, "rad"))
    entry = Table(f"{table.where}{name}, ", value)
    entry.of({"amplitude", "frequency"})
    entry.and_maybe({"mean", "phase"})
    return Swing(**{key: entry.number(key) for key in value})


def _mount(table: Table) -> Mount:
    mount = table.inner("mount")
    made: Mount = STRAIGHT if mount is None else _made(Mount, mount, set(), {"roll", "offset"})
    return made


def _occlusions(table: Table, seed: int) -> list[Occlusion] | RandomOcclusions:
    chance = table.inner("random_occlusions")
    if chance is None:
        entries = _all(table, "occlusion")
        return [_made(Occlusion, entry, {"begin", "end"}, {"channels"}) for entry in entries]
    if "occlusion" in table.data:
        raise ValueError("occlusion and random_occlusions: give one of them")
    chance.data = {**chance.data, "seed": seed}
    made: RandomOcclusions = _made(RandomOcclusions, chance, {"share", "seed"}, {"duration"})
    return made
