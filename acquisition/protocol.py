"""The bytes on the wire: commands to the microcontroller, frames from it, their checksum.

Three framings share the command. In *original* mode every transfer has 7388 bytes, the elements of
one read-out, low byte first, with neither header nor checksum. In *stream* mode every transfer has
7424 bytes: a header of 32 bytes, the elements and a checksum, all little-endian. In *spikes* mode
it has 256: the same header, what the firmware found in the elements, and a checksum.

The checksum is that of the microcontroller's CRC unit: CRC-32/MPEG-2 (polynomial 0x04C11DB7,
initial value 0xFFFFFFFF, nothing reflected, nothing inverted) over 32-bit words, where a word is
read from memory in little-endian order. The single word 0x12345678 gives 0xDF8A8A2B.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from itertools import pairwise
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from acquisition.frames import (
    CHANNELS,
    ELEMENTS,
    FULL_SCALE,
    MASTER_CLOCK,
    PIXELS,
    Frame,
    FrameFlags,
    OnboardSpike,
    SpikeFrame,
)
from acquisition.wiring import PROTOCOL, WIRING

if TYPE_CHECKING:
    from numpy.typing import NDArray

_STREAM: Final = PROTOCOL.stream
_SPIKES: Final = PROTOCOL.spikes

ORIGINAL_SIZE: Final = PROTOCOL.original_size
"""Bytes of every transfer in original mode."""
STREAM_SIZE: Final = _STREAM.frame_size
"""Bytes of every transfer in stream mode."""
SPIKES_SIZE: Final = PROTOCOL.spikes.frame_size
"""Bytes of every transfer in spikes mode."""
SIZES: Final = (ORIGINAL_SIZE, STREAM_SIZE, SPIKES_SIZE)
"""Bytes of a transfer by `Mode`."""
SPIKES_MAX: Final = PROTOCOL.spikes.spikes_max
"""Largest number of spikes in a frame."""
WINDOWS_MAX: Final = PROTOCOL.spikes.windows_max
"""Largest number of windows of a frame."""
WINDOW_MIN: Final = PROTOCOL.spikes.window_min
"""Shortest window, pixels."""
FULL_WINDOW: Final = (0, PIXELS - 1)
"""The window that is the whole line."""
SATURATED: Final = 1900
"""Light with which a pixel counts as full by default, counts below dark, as in `Correction`."""
BRIEF_TABLE_MAX: Final = (SPIKES_SIZE - _SPIKES.table_at - 4) // _SPIKES.entry_size
"""Largest number of entries that a running capture in spikes mode can be sent."""
COMMAND_MAGIC: Final = bytes(PROTOCOL.command_magic)
"""What a command begins with."""
SH_MIN: Final = PROTOCOL.sh_min
"""Shortest SH period, in master clocks."""
ICG_MIN: Final = PROTOCOL.icg_min
"""Shortest ICG period, in master clocks."""
COUNT_MAX: Final = 0xFFFF
"""Largest number of frames that a command can ask for."""
TABLE_MAX: Final = _STREAM.table_max
"""Largest number of entries of an LED sequence."""
CHAIN_FIRST: Final = WIRING.leds.chain_first
"""The first LED channel on the chain of shift registers."""
EXPOSURE_MIN: Final = PROTOCOL.stream.exposure_min
"""Shortest exposure of an LED, master clocks."""
CHAIN_STEP: Final = WIRING.leds.chain_step
"""Master clocks between two steps of the chain: it has to shift the next pattern in."""
LAST_TWO: Final = WIRING.leds.last_two
"""The LED channels of the last two frames in original mode."""

_U32_MAX: Final = 0xFFFF_FFFF
_EXTENSION: Final = _STREAM.table_at  # bytes before the table
_CONTINUES: Final = _STREAM.exposure_continues
_HEADER: Final = struct.Struct("<HBBIQQII")
_ENTRY: Final = struct.Struct("<QI")
_STATUS: Final = struct.Struct("<II32s")
_WINDOWED_ENTRY: Final = struct.Struct("<QIHH")
_LIMITS: Final = struct.Struct("<HH")
_FOUND: Final = struct.Struct("<BBHI")
_WINDOW: Final = struct.Struct("<HH")
_SPIKE: Final = struct.Struct("<IHHBB2x")
_NO_WINDOW: Final = (_SPIKES.no_window, _SPIKES.no_window)
_AWAIT_SYNC: Final = PROTOCOL.options["await_sync"]
_BRIEF: Final = PROTOCOL.options["brief"]
_SPIKE_FLAGS: Final = sum(_SPIKES.flags.values())
_STATUS_FLAG: Final = int(FrameFlags.STATUS)
_KNOWN_FLAGS: Final = int(
    FrameFlags.DROPPED | FrameFlags.CHANGED | FrameFlags.REFUSED | FrameFlags.STATUS
)
_REVERSED: Final = bytes(int(f"{byte:08b}"[::-1], 2) for byte in range(256))


class Mode(IntEnum):
    """What a command asks for, its byte 10."""

    ORIGINAL = PROTOCOL.modes["original"]
    STREAM = PROTOCOL.modes["stream"]
    SPIKES = PROTOCOL.modes["spikes"]
    """As stream mode, but frames are the spikes that the firmware found: `SpikeFrame`."""


class Refusal(IntEnum):
    """Why the microcontroller did not take a command."""

    NONE = _STREAM.refusals["none"]
    VERSION = _STREAM.refusals["version"]
    CHECKSUM = _STREAM.refusals["checksum"]
    PERIODS = _STREAM.refusals["periods"]
    TABLE = _STREAM.refusals["table"]
    MODE = _STREAM.refusals["mode"]


class CommandError(ValueError):
    """A command that the microcontroller would refuse.

    Parameters
    ----------
    message : str
    refusal : Refusal
        With what reason it would.
    """

    def __init__(self, message: str, refusal: Refusal) -> None:
        super().__init__(message)
        self.refusal = refusal

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (str(self), self.refusal)


class DecodeError(ValueError):
    """Bytes that are not what they should be."""


class ShortFrame(DecodeError):  # noqa: N818
    """More or fewer bytes than a transfer of this framing has."""


class BadMagic(DecodeError):  # noqa: N818
    """No frame (or command) begins where one should."""


class BadChecksum(DecodeError):  # noqa: N818
    """Bytes were changed on the way."""


class BadVersion(DecodeError):  # noqa: N818
    """An intact frame (or command) of a format unknown here."""


class BadHeader(DecodeError):  # noqa: N818
    """An intact frame whose header contradicts itself."""


def crc32_words(data: bytes | bytearray | memoryview) -> int:
    """Checksum of the microcontroller's CRC unit over little-endian 32-bit words.

    Parameters
    ----------
    data : bytes-like
        Its length is a multiple of 4.

    Returns
    -------
    int
        CRC-32/MPEG-2, fed the words from their most significant byte on.

    Raises
    ------
    ValueError
        The length is not a multiple of 4.
    """
    if len(data) % 4:
        raise ValueError(
            f"{len(data)} bytes: the unit takes words of 4 bytes; was the checksum itself included "
            "or a byte lost?"
        )
    # zlib's CRC has the same polynomial, but takes each byte from its lowest bit on: reverse the
    # bits of each word, and those of the result
    words = np.frombuffer(data, "<u4").byteswap().tobytes()
    return _reverse32(~zlib.crc32(words.translate(_REVERSED)))


def _reverse32(word: int) -> int:
    """Reverse the order of 32 bits."""
    return int.from_bytes((word & _U32_MAX).to_bytes(4, "little").translate(_REVERSED), "big")


@dataclass(frozen=True)
class Command:
    """What the sensor shall do, checked: a `Command` that exists is one the device accepts.

    Parameters
    ----------
    sh_period : int
        Time that the sensor gathers light, in master clocks (0.25 µs at 4 MHz), 40 or more.
    icg_period : int
        Time from read-out to read-out, in master clocks, a multiple of the SH period, 14776 or
        more.
    count : int
        Frames, 1 to 65535; in stream mode 0 means endless.
    mode : Mode, optional
    sequence : sequence of mapping of int to int, optional
        Stream and spikes mode: which LEDs are lit during each frame, over and over. One mapping
        for each frame, from channel (0 to 5 on pins, 6 to 63 on the chain) to the LED's time in
        master clocks, 10 up to the SH period, at the end of the integration; an empty mapping is
        an unlit frame. Without any, one LED each in turn, for the whole integration: the two that
        original mode lights.
    windows : sequence of sequence of tuple of int, optional
        Spikes mode: where spikes are looked for in each frame of the sequence, as first and last
        pixel, 24 pixels at least; 8 windows a frame at most, which do not overlap. An empty one,
        or none given, is the whole line, (0, 3647).
    saturated : int, optional
        Spikes mode: the light with which a pixel is full, in counts below the dark reference; 0 if
        that is unknown.
    threshold : int, optional
        Spikes mode: the light that a spike must have at least, in counts summed over 8 pixels;
        0: above the noise.
    await_sync : bool, optional
        Stream and spikes mode: begin with the next rising edge on the line `sync`, so that all
        microcontrollers that see it read out together. Until then no frame comes.

    Raises
    ------
    CommandError
        A value is out of its range.
    """

    sh_period: int
    icg_period: int
    count: int
    mode: Mode = Mode.ORIGINAL
    sequence: Sequence[Mapping[int, int]] = field(default=())
    windows: Sequence[Sequence[tuple[int, int]]] = field(default=())
    saturated: int = SATURATED
    threshold: int = 0
    await_sync: bool = False

    def __post_init__(self) -> None:
        check_periods(self.sh_period, self.icg_period)
        if self.mode not in tuple(Mode):
            raise CommandError(
                f"mode = {self.mode!r}: allowed are Mode.ORIGINAL, Mode.STREAM and Mode.SPIKES",
                Refusal.MODE,
            )
        object.__setattr__(self, "mode", Mode(self.mode))
        lowest = 1 if self.mode is Mode.ORIGINAL else 0
        count = _whole("count (-n)", self.count, Refusal.PERIODS)
        if not lowest <= count <= COUNT_MAX:
            raise CommandError(
                f"-n {count}: allowed are {lowest} to {COUNT_MAX} frames"
                + ("" if lowest == 0 or count else "; only stream mode can go on without end"),
                Refusal.PERIODS,
            )
        if self.mode is Mode.ORIGINAL and len(self.sequence):
            raise CommandError(
                "sequence: original mode lights its two LEDs itself; was stream mode meant?",
                Refusal.MODE,
            )
        if self.mode is Mode.ORIGINAL and self.await_sync:
            raise CommandError(
                "await_sync: original mode begins at once; was stream mode meant?", Refusal.MODE
            )
        if self.mode is not Mode.SPIKES and len(self.windows):
            raise CommandError(
                "windows: only spikes mode has them; was Mode.SPIKES meant?", Refusal.MODE
            )
        for name in ("saturated", "threshold"):
            value = _whole(name, getattr(self, name), Refusal.TABLE)
            if not 0 <= value <= FULL_SCALE:
                raise CommandError(
                    f"{name} = {value}: allowed are 0 to {FULL_SCALE} counts", Refusal.TABLE
                )
        object.__setattr__(self, "sequence", self._checked_sequence())
        object.__setattr__(self, "windows", self._checked_windows())
        entries = len(self._table())
        if entries > TABLE_MAX:
            raise CommandError(
                f"sequence: its {len(self.sequence)} frames need {entries} entries, one for each "
                f"different exposure or window of a frame; the device's table holds {TABLE_MAX}",
                Refusal.TABLE,
            )

    def _checked_sequence(self) -> tuple[dict[int, int], ...]:
        if self.mode is Mode.ORIGINAL:
            return ()
        longest = min(self.sh_period, _CONTINUES - 1)
        given = self.sequence if len(self.sequence) else [{n: longest} for n in LAST_TWO]
        return tuple(_checked_exposures(n, lit, self.sh_period) for n, lit in enumerate(given))

    def _checked_windows(self) -> tuple[tuple[tuple[int, int], ...], ...]:
        if self.mode is not Mode.SPIKES:
            return ()
        given = self.windows if len(self.windows) else [()] * len(self.sequence)
        if len(given) != len(self.sequence):
            raise CommandError(
                f"windows: {len(given)} for a sequence of {len(self.sequence)} frames; each frame "
                "has its own",
                Refusal.TABLE,
            )
        return tuple(
            check_windows(of_frame, f"windows[{n}]") if len(of_frame) else (FULL_WINDOW,)
            for n, of_frame in enumerate(given)
        )

    @property
    def size(self) -> int:
        """Bytes of one transfer in this command's mode."""
        return SIZES[self.mode]

    def frame_rate(self, master_clock: int = MASTER_CLOCK) -> float:
        """Read-outs per second at a master clock in Hz."""
        return master_clock / self.icg_period

    def leds(self, index: int) -> Mapping[int, int]:
        """Tell which LEDs are lit during a frame.

        Parameters
        ----------
        index : int
            Of the frame, from 0.

        Returns
        -------
        mapping of int to int
            Exposure in master clocks by LED channel.
        """
        if self.mode is not Mode.ORIGINAL:
            return self.sequence[index % len(self.sequence)]
        remaining = self.count - 1 - index
        return {LAST_TWO[1 - remaining]: self.sh_period} if 0 <= remaining <= 1 else {}

    def encode(self, size: int | None = None) -> bytes:
        """Encode for one transfer.

        Parameters
        ----------
        size : int, optional
            Length of the transfer, filled up with zeros: 7388 when the device is in original mode
            or its mode is unknown (the default), 7424 when it is in stream mode, 256 in spikes
            mode.

        Returns
        -------
        bytes

        Raises
        ------
        CommandError
            It does not fit into a transfer of 256 bytes.
        """
        size = ORIGINAL_SIZE if size is None else size
        if size not in SIZES:
            raise ValueError(
                f"size = {size}: transfers have {ORIGINAL_SIZE} bytes in original mode, "
                f"{STREAM_SIZE} in stream mode and {SPIKES_SIZE} in spikes mode"
            )
        result = (
            COMMAND_MAGIC
            + struct.pack(">IIBH", self.sh_period, self.icg_period, self.mode, self.count)
        )  # fmt: skip
        if self.mode is not Mode.ORIGINAL:
            table = self._table()
            options = _AWAIT_SYNC if self.await_sync else 0
            options |= _BRIEF if size == SPIKES_SIZE else 0
            plain = self.mode is Mode.STREAM and not options
            result += bytes([_STREAM.version if plain else _SPIKES.version, len(table), options])
            if self.mode is Mode.SPIKES:
                result += _LIMITS.pack(self.saturated, self.threshold)
            result += b"".join(table)
            result += crc32_words(result).to_bytes(4, "little")
        if len(result) > size:
            raise CommandError(
                f"sequence: its {len(table)} entries do not fit into a transfer of spikes mode, "
                f"{size} bytes; a running stream takes fewer, a new capture up to {TABLE_MAX}",
                Refusal.TABLE,
            )
        return result.ljust(size, b"\0")

    def _table(self) -> list[bytes]:
        if self.mode is not Mode.SPIKES:
            return [_ENTRY.pack(*entry) for lit in self.sequence for entry in _entries(_steps(lit))]
        table = []
        for lit, windows in zip(self.sequence, self.windows, strict=True):
            steps = _steps(lit)
            steps += [(0, 0)] * (len(windows) - len(steps))
            unused = [_NO_WINDOW] * (len(steps) - len(windows))
            for entry, window in zip(_entries(steps), [*windows, *unused], strict=True):
                table.append(_WINDOWED_ENTRY.pack(*entry, *window))
        return table

    @classmethod
    def decode(cls, data: bytes | bytearray | memoryview) -> Command:
        """Decode what a host sent, as the device does.

        Parameters
        ----------
        data : bytes-like
            A transfer, or its beginning.

        Returns
        -------
        Command

        Raises
        ------
        BadMagic
            It is no command: a plain read.
        CommandError
            It is a command that the device refuses; ``refusal`` says why.
        """
        data = bytes(data)
        if data[:2] != COMMAND_MAGIC:
            raise BadMagic(f"begins with {data[:2]!r}, not {COMMAND_MAGIC!r}: no command")
        if len(data) < _EXTENSION:
            raise ShortFrame(f"{len(data)} bytes: a command has {_EXTENSION} at least")
        sh_period, icg_period, mode, count = struct.unpack_from(">IIBH", data, 2)
        if mode == Mode.ORIGINAL:
            return cls(sh_period, icg_period, count)
        version, entries, options = data[13], data[14], data[15]
        if version not in (_STREAM.version, _SPIKES.version) or (
            version == _STREAM.version and (mode == Mode.SPIKES or options)
        ):
            raise CommandError(
                f"extension version {version}: known are {_STREAM.version}, without windows and "
                f"options, and {_SPIKES.version}",
                Refusal.VERSION,
            )
        known = _AWAIT_SYNC | (_BRIEF if mode == Mode.SPIKES else 0)
        if options & ~known:
            raise CommandError(
                f"options {options:#04x}: known are {known:#04x}, with {_BRIEF:#04x} in spikes mode "
                "only",
                Refusal.VERSION,
            )
        if not 1 <= entries <= TABLE_MAX:
            raise CommandError(f"{entries} entries: allowed are 1 to {TABLE_MAX}", Refusal.TABLE)
        start = _SPIKES.table_at if mode == Mode.SPIKES else _EXTENSION
        entry = _WINDOWED_ENTRY if mode == Mode.SPIKES else _ENTRY
        end = start + entries * entry.size
        if len(data) < end + 4:
            raise ShortFrame(f"{len(data)} bytes: {entries} entries need {end + 4}")
        crc = int.from_bytes(data[end : end + 4], "little")
        if crc != crc32_words(data[:end]):
            raise CommandError("the checksum differs: bytes were changed", Refusal.CHECKSUM)
        sync = bool(options & _AWAIT_SYNC)
        table = list(entry.iter_unpack(data[start:end]))
        if mode == Mode.STREAM:
            sequence = _sequence(table)
            return cls(sh_period, icg_period, count, Mode.STREAM, sequence, await_sync=sync)
        if mode != Mode.SPIKES:
            raise CommandError(f"mode {mode}: known are 0, 1 and {Mode.SPIKES.value}", Refusal.MODE)
        saturated, threshold = _LIMITS.unpack_from(data, _EXTENSION)
        return cls(
            *(sh_period, icg_period, count, Mode.SPIKES),
            sequence=_sequence([found[:2] for found in table]),
            windows=_windows(table),
            saturated=saturated,
            threshold=threshold,
            await_sync=sync,
        )


