"""The compiled tracer against what is known without it: closed forms, symmetries, limits."""

from __future__ import annotations

import math
import sys
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import raytransfer
from raytransfer import (
    CATALOGUE,
    THESIS_LENSES,
    ConstantIndex,
    Lens,
    OpticalSystem,
    Plate,
    collimating_pair,
    prototype_head,
    reference,
    telecentric_pair,
)
from raytransfer.lenses import Aperture, SphericalLens
from raytransfer.prescription import surface_frames
from raytransfer.systems import Placement
from raytransfer.tracing import Status, Trace, bundle, trace

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from raytransfer.lenses import Element, Meridian

    Array = NDArray[np.float64]

N = 1.52
GLASS = ConstantIndex("glass", N)
HEAD = prototype_head()
PAIR = replace(telecentric_pair(), sensor_distance=26.1)
COLLIMATOR = replace(collimating_pair(), sensor_distance=3.7)
PCX, PCV = THESIS_LENSES["PCX_30_32_60"], THESIS_LENSES["PCV_15_30_20"]
FIELDS = ("x", "y", "direction", "transmission", "status", "surface")


def alone(element: Element, sensor: float = 20.0, **kwargs: Any) -> OpticalSystem:
    return OpticalSystem("alone", (element,), (), sensor, **kwargs)


def shot(
    heights: tuple[Any, Any] = (0.0, 0.0), slopes: tuple[Any, Any] = (0.0, 0.0), z: float = -10.0
) -> tuple[Array, Array]:
    """Rays by where they cross the plane z = 0 and by their slopes, starting at z."""
    x, y, u, v = np.broadcast_arrays(*map(np.atleast_1d, (*heights, *slopes)))
    direction = np.stack([u, v, np.ones(len(u))]).astype(float)
    return np.stack([x, y, np.zeros(len(x))]) + z * direction, direction


def fan(system: OpticalSystem, source: tuple[float, float, float], n: int = 40) -> tuple[Any, Any]:
    rays = bundle(system, source, n, n)
    return rays.position, rays.direction


def same(one: Trace, other: Trace) -> None:
    """Bit for bit."""
    for name in FIELDS:
        assert_array_equal(getattr(one, name), getattr(other, name))


# --- planes ---------------------------------------------------------------------------------


@pytest.mark.parametrize("angle", [0.0, 0.3, -0.7, 1.2, 1.5])
@pytest.mark.parametrize("tilt", [(0.0, 0.0, 0.0), (0.15, 0.0, 0.4), (0.05, -0.1, 1.0)])
def test_a_plate_displaces_by_the_textbook_and_turns_nothing(
    angle: float, tilt: tuple[float, float, float]
) -> None:
    """Displacement t sin θ (1 − cos θ/√(n² − sin² θ)), in the plane of incidence."""
    t = 7.0
    turn = Placement(tilt=tilt).rotation()
    inward = turn @ [math.sin(angle) * 0.6, math.sin(angle) * 0.8, math.cos(angle)]
    system = alone(Plate("plate", t, GLASS), 30.0, placements=(Placement(tilt=tilt),))
    start = -10 * inward[:, None]
    ray = trace(system, start, inward[:, None])
    assert ray.status[0] == Status.ARRIVED
    assert_allclose(ray.direction[:, 0], inward, rtol=0, atol=1e-15 / math.cos(angle))
    end = np.array([ray.x[0], ray.y[0], t + 30.0])
    across = end - (end @ inward) * inward  # from the line through 0
    sine = math.sin(angle)
    expected = t * sine * (1 - math.cos(angle) / math.sqrt(N**2 - sine**2))
    side = turn @ [-math.cos(angle) * 0.6, -math.cos(angle) * 0.8, sine]
    assert_allclose(across, expected * side, rtol=0, atol=3e-14 * (1 + abs(end).max()))


def test_snell_at_a_prism_in_space() -> None:
    """n1 k × normal = n2 k′ × normal, at a front and a back that are not parallel.

    Two wedges of air: a plate stands tilted behind a tilted one, seen through their normals.
    """
    tilts = [(0.2, -0.1, 0.3), (-0.15, 0.25, 0.0)]
    glasses = [ConstantIndex("a", 1.4), ConstantIndex("b", 1.9)]
    plates = tuple(SphericalLens("p", 30, math.inf, math.inf, 4.0, g) for g in glasses)
    system = OpticalSystem(
        "two", plates, (12.0,), 5.0, tuple(Placement(tilt=tilt) for tilt in tilts)
    )
    position, direction = shot((1.0, -2.0), ([0.1, -0.4, 0.05], [0.3, 0.2, -0.6]))
    path = reference.path(system, position, direction)
    ray = trace(system, position, direction)
    assert ray.arrived.all()
    assert_allclose(path[-1][:2], [ray.x, ray.y], rtol=0, atol=1e-13)
    index = [1.0, 1.4, 1.0, 1.9, 1.0]
    pieces = np.diff(path, axis=0)
    pieces /= np.linalg.norm(pieces, axis=1, keepdims=True)
    for k, (_, rotation, _) in enumerate(surface_frames(system)):
        before, after = (np.cross(pieces[j].T, rotation[:, 2]) for j in (k, k + 1))
        assert_allclose(index[k] * before, index[k + 1] * after, rtol=0, atol=1e-13)
        assert np.abs(before).max() > 0.05


# --- one cylinder, by trigonometry ----------------------------------------------------------


def meridional(heights: Array, meridian: Meridian) -> tuple[Array, Array]:
    return shot((heights, 0.0) if meridian == "x" else (0.0, heights))


@pytest.mark.parametrize("meridian", ["x", "y"])
@pytest.mark.parametrize("radius", [31.0, -31.0])
def test_parallel_light_through_a_cylinder_curved_side_first(
    meridian: Meridian, radius: float
) -> None:
    """Angles of incidence and refraction have sines h/R and h/(n R); then Snell at the plane."""
    lens = replace(PCX, radius=radius, bends=meridian)
    h = np.linspace(-14.9, 14.9, 61)
    ray = trace(alone(lens), *meridional(h, meridian))
    bent = np.arcsin(h / radius) - np.arcsin(h / (N * radius))
    sag = radius - math.copysign(1, radius) * np.sqrt(radius**2 - h**2)
    at_plane = h - (lens.thickness - sag) * np.tan(bent)
    out = np.arcsin(N * np.sin(bent))
    along, across = (ray.x, ray.y) if meridian == "x" else (ray.y, ray.x)
    inside = np.abs(at_plane) <= 15
    assert inside.sum() >= 55
    assert_allclose(along[inside], (at_plane - 20 * np.tan(out))[inside], rtol=0, atol=2e-14)
    assert_array_equal(across, 0)
    assert_array_equal(ray.status == Status.ARRIVED, inside)
    assert_array_equal(ray.surface[~inside], 1)
    d = ray.direction[0 if meridian == "x" else 1]
    assert_allclose(d[inside], -np.sin(out)[inside], rtol=0, atol=1e-15)


@pytest.mark.parametrize("meridian", ["x", "y"])
@pytest.mark.parametrize("radius", [31.0, -31.0, 15.0])
def test_parallel_light_through_a_cylinder_plane_side_first(
    meridian: Meridian, radius: float
) -> None:
    """Straight to the curved side, where it is totally reflected from h = R/n on."""
    lens = replace(PCX, radius=radius, centre_thickness=15.5, bends=meridian, reversed=True)
    h = np.linspace(-14.9, 14.9, 61)
    ray = trace(alone(lens), *meridional(h, meridian))
    passes = np.abs(h) < abs(radius) / N
    assert_array_equal(ray.status, np.where(passes, Status.ARRIVED, Status.REFLECTED))
    assert_array_equal(ray.surface, np.where(passes, -1, 1))
    h = h[passes]
    bent = np.arcsin(N * h / radius) - np.arcsin(h / radius)
    sag = radius - math.copysign(1, radius) * np.sqrt(radius**2 - h**2)
    expected = h - (20 + sag) * np.tan(bent)
    along = (ray.x if meridian == "x" else ray.y)[passes]
    cosine = np.sqrt(1 - (N * h / radius) ** 2)  # grazing rays amplify what is rounded
    assert_allclose(along * cosine, expected * cosine, rtol=0, atol=2e-13)


