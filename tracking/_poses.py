"""Compiled pose estimation: bare arrays, no checks. `poses` stands on it.

A pose is [x, y, heading]; height is given, and integrated over in `over_heights`. A heading with
infinite `sharpness` (1/σ²) is known and stays as it is. A row of `leds` is x, y, z and the normal
of the side to which the LED shines, zeros if it may be seen from anywhere.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numba.extending import register_jitable

from raytransfer._kernels import CACHE
from tracking import camera, poses

_compile = njit(cache=CACHE, error_model="numpy", nogil=True)

shape = register_jitable(camera.shape)  # in place: so that image finds it
image = _compile(camera.image)
by_pose = _compile(poses.by_pose)

LIKELY = 12.0
"""Heights whose log-likelihood is lower by more than this are left out."""

FINE = 0.1
"""Log-likelihood by which the cells beside a maximum may be lower."""

CELLS = 512


@_compile
def closed_form(m, x, y, w, known, pose):
    """Set pose to where LEDs at x, y have the tangents m; w are weights of the equations.

    Every LED says C a + S b + P − m Q = 0 with a = −(x + m y), b = m x − y, C = cos φ, S = sin φ,
    P = C x₀ + S y₀, Q = S x₀ − C y₀. P and Q are eliminated by an orthogonal basis of their columns;
    (C, S) is the right singular vector of the rest with the smaller singular value.
    """
    n = len(m)
    middle_x, middle_y = x.mean(), y.mean()
    pp = pt = 0.0
    for i in range(n):
        pp += w[i] * w[i]
        pt -= w[i] * w[i] * m[i]
    mean = pt / pp  # of −m
    tt = 0.0
    for i in range(n):
        tt += (w[i] * (-m[i] - mean)) ** 2
    if not tt > 0:
        return False
    a_p = b_p = a_t = b_t = 0.0
    for i in range(n):
        dx, dy = x[i] - middle_x, y[i] - middle_y
        a, b, t = -(dx + m[i] * dy), m[i] * dx - dy, -m[i] - mean
        weight = w[i] * w[i]
        a_p += weight * a
        b_p += weight * b
        a_t += weight * a * t
        b_t += weight * b * t
    a_p, b_p, a_t, b_t = a_p / pp, b_p / pp, a_t / tt, b_t / tt
    if known:
        c, s = math.cos(pose[2]), math.sin(pose[2])
    else:
        aa = ab = bb = 0.0
        for i in range(n):
            dx, dy = x[i] - middle_x, y[i] - middle_y
            t = -m[i] - mean
            a = w[i] * (-(dx + m[i] * dy) - a_p - a_t * t)
            b = w[i] * (m[i] * dx - dy - b_p - b_t * t)
            aa += a * a
            ab += a * b
            bb += b * b
        angle = 0.5 * math.atan2(2 * ab, aa - bb)
        c, s = -math.sin(angle), math.cos(angle)
    q = -(c * a_t + s * b_t)
    p = -(c * a_p + s * b_p) - q * mean
    ahead = -n * q  # sum of distances; x and y are from their mean
    if ahead < 0 and not known:
        c, s, p, q = -c, -s, -p, -q
    pose[0] = middle_x + p * c + q * s
    pose[1] = middle_y + p * s - q * c
    if not known:
        pose[2] = math.atan2(s, c)
    return ahead != 0


@_compile
def begin(c, leds, pixels, inverse, chosen, height, known, pose):
    """Set pose to the closed form's for the LEDs chosen; 1/σ px each."""
    n = 0
    for i in range(len(pixels)):
        n += chosen[i]
    m, x, y, w, q = np.empty(n), np.empty(n), np.empty(n), np.empty(n), np.zeros(n)
    rise, u, sharp = np.empty(n), np.empty(n), np.empty(n)
    k = 0
    level = True
    for i in range(len(pixels)):
        if chosen[i]:
            x[k], y[k], rise[k], u[k], sharp[k] = (
                leds[i, 0],
                leds[i, 1],
                leds[i, 2] - height,
                pixels[i],
                inverse[i],
            )
            level = level and rise[k] == 0
            w[k] = inverse[i]
            k += 1
    pupil = pose.copy()
    for _step in range(2 if level else 4):
        for k in range(n):
            aim = (u[k] - c[1]) / c[0]
            value = aim
            for _ in range(camera.NEWTON_STEPS):
                at, slope, _q = shape(c, value, q[k])
                value -= (at - aim) / slope
            if not slope > 0:  # beyond the field
                return False
            m[k] = value
        if not closed_form(m, x, y, w, known, pupil):
            return False
        cos, sin = math.cos(pupil[2]), math.sin(pupil[2])
        for k in range(n):
            z = sin * (x[k] - pupil[0]) - cos * (y[k] - pupil[1])
            if not z > 0:
                return False
            w[k] = sharp[k] / z
            q[k] = (rise[k] / (z - c[2] + c[3])) ** 2 / (1 + m[k] * m[k])
    for i in range(len(pixels)):
        if chosen[i] and _dark(leds[i], pupil):
            return False
    # the centre of projection is behind the tracker's place
    pose[0] = pupil[0] + c[2] * sin
    pose[1] = pupil[1] - c[2] * cos
    pose[2] = pupil[2]
    return True


