"""Poses: exact without noise, scattering as they say with it, and honest about what they cannot tell."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from raytransfer.designs import DESIGNS
from raytransfer.irradiance import irradiance
from raytransfer.localisation import pinhole_jacobian, pose_bound
from raytransfer.sources import Emitter
from raytransfer.studies import room_to_optical
from tracking.camera import Camera
from tracking.leds import LedMap
from tracking.poses import (
    PoseFlags,
    Prior,
    closed_form,
    dilution,
    load_kernels,
    locate,
    optical,
    pose_jacobian,
    two_leds,
)
from tracking.spikes import SpikeFinder

if TYPE_CHECKING:
    from numpy.typing import NDArray

CAMERA = Camera(
    4189.0, 1823.5, (-0.418, 0.192), (-0.473, 0.115), pupil=0.1, depth=52.0, elevation=0.4
)
"""Nearly that of the head with the slit, which tests of the camera trace."""

WALL = LedMap.line(9, 300.0, 200.0).positions
UNKNOWN = Prior(0.0, math.inf)


def spikes_at(
    leds: NDArray[np.float64], *pose: float, camera: Camera = CAMERA
) -> NDArray[np.float64]:
    return camera.project(optical(leds, *pose))


def layouts(count: int, seed: int) -> list[tuple[NDArray[np.float64], tuple[float, float, float]]]:
    """Random LEDs and trackers over the area, LEDs in the field of view and in front."""
    rng = np.random.default_rng(seed)
    found: list[tuple[NDArray[np.float64], tuple[float, float, float]]] = []
    while len(found) < count:
        n = int(rng.integers(3, 10))
        leds = np.column_stack(
            [rng.uniform(-1200, 1200, n), rng.uniform(-400, 400, n), np.zeros(n)]
        )
        pose = (rng.uniform(-800, 800), rng.uniform(1300, 4150), rng.uniform(-0.3, 0.3))
        at = optical(leds, *pose)
        if (at[:, 2] > 300).all() and np.abs(at[:, 0] / at[:, 2]).max() < 0.6:
            found.append((leds, pose))
    return found


def heading_share(leds: NDArray[np.float64], pose: tuple[float, float, float]) -> float:
    """Part of the heading's information that is left when x and y are unknown."""
    rows = pose_jacobian(Camera.pinhole(28.0), leds, *pose)
    turn = rows[:, 2]
    rest = turn - rows[:, :2] @ np.linalg.lstsq(rows[:, :2], turn, rcond=None)[0]
    return float(rest @ rest / (turn @ turn))


def test_optical_is_the_workbenchs_room_with_height() -> None:
    rng = np.random.default_rng(1)
    leds = rng.uniform(-1000, 1000, (5, 3))
    x, y = rng.uniform(-500, 500, (2, 4, 1)), rng.uniform(1300, 4000, 3)
    points = optical(leds, x[0], y, 0.3, 120.0)
    offset, distance = room_to_optical(leds[:, :2], x[0], y, 0.3)
    assert points.shape == (4, 3, 5, 3)
    np.testing.assert_allclose(points[..., 0], np.moveaxis(offset, 0, -1), atol=1e-9)
    np.testing.assert_allclose(points[..., 2], np.moveaxis(distance, 0, -1), atol=1e-9)
    assert (points[..., 1] == leds[:, 2] - 120.0).all()


def test_an_led_at_larger_x_has_the_larger_pixel() -> None:
    assert (np.diff(spikes_at(LedMap.line(5, 300.0).positions, 50.0, 2500.0, 0.05)) > 0).all()


