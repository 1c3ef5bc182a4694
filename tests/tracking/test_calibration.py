"""Calibration: closed forms, the bundle on synthetic and on traced spikes, the file."""

from __future__ import annotations

import json
import math
import re
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from acquisition.frames import Frame
from raytransfer.designs import DESIGNS
from raytransfer.irradiance import pixel_response
from raytransfer.tolerances import Tolerances, perturb
from tracking.calibration import (
    Calibration,
    Corner,
    FourCorners,
    Loss,
    Observation,
    UndeterminedError,
    _Bundle,
    _loss,
    bundle,
    load_calibration,
)
from tracking.camera import Camera
from tracking.leds import LedMap
from tracking.poses import UNKNOWN, Prior, locate, optical
from tracking.spikes import Correction, SpikeFinder, SpikeFlags
from twin.experiments import Bench
from twin.sensor import SensorModel
from twin.world import Pose

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    Array = NDArray[np.float64]

CAMERA = Camera(4200.0, 1840.0, (-0.42, 0.19), decentring=(0.002, -0.001), pupil=-8.0)
RAIL = LedMap.line(9, 500.0)
STAGGERED = LedMap.line(9, 500.0, 150.0)
GRID = [(x, 1000 / v) for v in np.linspace(0.24, 0.77, 8) for x in np.linspace(-400, 400, 5)]
"""Places of the tracker, evenly in 1 / y, mm."""


def seen(
    poses: Sequence[tuple[float, float, float]],
    leds: LedMap,
    *,
    camera: Camera = CAMERA,
    noise: float = 0.0,
    sigma: float = 0.05,
    known: tuple[float, float] = (math.inf, math.inf),
    seed: int = 0,
) -> list[Observation]:
    """Spikes that a camera would see, and poses known to so many mm and rad."""
    rng = np.random.default_rng(seed)
    of_place, of_heading = known
    observations = []
    for x, y, heading in poses:
        points = optical(leds.positions, x, y, heading)
        on_line = np.flatnonzero(camera.sees(points))
        if len(on_line) < (1 if math.isfinite(of_place) else 3):
            continue
        pixels = camera.project(points[on_line])
        guess = np.array([x, y, heading])
        for n, spread in enumerate((of_place, of_place, of_heading)):
            if math.isfinite(spread):
                guess[n] += spread * rng.standard_normal()
        observations.append(
            Observation(
                [leds.channels[n] for n in on_line],
                pixels + noise * rng.standard_normal(len(pixels)),
                sigma,
                Prior(guess[0], of_place),
                Prior(guess[1], of_place),
                Prior(guess[2], of_heading),
            )
        )
    return observations


def turned(seed: int, most: float = 0.25) -> list[tuple[float, float, float]]:
    """Poses on the grid, each turned at random."""
    rng = np.random.default_rng(seed)
    return [(x, y, rng.uniform(-most, most)) for x, y in GRID]


# four corners -----------------------------------------------------------------------------------


def corner(x: float, y: float, camera: Camera, heading: float = 0.0) -> Corner:
    """What the thesis's two LEDs show at a place."""
    pair = np.array([[-250.0, 0, 0], [250.0, 0, 0]])
    first, second = camera.project(optical(pair, x, y, heading))
    return Corner(x, y, (first + second) / 2, second - first)


def area(camera: Camera) -> FourCorners:
    """The four corners of 0.8 m by 2.65 m."""
    return FourCorners(
        *(corner(x, y, camera) for x, y in ((-400, 1500), (-400, 4150), (400, 1500), (400, 4150)))
    )


def test_four_corners_are_right_at_the_corners_and_rational_is_exact_for_a_pinhole() -> None:
    camera = Camera(3500.0)
    corners = area(camera)
    for c in corners.corners:
        for place in (corners.bilinear, corners.rational):
            np.testing.assert_allclose(place(c.midpoint, c.separation), (c.x, c.y), atol=1e-6)
    x, y = np.meshgrid(np.linspace(-400, 400, 9), np.linspace(1500, 4150, 9))
    shown = [corner(*at, camera) for at in zip(x.flat, y.flat, strict=True)]
    middle, apart = np.array([(c.midpoint, c.separation) for c in shown]).T
    np.testing.assert_allclose(corners.rational(middle, apart), (x.ravel(), y.ravel()), atol=1e-6)
    # the separation f B / y is far from linear in y: half way between 1500 and 4150 mm it shows
    # that y is 2 · 1500 · 4150 / (1500 + 4150), and the mapping says the mean
    wrong = corners.bilinear(*corner(0.0, 2 / (1 / 1500 + 1 / 4150), camera)[2:])
    np.testing.assert_allclose(wrong, (0.0, 2825.0), atol=1e-6)


def test_four_corners_leave_what_a_lens_distorts() -> None:
    camera = replace(CAMERA, pupil=0.0)
    corners = area(camera)
    x, y = np.meshgrid(np.linspace(-400, 400, 17), np.linspace(1500, 4150, 17))
    shown = [corner(*at, camera) for at in zip(x.flat, y.flat, strict=True)]
    middle, apart = np.array([(c.midpoint, c.separation) for c in shown]).T
    errors = {
        name: np.sqrt(
            np.mean((np.array(place(middle, apart)) - (x.ravel(), y.ravel())) ** 2, axis=1)
        )
        for name, place in (("bilinear", corners.bilinear), ("rational", corners.rational))
    }
    assert 250 < errors["bilinear"][1] < 450
    assert 20 < errors["bilinear"][0] < 45
    assert 2 < errors["rational"][0] < 15
    assert 10 < errors["rational"][1] < 110


