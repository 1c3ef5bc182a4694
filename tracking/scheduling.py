"""Which LEDs to light next, and for how long.

A frame in which no LED is seen is wasted, as is one in which a near LED saturates. A schedule plans
the next frames from where the tracker is expected to be; `Capture.send` takes what it returns.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from acquisition.frames import MASTER_CLOCK
from acquisition.protocol import CHAIN_FIRST, CHAIN_STEP, EXPOSURE_MIN, TABLE_MAX, check_periods
from raytransfer import TCD1304
from raytransfer import _checks as check
from tracking.motion import load_kernels
from tracking.spikes import SpikeFlags

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from tracking.leds import LedMap
    from tracking.motion import MotionFilter
    from tracking.spikes import Spike

_MISSING, _SATURATED = int(SpikeFlags.MISSING), int(SpikeFlags.SATURATED)

FORGETTING = 1.0
"""Time after which little is left of what was learnt of an LED, s."""

ROUNDS = 4
"""Times that each LED is lit in a frame of its own for which what was learnt lasts at least."""

DOUBTFUL = 0.5
"""By how much a spike that was not found lowers the chance that the next one is."""
LOWEST = 0.02
"""Chance of an LED that was never found."""
ELSEWHERE = 0.1
"""Weight, in a search, of LEDs that should not be seen: the pose may be wrong."""

LAST = TCD1304.pixels - 1


def allowed(lit: Mapping[int, float], sh_period: int) -> dict[int, int]:
    """Exposures as the firmware takes them, none longer than asked for if that can be had.

    Whole clocks from `EXPOSURE_MIN` up to the SH period. LEDs of the chain whose exposures differ
    by less than `CHAIN_STEP` share the shorter one.

    Parameters
    ----------
    lit : mapping of int to float
        Exposures by channel, master clocks.
    sh_period : int
    """
    clocks = {n: int(min(max(t, EXPOSURE_MIN), sh_period)) for n, t in lit.items()}
    step = None
    for channel in sorted((n for n in clocks if n >= CHAIN_FIRST), key=clocks.__getitem__):
        if step is None or clocks[channel] - step >= CHAIN_STEP:
            step = clocks[channel]
        clocks[channel] = step
    return dict(sorted(clocks.items()))


class ExposureControl:
    """How long each LED is lit so that its spike is high and not saturated.

    The peak is taken to be gain × clocks × cosine / distance^1.5: between that of a spike whose
    width is the head's (1/distance²) and that of one whose width is its blur (1/distance). The gain
    of each LED follows the heights measured; an LED not seen lately takes that of the others.

    Parameters
    ----------
    leds : LedMap
    sh_period : int
        Longest exposure, master clocks.
    peak : float
        Height to aim for, electrons: half or less of what saturates leaves room for motion.
    gain : float
        To begin with, electrons mm^1.5 per clock. The default suits 0.25 W and a slit of 4 mm.
    """

    def __init__(
        self, leds: LedMap, sh_period: int, *, peak: float = 16_000.0, gain: float = 1e8
    ) -> None:
        self.leds = leds
        self.sh_period = check.whole("sh_period", sh_period)
        self.peak = check.positive("peak", peak, "electrons")
        self._common = math.log(check.positive("gain", gain))
        self._gains = np.full(len(leds), self._common)
        self._learnt = np.full(len(leds), -math.inf)  # when, s
        self._normals = np.column_stack([-np.sin(leds.facings), np.cos(leds.facings)])
        self._rows = {channel: row for row, channel in enumerate(leds.channels)}
        self._kernels = load_kernels()

    def fluxes(self, x: float, y: float, seconds: float) -> NDArray[np.float64]:
        """Electrons in the peak of each LED per clock, for a tracker at x, y (mm); 0 from behind.

        Parameters
        ----------
        x, y : float
        seconds : float
            Time, by which what was learnt is weighed.
        """
        weights = self._kernels.fading(self._learnt, seconds, FORGETTING)
        return np.asarray(
            self._kernels.fluxes(
                *(float(x), float(y), self.leds.positions, self._normals),
                *(self._gains, self._common, weights),
            )
        )

    def clocks(self, fluxes: NDArray[np.float64]) -> NDArray[np.float64]:
        """Exposures for these `fluxes`, master clocks."""
        least = self.peak / self.sh_period  # what is dimmer is lit for as long as may be
        return np.asarray(np.maximum(self.peak / np.maximum(fluxes, least), EXPOSURE_MIN))

    def learn(self, channel: int, clocks: int, spike: Spike, flux: float, seconds: float) -> None:
        """Take in how high an LED's spike was.

        Parameters
        ----------
        channel : int
        clocks : int
            For which it was lit.
        spike : Spike
        flux : float
            What `fluxes` had said, electrons per clock.
        seconds : float
        """
        if not flux > 0:
            return
        row = self._rows[channel]
        weight = math.exp(min(self._learnt.item(row) - seconds, 0.0) / FORGETTING)
        gain = self._common + weight * (self._gains.item(row) - self._common)
        flags = int(spike.flags)
        if flags & _MISSING:  # too dim, perhaps; or something is in the way
            gain = max(gain - 0.2, self._common - 2.0)
        elif flags & _SATURATED:
            gain += 1.0
            self._common += 0.1
        else:
            change = math.log(max(spike.height, 1.0) / (flux * clocks))
            change = min(max(change, -2.0), 2.0)
            gain += 0.5 * change
            self._common += 0.05 * (gain - self._common)
        self._gains[row] = gain
        self._learnt[row] = seconds

    def restart(self) -> None:
        """Forget when what was learnt was learnt: another clock begins. The LEDs' mean gain stays."""
        self._learnt[:] = -math.inf


