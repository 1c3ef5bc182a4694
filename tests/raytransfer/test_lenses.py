"""Cylindrical lenses and plates: the catalogue's numbers, geometry, matrices."""

from __future__ import annotations

import math
import tomllib
from dataclasses import FrozenInstanceError, replace
from importlib.resources import files
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from raytransfer import CATALOGUE, MATERIALS, THESIS_LENSES, ConstantIndex, Lens, Plate
from raytransfer.lenses import Aperture, SphericalLens

if TYPE_CHECKING:
    from raytransfer.lenses import Meridian

PARTS = [
    "LJ1695L1",
    "LJ1430L1",
    "LJ1477L1",
    "LJ1567L1",
    "LJ1640L1",
    "LJ1629L1",
    "LJ1653L1",
    "LJ1558L1",
    "LJ1363L1",
    "LJ1144L1",
    "LJ1836L1",
    "LJ1516L1",
    "LJ1328L2",
    "LK1085L2",
]
NOMINAL = tomllib.loads((files("raytransfer") / "data" / "lenses.toml").read_text())["catalogue"]
GLASS = MATERIALS["thesis glass"]
PCX = Lens("PCX", 30, 32, 31, 5.9, GLASS)


# --- the catalogue --------------------------------------------------------------------------


def test_the_catalogue_has_these_parts_and_no_others() -> None:
    assert sorted(CATALOGUE) == sorted(PARTS)
    assert all(lens.part == part for part, lens in CATALOGUE.items())


def test_the_tables_are_read_only() -> None:
    for table in (CATALOGUE, THESIS_LENSES):
        lenses: Any = table
        with pytest.raises(TypeError):
            lenses["LJ1430L1"] = PCX
        with pytest.raises(TypeError):
            del lenses["LJ1430L1"]
    lens: Any = CATALOGUE["LJ1430L1"]
    with pytest.raises(FrozenInstanceError):
        lens.radius = 30.0


@pytest.mark.parametrize("part", PARTS)
def test_radius_belongs_to_the_nominal_focal_length(part: str) -> None:
    expected = NOMINAL[part]["focal_length"] * (1.5168 - 1)
    rounding = max(0.01, 0.001 * abs(expected))
    assert CATALOGUE[part].radius == pytest.approx(expected, abs=rounding)


@pytest.mark.parametrize("part", PARTS)
def test_edge_thickness_is_the_catalogues(part: str) -> None:
    lens = CATALOGUE[part]
    # Pythagoras: how deep the circle is at the edge
    depth = abs(lens.radius) - math.sqrt(lens.radius**2 - (lens.height / 2) ** 2)
    edge = lens.centre_thickness - math.copysign(depth, lens.radius)
    assert edge == pytest.approx(NOMINAL[part]["edge_thickness"], abs=0.06)
    assert lens.edge_thickness == pytest.approx(edge, rel=1e-12)


@pytest.mark.parametrize("part", PARTS)
def test_focal_length_is_the_catalogues(part: str) -> None:
    lens = CATALOGUE[part]
    assert lens.focal_length() == pytest.approx(NOMINAL[part]["focal_length"], rel=2e-3)
    assert lens.matrix("x")[1, 0] == pytest.approx(-1 / lens.focal_length(), rel=1e-12)


def test_the_catalogues_names_say_what_is_concave() -> None:
    for part, lens in CATALOGUE.items():
        assert (lens.radius < 0) == part.startswith("LK")
        assert (lens.bends, lens.reversed) == ("x", False)
        assert lens.material is MATERIALS["N-BK7"]


@pytest.mark.parametrize(
    ("name", "height", "length", "radius", "thickness"),
    [
        ("PCX_30_32_50", 30, 32, 25.84, 6.80),
        ("PCX_30_32_60", 30, 32, 31, 5.9),
        ("PCX_30_32_100", 30, 32, 51.68, 5.22),
        ("PCX_15_30_20", 15, 30, 10.3, 5.2),
        ("PCV_15_30_20", 15, 30, -10.3, 2),
    ],
)
def test_the_thesiss_lenses(
    name: str, height: float, length: float, radius: float, thickness: float
) -> None:
    lens = THESIS_LENSES[name]
    assert (lens.height, lens.length) == (height, length)
    assert (lens.radius, lens.thickness, lens.centre_thickness) == (radius, thickness, thickness)
    assert lens.material.index() == 1.52
    assert len(THESIS_LENSES) == 5


