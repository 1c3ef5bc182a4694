"""A microcontroller in pure Python that keeps to the protocol, on a clock of its own.

Independent of the firmware: it has no pins, no sensor and no interrupts, but what it sends and
when is what the protocol says, stalls and all. `FaultyWire` breaks what passes between.
"""

from __future__ import annotations

import random
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from acquisition.frames import (
    ELEMENTS,
    MASTER_CLOCK,
    Frame,
    FrameFlags,
    OnboardSpike,
    SpikeFrame,
)
from acquisition.protocol import (
    ORIGINAL_SIZE,
    SIZES,
    BadMagic,
    Command,
    CommandError,
    Mode,
    Refusal,
    Status,
    encode_elements,
    encode_frame,
    encode_spikes,
    encode_status,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from numpy.typing import NDArray

BYTE = 8 / 15.6e6  # s
STALL = {Mode.ORIGINAL: 50e-3, Mode.STREAM: 1e-3, Mode.SPIKES: 1e-3}  # s
FLUSH = 3 * 15000 / MASTER_CLOCK  # s
LEDS = [{0: 100}, {1: 60}, {}, {0: 100, 1: 30}]
WINDOWS = [[(0, 99)], [(7, 300), (400, 500)], [], [(1, 3000)]]
_PATTERN = (3900 + np.random.default_rng(1304).integers(-3, 4, ELEMENTS)).astype(np.uint16)


def elements_at(number: int) -> NDArray[np.uint16]:
    """What the fake sensor shows in its n-th read-out since power-on."""
    result = _PATTERN.copy()
    at = 100 + 37 * (number % 90)
    result[at : at + 20] -= np.uint16(500 + number % 977)
    return result


def spikes_at(number: int) -> tuple[OnboardSpike, ...]:
    """What the fake firmware finds there: one spike, or two."""
    first = OnboardSpike(100 + 37 * (number % 90) + 10.5, 20.0, 500 + number % 977, 0, 0)
    return (first, first._replace(position=3600.25, height=99))[: 1 + number % 2]


def stream(count: int = 0) -> Command:
    return Command(100, 20000, count, Mode.STREAM, LEDS)


def spikes(count: int = 0) -> Command:
    return Command(100, 20000, count, Mode.SPIKES, LEDS, WINDOWS)


def check(frames: Iterable[Frame | SpikeFrame]) -> None:
    """Every frame is one that the device has taken."""
    for frame in frames:
        assert frame.timestamp is not None
        number = frame.timestamp // 1000
        if isinstance(frame, SpikeFrame):
            assert frame.spikes == spikes_at(number)
            assert frame.dark_level == 3900.5
        else:
            np.testing.assert_array_equal(frame.elements, elements_at(number))


class FakeMcu:
    """A `Link` to a fake device; all times in s, virtual."""

    def __init__(self, *, latency: float = 1e-4, extra: int = 0) -> None:
        self.latency = latency
        self.extra = extra  # frames sent more than asked for
        self.now = 0.0
        self.read_outs = 0  # since power-on
        self.commands: list[Command] = []
        self.lit: dict[int, dict[int, int]] = {}  # by read-out
        self.level: bool | None = None  # of the handshake line, if it is stuck
        self.edge_after: float | None = 0.0  # s, of the sync line, after a command that awaits one
        self.closed = False
        self.reset()

    def reset(self) -> None:
        """As after power-on; time goes on."""
        self.mode = Mode.ORIGINAL
        self.command: Command | None = None
        self.next_at = float("inf")
        self.sequence = 0
        self.left: float = 0
        self.table_at = 0
        self.flags = FrameFlags.NONE
        self.buffer = bytes(ORIGINAL_SIZE)
        self.status = b""
        self.offered: bytes | None = None
        self.offered_until = float("inf")
        self.current: bytes | None = None  # the frame being sent
        self.sending: bytes | None = None
        self.received = bytearray()
        self.last_byte = 0.0

    # --- the link

    @property
    def ready(self) -> bool:
        """The handshake line."""
        if self.level is not None:
            return self.level
        return self.offered is not None and self.sending is None

    def wait_ready(self, timeout: float) -> bool:
        """See `acquisition.links.Link`."""
        end = self.now + timeout
        while not self.ready:
            if self.now >= end:
                return False
            step = min(end, self._next_event())
            self._advance(max(step, self.now + 1e-6))
        self._advance(self.now + self.latency)
        return True

    def transfer(self, tx: bytes) -> bytes:
        """See `acquisition.links.Link`."""
        return self.exchange(tx)

    def sleep(self, seconds: float) -> None:
        """Let time pass."""
        end = self.now + seconds
        while self.now < end:
            self._advance(min(end, max(self._next_event(), self.now + 1e-6)))

    def close(self) -> None:
        """See `acquisition.links.Link`."""
        self.closed = True

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # --- SPI

    @property
    def size(self) -> int:
        return SIZES[self.mode]

    def exchange(self, tx: bytes) -> bytes:
        """Clock bytes through the slave, however many."""
        self._advance(self.now)
        rx = b""
        while len(rx) < len(tx):
            if self.sending is None:
                self.sending = self._to_send()
                self.received.clear()
            at = len(self.received)
            room = self.size - at if at < self.size else len(tx)
            piece = tx[len(rx) : len(rx) + room]
            rx += self.sending[at : at + len(piece)].ljust(len(piece), b"\0")
            self.received += piece
            self.last_byte = self.now + len(piece) * BYTE
            self._advance(self.last_byte)
            if len(self.received) >= self.size and not self._held:
                self._finished()
        return rx

    @property
    def _held(self) -> bool:
        """In spikes mode a command ends when the clock rests, unless it says that it is short."""
        received = self.received
        if self.mode is not Mode.SPIKES or len(received) < self.size or received[:2] != b"ER":
            return False
        return not (received[10] == Mode.SPIKES and received[15] & 2)

    def _to_send(self) -> bytes:
        self.current, self.offered = self.offered, None
        if self.mode is Mode.ORIGINAL:
            return self.buffer
        return self.current or self._answer(Refusal.NONE)

    def _finished(self) -> None:
        received, self.sending = bytes(self.received), None
        self._act(received)

    def _next_event(self) -> float:
        events = [self.next_at, self.offered_until]
        if self.sending is not None:
            events.append(self.last_byte + STALL[self.mode])
        return min(events)

    def _advance(self, now: float) -> None:
        self.now = max(self.now, now)
        if self.sending is not None and self.now >= self.last_byte + STALL[self.mode]:
            held = self._held
            received, self.sending = bytes(self.received), None
            least = ORIGINAL_SIZE // SIZES[Mode.SPIKES] * SIZES[Mode.SPIKES]
            held &= len(received) >= least
            if held or (len(received) >= ORIGINAL_SIZE and received[:2] == b"ER"):
                self._act(received)
            elif self.offered is None and self.mode is not Mode.ORIGINAL:
                self.offered = self.current
        if self.now >= self.offered_until:
            self.offered, self.offered_until = None, float("inf")
        while self.now >= self.next_at:
            self._read_out()

    # --- the sensor

    def _read_out(self) -> None:
        command = self.command
        assert command is not None
        self.lit[self.read_outs] = dict(command.leds(self.sequence - self.table_at))
        about: dict[str, Any] = {
            "sequence": self.sequence,
            "sh_period": command.sh_period,
            "icg_period": command.icg_period,
            "timestamp": self.read_outs * 1000,  # so that a test can tell which one it is
            "leds": sum(1 << n for n in command.leds(self.sequence - self.table_at)),
            "flags": self.flags,
        }
        number = self.read_outs
        self.read_outs += 1
        self.sequence += 1
        self.left -= 1
        period = command.icg_period / MASTER_CLOCK
        self.next_at = self.next_at + period if self.left > 0 else float("inf")
        if self.mode is Mode.ORIGINAL:
            self.buffer = encode_elements(Frame(elements_at(number), **about))
            self.offered = self.buffer
            if self.extra:  # the published firmware's handshake is a pulse
                self.offered_until = self.now + period
            return
        if self.offered is not None:
            # the newest wins; what is lost with the older one must not be forgotten
            lost = FrameFlags(self.offered[3]) & (FrameFlags.CHANGED | FrameFlags.REFUSED)
            about["flags"] = self.flags | FrameFlags.DROPPED | lost
        self.flags = FrameFlags.NONE
        if self.mode is Mode.STREAM:
            self.offered = encode_frame(Frame(elements_at(number), **about))
            return
        sequence = self.sequence - 1 - self.table_at
        windows = tuple(command.windows[sequence % len(command.windows)])
        self.offered = encode_spikes(SpikeFrame(spikes_at(number), windows, 3900.5, **about))

    # --- commands

    def _act(self, received: bytes) -> None:
        if self.extra and received[:2] == b"ER":
            count = int.from_bytes(received[11:13], "big") + self.extra
            received = received[:11] + count.to_bytes(2, "big") + received[13:]
        try:
            command = Command.decode(received)
        except BadMagic:
            return
        except CommandError as error:
            self._refuse(received[10], error.refusal)
            return
        self.commands.append(command)
        self._start(command)

    def _refuse(self, mode: int, refusal: Refusal) -> None:
        if mode == Mode.ORIGINAL:
            return
        running = self.mode is not Mode.ORIGINAL and self.left > 0
        if running and (mode == self.mode or refusal is Refusal.CHECKSUM):
            if self.next_at == float("inf"):  # it awaits an edge
                self.offered = self._answer(refusal)
            else:
                self.flags |= FrameFlags.REFUSED
            return
        self._stop()
        self.mode = Mode.SPIKES if mode == Mode.SPIKES else Mode.STREAM
        self.offered = self._answer(refusal)

    def _stop(self) -> None:
        self.left, self.next_at = 0, float("inf")
        self.offered, self.offered_until = None, float("inf")

    def _start(self, command: Command) -> None:
        before, self.command = self.command, command
        streaming = self.mode is command.mode and self.left > 0
        self.left = command.count or float("inf")
        self.flags |= FrameFlags.CHANGED
        if command.mode is Mode.ORIGINAL:
            self._stop()
            self.left = command.count
            self.mode, self.sequence, self.table_at = Mode.ORIGINAL, 0, 0
            self.flags = FrameFlags.NONE
            self.next_at = self.now + FLUSH + 3 * command.icg_period / MASTER_CLOCK
            return
        same = before is not None and _periods(before) == _periods(command)
        if streaming and same and not command.await_sync:
            self.table_at = self.sequence
            return
        self._stop()
        self.left = command.count or float("inf")
        self.mode, self.sequence, self.table_at = command.mode, 0, 0
        self.next_at = self.now + 2 * command.icg_period / MASTER_CLOCK
        if command.await_sync:
            self.next_at += float("inf") if self.edge_after is None else self.edge_after
        self.offered = self._answer(Refusal.NONE)

    def _answer(self, refusal: Refusal) -> bytes:
        sh, icg = (100, 30000) if self.command is None else _periods(self.command)
        return encode_status(Status(refusal, "fake 1.0", sh, icg), mode=self.mode)


def _periods(command: Command) -> tuple[int, int]:
    return command.sh_period, command.icg_period


class FaultyWire(FakeMcu):
    """A fake device behind a bad wire: now and then a transfer, or the handshake, goes wrong."""

    def __init__(self, seed: int, rate: float, faults: list[str]) -> None:
        super().__init__()
        self.random = random.Random(seed)  # noqa: S311
        self.rate = rate
        self.faults = faults
        self.injected: list[str] = []
        self.quiet = False
        self.once = False  # quiet again after a fault

    def _fault(self, *possible: str) -> str | None:
        names = [name for name in self.faults if name in possible]
        if self.quiet or not names or self.random.random() >= self.rate:
            return None
        name = self.random.choice(names)
        self.injected.append(name)
        self.quiet = self.once
        return name

    def wait_ready(self, timeout: float) -> bool:
        fault = self._fault("bounce", "deaf", "reset")
        if fault == "bounce":  # looks ready, but is not
            self.sleep(self.random.uniform(0, 1e-3))
            return True
        if fault == "deaf":  # an edge is missed
            self.sleep(timeout)
            return False
        if fault == "reset":
            self.sleep(self.random.uniform(0, 5e-3))
            self.reset()
        return super().wait_ready(timeout)

    def transfer(self, tx: bytes) -> bytes:
        fault = self._fault(*BREAKS, "flip tx")
        if fault == "flip tx":
            return self.exchange(flip(tx, self.random))
        if fault == "flip":
            return flip(self.exchange(tx), self.random)
        if fault in ("drop", "double", "truncate"):
            at = self.random.randrange(len(tx))
            seen = BREAKS[fault](tx, at)
            rx = self.exchange(seen)
            return (rx[:at] + rx[at + 1 :] if fault == "double" else rx).ljust(len(tx), b"\xff")
        return self.exchange(tx)


def flip(data: bytes, rng: random.Random) -> bytes:
    """Turn a few bits over."""
    result = bytearray(data)
    for _ in range(rng.randint(1, 4)):
        result[rng.randrange(len(result))] ^= 1 << rng.randrange(8)
    return bytes(result)


BREAKS: dict[str, Callable[[bytes, int], bytes]] = {
    "flip": lambda data, at: data[:at] + bytes([data[at] ^ 0x10]) + data[at + 1 :],
    "drop": lambda data, at: data[:at] + data[at + 1 :],
    "double": lambda data, at: data[: at + 1] + data[at:],
    "truncate": lambda data, at: data[:at],
}