def test_pose_jacobian_is_that_of_differences_and_of_the_pinhole() -> None:
    x, y, heading = 120.0, 2100.0, -0.13
    pose = np.array([x, y, heading])
    rows = pose_jacobian(CAMERA, WALL, x, y, heading, 250.0)
    for axis, step in enumerate((1e-2, 1e-2, 1e-6)):
        ahead, behind = pose.copy(), pose.copy()
        ahead[axis] += step
        behind[axis] -= step
        slope = (spikes_at(WALL, *ahead, 250.0) - spikes_at(WALL, *behind, 250.0)) / (2 * step)
        np.testing.assert_allclose(rows[:, axis], slope, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(
        np.abs(pose_jacobian(Camera.pinhole(28.0), WALL, x, y, heading)),
        np.abs(pinhole_jacobian(WALL[:, :2], x, y, heading, focal_length=28.0)),
        rtol=1e-10,
    )


def test_closed_form_is_exact_all_over_the_area() -> None:
    worst = 0.0
    for leds, pose in layouts(3000, 2):
        at = optical(leds, *pose)
        found = closed_form(-at[:, 0] / at[:, 2], leds[:, :2])
        error = np.abs(np.subtract(found, pose)).max()
        share = heading_share(leds, pose)
        if share > 1e-3:
            worst = max(worst, error)
        # the nearer to a danger circle, the more rounding matters
        assert error * share < 1e-10
    assert 0 < worst < 1e-9


def test_closed_form_with_known_heading_needs_two_leds() -> None:
    leds = np.array([[-250.0, 0.0, 0.0], [250.0, 0.0, 0.0]])
    at = optical(leds, 130.0, 2000.0, 0.1)
    found = closed_form(-at[:, 0] / at[:, 2], leds[:, :2], heading=0.1)
    np.testing.assert_allclose(found, (130.0, 2000.0, 0.1), atol=1e-9)
    camera = replace(CAMERA, pupil=-15.0)
    x, y = two_leds(camera, leds, spikes_at(leds, 130.0, 2000.0, 0.1, camera=camera), 0.1)
    assert (x, y) == pytest.approx((130.0, 2000.0), abs=1e-8)


@pytest.mark.parametrize("pose", [(0.0, 1300.0, 0.0), (400.0, 2500.0, -0.1), (-600.0, 4150.0, 0.1)])
def test_scatter_of_the_closed_form_is_the_bound(pose: tuple[float, float, float]) -> None:
    seen = WALL[CAMERA.sees(optical(WALL, *pose))]
    clean = spikes_at(seen, *pose)
    sigma = np.linspace(0.02, 0.05, len(seen))
    covariance = pose_bound(pose_jacobian(CAMERA, seen, *pose), sigma).covariance
    slope = np.abs(np.gradient(CAMERA.tangent(clean + np.array([[-0.5], [0.5]])), axis=0)[0])
    rng = np.random.default_rng(3)
    found = np.array(
        [
            closed_form(CAMERA.tangent(clean + sigma * noise), seen[:, :2], sigma * slope)
            for noise in rng.normal(size=(3000, len(seen)))
        ]
    )
    # 3000 runs tell a standard deviation to 1.3 %
    np.testing.assert_allclose(found.std(axis=0), np.sqrt(np.diag(covariance)), rtol=0.08)
    root = np.linalg.cholesky(covariance)
    # to a tenth of σ the mean is the truth, less the pupil's place
    here = np.array(pose) - [CAMERA.pupil * math.sin(pose[2]), -CAMERA.pupil * math.cos(pose[2]), 0]
    assert np.abs(np.linalg.solve(root, found.mean(axis=0) - here)).max() < 0.1


@pytest.mark.parametrize("sigma_heading", [0.0, math.radians(0.05), math.inf])
@pytest.mark.parametrize("pose", [(0.0, 1300.0, 0.0), (-600.0, 4150.0, 0.1)])
def test_scatter_of_located_poses_is_their_covariance(
    pose: tuple[float, float, float], sigma_heading: float
) -> None:
    seen = WALL[CAMERA.sees(optical(WALL, *pose))]
    clean = spikes_at(seen, *pose)
    sigma = np.linspace(0.02, 0.05, len(seen))
    rng = np.random.default_rng(4)
    runs = 2000
    turn = pose[2] + (rng.normal(0, sigma_heading, runs) if math.isfinite(sigma_heading) else 0.0)
    turns = np.broadcast_to(turn, runs)
    fixes = [
        locate(
            CAMERA, seen, clean + sigma * noise, sigma, heading=Prior(float(given), sigma_heading)
        )
        for noise, given in zip(rng.normal(size=(runs, len(seen))), turns, strict=True)
    ]
    kept = [fix for fix in fixes if not fix.flags & PoseFlags.REJECTED]
    assert len(kept) > 0.995 * runs
    errors = np.array([(fix.x, fix.y, fix.heading) for fix in kept]) - pose
    bound = pose_bound(
        pose_jacobian(CAMERA, seen, *pose), sigma, sigma_heading=sigma_heading
    ).covariance
    np.testing.assert_allclose(kept[0].covariance, bound, rtol=2e-3, atol=1e-12)
    known = slice(0, 2 if sigma_heading == 0 else 3)
    np.testing.assert_allclose(errors.std(axis=0)[known], np.sqrt(np.diag(bound))[known], rtol=0.08)
    chi2 = np.array([fix.chi2 for fix in fixes])
    degrees = len(seen) - (3 if math.isinf(sigma_heading) else 2)
    assert kept[0].degrees == degrees
    assert chi2.mean() == pytest.approx(degrees, abs=5 * math.sqrt(2 * degrees / runs))


def test_a_start_far_off_does_not_matter() -> None:
    clean = spikes_at(WALL, 100.0, 4000.0, 0.1)
    fix = locate(CAMERA, WALL, clean, 0.05, start=(-900.0, 1000.0, -0.4))
    assert (fix.x, fix.y, fix.heading) == pytest.approx((100.0, 4000.0, 0.1), abs=1e-6)


def test_the_cameras_own_error_is_in_the_covariance() -> None:
    clean = spikes_at(WALL, 100.0, 4000.0, 0.1)
    sure = locate(CAMERA, WALL, clean, 0.03)
    honest = locate(replace(CAMERA, model_error=0.04), WALL, clean, 0.03)
    np.testing.assert_allclose(honest.covariance, sure.covariance * (5 / 3) ** 2, rtol=1e-6)


def test_a_known_height_removes_what_it_adds() -> None:
    clean = spikes_at(WALL, 100.0, 2500.0, 0.05, 400.0)
    fix = locate(CAMERA, WALL, clean, 0.05, height=Prior(400.0, 0.0))
    assert (fix.x, fix.y, fix.heading) == pytest.approx((100.0, 2500.0, 0.05), abs=1e-6)
    ignored = locate(CAMERA, WALL, clean, 0.05)
    assert abs(ignored.y - 2500.0) > 20
    assert ignored.flags & PoseFlags.INCONSISTENT


@pytest.mark.parametrize("spread", [150.0, 400.0])
def test_an_unknown_height_widens_the_covariance_as_much_as_it_must(spread: float) -> None:
    leds = LedMap.line(5, 400.0).positions
    rng = np.random.default_rng(5)
    inside, areas, shifts = 0, [], []
    runs = 600
    for height, noise in zip(rng.normal(0, spread, runs), rng.normal(size=(runs, 5)), strict=True):
        pose = (rng.uniform(-200, 200), rng.uniform(2400, 4150), rng.uniform(-0.05, 0.05))
        pixels = spikes_at(leds, *pose, height) + 0.5 * noise
        fix = locate(
            CAMERA, leds, pixels, 0.5, heading=Prior(pose[2], 0.0), height=Prior(0.0, spread)
        )
        level = locate(CAMERA, leds, pixels, 0.5, heading=Prior(pose[2], 0.0))
        error = np.array([fix.x, fix.y]) - pose[:2]
        inside += error @ np.linalg.solve(fix.covariance[:2, :2], error) < 5.991
        areas.append(fix.covariance[1, 1] / level.covariance[1, 1])
        shifts.append(abs(level.y - pose[1]) / math.sqrt(level.covariance[1, 1]))
    # in 95 % of cases the truth is within the ellipse; 600 runs tell that to 0.9 %
    assert 0.92 < inside / runs < 0.985
    assert np.median(areas) > 1.05
    if spread > 300:
        assert np.median(areas) > 2
        assert np.percentile(shifts, 90) > 4  # what a height taken for 0 does


def test_any_height_that_light_comes_from_is_believed() -> None:
    clean = spikes_at(WALL, 100.0, 2500.0, 0.05, 300.0)
    fix = locate(CAMERA, WALL, clean, 0.05, height=UNKNOWN)
    errors = np.array([fix.x - 100, fix.y - 2500, fix.heading - 0.05])
    assert (np.abs(errors) < 3 * np.sqrt(np.diag(fix.covariance))).all()
    # that it is 300 mm away, the spikes tell; above or below, they do not
    assert fix.height == pytest.approx(0.0, abs=1.0)
    assert fix.sigma_height == pytest.approx(300.0, abs=15.0)
    # with four numbers to tell, nine LEDs do not check each other
    assert fix.flags == PoseFlags.UNCHECKED


def test_gross_errors_are_found_and_left_out() -> None:
    rng = np.random.default_rng(6)
    found = 0
    for run in range(200):
        pose = (rng.uniform(-300, 300), rng.uniform(3500, 4150), rng.uniform(-0.05, 0.05))
        count = 1 + run % 2
        pixels = spikes_at(WALL, *pose) + rng.normal(0, 0.05, 9)
        wrong = rng.choice(9, count, replace=False)
        pixels[wrong] += rng.choice([-1, 1], count) * rng.uniform(3, 300, count)
        fix = locate(CAMERA, WALL, pixels, 0.05)
        assert fix.flags & PoseFlags.REJECTED
        found += set(np.flatnonzero(fix.rejected)) == set(wrong)
        error = np.array([fix.x, fix.y, fix.heading]) - pose
        assert error @ np.linalg.solve(fix.covariance, error) < 30
        assert np.abs(fix.residuals[wrong]).min() > 2
    # noise alone makes one spike in 16,000 disagree by 4 σ
    assert found >= 197


def test_of_four_spikes_it_is_not_known_which_one_is_wrong() -> None:
    leds = LedMap.line(4, 500.0, 300.0).positions
    pixels = spikes_at(leds, 100.0, 3500.0, 0.02)
    pixels[1] += 20
    fix = locate(CAMERA, leds, pixels, 0.05)
    assert fix.flags == PoseFlags.AMBIGUOUS | PoseFlags.INCONSISTENT | PoseFlags.UNCHECKED
    # a known heading leaves one to spare
    fix = locate(CAMERA, leds, pixels, 0.05, heading=Prior(0.02, 0.0))
    assert fix.rejected.tolist() == [False, True, False, False]
    assert (fix.x, fix.y) == pytest.approx((100.0, 3500.0), abs=1e-3)


def test_a_wrong_map_is_inconsistent_not_half_rejected() -> None:
    rng = np.random.default_rng(7)
    moved = WALL + np.column_stack([rng.normal(0, 5, (9, 2)), np.zeros(9)])
    fix = locate(CAMERA, WALL, spikes_at(moved, 0.0, 4000.0, 0.0), 0.05)
    assert fix.flags == PoseFlags.INCONSISTENT
    assert not fix.rejected.any()


@pytest.mark.parametrize("count", [3, 4, 7])
def test_leds_and_tracker_on_a_circle_are_a_danger(count: int) -> None:
    middle, radius = np.array([50.0, 1100.0]), 1200.0
    angles = math.pi * 1.5 + np.linspace(-0.8, 0.8, count)
    places = middle + radius * np.column_stack([np.cos(angles), np.sin(angles)])
    leds = np.column_stack([places, np.zeros(count)])
    for place in (1.2, 1.57, 1.9):
        x, y = middle + radius * np.array([math.cos(place), math.sin(place)])
        fix = locate(CAMERA, leds, spikes_at(leds, x, y, 0.05), 0.05, start=(x, y, 0.05))
        assert fix.flags & ~PoseFlags.UNCHECKED == PoseFlags.DANGER_CIRCLE
        assert not fix.covariance[0, 0] < 1e6  # mm²
        # no danger if the heading is known, or away from it
        turned = locate(CAMERA, leds, spikes_at(leds, x, y, 0.05), 0.05, heading=Prior(0.05, 0.0))
        assert turned.flags & ~PoseFlags.UNCHECKED == PoseFlags.HEADING_ASSUMED
        assert (turned.x, turned.y) == pytest.approx((x, y), abs=1e-6)
        away = locate(CAMERA, leds, spikes_at(leds, x, y + 600, 0.05), 0.05)
        assert away.flags & ~PoseFlags.UNCHECKED == PoseFlags.NONE


def test_two_leds_take_the_heading_that_is_given() -> None:
    leds = np.array([[-250.0, 0.0, 0.0], [250.0, 0.0, 0.0]])
    pixels = spikes_at(leds, 130.0, 2000.0, 0.1)
    assumed = PoseFlags.HEADING_ASSUMED | PoseFlags.UNCHECKED
    fix = locate(CAMERA, leds, pixels, 0.1, heading=Prior(0.1, 0.0))
    assert fix.flags == assumed
    assert (fix.x, fix.y) == pytest.approx((130.0, 2000.0), abs=1e-6)
    # y σ / (√2 f) along x, √2 y² σ / (f B) along y
    unsure = locate(CAMERA, leds, pixels, 0.1, heading=Prior(0.1, math.radians(1)))
    assert unsure.flags == assumed
    assert math.sqrt(unsure.covariance[0, 0]) == pytest.approx(2000 * math.radians(1), rel=0.05)
    lost = locate(CAMERA, leds, pixels, 0.1)
    assert lost.flags == assumed | PoseFlags.AMBIGUOUS
    assert np.isinf(np.diag(lost.covariance)).all()


def test_spikes_that_are_missing_are_left_out() -> None:
    pixels = spikes_at(WALL, 0.0, 4000.0, 0.0)
    pixels[2] = math.nan
    sigma = np.full(9, 0.05)
    sigma[2], sigma[5] = math.inf, math.inf
    fix = locate(CAMERA, WALL, pixels, sigma)
    rest = [0, 1, 3, 4, 6, 7, 8]
    np.testing.assert_allclose(
        fix.covariance, locate(CAMERA, WALL[rest], pixels[rest], 0.05).covariance, rtol=1e-6
    )
    assert np.isnan(fix.residuals).tolist() == [i not in rest for i in range(9)]
    assert not fix.rejected.any()
    assert fix.degrees == 4


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"positions": WALL[:, :2]}, r"positions has shape \(N, 3\)"),
        ({"pixels": np.zeros(3)}, r"pixels has shape \(9,\), one per LED"),
        ({"sigma": 0.0}, r"sigma = 0 px: allowed is > 0"),
        ({"heading": Prior(20.0, 0.0)}, "heading.value = 20 rad: .*in degrees"),
        ({"height": Prior(0.0, -1.0)}, "height.sigma = -1"),
        ({"heading": Prior(0.0, 5.0)}, "heading.sigma = 5 rad: .*in degrees"),
        ({"start": (0.0, 4000.0, 10.0)}, r"start\[2\] = 10 rad: .*in degrees"),
        ({"start": (0.0, 4000.0)}, "start is x, y and heading, not 2 numbers"),
        ({"positions": WALL / 1000}, "LEDs are 2.4 mm apart at most: .*in metres"),
        ({"pixels": np.arange(9) * 200.0 + 1e6}, r"a spike at 1e\+06 px: the line has 3648"),
        ({"sigma": np.array([math.nan] + [0.05] * 8)}, "sigma = nan px: .*infinite for a spike"),
        ({"sigma": np.full((9, 1), 0.05)}, r"sigma is one number or has shape \(9,\)"),
        ({"facings": 90.0}, "90 rad: .*in degrees"),
        ({"facings": np.zeros(4)}, r"facings has shape \(9,\)"),
        ({"pixels": np.full(9, math.nan)}, "0 spikes: a pose needs 2"),
        (
            {"positions": WALL[::-1].copy(), "heading": Prior(0.0, 0.0)},
            "no pose with their LEDs in front: are LEDs and spikes in the same order",
        ),
    ],
)
def test_bad_input_is_refused(arguments: dict[str, Any], message: str) -> None:
    given: dict[str, Any] = {
        "positions": WALL,
        "pixels": spikes_at(WALL, 0.0, 4000.0, 0.0),
        "sigma": 0.05,
    }
    with pytest.raises(ValueError, match=message):
        locate(CAMERA, **(given | arguments))


