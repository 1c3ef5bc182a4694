"""Exact skew rays through an `OpticalSystem`, compiled; `reference` is the same in plain numpy.

Every surface has its true shape, place and tilt; Snell's law is exact. Light is unpolarised at
every surface, edges of glass absorb, and light that is reflected is lost: there are no ghosts.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from raytransfer import _checks as check
from raytransfer.materials import D_LINE
from raytransfer.prescription import prescription, surface_frames

if TYPE_CHECKING:
    from types import ModuleType

    from numpy.typing import ArrayLike, NDArray

    from raytransfer.systems import OpticalSystem

TINY = 1e-100
"""Below it a direction's z counts as 0, and squares of lengths underflow."""


class Status(IntEnum):
    """What became of a ray."""

    ARRIVED = 0
    MISSED = 1
    """It does not meet a surface."""
    BLOCKED = 2
    """It meets a surface outside its opening."""
    REFLECTED = 3
    """Total internal reflection."""


@dataclass(frozen=True)
class Trace:
    """Rays on the sensor's plane; of lost ones these numbers are 0.

    Attributes
    ----------
    x, y : ndarray, shape (N,)
        Along the pixel line and across it, mm, in the frame of the sensor.
    direction : ndarray, shape (3, N)
        Unit vectors in that frame.
    transmission : ndarray, shape (N,)
        Product of Fresnel's transmittances, or 1 without them.
    status : ndarray of uint8, shape (N,)
        See `Status`.
    surface : ndarray of int16, shape (N,)
        At which surface the ray was lost, counted from 0 through all elements; −1 for those that
        arrived.
    """

    x: NDArray[np.float64]
    y: NDArray[np.float64]
    direction: NDArray[np.float64]
    transmission: NDArray[np.float64]
    status: NDArray[np.uint8]
    surface: NDArray[np.int16]

    def _numbers(self, count: int) -> NDArray[np.float64]:
        """Return the array (6, count) that its parts are rows of, to be written over."""
        base = self.x.base
        if base is None or base.shape != (6, count):
            raise ValueError(
                f"out: a Trace of {len(self.x)} rays cannot take {count}; give one that trace "
                "returned for as many"
            )
        return base

    @classmethod
    def of(cls, out: NDArray[np.float64], lost: NDArray[np.int16]) -> Trace:
        """Name the parts of what a tracer wrote: out (6, N) and lost (N,)."""
        surface = np.where(lost == 0, np.int16(-1), lost >> 2)
        return cls(out[0], out[1], out[2:5], out[5], (lost & 3).astype(np.uint8), surface)

    @property
    def arrived(self) -> NDArray[np.bool_]:
        """Which rays arrived, shape (N,)."""
        return np.asarray(self.status == Status.ARRIVED)


def trace(
    system: OpticalSystem,
    position: ArrayLike,
    direction: ArrayLike,
    *,
    wavelength: float = D_LINE,
    fresnel: bool = True,
    threads: int | None = None,
    out: Trace | None = None,
) -> Trace:
    """Trace rays to the sensor, or to the plane of the last vertex if there is none.

    Parameters
    ----------
    system : OpticalSystem
    position : array_like, shape (3, N)
        Where the rays start, mm: X along the pixel line, Y up, Z with the light from the first
        vertex, so that sources have negative z.
    direction : array_like, shape (3, N)
        Of any length; z > 0.
    wavelength : float
        µm.
    fresnel : bool
        Whether to compute the transmission.
    threads : int, optional
        How many to use; all when left out. The result is the same bit for bit.
    out : Trace, optional
        What an earlier call returned for as many rays: written over, which spares fresh memory.

    Raises
    ------
    ValueError
        If a number is not finite, a ray starts in or behind the glass, or it does not go forward.
    """
    kernels = load_kernels()
    start, toward = _rays(position, direction)
    count = start.shape[1]
    traced = np.empty((6, count)) if out is None else out._numbers(count)
    status = np.empty(count, np.uint8) if out is None else out.status
    surface = np.empty(count, np.int16) if out is None else out.surface
    parts = prescription(system, wavelength)
    with using(threads):
        arguments = (_foremost(system), *parts, fresnel, traced, status, surface)
        if kernels.trace(start, toward, *arguments):
            start, toward = checked_rays(system, position, direction)
            kernels.trace(start, toward, *arguments)
    return Trace(traced[0], traced[1], traced[2:5], traced[5], status, surface)