def test_the_critical_angle_is_where_it_is() -> None:
    """Flagged just beyond R/n, not just before, to a part in 10¹⁴."""
    lens = replace(PCX, radius=20.0, centre_thickness=15.5, reversed=True)
    critical = 20.0 / N
    for side in (-1, 1):
        h = side * critical * (1 + np.array([-1e-6, -1e-10, -1e-14, 1e-14, 1e-10, 1e-6]))
        ray = trace(alone(lens, 0.0), *shot((h, 0.0)))
        # what grazes goes sideways: the plane of the vertex is ahead, 20 mm of circle beside
        assert_array_equal(ray.status == Status.REFLECTED, [0, 0, 0, 1, 1, 1])


def test_the_critical_angle_of_a_plane() -> None:
    """Into a thick lens steeply, so that the plane back is met from inside at asin 1/n."""
    ball = SphericalLens("half", 20.0, 10.0, math.inf, 10.0, GLASS)
    critical = math.asin(1 / N)  # rays through the centre of curvature are not bent in front
    angles = critical * (1 + np.array([-1e-6, -1e-12, -1e-14, 1e-14, 1e-12, 1e-6]))
    slopes = np.tan(angles)
    # through (0, 0, 10), the middle of the plane side
    position = np.stack([-15 * slopes, 0 * slopes, np.full(6, -5.0)])
    ray = trace(alone(ball, 0.0), position, [slopes, 0 * slopes, 1 + 0 * slopes])
    assert_array_equal(ray.status, [0, 0, 0, 3, 3, 3])
    assert_array_equal(ray.surface, [-1, -1, -1, 1, 1, 1])
    assert_allclose(ray.x[:3], 0, atol=1e-14)


# --- skew rays through cylinders ------------------------------------------------------------


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("radius", [31.0, -31.0])
def test_a_cylinder_keeps_the_direction_cosine_along_its_axis(turned: bool, radius: float) -> None:
    rng = np.random.default_rng(3)
    heights, slopes = rng.uniform(-10, 10, (2, 300)), rng.uniform(-0.6, 0.6, (2, 300))
    position, direction = shot((heights[0], heights[1]), (slopes[0], slopes[1]))
    cosines = direction / np.linalg.norm(direction, axis=0)
    curved = replace(PCX, radius=radius, reversed=turned)
    for lens, axis in ((curved.bending("x"), 1), (curved.bending("y"), 0)):
        ray = trace(alone(lens), position, direction)
        assert ray.arrived.sum() > 150
        kept = ray.direction[axis] - cosines[axis]
        assert np.abs(kept[ray.arrived]).max() < 1e-15
        # and not the slope, as two independent matrices would have it
        out = ray.direction[:, ray.arrived]
        changed = out[axis] / out[2] - slopes[axis, ray.arrived]
        assert np.median(np.abs(changed)) > 1e-3


@pytest.mark.parametrize("turned", [False, True])
def test_a_skew_ray_is_a_meridional_one_in_denser_glass(turned: bool) -> None:
    """Across the axis Snell's law holds with √(n² − k²)/√(1 − k²) for n; k is the axial cosine."""
    lens = replace(PCX, reversed=turned)
    h, u = np.meshgrid(np.linspace(-11, 11, 12), np.linspace(-0.2, 0.2, 7))
    for k in (0.1, 0.35, 0.6):
        dense = ConstantIndex("dense", math.sqrt(N**2 - k**2) / math.sqrt(1 - k**2))
        in_plane = np.stack([u.ravel(), 0 * u.ravel(), np.ones(u.size)])
        in_plane /= np.linalg.norm(in_plane, axis=0)
        flat = np.stack([h.ravel(), 0 * h.ravel(), np.zeros(h.size)]) - 5 * in_plane
        skew = math.sqrt(1 - k**2) * in_plane + np.array([[0.0], [k], [0.0]])
        as_skew = trace(alone(replace(lens, length=90)), flat, skew, fresnel=False)
        as_flat = trace(alone(replace(lens, material=dense)), flat, in_plane, fresnel=False)
        both = as_skew.arrived & as_flat.arrived
        assert_array_equal(as_skew.status, as_flat.status)
        assert both.sum() > 60
        assert_allclose(as_skew.x[both], as_flat.x[both], rtol=0, atol=5e-14)
        assert_allclose(
            as_skew.direction[0, both] / math.sqrt(1 - k**2), as_flat.direction[0, both], atol=1e-14
        )


def test_the_meridians_couple() -> None:
    """A source higher up lands elsewhere along the line: what the thesis's matrices deny."""
    position, direction = shot((5.0, 0.0), (0.0, np.array([0.0, 0.3])))
    level, steep = trace(PAIR, position, direction).x
    assert abs(level - steep) > 0.1


# --- spheres --------------------------------------------------------------------------------


def test_light_toward_the_aplanatic_point_of_a_sphere_meets_exactly() -> None:
    """Aimed n R beyond the centre it meets R/n beyond it, at any aperture; sines change by n.

    The back is a sphere about that point, which nothing is bent by.
    """
    radius, t = 20.0, 10.0
    focus = radius + radius / N
    lens = SphericalLens("aplanat", 26.0, radius, focus - t, t, GLASS)
    system = alone(lens, focus - t)
    rng = np.random.default_rng(5)
    r, phi = 12.5 * np.sqrt(rng.uniform(0, 1, 200)), rng.uniform(0, 2 * np.pi, 200)
    on_sphere = np.stack([r * np.cos(phi), r * np.sin(phi), radius - np.sqrt(radius**2 - r**2)])
    direction = np.array([[0.0], [0.0], [radius + N * radius]]) - on_sphere
    position = on_sphere - direction
    ray = trace(system, position, direction)
    assert ray.arrived.all()
    assert_allclose([ray.x, ray.y], 0, atol=3e-14)
    sines = direction[:2] / np.linalg.norm(direction, axis=0)
    assert_allclose(ray.direction[:2], N * sines, rtol=0, atol=3e-15)
    assert np.abs(ray.direction[:2]).max() > 0.35  # no paraxial case


def test_light_from_the_aplanatic_point_seems_to_come_from_its_partner() -> None:
    radius, t = 15.0, 14.0
    to_vertex = radius * (1 + 1 / N)
    lens = SphericalLens("meniscus", 20.0, -(to_vertex - t), -radius, t, GLASS)
    system = alone(lens, 10.0)
    angle, phi = np.linspace(0.01, 0.42, 100), np.linspace(0, 6, 100)
    direction = np.stack([np.sin(angle) * np.cos(phi), np.sin(angle) * np.sin(phi), np.cos(angle)])
    position = np.zeros((3, 100))
    position[2] = t - to_vertex
    ray = trace(system, position, direction)
    assert ray.arrived.all()
    assert_allclose(ray.direction[:2], direction[:2] / N, rtol=0, atol=2e-15)
    out = np.arcsin(np.sin(angle) / N)
    distance = (radius * (1 + N) + 10.0) * np.tan(out)
    assert_allclose(ray.x, distance * np.cos(phi), rtol=0, atol=2e-14)
    assert_allclose(ray.y, distance * np.sin(phi), rtol=0, atol=2e-14)


def test_a_ball_by_trigonometry() -> None:
    """Parallel light at h is turned by 2 (asin h/R − asin h/(n R)) about the centre."""
    radius = 10.0
    ball = SphericalLens("ball", 2 * radius, radius, -radius, 2 * radius, GLASS)
    h = np.linspace(-9.5, 9.5, 39)
    for angle in (0.0, 0.7, math.pi / 2):
        c, s = math.cos(angle), math.sin(angle)
        ray = trace(alone(ball, 30.0), *shot((h * c, h * s)))
        turn = 2 * (np.arcsin(h / radius) - np.arcsin(h / (N * radius)))
        # the line passes the centre at h as before, turned
        expected = h / np.cos(turn) - 40.0 * np.tan(turn)
        assert ray.arrived.all()
        assert_allclose(ray.x, expected * c, rtol=0, atol=1e-12)
        assert_allclose(ray.y, expected * s, rtol=0, atol=1e-12)


