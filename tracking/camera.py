"""The head as a camera: where on the line the light of a point lands.

A cylinder lens does not know the height of a point but the direction of its light: along its axis
it keeps the direction cosine, sin ψ. In the plane across the axis light from above therefore
refracts as if glass had the index nₑ² = n² + (n² − 1) q with q = tan² ψ: the higher the source, the
stronger the lens. Along the axis there is no power but for a collimator's, and the light that the
line gets crosses its height at the sensor: ψ is known from the source's height and a distance
counted from there. With ::

    m = −X / (distance + pupil),    q = (Y / (distance + depth))² / (1 + m²)

the spike of a point is at ::

    u = centre + scale · [m · (1 + k₁ m² + k₂ m⁴ + … + c₁ q + c₂ q² + (c₃ q + c₄ q²) m²) + e₁ m² + …]

where k is the lens's distortion, c what height adds, and e what a head adds that is not the same on
both sides.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from raytransfer import _checks as check
from raytransfer.sensors import TCD1304
from tracking.spikes import SpikeFlags

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import ArrayLike, NDArray

    from raytransfer.sensors import LineSensor
    from raytransfer.systems import OpticalSystem
    from tracking.spikes import Detector

TERMS = {"distortion": 4, "coupling": 4, "decentring": 3}
"""Most terms of each kind."""

AXIS = (TCD1304.pixels - 1) / 2
"""Middle of the line, px."""


def image(c: Any, x: Any, y: Any, distance: Any) -> tuple[Any, Any, Any, Any]:
    """Spike of a point and its derivatives along X, Y and distance, for `Camera.coefficients`.

    Plain arithmetic: of arrays in numpy, of numbers where it is compiled.
    """
    z = distance + c[2]
    m = -x / z
    rise = y / (distance + c[3])
    secant = 1 + m * m
    q = rise * rise / secant
    value, along_m, along_q = shape(c, m, q)
    across = c[0] * (along_m - along_q * 2 * m * q / secant)
    height = c[0] * along_q * 2 / secant * rise / (distance + c[3])
    return c[1] + c[0] * value, -across / z, height, -across * m / z - height * rise


def shape(c: Any, m: Any, q: Any) -> tuple[Any, Any, Any]:
    """(u − centre) / scale and its derivatives by m and by q."""
    t = m * m
    odd = 1 + t * (c[4] + t * (c[5] + t * (c[6] + t * c[7])))
    odd_slope = 1 + t * (3 * c[4] + t * (5 * c[5] + t * (7 * c[6] + t * 9 * c[7])))
    even = t * (c[12] + t * (c[13] + t * c[14]))
    even_slope = m * (2 * c[12] + t * (4 * c[13] + t * 6 * c[14]))
    height = q * (c[8] + c[9] * q + t * (c[10] + c[11] * q))
    height_slope = q * (c[8] + c[9] * q + 3 * t * (c[10] + c[11] * q))
    along_q = m * (c[8] + 2 * c[9] * q + t * (c[10] + 2 * c[11] * q))
    return m * (odd + height) + even, odd_slope + height_slope + even_slope, along_q


@dataclass(frozen=True)
class Camera:
    """Where on the line the light of a point lands, and back.

    Points are optical X, Y and distance before the first vertex, mm, as `tracking.poses.optical`
    gives them.

    Parameters
    ----------
    scale : float
        px per unit of m at the axis: focal length over pitch. Positive if the spike of an LED at
        larger X_room has the larger pixel number, as the wiring has it.
    centre : float
        px; where the axis meets the line.
    distortion : tuple of float
        k₁, k₂, … of m², m⁴, …; at most 4.
    coupling : tuple of float
        c₁ … c₄ of q, q², q m², q² m².
    decentring : tuple of float
        e₁, e₂, e₃ of m², m⁴, m⁶: 0 for a head that is the same on both sides.
    pupil : float
        How far behind the first vertex the centre of projection is, mm.
    depth : float
        How far behind it the light of all heights crosses the axis, mm: with plates and cylinders
        that bend along the line only, the sensor's place seen through them. It is of the design,
        not one of `parameters`: spikes hardly tell it.
    model_error : float
        RMS of what the model leaves of exact light, px, over the field it was fitted to. Poses take
        it for one more independent error of each spike, which it is from place to place; at one
        place it is always the same, and no mean over frames makes it smaller.
    elevation : float
        Largest |Y| / (distance + depth) from which light reaches the line.
    """

    scale: float
    centre: float = AXIS
    distortion: tuple[float, ...] = ()
    coupling: tuple[float, ...] = ()
    decentring: tuple[float, ...] = ()
    pupil: float = 0.0
    depth: float = 0.0
    model_error: float = 0.0
    elevation: float = 0.3

    def __post_init__(self) -> None:
        if check.number("scale", self.scale) == 0:
            raise ValueError("scale = 0 px: allowed is any other, focal length over pixel pitch")
        if abs(self.scale) < 100:
            raise ValueError(
                f"scale = {self.scale:g} px: a focal length over the pixel pitch is some thousand; "
                "was the focal length given in mm?"
            )
        check.number("centre", self.centre, "px")
        check.number("pupil", self.pupil, "mm")
        check.number("depth", self.depth, "mm")
        check.not_negative("model_error", self.model_error, "px")
        check.positive("elevation", self.elevation, "a tangent")
        for name, most in TERMS.items():
            given = getattr(self, name)
            if not isinstance(given, tuple | list):
                raise TypeError(f"{name} = {given!r}: a list of numbers is needed, one per term")
            terms = tuple(check.number(f"{name}[{i}]", v) for i, v in enumerate(given))
            if len(terms) > most:
                raise ValueError(f"{name} has {len(terms)} terms: allowed are {most} at most")
            object.__setattr__(self, name, terms)
        padded = [
            (*getattr(self, name), *(0.0,) * (most - len(getattr(self, name))))
            for name, most in TERMS.items()
        ]
        vector = np.array([self.scale, self.centre, self.pupil, self.depth, *sum(padded, ())])
        vector.flags.writeable = False
        object.__setattr__(self, "_coefficients", vector)

    @property
    def coefficients(self) -> NDArray[np.float64]:
        """All numbers of the model, with zeros for terms left out, as `image` takes them."""
        vector: NDArray[np.float64] = self._coefficients  # type: ignore[attr-defined]
        return vector

    @property
    def names(self) -> tuple[str, ...]:
        """Names of `parameters`."""
        return (
            "scale",
            "centre",
            "pupil",
            *(f"{name}[{i}]" for name in TERMS for i in range(len(getattr(self, name)))),
        )

    @property
    def parameters(self) -> NDArray[np.float64]:
        """Numbers of the model that are not left out, in the order of `names`."""
        terms = [value for name in TERMS for value in getattr(self, name)]
        return np.array([self.scale, self.centre, self.pupil, *terms])

    def with_parameters(self, values: ArrayLike) -> Camera:
        """Return the camera with other `parameters`."""
        new = [float(value) for value in np.asarray(values)]
        if len(new) != len(self.names):
            raise ValueError(f"{len(self.names)} parameters are needed ({', '.join(self.names)})")
        scale, centre, pupil, *rest = new
        terms = {}
        for name in TERMS:
            count = len(getattr(self, name))
            terms[name], rest = tuple(rest[:count]), rest[count:]
        return replace(self, scale=scale, centre=centre, pupil=pupil, **terms)  # type: ignore[arg-type]

    def project(self, points: ArrayLike) -> NDArray[np.float64]:
        """Spikes of points, px; NaN for points that are not in front.

        Parameters
        ----------
        points : array_like, shape (…, 3)
            Optical X, Y and distance, mm.

        Returns
        -------
        ndarray, shape (…)
            px, also beyond the ends of the line.
        """
        return np.asarray(image(self.coefficients, *self._in_front(points))[0])

    def jacobian(self, points: ArrayLike) -> NDArray[np.float64]:
        """Change of the spikes with the points, px per mm, shape (…, 3)."""
        return np.stack(image(self.coefficients, *self._in_front(points))[1:], axis=-1)

    def parameter_jacobian(self, points: ArrayLike) -> NDArray[np.float64]:
        """Change of the spikes with `parameters`, shape (…, number of parameters)."""
        x, y, distance = self._in_front(points)
        z = distance + self.pupil
        m = -x / z
        q = (y / (distance + self.depth)) ** 2 / (1 + m * m)
        value, along_m, along_q = shape(self.coefficients, m, q)
        by_pupil = -self.scale * (along_m - along_q * 2 * m * q / (1 + m * m)) * m / z
        columns = [value, np.ones_like(m), by_pupil]
        basis = _basis(m, q)
        for name in TERMS:
            columns += [self.scale * b for b in basis[name][: len(getattr(self, name))]]
        return np.stack(columns, axis=-1)

    def tangent(self, pixels: ArrayLike, q: ArrayLike = 0.0) -> NDArray[np.float64]:
        """Return m of spikes, the inverse of `project`.

        Parameters
        ----------
        pixels : array_like
            px.
        q : array_like
            Of their points, as the module has it; 0 at the height of the axis.

        Returns
        -------
        ndarray
            NaN beyond the field, where the polynomials fold: no point lands there, or one could be
            any of several.
        """
        u, height = np.broadcast_arrays(check.numbers("pixels", pixels), check.array("q", q))
        aim = (u - self.centre) / self.scale
        m = np.array(aim, dtype=float)
        with np.errstate(all="ignore"):  # from beyond the field it runs away
            for _ in range(NEWTON_STEPS):
                value, slope, _ = shape(self.coefficients, m, height)
                m -= (value - aim) / slope
            reached = np.abs(shape(self.coefficients, m, height)[0] - aim) < 1e-9
            return np.where(reached & self._rises(m, height), m, math.nan)

    def _rises(self, m: NDArray[np.float64], q: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Whether the spike moves on with m all the way from the axis: beyond a fold it does not."""
        way = np.linspace(0.0, 1.0, 17).reshape(-1, *(1,) * np.ndim(m))
        return np.asarray((shape(self.coefficients, way * m, q)[1] > 0).all(axis=0))

    def sees(
        self, points: ArrayLike, pixels: int = TCD1304.pixels, *, margin: float = 0.0
    ) -> NDArray[np.bool_]:
        """Whether light of points reaches the line: their spikes are on it, and they not too high.

        Parameters
        ----------
        points : array_like, shape (…, 3)
            Optical X, Y and distance, mm.
        pixels : int
            Of the line.
        margin : float
            px at either end that do not count: light that is cut off there shifts its spike.
        """
        at = self.project(points)
        x, y, distance = self._in_front(points)
        m, rise = -x / (distance + self.pupil), np.abs(y) / (distance + self.depth)
        seen = (at >= margin) & (at <= pixels - 1 - margin) & (rise <= self.elevation)
        return np.asarray(seen & self._rises(m, rise**2 / (1 + m * m)))

    @classmethod
    def pinhole(cls, focal_length: float, pitch: float = TCD1304.pitch) -> Self:
        """Return a camera without distortion of this focal length, mm."""
        return cls(check.positive("focal_length", focal_length) / check.positive("pitch", pitch))

    @classmethod
    def fit(
        cls,
        points: ArrayLike,
        pixels: ArrayLike,
        sigma: ArrayLike | None = None,
        *,
        distortion: int = 2,
        coupling: int = 0,
        decentring: int = 0,
        pupil: float | None = None,
        depth: float | None = 0.0,
        elevation: float | None = None,
    ) -> Self:
        """Fit a camera to spikes of known points.

        For a pupil and a depth all else is linear; these two are found by least squares.

        Parameters
        ----------
        points : array_like, shape (N, 3)
            Optical X, Y and distance, mm.
        pixels : array_like, shape (N,)
        sigma : array_like, shape (N,), optional
            Standard deviations, px; all the same when left out.
        distortion, coupling, decentring : int
            How many terms of each.
        pupil, depth : float, optional
            mm; to be found if None. Points at one distance do not tell the pupil, points at the
            height of the axis neither depth nor coupling.
        elevation : float, optional
            As for the camera; the points' largest when left out.

        Returns
        -------
        Camera
            With the RMS of what it leaves as `model_error`, less what σ (if it is given) says that
            noise leaves, and corrected for what a fit with so many terms can follow.

        Raises
        ------
        ValueError
            If a point is not in front, or the points are too few or do not tell all that is asked.
        """
        from scipy.optimize import least_squares  # type: ignore[import-untyped]  # slow to load

        at, u = check.array("points", points), check.array("pixels", pixels)
        if at.ndim != 2 or at.shape[1] != 3 or u.shape != (len(at),):
            raise ValueError(
                f"points has shape (N, 3) and pixels (N,), not {at.shape} and {u.shape}"
            )
        if len(at) and at[:, 2].min() <= 0:
            raise ValueError(
                f"distance = {at[:, 2].min():g} mm: allowed are points in front, > 0; "
                "are the columns X, Y, distance?"
            )
        spread = np.ones(len(u)) if sigma is None else check.positive_array("sigma", sigma)
        if spread.shape != u.shape:
            raise ValueError(f"sigma has shape {u.shape}, one per spike, not {spread.shape}")
        counts = dict(zip(TERMS, (distortion, coupling, decentring), strict=True))
        asked = [pupil is None, depth is None]
        needed = 2 + sum(counts.values()) + sum(asked)
        if len(u) < needed:
            raise ValueError(f"{len(u)} spikes: for {needed} numbers as many are needed")

        def columns(lengths: NDArray[np.float64]) -> NDArray[np.float64]:
            free = iter(lengths.tolist())
            behind = next(free) if pupil is None else pupil
            below = next(free) if depth is None else depth
            m = -at[:, 0] / (at[:, 2] + behind)
            q = (at[:, 1] / (at[:, 2] + below)) ** 2 / (1 + m * m)
            basis = _basis(m, q)
            terms = [b for name, count in counts.items() for b in basis[name][:count]]
            return np.stack([m, np.ones_like(m), *terms], axis=1) / spread[:, None]

        def rest(lengths: NDArray[np.float64]) -> NDArray[np.float64]:
            rows = columns(lengths)
            return np.asarray(u / spread - rows @ np.linalg.lstsq(rows, u / spread, rcond=None)[0])

        lengths = np.array([0.0, 50.0])[asked]
        if lengths.size:
            found = least_squares(rest, lengths, x_scale=10.0, xtol=1e-12, ftol=1e-14)
            lengths = found.x
            slopes = found.jac * 1000.0
            # px per m; from points that tell it, thousands
            told = np.sqrt(np.mean((slopes * spread[:, None]) ** 2, axis=0)) > 1.0
            if not told.all():
                what = [n for n, a in zip(("pupil", "depth"), asked, strict=True) if a]
                raise ValueError(
                    f"the points do not tell {what[int(np.argmin(told))]}: they need several "
                    "distances (depth: and heights); or give it"
                )
        rows = columns(lengths)
        size = np.linalg.norm(rows, axis=0)
        strength = np.linalg.svd(rows / np.where(size > 0, size, 1.0), compute_uv=False)
        if not size.all() or strength[-1] < 1e-9 * strength[0]:
            raise ValueError(
                f"the points do not tell all of {', '.join(counts)} asked for: coupling needs "
                "heights, distortion the whole field"
            )
        if lengths.size:
            rows = np.hstack([rows, found.jac])
        # part of each spike's error that is left
        left_part = 1 - (np.linalg.qr(rows)[0] ** 2).sum(axis=1)
        best = np.linalg.lstsq(rows[:, : len(size)], u / spread, rcond=None)[0]
        scale, centre, *rates = best.tolist()
        free = iter(lengths.tolist())
        terms: dict[str, Any] = {}
        for name, count in counts.items():
            terms[name] = tuple(rate / scale for rate in rates[:count])
            rates = rates[count:]
        camera = cls(
            scale,
            centre,
            **terms,
            pupil=next(free) if pupil is None else pupil,
            depth=next(free) if depth is None else depth,
        )
        left = u - camera.project(at)
        noise = 0.0 if sigma is None else float((spread**2 * left_part).sum())
        excess = max(float((left**2).sum()) - noise, 0.0)
        spare = float(left_part.sum())
        highest = float(np.max(np.abs(at[:, 1] / (at[:, 2] + camera.depth))))
        return replace(
            camera,
            model_error=math.sqrt(excess / spare) if spare > 1e-6 else 0.0,
            elevation=(highest or camera.elevation) if elevation is None else elevation,
        )

    @classmethod
    def from_system(
        cls,
        system: OpticalSystem,
        sensor: LineSensor = TCD1304,
        *,
        detector: Detector = "likelihood",
        wavelength: float = 0.63,
        extent: float = 2.0,
        distances: Sequence[float] = (1000.0, 1300.0, 2000.0, 4150.0),
        angles: int = 25,
        distortion: int = 2,
        coupling: int = 4,
        decentring: int = 0,
        rays: tuple[int, int] = (192, 64),
    ) -> Self:
        """Fit a camera to exact light: spikes of points over the field, located as a tracker does.

        Points are those whose light reaches the line, at all of the distances, at five heights up
        to the highest that sends it a fifth of what the axis sends. What the position depends on
        distance beyond the pupil (defocus moves skew light) is in `model_error` with all else that
        the terms leave.

        Parameters
        ----------
        system : OpticalSystem
            With a sensor_distance.
        sensor : LineSensor
        detector : {"likelihood", "gravity", "derivative", "minimum"}
        wavelength : float
            µm.
        extent : float
            Diameter of an LED, mm. The image of a point is but one pixel wide where it is sharp,
            and cannot be located.
        distances : sequence of float
            mm before the first vertex.
        angles : int
            Across the field, each way of it.
        distortion, coupling, decentring : int
            How many terms of each.
        rays : tuple of int
            As for `raytransfer.irradiance.pixel_response`.
        """
        from raytransfer.irradiance import disc_image, pixel_response
        from tracking.spikes import SpikeFinder

        check.not_negative("extent", extent, "a diameter in mm")
        finder = SpikeFinder(detector=detector)
        far = max(distances)
        length = abs(system.effective_focal_length("x", wavelength=wavelength))
        fine = replace(sensor, pitch=sensor.pitch / FINE, pixels=sensor.pixels * FINE)

        def light(x: float, y: float, distance: float) -> NDArray[np.float64]:
            point = pixel_response(
                system, (x, y, distance), fine, wavelength=wavelength, rays=rays, threads=1
            )
            size = extent * length / distance / fine.pitch
            blurred = np.convolve(point, disc_image(size, chords=True), mode="same")
            return np.asarray(blurred.reshape(-1, FINE).sum(axis=1))

        meridian = system.matrix("y", wavelength=wavelength)
        to_chip = system.sensor_distance or 0.0
        depth = (meridian.B + meridian.A * to_chip) / meridian.A
        on_axis = light(0.0, 0.0, far).sum()
        elevation = 0.0
        while elevation < HIGHEST and (
            light(0.0, (elevation + 0.02) * (far + depth), far).sum() > LEAST_LIGHT * on_axis
        ):
            elevation += 0.02
        widest = 1.3 * sensor.length / 2 / length
        points, pixels = [], []
        for distance in distances:
            for height in np.linspace(0.0, max(elevation, 0.02), 5) * (distance + depth):
                for tangent in np.linspace(-widest, widest, angles):
                    at = (float(tangent * distance), float(height), float(distance))
                    profile = light(*at)
                    if profile.sum() < LEAST_LIGHT / 4 * on_axis * (far / distance) ** 2:
                        continue
                    brightest = int(profile.argmax())
                    if not EDGE <= brightest < sensor.pixels - EDGE:
                        continue  # cut off: no use to a fit
                    spike = finder.profile(PEAK / profile[brightest] * profile)
                    if spike.found and not spike.flags & SpikeFlags.CLIPPED:
                        points.append(at)
                        pixels.append(spike.position)
        if not points:
            raise ValueError(f"{system.name}: no light reaches the line from {distances} mm")
        return cls.fit(
            points,
            pixels,
            distortion=distortion,
            coupling=coupling if elevation else 0,
            decentring=decentring,
            depth=None if elevation else depth,
            elevation=max(elevation, 0.02),
        )

    def to_dict(self) -> dict[str, Any]:
        """Return the camera as numbers and lists, for a JSON file."""
        return {
            name: list(value) if isinstance(value, tuple) else float(value)
            for name, value in ((name, getattr(self, name)) for name in self.__dataclass_fields__)
        }

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> Self:
        """Return the camera of `to_dict`.

        Raises
        ------
        TypeError
            If it is no dictionary, or a value is no number (or list of them, for terms).
        ValueError
            If a name is unknown or missing, or a number is out of range.
        """
        if not isinstance(data, dict):
            raise TypeError(f"camera: names and numbers are needed, not {data!r:.60}")
        known = set(cls.__dataclass_fields__)
        if wrong := set(data) ^ known:
            raise ValueError(
                f"camera: unknown or missing: {', '.join(sorted(wrong))}; "
                f"it has {', '.join(sorted(known))}"
            )
        values: dict[str, Any] = {
            k: tuple(v) if isinstance(v, list) else v for k, v in data.items()
        }
        return cls(**values)

    def _in_front(self, points: ArrayLike) -> tuple[Any, Any, Any]:
        at = check.numbers("points", points)
        if at.ndim == 0 or at.shape[-1] != 3:
            raise ValueError(
                f"points has shape (…, 3), optical X, Y and distance in mm, not {at.shape}"
            )
        distance = np.where(at[..., 2] + self.pupil > 0, at[..., 2], math.nan)
        return at[..., 0], at[..., 1], distance


HIGHEST = 0.6
"""Elevation up to which `Camera.from_system` looks for light."""

LEAST_LIGHT = 0.2
"""Of what the axis sends: with less a height is out of reach."""

FINE = 8
"""Parts of a pixel in which light is blurred before it is located."""

PEAK = 24_500.0
"""Electrons in the brightest pixel, 0.7 of full well."""

EDGE = 40
"""Pixels at the ends of the line where spikes may be cut off."""

NEWTON_STEPS = 8
"""Of `Camera.tangent`; from the field of a lens it converges in 4 or 5."""


def _basis(m: Any, q: Any) -> dict[str, list[Any]]:
    """Change of `shape` with each term, by kind."""
    t = m * m
    return {
        "distortion": [m * t, m * t**2, m * t**3, m * t**4],
        "coupling": [m * q, m * q * q, m * q * t, m * q * q * t],
        "decentring": [t, t**2, t**3],
    }
