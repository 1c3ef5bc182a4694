"""The design studies: the thesis's numbers, inverses, brute force, refusals."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from raytransfer import (
    CATALOGUE,
    SENSORS,
    TCD1304,
    RayMatrix,
    cast_rays,
    cast_rays_to_focal_length,
    collimating_pair,
    prototype_head,
    telecentric_pair,
)
from raytransfer.studies import (
    FAR,
    NEAR,
    THESIS_HALF_LENGTH,
    axial_resolution,
    beam_width,
    field_edge,
    image_position,
    lateral_resolution,
    led_line,
    lens_selection,
    plate_effect,
    resolution_map,
    room_to_optical,
    tracking_area,
    tracking_start,
    untracked_margin,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

F60 = telecentric_pair().matrix("x")
F50 = telecentric_pair("PCX_30_32_50").matrix("x")
F100 = telecentric_pair("PCX_30_32_100").matrix("x")
COLLIMATOR = collimating_pair().matrix("y")
HALF = 14.592
LARGE_LENSES = sorted(part for part, lens in CATALOGUE.items() if lens.height == 30)
IN_FOCUS_OR_FIXED = pytest.mark.parametrize("sensor_dist", [None, 26.1047, 20.0])


# --- the thesis's numbers -------------------------------------------------------------------


def at_digits(value: Any, expected: str) -> bool:
    """Whether a value is the expected one to within half a unit of its last digit."""
    decimals = len(expected.partition(".")[2])
    return abs(float(value) - float(expected)) <= 0.5 * 10.0**-decimals


def test_constants_of_the_thesis() -> None:
    assert (FAR, NEAR, THESIS_HALF_LENGTH) == (5000.0, 500.0, 14.55)
    assert TCD1304.length / 2 == pytest.approx(HALF, rel=1e-15)


def test_focus_of_the_pairs() -> None:
    assert at_digits(cast_rays(30, F60, 5000, 0).focal_length, "26.1047")  # O1
    assert at_digits(cast_rays(30, F60, 500, 0).focal_length, "27.8003")  # O2
    assert at_digits(cast_rays(30, F100, 5000, 0).focal_length, "46.757")  # O4
    assert at_digits(cast_rays(30, F50, 5000, 0).focal_length, "20.496")  # O5
    assert at_digits(telecentric_pair().effective_focal_length("x"), "29.8077")  # O12
    assert at_digits(cast_rays(30, F60, 5000, 0).focal_length - 0.7, "25.4047")  # O16


def test_beam_width_at_half_a_metre() -> None:
    sensor_dist = cast_rays(30, F60, 5000, 0).focal_length
    assert at_digits(beam_width(30, F60, 500, sensor_dist), "1.6180")  # O3


@pytest.mark.parametrize(
    ("matrix", "half_length", "metres"),
    [(F100, 14.55, "1.4505"), (F60, 14.55, "2.4280"), (F60, HALF, "2.4350")],  # O6, O7, O7
)
def test_field_edge_at_five_metres(matrix: RayMatrix, half_length: float, metres: str) -> None:
    assert at_digits(field_edge(matrix, 5000, half_length) / 1000, metres)


@pytest.mark.parametrize(("half_length", "metres"), [(14.55, "1.0502"), (HALF, "1.0473")])
def test_start_of_tracking(half_length: float, metres: str) -> None:
    assert at_digits(tracking_start(F60, 500, half_length) / 1000, metres)  # O8


def test_lateral_move_of_one_pixel() -> None:
    assert at_digits(lateral_resolution(F60, 5000, 0.008), "1.3350")  # O9


def test_margin_of_the_untracked_axis() -> None:
    far, near = untracked_margin(15, COLLIMATOR, [5000, 500], 3.7)
    assert at_digits(far / 1000, "2.745")  # O10
    assert at_digits(near / 1000, "0.281")  # O11


# --- image, field, start --------------------------------------------------------------------


@st.composite
def pairs(draw: st.DrawFn) -> RayMatrix:
    front, back = (draw(st.sampled_from(LARGE_LENSES)) for _ in range(2))
    return telecentric_pair(front, back, round(draw(st.floats(0, 20)), 6)).matrix("x")


far_enough = st.floats(1200, 20_000)  # in front of the front focus of every pair
sensor_dists = st.none() | st.floats(1, 400)
half_lengths = st.floats(0.1, 50)


@settings(deadline=None)
@given(pairs(), far_enough, half_lengths, sensor_dists)
def test_the_field_edge_is_imaged_on_the_end_of_the_line(
    matrix: RayMatrix, dist: float, half_length: float, sensor_dist: float | None
) -> None:
    edge = field_edge(matrix, dist, half_length, sensor_dist)
    assert edge > 0
    position = image_position(matrix, dist, edge, sensor_dist)
    assert position == pytest.approx(-half_length, rel=1e-12)  # inverted
    assert image_position(matrix, dist, -edge, sensor_dist) == pytest.approx(half_length, rel=1e-12)


@settings(deadline=None)
@given(pairs(), st.floats(100, 5000), half_lengths, sensor_dists, st.integers(1, 6))
def test_tracking_starts_where_the_field_edge_is_half_the_leds_away(
    matrix: RayMatrix, spacing: float, half_length: float, sensor_dist: float | None, leds: int
) -> None:
    start = tracking_start(matrix, spacing, half_length, sensor_dist, leds)
    assert start > 0
    edge = field_edge(matrix, start, half_length, sensor_dist)
    assert edge == pytest.approx(spacing * leds / 2, rel=1e-9)
    if leds == 2:
        assert tracking_start(matrix, spacing, half_length, sensor_dist) == start


def test_image_in_focus_is_the_focal_offset() -> None:
    dist, off = np.array([[500.0], [2000.0]]), np.array([-100.0, 0.0, 50.0])
    assert_array_equal(image_position(F60, dist, off), cast_rays(1, F60, dist, off).focal_offset)
    assert type(image_position(F60, 2000, 300)) is float
    assert type(image_position(F60, 2000, 300, 26.0)) is float


def test_image_on_a_fixed_sensor_is_the_middle_of_the_beam() -> None:
    m = np.asarray(F60)
    for dist, off, sensor_dist in [(500.0, 100.0, 26.1), (2000.0, -300.0, 20.0)]:
        # the ray through the middle of the first vertex
        height, angle = m @ [0, -off / dist]
        expected = height + sensor_dist * angle
        assert image_position(F60, dist, off, sensor_dist) == pytest.approx(expected, rel=1e-12)


def test_a_sensor_in_the_focus_is_in_focus() -> None:
    for dist in (500.0, 2000.0, 5000.0):
        focus = cast_rays(1, F60, dist, 0).focal_length
        assert image_position(F60, dist, 300, focus) == pytest.approx(
            image_position(F60, dist, 300), rel=1e-12
        )
        assert field_edge(F60, dist, HALF, focus) == pytest.approx(
            field_edge(F60, dist, HALF), rel=1e-12
        )
        assert lateral_resolution(F60, dist, 0.008, focus) == pytest.approx(
            lateral_resolution(F60, dist, 0.008), rel=1e-12
        )
        assert beam_width(30, F60, dist, focus) == pytest.approx(0, abs=1e-12)


def test_beam_width_by_hand() -> None:
    """Similar triangles: the full aperture narrows to nothing in the focus of a thin lens."""
    thin = RayMatrix([[1.0, 0.0], [-1 / 50, 1.0]])
    focus = 1 / (1 / 50 - 1 / 200)
    for sensor_dist in (0.0, 10.0, focus, 100.0, -20.0):
        expected = 30 * abs(1 - sensor_dist / focus)
        assert beam_width(30, thin, 200, sensor_dist) == pytest.approx(expected, abs=1e-12)


def test_defaults_are_the_thesiss_sensor() -> None:
    assert field_edge(F60, 5000) == field_edge(F60, 5000, HALF)
    assert tracking_start(F60, 500) == tracking_start(F60, 500, HALF)
    assert lateral_resolution(F60, 5000) == lateral_resolution(F60, 5000, 0.008)
    assert axial_resolution(F60, 5000, 500) == axial_resolution(F60, 5000, 500, 0.008)


# --- resolution -----------------------------------------------------------------------------


@IN_FOCUS_OR_FIXED
def test_lateral_resolution_shifts_the_image_by_a_pixel(sensor_dist: float | None) -> None:
    for dist in (500.0, 2000.0, 5000.0):
        step = lateral_resolution(F60, dist, 0.008, sensor_dist)
        before, after = (image_position(F60, dist, p, sensor_dist) for p in (100.0, 100.0 + step))
        assert abs(after - before) == pytest.approx(0.008, rel=1e-9)


@IN_FOCUS_OR_FIXED
@pytest.mark.parametrize("matrix", [F60, F100, prototype_head().matrix("x")])
def test_axial_resolution_is_the_derivative_of_the_separation(
    matrix: RayMatrix, sensor_dist: float | None
) -> None:
    baseline, pitch = 500.0, 0.008
    for dist in (500.0, 2000.0, 5000.0):

        def separation(at: float) -> float:
            one, other = (image_position(matrix, at, p, sensor_dist) for p in (-200.0, 300.0))
            return float(one - other)

        step = 1e-3 * dist
        # central differences of the fourth order
        slope = (
            8 * (separation(dist + step) - separation(dist - step))
            - (separation(dist + 2 * step) - separation(dist - 2 * step))
        ) / (12 * step)
        resolution = axial_resolution(matrix, dist, baseline, pitch, sensor_dist)
        assert resolution == pytest.approx(pitch / abs(slope), rel=1e-9)


@pytest.mark.parametrize("function", [lateral_resolution, field_edge])
@IN_FOCUS_OR_FIXED
def test_shapes(function: Callable[..., Any], sensor_dist: float | None) -> None:
    dists = np.array([[500.0, 1000.0], [2000.0, 5000.0]])
    values = function(F60, dists, sensor_dist=sensor_dist)
    assert values.shape == (2, 2)
    assert values[1, 0] == function(F60, 2000.0, sensor_dist=sensor_dist)


@IN_FOCUS_OR_FIXED
def test_shapes_with_two_arrays(sensor_dist: float | None) -> None:
    values = axial_resolution(F60, [[1000.0], [2000.0]], [1, 2, 3], sensor_dist=sensor_dist)
    assert values.shape == (2, 3)
    assert values[1, 2] == pytest.approx(
        axial_resolution(F60, 2000.0, 3, sensor_dist=sensor_dist), rel=1e-14
    )
    starts = tracking_start(F60, [300.0, 500.0], sensor_dist=sensor_dist)
    assert_array_equal(
        starts, [tracking_start(F60, s, sensor_dist=sensor_dist) for s in (300, 500)]
    )
    assert type(tracking_start(F60, 500, sensor_dist=sensor_dist)) is float
    assert beam_width(30, F60, [500.0, 1000.0], 26.0).shape == (2,)


# --- margin across the line -----------------------------------------------------------------


@pytest.mark.parametrize(
    ("matrix", "width", "sensor_dist"),
    [(COLLIMATOR, 15, 3.7), (COLLIMATOR, 12, 40.0), (prototype_head().matrix("y"), 15, 0.82)],
)
@pytest.mark.parametrize("dist", [500.0, 5000.0])
def test_the_last_ray_from_the_margin_ends_on_the_line(
    matrix: RayMatrix, width: float, sensor_dist: float, dist: float
) -> None:
    margin = untracked_margin(width, matrix, dist, sensor_dist)
    assert type(margin) is float
    to_line = np.array([[1, sensor_dist], [0, 1]]) @ np.asarray(matrix)

    def heights(source: float) -> NDArray[np.float64]:
        """On the sensor's plane, of rays all over the front lens."""
        y = np.linspace(-width / 2, width / 2, 1001)
        return np.asarray((to_line @ np.stack([y, (y - source) / dist]))[0])

    at_margin, size = heights(margin), abs(heights(0)).max()
    assert min(abs(at_margin[[0, -1]])) == pytest.approx(0, abs=1e-12 * size)  # an edge ray
    within, beyond = heights(0.99 * margin), heights(1.01 * margin)
    assert within.min() < 0 < within.max()
    assert beyond.min() > 0 or beyond.max() < 0
    assert_allclose(heights(-margin), -at_margin[::-1], atol=1e-12 * size)


