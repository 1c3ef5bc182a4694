"""What the firmware does in spikes mode, in Python: `firmware/spikes.c` equals it bit for bit.

Whole numbers only, and no more passes over the pixels than a Cortex-M4 has time for:

1. Light is summed over blocks of 8 pixels. Peaks and valleys of these sums must differ by ten times
   the noise: that of the dark reference, or a 16th of the light for its own and for uneven pixels.
   Two peaks are one spike if the valley between them is above half of the lower one.
2. The full width at half maximum is found on the pixels; on the blocks if 8 of them or more are
   above half, or if there are two peaks: then at half of the lower one, around both.
3. The position is where the derivative of light, smoothed by (1 − (x/r)²)² with r = 9/8 of the
   width, crosses zero: interpolated between two pixels (or blocks). If all of ±r is the spike's,
   its noise is 1.0 to 1.2 times the Cramér–Rao bound for smooth spikes of 4 to 200 px. (r = width/2
   without the weights is the filter of Blais and Rioux: 1.5 to 1.8 times; r = width: 1.15.)

Neither the flat field nor a sloping background is corrected: for that the host needs the pixels.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple

from acquisition.frames import LEADING, PIXELS, Frame, OnboardSpike, SpikeFrame
from acquisition.protocol import FULL_WINDOW, SATURATED, SPIKES_MAX, WINDOW_MIN, WINDOWS_MAX
from acquisition.wiring import PROTOCOL
from tracking.spikes import SpikeFlags

if TYPE_CHECKING:
    from collections.abc import Sequence

_BLOCK: Final = 8  # pixels
_WIDE: Final = 8  # blocks
_NOISE_LEAST: Final = 40  # counts, of a block's sum
_REACH_MAX: Final = 144  # samples
_SEEN: Final = 2 * _REACH_MAX  # pixels
_FRACTION: Final = 1024  # of a sample
_MIDDLE: Final = (_BLOCK - 1) * _FRACTION // 2  # of a block, from the middle of its first pixel
_POSITION_SCALE: Final = PROTOCOL.spikes.position_scale
_WIDTH_SCALE: Final = PROTOCOL.spikes.width_scale
_DARK_SCALE: Final = PROTOCOL.spikes.dark_scale
_U16_MAX: Final = 0xFFFF


def find_spikes(
    frame: Frame,
    windows: Sequence[tuple[int, int]] = (FULL_WINDOW,),
    *,
    saturated: int = SATURATED,
    threshold: int = 0,
) -> SpikeFrame:
    """Find what the firmware would find in a frame.

    Parameters
    ----------
    frame : Frame
    windows : sequence of tuple of int, optional
        First and last pixel of each window, 1 to 8 of them, 16 pixels or more each.
    saturated : int, optional
        Code at or below which a pixel is full; 0: unknown.
    threshold : int, optional
        Light that a spike must have, counts over 8 pixels; 0: above the noise.

    Returns
    -------
    SpikeFrame
        With all that is known of the frame.

    Raises
    ------
    ValueError
        There are too many windows, or one is too short or not on the line.
    """
    if not 1 <= len(windows) <= WINDOWS_MAX:
        raise ValueError(f"{len(windows)} windows: allowed are 1 to {WINDOWS_MAX}")
    for first, last in windows:
        if not (first >= 0 and last < PIXELS and last - first + 1 >= WINDOW_MIN):
            raise ValueError(
                f"window {first} to {last}: allowed are {WINDOW_MIN} pixels or more within 0 to "
                f"{PIXELS - 1}"
            )
    dark = frame.dark.tolist()
    total, count = sum(dark), len(dark)
    changes = sum(abs(b - a) for a, b in zip(dark, dark[2:], strict=False))
    zero = (total + count // 2) // count
    least = threshold or max(3 * changes, _NOISE_LEAST)
    elements = frame.elements.tolist()
    spikes: list[OnboardSpike] = []
    for number, (first, last) in enumerate(windows):
        pixels = elements[LEADING + first : LEADING + last + 1]
        most = SPIKES_MAX - len(spikes) - (len(windows) - 1 - number)
        found = _Line(pixels, zero, least, saturated).spikes(most)
        spikes += [_placed(spike, first, number) for spike in found]
    return SpikeFrame(
        tuple(spikes),
        windows=tuple((int(first), int(last)) for first, last in windows),
        dark_level=min((_DARK_SCALE * total + count // 2) // count, _U16_MAX) / _DARK_SCALE,
        sequence=frame.sequence,
        leds=frame.leds,
        exposures=frame.exposures,
        sh_period=frame.sh_period,
        icg_period=frame.icg_period,
        master_clock=frame.master_clock,
        timestamp=frame.timestamp,
        utc_ns=frame.utc_ns,
        monotonic_ns=frame.monotonic_ns,
        flags=frame.flags,
    )


class _Found(NamedTuple):
    """A spike in the units of the wire; its place counts from the window's first pixel."""

    place: int
    width: int
    height: int
    flags: int


