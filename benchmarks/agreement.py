"""Compare exact rays with rayoptics and batoid; the exit status is 1 where they do not agree.

The thesis's pair, catalogue glass at two wavelengths and random systems, skew rays through all of
them: where each ray meets the sensor plane, or at which surface it is lost and why.
"""

from __future__ import annotations

import argparse
import math
import sys
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from rich.console import Console
from rich.table import Table

from benchmarks.peers import Fates, trace_batoid, trace_rayoptics
from raytransfer.lenses import Aperture, Lens, Plate, SphericalLens
from raytransfer.materials import D_LINE, ConstantIndex
from raytransfer.systems import OpticalSystem, Placement, telecentric_pair
from raytransfer.tracing import Status, Trace, trace

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from benchmarks.peers import Array, Index
    from raytransfer.lenses import Element, Meridian

TOLERANCE = 1e-11
"""mm on the sensor, of rays that are nowhere near grazing; of others relative, see `Comparison`."""
NEAR = 20.0
"""mm from the middle of the sensor: the longest line that is sold is 29 mm long."""
GRAZING = 0.1
"""Cosine of incidence or refraction below which a ray is near grazing (84° and more)."""


@dataclass
class Comparison:
    """What two tracers said of the same rays, system after system.

    Of rays near the sensor and nowhere near grazing positions are compared in mm; of all others
    relative to the distance from the sensor's middle and to 1/cosine, with which rounding grows.
    """

    peer: str
    group: str
    systems: int = 0
    rays: int = 0
    worst: float = 0.0  # mm
    others: int = 0
    grazing: int = 0
    worst_others: float = 0.0  # relative
    lost: dict[Status, int] = field(default_factory=lambda: dict.fromkeys(list(Status)[1:], 0))
    disagreements: list[str] = field(default_factory=list)

    @property
    def holds(self) -> bool:
        """Whether all fates agree, and all positions within the tolerance."""
        return not self.disagreements and max(self.worst, self.worst_others) <= TOLERANCE

    def add(self, name: str, ours: Trace, theirs: Fates) -> None:
        """Compare one system's rays.

        Parameters
        ----------
        name : str
            For the list of disagreements.
        ours : Trace
        theirs : Fates
        """
        self.systems += 1
        self.rays += len(theirs.status)
        for status in self.lost:
            self.lost[status] += int(np.count_nonzero(ours.status == status))
        same = (ours.status == theirs.status) & (ours.surface == theirs.surface)
        self.disagreements += [
            f"{name}, ray {ray}: {_fate(ours, ray)} here, {_fate(theirs, ray)} in {self.peer}"
            for ray in np.flatnonzero(~same).tolist()
        ]
        arrived = same & (ours.status == Status.ARRIVED)
        apart = np.hypot(ours.x - theirs.x, ours.y - theirs.y)
        away = np.hypot(theirs.x, theirs.y)
        apart[np.isnan(apart)], away[np.isnan(away)] = math.inf, 0.0  # NaN is no agreement
        grazing = arrived & (theirs.cosine < GRAZING)
        strict = arrived & ~grazing & (away <= NEAR)
        self.worst = max(self.worst, float(apart[strict].max(initial=0.0)))
        others = arrived & ~strict
        self.others += int(np.count_nonzero(others))
        self.grazing += int(np.count_nonzero(grazing))
        relative = apart * theirs.cosine / np.maximum(1.0, away)
        self.worst_others = max(self.worst_others, float(relative[others].max(initial=0.0)))


def _fate(rays: Trace | Fates, ray: int) -> str:
    status = Status(int(rays.status[ray])).name.lower()
    where = int(rays.surface[ray])
    return status if where < 0 else f"{status} at surface {where}"


class Case(NamedTuple):
    """A system, how far away its light comes from (mm), a wavelength (µm), the peer's indices."""

    system: OpticalSystem
    distances: tuple[float, float]
    wavelength: float = D_LINE
    indices: Index | None = None


ROOM = (500.0, 5000.0)
NEARBY = (100.0, 2000.0)  # random lenses magnify what the distance of the source has rounded away


def pair_with_sensor(lens: Lens | str = "PCX_30_32_60", gap: float = 0.17) -> OpticalSystem:
    """Return two lenses face to face with the sensor where parallel light is focused."""
    pair = telecentric_pair(lens, gap=gap)
    return _with_sensor(pair, pair.back_focal_length("x"))


