"""Spikes: scatter against the Cramér–Rao bound, stated sigmas, corrections, what must not mislead."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.special import erf  # type: ignore[import-untyped]

from acquisition.frames import DARK, ELEMENTS, LEADING, PIXELS, Frame, FrameFlags
from raytransfer.designs import DESIGNS
from raytransfer.heads import Scene, spikes
from raytransfer.localisation import Noise, Nuisance, spike_bound
from tracking.spikes import MISSING, Correction, Detector, Spike, SpikeFinder, SpikeFlags
from twin.sensor import Electronics, SensorModel

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    Array = NDArray[np.float64]
    Shape = Callable[[float, float], Array]

NOISE = Noise()
FIVE: tuple[Nuisance, ...] = ("amplitude", "background", "gradient", "width")
CORRECTION = Correction.nominal(uncertainty=0.0, saturation=(NOISE.full_well - 250) / 47)
"""Of the sensor of `read`: its noise, all pixels alike."""
SIGMA = 1 / math.sqrt(8 * math.log(2))
AMBIENT = 0.1 * NOISE.full_well
PEAK = 0.7 * NOISE.full_well
PLACE = np.arange(PIXELS, dtype=float)
DETECTORS: tuple[Detector, ...] = ("minimum", "gravity", "derivative", "likelihood")
WRONG_DETECTOR: Any = "maximum"
DARK_CODE = 3900


@pytest.fixture(scope="module", autouse=True)
def _compiled() -> None:
    SpikeFinder().load_kernels()


def gaussian(fwhm: float, centre: float) -> Array:
    """Pixel charges of a spike of peak 1."""
    s = fwhm * SIGMA * math.sqrt(2)
    edges = (np.arange(PIXELS + 1) - 0.5 - centre) / s
    return np.asarray(s * math.sqrt(math.pi) / 2 * np.diff(erf(edges)))


def _sampled(shape: Callable[[Array], Array], centre: float) -> Array:
    fine = np.arange(-0.5 + 1 / 32, PIXELS - 0.5, 1 / 16) - centre
    return np.asarray(shape(fine).reshape(PIXELS, -1).mean(axis=1))


def defocused(fwhm: float, centre: float) -> Array:
    """A slit out of focus: a box with edges that a Gaussian softens."""
    s = 0.15 * fwhm * math.sqrt(2)
    return _sampled(lambda x: (erf((x + fwhm / 2) / s) - erf((x - fwhm / 2) / s)) / 2, centre)


def winged(fwhm: float, centre: float) -> Array:
    """A squared Lorentzian: a twelfth of its light is farther away than one FWHM."""
    k = 2 * math.sqrt(math.sqrt(2) - 1) / fwhm
    return _sampled(lambda x: 1 / (1 + (k * x) ** 2) ** 2, centre)


def coded(depth: Array | float, dark: int = DARK_CODE) -> Frame:
    """A frame whose pixels lie so many codes below the dark reference."""
    elements = np.full(ELEMENTS, float(dark))
    elements[LEADING : LEADING + PIXELS] -= depth
    return Frame(np.clip(np.rint(elements), 0, 4095).astype(np.uint16))


def read(expected: Array, rng: np.random.Generator) -> Frame:
    """A reading of an even sensor with the noise of `NOISE`."""
    charge = np.minimum(rng.poisson(expected), NOISE.full_well)
    charge = charge + NOISE.read_noise * rng.standard_normal(PIXELS)
    return coded(charge / NOISE.electrons_per_code)


class Scatter:
    """Errors of many readings of one shape, at random places."""

    def __init__(
        self,
        shape: Shape,
        fwhm: float,
        *,
        detector: Detector = "likelihood",
        peak: float = PEAK,
        background: Array | float = AMBIENT,
        beside: Callable[[float], Array | float] = lambda _: 0.0,
        count: int = 250,
        seed: int = 1,
    ) -> None:
        rng = np.random.default_rng([seed, round(10 * fwhm), DETECTORS.index(detector)])
        finder = SpikeFinder(CORRECTION, detector=detector, limit=1)
        errors, bounds, sigmas = [], [], []
        self.flags: list[SpikeFlags] = []
        for n in range(count):
            centre = rng.uniform(1400, 2200)
            spike, other = peak * shape(fwhm, centre), background + beside(centre)
            (found,) = finder(read(spike + other, rng))
            errors.append(found.position - centre)
            sigmas.append(found.sigma)
            self.flags.append(found.flags)
            if n < 8:
                bounds.append(spike_bound(spike, NOISE, background=other, nuisance=FIVE))
        self.bound = float(np.mean(bounds))
        self.ratio = float(np.sqrt(np.mean(np.square(errors)))) / self.bound
        self.honesty = float(np.sqrt(np.mean(np.square(sigmas)))) / float(np.std(errors))


# likelihood against the bound -------------------------------------------------------------------


@pytest.mark.parametrize("fwhm", [6, 12, 20, 40, 64])
@pytest.mark.parametrize("shape", [gaussian, defocused, winged])
def test_likelihood_comes_near_the_bound(shape: Shape, fwhm: float) -> None:
    """RMS error about the truth; the bound knows the true shape, the estimator does not."""
    scatter = Scatter(shape, fwhm)
    assert 0.85 < scatter.ratio < 1.3
    assert scatter.honesty == pytest.approx(1, abs=0.18)
    assert set(scatter.flags) == {SpikeFlags.NONE}


@pytest.mark.parametrize("fwhm", [6, 20, 64])
@pytest.mark.parametrize(("apart", "part"), [(1.5, 0.1), (-2.0, 0.3), (3.0, 0.05), (4.0, 0.2)])
def test_a_gradient_and_a_reflection_cost_little(fwhm: float, apart: float, part: float) -> None:
    """Ambient light that doubles within 900 px; a reflection of the same shape, in units of FWHM."""
    scatter = Scatter(
        gaussian,
        fwhm,
        peak=0.55 * NOISE.full_well,
        background=AMBIENT * (0.3 + PLACE / 1000),
        beside=lambda c: 0.55 * NOISE.full_well * part * gaussian(fwhm, c + apart * fwhm),
    )
    assert 0.85 < scatter.ratio < 1.6
    if abs(apart) <= 2:
        assert scatter.flags.count(SpikeFlags.REFLECTION) > 0.95 * len(scatter.flags)


@pytest.mark.parametrize("fwhm", [6, 20, 64])
@pytest.mark.parametrize("overfilled", [1.5, 4.0, 10.0])
@pytest.mark.parametrize("detector", ["gravity", "likelihood"])
def test_saturated_spikes(fwhm: float, overfilled: float, detector: Detector) -> None:
    """The bound leaves full pixels out, as the likelihood does where the fit is above them."""
    scatter = Scatter(
        gaussian, fwhm, detector=detector, peak=overfilled * NOISE.full_well, count=150
    )
    assert scatter.ratio < (1.35 if detector == "likelihood" else 7)
    assert all(flags & SpikeFlags.SATURATED for flags in scatter.flags)
    assert scatter.honesty > 0.8


SCENE = Scene()
VIEWS = [
    ("slit-4mm", 1300.0, 0.0),
    ("slit-4mm", 2500.0, 12.0),
    ("slit-4mm", 4150.0, 12.0),
    ("slit-f50-f100", 1300.0, 12.0),
    ("slit-f50-f100", 2500.0, 20.0),
    ("slit-f50-f100", 4150.0, 0.0),
]


@pytest.mark.parametrize(("name", "y", "angle"), VIEWS)
def test_exact_light_of_real_heads(name: str, y: float, angle: float) -> None:
    """Shapes with horns and of unequal sides: scatter about what the finder gives without noise.

    That is where a calibration by `profile` puts the LED, so it is the error that counts.
    """
    x = y * math.tan(math.radians(angle)) + np.linspace(0, 0.7, 5)
    light = spikes(DESIGNS[name].system, SCENE, x, np.full(5, y))
    rng = np.random.default_rng(3)
    finder = SpikeFinder(CORRECTION, limit=1)
    squares, sigmas, bounds = [], [], []
    first, last = (finder.profile(light.electrons[n]).position for n in (0, -1))
    pixels_per_mm = (last - first) / (x[-1] - x[0])
    for charge, slope in zip(light.electrons, light.slope / pixels_per_mm, strict=True):
        scale = PEAK / charge.max()
        exact = finder.profile(scale * charge + AMBIENT)
        found = [finder(read(scale * charge + AMBIENT, rng))[0] for _ in range(60)]
        errors = np.array([spike.position for spike in found]) - exact.position
        assert abs(errors.mean()) < 4.5 * errors.std() / math.sqrt(60)
        squares.append(np.mean(errors**2))
        sigmas += [spike.sigma for spike in found]
        bounds.append(
            spike_bound(
                scale * charge, NOISE, background=AMBIENT, nuisance=FIVE, derivative=scale * slope
            )
        )
    rms = math.sqrt(float(np.mean(squares)))
    assert 0.85 < rms / float(np.mean(bounds)) < 1.3
    assert float(np.mean(sigmas)) / rms == pytest.approx(1, abs=0.18)


FIELD = np.arange(0, 25.01, 0.5)


def across(name: str, y: float, angle: Array) -> Array:
    """Exact profiles of an LED across the field, peaks 1."""
    light = spikes(
        DESIGNS[name].system, SCENE, y * np.tan(np.radians(angle)), np.full(angle.size, y)
    )
    return np.asarray(light.electrons / light.electrons.max(axis=1, keepdims=True))


@pytest.mark.parametrize("name", ["slit-4mm", "slit-f50-f100", "thesis"])
@pytest.mark.parametrize("y", [1300.0, 2500.0, 4150.0])
def test_the_whole_field_of_real_heads(name: str, y: float) -> None:
    """Out to 25°, bright and faint: never one horn alone, and stated sigmas are true."""
    rng = np.random.default_rng(17)
    finder = SpikeFinder(CORRECTION, limit=1)
    light = across(name, y, FIELD)
    for peak in (PEAK, 0.05 * NOISE.full_well):
        errors, sigmas = [], []
        for charge in light:
            exact = finder.profile(peak * charge + AMBIENT)
            for _ in range(3):
                (found,) = finder(read(peak * charge + AMBIENT, rng))
                errors.append(found.position - exact.position)
                sigmas.append(found.sigma)
        assert np.abs(errors).max() < (0.15 if peak == PEAK else 0.6)
        assert np.median(sigmas) > 0.8 * np.std(errors)
        assert np.sqrt(np.mean(np.square(sigmas))) > 0.8 * np.std(errors)


@pytest.mark.parametrize(
    ("name", "most"), [("slit-4mm", 0.1), ("slit-f50-f100", 0.1), ("thesis", 0.3)]
)
@pytest.mark.parametrize("y", [1300.0, 2500.0, 4150.0])
def test_positions_are_continuous_along_the_field(name: str, y: float, most: float) -> None:
    """An LED that moves by 0.1° makes no jump, at any amount of light."""
    finder = SpikeFinder(CORRECTION, limit=1)
    angle = np.arange(17, 25.01, 0.1)
    for peak in (PEAK, 0.05 * NOISE.full_well):
        places = np.array(
            [finder.profile(peak * c + AMBIENT).position for c in across(name, y, angle)]
        )
        tangent = np.tan(np.radians(angle))
        smooth = np.polynomial.Legendre.fit(tangent, places, 5)(tangent)
        assert np.abs(np.diff(places - smooth)).max() < most


def test_horns_as_sharp_as_of_a_point() -> None:
    """One pixel wide, unequal, with a tenth of their height between: still one spike, in a window too."""
    rng = np.random.default_rng(18)
    finder = SpikeFinder(CORRECTION)
    for _ in range(60):
        apart, peak = rng.integers(12, 44), rng.uniform(0.05, 0.7) * NOISE.full_well
        light = np.full(PIXELS, 2.0 * NOISE.electrons_per_code)
        light[1500 : 1500 + apart] += 0.14 * peak
        light[1500], light[1501] = peak, 0.5 * peak
        light[1499 + apart], light[1498 + apart] = 0.8 * peak, 0.6 * peak
        middle = 1499.5 + apart / 2
        frame = read(light, rng)
        for found in (finder(frame), finder(frame, windows=[(1400, 1650)])):
            (spike,) = found
            assert abs(spike.position - middle) < 1
            assert spike.flags == SpikeFlags.DOUBLE


KNOWN = replace(CORRECTION, pattern=np.full(PIXELS, 1e-3))
"""With a dark pattern, as of a sensor that was measured: it has no hot pixels left."""


@pytest.mark.parametrize("detector", DETECTORS)
@pytest.mark.parametrize("fwhm", [0.1, 0.6, 0.9, 1.2, 1.5, 2.0])
def test_an_led_in_sharp_focus(detector: Detector, fwhm: float) -> None:
    """Found wherever in a pixel it is, and nobody says that a place in a pixel is known."""
    rng = np.random.default_rng(19)
    finder = SpikeFinder(KNOWN, detector=detector)
    errors, sigmas = [], []
    for _ in range(150):
        centre = rng.uniform(1000, 1100)
        light = gaussian(fwhm, centre)
        (found,) = finder(read(PEAK * light / light.max() + AMBIENT, rng))
        errors.append(found.position - centre)
        sigmas.append(found.sigma)
        assert found.width >= 1
        assert found.sigma < 0.6
    assert np.abs(errors).max() < 0.6
    # the derivative's own smoothing is no wider than a pixel
    if detector == "likelihood" or fwhm < 1.2:
        assert np.sqrt(np.mean(np.square(sigmas))) > 0.8 * np.std(errors)


def test_light_on_one_pixel_alone() -> None:
    """Where the dark pattern was measured, or an unlit frame is given, it is an LED; else a hot pixel."""
    rng = np.random.default_rng(20)
    light = np.full(PIXELS, AMBIENT)
    unlit = read(light, rng)
    light[1200] += PEAK
    frame = read(light, rng)
    for detector in DETECTORS:
        assert SpikeFinder(CORRECTION, detector=detector)(frame) == []
        for found in (
            SpikeFinder(KNOWN, detector=detector)(frame),
            SpikeFinder(CORRECTION, detector=detector)(frame, unlit=unlit),
            [SpikeFinder(CORRECTION, detector=detector).profile(light)],
        ):
            (spike,) = found
            assert spike.position == pytest.approx(1200, abs=0.1)
            assert spike.sigma == pytest.approx(1 / math.sqrt(12), rel=0.05)
            assert spike.height == pytest.approx(PEAK, rel=0.05)
    # what electrons wander in the silicon is enough to tell an LED: 0.003 mm, a tenth beside
    for centre in rng.uniform(1000, 1100, 30):
        blurred = gaussian(0.003 / 0.008 / SIGMA, float(centre))
        (spike,) = SpikeFinder(CORRECTION)(read(PEAK * blurred + AMBIENT, rng))
        assert abs(spike.position - centre) < 0.1


def test_measured_hot_pixels_are_no_spikes() -> None:
    """Bright without light: gone with the dark pattern, which does not hide an LED on one pixel."""
    rng = np.random.default_rng(21)
    pattern = np.where(PLACE % 173 == 0, 300.0, 0.0)
    finder = SpikeFinder(replace(CORRECTION, pattern=pattern))
    depth = pattern + 1.3 * rng.standard_normal(PIXELS)
    assert finder(coded(depth)) == []
    depth[1500] += 400
    (spike,) = finder(coded(depth))
    assert spike.position == pytest.approx(1500, abs=0.01)


# the other detectors ----------------------------------------------------------------------------


@pytest.mark.parametrize("fwhm", [6, 20, 64])
@pytest.mark.parametrize(
    ("detector", "least", "most"), [("gravity", 0.9, 1.3), ("derivative", 0.95, 1.35)]
)
def test_simpler_detectors(detector: Detector, least: float, most: float, fwhm: float) -> None:
    scatter = Scatter(gaussian, fwhm, detector=detector)
    assert least < scatter.ratio < most
    assert scatter.honesty == pytest.approx(1, abs=0.2)


@pytest.mark.parametrize(("fwhm", "about"), [(6, 32), (20, 35), (64, 54)])
def test_the_minimum_pixel_is_far_from_the_bound(fwhm: float, about: float) -> None:
    """The factors are an independent simulation's. Its sigma is told honestly all the same."""
    scatter = Scatter(gaussian, fwhm, detector="minimum", count=400)
    assert scatter.ratio == pytest.approx(about, rel=0.15)
    assert scatter.honesty == pytest.approx(1, abs=0.25)


