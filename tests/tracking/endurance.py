"""Hours of tracking on simulated spikes, with all that goes wrong in a room and on a link.

``python -m tests.tracking.endurance --hours 24 --seed 1``; `run` is the same for tests.
"""

from __future__ import annotations

import argparse
import gc
import math
import os
import sys
import time
from collections import deque
from dataclasses import dataclass, field, replace
from datetime import datetime
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from raytransfer.designs import DESIGNS
from raytransfer.heads import Scene
from tracking.camera import Camera
from tracking.leds import LedMap
from tracking.motion import MotionFilter
from tracking.poses import PoseFlags
from tracking.scheduling import Greedy
from tracking.spikes import SpikeFlags
from twin.spikes import Faults, SpikeTable, SpikeWorld, Wander
from twin.world import Led

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from tracking.poses import Estimate
    from tracking.scheduling import Schedule

SH_PERIOD, ICG_PERIOD = 400, 14_800
"""100 µs of light, 270 frames a second."""

DESIGN = "slit-4mm"
AHEAD = 4
"""Frames that are planned at a time."""

FLAGGED = int(
    PoseFlags.LOST
    | PoseFlags.PREDICTED
    | PoseFlags.RELOCALISED
    | PoseFlags.INCONSISTENT
    | PoseFlags.UNCHECKED
)
USELESS = int(SpikeFlags.MISSING | SpikeFlags.SATURATED)
"""Who sees one of these is warned. A pose that only says that a spike was refused is not excused."""

EVERY = 199
"""Poses of which one is kept for the errors' statistics."""

NEEDED = 3  # LEDs, for a pose
RECOVERY = 0.5  # s
WRONG = 1e-4  # part of all poses
GROWTH = 20_000_000  # bytes: 20 a frame would be more in an hour


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
    """Exact spikes of the head, and the camera that stands for it in the filter."""
    system = DESIGNS[DESIGN].system
    background = replace(Scene(), integration_time=SH_PERIOD / 4e6).background(system)
    return SpikeTable(system, background=background), Camera.from_system(system)


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
        recoveries = np.array(self.recoveries or [0.0])
        errors = np.array(self.errors or [0.0])
        return (
            f"{self.seconds / 3600:.2f} h, {self.frames} frames, at {self.possible / self.frames:.2%} "
            f"of them three LEDs in view, at {self.locked / self.frames:.2%} an unflagged pose; "
            f"{self.wrong} of these off by more than 5 σ "
            f"({self.wrong / max(self.locked, 1):.1e}); {self.losses} losses of lock, "
            f"{len(recoveries)} recoveries in {np.median(recoveries):.3f} s (median), "
            f"{recoveries.max():.3f} s (worst); {self.useful / self.seconds:.0f} useful exposures/s "
            f"of {self.lit / self.seconds:.0f}; errors {np.median(errors):.2f} mm (median), "
            f"{np.sqrt(np.mean(errors**2)):.2f} mm (RMS); memory {self.growth / 1e6:+.1f} MB"
        )


def follow(
    world: SpikeWorld,
    motion: MotionFilter,
    schedule: Schedule,
    frames: int,
    first: int = 0,
    report: Report | None = None,
) -> Report:
    """Track for so many frames."""
    report = Report() if report is None else report
    planned: deque[dict[int, int]] = deque({} for _ in range(schedule.latency))
    newest = world.time_ns(first) - world.period_ns
    for frame in range(first, first + frames):
        if len(planned) <= schedule.latency:
            planned.extend(schedule.sequence(motion, newest, AHEAD))
        lit = planned.popleft()
        now = world.time_ns(frame)
        windows = None
        if len(lit) > 1 and not motion.lost:
            expected = motion.expected(now)
            windows = {channel: expected.window(channel) for channel in lit}
        estimate = None
        for t_ns, shone, spikes in world.receive(frame, lit, windows):
            estimate = motion.observe(t_ns, spikes)
            schedule.observe(t_ns, shone, spikes)
            report.lit += len(shone)
            report.useful += sum(not int(spike.flags) & USELESS for spike in spikes.values())
        newest = now
        if estimate is None or estimate.t_ns != now:
            estimate = motion.estimate(now)
        report.take(
            now * 1e-9,
            estimate,
            lambda: world.pose(frame).tolist(),  # noqa: B023  # used before the next frame
            lambda: world.visible(frame),  # noqa: B023
            lost=motion.lost,
        )
    report.seconds += frames * world.period_ns * 1e-9
    report.losses = motion.losses
    return report


def resident() -> int:
    """Bytes of memory that this process holds (Linux)."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE")


def run(hours: float, seed: int, *, faults: Faults | None = None) -> Report:
    """Track a wandering tracker in a room of 40 LEDs; three of them may be lit in a frame.

    It moves as in a hand or on a vehicle: with seeds 1 to 4 up to 1.05 m/s, 1.5 to 3.0 m/s²
    (0.55 to 1.15 RMS), 1.6 rad/s and 1.8 to 3.3 rad/s² in an hour.
    """
    table, camera = head()
    leds = room()
    known = led_map(leds)
    path = Wander(seed, (-4000.0, 4000.0, -4000.0, 4000.0), turning=1.5, fast=3.0)
    world = SpikeWorld(
        leds,
        table,
        path,
        sh_period=SH_PERIOD,
        icg_period=ICG_PERIOD,
        faults=faults,
        seed=seed,
    )
    motion = MotionFilter(camera, known)
    schedule = Greedy(known, SH_PERIOD, ICG_PERIOD, per_frame=3)
    frames = round(hours * 3600 * 4e6 / ICG_PERIOD)
    warm = min(frames, 20_000)
    report = follow(world, motion, schedule, warm)
    gc.collect()
    size = resident()
    report = follow(world, motion, schedule, frames - warm, warm, report)
    gc.collect()
    report.growth = resident() - size
    return report


def main() -> int:
    """Run for some hours; fail where a criterion is not met."""
    parser = argparse.ArgumentParser(prog="python -m tests.tracking.endurance", description=__doc__)
    parser.add_argument("--hours", type=float, default=24.0, help="virtual; default: 24")
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    began = time.perf_counter()
    report = run(arguments.hours, arguments.seed)
    took = f"{(time.perf_counter() - began) / 60:.0f} min"
    sys.stdout.write(f"{datetime.now():%Y-%m-%d}, simulated spikes: {report}; {took}\n")
    for failure in report.failures():
        sys.stdout.write(f"FAILED: {failure}\n")
    return bool(report.failures())


if __name__ == "__main__":
    sys.exit(main())
