"""Bounds of spike and pose: closed forms, estimators on simulated readings, refusals."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import erf  # type: ignore[import-untyped]
from scipy.stats import norm, poisson  # type: ignore[import-untyped]

from raytransfer import TCD1304
from raytransfer.localisation import (
    Noise,
    Nuisance,
    pinhole_jacobian,
    pose_bound,
    shift_derivative,
    spike_bound,
)
from raytransfer.studies import room_to_optical

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    Array = NDArray[np.float64]

NOISE = Noise()
NONE: tuple[Nuisance, ...] = ()
FIVE: tuple[Nuisance, ...] = ("amplitude", "background", "gradient", "width")
"""With the position, the five parameters of a spike on a sloping background."""

NO_NUISANCE: Any = ("amplitude", "skew")
NO_TUPLE: Any = "width"

SIGMA = 1 / math.sqrt(8 * math.log(2))
"""Standard deviation of a Gaussian of FWHM 1."""


def gaussian(
    fwhm: float, centre: Any, pixels: int, peak: float = 24_500.0
) -> tuple[Array, Array, Array]:
    """Pixel charges of a Gaussian, and their derivatives for its centre and its log width."""
    s = fwhm * SIGMA
    edges = (np.arange(pixels + 1) - 0.5 - np.asarray(centre)[..., None]) / s
    bell = peak * np.exp(-(edges**2) / 2)
    charge = np.diff(peak * s * math.sqrt(math.pi / 2) * erf(edges / math.sqrt(2)))
    return charge, -np.diff(bell), charge - np.diff(edges * s * bell)


# the spike --------------------------------------------------------------------------------------


@pytest.mark.parametrize(("fwhm", "known"), [(6, 0.0095), (20, 0.017), (64, 0.031), (200, 0.056)])
@pytest.mark.parametrize("centre", [1823.5, 1823.17, 900.0])
def test_smooth_spikes_have_the_known_bounds(fwhm: float, known: float, centre: float) -> None:
    """An independent simulation's bounds at 0.7 of full well, whose spike it calls just smooth.

    A Gaussian in the dark stays 10 to 14 % below them; on ambient light of 0.1 of full well it
    explains all four, with the position alone unknown as with five parameters: of a symmetric
    spike on a long line the others do not correlate with position. Other smooth shapes do as well
    in the dark, a squared Lorentzian within 2.3 %, so the ambient light is the simplest reading of
    a set of numbers, not a finding.
    """
    light, _, _ = gaussian(fwhm, centre, TCD1304.pixels, 0.7 * NOISE.full_well)
    ambient = 0.1 * NOISE.full_well
    assert spike_bound(light, background=ambient, nuisance=FIVE) == pytest.approx(known, rel=0.03)
    assert spike_bound(light, background=ambient) == pytest.approx(known, rel=0.03)
    in_the_dark = spike_bound(light)
    assert 0.85 * known < in_the_dark < 0.91 * known

    tails = np.arange(TCD1304.pixels) - centre
    scale = 2 * math.sqrt(math.sqrt(2) - 1) / fwhm
    squared_lorentzian = 24_500 / (1 + (scale * tails) ** 2) ** 2
    assert spike_bound(squared_lorentzian) == pytest.approx(known, rel=0.03)


def test_photons_alone_give_width_over_root_of_their_number() -> None:
    """The pixel's own width adds its variance, 1/12 px²."""
    light, _, _ = gaussian(20, 200.3, 401)
    photons = Noise(read_noise=0.0, electrons_per_code=1e-6, codes=10**12)
    expected = math.hypot(20 * SIGMA, math.sqrt(1 / 12)) / math.sqrt(light.sum())
    for nuisance in (NONE, ("amplitude",), FIVE[:2]):
        assert spike_bound(light, photons, nuisance=nuisance) == pytest.approx(expected, rel=1e-3)


