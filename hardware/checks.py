"""What makes a mount good: it can be printed, assembled, holds its lenses and lets the light through.

Every check looks at the triangles that would be printed, not at the description they came from.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from hardware.findings import Finding
from hardware.mesh import manifold, manifold_of, mesh
from hardware.mount import mount_rules, window_place
from hardware.solids import Cylinder
from raytransfer.lenses import Aperture
from raytransfer.prescription import surface_frames
from raytransfer.reference import path, trace
from raytransfer.tracing import bundle

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from manifold3d import Manifold
    from numpy.typing import NDArray
    from trimesh import Trimesh

    from hardware.mount import LensMount
    from hardware.solids import Axis, Solid
    from hardware.stand import LedMount, Stand
    from raytransfer.systems import OpticalSystem

TOLERANCE = 0.05
"""Of outer dimensions, mm."""

TOUCH = 1e-3
"""Overlaps below this volume are rounding, mm³."""

STEP = 1.0
"""Between the places at which a lens is tried on its way into a half, mm."""

RAYS = (12, 160)
"""Of each source over the front opening, along and across the pixel line."""


CHECKS = (
    "watertight",
    "outer dimensions",
    "collision",
    "held",
    "insertable",
    "light",
    "slit",
    "holes",
    "board",
    "wall",
)
"""All checks, by the names that findings carry."""

_TOWARDS: Mapping[str, float] = {"lower": 1.0, "upper": -1.0}
"""Side of y from which lenses come into a half."""


def check_mount(mount: LensMount, surfaces: Mapping[str, Trimesh] | None = None) -> list[Finding]:
    """Say what is wrong with a mount; nothing is a good sign.

    Parameters
    ----------
    mount : LensMount
    surfaces : mapping of "lower" and "upper" to Trimesh, optional
        What will be printed, such as STL files read back; made from the description when left out.
    """
    if surfaces is None:
        surfaces = {half: mesh(solid) for half, solid in mount.halves.items()}
    findings = list(_watertight(surfaces))
    if findings:
        return findings  # what is inside is not defined
    halves = {half: manifold_of(surface) for half, surface in surfaces.items()}
    triangles = np.concatenate([surface.triangles for surface in surfaces.values()])
    return [
        *_outer_dimensions(mount, surfaces),
        *_collisions(mount, halves),
        *_held(mount, halves),
        *_insertable(mount, halves),
        *_light(mount, triangles),
        *_slit(mount, triangles),
        *_holes(mount, halves),
        *_board(mount, halves),
        *_walls(surfaces, mount.rules.printable_wall),
    ]


def _watertight(surfaces: Mapping[str, Trimesh]) -> Iterator[Finding]:
    for half, surface in surfaces.items():
        if not (surface.is_watertight and surface.is_winding_consistent):
            yield Finding("watertight", half, "the surface has gaps or faces turned inside out")
        elif surface.volume <= 0:
            yield Finding("watertight", half, f"the surface encloses {surface.volume:.4g} mm³")
        elif len(manifold_of(surface).decompose()) > 1:
            yield Finding("watertight", half, "it falls into several pieces")


def _outer_dimensions(mount: LensMount, surfaces: Mapping[str, Trimesh]) -> Iterator[Finding]:
    x, y = mount.half_size
    wanted: dict[str, tuple[list[float], list[float]]] = {
        "lower": ([-x, -y, mount.front], [x, 0.0, mount.face]),
        "upper": ([-x, 0.0, mount.front], [x, y, mount.face]),
    }
    for half, surface in surfaces.items():
        off = surface.bounds - np.array(wanted[half])
        if np.abs(off).max() > TOLERANCE:
            size = " × ".join(f"{s:.2f}" for s in np.ptp(surface.bounds, axis=0))
            yield Finding(
                "outer dimensions",
                half,
                f"{size} mm, with a face {np.abs(off).max():.3g} mm from where it should be",
            )


def _collisions(mount: LensMount, halves: Mapping[str, Manifold]) -> Iterator[Finding]:
    solids = {lens.name: manifold(lens.glass) for lens in mount.lenses} | {**halves}
    for (one, a), (other, b) in itertools.combinations(solids.items(), 2):
        shared = (a ^ b).volume()
        if shared > TOUCH:
            yield Finding("collision", one, f"shares {shared:.3g} mm³ with {other}")


def _held(mount: LensMount, halves: Mapping[str, Manifold]) -> Iterator[Finding]:
    """Move every lens a little in six directions: each half that should stop it must be met."""
    play = mount.rules.play
    for lens in mount.lenses:
        for axis, sign in itertools.product("xyz", (1, -1)):
            move = [sign * play * (axis == a) for a in "xyz"]
            moved = manifold(lens.glass).translate(move)
            missed = [
                half
                for half, body in halves.items()
                # along y a lens leaves one half and meets the other
                if not (axis == "y" and sign == _TOWARDS[half]) and (moved ^ body).volume() <= TOUCH
            ]
            if missed:
                yield Finding(
                    "held",
                    lens.name,
                    f"moves by {play:g} mm towards {'+' if sign > 0 else '−'}{axis} without "
                    f"meeting the {' and the '.join(missed)} half",
                )


def _insertable(mount: LensMount, halves: Mapping[str, Manifold]) -> Iterator[Finding]:
    """Bring every lens to its place from outside, through the plane where the halves part."""
    for lens in mount.lenses:
        travel = lens.half[1] + mount.half_size[1]
        for half, body in halves.items():
            glass = manifold(lens.glass)
            for step in np.arange(STEP, travel, STEP):
                shared = (glass.translate([0.0, _TOWARDS[half] * step, 0.0]) ^ body).volume()
                if shared > TOUCH:
                    yield Finding(
                        "insertable",
                        lens.name,
                        f"meets the {half} half {step:g} mm before it is in its pocket",
                    )
                    break


def used_light(mount: LensMount, system: OpticalSystem | None = None) -> NDArray[np.float64]:
    """Points of rays that reach the pixel line from the edges of the field, near and far.

    Parameters
    ----------
    mount : LensMount
    system : OpticalSystem, optional
        Another than the mount's, in the same frame.

    Returns
    -------
    ndarray, shape (S + 2, 3, N)
        As `raytransfer.reference.path`; the start is 10 mm before the mount.
    """
    system = mount.system if system is None else system
    field = mount.rules.field
    angles = (math.radians(field.along), math.radians(field.across))
    paths = []
    for i, j, distance in itertools.product((-1, 0, 1), (-1, 0, 1), field.distances):
        source = (
            i * distance * math.tan(angles[0]),
            j * distance * math.tan(angles[1]),
            distance,
        )
        rays = bundle(system, source, *RAYS)
        arrived = trace(system, rays.position, rays.direction, fresnel=False)
        # the strip around the line; the line itself may be reached between two rays
        near = arrived.arrived & (np.abs(arrived.y) <= field.strip)
        near &= np.abs(arrived.x) <= mount.sensor.length / 2
        if near.any():
            paths.append(path(system, rays.position[:, near], rays.direction[:, near]))
    if not paths:
        return np.empty((len(surface_frames(system)) + 2, 3, 0))
    points = np.concatenate(paths, axis=2)
    start, first = points[:2]
    back = (first[2] - (mount.front - 10.0)) / (first[2] - start[2])
    points[0] = first + back * (start - first)
    return points


def first_hit(
    start: NDArray[np.float64], end: NDArray[np.float64], triangles: NDArray[np.float64]
) -> NDArray[np.float64]:
    """How far along segments the first triangle is met.

    Parameters
    ----------
    start, end : ndarray, shape (3, N)
    triangles : ndarray, shape (T, 3, 3)

    Returns
    -------
    ndarray, shape (N,)
        0 at the start to 1 at the end, infinite where none is met.
    """
    result = np.full(start.shape[1], np.inf)
    if not len(result):
        return result
    low = np.minimum(start.min(axis=1), end.min(axis=1))
    high = np.maximum(start.max(axis=1), end.max(axis=1))
    within = (triangles.max(axis=1) >= low) & (triangles.min(axis=1) <= high)
    triangles = triangles[within.all(axis=1)]
    if not len(triangles):
        return result
    corner = triangles[:, 0]
    first, second = triangles[:, 1] - corner, triangles[:, 2] - corner
    normal = np.cross(first, second)
    # Möller and Trumbore's test, its triple products as products of matrices
    for some in np.array_split(np.arange(len(result)), 1 + len(result) * len(corner) // 500_000):
        p, d = start[:, some], end[:, some] - start[:, some]
        moment = np.cross(p, d, axis=0)  # of the segment's line about the origin
        scale = -(normal @ d)
        with np.errstate(divide="ignore", invalid="ignore"):
            u = (second @ moment - np.cross(second, corner) @ d) / scale
            v = (np.cross(first, corner) @ d - first @ moment) / scale
            t = (normal @ p - (normal * corner).sum(axis=1)[:, None]) / scale
        hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (t >= 0) & (t <= 1)
        result[some] = np.where(hit, t, np.inf).min(axis=0)
    return result


def _blocked(points: NDArray[np.float64], triangles: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Whether rays (S, 3, N) meet the mount before the sensor's window."""
    blocked = np.zeros(points.shape[2], dtype=bool)
    for start, end in itertools.pairwise(points):
        blocked |= np.isfinite(first_hit(start, end, triangles))
    return blocked


