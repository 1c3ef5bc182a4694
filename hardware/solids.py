"""Solids as descriptions: boxes, cylinders, prisms, what is added and what is cut away. Lengths in mm.

A description is data and needs no geometry kernel: `hardware.mesh` makes triangles of it,
`hardware.brep` exact surfaces, and both mean what `contains` says.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

Axis = Literal["x", "y", "z"]
"""A direction of the frame that a solid is described in."""

Point = tuple[float, float, float]
"""Three coordinates, mm."""

ACROSS: dict[Axis, tuple[int, int]] = {"x": (1, 2), "y": (0, 2), "z": (0, 1)}
"""Numbers of the two coordinates of an outline across each axis: y, z or x, z or x, y."""

_ALONG: dict[Axis, int] = {"x": 0, "y": 1, "z": 2}


@dataclass(frozen=True)
class Box:
    """A block with faces across the axes.

    Parameters
    ----------
    low, high : tuple of float
        Two opposite corners.

    Raises
    ------
    ValueError
        If it has no volume.
    """

    low: Point
    high: Point

    def __post_init__(self) -> None:
        if not all(low < high for low, high in zip(self.low, self.high, strict=True)):
            raise ValueError(f"box from {self.low} to {self.high} mm: each low is below its high")

    def contains(self, points: ArrayLike) -> NDArray[np.bool_]:
        """Whether points (3, N) lie inside."""
        p = np.asarray(points, dtype=float)
        low, high = np.array(self.low)[:, None], np.array(self.high)[:, None]
        return np.asarray(((p > low) & (p < high)).all(axis=0))


@dataclass(frozen=True)
class Cylinder:
    """A round bar along an axis.

    Parameters
    ----------
    axis : {"x", "y", "z"}
    centre : tuple of float
        The two coordinates across the axis, in the order of `ACROSS`.
    low, high : float
        Its ends along the axis.
    diameter : float

    Raises
    ------
    ValueError
        If it has no volume.
    """

    axis: Axis
    centre: tuple[float, float]
    low: float
    high: float
    diameter: float

    def __post_init__(self) -> None:
        if not (self.low < self.high and self.diameter > 0):
            raise ValueError(
                f"cylinder of {self.diameter:g} mm from {self.low:g} to {self.high:g} mm: low is "
                "below high, the diameter above 0"
            )

    def contains(self, points: ArrayLike) -> NDArray[np.bool_]:
        """Whether points (3, N) lie inside."""
        p = np.asarray(points, dtype=float)
        along = p[_ALONG[self.axis]]
        off = p[list(ACROSS[self.axis])] - np.array(self.centre)[:, None]
        round_ = np.hypot(*off) < self.diameter / 2
        return np.asarray(round_ & (along > self.low) & (along < self.high))


@dataclass(frozen=True)
class Prism:
    """An outline pulled along an axis.

    Parameters
    ----------
    axis : {"x", "y", "z"}
    outline : tuple of tuple of float
        Corners of a simple polygon, in the two coordinates of `ACROSS`, either way round.
    low, high : float
        Its ends along the axis.

    Raises
    ------
    ValueError
        If it has no volume.
    """

    axis: Axis
    outline: tuple[tuple[float, float], ...]
    low: float
    high: float

    def __post_init__(self) -> None:
        if not (self.low < self.high and abs(_area(self.outline)) > 0):
            raise ValueError(
                f"prism of {len(self.outline)} corners from {self.low:g} to {self.high:g} mm: low "
                "is below high, the outline has an area"
            )

    def contains(self, points: ArrayLike) -> NDArray[np.bool_]:
        """Whether points (3, N) lie inside."""
        p = np.asarray(points, dtype=float)
        along = p[_ALONG[self.axis]]
        within = _within(self.outline, *p[list(ACROSS[self.axis])])
        return np.asarray(within & (along > self.low) & (along < self.high))


@dataclass(frozen=True)
class Lathe:
    """An outline turned about the z axis.

    Parameters
    ----------
    outline : tuple of tuple of float
        Corners (radius ≥ 0, z) of a simple polygon.

    Raises
    ------
    ValueError
        If it has no area or a radius is negative.
    """

    outline: tuple[tuple[float, float], ...]

    def __post_init__(self) -> None:
        if min(radius for radius, _ in self.outline) < 0 or not abs(_area(self.outline)) > 0:
            raise ValueError("lathe: the outline has an area, and no radius below 0")

    def contains(self, points: ArrayLike) -> NDArray[np.bool_]:
        """Whether points (3, N) lie inside."""
        x, y, z = np.asarray(points, dtype=float)
        return _within(self.outline, np.hypot(x, y), z)


@dataclass(frozen=True)
class Union:
    """What is in any of the parts."""

    parts: tuple[Solid, ...]

    def contains(self, points: ArrayLike) -> NDArray[np.bool_]:
        """Whether points (3, N) lie inside."""
        return np.asarray(np.logical_or.reduce([part.contains(points) for part in self.parts]))


@dataclass(frozen=True)
class Intersection:
    """What is in all of the parts."""

    parts: tuple[Solid, ...]

    def contains(self, points: ArrayLike) -> NDArray[np.bool_]:
        """Whether points (3, N) lie inside."""
        return np.asarray(np.logical_and.reduce([part.contains(points) for part in self.parts]))


@dataclass(frozen=True)
class Difference:
    """A body without what is cut away."""

    body: Solid
    cut: tuple[Solid, ...]

    def contains(self, points: ArrayLike) -> NDArray[np.bool_]:
        """Whether points (3, N) lie inside."""
        gone = [part.contains(points) for part in self.cut]
        return np.asarray(self.body.contains(points) & ~np.logical_or.reduce(gone))


@dataclass(frozen=True)
class Placed:
    """A solid turned about an axis through the origin, then moved.

    Parameters
    ----------
    solid : Solid
    move : tuple of float
    axis : {"x", "y", "z"}
    quarters : int
        Quarter turns about the axis, right-handed.
    """

    solid: Solid
    move: Point = (0.0, 0.0, 0.0)
    axis: Axis = "z"
    quarters: int = 0

    def rotation(self) -> NDArray[np.float64]:
        """Matrix of the turn, shape (3, 3): whole numbers."""
        c, s = ((1, 0), (0, 1), (-1, 0), (0, -1))[self.quarters % 4]
        turns = {
            "x": [[1, 0, 0], [0, c, -s], [0, s, c]],
            "y": [[c, 0, s], [0, 1, 0], [-s, 0, c]],
            "z": [[c, -s, 0], [s, c, 0], [0, 0, 1]],
        }
        return np.array(turns[self.axis], dtype=float)

    def contains(self, points: ArrayLike) -> NDArray[np.bool_]:
        """Whether points (3, N) lie inside."""
        p = np.asarray(points, dtype=float) - np.array(self.move)[:, None]
        return self.solid.contains(self.rotation().T @ p)


Solid = Box | Cylinder | Prism | Lathe | Union | Intersection | Difference | Placed
"""Any description."""


def block(x: float, y: float, low: float, high: float) -> Box:
    """Return a box about the z axis, of half widths x and y."""
    return Box((-x, -y, low), (x, y, high))


def frustum(
    low: float, near: tuple[float, float], high: float, far: tuple[float, float]
) -> Intersection:
    """Return a block about the z axis whose half widths go from `near` at low to `far` at high."""
    (x0, y0), (x1, y1) = near, far
    size = max(x0, y0, x1, y1)
    return Intersection(
        (
            Prism("y", ((-x0, low), (x0, low), (x1, high), (-x1, high)), -size, size),
            Prism("x", ((-y0, low), (y0, low), (y1, high), (-y1, high)), -size, size),
        )
    )


def _area(outline: tuple[tuple[float, float], ...]) -> float:
    u, v = np.array(outline, dtype=float).T
    return float((u * np.roll(v, -1) - np.roll(u, -1) * v).sum() / 2)


def counterclockwise(
    outline: tuple[tuple[float, float], ...],
) -> tuple[tuple[float, float], ...]:
    """Return the corners in the order that kernels want."""
    return outline if _area(outline) > 0 else outline[::-1]


def _within(
    outline: tuple[tuple[float, float], ...], u: NDArray[np.float64], v: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """Whether points lie in a polygon: a ray from there crosses its edges an odd number of times."""
    inside = np.zeros(u.shape, dtype=bool)
    for (u0, v0), (u1, v1) in zip(outline, (*outline[1:], outline[0]), strict=True):
        if v0 != v1:
            crosses = ((v0 > v) != (v1 > v)) & (u < u0 + (v - v0) * (u1 - u0) / (v1 - v0))
            inside ^= crosses
    return inside


def arc(
    radius: float, half: float, vertex: float, segments: int = 96
) -> tuple[tuple[float, float], ...]:
    """Return points (h, z) of a circular arc from h = −half to half, corners on the circle, one of them at h = 0.

    Parameters
    ----------
    radius : float
        > 0: the centre lies at larger z than the vertex; infinite is a straight line.
    half : float
        At most |radius|.
    vertex : float
        z at h = 0.
    segments : int
        An even number.
    """
    if math.isinf(radius):
        return (-half, vertex), (0.0, vertex), (half, vertex)
    last = math.asin(half / abs(radius))
    angles = np.linspace(-last, last, segments + 1)
    h = abs(radius) * np.sin(angles)
    h[0], h[segments // 2], h[-1] = -half, 0.0, half
    z = vertex + radius * (1 - np.cos(angles))
    return tuple(zip(h.tolist(), z.tolist(), strict=True))
