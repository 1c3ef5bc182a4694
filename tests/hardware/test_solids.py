"""Descriptions, their triangles and STL files, held against closed forms and point membership."""

from __future__ import annotations

import io
import math
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import pytest
import trimesh

from hardware.mesh import (
    SEGMENTS,
    bounds,
    cross_section,
    manifold,
    manifold_of,
    mesh,
    stl,
    trimesh_of,
    volume,
    write_stl,
)
from hardware.solids import (
    ACROSS,
    Box,
    Cylinder,
    Difference,
    Intersection,
    Lathe,
    Placed,
    Prism,
    Solid,
    Union,
    arc,
    block,
    frustum,
)

if TYPE_CHECKING:
    from pathlib import Path

    from hardware.solids import Axis

AXES: tuple[Axis, ...] = ("x", "y", "z")
POLYGON = SEGMENTS / 2 * math.sin(math.tau / SEGMENTS)  # area of a circle's corners, radius 1
L_SHAPE = ((0.0, 0.0), (4.0, 0.0), (4.0, 1.0), (1.0, 1.0), (1.0, 3.0), (0.0, 3.0))


def test_box() -> None:
    box = Box((-1, -2, -3), (4, 5, 6))
    assert volume(box) == pytest.approx(5 * 7 * 9, rel=1e-12)
    assert bounds(box) == pytest.approx(np.array([[-1, -2, -3], [4, 5, 6]]), abs=1e-12)


@pytest.mark.parametrize("axis", AXES)
def test_cylinder(axis: Axis) -> None:
    bar = Cylinder(axis, (1.0, -2.0), -3.0, 5.0, 6.0)
    assert volume(bar) == pytest.approx(9 * POLYGON * 8, rel=1e-9)
    assert math.isclose(POLYGON, math.pi, rel_tol=0.002)
    low, high = bounds(bar)
    along = AXES.index(axis)
    assert (low[along], high[along]) == pytest.approx((-3, 5))
    assert [*low[list(ACROSS[axis])], *high[list(ACROSS[axis])]] == pytest.approx([-2, -5, 4, 1])


@pytest.mark.parametrize("axis", AXES)
@pytest.mark.parametrize("outline", [L_SHAPE, L_SHAPE[::-1]])
def test_prism(axis: Axis, outline: tuple[tuple[float, float], ...]) -> None:
    bar = Prism(axis, outline, -1.0, 4.0)
    assert volume(bar) == pytest.approx(6 * 5, rel=1e-9)
    low, high = bounds(bar)
    assert [*low[list(ACROSS[axis])], *high[list(ACROSS[axis])]] == pytest.approx([0, 0, 4, 3])


def test_lathe_and_frustum() -> None:
    cone = Lathe(((0.0, 0.0), (3.0, 0.0), (0.0, 4.0)))
    assert volume(cone) == pytest.approx(9 * POLYGON * 4 / 3, rel=1e-6)
    pyramid = frustum(1.0, (2.0, 3.0), 4.0, (1.0, 1.0))
    # area 4 x y with both linear in z
    assert volume(pyramid) == pytest.approx(3 * 4 * (2 * 3 + 1 * 1 + (2 + 1) * (3 + 1)) / 6)


