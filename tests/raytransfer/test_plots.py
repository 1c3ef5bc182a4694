"""What the figures show: their data against closed forms, their labels, their pixels."""

from __future__ import annotations

import contextlib
import io
import math
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import PathCollection, QuadMesh
from matplotlib.contour import QuadContourSet
from matplotlib.figure import Figure
from matplotlib.patches import Polygon, Rectangle
from numpy.testing import assert_allclose, assert_array_equal
from PIL import Image

from raytransfer import (
    CATALOGUE,
    MATERIALS,
    TCD1304,
    THESIS_LENSES,
    Lens,
    OpticalSystem,
    Plate,
    cast_rays,
    collimating_pair,
    plots,
    prototype_head,
    telecentric_pair,
)
from raytransfer.lenses import Aperture, SphericalLens
from raytransfer.studies import (
    beam_width,
    field_edge,
    led_line,
    lens_selection,
    resolution_map,
    tracking_area,
    tracking_start,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    from matplotlib.axes import Axes
    from matplotlib.lines import Line2D
    from numpy.typing import NDArray

    from raytransfer.lenses import Meridian

mpl.use("Agg")

PAIR = telecentric_pair()
F60 = PAIR.matrix("x")
HEAD = prototype_head()
HALF = TCD1304.length / 2
AREA = tracking_area(F60, led_line(3, 500), np.arange(-1250, 1251, 25), np.arange(100, 3001, 10))
RESOLUTION = resolution_map(
    F60, led_line(5, 500), np.linspace(-1500, 1500, 31), np.linspace(100, 4000, 40)
)
ROWS = lens_selection([CATALOGUE[part] for part in ("LJ1695L1", "LJ1430L1", "LJ1640L1")])


@pytest.fixture
def ax() -> Axes:
    figure = Figure(figsize=(6, 4), dpi=60, layout="constrained")
    FigureCanvasAgg(figure)
    return figure.add_subplot()


def data(line: Line2D) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    return np.asarray(line.get_xdata(), float), np.asarray(line.get_ydata(), float)


def at(line: Line2D, where: float) -> float:
    """Height of a drawn ray, extended in its last straight piece if need be."""
    x, y = data(line)
    slope = (y[-1] - y[-2]) / (x[-1] - x[-2])
    return float(y[-1] + slope * (where - x[-1]))


def labelled(ax: Axes, label: str) -> Line2D:
    (line,) = (line for line in ax.lines if str(line.get_label()).startswith(label))
    return line


def texts(ax: Axes) -> list[str]:
    legend = ax.get_legend()
    return [] if legend is None else [text.get_text() for text in legend.get_texts()]


# --- all of them ----------------------------------------------------------------------------

FIGURES: dict[str, Callable[[Axes], Axes]] = {
    "ray cast": lambda ax: plots.plot_ray_cast(30, 11.8, F60, 200, 50, ax),
    "focus": lambda ax: plots.plot_focus(30, PAIR, 500, 26.1, ax),
    "system x": lambda ax: plots.plot_system(HEAD, "x", [(5000, 0), (5000, 2000)], ax),
    "system y": lambda ax: plots.plot_system(HEAD, "y", [(5000, 0)], ax),
    "tracking area": lambda ax: plots.plot_tracking_area(AREA, ax),
    "lateral resolution": lambda ax: plots.plot_resolution(RESOLUTION, ax),
    "axial resolution": lambda ax: plots.plot_resolution(RESOLUTION, ax, quantity="axial"),
    "beam width": lambda ax: plots.plot_beam_width(30, {"f60": F60}, ax),
    "lens comparison": lambda ax: plots.plot_lens_comparison(ROWS, ax, highlight=["LJ1430L1"]),
}


@pytest.mark.parametrize("name", FIGURES)
def test_every_figure_is_drawn_into_the_given_axes(name: str, ax: Axes) -> None:
    assert FIGURES[name](ax) is ax
    assert plt.get_fignums() == []  # and into no other


@pytest.mark.parametrize("name", FIGURES)
def test_every_axis_has_its_unit(name: str, ax: Axes) -> None:
    FIGURES[name](ax)
    labels = [ax.get_xlabel(), ax.get_ylabel()]
    labels += [bar.get_ylabel() for bar in ax.figure.axes if bar is not ax]
    for label in labels:
        assert label.endswith(("(mm)", "(m)", "(mm per pixel)")) or label == "LEDs on the sensor"


@pytest.mark.parametrize("name", FIGURES)
def test_every_figure_renders(name: str, ax: Axes) -> None:
    FIGURES[name](ax)
    file = io.BytesIO()
    assert isinstance(ax.figure, Figure)
    ax.figure.savefig(file, format="png")
    pixels = np.asarray(Image.open(file).convert("RGB"))
    assert pixels.shape == (240, 360, 3)
    inside = ax.get_window_extent()
    part = pixels[240 - int(inside.y1) + 2 : 240 - int(inside.y0) - 2, int(inside.x0) + 2 :]
    drawn = (part != part[0, -1]).any(axis=2)
    assert drawn.mean() > 0.01


def test_the_style_is_the_projects() -> None:
    with mpl.rc_context():
        plots.style()
        assert mpl.rcParams["figure.figsize"] == [8.0, 4.0]
        assert mpl.rcParams["axes.spines.top"] is False
        assert mpl.rcParams["figure.constrained_layout.use"] is True
        colours = mpl.rcParams["axes.prop_cycle"].by_key()["color"]
        assert colours[:3] == ["#0072B2", "#D55E00", "#009E73"]


def test_every_figure_renders_in_the_projects_style() -> None:
    with mpl.rc_context():
        plots.style()
        for draw in FIGURES.values():
            figure = Figure(dpi=40)
            canvas = FigureCanvasAgg(figure)
            draw(figure.add_subplot())
            canvas.draw()
            assert np.ptp(np.asarray(canvas.buffer_rgba())[..., :3]) > 100


# --- ray cast -------------------------------------------------------------------------------


def test_ray_paths_by_hand() -> None:
    z, heights = plots.ray_paths(30, 11.8, F60, 200, 50, 40)
    assert_allclose(z, [-200, 0, 11.8, 51.8], rtol=1e-15)
    assert_array_equal(heights[0], [50, 50, 50])
    assert_array_equal(heights[1], [15, 0, -15])
    out, angle = np.asarray(F60) @ [[15, 0, -15], [-35 / 200, -50 / 200, -65 / 200]]
    assert_allclose(heights[2], out, rtol=1e-12)
    assert_allclose(heights[3], out + 40 * angle, rtol=1e-12)


@pytest.mark.parametrize(("dist", "off"), [(200, 50), (5000, 0), (500, -120)])
def test_ray_cast_meets_in_the_focus(dist: float, off: float, ax: Axes) -> None:
    plots.plot_ray_cast(30, 11.8, F60, dist, off, ax)
    focal_length, focal_offset = cast_rays(30, F60, dist, off)
    rays = [labelled(ax, label) for label in ("upper edge", "middle", "lower edge")]
    assert len({ray.get_color() for ray in rays}) == 3
    for ray, at_lens in zip(rays, (15, 0, -15), strict=True):
        x, y = data(ray)
        assert (x[0], y[0]) == (-dist, off)
        assert (x[1], y[1]) == (0, at_lens)
        assert x[2] == 11.8
        assert x[-1] > 11.8 + focal_length  # drawn beyond the focus
        assert at(ray, 11.8 + focal_length) == pytest.approx(focal_offset, rel=1e-9, abs=1e-9)
    star = labelled(ax, "focus")
    assert_allclose(np.ravel(data(star)), [11.8 + focal_length, focal_offset], atol=1e-12)
    assert f"{focal_length:.2f} mm behind" in str(star.get_label())
    assert_array_equal(np.ravel(data(labelled(ax, "source"))), [-dist, off])


def test_ray_cast_has_a_hatched_box(ax: Axes) -> None:
    plots.plot_ray_cast(28, 11.8, F60, 200, 50, ax)
    (box,) = ax.patches
    assert isinstance(box, Rectangle)
    assert box.get_hatch()
    assert (box.get_x(), box.get_y(), box.get_width(), box.get_height()) == (0, -14, 11.8, 28)


@pytest.mark.parametrize("dist", [10.0, -F60.D / F60.C])
def test_ray_cast_without_a_real_focus_marks_none(dist: float, ax: Axes) -> None:
    plots.plot_ray_cast(30, 11.8, F60, dist, 5, ax)
    assert not any("focus" in str(line.get_label()) for line in ax.lines)
    upper, lower = (labelled(ax, label) for label in ("upper edge", "lower edge"))
    near, far = (at(upper, z) - at(lower, z) for z in (11.8, 1000.0))
    if dist == 10:
        assert far > near
    else:
        assert far == pytest.approx(near, rel=1e-9)


def test_ray_cast_makes_its_own_axes() -> None:
    try:
        ax = plots.plot_ray_cast(30, 11.8, F60, 200, 50)
        assert plt.get_fignums() == [1]
        assert ax.figure is plt.figure(1)
        assert len(ax.patches) == 1
    finally:
        plt.close("all")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"lens_width": 0}, "lens_width = 0"),
        ({"lens_width": math.nan}, "lens_width = nan"),
        ({"lens_length": -1}, "lens_length = -1"),
        ({"lens_length": math.inf}, "lens_length = inf"),
        ({"source_dist": 0}, "source_dist = 0"),
        ({"axis_off": math.nan}, "axis_off = nan"),
    ],
)
def test_ray_cast_refuses_what_cast_rays_does(
    change: dict[str, float], message: str, ax: Axes
) -> None:
    good = {"lens_width": 30, "lens_length": 11.8, "source_dist": 200, "axis_off": 50}
    with pytest.raises(ValueError, match=f"^{message}"):
        plots.plot_ray_cast(lens_mat=F60, ax=ax, **{**good, **change})
    assert not ax.has_data()


