"""Figures of exact light: functions that draw into an `Axes` and return it.

They share colours with `plots`, whose rays are paraxial.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from raytransfer import _checks as check
from raytransfer.analysis import WIDTHS, FieldStudy, Spot, Width, through_focus
from raytransfer.lenses import Aperture, Meridian, check_meridian
from raytransfer.plots import GLASS, RAYS, SENSOR, glass
from raytransfer.reference import path
from raytransfer.sensors import TCD1304, LineSensor
from raytransfer.systems import MERIDIANS
from raytransfer.tracing import front_opening, trace

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from matplotlib.axes import Axes
    from mpl_toolkits.mplot3d import Axes3D  # type: ignore[import-untyped]
    from numpy.typing import ArrayLike, NDArray

    from raytransfer.illumination import Footprint
    from raytransfer.lenses import Element
    from raytransfer.systems import OpticalSystem

    Array = NDArray[np.float64]

PARAXIAL = "0.45"
"""What is paraxial is grey and dashed."""

DASHES = (0, (4, 2))

QUANTITIES = {
    "w80": "width that holds 80 % of the light (mm)",
    "w50": "width that holds 50 % of the light (mm)",
    "displacement": "between peak and paraxial position (mm)",
    "lost": "light lost on the way (%)",
    "on_sensor": "of what arrives, on the sensor (%)",
    "useful": "of what enters, on the sensor (%)",
}


def plot_rays(
    system: OpticalSystem,
    meridian: Meridian,
    sources: Sequence[tuple[float, float]],
    ax: Axes,
    *,
    rays: int = 15,
    sensor: LineSensor = TCD1304,
) -> Axes:
    """Exact rays through the real shapes, in one meridian.

    Rays that are lost end there, in a cross. `plots.plot_system` is the paraxial counterpart.

    Parameters
    ----------
    system : OpticalSystem
    meridian : {"x", "y"}
    sources : sequence of (source_dist, axis_off)
        mm; each gets its own colour, its rays come in from the left edge.
    ax : Axes
    rays : int
        Per source, over the front opening.
    sensor : LineSensor
        Drawn to its length, or as a thick point in the other meridian.
    """
    check_meridian("meridian", meridian)
    check.whole("rays", rays)
    axis = MERIDIANS.index(meridian)
    end = system.length + (system.sensor_distance or 0.0)
    lead = 0.3 * end
    lost_any = False
    for number, (source_dist, axis_off) in enumerate(sources):
        source = (axis_off, 0.0, source_dist) if axis == 0 else (0.0, axis_off, source_dist)
        points, arrived = _paths(system, source, rays, axis)
        z, height = points[:, 2], points[:, axis]
        # from far away: they come in from the left edge
        start = np.maximum(z[0], -lead)
        height[0] += (height[1] - height[0]) * (start - z[0]) / (z[1] - z[0])
        z[0] = start
        colour = RAYS[number % len(RAYS)]
        label = f"source {source_dist / 1000:g} m away, {axis_off / 1000:g} m off the axis"
        ax.plot(z, height, color=colour, linewidth=0.8, label=[label] + [None] * (rays - 1))
        ax.plot(z[-1, ~arrived], height[-1, ~arrived], "x", color=colour, markersize=5, zorder=5)
        lost_any |= bool((~arrived).any())
    window = 0.51 * sensor.length
    for element, (rotation, origin) in zip(system.elements, system.places(), strict=False):
        _draw_element(ax, element, rotation, origin, axis, window)
    half = sensor.length / 2 if meridian == "x" else 4 * sensor.pixel_height
    rotation, origin = (
        system.places()[-1]
        if system.sensor_distance is not None
        else (np.eye(3), np.array([0.0, 0.0, end]))
    )
    ends = origin + np.outer([-half, half], rotation[:, axis])
    ax.plot(
        ends[:, 2],
        ends[:, axis],
        color=SENSOR,
        linewidth=3,
        solid_capstyle="butt",
        zorder=4,
        label="sensor",
    )
    glass = [e.size(meridian) / 2 for e in system.elements if np.isfinite(e.size(meridian))]
    reach = 1.35 * max([*glass, half])  # rays that leave almost sideways go out of the picture
    handles, labels = ax.get_legend_handles_labels()
    if lost_any:
        handles.append(Line2D([], [], marker="x", color="k", linestyle=""))
        labels.append("ray lost")
    ax.axhline(0, color="0.5", linewidth=0.8, dashes=(8, 4), zorder=0)
    ax.set(
        xlabel="along the axis from the first surface (mm)",
        ylabel=f"{'along' if meridian == 'x' else 'across'} the pixel line (mm)",
        aspect="equal",
        ylim=(-reach, reach),
    )
    ax.legend(handles, labels, loc="lower left", bbox_to_anchor=(0, 1), ncols=2, borderaxespad=0.2)
    return ax


def _paths(
    system: OpticalSystem, source: tuple[float, float, float], rays: int, axis: int
) -> tuple[Array, NDArray[np.bool_]]:
    """Points (S + 2, 3, N) of a fan's rays, and which of them arrive."""
    low, high = front_opening(system, source)[2 * axis : 2 * axis + 2]
    aim = np.zeros((3, rays))
    aim[axis] = low + (np.arange(rays) + 0.5) * (high - low) / rays
    start = np.repeat(np.array([[source[0]], [source[1]], [-source[2]]]), rays, axis=1)
    arrived = trace(system, start, aim - start, fresnel=False).arrived
    return path(system, start, aim - start), arrived