def test_a_sphere_may_be_turned_about_its_centre() -> None:
    """All that is left of a tilt is where the edge is."""
    radius, t = 12.0, 24.0
    ball = SphericalLens("ball", 20.0, radius, -radius, t, GLASS)
    position, direction = shot(
        (np.linspace(-4, 4, 9), np.linspace(3, -2, 9)), (np.linspace(0.1, -0.1, 9), 0.07), -20.0
    )
    nominal = trace(alone(ball), position, direction)
    placement = Placement(tilt=(0.3, -0.2, 0.5))
    axis = placement.rotation()[:, 2]
    back = radius * (1 - axis[2])  # the vertex stays at z = 0, the centre comes nearer
    moved = alone(
        ball, 20.0 - back, placements=(replace(placement, decentre=tuple(-radius * axis[:2])),)
    )
    turned = trace(moved, position - [[0], [0], [back]], direction)
    assert nominal.arrived.all()
    assert turned.arrived.all()
    for name in ("x", "y", "direction", "transmission"):
        assert_allclose(getattr(turned, name), getattr(nominal, name), rtol=0, atol=3e-14)


# --- places ---------------------------------------------------------------------------------


def test_an_element_moved_aside_is_the_light_moved_back() -> None:
    position, direction = fan(HEAD, (300.0, -100.0, 2000.0))
    a, b = 0.37, -0.21
    moved = replace(HEAD, placements=(Placement((a, b)),) * 5, sensor_placement=Placement((a, b)))
    one = trace(moved, position + np.array([[a], [b], [0]]), direction)
    other = trace(HEAD, position, direction)
    assert_array_equal(one.status, other.status)
    assert_allclose(one.x, other.x, rtol=0, atol=1e-12)
    assert_allclose(one.y, other.y, rtol=0, atol=1e-12)
    # only the sensor
    only = trace(replace(HEAD, sensor_placement=Placement((a, b))), position, direction)
    assert_allclose(only.x[only.arrived], other.x[other.arrived] - a, rtol=0, atol=1e-14)
    assert_allclose(only.y[only.arrived], other.y[other.arrived] - b, rtol=0, atol=1e-14)


@pytest.mark.parametrize("tilt", [(0.2, 0.0, 0.0), (0.0, -0.3, 0.0), (0.1, 0.15, -0.7)])
@pytest.mark.parametrize(
    "element", [PCX, PCV.bending("y"), SphericalLens("ball", 20, 15, -30, 9, GLASS)]
)
def test_a_rigid_turn_changes_nothing(element: Element, tilt: tuple[float, float, float]) -> None:
    """Lens, sensor and light turned together about the front vertex."""
    placement = Placement(tilt=tilt)
    turn = placement.rotation()
    behind = element.thickness + 20.0
    sensor = turn[:, 2] * behind
    turned = OpticalSystem(
        "turned",
        (element,),
        (),
        sensor[2] - element.thickness,
        (placement,),
        replace(placement, decentre=(sensor[0], sensor[1])),
    )
    rng = np.random.default_rng(8)
    position, direction = shot(
        tuple(rng.uniform(-9, 9, (2, 200))), tuple(rng.uniform(-0.3, 0.3, (2, 200))), -30.0
    )
    one, other = (
        trace(alone(element), position, direction),
        trace(turned, turn @ position, turn @ direction),
    )
    assert one.arrived.sum() > 50
    assert_array_equal(one.status, other.status)
    assert_array_equal(one.surface, other.surface)
    for name in ("x", "y", "direction", "transmission"):
        assert_allclose(getattr(one, name), getattr(other, name), rtol=0, atol=1e-12)


def test_a_quarter_turn_about_the_axis_bends_the_other_meridian() -> None:
    position, direction = fan(PAIR, (100.0, 50.0, 400.0))
    quarter = Placement(tilt=(0, 0, math.pi / 2))
    turned = trace(alone(PCX, placements=(quarter,)), position, direction)
    bending = trace(alone(PCX.bending("y")), position, direction)
    assert_array_equal(turned.status, bending.status)
    assert 0 < turned.arrived.sum() < turned.arrived.size
    assert_allclose(turned.x, bending.x, rtol=0, atol=1e-12)
    assert_allclose(turned.y, bending.y, rtol=0, atol=1e-12)


def test_a_mirrored_source_has_a_mirrored_image() -> None:
    position, direction = fan(HEAD, (300.0, 100.0, 3000.0))
    here = trace(HEAD, position, direction)
    for sign in ([-1, 1, 1], [1, -1, 1], [-1, -1, 1]):
        flip = np.array(sign)[:, None]
        there = trace(HEAD, flip * position, flip * direction)
        assert_array_equal(there.status, here.status)
        assert_array_equal(there.x, sign[0] * here.x)
        assert_array_equal(there.y, sign[1] * here.y)
        assert_array_equal(there.transmission, here.transmission)


# --- principles -----------------------------------------------------------------------------

DISPLACED = replace(
    HEAD,
    placements=(
        Placement((0.2, -0.1), (0.01, -0.02, 0.01)),
        Placement((-0.1, 0.3), (0.002, 0.001, 0.02)),
        Placement((0.1, 0.1), (-0.002, -0.001, -0.02)),
        Placement((0.0, 0.3), (0.02, 0.0, 0.0)),
        Placement(tilt=(0.0, -0.03, 0.0)),
    ),
    sensor_placement=Placement((0.1, 0.1), (0.01, 0.02, -0.01)),
)


@pytest.mark.parametrize("system", [HEAD, DISPLACED], ids=["head", "displaced"])
def test_fermat(system: OpticalSystem) -> None:
    """Moving any point of a ray along its surface does not change the optical path, at first."""
    rays = bundle(system, (300.0, 400.0, 2000.0), 30, 30)
    traced = trace(system, rays.position, rays.direction)
    pick = np.flatnonzero(traced.arrived)[::5]
    assert len(pick) > 20
    path = reference.path(system, rays.position[:, pick], rays.direction[:, pick])
    frames = surface_frames(system)
    index = [1.0, *(1.0 if s.material is None else s.material.index() for s, _, _ in frames)]

    def length(points: Array) -> Array:
        return np.asarray(np.tensordot(index, np.linalg.norm(np.diff(points, axis=0), axis=1), 1))

    step = 1e-3
    for k, (surface, rotation, origin) in enumerate(frames, start=1):
        local = rotation.T @ (path[k] - origin[:, None])
        for axis in (0, 1):
            moved = {}
            for steps in (-2, -1, 1, 2):
                point = local.copy()
                point[axis] += steps * step
                point[2] = surface.sag(point[0], point[1])
                points = path.copy()
                points[k] = rotation @ point + origin[:, None]
                moved[steps] = length(points)
            slope = (8 * (moved[1] - moved[-1]) - (moved[2] - moved[-2])) / (12 * step)
            assert np.abs(slope).max() < 5e-9  # of sines up to 1
    # the tracer lands where the path ends
    rotation, origin = system.places()[-1]
    end = rotation.T @ (path[-1] - origin[:, None])
    assert_allclose(end, [traced.x[pick], traced.y[pick], 0 * pick], rtol=0, atol=1e-12)


@pytest.mark.parametrize("system", [HEAD, PAIR, COLLIMATOR], ids=["head", "pair", "collimator"])
def test_light_finds_its_way_back(system: OpticalSystem) -> None:
    distance = 300.0
    rays = bundle(system, (60.0, -30.0, distance), 30, 30)
    there = trace(system, rays.position, rays.direction)
    on = there.arrived
    assert on.sum() > 100
    assert system.sensor_distance is not None
    back = replace(system.turned(), sensor_distance=distance)
    # half a turn about Y: X and Z change sign, and the light is reversed
    position = np.stack([-there.x[on], there.y[on], np.full(on.sum(), -system.sensor_distance)])
    direction = there.direction[:, on] * [[1], [-1], [1]]
    home = trace(back, position, direction)
    assert home.arrived.all()
    cosine = there.direction[2, on].min()
    assert_allclose(home.x, -60.0, rtol=0, atol=1e-10 / cosine)
    assert_allclose(home.y, -30.0, rtol=0, atol=1e-10 / cosine)
    assert_allclose(home.transmission, there.transmission[on], rtol=1e-11)


