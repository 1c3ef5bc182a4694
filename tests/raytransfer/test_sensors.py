"""Line sensors: the two of the project, positions and pixels, sensors as data."""

from __future__ import annotations

import math
from importlib.resources import files
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

import raytransfer.sensors
from raytransfer import MATERIALS, SENSORS, TCD1304, LineSensor, Plate

if TYPE_CHECKING:
    from pathlib import Path

TCD1703 = SENSORS["TCD1703"]
WINDOW = Plate("window", 0.7, MATERIALS["sensor window"])


def test_the_thesiss_sensor() -> None:
    assert TCD1304 is SENSORS["TCD1304"]
    assert (TCD1304.pixels, TCD1304.pitch, TCD1304.pixel_height) == (3648, 0.008, 0.2)
    assert (TCD1304.leading_elements, TCD1304.trailing_elements) == (32, 14)
    assert TCD1304.elements == 3694
    assert TCD1304.length == pytest.approx(29.184, rel=1e-15)
    assert TCD1304.window == Plate("TCD1304 window", 0.7, MATERIALS["sensor window"])
    assert TCD1304.top_to_chip == 1.52


def test_the_larger_sensor() -> None:
    assert (TCD1703.pixels, TCD1703.pitch) == (7500, 0.007)
    assert TCD1703.length == pytest.approx(52.5, rel=1e-15)
    assert TCD1703.window is None
    with pytest.raises(ValueError, match="TCD1703: its data file does not give"):
        _ = TCD1703.elements


def test_positions_of_the_outermost_pixels() -> None:
    # pixel centres: half a pixel within the ends of the line
    assert_allclose(TCD1304.position([0, 3647]), [-14.588, 14.588], rtol=1e-12)
    assert_allclose(TCD1304.position([-0.5, 3647.5]), [-14.592, 14.592], rtol=1e-12)
    assert TCD1304.position((3648 - 1) / 2) == 0
    assert_allclose(np.diff(TCD1703.position(np.arange(7500))), 0.007, rtol=1e-9)


@settings(deadline=None)
@given(st.sampled_from(sorted(SENSORS)), st.floats(-1e4, 2e4))
def test_position_and_pixel_are_inverse(name: str, pixel: float) -> None:
    sensor = SENSORS[name]
    assert sensor.pixel(sensor.position(pixel)) == pytest.approx(pixel, rel=1e-12, abs=1e-9)
    assert sensor.position(sensor.pixel(pixel / 100)) == pytest.approx(pixel / 100, abs=1e-11)


@pytest.mark.parametrize("shape", [(), (5,), (2, 3), (0,)])
def test_positions_keep_their_shape(shape: tuple[int, ...]) -> None:
    assert np.shape(TCD1304.position(np.ones(shape))) == shape
    assert np.shape(TCD1304.pixel(np.ones(shape))) == shape


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_positions_that_are_not_finite_are_refused(bad: float) -> None:
    with pytest.raises(ValueError, match=f"^pixel = {bad}"):
        TCD1304.position([0, bad])
    with pytest.raises(ValueError, match=f"^position = {bad}"):
        TCD1304.pixel(bad)


@pytest.mark.parametrize("bad", [True, "1", 1j])
def test_positions_that_are_not_numbers_are_refused(bad: Any) -> None:
    with pytest.raises(TypeError, match=r"^pixel: real numbers are needed"):
        TCD1304.position(bad)
    with pytest.raises(TypeError, match=r"^position: real numbers are needed"):
        TCD1304.pixel(bad)


# --- sensors as data ------------------------------------------------------------------------


def test_one_more_file_is_one_more_sensor(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "sensors"
    folder.mkdir()
    for file in (files("raytransfer") / "data" / "sensors").iterdir():
        (folder / file.name).write_text(file.read_text(encoding="utf-8"), encoding="utf-8")
    (folder / "ours.toml").write_text(
        'name = "OURS1"\npixels = 10\npitch = 0.5\npixel_height = 0.1\n'
        "leading_elements = 2\ntrailing_elements = 3\n"
        '[window]\nthickness = 0.4\nmaterial = "fused silica"\ntop_to_chip = 1.1\n',
        encoding="utf-8",
    )
    monkeypatch.setattr(raytransfer.sensors, "FOLDER", tmp_path)
    sensors = raytransfer.sensors._sensors()
    assert set(sensors) == {*SENSORS, "OURS1"}
    assert {name: sensors[name] for name in SENSORS} == dict(SENSORS)
    ours = sensors["OURS1"]
    assert (ours.length, ours.elements, ours.top_to_chip) == (5.0, 15, 1.1)
    assert ours.window == Plate("OURS1 window", 0.4, MATERIALS["fused silica"])
    assert_allclose(ours.position([0, 9]), [-2.25, 2.25])


def test_every_file_is_a_sensor() -> None:
    folder = files("raytransfer") / "data" / "sensors"
    assert len(SENSORS) == len(list(folder.iterdir()))
    assert all(sensor.name == name for name, sensor in SENSORS.items())


def test_sensors_are_read_only() -> None:
    sensors: Any = SENSORS
    with pytest.raises(TypeError):
        sensors["TCD1304"] = TCD1703


# --- refusals -------------------------------------------------------------------------------

SIZES = {"pixels": 10, "pitch": 0.5, "pixel_height": 0.1}


@pytest.mark.parametrize("name", SIZES)
@pytest.mark.parametrize("bad", [0, -1, math.nan, math.inf])
def test_sizes_that_are_not_positive_are_refused(name: str, bad: Any) -> None:
    with pytest.raises(ValueError, match=f"^{name} of ours = {bad:g}: allowed"):
        LineSensor("ours", **{**SIZES, name: bad})


@pytest.mark.parametrize("name", SIZES)
@pytest.mark.parametrize("bad", [True, "1", None])
def test_sizes_that_are_not_numbers_are_refused(name: str, bad: Any) -> None:
    with pytest.raises(TypeError, match=f"^{name} of ours = {bad!r}: "):
        LineSensor("ours", **{**SIZES, name: bad})


def test_a_part_of_a_pixel_is_refused() -> None:
    pixels: Any = 3648.5
    with pytest.raises((TypeError, ValueError), match=r"pixels of ours = 3648\.5"):
        LineSensor("ours", pixels, 0.5, 0.1)


def test_a_window_needs_its_place_and_the_other_way_round() -> None:
    with pytest.raises(ValueError, match="give window and top_to_chip both"):
        LineSensor("ours", 10, 0.5, 0.1, window=WINDOW)
    with pytest.raises(ValueError, match="give window and top_to_chip both"):
        LineSensor("ours", 10, 0.5, 0.1, top_to_chip=1.52)


def test_a_chip_within_its_window_is_refused() -> None:
    with pytest.raises(ValueError, match=r"^top_to_chip of ours = 0\.6 mm: .*0\.7 mm"):
        LineSensor("ours", 10, 0.5, 0.1, window=WINDOW, top_to_chip=0.6)


@pytest.mark.parametrize("bad", [0.0, math.nan, -1.0])
def test_a_chip_that_is_nowhere_is_refused(bad: float) -> None:
    with pytest.raises(ValueError, match=f"top_to_chip of ours = {bad:g}"):
        LineSensor("ours", 10, 0.5, 0.1, window=WINDOW, top_to_chip=bad)