# --- geometry -------------------------------------------------------------------------------


@pytest.mark.parametrize("radius", [31.0, -31.0])
def test_sag_is_a_circle(radius: float) -> None:
    lens = replace(PCX, radius=radius)
    for y in np.linspace(-15, 15, 31):
        z = lens.sag(y)
        assert (z - radius) ** 2 + y**2 == pytest.approx(radius**2, rel=1e-12)
        assert z * radius >= 0
    assert lens.sag(0) == 0


def test_a_half_cylinder_is_the_thickest_lens() -> None:
    lens = replace(PCX, radius=15.0, centre_thickness=15.0)
    assert lens.edge_thickness == 0


def test_turned_and_bending() -> None:
    assert PCX.turned() == replace(PCX, reversed=True)
    assert PCX.turned().turned() == PCX
    assert PCX.bending("y") == replace(PCX, bends="y")
    assert PCX.bending("x") == PCX
    assert_array_equal(np.asarray(PCX.bending("y").matrix("y")), np.asarray(PCX.matrix("x")))


# --- matrices -------------------------------------------------------------------------------

lenses = st.builds(
    Lens,
    part=st.just("any"),
    height=st.just(10.0),
    length=st.just(10.0),
    radius=st.floats(5, 1000) | st.floats(-1000, -5),
    centre_thickness=st.floats(5.1, 40),
    material=st.builds(ConstantIndex, st.just("any"), st.floats(1.01, 2.5)),
    bends=st.sampled_from(["x", "y"]),
    reversed=st.booleans(),
)


@settings(deadline=None)
@given(lenses)
def test_matrix_of_a_thick_plano_lens(lens: Lens) -> None:
    """Textbook: power at the curved side only, the glass as long as t/n."""
    n, t = lens.material.index(), lens.thickness
    power = (n - 1) / lens.radius
    expected = [[1 - power * t / n, t / n], [-power, 1]]
    if lens.reversed:
        expected = [[1, t / n], [-power, 1 - power * t / n]]
    m = lens.matrix(lens.bends)
    assert_allclose(np.asarray(m), expected, rtol=1e-12, atol=1e-14)
    a, b, c, d = np.asarray(m).flat
    assert a * d - b * c == pytest.approx(1, rel=1e-12)
    assert (m.n1, m.n2) == (1.0, 1.0)


@settings(deadline=None)
@given(lenses)
def test_a_lens_is_a_plate_where_it_does_not_bend(lens: Lens) -> None:
    other: Meridian = "y" if lens.bends == "x" else "x"
    n, t = lens.material.index(), lens.thickness
    assert_allclose(np.asarray(lens.matrix(other)), [[1.0, t / n], [0.0, 1.0]], rtol=1e-14)
    assert_array_equal(np.asarray(lens.matrix(other, plates=False)), [[1, t], [0, 1]])
    # plates are no matter where it bends
    assert lens.matrix(lens.bends, plates=False) == lens.matrix(lens.bends)


@settings(deadline=None)
@given(lenses)
def test_a_turned_lens_is_the_lens_for_light_from_behind(lens: Lens) -> None:
    m, turned = lens.matrix(lens.bends), lens.turned().matrix(lens.bends)
    assert_allclose(np.asarray(turned), [[m.D, m.B], [m.C, m.A]], rtol=1e-12, atol=1e-14)
    assume(abs(lens.radius) < 500)
    assert turned != m  # a plano lens has two different sides