class _Blind:
    """Exposures before there was any pose: long, medium and short ones until an LED is found."""

    def __init__(self, count: int, sh_period: int, peak: float) -> None:
        self._levels = sh_period * np.array([1.0, 0.25, 0.0625])
        self._tries = np.zeros(count, np.int64)
        self._known = np.full(count, math.nan)  # what an LED found needs
        self._peak = peak

    def clocks(self) -> NDArray[np.float64]:
        """Master clocks of each LED."""
        tried = self._levels[self._tries % len(self._levels)]
        return np.where(np.isnan(self._known), tried, self._known)

    def learn(self, row: int, clocks: int, spike: Spike) -> None:
        """Take in what an LED lit for so many clocks gave."""
        flags = int(spike.flags)
        if flags & _MISSING:
            was_found = not math.isnan(self._known.item(row))
            self._tries[row] = 0 if was_found else self._tries.item(row) + 1
            self._known[row] = math.nan
        else:
            change = 0.25 if flags & _SATURATED else self._peak / max(spike.height, 1.0)
            self._known[row] = clocks * change


class Schedule:
    """Plans which LEDs are lit in the frames to come.

    Parameters
    ----------
    leds : LedMap
    sh_period, icg_period : int
        As in `Command`, master clocks.
    exposure : ExposureControl, optional
    per_frame : int
        Most LEDs in one frame. More than one needs windows in which to look for each.
    latency : int
        Frames from the newest one taken in to the first one planned: what has been sent to the
        firmware before, and the time a change takes to come into force.
    apart : float
        Distance that the spikes of one frame must have, px, uncertainty aside.
    sigma : float
        Of a spike of the height that exposure aims for, px.
    master_clock : int
        Hz.

    Raises
    ------
    ValueError
        If more LEDs are asked for than there are, or periods that the firmware would refuse.
    """

    def __init__(
        self,
        leds: LedMap,
        sh_period: int,
        icg_period: int,
        *,
        exposure: ExposureControl | None = None,
        per_frame: int = 1,
        latency: int = 3,
        apart: float = 80.0,
        sigma: float = 0.03,
        master_clock: int = MASTER_CLOCK,
    ) -> None:
        check_periods(sh_period, icg_period)
        if not 1 <= check.whole("per_frame", per_frame) <= len(leds):
            raise ValueError(f"per_frame = {per_frame}: allowed are 1 to {len(leds)} LEDs")
        if latency < 0:
            raise ValueError(f"latency = {latency}: allowed are whole numbers of frames from 0 on")
        self.leds = leds
        self.sh_period = sh_period
        self.exposure = ExposureControl(leds, sh_period) if exposure is None else exposure
        self.per_frame = per_frame
        self.latency = latency
        self.apart = check.positive("apart", apart, "px")
        self.sigma = check.positive("sigma", sigma, "px")
        self.period_ns = icg_period * 1_000_000_000 // master_clock
        # of what was learnt in a few rounds something must be left, however slow the frames are
        self._forgetting = max(FORGETTING, ROUNDS * len(leds) * self.period_ns * 1e-9)
        self._kernels = load_kernels()
        self._chances = np.ones(len(leds))
        self._judged = np.full(len(leds), -math.inf)  # when, s
        self._blind = _Blind(len(leds), sh_period, self.exposure.peak)
        self._lit = np.zeros(len(leds), np.int64)  # turn in which it was lit last
        self._turn = 0
        self._rows = {channel: row for row, channel in enumerate(leds.channels)}
        self._fluxes: NDArray[np.float64] = np.zeros(len(leds))
        away = np.linalg.norm(leds.positions[:, None] - leds.positions, axis=2)
        np.fill_diagonal(away, math.inf)
        nearer = (away[:, None, :] < away[:, :, None] - 1e-6).sum(axis=2)  # than this one
        self._nearness = 1.0 / (1.0 + nearer)

    def sequence(self, motion: MotionFilter, t_ns: int, frames: int) -> list[dict[int, int]]:
        """Plan frames.

        Parameters
        ----------
        motion : MotionFilter
        t_ns : int
            Time of the newest frame taken in; the first one planned is `latency` + 1 later.
        frames : int
            How many.

        Returns
        -------
        list of dict
            For each frame exposures in master clocks by channel, as `Command` takes them.

        Raises
        ------
        ValueError
            If they do not fit into the device's table.
        """
        if not 1 <= frames <= TABLE_MAX // self.per_frame:
            raise ValueError(
                f"frames = {frames} with up to {self.per_frame} LEDs each: the device's table of "
                f"{TABLE_MAX} entries allows 1 to {TABLE_MAX // self.per_frame}"
            )
        start = t_ns + (self.latency + 1) * self.period_ns
        seconds = start * 1e-9
        x, y, _, speed_x, speed_y, *_ = motion.state.tolist()
        ahead = max(start - motion.t_ns, 0) * 1e-9
        x, y = x + ahead * speed_x, y + ahead * speed_y
        self._fluxes = self.exposure.fluxes(x, y, seconds)
        clocks = self.exposure.clocks(self._fluxes)
        if motion.lost:
            if not motion.losses:  # nobody knows how far away they are
                self._fluxes = np.zeros(len(self.leds))
                clocks = self._blind.clocks()
            plan = self._search(motion, start, frames)
        else:
            plan = self._plan(motion, start, frames, clocks)
        result = []
        for rows in plan:
            self._turn += 1
            self._lit[rows] = self._turn
            channels = [self.leds.channels[row] for row in rows]
            result.append(
                allowed(dict(zip(channels, clocks[rows].tolist(), strict=True)), self.sh_period)
            )
        return result

    def observe(self, t_ns: int, lit: Mapping[int, int], spikes: Mapping[int, Spike]) -> None:
        """Take in what came of a frame: heights, and which LEDs were not found.

        Parameters
        ----------
        t_ns : int
        lit : mapping of int to int
            As planned.
        spikes : mapping of int to Spike
            By channel; those left out were not looked for.
        """
        seconds = t_ns * 1e-9
        for channel, spike in spikes.items():
            row = self._rows[channel]
            self.exposure.learn(channel, lit[channel], spike, self._fluxes.item(row), seconds)
            self._blind.learn(row, lit[channel], spike)
            if not int(spike.flags) & _MISSING:
                self._chances[row] = 1.0
            else:
                left = math.exp(min(self._judged.item(row) - seconds, 0.0) / self._forgetting)
                chance = 1.0 - (1.0 - self._chances.item(row)) * left
                self._chances[row] = max(DOUBTFUL * chance, LOWEST)
            self._judged[row] = seconds

    def chances(self, seconds: float) -> NDArray[np.float64]:
        """Chance of each LED to be found where it should be seen, from whether it was lately."""
        left = self._kernels.fading(self._judged, seconds, self._forgetting)
        return np.asarray(1.0 - (1.0 - self._chances) * left)

    def restart(self) -> None:
        """Forget which LEDs were found, and when: another clock begins."""
        self._chances[:] = 1.0
        self._judged[:] = -math.inf
        self._blind = _Blind(len(self.leds), self.sh_period, self.exposure.peak)
        self.exposure.restart()

    def _plan(
        self, motion: MotionFilter, start: int, frames: int, clocks: NDArray[np.float64]
    ) -> list[NDArray[np.int64]]:
        raise NotImplementedError

    def _search(self, motion: MotionFilter, start: int, frames: int) -> list[NDArray[np.int64]]:
        """One LED a frame while lock is lost: those that waited long, rather if they may be seen.

        That is those found lately, and their neighbours; where there was a pose, those that it says
        are in view; else those not tried yet.
        """
        seconds = start * 1e-9
        if not motion.losses:
            likely = np.where(np.isinf(self._judged), 1.0, ELSEWHERE)
        else:
            expected = motion.expected(max(start, motion.t_ns))
            likely = np.array(
                [
                    self._kernels.inside(pixel, sigma**2, float(LAST))
                    for pixel, sigma in zip(
                        expected.pixels.tolist(), expected.sigmas.tolist(), strict=True
                    )
                ]
            )
            likely *= self._fluxes > 0
        found = (self._chances == 1.0) & (seconds - self._judged < self._forgetting / 2)
        if found.any():
            likely = np.maximum(likely, self._nearness[found].max(axis=0))
        weight = np.where(found, 1.0, np.maximum(likely, ELSEWHERE) * self.chances(seconds))
        lit = self._lit.copy()
        plan = []
        for number in range(1, frames + 1):
            row = int(np.argmax(weight * (self._turn + number - lit)))
            lit[row] = self._turn + number
            plan.append(np.array([row]))
        return plan


