"""The room around the prototype: LEDs, where the tracker is, ambient light, walls, who stands between.

Room frame, mm: x along the line of LEDs, y away from it toward the tracker, z up; the plain set-up
lies in z = 0. `World.lit` is the one place where light becomes electrons; rays are exact.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from numbers import Integral
from typing import TYPE_CHECKING

import numpy as np

from acquisition.frames import CHANNELS
from raytransfer import TCD1304, OpticalSystem, prototype_head
from raytransfer import _checks as check
from raytransfer.irradiance import LightTable, disc, disc_points, photon_energy, pixel_response
from raytransfer.studies import room_to_optical

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from raytransfer import LineSensor

LUMINOUS_EFFICACY = 683.0  # lm/W at 555 nm
CLOSEST = 20.0  # mm from the first vertex: nearer ones are not seen
_ON_WALL = 1e-9  # of a way: where it begins


@dataclass(frozen=True)
class Led:
    """A Lambertian LED on one of the firmware's channels.

    Parameters
    ----------
    channel : int
        0 to 63, see wiring.toml.
    position : tuple of float
        Room x, y and z, mm.
    power : float
        Radiant power while lit, W. The thesis names none; 0.04 W leaves some 42,000 electrons in
        the brightest pixel, a caustic, in 25 µs from 1.3 m.
    wavelength : float
        µm.
    facing : float
        Direction in which it shines, rad, counter-clockwise from +y.
    extent : float
        Diameter of what shines, mm; 0 is a point.
    """

    channel: int
    position: tuple[float, float, float]
    power: float = 0.04
    wavelength: float = 0.63
    facing: float = 0.0
    extent: float = 0.0

    def __post_init__(self) -> None:
        _channels([self.channel])
        if len(self.position) != 3:
            raise ValueError(f"LED position = {self.position}: room x, y and z in mm are needed")
        for axis, value in zip("xyz", self.position, strict=True):
            check.number(f"{axis} of LED {self.channel}", value, "room coordinates in mm")
        check.not_negative("power", self.power, "W")
        check.positive("wavelength", self.wavelength, "µm")
        if self.wavelength > 20:
            raise ValueError(f"wavelength = {self.wavelength:g} µm: was it given in nm?")
        check.angle("facing", self.facing)
        check.not_negative("extent", self.extent, "a diameter in mm")

    def intensity(self, x: float, y: float, z: float) -> float:
        """Radiant intensity in W/sr toward a point of the room in mm."""
        dx, dy, dz = x - self.position[0], y - self.position[1], z - self.position[2]
        distance = np.hypot(np.hypot(dx, dy), dz)
        if distance == 0:
            return 0.0
        cosine = (dy * np.cos(self.facing) - dx * np.sin(self.facing)) / distance
        return float(self.power / np.pi * max(cosine, 0.0))


@dataclass(frozen=True)
class Pose:
    """Where the tracker is and how it is turned.

    Its own frame has X to its right, Y up and Z backward, with the light: the optical frame of a
    head that is mounted straight. Optical X, Y, Z of a point p of the room are Rᵀ(p − (x, y, z)) with

        R = R_z(heading) · B · R_x(pitch) · R_z(roll)
            ⎡−1  0  0⎤                ⎡1    0       0   ⎤            ⎡cos ρ  −sin ρ  0⎤
        B = ⎢ 0  0  1⎥     R_x(θ) =   ⎢0  cos θ  −sin θ⎥   R_z(ρ) = ⎢sin ρ   cos ρ  0⎥
            ⎣ 0  1  0⎦                ⎣0  sin θ   cos θ⎦            ⎣  0       0    1⎦

    so that the columns of R are the frame's axes in the room. Turned by its heading first, then
    pitched about its own X, then rolled about its own Z.

    Parameters
    ----------
    x, y : float
        mm.
    heading : float
        rad, counter-clockwise seen from above; 0 looks along −y. Angles are −2π to 2π: one that
        turns on and on is wrapped by ``math.remainder(angle, math.tau)``.
    z : float
        mm.
    pitch : float
        rad; positive looks up.
    roll : float
        rad; positive raises the tracker's right side.
    """

    x: float
    y: float
    heading: float = 0.0
    z: float = 0.0
    pitch: float = 0.0
    roll: float = 0.0

    def __post_init__(self) -> None:
        for name in ("x", "y", "z"):
            check.number(name, getattr(self, name), "mm")
        for name in ("heading", "pitch", "roll"):
            check.angle(name, getattr(self, name))

    @property
    def rotation(self) -> NDArray[np.float64]:
        """R: right, up and backward of the tracker as columns, in the room."""
        sin, cos = math.sin(self.heading), math.cos(self.heading)
        upright = np.array([[-cos, 0.0, -sin], [-sin, 0.0, cos], [0.0, 1.0, 0.0]])
        sin, cos = math.sin(self.pitch), math.cos(self.pitch)
        pitched = np.array([[1.0, 0.0, 0.0], [0.0, cos, -sin], [0.0, sin, cos]])
        return np.asarray(upright @ pitched @ _rolled(self.roll))


def _rolled(angle: float) -> NDArray[np.float64]:
    sin, cos = math.sin(angle), math.cos(angle)
    return np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])


Trajectory = Callable[[float], Pose]
"""Where the tracker is at a (virtual) time in s."""


@dataclass(frozen=True)
class Mount:
    """How a head sits on the tracker.

    Parameters
    ----------
    roll : float
        rad, about the optical axis: 0 has the line of pixels along the tracker's X; π/2 along its
        Y, perpendicular to that. Optical X, Y, Z are R_z(roll)ᵀ times those of the tracker's frame
        less the offset.
    offset : tuple of float
        Of the front vertex in the tracker's frame (right, up, backward), mm.
    """

    roll: float = 0.0
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        check.angle("roll of the mount", self.roll)
        if len(self.offset) != 3:
            raise ValueError(f"offset = {self.offset}: right, up and backward in mm are needed")
        for value in self.offset:
            check.number("offset of the mount", value, "mm")


STRAIGHT = Mount()
"""A single head: its line is level when the tracker is."""


@dataclass(frozen=True)
class Wall:
    """A vertical mirror: every LED before it has an image behind it, and none is seen through it.

    Parameters
    ----------
    start, end : tuple of float
        Room x and y of its ends, mm. It shines on both sides, and hides, at any height.
    reflectivity : float
        0 to 1: a window at night 0.1, varnish 0.05, a mirror 0.9; 0 only hides.
    """

    start: tuple[float, float]
    end: tuple[float, float]
    reflectivity: float

    def __post_init__(self) -> None:
        for name in ("start", "end"):
            value = getattr(self, name)
            if len(value) != 2:
                raise ValueError(f"{name} of a wall = {value}: room x and y in mm are needed")
            for number in value:
                check.number(f"{name} of a wall", number, "mm")
        if self.start == self.end:
            raise ValueError(f"a wall from {self.start} to itself has no direction")
        if not 0 <= check.number("reflectivity", self.reflectivity) <= 1:
            raise ValueError(f"reflectivity = {self.reflectivity:g}: allowed is 0 to 1; in %?")

    def image(self, led: Led) -> Led:
        """Return the mirror image of an LED, as bright as it is seen in the wall."""
        (x, y), turn = self.start, self._direction
        dx, dy = led.position[0] - x, led.position[1] - y
        sin, cos = math.sin(2 * turn), math.cos(2 * turn)
        return replace(
            led,
            position=(x + cos * dx + sin * dy, y + sin * dx - cos * dy, led.position[2]),
            facing=2 * turn - led.facing + math.pi,
            power=led.power * self.reflectivity,
        )

    def shows(self, image: Led, x: float, y: float) -> bool:
        """Whether the way from an image to a point of the room in mm passes through the wall."""
        return self._meets(image.position, (x, y)) is not None

    def hides(self, led: Led, x: float, y: float, mirror: Wall | None = None) -> bool:
        """Whether it stands between an LED and a point of the room in mm.

        Parameters
        ----------
        led : Led
            Or an image of one.
        x, y : float
            The point.
        mirror : Wall, optional
            Which the image is in: light comes from the LED to there, then to the point.
        """
        if mirror is None:
            return self._meets(led.position, (x, y)) is not None
        if mirror is self:
            return False
        share = mirror._meets(led.position, (x, y))
        if share is None:
            return False
        at = (
            led.position[0] + share * (x - led.position[0]),
            led.position[1] + share * (y - led.position[1]),
        )
        there = mirror.image(led).position  # back to the LED itself
        return self._meets(at, (x, y)) is not None or self._meets(there, at) is not None

    def _meets(self, begin: Sequence[float], end: Sequence[float]) -> float | None:
        """How far on the way from one place to another it is met: 0 to 1, without the ends."""
        along = (self.end[0] - self.start[0], self.end[1] - self.start[1])
        way = (end[0] - begin[0], end[1] - begin[1])
        gap = (self.start[0] - begin[0], self.start[1] - begin[1])
        across = way[0] * along[1] - way[1] * along[0]
        if across == 0:
            return None  # along the wall
        on_way = (gap[0] * along[1] - gap[1] * along[0]) / across
        on_wall = (gap[0] * way[1] - gap[1] * way[0]) / across
        # an LED on the wall is before it, whatever rounding says
        return on_way if _ON_WALL < on_way < 1 - _ON_WALL and 0 <= on_wall <= 1 else None

    @property
    def _direction(self) -> float:
        return math.atan2(self.end[1] - self.start[1], self.end[0] - self.start[0])


@dataclass(frozen=True)
class Occlusion:
    """Something stands before some LEDs for a while: they, and their reflections, are not seen.

    Parameters
    ----------
    begin, end : float
        Virtual s; hidden from the one to just before the other.
    channels : collection of int, optional
        All when left out.
    """

    begin: float
    end: float
    channels: Collection[int] | None = None

    def __post_init__(self) -> None:
        check.number("begin of an occlusion", self.begin, "s")
        if not self.end > self.begin:  # may be without end
            raise ValueError(
                f"occlusion from {self.begin} s to {self.end} s: it ends before it begins"
            )
        if self.channels is not None:
            object.__setattr__(self, "channels", frozenset(_channels(self.channels)))


@dataclass(frozen=True)
class RandomOcclusions:
    """Every LED is hidden for a share of the time, on its own: people walk about.

    Time is cut into slots; in each, chance decides for each LED. The same seed hides the same.

    Parameters
    ----------
    share : float
        Of the time, 0 to 1.
    duration : float
        Of a slot, s.
    seed : int
    """

    share: float
    duration: float = 0.3
    seed: int = 0

    def __post_init__(self) -> None:
        if not 0 <= check.number("share", self.share) <= 1:
            raise ValueError(f"share = {self.share:g}: allowed is 0 to 1; in %?")
        check.positive("duration", self.duration, "s")
        if self.seed < 0:
            raise ValueError(f"seed = {self.seed!r}: allowed are whole numbers from 0 on")

    def __call__(self, seconds: float) -> frozenset[int]:
        """Channels hidden at a time in s."""
        return _drawn(self.seed, math.floor(seconds / self.duration), self.share)


@lru_cache(maxsize=16)
def _drawn(seed: int, slot: int, share: float) -> frozenset[int]:
    chance = np.random.default_rng([seed, slot + (1 << 62)]).random(CHANNELS)
    return frozenset(np.flatnonzero(chance < share).tolist())


def _channels(channels: Collection[int]) -> Collection[int]:
    for channel in channels:
        value: object = channel  # 1.0 and True would pass for whole numbers
        whole = isinstance(value, Integral) and not isinstance(value, bool)
        if not whole or not 0 <= channel < CHANNELS:
            raise ValueError(
                f"LED channel = {channel!r}: allowed are 0 to {CHANNELS - 1}, whole numbers"
            )
    return channels


def two_leds() -> tuple[Led, Led]:
    """Return the thesis's pair: x = −250 mm on channel 0 and +250 mm on channel 1, y = 0."""
    return Led(0, (-250.0, 0.0, 0.0)), Led(1, (250.0, 0.0, 0.0))


