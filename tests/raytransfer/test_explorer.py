"""The explorer: its numbers, its picture, and what happens when something goes wrong."""

from __future__ import annotations

import html
import io
import math
import subprocess
import sys
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from PIL import Image

import raytransfer
from raytransfer import SENSORS, TCD1304, LineSensor, cast_rays, telecentric_pair
from raytransfer.analysis import fan
from raytransfer.explorer import Explorer
from raytransfer.plots import RAYS
from raytransfer.studies import (
    beam_width,
    field_edge,
    image_position,
    lateral_resolution,
    tracking_area,
    tracking_start,
)

HALF = TCD1304.length / 2
SETTINGS: dict[str, Any] = {
    "front": "LJ1430L1",
    "back": "LJ1567L1",
    "gap": 2.0,
    "sensor_dist": 33.0,
    "source_dist": 1500.0,
    "axis_off": -200.0,
    "led_spacing": 300.0,
}


@pytest.fixture(scope="module")
def shared() -> Explorer:
    """One explorer for tests that set it up themselves."""
    return Explorer()


def put(explorer: Explorer, settings: dict[str, Any], *, exact: bool = False) -> None:
    """Move the controls as if the explorer had been made with these settings."""
    explorer.exact.value = exact
    explorer.focus.value = settings["sensor_dist"] is None
    for name, value in settings.items():
        if value is not None:
            getattr(explorer, name).value = value


def pixels(explorer: Explorer) -> np.ndarray[Any, Any]:
    return np.asarray(Image.open(io.BytesIO(explorer.picture.value)))


# --- numbers --------------------------------------------------------------------------------


@pytest.mark.parametrize("sensor_dist", [None, 33.0])
@pytest.mark.parametrize(("source_dist", "axis_off"), [(1500.0, -200.0), (5000.0, 2900.0)])
def test_results_are_the_studies(
    shared: Explorer, sensor_dist: float | None, source_dist: float, axis_off: float
) -> None:
    changed = {"sensor_dist": sensor_dist, "source_dist": source_dist, "axis_off": axis_off}
    put(shared, {**SETTINGS, **changed})
    matrix = telecentric_pair("LJ1430L1", "LJ1567L1", 2.0).matrix("x")
    chip = cast_rays(1, matrix, 5000, 0).focal_length if sensor_dist is None else sensor_dist
    width = beam_width(30, matrix, source_dist, chip)
    edge = field_edge(matrix, source_dist, HALF, chip)
    position = image_position(matrix, source_dist, axis_off, chip)
    pixel = position / 0.008 + 1823.5
    where = f"pixel {pixel:.1f}" if abs(position) <= HALF else "off the sensor"
    leds = 300 * np.arange(-100, 101)  # a long line
    expected = {
        "focus of this source": f"{cast_rays(30, matrix, source_dist, 0).focal_length:.3f} mm "
        "behind the lenses",
        "sensor": f"{chip:.3f} mm behind the lenses",
        "image": f"{position:.3f} mm, {where}",
        "beam width": f"{width:.3f} mm, {width / 0.008:.0f} px",
        "field edge here": f"{edge:.0f} mm",
        "one pixel here": f"{lateral_resolution(matrix, source_dist, 0.008, chip):.3f} mm",
        "tracking starts at": f"{tracking_start(matrix, 300, HALF, chip):.0f} mm",
        "LEDs seen": f"{np.sum(np.abs(leds - axis_off) <= edge)}",
    }
    assert shared.view().results() == expected
    shown = html.unescape(shared.readout.value)
    for quantity, value in expected.items():
        assert quantity in shown
        assert value in shown
    assert (where == "off the sensor") == (axis_off == 2900)


def test_the_leds_that_are_seen_are_those_of_the_tracking_area(shared: Explorer) -> None:
    put(shared, SETTINGS)
    for axis_off in (-700.0, 0.0, 130.0):
        shared.axis_off.value = axis_off
        view = shared.view()
        area = tracking_area(
            view.matrix, view.leds, [axis_off], [view.source_dist], sensor_dist=view.sensor_dist
        )
        assert_array_equal(view.seen, area.visible[:, 0, 0])
        assert 0 < view.seen.sum() < view.seen.size
        assert 0 in view.leds  # the source


