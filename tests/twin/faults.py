"""A link that does to the twin what cables, noise and careless hosts do, and keeps count of it."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from itertools import islice
from typing import TYPE_CHECKING, Any

import numpy as np

from acquisition.capture import Capture
from acquisition.frames import LEADING, PIXELS, Frame, SpikeFrame
from acquisition.links import LinkError
from acquisition.protocol import Command, Mode
from tracking.onboard import find_spikes
from twin.link import TwinLink
from twin.machine import CLOCK

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

STREAM = Command(200, 20000, 0, mode=Mode.STREAM, sequence=[{0: 200}, {1: 100}, {}])
"""200 frames a second: slower than the link, so that nothing is dropped without a fault."""

SPIKES = Command(
    *(200, 20000, 0, Mode.SPIKES, [{0: 200}, {1: 100}]),
    windows=[[(0, 3647)], [(2400, 2650), (100, 130)]],
)
"""The same with spikes. No frame is unlit: of those, one is like the other."""


class FaultyLink(TwinLink):
    """The twin behind a bad cable: one fault of a kind for each call of `strike`.

    Every read-out's codes are kept for a while: what the firmware digitised is known here, and only
    here, so a frame that is not among them is a corrupt one.
    """

    def __init__(self, seed: int, **options: Any) -> None:
        self.rng = np.random.Generator(np.random.PCG64(seed))
        # by pixels: time of transfer, LEDs, all elements
        self.readouts: dict[bytes, tuple[float, int, NDArray[np.uint16]]] = {}
        self.fault: str | None = None
        self.after = 0  # transfers that are still left alone
        self.over = 0.0  # virtual time at which the last fault was over
        self.struck: Counter[str] = Counter()
        super().__init__(**options)
        clean = self.sensor.digitise

        def remembered(
            charge: NDArray[np.float64], dark_seconds: float
        ) -> tuple[NDArray[np.uint16], int]:
            codes, idle = clean(charge, dark_seconds)
            last = self.machine.readouts[-1]
            leds = sum(1 << int(source) - 1 for source in np.flatnonzero(last["lit"]) if source)
            self.readouts[codes[LEADING : LEADING + PIXELS].tobytes()] = (
                last["transfer"] / CLOCK,
                leds,
                codes.copy(),
            )
            while len(self.readouts) > 64:
                self.readouts.pop(next(iter(self.readouts)))
            return codes, idle

        self.sensor.digitise = remembered  # type: ignore[method-assign]

    def strike(self, fault: str, after: int = 0) -> None:
        """Let the next transfer but `after`, or the next look at the handshake, go wrong."""
        self.fault, self.after = fault, after

    def wait_ready(self, timeout: float) -> bool:
        """As the handshake line looks from the host."""
        if self.fault == "stuck low":
            self.sleep(timeout)
            self._done()
            return False
        if self.fault in ("stuck high", "bouncing"):
            if self.fault == "bouncing":
                self.sleep(self.rng.uniform(0, 0.004))
            self._done()
            return True
        return super().wait_ready(timeout)

    def transfer(self, tx: bytes) -> bytes:
        """As the bytes arrive at the other end."""
        if self.fault is None or not hasattr(self, "_" + self.fault.replace(" ", "_")):
            return super().transfer(tx)
        if self.after:
            self.after -= 1
            return super().transfer(tx)
        inflict: Callable[[bytes], bytes] = getattr(self, "_" + self.fault.replace(" ", "_"))
        rx = inflict(tx)
        self._done()
        return (rx + bytes(len(tx)))[: len(tx)]

    def _done(self) -> None:
        self.struck[str(self.fault)] += 1
        self.fault = None
        self.over = self.machine.seconds

    def _place(self, tx: bytes) -> int:
        """Faults like the beginning and the end as much as the middle."""
        kind = self.rng.integers(4)
        if kind == 0:
            return int(self.rng.integers(0, 40))
        if kind == 1:
            return len(tx) - 1 - int(self.rng.integers(0, 40))
        return int(self.rng.integers(0, len(tx)))

    def _flipped(self, data: bytes) -> bytes:
        bits = bytearray(data)
        for _ in range(int(self.rng.integers(1, 9))):
            bits[self._place(data)] ^= 1 << int(self.rng.integers(8))
        return bytes(bits)

    def _bits_flipped_in(self, tx: bytes) -> bytes:
        return self._flipped(super().transfer(tx))

    def _bits_flipped_out(self, tx: bytes) -> bytes:
        return super().transfer(self._flipped(tx))

    def _bytes_dropped(self, tx: bytes) -> bytes:
        """Clock pulses that the microcontroller does not see."""
        at, count = self._place(tx), int(self.rng.integers(1, 20))
        rx = super().transfer(tx[:at] + tx[at + count :])
        return rx[:at] + rx[at : at + 1] * count + rx[at:]

    def _bytes_doubled(self, tx: bytes) -> bytes:
        """Clock pulses that the host has not sent."""
        at, count = self._place(tx), int(self.rng.integers(1, 20))
        rx = super().transfer(tx[:at] + tx[at : at + 1] * count + tx[at:])
        return rx[:at] + rx[at + count :]

    def _truncated(self, tx: bytes) -> bytes:
        at = self._place(tx)
        return super().transfer(tx[:at]) if at else b""

    def _overlong(self, tx: bytes) -> bytes:
        return super().transfer(tx + bytes(int(self.rng.integers(1, 3000))))

    def _paused(self, tx: bytes) -> bytes:
        at = max(1, self._place(tx))
        rx = super().transfer(tx[:at])
        self.sleep(self.rng.choice([0.0002, 0.0009, 0.0011, 0.003, 0.02]))
        return rx + super().transfer(tx[at:])

    def _garbage_sent(self, tx: bytes) -> bytes:
        return super().transfer(self.rng.bytes(len(tx)))

    def _garbage_command(self, tx: bytes) -> bytes:
        """What begins as a command, with anything after it."""
        mode = int(self.rng.integers(0, 4))
        command = b"ER" + self.rng.bytes(8) + bytes([mode]) + self.rng.bytes(2)
        if self.rng.integers(2):
            command = b"".join(
                (
                    *(b"ER", (200).to_bytes(4, "big"), (20000).to_bytes(4, "big"), bytes([mode])),
                    *((3).to_bytes(2, "big"), bytes([1]), self.rng.bytes(40)),
                )
            )
        return super().transfer((command + self.rng.bytes(len(tx)))[: len(tx)])

    def _reset(self, tx: bytes) -> bytes:
        at = max(1, self._place(tx))
        rx = super().transfer(tx[:at])
        self.machine.reset()
        return rx + super().transfer(tx[at:])


LINK_FAULTS = (
    *("bits flipped in", "bits flipped out", "bytes dropped", "bytes doubled", "truncated"),
    *("overlong", "paused", "stuck low", "stuck high", "bouncing", "garbage sent"),
)
"""Faults after which the device is still in stream mode."""

DEVICE_FAULTS = ("garbage command", "reset")
"""Faults after which it may not be: the host must begin anew."""


@dataclass
class Report:
    """What came of many faults.

    Parameters
    ----------
    faults : Counter
        How often each kind struck.
    lost : dict of str to list of int
        Read-outs of the time after a fault was over that did not arrive, for each of a kind.
    missing : dict of str to list of int
        Read-outs that did not arrive from the fault's beginning on, the one it struck included.
    silent : dict of str to list of float
        Virtual seconds from the fault to the next good frame.
    corrupt : int
        Frames that were delivered as good and are not what was digitised.
    """

    faults: Counter[str] = field(default_factory=Counter)
    lost: dict[str, list[int]] = field(default_factory=dict)
    missing: dict[str, list[int]] = field(default_factory=dict)
    silent: dict[str, list[float]] = field(default_factory=dict)
    corrupt: int = 0

    def __str__(self) -> str:
        lines = [f"{self.corrupt} corrupt frames delivered as good"]
        for kind, count in sorted(self.faults.items()):
            lost, silent = max(self.lost.get(kind, [0])), max(self.silent.get(kind, [0.0]))
            lines.append(f"{kind:18s} {count:5d} times, at most {lost} lost, {silent:.3f} s silent")
        return "\n".join(lines)


def torture(
    seed: int,
    faults: int,
    kinds: tuple[str, ...],
    *,
    between: int = 2,
    command: Command = STREAM,
) -> Report:
    """Let faults strike a running stream, and judge every frame that is delivered.

    Raises
    ------
    RuntimeError
        If the stream does not come back.
    """
    report = Report()
    with FaultyLink(seed) as link:
        frames = Capture(link, command, retries=8)
        first = next(frames)
        booted, before = _device_clock(link, first), first.sequence
        newest = first.sequence
        for _ in range(faults):
            kind = kinds[int(link.rng.integers(len(kinds)))]
            struck, start = link.struck[kind], link.machine.seconds
            link.strike(kind)
            try:
                delivered: list[Frame | SpikeFrame] = []
                for frame in islice(frames, between + 1):
                    report.corrupt += not _is_what_was_digitised(link, frame)
                    report.corrupt += frame.sequence <= newest
                    newest = frame.sequence
                    delivered.append(frame)
            except LinkError as error:
                raise RuntimeError(f"seed {seed}: no recovery from {kind!r}: {error}") from error
            silent = _silence(link, delivered, start)
            if link.struck[kind] > struck:
                missing = delivered[-1].sequence - before - len(delivered)
                report.missing.setdefault(kind, []).append(missing)
                report.lost.setdefault(kind, []).append(_lost(link, delivered, booted))
                report.silent.setdefault(kind, []).append(silent)
            before = delivered[-1].sequence
            link.fault = None
        report.faults = link.struck
    return report


def _device_clock(link: FaultyLink, frame: Frame | SpikeFrame) -> float:
    """Virtual time at which the device's clock was 0, from a frame that has just been read out."""
    readouts = link.machine.readouts
    last = readouts[readouts["sampled"] > 0][-2:]["transfer"] / CLOCK
    stamp = (frame.timestamp or 0) * 1e-9
    return float(min(last - stamp, key=abs))