def test_margins_of_many_distances() -> None:
    margins = untracked_margin(15, COLLIMATOR, [[500.0], [5000.0]], 3.7)
    assert margins.shape == (2, 1)
    assert margins[1, 0] == untracked_margin(15, COLLIMATOR, 5000.0, 3.7)


# --- room -----------------------------------------------------------------------------------


def test_led_line_is_centred() -> None:
    assert_array_equal(led_line(5, 500), [-1000, -500, 0, 500, 1000])
    assert_array_equal(led_line(2, 500), [-250, 250])
    assert_array_equal(led_line(1, 500), [0])


def test_heading_0_looks_straight_at_the_line() -> None:
    off, dist = room_to_optical([[100.0, 0.0], [-50.0, 0.0]], 20.0, 3000.0)
    assert_array_equal(dist, [3000, 3000])
    assert_array_equal(off, [-80, 70])  # room x to the left of the pixel line's X


def test_heading_90_looks_along_the_line() -> None:
    off, dist = room_to_optical([[1000.0, 0.0], [-1000.0, 0.0]], 0.0, 300.0, math.pi / 2)
    assert_allclose(dist, [1000, -1000], rtol=1e-12)  # the other one is behind
    assert_allclose(off, [300, 300], rtol=1e-12)


@pytest.mark.parametrize("heading", [0.0, 0.3, math.pi / 2, -2.0, math.pi])
def test_room_to_optical_is_a_rotation_as_documented(heading: float) -> None:
    off, dist = room_to_optical([[1.0, 0.0], [0.0, 1.0]], 0.0, 0.0, heading)
    sin, cos = math.sin(heading), math.cos(heading)
    documented = np.array([[-cos, -sin], [-sin, cos]])
    found = np.array([off, -dist])  # X and Z
    assert_allclose(found, documented, atol=1e-15)
    # orthonormal and right-handed with Y up: X × Y = Z
    x_axis, z_axis = ([*row, 0.0] for row in found)
    assert_allclose(found @ found.T, np.eye(2), atol=1e-15)
    assert_allclose(np.cross(x_axis, [0.0, 0.0, 1.0]), z_axis, atol=1e-15)
    # the tracker looks against Z: along (sin, −cos), counter-clockwise from −y
    ahead = [sin, -cos]
    assert_allclose(room_to_optical([ahead], 0.0, 0.0, heading), [[0.0], [1.0]], atol=1e-15)


