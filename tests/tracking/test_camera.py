"""The camera: its derivatives, its inverse, what fits it, and what glass does to light from above."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from raytransfer.designs import DESIGNS
from raytransfer.irradiance import irradiance
from raytransfer.lenses import Lens, Plate
from raytransfer.localisation import pinhole_jacobian
from raytransfer.materials import ConstantIndex
from raytransfer.sources import Emitter
from raytransfer.studies import room_to_optical
from tracking.camera import Camera, image
from tracking.spikes import SpikeFinder

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from raytransfer.lenses import Element
    from raytransfer.systems import OpticalSystem
    from tracking.spikes import Detector

FULL = Camera(
    3500.0,
    1800.0,
    distortion=(-0.42, 0.19, 0.05, -0.3),
    coupling=(-0.47, 0.12, 0.1, -0.2),
    decentring=(0.01, -0.02, 0.03),
    pupil=-12.0,
    depth=51.0,
)


def field(count: int, seed: int, elevation: float = 0.35) -> NDArray[np.float64]:
    """Points all over the field of a head."""
    rng = np.random.default_rng(seed)
    distance = rng.uniform(1000, 5000, count)
    x = rng.uniform(-0.45, 0.45, count) * distance
    return np.column_stack([x, rng.uniform(-elevation, elevation, count) * distance, distance])


@pytest.fixture(scope="module")
def slit() -> Camera:
    return Camera.from_system(DESIGNS["slit-4mm"].system)


def spikes(
    system: OpticalSystem, points: NDArray[np.float64], detector: Detector
) -> NDArray[np.float64]:
    """Positions of the exact light of LEDs of 2 mm, px."""
    finder = SpikeFinder(detector=detector)
    emitter = Emitter(extent=2.0)
    found = []
    for x, y, distance in points.tolist():
        light = irradiance(
            system, emitter, (x, y, distance), integration_time=1e-3, rays=(192, 64)
        ).electrons
        found.append(finder.profile(24_500 * light / light.max()).position)
    return np.array(found)


def test_a_pinhole_is_the_similarity_of_triangles() -> None:
    camera = Camera.pinhole(28.0)
    assert camera.project([300.0, 500.0, 1500.0]) == pytest.approx(
        1823.5 - 28 / 0.008 * 300 / 1500, abs=1e-10
    )
    leds = np.array([[-250.0, 0.0], [250.0, 30.0]])
    offset, distance = room_to_optical(leds, 100.0, 2000.0, 0.1)
    points = np.column_stack([offset, [0.0, 0.0], distance])
    by_x, _, by_distance = camera.jacobian(points).T
    along_x = by_x * np.cos(0.1) - by_distance * np.sin(0.1)
    expected = pinhole_jacobian(leds, 100.0, 2000.0, 0.1, focal_length=28.0)
    # the workbench's images are upright in its own X, which runs against room x
    np.testing.assert_allclose(along_x, expected[:, 0], rtol=1e-12)


def test_derivatives_along_the_point_are_those_of_differences() -> None:
    points = field(200, 1)
    jacobian = FULL.jacobian(points)
    for axis in range(3):
        step = np.zeros(3)
        step[axis] = 1e-2
        slope = (FULL.project(points + step) - FULL.project(points - step)) / 2e-2
        np.testing.assert_allclose(jacobian[:, axis], slope, atol=2e-8)


def test_derivatives_along_the_parameters_are_those_of_differences() -> None:
    points = field(200, 2)
    jacobian = FULL.parameter_jacobian(points)
    assert jacobian.shape == (200, len(FULL.names))
    for column, name in enumerate(FULL.names):
        step = np.zeros(len(FULL.names))
        step[column] = 1e-4 * max(1.0, abs(FULL.parameters[column]))
        ahead, behind = (
            FULL.with_parameters(FULL.parameters + sign * step).project(points) for sign in (1, -1)
        )
        slope = (ahead - behind) / (2 * step[column])
        np.testing.assert_allclose(jacobian[:, column], slope, atol=1e-6, err_msg=name)


def test_the_compiled_image_is_the_same() -> None:
    from tracking import _poses

    for point in field(50, 3).tolist():
        np.testing.assert_allclose(
            _poses.image(FULL.coefficients, *point), image(FULL.coefficients, *point), rtol=1e-13
        )


def test_tangent_is_the_inverse_of_project() -> None:
    points = field(500, 4)
    m = -points[:, 0] / (points[:, 2] + FULL.pupil)
    q = (points[:, 1] / (points[:, 2] + FULL.depth)) ** 2 / (1 + m**2)
    np.testing.assert_allclose(FULL.tangent(FULL.project(points), q), m, atol=1e-14)


def test_points_behind_have_no_spike() -> None:
    spike = FULL.project([[0.0, 0.0, 1000.0], [0.0, 0.0, -1000.0], [0.0, 0.0, 11.0]])
    assert np.isnan(spike).tolist() == [False, True, True]  # the pupil is 12 mm before the vertex
    assert FULL.sees([[0.0, 0.0, 1000.0], [0.0, 0.0, -1000.0], [900.0, 0.0, 1000.0]]).tolist() == [
        True,
        False,
        False,
    ]


def test_beyond_the_fold_there_is_no_tangent() -> None:
    """The polynomial x (1 − 0.418 x²) rises as far as 0.893, where it is 0.595."""
    camera = Camera(4189.0, 1823.5, (-0.418,))
    fold = 1823.5 + 4189 * 0.5953
    inside = np.array([-600.0, 0.0, 3647.0, fold - 5])
    m = camera.tangent(inside)
    assert np.abs(m).max() < 0.893
    np.testing.assert_allclose(camera.project(np.stack([-m, 0 * m, 1 + 0 * m], -1)), inside)
    assert np.isnan(camera.tangent([-900.0, fold + 5, 5000.0, 1e5])).all()
    assert np.isnan(camera.tangent(1e5))


def test_a_point_whose_spike_is_folded_or_light_too_steep_is_not_seen() -> None:
    camera = Camera(4189.0, 1823.5, (-0.418,), elevation=0.3)
    points = np.array([[-300.0, 0.0, 1000.0], [-1500.0, 0.0, 1000.0], [1600.0, 0.0, 1000.0]])
    assert ((camera.project(points) >= 0) & (camera.project(points) < 3648)).all()
    assert camera.sees(points).tolist() == [True, False, False]
    high = [[100.0, y, 1000.0] for y in (-299.0, 299.0, 301.0, -900.0)]
    assert camera.sees(high).tolist() == [True, True, False, False]


def test_a_camera_travels_in_a_file() -> None:
    camera = replace(FULL, model_error=0.0801, elevation=0.37)
    assert Camera.from_dict(json.loads(json.dumps(camera.to_dict()))) == camera
    data = camera.to_dict()
    with pytest.raises(ValueError, match="unknown or missing: focal_length"):
        Camera.from_dict({**data, "focal_length": 28.0})
    with pytest.raises(TypeError, match=r"camera: names and numbers are needed, not \[1\]"):
        Camera.from_dict([1])  # type: ignore[arg-type]
    for wrong in (0.1, None, "0.1"):
        with pytest.raises(TypeError, match=r"distortion = .*: a list of numbers is needed"):
            Camera.from_dict({**data, "distortion": wrong})
    del data["pupil"]
    with pytest.raises(ValueError, match="unknown or missing: pupil"):
        Camera.from_dict(data)


@pytest.mark.parametrize(
    ("numbers", "message"),
    [
        ({"scale": 28.0}, "was the focal length given in mm"),
        ({"scale": 0.0}, "scale = 0"),
        ({"scale": 3500.0, "distortion": (0.0,) * 5}, "distortion has 5 terms: allowed are 4"),
        ({"scale": 3500.0, "coupling": (float("nan"),)}, r"coupling\[0\] = nan"),
        ({"scale": 3500.0, "model_error": -1.0}, "model_error = -1"),
        ({"scale": 3500.0, "elevation": 0.0}, "elevation = 0"),
    ],
)
def test_impossible_cameras_are_refused(numbers: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Camera(**numbers)


def test_points_that_are_none_are_refused() -> None:
    with pytest.raises(ValueError, match=r"shape \(…, 3\)"):
        FULL.project([[1.0, 2.0]])
    with pytest.raises(ValueError, match="14 parameters are needed"):
        FULL.with_parameters([1.0])


def test_a_fit_finds_the_camera_that_made_the_spikes() -> None:
    camera = Camera(4200.0, 1815.0, (-0.42, 0.19), (-0.47, 0.12), (0.01,), pupil=-3.0, depth=52.0)
    points = field(400, 5)
    found = Camera.fit(
        points, camera.project(points), distortion=2, coupling=2, decentring=1, depth=None
    )
    np.testing.assert_allclose(found.parameters, camera.parameters, rtol=1e-6, atol=1e-7)
    assert found.depth == pytest.approx(52.0, abs=1e-3)
    assert found.model_error < 1e-8


def test_the_scatter_of_a_fit_is_that_of_its_covariance() -> None:
    camera = Camera(4200.0, 1815.0, (-0.42, 0.19), pupil=-3.0)
    points = field(60, 6, elevation=0.0)
    rows = camera.parameter_jacobian(points)
    expected = np.sqrt(np.diag(np.linalg.inv(rows.T @ rows))) * 0.1
    rng = np.random.default_rng(7)
    found = np.array(
        [
            Camera.fit(points, camera.project(points) + rng.normal(0, 0.1, 60)).parameters
            for _ in range(250)
        ]
    )
    # 250 runs tell a standard deviation to 4.5 %
    np.testing.assert_allclose(found.std(axis=0), expected, rtol=0.18)


def test_the_models_error_is_not_the_noises() -> None:
    """Of spikes whose σ is given, only what the model cannot follow is left; it is unbiased."""
    true = Camera(4200.0, 1815.0, (-0.42, 0.19), pupil=-3.0)
    rng = np.random.default_rng(10)
    points = field(40, 11, elevation=0.0)
    sigma = rng.uniform(0.1, 0.5, 40)
    fits = []
    for error in (0.0, 0.4):
        found = []
        for _ in range(150):
            # what no term of the model is: another error at each place
            spikes = true.project(points) + sigma * rng.normal(size=40)
            found.append(Camera.fit(points, spikes + error * rng.normal(size=40), sigma))
        fits.append(np.array([camera.model_error for camera in found]))
    assert np.median(fits[0]) < 0.1  # of 0.32 px of noise
    assert np.sqrt(np.mean(fits[1] ** 2)) == pytest.approx(0.4, rel=0.06)
    # without σ all that is left is the model's, as large as of spikes not fitted
    few = [
        Camera.fit(points[:9], true.project(points[:9]) + rng.normal(0, 0.3, 9)).model_error
        for _ in range(300)
    ]
    assert np.sqrt(np.mean(np.square(few))) == pytest.approx(0.3, rel=0.08)
    assert Camera.fit(points[:5], true.project(points[:5])).model_error == 0


def test_an_elevation_that_is_given_is_taken_or_refused() -> None:
    points = field(50, 12)
    spikes = FULL.project(points)
    assert Camera.fit(points, spikes, pupil=-12.0, elevation=0.25).elevation == 0.25
    with pytest.raises(ValueError, match="elevation = 0"):
        Camera.fit(points, spikes, pupil=-12.0, elevation=0.0)


def test_a_fit_refuses_what_points_do_not_tell() -> None:
    points = field(50, 8)
    points[:, 2], points[:, 1] = 2000.0, 0.0
    pixels = FULL.project(points)
    with pytest.raises(ValueError, match="do not tell pupil"):
        Camera.fit(points, pixels, distortion=0)
    with pytest.raises(ValueError, match="coupling needs heights"):
        Camera.fit(points, pixels, pupil=0.0, coupling=1)
    with pytest.raises(ValueError, match="3 spikes: for 5 numbers"):
        Camera.fit(points[:3], pixels[:3])
    with pytest.raises(ValueError, match="are the columns X, Y, distance"):
        Camera.fit(-points, pixels)


def test_light_from_above_sees_glass_of_a_higher_index(slit: Camera) -> None:
    """The paraxial scale of the head made of nₑ² = n² + (n² − 1) q, against traced light."""
    system = DESIGNS["slit-4mm"].system
    air = system.sensor_distance or 0.0

    def in_light(element: Element, q: float) -> Element:
        if not isinstance(element, Lens | Plate):
            return element
        n = element.material.index(0.63)
        return replace(element, material=ConstantIndex("glass", math.sqrt(n**2 + (n**2 - 1) * q)))

    def scale(q: float) -> float:
        elements = tuple(in_light(element, q) for element in system.elements)
        m = replace(system, elements=elements).matrix("x", wavelength=0.63)
        # the slit is the first element: of a chief ray, position = angle · (B + D · air)
        return float(m.B + m.D * air) / 0.008

    assert slit.scale == pytest.approx(scale(0), rel=5e-4)
    slope = (scale(1e-4) / scale(0) - 1) / 1e-4
    assert slit.coupling[0] == pytest.approx(slope, rel=0.02)


def test_height_in_the_thesis_head_is_what_was_traced_elsewhere() -> None:
    """At X 1000, Y 2700, distance 5000 mm the light's median was found −12 % off, 89 px."""
    camera = Camera.from_system(DESIGNS["thesis"].system, angles=17)
    level, high = camera.project([[1000.0, 0.0, 5000.0], [1000.0, 2700.0, 5000.0]])
    assert (high - camera.centre) / (level - camera.centre) - 1 == pytest.approx(-0.12, abs=0.01)
    assert high - level == pytest.approx(89.0, abs=6.0)


@pytest.mark.parametrize(
    ("name", "detector", "error"),
    [("slit-4mm", "likelihood", 0.05), ("slit-f50-f100", "gravity", 0.1)],
)
def test_the_camera_of_a_head_holds_where_it_was_not_fitted(
    name: str, detector: Detector, error: float, slit: Camera
) -> None:
    system = DESIGNS[name].system
    camera = slit if name == "slit-4mm" else Camera.from_system(system, detector=detector)
    assert 0 < camera.model_error < error
    rng = np.random.default_rng(9)
    distance = rng.uniform(1000, 5000, 30)
    points = np.column_stack(
        [
            rng.uniform(-0.42, 0.42, 30) * distance,
            np.minimum(rng.uniform(-0.38, 0.38, 30) * distance, 1000.0),
            distance,
        ]
    )
    left = spikes(system, points, detector) - camera.project(points)
    # from other points, the RMS is the one that the camera states
    assert np.sqrt(np.mean(left**2)) < 1.5 * camera.model_error
    assert np.abs(left).max() < 5 * camera.model_error
