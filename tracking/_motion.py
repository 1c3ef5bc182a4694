"""Compiled Kalman filter and choice of LEDs: bare arrays, no checks, changed in place.

`motion` and `scheduling` stand on it. The state is x, y, heading, their rates, the tracker's height,
the gyroscope's bias and the square of the height: light knows the square of a difference of heights
only, (z − h)² = z² − 2 z h + h², which is linear in height and square, and not in the height alone.
Where that is unknown, a slope at some height would be right for none.
"""

from __future__ import annotations

import math
from types import FunctionType

import numpy as np
from numba import njit

from raytransfer._kernels import CACHE
from tracking import camera

X, Y, PHI, VX, VY, OMEGA, HEIGHT, BIAS, SQUARE = range(9)
STATES = 9

# outcomes of a measurement
USED, REJECTED, UNSEEN = 0, 1, 2

NEAR = 20.0  # mm before the centre of projection: nearer LEDs are not seen
LEVEL = 1e-3  # mm of height, at least, at which slopes are taken: at 0 that by the height is 0

_compile = njit(cache=CACHE, error_model="numpy", nogil=True)

# the camera's own formula, compiled: there is one
_image = _compile(
    FunctionType(
        camera.image.__code__, {"shape": _compile(camera.shape), "__name__": __name__}, "_image"
    )
)


@_compile
def project(state, led, lens, row):
    """Predicted pixel of an LED, NaN if it is far from the field; row gets its slopes by the state.

    The last two numbers of lens are the ends of the field, tangents: beyond, the polynomials of a
    camera mean nothing and may come back to the line.
    """
    sin, cos = math.sin(state[PHI]), math.cos(state[PHI])
    east, north = led[0] - state[X], led[1] - state[Y]
    across = -(east * cos + north * sin)  # optical X
    along = east * sin - north * cos  # distance
    depth = along + lens[2]
    if depth < NEAR or not lens[-2] * depth <= -across <= lens[-1] * depth:
        return math.nan
    square = led[2] * (led[2] - 2.0 * state[HEIGHT]) + state[SQUARE]
    up = max(math.sqrt(max(square, 0.0)), LEVEL)
    pixel, by_x, by_y, by_z = _image(lens, across, up, along)
    by_square = by_y / (2.0 * up)
    row[:] = 0.0
    row[X] = by_x * cos - by_z * sin
    row[Y] = by_x * sin + by_z * cos
    row[PHI] = by_x * along - by_z * across
    row[HEIGHT] = -2.0 * led[2] * by_square
    row[SQUARE] = by_square
    return pixel + by_square * (square - up * up)  # an estimate may be a little below 0


@_compile
def predict(state, cov, dt, density):
    """Carry the state on by dt s: constant velocity, white acceleration.

    Power spectral densities of the acceleration (mm²/s³) and angular acceleration (rad²/s³), of
    the walks of height (mm²/s) and bias (rad²/s³).
    """
    if dt <= 0.0:
        return
    for i in range(3):
        state[i] += dt * state[i + 3]
        for j in range(STATES):
            cov[i, j] += dt * cov[i + 3, j]
    for i in range(3):
        for j in range(STATES):
            cov[j, i] += dt * cov[j, i + 3]
    for i in range(3):
        q = density[0] if i < 2 else density[1]
        cov[i, i] += q * dt * dt * dt / 3.0
        cov[i, i + 3] += q * dt * dt / 2.0
        cov[i + 3, i] += q * dt * dt / 2.0
        cov[i + 3, i + 3] += q * dt
    cov[BIAS, BIAS] += density[3] * dt
    walk = density[2] * dt
    if walk > 0.0:  # h + w: its square grows by 2 h w + w²
        height = state[HEIGHT]
        square = max(state[SQUARE], height * height)
        cov[HEIGHT, HEIGHT] += walk
        cov[HEIGHT, SQUARE] += 2.0 * height * walk
        cov[SQUARE, HEIGHT] += 2.0 * height * walk
        cov[SQUARE, SQUARE] += (4.0 * square + 2.0 * walk) * walk
        state[SQUARE] += walk


@_compile
def spread(cov, row, column):
    """Variance of a linear form of the state; column gets their covariance."""
    total = 0.0
    for i in range(STATES):
        value = 0.0
        for j in range(STATES):
            value += cov[i, j] * row[j]
        column[i] = value
        total += value * row[i]
    return max(total, 0.0)


@_compile
def absorb(cov, row, column, total, variance):
    """Covariance after a scalar measurement, in Joseph's form: it stays symmetric and positive.

    P' = A P Aᵀ + K R Kᵀ with A = 1 − K h, and P hᵀ = column.
    """
    scale = total + variance
    for i in range(STATES):
        gain = column[i] / scale
        for j in range(STATES):
            cov[i, j] -= gain * column[j]  # A P
    for i in range(STATES):
        left = 0.0
        for j in range(STATES):
            left += cov[i, j] * row[j]  # A P hᵀ
        left -= column[i] / scale * variance
        for j in range(STATES):
            cov[i, j] -= left * column[j] / scale
    for i in range(STATES):
        for j in range(i):
            cov[i, j] = 0.5 * (cov[i, j] + cov[j, i])
            cov[j, i] = cov[i, j]


