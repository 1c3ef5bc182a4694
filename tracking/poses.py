"""Poses: from spikes of LEDs at known places to where the tracker is, and how sure that is.

A pose is x, y (mm) and heading (rad) of the tracker's first vertex in the room; its height is known,
or is integrated over. Two LEDs tell x and y if the heading is known, three tell it too; but not where
LEDs and tracker lie on one circle, from all points of which the LEDs appear under the same angles.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import IntFlag
from functools import lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from raytransfer import _checks as check
from raytransfer.localisation import pose_bound
from raytransfer.sensors import TCD1304
from tracking.leds import check_extent, check_facings

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
    """LEDs and tracker lie near one circle: position and heading can hardly be told apart. Within
    their errors spikes are not linear in them, and the covariance is not what poses scatter by."""
    INCONSISTENT = 64
    """Residuals are larger than the errors stated: something is wrong with the calibration."""
    HEADING_ASSUMED = 128
    """Heading was not measured but given."""
    UNCHECKED = 256
    """The others do not check every spike: a gross error of one could have moved the pose by more
    than `HIDDEN` σ and not have been found."""


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
        Of x, y and heading. What the camera's model leaves is in it (`Camera.model_error`), but is
        the same in all estimates of one place.
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
    heading's information that position does not explain away. With noise, equations are weighted by distance and solved a second time.

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
    pose = np.array([0.0, 0.0, 0.0 if heading is None else check.angle("heading", heading)])
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
    places, spikes = _positions(leds), _spikes(check.array("pixels", pixels), 2)
    if len(places) != 2:
        raise ValueError(f"leds has shape (2, 3), not {places.shape}; for more there is locate")
    turned = check.angle("heading", heading)
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
    facings: ArrayLike | None = None,
) -> Fix:
    """Pose from the spikes of LEDs at known places: weighted least squares, without gross errors.

    What height does to spikes is of second order in it, so a height that is not known is integrated
    over: mean and covariance are those of poses at all heights from which light can arrive, each as
    likely as its prior and the spikes make it.

    A fit that is less likely than 1 in 10⁴, or has a spike 4 σ off what the others say, is repeated
    without the spikes that disagree with the others, if these are less than a third: more is no
    gross error but a wrong map, camera or height. What the others do not say cannot be checked: of
    three spikes, or two with known heading, nothing, and of four or five not enough to be sure
    (`PoseFlags.UNCHECKED`).

    Parameters
    ----------
    camera : Camera
        Its `model_error` is added to every σ, squares to squares.
    positions : array_like, shape (N, 3)
        Room x, y and z of the LEDs, mm.
    pixels, sigma : array_like, shape (N,)
        Their spikes and standard deviations, px; one σ may stand for all. Spikes that are NaN or
        have infinite σ are left out as if they were not there.
    heading, height : Prior
        Height in mm, heading in rad.
    start : tuple of float, optional
        x, y and heading to begin with; from the closed form when left out.
    facings : array_like, shape (N,), optional
        Directions in which the LEDs shine, rad, counter-clockwise from +y; one may stand for all.
        No pose is looked for where they shine away from it. When left out they may be seen from
        anywhere: then a line of LEDs in reversed order, heading unknown, has a pose behind it.

    Returns
    -------
    Fix
        With fewer than three spikes the heading is the prior's value: the pose is flagged
        HEADING_ASSUMED, and AMBIGUOUS if nothing is known of it.

    Raises
    ------
    ValueError
        If there are fewer than two spikes, shapes do not match, a number is out of range, a spike
        is more than the line's length off the line, all LEDs are within 20 mm, or no pose has the
        LEDs in front, and itself on their lit side.
    """
    leds = _positions(positions)
    u = check.numbers("pixels", pixels)
    given = check.numbers("sigma", sigma)
    if u.shape != (len(leds),):
        raise ValueError(f"pixels has shape ({len(leds)},), one per LED, not {u.shape}")
    if given.shape not in {(), u.shape}:
        raise ValueError(f"sigma is one number or has shape {u.shape}, not {given.shape}")
    spread = np.broadcast_to(given, u.shape)
    found = np.isfinite(u)
    if (wrong := spread[found & ~(spread > 0)]).size:
        raise ValueError(
            f"sigma = {wrong[0]:g} px: allowed is > 0, infinite for a spike to be left out"
        )
    seen = found & np.isfinite(spread)
    if seen.sum() < 2:
        raise ValueError(
            f"{seen.sum()} spikes: a pose needs 2 with known heading, 3 without; "
            "a single one is for the motion filter"
        )
    _spikes(u[seen], int(seen.sum()))
    check_extent(leds[seen])
    heading, height = _prior("heading", heading), _prior("height", height)
    check.angle("heading.value", heading.value)
    if math.pi < heading.sigma < math.inf:
        raise ValueError(
            f"heading.sigma = {heading.sigma:g} rad: allowed are 0 to π, and infinity if nothing is "
            "known; was it given in degrees?"
        )
    if start is not None:
        if len(start) != 3:
            raise ValueError(f"start is x, y and heading, not {len(start)} numbers")
        x, y, turned = start
        start = (
            check.number("start[0]", x),
            check.number("start[1]", y),
            check.angle("start[2]", turned),
        )
    normals = np.zeros((len(leds), 2))
    if facings is not None:
        shines = check_facings(facings, len(leds))
        normals = np.column_stack([-np.sin(shines), np.cos(shines)])
    problem = _Problem(
        camera,
        np.hstack([leds, normals])[seen],
        u[seen],
        1 / np.hypot(spread[seen], camera.model_error),
        heading,
        height,
    )
    every = np.ones(int(seen.sum()), dtype=np.bool_)
    answer = problem.solve(every, start)
    if start is not None and not answer.chi2 <= _limit(answer.degrees, REFUSED):
        answer = min(answer, problem.solve(every), key=lambda a: a.chi2)
    flags = PoseFlags.NONE
    if problem.suspect(answer):
        answer, flags = problem.without_gross_errors(answer)
    fix = problem.fix(answer, flags)
    residuals, rejected = np.full(len(u), math.nan), np.zeros(len(u), dtype=np.bool_)
    residuals[seen], rejected[seen] = fix.residuals, fix.rejected
    return replace(fix, residuals=residuals, rejected=rejected)


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

HIDDEN = 6.0
"""How far, in σ of the pose, a gross error may move it before it is found, or the pose is flagged."""

ROUNDING = 1e-9
"""Part of an error that is left in a residual, below which it is none."""

BENT = 0.5
"""Second-order over first-order part of what spikes do within 2 σ of the pose, above which LEDs and
tracker are said to lie on a circle."""

OUT_OF_REACH = 1e4
"""mm; an unknown height is no farther off."""


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
    residuals: NDArray[np.float64]  # there, px, of spikes that were not chosen too
    left: NDArray[np.float64]  # part of each error that its residual shows


@dataclass(frozen=True)
class _Problem:
    """Spikes that were seen and all that is known; arrays as the kernels want them."""

    camera: Camera
    leds: NDArray[np.float64]  # x, y, z, and the normal of the lit side
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
            first = np.array(start)
            if known:
                first[2] = self.heading.value
        else:
            # with two LEDs a heading of some uncertainty begins with its mean
            trusted = known or count < 3 or self.heading.sigma < TRUSTED
            first = self.begin(chosen, self.height.value, known=trusted)
            if first is None and not known:
                first = self.begin(chosen, self.height.value, known=not trusted)
        covariance = np.zeros((3, 3))
        nowhere, none = np.full(4, math.nan), np.full(len(chosen), math.nan)
        failed = _Answer(
            *(nowhere[:3], covariance, math.inf, degrees, math.nan, 0.0, False),
            *(chosen, nowhere, none, none),
        )
        if first is None:
            return failed
        kernels = load_kernels()
        sharpness = math.inf if known else _sharpness(self.heading.sigma)
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
            *(first, covariance, chi2, degrees, high, high_sigma, determined),
            *(chosen, likeliest, *self.judge(likeliest, chosen)),
        )

    def judge(
        self, at: NDArray[np.float64], chosen: NDArray[np.bool_]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Residuals at x, y, heading and height, px, and the part of errors that is left in them."""
        residuals, left = np.empty((2, len(self.pixels)))
        known = self._known(int(chosen.sum()))
        load_kernels().judge(
            self.camera.coefficients,
            self.leds,
            self.pixels,
            self.inverse,
            chosen,
            float(at[3]),
            _sharpness(min(self.height.sigma, OUT_OF_REACH)),
            math.inf if known else _sharpness(self.heading.sigma),
            at[:3],
            residuals,
            left,
        )
        return residuals, left

    def suspect(self, answer: _Answer) -> bool:
        """Whether the spikes disagree, all of them or one with what the others say."""
        if not answer.chi2 <= _limit(answer.degrees, REFUSED):
            return True
        checked = answer.left > ROUNDING
        off = np.abs(answer.residuals) * self.inverse
        return bool((off[checked] > AGREES * np.sqrt(answer.left[checked])).any())

    def without_gross_errors(self, full: _Answer) -> tuple[_Answer, PoseFlags]:
        """Fit most spikes, leaving out those that disagree."""
        count = len(self.pixels)
        fewest = 3 + (count >= 3 and not self._told(full))  # one more than is needed
        if count <= fewest:
            # whichever is left out, the others agree
            several = PoseFlags.AMBIGUOUS if count == fewest else PoseFlags.NONE
            return full, several
        candidates = [self.solve(np.arange(count) != i) for i in range(count)]
        if (agreed := self._consensus()) is not None:
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

    def _told(self, answer: _Answer) -> bool:
        """Whether the heading is known beforehand at least as well as the spikes tell it."""
        if self.heading.sigma == 0 or math.isinf(self.heading.sigma):
            return self.heading.sigma == 0
        if math.isinf(answer.chi2) or not answer.determined:
            return True
        return bool(answer.covariance[2, 2] > 0.5 * self.heading.sigma**2)

    def _consensus(self) -> _Answer | None:
        """Fit the spikes that agree with the best minimal set."""
        every = np.ones(len(self.pixels), dtype=np.bool_)
        best, found = math.inf, None
        for high in self._heights():
            pose = np.array([0.0, 0.0, self.heading.value])
            cost = load_kernels().consensus(
                self.camera.coefficients,
                self.leds,
                self.pixels,
                self.inverse,
                every,
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
        chosen = np.abs(self.judge(found, every)[0]) * self.inverse < AGREES
        answer = None
        for _ in range(5):
            if chosen.sum() < 3:
                return answer
            answer = self.solve(chosen)
            if math.isinf(answer.chi2):
                return None
            again = np.abs(answer.residuals) * self.inverse < AGREES
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

    def fix(self, answer: _Answer, flags: PoseFlags) -> Fix:
        """Return the result with all its warnings."""
        if math.isinf(answer.chi2):
            lit = " and itself on their lit side" if self.leds[:, 3:].any() else ""
            raise ValueError(
                f"spikes at {self.pixels.round(2).tolist()} px fit no pose with their LEDs "
                f"in front{lit}: are LEDs and spikes in the same order, positions in mm and the "
                f"heading ({self.heading.value:g}) in rad?"
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
        if count >= 3 and (not answer.determined or self._bent(answer)):
            flags |= PoseFlags.DANGER_CIRCLE
        # an error of which AGREES σ are left in the residual moves the pose by this much
        left = answer.left[chosen]
        if (AGREES**2 * (1 - left) > HIDDEN**2 * left).any():
            flags |= PoseFlags.UNCHECKED
        if not answer.chi2 <= _limit(answer.degrees, INCONSISTENT):
            flags |= PoseFlags.INCONSISTENT
        x, y, turned = answer.pose.tolist()
        return Fix(
            x,
            y,
            math.remainder(turned, math.tau),
            answer.height,
            covariance,
            answer.residuals,
            ~chosen,
            answer.chi2,
            answer.degrees,
            flags,
            answer.sigma_height,
        )

    def _bent(self, answer: _Answer) -> bool:
        """Whether spikes are far from linear in the pose, where it is least known."""
        if self.heading.sigma == 0:
            return False
        away = 2 * answer.covariance[2] / math.sqrt(answer.covariance[2, 2])
        away *= min(1.0, TRUSTED / away[2])  # farther is round the circle
        bend = load_kernels().bend(
            self.camera.coefficients,
            self.leds,
            self.inverse,
            answer.chosen,
            answer.height,
            answer.pose,
            away,
        )
        return bool(bend > BENT)

    def _bound(self, answer: _Answer) -> NDArray[np.float64]:
        """Covariance with infinities where nothing is known."""
        chosen = answer.chosen
        x, y, heading, height = answer.likeliest.tolist()
        rows = pose_jacobian(self.camera, self.leds[chosen, :3], x, y, heading, height)
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
    return np.stack(by_pose(by_x, by_distance, points[..., 0], points[..., 2], cos, sin), axis=-1)


def by_pose(by_x: Any, by_distance: Any, across: Any, distance: Any, cos: Any, sin: Any) -> Any:
    """Derivatives along x, y and heading from those along optical X and distance.

    Plain arithmetic: of arrays in numpy, of numbers where it is compiled.
    """
    return (
        by_x * cos - by_distance * sin,
        by_x * sin + by_distance * cos,
        by_x * distance - by_distance * across,
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
    seen = camera.sees(optical(positions, x, y, heading, height))
    rows = pose_jacobian(camera, positions, x, y, heading, height)
    bound = pose_bound(np.where(seen[..., None], rows, 0.0), sigma, sigma_heading=sigma_heading)
    return Dilution(*np.sqrt(np.moveaxis(np.diagonal(bound.covariance, axis1=-2, axis2=-1), -1, 0)))


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


def _spikes(spikes: NDArray[np.float64], count: int) -> NDArray[np.float64]:
    if spikes.shape != (count,):
        raise ValueError(f"pixels has shape ({count},), one per LED, not {spikes.shape}")
    length = TCD1304.pixels
    if (far := spikes[np.abs(spikes - length / 2) > 1.5 * length]).size:
        raise ValueError(
            f"pixels: a spike at {far[0]:g} px: the line has {length}, and one may be {length} off "
            "its ends at most"
        )
    return spikes


def _prior(name: str, prior: Prior) -> Prior:
    value, sigma = check.number(f"{name}.value", prior[0]), float(prior[1])
    if not sigma >= 0:
        raise ValueError(f"{name}.sigma = {sigma}: allowed is 0 (known) to infinity (unknown)")
    return Prior(value, sigma)


def _sharpness(sigma: float) -> float:
    """1/σ², infinite if σ is 0."""
    return 1 / sigma**2 if sigma else math.inf


def _enough(count: int, known: bool) -> None:
    if count < 3 - known:
        raise ValueError(f"{count} LEDs: a pose needs 3, or 2 if the heading is known (heading=…)")
