"""How far away a single LED is, by the width of its spike.

A head is in focus at one distance only; nearer and farther LEDs make wider spikes (the thesis's
figure 4.3), so that "the resulting width and position of the spike can be sufficient to calculate
the position". How well, is what this module says: a width belongs to two distances, one on either
side of the focus; near the focus it hardly changes, and far away neither; it depends on the angle;
and a tenth of a millimetre between lens and chip changes it as much as a metre of distance.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntFlag
from functools import partial
from typing import TYPE_CHECKING, NamedTuple, Self

import numpy as np

from raytransfer import _checks as check
from raytransfer.irradiance import disc_image, pixel_response
from raytransfer.sensors import TCD1304
from raytransfer.tolerances import Tolerances, perturb
from tracking.camera import PEAK
from tracking.poses import KNOWN, UNKNOWN, Prior
from tracking.spikes import Spike, SpikeFinder, SpikeFlags

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    from raytransfer import LineSensor, OpticalSystem
    from tracking.camera import Camera

WIDTH_NOISE = 5.0
"""σ of a spike's width over σ of its position.

2.35 for a Gaussian in even noise, whose standard deviation and place are known equally well; about 2
for two bright rims, 3 to 6 for a soft box between them.
"""

RELATIVE_LIMIT = 0.2
"""A distance with a larger σ, relative to it, is called useless."""

GROSS = 8.0
"""Captures whose widths are so many times as far off as half of them are left out."""

NEIGHBOURS = 0.1
"""Part of the range of 1 / distance and m over which captures say how well widths are known."""

BRANCH = 0.05
"""Least probability of a distance that counts as possible."""

UNEXPLAINED = 5.0
"""A width that is farther from any distance's than so many σ is none of a single LED."""

_UNFIT = SpikeFlags.MISSING | SpikeFlags.SATURATED | SpikeFlags.CLIPPED | SpikeFlags.REFLECTION
_NODES = 2000  # distances, evenly in 1 / distance, at which probabilities are computed
_COLUMNS = 101  # tangents between which widths are linear


class RangeFlags(IntFlag):
    """What a distance must not be trusted in; 0 is nothing."""

    NONE = 0
    AMBIGUOUS = 1
    """A distance on the other side of the focus explains the width, too."""
    USELESS = 2
    """σ is more than `RELATIVE_LIMIT` of the distance."""
    UNEXPLAINED = 4
    """No distance explains the width: another kind of LED, a reflection, a head out of place."""
    OUTSIDE = 8
    """The spike is farther aside than widths are known."""
    UNFIT = 16
    """The spike has no width to be used: saturated, clipped, with a reflection or missing."""


class Branch(NamedTuple):
    """One of the distances that a width may mean.

    Attributes
    ----------
    distance, sigma : float
        mm.
    probability : float
    """

    distance: float
    sigma: float
    probability: float


@dataclass(frozen=True)
class Range:
    """What the width of a spike says.

    Attributes
    ----------
    distance, sigma : float
        Mean and standard deviation of all distances that are possible, along the axis from the
        first vertex, mm. Where both sides of the focus are, the mean may lie between them.
    branches : tuple of Branch
        Nearer and farther than the focus, those with a probability of `BRANCH` or more.
    flags : RangeFlags
    """

    distance: float
    sigma: float
    branches: tuple[Branch, ...]
    flags: RangeFlags = RangeFlags.NONE


class Place(NamedTuple):
    """A tracker's place from one LED.

    Attributes
    ----------
    x, y : float
        mm.
    covariance : ndarray, shape (2, 2)
        Of these.
    range : Range
    """

    x: float
    y: float
    covariance: NDArray[np.float64]
    range: Range


