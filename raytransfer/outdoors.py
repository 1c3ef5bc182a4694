"""How much daylight the head may see: sunlight, interference filters, what a pixel gathers of a scene.

The scene fills the field behind the LEDs: a matt surface of the given albedo under an illuminance
E_v in lux. Its radiance is L = ρ E_e / π (Lambert), E_e = E_v / K the irradiance of that light, K its
luminous efficacy. A pixel gathers

    electrons = t ∫ Σ L_λ T(λ, θ) η(λ) λ/(h c) G dλ,

the sum over the directions θ that reach it: G is their étendue in mm² sr, losses at surfaces included
(`pixel_view`), T a filter before the head, η electrons per photon, t the integration time. All
of it is proportional to lux and to time; `ambient_rate` is the one number that is left.

Left out: stray light within the mount, glare on dust, reflections between surfaces, fluorescence
of filters, and the sun itself in the field.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from raytransfer import _checks as check
from raytransfer._data import FOLDER, read
from raytransfer.irradiance import photon_energy
from raytransfer.localisation import Noise, Nuisance, spike_bound
from raytransfer.sensors import TCD1304, LineSensor
from raytransfer.sources import Spectrum, check_wavelength
from raytransfer.tracing import trace

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import ArrayLike, NDArray

    from raytransfer.systems import OpticalSystem

STEP = 0.25e-3
"""Integrals over wavelengths take steps of at most this, µm."""


def _table(entry: dict[str, Any], values: str) -> tuple[tuple[float, ...], tuple[float, ...]]:
    wavelengths = entry["first"] + entry["step"] * np.arange(len(entry[values]))
    return tuple(wavelengths.round(9).tolist()), tuple(map(float, entry[values]))


_DATA = read(FOLDER / "sunlight.toml")

SUNLIGHT = Spectrum(*_table(_DATA["global"], "irradiance"))
"""Sun and sky, ASTM G173-03 global tilt, 0.3 to 1.1 µm; its power is in W/m² per µm."""

DIRECT_SUNLIGHT = Spectrum(*_table(_DATA["direct"], "irradiance"))
"""The sun alone on a plane that faces it, ASTM G173-03 direct and circumsolar."""

_EYE = _table(_DATA["eye"], "relative")


def _mean(
    spectrum: Spectrum,
    function: Callable[[NDArray[np.float64]], NDArray[np.float64]],
    step: float = STEP,
) -> NDArray[np.float64]:
    """Mean over the spectrum's power of a function whose last axis is wavelength."""
    ends = spectrum.wavelengths[0], spectrum.wavelengths[-1]
    if ends[0] == ends[1]:
        return np.asarray(function(np.array(ends[:1]))[..., 0])
    steps = np.linspace(*ends, math.ceil((ends[1] - ends[0]) / step) + 1)
    wavelengths = np.union1d(steps, spectrum.wavelengths)
    values = spectrum.density(wavelengths) * function(wavelengths)
    return np.asarray(np.trapezoid(values, wavelengths))


def luminous_efficacy(spectrum: Spectrum) -> float:
    """Return lumens per watt: K = 683 ∫ V(λ) p(λ) dλ / ∫ p(λ) dλ, V the CIE's of 1924."""
    return float(
        _DATA["eye"]["efficacy"]
        * _mean(spectrum, lambda wavelength: np.interp(wavelength, *_EYE, left=0.0, right=0.0))
    )


def illuminance(spectrum: Spectrum) -> float:
    """Return the lux of an irradiance: a spectrum whose power is in W/m² per µm, such as `SUNLIGHT`."""
    return luminous_efficacy(spectrum) * float(np.trapezoid(spectrum.power, spectrum.wavelengths))


