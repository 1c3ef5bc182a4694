"""Lenses on an axis: matrices in both meridians, cardinal points, the thesis's systems.

The optical frame: Z with the light, X along the sensor's pixel line, Y up. Distances are in mm.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import reduce
from itertools import pairwise
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from raytransfer import _checks as check
from raytransfer.lenses import CATALOGUE, THESIS_LENSES, Aperture, Element, Lens, Meridian
from raytransfer.materials import D_LINE
from raytransfer.matrices import RayMatrix, trans_mat
from raytransfer.sensors import TCD1304, LineSensor

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray


MERIDIANS: tuple[Meridian, Meridian] = ("x", "y")


class Placed(NamedTuple):
    """An element and where its two vertices are, mm behind the system's first vertex."""

    element: Element
    front: float
    back: float


@dataclass(frozen=True)
class Placement:
    """How an element deviates from its place on the axis.

    Parameters
    ----------
    decentre : tuple of float
        Along X and Y, mm.
    tilt : tuple of float
        About X, Y and Z through the element's front vertex, one after the other, rad, right-handed:
        the rotation is R = Rz Ry Rx.
    """

    decentre: tuple[float, float] = (0.0, 0.0)
    tilt: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        for name, length, unit in (
            ("decentre", 2, "mm in X and Y"),
            ("tilt", 3, "rad about X, Y, Z"),
        ):
            values = tuple(getattr(self, name))
            if len(values) != length:
                raise ValueError(f"{name} = {values}: {length} numbers are needed, {unit}")
            object.__setattr__(
                self, name, tuple(check.number(f"{name}[{i}]", v) for i, v in enumerate(values))
            )
        if max(map(abs, self.tilt[:2])) >= math.pi / 2:
            raise ValueError(
                f"tilt = {self.tilt}: allowed is less than a right angle about X and Y; "
                "was it given in degrees?"
            )

    def rotation(self) -> NDArray[np.float64]:
        """Rotation matrix, shape (3, 3): its columns are the element's axes."""
        (cx, sx), (cy, sy), (cz, sz) = ((math.cos(a), math.sin(a)) for a in self.tilt)
        about_x = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
        about_y = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
        about_z = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])
        return np.asarray(about_z @ about_y @ about_x)


NOMINAL = Placement()
"""Where it should be."""


@dataclass(frozen=True)
class CardinalPoints:
    """The six cardinal points of a system in air, in one meridian; all in mm.

    Front points are measured from the system's first vertex, back points from its last; positive
    is with the light. The nodal points coincide with the principal points, because there is air on
    both sides. An afocal system has all of them at infinity.
    """

    effective_focal_length: float
    front_focal_point: float
    back_focal_point: float
    front_principal_point: float
    back_principal_point: float

    @property
    def front_nodal_point(self) -> float:
        """The front principal point, because there is air on both sides."""
        return self.front_principal_point

    @property
    def back_nodal_point(self) -> float:
        """The back principal point, because there is air on both sides."""
        return self.back_principal_point


