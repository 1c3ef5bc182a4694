"""Calibration: closed forms, the bundle on synthetic and on traced spikes, the file."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import pytest

from acquisition.frames import Frame
from raytransfer.designs import DESIGNS
from raytransfer.irradiance import pixel_response
from raytransfer.tolerances import Tolerances, perturb
from tracking.calibration import (
    LOSS_SCALE,
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
from twin.sensor import SensorModel
from twin.world import Led, Pose, World

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
    ],
)
def test_observations_are_checked(change: dict[str, Any], message: str) -> None:
    good: dict[str, Any] = {"channels": [0, 1, 2], "pixels": [1.0, 2.0, 3.0], "sigma": 0.1}
    with pytest.raises(ValueError, match=message):
        Observation(**{**good, **change})


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


class Room(NamedTuple):
    """A head as made and LEDs where they are; a tracker never sees this."""

    head: Any
    leds: LedMap

    def rates(self, poses: Sequence[Pose]) -> list[Array]:
        """Electrons per second from every LED, traced, for each pose."""
        lamps = [
            Led(channel, tuple(position), power=0.25)
            for channel, position in zip(
                self.leds.channels, self.leds.positions.tolist(), strict=True
            )
        ]
        world = World(lamps, tracker=lambda number: poses[int(number)], head=self.head)
        return [world.rates(float(n))[list(self.leds.channels)] for n in range(len(poses))]


def made(name: str, seed: int) -> Room:
    """A head with every part off by its tolerance, LEDs 2 mm off."""
    rng = np.random.default_rng(seed)
    head = perturb(DESIGNS[name].system, Tolerances(), rng)
    places = np.array(STAGGERED.positions)
    places[:, :2] += rng.normal(0, 2.0, (len(places), 2))
    return Room(head, LedMap(STAGGERED.channels, places))


UNSURE = SpikeFlags.CLIPPED | SpikeFlags.SATURATED | SpikeFlags.REFLECTION


class Sensor:
    """A sensor with its fixed pattern and noise, and what was measured of it."""

    TIME = 25e-6

    def __init__(self, specimen: int) -> None:
        self.model = SensorModel(specimen)
        dark = [self.frame(np.zeros(3648), 0.0) for _ in range(32)]
        flat = [self.frame(np.full(3648, 1e9), 30e-6) for _ in range(32)]
        self.correction = Correction.measure(dark, flat)
        self.finder = SpikeFinder(self.correction)

    def frame(self, rate: Array, lit: float) -> Frame:
        charge = rate * lit * self.model.response + self.model.dark_rates() * self.TIME
        return Frame(self.model.digitise(charge, self.TIME)[0])

    def look(self, rates: Array) -> tuple[list[int], list[float], list[float]]:
        """Channels, spikes and σ of all LEDs, lit one after the other for at most 0.7 of the well."""
        channels, pixels, sigma = [], [], []
        for channel, rate in enumerate(rates):
            if not rate.any():
                continue
            spikes = self.finder(self.frame(rate, min(self.TIME, 0.7 * 60_000 / rate.max())))
            whole = spikes and 60 < spikes[0].position < 3587  # nothing of it beyond the end
            if whole and not spikes[0].flags & UNSURE:
                channels.append(channel)
                pixels.append(spikes[0].position)
                sigma.append(spikes[0].sigma)
        return channels, pixels, sigma


@pytest.mark.parametrize(("name", "seed"), [("slit-4mm", 5), ("slit-f50-f100", 6)])
def test_accuracy_after_a_bundle_on_exact_light(name: str, seed: int) -> None:
    """Truth is traced through a misassembled head; what is known is the drawing and a grid.

    60 poses on a grid good to 0.5 mm and 0.1°, LEDs known to a few mm. Evaluated elsewhere with
    other noise: heading known below 2 m, solved beyond.
    """
    room, sensor = made(name, seed), Sensor(seed + 100)
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
        for (x, y), pose, rates in zip(grid, poses, room.rates(poses), strict=True)
        if (spikes := sensor.look(rates))[0]
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
    for pose, rates in zip(at, room.rates(at), strict=True):
        channels, pixels, sigma = sensor.look(rates)
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
    places = (found.leds.positions - room.leds.positions)[1:-1, :2]
    sigma_of_leds = [[found.sigma(f"LED {n} {axis}") for axis in "xy"] for n in range(1, 8)]
    assert rms(places / sigma_of_leds) < 2.0
    assert rms(places[1:-1, 0]) < 1.0
    assert found.camera.model_error < 0.2


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
    return bundle(observations, leds, CAMERA, correction=Sensor(1).correction, notes="Workshop, µm")


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
    assert measured.covariance is not None
    broken = replace(measured, covariance=measured.covariance * math.inf)
    with pytest.raises(ValueError, match="JSON"):
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
        (changed(leds=[{"channel": 1.5, "position": [0, 0, 0], "facing": 0}]), "channel = 1.5"),
        (changed(leds=[{"channel": 99, "position": [0, 0, 0], "facing": 0}]), "LED channel 99"),
        (changed(camera={"scale": 4000.0}), "camera: unknown or missing"),
        (changed(camera=[]), r"camera = \[\]: a dict is needed"),
        (changed(covariance=[[1.0]]), "a row and a column for each of"),
        (changed(covariance=[[1.0], [1.0, 2.0]]), "inhomogeneous"),
        (changed(parameters=["scale"]), "a row and a column for each of 1 names"),
        (changed(covariance=None), "come with their covariance"),
        (changed(rms=-1.0), "rms = -1"),
        (changed(correction={"gain": 1}), "correction"),
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
    assert LOSS_SCALE > 1