def test_shapes_of_the_room() -> None:
    x, y = np.zeros((1, 4)), np.ones((3, 1))
    off, dist = room_to_optical(np.ones((5, 2)), x, y, 0.1)
    assert off.shape == dist.shape == (5, 3, 4)
    off, dist = room_to_optical(np.ones((5, 2)), 0.0, 0.0)
    assert off.shape == dist.shape == (5,)


# --- tracking area --------------------------------------------------------------------------


def brute_force(
    leds: Any, x: float, y: float, heading: float, sensor_dist: float | None
) -> tuple[list[float], list[float], list[float]]:
    """Image, offset and distance of each LED for one tracker, with vectors and single rays."""
    look = np.array([math.sin(heading), -math.cos(heading)])
    pixels = np.array([-math.cos(heading), -math.sin(heading)])
    images, offs, dists = [], [], []
    for led in leds:
        to_led = np.asarray(led) - [x, y]
        dist, off = float(to_led @ look), float(to_led @ pixels)
        image = math.inf
        if dist > 0 and sensor_dist is None:
            focus = cast_rays(30, F60, dist, off)
            if focus.focal_length > 0:
                image = focus.focal_offset
        elif dist > 0:
            assert sensor_dist is not None
            top, bottom = cast_rays_to_focal_length(30, F60, dist, off, sensor_dist)
            image = (top + bottom) / 2
        images.append(image)
        offs.append(off)
        dists.append(dist)
    return images, offs, dists


