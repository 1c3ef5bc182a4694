"""Poses in space: exact without noise, as sure as said with it, unique where that is promised."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from tracking.camera import Camera
from tracking.poses import PoseFlags, Prior, locate
from tracking.space import (
    MountedCamera,
    SpaceFix,
    SpacePose,
    angles,
    locate_in_space,
    rotation,
    spikes_of,
    three_points,
)
from twin.world import Led, Mount, Pose, World

if TYPE_CHECKING:
    from numpy.typing import NDArray

CAMERA = Camera(
    4244.0, distortion=(-0.42, 0.2), coupling=(-0.48, 0.1, -0.01, 0.08), pupil=10.0, depth=51.6
)
HEADS = (MountedCamera(CAMERA), MountedCamera(CAMERA, math.pi / 2, (0.0, 60.0, 0.0)))
# no two LEDs share an x or a z, and turned upside down it is another
WALL = np.array(
    [(100.0 * (k - 4), 200.0 * (k % 3 == 0), 100.0 * ((4 * k) % 9 - 4)) for k in range(9)]
)
SQUARE = np.array([(x, 0.0, z) for x, z in ((-100, -100), (100, -100), (100, 100), (-100, 100))])


def random_pose(rng: np.random.Generator) -> SpacePose:
    """Somewhere before the wall, looking at it, rolled by anything."""
    y = rng.uniform(1300, 4150)
    x, z = rng.uniform(-0.2, 0.2, 2) * y
    away = rng.uniform(-0.06, 0.06, 2)
    roll = rng.uniform(-math.pi, math.pi)
    return SpacePose(x, y, z, -math.atan2(x, y) + away[0], -math.atan2(z, y) + away[1], roll)


def visible(spikes: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(np.where((spikes > 0) & (spikes < 3647), spikes, np.nan))


def vector(pose: SpacePose) -> NDArray[np.float64]:
    return np.array([pose.x, pose.y, pose.z, pose.heading, pose.pitch, pose.roll])


def error(fix: SpaceFix, pose: SpacePose) -> NDArray[np.float64]:
    off = vector(fix.pose) - vector(pose)
    off[3:] = (off[3:] + math.pi) % (2 * math.pi) - math.pi
    return off


def squared(fix: SpaceFix, pose: SpacePose) -> float:
    """Error in σ, squared, of all six numbers together."""
    off = error(fix, pose)
    return float(off @ np.linalg.solve(fix.covariance, off))


def test_the_twin_turns_and_sees_in_the_same_way() -> None:
    """The pipeline has its own formulas: they are the twin's."""
    rng = np.random.default_rng(5)
    for numbers in rng.uniform(-1.2, 1.2, (20, 3)):
        heading, pitch, roll = numbers
        axes = rotation(heading, pitch, roll)
        assert axes == pytest.approx(Pose(0, 0, heading, 0, pitch, roll).rotation)
        assert angles(axes) == pytest.approx(numbers)
        pose = Pose(30, 2000, heading / 10, -50, pitch / 10, roll)
        mount = Mount(roll, (10.0, 60.0, -5.0))
        leds = [Led(k, (x, y, z)) for k, (x, y, z) in enumerate(WALL.tolist())]
        seen = [World(leds=leds, mount=mount).seen_from(led, pose) for led in leds]
        spikes = spikes_of(
            [MountedCamera(CAMERA, mount.roll, mount.offset)],
            WALL,
            SpacePose(pose.x, pose.y, pose.z, pose.heading, pose.pitch, pose.roll),
        )
        assert spikes[0] == pytest.approx(CAMERA.project(seen), abs=1e-9)


