"""The lens mount of any head: two halves, clamped around the lenses, that carry the sensor's board.

Frame: that of the `OpticalSystem`, Z with the light from the first vertex, X along the pixel line,
Y up. The halves part at y = 0, and every lens goes into its half along y. A lens is held by a pocket
that follows its outer box, and by ledges at the four corners of its front and back, where no light
is used.
"""

from __future__ import annotations

import math
import tomllib
from dataclasses import dataclass
from importlib.resources import files
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from hardware.solids import (
    Box,
    Cylinder,
    Difference,
    Intersection,
    Lathe,
    Placed,
    Prism,
    Union,
    arc,
    block,
    frustum,
)
from raytransfer.lenses import Aperture, Lens, Plate, SphericalLens
from raytransfer.sensors import TCD1304, LineSensor
from raytransfer.systems import NOMINAL, OpticalSystem

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from hardware.solids import Solid

SKIN = 0.01
"""How far cuts that meet reach into each other, mm: nothing thinner stays between them."""


@dataclass(frozen=True)
class Board:
    """The sensor's board with the sensor on it, as far as the mount has to know.

    Parameters
    ----------
    size : tuple of float
        Of its outline along X and Y, mm.
    thickness : float
        mm.
    holes : tuple of tuple of float
        Middles of its holes, mm from the middle of the pixel line.
    hole_diameter : float
        mm.
    joints : tuple of tuple of float
        Half widths of the boxes in which the other parts' joints stand up.
    joint_height : float
        How far they do, mm.
    package : tuple of float
        Largest length, width and height of the sensor's package, mm.
    sockets : tuple of float
        Length, distance of the rows, width and height of the strips that it sits in, mm.
    """

    size: tuple[float, float]
    thickness: float
    holes: tuple[tuple[float, float], ...]
    hole_diameter: float
    joints: tuple[tuple[float, float], ...]
    joint_height: float
    package: tuple[float, float, float]
    sockets: tuple[float, float, float, float]

    @property
    def window_height(self) -> float:
        """From the board's face to the window's outer face, mm."""
        return self.sockets[3] + self.package[2]

    def parts(self, face: float) -> dict[str, Solid]:
        """Return the board and all that stands on it, its face at z = face, by name."""
        length, rows, width, height = self.sockets
        across, up = self.size[0] / 2, self.size[1] / 2
        strips = tuple(
            Box(
                (-length / 2, y - width / 2, face - height),
                (length / 2, y + width / 2, face),
            )
            for y in (-rows / 2, rows / 2)
        )
        top = face - self.window_height
        return {
            "board": block(across, up, face, face + self.thickness),
            "sockets": Union(strips),
            "package": block(self.package[0] / 2, self.package[1] / 2, top, face - height),
            "joints": Union(
                tuple(block(x, y, face - self.joint_height, face) for x, y in self.joints)
            ),
        }


@dataclass(frozen=True)
class Rules:
    """How a mount is made around its lenses; meanings in mechanics.toml, lengths in mm."""

    wall: float
    printable_wall: float
    lateral_clearance: float
    axial_clearance: float
    relief_clearance: float
    front_wall: float
    ledge: tuple[float, float]
    flare: float
    slit_bevel: float
    play: float
    front_screw: float
    screw_hole: float
    core_hole: float
    core_depth: float
    field: Field


@dataclass(frozen=True)
class Field:
    """Where the light comes from that must pass; meanings in mechanics.toml."""

    along: float
    across: float
    distances: tuple[float, ...]
    strip: float


@dataclass(frozen=True)
class MountedLens:
    """A lens as the mount sees it.

    Parameters
    ----------
    name : str
        Part number, and its number along the light if there are two of it.
    half : tuple of float
        Half its size along X and Y, mm.
    box : tuple of float
        Foremost and last z of the glass, mm.
    corner : tuple of float
        |x| and |y| from which on ledges cover it, mm.
    ledges : tuple of float
        z of the glass that the front and the back ledges meet first, mm.
    glass : Solid
    """

    name: str
    half: tuple[float, float]
    box: tuple[float, float]
    corner: tuple[float, float]
    ledges: tuple[float, float]
    glass: Solid


