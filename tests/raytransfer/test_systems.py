"""Systems of lenses: matrices by hand, cardinal points by rays, the thesis's pairs and head."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from raytransfer import (
    CATALOGUE,
    MATERIALS,
    SENSORS,
    TCD1304,
    THESIS_LENSES,
    Lens,
    OpticalSystem,
    Plate,
    RayMatrix,
    cast_rays,
    collimating_pair,
    prototype_head,
    telecentric_pair,
)
from raytransfer.lenses import Aperture, SphericalLens
from raytransfer.systems import Placement

if TYPE_CHECKING:
    from raytransfer.lenses import Meridian

THESIS_GLASS, WINDOW_GLASS = 1.52, 1.5
F60, T60 = 31 / (THESIS_GLASS - 1), 5.9  # focal length and thickness of one lens of the f60 pair

SYSTEMS = {
    "f60 pair": telecentric_pair(),
    "unequal pair": telecentric_pair("LJ1430L1", "LJ1567L1", 3.3),
    "collimator": collimating_pair(),
    "head": prototype_head(),
}
POWERED: list[tuple[str, Meridian]] = [
    ("f60 pair", "x"),
    ("unequal pair", "x"),
    ("collimator", "y"),
    ("head", "x"),
    ("head", "y"),
]


def free(d: float) -> np.ndarray[Any, Any]:
    return np.array([[1, d], [0, 1]])


# --- matrices -------------------------------------------------------------------------------


@pytest.mark.parametrize("name", SYSTEMS)
@pytest.mark.parametrize("meridian", ["x", "y"])
@pytest.mark.parametrize("plates", [True, False])
@pytest.mark.parametrize("wavelength", [0.45, 0.5875618])
def test_matrix_is_the_product_of_elements_and_gaps(
    name: str, meridian: Meridian, plates: bool, wavelength: float
) -> None:
    system = SYSTEMS[name]
    expected = np.eye(2)
    for number, element in enumerate(system.elements):
        if number:
            expected = free(system.gaps[number - 1]) @ expected
        part = element.matrix(meridian, plates=plates, wavelength=wavelength)
        expected = np.asarray(part) @ expected
    matrix = system.matrix(meridian, plates=plates, wavelength=wavelength)
    assert isinstance(matrix, RayMatrix)
    assert_allclose(np.asarray(matrix), expected, rtol=1e-12, atol=1e-14)
    assert matrix.determinant == 1.0


def test_head_by_hand_along_the_line() -> None:
    """Every refraction and every distance of figure 4.7 written out; y bends where x does not."""
    power = (THESIS_GLASS - 1) / 31
    curve = np.array([[1, 0], [-power, 1]])  # both sides of a curved surface in air
    pair = free(T60 / 1.52) @ curve @ free(0.17) @ curve @ free(T60 / 1.52)
    before, after = free(2.63) @ free(2 / 1.52), free(17.2)
    behind = free(0.7 / 1.5) @ free(3.0) @ free(5.2 / 1.52)
    expected = behind @ after @ pair @ before
    assert_allclose(np.asarray(prototype_head().matrix("x")), expected, rtol=1e-12)

    cave = np.array([[1, 0], [(THESIS_GLASS - 1) / 10.3, 1]])
    vex = np.array([[1, 0], [-(THESIS_GLASS - 1) / 10.3, 1]])
    air = free(2.63 + T60 / 1.52 + 0.17 + T60 / 1.52 + 17.2)
    expected = free(0.7 / 1.5) @ free(3.0) @ free(5.2 / 1.52) @ vex @ air @ free(2 / 1.52) @ cave
    assert_allclose(np.asarray(prototype_head().matrix("y")), expected, rtol=1e-12)


@pytest.mark.parametrize("name", SYSTEMS)
@pytest.mark.parametrize("meridian", ["x", "y"])
@pytest.mark.parametrize("plates", [True, False])
def test_trace_agrees_with_the_matrix(name: str, meridian: Meridian, plates: bool) -> None:
    system = SYSTEMS[name]
    rays = np.random.default_rng(4).normal(scale=[[5.0], [0.1]], size=(2, 7))
    z, path = system.trace(rays, meridian, plates=plates)
    assert z.shape == (2 * len(system.elements),)
    assert path.shape == (2 * len(system.elements), 2, 7)
    assert_array_equal(path[0], rays)
    assert_allclose(path[-1], system.matrix(meridian, plates=plates) @ rays, rtol=1e-12)
    assert_allclose(
        z, [vertex for placed in system.layout() for vertex in (placed.front, placed.back)]
    )
    # in the air between the elements rays are straight
    for back in range(1, len(z) - 1, 2):
        height, angle = path[back]
        assert_allclose(path[back + 1, 0], height + (z[back + 1] - z[back]) * angle, rtol=1e-12)
        assert_array_equal(path[back + 1, 1], angle)
    # and across each element they go as its matrix says
    for number, element in enumerate(system.elements):
        through = element.matrix(meridian, plates=plates) @ path[2 * number]
        assert_array_equal(path[2 * number + 1], through)


def test_layout_is_where_the_vertices_are() -> None:
    head = prototype_head()
    layout = head.layout()
    assert [placed.element for placed in layout] == list(head.elements)
    assert_allclose(
        [(placed.front, placed.back) for placed in layout],
        [(0, 2), (4.63, 10.53), (10.70, 16.60), (33.80, 39.00), (42.00, 42.70)],
        rtol=1e-12,
    )
    assert head.length == pytest.approx(42.70, rel=1e-12)
    assert telecentric_pair(gap=0.5).length == pytest.approx(2 * 5.9 + 0.5, rel=1e-12)


# --- cardinal points ------------------------------------------------------------------------


def test_f60_pair_against_gullstrand() -> None:
    """Two thick lenses, textbook: 1/f = 1/f1 + 1/f2 − e/(f1 f2) between their principal planes.

    A plano-convex lens has one principal plane in its curved vertex and the other t/n inside its
    plane face, so that e is the gap between the curved sides.
    """
    for gap in (0.0, 0.17, 5.0):
        f = 1 / (2 / F60 - gap / F60**2)
        back = f * (F60 - gap) / F60 - T60 / THESIS_GLASS
        pair = telecentric_pair(gap=gap)
        assert pair.effective_focal_length("x") == pytest.approx(f, rel=1e-12)
        assert pair.back_focal_length("x") == pytest.approx(back, rel=1e-12)
        points = pair.cardinal_points("x")
        assert points.front_focal_point == pytest.approx(-back, rel=1e-12)  # it is symmetric
        assert points.back_principal_point == pytest.approx(back - f, rel=1e-12)
        assert points.front_principal_point == pytest.approx(f - back, rel=1e-12)
    assert telecentric_pair().effective_focal_length("x") == pytest.approx(29.8077, abs=5e-5)


@pytest.mark.parametrize("front", ["LJ1695L1", "LJ1430L1", "LJ1516L1"])
@pytest.mark.parametrize("back", ["LJ1477L1", "LJ1144L1"])
def test_unequal_pairs_against_gullstrand(front: str, back: str) -> None:
    n, gap = MATERIALS["N-BK7"].index(), 2.5
    f1, f2 = (CATALOGUE[part].radius / (n - 1) for part in (front, back))
    f = f1 * f2 / (f1 + f2 - gap)
    pair = telecentric_pair(front, back, gap)
    points = pair.cardinal_points("x")
    t1, t2 = (CATALOGUE[part].centre_thickness for part in (front, back))
    assert points.effective_focal_length == pytest.approx(f, rel=1e-12)
    assert points.back_focal_point == pytest.approx(f * (f1 - gap) / f1 - t2 / n, rel=1e-12)
    assert points.front_focal_point == pytest.approx(-f * (f2 - gap) / f2 + t1 / n, rel=1e-12)


@pytest.mark.parametrize(("name", "meridian"), POWERED)
@pytest.mark.parametrize("plates", [True, False])
def test_cardinal_points_by_rays(name: str, meridian: Meridian, plates: bool) -> None:
    system = SYSTEMS[name]
    points = system.cardinal_points(meridian, plates=plates)
    height = 3.0

    def trace(z: float, y: float, angle: float) -> tuple[float, float]:
        """Height and angle at the last vertex of a ray through (z, y)."""
        rays = np.array([[y - z * angle], [angle]])
        (out,) = system.trace(rays, meridian, plates=plates)[1][-1].T
        return float(out[0]), float(out[1])

    # a parallel ray crosses the axis in the back focal point
    out, angle = trace(0, height, 0)
    assert out + points.back_focal_point * angle == pytest.approx(0, abs=1e-12)
    # and seems to have bent in the back principal plane
    assert out + points.back_principal_point * angle == pytest.approx(height, rel=1e-12)
    assert angle == pytest.approx(-height / points.effective_focal_length, rel=1e-12)

    # a ray through the front focal point leaves parallel, as high as it met the principal plane
    angle_in = 0.02
    out, angle = trace(points.front_focal_point, 0, angle_in)
    assert angle == pytest.approx(0, abs=1e-13)
    bent_at = (points.front_principal_point - points.front_focal_point) * angle_in
    assert out == pytest.approx(bent_at, rel=1e-11)
    assert bent_at == pytest.approx(points.effective_focal_length * angle_in, rel=1e-12)

    # a ray through the front nodal point keeps its angle and leaves through the back one
    out, angle = trace(points.front_nodal_point, 0, angle_in)
    assert angle == pytest.approx(angle_in, rel=1e-11)
    assert out + points.back_nodal_point * angle == pytest.approx(0, abs=1e-11)


def turned(system: OpticalSystem) -> OpticalSystem:
    elements = tuple(
        element.turned() if isinstance(element, Lens) else element
        for element in reversed(system.elements)
    )
    return OpticalSystem(f"{system.name}, turned", elements, system.gaps[::-1])


@pytest.mark.parametrize(("name", "meridian"), POWERED)
def test_a_turned_system_has_its_points_mirrored(name: str, meridian: Meridian) -> None:
    system = SYSTEMS[name]
    m, back = system.matrix(meridian), turned(system).matrix(meridian)
    assert_allclose(np.asarray(back), [[m.D, m.B], [m.C, m.A]], rtol=1e-12)
    points, mirrored = system.cardinal_points(meridian), turned(system).cardinal_points(meridian)
    assert_allclose(
        [
            mirrored.effective_focal_length,
            mirrored.back_focal_point,
            mirrored.front_focal_point,
            mirrored.back_principal_point,
            mirrored.front_principal_point,
        ],
        [
            points.effective_focal_length,
            -points.front_focal_point,
            -points.back_focal_point,
            -points.front_principal_point,
            -points.back_principal_point,
        ],
        rtol=1e-11,
    )
    assert_allclose(np.asarray(turned(turned(system)).matrix(meridian)), np.asarray(m), rtol=1e-14)


def test_back_focal_length_is_the_focus_of_a_star() -> None:
    for name, meridian in POWERED:
        matrix = SYSTEMS[name].matrix(meridian)
        star = cast_rays(1.0, matrix, 1e12, 0.0).focal_length
        assert SYSTEMS[name].back_focal_length(meridian) == pytest.approx(star, rel=1e-7)


@pytest.mark.parametrize("system", [telecentric_pair(), collimating_pair()])
def test_a_system_without_power_has_its_points_at_infinity(system: OpticalSystem) -> None:
    lens = system.elements[0]
    assert isinstance(lens, Lens)
    without: Meridian = "y" if lens.bends == "x" else "x"
    points = system.cardinal_points(without)
    assert {
        points.effective_focal_length,
        points.front_focal_point,
        points.back_focal_point,
        points.front_principal_point,
        points.back_principal_point,
        points.front_nodal_point,
        points.back_nodal_point,
    } == {math.inf}
    assert system.effective_focal_length(without) == math.inf
    assert system.back_focal_length(without) == math.inf


def lens_power(lens: Lens) -> float:
    return (lens.material.index() - 1) / lens.radius


def test_a_telescope_has_its_points_at_infinity_in_spite_of_rounding() -> None:
    """Galilei's: the focal points of a concave and a convex lens coincide."""
    concave, convex = THESIS_LENSES["PCV_15_30_20"], CATALOGUE["LJ1430L1"]
    # C = −(p1 + p2 − p1 p2 (gap + t/n)) for powers p and the concave lens's thickness t
    p1, p2 = (lens_power(lens) for lens in (concave, convex))
    gap = (p1 + p2) / (p1 * p2) - concave.thickness / 1.52
    telescope = collimating_pair(concave, convex, gap)
    assert abs(telescope.matrix("y").C) < 1e-15
    assert telescope.effective_focal_length("y") == math.inf
    assert telescope.back_focal_length("y") == math.inf
    nearly = collimating_pair(concave, convex, gap + 1e-6)
    assert math.isfinite(nearly.effective_focal_length("y"))