@pytest.mark.parametrize("detector", DETECTORS)
@pytest.mark.parametrize("fwhm", [3, 20, 150])
def test_without_noise(detector: Detector, fwhm: float) -> None:
    finder = SpikeFinder(CORRECTION, detector=detector)
    exact = {"likelihood": 1e-4, "derivative": 1e-3, "gravity": 0.02, "minimum": 0.51}
    for centre in (700.0, 1823.5, 2000.27):
        spike = finder.profile(PEAK * gaussian(fwhm, centre) + AMBIENT)
        assert abs(spike.position - centre) < exact[detector]
        # all but the fit draw straight lines from pixel to pixel
        assert spike.width == pytest.approx(fwhm, rel=0.001 if detector == "likelihood" else 0.1)
        assert spike.height == pytest.approx(PEAK, rel=0.001 if detector == "likelihood" else 0.1)
        assert spike.flags == SpikeFlags.NONE


def test_a_profile_in_a_window() -> None:
    light = PEAK * (gaussian(10, 800.0) + 0.5 * gaussian(10, 2500.25))
    finder = SpikeFinder()
    assert finder.profile(light).position == pytest.approx(800, abs=1e-3)
    assert finder.profile(light, (2400, 2600)).position == pytest.approx(2500.25, abs=1e-3)
    assert finder.profile(light, (100, 300)) is MISSING
    assert finder.profile(np.zeros(PIXELS)) is MISSING
    with pytest.raises(ValueError, match="shape"):
        finder.profile(light[None])


