"""Capture against a fake device, over good wires and bad ones."""

from __future__ import annotations

import itertools
import tracemalloc
from contextlib import suppress
from typing import TYPE_CHECKING

import numpy as np
import pytest

from acquisition.capture import Capture, CaptureStatistics, Refused, capture
from acquisition.frames import FrameFlags
from acquisition.links import LinkError, LinkTimeout, ReplayLink
from acquisition.protocol import (
    ORIGINAL_SIZE,
    STREAM_SIZE,
    Command,
    DecodeError,
    Mode,
    Refusal,
    Status,
    crc32_words,
    encode_status,
)
from tests.acquisition.fake_mcu import BREAKS, FakeMcu, FaultyWire, elements_at

if TYPE_CHECKING:
    from collections.abc import Iterable

    from acquisition.frames import Frame

LEDS = [{0: 100}, {1: 60}, {}, {0: 100, 1: 30}]


def original(count: int = 2) -> Command:
    return Command(100, 30000, count)


def stream(count: int = 0) -> Command:
    return Command(100, 20000, count, Mode.STREAM, LEDS)


def check(frames: Iterable[Frame]) -> None:
    """Every frame is one that the device has taken."""
    for frame in frames:
        assert frame.timestamp is not None
        np.testing.assert_array_equal(frame.elements, elements_at(frame.timestamp // 1000))


@pytest.mark.parametrize("count", [1, 2, 3, 7])
@pytest.mark.parametrize("extra", [0, 1])
def test_original_mode(count: int, extra: int) -> None:
    link = FakeMcu(extra=extra)
    firmware = "original" if extra else "linetrack"
    frames = list(capture(link, original(count), firmware=firmware))
    assert [frame.leds for frame in frames] == [0] * (count - 2) + [1, 2][-count:]
    assert [frame.sequence for frame in frames] == list(range(count))
    assert [dict(frame.exposures) for frame in frames[-2:]] == [{0: 100}, {1: 100}][-count:]
    for n, frame in enumerate(frames):
        np.testing.assert_array_equal(frame.elements, elements_at(n))
        assert (frame.sh_period, frame.icg_period) == (100, 30000)
        assert frame.timestamp is None
        assert frame.flags == FrameFlags.NONE
        assert frame.utc_ns > 0
        assert frame.monotonic_ns > 0
    assert not link.wait_ready(1)
    assert not link.closed


def test_stream() -> None:
    link = FakeMcu()
    with Capture(link, stream(50)) as frames:
        found = list(frames)
        assert frames.status is not None
        assert frames.status.firmware == "fake 1.0"
        assert frames.statistics == CaptureStatistics(good=50)
    check(found)
    assert [frame.sequence for frame in found] == list(range(50))
    assert found[0].flags == FrameFlags.CHANGED
    assert not any(frame.flags for frame in found[1:])
    for frame, lit in zip(found, itertools.cycle(LEDS), strict=False):
        assert frame.exposures == lit
        assert frame.leds == sum(1 << n for n in lit)


def test_endless_stream_is_stopped_dark_and_another_follows() -> None:
    link = FakeMcu()
    for _ in range(3):
        frames = list(itertools.islice(capture(link, stream()), 20))
        check(frames)
        assert [frame.sequence for frame in frames] == list(range(20))
        assert link.commands[-1].count == 1
        assert link.commands[-1].sequence == ({},)
    link.sleep(0.1)
    assert link.left == 0
    frames = list(capture(link, original()))
    assert [frame.leds for frame in frames] == [1, 2]
    check(capture(link, stream(3)))


def test_running_stream_of_somebody_else_is_taken_over() -> None:
    link = FakeMcu()
    foreign = Command(100, 20000, 0, Mode.STREAM, [{5: 70}])
    first = Capture(link, foreign)
    for _ in range(5):
        next(first)
    frames = Capture(link, stream(10))  # the first one was never closed
    found = list(frames)
    assert [frame.sequence for frame in found] == list(range(10))
    assert [dict(frame.exposures) for frame in found[:4]] == LEDS
    assert frames.statistics.stale > 0
    assert frames.statistics.restarts == 0


def test_late_host_loses_frames_and_is_told() -> None:
    link = FakeMcu()
    frames = Capture(link, stream())
    first = next(frames)
    link.sleep(5.5 * 20000 / 4e6)
    found = [first, *itertools.islice(frames, 10)]
    check(found)
    numbers = [frame.sequence for frame in found]
    assert numbers[-1] == frames.statistics.dropped + 10
    assert frames.statistics.dropped >= 4
    late = next(n for n, (a, b) in enumerate(itertools.pairwise(numbers), 1) if b > a + 1)
    assert found[late].flags & FrameFlags.DROPPED
    for frame in found:
        assert frame.exposures == LEDS[frame.sequence % 4]


def test_sequence_changed_on_the_way() -> None:
    link = FakeMcu()
    frames = Capture(link, stream())
    before = [next(frames) for _ in range(7)]
    frames.send([{3: 50}])
    frames.send([{4: 50}, {4: 20}])
    after = [next(frames) for _ in range(10)]
    check(before + after)
    assert [f.sequence for f in before + after] == list(range(17))
    (at,) = [n for n, frame in enumerate(after) if frame.flags & FrameFlags.CHANGED]
    assert at <= 3
    assert [dict(f.exposures) for f in after[at : at + 4]] == [{4: 50}, {4: 20}] * 2
    assert all(dict(f.exposures) == LEDS[f.sequence % 4] for f in after[:at])
    frames.send(Command(200, 30000, 0, Mode.STREAM, [{0: 200}]))
    changed = [next(frames) for _ in range(8)]
    assert changed[-1].sh_period == 200
    assert changed[-1].exposures == {0: 200}
    assert frames.command.icg_period == 30000
    assert frames.statistics.restarts == 0
    frames.close()


def test_change_keeps_the_number_of_frames() -> None:
    frames = Capture(FakeMcu(), stream(20))
    found = [next(frames) for _ in range(5)]
    frames.send([{2: 90}])
    found += frames
    assert [frame.sequence for frame in found] == list(range(20))


def test_lost_change_is_sent_again() -> None:
    link = FakeMcu()
    frames = Capture(link, stream())
    next(frames)
    frames.send([{2: 90}])
    plain, link.exchange = link.exchange, lambda tx: plain(bytes(len(tx)))  # type: ignore[method-assign]
    for _ in range(3):
        next(frames)
    link.exchange = plain  # type: ignore[method-assign]
    found = list(itertools.islice(frames, 20))
    check(found)
    assert found[-1].leds == 4
    assert frames.statistics.restarts == 1


def test_change_that_never_arrives_is_an_error() -> None:
    link = FakeMcu()
    frames = Capture(link, stream())
    next(frames)
    frames.send([{2: 90}])
    plain = link.exchange
    link.exchange = lambda tx: plain(bytes(len(tx)))  # type: ignore[method-assign]
    with pytest.raises(Refused, match="as if nothing had been sent"):
        list(itertools.islice(frames, 200))


def test_change_before_the_first_frame() -> None:
    frames = Capture(FakeMcu(), stream(6))
    frames.send([{5: 40}])
    assert [dict(frame.exposures) for frame in frames] == [{5: 40}] * 6
    frames = Capture(FakeMcu(), stream())
    next(frames)
    frames.send(Command(50, 30000, 0, Mode.STREAM, [{5: 40}]))
    while frames.command.sh_period != 50:
        next(frames)
    frames.send([{5: 45}])
    found = [next(frames) for _ in range(8)]
    assert [f.exposures[5] for f in found] == sorted(f.exposures[5] for f in found)
    assert found[-1].exposures == {5: 45}
    frames.close()


def test_late_host_at_a_change_does_not_mix_exposures_up() -> None:
    link = FakeMcu()
    frames = Capture(link, Command(100, 20000, 0, Mode.STREAM, [{0: 10}, {0: 20}]))
    found = [next(frames) for _ in range(3)]
    for n in range(30):
        frames.send([{0: 30 + n}, {0: 70 + n}])
        link.sleep(5e-3 * (n % 4))
        found += [next(frames) for _ in range(3)]
        link.sleep(5e-3 * (n % 3))
        found += [next(frames) for _ in range(3)]
    for frame in found:
        assert frame.timestamp is not None
        assert frame.exposures in ({}, link.lit[frame.timestamp // 1000])
    assert sum(bool(frame.exposures) for frame in found) > 60
    assert frames.statistics.dropped > 10


@pytest.mark.parametrize("seed", range(8))
def test_no_exposure_is_made_up(seed: int) -> None:
    """One LED, only its exposure changes: each frame's is the true one, or unknown."""
    link = FaultyWire(seed, 0.15, ["flip", "truncate", "deaf", "flip tx"])
    frames = Capture(link, Command(100, 20000, 0, Mode.STREAM, [{0: 10}]), retries=20)
    known = 0
    for n in range(120):
        if n % 6 == 5:
            frames.send([{0: n + 10}] if n < 90 else [{0: 100}])
        frame = next(frames)
        assert frame.timestamp is not None
        if frame.exposures:
            known += 1
            assert frame.exposures == link.lit[frame.timestamp // 1000]
    assert known > 60


def test_change_is_for_streams_alone() -> None:
    with pytest.raises(ValueError, match="use stream mode"):
        Capture(FakeMcu(), original()).send([{0: 10}])
    with pytest.raises(ValueError, match="new capture"):
        Capture(FakeMcu(), stream()).send(original())


class Deaf(FakeMcu):
    """A device that answers with whatever its test wants."""

    answer = b""

    def wait_ready(self, timeout: float) -> bool:
        self.sleep(timeout)
        return bool(self.answer)

    def transfer(self, tx: bytes) -> bytes:
        return self.answer or bytes(len(tx))


@pytest.mark.parametrize("mode", [Mode.ORIGINAL, Mode.STREAM])
@pytest.mark.parametrize("retries", [0, 2])
def test_silence(mode: Mode, retries: int) -> None:
    frames = Capture(Deaf(), Command(100, 30000, 2, mode), retries=retries)
    with pytest.raises(LinkTimeout, match=r"no frame within.*powered.*PB2"):
        next(frames)
    assert frames.statistics.restarts == retries
    assert frames.statistics.timeouts == retries + 1


@pytest.mark.parametrize("level", [False, True])
def test_stuck_handshake(level: bool) -> None:
    for command in (original(5), stream(5)):
        link = FakeMcu()
        link.level = level
        try:
            found = list(capture(link, command, retries=2))
        except LinkTimeout:
            continue
        assert level
        if command.mode is Mode.ORIGINAL:
            assert all(frame.flags & FrameFlags.INVALID for frame in found[1:])
        else:
            check(found)


def test_handshake_stuck_in_mid_stream() -> None:
    for level in (False, True):
        link = FakeMcu()
        frames = Capture(link, stream())
        check([next(frames) for _ in range(5)])
        link.level = level
        with suppress(LinkTimeout):
            check(itertools.islice(frames, 20))
        link.level = None
        check(capture(link, stream(5)))


def test_garbage_on_the_wire() -> None:
    link = Deaf()
    link.answer = bytes(range(256)) * 29
    seen: list[DecodeError] = []
    frames = Capture(link, stream(3), on_corrupt=seen.append)
    with pytest.raises(LinkTimeout, match="damaged transfers"):
        next(frames)
    assert len(seen) == frames.statistics.corrupt


def test_refusals() -> None:
    link = Deaf()
    link.answer = encode_status(Status(Refusal.VERSION, "newer", 100, 30000))
    with pytest.raises(Refused, match=r"version.*-s 100 -i 30000.*newer") as caught:
        list(capture(link, stream(3)))
    assert caught.value.reason is Refusal.VERSION
    link.answer = encode_status(Status(Refusal.CHECKSUM, "", 100, 30000))
    with pytest.raises(Refused) as caught:
        list(capture(link, stream(3)))
    assert caught.value.reason is Refusal.CHECKSUM


def test_unknown_firmware_is_not_a_broken_wire() -> None:
    link = Deaf()
    data = bytearray(encode_status(Status(Refusal.NONE, "", 100, 30000)))
    data[2] = 2
    data[-4:] = crc32_words(bytes(data[:-4])).to_bytes(4, "little")
    link.answer = bytes(data)
    with pytest.raises(LinkError, match="same release"):
        list(capture(link, stream(3)))


def test_options_are_checked() -> None:
    for options in ({"timeout": 0}, {"retries": -1}, {"firmware": "mine"}):
        with pytest.raises(ValueError, match="allowed"):
            capture(FakeMcu(), original(), **options)
    with pytest.raises(ValueError, match="no stream mode"):
        capture(FakeMcu(), stream(), firmware="original")


def test_reset_in_mid_frame_and_mid_stream() -> None:
    for at in (0, 7, 3000, 7000):
        link = FakeMcu()
        frames = Capture(link, stream(40))
        found = [next(frames) for _ in range(7)]
        link.sleep(4e-3)
        link.exchange(bytes(at))
        link.reset()
        found += frames
        check(found)
        assert [f.sequence for f in found[:7]] == list(range(7))
        numbers = [f.sequence for f in found]
        assert numbers == sorted(set(numbers))
        assert numbers[-1] == 39
        assert found[7].flags & FrameFlags.LOST
        assert frames.statistics.restarts == 1
    link = FakeMcu()
    frames = Capture(link, original(6))
    found = [next(frames) for _ in range(3)]
    link.reset()
    found += frames
    assert [f.leds for f in found] == [0, 0, 0, 0, 1, 2]
    assert found[3].flags & FrameFlags.LOST


@pytest.mark.parametrize("fault", sorted(BREAKS))
def test_one_fault_costs_two_frames_at_most(fault: str) -> None:
    for at in range(12):
        link = FaultyWire(at, 1.0, [fault])
        link.quiet = True
        frames = Capture(link, stream())
        found = [next(frames) for _ in range(4)]
        link.quiet = False
        link.once = True
        found += [next(frames) for _ in range(6)]
        check(found)
        lost = found[-1].sequence + 1 - len(found)
        assert lost <= 2
        assert link.injected == [fault]
        assert frames.statistics.corrupt <= 2
        assert frames.statistics.restarts == 0


@pytest.mark.parametrize("seed", range(12))
def test_stream_over_a_bad_wire(seed: int) -> None:
    faults = [*BREAKS, "flip tx", "bounce", "deaf", "reset"]
    link = FaultyWire(seed, 0.08, faults)
    frames = Capture(link, stream(), retries=20)
    found = []
    for n in range(150):
        if n % 25 == 0:
            frames.send([{n // 25 + 2: 10}, {0: 99}])
        found.append(next(frames))
    check(found)
    assert len(link.injected) > 5
    numbers = [frame.sequence for frame in found]
    assert numbers == sorted(set(numbers))
    for frame in found:
        if frame.exposures:
            assert sum(1 << n for n in frame.exposures) == frame.leds
    link.quiet = True
    while frames.command.sequence != ({7: 10}, {0: 99}):
        check([next(frames)])
    frames.close()


@pytest.mark.parametrize("seed", range(12))
def test_original_mode_over_a_bad_wire(seed: int) -> None:
    link = FaultyWire(seed, 0.1, [*BREAKS, "flip tx", "deaf", "reset"])
    for _ in range(15):
        frames = list(capture(link, original(4), retries=20))
        assert len(frames) == 4
        for frame in frames:
            assert bool(frame.flags & FrameFlags.INVALID) == bool(frame.invalid())
    assert link.injected
    link.quiet = True
    link.sleep(0.2)
    frames = list(capture(link, original(3)))
    assert not any(frame.flags for frame in frames)


def test_interrupted_transfer_is_no_lasting_harm() -> None:
    for at in (0, 1, 100, 7387, 7388, 7423):
        link = FakeMcu()
        frames = Capture(link, stream())
        next(frames)
        plain = link.transfer

        def interrupted(tx: bytes) -> bytes:
            link.transfer = plain  # type: ignore[method-assign]  # noqa: B023
            link.exchange(tx[:at])  # noqa: B023
            raise KeyboardInterrupt

        link.transfer = interrupted  # type: ignore[method-assign]
        with pytest.raises(KeyboardInterrupt):
            next(frames)
        assert link.commands[-1].count == 1
        check(capture(link, stream(4)))
        assert len(list(capture(link, original(2)))) == 2


def test_replayed_stream_ends_with_the_recording() -> None:
    recorded = list(capture(FakeMcu(), stream(10)))
    found = list(capture(ReplayLink(recorded), stream()))
    check(found)
    assert len(found) == 10


def test_memory_stays_flat() -> None:
    link = FakeMcu()
    frames = Capture(link, stream())
    for _ in range(50):
        next(frames)
    tracemalloc.start()
    try:
        before = tracemalloc.get_traced_memory()[0]
        for _ in range(300):
            next(frames)
            link.lit.clear()
        assert tracemalloc.get_traced_memory()[0] - before < 50_000
    finally:
        tracemalloc.stop()


def test_sizes() -> None:
    assert (ORIGINAL_SIZE, STREAM_SIZE) == (7388, 7424)