@dataclass(frozen=True)
class OpticalSystem:
    """Elements along the optical axis, front (where the light enters) to back.

    Parameters
    ----------
    name : str
    elements : tuple of Lens, SphericalLens, Plate and Aperture
    gaps : tuple of float
        Air between the vertices of one element and the next, mm, ≥ 0: one fewer than elements.
    sensor_distance : float, optional
        Air from the last vertex to the sensor's chip, mm.
    placements : tuple of Placement
        How each element deviates from its place; none means that no element does. Exact rays see
        it, matrices do not.
    sensor_placement : Placement
        The same for the sensor, about the middle of its line.

    Raises
    ------
    ValueError
        If there is no element, the number of gaps or placements does not fit, a distance is
        negative, or elements overlap anywhere within their edges.
    """

    name: str
    elements: tuple[Element, ...]
    gaps: tuple[float, ...] = ()
    sensor_distance: float | None = None
    placements: tuple[Placement, ...] = ()
    sensor_placement: Placement = NOMINAL

    def __post_init__(self) -> None:
        object.__setattr__(self, "elements", tuple(self.elements))
        object.__setattr__(self, "gaps", tuple(self.gaps))
        object.__setattr__(self, "placements", tuple(self.placements))
        if not self.elements:
            raise ValueError(f"{self.name}: a system has at least one element")
        for element in self.elements:
            if not isinstance(element, Element):
                raise TypeError(f"{self.name}: {element!r} is no Lens, Plate or Aperture")
        if len(self.gaps) != len(self.elements) - 1:
            raise ValueError(
                f"{self.name}: {len(self.elements)} elements have {len(self.elements) - 1} gaps "
                f"between them, not {len(self.gaps)}"
            )
        for number, gap in enumerate(self.gaps):
            before, after = self.elements[number : number + 2]
            check.not_negative(
                f"gap between {before.part} and {after.part}",
                gap,
                "elements stand front to back and cannot overlap",
            )
        if self.sensor_distance is not None:
            check.not_negative("sensor_distance", self.sensor_distance)
        for placement in (*self.placements, self.sensor_placement):
            if not isinstance(placement, Placement):
                raise TypeError(f"{self.name}: {placement!r} is no Placement(decentre, tilt)")
        if self.placements and len(self.placements) != len(self.elements):
            raise ValueError(
                f"{self.name}: {len(self.placements)} placements for {len(self.elements)} elements; "
                "give one for each, or none"
            )
        self._check_overlap()

    def _check_overlap(self) -> None:
        """Refuse elements that reach into each other, at any of 9 × 9 points within both."""
        places = self.places()
        layout = self.layout()
        every = range(len(self.elements))
        glass = [number for number in every if not isinstance(self.elements[number], Aperture)]
        # neighbours, and glass that might meet through a screen's opening
        for number, following in dict.fromkeys([*pairwise(every), *pairwise(glass)]):
            before, after = self.elements[number], self.elements[following]
            back, front = before.surfaces()[-1], after.surfaces()[0]
            if not (back.bends or front.bends or self.placements):
                continue  # parallel planes; gaps are ≥ 0
            extent = [
                min(before.size(m), after.size(m), key=lambda size: (math.isinf(size), size)) / 2
                for m in MERIDIANS
            ]
            if math.inf in extent:
                continue  # neither has a known edge
            x, y = np.meshgrid(*(np.linspace(-half, half, 9) for half in extent))
            if back.round or front.round:
                within = x**2 + y**2 <= min(extent) ** 2 * (1 + 1e-9)
                x, y = x[within], y[within]
            x, y = x.ravel(), y.ravel()
            if back.screen:
                x, y = x[~back.opens(x, y)], y[~back.opens(x, y)]
            rotation, origin = places[number]
            points = rotation @ np.stack([x, y, back.z + back.sag(x, y)]) + origin[:, None]
            rotation, origin = places[following]
            x, y, z = rotation.T @ (points - origin[:, None])
            if front.screen:
                solid = ~front.opens(x, y)
                x, y, z = x[solid], y[solid], z[solid]
            overlap = np.nan_to_num(z - front.sag(x, y), nan=-1.0)
            if overlap.size and overlap.max() > 1e-9:
                worst = int(overlap.argmax())
                raise ValueError(
                    f"{before.part} and {after.part} overlap by {overlap[worst]:.4g} mm at "
                    f"x = {x[worst]:.4g}, y = {y[worst]:.4g} mm: their vertices are "
                    f"{layout[following].front - layout[number].back:g} mm apart; "
                    "is the gap too small, or a lens the wrong way round?"
                )

    def places(self) -> tuple[tuple[NDArray[np.float64], NDArray[np.float64]], ...]:
        """Rotation (3, 3) and front vertex (3,) of every element, then of the sensor if it has one.

        The columns of the rotation are the element's axes in the frame of the system.
        """
        at = [placed.front for placed in self.layout()]
        placements = list(self.placements) or [NOMINAL] * len(at)
        if self.sensor_distance is not None:
            at.append(self.length + self.sensor_distance)
            placements.append(self.sensor_placement)
        return tuple(
            (placement.rotation(), np.array([*placement.decentre, z]))
            for placement, z in zip(placements, at, strict=True)
        )

    def turned(self) -> OpticalSystem:
        """Return the lenses as light from behind meets them, without a sensor.

        Turned about Y by 180°: X and Z change sign.

        Raises
        ------
        ValueError
            If an element is off its place.
        """
        if any(placement != NOMINAL for placement in self.placements):
            raise ValueError(
                f"{self.name}: only a system of elements in their places can be turned"
            )
        return replace(
            self,
            name=f"{self.name}, turned",
            elements=tuple(element.turned() for element in reversed(self.elements)),
            gaps=tuple(reversed(self.gaps)),
            sensor_distance=None,
            placements=(),
            sensor_placement=NOMINAL,
        )

    @property
    def length(self) -> float:
        """From the first vertex to the last, mm."""
        return sum(element.thickness for element in self.elements) + sum(self.gaps)

    def layout(self) -> tuple[Placed, ...]:
        """Return every element with its place on the axis, for drawing and building."""
        placed, front = [], 0.0
        for element, gap in zip(self.elements, (*self.gaps, 0.0), strict=True):
            back = front + element.thickness
            placed.append(Placed(element, front, back))
            front = back + gap
        return tuple(placed)

    def matrix(
        self, meridian: Meridian, *, plates: bool = True, wavelength: float = D_LINE
    ) -> RayMatrix:
        """Paraxial matrix from the first vertex to the last.

        Parameters
        ----------
        meridian : {"x", "y"}
            x holds the pixel line, y is across it. What bends one of them is a plate of glass in
            the other.
        plates : bool
            False leaves these plates and windows out, as the thesis does: air of their thickness.
        wavelength : float
            µm.
        """
        parts = [
            element.matrix(meridian, plates=plates, wavelength=wavelength)
            for element in self.elements
        ]
        for number, gap in reversed(list(enumerate(self.gaps, start=1))):
            parts.insert(number, trans_mat(gap))
        return reduce(lambda before, part: part @ before, parts)

    def trace(
        self, rays: ArrayLike, meridian: Meridian, *, plates: bool = True
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Follow paraxial rays from vertex to vertex.

        Parameters
        ----------
        rays : array_like, shape (2, N)
            Heights (mm) and angles (rad) at the first vertex, before it refracts.
        meridian : {"x", "y"}
        plates : bool
            As for `matrix`.

        Returns
        -------
        z : ndarray, shape (V,)
            The vertices, mm behind the first.
        rays : ndarray, shape (V, 2, N)
            Heights and angles there; angles in the air before an element at its front vertex,
            behind it at its back vertex.
        """
        here = np.asarray(rays, dtype=float)
        z: list[float] = []
        path: list[NDArray[np.float64]] = []
        for element, front, back in self.layout():
            if z:
                here = trans_mat(front - z[-1]) @ here
            z += [front, back]
            path.append(here)
            here = element.matrix(meridian, plates=plates) @ here
            path.append(here)
        return np.array(z), np.stack(path)

    def cardinal_points(
        self, meridian: Meridian, *, plates: bool = True, wavelength: float = D_LINE
    ) -> CardinalPoints:
        """Return focal, principal and nodal points in one meridian."""
        m = self.matrix(meridian, plates=plates, wavelength=wavelength)
        # what floating point leaves of C where the lenses of a telescope cancel
        if m.C == 0 or 0 < abs(m.B * m.C) < 1e-12 * abs(m.A * m.D):
            return CardinalPoints(*[math.inf] * 5)
        # Hecht, Optics, section 6.2, for a matrix that acts on (height, angle) in air
        return CardinalPoints(
            effective_focal_length=-1 / m.C,
            front_focal_point=m.D / m.C,
            back_focal_point=-m.A / m.C,
            front_principal_point=(m.D - 1) / m.C,
            back_principal_point=(1 - m.A) / m.C,
        )

    def effective_focal_length(
        self, meridian: Meridian, *, plates: bool = True, wavelength: float = D_LINE
    ) -> float:
        """Effective focal length in mm, −1/C; infinite without power."""
        points = self.cardinal_points(meridian, plates=plates, wavelength=wavelength)
        return points.effective_focal_length

    def back_focal_length(
        self, meridian: Meridian, *, plates: bool = True, wavelength: float = D_LINE
    ) -> float:
        """From the last vertex to the focus of parallel light, mm; infinite without power."""
        points = self.cardinal_points(meridian, plates=plates, wavelength=wavelength)
        return points.back_focal_point


def _lens(lens: Lens | str) -> Lens:
    if isinstance(lens, Lens):
        return lens
    known = {**CATALOGUE, **THESIS_LENSES}
    if lens not in known:
        raise ValueError(f"lens {lens!r}: known are {', '.join(known)}")
    return known[lens]


def telecentric_pair(
    front: Lens | str = "PCX_30_32_60", back: Lens | str | None = None, gap: float = 0.0
) -> OpticalSystem:
    """Two plano-convex lenses that bend x, curved sides facing each other (listing 4.2).

    Parameters
    ----------
    front, back : Lens or name in `CATALOGUE` or `THESIS_LENSES`
        `back` left out is the same as `front`.
    gap : float
        Air between the curved sides, mm; 0 as the thesis simulates it.
    """
    first = _lens(front)
    second = first if back is None else _lens(back)
    name = f"pair {first.part} + {second.part}"
    elements = (_oriented(first, "x", plane_first=True), _oriented(second, "x", plane_first=False))
    return OpticalSystem(name, elements, (gap,))


def collimating_pair(
    concave: Lens | str = "PCV_15_30_20", convex: Lens | str = "PCX_15_30_20", gap: float = 32.0
) -> OpticalSystem:
    """A plano-concave and a plano-convex lens that bend y, curved sides to the light (listing 4.3).

    The thesis simulates a gap of 32 mm; its head, figure 4.7, has 40 − 3 − 5.2 = 31.8 mm.
    """
    first, second = (_oriented(_lens(lens), "y", plane_first=False) for lens in (concave, convex))
    return OpticalSystem(f"collimator {first.part} + {second.part}", (first, second), (gap,))


def _oriented(lens: Lens, meridian: Meridian, *, plane_first: bool) -> Lens:
    lens = lens.bending(meridian)
    return lens if lens.reversed == plane_first else lens.turned()


def _lenses(system: OpticalSystem) -> tuple[Lens, Lens]:
    match system.elements:
        case (Lens() as first, Lens() as second):
            return first, second
    raise ValueError(f"{system.name}: a pair of two lenses is needed")


def prototype_head(
    sensor: LineSensor = TCD1304,
    pair: OpticalSystem | None = None,
    collimator: OpticalSystem | None = None,
    *,
    concave_height: float = 40.0,
    concave_to_pair: float = 2.63,
    pair_height: float = 25.4,
    convex_height: float = 3.0,
) -> OpticalSystem:
    """Return the head of figure 4.7: collimator around the pair, above the sensor's window.

    Parameters
    ----------
    sensor : LineSensor
        Its window and the air below it become part of the system.
    pair, collimator : OpticalSystem, optional
        The four lenses; the thesis's when left out. Their own gaps are replaced by what follows
        from the heights.
    concave_height, pair_height, convex_height : float
        Height in mm above the window's top of each element's lower vertex (figure 4.7, section
        4.2.1).
    concave_to_pair : float
        Air in mm between the concave lens and the pair (section 4.2.1). With the thesis's lenses the remaining
        40 − 2.63 − 25.4 − 2 × 5.9 leave 0.17 mm between the pair.
    """
    if sensor.window is None or sensor.top_to_chip is None:
        raise ValueError(f"{sensor.name}: a head needs its window, which its data file lacks")
    first, second = _lenses(pair or telecentric_pair())
    concave, convex = _lenses(collimator or collimating_pair())
    between = concave_height - concave_to_pair - pair_height - first.thickness - second.thickness
    gaps = (
        concave_to_pair,
        round(between, 9),  # what floating point adds to 0.17
        round(pair_height - convex_height - convex.thickness, 9),
        convex_height,
    )
    return OpticalSystem(
        f"head with {first.part} + {second.part}",
        (concave, first, second, convex, sensor.window),
        gaps,
        round(sensor.top_to_chip - sensor.window.thickness, 9),
    )
