"""The room around the prototype: LEDs, where the tracker is, ambient light.

Room frame, mm: x along the line of LEDs, y away from it toward the tracker, z up from the tracker's
height. `World.rates` is the one place where light becomes electrons; rays are exact.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from acquisition.frames import CHANNELS
from raytransfer import TCD1304, OpticalSystem, prototype_head
from raytransfer import _checks as check
from raytransfer.irradiance import LightTable, disc, disc_points, photon_energy, pixel_response
from raytransfer.studies import room_to_optical

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from raytransfer import LineSensor

LUMINOUS_EFFICACY = 683.0  # lm/W at 555 nm
CLOSEST = 20.0  # mm from the first vertex: nearer ones are not seen


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
        if not 0 <= self.channel < CHANNELS:
            raise ValueError(f"LED channel = {self.channel}: allowed are 0 to {CHANNELS - 1}")
        if len(self.position) != 3:
            raise ValueError(f"LED position = {self.position}: room x, y and z in mm are needed")
        for axis, value in zip("xyz", self.position, strict=True):
            check.number(f"{axis} of LED {self.channel}", value, "room coordinates in mm")
        check.not_negative("power", self.power, "W")
        check.positive("wavelength", self.wavelength, "µm")
        if self.wavelength > 20:
            raise ValueError(f"wavelength = {self.wavelength:g} µm: was it given in nm?")
        check.number("facing", self.facing)
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
    """Where the tracker is: x, y in mm, heading in rad, 0 looking along −y, counter-clockwise."""

    x: float
    y: float
    heading: float = 0.0

    def __post_init__(self) -> None:
        for name in ("x", "y", "heading"):
            check.number(name, getattr(self, name))


Trajectory = Callable[[float], Pose]
"""Where the tracker is at a (virtual) time in s."""


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
    """

    leds: Sequence[Led] = field(default_factory=two_leds)
    tracker: Pose | Trajectory = Pose(0.0, 1300.0)
    ambient: float = 0.0
    head: OpticalSystem = field(default_factory=prototype_head)
    sensor: LineSensor = TCD1304

    def __post_init__(self) -> None:
        object.__setattr__(self, "leds", tuple(self.leds))
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
        """Whether light depends on time."""
        return not isinstance(self.tracker, Pose)

    def pose(self, seconds: float = 0.0) -> Pose:
        """Where the tracker is."""
        return self.tracker if isinstance(self.tracker, Pose) else self.tracker(seconds)

    def seen_from(self, led: Led, pose: Pose) -> tuple[float, float, float]:
        """Return the LED's optical X, Y and distance from a pose, mm."""
        point = np.array([led.position[:2]])
        along, distance = room_to_optical(point, pose.x, pose.y, pose.heading)
        return float(along[0]), led.position[2], float(distance[0])

    def ambient_rate(self) -> float:
        """Electrons per second that ambient light brings to a pixel."""
        area = self.sensor.pitch * self.sensor.pixel_height * 1e-6  # m²
        return self.ambient / LUMINOUS_EFFICACY * area * self._electrons_per_joule(0.555)

    def rates(self, seconds: float = 0.0) -> NDArray[np.float64]:
        """Electrons per second in every pixel from every channel's LED while it is lit.

        Returns
        -------
        ndarray, shape (64, pixels)
        """
        rates = np.zeros((CHANNELS, self.sensor.pixels))
        pose = self.pose(seconds)
        solid_angles = _from_table if self.moving else _traced
        for led in self.leds:
            place = self.seen_from(led, pose)
            if place[2] <= CLOSEST:
                continue  # behind the tracker, or in its lenses
            intensity = led.intensity(pose.x, pose.y, 0.0)
            rate = intensity * self._electrons_per_joule(led.wavelength)
            points = disc_points(self.head, led.extent, place[2], self.sensor)
            for point, share in disc(place, led.extent, points):
                angles = solid_angles(self.head, self.sensor, led.wavelength, point)
                rates[led.channel] += rate * share * angles
        return rates

    def _electrons_per_joule(self, wavelength: float) -> float:
        response = self.sensor.response
        assert response is not None  # noqa: S101  # refused by __post_init__
        return float(response.quantum_efficiency(wavelength) / photon_energy(wavelength))


def _traced(
    head: OpticalSystem, sensor: LineSensor, wavelength: float, place: tuple[float, float, float]
) -> NDArray[np.float64]:
    return pixel_response(head, place, sensor, wavelength=wavelength)


def _from_table(
    head: OpticalSystem, sensor: LineSensor, wavelength: float, place: tuple[float, float, float]
) -> NDArray[np.float64]:
    return _table(head, sensor, wavelength).solid_angles(place)


@lru_cache(maxsize=8)
def _table(head: OpticalSystem, sensor: LineSensor, wavelength: float) -> LightTable:
    return LightTable(head, sensor, wavelength=wavelength)
