"""Timing charts of recorded pins: functions that draw into an `Axes` and return it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from acquisition.wiring import WIRING
from twin.machine import CLOCK

if TYPE_CHECKING:
    from collections.abc import Sequence

    from matplotlib.axes import Axes
    from numpy.typing import NDArray

    from twin.machine import Machine

UNITS = {"s": 1.0, "ms": 1e3, "µs": 1e6}


@dataclass(frozen=True)
class Lane:
    """One line of a timing chart.

    Parameters
    ----------
    net : str
        A net of wiring.toml; or "SCK", while the link's clock runs, or "ADC", while it samples.
    label : str
    inverted : bool
        Show it behind the 74HC04, as the sensor sees it.
    gap : float
        Pauses up to so many seconds do not count: a burst is drawn as one block.
    """

    net: str
    label: str
    inverted: bool = False
    gap: float = 0.0


def spans(machine: Machine, lane: Lane) -> NDArray[np.float64]:
    """When a recorded lane is high.

    Parameters
    ----------
    machine : Machine
        Made with ``record=True``.
    lane : Lane

    Returns
    -------
    ndarray, shape (N, 2)
        Beginnings and ends, s; what is still high ends now.
    """
    pin = lane.net if lane.net in ("SCK", "ADC") else WIRING.pins[lane.net].name
    edges = machine.edges(pin)
    levels = edges["level"].astype(bool) ^ lane.inverted
    times = edges["time"] / CLOCK
    if len(times) and not levels[0]:  # high since the beginning
        times, levels = np.insert(times, 0, 0.0), np.insert(levels, 0, True)
    rising = np.flatnonzero(levels & ~np.insert(levels[:-1], 0, False))
    falling = np.flatnonzero(~levels & np.insert(levels[:-1], 0, False))
    begins, ends = times[rising], times[falling]
    if len(ends) < len(begins):
        ends = np.append(ends, machine.seconds)
    apart = begins[1:] - ends[:-1] > lane.gap
    kept = np.insert(apart, 0, True) if len(begins) else np.empty(0, bool)
    return np.stack([begins[kept], ends[np.append(kept[1:], True)] if len(ends) else ends], axis=1)


def plot_lanes(
    machine: Machine,
    lanes: Sequence[Lane],
    ax: Axes,
    *,
    start: float,
    stop: float,
    unit: str = "ms",
) -> Axes:
    """Draw recorded levels one above the other.

    Parameters
    ----------
    machine : Machine
        Made with ``record=True``.
    lanes : sequence of Lane
        From top to bottom.
    ax : Axes
    start, stop : float
        Virtual s; the axis counts from `start`.
    unit : {"s", "ms", "µs"}
        Of the axis.
    """
    scale = UNITS[unit]
    for row, lane in enumerate(lanes):
        shown = spans(machine, lane)
        shown = np.clip(shown[(shown[:, 1] > start) & (shown[:, 0] < stop)], start, stop)
        base = -float(row)
        x = np.concatenate([[start], np.repeat(shown.ravel(), 2), [stop]])
        y = base + 0.62 * np.concatenate([[0], np.tile([0, 1, 1, 0], len(shown)), [0]])
        colour = f"C{row % 10}"
        ax.plot((x - start) * scale, y, color=colour, linewidth=1)
        ax.fill_between((x - start) * scale, base, y, color=colour, alpha=0.25, linewidth=0)
    ax.set_yticks([0.31 - row for row in range(len(lanes))], [lane.label for lane in lanes])
    ax.set_ylim(-len(lanes) + 0.8, 0.85)
    ax.set_xlim(0, (stop - start) * scale)
    ax.set_xlabel(f"time ({unit})")
    ax.tick_params(axis="y", length=0)
    ax.grid(visible=True, axis="x", alpha=0.3)
    ax.grid(visible=False, axis="y")
    return ax
