"""Poses: from spikes of LEDs at known places to where the tracker is, and how sure that is.

A pose is x, y (mm) and heading (rad) of the tracker's first vertex in the room; its height is known,
or is integrated over. Two LEDs tell x and y if the heading is known, three tell it too; but not where
LEDs and tracker lie on one circle, from all points of which the LEDs appear under the same angles.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntFlag
from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from raytransfer import _checks as check
from raytransfer.localisation import pose_bound

if TYPE_CHECKING:
    from collections.abc import Sequence
    from types import ModuleType

    from numpy.typing import ArrayLike, NDArray

    from tracking.camera import Camera


class PoseFlags(IntFlag):
    """What a pose must not be trusted in; 0 is nothing."""

    NONE = 0
    PREDICTED = 1
    """No LED was found: motion alone was carried on."""
    LOST = 2
    """Lock was lost: the pose is of the last time that it was known."""
    RELOCALISED = 4
    """The first pose after lock was lost."""
    REJECTED = 8
    """A measurement was refused as a gross error."""
    AMBIGUOUS = 16
    """Another pose explains the measurements as well."""
    DANGER_CIRCLE = 32
    """LEDs and tracker lie near one circle: position and heading cannot be told apart."""
    INCONSISTENT = 64
    """Residuals are larger than the errors stated: something is wrong with the calibration."""
    HEADING_ASSUMED = 128
    """Heading was not measured but given."""


@dataclass(frozen=True)
class Estimate:
    """A pose at a time, one line of the output.

    Parameters
    ----------
    t_ns : int
        Device time, ns: the end of the exposure, or the time predicted to.
    x, y : float
        mm.
    heading : float
        rad.
    covariance : ndarray, shape (3, 3)
        Of x, y and heading.
    flags : PoseFlags
    """

    t_ns: int
    x: float
    y: float
    heading: float
    covariance: NDArray[np.float64]
    flags: PoseFlags = PoseFlags.NONE


class Prior(NamedTuple):
    """What is known of a number beforehand.

    Attributes
    ----------
    value : float
    sigma : float
        Standard deviation: 0 if it is known, infinite if not.
    """

    value: float
    sigma: float


UNKNOWN = Prior(0.0, math.inf)
KNOWN = Prior(0.0, 0.0)


@dataclass(frozen=True)
class Fix:
    """A pose from spikes of one moment.

    Attributes
    ----------
    x, y : float
        mm.
    heading : float
        rad, −π to π.
    height : float
        Of the tracker, mm; the mean, if it was not known. Above and below LEDs of one height are
        the same to a cylinder.
    covariance : ndarray, shape (3, 3)
        Of x, y and heading, of whatever height may be. Variances of what is not determined are
        infinite.
    residuals : ndarray, shape (N,)
        Measured minus expected, px, of rejected spikes too, at the height that fits best.
    rejected : ndarray of bool, shape (N,)
    chi2 : float
        Sum of squares of residuals over σ, of priors too, at the height that fits best.
    degrees : int
        Of freedom of `chi2`.
    flags : PoseFlags
    sigma_height : float
        mm.
    """

    x: float
    y: float
    heading: float
    height: float
    covariance: NDArray[np.float64]
    residuals: NDArray[np.float64]
    rejected: NDArray[np.bool_]
    chi2: float
    degrees: int
    flags: PoseFlags
    sigma_height: float = 0.0

    def at(self, t_ns: int) -> Estimate:
        """Return the pose as an estimate at a time."""
        return Estimate(t_ns, self.x, self.y, self.heading, self.covariance, self.flags)


def optical(
    positions: ArrayLike,
    x: ArrayLike,
    y: ArrayLike,
    heading: ArrayLike = 0.0,
    height: ArrayLike = 0.0,
) -> NDArray[np.float64]:
    """Points of the room as a tracker sees them.

    Parameters
    ----------
    positions : array_like, shape (N, 3)
        Room x, y and z, mm.
    x, y, heading, height : array_like
        Tracker, mm and rad; any shapes that broadcast.

    Returns
    -------
    ndarray, shape (broadcast shape of the pose) + (N, 3)
        Optical X, Y and distance, mm; the distance is negative behind the tracker.
    """
    points = _positions(positions)
    poses = [
        check.array(name, value)
        for name, value in (("x", x), ("y", y), ("heading", heading), ("height", height))
    ]
    tracker_x, tracker_y, turned, z = (p[..., None] for p in np.broadcast_arrays(*poses))
    dx, dy = points[:, 0] - tracker_x, points[:, 1] - tracker_y
    sin, cos = np.sin(turned), np.cos(turned)
    return np.stack(
        np.broadcast_arrays(-cos * dx - sin * dy, points[:, 2] - z, sin * dx - cos * dy), axis=-1
    )


def closed_form(
    tangents: ArrayLike,
    points: ArrayLike,
    sigma: ArrayLike | None = None,
    *,
    heading: float | None = None,
) -> tuple[float, float, float]:
    """Pose of the centre of projection from tangents, without iteration.

    Every LED says C (X + m Y) − S (m X − Y) − P + m Q = 0, C and S the heading's cosine and sine,
    P = C x + S y, Q = S x − C y. P and Q are eliminated, (C, S) is a singular vector; that LEDs are
    in front decides the sign. Without noise the pose is exact but for rounding, which grows as the
    LEDs and the tracker come to lie on one circle: the error is about 1e-13 mm over the share of the
    heading's information that position does not explain away (`locate` flags less than 1e-4 of it as
    DANGER_CIRCLE). With noise, equations are weighted by distance and solved a second time.

    Parameters
    ----------
    tangents : array_like, shape (N,)
        m of `Camera.tangent`: −X / distance.
    points : array_like, shape (N, 2)
        Room x and y of the LEDs, mm.
    sigma : array_like, shape (N,), optional
        Relative standard deviations of the tangents; all the same when left out.
    heading : float, optional
        rad, if it is known.

    Returns
    -------
    x, y, heading : float
        mm and rad.

    Raises
    ------
    ValueError
        If there are fewer than three LEDs (two with known heading), or no pose has them in front.
    """
    m, places = check.array("tangents", tangents), check.array("points", points)
    if places.ndim != 2 or places.shape[1] != 2 or m.shape != (len(places),):
        raise ValueError(
            f"tangents has shape (N,) and points (N, 2), room x and y in mm, not {m.shape} and "
            f"{places.shape}"
        )
    _enough(len(m), heading is not None)
    spread = np.ones(len(m)) if sigma is None else check.positive_array("sigma", sigma)
    if spread.shape != m.shape:
        raise ValueError(f"sigma has shape {m.shape}, one per tangent, not {spread.shape}")
    pose = np.array([0.0, 0.0, 0.0 if heading is None else _angle("heading", heading)])
    kernels, known = load_kernels(), heading is not None
    x, y, weight = places[:, 0].copy(), places[:, 1].copy(), 1 / spread
    for _ in range(2):
        found = kernels.closed_form(m, x, y, weight, known, pose)
        ahead = np.sin(pose[2]) * (x - pose[0]) - np.cos(pose[2]) * (y - pose[1])
        if not (found and (ahead > 0).all()):
            raise ValueError(
                f"tangents {m.round(4).tolist()} fit no pose with all LEDs in front: are LEDs and "
                "tangents in the same order, and larger tangents those of larger room x?"
            )
        weight = 1 / (spread * ahead)
    return float(pose[0]), float(pose[1]), float(pose[2])


def two_leds(
    camera: Camera, leds: ArrayLike, pixels: ArrayLike, heading: float = 0.0
) -> tuple[float, float]:
    """Position from two LEDs at the tracker's height with known heading, in closed form.

    Parameters
    ----------
    camera : Camera
    leds : array_like, shape (2, 3)
        Room positions, mm.
    pixels : array_like, shape (2,)
        Their spikes, px.
    heading : float
        rad. An error of 1° moves the result by 2 % of the distance, mostly along x.

    Returns
    -------
    x, y : float
        mm.

    Raises
    ------
    ValueError
        If the spikes fit no position before the LEDs.
    """
    places, spikes = _positions(leds), _spikes(pixels, 2)
    if len(places) != 2:
        raise ValueError(f"leds has shape (2, 3), not {places.shape}; for more there is locate")
    turned = _angle("heading", heading)
    x, y, _ = closed_form(camera.tangent(spikes), places[:, :2], heading=turned)
    return x + camera.pupil * math.sin(turned), y - camera.pupil * math.cos(turned)


def locate(
    camera: Camera,
    positions: ArrayLike,
    pixels: ArrayLike,
    sigma: ArrayLike,
    *,
    heading: Prior = UNKNOWN,
    height: Prior = KNOWN,
    start: tuple[float, float, float] | None = None,
) -> Fix:
    """Pose from the spikes of LEDs at known places: weighted least squares, without gross errors.

    What height does to spikes is of second order in it, so a height that is not known is integrated
    over: mean and covariance are those of poses at all heights from which light can arrive, each as
    likely as its prior and the spikes make it.

    A fit that is less likely than 1 in 10⁴ is repeated without the spikes that disagree with the
    others, if these are less than a third: more is no gross error but a wrong map, camera or height.

    Parameters
    ----------
    camera : Camera
        Its `model_error` is added to every σ, squares to squares.
    positions : array_like, shape (N, 3)
        Room x, y and z of the LEDs, mm.
    pixels, sigma : array_like, shape (N,)
        Their spikes and standard deviations, px. Spikes that are NaN or have infinite σ are left
        out as if they were not there.
    heading, height : Prior
        Height in mm, heading in rad.
    start : tuple of float, optional
        x, y and heading to begin with; from the closed form when left out.

    Returns
    -------
    Fix
        With fewer than three spikes the heading is the prior's value: the pose is flagged
        HEADING_ASSUMED, and AMBIGUOUS if nothing is known of it.

    Raises
    ------
    ValueError
        If there are fewer than two spikes, shapes do not match, a number is out of range, or no
        pose has the LEDs in front.
    """
    leds = _positions(positions).copy()  # kernels are compiled for arrays that can be written
    u = check.numbers("pixels", pixels)
    spread = np.broadcast_to(check.numbers("sigma", sigma), u.shape)
    if u.shape != (len(leds),):
        raise ValueError(f"pixels has shape ({len(leds)},), one per LED, not {u.shape}")
    if (spread <= 0).any():
        raise ValueError(f"sigma = {spread[spread <= 0][0]:g} px: allowed is > 0")
    seen = np.isfinite(u) & np.isfinite(spread)
    if seen.sum() < 2:
        raise ValueError(
            f"{seen.sum()} spikes: a pose needs 2 with known heading, 3 without; "
            "a single one is for the motion filter"
        )
    heading, height = _prior("heading", heading), _prior("height", height)
    _angle("heading.value", heading.value)
    inverse = np.zeros(len(u))
    inverse[seen] = 1 / np.hypot(spread[seen], camera.model_error)
    problem = _Problem(camera, leds, np.where(seen, u, 0.0), inverse, heading, height)
    answer = problem.solve(seen, start)
    if start is not None and not answer.chi2 <= _limit(answer.degrees, REFUSED):
        answer = min(answer, problem.solve(seen), key=lambda a: a.chi2)
    flags = PoseFlags.NONE
    if not answer.chi2 <= _limit(answer.degrees, REFUSED):
        answer, flags = problem.without_gross_errors(answer, seen)
    return problem.fix(answer, seen, flags)


REFUSED = 1e-4
"""Probability of a larger χ² below which gross errors are looked for."""

INCONSISTENT = 1e-3
"""The same, below which a pose is flagged."""

PLAUSIBLE = 0.01
"""The same, above which a set of spikes could be the right one."""

TRUSTED = 0.2
"""Standard deviation of a heading, rad, up to which it is what a fit begins with."""

AGREES = 4.0
"""Residual, in σ, up to which a spike agrees with others."""

TRIES = 400
"""Minimal sets of LEDs that are tried, at most."""

ON_CIRCLE = 1e-4
"""Part of the heading's information that is left where LEDs and tracker are said to lie on a circle."""


