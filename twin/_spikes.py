"""Compiled simulation of spikes: bare arrays, no checks. `spikes` stands on it."""

from __future__ import annotations

import math

import numpy as np
from numba import njit, uint64

from raytransfer._kernels import CACHE

_compile = njit(cache=CACHE, error_model="numpy", nogil=True)

# tracking.spikes.SpikeFlags
SATURATED, CLIPPED, DOUBLE, REFLECTION, MISSING = 1, 2, 4, 8, 16

EVERYTHING = -1  # who is blocked: all LEDs at once


@_compile
def mixed(value):
    """Stir the bits of a number (the last step of splitmix64)."""
    value = (value ^ (value >> uint64(30))) * uint64(0xBF58476D1CE4E5B9)
    value = (value ^ (value >> uint64(27))) * uint64(0x94D049BB133111EB)
    return value ^ (value >> uint64(31))


@_compile
def uniform(seed, who, what, number):
    """Random number from 0 to 1 that belongs to its arguments (splitmix64)."""
    value = uint64(seed) + uint64(0x9E3779B97F4A7C15) * uint64(who + 2)
    for more in (what + 1, number + 1):
        value = mixed(value) + uint64(0x9E3779B97F4A7C15) * uint64(more)
    return float(mixed(value) >> uint64(11)) / 9007199254740992.0