def test_another_sensor() -> None:
    small = LineSensor("small", pixels=1000, pitch=0.01, pixel_height=0.1)
    explorer = Explorer("PCX_15_30_20", "PCX_15_30_20", axis_off=100.0, sensor=small)
    view = explorer.view()
    assert view.half_length == 5.0
    assert view.field_edge == field_edge(view.matrix, 2000, 5.0, view.sensor_dist)
    position = image_position(view.matrix, 2000, 100, view.sensor_dist)
    assert view.results()["image"] == f"{position:.3f} mm, pixel {position / 0.01 + 499.5:.1f}"


def test_a_sensor_longer_than_all_lenses_is_refused() -> None:
    with pytest.raises(ValueError, match="TCD1703"):
        Explorer(sensor=SENSORS["TCD1703"])


def test_lenses_lower_than_the_sensor_is_long_are_not_offered(shared: Explorer) -> None:
    names = set(shared.front.options)
    assert names == set(shared.back.options)
    assert {"PCX_30_32_60", "LJ1430L1", "LJ1516L1"} < names
    assert not names & {"LJ1328L2", "LK1085L2", "PCX_15_30_20", "PCV_15_30_20"}


# --- picture --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("front", "LJ1477L1"),
        ("back", "LJ1477L1"),
        ("gap", 4.0),
        ("sensor_dist", 35.0),
        ("source_dist", 1800.0),
        ("axis_off", 250.0),
        ("led_spacing", 500.0),
        ("focus", True),
    ],
)
def test_every_control_changes_the_picture(shared: Explorer, name: str, value: Any) -> None:
    put(shared, SETTINGS)
    control = getattr(shared, name)
    before, readout, start = shared.picture.value, shared.readout.value, control.value
    control.value = value
    assert shared.picture.value != before
    assert shared.readout.value != readout
    if name == "focus":  # switching it off leaves the sensor where it is
        return
    control.value = start
    assert shared.picture.value == before
    assert shared.readout.value == readout


def test_the_picture_is_the_canvas(shared: Explorer) -> None:
    shared.source_dist.value = 1730.0
    picture = pixels(shared)
    canvas = np.asarray(shared._drawing._canvas.buffer_rgba())
    assert picture.dtype == np.uint8
    assert picture.shape == (400, 960, 3)
    assert_array_equal(picture, canvas[..., :3])
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 20


@pytest.mark.parametrize(
    "moves",
    [
        [("source_dist", 3000.0), ("axis_off", 900.0), ("led_spacing", 800.0)],
        # so far that the background is drawn anew, once and twice
        [("back", "LJ1144L1"), ("front", "LJ1144L1"), ("focus", True)],
        [("sensor_dist", 300.0), ("gap", 7.0), ("sensor_dist", 40.0)],
        # a little further and a little back
        [("sensor_dist", 45.0)],
        [("sensor_dist", 60.0), ("sensor_dist", 52.0), ("sensor_dist", 48.0)],
    ],
)
def test_a_moved_explorer_shows_what_a_new_one_does(moves: list[tuple[str, Any]]) -> None:
    explorer = Explorer(**SETTINGS)
    for name, value in moves:
        getattr(explorer, name).value = value
    settings = {name: getattr(explorer, name).value for name in SETTINGS}
    if explorer.focus.value:
        settings["sensor_dist"] = None
    new = Explorer(**settings)
    assert explorer.picture.value == new.picture.value
    assert explorer.readout.value == new.readout.value


