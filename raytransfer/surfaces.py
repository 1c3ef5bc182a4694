"""Surfaces as they really are: planes, cylinders of either axis, spheres, and screens with an opening."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from raytransfer.materials import Material


@dataclass(frozen=True)
class Surface:
    """One surface of an element, in the element's frame: Z with the light, vertex on the axis.

    The points of a curved surface satisfy c (aₓ x² + a_y y² + z²) = 2 z, z from the vertex, with
    aₓ and a_y 1 for the meridians it bends and 0 otherwise: a sphere bends both, a cylinder one.

    Parameters
    ----------
    z : float
        Vertex, mm behind the element's front vertex.
    curvature : float
        1/radius in 1/mm, > 0 where the centre of curvature lies behind the surface; 0 is a plane.
    bends : {"", "x", "y", "xy"}
        The meridians in which it is curved.
    half : tuple of float
        Half the opening along X and Y, mm; of a round one its radius, twice.
    round : bool
    material : Material, optional
        Behind it; None is air.
    screen : bool
        It bends nothing: an opaque screen with the opening in it.
    """

    z: float = 0.0
    curvature: float = 0.0
    bends: Literal["", "x", "y", "xy"] = ""
    half: tuple[float, float] = (math.inf, math.inf)
    round: bool = False
    material: Material | None = None
    screen: bool = False

    @property
    def ax(self) -> float:
        """1 if it is curved along X, else 0."""
        return float("x" in self.bends)

    @property
    def ay(self) -> float:
        """1 if it is curved along Y, else 0."""
        return float("y" in self.bends)

    def sag(self, x: Any, y: Any) -> NDArray[np.float64]:
        """Depth behind the vertex at x, y, mm; NaN beside a curved surface's end."""
        c = self.curvature
        squares = c * (self.ax * np.square(x) + self.ay * np.square(y))
        root = 1 - c * squares
        root = np.where(np.abs(root) < 1e-12, 0.0, root)  # the end itself, but for rounding
        with np.errstate(invalid="ignore"):
            return np.asarray(squares / (1 + np.sqrt(root)))

    def depth(self, half: tuple[float, float]) -> float:
        """Depth behind the vertex at the edge of that half size, mm; without an edge 0."""
        x, y = (size if math.isfinite(size) else 0.0 for size in half)
        return float(self.sag(x, 0.0 if self.round else y))

    def opens(self, x: Any, y: Any) -> NDArray[np.bool_]:
        """Whether points lie within the opening."""
        if self.round:
            return np.asarray(np.square(x) + np.square(y) <= self.half[0] ** 2)
        return np.asarray((np.abs(x) <= self.half[0]) & (np.abs(y) <= self.half[1]))