def test_without_noise_the_pose_is_exact() -> None:
    rng = np.random.default_rng(11)
    poses = 0
    for _ in range(60):
        pose = random_pose(rng)
        chosen = rng.permutation(9)[: rng.integers(4, 10)]
        spikes = visible(spikes_of(HEADS, WALL[chosen], pose))
        if np.isfinite(spikes).all(axis=0).sum() < 4:
            continue
        poses += 1
        fix = locate_in_space(HEADS, WALL[chosen], spikes, 0.05)
        assert np.abs(error(fix, pose)).max() < 1e-9
        assert not fix.rejected.any()
        assert fix.degrees == np.isfinite(spikes).sum() - 6
    assert poses > 40


def test_spread_is_as_stated() -> None:
    """Within 10 % in each of the six numbers; residuals are χ², and no fit refuses anything."""
    rng = np.random.default_rng(2)
    pose = SpacePose(120.0, 2400.0, -60.0, -0.03, 0.02, 0.1)
    exact = spikes_of(HEADS, WALL, pose)
    start = locate_in_space(HEADS, WALL, exact, 0.1).pose
    fixes = [
        locate_in_space(HEADS, WALL, exact + rng.normal(0, 0.1, exact.shape), 0.1, start=start)
        for _ in range(600)
    ]
    errors = np.array([error(fix, pose) for fix in fixes])
    sigma = np.sqrt(np.diag(fixes[0].covariance))
    assert errors.std(axis=0) == pytest.approx(sigma, rel=0.1)
    assert np.abs(errors.mean(axis=0) / sigma).max() < 4 / math.sqrt(len(errors))
    stated = fixes[0].covariance / np.outer(sigma, sigma)
    doubt = (1 - stated**2) / math.sqrt(len(errors)) + 1e-12  # of a correlation that is measured
    assert (np.abs(np.corrcoef(errors.T) - stated) < 4 * doubt).all()
    assert np.mean([fix.chi2 for fix in fixes]) == pytest.approx(fixes[0].degrees, rel=0.05)
    assert sum(bool(fix.flags & PoseFlags.INCONSISTENT) for fix in fixes) <= 6


def test_the_beginning_need_not_be_told() -> None:
    """With noise too, at all distances, and the flags stay silent."""
    rng = np.random.default_rng(21)
    ambiguous = 0
    for _ in range(30):
        pose = random_pose(rng)
        spikes = visible(spikes_of(HEADS, WALL, pose) + rng.normal(0, 0.05, (2, 9)))
        fix = locate_in_space(HEADS, WALL, spikes, 0.05)
        assert np.abs(error(fix, pose) / np.sqrt(np.diag(fix.covariance))).max() < 5
        ambiguous += bool(fix.flags & PoseFlags.AMBIGUOUS)
    assert ambiguous == 0


def test_three_leds_have_several_poses_and_four_have_one() -> None:
    pose = SpacePose(100.0, 2000.0, 50.0, 0.02, -0.01, 0.3)
    three, four = WALL[[0, 2, 7]], WALL[[0, 2, 7, 5]]
    fix = locate_in_space(HEADS, three, spikes_of(HEADS, three, pose), 0.05)
    assert fix.flags & PoseFlags.AMBIGUOUS
    assert fix.degrees == 0
    assert fix.chi2 < 1e-6  # one of the poses that fit
    told = locate_in_space(
        HEADS, three, spikes_of(HEADS, three, pose), 0.05, start=replace(pose, x=90.0, roll=0.28)
    )
    assert np.abs(error(told, pose)).max() < 1e-9  # the near one
    assert told.flags & PoseFlags.AMBIGUOUS
    only = locate_in_space(HEADS, four, spikes_of(HEADS, four, pose), 0.05)
    assert only.flags == PoseFlags.UNCHECKED
    assert np.abs(error(only, pose)).max() < 1e-9


def test_a_beginning_behind_the_wall_is_of_no_consequence() -> None:
    pose = SpacePose(100.0, 2000.0, 50.0)
    spikes = spikes_of(HEADS, WALL, pose)
    fix = locate_in_space(HEADS, WALL, spikes, 0.05, start=SpacePose(0, -2000, 0))
    assert np.abs(error(fix, pose)).max() < 1e-9
    assert fix.flags == PoseFlags.NONE