def test_bad_input_to_the_closed_forms_is_refused() -> None:
    leds = WALL[3:6]
    at = optical(leds, 0.0, 2000.0, 0.0)
    tangents = -at[:, 0] / at[:, 2]
    with pytest.raises(ValueError, match="larger tangents those of larger room x"):
        closed_form(-tangents, leds[:, :2], heading=0.0)
    with pytest.raises(ValueError, match="2 LEDs: a pose needs 3, or 2 if the heading is known"):
        closed_form(tangents[:2], leds[:2, :2])
    with pytest.raises(ValueError, match="was it given in degrees"):
        two_leds(CAMERA, leds[:2], [1000.0, 2000.0], heading=10.0)
    with pytest.raises(ValueError, match=r"leds has shape \(2, 3\)"):
        two_leds(CAMERA, leds, [1000.0, 2000.0])


@pytest.mark.parametrize("seed", [10, 11])
def test_leds_that_are_not_seen_change_nothing(seed: int) -> None:
    """Gross errors are told among few LEDs of a large map as well as among these alone."""
    rng = np.random.default_rng(seed)
    rest = np.column_stack([rng.uniform(-5000, 5000, (31, 2)), np.zeros(31)])
    order = rng.permutation(40)
    for _ in range(20):
        pose = (rng.uniform(-300, 300), rng.uniform(3500, 4150), rng.uniform(-0.05, 0.05))
        pixels = spikes_at(WALL, *pose) + rng.normal(0, 0.05, 9)
        pixels[rng.choice(9, 2, replace=False)] += rng.uniform(3, 300, 2)
        few = locate(CAMERA, WALL, pixels, 0.05)
        assert few.flags & PoseFlags.REJECTED
        # rows of the large map in any order, those that are seen in the same one
        places = np.sort(order[:9])
        leds, u = np.empty((40, 3)), np.full(40, math.nan)
        leds[np.setdiff1d(order, places)] = rest
        leds[places], u[places] = WALL, pixels
        many = locate(CAMERA, leds, u, 0.05)
        assert (many.x, many.y, many.heading) == (few.x, few.y, few.heading)
        assert (many.covariance == few.covariance).all()
        assert many.rejected[places].tolist() == few.rejected.tolist()
        assert many.rejected.sum() == few.rejected.sum()
        np.testing.assert_array_equal(many.residuals[places], few.residuals)
        assert np.isnan(many.residuals).sum() == 31
        assert (many.flags, many.degrees, many.chi2) == (few.flags, few.degrees, few.chi2)


