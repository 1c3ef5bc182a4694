"""The thesis's matrices with numbers: listings, products, media, rays and refusals."""

from __future__ import annotations

import copy
import math
import pickle
from functools import reduce
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from raytransfer import (
    RayMatrix,
    collimating_pair,
    flat_mat,
    input_vec,
    refract_mat,
    telecentric_pair,
    trans_mat,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

TIGHT = 1e-12
NOT_NUMBERS = [True, "5", 1j, None, [1.0], np.array([1.0, 2.0])]
NOT_FINITE = [math.nan, math.inf, -math.inf]


def lens(n: float, radius: float, thickness: float) -> RayMatrix:
    matrix: RayMatrix = flat_mat(n, 1.0) @ trans_mat(thickness) @ refract_mat(1.0, n, radius)
    return matrix


PCX = lens(1.52, 31, 5.9)


# --- the listings ---------------------------------------------------------------------------


def test_listing_4_2_runs_as_printed() -> None:
    PCX = flat_mat(1.52, 1.0) * trans_mat(5.9) * refract_mat(1.0, 1.52, 31)
    reversed_PCX = refract_mat(1.52, 1.0, -31) * trans_mat(5.9) * flat_mat(1.0, 1.52)
    pair = PCX * reversed_PCX

    power = -0.52 / (1.52 * 31)  # of air to glass at the curved side, per unit of height
    curved_in = np.array([[1, 0], [power, 1 / 1.52]])
    curved_out = np.array([[1, 0], [(1.52 - 1) / -31, 1.52]])
    plane_in = np.array([[1, 0], [0, 1 / 1.52]])
    plane_out = np.array([[1, 0], [0, 1.52]])
    glass = np.array([[1, 5.9], [0, 1]])
    expected = plane_out @ glass @ curved_in @ curved_out @ glass @ plane_in

    assert isinstance(pair, RayMatrix)
    assert_allclose(np.asarray(pair), expected, rtol=TIGHT)
    assert_allclose(np.asarray(telecentric_pair().matrix("x")), expected, rtol=TIGHT)
    assert (pair.n1, pair.n2) == (1.0, 1.0)


@pytest.mark.parametrize("plates", [True, False])
def test_listing_4_3_runs_as_printed(plates: bool) -> None:
    PCX = flat_mat(1.52, 1.0) * trans_mat(5.2) * refract_mat(1.0, 1.52, 10.3)
    PCV = flat_mat(1.52, 1.0) * trans_mat(2) * refract_mat(1.0, 1.52, -10.3)
    system = PCX * trans_mat(32) * PCV

    convex = np.array([[1, 0], [-0.52 / (1.52 * 10.3), 1 / 1.52]])
    concave = np.array([[1, 0], [0.52 / (1.52 * 10.3), 1 / 1.52]])
    plane = np.array([[1, 0], [0, 1.52]])
    expected = (
        plane
        @ np.array([[1, 5.2], [0, 1]])
        @ convex
        @ np.array([[1, 32], [0, 1]])
        @ plane
        @ np.array([[1, 2], [0, 1]])
        @ concave
    )

    assert_allclose(np.asarray(system), expected, rtol=TIGHT)
    assert_allclose(np.asarray(collimating_pair().matrix("y", plates=plates)), expected, rtol=TIGHT)


# --- the matrices themselves ----------------------------------------------------------------


def test_elements_of_each_matrix() -> None:
    assert_array_equal(np.asarray(trans_mat(5.9)), [[1, 5.9], [0, 1]])
    assert_array_equal(np.asarray(trans_mat(-5.9)), [[1, -5.9], [0, 1]])
    assert_array_equal(np.asarray(flat_mat(1.0, 1.5)), [[1, 0], [0, 1 / 1.5]])
    assert_allclose(
        np.asarray(refract_mat(1.0, 1.5, 20.0)), [[1.0, 0.0], [-0.5 / 30, 1 / 1.5]], rtol=TIGHT
    )


def snell(n1: float, n2: float, radius: float, height: float, angle: float) -> tuple[float, float]:
    """Refract a ray at a circle by Snell's law; height and angle at the vertex plane again."""
    centre = np.array([radius, 0.0])
    start, direction = np.array([0.0, height]), np.array([math.cos(angle), math.sin(angle)])
    along = direction @ (centre - start)
    # the smaller root by the form that does not cancel: the point is next to the vertex plane
    square = height**2
    root = math.sqrt(along**2 - square)
    point = start + direction * square / (along + math.copysign(root, along))
    normal = np.arcsin(point[1] / -radius)  # its angle with the axis
    out = normal + math.asin(n1 / n2 * math.sin(angle - normal))
    return float(point[1] - point[0] * math.tan(out)), float(out)


@pytest.mark.parametrize(("n1", "n2"), [(1.0, 1.52), (1.52, 1.0), (1.33, 1.7)])
@pytest.mark.parametrize("radius", [31.0, -31.0, 10.3, -500.0])
def test_refract_mat_is_snells_law_near_the_axis(n1: float, n2: float, radius: float) -> None:
    height, angle = 2e-5, -3e-6
    expected = snell(n1, n2, radius, height, angle)
    # what is neglected is of the second order in height/radius
    assert_allclose(refract_mat(n1, n2, radius) @ np.array([height, angle]), expected, rtol=1e-9)


def test_flat_mat_is_the_limit_of_a_large_radius() -> None:
    assert_allclose(
        np.asarray(refract_mat(1.0, 1.5, 1e15)), np.asarray(flat_mat(1.0, 1.5)), atol=1e-15
    )


def test_properties_and_indices_name_the_elements() -> None:
    m = RayMatrix([[1.0, 2.0], [3.0, 7.0]])
    assert (m.A, m.B, m.C, m.D) == (1.0, 2.0, 3.0, 7.0)
    assert (m[0, 0], m[0, 1], m[1, 0], m[1, 1]) == (1.0, 2.0, 3.0, 7.0)
    assert all(type(value) is float for value in (m.A, m.B, m.C, m.D, m[0, 1]))


# --- products -------------------------------------------------------------------------------

indices = st.floats(1.0, 2.5)
radii = st.floats(5.0, 1000.0) | st.floats(-1000.0, -5.0)
distances = st.floats(-100.0, 100.0).map(lambda d: round(d, 6))  # to the nanometre
angles = st.floats(-1.0, 1.0).map(lambda angle: round(angle, 9))


@st.composite
def chains(draw: st.DrawFn) -> tuple[list[RayMatrix], float, float]:
    """Surfaces and gaps in the order in which the light meets them, first and last index."""
    media = draw(st.lists(indices, min_size=2, max_size=6))
    parts: list[RayMatrix] = []
    for before, after in pairwise(media):
        flat = draw(st.booleans())
        parts.append(flat_mat(before, after) if flat else refract_mat(before, after, draw(radii)))
        parts.append(trans_mat(draw(distances)))
    return parts, media[0], media[-1]


@settings(deadline=None)
@given(chains())
def test_products_multiply_and_keep_the_determinant_n1_over_n2(
    chain: tuple[list[RayMatrix], float, float],
) -> None:
    parts, first, last = chain
    product = reduce(lambda before, part: part @ before, parts)
    plain = reduce(lambda before, part: np.asarray(part) @ before, parts[1:], np.asarray(parts[0]))
    scale = np.abs(plain).max()
    assert_allclose(np.asarray(product), plain, rtol=0, atol=TIGHT * scale)
    assert (product.n1, product.n2) == (first, last)
    assert product.determinant == first / last
    a, b, c, d = np.asarray(product).flat
    assert a * d - b * c == pytest.approx(
        first / last, rel=TIGHT, abs=TIGHT * (abs(a * d) + abs(b * c))
    )


@settings(deadline=None)
@given(chains(), distances, angles)
def test_star_and_at_are_the_same(
    chain: tuple[list[RayMatrix], float, float], height: float, angle: float
) -> None:
    parts = chain[0]
    by_star = reduce(lambda before, part: part * before, parts)
    by_at = reduce(lambda before, part: part @ before, parts)
    assert by_star == by_at
    ray = input_vec(height, angle)
    assert_array_equal(by_star * ray, by_at @ ray)
    one_by_one = reduce(lambda at, part: part @ at, parts, ray)
    size = reduce(lambda at, part: np.abs(np.asarray(part)) @ at, parts, np.abs(ray))
    assert_allclose(by_at @ ray, one_by_one, rtol=0, atol=TIGHT * size.max())


def test_order_is_right_to_left() -> None:
    first, then = refract_mat(1.0, 1.52, 31), trans_mat(5.9)
    assert_allclose(
        np.asarray(then * first), [[1 - 5.9 * 0.52 / 47.12, 5.9 / 1.52], [first.C, 1 / 1.52]]
    )
    assert then * first != first * then


def test_a_translation_takes_on_the_media_beside_it() -> None:
    into_glass = trans_mat(5.9) * refract_mat(1.0, 1.52, 31)
    assert (into_glass.n1, into_glass.n2) == (1.0, 1.52)
    from_air = refract_mat(1.0, 1.52, 31) * trans_mat(100)
    assert (from_air.n1, from_air.n2) == (1.0, 1.52)
    nowhere = trans_mat(1) * trans_mat(2)
    assert (nowhere.n1, nowhere.n2, nowhere.B) == (None, None, 3.0)


def test_media_that_do_not_meet_are_refused() -> None:
    into_flint, out_of_crown = flat_mat(1.0, 1.7), flat_mat(1.52, 1.0)
    with pytest.raises(
        ValueError, match=r"leaves in n = 1\.7 .* begins in n = 1\.52.*right to lef"
    ):
        out_of_crown * trans_mat(5) * into_flint
    with pytest.raises(ValueError, match="right to left"):  # listing 4.2 with its ends exchanged
        refract_mat(1.0, 1.52, 31) * trans_mat(5.9) * flat_mat(1.52, 1.0) * flat_mat(1.52, 1.0)


def test_media_may_differ_by_rounding_only() -> None:
    n = math.nextafter(1.52, 2)
    assert (flat_mat(n, 1.0) * flat_mat(1.0, 1.52)).determinant == 1.0


# --- the determinant ------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("abcd", "media"),
    [
        (2 * np.eye(2), {}),
        (np.zeros((2, 2)), {}),
        ([[1, 0], [0, -1]], {}),
        ([[1, 0], [0, 1 / 1.52]], {}),
        ([[1, 0], [0, 1 / 1.52]], {"n1": 1.52, "n2": 1.0}),
        ([[1, 0], [0, 1]], {"n1": 1.0, "n2": 1.52}),
        ([[1 + 1e-8, 5.9], [0, 1]], {}),
    ],
)
def test_wrong_determinants_are_refused(abcd: Any, media: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=r"^determinant .* n1/n2 = "):
        RayMatrix(abcd, **media)