def test_swapped_leds_give_the_same_places() -> None:
    corners = area(CAMERA)
    swapped = FourCorners(*(c._replace(separation=-c.separation) for c in corners.corners))
    for name in ("bilinear", "rational"):
        np.testing.assert_allclose(
            getattr(swapped, name)(1700.0, -900.0), getattr(corners, name)(1700.0, 900.0)
        )


def test_degenerate_corners_are_refused() -> None:
    lf, lb, rf, rb = area(CAMERA).corners
    with pytest.raises(ValueError, match=r"separations .* left back -.*were the LEDs swapped"):
        FourCorners(lf, lb._replace(separation=-lb.separation), rf, rb)
    with pytest.raises(ValueError, match="same LED's frame taken twice"):
        FourCorners(lf, lb, rf._replace(separation=0.0), rb)
    with pytest.raises(ValueError, match=r"do not span an area.*same measurement"):
        FourCorners(lf, lb, lf, lb)
    with pytest.raises(ValueError, match="do not span an area"):
        FourCorners(*(Corner(0, 1000 + n, 1800.0, 500.0 + n) for n in range(4)))
    with pytest.raises(ValueError, match="midpoint of the corner right front = nan"):
        FourCorners(lf, lb, rf._replace(midpoint=math.nan), rb)
    with pytest.raises(ValueError, match=r"separation = -3 px.*swapped"):
        area(CAMERA).rational([1800.0, 1800.0], [500.0, -3.0])


# the bundle, synthetic --------------------------------------------------------------------------


def test_jacobian_is_that_of_differences() -> None:
    observations = seen(turned(1)[::4], STAGGERED, noise=1.0, known=(0.5, 0.01))
    problem = _Bundle(observations, STAGGERED, replace(CAMERA, coupling=(-0.4,)))
    problem.know(2.0, {"pupil": 3.0, "coupling[0]": 1.0})
    problem.values[: problem.first] *= 1.001
    free = problem.values[problem.free]
    spread = np.full(len(problem.pixels), 0.1)
    slopes = problem.slopes(free, spread)
    assert slopes.shape == (len(problem.pixels) + len(problem.prior), len(free))
    size = np.abs(slopes).max(axis=0)
    for column in range(len(free)):
        step = np.zeros(len(free))
        step[column] = 1e-4 / max(size[column], 1e-3)
        change = problem.weighted(free + step, spread) - problem.weighted(free - step, spread)
        np.testing.assert_allclose(
            change / (2 * step[column]), slopes[:, column], atol=1e-5 * max(size[column], 1e-3)
        )


@pytest.mark.parametrize("loss", ["huber", "soft_l1", "cauchy", "linear"])
def test_losses_and_their_slopes(loss: Loss) -> None:
    z = np.array([0.0, 0.3, 0.9, 1.2, 40.0])
    step = 1e-5
    value, slope, bend = _loss(loss, z)
    above, below = _loss(loss, z + step), _loss(loss, z - step * (z > 0))
    np.testing.assert_allclose((above[0] - below[0]) / (step + step * (z > 0)), slope, atol=1e-4)
    np.testing.assert_allclose((above[1] - below[1]) / (step + step * (z > 0)), bend, atol=1e-4)
    assert (value <= z + 1e-12).all()


def test_without_noise_everything_is_found_again() -> None:
    shifted = np.array(STAGGERED.positions)
    shifted[:, :2] += np.random.default_rng(3).normal(0, 3, (9, 2))
    truth = LedMap(STAGGERED.channels, shifted)
    found = bundle(
        seen(turned(2), truth, known=(0.0, 0.0)),
        STAGGERED,
        Camera(4000.0, 1800.0, pupil=-5.0),
        camera_sigma={"pupil": math.inf},
    )
    np.testing.assert_allclose(found.leds.positions, truth.positions, atol=1e-6)
    poses = [(100.0, 1400.0, 0.05), (-380.0, 4000.0, -0.1)]
    points = np.concatenate([optical(truth.positions, *pose) for pose in poses])
    there = points[CAMERA.sees(points)]
    np.testing.assert_allclose(found.camera.project(there), CAMERA.project(there), atol=1e-6)


def test_covariance_is_that_of_the_errors() -> None:
    """Errors of 25 bundles, and of the poses found with them, over what the covariances say."""
    leds = LedMap.line(5, 500.0, 150.0)
    poses = turned(5)[::2]
    names, ratios, of_poses = None, [], []
    pose = (80.0, 2600.0, 0.02)
    points = optical(leds.positions, *pose)
    for seed in range(25):
        observations = seen(poses, leds, noise=0.05, sigma=0.05, known=(0.5, 0.002), seed=seed)
        found = bundle(observations, leds, CAMERA, camera_sigma={"pupil": 0.0}, loss="linear")
        truth = dict(zip(CAMERA.names, CAMERA.parameters, strict=True))
        for channel, position in zip(leds.channels, leds.positions, strict=True):
            truth |= {f"LED {channel} {axis}": v for axis, v in zip("xy", position, strict=False)}
        values = dict(zip(found.camera.names, found.camera.parameters, strict=True))
        for channel, position in zip(found.leds.channels, found.leds.positions, strict=True):
            values |= {f"LED {channel} {axis}": v for axis, v in zip("xy", position, strict=False)}
        names = found.names
        error = np.array([values[name] - truth[name] for name in names])
        assert found.covariance is not None
        ratios.append(error @ np.linalg.solve(found.covariance, error) / len(names))
        fix = locate(found.camera, found.leds.positions, CAMERA.project(points), np.full(5, 0.05))
        off = np.array([fix.x, fix.y, fix.heading]) - pose
        covariance = found.pose_covariance(leds.channels, *pose)
        of_poses.append(off @ np.linalg.solve(covariance, off) / 3)
    # a mean of 25 χ² of 16 (3) degrees, over their number: σ 0.07 (0.16)
    assert names is not None
    assert len(names) == 16
    assert 0.75 < np.mean(ratios) < 1.25
    assert 0.5 < np.mean(of_poses) < 1.5