@pytest.mark.parametrize("count", [3, 9])
@pytest.mark.parametrize("stagger", [0.0, 200.0])
def test_leds_in_reversed_order_have_no_pose_on_their_lit_side(count: int, stagger: float) -> None:
    leds = LedMap.line(count, 300.0, stagger)
    spikes = spikes_at(leds.positions, 50.0, 4000.0, 0.02)
    right = locate(CAMERA, leds.positions, spikes, 0.05, facings=leds.facings)
    assert (right.x, right.y, right.heading) == pytest.approx((50.0, 4000.0, 0.02), abs=1e-5)
    assert locate(CAMERA, leds.positions[::-1], spikes, 0.05).y < 0  # the pose behind
    for wrong in (leds.positions[::-1], leds.positions * (-1, 1, 1)):
        with pytest.raises(ValueError, match=r"on their lit side: .*in the same order"):
            locate(CAMERA, wrong, spikes, 0.05, facings=leds.facings)
    # a room turned by 130° is the same
    turn = math.radians(130)
    matrix = np.array([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]])
    turned = np.column_stack([leds.positions[:, :2] @ matrix.T, leds.positions[:, 2]])
    fix = locate(CAMERA, turned, spikes, 0.05, facings=turn)
    assert (fix.x, fix.y) == pytest.approx(tuple(matrix @ [50.0, 4000.0]), abs=1e-5)
    with pytest.raises(ValueError, match="on their lit side"):
        locate(CAMERA, turned[::-1], spikes, 0.05, facings=turn)