@pytest.mark.parametrize("part", PARTS)
@pytest.mark.parametrize("meridian", ["x", "y"])
@pytest.mark.parametrize("plates", [True, False])
def test_every_matrix_of_the_catalogue_has_determinant_1(
    part: str, meridian: Meridian, plates: bool
) -> None:
    for lens in (CATALOGUE[part], CATALOGUE[part].turned()):
        matrix = lens.matrix(meridian, plates=plates)
        assert np.linalg.det(np.asarray(matrix)) == pytest.approx(1, rel=1e-12)
        assert matrix.determinant == 1


def test_a_lens_is_stronger_for_blue_light() -> None:
    lens = CATALOGUE["LJ1430L1"]
    blue, red = 0.45, 0.65
    assert lens.focal_length(blue) < lens.focal_length() < lens.focal_length(red)
    for wavelength in (blue, red):
        n = MATERIALS["N-BK7"].index(wavelength)
        assert lens.focal_length(wavelength) == pytest.approx(31 / (n - 1), rel=1e-14)
        m = lens.matrix("x", wavelength=wavelength)
        assert m[1, 0] == pytest.approx(-(n - 1) / 31, rel=1e-12)
        assert lens.matrix("y", wavelength=wavelength)[0, 1] == pytest.approx(5.87 / n, rel=1e-12)


def test_a_plate_shortens_the_path_in_both_meridians() -> None:
    window = Plate("window", 0.7, MATERIALS["sensor window"])
    for meridian in ("x", "y"):
        assert_allclose(
            np.asarray(window.matrix(meridian)), [[1.0, 0.7 / 1.5], [0.0, 1.0]], rtol=1e-14
        )
        assert_array_equal(np.asarray(window.matrix(meridian, plates=False)), [[1, 0.7], [0, 1]])


def test_a_plate_has_dispersion_too() -> None:
    plate = Plate("plate", 3.0, MATERIALS["N-SF11"])
    n = MATERIALS["N-SF11"].index(0.45)
    assert plate.matrix("x", wavelength=0.45)[0, 1] == pytest.approx(3 / n, rel=1e-14)
    assert plate.matrix("x").B != plate.matrix("x", wavelength=0.45).B


# --- refusals -------------------------------------------------------------------------------

SIZES = ["height", "length", "centre_thickness"]


@pytest.mark.parametrize("name", SIZES)
@pytest.mark.parametrize("bad", [math.nan, math.inf, 0, -5.9])
def test_sizes_that_are_not_positive_are_refused(name: str, bad: float) -> None:
    change: Any = {name: bad}
    with pytest.raises(ValueError, match=f"^{name} of PCX = {bad:g}: allowed"):
        replace(PCX, **change)


@pytest.mark.parametrize("name", [*SIZES, "radius"])
@pytest.mark.parametrize("bad", [True, "30", 30j, None, [30.0]])
def test_sizes_that_are_not_numbers_are_refused(name: str, bad: Any) -> None:
    with pytest.raises(TypeError) as refusal:
        replace(PCX, **{name: bad})
    assert str(refusal.value).startswith(f"{name} of PCX = {bad!r}:")


@pytest.mark.parametrize("bad", [0, math.nan, math.inf])
def test_radii_that_are_none_are_refused(bad: float) -> None:
    with pytest.raises(ValueError, match=f"^radius of PCX = {bad:g}:"):
        replace(PCX, radius=bad)


@pytest.mark.parametrize("bad", [14.99, -14.99, 1.0])
def test_radii_shorter_than_half_the_height_are_refused(bad: float) -> None:
    with pytest.raises(ValueError, match=r"half the height \(15 mm\).*focal length") as refusal:
        replace(PCX, radius=bad)
    assert str(refusal.value).startswith(f"radius of PCX = {bad:g} mm:")
    assert replace(PCX, radius=15.0, centre_thickness=20).radius == 15


def test_lenses_too_thin_for_their_edge_are_refused() -> None:
    with pytest.raises(ValueError, match=r"^centre_thickness of PCX = 3\.8 mm:.*edge thickness"):
        replace(PCX, centre_thickness=3.8)  # the curved side is 3.87 mm deep
    assert replace(PCX, centre_thickness=3.9).edge_thickness == pytest.approx(0.03, abs=0.01)


