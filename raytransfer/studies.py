"""The thesis's design studies (sections 4.2.1 and 5.3): functions that print nothing.

A single quantity comes as a number, or an array for arrays, in the unit that the docstring names;
what has several parts comes as a dataclass that labels them.

All of it is paraxial. `lens_mat` is the matrix of what lies between light and sensor in the
meridian under study; `sensor_dist` is the distance in mm from its last vertex to the chip. Where
`sensor_dist` is None the sensor stands in the focus of whatever source is asked for, as the thesis
assumes; a real sensor stands still, which `sensor_dist` shows.

Room frame, mm: x along the line of LEDs, y away from it toward the tracker, LEDs on y = 0.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np

from raytransfer import _checks as check
from raytransfer.casting import cast_rays, cast_rays_to_focal_length
from raytransfer.lenses import CATALOGUE, Lens
from raytransfer.matrices import elements
from raytransfer.sensors import TCD1304, LineSensor
from raytransfer.systems import OpticalSystem, telecentric_pair

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import ArrayLike, NDArray

    from raytransfer.matrices import RayMatrix

FAR = 5000.0
"""The thesis's tracking distance, mm: the head is in focus here."""

NEAR = 500.0
"""The near distance of the thesis's studies, mm."""

THESIS_HALF_LENGTH = 14.55
"""Half the sensor's length as the thesis rounds it, mm; the pixels span 2 × 14.592."""


def image_position(
    lens_mat: RayMatrix | ArrayLike,
    source_dist: ArrayLike,
    axis_off: ArrayLike,
    sensor_dist: float | None = None,
) -> Any:
    """Where on the sensor a source is seen, in mm from the axis; the image is inverted.

    Parameters
    ----------
    lens_mat : RayMatrix or array_like, shape (2, 2)
    source_dist, axis_off : array_like
        Distance along the axis (> 0) and from it, mm.
    sensor_dist : float, optional
        In focus when left out; otherwise the middle of the beam on this plane.

    Returns
    -------
    float or ndarray of the broadcast shape of `source_dist` and `axis_off`
    """
    if sensor_dist is None:
        return cast_rays(1.0, lens_mat, source_dist, axis_off).focal_offset
    check.number("sensor_dist", sensor_dist)
    top, bottom = cast_rays_to_focal_length(1.0, lens_mat, source_dist, axis_off, sensor_dist)
    return (top + bottom) / 2


def beam_width(
    lens_width: float,
    lens_mat: RayMatrix | ArrayLike,
    source_dist: ArrayLike,
    sensor_dist: float,
) -> Any:
    """Width in mm of the light of a source on a sensor that is not in its focus (rows O3).

    Parameters
    ----------
    lens_width : float
        Full aperture, mm.
    lens_mat, source_dist, sensor_dist
        As for `image_position`. The offset of the source does not matter paraxially.
    """
    check.number("sensor_dist", sensor_dist)
    top, bottom = cast_rays_to_focal_length(lens_width, lens_mat, source_dist, 0.0, sensor_dist)
    return np.abs(top - bottom)


def lateral_resolution(
    lens_mat: RayMatrix | ArrayLike,
    source_dist: ArrayLike,
    pitch: float = TCD1304.pitch,
    sensor_dist: float | None = None,
) -> Any:
    """Sideways move of a source, in mm, that shifts its image by one pixel (row O9).

    Parameters
    ----------
    lens_mat, source_dist, sensor_dist
        As for `image_position`.
    pitch : float
        Pixel pitch, mm.
    """
    check.positive("pitch", pitch)
    return pitch / np.abs(image_position(lens_mat, source_dist, 1.0, sensor_dist))