def test_gross_errors_count_little_and_are_named() -> None:
    observations = seen(turned(7), STAGGERED, noise=0.05, known=(0.5, 0.002), seed=1)
    rng = np.random.default_rng(4)
    spoiled = list(observations)
    for number in rng.choice(len(spoiled), 6, replace=False):
        pixels = np.array(spoiled[number].pixels)
        pixels[0] += 60.0
        spoiled[number] = replace(spoiled[number], pixels=pixels)

    def worst(loss: Loss, given: list[Observation]) -> tuple[float, str]:
        found = bundle(given, STAGGERED, CAMERA, loss=loss, led_sigma=5.0)
        off = found.leds.positions[1:-1] - STAGGERED.positions[1:-1]
        return float(np.abs(off).max()), found.notes

    clean, _ = worst("cauchy", observations)
    robust, notes = worst("cauchy", spoiled)
    assert robust < clean + 0.5
    assert worst("linear", spoiled)[0] > clean + 2
    assert sum("it counts little" in line for line in notes.splitlines()) == 6


def test_what_the_camera_cannot_follow_becomes_model_error() -> None:
    real = replace(CAMERA, distortion=(-0.42, 0.19, 0.9))
    observations = seen(
        turned(8), STAGGERED, camera=real, noise=0.02, sigma=0.02, known=(0.5, 0.002)
    )
    coarse = bundle(observations, STAGGERED, CAMERA, distortion=1, led_sigma=5.0)
    assert coarse.camera.distortion[1:] != ()
    held = replace(CAMERA, distortion=(-0.42,), decentring=())
    poor = bundle(observations, STAGGERED, held, distortion=1, decentring=0, led_sigma=5.0)
    good = bundle(observations, STAGGERED, CAMERA, distortion=3, led_sigma=5.0)
    assert good.camera.model_error < 0.01
    assert poor.camera.model_error > 0.1
    assert poor.sigma("scale") > 3 * good.sigma("scale")


# contradictions ---------------------------------------------------------------------------------


def relabelled(observations: list[Observation], swaps: dict[int, int]) -> list[Observation]:
    return [replace(o, channels=[swaps.get(c, c) for c in o.channels]) for o in observations]


@pytest.fixture(scope="module")
def surveyed() -> list[Observation]:
    return seen(turned(2), STAGGERED, noise=0.05, known=(0.5, 0.002))


@pytest.fixture(scope="module")
def straight(surveyed: list[Observation]) -> Calibration:
    return bundle(surveyed, STAGGERED, CAMERA, led_sigma=5.0)


@pytest.mark.parametrize("pair", [(3, 5), (0, 1)])
def test_swapped_channels_are_named(surveyed: list[Observation], pair: tuple[int, int]) -> None:
    a, b = pair
    observations = relabelled(surveyed, {a: b, b: a})
    with pytest.raises(ValueError, match=rf"^LED {a}: .*; LED {b}: [^;]*swapped"):
        bundle(observations, STAGGERED, CAMERA, led_sigma=5.0)
    # if nothing is said of the LEDs' places, they are where the spikes are
    found = bundle(
        observations, STAGGERED, CAMERA, led_sigma=np.where(np.isin(range(9), pair), math.inf, 5.0)
    )
    np.testing.assert_allclose(
        found.leds.positions[[b, a]], STAGGERED.positions[[a, b]], atol=4 * found.sigma(f"LED {a} y")
    )  # fmt: skip


def test_signs_and_orders_the_other_way_are_named(surveyed: list[Observation]) -> None:
    for led_sigma in (5.0, math.inf):
        with pytest.raises(
            ValueError, match=r"smooth curve.*if channels ran along the LEDs the oth"
        ):
            bundle(
                relabelled(surveyed, {n: 8 - n for n in range(9)}),
                STAGGERED,
                CAMERA,
                led_sigma=led_sigma,
            )
    clockwise = [replace(o, heading=o.heading._replace(value=-o.heading.value)) for o in surveyed]
    with pytest.raises(ValueError, match=r"smooth curve.*if headings were clockwise"):
        bundle(clockwise, STAGGERED, CAMERA, led_sigma=5.0)
    aside = [replace(o, x=o.x._replace(value=-o.x.value)) for o in surveyed]
    with pytest.raises(ValueError, match=r"smooth curve.*if x of the tracker ran the other way"):
        bundle(aside, STAGGERED, CAMERA, led_sigma=5.0)
    with pytest.raises(ValueError, match=r"scale of the camera = -4200 px, .* about \+4\d\d\d"):
        bundle(surveyed, STAGGERED, Camera(-4200.0), led_sigma=5.0)


def test_a_mirrored_line_is_calibrated_as_such(
    surveyed: list[Observation], straight: Calibration
) -> None:
    """Read from the other end, with a camera that says so."""
    mirrored = [replace(o, pixels=3647 - np.asarray(o.pixels)) for o in surveyed]
    found = bundle(mirrored, STAGGERED, Camera(-4100.0, 1800.0, pupil=CAMERA.pupil), led_sigma=5.0)
    assert found.camera.scale == pytest.approx(-straight.camera.scale, abs=0.01)
    assert found.camera.centre == pytest.approx(3647 - straight.camera.centre, abs=0.01)