# several spikes, windows ------------------------------------------------------------------------


@pytest.mark.parametrize("detector", DETECTORS)
def test_windows_give_each_its_spike(detector: Detector) -> None:
    rng = np.random.default_rng(5)
    light = AMBIENT + PEAK * (gaussian(9, 610.3) + 0.3 * gaussian(12, 700.7) + gaussian(30, 3000))
    windows = [
        (670, 730),
        (570, 650),
        (1500, 1600),
        (2900, 3100),
        (-20, 60),
        (5000, 5100),
        (90, 80),
    ]
    found = SpikeFinder(CORRECTION, detector=detector)(read(light, rng), windows=windows)
    assert len(found) == len(windows)
    for spike, place in zip(found, (700.7, 610.3, None, 3000, None, None, None), strict=True):
        if place is None:
            assert spike is MISSING
            assert not spike.found
        else:
            assert abs(spike.position - place) < 5 * spike.sigma
            assert not spike.flags & (SpikeFlags.MISSING | SpikeFlags.CLIPPED)


def test_the_whole_line_is_given_strongest_first() -> None:
    rng = np.random.default_rng(6)
    light = AMBIENT + PEAK * sum(
        a * gaussian(8, c) for a, c in ((0.2, 300.0), (1.0, 900.0), (0.5, 1500.0), (0.1, 2500.0))
    )
    frame = read(np.asarray(light), rng)
    found = SpikeFinder(CORRECTION)(frame)
    assert [round(spike.position) for spike in found] == [900, 1500, 300, 2500]
    assert [round(s.position) for s in SpikeFinder(CORRECTION, limit=2)(frame)] == [900, 1500]
    assert SpikeFinder(CORRECTION)(frame, windows=[]) == []