def test_an_led_that_shines_away_is_a_gross_error() -> None:
    leds = LedMap.line(9, 300.0, 200.0).positions
    facings = np.zeros(9)
    facings[3] = math.pi
    fix = locate(CAMERA, leds, spikes_at(leds, 50.0, 4000.0, 0.02), 0.05, facings=facings)
    assert fix.rejected.tolist() == [i == 3 for i in range(9)]
    assert (fix.x, fix.y, fix.heading) == pytest.approx((50.0, 4000.0, 0.02), abs=1e-5)


@pytest.mark.parametrize(
    ("count", "pitch", "warned"),
    [(4, 500.0, True), (5, 350.0, True), (6, 350.0, True), (7, 350.0, True), (9, 300.0, False)],
)
def test_a_pose_that_a_hidden_gross_error_could_have_moved_says_so(
    count: int, pitch: float, warned: bool
) -> None:
    """One spike of all is 5 to 30 σ off; a pose is far off if it is more than 7 σ."""
    leds = LedMap.line(count, pitch, 200.0).positions
    rng = np.random.default_rng(12)
    far, missed, coverage = 0, 0, 0
    runs = 400
    warning = PoseFlags.UNCHECKED | PoseFlags.AMBIGUOUS | PoseFlags.INCONSISTENT
    for _ in range(runs):
        pose = (rng.uniform(-200, 200), rng.uniform(3300, 4150), rng.uniform(-0.03, 0.03))
        pixels = spikes_at(leds, *pose) + rng.normal(0, 0.05, count)
        clean = locate(CAMERA, leds, pixels, 0.05)
        assert bool(clean.flags & PoseFlags.UNCHECKED) == warned or clean.rejected.any()
        pixels[rng.integers(count)] += rng.choice([-1, 1]) * rng.uniform(5, 30) * 0.05
        fix = locate(CAMERA, leds, pixels, 0.05)
        error = np.array([fix.x, fix.y, fix.heading]) - pose
        away = float(error @ np.linalg.solve(fix.covariance, error))
        far += away > 49
        missed += away > 49 and not fix.flags & warning
        coverage += away < 7.815
    assert missed == 0
    if warned:
        assert far > 0  # or the warning would be idle
    else:
        assert far == 0
        assert coverage > 0.9 * runs


