"""Exact light against closed forms, brute force, and numbers found independently.

The numbers under "found independently" are of another program, whose settings are known in part.
Where ours differ, ours are tested. A setting with which the other number would come out is named as
that: it was found by trying several, and may not be the one that was used.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from raytransfer import TCD1304, cast_rays, prototype_head, reference, telecentric_pair
from raytransfer.analysis import (
    Profile,
    chief_rays,
    fan,
    field_curvature,
    field_study,
    height_study,
    line_profile,
    profile,
    spot,
    stop_surface,
    through_focus,
)
from raytransfer.illumination import footprint
from raytransfer.lenses import Aperture, Lens, Plate, SphericalLens
from raytransfer.materials import MATERIALS, ConstantIndex
from raytransfer.prescription import surface_frames
from raytransfer.studies import plate_effect
from raytransfer.systems import OpticalSystem, Placement
from raytransfer.tracing import Status, bundle, trace

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from raytransfer.lenses import Meridian

    Array = NDArray[np.float64]

BARE = telecentric_pair()
FOCUS = float(cast_rays(30, BARE.matrix("x"), 5000, 0).focal_length)
PAIR = replace(BARE, sensor_distance=FOCUS)
FIRST, SECOND = BARE.elements
HEAD = prototype_head()
GLASS = MATERIALS["thesis glass"]


SHUT = OpticalSystem(
    "pair that sees straight ahead", (FIRST, SECOND, Aperture("slit", x=0.1)), (0.0, 20.0), 1.0
)


def with_slit(width: float, *, between: bool = False) -> OpticalSystem:
    slit = Aperture("slit", x=width)
    elements = (FIRST, slit, SECOND) if between else (slit, FIRST, SECOND)
    return OpticalSystem("pair with slit", elements, (0.0, 0.0), FOCUS)


# --- profiles ---


def test_profile_of_even_light() -> None:
    x = (np.arange(10_000) + 0.5) / 10_000 * 4 + 3
    found = profile(x, np.ones_like(x), pitch=0.01)
    assert_allclose(found.centroid, 5, atol=1e-12)
    assert_allclose(found.median, 5, atol=4e-4)
    assert_allclose(found.rms, 4 / math.sqrt(12), rtol=1e-6)
    assert_allclose([found.w50, found.w80], [2, 3.2], atol=8e-4)
    assert_allclose(found.full, 4, atol=8e-4)
    assert_allclose(found.fwhm, 4, atol=1e-9)


def test_profile_of_a_gaussian() -> None:
    x = np.linspace(-8, 8, 200_001)
    found = profile(x + 1.0, np.exp(-(x**2) / 2), pitch=0.005)
    assert abs(found.peak - 1) <= 0.005
    assert_allclose([found.centroid, found.median], 1, atol=1e-4)
    assert_allclose(found.rms, 1, rtol=1e-6)
    assert_allclose(found.fwhm, 2 * math.sqrt(2 * math.log(2)), atol=0.01)
    # quantiles of the normal distribution
    assert_allclose([found.w50, found.w80], [2 * 0.6744898, 2 * 1.2815516], atol=2e-4)


def test_profile_of_two_horns() -> None:
    """A peak picks one of two horns; median, widths and FWHM see both."""
    x = np.array([-1.0, -1.0, 0.0, 1.0, 1.0, 1.0])
    found = profile(x, np.ones(6), pitch=0.008)
    assert_allclose(found.peak, 1.004)
    assert_allclose(found.fwhm, 2 + 0.008)
    assert found.w50 == 0
    assert found.w80 == 2
    assert found.median == 0


@given(
    st.lists(st.tuples(st.floats(-10, 10), st.floats(0, 5) | st.just(0.0)), min_size=1, max_size=30)
)
def test_profile_against_brute_force(points: list[tuple[float, float]]) -> None:
    x, weight = np.array(points).T
    weight = np.where(weight < 1e-3, 0.0, weight)
    found = profile(x, weight)
    if not weight.any():
        assert np.isnan(found).all()
        return
    lit = sorted((a, b) for a, b in zip(x, weight, strict=True) if b > 0)
    total = sum(b for _, b in lit)
    for share, width in ((0.5, found.w50), (0.8, found.w80)):
        best = min(
            hi - lo
            for lo, _ in lit
            for hi, _ in lit
            if lo <= hi and sum(b for a, b in lit if lo <= a <= hi) >= share * total * (1 - 1e-9)
        )
        assert_allclose(width, best, atol=1e-9)
    assert_allclose(found.full, lit[-1][0] - lit[0][0])
    below = sum(b for a, b in lit if a < found.median)
    above = sum(b for a, b in lit if a > found.median)
    assert max(below, above) <= total / 2 * (1 + 1e-9)
    assert_allclose(found.centroid, np.average(x, weights=weight), atol=1e-9)


def test_profiles_of_many_rows_are_those_of_each() -> None:
    random = np.random.default_rng(1)
    x, weight = random.normal(0, 3, (2, 3, 500)), random.random((2, 3, 500))
    weight[0, 1] = 0
    weight[1, 2, 30:] = 0
    together = profile(x, weight)
    for index in np.ndindex(2, 3):
        assert_array_equal(
            [values[index] for values in together], list(profile(x[index], weight[index]))
        )
    assert np.isnan(together.w50[0, 1])
    assert np.isnan(profile(np.empty((2, 0)), np.empty((2, 0))).median).all()


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("name", ["x", "weight"])
def test_a_profile_refuses_what_is_no_light(name: str, bad: float) -> None:
    values = {"x": [0.0, 1.0], "weight": [1.0, 1.0]}
    values[name] = [1.0, bad]
    with pytest.raises(ValueError, match=f"{name} = {bad}: allowed are finite numbers"):
        profile(values["x"], values["weight"])
    with pytest.raises(ValueError, match=r"weight = -0\.5: allowed is >= 0.*background"):
        profile([0.0, 1.0], [1.0, -0.5])


# --- spots ---


@pytest.mark.parametrize("system", [PAIR, HEAD, with_slit(5.0), with_slit(5.0, between=True)])
@pytest.mark.parametrize(
    "position", [(0.0, 0.0, 5000.0), (2000.0, 0.0, 5000.0), (200.0, 90.0, 500.0)]
)
def test_no_light_is_unaccounted_for(
    system: OpticalSystem, position: tuple[float, float, float]
) -> None:
    light = spot(system, position, 101, 101)
    parts = light.weight.sum() + light.lost.sum() + light.faded
    assert_allclose(parts, light.entered, rtol=1e-12)
    kinds = [light.lost_share(kind) for kind in (Status.MISSED, Status.BLOCKED, Status.REFLECTED)]
    assert_allclose(sum(kinds), light.lost_share(), atol=1e-15)
    assert 0 < light.arrived < 1


def test_each_part_of_the_light_is_summed_by_itself() -> None:
    """Where it is tiny beside the others, so that a difference of sums would not have it."""
    plate = Plate("nearly air", 5.0, ConstantIndex("nearly air", 1.0001))
    faint = OpticalSystem("plate", (Aperture("stop", 20.0, 20.0), plate), (1.0,), 9.0)
    rays = bundle(faint, (0.0, 0.0, 5000.0), 101, 101)
    light = trace(faint, rays.position, rays.direction)
    found = spot(faint, (0.0, 0.0, 5000.0), 101, 101)
    assert_allclose(found.faded, math.fsum(rays.solid_angle * (1 - light.transmission)), rtol=1e-12)
    assert_allclose(found.faded / found.entered, 2 * (0.0001 / 2.0001) ** 2, rtol=1e-3)
    assert spot(faint, (0.0, 0.0, 5000.0), 101, 101, fresnel=False).faded == 0

    # a square window over the rim of a round lens, which all but a few rays pass by
    elements = (Aperture("window", 3.0, 3.0), SphericalLens("round", 20.0, 40.0, 1e9, 4.0, GLASS))
    placements = (Placement((8.56, 8.56)), Placement())
    corner = OpticalSystem("corner", elements, (0.0,), 70.0, placements)
    rays = bundle(corner, (0.0, 0.0, 5000.0), 301, 301)
    light = trace(corner, rays.position, rays.direction)
    enter = light.arrived | (light.surface > 1)
    assert 0 < enter.sum() < 30
    found = spot(corner, (0.0, 0.0, 5000.0), 301, 301)
    assert_allclose(found.entered, math.fsum(rays.solid_angle[enter]), rtol=1e-14)


def test_lost_rays_do_not_fade() -> None:
    light = fan(SHUT, "x", 5000, 2000, rays=101)
    assert light.faded == 0
    assert_allclose(light.lost.sum(), light.entered, rtol=1e-12)


@pytest.mark.parametrize(("system", "kind"), [(HEAD, Status.BLOCKED), (PAIR, Status.REFLECTED)])
def test_losses_are_those_of_the_rays(system: OpticalSystem, kind: Status) -> None:
    """Kind and surface of each loss, counted from the trace itself; the front's edge is no loss."""
    position = (2420.0, 100.0, 5000.0)
    rays = bundle(system, position, 151, 151)
    light = trace(system, rays.position, rays.direction)
    found = spot(system, position, 151, 151)
    assert found.lost_share(kind) > 0.04
    for surface in range(len(surface_frames(system))):
        for column, reason in enumerate((Status.MISSED, Status.BLOCKED, Status.REFLECTED)):
            rows = (light.surface == surface) & (light.status == reason)
            expected = rays.solid_angle[rows].sum()
            if surface == 0 and reason != Status.REFLECTED:
                assert found.lost[surface, column] == 0
            else:
                assert_allclose(found.lost[surface, column], expected, rtol=1e-12)