def _draw_element(
    ax: Axes, element: Element, rotation: Array, origin: Array, axis: int, window: float
) -> None:
    """The section of an element in the plane of the drawing, where it really is."""
    half = element.size(MERIDIANS[axis]) / 2
    if isinstance(element, Aperture):
        opening = element.aperture(MERIDIANS[axis]) / 2
        if not np.isfinite(opening):
            return
        for side in (-1, 1):
            local = np.zeros((3, 2))
            local[axis] = side * opening, side * max(1.5 * opening, window)
            ends = rotation @ local + origin[:, None]
            ax.plot(ends[2], ends[axis], color="k", linewidth=2, zorder=4)
        return
    at = np.linspace(1, -1, 81) * (half if np.isfinite(half) else window)
    sides = []
    for surface in element.surfaces():
        local = np.zeros((3, len(at)))
        local[axis] = at
        local[2] = surface.z + surface.sag(local[0], local[1])
        sides.append(rotation @ local + origin[:, None])
    outline = np.concatenate([sides[0], sides[1][:, ::-1]], axis=1)
    bends = any(MERIDIANS[axis] in surface.bends for surface in element.surfaces())
    ax.add_patch(glass(np.stack([outline[2], outline[axis]], axis=1), bends=bends))


def plot_profile(
    spot: Spot,
    ax: Axes,
    *,
    paraxial: Footprint | None = None,
    sensor: LineSensor = TCD1304,
    within: tuple[float, float] | None = None,
) -> Axes:
    """Light on each pixel of the line, exact over paraxial.

    Parameters
    ----------
    spot : Spot
        All of its light counts, also what is above or below the line. Without any, the legend says
        so.
    ax : Axes
    paraxial : Footprint, optional
        As from `illumination.footprint`. What is narrower than a pixel is drawn a pixel wide.
    sensor : LineSensor
    within : tuple of float, optional
        Part of the line to show, mm; left out, what holds most of the light.
    """
    found = spot.profile("x", sensor.pitch)
    edges = (np.arange(sensor.pixels + 1) - sensor.pixels / 2) * sensor.pitch
    total = float(spot.weight.sum())
    light, _ = np.histogram(spot.x, edges, weights=100 * spot.weight / (total or 1.0))
    end = sensor.length / 2
    if within is None:
        within = _extent(spot, sensor)
    floor = 1e-3
    ax.stairs(
        np.maximum(light, floor),
        edges,
        baseline=floor,
        fill=True,
        color=RAYS[1],
        label="exact" if total else "exact: no light arrives",
    )
    if paraxial is not None:
        width = max(paraxial.width, sensor.pitch)
        low, high = paraxial.centre - width / 2, paraxial.centre + width / 2
        height = 100 * sensor.pitch / width
        ax.plot(
            [low, low, high, high],
            [floor, height, height, floor],
            color=RAYS[0],
            linewidth=1.6,
            label="paraxial",
        )
    if total:
        ax.axvline(float(found.median), color="k", linewidth=1, linestyle=DASHES, label="median")
    for side in (-end, end):
        if within[0] < side < within[1]:
            beyond = (side, within[1]) if side > 0 else (within[0], side)
            ax.axvspan(*beyond, color="0.85", label="beyond the line")
    ax.set(
        xlabel="position on the line (mm)",
        ylabel="light per pixel (% of all)",
        xlim=within,
        yscale="log",
        ylim=(floor, 200),
    )
    ax.yaxis.set_major_formatter("{x:g}")
    ax.legend(loc="upper right")
    return ax