def axial_resolution(
    lens_mat: RayMatrix | ArrayLike,
    source_dist: ArrayLike,
    baseline: ArrayLike,
    pitch: float = TCD1304.pitch,
    sensor_dist: float | None = None,
) -> Any:
    """Move along the axis, in mm, that changes the separation of two images by one pixel.

    Parameters
    ----------
    lens_mat, source_dist, pitch, sensor_dist
        As for `lateral_resolution`.
    baseline : array_like
        Distance between the two sources, mm, across the axis.
    """
    check.positive("pitch", pitch)
    _, b, c, d, det = elements(lens_mat)
    dist = check.positive_array("source_dist", source_dist)
    base = check.positive_array("baseline", baseline)
    # derivative of image_position per unit of offset with respect to the distance
    if sensor_dist is None:
        slope = np.abs(c * det) / (c * dist + d) ** 2
    else:
        check.number("sensor_dist", sensor_dist)
        slope = abs(b + sensor_dist * d) / dist**2
    return pitch / (base * slope)


def field_edge(
    lens_mat: RayMatrix | ArrayLike,
    source_dist: ArrayLike,
    half_length: float = TCD1304.length / 2,
    sensor_dist: float | None = None,
) -> Any:
    """Largest distance of a source from the axis, in mm, that is still seen (rows O6, O7).

    Parameters
    ----------
    lens_mat, source_dist, sensor_dist
        As for `image_position`.
    half_length : float
        Half the length of the pixel line, mm.
    """
    check.positive("half_length", half_length)
    return half_length / np.abs(image_position(lens_mat, source_dist, 1.0, sensor_dist))


def tracking_start(
    lens_mat: RayMatrix | ArrayLike,
    led_spacing: ArrayLike,
    half_length: float = TCD1304.length / 2,
    sensor_dist: float | None = None,
    leds: int = 2,
) -> Any:
    """Distance in mm from which on a long line of LEDs is tracked without gaps (row O8).

    Wherever the tracker is, at least `leds` of them are within the field where the field edge is
    `leds`/2 spacings away; for two LEDs that is one spacing. The field edge grows linearly with
    the distance, so the start is solved, not searched.

    Parameters
    ----------
    lens_mat, half_length, sensor_dist
        As for `field_edge`.
    led_spacing : array_like
        mm.
    leds : int
        How many LEDs must be seen.

    Raises
    ------
    ValueError
        If the system forms no real image.
    """
    check.positive("half_length", half_length)
    _, b, c, d, det = elements(lens_mat)
    if c >= 0:
        raise ValueError(f"C = {c:g}: a system without positive power forms no real image")
    edge = check.positive_array("led_spacing", led_spacing) * check.whole("leds", leds) / 2
    if sensor_dist is None:
        start = np.maximum(-(edge * det / half_length + d) / c, 0.0)
    else:
        check.number("sensor_dist", sensor_dist)
        start = edge / half_length * abs(b + sensor_dist * d)
    return start if np.ndim(start) else float(start)


def untracked_margin(
    lens_width: float,
    lens_mat: RayMatrix | ArrayLike,
    source_dist: ArrayLike,
    sensor_dist: float,
) -> Any:
    """How far a source may be above or below the axis, in mm, and still light the line (O10, O11).

    The pixel line is a point in this meridian: a source lights it as long as one of its rays
    through the front lens ends there. The last one to do so passes the edge of the lens.

    Parameters
    ----------
    lens_width : float
        Full aperture of the front lens, mm.
    lens_mat, source_dist, sensor_dist
        As for `image_position`, in the meridian across the line.
    """
    half = check.positive("lens_width", lens_width) / 2
    a, b, c, d, _ = elements(lens_mat)
    dist = check.positive_array("source_dist", source_dist)
    check.number("sensor_dist", sensor_dist)
    # the ray through the edge that ends on the axis arrives with the angle −half·(a + s c)/(b + s d)
    slope = (a + sensor_dist * c) / (b + sensor_dist * d)
    margin = np.abs(half * (1 + dist * slope))
    return margin if np.ndim(margin) else float(margin)


@dataclass(frozen=True)
class PairStudy:
    """What a pair of lenses does in a tracker; lengths in mm.

    Attributes
    ----------
    front, back : str
        Part numbers.
    effective_focal_length : float
    focus_far, focus_near : float
        Focus behind the last vertex for a source at the far and the near distance.
    beam_width : float
        Width on a sensor in the far focus of the light of a source at the near distance.
    field_edge : float
        Largest offset seen at the far distance.
    tracking_start : float
        Start of continuous tracking for the LED spacing.
    lateral_resolution : float
        Sideways move at the far distance that shifts the image one pixel.
    """

    front: str
    back: str
    effective_focal_length: float
    focus_far: float
    focus_near: float
    beam_width: float
    field_edge: float
    tracking_start: float
    lateral_resolution: float


