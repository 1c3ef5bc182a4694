"""Hours of tracking on simulated spikes, with all that goes wrong in a room and on a link.

``python -m tests.tracking.endurance --hours 24 --seed 1``; `run` is the same for tests.
"""

from __future__ import annotations

import argparse
import gc
import importlib
import math
import os
import pickle
import sys
import time
from dataclasses import dataclass, field, replace
from datetime import datetime
from functools import lru_cache
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np

from acquisition.frames import ELEMENTS, Frame
from raytransfer.designs import DESIGNS
from raytransfer.heads import Scene
from tracking.calibration import Calibration
from tracking.leds import LedMap
from tracking.nominal import nominal_camera
from tracking.poses import PoseFlags
from tracking.spikes import SpikeFlags
from tracking.tracker import Tracker, default_schedule
from twin.spikes import Faults, SpikeTable, SpikeWorld, Wander
from twin.world import Led

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Iterable, Sequence

    from tracking.camera import Camera
    from tracking.poses import Estimate
    from tracking.spikes import Spike

SH_PERIOD, ICG_PERIOD = 400, 14_800
"""100 µs of light, 270 frames a second."""
FRAMES = round(3600 * 4e6 / ICG_PERIOD)
"""In an hour."""

DESIGN = "slit-4mm"
LATENCY = 3
"""Frames from one taken in to the first that is lit as was asked for then."""
PLACED = 0.3
"""How far LEDs stand off the plan, mm in x and in y, standard deviation."""

FLAGGED = int(
    PoseFlags.LOST
    | PoseFlags.PREDICTED
    | PoseFlags.RELOCALISED
    | PoseFlags.INCONSISTENT
    | PoseFlags.UNCHECKED
)
"""Who sees one of these is warned. A pose that only says that a spike was refused is not excused."""

USELESS = int(SpikeFlags.MISSING | SpikeFlags.SATURATED)

EVERY = 199
"""Poses of which one is kept for the errors' statistics."""

WARM = 20_000  # frames, after which nothing new is loaded
NEEDED = 3  # LEDs, for a pose
RECOVERY = 0.5  # s
WRONG = 1e-4  # part of all poses
GROWTH = 20_000_000  # bytes: 20 a frame would be more in an hour
INTERRUPTED = 130  # exit code


def room(count: int = 40, size: float = 10_000.0, power: float = 0.25) -> list[Led]:
    """LEDs at even distances along the walls of a square room, shining inward."""
    leds = []
    for number in range(count):
        side, along = divmod((number + 0.5) * 4 * size / count, size)
        facing = side * math.pi / 2
        x, y = along - size / 2, -size / 2
        sin, cos = math.sin(facing), math.cos(facing)
        place = (x * cos - y * sin, x * sin + y * cos, 0.0)
        leds.append(Led(number, place, power=power, facing=facing, extent=2.0))
    return leds


def led_map(leds: list[Led]) -> LedMap:
    """What the tracker is told of them."""
    return LedMap(
        [led.channel for led in leds],
        [led.position for led in leds],
        [led.facing for led in leds],
    )


@lru_cache(maxsize=1)
def head() -> tuple[SpikeTable, Camera]:
    """Exact spikes of the head, and the camera that its drawing says."""
    system = DESIGNS[DESIGN].system
    background = replace(Scene(), integration_time=SH_PERIOD / 4e6).background(system)
    return SpikeTable(system, background=background), nominal_camera(DESIGNS[DESIGN])