def _extent(spot: Spot, sensor: LineSensor) -> tuple[float, float]:
    """Part of the line, mm, that holds all but 2 % of the light, with some dark around it."""
    if not spot.weight.any():
        return -sensor.length / 2, sensor.length / 2
    order = np.argsort(spot.x)
    share = np.cumsum(spot.weight[order])
    ends = np.interp([0.01, 0.99], share / share[-1], spot.x[order])
    end = 1.02 * sensor.length / 2
    low, high = np.clip(ends, -end, end).tolist()
    pad = max(0.15 * (high - low), 20 * sensor.pitch)
    return max(low - pad, -end), min(high + pad, end)


def plot_spot(spot: Spot, ax: Axes, *, sensor: LineSensor = TCD1304, pixel: float = 0.1) -> Axes:
    """Where the light of a spot is on the sensor's plane, and the pixel line in it.

    Parameters
    ----------
    spot : Spot
    ax : Axes
    sensor : LineSensor
        Its line is drawn to its true height.
    pixel : float
        Size of the squares in which light is added up, mm.
    """
    check.positive("pixel", pixel)
    half_x = sensor.length / 2
    high = float(np.abs(spot.y).max(initial=pixel))
    on = spot.x[np.abs(spot.x) <= half_x]
    low_x, high_x = (on.min(), on.max()) if len(on) else (-half_x, half_x)
    x_edges = np.arange(low_x - pixel, high_x + 2 * pixel, pixel)
    y_edges = np.arange(-high - pixel, high + 2 * pixel, pixel)
    light, _, _ = np.histogram2d(spot.x, spot.y, (x_edges, y_edges), weights=spot.weight)
    # the square root shows the dim halo beside the caustic
    shown = np.ma.masked_equal(np.sqrt(light.T / light.max(initial=1e-300)), 0)
    mesh = ax.pcolormesh(x_edges, y_edges, shown, cmap="viridis_r", vmin=0, rasterized=True)
    bar = ax.figure.colorbar(mesh, ax=ax, label="irradiance ÷ largest")
    ticks = np.array([0, 0.01, 0.1, 0.25, 0.5, 1])
    bar.set_ticks(np.sqrt(ticks).tolist(), labels=[f"{tick:g}" for tick in ticks])
    for side in (-1, 1):
        ax.axhline(side * sensor.pixel_height / 2, color=RAYS[0], linewidth=1)
    ax.set(
        xlabel="along the pixel line (mm)",
        ylabel="across it (mm)",
        xlim=(low_x - 0.5, high_x + 0.5),
    )
    ax.grid(visible=False)
    return ax


