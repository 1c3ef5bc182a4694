"""Heads by a few numbers, what a tracker can know with them, and the search for a better one.

The figure of merit is a Cramér–Rao bound in mm: how much an estimate of the tracker's place
scatters at best, at the worst place of the tracking area, from exact profiles of light and the
noise of reading them. ``python -m raytransfer.heads`` searches again for the head that the package
ships.

A tracker in this module knows its heading, and sees one LED a frame.
"""

from __future__ import annotations

import argparse
import math
import multiprocessing
import sys
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field, fields, replace
from itertools import pairwise, product
from pathlib import Path
from typing import TYPE_CHECKING, Literal, NamedTuple, get_args

import numpy as np

from raytransfer import _checks as check
from raytransfer.designs import PARTS, save_design
from raytransfer.irradiance import RAYS, photon_energy, pixel_response
from raytransfer.lenses import CATALOGUE, Aperture, Lens
from raytransfer.localisation import Noise
from raytransfer.outdoors import ambient_rate, pixel_view
from raytransfer.sensors import TCD1304, LineSensor
from raytransfer.sources import Emitter
from raytransfer.studies import room_to_optical
from raytransfer.systems import NOMINAL, OpticalSystem
from raytransfer.tracing import front_opening, trace

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence
    from concurrent.futures import Executor

    from numpy.typing import ArrayLike, NDArray

    from raytransfer.lenses import Element

SlitPlace = Literal["before", "between", "behind"]
"""Of a slit: before the pair, between its lenses, behind it."""


@dataclass(frozen=True)
class Head:
    """A head like that of figure 4.7, by what can be chosen; the thesis's when nothing is said.

    Parameters
    ----------
    front, back : str
        Part numbers of the pair, in `CATALOGUE` or `THESIS_LENSES`.
    front_reversed, back_reversed : bool
        Whether the plane side meets the light first.
    gap : float
        Air between the pair's vertices, mm.
    pair_to_window : float
        From the pair's last vertex to the window's outer face, mm.
    slit : float, optional
        Full width along the pixel line, mm; no slit when left out.
    slit_place : {"before", "between", "behind"}
    slit_distance : float
        From the slit to the pair's first vertex, for "between" and "behind" from the vertex that
        light passes before the slit, mm.
    collimator : bool
        Whether the lenses that bend the other meridian are there.
    concave, convex : str
        Their part numbers; curved sides to the light.
    concave_to_pair, convex_to_window : float
        Air between them and the pair or the window, mm.
    sensor : LineSensor
        With a window.
    """

    front: str = "PCX_30_32_60"
    back: str = "PCX_30_32_60"
    front_reversed: bool = True
    back_reversed: bool = False
    gap: float = 0.17
    pair_to_window: float = 25.4
    slit: float | None = None
    slit_place: SlitPlace = "before"
    slit_distance: float = 12.0
    collimator: bool = True
    concave: str = "PCV_15_30_20"
    convex: str = "PCX_15_30_20"
    concave_to_pair: float = 2.63
    convex_to_window: float = 3.0
    sensor: LineSensor = TCD1304

    def __post_init__(self) -> None:
        _require_known(self, "front", "back", "concave", "convex")
        for name in (
            "gap",
            "pair_to_window",
            "slit_distance",
            "concave_to_pair",
            "convex_to_window",
        ):
            check.not_negative(name, getattr(self, name), "a distance in mm")
        if self.slit is not None:
            check.positive("slit", self.slit, "a full width in mm; None is no slit")
        if self.sensor.window is None:
            raise ValueError(f"{self.sensor.name}: a head needs its window, which its file lacks")

    def lenses(self) -> tuple[Lens, Lens]:
        """Return the pair as it stands in the head."""
        return (
            replace(PARTS[self.front], reversed=self.front_reversed),
            replace(PARTS[self.back], reversed=self.back_reversed),
        )

    def system(self) -> OpticalSystem:
        """Return the lenses, the slit and the window; `prototype_head` when nothing was said.

        Raises
        ------
        ValueError
            If parts overlap.
        """
        first, second = self.lenses()
        window, top_to_chip = self.sensor.window, self.sensor.top_to_chip
        if window is None or top_to_chip is None:
            raise ValueError(f"{self.sensor.name}: a head needs its window, which its file lacks")
        # each with its front vertex, from that of the pair
        behind = first.thickness + self.gap + second.thickness
        top = behind + self.pair_to_window
        placed: list[tuple[float, Element]] = [
            (0.0, first),
            (first.thickness + self.gap, second),
            (top, window),
        ]
        if self.collimator:
            concave, convex = (PARTS[name].bending("y") for name in (self.concave, self.convex))
            placed.insert(0, (-self.concave_to_pair - concave.thickness, concave))
            placed.insert(3, (top - self.convex_to_window - convex.thickness, convex))
        if self.slit is not None:
            at = {
                "before": -self.slit_distance,
                "between": first.thickness + self.slit_distance,
                "behind": behind + self.slit_distance,
            }[self.slit_place]
            number = sum(front < at for front, _ in placed)
            if self.slit_place == "between":  # even where it touches the second lens
                number = 2 if self.collimator else 1
            placed.insert(number, (at, Aperture("slit", x=self.slit)))
        gaps = (
            round(after - before - element.thickness, 9)  # what floating point adds
            for (before, element), (after, _) in pairwise(placed)
        )
        return OpticalSystem(
            f"head with {first.part} + {second.part}"
            + ("" if self.slit is None else f", slit {self.slit:g} mm"),
            tuple(element for _, element in placed),
            tuple(gaps),
            round(top_to_chip - window.thickness, 9),
        )