def test_one_spike_that_disagrees_is_found_though_the_sum_is_not_unlikely() -> None:
    leds = LedMap.line(24, 110.0, 200.0).positions
    pixels = spikes_at(leds, 50.0, 4000.0, 0.02)
    pixels[10] += 0.25  # 5 σ, χ² of 24 at 21 degrees
    fix = locate(CAMERA, leds, pixels, 0.05)
    assert np.flatnonzero(fix.rejected).tolist() == [10]
    assert (fix.x, fix.y, fix.heading) == pytest.approx((50.0, 4000.0, 0.02), abs=1e-5)


def test_a_vague_heading_is_no_witness_against_a_spike() -> None:
    """Of four spikes it is as little known which one is wrong as without it."""
    leds = LedMap.line(4, 500.0, 300.0).positions
    pixels = spikes_at(leds, 100.0, 3500.0, 0.02)
    pixels[1] += 20
    for sigma in (0.05, 0.5, math.inf):
        fix = locate(CAMERA, leds, pixels, 0.05, heading=Prior(0.0, sigma))
        assert not fix.rejected.any()
        assert fix.flags == PoseFlags.AMBIGUOUS | PoseFlags.INCONSISTENT | PoseFlags.UNCHECKED
    told = locate(CAMERA, leds, pixels, 0.05, heading=Prior(0.02, 1e-5))
    assert told.rejected.tolist() == [False, True, False, False]


