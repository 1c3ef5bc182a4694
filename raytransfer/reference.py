"""`tracing.trace` once more, in plain numpy and by other formulas: what the compiled one is held against.

Intersections start from the foot of the perpendicular on the surface's axis or centre, refraction
is the vector form of Snell's law, transmittance is what is not reflected. Slower, meant to be read.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from raytransfer.materials import D_LINE
from raytransfer.prescription import prescription
from raytransfer.tracing import TINY, Status, Trace, checked_rays

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import ArrayLike, NDArray

    from raytransfer.systems import OpticalSystem

    Array = NDArray[np.float64]


def trace(
    system: OpticalSystem,
    position: ArrayLike,
    direction: ArrayLike,
    *,
    wavelength: float = D_LINE,
    fresnel: bool = True,
) -> Trace:
    """Trace rays; parameters, result and refusals are those of `tracing.trace`."""
    q, d = checked_rays(system, position, direction)
    with np.errstate(all="ignore"):  # lost rays are followed too, wherever that leads
        for step in _follow(system, q, d, wavelength, fresnel):
            q, d, weight, lost = step
    out = np.where(lost == 0, np.stack([q[0], q[1], *d, weight]), 0.0)
    return Trace.of(out, lost)


def path(
    system: OpticalSystem,
    position: ArrayLike,
    direction: ArrayLike,
    *,
    wavelength: float = D_LINE,
) -> Array:
    """Points of rays in the frame of the system, for drawing.

    Returns
    -------
    ndarray, shape (S + 2, 3, N)
        Start, S surfaces, sensor. A ray that is blocked or totally reflected ends where that
        happens, one that misses a surface at the surface before; from there on its last point is
        repeated.
    """
    q, d = checked_rays(system, position, direction)
    rotation, origin = np.eye(3), np.zeros(3)
    points = [q]
    steps = prescription(system, wavelength).steps
    follow = _follow(system, q, d, wavelength, fresnel=False)
    with np.errstate(all="ignore"):
        for step, (local, _, _, lost) in zip(steps, follow, strict=True):
            # q' = A q + b, and the frame's own axes are the columns of the product of all Aᵀ
            rotation = rotation @ step[:, :3].T
            origin = origin - rotation @ step[:, 3]
            here = rotation @ local + origin[:, None]
            ended = (lost != 0) & ((lost >> 2) < len(points) - 1)
            ended |= (lost & 3 == Status.MISSED) & (lost >> 2 == len(points) - 1)
            points.append(np.where(ended, points[-1], here))
    return np.stack(points)


def _follow(
    system: OpticalSystem, q: Array, d: Array, wavelength: float, fresnel: bool
) -> Iterator[tuple[Array, Array, Array, NDArray[np.int16]]]:
    """Yield points, directions, transmission and losses at each surface, in its frame."""
    parts = prescription(system, wavelength)
    d = d / np.sqrt((d**2).sum(axis=0))
    weight = np.ones(q.shape[1])
    lost = np.zeros(q.shape[1], np.int16)
    for k, step in enumerate(parts.steps):
        q, d = step[:, :3] @ q + step[:, 3:], step[:, :3] @ d
        here = np.int16(4 * k)
        if k == len(parts.shapes):
            q, _, ahead = _plane(q, d)
            lost = np.where((lost == 0) & ~ahead, here + np.int16(Status.MISSED), lost)
            yield q, d, weight, lost
            return
        c, *meridians = parts.shapes[k]
        q, normal, hit = _plane(q, d) if c == 0 else _curved(q, d, 1 / c, np.array(meridians))
        hx, hy, circle = parts.edges[k]
        inside = (
            np.hypot(q[0], q[1]) <= hx if circle else (np.abs(q[0]) <= hx) & (np.abs(q[1]) <= hy)
        )
        n1, n2 = parts.indices[k]
        refracts = np.ones_like(hit)
        if n1:  # a screen has none
            cos1 = (normal * d).sum(axis=0)
            sin2 = n1 / n2 * np.sqrt(np.maximum(0.0, 1 - cos1**2))
            refracts = sin2 < 1
            cos2 = np.sqrt(np.where(refracts, 1 - sin2**2, 1.0))
            d = n1 / n2 * d + (cos2 - n1 / n2 * cos1) * normal
        for ok, reason in (
            (hit, Status.MISSED),
            (inside, Status.BLOCKED),
            (refracts, Status.REFLECTED),
        ):
            lost = np.where((lost == 0) & ~ok, here + np.int16(reason), lost)
        if n1 and fresnel:
            weight = np.where(lost == 0, weight * _transmittance(n1, n2, cos1, cos2), weight)
        yield q, d, weight, lost


def _plane(q: Array, d: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
    ahead = d[2] > TINY
    q = q - d * (q[2] / np.where(ahead, d[2], 1.0))
    normal = np.zeros_like(q)
    normal[2] = 1.0
    return q, normal, ahead


def _curved(
    q: Array, d: Array, radius: float, meridians: Array
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Intersect with the near side of a cylinder or sphere whose vertex is at 0."""
    curved = np.array([*meridians, 1.0])[:, None]
    centre = np.array([[0.0], [0.0], [radius]])
    # seen from outside it must be ahead; seen from inside there is always a way out
    ahead = (radius < 0) | ((curved * (q - centre) * d).sum(axis=0) < 0)
    q, _, _ = _plane(q, d)  # a distant source costs digits
    across = curved * d  # what of the direction is across the axis
    square = (across**2).sum(axis=0)
    from_centre = curved * (q - centre)
    to_foot = -(from_centre * d).sum(axis=0) / np.where(square > 0, square, 1.0)
    foot = from_centre + to_foot * across
    beside = radius**2 - (foot**2).sum(axis=0)
    hit = (beside > 0) & (square > 0)
    half_chord = np.sqrt(np.where(hit, beside / np.where(square > 0, square, 1.0), 0.0))
    length = to_foot - np.sign(radius) * half_chord
    q = q + length * d
    normal = -curved * (q - centre) / radius
    return q, normal, hit & ahead & (normal[2] > 0) & ((normal * d).sum(axis=0) > 0)


def _transmittance(n1: float, n2: float, cos1: Array, cos2: Array) -> Array:
    """Fresnel for unpolarised light (Born and Wolf, Principles of Optics, section 1.5)."""
    s = (n1 * cos1 - n2 * cos2) / (n1 * cos1 + n2 * cos2)
    p = (n1 * cos2 - n2 * cos1) / (n1 * cos2 + n2 * cos1)
    return 1 - (s**2 + p**2) / 2