def test_a_poor_guess_is_no_contradiction(surveyed: list[Observation]) -> None:
    """LEDs and camera far off, spikes as they should be."""
    guess = np.array(STAGGERED.positions)
    guess[:, :2] += np.random.default_rng(0).normal(0, 100, (9, 2))
    good = bundle(surveyed, STAGGERED, CAMERA)
    for camera in (CAMERA, Camera(2800.0, 2440.0), Camera(10_000.0)):
        found = bundle(surveyed, LedMap(STAGGERED.channels, guess), camera)
        np.testing.assert_allclose(found.leds.positions, good.leds.positions, atol=0.5)


@pytest.mark.parametrize("seed", [5, 6, 7, 8])
def test_one_spike_in_five_may_be_wrong(surveyed: list[Observation], seed: int) -> None:
    rng = np.random.default_rng(seed)
    spoiled, count = [], 0
    for o in surveyed:
        wrong = rng.random(len(o.channels)) < 0.2
        off = wrong * rng.choice([-1, 1], wrong.size) * rng.uniform(20, 300, wrong.size)
        spoiled.append(replace(o, pixels=np.asarray(o.pixels) + off))
        count += int(wrong.sum())
    assert count > 20
    found = bundle(spoiled, STAGGERED, CAMERA, led_sigma=5.0)
    inner = found.leds.positions[1:-1, :2] - STAGGERED.positions[1:-1, :2]
    sigma = [[found.sigma(f"LED {n} {axis}") for axis in "xy"] for n in range(1, 8)]
    assert np.abs(inner / sigma).max() < 4.5
    assert abs(found.camera.scale - CAMERA.scale) < 4 * found.sigma("scale")
    assert found.camera.model_error < 0.1
    told = re.search(r"So it is with (\d+) more, (\d+) of (\d+)\.", found.notes)
    assert told is not None
    more, named, spikes = (int(number) for number in told.groups())
    assert (more, spikes) == (named - 10, found.spikes)
    # an LED at the end, seen from few poses, may follow one
    assert 0.9 * count <= named <= count


def test_what_no_camera_follows_is_refused(surveyed: list[Observation]) -> None:
    """Spikes of all channels in disorder: no single mistake explains them."""
    rng = np.random.default_rng(1)
    mixed = [
        replace(o, channels=rng.permutation(9)[: len(o.channels)].tolist())
        for o in surveyed
    ]  # fmt: skip
    with pytest.raises((ValueError, RuntimeError), match=r"no camera fits|spikes are off"):
        bundle(mixed, STAGGERED, CAMERA, led_sigma=5.0)


def test_a_model_error_that_does_not_settle_is_noted(
    surveyed: list[Observation], monkeypatch: pytest.MonkeyPatch
) -> None:
    def rounds(*errors: float) -> tuple[int, str]:
        given = list(errors * 10)
        monkeypatch.setattr(_Bundle, "left_over", lambda *_: given.pop())
        notes = bundle(surveyed, STAGGERED, CAMERA, led_sigma=5.0).notes
        return 20 - len(given), notes

    count, notes = rounds(0.1, 0.5)
    assert (count, "had not settled after 12 rounds" in notes) == (12, True)
    # far below the spikes' σ of 0.05 px there is nothing to settle
    count, notes = rounds(0.001, 0.002)
    assert (count, "settled" in notes) == (2, False)


def test_notes_say_what_is_left_open_in_mm(
    surveyed: list[Observation], straight: Calibration
) -> None:
    """A centre a few px off is an x a few mm off where the heading is known."""
    pattern = r"± (\S+) mm in x and ± (\S+) mm in y with a \w+ heading \(at worst (\S+) and (\S+)\)"
    for told, sigma_heading in zip(
        re.findall(pattern, straight.notes), (0.0, math.inf), strict=True
    ):
        spread = [
            np.sqrt(
                np.diag(straight.pose_covariance(o.channels, *pose, sigma_heading=sigma_heading))
            )
            for o, pose in zip(surveyed, turned(2), strict=True)
            if len(o.channels) > 2
        ]
        expected = [*np.median(spread, axis=0)[:2], *np.max(spread, axis=0)[:2]]
        assert [float(v) for v in told] == pytest.approx(expected, rel=0.1)
    loose = [replace(o, heading=Prior(o.heading.value, 0.004)) for o in surveyed[::2]]
    open_centre = bundle(loose, STAGGERED, CAMERA, led_sigma=5.0)
    assert 2 < open_centre.sigma("centre") < 5
    *_, worst, _ = re.findall(pattern, open_centre.notes)[0]
    # at 4.15 m a pixel is a millimetre
    assert float(worst) == pytest.approx(open_centre.sigma("centre"), rel=0.3)


# what observations cannot tell ------------------------------------------------------------------


def test_a_room_that_nothing_fixes_is_refused_by_name() -> None:
    free = seen(turned(1), STAGGERED)
    with pytest.raises(UndeterminedError, match="Hold two LEDs") as refused:
        bundle(free, STAGGERED, CAMERA)
    assert refused.value.parameters == (
        "the room's place along x",
        "the room's place along y",
        "the room's orientation",
        "the room's size",
    )
    one = np.full(9, math.inf)
    one[4] = 0.0
    headings = seen(turned(1), STAGGERED, known=(math.inf, 0.001))
    with pytest.raises(UndeterminedError) as refused:
        bundle(headings, STAGGERED, CAMERA, led_sigma=one)
    assert refused.value.parameters == ("the room's size",)


