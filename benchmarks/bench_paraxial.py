"""Casting and propagating a million rays through the thesis's pair, beside other packages.

In every comparison both sides are checked to compute the same.
"""

from __future__ import annotations

import json
import os
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any
from unittest import mock

import numpy as np
import sympy

import raytransfer
from benchmarks.measure import Result, interleaved, ratios, require_same, seconds

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    Array = NDArray[np.float64]

COUNT = 1_000_000
QUICK = 10  # calls of some milliseconds make one sample
MATRIX = raytransfer.telecentric_pair().matrix("x")
WIDTH = 30.0  # mm, of the lenses
# The same pair as a prescription for the others: the thesis's glass, mm
INDEX, THICKNESS, RADIUS = 1.52, 5.9, 31.0


def run() -> list[Result]:
    """Measure everything about paraxial rays."""
    rng = np.random.default_rng(41)
    distance = rng.uniform(500.0, 10_000.0, COUNT)
    offset = rng.uniform(-2_500.0, 2_500.0, COUNT)
    rays = np.stack([rng.uniform(-15.0, 15.0, COUNT), rng.uniform(-0.1, 0.1, COUNT)])
    out = np.empty_like(rays)
    return [
        *_cast(distance, offset),
        *_beside_copy(rays, out),
        *_beside_optiland(rays, out),
        *_beside_raytracing(rays, out),
    ]


def _cast(distance: Array, offset: Array) -> list[Result]:
    rounds, sources = 15, 2  # the listing gets few sources: it manages some ten in a second
    lens_mat = sympy.Matrix(np.asarray(MATRIX))
    found: list[tuple[Any, Any]] = []
    todo: Iterator[tuple[float, float]] = zip(distance.tolist(), offset.tolist(), strict=True)

    def listing() -> None:
        # each source is a new one: sympy remembers what it solved
        new = [next(todo) for _ in range(sources)]
        found.extend(_listing_4_1(WIDTH, lens_mat, *source) for source in new)

    ours, theirs = interleaved(
        rounds,
        seconds(lambda: raytransfer.cast_rays(WIDTH, MATRIX, distance, offset)),
        seconds(listing),
    )
    few = slice(len(found))
    focus = raytransfer.cast_rays(WIDTH, MATRIX, distance[few], offset[few])
    require_same("listing 4.1", found, np.transpose(focus))
    speed = [COUNT / taken for taken in ours]
    listing_speed = [sources / taken for taken in theirs]
    return [
        Result("cast_rays", "points/s", speed, target=20e6),
        Result("cast_rays / listing 4.1", "×", ratios(speed, listing_speed), target=100_000),
    ]


def _listing_4_1(lens_width: float, lens_mat: Any, source_dist: float, axis_off: float) -> Any:
    """Find a focus as the thesis does: solve equations 4.2 to 4.4 for this source."""
    x, y = sympy.symbols("x y")
    to_lens = _translation(source_dist)

    def through(edge: float) -> Any:
        angle = _solve(to_lens * sympy.Matrix([axis_off, x]) - sympy.Matrix([edge, x]), x)
        return lens_mat * to_lens * sympy.Matrix([axis_off, angle])

    top, bottom = through(lens_width / 2), through(-lens_width / 2)
    behind = _translation(x)
    top_misses = behind * top - sympy.Matrix([y, top[1]])
    bottom_misses = behind * bottom - sympy.Matrix([y, bottom[1]])
    focal_length = _solve(top_misses - bottom_misses, x)
    return focal_length, (_translation(focal_length) * top)[0]


def _translation(d: Any) -> Any:
    return sympy.Matrix([[1, d], [0, 1]])


def _solve(vector: Any, unknown: Any) -> Any:
    """Solve vector = 0 element by element; that of the angles is always 0 and has no solution."""
    (solution,) = (value for element in vector for value in sympy.solve(element, unknown))
    return solution


def _beside_copy(rays: Array, out: Array) -> list[Result]:
    ours, copy = interleaved(
        40,
        seconds(lambda: MATRIX.propagate(rays, out=out), QUICK),
        seconds(lambda: np.copyto(out, rays), QUICK),
    )
    # both read and write the same bytes
    return [
        Result("propagate", "rays/s", [COUNT / taken for taken in ours]),
        Result("propagate / copyto", "×", ratios(copy, ours), target=0.9),
    ]