# --- focus ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("dist", "where"), [(500.0, "behind"), (5000.0, "on"), (10_000.0, "before")]
)
@pytest.mark.parametrize("magnify", [1.0, 5.0])
def test_focus_is_where_it_says(dist: float, where: str, magnify: float, ax: Axes) -> None:
    sensor_dist = cast_rays(30, F60, 5000, 0).focal_length
    plots.plot_focus(30, PAIR, dist, sensor_dist, ax, magnify=magnify)
    focus = cast_rays(30, F60, dist, 0).focal_length
    title = ax.get_title() + ax.get_title("left")
    assert f"source at {dist / 1000:g} m" in title
    if where == "on":
        assert "focus on the sensor" in title
    else:
        assert f"focus {abs(focus - sensor_dist):.3f} mm {where} the sensor" in title
    assert f"beam {beam_width(30, F60, dist, sensor_dist):.3f} mm wide" in title
    assert ("drawn × 5" in title) == (magnify == 5)
    shown = PAIR.length + sensor_dist + magnify * (focus - sensor_dist)
    rays = ax.lines[:3]
    for ray, height in zip(rays, (15, 0, -15), strict=True):
        x, y = data(ray)
        assert np.interp(0, x, y) == height
        assert np.interp(shown, x, y) == pytest.approx(0, abs=1e-12)
        # straight through the focus to the right edge
        slopes = np.diff(y) / np.diff(x)
        assert slopes[-1] == pytest.approx(slopes[-2], rel=1e-12)
        # from the source: the first piece points to it
        assert y[0] - (x[0] + dist) * (y[1] - y[0]) / (x[1] - x[0]) == pytest.approx(0, abs=1e-9)
        assert (np.diff(x) > 0).all()
    x, y = data(labelled(ax, "sensor"))
    assert_allclose(x, [PAIR.length + sensor_dist] * 2)
    assert len(ax.patches) == 2


