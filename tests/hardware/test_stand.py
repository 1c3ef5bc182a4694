"""The motherboard and the LED's mount: good ones pass, faults put in on purpose are found."""

from __future__ import annotations

import copy
from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from hardware.checks import check_led_mount, check_stand
from hardware.mesh import bounds, manifold
from hardware.mount import lens_mount, mechanics
from hardware.solids import Box, Cylinder, Difference, Union
from hardware.stand import LedMount, Stand, led_mount, stand
from raytransfer.designs import DESIGNS

if TYPE_CHECKING:
    from collections.abc import Callable

    from hardware.solids import Solid

DATA = mechanics()


@lru_cache
def good(name: str = "thesis") -> Stand:
    return stand(lens_mount(DESIGNS[name].system))


def with_part(name: str, part: Solid) -> Stand:
    return replace(good(), parts={**good().parts, name: part})


@pytest.mark.parametrize("name", DESIGNS)
def test_good_stands_pass_every_check(name: str) -> None:
    assert check_stand(good(name)) == []


def test_it_is_the_thesis_motherboard() -> None:
    """Section 4.4.1: four parts, seven M2.5 for the two computers, feet on M2.5."""
    assert len(good().parts) == 4
    computers = [board for board in good().boards if board.part == "base"]
    assert sum(len(board.holes) for board in computers) == 7
    assert {foot for _, _, foot in good().foot_screws} == set(good().parts) - {"base"}


def test_boards_lie_as_they_are() -> None:
    """Holes of the Raspberry Pi on 58 × 49; the Nucleo's on the Arduino's grid; none mirrored."""
    pi, nucleo, _ = good().boards
    x, z = np.transpose(pi.centres())
    assert sorted({*x.round(6)}) == pytest.approx([x.min(), x.min() + 49])
    assert sorted({*z.round(6)}) == pytest.approx([z.min(), z.min() + 58])
    a, b, c = np.array(nucleo.centres())
    assert b - a == pytest.approx([48.26, 1.27])
    assert c - a == pytest.approx([33.02, 52.07])
    # from above, z points down the page where x points right: a turn, not a mirror image
    first, second, third = (np.array(hole) for hole in nucleo.holes)
    on_board = np.linalg.det([second - first, third - first])
    assert np.linalg.det([(b - a) * [1, -1], (c - a) * [1, -1]]) == pytest.approx(on_board)
    inside = np.array(nucleo.size) - nucleo.holes
    assert inside.min() > 1.6


def test_the_head_stands_on_its_holder() -> None:
    """Its lower side is where the plate is, and the whole stands on one level."""
    head = good().mount
    assert good().under == pytest.approx(-head.half_size[1])
    feet = {name: part for name, part in good().parts.items() if name != "base"}
    lows = [bounds(part)[0, 1] for part in feet.values()]
    assert lows == pytest.approx([lows[0]] * 3)
    holder = manifold(good().parts["lens holder"])
    assert (manifold(head.lower).translate([0, -0.01, 0]) ^ holder).volume() > 1.0


def filled(name: str, at: tuple[float, float]) -> Stand:
    low, high = bounds(good().parts[name])[:, 1]
    return with_part(name, Union((good().parts[name], Cylinder("y", at, low, high, 4.0))))


def moved_hole(name: str) -> Stand:
    """One hole of a board is 1 mm beside its post."""
    boards = tuple(
        replace(b, holes=((b.holes[0][0] + 1, b.holes[0][1]), *b.holes[1:]))
        if b.name == name
        else b
        for b in good().boards
    )
    return replace(good(), boards=boards)


def low_post() -> Stand:
    """Posts of the base are 1 mm too high: they reach into the boards."""
    data = copy.deepcopy(DATA)
    data["stand"]["post"] += 1.0
    return replace(stand(good().mount, data), boards=good().boards)


def no_room_behind_the_head() -> Stand:
    data = copy.deepcopy(DATA)
    data["stand"]["behind_head"] = 0.5
    return stand(good().mount, data)


def thin_plate() -> Stand:
    data = copy.deepcopy(DATA)
    data["stand"]["rib"] = 1.0
    return stand(good().mount, data)


def broken_leg() -> Stand:
    low, high = bounds(good().parts["foot"])
    middle = (low + high) / 2
    cut = Box((middle[0] - 1, low[1] - 1, low[2] - 1), (middle[0] + 1, high[1] + 1, high[2] + 1))
    return with_part("foot", Difference(good().parts["foot"], (cut,)))


def other_head() -> Stand:
    """The holder was made for another head, whose screws are elsewhere."""
    return replace(good(), mount=good("slit-4mm").mount)


@pytest.mark.parametrize(
    ("fault", "check"),
    [
        (lambda: filled("base", good().foot_screws[0][:2]), "holes"),
        (lambda: filled("foot", good().foot_screws[2][:2]), "holes"),
        (lambda: filled("lens holder", good().mount.screws[1]), "holes"),
        (lambda: moved_hole("raspberry_pi"), "holes"),
        (lambda: moved_hole("nucleo"), "holes"),
        (lambda: moved_hole("led_control"), "holes"),
        (other_head, "holes"),
        (low_post, "collision"),
        (no_room_behind_the_head, "collision"),
        (thin_plate, "wall"),
        (broken_leg, "watertight"),
    ],
)
def test_faults_are_found(fault: Callable[[], Stand], check: str) -> None:
    findings = check_stand(fault())
    print(*findings, sep="\n")
    assert check in {finding.check for finding in findings}


def test_led_mount() -> None:
    """A pole of 14.1 mm and two M3: section 4.4.1. The clamp closes the bore around the pole."""
    led = led_mount()
    assert check_led_mount(led) == []
    rules = DATA["led_mount"]
    assert rules["pole"] == 14.1
    assert len(led.screws) == 2
    low, high = bounds(led.solid)
    assert high[0] - low[0] == pytest.approx(rules["plate"][0], abs=0.05)
    assert (low[1], high[2]) == pytest.approx((led.plate, rules["plate"][1]))
    # what of the bore's circumference is cut by the slit, closed, is more than its clearance
    assert rules["slit"] > np.pi * rules["clearance"]


def changed(**changes: Any) -> dict[str, Any]:
    data = copy.deepcopy(DATA)
    data["led_mount"] |= changes
    return data


@pytest.mark.parametrize(
    ("fault", "check"),
    [
        (lambda: replace(led_mount(changed(pole=13.0)), rules=DATA["led_mount"]), "collision"),
        (lambda: replace(led_mount(changed(pole=16.0)), rules=DATA["led_mount"]), "held"),
        (lambda: led_mount(changed(hole_distance=28.0)), "holes"),
        (lambda: replace(led_mount(changed(core_hole=1.0)), rules=DATA["led_mount"]), "holes"),
        (lambda: replace(led_mount(changed(ear=[0.8, 9.0])), rules=DATA["led_mount"]), "holes"),
        (lambda: led_mount(changed(wall=0.9)), "wall"),
        (
            lambda: replace(
                led_mount(),
                solid=Difference(led_mount().solid, (Box((-20, -20, 10), (20, 30, 12)),)),
            ),
            "watertight",
        ),
    ],
)
def test_faults_of_led_mounts_are_found(fault: Callable[[], LedMount], check: str) -> None:
    findings = check_led_mount(fault())
    print(*findings, sep="\n")
    assert check in {finding.check for finding in findings}
