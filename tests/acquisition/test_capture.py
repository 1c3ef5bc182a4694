"""Capture against a fake device, over good wires and bad ones."""

from __future__ import annotations

import itertools
import os
import threading
import time
import tracemalloc
from contextlib import suppress
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from acquisition.capture import Capture, CaptureStatistics, Refused, capture
from acquisition.frames import FrameFlags
from acquisition.links import LinkError, LinkTimeout, ReplayLink, SpiLink
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
from tests.acquisition.fake_mcu import (
    BREAKS,
    LEDS,
    FakeMcu,
    FaultyWire,
    check,
    elements_at,
    spikes,
    stream,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from acquisition.frames import Frame


def original(count: int = 2) -> Command:
    return Command(100, 30000, count)


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


class Busy(FakeMcu):
    """The host is away for a while after some of the transfers (counted from 1)."""

    def __init__(self, seconds: float, after: Iterable[int]) -> None:
        super().__init__()
        self.seconds = seconds
        self.after = iter(after)
        self.transfers = 0
        self.then = next(self.after)

    def transfer(self, tx: bytes) -> bytes:
        rx = super().transfer(tx)
        self.transfers += 1
        if self.transfers == self.then:
            self.then = next(self.after, 0)
            self.sleep(self.seconds)
        return rx


@pytest.mark.parametrize(
    ("count", "after", "commands"),
    [(2, 1, [2, 2]), (7, 3, [7, 7]), (16, 14, [16, 16]), (30, 22, [30, 17]), (30, 3, [30, 17])],
)
def test_missed_frame_of_original_mode_does_not_relabel_the_others(
    count: int, after: int, commands: list[int]
) -> None:
    link = Busy(45e-3 if after == 1 else 17e-3, [after])
    frames = Capture(link, original(count))
    found = list(frames)
    assert [command.count for command in link.commands] == commands
    assert [frame.leds for frame in found] == [0] * (count - 2) + [1, 2]
    assert [frame.sequence for frame in found] == list(range(count))
    true = {elements_at(n).tobytes(): lit for n, lit in link.lit.items()}
    for frame in found:
        assert frame.exposures == true[frame.elements.tobytes()]
    (lost,) = [frame.sequence for frame in found if frame.flags & FrameFlags.LOST]
    assert lost == count - commands[-1]
    assert frames.statistics == CaptureStatistics(good=count, timeouts=1, restarts=1)


def test_missed_frame_on_the_twin() -> None:
    if not os.environ.get("CI"):
        pytest.importorskip("unicorn")
    from twin.link import TwinLink

    def spikes(link: TwinLink) -> dict[int, int]:
        return {frame.leds: int(frame.pixels.argmin()) for frame in capture(link, original(3))}

    class BusyHost(TwinLink):
        transfers = 0

        def transfer(self, tx: bytes) -> bytes:
            rx = super().transfer(tx)
            self.transfers += 1
            if self.transfers == 1:
                self.sleep(60e-3)
            return rx

    with TwinLink() as link:
        wanted = spikes(link)
    with BusyHost() as busy:
        found = spikes(busy)
        assert busy.transfers > 4  # the command was repeated
    assert list(found) == list(wanted) == [0, 1, 2]
    assert abs(wanted[1] - wanted[2]) > 1000
    for leds in (1, 2):
        assert abs(found[leds] - wanted[leds]) < 200


def test_host_that_is_always_too_slow_for_original_mode() -> None:
    link = Busy(17e-3, itertools.count(2))
    with pytest.raises(LinkTimeout, match=r"only 3 of 4 frames came.*3 times.*every 0\.0075 s"):
        list(capture(link, original(4), retries=2))
    assert [command.count for command in link.commands] == [4] * 3


@pytest.mark.parametrize("count", [2, 5, 20])
def test_frame_that_was_read_twice_is_shown(count: int) -> None:
    class Twice(FakeMcu):
        looks = 0

        def wait_ready(self, timeout: float) -> bool:
            self.looks += 1
            return self.looks == 2 or super().wait_ready(timeout)

    frames = Capture(Twice(), original(count))
    found = list(frames)
    assert [bool(frame.flags & FrameFlags.INVALID) for frame in found] == [
        n == 1 for n in range(count)
    ]
    assert "read twice" in found[1].reasons[0]
    assert frames.statistics.invalid == 1
    # one of the device's frames was not read: which of these the LEDs lit is not known
    for frame in found[-2:]:
        assert (frame.leds, dict(frame.exposures)) == (0, {})
        assert frame.flags & FrameFlags.LOST


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
    with pytest.raises(ValueError, match="original mode; begin a new one"):
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


def test_refusals_of_commands_that_nobody_sent_are_not_added_up() -> None:
    """Garbage taken for a command is refused; what is sent again, a frame may confirm."""
    link = FakeMcu()
    frames = Capture(link, stream())
    for _ in range(3):
        found = list(itertools.islice(frames, 5))
        check(found)
        plain, refusal = link.exchange, encode_status(Status(Refusal.VERSION, "", 100, 20000))

        def refused(tx: bytes, plain: Any = plain, refusal: bytes = refusal) -> bytes:
            link.exchange = plain  # type: ignore[method-assign]
            plain(tx)
            return refusal

        link.exchange = refused  # type: ignore[method-assign]
    assert len(list(itertools.islice(frames, 5))) == 5


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
    frames = Capture(link, original(20))
    found = [next(frames) for _ in range(3)]
    link.reset()
    found += frames
    assert [f.leds for f in found] == [0] * 18 + [1, 2]
    assert found[3].flags & FrameFlags.LOST
    assert link.commands[-1].count == 17  # those delivered are not asked for again


def test_a_running_stream_that_is_silent_is_soon_begun_anew() -> None:
    link = FakeMcu()
    frames = Capture(link, stream())
    check([next(frames) for _ in range(5)])
    link.reset()
    before = link.now
    check([next(frames)])
    assert link.now - before < 0.15
    assert frames.statistics.restarts == 1
    # a slow one is waited for
    slow = FakeMcu()
    frames = Capture(slow, Command(100, 2_000_000, 0, Mode.STREAM))
    check([next(frames) for _ in range(3)])
    slow.next_at += 1.2  # two more read-outs
    check([next(frames)])
    assert frames.statistics.timeouts == 0


def test_a_handshake_that_is_missed_costs_nothing() -> None:
    link = FakeMcu()
    frames = Capture(link, stream())
    found = [next(frames) for _ in range(5)]
    for _ in range(20):
        link.level = False
        plain = link.exchange

        def seen(tx: bytes) -> bytes:
            link.level = None
            link.exchange = plain  # type: ignore[method-assign]  # noqa: B023
            return plain(tx)  # noqa: B023

        link.exchange = seen  # type: ignore[method-assign]
        found += [next(frames) for _ in range(3)]
    check(found)
    assert frames.statistics.timeouts == 20
    assert frames.statistics.restarts == frames.statistics.corrupt == 0
    assert all(frame.exposures == LEDS[frame.sequence % 4] for frame in found)


def test_after_a_broken_transfer_the_device_is_left_alone() -> None:
    """Else, with a handshake that is stuck, one transfer after the other is out of step."""
    for at in range(12):
        link = FaultyWire(at, 1.0, ["truncate"])
        link.quiet = link.once = True
        frames = Capture(link, stream())
        check([next(frames) for _ in range(4)])
        link.quiet, link.level = False, True
        check([next(frames) for _ in range(4)])
        assert link.injected == ["truncate"]
        assert frames.statistics.corrupt == 1
        assert frames.statistics.restarts == 0


class Silent(SpiLink):
    """A link in real time to a device that never answers."""

    def __init__(self) -> None:
        self.commands: list[Command] = []

    def wait_ready(self, timeout: float) -> bool:
        time.sleep(timeout)
        return False

    def transfer(self, tx: bytes) -> bytes:
        self.commands.append(Command.decode(tx))
        return bytes(len(tx))

    def close(self) -> None:
        pass


@pytest.mark.parametrize("mode", [Mode.ORIGINAL, Mode.STREAM])
def test_interrupted_while_the_device_is_silent(mode: Mode) -> None:
    link = Silent()
    frames = Capture(link, Command(100, 30000, 0xFFFF, mode), timeout=60)
    timer = threading.Timer(0.05, frames.interrupt)
    before = time.monotonic()
    timer.start()
    assert list(frames) == []
    assert time.monotonic() - before < 5
    timer.join()
    last = [(command.count, command.sequence) for command in link.commands[1:]]
    assert last == ([(1, ({},))] if mode is Mode.STREAM else [])
    assert frames.statistics.timeouts == 0


def test_interrupted_between_frames() -> None:
    link = FakeMcu()
    frames = Capture(link, stream())
    check([next(frames) for _ in range(5)])
    frames.interrupt()
    frames.interrupt()
    assert list(frames) == []
    assert link.commands[-1].count == 1
    check(capture(link, stream(3)))
    early = Capture(link, stream())
    early.interrupt()
    sent = len(link.commands)
    assert list(early) == []
    assert len(link.commands) == sent


@pytest.mark.parametrize(("mode", "seen"), [(Mode.ORIGINAL, b""), (Mode.STREAM, b"?")])
def test_interrupted_in_a_pause(mode: Mode, seen: bytes) -> None:
    """No pause is longer than an interruption may take, and no repetition follows it."""
    link = Deaf()
    link.answer = seen * STREAM_SIZE
    frames = Capture(link, Command(100, 30000, 2, mode), retries=99)
    plain: Callable[[float], None] = link.sleep
    slept = []

    def sleep(seconds: float) -> None:
        slept.append(seconds)
        plain(seconds)
        if len(slept) > 10:
            frames.interrupt()

    link.sleep = sleep  # type: ignore[method-assign]
    assert list(frames) == []
    assert len(slept) <= 13
    assert all(seconds <= 0.1 for seconds in slept if seconds != frames._timeout)


def test_interrupted_original_mode_keeps_what_came() -> None:
    link = Busy(0, [0])
    frames = Capture(link, original(6))
    plain = link.transfer

    def transfer(tx: bytes) -> bytes:
        if link.transfers == 4:
            frames.interrupt()
        return plain(tx)

    link.transfer = transfer  # type: ignore[method-assign]
    found = list(frames)
    assert [frame.sequence for frame in found] == [0, 1, 2, 3]
    assert [frame.leds for frame in found] == [0] * 4
    for n, frame in enumerate(found):
        np.testing.assert_array_equal(frame.elements, elements_at(n))


STREAMS = pytest.mark.parametrize("command", [stream(), spikes()], ids=["stream", "spikes"])


@STREAMS
@pytest.mark.parametrize("fault", sorted(BREAKS))
def test_one_fault_costs_two_frames_at_most(command: Command, fault: str) -> None:
    for at in range(12):
        link = FaultyWire(at, 1.0, [fault])
        link.quiet = True
        frames = Capture(link, command)
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


@STREAMS
@pytest.mark.parametrize("seed", range(12))
def test_stream_over_a_bad_wire(command: Command, seed: int) -> None:
    faults = [*BREAKS, "flip tx", "bounce", "deaf", "reset"]
    link = FaultyWire(seed, 0.08, faults)
    frames = Capture(link, command, retries=20)
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
        if frame.exposures and frame.timestamp is not None:
            assert sum(1 << n for n in frame.exposures) == frame.leds
            assert frame.exposures == link.lit[frame.timestamp // 1000]
    link.quiet = True
    while frames.command.sequence != ({7: 10}, {0: 99}):
        check([next(frames)])
    frames.close()


@pytest.mark.parametrize("seed", range(12))
def test_original_mode_over_a_bad_wire(seed: int) -> None:
    link = FaultyWire(seed, 0.1, [*BREAKS, "flip tx", "deaf", "reset"])
    whole = 0
    for _ in range(15):
        frames = list(capture(link, original(4), retries=20))
        assert len(frames) == 4
        read_outs = {elements_at(n).tobytes() for n in range(min(link.read_outs, 90 * 977))}
        for frame in frames:
            if frame.flags & FrameFlags.INVALID:
                twice = any("read twice" in reason for reason in frame.reasons)
                assert twice or frame.elements.tobytes() not in read_outs
                continue
            # what was not sent so, and is not flagged, the format does not let one see
            assert frame.elements.max() <= 4095
            assert np.ptp(frame.dark) <= 128
            assert frame.dark_level >= 1024
            whole += frame.elements.tobytes() in read_outs
    assert link.injected
    assert whole > 20
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


def recordings() -> Iterator[list[Frame]]:
    yield list(capture(FakeMcu(), stream(9)))
    yield list(capture(FakeMcu(), original(4)))
    first, *others = capture(FakeMcu(), stream(5))
    others[1] = others[1].replaced(flags=FrameFlags.INVALID | FrameFlags.LOST)
    yield [first, *others[1:]]


@pytest.mark.parametrize("frames", list(recordings()))
@pytest.mark.parametrize("mode", [Mode.ORIGINAL, Mode.STREAM])
@pytest.mark.parametrize("count", [2, 40])
def test_replay_makes_nothing_up(frames: list[Frame], mode: Mode, count: int) -> None:
    """Neither exposures and LEDs of the command given now, nor times that were not recorded."""
    sh, icg = frames[0].sh_period, frames[0].icg_period
    link = ReplayLink(frames)
    source = Capture(link, Command(sh, icg, count, mode, [{7: 33}] if mode else []))
    found = list(source)
    among = [frame.sequence for frame in frames] if mode else range(len(frames))
    assert len(found) == sum(number - frames[0].sequence < count for number in among)
    for frame, wanted in zip(found, frames, strict=False):
        np.testing.assert_array_equal(frame.elements, wanted.elements)
        assert (frame.leds, frame.exposures) == (wanted.leds, wanted.exposures)
        assert (frame.timestamp, frame.sh_period) == (wanted.timestamp, wanted.sh_period)
        assert wanted.flags & ~frame.flags == 0
        assert frame.utc_ns > wanted.utc_ns
    bad = sum(bool(frame.flags & FrameFlags.INVALID) for frame in found)
    assert (source.statistics.good, source.statistics.invalid) == (len(found) - bad, bad)


def test_replay_of_original_mode_is_not_held_back() -> None:
    frames = Capture(ReplayLink(list(capture(FakeMcu(), original(4)))), original(4))
    next(frames)
    assert frames.statistics.good == 1


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
