"""Spikes from the firmware's machine code, and two sensors that read out together."""

from __future__ import annotations

from dataclasses import replace
from itertools import islice
from typing import TYPE_CHECKING

import numpy as np
import pytest

from acquisition.capture import Capture, Refused, SpikeCapture, capture
from acquisition.frames import ELEMENTS, LEADING, PIXELS, Frame, FrameFlags, SpikeFrame
from acquisition.links import LinkTimeout
from acquisition.protocol import Command, Mode, Refusal, Status, decode_spikes
from tracking.onboard import find_spikes
from tracking.spikes import SpikeFlags
from twin.link import TwinLink
from twin.machine import CLOCK
from twin.world import Led, Pose, World

if TYPE_CHECKING:
    from numpy.typing import NDArray

FASTEST = 14800  # clocks: 270.3 read-outs a second
READ_OUT = ELEMENTS * 84  # cycles


class Watched(TwinLink):
    """The twin, with every read-out's codes remembered by the time of its transfer, cycles."""

    def __init__(self, world: World | None = None, shown: NDArray[np.uint16] | None = None) -> None:
        super().__init__(world, record=True)
        self.shown: dict[int, NDArray[np.uint16]] = {}
        digitise = self.machine._digitise_python
        assert digitise is not None

        def remembered(charge: NDArray[np.float64], time: int) -> NDArray[np.uint16]:
            codes = np.asarray(digitise(charge, time)) if shown is None else shown
            self.shown[int(self.machine.readouts[-1]["transfer"])] = codes[:ELEMENTS].copy()
            return codes

        self.machine._digitise_python = remembered

    def read_out_of(self, frame: SpikeFrame) -> int:
        """Time of the transfer of a frame that has just come, whose spikes are those of its codes."""
        newest = sorted(self.shown)[-2:]
        found = [
            find_spikes(Frame(self.shown[time], leds=frame.leds), frame.windows) for time in newest
        ]
        fitting = [
            time
            for time, expected in zip(newest, found, strict=True)
            if (expected.spikes, expected.dark_level) == (frame.spikes, frame.dark_level)
        ]
        assert fitting, f"not what was digitised: {frame}"
        return fitting[-1]


def scene(widths: list[float], height: float = 1500.0, seed: int = 5) -> NDArray[np.uint16]:
    """Codes of a read-out with so wide spikes at even distances, and the idle one."""
    rng = np.random.default_rng(seed)
    pixels = np.arange(PIXELS)
    light = np.zeros(PIXELS)
    for n, width in enumerate(widths):
        middle = PIXELS * (n + 0.5) / len(widths)
        light += height * np.exp(-4 * np.log(2) * ((pixels - middle) / width) ** 2)
    codes = 3920 + rng.normal(0, 1.4, ELEMENTS + 1)
    codes[LEADING : LEADING + PIXELS] -= light + rng.normal(0, np.sqrt(light / 29))
    return np.clip(np.rint(codes), 0, 4095).astype(np.uint16)