def _with_sensor(system: OpticalSystem, distance: float, **places: Any) -> OpticalSystem:
    return OpticalSystem(system.name, system.elements, system.gaps, distance, **places)


def glass_cases() -> Iterator[Case]:
    """Yield N-BK7 at the ends of what a silicon sensor is used for, by Schott's catalogue."""
    from opticalglass.glassfactory import create_glass

    schott = create_glass("N-BK7", "Schott")
    for wavelength in (0.45, 0.85):
        index = float(schott.rindex(1000 * wavelength))  # nm
        yield Case(pair_with_sensor("LJ1430L1", 0.5), ROOM, wavelength, _constant(index))


def _constant(index: float) -> Index:
    return lambda _: index


def random_system(
    rng: np.random.Generator, kinds: Sequence[Callable[[np.random.Generator], Element]]
) -> OpticalSystem:
    """Return one to three elements, in half of the systems decentred and tilted.

    Parameters
    ----------
    rng : numpy.random.Generator
    kinds : sequence of callable
        Makers of elements, each as likely as the others.
    """
    count = int(rng.integers(1, 4))
    elements = tuple(kinds[int(rng.integers(len(kinds)))](rng) for _ in range(count))
    placements: tuple[Placement, ...] = ()
    sensor = Placement()
    if rng.random() < 0.5:
        placements = tuple(_placement(rng) for _ in elements)
        sensor = _placement(rng)
    gaps = rng.uniform(0.0, 4.0, count - 1)
    distance = rng.uniform(10.0, 40.0)
    while True:  # apart until they do not overlap
        try:
            return OpticalSystem(
                "random", elements, tuple(gaps.tolist()), distance, placements, sensor
            )
        except ValueError as error:
            if "overlap" not in str(error):
                raise
            gaps += 1.0


def _placement(rng: np.random.Generator) -> Placement:
    x, y = rng.uniform(-1.0, 1.0, 2).tolist()
    about_x, about_y, about_z = rng.uniform(-0.1, 0.1, 3).tolist()
    return Placement((x, y), (about_x, about_y, 3 * about_z))


def _glass(rng: np.random.Generator) -> ConstantIndex:
    return ConstantIndex("glass", rng.uniform(1.4, 1.9))


def cylinder(rng: np.random.Generator) -> Lens:
    """Return a plano-cylindrical lens of either axis, either side to the light."""
    height, length = rng.uniform(10.0, 30.0, 2)
    radius = rng.choice([-1, 1]) * height / 2 * rng.uniform(1.01, 4.0)
    depth = abs(radius) - math.sqrt(radius**2 - height**2 / 4)
    meridians: tuple[Meridian, Meridian] = ("x", "y")
    return Lens(
        "cylinder",
        height,
        length,
        radius,
        rng.uniform(1.0, 4.0) + (depth if radius > 0 else 0.0),
        _glass(rng),
        bends=meridians[rng.integers(2)],
        reversed=bool(rng.integers(2)),
        clear=(0.9 * height, 0.95 * length) if rng.random() < 0.5 else None,
    )


def sphere(rng: np.random.Generator) -> SphericalLens:
    """Return a round lens, one in four of whose sides are plane."""
    diameter = rng.uniform(10.0, 30.0)
    front, back = (
        math.inf
        if rng.random() < 0.25
        else rng.choice([-1, 1]) * diameter / 2 * rng.uniform(1.05, 5.0)
        for _ in range(2)
    )
    convex = [radius for radius in (front, -back) if 0 < radius < math.inf]
    depth = sum(radius - math.sqrt(radius**2 - diameter**2 / 4) for radius in convex)
    return SphericalLens("sphere", diameter, front, back, depth + rng.uniform(1, 4), _glass(rng))


def plate(rng: np.random.Generator) -> Plate:
    """Return a window."""
    return Plate("plate", rng.uniform(0.5, 3.0), _glass(rng))


def slit(rng: np.random.Generator) -> Aperture:
    """Return a screen with a rectangular opening."""
    width, height = rng.uniform(4.0, 20.0, 2)
    return Aperture("slit", width, height)