def plot_map(
    study: FieldStudy,
    ax: Axes,
    *,
    quantity: str = "w80",
    levels: int = 9,
    sensor: LineSensor = TCD1304,
) -> Axes:
    """A quantity over the places of a source, offset and distance, that are imaged on the line.

    Parameters
    ----------
    study : FieldStudy
        On a grid: `field_study(system, distances[:, None], offsets)`, or offsets that grow with the
        distance.
    ax : Axes
    quantity : {"w80", "w50", "displacement", "lost", "on_sensor", "useful"}
    levels : int
        About how many steps of colour.
    sensor : LineSensor
    """
    if quantity not in QUANTITIES:
        raise ValueError(f"quantity = {quantity!r}: allowed are {', '.join(QUANTITIES)}")
    if study.source_dist.ndim != 2:
        raise ValueError(
            f"the study has shape {study.source_dist.shape}: a map needs a grid, as from "
            "field_study(system, distances[:, None], offsets)"
        )
    if quantity in ("w50", "w80"):
        values = getattr(study.light, quantity)
    elif quantity == "displacement":
        values = np.abs(study.distortion("peak"))
    else:
        values = 100 * getattr(study, quantity)
    seen = np.abs(study.paraxial) <= sensor.length / 2
    shown = np.ma.masked_where(~seen | ~np.isfinite(values), values)
    if min(shown.shape) < 2 or shown.mask.all():
        raise ValueError("no source of the grid is imaged on the sensor, or it is only one row")
    steps = np.asarray(MaxNLocator(levels).tick_values(float(shown.min()), float(shown.max())))
    if quantity in ("lost", "on_sensor", "useful"):
        steps = np.unique(np.clip(steps, 0, 100))
    bands = ax.contourf(
        study.axis_off / 1000,
        study.source_dist / 1000,
        shown,
        levels=steps,
        cmap="viridis_r" if quantity not in ("on_sensor", "useful") else "viridis",
    )
    ax.figure.colorbar(bands, ax=ax, label=QUANTITIES[quantity])
    ax.set(xlabel="offset of the source (m)", ylabel="distance of the source (m)")
    ax.grid(visible=False)
    return ax


def plot_focus_curves(
    spots: Mapping[str, Spot],
    ax: Axes,
    shifts: ArrayLike,
    *,
    width: Width = "w80",
) -> Axes:
    """Width of the light over the place of the sensor, with the narrowest marked.

    Parameters
    ----------
    spots : mapping of str to Spot
        By label.
    ax : Axes
    shifts : array_like, shape (K,)
        mm, > 0 behind the sensor's place.
    width : {"rms", "fwhm", "w50", "w80", "full"}
    """
    if width not in WIDTHS:
        raise ValueError(f"width = {width!r}: allowed are {', '.join(WIDTHS)}")
    shifts = np.atleast_1d(check.array("shifts", shifts))
    styles = ("-", "--", "-.", ":")
    for number, (label, spot) in enumerate(spots.items()):
        sizes = getattr(through_focus(spot, shifts), width)
        colour = RAYS[number % len(RAYS)]
        ax.plot(shifts, sizes, color=colour, linestyle=styles[number % len(styles)], label=label)
        best = int(np.argmin(sizes))
        ax.plot(shifts[best], sizes[best], "o", color=colour, markersize=6)
    ax.axvline(0, color=PARAXIAL, linewidth=0.9, linestyle=DASHES, label="sensor")
    ax.set(
        xlabel="sensor moved away from the lenses by (mm)", ylabel=f"{WIDTHS[width]} (mm)", ylim=0
    )
    ax.legend()
    return ax


def plot_distortion(study: FieldStudy, ax: Axes, *, reference: str = "paraxial") -> Axes:
    """How far chief ray, median and peak are from the paraxial position, over the field.

    Parameters
    ----------
    study : FieldStudy
        Of sources at one distance, shape (K,).
    ax : Axes
    reference : {"paraxial", "image_point", "f_tan"}
    """
    angle = np.degrees(study.angle)
    lines = (
        ("chief", "chief ray", "-"),
        ("median", "median of the light", "--"),
        ("peak", "brightest pixel", "-."),
    )
    toward_axis = -np.sign(np.where(study.paraxial == 0, 1, study.paraxial))
    for (estimator, label, dashes), colour in zip(lines, RAYS, strict=True):
        shift = study.distortion(estimator, reference) * toward_axis
        ax.plot(angle, shift, color=colour, linestyle=dashes, label=label)
    ax.axhline(0, color=PARAXIAL, linewidth=0.9, linestyle=DASHES, label="paraxial")
    ax.set(xlabel="field angle (°)", ylabel="toward the axis by (mm)")
    ax.legend()
    return ax


