"""How good is a tracker? Resolution, accuracy, jitter, latency, consistency, from arrays.

Nothing here knows where its numbers come from: estimates and truths go in, statistics come out, in
the unit that went in. Chapter 5 of the thesis says what it means by each, and so does this module.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from raytransfer import _checks as check

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from numpy.typing import ArrayLike, NDArray


@dataclass(frozen=True)
class Jitter:
    """Scatter of a tracker at rest (thesis, section 5.4).

    Attributes
    ----------
    mean, sigma : float
        µ and σ, the latter with N − 1.
    count : int
        N.
    """

    mean: float
    sigma: float
    count: int


@dataclass(frozen=True)
class Errors:
    """Size of errors.

    Attributes
    ----------
    bias, rms, median, p95, worst : float
        Mean, root mean square; median, 95th percentile and largest of the absolute values.
    count : int
    """

    bias: float
    rms: float
    median: float
    p95: float
    worst: float
    count: int


class Slope(NamedTuple):
    """A straight line through measurements.

    Attributes
    ----------
    slope, sigma : float
        Pixels per mm, and its standard error.
    intercept : float
        Pixels at 0 mm.
    scatter : float
        Standard deviation of the measurements about the line, px.
    """

    slope: float
    sigma: float
    intercept: float
    scatter: float

    @property
    def resolution(self) -> float:
        """What one pixel is worth, mm."""
        return abs(1 / self.slope) if self.slope else np.inf


@dataclass(frozen=True)
class Latency:
    """How long it takes, in the unit of the samples.

    Attributes
    ----------
    median, p95, worst : float
    count : int
    """

    median: float
    p95: float
    worst: float
    count: int


def _samples(name: str, values: ArrayLike, least: int) -> NDArray[np.float64]:
    samples = check.array(name, values)
    if samples.ndim != 1 or len(samples) < least:
        raise ValueError(f"{name} has shape {samples.shape}: (N,) is needed, N {least} or more")
    return np.asarray(samples, dtype=float)


def jitter(samples: ArrayLike, reference: float = 0.0) -> Jitter:
    """Return mean and standard deviation of repeated measurements at rest.

    Parameters
    ----------
    samples : array_like, shape (N,)
        2 or more.
    reference : float
        Where 0 is: the mean is of the deviations from it.
    """
    values = _samples("samples", samples, 2)
    return Jitter(float(values.mean() - reference), float(values.std(ddof=1)), len(values))


def histogram(
    samples: ArrayLike, width: float | None = None
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return counts and edges of bins, one of them around 0.

    Parameters
    ----------
    samples : array_like, shape (N,)
    width : float, optional
        Of a bin. Values that come in steps need the step, or a multiple of it. Left out: that of
        Freedman and Diaconis, 2 × interquartile range / N^⅓.

    Returns
    -------
    counts : ndarray of int, shape (B,)
    edges : ndarray, shape (B + 1,)
    """
    values = _samples("samples", samples, 1)
    if width is None:
        low, high = np.percentile(values, [25, 75])
        width = float(2 * (high - low) / len(values) ** (1 / 3))
        if width == 0:
            width = float(np.ptp(values)) or 1.0
    check.positive("width", width, "of a bin")
    number = np.rint(values / width)
    edges = (np.arange(number.min(), number.max() + 2) - 0.5) * width
    counts, _ = np.histogram(values, edges)
    return counts, edges


def midpoint_error(start: ArrayLike, middle: ArrayLike, end: ArrayLike) -> NDArray[np.float64]:
    """Return the thesis's accuracy: what is measured halfway of a move, minus the ends' mean.

    It finds what bends the scale within the move, and the noise of three measurements; an error
    that all three share it cannot find.
    """
    first, between, last = (
        check.array(name, values)
        for name, values in (("start", start), ("middle", middle), ("end", end))
    )
    return np.asarray(between - (first + last) / 2)


def accuracy(estimates: ArrayLike, truths: ArrayLike) -> Errors:
    """Return the errors of estimates with known truth.

    Parameters
    ----------
    estimates, truths : array_like, shape (N,)
    """
    found, true = _samples("estimates", estimates, 1), _samples("truths", truths, 1)
    if len(found) != len(true):
        raise ValueError(f"{len(found)} estimates and {len(true)} truths: one each is needed")
    error = found - true
    size = np.abs(error)
    median, p95 = np.percentile(size, [50, 95]).tolist()
    rms = float(np.sqrt(np.mean(error**2)))
    return Errors(float(error.mean()), rms, median, p95, float(size.max()), len(size))


