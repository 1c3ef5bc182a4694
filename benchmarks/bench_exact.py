"""Exact rays through the thesis's pair, beside other packages, and what light costs on the pixels.

Every ray is a skew one that arrives near the sensor: those that miss a lens make the iterations of
others take several times as long. Fresnel's losses are left out where the others leave them out.
In every comparison both sides are checked to compute the same.
"""

from __future__ import annotations

import math
import subprocess
import sys
import timeit
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
from numba import njit

from benchmarks.agreement import NEAR, ROOM, pair_with_sensor, skew_rays
from benchmarks.measure import Result, interleaved, ratios, require_same, seconds
from benchmarks.peers import batoid_interface, places
from raytransfer import TCD1304, prototype_head, reference
from raytransfer.irradiance import RAYS, LightTable, pixel_response
from raytransfer.lenses import Lens, SphericalLens
from raytransfer.systems import OpticalSystem
from raytransfer.tracing import trace

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from benchmarks.peers import Array

COUNT = 1_000_000
ROUNDS = 9
BLOCK = 8192  # rays of plain numpy that stay in the cache
WAVELENGTH = 0.63  # µm
# what one ray through two planes and two cylinders to a plane takes at least
ROOTS, DIVISIONS = 7, 6


def run() -> list[Result]:
    """Measure everything about exact rays."""
    rng = np.random.default_rng(43)
    pair = pair_with_sensor()
    rays = arriving_rays(rng, pair, COUNT)
    return [
        *_alone(pair, *rays),
        *_beside_numpy(pair, *rays),
        *_beside_optiland(pair, *rays),
        *_beside_batoid(rng),
        *_profile(rng),
        _memory(),
    ]


def arriving_rays(
    rng: np.random.Generator, system: OpticalSystem, count: int
) -> tuple[Array, Array]:
    """Return skew rays (3, count) from all over a room, all of which arrive near the sensor."""
    found: list[tuple[Array, Array]] = []
    missing = count
    while missing > 0:
        position, direction = skew_rays(rng, system, count, ROOM)
        end = trace(system, position, direction)
        near = np.flatnonzero(end.arrived & (np.hypot(end.x, end.y) < NEAR))[:missing]
        found.append((position[:, near], direction[:, near]))
        missing -= len(near)
    positions, directions = zip(*found, strict=True)
    # coordinate after coordinate, as all tracers want them
    position_of, direction_of = (
        np.ascontiguousarray(np.concatenate(parts, axis=1)) for parts in (positions, directions)
    )
    return position_of, direction_of


def _over(
    system: OpticalSystem, position: Array, direction: Array, **options: Any
) -> Callable[[], object]:
    """Trace into the same memory each time, as others change their rays in place."""
    place = trace(system, position, direction)
    return lambda: trace(system, position, direction, out=place, **options)


def _alone(pair: OpticalSystem, position: Array, direction: Array) -> list[Result]:
    numbers = position.reshape(-1)
    limit = np.empty(COUNT)
    one, two, fresnel, bound = interleaved(
        ROUNDS,
        seconds(_over(pair, position, direction, fresnel=False, threads=1)),
        seconds(_over(pair, position, direction, fresnel=False, threads=2)),
        seconds(_over(pair, position, direction, threads=1)),
        seconds(lambda: _roots_and_divisions(numbers, limit)),
    )
    return [
        Result("trace, one thread", "rays/s", [COUNT / taken for taken in one]),
        Result("trace, two threads", "rays/s", [COUNT / taken for taken in two]),
        Result("trace with Fresnel, one thread", "rays/s", [COUNT / taken for taken in fresnel]),
        Result("trace / its roots and divisions alone", "×", ratios(bound, one)),
    ]


@njit(error_model="numpy")
def _roots_and_divisions(numbers: Array, out: Array) -> None:
    """Take as many roots and divisions for each number as a ray needs; none waits for another."""
    for start in range(0, len(out), 1024):
        for i in range(start, min(start + 1024, len(out))):
            number = abs(numbers[i])
            total = 0.0
            for k in range(ROOTS):
                total += np.sqrt(number + k)
            for k in range(DIVISIONS):
                total += k / (number + (k + 0.5))
            out[i] = total


