"""The tracker: frames in, poses out. It joins spikes, poses, motion and the choice of LEDs.

>>> from acquisition.links import open_link
>>> from raytransfer.designs import DESIGNS
>>> from tracking.calibration import Calibration
>>> from tracking.leds import LedMap
>>> from tracking.tracker import track
>>> with open_link("twin") as link:  # doctest: +SKIP
...     calibration = Calibration.nominal(DESIGNS["thesis"], LedMap.line(2, 500.0))
...     for estimate in track(link, calibration, count=100):
...         print(estimate.x, estimate.y)
"""

from __future__ import annotations

import gc
import math
from contextlib import closing
from dataclasses import replace
from itertools import islice, pairwise
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from acquisition.capture import Capture
from acquisition.frames import ELEMENTS, MASTER_CLOCK, Frame, FrameFlags
from acquisition.protocol import BRIEF_TABLE_MAX, ICG_MIN, WINDOW_MIN, Command, Mode
from raytransfer import TCD1304
from raytransfer import _checks as check
from tracking.camera import Camera
from tracking.leds import LedMap
from tracking.motion import Innovation, MotionFilter, Outcome
from tracking.poses import Estimate, PoseFlags, Prior, locate, optical
from tracking.scheduling import ExposureControl, PredictedVisible
from tracking.spikes import MISSING, Spike, SpikeFinder, SpikeFlags

if TYPE_CHECKING:
    from collections.abc import Collection, Generator, Iterator, Mapping, Sequence

    from acquisition.frames import OnboardSpike, SpikeFrame
    from acquisition.links import Link
    from tracking.calibration import Calibration
    from tracking.motion import Expected
    from tracking.scheduling import Schedule
    from tracking.spikes import Detector

AHEAD: Final = 4
"""Frames that a schedule is made for at a time."""

SH_PERIOD: Final = 100
"""Longest exposure if nothing else is said: 25 µs, as in the thesis; master clocks."""

PER_FRAME: Final = 3
"""Most LEDs of one frame, if nothing else is said."""

PLACED: Final = 0.5
"""How well LEDs are where a map has them that nobody has calibrated, mm."""

PEAK: Final = 30_000.0
"""Height of a spike that exposures aim for, electrons: a third of what fills a pixel."""

UNLIT_EVERY: Final = 20
"""Frames from one without light to the next, if nothing else is said: 5 % of them."""

LATE: Final = 8
"""Frames by which one may come late; what is earlier is of another recording or another start."""

BRISK_NS: Final = 10_000_000
"""Period from frame to frame up to which times that the filter waits are the same, ns. With longer
ones they are as many frames, and it may be as uncertain as motion makes it in them: white
acceleration by their power of 3/2."""

SLOWEST: Final = {True: 0.1, False: 0.05}
"""Longest period from frame to frame with the heading known, or not, s: beyond, so much may happen
between two frames that no pose would hold."""

END: Final = 60.0
"""Pixels at the ends of the line where part of a spike's light may be beyond it."""

_SPEED = 1000.0  # mm/s; what is not known better
_TURNING = 1.5  # rad/s
_MEMORY, _PATIENCE = 0.25, 0.3  # s
_UNCERTAINTY = 50.0, 0.015  # mm, rad
_STROLL = 300.0  # mm/s; while two LEDs are seen one after the other
_WIDTH = 40.0  # px of a spike that was not seen yet
_REACH = 1.5  # widths that a spike's light reaches to either side
_MARGIN = 8.0  # px of background beyond it
_DOUBLE, _CLIPPED = SpikeFlags.DOUBLE.value, SpikeFlags.CLIPPED.value
_REFLECTION = SpikeFlags.REFLECTION.value
_UNCERTAIN = _CLIPPED | _DOUBLE
_ODD = SpikeFlags.MISSING.value | _UNCERTAIN
_KEPT = PoseFlags.INCONSISTENT | PoseFlags.UNCHECKED
_USUAL = 1.6  # times the mean width: wider is unusual
_LEAST = 0.15  # of a lamp's height by which its light may have changed
_PARALLEL = 0.995  # cosine between the facings of a wall's LEDs
_APART = 1.0  # widths: spikes of one frame that are nearer cannot be told apart


