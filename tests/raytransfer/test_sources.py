"""Sources of light: normalisation, closed forms, refusals."""

from __future__ import annotations

import math
import pickle
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from raytransfer.sources import Emitter, Lobe, Spectrum

if TYPE_CHECKING:
    from collections.abc import Callable

TRIANGLE = Spectrum((0.6, 0.62, 0.66), (0.0, 1.0, 0.0))
BATWING = Lobe.measured(np.radians([0, 20, 50, 80]), [0.6, 0.8, 1.0, 0.1])

spectra = st.builds(
    lambda start, widths, power: Spectrum(
        tuple(start + np.concatenate([[0.0], np.cumsum(widths)])), tuple(power[: len(widths) + 1])
    ),
    st.floats(0.3, 0.8),
    st.lists(st.floats(0.001, 0.1), min_size=1, max_size=8),
    st.lists(st.floats(0.0, 5.0), min_size=9, max_size=9).map(lambda p: [p[0] + 0.1, *p[1:]]),
)


# --- spectrum -------------------------------------------------------------------------------


def test_a_line_is_one_wavelength() -> None:
    line = Spectrum.line(0.63)
    for n in (1, 7):
        wavelengths, shares = line.samples(n)
        assert wavelengths.tolist() == [0.63]
        assert shares.tolist() == [1.0]
    assert line.mean == 0.63
    with pytest.raises(ValueError, match=r"line at 0\.63 µm has no power per µm"):
        line.density(0.63)


def test_an_leds_bell_curve() -> None:
    led = Spectrum.gaussian(0.63, 0.02)
    assert led.mean == pytest.approx(0.63, rel=1e-12)
    assert_allclose(led.density([0.62, 0.64]) / led.density(0.63), 0.5, rtol=0.003)
    # of a normal distribution, except for what is cut off beyond 3.5 sigma
    sigma = 0.02 / math.sqrt(8 * math.log(2))
    assert led.density(0.63) == pytest.approx(1 / (math.sqrt(2 * math.pi) * sigma), rel=0.002)
    assert led.density([0.59, 0.67]).tolist() == [0, 0]
    wavelengths, _ = led.samples(400)
    assert wavelengths.std() == pytest.approx(sigma, rel=0.01)


@settings(deadline=None)
@given(spectra, st.integers(1, 12))
def test_samples_keep_power_and_mean_wavelength(spectrum: Spectrum, n: int) -> None:
    wavelengths, shares = spectrum.samples(n)
    assert wavelengths.shape == shares.shape == (n,)
    assert shares.sum() == pytest.approx(1, rel=1e-12)
    assert (np.diff(wavelengths) > 0).all()
    assert wavelengths @ shares == pytest.approx(spectrum.mean, rel=1e-9)
    fine = np.linspace(spectrum.wavelengths[0], spectrum.wavelengths[-1], 20_001)
    fine = np.union1d(fine, spectrum.wavelengths)
    density = spectrum.density(fine)
    assert np.trapezoid(density, fine) == pytest.approx(1, rel=1e-9)
    assert np.trapezoid(density * fine, fine) == pytest.approx(spectrum.mean, rel=1e-6)


def test_samples_have_equal_power() -> None:
    wavelengths, _ = TRIANGLE.samples(3)
    # a third is reached at 0.62 exactly; the falling side holds 2/3 and its half lies beyond
    # 0.66 − 0.04 / √2
    cut = 0.66 - 0.04 / math.sqrt(2)
    assert wavelengths[0] == pytest.approx(0.6 + 0.02 * 2 / 3, rel=1e-12)
    assert wavelengths[2] == pytest.approx(0.66 - (0.66 - cut) * 2 / 3, rel=1e-12)


