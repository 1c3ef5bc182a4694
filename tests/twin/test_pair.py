"""Two sensors with the real firmware, one sync line: same exposures, six degrees of freedom."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from acquisition.capture import Capture
from acquisition.links import LinkError
from acquisition.protocol import Command, Mode
from raytransfer.designs import DESIGNS
from tracking.camera import Camera
from tracking.poses import PoseFlags
from tracking.space import (
    MountedCamera,
    SpaceFix,
    SpacePose,
    locate_in_space,
    spikes_of,
)
from tracking.spikes import SpikeFinder
from twin.machine import CLOCK, TICKS
from twin.pair import PERPENDICULAR, PULSE, SyncedLink, TwinPair
from twin.world import STRAIGHT, Led, Pose, World

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import NDArray

    from acquisition.frames import Frame

HEAD = DESIGNS["slit-4mm"].system
# no two LEDs share an x or a z, so that none hides another on either line
WALL = np.array([(100.0 * (k - 4), 200.0 * (k % 2), 100.0 * ((4 * k) % 9 - 4)) for k in range(9)])
LEDS = [Led(k, (x, y, z), power=0.1, extent=2.0) for k, (x, y, z) in enumerate(WALL.tolist())]
LATE = 0.0037
"""By so many s one host is later than the other; not a whole number of periods."""
SINGLY = [{k: 60} for k in range(9)]
TOGETHER = dict.fromkeys(range(9), 60)


@pytest.fixture(scope="module")
def heads() -> tuple[MountedCamera, ...]:
    camera = Camera.from_system(HEAD, distances=(1800.0, 2600.0), angles=15, rays=(96, 48))
    return tuple(MountedCamera(camera, m.roll, m.offset) for m in (STRAIGHT, PERPENDICULAR))


def singly(frames: Iterable[tuple[Frame, ...]]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Spikes and their σ of frames with one LED each."""
    finder = SpikeFinder(limit=1)
    pixels, sigma = np.full((2, 9), np.nan), np.full((2, 9), np.inf)
    for pair in frames:
        for sensor, frame in enumerate(pair):
            (led,) = frame.channels
            for spike in finder(frame):
                pixels[sensor, led], sigma[sensor, led] = spike.position, spike.sigma
    return pixels, sigma


