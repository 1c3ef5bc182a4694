"""The live map: what it draws of steps, how often, and that the picture follows."""

from __future__ import annotations

import io
import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image

from tracking.leds import LedMap
from tracking.live import LiveMap
from tracking.motion import Innovation, Outcome
from tracking.poses import Estimate, PoseFlags
from tracking.tracker import Step

LEDS = LedMap([3, 5, 8], [[-500.0, 0.0], [0.0, 300.0], [500.0, 0.0]])
COVARIANCE = np.diag([4.0, 1.0, 1e-6])


def step(
    t_ns: int = 0,
    place: tuple[float, float, float] | None = (100.0, 1500.0, 0.0),
    lit: tuple[int, ...] = (3, 8),
    residuals: tuple[tuple[int, float, Outcome], ...] = ((3, 0.5, Outcome.USED),),
    covariance: Any = COVARIANCE,
    flags: PoseFlags = PoseFlags.NONE,
) -> Step:
    frame: Any = SimpleNamespace(channels=lit)
    estimate = None if place is None else Estimate(t_ns, *place, covariance, flags)
    found = tuple(Innovation(t_ns, n, 1000.0, value, 0.5, what) for n, value, what in residuals)
    return Step(frame, t_ns, estimate, found)


def pixels(view: LiveMap) -> np.ndarray[Any, Any]:
    return np.asarray(Image.open(io.BytesIO(view.picture.value)).convert("RGB")).astype(int)


def points(artist: Any) -> list[tuple[float, float]]:
    x, y = (np.asarray(data, dtype=float).tolist() for data in artist.get_data())
    return list(zip(x, y, strict=True))


def test_before_any_pose() -> None:
    view = LiveMap(LEDS)
    empty = pixels(view)
    assert "no pose yet" in view.readout.value
    view.show(step(place=None, lit=(5,), residuals=()))
    assert "no pose yet" in view.readout.value
    assert points(view._map._on) == [(0.0, 0.3)]
    assert (pixels(view) != empty).any()  # the LED that is lit
    assert not view._map._tracker.get_visible()


def test_a_pose_is_drawn_where_it_is() -> None:
    view = LiveMap(LEDS)
    view.show(step(place=(100.0, 1500.0, math.radians(90))))
    drawn = view._map
    assert points(drawn._tracker) == [(0.1, 1.5)]
    (start, end) = points(drawn._needle)
    assert start == (0.1, 1.5)
    assert end[0] > 0.1  # heading 90° counter-clockwise from −y is +x
    assert end[1] == pytest.approx(1.5)
    assert points(drawn._on) == [(-0.5, 0.0), (0.5, 0.0)]
    rays = [point for point in points(drawn._rays) if not math.isnan(point[0])]
    assert rays == [(0.1, 1.5), (-0.5, 0.0), (0.1, 1.5), (0.5, 0.0)]
    assert "y   1500.00" in view.readout.value
    # in the picture, too: the tracker's black dot is at its place on the axes
    x, y = drawn.room.transData.transform((0.1, 1.5))
    height = int(drawn.figure.bbox.height)
    assert pixels(view)[height - round(y) - 1, round(x)].max() < 60


def test_the_ellipse_is_that_of_the_covariance() -> None:
    view = LiveMap(LEDS)
    turn, sizes = math.radians(30), (5.0, 1.0)
    rotation = np.array([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]])
    covariance = np.eye(3)
    covariance[:2, :2] = rotation @ np.diag(np.square(sizes)) @ rotation.T
    view.show(step(covariance=covariance))
    ellipse: Any = view._map._ellipse
    assert ellipse.get_width() == pytest.approx(2 * 3 * 5)
    assert ellipse.get_height() == pytest.approx(2 * 3 * 1)
    assert ellipse.get_angle() % 180 == pytest.approx(30)
    # all of it is on the axes, and not small
    reach = view._map.close.get_xlim()[1]
    assert 15 <= reach <= 60
    view.show(step(covariance=np.diag([math.inf, 1.0, 1.0])))
    assert not ellipse.get_visible()
    view.show(step(covariance=COVARIANCE * 1e-6))
    assert view._map.close.get_xlim()[1] < 0.1


def test_residuals_are_shown_by_led() -> None:
    view = LiveMap(LEDS)
    view.show(
        step(
            residuals=(
                (3, 0.5, Outcome.USED),
                (5, -50.0, Outcome.REJECTED),
                (8, math.nan, Outcome.MISSING),
            )
        )
    )
    assert points(view._map._accepted) == [(0.0, 1.0)]
    assert points(view._map._refused) == [(1.0, -5.0)]  # far off: at the edge
    for _ in range(200):
        view._map.take(step(residuals=((8, 0.0, Outcome.USED),)))
    view.show(step(residuals=()))
    assert len(points(view._map._accepted)) == 119  # old ones are forgotten
    assert points(view._map._refused) == []


def test_what_is_wrong_is_written_on_the_map() -> None:
    view = LiveMap(LEDS)
    view.show(step(flags=PoseFlags.LOST | PoseFlags.HEADING_ASSUMED))
    assert view._map._note.get_text() == "lost"
    assert points(view._map._line) == []  # a pose that is not known is no track
    view.show(step())
    assert view._map._note.get_text() == ""
    assert len(points(view._map._line)) == 1


def test_the_map_grows_with_the_track() -> None:
    view = LiveMap(LEDS, area=(-1000, 1000, 0, 2000))
    view.show(step())
    before = view._map.room.get_ylim()
    view.show(step(place=(-1700.0, 3100.0, 0.0)))
    after = view._map.room
    assert after.get_ylim()[1] > 3.5 > before[1]
    assert after.get_xlim()[0] < -2.0
    assert len(points(view._map._line)) == 2


def test_watch_draws_now_and_then_and_the_last() -> None:
    view = LiveMap(LEDS)
    drawn: list[int] = []
    png = view._map.png

    def counted() -> bytes:
        drawn.append(len(view._map._track))
        return png()

    view._map.png = counted  # type: ignore[method-assign]
    steps = [step(t_ns=n * 4_000_000) for n in range(30)]
    assert list(view.watch(steps, interval=0.05)) == steps
    assert drawn == [1, 14, 27, 30]  # each 52 ms, and the end
    assert "0.116000 s" in view.readout.value


def test_a_redrawn_background_gives_the_same_picture() -> None:
    """Blitting leaves nothing behind of what was shown before."""
    one, other = LiveMap(LEDS), LiveMap(LEDS)
    for number in range(5):
        place = (100.0 * number, 1000.0 + 100 * number, 0.1 * number)
        one.show(step(place=place, flags=PoseFlags.LOST, lit=(5,)))
    last = step(place=(0.0, 1800.0, 0.0), residuals=())
    one._map._track.clear()
    one._map._residuals.clear()
    one.show(last)
    other.show(last)
    one._map._background = None
    one.show(last)
    one._map._track.clear()
    other._map._track.clear()
    one.show(last)
    other.show(last)
    assert np.array_equal(pixels(one), pixels(other))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"area": (0, 0, 0, 1)}, "area = .* each from < to"),
        ({"truth": [[1.0, 2.0, 3.0]]}, r"truth has shape \(N, 2\)"),
    ],
)
def test_what_cannot_be_drawn_is_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        LiveMap(LEDS, **options)