def test_a_round_front_takes_only_what_falls_on_it() -> None:
    lens = SphericalLens("round", 20.0, 40.0, math.inf, 4.0, GLASS)
    system = OpticalSystem("round", (lens,), (), 70.0)
    light = spot(system, (0.0, 0.0, 5000.0), 401, 401, fresnel=False)
    assert_allclose(light.arrived, 1, rtol=1e-12)
    # the solid angle of the disc; the front's edge lies a sag behind its vertex
    edge = 5000 + 40 - math.sqrt(40**2 - 10**2)
    assert_allclose(light.entered, 2 * math.pi * (1 - edge / math.hypot(edge, 10)), rtol=2e-3)


@pytest.mark.parametrize("shift", [-7.3, 0.0, 4.1])
def test_another_plane_is_another_sensor(shift: float) -> None:
    moved = replace(PAIR, sensor_distance=FOCUS + shift)
    here, there = (
        spot(PAIR, (1500, 0, 3000), 51, 11).at(shift),
        spot(moved, (1500, 0, 3000), 51, 11),
    )
    assert_allclose(here.x, there.x, rtol=1e-10, atol=1e-11)
    assert_allclose(here.y, there.y, rtol=1e-10, atol=1e-11)


def test_through_focus_is_each_plane_by_itself() -> None:
    light = fan(PAIR, "x", 2000, 300, rays=2001)
    shifts = [-6.0, -1.0, 0.0, 2.0]
    curve = through_focus(light, shifts)
    for number, shift in enumerate(shifts):
        assert_array_equal([v[number] for v in curve], list(light.at(shift).profile()))


