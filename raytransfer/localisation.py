"""How well light can be located at best: Cramér–Rao bounds of a spike and of a tracker's pose.

A bound is the smallest standard deviation that any unbiased estimator can have: it judges a lens
before there is an estimator, and an estimator by how close it comes. Light that arrives is all
that counts here; vibration, a wrong calibration and an unflat field come on top.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np

from raytransfer import _checks as check
from raytransfer.sensors import TCD1304
from raytransfer.studies import room_to_optical

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

Nuisance = Literal["amplitude", "background", "gradient", "width"]
"""What else about a spike is unknown."""

_NUISANCES = get_args(Nuisance)

SATURATION_MARGIN = 3.0
"""Standard deviations that a pixel's expected charge must stay below saturation."""

_UNDETERMINED = 1e-9
"""Relative size below which information is rounding error."""


@dataclass(frozen=True)
class Noise:
    """What a pixel's reading scatters by: photons, read-out, quantisation.

    Parameters
    ----------
    full_well : float
        Charge at which a pixel saturates, e⁻.
    read_noise : float
        Standard deviation without light, e⁻.
    electrons_per_code : float
        Charge of one step of the analogue-to-digital converter, e⁻. A step adds a variance of
        1/12 step², which holds where the other noise is about a step or more.
    codes : int
        Number of the converter's codes.
    """

    full_well: float = 35_000.0
    read_noise: float = 60.0
    electrons_per_code: float = 47.0
    codes: int = 4096

    def __post_init__(self) -> None:
        check.positive("full_well", self.full_well)
        check.not_negative("read_noise", self.read_noise)
        check.positive("electrons_per_code", self.electrons_per_code)
        check.whole("codes", self.codes)
        if self.read_noise >= self.full_well:
            raise ValueError(
                f"read_noise = {self.read_noise:g} e⁻: allowed is below the full well of "
                f"{self.full_well:g} e⁻; are the two swapped?"
            )

    @property
    def saturation(self) -> float:
        """Charge above which readings do not rise, e⁻: the well's or the converter's end."""
        return min(self.full_well, self.codes * self.electrons_per_code)

    def variance(self, electrons: ArrayLike) -> NDArray[np.float64]:
        """Variance of the reading, e⁻², at an expected charge in e⁻, saturation left aside."""
        charge = _charge("electrons", electrons)
        return np.asarray(charge + self.read_noise**2 + self.electrons_per_code**2 / 12)

    def unsaturated(self, electrons: ArrayLike) -> NDArray[np.bool_]:
        """Whether a reading of this expected charge in e⁻ can be used.

        Pixels whose expected charge comes within `SATURATION_MARGIN` standard deviations of
        saturation count as saturated: some of their readings are cut off, which makes them biased.
        Below, one reading in 700 at most is cut off.
        """
        charge = _charge("electrons", electrons)
        margin = SATURATION_MARGIN * np.sqrt(self.variance(charge))
        return np.asarray(charge + margin < self.saturation)


def shift_derivative(electrons: ArrayLike) -> NDArray[np.float64]:
    """Change of each pixel's charge per pixel that the profile moves toward higher pixels.

    Derivative of a cubic spline through the charge accumulated up to the pixels' edges, so that
    what leaves one pixel enters the next. Of a Gaussian's pixel charges it gives the bound of
    `spike_bound` to 0.3 % down to an FWHM of 2.5 px and to 1 % at 2 px (central differences:
    11 and 17 %). A profile cut off in its flank
    is less certain there.

    Parameters
    ----------
    electrons : array_like, shape (N,)
        Charge per pixel, e⁻.

    Returns
    -------
    ndarray, shape (N,)
        e⁻ per px.
    """
    profile = check.array("electrons", electrons)
    if profile.ndim != 1 or not profile.size:
        raise ValueError(f"electrons has shape (N,), not {profile.shape}")
    from scipy.interpolate import CubicSpline  # type: ignore[import-untyped]  # slow to load

    accumulated = np.concatenate([[0.0], np.cumsum(profile)])
    edges = np.arange(accumulated.size)
    at_edges = CubicSpline(edges, accumulated)(edges, 1)
    return np.asarray(-np.diff(at_edges))