def test_a_determinant_beyond_floating_point_is_refused() -> None:
    with np.errstate(over="ignore"), pytest.raises(ValueError, match="determinant"):
        RayMatrix([[1e200, 0], [0, 1e200]])


def test_right_determinants_are_accepted() -> None:
    assert RayMatrix([[1.0, 0.0], [0.0, 1 / 1.52]], n1=1.0, n2=1.52).determinant == 1 / 1.52
    assert RayMatrix([[1 + 1e-10, 5.9], [0.0, 1.0]]).A == 1 + 1e-10
    assert RayMatrix([[0.0, 60.0], [-1 / 60, 0.0]]).determinant == 1.0


@pytest.mark.parametrize("media", [{"n1": 1.0}, {"n2": 1.52}])
def test_one_index_alone_is_refused(media: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=r"n1 = .*, n2 = .*: give both"):
        RayMatrix(np.eye(2), **media)


@pytest.mark.parametrize("name", ["n1", "n2"])
@pytest.mark.parametrize("bad", [0.5, math.nan, math.inf])
def test_matrix_indices_are_checked(name: str, bad: float) -> None:
    with pytest.raises(ValueError, match=f"{name} = {bad:g}"):
        RayMatrix(np.eye(2), **{"n1": 1.0, "n2": 1.0, name: bad})


