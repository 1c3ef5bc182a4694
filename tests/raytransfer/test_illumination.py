"""Paraxial light on the pixels: positions, widths, and every part of the light accounted for."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from raytransfer import TCD1304, cast_rays, prototype_head, telecentric_pair
from raytransfer.illumination import footprint, pixel_solid_angles
from raytransfer.studies import beam_width, image_position
from raytransfer.systems import OpticalSystem

if TYPE_CHECKING:
    from numpy.typing import NDArray

HEAD = prototype_head()


def pair_at(sensor_distance: float) -> OpticalSystem:
    pair = telecentric_pair()
    return OpticalSystem(pair.name, pair.elements, pair.gaps, sensor_distance)


def brute_force(
    system: OpticalSystem, meridian: str, distance: float, offset: float
) -> NDArray[np.float64]:
    """Where a fan of 200,001 rays that no lens stops lands, mm."""
    y = np.linspace(-20, 20, 200_001)
    _, path = system.trace(np.stack([y, (y - offset) / distance]), meridian)  # type: ignore[arg-type]
    half = np.repeat(
        [getattr(e, "size", lambda _: np.inf)(meridian) / 2 for e in system.elements], 2
    )
    passed = np.all(np.abs(path[:, 0]) <= half[:, None], axis=0)
    end = path[-1, 0] + (system.sensor_distance or 0) * path[-1, 1]
    return np.asarray(end[passed])


@settings(deadline=None, max_examples=60)
@given(st.floats(300, 8000), st.floats(-0.5, 0.5), st.sampled_from(["x", "y"]))
def test_footprint_is_where_the_rays_that_pass_land(distance: float, slope: float, m: str) -> None:
    light = footprint(HEAD, m, distance, slope * distance)  # type: ignore[arg-type]
    rays = brute_force(HEAD, m, distance, slope * distance)
    if light is None:
        assert len(rays) <= 1
    else:
        assert light.image == pytest.approx((rays.min(), rays.max()), abs=2e-3)


def test_on_the_axis_it_is_the_studies_position_and_width() -> None:
    light = footprint(HEAD, "x", 1300, 0)
    assert light is not None
    assert HEAD.sensor_distance is not None
    matrix, place = HEAD.matrix("x"), HEAD.sensor_distance
    assert light.centre == pytest.approx(image_position(matrix, 1300, 0, place), abs=1e-12)
    width = beam_width(light.pupil[1] - light.pupil[0], matrix, 1300, place)
    assert light.width == pytest.approx(width, rel=1e-12)


def test_vignetting_moves_the_middle_but_by_less_than_the_light_lost() -> None:
    light = footprint(HEAD, "x", 1300, 600)
    assert light is not None
    chief = image_position(HEAD.matrix("x"), 1300, 600, HEAD.sensor_distance)
    assert light.image[0] < chief < light.image[1]
    assert light.pupil[0] > -15 + 1
    assert light.centre != pytest.approx(chief, abs=0.05)


def test_pixels_share_the_collected_solid_angle() -> None:
    """With the whole footprint on the line the pixels' sum is pupil area over distance squared."""
    system = pair_at(26.5)
    sensor = TCD1304
    x, y = footprint(system, "x", 2000, 0), footprint(system, "y", 2000, 0)
    assert x is not None
    assert y is not None
    area = (x.pupil[1] - x.pupil[0]) * (y.pupil[1] - y.pupil[0])
    expected = area / 2000**2 * sensor.pixel_height / y.width
    assert pixel_solid_angles(system, (0, 0, 2000)).sum() == pytest.approx(expected, rel=1e-12)


def test_light_falls_with_distance_and_angle() -> None:
    near = pixel_solid_angles(HEAD, (0, 0, 1000)).sum()
    far = pixel_solid_angles(HEAD, (0, 0, 4000)).sum()
    assert near / far == pytest.approx(16, rel=0.02)  # the pupil changes a little
    assert pixel_solid_angles(HEAD, (300, 0, 1000)).sum() < near


def test_image_is_inverted_and_leaves_the_line() -> None:
    middle = np.average(np.arange(3648), weights=pixel_solid_angles(HEAD, (250, 0, 1300)))
    assert middle < 1823.5 - 600
    assert not pixel_solid_angles(HEAD, (2000, 0, 1300)).any()
    assert not pixel_solid_angles(HEAD, (0, 0, -100)).any()


def test_a_perfect_focus_fills_one_pixel() -> None:
    pair = telecentric_pair()
    distance = cast_rays(30, pair.matrix("x"), 5000, 100).focal_length
    angles = pixel_solid_angles(pair_at(float(distance)), (100, 0, 5000))
    assert np.count_nonzero(angles > angles.sum() * 1e-6) == 1


def test_a_system_without_a_sensor_is_refused() -> None:
    with pytest.raises(ValueError, match="sensor_distance is needed"):
        footprint(telecentric_pair(), "x", 1000, 0)
    with pytest.raises(ValueError, match="stands before the head"):
        footprint(HEAD, "x", 0, 0)


def test_response_counts_photons() -> None:
    response = TCD1304.response
    assert response is not None
    assert response.quantum_efficiency(0.55) == pytest.approx(0.8)
    assert response.quantum_efficiency(0.40) == pytest.approx(0.8 * 0.80 * 0.55 / 0.40)
    assert response.quantum_efficiency([0.3, 1.2]).tolist() == [0, 0]