@dataclass(frozen=True)
class BandPass:
    """An interference filter, parallel light on it.

    T(λ, θ) = blocking + (peak − blocking) / (1 + ((λ − λ_c)/(width/2))^(2 cavities)) with
    λ_c(θ) = centre √(1 − (sin θ / n)²): light at an angle meets layers that seem thinner, so the
    band moves to blue. n is the effective index of the layers. That width and peak change with
    the angle, and that the two polarisations part, is left out: little below 30°.

    Parameters
    ----------
    centre, width : float
        Middle and full width at half the peak, for light that falls square on it, µm.
    peak, blocking : float
        Transmission in the middle, and far outside.
    effective_index : float
        1.4 to 2.4 as makers state it; higher moves less.
    cavities : int
        1 is a Fabry–Perot's Lorentzian; more make the top flatter and the edges steeper.

    Raises
    ------
    ValueError
        If a value is outside these meanings, or wavelengths are not in µm.

    References
    ----------
    H. A. Macleod, Thin-Film Optical Filters, on tilted narrowband filters.
    """

    centre: float
    width: float
    peak: float = 0.9
    blocking: float = 1e-4
    effective_index: float = 2.0
    cavities: int = 3

    def __post_init__(self) -> None:
        check_wavelength("centre of the filter", self.centre)
        check.positive("width of the filter", self.width, "a full width in µm")
        if self.width >= self.centre:
            raise ValueError(
                f"width of the filter = {self.width:g} µm: allowed is less than its centre, "
                f"{self.centre:g} µm; was it given in nm?"
            )
        if not 0 < check.number("peak of the filter", self.peak) <= 1:
            raise ValueError(
                f"peak of the filter = {self.peak:g}: allowed is > 0 to 1; was it given in percent?"
            )
        if not 0 <= check.number("blocking of the filter", self.blocking) < self.peak:
            raise ValueError(
                f"blocking of the filter = {self.blocking:g}: allowed is 0 to less than its peak, "
                f"{self.peak:g}; was the optical density given? 4 is 1e-4"
            )
        check.refractive_index("effective_index of the filter", self.effective_index)
        check.whole("cavities of the filter", self.cavities)

    def centre_at(self, angle: ArrayLike) -> NDArray[np.float64]:
        """Return the middle of the band in µm for light at angles (rad) from the filter's normal."""
        angle = _angle(angle)
        return np.asarray(self.centre * np.sqrt(1 - (np.sin(angle) / self.effective_index) ** 2))

    def transmission(self, wavelength: ArrayLike, angle: ArrayLike = 0.0) -> NDArray[np.float64]:
        """Return the part of the light that passes, at wavelengths (µm) and angles (rad).

        The two are broadcast against each other.
        """
        wavelength = check.positive_array("wavelength", wavelength, "wavelengths are in µm")
        away = (wavelength - self.centre_at(angle)) / (self.width / 2)
        # far outside the power overflows to infinity, and the band is 0 there
        with np.errstate(over="ignore"):
            band = 1 / (1 + away ** (2 * self.cavities))
        return np.asarray(self.blocking + (self.peak - self.blocking) * band)


def _angle(angle: ArrayLike) -> NDArray[np.float64]:
    angle = check.array("angle", angle)
    if angle.size and np.abs(angle).max() > math.pi / 2 * (1 + 1e-9):
        raise ValueError(
            f"angle = {np.abs(angle).max():g}: allowed are −π/2 to π/2 rad; was it given in degrees?"
        )
    return angle


def electrons_per_joule(
    spectrum: Spectrum,
    sensor: LineSensor = TCD1304,
    bandpass: BandPass | None = None,
    angle: ArrayLike = 0.0,
) -> NDArray[np.float64]:
    """Return the electrons that 1 J of this light, measured before the filter, leaves in a pixel.

    ∫ p(λ) T(λ, θ) η(λ) λ/(h c) dλ / ∫ p(λ) dλ.

    Parameters
    ----------
    spectrum : Spectrum
    sensor : LineSensor
        With a response.
    bandpass : BandPass, optional
        None is no filter.
    angle : array_like
        Of the light to the filter's normal, rad.

    Returns
    -------
    ndarray
        1/J, of the shape of the angles.
    """
    response = sensor.response
    if response is None:
        raise ValueError(f"{sensor.name}: its data file has no response, which is needed")
    angle = _angle(angle)

    def electrons(wavelength: NDArray[np.float64]) -> NDArray[np.float64]:
        efficiency = response.quantum_efficiency(wavelength) / photon_energy(wavelength)
        if bandpass is None:
            return np.broadcast_to(efficiency, (*angle.shape, *wavelength.shape))
        return efficiency * bandpass.transmission(wavelength, angle[..., None])

    step = STEP if bandpass is None else min(STEP, bandpass.width / 16)
    return _mean(spectrum, electrons, step)