@pytest.mark.parametrize("dist", [10.0, -F60.D / F60.C])
def test_a_focus_that_is_not_behind_the_lenses(dist: float, ax: Axes) -> None:
    """Virtual or at infinity: drawn as it is, or refused, but never drawn backwards."""
    with contextlib.suppress(ValueError):
        plots.plot_focus(30, PAIR, dist, 26.1, ax)
    for ray in ax.lines[:3]:
        x, _ = data(ray)
        assert (np.diff(x) >= 0).all()


# --- systems --------------------------------------------------------------------------------


def test_outline_of_a_curved_side_is_a_circle() -> None:
    for placed in [*PAIR.layout(), *collimating_pair().layout()]:
        lens = placed.element
        assert isinstance(lens, Lens)
        corners = plots.outline(placed, lens.bends, 14.9)
        assert corners.shape == (82, 2)
        assert corners[:, 1].max() == -corners[:, 1].min() == lens.height / 2
        left, right = corners[:41], corners[41:]
        curved, plane = (right, left) if lens.reversed else (left, right)
        vertex = placed.back if lens.reversed else placed.front
        centre = vertex + (-lens.radius if lens.reversed else lens.radius)
        distance = np.hypot(curved[:, 0] - centre, curved[:, 1])
        assert_allclose(distance, abs(lens.radius), rtol=1e-12)
        assert set(plane[:, 0]) == {placed.front if lens.reversed else placed.back}
        thickness = abs(curved[0, 0] - plane[-1, 0])
        assert thickness == pytest.approx(lens.edge_thickness, rel=1e-12)


