"""The room's light in electrons, and what bad rooms are told."""

from __future__ import annotations

import itertools
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import pytest

from raytransfer import TCD1304
from raytransfer.designs import DESIGNS
from raytransfer.irradiance import LightTable, pixel_response
from twin.world import (
    Led,
    Mount,
    Occlusion,
    Pose,
    RandomOcclusions,
    Wall,
    World,
    two_leds,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray

SLIT = DESIGNS["slit-4mm"].system


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


# --- in space --------------------------------------------------------------------------------------


def test_axes_of_a_pose_are_as_documented() -> None:
    right, up, back = Pose(0, 0).rotation.T
    assert (right, up, back) == (
        pytest.approx([-1, 0, 0]),
        pytest.approx([0, 0, 1]),
        pytest.approx([0, 1, 0]),
    )
    rng = np.random.default_rng(3)
    for heading, pitch, roll in rng.uniform(-1.5, 1.5, (20, 3)):
        turned = Pose(0, 0, heading, 0, pitch, roll).rotation
        assert turned @ turned.T == pytest.approx(np.eye(3), abs=1e-12)
        assert np.linalg.det(turned) == pytest.approx(1)
    left = Pose(0, 0, heading=0.1).rotation
    assert -left[:, 2] == pytest.approx([np.sin(0.1), -np.cos(0.1), 0])  # looks to +x
    assert -Pose(0, 0, pitch=0.1).rotation[2, 2] == pytest.approx(np.sin(0.1))  # looks up
    assert Pose(0, 0, roll=0.1).rotation[2, 0] == pytest.approx(np.sin(0.1))  # right side up


def test_in_the_plane_space_changes_nothing() -> None:
    """The rotation of space and the formula of the plane see the same, the latter bit for bit."""
    led = Led(0, (-250, 10, 30))
    world = World(leds=[led])
    plain = world.seen_from(led, Pose(70, 1500, 0.2))
    assert plain == (
        float(-np.cos(0.2) * (-250 - 70.0) - np.sin(0.2) * (10 - 1500.0)),
        30.0,
        float(np.sin(0.2) * (-250 - 70.0) - np.cos(0.2) * (10 - 1500.0)),
    )
    general = World(leds=[led], mount=Mount(0.0, (0.0, 0.0, 1e-300)))
    assert general.seen_from(led, Pose(70, 1500, 0.2)) == pytest.approx(plain, abs=1e-9)


def test_a_tracker_that_rises_sees_leds_lower_and_nothing_else() -> None:
    led = two_leds()[1]
    low, high = (World().seen_from(led, Pose(0, 1300, 0.1, z=z)) for z in (0.0, 40.0))
    assert high == (low[0], low[1] - 40.0, low[2])
    plain, rates = (World(tracker=Pose(0, 1300, z=z)).rates()[:2] for z in (0.0, 100.0))
    raised = World(leds=[Led(k, (x, 0, -100.0)) for k, x in ((0, -250.0), (1, 250.0))])
    assert not np.array_equal(plain, rates)
    assert rates == pytest.approx(raised.rates()[:2])


def test_pitch_and_roll_move_leds_as_geometry_says() -> None:
    led = Led(0, (0, 0, 0))
    x, y, distance = World().seen_from(led, Pose(0, 1000, pitch=0.1))
    assert (x, y, distance) == pytest.approx((0, -1000 * np.sin(0.1), 1000 * np.cos(0.1)))
    left = Led(0, (-100, 0, 0))  # to the right of one who looks along −y
    x, y, _ = World().seen_from(left, Pose(0, 1000, roll=0.1))
    assert (x, y) == pytest.approx((100 * np.cos(0.1), -100 * np.sin(0.1)))


def test_a_perpendicular_head_sees_height_as_the_straight_one_sees_width() -> None:
    """A quarter turn of the mount, and the scene turned as much, is the same light."""
    wide = World(leds=[Led(0, (-200, 0, 50))], head=SLIT).rates()[0]
    turned = World(leds=[Led(0, (50, 0, 200))], head=SLIT, mount=Mount(np.pi / 2)).rates()[0]
    assert turned == pytest.approx(wide, abs=1e-9 * wide.max())


def test_a_head_beside_the_middle_sees_from_there() -> None:
    led = Led(0, (100, 0, 20))
    pose = Pose(10, 1500, 0.1, 5, 0.05, -0.03)
    beside = World(leds=[led], mount=Mount(0.0, (30.0, 60.0, -8.0)))
    x, y, z = (pose.x, pose.y, pose.z) + pose.rotation @ [30.0, 60.0, -8.0]
    there = World(leds=[led])
    moved = Pose(x, y, pose.heading, z, pose.pitch, pose.roll)
    assert beside.seen_from(led, pose) == pytest.approx(there.seen_from(led, moved))
    one, other = (
        w.rates()[0]
        for w in (
            World(leds=[led], tracker=pose, mount=beside.mount),
            World(leds=[led], tracker=moved),
        )
    )
    assert one == pytest.approx(other, rel=1e-9)


# --- what is out of sight costs nothing, and nothing else does -------------------------------------


def _there(pose: Pose, _: float) -> Pose:
    return pose


@pytest.mark.parametrize("name", ["slit-4mm", "thesis"])
def test_nothing_in_view_is_left_out(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Against tracing, for places around and beyond the edge of the view, at all heights."""

    def traced_anew(table: LightTable, place: tuple[float, float, float]) -> NDArray[np.float64]:
        return pixel_response(table.system, place, table.sensor, wavelength=table.wavelength)

    monkeypatch.setattr(LightTable, "solid_angles", traced_anew)
    rng = np.random.default_rng(7)
    head = DESIGNS[name].system
    dark = skipped = 0
    for _ in range(60):
        distance = 1 / rng.uniform(1 / 6000, 1 / 300)
        x, z = (
            rng.choice((-1, 1)) * rng.uniform(0.3, 1.2) * distance,
            rng.uniform(-0.6, 0.6) * distance,
        )
        led = Led(0, (x, 0, z), power=1.0)
        pose = Pose(0, distance)
        world = World(leds=[led], head=head, tracker=partial(_there, pose))
        lit = dict(world.lit())
        traced = pixel_response(head, world.seen_from(led, pose), wavelength=0.63)
        dark += not traced.any()
        skipped += not lit
        assert lit or not traced.any()
    assert 0.5 * dark < skipped <= dark


def test_light_of_a_moving_tracker_is_as_exact_where_the_spike_is_narrowest() -> None:
    """At 18 degrees the slit's spike is 4 px wide and the coarser lattice not good enough."""
    assert LightTable.STEPS[0] == 0.05
    for slope in np.linspace(0.26, 0.4, 15):
        led = Led(0, (slope * 2000, 0, 0))
        moving = World(leds=[led], head=SLIT, tracker=lambda _: Pose(0, 2000)).rates()[0]
        traced = World(leds=[led], head=SLIT, tracker=Pose(0, 2000)).rates()[0]
        pixels = np.arange(len(traced))
        assert np.abs(moving - traced).max() < 0.02 * traced.max()
        shift = pixels @ moving / moving.sum() - pixels @ traced / traced.sum()
        assert abs(shift) < 0.005


# --- reflections and occlusions --------------------------------------------------------------------


def test_a_wall_shows_an_image_of_an_led() -> None:
    """A mirror in x = 800: the image stands at 1600 − x and shines as the LED would from there."""
    led = Led(3, (100, 0, 20), power=2.0, facing=0.2)
    wall = Wall((800, -1000), (800, 5000), 0.25)
    image = wall.image(led)
    assert image.position == pytest.approx((1500, 0, 20))
    assert image.power == 0.5
    assert image.intensity(0, 2000, 0) == pytest.approx(0.25 * led.intensity(1600, 2000, 0))
    head = DESIGNS["thesis"].system
    tracker = Pose(300, 2000, heading=0.25)
    alone, with_wall = (
        World(leds=[led], tracker=tracker, head=head, walls=w).rates()[3] for w in ((), (wall,))
    )
    ghost = World(leds=[image], tracker=tracker, head=head).rates()[3]
    assert ghost.any()
    assert with_wall == pytest.approx(alone + ghost)


def test_images_are_seen_only_through_the_wall() -> None:
    wall = Wall((800, 500), (800, 1500), 0.5)
    image = wall.image(Led(0, (0, 0, 0)))
    assert wall.shows(image, 0, 2000)  # meets the wall at y = 1000
    assert not wall.shows(image, 0, 4000)  # would at 2000
    assert not wall.shows(image, 1000, 2000)  # from behind
    slanted = Wall((0, -100), (100, 0), 1.0)
    assert slanted.image(Led(0, (100, -100, 0))).position == pytest.approx((0, 0, 0))


def test_a_wall_hides_what_is_behind_it() -> None:
    """A screen 1 m before the LEDs, from x = 100 on; it need not reflect."""
    leds = [Led(0, (0, 0, 0)), Led(1, (300, 0, 50))]
    for reflectivity in (0.0, 0.5):
        screen = Wall((100, 1000), (900, 1000), reflectivity)
        lit = dict(World(leds, Pose(0, 2000), walls=[screen]).lit())
        assert sorted(lit) == [0]  # the way to LED 1 crosses y = 1000 at x = 150
        assert sorted(dict(World(leds, Pose(-200, 2000), walls=[screen]).lit())) == [0, 1]
    for turn in np.linspace(0, 1, 50):  # LEDs that are mounted on a wall are before it
        cos, sin = np.cos(turn), np.sin(turn)
        wall = Wall((-1000 * cos, -1000 * sin), (1000 * cos, 1000 * sin), 0.0)
        for along in (-250.0, 70.0, 250.0):
            led = Led(0, (along * cos, along * sin, 0), facing=turn)
            assert not wall.hides(led, -2000 * sin, 2000 * cos)


def test_a_wall_hides_reflections_too() -> None:
    """Light that goes from the LED at x = 0 to the mirror in x = 800, and from there to y = 2000."""
    led, mirror = Led(0, (0, 0, 0)), Wall((800, -1000), (800, 5000), 0.5)
    tracker = Pose(0, 2000, heading=0.35)  # the mirror is met at y = 1000

    def light(*screens: Wall) -> float:
        return float(World([led], tracker, head=SLIT, walls=[mirror, *screens]).rates()[0].sum())

    both = light()
    before, after = Wall((400, 400), (400, 600), 0.0), Wall((400, 1400), (400, 1600), 0.0)
    beyond = Wall((1200, 400), (1200, 600), 0.0)  # only the image's way to the mirror crosses it
    direct = light(before)
    assert 0 < direct < both
    assert light(after) == direct
    assert light(beyond) == both
    straight = Wall((-50, 1000), (50, 1000), 0.0)
    assert light(straight) == pytest.approx(both - direct)
    assert light(straight, after) == 0


def test_the_ghost_moves_with_the_tracker() -> None:
    walls = [Wall((350, -1000), (350, 5000), 0.3)]
    led = Led(0, (0, 0, 0), power=1.0)

    def along_x(seconds: float) -> Pose:
        return Pose(seconds, 2500)

    mirrored = World([led], along_x, head=SLIT, walls=walls)
    alone = World([led], along_x, head=SLIT)
    pixels = np.arange(TCD1304.pixels)
    for x in (-150.0, 0.0, 150.0):
        direct = alone.rates(x)[0]
        ghost = mirrored.rates(x)[0] - direct
        assert ghost.sum() == pytest.approx(0.3 * direct.sum(), rel=0.3)
        apart = pixels @ ghost / ghost.sum() - pixels @ direct / direct.sum()
        assert apart == pytest.approx(700 / 2500 * 4244, rel=0.1)  # and distortion


def test_hidden_leds_are_dark_and_come_back() -> None:
    world = World(occlusions=[Occlusion(1.0, 2.0, [0]), Occlusion(1.5, 3.0)])
    assert world.changing
    assert not world.moving
    lit = {t: sorted(dict(world.lit(t))) for t in (0.0, 1.0, 1.5, 2.0, 3.0)}
    assert lit == {0.0: [0, 1], 1.0: [1], 1.5: [], 2.0: [], 3.0: [0, 1]}
    asked = World(occlusions=lambda seconds: [1] if seconds < 1 else [])
    assert sorted(dict(asked.lit(0.5))) == [0]
    assert sorted(dict(asked.lit(1.5))) == [0, 1]


def test_chance_hides_the_share_asked_for_and_the_same_with_the_same_seed() -> None:
    hidden = RandomOcclusions(0.2, 0.5, seed=4)
    times = np.arange(0, 500, 0.5) + 0.1
    counts = np.zeros(64)
    for seconds in times:
        counts[list(hidden(seconds))] += 1
    assert counts.mean() / len(times) == pytest.approx(0.2, abs=0.005)
    assert 0.1 < counts.min() / len(times) < counts.max() / len(times) < 0.3
    assert hidden(0.1) == hidden(0.4) == RandomOcclusions(0.2, 0.5, seed=4)(0.2)
    assert hidden(0.1) != RandomOcclusions(0.2, 0.5, seed=5)(0.1)
    assert hidden(-0.1) == hidden(-0.4)  # also before the beginning


def test_equal_worlds_give_equal_light() -> None:
    def world() -> World:
        return World(
            [Led(k, (300.0 * k - 600, 0, 0)) for k in range(5)],
            lambda s: Pose(100 * s, 2000, 0.1 * s, 10 * s, 0.02 * s, 0.01 * s),
            head=SLIT,
            walls=[Wall((900, -100), (900, 3000), 0.2)],
            occlusions=RandomOcclusions(0.3),
        )

    for one, other in itertools.pairwise([world(), world(), world()]):
        assert np.array_equal(one.rates(1.3), other.rates(1.3))


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (lambda: Led(64, (0, 0, 0)), "allowed are 0 to 63"),
        (lambda: Led(1.5, (0, 0, 0)), "whole numbers"),  # type: ignore[arg-type]
        (lambda: Led(True, (0, 0, 0)), "whole numbers"),
        (lambda: Led("1", (0, 0, 0)), "whole numbers"),  # type: ignore[arg-type]
        (lambda: Occlusion(0.0, 1.0, [1.5]), "whole numbers"),  # type: ignore[list-item]
        (lambda: Led(0, (0, 0, 0), facing=45), "facing = 45 rad.*in degrees"),
        (lambda: Pose(0, 0, 90), "heading = 90 rad.*in degrees"),
        (lambda: Pose(0, 0, pitch=10), "pitch = 10 rad.*in degrees"),
        (lambda: Pose(0, 0, roll=-10), "roll = -10 rad.*in degrees"),
        (lambda: Mount(90), "in degrees"),
        (lambda: Led(0, (0, 0)), "x, y and z"),  # type: ignore[arg-type]
        (lambda: Led(0, (0, np.nan, 0)), "finite"),
        (lambda: Led(0, (0, 0, 0), power=-1), "power"),
        (lambda: Led(0, (0, 0, 0), wavelength=630), "given in nm"),
        (lambda: Led(0, (0, 0, 0), extent=-1), "extent"),
        (lambda: World(leds=[*two_leds(), *two_leds()]), "each may be used once"),
        (lambda: World(ambient=-1), "ambient"),
        (lambda: Pose(0, np.inf), "finite"),
        (lambda: Pose(0, 0, pitch=np.nan), "finite"),
        (lambda: Mount(np.inf), "finite"),
        (lambda: Mount(0, (1, 2)), "right, up and backward"),  # type: ignore[arg-type]
        (lambda: Wall((0, 0), (0, 0), 0.5), "no direction"),
        (lambda: Wall((0, 0), (1, 0), 5), r"in %\?"),
        (lambda: Wall((0, 0, 1), (1, 0), 0.5), "room x and y"),  # type: ignore[arg-type]
        (lambda: Occlusion(2.0, 1.0), "ends before it begins"),
        (lambda: Occlusion(0.0, 1.0, [64]), "allowed are 0 to 63"),
        (lambda: RandomOcclusions(20), r"in %\?"),
        (lambda: RandomOcclusions(0.1, 0), "duration"),
        (lambda: RandomOcclusions(0.1, seed=-1), "seed"),
    ],
)
def test_a_wrong_room_is_refused(wrong: object, message: str) -> None:
    assert callable(wrong)
    with pytest.raises(ValueError, match=message):
        wrong()


def test_a_design_is_not_yet_a_head() -> None:
    with pytest.raises(TypeError, match=r"of a Design take \.system"):
        World(head=DESIGNS["thesis"])  # type: ignore[arg-type]