def test_a_dark_gap_is_no_place_for_samples() -> None:
    two = Spectrum((0.40, 0.41, 0.42, 0.60, 0.61, 0.62), (0, 1, 0, 0, 1, 0))
    assert_allclose(two.samples(2)[0], [0.41, 0.61], rtol=1e-12)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Spectrum.line(630), r"= 630 µm: allowed are 0\.1 to 20 µm; was it given in nm\?"),
        (lambda: Spectrum.gaussian(630, 20), r"^peak = 630 µm: .*nm"),
        (lambda: Spectrum.gaussian(0.63, 20), r"^fwhm = 20 µm: .*nm"),
        (lambda: Spectrum.gaussian(0.63, 0), r"^fwhm = 0: allowed is > 0"),
        (lambda: Spectrum((400, 500), (1, 1)), "given in nm"),
        (lambda: Spectrum((0.5, 0.4), (1, 1)), "rise"),
        (lambda: Spectrum((0.5, 0.5), (1, 1)), "rise"),
        (lambda: Spectrum((0.4, 0.5), (1, -0.1)), r"power of the spectrum = -0\.1: .*>= 0"),
        (lambda: Spectrum((0.4, 0.5), (0, 0)), "nothing is sent"),
        (lambda: Spectrum((0.4, 0.5), (1,)), "as many powers as wavelengths"),
        (lambda: Spectrum((), ()), "1 or more"),
        (lambda: Spectrum((0.4, math.nan), (1, 1)), "finite"),
        (lambda: Spectrum((0.4, 0.5), (1, math.inf)), "finite"),
        (lambda: TRIANGLE.samples(0), "n = 0"),
    ],
)
def test_spectra_that_cannot_be_are_refused(make: Callable[[], Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()


# --- lobe -----------------------------------------------------------------------------------


def sphere_integral(lobe: Lobe) -> float:
    """∫ I dΩ, by the midpoint rule over the angle."""
    theta = (np.arange(100_000) + 0.5) * np.pi / 100_000
    return float(2 * np.pi * (lobe.intensity(np.cos(theta)) * np.sin(theta)).mean() * np.pi)


def test_lambert() -> None:
    lobe = Lobe.lambertian()
    assert_allclose(lobe.intensity([1, 0.5, 0, -0.3]), [1 / np.pi, 0.5 / np.pi, 0, 0], rtol=1e-15)
    assert_allclose(lobe.table(5), (1 - np.linspace(0, 1, 5) ** 2) / np.pi, rtol=1e-15)
    # within a cone of half-angle α: sin² α
    theta = (np.arange(10_000) + 0.5) / 10_000 * np.radians(30)
    cone = (lobe.intensity(np.cos(theta)) * np.sin(theta)).mean() * np.radians(30) * 2 * np.pi
    assert cone == pytest.approx(math.sin(np.radians(30)) ** 2, rel=1e-6)


@pytest.mark.parametrize("lobe", [Lobe(), BATWING, Lobe.measured([0, 0.2], [1, 1])])
def test_one_watt_goes_out(lobe: Lobe) -> None:
    assert sphere_integral(lobe) == pytest.approx(1, rel=1e-4)


def test_a_measured_cosine_is_lambertian() -> None:
    angles = np.linspace(0, np.pi / 2, 181)
    measured = Lobe.measured(angles, 7 * np.cos(angles))
    cosine = np.linspace(-1, 1, 101)
    assert_allclose(measured.intensity(cosine), Lobe().intensity(cosine), rtol=1e-4, atol=1e-6)


def test_an_even_hemisphere() -> None:
    even = Lobe.measured([0, np.pi / 2], [3, 3])
    assert_allclose(even.intensity([1, 0.3, 1e-9]), 1 / (2 * np.pi), rtol=1e-12)
    assert even.intensity(-1e-6) == 0
    assert even.intensity(1 + 1e-12) == pytest.approx(1 / (2 * np.pi))


def test_a_lobe_ends_with_its_last_angle() -> None:
    cone = Lobe.measured([0, 0.3], [1, 1])
    assert cone.intensity(math.cos(0.31)) == 0
    assert cone.intensity(1) == pytest.approx(1 / (2 * np.pi * (1 - math.cos(0.3))))


@pytest.mark.parametrize("shape", [(), (4,), (2, 3), (0,)])
def test_intensities_keep_their_shape(shape: tuple[int, ...]) -> None:
    for lobe in (Lobe(), BATWING):
        assert lobe.intensity(np.ones(shape)).shape == shape


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Lobe.measured([0, 30, 60], [1, 0.9, 0.5]), r"= 60: .*π/2 rad; .*degrees"),
        (lambda: Lobe.measured([0.1, 0.5], [1, 0.9]), "rise from 0"),
        (lambda: Lobe.measured([0, 0.5, 0.4], [1, 1, 1]), "rise from 0"),
        (lambda: Lobe.measured([0, 0.5], [1, -0.1]), r"= -0\.1: allowed is >= 0"),
        (lambda: Lobe.measured([0, 0.5], [0, 0]), "nothing is sent"),
        (lambda: Lobe.measured([0, 0.5], [1]), "as many intensities as angles"),
        (lambda: Lobe.measured([0], [1]), "2 or more"),
        (lambda: Lobe().intensity(30), r"cosine = 30: .*was the angle given"),
        (lambda: Lobe().intensity(-1.2), r"cosine = -1\.2: "),
        (lambda: Lobe().table(1), "n = 1"),
    ],
)
def test_lobes_that_cannot_be_are_refused(make: Callable[[], Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()


# --- emitter --------------------------------------------------------------------------------


def test_what_is_taken_for_an_led_when_nothing_is_said() -> None:
    emitter = Emitter()
    assert (emitter.power, emitter.extent) == (0.25, 0.0)
    assert emitter.spectrum == Spectrum.line(0.63)
    assert emitter.lobe == Lobe.lambertian()


def test_sources_compare_hash_and_pickle() -> None:
    one = Emitter(1.0, Spectrum.gaussian(0.63, 0.02), BATWING, 2.0)
    other = Emitter(1.0, Spectrum.gaussian(0.63, 0.02), BATWING, 2.0)
    assert one == other
    assert len({one, other, Emitter()}) == 2
    assert pickle.loads(pickle.dumps(one)) == one  # noqa: S301
    assert Spectrum([0.4, 0.5], [1, 2]) == Spectrum((0.4, 0.5), (1, 2))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"power": 0}, r"^power of the emitter = 0: .*W"),
        ({"power": -1}, r"^power of the emitter = -1"),
        ({"power": math.nan}, "finite"),
        ({"extent": -1}, r"^extent of the emitter = -1: .*mm"),
    ],
)
def test_emitters_that_cannot_be_are_refused(values: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Emitter(**values)


def test_parts_of_another_kind_are_refused() -> None:
    wavelength: Any = 0.63
    with pytest.raises(TypeError, match=r"^spectrum of the emitter = 0\.63: a Spectrum is needed"):
        Emitter(spectrum=wavelength)
    with pytest.raises(TypeError, match=r"^lobe of the emitter = 'Lambert': a Lobe is needed"):
        Emitter(lobe="Lambert")  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="wavelengths: a sequence of numbers"):
        Spectrum(wavelength, (1.0,))