def check_periods(sh_period: int, icg_period: int) -> None:
    """Refuse periods that the device would refuse.

    Parameters
    ----------
    sh_period, icg_period : int
        In master clocks.

    Raises
    ------
    CommandError
        Names the value, what is allowed and the likely mistake.
    """
    sh = _whole("SH period (-s)", sh_period, Refusal.PERIODS)
    icg = _whole("ICG period (-i)", icg_period, Refusal.PERIODS)
    swapped = "; are -i and -s swapped?" if icg < sh else ""
    if icg < ICG_MIN:
        raise CommandError(
            f"-i {icg} is below {ICG_MIN}, the clocks that a read-out takes{swapped}",
            Refusal.PERIODS,
        )
    if icg > _U32_MAX:
        raise CommandError(f"-i {icg} is above {_U32_MAX}, the largest value", Refusal.PERIODS)
    if sh < SH_MIN:
        raise CommandError(
            f"-s {sh} is below {SH_MIN}, the sensor's shortest integration", Refusal.PERIODS
        )
    if icg % sh:
        lower, upper = icg - icg % sh, icg - icg % sh + sh
        near = f"{lower} or {upper}" if lower >= ICG_MIN else str(-(-ICG_MIN // sh) * sh)
        raise CommandError(
            f"-i {icg} is no multiple of -s {sh}: with this -s, -i may be {near}"
            if icg > sh
            else f"-i {icg} is below -s {sh}, of which it must be a multiple{swapped}",
            Refusal.PERIODS,
        )


def _whole(name: str, value: Any, refusal: Refusal) -> int:
    if isinstance(value, bool | np.bool_) or not isinstance(value, int | np.integer):
        raise CommandError(f"{name} = {value!r}: a whole number is needed", refusal)
    return int(value)


def _checked_exposures(frame: int, lit: Any, sh_period: int) -> dict[int, int]:
    """Check one frame of a sequence; its LEDs in rising order, without those that stay dark."""
    if not isinstance(lit, Mapping):
        raise CommandError(
            f"sequence[{frame}] = {lit!r}: a mapping from LED channel to exposure in master clocks "
            "is needed",
            Refusal.TABLE,
        )
    result = {}
    for channel, exposure in lit.items():
        name = f"sequence[{frame}]"
        number = _whole(f"channel of {name}", channel, Refusal.TABLE)
        clocks = _whole(f"{name}[{number}]", exposure, Refusal.TABLE)
        if not 0 <= number < CHANNELS:
            raise CommandError(
                f"{name}: LED {number}: allowed are channels 0 to {CHANNELS - 1}; was a mask given?",
                Refusal.TABLE,
            )
        if clocks and not EXPOSURE_MIN <= clocks <= min(sh_period, _CONTINUES - 1):
            raise CommandError(
                f"{name}[{number}] = {clocks} clocks: allowed are 0 (dark) and {EXPOSURE_MIN} up "
                f"to the SH period, {sh_period}; light outside the integration is not seen",
                Refusal.TABLE,
            )
        if clocks:
            result[number] = clocks
    steps = sorted({clocks for number, clocks in result.items() if number >= CHAIN_FIRST})
    for first, second in pairwise(steps):
        if second - first < CHAIN_STEP:
            raise CommandError(
                f"sequence[{frame}]: LEDs of the chain (channels {CHAIN_FIRST} and up) go on "
                f"{second} and {first} clocks before the end; there must be {CHAIN_STEP} between",
                Refusal.TABLE,
            )
    return dict(sorted(result.items()))


def _steps(lit: Mapping[int, int]) -> list[tuple[int, int]]:
    """Return (mask, exposure) by falling exposure; one unlit step for an unlit frame."""
    masks: dict[int, int] = {}
    for channel, exposure in lit.items():
        masks[exposure] = masks.get(exposure, 0) | 1 << channel
    return [(masks[e], e) for e in sorted(masks, reverse=True)] or [(0, 0)]


def _entries(steps: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """Mark all but the last step of a frame as followed by another one."""
    return [(mask, exposure | _CONTINUES) for mask, exposure in steps[:-1]] + steps[-1:]


def check_windows(
    windows: Sequence[tuple[int, int]], name: str = "windows"
) -> tuple[tuple[int, int], ...]:
    """Refuse windows of a frame that the device would refuse.

    Parameters
    ----------
    windows : sequence of tuple of int
        First and last pixel of each.
    name : str, optional
        What errors call them.

    Returns
    -------
    tuple of tuple of int

    Raises
    ------
    CommandError
        There are none or more than 8, two overlap, or one has fewer than 24 pixels or is not on
        the line.
    """
    result: list[tuple[int, int]] = []
    for window in windows:
        try:
            first, last = window
        except (TypeError, ValueError):
            raise CommandError(
                f"{name} = {windows!r}: pairs of first and last pixel are needed; was one window "
                "given instead of a list of them?",
                Refusal.TABLE,
            ) from None
        first = _whole(f"first pixel of {name}", first, Refusal.TABLE)
        last = _whole(f"last pixel of {name}", last, Refusal.TABLE)
        if not (first >= 0 and last < PIXELS and last - first + 1 >= WINDOW_MIN):
            raise CommandError(
                f"{name}: {first} to {last}: allowed are {WINDOW_MIN} pixels or more within 0 to "
                f"{PIXELS - 1}",
                Refusal.TABLE,
            )
        for other in result:
            if first <= other[1] and other[0] <= last:
                raise CommandError(
                    f"{name}: {first} to {last} overlaps {other[0]} to {other[1]}: a pixel is in "
                    "one window at most; make one of the two",
                    Refusal.TABLE,
                )
        result.append((first, last))
    if not 1 <= len(result) <= WINDOWS_MAX:
        raise CommandError(
            f"{name}: {len(result)}: allowed are 1 to {WINDOWS_MAX} in one frame", Refusal.TABLE
        )
    return tuple(result)


def _windows(table: Sequence[tuple[int, ...]]) -> list[list[tuple[int, int]]]:
    """Undo `Command._table` for the windows, refusing what the device refuses."""
    result: list[list[tuple[int, int]]] = [[]]
    for number, (_, word, first, last) in enumerate(table):
        if (first, last) != _NO_WINDOW:
            result[-1].append((first, last))
        if not word & _CONTINUES:
            if not result[-1]:
                raise CommandError(f"entry {number}: a frame without a window", Refusal.TABLE)
            result.append([])
    return result[:-1]


def _sequence(table: Sequence[tuple[int, ...]]) -> list[dict[int, int]]:
    """Undo `Command._table`, refusing what the device refuses."""
    result: list[dict[int, int]] = []
    lit: dict[int, int] = {}
    before: int | None = None
    for number, (mask, word) in enumerate(table):
        exposure = word & ~_CONTINUES
        if before is not None and exposure >= before and (mask or exposure):
            raise CommandError(
                f"entry {number}: exposure {exposure} after {before}; they must fall in a frame",
                Refusal.TABLE,
            )
        for channel in range(CHANNELS):
            if mask >> channel & 1:
                lit.setdefault(channel, exposure)
        if word & _CONTINUES:
            before = exposure
        else:
            result.append(lit)
            lit, before = {}, None
    if before is not None:
        raise CommandError("the last entry says that another one follows", Refusal.TABLE)
    return result


@dataclass(frozen=True)
class Status:
    """The device's answer to a command.

    Parameters
    ----------
    refusal : Refusal
        `Refusal.NONE`: accepted.
    firmware : str
        Build of the firmware.
    sh_period, icg_period : int
        Those in force, in master clocks.
    timestamp : int
        Device time, ns.
    sequence : int
    flags : FrameFlags
    """

    refusal: Refusal
    firmware: str
    sh_period: int
    icg_period: int
    timestamp: int = 0
    sequence: int = 0
    flags: FrameFlags = FrameFlags.STATUS


def decode_elements(data: bytes | bytearray | memoryview) -> NDArray[np.uint16]:
    """Decode a transfer of original mode: the elements alone.

    Parameters
    ----------
    data : bytes-like
        7388 bytes.

    Returns
    -------
    ndarray of uint16, shape (3694,)

    Raises
    ------
    ShortFrame
        There are more or fewer bytes.
    """
    if len(data) != ORIGINAL_SIZE:
        raise ShortFrame(f"{len(data)} bytes: a transfer in original mode has {ORIGINAL_SIZE}")
    return np.frombuffer(data, "<u2").astype(np.uint16, copy=False)


def encode_elements(frame: Frame) -> bytes:
    """Encode a frame as the device sends it in original mode, 7388 bytes."""
    return frame.elements.astype("<u2").tobytes()


def decode_frame(
    data: bytes | bytearray | memoryview,
    *,
    exposures: Mapping[int, int] | None = None,
    master_clock: int = MASTER_CLOCK,
    utc_ns: int = 0,
    monotonic_ns: int = 0,
) -> Frame | Status:
    """Decode a transfer of stream mode.

    Parameters
    ----------
    data : bytes-like
        7424 bytes.
    exposures : mapping of int to int, optional
        Exposure in master clocks by LED channel: the device does not send it.
    master_clock : int, optional
        Of the sensor, Hz.
    utc_ns, monotonic_ns : int, optional
        The host's clocks at arrival, ns.

    Returns
    -------
    Frame or Status

    Raises
    ------
    DecodeError
        `ShortFrame`, `BadMagic` or `BadChecksum`: it did not arrive as it was sent.
        `BadVersion` or `BadHeader`: it did, but is not understood here.
    """
    told = _told(data, Mode.STREAM, exposures, master_clock, utc_ns, monotonic_ns)
    if isinstance(told, Status):
        return told
    elements = np.frombuffer(data, "<u2", ELEMENTS, _HEADER.size).astype(np.uint16)
    return Frame(elements, **told)


def decode_spikes(
    data: bytes | bytearray | memoryview,
    *,
    exposures: Mapping[int, int] | None = None,
    master_clock: int = MASTER_CLOCK,
    utc_ns: int = 0,
    monotonic_ns: int = 0,
) -> SpikeFrame | Status:
    """Decode a transfer of spikes mode.

    Parameters
    ----------
    data : bytes-like
        256 bytes.
    exposures, master_clock, utc_ns, monotonic_ns
        As in `decode_frame`.

    Returns
    -------
    SpikeFrame or Status

    Raises
    ------
    DecodeError
        As in `decode_frame`.
    """
    told = _told(data, Mode.SPIKES, exposures, master_clock, utc_ns, monotonic_ns)
    if isinstance(told, Status):
        return told
    count, window_count, dark, _ = _FOUND.unpack_from(data, _HEADER.size)
    if count > SPIKES_MAX or not 1 <= window_count <= WINDOWS_MAX:
        raise BadHeader(
            f"{count} spikes in {window_count} windows: allowed are {SPIKES_MAX} in 1 to "
            f"{WINDOWS_MAX}"
        )
    at = _HEADER.size + _FOUND.size
    windows = tuple(_WINDOW.unpack_from(data, at + n * _WINDOW.size) for n in range(window_count))
    for first, last in windows:
        if not first <= last < PIXELS:
            raise BadHeader(f"window {first} to {last}: pixels are 0 to {PIXELS - 1}")
    at += WINDOWS_MAX * _WINDOW.size
    spikes = []
    for n in range(count):
        position, width, height, marks, window = _SPIKE.unpack_from(data, at + n * _SPIKE.size)
        if window >= window_count:
            raise BadHeader(f"a spike in window {window} of {window_count}")
        if position > (PIXELS - 1) * _SPIKES.position_scale:
            raise BadHeader(
                f"a spike at {position / _SPIKES.position_scale:g} px: pixels are 0 to {PIXELS - 1}"
            )
        if marks & ~_SPIKE_FLAGS:
            raise BadHeader(f"flags {marks:#04x} of a spike: known are {_SPIKE_FLAGS:#04x}")
        position, width = position / _SPIKES.position_scale, width / _SPIKES.width_scale
        spikes.append(OnboardSpike(position, width, height, marks, window))
    return SpikeFrame(tuple(spikes), windows=windows, dark_level=dark / _SPIKES.dark_scale, **told)


def _told(
    data: bytes | bytearray | memoryview,
    mode: Mode,
    exposures: Mapping[int, int] | None,
    master_clock: int,
    utc_ns: int,
    monotonic_ns: int,
) -> Status | dict[str, Any]:
    """Return what the header and the host tell of a frame, by field; or a status as it is."""
    flags, sequence, leds, clocks, icg_period, sh_period = _checked_header(data, mode)
    timestamp = _nanoseconds(clocks, master_clock)
    if flags & _STATUS_FLAG:
        code, _, build = _STATUS.unpack_from(data, _HEADER.size)
        if code not in Refusal._value2member_map_:
            raise BadHeader(f"refusal {code}: known are {[member.value for member in Refusal]}")
        firmware = build.rstrip(b"\0").decode("ascii", "replace")
        return Status(Refusal(code), firmware, sh_period, icg_period, timestamp, sequence, flags)
    return {
        "sequence": sequence,
        "leds": leds,
        "exposures": {} if exposures is None else exposures,
        "sh_period": sh_period,
        "icg_period": icg_period,
        "master_clock": master_clock,
        "timestamp": timestamp,
        "utc_ns": utc_ns,
        "monotonic_ns": monotonic_ns,
        "flags": flags,
    }


def _checked_header(
    data: bytes | bytearray | memoryview, mode: Mode
) -> tuple[FrameFlags, int, int, int, int, int]:
    if len(data) != SIZES[mode]:
        raise ShortFrame(
            f"{len(data)} bytes: a transfer in {mode.name.lower()} mode has {SIZES[mode]}"
        )
    magic, version, flags, *rest = _HEADER.unpack_from(data)
    if magic != _STREAM.magic:
        raise BadMagic(
            f"begins with {magic:#06x}, not {_STREAM.magic:#06x}: a transfer is out of step, or "
            f"the device is not in {mode.name.lower()} mode"
        )
    sent = int.from_bytes(data[-4:], "little")
    found = crc32_words(memoryview(data)[:-4])
    if sent != found:
        raise BadChecksum(
            f"checksum {found:#010x}, sent was {sent:#010x}: bytes were changed on the link"
        )
    if version != (known := _version(mode)):
        raise BadVersion(
            f"frame version {version}: known is {known}; firmware and host program must come from "
            "the same release"
        )
    if flags & ~_KNOWN_FLAGS:
        raise BadHeader(f"flags {flags:#04x}: known are {_KNOWN_FLAGS:#04x}")
    return (FrameFlags(flags), *rest)


def _version(mode: Mode) -> int:
    return _SPIKES.version if mode is Mode.SPIKES else _STREAM.version


def _nanoseconds(clocks: int, master_clock: int) -> int:
    return clocks * 1_000_000_000 // master_clock


def _clocks(nanoseconds: int, master_clock: int) -> int:
    return -(-nanoseconds * master_clock // 1_000_000_000)


def encode_frame(frame: Frame) -> bytes:
    """Encode a frame as the device sends it in stream mode, 7424 bytes.

    What belongs to the host (exposures, its clocks and flags) is not sent. A frame without a
    timestamp gets 0.
    """
    return _sealed(Mode.STREAM, *_head(frame), encode_elements(frame))


def encode_spikes(frame: SpikeFrame) -> bytes:
    """Encode a frame as the device sends it in spikes mode, 256 bytes; see `encode_frame`.

    Raises
    ------
    ValueError
        It has more than 8 spikes, or not 1 to 8 windows.
    """
    if len(frame.spikes) > SPIKES_MAX or not 1 <= len(frame.windows) <= WINDOWS_MAX:
        raise ValueError(
            f"{len(frame.spikes)} spikes in {len(frame.windows)} windows: the device sends "
            f"{SPIKES_MAX} in 1 to {WINDOWS_MAX} at most"
        )
    spikes = [
        _SPIKE.pack(
            round(spike.position * _SPIKES.position_scale),
            round(spike.width * _SPIKES.width_scale),
            *(spike.height, spike.flags, spike.window),
        )
        for spike in frame.spikes
    ]
    dark = round(frame.dark_level * _SPIKES.dark_scale)
    windows = b"".join(_WINDOW.pack(*window) for window in frame.windows)
    body = _FOUND.pack(len(spikes), len(frame.windows), dark, 0)
    body += windows.ljust(WINDOWS_MAX * _WINDOW.size, b"\0") + b"".join(spikes)
    return _sealed(Mode.SPIKES, *_head(frame), body)


def _head(frame: Frame | SpikeFrame) -> tuple[int, tuple[int, ...]]:
    clocks = _clocks(frame.timestamp or 0, frame.master_clock)
    flags = int(frame.flags) & _KNOWN_FLAGS & ~FrameFlags.STATUS
    return flags, (frame.sequence, frame.leds, clocks, frame.icg_period, frame.sh_period)


def encode_status(
    status: Status, master_clock: int = MASTER_CLOCK, *, mode: Mode = Mode.STREAM
) -> bytes:
    """Encode an answer as the device sends it in stream mode, 7424 bytes, or in spikes mode."""
    clocks = _clocks(status.timestamp, master_clock)
    flags = int(status.flags) & _KNOWN_FLAGS | FrameFlags.STATUS
    head = (status.sequence, 0, clocks, status.icg_period, status.sh_period)
    build = status.firmware.encode("ascii", "replace")
    return _sealed(mode, flags, head, _STATUS.pack(status.refusal, 0, build))


def _sealed(mode: Mode, flags: int, head: tuple[int, ...], body: bytes) -> bytes:
    data = _HEADER.pack(_STREAM.magic, _version(mode), flags, *head) + body
    data = data.ljust(SIZES[mode] - 4, b"\0")
    return data + crc32_words(data).to_bytes(4, "little")