@dataclass(frozen=True)
class World:
    """All that light depends on.

    Parameters
    ----------
    leds : sequence of Led
        At most one per channel; the thesis's two when left out.
    tracker : Pose or callable
        A pose, or a trajectory: seconds to pose. Left out: (0, 1300) mm, straight at the line.
    ambient : float
        Illuminance on the pixels, lx (as if all at 555 nm); 0 is a dark room.
    head : OpticalSystem
        With a sensor_distance; the thesis's head when left out.
    sensor : LineSensor
    mount : Mount
        Of the head on the tracker; straight when left out.
    walls : sequence of Wall
        That reflect, and hide what is behind them; one reflection is followed, not those of
        reflections.
    occlusions : sequence of Occlusion, or callable
        What hides LEDs: when, or a function from seconds to the channels hidden. In the twin it is
        asked when an LED goes on and when a read-out starts.
    """

    leds: Sequence[Led] = field(default_factory=two_leds)
    tracker: Pose | Trajectory = Pose(0.0, 1300.0)
    ambient: float = 0.0
    head: OpticalSystem = field(default_factory=prototype_head)
    sensor: LineSensor = TCD1304
    mount: Mount = STRAIGHT
    walls: Sequence[Wall] = ()
    occlusions: Sequence[Occlusion] | Callable[[float], Collection[int]] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "leds", tuple(self.leds))
        object.__setattr__(self, "walls", tuple(self.walls))
        if not callable(self.occlusions):
            object.__setattr__(self, "occlusions", tuple(self.occlusions))
        channels = [led.channel for led in self.leds]
        if len(set(channels)) != len(channels):
            raise ValueError(f"LED channels {channels}: each may be used once")
        check.not_negative("ambient", self.ambient, "illuminance on the pixels, lx")
        if not isinstance(self.head, OpticalSystem):
            raise TypeError(
                f"head = {self.head!r:.60}: an OpticalSystem is needed; of a Design take .system"
            )
        if self.sensor.response is None:
            raise ValueError(f"{self.sensor.name}: its data file lacks the spectral response")

    @property
    def moving(self) -> bool:
        """Whether the tracker moves."""
        return not isinstance(self.tracker, Pose)

    @property
    def changing(self) -> bool:
        """Whether light depends on time."""
        return self.moving or bool(self.occlusions)

    def pose(self, seconds: float = 0.0) -> Pose:
        """Where the tracker is."""
        return self.tracker if isinstance(self.tracker, Pose) else self.tracker(seconds)

    def hidden(self, seconds: float = 0.0) -> Collection[int]:
        """Channels of the LEDs that something stands before."""
        if callable(self.occlusions):
            return self.occlusions(seconds)
        hidden: set[int] = set()
        for occlusion in self.occlusions:
            if occlusion.begin <= seconds < occlusion.end:
                if occlusion.channels is None:
                    return range(CHANNELS)
                hidden.update(occlusion.channels)
        return hidden

    def seen_from(self, led: Led, pose: Pose) -> tuple[float, float, float]:
        """Return the LED's optical X, Y and distance from a pose, mm."""
        x, y, distance = self._seen(np.array([led.position]), pose).tolist()[0]
        return x, y, distance

    def _seen(self, points: NDArray[np.float64], pose: Pose) -> NDArray[np.float64]:
        if pose.pitch or pose.roll or self.mount != STRAIGHT:
            own = (points - (pose.x, pose.y, pose.z)) @ pose.rotation - self.mount.offset
            return own @ _rolled(self.mount.roll) * (1.0, 1.0, -1.0)
        along, distance = room_to_optical(points[:, :2], pose.x, pose.y, pose.heading)
        return np.column_stack([along, points[:, 2] - pose.z, distance])

    def ambient_rate(self) -> float:
        """Electrons per second that ambient light brings to a pixel."""
        area = self.sensor.pitch * self.sensor.pixel_height * 1e-6  # m²
        return self.ambient / LUMINOUS_EFFICACY * area * _electrons_per_joule(self.sensor, 0.555)

    def rates(self, seconds: float = 0.0) -> NDArray[np.float64]:
        """Electrons per second in every pixel from every channel's LED while it is lit.

        Returns
        -------
        ndarray, shape (64, pixels)
        """
        rates = np.zeros((CHANNELS, self.sensor.pixels))
        for channel, rate in self.lit(seconds):
            rates[channel] = rate
        return rates

    def lit(
        self, seconds: float = 0.0, channels: Collection[int] | None = None
    ) -> Iterator[tuple[int, NDArray[np.float64]]]:
        """Yield the rows of `rates` that are not dark, with their channels.

        What a 64-row table would cost twice a frame is saved, and whatever is out of sight.

        Parameters
        ----------
        seconds : float
            When.
        channels : collection of int, optional
            Of the LEDs in question; all when left out.
        """
        pose, hidden = self.pose(seconds), self.hidden(seconds)
        eye = (pose.x, pose.y, pose.z)
        if any(self.mount.offset):
            eye = tuple((eye + pose.rotation @ self.mount.offset).tolist())
        lit: dict[int, NDArray[np.float64]] = {}
        places = self._seen(self._positions, pose).tolist()
        for (led, wall), place in zip(self._sources, places, strict=True):
            if channels is not None and led.channel not in channels:
                continue
            if led.channel in hidden or (wall and not wall.shows(led, eye[0], eye[1])):
                continue
            if any(other.hides(led, eye[0], eye[1], wall) for other in self.walls):
                continue
            light = self._light(led, (place[0], place[1], place[2]), led.intensity(*eye))
            if light is not None:
                lit[led.channel] = light + lit[led.channel] if led.channel in lit else light
        yield from lit.items()

    @cached_property
    def _sources(self) -> list[tuple[Led, Wall | None]]:
        """LEDs, and their images in the walls."""
        mirrors = [wall for wall in self.walls if wall.reflectivity]
        images = [(wall.image(led), wall) for wall in mirrors for led in self.leds]
        return [*((led, None) for led in self.leds), *images]

    @cached_property
    def _positions(self) -> NDArray[np.float64]:
        return np.array([led.position for led, _ in self._sources]).reshape(-1, 3)

    @cached_property
    def _optics(self) -> dict[float, _Optics]:
        """By wavelength."""
        return {
            led.wavelength: _optics(self.head, self.sensor, led.wavelength) for led in self.leds
        }

    def _light(
        self, led: Led, place: tuple[float, float, float], intensity: float
    ) -> NDArray[np.float64] | None:
        """Electrons per second from an LED, or an image of one, that is lit; None is darkness."""
        distance = place[2]
        if distance <= CLOSEST or intensity == 0:
            return None  # behind the tracker or in its lenses, or turned away
        optics = self._optics[led.wavelength]
        solid_angles: Callable[[tuple[float, float, float]], NDArray[np.float64]]
        if not self.moving:
            solid_angles, points = optics.traced, optics.points(led.extent, distance)
        elif optics.in_view(place, led.extent / 2):
            # by steps of a sixth, not to be computed anew for each place
            step = 2 ** (math.floor(4 * math.log2(distance)) / 4)
            solid_angles, points = optics.table.solid_angles, optics.points(led.extent, step)
        else:
            return None
        rate = intensity * optics.electrons_per_joule
        total: NDArray[np.float64] | None = None
        for point, share in disc(place, led.extent, points):
            part = rate * share * solid_angles(point)
            total = part if total is None else total + part
        return total