def test_focal_lengths_depend_on_colour_and_plates() -> None:
    pair = telecentric_pair("LJ1430L1")
    n = MATERIALS["N-BK7"].index(0.45)
    assert pair.effective_focal_length("x", wavelength=0.45) == pytest.approx(
        31.00 / (n - 1) / 2, rel=1e-12
    )
    head = prototype_head()
    moved = head.back_focal_length("x") - head.back_focal_length("x", plates=False)
    assert moved == pytest.approx(5.2 * (1 - 1 / 1.52) + 0.7 * (1 - 1 / 1.5), rel=1e-12)


# --- the thesis's systems -------------------------------------------------------------------


def test_telecentric_pair_has_its_curved_sides_inside() -> None:
    first, second = telecentric_pair().elements
    assert isinstance(first, Lens)
    assert isinstance(second, Lens)
    assert (first.reversed, second.reversed) == (True, False)
    assert (first.bends, second.bends) == ("x", "x")
    assert first.turned() == second == THESIS_LENSES["PCX_30_32_60"]
    assert telecentric_pair().gaps == (0.0,)
    assert telecentric_pair().sensor_distance is None


def test_collimating_pair_has_its_curved_sides_to_the_light() -> None:
    concave, convex = collimating_pair().elements
    assert isinstance(concave, Lens)
    assert isinstance(convex, Lens)
    assert (concave.radius, convex.radius) == (-10.3, 10.3)
    assert (concave.reversed, convex.reversed) == (False, False)
    assert (concave.bends, convex.bends) == ("y", "y")
    assert collimating_pair().gaps == (32.0,)