X, Y = np.linspace(-1500, 1500, 7), np.array([15.0, 300.0, 700.0, 1100.0, 2500.0])
LEDS = np.array([[-1000.0, 0.0], [-400.0, 0.0], [100.0, 0.0], [350.0, 600.0], [900.0, 100.0]])


@IN_FOCUS_OR_FIXED
@pytest.mark.parametrize("heading", [0.0, 0.4, -0.9, math.pi / 2, 3.0])
def test_tracking_area_by_brute_force(heading: float, sensor_dist: float | None) -> None:
    area = tracking_area(F60, LEDS, X, Y, heading=heading, sensor_dist=sensor_dist)
    assert area.position.shape == (5, 5, 7)
    assert area.count.shape == area.tracked().shape == (5, 7)
    for row, y in enumerate(Y):
        for column, x in enumerate(X):
            images, _, _ = brute_force(LEDS, x, y, heading, sensor_dist)
            assert_allclose(area.position[:, row, column], images, rtol=1e-9, atol=1e-9)
            seen = [abs(image) <= HALF for image in images]
            assert area.visible[:, row, column].tolist() == seen
            assert area.count[row, column] == sum(seen)
            for leds in (1, 2, 3):
                assert area.tracked(leds)[row, column] == (sum(seen) >= leds)
    assert_array_equal(area.tracked(), area.tracked(2))
    if heading == 0:
        assert area.count.max() > 2  # the grid shows something
    assert np.isinf(area.position).any()  # and has LEDs without an image