def test_the_picture_shows_the_rays(shared: Explorer) -> None:
    """What is drawn: rays that meet in the focus, the sensor, the field on the line of LEDs."""
    put(shared, {**SETTINGS, "source_dist": 2000.0, "axis_off": 300.0})
    drawing, view = shared._drawing, shared.view()
    focus = cast_rays(30, view.matrix, 2000, 300)
    for ray in drawing._rays:
        z, heights = (np.asarray(values, float) for values in ray.get_data())
        slope = (heights[-1] - heights[-2]) / (z[-1] - z[-2])
        height = heights[-2] + slope * (view.system.length + focus.focal_length - z[-2])
        assert height == pytest.approx(focus.focal_offset, rel=1e-9)
    assert_array_equal(drawing._line.get_xdata(), [view.system.length + view.sensor_dist] * 2)
    assert_array_equal(drawing._line.get_ydata(), [-HALF, HALF])
    # and the axis reaches a little further than the sensor
    chip = view.system.length + view.sensor_dist
    assert drawing._optics.get_xlim()[0] < 0
    assert chip < drawing._optics.get_xlim()[1] < 2 * chip
    edge = field_edge(view.matrix, 2000, HALF, view.sensor_dist)
    corners = 1000 * drawing._field.get_xy()
    assert corners[:3].tolist() == pytest.approx(
        np.array([[300, 2000], [300 - edge, 0], [300 + edge, 0]])
    )
    assert drawing._tracked.get_y() * 1000 == pytest.approx(view.tracking_start)


# --- the sensor in the focus ----------------------------------------------------------------


@pytest.mark.parametrize("front", ["LJ1695L1", "LJ1567L1", "LJ1653L1"])
@pytest.mark.parametrize("gap", [0.0, 8.0])
def test_the_sensor_follows_the_focus(shared: Explorer, front: str, gap: float) -> None:
    put(shared, {**SETTINGS, "sensor_dist": None, "front": front, "gap": gap})
    matrix = telecentric_pair(front, shared.back.value, gap).matrix("x")
    focus = cast_rays(30, matrix, 5000, 0).focal_length
    assert shared.focus.value
    assert shared.sensor_dist.disabled
    assert shared.sensor_dist.value == focus
    assert shared.view().sensor_dist == focus


def test_the_sensor_follows_the_longest_focus() -> None:
    explorer = Explorer("LJ1516L1", "LJ1516L1", gap=10.0)
    focus = cast_rays(30, explorer.view().matrix, 5000, 0).focal_length
    assert explorer.view().sensor_dist == focus
    assert explorer.sensor_dist.value == focus  # the slider is not at its end


def test_the_sensor_can_be_let_go() -> None:
    explorer = Explorer()
    focus = explorer.sensor_dist.value
    explorer.focus.value = False
    assert not explorer.sensor_dist.disabled
    assert explorer.sensor_dist.value == focus
    explorer.back.value = "LJ1567L1"
    assert explorer.sensor_dist.value == explorer.view().sensor_dist == focus  # stays
    explorer.sensor_dist.value = 30.0
    assert explorer.view().sensor_dist == 30.0
    explorer.focus.value = True
    assert explorer.sensor_dist.disabled
    matrix = telecentric_pair("PCX_30_32_60", "LJ1567L1").matrix("x")
    assert explorer.sensor_dist.value == cast_rays(30, matrix, 5000, 0).focal_length


# --- exact rays -----------------------------------------------------------------------------


def test_nothing_is_compiled_before_the_switch_is_on() -> None:
    code = """
import sys
from raytransfer.explorer import Explorer
explorer = Explorer()
explorer.source_dist.value = 1000
print("numba" in sys.modules)
"""
    command = [sys.executable, "-c", code]
    assert subprocess.run(command, capture_output=True, check=True).stdout == b"False\n"