def skewed(length: int, *, falling: bool = False) -> NDArray[np.uint16]:
    """Eight that rise evenly over so many pixels, then are over: those take the longest."""
    pixels = np.arange(PIXELS) % (PIXELS // 8)
    light = np.where(pixels < length, pixels / length, 0.0)
    codes = 3920 + np.random.default_rng(1).normal(0, 1.0, ELEMENTS + 1)
    codes[LEADING : LEADING + PIXELS] -= 1500 * (light[::-1] if falling else light)
    return np.rint(codes).astype(np.uint16)


def noise() -> NDArray[np.uint16]:
    """Whatever: 456 blocks, hundreds of peaks."""
    rng = np.random.default_rng(3)
    codes = 3920 + rng.normal(0, 1.0, ELEMENTS + 1)
    codes[LEADING : LEADING + PIXELS] -= np.repeat(rng.integers(0, 2000, PIXELS // 8), 8)
    return np.rint(codes).astype(np.uint16)


def room() -> World:
    """Several LEDs at once."""
    leds = [Led(n, (120.0 * (n - 2), 0, 0), power=0.3) for n in range(5)]
    return World(leds=leds, tracker=Pose(0, 3000))


def test_spikes_are_those_of_the_reference_to_the_last_bit() -> None:
    sequence = [{0: 200}, dict.fromkeys(range(5), 100), {}, {1: 150, 3: 60}]
    windows = [[], [], [(0, 3647)], [(1500, 1815), (2200, 2223), (1830, 2110)]]
    command = Command(200, FASTEST, 0, Mode.SPIKES, sequence, windows)
    with Watched(room()) as link, SpikeCapture(link, command) as frames:
        for n, frame in enumerate(islice(frames, 40)):
            link.read_out_of(frame)
            assert frame.exposures == sequence[n % 4]
            assert frame.windows == command.windows[n % 4]
            assert len(frame.spikes) == (1, 5, 0, 2)[n % 4]
        assert frames.statistics.dropped == frames.statistics.corrupt == 0
        for spike in find_spikes(Frame(link.shown[max(link.shown)])).spikes:
            assert not spike.flags & SpikeFlags.SATURATED


WHOLE = [(0, PIXELS - 1)]
EIGHTHS = [(n * 456, n * 456 + 455) for n in range(8)]
PARTS = [(n * 456 + 164, n * 456 + 291) for n in range(8)]


@pytest.mark.parametrize(
    ("codes", "windows", "spikes", "allowed"),
    [
        (scene([]), WHOLE, 0, 0.36e-3),
        (scene([]), EIGHTHS, 0, 0.37e-3),
        (scene([20.0]), WHOLE, 1, 0.38e-3),
        (scene([6.0] * 8), WHOLE, 8, 0.49e-3),
        (scene([62.0] * 8), WHOLE, 8, 0.82e-3),
        (scene([300.0] * 8), WHOLE, 8, 0.80e-3),
        (skewed(100), WHOLE, 8, 0.84e-3),
        (skewed(100), EIGHTHS, 8, 0.84e-3),
        (skewed(115), WHOLE, 8, 0.84e-3),
        (skewed(115, falling=True), WHOLE, 8, 0.84e-3),
        (noise(), WHOLE, 8, 0.80e-3),
        (scene([20.0]), [(1792, 1855)], 1, 0.07e-3),
        (scene([20.0] * 8), PARTS, 8, 0.33e-3),
    ],
)
def test_cycle_budget(
    codes: NDArray[np.uint16], windows: list[tuple[int, int]], spikes: int, allowed: float
) -> None:
    """From the last sample until the frame is offered, at the sensor's highest rate.

    Of the full frame's 3.7 ms. Time is the emulator's count of cycles: flash without wait states,
    as behind its cache.
    """
    command = Command(200, FASTEST, 0, Mode.SPIKES, [{}], [windows])
    with Watched(shown=codes) as link, SpikeCapture(link, command) as frames:
        for frame in islice(frames, 8):
            link.read_out_of(frame)
            assert len(frame.spikes) == spikes
        assert frames.statistics.dropped == 0
        readouts = link.machine.readouts
        ends = readouts[readouts["sampled"] > 0]["start"][2:-1].astype(np.int64) + READ_OUT
        rises = link.machine.edges("PB2")
        rises = rises[rises["level"] == 1]["time"].astype(np.int64)
        taken = []
        for end in ends:
            (rise,) = rises[(rises > end) & (rises < end + FASTEST * 21)]  # none is another's
            taken.append((rise - end) / CLOCK)
    print(f"{spikes} spikes, {len(windows)} windows: {max(taken) * 1e3:.3f} ms")
    assert len(taken) >= 5
    assert max(taken) < allowed


@pytest.mark.parametrize(
    ("shown", "windows"),
    [
        (None, WHOLE),
        (None, [(2400, 2650)]),
        (scene([62.0] * 8), WHOLE),
        (skewed(100), WHOLE),
        (skewed(115, falling=True), EIGHTHS),
    ],
)
def test_latency_at_the_highest_rate(
    shown: NDArray[np.uint16] | None, windows: list[tuple[int, int]]
) -> None:
    """End of exposure to spikes at the host, which looks 0.1 ms after the handshake."""
    command = Command(200, FASTEST, 0, Mode.SPIKES, [{1: 200}], [windows])
    with Watched(shown=shown) as link, SpikeCapture(link, command) as frames:
        late, stamps = [], []
        for frame in islice(frames, 40):
            # the newest read-out that is over: what it shows may be what all show
            over = [time for time in link.shown if time + READ_OUT < link.machine.time]
            late.append(link.machine.seconds - max(over) / CLOCK)
            assert link.read_out_of(frame)
            stamps.append(frame.timestamp or 0)
        assert frames.statistics.dropped == 0
    assert set(np.diff(stamps)) == {FASTEST * 250}
    print(f"{windows}: at most {max(late) * 1e3:.3f} ms")
    assert min(late) > 3.9e-3
    assert max(late) < 4.8e-3


def test_modes_follow_each_other() -> None:
    with TwinLink() as link:
        for before in Mode:
            for after in Mode:
                for mode in (before, after):
                    count = 3 if mode is Mode.ORIGINAL else 0
                    frames = Capture(link, Command(200, 20000, count, mode))
                    with frames:
                        assert len(list(islice(frames, 3))) == 3
                    found = frames.statistics
                    assert (found.restarts, found.corrupt, found.invalid) == (0, 0, 0)


def test_windows_and_leds_are_exchanged_without_interruption() -> None:
    command = Command(200, FASTEST, 0, Mode.SPIKES, [{0: 200}], [[(1000, 1300)]])
    with Watched() as link, SpikeCapture(link, command) as frames:
        found = list(islice(frames, 5))
        for n in range(20):
            change = replace(command, sequence=[{n % 2: 100}], windows=[[(100 * n, 2600)]])
            frames.send(change)
            for frame in islice(frames, 5):
                link.read_out_of(frame)
                found.append(frame)
            assert found[-1].windows == ((100 * n, 2600),)
            assert found[-1].exposures == {n % 2: 100}
            # in force with the exposure after next: one read-out is under way, one has begun
            assert [bool(f.flags & FrameFlags.CHANGED) for f in found[-5:]].index(True) <= 3
        assert [frame.sequence for frame in found] == list(range(105))
        assert frames.statistics.restarts == frames.statistics.dropped == 0


def test_slow_hosts_lose_frames_and_are_told() -> None:
    command = Command(200, FASTEST, 0, Mode.SPIKES, [{0: 200}])
    with Watched() as link, SpikeCapture(link, command) as frames:
        list(islice(frames, 3))
        link.sleep(0.05)
        found = list(islice(frames, 6))
        link.read_out_of(found[-1])
        assert frames.statistics.dropped >= 11
        assert any(frame.flags & FrameFlags.DROPPED for frame in found)
        assert [frame.sequence for frame in found] == sorted({f.sequence for f in found})
        assert frames.statistics.corrupt == 0


def test_the_thesis_head_has_one_spike_for_each_led_not_two() -> None:
    """Its caustic's horns, 35 px apart, are one spike that says that it is double."""
    with TwinLink() as link:
        command = Command(200, 20000, 40, Mode.SPIKES)
        for first, second in zip(*[iter(capture(link, command))] * 2, strict=True):
            for frame, middle in ((first, 1117.8), (second, 2529.2)):
                assert isinstance(frame, SpikeFrame)
                assert [s.flags for s in frame.spikes] == [SpikeFlags.DOUBLE]
                assert frame.spikes[0].position == pytest.approx(middle, abs=0.2)
                assert frame.spikes[0].width == pytest.approx(42, abs=1)


# --- two sensors, one line


def awaiting(link: TwinLink, command: Command) -> Status:
    """Let the device take the command; its answer."""
    link.sleep(1e-3)
    link.transfer(command.encode())
    assert link.wait_ready(0.1)
    status = decode_spikes(link.transfer(bytes(command.size)))
    assert isinstance(status, Status)
    return status


def test_sensors_that_see_the_same_edge_read_out_together() -> None:
    """To the cycle, whatever each of them did before: one clock, and pulses from the same edge."""
    command = Command(200, 15000, 0, Mode.SPIKES, [{0: 200}, {1: 100}], await_sync=True)
    with TwinLink(seed=1, record=True) as one, TwinLink(seed=2, record=True) as two:
        list(capture(one, Command(100, 30000, 3, Mode.STREAM)))
        before = one.clock_offset
        two.sleep(0.0123456)
        for link in (one, two):
            assert awaiting(link, command).refusal is Refusal.NONE
        start = max(one.machine.time, two.machine.time) + round(0.777 * CLOCK)
        edges = []
        for link in (one, two):
            link.machine.run((start - link.machine.time) / CLOCK)
            assert link.machine.time == start
            assert not link.machine.level("PB2"), "nothing before the edge"
            link.machine.clear_edges()
            link.machine.drive("PB1", True)
            link.machine.run(0.1)
            edges.append(link.machine.edges("PA0")["time"])
        assert len(edges[0]) > 40
        assert np.array_equal(edges[0], edges[1])
        assert 0 < edges[0][0] - start < 500
        # the device's clock has gone on while it waited
        assert abs(one.clock_offset - before) < 1e-6


def test_waiting_hangs_nothing() -> None:
    """Without an edge a new command takes over; an edge that nobody awaits does nothing."""
    wait = Command(200, 20000, 3, Mode.SPIKES, await_sync=True)
    with TwinLink() as link:
        for mode in Mode:
            awaiting(link, wait)
            link.sleep(0.5)
            assert not link.wait_ready(0)
            assert len(list(capture(link, Command(200, 20000, 3, mode)))) == 3
        awaiting(link, wait)
        awaiting(link, wait)
        link.machine.drive("PB1", True)
        link.machine.drive("PB1", False)
        link.machine.drive("PB1", True)
        assert link.wait_ready(0.1)
        frame = decode_spikes(link.transfer(bytes(256)))
        assert isinstance(frame, SpikeFrame)
        assert frame.sequence == 0
        running = Capture(link, replace(wait, count=0, await_sync=False))
        with running:
            before = list(islice(running, 3))
            link.machine.drive("PB1", False)
            link.machine.drive("PB1", True)
            after = list(islice(running, 3))
        assert [frame.sequence for frame in before + after] == list(range(6))


def test_a_damaged_command_does_not_end_the_wait() -> None:
    wait = Command(200, 20000, 3, Mode.SPIKES, await_sync=True)
    with TwinLink() as link:
        awaiting(link, wait)
        damaged = bytearray(wait.encode(256))
        damaged[20] ^= 1
        link.sleep(1e-3)
        link.transfer(bytes(damaged))
        assert link.wait_ready(0.1)
        answer = decode_spikes(link.transfer(bytes(256)))
        assert isinstance(answer, Status)
        assert answer.refusal is Refusal.CHECKSUM
        link.machine.drive("PB1", True)
        assert link.wait_ready(0.1)
        assert isinstance(decode_spikes(link.transfer(bytes(256))), SpikeFrame)


def test_a_wait_that_is_given_up_leaves_nothing_armed() -> None:
    command = Command(200, 20000, 0, Mode.SPIKES, await_sync=True)
    with TwinLink() as link:
        with pytest.raises(LinkTimeout, match="sync line"), SpikeCapture(link, command) as frames:
            next(frames)
        assert frames.statistics.restarts == 0
        while link.wait_ready(0.1):
            link.transfer(bytes(256))
        link.machine.drive("PB1", True)
        assert not link.wait_ready(0.1)


@pytest.mark.parametrize("running", [Mode.STREAM, Mode.SPIKES])
@pytest.mark.parametrize("wanted", [Mode.STREAM, Mode.SPIKES])
def test_a_command_of_a_newer_release_is_refused_understandably(
    running: Mode, wanted: Mode
) -> None:
    """Whatever went on before: in the framing that the host of that command reads."""

    class Newer(Command):
        def encode(self, size: int | None = None) -> bytes:
            data = bytearray(super().encode(size))
            data[13] = 3
            return bytes(data)

    with TwinLink() as link:
        before = Capture(link, Command(200, 20000, 0, running))
        assert len(list(islice(before, 3))) == 3
        with pytest.raises(Refused, match="same release"):
            next(Capture(link, Newer(200, 20000, 0, wanted)))
        assert len(list(Capture(link, Command(200, 20000, 3, wanted)))) == 3


def test_the_beginning_of_a_command_is_not_obeyed() -> None:
    """One of original mode has no checksum: 256 bytes of 7388 may be all that is left of it."""
    with TwinLink() as link, SpikeCapture(link, Command(200, FASTEST, 0, Mode.SPIKES)) as frames:
        list(islice(frames, 3))
        for size in (256, 1000, 7100):
            link.transfer(Command(200, 30000, 2).encode()[:size])
            link.sleep(5e-3)
            assert len(list(islice(frames, 5))) == 5
        assert frames.statistics.restarts == 0


def test_pixels_too_begin_with_an_edge() -> None:
    command = Command(200, 20000, 4, Mode.STREAM, await_sync=True)
    with TwinLink() as link:
        look = link.wait_ready

        def edge(timeout: float) -> bool:
            if not look(0.05):
                link.machine.drive("PB1", True)
            return look(timeout)

        link.wait_ready = edge  # type: ignore[method-assign]
        frames = Capture(link, command)
        assert [frame.leds for frame in frames] == [1, 2, 1, 2]
        assert frames.statistics.restarts == 0