@_compile
def take(state, cov, residual, variance, bend, gate, row, column, result):
    """Take a measurement in, unless its residual is too large for the gate (χ²).

    Bend is the part of the prediction's variance that straight lines leave out.
    """
    total = spread(cov, row, column)
    variance += bend * total
    scale = total + variance
    result[1] = residual
    result[2] = scale
    if not residual * residual <= gate * scale:
        return REJECTED
    for i in range(STATES):
        state[i] += column[i] * residual / scale
    absorb(cov, row, column, total, variance)
    return USED


@_compile
def measure(state, cov, led, lens, pixel, variance, blur, gate, row, column, result):
    """Take a spike in; result gets the prediction, the residual and the variance of that.

    Variance is that of the spike, px²; blur that of the LED's place along the line, mm².
    """
    predicted = project(state, led, lens, row)
    result[0] = predicted
    if math.isnan(predicted):
        result[1] = math.nan
        result[2] = math.inf
        return UNSEEN
    variance += blur * (row[X] * row[X] + row[Y] * row[Y])
    # terms of second order: a shift across times one along, over the distance, and heading squared
    east, north = led[0] - state[X], led[1] - state[Y]
    apart = east * east + north * north
    bend = (cov[X, X] + cov[Y, Y]) / apart + cov[PHI, PHI]
    if (
        cov[SQUARE, SQUARE] > 0.0
    ):  # its slopes change with the pose and, beside the distance, itself
        by_height, by_square = row[HEIGHT], row[SQUARE]
        doubt = by_height * by_height * cov[HEIGHT, HEIGHT]
        doubt += 2.0 * by_height * by_square * cov[HEIGHT, SQUARE]
        doubt += by_square * by_square * cov[SQUARE, SQUARE]
        variance += (bend + cov[SQUARE, SQUARE] / (apart * apart)) * doubt
    return take(state, cov, pixel - predicted, variance, bend, gate, row, column, result)


@_compile
def turn(state, cov, rate, variance, gate, row, column, result):
    """Take a gyroscope's rate in: heading's rate plus the bias."""
    row[:] = 0.0
    row[OMEGA] = 1.0
    row[BIAS] = 1.0
    result[0] = state[OMEGA] + state[BIAS]
    return take(state, cov, rate - result[0], variance, 0.0, gate, row, column, result)


@_compile
def expect(state, cov, leds, normals, lens, last, pixels, sigmas, visible):
    """Predicted pixel of every LED, its standard deviation, whether it shines here and is on the line."""
    row = np.empty(STATES)
    column = np.empty(STATES)
    for n in range(len(leds)):
        pixel = project(state, leds[n], lens, row)
        pixels[n] = pixel
        sigmas[n] = math.inf if math.isnan(pixel) else math.sqrt(spread(cov, row, column))
        facing = (state[X] - leds[n, 0]) * normals[n, 0] + (state[Y] - leds[n, 1]) * normals[n, 1]
        visible[n] = facing > 0.0 and 0.0 <= pixel <= last


@_compile
def fit(state, basis, prior, density, blur, ages, rows, pixels, variances, leds, lens, information):
    """Fit a path to spikes of some time; returns χ², NaN if it fails.

    Ages are times minus that of the state, s, 0 or less. What is sought are multiples of the
    columns of basis, to be added to the state: prior has the information that they are 0. The path
    goes at constant rates but for white acceleration of this density, which moves spikes of about
    the same time alike; LEDs are off their places by a variance of blur. Gauss–Newton with halved
    steps; information gets the normal matrix.
    """
    unknowns = basis.shape[1]
    count = len(pixels)
    row = np.empty(STATES)
    residuals, slopes, pose = np.empty(count), np.empty((count, unknowns)), np.empty((count, 3))
    noise = np.zeros((count, count))
    start = state.copy()
    found, at, step = np.zeros(unknowns), np.zeros(unknowns), np.zeros(unknowns)
    best = math.inf
    for _ in range(30):
        right = -(prior @ at)
        cost = -(at @ right)
        chi = 0.0
        now = start + basis @ at
        moved = now.copy()
        for n in range(count):
            for i in range(3):
                moved[i] = now[i] + ages[n] * now[i + 3]
            predicted = project(moved, leds[rows[n]], lens, row)
            if math.isnan(predicted):
                chi = math.inf
                break
            for i in range(3):
                pose[n, i] = row[i]
                row[i + 3] = ages[n] * row[i]
            slopes[n] = row @ basis
            residuals[n] = pixels[n] - predicted
        if chi == 0.0:
            if not noise[0, 0]:  # it hardly changes with the pose
                for n in range(count):
                    for m in range(n + 1):
                        short, long = max(ages[n], ages[m]), min(ages[n], ages[m])
                        shared = short * short * (short / 6 - long / 2)
                        moves = pose[n, 0] * pose[m, 0] + pose[n, 1] * pose[m, 1]
                        turns = pose[n, 2] * pose[m, 2]
                        noise[n, m] = shared * (density[0] * moves + density[1] * turns)
                        if rows[n] == rows[m]:
                            noise[n, m] += blur * moves
                    noise[n, n] += variances[n]
                noise = np.linalg.cholesky(noise)
            for n in range(count):  # to spikes of unit variance
                for m in range(n):
                    residuals[n] -= noise[n, m] * residuals[m]
                    slopes[n] -= noise[n, m] * slopes[m]
                residuals[n] /= noise[n, n]
                slopes[n] /= noise[n, n]
            chi = residuals @ residuals
        if not chi + cost < best:
            if np.abs(step[:2]).max() < 1e-3:
                break
            step *= 0.5
            at = found + step
            continue
        gained = best - chi - cost
        best = chi + cost
        normal = prior + slopes.T @ slopes
        right += slopes.T @ residuals
        found[:] = at
        state[:] = now
        information[:] = normal
        if gained < 1e-3:
            break
        size = np.sqrt(np.diag(normal))  # mm beside rad: compare what has no unit
        scaled = normal / np.outer(size, size)
        if not np.linalg.cond(scaled) < 1e12:
            return math.nan
        step = np.linalg.solve(scaled, right / size) / size
        at = found + step
    return best