def plot_losses(study: FieldStudy, ax: Axes) -> Axes:
    """What becomes of the light that enters, over the field: areas that add up to 100 %.

    Parameters
    ----------
    study : FieldStudy
        Of sources at one distance, shape (K,).
    ax : Axes
    """
    angle = np.degrees(study.angle)
    parts = {
        "on the sensor": study.useful,
        "beyond its ends": study.arrived * (1 - study.on_sensor),
        "reflected by surfaces": study.faded,
        "outside an opening": study.blocked,
        "totally reflected": study.reflected,
        "past a surface": study.missed,
    }
    parts = {label: part for label, part in parts.items() if part.max() > 5e-4}
    colours = {
        "on the sensor": RAYS[1],
        "beyond its ends": "#9ecae1",
        "reflected by surfaces": "0.85",
        "outside an opening": "#E69F00",
        "totally reflected": RAYS[0],
        "past a surface": "0.6",
    }
    ax.stackplot(
        angle,
        *(100 * part for part in parts.values()),
        labels=list(parts),
        colors=[colours[label] for label in parts],
    )
    ax.set(
        xlabel="field angle (°)",
        ylabel="share of the light (%)",
        xlim=(angle.min(), angle.max()),
        ylim=(0, 100),
    )
    ax.grid(visible=False)
    ax.legend(loc="lower left", frameon=True, framealpha=1, edgecolor="none")
    return ax


def plot_head(
    system: OpticalSystem,
    sources: Sequence[tuple[float, float, float]],
    ax: Axes3D,
    *,
    rays: tuple[int, int] = (7, 3),
    sensor: LineSensor = TCD1304,
) -> Axes3D:
    """The head in space, with the rays of point sources; lost ones end where they are lost.

    Parameters
    ----------
    system : OpticalSystem
    sources : sequence of (x, y, distance)
        mm; each gets its own colour.
    ax : Axes3D
        Such as `figure.add_subplot(projection="3d")`.
    rays : tuple of int
        Along and across the pixel line, per source.
    sensor : LineSensor
    """
    end = system.length + (system.sensor_distance or 0.0)
    lead = 0.3 * end
    for number, source in enumerate(sources):
        low_x, high_x, low_y, high_y = front_opening(system, source)
        u, v = np.meshgrid(
            low_x + (np.arange(rays[0]) + 0.5) * (high_x - low_x) / rays[0],
            low_y + (np.arange(rays[1]) + 0.5) * (high_y - low_y) / rays[1],
        )
        aim = np.stack([u.ravel(), v.ravel(), 0 * u.ravel()])
        start = np.repeat(np.array([[source[0]], [source[1]], [-source[2]]]), u.size, axis=1)
        points = path(system, start, aim - start)
        z = np.maximum(points[0, 2], -lead)
        part = (z - points[0, 2]) / (points[1, 2] - points[0, 2])
        points[0] += part * (points[1] - points[0])
        for ray in range(u.size):
            x, y, along = points[:, :, ray].T
            label = f"source at {source[0] / 1000:g}, {source[1] / 1000:g}, {source[2] / 1000:g} m"
            ax.plot(
                along,
                x,
                y,
                color=RAYS[number % len(RAYS)],
                linewidth=0.6,
                label=None if ray else label,
            )
    for element, (rotation, origin) in zip(system.elements, system.places(), strict=False):
        half = [element.size(meridian) / 2 for meridian in MERIDIANS]
        half = [
            h if np.isfinite(h) else 0.51 * s
            for h, s in zip(half, (sensor.length, 10.0), strict=True)
        ]
        x, y = np.meshgrid(*(np.linspace(-h, h, 13) for h in half))
        for surface in element.surfaces():
            local = np.stack(
                [x.ravel(), y.ravel(), surface.z + surface.sag(x, y).ravel() + 0 * x.ravel()]
            )
            at = (rotation @ local + origin[:, None]).reshape(3, *x.shape)
            ax.plot_surface(at[2], at[0], at[1], color=GLASS, alpha=0.22, shade=False)
            rim = np.concatenate([at[:, 0], at[:, :, -1], at[:, -1, ::-1], at[:, ::-1, 0]], axis=1)
            ax.plot(rim[2], rim[0], rim[1], color="0.35", linewidth=0.6)
    line = np.array([-1, 1]) * sensor.length / 2
    ax.plot([end, end], line, [0, 0], color=SENSOR, linewidth=4, label="pixel line")
    ax.set(xlabel="Z (mm)", ylabel="X (mm)", zlabel="Y (mm)")
    ax.yaxis.set_major_locator(MaxNLocator(3))  # is foreshortened: more would overlap
    ax.set_box_aspect((1.7, 1, 1), zoom=1.15)
    ax.view_init(elev=20, azim=-60)
    ax.legend(loc="upper left")
    return ax
