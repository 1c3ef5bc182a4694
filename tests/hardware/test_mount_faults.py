"""Faults put into a good mount on purpose: each is found, and by the check that is meant for it."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from hardware.checks import CHECKS, check_mount
from hardware.mesh import mesh
from hardware.mount import LensMount, lens_mount, mount_rules, sensor_board
from hardware.solids import Box, Cylinder, Difference, Placed, Solid, Union
from raytransfer.designs import DESIGNS
from raytransfer.lenses import Aperture

if TYPE_CHECKING:
    from collections.abc import Callable

RULES, BOARD = mount_rules(), sensor_board()


@lru_cache
def good(name: str = "thesis") -> LensMount:
    return lens_mount(DESIGNS[name].system)


def with_more(part: Solid, half: str = "lower") -> LensMount:
    """Return the thesis's mount with plastic where none belongs."""
    changed: dict[str, Any] = {half: Union((good().halves[half], part))}
    return replace(good(), **changed)


def with_less(part: Solid, half: str = "lower") -> LensMount:
    changed: dict[str, Any] = {half: Difference(good().halves[half], (part,))}
    return replace(good(), **changed)


def colliding_lenses() -> LensMount:
    """The pair is 0.17 mm apart; one of them 0.3 mm off its place."""
    first, second, *others = good().lenses[1:]
    moved = replace(first, glass=Placed(first.glass, (0.0, 0.0, 0.3)))
    return replace(good(), lenses=(good().lenses[0], moved, second, *others))


def pocket_after_a_concave_shape() -> LensMount:
    """The pocket's ends follow the hollow side of the lens: nothing collides, none gets in."""
    lens = good().lenses[0]
    low, _ = lens.box
    ends = tuple(Box((x - 1.2, -7.0, low), (x + 1.2, 0.0, low + 3.2)) for x in (-14.0, 14.0))
    room = Placed(lens.glass, (0.0, 0.0, -RULES.axial_clearance))
    return with_more(Difference(Union(ends), (room, lens.glass)))


def blocked_light() -> LensMount:
    return with_more(Box((-1.0, -17.0, 20.0), (1.0, 0.0, 22.0)))


def narrow_bore() -> LensMount:
    """Walls of the bore come in to |x| = 9 behind the pair: light from the field's edge is cut."""
    return with_more(Box((9.0, -17.0, 20.0), (16.0, 0.0, 22.0)))


def no_light() -> LensMount:
    """A strip so narrow that no ray that is tried ends in it: nothing was checked."""
    field = replace(RULES.field, strip=1e-9, across=11.9)
    return replace(good("slit-f50-f100"), rules=replace(RULES, field=field))


def missing_clamp_hole() -> LensMount:
    (x, z), *_ = good().screws
    return with_more(Cylinder("y", (x, z), -22.5, 0.0, 4.0))


def blind_clamp_hole() -> LensMount:
    """Open at one end only."""
    (x, z), *_ = good().screws
    return with_more(Cylinder("y", (x, z), -22.5, -20.0, 4.0))


def three_screws() -> LensMount:
    return replace(good(), screws=good().screws[:3])


def missing_board_hole() -> LensMount:
    (x, y), *_ = good().board.holes
    face = good().face
    return with_more(Cylinder("z", (x, y), face - 10, face, 3.0))


def displaced_board_hole() -> LensMount:
    """The board has one hole 0.5 mm beside where the mount was made for."""
    (x, y), *others = BOARD.holes
    return replace(good(), board=replace(BOARD, holes=((x + 0.5, y), *others)))


def other_board() -> LensMount:
    """The mount is for a board with holes nearer to its middle; the board lacks two of them."""
    return replace(good(), board=replace(BOARD, holes=BOARD.holes[:2]))


def no_relief_for_sockets() -> LensMount:
    """Made as if the sensor lay on the board by itself, in no sockets."""
    length, _, width, height = BOARD.sockets
    narrow = replace(BOARD, sockets=(length, 0.0, width, height), package=(30.0, 3.0, 3.22))
    return replace(lens_mount(good().system, board=narrow), board=BOARD)


def no_relief_for_joints() -> LensMount:
    flat = lens_mount(good().system, board=replace(BOARD, joint_height=0.01))
    return replace(flat, board=BOARD)


def sensor_too_deep() -> LensMount:
    """Sockets 0.5 mm lower than the ones it was made for: the window is that much off."""
    length, rows, width, height = BOARD.sockets
    lower = replace(BOARD, sockets=(length, rows, width, height - 0.5))
    return replace(good(), board=lower)


def mount_for_a_slit(width: float) -> LensMount:
    """Return the mount for a slit of another width than the design's 8.95 mm."""
    design = good("slit-f50-f100").system
    elements = tuple(replace(e, x=width) if isinstance(e, Aperture) else e for e in design.elements)
    return replace(lens_mount(replace(design, elements=elements)), system=design)