@pytest.mark.parametrize("sensor_dist", [None, 33.0])
@pytest.mark.parametrize(("source_dist", "axis_off"), [(1500.0, -200.0), (2000.0, 700.0)])
def test_exact_results_are_those_of_the_analysis(
    shared: Explorer, sensor_dist: float | None, source_dist: float, axis_off: float
) -> None:
    changed = {"sensor_dist": sensor_dist, "source_dist": source_dist, "axis_off": axis_off}
    put(shared, {**SETTINGS, **changed}, exact=True)
    view = shared.view()
    system = replace(
        telecentric_pair("LJ1430L1", "LJ1567L1", 2.0), sensor_distance=view.sensor_dist
    )
    light = fan(system, "x", source_dist, axis_off, rays=4001)
    found, pitch = light.profile(), 0.008
    middle = image_position(view.matrix, source_dist, axis_off, view.sensor_dist)
    lost = 1 - light.arrived - light.faded / light.entered
    assert shared.view().exact_results() == {
        "image, median": f"{found.median:.3f} mm, pixel {found.median / pitch + 1823.5:.1f}",
        "image, peak": f"{found.peak:.3f} mm, pixel {found.peak / pitch + 1823.5:.1f}",
        "median − paraxial": f"{(found.median - middle) / pitch:+.1f} px",
        "peak − paraxial": f"{(found.peak - middle) / pitch:+.1f} px",
        "50 % of the light in": f"{found.w50 / pitch:.0f} px",
        "80 % of the light in": f"{found.w80 / pitch:.0f} px",
        "light lost": f"{100 * lost:.1f} % on the way, "
        f"{100 * light.faded / light.entered:.1f} % reflected",
        "light on the sensor": f"{100 * light.arrived * light.on():.1f} % of all, "
        f"{100 * light.on():.1f} % of what arrives",
    }
    # a finer fan says the same
    finer = fan(system, "x", source_dist, axis_off, rays=40_001)
    assert_allclose(finer.profile().median, found.median, atol=0.5 * pitch)
    assert_allclose(finer.profile().w80, found.w80, atol=2 * pitch)
    shown = html.unescape(shared.readout.value)
    for quantity, value in {**view.results(), **view.exact_results()}.items():
        assert quantity in shown
        assert value in shown


def test_results_stay_paraxial(shared: Explorer) -> None:
    put(shared, SETTINGS)
    before = shared.view().results()
    shared.exact.value = True
    assert shared.view().results() == before


def test_the_switch_adds_exact_rays_and_takes_them_away(shared: Explorer) -> None:
    put(shared, SETTINGS)
    picture, readout = shared.picture.value, shared.readout.value
    assert "exact" not in readout
    shared.exact.value = True
    assert shared.picture.value != picture
    assert "exact" in shared.readout.value
    other = shared.picture.value
    shared.source_dist.value += 300
    assert shared.picture.value != other
    shared.source_dist.value -= 300
    assert shared.picture.value == other
    shared.exact.value = False
    assert shared.picture.value == picture
    assert shared.readout.value == readout
    # whether it was switched on before or after the others were moved
    new = Explorer(**SETTINGS, exact=True)
    assert new.picture.value == other
    new.exact.value = False
    assert new.picture.value == picture


def test_the_titles_say_what_is_exact(shared: Explorer) -> None:
    drawing = shared._drawing
    for exact, titles in (
        (False, ("rays along the pixel line (paraxial)", "room from above; shaded: two LEDs seen")),
        (
            True,
            (
                "rays along the pixel line: exact; dashed: paraxial",
                "room, paraxial; shaded: two LEDs seen",
            ),
        ),
    ):
        put(shared, SETTINGS, exact=exact)
        assert drawing._optics.get_title(loc="left") == titles[0]
        assert drawing._room.get_title(loc="left") == titles[1]
        # each over its own axes
        right = drawing._optics.get_window_extent().x1
        ends = [title.get_window_extent().x1 for title in drawing._titles]
        assert ends[0] < right < drawing._room.get_window_extent().x0
        assert ends[1] <= drawing.figure.bbox.x1


@pytest.mark.parametrize("axis_off", [0.0, 20.0])
def test_weak_lenses_are_nearly_paraxial(axis_off: float) -> None:
    explorer = Explorer("LJ1516L1", "LJ1516L1", sensor_dist=400.0, axis_off=axis_off, exact=True)
    drawing, view = explorer._drawing, explorer.view()
    for exact, paraxial, colour in zip(drawing._exact, drawing._rays, RAYS, strict=True):
        z, heights = (np.asarray(values, float) for values in exact.get_data())
        dashed = np.asarray(paraxial.get_ydata(), float)
        # both start together
        assert_allclose([z[0], heights[0], dashed[0]], [-2000, axis_off, axis_off], atol=1e-9)
        assert_allclose([z[1], heights[1]], [0, dashed[1]], atol=1e-9)
        assert z[-1] == pytest.approx(view.system.length + 500)
        assert_allclose(heights[-1], dashed[-1], atol=0.1)
        assert exact.get_color() == paraxial.get_color() == colour
        assert paraxial.get_linestyle() == "--"
        assert paraxial.get_linewidth() < exact.get_linewidth()
    edges = [float(np.asarray(line.get_ydata())[1]) for line in drawing._exact]
    assert edges[0] == -edges[2] == pytest.approx(0.95 * 15)


