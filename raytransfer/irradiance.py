"""What really lands on the pixels: exact rays, Fresnel losses, every joule accounted for.

A grid of rays fills the front opening. Each stands for a cell of it, and the cell's light is spread
evenly over its image on the sensor, between the middles to the images of the neighbours. There is no
noise of sampling, caustics come out sharp, and what is emitted equals what arrives plus what is lost.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from raytransfer import _checks as check
from raytransfer.prescription import prescription
from raytransfer.sensors import TCD1304, LineSensor
from raytransfer.tracing import check_source, front_opening, load_kernels, using

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import ArrayLike, NDArray

    from raytransfer.sources import Emitter
    from raytransfer.systems import OpticalSystem

PLANCK = 6.62607015e-34  # J s
SPEED_OF_LIGHT = 299792458.0  # m/s

RAYS = (384, 128)
"""Columns and rows of the grid when nothing is said: 0.1 % of the peak, RMS, in the thesis's head."""

FEWEST_ROWS = 16
"""With fewer rows of rays the pixel line is too thin to be met."""


def photon_energy(wavelength: ArrayLike) -> NDArray[np.float64]:
    """Energy of a photon in J; wavelength in µm."""
    return np.asarray(PLANCK * SPEED_OF_LIGHT / (np.asarray(wavelength) * 1e-6))


@dataclass(frozen=True)
class EnergyBudget:
    """Where the light went, J (for `pixel_budget`: sr). Every part is added up on its own.

    Attributes
    ----------
    emitted : float
        Toward the front opening.
    on_pixels, beside_line, beyond_ends : float
        On the pixels; on the sensor's plane above and below the line; beyond its ends.
    surfaces : tuple of str
        Names of the surfaces, front to back, and of the sensor's plane.
    missed, blocked, totally_reflected, reflected : tuple of float
        Lost at each surface: no intersection; outside the opening; total reflection; the part that
        Fresnel's equations reflect.
    """

    emitted: float
    on_pixels: float
    beside_line: float
    beyond_ends: float
    surfaces: tuple[str, ...]
    missed: tuple[float, ...]
    blocked: tuple[float, ...]
    totally_reflected: tuple[float, ...]
    reflected: tuple[float, ...]

    @property
    def accounted(self) -> float:
        """The sum of all parts; equal to `emitted` but for rounding."""
        return math.fsum(amount for _, amount in self.parts())

    def parts(self) -> Iterator[tuple[str, float]]:
        """Yield the name and the amount of every part that is not 0."""
        yield "on the pixels", self.on_pixels
        yield "beside the line", self.beside_line
        yield "beyond its ends", self.beyond_ends
        for what in ("missed", "blocked", "totally_reflected", "reflected"):
            for surface, amount in zip(self.surfaces, getattr(self, what), strict=True):
                if amount:
                    yield f"{what.replace('_', ' ')} at {surface}", amount


class PixelLight(NamedTuple):
    """What `irradiance` finds.

    Attributes
    ----------
    electrons : ndarray, shape (pixels,)
        Mean photo-electrons of each pixel.
    budget : EnergyBudget
        Of the light sent toward the front opening in the integration time, J.
    """

    electrons: NDArray[np.float64]
    budget: EnergyBudget