class _Answer(NamedTuple):
    pose: NDArray[np.float64]
    covariance: NDArray[np.float64]
    chi2: float
    degrees: int
    height: float
    sigma_height: float
    determined: bool
    chosen: NDArray[np.bool_]
    likeliest: NDArray[np.float64]  # pose and height of the least χ²


@dataclass(frozen=True)
class _Problem:
    """Spikes and all that is known; arrays as the kernels want them."""

    camera: Camera
    leds: NDArray[np.float64]
    pixels: NDArray[np.float64]
    inverse: NDArray[np.float64]
    heading: Prior
    height: Prior

    def _known(self, count: int) -> bool:
        return self.heading.sigma == 0 or (count < 3 and math.isinf(self.heading.sigma))

    def begin(
        self, chosen: NDArray[np.bool_], height: float, *, known: bool
    ) -> NDArray[np.float64] | None:
        """Closed-form pose at a height, if there is one with the LEDs in front."""
        pose = np.array([0.0, 0.0, self.heading.value])
        done = load_kernels().begin(
            self.camera.coefficients,
            self.leds,
            self.pixels,
            self.inverse,
            chosen,
            height,
            known,
            pose,
        )
        return pose if done else None

    def solve(
        self, chosen: NDArray[np.bool_], start: Sequence[float] | NDArray[np.float64] | None = None
    ) -> _Answer:
        """Fit these spikes; χ² is infinite if that cannot be."""
        count = int(chosen.sum())
        known = self._known(count)
        degrees = count - 2
        degrees -= math.isinf(self.heading.sigma) and not known
        degrees -= math.isinf(self.height.sigma)
        first = None
        if start is not None:
            first = np.array([*(check.number("start", v) for v in start)])
            if known:
                first[2] = self.heading.value
        else:
            # with two LEDs a heading of some uncertainty begins with its mean
            trusted = known or count < 3 or self.heading.sigma < TRUSTED
            first = self.begin(chosen, self.height.value, known=trusted)
            if first is None and not known:
                first = self.begin(chosen, self.height.value, known=not trusted)
        covariance = np.zeros((3, 3))
        nowhere = np.full(4, math.nan)
        failed = _Answer(
            nowhere[:3], covariance, math.inf, degrees, math.nan, 0.0, False, chosen, nowhere
        )
        if first is None:
            return failed
        kernels = load_kernels()
        sharpness = math.inf if known else 1 / self.heading.sigma**2
        at = (self.camera.coefficients, self.leds, self.pixels, self.inverse, chosen)
        turn = (self.heading.value, sharpness)
        if self.height.sigma == 0:
            chi2, root = kernels.fit(*at, self.height.value, *turn, first, covariance)
            high, high_sigma, determined = self.height.value, 0.0, not math.isnan(root)
            likeliest = np.append(first, high)
        else:
            likeliest = np.empty(4)
            chi2, high, high_sigma, determined = kernels.over_heights(
                *at, *self.height, self.camera.elevation, *turn, first, covariance, likeliest
            )
        if math.isinf(chi2):
            return failed
        return _Answer(
            first, covariance, chi2, degrees, high, high_sigma, determined, chosen, likeliest
        )

    def without_gross_errors(
        self, full: _Answer, seen: NDArray[np.bool_]
    ) -> tuple[_Answer, PoseFlags]:
        """Fit most spikes, leaving out those that disagree."""
        count = int(seen.sum())
        fewest = 3 + (count >= 3 and math.isinf(self.heading.sigma))  # one more than is needed
        if count <= fewest:
            # whichever is left out, the others agree
            several = PoseFlags.AMBIGUOUS if count == fewest else PoseFlags.NONE
            return full, several
        candidates = [self._without(seen, np.arange(len(seen)) == i) for i in np.flatnonzero(seen)]
        if (agreed := self._consensus(seen)) is not None:
            candidates.append(agreed)
        good = [
            c
            for c in candidates
            if c.chosen.sum() >= max(fewest, count - (count - 1) // 3)
            and c.chi2 <= _limit(c.degrees, INCONSISTENT)
        ]
        if not good:
            return full, PoseFlags.NONE
        # the fewest refused, then the best fit
        most = max(int(c.chosen.sum()) for c in good)
        equal = sorted((c for c in good if c.chosen.sum() == most), key=lambda c: c.chi2)
        best = equal[0]
        others = [
            c
            for c in equal[1:]
            if (c.chosen != best.chosen).any() and c.chi2 <= _limit(c.degrees, PLAUSIBLE)
        ]
        flags = PoseFlags.REJECTED
        if any(_apart(best, c) for c in others):
            flags |= PoseFlags.AMBIGUOUS
        return best, flags

    def _without(self, seen: NDArray[np.bool_], gone: NDArray[np.bool_]) -> _Answer:
        return self.solve(seen & ~gone)

    def _consensus(self, seen: NDArray[np.bool_]) -> _Answer | None:
        """Fit the spikes that agree with the best minimal set."""
        best, found = math.inf, None
        for high in self._heights():
            pose = np.array([0.0, 0.0, self.heading.value])
            cost = load_kernels().consensus(
                self.camera.coefficients,
                self.leds,
                self.pixels,
                self.inverse,
                seen,
                high,
                self.heading.sigma == 0,
                AGREES,
                TRIES,
                pose,
            )
            if cost < best:
                best, found = cost, np.append(pose, high)
        if found is None:
            return None
        chosen = seen & (np.abs(self.residuals(found)) * self.inverse < AGREES)
        answer = None
        for _ in range(5):
            if chosen.sum() < 3:
                return answer
            answer = self.solve(chosen)
            if math.isinf(answer.chi2):
                return None
            again = seen & (np.abs(self.residuals(answer.likeliest)) * self.inverse < AGREES)
            if (again == chosen).all():
                break
            chosen = again
        return answer

    def _heights(self) -> list[float]:
        """Heights that stand for all that are likely."""
        if self.height.sigma == 0:
            return [self.height.value]
        spread = self.height.sigma
        if math.isinf(spread):
            apart = np.ptp(self.leds[:, 0])
            spread = self.camera.elevation * max(apart, 1000.0)
        return [self.height.value + k * spread for k in (-1.5, -0.7, 0.0, 0.7, 1.5)]

    def residuals(self, at: NDArray[np.float64]) -> NDArray[np.float64]:
        """Measured minus expected at x, y, heading and height, px."""
        x, y, heading, height = at.tolist()
        points = optical(self.leds, x, y, heading, height)
        return np.asarray(self.pixels - self.camera.project(points))

    def fix(self, answer: _Answer, seen: NDArray[np.bool_], flags: PoseFlags) -> Fix:
        """Return the result with all its warnings."""
        if math.isinf(answer.chi2):
            raise ValueError(
                f"spikes at {self.pixels[seen].round(2).tolist()} px fit no pose with their LEDs "
                "in front: are LEDs and spikes in the same order, positions in mm and the heading "
                f"({self.heading.value:g}) in rad?"
            )
        chosen = answer.chosen
        count = int(chosen.sum())
        covariance = answer.covariance
        if self.heading.sigma == 0 or count < 3:
            flags |= PoseFlags.HEADING_ASSUMED
        if count < 3 and math.isinf(self.heading.sigma):
            flags |= PoseFlags.AMBIGUOUS
            covariance = np.full((3, 3), math.inf)
        elif not answer.determined:
            covariance = self._bound(answer)
        elif self.heading.sigma > 0 and count >= 3:
            share = load_kernels().heading_seen(
                self.camera.coefficients,
                self.leds,
                self.inverse,
                chosen,
                answer.height,
                answer.pose,
            )
            if share < ON_CIRCLE:
                flags |= PoseFlags.DANGER_CIRCLE
        if not answer.determined and count >= 3:
            flags |= PoseFlags.DANGER_CIRCLE
        if not answer.chi2 <= _limit(answer.degrees, INCONSISTENT):
            flags |= PoseFlags.INCONSISTENT
        x, y, turned = answer.pose.tolist()
        residuals = self.residuals(answer.likeliest)
        residuals[~seen] = math.nan
        return Fix(
            x,
            y,
            math.remainder(turned, math.tau),
            answer.height,
            covariance,
            residuals,
            seen & ~chosen,
            answer.chi2,
            answer.degrees,
            flags,
            answer.sigma_height,
        )

    def _bound(self, answer: _Answer) -> NDArray[np.float64]:
        """Covariance with infinities where nothing is known."""
        chosen = answer.chosen
        x, y, heading, height = answer.likeliest.tolist()
        rows = pose_jacobian(self.camera, self.leds[chosen], x, y, heading, height)
        found = pose_bound(rows, 1 / self.inverse[chosen], sigma_heading=self.heading.sigma)
        return found.covariance


def pose_jacobian(
    camera: Camera,
    positions: ArrayLike,
    x: ArrayLike,
    y: ArrayLike,
    heading: ArrayLike = 0.0,
    height: ArrayLike = 0.0,
) -> NDArray[np.float64]:
    """Change of the spikes with x, y (px per mm) and heading (px per rad).

    Parameters
    ----------
    camera, positions, x, y, heading, height
        As for `optical`.

    Returns
    -------
    ndarray, shape (broadcast shape of the pose) + (N, 3)
    """
    points = optical(positions, x, y, heading, height)
    by_x, _, by_distance = np.moveaxis(camera.jacobian(points), -1, 0)
    turned = np.asarray(heading, dtype=float)[..., None]
    sin, cos = np.sin(turned), np.cos(turned)
    return np.stack(
        [
            by_x * cos - by_distance * sin,
            by_x * sin + by_distance * cos,
            by_x * points[..., 2] - by_distance * points[..., 0],
        ],
        axis=-1,
    )


class Dilution(NamedTuple):
    """How errors of spikes become errors of poses.

    Attributes
    ----------
    x, y : ndarray
        Standard deviations, mm; infinite where the pose is not determined.
    heading : ndarray
        rad.
    """

    x: NDArray[np.float64]
    y: NDArray[np.float64]
    heading: NDArray[np.float64]


def dilution(
    camera: Camera,
    positions: ArrayLike,
    x: ArrayLike,
    y: ArrayLike,
    heading: ArrayLike = 0.0,
    *,
    height: ArrayLike = 0.0,
    sigma: float = 1.0,
    sigma_heading: float = math.inf,
) -> Dilution:
    """Standard deviations of poses, from all LEDs whose spikes are on the line.

    Parameters
    ----------
    camera, positions, x, y, heading, height
        As for `optical`; x and y are usually a grid.
    sigma : float
        Of every spike, px. With 1 px and a heading that is known or unknown this is the dilution
        of precision, per px.
    sigma_heading : float
        What is known of the heading, rad: 0 if it is known, infinite if not.

    Returns
    -------
    Dilution
        Arrays of the broadcast shape of the pose.
    """
    check.positive("sigma", sigma, "px")
    if not sigma_heading >= 0:
        raise ValueError(
            f"sigma_heading = {sigma_heading}: allowed is 0 (known) to infinity (unknown)"
        )
    rows = pose_jacobian(camera, positions, x, y, heading, height) / sigma
    seen = camera.sees(optical(positions, x, y, heading, height))
    rows = np.where(seen[..., None], rows, 0.0)
    size = 3 if sigma_heading else 2
    information = np.swapaxes(rows, -1, -2)[..., :size, :] @ rows[..., :size]
    if sigma_heading:
        information[..., 2, 2] += 1 / sigma_heading**2
    scale = np.sqrt(np.einsum("...ii->...i", information))
    scale = np.where(scale > 0, scale, 1.0)
    # as correlations: rounding leaves about 1e-15 of what is not determined
    values, vectors = np.linalg.eigh(information / scale[..., :, None] / scale[..., None, :])
    with np.errstate(divide="ignore"):
        inverse = np.where(values > 1e-13, 1 / np.maximum(values, 1e-300), math.inf)
    share = vectors**2
    with np.errstate(invalid="ignore"):
        variance = np.where(
            (share > 1e-18) | np.isfinite(inverse[..., None, :]),
            share * inverse[..., None, :],
            0.0,
        ).sum(axis=-1)
    spread = np.sqrt(variance) / scale
    if not sigma_heading:
        spread = np.concatenate([spread, np.zeros((*spread.shape[:-1], 1))], axis=-1)
    return Dilution(*np.moveaxis(spread, -1, 0))


def load_kernels() -> ModuleType:
    """Return the compiled kernels; the first call loads them."""
    from tracking import _poses  # numba is slow to load

    return _poses


@lru_cache(maxsize=256)
def _limit(degrees: int, probability: float) -> float:
    """χ² that is exceeded with a probability."""
    from scipy.special import chdtri  # type: ignore[import-untyped]  # slow to load

    # without degrees of freedom only rounding and the steps of the height are left
    return float(chdtri(max(degrees, 1), probability))


def _apart(one: _Answer, other: _Answer) -> bool:
    """Whether two poses differ by more than they scatter."""
    away = one.pose - other.pose
    spread = np.sqrt(np.diag(one.covariance) + np.diag(other.covariance))
    return bool((np.abs(away) > 3 * spread).any())


def _positions(positions: ArrayLike) -> NDArray[np.float64]:
    points = check.array("positions", positions)
    if points.ndim != 2 or points.shape[1] != 3:
        raise ValueError(f"positions has shape (N, 3), room x, y and z in mm, not {points.shape}")
    return np.ascontiguousarray(points)


def _spikes(pixels: ArrayLike, count: int) -> NDArray[np.float64]:
    spikes = check.array("pixels", pixels)
    if spikes.shape != (count,):
        raise ValueError(f"pixels has shape ({count},), one per LED, not {spikes.shape}")
    return spikes


def _prior(name: str, prior: Prior) -> Prior:
    value, sigma = check.number(f"{name}.value", prior[0]), float(prior[1])
    if not sigma >= 0:
        raise ValueError(f"{name}.sigma = {sigma}: allowed is 0 (known) to infinity (unknown)")
    return Prior(value, sigma)


def _angle(name: str, value: float) -> float:
    angle = check.number(name, value)
    if abs(angle) > math.tau:
        raise ValueError(f"{name} = {angle:g} rad: allowed are −2π to 2π; was it given in degrees?")
    return angle


def _enough(count: int, known: bool) -> None:
    if count < 3 - known:
        raise ValueError(f"{count} LEDs: a pose needs 3, or 2 if the heading is known (heading=…)")
