"""Motion: one pose from spikes of different times, each taken in when its LED was lit.

An extended Kalman filter with constant velocity, white acceleration, fed one exposure at a time
(SCAAT: G. Welch and G. Bishop, SIGGRAPH 1997): a single spike does not tell a pose, but it corrects
one. Each spike passes a gate; where too few pass, lock is lost, and a pose is sought anew in the
spikes of a short time.
"""

from __future__ import annotations

import math
from collections import deque
from enum import IntEnum
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from raytransfer import TCD1304
from raytransfer import _checks as check
from tracking.poses import Estimate, Fix, PoseFlags, Prior, locate
from tracking.spikes import SpikeFlags

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from numpy.typing import NDArray

    from tracking.camera import Camera
    from tracking.leds import LedMap
    from tracking.spikes import Spike

# enumerations are slow: inside, flags are whole numbers
_FLAGS = tuple(PoseFlags(n) for n in range(2 * max(PoseFlags)))
_PREDICTED, _LOST, _RELOCALISED, _REJECTED, _INCONSISTENT, _UNCHECKED = (
    int(flag)
    for flag in (
        *(PoseFlags.PREDICTED, PoseFlags.LOST, PoseFlags.RELOCALISED),
        *(PoseFlags.REJECTED, PoseFlags.INCONSISTENT, PoseFlags.UNCHECKED),
    )
)
_UNCERTAIN = int(SpikeFlags.CLIPPED | SpikeFlags.DOUBLE)
_MISSING = int(SpikeFlags.MISSING)

_LAST = TCD1304.pixels - 1
_GYRO = -1  # instead of a channel

RECORD = 256
"""Innovations that a filter remembers."""

RECENT = 16
"""Measurements by which it judges whether it is still right …"""
REFUSED = 8
"""… of which so many refused by the gate are too many."""

_HISTORY = (1 << RECENT) - 1

SQUARED = 2.0
"""Times its standard deviation that the square of an unknown height is taken to be uncertain by:
that of a normal distribution is not one itself, and is often far above its mean."""

SHARE = 1 / 64
"""Of each innovation in the mean by which errors are judged to be as large as stated …"""
INFLATED = 3.0
"""… and the mean of its square over its variance, 1 on average, above which they are not."""

BEYOND = 200.0
"""How far beyond the ends of the line spikes are predicted, px."""

SPIKES = 40
"""Most spikes that the search for a pose takes."""
SURE = 20
"""So many are enough if they are of three LEDs, which fit some pose whatever they say …"""
FEW = 7
"""… or so many near the last pose, or when half the memory has passed without a fourth LED; or in
the newer half of what is kept; or of the three that are left when one of four LEDs is left out."""
ROUGH = 2.5
"""Times the uncertainty at which lock is lost that a pose may begin with."""
MANY = 5
"""LEDs that are believed wherever they say that the tracker is."""
CONFIRMATIONS = 3
"""Spikes that must agree with a pose that was found before it counts."""

DOUBT = 5.0
"""Uncertainty of a prediction from which on a spike may be a reflection that comes in handy, px."""
NEEDED = 3
"""LEDs that some pose fits, whatever they say."""


class Outcome(IntEnum):
    """What became of a measurement."""

    USED = 0
    REJECTED = 1
    """Outside the gate."""
    UNSEEN = 2
    """The LED should not be in the field."""
    MISSING = 3
    """No spike was found."""
    STALE = 4
    """Older than what was taken in already, or the same LED of the same exposure again."""
    KEPT = 5
    """Lock is lost: kept for the search of a pose."""


_OUTCOMES = tuple(Outcome)


class Innovation(NamedTuple):
    """What a measurement said beside what was expected.

    Attributes
    ----------
    t_ns : int
    channel : int
        Of the LED; −1 for the gyroscope.
    predicted, residual : float
        px (gyroscope: rad/s); NaN where nothing was compared.
    sigma : float
        Of the residual: of prediction and measurement together.
    outcome : Outcome
    """

    t_ns: int
    channel: int
    predicted: float
    residual: float
    sigma: float
    outcome: Outcome

    @property
    def nis(self) -> float:
        """Normalised innovation squared, of χ² with one degree of freedom."""
        return (self.residual / self.sigma) ** 2