# --- exact tends to paraxial ----------------------------------------------------------------


@pytest.mark.parametrize(
    ("system", "meridian"),
    [(PAIR, "x"), (COLLIMATOR, "y"), (HEAD, "x"), (HEAD, "y"), (PAIR, "y"), (COLLIMATOR, "x")],
    ids=["pair x", "collimator y", "head x", "head y", "pair y", "collimator x"],
)
def test_the_difference_to_the_matrix_falls_with_the_third_power(
    system: OpticalSystem, meridian: Meridian
) -> None:
    scale = np.geomspace(0.05, 0.5, 8)
    for height, slope in ((3.0, 0.0), (0.0, 0.1), (2.0, -0.07)):
        zero = np.zeros(8)
        h, u = height * scale, slope * scale
        heights, slopes = ((h, zero), (u, zero)) if meridian == "x" else ((zero, h), (zero, u))
        ray = trace(system, *shot(heights, slopes))
        assert ray.arrived.all()
        m = system.matrix(meridian)
        assert system.sensor_distance is not None
        paraxial, angle = np.asarray(m) @ [h, u]
        paraxial = paraxial + system.sensor_distance * angle
        difference = np.abs((ray.x if meridian == "x" else ray.y) - paraxial)
        if slope == 0 and (system, meridian) in ((PAIR, "y"), (COLLIMATOR, "x")):
            assert_allclose(difference, 0, atol=1e-14)  # plates: nothing to be wrong about
            continue
        exponent, _ = np.polyfit(np.log(scale), np.log(difference), 1)
        assert 2.9 <= exponent <= 3.1
        assert difference[-1] > 1e-6


def test_skew_rays_tend_to_both_matrices_with_the_third_power() -> None:
    scale = np.geomspace(0.05, 0.5, 8)
    h, u = np.array([2.0, -1.0]), np.array([0.03, 0.05])
    ray = trace(HEAD, *shot(tuple(np.outer(h, scale)), tuple(np.outer(u, scale))))
    assert ray.arrived.all()
    assert HEAD.sensor_distance is not None
    for at, meridian, got in ((0, "x", ray.x), (1, "y", ray.y)):
        m = HEAD.matrix("x" if meridian == "x" else "y")
        height, angle = np.asarray(m) @ [h[at], u[at]]
        difference = np.abs(got - scale * (height + HEAD.sensor_distance * angle))
        exponent, _ = np.polyfit(np.log(scale), np.log(difference), 1)
        assert 2.9 <= exponent <= 3.1


def test_paraxial_heights_are_right_to_rounding() -> None:
    """At 1 µm the third power is gone, and the matrix must be exact."""
    for system, meridian in ((PAIR, "x"), (HEAD, "x"), (HEAD, "y")):
        h = np.array([1e-3])
        m = system.matrix(meridian)  # type: ignore[arg-type]
        ray = trace(system, *shot((h, 0.0) if meridian == "x" else (0.0, h)))
        assert system.sensor_distance is not None
        expected = (m.A + system.sensor_distance * m.C) * h
        assert_allclose(ray.x if meridian == "x" else ray.y, expected, rtol=0, atol=1e-11)


# --- dispersion -----------------------------------------------------------------------------


def test_colours_focus_where_their_index_says() -> None:
    """Plane side first the focus is R/(n − 1) behind the curved vertex, for small heights."""
    lens = CATALOGUE["LJ1430L1"].turned()
    h = np.array([1e-2])
    lines = {0.4861327: 1.5223764, 0.5875618: 1.5168000, 0.6562725: 1.5143222}  # F, d, C: Schott
    for wavelength, n in lines.items():
        ray = trace(alone(lens, 0.0), *shot((h, 0.0)), wavelength=wavelength)
        focus = -ray.x * ray.direction[2] / ray.direction[0]
        assert focus[0] == pytest.approx(31.0 / (n - 1), rel=2e-6)
    far = [
        float((-r.x * r.direction[2] / r.direction[0])[0])
        for r in (
            trace(alone(lens, 0.0), *shot((h, 0.0)), wavelength=w) for w in (0.6562725, 0.4861327)
        )
    ]
    assert far[0] - far[1] == pytest.approx(31.0 / 0.5143222 - 31.0 / 0.5223764, rel=5e-5)


def test_the_colour_of_the_head_is_its_matrixs() -> None:
    head = prototype_head(pair=telecentric_pair("LJ1430L1"))
    h = np.array([1e-3])
    assert head.sensor_distance is not None
    shifts = []
    for wavelength in (0.45, 0.63, 0.94):
        ray = trace(head, *shot((h, 0.0)), wavelength=wavelength)
        m = head.matrix("x", wavelength=wavelength)
        assert_allclose(ray.x, (m.A + head.sensor_distance * m.C) * h, rtol=0, atol=1e-11)
        shifts.append(ray.x[0])
    assert np.ptp(shifts) > 1e-6


def test_wavelengths_in_nm_are_refused() -> None:
    for lens in (CATALOGUE["LJ1430L1"], PCX):  # with dispersion and without
        for tracer in (trace, reference.trace):
            with pytest.raises(ValueError, match="given in nm"):
                tracer(alone(lens), *shot(), wavelength=630)


# --- Fresnel --------------------------------------------------------------------------------


@pytest.mark.parametrize("n", [1.0, 1.3, 1.52, 2.5])
def test_straight_light_loses_the_textbooks_share_at_every_surface(n: float) -> None:
    each = 1 - ((n - 1) / (n + 1)) ** 2
    plate = Plate("plate", 2.0, ConstantIndex("any", n))
    for count in (1, 3):
        system = OpticalSystem("stack", (plate,) * count, (1.0,) * (count - 1), 5.0)
        assert_allclose(trace(system, *shot()).transmission, each ** (2 * count), rtol=1e-14)
    assert_array_equal(trace(system, *shot(), fresnel=False).transmission, 1.0)
    lens = replace(PCX, material=ConstantIndex("any", n))
    assert_allclose(trace(alone(lens), *shot()).transmission, each**2, rtol=1e-14)


def test_the_head_on_its_axis_is_the_product_of_its_surfaces() -> None:
    each, window = ((1 - ((n - 1) / (n + 1)) ** 2) for n in (1.52, 1.5))
    assert_allclose(trace(HEAD, *shot()).transmission, each**8 * window**2, rtol=1e-13)


def test_at_brewsters_angle_only_one_polarisation_is_reflected() -> None:
    """R_s = ((n² − 1)/(n² + 1))², R_p = 0; inside the plate it is Brewster's angle again."""
    slope = N  # tan of the angle
    ray = trace(alone(Plate("plate", 2.0, GLASS)), *shot((0, 0), (0.6 * slope, 0.8 * slope)))
    half = 0.5 * ((N**2 - 1) / (N**2 + 1)) ** 2
    assert_allclose(ray.transmission, (1 - half) ** 2, rtol=1e-14)
    # so does a cylinder where its curved side is met at that angle
    h = 31 * math.sin(math.atan(N))
    lens = Lens("tall", 60, 10, 31, 32, GLASS)
    ray = trace(alone(lens, 0.1), *shot((h, 0.0)), fresnel=True)
    bent = math.atan(N) - math.asin(math.sin(math.atan(N)) / N)
    at_back = plane_transmittance(N, 1.0, math.cos(bent))
    assert_allclose(ray.transmission, (1 - half) * at_back, rtol=1e-12)


def plane_transmittance(n1: float, n2: float, cos1: float) -> float:
    """From the sines and tangents of Fresnel's own formulas."""
    i = math.acos(cos1)
    r = math.asin(n1 / n2 * math.sin(i))
    s = (math.sin(i - r) / math.sin(i + r)) ** 2
    p = (math.tan(i - r) / math.tan(i + r)) ** 2
    return 1 - (s + p) / 2


