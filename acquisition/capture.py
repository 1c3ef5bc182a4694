"""Capture: a command goes out, frames come in, and what happens on the wire is dealt with.

>>> from acquisition.capture import capture
>>> from acquisition.links import open_link
>>> from acquisition.protocol import Command
>>> with open_link("twin") as link:  # doctest: +SKIP
...     frames = list(capture(link, Command(sh_period=100, icg_period=30000, count=2)))
"""

from __future__ import annotations

import time
from collections import deque
from contextlib import closing, suppress
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final, Literal, Self

import numpy as np

from acquisition.frames import MASTER_CLOCK, Frame, FrameFlags, SpikeFrame
from acquisition.links import Link, LinkEnded, LinkError, LinkTimeout, pause
from acquisition.protocol import (
    ORIGINAL_SIZE,
    SIZES,
    STREAM_SIZE,
    BadChecksum,
    BadHeader,
    BadVersion,
    Command,
    DecodeError,
    Mode,
    Refusal,
    Status,
    decode_elements,
    decode_frame,
    decode_spikes,
)
from acquisition.wiring import PROTOCOL, WIRING

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
    from types import TracebackType

    from numpy.typing import NDArray

Firmware = Literal["linetrack", "original"]

_SLACK: Final = 0.25  # s; far more than a busy host needs to look at the line
_FLUSH: Final = PROTOCOL.flush_icg * PROTOCOL.flush_pulses  # clocks
_PERIODS: Final = 6  # read-outs that may pass between command and first frame
_QUIET: Final = 2e-6 * PROTOCOL.stream.stall_us  # s; the device gives a transfer up in half
_BREATH: Final = 1e-4  # s; after a transfer, until the device can take one that it did not offer
_RESET: Final = 1.2e-6 * PROTOCOL.stream.original_stall_us  # s; in original mode, too
_FRUITLESS: Final = 8  # transfers without a good frame before the command is sent again
_HELD: Final = 16  # frames of original mode held back until all have come
_SILENCE: Final = (4, 20e-3, 5e-3)  # read-outs, or s; slack, s: longer, no running stream is silent
_UNCONFIRMED: Final = 8  # frames until a command that nothing came of is sent again
_SEQUENCES: Final = 1 << 32
_SLICE: Final = 0.1  # s; how long an interruption may go unnoticed
_OLD: Final = PROTOCOL.stream.magic.to_bytes(2, "little") + bytes([PROTOCOL.stream.version])
_ZEROS: Final = {size: bytes(size) for size in SIZES}


class Refused(LinkError):  # noqa: N818
    """The device refuses the command.

    Parameters
    ----------
    reason : Refusal or None
        None: it does not say why.
    detail : str
    """

    def __init__(self, reason: Refusal | None, detail: str) -> None:
        super().__init__(reason, detail)
        self.reason = reason
        self.detail = detail

    def __str__(self) -> str:
        why = "it gives no reason" if self.reason is None else self.reason.name.lower()
        return f"the device refuses the command ({why}): {self.detail}"


@dataclass
class CaptureStatistics:
    """What a capture has met so far.

    Parameters
    ----------
    good : int
        Frames delivered without complaint.
    invalid : int
        Frames delivered with the flag `FrameFlags.INVALID`: in original mode, or so recorded.
    dropped : int
        Stream and spikes mode: read-outs missing in the sequence, lost by the device or on the link.
    corrupt : int
        Stream and spikes mode: transfers that arrived damaged; none of them is delivered.
    stale : int
        Stream and spikes mode: frames of an earlier command, or sent twice; not delivered either.
    timeouts : int
        Times the device did not offer anything in time.
    restarts : int
        Commands sent again.
    """

    good: int = 0
    invalid: int = 0
    dropped: int = 0
    corrupt: int = 0
    stale: int = 0
    timeouts: int = 0
    restarts: int = 0