@dataclass(frozen=True)
class LensMount:
    """Two halves and what they hold.

    Parameters
    ----------
    system : OpticalSystem
    sensor : LineSensor
    board : Board
    rules : Rules
    lenses : tuple of MountedLens
        Front to back.
    lower, upper : Solid
        The halves, in the system's frame.
    half_size : tuple of float
        Half the outer width and height, mm.
    front, face : float
        z of the front, and of the back on which the board lies, mm.
    screws : tuple of tuple of float
        x and z of the M3, which run along Y through both halves.
    """

    system: OpticalSystem
    sensor: LineSensor
    board: Board
    rules: Rules
    lenses: tuple[MountedLens, ...]
    lower: Solid
    upper: Solid
    half_size: tuple[float, float]
    front: float
    face: float
    screws: tuple[tuple[float, float], ...]

    @property
    def size(self) -> tuple[float, float, float]:
        """Outer width, height and length of the clamped halves, mm."""
        return 2 * self.half_size[0], 2 * self.half_size[1], self.face - self.front

    @property
    def window(self) -> float:
        """Z of the window's outer face, mm."""
        return self.face - self.board.window_height

    @property
    def halves(self) -> dict[str, Solid]:
        """Both halves by name."""
        return {"lower": self.lower, "upper": self.upper}

    def printed(self) -> dict[str, Solid]:
        """Return both halves by name as they are printed: z up from the bed, the outer face down.

        All that is cut into them is then open to above, but for the board's screw holes.
        """
        up = self.half_size[1]
        return {
            "lower": Placed(self.lower, (0.0, 0.0, up), "x", 1),
            "upper": Placed(self.upper, (0.0, 0.0, up), "x", -1),
        }

    def heights(self) -> dict[str, float]:
        """Height of every lens's last vertex above the window's outer face, mm, by name."""
        placed = [p for p in self.system.layout() if isinstance(p.element, Lens | SphericalLens)]
        return {
            lens.name: self.window - at.back for lens, at in zip(self.lenses, placed, strict=True)
        }


def mechanics() -> dict[str, Any]:
    """Return what data/mechanics.toml says."""
    text = (files("hardware") / "data" / "mechanics.toml").read_text(encoding="utf-8")
    return tomllib.loads(text)


def sensor_board(sensor: LineSensor = TCD1304, data: Mapping[str, Any] | None = None) -> Board:
    """Return the board of a sensor.

    Parameters
    ----------
    sensor : LineSensor
    data : mapping, optional
        Another `mechanics()`.

    Raises
    ------
    ValueError
        If mechanics.toml does not know the sensor's package.
    """
    data = mechanics() if data is None else data
    if sensor.name not in data["package"]:
        raise ValueError(
            f"{sensor.name}: mechanics.toml knows the package of {', '.join(data['package'])} only"
        )
    package, board = data["package"][sensor.name], data["sensor_board"]
    strip = board["sockets"]
    return Board(
        size=(board["size"][0], board["size"][1]),
        thickness=board["thickness"],
        holes=tuple((x, y) for x, y in board["holes"]),
        hole_diameter=board["hole_diameter"],
        joints=tuple((x, y) for x, y in board["joints"]),
        joint_height=board["joint_height"],
        package=(
            package["length"] + package["length_tolerance"],
            package["width"] + package["width_tolerance"],
            package["height"],
        ),
        sockets=(
            package["pins_in_a_row"] * package["pitch"],
            package["row_distance"],
            strip["width"],
            strip["height"],
        ),
    )


def mount_rules(data: Mapping[str, Any] | None = None) -> Rules:
    """Return the rules of mechanics.toml, or of another `mechanics()`."""
    entry = dict((mechanics() if data is None else data)["mount"])
    field = dict(entry.pop("field"))
    distances = tuple(field.pop("distances"))
    across, up = entry.pop("ledge")
    return Rules(**entry, ledge=(across, up), field=Field(distances=distances, **field))