def _placed(spike: _Found, first: int, window: int) -> OnboardSpike:
    place = min(spike.place + first * _POSITION_SCALE, (PIXELS - 1) * _POSITION_SCALE)
    return OnboardSpike(
        place / _POSITION_SCALE, spike.width / _WIDTH_SCALE, spike.height, spike.flags, window
    )


class _Peak(NamedTuple):
    """Blocks: between two valleys, the highest, or two with no deep valley between them."""

    left: int
    top: int
    right: int
    lower: int  # light of the lowest of its tops
    twin: bool = False  # it has several


class _Line:
    """A window of the line, its first pixel and block being 0."""

    def __init__(self, pixels: list[int], zero: int, least: int, saturated: int) -> None:
        self.pixels = pixels
        self.saturated = saturated
        self.least = least
        self.light = [zero - pixel for pixel in pixels]
        self.blocks = [
            sum(self.light[n : n + _BLOCK]) for n in range(0, len(pixels) - _BLOCK + 1, _BLOCK)
        ]

    def spikes(self, most: int) -> list[_Found]:
        """Return at most so many, the highest first; of equal ones, the one found first."""
        peaks = self._joined(self._peaks())
        peaks = sorted(peaks, key=self._height, reverse=True)[:most]
        spikes = sorted(map(self._refined, peaks), key=lambda spike: spike.height, reverse=True)
        return [
            spike._replace(flags=spike.flags | SpikeFlags.REFLECTION)
            if any(
                2 * other.height <= spike.height
                and abs(other.place - spike.place) * _WIDTH_SCALE
                <= 4 * spike.width * _POSITION_SCALE
                for other in spikes[n + 1 :]
            )
            else spike
            for n, spike in enumerate(spikes)
        ]

    def _height(self, peak: _Peak) -> int:
        return self.blocks[peak.top] - min(self.blocks[peak.left], self.blocks[peak.right])

    def _least_rise(self, light: int) -> int:
        return self.least + max(light, 0) // 16

    def _peaks(self) -> list[_Peak]:
        """Peaks and valleys in turn, each of which differs from the last by more than noise."""
        light = self.blocks
        result = []
        left = top = lowest = 0
        climbing = True
        for n in range(1, len(light)):
            if climbing:
                if light[n] < light[lowest]:
                    lowest = n
                if light[n] > light[top]:
                    left, top = lowest, n
                elif light[top] - light[n] > self._least_rise(light[top]):
                    climbing, lowest = False, n
            elif light[n] < light[lowest]:
                lowest = n
            elif light[n] - light[lowest] > self._least_rise(light[n]):
                result.append(_Peak(left, top, lowest, light[top]))
                climbing, left, top = True, lowest, n
        if climbing:
            lowest = min(range(top, len(light)), key=light.__getitem__)
        if not climbing or light[top] - light[left] > self._least_rise(light[top]):
            result.append(_Peak(left, top, lowest, light[top]))
        return result

    def _joined(self, peaks: list[_Peak]) -> list[_Peak]:
        """Join peaks between which there is no deep valley."""
        light = self.blocks
        result: list[_Peak] = []
        for peak in peaks:
            if result:
                before = result[-1]
                base = min(light[before.left], light[peak.right])
                lower = min(light[before.top], light[peak.top])
                if 2 * (light[peak.left] - base) > lower - base:
                    top = max(before.top, peak.top, key=light.__getitem__)
                    lower = min(before.lower, peak.lower)
                    result[-1] = _Peak(before.left, top, peak.right, lower, twin=True)
                    continue
            result.append(peak)
        return result

    def _above(self, peak: _Peak, base: int) -> int:
        """How many blocks around the top are above half, of the lower one if there are two."""
        light = self.blocks
        half = base + (peak.lower - base) // 2
        first = last = peak.top
        while first > peak.left and light[first - 1] > half:
            first -= 1
        while last < peak.right and light[last + 1] > half:
            last += 1
        return last - first + 1

    def _refined(self, peak: _Peak) -> _Found:
        light = self.blocks
        begins, ends = peak.left == 0, peak.right == len(light) - 1
        first = peak.left * _BLOCK
        last = len(self.pixels) - 1 if ends else peak.right * _BLOCK + _BLOCK - 1

        around = 2 * self._above(peak, min(light[peak.left], light[peak.right])) + 4
        near = slice(max(peak.left, peak.top - around), min(peak.right, peak.top + around) + 1)
        base = min(light[near])
        if peak.twin or self._above(peak, base) >= _WIDE:
            twice = peak.lower + base
            left, open_left = _half_place(light, peak.top, -1, peak.left, twice)
            right, open_right = _half_place(light, peak.top, 1, peak.right, twice)
            left, right = _BLOCK * left + _MIDDLE, _BLOCK * right + _MIDDLE
            height = max(light[peak.top] - base, 0) // _BLOCK
        else:
            tops = range(
                max((peak.top - 1) * _BLOCK, first), min((peak.top + 2) * _BLOCK - 1, last) + 1
            )
            top = max(tops, key=self.light.__getitem__)
            base //= _BLOCK
            twice = self.light[top] + base
            left, open_left = _half_place(self.light, top, -1, max(first, top - _SEEN), twice)
            right, open_right = _half_place(self.light, top, 1, min(last, top + _SEEN), twice)
            height = max(self.light[top] - base, 0)
        width = right - left
        place = (left + right) // 2
        if width >= _WIDE * _BLOCK * _FRACTION:
            bounds = peak.left, peak.right
            zero, cut = _derivative_zero(light, _BLOCK, place - _MIDDLE, width, *bounds)
            zero = None if zero is None else _BLOCK * zero + _MIDDLE
        else:
            zero, cut = _derivative_zero(self.light, 1, place, width, first, last)
        place = place if zero is None else zero

        flags = SpikeFlags.NONE
        if peak.twin or (open_left and not begins) or (open_right and not ends):
            flags |= SpikeFlags.DOUBLE
        if (open_left and begins) or (open_right and ends) or (cut and (begins or ends)):
            flags |= SpikeFlags.CLIPPED
        within = slice(max(left // _FRACTION, 0), max(right // _FRACTION + 1, 0))
        if any(pixel <= self.saturated for pixel in self.pixels[within]):
            flags |= SpikeFlags.SATURATED
        width = min(width * _WIDTH_SCALE // _FRACTION, _U16_MAX)
        return _Found(max(place, 0), width, min(height, _U16_MAX), int(flags))


def _derivative_zero(
    light: list[int], size: int, place: int, width: int, first: int, last: int
) -> tuple[int | None, bool]:
    """Where the derivative of smoothed light is zero near a place, in fractions of a sample.

    None if too little light of this spike, from first to last, is on either side to tell; the
    second value is then whether it ends too soon. Place and width are in fractions of a pixel.
    """
    unit = size * _FRACTION
    middle = (place + unit // 2) // unit
    wanted = max((width + width // 8 + unit // 2) // unit, 4)
    room = min(middle - first, last - middle)
    reach = min(wanted, room, _REACH_MAX)
    if reach < 3 or 2 * reach * unit < width:
        return None, room < wanted
    return _crossing(light, middle, reach, first + reach, last - reach), False


def _half_place(light: list[int], top: int, step: int, end: int, twice: int) -> tuple[int, bool]:
    """Where light falls to half for two samples, and whether the end comes first."""

    def below(n: int) -> bool:
        return 2 * light[n] < twice and (n == end or 2 * light[n + step] < twice)

    n = top
    while n != end and not below(n + step):
        n += step
    if n == end:
        return n * _FRACTION + step * _FRACTION // 2, True
    fall = light[n] - light[n + step]
    return n * _FRACTION + step * ((2 * light[n] - twice) * (_FRACTION // 2) // fall), False


def _crossing(light: list[int], at: int, reach: int, first: int, last: int) -> int | None:
    """Where the derivative of smoothed light changes its sign; None if it does not."""
    weights = [x * (reach**2 - x**2) for x in range(1, reach)]

    def slope(n: int) -> int:
        """Positive left of the middle of a spike."""
        right, left = light[n + 1 : n + reach], light[n - reach + 1 : n][::-1]
        return sum(w * (b - a) for w, a, b in zip(weights, left, right, strict=True))

    low = high = at
    before = after = slope(at)
    step = 1
    if before >= 0:
        while after >= 0:
            if high == last:
                return None
            low, before = high, after
            high = min(high + step, last)
            step *= 2
            after = slope(high)
    else:
        while before < 0:
            if low == first:
                return None
            high, after = low, before
            low = max(low - step, first)
            step *= 2
            before = slope(low)
    while high - low > 1:
        middle = (low + high) // 2
        found = slope(middle)
        if found >= 0:
            low, before = middle, found
        else:
            high, after = middle, found
    whole = before - after
    shift = max(whole.bit_length() - 21, 0)  # 32 bits are enough, and the processor divides no more
    whole, before = whole >> shift, before >> shift
    return low * _FRACTION + (before * _FRACTION + whole // 2) // whole
