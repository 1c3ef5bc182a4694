"""All studies in one go: the table of claims, the figures, a report that is one file."""

from __future__ import annotations

import base64
import html
import io
from typing import TYPE_CHECKING

import matplotlib as mpl
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from raytransfer import plots
from raytransfer.casting import cast_rays
from raytransfer.studies import (
    FAR,
    NEAR,
    led_line,
    lens_selection,
    plate_effect,
    resolution_map,
    tracking_area,
)
from raytransfer.systems import collimating_pair, prototype_head, telecentric_pair
from raytransfer.thesis import COVER, LED_SPACING, LENS_WIDTH, ClaimTable, claims

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

GRID_X = np.linspace(-3000, 3000, 301)
GRID_Y = np.linspace(10, FAR, 251)
LEDS = led_line(5, LED_SPACING)


def _area(figure: Figure) -> str:
    area = tracking_area(telecentric_pair().matrix("x"), LEDS, GRID_X, GRID_Y)
    plots.plot_tracking_area(area, figure.subplots())
    return "Five LEDs, 0.5 m apart: how many of them land on the sensor (figure 4.1)."


def _collimator(figure: Figure) -> str:
    sources = [(NEAR, 0.0), (NEAR, 281.0)]
    plots.plot_system(collimating_pair(), "y", sources, figure.subplots(), sensor_dist=3 + COVER)
    return (
        "The collimating pair, across the pixel line; a ray that misses a lens ends there. "
        "Paraxial rays bend at vertex planes. The second source is at the margin of claim O11 "
        "(figure 4.3)."
    )


def _focus(figure: Figure) -> str:
    pair = telecentric_pair()
    sensor_dist = cast_rays(LENS_WIDTH, pair.matrix("x"), FAR, 0).focal_length
    axes = figure.subplots(1, 3, sharey=True)
    for ax, source_dist, magnify in zip(axes, (FAR, NEAR, 2 * FAR), (1, 5, 60), strict=True):
        plots.plot_focus(LENS_WIDTH, pair, source_dist, sensor_dist, ax, magnify=magnify)
    return "The focus on, behind and before the sensor (figure 4.4)."


def _rays(figure: Figure) -> str:
    pair = telecentric_pair()
    plots.plot_ray_cast(LENS_WIDTH, pair.length, pair.matrix("x"), 200, 50, figure.subplots())
    return "Three rays through the pair, source 200 mm away and 50 mm off the axis (figure 4.5)."


def _lenses(figure: Figure) -> str:
    named = ("LJ1695L1", "LJ1430L1", "LJ1567L1", "LJ1516L1")
    plots.plot_lens_comparison(lens_selection(), figure.subplots(), highlight=named)
    return (
        "Every pair of the catalogue's 30 mm lenses, near is 0.5 m and far 5 m: paraxially only the "
        "focal length counts."
    )


def _beam(figure: Figure) -> str:
    names = {f"two f {f}": f"PCX_30_32_{f}" for f in (50, 60, 100)}
    pairs = {label: telecentric_pair(name).matrix("x") for label, name in names.items()}
    plots.plot_beam_width(LENS_WIDTH, pairs, figure.subplots())
    return "Beam width on a sensor in the focus of 5 m."


def _resolution(figure: Figure) -> str:
    matrix = telecentric_pair().matrix("x")
    resolution = resolution_map(matrix, LEDS, GRID_X, GRID_Y)
    left, right = figure.subplots(1, 2)
    plots.plot_resolution(resolution, left)
    plots.plot_resolution(resolution, right, quantity="axial")
    return "What one pixel is worth, sideways and toward the LEDs; white where fewer than two are seen."


def _head(figure: Figure) -> str:
    head = prototype_head()
    along, across = figure.subplots(1, 2)
    plots.plot_system(head, "x", [(FAR, 0), (FAR, 1500)], along, width=28)
    plots.plot_system(head, "y", [(FAR, 0), (FAR, 1500)], across)
    along.set_title("along the pixel line", loc="right")
    across.set_title("across it", loc="right")
    effect = plate_effect(head)
    return (
        "The whole head, along and across the pixel line (figure 4.7). Glass between pair and "
        f"chip moves the focus back by {effect.shift:.2f} mm; the beam of a source at 5 m is "
        f"{effect.width_with:.2f} mm wide, {effect.width_without:.2f} mm without the plates."
    )


FIGURES: dict[str, tuple[Callable[[Figure], str], tuple[float, float]]] = {
    "tracking-area": (_area, (8, 5.6)),
    "collimator": (_collimator, (8, 3.8)),
    "focus": (_focus, (11, 3.6)),
    "rays": (_rays, (8, 4)),
    "lens-comparison": (_lenses, (8, 4)),
    "beam-width": (_beam, (8, 3.5)),
    "resolution": (_resolution, (12, 4.4)),
    "head": (_head, (12, 4.2)),
}
"""Each figure's function, which draws it and returns its caption, and its size in inches."""


def draw(name: str) -> tuple[bytes, str]:
    """Return a figure of `FIGURES` as PNG, and its caption."""
    function, size = FIGURES[name]
    with mpl.rc_context():
        plots.style()
        figure = Figure(figsize=size)
        FigureCanvasAgg(figure)
        caption = function(figure)
        buffer = io.BytesIO()
        figure.savefig(buffer, format="png")
    return buffer.getvalue(), caption


def write(folder: Path) -> Iterator[str]:
    """Write all figures and report.html into a folder; yields the name of what was written.

    Parameters
    ----------
    folder : Path
        Made if it does not exist.
    """
    pictures: dict[str, tuple[bytes, str]] = {}
    (folder / "figures").mkdir(parents=True, exist_ok=True)
    for name in FIGURES:
        pictures[name] = draw(name)
        (folder / "figures" / f"{name}.png").write_bytes(pictures[name][0])
        yield name
    (folder / "report.html").write_text(page(claims(), pictures), encoding="utf-8")
    yield "report.html"


def page(table: ClaimTable, pictures: dict[str, tuple[bytes, str]]) -> str:
    """Return the report: a table and figures, everything in one HTML file."""
    figures = "\n".join(
        f'<figure><img alt="{html.escape(caption)}" '
        f'src="data:image/png;base64,{base64.b64encode(png).decode()}">'
        f"<figcaption>{html.escape(caption)}</figcaption></figure>"
        for png, caption in pictures.values()
    )
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>linetrack: the thesis's optics, reproduced</title>
<style>
body {{ font: 16px/1.5 system-ui, sans-serif; max-width: 1100px; margin: 2em auto; padding: 0 1em;
  color: #222; }}
table {{ border-collapse: collapse; font-size: 14px; }}
th, td {{ padding: .35em .7em; border-bottom: 1px solid #ddd; text-align: left;
  vertical-align: top; }}
td:nth-child(n+3):nth-child(-n+5), th:nth-child(n+3):nth-child(-n+5) {{ text-align: right;
  white-space: nowrap; }}
figure {{ margin: 2.5em 0; }}
img {{ max-width: 100%; height: auto; }}
figcaption {{ color: #555; font-size: 14px; }}
</style>
</head>
<body>
<h1>The thesis's optics, reproduced</h1>
<p>C. Prossenitsch, <cite>Outdoor Inside-Out Linear Image Sensor Tracking</cite>. What the thesis
quotes, what its own paraxial model gives, and the difference. All numbers are simulated, and
paraxial: they hold near the optical axis. Nothing here was measured on hardware.</p>
{table.html()}
{figures}
</body>
</html>
"""