@pytest.mark.parametrize("bad", ["z", "X", "", None])
def test_other_meridians_are_refused(bad: Any) -> None:
    plate = Plate("window", 0.7, GLASS)
    with pytest.raises(ValueError, match="allowed are 'x'") as refusal:
        replace(PCX, bends=bad)
    assert str(refusal.value).startswith(f"bends = {bad!r}:")
    with pytest.raises(ValueError, match=f"^meridian = {bad!r}:"):
        PCX.matrix(bad)
    with pytest.raises(ValueError, match=f"^meridian = {bad!r}:"):
        plate.matrix(bad)
    with pytest.raises(ValueError, match=f"^bends = {bad!r}:"):
        PCX.bending(bad)


@pytest.mark.parametrize("bad", [0, -0.7, math.nan, math.inf])
def test_plates_without_thickness_are_refused(bad: float) -> None:
    with pytest.raises(ValueError, match=f"^thickness of window = {bad:g}:"):
        Plate("window", bad, GLASS)


@pytest.mark.parametrize("bad", [True, "0.7", None])
def test_plates_of_no_number_are_refused(bad: Any) -> None:
    with pytest.raises(TypeError, match=f"^thickness of window = {bad!r}:"):
        Plate("window", bad, GLASS)


def test_wavelengths_in_nm_are_refused() -> None:
    lens = CATALOGUE["LJ1430L1"]
    with pytest.raises(ValueError, match="given in nm"):
        lens.matrix("x", wavelength=587.6)
    with pytest.raises(ValueError, match="given in nm"):
        lens.focal_length(587.6)


# --- clear aperture -------------------------------------------------------------------------


def test_a_clear_aperture_closes_the_edges_but_not_the_glass() -> None:
    lens = replace(PCX, clear=(26.0, 28.0))
    assert (lens.aperture("x"), lens.aperture("y")) == (26, 28)
    assert (lens.size("x"), lens.size("y")) == (30, 32)
    assert lens.edge_thickness == PCX.edge_thickness
    assert (PCX.aperture("x"), PCX.aperture("y")) == (30, 32)
    assert_array_equal(np.asarray(lens.matrix("x")), np.asarray(PCX.matrix("x")))
    for surface in lens.surfaces():
        assert surface.half == (13, 14)
    # (across, along) go with the lens
    turned = lens.bending("y")
    assert (turned.aperture("x"), turned.aperture("y")) == (28, 26)
    assert [surface.half for surface in turned.turned().surfaces()] == [(14, 13)] * 2


def test_a_clear_aperture_may_be_all_of_the_glass_and_a_list() -> None:
    as_list: Any = [30, 32]
    lens = replace(PCX, clear=as_list)
    assert lens == replace(PCX, clear=(30, 32))
    assert hash(lens) == hash(replace(PCX, clear=(30, 32)))


@pytest.mark.parametrize(
    ("clear", "name", "glass"), [((30.001, 10), "height", 30), ((10, 32.5), "length", 32)]
)
def test_clear_apertures_larger_than_the_glass_are_refused(
    clear: tuple[float, float], name: str, glass: int
) -> None:
    with pytest.raises(ValueError, match=rf"the glass is {glass} mm; clear is \(across") as refusal:
        replace(PCX, clear=clear)
    wrong = clear[name == "length"]
    assert str(refusal.value).startswith(f"clear {name} of PCX = {wrong:g} mm:")


@pytest.mark.parametrize("bad", [0, -3, math.nan, math.inf])
def test_clear_apertures_that_are_no_size_are_refused(bad: float) -> None:
    with pytest.raises(ValueError, match=f"^clear height of PCX = {bad:g}: allowed"):
        replace(PCX, clear=(bad, 10))
    with pytest.raises(ValueError, match=f"^clear length of PCX = {bad:g}: allowed"):
        replace(PCX, clear=(10, bad))


