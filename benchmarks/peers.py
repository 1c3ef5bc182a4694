"""Systems of raytransfer as models of other packages, which trace skew rays through them.

Frames and indices are worked out here, from the elements' surfaces and placements; the geometry of
the rays is all the peer's. Each model tells the rays' fates in raytransfer's words.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial.transform import Rotation  # type: ignore[import-untyped]

from raytransfer.surfaces import Surface
from raytransfer.systems import NOMINAL
from raytransfer.tracing import Status

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from numpy.typing import NDArray

    from raytransfer.materials import Material
    from raytransfer.systems import OpticalSystem, Placement

    Array = NDArray[np.float64]
    Index = Callable[[Material], float]


@dataclass(frozen=True)
class Placed:
    """A surface in the room.

    Parameters
    ----------
    surface : Surface
        Its own ``z`` is within ``origin`` already.
    origin : ndarray, shape (3,)
        Vertex in the system's frame, mm.
    rotation : ndarray, shape (3, 3)
        Its columns are the surface's axes.
    index : float
        Refractive index behind it.
    """

    surface: Surface
    origin: Array
    rotation: Array
    index: float


@dataclass(frozen=True)
class Fates:
    """Where a peer's rays went; N rays.

    Parameters
    ----------
    x, y : ndarray, shape (N,)
        On the sensor plane, in its frame, mm; 0 where lost.
    status, surface : ndarray, shape (N,)
        As in `raytransfer.tracing.Trace`.
    cosine : ndarray, shape (N,)
        Smallest cosine of incidence or refraction on the ray's way, the sensor included.
    """

    x: Array
    y: Array
    status: NDArray[np.uint8]
    surface: NDArray[np.int16]
    cosine: Array

    @classmethod
    def unknown(cls, rays: int) -> Fates:
        """Return the fates of rays that have not been traced yet."""
        return cls(
            np.zeros(rays),
            np.zeros(rays),
            np.full(rays, Status.ARRIVED, dtype=np.uint8),
            np.full(rays, -1, dtype=np.int16),
            np.ones(rays),
        )


def places(system: OpticalSystem, index: Index) -> tuple[Placed, ...]:
    """Place all surfaces of a system, the sensor plane last."""
    if system.sensor_distance is None:
        raise ValueError(f"{system.name} has no sensor_distance")
    return tuple(_places(system, index))


def _places(system: OpticalSystem, index: Index) -> Iterator[Placed]:
    placements = system.placements or (NOMINAL,) * len(system.elements)
    for (element, front, _), placement in zip(system.layout(), placements, strict=True):
        origin, rotation = _frame(placement, front)
        for surface in element.surfaces():
            behind = 1.0 if surface.material is None else index(surface.material)
            yield Placed(surface, origin + surface.z * rotation[:, 2], rotation, behind)
    at = system.length + (system.sensor_distance or 0.0)
    yield Placed(Surface(screen=True), *_frame(system.sensor_placement, at), 1.0)


def _frame(placement: Placement, z: float) -> tuple[Array, Array]:
    # lower case: about the fixed axes X, then Y, then Z
    rotation = Rotation.from_euler("xyz", placement.tilt).as_matrix()
    return np.array([*placement.decentre, z]), rotation


def _beyond(surface: Surface, z: Any) -> Any:
    """Whether a point is on the other half of a sphere or cylinder, which is not of glass.

    Or nowhere, NaN: where rayoptics looks for a plane behind a ray.
    """
    return np.logical_not(z * surface.curvature < 1)


@np.errstate(divide="ignore", invalid="ignore")
def trace_rayoptics(
    system: OpticalSystem, position: Array, direction: Array, index: Index
) -> Fates:
    """Trace with rayoptics, ray by ray.

    Parameters
    ----------
    system : OpticalSystem
        With planes, cylinders of either axis, spheres and screens, placed in any way.
    position, direction : ndarray, shape (3, N)
        As for `raytransfer.tracing.trace`, the direction of unit length.
    index : callable
        Refractive index of a material.
    """
    from rayoptics.raytr import traceerror
    from rayoptics.raytr.raytrace import trace_raw

    errors = {
        traceerror.TraceMissedSurfaceError: Status.MISSED,
        traceerror.TraceRayBlockedError: Status.BLOCKED,
        traceerror.TraceTIRError: Status.REFLECTED,
    }
    placed = places(system, index)
    path = list(_rayoptics_path(placed))
    fates = Fates.unknown(position.shape[1])
    for ray, (start, along) in enumerate(zip(position.T, direction.T, strict=True)):
        status, number = Status.ARRIVED, -1
        try:
            way, _, _ = trace_raw(
                iter(path),
                start,
                along,
                550.0,
                eps=1e-13,
                check_apertures=True,
                intersect_obj=False,
                pt_inside_fuzz=0.0,
            )
        except traceerror.TraceError as error:
            status, number = errors[type(error)], error.surf - 1
            way = error.ray_pkg[0]
        # the first element is the start; a ray that misses a surface ends at the one before
        for passed, (place, (point, *_)) in enumerate(zip(placed, way[1:], strict=False)):
            if _beyond(place.surface, point[2]):
                status, number = Status.MISSED, passed
                break
        fates.status[ray], fates.surface[ray] = status, number
        if status != Status.ARRIVED:
            continue
        fates.x[ray], fates.y[ray] = way[-1][0][:2]
        for (before, here), (_, _, (turn, _), _, _) in zip(pairwise(way), path, strict=False):
            normal = here[3]
            cosines = (normal @ (turn @ before[1]), normal @ here[1])
            fates.cosine[ray] = min(fates.cosine[ray], *np.abs(cosines))
    return fates


def _rayoptics_path(placed: tuple[Placed, ...]) -> Iterator[tuple[Any, ...]]:
    """Yield interface, gap, transform to the next, index behind and direction, as it wants them."""
    from rayoptics.elem.surface import Circular, Rectangular
    from rayoptics.elem.surface import Surface as Interface

    origins = [np.zeros(3), *(place.origin for place in placed)]
    turns = [np.eye(3), *(place.rotation for place in placed)]
    frames = zip(origins, turns, strict=True)
    transforms: list[tuple[Array, Array] | None] = [
        (there.T @ here, here.T @ (to - at)) for (at, here), (to, there) in pairwise(frames)
    ]
    transforms.append(None)  # none behind the sensor
    yield None, None, transforms[0], 1.0, 1.0
    for place, transform in zip(placed, transforms[1:], strict=True):
        surface = place.surface
        opening = Circular(surface.half[0]) if surface.round else Rectangular(*surface.half)
        interface = Interface(
            profile=_rayoptics_profile(surface),
            clear_apertures=[opening],
            interact_mode="dummy" if surface.screen else "transmit",
        )
        yield interface, None, transform, place.index, 1.0


def _rayoptics_profile(surface: Surface) -> Any:
    from rayoptics.elem import profiles
    from rayoptics.raytr.traceerror import TraceMissedSurfaceError

    class Swept:
        """A straight line swept about an axis: a cylinder.

        As the curve that is swept it would be a square root, whose end some iterations of a ray
        step over although the ray does meet the cylinder. Its iterations need telling, however,
        when they have found nothing.
        """

        def intersect(self, p0: Array, d: Array, eps: float, z_dir: float) -> Any:
            distance, point = super().intersect(p0, d, eps, z_dir)  # type: ignore[misc]
            if not abs(self.f(point)) < 1e-9:  # type: ignore[attr-defined]
                raise TraceMissedSurfaceError
            return distance, point

    if surface.bends in ("x", "y"):
        base = profiles.YToroid if surface.bends == "x" else profiles.XToroid
        return type("Cylinder", (Swept, base), {})(c=0.0, cR=surface.curvature)
    return profiles.Spherical(c=surface.curvature)


def trace_batoid(system: OpticalSystem, position: Array, direction: Array, index: Index) -> Fates:
    """Trace with batoid, surface by surface.

    Parameters
    ----------
    system : OpticalSystem
        With planes, spheres and screens, placed in any way.
    position, direction : ndarray, shape (3, N)
        As for `raytransfer.tracing.trace`, the direction of unit length.
    index : callable
        Refractive index of a material.
    """
    import batoid

    fates = Fates.unknown(position.shape[1])
    rays = batoid.RayVector(*position, *direction)  # its units are metres, but any will do

    def lose(which: NDArray[np.bool_], status: Status, number: int) -> None:
        which &= fates.surface < 0
        fates.status[which], fates.surface[which] = status, number

    def tilt(interface: Any) -> None:
        normal = interface.normal(rays.x, rays.y)
        cosine = np.abs(np.sum(normal * rays.v, axis=1)) / np.linalg.norm(rays.v, axis=1)
        np.fmin(fates.cosine, cosine, out=fates.cosine)  # of a lost ray it may be NaN

    before = batoid.ConstMedium(1.0)
    for number, place in enumerate(places(system, index)):
        interface, opening = batoid_interface(place.surface)
        frame = batoid.CoordSys(place.origin, place.rotation)
        behind = batoid.ConstMedium(place.index)
        interface.intersect(rays, frame)
        lose(rays.failed | _beyond(place.surface, rays.z), Status.MISSED, number)
        tilt(interface)
        if opening is not None:
            opening.obscure(rays)
            lose(rays.vignetted.copy(), Status.BLOCKED, number)
        interface.refract(rays, before, behind)
        lose(rays.failed.copy(), Status.REFLECTED, number)
        tilt(interface)
        before = behind
    arrived = fates.surface < 0
    fates.x[arrived], fates.y[arrived] = rays.x[arrived], rays.y[arrived]
    return fates


def batoid_interface(surface: Surface) -> tuple[Any, Any]:
    """Return batoid's surface, and what covers it outside its opening, None without an edge."""
    import batoid

    if surface.bends in ("x", "y"):
        raise ValueError("batoid has no cylinders")
    interface = batoid.Sphere(1 / surface.curvature) if surface.curvature else batoid.Plane()
    if surface.half == (np.inf, np.inf):
        return interface, None
    if surface.round:
        return interface, batoid.ObscNegation(batoid.ObscCircle(surface.half[0]))
    width, height = (2 * half for half in surface.half)
    return interface, batoid.ObscNegation(batoid.ObscRectangle(width, height))