@pytest.mark.parametrize("apart", [2.5, 4.0])
def test_two_leds_that_overlap_are_told_apart(apart: float) -> None:
    """Both are found at their places, near the scatter that each has alone, and flagged."""
    rng = np.random.default_rng(7)
    finder = SpikeFinder(CORRECTION)
    errors, flags = [], []
    for _ in range(60):
        c = rng.uniform(900, 1000)
        light = AMBIENT + PEAK * (gaussian(14, c) + 0.8 * gaussian(14, c + 14 * apart))
        found = finder(read(light, rng))
        assert len(found) == 2
        errors += [found[0].position - c, found[1].position - c - 14 * apart]
        window = (round(c) - 60, round(c) + 100)
        (one,) = finder(read(light, rng), windows=[window])
        errors.append(one.position - c)
        flags.append(one.flags)
    bound = spike_bound(PEAK * gaussian(14, 950), NOISE, background=AMBIENT, nuisance=FIVE)
    assert np.sqrt(np.mean(np.square(errors))) < 2 * bound
    assert set(flags) == {SpikeFlags.DOUBLE}


def test_two_leds_too_near_are_one_and_flagged() -> None:
    """As bright as each other and 1.7 widths apart, they look like a caustic."""
    rng = np.random.default_rng(7)
    light = AMBIENT + PEAK * (gaussian(14, 950.0) + 0.8 * gaussian(14, 974.0))
    for _ in range(20):
        (spike,) = SpikeFinder(CORRECTION)(read(light, rng))
        assert 945 < spike.position < 979
        assert spike.flags == SpikeFlags.DOUBLE