@pytest.mark.parametrize("width", ["rms", "fwhm", "w50", "w80", "full"])
def test_best_focus_is_the_narrowest_of_many_planes(width: str) -> None:
    light = fan(PAIR, "x", 5000, 700, rays=2001)
    shift, size = light.best_focus(width)  # type: ignore[arg-type]
    sizes = getattr(through_focus(light, np.linspace(-12, 6, 361)), width)
    assert size <= sizes.min() + 1e-9
    assert_allclose(getattr(light.at(shift).profile(), width), size, rtol=1e-9)


def test_no_light_has_no_focus() -> None:
    with pytest.raises(ValueError, match="no light arrives"):
        fan(SHUT, "x", 5000, 2000, rays=11).best_focus()
    with pytest.raises(ValueError, match="the rays are parallel"):
        fan(PAIR, "x", 5000, 0, rays=1).best_focus()


def test_a_fan_is_a_slice_of_a_spot() -> None:
    """Middle row of a spot over a thin opening: the same rays, the same light."""
    thin = fan(PAIR, "x", 2000, 400, rays=301)
    whole = spot(PAIR, (400, 0, 2000), 301, 3)
    rows = np.abs(whole.y) < 1e-9
    assert_allclose(whole.x[rows], thin.x, atol=1e-11)
    # a spot's light is per steradian, a fan's per steradian and mm of the 32 mm across
    assert_allclose(whole.weight[rows], thin.weight * 32 / 3, rtol=1e-3)