def test_two_held_leds_fix_the_room() -> None:
    held = np.full(9, math.inf)
    held[[2, 6]] = 0.0
    found = bundle(
        seen(turned(1), STAGGERED),
        STAGGERED,
        CAMERA,
        led_sigma=held,
        camera_sigma={"pupil": 0.0, "centre": 0.0},
    )
    assert np.array_equal(found.leds.positions[[2, 6]], STAGGERED.positions[[2, 6]])
    np.testing.assert_allclose(found.leds.positions, STAGGERED.positions, atol=1e-3)
    assert found.sigma("LED 2 x") == 0.0
    assert found.sigma("LED 3 x") > 0.0


def test_a_straight_rail_and_free_poses_do_not_tell_the_scale() -> None:
    """The LEDs' places known exactly, what is left free hides in the poses."""
    pinhole = Camera(3500.0)
    options: Any = {
        "led_sigma": 0.0,
        "camera_sigma": {"pupil": 0.0},
        "distortion": 0,
        "decentring": 0,
    }
    free = seen(turned(1), RAIL, camera=pinhole, noise=0.05)
    with pytest.raises(UndeterminedError, match=r"(?s)scale.*stagger an LED") as refused:
        bundle(free, RAIL, pinhole, **options)
    assert "scale" in refused.value.parameters
    # two ways out: stagger, or known poses
    middle = np.array(RAIL.positions)
    middle[4, 1] = 300.0
    staggered = LedMap(RAIL.channels, middle)
    found = bundle(
        seen(turned(1), staggered, camera=pinhole, noise=0.05), staggered, pinhole, **options
    )
    assert found.sigma("scale") < 5.0
    assert abs(found.camera.scale - 3500.0) < 4 * found.sigma("scale")
    places = seen(turned(1), RAIL, camera=pinhole, noise=0.05, known=(0.5, math.inf))
    assert bundle(places, RAIL, pinhole, **options).sigma("scale") < 5.0


def test_a_pose_without_spikes_changes_nothing(
    surveyed: list[Observation], straight: Calibration
) -> None:
    blind = Observation([], [], 0.1, Prior(0.0, 0.5), Prior(2000.0, 0.5), Prior(0.0, 0.01))
    for more in ([*surveyed, blind], [blind, *surveyed]):
        found = bundle(more, STAGGERED, CAMERA, led_sigma=5.0)
        np.testing.assert_allclose(
            found.camera.parameters, straight.camera.parameters, rtol=1e-6, atol=1e-8
        )
    with pytest.raises(ValueError, match=r"LEDs \[\] do not tell the pose"):
        straight.pose_covariance([], 0.0, 2000.0)


def test_with_free_distortion_a_straight_rail_tells_the_scale_badly() -> None:
    free = seen(turned(1), RAIL, noise=0.05)
    with pytest.raises(UndeterminedError) as refused:
        bundle(free, RAIL, CAMERA, led_sigma=0.0, camera_sigma={"pupil": 0.0})
    assert {"scale", "centre"} <= set(refused.value.parameters)
    assert refused.value.calibration is not None


def test_unknown_headings_leave_the_centre_open() -> None:
    observations = seen(turned(3, 0.1), STAGGERED, noise=0.3, sigma=0.3, known=(0.5, math.inf))
    with pytest.raises(UndeterminedError, match=r"what a turned head shows.*headings") as refused:
        bundle(observations, STAGGERED, CAMERA, led_sigma=5.0, decentring=1)
    assert "centre" in refused.value.parameters
    found = bundle(
        observations, STAGGERED, CAMERA, led_sigma=5.0, camera_sigma={"centre": 0.0}, decentring=1
    )
    assert found.camera.centre == CAMERA.centre


def test_an_led_that_is_never_seen() -> None:
    more = LedMap([*STAGGERED.channels, 20], np.vstack([STAGGERED.positions, [[0.0, 9000.0, 0.0]]]))
    observations = seen(turned(2), STAGGERED, noise=0.05, known=(0.5, 0.002))
    with pytest.raises(UndeterminedError, match="LED 20 x, LED 20 y"):
        bundle(observations, more, CAMERA)
    found = bundle(observations, more, CAMERA, led_sigma=5.0)
    assert found.sigma("LED 20 x") == pytest.approx(5.0)
    assert "LED 20 x: as known beforehand, ± 5" in found.notes


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"channels": [0, 1]}, r"one spike for each of 2 channels"),
        ({"channels": [0, 0, 1]}, "each is seen once"),
        ({"pixels": [1.0, math.nan, 2.0]}, "pixels = nan"),
        ({"sigma": 0.0}, "sigma = 0"),
        ({"x": Prior(0.0, -1.0)}, "σ of x = -1"),
        ({"height": math.inf}, "height = inf"),
        ({"heading": Prior(14.0, 0.1)}, "heading = 14 rad.*degrees"),
        ({"heading": Prior(0.2, 10.0)}, "σ of heading = 10 rad.*degrees"),
        ({"pixels": [1.0, 1e6, 2.0]}, r"pixels = 1e\+06.*0 to 3647 px"),
        ({"sigma": [0.1, math.nan, 0.1]}, "sigma = nan"),
        ({"sigma": [[0.1], [0.1], [0.1]]}, r"sigma .* not \(3, 1\)"),
        ({"channels": [0, 1.7, 2]}, "LED channel = 1.7"),
        ({"channels": [0, True, 2]}, "LED channel = True"),
        ({"channels": [0, "01", 2]}, "LED channel = '01'"),
    ],
)
def test_observations_are_checked(change: dict[str, Any], message: str) -> None:
    good: dict[str, Any] = {"channels": [0, 1, 2], "pixels": [1.0, 2.0, 3.0], "sigma": 0.1}
    with pytest.raises((ValueError, TypeError), match=message):
        Observation(**{**good, **change})
    # as spikes and frames have them
    taken = Observation(np.arange(3), np.array([1.0, 2.0, 3690.0]), np.float64(0.1))  # type: ignore[arg-type]
    assert taken.channels == (0, 1, 2)
    assert np.array_equal(taken.sigma, [0.1, 0.1, 0.1])


