"""What the firmware does in spikes mode, in Python: `firmware/spikes.c` equals it bit for bit.

Whole numbers only, and no more passes over the pixels than a Cortex-M4 has time for:

1. Light is summed over blocks of 8 pixels. Peaks and valleys of these sums must differ by twenty
   times the noise in the dark, of which 13 elements tell little, and a 16th of the light for its
   own and for uneven pixels; from its base, a spike by an eighth of that. Two peaks are one spike
   if the valley between them is above half of the lower one. A pixel with darkness on both sides
   is no spike.
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

from acquisition.frames import LEADING, Frame, OnboardSpike, SpikeFrame
from acquisition.protocol import FULL_WINDOW, SATURATED, SPIKES_MAX, check_windows
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
        First and last pixel of each window, 1 to 8 of them, 24 pixels or more each. They do not
        overlap. If there are as many as LEDs are lit, one LED is expected in each.
    saturated : int, optional
        Light with which a pixel is full, counts below the dark reference; 0: unknown.
    threshold : int, optional
        Light that a spike must have, counts over 8 pixels; 0: above the noise.

    Returns
    -------
    SpikeFrame
        With all that is known of the frame.

    Raises
    ------
    ValueError
        There are too many windows, two overlap, or one is too short or not on the line.
    """
    windows = check_windows(windows)
    dark = frame.dark.tolist()
    total, count = sum(dark), len(dark)
    noise = sum(abs(b - a) for a, b in zip(dark, dark[2:], strict=False))
    about = _About(
        zero=(total + count // 2) // count,
        noise=noise,
        least=threshold or max(5 * noise, _NOISE_LEAST),
        saturated=saturated,
        alone=0 < len(frame.channels) <= len(windows),
    )
    elements = frame.elements.tolist()
    spikes: list[OnboardSpike] = []
    for number, (first, last) in enumerate(windows):
        pixels = elements[LEADING + first : LEADING + last + 1]
        most = SPIKES_MAX - len(spikes) - (len(windows) - 1 - number)
        for spike in _Line(pixels, about).spikes(most):
            place = spike.place / _POSITION_SCALE + first
            width = spike.width / _WIDTH_SCALE
            spikes.append(OnboardSpike(place, width, spike.height, spike.flags, number))
    return SpikeFrame(
        tuple(spikes),
        windows=windows,
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


class _About(NamedTuple):
    """What is known of the frame."""

    zero: int  # code without light
    noise: int  # of a pixel in the dark, 12 times
    least: int
    saturated: int
    alone: bool  # all light in a window is of one LED


class _Found(NamedTuple):
    """A spike in the units of the wire; its place counts from the window's first pixel."""

    place: int
    width: int
    height: int
    flags: int


class _Peak(NamedTuple):
    """Blocks: between two valleys, the highest, or two with no deep valley between them."""

    left: int
    top: int
    right: int
    lower: int  # light of the lowest of its tops
    twin: bool = False  # it has several


class _Line:
    """A window of the line, its first pixel and block being 0."""

    def __init__(self, pixels: list[int], about: _About) -> None:
        self.about = about
        self.light = [about.zero - pixel for pixel in pixels]
        count = -(-len(pixels) // _BLOCK)  # the last one overlaps the one before it if it must
        self.starts = [min(n * _BLOCK, len(pixels) - _BLOCK) for n in range(count)]
        self.blocks = [sum(self.light[at : at + _BLOCK]) for at in self.starts]

    def spikes(self, most: int) -> list[_Found]:
        """Return at most so many, the highest first; of equal ones, the one found first."""
        peaks = [peak for peak in self._joined(self._peaks()) if self._is_spike(peak)]
        peaks = sorted(peaks, key=self._height, reverse=True)[:most]
        spikes = sorted(map(self._refined, peaks), key=lambda spike: spike.height, reverse=True)
        if not (self.about.alone and spikes):
            return spikes
        highest, *others = spikes
        flags = highest.flags
        for other in others:
            apart = abs(other.place - highest.place)
            if apart * _WIDTH_SCALE <= 4 * highest.width * _POSITION_SCALE:
                flags |= self._second(other.height, highest.height)
        return [highest._replace(flags=flags), *others]

    def _second(self, height: int, highest: int) -> SpikeFlags:
        """Tell what a second peak is: if no other LED is lit, a weaker one is a reflection."""
        weak = self.about.alone and 2 * height <= highest
        return SpikeFlags.REFLECTION if weak else SpikeFlags.DOUBLE

    def _base(self, peak: _Peak) -> int:
        return min(self.blocks[peak.left], self.blocks[peak.right])

    def _height(self, peak: _Peak) -> int:
        return self.blocks[peak.top] - self._base(peak)

    def _is_spike(self, peak: _Peak) -> bool:
        """It rises enough from its base, and not all of its light is in one pixel."""
        base, height = self._base(peak), self._height(peak)
        if height <= self.about.least + max(base, 0) // 8:
            return False
        start = self.starts[peak.top]
        at = max(range(start, start + _BLOCK), key=self.light.__getitem__)
        if at < 2 or at + 2 >= len(self.light):
            return True
        beside = sum(self.light[at + n] for n in (-2, -1, 1, 2)) - base // 2
        lonely = 4 * (self.light[at] - base // _BLOCK) >= 3 * height
        return not (2 * beside <= 3 * self.about.noise and lonely)

    def _least_rise(self, light: int) -> int:
        return self.about.least + max(light, 0) // 16

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
        last = self.starts[peak.right] + _BLOCK - 1
        right_block = min(peak.right, len(self.light) // _BLOCK - 1)  # of those at even distances
        top_block = min(peak.top, right_block)

        around = 2 * self._above(peak, self._base(peak)) + 4
        near = slice(max(peak.left, peak.top - around), min(peak.right, peak.top + around) + 1)
        base = block_base = min(light[near])
        if peak.twin or self._above(peak, base) >= _WIDE:
            twice = peak.lower + base
            left, open_left = _half_place(light, top_block, -1, peak.left, twice)
            right, open_right = _half_place(light, top_block, 1, right_block, twice)
            left, right = _BLOCK * left + _MIDDLE, _BLOCK * right + _MIDDLE
            height = max(light[peak.top] - base, 0) // _BLOCK
            start = self.starts[peak.top]
            most = max(self.light[start : start + _BLOCK])
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
            most = self.light[top]
        width = right - left
        place = (left + right) // 2
        if width >= _WIDE * _BLOCK * _FRACTION:
            bounds = peak.left, right_block
            zero = _derivative_zero(light, _BLOCK, place - _MIDDLE, width, *bounds)
            zero = None if zero is None else _BLOCK * zero + _MIDDLE
        else:
            zero = _derivative_zero(self.light, 1, place, width, first, last)
        place = place if zero is None else zero

        end = (len(self.light) - 1) * _FRACTION
        flags = SpikeFlags.NONE
        if (open_left and not begins) or (open_right and not ends):
            flags |= SpikeFlags.DOUBLE
        elif peak.twin:
            flags |= self._second(peak.lower - block_base, light[peak.top] - block_base)
        over = place < width or place + width > end
        if (open_left and begins) or (open_right and ends) or over:
            flags |= SpikeFlags.CLIPPED
        if 0 < self.about.saturated <= most:
            flags |= SpikeFlags.SATURATED
        width = min(width * _WIDTH_SCALE // _FRACTION, _U16_MAX)
        return _Found(min(max(place, 0), end), width, min(height, _U16_MAX), int(flags))


def _derivative_zero(
    light: list[int], size: int, place: int, width: int, first: int, last: int
) -> int | None:
    """Where the derivative of smoothed light is zero near a place, in fractions of a sample.

    None if too little light of this spike, from first to last, is on either side to tell. Place
    and width are in fractions of a pixel.
    """
    unit = size * _FRACTION
    middle = (place + unit // 2) // unit
    wanted = max((width + width // 8 + unit // 2) // unit, 4)
    room = min(middle - first, last - middle)
    reach = min(wanted, room, _REACH_MAX)
    if reach < 3 or 2 * reach * unit < width:
        return None
    return _crossing(light, middle, reach, first + reach, last - reach)


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
    step = max(reach // 16, 1)
    if before >= 0:
        while after >= 0:
            if high == last:
                return None
            low, before = high, after
            high = min(high + step, last)
            step *= 4
            after = slope(high)
    else:
        while before < 0:
            if low == first:
                return None
            high, after = low, before
            low = max(low - step, first)
            step *= 4
            before = slope(low)
    # where a straight line crosses, which is close; every third time the middle, to be sure
    tries = 0
    while high - low > 1:
        tries += 1
        crosses = (high - low) * _ratio(before, before - after) // _FRACTION
        inner = min(max(crosses, 1), high - low - 1) if tries % 3 else (high - low) // 2
        found = slope(low + inner)
        if found >= 0:
            low, before = low + inner, found
        else:
            high, after = low + inner, found
    return low * _FRACTION + _ratio(before, before - after)


def _ratio(part: int, whole: int) -> int:
    """In fractions, rounded."""
    shift = max(whole.bit_length() - 21, 0)  # 32 bits are enough, and the processor divides no more
    part, whole = part >> shift, whole >> shift
    return (part * _FRACTION + whole // 2) // whole