@pytest.mark.parametrize("shape", [(), (2,), (4,), (1, 2), (3, 3), (2, 2, 2)])
def test_matrices_of_another_shape_are_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match=r"shape \(2, 2\), not ") as refusal:
        RayMatrix(np.ones(shape))
    assert str(shape) in str(refusal.value)


@pytest.mark.parametrize("bad", NOT_FINITE)
def test_matrices_with_elements_that_are_not_finite_are_refused(bad: float) -> None:
    with pytest.raises(ValueError, match=f"element = {bad}"):
        RayMatrix([[1.0, bad], [0.0, 1.0]])


@pytest.mark.parametrize(
    "abcd", [np.eye(2, dtype=bool), np.eye(2, dtype=complex), [["1", "0"], ["0", "1"]], None]
)
def test_matrices_of_anything_but_real_numbers_are_refused(abcd: Any) -> None:
    with pytest.raises(TypeError, match="element: real numbers are needed, not"):
        RayMatrix(abcd)


# --- numpy ----------------------------------------------------------------------------------


def test_asarray_is_a_plain_copy() -> None:
    m = trans_mat(5.9)
    array = np.asarray(m)
    assert type(array) is np.ndarray
    assert array.shape == (2, 2)
    assert array.dtype == np.float64
    array[0, 1] = 99
    assert m.B == 5.9
    assert_array_equal(np.asarray(m), [[1, 5.9], [0, 1]])
    assert np.asarray(m, dtype=np.float32).dtype == np.float32