def covers(lens: Lens, sensor: LineSensor) -> bool:
    """Whether a lens is convex and as high as the sensor is long."""
    return lens.radius > 0 and lens.height >= sensor.length


def lens_selection(
    lenses: Iterable[Lens] | None = None,
    *,
    far: float = FAR,
    near: float = NEAR,
    led_spacing: float = 500.0,
    gap: float = 0.0,
    sensor: LineSensor = TCD1304,
) -> tuple[PairStudy, ...]:
    """Study every pair of lenses, in both orders, shortest focal length first.

    Parameters
    ----------
    lenses : iterable of Lens, optional
        Left out: all of the catalogue that are convex and as high as the sensor is long.
    far, near : float
        Source distances, mm: the sensor stands in the focus of `far`.
    led_spacing : float
        mm.
    gap : float
        Air between the curved sides, mm.
    sensor : LineSensor
    """
    if lenses is None:
        lenses = [lens for lens in CATALOGUE.values() if covers(lens, sensor)]
        if not lenses:
            raise ValueError(
                f"no lens of the catalogue is as high as the {sensor.name} is long "
                f"({sensor.length:g} mm); give lenses="
            )
    lenses = list(lenses)
    for lens in lenses:
        if lens.radius < 0:
            raise ValueError(f"{lens.part} is concave: pairs of convex lenses are studied")
    half_length = sensor.length / 2
    rows = []
    for front, back in product(lenses, repeat=2):
        system = telecentric_pair(front, back, gap)
        matrix = system.matrix("x")
        focus_far, focus_near = cast_rays(front.height, matrix, [far, near], 0.0).focal_length
        rows.append(
            PairStudy(
                front=front.part,
                back=back.part,
                effective_focal_length=system.effective_focal_length("x"),
                focus_far=float(focus_far),
                focus_near=float(focus_near),
                beam_width=float(
                    beam_width(min(front.height, back.height), matrix, near, focus_far)
                ),
                field_edge=float(field_edge(matrix, far, half_length)),
                tracking_start=tracking_start(matrix, led_spacing, half_length),
                lateral_resolution=float(lateral_resolution(matrix, far, sensor.pitch)),
            )
        )
    return tuple(sorted(rows, key=lambda row: row.effective_focal_length))


def led_line(count: int, spacing: float) -> NDArray[Any]:
    """Room x of `count` LEDs, `spacing` mm apart, centred on 0."""
    check.whole("count", count)
    check.positive("spacing", spacing)
    return (np.arange(count) - (count - 1) / 2) * spacing


def room_to_optical(
    points: ArrayLike, x: ArrayLike, y: ArrayLike, heading: float = 0.0
) -> tuple[Any, Any]:
    """Where points of the room are as seen by a tracker: offset and distance.

    The tracker stands at (x, y); its optical axis looks along −y at heading 0 and turns
    counter-clockwise seen from above. Optical Z goes with the light (into the lens), X along the
    pixel line, Y up. With φ the heading, (X, Z) is the room vector from tracker to point times ::

        X   [ −cos φ   −sin φ ] x
        Z = [ −sin φ    cos φ ] y

    and a source's distance is −Z.

    Parameters
    ----------
    points : array_like, shape (N, 2)
        Room x and y in mm.
    x, y : array_like
        Tracker, mm; any shapes that broadcast.
    heading : float
        rad.

    Returns
    -------
    axis_off, source_dist : ndarray, shape (N,) + the broadcast shape of x and y
        Optical X and distance along the axis, mm; the distance is negative behind the tracker.
    """
    points = check.array("points", points)
    if points.ndim != 2 or points.shape[1] != 2:
        raise ValueError(f"points has shape (N, 2), not {points.shape}")
    x, y = np.broadcast_arrays(check.array("x", x), check.array("y", y))
    shape = (-1,) + (1,) * x.ndim
    dx = points[:, 0].reshape(shape) - x
    dy = points[:, 1].reshape(shape) - y
    sin, cos = np.sin(check.number("heading", heading)), np.cos(heading)
    return -cos * dx - sin * dy, sin * dx - cos * dy