def test_the_horns_of_a_caustic_are_one_spike() -> None:
    """Its position is their middle, whichever is brighter by chance."""
    rng = np.random.default_rng(8)
    finder = SpikeFinder(CORRECTION)
    for _ in range(40):
        c = rng.uniform(1500, 1600)
        inside = np.clip((np.abs(PLACE - c) < 15) * 0.3, 0, 1)
        light = AMBIENT + 0.6 * PEAK * (gaussian(4, c - 15) + gaussian(4, c + 15) + inside)
        (spike,) = finder(read(light, rng))
        assert abs(spike.position - c) < 0.5
        assert spike.flags == SpikeFlags.DOUBLE
        assert spike.width == pytest.approx(34, abs=1)


@pytest.mark.parametrize("detector", DETECTORS)
def test_a_spike_over_the_end_is_flagged(detector: Detector) -> None:
    rng = np.random.default_rng(9)
    finder = SpikeFinder(CORRECTION, detector=detector)
    for place in (6.0, PIXELS - 8.0):
        (spike,) = finder(read(PEAK * gaussian(20, place) + AMBIENT, rng))
        assert spike.flags & SpikeFlags.CLIPPED
        assert abs(spike.position - place) < 3
    frame = read(PEAK * gaussian(20, 1000.0) + AMBIENT, rng)
    (spike,) = finder(frame, windows=[(990, 1200)])
    assert spike.flags & (SpikeFlags.CLIPPED | SpikeFlags.MISSING)
    # without its peak nobody knows where it is
    assert finder(read(PEAK * gaussian(20, -8.0) + AMBIENT, rng)) == []