def _beside_numpy(pair: OpticalSystem, position: Array, direction: Array) -> list[Result]:
    def blocks() -> list[Array]:
        traced = (
            reference.trace(
                pair,
                position[:, start : start + BLOCK],
                direction[:, start : start + BLOCK],
                fresnel=False,
            )
            for start in range(0, COUNT, BLOCK)
        )
        return [np.stack([end.x, end.y]) for end in traced]

    ours = trace(pair, position, direction, fresnel=False)
    require_same("numpy", np.concatenate(blocks(), axis=1), (ours.x, ours.y), 1e-10)
    compiled, plain = interleaved(
        ROUNDS,
        seconds(_over(pair, position, direction, fresnel=False, threads=1)),
        seconds(blocks),
    )
    return [Result("trace / numpy in blocks", "×", ratios(plain, compiled), target=5)]


def _beside_optiland(pair: OpticalSystem, position: Array, direction: Array) -> list[Result]:
    from optiland.materials import IdealMaterial
    from optiland.optic import Optic
    from optiland.physical_apertures import RectangularAperture
    from optiland.rays import RealRays

    placed = places(pair, lambda material: material.index())
    optic = Optic()
    optic.surfaces.add(index=0, thickness=math.inf)
    for number, (here, after) in enumerate(pairwise(placed), start=1):
        width, height = here.surface.half
        shape: dict[str, Any] = {}
        if here.surface.bends:
            # its biconic is slower
            radius = 1 / here.surface.curvature
            shape = {"surface_type": "toroidal", "radius_x": radius, "radius_y": math.inf}
        optic.surfaces.add(
            index=number,
            thickness=after.origin[2] - here.origin[2],
            material=IdealMaterial(n=here.index),
            aperture=RectangularAperture(-width, width, -height, height),
            is_stop=number == 1,
            **shape,
        )
    optic.surfaces.add(index=len(placed))
    optic.wavelengths.add(value=WAVELENGTH, is_primary=True)
    ones = np.ones(COUNT)

    def traced() -> tuple[float, Any]:
        # it changes its rays; making them is not counted
        rays = RealRays(*position.copy(), *direction.copy(), ones.copy(), WAVELENGTH * ones)
        taken = timeit.timeit(lambda: optic.surfaces.trace(rays, skip=1, record=False), number=1)
        return taken, rays

    ours = trace(pair, position, direction, fresnel=False)
    rays = traced()[1]
    require_same("optiland", (rays.x, rays.y, rays.i > 0), (ours.x, ours.y, ours.arrived))
    one, every, theirs = interleaved(
        ROUNDS,
        seconds(_over(pair, position, direction, fresnel=False, threads=1)),
        seconds(_over(pair, position, direction, fresnel=False)),
        lambda: traced()[0],
    )
    return [
        Result("trace, all threads / optiland's numpy", "×", ratios(theirs, every), target=60),
        Result("trace, one thread / optiland's numpy", "×", ratios(theirs, one)),
    ]


def _beside_batoid(rng: np.random.Generator) -> list[Result]:
    import batoid
    from batoid import global_vars

    pair = spherical_pair()
    position, direction = arriving_rays(rng, pair, COUNT)
    placed = places(pair, lambda material: material.index())
    media = [batoid.ConstMedium(index) for index in (1.0, *(place.index for place in placed))]
    items = [
        (*batoid_interface(place.surface), batoid.CoordSys(place.origin), before, behind)
        for place, (before, behind) in zip(placed, pairwise(media), strict=True)
    ]
    start = batoid.RayVector(*position, *direction)

    def traced(threads: int) -> tuple[float, Any]:
        rays = start.copy()  # it changes its rays; making them is not counted

        def through() -> None:
            for interface, opening, frame, before, behind in items:
                if before == behind:  # the sensor
                    interface.intersect(rays, frame)
                else:
                    interface.refract(rays, before, behind, frame)
                if opening is not None:
                    opening.obscure(rays)

        global_vars._batoid_max_threads = threads
        return timeit.timeit(through, number=1), rays

    ours = trace(pair, position, direction, fresnel=False)
    rays = traced(1)[1]
    lost = rays.vignetted | rays.failed
    require_same("batoid", (rays.x, rays.y, ~lost), (ours.x, ours.y, ours.arrived))
    results = []
    for threads, words in ((1, "one thread"), (2, "two threads")):
        compiled, theirs = interleaved(
            ROUNDS,
            seconds(_over(pair, position, direction, fresnel=False, threads=threads)),
            lambda threads=threads: traced(threads)[0],  # type: ignore[misc]
        )
        results.append(
            Result(f"trace, spheres / batoid, {words}", "×", ratios(theirs, compiled), target=10)
        )
    return results