def test_outline_of_a_plate_is_a_rectangle() -> None:
    for placed in HEAD.layout():
        lens = placed.element
        if isinstance(lens, Lens) and lens.bends == "x":
            continue
        corners = plots.outline(placed, "x", 14.9)
        half = lens.length / 2 if isinstance(lens, Lens) else 14.9
        assert isinstance(lens, Lens | Plate)
        assert set(corners[:, 0]) == {placed.front, placed.back}
        assert corners[:, 1].max() == -corners[:, 1].min() == half


@pytest.mark.parametrize("meridian", ["x", "y"])
@pytest.mark.parametrize("plates", [True, False])
def test_system_shows_the_traced_rays(meridian: Meridian, plates: bool, ax: Axes) -> None:
    sources = [(5000.0, 0.0), (2000.0, 300.0)]
    plots.plot_system(HEAD, meridian, sources, ax, rays=5, width=8.0, plates=plates)
    for number, (dist, off) in enumerate(sources):
        y = np.linspace(4, -4, 5)
        z, path = HEAD.trace(np.stack([y, (y - off) / dist]), meridian, plates=plates)
        lines = ax.lines[5 * number : 5 * number + 5]
        assert len({line.get_color() for line in lines}) == 1
        for line, start, heights in zip(lines, y, path[:, 0].T, strict=True):
            x, drawn = data(line)
            assert_allclose(x[1:-1], z)
            seen = ~np.isnan(drawn[1:-1])
            assert_allclose(drawn[1:-1][seen], heights[seen], rtol=1e-12)
            # comes from the source, ends on the chip
            assert drawn[0] == pytest.approx(start + (start - off) / dist * x[0], rel=1e-12)
            assert x[-1] == pytest.approx(HEAD.length + 0.82)
    assert ax.lines[0].get_color() != ax.lines[5].get_color()
    assert [text for text in texts(ax) if text.startswith("source")] == [
        "source 5 m away, 0 m off the axis",
        "source 2 m away, 0.3 m off the axis",
    ]
    assert len(ax.patches) == 5
    assert all(isinstance(patch, Polygon) for patch in ax.patches)
    x, y = data(labelled(ax, "sensor"))
    assert_allclose(x, [HEAD.length + 0.82] * 2)
    assert_allclose(y, [-HALF, HALF] if meridian == "x" else [-0.8, 0.8])