def lens_mount(
    system: OpticalSystem,
    sensor: LineSensor = TCD1304,
    *,
    board: Board | None = None,
    rules: Rules | None = None,
) -> LensMount:
    """Lay out the mount of a head.

    Parameters
    ----------
    system : OpticalSystem
        With a sensor_distance; every element in its place. A last plate is the sensor's window.
    sensor : LineSensor
        With a window.
    board, rules : optional
        Those of mechanics.toml when left out.

    Raises
    ------
    ValueError
        If the system has no lens or no sensor_distance, elements are off their places, a plate is
        not the sensor's window (no edge is known to hold it by), or a lens reaches into the sensor.
    """
    board = sensor_board(sensor) if board is None else board
    rules = mount_rules() if rules is None else rules
    window = window_place(system, sensor)
    stations = _stations(system, sensor, rules)
    lenses = tuple(station for station in stations if isinstance(station, MountedLens))
    if not lenses:
        raise ValueError(f"{system.name}: there is no lens to mount")
    face = window + board.window_height
    relief = window - rules.relief_clearance
    if lenses[-1].box[1] + rules.axial_clearance + rules.printable_wall > relief:
        raise ValueError(
            f"{system.name}: {lenses[-1].name} ends {window - lenses[-1].box[1]:.4g} mm before the "
            f"sensor's window; a ledge of {rules.printable_wall:g} mm and "
            f"{rules.relief_clearance:g} mm of clearance have to fit between"
        )
    wide, high = _widest(lenses, rules)
    screw_x = wide + rules.wall + rules.screw_hole / 2
    half_x = max(screw_x + rules.screw_hole / 2 + rules.wall, board.size[0] / 2)
    half_y = max(high + rules.wall, board.size[1] / 2)
    first = stations[0]
    front = (
        first.z if isinstance(first, _Slit) else _pocket_ends(first, rules)[0] - rules.front_wall
    )
    last_screw = relief - rules.wall - rules.screw_hole / 2
    screws = tuple(
        (x, z) for z in (front + rules.front_screw, last_screw) for x in (-screw_x, screw_x)
    )

    void = [*_light(stations, front, relief, rules), *_pockets(lenses, rules)]
    void += _relief(board, face, rules)
    void += [Cylinder("y", at, -half_y - 1, half_y + 1, rules.screw_hole) for at in screws]
    void += [
        Cylinder("z", at, face - rules.core_depth, face + 1, rules.core_hole) for at in board.holes
    ]
    outer = {
        "lower": Box((-half_x, -half_y, front), (half_x, 0.0, face)),
        "upper": Box((-half_x, 0.0, front), (half_x, half_y, face)),
    }
    return LensMount(
        system,
        sensor,
        board,
        rules,
        lenses,
        lower=Difference(outer["lower"], tuple(void)),
        upper=Difference(outer["upper"], tuple(void)),
        half_size=(half_x, half_y),
        front=front,
        face=face,
        screws=screws,
    )


@dataclass(frozen=True)
class _Slit:
    """A screen of the design: its plate is part of the mount, its edge lies at z."""

    z: float
    opening: tuple[float, float]


_Station = MountedLens | _Slit


def window_place(system: OpticalSystem, sensor: LineSensor) -> float:
    """Return z of the window's outer face, mm, in the frame of the system.

    Raises
    ------
    ValueError
        As `lens_mount`.
    """
    if any(at != NOMINAL for at in (*system.placements, system.sensor_placement)):
        raise ValueError(
            f"{system.name}: a mount is made for elements in their places; replace its placements"
        )
    if system.sensor_distance is None or sensor.top_to_chip is None:
        raise ValueError(
            f"{system.name}: a mount needs sensor_distance and a sensor whose window is known"
        )
    last = system.layout()[-1]
    if last.element == sensor.window:
        return last.front
    return last.back + system.sensor_distance - sensor.top_to_chip


