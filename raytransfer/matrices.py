"""Ray transfer (ABCD) matrices in the thesis's vocabulary: chapter 3.3 and section 4.2.

A ray is a column ``(height, angle)``: height in mm above the optical axis, angle in rad (the angle
itself, not n times the angle). Light travels left to right, and the matrix that the light meets
first stands rightmost in a product. All of this is paraxial: it holds for small heights and angles.

Each function takes numbers and returns numpy, or takes at least one sympy object and returns the
matrices of `sympy.physics.optics`.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from raytransfer import _checks as check

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, DTypeLike, NDArray


_BLOCK = 65536
"""Rays multiplied at once. At some 250,000 OpenBLAS begins to pack and thread, at half the speed."""

_BLOCK_IN_PLACE = 16384
"""The same in place, where NumPy copies each block first: few enough for the copy to stay in cache."""

_PLAIN = (
    "a ray matrix * a plain 2 × 2 array: wrap the array in RayMatrix(...) if it is a matrix; "
    "if it holds two rays, use @ or propagate"
)


class RayMatrix:
    """A numeric 2 × 2 ray transfer matrix that knows the media on its two sides.

    ``*`` and ``@`` both mean the matrix product, with another matrix or with rays; numpy functions
    that work element by element refuse it. ``np.asarray(m)`` is the plain 2 × 2 array.

    Parameters
    ----------
    abcd : array_like, shape (2, 2)
        The matrix ``[[A, B], [C, D]]``; B in mm, C in 1/mm.
    n1, n2 : float, optional
        Refractive index before and after. Left out, both sides are the same unnamed medium.

    Raises
    ------
    ValueError
        If an element is not finite, or the determinant is not n1/n2 (to one part in 10⁹).
    """

    __slots__ = ("_abcd", "_n1", "_n2")

    # numpy leaves `array * matrix` to __rmul__ and refuses `np.multiply(matrix, ...)`
    __array_ufunc__ = None
    # sympy leaves `matrix * self` to __rmul__: its own priorities are about 10
    _op_priority = 20.0

    def __init__(self, abcd: ArrayLike, n1: float | None = None, n2: float | None = None) -> None:
        values = np.array(check.array("a ray matrix's element", abcd))
        if values.shape != (2, 2):
            raise ValueError(f"a ray matrix has shape (2, 2), not {values.shape}")
        if (n1 is None) != (n2 is None):
            raise ValueError(f"n1 = {n1}, n2 = {n2}: give both refractive indices or neither")
        self._n1 = None if n1 is None else check.refractive_index("n1", n1)
        self._n2 = None if n2 is None else check.refractive_index("n2", n2)
        (a, b), (c, d) = values
        size = abs(a * d) + abs(b * c)
        if not abs(a * d - b * c - self.determinant) <= 1e-9 * size < math.inf:
            raise ValueError(
                f"determinant {a * d - b * c:.9g}: a ray matrix from n1 = {self.n1} to "
                f"n2 = {self.n2} has n1/n2 = {self.determinant:.9g}; was it scaled, or do the "
                "media differ (say so with n1= and n2=)?"
            )
        values.setflags(write=False)
        self._abcd = values

    @property
    def n1(self) -> float | None:
        """Refractive index before; None for an unnamed medium."""
        return self._n1

    @property
    def n2(self) -> float | None:
        """Refractive index behind; None for an unnamed medium."""
        return self._n2

    @property
    def determinant(self) -> float:
        """The determinant n1/n2 that this matrix was checked against."""
        return 1.0 if self.n1 is None or self.n2 is None else self.n1 / self.n2

    @property
    def A(self) -> float:
        """Height out per height in; 0 if parallel light is focused on the exit plane."""
        return float(self._abcd[0, 0])

    @property
    def B(self) -> float:
        """Height out per angle in, mm; 0 if the exit plane is the image of the entrance plane."""
        return float(self._abcd[0, 1])

    @property
    def C(self) -> float:
        """Angle out per height in, 1/mm; −1/f in air, 0 for an afocal system."""
        return float(self._abcd[1, 0])

    @property
    def D(self) -> float:
        """Angle out per angle in; 0 if the entrance plane is the front focal plane."""
        return float(self._abcd[1, 1])

    def propagate(
        self, rays: ArrayLike, out: NDArray[np.float64] | None = None
    ) -> NDArray[np.float64]:
        """Send rays through: the same as ``matrix @ rays``, into `out` if it is given.

        Parameters
        ----------
        rays : array_like, shape (2, ...)
            Heights (mm) and angles (rad).
        out : ndarray, shape (2, N), optional
            Where to put the result; saves the time for new memory. With ``out=rays`` the result
            replaces the rays, which is fastest.

        Returns
        -------
        ndarray, the shape of `rays`

        Raises
        ------
        TypeError
            If `rays` does not have two rows of real numbers.
        ValueError
            If `out` has another shape.
        """
        array = np.asarray(rays)
        if array.ndim == 0 or array.shape[0] != 2 or array.dtype.kind not in "iuf":
            raise TypeError(
                f"{_shown(rays)} is neither a ray matrix nor rays of shape (2, ...); "
                "a ray matrix times a number is not a ray matrix, and rays stand to its right"
            )
        flat = array if array.ndim <= 2 else array.reshape(2, -1)
        if out is not None and out.shape != flat.shape:
            raise ValueError(f"out has shape {flat.shape}, not {out.shape}")
        if flat.size <= 2 * _BLOCK:
            result = np.matmul(self._abcd, flat, out=out)
        else:
            result = np.empty(flat.shape) if out is None else out
            if result is not array and np.may_share_memory(result, flat):
                flat = flat.copy()  # else a block could overwrite the next one's rays
            size = _BLOCK_IN_PLACE if result is array else _BLOCK
            for start in range(0, flat.shape[1], size):
                columns = slice(start, start + size)
                np.matmul(self._abcd, flat[:, columns], out=result[:, columns])
        return result if out is not None else result.reshape(array.shape)

    def __matmul__(self, other: Any) -> Any:
        """Return the product with a matrix the light met before, or with rays."""
        if check.is_symbolic(other):
            from raytransfer import symbolic  # sympy is loaded: its object came in

            return symbolic.matrix(self) * symbolic.matrix(other)
        if not isinstance(other, RayMatrix):
            return self.propagate(other)
        if None not in (self.n1, other.n2) and not math.isclose(self.n1, other.n2):  # type: ignore[arg-type]
            raise ValueError(
                f"the light leaves in n = {other.n2:g} but the next matrix begins in "
                f"n = {self.n1:g}: matrices are concatenated right to left; is one missing, "
                "in the wrong place, or are its n1 and n2 exchanged?"
            )
        n1 = self.n1 if other.n1 is None else other.n1
        n2 = other.n2 if self.n2 is None else self.n2
        return RayMatrix(self._abcd @ other._abcd, n1, n2)

    def __rmatmul__(self, other: Any) -> Any:
        """Return the product of something that stands to the left: a sympy or a plain matrix."""
        if check.is_symbolic(other):
            from raytransfer import symbolic

            return symbolic.matrix(other) * symbolic.matrix(self)
        array = np.asarray(other)
        if array.shape != (2, 2) or array.dtype.kind not in "iuf":
            raise TypeError(
                f"{_shown(other)} times a ray matrix: only a matrix can stand to its left; "
                "rays stand to its right"
            )
        return array @ self._abcd

    def __mul__(self, other: Any) -> Any:
        """Return the matrix product; a plain 2 × 2 array is refused.

        Its product would be a plain array, and a further ``*`` would multiply element by element.
        """
        if isinstance(other, np.ndarray) and other.shape == (2, 2):
            raise TypeError(_PLAIN)
        return self @ other

    def __rmul__(self, other: Any) -> Any:
        """Return the matrix product; a plain 2 × 2 array is refused."""
        if isinstance(other, np.ndarray) and other.shape == (2, 2):
            raise TypeError(_PLAIN)
        return self.__rmatmul__(other)

    def __array__(
        self,
        dtype: DTypeLike | None = None,
        copy: bool | None = None,
    ) -> NDArray[Any]:
        return np.array(self._abcd, dtype=dtype)

    def __getitem__(self, index: tuple[int, int]) -> float:
        return float(self._abcd[index])

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, RayMatrix):
            return NotImplemented
        return (
            bool((self._abcd == other._abcd).all()) and self.n1 == other.n1 and self.n2 == other.n2
        )

    def __hash__(self) -> int:
        return hash((*self._abcd.flat, self.n1, self.n2))

    def __reduce__(self) -> tuple[Any, ...]:
        return RayMatrix, (self._abcd.tolist(), self.n1, self.n2)

    def __repr__(self) -> str:
        media = "" if self.n1 is None else f", n1={self.n1:g}, n2={self.n2:g}"
        return f"RayMatrix([[{self.A:g}, {self.B:g}], [{self.C:g}, {self.D:g}]]{media})"

    def _repr_latex_(self) -> str:
        def tex(value: float) -> str:
            mantissa, e, exponent = f"{value:.6g}".partition("e")
            return f"{mantissa} \\cdot 10^{{{int(exponent)}}}" if e else mantissa

        rows = f"{tex(self.A)} & {tex(self.B)} \\\\ {tex(self.C)} & {tex(self.D)}"
        return f"$\\displaystyle \\begin{{bmatrix}}{rows}\\end{{bmatrix}}$"


def _shown(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def trans_mat(d: Any) -> Any:
    """Translation by d along the axis (equation 3.7).

    Parameters
    ----------
    d : float or sympy expression
        Distance in mm; negative distances go back to virtual foci.

    Returns
    -------
    RayMatrix, or sympy's FreeSpace

    Raises
    ------
    ValueError
        If d is not finite.
    """
    if check.is_symbolic(d):
        from raytransfer import symbolic

        return symbolic.trans_mat(d)
    return RayMatrix(
        [
            [1.0, check.number("d", d, "a distance in mm, negative toward a virtual focus")],
            [0.0, 1.0],
        ]
    )


def refract_mat(n1: Any, n2: Any, R: Any) -> Any:
    """Refraction at a curved surface (equation 3.9).

    Parameters
    ----------
    n1, n2 : float or sympy expression
        Refractive index before and after the surface.
    R : float or sympy expression
        Radius of curvature in mm, positive where the centre of curvature lies behind the surface
        (the surface bulges toward the light).

    Returns
    -------
    RayMatrix, or sympy's CurvedRefraction

    Raises
    ------
    ValueError
        If a number is not finite, an index is below 1, or R is 0.
    """
    if check.is_symbolic(n1, n2, R):
        from raytransfer import symbolic

        return symbolic.refract_mat(n1, n2, R)
    n1, n2 = check.refractive_index("n1", n1), check.refractive_index("n2", n2)
    R = check.radius("R", R)
    return RayMatrix([[1.0, 0.0], [(n1 - n2) / (R * n2), n1 / n2]], n1, n2)


def flat_mat(n1: Any, n2: Any) -> Any:
    """Refraction at a plane surface: `refract_mat` for R to infinity (equation 4.1).

    Parameters
    ----------
    n1, n2 : float or sympy expression
        Refractive index before and after the surface.

    Returns
    -------
    RayMatrix, or sympy's FlatRefraction

    Raises
    ------
    ValueError
        If an index is not finite or below 1.
    """
    if check.is_symbolic(n1, n2):
        from raytransfer import symbolic

        return symbolic.flat_mat(n1, n2)
    n1, n2 = check.refractive_index("n1", n1), check.refractive_index("n2", n2)
    return RayMatrix([[1.0, 0.0], [0.0, n1 / n2]], n1, n2)


def input_vec(offset: Any, angle: Any) -> Any:
    """A ray, or many, as a column (equation 3.6).

    Parameters
    ----------
    offset : float, array_like or sympy expression
        Distance from the optical axis in mm.
    angle : float, array_like or sympy expression
        Angle with the optical axis in rad.

    Returns
    -------
    ndarray, shape (2,) + the broadcast shape of the two, or sympy's GeometricRay

    Raises
    ------
    ValueError
        If a number is not finite.
    """
    if check.is_symbolic(offset, angle):
        from raytransfer import symbolic

        return symbolic.input_vec(offset, angle)
    pair = np.broadcast_arrays(
        check.array("offset", offset, "a height in mm"),
        check.array("angle", angle, "an angle in rad, not in degrees"),
    )
    return np.stack(pair)


def elements(lens_mat: Any) -> tuple[float, float, float, float, float]:
    """Return A, B, C, D and the determinant of a RayMatrix or a plain 2 × 2 array."""
    if not isinstance(lens_mat, RayMatrix):
        if hasattr(lens_mat, "matrix"):
            raise TypeError(
                "lens_mat: a ray matrix is needed; a lens or system has one in each meridian, "
                "so pass its .matrix('x') or .matrix('y')"
            )
        values = check.array("lens_mat", lens_mat)
        if values.shape != (2, 2):
            raise ValueError(f"lens_mat has shape (2, 2), not {values.shape}")
        (a, b), (c, d) = values.tolist()
        return a, b, c, d, a * d - b * c
    return lens_mat.A, lens_mat.B, lens_mat.C, lens_mat.D, lens_mat.determinant