class _Table(LightTable):
    """With half the step: where a slit's spike is narrowest, the whole is too far, and rays cost."""

    STEPS = (0.025, *LightTable.STEPS[1:])


class _Optics:
    """A head and a sensor in light of one wavelength, and what of them is worth remembering."""

    ROWS, LAYERS = 0.25, 1e-3
    """Steps of Y/distance and 1/distance (1/mm) in which the edge of the view is sought."""
    STEEPEST, STEP, FINE = 2.0, 0.25, 0.05
    """Of |X|/distance there: where the search begins, and its steps."""
    RAYS = (64, 32)
    """Enough to say whether there is light at all."""

    def __init__(self, head: OpticalSystem, sensor: LineSensor, wavelength: float) -> None:
        self.head, self.sensor, self.wavelength = head, sensor, wavelength
        self.electrons_per_joule = _electrons_per_joule(sensor, wavelength)
        self.traced = lru_cache(maxsize=128)(self._traced)
        self.points = lru_cache(maxsize=256)(self._points)
        self._edge_between = lru_cache(maxsize=1024)(self._edge)
        self._edges: dict[tuple[int, int], float] = {}

    @cached_property
    def table(self) -> LightTable:
        return _Table(self.head, self.sensor, wavelength=self.wavelength)

    def _traced(self, place: tuple[float, float, float]) -> NDArray[np.float64]:
        return pixel_response(self.head, place, self.sensor, wavelength=self.wavelength)

    def _points(self, extent: float, distance: float) -> int:
        return disc_points(self.head, extent, distance, self.sensor) if extent else 1

    def in_view(self, place: tuple[float, float, float], radius: float) -> bool:
        """Whether light may get to the pixels from a place: quick, and never wrongly no."""
        x, y, distance = place
        slope = (abs(x) - radius) / distance
        if distance < LightTable.CLOSEST or slope <= 0 or slope >= self.STEEPEST:
            return True
        row, layer = math.floor(y / distance / self.ROWS), math.floor(1 / distance / self.LAYERS)
        return slope <= self._edge_between(row, layer)

    def _edge(self, row: int, layer: int) -> float:
        """Largest |X|/distance whose light gets to a pixel, for some steps of height and distance."""
        return max(self._edge_at(row + i, layer + j) for i in (0, 1) for j in (0, 1))

    def _edge_at(self, row: int, layer: int) -> float:
        at = (row, layer)
        if at not in self._edges:
            height, distance = row * self.ROWS, 1 / (self.LAYERS * max(layer, 0.1))
            edge = next(
                (
                    slope
                    for slope in np.arange(self.STEEPEST, -self.STEP, -self.STEP).tolist()
                    if self._light_from(slope, height, distance)
                ),
                -self.STEP,
            )
            for slope in np.arange(edge + self.STEP, edge, -self.FINE).tolist():
                if self._light_from(slope, height, distance):
                    edge = slope
                    break
            self._edges[at] = edge + self.FINE
        return self._edges[at]

    def _light_from(self, slope: float, height: float, distance: float) -> bool:
        """Whether light gets to a pixel from either side."""
        return any(
            pixel_response(
                self.head,
                (side * slope * distance, height * distance, distance),
                self.sensor,
                wavelength=self.wavelength,
                rays=self.RAYS,
            ).any()
            for side in (-1, 1)
        )


@lru_cache(maxsize=8)
def _optics(head: OpticalSystem, sensor: LineSensor, wavelength: float) -> _Optics:
    return _Optics(head, sensor, wavelength)


def _electrons_per_joule(sensor: LineSensor, wavelength: float) -> float:
    response = sensor.response
    assert response is not None  # noqa: S101  # refused by World
    return float(response.quantum_efficiency(wavelength) / photon_energy(wavelength))