@pytest.mark.parametrize("meridian", ["x", "y"])
def test_meridians_change_places(meridian: Meridian) -> None:
    turned = OpticalSystem(
        "turned about Z",
        tuple(e.bending("y") if isinstance(e, Lens) else e for e in BARE.elements),
        BARE.gaps,
        FOCUS,
    )
    system = PAIR if meridian == "x" else turned
    light = fan(system, meridian, 3000, 900, rays=1001)
    assert_allclose(
        list(light.profile(meridian)), list(fan(PAIR, "x", 3000, 900, rays=1001).profile())
    )
    study = field_study(system, [3000.0], [900.0], meridian, rays=1001)
    assert_allclose(study.chief, field_study(PAIR, [3000.0], [900.0], rays=1001).chief, atol=1e-9)


# --- the line ---


def test_light_on_the_line_is_what_a_dense_spot_leaves_there() -> None:
    position = (1000.0, 900.0, 5000.0)
    dense = spot(HEAD, position, 400, 6000)
    on = (np.abs(dense.y) <= TCD1304.pixel_height / 2) & (np.abs(dense.x) <= TCD1304.length / 2)
    expected = profile(dense.x[on], dense.weight[on])
    found = line_profile(HEAD, position)
    assert_allclose(found.median, expected.median, atol=0.004)
    assert_allclose(found.centroid, expected.centroid, atol=0.02)
    assert_allclose(found.w80, expected.w80, rtol=0.02)
    assert_allclose(found.rms, expected.rms, rtol=0.01)


# --- chief rays ---


def test_stop_of_each_system() -> None:
    assert stop_surface(PAIR) == 1  # where the curved sides meet
    assert stop_surface(HEAD) == 3
    assert stop_surface(HEAD, "y") == 0
    assert stop_surface(with_slit(3.0)) == 0
    assert stop_surface(with_slit(3.0, between=True)) == 2
    high = OpticalSystem("h", (Aperture("flat slit", y=3.0), FIRST), (1.0,), 50.0)
    assert stop_surface(high) == 2
    assert stop_surface(OpticalSystem("p", (Plate("window", 1.0, GLASS),), (), 1.0)) == 0


@pytest.mark.parametrize("system", [PAIR, HEAD])
@pytest.mark.parametrize("on_line", [False, True])
def test_chief_rays_pass_the_middle_of_the_stop(system: OpticalSystem, on_line: bool) -> None:
    tilted = replace(
        system,
        placements=(
            Placement((0.3, -0.1), (0.02, -0.03, 0.05)),
            *([Placement()] * (len(system.elements) - 1)),
        ),
        gaps=tuple(gap + 2 for gap in system.gaps),
    )
    if system is PAIR and on_line:
        source = np.array([[0.0, 300.0], [0.0, 2.0], [3000.0, 4000.0]])
    else:
        source = np.array([[0.0, 1000.0], [0.0, 150.0], [3000.0, 5000.0]])
    x, y = chief_rays(tilted, source, on_line=on_line)
    assert np.isfinite(x).all()
    if on_line:
        assert_allclose(y, 0, atol=1e-7)
    stop = stop_surface(tilted)
    _, rotation, vertex = surface_frames(tilted)[stop]
    # the same ray from the sensor back to the source: found by aiming at its hit from the source
    for k in range(2):
        start = source[:, k] * [1, 1, -1]
        found = _ray_to(tilted, start, x[k], y[k])
        at_stop = rotation.T @ (found[stop + 1] - vertex)
        assert abs(at_stop[0]) < 1e-5
        if not on_line:
            assert abs(at_stop[1]) < 1e-5


def _ray_to(system: OpticalSystem, start: Array, x: float, y: float) -> Array:
    """Path of the ray that ends at (x, y) on the sensor, by a Gauss–Newton search."""

    def follow(aims: Array) -> Array:
        sources = start[:, None] * np.ones(aims.shape[1])
        return reference.path(system, sources, np.vstack([aims, 0 * aims[:1]]) - sources)

    turn, middle = system.places()[-1]
    aim = np.zeros((2, 1))
    for _ in range(60):
        ends = follow(aim + np.array([[0, 1e-4, 0], [0, 0, 1e-4]]))[-1]
        local = (turn.T @ (ends - middle[:, None]))[:2]
        slope = (local[:, 1:] - local[:, :1]) / 1e-4
        aim = aim - 0.7 * np.linalg.solve(slope, local[:, :1] - [[x], [y]])
    return follow(aim)[:, :, 0]


