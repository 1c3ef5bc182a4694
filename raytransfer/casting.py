"""Where the light of a point source goes: the thesis's `cast_rays` family in closed form.

Listing 4.1 solves equations 4.2 to 4.4 anew for every source. For a system [[A, B], [C, D]] and a
source at distance d and offset p they have one solution: the ray from the source to height y on the
lens has the angle (y − p)/d, all such rays cross at the distance x = −(A d + B)/(C d + D) behind
the system, and there their height is p (A D − B C)/(C d + D). Neither depends on y, nor on the lens
width: that is what paraxial means.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from raytransfer import _checks as check
from raytransfer.matrices import elements

_VIRTUAL = (
    "the source stands in front of the lens; for light that converges toward a point "
    "behind it put trans_mat of the negative distance into lens_mat"
)


_WIDTH = "the full aperture of the lens in mm"


class Focus(NamedTuple):
    """Where the rays of a source meet: behind the system and off the axis, both in mm."""

    focal_length: Any
    focal_offset: Any


class Heights(NamedTuple):
    """Heights in mm of the rays through the upper and the lower edge of the lens."""

    top: Any
    bottom: Any


def _focus(a: Any, b: Any, det: Any, dist: Any, off: Any, vergence: Any) -> tuple[Any, Any]:
    return -(a * dist + b) / vergence, off * det / vergence


def _height(abcd: tuple[Any, ...], y: Any, angle: Any, length: Any) -> Any:
    a, b, c, d = abcd
    return (a + length * c) * y + (b + length * d) * angle


def cast_rays(lens_width: Any, lens_mat: Any, source_dist: Any, axis_off: Any) -> Focus:
    """Find the point where the light of a source is focused.

    Parameters
    ----------
    lens_width : float
        Full aperture in mm. It must be positive; the paraxial focus does not depend on it.
    lens_mat : RayMatrix, array_like of shape (2, 2), or sympy matrix
        The optical system.
    source_dist : array_like or sympy expression
        Distance from the source to the system along the axis, mm, > 0.
    axis_off : array_like or sympy expression
        Distance of the source from the axis, mm.

    Returns
    -------
    focal_length, focal_offset
        Distance in mm from the end of the system to the focus (negative: virtual), and the
        distance of the focus from the axis. Floats, arrays of the broadcast shape of
        `source_dist` and `axis_off`, or sympy expressions. Where the rays leave parallel
        (C·d + D = 0 to within rounding) both are infinite, the offset with the sign of the side
        toward which they leave, or 0 on the axis.

    Raises
    ------
    ValueError
        If a number is not finite, or a width or distance is not positive.
    """
    if check.is_symbolic(lens_width, lens_mat, source_dist, axis_off):
        return _cast_rays_symbolic(lens_width, lens_mat, source_dist, axis_off)
    check.positive("lens_width", lens_width, _WIDTH)
    a, b, c, d, det = elements(lens_mat)
    dist = check.positive_array("source_dist", source_dist, _VIRTUAL)
    off = check.array("axis_off", axis_off)
    _require_broadcast(source_dist=dist, axis_off=off)
    vergence = c * dist + d
    # c·dist and d cancel: what is left below a few rounding errors is nothing
    parallel = np.abs(vergence) <= 4 * np.finfo(float).eps * abs(d)
    with np.errstate(divide="ignore", invalid="ignore"):
        focal_length, focal_offset = _focus(a, b, det, dist, off, vergence)
    if parallel.any():
        focal_length = np.where(parallel, np.inf, focal_length)
        at_infinity = np.where(off == 0, 0.0, np.copysign(np.inf, c * off))
        focal_offset = np.where(parallel, at_infinity, focal_offset)
    focal_offset = focal_offset + 0.0  # no −0.0 on the axis
    if np.ndim(focal_offset) == 0:
        return Focus(float(focal_length), float(focal_offset))
    if focal_length.shape != focal_offset.shape:
        focal_length = np.broadcast_to(focal_length, focal_offset.shape).copy()
    return Focus(focal_length, focal_offset)


def _require_broadcast(**arrays: Any) -> None:
    try:
        np.broadcast_shapes(*(array.shape for array in arrays.values()))
    except ValueError:
        shapes = ", ".join(f"{name} {array.shape}" for name, array in arrays.items())
        raise ValueError(
            f"shapes do not broadcast: {shapes}; for a grid give one of them a further axis, "
            "as in source_dist[:, None]"
        ) from None


def _cast_rays_symbolic(lens_width: Any, lens_mat: Any, source_dist: Any, axis_off: Any) -> Focus:
    import sympy

    from raytransfer import symbolic

    symbolic.checked(check.positive, "lens_width", lens_width)
    a, b, c, d, det = symbolic.elements(lens_mat)
    dist = symbolic.checked(check.positive, "source_dist", source_dist)
    off = symbolic.checked(check.number, "axis_off", axis_off)
    vergence = c * dist + d
    if sympy.cancel(vergence) == 0:
        return Focus(sympy.oo, sympy.sign(c * off) * sympy.oo if off != 0 else sympy.Integer(0))
    return Focus(*_focus(a, b, det, dist, off, vergence))


def cast_rays_to_focal_length(
    lens_width: Any, lens_mat: Any, source_dist: Any, axis_off: Any, focal_length: Any
) -> Heights:
    """Send two rays through the edges of the lens to a plane behind it.

    Parameters
    ----------
    lens_width : float or sympy expression
        Full aperture in mm, > 0: the rays meet the lens at ± half of it.
    lens_mat, source_dist, axis_off
        As for `cast_rays`.
    focal_length : array_like or sympy expression
        Distance in mm from the end of the system to the plane; any sign.

    Returns
    -------
    top, bottom
        Heights in mm on that plane of the ray through +lens_width/2 and of the one through
        −lens_width/2. Their difference is the width of the beam.

    Raises
    ------
    ValueError
        If a number is not finite, or a width or distance is not positive.
    """
    values = (lens_width, lens_mat, source_dist, axis_off, focal_length)
    if check.is_symbolic(*values):
        from raytransfer import symbolic

        half = symbolic.checked(check.positive, "lens_width", lens_width) / 2
        abcd = symbolic.elements(lens_mat)[:4]
        dist = symbolic.checked(check.positive, "source_dist", source_dist)
        off = symbolic.checked(check.number, "axis_off", axis_off)
        length = symbolic.checked(check.number, "focal_length", focal_length)
    else:
        half = check.positive("lens_width", lens_width, _WIDTH) / 2
        abcd = elements(lens_mat)[:4]
        dist = check.positive_array("source_dist", source_dist, _VIRTUAL)
        off = check.array("axis_off", axis_off)
        length = check.array("focal_length", focal_length)
        _require_broadcast(source_dist=dist, axis_off=off, focal_length=length)
    heights = [_height(abcd, y, (y - off) / dist, length) for y in (half, -half)]
    if np.ndim(heights[0]) == 0 and not check.is_symbolic(*heights):
        heights = [float(height) for height in heights]
    return Heights(*heights)