def _stations(system: OpticalSystem, sensor: LineSensor, rules: Rules) -> tuple[_Station, ...]:
    """Return all lenses and slits, front to back."""
    stations: list[_Station] = []
    names = [element.part for element in system.elements]
    for number, (element, front, back) in enumerate(system.layout()):
        match element:
            case Plate():
                if number < len(names) - 1 or element != sensor.window:
                    raise ValueError(
                        f"{element.part}: a plate's edges are not known, so that it cannot be held"
                    )
            case Aperture():
                stations.append(_Slit(front, (element.x / 2, element.y / 2)))
            case Lens() | SphericalLens():
                name = element.part
                if names.count(name) > 1:
                    name += f" ({names[: number + 1].count(name)})"
                stations.append(_mounted(element, name, front, back, rules))
    return tuple(stations)


def _mounted(
    lens: Lens | SphericalLens, name: str, front: float, back: float, rules: Rules
) -> MountedLens:
    half = (lens.size("x") / 2, lens.size("y") / 2)
    if isinstance(lens, SphericalLens):
        inner = half[0] / math.sqrt(2) - min(rules.ledge) / 2
        corner = (inner, inner)
        outermost = (half[0] / math.sqrt(2),) * 2
    else:
        corner = (half[0] - rules.ledge[0], half[1] - rules.ledge[1])
        outermost = half
    ahead, behind = lens.surfaces()
    sag = np.array([s.sag(*np.transpose([corner, outermost])) for s in (ahead, behind)])
    return MountedLens(
        name=name,
        half=half,
        box=(front + min(0.0, ahead.depth(half)), back + max(0.0, behind.depth(half))),
        corner=corner,
        # what a ledge meets first; sags grow or fall steadily from the axis on
        ledges=(front + float(sag[0].min()), back + float(sag[1].max())),
        glass=_glass(lens, front, back),
    )


def _glass(lens: Lens | SphericalLens, front: float, back: float) -> Solid:
    radii = [1 / s.curvature if s.curvature else math.inf for s in lens.surfaces()]
    size = lens.diameter if isinstance(lens, SphericalLens) else lens.height
    before, after = (arc(r, size / 2, z) for r, z in zip(radii, (front, back), strict=True))
    outline = (*before, *reversed(after))
    if isinstance(lens, SphericalLens):
        # an arc has a point on the axis
        return Lathe(tuple((h, z) for h, z in outline if h >= 0))
    axis: Literal["x", "y"] = "y" if lens.bends == "x" else "x"
    return Prism(axis, outline, -lens.length / 2, lens.length / 2)


def _corners(
    inner: tuple[float, float], outer: tuple[float, float], low: float, high: float
) -> Union:
    """Return the four corners of a frame around the axis."""
    return Union(
        tuple(
            Box(
                (min(i * inner[0], i * outer[0]), min(j * inner[1], j * outer[1]), low),
                (max(i * inner[0], i * outer[0]), max(j * inner[1], j * outer[1]), high),
            )
            for i in (-1, 1)
            for j in (-1, 1)
        )
    )


def _light(stations: Sequence[_Station], front: float, relief: float, rules: Rules) -> list[Solid]:
    """Return the way of the light: before, between and behind all lenses and slits."""
    wide = _widest([station for station in stations if isinstance(station, MountedLens)], rules)
    void: list[Solid] = []
    first = stations[0]
    if isinstance(first, MountedLens):
        start, _ = _pocket_ends(first, rules)
        grows = (start - front) * math.tan(math.radians(rules.flare))
        for arm in _arms(first, rules):
            x, y = arm[0] - SKIN, arm[1] - SKIN  # not through the very edge of the pocket
            void.append(_flared(front, (x + grows, y + grows), start, (x, y)))
    for before, after in zip(stations, (*stations[1:], None), strict=True):
        low = before.z if isinstance(before, _Slit) else _pocket_ends(before, rules)[1]
        high, ledge = relief, 0.0
        if isinstance(after, _Slit):
            high = after.z
        elif after is not None:
            high, ledge = _pocket_ends(after, rules)[0], rules.wall
        if high < low - SKIN:
            continue  # the pockets meet
        if high - low > 2 * rules.wall + ledge:  # no slot thinner than a wall
            void.append(_opening(before, wide, low, low + rules.wall, rules))
            void.append(block(*wide, low + rules.wall, high - ledge + SKIN * (after is None)))
            if isinstance(after, MountedLens):
                void.append(_opening(after, wide, high - ledge, high, rules))
        else:  # one ledge serves both
            shared = [before, after] if isinstance(after, MountedLens) else [before]
            void.append(Intersection(tuple(_opening(s, wide, low, high, rules) for s in shared)))
    return void