def _light(mount: LensMount, triangles: NDArray[np.float64]) -> Iterator[Finding]:
    points = used_light(mount)
    if not points.shape[2]:
        yield Finding("light", "mount", "no light from the field reaches the pixel line")
    blocked = _blocked(points, triangles)
    if blocked.any():
        first = points[1][:, blocked.argmax()]
        yield Finding(
            "light",
            "mount",
            f"{blocked.sum()} of {len(blocked)} rays that the sensor would use meet it, such as "
            f"the one through x = {first[0]:.3g}, y = {first[1]:.3g} mm at the front",
        )


def _slit(mount: LensMount, triangles: NDArray[np.float64]) -> Iterator[Finding]:
    """Light that a screen of the design stops must meet the mount."""
    screens = [e for e in mount.system.elements if isinstance(e, Aperture)]
    if not screens:
        return
    elements = tuple(
        replace(e, x=math.inf, y=math.inf) if isinstance(e, Aperture) else e
        for e in mount.system.elements
    )
    points = used_light(mount, replace(mount.system, elements=elements))
    frames = surface_frames(mount.system)
    for number, (surface, _, _) in enumerate(frames):
        if not surface.screen:
            continue
        beside = points[number + 1][:2] - np.clip(
            points[number + 1][:2],
            *(sign * (np.array(surface.half)[:, None] + TOLERANCE) for sign in (-1, 1)),
        )
        stray = points[:, :, beside.any(axis=0)]
        passed = ~_blocked(stray, triangles)
        if passed.any():
            at = stray[number + 1][:, passed.argmax()]
            yield Finding(
                "slit",
                "mount",
                f"{passed.sum()} of {len(passed)} rays beside the slit pass, such as the one at "
                f"x = {at[0]:.3g} mm, {abs(at[0]) - surface.half[0]:.3g} mm beside its edge",
            )