def test_chief_rays_of_one_source_and_of_none() -> None:
    x, y = chief_rays(PAIR, (1000, 0, 5000))
    assert isinstance(x, float)
    assert y == 0
    # above what the concave lens lets pass: no chief ray
    assert np.isnan(chief_rays(HEAD, (0, 40_000, 5000))[0])
    with pytest.raises(ValueError, match=r"stop = 4: .* has the surfaces 0 to 3"):
        chief_rays(PAIR, (0, 0, 5000), stop=4)
    with pytest.raises(ValueError, match="shape"):
        chief_rays(PAIR, (0, 5000))
    with pytest.raises(ValueError, match="distance of the source"):
        chief_rays(PAIR, (0, 0, -5000))
    with pytest.raises(ValueError, match="sensor_distance is needed"):
        chief_rays(BARE, (0, 0, 5000))


# --- studies ---


def test_a_study_is_the_fans_of_its_places() -> None:
    distances, offsets = np.array([[500.0], [5000.0]]), np.array([0.0, 100.0, 180.0])
    study = field_study(PAIR, distances, offsets, rays=501)
    matrix = PAIR.matrix("x")
    for (i, j), offset in np.ndenumerate(np.broadcast_to(offsets, (2, 3))):
        distance = float(distances[i, 0])
        light = fan(PAIR, "x", distance, float(offset), rays=501)
        assert_allclose(
            [v[i, j] for v in study.light], list(light.profile()), rtol=1e-12, atol=1e-12
        )
        assert_allclose(study.lost[i, j], light.lost_share(), atol=1e-14)
        assert_allclose(study.blocked[i, j], light.lost_share(Status.BLOCKED), atol=1e-14)
        assert_allclose(study.on_sensor[i, j], light.on(), rtol=1e-12)
        assert_allclose(study.arrived[i, j], light.arrived, rtol=1e-12)
        assert_allclose(study.faded[i, j], light.faded / light.entered, rtol=1e-12)
        assert_allclose(study.useful[i, j], light.arrived * light.on(), rtol=1e-12)
        assert_allclose(study.chief[i, j], chief_rays(PAIR, (offset, 0, distance))[0], atol=1e-9)
        light_box = footprint(PAIR, "x", distance, float(offset))
        assert light_box is not None
        assert_allclose(study.paraxial_width[i, j], light_box.width)
        assert_allclose(
            study.image_point[i, j], cast_rays(30, matrix, distance, offset).focal_offset
        )
    assert_allclose(study.angle, np.arctan(offsets / distances))
    assert_allclose(study.lost + study.faded + study.arrived, 1)
    assert_allclose(study.distortion("median", "f_tan"), study.light.median - study.f_tan)


def test_useful_is_what_is_really_on_the_sensor() -> None:
    """Counted from the trace itself, with what surfaces reflect."""
    aim = ((np.arange(4001) + 0.5) / 4001 - 0.5) * 30
    start = np.array([[2420.0], [0.0], [-5000.0]]).repeat(4001, axis=1)
    direction = np.stack([aim, 0 * aim, 0 * aim]) - start
    light = trace(PAIR, start, direction)
    solid_angle = 5000 / (direction**2).sum(axis=0) ** 1.5
    on = light.arrived & (np.abs(light.x) <= TCD1304.length / 2)
    study = field_study(PAIR, 5000, 2420, rays=4001)
    expected = (solid_angle * light.transmission)[on].sum() / solid_angle.sum()
    assert_allclose(study.useful, expected, rtol=1e-9)
    assert_allclose(study.useful, 0.415, atol=5e-4)
    assert_allclose(study.faded, 0.165, atol=5e-4)


def test_near_the_axis_everything_is_paraxial() -> None:
    """Through a slit of 0.02 mm, at 0.1°: differences go with the cube of angles."""
    narrow = with_slit(0.02, between=True)
    study = field_study(narrow, 5000.0, [8.7, -4.0], rays=51)
    for estimator in ("chief", "median", "centroid"):
        assert_allclose(study.distortion(estimator), 0, atol=1e-6)
    assert_allclose(study.light.full, study.paraxial_width, atol=3e-6)
    assert_allclose(study.lost, 1 - 0.02 / 30, atol=0.03)