@dataclass
class Report:
    """What happened.

    The clock of a recovery starts with the first frame, taken in while lock is lost, at which three
    LEDs or more can be seen: in front of the tracker, their spikes on the line, nothing before them,
    high enough when lit for the whole integration. It starts anew when there are fewer for a moment,
    since three are needed for a pose, and ends with the frame after which lock is there again. The
    first search of a run counts, too.

    Attributes
    ----------
    frames : int
    seconds : float
        Virtual.
    possible : int
        Frames at which three LEDs or more can be seen.
    locked : int
        Frames with a pose that is not flagged.
    wrong : int
        Of these, poses off by more than 5 σ in x, y or heading.
    losses : int
        Of lock.
    recoveries : list of float
        s.
    waiting : float
        Time on the clock of a recovery that has not come yet, s.
    useful, lit : int
        Spikes found and not saturated; LEDs lit.
    errors : list of float
        Of one locked pose in `EVERY`, mm.
    growth : int
        By how much the process is larger in the end than after the warm-up, bytes.
    """

    frames: int = 0
    seconds: float = 0.0
    possible: int = 0
    locked: int = 0
    wrong: int = 0
    losses: int = 0
    recoveries: list[float] = field(default_factory=list)
    waiting: float = 0.0
    useful: int = 0
    lit: int = 0
    errors: list[float] = field(default_factory=list)
    growth: int = 0
    _since: float | None = None

    def take(
        self,
        seconds: float,
        estimate: Estimate | None,
        pose: Callable[[], Sequence[float]],
        visible: Callable[[], int],
        *,
        lost: bool,
    ) -> None:
        """Judge a frame: its time, what the tracker says, the truth, and how many LEDs can be seen."""
        self.frames += 1
        possible = visible() >= NEEDED
        self.possible += possible
        if lost:
            if not possible:
                self._since, self.waiting = None, 0.0
            else:
                self._since = seconds if self._since is None else self._since
                self.waiting = seconds - self._since
        elif self._since is not None:
            self.recoveries.append(seconds - self._since)
            self._since, self.waiting = None, 0.0
        if estimate is None or int(estimate.flags) & FLAGGED:
            return
        self.locked += 1
        x, y, heading = pose()
        dx, dy = estimate.x - x, estimate.y - y
        turned = math.remainder(estimate.heading - heading, math.tau)
        xx, yy, hh = estimate.covariance.diagonal().tolist()
        self.wrong += dx * dx > 25 * xx or dy * dy > 25 * yy or turned * turned > 25 * hh
        if not self.locked % EVERY:
            self.errors.append(math.hypot(dx, dy))

    def failures(self) -> list[str]:
        """Tell which criteria are not met."""
        found = []
        if self.wrong > WRONG * self.locked:
            found.append(f"{self.wrong} of {self.locked} poses off by more than 5 σ, unflagged")
        if late := [t for t in [*self.recoveries, self.waiting] if t > RECOVERY]:
            found.append(f"{len(late)} recoveries later than {RECOVERY} s: {max(late):.2f} s")
        if self.growth > GROWTH:
            found.append(f"memory has grown by {self.growth} bytes")
        return found

    def __str__(self) -> str:
        if not self.frames:
            return "nothing happened"
        hours = self.seconds / 3600
        length = f"{hours:.2f} h" if hours >= 1 else f"{60 * hours:.1f} min"
        recoveries = np.array(self.recoveries or [0.0])
        errors = np.array(self.errors or [0.0])
        return (
            f"{length}, {self.frames} frames, at {self.possible / self.frames:.2%} "
            f"of them three LEDs in view, at {self.locked / self.frames:.2%} an unflagged pose; "
            f"{self.wrong} of these off by more than 5 σ "
            f"({self.wrong / max(self.locked, 1):.1e}); {self.losses} losses of lock, "
            f"{len(recoveries)} recoveries in {np.median(recoveries):.3f} s (median), "
            f"{recoveries.max():.3f} s (worst); {self.useful / self.seconds:.0f} useful exposures/s "
            f"of {self.lit / self.seconds:.0f}; errors {np.median(errors):.2f} mm (median), "
            f"{np.sqrt(np.mean(errors**2)):.2f} mm (RMS); memory {self.growth / 1e6:+.1f} MB"
        )