def test_a_plane_that_may_be_tilted_either_way_is_told() -> None:
    """A square of 0.2 m seen obliquely, begun from the wrong side of its normal, and from nowhere."""
    rng = np.random.default_rng(3)
    ambiguous = 0
    for number in range(40):
        x = rng.choice((-1, 1)) * rng.uniform(0.1, 0.35) * 4000
        pose = SpacePose(x, 4000.0, 30.0, -math.atan2(x, 4000), 0.0, rng.uniform(-0.2, 0.2))
        spikes = spikes_of(HEADS, SQUARE, pose) + rng.normal(0, 0.5, (2, 4))
        wrong = replace(pose, x=-x, heading=-pose.heading)
        fix = locate_in_space(HEADS, SQUARE, spikes, 0.5, start=wrong if number % 2 else None)
        ambiguous += bool(fix.flags & PoseFlags.AMBIGUOUS)
        assert squared(fix, pose) < 60 or fix.flags & PoseFlags.AMBIGUOUS
    assert 4 <= ambiguous <= 20  # near the normal the two are one, far from it noise decides


def test_the_better_of_two_tilts_is_found_from_the_other() -> None:
    pose = SpacePose(1000.0, 3000.0, 30.0, -math.atan2(1000, 3000), 0.0, 0.1)
    for leds in (SQUARE, SQUARE[:3], WALL * (1, 0, 1)):
        start = replace(pose, x=-1000.0, heading=-pose.heading)
        exact = spikes_of(HEADS, leds, pose)
        fix = locate_in_space(HEADS, leds, exact, 0.05, start=start)
        found = np.abs(error(fix, pose)).max() < 1e-6
        # three LEDs fit both, and the one begun with is taken
        assert found == (len(leds) > 3)
        assert bool(fix.flags & PoseFlags.AMBIGUOUS) == (len(leds) == 3)


def test_three_points_gives_all_poses() -> None:
    """The true one is among them, and all see the points where they are seen."""
    rng = np.random.default_rng(8)
    counts = []
    for _ in range(200):
        points = rng.uniform(-400, 400, (3, 3))
        place, axes = rng.normal((0, 2500, 0), 300), rotation(*rng.uniform(-1, 1, 3))
        own = (points - place) @ axes
        rays = own / np.linalg.norm(own, axis=1)[:, None]
        poses = three_points(rays, points)
        counts.append(len(poses))
        nearest = min(np.abs(found - place).max() for found, _ in poses)
        assert nearest < 1.0
        for _, turned in poses:
            assert turned @ turned.T == pytest.approx(np.eye(3), abs=1e-9)
    assert max(counts) > 1
    assert three_points(np.eye(3), np.zeros((3, 3))) == []


def test_a_gross_error_is_left_out() -> None:
    rng = np.random.default_rng(6)
    pose = SpacePose(120.0, 2400.0, -60.0, -0.03, 0.02, 0.1)
    for wrong in ((0, 0), (1, 4), (0, 8)):
        spikes = spikes_of(HEADS, WALL, pose) + rng.normal(0, 0.05, (2, 9))
        spikes[wrong] += 40.0  # a reflection
        fix = locate_in_space(HEADS, WALL, spikes, 0.05)
        assert fix.flags == PoseFlags.REJECTED
        assert np.argwhere(fix.rejected).tolist() == [list(wrong)]
        assert fix.residuals[wrong] == pytest.approx(40, abs=1)
        assert np.abs(error(fix, pose) / np.sqrt(np.diag(fix.covariance))).max() < 5