def _positions_of(leds: ArrayLike) -> NDArray[np.float64]:
    """Return (N, 2) room points; a flat list is a line on y = 0."""
    points = check.array("leds", leds)
    if points.ndim == 1:
        points = np.stack([points, np.zeros_like(points)], axis=1)
    if points.ndim != 2 or points.shape[1] != 2 or not len(points):
        raise ValueError(f"leds has shape (N,) or (N, 2), not {points.shape}")
    return points


@dataclass(frozen=True)
class AreaMap:
    """What a tracker sees on a grid of room positions (figure 4.1).

    Attributes
    ----------
    x, y : ndarray, shapes (W,) and (H,)
        The grid, mm.
    leds : ndarray, shape (N, 2)
        LEDs, mm.
    position : ndarray, shape (N, H, W)
        Where on the sensor each is imaged, mm from the axis; infinite where it forms no image.
    half_length : float
        Half the length of the pixel line, mm.
    """

    x: NDArray[np.float64]
    y: NDArray[np.float64]
    leds: NDArray[np.float64]
    position: NDArray[np.float64]
    half_length: float

    @property
    def visible(self) -> NDArray[np.bool_]:
        """Whether an LED's image lies on the pixels, shape (N, H, W)."""
        return np.abs(self.position) <= self.half_length

    @property
    def count(self) -> NDArray[np.intp]:
        """How many LEDs are seen, shape (H, W)."""
        count: NDArray[np.intp] = self.visible.sum(axis=0)
        return count

    def tracked(self, leds: int = 2) -> NDArray[np.bool_]:
        """Where at least `leds` are seen, shape (H, W)."""
        return self.count >= leds


@dataclass(frozen=True)
class ResolutionMap(AreaMap):
    """An `AreaMap` with what one pixel means there; NaN where fewer than two LEDs are seen.

    Attributes
    ----------
    lateral : ndarray, shape (H, W)
        Sideways move per pixel, mm, for the middle of the LEDs that are seen.
    axial : ndarray, shape (H, W)
        Move along the axis per pixel of separation of the outermost LEDs that are seen, mm;
        infinite where these are in one direction.
    """

    lateral: NDArray[np.float64]
    axial: NDArray[np.float64]


def tracking_area(
    lens_mat: RayMatrix | ArrayLike,
    leds: ArrayLike,
    x: ArrayLike,
    y: ArrayLike,
    *,
    heading: float = 0.0,
    half_length: float = TCD1304.length / 2,
    sensor_dist: float | None = None,
) -> AreaMap:
    """Map which LEDs land on the sensor, for a tracker at every point of a grid.

    Parameters
    ----------
    lens_mat, half_length, sensor_dist
        As for `field_edge`.
    leds : array_like, shape (N,) or (N, 2)
        Room x on the line y = 0 (`led_line` makes one), or room x and y, mm.
    x, y : array_like, shapes (W,) and (H,)
        Tracker positions, mm: of the first lens vertex.
    heading : float
        rad, 0 looks straight at the line.
    """
    return _map(lens_mat, leds, x, y, heading, half_length, sensor_dist)[0]


