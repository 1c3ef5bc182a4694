"""Daylight: sunlight in lux, tilted filters, étendue both ways, limits of saturation and noise."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from raytransfer import SENSORS, TCD1304, LineSensor, prototype_head
from raytransfer.irradiance import photon_energy
from raytransfer.lenses import Aperture
from raytransfer.localisation import Noise, spike_bound
from raytransfer.outdoors import (
    DIRECT_SUNLIGHT,
    SUNLIGHT,
    BandPass,
    PixelView,
    ambient_bound,
    ambient_rate,
    electrons_per_joule,
    illuminance,
    largest_ambient,
    luminous_efficacy,
    pixel_etendue,
    pixel_view,
    saturation_ambient,
    subtraction_cost,
)
from raytransfer.sources import Spectrum
from raytransfer.systems import OpticalSystem, Placement
from raytransfer.tracing import trace

if TYPE_CHECKING:
    from collections.abc import Callable

HEAD = prototype_head()
RED = BandPass(0.63, 0.03)
SPIKE = 20_000 * np.exp(-0.5 * ((np.arange(200) - 99.7) / 12) ** 2)


# --- light as data --------------------------------------------------------------------------


def test_full_sun() -> None:
    """Against the integrals of the full ASTM G173-03 table with V(λ) in steps of 1 nm."""
    assert illuminance(SUNLIGHT) == pytest.approx(109_495, rel=1e-3)
    assert illuminance(DIRECT_SUNLIGHT) == pytest.approx(97_142, rel=1e-3)
    power = np.trapezoid(SUNLIGHT.power, SUNLIGHT.wavelengths)
    assert power == pytest.approx(804.56, rel=1e-3)
    assert SUNLIGHT.wavelengths[0] == 0.3
    assert SUNLIGHT.wavelengths[-1] == 1.1


def test_the_eye() -> None:
    assert luminous_efficacy(Spectrum.line(0.56)) == pytest.approx(683 * 0.995)
    assert luminous_efficacy(Spectrum.line(0.63)) == pytest.approx(683 * 0.265)
    assert luminous_efficacy(Spectrum.line(0.85)) == 0


def test_the_sensors_saturation_exposure() -> None:
    """0.004 lx s, the datasheet says, fills a pixel; makers of boards quote 40 to 90 ke⁻."""
    wavelengths = np.linspace(0.4, 0.7, 61)
    power = np.interp(wavelengths, SUNLIGHT.wavelengths, SUNLIGHT.power)
    visible = Spectrum(tuple(wavelengths), tuple(power))
    joules = 0.004 / luminous_efficacy(visible) * 0.008e-3 * 0.2e-3
    assert 40_000 < joules * electrons_per_joule(visible) < 60_000


# --- filters --------------------------------------------------------------------------------


def test_a_tilted_filter_moves_to_blue() -> None:
    assert RED.centre_at(0) == 0.63
    assert RED.centre_at(math.radians(26)) == pytest.approx(0.6147, abs=5e-5)
    assert RED.centre_at(-0.3) == RED.centre_at(0.3)
    assert RED.transmission(RED.centre_at(0.4), 0.4) == pytest.approx(0.9)
    # as a film of that index: inside it the angle is smaller, sin θ / n
    inside = math.asin(math.sin(0.4) / 2)
    assert RED.centre_at(0.4) == pytest.approx(0.63 * math.cos(inside))


@settings(deadline=None)
@given(st.floats(0.002, 0.2), st.integers(1, 6), st.floats(0.01, 1))
def test_width_peak_and_blocking_are_what_they_say(
    width: float, cavities: int, peak: float
) -> None:
    band = BandPass(0.63, width, peak, 1e-5, cavities=cavities)
    assert band.transmission(0.63) == pytest.approx(peak)
    half = band.transmission([0.63 - width / 2, 0.63 + width / 2])
    assert_allclose(half, (peak + 1e-5) / 2, rtol=1e-9)
    assert (band.transmission(np.linspace(0.3, 1.1, 50)) >= 1e-5).all()


def test_far_outside_a_narrow_filter() -> None:
    assert BandPass(0.63, 1e-3, cavities=100).transmission(1.1) == pytest.approx(1e-4)


def test_wavelengths_and_angles_are_broadcast() -> None:
    assert RED.transmission(np.full(5, 0.63), np.zeros((3, 1))).shape == (3, 5)
    assert electrons_per_joule(SUNLIGHT, TCD1304, RED, np.zeros((2, 3))).shape == (2, 3)
    assert electrons_per_joule(SUNLIGHT, angle=np.zeros(4)).shape == (4,)


def test_electrons_of_a_line() -> None:
    response = TCD1304.response
    assert response is not None
    expected = response.quantum_efficiency(0.63) / photon_energy(0.63)
    line = Spectrum.line(0.63)
    assert electrons_per_joule(line) == pytest.approx(expected)
    assert electrons_per_joule(line, TCD1304, RED) == pytest.approx(0.9 * expected)
    assert electrons_per_joule(Spectrum.line(0.2)) == 0


def test_sunlight_through_a_filter_is_its_density_times_an_equal_area() -> None:
    narrow = BandPass(0.5545, 0.004, blocking=0)  # where 10 nm of table are one straight line
    area = 0.9 * 0.002 * (math.pi / 3) / math.sin(math.pi / 6)  # ∫ dx / (1 + x⁶)
    line = electrons_per_joule(Spectrum.line(0.5545))
    expected = SUNLIGHT.density(0.5545) * area * line
    assert electrons_per_joule(SUNLIGHT, TCD1304, narrow) == pytest.approx(expected, rel=2e-3)


def test_an_led_fades_at_the_edge_of_the_field() -> None:
    led = Spectrum.gaussian(0.63, 0.018)
    at = electrons_per_joule(led, TCD1304, BandPass(0.63, 0.01), np.radians([0, 13, 26]))
    assert at[2] < at[0] / 4
    # the way out: wider, and on the red side, as the field moves it to blue only
    wide = electrons_per_joule(led, TCD1304, BandPass(0.638, 0.05), np.radians([0, 13, 26]))
    assert wide.min() > 0.95 * wide.max()


# --- étendue --------------------------------------------------------------------------------


def screen(
    x: float, y: float, distance: float, placement: Placement | None = None
) -> OpticalSystem:
    bare = OpticalSystem("screen", (Aperture("opening", x, y),), (), distance)
    return bare if placement is None else replace(bare, sensor_placement=placement)


POINT = LineSensor("point", 1, 1e-3, 1e-3)


@pytest.mark.parametrize(("x", "y", "distance"), [(4, 4, 20), (30, 10, 15), (60, 80, 10)])
def test_a_rectangle_before_a_pixel(x: float, y: float, distance: float) -> None:
    """Projected solid angle of a rectangle, closed form (view factor, four quarters)."""
    a, b = x / 2 / distance, y / 2 / distance
    quarter = a / math.hypot(1, a) * math.atan(b / math.hypot(1, a))
    quarter += b / math.hypot(1, b) * math.atan(a / math.hypot(1, b))
    expected = POINT.pitch * POINT.pixel_height * 2 * quarter
    assert pixel_etendue(screen(x, y, distance), 0, POINT) == pytest.approx(expected, rel=3e-3)


def test_light_for_a_pixel_beside_the_axis_comes_from_the_other_side() -> None:
    view = pixel_view(screen(1, 1, 50), float(TCD1304.pixel(10.0)), rays=20_000)
    mean = view.direction @ view.etendue / view.total
    assert_allclose(mean, np.array([10, 0, 50]) / math.hypot(10, 50), atol=1e-3)
    assert_allclose(np.linalg.norm(view.direction, axis=0), 1, rtol=1e-12)
    assert view.angle @ view.etendue / view.total == pytest.approx(math.atan(0.2), rel=1e-3)
    cos = 50 / math.hypot(10, 50)
    area = TCD1304.pitch * TCD1304.pixel_height
    expected = area * cos**2 / (50**2 + 10**2)
    assert view.total == pytest.approx(expected, rel=0.01)


def test_the_sensors_own_placement_counts() -> None:
    straight = pixel_view(screen(2, 2, 50), 0, POINT)
    tilted = pixel_view(screen(2, 2, 50, Placement((5.0, 3.0), (0.0, 0.4, 0.0))), 0, POINT)
    toward = np.array([5, 3, 50]) / np.linalg.norm([5, 3, 50])
    assert_allclose(tilted.direction @ tilted.etendue / tilted.total, toward, atol=1e-3)
    normal = Placement(tilt=(0.0, 0.4, 0.0)).rotation()[:, 2]
    expected = (toward @ normal) * toward[2] / (5**2 + 3**2 + 50**2) * 50**2
    assert tilted.total / straight.total == pytest.approx(expected, rel=0.01)


def test_no_light_no_etendue() -> None:
    far = screen(1e-3, 1e-3, 50, Placement((1000.0, 0.0)))
    view = pixel_view(far, 0, POINT)
    assert view.total == 0
    assert view.direction.shape == (3, 0)
    assert ambient_rate(view) == 0


def test_what_pixels_see_is_what_a_bright_room_sends_them() -> None:
    """Light forward, from everywhere: dx dy dl dm over the front opening, onto 30 large pixels."""
    sensor = LineSensor("large", 30, 0.97, 2.0)
    low, high = np.array([-15.5, -8, -0.8, -0.9]), np.array([15.5, 8, 0.8, 0.9])
    count = 3_000_000
    x, y, l, m = (low + np.random.default_rng(1).random((count, 4)) * (high - low)).T
    ahead = l**2 + m**2 < 0.999
    x, y, l, m = (values[ahead] for values in (x, y, l, m))
    direction = np.stack([l, m, np.sqrt(1 - l**2 - m**2)])
    # they cross the plane of the first vertex at x, y; the glass begins before it
    start = np.stack([x, y, 0 * x]) - 10 * direction / direction[2]
    light = trace(HEAD, start, direction, wavelength=0.63)
    on_line = light.arrived & (np.abs(light.y) < sensor.pixel_height / 2)
    edges = (np.arange(sensor.pixels + 1) - sensor.pixels / 2) * sensor.pitch
    forward, _ = np.histogram(light.x[on_line], edges, weights=light.transmission[on_line])
    forward *= np.prod(high - low) / count
    pixels = range(sensor.pixels)
    backward = np.array([pixel_etendue(HEAD, pixel, sensor, rays=20_000) for pixel in pixels])
    assert backward.sum() == pytest.approx(forward.sum(), rel=0.01)
    # five by five, as 1,500 random rays arrive in a pixel
    fives = (6, 5)
    assert_allclose(backward.reshape(fives).sum(1), forward.reshape(fives).sum(1), rtol=0.03)


def test_rays_enough() -> None:
    coarse, fine = (pixel_etendue(HEAD, 300, rays=rays) for rays in (60_000, 500_000))
    assert coarse == pytest.approx(fine, rel=2e-3)


def test_the_two_ends_of_the_line_see_alike() -> None:
    assert pixel_etendue(HEAD, 0) == pytest.approx(pixel_etendue(HEAD, 3647), rel=2e-3)


# --- ambient --------------------------------------------------------------------------------

VIEW = PixelView(np.array([[0.0, 0.1], [0.0, 0.2], [1.0, math.sqrt(0.95)]]), np.array([3e-4, 1e-4]))


def test_a_scene_of_one_colour() -> None:
    green = Spectrum.line(0.55)
    joules = 0.5 / math.pi / luminous_efficacy(green) * 1e-6 * 4e-4  # per lx and s
    expected = joules * 0.8 / photon_energy(0.55)
    assert ambient_rate(VIEW, albedo=0.5, spectrum=green) == pytest.approx(expected)


def test_a_filter_sees_each_direction_at_its_angle() -> None:
    line = Spectrum.line(0.63)
    steep = BandPass(0.63, 0.01)
    passed = 0.75 * 0.9 + 0.25 * steep.transmission(0.63, math.asin(math.sqrt(0.05)))
    ratio = ambient_rate(VIEW, spectrum=line, bandpass=steep) / ambient_rate(VIEW, spectrum=line)
    assert ratio == pytest.approx(passed, rel=2e-3)


def test_saturation_is_proportional() -> None:
    assert saturation_ambient(1000.0, 0.01) == pytest.approx(3500)
    assert saturation_ambient(1000.0, 0.01, signal=20_000) == pytest.approx(1500)
    assert saturation_ambient(1000.0, 0.02, noise=Noise(full_well=60_000)) == pytest.approx(3000)
    assert saturation_ambient(1000.0, 0.01, signal=36_000) == 0


def test_the_thesiss_head_outdoors() -> None:
    """Shade is 10,000 lx: without a filter it fills the pixels in the shortest integration."""
    rate = ambient_rate(pixel_view(HEAD, 1823.5))
    assert saturation_ambient(rate, 25e-6) == pytest.approx(5180, rel=0.01)
    assert saturation_ambient(rate, 1e-3) == pytest.approx(130, rel=0.01)


@pytest.mark.parametrize("subtracted", [False, True])
def test_the_largest_ambient_is_where_the_bound_is_reached(subtracted: bool) -> None:
    rate, time = 2e5, 25e-6
    lux = largest_ambient(SPIKE, 0.03, rate, time, subtracted=subtracted)
    noise, background = Noise(), lux * rate * time
    assert 0 < background < 15_000
    # lit and unlit, each with its photons, its read-out and its quantisation
    extra = noise.variance(background) if subtracted else 0.0
    both = replace(noise, read_noise=math.sqrt(noise.read_noise**2 + float(extra)))
    assert spike_bound(SPIKE, both, background=background) == pytest.approx(0.03, rel=2e-3)
    assert largest_ambient(SPIKE, 0.05, rate, time, subtracted=subtracted) > lux
    assert largest_ambient(SPIKE, 0.03, rate, 2 * time, subtracted=subtracted) == pytest.approx(
        lux / 2
    )


@pytest.mark.parametrize("subtracted", [False, True])
def test_pixels_are_full_in_one_frame_not_in_the_difference(subtracted: bool) -> None:
    flat = np.where(np.abs(np.arange(60) - 29.5) < 10, 20_000.0, 0.0)
    # the margin of three deviations is one frame's: B + 20,000 + 3 √variance = full well
    noise = Noise()
    last = 14_413.6
    assert last + 20_000 + 3 * math.sqrt(noise.variance(last + 20_000)) == pytest.approx(
        noise.saturation, abs=1
    )

    def bound(background: float) -> float:
        return ambient_bound(flat, background, subtracted=subtracted)

    extra = float(noise.variance(last - 2)) if subtracted else 0.0
    endless = replace(noise, full_well=1e6, read_noise=math.sqrt(noise.read_noise**2 + extra))
    assert bound(last - 2) == pytest.approx(spike_bound(flat, endless, background=last - 2))
    assert bound(last + 2) > 1.2 * bound(last - 2)
    wanted = 1.1 * bound(last - 2)
    lux = largest_ambient(flat, wanted, 1e5, 25e-6, subtracted=subtracted)
    assert lux * 1e5 * 25e-6 == pytest.approx(last, abs=1e-4 * noise.saturation)


def test_subtraction_lowers_the_largest_ambient() -> None:
    once, twice = (largest_ambient(SPIKE, 0.03, 2e5, 25e-6, subtracted=s) for s in (False, True))
    assert twice < once


def test_no_ambient_is_allowed_where_darkness_does_not_suffice() -> None:
    assert largest_ambient(SPIKE, 1e-3, 2e5, 25e-6) == 0


def test_subtraction_costs_what_two_readings_scatter() -> None:
    rng = np.random.default_rng(3)
    noise = Noise(electrons_per_code=1e-3)
    for signal, background in ((0, 0), (20_000, 500), (5_000, 10_000)):
        lit, unlit = (
            rng.poisson(mean, 200_000) + rng.normal(0, noise.read_noise, 200_000)
            for mean in (signal + background, background)
        )
        expected = np.std(lit - unlit) / np.std(lit)
        assert subtraction_cost(signal, background, noise) == pytest.approx(expected, rel=0.01)
    assert subtraction_cost(0, [0, 1e6]) == pytest.approx(math.sqrt(2))
    assert subtraction_cost(1e9, 0) == pytest.approx(1, abs=1e-5)


# --- refusals -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: BandPass(630, 10), r"^centre of the filter = 630 µm: .*nm"),
        (lambda: BandPass(0.63, 10), r"^width of the filter = 10 µm: .*nm"),
        (lambda: BandPass(0.63, 0), r"^width of the filter = 0: "),
        (lambda: BandPass(0.63, 0.01, 90), r"^peak of the filter = 90: .*percent"),
        (lambda: BandPass(0.63, 0.01, blocking=4), r"^blocking of the filter = 4: .*density"),
        (lambda: BandPass(0.63, 0.01, effective_index=0.5), "refractive index is 1 or more"),
        (lambda: BandPass(0.63, 0.01, cavities=0), "cavities of the filter = 0"),
        (lambda: RED.transmission(0.63, 26), r"^angle = 26: .*degrees"),
        (lambda: RED.transmission(-0.63), "wavelengths are in µm"),
        (lambda: electrons_per_joule(SUNLIGHT, SENSORS["TCD1703"]), "TCD1703: .*no response"),
        (lambda: pixel_view(HEAD, 3648), r"^pixel = 3648: TCD1304 has 0 to 3647"),
        (lambda: pixel_view(replace(HEAD, sensor_distance=None), 0), "sensor_distance is needed"),
        (lambda: ambient_rate(VIEW, albedo=20), r"^albedo = 20: .*percent"),
        (lambda: saturation_ambient(1e5, 0), r"^integration_time = 0: .*s"),
        (lambda: saturation_ambient(0, 1), r"^rate = 0: "),
        (lambda: saturation_ambient(1e5, 1, signal=-1), r"^signal = -1: "),
        (lambda: largest_ambient(SPIKE, 0, 1e5, 1), r"^wanted = 0: "),
        (lambda: subtraction_cost(-1, 0), "= -1"),
    ],
)
def test_what_cannot_be_is_refused(make: Callable[[], Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()
