"""Intensity charts of frames: as figures (matplotlib), and as text for a terminal."""

from __future__ import annotations

import math
import os
import sys
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from acquisition.frames import ELEMENTS, LEADING, PIXELS

if TYPE_CHECKING:
    from collections.abc import Sequence

    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from numpy.typing import NDArray

    from acquisition.frames import Frame

STYLE: Final[dict[Any, Any]] = {
    "figure.figsize": (9, 4.5),
    "figure.dpi": 100,
    "savefig.dpi": 100,
    "figure.constrained_layout.use": True,
    "axes.titlesize": 11,
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.axisbelow": True,
    "axes.grid": True,
    "grid.color": "#d9d9d9",
    "grid.linewidth": 0.6,
    "lines.linewidth": 1.0,
    "legend.frameon": False,
    "legend.fontsize": 9,
    "xtick.labelsize": 9,
    "ytick.labelsize": 9,
}
"""Settings of matplotlib for the charts."""
COLOURS: Final = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
"""After Okabe and Ito: told apart by the colour-blind, too. From the eighth curve on: dashed."""

_NO_WINDOWS: Final = frozenset({"agg", "cairo", "pdf", "pgf", "ps", "svg", "template"})
_MOST_IN_LEGEND: Final = 14
_SHALLOW: Final = 32  # counts; a dip less deep is no spike
_BRAILLE: Final = np.array([[0x01, 0x08], [0x02, 0x10], [0x04, 0x20], [0x40, 0x80]])


class NoDisplayError(Exception):
    """There is no screen to show a figure on: says what to do instead."""


def plot_intensity(frames: Sequence[tuple[str, Frame]], ax: Axes, *, whole: bool = False) -> Axes:
    """Draw what the sensor sent, all frames in one chart.

    Parameters
    ----------
    frames : sequence of (str, Frame)
        Each with its label.
    ax : Axes
    whole : bool
        Draw all 3694 elements, numbered from 1 as in a `.dat` file, not only the pixels.
    """
    for n, (label, frame) in enumerate(frames):
        values = frame.elements if whole else frame.pixels
        ax.plot(
            np.arange(values.size) + (1 if whole else 0),
            values,
            color=COLOURS[n % len(COLOURS)],
            linestyle=("-", "--", ":")[n // len(COLOURS) % 3],
            label=label,
        )
    size = ELEMENTS if whole else PIXELS
    ax.set(
        xlabel="element (number in the .dat file)" if whole else "pixel",
        ylabel="ADC counts (light lowers them)",
        xlim=(1, size) if whole else (0, size - 1),
    )
    if whole:
        ax.axvspan(1, LEADING, color="0.92", zorder=0)
        ax.axvspan(LEADING + PIXELS + 1, ELEMENTS, color="0.92", zorder=0)
    ax.set_xticks([*range(0, 3500, 500), size - (0 if whole else 1)])
    if len(frames) <= _MOST_IN_LEGEND:
        columns = 1 if len(frames) == 1 else 2 if len(frames) <= 4 else 3
        ax.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=columns, borderaxespad=0.2)
    else:
        ax.set_title(f"{len(frames)} frames, {frames[0][0]} to {frames[-1][0]}")
    return ax


def save_chart(frames: Sequence[tuple[str, Frame]], path: str, *, whole: bool = False) -> None:
    """Write the chart as a picture; the ending of the name tells its format.

    Parameters
    ----------
    frames : sequence of (str, Frame)
    path : str
    whole : bool
        As for `plot_intensity`.

    Raises
    ------
    ValueError
        The ending is no known format.
    OSError
    """
    import matplotlib as mpl
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    with mpl.rc_context(STYLE):
        figure = Figure()
        FigureCanvasAgg(figure)
        plot_intensity(frames, figure.subplots(), whole=whole)
        figure.savefig(path)