def test_leds_behind_the_tracker_are_not_seen() -> None:
    away = tracking_area(F60, led_line(5, 500), [0.0], [2000.0], heading=math.pi)
    assert_array_equal(away.position, np.full((5, 1, 1), math.inf))
    assert away.count.item() == 0


def test_leds_within_the_front_focus_are_not_seen() -> None:
    front_focus = -F60.D / F60.C
    y = [0.5 * front_focus, 1.5 * front_focus]
    area = tracking_area(F60, [0.0], [1.0], y)
    assert_array_equal(area.visible[0, :, 0], [False, True])
    assert area.position[0, 0, 0] == math.inf


def test_an_led_in_the_front_focus_itself_forms_no_image() -> None:
    front_focus = -F60.D / F60.C
    area = tracking_area(F60, [0.0], [0.0, 1.0], [front_focus])
    assert_array_equal(area.position, np.full((1, 1, 2), math.inf))


def test_a_flat_list_is_a_line_of_leds() -> None:
    line = [-500.0, 0.0, 500.0]
    flat = tracking_area(F60, line, X, Y)
    points = tracking_area(F60, [[x, 0.0] for x in line], X, Y)
    assert_array_equal(flat.position, points.position)
    assert_array_equal(flat.leds, points.leds)
    assert_array_equal(flat.x, X)
    assert_array_equal(flat.y, Y)
    assert flat.half_length == pytest.approx(HALF)


@IN_FOCUS_OR_FIXED
@pytest.mark.parametrize("leds", [1, 2, 3, 4])
def test_from_the_start_on_every_tracker_sees_enough_leds(
    leds: int, sensor_dist: float | None
) -> None:
    """Beside a long line: everywhere from the start on, not everywhere just before it."""
    spacing = 500.0
    start = tracking_start(F60, spacing, HALF, sensor_dist, leds)
    x = np.linspace(0, spacing, 101)  # one period, with the worst places 0 and spacing/2
    y = start * np.array([1 - 1e-6, 1 + 1e-6, 1.01, 1.1, 1.5, 2.0])
    area = tracking_area(
        F60, led_line(41, spacing), x, y, half_length=HALF, sensor_dist=sensor_dist
    )
    tracked = area.tracked(leds)
    assert not tracked[0].all()
    assert tracked[0].any() or leds == 1
    assert tracked[1:].all()


def test_tracking_cannot_start_behind_the_tracker() -> None:
    """With the lenses far apart even the nearest source has a real image."""
    relay = telecentric_pair(gap=100.0).matrix("x")
    assert tracking_area(relay, led_line(41, 5.0), np.linspace(0, 5, 11), [0.1]).tracked().all()
    assert tracking_start(relay, 5.0) >= 0


# --- resolution map -------------------------------------------------------------------------


@IN_FOCUS_OR_FIXED
@pytest.mark.parametrize("heading", [0.0, 0.4, -0.9])
def test_resolution_map_by_brute_force(heading: float, sensor_dist: float | None) -> None:
    resolution = resolution_map(F60, LEDS, X, Y, heading=heading, sensor_dist=sensor_dist)
    area = tracking_area(F60, LEDS, X, Y, heading=heading, sensor_dist=sensor_dist)
    assert_array_equal(resolution.position, area.position)
    compared = 0
    for row, y in enumerate(Y):
        for column, x in enumerate(X):
            images, offs, dists = brute_force(LEDS, x, y, heading, sensor_dist)
            seen = [number for number, image in enumerate(images) if abs(image) <= HALF]
            lateral = resolution.lateral[row, column]
            axial = resolution.axial[row, column]
            if len(seen) < 2:
                assert math.isnan(lateral)
                assert math.isnan(axial)
                continue
            compared += 1
            middle = float(np.mean([dists[number] for number in seen]))
            baseline = float(np.ptp([offs[number] for number in seen]))
            assert lateral == pytest.approx(
                lateral_resolution(F60, middle, 0.008, sensor_dist), rel=1e-9
            )
            assert axial == pytest.approx(
                axial_resolution(F60, middle, baseline, 0.008, sensor_dist), rel=1e-9
            )
    assert 0 < compared < X.size * Y.size


