"""Minutes of tracking through the real firmware, with all that goes wrong in a room and on a link.

``python -m tests.twin.endurance --minutes 10 --seed 1``; `run` is the same for tests.
"""

from __future__ import annotations

import argparse
import gc
import math
import sys
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from acquisition.capture import Capture
from raytransfer.designs import DESIGNS
from tests.tracking.endurance import INTERRUPTED, Report, resident, show
from tests.twin.faults import DEVICE_FAULTS, LINK_FAULTS, FaultyLink
from tracking.calibration import Calibration
from tracking.leds import LedMap
from tracking.motion import Outcome
from tracking.tracker import Tracker, default_schedule, first_command, follow
from twin.rooms import Swing, Tour
from twin.spikes import Wander
from twin.world import Led, RandomOcclusions, Wall, World

if TYPE_CHECKING:
    from collections.abc import Collection, Generator

    from tracking.tracker import Step
    from twin.link import TwinLink

HEAD = DESIGNS["slit-4mm"]
LEDS = LedMap.line(11, 300.0, 300.0)
PLACED = 0.3  # mm; how far LEDs stand off the plan
AREA = (-500.0, 500.0, 1700.0, 4000.0)  # mm
ICG_PERIODS = {False: 16_000, True: 14_800}
"""Of pixels, which take the link as long, and of spikes: 250 and 270 frames a second."""

DARK_EVERY, DARK = 8.0, (0.1, 0.9)  # s; someone stands before everything, and for how long
LINK_FAULT_EVERY, DEVICE_FAULT_EVERY = 1.0, 15.0  # s, on average
WARM = 20.0  # s
LIGHT_EVERY = 0.25  # s of the walk for which light is computed beforehand: its tables are then full


class Room:
    """LEDs on a wall, a shiny wall beside them, people between, a tracker that wanders about."""

    def __init__(self, seed: int) -> None:
        random = np.random.default_rng(seed)
        off = random.normal(0.0, PLACED, (len(LEDS), 2))
        places = LEDS.positions[:, :2] + off
        wander = Wander(seed, AREA)
        self._people = RandomOcclusions(0.05, 0.4, seed)
        self._seed = seed
        self.calibration = Calibration.nominal(HEAD, LEDS)
        self.world = World(
            [
                Led(n, (x, y, 0.0), power=0.1)
                for n, (x, y) in zip(LEDS.channels, places.tolist(), strict=True)
            ],
            Tour(lambda t: (*wander(t)[:2], 0.0), heading=Swing(0.0, 0.2, 0.11)),
            ambient=100.0,
            head=HEAD.system,
            walls=[Wall((1700.0, 0.0), (1700.0, 5000.0), 0.4)],
            occlusions=self.hidden,
        )

    def hidden(self, seconds: float) -> Collection[int]:
        """Channels that someone stands before."""
        begin, end = _darkness(self._seed, math.floor(seconds / DARK_EVERY))
        return LEDS.channels if begin <= seconds < end else self._people(seconds)

    def visible(self, seconds: float) -> int:
        """How many LEDs can be seen."""
        pose, hidden = self.world.pose(seconds), self.hidden(seconds)
        places = [
            self.world.seen_from(led, pose) for led in self.world.leds if led.channel not in hidden
        ]
        if not places:
            return 0
        pixels = self.calibration.camera.project(np.array(places))
        return int(np.sum((pixels >= 0) & (pixels < self.world.sensor.pixels)))


@lru_cache(maxsize=4)
def _darkness(seed: int, slot: int) -> tuple[float, float]:
    random = np.random.default_rng([seed, slot + (1 << 62)])
    begin = slot * DARK_EVERY + random.uniform(0.0, DARK_EVERY - DARK[1])
    return begin, begin + random.uniform(*DARK)


class Clock:
    """World time of device times; a device that was reset counts anew."""

    SETTLED = 8
    """Frames: at an exposure's end the device may not have counted it yet, at the next it has."""

    def __init__(self, link: TwinLink) -> None:
        self._link = link
        self._newest, self._frames, self._zero = -1, 0, math.inf

    def __call__(self, t_ns: int) -> float:
        """s, of a frame that has just come."""
        if t_ns < self._newest:
            self._frames, self._zero = 0, math.inf
        if self._frames < self.SETTLED:
            self._zero = min(self._zero, self._link.clock_offset)
        self._newest = t_ns
        self._frames += 1
        return self._zero + t_ns * 1e-9


def minutes(count: float, seed: int, *, spikes: bool) -> Generator[Report]:
    """Track through the firmware image: whole frames, or spikes that it finds itself.

    Yield what was so far after each minute, and in the end.
    """
    room, report = Room(seed), Report()
    random = np.random.default_rng([seed, 1])
    icg_period = ICG_PERIODS[spikes]
    period = icg_period / 4e6
    size, locked, told = 0, False, 0
    for seconds in np.arange(0.0, 60 * count, LIGHT_EVERY).tolist():
        for _ in room.world.lit(seconds):
            pass
    with FaultyLink(seed, world=room.world) as link:
        clock = Clock(link)
        tracker = Tracker(room.calibration, schedule=default_schedule(LEDS, icg_period=icg_period))
        command = first_command(tracker, spikes=spikes)
        with Capture(link, command, retries=8) as capture:
            for step in follow(capture, tracker):
                _judge(report, step, clock(step.t_ns), room, lost=not tracker.locked)
                report.losses += locked and not tracker.locked
                locked = tracker.locked
                report.seconds = link.machine.seconds
                if not size and report.seconds > min(WARM, 30 * count):
                    gc.collect()
                    size = resident()
                if report.seconds > 60 * count:
                    break
                if report.seconds > 60 * (told + 1):
                    told += 1
                    report.growth = resident() - size
                    yield report
                if link.fault is None:
                    chance = random.random() / period
                    if chance < 1 / DEVICE_FAULT_EVERY:
                        link.strike(str(random.choice(DEVICE_FAULTS)))
                    elif chance < 1 / DEVICE_FAULT_EVERY + 1 / LINK_FAULT_EVERY:
                        link.strike(str(random.choice(LINK_FAULTS)))
            gc.collect()
            report.growth = resident() - size
    yield report


def run(count: float, seed: int, *, spikes: bool) -> Report:
    """As `minutes`, to the end."""
    *_, report = minutes(count, seed, spikes=spikes)
    return report


def _judge(report: Report, step: Step, seconds: float, room: Room, *, lost: bool) -> None:
    def pose() -> tuple[float, float, float]:
        true = room.world.pose(seconds)
        return true.x, true.y, true.heading

    report.take(seconds, step.estimate, pose, lambda: room.visible(seconds), lost=lost)
    report.lit += len(step.lit)
    report.useful += sum(found.outcome is Outcome.USED for found in step.innovations)


def main() -> int:
    """Run for some minutes; fail where a criterion is not met."""
    parser = argparse.ArgumentParser(prog="python -m tests.twin.endurance", description=__doc__)
    parser.add_argument("--minutes", type=float, default=10.0, help="virtual; default: 10")
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    code = 0
    for spikes in (False, True):
        kind = "spikes from the microcontroller" if spikes else "whole frames"
        reports = minutes(arguments.minutes / 2, arguments.seed, spikes=spikes)
        code = max(code, show(f"through the firmware, {kind}", reports))
        if code == INTERRUPTED:
            break
    return code


if __name__ == "__main__":
    sys.exit(main())
