"""Figures of the studies: functions that draw into an `Axes` and return it.

Rays are paraxial: they bend at vertex planes, whatever shape is drawn around them. `style()` loads
the package's one style file.
"""

from __future__ import annotations

from importlib.resources import as_file
from typing import TYPE_CHECKING

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import BoundaryNorm, ListedColormap
from matplotlib.lines import Line2D
from matplotlib.patches import Polygon, Rectangle
from matplotlib.ticker import MaxNLocator

from raytransfer import _checks as check
from raytransfer._data import FOLDER
from raytransfer.casting import cast_rays
from raytransfer.lenses import Aperture, Element, Meridian, Plate
from raytransfer.sensors import TCD1304, LineSensor
from raytransfer.studies import FAR, NEAR, beam_width

if TYPE_CHECKING:
    from collections.abc import Sequence

    from matplotlib.axes import Axes
    from numpy.typing import ArrayLike, NDArray

    from raytransfer.matrices import RayMatrix
    from raytransfer.studies import AreaMap, PairStudy, ResolutionMap
    from raytransfer.systems import OpticalSystem, Placed

GLASS = "#9ecae1"
RAYS = ("#D55E00", "#0072B2", "#009E73")
SENSOR = "#404040"
LED = "#E69F00"
TRACKED = "#c1121f"


def style() -> None:
    """Use the package's style for all figures from now on."""
    with as_file(FOLDER / "linetrack.mplstyle") as path:
        plt.style.use(path)