@pytest.mark.parametrize("angle", [1e-3, 0.2, 0.9, 1.3, 1.55])
def test_oblique_light_by_fresnels_sines_and_tangents(angle: float) -> None:
    u = math.tan(angle)
    inside = math.asin(math.sin(angle) / N)
    expected = plane_transmittance(1, N, math.cos(angle)) * plane_transmittance(
        N, 1, math.cos(inside)
    )
    ray = trace(alone(Plate("plate", 2.0, GLASS)), *shot((0, 0), (-0.8 * u, 0.6 * u)))
    assert_allclose(ray.transmission, expected, rtol=1e-11)


def test_transmission_is_a_share() -> None:
    rays = bundle(HEAD, (500.0, 300.0, 1500.0), 100, 100)
    t = trace(HEAD, rays.position, rays.direction)
    assert ((t.transmission > 0) == t.arrived).all()
    assert t.transmission.max() < 0.66
    without = trace(HEAD, rays.position, rays.direction, fresnel=False)
    assert_array_equal(without.transmission, t.arrived)
    for name in ("x", "y", "direction", "status", "surface"):
        assert_array_equal(getattr(without, name), getattr(t, name))


# --- what becomes of rays -------------------------------------------------------------------


def test_statuses_and_surfaces_by_hand() -> None:
    """Each ray is lost at the first surface that it does not pass."""
    lens = Lens("lens", 20, 20, 30, 3, GLASS, reversed=True)  # plane 1, curved 2
    system = OpticalSystem("slit", (Aperture("slit", x=24.0), lens), (2.0,), 10.0)
    cases = [  # height and slope at the slit, and what follows
        ((0.0, 0.0), (0.0, 0.0), Status.ARRIVED, -1),
        ((12.1, 0.0), (0.0, 0.0), Status.BLOCKED, 0),
        ((5.9, 0.0), (0.0, 0.0), Status.ARRIVED, -1),
        ((10.1, 0.0), (0.0, 0.0), Status.BLOCKED, 1),
        ((0.0, 10.1), (0.0, 0.0), Status.BLOCKED, 1),
        ((7.9, 0.0), (1.0, 0.0), Status.BLOCKED, 2),  # at 9.9 and 10.7 mm
        ((11.85, 0.0), (-1.0, 0.0), Status.REFLECTED, 2),  # at 17.4 + 27.7 degrees
    ]
    heights, slopes, status, surface = zip(*cases, strict=True)
    ray = trace(system, *shot(tuple(np.transpose(heights)), tuple(np.transpose(slopes))))
    assert_array_equal(ray.status, status)
    assert_array_equal(ray.surface, surface)
    assert_array_equal(ray.arrived, ray.status == 0)
    assert ray.status.dtype == np.uint8
    assert ray.surface.dtype == np.int16
    assert [status.name for status in Status] == ["ARRIVED", "MISSED", "BLOCKED", "REFLECTED"]


def test_rays_beside_a_sphere_miss_it() -> None:
    ball = SphericalLens("ball", 20.0, 10.0, -10.0, 20.0, GLASS)
    ray = trace(alone(ball), *shot(([9.999, 10.001, 20.0], 0.0)))
    assert_array_equal(ray.status, Status.MISSED)
    # what just meets it is turned by 96 degrees and misses the sensor
    assert_array_equal(ray.surface, [2, 0, 0])


def test_rays_turned_away_from_the_sensor_miss_it() -> None:
    system = alone(Aperture("open"), 10.0, sensor_placement=Placement(tilt=(0, 1.5, 0)))
    ray = trace(system, *shot(([0.0, 0.0], 0.0), ([0.0, -20.0], 0.0)))
    assert_array_equal(ray.status, [0, 1])
    assert_array_equal(ray.surface, [-1, 1])  # the plane behind the one surface


def test_a_lost_ray_is_0() -> None:
    rays = bundle(HEAD, (500.0, 300.0, 900.0), 100, 100)
    ray = trace(HEAD, rays.position, rays.direction)
    lost = ~ray.arrived
    assert {0, 2, 3} <= set(ray.status.tolist())
    for values in (ray.x, ray.y, ray.transmission, *ray.direction):
        assert_array_equal(values[lost], 0)
    assert_array_equal(ray.surface == -1, ray.arrived)
    assert_allclose(np.linalg.norm(ray.direction[:, ray.arrived], axis=0), 1, rtol=1e-14)


def test_without_a_sensor_rays_end_at_the_last_vertex() -> None:
    position, direction = fan(PAIR, (20.0, 10.0, 500.0))
    here = trace(telecentric_pair(), position, direction)
    there = trace(replace(PAIR, sensor_distance=0.0), position, direction)
    same(here, there)


def test_edges_belong_to_the_opening() -> None:
    slit = alone(Aperture("slit", x=5.0, y=4.0))
    x, y = [2.5, np.nextafter(2.5, 9), -2.5, 0, 0], [0, 0, 2, -2, np.nextafter(-2, -9)]
    assert_array_equal(trace(slit, *shot((x, y))).status, [0, 2, 0, 0, 2])
    disc = alone(SphericalLens("disc", 10.0, math.inf, math.inf, 1.0, GLASS))
    x, y = [3.0, 5.0, np.nextafter(5.0, 9), 4.9], [4.0, 0.0, 0.0, 4.9]
    assert_array_equal(trace(disc, *shot((x, y))).status, [0, 0, 2, 2])
    clear = alone(replace(PCX, clear=(20.0, 6.0)))
    assert_array_equal(
        trace(clear, *shot(([9.9, 10.1, 0, 0], [0, 0, 2.9, 3.1]))).status, [0, 2, 0, 2]
    )


def test_a_clear_aperture_cuts_and_changes_nothing_else() -> None:
    position, direction = fan(PAIR, (100.0, 50.0, 700.0))
    lens = replace(PCX, clear=(20.0, 24.0))
    cut = replace(PAIR, elements=(lens.turned(), lens))
    one, other = trace(PAIR, position, direction), trace(cut, position, direction)
    assert 100 < other.arrived.sum() < one.arrived.sum()
    assert one.arrived[other.arrived].all()
    for name in ("x", "y", "transmission"):
        assert_array_equal(getattr(one, name)[other.arrived], getattr(other, name)[other.arrived])


# --- surfaces deep and far ------------------------------------------------------------------


@pytest.mark.parametrize("gap", [0.0, 5.0, 10.0, 10.4, 20.0, 300.0])
def test_a_hollow_lens_is_found_from_any_distance(gap: float) -> None:
    """From inside its circle and from outside: an open screen before it is no matter."""
    behind = OpticalSystem("behind", (Aperture("open"), PCV), (gap,), 8.0)
    rng = np.random.default_rng(2)
    heights, slopes = rng.uniform(-7, 7, (2, 200)), rng.uniform(-0.5, 0.5, (2, 200))
    position, direction = shot(tuple(heights), tuple(slopes), -310.0)
    one = trace(alone(PCV, 8.0), position, direction)
    moved = position + np.array([[0], [0], [gap]])
    two = trace(behind, moved, direction)
    assert one.arrived.sum() > 60
    assert_array_equal(one.status, two.status)
    assert_array_equal(np.where(one.arrived, -1, one.surface + 1), two.surface)
    assert_allclose(one.x, two.x, rtol=0, atol=1e-11)
    assert_allclose(one.y, two.y, rtol=0, atol=1e-11)


def test_light_that_goes_backward_seen_from_a_tilted_lens() -> None:
    """From within the hollow, and never to the plane of its vertex; against the reference."""
    lens = alone(PCV, placements=(Placement(tilt=(0.3, 0.0, 0.5)),))
    rotation = lens.places()[0][0]
    x, y = (v.ravel() for v in np.meshgrid(np.linspace(-3, 3, 41), np.linspace(-1, 1, 41)))
    toward = rotation @ np.stack([x, y, np.full(x.size, -0.05)])
    toward = toward[:, toward[2] > 0]
    start = (rotation @ [[0.5], [-0.5], [-1.5]]).repeat(toward.shape[1], axis=1)
    found, expected = (tracer(lens, start, toward) for tracer in (trace, reference.trace))
    assert_array_equal(found.status, expected.status)
    assert_array_equal(found.surface, expected.surface)
    assert {*found.surface.tolist()} == {0, 1}