class Step(NamedTuple):
    """What a frame led to.

    Attributes
    ----------
    frame : Frame or SpikeFrame
    t_ns : int
        Its time: the end of its exposure, device time in ns.
    estimate : Estimate or None
        None as long as no pose has ever been known.
    innovations : tuple of Innovation
        What each LED lit said beside what was expected.
    """

    frame: Frame | SpikeFrame
    t_ns: int
    estimate: Estimate | None
    innovations: tuple[Innovation, ...]

    @property
    def lit(self) -> tuple[int, ...]:
        """Channels of the LEDs lit."""
        return self.frame.channels


class Tracker:
    """Follows a tracker from frame to frame.

    As long as no pose is known, LEDs are lit one by one and sought over the whole line; then each
    is sought where it is expected, and several may be lit at once. When lock is lost it begins
    again. Everything is compiled when it is made: no frame waits for that.

    Parameters
    ----------
    calibration : Calibration
        At least two LEDs.
    heading : Prior, optional
        With sigma 0 it is known and not estimated, which two LEDs need: with two, and left out, it
        is taken to be 0. An infinite sigma, the default with three or more, leaves it open.
    height : Prior
        Of the tracker, mm.
    detector : {"minimum", "gravity", "derivative", "likelihood"}
    schedule : Schedule, optional
        What to light, of the calibration's LEDs. Left out, a `PredictedVisible` of up to three LEDs
        a frame, with an SH period of 100 clocks and the shortest ICG period.
    unlit_every : int
        Frames from one in which no LED is lit to the next; 0 is never. What shines in it, a lamp, a
        window, is subtracted where an LED is sought, as long as it stays in its place on the line.
        Not in spikes mode, in which nothing can be subtracted.
    **motion
        Further options of `MotionFilter`. Its memory, patience and uncertainty follow from the
        frames' period when left out.

    Attributes
    ----------
    innovations : tuple of Innovation
        Of the last frame.

    Raises
    ------
    ValueError
        There are too few LEDs, or a heading that is neither known nor open; unlit_every is below 0
        or 1; the schedule is of another map, or its frames are further apart than `SLOWEST`.
    """

    def __init__(
        self,
        calibration: Calibration,
        *,
        heading: Prior | None = None,
        height: Prior = Prior(0.0, 0.0),  # noqa: B008  # immutable
        detector: Detector = "likelihood",
        schedule: Schedule | None = None,
        unlit_every: int = UNLIT_EVERY,
        **motion: Any,
    ) -> None:
        leds = calibration.leds
        if len(leds) < 2:
            raise ValueError(f"{len(leds)} LED in the map: a pose needs two, with a known heading")
        if heading is None:
            heading = Prior(0.0, 0.0 if len(leds) == 2 else math.inf)
        if heading.sigma not in (0, math.inf):
            raise ValueError(
                f"sigma of heading = {heading.sigma}: allowed is 0, it is known, or infinity, it "
                "is measured"
            )
        if heading.sigma and len(leds) == 2:
            raise ValueError("two LEDs do not tell the heading: give one, or a map of three")
        check.number("value of heading", heading.value, "rad")
        if unlit_every < 0 or unlit_every == 1:
            raise ValueError(
                f"unlit_every = {unlit_every}: allowed are 2 and more frames, or 0 for never"
            )
        schedule = default_schedule(leds) if schedule is None else schedule
        if schedule.leds != leds:
            raise ValueError(
                f"the schedule lights LEDs {', '.join(map(str, schedule.leds.channels))} of a map "
                "that is not the calibration's: were places or channels changed?"
            )
        self.schedule = schedule
        self._unlit_every = unlit_every
        self._since_unlit = unlit_every  # frames
        self._unlit: Frame | None = None  # the newest
        self._lamps: list[Spike] = []  # that shine in it
        self._heading = heading if heading.sigma == 0 else None
        self.calibration = calibration
        self.leds = leds
        self.innovations: tuple[Innovation, ...] = ()
        still = {"angular": 0.0, "turning": 1e-9}  # a heading that is known does not change
        options = {"speed": _SPEED, "turning": _TURNING, **(still if self._heading else {})}
        if calibration.covariance is None:
            options["led_error"] = PLACED
        self._height, self._options = height, {**options, **motion}
        self._losses = 0  # of filters before this one
        self._begin(schedule.period_ns)
        self._finder = SpikeFinder(calibration.correction, detector=detector)
        self._warm()
        self._widths = dict.fromkeys(leds.channels, _WIDTH)
        self._t_ns: int | None = None
        self._sequence = 0  # number of the newest frame
        self._known = False  # whether there was ever a pose
        self._told: set[int] = set()  # LEDs of which the schedule has heard since its last plan
        self._left = 0  # frames until a new sequence is due

    @property
    def locked(self) -> bool:
        """Whether the pose is known."""
        return not self._filter.lost

    @property
    def losses(self) -> int:
        """How often lock was lost."""
        return self._losses + self._filter.losses

    def update(self, frame: Frame | SpikeFrame) -> Estimate | None:
        """Take a frame in, and return the pose at the end of its exposure.

        Where the device's clock runs back, everything begins anew.

        Parameters
        ----------
        frame : Frame or SpikeFrame
            One with `FrameFlags.INVALID` is not measured on. One that comes late or twice changes
            nothing.

        Returns
        -------
        Estimate or None
            None as long as no pose has ever been known, and for what comes late or twice.

        Raises
        ------
        ValueError
            It was lit by an LED that the map does not have, or comes from a recording whose frames
            are further apart than `SLOWEST`.
        """
        if unknown := [n for n in frame.channels if n not in self._widths]:
            raise ValueError(
                f"frame {frame.sequence} is lit by LED {unknown[0]}, and the LED map has "
                f"{', '.join(map(str, self.leds.channels))}: is it that of another room?"
            )
        t_ns = self._time(frame)
        if self._stale(frame, t_ns):
            self.innovations = tuple(
                Innovation(t_ns, n, math.nan, math.nan, math.inf, Outcome.STALE)
                for n in frame.channels
            )
            return None
        self._follow_clock(frame, t_ns)
        lost = self._filter.lost
        spikes: dict[int, Spike] = {}
        self._since_unlit += 1
        if not frame.flags & FrameFlags.INVALID:
            if isinstance(frame, Frame) and not frame.channels:
                self._unlit, self._lamps = frame, self._finder(frame)
            spikes = self._sought(frame) if lost else self._expected(frame, t_ns)
        # LEDs go out together: the longest exposure has the earliest middle
        lit = {n: frame.exposures.get(n, frame.sh_period) for n in spikes}
        if frame.exposures:
            # once for each plan: heights are compared with what that plan had expected
            news = {n: spike for n, spike in spikes.items() if n not in self._told}
            self.schedule.observe(t_ns, lit, news)
            self._told.update(news)
        found = []
        for channel, clocks in sorted(lit.items(), key=lambda item: -item[1]):
            middle = t_ns - round(clocks / frame.master_clock * 0.5e9)
            spike = self._judged(channel, spikes[channel])
            if self._filter.lost and self._heading is not None:
                found.append(self._keep(middle, channel, spike))
            else:
                found.append(self._filter.update(middle, channel, spike))
            if not int(spike.flags) & _ODD:
                self._widths[channel] += 0.25 * (spike.width - self._widths[channel])
        self.innovations = tuple(found)
        if not found:
            self._filter.observe(t_ns, {})
        if self._filter.lost and self._heading is not None:
            self._fix(t_ns)
        self._left -= 1
        if lost != self._filter.lost:
            self._left = 0
            self._seen.clear()
        return self._estimate(t_ns, lost=lost)

    def step(self, frame: Frame | SpikeFrame) -> Step:
        """As `update`, with what it was based on."""
        t_ns = self._time(frame)
        estimate = self.update(frame)
        return Step(frame, t_ns, estimate, self.innovations)

    def sequence(self, *, spikes: bool = False) -> list[dict[int, int]] | None:
        """What to light in the next frames: exposure in master clocks by channel, frame by frame.

        Parameters
        ----------
        spikes : bool
            Whether the microcontroller finds the spikes: then no frame is left unlit.

        Returns
        -------
        list of dict, or None
            None: go on as before.
        """
        if self._left > 0:
            return None
        self._told.clear()
        frames = self._left = min(AHEAD, max(1, BRIEF_TABLE_MAX // self.schedule.per_frame))
        unlit: list[dict[int, int]] = []
        if self._unlit_every and not spikes and self._since_unlit >= self._unlit_every:
            unlit, frames = [{}], max(frames - 1, 1)
            self._since_unlit = 0
        return unlit + self.schedule.sequence(self._filter, self._t_ns or 0, frames)

    def windows(self, sequence: Sequence[Mapping[int, int]]) -> list[list[tuple[int, int]]]:
        """Where the microcontroller shall look for the spikes of a `sequence` just planned.

        Returns
        -------
        list of list of tuple of int
            For each frame first and last pixels, by rising pixels and apart from each other; an
            empty list is the whole line.
        """
        if self._filter.lost:
            return [[] for _ in sequence]
        period = self.schedule.period_ns
        start = max(self._t_ns or 0, self._filter.t_ns) + (self.schedule.latency + 1) * period
        result = []
        for number, lit in enumerate(sequence):
            # a plan that its successor replaces late is gone through twice
            times = (start + number * period, start + (number + len(sequence)) * period)
            found = [self._lit_windows(lit, self._filter.expected(t)) for t in times]
            both = [(*found[0][n], *found[1][n]) for n in found[0] if n in found[1]]
            apart: list[tuple[int, int]] = []
            for first, last in sorted((min(w), max(w)) for w in both):
                if apart and first <= apart[-1][1]:  # what is found there is told apart by place
                    apart[-1] = (apart[-1][0], max(apart[-1][1], last))
                else:
                    apart.append((first, last))
            result.append([w for w in apart if w[1] - w[0] + 1 >= WINDOW_MIN])
        return result

    def _warm(self) -> None:
        """Go once through all that is compiled: a kernel is loaded, or made, when it is called."""
        self._finder.load_kernels()
        codes = np.full(ELEMENTS, 3900, np.uint16)
        codes[2000:2010] = 3000
        self._finder(Frame(codes))
        self._finder(Frame(codes), windows=[(1900, 2000)], unlit=Frame(codes))
        # a camera and a room in which a pose is found, whatever those of the user are
        camera, leds = (
            Camera(3500.0, (TCD1304.pixels - 1) / 2, (0.02,)),
            LedMap.line(9, 200.0, 300.0),
        )
        points = optical(leds.positions, 0.0, 3000.0, 0.0, 0.0)
        pixels = camera.project(points)
        motion = MotionFilter(camera, leds, height=Prior(0.0, min(self._height.sigma, 1.0)))
        plan = default_schedule(leds)
        for number in range(4 * len(leds)):
            row = number % len(leds)
            spike = Spike(float(pixels[row]), 0.1, 10.0, 1e4)
            motion.update(number * plan.period_ns, leds.channels[row], spike)
        locate(camera, leds.positions, pixels, 0.1, heading=Prior(0.0, 0.0))
        for lost in (False, True):
            motion.lost, motion.losses = lost, 1
            plan.sequence(motion, motion.t_ns, AHEAD)
            motion.estimate(motion.t_ns + 1)
            motion.expected(motion.t_ns + 1)
        gc.collect()  # compiling leaves much behind: clear it away now, not between two frames

    def _begin(self, period_ns: int) -> None:
        """Know of no pose, and that frames come with this period."""
        known = self._heading is not None
        slowest = SLOWEST[known]
        if period_ns > slowest * 1e9:
            raise ValueError(
                f"a frame every {period_ns * 1e-9:g} s, heading {'' if known else 'not '}known: "
                f"allowed is up to {slowest:g} s, an ICG period of {slowest * MASTER_CLOCK:.0f} clocks"
            )
        self._period_ns = period_ns
        options = self._pace() | self._options
        self._memory_ns = round(options["memory"] * 1e9)
        self._filter = MotionFilter(
            self.calibration.camera, self.leds, height=self._height, **options
        )
        self._seen: dict[int, tuple[int, Spike]] = {}  # latest, while lock is lost
        self._last: Estimate | None = None  # that was known
        self._fresh = PoseFlags.NONE  # of a pose just found
        self._unlit, self._lamps = None, []

    def _pace(self) -> dict[str, Any]:
        """Limits of the filter, as many frames away as with `BRISK_NS`."""
        slow = max(self._period_ns / BRISK_NS, 1.0)
        place, heading = _UNCERTAINTY
        return {
            "memory": slow * _MEMORY,
            "patience": slow * _PATIENCE,
            "uncertainty": (slow**1.5 * place, slow**1.5 * heading),
        }

    def _time(self, frame: Frame | SpikeFrame) -> int:
        """End of the exposure, ns; of frames without a time, one read-out after the other."""
        if frame.timestamp is not None:
            return frame.timestamp
        clocks = frame.icg_period or ICG_MIN
        return (self._t_ns or 0) + round(clocks / frame.master_clock * 1e9)

    def _stale(self, frame: Frame | SpikeFrame, t_ns: int) -> bool:
        """Whether a frame comes late or twice: its number has gone back by as much as its time."""
        if self._t_ns is None or t_ns > self._t_ns:
            return False
        behind = (self._t_ns - t_ns) / self._period_ns
        return behind < LATE and abs(self._sequence - frame.sequence - behind) < 0.5

    def _follow_clock(self, frame: Frame | SpikeFrame, t_ns: int) -> None:
        """Begin anew with another clock, and with the period that the frames really have."""
        back = self._t_ns is not None and t_ns < self._t_ns
        if back:  # another recording, or the device began anew
            self._losses += self._filter.losses + (not self._filter.lost)
            self.schedule.restart()
        if back or self._t_ns is None:
            period_ns = round(frame.icg_period / frame.master_clock * 1e9)
            self._begin(period_ns or self._period_ns)
        self._t_ns, self._sequence = t_ns, frame.sequence

    def _sought(self, frame: Frame | SpikeFrame) -> dict[int, Spike]:
        """Spikes of the whole line: the strongest, as many as LEDs are lit.

        Several at once are told apart by their order only: LEDs of a wall, seen from its front,
        have that of their place along it. Of different walls, or where one is far before another, it
        depends on where one stands.
        """
        channels = frame.channels
        if not channels:
            return {}
        found = self._whole_line(frame)[: len(channels)]
        if len(channels) == 1:
            return {channels[0]: found[0] if found else MISSING}
        rows = [self.leds.index(n) for n in channels]
        facings = self.leds.facings[rows]
        wall = np.array([math.cos(facings[0]), math.sin(facings[0])])
        places = self.leds.positions[rows, :2] @ np.column_stack([wall, [-wall[1], wall[0]]])
        order = np.argsort(places[:, 0])
        steps = np.diff(places[order], axis=0)
        parallel = np.cos(facings - facings[0]).min() > _PARALLEL
        if len(found) < len(channels) or not parallel or (steps[:, 0] <= abs(steps[:, 1])).any():
            return {}
        turned = self.calibration.camera.scale < 0
        along = [channels[i] for i in order]
        spikes = sorted(found, key=lambda spike: spike.position, reverse=turned)
        return dict(zip(along, spikes, strict=True))

    def _expected(self, frame: Frame | SpikeFrame, t_ns: int) -> dict[int, Spike]:
        """Spikes of the LEDs lit, each where it should be."""
        expected = self._filter.expected(max(t_ns, self._filter.t_ns))
        windows = self._lit_windows(frame.channels, expected)
        if isinstance(frame, Frame):
            places = list(windows.values())
            spikes = self._finder(frame, windows=places, unlit=self._background(frame, places))
            return dict(zip(windows, spikes, strict=True))
        found = self._whole_line(frame)
        return {
            channel: next((s for s in found if first <= s.position <= last), MISSING)
            for channel, (first, last) in windows.items()
        }

    def _judged(self, channel: int, spike: Spike) -> Spike:
        """How far a spike is believed: DOUBLE and CLIPPED ones the filter takes for less sure.

        A double peak no wider than this LED's spikes are is the head's caustic: LEDs that would meet
        are not looked for at once, so that a second one does not hide here. At the end of the line
        some light may be lacking. A reflection pulls a spike as a second LED would; once a pose is
        known that is left to the filter's gate, which with less sure spikes would be wider.
        """
        if not spike.found:
            return spike
        flags = as_found = int(spike.flags)  # an enum's & takes 1 µs
        if flags & _DOUBLE and spike.width < _USUAL * self._widths[channel]:
            flags &= ~_DOUBLE
        if flags & _REFLECTION and self._filter.lost:
            flags |= _DOUBLE
        if not END <= spike.position <= TCD1304.pixels - 1 - END:
            flags |= _CLIPPED
        return replace(spike, flags=SpikeFlags(flags)) if flags != as_found else spike

    def _background(
        self, frame: Frame, windows: Collection[tuple[int, int]] | None = None
    ) -> Frame | None:
        """The unlit frame, if lamps that it shows in the windows are still where they were.

        An LED only adds light: where there is less than in the unlit frame, a lamp has moved.
        """
        unlit = self._unlit
        if unlit is None or not self._lamps or unlit.sh_period != frame.sh_period:
            return None
        gain, noise = self._finder.correction.electrons_per_code, self._finder.correction.read_noise
        levels = frame.dark_level, unlit.dark_level
        met = False
        for lamp in self._lamps:
            first, last = max(int(lamp.position - lamp.width), 0), int(lamp.position + lamp.width)
            if windows is not None and not any(a <= last and first <= b for a, b in windows):
                continue
            met = True
            core = slice(first, last + 1)
            more = (levels[0] - frame.pixels[core].astype(float)) - (
                levels[1] - unlit.pixels[core].astype(float)
            )
            doubt = 4 * math.sqrt(2 * (lamp.height + noise**2))
            if more.min() * gain < -_LEAST * lamp.height - doubt:
                return None
        return unlit if met else None

    def _whole_line(self, frame: Frame | SpikeFrame) -> list[Spike]:
        """All spikes, the strongest first."""
        if isinstance(frame, Frame):
            return self._finder(frame, unlit=self._background(frame) if frame.channels else None)
        gain, noise = self._finder.correction.electrons_per_code, self._finder.correction.read_noise
        found = [_from_device(s, gain, noise, self._unevenness) for s in frame.spikes]
        return sorted(found, key=lambda spike: -spike.height)

    def _lit_windows(self, lit: Collection[int], expected: Expected) -> dict[int, tuple[int, int]]:
        """First and last pixel by channel; LEDs that cannot be told apart are left out."""
        channels, pixels, sigmas = expected.channels, expected.pixels, expected.sigmas
        rows = [row for row in map(self.leds.index, lit) if expected.visible[row]]
        rows.sort(key=pixels.__getitem__)
        widths = [self._widths[channels[row]] for row in rows]
        windows = {
            channels[row]: expected.window(channels[row], _REACH * width + _MARGIN)
            for row, width in zip(rows, widths, strict=True)
        }
        mixed = set()
        for (i, row), (j, other) in pairwise(enumerate(rows)):
            one, next_one = channels[row], channels[other]
            gap = pixels[other] - pixels[row]
            if gap < _APART * (widths[i] + widths[j]) + 3 * (sigmas[row] + sigmas[other]):
                mixed |= {one, next_one}
            border = (pixels[row] + pixels[other]) / 2
            (low, high), (next_low, next_high) = windows[one], windows[next_one]
            windows[one] = low, min(high, math.ceil(border))
            windows[next_one] = max(next_low, math.floor(border)), next_high
        return {channel: places for channel, places in windows.items() if channel not in mixed}

    @property
    def _unevenness(self) -> float:
        """Of pixels, which the microcontroller does not correct."""
        response = self._finder.correction.response
        return max(float(response.std()), self._finder.correction.uncertainty)

    def _keep(self, t_ns: int, channel: int, spike: Spike) -> Innovation:
        if spike.found:
            self._seen[channel] = t_ns, spike
        outcome = Outcome.KEPT if spike.found else Outcome.MISSING
        return Innovation(t_ns, channel, math.nan, math.nan, math.inf, outcome)

    def _fix(self, t_ns: int) -> None:
        """Seek a pose of known heading in the latest spike of each LED."""
        assert self._heading is not None  # noqa: S101  # as the caller has asked
        recent = {n: kept for n, kept in self._seen.items() if t_ns - kept[0] <= self._memory_ns}
        if len(recent) < 2:
            return
        camera = self.calibration.camera
        smear = abs(camera.scale) * _STROLL / 1000  # px/s, seen from a metre
        ages = np.array([t_ns - at for at, _ in recent.values()]) * 1e-9
        sigmas = np.array(
            [
                math.hypot(s.sigma, s.width / 4 if int(s.flags) & _UNCERTAIN else 0.0)
                for _, s in recent.values()
            ]
        )
        rows = [self.leds.index(n) for n in recent]
        try:
            fix = locate(
                camera,
                self.leds.positions[rows],
                np.array([spike.position for _, spike in recent.values()]),
                np.sqrt(sigmas**2 + (3 * camera.model_error) ** 2 + (smear * ages) ** 2),
                heading=self._heading,
                height=self._height,
                facings=self.leds.facings[rows],
            )
        except ValueError:  # no pose has the LEDs in front, and shining toward it
            return
        limit = fix.degrees + 4 * math.sqrt(2 * max(fix.degrees, 0))
        if not np.isfinite(fix.covariance).all() or fix.flags & PoseFlags.AMBIGUOUS:
            return
        if fix.degrees > 0 and fix.chi2 > limit:
            return
        self._filter.start(fix, t_ns, recent)
        # the filter keeps UNCHECKED, as long as it is so
        self._fresh = fix.flags & ~PoseFlags.UNCHECKED

    def _estimate(self, t_ns: int, *, lost: bool) -> Estimate | None:
        """The pose at the end of a frame, in which lock was lost at its beginning or not."""
        flags = PoseFlags.NONE if self._heading is None else PoseFlags.HEADING_ASSUMED
        if self._filter.lost:
            if self._last is None:
                return None
            seconds = (t_ns - self._last.t_ns) * 1e-9
            rates = np.array([_SPEED, _SPEED, 0.0 if self._heading else _TURNING])
            covariance = self._last.covariance + np.diag((rates * seconds) ** 2)
            return replace(
                self._last, t_ns=t_ns, covariance=covariance, flags=flags | PoseFlags.LOST
            )
        # of all LEDs of the frame; the filter's own flags are those of the last one
        outcomes = {found.outcome for found in self.innovations}
        now = self._filter.estimate(max(t_ns, self._filter.t_ns))
        flags |= now.flags & _KEPT | self._fresh
        self._fresh = PoseFlags.NONE
        if Outcome.REJECTED in outcomes:
            flags |= PoseFlags.REJECTED
        if lost and self._known:
            flags |= PoseFlags.RELOCALISED
        self._known = True
        if not lost and Outcome.USED not in outcomes:
            flags |= PoseFlags.PREDICTED
        now = replace(now, flags=flags)
        if self._heading is not None:  # rounding aside it has not changed
            now.covariance[2] = now.covariance[:, 2] = 0.0
            now = replace(now, heading=self._heading.value)
        self._last = now
        return now


def _from_device(found: OnboardSpike, gain: float, noise: float, uneven: float) -> Spike:
    """A spike that the microcontroller found, with the error that one of its size has.

    Of a Gaussian with standard deviation s and height h: photons give s²/(√(2π) s h), read noise r
    gives 2 s r²/(√π h²), uneven pixels u² s/(4 √π); the filter needs 1.15 times the root.
    """
    height, s = found.height * gain, max(found.width, 1.0) / 2.3548
    if height <= 0:
        return MISSING
    variance = s / (2.5066 * height) + 1.1284 * s * (noise / height) ** 2 + 0.1410 * s * uneven**2
    sigma = 1.15 * math.sqrt(variance)
    return Spike(found.position, sigma, found.width, height, SpikeFlags(found.flags))


def default_schedule(
    leds: LedMap, sh_period: int = SH_PERIOD, icg_period: int | None = None
) -> Schedule:
    """Up to `PER_FRAME` LEDs a frame, those that should be seen.

    Parameters
    ----------
    leds : LedMap
    sh_period : int
        The longest exposure, master clocks.
    icg_period : int, optional
        From frame to frame, master clocks; the shortest possible when left out.

    Raises
    ------
    CommandError
        The periods are not possible.
    """
    if icg_period is None:
        icg_period = -(-ICG_MIN // sh_period) * sh_period if sh_period > 0 else ICG_MIN
    return PredictedVisible(
        leds,
        sh_period,
        icg_period,
        exposure=ExposureControl(leds, sh_period, peak=PEAK),
        per_frame=min(len(leds), PER_FRAME),
    )


def first_command(tracker: Tracker, *, count: int = 0, spikes: bool = False) -> Command:
    """The command that a capture for `follow` begins with.

    Parameters
    ----------
    tracker : Tracker
    count : int
        Frames; 0 is without end.
    spikes : bool
        Whether the microcontroller finds the spikes.
    """
    schedule = tracker.schedule
    mode = Mode.SPIKES if spikes else Mode.STREAM
    # without windows: while lock is lost, spikes are sought on the whole line
    sequence = tracker.sequence(spikes=spikes) or ()
    icg_period = round(schedule.period_ns * MASTER_CLOCK * 1e-9)
    return Command(schedule.sh_period, icg_period, count, mode, sequence)


def follow(capture: Capture, tracker: Tracker, *, steer: bool = True) -> Generator[Step]:
    """Yield what each frame of a running capture leads to.

    Parameters
    ----------
    capture : Capture
        In stream or spikes mode; from `first_command` where it is to be steered.
    tracker : Tracker
    steer : bool
        Send what the tracker wants lit next. Not for recordings: their LEDs are what they are.

    Yields
    ------
    Step
        One for each frame; the first ones without a pose.
    """
    spikes = capture.command.mode is Mode.SPIKES
    for frame in capture:
        step = tracker.step(frame)
        if steer and (wanted := tracker.sequence(spikes=spikes)) is not None:
            if spikes:
                windows = tracker.windows(wanted)
                capture.send(replace(capture.command, sequence=wanted, windows=windows))
            else:
                capture.send(wanted)
        yield step


def track(
    link: Link, calibration: Calibration, *, count: int = 0, spikes: bool = False, **options: Any
) -> Iterator[Estimate]:
    """Yield poses: one for each frame from a link, once the first is known.

    Parameters
    ----------
    link : Link
        Stays open. A recording is followed with the LEDs that it was made with.
    calibration : Calibration
    count : int
        Poses; 0 is without end.
    spikes : bool
        As for `first_command`.
    **options
        As for `Tracker`.

    Yields
    ------
    Estimate
    """
    tracker = Tracker(calibration, **options)
    command = first_command(tracker, spikes=spikes)
    steer = not hasattr(link, "recorded")
    with Capture(link, command) as capture, closing(follow(capture, tracker, steer=steer)) as steps:
        poses = (step.estimate for step in steps if step.estimate is not None)
        yield from islice(poses, count or None)
