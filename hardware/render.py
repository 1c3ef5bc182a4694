"""Shaded pictures of parts, in plain numpy: for notebooks and instructions without a display."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from hardware.mesh import manifold, trimesh_of
from hardware.solids import Cylinder

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from hardware.mount import LensMount
    from hardware.solids import Point, Solid
    from hardware.stand import LedMount, Stand

PLASTIC = (0.87, 0.85, 0.80)
GLASS = (0.45, 0.66, 0.85)
BOARD = (0.16, 0.45, 0.28)
PACKAGE = (0.25, 0.25, 0.28)
ALUMINIUM = (0.66, 0.68, 0.71)
_LIGHT = np.array([-0.35, 0.55, 0.76])  # to the left of the eye, above and behind it


class Shown(NamedTuple):
    """A part of a picture.

    Attributes
    ----------
    solid : Solid
    colour : tuple of float
        Red, green and blue, 0 to 1.
    move : tuple of float
        Where to from its place, mm.
    opacity : float
        1, or less for what is seen through.
    """

    solid: Solid
    colour: tuple[float, float, float]
    move: Point = (0.0, 0.0, 0.0)
    opacity: float = 1.0


def exploded(mount: LensMount, apart: float = 30.0) -> list[Shown]:
    """Return a mount taken apart: the upper half above, the board behind, lenses between.

    Parameters
    ----------
    mount : LensMount
    apart : float
        Between the halves and the lenses, mm.
    """
    parts = [
        Shown(mount.lower, PLASTIC, (0.0, -apart, 0.0)),
        Shown(mount.upper, PLASTIC, (0.0, apart, 0.0)),
        *(Shown(lens.glass, GLASS, opacity=0.6) for lens in mount.lenses),
    ]
    for name, solid in mount.board.parts(mount.face).items():
        if name != "joints":
            colour = BOARD if name == "board" else PACKAGE
            parts.append(Shown(solid, colour, (0.0, 0.0, apart / 2)))
    return parts


def standing(stand: Stand) -> list[Shown]:
    """Return the motherboard with the head and all boards on it."""
    mount = stand.mount
    parts = [Shown(solid, PLASTIC) for solid in (*stand.parts.values(), *mount.halves.values())]
    parts += [Shown(lens.glass, GLASS) for lens in mount.lenses]
    parts += [Shown(board.slab(), BOARD) for board in stand.boards]
    return [*parts, Shown(mount.board.parts(mount.face)["board"], BOARD)]


def on_pole(mount: LedMount) -> list[Shown]:
    """Return an LED's mount on its pole."""
    pole = Cylinder("z", (0.0, 0.0), -25.0, 55.0, mount.rules["pole"])
    return [Shown(mount.solid, PLASTIC), Shown(pole, ALUMINIUM)]