def _is_what_was_digitised(link: FaultyLink, frame: Frame | SpikeFrame) -> bool:
    """Whether pixels (or spikes), LEDs and time are those of one read-out, not delivered before."""
    key = _source(link, frame) if isinstance(frame, SpikeFrame) else frame.pixels.tobytes()
    time, leds, _ = link.readouts.pop(key, (0.0, -1, None))
    on_the_way = link.machine.seconds - time
    return frame.leds == leds and 0 < on_the_way < 0.06


def _source(link: FaultyLink, frame: SpikeFrame) -> bytes:
    """The read-out that has these spikes, to the last bit, in the windows asked for."""
    place = [sum(1 << n for n in lit) for lit in SPIKES.sequence].index(frame.leds)
    for key, (_, leds, codes) in reversed(link.readouts.items()):
        if leds == frame.leds and frame.windows == SPIKES.windows[place]:
            expected = find_spikes(Frame(codes, leds=leds), frame.windows)
            if (expected.spikes, expected.dark_level) == (frame.spikes, frame.dark_level):
                return key if frame.spikes else b""
    return b""


def _lost(link: FaultyLink, delivered: list[Frame | SpikeFrame], booted: float) -> int:
    """Count the read-outs since the fault that are not among the frames delivered."""
    period = STREAM.icg_period / 4e6
    stamps = [booted + (frame.timestamp or 0) * 1e-9 for frame in delivered]
    after = [stamp for stamp in stamps if stamp > link.over]
    if not after:
        return 0
    return int((after[-1] - link.over) / period) - (len(after) - 1)


def _silence(link: FaultyLink, delivered: list[Frame | SpikeFrame], start: float) -> float:
    period = STREAM.icg_period / 4e6
    return link.machine.seconds - start - (len(delivered) - 1) * period
