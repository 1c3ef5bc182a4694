"""`cast_rays` and `cast_rays_to_focal_length` against the thesis's own way to solve them."""

from __future__ import annotations

import math
from fractions import Fraction
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
import sympy
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import BroadcastableShapes, mutually_broadcastable_shapes
from numpy.testing import assert_allclose, assert_array_equal

from raytransfer import (
    MATERIALS,
    Lens,
    RayMatrix,
    cast_rays,
    cast_rays_to_focal_length,
    collimating_pair,
    flat_mat,
    input_vec,
    prototype_head,
    refract_mat,
    telecentric_pair,
    trans_mat,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

PAIR = telecentric_pair().matrix("x")
SYSTEMS = {
    "f60 pair": PAIR,
    "f50 pair": telecentric_pair("PCX_30_32_50").matrix("x"),
    "unequal pair, gap": telecentric_pair("LJ1430L1", "LJ1567L1", 3.3).matrix("x"),
    "collimator": collimating_pair().matrix("y"),
    "head x": prototype_head().matrix("x"),
    "head y": prototype_head().matrix("y"),
}


# --- the oracle: the thesis's method --------------------------------------------------------


def edge_rays(lens_width: Any, abcd: Any, source_dist: Any, axis_off: Any) -> list[tuple[Any, Any]]:
    """Height and angle behind the system of the rays through its upper and its lower edge."""
    (a, b), (c, d) = abcd
    result = []
    for y in (lens_width / 2, -lens_width / 2):
        angle = (y - axis_off) / source_dist
        result.append((a * y + b * angle, c * y + d * angle))
    return result


def crossing(lens_width: float, abcd: Any, source_dist: float, axis_off: float) -> Any:
    """Where the two edge rays cross: x and h with h = height + x angle for both of them."""
    rays = edge_rays(lens_width, abcd, source_dist, axis_off)
    return np.linalg.solve([[-angle, 1] for _, angle in rays], [height for height, _ in rays])


def exact_crossing(
    lens_width: float, abcd: Any, source_dist: float, axis_off: float
) -> tuple[float, float]:
    """The same in rational numbers, without any rounding."""
    width, dist, off = map(Fraction, (lens_width, source_dist, axis_off))
    exact = [[Fraction(float(element)) for element in row] for row in abcd]
    (h1, u1), (h2, u2) = edge_rays(width, exact, dist, off)
    x = (h2 - h1) / (u1 - u2)
    return float(x), float(h1 + x * u1)


def to_the_nanometre(length: float) -> float:
    return round(length, 6)


gaps = st.floats(0, 40).map(to_the_nanometre)


@st.composite
def matrices(draw: st.DrawFn) -> NDArray[np.float64]:
    """Two thick lenses and the air between them, multiplied here."""
    m = np.eye(2)
    for _ in range(2):
        n = draw(st.floats(1.3, 2.0))
        for before, after in ((1.0, n), (n, 1.0)):
            radius = draw(st.floats(10, 500)) * draw(st.sampled_from([-1, 1]))
            m = np.array([[1, 0], [(before - after) / (radius * after), before / after]]) @ m
            m = np.array([[1, draw(gaps)], [0, 1]]) @ m
    return m


widths = st.floats(0.1, 60)
source_dists = st.floats(1, 20_000)
offsets = st.floats(-3000, 3000).map(to_the_nanometre)


def assume_no_cancellation(abcd: Any, dist: float) -> None:
    """Leave out settings whose result no floating-point formula can give to 12 digits."""
    (a, b), (c, d) = abcd
    assume(abs(a * dist + b) > 1e-2 * (abs(a * dist) + abs(b)))
    assume(abs(c * dist + d) > 1e-2 * (abs(c * dist) + abs(d)))


@settings(deadline=None)
@given(widths, matrices(), source_dists, offsets)
def test_focus_is_where_the_edge_rays_cross(
    width: float, abcd: NDArray[np.float64], dist: float, off: float
) -> None:
    assume_no_cancellation(abcd, dist)
    assume(abs(off) < 100 * width)  # np.linalg.solve loses digits with nearly equal rays
    expected = crossing(width, abcd, dist, off)
    for matrix in (abcd, RayMatrix(abcd)):
        focus = cast_rays(width, matrix, dist, off)
        assert_allclose(focus, expected, rtol=1e-9, atol=1e-9 * (width + abs(off)))


@settings(deadline=None)
@given(widths, matrices(), source_dists, offsets)
def test_focus_is_exactly_where_the_edge_rays_cross(
    width: float, abcd: NDArray[np.float64], dist: float, off: float
) -> None:
    assume_no_cancellation(abcd, dist)
    (a, b), (c, d) = abcd
    assume(abs(a * d - b * c) > 1e-2 * (abs(a * d) + abs(b * c)))
    assert_allclose(
        cast_rays(width, abcd, dist, off), exact_crossing(width, abcd, dist, off), rtol=1e-12
    )


@pytest.mark.parametrize("system", SYSTEMS)
@pytest.mark.parametrize(
    ("dist", "off"), [(5000.0, 0.0), (500.0, 100.0), (200.0, 50.0), (5.0, -3.0), (1e6, 2e3)]
)
def test_focus_through_the_projects_systems(system: str, dist: float, off: float) -> None:
    matrix = SYSTEMS[system]
    expected = exact_crossing(30.0, np.asarray(matrix), dist, off)
    assert_allclose(cast_rays(30.0, matrix, dist, off), expected, rtol=1e-12)


@pytest.mark.parametrize(
    ("width", "dist", "off"), [(30, 5000, 0), (30, 200, 50), (15, 500, -100), (1, 12, 3)]
)
def test_focus_solves_equations_4_2_to_4_4(width: int, dist: int, off: int) -> None:
    """Both edge rays, the two angles and the focus unknown, solved as the thesis lets sympy do."""
    top, bottom, length, height = sympy.symbols("top bottom length height")
    lens = sympy.Matrix(2, 2, [sympy.Rational(value) for value in np.asarray(PAIR).flat])

    def ray(angle: Any) -> Any:
        return sympy.Matrix([off, angle])

    to_lens = sympy.Matrix([[1, dist], [0, 1]])
    to_focus = sympy.Matrix([[1, length], [0, 1]])
    (solution,) = sympy.solve(
        [
            (to_lens * ray(top))[0] - sympy.Rational(width, 2),  # 4.2
            (to_lens * ray(bottom))[0] + sympy.Rational(width, 2),  # 4.3
            (to_focus * lens * to_lens * ray(top))[0] - height,  # 4.4
            (to_focus * lens * to_lens * ray(bottom))[0] - height,
        ],
        [top, bottom, length, height],
        dict=True,
    )
    expected = float(solution[length]), float(solution[height])
    assert_allclose(cast_rays(width, PAIR, dist, off), expected, rtol=1e-12)


@given(st.floats(0.1, 1000))
def test_the_focus_does_not_depend_on_the_width(width: float) -> None:
    assert cast_rays(width, PAIR, 200, 50) == cast_rays(30, PAIR, 200, 50)


def test_a_negative_translation_makes_the_source_virtual() -> None:
    """Light that converges 100 mm behind a thin lens of f = 50 meets 100/3 mm behind it."""
    thin = RayMatrix([[1.0, 0.0], [-1 / 50, 1.0]])
    focus = cast_rays(30, thin @ trans_mat(-300), 200, 3)
    assert_allclose(focus, (100 / 3, 3 * (50 / 150)), rtol=1e-12)


def test_a_ball_lens() -> None:
    """A textbook's value: f = n D / (4 (n − 1)) from the centre of the ball."""
    n, radius = 1.5, 10.0
    ball = refract_mat(n, 1.0, -radius) * trans_mat(2 * radius) * refract_mat(1.0, n, radius)
    far = cast_rays(1.0, ball, 1e13, 0.0).focal_length
    assert far + radius == pytest.approx(n * 2 * radius / (4 * (n - 1)), rel=1e-11)


# --- edge rays to a plane -------------------------------------------------------------------


@settings(deadline=None)
@given(widths, matrices(), source_dists, offsets, st.floats(-500, 500).map(to_the_nanometre))
def test_edge_rays_on_a_plane(
    width: float, abcd: NDArray[np.float64], dist: float, off: float, length: float
) -> None:
    whole = np.array([[1, length], [0, 1]]) @ abcd @ np.array([[1, dist], [0, 1]])
    heights = cast_rays_to_focal_length(width, abcd, dist, off, length)
    for height, edge in ((heights.top, width / 2), (heights.bottom, -width / 2)):
        angle = (edge - off) / dist
        expected = whole @ [off, angle]
        rounding = np.abs(whole[0]) @ np.abs([off, angle]) + abs(length * abcd[1, 0] * edge)
        assert height == pytest.approx(expected[0], rel=1e-12, abs=1e-12 * rounding)


@pytest.mark.parametrize("system", SYSTEMS)
def test_edge_rays_on_a_plane_exactly(system: str) -> None:
    matrix = SYSTEMS[system]
    abcd = [[Fraction(value) for value in row] for row in np.asarray(matrix).tolist()]
    rays = edge_rays(Fraction(28), abcd, Fraction(500), Fraction(70))
    expected = [float(height + 21 * angle) for height, angle in rays]
    heights = cast_rays_to_focal_length(28, matrix, 500, 70, 21)
    assert_allclose(heights, expected, rtol=1e-12)
    assert (heights.top, heights.bottom) == (heights[0], heights[1])


def test_top_is_the_ray_through_the_upper_edge() -> None:
    top, bottom = cast_rays_to_focal_length(30, RayMatrix([[1, 0], [0, 1]]), 1000, 0, 1e-9)
    assert top == pytest.approx(15)
    assert bottom == pytest.approx(-15)


@settings(deadline=None)
@given(widths, st.sampled_from(sorted(SYSTEMS)), st.floats(300, 20_000), offsets)
def test_edge_rays_meet_in_the_focus(width: float, system: str, dist: float, off: float) -> None:
    matrix = SYSTEMS[system]
    focus = cast_rays(width, matrix, dist, off)
    heights = cast_rays_to_focal_length(width, matrix, dist, off, focus.focal_length)
    assert_allclose(heights, [focus.focal_offset] * 2, rtol=1e-9, atol=1e-10 * (width + abs(off)))


# --- shapes ---------------------------------------------------------------------------------


@settings(deadline=None)
@given(mutually_broadcastable_shapes(num_shapes=2, max_dims=3, min_side=0, max_side=4))
def test_any_shapes_of_distance_and_offset(shapes: BroadcastableShapes) -> None:
    numbers = np.random.default_rng(3)
    dist = numbers.uniform(100, 5000, size=shapes.input_shapes[0])
    off = numbers.uniform(-500, 500, size=shapes.input_shapes[1])
    focus = cast_rays(30, PAIR, dist, off)
    heights = cast_rays_to_focal_length(30, PAIR, dist, off, 26.0)
    assert np.shape(focus.focal_length) == np.shape(focus.focal_offset) == shapes.result_shape
    assert np.shape(heights.top) == np.shape(heights.bottom) == shapes.result_shape
    each_dist, each_off = np.broadcast_arrays(dist, off)
    for index in np.ndindex(shapes.result_shape):
        one, other = float(each_dist[index]), float(each_off[index])
        at = [np.asarray(values)[index] for values in (*focus, *heights)]
        alone = (
            *cast_rays(30, PAIR, one, other),
            *cast_rays_to_focal_length(30, PAIR, one, other, 26),
        )
        assert_allclose(at, alone, rtol=1e-14)


@settings(deadline=None)
@given(mutually_broadcastable_shapes(num_shapes=3, max_dims=3, min_side=0, max_side=4))
def test_any_shapes_of_the_plane_too(shapes: BroadcastableShapes) -> None:
    dist, off, length = (np.ones(shape) for shape in shapes.input_shapes)
    heights = cast_rays_to_focal_length(30, PAIR, dist, off, length)
    assert np.shape(heights.top) == np.shape(heights.bottom) == shapes.result_shape


def test_a_column_and_a_row_make_a_table() -> None:
    focus = cast_rays(30, PAIR, [[500.0], [2000.0], [5000.0]], [0.0, 50.0, 100.0, -100.0])
    assert focus.focal_length.shape == focus.focal_offset.shape == (3, 4)
    assert_allclose(focus.focal_length[:, 0], focus.focal_length[:, 3])
    assert_allclose(focus.focal_offset[:, 2], -focus.focal_offset[:, 3])
    focus.focal_length[0, 0] = 1.0  # each element is its own
    assert focus.focal_length[0, 1] != 1.0


@pytest.mark.parametrize("kind", [int, float, np.float64, np.float32, np.int32, np.array])
def test_single_numbers_give_floats_of_python(kind: Any) -> None:
    results = (
        *cast_rays(30, PAIR, kind(500), kind(100)),
        *cast_rays_to_focal_length(30, PAIR, kind(500), kind(100), kind(26)),
    )
    assert [type(value) for value in results] == [float] * 4
    front_focus = -PAIR.D / PAIR.C
    assert [type(value) for value in cast_rays(30, PAIR, front_focus, 1)] == [float] * 2


def test_results_have_names() -> None:
    focus = cast_rays(30, PAIR, 200, 50)
    assert (focus.focal_length, focus.focal_offset) == tuple(focus)


def test_arguments_are_not_changed() -> None:
    dist, off = np.array([500.0, -PAIR.D / PAIR.C]), np.array([0.0, 10.0])
    before = dist.copy(), off.copy()
    cast_rays(30, PAIR, dist, off)
    assert_array_equal(dist, before[0])
    assert_array_equal(off, before[1])


# --- parallel rays --------------------------------------------------------------------------


@settings(deadline=None)
@given(matrices(), offsets, st.integers(-1, 1))
def test_a_source_in_the_front_focus_leaves_parallel(
    abcd: NDArray[np.float64], off: float, steps: int
) -> None:
    (_, _), (c, d) = abcd
    assume(c != 0)
    assume(-d / c > 1e-3)
    dist = -d / c
    dist += steps * math.ulp(dist)  # the front focus as another computation may round it
    focus = cast_rays(30, abcd, dist, off)
    assert focus.focal_length == math.inf
    # the middle ray tells to which side they leave
    _, angle = abcd @ [0, -off / dist]
    assert focus.focal_offset == (math.copysign(math.inf, angle) if angle else 0)
    assert math.copysign(1, cast_rays(30, abcd, dist, 0).focal_offset) == 1  # not -0.0


@pytest.mark.parametrize("system", ["f60 pair", "f50 pair", "unequal pair, gap", "head x"])
def test_only_the_front_focus_itself_is_parallel(system: str) -> None:
    matrix = SYSTEMS[system]
    front_focus = -matrix.D / matrix.C
    for factor, sign in ((1 - 1e-12, -1), (1 + 1e-12, 1)):
        length, offset = cast_rays(30, matrix, front_focus * factor, 5)
        assert math.isfinite(length)
        assert math.isfinite(offset)
        assert sign * length > 1e9  # virtual before the front focus, real behind it


def test_one_parallel_bundle_among_others() -> None:
    front_focus = -PAIR.D / PAIR.C
    focus = cast_rays(30, PAIR, [front_focus, 2 * front_focus], [[0.0], [5.0], [-5.0]])
    assert_array_equal(focus.focal_length[:, 0], [math.inf] * 3)
    assert_array_equal(focus.focal_offset[:, 0], [0, -math.inf, math.inf])
    assert not np.signbit(focus.focal_offset[0]).any()  # no -0.0 on the axis
    alone = cast_rays(30, PAIR, 2 * front_focus, 5)
    assert_array_equal(focus.focal_length[:, 1], [alone.focal_length] * 3)
    assert_array_equal(focus.focal_offset[:, 1], [0, alone.focal_offset, -alone.focal_offset])


def test_light_from_the_front_focal_point_of_every_pair_is_parallel() -> None:
    for gap in np.linspace(0, 20, 41):
        system = telecentric_pair(gap=float(gap))
        front_focus = -system.cardinal_points("x").front_focal_point
        focus = cast_rays(30, system.matrix("x"), front_focus, 0.0)
        assert focus == (math.inf, 0.0)


# --- refusals -------------------------------------------------------------------------------

GOOD: dict[str, Any] = {
    "lens_width": 30.0,
    "lens_mat": PAIR,
    "source_dist": 2000.0,
    "axis_off": 300.0,
    "focal_length": 26.0,
}


BOTH = [cast_rays, cast_rays_to_focal_length]
ARRAYS = [(function, name) for function in BOTH for name in ("source_dist", "axis_off")]
ARRAYS += [(cast_rays_to_focal_length, "focal_length")]


def call(function: Callable[..., Any], **changed: Any) -> None:
    arguments = {**GOOD, **changed}
    if function is cast_rays:
        del arguments["focal_length"]
    function(**arguments)


@pytest.mark.parametrize(
    ("function", "name"), [*ARRAYS, *((function, "lens_width") for function in BOTH)]
)
@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_numbers_that_are_not_finite_are_refused(
    function: Callable[..., Any], name: str, bad: float
) -> None:
    with pytest.raises(ValueError, match=f"^{name} = {bad}: allowed are finite numbers"):
        call(function, **{name: bad})


@pytest.mark.parametrize(("function", "name"), ARRAYS)
@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_arrays_that_are_not_finite_are_refused(
    function: Callable[..., Any], name: str, bad: float
) -> None:
    with pytest.raises(ValueError, match=f"^{name} = {bad}: allowed are finite numbers"):
        call(function, **{name: [[1.0], [bad]]})


@pytest.mark.parametrize("function", BOTH)
@pytest.mark.parametrize("bad", [0, -0.0, -30.0])
def test_a_width_that_is_not_positive_is_refused(function: Callable[..., Any], bad: float) -> None:
    with pytest.raises(ValueError, match=rf"^lens_width = {bad:g}: allowed is > 0"):
        call(function, lens_width=bad)


@pytest.mark.parametrize("function", BOTH)
@pytest.mark.parametrize("bad", [0, -0.0, -2000.0, [1000, -1], [[0.0], [3.0]]])
def test_a_distance_that_is_not_positive_is_refused_with_a_way_out(
    function: Callable[..., Any], bad: Any
) -> None:
    with pytest.raises(ValueError, match=r"allowed is > 0; .*trans_mat") as refusal:
        call(function, source_dist=bad)
    assert str(refusal.value).startswith(f"source_dist = {np.min(bad):g}:")


@pytest.mark.parametrize("function", BOTH)
@pytest.mark.parametrize("bad", [True, "30", 1j, None, [30.0], np.array([30.0, 20.0])])
def test_a_width_that_is_not_a_number_is_refused(function: Callable[..., Any], bad: Any) -> None:
    with pytest.raises(TypeError) as refusal:
        call(function, lens_width=bad)
    assert str(refusal.value).startswith(f"lens_width = {bad!r}:")


@pytest.mark.parametrize(("function", "name"), ARRAYS)
@pytest.mark.parametrize(
    ("bad", "shown"),
    [(True, "bool"), ("30", "U2"), (1j, "complex128"), (None, "object"), ([1j, 2], "complex128")],
)
def test_what_is_not_real_numbers_is_refused(
    function: Callable[..., Any], name: str, bad: Any, shown: str
) -> None:
    with pytest.raises(TypeError, match=f"^{name}: real numbers are needed, not .*{shown}"):
        call(function, **{name: bad})


@pytest.mark.parametrize("function", BOTH)
@pytest.mark.parametrize("shape", [(), (2,), (4,), (2, 3), (3, 3), (1, 2, 2)])
def test_a_matrix_of_another_shape_is_refused(
    function: Callable[..., Any], shape: tuple[int, ...]
) -> None:
    with pytest.raises(ValueError, match=r"^lens_mat has shape \(2, 2\), not ") as refusal:
        call(function, lens_mat=np.ones(shape))
    assert str(shape) in str(refusal.value)


@pytest.mark.parametrize("function", BOTH)
@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_a_matrix_that_is_not_finite_is_refused(function: Callable[..., Any], bad: float) -> None:
    with pytest.raises(ValueError, match=f"^lens_mat = {bad}"):
        call(function, lens_mat=[[1, 0], [bad, 1]])


@pytest.mark.parametrize("function", BOTH)
@pytest.mark.parametrize("bad", [np.eye(2, dtype=bool), np.eye(2) * 1j, "lens", None])
def test_a_matrix_of_anything_but_real_numbers_is_refused(
    function: Callable[..., Any], bad: Any
) -> None:
    with pytest.raises(TypeError, match=r"^lens_mat: real numbers are needed"):
        call(function, lens_mat=bad)


@pytest.mark.parametrize("function", BOTH)
def test_shapes_that_do_not_fit_are_refused(function: Callable[..., Any]) -> None:
    with pytest.raises(ValueError, match=r"source_dist \(2,\), axis_off \(3,\).*\[:, None\]"):
        call(function, source_dist=[1.0, 2.0], axis_off=[1.0, 2.0, 3.0])


@pytest.mark.parametrize(
    ("mistake", "hint"),
    [
        (lambda: cast_rays(-30, np.eye(2), 5000, 0), "full aperture of the lens in mm"),
        (lambda: cast_rays(30, np.eye(2), -5000, 0), "the source stands in front of the lens"),
        (lambda: trans_mat(math.inf), "a distance in mm"),
        (lambda: input_vec(1, math.nan), "not in degrees"),
        (lambda: flat_mat(math.nan, 1), "a refractive index is 1 or more"),
        (lambda: refract_mat(1 / 1.52, 1, 31), "the ratio of two indices"),
        (lambda: refract_mat(1, 1.52, 0), "a plane is flat_mat"),
        (
            lambda: Lens("a", 30, 32, 31, -5.9, MATERIALS["N-BK7"]),
            "the sign of a concave lens belongs to its radius",
        ),
        (lambda: Lens("a", 30, 32, 14, 5.9, MATERIALS["N-BK7"]), "was the focal length"),
        (lambda: telecentric_pair(gap=-1), "cannot overlap"),
    ],
)
def test_refusals_name_the_likely_mistake(mistake: Callable[[], object], hint: str) -> None:
    with pytest.raises(ValueError, match=hint):
        mistake()
