"""Statistics, against closed forms and against distributions whose figures are known."""

from __future__ import annotations

import math

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.figure import Figure

from tracking.evaluation import (
    accuracy,
    histogram,
    jitter,
    latency,
    midpoint_error,
    nees,
    nees_band,
    plot_jitter,
    resolution,
)


def test_jitter_divides_by_one_less_than_the_samples() -> None:
    found = jitter([1.0, 2.0, 3.0, 6.0], reference=2.0)
    assert (found.mean, found.count) == (1.0, 4)
    assert found.sigma == pytest.approx(math.sqrt((4 + 1 + 0 + 9) / 3))


def test_jitter_of_many_normal_samples() -> None:
    found = jitter(np.random.default_rng(1).normal(0.05, 0.436, 93_000))
    assert found.mean == pytest.approx(0.05, abs=4 * 0.436 / math.sqrt(93_000))
    assert found.sigma == pytest.approx(0.436, rel=4 / math.sqrt(2 * 93_000))


@pytest.mark.parametrize("samples", [[1.0], [[1.0, 2.0]], [1.0, math.nan]])
def test_jitter_refuses(samples: list[float]) -> None:
    with pytest.raises(ValueError, match="samples"):
        jitter(samples)


def test_histogram_has_a_bin_around_zero_and_counts_everything() -> None:
    counts, edges = histogram([-0.4, -0.1, 0.0, 0.2, 1.1], width=0.5)
    assert edges == pytest.approx([-0.75, -0.25, 0.25, 0.75, 1.25])
    assert counts.tolist() == [1, 3, 0, 1]


def test_histogram_of_values_in_steps_gives_each_step_a_bin() -> None:
    steps = np.array([-1.0, -0.5, 0.0, 0.0, 0.5, 1.5])
    counts, edges = histogram(steps, width=0.5)
    assert counts.tolist() == [1, 1, 2, 1, 0, 1]
    assert len(edges) == 7


def test_histogram_width_of_freedman_and_diaconis() -> None:
    samples = np.arange(1000.0)
    counts, edges = histogram(samples)
    assert np.diff(edges) == pytest.approx(2 * 499.5 / 10)
    assert counts.sum() == 1000


def test_histogram_of_equal_values_is_one_bin() -> None:
    counts, _ = histogram([3.0, 3.0, 3.0])
    assert counts.tolist() == [3]


def test_midpoint_error_is_the_thesis_own_sum() -> None:
    # E4: 1536 px where the mean of the ends is 1541
    assert float(midpoint_error(1500, 1536, 1582)) == -5.0
    # a straight scale has none, a parabola its sagitta
    x = np.array([0.0, 50.0, 100.0])
    assert float(midpoint_error(*(3 + 2 * x))) == 0.0
    assert float(midpoint_error(*(0.01 * x**2))) == pytest.approx(-0.01 * 50**2)


def test_accuracy_by_hand() -> None:
    found = accuracy([1.0, 1.0, 4.0, 0.0], [0.0, 2.0, 1.0, 1.0])
    assert (found.bias, found.count, found.worst) == (0.5, 4, 3.0)
    assert found.rms == pytest.approx(math.sqrt((1 + 1 + 9 + 1) / 4))
    assert found.median == 1.0
    assert found.p95 == pytest.approx(1 + 0.85 * 2)


def test_accuracy_needs_pairs() -> None:
    with pytest.raises(ValueError, match="one each"):
        accuracy([1.0, 2.0], [1.0])


def test_resolution_of_a_line_and_its_standard_error() -> None:
    x = np.linspace(-500, 500, 21)
    exact = resolution(x, 1824 - 0.83 * x)
    assert exact.slope == pytest.approx(-0.83)
    assert exact.intercept == pytest.approx(1824)
    assert exact.resolution == pytest.approx(1 / 0.83)
    assert exact.scatter < 1e-9
    rng = np.random.default_rng(2)
    fits = [resolution(x, -0.83 * x + rng.normal(0, 10, 21)) for _ in range(4000)]
    slopes = [fit.slope for fit in fits]
    assert np.mean([fit.sigma**2 for fit in fits]) == pytest.approx(np.var(slopes), rel=0.1)
    assert np.mean([fit.scatter**2 for fit in fits]) == pytest.approx(100, rel=0.03)


def test_resolution_needs_a_move() -> None:
    with pytest.raises(ValueError, match="a move"):
        resolution([5.0, 5.0, 5.0], [1.0, 2.0, 3.0])


def test_latency() -> None:
    found = latency(np.arange(101.0))
    assert (found.median, found.p95, found.worst, found.count) == (50.0, 95.0, 100.0, 101)
    with pytest.raises(ValueError, match="negative"):
        latency([1.0, -0.1])


def test_nees_of_honest_covariances_is_chi_squared() -> None:
    rng = np.random.default_rng(3)
    root = rng.normal(size=(5000, 3, 3)) + 2 * np.eye(3)
    covariances = root @ root.swapaxes(1, 2)
    errors = (root @ rng.normal(size=(5000, 3, 1)))[..., 0]
    values = nees(errors, covariances)
    low, high = nees_band(5000, 3)
    assert low < values.mean() < high
    assert np.var(values) == pytest.approx(6, rel=0.15)  # χ² with 3 degrees: 2 d
    # errors that are larger than stated by a tenth are found out
    assert nees(1.1 * errors, covariances).mean() > high


def test_nees_by_hand() -> None:
    assert nees([[3.0, 4.0]], [[[9.0, 0.0], [0.0, 4.0]]]).tolist() == [5.0]


def test_nees_band_is_the_textbook_one() -> None:
    # Bar-Shalom, table 1.5.4-1: χ² with 100 degrees, 2.5 % and 97.5 %: 74.2 and 129.6
    assert nees_band(50, 2) == pytest.approx((74.22 / 50, 129.56 / 50), abs=1e-3)
    low, high = nees_band(1, 3, level=0.5)
    assert low < 3 < high
    with pytest.raises(ValueError, match="percent"):
        nees_band(50, 2, level=95)


@pytest.mark.parametrize(("errors", "covariances"), [((4, 3), (4, 2, 2)), ((4,), (4, 1, 1))])
def test_nees_refuses_shapes(errors: tuple[int, ...], covariances: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match="are needed"):
        nees(np.ones(errors), np.ones(covariances))


def test_plot_says_what_the_numbers_say() -> None:
    samples = np.random.default_rng(4).normal(0.05, 0.436, 93)
    ax = Figure().subplots()
    assert plot_jitter(samples, ax, width=0.2, label="x, at rest") is ax
    found = jitter(samples)
    title = ax.get_title(loc=mpl.rcParams["axes.titlelocation"]).replace("−", "-")
    assert f"µ = {found.mean:.3g} mm, σ = {found.sigma:.3g} mm" in title
    assert "x, at rest" in title
    (stairs,) = ax.patches[:1]
    assert stairs.get_data().values.sum() == 93  # type: ignore[attr-defined]
    assert "93" in ax.get_ylabel()