class RoundRobin(Schedule):
    """One LED after the other, whether it can be seen or not."""

    def _plan(
        self,
        motion: MotionFilter,  # noqa: ARG002  # it asks nobody
        start: int,  # noqa: ARG002
        frames: int,
        clocks: NDArray[np.float64],  # noqa: ARG002
    ) -> list[NDArray[np.int64]]:
        first = self._turn * self.per_frame
        numbers = first + np.arange(frames * self.per_frame).reshape(frames, -1)
        return list(numbers % len(self.leds))

    def _search(
        self,
        motion: MotionFilter,  # noqa: ARG002
        start: int,  # noqa: ARG002
        frames: int,
    ) -> list[NDArray[np.int64]]:
        return list((self._turn + np.arange(frames)[:, None]) % len(self.leds))


class PredictedVisible(Schedule):
    """Of the LEDs that should be seen, those that waited longest."""

    def _plan(
        self, motion: MotionFilter, start: int, frames: int, clocks: NDArray[np.float64]
    ) -> list[NDArray[np.int64]]:
        expected = motion.expected(max(start, motion.t_ns))
        usable = expected.visible & (self._fluxes * clocks < 2 * self.exposure.peak)
        weight = usable * self.chances(start * 1e-9)
        if not weight.any():
            return self._search(motion, start, frames)
        lit = self._lit.copy()
        pixels, sigmas = expected.pixels.tolist(), expected.sigmas.tolist()
        plan = []
        for number in range(1, frames + 1):
            rows: list[int] = []
            for row in np.argsort(-weight * (self._turn + number - lit)).tolist():
                if len(rows) == self.per_frame or not weight[row]:
                    break
                if all(
                    abs(pixels[row] - pixels[other])
                    > self.apart + 3 * (sigmas[row] + sigmas[other])
                    for other in rows
                ):
                    rows.append(row)
            lit[rows] = self._turn + number
            plan.append(np.array(rows))
        return plan


class Greedy(Schedule):
    """The LEDs that should lower the variance of the place most, one choice after the other."""

    def _plan(
        self, motion: MotionFilter, start: int, frames: int, clocks: NDArray[np.float64]
    ) -> list[NDArray[np.int64]]:
        peaks = self._fluxes * clocks
        usable = (peaks > 0) & (peaks < 2 * self.exposure.peak)
        variances = self.sigma**2 * np.maximum(self.exposure.peak / np.maximum(peaks, 1e-9), 1.0)
        chosen = np.empty((frames, self.per_frame), np.int64)
        motion.choose(
            start,
            self.period_ns * 1e-9,
            usable * self.chances(start * 1e-9),
            variances,
            self.apart,
            chosen,
        )
        plan = [rows[rows >= 0] for rows in chosen]
        if not len(plan[0]):
            return self._search(motion, start, frames)
        return plan
