"""One read-out of the sensor, with what it takes to understand it later."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import IntFlag
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, Any, Final, NamedTuple, Self

import numpy as np

from acquisition.wiring import PROTOCOL, WIRING

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

_FLAGS: Final = PROTOCOL.stream.flags

ELEMENTS: Final = PROTOCOL.elements
"""Elements of one read-out: dummies, dark reference, pixels, dummies."""
LEADING: Final = PROTOCOL.leading_elements
"""Elements before the first pixel."""
PIXELS: Final = PROTOCOL.pixels
"""Elements that see light."""
MASTER_CLOCK: Final = WIRING.mcu.master_clock
"""The sensor's clock on the prototype, Hz."""
CHANNELS: Final = 64
"""LED channels that a mask has bits for."""
FULL_SCALE: Final = PROTOCOL.full_scale
"""Largest value of the 12-bit converter."""
DARK: Final = slice(PROTOCOL.dark_first, PROTOCOL.dark_first + PROTOCOL.dark_count)
"""The light-shielded elements D16 to D28, the dark reference."""

_DARK_LOWEST = 1024  # the sensor's dark output is 1.5 V at least, of 3.3 V
_DARK_SPREAD = 128  # noise and the odd/even step are a few counts
_DARK_ABOVE = 128  # light lowers the output: nothing lies above the dark reference
_ZERO_RUN = 16  # the sensor saturates far above 0


class FrameFlags(IntFlag):
    """What happened to a frame. The low eight bits come from the device, the others from here."""

    NONE = 0
    DROPPED = _FLAGS["dropped"]
    """Read-outs were lost just before this frame, since the link was busy."""
    CHANGED = _FLAGS["changed"]
    """The first frame exposed by a new command."""
    REFUSED = _FLAGS["refused"]
    """The command just received was refused; this frame follows the last good one."""
    STATUS = _FLAGS["status"]
    """No pixels: an answer to a command. A `Frame` never has it."""
    INVALID = 1 << 8
    """The frame contradicts itself: `Frame.invalid` says how. Do not measure on it."""
    LOST = 1 << 9
    """Frames before this one came damaged or not at all. Without LEDs, those may be unknown."""


@lru_cache(maxsize=1024)
def _channels(leds: int) -> tuple[int, ...]:
    return tuple(n for n in range(leds.bit_length()) if leds >> n & 1)


class _Readout:
    """What every read-out is described by."""

    leds: int
    sh_period: int
    master_clock: int

    def _check(self) -> None:
        if self.master_clock <= 0:
            raise ValueError(f"master_clock = {self.master_clock} Hz: allowed is > 0")
        if not 0 <= self.leds < 1 << CHANNELS:
            raise ValueError(f"leds = {self.leds:#x}: a mask of {CHANNELS} bits is needed")

    @property
    def integration_time(self) -> float:
        """How long the sensor gathered light, s; 0 if the SH period is unknown."""
        return self.sh_period / self.master_clock

    @property
    def channels(self) -> tuple[int, ...]:
        """Channels of the LEDs lit, ascending."""
        return _channels(self.leds)

    def replaced(self, **values: Any) -> Self:
        """Return a copy with other values (not pixels), as `dataclasses.replace` but unchecked."""
        result = object.__new__(type(self))
        result.__dict__.update(self.__dict__, **values)
        return result