@_compile
def _dark(led, pose):
    """Whether an LED shines away from a place."""
    return (led[0] - pose[0]) * led[3] + (led[1] - pose[1]) * led[4] > 0


@_compile
def expected(c, led, pose, height):
    """Spike of an LED, its derivatives along x, y, heading and height, and the distance to the pupil.

    The distance is not positive if no light comes from there.
    """
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    dx, dy = led[0] - pose[0], led[1] - pose[1]
    across, distance = -cos * dx - sin * dy, sin * dx - cos * dy
    u, by_x, by_y, by_z = image(c, across, led[2] - height, distance)
    ux, uy, up = by_pose(by_x, by_z, across, distance, cos, sin)
    return u, ux, uy, up, -by_y, -math.inf if _dark(led, pose) else distance + c[2]


@_compile
def _normal(c, leds, pixels, inverse, chosen, height, heading, sharpness, pose, a, g):
    """Normal equations at a pose; returns chi², infinite if an LED chosen is not in front."""
    a[:] = 0.0
    g[:] = 0.0
    chi2 = 0.0
    for i in range(len(pixels)):
        if not chosen[i]:
            continue
        u, ux, uy, up, _, z = expected(c, leds[i], pose, height)
        if not z > 0:
            return math.inf
        r = (pixels[i] - u) * inverse[i]
        ux, uy, up = ux * inverse[i], uy * inverse[i], up * inverse[i]
        chi2 += r * r
        g[0] += ux * r
        g[1] += uy * r
        g[2] += up * r
        a[0, 0] += ux * ux
        a[1, 0] += uy * ux
        a[1, 1] += uy * uy
        a[2, 0] += up * ux
        a[2, 1] += up * uy
        a[2, 2] += up * up
    if math.isinf(sharpness):
        a[2, 0] = a[2, 1] = g[2] = 0.0
        a[2, 2] = 1.0
    else:
        away = heading - pose[2]
        away -= 2 * math.pi * round(away / (2 * math.pi))
        chi2 += sharpness * away * away
        a[2, 2] += sharpness
        g[2] += sharpness * away
    return chi2


@_compile
def _cholesky(a, damping, low):
    """Factor the symmetric matrix whose lower half is given, its diagonal raised."""
    for i in range(len(a)):
        for j in range(i + 1):
            s = a[i, j] * (1 + damping) if i == j else a[i, j]
            for k in range(j):
                s -= low[i, k] * low[j, k]
            if i == j:
                # rounding leaves so much of what is not determined
                if not s > 1e-13 * a[i, i]:
                    return False
                low[i, i] = math.sqrt(s)
            else:
                low[i, j] = s / low[j, j]
    return True


@_compile
def _solve(low, g, step):
    for i in range(3):
        s = g[i]
        for k in range(i):
            s -= low[i, k] * step[k]
        step[i] = s / low[i, i]
    for i in range(2, -1, -1):
        s = step[i]
        for k in range(i + 1, 3):
            s -= low[k, i] * step[k]
        step[i] = s / low[i, i]


@_compile
def fit(c, leds, pixels, inverse, chosen, height, heading, sharpness, pose, covariance):
    """Refine a pose by Levenberg and Marquardt's method.

    Returns chi² and half the logarithm of the covariance's determinant; chi² is infinite if there
    is no pose with the LEDs in front, the other NaN if the pose is not determined.
    """
    a, low, g, step = np.empty((3, 3)), np.zeros((3, 3)), np.empty(3), np.empty(3)
    there, more, down = np.empty(3), np.empty((3, 3)), np.empty(3)
    chi2 = _normal(c, leds, pixels, inverse, chosen, height, heading, sharpness, pose, a, g)
    if math.isinf(chi2):
        return chi2, math.nan
    damping = 0.0
    for _ in range(60):
        if not _cholesky(a, damping, low):
            damping = max(1e-9, 10 * damping)
            if damping > 1e6:
                break
            continue
        _solve(low, g, step)
        size = 0.0
        for i in range(3):
            there[i] = pose[i] + step[i]
            size += step[i] * g[i]
        if size < 1e-20:  # σ²
            break
        new = _normal(
            c, leds, pixels, inverse, chosen, height, heading, sharpness, there, more, down
        )
        if new <= chi2:
            better = chi2 - new
            chi2 = new
            pose[:] = there
            a[:] = more
            g[:] = down
            damping = damping / 10 if damping > 1e-8 else 0.0
            if size < 1e-10 or better < 1e-13 * chi2:
                break
        elif size < 1e-10:
            break
        else:
            damping = max(1e-4, 10 * damping)
            if damping > 1e9:
                break
    if not _cholesky(a, 0.0, low):
        return chi2, math.nan
    unit = np.zeros(3)
    for j in range(3):
        unit[:] = 0.0
        unit[j] = 1.0
        _solve(low, unit, step)
        covariance[:, j] = step
    if math.isinf(sharpness):
        covariance[2, 2] = 0.0
    return chi2, -math.log(low[0, 0] * low[1, 1] * low[2, 2])


