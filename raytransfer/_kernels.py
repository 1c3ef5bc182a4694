"""Compiled ray tracing: bare arrays, no checks. `tracing` and `irradiance` stand on it.

Rays are traced in blocks, surface by surface, each surface in a loop without branches that the
compiler turns into vector instructions: choices are made between values that are both there, and
what is the same for all rays is decided when the loop is compiled. A block is one flat array of rows
at constant offsets, by which the compiler sees that they do not overlap. Every ray is computed on its
own, in full blocks, so results do not depend on the number of threads.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange

BLOCK = 1024
X, Y, Z, DX, DY, DZ, W, LOST, KEPT = (BLOCK * row for row in range(9))
SIZE = 9 * BLOCK

# as in tracing.Status; LOST holds 0 or 4 × surface + reason
MISSED, BLOCKED, REFLECTED = 1.0, 2.0, 3.0

TINY = 1e-100  # as in tracing


def _cacheable() -> bool:
    """Whether compiled code can be kept: beside this file, or in the user's home."""
    try:
        njit(cache=True)(_cacheable)
    except RuntimeError:  # neither can be written: each process compiles anew
        return False
    return True


CACHE = _cacheable()

_compile = njit(cache=CACHE, error_model="numpy", fastmath={"contract"}, nogil=True)


@_compile
def _turn(b, step):
    """Take positions and directions into the next frame."""
    for i in range(BLOCK):
        x, y, z = b[X + i], b[Y + i], b[Z + i]
        b[X + i] = step[0, 0] * x + step[0, 1] * y + step[0, 2] * z + step[0, 3]
        b[Y + i] = step[1, 0] * x + step[1, 1] * y + step[1, 2] * z + step[1, 3]
        b[Z + i] = step[2, 0] * x + step[2, 1] * y + step[2, 2] * z + step[2, 3]
        x, y, z = b[DX + i], b[DY + i], b[DZ + i]
        b[DX + i] = step[0, 0] * x + step[0, 1] * y + step[0, 2] * z
        b[DY + i] = step[1, 0] * x + step[1, 1] * y + step[1, 2] * z
        b[DZ + i] = step[2, 0] * x + step[2, 1] * y + step[2, 2] * z


@_compile
def _to_plane(b, x, y, z, code):
    """Shift the origin, then advance to z = 0; a ray that does not go there stays, and is lost."""
    for i in range(BLOCK):
        dz = b[DZ + i]
        ahead = dz > TINY
        height = b[Z + i] + z
        t = -height / (dz if ahead else 1.0)
        t = t if ahead else 0.0
        b[X + i] += x + t * b[DX + i]
        b[Y + i] += y + t * b[DY + i]
        b[Z + i] = 0.0 if ahead else height
        old = b[LOST + i]
        b[LOST + i] = old if (old != 0.0) | ahead else code + MISSED


@_compile
def _open(b, hx, hy, circle, code):
    """Lose what is outside the opening, rectangular or round."""
    for i in range(BLOCK):
        x, y = b[X + i], b[Y + i]
        inside = (x * x + y * y <= hx * hx) if circle != 0.0 else (abs(x) <= hx) & (abs(y) <= hy)
        old = b[LOST + i]
        b[LOST + i] = old if (old != 0.0) | inside else code + BLOCKED


@_compile
def _split(b, i, lost, n1, n2, cos1, cos2):
    """Split a ray's weight by Fresnel's equations, unpolarised: reflectance and transmittance."""
    s1, s2, p1, p2 = n1 * cos1, n2 * cos2, n1 * cos2, n2 * cos1
    s, p = s1 + s2, p1 + p2
    scale = 1.0 / (s * p)
    s_part = (s1 - s2) * p * scale
    p_part = (p1 - p2) * s * scale
    weight = b[W + i]
    reflected = 0.5 * (s_part * s_part + p_part * p_part) * weight
    transmitted = 2.0 * s1 * s2 * scale * scale * (s * s + p * p) * weight
    b[KEPT + i] = reflected if lost == 0.0 else 0.0
    b[W + i] = transmitted if lost == 0.0 else weight