def test_a_half_cylinder_from_its_plane_side() -> None:
    """The plane holds the axis: rays start deep inside the circle, toward and away from it."""
    radius = 15.0
    lens = Lens("half", 30, 30, radius, radius, GLASS, reversed=True)
    h, angle = (v.ravel() for v in np.meshgrid(np.linspace(-12, 12, 25), [-0.5, 0.0, 0.4]))
    ray = trace(alone(lens, 25.0), *shot((h, 0.0), (np.tan(angle), 0.0)))
    inside = np.arcsin(np.sin(angle) / N)
    sine = h * np.cos(inside) / radius  # of incidence at the circle: the ray's arm over R
    passes = np.abs(N * sine) < 1
    assert 20 < passes.sum() < passes.size
    assert_array_equal(ray.status, np.where(passes, Status.ARRIVED, Status.REFLECTED))
    h, inside, sine = h[passes], inside[passes], sine[passes]
    where = np.arcsin(sine) + inside  # of the point on the circle, seen from the axis
    out = where - np.arcsin(N * sine)
    x, z = radius * np.sin(where), radius * np.cos(where)
    expected = x + (radius + 25.0 - z) * np.tan(out)
    cosine = np.sqrt(1 - (N * sine) ** 2) * np.cos(out)
    assert_allclose(ray.x[passes] * cosine, expected * cosine, rtol=0, atol=1e-12)


def test_light_beyond_a_lens_does_not_meet_it_backward() -> None:
    """From a hollow back light leaves outward past a small ball: it misses, whatever lies behind."""
    wide = Lens("wide", 30, 30, -15.5, 1.0, GLASS).turned()
    ball = SphericalLens("ball", 4.0, 2.0, -2.0, 4.0, GLASS)
    system = OpticalSystem("past", (wide, ball), (0.5,), 20.0)
    x = np.linspace(8, 14.5, 40)
    for slope in (0.0, 0.3, 1.0):
        ray = trace(system, *shot((x, 0.0), (slope, 0.0)))
        assert not ray.arrived.any()
        assert_array_equal(ray.status[ray.surface == 2], Status.MISSED)


# --- the same bits --------------------------------------------------------------------------


@pytest.mark.parametrize("count", [0, 1, 2, 1023, 1024, 1025, 5000])
def test_a_ray_does_not_depend_on_the_others(count: int) -> None:
    """Nor on threads, nor on its place among them."""
    rng = np.random.default_rng(7)
    position, direction = shot(
        tuple(rng.uniform(-15, 15, (2, 5000))), tuple(rng.uniform(-0.3, 0.3, (2, 5000)))
    )
    position[2] -= rng.uniform(0, 100, 5000)
    for system in (HEAD, DISPLACED):
        whole = trace(system, position, direction)
        assert whole.x.shape == (5000,)
        assert len(set(whole.status.tolist())) >= 3
        choice = rng.permutation(5000)[:count]
        part = Trace(*(getattr(whole, name)[..., choice] for name in FIELDS))
        for threads in (1, 2, None):
            some = trace(system, position[:, choice], direction[:, choice], threads=threads)
            assert some.x.shape == some.surface.shape == (count,)
            assert some.direction.shape == (3, count)
            same(some, part)
        start = (5000 - count) // 2
        window = slice(start, start + count)
        same(
            trace(system, position[:, window], direction[:, window], threads=1),
            Trace(*(getattr(whole, name)[..., window] for name in FIELDS)),
        )


def test_arrays_may_lie_in_memory_as_they_like() -> None:
    position, direction = shot((np.linspace(-9, 9, 50), 0.3), (0.1, 0.0))
    expected = trace(HEAD, position, direction)
    same(expected, trace(HEAD, np.asfortranarray(position), direction.T.copy().T))
    same(expected, trace(HEAD, position.tolist(), direction.tolist()))
    twice = np.repeat(position, 2, axis=1)
    same(expected, trace(HEAD, twice[:, ::2], direction))
    whole: Any = np.array([[1], [0], [-5]]), np.array([[0], [0], [1]])
    assert trace(HEAD, *whole).arrived.all()
    # and are left alone
    before = position.copy(), direction.copy()
    position.flags.writeable = direction.flags.writeable = False
    trace(HEAD, position, direction)
    assert_array_equal(position, before[0])
    assert_array_equal(direction, before[1])


@pytest.mark.parametrize("length", [1e-200, 1e-12, 0.25, 4.0, 1e12, 1e200])
def test_directions_have_any_length(length: float) -> None:
    position, direction = shot(([0.0, 3.0, -9.0], 1.0), ([0.1, 0.0, 0.2], 0.05))
    expected = trace(HEAD, position, direction)
    scaled = trace(HEAD, position, direction * length)
    assert expected.arrived.all()
    assert_array_equal(scaled.status, 0)
    assert_allclose(scaled.x, expected.x, rtol=0, atol=1e-13)
    assert_allclose(scaled.y, expected.y, rtol=0, atol=1e-13)


# --- nothing but numbers --------------------------------------------------------------------


@pytest.mark.parametrize("height", [1.0, 1e3, 1e9, 1e40, 1e100, 1e150])
@pytest.mark.parametrize("tracer", [trace, reference.trace])
def test_whatever_happens_results_are_finite(tracer: Any, height: float) -> None:
    rng = np.random.default_rng(11)
    position = np.stack([*rng.uniform(-height, height, (2, 500)), rng.uniform(-height, 0, 500)])
    position[2] -= 20
    toward = rng.normal(size=(3, 500))
    toward[2] = np.abs(toward[2]) * 10.0 ** -rng.integers(0, 300, 500)
    toward[:2, ::5] = 0
    ball = SphericalLens("ball", 20.0, 10.0, -10.0, 20.0, GLASS)
    systems = [
        HEAD,
        DISPLACED,
        alone(Plate("endless", 1.0, GLASS)),
        alone(Aperture("endless")),
        OpticalSystem("balls", (ball,) * 4, (0.0, 1.0, 2.0), 0.0),
    ]
    for system in systems:
        ray = tracer(system, position, toward)
        for values in (ray.x, ray.y, ray.direction, ray.transmission):
            assert np.isfinite(values).all()
        assert ((ray.status == 0) == (ray.surface == -1)).all()
        assert ray.status.max() <= 3


def test_the_axes_and_edges_of_the_shapes_are_no_trap() -> None:
    """Rays along the axis of a cylinder, through a sphere's centre, onto tangents and vertices."""
    lens = Lens("half", 30, 30, 15.0, 15.0, GLASS)
    ball = SphericalLens("ball", 20.0, 10.0, -10.0, 20.0, GLASS)
    x = np.array([0.0, 15.0, -15.0, 10.0, -10.0, 1e-300, 5e-324])
    for element in (lens, lens.turned(), ball, ball.turned()):
        for slope in (0.0, 1e-300, 1.0, 1e16, -1e16):
            position, direction = shot((x, 0.0), z=-1.0)
            direction[1] = slope
            for tracer in (trace, reference.trace):
                ray = tracer(alone(element), position, direction)
                assert np.isfinite([ray.x, ray.y, *ray.direction, ray.transmission]).all()
                assert ray.arrived[0] or abs(slope) > 0.5


# --- refusals -------------------------------------------------------------------------------


@pytest.mark.parametrize("tracer", [trace, reference.trace, reference.path])
@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_numbers_that_are_not_finite_are_refused(tracer: Any, bad: float) -> None:
    position, direction = shot((np.arange(3.0), 0.0))
    for at in range(3):
        wrong = position.copy()
        wrong[at, 1] = bad
        with pytest.raises(ValueError, match=f"^position = {bad}: allowed are finite numbers; mm"):
            tracer(HEAD, wrong, direction)
        wrong = direction.copy()
        wrong[at, 1] = bad
        with pytest.raises(ValueError, match=f"^direction = {bad}: allowed are finite numbers"):
            tracer(HEAD, position, wrong)


@pytest.mark.parametrize("tracer", [trace, reference.trace, reference.path])
@pytest.mark.parametrize(
    ("position", "direction"),
    [((3,), (3,)), ((2, 5), (2, 5)), ((5, 3), (5, 3)), ((3, 5), (3, 1)), ((3, 4), (3, 5))],
)
def test_other_shapes_are_refused(
    tracer: Any, position: tuple[int, ...], direction: tuple[int, ...]
) -> None:
    with pytest.raises(ValueError, match=r"both are \(3, N\): x, y and z") as refusal:
        tracer(HEAD, -np.ones(position), np.ones(direction))
    assert f"position {position} and direction {direction}" in str(refusal.value)