def _require_known(of: Head | Layout, *parts: str) -> None:
    """Refuse unknown parts and an unknown place of the slit."""
    for name in parts:
        if getattr(of, name) not in PARTS:
            raise ValueError(f"{name} = {getattr(of, name)!r}: known are {', '.join(PARTS)}")
    if of.slit_place not in get_args(SlitPlace):
        raise ValueError(
            f"slit_place = {of.slit_place!r}: allowed are {', '.join(get_args(SlitPlace))}"
        )


BETTER = Head(
    "LJ1695L1",
    "LJ1567L1",
    front_reversed=True,
    back_reversed=False,
    gap=2.65,
    pair_to_window=26.25,
    slit=8.95,
    slit_distance=14.0,
    collimator=False,
    concave="LK1085L2",
    convex="LJ1328L2",
)
"""What `search` found with its defaults; ``slit-f50-f100`` of `designs.DESIGNS`."""


@dataclass(frozen=True)
class Scene:
    """What all heads are compared with: LEDs, light, noise, and where the tracker may be.

    The power, the size of the LEDs and the ambient light are assumptions; the thesis gives none.

    Parameters
    ----------
    leds : tuple of float
        x in mm of the LEDs, which stand on y = 0 and face along y. The thesis's are 0.5 m apart.
    emitter : Emitter
        0.25 W of red light from 2 mm. Of its spectrum only the mean wavelength is used.
    integration_time : float
        s; 25 µs as in the thesis's call of its program. Ambient light is gathered for as long.
    fill : float
        Part of saturation that the brightest pixel may reach, ambient light included: where it
        would be exceeded an LED is lit for less of the integration time, as the firmware allows.
    ambient : float
        Illuminance of what is behind the LEDs, lx: from a lit room (500) to sunlight (1e5).
    noise : Noise
    diffusion : float
        Standard deviation of the way that electrons wander in the silicon, mm. 0.003: with it the
        contrast of the finest lines is halved, as is usual in red light.
    distances : tuple of float
        At which heads are judged, mm: those of the thesis's measurements.
    field : float
        Every LED is within this angle of the axis for a tracker in the tracking area, rad.
    """

    leds: tuple[float, ...] = (-250.0, 250.0)
    emitter: Emitter = field(default_factory=lambda: Emitter(power=0.25, extent=2.0))
    integration_time: float = 25e-6
    fill: float = 0.7
    ambient: float = 500.0
    noise: Noise = field(default_factory=Noise)
    diffusion: float = 0.003
    distances: tuple[float, ...] = (1300.0, 4150.0)
    field: float = math.radians(25)

    def __post_init__(self) -> None:
        for name in ("leds", "distances"):
            values = getattr(self, name)
            object.__setattr__(
                self, name, tuple(check.number(f"{name}[{i}]", v) for i, v in enumerate(values))
            )
        for name, kind in (("emitter", Emitter), ("noise", Noise)):
            if not isinstance(value := getattr(self, name), kind):
                raise TypeError(f"{name} = {value!r}: of kind {kind.__name__} is needed")
        if len(set(self.leds)) < 2:
            raise ValueError(f"leds = {self.leds}: two or more places tell where the tracker is")
        if not self.distances:
            raise ValueError("distances: at least one is needed")
        for distance in self.distances:
            check.positive("a distance", distance, "from the LEDs, mm")
        check.not_negative("ambient", self.ambient, "lx")
        check.not_negative("diffusion", self.diffusion, "mm")
        check.positive("integration_time", self.integration_time, "s")
        if not 0 < check.number("fill", self.fill) <= 1:
            raise ValueError(f"fill = {self.fill:g}: allowed is > 0 to 1; was it given in percent?")
        if not 0 < check.number("field", self.field) < math.pi / 2:
            raise ValueError(
                f"field = {self.field:g}: allowed is > 0 and less than a right angle, in rad; "
                "was it given in degrees?"
            )
        if (narrowest := self.half_width(min(self.distances))) < 0:
            raise ValueError(
                f"distance = {min(self.distances):g} mm: {-narrowest:g} mm are lacking until all "
                f"LEDs are within {math.degrees(self.field):g}° of the axis"
            )

    def half_width(self, distance: float) -> float:
        """Largest |x| of the tracking area at this distance from the LEDs, mm."""
        return distance * math.tan(self.field) - max(map(abs, self.leds))

    def background(self, system: OpticalSystem, sensor: LineSensor = TCD1304) -> float:
        """Electrons that ambient light leaves in a pixel, taken from the middle one.

        With everything in its place: what decides is how much a pixel sees, not quite where.
        """
        if not self.ambient:
            return 0.0
        system = replace(system, placements=(), sensor_placement=NOMINAL)
        view = pixel_view(system, (sensor.pixels - 1) / 2, sensor, rays=20_000)
        return ambient_rate(view, sensor=sensor) * self.ambient * self.integration_time