def spherical_pair() -> OpticalSystem:
    """Return the thesis's pair with spheres for cylinders."""
    pair = pair_with_sensor()
    lenses = tuple(
        SphericalLens(
            f"{lens.part} as a sphere",
            lens.height,
            math.inf if lens.reversed else lens.radius,
            -lens.radius if lens.reversed else math.inf,
            lens.thickness,
            lens.material,
        )
        for lens in pair.elements
        if isinstance(lens, Lens)
    )
    return OpticalSystem("pair of spheres", lenses, pair.gaps, pair.sensor_distance)


def _profile(rng: np.random.Generator) -> list[Result]:
    """Light on the pixels behind the whole head of figure 4.7, from sources all over the room."""
    head = prototype_head()
    table = LightTable(head, TCD1304, wavelength=WAVELENGTH)
    sources = [
        (distance * math.tan(angle), 0.0, distance)
        for distance, angle in zip(
            np.exp(rng.uniform(math.log(700.0), math.log(5000.0), 12)).tolist(),
            np.radians(rng.uniform(-20.0, 20.0, 12)).tolist(),
            strict=True,
        )
    ]
    exact = [response(head, source, (10 * RAYS[0], 10 * RAYS[1])) for source in sources]
    coarse = [response(head, source, RAYS) for source in sources]
    from_table = [table.solid_angles(source) for source in sources]
    (once,) = interleaved(ROUNDS, lambda: _each(sources, lambda at: response(head, at, RAYS)))
    (looked_up,) = interleaved(ROUNDS, lambda: _each(sources, table.solid_angles, 50))
    return [
        Result("light on the pixels, one thread", "ms", [1e3 * s for s in once], "lower", 100),
        Result(
            "its error, RMS, of 100 times the rays",
            "% of peak",
            [100 * rms(few, many) for few, many in zip(coarse, exact, strict=True)],
            "lower",
            1,
        ),
        Result("light from the table", "µs", [1e6 * s for s in looked_up], "lower", 50),
        Result(
            "its error, RMS",
            "% of peak",
            [100 * rms(quick, many) for quick, many in zip(from_table, exact, strict=True)],
            "lower",
        ),
    ]


def response(
    system: OpticalSystem, source: tuple[float, float, float], rays: tuple[int, int]
) -> NDArray[np.float64]:
    """Trace to the pixels on one thread."""
    return pixel_response(system, source, wavelength=WAVELENGTH, rays=rays, threads=1)


def _each(
    sources: list[tuple[float, float, float]],
    call: Callable[[tuple[float, float, float]], object],
    number: int = 1,
) -> float:
    """Return how long a call takes on average, s."""
    taken = timeit.timeit(lambda: [call(source) for source in sources], number=number)
    return taken / len(sources) / number


def rms(pixels: NDArray[np.float64], exact: NDArray[np.float64]) -> float:
    """RMS difference where there is light, relative to the peak."""
    lit = (pixels > 0) | (exact > 0)
    return float(np.sqrt(np.mean((pixels - exact)[lit] ** 2)) / exact.max())


_MEMORY = """
from pathlib import Path
from raytransfer import TCD1304, prototype_head
from raytransfer.irradiance import irradiance
from raytransfer.sources import Emitter

def light(*rays):
    irradiance(prototype_head(), Emitter(), (300.0, 0.0, 1300.0), TCD1304, integration_time=25e-6,
               rays=rays, wavelengths=1)

def kilobytes(what):
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith(what))

light(16, 16)
Path("/proc/self/clear_refs").write_text("5")  # forget the peak so far
start = kilobytes("VmRSS:")
light(10_000, 10_000)
print(kilobytes("VmHWM:") - start)
"""


def _memory() -> Result:
    """Measure what a run of 10⁸ rays adds to the memory of a process that has traced a few."""
    command = [sys.executable, "-c", _MEMORY]
    output = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    return Result("memory of 10⁸ rays of light", "MB", [int(output) / 1024], "lower", 1000)