def test_the_array_a_matrix_was_made_from_may_change_afterwards() -> None:
    abcd = np.array([[1, 5.9], [0, 1]])
    m = RayMatrix(abcd)
    abcd[0, 1] = 99
    assert m.B == 5.9


@pytest.mark.parametrize(
    "operation",
    [
        lambda m: np.multiply(m, m),
        lambda m: np.multiply(np.eye(2), m),
        lambda m: np.multiply(m, 2.0),
        lambda m: np.add(m, m),
        lambda m: np.sin(m),
        lambda m: m + m,
        lambda m: m - m,
        lambda m: m / 2,
        lambda m: m**2,
        lambda m: -m,
        lambda m: m + np.eye(2),
        lambda m: np.eye(2) + m,
    ],
)
def test_nothing_works_element_by_element(operation: Callable[[RayMatrix], Any]) -> None:
    with pytest.raises(TypeError):
        operation(PCX)


@pytest.mark.parametrize("factor", [2, 2.0, np.float64(2), np.array(2.0), True, "2", None, 1j])
def test_a_number_times_a_matrix_is_refused_from_both_sides(factor: Any) -> None:
    with pytest.raises(TypeError, match="ray matrix"):
        factor * PCX
    with pytest.raises(TypeError, match="ray matrix"):
        PCX * factor
    with pytest.raises(TypeError, match="ray matrix"):
        PCX @ factor


def test_an_array_to_the_left_is_multiplied_as_a_matrix() -> None:
    array = np.array([[1.0, 2.0], [3.0, 4.0]])
    expected = [
        [array[0] @ np.asarray(PCX)[:, 0], array[0] @ np.asarray(PCX)[:, 1]],
        [array[1] @ np.asarray(PCX)[:, 0], array[1] @ np.asarray(PCX)[:, 1]],
    ]
    assert_allclose(array @ PCX, expected, rtol=TIGHT)