class Spikes(NamedTuple):
    """What the pixels get from LEDs, one row each.

    Attributes
    ----------
    electrons : ndarray, shape (S, pixels)
    slope : ndarray, shape (S, pixels)
        Their change per mm that the LED moves along X, e⁻/mm.
    """

    electrons: NDArray[np.float64]
    slope: NDArray[np.float64]


COLUMNS = 96
"""Of rays, in the quick model of a profile."""

FINE = 4
"""Parts of a pixel in which light is blurred, before they are added."""

DARKNESS = 1e-6
"""Electrons of the brightest pixel: less is what rounding leaves where there is no light."""

SHIFT = 0.25
"""Pixels that an image moves, one way and the other, for the difference that is a slope."""


def spikes(
    system: OpticalSystem,
    scene: Scene,
    offset: ArrayLike,
    distance: ArrayLike,
    *,
    sensor: LineSensor = TCD1304,
    rays: tuple[int, int] | None = None,
) -> Spikes:
    """Profiles of LEDs at the height of the axis, and how they change when the LED moves along X.

    The profile of a point is blurred by the LED's disc, at the paraxial scale of its image, by
    diffraction at the cone of light that reaches the sensor, and by the wandering of electrons.
    Without these an aberrated image has edges as sharp as no LED makes, which would be taken for
    information.

    Parameters
    ----------
    system : OpticalSystem
        With a sensor_distance.
    scene : Scene
    offset, distance : array_like, shape (S,)
        X, and distance before the first vertex, mm.
    sensor : LineSensor
    rays : tuple of int, optional
        As for `pixel_response`. When left out, rays in the plane of the axis and their neighbours
        stand for all, which is some five times as fast; light agrees to 1 %, bounds to 2 % behind a slit and to
        5 % in the thesis's head. A system that is not the same above that plane as below, for a
        part is off its place, gets `RAYS`.
    """
    from scipy.fft import irfft, next_fast_len, rfft  # type: ignore[import-untyped]  # slow to load
    from scipy.special import j1  # type: ignore[import-untyped]

    if sensor.response is None:
        raise ValueError(f"{sensor.name}: its data file lacks the spectral response")
    x, z = (check.array(n, v) for n, v in (("offset", offset), ("distance", distance)))
    if x.ndim != 1 or x.shape != z.shape:
        raise ValueError(f"offset and distance have one shape (S,), not {x.shape} and {z.shape}")
    if rays is None and not _mirrored(system):
        rays = RAYS
    wavelength = scene.emitter.spectrum.mean
    scale = system.effective_focal_length("x", wavelength=wavelength) / z / sensor.pitch  # px/mm
    step = SHIFT / scale
    both = np.concatenate([x - step, x + step]), np.concatenate([z, z])
    # light is blurred before it is divided among pixels
    fine = replace(sensor, pitch=sensor.pitch / FINE, pixels=sensor.pixels * FINE)
    points, cone = _meridional(system, *both, fine, wavelength)
    if rays is not None:
        points = np.stack(
            [
                pixel_response(
                    system, (u, 0.0, v), fine, wavelength=wavelength, rays=rays, threads=1
                )
                for u, v in zip(*(array.tolist() for array in both), strict=True)
            ]
        )
    length = next_fast_len(fine.pixels + 256 * FINE, real=True)
    frequency = np.fft.rfftfreq(length, 1 / FINE)  # cycles per pixel
    # of a disc, J₁(πDν)/(πDν/2); of a slit without aberrations a triangle (Goodman, section 7.2)
    argument = np.maximum(np.pi * scene.emitter.extent * frequency * np.abs(scale[:, None]), 1e-9)
    cutoff = np.maximum(cone, 1e-9) * sensor.pitch * 1e3 / wavelength  # cycles per pixel
    diffraction = np.maximum(1 - frequency / cutoff[:, None], 0.0)
    wander = np.exp(-2 * (np.pi * scene.diffusion / sensor.pitch * frequency) ** 2)
    blur = np.concatenate([2 * j1(argument) / argument] * 2) * diffraction * wander
    blurred = irfft(rfft(points, length, axis=1) * blur, length, axis=1)[:, : fine.pixels]
    before, after = np.split(blurred.reshape(len(blurred), -1, FINE).sum(axis=2), 2)
    efficiency = float(sensor.response.quantum_efficiency(wavelength))
    photons = scene.emitter.power * scene.integration_time / photon_energy(wavelength)
    per_sr = efficiency * photons * scene.emitter.lobe.intensity(z / np.hypot(x, z))[:, None]
    return Spikes(
        np.maximum((before + after) / 2 * per_sr, 0.0),
        (after - before) / (2 * step[:, None]) * per_sr,
    )