def picture(
    parts: Sequence[Shown],
    *,
    azimuth: float = 35.0,
    elevation: float = 25.0,
    pixels: int = 700,
) -> NDArray[np.uint8]:
    """Draw parts as a camera far away sees them, Y up.

    Parameters
    ----------
    parts : sequence of Shown
    azimuth, elevation : float
        Where the camera stands, degrees: 0, 0 looks along Z from the light's side; azimuth turns
        towards +X, elevation upwards.
    pixels : int
        Of the longer side.

    Returns
    -------
    ndarray, shape (H, W, 3)
        For matplotlib's ``imshow``.
    """
    turn = _camera(math.radians(azimuth), math.radians(elevation))
    opaque = sorted(parts, key=lambda part: -part.opacity)
    # small triangles: what is tried for each is the rectangle around it
    meshes = [trimesh_of(manifold(part.solid).refine_to_length(4.0)) for part in opaque]
    corners = [
        (np.asarray(surface.triangles) + np.array(part.move)) @ turn.T
        for part, surface in zip(opaque, meshes, strict=True)
    ]
    every = np.concatenate(corners).reshape(-1, 3)
    low, high = every[:, :2].min(axis=0) - 2, every[:, :2].max(axis=0) + 2
    scale = 2 * pixels / (high - low).max()  # twice as fine as the picture, then averaged
    width, height = (2 * np.ceil((high - low) * scale / 2)).astype(int)
    image = np.ones((height, width, 3), dtype=np.float32)
    depth = np.full((height, width), -np.inf)
    light = _LIGHT / np.linalg.norm(_LIGHT)
    for part, surface, triangles in zip(opaque, meshes, corners, strict=True):
        normals = np.asarray(surface.face_normals) @ turn.T
        screen = triangles.copy()
        screen[..., 0] = (triangles[..., 0] - low[0]) * scale
        screen[..., 1] = (high[1] - triangles[..., 1]) * scale
        x0, y0 = np.floor(screen[..., :2].min(axis=(0, 1))).astype(int)
        x1, y1 = np.ceil(screen[..., :2].max(axis=(0, 1))).astype(int) + 1
        here = np.s_[y0:y1, x0:x1]
        screen[..., :2] -= x0, y0
        before = depth[here].copy()
        face = _rasterise(screen, normals[:, 2] > 0, before)
        shade = 0.45 + 0.55 * np.clip(normals @ light, 0.0, 1.0)
        shade = shade[face] * np.where(_edges(face, normals, before), 0.45, 1.0)
        seen = face >= 0
        colour = part.opacity * shade[seen][:, None] * np.array(part.colour)
        image[here][seen] = colour + (1 - part.opacity) * image[here][seen]
        if part.opacity == 1:
            depth[here] = before
    fine = image.reshape(height // 2, 2, width // 2, 2, 3).mean(axis=(1, 3))
    return np.asarray((255 * np.clip(fine, 0, 1)).astype(np.uint8))


def _camera(azimuth: float, elevation: float) -> NDArray[np.float64]:
    """Rows: right, up and towards the camera, in the frame of the parts."""
    ca, sa, ce, se = (f(a) for a in (azimuth, elevation) for f in (math.cos, math.sin))
    towards = np.array([sa * ce, se, -ca * ce])
    right = np.array([-ca, 0.0, -sa])
    return np.stack([right, np.cross(towards, right), towards])


def _rasterise(
    triangles: NDArray[np.float64], front: NDArray[np.bool_], depth: NDArray[np.float64]
) -> NDArray[np.int64]:
    """Return which triangle is seen at each pixel, −1 for none; depth is written over."""
    height, width = depth.shape
    low = np.floor(triangles[..., :2].min(axis=1)).astype(int)
    size = np.ceil(triangles[..., :2].max(axis=1)).astype(int) - low
    area = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])[:, 2]
    drawn = np.flatnonzero(front & (area != 0))
    # every pixel of the rectangle around every triangle, one after the other
    count = size[drawn].prod(axis=1)
    face = np.repeat(drawn, count)
    nth = np.arange(len(face)) - np.repeat(np.cumsum(count) - count, count)
    down, right = np.divmod(nth, size[face, 0])
    column, row = low[face, 0] + right, low[face, 1] + down
    (ax, ay, az), (bx, by, bz), (cx, cy, cz) = (triangles[drawn, i].T for i in range(3))
    # how much of the second and the third corner, and the depth, are linear on the screen
    planes = np.empty((3, 3, len(triangles)))
    v = np.stack([cy - ay, ax - cx]) / area[drawn]
    w = np.stack([ay - by, bx - ax]) / area[drawn]
    for plane, slope, start in (
        (planes[0], v, 0.0),
        (planes[1], w, 0.0),
        (planes[2], v * (bz - az) + w * (cz - az), az),
    ):
        plane[:2, drawn] = slope
        plane[2, drawn] = start - slope[0] * ax - slope[1] * ay
    share = planes[0, 0, face] * (column + 0.5)
    share += planes[0, 1, face] * (row + 0.5) + planes[0, 2, face]
    other = planes[1, 0, face] * (column + 0.5)
    other += planes[1, 1, face] * (row + 0.5) + planes[1, 2, face]
    inside = (share >= 0) & (other >= 0) & (share + other <= 1)
    face, column, row = face[inside], column[inside], row[inside]
    z = planes[2, 0, face] * (column + 0.5) + planes[2, 1, face] * (row + 0.5) + planes[2, 2, face]
    nearer = z > depth[row, column]
    order = np.flatnonzero(nearer)[np.argsort(z[nearer], kind="stable")]
    seen = np.full((height, width), -1)
    seen[row[order], column[order]] = face[order]  # the last written is the nearest
    depth[row[order], column[order]] = z[order]
    return seen


def _edges(
    face: NDArray[np.int64], normals: NDArray[np.float64], depth: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """Pixels beside which the surface bends by more than 30°, jumps or ends."""
    edge = np.zeros(face.shape, dtype=bool)
    for after in (np.s_[1:, :], np.s_[:, 1:]):
        first = tuple(slice(None, -1) if part == np.s_[1:] else part for part in after)
        at = np.nonzero(face[first] != face[after])
        one, other = face[first][at], face[after][at]
        bend = (normals[one] * normals[other]).sum(axis=-1) < math.cos(math.radians(30))
        ends = (one < 0) != (other < 0)
        near, far = depth[first][at], depth[after][at]
        jump = ~ends & (np.abs(np.where(ends, 0.0, near) - np.where(ends, 0.0, far)) > 1.0)
        edge[first][at] |= bend | ends | jump
    return edge & (face >= 0)
