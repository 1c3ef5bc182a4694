"""Poses in space: two line sensors, turned against each other, see LEDs on a wall.

One line sensor tells of every LED the angle across its line, and nothing along it but what height
does to a cylinder's focal length. A second one, perpendicular to it, tells the other angle: together
they see directions, from which all six numbers of a pose follow. Three LEDs are enough for a pose,
but up to four poses fit them; a fourth LED decides.

The tracker's own frame has X to its right, Y up and Z backward; see `rotation`.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from raytransfer import _checks as check
from tracking.camera import image
from tracking.poses import (
    AGREES,
    HIDDEN,
    INCONSISTENT,
    PLAUSIBLE,
    REFUSED,
    ROUNDING,
    PoseFlags,
    _limit,
)

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import ArrayLike, NDArray

    from tracking.camera import Camera


@dataclass(frozen=True)
class MountedCamera:
    """A head on the tracker.

    Parameters
    ----------
    camera : Camera
    roll : float
        rad, about the optical axis, that is the tracker's Z: 0 has the line along the tracker's X,
        π/2 along its Y. Axes of all heads are parallel.
    offset : tuple of float
        Of the front vertex in the tracker's frame (right, up, backward), mm.
    """

    camera: Camera
    roll: float = 0.0
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        check.angle("roll of the mount", self.roll)
        if len(self.offset) != 3:
            raise ValueError(f"offset = {self.offset}: right, up and backward in mm are needed")
        for value in self.offset:
            check.number("offset of the mount", value, "mm")

    @property
    def to_optical(self) -> NDArray[np.float64]:
        """What makes optical X, Y and distance of a point of the tracker's frame less the offset."""
        sin, cos = math.sin(self.roll), math.cos(self.roll)
        return np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, -1.0]])


@dataclass(frozen=True)
class SpacePose:
    """Position and attitude of a tracker.

    Attributes
    ----------
    x, y, z : float
        mm.
    heading, pitch, roll : float
        rad, −2π to 2π; see `rotation`.
    """

    x: float
    y: float
    z: float
    heading: float = 0.0
    pitch: float = 0.0
    roll: float = 0.0

    def __post_init__(self) -> None:
        for name in ("x", "y", "z"):
            check.number(name, getattr(self, name), "mm")
        for name in ("heading", "pitch", "roll"):
            check.angle(name, getattr(self, name))


@dataclass(frozen=True)
class SpaceFix:
    """A pose in space from spikes of one moment.

    Attributes
    ----------
    pose : SpacePose
    covariance : ndarray, shape (6, 6)
        Of x, y, z, heading, pitch and roll, mm and rad; useless for the angles where the tracker
        looks straight up or down.
    residuals : ndarray, shape (cameras, N)
        Measured minus expected, px, of rejected spikes too; NaN where there is none.
    rejected : ndarray of bool, shape (cameras, N)
    chi2 : float
        Sum of squares of residuals over σ, of spikes not rejected.
    degrees : int
        Of freedom of `chi2`.
    flags : PoseFlags
    """

    pose: SpacePose
    covariance: NDArray[np.float64]
    residuals: NDArray[np.float64]
    rejected: NDArray[np.bool_]
    chi2: float
    degrees: int
    flags: PoseFlags


def rotation(heading: float, pitch: float, roll: float) -> NDArray[np.float64]:
    """Axes of the tracker in the room, as columns: right, up, backward.

    It is turned by its heading first (counter-clockwise seen from above, 0 looks along −y), then
    pitched about its own X (positive looks up), then rolled about its own Z (positive raises its
    right side).
    """
    (sh, ch), (sp, cp), (sr, cr) = ((math.sin(a), math.cos(a)) for a in (heading, pitch, roll))
    turned = np.array([[-ch, 0.0, -sh], [-sh, 0.0, ch], [0.0, 1.0, 0.0]])
    pitched = np.array([[1.0, 0.0, 0.0], [0.0, cp, -sp], [0.0, sp, cp]])
    rolled = np.array([[cr, -sr, 0.0], [sr, cr, 0.0], [0.0, 0.0, 1.0]])
    return np.asarray(turned @ pitched @ rolled)