def _refraction(fresnel, circle):
    """Loops over a block for a plane and for a curved surface; with or without Fresnel's losses.

    With them, what the surface reflects of each ray's weight is put into KEPT.
    """

    @_compile
    def plane(b, x, y, z, n1, n2, hx, hy, code):
        """Shift, advance, open and refract: the normal is Z, one root does."""
        mu = n1 / n2
        for i in range(BLOCK):
            dx, dy, dz = b[DX + i], b[DY + i], b[DZ + i]
            hit = dz > TINY
            cos1 = dz if hit else 1.0
            t = -(b[Z + i] + z) / cos1
            px = b[X + i] + x + t * dx
            py = b[Y + i] + y + t * dy
            square = 1.0 - mu * mu * (1.0 - cos1 * cos1)
            refracts = square > 0.0
            cos2 = np.sqrt(square if refracts else 1.0)
            inside = px * px + py * py <= hx * hx if circle else (abs(px) <= hx) & (abs(py) <= hy)
            b[X + i], b[Y + i], b[Z + i] = px, py, 0.0
            b[DX + i], b[DY + i], b[DZ + i] = mu * dx, mu * dy, cos2
            now = 0.0 if refracts else code + REFLECTED
            now = now if inside else code + BLOCKED
            now = now if hit else code + MISSED
            old = b[LOST + i]
            now = old if old != 0.0 else now
            b[LOST + i] = now
            if fresnel:
                _split(b, i, now, n1, n2, cos1, cos2)

    @_compile
    def curved(b, x, y, z, c, ax, ay, n1, n2, hx, hy, code):
        """Shift, intersect, open and refract.

        With F = c/2 (aₓ x² + a_y y² + z²) − z = 0 the gradient has length 1 on the surface, and its
        product with the direction where light meets it is minus the root of the discriminant: the
        cosine of incidence costs nothing. Where the centre lies before the surface (a < 0) light
        meets it on its way out of the cylinder or sphere, from wherever it came; where it lies
        behind, on its way in, which must be ahead.
        """
        mu = n1 / n2
        sx = ax * c
        sy = ay * c
        for i in range(BLOCK):
            px, py, pz = b[X + i] + x, b[Y + i] + y, b[Z + i] + z
            dx, dy, dz = b[DX + i], b[DY + i], b[DZ + i]
            a = sx * dx * dx + sy * dy * dy + c * dz * dz
            half_b = sx * px * dx + sy * py * dy + (c * pz - 1.0) * dz
            f = sx * px * px + sy * py * py + (c * pz - 2.0) * pz
            square = half_b * half_b - a * f
            inward = half_b < 0.0
            hit = (square > 0.0) & (inward | (a < 0.0))
            cos1 = np.sqrt(square if hit else 1.0)
            # the same root twice, each without cancellation
            over_in, under_in = f, cos1 - half_b
            over_out, under_out = -half_b - cos1, a if hit else 1.0
            t = (over_in if inward else over_out) / (under_in if inward else under_out)
            px += t * dx
            py += t * dy
            pz += t * dz
            # the half of the cylinder or sphere that holds the vertex
            hit &= c * pz < 1.0
            square = 1.0 - mu * mu * (1.0 - cos1 * cos1)
            refracts = square > 0.0
            cos2 = np.sqrt(square if refracts else 1.0)
            inside = px * px + py * py <= hx * hx if circle else (abs(px) <= hx) & (abs(py) <= hy)
            g = mu * cos1 - cos2
            b[X + i], b[Y + i], b[Z + i] = px, py, pz
            b[DX + i] = mu * dx + g * sx * px
            b[DY + i] = mu * dy + g * sy * py
            b[DZ + i] = mu * dz + g * (c * pz - 1.0)
            now = 0.0 if refracts else code + REFLECTED
            now = now if inside else code + BLOCKED
            now = now if hit else code + MISSED
            old = b[LOST + i]
            now = old if old != 0.0 else now
            b[LOST + i] = now
            if fresnel:
                _split(b, i, now, n1, n2, cos1, cos2)

    return plane, curved


