"""Solids as triangles: manifold3d cuts and joins, trimesh holds the result, STL takes it to a printer."""

from __future__ import annotations

import functools
import struct
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from hardware.solids import (
    Box,
    Cylinder,
    Difference,
    Intersection,
    Lathe,
    Placed,
    Prism,
    Solid,
    Union,
    counterclockwise,
)

if TYPE_CHECKING:
    import os

    from manifold3d import Manifold
    from numpy.typing import NDArray
    from trimesh import Trimesh

    from hardware.solids import Axis

SEGMENTS = 64
"""Of a full circle: corners lie on it, flats 0.12 % of the radius within."""

# from an outline's two coordinates and the direction in which manifold3d extrudes, to x, y, z
_TURNS = {
    "x": ((0, 0, 1), (1, 0, 0), (0, 1, 0)),
    "y": ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
    "z": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
}


@functools.lru_cache(maxsize=256)
def manifold(solid: Solid) -> Manifold:
    """Evaluate a description with manifold3d.

    Raises
    ------
    ModuleNotFoundError
        If manifold3d is not installed; the message says what to install.
    """
    kernel = _kernel()
    match solid:
        case Box():
            size = np.subtract(solid.high, solid.low)
            return kernel.Manifold.cube(size).translate(solid.low)
        case Cylinder():
            circle = kernel.CrossSection.circle(solid.diameter / 2, SEGMENTS)
            return _along(solid.axis, circle.translate(solid.centre), solid.low, solid.high)
        case Prism():
            outline = kernel.CrossSection([counterclockwise(solid.outline)])
            return _along(solid.axis, outline, solid.low, solid.high)
        case Lathe():
            outline = kernel.CrossSection([counterclockwise(solid.outline)])
            return kernel.Manifold.revolve(outline, SEGMENTS)
        case Union():
            return _all(solid.parts, kernel.OpType.Add)
        case Intersection():
            return _all(solid.parts, kernel.OpType.Intersect)
        case Difference():
            return manifold(solid.body) - _all(solid.cut, kernel.OpType.Add)
        case Placed():
            move = np.column_stack([solid.rotation(), solid.move])
            return manifold(solid.solid).transform(move)


def _kernel() -> Any:
    try:
        import manifold3d
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            "meshes are made by manifold3d, which is not installed: pip install linetrack[hardware]"
        ) from error
    return manifold3d


def _all(parts: tuple[Solid, ...], operation: Any) -> Any:
    return _kernel().Manifold.batch_boolean([manifold(part) for part in parts], operation)


def _along(axis: Axis, outline: Any, low: float, high: float) -> Any:
    turn = np.array(_TURNS[axis], dtype=float)
    bottom = -high if axis == "y" else low  # extruded against y
    pulled = outline.extrude(high - low).translate((0, 0, bottom))
    return pulled.transform(np.column_stack([turn, np.zeros(3)]))


def mesh(solid: Solid) -> Trimesh:
    """Return a description as triangles, vertices in mm."""
    return trimesh_of(manifold(solid))


def trimesh_of(body: Manifold) -> Trimesh:
    """Return a manifold as triangles."""
    import trimesh

    data = body.to_mesh64()
    return trimesh.Trimesh(data.vert_properties[:, :3], data.tri_verts, process=False)


def manifold_of(surface: Trimesh) -> Manifold:
    """Return triangles, such as those read from an STL, as a manifold.

    Raises
    ------
    ValueError
        If they do not close.
    """
    kernel = _kernel()
    data = kernel.Mesh64(
        np.array(surface.vertices, dtype=np.float64, order="C"),
        np.array(surface.faces, dtype=np.uint64, order="C"),
    )
    body = kernel.Manifold(data)
    if body.status() != kernel.Error.NoError:
        raise ValueError(f"the mesh is no closed surface: {body.status().name}")
    return body


def stl(surface: Trimesh) -> bytes:
    """Return triangles as a binary STL, in mm; equal solids give equal bytes."""
    corners = np.asarray(surface.triangles, dtype="<f4")
    # each triangle from its smallest corner on, then all in order: kernels promise no order
    first = np.lexsort(corners.transpose(2, 0, 1)[::-1], axis=-1)[:, 0]
    turn = (first[:, None] + np.arange(3)) % 3
    corners = np.take_along_axis(corners, turn[:, :, None], axis=1)
    corners = corners[np.lexsort(corners.reshape(-1, 9).T[::-1])]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    record = np.zeros(
        len(corners), dtype=[("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("more", "<u2")]
    )
    record["normal"] = normal / np.where(length > 0, length, 1.0)
    record["corners"] = corners
    return b"binary STL, mm".ljust(80) + struct.pack("<I", len(record)) + record.tobytes()


def write_stl(solid: Solid, path: str | os.PathLike[str]) -> Path:
    """Write a description as a binary STL in mm, byte for byte the same every time.

    Raises
    ------
    FileNotFoundError
        If there is no such folder.
    """
    target = Path(path)
    target.write_bytes(stl(mesh(solid)))
    return target


def volume(solid: Solid) -> float:
    """Volume of the triangles, mm³."""
    return float(manifold(solid).volume())


def cross_section(solid: Solid, axis: Literal["x", "y"], at: float) -> list[NDArray[np.float64]]:
    """Return the outlines of what a plane cuts out of a solid.

    Parameters
    ----------
    solid : Solid
    axis : {"x", "y"}
        Across the plane.
    at : float
        Where on it, mm.

    Returns
    -------
    list of ndarray, shape (N, 2)
        z, and the third coordinate, mm.
    """
    if axis == "x":
        return list(manifold(Placed(solid, axis="y", quarters=1)).slice(-at).to_polygons())
    rings = manifold(Placed(solid, axis="x", quarters=1)).slice(at).to_polygons()
    return [ring[:, ::-1] * (-1, 1) for ring in rings]


def bounds(solid: Solid) -> NDArray[np.float64]:
    """Lowest and highest coordinates, shape (2, 3), mm."""
    return np.array(manifold(solid).bounding_box()).reshape(2, 3)