@pytest.mark.parametrize("flip", [False, True])
def test_pairs_put_any_lens_the_right_way_round(flip: bool) -> None:
    lens = CATALOGUE["LJ1430L1"].bending("y")
    pair = telecentric_pair(lens.turned() if flip else lens, "LJ1567L1", 1.0)
    assert pair == telecentric_pair("LJ1430L1", CATALOGUE["LJ1567L1"], 1.0)
    assert [element.part for element in pair.elements] == ["LJ1430L1", "LJ1567L1"]
    assert telecentric_pair("LJ1430L1") == telecentric_pair("LJ1430L1", "LJ1430L1")


@pytest.mark.parametrize("make", [telecentric_pair, collimating_pair, prototype_head])
@pytest.mark.parametrize(("plates", "meridian"), [(True, "x"), (False, "x"), (True, "y")])
def test_the_thesiss_systems_have_determinant_1(make: Any, plates: bool, meridian: Any) -> None:
    matrix = np.asarray(make().matrix(meridian, plates=plates))
    assert np.linalg.det(matrix) == pytest.approx(1, rel=1e-12)


def test_prototype_head_is_figure_4_7() -> None:
    head = prototype_head()
    assert head.gaps == (2.63, 0.17, 17.2, 3.0)
    assert head.sensor_distance == 0.82
    concave, first, second, convex, window = head.elements
    assert (concave, convex) == collimating_pair().elements
    assert (first, second) == telecentric_pair().elements
    assert window == TCD1304.window
    # heights of the lower vertices above the window's top, read off the layout
    top = head.layout()[-1].front
    lower = [top - placed.back for placed in head.layout()[:-1]]
    assert_allclose(lower, [40.0 - 2 + 2, 40 - 2.63 - 5.9, 25.4, 3.0], rtol=1e-12)