def test_a_plain_array_cannot_begin_an_elementwise_product() -> None:
    """Of matrix * array only an array would be left, and * with the next one elementwise."""
    array = np.array([[1.0, 5.0], [0.0, 1.0]])
    for product in (lambda: PCX * array, lambda: array * PCX, lambda: PCX * array * array):
        with pytest.raises(TypeError, match=r"wrap the array in RayMatrix"):
            product()
    wrapped = PCX * RayMatrix(array) * RayMatrix(array)
    assert_allclose(np.asarray(wrapped), np.asarray(PCX) @ array @ array, rtol=TIGHT)


@pytest.mark.parametrize(
    "array", [np.array([1, 2]), np.ones((1, 2)), np.ones((3, 2)), np.ones((2, 2, 2)), np.eye(3)]
)
def test_no_other_array_can_stand_to_the_left(array: NDArray[np.float64]) -> None:
    with pytest.raises(TypeError, match="rays stand to its right"):
        array * PCX
    with pytest.raises(TypeError, match="rays stand to its right"):
        array @ PCX


# --- rays -----------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", [(2,), (2, 1), (2, 5), (2, 0), (2, 3, 4), (2, 0, 3)])
def test_rays_of_any_shape_go_through(shape: tuple[int, ...]) -> None:
    rays = np.random.default_rng(1).normal(size=shape)
    result = PCX @ rays
    assert result.shape == shape
    assert_allclose(result[0], PCX.A * rays[0] + PCX.B * rays[1], rtol=TIGHT)
    assert_allclose(result[1], PCX.C * rays[0] + PCX.D * rays[1], rtol=TIGHT)
    assert_array_equal(PCX.propagate(rays), result)


MANY = [1, 3, 65_536, 131_072, 200_001]  # many are sent through in blocks


@pytest.mark.parametrize("count", MANY)
def test_however_many_rays_each_goes_its_way(count: int) -> None:
    height, angle = rays = np.random.default_rng(5).normal(size=(2, count))
    expected = [PCX.A * height + PCX.B * angle, PCX.C * height + PCX.D * angle]
    assert_allclose(PCX @ rays, expected, rtol=TIGHT, atol=1e-14)
    assert_array_equal(PCX @ rays.reshape(2, count, 1), (PCX @ rays).reshape(2, count, 1))
    assert_array_equal(PCX @ rays[:, ::-1], (PCX @ rays)[:, ::-1])


@pytest.mark.parametrize("count", MANY)
def test_propagate_writes_into_out(count: int) -> None:
    rays = np.random.default_rng(5).normal(size=(2, count))
    expected, out = PCX @ rays, np.empty_like(rays)
    assert PCX.propagate(rays, out=out) is out
    assert_array_equal(out, expected)
    assert PCX.propagate(rays, out=rays) is rays  # in place
    assert_array_equal(rays, expected)


@pytest.mark.parametrize("count", MANY)
def test_out_may_overlap_the_rays(count: int) -> None:
    memory = np.random.default_rng(5).normal(size=(2, count + 1))
    expected = PCX @ memory[:, :-1].copy()
    PCX.propagate(memory[:, :-1], out=memory[:, 1:])
    assert_array_equal(memory[:, 1:], expected)


@pytest.mark.parametrize("count", MANY)
@pytest.mark.parametrize(("rows", "more"), [(2, 1), (2, -1), (3, 0), (1, 0)])
def test_an_out_of_another_shape_is_refused(count: int, rows: int, more: int) -> None:
    with pytest.raises(ValueError, match=r"(?i)\bout"):
        PCX.propagate(np.ones((2, count)), out=np.empty((rows, count + more)))


@pytest.mark.parametrize(
    "rays",
    [[1, 2, 3], np.ones((3, 2)), 5.0, [True, False], ["1", "2"], [1j, 2], []],
)
def test_what_is_not_rays_is_refused(rays: Any) -> None:
    with pytest.raises(TypeError, match=r"rays of shape \(2, \.\.\.\)"):
        PCX.propagate(rays)
    with pytest.raises(TypeError, match=r"rays of shape \(2, \.\.\.\)"):
        PCX @ rays