def test_resolution_map_of_another_sensor() -> None:
    sensor = SENSORS["TCD1703"]
    resolution = resolution_map(F60, led_line(5, 500), [0.0], [2000.0], sensor=sensor)
    assert resolution.half_length == pytest.approx(26.25)
    assert resolution.lateral.item() == pytest.approx(
        lateral_resolution(F60, 2000, 0.007), rel=1e-12
    )


def test_resolution_where_all_leds_are_in_one_direction() -> None:
    """Two images that coincide say nothing about the distance; the rest of the map is there."""
    leds = [[0.0, 0.0], [0.0, -500.0]]
    resolution = resolution_map(F60, leds, [0.0, 100.0], [2000.0])
    assert resolution.count.tolist() == [[2, 2]]
    assert not np.isfinite(resolution.axial[0, 0])
    assert np.isfinite(resolution.lateral).all()


# --- lens selection -------------------------------------------------------------------------

ROWS = lens_selection()


def test_lens_selection_studies_every_pair_of_large_convex_lenses() -> None:
    assert len(LARGE_LENSES) == 12
    assert len(ROWS) == 144
    assert {(row.front, row.back) for row in ROWS} == {
        (front, back) for front in LARGE_LENSES for back in LARGE_LENSES
    }


def test_lens_selection_is_sorted() -> None:
    focal = [row.effective_focal_length for row in ROWS]
    assert focal == sorted(focal)
    assert (ROWS[0].front, ROWS[0].back) == ("LJ1695L1", "LJ1695L1")
    assert (ROWS[-1].front, ROWS[-1].back) == ("LJ1516L1", "LJ1516L1")


@pytest.mark.parametrize("row", ROWS[::13], ids=lambda row: f"{row.front}+{row.back}")
def test_lens_selection_agrees_with_the_single_functions(row: Any) -> None:
    pair = telecentric_pair(row.front, row.back)
    matrix = pair.matrix("x")
    assert row.effective_focal_length == pair.effective_focal_length("x")
    assert row.focus_far == pytest.approx(cast_rays(30, matrix, 5000, 0).focal_length, rel=1e-14)
    assert row.focus_near == pytest.approx(cast_rays(30, matrix, 500, 0).focal_length, rel=1e-14)
    assert row.beam_width == pytest.approx(beam_width(30, matrix, 500, row.focus_far), rel=1e-12)
    assert row.field_edge == pytest.approx(field_edge(matrix, 5000, HALF), rel=1e-12)
    assert row.tracking_start == pytest.approx(tracking_start(matrix, 500, HALF), rel=1e-12)
    assert row.lateral_resolution == pytest.approx(
        lateral_resolution(matrix, 5000, 0.008), rel=1e-12
    )


def test_lens_selection_of_given_lenses_and_distances() -> None:
    lenses = iter([CATALOGUE["LJ1430L1"], CATALOGUE["LJ1328L2"]])
    rows = lens_selection(lenses, far=3000, near=1000, led_spacing=300, gap=2.0)
    assert len(rows) == 4
    mixed = next(row for row in rows if (row.front, row.back) == ("LJ1430L1", "LJ1328L2"))
    matrix = telecentric_pair("LJ1430L1", "LJ1328L2", 2.0).matrix("x")
    focus = cast_rays(1, matrix, 3000, 0).focal_length
    assert mixed.focus_far == pytest.approx(focus, rel=1e-14)
    assert mixed.beam_width == pytest.approx(beam_width(15, matrix, 1000, focus), rel=1e-12)
    assert mixed.tracking_start == pytest.approx(tracking_start(matrix, 300), rel=1e-12)


