"""Room files: what they give, what wrong ones are told, and the link that takes them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from acquisition.links import LinkUnavailable
from raytransfer.designs import DESIGNS, save_design
from tracking.leds import LedMap
from twin.link import open_twin
from twin.rooms import ROOMS, Tour, load_room
from twin.world import Led, Mount, Occlusion, Pose, RandomOcclusions, Wall, World

if TYPE_CHECKING:
    from pathlib import Path

PLAIN = """
format = "linetrack room"
version = 1
name = "plain"
head = "slit-4mm"
{more}
[tracker]
{tracker}
[[led]]
channel = 4
position = [-250.0, 0.0, 10.0]
[[led]]
channel = 2
position = [250, 0, 0]
power = 0.5
facing = 0.1
"""
FIXED = 'path = "fixed"\nposition = [0.0, 2000.0]'


def room_file(folder: Path, more: str = "", tracker: str = FIXED) -> Path:
    path = folder / "room.toml"
    path.write_text(PLAIN.format(more=more, tracker=tracker), encoding="utf-8")
    return path


def test_rooms_of_the_package() -> None:
    assert set(ROOMS) >= {"thesis", "walk"}
    for name in ROOMS:
        room = load_room(name)
        assert room.name == name
        assert len(room.world.leds) == len(room.nominal)


def test_the_thesiss_room_is_the_default_one() -> None:
    room, default = load_room("thesis"), World()
    assert room.world == default
    assert room.seed == 1304


def test_the_walk_keeps_its_promises() -> None:
    """At most 1 m/s, between 1.3 and 4.15 m, LEDs half a metre apart, two or more in view."""
    world = load_room("walk").world
    assert world.head == DESIGNS["slit-4mm"].system
    times = np.arange(0, 120, 0.02)
    poses = np.array([(p.x, p.y, p.heading) for p in map(world.pose, times)])
    speed = np.linalg.norm(np.diff(poses[:, :2], axis=0), axis=1) / 0.02
    assert 0.9e3 < speed.max() <= 1e3
    assert poses[:, 1].min() == pytest.approx(1300, abs=5)
    assert poses[:, 1].max() == pytest.approx(4150, abs=5)
    seen = []
    for pose in map(world.pose, times[::50]):
        places = np.array([world.seen_from(led, pose) for led in world.leds])
        seen.append((np.abs(places[:, 0] / places[:, 2]) < 0.45).sum())
    assert min(seen) >= 2
    assert np.diff(sorted(led.position[0] for led in load_room("walk").nominal)) == pytest.approx(
        500
    )


def test_a_tracker_is_told_where_leds_should_be_not_where_they_are(tmp_path: Path) -> None:
    room = load_room(room_file(tmp_path, "placement_error = 0.5\nseed = 3"))
    told = LedMap(*room.known_leds())
    assert told.channels == (4, 2)
    assert told.positions.tolist() == [[-250, 0, 10], [250, 0, 0]]
    assert told.facings.tolist() == [0, 0.1]
    off = np.array([led.position for led in room.world.leds]) - told.positions
    assert 0.1 < off.std() < 1.0
    again = load_room(room_file(tmp_path, "placement_error = 0.5\nseed = 3"))
    other = load_room(room_file(tmp_path, "placement_error = 0.5\nseed = 4"))
    assert again.world.leds == room.world.leds != other.world.leds
    exact = load_room(room_file(tmp_path))
    assert list(exact.world.leds) == list(exact.nominal)


def test_all_that_a_room_may_say(tmp_path: Path) -> None:
    save_design(DESIGNS["thesis"].system, tmp_path / "own.toml")
    text = PLAIN.replace('head = "slit-4mm"', 'head = "own.toml"').format(
        tracker=FIXED + "\nheading = 0.1\npitch = 0.02\nroll = -0.03",
        more="""