@_compile
def judge(
    c, leds, pixels, inverse, chosen, height, height_sharpness, sharpness, pose, residuals, left
):
    """Set the residuals of all spikes, px, and the part of each one's error that is left in its own.

    The rest, of 1, goes into the pose. All is 0 where the pose is not determined.
    """
    a, low, rows = np.zeros((4, 4)), np.zeros((4, 4)), np.zeros((len(leds), 4))
    left[:] = 0.0
    for i in range(len(leds)):
        u, ux, uy, up, uh, z = expected(c, leds[i], pose, height)
        residuals[i] = pixels[i] - u if z > 0 else math.nan
        if chosen[i]:
            rows[i] = (ux, uy, up, uh)
            rows[i] *= inverse[i]
            if math.isinf(sharpness):
                rows[i, 2] = 0.0
            if math.isinf(height_sharpness):
                rows[i, 3] = 0.0
            for j in range(4):
                for k in range(j + 1):
                    a[j, k] += rows[i, j] * rows[i, k]
    a[2, 2] += 1.0 if math.isinf(sharpness) else sharpness
    a[3, 3] += 1.0 if math.isinf(height_sharpness) else height_sharpness
    if not _cholesky(a, 0.0, low):
        return
    for i in range(len(leds)):
        if chosen[i]:
            left[i] = 1.0
            for j in range(4):
                for k in range(j):
                    rows[i, j] -= low[j, k] * rows[i, k]
                rows[i, j] /= low[j, j]
                left[i] -= rows[i, j] ** 2
            left[i] = max(left[i], 0.0)


@_compile
def bend(c, leds, inverse, chosen, height, pose, away):
    """How far spikes are from moving in proportion with the pose, which goes away to both sides.

    Returns the second-order part of what they do over the first-order part, of all in σ.
    """
    even = odd = 0.0
    for i in range(len(leds)):
        if chosen[i]:
            here = expected(c, leds[i], pose, height)
            ahead = expected(c, leds[i], pose + away, height)
            behind = expected(c, leds[i], pose - away, height)
            if not (ahead[5] > 0 and behind[5] > 0):
                return math.inf
            even += ((ahead[0] + behind[0] - 2 * here[0]) * inverse[i]) ** 2
            odd += ((ahead[0] - behind[0]) * inverse[i]) ** 2
    return math.sqrt(even / odd) if odd > 0 else math.inf


@_compile
def _reach(c, leds, chosen, elevation, pose):
    """Heights of the tracker from which all LEDs chosen are within its reach."""
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    first, last = -math.inf, math.inf
    for i in range(len(leds)):
        if chosen[i]:
            z = sin * (leds[i, 0] - pose[0]) - cos * (leds[i, 1] - pose[1]) + c[3]
            first = max(first, leds[i, 2] - elevation * z)
            last = min(last, leds[i, 2] + elevation * z)
    return first, last