def spike_bound(
    electrons: ArrayLike,
    noise: Noise | None = None,
    *,
    background: ArrayLike = 0.0,
    nuisance: tuple[Nuisance, ...] = ("amplitude", "background"),
    derivative: ArrayLike | None = None,
) -> float:
    """Cramér–Rao bound of a spike's position, 1 σ in px, from one reading of the pixels given.

    The spike's shape is known; what `nuisance` names is estimated along with the position. Pixels
    are independent, each with the variance of `noise` at its own expected charge. That the variance
    too depends on position, the term ½ (∂ ln σ²)² of a normal distribution, is left out: counted
    photons do not have it, and with the default read noise it would change the bound by less than
    1e-4. Saturated pixels (`Noise.unsaturated`) are left out too; that a pixel is known to be full
    could say a little more.

    Parameters
    ----------
    electrons : array_like, shape (N,)
        Expected charge per pixel of the spike alone, e⁻.
    noise : Noise, optional
        `Noise()` when left out.
    background : array_like, optional
        Expected charge of everything else, e⁻: one number or shape (N,).
    nuisance : tuple of {"amplitude", "background", "gradient", "width"}
        Unknowns: scale of the spike, a charge common to all pixels, one that rises linearly along
        them, a stretch of the spike about its centre of gravity. The position of a skew spike of
        unknown width is thus that of its centre of gravity.
    derivative : array_like, shape (N,), optional
        Change of `electrons` per px of motion; `shift_derivative` when left out. Where the profile
        has detail finer than 2 px (a caustic's edge), give it, as the difference of two computed
        profiles over the shift between them: pixel charges alone no longer tell it.

    Returns
    -------
    float
        px; infinite where position cannot be told: no light, all of it saturated, or no
        difference to a change of the unknowns.

    Raises
    ------
    ValueError
        If a charge is negative, shapes differ, or an unknown is named that is none.
    """
    noise = Noise() if noise is None else noise
    spike = _charge("electrons", electrons)
    if spike.ndim != 1 or not spike.size:
        raise ValueError(f"electrons has shape (N,), not {spike.shape}")
    ambient = _charge("background", background)
    if ambient.shape not in {(), spike.shape}:
        raise ValueError(
            f"background is one number or has the shape {spike.shape} of electrons, "
            f"not {ambient.shape}"
        )
    if unknown := [name for name in nuisance if name not in _NUISANCES]:
        raise ValueError(
            f"nuisance has {unknown[0]!r}: allowed is a tuple of {', '.join(_NUISANCES)}"
        )
    if derivative is None:
        slope = shift_derivative(spike)
    else:
        slope = check.array("derivative", derivative)
        if slope.shape != spike.shape:
            raise ValueError(
                f"derivative has the shape {spike.shape} of electrons, not {slope.shape}"
            )
    total = spike + ambient
    weight = np.where(noise.unsaturated(total), 1 / np.sqrt(noise.variance(total)), 0.0)
    signal = weight * slope
    size = float(np.linalg.norm(signal))
    if size <= _UNDETERMINED * float(np.linalg.norm(weight * spike)):
        return math.inf
    pixel = np.arange(spike.size) - (spike.size - 1) / 2
    light = spike.sum()
    gravity = float(pixel @ spike / light) if light else 0.0
    shapes = {
        "amplitude": spike,
        "background": np.ones_like(spike),
        "gradient": pixel,
        "width": (pixel - gravity) * slope,
    }
    others = np.stack([weight * shapes[name] for name in dict.fromkeys(nuisance)] or [signal * 0])
    # what is left of the signal when the unknowns have explained what they can
    norms = np.linalg.norm(others, axis=1)
    others = others[norms > 0] / norms[norms > 0, None]
    _, strength, basis = np.linalg.svd(others, full_matrices=False)
    basis = basis[strength > _UNDETERMINED]
    rest = float(np.linalg.norm(signal - (signal @ basis.T) @ basis))
    return 1 / rest if rest > _UNDETERMINED * size else math.inf


@dataclass(frozen=True)
class PoseBound:
    """Smallest scatter of an estimated pose.

    Attributes
    ----------
    covariance : ndarray, shape (3, 3)
        Of x, y (mm) and heading (rad). The variance of what the measurements leave undetermined
        is infinite, as is its covariance with what hangs on it.
    """

    covariance: NDArray[np.float64]

    @property
    def sigma_x(self) -> float:
        """Standard deviation of x, mm."""
        return float(np.sqrt(self.covariance[0, 0]))

    @property
    def sigma_y(self) -> float:
        """Standard deviation of y, mm."""
        return math.sqrt(self.covariance[1, 1])

    @property
    def sigma_heading(self) -> float:
        """Standard deviation of the heading, rad."""
        return math.sqrt(self.covariance[2, 2])