class RangeFinder:
    """Distance of an LED from the width of its spike.

    All distances within a table are taken as equally probable beforehand, and none beyond; what is
    expected comes on top. The result is the mean and the standard deviation of what the width
    leaves. Where that reaches the farthest distance, σ is as small as the table's end makes it.

    Parameters
    ----------
    camera : Camera
        For the direction.
    distances : array_like, shape (N,)
        Of LEDs before the first vertex, mm, rising.
    tangents : array_like, shape (M,)
        m of `Camera`, rising.
    widths : array_like, shape (N, M)
        Full widths at half maximum, px, as the spike finder measures them.
    spread : array_like
        Standard deviation with which these are known, px: one number or shape (N, M). The noise of
        a spike comes on top.

    Raises
    ------
    ValueError
        If shapes do not fit or a number is out of its range.
    """

    def __init__(
        self,
        camera: Camera,
        distances: ArrayLike,
        tangents: ArrayLike,
        widths: ArrayLike,
        spread: ArrayLike,
    ) -> None:
        from scipy.interpolate import PchipInterpolator  # type: ignore[import-untyped]  # slow to load

        at = check.positive_array("distances", distances, "mm")
        aside = check.array("tangents", tangents)
        table = check.positive_array("widths", widths, "px")
        error = np.broadcast_to(check.positive_array("spread", spread, "px"), table.shape)
        if at.ndim != 1 or aside.ndim != 1 or table.shape != (len(at), len(aside)):
            raise ValueError(
                f"widths has shape (distances, tangents), ({at.size}, {aside.size}), "
                f"not {table.shape}"
            )
        if min(table.shape) < 4 or (np.diff(at) <= 0).any() or (np.diff(aside) <= 0).any():
            raise ValueError("distances and tangents: four or more of each are needed, rising")
        self.camera = camera
        near, far = 1 / at[0], 1 / at[-1]
        self.distances: NDArray[np.float64] = 1 / np.linspace(far, near, _NODES)[::-1]
        self.tangents: NDArray[np.float64] = np.linspace(aside[0], aside[-1], _COLUMNS)

        def fine(values: NDArray[np.float64]) -> NDArray[np.float64]:
            along = PchipInterpolator(1 / at[::-1], values[::-1], axis=0)(1 / self.distances)
            return np.asarray(PchipInterpolator(aside, along, axis=1)(self.tangents))

        self.widths = fine(table)
        self.spread = fine(np.array(error))
        # what each node stands for: equally probable are distances, not their inverses
        between = (self.distances[1:] + self.distances[:-1]) / 2
        self._share = np.diff([self.distances[0], *between, self.distances[-1]])

    @classmethod
    def from_system(
        cls,
        system: OpticalSystem,
        camera: Camera,
        *,
        finder: SpikeFinder | None = None,
        sensor: LineSensor = TCD1304,
        wavelength: float = 0.63,
        extent: float = 2.0,
        distances: ArrayLike | None = None,
        half_field: float = 0.42,
        tolerances: Tolerances | None = None,
        heads: int = 24,
        seed: int = 0,
    ) -> Self:
        """Widths of a head as drawn, in exact light; how sure they are, from heads as made.

        The spread is the root mean square of `heads` deviations from the drawing. From so few it is
        itself not well known: it is taken times √(N / (N − 2)), the standard deviation of Student's
        distribution with N degrees of freedom, which is what the next head then follows.

        Parameters
        ----------
        system : OpticalSystem
            With a sensor_distance.
        camera : Camera
        finder : SpikeFinder, optional
            What measures the widths. `SpikeFinder()` when left out.
        sensor : LineSensor
        wavelength : float
            µm.
        extent : float
            Diameter of the LEDs, mm: part of the width, near by.
        distances : array_like, optional
            mm; 300 to 6000 when left out.
        half_field : float
            Largest tangent, to both sides.
        tolerances : Tolerances, optional
            `Tolerances()` when left out, which describes a printed mount: with it the widths of a
            head that was never measured say little.
        heads : int
            So many are drawn, 3 or more. With 24 the spread is known to about 12 %.
        seed : int

        Raises
        ------
        ValueError
            If an LED within the field leaves no spike on the line, or there are too few heads.
        """
        finder = SpikeFinder() if finder is None else finder
        tolerances = Tolerances() if tolerances is None else tolerances
        at = 1 / np.linspace(1 / 300, 1 / 6000, 16) if distances is None else distances
        at = check.positive_array("distances", at, "mm")
        aside = np.linspace(-1, 1, 7) * check.positive("half_field", half_field, "a tangent")
        if check.whole("heads", heads) < 3:
            raise ValueError(f"heads = {heads}: of fewer than 3 no spread is known")
        draws = np.random.SeedSequence(seed).spawn(heads)
        made = [perturb(system, tolerances, np.random.default_rng(draw)) for draw in draws]

        def widths(of: OpticalSystem, columns: NDArray[np.float64]) -> NDArray[np.float64]:
            width = partial(_width, of, camera, finder, sensor, wavelength, extent)
            return np.array([[width(d, m) for m in columns.tolist()] for d in at.tolist()])

        drawn = widths(system, aside)
        few = slice(None, None, 2)  # across the field spreads change less than widths
        off = np.array([widths(head, aside[few]) for head in made]) - drawn[:, few]
        some = np.sqrt(np.sum(off**2, axis=0) / (heads - 2))
        spread = np.array([np.interp(aside, aside[few], row) for row in some])
        return cls(camera, at, aside, drawn, np.hypot(spread, 0.01 * drawn))

    @classmethod
    def from_captures(
        cls,
        camera: Camera,
        distances: ArrayLike,
        pixels: ArrayLike,
        widths: ArrayLike,
        *,
        drift: float = 0.1,
    ) -> Self:
        """Widths of a head that was measured.

        Squares of widths are fitted by a polynomial in 1 / distance and m: without caustics the blur
        of an opening grows linearly with 1 / distance away from the focus, and adds to the rest
        about as squares do. Gross errors are left out.

        Parameters
        ----------
        camera : Camera
            Calibrated.
        distances : array_like, shape (N,)
            Along the axis from the first vertex, mm.
        pixels, widths : array_like, shape (N,)
            Of the spikes, px.
        drift : float
            Standard deviation by which widths may have changed since, px. 0.1: about what one kelvin
            does in a printed mount, which moves the chip by 2 µm, with a slit of 9 mm.

        Raises
        ------
        ValueError
            If there are too few spikes, or they are all at one distance or direction.
        """
        at = check.positive_array("distances", distances, "mm")
        aside = camera.tangent(check.array("pixels", pixels))
        seen = check.positive_array("widths", widths, "px")
        terms = [(i, j) for i in range(4) for j in range(5) if i + j <= 5]
        if at.ndim != 1 or at.shape != aside.shape or at.shape != seen.shape:
            raise ValueError("distances, pixels and widths: one of each for every spike is needed")
        if len(at) < 3 * len(terms):
            raise ValueError(
                f"{len(at)} spikes: {3 * len(terms)} or more are needed, all over the distances and "
                "directions that are to be used"
            )
        low, high = at.min(), at.max()
        reach = float(np.abs(aside).max())

        def basis(d: NDArray[np.float64], m: NDArray[np.float64]) -> NDArray[np.float64]:
            v = (2 / d - 1 / low - 1 / high) / (1 / low - 1 / high)
            return np.stack([v**i * (m / reach) ** j for i, j in terms], axis=-1)

        if high <= 1.05 * low or np.ptp(aside) < 0.05:
            raise ValueError(
                f"distances {low:g} to {high:g} mm, tangents {aside.min():.2f} to {aside.max():.2f}: "
                "both must vary"
            )
        rows = basis(at, aside) / (2 * seen[:, None])
        good = np.ones(len(at), dtype=bool)
        for _ in range(3):  # without what belongs to no single LED
            fitted, _, rank, _ = np.linalg.lstsq(rows[good], seen[good] / 2)
            if rank < len(terms):
                raise ValueError("the spikes do not tell how width hangs on distance and direction")
            left = np.abs(seen / 2 - rows @ fitted)
            good = left <= GROSS * np.median(left)
        at, aside, seen, rows = at[good], aside[good], seen[good], rows[good]
        least = 0.5 * float(seen.min())

        def width(d: NDArray[np.float64], m: NDArray[np.float64]) -> NDArray[np.float64]:
            return np.asarray(np.sqrt(np.maximum(basis(d, m) @ fitted, least**2)))

        # what a fit without a spike is off at it; where a head is in focus that is more than elsewhere
        leverage = (np.linalg.qr(rows)[0] ** 2).sum(axis=1)
        off = (seen - width(at, aside)) / np.maximum(1 - leverage, 0.1)
        nodes = 1 / np.linspace(1 / low, 1 / high, 40)
        columns = np.linspace(aside.min(), aside.max(), 21)
        grid = np.meshgrid(nodes, columns, indexing="ij")
        away = [
            (grid[0][..., None] ** -1 - 1 / at) / (1 / low - 1 / high),
            (grid[1][..., None] - aside) / np.ptp(aside),
        ]
        near = np.exp(-0.5 * (away[0] ** 2 + away[1] ** 2) / NEIGHBOURS**2)
        local = np.sqrt((near @ off**2 + off @ off / len(off)) / (near.sum(axis=-1) + 1))
        drift = check.not_negative("drift", drift, "px")
        return cls(camera, nodes, columns, width(*grid), np.hypot(local, drift))

    def __call__(self, spike: Spike, expected: Prior = UNKNOWN) -> Range:
        """Return the distance of a spike's LED.

        Parameters
        ----------
        spike : Spike
        expected : Prior
            What is known of the distance beforehand, mm.
        """
        value, known = expected
        if not known > 0:
            raise ValueError(f"σ of the expected distance = {known}: allowed is > 0 to infinity")
        density = self._share.copy()
        if math.isfinite(known):
            density *= np.exp(-0.5 * ((self.distances - value) / known) ** 2)
            if density.sum() <= 1e-12 * self._share.sum():
                raise ValueError(
                    f"expected distance {value:g} ± {known:g} mm: widths are known from "
                    f"{self.distances.min():.0f} to {self.distances.max():.0f} mm"
                )
        flags = RangeFlags.NONE
        nearest = 0
        if spike.flags & _UNFIT or not math.isfinite(spike.width + spike.sigma):
            flags |= RangeFlags.UNFIT
        else:
            tangent = float(self.camera.tangent(spike.position))
            if not self.tangents[0] <= tangent <= self.tangents[-1]:
                flags |= RangeFlags.OUTSIDE
            width, error = self._at(tangent)
            error = np.hypot(error, WIDTH_NOISE * spike.sigma)
            off = np.abs(width - spike.width) / error
            if off.min() > UNEXPLAINED:
                flags |= RangeFlags.UNEXPLAINED
            density *= np.exp(-0.5 * (off**2 - off.min() ** 2)) / error
            nearest = int(width.argmin())
        if flags & (RangeFlags.OUTSIDE | RangeFlags.UNEXPLAINED):  # the width says nothing then
            density = self._share.copy()
        density /= density.sum()
        distance, sigma = _moments(self.distances, density)
        branches = []
        for side in (slice(0, nearest), slice(nearest, None)):
            part = float(density[side].sum())
            if part >= BRANCH:
                branches.append(Branch(*_moments(self.distances[side], density[side] / part), part))
        if len(branches) > 1 and branches[1].distance - branches[0].distance > 2 * (
            branches[0].sigma + branches[1].sigma
        ):
            flags |= RangeFlags.AMBIGUOUS
        if sigma > RELATIVE_LIMIT * distance:
            flags |= RangeFlags.USELESS
        return Range(distance, sigma, tuple(branches), flags)

    def place(
        self,
        spike: Spike,
        led: ArrayLike,
        heading: Prior = KNOWN,
        expected: Prior = UNKNOWN,
    ) -> Place:
        """Return where the tracker is, from one LED at about its own height.

        Parameters
        ----------
        spike : Spike
        led : array_like, shape (2,) or (3,)
            Room x and y, mm; z is not used.
        heading : Prior
            Known, or known with an error that becomes one of the place, rad.
        expected : Prior
            What is known of the distance beforehand, mm.

        Raises
        ------
        ValueError
            If the heading is unknown or the spike has no position.
        """
        at = check.array("led", led)
        if at.shape not in {(2,), (3,)}:
            raise ValueError(f"led has shape (2,) or (3,), room x, y (and z) in mm, not {at.shape}")
        turned = check.number("heading", heading.value)
        if not 0 <= heading.sigma < math.inf:
            raise ValueError(
                f"σ of the heading = {heading.sigma}: allowed is >= 0 and finite; one LED does not "
                "tell where a tracker looks"
            )
        if not spike.found:
            raise ValueError("the spike was not found: it has no direction")
        found = self(spike, expected)
        depth = found.distance + self.camera.pupil
        m = float(self.camera.tangent(spike.position))
        slope = -depth * float(self.camera.jacobian([-m * depth, 0.0, found.distance])[0])
        ahead = np.array([math.sin(turned), -math.cos(turned)])
        right = np.array([math.cos(turned), math.sin(turned)])
        x, y = (at[:2] - found.distance * ahead - m * depth * right).tolist()
        changes = np.stack(
            [
                (ahead + m * right) * found.sigma,
                right * depth * math.hypot(spike.sigma, self.camera.model_error) / slope,
                (found.distance * right - m * depth * ahead) * heading.sigma,
            ]
        )
        return Place(x, y, changes.T @ changes, found)

    def useful(self, tangent: float = 0.0, sigma: float = 0.05) -> NDArray[np.bool_]:
        """Whether a width alone tells the distance, at each of `distances`.

        It does where σ of the spike's `Range` is within `RELATIVE_LIMIT` of the distance. Where the
        other side of the focus explains the width as well, it does not.

        Parameters
        ----------
        tangent : float
            m of the LED.
        sigma : float
            Of the spike's position, px.
        """
        width, error = self._at(check.number("tangent", tangent))
        error = np.hypot(error, WIDTH_NOISE * check.not_negative("sigma", sigma, "px"))
        told = []
        for seen in width:
            density = self._share * np.exp(-0.5 * ((width - seen) / error) ** 2) / error
            distance, found = _moments(self.distances, density / density.sum())
            told.append(found <= RELATIVE_LIMIT * distance)
        return np.array(told)

    def _at(self, tangent: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Widths and their σ over all distances in a direction."""
        place = np.interp(tangent, self.tangents, np.arange(_COLUMNS))
        left = min(int(place), _COLUMNS - 2)
        part = place - left
        return tuple(  # type: ignore[return-value]
            (1 - part) * table[:, left] + part * table[:, left + 1]
            for table in (self.widths, self.spread)
        )


def _moments(values: NDArray[np.float64], weights: NDArray[np.float64]) -> tuple[float, float]:
    """Mean and standard deviation; not less than the distance of two nodes over √12."""
    mean = float(values @ weights)
    variance = float((values - mean) ** 2 @ weights)
    at = min(int(np.searchsorted(values, mean)), len(values) - 1)
    step = float(abs(values[at] - values[max(at - 1, 0)]))
    return mean, math.sqrt(variance + step**2 / 12)


def _width(
    system: OpticalSystem,
    camera: Camera,
    finder: SpikeFinder,
    sensor: LineSensor,
    wavelength: float,
    extent: float,
    distance: float,
    tangent: float,
) -> float:
    """Width of an LED's spike at a distance in a direction, px."""
    place = (-tangent * (distance + camera.pupil), 0.0, distance)
    light = pixel_response(system, place, sensor, wavelength=wavelength, rays=RAYS)
    if not light.any():
        raise ValueError(
            f"{system.name}: no light of an LED at X = {place[0]:.0f}, distance {distance:.0f} mm "
            "falls on the line; take a smaller half_field"
        )
    size = extent * abs(float(camera.jacobian(place)[0]))
    light = np.convolve(light, disc_image(size), "same")
    spike = finder.profile(light * (PEAK / light.max()))
    # in focus, light on one pixel is no spike
    return spike.width if spike.found else 1.0


RAYS = (192, 48)
"""Over the opening, for widths."""