@dataclass(frozen=True, eq=False)
class PixelView:
    """The light that can reach a pixel: rays traced backward from it, each with its étendue.

    Parameters
    ----------
    direction : ndarray, shape (3, N)
        Of the light before the head, with unit length, in the system's frame.
    etendue : ndarray, shape (N,)
        mm² sr; a ray's part of the pixel's area times projected solid angle times its transmission.
    """

    direction: NDArray[np.float64]
    etendue: NDArray[np.float64]

    @property
    def total(self) -> float:
        """Étendue of the pixel, mm² sr: times a radiance it is the power on it."""
        return float(self.etendue.sum())

    @property
    def angle(self) -> NDArray[np.float64]:
        """Angle of the light to the axis before the head, rad, shape (N,)."""
        return np.asarray(np.arccos(np.clip(self.direction[2], -1.0, 1.0)))


def pixel_view(
    system: OpticalSystem,
    pixel: float,
    sensor: LineSensor = TCD1304,
    *,
    wavelength: float = 0.63,
    rays: int = 60_000,
) -> PixelView:
    """Look out of a pixel: trace backward what can reach it.

    Light that can go one way can go the other, and loses as much. Rays start all over the pixel,
    evenly in their direction cosines l and m: because cos θ dΩ = dl dm, each stands for the same
    étendue before losses.

    Parameters
    ----------
    system : OpticalSystem
        With a sensor_distance, elements in their places; the sensor may be off its own.
    pixel : float
        Number from 0.
    sensor : LineSensor
    wavelength : float
        µm.
    rays : int
        60,000 leave about 0.2 %.

    Raises
    ------
    ValueError
        If there is no such pixel, or the system has no sensor or cannot be turned.
    """
    if system.sensor_distance is None:
        raise ValueError(f"{system.name}: sensor_distance is needed to look out of a pixel")
    if not -0.5 <= check.number("pixel", pixel) <= sensor.pixels - 0.5:
        raise ValueError(f"pixel = {pixel:g}: {sensor.name} has 0 to {sensor.pixels - 1}")
    check.whole("rays", rays)
    # where the light goes behind the front does not matter, only its direction there
    back = replace(system.turned(), sensor_distance=1000.0)
    rotation, origin = system.places()[-1]
    middle = np.array([float(sensor.position(pixel)), 0.0, 0.0])
    size = np.array([sensor.pitch, sensor.pixel_height, 0.0])

    low, high = np.full(2, -1.0), np.full(2, 1.0)
    # two looks with few rays find the directions that can arrive at all
    for count in (10_000, 10_000, rays):
        points = _even(count, 4)
        cosines = low[:, None] + (high - low)[:, None] * points[:2]
        square = (cosines**2).sum(axis=0)
        use = square < 1
        cosines, square, points = cosines[:, use], square[use], points[:, use]
        on_pixel = np.concatenate([points[2:] - 0.5, np.zeros((1, use.sum()))])
        start = rotation @ (middle[:, None] + size[:, None] * on_pixel) + origin[:, None]
        toward = rotation @ np.concatenate([cosines, -np.sqrt(1 - square)[None]])
        # as `turned`: about Y, from the last vertex on
        start = _TURN * (start - [[0.0], [0.0], [system.length]])
        toward = _TURN * toward
        ahead = toward[2] > 0  # all, unless the sensor is tilted
        light = trace(back, start[:, ahead], toward[:, ahead], wavelength=wavelength)
        arrived = light.arrived
        if not arrived.any():
            return PixelView(np.zeros((3, 0)), np.zeros(0))
        each = float(np.prod(high - low)) / count * sensor.pitch * sensor.pixel_height
        found = cosines[:, ahead][:, arrived]
        margin = 0.02 * (high - low)
        low = np.maximum(found.min(axis=1) - margin, -1.0)
        high = np.minimum(found.max(axis=1) + margin, 1.0)
    # the light comes against the ray
    direction = -_TURN * light.direction[:, arrived]
    return PixelView(direction, light.transmission[arrived] * each)