def _map(
    lens_mat: RayMatrix | ArrayLike,
    leds: ArrayLike,
    x: ArrayLike,
    y: ArrayLike,
    heading: float,
    half_length: float,
    sensor_dist: float | None,
) -> tuple[AreaMap, NDArray[np.float64], NDArray[np.float64]]:
    """Return the map, and each LED's offset and distance from each grid point, mm."""
    check.positive("half_length", half_length)
    points = _positions_of(leds)
    x, y = np.atleast_1d(check.array("x", x)), np.atleast_1d(check.array("y", y))
    for name, grid in (("x", x), ("y", y)):
        if grid.ndim != 1:
            raise ValueError(f"{name} has shape (N,), not {grid.shape}; the grid is made from both")
    axis_off, source_dist = room_to_optical(points, x[None, :], y[:, None], heading)
    ahead = source_dist > 0
    dist = np.where(ahead, source_dist, 1.0)
    position = image_position(lens_mat, dist, axis_off, sensor_dist)
    if sensor_dist is None:  # a source within the front focal length has no real image
        focus = cast_rays(1.0, lens_mat, dist, 0.0).focal_length
        ahead &= (focus > 0) & np.isfinite(focus)
    area = AreaMap(x, y, points, np.where(ahead, position, np.inf), half_length)
    return area, axis_off, source_dist


def resolution_map(
    lens_mat: RayMatrix | ArrayLike,
    leds: ArrayLike,
    x: ArrayLike,
    y: ArrayLike,
    *,
    heading: float = 0.0,
    sensor: LineSensor = TCD1304,
    sensor_dist: float | None = None,
) -> ResolutionMap:
    """Map what one pixel means in mm, over the area in which at least two LEDs are seen.

    Parameters
    ----------
    lens_mat, leds, x, y, heading, sensor_dist
        As for `tracking_area`.
    sensor : LineSensor
        Its length and pitch are used.
    """
    half_length = sensor.length / 2
    area, axis_off, source_dist = _map(lens_mat, leds, x, y, heading, half_length, sensor_dist)
    visible, count = area.visible, area.count
    enough = count >= 2
    low = np.where(visible, axis_off, np.inf).min(axis=0)
    high = np.where(visible, axis_off, -np.inf).max(axis=0)
    baseline = np.where(enough, high, 1.0) - np.where(enough, low, 0.0)
    total = np.where(visible, source_dist, 0.0).sum(axis=0)
    middle = np.where(enough, total / np.maximum(count, 1), 1.0)
    lateral = lateral_resolution(lens_mat, middle, sensor.pitch, sensor_dist)
    apart = baseline > 0  # images that coincide say nothing about the distance
    safe = np.where(apart, baseline, 1.0)
    axial = axial_resolution(lens_mat, middle, safe, sensor.pitch, sensor_dist)
    return ResolutionMap(
        area.x,
        area.y,
        area.leds,
        area.position,
        half_length,
        lateral=np.where(enough, lateral, np.nan),
        axial=np.where(enough, np.where(apart, axial, np.inf), np.nan),
    )


@dataclass(frozen=True)
class PlateEffect:
    """What the glass plates between pair and sensor do to the focus; mm.

    Attributes
    ----------
    sensor_dist : float
        From the head's last vertex to the chip.
    focus_without, focus_with : float
        Focus behind the last vertex with the plates left out, as in the thesis, and with them.
    width_without, width_with : float
        Width of the beam on the chip in the two cases.
    """

    sensor_dist: float
    focus_without: float
    focus_with: float
    width_without: float
    width_with: float

    @property
    def shift(self) -> float:
        """How far the plates move the focus back, mm."""
        return self.focus_with - self.focus_without


def plate_effect(
    head: OpticalSystem, source_dist: float = FAR, lens_width: float = 30.0
) -> PlateEffect:
    """Compare the focus along the pixel line without and with the glass that has no power there.

    Parameters
    ----------
    head : OpticalSystem
        With a sensor_distance, such as `prototype_head()`.
    source_dist : float
        From the source to the head's first vertex, mm.
    lens_width : float
        Full aperture, mm.
    """
    if head.sensor_distance is None:
        raise ValueError(f"{head.name}: no sensor_distance, so nothing says where the chip is")
    results = []
    for plates in (False, True):
        matrix = head.matrix("x", plates=plates)
        focus = cast_rays(lens_width, matrix, source_dist, 0.0).focal_length
        width = beam_width(lens_width, matrix, source_dist, head.sensor_distance)
        results.append((float(focus), float(width)))
    (focus_without, width_without), (focus_with, width_with) = results
    return PlateEffect(head.sensor_distance, focus_without, focus_with, width_without, width_with)
