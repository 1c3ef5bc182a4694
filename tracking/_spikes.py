"""Compiled search for spikes: bare arrays, no checks. `spikes` stands on it.

A line is converted to electrons, searched at several scales at once by differences of sums, and what
stands out is measured in pixels around it. Nothing is kept between calls, so threads do not meet.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from raytransfer._kernels import CACHE

_compile = njit(cache=CACHE, error_model="numpy", fastmath={"contract"}, nogil=True)

# as in SpikeFlags
SATURATED, CLIPPED, DOUBLE, REFLECTION, MISSING = 1, 2, 4, 8, 16

MINIMUM, GRAVITY, DERIVATIVE, LIKELIHOOD = range(4)

POSITION, SIGMA, WIDTH, HEIGHT, FLAGS, COLUMNS = range(6)

BLOCK = 16  # places looked at together; most have nothing
BIN = 4  # px; even, so that a difference between odd and even pixels cancels
SCALES = 7  # widths of the search: 4 to 256 px
NOISIER = 1.15  # times what is stated
LONELY = (
    4.0  # times its neighbours that a pixel has before it is looked at: 2.7 in a spike of 1.5 px
)
SPILL = 0.03  # of its light that an LED in sharp focus leaves beside a pixel, a hot one not
WANDER = 0.35  # of the read noise: what a dark line's slow structure may be
WIDEST = 320.0  # px; what is wider is no spike of an LED
LEVEL = 0.5  # of the height, where the width is measured
PEAK = 2.3548200450309493  # full width at half maximum of a Gaussian, in standard deviations
KERNEL = 0.35  # standard deviation of the derivative's Gaussian, in widths
REACH = 4.0  # widths to either side that a fit looks at
GROUPS = 12.0  # pixels are summed to that many a width: more tells a Gaussian's place no better
ITERATIONS = 30
MISFIT = 5.0  # standard deviations by which chi-square may exceed its mean
SECOND = 0.5  # of the height: a second peak above is another LED, below a reflection
OVERLAP = 2.0  # widths between two spikes below which they are fitted together
VAGUE = 0.25  # widths that a position may be uncertain by
PIXEL = (
    0.3  # px that a position may be uncertain by in any case: it is in a pixel, or in one of two
)
COARSE = 3.0  # px: a narrower spike is not resolved
STEEP = 0.02  # px by which the steep sides of a spike without its top shift as they cross pixels
GAP = 0.09  # of the height: two peaks with less light between them are two spikes
HORNS = 96  # px: a caustic's horns are no farther apart
SHOULDER = 0.6  # of the height by which the light may differ on both sides
FALLEN = 0.9  # of the height, at the end of the line
DIP = 0.6  # of the height: two peaks are two if it is darker between them
NARROWER = 0.4  # of the outline's width: a fit below is not of that spike
WEAKEST = 0.01  # of the height: what is smaller is no second peak but the spike's own shape


@_compile
def convert(elements, pattern, gain, inverse, settings, electrons, variance, full):
    """Electrons, their variance and full pixels of a read-out.

    `gain` is in electrons a code, `inverse` is one over the relative response; `settings` has
    variance without light, saturation in codes, squared relative uncertainty.
    """
    reference = float(_smallest(elements[16:29].copy(), 6))
    read, saturation, doubt = settings[0], settings[1], settings[2]
    codes = elements[32 : 32 + electrons.size]
    for i in range(electrons.size):
        code = codes[i]
        below = reference - code
        full[i] = (below >= saturation) | (code == 0)
        light = (below - pattern[i]) * gain[i]
        electrons[i] = light
        variance[i] = read + max(light, 0.0) * inverse[i] + doubt * light * light


@_compile
def _heal(electrons, variance):
    """Replace hot pixels: far above both neighbours, which are as if it were not there.

    An LED in sharp focus leaves light beside its pixel, on one side at least.
    """
    count = electrons.size - 4
    # slices, not places beside: the compiler then makes vectors of it
    one, two, at, four, five = (
        electrons[:count], electrons[1:], electrons[2:], electrons[3:], electrons[4:]
    )  # fmt: skip
    spread = variance[2:]
    hot = 0
    found = np.empty(max(count, 0), np.bool_)
    for k in range(count):
        beside = max(two[k], four[k])
        low = min(min(one[k], five[k]), beside)
        over = at[k] - low - LONELY * (beside - low)
        found[k] = (over > 0.0) & (over * over > 64.0 * spread[k])
        hot += found[k]
    if not hot:
        return
    for i in range(2, count + 2):
        if found[i - 2]:
            before, after = electrons[i - 1], electrons[i + 1]
            before2, after2 = electrons[i - 2], electrons[i + 2]
            step = abs(after - before - 0.5 * (after2 - before2))
            spilled = max(step, 0.5 * (before + after - before2 - after2))
            noise = math.sqrt(variance[i - 1] + variance[i + 1])
            if spilled < max(SPILL * (electrons[i] - min(before, after)), 4.0 * noise):
                electrons[i] = 0.5 * (before + after)


@_compile
def _bin(total, spread, first, bins, light, noise):
    """Of running sums of electrons and variance, those at the borders of bins."""
    for k in range(bins + 1):
        light[k] = total[first + k * BIN]
        noise[k] = spread[first + k * BIN]


@_compile
def _noise(light, noise, bins):
    """How many times larger the noise is than stated, from differences of neighbouring bins."""
    sizes = np.empty(bins)
    count = 0
    for limit in (100, 450):  # a median of a hundred scatters by a tenth: look again
        step = max(bins // limit, 2)
        count = (bins - 1) // step
        if count < 16:
            return 1.0
        large = 0
        for k in range(count):
            a = k * step
            difference = (light[a + 2] - light[a + 1]) - (light[a + 1] - light[a])
            sizes[k] = abs(difference) / math.sqrt(noise[a + 2] - noise[a])
            large += 1.4826 * sizes[k] > NOISIER
        if 2 * large <= count:
            return 1.0
    return 1.4826 * _smallest(sizes[:count], count // 2)


@_compile
def _smallest(values, n):
    """The value that sorting would put at place n; the values change places."""
    low, high = 0, values.size - 1
    while low < high:
        pivot = values[(low + high) // 2]
        i, j = low, high
        while i <= j:
            while values[i] < pivot:
                i += 1
            while values[j] > pivot:
                j -= 1
            if i <= j:
                values[i], values[j] = values[j], values[i]
                i += 1
                j -= 1
        if n <= j:
            high = j
        elif n >= i:
            low = i
        else:
            break
    return values[n]


@_compile
def _mark(light, noise, wide, near, floor, least, marked):
    """In which blocks of places, with room on both sides, light may be significant.

    Nearly all have none: no branches and no divisions, so that the compiler makes vectors of it.
    """
    far = near + wide
    l2, l3, l4 = light[wide:], light[far:], light[far + wide :]
    l5, l6 = light[far + wide + near :], light[far + wide + far :]
    n2, n3, n4 = noise[wide:], noise[far:], noise[far + wide :]
    n5, n6 = noise[far + wide + near :], noise[far + wide + far :]
    for block in range(marked.size):
        count = 0
        for n in range(BLOCK):
            k = block * BLOCK + n
            centre = l4[k] - l3[k]
            excess = centre - 0.5 * (l2[k] - light[k] + l6[k] - l5[k])
            own = n4[k] - n3[k] + floor
            around = own + 0.25 * (n2[k] - noise[k] + n6[k] - n5[k])
            count += (
                (excess > 0.0)
                & (centre > 0.0)
                & (excess * excess > least * around)
                & (centre * centre > least * own)
            )
        marked[block] = count


@_compile
def _significance(light, noise, bins, j, wide, near, floor):
    """Significance of light in `wide` bins from j on over what is beside it, squared with its sign.

    What is beside it may be cut off or missing on one side.
    """
    far = near + wide
    centre = light[j + wide] - light[j]
    own = noise[j + wide] - noise[j] + floor
    if j >= far and j + wide + far <= bins:
        beside = light[j - near] - light[j - far] + light[j + wide + far] - light[j + wide + near]
        around = noise[j - near] - noise[j - far] + noise[j + wide + far] - noise[j + wide + near]
        excess = centre - 0.5 * beside
        around = own + 0.25 * around
    else:
        around = own
        beside, sides = 0.0, 0
        for side in range(2):
            a = max(j - far, 0) if side == 0 else j + wide + near
            b = j - near if side == 0 else min(j + wide + far, bins)
            if 2 * (b - a) >= wide:
                part = wide / (b - a)
                beside += (light[b] - light[a]) * part
                around += (noise[b] - noise[a]) * part * part
                sides += 1
        if not sides:
            return -1.0
        excess = centre - beside / sides
    # beside what is darker than dark, as of an inverted output, nothing is light
    return min(excess * abs(excess) / around, centre * abs(centre) / own)


@_compile
def _scan(light, noise, bins, wander, least, scores, scales, places):
    """Find where light stands out from what is beside it, at several scales; returns how often.

    `light` and `noise` are running sums of electrons and variance over bins, with room for one more
    block. Of scale n, the width is BIN 2^n pixels and places are in steps of `_step(n)` bins.
    `scores` gets their significance, squared, which is more than `least`; scales ascend, and places
    of one scale. `wander` is the variance of what does not average over pixels.
    """
    coarse, rough = np.zeros(bins // 2 + 1 + BLOCK), np.zeros(bins // 2 + 1 + BLOCK)
    marked = np.empty(bins // BLOCK + 1, np.int64)
    found = 0
    for n in range(_scales(bins)):
        wide, step, count = 1 << n, _step(n), _places(bins, n)
        near = (wide + 1) // 2
        far = near + wide
        floor = wander * (wide * BIN) ** 2
        # between these both sides are inside
        start = min((far + step - 1) // step, count)
        stop = max((bins - wide - far) // step + 1, start)
        blocks = marked[: (stop - start + BLOCK - 1) // BLOCK]
        below = least * (1.0 - 1e-9)  # however it is rounded
        if step == 1:
            _mark(light, noise, wide, near, floor, below, blocks)
        else:
            for k in range(bins // step + 1):
                coarse[k], rough[k] = light[k * step], noise[k * step]
            _mark(coarse, rough, wide // step, near // step, floor, below, blocks)
        for block in range(-1, blocks.size + 1):
            begin = start + block * BLOCK
            end = min(begin + BLOCK, stop)
            if block < 0:
                begin, end = 0, start
            elif block == blocks.size:
                begin, end = stop, count
            elif not blocks[block]:
                continue
            for k in range(begin, end):
                score = _significance(light, noise, bins, k * step, wide, near, floor)
                if score > least:
                    scores[found], scales[found], places[found] = score, n, k
                    found += 1
    return found


@_compile
def _scales(bins):
    n = 0
    while n < SCALES and bins >= 2 << n:
        n += 1
    return n


@_compile
def _places(bins, n):
    return (bins - (1 << n)) // _step(n) + 1


@_compile
def _step(n):
    return 1 if n < 3 else 1 << (n - 2)


@_compile
def _mean(total, first, last, centre, half):
    """Mean over the pixels within `half` of one, cut off at the ends."""
    a, b = max(centre - half, first), min(centre + half, last)
    return (total[b + 1] - total[a]) / (b + 1 - a)


@_compile
def _crossing(total, first, last, start, direction, level, smooth, furthest):
    """Go until the smoothed light falls below a level; where it does, or NaN."""
    before = _mean(total, first, last, start, smooth)
    i = start
    for _ in range(furthest):
        i += direction
        if i < first or i > last:
            return np.nan
        now = _mean(total, first, last, i, smooth)
        if now < level:
            part = (before - level) / (before - now) if before > now else 0.5
            return i - direction * (1.0 - min(max(part, 0.0), 1.0))
        before = now
    return np.nan


@_compile
def _outermost(total, first, last, peak, direction, level, floor, gap, smooth, furthest):
    """The outermost pixel above a level: of a caustic's second horn, but not over a gap."""
    outer = peak
    for k in range(1, furthest + 1):
        i = peak + direction * k
        if i < first or i > last:
            break
        if _mean(total, first, last, i, smooth) >= level:
            between = abs(i - outer) - 1
            half = between // 4
            if between > 2 and _mean(total, first, last, (i + outer) // 2, half) < floor + gap:
                break
            outer = i
        elif _mean(total, first, last, i, max(smooth, 2)) < floor + 0.4 * gap:
            break
    return outer


@_compile
def _outline(total, first, last, centre, scale, shape):
    """Measure background, height and half-maximum places of what is at a place.

    `shape` gets background, height, left, right. Returns 0 if it is no spike, 1 if it is one, plus
    2 if it reaches over the left end, plus 4 if over the right.
    """
    width = float(scale)
    middle = centre
    ends = 0
    left = right = 0.0
    base = peak = 0.0
    for turn in range(3):
        # the background from beside it, on both sides where there are pixels
        near, far = int(0.5 * width + 0.75 * width + 3), int(0.5 * width + 1.75 * width + 8)
        centre_px = round(middle)
        a, b = max(centre_px - far, first), centre_px - near
        c, d = centre_px + near + 1, min(centre_px + far + 1, last + 1)
        before = (total[b] - total[a]) / (b - a) if b - a >= 2 else np.inf
        after = (total[d] - total[c]) / (d - c) if d - c >= 2 else np.inf
        base = 0.5 * (before + after)
        if math.isinf(base):
            base = min(before, after)
        if math.isinf(base):
            base = min(
                _mean(total, first, last, first + 2, 2), _mean(total, first, last, last - 2, 2)
            )
        smooth = int(width / 12)
        reach = int(0.5 * scale + 0.5 * width) + 2 if turn == 0 else int(0.75 * width) + 2
        at = centre_px
        peak = -np.inf
        for i in range(max(centre_px - reach, first), min(centre_px + reach, last) + 1):
            value = _mean(total, first, last, i, smooth)
            if value > peak:
                peak, at = value, i
        height = peak - base
        if not height > 0.0:
            return 0
        if abs(before - after) > 0.5 * SHOULDER * height:  # another spike is on one side
            base = min(before, after)
            height = peak - base
        level = base + LEVEL * height
        # the background beside one horn may be the light between both
        floor, gap = min(base, min(before, after)), GAP * height
        reach = max(reach, HORNS)
        low = _outermost(total, first, last, at, -1, level, floor, gap, smooth, reach)
        high = _outermost(total, first, last, at, 1, level, floor, gap, smooth, reach)
        furthest = int(WIDEST)
        left = _crossing(total, first, last, low, -1, level, smooth, furthest)
        right = _crossing(total, first, last, high, 1, level, smooth, furthest)
        ends = 0
        if math.isnan(left):
            if low - furthest >= first:
                return 0
            left = first - 0.5
            ends |= 2
        if math.isnan(right):
            if high + furthest <= last:
                return 0
            right = last + 0.5
            ends |= 4
        if ends == 6:
            return 0
        # one that is cut off has its peak on the line, or nobody knows where it is
        if ends:
            end = first if ends == 2 else last
            fallen = _mean(total, first, last, end, max(smooth, 1)) < base + FALLEN * height
            if abs(at - end) < max(2.0, 0.125 * (right - left)) or not fallen:
                return 0
        middle = 0.5 * (left + right)
        width = max(right - left, 1.0)
        if width > WIDEST:
            return 0
        if turn == 2 and ends == 0:  # a shoulder of something broad is no spike
            valleys = np.empty(2)
            for side in range(2):
                lowest = np.inf
                for k in range(1, int(1.5 * width) + 4):
                    i = int(left) - k if side == 0 else int(right) + 1 + k
                    if first <= i <= last:
                        lowest = min(lowest, _mean(total, first, last, i, max(smooth, 1)))
                valleys[side] = lowest
            if abs(valleys[0] - valleys[1]) > SHOULDER * height:
                return 0
        shape[0], shape[1], shape[2], shape[3] = base, height, left, right
    return 1 | ends


# --- maximum likelihood --------------------------------------------------------------------------
#
# The parameters of a fit: place, log of the edges' standard deviation, height of the bell or of the
# rims, background and its gradient; distance of the rims and light between them; height and place
# of a second bell.
PLACE, SOFT, BELL, BASE, SLOPE, APART, FLOOR, BELL2, PLACE2, PARAMETERS = range(10)

_HALF_PI = math.sqrt(math.pi / 2)
_ROOT2 = math.sqrt(0.5)
_ROOT_2PI = math.sqrt(2 * math.pi)


@_compile
def _edge(z, soft):
    """A bell of height 1; its integral; the integral of that one, as an edge of height 1."""
    u = z / soft
    bell = math.exp(-0.5 * u * u)
    error = math.erf(u * _ROOT2)
    rise = 0.5 + 0.5 * error
    return bell, soft * _HALF_PI * error, z * rise + soft * bell / _ROOT_2PI


@_compile
def _accumulate(cells, origin, size, q, rims, second, old, model, new, normal, score):
    """Chi-square and its normal equations for one set of parameters.

    `cells` has electrons, variance without the model's photons, and use (−1: full) of pixels, or of
    groups of `size` pixels, the middle of the first at `origin`. `old` holds the variances by which
    a step is judged, `new` gets those of this model; returns chi-square by the one and the other.
    """
    place, base, slope, bell = q[PLACE], q[BASE], q[SLOPE], q[BELL]
    soft = math.exp(q[SOFT])
    half = 0.5 * q[APART] if rims else 0.0
    level = q[FLOOR]
    bell2, place2 = q[BELL2], q[PLACE2]
    count = model.size
    order = PARAMETERS if second else (7 if rims else 5)
    side = 0.5 * size
    tail, tail2 = 5.8 * soft + half + side, 5.8 * soft + side
    per = level / (soft * _ROOT_2PI)  # the slope of an edge is a bell
    normal[:] = 0.0
    score[:] = 0.0
    d = np.zeros(PARAMETERS)
    d[BASE] = size
    judged = counted = 0.0
    s_w = s_t = s_tt = s_r = s_rt = 0.0
    middle = 0.5 * (count - 1)
    was, was2 = -2, -2  # cells whose right edges are known
    l_bell = l_area = l_floor = r_bell = r_area = r_floor = 0.0
    s_bell = s_area = 0.0
    for k in range(count):
        x = origin + k * size - place
        t = (k - middle) * size
        mean = (base + slope * t) * size
        near = abs(x) < tail
        near2 = second and abs(x + place - place2) < tail2
        if near:
            z = x + half
            if was != k - 1:
                l_bell, l_area, l_floor = _edge(z - side, soft)
                if rims:
                    r_bell, r_area, r_floor = _edge(z - 2.0 * half - side, soft)
            was = k
            bell1, area1, floor1 = _edge(z + side, soft)
            bells, fall = area1 - l_area, bell1 - l_bell
            stretch = (z + side) * bell1 - (z - side) * l_bell
            floor = floor1 - l_floor
            l_bell, l_area, l_floor = bell1, area1, floor1
            if rims:
                z -= 2.0 * half
                bell1, area1, floor1 = _edge(z + side, soft)
                bells_r, fall_r = area1 - r_area, bell1 - r_bell
                stretch_r = (z + side) * bell1 - (z - side) * r_bell
                floor -= floor1 - r_floor
                r_bell, r_area, r_floor = bell1, area1, floor1
                d[PLACE] = -bell * (fall + fall_r) - per * (bells - bells_r)
                d[SOFT] = bell * (bells - stretch + bells_r - stretch_r)
                d[SOFT] += level * soft / _ROOT_2PI * (fall - fall_r)
                d[BELL] = bells + bells_r
                d[APART] = 0.5 * bell * (fall - fall_r) + 0.5 * per * (bells + bells_r)
                d[FLOOR] = floor
                mean += bell * (bells + bells_r) + level * floor
            else:
                d[PLACE] = -bell * fall
                d[SOFT] = bell * (bells - stretch)
                d[BELL] = bells
                mean += bell * bells
        else:
            d[PLACE] = d[SOFT] = d[BELL] = d[APART] = d[FLOOR] = 0.0
        if near2:
            z = x + place - place2
            if was2 != k - 1:
                s_bell, s_area, _ = _edge(z - side, soft)
            was2 = k
            bell1, area1, _ = _edge(z + side, soft)
            bells, fall = area1 - s_area, bell1 - s_bell
            d[SOFT] += bell2 * (bells - (z + side) * bell1 + (z - side) * s_bell)
            d[BELL2] = bells
            d[PLACE2] = -bell2 * fall
            mean += bell2 * bells
            s_bell, s_area = bell1, area1
        else:
            d[BELL2] = d[PLACE2] = 0.0
        model[k] = mean
        variance = cells[1, k] + max(mean, 0.0)
        new[k] = variance
        use = cells[2, k]
        rest = cells[0, k] - mean
        # a full pixel says only that there is at least so much
        if use == 0.0 or (use < 0.0 and rest <= 0.0):
            continue
        judged += rest * rest / old[k]
        w = 1.0 / variance
        counted += rest * rest * w
        if near or near2:
            wr = w * rest
            d[SLOPE] = t * size
            for a in range(order):
                score[a] += wr * d[a]
                wd = w * d[a]
                for b in range(a + 1):
                    normal[a, b] += wd * d[b]
        else:
            s_w += w
            s_t += w * t
            s_tt += w * t * t
            s_r += w * rest
            s_rt += w * rest * t
    normal[BASE, BASE] += s_w * size * size
    normal[SLOPE, BASE] += s_t * size * size
    normal[SLOPE, SLOPE] += s_tt * size * size
    score[BASE] += s_r * size
    score[SLOPE] += s_rt * size
    return judged, counted


@_compile
def _solve(normal, score, active, damping, step):
    """Solve for a step of the active parameters; return the variance of the first, or NaN."""
    n = active.size
    scale = np.empty(n)
    lower = np.zeros((n, n))
    for a in range(n):
        size = normal[active[a], active[a]]
        scale[a] = 1.0 / math.sqrt(size) if size > 0.0 else 0.0
    for a in range(n):
        for b in range(a + 1):
            i, j = active[a], active[b]
            value = normal[i, j] if i >= j else normal[j, i]
            value *= scale[a] * scale[b]
            if a == b:
                value = 1.0 + damping
            for k in range(b):
                value -= lower[a, k] * lower[b, k]
            if a == b:
                if not value > 1e-13:
                    return np.nan
                lower[a, a] = math.sqrt(value)
            else:
                lower[a, b] = value / lower[b, b]
    work = np.empty(n)
    for a in range(n):
        value = score[active[a]] * scale[a]
        for k in range(a):
            value -= lower[a, k] * work[k]
        work[a] = value / lower[a, a]
    for a in range(n - 1, -1, -1):
        value = work[a]
        for k in range(a + 1, n):
            value -= lower[k, a] * work[k]
        work[a] = value / lower[a, a]
    step[:] = 0.0
    for a in range(n):
        step[active[a]] = work[a] * scale[a]
    # column of the inverse for the first parameter
    total = 0.0
    for a in range(n):
        value = 1.0 if a == 0 else 0.0
        for k in range(a):
            value -= lower[a, k] * work[k]
        work[a] = value / lower[a, a]
        total += work[a] * work[a]
    return total * scale[0] * scale[0]


@_compile
def _fit(cells, origin, size, q, rims, second, model):
    """Fit by damped scoring from `q`, in place. Returns chi-square and the place's variance."""
    count = 5 + (2 if rims or second else 0)
    active = np.empty(count, np.int64)
    for k in range(5):
        active[k] = k
    if rims:
        active[5], active[6] = APART, FLOOR
    elif second:
        active[5], active[6] = BELL2, PLACE2
    pixels = model.size
    normal, score = np.zeros((PARAMETERS, PARAMETERS)), np.zeros(PARAMETERS)
    normal2, score2 = np.zeros((PARAMETERS, PARAMETERS)), np.zeros(PARAMETERS)
    model2, variance, variance2 = np.empty(pixels), np.empty(pixels), np.empty(pixels)
    step, trial = np.zeros(PARAMETERS), q.copy()
    variance[:] = np.inf
    chi, damping, width = np.inf, 1e-3, pixels * size
    for turn in range(ITERATIONS):
        before, counted = _accumulate(
            cells, origin, size, trial, rims, second, variance, model2, variance2, normal2, score2
        )
        if turn == 0 or before <= chi * (1 + 1e-12):
            q[:] = trial
            chi = counted
            normal, normal2 = normal2, normal
            score, score2 = score2, score
            variance, variance2 = variance2, variance
            model[:] = model2
            damping = max(damping * 0.1, 1e-9)
        else:
            damping *= 10
        got = np.nan
        while damping < 1e6:
            got = _solve(normal, score, active, damping, step)
            if not math.isnan(got):
                break
            damping = max(damping * 10, 1e-6)
        if math.isnan(got):
            return chi, np.nan
        gain = 0.0
        for k in range(PARAMETERS):
            gain += step[k] * score[k]
        if gain < 1e-2 and step[PLACE] * step[PLACE] < 1e-6 * got:
            break
        for k in range(PARAMETERS):
            trial[k] = q[k] + step[k]
        soft = q[SOFT]
        trial[SOFT] = min(max(trial[SOFT], soft - 1.0), soft + 1.0)
        trial[SOFT] = min(max(trial[SOFT], -1.6), math.log(width))
        limit = 2.0 * math.exp(soft) + 0.25 * q[APART]
        trial[PLACE] = min(max(trial[PLACE], q[PLACE] - limit), q[PLACE] + limit)
        trial[APART] = min(max(trial[APART], 0.0), width)
        limit = math.exp(soft)
        trial[PLACE2] = min(max(trial[PLACE2], q[PLACE2] - limit), q[PLACE2] + limit)
    return chi, _solve(normal, score, active, 1e-10, step)


@_compile
def _extent(q, rims, out):
    """Full width at half maximum and height of a fitted shape."""
    soft = math.exp(q[SOFT])
    if not rims:
        out[0], out[1] = PEAK * soft, q[BELL]
        return
    half = 0.5 * q[APART]
    end = half + 4.0 * soft
    peak = 0.0
    for k in range(41):
        peak = max(peak, _shape(end * k / 40.0, half, soft, q[BELL], q[FLOOR]))
    high = end
    while high > 0.0 and _shape(high, half, soft, q[BELL], q[FLOOR]) < LEVEL * peak:
        high -= end / 40.0
    low, high = max(high, 0.0), high + end / 40.0
    for _ in range(20):
        mid = 0.5 * (low + high)
        if _shape(mid, half, soft, q[BELL], q[FLOOR]) < LEVEL * peak:
            high = mid
        else:
            low = mid
    out[0], out[1] = low + high, peak


@_compile
def _shape(x, half, soft, bell, floor):
    u, v = (x + half) / soft, (x - half) / soft
    value = bell * (math.exp(-0.5 * u * u) + math.exp(-0.5 * v * v))
    return value + floor * 0.5 * (math.erf(u * _ROOT2) - math.erf(v * _ROOT2))


@_compile
def _beside(cells, origin, size, model, place, width, out):
    """Find the most significant bump in what a fit leaves: its score, place and height."""
    wide = max(int(0.8 * width / size), 2)
    gap = max(wide // 2, 1)
    n = model.size
    rest, spread = np.zeros(n + 1), np.zeros(n + 1)
    for k in range(n):
        use = 1.0 if cells[2, k] > 0.0 else 0.0
        rest[k + 1] = rest[k] + use * (cells[0, k] - model[k])
        spread[k + 1] = spread[k] + cells[1, k] + max(model[k], 0.0)
    out[0] = 0.0
    for k in range(gap + 2, n - wide - gap - 1):
        centre = origin + size * (k + 0.5 * (wide - 1))
        if abs(centre - place) < 1.1 * width:
            continue
        light = (rest[k + wide] - rest[k]) / wide
        noise = (spread[k + wide] - spread[k]) / (wide * wide)
        a, b = max(k - gap - wide, 0), k - gap
        around = max(0.0, (rest[b] - rest[a]) / (b - a))
        a, b = k + wide + gap, min(k + 2 * wide + gap, n)
        around = max(around, (rest[b] - rest[a]) / (b - a))
        # the spike's own wings are on both sides
        mirror = round((2.0 * place - centre - origin) / size - 0.5 * (wide - 1))
        if mirror < 0 or mirror + wide > n:
            continue
        around = max(around, (rest[mirror + wide] - rest[mirror]) / wide)
        score = (light - around) / math.sqrt(2.0 * noise)
        if score > out[0]:
            out[0], out[1], out[2] = score, centre, (light - around) / size


@_compile
def _horns(electrons, variance, first, last, shape, out):
    """Find a caustic's two horns in an outline: their places, mean height, what is between them."""
    base, left, right = shape[0], shape[2], shape[3]
    low, high = max(math.floor(left), first), min(math.ceil(right), last)
    middle = (low + high) // 2
    one, other = low, high
    for i in range(low, middle + 1):
        if electrons[i] > electrons[one]:
            one = i
    for i in range(middle, high + 1):
        if electrons[i] > electrons[other]:
            other = i
    between = other - one
    if 2 * between < high - low or between < 3:
        return False
    light = noise = 0.0
    a, b = one + (between + 2) // 4, other - (between + 2) // 4
    for i in range(a, b + 1):
        light += electrons[i]
        noise += variance[i]
    light, noise = light / (b - a + 1), math.sqrt(noise) / (b - a + 1)
    least = min(electrons[one], electrons[other]) - base
    out[0], out[1] = one, other
    out[2] = 0.5 * (electrons[one] + electrons[other]) - base
    out[3] = max(light - base, 0.0)
    # peaks of noise alone are not so high
    doubt = 3.0 * math.sqrt(max(variance[one], variance[other])) + noise
    return light - base < min(DIP * least, least - doubt)


@_compile
def _likelihood(electrons, variance, full, first, last, shape, beside, threshold, out):
    """Maximum likelihood of one spike whose outline is known. Returns whether it came to a result.

    With another spike `beside` (its height and place; no height if there is none) both are fitted.
    Else at first a Gaussian, on groups of pixels if it is wide; where noise cannot explain what that
    leaves, with a second one beside it; at last, on single pixels, with rims.
    """
    base, height, left, right = shape[0], shape[1], shape[2], shape[3]
    width = right - left
    q, best = np.zeros(PARAMETERS), np.zeros(PARAMETERS)
    chi = spread = np.nan
    chosen, fitted = -1, 0
    bump, horns = np.zeros(3), np.zeros(4)
    known = beside[0] > 0.0
    horned = _horns(electrons, variance, max(first, 0), last, shape, horns)
    if known and horned:
        return False
    group = max(int(width / GROUPS), 1)
    for i in range(first, last + 1):
        if full[i]:
            group = 1
            break
    cells, model = np.empty((3, 1)), np.empty(1)
    origin, lit = 0.0, 0
    # horns are no Gaussian, even where light is too weak to tell
    for stage in range(2 if horned else 0, 3 if not horned else 4):
        if cells.shape[1] == 1 or (stage == 2 and group > 1):
            if stage == 2:
                group = 1
            n = (last - first + 1) // group
            origin = first + 0.5 * (group - 1)
            cells, model = np.zeros((3, n)), np.empty(n)
            lit = 0
            for k in range(n):
                use = 1.0
                for i in range(first + k * group, first + (k + 1) * group):
                    cells[0, k] += electrons[i]
                    cells[1, k] += variance[i] - max(electrons[i], 0.0)
                    if full[i]:
                        use = -1.0
                        lit += 1
                cells[2, k] = use
        q[:] = best
        if stage == 0:
            q[PLACE], q[SOFT] = 0.5 * (left + right), math.log(max(width, 1.0) / PEAK)
            q[BELL], q[BASE] = height * (1.5 if lit else 1.0), base
            if known:
                q[BELL2], q[PLACE2] = beside[0], beside[1]
        elif stage == 1:
            wide = PEAK * math.exp(q[SOFT])
            _beside(cells, origin, group, model, q[PLACE], wide, bump)
            if not (bump[0] > threshold and bump[2] > WEAKEST * q[BELL]):
                continue
            q[BELL2], q[PLACE2] = 2.0 * bump[2], bump[1]  # the first took part of it
        elif stage == 2 and horned:
            # of the outer side from the top to the half: what a bell has
            soft = 0.5 * ((horns[0] - left) + (right - horns[1])) * 2.0 / PEAK
            q[BELL], q[FLOOR] = max(horns[2] - 0.5 * horns[3], 0.2 * height), horns[3]
            q[SOFT], q[APART] = math.log(max(soft, 0.4)), horns[1] - horns[0]
            q[PLACE], q[BASE], q[SLOPE] = 0.5 * (horns[0] + horns[1]), base, 0.0
        else:
            if width < 3.5 or (horned and chosen > 0):
                break
            q[BELL], q[FLOOR] = 0.2 * height, 0.7 * height
            q[SOFT], q[APART] = math.log(max(0.12 * width, 0.6)), 0.85 * width
            q[PLACE], q[BASE], q[SLOPE] = 0.5 * (left + right), base, 0.0
        result, certain = _fit(cells, origin, group, q, stage >= 2, known or stage == 1, model)
        if not certain > 0.0:
            if horned and stage == 2:
                continue
            if known and stage == 0:
                return False
            break
        if stage == 1 and not (
            result < chi - threshold * threshold
            and q[BELL2] > WEAKEST * q[BELL]
            and abs(q[PLACE2] - q[PLACE]) > 0.8 * PEAK * math.exp(q[SOFT])
            and first <= q[PLACE2] <= last
        ):
            continue
        n = model.size
        if chosen == 1 and result - n > chi - fitted:  # of two that do not fit the better
            break
        best[:] = q
        chi, spread, chosen, fitted = result, certain, min(stage, 2), n
        if lit or known or chi < n + MISFIT * math.sqrt(2.0 * n):
            break
    # where no shape fits, pixels too coarse for it move the place, or noise chooses between two fits
    excess = chi - fitted - MISFIT * math.sqrt(2.0 * fitted)
    if not lit and excess > 0.0:
        if width < COARSE:
            spread *= 1.0 + excess / (2.0 * width + 4.0)
        elif chosen == 1:
            spread *= 2.0
    place = best[PLACE]
    if chosen < 0 or not first - 0.5 <= place <= last + 0.5:
        return False
    extent = np.empty(2)
    _extent(best, chosen == 2, extent)
    flags = 0
    if chosen == 1 or known:
        one, other = best[BELL], best[BELL2]
        if other > one and not known:
            place, extent[1] = best[PLACE2], other
        flags = DOUBLE if min(one, other) > SECOND * max(one, other) else REFLECTION
    elif chosen == 2:
        middle = _shape(0.0, 0.5 * best[APART], math.exp(best[SOFT]), best[BELL], best[FLOOR])
        if middle < DIP * extent[1]:
            flags = DOUBLE
    if not (extent[1] > 0.0 and extent[0] > 0.0):
        return False
    # one horn alone, or what else is not what was seen
    if not (lit or known) and extent[0] < NARROWER * width:
        return False
    out[POSITION], out[SIGMA] = place, math.sqrt(spread)
    out[WIDTH], out[HEIGHT], out[FLAGS] = extent[0], extent[1], flags
    return True


# --- simpler detectors ---------------------------------------------------------------------------


@_compile
def _gravity(electrons, variance, first, last, total, shape, fraction, out):
    """Centre of gravity of what is above a fraction of the height."""
    base, height, left, right = shape[0], shape[1], shape[2], shape[3]
    level = base + fraction * height
    width = right - left
    smooth = int(width / 12)
    reach = int(2 * width) + 3
    low = _crossing(total, first, last, max(int(left), first), -1, level, smooth, reach)
    high = _crossing(total, first, last, min(int(right) + 1, last), 1, level, smooth, reach)
    # straight between pixels: those at the ends count by the part that is above
    start = stop = 1.0
    if math.isnan(low):
        a = max(int(left) - reach, first)
    else:
        a = math.ceil(low)
        start = 0.5 + 0.5 * (a - low)
    if math.isnan(high):
        b = min(int(right) + 1 + reach, last)
    else:
        b = math.floor(high)
        stop = 0.5 + 0.5 * (high - b)
    light = moment = 0.0
    for i in range(a, b + 1):
        value = electrons[i] - level
        if i == a:
            value *= start
        if i == b:
            value *= stop
        light += value
        moment += value * (i - a)
    if not light > 0.0:
        return False
    centre = a + moment / light
    spread = 0.0
    for i in range(a, b + 1):
        spread += (i - centre) * (i - centre) * variance[i]
    if not a - 0.5 <= centre <= b + 0.5:
        return False
    out[POSITION], out[SIGMA] = centre, math.sqrt(spread) / light
    return True


@_compile
def _derivative(electrons, variance, first, last, shape, out):
    """Where the light, smoothed by a Gaussian, has no slope."""
    base, left, right = shape[0], shape[2], shape[3]
    width = right - left
    soft = max(KERNEL * width, 0.8)
    for _ in range(4):
        place = 0.5 * (left + right)
        for _ in range(20):
            reach = int(4.5 * soft) + 1
            middle = round(place)
            # as many pixels on either side, or the background would pull
            reach = min(reach, min(middle - first, last - middle))
            if reach < 1:
                return False
            value = bend = noise = 0.0
            for i in range(middle - reach, middle + reach + 1):
                z = (i - place) / soft
                bell = math.exp(-0.5 * z * z)
                value += (electrons[i] - base) * z * bell
                bend += (electrons[i] - base) * (z * z - 1.0) * bell / soft
                noise += variance[i] * z * z * bell * bell
            if not bend < 0.0:
                break
            step = -value / bend
            step = min(max(step, -0.5 * soft), 0.5 * soft)
            place += step
            if not left - width < place < right + width:
                break
            if abs(step) < 1e-6:
                out[POSITION], out[SIGMA] = place, math.sqrt(noise) / -bend
                return True
        soft *= 1.4  # two horns: smoothed until they are one
    return False


@_compile
def _minimum(electrons, variance, first, last, total, shape, out):
    """The pixel with the most light; its scatter from the chance of each pixel to be that one."""
    left, right = shape[2], shape[3]
    a, b = max(math.floor(left), first), min(math.ceil(right), last)
    best = a
    for i in range(a, b + 1):
        if electrons[i] > electrons[best]:
            best = i
    n = b - a + 1
    smooth = int((right - left) / 12)
    mean, noise = np.empty(n), 0.0
    for k in range(n):
        mean[k] = _mean(total, first, last, a + k, smooth)
        noise = max(noise, math.sqrt(variance[a + k]))
    top = mean.max()
    weight = np.zeros(n)
    for g in range(25):
        y = top + noise * (-2.0 + 0.3 * g)
        together = 0.0
        for k in range(n):
            u = (y - mean[k]) / noise
            if u < 6.0:
                together += math.log(max(0.5 * math.erfc(-u * _ROOT2), 1e-300))
        for k in range(n):
            u = (y - mean[k]) / noise
            if u < 6.0:
                below = max(0.5 * math.erfc(-u * _ROOT2), 1e-300)
                weight[k] += math.exp(together - 0.5 * u * u) / below
    light = moment = 0.0
    for k in range(n):
        light += weight[k]
        moment += weight[k] * k
    out[POSITION] = best
    if not light > 0.0:
        return False
    centre = moment / light
    spread = 1.0 / 12.0
    for k in range(n):
        spread += weight[k] / light * (k - centre) * (k - centre)
    out[SIGMA] = math.sqrt(spread)
    return True


@_compile
def _within(electrons, first, last, base, place):
    """Standard deviation of a place within its pixel, px, where that pixel has nearly all light.

    Light that is no wider than a pixel and leaves a part s in the next one has its middle between s
    and the border, at 0.5, and nothing tells where. Light on both sides does.
    """
    i = min(max(round(place), first), last)
    before = max(electrons[i - 1] - base, 0.0) if i > first else 0.0
    after = max(electrons[i + 1] - base, 0.0) if i < last else 0.0
    light = max(electrons[i] - base, 0.0) + before + after
    if not light > 0.0:
        return 0.0
    alone = max(1.0 - 2.0 * (before + after) / light, 0.0)
    return alone * max(1.0 - 10.0 * min(before, after) / light, 0.0) / math.sqrt(12.0)


# --- all together --------------------------------------------------------------------------------


@_compile
def _search(
    electrons, variance, full, total, light, noise, first, last, limit, kind, settings, out
):  # fmt: skip
    """Find the spikes between two pixels, the most significant first; returns how many."""
    threshold, fraction = settings[3], settings[4]
    bins = (last - first + 1) // BIN
    if bins < 3:
        return 0
    most_places = 0
    for n in range(_scales(bins)):
        most_places += _places(bins, n)
    scores = np.empty(most_places)
    scales, places = np.empty(most_places, np.int64), np.empty(most_places, np.int64)
    wander = WANDER * WANDER * settings[0]
    least = threshold * threshold
    count = _scan(light, noise, bins, wander, least, scores, scales, places)
    most = limit + 2  # what is not asked for may be too near to what is
    shapes = np.empty((most, 4))
    ends = np.empty(most, np.int64)
    found = 0
    for _ in range(4 * most):
        top, best = least, -1
        for m in range(count):
            if scores[m] > top:
                top, best = scores[m], m
        if best < 0:
            break
        n_top, k_top = scales[best], places[best]
        scale = BIN << n_top
        centre = first + k_top * _step(n_top) * BIN + 0.5 * (scale - 1)
        shape = shapes[found]
        what = _outline(total, first, last, centre, scale, shape)
        if what:
            low, high = shape[2], shape[3]
            for other in range(found):
                if low < shapes[other, 3] and high > shapes[other, 2]:
                    what = 0
        if what:
            ends[found] = what
            found += 1
            low, high = shape[2] - 2.0 - first, shape[3] + 2.0 - first
            for m in range(count):
                size, step = BIN << scales[m], _step(scales[m]) * BIN
                k = places[m]
                if max(int((low - size) / step), 0) <= k <= int(high / step) + 1:
                    scores[m] = -1.0
        else:  # only what is like it
            for m in range(max(best - 1, 0), min(best + 2, count)):
                if scales[m] == n_top and abs(places[m] - k_top) <= 1:
                    scores[m] = -1.0
        if found == most:
            break
    beside = np.zeros(2)
    kept = 0
    for n in range(min(found, limit)):
        shape = shapes[n]
        width = shape[3] - shape[2]
        middle = 0.5 * (shape[2] + shape[3])
        a = max(int(middle - REACH * width - 10.0), first)
        b = min(int(middle + REACH * width + 10.0), last)
        # a neighbour is left out, or fitted too if it overlaps
        nearest = -1
        for other in range(found):
            if other != n:
                gap = max(shapes[other, 2] - shape[3], shape[2] - shapes[other, 3])
                higher = nearest < 0 or shapes[other, 1] > shapes[nearest, 1]
                if gap < OVERLAP * width and higher:
                    nearest = other
        beside[:] = 0.0
        if nearest >= 0:
            low, high = shapes[nearest, 2], shapes[nearest, 3]
            beside[0], beside[1] = shapes[nearest, 1], 0.5 * (low + high)
            a = max(min(a, int(low - width - 10.0)), first)
            b = min(max(b, int(high + width + 10.0)), last)
        c, d = a, b  # what is left if all neighbours are left out
        for other in range(found):
            if other != n:
                if shapes[other, 3] <= shape[2]:
                    edge = int(0.5 * (shapes[other, 3] + shape[2])) + 1
                    c = max(c, edge)
                    a = a if other == nearest else max(a, edge)
                else:
                    edge = int(0.5 * (shapes[other, 2] + shape[3]))
                    d = min(d, edge)
                    b = b if other == nearest else min(b, edge)
        row = out[kept]
        row[WIDTH], row[HEIGHT], row[FLAGS] = width, shape[1], 0.0
        done = False
        if kind == LIKELIHOOD:
            for _ in range(2):  # together, or if that fails alone
                if not done:
                    done = _likelihood(
                        electrons, variance, full, a, b, shape, beside, threshold, row
                    )
                    a, b = c, d
                    beside[:] = 0.0
            # of one pixel's light no shape can be fitted
            if done and width < COARSE and not 0.0 < row[SIGMA] < VAGUE * row[WIDTH]:
                done = False
        elif kind == DERIVATIVE:
            done = _derivative(electrons, variance, c, d, shape, row)
        elif kind == MINIMUM:
            done = _minimum(electrons, variance, c, d, total, shape, row)
        if not done:
            row[WIDTH], row[HEIGHT], row[FLAGS] = width, shape[1], 0.0
            done = _gravity(electrons, variance, c, d, total, shape, fraction, row)
        # a broad spectrum, or too little light
        vague = max(VAGUE * row[WIDTH], 2.0 * PIXEL if kind == MINIMUM else PIXEL)
        if not (done and 0.0 < row[SIGMA] < vague and row[WIDTH] < WIDEST):
            continue
        if width < COARSE:
            if kind != MINIMUM:
                within = _within(electrons, c, d, shape[0], row[POSITION])
                row[SIGMA] = math.hypot(row[SIGMA], within)
            if row[WIDTH] < 1.0:
                row[WIDTH], row[HEIGHT] = 1.0, shape[1]
        flags = int(row[FLAGS])
        for i in range(max(int(shape[2]), first), min(int(shape[3]) + 1, last) + 1):
            if full[i]:
                flags |= SATURATED
                if kind in (GRAVITY, DERIVATIVE):
                    row[SIGMA] = math.hypot(row[SIGMA], STEEP * 8.0 / max(width, 8.0))
                break
        if ends[n] > 1 or row[POSITION] - width < first or row[POSITION] + width > last:
            flags |= CLIPPED
        row[FLAGS] = flags
        kept += 1
    return kept


@_compile
def find(
    elements, unlit, charge, pattern, gain, inverse, windows, limit, kind, settings, out
):  # fmt: skip
    """Find spikes of the whole line if there are no windows, else one in each; returns how many.

    Of a read-out `elements`, less an `unlit` one if that has a size; or if `charge` has one, of
    that many electrons without noise.
    """
    size = charge.size if charge.size else pattern.size
    electrons, variance, full = np.empty(size), np.empty(size), np.empty(size, np.bool_)
    if charge.size:
        for i in range(size):
            electrons[i] = charge[i]
            variance[i] = settings[0] + max(charge[i], 0.0)
            full[i] = False
    else:
        convert(elements, pattern, gain, inverse, settings, electrons, variance, full)
        if unlit.size:
            electrons2, variance2, full2 = np.empty(size), np.empty(size), np.empty(size, np.bool_)
            convert(unlit, pattern, gain, inverse, settings, electrons2, variance2, full2)
            for i in range(size):
                electrons[i] -= electrons2[i]
                variance[i] += variance2[i]
                full[i] |= full2[i]
        elif settings[5] == 0.0:
            _heal(electrons, variance)
    total, spread = np.empty(size + 1), np.empty(size + 1)
    total[0] = spread[0] = 0.0
    for i in range(size):
        total[i + 1] = total[i] + electrons[i]
        spread[i + 1] = spread[i] + variance[i]
    bins = size // BIN
    light, noise = np.zeros(bins + 1 + BLOCK), np.zeros(bins + 1 + BLOCK)
    _bin(total, spread, 0, bins, light, noise)
    factor = _noise(light, noise, bins)
    if factor > 1.0:
        for i in range(size):
            variance[i] *= factor * factor
            spread[i + 1] *= factor * factor
        _bin(total, spread, 0, bins, light, noise)
    most = 3 if windows.shape[0] else limit
    rows = np.empty((most, COLUMNS))
    for n in range(max(windows.shape[0], 1)):
        first, last = 0, size - 1
        if windows.shape[0]:
            first, last = max(windows[n, 0], 0), min(windows[n, 1], size - 1)
            bins = max((last - first + 1) // BIN, 0)
            _bin(total, spread, first, bins, light, noise)
        count = _search(
            electrons, variance, full, total, light, noise, first, last, most, kind, settings, rows
        )
        if windows.shape[0] == 0:
            out[:count] = rows[:count]
            return count
        row = out[n]
        if count == 0:
            row[POSITION] = row[WIDTH] = row[HEIGHT] = np.nan
            row[SIGMA] = np.inf
            row[FLAGS] = MISSING
            continue
        best, other = 0, -1
        for k in range(1, count):
            if rows[k, HEIGHT] > rows[best, HEIGHT]:
                best, other = k, best
            elif other < 0 or rows[k, HEIGHT] > rows[other, HEIGHT]:
                other = k
        row[:] = rows[best]
        if other >= 0:
            ratio = rows[other, HEIGHT] / rows[best, HEIGHT]
            if ratio > WEAKEST:
                row[FLAGS] = int(row[FLAGS]) | (DOUBLE if ratio > SECOND else REFLECTION)
    return windows.shape[0]