@_compile
def over_heights(
    c,
    leds,
    pixels,
    inverse,
    chosen,
    prior,
    spread,
    elevation,
    heading,
    sharpness,
    pose,
    covariance,
    likeliest,
):
    """Mean pose and covariance over all heights, each as likely as spikes and prior make it.

    Heights are divided into cells; those that matter, and all about a maximum that may come to
    matter (there may be two, above and below the LEDs), again until they are fine enough. Returns
    the least chi², the mean height, its standard deviation, and whether the pose is determined;
    sets `likeliest` to the pose and height of the least chi².
    """
    first, last = _reach(c, leds, chosen, elevation, pose)
    if not math.isinf(spread):
        low, high = max(first, prior - 4 * spread), min(last, prior + 4 * spread)
        if low < high:
            first, last = low, high
        else:  # out of reach, it is said: believed
            first, last = prior - 4 * spread, prior + 4 * spread
    cells = 15
    at, width = np.empty(CELLS), np.empty(CELLS)
    found, spreads = np.empty((CELLS, 3)), np.empty((CELLS, 3, 3))
    chi, likely = np.full(CELLS, math.inf), np.full(CELLS, -math.inf)
    for k in range(cells):
        width[k] = (last - first) / cells
        at[k] = first + (k + 0.5) * width[k]
    solved = 0
    determined = True
    for _ in range(12):
        for k in range(solved, cells):
            found[k] = pose
            chi[k], root = fit(
                c, leds, pixels, inverse, chosen, at[k], heading, sharpness, found[k], spreads[k]
            )
            if math.isinf(chi[k]):
                continue
            if math.isnan(root):
                determined = False
                root = 0.0
                spreads[k] = 0.0
            if not math.isinf(spread):
                chi[k] += ((at[k] - prior) / spread) ** 2
            likely[k] = root - chi[k] / 2
        solved = cells
        best = likely[:cells].max()
        if math.isinf(best):
            return math.inf, prior, spread, False
        order = np.argsort(at[:cells])
        split = np.zeros(cells, dtype=np.bool_)
        for n in range(cells):
            k = order[n]
            before, after = order[max(n - 1, 0)], order[min(n + 1, cells - 1)]
            top = likely[k]
            if math.isinf(top) or top < max(likely[before], likely[after]):
                continue
            # by no more than it falls off can it be higher within a cell
            fall = 0.0
            for side in (before, after):
                fall = max(fall, top - likely[side] if not math.isinf(likely[side]) else LIKELY)
            if fall > FINE and top + fall > best - LIKELY:
                split[before] = split[k] = split[after] = True
        if not split.any():
            break
        for k in range(cells):
            if (split[k] or likely[k] > best - LIKELY) and solved + 2 <= CELLS:
                width[k] /= 3
                at[solved], at[solved + 1] = at[k] - width[k], at[k] + width[k]
                width[solved] = width[solved + 1] = width[k]
                solved += 2
        cells, solved = solved, cells
    k = np.argmin(chi[:cells])
    likeliest[:3] = found[k]
    likeliest[3] = at[k]
    best = likely[:cells].max()
    total = height = square = 0.0
    pose[:] = 0.0
    for k in range(cells):
        weight = width[k] * math.exp(likely[k] - best)
        likely[k] = weight
        total += weight
        height += weight * at[k]
        for i in range(3):
            pose[i] += weight * found[k, i] if weight else 0.0
    pose /= total
    height /= total
    covariance[:] = 0.0
    for k in range(cells):
        if likely[k]:
            weight = likely[k] / total
            square += weight * ((at[k] - height) ** 2 + width[k] ** 2 / 12)
            for i in range(3):
                for j in range(3):
                    covariance[i, j] += weight * (
                        spreads[k, i, j] + (found[k, i] - pose[i]) * (found[k, j] - pose[j])
                    )
    return chi[:cells].min(), height, math.sqrt(square), determined


@_compile
def _draw(seed, n):
    """Return the next seed and a number below n; the same numbers in every run."""
    seed = (1103515245 * seed + 12345) % 2147483648
    return seed, (seed >> 12) % n


@_compile
def consensus(c, leds, pixels, inverse, chosen, height, known, limit, tries, pose):
    """Set pose to that of the minimal set of LEDs which most of the others agree with.

    Sets are three LEDs, or two if the heading is known: all of them, or `tries` of them by
    chance if there are more. Returns the cost: the sum of squared residuals in σ, each at most
    limit².
    """
    n = len(pixels)
    total = n * (n - 1) // 2 if known else n * (n - 1) * (n - 2) // 6
    some, there, found = np.zeros(n, dtype=np.bool_), pose.copy(), pose.copy()
    best = math.inf
    seed = 1
    i, j, k = 0, 1, (1 if known else 2)
    for _step in range(min(total, tries)):
        if total > tries:
            while True:
                seed, i = _draw(seed, n)
                seed, j = _draw(seed, n)
                seed, k = (seed, j) if known else _draw(seed, n)
                if i != j and (known or (i != k and j != k)):
                    break
        some[:] = False
        some[i] = some[j] = some[k] = True
        there[:] = pose
        if begin(c, leds, pixels, inverse, some, height, known, there):
            cost = 0.0
            for led in range(n):
                if chosen[led]:
                    u, _, _, _, _, z = expected(c, leds[led], there, height)
                    r = (pixels[led] - u) * inverse[led]
                    cost += min(r * r, limit * limit) if z > 0 else limit * limit
            if cost < best:
                best = cost
                found[:] = there
        if total <= tries:  # the next in order
            if known:
                j += 1
                if j == n:
                    i += 1
                    j = i + 1
                k = j
            else:
                k += 1
                if k == n:
                    j += 1
                    if j == n - 1:
                        i += 1
                        j = i + 1
                    k = j + 1
    pose[:] = found
    return best