@pytest.mark.parametrize(
    ("stagger", "y", "sigma", "danger"),
    [
        (0.0, 4150.0, 0.02, False),  # a straight line has no circle in front of it
        (-100.0, 2100.0, 0.02, False),
        (-100.0, 2300.0, 0.02, False),
        (-100.0, 2400.0, 0.02, True),
        (-100.0, 2500.0, 0.02, True),  # on the circle
    ],
)
def test_danger_is_where_the_covariance_misleads(
    stagger: float, y: float, sigma: float, danger: bool
) -> None:
    leds = LedMap.line(3, 500.0, stagger).positions
    clean = spikes_at(leds, 0.0, y, 0.0)
    rng = np.random.default_rng(13)
    runs = 300
    flagged, inside, far = 0, 0, 0
    for noise in rng.normal(0, sigma, (runs, 3)):
        fix = locate(CAMERA, leds, clean + noise, sigma)
        flagged += bool(fix.flags & PoseFlags.DANGER_CIRCLE)
        error = np.array([fix.x, fix.y - y, fix.heading])
        away = error @ np.linalg.lstsq(fix.covariance, error)[0]
        inside += away < 7.815
        far += away > 25
    if danger:
        assert flagged == runs
        assert far > 0.005 * runs  # of honest errors 1.5e-5 are so far off
    else:
        assert flagged == 0
        # 300 runs tell 95 % to 1.3 %
        assert inside > 0.91 * runs
        assert far == 0


@pytest.mark.parametrize("height", [-450.0, -300.0, -200.0, 250.0, 400.0])
@pytest.mark.parametrize("sigma", [0.005, 0.03])
def test_both_heights_are_believed_if_one_is_less_likely(sigma: float, height: float) -> None:
    """Above and below the LEDs is the same to the spikes: the prior decides how much each counts."""
    rng = np.random.default_rng(14)
    prior = Prior(100.0, 300.0)
    pose = (rng.uniform(-100, 100), rng.uniform(3300, 4000), rng.uniform(-0.03, 0.03))
    pixels = spikes_at(WALL, *pose, height) + rng.normal(0, sigma, 9)
    fix = locate(CAMERA, WALL, pixels, sigma, height=prior)
    # poses at all heights, each known, as likely as prior and spikes make it
    heights = np.arange(-700.0, 700.0, 2.0)
    fits = [locate(CAMERA, WALL, pixels, 30 * sigma, height=Prior(h, 0.0)) for h in heights]
    chi2 = np.array([(f.residuals**2).sum() for f in fits]) / sigma**2
    likely = np.exp(-(chi2 - chi2.min() + ((heights - prior.value) / prior.sigma) ** 2) / 2)
    likely *= np.sqrt([np.linalg.det(f.covariance) for f in fits])
    likely /= likely.sum()
    mean = (likely * heights).sum()
    spread = math.sqrt((likely * (heights - mean) ** 2).sum())
    assert spread > 100  # both count
    assert fix.height == pytest.approx(mean, abs=0.02 * spread)
    assert fix.sigma_height == pytest.approx(spread, rel=0.02)


def test_stagger_toward_the_tracker_tells_the_heading() -> None:
    """Three LEDs, 0.5 m apart, 1.3 m away: σ_x of 3.2 mm/px, 1 with stagger, 7 with the other."""
    camera = Camera.pinhole(30.0)
    found = {
        stagger: float(dilution(camera, LedMap.line(3, 500.0, stagger).positions, 0.0, 1300.0).x)
        for stagger in (0.0, 300.0, -300.0)
    }
    assert found == pytest.approx({0.0: 3.2, 300.0: 1.0, -300.0: 7.0}, rel=0.06)


def test_a_known_heading_is_worth_more_than_a_gyroscope() -> None:
    """9 LEDs in a line, 0.5 m apart: 13 to 16 times in x; 0.05° and spikes of 1 px: 1.5 to 8."""
    leds = LedMap.line(9, 500.0).positions
    y = np.array([1300.0, 2500.0, 4150.0])
    camera = Camera.pinhole(30.0)
    unknown = dilution(camera, leds, 0.0, y)
    known = dilution(camera, leds, 0.0, y, sigma_heading=0.0)
    gyroscope = dilution(camera, leds, 0.0, y, sigma_heading=math.radians(0.05))
    worth = unknown.x / known.x
    assert worth.min() > 12.5
    assert worth.max() < 16.5
    assert (known.heading == 0).all()
    assert ((unknown.x / gyroscope.x > 1.5) & (unknown.x / gyroscope.x < 8)).all()


