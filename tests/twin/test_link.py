"""What a link to the twin tells beside frames: its device's clock, and where LEDs should be."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from acquisition.capture import Capture, capture
from acquisition.frames import MASTER_CLOCK
from acquisition.links import LinkError
from acquisition.protocol import Command, Mode
from tracking.leds import LedMap
from twin.link import TwinLink, open_twin
from twin.machine import CLOCK
from twin.rooms import load_room
from twin.world import Led, Pose, World

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator

    from numpy.typing import NDArray

CYCLES = CLOCK // MASTER_CLOCK
STREAM = Command(200, 14800, 5, Mode.STREAM, [{0: 80}, {2: 200, 5: 100}, {}])
SPIKES = Command(100, 15000, 4, Mode.SPIKES, [{0: 80}])


def test_timestamps_are_the_worlds_times_to_the_cycle() -> None:
    """Whenever it is asked for, in all modes, though each change of the periods moves it."""
    with TwinLink() as link:
        seen = []
        for command in (STREAM, Command(100, 30000, 2), SPIKES, STREAM):
            frames = list(capture(link, command))
            lit = {int(r["transfer"]): r["lit"][1:] for r in link.machine.readouts if r["sampled"]}
            for wait in (0.0, 1e-5, 0.0017, 0.0123):
                link.sleep(wait)
                offset = link.clock_offset
                assert 0.4e-3 < offset < 1e-3  # it boots
                for frame in frames:
                    if frame.timestamp is None:  # original mode tells no times
                        continue
                    end = round(offset * CLOCK) + frame.timestamp * CYCLES // 250
                    assert np.flatnonzero(lit[end]).tolist() == sorted(frame.exposures)
            seen.append(offset)
        steps = np.diff(seen) * CLOCK
        # halt, flush and first exposure each set the timers' periods anew
        assert ((steps >= 0) & (steps <= 3 * CYCLES + 1e-6)).all(), steps


def test_the_clock_offset_holds_in_the_middle_of_a_capture() -> None:
    """Also right after an exposure, when the interrupt that counts is not over yet."""
    with TwinLink() as link, Capture(link, Command(200, 14800, 0, Mode.STREAM)) as frames:
        offsets = set()
        for _, _frame in zip(range(5), frames, strict=False):
            for _ in range(40):
                link.machine.run(1e-4 / 7)
                offsets.add(link.clock_offset)
        assert len(offsets) == 1


def test_after_a_reset_the_clock_begins_anew() -> None:
    with TwinLink() as link:
        list(capture(link, STREAM))
        before = link.clock_offset
        at = link.machine.seconds
        link.machine.reset()
        link.sleep(0.02)
        assert link.clock_offset - at == pytest.approx(before, abs=2e-6)


def test_while_the_device_waits_its_clock_is_not_told() -> None:
    with TwinLink() as link:
        link.transfer(replace(STREAM, await_sync=True).encode())
        link.sleep(0.1)
        with pytest.raises(LinkError, match="sync line"):
            _ = link.clock_offset


def test_what_is_told_of_the_leds() -> None:
    """A room's plan, not where the LEDs are; without one, where the world has them."""
    room = load_room("walk")
    with open_twin("walk") as link:
        assert LedMap(*link.known_leds) == LedMap(*room.known_leds())
        assert link.world.leds != tuple(room.nominal)
    leds = [Led(3, (-100, 20, 5), facing=0.1), Led(9, (300, 0, 0))]
    with TwinLink(World(leds=leds)) as link:
        told = LedMap(*link.known_leds)
    assert told == LedMap([3, 9], [[-100, 20, 5], [300, 0, 0]], [0.1, 0.0])
    with open_twin() as link:
        assert LedMap(*link.known_leds) == LedMap.line(2, 500.0)


def test_light_of_a_moving_tracker_is_computed_for_leds_that_are_lit_and_no_others() -> None:
    """And frames are the same, to the last count, as if all of it were."""
    asked: list[int] = []

    class Watched(World):
        lavish = False

        def lit(
            self, seconds: float = 0.0, channels: Collection[int] | None = None
        ) -> Iterator[tuple[int, NDArray[np.float64]]]:
            if seconds and channels is not None:  # at 0 all are asked for
                asked.extend(channels)
            return super().lit(seconds, None if self.lavish else channels)

    class Lavish(Watched):
        lavish = True

    def swaying(seconds: float) -> Pose:
        return Pose(100 * math.sin(9 * seconds), 1700.0, 0.05 * math.cos(7 * seconds))

    leds = [Led(channel, (50.0 * channel - 150, 0.0, 0.0)) for channel in (0, 2, 5, 7)]
    captured = []
    for kind in (Watched, Lavish):
        with TwinLink(kind(leds, swaying), seed=2) as link:
            captured.append(list(capture(link, replace(STREAM, count=9))))
        assert set(asked) == {0, 2, 5}
    for frame, same in zip(*captured, strict=True):
        np.testing.assert_array_equal(frame.pixels, same.pixels)
        depth = frame.dark_level - frame.pixels.min()
        assert depth > 200 if frame.exposures else depth < 50