def test_heights_move_the_heads_elements() -> None:
    head = prototype_head(concave_height=41, concave_to_pair=3, pair_height=25, convex_height=4)
    assert_allclose(head.gaps, (3, 41 - 3 - 25 - 11.8, 25 - 4 - 5.2, 4), rtol=1e-12)
    assert head.length == pytest.approx(41 + 2 + 0.7, rel=1e-12)


def test_a_head_from_other_lenses() -> None:
    head = prototype_head(pair=telecentric_pair("LJ1430L1"), collimator=collimating_pair())
    assert_allclose(head.gaps, (2.63, 40 - 2.63 - 25.4 - 2 * 5.87, 17.2, 3.0), rtol=1e-12)
    assert head.elements[1:3] == telecentric_pair("LJ1430L1").elements


def test_plates_move_the_heads_focus_back() -> None:
    """Behind the pair the light crosses two plates: the convex collimator and the window.

    A plate of thickness t moves the focus back by t (1 − 1/n). The concave lens, in front, brings
    the source as much nearer to the pair, which its focus follows only slightly.
    """
    head = prototype_head()
    source_dist = 5000.0
    with_plates, without = (
        cast_rays(30, head.matrix("x", plates=plates), source_dist, 0).focal_length
        for plates in (True, False)
    )
    behind = 5.2 * (1 - 1 / THESIS_GLASS) + 0.7 * (1 - 1 / WINDOW_GLASS)

    def focus_of_pair(glass_before: float) -> float:
        """Gullstrand's pair, the source measured from its front principal plane."""
        f = 1 / (2 / F60 - 0.17 / F60**2)
        principal = f - f * (F60 - 0.17) / F60 + T60 / THESIS_GLASS
        distance = source_dist + glass_before + 2.63 + principal
        return 1 / (1 / f - 1 / distance)

    nearer = focus_of_pair(2 / THESIS_GLASS) - focus_of_pair(2.0)
    assert with_plates - without == pytest.approx(behind + nearer, abs=1e-9)
    assert 0 < nearer < 1e-4
    assert with_plates - without == pytest.approx(behind, abs=1e-4)
    assert behind == pytest.approx(2.0123, abs=1e-4)