def _holes(mount: LensMount, halves: Mapping[str, Manifold]) -> Iterator[Finding]:
    rules, board = mount.rules, mount.board
    if len(mount.screws) != 4:
        yield Finding("holes", "mount", f"{len(mount.screws)} screws clamp it, not 4")
    if len(board.holes) != 4:
        yield Finding("holes", "board", f"{len(board.holes)} holes, not 4")
    y = mount.half_size[1]
    for at in mount.screws:
        for half, (low, high) in {"lower": (-y, 0.0), "upper": (0.0, y)}.items():
            wrong = _hole(halves[half], "y", at, low, high, rules.screw_hole, rules.printable_wall)
            if wrong:
                where = f"x = {at[0]:.4g}, z = {at[1]:.4g} mm"
                yield Finding("holes", half, f"M3 hole at {where}: {wrong}")
    for at in board.holes:
        half = "lower" if at[1] < 0 else "upper"
        low, high = mount.face - rules.core_depth, mount.face
        wrong = _hole(halves[half], "z", at, low, high, rules.core_hole, rules.printable_wall)
        if wrong:
            where = f"x = {at[0]:.4g}, y = {at[1]:.4g} mm"
            yield Finding("holes", half, f"M2.5 hole at {where}: {wrong}")


def _hole(
    body: Manifold,
    axis: Axis,
    at: tuple[float, float],
    low: float,
    high: float,
    diameter: float,
    wall: float,
) -> str:
    """Return what is wrong with a hole: it has to be open, and plastic has to be around it."""
    bar = manifold(Cylinder(axis, at, low, high, diameter - 2 * TOLERANCE))
    filled = (bar ^ body).volume() / bar.volume()
    if filled > 1e-3:
        return f"{filled:.0%} of it is filled"
    around, hole = (
        manifold(Cylinder(axis, at, low, high, size)) for size in (diameter + 2 * wall, diameter)
    )
    missing = 1 - (around ^ body).volume() / (around.volume() - hole.volume())
    if missing > 1e-3:
        return f"{missing:.0%} of the {wall:g} mm around it are missing"
    return ""


