"""Plano-cylindrical lenses and plane plates, and the catalogue they are bought from.

`CATALOGUE` maps part numbers to lenses as the maker lists them, `THESIS_LENSES` the thesis's names
to the rounded values of its listings. Both are read from ``data/lenses.toml``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any, Literal, Self

from raytransfer import _checks as check
from raytransfer._data import FOLDER, read
from raytransfer.materials import D_LINE, MATERIALS, Material
from raytransfer.matrices import RayMatrix, flat_mat, refract_mat, trans_mat

Meridian = Literal["x", "y"]
"""The plane of a paraxial ray: x holds the sensor's pixel line, y is across it."""


def check_meridian(name: str, value: str) -> None:
    """Refuse anything but the two meridians."""
    if value not in ("x", "y"):
        raise ValueError(
            f"{name} = {value!r}: allowed are 'x' (along the pixel line) and 'y' (across it)"
        )


def check_material(part: str, material: Material) -> None:
    """Refuse anything but a material."""
    if not isinstance(material, Material):
        raise TypeError(
            f"material of {part} = {material!r}: take one of MATERIALS, or ConstantIndex(name, n)"
        )


@dataclass(frozen=True)
class Plate:
    """A plane plate, such as the window over a sensor.

    Parameters
    ----------
    part : str
        Part number or name.
    thickness : float
        mm, > 0.
    material : Material
    """

    part: str
    thickness: float
    material: Material

    def __post_init__(self) -> None:
        check.positive(f"thickness of {self.part}", self.thickness, "a size in mm")
        check_material(self.part, self.material)

    def matrix(
        self, meridian: Meridian, *, plates: bool = True, wavelength: float = D_LINE
    ) -> RayMatrix:
        """Matrix in either meridian; with ``plates=False`` that of as much air."""
        check_meridian("meridian", meridian)
        return _plate(self.thickness, self.material.index(wavelength) if plates else None)


@dataclass(frozen=True)
class Lens:
    """A plano-convex or plano-concave cylindrical lens.

    Parameters
    ----------
    part : str
        Part number or name.
    height, length : float
        Size across and along the axis of the cylinder, mm.
    radius : float
        Radius of curvature in mm: > 0 plano-convex, < 0 plano-concave.
    centre_thickness : float
        Thickness on the optical axis, mm.
    material : Material
    bends : {"x", "y"}
        The meridian in which the lens has power.
    reversed : bool
        False: the curved side meets the light first. True: the plane side does.

    Raises
    ------
    ValueError
        If a size is not positive, the radius is shorter than half the height, or a convex lens is
        too thin for its edge to exist.
    """

    part: str
    height: float
    length: float
    radius: float
    centre_thickness: float
    material: Material
    bends: Meridian = "x"
    reversed: bool = False

    def __post_init__(self) -> None:
        for name in ("height", "length"):
            check.positive(f"{name} of {self.part}", getattr(self, name), "a size in mm")
        check.positive(
            f"centre_thickness of {self.part}",
            self.centre_thickness,
            "the sign of a concave lens belongs to its radius",
        )
        check_material(self.part, self.material)
        check.radius(f"radius of {self.part}", self.radius)
        check_meridian("bends", self.bends)
        if abs(self.radius) < self.height / 2:
            raise ValueError(
                f"radius of {self.part} = {self.radius:g} mm: |radius| is at least half the height "
                f"({self.height / 2:g} mm); was the focal length or the diameter meant?"
            )
        if self.edge_thickness < 0:
            raise ValueError(
                f"centre_thickness of {self.part} = {self.centre_thickness:g} mm: the curved side "
                f"is {self.sag(self.height / 2):.4g} mm deep, the edge would be "
                f"{self.edge_thickness:.4g} mm thick; was the edge thickness given?"
            )

    @property
    def thickness(self) -> float:
        """Thickness on the optical axis, mm."""
        return self.centre_thickness

    @property
    def edge_thickness(self) -> float:
        """Thickness at the upper and lower edge, mm."""
        return self.centre_thickness - self.sag(self.height / 2)

    def sag(self, y: float) -> float:
        """Depth in mm of the curved side at y mm from the axis; negative where it is hollow."""
        return math.copysign(abs(self.radius) - math.sqrt(self.radius**2 - y**2), self.radius)

    def size(self, meridian: Meridian) -> float:
        """Full aperture in one meridian, mm."""
        check_meridian("meridian", meridian)
        return self.height if meridian == self.bends else self.length

    def focal_length(self, wavelength: float = D_LINE) -> float:
        """Effective focal length of the lens alone, in mm: R/(n − 1)."""
        return self.radius / (self.material.index(wavelength) - 1)

    def turned(self) -> Self:
        """Return the lens with its other side to the light."""
        return replace(self, reversed=not self.reversed)

    def bending(self, meridian: Meridian) -> Self:
        """Return the lens rotated about the optical axis so that it bends the given meridian."""
        return replace(self, bends=meridian)

    def matrix(
        self, meridian: Meridian, *, plates: bool = True, wavelength: float = D_LINE
    ) -> RayMatrix:
        """Matrix from the first vertex to the second, air to air.

        In the meridian that it does not bend a lens is a plane plate of glass. The thesis leaves
        these plates out: ``plates=False`` puts as much air there.
        """
        check_meridian("meridian", meridian)
        n = self.material.index(wavelength)
        if meridian != self.bends:
            return _plate(self.centre_thickness, n if plates else None)
        glass = trans_mat(self.centre_thickness)
        matrix: RayMatrix
        if self.reversed:
            matrix = refract_mat(n, 1.0, -self.radius) @ glass @ flat_mat(1.0, n)
        else:
            matrix = flat_mat(n, 1.0) @ glass @ refract_mat(1.0, n, self.radius)
        return matrix


Element = Lens | Plate


def _plate(thickness: float, n: float | None) -> RayMatrix:
    matrix: RayMatrix = trans_mat(thickness)
    if n is not None:
        matrix = flat_mat(n, 1.0) @ matrix @ flat_mat(1.0, n)
    return matrix


def _lens(part: str, entry: dict[str, Any]) -> Lens:
    sizes = ("height", "length", "radius", "centre_thickness")
    known = {*sizes, "material", "focal_length", "edge_thickness"}
    if wrong := known ^ set(entry):
        raise ValueError(f"lenses.toml, {part}: missing or unknown: {', '.join(sorted(wrong))}")
    if entry["material"] not in MATERIALS:
        raise ValueError(
            f"lenses.toml, {part}: material {entry['material']!r}; known are {', '.join(MATERIALS)}"
        )
    material = MATERIALS[entry["material"]]
    return Lens(part, material=material, **{size: entry[size] for size in sizes})


def _lenses(table: str) -> MappingProxyType[str, Lens]:
    entries = read(FOLDER / "lenses.toml")[table]
    return MappingProxyType({part: _lens(part, entry) for part, entry in entries.items()})


CATALOGUE = _lenses("catalogue")
"""Stock lenses by part number, curved side to the light, bending x."""

THESIS_LENSES = _lenses("thesis")
"""The lenses of the thesis's listings, with its rounded values and its index of 1.52."""
