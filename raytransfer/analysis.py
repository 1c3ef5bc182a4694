"""What lens designers read off exact rays: spots, widths, distortion, vignetting, focus.

Beside each stands the paraxial answer. A *fan* is light in one meridian, a *spot* that of the whole
opening; behind the last surface rays are straight, so one trace knows every place of the sensor.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np

from raytransfer import _checks as check
from raytransfer.illumination import footprint
from raytransfer.irradiance import RAYS, pixel_response
from raytransfer.lenses import Meridian, check_meridian
from raytransfer.materials import D_LINE
from raytransfer.prescription import surface_frames
from raytransfer.reference import path
from raytransfer.sensors import TCD1304, LineSensor
from raytransfer.studies import image_position
from raytransfer.systems import MERIDIANS
from raytransfer.tracing import Status, Trace, bundle, front_opening, trace

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import ArrayLike, NDArray

    from raytransfer.systems import OpticalSystem

    Array = NDArray[np.float64]

LOSSES = (Status.MISSED, Status.BLOCKED, Status.REFLECTED)
"""The kinds of loss, in the order in which `Spot.lost` has them."""

Width = Literal["rms", "fwhm", "w50", "w80", "full"]
"""The measures of a width, as `Profile` names them."""

WIDTHS = {
    "rms": "RMS width",
    "fwhm": "FWHM",
    "w50": "width that holds 50 %",
    "w80": "width that holds 80 %",
    "full": "full width",
}
"""The same in words."""


class Profile(NamedTuple):
    """Where light is along a line, and how wide: numbers, or arrays of one shape; mm.

    NaN where there is no light.

    Attributes
    ----------
    peak : ndarray
        Middle of the brightest pixel. Near a caustic the irradiance of rays has no upper bound,
        so that a peak has a meaning only for a pixel of some size.
    centroid, median : ndarray
    rms : ndarray
        Root mean square distance from the centroid. A few rays that leave far aside decide it.
    fwhm : ndarray
        Between the outermost pixels that have half the peak or more, theirs included.
    w50, w80 : ndarray
        Shortest interval that holds 50 % or 80 % of the light.
    full : ndarray
        From the first ray to the last.
    """

    peak: Any
    centroid: Any
    median: Any
    rms: Any
    fwhm: Any
    w50: Any
    w80: Any
    full: Any


def profile(x: ArrayLike, weight: ArrayLike, pitch: float = TCD1304.pitch) -> Profile:
    """Measure light that arrives at points of a line.

    Parameters
    ----------
    x, weight : array_like, shape (..., N)
        Places in mm and how much light there is, ≥ 0, one distribution per row.
    pitch : float
        Size in mm of the pixels for peak and fwhm; an edge between two is at 0.

    Returns
    -------
    Profile
        Of shape (...).

    Raises
    ------
    ValueError
        If a place or a weight is not finite, or a weight is below 0.
    """
    check.positive("pitch", pitch)
    x, weight = check.array("x", x), check.array("weight", weight)
    if weight.size and weight.min() < 0:
        raise ValueError(
            f"weight = {weight.min():g}: allowed is >= 0, it is how much light there is; "
            "was a background subtracted?"
        )
    x, weight = np.broadcast_arrays(x, weight)
    shape, rays = x.shape[:-1], x.shape[-1]
    if not rays:
        return Profile(*(np.full(shape, np.nan)[()] for _ in Profile._fields))
    x, weight = x.reshape(-1, rays), weight.reshape(-1, rays)
    total = weight.sum(axis=1)
    result = np.full((len(Profile._fields), len(x)), np.nan)
    lit = total > 0
    if lit.any():
        result[:, lit] = _measured(x[lit], weight[lit] / total[lit, None], pitch)
    return Profile(*(row.reshape(shape)[()] for row in result))


def _measured(x: Array, share: Array, pitch: float) -> Array:
    """Return the numbers of `Profile` as rows, for distributions with some light in each."""
    rows = np.arange(len(x))[:, None]
    centroid = (share * x).sum(axis=1)
    rms = np.sqrt((share * (x - centroid[:, None]) ** 2).sum(axis=1))
    order = np.argsort(np.where(share > 0, x, np.inf), axis=1)  # what is dark comes last
    at, light = np.take_along_axis(x, order, 1), np.take_along_axis(share, order, 1)
    last = (light > 0).sum(axis=1) - 1
    high = np.take_along_axis(at, last[:, None], 1)
    at = np.where(light > 0, at, high)
    upto = np.cumsum(light, axis=1)
    upto /= upto[:, -1:]
    # all rows in one search: row r holds the shares r·2 … r·2 + 1
    flat = (upto + 2 * rows).ravel()

    def index(share_upto: Array) -> NDArray[np.intp]:
        found = np.searchsorted(flat, (share_upto + 2 * rows).ravel()).reshape(share_upto.shape)
        return np.asarray(np.minimum(found - rows * at.shape[1], at.shape[1] - 1))

    def shortest(part: float) -> Array:
        before = upto - light / upto[:, -1:]
        enough = before + part - 1e-12 <= 1.0
        end = index(np.where(enough, before + part - 1e-12, 0.5))
        lengths = np.take_along_axis(at, end, 1) - at
        return np.asarray(np.where(enough, lengths, np.inf).min(axis=1))

    median = np.take_along_axis(at, index(np.full((len(x), 1), 0.5)), 1)[:, 0]
    peak, fwhm = _brightest(at, light, median, pitch)
    full = high[:, 0] - at[:, 0]
    return np.stack([peak, centroid, median, rms, fwhm, shortest(0.5), shortest(0.8), full])


def _brightest(at: Array, light: Array, median: Array, pitch: float) -> tuple[Array, Array]:
    """Return peak and fwhm of light on pixels, looked for within 4096 of them around the median."""
    half = 2048
    rows = np.arange(len(at))[:, None]
    first = np.floor(median[:, None] / pitch) - half
    pixel = np.floor(at / pitch) - first
    near = (pixel >= 0) & (pixel < 2 * half)
    slot = (pixel + 2 * half * rows)[near].astype(np.intp)
    pixels = np.bincount(slot, light[near], 2 * half * len(at)).reshape(len(at), -1)
    top = pixels.argmax(axis=1)
    bright = pixels >= pixels.max(axis=1, keepdims=True) / 2
    across = 2 * half - bright[:, ::-1].argmax(axis=1) - bright.argmax(axis=1)
    return (first[:, 0] + top + 0.5) * pitch, across * pitch


@dataclass(frozen=True)
class Spot:
    """The light of one point source on the sensor's plane, as rays.

    Attributes
    ----------
    position : tuple of float
        Source: X, Y and distance before the first vertex, mm.
    x, y : ndarray, shape (N,)
        Where they arrive, in the frame of the sensor, mm.
    slope : ndarray, shape (2, N)
        dx/dz and dy/dz there.
    weight : ndarray, shape (N,)
        Solid angle times transmission, sr; of a fan, sr per mm of the opening across it.
    entered : float
        The same for all light that enters the first glass. What falls beside it is not counted.
    lost : ndarray, shape (S + 1, 3)
        Of it, what does not arrive: at which surface (last: the sensor's plane) and why, see
        `LOSSES`.
    faded : float
        Of it, what surfaces reflect of the rays that arrive: solid angle times (1 − transmission).
        A lost ray counts in `lost` with all of its light, also what surfaces before the loss had
        reflected, and has no part in this.
    """

    position: tuple[float, float, float]
    x: Array
    y: Array
    slope: Array
    weight: Array
    entered: float
    lost: Array
    faded: float

    @property
    def arrived(self) -> float:
        """Share of the light that entered, 0 to 1, that arrives on the sensor's plane."""
        return float(self.weight.sum()) / self.entered if self.entered else 0.0

    def lost_share(self, *kinds: Status) -> float:
        """Share of the light that entered and is lost on the way, by one, several or all kinds."""
        columns = [LOSSES.index(kind) for kind in kinds or LOSSES]
        return float(self.lost[:, columns].sum()) / self.entered if self.entered else 0.0

    def on(self, sensor: LineSensor = TCD1304) -> float:
        """Share of the light on the sensor's plane that is within the length of its line."""
        total = float(self.weight.sum())
        return float(self.weight[np.abs(self.x) <= sensor.length / 2].sum()) / total if total else 0

    def at(self, shift: float) -> Spot:
        """Return the spot on a plane `shift` mm behind that of the sensor."""
        check.number("shift", shift, "mm from the sensor, > 0 away from the lenses")
        dx, dy = shift * self.slope
        return replace(self, x=self.x + dx, y=self.y + dy)

    def profile(self, meridian: Meridian = "x", pitch: float = TCD1304.pitch) -> Profile:
        """Measure it along the pixel line or across it."""
        check_meridian("meridian", meridian)
        return profile(self.x if meridian == "x" else self.y, self.weight, pitch)

    def best_focus(
        self,
        width: Width = "rms",
        meridian: Meridian = "x",
        within: tuple[float, float] = (-15, 10),
    ) -> tuple[float, float]:
        """Find the plane in which the light is narrowest.

        Parameters
        ----------
        width : {"rms", "fwhm", "w50", "w80", "full"}
            What is to be small. The plane of the least rms is solved for, that of the others is
            searched in 200 steps, then more closely around the best of them.
        meridian : {"x", "y"}
        within : tuple of float
            Range of the search, mm behind the sensor.

        Returns
        -------
        shift, size : float
            From the sensor, > 0 behind it, and the width there; mm.

        Raises
        ------
        ValueError
            If no light arrives, or all rays are parallel, or the width is not one of these.
        """
        check_meridian("meridian", meridian)
        if width not in WIDTHS:
            raise ValueError(f"width = {width!r}: allowed are {', '.join(WIDTHS)}")
        if not self.weight.any():
            raise ValueError("no light arrives, so there is no focus")
        here, slope = (self.x, self.slope[0]) if meridian == "x" else (self.y, self.slope[1])
        if width == "rms":
            share = self.weight / self.weight.sum()
            rise = slope - (share * slope).sum()
            spread = (share * rise**2).sum()
            if spread == 0:
                raise ValueError("the rays are parallel, so there is no focus")
            shift = -float((share * here * rise).sum() / spread)
            return shift, float(profile(here + shift * slope, self.weight).rms)
        low, high = within
        for steps in (200, 40, 40):
            shifts = np.linspace(low, high, steps + 1)
            sizes = [
                float(getattr(profile(here + shift * slope, self.weight), width))
                for shift in shifts
            ]
            best = int(np.argmin(sizes))
            step = (high - low) / steps
            low, high = shifts[best] - step, shifts[best] + step
        return float(shifts[best]), sizes[best]


def through_focus(spot: Spot, shifts: ArrayLike, meridian: Meridian = "x") -> Profile:
    """Measure a spot on planes before and behind the sensor.

    Parameters
    ----------
    spot : Spot
    shifts : array_like, shape (K,)
        mm, > 0 behind the sensor.
    meridian : {"x", "y"}

    Returns
    -------
    Profile
        Arrays of shape (K,).
    """
    check_meridian("meridian", meridian)
    shifts = np.atleast_1d(check.array("shifts", shifts))[:, None]
    here, slope = (spot.x, spot.slope[0]) if meridian == "x" else (spot.y, spot.slope[1])
    return profile(here + shifts * slope, spot.weight)


def fan(
    system: OpticalSystem,
    meridian: Meridian,
    source_dist: float,
    axis_off: float,
    *,
    rays: int = 20_001,
    wavelength: float = D_LINE,
    fresnel: bool = True,
) -> Spot:
    """Trace light in the plane through the axis that holds the source.

    Parameters
    ----------
    system : OpticalSystem
        With a sensor_distance.
    meridian : {"x", "y"}
    source_dist, axis_off : float
        Distance of the source before the first vertex, and from the axis in this meridian, mm.
    rays : int
        Evenly over the front opening.
    wavelength : float
        µm.
    fresnel : bool
        Whether surfaces reflect a part.
    """
    check_meridian("meridian", meridian)
    dist = np.array([check.positive("source_dist", source_dist, "it stands before the head")])
    source = _sources(meridian, dist, np.array([check.number("axis_off", axis_off)]))
    position, direction, weight = _fan_rays(system, meridian, source, rays)
    place: tuple[float, float, float] = tuple(source[:, 0].tolist())
    return _spot(system, place, position, direction, weight, wavelength, fresnel)


def spot(
    system: OpticalSystem,
    position: tuple[float, float, float],
    nx: int = 501,
    ny: int = 501,
    *,
    wavelength: float = D_LINE,
    fresnel: bool = True,
) -> Spot:
    """Trace the light of a point source through the whole opening: a spot diagram.

    Parameters
    ----------
    system : OpticalSystem
        With a sensor_distance.
    position : tuple of float
        Source: X, Y, and distance before the first vertex, mm.
    nx, ny : int
        Rays over the front opening.
    wavelength, fresnel
        As for `fan`.
    """
    rays = bundle(system, position, nx, ny)
    return _spot(
        system, position, rays.position, rays.direction, rays.solid_angle, wavelength, fresnel
    )


def line_profile(
    system: OpticalSystem,
    position: tuple[float, float, float],
    sensor: LineSensor = TCD1304,
    *,
    rays: tuple[int, int] = RAYS,
    wavelength: float = D_LINE,
) -> Profile:
    """Measure the light of a point source that lands on the pixels themselves.

    A `spot` holds all light on the sensor's plane; the line is 0.2 mm of it, and what passes there
    went through a narrow strip of the opening.

    Parameters
    ----------
    system, position, sensor, rays, wavelength
        As for `irradiance.pixel_response`.
    """
    response = pixel_response(system, position, sensor, wavelength=wavelength, rays=rays)
    parts = 8  # of a pixel, lit evenly
    within = (np.arange(parts) + 0.5) / parts - 0.5
    at = sensor.position((np.arange(sensor.pixels)[:, None] + within).ravel())
    return profile(at, np.repeat(response, parts), sensor.pitch)


def stop_surface(system: OpticalSystem, meridian: Meridian = "x") -> int:
    """Return the surface through whose middle chief rays pass, counted from 0 through all elements.

    It is the first screen that is narrower than infinite in this meridian; without one, the curved
    side of the first lens that bends it: in a pair with curved sides facing, the point where they
    meet, through which rays leave as they came.
    """
    surfaces = [surface for surface, _, _ in surface_frames(system)]
    axis = MERIDIANS.index(meridian)
    for number, surface in enumerate(surfaces):
        if surface.screen and np.isfinite(surface.half[axis]):
            return number
    for number, surface in enumerate(surfaces):
        if meridian in surface.bends:
            return number
    return 0


def chief_rays(
    system: OpticalSystem,
    position: ArrayLike,
    *,
    stop: int | None = None,
    on_line: bool = False,
    wavelength: float = D_LINE,
) -> tuple[Any, Any]:
    """Where the chief rays of point sources land: those through the middle of the stop.

    Parameters
    ----------
    system : OpticalSystem
        With a sensor_distance.
    position : array_like, shape (3,) or (3, N)
        Sources: X, Y, and distance before the first vertex, mm.
    stop : int, optional
        A surface; left out, that of `stop_surface`.
    on_line : bool
        Take the ray that passes the middle of the stop along X only, and that ends on the pixel
        line: where the lenses across the line do not image, most light never comes near it.
    wavelength : float
        µm.

    Returns
    -------
    x, y : float, or ndarray of shape (N,)
        On the sensor, mm; NaN where that ray is lost.
    """
    places = check.array("position", position)
    single = places.ndim == 1
    places = places.reshape(len(places), -1)
    if len(places) != 3:
        raise ValueError(f"position has shape (3,) or (3, N), not {np.shape(position)}")
    check.positive_array("distance of the source", places[2], "it stands before the first vertex")
    _require_sensor(system)
    number = stop_surface(system) if stop is None else stop
    frames = surface_frames(system)
    if not 0 <= number < len(frames):
        raise ValueError(f"stop = {number}: {system.name} has the surfaces 0 to {len(frames) - 1}")
    _, rotation, vertex = frames[number]
    turn, middle = system.places()[-1]
    start = places * np.array([[1.0], [1.0], [-1.0]])

    def miss(aim: Array) -> Array:
        """How far beside stop (and line) the rays pass that are aimed at z = 0; shape (2, …)."""
        source = np.tile(start, aim.shape[1] // start.shape[1])
        points = path(system, source, np.vstack([aim, 0 * aim[:1]]) - source, wavelength=wavelength)
        at_stop = rotation.T @ (points[number + 1] - vertex[:, None])
        if on_line:
            return np.stack([at_stop[0], (turn.T @ (points[-1] - middle[:, None]))[1]])
        return np.asarray(at_stop[:2])

    count = start.shape[1]
    aim = start[:2] + (vertex[:2, None] - start[:2]) * (start[2] / (start[2] - vertex[2]))
    step = 1e-3
    along, up = np.array([[[step], [0.0]], [[0.0], [step]]])
    for _ in range(12):  # Newton's method, with differences for the derivative
        three = miss(np.concatenate([aim, aim + along, aim + up], axis=1))
        here, right, above = np.split(three, 3, axis=1)
        (a, c), (b, d) = (right - here) / step, (above - here) / step
        det = a * d - b * c
        det = np.where(det == 0, np.inf, det)  # lost: stay
        move = np.stack([d * here[0] - b * here[1], a * here[1] - c * here[0]]) / det
        aim = aim - move
        if np.abs(move).max(initial=0.0) < 1e-10:
            break
    toward = np.vstack([aim, np.zeros((1, count))]) - start
    light = trace(system, start, toward, wavelength=wavelength, fresnel=False)
    found = light.arrived & (np.abs(miss(aim)).max(axis=0) < 1e-7)
    x, y = (np.where(found, values, np.nan) for values in (light.x, light.y))
    return (float(x[0]), float(y[0])) if single else (x, y)


@dataclass(frozen=True)
class FieldStudy:
    """Exact and paraxial answers, side by side, over distances and offsets in one meridian; mm.

    All arrays have the broadcast shape of `source_dist` and `axis_off`. Shares are 0 to 1.

    Attributes
    ----------
    source_dist, axis_off : ndarray
    paraxial : ndarray
        Where paraxial light of the source is centred on the sensor (`studies.image_position`).
    image_point : ndarray
        Offset of the paraxial focus, before or behind the sensor (`cast_rays`).
    f_tan : ndarray
        −f tan θ, as a lens without distortion images directions from far away.
    paraxial_width : ndarray
        Full width of the paraxial light that passes all elements (`illumination.footprint`).
    chief : ndarray
        See `chief_rays`.
    light : Profile
        Exact; arrays.
    missed, blocked, reflected : ndarray
        Share of the light that entered that is lost: past a surface, outside an opening, and by
        total reflection.
    faded : ndarray
        Share of the light that entered that surfaces reflect of the rays that arrive, see `Spot`.
    arrived : ndarray
        Share of the light that entered that arrives on the sensor's plane: what is neither lost
        nor faded.
    on_sensor : ndarray
        Share of the light on the sensor's plane that is within the length of the line.
    """

    source_dist: Array
    axis_off: Array
    paraxial: Array
    image_point: Array
    f_tan: Array
    paraxial_width: Array
    chief: Array
    light: Profile
    missed: Array
    blocked: Array
    reflected: Array
    faded: Array
    arrived: Array
    on_sensor: Array

    @property
    def angle(self) -> Array:
        """Field angle, rad."""
        return np.asarray(np.arctan2(self.axis_off, self.source_dist))

    @property
    def lost(self) -> Array:
        """Share of the light that entered with rays that do not arrive: lost on the way."""
        return self.missed + self.blocked + self.reflected

    @property
    def useful(self) -> Array:
        """Share of the light that entered and arrives within the length of the line."""
        return self.arrived * self.on_sensor

    def distortion(self, estimator: str = "chief", reference: str = "paraxial") -> Array:
        """How far light is from where it should be, mm; > 0 is toward positive X.

        Parameters
        ----------
        estimator : {"chief", "peak", "median", "centroid"}
        reference : {"paraxial", "image_point", "f_tan"}
        """
        for name, value, allowed in (
            ("estimator", estimator, ("chief", "peak", "median", "centroid")),
            ("reference", reference, ("paraxial", "image_point", "f_tan")),
        ):
            if value not in allowed:
                raise ValueError(f"{name} = {value!r}: allowed are {', '.join(allowed)}")
        found = self.chief if estimator == "chief" else getattr(self.light, estimator)
        return np.asarray(found - getattr(self, reference))


def field_study(
    system: OpticalSystem,
    source_dist: ArrayLike,
    axis_off: ArrayLike,
    meridian: Meridian = "x",
    *,
    rays: int = 4001,
    wavelength: float = D_LINE,
    sensor: LineSensor = TCD1304,
) -> FieldStudy:
    """Trace a fan from every source of a grid, and compare with the paraxial answers.

    Parameters
    ----------
    system : OpticalSystem
        With a sensor_distance.
    source_dist, axis_off : array_like
        Distances before the first vertex and offsets in this meridian, mm; they broadcast.
    meridian : {"x", "y"}
    rays : int
        Per source. Peaks and the narrowest widths want 20,000.
    wavelength : float
        µm, of the paraxial answers, too; but `paraxial_width` is that of the d line.
    sensor : LineSensor

    Raises
    ------
    ValueError
        If the system has no sensor, or a source is not before it.
    """
    check_meridian("meridian", meridian)
    sensor_dist = _require_sensor(system)
    dist, off = np.broadcast_arrays(
        check.positive_array("source_dist", source_dist, "sources stand before the head"),
        check.array("axis_off", axis_off),
    )
    shape = dist.shape
    sources = _sources(meridian, dist.ravel(), off.ravel())
    per_call = max(1, 1_000_000 // check.whole("rays", rays))
    lights, shares, on_sensor = [], [], []
    for start in range(0, sources.shape[1], per_call):
        part = sources[:, start : start + per_call]
        position, direction, solid_angle = _fan_rays(system, meridian, part, rays)
        light = trace(system, position, direction, wavelength=wavelength)
        at = (light.x if meridian == "x" else light.y).reshape(-1, rays)
        weight = solid_angle * light.transmission
        weight = weight.reshape(-1, rays)
        lights.append(profile(at, weight, sensor.pitch))
        never = _beside(system, light)
        entered = np.where(never, 0.0, solid_angle).reshape(-1, rays)
        status = np.where(never, Status.ARRIVED, light.status).reshape(-1, rays)
        total = np.maximum(entered.sum(axis=1), 1e-300)
        faded = solid_angle * np.where(light.arrived, 1 - light.transmission, 0.0)
        parts = [entered * (status == kind) for kind in LOSSES]
        parts += [faded.reshape(-1, rays), weight]
        shares.append([part.sum(axis=1) / total for part in parts])
        within = np.abs(at) <= sensor.length / 2
        on_plane = np.maximum(weight.sum(axis=1), 1e-300)
        on_sensor.append((weight * within).sum(axis=1) / on_plane)
    missed, blocked, reflected, faded, arrived = np.concatenate(shares, axis=1).reshape(5, *shape)
    matrix = system.matrix(meridian, wavelength=wavelength)
    footprints = [
        footprint(system, meridian, *place)
        for place in zip(dist.ravel().tolist(), off.ravel().tolist(), strict=True)
    ]
    chief = chief_rays(system, sources, stop=stop_surface(system, meridian), wavelength=wavelength)[
        MERIDIANS.index(meridian)
    ]
    return FieldStudy(
        source_dist=dist,
        axis_off=off,
        paraxial=np.asarray(image_position(matrix, dist, off, sensor_dist)),
        image_point=np.asarray(image_position(matrix, dist, off)),
        f_tan=-system.effective_focal_length(meridian, wavelength=wavelength) * off / dist,
        paraxial_width=np.reshape([np.nan if f is None else f.width for f in footprints], shape),
        chief=chief.reshape(shape),
        light=Profile(
            *(np.concatenate(values).reshape(shape) for values in zip(*lights, strict=True))
        ),
        missed=missed,
        blocked=blocked,
        reflected=reflected,
        faded=faded,
        arrived=arrived,
        on_sensor=np.concatenate(on_sensor).reshape(shape),
    )


def field_curvature(
    system: OpticalSystem,
    source_dist: float,
    axis_offs: Iterable[float],
    meridian: Meridian = "x",
    *,
    width: Width = "rms",
    rays: int = 4001,
    wavelength: float = D_LINE,
) -> tuple[Array, Array]:
    """Find the best focus of sources at several offsets.

    Of a whole aperture this mixes the curvature of the field with coma and spherical aberration; an
    `Aperture` before or between the lenses shows the curvature alone.

    Returns
    -------
    shift, size : ndarray, shape (K,)
        As from `Spot.best_focus`: behind the sensor where > 0, and the width there, mm.
    """
    found = [
        fan(system, meridian, source_dist, off, rays=rays, wavelength=wavelength).best_focus(
            width, meridian
        )
        for off in axis_offs
    ]
    shift, size = np.array(found).reshape(-1, 2).T
    return shift, size


class HeightStudy(NamedTuple):
    """Where a source's light is on the pixel line when it is lifted; arrays of shape (K,), mm.

    Attributes
    ----------
    height : ndarray
        Of the source above the axis.
    paraxial : float
        For all heights the same: two meridians know nothing of each other.
    chief : ndarray
        `chief_rays` on the line.
    light : Profile
        Of the light on the pixels; arrays.
    """

    height: Array
    paraxial: float
    chief: Array
    light: Profile


def height_study(
    system: OpticalSystem,
    axis_off: float,
    source_dist: float,
    heights: ArrayLike,
    sensor: LineSensor = TCD1304,
    *,
    rays: tuple[int, int] = RAYS,
    wavelength: float = D_LINE,
) -> HeightStudy:
    """Lift a source, and see its light move along the pixel line.

    A cylinder keeps the direction cosine along its axis, not the slope: for a ray that goes up or
    down its power across is another one.

    Parameters
    ----------
    system : OpticalSystem
        With a sensor_distance.
    axis_off, source_dist : float
        Of the source, mm.
    heights : array_like, shape (K,)
        mm.
    sensor, rays, wavelength
        As for `line_profile`.
    """
    height = np.atleast_1d(check.array("heights", heights))
    sensor_dist = _require_sensor(system)
    sources = np.stack([0 * height + axis_off, height, 0 * height + source_dist])
    lights = [
        line_profile(
            system, (axis_off, float(h), source_dist), sensor, rays=rays, wavelength=wavelength
        )
        for h in height
    ]
    matrix = system.matrix("x", wavelength=wavelength)
    return HeightStudy(
        height,
        float(image_position(matrix, source_dist, axis_off, sensor_dist)),
        chief_rays(system, sources, on_line=True, wavelength=wavelength)[0],
        Profile(*(np.array(values) for values in zip(*lights, strict=True))),
    )


def _require_sensor(system: OpticalSystem) -> float:
    if system.sensor_distance is None:
        raise ValueError(f"{system.name}: sensor_distance is needed to say where light lands")
    return system.sensor_distance


def _first_glass(system: OpticalSystem) -> int:
    """Return the first surface that is no screen."""
    surfaces = [surface for surface, _, _ in surface_frames(system)]
    return next((k for k, surface in enumerate(surfaces) if not surface.screen), len(surfaces))


def _beside(system: OpticalSystem, light: Trace) -> NDArray[np.bool_]:
    """Which rays never entered: they met no opening, or not the first glass."""
    early = (light.surface >= 0) & (light.surface <= _first_glass(system))
    return np.asarray(early & (light.status != Status.REFLECTED))


def _sources(meridian: Meridian, dist: Array, off: Array) -> Array:
    """Sources in a meridian, shape (3, G)."""
    return np.stack([off, 0 * off, dist] if meridian == "x" else [0 * off, off, dist])


def _fan_rays(
    system: OpticalSystem, meridian: Meridian, sources: Array, rays: int
) -> tuple[Array, Array, Array]:
    """Rays of fans, one source (3, G) after the other, and their solid angle per mm across."""
    check.whole("rays", rays)
    axis = MERIDIANS.index(meridian)
    openings = [front_opening(system, place) for place in map(tuple, sources.T.tolist())]
    low, high = np.array(openings).reshape(-1, 4)[:, 2 * axis : 2 * axis + 2].T[:, :, None]
    step = (high - low) / rays
    aim = np.zeros((3, sources.shape[1], rays))
    aim[axis] = low + (np.arange(rays) + 0.5) * step
    start = sources[:, :, None] * np.array([1.0, 1.0, -1.0])[:, None, None]
    start = np.broadcast_to(start, aim.shape)
    direction = aim - start
    solid_angle = step * sources[2, :, None] / ((direction**2).sum(axis=0)) ** 1.5
    return start.reshape(3, -1), direction.reshape(3, -1), solid_angle.ravel()


def _spot(
    system: OpticalSystem,
    source: tuple[float, float, float],
    position: Array,
    direction: Array,
    solid_angle: Array,
    wavelength: float,
    fresnel: bool,
) -> Spot:
    _require_sensor(system)
    light: Trace = trace(system, position, direction, wavelength=wavelength, fresnel=fresnel)
    surfaces = len(surface_frames(system))
    lost = np.zeros((surfaces + 1, len(LOSSES)))
    gone = ~light.arrived
    np.add.at(lost, (light.surface[gone], light.status[gone].astype(int) - 1), solid_angle[gone])
    # what falls beside the first glass never entered
    lost[: _first_glass(system) + 1, :2] = 0.0
    here = light.arrived
    transmission = light.transmission[here]
    weight = solid_angle[here] * transmission
    direction = light.direction[:, here]
    return Spot(
        position=source,
        x=light.x[here],
        y=light.y[here],
        slope=direction[:2] / direction[2],
        weight=weight,
        entered=float(solid_angle[~_beside(system, light)].sum()),
        lost=lost,
        faded=float((solid_angle[here] * (1 - transmission)).sum()),
    )