@pytest.mark.parametrize("tracer", [trace, reference.trace])
def test_what_is_no_number_is_refused(tracer: Any) -> None:
    with pytest.raises(TypeError, match=r"^position: real numbers are needed"):
        tracer(HEAD, [["a"], ["b"], ["c"]], [[0], [0], [1]])
    with pytest.raises(TypeError, match=r"^direction: real numbers are needed, not complex"):
        tracer(HEAD, [[0], [0], [-1]], [[0], [0], [1j]])


@pytest.mark.parametrize("tracer", [trace, reference.trace])
@pytest.mark.parametrize("z", [0.0, -1.0, -1e-300])
def test_light_that_goes_backward_is_refused(tracer: Any, z: float) -> None:
    position, direction = shot((np.arange(3.0), 0.0))
    direction[2, 1] = z
    with pytest.raises(ValueError, match=f"^direction: z = {z:g} of ray 1; light goes forward"):
        tracer(HEAD, position, direction)


HOLLOW = alone(PCV)  # 3.24 mm deep at x = ±7.5
DOME = alone(SphericalLens("dome", 24.0, -12.5, math.inf, 3.0, GLASS))


@pytest.mark.parametrize(
    ("system", "place", "fine"),
    [
        (alone(PCX), (0.0, 0.0, -1e-9), True),
        (alone(PCX), (0.0, 0.0, 1e-9), False),
        (alone(PCX), (0.0, 0.0, 3.0), False),  # in the glass
        (alone(PCX), (0.0, 0.0, 100.0), False),  # behind everything
        (alone(PCX), (14.0, 0.0, 3.0), True),  # before the curved side, beside the vertex
        (alone(PCX), (14.0, 0.0, 3.4), False),
        (alone(PCX), (20.0, 0.0, 1.0), False),  # beside the lens: would be traced back to it
        (alone(PCX), (0.0, 17.0, 1.0), False),
        (alone(PCX), (20.0, 0.0, -1.0), True),
        (HOLLOW, (0.0, 0.0, -0.1), True),  # in the hollow
        (HOLLOW, (7.0, 0.0, -2.0), False),  # in the glass beside it
        (HOLLOW, (7.0, 0.0, -2.8), True),
        (HOLLOW, (9.0, 0.0, -3.0), False),  # beside the lens
        (HOLLOW, (9.0, 0.0, -3.3), True),
        (DOME, (11.9, 0.0, -1.0), False),  # its corner is beyond the sphere
        (DOME, (8.0, 8.0, -5.0), False),
        (DOME, (0.0, 0.0, -1.0), True),
        (OpticalSystem("slit", (Aperture("s", x=5.0), PCX), (9.0,), 5.0), (0, 0, 3.0), False),
        (OpticalSystem("slit", (Aperture("s", x=5.0), PCX), (9.0,), 5.0), (9, 0, 0.1), False),
        (OpticalSystem("slit", (Aperture("s", x=5.0), PCX), (9.0,), 5.0), (0, 0, -0.1), True),
        (alone(Plate("plate", 1.0, GLASS)), (0, 0, 0.5), False),
        (alone(PCX, placements=(Placement(tilt=(0, 0.1, 0)),)), (14.0, 0.0, 1.0), True),
        (alone(PCX, placements=(Placement(tilt=(0, 0.1, 0)),)), (14.0, 0.0, 2.5), False),
        (alone(PCX, placements=(Placement(tilt=(0, -0.1, 0)),)), (14.0, 0.0, 2.5), True),
        (alone(PCX, placements=(Placement((5.0, 0.0)),)), (5.0, 0.0, 0.1), False),
        (alone(PCX, placements=(Placement((5.0, 0.0)),)), (-8.0, 0.0, 2.0), True),
    ],
)
def test_sources_in_or_behind_the_glass_are_refused(
    system: OpticalSystem, place: tuple[float, float, float], fine: bool
) -> None:
    position = np.array([(0.0, 0.0, -50.0), place, (1.0, 1.0, -50.0)]).T
    direction = np.array([[0.0], [0.0], [1.0]]).repeat(3, axis=1)
    for tracer in (trace, reference.trace, reference.path):
        call: Any = tracer
        if fine:
            call(system, position, direction)
            continue
        part = system.elements[0].part
        with pytest.raises(ValueError, match=rf"^position of ray 1 = .*in or behind {part}") as no:
            call(system, position, direction)
        assert str(tuple(map(float, place))) in str(no.value)
        assert "sources have negative z" in str(no.value)


@pytest.mark.parametrize("bad", [0, -1, 1.5])
def test_threads_that_are_no_number_are_refused(bad: Any) -> None:
    with pytest.raises(ValueError, match=f"^threads = {bad}: allowed are whole numbers"):
        trace(HEAD, *shot(), threads=bad)
    with pytest.raises(TypeError, match=r"^threads = '2'"):
        trace(HEAD, *shot(), threads="2")  # type: ignore[arg-type]


def test_more_threads_than_there_are_do_no_harm(monkeypatch: pytest.MonkeyPatch) -> None:
    import numba

    before = numba.get_num_threads()
    same(trace(HEAD, *shot(), threads=10_000), trace(HEAD, *shot()))
    # a machine with more processors than numba was given
    monkeypatch.setattr("os.cpu_count", lambda: 10_000)
    same(trace(HEAD, *shot(), threads=10_000), trace(HEAD, *shot()))
    assert numba.get_num_threads() == before


def test_without_numba_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    trace(HEAD, *shot())
    monkeypatch.setitem(sys.modules, "numba", None)
    monkeypatch.delitem(sys.modules, "raytransfer._kernels")
    monkeypatch.delattr(raytransfer, "_kernels")
    with pytest.raises(ModuleNotFoundError, match=r"numba.*pip install linetrack\[exact\]"):
        trace(HEAD, *shot())
    # the readable twin and the bundle need none
    assert reference.trace(HEAD, *shot()).arrived.all()
    assert bundle(HEAD, (0.0, 0.0, 100.0), 2, 2).solid_angle.shape == (4,)