# --- refusals -------------------------------------------------------------------------------

PCX = THESIS_LENSES["PCX_30_32_60"]


def test_a_system_without_elements_is_refused() -> None:
    with pytest.raises(ValueError, match="nothing: a system has at least one element"):
        OpticalSystem("nothing", ())


@pytest.mark.parametrize(("count", "gaps"), [(1, (1.0,)), (2, ()), (2, (1.0, 2.0)), (3, (1.0,))])
def test_a_wrong_number_of_gaps_is_refused(count: int, gaps: tuple[float, ...]) -> None:
    with pytest.raises(ValueError, match=r"^ours: ") as refusal:
        OpticalSystem("ours", (PCX,) * count, gaps)
    assert f"{count} elements have {count - 1} gaps" in str(refusal.value)
    assert f"not {len(gaps)}" in str(refusal.value)


@pytest.mark.parametrize("bad", [-0.01, -5, math.nan, math.inf])
def test_gaps_that_are_no_distance_are_refused(bad: float) -> None:
    window = Plate("window", 0.7, MATERIALS["air"])
    with pytest.raises(ValueError, match="front to back and cannot overlap") as refusal:
        OpticalSystem("ours", (PCX, PCX, window), (1.0, bad))
    assert str(refusal.value).startswith(f"gap between PCX_30_32_60 and window = {bad:g}:")
    with pytest.raises(ValueError, match=f"^gap between .* = {bad:g}:"):
        telecentric_pair(gap=bad)
    with pytest.raises(ValueError, match=f"^gap between .* = {bad:g}:"):
        collimating_pair(gap=bad)


@pytest.mark.parametrize("bad", [True, "1", 1j, None])
def test_gaps_that_are_no_numbers_are_refused(bad: Any) -> None:
    with pytest.raises(TypeError) as refusal:
        OpticalSystem("ours", (PCX, PCX), (bad,))
    assert str(refusal.value).startswith(f"gap between PCX_30_32_60 and PCX_30_32_60 = {bad!r}:")


@pytest.mark.parametrize("bad", [-0.1, math.nan, math.inf])
def test_sensor_distances_that_are_none_are_refused(bad: float) -> None:
    with pytest.raises(ValueError, match=f"^sensor_distance = {bad:g}:"):
        OpticalSystem("ours", (PCX,), (), bad)


def test_a_head_whose_lenses_overlap_is_refused() -> None:
    with pytest.raises(ValueError, match=r"^gap between PCX_30_32_60 and PCX_30_32_60 = -0\.83"):
        prototype_head(concave_height=39)


def test_a_head_needs_the_sensors_window() -> None:
    with pytest.raises(ValueError, match=r"^TCD1703: a head needs its window"):
        prototype_head(SENSORS["TCD1703"])


def test_a_head_needs_pairs() -> None:
    single = OpticalSystem("single", (PCX,))
    with pytest.raises(ValueError, match=r"^single: a pair of two lenses"):
        prototype_head(pair=single)
    with pytest.raises(ValueError, match=r"^single: a pair of two lenses"):
        prototype_head(collimator=single)


def test_unknown_lenses_are_refused_with_the_known_ones() -> None:
    with pytest.raises(ValueError, match=r"^lens 'LJ0000': known are .*LJ1430L1.*PCX_30_32_60"):
        telecentric_pair("LJ0000")
    with pytest.raises(ValueError, match=r"^lens 'LJ0000': known are"):
        collimating_pair(convex="LJ0000")


@pytest.mark.parametrize("bad", ["z", "", None])
def test_other_meridians_are_refused(bad: Any) -> None:
    system = telecentric_pair()
    for call in (
        system.matrix,
        system.cardinal_points,
        system.effective_focal_length,
        system.back_focal_length,
        lambda meridian: system.trace([[1.0], [0.0]], meridian),
    ):
        with pytest.raises(ValueError, match=f"^meridian = {bad!r}:"):
            call(bad)


def test_lists_are_accepted_for_tuples() -> None:
    elements: Any = [PCX, PCX]
    gaps: Any = [1.0]
    system = OpticalSystem("ours", elements, gaps)
    assert system == replace(system, elements=(PCX, PCX), gaps=(1.0,))
    assert hash(system) == hash(OpticalSystem("ours", (PCX, PCX), (1.0,)))


# --- places ---------------------------------------------------------------------------------