def test_arc_lies_on_its_circle() -> None:
    h, z = np.transpose(arc(-10.3, 7.5, 2.0))
    assert np.hypot(h, z - (2.0 - 10.3)) == pytest.approx(np.full(h.shape, 10.3))
    assert (h[0], h[-1]) == (-7.5, 7.5)
    assert z[len(z) // 2] == pytest.approx(2.0)
    assert arc(math.inf, 3.0, 1.0) == ((-3.0, 1.0), (0.0, 1.0), (3.0, 1.0))


def combinations() -> list[Solid]:
    box, bar = Box((0, 0, 0), (6, 5, 4)), Cylinder("y", (3.0, 2.0), -1.0, 6.0, 3.0)
    wedge = Prism("x", ((0, 0), (5, 0), (0, 4)), 1.0, 8.0)
    return [
        Union((box, bar, wedge)),
        Intersection((box, bar, wedge)),
        Difference(box, (bar, wedge)),
        Placed(Difference(box, (bar,)), (1.0, -2.0, 3.0), "x", 1),
        Placed(Prism("z", L_SHAPE, 0.0, 2.0), (0.5, 0.0, 0.0), "y", 3),
        Placed(Prism("y", L_SHAPE, 0.0, 2.0), (0.0, 0.0, 1.0), "z", -1),
        Difference(Lathe(((0.0, 0.0), (3.0, 0.0), (3.0, 2.0), (0.0, 4.0))), (block(1, 1, 1, 9),)),
    ]


def winding(surface: trimesh.Trimesh, points: np.ndarray) -> np.ndarray:
    """How often the surface goes around each point: the solid angles of all its triangles."""
    a, b, c = (np.asarray(surface.triangles)[:, i] - points[:, None] for i in range(3))
    la, lb, lc = (np.linalg.norm(v, axis=-1) for v in (a, b, c))
    triple = (a * np.cross(b, c)).sum(axis=-1)
    dots = [(u * v).sum(axis=-1) * w for u, v, w in ((a, b, lc), (b, c, la), (c, a, lb))]
    angles = 2 * np.arctan2(triple, la * lb * lc + sum(dots))
    return np.asarray(angles.sum(axis=-1) / (4 * math.pi))


@pytest.mark.parametrize("solid", combinations())
def test_triangles_are_what_the_description_says(solid: Solid) -> None:
    """Every point is inside both or outside both (none lies between a circle and its corners)."""
    surface = mesh(solid)
    assert surface.is_watertight
    low, high = bounds(solid)
    points = low - 0.5 + np.random.default_rng(1).random((600, 3)) * (high - low + 1)
    around = winding(surface, points)
    assert np.abs(around - around.round()).max() < 1e-6
    inside = around.round() == 1
    assert 20 < inside.sum() < 580
    assert (solid.contains(points.T) == inside).all()


@pytest.mark.parametrize(
    "make",
    [
        lambda: Box((0, 0, 0), (1, 0, 1)),
        lambda: Cylinder("z", (0, 0), 1.0, 1.0, 2.0),
        lambda: Cylinder("z", (0, 0), 0.0, 1.0, -2.0),
        lambda: Prism("z", ((0, 0), (1, 1), (2, 2)), 0.0, 1.0),
        lambda: Lathe(((-1, 0), (1, 0), (0, 1))),
    ],
)
def test_solids_without_volume_are_refused(make) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(ValueError, match=r"low|radius"):
        make()


def test_stl_is_reproducible_and_reads_back(tmp_path: Path) -> None:
    solid = combinations()[2]
    first = write_stl(solid, tmp_path / "a.stl").read_bytes()
    surface = mesh(solid)
    shuffled = np.random.default_rng(2).permutation(len(surface.faces))
    turned = np.roll(np.asarray(surface.faces)[shuffled], 1, axis=1)
    again = trimesh.Trimesh(surface.vertices, turned, process=False)
    assert stl(again) == first  # whatever order a kernel gives them in
    read = trimesh.load_mesh(io.BytesIO(first), file_type="stl")
    assert read.is_watertight
    assert read.volume == pytest.approx(volume(solid), rel=1e-6)
    assert read.bounds == pytest.approx(bounds(solid), abs=1e-5)
    assert manifold_of(read).volume() == pytest.approx(volume(solid), rel=1e-6)


def test_an_open_mesh_is_no_solid() -> None:
    surface = trimesh_of(manifold(Box((0, 0, 0), (1, 1, 1))))
    surface.update_faces(np.arange(len(surface.faces)) > 0)
    with pytest.raises(ValueError, match="no closed surface"):
        manifold_of(surface)


@pytest.mark.parametrize(
    ("axis", "at", "low", "high"),
    [("x", 6.0, (0.0, 0.0), (2.0, 1.0)), ("y", -1.0, (-3.0, -1.0), (6.0, 4.0))],
)
def test_cross_sections_lie_as_the_solid_does(
    axis: Literal["x", "y"], at: float, low: Any, high: Any
) -> None:
    step = Box((4.0, 0.0, 0.0), (8.0, 1.0, 2.0))
    solid = Union((Box((-1.0, -2.0, -3.0), (4.0, 5.0, 6.0)), step))
    (ring,) = cross_section(solid, axis, at)
    assert ring.min(axis=0) == pytest.approx(low, abs=1e-6)
    assert ring.max(axis=0) == pytest.approx(high, abs=1e-6)
    assert cross_section(solid, axis, 20.0) == []