def _beside_optiland(rays: Array, out: Array) -> list[Result]:
    from optiland.materials import IdealMaterial
    from optiland.optic import Optic
    from optiland.rays import ParaxialRays

    optic, glass, wavelength = Optic(), IdealMaterial(n=INDEX), 0.5876
    optic.surfaces.add(index=0, thickness=0)  # rays start at the first vertex
    optic.surfaces.add(index=1, thickness=THICKNESS, material=glass, is_stop=True)
    optic.surfaces.add(index=2, thickness=0, radius=-RADIUS)
    optic.surfaces.add(index=3, thickness=THICKNESS, radius=RADIUS, material=glass)
    optic.surfaces.add(index=4, thickness=0)
    optic.surfaces.add(index=5)
    optic.wavelengths.add(value=wavelength, is_primary=True)
    heights, angles = rays

    def trace() -> Any:
        # its fastest: one z and one wavelength for all rays, nothing kept between surfaces
        start = ParaxialRays(heights, angles, 0.0, wavelength)
        return optic.surfaces.trace(start, record=False)

    def trace_generic() -> Any:
        # its usual call, which returns the rays at every surface
        return optic.paraxial.trace_generic(heights, angles, 0.0, wavelength)

    expected = MATRIX.propagate(rays)
    traced = trace()
    require_same("optiland's trace", (traced.y, traced.u), expected)
    at_surfaces = [array.reshape(-1, COUNT)[-1] for array in trace_generic()]
    require_same("optiland's trace_generic", at_surfaces, expected)
    replaced = rays.copy()  # stays bounded: the matrix only turns these rays about
    ours, in_place, generic, fastest = interleaved(
        15,
        seconds(lambda: MATRIX.propagate(rays, out=out), QUICK),
        seconds(lambda: MATRIX.propagate(replaced, out=replaced), QUICK),
        seconds(trace_generic),
        seconds(trace),
    )
    return [
        Result(
            "propagate in place / optiland trace_generic", "×", ratios(generic, in_place), target=50
        ),
        Result("propagate / optiland trace_generic", "×", ratios(generic, ours)),
        Result("propagate in place / optiland surfaces.trace", "×", ratios(fastest, in_place)),
    ]


def _beside_raytracing(rays: Array, out: Array) -> list[Result]:
    raytracing = _raytracing()
    few = 20_000  # rays for it, one Python object each; speeds are compared per ray
    surfaces = raytracing.MatrixGroup(
        [
            raytracing.DielectricInterface(1.0, INDEX),
            raytracing.Space(THICKNESS, INDEX),
            raytracing.DielectricInterface(INDEX, 1.0, -RADIUS),
            raytracing.DielectricInterface(1.0, INDEX, RADIUS),
            raytracing.Space(THICKNESS, INDEX),
            raytracing.DielectricInterface(INDEX, 1.0),
        ]
    )
    pair = surfaces.transferMatrix()  # one matrix, as ours; the group takes six times as long
    beam = raytracing.Rays([raytracing.Ray(*ray) for ray in rays[:, :few].T.tolist()])

    def trace() -> Any:
        # faster than traceMany, which keeps the way of each ray, and than its parallel variant
        return pair.traceManyThrough(beam, progress=False)

    traced = trace()
    require_same(
        "raytracing", (traced.yValues, traced.thetaValues), MATRIX.propagate(rays[:, :few])
    )
    ours, theirs = interleaved(
        15, seconds(lambda: MATRIX.propagate(rays, out=out), QUICK), seconds(trace)
    )
    speed, their_speed = [COUNT / taken for taken in ours], [few / taken for taken in theirs]
    return [Result("propagate / raytracing", "×", ratios(speed, their_speed), target=1000)]


def _raytracing() -> Any:
    """Import raytracing with the preferences of a passing home: it asks the network for updates."""
    import matplotlib.font_manager  # noqa: F401 (raytracing loads it; its cache stays at home)

    with tempfile.TemporaryDirectory() as home, mock.patch.dict(os.environ, HOME=home):
        config = Path(home) / ".config"
        config.mkdir()
        asked = {"lastVersionCheck": "9999-01-01T00:00:00.0"}
        (config / "ca.dcclab.python.raytracing.json").write_text(json.dumps(asked))
        import raytracing
    return raytracing