GLASS = MATERIALS["thesis glass"]
PCV = THESIS_LENSES["PCV_15_30_20"]
SLIT = Aperture("slit", x=5.0)


def turn(axis: int, angle: float) -> np.ndarray[Any, Any]:
    """Rodrigues: v cos + (k × v) sin + k (k · v) (1 − cos)."""
    k = np.eye(3)[axis]
    columns = [
        v * math.cos(angle) + np.cross(k, v) * math.sin(angle) + k * (k @ v) * (1 - math.cos(angle))
        for v in np.eye(3)
    ]
    return np.stack(columns, axis=1)


def test_rotation_is_about_x_then_y_then_z() -> None:
    tilt = (0.3, -0.4, 1.2)
    expected = turn(2, tilt[2]) @ turn(1, tilt[1]) @ turn(0, tilt[0])
    assert_allclose(Placement(tilt=tilt).rotation(), expected, rtol=1e-14, atol=1e-16)
    # right-handed: about X, Y goes to Z
    assert_allclose(Placement(tilt=(0.1, 0, 0)).rotation()[:, 1], [0, math.cos(0.1), math.sin(0.1)])
    assert_array_equal(Placement().rotation(), np.eye(3))


def test_places_are_the_layout_with_the_deviations() -> None:
    placements = (
        Placement(),
        Placement((0.1, -0.2), (0.01, 0.02, 0.03)),
        Placement((0.0, 0.3)),
        Placement(),
        Placement(tilt=(0, 0, 0.5)),
    )
    head = replace(prototype_head(), placements=placements, sensor_placement=Placement((0.05, 0.0)))
    places = head.places()
    assert len(places) == 6
    for (rotation, origin), placement, placed in zip(
        places, placements, head.layout(), strict=False
    ):
        assert_array_equal(rotation, placement.rotation())
        assert_array_equal(origin, [*placement.decentre, placed.front])
    assert_allclose(places[-1][1], [0.05, 0.0, 42.70 + 0.82], rtol=1e-14)
    assert len(telecentric_pair().places()) == 2  # no sensor
    # matrices know nothing of them
    assert head.matrix("x") == prototype_head().matrix("x")
    assert hash(head) != hash(prototype_head())


@pytest.mark.parametrize("bad", [math.nan, math.inf])
@pytest.mark.parametrize(("name", "length"), [("decentre", 2), ("tilt", 3)])
def test_placements_that_are_not_finite_are_refused(name: str, length: int, bad: float) -> None:
    for at in range(length):
        values: Any = [0.0] * length
        values[at] = bad
        with pytest.raises(ValueError, match=rf"^{name}\[{at}\] = {bad}"):
            Placement(**{name: values})
    wrong: Any = {name: ["0.1"] * length}
    with pytest.raises(TypeError, match=rf"^{name}\[0\] = '0.1'"):
        Placement(**wrong)


@pytest.mark.parametrize("bad", [(), (0.1,), (0.1, 0.2, 0.3, 0.4)])
def test_placements_of_another_number_are_refused(bad: Any) -> None:
    with pytest.raises(ValueError, match=r"^decentre = .*: 2 numbers are needed, mm in X and Y"):
        Placement(decentre=bad)
    with pytest.raises(ValueError, match=r"^tilt = .*: 3 numbers are needed, rad about X, Y, Z"):
        Placement(tilt=bad)


@pytest.mark.parametrize("tilt", [(math.pi / 2, 0, 0), (0, -2.0, 0), (5.0, 0, 0)])
def test_tilts_in_degrees_are_refused(tilt: Any) -> None:
    with pytest.raises(ValueError, match="given in degrees") as refusal:
        Placement(tilt=tilt)
    assert str(refusal.value).startswith(f"tilt = {tuple(map(float, tilt))}")
    assert Placement(tilt=(0, 1.57, 90)).tilt == (0, 1.57, 90)  # about Z all angles are sensible


def test_a_wrong_number_of_placements_is_refused() -> None:
    with pytest.raises(ValueError, match=r"1 placements for 5 elements; give one for each"):
        replace(prototype_head(), placements=(Placement(),))


# --- turned ---------------------------------------------------------------------------------


@pytest.mark.parametrize("name", SYSTEMS)
def test_turned_is_the_system_from_behind(name: str) -> None:
    system = SYSTEMS[name]
    back = system.turned()
    assert back.sensor_distance is None
    assert back.length == pytest.approx(system.length, rel=1e-15)
    for meridian in ("x", "y"):
        m = system.matrix(meridian)
        seen = back.matrix(meridian)
        assert_allclose(np.asarray(seen), [[m.D, m.B], [m.C, m.A]], rtol=1e-12, atol=1e-15)
    assert back.turned().elements == system.elements
    assert back.turned().gaps == system.gaps
    assert back.name == f"{system.name}, turned"