def skew_rays(
    rng: np.random.Generator,
    system: OpticalSystem,
    count: int,
    distances: tuple[float, float] = NEARBY,
) -> tuple[Array, Array]:
    """Return rays from all over a room to the front of a system and beside it.

    Parameters
    ----------
    rng : numpy.random.Generator
    system : OpticalSystem
    count : int
    distances : tuple of float
        Nearest and farthest source, mm before the first vertex.

    Returns
    -------
    position, direction : ndarray, shape (3, count)
        mm; the directions are of unit length.
    """
    sizes = [min(system.elements[0].aperture(meridian), 30.0) for meridian in ("x", "y")]
    distance = np.exp(rng.uniform(math.log(distances[0]), math.log(distances[1]), count))
    position = np.stack([*(distance * np.tan(rng.uniform(-0.5, 0.5, (2, count)))), -distance])
    beside = rng.choice([1.0, 1.1, 2.5])  # in some systems far enough to miss a surface
    target = np.stack([rng.uniform(-size, size, count) / 2 * beside for size in sizes])
    direction = np.stack([*(target - position[:2]), distance])
    return position, direction / np.linalg.norm(direction, axis=0)


PEERS: dict[str, tuple[Callable[..., Fates], tuple[Callable[..., Element], ...]]] = {
    "rayoptics": (trace_rayoptics, (cylinder, cylinder, cylinder, plate, slit, sphere)),
    "batoid": (trace_batoid, (sphere, sphere, plate, slit)),
}
"""What each peer is asked to trace; only one of them has cylinders."""


def compare(peer: str, systems: int, rays: int, seed: int) -> list[Comparison]:
    """Trace with raytransfer and a peer.

    Parameters
    ----------
    peer : str
        A key of `PEERS`.
    systems : int
        How many random ones.
    rays : int
        Through each system.
    seed : int

    Returns
    -------
    list of Comparison
        Of the pairs with a peer that has cylinders, then of the random systems.
    """
    tracer, kinds = PEERS[peer]
    rng = np.random.default_rng(seed)
    groups = {"random": [Case(random_system(rng, kinds), NEARBY) for _ in range(systems)]}
    if cylinder in kinds:
        groups = {"pairs": [Case(pair_with_sensor(), ROOM), *glass_cases()], **groups}
    results = []
    for group, cases in groups.items():
        result = Comparison(peer, group)
        for number, (system, distances, wavelength, indices) in enumerate(cases):
            position, direction = skew_rays(rng, system, rays, distances)
            ours = trace(system, position, direction, wavelength=wavelength)
            theirs = tracer(system, position, direction, indices or _indices(wavelength))
            result.add(f"{group} {number}", ours, theirs)
        results.append(result)
    return results


def _indices(wavelength: float) -> Index:
    return lambda material: material.index(wavelength)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.agreement", description=__doc__)
    parser.add_argument("--systems", type=int, default=50, help="random ones for each peer")
    parser.add_argument("--rays", type=int, default=2000, help="through each of them")
    parser.add_argument("--seed", type=int, default=17)
    chosen = parser.parse_args(arguments)
    results = [
        result
        for peer in PEERS
        for result in compare(peer, chosen.systems, chosen.rays, chosen.seed)
    ]
    console = Console()
    console.print(_table(results))
    for result in results:
        for line in result.disagreements[:20]:
            console.print(line)
    return 0 if all(result.holds for result in results) else 1


def _table(results: Sequence[Comparison]) -> Table:
    rows: dict[str, list[str]] = {
        "systems": [f"{result.systems}" for result in results],
        "rays": [f"{result.rays:,}" for result in results],
        **{
            f"{status.name.lower()} here": [f"{result.lost[status]:,}" for result in results]
            for status in list(Status)[1:]
        },
        "fates that differ": [f"{len(result.disagreements):,}" for result in results],
        f"worst within {NEAR:g} mm of the sensor's middle, mm": [
            f"{result.worst:.2g}" for result in results
        ],
        "rays beside it or near grazing": [f"{result.others:,}" for result in results],
        f"of these with a cosine < {GRAZING:g}": [f"{result.grazing:,}" for result in results],
        "worst of these, relative to distance and 1/cosine": [
            f"{result.worst_others:.2g}" for result in results
        ],
        f"holds (≤ {TOLERANCE:g})": [
            "yes" if result.holds else "[bold red]no[/]" for result in results
        ],
    }
    table = Table("raytransfer beside")
    for result in results:
        table.add_column(f"{result.peer},\n{result.group}", justify="right")
    for name, cells in rows.items():
        table.add_row(name, *cells)
    return table


if __name__ == "__main__":
    sys.exit(main())