def pose_bound(
    jacobian: ArrayLike, sigma: ArrayLike, *, sigma_heading: float = math.inf
) -> PoseBound:
    """Cramér–Rao bound of a tracker's pose from the spikes of LEDs at known places.

    Parameters
    ----------
    jacobian : array_like, shape (…, N, 3)
        Of one pose or many: change of each spike's position, px, with the tracker's x and y (per mm) and heading
        (per rad), as from `pinhole_jacobian` or from differences of traced positions.
    sigma : array_like
        Standard deviation of each spike's position, px, shape (N,), or one for all; independent.
        An LED at infinity (as `spike_bound` says of one that is not seen) tells nothing.
    sigma_heading : float
        What is known of the heading beforehand, rad: 0 if it is known, infinite if not.

    Returns
    -------
    PoseBound

    Raises
    ------
    ValueError
        If shapes do not match or a standard deviation is none.
    """
    rows = check.array("jacobian", jacobian)
    if rows.ndim < 2 or rows.shape[-1] != 3:
        raise ValueError(
            f"jacobian has shape (…, N, 3), one row per LED, not {rows.shape}; is it transposed?"
        )
    *poses, count, _ = rows.shape
    spread = np.asarray(sigma, dtype=float)
    if spread.shape not in {(), (count,)}:
        raise ValueError(
            f"sigma is one number or one per LED, shape ({count},), not {spread.shape}"
        )
    if not (spread > 0).all():
        wrong = spread[~(spread > 0)].flat[0]
        raise ValueError(f"sigma = {wrong}: allowed is > 0, infinite for an LED that is not seen")
    if not sigma_heading >= 0:
        raise ValueError(
            f"sigma_heading = {sigma_heading}: allowed is 0 (known) to infinity (unknown)"
        )
    rows = rows / np.broadcast_to(spread, count)[:, None]
    covariance = np.zeros((*poses, 3, 3))
    if sigma_heading == 0:
        covariance[..., :2, :2] = _inverse(rows[..., :2])
    else:
        known = np.broadcast_to([0.0, 0.0, 1 / sigma_heading], (*poses, 1, 3))
        covariance[:] = _inverse(np.concatenate([rows, known], axis=-2))
    return PoseBound(covariance)


def pinhole_jacobian(
    leds: ArrayLike,
    x: float,
    y: float,
    heading: float = 0.0,
    *,
    focal_length: float,
    pitch: float = TCD1304.pitch,
) -> NDArray[np.float64]:
    """Change of the images' positions with the pose of a camera without distortion.

    With (X, Z) from `studies.room_to_optical` the image stands at −f tan(angle) / pitch pixels from
    the axis, tan(angle) = X / −Z: inverted, as `studies.image_position` has it. A sensor mounted
    the other way round changes all signs and no bound.

    Parameters
    ----------
    leds : array_like, shape (N, 2)
        Room x and y, mm.
    x, y, heading : float
        Tracker, mm and rad.
    focal_length, pitch : float
        mm.

    Returns
    -------
    ndarray, shape (N, 3)
        px per mm, px per mm, px per rad.

    Raises
    ------
    ValueError
        If an LED is not in front of the tracker.
    """
    scale = check.positive("focal_length", focal_length) / check.positive("pitch", pitch)
    pose = check.number("x", x), check.number("y", y)
    offset, distance = room_to_optical(leds, *pose, heading)
    if (distance <= 0).any():
        raise ValueError(
            f"an LED is {-distance.min():g} mm behind a tracker at x = {x:g}, y = {y:g}, heading "
            f"{heading:g} rad: allowed are LEDs in front; was the heading given in degrees?"
        )
    tangent = offset / distance
    sin, cos = math.sin(heading), math.cos(heading)
    along_x = (cos + tangent * sin) / distance
    along_y = (sin - tangent * cos) / distance
    return np.asarray(-scale * np.stack([along_x, along_y, 1 + tangent**2], axis=1))


def _charge(name: str, electrons: ArrayLike) -> NDArray[np.float64]:
    """Return the charges as an array, or refuse negative ones."""
    charge = check.array(name, electrons)
    if charge.size and charge.min() < 0:
        raise ValueError(
            f"{name} = {charge.min():g} e⁻: allowed is >= 0; "
            "expected charge is needed, not a reading with its noise"
        )
    return charge


def _inverse(rows: NDArray[np.float64]) -> NDArray[Any]:
    """Inverse of rowsᵀ rows, with infinities where a direction is not determined."""
    size = rows.shape[-1]
    if (missing := size - rows.shape[-2]) > 0:
        rows = np.concatenate([rows, np.zeros((*rows.shape[:-2], missing, size))], axis=-2)
    norms = np.linalg.norm(rows, axis=-2, keepdims=True)
    norms[norms == 0] = 1
    _, strength, basis = np.linalg.svd(rows / norms, full_matrices=False)
    told = (strength > _UNDETERMINED * strength.max(axis=-1, keepdims=True))[..., None]
    known = np.where(told, basis, 0.0) / np.where(told, strength[..., None], 1.0)
    flat = np.where(told, 0.0, basis)
    free = np.swapaxes(flat, -1, -2) @ flat
    told_so = np.swapaxes(known, -1, -2) @ known
    inverse = np.where(np.abs(free) > _UNDETERMINED, np.copysign(np.inf, free), told_so)
    return np.asarray(inverse / (np.swapaxes(norms, -1, -2) * norms))