def test_rays_that_miss_a_lens_end_there(ax: Axes) -> None:
    """Across the line rays 15 mm wide are spread beyond the 15 mm convex lens."""
    pair = collimating_pair()
    plots.plot_system(pair, "y", [(5000, 0)], ax, rays=3, width=14.0)
    _, path = pair.trace([[7.0, 0.0, -7.0], [7 / 5000, 0.0, -7 / 5000]], "y")
    assert abs(path[2, 0, 0]) > 7.5  # what follows is about something
    upper, middle, lower = (data(line)[1] for line in ax.lines[:3])
    for ray in (upper, lower):
        assert_array_equal(np.isnan(ray), [False, False, False, False, True, True])
    assert abs(upper[3]) == pytest.approx(abs(path[2, 0, 0]), rel=1e-12)  # up to where it misses
    assert not np.isnan(middle).any()


def test_rays_that_miss_the_first_lens_end_there(ax: Axes) -> None:
    plots.plot_system(PAIR, "x", [(5000, 0)], ax, rays=3, width=32.0)
    upper, middle, _ = (data(line)[1] for line in ax.lines[:3])
    assert upper[1] == 16  # a lens is 30 mm high
    assert np.isnan(upper[2:]).all()
    assert not np.isnan(middle).any()


def test_rays_fill_the_first_lens(ax: Axes) -> None:
    plots.plot_system(PAIR, "x", [(5000, 0)], ax)
    first = [data(line)[1][1] for line in ax.lines[:9]]
    assert (max(first), min(first)) == (15, -15)
    assert not any(str(line.get_label()) == "sensor" for line in ax.lines)


def test_a_sensor_can_be_put_anywhere(ax: Axes) -> None:
    plots.plot_system(PAIR, "x", [(5000, 0)], ax, width=28.0, sensor_dist=26.1)
    assert_allclose(data(labelled(ax, "sensor"))[0], [PAIR.length + 26.1] * 2)
    for line in ax.lines[:9]:
        assert abs(data(line)[1][-1]) < 0.1  # all of it near the focus


@pytest.mark.parametrize("bad", [0, -5000, math.nan])
def test_sources_without_a_distance_are_refused(bad: float, ax: Axes) -> None:
    with pytest.raises(ValueError, match=f"^source_dist = {bad:g}"):
        plots.plot_system(PAIR, "x", [(bad, 0)], ax)


# --- screens and round lenses ---------------------------------------------------------------

SLIT = Aperture("slit", x=5.0)
WITH_SLIT = OpticalSystem("slit and pair", (SLIT, *PAIR.elements), (6.0, 0.0), 26.0)


def screens(ax: Axes) -> list[NDArray[np.float64]]:
    """End points of what is drawn black and thick, where it can be seen."""
    lines = [line for line in ax.lines if line.get_color() == "k" and line.get_linewidth() == 2]
    ends = [np.stack(data(line), axis=1) for line in lines]
    return [end for end in ends if np.isfinite(end).all()]


def test_a_screen_is_drawn_beside_its_opening(ax: Axes) -> None:
    plots.plot_system(WITH_SLIT, "x", [(500, 0)], ax)
    lower, upper = screens(ax)
    assert_array_equal(lower[:, 0], 0)
    assert_array_equal(upper[:, 0], 0)
    assert (lower[0, 1], upper[0, 1]) == (-2.5, 2.5)
    assert lower[1, 1] == -upper[1, 1] < -10
    assert len(ax.patches) == 2  # no glass


def test_a_screen_is_where_it_stands(ax: Axes) -> None:
    behind = OpticalSystem("behind", (*PAIR.elements, SLIT), (0.0, 4.0), 20.0)
    plots.plot_system(behind, "x", [(500, 0)], ax)
    for side in screens(ax):
        assert_allclose(side[:, 0], 2 * 5.9 + 4.0, rtol=1e-15)