def angles(axes: ArrayLike) -> tuple[float, float, float]:
    """Heading, pitch and roll of axes as of `rotation`, rad."""
    r = np.asarray(axes, dtype=float)
    pitch = math.asin(min(max(-r[2, 2], -1.0), 1.0))
    return math.atan2(-r[0, 2], r[1, 2]), pitch, math.atan2(r[2, 0], r[2, 1])


def spikes_of(
    cameras: Sequence[MountedCamera], positions: ArrayLike, pose: SpacePose
) -> NDArray[np.float64]:
    """Spikes of LEDs on every sensor, px, shape (cameras, N); NaN for LEDs that are not in front.

    Parameters
    ----------
    cameras : sequence of MountedCamera
    positions : array_like, shape (N, 3)
        Room x, y and z, mm.
    pose : SpacePose
    """
    axes = rotation(pose.heading, pose.pitch, pose.roll)
    own = (_points(positions) - (pose.x, pose.y, pose.z)) @ axes
    return np.stack([c.camera.project((own - c.offset) @ c.to_optical.T) for c in cameras])


def locate_in_space(
    cameras: Sequence[MountedCamera],
    positions: ArrayLike,
    pixels: ArrayLike,
    sigma: ArrayLike,
    *,
    start: SpacePose | None = None,
) -> SpaceFix:
    """Pose from the spikes of LEDs at known places on several line sensors.

    Begins with the closed-form poses of three LEDs that two sensors see, and where it is told to,
    goes on with weighted least squares of all spikes, and takes the pose that fits best. What LEDs
    near one plane look like when they are tilted the other way is always tried: from afar it is
    nearly the same. The sensors' common height coupling is solved, not assumed: each tells the
    other how high LEDs are.

    A fit that is less likely than 1 in 10⁴, or has a spike 4 σ off what the others say, is repeated
    without the spikes that disagree with the others, as few as will do and at most a third.

    Parameters
    ----------
    cameras : sequence of MountedCamera
        Two or more; lines of at least two are not parallel.
    positions : array_like, shape (N, 3)
        Room x, y and z of the LEDs, mm.
    pixels, sigma : array_like, shape (cameras, N)
        Spikes and their standard deviations, px; NaN, or infinite σ, where a sensor does not see an
        LED. A camera's `model_error` is added to σ, squares to squares.
    start : SpacePose, optional
        Where to begin, too, as from the last fix; then three LEDs need not be seen by two sensors.
        With three LEDs, the pose to which this leads is taken.

    Returns
    -------
    SpaceFix
        AMBIGUOUS with three LEDs, or if another pose fits about as well, be it without other
        spikes; REJECTED if gross errors were left out; INCONSISTENT if residuals are too large for
        σ; UNCHECKED, as with four LEDs and often with five, if the others do not tell of every spike
        whether it is wrong.

    Raises
    ------
    ValueError
        If there are fewer than three LEDs or six spikes, shapes do not match, no pose has the LEDs
        in front, or the spikes do not tell all six numbers, as of LEDs on one line.
    """
    problem = _Problem.of(cameras, positions, pixels, sigma)
    fits = problem.fits(problem.everything, None if start is None else _state(start))
    choices = [_Choice(fit, problem.everything) for fit in fits]
    flags = PoseFlags.NONE
    if not (choices and problem.agree(choices[0])):
        fewer = problem.without_gross_errors([fit.state for fit in fits])
        if fewer:
            choices = fewer
            flags |= PoseFlags.NONE if fewer[0].chosen.all() else PoseFlags.REJECTED
    if not choices:
        raise ValueError(
            "no pose has the LEDs in front: are spikes and LEDs in the same order, and is the roll "
            "of the mounts right?"
        )
    best = choices[0]
    if not best.fit.chi2 <= _limit(problem.degrees(best.chosen), INCONSISTENT):
        flags |= PoseFlags.INCONSISTENT
    if len(np.unique(problem.led[best.chosen])) < 4 or any(
        problem.rivals(best, other) for other in choices[1:]
    ):
        flags |= PoseFlags.AMBIGUOUS
    left = problem.left(best)[best.chosen]
    if (AGREES**2 * (1 - left) > HIDDEN**2 * left).any():
        flags |= PoseFlags.UNCHECKED
    return problem.fix(best, flags)


_TRIPLES = 4
"""How many sets of three LEDs a fit is begun with."""

_FEW = 5
"""LEDs up to which poses other than the one begun with, and that tilted the other way, may fit."""