@dataclass(frozen=True, eq=False)
class Frame(_Readout):
    """One read-out of the sensor.

    Parameters
    ----------
    elements : ndarray of uint16, shape (3694,)
        As read from the converter: 16 dummies, 13 light-shielded elements, 3 of transition, 3648
        pixels, 14 dummies. Light lowers the values. The array is made read-only.
    sequence : int
        Number of the read-out, from 0; a jump means read-outs that did not arrive.
    leds : int
        Mask of the LEDs lit: bit n is channel n.
    exposures : mapping of int to int, optional
        LED-on time by channel, in master clocks; empty if unknown.
    sh_period, icg_period : int
        In master clocks; 0 if unknown. The sensor integrates for one SH period.
    master_clock : int
        Of the sensor, Hz.
    timestamp : int or None
        Device time in ns at the SH edge that ended the integration; None where the device sends
        none (original mode, `.dat` files).
    utc_ns, monotonic_ns : int
        The host's clocks when the frame had arrived, ns; 0 if unknown. The second one has no
        fixed origin: only differences within one run of the host mean something.
    flags : FrameFlags
    reasons : tuple of str, optional
        Why the flag `FrameFlags.INVALID` is set, where more is known than `invalid` finds.

    Raises
    ------
    ValueError
        The elements are not 3694 values of uint16, or another value is out of its range.
    """

    elements: NDArray[np.uint16]
    sequence: int = 0
    leds: int = 0
    exposures: Mapping[int, int] = field(default_factory=dict)
    sh_period: int = 0
    icg_period: int = 0
    master_clock: int = MASTER_CLOCK
    timestamp: int | None = None
    utc_ns: int = 0
    monotonic_ns: int = 0
    flags: FrameFlags = FrameFlags.NONE
    reasons: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        elements = np.asarray(self.elements)
        if elements.dtype != np.uint16 or elements.shape != (ELEMENTS,):
            raise ValueError(
                f"elements: {ELEMENTS} values of uint16 are needed, as read from the sensor, not "
                f"{elements.dtype} of shape {elements.shape}; were only the pixels given?"
            )
        if elements.flags.writeable:
            elements = elements.view()
            elements.flags.writeable = False
        object.__setattr__(self, "elements", elements)
        self._check()

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Frame):
            return NotImplemented
        return self._values() == other._values() and np.array_equal(self.elements, other.elements)

    __hash__ = None  # type: ignore[assignment]  # as every type that holds an array

    def _values(self) -> tuple[object, ...]:
        return (
            *(self.sequence, self.leds, dict(self.exposures), self.sh_period, self.icg_period),
            *(self.master_clock, self.timestamp, self.utc_ns, self.monotonic_ns, self.flags),
        )

    @property
    def pixels(self) -> NDArray[np.uint16]:
        """The 3648 elements that see light, S1 to S3648 (a view)."""
        return self.elements[LEADING : LEADING + PIXELS]

    @property
    def dark(self) -> NDArray[np.uint16]:
        """The 13 light-shielded elements D16 to D28 (a view)."""
        return self.elements[DARK]

    @cached_property
    def dark_level(self) -> float:
        """Median of the dark reference, in counts."""
        return float(np.median(self.dark))

    def invalid(self) -> list[str]:
        """Tell what in the frame no sensor can have sent; an empty list if nothing is seen.

        The original protocol has neither checksum nor header, so this is all there is to see of
        a broken transfer there: values beyond the 12-bit converter, an output that is stuck, and
        dark reference elements that are lit or no longer at their place. What keeps the shape of
        a frame, such as a flipped low bit, cannot be seen.

        Returns
        -------
        list of str
            One sentence for each reason.
        """
        elements, result = self.elements, list(self.reasons)
        highest, lowest = int(elements.max()), int(elements.min())
        if highest == lowest:
            result.append(
                f"every element reads {highest}: MISO is stuck, or nothing answers; check the "
                "wiring and the microcontroller's power"
            )
            return result
        if highest > FULL_SCALE:
            count = int(np.count_nonzero(elements > FULL_SCALE))
            result.append(
                f"{count} elements are above {FULL_SCALE}, the converter's largest value: bytes "
                "were lost, doubled or changed on the link"
            )
        if lowest == 0 and (run := _longest_run(elements == 0)) >= _ZERO_RUN:
            result.append(
                f"{run} elements in a row read 0, far below the sensor's saturation: part of the "
                "frame was not sent"
            )
        dark = self.dark
        low, high = int(dark.min()), int(dark.max())
        if high - low > _DARK_SPREAD:
            result.append(
                f"the dark reference D16 to D28 spreads over {high - low} counts, more than "
                f"{_DARK_SPREAD}: the frame is shifted"
            )
        level = self.dark_level
        if level < _DARK_LOWEST:
            result.append(
                f"the dark reference reads {level:g}, below {_DARK_LOWEST}: the frame is shifted, "
                "or the sensor's output is not connected or inverted"
            )
        above = int(self.pixels.max()) - level
        if above > _DARK_ABOVE and highest <= FULL_SCALE:
            result.append(
                f"a pixel reads {above:g} counts above the dark reference, though light lowers "
                "it: the frame is shifted, a byte was changed, or the output is inverted"
            )
        return result