def test_a_screen_without_an_edge_in_this_meridian_hides_nothing(ax: Axes) -> None:
    plots.plot_system(WITH_SLIT, "y", [(500, 0)], ax, rays=3, width=20.0)
    assert screens(ax) == []
    for line in ax.lines[:3]:
        assert not np.isnan(data(line)[1]).any()
    assert np.isfinite([ax.get_xlim(), ax.get_ylim()]).all()


def test_a_screen_wider_than_the_window_is_drawn_too(ax: Axes) -> None:
    wide = OpticalSystem("wide", (*PAIR.elements, Aperture("wide", x=50.0)), (0.0, 4.0), 20.0)
    plots.plot_system(wide, "x", [(500, 0)], ax)
    for side in screens(ax):
        assert abs(side[0, 1]) == 25
        assert abs(side[1, 1]) > 25


def test_rays_end_at_a_screen(ax: Axes) -> None:
    plots.plot_system(WITH_SLIT, "x", [(5000, 0)], ax, rays=5, width=8.0)
    upper, inner, middle, _, lower = (data(line)[1] for line in ax.lines[:5])
    for ray in (upper, lower):
        assert abs(ray[1]) == 4  # up to the screen
        assert np.isnan(ray[2:]).all()
    for ray in (inner, middle):
        assert not np.isnan(ray).any()


def test_rays_fill_the_opening_of_a_screen_in_front(ax: Axes) -> None:
    plots.plot_system(WITH_SLIT, "x", [(5000, 0)], ax)
    first = [data(line)[1][1] for line in ax.lines[:9]]
    assert (max(first), min(first)) == (2.5, -2.5)


def test_rays_end_at_the_clear_aperture(ax: Axes) -> None:
    lens = replace(THESIS_LENSES["PCX_30_32_60"], clear=(20.0, 24.0))
    system = OpticalSystem("clear", (lens,), (), 20.0)
    plots.plot_system(system, "x", [(5000, 0)], ax)
    first = [data(line)[1][1] for line in ax.lines[:9]]
    assert (max(first), min(first)) == (10, -10)
    count = len(ax.lines)
    plots.plot_system(system, "x", [(5000, 0)], ax, rays=3, width=21.0)
    assert np.isnan(data(ax.lines[count])[1][2:]).all()
    # the glass is drawn as far as it goes
    (corners,) = {patch.get_xy()[:, 1].max() for patch in ax.patches if isinstance(patch, Polygon)}
    assert corners == 15


@pytest.mark.parametrize("meridian", ["x", "y"])
@pytest.mark.parametrize("radius", [20.0, 24.75])
def test_outline_of_a_round_lens_is_two_circles(meridian: Meridian, radius: float) -> None:
    """Up to the whole ball, whose edge may not become nothing by rounding."""
    diameter = 30.0 if radius == 20 else 2 * radius
    lens = SphericalLens("round", diameter, radius, -radius, 2 * radius, MATERIALS["N-BK7"])
    system = OpticalSystem("one", (Plate("plate", 1.0, MATERIALS["N-BK7"]), lens), (30.0,))
    corners = plots.outline(system.layout()[1], meridian, 14.9)
    assert np.isfinite(corners).all()
    assert corners[:, 1].max() == -corners[:, 1].min() == diameter / 2
    for side in (corners[:41], corners[41:]):
        # both are about the middle of a symmetric ball
        distance = np.hypot(side[:, 0] - (31.0 + radius), side[:, 1])
        assert_allclose(distance, radius, rtol=1e-6)
    assert corners[20, 0] == pytest.approx(31.0)
    assert corners[61, 0] == pytest.approx(31.0 + 2 * radius)


# --- tracking area --------------------------------------------------------------------------


def outlines(ax: Axes) -> NDArray[np.float64]:
    """Corners of the contour that bounds the tracked area, in mm."""
    (lines,) = (c for c in ax.collections if isinstance(c, QuadContourSet) and not c.filled)
    corners = [np.asarray(path.vertices) for path in lines.get_paths()]
    return 1000 * np.concatenate(corners)