def test_a_study_refuses_what_it_cannot_do() -> None:
    with pytest.raises(ValueError, match="sensor_distance is needed"):
        field_study(BARE, 5000, 0)
    with pytest.raises(ValueError, match="source_dist"):
        field_study(PAIR, -5000, 0)
    with pytest.raises(ValueError, match="meridian = 'z'"):
        field_study(PAIR, 5000, 0, "z")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="rays"):
        fan(PAIR, "x", 5000, 0, rays=0)
    with pytest.raises(ValueError, match="rays"):
        field_study(PAIR, 5000, 0, rays=0)
    with pytest.raises(ValueError, match="source_dist"):
        fan(PAIR, "x", 0, 0)
    study = field_study(PAIR, 5000, 0, rays=11)
    with pytest.raises(ValueError, match="estimator = 'mean'"):
        study.distortion("mean")
    with pytest.raises(ValueError, match="reference = 'truth'"):
        study.distortion("chief", "truth")
    with pytest.raises(ValueError, match="width = 'thin'"):
        fan(PAIR, "x", 5000, 0, rays=11).best_focus("thin")  # type: ignore[arg-type]


def test_light_that_never_arrives() -> None:
    light = fan(SHUT, "x", 5000, 2000, rays=101)
    assert light.entered > 0
    assert light.arrived == light.on() == 0
    assert_allclose(light.lost_share(), 1)
    assert np.isnan(light.profile().median)
    study = field_study(SHUT, 5000, 2000, rays=101)
    assert np.isnan(study.light.w80)
    assert np.isnan(study.paraxial_width)
    assert study.useful == study.arrived == study.faded == 0


def test_light_that_never_enters() -> None:
    """A slit so far before the lens that light from the side misses the lens."""
    system = OpticalSystem("deep", (Aperture("slit", x=1.0), FIRST), (20.0,), 50.0)
    light = fan(system, "x", 50, 400, rays=101)
    assert light.entered == light.arrived == light.lost_share() == 0
    study = field_study(system, 50, 400, rays=101)
    assert study.lost == study.arrived == study.faded == study.useful == 0


# --- found independently: the f 60 pair alone, ±15 mm, sensor in the paraxial focus of 5 m ---

# distance, offset: chief − paraxial, peak − paraxial, w50, w80, lost %, on the sensor %
TABLE = {
    (5000, 0): (0, 0, 0.79, 3.8, 0, 100),
    (5000, 1000): (0.009, 0.14, 0.87, 4.0, 0.9, 95),
    (5000, 2000): (0.065, 1.08, 1.03, 6.5, 6.4, 73),
    (5000, 2420): (0.113, 1.84, 1.31, 7.7, 12.2, 58),
    (1050, 500): (0.146, 1.62, 1.10, 7.3, 11.5, 60),
    (500, 0): (0, 0.16, 0.31, 2.1, 0.3, 100),
    (500, 231): (0.188, 1.30, 0.79, 6.6, 10.3, 63),
}


def even_in_height(distance: float, offset: float) -> tuple[Profile, float, float]:
    """As the table was made: as many rays for each mm of the opening, wherever the source is."""
    count = 200_001
    aim = (np.arange(count) + 0.5) / count * 30 - 15
    start = np.array([[offset], [0.0], [-distance]]).repeat(count, axis=1)
    light = trace(PAIR, start, np.stack([aim, 0 * aim, 0 * aim]) - start)
    on = light.transmission[np.abs(light.x) <= TCD1304.length / 2].sum() / light.transmission.sum()
    found = profile(light.x, light.transmission)
    return found, 100 * (1 - light.arrived.mean()), 100 * on


@pytest.mark.parametrize("place", TABLE)
def test_table(place: tuple[int, int]) -> None:
    chief, peak, w50, w80, lost, on = TABLE[place]
    found, our_lost, our_on = even_in_height(*place)
    study = field_study(PAIR, *place, rays=20_001)
    assert_allclose(study.distortion("chief"), chief, atol=5e-4)
    assert_allclose(abs(study.distortion("peak")), peak, atol=0.006)
    assert_allclose(found.w50, w50, atol=0.006)
    # two of 42 numbers differ in the last digit, and why is not known
    ours_w80, ours_on = {(500, 0): (2.05, on), (5000, 2000): (w80, 72.45)}.get(place, (w80, on))
    assert_allclose(found.w80, ours_w80, atol=0.005 if place == (500, 0) else 0.05)
    assert_allclose(our_lost, lost, atol=0.06)
    assert_allclose(our_on, ours_on, atol=0.05 if place == (5000, 2000) else 0.5)