class Expected(NamedTuple):
    """Where spikes of all LEDs should be.

    Attributes
    ----------
    channels : tuple of int
    pixels : ndarray, shape (N,)
        px, also a little beyond the line's ends; NaN for LEDs that are not in the field.
    sigmas : ndarray, shape (N,)
        Of these, px.
    visible : ndarray of bool, shape (N,)
        Whether the LED shines toward the tracker and its spike is on the line.
    """

    channels: tuple[int, ...]
    pixels: NDArray[np.float64]
    sigmas: NDArray[np.float64]
    visible: NDArray[np.bool_]

    def window(self, channel: int, extent: float = 40.0, sigmas: float = 5.0) -> tuple[int, int]:
        """First and last pixel in which to look for an LED's spike.

        Parameters
        ----------
        channel : int
        extent : float
            What a spike reaches to either side of its position, px.
        sigmas : float
            How many standard deviations of the prediction are added.
        """
        row = self.channels.index(channel)
        at = self.pixels.item(row)
        half = extent + sigmas * self.sigmas.item(row)
        if not half < _LAST:
            return 0, _LAST
        return min(max(int(at - half), 0), _LAST), min(max(math.ceil(at + half), 0), _LAST)


class MotionFilter:
    """Extended Kalman filter of x, y, heading, their rates, height and a gyroscope's bias.

    Measurements are taken in by rising time. One that is older than the newest is refused
    (`Outcome.STALE`), as is a second one of the same LED at the same time: a frame that arrives
    late or twice changes nothing. Where nothing newer comes for all of `patience`, the clock must
    have been set back: lock is lost, and the time is that of these from then on.

    Parameters
    ----------
    camera : Camera
    leds : LedMap
    acceleration : float
        Square root of the power spectral density of the acceleration along x and along y,
        mm/s²/√Hz: motion with accelerations of a (rms) that last for τ has a √(2 τ).
    angular : float
        The same of the heading, rad/s²/√Hz.
    height : Prior
        The tracker's height, mm; a sigma above 0 makes it a state, and its square another one.
    height_walk : float
        By how much height wanders, mm/√s.
    bias : Prior
        Of the gyroscope, rad/s. What was learnt of it is kept when lock is lost, taken for twice as
        uncertain; or forgotten if the rates did not fit.
    bias_walk : float
        rad/s/√s.
    model_error : float, optional
        Error of the camera's model in a spike's position, px. It is the same as long as a spike
        stays where it is, and does not average out; a filter that takes it as noise must take it
        as larger. Three times the camera's own when left out.
    led_error : float
        Standard deviation of the LEDs' positions, mm.
    gate : float
        Largest normalised innovation squared.
    patience : float
        Time without a spike that passed the gate after which lock is lost, s; longer than some
        frames.
    memory : float
        How old a spike may be in the search for a pose, s. Three different LEDs or more must be
        found in it, `FEW` spikes in all if they are not more than three.
    uncertainty : tuple of float
        Standard deviations of place, mm, and heading, rad, above which lock is lost: the next spike
        could be a reflection and still pass the gate. A pose that is found may have `ROUGH` times
        as much.
    speed, turning : float
        Standard deviations of the rates when nothing is known of them yet, mm/s and rad/s.

    Attributes
    ----------
    lost : bool
        Whether the pose is unknown, as it is in the beginning.
    losses, stale : int
        How often lock was lost; measurements refused as too old.
    innovations : deque of Innovation
        The newest `RECORD`.

    Raises
    ------
    ValueError
        If a number is negative, or not finite.
    """

    def __init__(
        self,
        camera: Camera,
        leds: LedMap,
        *,
        acceleration: float = 1000.0,
        angular: float = 1.0,
        height: Prior = Prior(0.0, 0.0),  # noqa: B008  # immutable
        height_walk: float = 0.0,
        bias: Prior = Prior(0.0, 0.0),  # noqa: B008
        bias_walk: float = 0.0,
        model_error: float | None = None,
        led_error: float = 0.0,
        gate: float = 16.0,
        patience: float = 0.3,
        memory: float = 0.25,
        uncertainty: tuple[float, float] = (50.0, 0.015),
        speed: float = 1000.0,
        turning: float = 1.5,
    ) -> None:
        densities = {
            "acceleration": acceleration,
            "angular": angular,
            "height_walk": height_walk,
            "bias_walk": bias_walk,
        }
        for name, value in densities.items():
            check.not_negative(name, value)
        for name, prior in (("height", height), ("bias", bias)):
            check.number(f"value of {name}", prior.value)
            check.not_negative(f"sigma of {name}", prior.sigma, "0 if it is known")
        error = 3 * camera.model_error if model_error is None else model_error
        self.camera, self.leds = camera, leds
        self._height, self._bias = height, bias
        self._density = np.array([value**2 for value in densities.values()])
        self._model_variance = check.not_negative("model_error", error, "px") ** 2
        self._blur = check.not_negative("led_error", led_error, "mm") ** 2
        self._gate = check.positive("gate", gate)
        self._patience_ns = round(check.positive("patience", patience, "s") * 1e9)
        self._memory_ns = round(check.positive("memory", memory, "s") * 1e9)
        if np.shape(uncertainty) != (2,):
            raise ValueError(f"uncertainty = {uncertainty!r}: two are needed, of place and heading")
        self._limits = tuple(check.positive("uncertainty", u) ** 2 for u in uncertainty)
        self._rates = (check.positive("speed", speed), check.positive("turning", turning))
        self._rows = {channel: row for row, channel in enumerate(leds.channels)}
        self._normals = np.column_stack([-np.sin(leds.facings), np.cos(leds.facings)])
        self._kernels = load_kernels()
        ends = np.sort(camera.tangent([-BEYOND, _LAST + BEYOND]))
        self._lens = np.concatenate([camera.coefficients, ends])
        states = self._kernels.STATES
        self._state = self._unmoved()
        self._cov = np.zeros((states, states))
        self._cov[7, 7] = bias.sigma**2
        self._known = False  # any pose
        # what there is to find out: pose, rates, height and its square, the last two in units of
        # their uncertainty
        doubt = height.sigma
        self._basis = np.zeros((states, 8))
        self._basis[:6, :6] = np.eye(6)
        self._basis[6, 6] = doubt
        self._basis[8, 6:] = 2 * height.value * doubt, SQUARED * math.sqrt(2) * doubt**2
        self._prior = np.diag([0.0] * 3 + [speed**-2, speed**-2, turning**-2, 1.0, 1.0])
        self._row, self._column, self._result = np.zeros(states), np.zeros(states), np.zeros(3)
        self._t = 0
        self._seen: set[int] = set()
        self._used_ns = 0
        self._recent = 0  # a bit for each measurement, 1 if it was refused
        self._trusted: tuple[int, float, float, float] | None = None
        self._mean_nis = self._mean_turn = 1.0  # of spikes; of rates of the gyroscope
        self._late: int | None = None  # time of the first one that was stale since any was not
        self._kept: deque[tuple[int, int, float, float]] = deque(maxlen=SPIKES)
        self._to_confirm = 0
        self._tries = 0
        self._flags = 0
        self._doubts = 0  # a bit for each measurement, 1 if the pose was unchecked
        self._unchecked = False  # the pose: too few LEDs speak for it …
        self._witnesses: frozenset[int] = frozenset()  # … and these
        self._speakers = 0  # how many of them would have told if it were wrong
        self._agreed: set[int] = set()  # LEDs that have passed narrow gates since
        self._refused: set[int] = set()  # since any spike was believed
        self.lost = True
        self.losses = 0
        self.stale = 0
        self.innovations: deque[Innovation] = deque(maxlen=RECORD)

    @property
    def t_ns(self) -> int:
        """Time of the newest measurement, ns."""
        return self._t

    @property
    def state(self) -> NDArray[np.float64]:
        """x, y, heading, their rates, height, bias, height squared at `t_ns`; mm, rad, s. A copy."""
        return self._state.copy()

    @property
    def covariance(self) -> NDArray[np.float64]:
        """Of `state`, shape (9, 9); infinite where no pose was ever known. A copy."""
        return self._cov.copy() if self._known else np.diag(np.full(len(self._cov), math.inf))

    @property
    def unchecked(self) -> bool:
        """Whether a further LED has still to agree with the pose (`PoseFlags.UNCHECKED`).

        It was found with three LEDs, which fit some pose even if one of them is a reflection; or,
        after a time without, spikes of one LED alone passed, which might have been anything near;
        or one passed after it had been refused.
        """
        return self._unchecked

    def start(self, fix: Fix, t_ns: int, channels: Iterable[int] = ()) -> None:
        """Begin at a pose; its rates are unknown.

        Parameters
        ----------
        fix : Fix
        t_ns : int
        channels : iterable of int
            Of the LEDs that it is from: if it is `PoseFlags.UNCHECKED`, it is until another agrees.

        Raises
        ------
        ValueError
            If the pose or its covariance is not finite.
        """
        if not (
            np.isfinite([fix.x, fix.y, fix.heading]).all() and np.isfinite(fix.covariance).all()
        ):
            raise ValueError("fix: pose and covariance must be finite; were there enough spikes?")
        speed, turning = self._rates
        state = self._unmoved()
        state[:3] = fix.x, fix.y, fix.heading
        covariance = np.diag([0.0] * 3 + [speed**2, speed**2, turning**2, 1.0, 1.0])
        covariance[:3, :3] = fix.covariance
        self._begin(t_ns, state, covariance)
        self._witnesses = frozenset(self._rows[channel] for channel in channels)
        self._lock(unchecked=bool(fix.flags & PoseFlags.UNCHECKED))

    def _unmoved(self) -> NDArray[np.float64]:
        """State before anything is known: height, its square and bias as they are likely to be."""
        state = np.zeros(self._kernels.STATES)
        height, doubt = self._height.value, self._height.sigma
        state[6:] = height, self._bias.value, height**2 + doubt**2
        return state

    def _begin(
        self, t_ns: int, state: NDArray[np.float64], covariance: NDArray[np.float64]
    ) -> None:
        """Take over a state but for its bias, and the covariance of multiples of `_basis`."""
        bias, variance = self._bias.value, self._bias.sigma**2
        if self._mean_turn <= INFLATED:
            bias = self._state[7]
            variance = max(self._cov[7, 7], min(4 * self._cov[7, 7], variance))
        self._t = int(t_ns)
        self._seen.clear()
        self._state[:] = state
        self._state[7] = bias
        self._cov[:] = self._basis @ covariance @ self._basis.T
        self._cov += self._cov.T.copy()
        self._cov *= 0.5
        self._cov[7, 7] = variance
        self._mean_turn = 1.0
        self._known = True

    def _lock(self, *, unchecked: bool) -> None:
        self.lost = False
        self._unchecked = unchecked
        self._refused.clear()
        self._agreed.clear()
        self._used_ns = self._t
        self._recent = self._doubts = 0
        self._mean_nis = 1.0
        self._kept.clear()
        self._to_confirm = 0
        self._flags = 0

    def predict(self, t_ns: int) -> None:
        """Carry the state on to a time, ns; an earlier one than `t_ns` leaves it as it is."""
        if t_ns > self._t:
            self._kernels.predict(self._state, self._cov, (t_ns - self._t) * 1e-9, self._density)
            self._t = int(t_ns)
            self._seen.clear()
            self._flags = 0
            self._late = None

    def update(
        self, t_ns: int, channel: int, spike: Spike, gyro: tuple[float, float] | None = None
    ) -> Innovation:
        """Take in what was found of an LED.

        Parameters
        ----------
        t_ns : int
            When it was lit, ns.
        channel : int
        spike : Spike
        gyro : tuple of float, optional
            Rate of the heading at that time and its standard deviation, rad/s.

        Returns
        -------
        Innovation

        Raises
        ------
        KeyError
            If no LED has this channel.
        """
        row = self._rows.get(channel)
        if row is None:
            self.leds.index(channel)  # says what is wrong
            raise AssertionError  # pragma: no cover
        if t_ns > self._t:
            self.predict(t_ns)
        if gyro is not None:
            self._turn(t_ns, *gyro)
        if t_ns < self._t or channel in self._seen:
            self.stale += 1
            self._doubt_clock(t_ns)
            return self._note(t_ns, channel, Outcome.STALE)
        self._seen.add(channel)
        flags = int(spike.flags)
        if flags & _MISSING:
            self._judge()
            return self._note(t_ns, channel, Outcome.MISSING)
        variance = spike.sigma**2 + self._model_variance
        if flags & _UNCERTAIN:  # some of its light is lacking, or not its own
            variance += (spike.width / 4) ** 2
        if not (math.isfinite(variance) and variance > 0 and math.isfinite(spike.position)):
            raise ValueError(
                f"spike of LED {channel} at {spike.position} px, sigma {spike.sigma}: a spike that "
                "was found has a finite position and a sigma above 0"
            )
        if self.lost:
            return self._search(t_ns, channel, row, spike.position, variance)
        outcome = _OUTCOMES[self._measure(row, spike.position, variance)]
        predicted, residual, scale = self._result.tolist()
        self._recent = self._recent << 1 & _HISTORY
        self._doubts = (self._doubts << 1 | self._unchecked) & _HISTORY
        if outcome is Outcome.USED:
            self._used_ns = self._t
            self._believe(row, scale - variance)
            if not self._recent and not self._unchecked:
                self._trusted = (self._t, *self._state[:3].tolist())
        else:
            self._recent |= 1
            self._refused.add(row)
            if self._doubts and not self._unchecked:  # what agreed may have been the reflection
                self._unchecked, self._witnesses = True, frozenset()
                self._agreed.clear()
            self._flags |= _REJECTED
        if outcome is not Outcome.UNSEEN:
            nis = min(residual * residual / scale, self._gate)
            self._mean_nis += SHARE * (nis - self._mean_nis)
        self._judge()
        return self._note(t_ns, channel, outcome, predicted, residual, math.sqrt(scale))

    def observe(
        self, t_ns: int, spikes: Mapping[int, Spike], gyro: tuple[float, float] | None = None
    ) -> Estimate:
        """Take in all that was found in a frame, and return the pose.

        Parameters
        ----------
        t_ns : int
        spikes : mapping of int to Spike
            By channel: one for each LED that was lit.
        gyro : tuple of float, optional
            As for `update`.

        Returns
        -------
        Estimate
        """
        for channel, spike in spikes.items():
            self.update(t_ns, channel, spike, gyro)
            gyro = None
        if not spikes:
            self.predict(t_ns)
            if gyro is not None:
                self._turn(t_ns, *gyro)
            if t_ns < self._t:
                self._doubt_clock(t_ns)
            self._judge()
        return self.estimate()

    def estimate(self, t_ns: int | None = None) -> Estimate:
        """Return the pose, carried on to a time ("now").

        Parameters
        ----------
        t_ns : int, optional
            `t_ns` of the newest measurement when left out; earlier times are refused.

        Raises
        ------
        ValueError
            If the time is before the newest measurement: a filter does not remember.
        """
        state, cov, t_ns = self._at(t_ns)
        flags = self._flags
        flags |= _LOST if self.lost else _UNCHECKED * self._unchecked
        if t_ns > self._used_ns:
            flags |= _PREDICTED
        if self._mean_nis > INFLATED or self._mean_turn > INFLATED:
            flags |= _INCONSISTENT
        x, y, heading = state[:3].tolist()
        heading = math.remainder(heading, math.tau)
        covariance = cov[:3, :3].copy() if self._known else np.diag([math.inf] * 3)
        return Estimate(t_ns, x, y, heading, covariance, _FLAGS[flags])

    def expected(self, t_ns: int | None = None) -> Expected:
        """Tell where the spikes of all LEDs should be: for windows, and for what to light.

        Parameters
        ----------
        t_ns : int, optional
            As for `estimate`.
        """
        state, cov, _ = self._at(t_ns)
        pixels, sigmas = np.empty(len(self.leds)), np.empty(len(self.leds))
        visible = np.empty(len(self.leds), np.bool_)
        self._kernels.expect(
            state,
            cov,
            self.leds.positions,
            self._normals,
            self._lens,
            float(_LAST),
            pixels,
            sigmas,
            visible,
        )
        if not self._known:
            pixels[:], sigmas[:], visible[:] = math.nan, math.inf, False
        return Expected(self.leds.channels, pixels, sigmas, visible)

    def choose(
        self,
        t_ns: int,
        period: float,
        chances: NDArray[np.float64],
        variances: NDArray[np.float64],
        apart: float,
        chosen: NDArray[np.int64],
    ) -> None:
        """Choose LEDs for frames to come that should lower the variance of x and y most.

        Parameters
        ----------
        t_ns : int
            Of the first frame.
        period : float
            From frame to frame, s.
        chances : ndarray, shape (N,)
            Of each LED to be found if its spike is on the line.
        variances : ndarray, shape (N,)
            Of the spikes, px².
        apart : float
            px between the spikes of a frame.
        chosen : ndarray of int, shape (frames, LEDs in a frame)
            Gets rows of the map; −1 is none.
        """
        self._kernels.choose(
            self._state,
            self._cov,
            self._density,
            max(t_ns - self._t, 0) * 1e-9,
            period,
            self.leds.positions,
            self._lens,
            float(_LAST),
            chances,
            variances + self._model_variance,
            self._blur,
            apart,
            chosen,
        )

    def _at(self, t_ns: int | None) -> tuple[NDArray[np.float64], NDArray[np.float64], int]:
        if t_ns is None or t_ns == self._t:
            return self._state, self._cov, self._t
        if t_ns < self._t:
            raise ValueError(
                f"t_ns = {t_ns}: the newest measurement is of {self._t}; a filter tells the "
                "present and the future"
            )
        state, cov = self._state.copy(), self._cov.copy()
        self._kernels.predict(state, cov, (t_ns - self._t) * 1e-9, self._density)
        return state, cov, int(t_ns)

    def _measure(self, row: int, pixel: float, variance: float) -> int:
        outcome: int = self._kernels.measure(
            self._state,
            self._cov,
            self.leds.positions[row],
            self._lens,
            pixel,
            variance,
            self._blur,
            self._gate,
            self._row,
            self._column,
            self._result,
        )
        return outcome

    def _turn(self, t_ns: int, rate: float, sigma: float) -> None:
        """Take in a rate of the gyroscope, one for each time."""
        check.number("rate of the gyroscope", rate, "rad/s")
        variance = check.positive("sigma of the gyroscope", sigma, "rad/s") ** 2
        if t_ns < self._t or _GYRO in self._seen or not self._known:
            return
        self._seen.add(_GYRO)
        outcome = self._kernels.turn(
            self._state,
            self._cov,
            rate,
            variance,
            self._gate,
            self._row,
            self._column,
            self._result,
        )
        predicted, residual, scale = self._result.tolist()
        if not self.lost:
            nis = min(residual * residual / scale, self._gate)
            self._mean_turn += SHARE * (nis - self._mean_turn)
            self._flags |= _REJECTED * (outcome != Outcome.USED)
        self._note(self._t, _GYRO, _OUTCOMES[outcome], predicted, residual, math.sqrt(scale))

    def _note(
        self,
        t_ns: int,
        channel: int,
        outcome: Outcome,
        predicted: float = math.nan,
        residual: float = math.nan,
        sigma: float = math.inf,
    ) -> Innovation:
        innovation = Innovation(t_ns, channel, predicted, residual, sigma, outcome)
        self.innovations.append(innovation)
        return innovation

    def _believe(self, row: int, doubt: float) -> None:
        """Find out whether a spike that passed the gate speaks for the pose, or was easy to please.

        Doubt is the variance of its prediction, px². Nothing is cleared by a spike of which nearly
        as little was known as of the doubtful one, nor as long as others are refused.
        """
        if doubt > DOUBT**2 or row in self._refused:
            if not self._unchecked:
                self._unchecked, self._witnesses = True, frozenset([row])
                self._agreed.clear()
            return
        if self._unchecked:
            if doubt > (DOUBT / 2) ** 2 or self._recent:
                return
            self._agreed.add(row)
            if row in self._witnesses and len(self._agreed) <= NEEDED:
                return
        self._refused.clear()
        self._unchecked = False

    def _doubt_clock(self, t_ns: int) -> None:
        """Find out from a measurement that is stale whether the clock was set back."""
        if self._late is None:
            self._late = t_ns
        if t_ns - self._late > self._patience_ns:
            self._lose()
            self._t, self._late = int(t_ns), None
            self._known, self._trusted = False, None
            self._seen.clear()

    def _judge(self) -> None:
        """Find out whether lock is lost."""
        if self.lost:
            return
        place, heading = self._limits
        cov = self._cov
        if (
            self._t - self._used_ns > self._patience_ns
            or self._recent.bit_count() >= REFUSED
            or cov.item(0, 0) > place
            or cov.item(1, 1) > place
            or cov.item(2, 2) > heading
        ):
            self._lose()

    def _lose(self) -> None:
        self.losses += not self.lost
        self.lost = True
        self._kept.clear()
        self._to_confirm = 0

    def _search(
        self, t_ns: int, channel: int, row: int, pixel: float, variance: float
    ) -> Innovation:
        """Take in a spike while lock is lost."""
        self._kept.append((t_ns, row, pixel, variance))
        if self._to_confirm:
            self._tries += 1
            outcome = Outcome(self._measure(row, pixel, variance))
            predicted, residual, scale = self._result.tolist()
            if outcome is Outcome.USED:
                self._used_ns = t_ns
                self._to_confirm -= 1
                # the pose has followed what was easy to please: that LED cannot speak for it later
                self._speakers += row not in self._witnesses and scale - variance <= DOUBT**2
                self._witnesses |= {row}
                if not self._to_confirm:
                    self._lock(unchecked=self._speakers <= NEEDED)
                    self._flags = _RELOCALISED
            elif self._tries >= 2 * CONFIRMATIONS:
                self._to_confirm = 0
            return self._note(t_ns, channel, outcome, predicted, residual, math.sqrt(scale))
        if self._relocalise():
            self._to_confirm, self._tries = CONFIRMATIONS, 0
        return self._note(t_ns, channel, Outcome.KEPT)

    def _relocalise(self) -> bool:
        """Seek a pose in the spikes kept; the filter begins there."""
        while self._t - self._kept[0][0] > self._memory_ns:
            self._kept.popleft()
        rows = np.array([row for _, row, _, _ in self._kept])
        ages = np.array([(t - self._t) * 1e-9 for t, *_ in self._kept])
        kept = np.array(self._kept)
        # three LEDs fit some pose, whatever they say: better with more, or near the last pose
        waited = self._trusted is not None or 2 * (self._t - self._kept[0][0]) >= self._memory_ns
        for first in (0, len(rows) // 2):  # LEDs may have been confused when lock was lost
            different = len(np.unique(rows[first:]))
            more = different > NEEDED and not first
            fewest = NEEDED + 1 if more else FEW if waited else SURE
            if different < NEEDED or len(rows) - first < fewest:
                return False
            if self._fitted(ages[first:], rows[first:], kept[first:, 2], kept[first:, 3]):
                return True
        return False

    def _reachable(self, state: NDArray[np.float64]) -> bool:
        """Whether the tracker can have come here from where it was for certain."""
        if self._trusted is None:
            return True
        t_ns, x, y, heading = self._trusted
        seconds = (self._t - t_ns) * 1e-9
        turned = abs(math.remainder(state[2] - heading, math.tau))
        speed, turning = self._rates
        return bool(
            math.hypot(state[0] - x, state[1] - y) < (0.1 + 1.5 * seconds) * speed
            and turned < (0.1 + 1.5 * seconds) * turning
        )

    def _fitted(
        self,
        ages: NDArray[np.float64],
        rows: NDArray[np.int64],
        pixels: NDArray[np.float64],
        variances: NDArray[np.float64],
    ) -> bool:
        """Begin at a path that fits, leaving single LEDs out where none does."""
        different = np.unique(rows)
        use = np.ones(len(rows), bool)
        found = self._path(use, ages, rows, pixels, variances)
        if found is None and len(different) > NEEDED:
            # three fit some path whatever they say: it must be the only one that can be reached
            few = len(different) == NEEDED + 1
            paths = []
            for row in different:
                use = rows != row
                if (path := self._path(use, ages, rows, pixels, variances)) is not None:
                    paths.append((use, path))
                    if not few:
                        break
            if not paths or (few and (len(paths) > 1 or self._trusted is None)):
                return False
            use, found = paths[0]
            if few and use.sum() < FEW:
                return False
        if found is None:
            return False
        self._begin(self._t, *found)
        self._seen = {int(rows[-1])}
        self._witnesses = frozenset(rows[use].tolist())
        self._speakers = len(self._witnesses)
        return True

    def _path(
        self,
        use: NDArray[np.bool_],
        ages: NDArray[np.float64],
        rows: NDArray[np.int64],
        pixels: NDArray[np.float64],
        variances: NDArray[np.float64],
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
        """Fit a path to some of the spikes: its end and the covariance of that, if it is sure."""
        ages, rows, pixels, variances = ages[use], rows[use], pixels[use], variances[use]
        # first a pose as if all were of one moment
        moved = variances + (self.camera.scale * ages * self._rates[1] / 2) ** 2
        different = np.unique(rows)
        newest = np.sort([np.flatnonzero(rows == row)[-1] for row in different])
        try:
            fix = locate(
                self.camera,
                self.leds.positions[rows[newest]],
                pixels[newest],
                np.sqrt(moved[newest]),
                height=self._height,
                facings=self.leds.facings[rows[newest]],
            )
        except ValueError:  # no pose has the LEDs in front, and shining toward it
            return None
        state = self._unmoved()
        state[:3] = fix.x, fix.y, fix.heading
        if not np.isfinite(fix.covariance).all() or fix.flags & PoseFlags.AMBIGUOUS:
            # too few LEDs, or too near to each other, or moved too far between their spikes
            if self._trusted is None or not self._reachable(self._state):
                return None
            state[:3] = self._state[:3]
        information = np.zeros_like(self._prior)
        chi2 = self._kernels.fit(
            state,
            self._basis,
            self._prior,
            self._density,
            self._blur,
            ages,
            rows,
            pixels,
            variances,
            self.leds.positions,
            self._lens,
            information,
        )
        degrees = len(rows) - 3
        if not chi2 <= degrees + 4 * math.sqrt(2 * degrees):
            return None
        covariance = np.asarray(np.linalg.inv(information), np.float64)
        place, heading = (ROUGH**2 * limit for limit in self._limits)
        if max(covariance[0, 0], covariance[1, 1]) > place or covariance[2, 2] > heading:
            return None
        if len(different) < MANY and not self._reachable(state):
            return None
        return state, covariance


def load_kernels() -> Any:
    """Return `tracking._motion`, which takes numba to load."""
    from tracking import _motion

    return _motion