def _mirrored(system: OpticalSystem) -> bool:
    """Whether the plane Y = 0 is one of symmetry."""
    places = (*system.placements, system.sensor_placement)
    return not any(place.decentre[1] or place.tilt[0] or place.tilt[2] for place in places)


def _meridional(
    system: OpticalSystem,
    x: NDArray[np.float64],
    z: NDArray[np.float64],
    sensor: LineSensor,
    wavelength: float,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Profiles (S, pixels) of points as `pixel_response` has them, nearly, and cones (S,).

    How much of the pupil's height lands on the pixels follows from one ray beside the plane Y = 0,
    which is a plane of symmetry; elsewhere in the pupil it is taken to be the same. A cone is the
    range of the sine of light on the sensor.
    """
    widest = int(np.argmin(x / z)), int(np.argmax(x / z))
    ends = [front_opening(system, (float(x[i]), 0.0, float(z[i]))) for i in widest]
    low, high = min(end[0] for end in ends), max(end[1] for end in ends)
    width = (high - low) / COLUMNS
    pupil = low + (np.arange(COLUMNS) + 0.5) * width
    beside = 0.02  # mm
    toward = np.stack(np.broadcast_arrays(pupil - x[:, None], beside, z[:, None]))
    start = np.stack(np.broadcast_arrays(x[:, None], 0.0, -z[:, None] + 0 * pupil))
    light = trace(
        system, start.reshape(3, -1), toward.reshape(3, -1), wavelength=wavelength, threads=1
    )
    shape = (len(x), COLUMNS)
    arrived = light.arrived.reshape(shape)
    height = np.where(arrived, np.abs(light.y.reshape(shape)), np.inf) / beside
    solid_angle = width * sensor.pixel_height * z[:, None] / (toward**2).sum(axis=0) ** 1.5
    share = light.transmission.reshape(shape) * solid_angle / height
    sine = np.where(arrived, light.direction[0].reshape(shape), np.nan)
    lit = arrived.any(axis=1)
    cone = np.zeros(len(x))
    cone[lit] = np.nanmax(sine[lit], axis=1) - np.nanmin(sine[lit], axis=1)
    at = np.where(arrived, light.x.reshape(shape), 0.0) / sensor.pitch + sensor.pixels / 2
    return _lay(at, share, arrived, sensor.pixels), cone


def _lay(
    at: NDArray[np.float64], share: NDArray[np.float64], arrived: NDArray[np.bool_], pixels: int
) -> NDArray[np.float64]:
    """Spread each column's light evenly to half-way to the neighbours' places, in pixels."""
    steps = np.diff(at, axis=1)
    joined = arrived[:, 1:] & arrived[:, :-1]
    none = np.zeros((len(at), 1), dtype=bool)
    left, right = np.pad(steps, ((0, 0), (1, 0))), np.pad(steps, ((0, 0), (0, 1)))
    has_left, has_right = np.hstack([none, joined]), np.hstack([joined, none])
    left = np.where(has_left, left, np.where(has_right, right, 0.0))
    right = np.where(has_right, right, left)
    ends = np.sort([at - left / 2, at + right / 2], axis=0)
    ends[1] = np.maximum(ends[1], ends[0] + 1e-3)
    density = np.where(arrived, share / (ends[1] - ends[0]), 0.0)
    # light up to a place is a sum of ramps that begin at one end and are undone at the other; its
    # differences from pixel to pixel are the charges
    begin = np.clip(np.hstack([ends[0], ends[1]]), -1.0, pixels + 1.0) + 2
    rise = np.hstack([density, -density])
    first = np.ceil(begin).astype(int)
    size = pixels + 5
    row = np.arange(len(at))[:, None] * size
    kwargs = {"minlength": len(at) * size}
    started = np.bincount((row + first).ravel(), (rise * (first - begin)).ravel(), **kwargs)
    going = np.bincount((row + first + 1).ravel(), rise.ravel(), **kwargs)
    charges = started.reshape(len(at), size) + np.cumsum(going.reshape(len(at), size), axis=1)
    return np.asarray(charges[:, 3 : 3 + pixels])


def led_bounds(
    system: OpticalSystem,
    scene: Scene,
    offset: ArrayLike,
    distance: ArrayLike,
    *,
    sensor: LineSensor = TCD1304,
    rays: tuple[int, int] | None = None,
    background: float | None = None,
) -> NDArray[np.float64]:
    """Cramér–Rao bound of the place of LEDs along X, 1 σ in mm, shape (S,).

    As `spike_bound`, with amplitude and background unknown, in mm at the LED. What the blur tells
    of the distance is left unused, which is little.

    Parameters
    ----------
    system, scene, offset, distance, sensor, rays
        As for `spikes`.
    background : float, optional
        Electrons of ambient light; computed when left out.
    """
    seen = spikes(system, scene, offset, distance, sensor=sensor, rays=rays)
    ambient = scene.background(system, sensor) if background is None else background
    room = max(scene.fill * scene.noise.saturation - ambient, 0.0)
    # part of the integration time that each LED is lit for
    lit = np.minimum(1.0, room / np.maximum(seen.electrons.max(axis=1, keepdims=True), 1e-9))
    return _spike_bounds(lit * seen.electrons, lit * seen.slope, scene.noise, ambient)


def _spike_bounds(
    electrons: NDArray[np.float64], slope: NDArray[np.float64], noise: Noise, background: float
) -> NDArray[np.float64]:
    """`spike_bound` of many at once, amplitude and background unknown, none saturated."""
    weight = 1 / noise.variance(electrons + background)
    total = weight.sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        # what is left of slope and spike without their weighted means, then of slope without spike
        slope = slope - ((weight * slope).sum(axis=1) / total)[:, None]
        spike = electrons - ((weight * electrons).sum(axis=1) / total)[:, None]
        along = (weight * slope * spike).sum(axis=1) / (weight * spike**2).sum(axis=1)
        slope -= np.where(np.isfinite(along), along, 0.0)[:, None] * spike
        bound = 1 / np.sqrt((weight * slope**2).sum(axis=1))
    return np.where(electrons.max(axis=1) > DARKNESS, bound, np.inf)


class PositionBounds(NamedTuple):
    """Cramér–Rao bounds of the tracker's place, 1 σ in mm; infinite where an LED is not seen.

    Attributes
    ----------
    x, y : ndarray
        Where the tracker is.
    sigma_x, sigma_y : ndarray
        Along the line of LEDs, and away from it.
    """

    x: NDArray[np.float64]
    y: NDArray[np.float64]
    sigma_x: NDArray[np.float64]
    sigma_y: NDArray[np.float64]

    @property
    def total(self) -> NDArray[np.float64]:
        """√(σ_x² + σ_y²)."""
        return np.hypot(self.sigma_x, self.sigma_y)

    @property
    def worst(self) -> float:
        """The largest `total`."""
        return float(self.total.max())


def position_bounds(
    system: OpticalSystem,
    scene: Scene,
    distance: float,
    *,
    sensor: LineSensor = TCD1304,
    rays: tuple[int, int] | None = None,
    angles: int = 31,
    background: float | None = None,
) -> PositionBounds:
    """Bounds for a tracker across the tracking area at one distance from the LEDs.

    Heading is known and 0. `led_bounds` is computed at equal steps of X, from the axis to both ends
    of the field, and its inverse interpolated in between.

    Parameters
    ----------
    system, scene, sensor, rays, background
        As for `led_bounds`.
    distance : float
        y of the tracker, mm.
    angles : int
        Number of steps on each side of the axis; on one side only if the system is symmetric, with
        nothing off its place.

    Returns
    -------
    PositionBounds
        At 2 `angles` − 1 places from one end of the tracking area to the other.
    """
    edge = check.positive("distance", distance) * math.tan(scene.field)
    half = check.whole("angles", angles)
    symmetric = not system.placements and not system.sensor_placement.decentre[0]
    symmetric = symmetric and not any(system.sensor_placement.tilt)
    offset = np.linspace(0.0 if symmetric else -edge, edge, half if symmetric else 2 * half - 1)
    bound = led_bounds(
        system,
        scene,
        offset,
        np.full(len(offset), distance),
        sensor=sensor,
        rays=rays,
        background=background,
    )
    side = scene.half_width(distance)
    x = np.linspace(-side, side, 2 * half - 1)
    room = np.stack([scene.leds, np.zeros(len(scene.leds))], axis=1)
    across, away = room_to_optical(room, x, distance)
    at = np.abs(across) if symmetric else across
    # information of the LEDs' places along X, 1/mm²
    information = np.interp(at, offset, 1 / bound) ** 2
    sigma_x, sigma_y = _known_heading(across / -away, information)
    return PositionBounds(x, np.full(len(x), float(distance)), sigma_x, sigma_y)


def _known_heading(
    tangent: NDArray[np.float64], information: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """σ_x and σ_y, shape (N,), from LEDs, shape (L, N), that see dX = −dx + tangent · dy.

    As `pose_bound` with known heading, for many places at once.
    """
    pairs = [(i, j) for i in range(len(tangent)) for j in range(i)]
    determinant = sum(
        (information[i] * information[j] * (tangent[i] - tangent[j]) ** 2 for i, j in pairs),
        start=np.zeros(tangent.shape[1]),
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        sigma = np.sqrt([(information * tangent**2).sum(0), information.sum(0)] / determinant)
    return tuple(np.where(determinant > 0, sigma, np.inf))


def worst_bounds(
    system: OpticalSystem,
    scene: Scene,
    *,
    sensor: LineSensor = TCD1304,
    rays: tuple[int, int] | None = None,
    angles: int = 31,
) -> tuple[float, ...]:
    """Largest `PositionBounds.total` at each of the scene's distances, mm.

    Parameters
    ----------
    system, scene, sensor, rays, angles
        As for `position_bounds`.
    """
    background = scene.background(system, sensor)
    return tuple(
        position_bounds(
            system, scene, y, sensor=sensor, rays=rays, angles=angles, background=background
        ).worst
        for y in scene.distances
    )


@dataclass(frozen=True)
class Layout:
    """What of a head is chosen from a list: lenses, their sides, where the slit is, collimator."""

    front: str
    back: str
    front_reversed: bool
    back_reversed: bool
    slit_place: SlitPlace
    collimator: bool

    def __post_init__(self) -> None:
        _require_known(self, "front", "back")

    def limits(self) -> NDArray[np.float64]:
        """Least and largest gap, slit, slit_distance and defocus, mm, shape (4, 2)."""
        # the concave lens has edges that stand 3.2 mm before its vertex
        nearest = 8.0 if self.collimator and self.slit_place == "before" else 0.0
        farthest = {"before": 30.0, "between": 14.0, "behind": 12.0}[self.slit_place]
        return np.array([(0.0, 14.0), (1.0, 20.0), (nearest, farthest), (-1.0, 6.0)])

    def head(self, numbers: ArrayLike, scene: Scene, sensor: LineSensor = TCD1304) -> Head:
        """Return the head with this gap, slit, slit_distance and defocus.

        Defocus is how far before the paraxial focus of the farthest LEDs the sensor stands, mm.
        For a slit between the lenses, slit_distance is the part of the gap times 14 mm.
        """
        gap, slit, slit_distance, defocus = np.asarray(numbers, dtype=float).tolist()
        if self.slit_place == "between":
            slit_distance *= gap / self.limits()[2, 1]
        concave, convex = ("LK1085L2", "LJ1328L2")
        head = Head(
            self.front,
            self.back,
            self.front_reversed,
            self.back_reversed,
            gap,
            40.0,
            slit,
            self.slit_place,
            slit_distance,
            self.collimator,
            concave,
            convex,
            sensor=sensor,
        )
        wavelength = scene.emitter.spectrum.mean
        first, second = head.lenses()
        pair = OpticalSystem("pair", (first, second), (gap,)).matrix("x", wavelength=wavelength)
        distance = max(scene.distances)
        focus = -(pair.A * distance + pair.B) / (pair.C * distance + pair.D)
        for plate in (PARTS[convex] if self.collimator else None, sensor.window):
            if plate is not None:
                focus += plate.thickness * (1 - 1 / plate.material.index(wavelength))
        return replace(head, pair_to_window=focus - (sensor.top_to_chip or 0.0) - defocus)


def layouts(scene: Scene, sensor: LineSensor = TCD1304) -> list[Layout]:
    """Every way to make a head of two of the 30 mm lenses that sees the whole field.

    Pairs are left out whose paraxial focal length, touching, is a tenth or more too long for that.
    """
    convex = [lens for lens in CATALOGUE.values() if lens.radius > 0 and lens.height == 30]
    longest = 1.1 * sensor.length / 2 / math.tan(scene.field)
    pairs = [
        (a.part, b.part)
        for a, b in product(convex, repeat=2)
        if 1 / (1 / a.focal_length() + 1 / b.focal_length()) < longest
    ]
    turned, places, with_collimator = (True, False), get_args(SlitPlace), (True, False)
    return [
        Layout(*pair, *rest)
        for pair, *rest in product(pairs, turned, turned, places, with_collimator)
    ]


class Candidate(NamedTuple):
    """A head and its bounds.

    Attributes
    ----------
    head : Head
    worst : tuple of float
        `worst_bounds`, mm.
    gain : float
        Smallest of the reference's bounds divided by these.
    """

    head: Head
    worst: tuple[float, ...]
    gain: float


def search(
    scene: Scene | None = None,
    *,
    choices: Iterable[Layout] | None = None,
    samples: int = 32,
    refine: int = 8,
    rounds: int = 20,
    seed: int = 0,
    sensor: LineSensor = TCD1304,
    executor: Executor | None = None,
) -> list[Candidate]:
    """Look for the head with the largest gain over the thesis's where that is least.

    Every layout is tried with `samples` sets of numbers that fill their limits evenly; the best
    layouts go through differential evolution, which begins with their samples, then through Nelder
    and Mead's simplex, and are rounded to 0.05 mm. Bounds are from the quick model of `spikes`;
    verify them with rays.

    Parameters
    ----------
    scene : Scene, optional
    choices : iterable of Layout, optional
        All of `layouts` when left out.
    samples, refine, rounds : int
        Sets of numbers per layout, 5 or more; layouts that are refined; generations of evolution.
    seed : int
    sensor : LineSensor
    executor : Executor, optional
        One of `concurrent.futures`, for the layouts; the result is the same.

    Returns
    -------
    list of Candidate
        The refined ones, best first.

    Raises
    ------
    ValueError
        If the thesis's head cannot locate in this scene, or none that was tried can.
    """
    scene = scene or Scene()
    for name, value in (("samples", samples), ("refine", refine), ("rounds", rounds)):
        check.whole(name, value)
    if samples < 5:
        raise ValueError(f"samples = {samples}: allowed is >= 5; evolution begins with them")
    reference = worst_bounds(Head(sensor=sensor).system(), scene, sensor=sensor, rays=RAYS)
    if not np.isfinite(reference).all():
        raise ValueError(
            f"the thesis's head, with which all are compared, has bounds of {reference} mm in this "
            f"scene; is it too bright (ambient = {scene.ambient:g} lx) or too wide "
            f"(field = {scene.field:g} rad)?"
        )
    distribute = executor.map if executor else map
    trials = [
        _Trial(choice, scene, sensor, reference, samples, rounds, seed)
        for choice in (layouts(scene, sensor) if choices is None else choices)
    ]
    screened = list(distribute(_screen, trials))
    order = sorted(range(len(trials)), key=lambda i: screened[i].costs[0])
    chosen = [i for i in order[:refine] if screened[i].costs[0] < HOPELESS]
    if not chosen:
        raise ValueError(
            f"none of {len(trials)} layouts with {samples} samples each can be built and sees the "
            "LEDs wherever the tracker may be"
        )
    found = distribute(_refine, [trials[i] for i in chosen], [screened[i] for i in chosen])
    return sorted(found, key=lambda candidate: -candidate.gain)


SCREENED_ANGLES, REFINED_ANGLES = 7, 15
"""Steps of the field in the search."""

POPULATION = 16
"""Of differential evolution, or the samples if they are fewer."""

HOPELESS = 1e3
"""Cost of what cannot be built or does not see."""


@dataclass(frozen=True)
class _Trial:
    """A layout and all that its search needs; goes to other processes."""

    layout: Layout
    scene: Scene
    sensor: LineSensor
    reference: tuple[float, ...]
    samples: int
    rounds: int
    seed: int

    def cost(self, numbers: NDArray[np.float64], angles: int, per_light: float) -> float:
        """Largest ratio of worst bounds to the reference's."""
        try:
            system = self.layout.head(numbers, self.scene, self.sensor).system()
        except ValueError:
            return HOPELESS
        background = per_light * self._light(system)
        ratios = [
            position_bounds(
                system, self.scene, y, sensor=self.sensor, angles=angles, background=background
            ).worst
            / known
            for y, known in zip(self.scene.distances, self.reference, strict=True)
        ]
        return min(max(ratios), HOPELESS)

    def per_light(self, system: OpticalSystem) -> float:
        """Background of a system in parts of `_light`: nearly the same for all slits."""
        light = self._light(system)
        return self.scene.background(system, self.sensor) / light if light else 0.0

    def _light(self, system: OpticalSystem) -> float:
        """Light of a far source on the axis over focal length: the étendue of a pixel's width."""
        far = np.array([max(self.scene.distances)])
        wavelength = self.scene.emitter.spectrum.mean
        light = _meridional(system, np.zeros(1), far, self.sensor, wavelength)[0].sum()
        return float(light / abs(system.effective_focal_length("x")))


class _Screened(NamedTuple):
    """Samples (n, 4), best first, their costs, and the factor from light to background."""

    numbers: NDArray[np.float64]
    costs: NDArray[np.float64]
    per_light: float


def _screen(trial: _Trial) -> _Screened:
    from scipy.stats import qmc  # type: ignore[import-untyped]  # slow to load

    limits = trial.layout.limits()
    power = (trial.samples - 1).bit_length()  # of 2, which is how many it wants to give
    cube = qmc.Sobol(len(limits), rng=trial.seed).random_base2(power)[: trial.samples]
    numbers = qmc.scale(cube, *limits.T)
    per_light = 0.0
    for sample in numbers:
        try:
            system = trial.layout.head(sample, trial.scene, trial.sensor).system()
        except ValueError:
            continue
        if per_light := trial.per_light(system):
            break
    costs = np.array([trial.cost(sample, SCREENED_ANGLES, per_light) for sample in numbers])
    order = np.argsort(costs, kind="stable")
    return _Screened(numbers[order], costs[order], per_light)


def _refine(trial: _Trial, screened: _Screened) -> Candidate:
    from scipy.optimize import (  # type: ignore[import-untyped]
        differential_evolution,
        minimize,
    )

    limits = trial.layout.limits()
    arguments = (REFINED_ANGLES, screened.per_light)
    evolved = differential_evolution(
        trial.cost,
        limits,
        args=arguments,
        init=screened.numbers[:POPULATION],
        maxiter=trial.rounds,
        rng=trial.seed,
        polish=False,
        tol=0.0,
    )
    # a simplex of some tenths of a millimetre
    start = evolved.x + np.vstack([np.zeros(4), 0.3 * np.eye(4)])
    best = minimize(
        trial.cost,
        evolved.x,
        args=arguments,
        method="Nelder-Mead",
        bounds=limits,
        options={
            "initial_simplex": np.clip(start, *limits.T),
            "maxfev": 5 * trial.rounds,
            "xatol": 0.02,
        },
    ).x
    found = trial.layout.head(best, trial.scene, trial.sensor)
    head = _rounded(found)
    try:
        system = head.system()
    except ValueError:  # what touched before now overlaps
        head, system = found, found.system()
    worst = worst_bounds(system, trial.scene, sensor=trial.sensor)
    gain = min(known / own for known, own in zip(trial.reference, worst, strict=True))
    return Candidate(head, worst, gain)


def _rounded(head: Head) -> Head:
    """Return the head with lengths in steps of 0.05 mm."""
    lengths = {
        name: round(round(getattr(head, name) / 0.05) * 0.05, 9)
        for name in ("gap", "slit", "slit_distance", "pair_to_window")
    }
    return replace(head, **lengths)


def main(arguments: Sequence[str] | None = None) -> int:
    """Search, print what was found, and write the best as a design if asked to."""
    parser = argparse.ArgumentParser(
        prog="python -m raytransfer.heads",
        description="Search the catalogue for the head that locates best. Takes minutes.",
    )
    parser.add_argument("--save", metavar="FILE.toml", help="write the best as a design")
    parser.add_argument("--samples", type=int, default=32, help="per layout (32)")
    parser.add_argument("--refine", type=int, default=8, help="layouts that are refined (8)")
    parser.add_argument("--rounds", type=int, default=20, help="of evolution (20)")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(arguments)
    if options.save and not (
        options.save.endswith(".toml") and Path(options.save).absolute().parent.is_dir()
    ):
        parser.error(f"--save {options.save}: a .toml file in a folder that exists is needed")
    scene = Scene()
    # spawned: numba's threads do not survive a fork
    with ProcessPoolExecutor(mp_context=multiprocessing.get_context("spawn")) as executor:
        found = search(
            scene,
            samples=options.samples,
            refine=options.refine,
            rounds=options.rounds,
            seed=options.seed,
            executor=executor,
        )
    lines = ["gain  worst bound (mm) at " + ", ".join(f"{y:g} mm" for y in scene.distances)]
    lines += [
        f"{gain:4.2f}  {', '.join(f'{bound:.4f}' for bound in worst)}  "
        + ", ".join(f"{f.name}={getattr(head, f.name)}" for f in fields(head) if f.name != "sensor")
        for head, worst, gain in found
    ]
    sys.stdout.write("\n".join(lines) + "\n")
    if options.save:
        best = found[0]
        bounds = ", ".join(
            f"{bound:.4f} at {y:g} mm" for bound, y in zip(best.worst, scene.distances, strict=True)
        )
        save_design(
            best.head.system(),
            options.save,
            sensor=best.head.sensor,
            notes=f"Found by python -m raytransfer.heads; worst-case bound in mm: {bounds}.",
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
