"""A live map for notebooks: where the tracker is, how sure that is, and what each LED says.

view = LiveMap(calibration.leds)
view  # as the last line of a cell
for step in view.watch(follow(capture, tracker)): ...
"""

from __future__ import annotations

import html
import math
from collections import deque
from typing import TYPE_CHECKING, Any, Final

import ipywidgets as widgets
import matplotlib as mpl
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse

from raytransfer import plots
from raytransfer.explorer import encode_png
from tracking.motion import Outcome
from tracking.output import as_text
from tracking.poses import PoseFlags

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from numpy.typing import ArrayLike, NDArray

    from tracking.leds import LedMap
    from tracking.poses import Estimate
    from tracking.tracker import Step

SIGMAS: Final = 3
"""The ellipse is so many standard deviations wide."""

_TRACK = 2000  # poses of the track that are kept
_HISTORY = 120  # frames of residuals
_RESIDUALS = 5.0  # standard deviations shown; larger ones stick to the edge
_NEEDLE = 0.04  # length of the tracker's pointer, of the room's larger side
_BAD = PoseFlags.LOST | PoseFlags.INCONSISTENT


class LiveMap(widgets.VBox):  # type: ignore[misc]
    """The room from above, the pose close up, and residuals; redrawn by `show`.

    Parameters
    ----------
    leds : LedMap
    area : tuple of float, optional
        x from, to, y from, to, mm: what of the room is shown. Left out, the LEDs and as much in
        front of them as they are wide, 2 m at least. It grows when the tracker leaves it.
    truth : array_like, shape (N, 2), optional
        True path, x and y in mm, drawn below the estimated one.

    Raises
    ------
    ValueError
        If the area has no size or the path another shape.
    """

    def __init__(
        self,
        leds: LedMap,
        area: tuple[float, float, float, float] | None = None,
        truth: ArrayLike | None = None,
    ) -> None:
        self.picture = widgets.Image(format="png")
        self.readout = widgets.HTML()
        self._map = Map(leds, _around(leds) if area is None else area, truth)
        self.picture.value = self._map.png()
        self.readout.value = _pre("no pose yet")
        super().__init__([self.picture, self.readout])

    def show(self, step: Step) -> None:
        """Draw a step of `tracking.tracker.follow`."""
        self._map.take(step)
        self._redraw(step)

    def watch(self, steps: Iterable[Step], interval: float = 0.05) -> Iterator[Step]:
        """Yield the steps, drawn now and then.

        Parameters
        ----------
        steps : iterable of Step
        interval : float
            Device seconds from picture to picture. The last step is drawn in any case.
        """
        drawn: int | None = None
        last: Step | None = None
        for step in steps:
            self._map.take(step)
            last, now = step, step.t_ns
            if drawn is None or now - drawn >= interval * 1e9:
                self._redraw(step)
                drawn, last = now, None
            yield step
        if last is not None:
            self._redraw(last)

    def _redraw(self, step: Step) -> None:
        self.picture.value = self._map.png()
        text = "no pose yet" if step.estimate is None else as_text(step.estimate)
        self.readout.value = _pre(text)


def _pre(text: str) -> str:
    return f'<pre style="margin:0">{html.escape(text)}</pre>'


def _around(leds: LedMap) -> tuple[float, float, float, float]:
    low, high = leds.positions[:, :2].min(axis=0), leds.positions[:, :2].max(axis=0)
    reach = max(2000.0, float((high - low).max()))
    middle = (low[0] + high[0]) / 2
    return middle - reach / 2, middle + reach / 2, low[1], max(low[1] + reach, high[1])