def test_input_vec_is_a_column_of_height_and_angle() -> None:
    assert_array_equal(input_vec(3, 0.1), [3, 0.1])
    assert_array_equal(input_vec([1, 2, 3], 0.1), [[1, 2, 3], [0.1, 0.1, 0.1]])
    assert input_vec(np.zeros((3, 1)), np.zeros(4)).shape == (2, 3, 4)
    assert_array_equal(trans_mat(10) * input_vec(3, 0.1), [4, 0.1])


@pytest.mark.parametrize("name", ["offset", "angle"])
@pytest.mark.parametrize("bad", NOT_FINITE)
def test_rays_that_are_not_finite_are_refused(name: str, bad: float) -> None:
    for value in (bad, [0.0, bad]):
        with pytest.raises(ValueError, match=f"{name} = {bad}"):
            input_vec(**{"offset": 1.0, "angle": 0.1, name: value})


@pytest.mark.parametrize("name", ["offset", "angle"])
@pytest.mark.parametrize(("bad", "shown"), [(True, "bool"), ("5", "U1"), (1j, "complex128")])
def test_rays_that_are_not_numbers_are_refused(name: str, bad: Any, shown: str) -> None:
    with pytest.raises(TypeError, match=f"{name}: real numbers are needed, not .*{shown}"):
        input_vec(**{"offset": 1.0, "angle": 0.1, name: bad})


def test_rays_whose_shapes_do_not_fit_are_refused() -> None:
    with pytest.raises(ValueError, match=r"\(2,\).*\(3,\)"):
        input_vec([1, 2], [1, 2, 3])


# --- arguments ------------------------------------------------------------------------------

GOOD: dict[str, dict[str, Any]] = {
    "trans_mat": {"d": 5.9},
    "refract_mat": {"n1": 1.0, "n2": 1.52, "R": 31},
    "flat_mat": {"n1": 1.52, "n2": 1.0},
}
FUNCTIONS: dict[str, Callable[..., Any]] = {
    "trans_mat": trans_mat,
    "refract_mat": refract_mat,
    "flat_mat": flat_mat,
}
ARGUMENTS = [(function, name) for function, names in GOOD.items() for name in names]


@pytest.mark.parametrize(("function", "name"), ARGUMENTS)
@pytest.mark.parametrize("bad", NOT_FINITE)
def test_arguments_that_are_not_finite_are_refused(function: str, name: str, bad: float) -> None:
    with pytest.raises(ValueError, match=f"^{name} = {bad}: allowed are finite numbers"):
        FUNCTIONS[function](**{**GOOD[function], name: bad})


@pytest.mark.parametrize(("function", "name"), ARGUMENTS)
@pytest.mark.parametrize("bad", NOT_NUMBERS, ids=repr)
def test_arguments_that_are_not_real_numbers_are_refused(
    function: str, name: str, bad: Any
) -> None:
    with pytest.raises(TypeError) as refusal:
        FUNCTIONS[function](**{**GOOD[function], name: bad})
    assert str(refusal.value).startswith(f"{name} = {bad!r}: a single real number is needed")


@pytest.mark.parametrize("function", ["refract_mat", "flat_mat"])
@pytest.mark.parametrize("name", ["n1", "n2"])
@pytest.mark.parametrize("bad", [0.999999, 0, -1.52, 1 / 1.52])
def test_indices_below_1_are_refused(function: str, name: str, bad: float) -> None:
    with pytest.raises(ValueError, match=r"a refractive index is 1 or more.*ratio") as refusal:
        FUNCTIONS[function](**{**GOOD[function], name: bad})
    assert str(refusal.value).startswith(f"{name} = {bad:g}:")


@pytest.mark.parametrize("bad", [0, 0.0, -0.0])
def test_radius_0_is_refused_and_pointed_to_flat_mat(bad: float) -> None:
    with pytest.raises(ValueError, match=r"^R = 0: .*flat_mat"):
        refract_mat(1.0, 1.52, bad)
    with pytest.raises(ValueError, match=r"^R = inf: .*flat_mat"):
        refract_mat(1.0, 1.52, math.inf)