def test_read_noise_alone_gives_the_energy_of_the_slope() -> None:
    """Of a·exp(−x²/2s²) it is a² √π / 2s."""
    s, peak, noise = 20 * SIGMA, 1.0, Noise(electrons_per_code=1e-6, codes=10**12)
    light, _, _ = gaussian(20, 200.3, 401, peak)
    expected = 60 / peak * math.sqrt(2 * s / math.sqrt(math.pi))
    assert spike_bound(light, noise) == pytest.approx(expected, rel=1.5e-3)
    assert spike_bound(light * 3, noise) == pytest.approx(expected / 3, rel=1.5e-3)


def test_quantisation_adds_a_twelfth_of_a_step_squared() -> None:
    assert NOISE.variance(1000.0) == pytest.approx(1000 + 60**2 + 47**2 / 12, rel=1e-15)
    coarse = Noise(read_noise=0.0, electrons_per_code=60 * math.sqrt(12))
    fine = Noise(electrons_per_code=1e-6, codes=10**12)
    light, _, _ = gaussian(6, 30.2, 61, 3000)
    assert spike_bound(light, coarse) == pytest.approx(spike_bound(light, fine), rel=1e-9)


@pytest.mark.parametrize("mean", [0.0, 30.0, 1000.0])
def test_a_pixel_tells_what_its_variance_says(mean: float) -> None:
    """Exact Fisher information of photons plus read noise: no ½(∂ln σ²)² is missed."""
    reading, step = np.linspace(mean - 700, mean + 700, 5601, retstep=True)
    # photons have the variance of their mean; ∂P(k)/∂mean = P(k − 1) − P(k)
    k = np.arange(math.ceil(mean + 12 * math.sqrt(mean)) + 4)
    if mean:
        density = norm.pdf(reading[:, None], k, 60.0)
        here, before = poisson.pmf(k, mean), poisson.pmf(k - 1, mean)
        p, slope = density @ here, density @ (before - here)
    else:
        p = norm.pdf(reading, 0.0, 60.0)
        slope = norm.pdf(reading, 1.0, 60.0) - p
    information = np.sum(slope**2 / p) * step
    assert information * (mean + 60**2) == pytest.approx(1.0, abs=2e-4)


@settings(deadline=None, max_examples=40)
@given(st.floats(0, 1), st.sampled_from([3.0, 6.0, 20.0]), st.integers(0, 30))
def test_where_on_the_line_a_spike_stands_does_not_matter(
    shift: float, fwhm: float, whole: int
) -> None:
    at_rest = spike_bound(gaussian(fwhm, 90.0, 241)[0], background=800.0)
    moved = gaussian(fwhm, 90.0 + shift + whole, 241)[0]
    assert spike_bound(moved, background=800.0) == pytest.approx(at_rest, rel=5e-3)
    assert spike_bound(moved[::-1], background=800.0) == pytest.approx(
        spike_bound(moved, background=800.0), rel=1e-9
    )


@pytest.mark.parametrize(("fwhm", "close"), [(2, 1e-2), (2.5, 3e-3), (3, 2e-3), (6, 2e-4)])
def test_derivative_of_narrow_spikes(fwhm: float, close: float) -> None:
    for centre in np.linspace(30, 30.9, 10):
        light, exact, _ = gaussian(fwhm, centre, 61)
        given = spike_bound(light, derivative=exact)
        assert spike_bound(light) == pytest.approx(given, rel=close)
        assert abs(spike_bound(light, derivative=-np.gradient(light)) / given - 1) > 5 * close


def test_derivative_keeps_the_charge_and_is_exact_for_parabolas() -> None:
    light, _, _ = gaussian(2.2, 30.3, 61)
    assert shift_derivative(light).sum() == pytest.approx(0.0, abs=1e-9 * light.sum())
    edges = np.arange(201) - 100.0
    parabola = np.diff(edges**3 / 3)
    assert shift_derivative(parabola) == pytest.approx(-np.diff(edges**2), rel=1e-9, abs=1e-8)
    assert shift_derivative([5.0]) == pytest.approx([0.0])


