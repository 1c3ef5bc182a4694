"""Lenses, plates and screens, and the catalogue of plano-cylindrical lenses.

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
from raytransfer.surfaces import Surface

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

    def size(self, meridian: Meridian) -> float:
        """Size in one meridian: no edge is known."""
        check_meridian("meridian", meridian)
        return math.inf

    aperture = size

    def surfaces(self) -> tuple[Surface, ...]:
        """Front and back."""
        return Surface(material=self.material), Surface(z=self.thickness)

    def turned(self) -> Self:
        """Return the plate: both sides are alike."""
        return self


@dataclass(frozen=True)
class Aperture:
    """A thin opaque screen with a rectangular opening, such as a slit.

    Parameters
    ----------
    part : str
        Name.
    x, y : float
        Full widths of the opening, mm, > 0; infinite where it has no edge.
    """

    part: str
    x: float = math.inf
    y: float = math.inf

    def __post_init__(self) -> None:
        for name in ("x", "y"):
            if getattr(self, name) != math.inf:
                check.positive(f"{name} of {self.part}", getattr(self, name), "a full width in mm")

    @property
    def thickness(self) -> float:
        """Of the screen: 0."""
        return 0.0

    def matrix(
        self, meridian: Meridian, *, plates: bool = True, wavelength: float = D_LINE
    ) -> RayMatrix:
        """Matrix in either meridian: it bends nothing."""
        del plates, wavelength  # as the other elements have it
        check_meridian("meridian", meridian)
        return _plate(0.0, None)

    def size(self, meridian: Meridian) -> float:
        """Size of the screen: it has no edge."""
        check_meridian("meridian", meridian)
        return math.inf

    def aperture(self, meridian: Meridian) -> float:
        """Full opening in one meridian, mm."""
        check_meridian("meridian", meridian)
        return self.x if meridian == "x" else self.y

    def surfaces(self) -> tuple[Surface, ...]:
        """The screen."""
        return (Surface(half=(self.x / 2, self.y / 2), screen=True),)

    def turned(self) -> Self:
        """Return the screen: both sides are alike."""
        return self


@dataclass(frozen=True)
class SphericalLens:
    """A round lens with two spherical or plane sides.

    Parameters
    ----------
    part : str
        Part number or name.
    diameter : float
        mm.
    front_radius, back_radius : float
        Radii of curvature in mm, > 0 where the centre of curvature lies behind the surface;
        infinite for a plane.
    centre_thickness : float
        Thickness on the optical axis, mm.
    material : Material

    Raises
    ------
    ValueError
        If a size is not positive, a radius is shorter than half the diameter, or the sides cross
        before the edge.
    """

    part: str
    diameter: float
    front_radius: float
    back_radius: float
    centre_thickness: float
    material: Material

    def __post_init__(self) -> None:
        for name in ("diameter", "centre_thickness"):
            check.positive(f"{name} of {self.part}", getattr(self, name), "a size in mm")
        check_material(self.part, self.material)
        for name in ("front_radius", "back_radius"):
            radius = getattr(self, name)
            if radius in (math.inf, -math.inf):
                continue
            check.radius(f"{name} of {self.part}", radius)
            if abs(radius) < self.diameter / 2:
                raise ValueError(
                    f"{name} of {self.part} = {radius:g} mm: |radius| is at least half the "
                    f"diameter ({self.diameter / 2:g} mm)"
                )
        if self.edge_thickness < -1e-9:  # a whole ball's is 0, but for rounding
            raise ValueError(
                f"centre_thickness of {self.part} = {self.centre_thickness:g} mm: the sides cross "
                f"before the edge, which would be {self.edge_thickness:.4g} mm thick"
            )

    @property
    def thickness(self) -> float:
        """Thickness on the optical axis, mm."""
        return self.centre_thickness

    @property
    def edge_thickness(self) -> float:
        """Thickness at the edge, mm."""
        front, back = (float(side.sag(self.diameter / 2, 0.0)) for side in self.surfaces())
        return self.centre_thickness - front + back

    def size(self, meridian: Meridian) -> float:
        """Diameter, mm."""
        check_meridian("meridian", meridian)
        return self.diameter

    aperture = size

    def turned(self) -> Self:
        """Return the lens with its other side to the light."""
        return replace(self, front_radius=-self.back_radius, back_radius=-self.front_radius)

    def surfaces(self) -> tuple[Surface, ...]:
        """Front and back."""
        half = (self.diameter / 2, self.diameter / 2)
        front = Surface(0.0, 1 / self.front_radius, "xy", half, True, self.material)
        return front, Surface(self.thickness, 1 / self.back_radius, "xy", half, True)

    def matrix(
        self, meridian: Meridian, *, plates: bool = True, wavelength: float = D_LINE
    ) -> RayMatrix:
        """Matrix from the first vertex to the second, air to air: the same in both meridians."""
        del plates  # it has none
        check_meridian("meridian", meridian)
        n = self.material.index(wavelength)
        front, back = (
            flat_mat(before, after) if math.isinf(radius) else refract_mat(before, after, radius)
            for before, after, radius in ((1.0, n, self.front_radius), (n, 1.0, self.back_radius))
        )
        matrix: RayMatrix = back @ trans_mat(self.thickness) @ front
        return matrix


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
    clear : tuple of float, optional
        Clear aperture across and along the axis of the cylinder, mm, where a mount covers the
        edges; left out, all of the glass.

    Raises
    ------
    ValueError
        If a size is not positive, the radius is shorter than half the height, a convex lens is
        too thin for its edge to exist, or the clear aperture is larger than the glass.
    """

    part: str
    height: float
    length: float
    radius: float
    centre_thickness: float
    material: Material
    bends: Meridian = "x"
    reversed: bool = False
    clear: tuple[float, float] | None = None

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
        if self.clear is None:
            return
        object.__setattr__(self, "clear", tuple(self.clear))
        if len(self.clear) != 2:
            raise ValueError(
                f"clear of {self.part} = {self.clear}: two sizes are needed, (across, along) the "
                "axis of the cylinder, mm"
            )
        for name, clear in zip(("height", "length"), self.clear, strict=True):
            size = getattr(self, name)
            if check.positive(f"clear {name} of {self.part}", clear, "a size in mm") > size:
                raise ValueError(
                    f"clear {name} of {self.part} = {clear:g} mm: the glass is {size:g} mm; "
                    "clear is (across, along) the axis of the cylinder"
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
        """Size of the glass in one meridian, mm."""
        check_meridian("meridian", meridian)
        return self.height if meridian == self.bends else self.length

    def aperture(self, meridian: Meridian) -> float:
        """Full opening in one meridian, mm."""
        check_meridian("meridian", meridian)
        across, along = self.clear or (self.height, self.length)
        return across if meridian == self.bends else along

    def surfaces(self) -> tuple[Surface, ...]:
        """Front and back."""
        half = (self.aperture("x") / 2, self.aperture("y") / 2)
        if self.reversed:
            front = Surface(half=half, material=self.material)
            return front, Surface(self.thickness, -1 / self.radius, self.bends, half)
        front = Surface(0.0, 1 / self.radius, self.bends, half, material=self.material)
        return front, Surface(self.thickness, half=half)

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


Element = Lens | SphericalLens | Plate | Aperture


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