@_compile
def episode(seed, who, what, t, every, mean, longest):
    """Number of the episode that goes on at t, −1 if none: one in each slot of `every` s.

    A function of its arguments alone, so that whoever asks meets the same world.
    """
    if not every < math.inf:
        return -1
    slot = int(t // every)
    duration = min(-mean * math.log(1.0 - uniform(seed, who, what, 2 * slot)), longest)
    duration = min(duration, every)
    start = slot * every + (every - duration) * uniform(seed, who, what, 2 * slot + 1)
    return slot if start <= t < start + duration else -1


@_compile
def look(table, m, nearness, out):
    """Position, log width, log light and the two terms of σ² of a spike; cubic in m, linear in 1/d.

    `table` is (axes, fields): axes the first m, its step, the first nearness, its step.
    """
    axes, fields = table
    count, near = fields.shape[1], fields.shape[2]
    at = (m - axes[0]) / axes[1]
    i = min(max(int(at), 1), count - 3)
    t = at - i
    if at < 0.0 or at > count - 1:
        return False
    depth = min(max((nearness - axes[2]) / axes[3], 0.0), near - 1.0)
    j = min(int(depth), near - 2)
    s = depth - j
    a = -0.5 * t + t * t - 0.5 * t * t * t
    b = 1.0 - 2.5 * t * t + 1.5 * t * t * t
    c = 0.5 * t + 2.0 * t * t - 1.5 * t * t * t
    d = -0.5 * t * t + 0.5 * t * t * t
    for field in range(fields.shape[0]):
        value = 0.0
        for k, share in ((j, 1.0 - s), (j + 1, s)):
            f = fields[field]
            if field == 0:
                part = a * f[i - 1, k] + b * f[i, k] + c * f[i + 1, k] + d * f[i + 2, k]
            else:
                part = (1.0 - t) * f[i, k] + t * f[i + 1, k]
            value += share * part
        out[field] = value
    return not math.isnan(out[0])


@_compile
def direct(led, normal, pose, table, last, out):
    """Spike of an LED from a pose: look's fields, with log light per intensity of 1; or False."""
    sin, cos = math.sin(pose[2]), math.cos(pose[2])
    east, north = led[0] - pose[0], led[1] - pose[1]
    across = -(east * cos + north * sin)
    along = east * sin - north * cos
    distance = math.hypot(east, north)
    facing = -(east * normal[0] + north * normal[1]) / distance
    if along < 100.0 or facing <= 0.0:
        return False
    if not look(table, -across / along, 1.0 / along, out):
        return False
    out[2] += math.log(facing / (along * along))
    return 0.0 <= out[0] <= last


@_compile
def blocked(seed, led, t, faults):
    """Whether someone stands between: before one LED, or before all."""
    if episode(seed, EVERYTHING, 0, t, faults[2], faults[3], faults[4]) >= 0:
        return True
    return episode(seed, led, 0, t, faults[0], faults[1], faults[4]) >= 0


@_compile
def visible(seed, t, pose, leds, normals, rates, table, last, faults, seconds, least):
    """Number of LEDs whose spike is on the line, not blocked, and high enough if lit so long."""
    out = np.empty(5)
    count = 0
    for n in range(len(leds)):
        if direct(leds[n], normals[n], pose, table, last, out) and not blocked(seed, n, t, faults):
            count += math.exp(out[2]) * rates[n] * seconds > least
    return count


@_compile
def within(spike, windows, k):
    """Whether there is a spike, in a window if there are any."""
    there = spike[5] > 0.0
    return there and (len(windows) == 0 or windows[k, 0] <= spike[0] <= windows[k, 1])


@_compile
def expose(
    seed,
    draws,
    t,
    pose,
    leds,
    normals,
    rates,
    table,
    last,
    faults,
    noise,
    rows,
    seconds,
    windows,
    out,
):
    """What a finder says of a frame in which the LEDs `rows` are lit for `seconds`.

    One row of out for each window, the strongest there: position, sigma, width, height, flags. With
    no windows those of the line, by falling height. Draws has a row of random numbers for each LED,
    two normal ones and three from 0 to 1.
    """
    count = len(rows)
    fields = np.empty(5)
    # what there is to be found: position, sigma, width, height seen, flags, height, 1 once told
    there = np.empty((2 * count + 1, 7))
    found = 0
    for k in range(count):
        n = rows[k]
        if not direct(leds[n], normals[n], pose, table, last, fields):
            continue
        light = math.exp(fields[2]) * rates[n] * seconds[k]
        hidden = blocked(seed, n, t, faults)
        mirror = episode(seed, n, 1, t, faults[5], faults[6], faults[4])
        for kind in range(2):
            position, height, flags = fields[0], light, 0
            if kind == 0:
                if hidden:
                    continue
            else:  # a shiny wall: the same light from elsewhere
                if mirror < 0:
                    continue
                offset = 30.0 + 870.0 * uniform(seed, n, 2, mirror) ** 2
                if uniform(seed, n, 3, mirror) < 0.5:
                    offset = -offset
                position += offset
                height *= 0.05 + 0.85 * uniform(seed, n, 4, mirror)
                if not 0.0 <= position <= last:
                    continue
            if height < noise[0]:
                continue
            width = math.exp(fields[1])
            seen = min(height, noise[1])
            sigma = math.sqrt(math.exp(fields[3]) / seen + math.exp(fields[4]) / (seen * seen))
            sigma *= noise[2]
            if height > noise[1]:
                flags |= SATURATED
                over = 1.0 + math.log(height / noise[1])
                sigma *= 7.0 * over
                width *= over
            if min(position, last - position) < width:
                flags |= CLIPPED
            row = there[found]
            row[0] = position + sigma * draws[k, kind]
            row[1] = sigma
            row[2] = width
            row[3] = seen
            row[4] = flags
            row[5] = height
            row[6] = 0.0
            found += 1
    # spikes that touch are one
    for i in range(found):
        for j in range(i):
            one, other = there[i], there[j]
            if one[5] > 0.0 and other[5] > 0.0 and abs(one[0] - other[0]) < one[2] + other[2]:
                total = one[5] + other[5]
                other[0] = (one[0] * one[5] + other[0] * other[5]) / total
                other[2] += abs(one[0] - other[0])
                other[4] = int(other[4]) | int(one[4]) | DOUBLE
                other[5] = total
                one[5] = 0.0
    for k in range(count):
        out[k, 0] = math.nan
        out[k, 1] = math.inf
        out[k, 2] = math.nan
        out[k, 3] = math.nan
        out[k, 4] = MISSING
        best, second = -1, -1
        for i in range(found):
            free = len(windows) > 0 or there[i, 6] == 0.0
            brighter = best < 0 or there[i, 5] > there[best, 5]
            if free and brighter and within(there[i], windows, k):
                best = i
        if best < 0:
            continue
        for i in range(found):
            brighter = second < 0 or there[i, 5] > there[second, 5]
            if i != best and brighter and within(there[i], windows, k):
                second = i
        there[best, 6] = 1.0
        out[k, :4] = there[best, :4]
        flags = int(there[best, 4])
        if second >= 0 and abs(there[best, 0] - there[second, 0]) < 4.0 * there[best, 2]:
            flags |= REFLECTION
        out[k, 4] = flags
        if draws[k, 2] < noise[3]:  # a gross error, of which the finder knows nothing
            off = 5.0 + 295.0 * draws[k, 3]
            out[k, 0] += off if draws[k, 4] < 0.5 else -off