_plane, _curved = _refraction(fresnel=False, circle=False)
_plane_round, _curved_round = _refraction(fresnel=False, circle=True)
_plane_fresnel, _curved_fresnel = _refraction(fresnel=True, circle=False)
_plane_fresnel_round, _curved_fresnel_round = _refraction(fresnel=True, circle=True)


@njit(cache=CACHE, fastmath={"contract", "reassoc"}, nogil=True)
def _sum(values, count):
    """Add up the first values; always in the same order."""
    total = 0.0
    for i in range(count):
        total += values[i]
    return total


@_compile
def through(b, steps, turned, shapes, indices, edges, fresnel, reflected):
    """Trace one block from the system's frame to the sensor's plane.

    With `fresnel`, W is multiplied by each transmittance, and what every surface reflects is added
    up in `reflected` (S,). A ray that is lost keeps the weight with which it was lost.
    """
    count = len(shapes)
    for k in range(count + 1):
        step = steps[k]
        x, y, z = step[0, 3], step[1, 3], step[2, 3]
        code = 4.0 * k
        if turned[k]:
            _turn(b, step)
            x = y = z = 0.0
        if k == count:
            _to_plane(b, x, y, z, code)
            return
        c, ax, ay = shapes[k]
        n1, n2 = indices[k]
        hx, hy, circle = edges[k]
        if n1 == 0.0:
            _to_plane(b, x, y, z, code)
            _open(b, hx, hy, circle, code)
            continue
        if c != 0.0:
            if k == 0:  # from far away, what matters near the vertex would drown in the distance
                _to_plane(b, x, y, z, -MISSED)  # loses none: it may be met from aside
                x = y = z = 0.0
            if circle == 0.0:
                if fresnel:
                    _curved_fresnel(b, x, y, z, c, ax, ay, n1, n2, hx, hy, code)
                else:
                    _curved(b, x, y, z, c, ax, ay, n1, n2, hx, hy, code)
            elif fresnel:
                _curved_fresnel_round(b, x, y, z, c, ax, ay, n1, n2, hx, hx, code)
            else:
                _curved_round(b, x, y, z, c, ax, ay, n1, n2, hx, hx, code)
        elif circle == 0.0:
            if fresnel:
                _plane_fresnel(b, x, y, z, n1, n2, hx, hy, code)
            else:
                _plane(b, x, y, z, n1, n2, hx, hy, code)
        elif fresnel:
            _plane_fresnel_round(b, x, y, z, n1, n2, hx, hx, code)
        else:
            _plane_round(b, x, y, z, n1, n2, hx, hx, code)
        if fresnel:
            reflected[k] += _sum(b[KEPT:], BLOCK)


@_compile
def _load(row, values, rest):
    """Fill a row of a block, and what is left of it with `rest`."""
    for i in range(len(values)):
        row[i] = values[i]
    for i in range(len(values), BLOCK):
        row[i] = rest


@_compile
def _save(values, row, lost):
    """Take a row out of a block: 0 for lost rays, whose numbers have no meaning."""
    for i in range(len(values)):
        value = row[i]
        values[i] = value if lost[i] == 0.0 else 0.0


@_compile
def _save_losses(status, surface, lost):
    """Take LOST apart: the reason, and the surface or −1."""
    for i in range(len(status)):
        behind = np.floor(lost[i] * 0.25)  # in doubles: quicker than with integers
        status[i] = np.uint8(np.int32(lost[i] - 4.0 * behind))
        surface[i] = np.int16(np.int32(behind if lost[i] != 0.0 else -1.0))


@_compile
def _normalise(b, doubtful, front):
    """Make directions unit vectors; mark rays that a closer look might refuse."""
    for i in range(BLOCK):
        x, y, z = b[X + i], b[Y + i], b[Z + i]
        dx, dy, dz = b[DX + i], b[DY + i], b[DZ + i]
        square = dx * dx + dy * dy + dz * dz
        usual = (square > 1e-100) & (square < 1e100) & (dz > TINY) & (z < front)
        usual &= 0.0 * (x + y + z) == 0.0  # false for what is not finite
        scale = 1.0 / np.sqrt(square if usual else 1.0)
        b[DX + i] = dx * scale
        b[DY + i] = dy * scale
        b[DZ + i] = dz * scale
        b[W + i] = 1.0
        b[LOST + i] = 0.0
        doubtful[i] = 0.0 if usual else 1.0