def resolution(places: ArrayLike, pixels: ArrayLike) -> Slope:
    """Fit a straight line: how many pixels a mm is.

    Parameters
    ----------
    places : array_like, shape (N,)
        True places, mm; 3 or more, not all the same.
    pixels : array_like, shape (N,)
    """
    x, u = _samples("places", places, 3), _samples("pixels", pixels, 3)
    if len(x) != len(u):
        raise ValueError(f"{len(x)} places and {len(u)} pixels: one each is needed")
    about = x - x.mean()
    spread = float(about @ about)
    if spread == 0:
        raise ValueError("places: all are the same; a slope needs a move")
    slope = float(about @ u) / spread
    intercept = float(u.mean() - slope * x.mean())
    residuals = u - intercept - slope * x
    scatter = float(np.sqrt(residuals @ residuals / (len(x) - 2)))
    return Slope(slope, scatter / float(np.sqrt(spread)), intercept, scatter)


def latency(samples: ArrayLike) -> Latency:
    """Summarise how long things took.

    Parameters
    ----------
    samples : array_like, shape (N,)
        Not negative.
    """
    values = _samples("samples", samples, 1)
    if (least := float(values.min())) < 0:
        raise ValueError(f"samples: {least:g} is negative; were start and end confused?")
    median, p95 = np.percentile(values, [50, 95]).tolist()
    return Latency(median, p95, float(values.max()), len(values))


def nees(errors: ArrayLike, covariances: ArrayLike) -> NDArray[np.float64]:
    """Return the normalised estimation error squared: d-dimensional χ² if covariances are honest.

    Parameters
    ----------
    errors : array_like, shape (N, d)
        Estimate minus truth; angles already wrapped.
    covariances : array_like, shape (N, d, d)

    Returns
    -------
    ndarray, shape (N,)

    References
    ----------
    Bar-Shalom, Li, Kirubarajan, Estimation with Applications to Tracking and Navigation, 5.4.
    """
    error, covariance = check.array("errors", errors), check.array("covariances", covariances)
    if error.ndim != 2 or covariance.shape != (*error.shape, error.shape[1]):
        raise ValueError(
            f"errors {error.shape} and covariances {covariance.shape}: (N, d) and (N, d, d) are "
            "needed"
        )
    weighted = np.linalg.solve(covariance, error[..., None])[..., 0]
    return np.asarray(np.einsum("ni,ni->n", error, weighted))


def nees_band(count: int, degrees: int, level: float = 0.95) -> tuple[float, float]:
    """Return the limits of the mean of `count` independent NEES values of d degrees of freedom.

    Parameters
    ----------
    count, degrees : int
        N and d, 1 or more.
    level : float
        Part of all means that lies between the limits.
    """
    from scipy.stats import chi2  # type: ignore[import-untyped]  # slow to load

    number = check.whole("count", count) * check.whole("degrees", degrees)
    if not 0 < level < 1:
        raise ValueError(f"level = {level:g}: allowed is > 0 to < 1; was it given in percent?")
    low, high = chi2.ppf([(1 - level) / 2, (1 + level) / 2], number) / count
    return float(low), float(high)


def plot_jitter(
    samples: ArrayLike,
    ax: Axes,
    *,
    unit: str = "mm",
    width: float | None = None,
    label: str = "",
) -> Axes:
    """Draw a histogram with µ and σ, as figures 5.3 and 5.4 of the thesis.

    Parameters
    ----------
    samples : array_like, shape (N,)
        Deviations.
    ax : Axes
    unit : str
    width : float, optional
        Of a bin, as for `histogram`.
    label : str
        Title: what is shown.
    """
    found = jitter(samples)
    counts, edges = histogram(samples, width)
    ax.stairs(counts, edges, fill=True, color="#0072B2", alpha=0.75)
    ax.axvline(found.mean, color="#D55E00", linewidth=1.4)
    ax.axvspan(
        found.mean - found.sigma,
        found.mean + found.sigma,
        color="#D55E00",
        alpha=0.15,
        linewidth=0,
        zorder=0,
    )
    ax.set(xlabel=f"deviation / {unit}", ylabel=f"samples (of {found.count})")
    figures = f"µ = {found.mean:.3g} {unit}, σ = {found.sigma:.3g} {unit}".replace("-", "−")
    ax.set_title(f"{label}\n{figures}".lstrip("\n"), fontsize=10)
    return ax