def test_bundles_are_checked() -> None:
    observations = seen(turned(1), STAGGERED, known=(0.5, 0.01))
    with pytest.raises(ValueError, match="observations: none"):
        bundle([], STAGGERED, CAMERA)
    with pytest.raises(ValueError, match=r"observation 1 has LED \d: the map has \[0\]"):
        bundle(observations, LedMap([0], [[0, 0]]), CAMERA)
    with pytest.raises(ValueError, match="camera_sigma: focal: known are scale"):
        bundle(observations, STAGGERED, CAMERA, camera_sigma={"focal": 1.0})
    with pytest.raises(ValueError, match=r"led_sigma .* not \(4,\)"):
        bundle(observations, STAGGERED, CAMERA, led_sigma=[1, 2, 3, 4])
    with pytest.raises(ValueError, match="σ = -1"):
        bundle(observations, STAGGERED, CAMERA, led_sigma=-1)
    wrong: Any = "l2"
    with pytest.raises(ValueError, match="loss = 'l2'"):
        bundle(observations, STAGGERED, CAMERA, loss=wrong)
    few = [Observation([0, 1], [1000.0, 2000.0], 0.1)]
    with pytest.raises(ValueError, match=r"observation 1: 2 LEDs: a pose needs 3"):
        bundle(few, STAGGERED, CAMERA)
    behind = [replace(o, y=Prior(-2000.0, 0.5)) for o in observations]
    with pytest.raises(ValueError, match="behind the tracker"):
        bundle(behind, STAGGERED, CAMERA)


# exact light ------------------------------------------------------------------------------------


UNSURE = SpikeFlags.CLIPPED | SpikeFlags.SATURATED | SpikeFlags.REFLECTION


def made(name: str, seed: int) -> Bench:
    """A head with every part off by its tolerance, LEDs 2 mm off; a tracker sees only its frames."""
    rng = np.random.default_rng(seed)
    head = perturb(DESIGNS[name].system, Tolerances(), rng)
    places = np.array(STAGGERED.positions)
    places[:, :2] += rng.normal(0, 2.0, (len(places), 2))
    return Bench(head, LedMap(STAGGERED.channels, places), seed=seed + 100)


def look(bench: Bench, pose: Pose) -> tuple[list[int], list[float], list[float]]:
    """Channels, spikes and σ of all LEDs."""
    sight = bench.look(pose)
    good = [
        (channel, spike.position, spike.sigma)
        for channel, spike in zip(sight.channels, sight.spikes[0], strict=True)
        if 60 < spike.position < 3587 and not spike.flags & UNSURE  # nothing of it beyond the end
    ]
    channels, pixels, sigma = zip(*good, strict=True) if good else ((), (), ())
    return list(channels), list(pixels), list(sigma)


@pytest.mark.parametrize(("name", "seed"), [("slit-4mm", 5), ("slit-f50-f100", 6)])
def test_accuracy_after_a_bundle_on_exact_light(name: str, seed: int) -> None:
    """Truth is traced through a misassembled head; what is known is the drawing and a grid.

    60 poses on a grid good to 0.5 mm and 0.1°, LEDs known to a few mm. Evaluated elsewhere with
    other noise: heading known below 2 m, solved beyond.
    """
    bench = made(name, seed)
    rng = np.random.default_rng(seed + 200)
    grid = [(x, 1000 / v) for v in np.linspace(0.238, 0.8, 10) for x in np.linspace(-400, 400, 6)]
    poses = [
        Pose(x + rng.normal(0, 0.5), y + rng.normal(0, 0.5), rng.uniform(-0.25, 0.25))
        for x, y in grid
    ]
    exact = math.radians(0.1)
    observations = [
        Observation(
            *spikes,
            Prior(x, 0.5),
            Prior(y, 0.5),
            Prior(pose.heading + rng.normal(0, exact), exact),
        )
        for (x, y), pose in zip(grid, poses, strict=True)
        if (spikes := look(bench, pose))[0]
    ]
    nominal = Calibration.nominal(DESIGNS[name], STAGGERED)
    found = bundle(observations, nominal.leds, nominal.camera, led_sigma=5.0)

    other = np.random.default_rng(seed + 300)
    at = [
        Pose(float(x + other.uniform(-30, 30)), y, other.uniform(-0.05, 0.05))
        for y in (1300.0, 4150.0)
        for x in np.linspace(-350, 350, 8)
    ]
    errors: dict[str, list[tuple[float, float]]] = {"nominal": [], "bundle": []}
    for pose in at:
        channels, pixels, sigma = look(bench, pose)
        known = Prior(pose.heading, 0.0) if pose.y < 2000 else UNKNOWN
        for key, calibration in (("nominal", nominal), ("bundle", found)):
            places = calibration.leds.positions[channels]
            fix = locate(calibration.camera, places, pixels, sigma, heading=known)
            errors[key].append((fix.x - pose.x, fix.y - pose.y))
    off = {key: np.hypot(*np.array(values).T) for key, values in errors.items()}
    near, far = slice(0, 8), slice(8, 16)

    def rms(values: Array) -> float:
        return float(np.sqrt(np.mean(values**2)))

    assert off["bundle"][near].max() <= 1.0
    assert off["bundle"][far].max() <= 2.0
    assert rms(off["nominal"][near]) > 4 * rms(off["bundle"][near])
    places = (found.leds.positions - bench.leds.positions)[1:-1, :2]
    sigma_of_leds = [[found.sigma(f"LED {n} {axis}") for axis in "xy"] for n in range(1, 8)]
    assert rms(places / sigma_of_leds) < 2.0
    assert rms(places[1:-1, 0]) < 1.0
    assert found.camera.model_error < 0.2
    bench.close()