@njit(cache=CACHE, error_model="numpy", fastmath={"contract"}, nogil=True, parallel=True)
def trace(
    position, direction, front, steps, turned, shapes, indices, edges, fresnel, out, status, surface
):
    """Trace rays (3, N) to the sensor: x, y, direction and transmission into out (6, N).

    Returns how many rays are doubtful: they do not start before z = `front`, do not go forward, or
    are not finite.
    """
    rays = position.shape[1]
    blocks = (rays + BLOCK - 1) // BLOCK
    doubts = np.zeros(blocks)
    for j in prange(blocks):
        b = np.empty(SIZE)
        reflected = np.zeros(len(shapes))
        start = j * BLOCK
        end = min(start + BLOCK, rays)
        for row in range(3):
            _load(b[row * BLOCK :], position[row, start:end], front - 1.0)
            _load(b[(3 + row) * BLOCK :], direction[row, start:end], 1.0)
        _normalise(b, b[KEPT:], front)
        doubts[j] = _sum(b[KEPT:], BLOCK)
        through(b, steps, turned, shapes, indices, edges, fresnel, reflected)
        lost = b[LOST:]
        _save(out[0, start:end], b[X:], lost)
        _save(out[1, start:end], b[Y:], lost)
        _save(out[2, start:end], b[DX:], lost)
        _save(out[3, start:end], b[DY:], lost)
        _save(out[4, start:end], b[DZ:], lost)
        _save(out[5, start:end], b[W:], lost)
        _save_losses(status[start:end], surface[start:end], lost)
    return doubts.sum()


@_compile
def _emit(b, first, count, ny, source, grid, lobe, facing):
    """Rays `first` to `first + count` of a point source, row after row of each column, from z = 0.

    grid is (low x, step x, low y, step y) on that plane. W becomes radiant intensity × solid angle;
    the intensity is 1, or by the cosine to `facing` from a table over √(1 − cosine) from 0 to 1.
    Rays beyond `count` carry nothing.
    """
    column = first // ny
    row = first - column * ny
    for i in range(BLOCK):
        b[X + i] = column
        b[Y + i] = row
        row += i < count - 1  # the rest repeats the last one
        if row == ny:
            row = 0
            column += 1
    for i in range(BLOCK):
        u = grid[0] + (b[X + i] + 0.5) * grid[1]
        v = grid[2] + (b[Y + i] + 0.5) * grid[3]
        dx = u - source[0]
        dy = v - source[1]
        dz = source[2]
        square = dx * dx + dy * dy + dz * dz
        scale = 1.0 / np.sqrt(square)
        b[X + i] = u
        b[Y + i] = v
        b[Z + i] = 0.0
        b[DX + i] = dx * scale
        b[DY + i] = dy * scale
        b[DZ + i] = dz * scale
        b[W + i] = grid[1] * grid[3] * dz * scale * scale * scale
        b[LOST + i] = 0.0
    last = len(lobe) - 1
    if last > 0:
        for i in range(BLOCK):
            cosine = b[DX + i] * facing[0] + b[DY + i] * facing[1] + b[DZ + i] * facing[2]
            at = np.sqrt(max(1.0 - cosine, 0.0)) * last
            k = min(int(at), last - 1)
            b[W + i] *= (lobe[k] + (at - k) * (lobe[k + 1] - lobe[k])) * (cosine > 0.0)
    for i in range(count, BLOCK):
        b[W + i] = 0.0


