"""The room's light in electrons, and what bad rooms are told."""

from __future__ import annotations

import numpy as np
import pytest

from raytransfer import TCD1304
from raytransfer.designs import DESIGNS
from raytransfer.irradiance import pixel_response
from twin.world import Led, Pose, World, two_leds


def test_the_default_room_is_the_documented_one() -> None:
    world = World()
    assert [led.position for led in world.leds] == [(-250, 0, 0), (250, 0, 0)]
    assert world.pose() == Pose(0, 1300, 0)
    assert world.ambient_rate() == 0
    assert not world.moving


def test_default_leds_leave_some_42000_electrons_in_25_us() -> None:
    rates = World().rates()
    assert 40_000 < rates[:2].max() * 25e-6 < 44_000
    assert not rates[2:].any()


def test_power_becomes_electrons() -> None:
    """By hand: W/sr times sr, over the photon's energy, times quantum efficiency."""
    led = Led(5, (0, 0, 0), power=1.0, wavelength=0.55)
    rates = World(leds=[led]).rates()[5]
    angles = pixel_response(World().head, (0, 0, 1300), wavelength=0.55)
    photon = 6.62607015e-34 * 299792458 / 550e-9
    assert rates == pytest.approx(angles / np.pi / photon * 0.8, rel=1e-9)


def test_leds_are_lambertian_and_dark_behind() -> None:
    led = Led(0, (0, 0, 0), power=np.pi)
    assert led.intensity(0, 1000, 0) == pytest.approx(1)
    assert led.intensity(1000, 1000, 0) == pytest.approx(np.sqrt(0.5))
    assert led.intensity(0, -1000, 0) == 0
    assert Led(0, (0, 0, 0), power=np.pi, facing=np.pi / 2).intensity(-5, 0, 0) == pytest.approx(1)


def test_turning_left_moves_the_spike_as_an_led_to_the_right_does() -> None:
    """Counter-clockwise seen from above, looking along −y: the line moves to optical +X."""
    still, turned = World().rates()[0], World(tracker=Pose(0, 1300, 0.1)).rates()[0]
    pixels = np.arange(TCD1304.pixels)
    moved = np.average(pixels, weights=turned) - np.average(pixels, weights=still)
    assert abs(moved) > 300
    led = World().leds[0]
    before = World().seen_from(led, Pose(0, 1300))[0]
    after = World().seen_from(led, Pose(0, 1300, 0.1))[0]
    assert np.sign(moved) == -np.sign(after - before)  # inverted image


def test_an_led_that_is_not_a_point_is_blurred() -> None:
    """2 mm are 5.5 px from 1.3 m; the light in all stays the same."""
    point, wide = (World(leds=[Led(0, (0, 0, 0), extent=e)]).rates()[0] for e in (0.0, 2.0))
    assert wide.sum() == pytest.approx(point.sum(), rel=1e-3)
    assert wide.max() < 0.8 * point.max()


def test_the_table_and_the_trace_give_the_same_light() -> None:
    """The former for a tracker that moves, the latter for one that stands."""
    pose = Pose(100, 1500)
    still, moving = World(tracker=pose).rates()[:2], World(tracker=lambda _: pose).rates()[:2]
    assert not np.array_equal(still, moving)
    difference = (moving - still)[still > 0]
    assert np.sqrt(np.mean(difference**2)) < 0.01 * still.max()
    assert moving.sum(axis=1) == pytest.approx(still.sum(axis=1), rel=2e-3)


def test_a_trajectory_is_followed() -> None:
    world = World(tracker=lambda seconds: Pose(100 * seconds, 1300))
    assert world.moving
    assert world.pose(2.0).x == 200
    assert not np.array_equal(world.rates(0.0), world.rates(1.0))


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (lambda: Led(64, (0, 0, 0)), "allowed are 0 to 63"),
        (lambda: Led(0, (0, 0)), "x, y and z"),  # type: ignore[arg-type]
        (lambda: Led(0, (0, np.nan, 0)), "finite"),
        (lambda: Led(0, (0, 0, 0), power=-1), "power"),
        (lambda: Led(0, (0, 0, 0), wavelength=630), "given in nm"),
        (lambda: Led(0, (0, 0, 0), extent=-1), "extent"),
        (lambda: World(leds=[*two_leds(), *two_leds()]), "each may be used once"),
        (lambda: World(ambient=-1), "ambient"),
        (lambda: Pose(0, np.inf), "finite"),
    ],
)
def test_a_wrong_room_is_refused(wrong: object, message: str) -> None:
    assert callable(wrong)
    with pytest.raises(ValueError, match=message):
        wrong()


def test_a_design_is_not_yet_a_head() -> None:
    with pytest.raises(TypeError, match=r"of a Design take \.system"):
        World(head=DESIGNS["thesis"])  # type: ignore[arg-type]