def test_nominal_is_what_exact_light_says() -> None:
    design = DESIGNS["slit-4mm"]
    nominal = Calibration.nominal(design, STAGGERED)
    light = pixel_response(design.system, (-300.0, 0.0, 2000.0), wavelength=0.63)
    spike = SpikeFinder().profile(light * (24_500 / light.max()))
    assert nominal.camera.project([-300.0, 0.0, 2000.0]) == pytest.approx(spike.position, abs=0.2)
    assert nominal.covariance is None
    assert math.isnan(nominal.sigma("scale"))
    assert "nothing was measured" in nominal.notes
    with pytest.raises(ValueError, match="no covariance"):
        nominal.pose_covariance([3, 4, 5], 0.0, 2000.0)
    with pytest.raises(KeyError, match="known are scale"):
        nominal.sigma("focal length")


# the file ---------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def measured() -> Calibration:
    leds = LedMap([3, 5, 9, 12, 20], LedMap.line(5, 500.0, 150.0).positions, [0, 0.1, 0, -0.1, 0])
    observations = seen(turned(5)[::2], leds, noise=0.05, known=(0.5, 0.002))
    sensor = SensorModel(1)
    dark, flat = (
        [Frame(sensor.digitise(np.full(3648, charge), 1e-5)[0]) for _ in range(8)]
        for charge in (0.0, 30_000.0)
    )
    correction = Correction.measure(dark, flat)
    return bundle(observations, leds, CAMERA, correction=correction, notes="Workshop, µm")


def test_a_file_is_read_back_bit_for_bit(measured: Calibration, tmp_path: Path) -> None:
    measured.save(tmp_path / "room.json")
    back = load_calibration(tmp_path / "room.json")
    assert back.camera == measured.camera
    assert back.leds == measured.leds
    assert back.names == measured.names
    assert back.covariance is not None
    assert measured.covariance is not None
    assert np.array_equal(back.covariance, measured.covariance)
    assert (back.rms, back.spikes, back.redundancy, back.notes) == (
        *(measured.rms, measured.spikes, measured.redundancy, measured.notes),
    )
    assert back.correction is not None
    assert measured.correction is not None
    assert back.correction.to_dict() == measured.correction.to_dict()
    back.save(tmp_path / "again.json")
    assert (tmp_path / "again.json").read_bytes() == (tmp_path / "room.json").read_bytes()
    assert [path.name for path in tmp_path.iterdir() if path.suffix != ".json"] == []
    data = json.loads((tmp_path / "room.json").read_text("utf-8"))
    assert data["units"]["length"] == "mm"
    assert data["format"] == "linetrack calibration"


def test_a_nominal_calibration_is_a_file_too(tmp_path: Path) -> None:
    Calibration(CAMERA, RAIL).save(tmp_path / "nominal.json")
    back = load_calibration(tmp_path / "nominal.json")
    assert (back.camera, back.leds, back.covariance) == (CAMERA, RAIL, None)
    assert math.isnan(back.rms)


def test_what_cannot_be_written_leaves_the_old_file(measured: Calibration, tmp_path: Path) -> None:
    path = tmp_path / "room.json"
    path.write_text("old", "utf-8")
    broken = replace(measured, notes="half a character: \ud83d")
    with pytest.raises(ValueError, match="surrogates"):
        broken.save(path)
    assert path.read_text("utf-8") == "old"
    assert list(tmp_path.iterdir()) == [path]
    with pytest.raises(ValueError, match=r"ends in \.json"):
        measured.save(tmp_path / "room.toml")