def test_the_outline_of_the_tracked_area_is_the_closed_form(ax: Axes) -> None:
    plots.plot_tracking_area(AREA, ax)
    outline = outlines(ax)
    # two of three LEDs, 500 mm apart: corners where two of them are equally far from the axis
    near, far = tracking_start(F60, 250, HALF), tracking_start(F60, 500, HALF)
    for corner in [(-250, near), (250, near), (0, far), (-500, far), (500, far)]:
        assert np.hypot(*(outline - corner).T).min() < 1.0
    # and everywhere the second nearest LED is at the field edge
    distances = np.sort(np.abs(outline[:, :1] - [-500, 0, 500]), axis=1)
    assert_allclose(distances[:, 1], field_edge(F60, outline[:, 1], HALF), atol=2.0)


def test_three_leds_are_tracked_in_a_smaller_area(ax: Axes) -> None:
    plots.plot_tracking_area(AREA, ax, leds=3)
    outline = outlines(ax)
    corner = (0, tracking_start(F60, 500, HALF))  # ±500 at the edges
    assert np.hypot(*(outline - corner).T).min() < 1.0
    distances = np.abs(outline[:, :1] - [-500, 0, 500]).max(axis=1)
    assert_allclose(distances, field_edge(F60, outline[:, 1], HALF), atol=2.0)
    assert "3 or more: tracked" in texts(ax)


def test_shades_tell_how_many_leds_are_seen(ax: Axes) -> None:
    plots.plot_tracking_area(AREA, ax)
    canvas = ax.figure.canvas
    assert isinstance(canvas, FigureCanvasAgg)
    canvas.draw()
    pixels = np.asarray(canvas.buffer_rgba())
    shades = plt.get_cmap("Blues")(np.linspace(0, 0.75, 4))
    checked = set()
    for x, y in [(0, 600), (-500, 700), (300, 700), (0, 1400), (700, 1800), (0, 2500)]:
        count = int(np.sum(np.abs(x - np.array([-500, 0, 500])) <= field_edge(F60, y, HALF)))
        across, up = ax.transData.transform((x / 1000, y / 1000))
        pixel = pixels[len(pixels) - 1 - int(up), int(across)] / 255
        assert_allclose(pixel, shades[count], atol=0.01)
        checked.add(count)
    assert checked == {1, 2, 3}
    (bar,) = (other for other in ax.figure.axes if other is not ax)
    assert bar.get_ylabel() == "LEDs on the sensor"
    assert_array_equal(bar.get_yticks(), [0, 1, 2, 3])


def test_leds_are_where_they_are(ax: Axes) -> None:
    plots.plot_tracking_area(AREA, ax)
    x, y = data(ax.lines[0])
    assert_allclose(x, [-0.5, 0, 0.5])
    assert_allclose(y, 0)
    assert ax.get_xlim() == (-1.25, 1.25)
    assert ax.get_ylim() == (0, 3)
    assert ax.get_aspect() == 1


@pytest.mark.parametrize(
    ("leds", "everywhere"), [(led_line(11, 300), True), (led_line(2, 9000), False)]
)
def test_an_area_without_a_boundary_has_no_outline(
    leds: NDArray[np.float64], everywhere: bool, ax: Axes
) -> None:
    area = tracking_area(F60, leds, np.linspace(-200, 200, 9), np.linspace(3000, 4000, 5))
    assert area.tracked().all() == everywhere
    assert area.tracked().any() == everywhere
    plots.plot_tracking_area(area, ax)
    (lines,) = (c for c in ax.collections if isinstance(c, QuadContourSet) and not c.filled)
    assert sum(np.size(path.vertices) for path in lines.get_paths()) == 0


def test_a_single_led_tracks_nothing(ax: Axes) -> None:
    area = tracking_area(F60, [0.0], np.linspace(-500, 500, 9), np.linspace(100, 1000, 9))
    plots.plot_tracking_area(area, ax)
    assert not any(isinstance(c, QuadContourSet) and not c.filled for c in ax.collections)
    ax.figure.canvas.draw()


