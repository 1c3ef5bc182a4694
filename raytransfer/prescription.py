"""What a tracer needs of a system: its surfaces one after the other, as plain arrays."""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from raytransfer.materials import D_LINE
from raytransfer.sources import check_wavelength

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from raytransfer.surfaces import Surface
    from raytransfer.systems import OpticalSystem


class Prescription(NamedTuple):
    """S surfaces and the plane that light is traced to, for one wavelength.

    Attributes
    ----------
    steps : ndarray, shape (S + 1, 3, 4)
        [A | b]: q′ = A q + b takes coordinates from one surface's frame (first: the system's) to
        the next one's (last: the sensor's).
    turned : ndarray of bool, shape (S + 1,)
        Whether A is more than the identity.
    shapes : ndarray, shape (S, 3)
        Curvature in 1/mm, aₓ, a_y (see `Surface`).
    indices : ndarray, shape (S, 2)
        Refractive index before and behind; of a screen 0, 0.
    edges : ndarray, shape (S, 3)
        Half openings along X and Y, mm; the third is 1 for a round one.
    """

    steps: NDArray[np.float64]
    turned: NDArray[np.bool_]
    shapes: NDArray[np.float64]
    indices: NDArray[np.float64]
    edges: NDArray[np.float64]


def prescription(system: OpticalSystem, wavelength: float = D_LINE) -> Prescription:
    """Lay out a system's surfaces for a wavelength in µm."""
    check_wavelength("wavelength", wavelength)  # a constant index would take any
    frames = surface_frames(system)
    rotation, origin = np.eye(3), np.zeros(3)
    steps = []
    for next_rotation, next_origin in [(r, o) for _, r, o in frames] + [_target(system)]:
        turn = next_rotation.T @ rotation
        if np.array_equal(next_rotation, rotation):
            turn = np.eye(3)
        shift = next_rotation.T @ (origin - next_origin)
        steps.append(np.column_stack([turn, shift]))
        rotation, origin = next_rotation, next_origin
    surfaces = [surface for surface, _, _ in frames]
    indices, before = [], 1.0
    for surface in surfaces:
        if surface.screen:
            indices.append((0.0, 0.0))
            continue
        behind = 1.0 if surface.material is None else surface.material.index(wavelength)
        indices.append((before, behind))
        before = behind
    stacked = np.stack(steps)
    return Prescription(
        steps=stacked,
        turned=(stacked[:, :, :3] != np.eye(3)).any(axis=(1, 2)),
        shapes=np.array([(s.curvature, s.ax, s.ay) for s in surfaces], dtype=float),
        indices=np.array(indices),
        edges=np.array([(*s.half, float(s.round)) for s in surfaces], dtype=float),
    )


@lru_cache(maxsize=64)
def surface_frames(
    system: OpticalSystem,
) -> tuple[tuple[Surface, NDArray[np.float64], NDArray[np.float64]], ...]:
    """Every surface with the rotation and the vertex of its frame, in that of the system."""
    frames = tuple(
        (surface, rotation, origin + surface.z * rotation[:, 2])
        for element, (rotation, origin) in zip(system.elements, system.places(), strict=False)
        for surface in element.surfaces()
    )
    for _, rotation, origin in frames:  # are shared
        rotation.flags.writeable = origin.flags.writeable = False
    return frames


def _target(system: OpticalSystem) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the frame of the sensor, or of the plane through the last vertex."""
    if system.sensor_distance is None:
        return np.eye(3), np.array([0.0, 0.0, system.length])
    return system.places()[-1]
