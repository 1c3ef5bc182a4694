"""What a point source leaves on the sensor, paraxially.

A source sends light through the aperture that all elements leave open; behind the head it lies on a
rectangle, evenly. Neither aberrations nor losses at surfaces are in it: positions are those of
`studies.image_position`, widths those of `studies.beam_width` for the aperture that is really open.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from raytransfer import _checks as check
from raytransfer.sensors import TCD1304, LineSensor

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from raytransfer.lenses import Meridian
    from raytransfer.systems import OpticalSystem


class Footprint(NamedTuple):
    """Light of one source in one meridian.

    Parameters
    ----------
    pupil : tuple of float
        Lowest and highest ray at the first vertex that pass every element, mm.
    image : tuple of float
        Where the light begins and ends on the sensor, mm.
    """

    pupil: tuple[float, float]
    image: tuple[float, float]

    @property
    def centre(self) -> float:
        """Middle of the light on the sensor, mm."""
        return (self.image[0] + self.image[1]) / 2

    @property
    def width(self) -> float:
        """Full width on the sensor, mm."""
        return self.image[1] - self.image[0]


def footprint(
    system: OpticalSystem, meridian: Meridian, source_dist: float, axis_off: float
) -> Footprint | None:
    """Return where the light of a point source goes, or None if no ray passes every element.

    Parameters
    ----------
    system : OpticalSystem
        With a sensor_distance.
    meridian : {"x", "y"}
        x along the pixel line, y across it.
    source_dist, axis_off : float
        Source: distance before the first vertex (> 0) and offset in this meridian, mm.

    Raises
    ------
    ValueError
        If the system has no sensor, or the source is not before it.
    """
    if system.sensor_distance is None:
        raise ValueError(f"{system.name}: sensor_distance is needed to say where light lands")
    check.positive("source_dist", source_dist, "the source stands before the head")
    check.number("axis_off", axis_off)
    # two rays span all: heights anywhere are linear in the height at the first vertex
    start = np.array([[0.0, 1.0], [-axis_off / source_dist, (1.0 - axis_off) / source_dist]])
    _, path = system.trace(start, meridian)
    at_0 = path[:, 0, 0]
    slope = path[:, 0, 1] - at_0
    low, high = -np.inf, np.inf
    half = [element.aperture(meridian) / 2 for element in system.elements]
    for height, rise, limit in zip(at_0, slope, np.repeat(half, 2), strict=True):
        if rise == 0:
            if abs(height) > limit:
                return None
            continue
        ends = sorted(((-limit - height) / rise, (limit - height) / rise))
        low, high = max(low, ends[0]), min(high, ends[1])
    if not low < high:
        return None
    on_sensor = path[-1, 0] + system.sensor_distance * path[-1, 1]
    ends = sorted(on_sensor[0] + (on_sensor[1] - on_sensor[0]) * np.array([low, high]))
    return Footprint((float(low), float(high)), (float(ends[0]), float(ends[1])))


def pixel_solid_angles(
    system: OpticalSystem, position: tuple[float, float, float], sensor: LineSensor = TCD1304
) -> NDArray[np.float64]:
    """Solid angle of a point source's light that each pixel gets.

    Times the source's radiant intensity (W/sr) in the direction of the head, this is the power on a
    pixel.

    Parameters
    ----------
    system : OpticalSystem
    position : tuple of float
        Source: optical X along the pixel line, Y across it, and distance before the first vertex,
        mm. A source at or behind the first vertex gives darkness.
    sensor : LineSensor

    Returns
    -------
    ndarray, shape (pixels,)
        sr.
    """
    along, across, distance = position
    dark = np.zeros(sensor.pixels)
    if distance <= 0:
        return dark
    x = footprint(system, "x", distance, along)
    y = footprint(system, "y", distance, across)
    if x is None or y is None:
        return dark
    area = (x.pupil[1] - x.pupil[0]) * (y.pupil[1] - y.pupil[0])
    collected = area * distance / np.hypot(np.hypot(along, across), distance) ** 3
    edges = np.arange(sensor.pixels + 1, dtype=float) - sensor.pixels / 2
    half = sensor.pixel_height / 2
    on_line = _share(np.array([-half, half]), y)[0]
    return np.asarray(collected * on_line * _share(edges * sensor.pitch, x))


def _share(edges: NDArray[np.float64], light: Footprint) -> NDArray[np.float64]:
    """Which part of the light lies between neighbouring edges."""
    low, high = light.image
    # a perfect focus is a step; its middle still belongs to one pixel
    width = max(high - low, 1e-9)
    return np.diff(np.clip((edges - (low + high - width) / 2) / width, 0.0, 1.0))