@pytest.mark.parametrize(("count", "trusted"), [(4, 0.1), (5, 0.6)])
def test_with_few_leds_it_is_told_when_any_spike_may_be_the_wrong_one(
    count: int, trusted: float
) -> None:
    """One gross error of 20 to 50 σ: a pose that is far off never goes without a warning."""
    rng = np.random.default_rng(count)
    leds = WALL[[0, 2, 7, 5, 4][:count]]
    rejected, right = 0, []
    for _ in range(30):
        x, heading, pitch, roll = rng.uniform(-0.05, 0.05, 4).tolist()
        pose = SpacePose(2000 * x, 2400.0, 50.0, heading, pitch, roll)
        spikes = spikes_of(HEADS, leds, pose) + rng.normal(0, 0.05, (2, count))
        spoilt = int(rng.integers(2)), int(rng.integers(count))
        spikes[spoilt] += rng.choice((-1, 1)) * rng.uniform(1.0, 2.5)
        fix = locate_in_space(HEADS, leds, spikes, 0.05)
        doubtful = fix.flags & (PoseFlags.AMBIGUOUS | PoseFlags.INCONSISTENT | PoseFlags.UNCHECKED)
        assert squared(fix, pose) < 60 or doubtful
        rejected += int(fix.rejected.any())
        if fix.rejected.any() and not fix.flags & PoseFlags.AMBIGUOUS:
            right.append(np.argwhere(fix.rejected).tolist() == [list(spoilt)])
    assert rejected > 20
    assert sum(right) >= trusted * 30
    assert all(right) or count == 4  # of which one check remains, and that is not enough


def test_two_gross_errors_are_left_out() -> None:
    rng = np.random.default_rng(9)
    pose = SpacePose(120.0, 2400.0, -60.0, -0.03, 0.02, 0.1)
    spikes = spikes_of(HEADS, WALL, pose) + rng.normal(0, 0.05, (2, 9))
    spikes[0, 2] += 30.0
    spikes[1, 6] -= 12.0
    fix = locate_in_space(HEADS, WALL, spikes, 0.05)
    # less checks the others now
    assert fix.flags == PoseFlags.REJECTED | PoseFlags.UNCHECKED
    assert np.argwhere(fix.rejected).tolist() == [[0, 2], [1, 6]]
    assert squared(fix, pose) < 40


def test_leds_in_reversed_order_and_swapped_sensors_are_told() -> None:
    pose = SpacePose(60.0, 2200.0, -40.0, -0.02, 0.015, 0.05)
    spikes = spikes_of(HEADS, WALL, pose)
    for seen in (spikes[:, ::-1], spikes[::-1]):
        fix = locate_in_space(HEADS, WALL, seen, 0.05)
        assert fix.flags & PoseFlags.INCONSISTENT
        assert not fix.rejected.any()


def test_three_noisy_leds_are_not_called_inconsistent() -> None:
    """Where no pose fits three directions exactly, the best one is within the noise."""
    rng = np.random.default_rng(4)
    # on the cylinder through them two poses are one: noise leaves none
    angle = np.radians([90, 210, 330])
    leds = np.column_stack([200 * np.cos(angle), 0 * angle, 200 * np.sin(angle)])
    pose = SpacePose(200.0, 1500.0, 0.0, -math.atan2(200, 1500))
    exact = spikes_of(HEADS, leds, pose)
    left = []
    for _ in range(30):
        fix = locate_in_space(HEADS, leds, exact + rng.normal(0, 0.3, (2, 3)), 0.3, start=pose)
        left.append(fix.chi2)
        assert not fix.flags & PoseFlags.INCONSISTENT
    assert max(left) > 1e-3


def test_a_wrong_map_is_told() -> None:
    """Too many disagree: nothing is left out to make it fit."""
    pose = SpacePose(120.0, 2400.0, -60.0)
    rng = np.random.default_rng(1)
    spikes = spikes_of(HEADS, WALL + rng.normal(0, 8, WALL.shape), pose)
    fix = locate_in_space(HEADS, WALL, spikes, 0.05)
    assert fix.flags & PoseFlags.INCONSISTENT
    assert not fix.rejected.any()