def changed(**values: Any) -> dict[str, Any]:
    return values


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (changed(format="linetrack design"), "no calibration file"),
        (changed(version=2), "version = 2: this program reads version 1.*later one"),
        (changed(version=True), "version = True"),
        (changed(date="today"), "unknown or missing: date; known are camera"),
        (changed(units={"length": "m"}), r"units = \{'length': 'm'\}"),
        (changed(leds=[{"channel": 1, "position": [0, 0, 0]}]), "LED number 1: .*facing"),
        (
            changed(leds=[{"channel": 1.5, "position": [0, 0, 0], "facing": 0}]),
            "LED channel 1.5: a whole",
        ),
        (changed(leds=[{"channel": 99, "position": [0, 0, 0], "facing": 0}]), "LED channel 99"),
        (changed(camera={"scale": 4000.0}), "camera: unknown or missing"),
        (changed(camera=[]), r"camera = \[\]: a table is needed"),
        (changed(covariance=[[1.0]]), "a row and a column for each of"),
        (changed(covariance=[[1.0], [1.0, 2.0]]), "covariance: a square table"),
        (changed(parameters=["scale"]), "a row and a column for each of 1 names"),
        (changed(covariance=None), "come with their covariance"),
        (changed(rms=-1.0), "rms = -1"),
        (changed(correction={"gain": 1}), "correction"),
        (changed(correction=[]), r"correction = \[\]: a table or null is needed"),
        (changed(notes=None), "notes = None: a text is needed"),
        (changed(leds=[]), "leds: none"),
        (
            changed(leds=[{"channel": 1, "position": "abc", "facing": 0}]),
            "number 1: position = 'ab",
        ),
        (changed(leds=[{"channel": 1, "position": [0, 0], "facing": 0}]), "a list of x, y and z"),
        (changed(leds=[{"channel": 1, "position": [0, None, 0], "facing": 0}]), "LED number 1:"),
        (changed(leds=[{"channel": 1, "position": [0, 0, 0], "facing": 45}]), "45 rad.*degrees"),
        (changed(parameters="scale"), "parameters = 'scale': a list is needed"),
        (changed(parameters=[["scale"]]), r"parameters: \['scale'\]: a name is needed"),
        (changed(covariance=3), "covariance = 3: a list or null is needed"),
        (changed(spikes=2.5), "spikes = 2.5: a whole number is needed"),
        (changed(spikes=True), "spikes = True: a whole number is needed"),
        (changed(spikes=-1), "spikes = -1: allowed is >= 0"),
        (changed(redundancy=-3.7), "redundancy = -3.7: a whole number is needed"),
    ],
)
def test_files_that_are_refused(
    measured: Calibration, tmp_path: Path, change: dict[str, Any], message: str
) -> None:
    path = tmp_path / "room.json"
    measured.save(path)
    data = json.loads(path.read_text("utf-8"))
    path.write_text(json.dumps(data | change), "utf-8")
    with pytest.raises(ValueError, match=f"(?s)room.json: .*{message}"):
        load_calibration(path)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('"scale": 4', '"scale": 1.0, "scale": 4', "scale is there twice"),
        ('"notes": ', '"rms": 0.1, "notes": ', "rms is there twice"),
    ],
)
def test_a_name_that_stands_twice_is_refused(
    measured: Calibration, tmp_path: Path, old: str, new: str, message: str
) -> None:
    path = tmp_path / "room.json"
    measured.save(path)
    text = path.read_text("utf-8")
    assert text.count(old) == 1
    path.write_text(text.replace(old, new), "utf-8")
    with pytest.raises(ValueError, match=message):
        load_calibration(path)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("distortion", 0.1, "distortion = 0.1: a list"),
        ("distortion", None, "distortion = None: a list"),
        ("centre", 1e6, "centre of the camera = 1e.06 px"),
        ("pupil", -5000.0, "pupil of the camera = -5000 mm: allowed is within ± 500"),
    ],
)
def test_cameras_that_are_refused(
    measured: Calibration, tmp_path: Path, name: str, value: Any, message: str
) -> None:
    path = tmp_path / "room.json"
    measured.save(path)
    data = json.loads(path.read_text("utf-8"))
    data["camera"][name] = value
    path.write_text(json.dumps(data), "utf-8")
    with pytest.raises(ValueError, match=f"room.json: .*{message}"):
        load_calibration(path)


def test_leds_in_metres_are_refused(measured: Calibration, tmp_path: Path) -> None:
    path = tmp_path / "room.json"
    measured.save(path)
    data = json.loads(path.read_text("utf-8"))
    for led in data["leds"]:
        led["position"] = [value / 1000 for value in led["position"]]
    path.write_text(json.dumps(data), "utf-8")
    with pytest.raises(ValueError, match="metres"):
        load_calibration(path)


@pytest.mark.parametrize(
    ("covariance", "message"),
    [
        ([[-1.0, 0.0], [0.0, 4.0]], "a variance of -1"),
        ([[1.0, 3.0], [0.0, 4.0]], "not symmetric"),
        ([[1.0, 3.0], [3.0, 4.0]], "a sum of parameters a negative variance"),
        ([[1.0, 1.0], [1.0, 0.0]], "a sum of parameters a negative variance"),
        ([[math.inf, 0.0], [0.0, 4.0]], "covariance = inf"),
    ],
)
def test_what_is_no_covariance_is_refused(covariance: list[list[float]], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Calibration(CAMERA, RAIL, names=("scale", "centre"), covariance=np.array(covariance))
    # a parameter that is known exactly, and two that only their sum is known of, are no mistakes
    Calibration(CAMERA, RAIL, names=("scale", "centre"), covariance=np.diag([1e-12, 0.0]))
    Calibration(CAMERA, RAIL, names=("scale", "centre"), covariance=np.array([[4, -2], [-2, 1.0]]))


def test_other_files_are_refused(tmp_path: Path) -> None:
    for number, content in enumerate((b"[]", b"{", b"\xff\xfe", b'"x"')):
        path = tmp_path / f"{number}.json"
        path.write_bytes(content)
        with pytest.raises(ValueError, match=rf"{number}\.json: "):
            load_calibration(path)
    with pytest.raises(FileNotFoundError):
        load_calibration(tmp_path / "none.json")


def test_names_must_be_known() -> None:
    with pytest.raises(ValueError, match="neither camera nor LEDs have focal"):
        Calibration(CAMERA, RAIL, names=("focal",), covariance=np.eye(1))
    with pytest.raises(ValueError, match="each may be there once"):
        Calibration(CAMERA, RAIL, names=("scale", "scale"), covariance=np.eye(2))