@_compile
def _columns(first, columns, ny, source, grid, lobe, facing, parts, fresnel, b, rays, reflected):
    """Trace whole columns of the pupil into rays (4, …): x, y, weight and LOST at the sensor.

    Returns the emitted power.
    """
    steps, turned, shapes, indices, edges = parts
    emitted = 0.0
    count = columns * ny
    for start in range(0, count, BLOCK):
        size = min(BLOCK, count - start)
        _emit(b, first * ny + start, size, ny, source, grid, lobe, facing)
        emitted += _sum(b[W:], size)
        through(b, steps, turned, shapes, indices, edges, fresnel, reflected)
        for i in range(size):
            rays[0, start + i], rays[1, start + i] = b[X + i], b[Y + i]
            rays[2, start + i], rays[3, start + i] = b[W + i], b[LOST + i]
    return emitted


@_compile
def _slope(rays, row, at, low, high):
    """Change of a coordinate per cell: from both neighbours, from the one that arrived, or 0."""
    below = low >= 0 and rays[3, low] == 0.0
    above = high >= 0 and rays[3, high] == 0.0
    if below and above:
        return 0.5 * (rays[row, high] - rays[row, low])
    if above:
        return rays[row, high] - rays[row, at]
    if below:
        return rays[row, at] - rays[row, low]
    return 0.0


@_compile
def _on_line(rays, at, low, high, half):
    """Which part of a cell's light lies on the pixel line, |y| ≤ half, and where along the line.

    `low` and `high` are the cells beside it across the line. The cell's light is taken as spread
    evenly between the middles to its neighbours.

    Returns
    -------
    share, x
        x is the middle of that part, mm.
    beside
        The share below and above the line, on its own.
    spread
        How much of the line it covers because x changes along the cell, mm.
    """
    y = rays[1, at]
    rise = _slope(rays, 1, at, low, high)
    if rise == 0.0:
        if abs(y) <= half:
            return 1.0, rays[0, at], 0.0, 0.0
        return 0.0, rays[0, at], 1.0, 0.0
    first = (-half - y) / rise
    last = (half - y) / rise
    if first > last:
        first, last = last, first
    first = min(max(first, -0.5), 0.5)
    last = min(max(last, -0.5), 0.5)
    drift = _slope(rays, 0, at, low, high)
    middle = rays[0, at] + drift * 0.5 * (first + last)
    return last - first, middle, (first + 0.5) + (0.5 - last), abs(drift) * (last - first)


@_compile
def _spread(pixels, power, middle, width, pitch):
    """Put power evenly on the interval around `middle`; returns what falls beyond the ends."""
    count = len(pixels)
    low = (middle - 0.5 * width) / pitch + 0.5 * count
    high = (middle + 0.5 * width) / pitch + 0.5 * count
    if high - low < 1e-9:
        at = np.floor(0.5 * (low + high))
        if 0.0 <= at < count:
            pixels[int(at)] += power
            return 0.0
        return power
    density = power / (high - low)
    beyond = density * (max(0.0, min(high, 0.0) - low) + max(0.0, high - max(low, float(count))))
    first = max(low, 0.0)
    last = min(high, float(count))
    if first >= last:
        return beyond
    k = int(first)
    end = min(int(last), count - 1)
    if k == end:
        pixels[k] += density * (last - first)
        return beyond
    pixels[k] += density * (k + 1 - first)
    for p in range(k + 1, end):
        pixels[p] += density
    pixels[end] += density * (last - end)
    return beyond


STRIPS = 256