_TURN = np.array([[-1.0], [1.0], [-1.0]])


def _even(count: int, dimensions: int) -> NDArray[np.float64]:
    """Points that fill the unit cube evenly, shape (dimensions, count).

    Additive recurrence with powers of the root of g^(d+1) = g + 1 (M. Roberts, 2018).
    """
    g = 2.0
    for _ in range(50):
        g = (1 + g) ** (1 / (dimensions + 1))
    steps = g ** -np.arange(1.0, dimensions + 1)
    return np.asarray((0.5 + np.outer(steps, np.arange(1, count + 1))) % 1)


def pixel_etendue(
    system: OpticalSystem,
    pixel: float,
    sensor: LineSensor = TCD1304,
    *,
    wavelength: float = 0.63,
    rays: int = 60_000,
) -> float:
    """Return the étendue of a pixel through the head in mm² sr; see `pixel_view`."""
    return pixel_view(system, pixel, sensor, wavelength=wavelength, rays=rays).total


def ambient_rate(
    view: PixelView,
    *,
    albedo: float = 0.2,
    spectrum: Spectrum = SUNLIGHT,
    sensor: LineSensor = TCD1304,
    bandpass: BandPass | None = None,
) -> float:
    """Return the electrons that a lit scene leaves in a pixel, per lux and second.

    Parameters
    ----------
    view : PixelView
        Of that pixel of that sensor.
    albedo : float
        Part of the light that the scene sends back, the same at all wavelengths. Soil and asphalt
        0.1 to 0.2, concrete 0.3 to 0.5, fresh snow 0.8 to 0.9.
    spectrum : Spectrum
        Of what lights the scene.
    sensor : LineSensor
    bandpass : BandPass, optional
        A filter square to the axis before the head, where every direction is still one angle.

    Returns
    -------
    float
        1/(lx s).
    """
    if not 0 < check.number("albedo", albedo) <= 1:
        raise ValueError(f"albedo = {albedo:g}: allowed is > 0 to 1; was it given in percent?")
    # the filter is smooth in the angle: half a degree is fine enough
    angles = np.linspace(0, math.pi / 2, 181)
    electrons = electrons_per_joule(spectrum, sensor, bandpass, angles)
    gathered = view.etendue @ np.interp(view.angle, angles, electrons)
    radiance = albedo / (math.pi * luminous_efficacy(spectrum)) * 1e-6  # W/(mm² sr) per lx
    return float(radiance * gathered)


def saturation_ambient(
    rate: float, integration_time: float, *, signal: float = 0.0, noise: Noise | None = None
) -> float:
    """Return the illuminance in lux at which a pixel is full: (full well − signal) / (rate t).

    Parameters
    ----------
    rate : float
        Of `ambient_rate`.
    integration_time : float
        s. Without the electronic shutter the sensor gathers light from one read-out to the next
        (the ICG period), with it from one SH pulse to the next, however briefly the LED is lit.
    signal : float
        Electrons of the LED in that pixel.
    noise : Noise, optional
        For its full well; `Noise()` when left out.
    """
    _per_lux(rate, integration_time)
    room = (noise or Noise()).saturation - check.not_negative("signal", signal)
    return max(room, 0.0) / (rate * integration_time)