def test_lens_selection_for_a_sensor_longer_than_all_lenses_is_refused() -> None:
    with pytest.raises(ValueError, match=r"as high as the TCD1703 is long \(52\.5 mm\)"):
        lens_selection(sensor=SENSORS["TCD1703"])
    rows = lens_selection([CATALOGUE["LJ1430L1"]], sensor=SENSORS["TCD1703"])
    assert rows[0].lateral_resolution == pytest.approx(
        lateral_resolution(telecentric_pair("LJ1430L1").matrix("x"), 5000, 0.007)
    )


# --- plates ---------------------------------------------------------------------------------


@pytest.mark.parametrize("source_dist", [500.0, 5000.0])
def test_plate_effect_is_two_casts(source_dist: float) -> None:
    head = prototype_head()
    effect = plate_effect(head, source_dist, 28.0)
    foci, widths = [], []
    for plates in (False, True):
        matrix = head.matrix("x", plates=plates)
        foci.append(cast_rays(28.0, matrix, source_dist, 0).focal_length)
        top, bottom = cast_rays_to_focal_length(28.0, matrix, source_dist, 0, 0.82)
        widths.append(abs(top - bottom))
    assert (effect.focus_without, effect.focus_with) == tuple(foci)
    assert_allclose((effect.width_without, effect.width_with), widths, rtol=1e-14)
    assert effect.shift == foci[1] - foci[0]
    assert effect.sensor_dist == 0.82
    # the convex collimator and the window are behind the pair
    assert effect.shift == pytest.approx(5.2 * (1 - 1 / 1.52) + 0.7 * (1 - 1 / 1.5), abs=0.01)


def test_plate_effect_needs_a_sensor() -> None:
    with pytest.raises(ValueError, match=r"^pair PCX_30_32_60 .*: no sensor_distance"):
        plate_effect(telecentric_pair())


# --- refusals -------------------------------------------------------------------------------

GOOD: dict[Callable[..., Any], dict[str, Any]] = {
    image_position: {"source_dist": 2000.0, "axis_off": 300.0, "sensor_dist": 26.0},
    beam_width: {"lens_width": 30.0, "source_dist": 2000.0, "sensor_dist": 26.0},
    lateral_resolution: {"source_dist": 2000.0, "pitch": 0.008, "sensor_dist": 26.0},
    axial_resolution: {
        "source_dist": 2000.0,
        "baseline": 500.0,
        "pitch": 0.008,
        "sensor_dist": 26.0,
    },
    field_edge: {"source_dist": 2000.0, "half_length": 14.0, "sensor_dist": 26.0},
    tracking_start: {"led_spacing": 500.0, "half_length": 14.0, "sensor_dist": 26.0},
    untracked_margin: {"lens_width": 15.0, "source_dist": 2000.0, "sensor_dist": 3.7},
    tracking_area: {
        "leds": [0.0, 500.0],
        "x": [0.0],
        "y": [2000.0],
        "heading": 0.0,
        "half_length": 14.0,
        "sensor_dist": 26.0,
    },
    resolution_map: {
        "leds": [0.0, 500.0],
        "x": [0.0],
        "y": [2000.0],
        "heading": 0.0,
        "sensor_dist": 26.0,
    },
}
ARGUMENTS = [
    pytest.param(function, name, id=f"{function.__name__}-{name}")
    for function, names in GOOD.items()
    for name in names
]
POSITIVE = {"lens_width", "source_dist", "baseline", "pitch", "half_length", "led_spacing"}


def call(function: Callable[..., Any], **changed: Any) -> Any:
    return function(lens_mat=F60, **{**GOOD[function], **changed})


@pytest.mark.parametrize("function", GOOD)
def test_good_arguments_are_good(function: Callable[..., Any]) -> None:
    call(function)


@pytest.mark.parametrize(("function", "name"), ARGUMENTS)
@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_arguments_that_are_not_finite_are_refused(
    function: Callable[..., Any], name: str, bad: float
) -> None:
    with pytest.raises(ValueError, match=f"^{name} = {bad}: "):
        call(function, **{name: bad})


@pytest.mark.parametrize(
    ("function", "name"),
    [case for case in ARGUMENTS if case.values[1] in POSITIVE],
)
@pytest.mark.parametrize("bad", [0.0, -1.0])
def test_arguments_that_are_not_positive_are_refused(
    function: Callable[..., Any], name: str, bad: float
) -> None:
    with pytest.raises(ValueError, match=f"^{name} = {bad:g}: allowed is > 0"):
        call(function, **{name: bad})


