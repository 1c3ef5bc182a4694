"""The thesis's functions, on files made by hand and through the real firmware image."""

from __future__ import annotations

import math
from itertools import islice
from typing import TYPE_CHECKING

import numpy as np
import pytest

from acquisition.dat import DatError, numbered, write_dat
from acquisition.frames import ELEMENTS, LEADING, PIXELS, Frame
from acquisition.links import open_link
from tracking.baseline import (
    positions,
    print_tracking_area,
    read_data,
    simple_spike_tracking,
    tracking_2d,
)
from tracking.calibration import Corner, FourCorners
from twin.link import TwinLink

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path


def line(pixel: int, depth: int = 1500) -> Frame:
    """A frame with one spike, its sides less deep."""
    elements = np.full(ELEMENTS, 3920, np.uint16)
    for offset in range(-3, 4):
        elements[LEADING + pixel + offset] -= np.uint16(depth // (1 + abs(offset)))
    return Frame(elements, sh_period=100, icg_period=30000)


def write_pair(folder: Path, first: int, second: int, number: int = 1) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    write_dat(numbered(folder / "output", number), line(first))
    write_dat(numbered(folder / "output", number + 1), line(second))


def change_line(number: int, text: str) -> Callable[[str], str]:
    """Replace the value line of an element, numbered from 1."""

    def changed(content: str) -> str:
        lines = content.split("\n")
        lines[3 + number] = text
        return "\n".join(lines)

    return changed


BAD: dict[str, Callable[[str], str]] = {
    "short": lambda text: text[: len(text) // 2],
    "empty": lambda _: "",
    "garbage": lambda _: "\x00\xff not a measurement\n" * 40,
    "not-a-number": change_line(700, "700 x"),
    "negative": change_line(700, "700 -5"),
    "beyond-16-bits": change_line(700, "700 70000"),
    "beyond-the-converter": change_line(700, "700 4200"),
    "one-line-twice": lambda text: text.replace("\n700 ", "\n700 3920\n700 ", 1),
    "all-zero": lambda text: "\n".join(
        f"{row.split(' ')[0]} 0" if row[:1].isdigit() else row for row in text.split("\n")
    ),
    "lit-dark-reference": change_line(20, "20 2000"),
    "brighter-than-dark": change_line(700, "700 4095"),
    "shifted": lambda text: "\n".join(
        f"{n} {row.split(' ')[1]}" if row[:1].isdigit() else row
        for n, row in enumerate(text.split("\n")[:4] + text.split("\n")[1400:3600], start=-3)
    ),
}


def test_data_is_a_list_in_the_files_order(tmp_path: Path) -> None:
    path = tmp_path / "one.dat"
    frame = line(2185)
    write_dat(path, frame)
    data = read_data(path)
    assert isinstance(data, list)
    assert all(type(value) is int for value in data)
    assert data == frame.elements.tolist()
    assert data.index(min(data)) == LEADING + 2185  # dummies and dark reference are counted


def test_midpoint_is_x_and_first_minus_second_is_y() -> None:
    data1, data2 = [9, 9, 9, 9, 9, 9, 2, 9], [9, 3, 9, 9, 9, 9, 9, 9]
    assert simple_spike_tracking(data1, data2) == (3.5, 5.0)
    assert simple_spike_tracking(data2, data1) == (3.5, -5.0)


def test_first_of_equal_minima_counts() -> None:
    assert simple_spike_tracking([5, 1, 1, 1], [5, 5, 5, 1]) == (2.0, -2.0)


@pytest.mark.parametrize(("first", "second"), [([], []), ([1, 2, 3], [1, 2])])
def test_unequal_lines_are_refused(first: list[int], second: list[int]) -> None:
    with pytest.raises(ValueError, match="two lines of the same sensor"):
        simple_spike_tracking(first, second)


def test_tracking_2d_prints_what_it_returns(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_pair(tmp_path, 2973, 1437)
    assert tracking_2d(tmp_path / "output") == (LEADING + 2205.0, 1536.0)
    assert capsys.readouterr().out == f"{LEADING + 2205} 1536\n"


@pytest.mark.parametrize("which", [1, 2])
@pytest.mark.parametrize("kind", BAD)
def test_bad_files_are_reported_and_give_nothing(
    kind: str, which: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_pair(tmp_path, 2973, 1437)
    path = numbered(tmp_path / "output", which)
    path.write_bytes(BAD[kind](path.read_text(encoding="ascii")).encode("latin-1"))
    with pytest.raises(DatError, match=path.name):
        read_data(path)
    assert tracking_2d(tmp_path / "output") is None
    said = capsys.readouterr().out
    assert said.startswith("invalid data: ")
    assert path.name in said
    assert said.count("\n") == 1


def test_missing_file_is_not_called_invalid_data(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        tracking_2d(tmp_path / "output")


CORNER_SPIKES = {"lf": (2400, 800), "lb": (2100, 1500), "rf": (2850, 1250), "rb": (2300, 1700)}


def area(folder: Path) -> None:
    for corner, (first, second) in CORNER_SPIKES.items():
        write_pair(folder / corner, first, second)


def test_tracking_area_is_printed_corner_by_corner(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    area(tmp_path)
    write_pair(tmp_path / "lb", 2110, 1500, number=3)  # two measurements: their mean
    write_pair(tmp_path / "rf", 900, 900, number=3)
    numbered(tmp_path / "rf" / "output", 4).write_text("nonsense")
    found = print_tracking_area(tmp_path)
    assert found == {
        "lf": (LEADING + 1600.0, 1600.0),
        "lb": (LEADING + 1802.5, 605.0),
        "rf": (LEADING + 2050.0, 1600.0),
        "rb": (LEADING + 2000.0, 600.0),
    }
    lines = capsys.readouterr().out.splitlines()
    assert [text.split()[0] for text in lines] == ["lf", "lb", "rf", "rf", "rb"]
    assert lines[2].startswith("rf invalid data: ")
    assert lines[1] == f"lb {LEADING + 1802.5} 605"


def test_corner_without_valid_data_is_left_out(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    area(tmp_path)
    numbered(tmp_path / "rb" / "output", 1).write_text("nonsense")
    assert set(print_tracking_area(tmp_path)) == {"lf", "lb", "rf"}
    assert "rb invalid data: no pair of files is left" in capsys.readouterr().out


def test_missing_corner_is_named(tmp_path: Path) -> None:
    area(tmp_path)
    for file in (tmp_path / "rf").iterdir():
        file.unlink()
    with pytest.raises(FileNotFoundError, match="rf"):
        print_tracking_area(tmp_path)
    (tmp_path / "rf").rmdir()
    with pytest.raises(FileNotFoundError, match="rf"):
        print_tracking_area(tmp_path)


def test_corners_map_pixels_to_their_own_places(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    area(tmp_path)
    places = {"lf": (-400.0, 1300.0), "lb": (-400.0, 4150.0)}
    places |= {"rf": (400.0, 1300.0), "rb": (400.0, 4150.0)}
    measured = print_tracking_area(tmp_path, places)
    assert capsys.readouterr().out.splitlines()[2] == f"rf {LEADING + 2050} 1600 at 400 1300 mm"
    corners = FourCorners(*(Corner(*places[corner], *measured[corner]) for corner in places))
    for corner, place in places.items():
        found = tracking_2d(tmp_path / corner / "output", corners=corners)
        assert found == pytest.approx(place, abs=1e-6)


def test_call_after_call_through_the_firmware() -> None:
    with TwinLink() as link:
        readings = list(positions(link, count=3))
        seconds = link.machine.seconds
    assert len(readings) == 3
    assert seconds == pytest.approx(3 * 0.045, abs=0.02)  # as the thesis's calls
    for reading in readings:
        assert not reading.invalid
        # LEDs to the left and the right of the middle, some 1380 px apart
        assert reading.x == pytest.approx(LEADING + PIXELS / 2, abs=40)
        assert reading.y == pytest.approx(-1380, abs=60)


def test_call_after_call_in_mm() -> None:
    corners = FourCorners(
        Corner(-400, 1300, 2000, -1400),
        Corner(-400, 4150, 1900, -440),
        Corner(400, 1300, 1700, -1400),
        Corner(400, 4150, 1800, -440),
    )
    with TwinLink() as link:
        pixels = next(positions(link, count=1))
    with TwinLink() as link:
        (reading,) = positions(link, corners, count=1)
    assert (reading.x, reading.y) == pytest.approx(corners.bilinear(pixels.x, pixels.y))
    assert reading.y == pytest.approx(1300, abs=200)


def test_damaged_frame_is_a_reading_without_a_place(tmp_path: Path) -> None:
    elements = line(900).elements.copy()
    elements[1000:1400] = 0
    write_pair(tmp_path, 2000, 1000)
    broken = line(900).replaced(elements=elements)
    write_dat(numbered(tmp_path / "output", 2), broken)
    write_pair(tmp_path, 2000, 1000, number=3)
    with open_link("replay", str(tmp_path / "output")) as link:
        damaged, good = positions(link, count=2)
    assert math.isnan(damaged.x)
    assert math.isnan(damaged.y)
    assert damaged.invalid[0].startswith("frame 2: ")
    assert str(damaged).startswith("invalid data: frame 2: ")
    assert (good.x, good.y, good.invalid) == (LEADING + 1500, 1000, ())


def test_ends_with_the_recording(tmp_path: Path) -> None:
    write_pair(tmp_path, 2000, 1000)
    write_dat(numbered(tmp_path / "output", 3), line(2000))
    with open_link("replay", str(tmp_path / "output")) as link:
        readings = list(islice(positions(link), 5))
    assert [(reading.x, reading.y) for reading in readings] == [(LEADING + 1500, 1000)]