def test_finer_detail_than_pixels_needs_the_derivative_given() -> None:
    """Two caustic edges of 0.3 px: pixel charges mislead by a tenth and more, differences do not."""
    fine = np.arange(-60.0, 60.0, 1 / 512) + 1 / 1024
    blur = norm.pdf(fine[np.abs(fine) < 3], 0, 0.3) / 512
    inside = np.clip(1 - (fine / 35) ** 2, 1e-3, None) ** -0.5 * (np.abs(fine) < 35)
    density = np.convolve(inside, blur, mode="same")
    accumulated = np.concatenate([[0.0], np.cumsum(density)]) / 512
    grid = np.arange(fine.size + 1) / 512 - 60

    def pixels(shift: float) -> Array:
        return 1000 * np.diff(np.interp(np.arange(-50.5, 51) - shift, grid, accumulated))

    def bounds(h: float) -> tuple[float, float]:
        light = pixels(0.2)
        slope = (pixels(0.2 + h) - pixels(0.2 - h)) / (2 * h)
        return spike_bound(light), spike_bound(light, derivative=slope)

    guessed, exact = bounds(0.02)
    assert exact == pytest.approx(bounds(0.01)[1], rel=5e-3)
    assert abs(guessed / exact - 1) > 0.1


def skew_profile(shift: float, stretch: float, pivot: float) -> Array:
    """Two overlapping Gaussians, stretched about a point."""
    first, second = pivot + shift + stretch * (np.array([60.0, 72.4]) - pivot)
    wide = gaussian(20 * stretch, second, 141, 6_000)[0]
    return np.asarray(gaussian(9 * stretch, first, 141, 20_000)[0] + wide)


@pytest.mark.parametrize(
    "nuisance", [(), ("amplitude",), ("background", "gradient"), ("width",), FIVE]
)
def test_unknowns_of_a_skew_spike_cost_what_the_full_matrix_says(
    nuisance: tuple[Nuisance, ...],
) -> None:
    """Against the inverse of the Fisher matrix, derivatives by differences of the profile."""
    light = skew_profile(0.0, 1.0, 64.0)
    pivot = float(np.arange(141) @ light / light.sum())
    ambient = 500 + 3.0 * np.arange(141)
    h = 1e-3
    slopes = {
        "amplitude": light,
        "background": np.ones(141),
        "gradient": np.arange(141.0),
        "width": (skew_profile(0, 1 + h, pivot) - skew_profile(0, 1 - h, pivot)) / (2 * h),
    }
    motion = (skew_profile(h, 1, pivot) - skew_profile(-h, 1, pivot)) / (2 * h)
    columns = np.stack([motion, *(slopes[name] for name in nuisance)])
    information = (columns / (light + ambient + 60**2 + 47**2 / 12)) @ columns.T
    scale = np.sqrt(np.diag(information))
    inverse = np.linalg.inv(information / np.outer(scale, scale))
    expected = math.sqrt(inverse[0, 0]) / scale[0]
    bound = spike_bound(light, background=ambient, nuisance=nuisance)
    assert bound == pytest.approx(expected, rel=2e-3)


def test_every_unknown_costs_and_skewness_makes_it_dear() -> None:
    light = skew_profile(0.0, 1.0, 64.0)
    costs = [spike_bound(light, nuisance=FIVE[:n]) for n in range(5)]
    assert costs == sorted(costs)
    assert costs[-1] > 1.05 * costs[0]
    assert spike_bound(light, nuisance=FIVE[::-1]) == pytest.approx(costs[-1], rel=1e-9)
    assert spike_bound(light, background=5000.0) > 1.05 * spike_bound(light)