def test_other_modules_that_are_missing_are_not_blamed_on_numba(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(sys.modules, "raytransfer._kernels", None)
    monkeypatch.delattr(raytransfer, "_kernels")
    with pytest.raises(ImportError) as refusal:
        trace(HEAD, *shot())
    assert "pip install" not in str(refusal.value)


# --- bundles --------------------------------------------------------------------------------


def rectangle(x: tuple[float, float], y: tuple[float, float], d: float) -> float:
    """Solid angle of x × y at distance d, seen from the origin: four times atan, with signs."""
    return sum(
        i * j * math.atan(a * b / (d * math.sqrt(a * a + b * b + d * d)))
        for i, a in zip((-1, 1), x, strict=True)
        for j, b in zip((-1, 1), y, strict=True)
    )


@pytest.mark.parametrize(
    "source", [(0.0, 0.0, 5000.0), (0.0, 0.0, 5.0), (300.0, -80.0, 500.0), (4.0, 3.0, 8.0)]
)
def test_solid_angles_are_those_of_the_opening(source: tuple[float, float, float]) -> None:
    x, y, d = source
    system = alone(Aperture("window", x=12.0, y=7.0))
    exact = rectangle((-6 - x, 6 - x), (-3.5 - y, 3.5 - y), d)
    errors = []
    for n in (50, 100, 200):
        rays = bundle(system, source, n, n + 1)
        assert rays.solid_angle.shape == (n * (n + 1),)
        errors.append(abs(rays.solid_angle.sum() / exact - 1))
    assert errors[-1] < 2e-5
    # midpoints: the error goes with the square
    assert errors[1] < 0.26 * errors[0] + 1e-10
    assert errors[2] < 0.26 * errors[1] + 1e-10


def test_bundles_are_in_order_and_through_the_middles() -> None:
    rays = bundle(alone(Aperture("window", x=12.0, y=6.0)), (1.0, 2.0, 50.0), 3, 2)
    assert_allclose(rays.pupil[0], [-4, -4, 0, 0, 4, 4], atol=1e-15)
    assert_allclose(rays.pupil[1], [-1.5, 1.5] * 3, atol=1e-15)
    assert_array_equal(rays.position, np.array([[1.0], [2.0], [-50.0]]).repeat(6, axis=1))
    at_plane = rays.position + rays.direction * 50 / rays.direction[2]
    assert_allclose(at_plane[:2], rays.pupil, rtol=0, atol=1e-13)
    assert_allclose(np.linalg.norm(rays.direction, axis=0), 1, rtol=1e-15)


DEEP = SphericalLens("deep", 30.0, 16.0, math.inf, 12.0, GLASS)  # corners beyond the sphere
TILTED = (Placement((0.5, -0.3), (0.1, -0.15, 0.3)),)
SLIT = Aperture("slit", x=5.0)
ROLLED, BACK = (Placement(tilt=(0.0, 0.0, roll)) for roll in (0.8, -0.8))


@pytest.mark.parametrize(
    "system",
    [
        HEAD,
        DISPLACED,
        PAIR,
        alone(PCX),
        alone(PCX, placements=TILTED),
        alone(PCV, placements=TILTED),
        alone(DEEP),
        alone(replace(DEEP, front_radius=-16.0)),
        alone(replace(PCX, clear=(20.0, 30.0))),
        alone(Lens("half", 30, 30, 15.0, 15.0, GLASS)),
        OpticalSystem("slit", (SLIT, PCX), (0.0,), 5.0),
        OpticalSystem("slit", (SLIT, *HEAD.elements), (9.0, *HEAD.gaps), 0.82),
        OpticalSystem("slit", (SLIT, PCX), (9.0,), 5.0, (TILTED[0], Placement())),
        OpticalSystem("two", (SLIT, Aperture("across", y=3.0), PCX), (9.0, 1.0), 5.0),
        OpticalSystem(
            "rolled", (SLIT, *PAIR.elements), (10.0, 0.2), 26.0, (ROLLED, *[Placement()] * 2)
        ),
        OpticalSystem("aside", (SLIT, PCX), (9.0,), 5.0, (BACK, Placement((9.0, 9.0)))),
    ],
    ids=lambda system: f"{system.name} {system.elements[0].part}",
)
def test_every_ray_that_passes_the_front_is_in_the_bundle(system: OpticalSystem) -> None:
    """A grid far larger than any opening finds no ray outside, and the bundle is no larger."""
    front = next(k for k, (s, _, _) in enumerate(surface_frames(system)) if not s.screen)
    total = 0
    for source in ((0.0, 0.0, 40.0), (0.0, 0.0, 5e3), (60.0, -45.0, 45.0), (-400.0, 900.0, 3e3)):
        rays = bundle(system, source, 60, 60)
        low = rays.pupil.min(axis=1, keepdims=True)
        high = rays.pupil.max(axis=1, keepdims=True)
        half_cell = (high - low) / 118
        low, high = low - half_cell, high + half_cell
        size = max(np.abs(low).max(), np.abs(high).max()) + 30
        grid = np.linspace(-size, size, 261)
        u, v = (w.ravel() for w in np.meshgrid(grid, grid))
        start = np.array([source[0], source[1], -source[2]])[:, None]
        toward = np.stack([u, v, 0 * u]) - start
        ray = trace(system, start.repeat(u.size, axis=1), toward, fresnel=False)
        passed = ray.arrived | (ray.surface > front)
        passed |= (ray.surface == front) & (ray.status == Status.REFLECTED)
        beyond = (np.stack([u, v]) < low - 1e-9) | (np.stack([u, v]) > high + 1e-9)
        assert not (passed & beyond.any(axis=0)).any()
        total += passed.sum()
    assert total > 100


def test_a_bundle_is_no_larger_than_the_front_needs() -> None:
    """Where the edge is in a plane, the opening is exact."""
    rays = bundle(PAIR, (0.0, 0.0, 100.0), 2, 2)
    assert_allclose(np.abs(rays.pupil).max(axis=1), [7.5, 8.0])
    slit = OpticalSystem("slit", (SLIT, *PAIR.elements), (10.0, 0.0), 26.1)
    rays = bundle(slit, (0.0, 0.0, 100.0), 2, 2)
    assert_allclose(np.abs(rays.pupil).max(axis=1), [1.25, 8.0 / 1.1])
    # a tilt of some minutes of arc does not open it
    tilted = replace(slit, placements=(Placement(tilt=(1e-3, 0, 0)), Placement(), Placement()))
    rays = bundle(tilted, (0.0, 0.0, 1000.0), 2, 2)
    assert np.abs(rays.pupil[0]).max() < 1.27


def test_a_slit_may_be_tilted_before_a_near_source() -> None:
    slit = OpticalSystem("slit", (SLIT, PCX), (9.0,), 5.0, (TILTED[0], Placement()))
    for distance in (5.0, 20.0, 300.0, 3000.0):
        rays = bundle(slit, (0.0, 0.0, distance), 40, 40)
        assert trace(slit, rays.position, rays.direction).arrived.any()


def test_openings_that_do_not_overlap_let_nothing_through() -> None:
    aside = (Placement((20.0, 0.0)), Placement())
    system = OpticalSystem(
        "aside", (Aperture("a", x=4.0), Aperture("b", x=4.0, y=3.0)), (1.0,), 5.0, aside
    )
    rays = bundle(system, (0.0, 0.0, 100.0), 4, 4)
    assert rays.solid_angle.sum() == 0
    assert not trace(system, rays.position, rays.direction).arrived.any()


def test_bundles_of_sources_in_the_lens_are_refused() -> None:
    with pytest.raises(ValueError, match=r"^distance of the source = 2 mm: .*within the depth"):
        bundle(HEAD, (0.0, 0.0, 2.0), 4, 4)  # the hollow front is 3.24 mm deep
    for bad in (0, -5.0):
        with pytest.raises(ValueError, match=f"^distance of the source = {bad:g}: allowed is > 0"):
            bundle(HEAD, (0.0, 0.0, bad), 4, 4)


def test_bundles_without_an_edge_are_refused() -> None:
    for system in (alone(Plate("plate", 1.0, GLASS)), alone(SLIT)):
        with pytest.raises(ValueError, match=r"^alone: no edge limits the light at the front"):
            bundle(system, (0.0, 0.0, 100.0), 4, 4)


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_bundles_of_sources_that_are_nowhere_are_refused(bad: float) -> None:
    for at in range(3):
        source: Any = [0.0, 0.0, 100.0]
        source[at] = bad
        with pytest.raises(ValueError, match=rf"^position\[{at}\] = {bad}"):
            bundle(HEAD, source, 4, 4)
    short: Any = (0.0, 100.0)
    with pytest.raises(ValueError, match=r"^position = \(0\.0, 100\.0\): X, Y and the distance"):
        bundle(HEAD, short, 4, 4)


@pytest.mark.parametrize("bad", [0, -3, 2.0])
def test_bundles_of_no_number_of_rays_are_refused(bad: Any) -> None:
    with pytest.raises(ValueError, match=f"^nx = {bad}"):
        bundle(HEAD, (0.0, 0.0, 100.0), bad, 4)
    with pytest.raises(ValueError, match=f"^ny = {bad}"):
        bundle(HEAD, (0.0, 0.0, 100.0), 4, bad)


def test_a_trace_can_be_written_over() -> None:
    """The same numbers in the same memory; of another size it is refused, and left alone."""
    head = prototype_head()
    first, second = (bundle(head, (x, 0.0, 1300.0), 40, 30) for x in (0.0, 300.0))
    place = trace(head, first.position, first.direction)
    fresh = trace(head, second.position, second.direction)
    again = trace(head, second.position, second.direction, out=place)
    assert np.shares_memory(again.x, place.x)
    for name in ("x", "y", "direction", "transmission", "status", "surface"):
        assert np.array_equal(getattr(again, name), getattr(fresh, name))
    with pytest.raises(ValueError, match="of 1200 rays cannot take 10"):
        trace(head, first.position[:, :10], first.direction[:, :10], out=place)