def capture(link: Link, command: Command, **options: Any) -> Iterator[Any]:
    """Send a command and yield the frames that answer it.

    Parameters
    ----------
    link : Link
        Stays open. In which mode the device is does not matter.
    command : Command
    **options
        Those of `Capture`.

    Yields
    ------
    Frame, or in spikes mode SpikeFrame
        In original mode every one of them, those that contradict themselves with
        `FrameFlags.INVALID`; up to 16 are held back until all have come, since one that is missed
        would change the LEDs of the others: then they are asked for again. In stream mode only
        good ones. From a recording, LEDs, exposures and timestamp are the recorded ones.

    Raises
    ------
    LinkTimeout
        Nothing comes, in spite of repeated commands.
    Refused
        The device does not take the command.
    LinkError
        From the link.
    """
    frames = Capture(link, command, **options)
    return _closing(frames)


def _closing(frames: Capture) -> Iterator[Any]:
    with closing(frames):
        yield from frames


class Capture:
    """A capture under way: an iterator of frames that can be looked at and steered meanwhile.

    Used in a ``with`` statement it is closed in any case: a device in the middle of an endless
    stream is told to stop. The link stays open. In spikes mode the frames are `SpikeFrame`: see
    `SpikeCapture`. All that is said of stream mode holds there, too.

    Parameters
    ----------
    link : Link
        In which mode the device is does not matter.
    command : Command
    timeout : float, optional
        How long the device may be silent, s. By default six read-outs and a flush, and a quarter
        of a second for the host; while a stream runs, four read-outs or 20 ms. With
        ``await_sync``, the edge has to come within ``retries + 1`` times that.
    retries : int, optional
        How often a command is sent again before the capture fails. Counted anew after each good
        frame. Once frames have come, one sent again does not await an edge any more. None is sent
        again to a device that says that it waits for the edge.
    firmware : {"linetrack", "original"}, optional
        "original": the published one, which sends one frame more than asked for.
    master_clock : float, optional
        Of the sensor, Hz; by default the link's, or the prototype's.
    on_corrupt : callable, optional
        Called with the `DecodeError` of each damaged transfer in stream mode.

    Attributes
    ----------
    statistics : CaptureStatistics
    status : Status or None
        Stream mode: the device's last answer to a command, with its firmware's build.

    Raises
    ------
    ValueError
        An option is out of its range.
    """

    def __init__(
        self,
        link: Link,
        command: Command,
        *,
        timeout: float | None = None,
        retries: int = 3,
        firmware: Firmware = "linetrack",
        master_clock: int | None = None,
        on_corrupt: Callable[[DecodeError], None] | None = None,
    ) -> None:
        if timeout is not None and not timeout > 0:
            raise ValueError(f"timeout = {timeout} s: allowed is > 0; None is a fitting one")
        if retries < 0:
            raise ValueError(f"retries = {retries}: allowed is >= 0")
        if firmware not in ("linetrack", "original"):
            raise ValueError(f"firmware = {firmware!r}: allowed are 'linetrack' and 'original'")
        if firmware == "original" and command.mode is not Mode.ORIGINAL:
            raise ValueError("firmware = 'original': it has no stream mode")
        self.statistics = CaptureStatistics()
        self.status: Status | None = None
        self._link = link
        self._firmware = firmware
        default: int = getattr(link, "master_clock", MASTER_CLOCK)
        self._clock = default if master_clock is None else master_clock
        self._given_timeout = timeout
        self._retries = retries
        self._on_corrupt = on_corrupt
        self._interrupted = False
        self._attempts = 0
        self._number = -1  # of the last frame delivered
        self._lost = False
        # original mode
        self._missing = 0  # frames still to come of the command under way
        self._came: tuple[int, int] | None = None  # frames of the last command that came, asked for
        # stream mode
        self._await_sync = command.await_sync
        self._command = command  # whose LED sequence is in force
        self._pending: Command | None = None  # sent, without an answer yet
        self._queued: Command | None = None  # to be sent with the next transfer
        self._age = 0  # frames since the pending one was sent
        self._tries = 0  # how often that was
        self._doubtful = False  # its first frame may have been lost
        self._fruitless = 0
        self._started = False
        self._running = False  # the device goes on by itself
        self._expected: int | None = 0  # the next frame's sequence number; None: any
        self._base: int | None = 0  # the frame that the LED sequence began with; None: unknown
        self._settled = False  # a frame has come since the device's last (re)start
        self._refusal: Refusal | None = None
        self._denied = False  # a stream of before went on, with word of a refusal
        self._synced = False  # the command just sent awaits an edge
        self._waiting = False  # and the device has said that it does
        self._frames = self._original() if command.mode is Mode.ORIGINAL else self._stream()

    def __iter__(self) -> Self:
        return self

    def __next__(self) -> Frame:
        return next(self._frames)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """End the capture: an unfinished stream is stopped. The link stays open."""
        self._frames.close()

    def interrupt(self) -> None:
        """End the iteration soon, from another thread or a signal handler.

        A `next` that waits ends as after the last frame, within 0.2 s even if the device is
        silent; an unfinished stream is stopped. A second call does nothing.
        """
        self._interrupted = True  # no lock: a signal handler may run while one is held

    def _check(self) -> None:
        if self._interrupted:
            raise LinkEnded("the capture was interrupted")

    def _pause(self, seconds: float) -> None:
        pause(self._link, seconds)
        self._check()

    def _wait_ready(self, timeout: float) -> bool:
        """As the link's; where time is the host's, an interruption is noticed meanwhile."""
        self._check()
        step = timeout if hasattr(self._link, "sleep") else _SLICE
        while timeout > step:
            if self._link.wait_ready(step):
                return True
            timeout -= step
            self._check()
        ready = self._link.wait_ready(timeout)
        self._check()
        return ready

    @property
    def command(self) -> Command:
        """The command in force: the last one that the device has taken."""
        return self._command

    def send(self, change: Command | Sequence[Mapping[int, int]]) -> None:
        """Change the running stream, with the next transfer; it is not interrupted.

        The first frame exposed by it has `FrameFlags.CHANGED`. A command that is lost on the way
        is sent again. One is under way at a time: of those given meanwhile, the last one follows.

        Parameters
        ----------
        change : Command, or sequence of mapping of int to int
            A new command, or only a new LED sequence as in `Command`, in spikes mode for the whole
            line. Frames go on being counted: the capture ends after as many as it was begun for.

        Raises
        ------
        CommandError
            The sequence is not possible; in spikes mode, it has more entries than
            `acquisition.protocol.BRIEF_TABLE_MAX`.
        ValueError
            The capture is in original mode, or the command in another one than the capture.
        """
        mode = self._command.mode
        if mode is Mode.ORIGINAL:
            raise ValueError("original mode takes one command for each capture; use stream mode")
        if not isinstance(change, Command):
            change = replace(self._newest(), sequence=change, windows=())
        if change.mode is not mode:
            raise ValueError(
                f"a running capture in {mode.name.lower()} mode cannot go over to "
                f"{change.mode.name.lower()} mode; begin a new one"
            )
        change = replace(change, await_sync=False)
        change.encode(SIZES[mode])  # or raise, here where the command comes from
        self._queued = change
        if self._pending is None:
            self._tries = 0

    def _newest(self) -> Command:
        return self._queued or self._pending or self._command

    @property
    def _timeout(self) -> float:
        if self._given_timeout is not None:
            return self._given_timeout
        longest = max(self._command.icg_period, self._newest().icg_period)
        return _SLACK + (_FLUSH + _PERIODS * longest) / self._clock

    @property
    def _patience(self) -> float:
        """How long to wait in stream mode: one that runs offers a frame with every read-out."""
        if self._given_timeout is not None or not self._settled or self._pending is not None:
            return self._timeout
        readouts, shortest, slack = _SILENCE
        return max(readouts * self._command.icg_period / self._clock, shortest) + slack

    # --- original mode

    def _original(self) -> Generator[Frame]:
        """Hold frames back until all that the command asked for have come.

        Only its place among them tells which LED lit a frame, and a frame that is missed would
        give the others its place. Then those held back are asked for anew; at most the last 16,
        since the LEDs are for the last two: what came before them is unlit in any case.
        """
        total = self._command.count
        before: NDArray[np.uint16] | None = None
        held: deque[Frame] = deque()
        known = True
        try:
            while self._number + 1 < total:
                held.clear()
                known, self._missing = True, total - self._number - 1
                self._ask(self._missing)
                while self._missing and self._wait():
                    elements = decode_elements(self._link.transfer(_ZEROS[ORIGINAL_SIZE]))
                    twice = before is not None and np.array_equal(elements, before)
                    before, known = elements, known and not twice
                    held.append(self._judged(elements, twice=twice))
                    self._missing -= 1
                    if len(held) > _HELD or self._recorded is not None:
                        yield self._delivered(held.popleft(), known=known)
                asked = total - self._number - 1
                self._came = (len(held), asked) if held else None
                while held and not self._missing:
                    yield self._delivered(held.popleft(), known=known)
        except LinkEnded:
            while held:
                yield self._delivered(held.popleft(), known=False)

    @property
    def _recorded(self) -> Frame | None:
        """The frame just transferred as it was recorded, where the link is a recording."""
        recorded: Frame | None = getattr(self._link, "recorded", None)
        return recorded

    def _ask(self, count: int) -> None:
        """Send the command for that many frames; not before the device has forgotten the last."""
        if self._attempts:
            self._again()
        data = bytearray(replace(self._command, count=count).encode(ORIGINAL_SIZE))
        if self._firmware == "original":  # it sends one more
            data[11:13] = (count - 1).to_bytes(2, "big")
        self._pause(_BREATH)
        self._link.transfer(bytes(data))

    def _wait(self) -> bool:
        if self._wait_ready(self._timeout):
            return True
        self.statistics.timeouts += 1
        self._attempts += 1
        return False

    def _again(self) -> None:
        """Count a repetition of the command, and wait until the device is ready for it."""
        if self._attempts > self._retries:
            self._running = False
            raise LinkTimeout(self._explanation())
        self.statistics.restarts += 1
        self._lost = True
        self._pause(_RESET)

    def _explanation(self) -> str:
        found = self.statistics
        if self._waiting:
            return (
                f"no edge on the sync line within {self._attempts} times {self._timeout:.3g} s, "
                "though the device waits for one: is what drives the line wired to "
                f"{WIRING.pins['sync'].name}, with a common ground, and does it rise?"
            )
        if found.corrupt > found.timeouts:
            return (
                f"{found.corrupt} damaged transfers and no good one after the command was sent "
                f"{self._attempts} times: check MISO, MOSI, SCLK and ground, keep the wires short, "
                "and try a lower SPI clock; is this project's firmware on the microcontroller?"
            )
        if self._came is not None:
            return (
                f"only {self._came[0]} of {self._came[1]} frames came, though the command was sent "
                f"{self._attempts} times: is the host too slow for a frame every "
                f"{self._command.icg_period / self._clock:.3g} s? Give a longer ICG period (-i), "
                "or use stream mode, which numbers its frames"
            )
        return (
            f"no frame within {self._timeout:.3g} s, though the command was sent "
            f"{self._attempts} times: is the microcontroller powered and flashed, are PB2 and the "
            "handshake input, MOSI, SCLK and ground wired as the README's table says, and is SPI "
            "on (dtparam=spi=on in /boot/firmware/config.txt)?"
        )

    def _judged(self, elements: NDArray[np.uint16], *, twice: bool) -> Frame:
        """Make a frame of the elements; which number and which LEDs it has is not known yet."""
        frame = self._recorded or Frame(
            elements,
            sh_period=self._command.sh_period,
            icg_period=self._command.icg_period,
            master_clock=self._clock,
        )
        frame = frame.replaced(utc_ns=time.time_ns(), monotonic_ns=time.monotonic_ns())
        reasons = frame.invalid()
        if twice:
            reasons.append(
                "the same as the frame before, to the last bit: it was read twice; does the "
                "handshake line follow the device?"
            )
        if not reasons:
            return frame
        return replace(frame, flags=frame.flags | FrameFlags.INVALID, reasons=tuple(reasons))

    def _delivered(self, frame: Frame, *, known: bool) -> Frame:
        """Number a frame of original mode; known: its place tells its LEDs."""
        self._number += 1
        self._attempts = 0
        self._count(frame.flags)
        flags = frame.flags | self._lost_flag()
        if self._recorded is not None:
            return frame.replaced(sequence=self._number, flags=flags)
        exposures = self._command.leds(self._number) if known else {}
        return frame.replaced(
            sequence=self._number,
            leds=_mask(exposures),
            exposures=exposures,
            flags=flags if known else flags | FrameFlags.LOST,
        )

    def _count(self, flags: FrameFlags) -> None:
        if flags & FrameFlags.INVALID:
            self.statistics.invalid += 1
        else:
            self.statistics.good += 1

    def _lost_flag(self) -> FrameFlags:
        lost, self._lost = self._lost, False
        return FrameFlags.LOST if lost else FrameFlags.NONE

    # --- stream mode

    def _stream(self) -> Generator[Any]:
        total = self._command.count
        try:
            with suppress(LinkEnded):
                self._issue(self._newest())
                while total == 0 or self._number + 1 < total:
                    frame = self._next_frame()
                    if frame is not None:
                        yield frame
        finally:
            if self._running:
                self._stop()

    def _issue(self, command: Command) -> None:
        """Send a whole command to a device in whatever mode."""
        self._pending, self._queued, self._age, self._tries = command, None, 0, 1
        self._settled = False
        self._pause(_BREATH)
        self._running = True
        # once frames have come, a restart does not wait for another edge, which may never come
        self._synced, self._waiting = self._await_sync and self._number < 0, False
        command = replace(command, count=self._left(), await_sync=self._synced)
        self._link.transfer(command.encode(ORIGINAL_SIZE))

    def _left(self) -> int:
        """How many frames are still to come; 0 if there is no end."""
        total = self._command.count
        return max(1, total - self._number - 1) if total else 0

    def _repeat(self) -> None:
        """Send the newest command again, as if nothing was known of the device."""
        self._attempts += 1
        if self._attempts > self._retries and self._refusal is not None:
            raise Refused(self._refusal, "sent several times, it was refused each time")
        self._again()
        self._fruitless = 0
        self._doubtful = True
        self._issue(self._newest())

    def _next_frame(self) -> Frame | SpikeFrame | None:
        """Do one transfer; None if it brought no frame to deliver."""
        link, statistics = self._link, self.statistics
        ready = self._wait_ready(self._patience)
        statistics.timeouts += not ready
        # A stream that ran until now may have a frame though the line is stuck: look, once.
        stuck = not ready and self._started and self._fruitless == 0
        if self._waiting and not ready:
            self._attempts += 1
            if self._attempts > self._retries:
                raise LinkTimeout(self._explanation())
            stuck, self._fruitless = True, 0  # ask whether it still waits
        if not (ready or stuck) or self._fruitless >= _FRUITLESS:
            self._repeat()
            return None
        self._fruitless += 1
        data = link.transfer(self._outgoing())
        utc_ns, monotonic_ns = time.time_ns(), time.monotonic_ns()
        try:
            item = (decode_spikes if self._command.mode is Mode.SPIKES else decode_frame)(
                data, master_clock=self._clock, utc_ns=utc_ns, monotonic_ns=monotonic_ns
            )
        except (BadVersion, BadHeader) as error:
            raise LinkError(f"the device sends what this program does not know: {error}") from error
        except DecodeError as error:
            if isinstance(error, BadChecksum) and self._refused_by_older(data):
                return None
            statistics.corrupt += 1
            self._lost = self._doubtful = True
            if self._on_corrupt is not None:
                self._on_corrupt(error)
            if stuck:
                self._repeat()
            else:
                self._pause(_QUIET)
            return None
        if isinstance(item, Status):
            self._answered(item)
            return None
        return self._accepted(item)

    def _refused_by_older(self, data: bytes) -> bool:
        """Whether older firmware, which knows no spikes mode, refuses it in frames of stream mode.

        Of such a frame only the beginning has come, but it is sent once more.
        """
        if self._command.mode is not Mode.SPIKES or self._started or not data.startswith(_OLD):
            return False
        self._pause(_QUIET)
        try:
            item = decode_frame(self._link.transfer(_ZEROS[STREAM_SIZE]), master_clock=self._clock)
        except DecodeError:
            return False
        if isinstance(item, Status):
            if item.refusal is Refusal.NONE:
                return False
            self._answered(item)
            return True
        return self._denied_by(item)

    def _denied_by(self, frame: Frame | SpikeFrame) -> bool:
        """Whether a stream that ran before goes on, and says that the command was refused.

        As with an answer, only the second one is believed.
        """
        if self._started or self._pending is None or not frame.flags & FrameFlags.REFUSED:
            return False
        self.statistics.stale += 1
        if self._denied:
            raise Refused(
                None,
                "what it did before goes on; do firmware and host program come from the same "
                "release?",
            )
        self._denied = True
        self._repeat()
        return True

    def _outgoing(self) -> bytes:
        """Return what to send while reading: the command queued, or zeros."""
        queued = self._queued
        if queued is None or self._pending is not None or not self._settled:
            return _ZEROS[self._command.size]
        self._pending, self._queued, self._age = queued, None, 0
        self._doubtful &= self._tries > 0
        self._tries += 1
        return replace(queued, count=self._left()).encode(queued.size)

    def _answered(self, status: Status) -> None:
        """Take the device's answer to a command."""
        self.status = status
        if status.refusal is not Refusal.NONE:
            self._refuse(status)
            return
        if self._pending is None:
            return  # it has nothing else to send
        self._confirm(0)  # sequence numbers and LED sequence begin together
        self._waiting = self._synced
        self._started, self._settled = True, False
        self._expected = 0 if self._number < 0 else None

    def _confirm(self, base: int | None) -> None:
        """Note that the device has taken the command, with the frame of that sequence number."""
        if self._pending is not None:
            # the number of frames to deliver is the capture's, whatever a change says
            self._command = replace(self._pending, count=self._command.count)
            self._tries = 0
        self._refusal = None
        self._pending, self._base, self._doubtful = None, base, False

    def _resend(self, reason: str) -> None:
        """Send the pending command with the next transfer once more."""
        if self._tries > self._retries:
            raise Refused(None, reason)
        self._queued, self._pending = self._newest(), None
        self.statistics.restarts += 1

    def _refuse(self, status: Status) -> None:
        """A refusal may be the link's fault: only the second one of a kind is believed."""
        reason, before = status.refusal, self._refusal
        self._refusal = reason
        if reason is before and reason is not Refusal.CHECKSUM:
            raise Refused(
                reason,
                f"it stays at -s {status.sh_period} -i {status.icg_period}; its firmware is "
                f"{status.firmware!r}: do firmware and host program come from the same release?",
            )
        self._repeat()

    def _accepted(self, frame: Frame | SpikeFrame) -> Frame | SpikeFrame | None:
        """Number a good frame and tell its exposures; None if it is none of this capture's."""
        if self._denied_by(frame):
            return None
        self._waiting = False
        changed = bool(frame.flags & FrameFlags.CHANGED)
        if changed:
            anew = not self._started or self._pending is not None
            if anew and (not self._started or self._behind(frame)):
                self._expected = None
            self._started = True
            if anew:
                # if frames were dropped, the flag may be that of an earlier one
                dropped = frame.flags & FrameFlags.DROPPED
                self._confirm(None if dropped else frame.sequence)
        elif self._pending is not None:
            self._age += 1
            if frame.flags & FrameFlags.REFUSED:
                self._resend("its frames go on as before")
            elif self._age > _UNCONFIRMED:
                self._resend("its frames go on as if nothing had been sent")
        if not self._started or self._behind(frame):
            self.statistics.stale += 1
            return None
        self._settled = True
        gap = 0 if self._expected is None else (frame.sequence - self._expected) % _SEQUENCES
        self._expected = (frame.sequence + 1) % _SEQUENCES
        self._number += 1 + gap
        total = self._command.count
        self._running = not (total and self._number + 1 >= total)
        if total and self._number >= total:
            return None
        self._attempts = self._fruitless = 0
        statistics = self.statistics
        statistics.dropped += gap
        if gap:
            self._doubtful = True
            self._lost |= not frame.flags & FrameFlags.DROPPED
        exposures, timestamp, flags = self._exposures(frame), frame.timestamp, frame.flags
        if (recorded := self._recorded) is not None:
            exposures, timestamp = recorded.exposures, recorded.timestamp
            flags |= recorded.flags
        self._count(flags)
        return frame.replaced(
            sequence=self._number,
            exposures=exposures,
            timestamp=timestamp,
            flags=flags | self._lost_flag(),
        )

    def _behind(self, frame: Frame | SpikeFrame) -> bool:
        """Whether a frame of this number has been delivered already."""
        if self._expected is None:
            return False
        return (frame.sequence - self._expected) % _SEQUENCES >= _SEQUENCES // 2

    def _exposures(self, frame: Frame | SpikeFrame) -> Mapping[int, int]:
        """Find the frame in the LED sequence: at its place, or else the only one that fits.

        The device sends the mask alone. Where a new sequence may be in force already without its
        first frame having come, and both could have lit these LEDs, the exposure is unknown.
        """
        sequence = self._command.sequence
        known = [*sequence]
        if self._base is not None:
            place = sequence[(frame.sequence - self._base) % _SEQUENCES % len(sequence)]
            known = [place] if _mask(place) == frame.leds else known
        change = self._pending or self._queued
        if change is not None and (self._doubtful or len(known) > 1):
            known += change.sequence
        fitting = {tuple(lit.items()) for lit in known if _mask(lit) == frame.leds}
        return dict(fitting.pop()) if len(fitting) == 1 else {}

    def _stop(self) -> None:
        """Leave the device with its LEDs off: one more unlit frame, and no other."""
        self._running = False
        last = replace(self._command, count=1, sequence=[{}], windows=(), await_sync=False)
        with suppress(LinkError, OSError):
            pause(self._link, _QUIET)
            longest = _SLICE if self._interrupted else float("inf")
            self._link.wait_ready(min(2 * self._command.icg_period / self._clock, longest))
            self._link.transfer(last.encode(last.size))


class SpikeCapture(Capture):
    """A `Capture` in spikes mode, for type checkers: its frames are `SpikeFrame`.

    Raises
    ------
    ValueError
        The command is in another mode.
    """

    def __init__(self, link: Link, command: Command, **options: Any) -> None:
        if command.mode is not Mode.SPIKES:
            raise ValueError(f"mode = {command.mode.name}: Mode.SPIKES is needed here")
        super().__init__(link, command, **options)

    def __next__(self) -> SpikeFrame:  # type: ignore[override]
        return super().__next__()  # type: ignore[return-value]


def _mask(lit: Mapping[int, int]) -> int:
    return sum(1 << channel for channel in lit)