def scatter_of_maximum_likelihood(
    fwhm: float, peak: float, ambient: float, pixels: int, trials: int
) -> tuple[float, float, float]:
    """Bias and scatter of a five-parameter fit to simulated readings, and the bound, px."""
    random = np.random.default_rng(20_240_607)
    truth = pixels / 2 + 0.17
    light = gaussian(fwhm, truth, pixels, peak)[0]
    charge = random.poisson(light + ambient, (trials, pixels)) + random.normal(
        0, NOISE.read_noise, (trials, pixels)
    )
    step = NOISE.electrons_per_code
    reading = np.rint(np.clip(charge, None, NOISE.saturation) / step) * step
    ramp = (np.arange(pixels) - pixels / 2) / pixels
    used = NOISE.unsaturated(light + ambient)
    start = [truth + 0.1 * fwhm, 0.05, 1.05 * peak, 0.9 * ambient, 0.0]
    fit = np.tile(start, (trials, 1))
    for _ in range(12):
        centre, stretch, height, level, rise = fit.T
        shape = [
            gaussian(fwhm * math.exp(s), c, pixels, 1.0)
            for s, c in zip(stretch, centre, strict=True)
        ]
        bell, motion, widening = (np.stack(part) for part in zip(*shape, strict=True))
        h = height[:, None]
        model = h * bell + level[:, None] + rise[:, None] * ramp
        unit = np.ones_like(bell)
        slopes = np.stack([h * motion, h * widening, bell, unit, unit * ramp], axis=1)
        weight = used / NOISE.variance(np.clip(model, 0, None))
        left = np.einsum("tip,tp,tjp->tij", slopes, weight, slopes, optimize=True)
        right = np.einsum("tip,tp->ti", slopes, weight * (reading - model))
        fit += np.linalg.solve(left, right[..., None])[..., 0]
    error = fit[:, 0] - truth
    bound = spike_bound(light, background=ambient, nuisance=FIVE)
    return float(error.mean()), float(error.std()), bound


@pytest.mark.parametrize(
    ("fwhm", "peak", "ambient", "pixels"),
    [(6, 24_500, 3500, 41), (6, 24_500, 300, 14), (20, 24_500, 3500, 121), (12, 60_000, 1000, 81)],
    ids=["narrow", "cramped", "medium", "saturated"],
)
def test_maximum_likelihood_reaches_the_bound(
    fwhm: float, peak: float, ambient: float, pixels: int
) -> None:
    """1500 readings: the scatter's own standard error is 1.8 %."""
    bias, scatter, bound = scatter_of_maximum_likelihood(fwhm, peak, ambient, pixels, 1500)
    assert scatter == pytest.approx(bound, rel=0.06)
    assert abs(bias) < 4 * bound / math.sqrt(1500)


# saturation -------------------------------------------------------------------------------------


def test_saturated_pixels_tell_nothing() -> None:
    light, slope, _ = gaussian(30, 100.3, 201, 60_000)
    clear = NOISE.unsaturated(light)
    assert (~clear).sum() == 27
    flanks = spike_bound(light, derivative=slope, nuisance=("background",))
    assert flanks == pytest.approx(
        spike_bound(light[clear], derivative=slope[clear], nuisance=("background",)), rel=1e-12
    )
    # whatever the light does inside, readings do not show it
    other = np.where(clear, light, light + 5e4)
    assert spike_bound(other, derivative=slope, nuisance=("background",)) == pytest.approx(
        flanks, rel=1e-12
    )
    deep = Noise(full_well=1e6, codes=100_000)
    assert spike_bound(light, deep, derivative=slope) < spike_bound(light, derivative=slope)
    assert spike_bound(np.full(50, 1e5)) == math.inf
    assert spike_bound(light, background=40_000.0) == math.inf


def test_near_saturation_is_three_sigma() -> None:
    edge = 35_000 - 3 * math.sqrt(35_000 - 585 + 3600 + 184)
    assert NOISE.unsaturated([0, edge - 2, edge + 2, 35_000, 1e6]).tolist() == [1, 1, 0, 0, 0]


def test_the_converter_saturates_where_its_codes_end() -> None:
    assert NOISE.saturation == 35_000
    short = Noise(codes=256)
    assert short.saturation == 256 * 47
    assert not short.unsaturated(12_000.0)
    light, _, _ = gaussian(20, 60.0, 121, 11_000)
    assert spike_bound(light, Noise(full_well=10_000)) > spike_bound(light) * 1.001