def check_stand(stand: Stand) -> list[Finding]:
    """Say what is wrong with a motherboard: what `check_mount` does, as far as it applies.

    Parameters
    ----------
    stand : Stand
    """
    surfaces = {name: mesh(solid) for name, solid in stand.parts.items()}
    findings = list(_watertight(surfaces))
    if findings:
        return findings
    mount, rules = stand.mount, stand.rules
    bodies = {name: manifold_of(surface) for name, surface in surfaces.items()}
    others: dict[str, Solid] = {f"{half} half of the mount": s for half, s in mount.halves.items()}
    others |= {f"sensor's {name}": s for name, s in mount.board.parts(mount.face).items()}
    others |= {board.name: board.slab() for board in stand.boards}
    solids = bodies | {name: manifold(solid) for name, solid in others.items()}
    for (one, a), (other, b) in itertools.combinations(solids.items(), 2):
        if one in bodies and (shared := (a ^ b).volume()) > TOUCH:
            findings.append(Finding("collision", one, f"shares {shared:.3g} mm³ with {other}"))
    holes: list[tuple[str, str, tuple[float, float], float, float, float]] = []
    for board in stand.boards:
        y, depth = board.corner[1], rules["core_depth"]
        holes += [
            (board.part, f"M2.5 hole of the {board.name}", at, y - depth, y, rules["core_hole"])
            for at in board.centres()
        ]
    under = stand.under
    for x, z, foot in stand.foot_screws:
        depth = rules["core_depth"]
        holes += [
            ("base", f"M2.5 hole to the {foot}", (x, z), under, stand.top, rules["screw_hole"]),
            (foot, "M2.5 hole to the base", (x, z), under - depth, under, rules["core_hole"]),
        ]
    holes += [
        ("lens holder", "M3 hole", at, under - rules["plate"], under, mount.rules.screw_hole)
        for at in mount.screws
    ]
    wall = mount.rules.printable_wall
    for part, name, at, low, high, diameter in holes:
        if wrong := _hole(bodies[part], "y", at, low, high, diameter, wall):
            where = f"x = {at[0]:.4g}, z = {at[1]:.4g} mm"
            findings.append(Finding("holes", part, f"{name} at {where}: {wrong}"))
    return [*findings, *_walls(surfaces, wall)]