# --- resolution -----------------------------------------------------------------------------


@pytest.mark.parametrize("quantity", ["lateral", "axial"])
def test_resolution_shows_the_maps_values(quantity: str, ax: Axes) -> None:
    plots.plot_resolution(RESOLUTION, ax, quantity=quantity)
    (mesh,) = (c for c in ax.collections if isinstance(c, QuadMesh))
    values: Any = np.ma.asarray(mesh.get_array())
    expected = getattr(RESOLUTION, quantity)
    assert_array_equal(np.ma.getmaskarray(values), np.isnan(expected))
    assert_array_equal(values.compressed(), expected[~np.isnan(expected)])
    assert np.isnan(expected).any()
    (bar,) = (other for other in ax.figure.axes if other is not ax)
    direction = {"lateral": "sideways", "axial": "toward the LEDs"}[quantity]
    assert bar.get_ylabel() == f"{direction} (mm per pixel)"
    vmax = mesh.norm.vmax
    assert vmax is not None
    assert vmax >= np.nanmax(expected)  # no value is off the scale


def test_resolution_refuses_other_quantities(ax: Axes) -> None:
    with pytest.raises(ValueError, match=r"^quantity = 'both': allowed are 'lateral'"):
        plots.plot_resolution(RESOLUTION, ax, quantity="both")


def test_resolution_of_an_area_without_leds_is_refused(ax: Axes) -> None:
    nothing = resolution_map(F60, [0.0], [0.0, 1.0], [1000.0, 2000.0])
    with pytest.raises(ValueError, match="two LEDs are seen nowhere"):
        plots.plot_resolution(nothing, ax)


# --- lens comparison ------------------------------------------------------------------------


def test_beam_width_over_distance(ax: Axes) -> None:
    f100 = telecentric_pair("PCX_30_32_100").matrix("x")
    plots.plot_beam_width(30, {"f60": F60, "f100": f100}, ax, far=4000, near=800)
    for label, matrix in (("f60", F60), ("f100", f100)):
        x, y = data(labelled(ax, label))
        assert (x[0], x[-1]) == pytest.approx((0.8, 8.0))
        sensor_dist = cast_rays(30, matrix, 4000, 0).focal_length
        assert_allclose(y, beam_width(30, matrix, 1000 * x, sensor_dist), atol=1e-12)
        assert x[np.argmin(y)] == pytest.approx(4.0, rel=0.02)  # narrowest in focus
    assert_allclose(data(labelled(ax, "sensor in focus"))[0], [4, 4])
    assert ax.get_xscale() == "log"
    assert ax.get_ylim()[0] == 0
    assert [text.get_text() for text in ax.get_xticklabels()] == ["1", "2", "5"]


def test_lens_comparison_shows_every_pair(ax: Axes) -> None:
    plots.plot_lens_comparison(ROWS, ax, highlight=["LJ1430L1", "LJ1640L1"])
    (points,) = (c for c in ax.collections if isinstance(c, PathCollection))
    assert_allclose(
        np.asarray(points.get_offsets()), [(row.beam_width, row.field_edge / 1000) for row in ROWS]
    )
    values: Any = points.get_array()
    assert_allclose(values, [row.effective_focal_length for row in ROWS])
    named = {text.get_text(): text.xy for text in ax.texts if hasattr(text, "xy")}
    assert set(named) == {"two LJ1430L1, f = 30.0 mm", "two LJ1640L1, f = 65.0 mm"}
    row = next(row for row in ROWS if row.front == row.back == "LJ1430L1")
    assert named["two LJ1430L1, f = 30.0 mm"] == (row.beam_width, row.field_edge / 1000)
    (bar,) = (other for other in ax.figure.axes if other is not ax)
    assert [text.get_text() for text in bar.get_yticklabels()] == ["30", "50"]