def test_table_by_solid_angle() -> None:
    """Ours: a strip of the opening gets the light of its solid angle, less where it is far off."""
    distances, offsets = np.array(list(TABLE), float).T
    study = field_study(PAIR, distances, offsets, rays=20_001)
    assert_allclose(study.light.w50, [0.79, 0.87, 1.03, 1.32, 1.13, 0.31, 0.84], atol=0.006)
    assert_allclose(study.light.w80, [3.84, 3.96, 6.55, 7.69, 7.37, 2.05, 6.84], atol=0.006)
    assert_allclose(100 * study.lost, [0.03, 0.89, 6.34, 12.17, 11.46, 0.27, 10.15], atol=0.01)
    assert_allclose(100 * study.on_sensor, [100, 94.7, 72.4, 58.2, 59.6, 100, 62.4], atol=0.06)
    assert_allclose(study.light.full[5], 6.2, atol=0.05)
    assert_allclose(study.paraxial_width[5], 1.6, atol=0.05)
    # against the image point, not the middle of the light on the sensor
    assert_allclose(study.distortion("chief", "image_point")[[4, 6]], [0.431, 0.869], atol=5e-4)
    assert (abs(study.distortion("chief"))[1:4] / abs(study.paraxial)[1:4]).max() < 0.008


def test_best_focus_on_axis() -> None:
    light = fan(PAIR, "x", 5000, 0)
    shift, size = light.best_focus()
    assert_allclose(shift, -4.3, atol=0.05)
    assert_allclose([light.profile().rms, size], [1.54, 0.63], atol=0.005)


def test_curvature_of_the_field_of_a_narrow_slit() -> None:
    """Between the lenses; in front of them it is −1.5, −5.0 and −6.6 mm."""
    offsets = 5000 * np.tan(np.radians([11.3, 21.8, 25.8]))
    shift, _ = field_curvature(with_slit(3.0, between=True), 5000, offsets.tolist())
    assert_allclose(shift, [-2.0, -6.7, -9.0], atol=0.05)
    shift, _ = field_curvature(with_slit(3.0), 5000, offsets.tolist())
    assert_allclose(shift, [-1.5, -5.0, -6.6], atol=0.05)


def test_a_slit_of_10_mm() -> None:
    light, all_of_it = fan(with_slit(10.0), "x", 5000, 0), fan(PAIR, "x", 5000, 0)
    assert_allclose(light.profile().rms, 0.042, atol=5e-4)  # in front of the pair
    between = fan(with_slit(10.0, between=True), "x", 5000, 0)
    assert_allclose(between.profile().rms, 0.0429, atol=1e-4)
    assert_allclose(1 - light.weight.sum() / all_of_it.weight.sum(), 2 / 3, atol=0.005)


def test_both_curved_sides_toward_the_source() -> None:
    system = OpticalSystem("both curved sides first", (FIRST.turned(), SECOND), (0.0,))
    focus = float(cast_rays(30, system.matrix("x"), 5000, 0).focal_length)
    system = replace(system, sensor_distance=focus)
    assert_allclose(fan(system, "x", 5000, 0).profile().rms, 0.65, atol=0.005)
    edge = fan(system, "x", 5000, 2420, rays=400_001)
    widths = [edge.profile(pitch=pitch).fwhm for pitch in (0.008, 0.02, 0.05)]
    assert_allclose(widths, 5.7, atol=0.05)


def test_plates_of_the_head() -> None:
    """The shift by glass agrees. The chip is 1.155 mm inside the focus, elsewhere 1.61 (beam 1.62).

    A chip 1.065 mm under the window's top, instead of 1.52, would give 1.61. That depth does not
    give the other program's scale and area as well, so it is no explanation.
    """
    effect = plate_effect(HEAD)
    assert_allclose(effect.shift, 2.01, atol=0.005)
    assert_allclose(5.2 * (1 - 1 / 1.52), 1.78, atol=0.005)
    assert_allclose(effect.focus_with - effect.sensor_dist, 1.155, atol=0.001)
    assert_allclose(effect.width_with, 1.16, atol=0.005)