class Sight:
    """Stands in for a tracker's `SpikeFinder`: says what there is to find, without an image."""

    def __init__(self, world: SpikeWorld) -> None:
        self._world = world
        self.useful = 0

    def __call__(
        self,
        frame: Frame,
        *,
        windows: Sequence[tuple[int, int]] | None = None,
        unlit: Frame | None = None,
    ) -> list[Spike]:
        """Strongest spike of each window, or of the line."""
        assert unlit is None, "there are no lamps"
        channels = frame.channels
        places = None
        if windows is not None:  # the world wants one for each LED lit
            beside = [(0, 0)] * (len(channels) - len(windows))
            places = dict(zip(channels, [*windows, *beside], strict=True))
        spikes = [*self._world.expose(frame.sequence, frame.exposures, places).values()]
        spikes = spikes[: len(channels if windows is None else windows)]
        self.useful += sum(not int(spike.flags) & USELESS for spike in spikes)
        return [spike for spike in spikes if windows is not None or spike.found]


class Run:
    """A tracker in a world, with what a link has between them; can be gone on with."""

    def __init__(self, world: SpikeWorld, tracker: Tracker) -> None:
        self._world, self._tracker = world, tracker
        self._sight = Sight(world)
        tracker._finder = self._sight  # type: ignore[assignment]
        self._frame = 0
        self._plan, self._since = tracker.sequence() or [{}], 0
        self._sent: list[tuple[int, list[dict[int, int]]]] = []
        self._shown: dict[int, Frame] = {}  # the newest, by their time
        self._elements = np.full(ELEMENTS, 3900, np.uint16)
        self.report = Report()

    def go(self, frames: int) -> Report:
        """Track for so many frames."""
        try:
            for _ in range(frames):
                self._step(self._frame)
                self._frame += 1
        finally:  # also when it is interrupted
            report = self.report
            report.seconds = self._frame * self._world.period_ns * 1e-9
            report.losses, report.useful = self._tracker.losses, self._sight.useful
        return report

    def _step(self, number: int) -> None:
        world, tracker, report = self._world, self._tracker, self.report
        while self._sent and self._sent[0][0] <= number:
            self._since, self._plan = self._sent.pop(0)
        now = world.time_ns(number)
        self._shown[now] = self._expose(number, now)
        if len(self._shown) > 8:
            del self._shown[next(iter(self._shown))]
        estimate = None
        for t_ns, _, _ in world.receive(number, {}):  # spikes are found when a frame is there
            step = tracker.step(self._shown[t_ns])
            report.lit += len(step.lit)
            estimate = step.estimate or estimate
            if (wanted := tracker.sequence()) is not None:
                self._sent.append((number + 1 + LATENCY, wanted))
        report.take(
            now * 1e-9,
            estimate,
            lambda: world.pose(number).tolist(),
            lambda: world.visible(number),
            lost=not tracker.locked,
        )

    def _expose(self, number: int, t_ns: int) -> Frame:
        lit = self._plan[(number - self._since) % len(self._plan)]
        return Frame(
            self._elements,
            sequence=number,
            leds=sum(1 << channel for channel in lit),
            exposures=lit,
            sh_period=SH_PERIOD,
            icg_period=ICG_PERIOD,
            timestamp=t_ns,
        )