notes = "all of it"
seed = 7
ambient = 120
every_led = { power = 0.2, wavelength = 0.85, extent = 1.0 }
mount = { roll = 1.5, offset = [0, 60, 0] }
wall = [{ start = [900, 0], end = [900, 3000], reflectivity = 0.1 }]
occlusion = [{ begin = 1.0, end = inf, channels = [4] }, { begin = 2, end = 3 }]
""",
    )
    path = tmp_path / "full.toml"
    path.write_text(text, encoding="utf-8")
    room = load_room(path)
    assert (room.notes, room.seed) == ("all of it", 7)
    assert room.world == World(
        leds=[
            Led(4, (-250, 0, 10), 0.2, 0.85, 0.0, 1.0),
            Led(2, (250, 0, 0), 0.5, 0.85, 0.1, 1.0),
        ],
        tracker=Pose(0, 2000, 0.1, 0, 0.02, -0.03),
        ambient=120,
        head=DESIGNS["thesis"].system,
        mount=Mount(1.5, (0, 60, 0)),
        walls=[Wall((900, 0), (900, 3000), 0.1)],
        occlusions=[Occlusion(1.0, np.inf, [4]), Occlusion(2, 3)],
    )


def test_chance_in_a_room_has_the_rooms_seed(tmp_path: Path) -> None:
    room = load_room(room_file(tmp_path, "seed = 9\nrandom_occlusions = { share = 0.1 }"))
    assert room.world.occlusions == RandomOcclusions(0.1, seed=9)


def test_ways_through_the_room(tmp_path: Path) -> None:
    def tour(text: str) -> Tour:
        tracker = load_room(room_file(tmp_path, tracker=text)).world.tracker
        assert isinstance(tracker, Tour)
        return tracker

    def speed(way: Tour, times: np.ndarray) -> float:
        poses = np.array([(p.x, p.y, p.z) for p in map(way, times)])
        return float(np.linalg.norm(np.diff(poses, axis=0), axis=1).max() / (times[1] - times[0]))

    line = tour('path = "line"\nstart = [-500, 2000]\nend = [500, 2000, 100]\nspeed = 800')
    assert (line(0.0).x, line(0.0).z) == (-500, 0)
    assert line(np.pi / 2 * np.hypot(1000, 100) / 800).x == pytest.approx(500)
    assert speed(line, np.arange(0, 4, 1e-3)) == pytest.approx(800, rel=1e-3)

    circle = tour('path = "circle"\ncentre = [0, 2500]\nradius = 300\nspeed = 600')
    there = circle(np.pi / 4)
    assert (there.x, there.y) == pytest.approx((0, 2800))
    assert speed(circle, np.arange(0, 4, 1e-3)) == pytest.approx(600, rel=1e-3)

    swing = tour(
        'path = "lissajous"\ncentre = [0, 2500]\namplitude = [100, 0, 50]\nfrequency = [1, 0, 2]\n'
        "phase = [0.0, 0.0, 1.5]\nheading = { amplitude = 0.2, frequency = 0.5, mean = 0.1 }\n"
        "pitch = 0.05"
    )
    there = swing(0.25)
    assert (there.x, there.y) == pytest.approx((100, 2500))
    assert there.z == pytest.approx(50 * np.sin(np.pi + 1.5))
    assert there.heading == pytest.approx(0.1 + 0.2 * np.sin(np.pi / 4))
    assert there.pitch == 0.05

    way = tour(
        'path = "waypoints"\ntimes = [1, 2, 4]\npoints = [[0, 2000], [100, 2500], [0, 3000]]'
    )
    through = np.array([(way(t).x, way(t).y) for t in (0, 1, 2, 4, 9)])
    expected = np.array([(0, 2000), (0, 2000), (100, 2500), (0, 3000), (0, 3000)])
    assert through == pytest.approx(expected)
    assert abs(way(1.001).y - 2000) < 0.01  # begins at rest
    assert abs(way(3.999).y - 3000) < 0.01

    turning = tour(FIXED + "\nheading = { amplitude = 0.1, frequency = 1.0 }")
    assert turning(0.25).heading == pytest.approx(0.1)


@pytest.mark.parametrize(
    ("more", "tracker", "message"),
    [
        ("colour = 3", FIXED, "unknown: colour; known are"),
        ("seed = -1", FIXED, "whole numbers from 0 on"),
        ("ambient = -5", FIXED, "ambient"),
        ("placement_error = -1", FIXED, "placement_error"),
        ("every_led = { channel = 1 }", FIXED, "every_led, unknown: channel"),
        ("wall = [{ start = [0, 0], end = [1, 0] }]", FIXED, "wall 1, missing: reflectivity"),
        (
            "wall = [{ start = [0, 0], end = [1, 0], reflectivity = 7 }]",
            FIXED,
            "wall 1, reflectivity = 7",
        ),
        ("occlusion = [{ begin = 2, end = 1 }]", FIXED, "occlusion 1, .*ends before"),
        ("random_occlusions = { share = 0.1 }\nocclusion = []", FIXED, "one of them"),
        ("mount = { offset = [1, 2] }", FIXED, "mount, offset"),
        ("", 'path = "spiral"', "tracker, path = 'spiral': known are fixed, line, circle"),
        ("", 'path = "fixed"', "tracker, missing: position"),
        ("", 'path = "fixed"\nposition = [1]', "two or three coordinates"),
        ("", 'path = "line"\nstart = [0, 1]\nend = [0, 1]\nspeed = 1', "tracker, .*differ"),
        ("", 'path = "line"\nstart = [0, 1]\nend = [0, 2]\nspeed = 0', "speed"),
        ("", 'path = "circle"\ncentre = [0, 1]\nradius = -1\nspeed = 1', "radius"),
        ("", 'path = "waypoints"\ntimes = [1, 1]\npoints = [[0, 1], [0, 2]]', "later"),
        ("", 'path = "waypoints"\ntimes = [1]\npoints = [[0, 1]]', "2 or more"),
        ("", FIXED + '\nheading = "north"', "heading"),
        ("", FIXED + "\nheading = { amplitude = 1.0 }", "heading, missing: frequency"),
        ("", FIXED + "\nspeed = 3", "tracker, unknown: speed"),
    ],
)
def test_wrong_rooms_are_told_where_and_why(
    tmp_path: Path, more: str, tracker: str, message: str
) -> None:
    path = room_file(tmp_path, more, tracker)
    with pytest.raises(ValueError, match=rf"(?s)room\.toml: .*{message}"):
        load_room(path)


@pytest.mark.parametrize(
    ("before", "after", "message"),
    [
        ('format = "linetrack room"', 'format = "linetrack design"', "no room file"),
        ("version = 1", "version = 2", "written by a later one"),
        ('head = "slit-4mm"', 'head = "slit"', "head = slit: neither a design file nor"),
        ("channel = 4", "channel = 64", "led 1, .*0 to 63"),
        ("channel = 4", "channel = 2", "used once"),
        ("position = [250, 0, 0]", "position = [250, 0]", "led 2, .*x, y and z"),
        ("position = [250, 0, 0]", "", "led 2, missing: position"),
        ("power = 0.5", "watts = 0.5", "led 2, unknown: watts"),
        ('name = "plain"', "", "missing: name"),
        ('head = "slit-4mm"', 'haed = "slit-4mm"', "missing: head; was haed meant to be it"),
        ("version = 1", "version = ", "no room file, which is TOML .*Invalid value"),
    ],
)
def test_wrong_files_are_told_so(tmp_path: Path, before: str, after: str, message: str) -> None:
    path = room_file(tmp_path)
    text = path.read_text(encoding="utf-8")
    assert before in text
    path.write_text(text.replace(before, after), encoding="utf-8")
    with pytest.raises(ValueError, match=rf"(?s)room\.toml: .*{message}"):
        load_room(path)


def test_the_link_takes_rooms_and_designs_by_name_and_file(tmp_path: Path) -> None:
    path = room_file(tmp_path, "seed = 5")
    with open_twin(str(path)) as link:
        assert link.world == load_room(path).world
        pattern = link.sensor.response
    with open_twin(str(path), seed=6) as link:
        assert not np.array_equal(link.sensor.response, pattern)
    with open_twin("walk") as link:
        assert len(link.world.leds) == 7
    with open_twin("slit-4mm") as link:
        assert link.world.head == DESIGNS["slit-4mm"].system
        assert len(link.world.leds) == 2
    with pytest.raises(LinkUnavailable, match="one of the rooms thesis, walk"):
        open_twin("hall")
    path.write_text("format = 3", encoding="utf-8")
    with pytest.raises(ValueError, match="no design file"):
        open_twin(str(path))