def scales(system: OpticalSystem) -> dict[str, list[float]]:
    """Pixels per 100 mm at 1300 and 4150 mm."""
    study = field_study(system, [[1300.0], [4150.0]], [-50.0, 50.0], rays=20_001)
    values = {"paraxial": study.paraxial, "chief": study.chief, "median": study.light.median}
    return {
        name: (np.abs(np.diff(value, axis=1)[:, 0]) / TCD1304.pitch).tolist()
        for name, value in values.items()
    }


def test_scales() -> None:
    assert_allclose(scales(PAIR)["paraxial"], [288, 90], atol=0.5)
    head = scales(HEAD)
    # elsewhere 293 and 91; from the axis outward it is 292.6 instead of 293.6
    assert_allclose(head["median"], [293.6, 90.8], atol=0.1)
    outward = field_study(HEAD, 1300.0, [0.0, 100.0], rays=20_001).light.median
    assert_allclose(abs(np.diff(outward)) / TCD1304.pitch, 292.6, atol=0.1)
    # elsewhere 271 and 85, which is not reproduced
    assert_allclose(head["chief"], [276.0, 86.8], atol=0.1)


def test_height_couples_into_x() -> None:
    """The change of 12 % agrees; the places are 4 and 3 µm from those elsewhere, −5.871 and −5.163.

    Counting the distance from the pair, 4.63 mm behind the front, would give these; so would a chip
    1.37 mm under the window's top. Which of them, if any, is not known.
    """
    ours = height_study(HEAD, 1000, 5000, [0.0, 2700.0])
    assert_allclose(ours.light.median, [-5.8665, -5.1605], atol=6e-4)
    assert_allclose(ours.light.median[1] / ours.light.median[0] - 1, -0.12, atol=0.005)
    assert_allclose(np.diff(ours.light.median) / TCD1304.pitch, 88.3, atol=0.2)
    assert_allclose(ours.paraxial, -5.827, atol=0.001)


def test_height_couples_little_without_the_collimator() -> None:
    first, second = (
        replace(lens, length=1e5) for lens in (FIRST, SECOND) if isinstance(lens, Lens)
    )
    sources = np.array([[1000.0, 1000.0], [0.0, 2700.0], [5000.0, 5000.0]])

    def change(system: OpticalSystem, stop: int) -> float:
        x, _ = chief_rays(system, sources, stop=stop)
        return float(100 * (x[1] / x[0] - 1))

    alone = OpticalSystem("as in the head", (first, second), HEAD.gaps[1:2], 26.92)
    # through the middle of the second lens; through that of the first it is −0.96 and −1.98 %,
    # and −0.92 and −1.92 % with the lenses in contact
    assert_allclose(change(alone, 2), -0.8, atol=0.05)
    assert_allclose(change(alone, 1), -0.96, atol=0.02)
    plates = (Plate("convex lens, flat", 5.2, GLASS), HEAD.elements[-1])
    assert HEAD.sensor_distance is not None
    slabs = OpticalSystem("slabs", (first, second, *plates), HEAD.gaps[1:], HEAD.sensor_distance)
    assert_allclose(change(slabs, 2), -1.9, atol=0.05)


def test_what_the_collimator_takes_and_gives() -> None:
    """Area of the opening, on the plane of the first vertex, whose light gets to the line."""

    def area(system: OpticalSystem, height: float = 0.0) -> float:
        rays = bundle(system, (0.0, height, 5000.0), 60, 20_000)
        light = trace(system, rays.position, rays.direction, fresnel=False)
        on = light.arrived & (np.abs(light.y) <= TCD1304.pixel_height / 2)
        on &= np.abs(light.x) <= TCD1304.length / 2
        cell = np.ptp(rays.pupil, axis=1) / (59, 19_999)
        return float(on.sum() * cell[0] * cell[1])

    # elsewhere 5.85 and 3.09: both 2 % less, for a reason that is not known; their ratio agrees
    assert_allclose(area(PAIR), 5.95, atol=0.02)
    assert_allclose(area(HEAD), 3.16, atol=0.02)
    assert_allclose(area(HEAD) / area(PAIR), 3.09 / 5.85, atol=0.005)
    assert_allclose(area(HEAD, 2700) / area(HEAD), 0.41, atol=0.005)
