"""What sends light: its spectrum, the directions it goes, its power and size."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Self

import numpy as np

from raytransfer import _checks as check

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

SHORTEST, LONGEST = 0.1, 20.0
"""Wavelengths outside are refused, µm: whoever gives them means nm."""


def check_wavelength(name: str, value: float) -> float:
    """Return the wavelength in µm, or refuse it."""
    check.positive(name, value, "wavelengths are in µm")
    if not SHORTEST <= value <= LONGEST:
        raise ValueError(
            f"{name} = {value:g} µm: allowed are {SHORTEST:g} to {LONGEST:g} µm; "
            "was it given in nm?"
        )
    return float(value)


def _numbers(name: str, values: tuple[float, ...]) -> tuple[float, ...]:
    if np.ndim(values) != 1:
        raise TypeError(f"{name}: a sequence of numbers is needed, not {values!r}")
    return tuple(check.number(name, value) for value in values)


@dataclass(frozen=True)
class Spectrum:
    """Power against wavelength, linear between the given points and 0 outside them.

    Parameters
    ----------
    wavelengths : tuple of float
        µm, rising. A single one is a spectral line.
    power : tuple of float
        Relative power per µm there, ≥ 0; only its shape counts.

    Raises
    ------
    ValueError
        If the wavelengths do not rise or are not in µm, or power is negative or 0 throughout.
    """

    wavelengths: tuple[float, ...]
    power: tuple[float, ...]

    def __post_init__(self) -> None:
        wavelengths = _numbers("wavelengths", self.wavelengths)
        power = _numbers("power", self.power)
        if len(wavelengths) != len(power) or not wavelengths:
            raise ValueError(
                f"a spectrum needs as many powers as wavelengths, 1 or more; not {len(power)} "
                f"and {len(wavelengths)}"
            )
        for wavelength in wavelengths:
            check_wavelength("a wavelength of the spectrum", wavelength)
        if any(b <= a for a, b in pairwise(wavelengths)):
            raise ValueError(f"wavelengths of a spectrum rise; {wavelengths} do not")
        for value in power:
            check.not_negative("power of the spectrum", value, "was a dark level subtracted?")
        if not any(power):
            raise ValueError("power of the spectrum = 0 at every wavelength: nothing is sent")
        object.__setattr__(self, "wavelengths", wavelengths)
        object.__setattr__(self, "power", power)

    @classmethod
    def line(cls, wavelength: float) -> Self:
        """Return all power at one wavelength, µm."""
        return cls((wavelength,), (1.0,))

    @classmethod
    def gaussian(cls, peak: float, fwhm: float) -> Self:
        """Return the bell curve of a single-colour LED.

        Parameters
        ----------
        peak, fwhm : float
            Its middle, and its full width at half the power, µm. The curve is cut off 1.5 widths
            from the middle, where 0.2 % of the peak is left.
        """
        check_wavelength("peak", peak)
        check.positive("fwhm", fwhm, "a width in µm; a single wavelength is Spectrum.line")
        if fwhm > peak / 2:
            raise ValueError(
                f"fwhm = {fwhm:g} µm: allowed is up to half of the peak's {peak:g} µm; "
                "was it given in nm?"
            )
        # 25 points a width: straight lines between them keep the area to 0.1 %
        steps = np.linspace(-1.5, 1.5, 76)
        power = np.exp(-4 * math.log(2) * steps**2)
        return cls(tuple((peak + fwhm * steps).tolist()), tuple(power.tolist()))

    @property
    def mean(self) -> float:
        """Mean wavelength, weighted with power, µm."""
        wavelengths, shares = self.samples(1)
        return float(wavelengths @ shares)

    def density(self, wavelength: ArrayLike) -> NDArray[np.float64]:
        """Return the share of the power per µm at wavelengths in µm; its integral is 1.

        Raises
        ------
        ValueError
            For a line, which has no density.
        """
        at = check.array("wavelength", wavelength)
        if len(self.wavelengths) == 1:
            raise ValueError(f"a line at {self.wavelengths[0]:g} µm has no power per µm")
        total = float(np.trapezoid(self.power, self.wavelengths))
        power = np.interp(at, self.wavelengths, self.power, left=0.0, right=0.0)
        return np.asarray(power / total)

    def samples(self, n: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Stand for the spectrum with n wavelengths of equal power.

        The spectrum is cut where each part has 1/n of the power, and a part becomes its mean
        wavelength: that of the whole is kept exactly, however small n is.

        Parameters
        ----------
        n : int
            How many.

        Returns
        -------
        wavelengths, shares : ndarray, shape (n,)
            µm, rising, and parts of the power, with the sum 1. A line is one wavelength: shape
            (1,), whatever n is.
        """
        check.whole("n", n)
        if len(self.wavelengths) == 1:
            return np.array(self.wavelengths), np.ones(1)
        x, p = np.array(self.wavelengths), np.array(self.power)
        width, rise = np.diff(x), np.diff(p)
        # power and first moment from the beginning to each point, per segment in closed form
        power = np.concatenate([[0.0], np.cumsum(width * (p[:-1] + p[1:]) / 2)])
        moment = width * (x[:-1] * (p[:-1] + p[1:]) / 2 + width * (p[:-1] + 2 * p[1:]) / 6)
        moment = np.concatenate([[0.0], np.cumsum(moment)])

        cuts = power[-1] * np.arange(1, n) / n
        at = np.searchsorted(power, cuts, side="right") - 1
        # how far into its segment a cut is: p t + rise t²/2 = what is missing, in units of width
        missing = (cuts - power[at]) / width[at]
        root = np.sqrt(np.maximum(p[at] ** 2 + 2 * rise[at] * missing, 0.0))
        t = np.divide(2 * missing, p[at] + root, out=np.zeros(n - 1), where=missing > 0)
        before = x[at] * t * (p[at] + rise[at] * t / 2)
        before += width[at] * t**2 * (p[at] / 2 + rise[at] * t / 3)
        edges = np.concatenate([[0.0], moment[at] + width[at] * before, moment[-1:]])
        return np.diff(edges) * n / power[-1], np.full(n, 1 / n)