@njit(cache=CACHE, error_model="numpy", fastmath={"contract"}, nogil=True, parallel=True)
def illuminate(
    nx, ny, source, grid, lobe, facing,
    steps, turned, shapes, indices, edges, fresnel,
    pitch, half, pixels, account,
):  # fmt: skip
    """Light of a point source on the pixels: a cell of the pupil at a time, evenly over its image.

    pixels : (pixels,), added to. account : (S + 2, 4) of power missed, blocked, totally reflected
    and partly reflected at each surface and at the sensor's plane; the last row is emitted, beside
    the line, beyond its ends.
    """
    parts = (steps, turned, shapes, indices, edges)
    surfaces = len(shapes)
    width = max(1, max(16 * BLOCK // ny, (nx + STRIPS - 1) // STRIPS))
    strips = (nx + width - 1) // width
    each_pixels = np.zeros((strips, len(pixels)))
    each_account = np.zeros((strips, surfaces + 2, 4))
    for strip in prange(strips):
        b = np.empty(SIZE)
        mine = each_account[strip]
        reflected = np.zeros(surfaces)
        ignored = np.zeros(surfaces)
        first = strip * width
        columns = min(width, nx - first)
        # one more column on each side, traced only for the slopes
        rays = np.empty((4, (columns + 2) * ny))
        rays[3] = 1.0
        own = rays[:, ny : (columns + 1) * ny]
        mine[surfaces + 1, 0] = _columns(
            first, columns, ny, source, grid, lobe, facing, parts, fresnel, b, own, reflected
        )
        if first > 0:
            _columns(
                first - 1, 1, ny, source, grid, lobe, facing, parts, fresnel, b,
                rays[:, :ny], ignored,
            )  # fmt: skip
        if first + columns < nx:
            _columns(
                first + columns, 1, ny, source, grid, lobe, facing, parts, fresnel, b,
                rays[:, (columns + 1) * ny :], ignored,
            )  # fmt: skip
        for column in range(1, columns + 1):
            for row in range(ny):
                at = column * ny + row
                weight = rays[2, at]
                lost = int(rays[3, at])
                if lost != 0:
                    mine[lost >> 2, (lost & 3) - 1] += weight
                    continue
                share, middle, beside, drift = _on_line(
                    rays, at, at - 1 if row > 0 else -1, at + 1 if row < ny - 1 else -1, half
                )
                mine[surfaces + 1, 1] += weight * beside
                if share > 0.0:
                    slope = _slope(rays, 0, at, at - ny, at + ny)
                    mine[surfaces + 1, 2] += _spread(
                        each_pixels[strip], weight * share, middle, abs(slope) + drift, pitch
                    )
        mine[:surfaces, 3] = reflected
    for strip in range(strips):
        pixels += each_pixels[strip]
        account += each_account[strip]


@_compile
def columns_of(nx, ny, source, grid, steps, turned, shapes, indices, edges, half, columns):
    """Into columns (3, nx): the light each column of the pupil puts on the line, where, how wide, mm.

    The width is that of an even spread with the same variance. Returns the first and the last row
    that put any light there.
    """
    parts = (steps, turned, shapes, indices, edges)
    b = np.empty(SIZE)
    rays = np.empty((4, nx * ny))
    no_lobe, ahead = np.empty(0), np.zeros(3)
    _columns(0, nx, ny, source, grid, no_lobe, ahead, parts, True, b, rays, np.zeros(len(shapes)))
    first, last = ny, -1
    for column in range(nx):
        total = 0.0
        moment = 0.0
        square = 0.0
        for row in range(ny):
            at = column * ny + row
            if rays[3, at] != 0.0:
                continue
            share, middle, _, drift = _on_line(
                rays, at, at - 1 if row > 0 else -1, at + 1 if row < ny - 1 else -1, half
            )
            if share > 0.0:
                first = min(first, row)
                last = max(last, row)
                light = share * rays[2, at]
                total += light
                moment += light * middle
                square += light * (middle * middle + drift * drift / 12.0)
        columns[:, column] = 0.0
        if total > 0.0:
            mean = moment / total
            columns[0, column] = total
            columns[1, column] = mean
            columns[2, column] = np.sqrt(12.0 * max(square / total - mean * mean, 0.0))
    return first, last


@_compile
def lay(columns, scale, pitch, pixels):
    """Lay columns (3, N) of light on the pixels: between the middles to the neighbours, and wider."""
    count = columns.shape[1]
    for k in range(count):
        low = columns[1, max(k - 1, 0)]
        high = columns[1, min(k + 1, count - 1)]
        width = abs(high - low) / (min(k + 1, count - 1) - max(k - 1, 0))
        _spread(pixels, columns[0, k] * scale, columns[1, k], width + abs(columns[2, k]), pitch)
