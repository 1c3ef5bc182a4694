"""The thesis's vocabulary in sympy, reached through `raytransfer.matrices` and `.casting`.

The matrices are those of `sympy.physics.optics`, so they can be derived with, solved and printed.
Concrete numbers among the symbols are checked as everywhere else.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import sympy
from sympy.physics.optics import (
    CurvedRefraction,
    FlatRefraction,
    FreeSpace,
    GeometricRay,
    RayTransferMatrix,
)

from raytransfer import _checks as check
from raytransfer import matrices
from raytransfer.matrices import RayMatrix

if TYPE_CHECKING:
    from collections.abc import Callable


def checked(rule: Callable[[str, Any], float], name: str, value: Any) -> Any:
    """Sympify the value; one that is a number must also pass the rule."""
    expression = None if isinstance(value, str) else sympy.sympify(value)
    if not isinstance(expression, sympy.Expr):
        raise TypeError(
            f"{name} = {value!r}: a number or an expression is needed; arrays and symbols do not "
            "mix: lambdify the result"
        )
    if expression.is_number:
        if not expression.is_extended_real:
            raise ValueError(f"{name} = {expression}: a real number is needed")
        rule(name, float(expression))
    return expression


def trans_mat(d: Any) -> FreeSpace:
    """Translation, equation 3.7."""
    return FreeSpace(checked(check.number, "d", d))


def refract_mat(n1: Any, n2: Any, R: Any) -> CurvedRefraction:
    """Refraction at a curved surface, equation 3.9."""
    index = check.refractive_index
    n1, n2 = checked(index, "n1", n1), checked(index, "n2", n2)
    return CurvedRefraction(checked(check.radius, "R", R), n1, n2)


def flat_mat(n1: Any, n2: Any) -> FlatRefraction:
    """Refraction at a plane surface, equation 4.1."""
    index = check.refractive_index
    return FlatRefraction(checked(index, "n1", n1), checked(index, "n2", n2))


def input_vec(offset: Any, angle: Any) -> GeometricRay:
    """A ray as a column, equation 3.6."""
    return GeometricRay(
        checked(check.number, "offset", offset), checked(check.number, "angle", angle)
    )


def matrix(value: Any) -> Any:
    """The value as something sympy multiplies: a ray transfer matrix, or rays as a column."""
    if isinstance(value, sympy.MatrixBase):
        if value.shape == (2, 2) and not isinstance(value, RayTransferMatrix):
            return RayTransferMatrix(*value)
        return value
    if check.is_symbolic(value):
        raise TypeError(f"{value} times a ray matrix: a scaled ray matrix is not a ray matrix")
    return RayTransferMatrix(*map(sympy.sympify, (value.A, value.B, value.C, value.D)))


def elements(lens_mat: Any) -> tuple[Any, ...]:
    """Return A, B, C, D and the determinant as sympy expressions."""
    if isinstance(lens_mat, RayMatrix):
        return tuple(sympy.sympify(value) for value in matrices.elements(lens_mat))
    array = sympy.Matrix(lens_mat)
    if array.shape != (2, 2):
        raise ValueError(f"lens_mat has shape (2, 2), not {array.shape}")
    a, b, c, d = (checked(check.number, "lens_mat", element) for element in array)
    return a, b, c, d, sympy.cancel(a * d - b * c)
