"""Figures of tracking: functions that draw into an `Axes` and return it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from raytransfer import plots

if TYPE_CHECKING:
    from collections.abc import Sequence

    from matplotlib.axes import Axes
    from numpy.typing import ArrayLike

    from tracking.leds import LedMap
    from tracking.poses import Estimate


def plot_path(
    leds: LedMap, estimates: Sequence[Estimate], ax: Axes, truth: ArrayLike | None = None
) -> Axes:
    """Draw the room from above: LEDs, the path found, and the true one.

    Parameters
    ----------
    leds : LedMap
    estimates : sequence of Estimate
    ax : Axes
    truth : array_like, shape (N, 2), optional
        x and y of the true path, mm.
    """
    if truth is not None:
        x, y = np.asarray(truth, dtype=float).T / 1000
        ax.plot(x, y, color="0.75", linewidth=6, label="true path")
    found = np.array([(e.x, e.y) for e in estimates]).reshape(-1, 2) / 1000
    ax.plot(*found.T, color=plots.RAYS[1], linewidth=1.2, label="estimated")
    if len(found):
        ax.plot(*found[0], "o", color=plots.RAYS[1], markersize=5)
    ax.plot(*leds.positions[:, :2].T / 1000, "o", color=plots.LED, markersize=7, label="LEDs")
    ax.set(xlabel="x (m)", ylabel="y from the LEDs (m)", aspect="equal")
    return ax


def plot_errors(
    seconds: ArrayLike, errors: ArrayLike, sigmas: ArrayLike, axes: Sequence[Axes]
) -> Sequence[Axes]:
    """Draw errors of x, y and heading over time, each with the band of its ± 3 σ.

    Parameters
    ----------
    seconds : array_like, shape (N,)
    errors, sigmas : array_like, shape (N, 3)
        mm, mm and rad; the last is drawn in mrad.
    axes : sequence of Axes
        Three, from top to bottom.
    """
    values, bands = np.array(errors, dtype=float), 3 * np.array(sigmas, dtype=float)
    values[:, 2] *= 1e3
    bands[:, 2] *= 1e3
    names = ("x (mm)", "y (mm)", "heading (mrad)")
    for number, (ax, name) in enumerate(zip(axes, names, strict=True)):
        band = bands[:, number]
        ax.fill_between(
            np.asarray(seconds), -band, band, color=plots.GLASS, alpha=0.6, label="± 3 σ"
        )
        ax.plot(seconds, values[:, number], color=plots.RAYS[0], linewidth=1, label="error")
        ax.axhline(0, color="0.5", linewidth=0.6)
        ax.set_ylabel(name)
    axes[-1].set_xlabel("device time (s)")
    return axes