@pytest.mark.parametrize(("function", "name"), ARGUMENTS)
@pytest.mark.parametrize("bad", [True, "30", 1j])
def test_arguments_that_are_not_numbers_are_refused(
    function: Callable[..., Any], name: str, bad: Any
) -> None:
    with pytest.raises(TypeError, match=f"^{name}( = .*:|: real numbers are needed)"):
        call(function, **{name: bad})


@pytest.mark.parametrize("function", GOOD)
def test_a_matrix_of_another_shape_is_refused(function: Callable[..., Any]) -> None:
    with pytest.raises(ValueError, match=r"^lens_mat has shape \(2, 2\), not \(3, 3\)"):
        function(lens_mat=np.eye(3), **GOOD[function])


@pytest.mark.parametrize("leds", [0, -1, math.nan])
def test_a_number_of_leds_below_1_is_refused(leds: Any) -> None:
    with pytest.raises(ValueError, match=f"^leds = {leds}: "):
        tracking_start(F60, 500, leds=leds)
    with pytest.raises(ValueError, match=f"^count = {leds}: "):
        led_line(leds, 500)


@pytest.mark.parametrize("count", [2.5, "2", None])
def test_a_number_of_leds_that_is_not_whole_is_refused(count: Any) -> None:
    with pytest.raises((TypeError, ValueError), match=r"^count = "):
        led_line(count, 500)
    with pytest.raises((TypeError, ValueError), match=r"^leds = "):
        tracking_start(F60, 500, leds=count)


@pytest.mark.parametrize("bad", [0, -500, math.nan, math.inf])
def test_spacings_that_are_not_positive_are_refused(bad: float) -> None:
    with pytest.raises(ValueError, match=f"^spacing = {bad:g}: "):
        led_line(3, bad)
    with pytest.raises(ValueError, match=f"^led_spacing = {bad:g}: "):
        tracking_start(F60, bad)


def test_systems_that_form_no_image_have_no_start() -> None:
    diverging = RayMatrix([[1.0, 0.0], [1 / 50, 1.0]])
    for matrix in (diverging, RayMatrix(np.eye(2))):
        with pytest.raises(ValueError, match=r"^C = .*: a system without positive power"):
            tracking_start(matrix, 500)


@pytest.mark.parametrize("shape", [(), (0,), (3, 3), (2, 2, 2), (0, 2)])
def test_leds_of_another_shape_are_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match=r"^leds has shape \(N,\) or \(N, 2\), not "):
        tracking_area(F60, np.ones(shape), [0.0], [2000.0])
    with pytest.raises(ValueError, match=r"^leds has shape \(N,\) or \(N, 2\), not "):
        resolution_map(F60, np.ones(shape), [0.0], [2000.0])


@pytest.mark.parametrize("shape", [(2,), (1, 3), (2, 2, 2)])
def test_room_points_of_another_shape_are_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match=r"^points .*shape"):
        room_to_optical(np.ones(shape), 0.0, 0.0)


@pytest.mark.parametrize("name", ["x", "y"])
def test_grids_of_another_shape_are_refused(name: str) -> None:
    with pytest.raises(ValueError, match=f"^{name} .*shape"):
        call(tracking_area, **{name: [[0.0, 1.0], [2.0, 3.0]]})


@pytest.mark.parametrize("name", ["points", "x", "y", "heading"])
@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_room_arguments_that_are_not_finite_are_refused(name: str, bad: float) -> None:
    good: dict[str, Any] = {"points": [[0.0, 0.0]], "x": 0.0, "y": 0.0, "heading": 0.0}
    value = [[0.0, bad]] if name == "points" else bad
    with pytest.raises(ValueError, match=f"^{name} = {bad}: "):
        room_to_optical(**{**good, name: value})


# --- quiet ----------------------------------------------------------------------------------


def test_no_study_prints(capsys: pytest.CaptureFixture[str]) -> None:
    for function in GOOD:
        call(function)
    led_line(3, 500)
    room_to_optical([[0.0, 0.0]], 0.0, 2000.0)
    lens_selection([CATALOGUE["LJ1430L1"]])
    plate_effect(prototype_head())
    captured = capsys.readouterr()
    assert (captured.out, captured.err) == ("", "")