def test_displaced_elements_cannot_be_turned_but_a_sensor_can_be_left() -> None:
    head = prototype_head()
    moved = replace(head, placements=(Placement((0.1, 0.0)), *[Placement()] * 4))
    with pytest.raises(ValueError, match="only a system of elements in their places"):
        moved.turned()
    nominal = replace(
        head, placements=(Placement(),) * 5, sensor_placement=Placement(tilt=(0.1, 0, 0))
    )
    assert nominal.turned() == head.turned()


# --- overlap --------------------------------------------------------------------------------


def sag(radius: float, height: float) -> float:
    return radius - math.sqrt(radius**2 - height**2)


def least_gap(before: Any, after: Any, *, low: float = 0.0, high: float = 40.0) -> float:
    """The smallest gap that is not refused."""
    while high - low > 1e-10:
        middle = (low + high) / 2
        try:
            OpticalSystem("gap", (before, after), (middle,))
        except ValueError as refusal:
            assert "overlap" in str(refusal)  # noqa: PT017
            low = middle
        else:
            high = middle
    return high


def test_lenses_may_stand_as_close_as_their_glass_allows() -> None:
    """The smallest gap is what the circles say, to 1e-8 mm."""
    convex, hollow = PCX.turned(), replace(PCX, radius=-31.0)
    deep = sag(31, 15)
    cases: list[tuple[Any, Any, float]] = [
        (convex, PCX, 0.0),  # curved sides touch in their vertices
        (convex, hollow, 0.0),  # as ball and socket
        (PCX, hollow, deep),  # a plane before a hollow: the edges meet
        (hollow.turned(), PCX.turned(), deep),
        (hollow.turned(), hollow, 2 * deep),
        (hollow.turned(), PCX, 0.0),
        (replace(convex, radius=60.0), hollow, deep - sag(60, 15)),
        (replace(convex, radius=20.0, centre_thickness=7.0), hollow, 0.0),
        (PCX, hollow.bending("y"), sag(31, 15)),  # 32 mm wide, 30 high
        (convex, hollow.bending("y"), sag(31, 15)),  # crossed: its ends in the middle
    ]
    for before, after, expected in cases:
        assert least_gap(before, after) == pytest.approx(expected, abs=1e-8)


def test_only_the_smaller_one_of_the_two_can_touch() -> None:
    small = Lens("small", 10, 10, 31, 5.9, GLASS).turned()
    hollow = replace(PCX, radius=-31.0)
    flat = small.turned()
    assert least_gap(flat, hollow) == pytest.approx(sag(31, 5), abs=1e-8)
    assert least_gap(hollow.turned(), small) == pytest.approx(sag(31, 5), abs=1e-8)


def test_round_lenses_touch_on_a_circle_not_in_the_corners() -> None:
    hollow = SphericalLens("hollow", 20.0, -15.0, math.inf, 3.0, GLASS)
    flat = SphericalLens("flat", 20.0, math.inf, math.inf, 3.0, GLASS)
    assert least_gap(flat, hollow) == pytest.approx(sag(15, 10), abs=1e-8)
    assert least_gap(hollow.turned(), flat) == pytest.approx(sag(15, 10), abs=1e-8)
    # a square lens of 20 mm has its corners outside the round one
    square = Lens("square", 20, 20, 100, 5, GLASS)
    assert least_gap(square, hollow) == pytest.approx(sag(15, 10), abs=1e-8)


def test_screens_reach_to_the_edge_of_their_opening() -> None:
    hollow = replace(PCX, radius=-31.0)
    assert least_gap(SLIT, PCX) == 0 or least_gap(SLIT, PCX) < 1e-9  # before a convex side
    assert least_gap(PCX.turned(), SLIT) < 1e-9
    assert least_gap(SLIT, hollow) == pytest.approx(sag(31, 15), abs=1e-8)
    assert least_gap(hollow.turned(), SLIT) == pytest.approx(sag(31, 15), abs=1e-8)
    # one that is wider than the lens lets it in
    assert least_gap(Aperture("wide", x=30.5, y=32.5), hollow) < 1e-9
    assert least_gap(hollow.turned(), Aperture("open")) < 1e-9