def test_lost_rays_end_where_they_are_lost() -> None:
    explorer = Explorer(axis_off=900.0, exact=True)
    drawing, view = explorer._drawing, explorer.view()
    z, height, lost = view.exact_rays()
    assert 0 < lost.sum() < len(lost)
    assert_array_equal(drawing._lost.get_xdata(), z[-1, lost])
    assert_array_equal(drawing._lost.get_ydata(), height[-1, lost])
    assert z[-1, lost].max() <= view.system.length
    # the steep edge meets the curved side of the first lens at more than the critical angle
    assert lost[0]
    first = view.system.elements[0].surfaces()[1]
    assert abs(height[-1, 0]) < 15
    assert z[-1, 0] == pytest.approx(first.z + float(first.sag(height[-1, 0], 0.0)))
    assert_allclose(z[-1, ~lost], view.system.length + 1.25 * view.sensor_dist)


@pytest.mark.parametrize(
    ("changed", "quantity", "text"),
    [
        ({"axis_off": 3000.0}, "image, median", "mm, off the sensor"),
        ({"axis_off": 3000.0}, "light on the sensor", "0.0 % of all, 0.0 % of what arrives"),
        # so near that the light leaves diverging
        (
            {"front": "LJ1516L1", "back": "LJ1516L1", "source_dist": 200.0, "axis_off": 1.0},
            "image, median",
            "pixel",
        ),
        ({"sensor_dist": 5.0}, "image, median", "pixel"),
        ({"gap": 10.0, "axis_off": 0.0}, "median − paraxial", "+0.0 px"),
    ],
)
def test_odd_settings(shared: Explorer, changed: dict[str, Any], quantity: str, text: str) -> None:
    put(shared, {**SETTINGS, **changed}, exact=True)
    assert text in shared.view().exact_results()[quantity]
    assert shared.error.value == ""


def test_where_no_light_arrives_the_table_says_so(shared: Explorer) -> None:
    """Total reflection at the first curved side, and past the second lens."""
    steep = {"front": "PCX_30_32_50", "back": "PCX_30_32_50", "gap": 3.0}
    put(shared, {**SETTINGS, **steep, "source_dist": 200.0, "axis_off": 450.0}, exact=True)
    results = shared.view().exact_results()
    assert results["image, median"] == results["image, peak"] == "no light arrives"
    assert results["median − paraxial"] == results["80 % of the light in"] == "–"
    assert results["light on the sensor"] == "0.0 % of all, 0.0 % of what arrives"
    assert results["light lost"] == "100.0 % on the way, 0.0 % reflected"
    assert shared.view().exact_rays()[2].all()


@settings(max_examples=25, deadline=None)
@given(
    front=st.sampled_from(Explorer().front.options),
    back=st.sampled_from(Explorer().front.options),
    gap=st.floats(0, 10),
    sensor_dist=st.none() | st.floats(5, 600),
    source_dist=st.floats(200, 6000),
    axis_off=st.floats(-3000, 3000),
    led_spacing=st.floats(100, 2000),
)
def test_whatever_the_sliders_say_is_shown(shared: Explorer, **changed: Any) -> None:
    put(shared, changed, exact=True)
    assert shared.error.value == ""
    results = shared.view().exact_results()
    assert not any("nan" in value or "inf" in value for value in results.values())
    lost, faded = (float(part.split(" %")[0]) for part in results["light lost"].split(", "))
    useful, on_sensor = (
        float(part.split(" %")[0]) for part in results["light on the sensor"].split(", ")
    )
    assert 0 <= useful <= on_sensor <= 100
    assert lost + faded + useful <= 100.2  # each is rounded
    if results["image, median"] == "no light arrives":
        assert shared.view().exact_rays()[2].all()
        assert (lost, useful) == (100, 0)
        return
    narrow, wide = (
        float(results[f"{share} % of the light in"].removesuffix(" px")) for share in (50, 80)
    )
    assert 0 <= narrow <= wide


