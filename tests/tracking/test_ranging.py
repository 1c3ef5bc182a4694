"""Distance of a single LED by the width of its spike: inverse, error bars, limits."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from raytransfer.designs import DESIGNS
from raytransfer.irradiance import disc, disc_image, disc_points, pixel_response
from raytransfer.tolerances import Tolerances, perturb
from tracking.camera import Camera
from tracking.poses import Prior, optical
from tracking.ranging import RELATIVE_LIMIT, WIDTH_NOISE, RangeFinder, RangeFlags
from tracking.spikes import Spike, SpikeFinder, SpikeFlags

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[np.float64]

CAMERA = Camera(4200.0, 1820.0, (-0.42, 0.19))
DISTANCES = 1 / np.linspace(1 / 300, 1 / 6000, 60)
TANGENTS = np.linspace(-0.4, 0.4, 9)
FOCUS = 2500.0


def blur(distance: Any, tangent: Any) -> Any:
    """Width of a head in focus at 2.5 m (nearer aside), px."""
    focus = FOCUS * (1 - 0.5 * np.asarray(tangent) ** 2)
    return np.hypot(2.0, 30_000.0 * (1 / np.asarray(distance) - 1 / focus))


@pytest.fixture(scope="module")
def table() -> RangeFinder:
    return RangeFinder(
        CAMERA, DISTANCES, TANGENTS, blur(*np.meshgrid(DISTANCES, TANGENTS, indexing="ij")), 0.05
    )


def spike(distance: float, tangent: float, *, sigma: float = 0.01, width: float = 0.0) -> Spike:
    """What the head with that blur shows."""
    position = CAMERA.project([-tangent * distance, 0.0, distance])
    return Spike(float(position), sigma, width or float(blur(distance, tangent)), 20_000.0)


@pytest.mark.parametrize("tangent", [0.0, -0.13, 0.37])
@pytest.mark.parametrize("distance", [350.0, 700.0, 1200.0])
def test_width_gives_the_distance_near_by(
    table: RangeFinder, distance: float, tangent: float
) -> None:
    found = table(spike(distance, tangent))
    step = 1.0
    slope = (blur(distance + step, tangent) - blur(distance - step, tangent)) / (2 * step)
    assert found.sigma == pytest.approx(math.hypot(0.05, WIDTH_NOISE * 0.01) / abs(slope), rel=0.15)
    assert found.distance == pytest.approx(distance, abs=0.5 * found.sigma)
    assert found.flags == RangeFlags.NONE


def test_two_sides_of_the_focus_are_both_told(table: RangeFinder) -> None:
    far = 4500.0
    near = 1 / (2 / FOCUS - 1 / far)
    found = table(spike(far, 0.0))
    assert RangeFlags.AMBIGUOUS in found.flags
    assert [b.distance for b in found.branches] == pytest.approx([near, far], rel=0.03)
    assert sum(b.probability for b in found.branches) == pytest.approx(1.0, abs=0.01)
    # a rough idea of the distance decides
    for value in (near, far):
        decided = table(spike(far, 0.0), Prior(value, 500.0))
        assert decided.flags == RangeFlags.NONE
        assert decided.distance == pytest.approx(value, rel=0.03)
        assert len(decided.branches) == 1


def test_in_focus_and_far_away_it_says_that_it_is_useless(table: RangeFinder) -> None:
    noisy = table(spike(FOCUS, 0.0, sigma=0.3))
    assert RangeFlags.USELESS in noisy.flags
    assert noisy.sigma > 0.2 * FOCUS
    useful = table.useful(0.0, sigma=0.3)
    assert useful[table.distances < 1000].all()
    assert not useful[np.abs(table.distances - FOCUS) < 50].any()


@pytest.mark.parametrize("sigma", [0.1, 0.3])
def test_useful_is_where_a_spike_is_not_told_to_be_useless(
    table: RangeFinder, sigma: float
) -> None:
    useful = table.useful(0.0, sigma)
    for number in range(0, len(useful), 50):
        told = table(spike(table.distances[number], 0.0, sigma=sigma))
        assert useful[number] == (RangeFlags.USELESS not in told.flags)
    assert 0 < useful.sum() < len(useful)


@pytest.mark.parametrize("flag", [SpikeFlags.MISSING, SpikeFlags.SATURATED, SpikeFlags.REFLECTION])
def test_spikes_without_a_width_leave_the_distance_open(
    table: RangeFinder, flag: SpikeFlags
) -> None:
    found = table(replace(spike(800.0, 0.0), flags=flag))
    assert RangeFlags.UNFIT | RangeFlags.USELESS in found.flags
    assert found.sigma == pytest.approx((6000 - 300) / math.sqrt(12), rel=0.02)
    with_prior = table(replace(spike(800.0, 0.0), flags=flag), Prior(900.0, 100.0))
    assert (with_prior.distance, with_prior.sigma) == pytest.approx((900.0, 100.0), rel=0.02)


def test_widths_that_no_distance_explains(table: RangeFinder) -> None:
    wide = table(spike(800.0, 0.0, width=300.0))
    assert RangeFlags.UNEXPLAINED | RangeFlags.USELESS in wide.flags
    aside = table(spike(800.0, 0.44))
    assert RangeFlags.OUTSIDE | RangeFlags.USELESS in aside.flags


def test_place_and_its_covariance(table: RangeFinder) -> None:
    """Errors of 400 places over what the covariance says, heading known to half a degree."""
    rng = np.random.default_rng(2)
    led, pose = np.array([300.0, 50.0, 0.0]), (150.0, 1000.0, 0.2)
    (x, _, distance) = optical(led[None], *pose)[0]
    clean = spike(distance, -x / distance, sigma=0.02)
    heading = math.radians(0.5)
    exact = table.place(clean, led, Prior(pose[2], 0.0))
    assert (exact.x, exact.y) == pytest.approx(pose[:2], abs=1.0)
    ratios = []
    for _ in range(400):
        error = rng.standard_normal(3)
        shown = replace(
            clean,
            position=clean.position + 0.02 * error[0],
            width=clean.width + math.hypot(0.05, WIDTH_NOISE * 0.02) * error[1],
        )
        place = table.place(shown, led, Prior(pose[2] + heading * error[2], heading))
        off = np.array([place.x - pose[0], place.y - pose[1]])
        ratios.append(off @ np.linalg.solve(place.covariance, off))
    # χ² of 2 degrees, 400 times: its mean is 2 ± 0.1
    assert 1.7 < np.mean(ratios) < 2.3


def test_a_disc_is_what_many_points_make() -> None:
    """Convolved with the chords of its image; the same as the LED traced point by point."""
    system = DESIGNS["slit-f50-f100"].system
    camera = Camera(4191.0, 1823.5, (-0.42, 0.194))
    place, extent = (-200.0, 0.0, 800.0), 3.0
    light = pixel_response(system, place, wavelength=0.63)
    points = disc(place, extent, disc_points(system, extent, place[2]))
    whole = np.sum([s * pixel_response(system, p, wavelength=0.63) for p, s in points], axis=0)
    kernel = disc_image(extent * abs(float(camera.jacobian(place)[0])))
    finder = SpikeFinder()
    widths = [
        finder.profile(profile * (24_500 / profile.max())).width
        for profile in (np.convolve(light, kernel, "same"), whole)
    ]
    assert widths[0] == pytest.approx(widths[1], rel=0.01)


class Head:
    """A head as made, and the spikes that it shows of LEDs 2 mm across."""

    def __init__(self, name: str, seed: int) -> None:
        self.rng = np.random.default_rng(seed)
        self.system = perturb(DESIGNS[name].system, Tolerances(), self.rng)
        self.finder = SpikeFinder()

    def light(self, distance: float, tangent: float) -> Array:
        """Electrons of an LED, without noise."""
        place = (-tangent * distance, 0.0, distance)
        light = pixel_response(self.system, place, wavelength=0.63, rays=(256, 64))
        light = np.convolve(light, disc_image(2.0 * 4200.0 / distance), "same")
        return np.asarray(light * (24_500 / light.max()))

    def spikes(self, count: int, near: float, far: float) -> list[tuple[float, Spike]]:
        found: list[tuple[float, Spike]] = []
        while len(found) < count:
            distance = self.rng.uniform(near, far)
            light = self.light(distance, self.rng.uniform(-0.36, 0.36))
            charge = self.rng.poisson(light) + self.rng.normal(0, 60, light.size)
            spike = self.finder.profile(charge)
            if spike.found and not spike.flags & (SpikeFlags.CLIPPED | SpikeFlags.REFLECTION):
                found.append((distance, spike))
        return found


def coverage(finder: RangeFinder, spikes: list[tuple[float, Spike]]) -> Array:
    """Errors over σ."""
    ranges = [finder(s) for _, s in spikes]
    return np.array([(r.distance - d) / r.sigma for r, (d, _) in zip(ranges, spikes, strict=True)])


@pytest.fixture(scope="module")
def drawn() -> RangeFinder:
    return RangeFinder.from_system(DESIGNS["slit-f50-f100"].system, CAMERA)


@pytest.fixture(scope="module")
def others() -> list[tuple[float, Spike]]:
    """Of 150 heads, none of which is among those that the spread is from; 8 LEDs each.

    The errors of a head's spikes are much the same, and the table takes all distances from 300 to
    6000 mm as equally probable: many heads, and distances drawn as that says.
    """
    heads = (Head("slit-f50-f100", seed) for seed in range(100, 250))
    return [found for head in heads for found in head.spikes(8, 300, 6000)]


def test_error_bars_of_the_drawing_hold_for_heads_as_made(
    drawn: RangeFinder, others: list[tuple[float, Spike]]
) -> None:
    off = coverage(drawn, others)
    told = np.array([RangeFlags.USELESS not in drawn(s).flags for _, s in others])
    assert told.sum() > 100
    # a bar that is too long is as wrong as one that is too short
    for part in (off, off[told], off[~told]):
        assert 0.6 < np.mean(np.abs(part) < 1) < 0.76
        assert np.mean(np.abs(part) < 2) > 0.9
        assert 0.85 < np.sqrt(np.mean(part**2)) < 1.15


def test_a_drawing_ranges_up_to_little_more_than_a_metre(
    drawn: RangeFinder, others: list[tuple[float, Spike]]
) -> None:
    useful = drawn.useful()
    end = drawn.distances[useful].max()
    assert 1100 < end < 1300
    assert useful[drawn.distances <= end].all()
    # where σ is said to be about the limit, errors are that large
    ranges = [(drawn(s), d) for d, s in others]
    limit = [
        (r.distance - d) / r.distance
        for r, d in ranges
        if 0.75 < r.sigma / r.distance / RELATIVE_LIMIT < 1.25 and r.distance < 2000
    ]
    assert len(limit) > 40
    assert np.sqrt(np.mean(np.square(limit))) == pytest.approx(RELATIVE_LIMIT, rel=0.25)


def test_far_away_a_drawing_says_little(
    drawn: RangeFinder, others: list[tuple[float, Spike]]
) -> None:
    """Beyond 2 m; σ is within the limit only where the end of the table bounds it."""
    far = [drawn(s) for d, s in others if d > 2000]
    share = np.array([r.sigma / r.distance for r in far])
    assert np.median([r.sigma for r in far]) > 800
    assert share.min() > 0.15
    assert np.median(share) > 0.25
    told = [r for r in far if RangeFlags.USELESS not in r.flags]
    assert 0 < len(told) < 0.15 * len(far)
    assert all(r.distance + 2 * r.sigma > 6000 for r in told)


def test_a_spread_of_few_heads_is_students() -> None:
    """Three heads: √3 times the root mean square of their deviations."""
    seed, at, m = 4, [500.0, 700.0, 1000.0, 1500.0], -0.42
    system = DESIGNS["slit-f50-f100"].system
    finder = RangeFinder.from_system(system, CAMERA, distances=at, heads=3, seed=seed)
    head = Head("slit-f50-f100", 0)

    def width() -> float:
        return head.finder.profile(head.light(at[0], m)).width

    head.system = system
    exact = width()
    off = []
    for draw in np.random.SeedSequence(seed).spawn(3):
        head.system = perturb(system, Tolerances(), np.random.default_rng(draw))
        off.append(width() - exact)
    expected = math.hypot(math.sqrt(3 * np.mean(np.square(off))), 0.01 * exact)
    assert finder.spread[0, 0] == pytest.approx(expected, rel=0.03)


def test_error_bars_of_captures_hold() -> None:
    """One head, measured; judged by other spikes of the same head."""
    head = Head("slit-f50-f100", 3)
    taken, others = head.spikes(120, 400, 4500), head.spikes(120, 450, 4000)
    d, positions, widths = np.array([(d, s.position, s.width) for d, s in taken]).T
    widths[5] += 40.0  # a reflection
    finder = RangeFinder.from_captures(CAMERA, d, positions, widths, drift=0.0)
    inside = [(d, s) for d, s in others if not finder(s).flags & RangeFlags.OUTSIDE]
    assert len(inside) > 110
    off = np.abs(coverage(finder, inside))
    assert np.mean(off < 1) > 0.6
    assert np.mean(off < 2) > 0.9
    near = np.array([finder(s).distance - d for d, s in inside if d < 1300])
    assert np.median(np.abs(near)) < 10
    drifted = RangeFinder.from_captures(CAMERA, d, positions, widths, drift=0.4)
    assert drifted(inside[0][1]).sigma > 2 * finder(inside[0][1]).sigma


def test_what_is_refused(table: RangeFinder) -> None:
    good = spike(800.0, 0.1)
    with pytest.raises(ValueError, match="σ of the expected distance = 0"):
        table(good, Prior(800.0, 0.0))
    with pytest.raises(ValueError, match="widths are known from 300 to 6000 mm"):
        table(good, Prior(20_000.0, 10.0))
    with pytest.raises(ValueError, match="one LED does not tell where a tracker looks"):
        table.place(good, [0.0, 0.0], Prior(0.0, math.inf))
    with pytest.raises(ValueError, match="led has shape"):
        table.place(good, [0.0])
    with pytest.raises(ValueError, match="has no direction"):
        table.place(replace(good, flags=SpikeFlags.MISSING), [0.0, 0.0])
    with pytest.raises(ValueError, match=r"not \(3, 9\)"):
        RangeFinder(CAMERA, DISTANCES, TANGENTS, np.ones((3, 9)), 0.1)
    with pytest.raises(ValueError, match="four or more of each are needed, rising"):
        RangeFinder(CAMERA, DISTANCES[::-1], TANGENTS, np.ones((60, 9)), 0.1)
    with pytest.raises(ValueError, match="10 spikes: 51 or more"):
        RangeFinder.from_captures(CAMERA, np.ones(10), np.ones(10), np.ones(10))
    with pytest.raises(ValueError, match="both must vary"):
        RangeFinder.from_captures(CAMERA, np.full(90, 900.0), np.arange(90.0), np.ones(90))
    with pytest.raises(ValueError, match="one of each for every spike"):
        RangeFinder.from_captures(CAMERA, np.ones(60), np.ones(61), np.ones(60))
    with pytest.raises(ValueError, match="take a smaller half_field"):
        RangeFinder.from_system(DESIGNS["slit-4mm"].system, CAMERA, half_field=0.9, heads=3)
    with pytest.raises(ValueError, match="heads = 2: of fewer than 3"):
        RangeFinder.from_system(DESIGNS["slit-4mm"].system, CAMERA, heads=2)