class Map:
    """The picture: a background drawn rarely, and artists blitted over it at every step."""

    def __init__(
        self,
        leds: LedMap,
        area: tuple[float, float, float, float],
        truth: ArrayLike | None = None,
    ) -> None:
        if not (area[0] < area[1] and area[2] < area[3]):
            raise ValueError(f"area = {area}: x from, to, y from, to in mm, each from < to")
        path = np.empty((0, 2)) if truth is None else np.asarray(truth, dtype=float)
        if path.ndim != 2 or path.shape[1] != 2:
            raise ValueError(f"truth has shape (N, 2), x and y in mm, not {path.shape}")
        self._leds = leds
        self._area = area
        self._span = 0.0  # of the close-up, mm
        self._track: deque[tuple[float, float]] = deque(maxlen=_TRACK)
        self._residuals: deque[list[tuple[int, float, bool]]] = deque(maxlen=_HISTORY)
        self._lit: frozenset[int] = frozenset()
        self._estimate: Estimate | None = None
        with mpl.rc_context():
            plots.style()
            self.figure = Figure(figsize=(9.6, 4.6), dpi=100)
            self._canvas = FigureCanvasAgg(self.figure)
            grid = self.figure.add_gridspec(2, 2, width_ratios=(1, 1))
            self.room = self.figure.add_subplot(grid[:, 0])
            self.close = self.figure.add_subplot(grid[0, 1])
            self.signals = self.figure.add_subplot(grid[1, 1])
            self._axes()
            (self._true,) = self.room.plot(
                *(path.T / 1000), color="0.75", linewidth=3, label="true path"
            )
            x, y = leds.positions[:, 0] / 1000, leds.positions[:, 1] / 1000
            (self._all,) = self.room.plot(
                x, y, "o", color="w", markeredgecolor="0.4", markersize=5, clip_on=False
            )
            (self._on,) = self.room.plot([], [], "o", color=plots.LED, markersize=7, clip_on=False)
            (self._line,) = self.room.plot([], [], color=plots.RAYS[1], linewidth=1.2)
            (self._rays,) = self.room.plot([], [], color=plots.LED, linewidth=0.8)
            (self._tracker,) = self.room.plot([], [], "o", color="k", markersize=5)
            (self._needle,) = self.room.plot([], [], color="k", linewidth=1.5)
            (self._recent,) = self.close.plot([], [], ".", color=plots.RAYS[1], markersize=3)
            self._ellipse = self.close.add_patch(
                Ellipse((0, 0), 0, 0, facecolor=plots.GLASS, edgecolor="k", alpha=0.7)
            )
            (self._accepted,) = self.signals.plot([], [], ".", color=plots.RAYS[2], markersize=4)
            (self._refused,) = self.signals.plot([], [], "x", color=plots.TRACKED, markersize=5)
            self._note = self.room.text(
                0.02, 0.98, "", transform=self.room.transAxes, va="top", color=plots.TRACKED
            )
        self.moving: dict[Any, list[Any]] = {
            self.room: [
                self._rays,
                self._line,
                self._on,
                self._needle,
                self._tracker,
                self._note,
            ],
            self.close: [self._ellipse, self._recent],
            self.signals: [self._accepted, self._refused],
        }
        for artists in self.moving.values():
            for artist in artists:
                artist.set_animated(True)
        self._zoom(1.0)
        self._canvas.draw()  # lay out once: the axes stay where they are
        self.figure.set_layout_engine("none")
        self._background: Any = None

    def _axes(self) -> None:
        self.room.set(xlabel="x (m)", ylabel="y from the LEDs (m)", aspect="equal")
        self.room.set_title("room from above; yellow: LEDs lit")
        self.close.set(xlabel="x − now (mm)", ylabel="y − now (mm)", aspect="equal")
        self.close.set_title(f"close up; ellipse: {SIGMAS} σ")
        channels = self._leds.channels
        shown = channels if len(channels) <= 12 else channels[:: -(-len(channels) // 8)]
        self.signals.set(
            xlabel="LED",
            ylabel="spike − expected (σ)",
            xlim=(-0.6, len(channels) - 0.4),
            ylim=(-_RESIDUALS - 0.4, _RESIDUALS + 0.4),
            xticks=[channels.index(n) for n in shown],
            xticklabels=[str(n) for n in shown],
        )
        self.signals.axhspan(-SIGMAS, SIGMAS, color="0.93")
        self.signals.set_title(f"the last {_HISTORY} frames; × refused")
        self._frame_room()

    def _frame_room(self) -> None:
        left, right, near, far = (value / 1000 for value in self._area)
        margin = 0.04 * max(right - left, far - near)
        self.room.set(xlim=(left - margin, right + margin), ylim=(near - margin, far + margin))

    def _zoom(self, span: float) -> None:
        self._span = span
        self.close.set(xlim=(-span, span), ylim=(-span, span))
        self._background = None

    def take(self, step: Step) -> None:
        """Note a step, without drawing."""
        self._lit = frozenset(step.lit)
        row = self._leds.index
        self._residuals.append(
            [
                (row(found.channel), found.residual / found.sigma, found.outcome is Outcome.USED)
                for found in step.innovations
                if math.isfinite(found.residual)
            ]
        )
        self._estimate = step.estimate
        if step.estimate is not None and not step.estimate.flags & PoseFlags.LOST:
            self._track.append((step.estimate.x, step.estimate.y))

    def png(self) -> bytes:
        """Return the picture as it is now."""
        self._place()
        if self._background is None:
            self._canvas.draw()
            self._background = self._canvas.copy_from_bbox(self.figure.bbox)
        self._canvas.restore_region(self._background)
        for axes, artists in self.moving.items():
            for artist in artists:
                axes.draw_artist(artist)
        return encode_png(np.asarray(self._canvas.buffer_rgba())[..., :3])

    def _place(self) -> None:
        positions = self._leds.positions[:, :2] / 1000
        on = np.array([n in self._lit for n in self._leds.channels])
        self._on.set_data(*positions[on].T)
        self._place_residuals()
        estimate = self._estimate
        for artist in (self._tracker, self._needle, self._rays, self._ellipse, self._recent):
            artist.set_visible(estimate is not None)
        if estimate is None:
            return
        self._reach(estimate.x, estimate.y)
        x, y = estimate.x / 1000, estimate.y / 1000
        track = np.array(self._track).reshape(-1, 2)
        self._line.set_data(*track.T / 1000)
        self._tracker.set_data([x], [y])
        size = _NEEDLE * max(self._area[1] - self._area[0], self._area[3] - self._area[2]) / 1000
        self._needle.set_data(
            [x, x + size * math.sin(estimate.heading)], [y, y - size * math.cos(estimate.heading)]
        )
        ends = np.full((int(on.sum()), 3, 2), np.nan)
        ends[:, 0], ends[:, 1] = (x, y), positions[on]
        self._rays.set_data(*ends.reshape(-1, 2).T)
        note = estimate.flags & _BAD
        self._note.set_text(
            ", ".join(flag.name.lower() for flag in PoseFlags if flag & note and flag.name)
        )
        self._place_ellipse(estimate, track)

    def _place_residuals(self) -> None:
        points = np.array([point for frame in self._residuals for point in frame]).reshape(-1, 3)
        accepted = points[:, 2] > 0
        for artist, which in ((self._accepted, accepted), (self._refused, ~accepted)):
            artist.set_data(points[which, 0], np.clip(points[which, 1], -_RESIDUALS, _RESIDUALS))

    def _place_ellipse(self, estimate: Estimate, track: NDArray[np.float64]) -> None:
        values, vectors = np.linalg.eigh(estimate.covariance[:2, :2])
        sides = 2 * SIGMAS * np.sqrt(np.maximum(values, 0))
        shown = math.isfinite(sides.max())
        self._ellipse.set_visible(shown)
        if shown:
            self._zoom_to(0.75 * sides.max())
            self._ellipse.set(
                width=sides[1],
                height=sides[0],
                angle=math.degrees(math.atan2(vectors[1, 1], vectors[0, 1])),
            )
        self._recent.set_data(*(track - (estimate.x, estimate.y)).T)

    def _zoom_to(self, wanted: float) -> None:
        """Take the next of 1, 2, 5, 10, … mm, and stay there until it is far off."""
        if 0.25 * self._span <= wanted <= self._span:
            return
        decade = 10.0 ** math.floor(math.log10(max(wanted, 1e-3)))
        self._zoom(
            next(decade * n for n in (1, 2, 5, 10) if decade * n >= min(wanted, 10 * decade))
        )

    def _reach(self, x: float, y: float) -> None:
        """Show more of the room if the tracker has left what is shown."""
        left, right, near, far = self._area
        if left <= x <= right and near <= y <= far:
            return
        step = 500.0
        self._area = (
            min(left, step * math.floor(x / step)),
            max(right, step * math.ceil(x / step)),
            min(near, step * math.floor(y / step)),
            max(far, step * math.ceil(y / step)),
        )
        self._frame_room()
        self._background = None