def test_without_numba_the_switch_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    explorer = Explorer()
    picture, readout = explorer.picture.value, explorer.readout.value
    with monkeypatch.context() as without:
        without.setitem(sys.modules, "numba", None)
        without.delitem(sys.modules, "raytransfer._kernels", raising=False)
        without.delattr(raytransfer, "_kernels", raising=False)
        with pytest.raises(ModuleNotFoundError, match=r"linetrack\[exact\]"):
            explorer.exact.value = True
        assert "pip install linetrack[exact]" in explorer.error.value
        assert "Traceback" not in explorer.error.value
        assert not explorer.exact.value
        assert (explorer.picture.value, explorer.readout.value) == (picture, readout)
        explorer.source_dist.value = 2500.0  # what is paraxial goes on
        assert explorer.error.value == ""
        with pytest.raises(ModuleNotFoundError, match="numba"):
            Explorer(exact=True)
    explorer.exact.value = True
    assert explorer.error.value == ""


# --- errors ---------------------------------------------------------------------------------


def test_an_error_is_raised_and_shown_and_goes_away(monkeypatch: pytest.MonkeyPatch) -> None:
    explorer = Explorer()
    good = explorer.picture.value
    assert explorer.error.value == ""

    def fail(_view: object) -> bytes:
        raise ZeroDivisionError("the <lens> is & broken")

    with monkeypatch.context() as broken:
        broken.setattr(explorer._drawing, "png", fail)
        for value in (3000.0, 3100.0):
            with pytest.raises(ZeroDivisionError, match="is & broken"):
                explorer.source_dist.value = value
            shown = explorer.error.value
            assert "ZeroDivisionError: the &lt;lens&gt; is &amp; broken" in shown
            assert "Traceback" in shown
            assert "<lens>" not in shown
    assert explorer.picture.value == good  # the last one that could be drawn

    explorer.source_dist.value = 3200.0
    assert explorer.error.value == ""
    assert explorer.picture.value == Explorer(source_dist=3200.0).picture.value


def test_errors_of_the_studies_are_raised_too(monkeypatch: pytest.MonkeyPatch) -> None:
    explorer = Explorer()
    with monkeypatch.context() as broken:
        broken.setattr("raytransfer.explorer.tracking_start", lambda *_: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            explorer.gap.value = 1.0
        assert "ZeroDivisionError" in explorer.error.value
    explorer.gap.value = 2.0
    assert explorer.error.value == ""


@pytest.mark.parametrize(
    ("name", "bad"),
    [
        ("gap", -1.0),
        ("gap", 11.0),
        ("sensor_dist", 0.0),
        ("sensor_dist", 1000.0),
        ("source_dist", 10_000.0),
        ("source_dist", math.nan),
        ("axis_off", 5000.0),
        ("led_spacing", 1.0),
    ],
)
def test_settings_beyond_the_sliders_are_refused(name: str, bad: float) -> None:
    settings: Any = {name: bad}
    with pytest.raises(ValueError, match=rf"= {bad:g} mm: the explorer goes from"):
        Explorer(**settings)


@pytest.mark.parametrize("name", ["front", "back"])
@pytest.mark.parametrize("bad", ["LJ0000", "LJ1328L2"])
def test_lenses_that_are_not_offered_are_refused(name: str, bad: str) -> None:
    settings: Any = {name: bad}
    with pytest.raises(ValueError, match=bad):
        Explorer(**settings)


@pytest.mark.parametrize("source_dist", [1500.0, 3000.0, 4300.0, 6000.0])
@pytest.mark.parametrize("axis_off", [-3000.0, -1234.0, 0.0, 2990.0, 3000.0])
@pytest.mark.parametrize("led_spacing", [100.0, 730.0, 2000.0])
def test_two_leds_are_seen_from_the_start_of_tracking_on(
    shared: Explorer, source_dist: float, axis_off: float, led_spacing: float
) -> None:
    """Also at the edge of the room: the line of LEDs is long, the picture shows a part of it."""
    moved = {"source_dist": source_dist, "axis_off": axis_off, "led_spacing": led_spacing}
    put(shared, {**SETTINGS, **moved})
    view = shared.view()
    if source_dist >= view.tracking_start:
        assert view.seen.sum() >= 2
    inside = 2 * view.field_edge / led_spacing
    assert abs(view.seen.sum() - inside) <= 1
