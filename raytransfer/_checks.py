"""Checks at the edges: every refusal names the value, its range and the likely mistake."""

from __future__ import annotations

import math
import sys
from numbers import Integral, Real
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray


def is_symbolic(*values: object) -> bool:
    """Whether any of the values is a sympy object (never imports sympy to find out)."""
    sympy = sys.modules.get("sympy")
    return sympy is not None and any(
        isinstance(value, (sympy.Basic, sympy.MatrixBase)) for value in values
    )


def number(name: str, value: Any, hint: str = "") -> float:
    """Return the value as a finite float, or refuse it."""
    if isinstance(value, np.ndarray) and value.ndim == 0:
        value = value[()]
    if isinstance(value, bool | np.bool_) or not isinstance(value, Real):
        raise TypeError(f"{name} = {value!r}: a single real number is needed{_because(hint)}")
    try:
        result = float(value)
    except OverflowError:
        raise ValueError(
            f"{name} is a whole number beyond all floating-point ones{_because(hint)}"
        ) from None
    if not math.isfinite(result):
        raise ValueError(f"{name} = {value}: allowed are finite numbers{_because(hint)}")
    return result


def positive(name: str, value: Any, hint: str = "") -> float:
    """Return the value as a finite float above 0, or refuse it."""
    result = number(name, value, hint)
    if result <= 0:
        raise ValueError(f"{name} = {result:g}: allowed is > 0{_because(hint)}")
    return result


def not_negative(name: str, value: Any, hint: str = "") -> float:
    """Return the value as a finite float, 0 or above, or refuse it."""
    result = number(name, value, hint)
    if result < 0:
        raise ValueError(f"{name} = {result:g}: allowed is >= 0{_because(hint)}")
    return result


def angle(name: str, value: Any) -> float:
    """Return value as a float; refuse what is more than one turn."""
    turned = number(name, value, "rad")
    if abs(turned) > math.tau:
        raise ValueError(
            f"{name} = {turned:g} rad: allowed are −2π to 2π; was it given in degrees?"
        )
    return turned


def whole(name: str, value: Any) -> int:
    """Return the value as an integer, 1 or above, or refuse it."""
    if isinstance(value, bool) or not isinstance(value, Real):
        raise TypeError(f"{name} = {value!r}: a whole number is needed")
    if not isinstance(value, Integral) or value < 1:
        raise ValueError(f"{name} = {value}: allowed are whole numbers from 1 on")
    return int(value)


def refractive_index(name: str, value: Any) -> float:
    """Return the value as a refractive index, or refuse it."""
    result = number(name, value, "a refractive index is 1 or more")
    if result < 1:
        raise ValueError(
            f"{name} = {result:g}: a refractive index is 1 or more; "
            "was the ratio of two indices given, or are the arguments in another order?"
        )
    return result


def radius(name: str, value: Any) -> float:
    """Return the value as a radius of curvature, or refuse it."""
    result = number(name, value, "a plane is flat_mat(n1, n2)")
    if result == 0:
        raise ValueError(
            f"{name} = 0: allowed is any radius but 0, positive where the centre of curvature "
            "lies behind the surface; a plane is flat_mat(n1, n2), not R = 0"
        )
    return result


def numbers(name: str, values: ArrayLike) -> NDArray[np.float64]:
    """Return the values as an array of floats, or refuse what are no real numbers."""
    result = np.asarray(values)
    if result.dtype.kind not in "iuf":
        raise TypeError(f"{name}: real numbers are needed, not {result.dtype}")
    return result.astype(np.float64, copy=False)


def array(name: str, values: ArrayLike, hint: str = "") -> NDArray[np.float64]:
    """Return the values as an array of finite floats, or refuse them."""
    result = numbers(name, values)
    if not np.isfinite(result).all():
        first = result[~np.isfinite(result)].flat[0]
        raise ValueError(f"{name} = {first}: allowed are finite numbers{_because(hint)}")
    return result


def positive_array(name: str, values: ArrayLike, hint: str = "") -> NDArray[np.float64]:
    """Return the values as an array of finite floats above 0, or refuse them."""
    result = array(name, values, hint)
    if result.size and result.min() <= 0:
        raise ValueError(f"{name} = {result.min():g}: allowed is > 0{_because(hint)}")
    return result


def _because(hint: str) -> str:
    return f"; {hint}" if hint else ""