@dataclass(frozen=True)
class Lobe:
    """Radiant intensity against the angle from the emitter's axis, the same all around it.

    Nothing is sent behind the emitter's plane. `Lobe()` is Lambertian.

    Parameters
    ----------
    angles : tuple of float
        rad from the axis, rising from 0 to π/2 at most; the intensity is linear between them
        and 0 beyond the last. None at all: Lambertian, cos θ.
    relative : tuple of float
        Intensity there, ≥ 0; only its shape counts.

    Raises
    ------
    ValueError
        If the angles do not rise from 0 or exceed π/2, or intensity is negative or 0 throughout.
    """

    angles: tuple[float, ...] = ()
    relative: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        angles = _numbers("angles", self.angles)
        relative = _numbers("relative", self.relative)
        if len(angles) != len(relative) or len(angles) == 1:
            raise ValueError(
                f"a lobe needs as many intensities as angles, 2 or more; not {len(relative)} "
                f"and {len(angles)}"
            )
        object.__setattr__(self, "angles", angles)
        object.__setattr__(self, "relative", relative)
        if not angles:
            return
        if angles[0] != 0 or any(b <= a for a, b in pairwise(angles)):
            raise ValueError(f"angles of a lobe rise from 0, its axis; {angles} do not")
        if angles[-1] > math.pi / 2 * (1 + 1e-9):
            raise ValueError(
                f"angles of a lobe = {angles[-1]:g}: allowed are 0 to π/2 rad; "
                "were they given in degrees?"
            )
        for value in relative:
            check.not_negative("relative intensity of a lobe", value)
        if not any(relative):
            raise ValueError("relative intensity of a lobe = 0 at every angle: nothing is sent")

    @classmethod
    def lambertian(cls) -> Self:
        """Return cos θ: a surface that looks equally bright from everywhere."""
        return cls()

    @classmethod
    def measured(cls, angles: ArrayLike, relative: ArrayLike) -> Self:
        """Return a lobe read from a data sheet's chart; angles in rad, from 0."""
        return cls(
            tuple(np.atleast_1d(check.array("angles", angles)).tolist()),
            tuple(np.atleast_1d(check.array("relative", relative)).tolist()),
        )

    def intensity(self, cosine: ArrayLike) -> NDArray[np.float64]:
        """Return the radiant intensity of an emitter of 1 W.

        Its integral over all directions is 1; a Lambertian emitter has cos θ / π.

        Parameters
        ----------
        cosine : array_like
            Cosine of the angle between direction and axis, −1 to 1.

        Returns
        -------
        ndarray
            W/sr per W, of the shape of the cosines; 0 where they are negative.
        """
        cosine = check.array("cosine", cosine, "the cosine of the angle from the axis")
        if cosine.size and np.abs(cosine).max() > 1 + 1e-9:
            raise ValueError(
                f"cosine = {cosine.flat[np.abs(cosine).argmax()]:g}: allowed are −1 to 1; was the "
                "angle given, or was the direction not normalised?"
            )
        if not self.angles:
            return np.asarray(np.maximum(cosine, 0.0) / math.pi)
        theta, relative = np.array(self.angles), np.array(self.relative)
        # ∫ (a + s θ) sin θ dθ = −(a + s θ) cos θ + s sin θ over each segment
        slope = np.diff(relative) / np.diff(theta)
        turned = -np.diff(relative * np.cos(theta)) + slope * np.diff(np.sin(theta))
        value = np.interp(np.arccos(np.clip(cosine, -1, 1)), theta, relative, right=0.0)
        return np.asarray(np.where(cosine >= 0, value, 0.0) / (2 * math.pi * turned.sum()))

    def table(self, n: int) -> NDArray[np.float64]:
        """Return the intensity at cosines 1 − u², u evenly from 0 to 1, shape (n,), W/sr per W.

        Near the axis u is the angle over √2: narrow lobes are as well resolved as wide ones.
        """
        if check.whole("n", n) < 2:
            raise ValueError(f"n = {n}: a table has 2 values or more")
        return self.intensity(1 - np.linspace(0.0, 1.0, n) ** 2)


RED = Spectrum.line(0.63)
"""A red LED's light, as one wavelength."""

LAMBERTIAN = Lobe.lambertian()
"""A bare LED's lobe, nearly."""


@dataclass(frozen=True)
class Emitter:
    """A light source, such as an LED.

    Parameters
    ----------
    power : float
        Radiant power, W, > 0.
    spectrum : Spectrum
    lobe : Lobe
    extent : float
        Diameter of the emitting disc, mm; 0 is a point.
    """

    power: float = 0.25
    spectrum: Spectrum = RED
    lobe: Lobe = LAMBERTIAN
    extent: float = 0.0

    def __post_init__(self) -> None:
        check.positive("power of the emitter", self.power, "the light in W, not the electricity")
        check.not_negative("extent of the emitter", self.extent, "a diameter in mm")
        for name, kind in (("spectrum", Spectrum), ("lobe", Lobe)):
            if not isinstance(value := getattr(self, name), kind):
                raise TypeError(f"{name} of the emitter = {value!r}: a {kind.__name__} is needed")