def test_what_a_pixel_is_worth() -> None:
    """With nine LEDs over the field: across it, where attitude is in the way, much more than along."""
    for y, size, across, along in ((1300.0, 1.0, 1.2, 0.4), (4150.0, 3.0, 5.0, 1.5)):
        pose = SpacePose(0.0, y, 0.0)
        wall = WALL * size
        fix = locate_in_space(HEADS, wall, spikes_of(HEADS, wall, pose), 1.0)
        sigma = np.sqrt(np.diag(fix.covariance))[:3]
        assert sigma[0] == pytest.approx(sigma[2], rel=0.15)
        assert 2 * sigma[1] < sigma[0] < across
        assert sigma[1] < along


def test_a_second_sensor_removes_the_unknown_height() -> None:
    """One sensor is off by the height it assumes, or unsure for not knowing it; two are neither."""
    flat = WALL * (3, 1.5, 0)
    pose = SpacePose(150.0, 2500.0, 400.0)
    spikes = spikes_of(HEADS[:1], flat, pose)[0]
    on_line = np.abs(spikes - 1823.5) < 1823
    leds, spikes = flat[on_line], spikes[on_line]
    assumed = locate(CAMERA, leds, spikes, 0.05, height=Prior(0, 0))
    widened = locate(CAMERA, leds, spikes, 0.05, height=Prior(0, 300))
    known = locate(CAMERA, leds, spikes, 0.05, height=Prior(400, 0))
    assert math.hypot(assumed.x - pose.x, assumed.y - pose.y) > 10
    assert math.hypot(known.x - pose.x, known.y - pose.y) < 1e-6
    assert np.sqrt(widened.covariance[1, 1]) > 5 * np.sqrt(known.covariance[1, 1])
    looking = replace(pose, pitch=-math.atan2(400, 2500))
    both = visible(spikes_of(HEADS, WALL, looking))
    fix = locate_in_space(HEADS, WALL, both, 0.05)
    assert np.abs(error(fix, looking)).max() < 1e-9


def test_what_cannot_be_located_is_refused() -> None:
    pose = SpacePose(0.0, 2000.0, 0.0)
    spikes = spikes_of(HEADS, WALL, pose)
    few = np.where(np.arange(9) < 2, spikes, np.nan)
    with pytest.raises(ValueError, match="4 spikes of 2 LEDs"):
        locate_in_space(HEADS, WALL, few, 0.05)
    with pytest.raises(ValueError, match="parallel"):
        locate_in_space([HEADS[0], HEADS[0]], WALL, spikes, 0.05)
    with pytest.raises(ValueError, match="a row for each camera"):
        locate_in_space(HEADS, WALL, spikes[0], 0.05)
    with pytest.raises(ValueError, match="sigma = 0"):
        locate_in_space(HEADS, WALL, spikes, 0.0)
    with pytest.raises(ValueError, match=r"shape \(N, 3\)"):
        locate_in_space(HEADS, WALL[:, :2], spikes, 0.05)
    line = np.column_stack([np.linspace(-200, 200, 5), np.zeros((5, 2))])
    for leds in (line, WALL[[0, 0, 0, 0]]):
        with pytest.raises(ValueError, match="on one line"):
            locate_in_space(HEADS, leds, spikes_of(HEADS, leds, pose), 0.05)
    with pytest.raises(ValueError, match="finite"):
        replace(pose, x=math.nan)
    for name in ("heading", "pitch", "roll"):
        with pytest.raises(ValueError, match=f"{name} = 10 rad.*in degrees"):
            replace(pose, **{name: 10.0})
    with pytest.raises(ValueError, match="in degrees"):
        MountedCamera(CAMERA, 90.0)
    with pytest.raises(ValueError, match="right, up and backward"):
        MountedCamera(CAMERA, 0.0, (1.0, 2.0))  # type: ignore[arg-type]