def ray_paths(
    lens_width: float,
    lens_length: float,
    lens_mat: RayMatrix | ArrayLike,
    source_dist: float,
    axis_off: float,
    end: float,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Three rays through the upper edge, the middle and the lower edge of a system.

    Parameters
    ----------
    lens_width, lens_length : float
        Full aperture and length of the system, mm.
    lens_mat, source_dist, axis_off
        As for `cast_rays`.
    end : float
        How far the rays go on behind the system, mm.

    Returns
    -------
    z : ndarray, shape (4,)
        Source, first vertex (0), last vertex and end, mm.
    heights : ndarray, shape (4, 3)
        Of the three rays there, mm.
    """
    y = np.array([0.5, 0.0, -0.5]) * lens_width
    before = np.stack([y, (y - axis_off) / source_dist])
    after = np.asarray(lens_mat) @ before
    z = np.array([-source_dist, 0.0, lens_length, lens_length + end])
    return z, np.stack([np.full(3, axis_off), y, after[0], after[0] + end * after[1]])


def plot_ray_cast(
    lens_width: float,
    lens_length: float,
    lens_mat: RayMatrix | ArrayLike,
    source_dist: float,
    axis_off: float,
    ax: Axes | None = None,
) -> Axes:
    """Three rays from a source through a hatched box to their focus (figure 4.5).

    Parameters
    ----------
    lens_width, lens_length : float
        Full aperture and length of the system, mm, > 0.
    lens_mat : RayMatrix or array_like, shape (2, 2)
    source_dist, axis_off : float
        Distance of the source along and from the axis, mm.
    ax : Axes, optional
        A new one when left out.

    Raises
    ------
    ValueError
        If a number is not finite, or a width, length or distance is not positive.
    """
    check.positive("lens_length", lens_length, "the length of the box in mm")
    source_dist = check.positive("source_dist", source_dist, "one source is drawn")
    axis_off = check.number("axis_off", axis_off, "one source is drawn")
    focal_length, focal_offset = cast_rays(lens_width, lens_mat, source_dist, axis_off)
    ax = ax if ax is not None else plt.subplots()[1]
    real = np.isfinite(focal_length) and focal_length > 0
    # without a real focus there is nothing to stop at: show as much behind as in front
    end = 1.25 * focal_length if real else source_dist
    z, heights = ray_paths(lens_width, lens_length, lens_mat, source_dist, axis_off, end)
    for ray, colour, label in zip(
        heights.T, RAYS, ("upper edge", "middle", "lower edge"), strict=True
    ):
        ax.plot(z, ray, color=colour, label=label)
    ax.add_patch(
        Rectangle(
            (0, -lens_width / 2),
            lens_length,
            lens_width,
            facecolor=GLASS,
            alpha=0.5,
            hatch="///",
            edgecolor="0.4",
            zorder=3,
        )
    )
    ax.plot(-source_dist, axis_off, "o", color=LED, zorder=4, label="source")
    if real:
        ax.plot(
            lens_length + focal_length,
            focal_offset,
            "k*",
            markersize=9,
            zorder=5,
            label=f"focus {focal_length:.2f} mm behind,\n{focal_offset:.2f} mm off axis".replace(
                "-", "−"
            ),
        )
    _axis(ax)
    ax.legend(loc="upper right")
    return ax


def _axis(ax: Axes) -> None:
    ax.axhline(0, color="0.5", linewidth=0.8, dashes=(8, 4), zorder=0)
    ax.set(xlabel="along the axis from the first surface (mm)", ylabel="height (mm)")


def plot_focus(
    lens_width: float,
    system: OpticalSystem,
    source_dist: float,
    sensor_dist: float,
    ax: Axes,
    *,
    magnify: float = 1.0,
) -> Axes:
    """Where the focus of a source lies relative to the sensor (figure 4.4, one of a to c).

    Parameters
    ----------
    lens_width : float
        Full aperture, mm.
    system : OpticalSystem
    source_dist : float
        mm; the rays from the source come in from the left edge.
    sensor_dist : float
        From the last vertex to the sensor, mm.
    ax : Axes
    magnify : float
        Draws the distance between focus and sensor so many times as large; the title tells the
        true one.
    """
    matrix = system.matrix("x")
    focus, _ = cast_rays(lens_width, matrix, source_dist, 0.0)
    if not 0 < focus < np.inf:
        raise ValueError(
            f"source_dist = {source_dist:g} mm: the source is within the front focal length "
            "and has no focus behind the lenses"
        )
    width = beam_width(lens_width, matrix, source_dist, sensor_dist)
    defocus = focus - sensor_dist
    shown = sensor_dist + magnify * defocus
    y = np.array([0.5, 0.0, -0.5]) * lens_width
    for height, colour in zip(y, RAYS, strict=True):
        entry = height * (1 - 20 / source_dist)
        exit_height = (matrix @ np.array([height, height / source_dist]))[0]
        z = [-20, 0, system.length, system.length + shown, system.length + 1.35 * sensor_dist]
        slope = -exit_height / shown
        ax.plot(z, [entry, height, exit_height, 0, slope * (z[-1] - z[-2])], color=colour)
    _draw_glass(ax, system, "x", lens_width / 2)
    _draw_sensor(ax, system.length + sensor_dist, lens_width / 2)
    ax.annotate(
        "sensor",
        (system.length + sensor_dist, lens_width / 2),
        (0, 3),
        textcoords="offset points",
        ha="center",
        fontsize=9,
    )
    where = "on the sensor"
    if abs(defocus) > 1e-9:
        where = f"{abs(defocus):.3f} mm {'behind' if defocus > 0 else 'before'} the sensor"
    drawn = f", drawn × {magnify:g}" if magnify != 1 else ""
    ax.set_title(
        f"source at {source_dist / 1000:g} m{drawn}\nfocus {where}\nbeam {width:.3f} mm wide"
    )
    _axis(ax)
    if magnify != 1:
        ax.set_xlabel("along the axis (mm), focus not to scale")
    return ax


def outline(placed: Placed, meridian: Meridian, window: float) -> NDArray[np.float64]:
    """Corners of an element's cross-section, shape (82, 2): z and height in mm.

    Parameters
    ----------
    placed : Placed
    meridian : {"x", "y"}
    window : float
        Half size in mm of elements that are not lenses.
    """
    element, front, _ = placed
    half = _half_size(element, meridian, window)
    y = np.linspace(half, -half, 41)
    at = (y, 0.0) if meridian == "x" else (0.0, y)
    left, right = (
        np.stack([front + side.z + side.sag(*at) + 0 * y, y], 1) for side in element.surfaces()
    )
    return np.concatenate([left, right[::-1]])


def _draw_glass(ax: Axes, system: OpticalSystem, meridian: Meridian, window: float) -> None:
    for placed in system.layout():
        if isinstance(placed.element, Aperture):
            half = placed.element.aperture(meridian) / 2
            for side in (-1, 1):
                end = side * max(1.5 * half, window)
                ax.plot([placed.front] * 2, [side * half, end], color="k", linewidth=2)
            continue
        bends = any(meridian in side.bends for side in placed.element.surfaces())
        ax.add_patch(glass(outline(placed, meridian, window), bends=bends))


def glass(corners: NDArray[np.float64], *, bends: bool) -> Polygon:
    """Return a cross-section (N, 2) as glass; paler where it bends nothing in this meridian."""
    return Polygon(
        corners,
        facecolor=GLASS,
        edgecolor="0.35",
        alpha=0.7 if bends else 0.35,
        linewidth=0.8,
        zorder=3,
    )


def plot_system(
    system: OpticalSystem,
    meridian: Meridian,
    sources: Sequence[tuple[float, float]],
    ax: Axes,
    *,
    rays: int = 9,
    width: float | None = None,
    plates: bool = True,
    sensor_dist: float | None = None,
    sensor: LineSensor = TCD1304,
) -> Axes:
    """Rays of one or more sources through the lenses of a system (figure 4.3).

    A ray that misses a lens ends there.

    Parameters
    ----------
    system : OpticalSystem
    meridian : {"x", "y"}
    sources : sequence of (source_dist, axis_off)
        mm; each gets its own colour, its rays come in from the left edge.
    ax : Axes
    rays : int
        Rays per source.
    width : float, optional
        Aperture that the rays fill at the first vertex, mm; left out, the first lens's.
    plates : bool
        As for `OpticalSystem.matrix`.
    sensor_dist : float, optional
        From the last vertex to the sensor, mm; left out, the system's own.
    sensor : LineSensor
        Drawn to its length, or as a thick point in the other meridian.
    """
    window = 0.51 * sensor.length  # a little longer than the pixels
    if width is None:
        opening = _half_opening(system.elements[0], meridian, window)
        width = 2 * (opening if np.isfinite(opening) else window)
    end = system.sensor_distance if sensor_dist is None else sensor_dist
    behind = 20.0 if end is None else end
    lead = 0.35 * (system.length + behind)
    y = np.linspace(0.5, -0.5, rays) * width
    for number, (source_dist, axis_off) in enumerate(sources):
        slopes = (y - axis_off) / check.positive("source_dist", source_dist)
        z, path = system.trace(np.stack([y, slopes]), meridian, plates=plates)
        start, last = y - lead * slopes, path[-1]
        heights = np.vstack([start, path[:, 0], last[0] + behind * last[1]])
        half = [_half_opening(element, meridian, window) for element in system.elements]
        missed = np.abs(path[:, 0]) > np.repeat(half, 2)[:, None] + 1e-9
        gone = np.maximum.accumulate(missed)
        heights[2:][gone] = np.nan  # drawn up to the vertex where it misses
        label = f"source {source_dist / 1000:g} m away, {axis_off / 1000:g} m off the axis"
        ax.plot(
            [-lead, *z, z[-1] + behind],
            heights,
            color=RAYS[number % len(RAYS)],
            linewidth=0.9,
            label=[label] + [None] * (rays - 1),
        )
    _draw_glass(ax, system, meridian, window)
    if end is not None:
        half_line = sensor.length / 2 if meridian == "x" else 4 * sensor.pixel_height
        _draw_sensor(ax, system.length + end, half_line)
    _axis(ax)
    ax.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=2, borderaxespad=0.2)
    return ax


def _half_size(element: Element, meridian: Meridian, window: float) -> float:
    half = element.size(meridian) / 2
    return half if np.isfinite(half) else window


def _half_opening(element: Element, meridian: Meridian, window: float) -> float:
    half = element.aperture(meridian) / 2
    return window if isinstance(element, Plate) else half


def _draw_sensor(ax: Axes, z: float, half: float) -> None:
    ax.plot(
        [z, z],
        [-half, half],
        color=SENSOR,
        linewidth=3,
        solid_capstyle="butt",
        zorder=4,
        label="sensor",
    )


def _draw_leds(ax: Axes, area: AreaMap) -> None:
    ax.plot(
        area.leds[:, 0] / 1000,
        area.leds[:, 1] / 1000,
        "o",
        color=LED,
        markeredgecolor="k",
        markeredgewidth=0.5,
        clip_on=False,
        zorder=5,
    )
    ax.set(
        xlabel="x along the LEDs (m)",
        ylabel="y from the LEDs (m)",
        aspect="equal",
        xlim=area.x[[0, -1]] / 1000,
        ylim=(min(0.0, area.y.min() / 1000), area.y.max() / 1000),
    )
    ax.grid(visible=False)


def plot_tracking_area(area: AreaMap, ax: Axes, *, leds: int = 2) -> Axes:
    """How many LEDs are seen from where, and the area that is tracked, outlined (figure 4.1).

    Parameters
    ----------
    area : AreaMap
    ax : Axes
    leds : int
        How many LEDs tracking needs.
    """
    x, y = area.x / 1000, area.y / 1000
    most = max(int(area.count.max()), leds)
    shades = plt.get_cmap("Blues")(np.linspace(0, 0.75, most + 1))
    # the k-th nearest image to the axis decides whether k LEDs are seen
    nearest = np.sort(np.abs(area.position), axis=0)[:most]
    nearest = np.minimum(nearest, 10 * area.half_length)
    for k, distance in enumerate(nearest, start=1):
        ax.contourf(x, y, distance, levels=[0, area.half_length], colors=[shades[k]])
    if leds <= len(nearest):
        ax.contour(
            x, y, nearest[leds - 1], levels=[area.half_length], colors=TRACKED, linewidths=1.8
        )
    scale = ScalarMappable(
        BoundaryNorm(np.arange(-0.5, most + 1), most + 1), ListedColormap(shades)
    )
    ax.figure.colorbar(scale, ax=ax, label="LEDs on the sensor", ticks=np.arange(most + 1))
    ax.legend(
        handles=[
            Line2D([], [], color=TRACKED, label=f"{leds} or more: tracked"),
            Line2D([], [], marker="o", color=LED, linestyle="", label="LED"),
        ],
        loc="lower left",
        bbox_to_anchor=(0, 1),
        ncols=2,
        borderaxespad=0.2,
    )
    _draw_leds(ax, area)
    return ax


LABELS = {"lateral": "sideways", "axial": "toward the LEDs"}


def plot_resolution(
    resolution: ResolutionMap, ax: Axes, *, quantity: str = "lateral", levels: int = 9
) -> Axes:
    """What a pixel is worth over the tracked area.

    Parameters
    ----------
    resolution : ResolutionMap
    ax : Axes
    quantity : {"lateral", "axial"}
    levels : int
        About how many steps of colour.
    """
    if quantity not in LABELS:
        raise ValueError(f"quantity = {quantity!r}: allowed are 'lateral' and 'axial'")
    values = np.ma.masked_invalid(getattr(resolution, quantity))
    if values.mask.all():
        raise ValueError("two LEDs are seen nowhere on this grid: widen it, or move the LEDs")
    steps = MaxNLocator(levels).tick_values(0, float(values.max()))
    mesh = ax.pcolormesh(
        resolution.x / 1000,
        resolution.y / 1000,
        values,
        rasterized=True,
        cmap="viridis_r",
        norm=BoundaryNorm(steps, 256),
    )
    ax.figure.colorbar(mesh, ax=ax, label=f"{LABELS[quantity]} (mm per pixel)")
    _draw_leds(ax, resolution)
    return ax


def plot_beam_width(
    lens_width: float,
    pairs: dict[str, RayMatrix],
    ax: Axes,
    *,
    far: float = FAR,
    near: float = NEAR,
) -> Axes:
    """Beam width on a sensor in the far focus, over the distance of the source.

    Parameters
    ----------
    lens_width : float
        Full aperture, mm.
    pairs : dict of str to RayMatrix
        Systems by label.
    ax : Axes
    far, near : float
        Range of distances, mm.
    """
    distances = np.geomspace(near, 2 * far, 200)
    for label, matrix in pairs.items():
        sensor_dist = cast_rays(lens_width, matrix, far, 0.0).focal_length
        ax.plot(
            distances / 1000, beam_width(lens_width, matrix, distances, sensor_dist), label=label
        )
    ax.axvline(far / 1000, color="0.5", linewidth=0.8, dashes=(8, 4), label="sensor in focus")
    ax.set(xlabel="distance of the source (m)", ylabel="beam width (mm)", ylim=0)
    _plain_log_axis(ax, distances / 1000)
    ax.legend()
    return ax


def plot_lens_comparison(
    rows: Sequence[PairStudy], ax: Axes, *, highlight: Sequence[str] = ()
) -> Axes:
    """Field edge over beam width for every pair: the two wishes that decide a choice.

    Parameters
    ----------
    rows : sequence of PairStudy
        From `lens_selection`.
    ax : Axes
    highlight : sequence of str
        Part numbers whose pair of equals is named in the figure.
    """
    width = [row.beam_width for row in rows]
    edge = [row.field_edge / 1000 for row in rows]
    focal = np.array([row.effective_focal_length for row in rows])
    points = ax.scatter(
        width, edge, c=focal, cmap="viridis_r", norm="log", s=22, edgecolors="0.3", linewidths=0.4
    )
    bar = ax.figure.colorbar(points, ax=ax, label="effective focal length (mm)")
    ticks = [t for t in (20, 30, 50, 100, 200, 500) if focal.min() <= t <= focal.max()]
    bar.set_ticks(ticks, labels=[f"{t}" for t in ticks])
    bar.minorticks_off()
    for row in rows:
        if row.front == row.back and row.front in highlight:
            late = row.beam_width > np.sqrt(min(width) * max(width))
            ax.plot(
                row.beam_width,
                row.field_edge / 1000,
                "o",
                color="none",
                markersize=10,
                markeredgecolor="k",
                markeredgewidth=1,
            )
            ax.annotate(
                f"two {row.front}, f = {row.effective_focal_length:.1f} mm",
                (row.beam_width, row.field_edge / 1000),
                (0, 26) if late else (8, 4),
                textcoords="offset points",
                ha="right" if late else "left",
                fontsize=9,
            )
    _plain_log_axis(ax, width)
    ax.set(
        xlabel="beam width at the near distance (mm)",
        ylabel="field edge at the far distance (m)",
        ylim=0,
    )
    return ax


def _plain_log_axis(ax: Axes, values: ArrayLike) -> None:
    """Give the x axis a logarithmic scale with ticks at 1, 2 and 5 and no powers of ten."""
    low, high = np.min(values), np.max(values)
    ticks = [step * 10.0**power for power in range(-3, 5) for step in (1, 2, 5)]
    ax.set_xscale("log")
    ax.set_xlim(low * 0.9, high * 1.1)
    ax.set_xticks([t for t in ticks if low * 0.9 <= t <= high * 1.1])
    ax.xaxis.set_major_formatter("{x:g}")
    ax.minorticks_off()