def test_the_search_by_blocks_misses_nothing() -> None:
    """Against the significance of every place at every scale, of lines and of windows."""
    from tracking import _spikes as kernels

    rng = np.random.default_rng(14)
    least, wander = 36.0, 400.0
    found = 0
    for n in range(2000):
        bins = int(rng.integers(3, PIXELS // 4 + 1)) if n % 2 else PIXELS // 4
        place = np.arange(4 * bins)
        expected = np.full(4 * bins, rng.choice([0.0, 300.0, 14_000.0]))
        for _ in range(rng.integers(0, 6)):  # narrow to broader than any spike, bright or dark
            width, height = np.exp(rng.uniform(0, 6.5)), np.exp(rng.uniform(3, 11.4))
            form = ((place - rng.uniform(-50, 4 * bins + 50)) / width) ** 2
            expected += rng.choice([1.0, 1.0, -0.1]) * height * np.exp(-4 * math.log(2) * form)
        expected += rng.choice([0.0, 0.0, 30_000.0]) * (place > rng.integers(4 * bins))
        variance = 3800.0 + np.maximum(expected, 0.0)
        charge = expected + np.sqrt(variance) * rng.standard_normal(4 * bins)
        light, noise = np.zeros((2, bins + 1 + kernels.BLOCK))
        light[1 : bins + 1] = charge.reshape(-1, 4).sum(axis=1).cumsum()
        noise[1 : bins + 1] = variance.reshape(-1, 4).sum(axis=1).cumsum()
        scores, scales, places = np.empty(4000), np.empty(4000, int), np.empty(4000, int)
        count = kernels._scan(light, noise, bins, wander, least, scores, scales, places)
        listed = [*zip(scales[:count].tolist(), places[:count].tolist(), strict=True)]
        all_of_them = {}
        for scale in range(kernels._scales(bins)):
            wide, step = 2**scale, kernels._step(scale)
            near = (wide + 1) // 2
            far, floor = near + wide, wander * (4 * wide) ** 2
            k = np.arange(kernels._places(bins, scale))
            j = k * step
            inside = (j >= far) & (j + wide + far <= bins)
            i = j[inside]

            def over(sums: Array, i: NDArray[np.int64] = i, wide: int = wide) -> Array:
                return sums[i + wide] - sums[i]

            own = over(noise) + floor
            beside, around = (
                over(sums, i - far) + over(sums, i + wide + near) for sums in (light, noise)
            )
            excess = over(light) - beside / 2
            score = np.minimum(
                excess * abs(excess) / (own + around / 4), over(light) * abs(over(light)) / own
            )
            every = np.empty(k.size)
            every[inside] = score
            every[~inside] = [
                kernels._significance(light, noise, bins, int(at), wide, near, floor)
                for at in j[~inside]
            ]
            all_of_them.update({(scale, int(at)): every[at] for at in k[every > least]})
        assert listed == [*all_of_them]
        assert np.allclose(scores[:count], [*all_of_them.values()], rtol=1e-9, atol=0)
        found += count
    assert found > 50_000  # 96 000 or so: the frames have something to miss


# what is no spike -------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["dark", "ambient", "uneven", "odd and even", "noisy"])
def test_no_line_gives_no_spike(kind: str) -> None:
    """None in 3000 frames: with 95 % confidence fewer than one in a thousand."""
    rng = np.random.default_rng(10)
    response = 1 + 0.015 * rng.standard_normal(PIXELS)
    finders = [SpikeFinder(), SpikeFinder(detector="gravity")]
    for n in range(3000):
        depth = np.zeros(PIXELS)
        noise: Array | float = 1.3
        if kind in ("ambient", "uneven"):
            depth += 150 * (1 + 0.5 * np.cos(PLACE / 1160 - 1.57)) if kind == "ambient" else 75
            noise = np.sqrt(1.7 + depth / 47)
            depth = depth * (response if kind == "uneven" else 1)
        elif kind == "odd and even":
            depth += 4.0 * (PLACE % 2)
        elif kind == "noisy":
            noise = 6.0
        frame = coded(depth + noise * rng.standard_normal(PIXELS))
        assert finders[n % 2](frame) == []


def bell(place: float, width: float, height: float) -> Array:
    return np.asarray(height * np.exp(-4 * math.log(2) * ((PLACE - place) / width) ** 2))


SPECTRUM = bell(1200, 300, 700) + bell(1900, 900, 900)
NO_SPIKES = {
    "white LED": SPECTRUM,
    "continuous": bell(1700, 1800, 1500),
    "step": np.where(PLACE > 1800, 600.0, 0.0),
    "wide box": np.where((PLACE > 1000) & (PLACE < 2500), 600.0, 0.0),
    "all full": np.full(PIXELS, 2060.0),
    "clipped at both ends of the converter": np.where(PLACE > 1800, 5000.0, -5000.0),
    "inverted": -bell(1800, 20, 150),
    "inverted spectrum": -0.2 * SPECTRUM,
    "hot pixels": np.where(PLACE % 173 == 0, 900.0, 0.0),
    "shade of the ambient light": np.clip(74 + (PLACE - 1500) * 0.04, 2, 250),
}


@pytest.mark.parametrize("detector", DETECTORS)
@pytest.mark.parametrize("name", NO_SPIKES)
def test_what_is_no_spike(name: str, detector: Detector) -> None:
    rng = np.random.default_rng(11)
    depth = NO_SPIKES[name]
    for _ in range(5):
        noise = np.sqrt(1.7 + np.maximum(depth, 0) / 47) * rng.standard_normal(PIXELS)
        assert SpikeFinder(detector=detector)(coded(depth + noise)) == []
    assert SpikeFinder(detector=detector)(Frame(np.zeros(ELEMENTS, np.uint16))) == []


def test_lines_of_a_spectrum() -> None:
    """A laser, its ghost, a strong neighbour: each at its place, whatever the converter's offset."""
    rng = np.random.default_rng(12)
    places = (435.0, 1100.5, 1500.2, 1560.0, 2600.4)
    depth = sum(bell(c, 8, a) for c, a in zip(places, (300, 900, 1700, 500, 150), strict=True))
    noise = np.sqrt(1.7 + np.maximum(depth, 0) / 47) * rng.standard_normal(PIXELS)
    for dark in (2600, 3950):
        found = SpikeFinder()(coded(depth + noise, dark))
        assert np.allclose(sorted(s.position for s in found), places, atol=0.1)
    elements = np.full(ELEMENTS, 60_000.0)
    elements[LEADING : LEADING + PIXELS] -= 20 * (depth + noise)
    found = SpikeFinder(Correction.nominal(electrons_per_code=2.4, saturation=40_000))(
        Frame(np.rint(elements).astype(np.uint16))
    )
    assert np.allclose(sorted(s.position for s in found), places, atol=0.1)
    # a plateau of full pixels is a spike, its middle known less well
    (flat,) = SpikeFinder()(coded(np.minimum(bell(1800, 150, 8000), 1950) + noise[::-1] * 0.1))
    assert flat.position == pytest.approx(1800, abs=0.2)
    assert flat.flags == SpikeFlags.SATURATED


def test_a_hot_pixel_does_not_pull_a_spike() -> None:
    rng = np.random.default_rng(13)
    depth = bell(1000.3, 14, 400)
    depth[[997, 1006, 1015]] += 900
    (spike,) = SpikeFinder()(coded(depth + 1.5 * rng.standard_normal(PIXELS)))
    assert spike.position == pytest.approx(1000.3, abs=0.6)


@settings(max_examples=150, deadline=None)
@given(
    base=st.sampled_from([0, 1, 2000, 3900, 4095, 65535]),
    places=arrays(np.int64, 12, elements=st.integers(0, ELEMENTS - 1)),
    values=arrays(np.uint16, 12),
    seed=st.integers(0, 99),
    spread=st.sampled_from([0, 1, 30, 70_000]),
    detector=st.sampled_from(DETECTORS),
    windows=st.none()
    | st.lists(st.tuples(st.integers(-5000, 9000), st.integers(-5000, 9000)), max_size=5),
    unlit=st.booleans(),
)
def test_any_frame_gives_finite_spikes_or_none(
    base: int,
    places: NDArray[np.int64],
    values: NDArray[np.uint16],
    seed: int,
    spread: int,
    detector: Detector,
    windows: list[tuple[int, int]] | None,
    unlit: bool,
) -> None:
    """Blocks of any values on noise of any size."""
    rng = np.random.default_rng(seed)
    elements = np.clip(base + spread * rng.standard_normal(ELEMENTS), 0, 65535).astype(np.uint16)
    ends = np.sort(places).reshape(-1, 2)
    for (a, b), value in zip(ends, values, strict=False):
        elements[a:b] = value
    finder = SpikeFinder(detector=detector)
    frame = Frame(elements)
    found = finder(frame, windows=windows, unlit=Frame(elements[::-1]) if unlit else None)
    if windows is None:
        assert len(found) <= finder.limit
        assert all(spike.found for spike in found)
    else:
        assert len(found) == len(windows)
    for spike in found:
        if spike.found:
            assert -0.5 <= spike.position <= PIXELS - 0.5
            assert 0 < spike.sigma < spike.width < math.inf
            assert 0 < spike.height < math.inf
        else:
            assert math.isnan(spike.position)
            assert spike.sigma == math.inf


def test_an_invalid_frame_is_not_measured() -> None:
    frame = coded(bell(1000, 10, 500)).replaced(flags=FrameFlags.INVALID)
    assert SpikeFinder()(frame) == []
    assert SpikeFinder()(frame, windows=[(900, 1100)]) == [MISSING]


def test_arguments_are_checked() -> None:
    with pytest.raises(ValueError, match="allowed are minimum, gravity"):
        SpikeFinder(detector=WRONG_DETECTOR)
    with pytest.raises(ValueError, match="limit"):
        SpikeFinder(limit=0)
    with pytest.raises(ValueError, match="threshold"):
        SpikeFinder(threshold=-1)
    bad: Any = [(1, 2, 3)]
    with pytest.raises(ValueError, match="pairs"):
        SpikeFinder()(coded(0.0), windows=bad)


# the sensor -------------------------------------------------------------------------------------

ELECTRONICS = Electronics(response_spread=0.02, odd_even_offset=0.004, dark_spread=0.5)
PER_CODE = 60_000 / (1.66 / 3.3 * 4096)
SECONDS = 0.05


def captured(sensor: SensorModel, light: Array | float, sh_period: int = 200_000) -> Frame:
    """A frame of so many electrons per even pixel, after some dark signal."""
    charge = sensor.response * light + sensor.dark_rates() * SECONDS
    return Frame(sensor.digitise(charge, SECONDS)[0], sh_period=sh_period)


@pytest.fixture(scope="module")
def sensor() -> SensorModel:
    return SensorModel(7, ELECTRONICS)


@pytest.fixture(scope="module")
def measured(sensor: SensorModel) -> Correction:
    shade = 30_000 * (1 - 0.2 * np.linspace(-1, 1, PIXELS) ** 2)
    lamp = np.random.default_rng(1).uniform(0.97, 1.03, 48)
    return Correction.measure(
        [captured(sensor, 0.0) for _ in range(48)], [captured(sensor, f * shade) for f in lamp]
    )


def test_a_sensor_is_measured(sensor: SensorModel, measured: Correction) -> None:
    """Photon transfer, response and dark pattern, through codes, a flickering, shaded lamp."""
    assert measured.electrons_per_code == pytest.approx(PER_CODE, rel=0.01)
    dark_signal = sensor.dark_rates().mean() * SECONDS
    expected = math.sqrt(40**2 + dark_signal + PER_CODE**2 / 12)
    assert measured.read_noise == pytest.approx(expected, rel=0.02)
    left = measured.response / sensor.response
    # what is smooth in the response cannot be told from the lamp's shading
    left /= np.polynomial.Legendre.fit(PLACE, left, 4)(PLACE)
    assert np.std(left) == pytest.approx(measured.uncertainty, rel=0.1)
    assert np.std(left) < 0.002
    shielded = sensor.dark_rates() * SECONDS / PER_CODE
    expected_pattern = shielded - 0.004 / 3.3 * 4096 * np.where(PLACE % 2, 0.5, -0.5)
    assert np.std(measured.pattern - expected_pattern) < 0.35


def test_the_flat_field_brings_spikes_near_the_bound(
    sensor: SensorModel, measured: Correction
) -> None:
    """Of pixels that differ by 2 % and read through codes; without it the error is much larger."""
    noise = Noise(60_000, math.hypot(40, math.sqrt(1000)), PER_CODE)
    rng = np.random.default_rng(2)
    even = Correction(
        np.full(PIXELS, np.median(measured.pattern)), np.ones(PIXELS), PER_CODE,
        measured.read_noise, 1900.0, 0.02,
    )  # fmt: skip
    for fwhm in (6, 20, 64):
        errors: dict[str, list[float]] = {"measured": [], "even": []}
        for _ in range(150):
            centre = rng.uniform(300, 3300)
            frame = captured(sensor, 40_000 * gaussian(fwhm, centre) + 3000)
            for name, correction in (("measured", measured), ("even", even)):
                (spike,) = SpikeFinder(correction, limit=1)(frame)
                errors[name].append(spike.position - centre)
        bound = spike_bound(
            40_000 * gaussian(fwhm, 1500.2), noise, background=3000.0, nuisance=FIVE
        )
        with_it, without = (
            float(np.sqrt(np.mean(np.square(errors[name])))) / bound
            for name in ("measured", "even")
        )
        assert 0.85 < with_it < 1.3
        assert without > 2.5


def test_an_unlit_frame_takes_the_scene_away(sensor: SensorModel, measured: Correction) -> None:
    """A lamp in the scene is no LED; noise of both frames is in the variance and in sigma."""
    scene = 8000 * gaussian(30, 2000) + 2000
    lit = captured(sensor, scene + 20_000 * gaussian(10, 1200.4))
    unlit = captured(sensor, scene)
    finder = SpikeFinder(measured)
    assert len(finder(lit)) == 2
    (spike,) = finder(lit, unlit=unlit)
    assert abs(spike.position - 1200.4) < 5 * spike.sigma
    light, alone = measured.light(lit, unlit), measured.light(lit)
    assert np.allclose(light.variance, alone.variance + measured.light(unlit).variance)
    rest = (light.electrons - 20_000 * gaussian(10, 1200.4)) / np.sqrt(light.variance)
    assert np.std(rest) == pytest.approx(1, abs=0.05)
    assert spike.sigma > finder(lit, windows=[(1100, 1300)])[0].sigma
    assert not light.saturated.any()


def test_full_pixels_are_known(sensor: SensorModel, measured: Correction) -> None:
    light = measured.light(captured(sensor, 150_000 * gaussian(20, 1000)))
    full = np.flatnonzero(light.saturated)
    assert full.size == np.ptp(full) + 1
    assert abs(full.mean() - 1000) < 1
    assert Correction.nominal().light(Frame(np.zeros(ELEMENTS, np.uint16))).saturated.all()


def test_a_correction_is_kept_exactly(measured: Correction) -> None:
    again = Correction.from_dict(json.loads(json.dumps(measured.to_dict())))
    assert again == measured
    assert again != Correction.nominal()
    assert measured != "a correction"
    data = measured.to_dict()
    with pytest.raises(ValueError, match="'gain' of a correction is unknown"):
        Correction.from_dict({**data, "gain": 1.0})
    del data["pattern"]
    with pytest.raises(ValueError, match="'pattern' of a correction is missing"):
        Correction.from_dict(data)


def test_a_correction_refuses(measured: Correction) -> None:
    cases: list[tuple[str, Any, str]] = [
        ("pattern", np.zeros(3), r"shape \(3648,\)"),
        ("response", np.zeros(PIXELS), "response = 0"),
        ("electrons_per_code", 0.0, "electrons_per_code = 0"),
        ("read_noise", -1.0, "read_noise"),
        ("saturation", math.nan, "saturation"),
        ("uncertainty", 1.5, "percent"),
    ]
    for name, value, words in cases:
        with pytest.raises(ValueError, match=words):
            replace(measured, **{name: value})
    with pytest.raises(ValueError, match="read-only"):
        measured.pattern[0] = 1


def test_frames_that_do_not_fit_are_refused(sensor: SensorModel) -> None:
    dark = [captured(sensor, 0.0) for _ in range(6)]
    flat = [captured(sensor, 20_000.0) for _ in range(6)]
    for darks, flats, words in (
        (dark[:3], flat, "3 dark frames: at least 4"),
        (flat, flat, "dark frame 0 is not dark"),
        ([*dark, captured(sensor, 9000 * gaussian(20, 900))], flat, "dark frame 6 is not dark"),
        (dark, dark, "flat frame 0 is too dark"),
        (dark, [captured(sensor, 70_000.0)] * 4, "flat frame 0 is saturated"),
        (dark, [*flat, captured(sensor, 20_000 + 9000 * gaussian(30, 900))], "6 is not even"),
        (dark, [captured(sensor, 20_000 + 5.0 * PLACE)] * 4, "not even|smooth shading|scatter by"),
        (dark, [captured(sensor, 5000 + 10.0 * PLACE)] * 4, "flat frame 0 is not even"),
        (dark, flat[:1] * 6, "photons must add"),
        (dark, [captured(sensor, 20_000.0, sh_period=400)] * 4, "SH periods"),
        (dark, [Frame(np.full(ELEMENTS, 7, np.uint16))] * 4, "flat frame 0: every element"),
    ):
        with pytest.raises(ValueError, match=words):
            Correction.measure(darks, flats)


# compiled code ----------------------------------------------------------------------------------


def test_nothing_is_compiled_after_loading() -> None:
    from tracking import _spikes

    def signatures() -> dict[str, int]:
        return {
            name: len(entry.signatures)
            for name, entry in vars(_spikes).items()
            if hasattr(entry, "signatures")
        }

    SpikeFinder().load_kernels()
    before = signatures()
    assert before["find"] == 1
    stack = np.stack([coded(bell(900, 10, 400)).elements] * 2, axis=1)
    for detector in DETECTORS:
        finder = SpikeFinder(detector=detector, limit=np.int64(3))  # type: ignore[arg-type]
        for frame in (coded(bell(900, 10, 400)), Frame(stack[:, 0])):
            finder(frame)
            finder(frame, windows=[(800, 1000)], unlit=coded(0.0))
            finder(frame, windows=np.array([[800.0, 1000.0]]))  # type: ignore[arg-type]
            finder.correction.light(frame, coded(0.0))
        finder.profile(list(PEAK * gaussian(9, 700)))
        finder.profile(np.arange(PIXELS)[::-1], (10, 90))
    assert signatures() == before


def test_flags_of_a_spike() -> None:
    spike = Spike(1.0, 0.1, 5.0, 100.0, SpikeFlags.DOUBLE | SpikeFlags.CLIPPED)
    assert spike.found
    assert not MISSING.found
    assert DARK.start == 16  # where the compiled code looks for the dark reference