def test_tilts_and_decentres_need_room() -> None:
    disc = SphericalLens("disc", 20.0, math.inf, math.inf, 3.0, GLASS)
    tilted = (Placement(), Placement(tilt=(0.0, 0.1, 0.0)))
    room = 10 * math.tan(0.1)  # the tilted front is met 10 mm from the axis
    with pytest.raises(ValueError, match=r"disc and disc overlap by .* 0\.9 mm apart; is the gap"):
        OpticalSystem("tilted", (disc, disc), (0.9,), placements=tilted)
    OpticalSystem("tilted", (disc, disc), (room + 0.001,), placements=tilted)
    # parallel, but the second one's vertex stays on the axis
    room = 3 / math.cos(0.1) - 3
    OpticalSystem("both", (disc, disc), (room + 1e-8,), placements=(tilted[1],) * 2)
    with pytest.raises(ValueError, match="overlap"):
        OpticalSystem("both", (disc, disc), (room - 1e-8,), placements=(tilted[1],) * 2)
    # ball and socket fit only where they are centred
    hollow, convex = replace(PCX, radius=-31.0), PCX.turned()
    aside = (Placement(), Placement(decentre=(3.0, 0.0)))
    OpticalSystem("fits", (convex, hollow), (0.0,))
    with pytest.raises(ValueError, match="overlap"):
        OpticalSystem("aside", (convex, hollow), (0.0,), placements=aside)
    OpticalSystem(
        "along", (convex, hollow), (0.0,), placements=(Placement(), Placement((0.0, 3.0)))
    )


def test_overlap_names_what_where_and_why() -> None:
    hollow = replace(PCX, radius=-31.0, part="hollow")
    with pytest.raises(ValueError, match="PCX_30_32_60 and hollow overlap") as refusal:
        OpticalSystem("ours", (PCX, hollow), (1.5,))
    message = str(refusal.value)
    assert f"overlap by {sag(31, 15) - 1.5:.4g} mm" in message
    assert "x = -15" in message or "x = 15" in message
    assert "vertices are 1.5 mm apart; is the gap too small, or a lens the wrong way" in message


def test_a_hollow_half_cylinder_is_as_deep_as_its_radius() -> None:
    """Where 1/R is rounded up its edge must not be taken for no glass at all."""
    for radius in (20.0, 23.25, 30.75, 49.0):
        gutter = Lens("gutter", 2 * radius, 20, -radius, 2.0, GLASS)
        flat = Lens("flat", 2 * radius, 20, 1000, 10, GLASS)
        assert least_gap(flat, gutter, high=60) == pytest.approx(radius, abs=1e-8)


def test_the_wrong_way_round_is_found_in_the_head() -> None:
    head = prototype_head()
    concave, first, second, convex, window = head.elements
    for elements in [
        (concave.turned(), first, second, convex, window),  # hollow toward the pair: 2.63 mm
        (concave, replace(PCX, radius=-31.0), second, convex, window),  # hollow to a plane side
    ]:
        try:
            OpticalSystem("head", elements, head.gaps, head.sensor_distance)
        except ValueError as refusal:
            assert "overlap" in str(refusal)  # noqa: PT017
        else:
            pytest.fail("accepted")
    # and what fits is not refused
    OpticalSystem("head", (concave, first, second, convex.turned(), window), head.gaps)
    OpticalSystem("slit", (SLIT, *head.elements), (3.25, *head.gaps), head.sensor_distance)


def test_what_is_no_element_is_refused() -> None:
    wrong: Any = (PCX, "PCX_30_32_60")
    with pytest.raises(TypeError, match=r"^ours: 'PCX_30_32_60' is no Lens, Plate or Aperture"):
        OpticalSystem("ours", wrong, (1.0,))


def test_what_is_no_placement_is_refused() -> None:
    wrong: Any = ((0.1, 0.0),)
    with pytest.raises(TypeError, match=r"^ours: .*\(0.1, 0.0\).*Placement"):
        OpticalSystem("ours", (PCX,), placements=wrong)
    with pytest.raises(TypeError, match=r"^ours: .*\(0.1, 0.0\).*Placement"):
        OpticalSystem("ours", (PCX,), sensor_placement=wrong[0])


def test_glass_does_not_reach_through_a_wide_screen_into_other_glass() -> None:
    """Two hollow sides back to back touch at their edges, whatever is open between them."""
    hollow = Lens("hollow", 20.0, 20.0, -20.0, 3.0, MATERIALS["N-BK7"])
    wide = Aperture("wide open", 30.0, 30.0)
    deep = 2 * abs(hollow.sag(10.0))
    with pytest.raises(ValueError, match=r"hollow and hollow overlap by 0\.2 mm"):
        OpticalSystem("close", (hollow.turned(), wide, hollow), (deep / 2 - 0.1, deep / 2 - 0.1))
    OpticalSystem("apart", (hollow.turned(), wide, hollow), (deep / 2, deep / 2))