def resident() -> int:
    """Bytes of memory that this process holds (Linux)."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE")


def hours(
    count: float, seed: int, *, faults: Faults | None = None, state: Path | None = None
) -> Generator[Report]:
    """Track a wandering tracker in a room of 40 LEDs; yield what was so far after each hour.

    It is the `Tracker` that users have, with `default_schedule`: search, windows, judging of
    spikes, motion, choice of LEDs and exposures, unlit frames, late and double frames. The camera is
    that of the head's drawing; LEDs stand `PLACED` off their plan, of which the tracker knows only
    what it takes for any map that nobody has calibrated.

    It moves as in a hand or on a vehicle: with seeds 1 to 4 up to 1.05 m/s, 1.5 to 3.0 m/s²
    (0.55 to 1.15 RMS), 1.6 rad/s and 1.8 to 3.3 rad/s² in an hour.

    Not exercised: images, so neither the spike finder nor lamps that are subtracted (`Sight` stands
    for them); firmware, its own search for spikes, and the capture with its repair of what was
    damaged (`tests.twin.endurance` has all these); a height that is not known, a heading that is;
    errors of the camera other than those of its fit. Light is that of the end of each exposure.

    With a file for the state, a run that was interrupted goes on after the last whole hour.
    """
    running = load(state) if state and state.exists() else begin(seed, faults)
    frames = round(count * FRAMES)
    grown = running.report.growth  # in the processes before this one
    size = 0
    while True:
        report = running.report
        left = frames - report.frames
        if size or left <= 0:
            yield report
            if left <= 0:
                return
        running.go(min(left, FRAMES - report.frames % FRAMES if size else WARM))
        gc.collect()
        size = size or resident()
        report.growth = max(grown, resident() - size)
        if state and not report.frames % FRAMES:
            keep(running, state)


def begin(seed: int, faults: Faults | None) -> Run:
    """Return a run of which nothing has happened yet."""
    table, camera = head()
    leds = room()
    random = np.random.default_rng([seed, 1])
    off = random.normal(0.0, PLACED, (len(leds), 2)).tolist()
    world = SpikeWorld(
        [
            replace(led, position=(led.position[0] + dx, led.position[1] + dy, 0.0))
            for led, (dx, dy) in zip(leds, off, strict=True)
        ],
        table,
        Wander(seed, (-4000.0, 4000.0, -4000.0, 4000.0), turning=1.5, fast=3.0),
        sh_period=SH_PERIOD,
        icg_period=ICG_PERIOD,
        faults=faults,
        seed=seed,
    )
    known = led_map(leds)
    tracker = Tracker(
        Calibration(camera, known), schedule=default_schedule(known, SH_PERIOD, ICG_PERIOD)
    )
    return Run(world, tracker)


class _Pickler(pickle.Pickler):
    """Pickles objects that keep the module of their compiled functions."""

    def reducer_override(self, obj: Any) -> Any:
        if isinstance(obj, ModuleType):
            return importlib.import_module, (obj.__name__,)
        return NotImplemented


def keep(running: Run, path: Path) -> None:
    """Write a run to a file, whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_suffix(".part")
    with part.open("wb") as file:
        _Pickler(file).dump(running)
    part.replace(path)


def load(path: Path) -> Run:
    """Return the run that `keep` has written: of one's own, a pickle can do anything."""
    with path.open("rb") as file:
        running: Run = pickle.load(file)  # noqa: S301
    return running


def run(count: float, seed: int, *, faults: Faults | None = None) -> Report:
    """As `hours`, to the end."""
    *_, report = hours(count, seed, faults=faults)
    return report


def main() -> int:
    """Run for some hours; fail where a criterion is not met."""
    parser = argparse.ArgumentParser(prog="python -m tests.tracking.endurance", description=__doc__)
    parser.add_argument("--hours", type=float, default=24.0, help="virtual; default: 24")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--state", type=Path, help="goes on from this file, kept hour by hour")
    arguments = parser.parse_args()
    reports = hours(arguments.hours, arguments.seed, state=arguments.state)
    return show("simulated spikes", reports)


def show(what: str, reports: Iterable[Report]) -> int:
    """Print how far a run is, and its end or where it was interrupted; return an exit code."""
    began = time.perf_counter()
    report, interrupted = Report(), False
    try:
        for report in reports:
            sys.stdout.write(f"… {report}\n")
            sys.stdout.flush()
    except KeyboardInterrupt:
        interrupted = True
    took = f"{(time.perf_counter() - began) / 60:.0f} min"
    end = "; INTERRUPTED" if interrupted else ""
    sys.stdout.write(f"{datetime.now():%Y-%m-%d}, {what}: {report}; {took}{end}\n")
    for failure in report.failures():
        sys.stdout.write(f"FAILED: {failure}\n")
    sys.stdout.flush()
    return INTERRUPTED if interrupted else bool(report.failures())


if __name__ == "__main__":
    sys.exit(main())