def irradiance(
    system: OpticalSystem,
    emitter: Emitter,
    position: tuple[float, float, float],
    sensor: LineSensor = TCD1304,
    *,
    integration_time: float,
    facing: tuple[float, float, float] = (0.0, 0.0, 1.0),
    rays: tuple[int, int] = RAYS,
    wavelengths: int = 5,
    threads: int | None = None,
) -> PixelLight:
    """Electrons in every pixel from an emitter.

    Parameters
    ----------
    system : OpticalSystem
        With a sensor_distance.
    emitter : Emitter
        An extended one is taken as points along the line, weighted as the chords of a disc, with
        images half a pixel apart or less.
    position : tuple of float
        X along the pixel line, Y up, and distance before the first vertex, mm.
    sensor : LineSensor
        Its pitch, height and quantum efficiency are used; the window belongs to the system.
    integration_time : float
        s.
    facing : tuple of float
        Direction of the emitter's axis in the frame of the system; straight at it when left out.
    rays : tuple of int
        Columns along X and rows along Y of the grid over the front opening. An opening within the
        head that is narrower than a row or column needs more.
    wavelengths : int
        How many stand for the spectrum.
    threads : int, optional
        All when left out; the result is the same.

    Raises
    ------
    ValueError
        If the sensor or its response is unknown, the source stands in the lens, or a number is not
        finite.
    """
    time = check.not_negative("integration_time", integration_time, "s")
    if sensor.response is None:
        raise ValueError(f"{sensor.name}: its data file lacks the spectral response")
    axis = check.array("facing", facing)
    if axis.shape != (3,) or not axis.any():
        raise ValueError(f"facing = {facing}: a direction, X, Y and Z with the light")
    axis = axis / np.sqrt(axis @ axis)
    table = emitter.lobe.table(2049)
    place = check_source(position)
    points = disc_points(system, emitter.extent, place[2], sensor)
    electrons = np.zeros(sensor.pixels)
    on_pixels = np.zeros(sensor.pixels)
    account = 0.0
    for wavelength, share in zip(*emitter.spectrum.samples(wavelengths), strict=True):
        for point, part in disc(place, emitter.extent, points):
            pixels, losses = _illuminate(
                system, point, sensor, wavelength, rays, threads, table, axis
            )
            energy = emitter.power * time * share * part
            on_pixels += energy * pixels
            account = account + energy * losses
            efficiency = float(sensor.response.quantum_efficiency(wavelength))
            electrons += energy * efficiency / photon_energy(wavelength) * pixels
    return PixelLight(electrons, _budget(system, on_pixels, np.asarray(account)))


def pixel_response(
    system: OpticalSystem,
    position: tuple[float, float, float],
    sensor: LineSensor = TCD1304,
    *,
    wavelength: float,
    rays: tuple[int, int] = RAYS,
    threads: int | None = None,
) -> NDArray[np.float64]:
    """Solid angle of a point source's light that each pixel gets, losses taken off, sr.

    The exact counterpart of `illumination.pixel_solid_angles`: times the radiant intensity in W/sr
    this is the power on a pixel.

    Parameters
    ----------
    system, position, sensor, rays, threads
        As for `irradiance`.
    wavelength : float
        µm.
    """
    return _illuminate(system, check_source(position), sensor, wavelength, rays, threads)[0]


def pixel_budget(
    system: OpticalSystem,
    position: tuple[float, float, float],
    sensor: LineSensor = TCD1304,
    *,
    wavelength: float,
    rays: tuple[int, int] = RAYS,
    threads: int | None = None,
) -> EnergyBudget:
    """Where the light of a source goes that sends 1 W/sr in all directions; as `pixel_response`."""
    pixels, account = _illuminate(system, check_source(position), sensor, wavelength, rays, threads)
    return _budget(system, pixels, account)


def disc_points(
    system: OpticalSystem, extent: float, distance: float, sensor: LineSensor = TCD1304
) -> int:
    """Return how many points stand for a disc: their images are half a pixel apart or less.

    Parameters
    ----------
    system : OpticalSystem
    extent, distance : float
        Diameter of the disc and its distance before the first vertex, mm.
    sensor : LineSensor
    """
    focal_length = abs(system.effective_focal_length("x"))
    if math.isinf(focal_length):  # a camera without lenses
        focal_length = system.length + (system.sensor_distance or 0.0)
    image = extent * focal_length / distance / sensor.pitch
    # in the middle the nodes are π/2 times as far apart as on average
    return max(7, math.ceil(math.pi * image)) if extent else 1


def disc(
    position: tuple[float, float, float], extent: float, points: int
) -> list[tuple[tuple[float, float, float], float]]:
    """Points along the line that stand for a disc of a diameter in mm, and their shares."""
    if points == 1:
        return [(position, 1.0)]
    # Gauss and Chebyshev's second rule: its weight is a disc's chord
    angle = np.arange(1, points + 1) * np.pi / (points + 1)
    shares = 2 / (points + 1) * np.sin(angle) ** 2
    x, y, distance = position
    return [
        ((x + offset, y, distance), share)
        for offset, share in zip(
            (extent / 2 * np.cos(angle)).tolist(), shares.tolist(), strict=True
        )
    ]