@pytest.mark.parametrize("bad", [(10.0,), (10.0, 10.0, 10.0), ()])
def test_clear_apertures_of_another_number_are_refused(bad: Any) -> None:
    with pytest.raises(ValueError, match=r"^clear of PCX = .*two sizes.*\(across, along\)"):
        replace(PCX, clear=bad)


# --- surfaces of the elements ---------------------------------------------------------------


@settings(deadline=None)
@given(lenses)
def test_surfaces_are_the_lens(lens: Lens) -> None:
    front, back = lens.surfaces()
    assert (front.z, back.z) == (0, lens.thickness)
    assert (front.material, back.material) == (lens.material, None)
    curved, plane = (back, front) if lens.reversed else (front, back)
    assert plane.curvature == 0
    assert curved.bends == lens.bends
    at = np.array([-5.0, 2.0, 4.9])
    x, y = (at, 0 * at) if lens.bends == "x" else (0 * at, at)
    depth = [lens.sag(height) for height in at]
    # a convex side retreats into the glass from its vertex, whichever way it looks
    assert_allclose(curved.sag(x, y), np.multiply(depth, -1 if lens.reversed else 1), atol=1e-10)
    assert_array_equal(curved.sag(y, x), 0)
    # as seen from behind
    for seen, here in zip(lens.turned().surfaces(), (back, front), strict=True):
        assert seen.curvature == -here.curvature
        assert seen.z == pytest.approx(lens.thickness - here.z, abs=1e-12)


# --- screens --------------------------------------------------------------------------------


def test_a_screen_is_thin_and_bends_nothing() -> None:
    slit = Aperture("slit", x=5.0)
    assert slit.thickness == 0
    for meridian, opening in (("x", 5.0), ("y", math.inf)):
        m: Any = meridian
        assert_array_equal(np.asarray(slit.matrix(m, plates=False, wavelength=0.45)), np.eye(2))
        assert slit.aperture(m) == opening
        assert slit.size(m) == math.inf
    (surface,) = slit.surfaces()
    assert surface.screen
    assert (surface.half, surface.material, surface.curvature) == ((2.5, math.inf), None, 0)
    assert slit.turned() == slit
    assert Aperture("open").aperture("x") == math.inf


@pytest.mark.parametrize("name", ["x", "y"])
@pytest.mark.parametrize("bad", [0, -5, math.nan, -math.inf])
def test_openings_that_are_no_width_are_refused(name: str, bad: float) -> None:
    with pytest.raises(ValueError, match=f"^{name} of slit = {bad:g}:") as refusal:
        Aperture("slit", **{name: bad})
    assert "full width" in str(refusal.value) or "finite" in str(refusal.value)


@pytest.mark.parametrize("bad", [True, "5", None, [5.0]])
def test_openings_that_are_no_number_are_refused(bad: Any) -> None:
    with pytest.raises(TypeError) as refusal:
        Aperture("slit", x=bad)
    assert str(refusal.value).startswith(f"x of slit = {bad!r}:")


# --- round lenses ---------------------------------------------------------------------------

ROUND = SphericalLens("ball", 20.0, 15.0, -40.0, 8.0, GLASS)


@pytest.mark.parametrize("meridian", ["x", "y"])
def test_a_round_lens_is_the_lens_makers(meridian: Meridian) -> None:
    """1/f = (n − 1) (1/R1 − 1/R2 + (n − 1) t/(n R1 R2)), in both meridians."""
    for lens in (ROUND, replace(ROUND, front_radius=-30.0), replace(ROUND, back_radius=25.0)):
        n, t, r1, r2 = 1.52, lens.thickness, lens.front_radius, lens.back_radius
        power = (n - 1) * (1 / r1 - 1 / r2 + (n - 1) * t / (n * r1 * r2))
        m = lens.matrix(meridian)
        assert_allclose(m.C, -power, rtol=1e-12)
        assert_allclose([m.A, m.D], [1 - (n - 1) * t / (n * r1), 1 + (n - 1) * t / (n * r2)])
        assert_allclose(m.B, t / n, rtol=1e-14)
        back = lens.turned().matrix(meridian)
        assert_allclose(np.asarray(back), [[m.D, m.B], [m.C, m.A]], rtol=1e-12)
    assert ROUND.size(meridian) == ROUND.aperture(meridian) == 20