# nothing to tell --------------------------------------------------------------------------------


def test_what_cannot_be_told_is_infinite() -> None:
    dark = np.zeros(20)
    assert spike_bound(dark) == math.inf
    assert spike_bound(np.full(20, 300.0)) == math.inf
    ramp = np.arange(40.0) * 20
    slope = np.full(40, -20.0)
    assert spike_bound(ramp, derivative=slope, nuisance=()) < math.inf
    assert spike_bound(ramp, derivative=slope, nuisance=("background",)) == math.inf
    # three unknowns that are two: the third takes nothing more
    motion = gaussian(6, 20.3, 40)[1]
    assert spike_bound(ramp, derivative=motion, nuisance=FIVE[:3]) == pytest.approx(
        spike_bound(ramp, derivative=motion, nuisance=FIVE[:2]), rel=1e-9
    )
    light, _, _ = gaussian(6, 10.0, 4)
    assert spike_bound(light, nuisance=FIVE) == math.inf  # four pixels, five unknowns


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: Noise(full_well=0), "full_well = 0"),
        (lambda: Noise(full_well=60, read_noise=35_000), "swapped"),
        (lambda: Noise(read_noise=-1), "read_noise = -1"),
        (lambda: Noise(electrons_per_code=0), "electrons_per_code = 0"),
        (lambda: Noise(codes=0), "codes = 0"),
        (lambda: NOISE.variance(-5.0), "not a reading with its noise"),
        (lambda: spike_bound([1.0, -2.0, 3.0]), "electrons = -2 e⁻"),
        (lambda: spike_bound([1.0, math.nan]), "finite"),
        (lambda: spike_bound(np.ones((2, 9))), r"\(N,\), not \(2, 9\)"),
        (lambda: spike_bound([]), "shape"),
        (lambda: spike_bound(np.ones(9), background=-1.0), "background = -1"),
        (lambda: spike_bound(np.ones(9), background=np.ones(8)), r"not \(8,\)"),
        (lambda: spike_bound(np.ones(9), derivative=np.ones(8)), r"not \(8,\)"),
        (lambda: spike_bound(np.ones(9), nuisance=NO_NUISANCE), "'skew': .* tuple of amplitude, b"),
        (lambda: spike_bound(np.ones(9), nuisance=NO_TUPLE), "'w': allowed is a tuple"),
        (lambda: shift_derivative(np.ones((3, 3))), r"not \(3, 3\)"),
    ],
)
def test_refusals_of_the_spike(call: Callable[[], object], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        call()


# the pose ---------------------------------------------------------------------------------------

FOCAL = 28.2
F_PIXELS = FOCAL / TCD1304.pitch


def row(leds: int, spacing: float = 500.0) -> Array:
    """LEDs on y = 0, mm."""
    return np.stack([(np.arange(leds) - (leds - 1) / 2) * spacing, np.zeros(leds)], axis=1)


def seen(leds: Array, y: float) -> Array:
    """Those within the field of a tracker at x = 0."""
    return leds[np.abs(leds[:, 0]) <= TCD1304.length / 2 / FOCAL * y]


def images(leds: Array, pose: Array) -> Array:
    offset, distance = room_to_optical(leds, pose[0], pose[1], pose[2])
    return np.asarray(-F_PIXELS * offset / distance)


@settings(deadline=None, max_examples=60)
@given(st.floats(-900, 900), st.floats(500, 5000), st.floats(-0.6, 0.6))
def test_jacobian_is_the_difference_of_images(x: float, y: float, heading: float) -> None:
    leds = np.array([[-200.0, 0.0], [0.0, 250.0], [321.0, -90.0]])
    pose = np.array([x, y, heading])
    _, distance = room_to_optical(leds, x, y, heading)
    if distance.min() < 100:
        return
    jacobian = pinhole_jacobian(leds, x, y, heading, focal_length=FOCAL)
    for column, h in enumerate((1e-2, 1e-2, 1e-5)):
        step = np.zeros(3)
        step[column] = h
        difference = (images(leds, pose + step) - images(leds, pose - step)) / (2 * h)
        assert jacobian[:, column] == pytest.approx(difference, rel=1e-5, abs=1e-4)


def test_images_move_as_the_inverted_image_of_the_studies() -> None:
    """Tracker to the right: LEDs move left in the room's view, so do they on an inverted sensor."""
    along_x, along_y, turn = pinhole_jacobian([[0, 0]], 0, 2000, focal_length=FOCAL)[0]
    assert along_x == pytest.approx(-F_PIXELS / 2000)
    assert along_y == pytest.approx(0.0)
    assert turn == pytest.approx(-F_PIXELS)


@pytest.mark.parametrize("distance", [1300.0, 2500.0, 4150.0])
@pytest.mark.parametrize("baseline", [300.0, 500.0])
def test_two_leds_and_a_known_heading(distance: float, baseline: float) -> None:
    """σ_x = y σ_u / (√2 f), σ_y = √2 y² σ_u / (f B)."""
    leds, sigma = row(2, baseline), 0.05
    bound = pose_bound(
        pinhole_jacobian(leds, 0, distance, focal_length=FOCAL), sigma, sigma_heading=0
    )
    assert bound.sigma_x == pytest.approx(distance * sigma / (math.sqrt(2) * F_PIXELS))
    assert bound.sigma_y == pytest.approx(
        math.sqrt(2) * distance**2 * sigma / (F_PIXELS * baseline)
    )
    assert bound.sigma_heading == 0


def test_knowing_the_heading_is_worth_13_to_16_in_x() -> None:
    """Nine LEDs 0.5 m apart, of which 3, 5 and 9 are seen; nothing in y."""
    factors = []
    for y in (1300.0, 2500.0, 4150.0):
        jacobian = pinhole_jacobian(seen(row(9), y), 0, y, focal_length=FOCAL)
        free, known = pose_bound(jacobian, 1.0), pose_bound(jacobian, 1.0, sigma_heading=0)
        factors.append(free.sigma_x / known.sigma_x)
        assert free.sigma_y == pytest.approx(known.sigma_y, rel=1e-9)
        # what is known of the heading adds to what is measured
        gyroscope = pose_bound(jacobian, 1.0, sigma_heading=math.radians(0.05))
        assert gyroscope.sigma_heading**-2 == pytest.approx(
            free.sigma_heading**-2 + math.radians(0.05) ** -2, rel=1e-9
        )
        assert 1.5 < free.sigma_x / gyroscope.sigma_x < 8
    assert np.round(factors).tolist() == [16, 16, 13]


@pytest.mark.parametrize(("stagger", "expected"), [(0.0, 3.2), (300.0, 0.97), (-300.0, 7.0)])
def test_a_staggered_middle_led(stagger: float, expected: float) -> None:
    """σ_x at 1.3 m per pixel, f 30 mm: toward the tracker helps, away from it harms."""
    leds = row(3)
    leds[1, 1] = stagger
    bound = pose_bound(pinhole_jacobian(leds, 0, 1300, focal_length=30), 1.0)
    assert bound.sigma_x == pytest.approx(expected, rel=0.025)


def test_an_estimated_pose_scatters_as_the_bound_says() -> None:
    """Gauss–Newton on noisy images, each LED with its own noise; 3000 trials."""
    random = np.random.default_rng(5)
    leds, truth = row(9), np.array([130.0, 4150.0, 0.04])
    sigma = np.linspace(0.03, 0.3, 9)
    measured = images(leds, truth) + random.normal(0, sigma, (3000, 9))
    poses = []
    for image in measured:
        pose = truth.copy()
        for _ in range(3):
            jacobian = pinhole_jacobian(leds, *pose, focal_length=FOCAL)
            left = jacobian / sigma[:, None]
            pose += np.linalg.lstsq(left, (image - images(leds, pose)) / sigma)[0]
        poses.append(pose)
    bound = pose_bound(pinhole_jacobian(leds, *truth, focal_length=FOCAL), sigma)
    scatter = np.cov(np.array(poses).T)
    sigmas = [bound.sigma_x, bound.sigma_y, bound.sigma_heading]
    assert np.sqrt(np.diag(scatter)) == pytest.approx(sigmas, rel=0.05)
    scale = np.outer(sigmas, sigmas)
    assert scatter / scale == pytest.approx(bound.covariance / scale, abs=0.08)


def test_an_unseen_led_tells_nothing_and_turning_the_room_changes_nothing() -> None:
    leds = np.array([[-500.0, 0.0], [0.0, 300.0], [600.0, 0.0], [900.0, 50.0]])
    jacobian = pinhole_jacobian(leds, 100, 2500, 0.1, focal_length=FOCAL)
    blind = pose_bound(jacobian, [0.1, 0.1, 0.2, math.inf])
    assert blind.covariance == pytest.approx(
        pose_bound(jacobian[:3], [0.1, 0.1, 0.2]).covariance, rel=1e-7
    )
    assert pose_bound(jacobian, 0.1).sigma_x < blind.sigma_x
    a = 0.3
    turn = np.array([[math.cos(a), -math.sin(a)], [math.sin(a), math.cos(a)]])
    x, y = turn @ [100, 2500]
    turned = pose_bound(pinhole_jacobian(leds @ turn.T, x, y, 0.1 + a, focal_length=FOCAL), 0.1)
    straight = pose_bound(jacobian, 0.1)
    assert turned.sigma_heading == pytest.approx(straight.sigma_heading, rel=1e-9)
    assert turned.covariance[:2, :2] == pytest.approx(
        turn @ straight.covariance[:2, :2] @ turn.T, rel=1e-7
    )


def test_what_the_leds_leave_open_is_infinite() -> None:
    def jacobian(leds: Array) -> Array:
        return pinhole_jacobian(leds, 0, 2000, focal_length=FOCAL)

    two = pose_bound(jacobian(row(2)), 0.1)
    assert (two.sigma_x, two.sigma_heading) == (math.inf, math.inf)
    assert two.sigma_y < math.inf  # a pair seen straight on gives its distance all the same
    one = pose_bound(jacobian(row(1)), 0.1, sigma_heading=0)
    assert one.sigma_x == pytest.approx(0.1 * 2000 / F_PIXELS)
    assert one.sigma_y == math.inf
    none = pose_bound(jacobian(row(3)), math.inf, sigma_heading=0.01)
    assert (none.sigma_x, none.sigma_y) == (math.inf, math.inf)
    assert none.sigma_heading == pytest.approx(0.01)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: pose_bound(np.ones((3, 4)), 0.1), "transposed"),
        (lambda: pose_bound(np.ones((4, 3)), [0.1, 0.2]), r"shape \(4,\), not \(2,\)"),
        (lambda: pose_bound(np.ones((4, 3)), [0.1, 0.2, 0.0, 1.0]), "sigma = 0"),
        (lambda: pose_bound(np.ones((4, 3)), math.nan), "sigma = nan"),
        (lambda: pose_bound(np.ones((4, 3)), 0.1, sigma_heading=-1.0), "sigma_heading = -1"),
        (lambda: pose_bound(np.ones((4, 3)), 0.1, sigma_heading=math.nan), "sigma_heading = nan"),
        (lambda: pinhole_jacobian(row(3), 0, -100, focal_length=28), "100 mm behind"),
        (lambda: pinhole_jacobian(row(3), 0, 900, 180.0, focal_length=28), "degrees"),
        (lambda: pinhole_jacobian(row(3), 0, 900, focal_length=0), "focal_length = 0"),
        (lambda: pinhole_jacobian(np.ones((2, 3)), 0, 900, focal_length=28), r"\(N, 2\)"),
    ],
)
def test_refusals_of_the_pose(call: Callable[[], object], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        call()