@pytest.mark.parametrize("number", [5, np.int64(5), np.float32(5), np.array(5.0)])
def test_every_kind_of_real_number_is_accepted(number: Any) -> None:
    assert trans_mat(number) == trans_mat(5.0)
    assert refract_mat(1, 2, number) == refract_mat(1.0, 2.0, 5.0)


# --- as an object ---------------------------------------------------------------------------


@pytest.mark.parametrize("m", [trans_mat(5.9), refract_mat(1.0, 1.52, 31), PCX])
def test_pickles_and_copies_are_equal(m: RayMatrix) -> None:
    for other in (pickle.loads(pickle.dumps(m)), copy.copy(m), copy.deepcopy(m)):  # noqa: S301
        assert other == m
        assert hash(other) == hash(m)
        assert (other.n1, other.n2) == (m.n1, m.n2)


def test_equality_is_of_elements_and_media() -> None:
    assert trans_mat(5.9) == RayMatrix([[1.0, 5.9], [0.0, 1.0]])
    assert trans_mat(5.9) != trans_mat(5.9 + 1e-15)
    assert RayMatrix(np.eye(2), 1.0, 1.0) != RayMatrix(np.eye(2), 1.5, 1.5)
    assert RayMatrix(np.eye(2), 1.0, 1.0) != RayMatrix(np.eye(2))
    assert trans_mat(5.9) != 5.9
    assert len({trans_mat(5.9), trans_mat(5.9), trans_mat(6)}) == 2


def test_elements_cannot_be_assigned() -> None:
    m: Any = trans_mat(5.9)
    with pytest.raises(AttributeError):
        m.B = 3.0
    with pytest.raises(TypeError):
        m[0, 1] = 3.0


def test_repr_shows_elements_and_media() -> None:
    assert repr(trans_mat(5.9)) == "RayMatrix([[1, 5.9], [0, 1]])"
    assert repr(flat_mat(1.6, 1.0)) == "RayMatrix([[1, 0], [0, 1.6]], n1=1.6, n2=1)"


def test_latex() -> None:
    assert trans_mat(5.9)._repr_latex_() == (
        r"$\displaystyle \begin{bmatrix}1 & 5.9 \\ 0 & 1\end{bmatrix}$"
    )
    assert RayMatrix([[1.0, 2.5e-7], [0.0, 1.0]])._repr_latex_() == (
        r"$\displaystyle \begin{bmatrix}1 & 2.5 \cdot 10^{-7} \\ 0 & 1\end{bmatrix}$"
    )


@pytest.mark.parametrize("count", [1, 5, 16384, 16385, 40_000])
def test_many_rays_are_the_same_as_few(count: int) -> None:
    """However propagate divides them: into new memory, into `out`, in place, or overlapping."""
    matrix = RayMatrix([[0.87, 7.26], [(0.87 * 0.87 - 1) / 7.26, 0.87]])
    rays = np.random.default_rng(count).normal(size=(2, count))
    expected = np.asarray(matrix) @ rays
    assert_allclose(matrix @ rays, expected, rtol=1e-12, atol=1e-15)
    out = np.empty_like(rays)
    assert matrix.propagate(rays, out=out) is out
    assert_allclose(out, expected, rtol=1e-12, atol=1e-15)
    in_place = rays.copy()
    assert matrix.propagate(in_place, out=in_place) is in_place
    assert_allclose(in_place, expected, rtol=1e-12, atol=1e-15)
    shifted = np.concatenate([rays, np.zeros((2, 7))], axis=1)
    matrix.propagate(shifted[:, :count], out=shifted[:, 7:])
    assert_allclose(shifted[:, 7:], expected, rtol=1e-12, atol=1e-15)
    assert_allclose(
        matrix @ rays.reshape(2, 1, count), expected[:, None, :], rtol=1e-12, atol=1e-15
    )