def test_a_round_lens_with_plane_sides_is_a_plate() -> None:
    lens = SphericalLens("disc", 20.0, math.inf, -math.inf, 3.0, GLASS)
    assert_allclose(np.asarray(lens.matrix("x")), [[1.0, 3 / 1.52], [0.0, 1.0]], rtol=1e-14)
    assert lens.edge_thickness == 3
    assert [surface.curvature for surface in lens.surfaces()] == [0, 0]
    assert all(surface.round for surface in lens.surfaces())


def test_edges_of_round_lenses() -> None:
    front, back = 15 - math.sqrt(15**2 - 100), 40 - math.sqrt(40**2 - 100)
    assert ROUND.edge_thickness == pytest.approx(8 - front - back, rel=1e-12)
    meniscus = replace(ROUND, front_radius=15.0, back_radius=20.0)
    assert meniscus.edge_thickness == pytest.approx(8 - front + 20 - math.sqrt(300), rel=1e-12)
    assert ROUND.turned().turned() == ROUND
    assert ROUND.turned().edge_thickness == pytest.approx(ROUND.edge_thickness, rel=1e-12)


@pytest.mark.parametrize("radius", [15.0, 23.25, 24.75, 30.75, 49.0])
def test_a_whole_ball_is_a_lens(radius: float) -> None:
    """Its edge is 0 thick, also where 1/R is rounded up."""
    ball = SphericalLens("ball", 2 * radius, radius, -radius, 2 * radius, GLASS)
    assert ball.edge_thickness == pytest.approx(0, abs=1e-12)
    n = 1.52
    assert_allclose(ball.matrix("x").C, -2 * (n - 1) / (n * radius), rtol=1e-12)


@pytest.mark.parametrize("name", ["diameter", "centre_thickness"])
@pytest.mark.parametrize("bad", [math.nan, math.inf, 0, -5.9])
def test_round_sizes_that_are_not_positive_are_refused(name: str, bad: float) -> None:
    change: Any = {name: bad}
    with pytest.raises(ValueError, match=f"^{name} of ball = {bad:g}: allowed"):
        replace(ROUND, **change)


@pytest.mark.parametrize("name", ["front_radius", "back_radius"])
def test_round_radii_that_are_none_are_refused(name: str) -> None:
    for bad in (0, math.nan):
        change: Any = {name: bad}
        with pytest.raises(ValueError, match=f"^{name} of ball = {bad:g}"):
            replace(ROUND, **change)
    for bad in (9.99, -9.99):
        change = {name: bad}
        with pytest.raises(ValueError, match=r"at least half the diameter \(10 mm\)") as refusal:
            replace(ROUND, **change)
        assert str(refusal.value).startswith(f"{name} of ball = {bad:g} mm")
    wrong: Any = {name: "15"}
    with pytest.raises(TypeError, match=f"^{name} of ball = '15'"):
        replace(ROUND, **wrong)


def test_round_lenses_whose_sides_cross_are_refused() -> None:
    with pytest.raises(ValueError, match=r"^centre_thickness of ball = 5 mm: the sides cross"):
        replace(ROUND, centre_thickness=5.0)  # 3.82 + 1.27 mm deep
    assert replace(ROUND, centre_thickness=5.1).edge_thickness > 0


@pytest.mark.parametrize("make", [lambda m: replace(ROUND, material=m), lambda m: Plate("p", 1, m)])
@pytest.mark.parametrize("bad", [1.52, "N-BK7", None])
def test_materials_that_are_none_are_refused(make: Any, bad: Any) -> None:
    with pytest.raises(TypeError, match="take one of MATERIALS") as refusal:
        make(bad)
    assert f"= {bad!r}" in str(refusal.value)
