"""The thesis's matrices with symbols: sympy's types, mixed products, derivations."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
import sympy
from numpy.testing import assert_allclose
from sympy.physics.optics import (
    CurvedRefraction,
    FlatRefraction,
    FreeSpace,
    GeometricRay,
    RayTransferMatrix,
    ThinLens,
)

from raytransfer import (
    RayMatrix,
    cast_rays,
    cast_rays_to_focal_length,
    flat_mat,
    input_vec,
    refract_mat,
    telecentric_pair,
    trans_mat,
)

if TYPE_CHECKING:
    from collections.abc import Callable

n, d, p, w, t, x = sympy.symbols("n d p w t x", positive=True)
R, R1, R2, h, a = sympy.symbols("R R1 R2 h a", real=True, nonzero=True)

PAIR = telecentric_pair().matrix("x")


def is_zero(expression: Any) -> bool:
    return bool(sympy.simplify(expression) == 0)


# --- types ----------------------------------------------------------------------------------

VOCABULARY: list[tuple[Callable[..., Any], Any, tuple[float, ...]]] = [
    (trans_mat, FreeSpace, (5.9,)),
    (refract_mat, CurvedRefraction, (1.0, 1.52, 31.0)),
    (flat_mat, FlatRefraction, (1.0, 1.52)),
    (input_vec, GeometricRay, (3.0, 0.1)),
]
POSITIONS = [
    (function, kind, numbers, position)
    for function, kind, numbers in VOCABULARY
    for position in range(len(numbers))
]


@pytest.mark.parametrize(("function", "kind", "numbers", "position"), POSITIONS)
def test_one_symbol_makes_it_sympy(
    function: Callable[..., Any], kind: Any, numbers: tuple[float, ...], position: int
) -> None:
    symbol = sympy.Symbol("symbol", positive=True)
    result = function(*[symbol if i == position else v for i, v in enumerate(numbers)])
    assert type(result) is kind
    assert result.free_symbols == {symbol}
    with_number = np.array(result.subs(symbol, numbers[position]).tolist(), dtype=float)
    expected = np.asarray(function(*numbers)).reshape(with_number.shape)
    assert_allclose(with_number, expected, rtol=1e-15)


@pytest.mark.parametrize(("function", "kind", "numbers", "position"), POSITIONS)
def test_one_number_of_sympy_makes_it_sympy(
    function: Callable[..., Any], kind: Any, numbers: tuple[float, ...], position: int
) -> None:
    exact = sympy.Rational(str(numbers[position]))
    result = function(*[exact if i == position else v for i, v in enumerate(numbers)])
    assert type(result) is kind


# --- mixed products -------------------------------------------------------------------------

PLAIN = sympy.Matrix([[1, x], [0, 1]])


@pytest.mark.parametrize("other", [FreeSpace(x), PLAIN, sympy.ImmutableMatrix(PLAIN)], ids=repr)
@pytest.mark.parametrize(
    ("product", "left"),
    [
        (lambda m, s: m * s, True),
        (lambda m, s: m @ s, True),
        (lambda m, s: s * m, False),
        (lambda m, s: s @ m, False),
    ],
    ids=["m*s", "m@s", "s*m", "s@m"],
)
def test_products_of_numbers_and_symbols_are_sympy(
    other: Any, product: Callable[[Any, Any], Any], left: bool
) -> None:
    result = product(PAIR, other)
    assert isinstance(result, RayTransferMatrix)
    assert result.free_symbols == {x}
    numeric = np.array(result.subs(x, 7.25).tolist(), dtype=float)
    plain, space = np.asarray(PAIR), np.array([[1, 7.25], [0, 1]])
    assert_allclose(numeric, plain @ space if left else space @ plain, rtol=1e-12)


def test_a_matrix_sends_a_symbolic_ray_through() -> None:
    for ray in (PAIR * input_vec(h, a), PAIR @ input_vec(h, a)):
        assert ray.shape == (2, 1)
        assert is_zero(ray[0] - (PAIR.A * h + PAIR.B * a))
        assert is_zero(ray[1] - (PAIR.C * h + PAIR.D * a))


def test_symbolic_products_agree_with_numeric_ones() -> None:
    """The whole of listing 4.2 with one symbol in it."""
    symbolic = (
        flat_mat(n, 1.0)
        * trans_mat(5.9)
        * refract_mat(1.0, n, 31)
        * refract_mat(n, 1.0, -31)
        * trans_mat(5.9)
        * flat_mat(1.0, n)
    )
    assert_allclose(
        np.array(symbolic.subs(n, 1.52).tolist(), dtype=float), np.asarray(PAIR), rtol=1e-12
    )


@pytest.mark.parametrize("factor", [x, sympy.Integer(2), x + 1])
def test_a_symbol_times_a_matrix_is_refused_from_both_sides(factor: Any) -> None:
    with pytest.raises(TypeError, match="scaled ray matrix is not a ray matrix"):
        factor * PAIR
    with pytest.raises(TypeError, match="scaled ray matrix is not a ray matrix"):
        PAIR * factor


# --- derivations ----------------------------------------------------------------------------


def test_equation_3_12_two_surfaces_are_a_thin_lens() -> None:
    thin = refract_mat(n, 1, R2) * refract_mat(1, n, R1)
    one_over_f = (n - 1) * (1 / R1 - 1 / R2)  # the lensmaker's equation
    assert is_zero(thin.A - 1)
    assert is_zero(thin.B)
    assert is_zero(thin.C + one_over_f)
    assert is_zero(thin.D - 1)
    lens = ThinLens(1 / one_over_f)
    assert all(is_zero(one - other) for one, other in zip(thin, lens, strict=True))


def test_equation_3_4_a_thick_lens() -> None:
    thick = refract_mat(n, 1, R2) * trans_mat(t) * refract_mat(1, n, R1)
    one_over_f = (n - 1) * (1 / R1 - 1 / R2 + (n - 1) * t / (n * R1 * R2))
    assert is_zero(thick.C + one_over_f)
    assert is_zero(thick.det() - 1)


def test_flat_mat_is_the_limit_of_refract_mat() -> None:
    curved, flat = refract_mat(1, n, R), flat_mat(1, n)
    limits = [sympy.limit(element, R, sympy.oo) for element in curved]
    assert all(is_zero(one - other) for one, other in zip(limits, flat, strict=True))


def test_cast_rays_through_a_thin_lens_is_the_lens_equation() -> None:
    f = sympy.Symbol("f", positive=True)
    focus = cast_rays(w, ThinLens(f), d, p)
    assert is_zero(1 / focus.focal_length + 1 / d - 1 / f)
    assert is_zero(focus.focal_offset / p + focus.focal_length / d)


# --- casting --------------------------------------------------------------------------------

THICK = refract_mat(n, 1, R2) * trans_mat(t) * refract_mat(1, n, R1)
SETTINGS = np.random.default_rng(2).uniform(
    [1.3, 20, -90, 1, 300, -500], [1.9, 90, -20, 9, 9000, 500], size=(50, 6)
)


def test_symbolic_cast_rays_agrees_with_numbers() -> None:
    focus = cast_rays(w, THICK, d, p)
    function = sympy.lambdify((n, R1, R2, t, d, p), [*focus], "numpy")
    for values in SETTINGS:
        index, front, back, thickness, dist, off = values
        matrix = refract_mat(index, 1, back) * trans_mat(thickness) * refract_mat(1, index, front)
        assert_allclose(function(*values), cast_rays(30, matrix, dist, off), rtol=1e-12)


def test_symbolic_edge_rays_agree_with_numbers() -> None:
    heights = cast_rays_to_focal_length(w, THICK, d, p, x)
    function = sympy.lambdify((w, n, R1, R2, t, d, p, x), [*heights], "numpy")
    for values in SETTINGS:
        index, front, back, thickness, dist, off = values
        matrix = refract_mat(index, 1, back) * trans_mat(thickness) * refract_mat(1, index, front)
        numeric = cast_rays_to_focal_length(28.0, matrix, dist, off, 40.0)
        assert_allclose(function(28.0, *values, 40.0), numeric, rtol=1e-12, atol=1e-12 * 500)


@pytest.mark.parametrize("matrix", [PAIR, np.asarray(PAIR), sympy.Matrix(np.asarray(PAIR))])
def test_symbols_with_any_kind_of_matrix(matrix: Any) -> None:
    focus = cast_rays(30, matrix, d, p)
    numbers = {d: 2000, p: 300}
    assert_allclose(
        [float(value.subs(numbers)) for value in focus], cast_rays(30, PAIR, 2000, 300), rtol=1e-12
    )


def test_parallel_rays_meet_at_oo() -> None:
    f = sympy.Symbol("f", positive=True)
    thin = ThinLens(f)
    for off, sign in ((p, -1), (-p, 1)):  # the middle ray goes on to the other side
        focus = cast_rays(30, thin, f, off)
        assert focus.focal_length == sympy.oo
        assert focus.focal_offset == sign * sympy.oo
    assert cast_rays(30, thin, f, 0) == (sympy.oo, 0)


def test_parallel_rays_of_a_thick_lens_meet_at_oo() -> None:
    front_focus = -THICK.D / THICK.C
    assert cast_rays(30, THICK, front_focus, 0).focal_length == sympy.oo


# --- refusals -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: refract_mat(n, 0.5, R), r"n2 = 0\.5: a refractive index is 1 or more"),
        (lambda: refract_mat(0.5, n, R), r"n1 = 0\.5: a refractive index is 1 or more"),
        (lambda: refract_mat(n, 1, 0), r"R = 0: .*flat_mat"),
        (lambda: refract_mat(n, 1, sympy.oo), r"R = inf: .*flat_mat"),
        (lambda: refract_mat(n, 1, float("nan")), "R = nan"),
        (lambda: refract_mat(n, 1, sympy.I), "R = I: a real number is needed"),
        (lambda: flat_mat(n, sympy.Rational(1, 2)), r"n2 = 0\.5: a refractive index"),
        (lambda: trans_mat(sympy.oo), "d = inf: allowed are finite numbers"),
        (lambda: trans_mat(sympy.nan), "d = nan: a real number is needed"),
        (lambda: trans_mat(sympy.zoo), "d = zoo: a real number is needed"),
        (lambda: input_vec(h, float("inf")), "angle = inf"),
        (lambda: cast_rays(0, THICK, d, p), "lens_width = 0: allowed is > 0"),
        (lambda: cast_rays(30, THICK, -5, p), "source_dist = -5: allowed is > 0"),
        (lambda: cast_rays(30, THICK, 0, p), "source_dist = 0: allowed is > 0"),
        (lambda: cast_rays(30, THICK, d, sympy.oo), "axis_off = inf"),
        (lambda: cast_rays_to_focal_length(-1, THICK, d, p, x), "lens_width = -1"),
        (lambda: cast_rays_to_focal_length(30, THICK, d, p, sympy.oo), "focal_length = inf"),
    ],
)
def test_numbers_among_symbols_are_checked(call: Callable[[], Any], message: str) -> None:
    with pytest.raises(ValueError, match=f"^{message}"):
        call()


@pytest.mark.parametrize(
    ("call", "name"),
    [
        (lambda array: refract_mat(n, 1.0, array), "R"),
        (lambda array: flat_mat(n, array), "n2"),
        (lambda array: input_vec(h, array), "angle"),
        (lambda array: cast_rays(30, PAIR, d, array), "axis_off"),
        (lambda array: cast_rays(30, THICK, array, 0), "source_dist"),
        (lambda array: cast_rays_to_focal_length(30, THICK, d, p, array), "focal_length"),
    ],
)
@pytest.mark.parametrize("array", [np.array([10.0, 20.0]), [10.0, 20.0]], ids=["array", "list"])
def test_arrays_and_symbols_do_not_mix(call: Callable[[Any], Any], name: str, array: Any) -> None:
    with pytest.raises(TypeError, match=f"^{name} = .*lambdify the result"):
        call(array)


@pytest.mark.parametrize("bad", [True, None])
def test_what_is_not_a_number_is_refused_among_symbols(bad: Any) -> None:
    with pytest.raises(TypeError, match=f"n2 = {bad!r}"):
        refract_mat(n, bad, R)


@pytest.mark.parametrize("bad", ["1.52", "m"])
def test_text_is_refused_among_symbols(bad: str) -> None:
    with pytest.raises(TypeError, match="n2 = "):
        refract_mat(n, bad, R)


@pytest.mark.parametrize(
    "matrix", [sympy.Matrix([1, 2, 3, 4]), sympy.Matrix([[1, 2, 3, 4]]), sympy.eye(3), np.eye(3)]
)
def test_lens_matrices_of_another_shape_are_refused_among_symbols(matrix: Any) -> None:
    with pytest.raises(ValueError, match=r"^lens_mat .*shape \(2, 2\)"):
        cast_rays(30, matrix, d, p)


@pytest.mark.parametrize("matrix", [[[1, 0], [float("nan"), 1]], [[1, 0], [float("inf"), 1]]])
def test_lens_matrices_that_are_not_finite_are_refused_among_symbols(matrix: Any) -> None:
    for lens_mat in (matrix, sympy.Matrix(matrix)):
        with pytest.raises(ValueError, match=r"^lens_mat = "):
            cast_rays(30, lens_mat, d, p)


def test_numeric_functions_stay_numeric_when_sympy_is_loaded() -> None:
    assert type(trans_mat(5.9)) is RayMatrix
    assert type(cast_rays(30, PAIR, 2000, 300).focal_length) is float