def checked_rays(
    system: OpticalSystem, position: ArrayLike, direction: ArrayLike
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return rays as arrays (3, N), or refuse them as `trace` does."""
    start, toward = _rays(position, direction)
    check.array("position", start, "mm")
    check.array("direction", toward)
    if not start.size:
        return start, toward
    if toward[2].min() <= 0:
        raise ValueError(
            f"direction: z = {toward[2].min():g} of ray {toward[2].argmin()}; light goes forward, "
            "z > 0"
        )
    if toward[2].min() < TINY or max(-toward.min(), toward.max()) > 1 / TINY:
        toward = toward / np.abs(toward).max(axis=0)  # its square would overflow
    front, rotation, origin = surface_frames(system)[0]
    first = system.elements[0]
    size = (first.size("x") / 2, first.size("y") / 2)
    foremost = min(front.depth(size), 0.0)
    if start[2].max() < _foremost(system):
        return start, toward
    x, y, z = rotation.T @ (start - origin[:, None])
    beside = (np.abs(x) > size[0]) | (np.abs(y) > size[1])
    if front.round:
        beside |= np.hypot(x, y) > size[0]
    # beside the lens it may not stand behind any of it: the ray would be traced back to the front
    behind = z > np.where(beside, foremost, np.nan_to_num(front.sag(x, y)))
    if behind.any():
        ray = int(behind.argmax())
        raise ValueError(
            f"position of ray {ray} = {tuple(map(float, start[:, ray]))} mm: it is in or behind "
            f"{first.part}, whose vertex is at z = {origin[2]:g}; sources have negative z"
        )
    return start, toward


def _rays(
    position: ArrayLike, direction: ArrayLike
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return rays as contiguous arrays (3, N), or refuse their shapes."""
    start, toward = (
        np.ascontiguousarray(check.numbers(name, values))
        for name, values in (("position", position), ("direction", direction))
    )
    if start.ndim != 2 or len(start) != 3 or start.shape != toward.shape:
        raise ValueError(
            f"position {start.shape} and direction {toward.shape}: both are (3, N): x, y and z "
            "of N rays"
        )
    return start, toward


def _foremost(system: OpticalSystem) -> float:
    """Return a z before all of the first element, mm."""
    front, rotation, origin = surface_frames(system)[0]
    first = system.elements[0]
    size = (first.size("x") / 2, first.size("y") / 2)
    tilt = np.abs(rotation[2, :2]) @ np.where(np.isfinite(size), size, 0.0)
    return float(origin[2] + min(front.depth(size), 0.0) - tilt)


class Bundle(NamedTuple):
    """Rays from a point source over the front opening.

    Attributes
    ----------
    position, direction : ndarray, shape (3, N)
        For `trace`.
    solid_angle : ndarray, shape (N,)
        What each ray stands for, sr.
    pupil : ndarray, shape (2, N)
        Where it would meet the plane of the first vertex, mm.
    """

    position: NDArray[np.float64]
    direction: NDArray[np.float64]
    solid_angle: NDArray[np.float64]
    pupil: NDArray[np.float64]


def bundle(system: OpticalSystem, position: tuple[float, float, float], nx: int, ny: int) -> Bundle:
    """Rays from a point source to the middles of an nx × ny grid over the front opening.

    Parameters
    ----------
    system : OpticalSystem
    position : tuple of float
        Source: X, Y, and distance before the first vertex, mm.
    nx, ny : int
        Ray ix · ny + iy is that of column ix and row iy.
    """
    across, up, distance = check_source(position)
    low_x, high_x, low_y, high_y = front_opening(system, position)
    step = (high_x - low_x) / check.whole("nx", nx), (high_y - low_y) / check.whole("ny", ny)
    u, v = np.meshgrid(
        low_x + (np.arange(nx) + 0.5) * step[0],
        low_y + (np.arange(ny) + 0.5) * step[1],
        indexing="ij",
    )
    pupil = np.stack([u.ravel(), v.ravel()])
    source = np.array([across, up, -distance])[:, None]
    to = np.stack([*pupil, np.zeros(pupil.shape[1])]) - source
    length = np.sqrt((to**2).sum(axis=0))
    return Bundle(
        np.repeat(source, pupil.shape[1], axis=1),
        to / length,
        step[0] * step[1] * distance / length**3,
        pupil,
    )


def check_source(position: tuple[float, float, float]) -> tuple[float, float, float]:
    """Return the source's X, Y and distance, or refuse them."""
    if len(position) != 3:
        raise ValueError(f"position = {position}: X, Y and the distance before the head, mm")
    x, y, distance = (check.number(f"position[{i}]", value) for i, value in enumerate(position))
    check.positive("distance of the source", distance, "it stands before the first vertex")
    return x, y, distance


def front_opening(
    system: OpticalSystem, position: tuple[float, float, float]
) -> tuple[float, float, float, float]:
    """Lowest and highest X and Y of the rays that can pass the front, on the plane z = 0, mm.

    Seen from the source, the edges of all screens and of the first glass are projected on that
    plane; the rectangle holds every ray that passes them, and some that do not.

    Raises
    ------
    ValueError
        If nothing at the front has an edge, or the source stands in the first element.
    """
    x, y, distance = check_source(position)
    source = np.array([x, y, -distance])
    low, high = np.full(2, -np.inf), np.full(2, np.inf)
    frames = surface_frames(system)
    glass, _, place = next((f for f in frames if not f[0].screen), frames[-1])
    # where a screen has no edge, light that reaches the first glass passes within, however rolled
    reach = math.hypot(*np.minimum(glass.half, 1e4)) + math.hypot(*place[:2])
    slope = (math.hypot(x, y) + reach) / distance
    reach += 2 * slope * (abs(place[2]) + 10) + 1
    for surface, rotation, origin in frames:
        limits = np.minimum(surface.half, reach + math.hypot(*origin[:2]))
        corners = np.array([[i, j] for i in (-1, 1) for j in (-1, 1)]).T * limits[:, None]
        depths = {0.0, surface.depth(surface.half)}
        points = np.concatenate([np.vstack([corners, np.full(4, z)]) for z in depths], axis=1)
        points = rotation @ points + origin[:, None]
        ahead = points[2] + distance
        bounded = np.isfinite(surface.half)
        if ahead.min() > 0:
            on_plane = source[:2, None] + (points[:2] - source[:2, None]) * (distance / ahead)
            low = np.where(bounded, np.maximum(low, on_plane.min(axis=1)), low)
            high = np.where(bounded, np.minimum(high, on_plane.max(axis=1)), high)
        elif bounded.all():  # an endless one that is tilted reaches past any source
            raise ValueError(
                f"distance of the source = {distance:g} mm: it stands within the depth of the "
                "front surface; sources are before the lenses"
            )
        if not surface.screen:
            break
    if not np.isfinite([low, high]).all():
        raise ValueError(
            f"{system.name}: no edge limits the light at the front; give the first lens a size, "
            "or put an Aperture before it"
        )
    high = np.maximum(high, low)  # openings that do not overlap let nothing through
    return float(low[0]), float(high[0]), float(low[1]), float(high[1])


class using:  # noqa: N801  # reads as a statement
    """Use so many threads of numba's within a `with`, then as many as before."""

    def __init__(self, threads: int | None) -> None:
        self._threads = None if threads is None else check.whole("threads", threads)
        self._before = 0

    def __enter__(self) -> None:
        if self._threads is not None:
            import numba

            config: Any = numba.config
            self._before = numba.get_num_threads()
            numba.set_num_threads(min(self._threads, config.NUMBA_NUM_THREADS))

    def __exit__(self, *_: object) -> None:
        if self._before:
            import numba

            numba.set_num_threads(self._before)


def load_kernels() -> ModuleType:
    """Import the compiled kernels; `ModuleNotFoundError` says what to install."""
    try:
        from raytransfer import _kernels
    except ModuleNotFoundError as error:
        if error.name not in ("numba", "llvmlite"):
            raise
        raise ModuleNotFoundError(
            "exact rays are traced by numba, which is not installed: pip install linetrack[exact]"
        ) from error
    return _kernels