@dataclass(frozen=True)
class _Difference(Noise):
    """Noise of a frame less an unlit one of the same scene."""

    unlit: float = 0.0

    def variance(self, electrons: ArrayLike) -> NDArray[np.float64]:
        return super().variance(electrons) + super().variance(self.unlit)

    def unsaturated(self, electrons: ArrayLike) -> NDArray[np.bool_]:
        # frames are cut off before they are subtracted, and the lit one sooner
        frame = Noise(self.full_well, self.read_noise, self.electrons_per_code, self.codes)
        return frame.unsaturated(electrons)


def ambient_bound(
    electrons: ArrayLike,
    background: float,
    *,
    noise: Noise | None = None,
    subtracted: bool = False,
    nuisance: tuple[Nuisance, ...] = ("amplitude", "background"),
) -> float:
    """Return the `spike_bound` of a spike on an even scene, 1 σ in px.

    Parameters
    ----------
    electrons : array_like, shape (N,)
        Expected charge per pixel of the LED alone.
    background : float
        Expected charge that the scene leaves in each pixel.
    noise : Noise, optional
        Of one frame.
    subtracted : bool
        An unlit frame is subtracted, which adds the noise of its scene, read-out and quantisation.
        Which pixels are full is decided before, in each frame.
    nuisance : tuple of str
        As for `spike_bound`. A scene that was subtracted need not be estimated.

    Returns
    -------
    float
        px; infinite where the position cannot be told.
    """
    noise = noise or Noise()
    if subtracted:
        noise = _Difference(
            noise.full_well, noise.read_noise, noise.electrons_per_code, noise.codes, background
        )
    return spike_bound(electrons, noise, background=background, nuisance=nuisance)


def largest_ambient(
    electrons: ArrayLike,
    wanted: float,
    rate: float,
    integration_time: float,
    *,
    noise: Noise | None = None,
    subtracted: bool = False,
    nuisance: tuple[Nuisance, ...] = ("amplitude", "background"),
) -> float:
    """Return the illuminance in lux up to which a spike can be located as well as wanted.

    There the `ambient_bound` is `wanted`: the scene's light scatters, and pixels that it helps to
    fill are lost.

    Parameters
    ----------
    electrons : array_like, shape (N,)
        Expected charge per pixel of the LED alone.
    wanted : float
        Largest allowed standard deviation, px.
    rate, integration_time : float
        As for `saturation_ambient`; the rate is taken as that of all the pixels.
    noise, subtracted, nuisance
        As for `ambient_bound`.

    Returns
    -------
    float
        0 if not even darkness is dark enough; infinite never, because pixels fill.
    """
    _per_lux(rate, integration_time)
    check.positive("wanted", wanted, "a standard deviation in px")
    noise = noise or Noise()

    def bound(background: float) -> float:
        return ambient_bound(
            electrons, background, noise=noise, subtracted=subtracted, nuisance=nuisance
        )

    low, high = 0.0, noise.saturation
    if bound(low) > wanted:
        return 0.0
    while high - low > 1e-4 * noise.saturation:
        middle = (low + high) / 2
        low, high = (middle, high) if bound(middle) <= wanted else (low, middle)
    return low / (rate * integration_time)


def subtraction_cost(
    signal: ArrayLike, background: ArrayLike, noise: Noise | None = None
) -> NDArray[np.float64]:
    """Return by how much a pixel's noise grows when an unlit frame is subtracted.

    √(1 + V(B) / V(S + B)) with V the variance of a reading: from little more than 1 (a bright LED
    in the dark) to √2 (all of it scene or read noise). The rate is halved as well, and what moves
    between the two frames stays.

    Parameters
    ----------
    signal, background : array_like
        Electrons of LED (S) and scene (B), broadcast against each other.
    noise : Noise, optional
    """
    noise = noise or Noise()
    lit = np.add(*(check.array(n, v) for n, v in (("signal", signal), ("background", background))))
    return np.asarray(np.sqrt(1 + noise.variance(background) / noise.variance(lit)))


def _per_lux(rate: float, integration_time: float) -> None:
    check.positive("rate", rate, "electrons per lux and second")
    check.positive("integration_time", integration_time, "in s")