class OnboardSpike(NamedTuple):
    """A spike that the firmware found (its firmware/spikes.c says how).

    Parameters
    ----------
    position : float
        px, 0 the middle of the first pixel, in steps of 1/1024.
    width : float
        Full width at half maximum, px, in steps of 1/16.
    height : int
        Of its peak above its base, counts.
    flags : int
        1 saturated, 2 clipped by the window or the line, 4 double, 8 a weaker one of the same LED
        is near: as in `tracking.spikes.SpikeFlags`. Where several LEDs may be in a window, nothing
        is said of the same LED.
    window : int
        Which of the frame's windows it is in.
    """

    position: float
    width: float
    height: int
    flags: int
    window: int


@dataclass(frozen=True)
class SpikeFrame(_Readout):
    """What the firmware found in one read-out, in spikes mode.

    Parameters
    ----------
    spikes : tuple of OnboardSpike
        Window after window, the highest of each first; 8 at most. Empty: there was none.
    windows : tuple of tuple of int
        First and last pixel of each window that was looked through.
    dark_level : float
        Mean of the dark reference, counts, in steps of 1/16; a `Frame` has the median.
    sequence, leds, exposures, sh_period, icg_period, master_clock
        As those of a `Frame`.
    timestamp, utc_ns, monotonic_ns, flags
        As those of a `Frame`.
    """

    spikes: tuple[OnboardSpike, ...]
    windows: tuple[tuple[int, int], ...] = ((0, PIXELS - 1),)
    dark_level: float = 0.0
    sequence: int = 0
    leds: int = 0
    exposures: Mapping[int, int] = field(default_factory=dict)
    sh_period: int = 0
    icg_period: int = 0
    master_clock: int = MASTER_CLOCK
    timestamp: int | None = None
    utc_ns: int = 0
    monotonic_ns: int = 0
    flags: FrameFlags = FrameFlags.NONE

    __hash__ = None  # type: ignore[assignment]  # it holds a mapping

    def __post_init__(self) -> None:
        self._check()


def stack(frames: Sequence[Frame]) -> dict[str, NDArray[Any]]:
    """Put the frames' values into arrays with a leading axis, one entry per frame.

    Parameters
    ----------
    frames : sequence of Frame

    Returns
    -------
    dict of str to ndarray
        ``elements`` (N, 3694) uint16; ``sequence``, ``leds``, uint64; ``exposures`` (N, 64)
        uint32 in master clocks, 0 for unlit; ``sh_period``, ``icg_period``, ``master_clock``
        uint32; ``timestamp`` int64 in ns, −1 where there is none; ``utc_ns``, ``monotonic_ns``
        int64; ``flags`` uint32.
    """
    count = len(frames)
    elements = np.empty((count, ELEMENTS), np.uint16)
    exposures = np.zeros((count, CHANNELS), np.uint32)
    for n, frame in enumerate(frames):
        elements[n] = frame.elements
        for channel, clocks in frame.exposures.items():
            exposures[n, channel] = clocks

    def column(values: list[int], dtype: type[np.generic]) -> NDArray[Any]:
        return np.array(values, dtype=dtype)

    return {
        "elements": elements,
        "sequence": column([frame.sequence for frame in frames], np.uint64),
        "leds": column([frame.leds for frame in frames], np.uint64),
        "exposures": exposures,
        "sh_period": column([frame.sh_period for frame in frames], np.uint32),
        "icg_period": column([frame.icg_period for frame in frames], np.uint32),
        "master_clock": column([frame.master_clock for frame in frames], np.uint32),
        "timestamp": column(
            [-1 if frame.timestamp is None else frame.timestamp for frame in frames], np.int64
        ),
        "utc_ns": column([frame.utc_ns for frame in frames], np.int64),
        "monotonic_ns": column([frame.monotonic_ns for frame in frames], np.int64),
        "flags": column([int(frame.flags) for frame in frames], np.uint32),
    }


def _longest_run(where: NDArray[np.bool_]) -> int:
    """Length of the longest run of true values."""
    edges = np.flatnonzero(np.diff(where, prepend=False, append=False))
    return int((edges[1::2] - edges[::2]).max()) if edges.size else 0