def wrong_outer_dimension() -> LensMount:
    x, y = good().half_size
    return with_more(Box((x - 1, -y + 2, 0.0), (x + 0.2, -2.0, 20.0)))


def too_short() -> LensMount:
    """Half a millimetre is missing at the front."""
    x, y = good().half_size
    front = good().front
    return with_less(Box((-x - 1, 0.0, front - 1), (x + 1, y + 1, front + 0.5)), "upper")


def thin_wall() -> LensMount:
    thin = lens_mount(good().system, rules=replace(RULES, front_wall=0.8))
    return replace(thin, rules=RULES)


def loose_lens() -> LensMount:
    """Half a millimetre of room on both sides of each lens."""
    loose = lens_mount(good().system, rules=replace(RULES, axial_clearance=0.5))
    return replace(loose, rules=RULES)


def missing_ledge() -> LensMount:
    """One half lacks its ledges behind the concave lens and the pair's first."""
    lens = good().lenses[2]
    x, y = lens.half
    return with_less(Box((-x, -y, lens.box[1]), (x, 0.0, lens.box[1] + 1.0)))


def tight_pocket() -> LensMount:
    tight = lens_mount(good().system, rules=replace(RULES, lateral_clearance=-0.2))
    return replace(tight, rules=RULES)


def halves_that_overlap() -> LensMount:
    return with_more(Box((-22.0, -1.0, 25.0), (-21.0, 0.04, 30.0)))


def half_in_two_pieces() -> LensMount:
    z = good().front + 20
    return with_less(Box((-30.0, -30.0, z), (30.0, 1.0, z + 1)))


FAULTS: list[tuple[Callable[[], LensMount], str]] = [
    (colliding_lenses, "collision"),
    (tight_pocket, "collision"),
    (halves_that_overlap, "collision"),
    (pocket_after_a_concave_shape, "insertable"),
    (blocked_light, "light"),
    (narrow_bore, "light"),
    (no_light, "light"),
    (missing_clamp_hole, "holes"),
    (blind_clamp_hole, "holes"),
    (three_screws, "holes"),
    (missing_board_hole, "holes"),
    (displaced_board_hole, "holes"),
    (other_board, "holes"),
    (no_relief_for_sockets, "board"),
    (no_relief_for_joints, "board"),
    (sensor_too_deep, "board"),
    (lambda: mount_for_a_slit(7.0), "light"),
    (lambda: mount_for_a_slit(11.0), "slit"),
    (lambda: mount_for_a_slit(math.inf), "slit"),
    (wrong_outer_dimension, "outer dimensions"),
    (too_short, "outer dimensions"),
    (thin_wall, "wall"),
    (loose_lens, "held"),
    (missing_ledge, "held"),
    (half_in_two_pieces, "watertight"),
]

# what goes wrong as well where one thing is wrong
ALSO = {
    "colliding_lenses": {"held", "insertable"},
    "halves_that_overlap": {"wall"},
    "pocket_after_a_concave_shape": {"light"},
    "missing_ledge": {"wall"},
    "tight_pocket": {"insertable"},
    "no_relief_for_sockets": {"light"},
    "thin_wall": {"outer dimensions"},
    "too_short": {"wall"},
}


@pytest.mark.parametrize(
    ("fault", "check"), FAULTS, ids=[f"{i}-{f.__name__}" for i, (f, _) in enumerate(FAULTS)]
)
def test_every_fault_is_found_by_its_check(fault: Callable[[], LensMount], check: str) -> None:
    findings = check_mount(fault())
    found = {finding.check for finding in findings}
    print(*findings, sep="\n")
    assert check in found
    assert found <= {check} | ALSO.get(fault.__name__, set())


def test_every_check_has_a_fault() -> None:
    assert {check for _, check in FAULTS} == set(CHECKS)


def test_a_mesh_with_a_gap_is_found() -> None:
    surfaces = {half: mesh(solid) for half, solid in good().halves.items()}
    surfaces["upper"].update_faces(np.arange(len(surfaces["upper"].faces)) != 7)
    (finding,) = check_mount(good(), surfaces)
    assert (finding.check, finding.where) == ("watertight", "upper")


def test_a_mesh_turned_inside_out_is_found() -> None:
    surfaces = {half: mesh(solid) for half, solid in good().halves.items()}
    surfaces["lower"].invert()
    (finding,) = check_mount(good(), surfaces)
    assert (finding.check, finding.where) == ("watertight", "lower")


def test_a_mesh_in_inches_is_found() -> None:
    surfaces = {half: mesh(solid) for half, solid in good().halves.items()}
    for surface in surfaces.values():
        surface.vertices = surface.vertices / 25.4
    found = {finding.check for finding in check_mount(good(), surfaces)}
    assert {"outer dimensions", "held", "holes"} <= found