def show_chart(frames: Sequence[tuple[str, Frame]], *, whole: bool = False) -> Figure:
    """Show the chart in a window and wait until it is closed.

    Parameters
    ----------
    frames : sequence of (str, Frame)
    whole : bool
        As for `plot_intensity`.

    Raises
    ------
    NoDisplayError
        There is no screen, or nothing that draws windows.
    """
    hint = "write a picture with --save chart.png"
    if sys.platform == "linux" and not any(
        os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY", "MPLBACKEND")
    ):
        raise NoDisplayError(f"there is no display to show the chart on: {hint}")
    import matplotlib.pyplot as plt

    if plt.get_backend().lower() in _NO_WINDOWS:
        message = f"matplotlib has nothing to open a window with: apt install python3-tk, or {hint}"
        raise NoDisplayError(message)
    with plt.rc_context(STYLE):
        try:
            figure, ax = plt.subplots()
        except Exception as error:  # each toolkit raises its own
            raise NoDisplayError(f"no window can be opened ({error}): {hint}") from error
        plot_intensity(frames, ax, whole=whole)
        plt.show()
    return figure


@dataclass
class Span:
    """Range of a vertical axis that only ever grows, so that a moving chart stays readable.

    Attributes
    ----------
    low, high : float
        ADC counts.
    """

    low: float = math.inf
    high: float = -math.inf

    def take(self, values: NDArray[np.uint16]) -> None:
        """Widen the range so that it holds the values, with some air around them."""
        low, high = float(values.min()), float(values.max())
        if low < self.low or high > self.high:
            air = max(0.05 * (high - low), 16.0)
            self.low = min(self.low, max(0.0, low - air))
            self.high = max(self.high, high + air)


def spike(pixels: NDArray[np.uint16]) -> tuple[float, int, float] | None:
    """Find the deepest spike of a frame.

    Parameters
    ----------
    pixels : ndarray of uint16

    Returns
    -------
    centre : float
        Centre of gravity of what lies below half of the depth, in pixels from 0.
    width : int
        Pixels at half of the depth.
    depth : float
        Counts from the median to the lowest value.

    Instead of the three, None if nothing is far below the median.
    """
    below = np.median(pixels) - pixels
    lowest = int(below.argmax())
    depth = float(below[lowest])
    if depth < _SHALLOW:
        return None
    outside = np.flatnonzero(below < depth / 2)
    edge = int(np.searchsorted(outside, lowest))
    first = int(outside[edge - 1]) + 1 if edge else 0
    last = int(outside[edge]) if edge < outside.size else pixels.size
    part = below[first:last]
    centre = float((np.arange(first, last) * part).sum() / part.sum())
    return centre, last - first, depth


def text_chart(
    values: NDArray[np.uint16], width: int, height: int, span: Span, *, plain: bool = False
) -> list[str]:
    """Draw a curve with characters; the narrowest spike stays visible.

    Each column of dots reaches from the smallest to the largest of the values that fall into it.

    Parameters
    ----------
    values : ndarray of uint16, shape (N,)
    width, height : int
        Characters; with Braille each has 2 by 4 dots.
    span : Span
        Of the vertical axis; values beyond it are drawn at its ends.
    plain : bool
        ASCII instead of Braille characters.

    Returns
    -------
    list of str
        `height` lines of `width` characters, from the top.
    """
    across, down = (1, 1) if plain else (2, 4)
    columns, rows = min(width * across, values.size), height * down
    starts = np.linspace(0, values.size, columns, endpoint=False).astype(int)
    low, high = np.minimum.reduceat(values, starts), np.maximum.reduceat(values, starts)
    # up to the first value of the next column, so that the curve has no gaps
    low[:-1] = np.minimum(low[:-1], values[starts[1:]])
    high[:-1] = np.maximum(high[:-1], values[starts[1:]])
    scale = (rows - 1) / max(span.high - span.low, 1.0)
    top = np.clip(np.rint((span.high - high) * scale), 0, rows - 1)
    bottom = np.clip(np.rint((span.high - low) * scale), 0, rows - 1)
    row = np.arange(rows)[:, None]
    dots = np.zeros((rows, width * across), bool)
    dots[:, :columns] = (top <= row) & (row <= bottom)
    if plain:
        return ["".join("#" if dot else " " for dot in line) for line in dots]
    cells = dots.reshape(height, 4, width, 2).transpose(0, 2, 1, 3)
    codes = 0x2800 + (cells * _BRAILLE).sum((2, 3))
    return ["".join(map(chr, line)) for line in codes]