def disc_image(diameter: float, *, chords: bool = False) -> NDArray[np.float64]:
    """Shares of a disc's light by part of the line, its image lying on the middle of a part.

    Light of a point, convolved with it, is that of a disc.

    Parameters
    ----------
    diameter : float
        Of the image, in parts: pixels, or fractions of them; 0 is a point.
    chords : bool
        Each part gets as much as the chord in its middle tells, instead of all that falls on it:
        the same where parts are fine.

    Returns
    -------
    ndarray
        An odd number of shares, 1 in all.

    Raises
    ------
    ValueError
        If the diameter is negative or not finite.
    """
    radius = check.not_negative("diameter", diameter, "in parts of the line") / 2
    if radius < 5e-7:
        return np.ones(1)
    if chords:
        across = np.arange(-math.floor(radius), math.floor(radius) + 1)
        chord = np.sqrt(radius**2 - across**2)
        return np.asarray(chord / chord.sum())
    reach = math.ceil(radius - 0.5)
    edges = np.clip((np.arange(2 * reach + 2) - reach - 0.5) / radius, -1, 1)
    # what is under a chord's length has a closed form
    return np.asarray(np.diff(edges * np.sqrt(1 - edges**2) + np.arcsin(edges)) / math.pi)


def _illuminate(
    system: OpticalSystem,
    position: tuple[float, float, float],
    sensor: LineSensor,
    wavelength: float,
    rays: tuple[int, int],
    threads: int | None,
    lobe: NDArray[np.float64] | None = None,
    facing: NDArray[np.float64] | None = None,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Pixels (sr, or the lobe's unit) and the account of `_kernels.illuminate`."""
    if system.sensor_distance is None:
        raise ValueError(f"{system.name}: sensor_distance is needed to say where light lands")
    nx, ny = (check.whole(f"rays[{i}]", number) for i, number in enumerate(rays))
    if ny < FEWEST_ROWS:
        raise ValueError(
            f"rays = {rays}: allowed are {FEWEST_ROWS} rows or more, (columns, rows); the light on "
            "the thin line of pixels is found between rows"
        )
    kernels = load_kernels()
    low_x, high_x, low_y, high_y = front_opening(system, position)
    grid = np.array([low_x, (high_x - low_x) / nx, low_y, (high_y - low_y) / ny])
    parts = prescription(system, wavelength)
    pixels = np.zeros(sensor.pixels)
    account = np.zeros((len(parts.shapes) + 2, 4))
    with using(threads):
        kernels.illuminate(
            nx,
            ny,
            np.array(position),
            grid,
            np.empty(0) if lobe is None else lobe,
            np.zeros(3) if facing is None else facing,
            *parts,
            True,
            sensor.pitch,
            sensor.pixel_height / 2,
            pixels,
            account,
        )
    return pixels, account


def _budget(
    system: OpticalSystem, pixels: NDArray[np.float64], account: NDArray[np.float64]
) -> EnergyBudget:
    emitted, beside, beyond, _ = account[-1].tolist()
    missed, blocked, totally, partly = (tuple(column.tolist()) for column in account[:-1].T)
    return EnergyBudget(
        emitted=emitted,
        on_pixels=math.fsum(pixels),
        beside_line=beside,
        beyond_ends=beyond,
        surfaces=(
            *(
                f"{element.part}{side}"
                for element in system.elements
                for side in ("", ", back")[: len(element.surfaces())]
            ),
            "the sensor's plane",
        ),
        missed=missed,
        blocked=blocked,
        totally_reflected=totally,
        reflected=partly,
    )


class LightTable:
    """`pixel_response` for a source that moves: some tens of µs a position.

    What changes smoothly with the source is not the profile but where each part of the pupil sends
    its light, and how much. Both are computed, for `COLUMNS` parts of the open pupil, on a lattice
    in X/distance, Y/distance and 1/distance, when they are first needed, and interpolated by cubic
    polynomials in between; the parts are then laid on the pixels. Caustics move and sharpen as they
    should. Where that is not good enough, because edges within the head or the rim of the field pass
    through, rays are traced: a cell of the lattice is used only if, in its middle, it differs from
    them by less than `TOLERANCE`.

    Parameters
    ----------
    system : OpticalSystem
        With a sensor_distance.
    sensor : LineSensor
    wavelength : float
        µm.
    """

    COLUMNS = 128
    ROWS = 16
    ROUGH = (32, 64)
    STEPS = (0.05, 0.05, 2.5e-4)
    """Of the lattice: slopes, and 1/mm."""
    CLOSEST = 200.0
    """Nearer sources than this, mm, are computed anew each time."""
    TOLERANCE = 0.01
    """Of the peak, RMS over the pixels that get light."""
    CELLS = 512
    """So many of its cells are kept, 0.2 MB each, and eight times as many nodes of 3 kB."""

    def __init__(
        self, system: OpticalSystem, sensor: LineSensor = TCD1304, *, wavelength: float = 0.63
    ) -> None:
        if system.sensor_distance is None:
            raise ValueError(f"{system.name}: sensor_distance is needed to say where light lands")
        self.system = system
        self.sensor = sensor
        self.wavelength = check.positive("wavelength", wavelength, "wavelengths are in µm")
        self._parts = prescription(system, wavelength)
        load_kernels()  # refuses now what cannot be traced later
        self._nodes: OrderedDict[tuple[int, int, int], NDArray[np.float64]] = OrderedDict()
        self._cells: OrderedDict[tuple[int, int, int], NDArray[np.float64] | None] = OrderedDict()

    def solid_angles(self, position: tuple[float, float, float]) -> NDArray[np.float64]:
        """Solid angle of a point source's light that each pixel gets, losses taken off, sr.

        Parameters
        ----------
        position : tuple of float
            As for `pixel_response`; a source at or behind the first vertex gives darkness.

        Returns
        -------
        ndarray, shape (pixels,)
        """
        x, y, distance = position
        if not math.isfinite(x + y + distance):
            check_source(position)  # says which; on its own it would take a tenth of the time
        pixels = np.zeros(self.sensor.pixels)
        if distance <= 0:
            return pixels
        if distance < self.CLOSEST:
            return pixel_response(self.system, position, self.sensor, wavelength=self.wavelength)
        at = [
            value / step - offset
            for value, step, offset in zip(
                (x / distance, y / distance, 1 / distance), self.STEPS, _OFFSETS, strict=True
            )
        ]
        first = [math.floor(value) - 1 for value in at]
        first[2] = max(first[2], 0)  # beyond the farthest nodes the polynomial goes on
        cell = self._cell((first[0], first[1], first[2]))
        if cell is None:
            return pixel_response(self.system, position, self.sensor, wavelength=self.wavelength)
        if not cell.size:
            return pixels
        within = (at[0] - first[0], at[1] - first[1], at[2] - first[2])
        self._lay(cell, within, 1 / distance, pixels)
        return pixels

    def _cell(self, first: tuple[int, int, int]) -> NDArray[np.float64] | None:
        """The 64 nodes around a cell, shape (64, 3 COLUMNS); empty if dark, None if to be traced."""
        if first in self._cells:
            self._cells.move_to_end(first)
            return self._cells[first]
        nodes = [
            self._node((first[0] + i, first[1] + j, first[2] + k))
            for i in range(4)
            for j in range(4)
            for k in range(4)
        ]
        lit = sum(bool(node.size) for node in nodes)
        cell = np.stack(nodes) if lit == len(nodes) else None if lit else np.empty(0)
        if not self._right(first, cell):
            cell = None
        _keep(self._cells, first, cell, self.CELLS)
        return cell

    def _right(self, first: tuple[int, int, int], cell: NDArray[np.float64] | None) -> bool:
        """Whether a cell gives, in its middle, what rays give: not where edges move through it."""
        if cell is None:
            return False
        slope_x, slope_y, near = (
            (number + 1.5 + offset) * step
            for number, offset, step in zip(first, _OFFSETS, self.STEPS, strict=True)
        )
        place = (slope_x / near, slope_y / near, 1 / near)
        traced = pixel_response(self.system, place, self.sensor, wavelength=self.wavelength)
        found = np.zeros(self.sensor.pixels)
        if cell.size:
            self._lay(cell, (1.5, 1.5, 1.5), near, found)
        lit = (traced > 0) | (found > 0)
        if not lit.any():
            return True
        error = np.sqrt(np.mean((found - traced)[lit] ** 2))
        return bool(error <= self.TOLERANCE * traced.max())

    def _lay(
        self,
        cell: NDArray[np.float64],
        at: tuple[float, float, float],
        near: float,
        pixels: NDArray[np.float64],
    ) -> None:
        """Interpolate a cell's columns at a place in units of its nodes, and lay them on pixels."""
        x, y, z = (_cubic(value) for value in at)
        weights = np.multiply.outer(np.multiply.outer(x, y), z).ravel()
        columns = (weights @ cell).reshape(3, -1)
        load_kernels().lay(columns, near**2, self.sensor.pitch, pixels)

    def _node(self, index: tuple[int, int, int]) -> NDArray[np.float64]:
        if index not in self._nodes:
            slope_x, slope_y, near = (
                (number + offset) * step
                for number, offset, step in zip(index, _OFFSETS, self.STEPS, strict=True)
            )
            distance = 1 / near
            node = self._pupil((slope_x * distance, slope_y * distance, distance))
            _keep(self._nodes, index, node, 8 * self.CELLS)
        return self._nodes[index]

    def _pupil(self, position: tuple[float, float, float]) -> NDArray[np.float64]:
        """Light × distance², place on the line and width of the open pupil's columns, in turn.

        Empty where no light gets to the line.
        """
        low_x, high_x, low_y, high_y = front_opening(self.system, position)
        # where the line's light passes: first roughly, then both ends more and more closely
        rough, (first_row, last_row) = self._columns(
            position, (low_x, high_x, low_y, high_y), *self.ROUGH
        )
        lit = np.flatnonzero(rough[0])
        if not len(lit):
            return np.empty(0)
        row = (high_y - low_y) / self.ROUGH[1]
        low_y, high_y = (
            max(low_y, low_y + (first_row - 1) * row),
            min(high_y, low_y + (last_row + 2) * row),
        )
        step = (high_x - low_x) / self.ROUGH[0]
        ends = [low_x + lit[0] * step, low_x + (lit[-1] + 1) * step]
        for _ in range(2):
            for side in (0, 1):  # each lies within a column of the one found
                around = (ends[side] - step, ends[side] + step, low_y, high_y)
                lit = np.flatnonzero(self._columns(position, around, 32, 32)[0][0])
                if len(lit):
                    number = lit[0] if side == 0 else lit[-1] + 1
                    ends[side] = around[0] + number * step / 16
            step /= 16
        columns, _ = self._columns(
            position, (ends[0], ends[1], low_y, high_y), self.COLUMNS, self.ROWS
        )
        columns[0] *= position[2] ** 2
        return columns.ravel()

    def _columns(
        self,
        position: tuple[float, float, float],
        area: tuple[float, float, float, float],
        nx: int,
        ny: int,
    ) -> tuple[NDArray[np.float64], tuple[int, int]]:
        """Light, place and width of each column of an area of the front; first and last lit row."""
        low_x, high_x, low_y, high_y = area
        grid = np.array([low_x, (high_x - low_x) / nx, low_y, (high_y - low_y) / ny])
        columns = np.empty((3, nx))
        rows = load_kernels().columns_of(
            nx, ny, np.array(position), grid, *self._parts, self.sensor.pixel_height / 2, columns
        )
        return columns, rows


_OFFSETS = (0.0, 0.0, 0.5)
"""Of the lattice, in steps: the farthest nodes are half a step from infinity."""


def _cubic(t: float) -> NDArray[np.float64]:
    """Weights of the nodes 0, 1, 2, 3 at t: Lagrange's polynomials."""
    return np.array(
        [
            -(t - 1) * (t - 2) * (t - 3) / 6,
            t * (t - 2) * (t - 3) / 2,
            -t * (t - 1) * (t - 3) / 2,
            t * (t - 1) * (t - 2) / 6,
        ]
    )


def _keep(store: OrderedDict[Any, Any], key: Any, value: Any, most: int) -> None:
    """Store a value, and forget the first if there are too many."""
    store[key] = value
    if len(store) > most:
        store.popitem(last=False)