@_compile
def fluxes(x, y, leds, normals, gains, common, weights):
    """Electrons in the peak of each LED per clock: gain × cosine / distance^1.5, 0 from behind.

    Gains are logarithms; a weight says how far one's own counts, and not the common one.
    """
    out = np.zeros(len(leds))
    for n in range(len(leds)):
        east, north = x - leds[n, 0], y - leds[n, 1]
        facing = east * normals[n, 0] + north * normals[n, 1]
        if facing > 0.0:
            gain = math.exp(common + weights[n] * (gains[n] - common))
            out[n] = facing * gain * (east * east + north * north + 1.0) ** -1.25
    return out


@_compile
def fading(times, seconds, constant):
    """What is left at a time of what was learnt at earlier times: 1 of the present, 0 of never."""
    return np.exp(np.minimum(times - seconds, 0.0) / constant)


@_compile
def inside(pixel, variance, last):
    """Probability that a spike is on the line, of pixels 0 to last."""
    if math.isnan(pixel):
        return 0.0
    scale = 1.0 / math.sqrt(2.0 * variance + 1e-12)
    return 0.5 * (math.erf(pixel * scale) - math.erf((pixel - last) * scale))


@_compile
def choose(
    state, cov, density, first, period, leds, lens, last, chances, variances, blur, apart, chosen
):
    """Choose LEDs frame by frame, each time the one that is expected to tell most about the place.

    That is by how much a spike lowers the sum of the variances of x and y, times the probability
    that the LED is seen and found; with each one chosen the covariance shrinks as it would. Spikes
    of a frame are to be `apart` px and three standard deviations each apart. Chosen gets rows of
    LEDs, −1 where there is none.
    """
    frames, places = chosen.shape
    chosen[:] = -1
    state = state.copy()
    cov = cov.copy()
    rows = np.empty((len(leds), STATES))
    column = np.empty(STATES)
    pixels = np.empty(len(leds))
    seen = np.empty(len(leds))
    noise = np.empty(len(leds))
    spreads = np.empty(len(leds))
    for frame in range(frames):
        predict(state, cov, first if frame == 0 else period, density)
        for n in range(len(leds)):
            pixels[n] = math.nan
            if chances[n] > 0.0:
                pixels[n] = project(state, leds[n], lens, rows[n])
            if math.isnan(pixels[n]):
                seen[n] = 0.0
                continue
            spreads[n] = spread(cov, rows[n], column)
            seen[n] = chances[n] * inside(pixels[n], spreads[n], last)
            noise[n] = variances[n] + blur * (rows[n, X] ** 2 + rows[n, Y] ** 2)
        for place in range(places):
            best, most = -1, 0.0
            for n in range(len(leds)):
                if seen[n] < 0.01:
                    continue
                free = True
                for other in chosen[frame, :place]:
                    reach = apart + 3.0 * (math.sqrt(spreads[n]) + math.sqrt(spreads[other]))
                    free &= abs(pixels[n] - pixels[other]) > reach
                if free:
                    total = spread(cov, rows[n], column)
                    told = seen[n] * (column[X] ** 2 + column[Y] ** 2) / (total + noise[n])
                    if told > most:
                        best, most = n, told
            if best < 0:
                break
            chosen[frame, place] = best
            if seen[best] > 0.5:
                total = spread(cov, rows[best], column)
                absorb(cov, rows[best], column, total, noise[best])