def together(
    pair: tuple[Frame, ...], expected: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Spikes and their σ of frames with all LEDs, near where they are expected."""
    finder = SpikeFinder()
    pixels, sigma = np.full((2, 9), np.nan), np.full((2, 9), np.inf)
    for sensor, frame in enumerate(pair):
        leds = np.flatnonzero(np.abs(expected[sensor] - 1823.5) < 1780)
        places = np.rint(expected[sensor, leds]).astype(int)
        spikes = finder(frame, windows=[(int(p) - 30, int(p) + 30) for p in places])
        for led, spike in zip(leds, spikes, strict=True):
            pixels[sensor, led], sigma[sensor, led] = spike.position, spike.sigma
    return pixels, sigma


def off(fix: SpaceFix, pose: Pose) -> NDArray[np.float64]:
    return np.array(
        [
            getattr(fix.pose, n) - getattr(pose, n)
            for n in ("x", "y", "z", "heading", "pitch", "roll")
        ]
    )


def as_spoken(pose: Pose) -> SpacePose:
    return SpacePose(pose.x, pose.y, pose.z, pose.heading, pose.pitch, pose.roll)


def test_both_expose_at_the_same_time_and_see_from_their_own_mounts(
    heads: tuple[MountedCamera, ...],
) -> None:
    """To the cycle, though one board is behind; light is each head's own, the pose the tracker's."""
    pose = Pose(60.0, 2200.0, -0.02, -40.0, 0.015, 0.05)
    command = Command(1000, 16000, 9, Mode.STREAM, SINGLY)
    with TwinPair(World(LEDS, pose, head=HEAD)) as pair:
        pair.links[1].sleep(LATE)
        frames = list(pair.capture(command))
        ends = [link.machine.readouts["transfer"][-9:].tolist() for link in pair.links]
    assert len(frames) == 9
    for number, (one, other) in enumerate(frames):
        assert one.sequence == other.sequence == number
        assert one.timestamp == other.timestamp
        assert one.channels == other.channels == (number,)
        assert not np.array_equal(one.pixels, other.pixels)
    assert ends[0] == ends[1]  # cycles
    pixels, sigma = singly(frames)
    expected = spikes_of(heads, WALL, as_spoken(pose))
    seen = np.isfinite(pixels)
    assert seen.all()
    residuals = (pixels - expected)[seen]
    assert np.abs(residuals).max() < 0.1
    fix = locate_in_space(heads, WALL, pixels, sigma)
    error = off(fix, pose)
    assert not fix.flags & PoseFlags.AMBIGUOUS
    assert np.abs(error[:3]).max() < 0.4  # mm
    assert np.abs(error[3:]).max() < 2e-4  # rad


def exposed(link: SyncedLink, count: int) -> list[int]:
    """Ends of the last exposures that the firmware has sampled, cycles."""
    log = link.machine.readouts
    return [int(t) for t in log["transfer"][log["sampled"] != 0][-count:]]


def test_the_line_is_what_makes_them_begin_together() -> None:
    """Without it one board is as late as its host; with it, not by a cycle."""
    command = Command(1000, 16000, 3, Mode.STREAM, [{0: 60, 1: 40}] * 3)
    with TwinPair(World()) as pair:
        pair.links[1].sleep(LATE)
        for link in pair.links:
            assert len(list(Capture(link, command))) == 3
        one, other = (exposed(link, 3) for link in pair.links)
        assert [b - a for a, b in zip(one, other, strict=True)] == [round(LATE * CLOCK)] * 3
        frames = list(pair.capture(command))
        one, other = (exposed(link, 3) for link in pair.links)
    assert one == other
    assert len(frames) == 3
    assert all(a.timestamp == b.timestamp for a, b in frames)


def test_boards_that_miss_the_edge_or_light_other_leds_are_not_taken_for_a_pair(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    command = Command(1000, 16000, 3, Mode.STREAM, [{0: 60, 1: 40}] * 3)
    with TwinPair(World()) as pair:
        pulse_at = pair.links[1].pulse_at
        monkeypatch.setattr(
            pair.links[1], "pulse_at", lambda ticks: pulse_at(ticks + TICKS // 2000)
        )
        with pytest.raises(LinkError, match="edge of the sync line"):
            list(pair.capture(command))
    for other, named in ({0: 60, 2: 40}, "LED [12] was lit"), ({0: 60, 1: 44}, "LED 1 was lit"):
        with TwinPair(World()) as pair:

            def capture(link: SyncedLink, told: Command) -> Capture:
                sequence = [other] * 3 if link is pair.links[1] else told.sequence  # noqa: B023
                return Capture(link, replace(told, sequence=sequence))

            monkeypatch.setattr("twin.pair.Capture", capture)
            with pytest.raises(LinkError, match=named):
                list(pair.capture(command))


def test_hosts_of_different_speed_are_no_matter() -> None:
    """The link delays an interrupt now and then: light is alike, not equal, and that is let pass."""
    command = Command(1000, 16000, 12, Mode.STREAM, [{0: 60, 1: 40}] * 12)
    with TwinPair(World()) as pair:
        pair.links[1].host_latency = 2.1e-3
        frames = list(pair.capture(command))
        lit = [link.machine.readouts[-6:]["lit"][:, 1].tolist() for link in pair.links]
    assert 6 < len(frames) <= 12
    assert all(one.timestamp == other.timestamp for one, other in frames)
    assert lit[0] != lit[1]


def test_a_tracker_that_moves_and_turns_is_followed(heads: tuple[MountedCamera, ...]) -> None:
    """All LEDs in each frame: after nine with one each, to begin with, no pose is ever told."""

    def tracker(seconds: float) -> Pose:
        swing = math.sin(6 * seconds)
        return Pose(
            30 * swing, 2200 + 300 * seconds, 0.01 * swing, 20 - 100 * seconds, 0.02, 0.03 * swing
        )

    sequence = [*SINGLY, *[TOGETHER] * 12]
    command = Command(1000, 16000, len(sequence), Mode.STREAM, sequence)
    with TwinPair(World(LEDS, tracker, head=HEAD)) as pair:
        pair.links[1].sleep(LATE)
        frames = list(pair.capture(command))
        begun = pair.links[0].clock_offset
    assert len(frames) == len(sequence)
    near = locate_in_space(heads, WALL, *singly(frames[:9])).pose
    errors = []
    for one, other in frames[9:]:
        assert one.timestamp == other.timestamp
        fix = locate_in_space(
            heads, WALL, *together((one, other), spikes_of(heads, WALL, near)), start=near
        )
        near = fix.pose
        assert one.timestamp is not None
        errors.append(off(fix, tracker(begun + one.timestamp * 1e-9)))
    errors_rms = np.sqrt(np.mean(np.square(errors), axis=0))
    assert (errors_rms[:3] < 0.4).all()  # mm
    assert (errors_rms[3:] < 2e-4).all()  # rad


def test_an_edge_comes_when_it_was_said_to_whatever_the_host_does() -> None:
    """During a transfer, a wait and a sleep; told by the pulls of the driver itself."""
    driven: list[tuple[int, bool | None]] = []
    with SyncedLink() as link:
        drive = link.machine.drive

        def watched(pin: str, level: bool | None) -> None:
            assert pin == "PB1"
            driven.append((link.ticks, level))
            drive(pin, level)

        link.machine.drive = watched  # type: ignore[method-assign]
        pulse, begun = round(PULSE * TICKS), link.ticks
        for step, pass_time in (
            (TICKS // 1000, lambda: link.transfer(bytes(7388))),
            (TICKS // 1000, lambda: link.wait_ready(0.01)),
            (TICKS // 1000, lambda: link.sleep(0.01)),
        ):
            driven.clear()
            at = link.ticks + step
            link.pulse_at(at)
            pass_time()
            assert driven == [(at, True), (at + pulse, False)]
        with pytest.raises(ValueError, match="already"):
            link.pulse_at(begun)


def test_a_delay_out_of_range_is_refused() -> None:
    with TwinPair(World()) as pair, pytest.raises(ValueError, match="in ms"):
        next(pair.capture(Command(1000, 16000, 1, Mode.STREAM), delay=50))