def check_led_mount(led: LedMount) -> list[Finding]:
    """Say what is wrong with an LED's mount.

    Parameters
    ----------
    led : LedMount
    """
    surfaces = {"LED mount": mesh(led.solid)}
    findings = list(_watertight(surfaces))
    if findings:
        return findings
    body, rules = manifold_of(surfaces["LED mount"]), led.rules
    height, wall = rules["plate"][1], mount_rules().printable_wall
    pole = manifold(Cylinder("z", (0.0, 0.0), 0.0, height, rules["pole"]))
    if (shared := (pole ^ body).volume()) > TOUCH:
        findings.append(Finding("collision", "LED mount", f"shares {shared:.3g} mm³ with the pole"))
    # turned by a little the pole is still met from everywhere but the slit
    inside = manifold(Cylinder("z", (0.0, 0.0), 0.0, height, rules["pole"] + 1.0)) - pole
    around = (inside ^ body).volume() / inside.volume()
    if not 0.5 < around < 1:
        findings.append(Finding("held", "LED mount", f"it surrounds {around:.0%} of the pole"))
    depth = rules["core_depth"]
    for at in led.screws:
        wrong = _hole(body, "y", at, led.plate, led.plate + depth, rules["core_hole"], wall)
        if wrong:
            findings.append(Finding("holes", "LED mount", f"M3 hole at x = {at[0]:g} mm: {wrong}"))
    thick = rules["slit"] / 2 + rules["ear"][0]
    for low, high in ((-thick, -rules["slit"] / 2), (rules["slit"] / 2, thick)):
        if wrong := _hole(body, "x", led.clamp, low, high, rules["screw_hole"], wall):
            findings.append(Finding("holes", "LED mount", f"M3 hole of the clamp: {wrong}"))
    return [*findings, *_walls(surfaces, wall)]


def _board(mount: LensMount, halves: Mapping[str, Manifold]) -> Iterator[Finding]:
    for (name, solid), (half, body) in itertools.product(
        mount.board.parts(mount.face).items(), halves.items()
    ):
        shared = (manifold(solid) ^ body).volume()
        if shared > TOUCH:
            yield Finding("board", half, f"shares {shared:.3g} mm³ with the {name}")
    off = mount.window - window_place(mount.system, mount.sensor)
    if abs(off) > TOLERANCE:
        yield Finding("board", "window", f"{off:+.3g} mm from where the lens system has it")


def _walls(surfaces: Mapping[str, Trimesh], least: float) -> Iterator[Finding]:
    """From points on every face go inward: a face that looks back must not come too soon."""
    for half, surface in surfaces.items():
        thickness, at = thinnest(surface, least)
        if thickness < least - TOLERANCE:
            place = ", ".join(f"{c:.3g}" for c in at)
            yield Finding(
                "wall",
                half,
                f"{thickness:.3g} mm thick at ({place}) mm; the least that prints is {least:g} mm",
            )


def thinnest(surface: Trimesh, beyond: float) -> tuple[float, NDArray[np.float64]]:
    """Return the thickness of the thinnest wall and a point on it.

    A wall is what lies between two faces that look away from each other, to 20°; wedges are none.

    Parameters
    ----------
    surface : Trimesh
        Watertight.
    beyond : float
        Thicker walls are not looked for, mm.
    """
    triangles, normals = np.asarray(surface.triangles), np.asarray(surface.face_normals)
    best, place = np.inf, np.zeros(3)
    directions, of = np.unique(normals.round(6), axis=0, return_inverse=True)
    for number, normal in enumerate(directions):
        points = np.einsum("pc,tcd->dtp", _SPREAD, triangles[of.ravel() == number]).reshape(3, -1)
        opposite = triangles[normals @ normal < -math.cos(math.radians(20))]
        if not len(opposite):
            continue
        depth = beyond * first_hit(points, points - beyond * normal[:, None], opposite)
        if depth.min() < best:
            best, place = float(depth.min()), points[:, depth.argmin()]
    return best, place


_SPREAD = np.array(
    [
        *((0.98, 0.01, 0.01), (0.01, 0.98, 0.01), (0.01, 0.01, 0.98)),
        *((0.49, 0.49, 0.02), (0.02, 0.49, 0.49), (0.49, 0.02, 0.49)),
        (1 / 3, 1 / 3, 1 / 3),
    ]
)
"""Points of a triangle, as weights of its corners: near them, near the edges' middles, centre."""