_TRIES = 20
"""How many, where gross errors are looked for."""

_BASES = 3
"""Fits of all spikes from which those with one left out are begun."""

_FEWEST = 7
"""Spikes, of which one says whether the others agree."""

_CLOSE = 9.0
"""χ² by which a pose may fit worse and still count as about as good: 90 times less likely."""

_STEPS = 40
"""Of least squares, at most; from a pose that is nearly right it takes 4 to 6."""


class _State(NamedTuple):
    """Position, mm, and axes of the tracker."""

    place: NDArray[np.float64]
    axes: NDArray[np.float64]


class _Fit(NamedTuple):
    chi2: float
    state: _State


class _Choice(NamedTuple):
    """A fit of some of the spikes."""

    fit: _Fit
    chosen: NDArray[np.bool_]


def _state(pose: SpacePose) -> _State:
    return _State(np.array([pose.x, pose.y, pose.z]), rotation(pose.heading, pose.pitch, pose.roll))


@dataclass(frozen=True, eq=False)
class _Problem:
    """Spikes one after the other, with LED and sensor of each."""

    cameras: tuple[MountedCamera, ...]
    positions: NDArray[np.float64]  # (N, 3)
    shape: tuple[int, int]
    sensor: NDArray[np.intp]  # (K,)
    led: NDArray[np.intp]
    pixels: NDArray[np.float64]
    sigma: NDArray[np.float64]
    turns: NDArray[np.float64]  # (K, 3, 3)
    offsets: NDArray[np.float64]  # (K, 3)
    lens: NDArray[np.float64]  # `Camera.coefficients` of each, as columns

    @classmethod
    def of(
        cls,
        cameras: Sequence[MountedCamera],
        positions: ArrayLike,
        pixels: ArrayLike,
        sigma: ArrayLike,
    ) -> _Problem:
        points = _points(positions)
        u = check.numbers("pixels", pixels)
        shape = (len(cameras), len(points))
        if u.shape != shape:
            raise ValueError(
                f"pixels has shape {shape}, a row for each camera and a column for each LED, not "
                f"{u.shape}"
            )
        spread = np.broadcast_to(check.numbers("sigma", sigma), shape)
        if (spread <= 0).any():
            raise ValueError(f"sigma = {spread[spread <= 0][0]:g} px: allowed is > 0")
        sensor, led = np.nonzero(np.isfinite(u) & np.isfinite(spread))
        if len(np.unique(led)) < 3 or len(led) < 6:
            raise ValueError(
                f"{len(led)} spikes of {len(np.unique(led))} LEDs: a pose in space needs three LEDs "
                "that two sensors see"
            )
        width = np.linalg.svd(points[led] - points[led].mean(axis=0), compute_uv=False)
        if width[1] <= _ON_LINE * width[0]:
            raise ValueError(
                f"positions {points[np.unique(led)].tolist()} lie on one line: the tracker may be "
                "anywhere on a circle around it"
            )
        rolls = np.array([cameras[i].roll for i in np.unique(sensor)])
        if not (np.abs(np.sin(rolls[:, None] - rolls[None, :])) > _PARALLEL).any():
            raise ValueError(
                f"sensors with roll {rolls.tolist()}: lines that are parallel tell nothing of the "
                "other direction; a second head is mounted with roll π/2"
            )
        errors = np.array([c.camera.model_error for c in cameras])
        return cls(
            tuple(cameras),
            points,
            shape,
            sensor,
            led,
            u[sensor, led],
            np.hypot(spread[sensor, led], errors[sensor]),
            np.stack([c.to_optical for c in cameras])[sensor],
            np.array([c.offset for c in cameras])[sensor],
            np.stack([c.camera.coefficients for c in cameras], axis=1)[:, sensor],
        )

    @property
    def everything(self) -> NDArray[np.bool_]:
        return np.ones(len(self.led), dtype=bool)

    def degrees(self, chosen: NDArray[np.bool_]) -> int:
        return int(chosen.sum()) - 6

    def model(self, state: _State) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
        """Expected spikes and their derivatives by place (room) and turn (own frame), (K,), (K, 6).

        None if an LED is not in front.
        """
        at = ((self.positions - state.place) @ state.axes)[self.led]
        x, y, distance = np.einsum("kij,kj->ik", self.turns, at - self.offsets)
        # as an LED comes to either point, where it is seen goes to infinity
        if (distance + np.minimum(self.lens[2], self.lens[3]).clip(max=0) <= 0).any():
            return None
        expected, *by = image(self.lens, x, y, distance)
        across = np.einsum("ik,kij->kj", np.stack(by), self.turns)  # px per mm, tracker's frame
        slopes = np.empty((len(self.led), 6))
        slopes[:, :3] = -across @ state.axes.T
        # a turn ω moves points by at × ω, and pixels by (across × at) · ω
        slopes[:, 3] = across[:, 1] * at[:, 2] - across[:, 2] * at[:, 1]
        slopes[:, 4] = across[:, 2] * at[:, 0] - across[:, 0] * at[:, 2]
        slopes[:, 5] = across[:, 0] * at[:, 1] - across[:, 1] * at[:, 0]
        return expected, slopes

    def refined(self, state: _State, chosen: NDArray[np.bool_]) -> _Fit:
        """Least squares after Levenberg and Marquardt."""
        weight = chosen / self.sigma
        modelled = self.model(state)
        if modelled is None:
            return _Fit(math.inf, state)
        rest, slopes = (self.pixels - modelled[0]) * weight, modelled[1] * weight[:, None]
        chi2, damping = float(rest @ rest), 1e-3
        for _ in range(_STEPS):
            size = np.linalg.norm(slopes, axis=0)
            size[size == 0] = 1.0
            scaled = slopes / size
            normal = scaled.T @ scaled + damping * np.eye(6)
            step = np.linalg.solve(normal, scaled.T @ rest) / size
            moved = _State(state.place + step[:3], state.axes @ _turn(step[3:]))
            modelled = self.model(moved)
            if modelled is not None:
                left = (self.pixels - modelled[0]) * weight
                new = float(left @ left)
                still = bool(np.abs(step * size).max() < _STILL)
                if new < chi2:
                    state, rest, chi2 = moved, left, new
                    slopes = modelled[1] * weight[:, None]
                    if still and damping <= _FREE:
                        break
                    damping *= 0.01
                    continue
                if still:
                    break
            damping *= 10
        return _Fit(chi2, state)

    def fits(self, chosen: NDArray[np.bool_], start: _State | None) -> list[_Fit]:
        """Least squares from several beginnings: different poses, the best first."""
        found: list[_Fit] = []

        def begin(state: _State) -> None:
            fit = self.refined(state, chosen)
            if math.isfinite(fit.chi2) and not any(_same(fit, other) for other in found):
                found.append(fit)

        degrees = self.degrees(chosen)
        enough = _limit(degrees, REFUSED)
        if start is not None:
            begin(start)
        many = len(np.unique(self.led[chosen])) > _FEW
        if not (many and found and found[0].chi2 <= enough):
            for _, states in itertools.islice(self.beginnings(chosen), _TRIPLES):
                for state in states:
                    begin(state)
                if any(fit.chi2 <= enough for fit in found):
                    break  # all poses that fit these three LEDs were tried
        if found:
            begin(self.mirrored(min(found, key=lambda fit: fit.chi2).state, chosen))
        # without redundancy all fits are as good, and what was told to begin with decides
        found.sort(key=lambda fit: fit.chi2 if degrees > 0 else float(fit.chi2 > enough))
        return found

    def mirrored(self, state: _State, chosen: NDArray[np.bool_]) -> _State:
        """Pose from which LEDs of one plane look much the same, tilted the other way.

        Depth along the line of sight is reversed, which a plane's reflection in itself undoes.
        """
        leds = self.positions[np.unique(self.led[chosen])]
        middle = leds.mean(axis=0)
        own = (middle - state.place) @ state.axes
        sight = own / np.linalg.norm(own)
        normal = np.linalg.svd(leds - middle)[2][-1]
        axes = state.axes - 2 * np.outer(normal, normal @ state.axes)
        axes -= 2 * np.outer(axes @ sight, sight)
        return _State(middle - axes @ own, axes)

    def without_gross_errors(self, states: list[_State]) -> list[_Choice]:
        """Fits of as many spikes as agree, at least two thirds: the best first, none if none do.

        Parameters
        ----------
        states : list of _State
            Fits of all spikes, the best first.
        """
        found: list[_Choice] = []

        def add(fit: _Fit, chosen: NDArray[np.bool_]) -> None:
            if fit.chi2 <= _limit(self.degrees(chosen), INCONSISTENT) and not any(
                (chosen == other.chosen).all() and _same(fit, other.fit) for other in found
            ):
                found.append(_Choice(fit, chosen))

        # a single one may be any: where few are left, several fit without it
        if len(self.led) > _FEWEST:
            for wrong in range(len(self.led)):
                chosen = np.arange(len(self.led)) != wrong
                for state in states[:_BASES]:
                    add(self.refined(state, chosen), chosen)
        if not found:
            for fit, chosen in self.consensus():
                add(fit, chosen)
        if not found:
            return []
        most = max(choice.chosen.sum() for choice in found)
        for fit, chosen in [choice for choice in found if choice.chosen.sum() == most]:
            add(self.refined(self.mirrored(fit.state, chosen), chosen), chosen)
        found = [choice for choice in found if choice.chosen.sum() == most]
        return sorted(found, key=lambda choice: choice.fit.chi2)

    def consensus(self) -> Iterator[_Choice]:
        """Fits of spikes that agree with three LEDs, for many of these."""
        for triple, states in itertools.islice(self.beginnings(self.everything), _TRIES):
            three = np.isin(self.led, triple)
            for state in states:
                fit, chosen = self.refined(state, three), three
                for _ in range(2):
                    chosen = self.agreeing(fit.state, chosen)
                    if 3 * chosen.sum() < 2 * len(chosen) or chosen.sum() < _FEWEST:
                        break
                    fit = self.refined(fit.state, chosen)
                else:
                    yield _Choice(fit, chosen)

    def left(self, choice: _Choice) -> NDArray[np.float64]:
        """Part of an error of each spike that is left in its residual, (K,)."""
        modelled = self.model(choice.fit.state)
        covariance = self.turned_covariance(choice.fit.state, choice.chosen)
        if modelled is None or covariance is None:
            return np.zeros(len(self.led))
        slopes = modelled[1] / self.sigma[:, None]
        return np.asarray(1 - np.einsum("ki,ij,kj->k", slopes, covariance, slopes))

    def agree(self, choice: _Choice) -> bool:
        """Whether a fit of all spikes is likely, and none is off what the others say."""
        if not choice.fit.chi2 <= _limit(self.degrees(choice.chosen), REFUSED):
            return False
        modelled, left = self.model(choice.fit.state), self.left(choice)
        if modelled is None:
            return False
        off = ((self.pixels - modelled[0]) / self.sigma) ** 2
        return bool((off <= AGREES**2 * left)[left > ROUNDING].all())

    def rivals(self, best: _Choice, other: _Choice) -> bool:
        """Whether another fit may be the right one, and the best one does not allow for it."""
        likely = max(_limit(self.degrees(other.chosen), PLAUSIBLE), best.fit.chi2 + _CLOSE)
        if other.fit.chi2 > likely:
            return False
        one = self.turned_covariance(best.fit.state, best.chosen)
        if one is None:
            return True
        (place, axes), (there, turned) = best.fit.state, other.fit.state
        swung = axes.T @ turned - turned.T @ axes  # twice the sine of the angle, about an axis
        away = np.array([*(there - place), *(swung[[2, 0, 1], [1, 2, 0]] / 2)])
        if np.trace(axes.T @ turned) < 1:  # by more than a quarter turn
            return True
        return bool(away @ np.linalg.solve(one, away) > _limit(6, PLAUSIBLE))

    def agreeing(self, state: _State, chosen: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Spikes that agree with a pose fitted to some of them, which is not exact."""
        modelled = self.model(state)
        covariance = self.turned_covariance(state, chosen)
        if modelled is None or covariance is None:
            return np.zeros(len(chosen), dtype=bool)
        expected, slopes = modelled
        doubt = np.einsum("ki,ij,kj->k", slopes, covariance, slopes)
        variance = self.sigma**2 + np.where(chosen, 0.0, doubt)
        return np.asarray((self.pixels - expected) ** 2 <= AGREES**2 * variance)

    def beginnings(
        self, chosen: NDArray[np.bool_]
    ) -> Iterator[tuple[tuple[int, int, int], list[_State]]]:
        """Poses from three LEDs at a time that two sensors see, the widest triangles first."""
        directions = self.directions(chosen)

        def area(triple: tuple[int, int, int]) -> float:
            first, second, third = self.positions[list(triple)]
            return float(np.linalg.norm(np.cross(second - first, third - first)))

        triples = sorted(itertools.combinations(directions, 3), key=area, reverse=True)
        centre = np.mean(
            [np.add(c.offset, (0.0, 0.0, c.camera.pupil)) for c in self.cameras], axis=0
        )
        for triple in triples:
            rays = np.stack([directions[led] for led in triple])
            poses = three_points(rays, self.positions[list(triple)])
            yield triple, [_State(place - axes @ centre, axes) for place, axes in poses]

    def directions(self, chosen: NDArray[np.bool_]) -> dict[int, NDArray[np.float64]]:
        """Unit vectors toward LEDs in the tracker's frame, as if all heads were in one place."""
        rolls = np.array([c.roll for c in self.cameras])[self.sensor]
        across = np.column_stack([np.cos(rolls), np.sin(rolls)]) * chosen[:, None]
        up = np.column_stack([-np.sin(rolls), np.cos(rolls)])
        normal = np.zeros((self.shape[1], 2, 2))
        np.add.at(normal, self.led, across[:, :, None] * across[:, None, :])
        known = np.flatnonzero(np.linalg.det(normal) > _PARALLEL**2)
        m, q = np.zeros(len(rolls)), np.zeros(len(rolls))
        slopes = np.zeros((self.shape[1], 2))
        for _ in range(4):  # heights that one sensor tells the other
            for number, mounted in enumerate(self.cameras):
                mine = self.sensor == number
                m[mine] = mounted.camera.tangent(self.pixels[mine], q[mine])
            right = np.zeros((self.shape[1], 2))
            np.add.at(right, self.led, -m[:, None] * across)
            slopes[known] = np.linalg.solve(normal[known], right[known][..., None])[..., 0]
            q = (up * slopes[self.led]).sum(axis=1) ** 2 / (1 + m * m)
        rays = np.column_stack([slopes, -np.ones(len(slopes))])
        rays /= np.linalg.norm(rays, axis=1)[:, None]
        return {int(led): rays[led] for led in known}

    def turned_covariance(
        self, state: _State, chosen: NDArray[np.bool_]
    ) -> NDArray[np.float64] | None:
        """Covariance of place and turn in the tracker's own frame; None if they are not told."""
        modelled = self.model(state)
        if modelled is None:
            return None
        slopes = modelled[1][chosen] / self.sigma[chosen, None]
        size = np.linalg.norm(slopes, axis=0)
        if not size.all():
            return None
        _, strength, turn = np.linalg.svd(slopes / size, full_matrices=False)
        if len(strength) < 6 or strength[-1] < _SINGULAR * strength[0]:
            return None
        root = turn.T / strength / size[:, None]
        return np.asarray(root @ root.T)

    def fix(self, choice: _Choice, flags: PoseFlags) -> SpaceFix:
        """What is told of a fit."""
        fit, chosen = choice
        place, axes = fit.state
        heading, pitch, roll = angles(axes)
        covariance = self.turned_covariance(fit.state, chosen)
        if covariance is None:
            raise ValueError(
                f"{chosen.sum()} spikes of LEDs at {self.positions[np.unique(self.led)].tolist()} "
                "do not tell all six numbers from where the tracker is: add LEDs, in depth"
            )
        # ω in the tracker's frame = rates @ changes of heading, pitch, roll
        rates = np.array(
            [
                [math.cos(pitch) * math.sin(roll), math.cos(roll), 0.0],
                [math.cos(pitch) * math.cos(roll), -math.sin(roll), 0.0],
                [-math.sin(pitch), 0.0, 1.0],
            ]
        )
        change = np.eye(6)
        change[3:, 3:] = np.linalg.pinv(rates)
        covariance = change @ covariance @ change.T
        modelled = self.model(fit.state)
        assert modelled is not None  # noqa: S101  # of a fit it is not
        residuals = np.full(self.shape, math.nan)
        residuals[self.sensor, self.led] = self.pixels - modelled[0]
        rejected = np.zeros(self.shape, dtype=bool)
        rejected[self.sensor, self.led] = ~chosen
        x, y, z = place.tolist()
        return SpaceFix(
            SpacePose(x, y, z, heading, pitch, roll),
            covariance,
            residuals,
            rejected,
            fit.chi2,
            self.degrees(chosen),
            flags,
        )


def three_points(
    rays: NDArray[np.float64], points: NDArray[np.float64]
) -> list[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Poses from which three points are seen in given directions, at most four.

    Grunert's solution of 1841, in the notation of Haralick and others, "Review and analysis of
    solutions of the three point perspective pose estimation problem", 1994.

    Parameters
    ----------
    rays : ndarray, shape (3, 3)
        Unit vectors in the observer's frame, one a row.
    points : ndarray, shape (3, 3)
        mm, one a row.

    Returns
    -------
    list of (place, axes)
        Observer in mm, and axes of the frame as columns.
    """
    a2, b2, c2 = (float(np.sum((points[i] - points[j]) ** 2)) for i, j in ((1, 2), (0, 2), (0, 1)))
    if min(a2, b2, c2) == 0:
        return []
    alpha, beta, gamma = (float(rays[i] @ rays[j]) for i, j in ((1, 2), (0, 2), (0, 1)))
    minus, plus = (a2 - c2) / b2, (a2 + c2) / b2
    quartic = [
        (minus - 1) ** 2 - 4 * c2 / b2 * alpha**2,
        4
        * (minus * (1 - minus) * beta - (1 - plus) * alpha * gamma + 2 * c2 / b2 * alpha**2 * beta),
        2
        * (
            minus**2
            - 1
            + 2 * minus**2 * beta**2
            + 2 * (b2 - c2) / b2 * alpha**2
            - 4 * plus * alpha * beta * gamma
            + 2 * (b2 - a2) / b2 * gamma**2
        ),
        4
        * (
            -minus * (1 + minus) * beta + 2 * a2 / b2 * gamma**2 * beta - (1 - plus) * alpha * gamma
        ),
        (1 + minus) ** 2 - 4 * a2 / b2 * gamma**2,
    ]
    found = []
    for root in np.roots(quartic):
        v = float(root.real)
        # noise makes two poses that are nearly one a complex pair: its real part is good enough
        if abs(root.imag) > _COMPLEX * abs(root) or v <= 0 or abs(gamma - v * alpha) < 1e-12:
            continue
        u = ((minus - 1) * v * v - 2 * minus * beta * v + 1 + minus) / (2 * (gamma - v * alpha))
        if u <= 0:
            continue
        nearest = math.sqrt(b2 / (1 + v * v - 2 * v * beta))
        own = rays * (nearest * np.array([1.0, u, v]))[:, None]
        # the turn that lays one triangle on the other, after Kabsch
        middle, target = own.mean(axis=0), points.mean(axis=0)
        left, _, right = np.linalg.svd((points - target).T @ (own - middle))
        handed = np.diag([1.0, 1.0, np.linalg.det(left @ right)])
        axes = left @ handed @ right
        found.append((target - axes @ middle, axes))
    return found


_STILL = 1e-6
"""Of least squares: done when a step changes no expected spike by more than so many σ."""

_FREE = 1e-6
"""Damping up to which a small step means that it is done, not that it is held back."""

_PARALLEL = 0.1
"""Sine of the angle below which two lines count as parallel."""

_ON_LINE = 1e-9
"""Width of LEDs relative to their length below which they lie on one line: rounding."""

_SINGULAR = 1e-9
"""Part of the information that is left where a pose is not told."""

_COMPLEX = 0.05
"""Imaginary part of a root, relative to it, up to which it counts as real."""


def _turn(vector: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rotation about a vector by its length (Rodrigues)."""
    angle = float(np.linalg.norm(vector))
    x, y, z = vector.tolist()
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    if angle < 1e-9:
        return np.asarray(np.eye(3) + cross)
    return np.asarray(
        np.eye(3)
        + math.sin(angle) / angle * cross
        + (1 - math.cos(angle)) / angle**2 * (cross @ cross)
    )


def _same(one: _Fit, other: _Fit) -> bool:
    return bool(
        np.abs(one.state.place - other.state.place).max() < 0.1
        and np.abs(one.state.axes - other.state.axes).max() < 1e-4
    )


def _points(positions: ArrayLike) -> NDArray[np.float64]:
    points = check.array("positions", positions)
    if points.ndim != 2 or points.shape[1] != 3:
        raise ValueError(f"positions has shape (N, 3), room x, y and z in mm, not {points.shape}")
    return points
