"""What the figures of exact light show: their data against the trace, their labels."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations, pairwise
from typing import TYPE_CHECKING, Any

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import PolyCollection, QuadMesh
from matplotlib.contour import QuadContourSet
from matplotlib.figure import Figure
from matplotlib.patches import Polygon, StepPatch
from numpy.testing import assert_allclose

from raytransfer import TCD1304, cast_rays, exact_plots, plots, prototype_head, telecentric_pair
from raytransfer.analysis import fan, field_study, spot, through_focus
from raytransfer.illumination import footprint
from raytransfer.lenses import Aperture
from raytransfer.plots import RAYS
from raytransfer.systems import OpticalSystem, Placement
from raytransfer.tracing import Status, trace

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.lines import Line2D

    from raytransfer.lenses import Meridian

mpl.use("Agg")

BARE = telecentric_pair()
FOCUS = float(cast_rays(30, BARE.matrix("x"), 5000, 0).focal_length)
PAIR = replace(BARE, sensor_distance=FOCUS)
HEAD = prototype_head()
HALF = TCD1304.length / 2
DISTANCE = np.linspace(600, 5000, 5)[:, None]
STUDY = field_study(
    PAIR, DISTANCE, DISTANCE * np.tan(np.radians(np.linspace(-25, 25, 11))), rays=801
)
FIELD = field_study(PAIR, 5000, np.linspace(0, 2420, 12), rays=4001)


@pytest.fixture
def ax() -> Axes:
    figure = Figure(figsize=(6, 4), dpi=60, layout="constrained")
    FigureCanvasAgg(figure)
    return figure.add_subplot()


def texts(ax: Axes) -> list[str]:
    legend = ax.get_legend()
    assert legend is not None
    return [text.get_text() for text in legend.get_texts()]


def xy(line: Line2D) -> tuple[list[float], list[float]]:
    return list(np.asarray(line.get_xdata(), float)), list(np.asarray(line.get_ydata(), float))


def meshed(ax: Axes) -> tuple[QuadMesh, Any]:
    """Return the mesh in a figure and its values, as a masked array."""
    mesh = next(c for c in ax.collections if isinstance(c, QuadMesh))
    return mesh, np.ma.asarray(mesh.get_array())


def contours(ax: Axes) -> QuadContourSet:
    return next(c for c in ax.collections if isinstance(c, QuadContourSet))


def drawn(ax: Axes) -> None:
    """Draw it, so that what only fails then does."""
    figure = ax.figure
    assert isinstance(figure, Figure)
    figure.canvas.draw()


# --- rays ---


@pytest.mark.parametrize("meridian", ["x", "y"])
def test_rays_end_where_the_trace_ends(ax: Axes, meridian: Meridian) -> None:
    offset = 900.0
    exact_plots.plot_rays(HEAD, meridian, [(5000, offset)], ax, rays=15)
    drawn(ax)
    light = fan(HEAD, meridian, 5000, offset, rays=15)
    arrived = light.x if meridian == "x" else light.y
    end = HEAD.length + (HEAD.sensor_distance or 0)
    rays = [line for line in ax.lines if line.get_color() == RAYS[0] and len(xy(line)[0]) > 2]
    rays = [line for line in rays if line.get_marker() == "None"]
    assert len(rays) == 15
    finish = [xy(line)[1][-1] for line in rays if abs(xy(line)[0][-1] - end) < 1e-9]
    assert_allclose(finish, arrived, atol=1e-9)
    crosses = next(line for line in ax.lines if line.get_marker() == "x")
    assert len(xy(crosses)[0]) == 15 - len(arrived) > 0
    assert max(xy(crosses)[0]) < end
    assert texts(ax) == ["source 5 m away, 0.9 m off the axis", "sensor", "ray lost"]


def test_lines_bend_on_the_curves_themselves(ax: Axes) -> None:
    exact_plots.plot_rays(PAIR, "x", [(5000, 0)], ax, rays=5)
    outline = next(patch for patch in ax.patches if isinstance(patch, Polygon)).get_xy()
    ray = next(line for line in ax.lines if line.get_color() == RAYS[0])
    z, height = xy(ray)
    curved = BARE.elements[0].surfaces()[1]
    assert_allclose(z[2], curved.z + curved.sag(height[2], 0.0), atol=1e-9)
    inner = np.asarray(outline)
    near = np.abs(inner[:, 1] - height[2]).argmin()
    assert abs(inner[near, 1] - height[2]) < 0.2
    assert "ray lost" not in texts(ax)


def test_placed_elements_and_slits_are_drawn_where_they_are(ax: Axes) -> None:
    first, second = BARE.elements
    system = OpticalSystem(
        "tilted",
        (Aperture("slit", x=6.0), first, second),
        (5.0, 3.0),
        FOCUS,
        (Placement((2.0, 0.0)), Placement(), Placement((0.0, 0.0), (0.0, 0.1, 0.0))),
    )
    exact_plots.plot_rays(system, "x", [(5000, 0)], ax, rays=7)
    drawn(ax)
    blades = [line for line in ax.lines if line.get_color() == "k"]
    assert sorted(xy(blade)[1][0] for blade in blades) == [-1.0, 5.0]
    polygon = np.asarray([p for p in ax.patches if isinstance(p, Polygon)][1].get_xy())
    vertex = system.layout()[2].front
    # the flat back leans by 0.1 rad: a tilt about Y takes Z toward X
    flat = polygon[81:162]
    slope = np.polyfit(flat[:, 1], flat[:, 0], 1)[0]
    assert_allclose(slope, -np.tan(0.1), rtol=1e-9)
    assert polygon[:, 0].min() > vertex - 3


# --- light ---


def test_profile_is_the_light_of_each_pixel(ax: Axes) -> None:
    light = fan(PAIR, "x", 500, 0)
    exact_plots.plot_profile(light, ax, paraxial=footprint(PAIR, "x", 500, 0))
    drawn(ax)
    values, _, _ = next(p for p in ax.patches if isinstance(p, StepPatch)).get_data()
    assert len(values) == TCD1304.pixels
    assert_allclose(values[values > 1e-3].sum(), 100, rtol=1e-3)
    box = next(line for line in ax.lines if line.get_color() == RAYS[0])
    x, y = xy(box)
    assert_allclose(x[2] - x[1], 1.606, atol=1e-3)
    assert_allclose((x[2] - x[1]) / TCD1304.pitch * y[1], 100)
    assert texts(ax) == ["exact", "paraxial", "median"]
    low, high = ax.get_xlim()
    assert -HALF < low < -1 < 1 < high < HALF


def test_profile_shows_the_end_of_the_line(ax: Axes) -> None:
    exact_plots.plot_profile(
        fan(PAIR, "x", 5000, 2420), ax, paraxial=footprint(PAIR, "x", 5000, 2420)
    )
    assert "beyond the line" in texts(ax)
    assert_allclose(ax.get_xlim()[0], -1.02 * HALF)
    exact_plots.plot_profile(fan(PAIR, "x", 5000, 0), ax, within=(-1, 2))
    assert ax.get_xlim() == (-1, 2)


def test_no_light_is_shown_as_none(ax: Axes) -> None:
    shut = OpticalSystem("shut", (*BARE.elements, Aperture("slit", x=0.1)), (0.0, 20.0), 1.0)
    light = fan(shut, "x", 5000, 2000, rays=101)
    exact_plots.plot_profile(light, ax, paraxial=footprint(PAIR, "x", 5000, 2000))
    drawn(ax)
    values, _, _ = next(p for p in ax.patches if isinstance(p, StepPatch)).get_data()
    assert_allclose(values, 1e-3)  # the floor of the axis
    assert texts(ax) == ["exact: no light arrives", "paraxial"]
    assert_allclose(ax.get_xlim(), (-HALF, HALF))
    exact_plots.plot_profile(light, ax, within=(-1, 2))
    assert ax.get_xlim() == (-1, 2)


def test_spot_shows_all_light_on_the_plane(ax: Axes) -> None:
    light = spot(HEAD, (300, 200, 3000), 301, 301)
    exact_plots.plot_spot(light, ax, pixel=0.2)
    drawn(ax)
    mesh, values = meshed(ax)
    corners = np.asarray(mesh.get_coordinates())
    edges = corners[0, :, 0], corners[:, 0, 1]
    expected, _, _ = np.histogram2d(light.x, light.y, edges, weights=light.weight)
    assert_allclose(values.filled(0.0) ** 2, expected.T / expected.max(), atol=1e-12)
    on = np.abs(light.x) <= HALF
    assert_allclose(expected.sum(), light.weight[on].sum(), rtol=0.02)
    low, high = ax.get_xlim()
    assert low < light.x[on].min() < light.x[on].max() < high
    rails = sorted(xy(line)[1][0] for line in ax.lines)
    assert_allclose(rails, [-TCD1304.pixel_height / 2, TCD1304.pixel_height / 2])


# --- maps and curves ---


@pytest.mark.parametrize("quantity", exact_plots.QUANTITIES)
def test_maps_show_the_study(ax: Axes, quantity: str) -> None:
    exact_plots.plot_map(STUDY, ax, quantity=quantity)
    drawn(ax)
    expected = {
        "w50": STUDY.light.w50,
        "w80": STUDY.light.w80,
        "displacement": abs(STUDY.light.peak - STUDY.paraxial),
        "lost": 100 * STUDY.lost,
        "on_sensor": 100 * STUDY.on_sensor,
        "useful": 100 * STUDY.useful,
    }[quantity]
    bands = contours(ax)
    levels = np.asarray(bands.levels)
    found = 0
    for k, (low, high) in enumerate(pairwise(levels)):
        inside = (expected > low + 0.02 * (high - low)) & (expected < high - 0.02 * (high - low))
        inside[[0, -1]] = inside[:, [0, -1]] = False  # on the rim of the map
        points = np.stack([STUDY.axis_off[inside], STUDY.source_dist[inside]], axis=1) / 1000
        found += len(points)
        assert bands.get_paths()[k].contains_points(points).all()
    assert found > 10
    assert levels[0] <= expected.min() < expected.max() <= levels[-1]
    assert ax.get_xlabel() == "offset of the source (m)"
    figure = ax.figure
    assert isinstance(figure, Figure)
    assert figure.axes[1].get_ylabel() == exact_plots.QUANTITIES[quantity]
    ticks = [float(t) for t in figure.axes[1].get_yticks()]
    if "%" in exact_plots.QUANTITIES[quantity] and quantity in ("lost", "on_sensor", "useful"):
        assert min(ticks) >= 0
        assert max(ticks) <= 100


def test_maps_leave_out_what_is_not_imaged_on_the_line(ax: Axes) -> None:
    wide = field_study(PAIR, [[2000.0], [3500.0], [4000.0]], [0.0, 500.0, 1500.0, 2500.0], rays=101)
    exact_plots.plot_map(wide, ax)
    drawn_to = np.concatenate([np.asarray(path.vertices) for path in contours(ax).get_paths()])
    assert_allclose(drawn_to.max(axis=0), [1.5, 4.0])
    unseen = [[0.6, 2.0], [1.5, 2.0], [2.5, 3.9]]
    for band in contours(ax).get_paths():
        assert not band.contains_points(unseen).any()
    with pytest.raises(ValueError, match="no source of the grid"):
        exact_plots.plot_map(field_study(PAIR, [[500.0]], [900.0, 950.0], rays=11), ax)
    with pytest.raises(ValueError, match="a map needs a grid"):
        exact_plots.plot_map(FIELD, ax)
    with pytest.raises(ValueError, match="quantity = 'sharpness'"):
        exact_plots.plot_map(STUDY, ax, quantity="sharpness")


def test_focus_curves_and_their_lowest_points(ax: Axes) -> None:
    shifts = np.linspace(-8, 4, 61)
    lights = {"near": fan(PAIR, "x", 500, 0, rays=1001), "far": fan(PAIR, "x", 5000, 0, rays=1001)}
    exact_plots.plot_focus_curves(lights, ax, shifts, width="rms")
    for number, light in enumerate(lights.values()):
        curve, dot = ax.lines[2 * number], ax.lines[2 * number + 1]
        assert_allclose(xy(curve)[1], through_focus(light, shifts).rms)
        assert_allclose(xy(dot)[0][0], light.best_focus()[0], atol=0.1)
    assert texts(ax) == ["near", "far", "sensor"]
    assert ax.get_ylabel() == "RMS width (mm)"
    with pytest.raises(ValueError, match="width = 'narrow'"):
        exact_plots.plot_focus_curves(lights, ax, shifts, width="narrow")  # type: ignore[arg-type]


def test_distortion_is_toward_the_axis(ax: Axes) -> None:
    exact_plots.plot_distortion(FIELD, ax)
    chief, median, peak = (np.array(xy(line)[1]) for line in ax.lines[:3])
    assert_allclose(chief, FIELD.chief - FIELD.paraxial)
    assert 0 < chief[-1] < median[-1] < peak[-1]
    assert_allclose(xy(ax.lines[0])[0], np.degrees(np.arctan(FIELD.axis_off / 5000)))
    other = field_study(PAIR, 5000, -FIELD.axis_off, rays=4001)
    exact_plots.plot_distortion(other, ax)
    assert_allclose(xy(ax.lines[4])[1], chief, atol=1e-9)


def test_losses_add_up(ax: Axes) -> None:
    exact_plots.plot_losses(FIELD, ax)
    drawn(ax)
    areas = [c for c in ax.collections if isinstance(c, PolyCollection)]
    assert texts(ax) == [
        "on the sensor",
        "beyond its ends",
        "reflected by surfaces",
        "outside an opening",
        "totally reflected",
    ]
    assert len(areas) == 5
    light = fan(PAIR, "x", 5000, 2420, rays=4001)
    useful = 100 * light.arrived * light.on()
    thick = [useful, 100 * light.arrived - useful, 100 * light.faded / light.entered]
    thick += [100 * light.lost_share(kind) for kind in (Status.BLOCKED, Status.REFLECTED)]
    edge = np.degrees(np.arctan2(2420, 5000))
    for area, expected in zip(areas, thick, strict=True):
        points = np.asarray(area.get_paths()[0].vertices)
        there = points[np.isclose(points[:, 0], edge), 1]
        assert_allclose(np.ptp(there), expected, atol=1e-9)
    top = np.asarray(areas[-1].get_paths()[0].vertices)[:, 1].max()
    assert_allclose(top, 100, atol=0.05)


def test_head_in_space() -> None:
    figure = Figure(figsize=(6, 4), dpi=60)
    FigureCanvasAgg(figure)
    ax = figure.add_subplot(projection="3d")
    source = (200.0, 300.0, 2000.0)
    exact_plots.plot_head(HEAD, [source], ax, rays=(5, 3))
    figure.canvas.draw()
    rays = [line for line in ax.lines if line.get_color() == RAYS[0]]
    assert len(rays) == 15
    end = HEAD.length + (HEAD.sensor_distance or 0)
    ends = [np.array(line.get_data_3d())[:, -1] for line in rays]
    arrived = sorted(tuple(p[1:]) for p in ends if abs(p[0] - end) < 1e-9)
    light = spot(HEAD, source, 5, 3)
    assert_allclose(arrived, sorted(zip(light.x, light.y, strict=True)), atol=1e-9)
    assert 0 < len(arrived) < 15
    assert [text.get_text() for text in ax.get_legend().get_texts()] == [
        "source at 0.2, 0.3, 2 m",
        "pixel line",
    ]


@pytest.mark.parametrize("sources", [[(0, 0, 5000), (1500, 800, 5000)], [(200, 300, 2000)]])
def test_labels_of_the_head_in_space_do_not_overlap(
    sources: list[tuple[float, float, float]],
) -> None:
    with mpl.rc_context():
        plots.style()
        figure = Figure(figsize=(7, 4.6))
        FigureCanvasAgg(figure)
        ax = figure.add_subplot(projection="3d")
        exact_plots.plot_head(HEAD, sources, ax)
        figure.canvas.draw()
    boxes = []
    for axis in (ax.xaxis, ax.yaxis, ax.zaxis):
        low, high = sorted(axis.get_view_interval())
        ticks = [t for t in axis.get_major_ticks() if low <= t.get_loc() <= high]
        assert len(ticks) >= 3
        boxes += [t.label1.get_window_extent() for t in ticks]
    for first, second in combinations(boxes, 2):
        assert not first.overlaps(second)


def test_what_is_not_a_system_in_focus_is_drawn_too(ax: Axes) -> None:
    """Without a sensor rays go to the last vertex."""
    exact_plots.plot_rays(BARE, "x", [(5000, 0)], ax, rays=3)
    ray = next(line for line in ax.lines if line.get_color() == RAYS[0])
    assert_allclose(xy(ray)[0][-1], BARE.length)
    start = np.array([[0.0], [0.0], [-5000.0]])
    assert trace(BARE, start, [[0.0], [0.0], [1.0]]).arrived.all()