def test_dilution_is_the_bound_of_every_place() -> None:
    x, y = np.meshgrid([-900.0, 0.0, 400.0], [1300.0, 4150.0])
    found = dilution(CAMERA, WALL, x, y, 0.1, sigma=0.3, sigma_heading=0.01)
    for index in np.ndindex(x.shape):
        at = (float(x[index]), float(y[index]), 0.1)
        seen = WALL[CAMERA.sees(optical(WALL, *at))]
        bound = pose_bound(pose_jacobian(CAMERA, seen, *at), 0.3, sigma_heading=0.01)
        assert (found.x[index], found.y[index], found.heading[index]) == pytest.approx(
            (bound.sigma_x, bound.sigma_y, bound.sigma_heading), rel=1e-6
        )
    # no light comes from above the reach of the head
    assert np.isinf(dilution(CAMERA, WALL, 0.0, 2000.0, height=900.0).x)
    # one LED in view tells nothing
    assert np.isinf(dilution(CAMERA, WALL[:1], 0.0, 2000.0).x)


@pytest.mark.parametrize(("y", "wrong"), [(1300.0, 24.0), (2500.0, 44.0), (4150.0, 73.0)])
def test_a_degree_of_heading_hurts_two_leds_and_not_three(y: float, wrong: float) -> None:
    turn = math.radians(1)
    pair = np.array([[-250.0, 0.0, 0.0], [250.0, 0.0, 0.0]])
    x, _ = two_leds(CAMERA, pair, spikes_at(pair, 0.0, y, turn))
    assert abs(x) == pytest.approx(wrong, abs=1.0)
    rng = np.random.default_rng(8)
    seen = WALL[CAMERA.sees(optical(WALL, 0.0, y, turn))]
    clean = spikes_at(seen, 0.0, y, turn)
    fixes = [
        locate(CAMERA, seen, clean + noise, 0.03) for noise in rng.normal(0, 0.03, (300, len(seen)))
    ]
    errors = np.hypot([fix.x for fix in fixes], [fix.y - y for fix in fixes])
    assert np.sqrt(np.mean(errors**2)) < 1.0
    assert np.mean([fix.heading for fix in fixes]) == pytest.approx(turn, abs=1e-4)


def test_a_degree_of_heading_hurts_in_exact_light_too() -> None:
    """Neither position knows the camera that made the spikes: rays through the glass did."""
    head = DESIGNS["slit-4mm"].system
    camera = Camera.from_system(head, angles=17)
    finder, emitter, turn = SpikeFinder(), Emitter(extent=2.0), math.radians(1)

    def spike(point: NDArray[np.float64]) -> float:
        light = irradiance(
            head, emitter, tuple(point.tolist()), integration_time=1e-3, rays=(192, 64)
        ).electrons
        return finder.profile(24_500 * light / light.max()).position

    pair = np.array([[-250.0, 0.0, 0.0], [250.0, 0.0, 0.0]])
    for y, wrong in ((1300.0, 24.0), (2500.0, 44.0), (4150.0, 73.0)):
        x, _ = two_leds(camera, pair, [spike(at) for at in optical(pair, 0.0, y, turn)])
        assert x == pytest.approx(wrong, abs=1.0)
        seen = WALL[camera.sees(optical(WALL, 0.0, y, turn), margin=40)]
        fix = locate(camera, seen, [spike(at) for at in optical(seen, 0.0, y, turn)], 0.005)
        assert math.hypot(fix.x, fix.y - y) < 1.0
        assert fix.heading == pytest.approx(turn, abs=math.radians(0.02))


def test_kernels_are_compiled_once_for_all_kinds_of_input() -> None:
    """Lists, whole numbers and read-only arrays must not stall a tracker."""
    pixels = spikes_at(WALL, 0.0, 4000.0, 0.0)
    locate(CAMERA, WALL, pixels, 0.05)
    before = len(load_kernels().fit.signatures)
    locate(CAMERA, WALL.astype(int).tolist(), pixels.tolist(), 1, height=Prior(0, 0))
    frozen = pixels.copy()
    frozen.flags.writeable = False
    locate(CAMERA, WALL[::1], frozen, np.ones(9), start=(0, 4000, 0))
    assert len(load_kernels().fit.signatures) == before