def _opening(
    station: _Station, wide: tuple[float, float], low: float, high: float, rules: Rules
) -> Solid:
    """Return what a lens's ledges or a slit's plate leave open."""
    if isinstance(station, MountedLens):
        arms = _arms(station, rules)
        return Union(tuple(block(x, y, low - SKIN, high + SKIN) for x, y in arms))
    grows = (high - low) * math.tan(math.radians(rules.slit_bevel))
    (x, y), (most_x, most_y) = station.opening, wide
    far = min(x + grows, most_x), min(y + grows, most_y)
    return _flared(low, (min(x, most_x), min(y, most_y)), high, far)


def _flared(low: float, near: tuple[float, float], high: float, far: tuple[float, float]) -> Solid:
    """Return a frustum that goes on a little at both ends."""
    x, y = ((b - a) * SKIN / (high - low) for a, b in zip(near, far, strict=True))
    return frustum(low - SKIN, (near[0] - x, near[1] - y), high + SKIN, (far[0] + x, far[1] + y))


def _arms(lens: MountedLens, rules: Rules) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return half widths of the two boxes of the cross that a lens's ledges leave open."""
    x, y = _pocket_half(lens, rules)
    return (x, lens.corner[1]), (lens.corner[0], y)


def _widest(lenses: Sequence[MountedLens], rules: Rules) -> tuple[float, float]:
    """Return half width and half height that every lens's pocket fits in."""
    x, y = np.max([_pocket_half(lens, rules) for lens in lenses], axis=0)
    return float(x), float(y)


def _pocket_half(lens: MountedLens, rules: Rules) -> tuple[float, float]:
    return lens.half[0] + rules.lateral_clearance, lens.half[1] + rules.lateral_clearance


def _pocket_ends(lens: MountedLens, rules: Rules) -> tuple[float, float]:
    return lens.box[0] - rules.axial_clearance, lens.box[1] + rules.axial_clearance


def _pockets(lenses: Sequence[MountedLens], rules: Rules) -> list[Solid]:
    """Return each lens's outer box with its clearance, less the ledges in it."""
    result: list[Solid] = []
    for lens in lenses:
        half = _pocket_half(lens, rules)
        low, high = _pocket_ends(lens, rules)
        ends = (
            (low, lens.ledges[0] - rules.axial_clearance),
            (lens.ledges[1] + rules.axial_clearance, high),
        )
        ledges = [
            _corners(lens.corner, half, start, end) for start, end in ends if end - start > 1e-6
        ]
        pocket = block(*half, low, high)
        result.append(Difference(pocket, tuple(ledges)) if ledges else pocket)
    return result


def _relief(board: Board, face: float, rules: Rules) -> list[Solid]:
    """Return the room for the sensor, its sockets and the joints of the other parts."""
    room = rules.relief_clearance
    length, rows, width, _ = board.sockets
    x = max(board.package[0], length) / 2 + room
    y = max(board.package[1], rows + width) / 2 + room
    joints = [
        block(a + room, b + room, face - board.joint_height - room, face + 1)
        for a, b in board.joints
    ]
    return [block(x, y, face - board.window_height - room, face + 1), *joints]
