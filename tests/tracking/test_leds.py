"""The map of LEDs: what is accepted and what is refused."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from tracking.leds import LedMap

PLACES = [[-250.0, 0.0], [250.0, 0.0]]


def test_a_line_rises_with_x_and_comes_nearer_at_every_second() -> None:
    leds = LedMap.line(4, 500.0, 300.0, first_channel=7)
    assert leds.channels == (7, 8, 9, 10)
    assert leds.positions.tolist() == [
        [-750.0, 0.0, 0.0],
        [-250.0, 300.0, 0.0],
        [250.0, 0.0, 0.0],
        [750.0, 300.0, 0.0],
    ]
    assert leds.index(9) == 2
    with pytest.raises(KeyError, match="no LED has channel 3"):
        leds.index(3)


def test_a_map_is_its_own_and_cannot_be_written() -> None:
    places = np.array([[0.0, 0.0, 1.0], [100.0, 0.0, 2.0]])
    leds = LedMap(np.array([3, 5]).tolist(), places, 0.1)
    places[0, 0] = 50.0
    assert leds.positions[0, 0] == 0.0
    assert leds.facings.tolist() == [0.1, 0.1]
    assert leds == LedMap([3, 5], [[0, 0, 1], [100, 0, 2]], [0.1, 0.1])
    assert leds != LedMap([5, 3], leds.positions, leds.facings)
    with pytest.raises(ValueError, match="read-only"):
        leds.positions[0, 0] = 1.0


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        (([1.7, 2], PLACES), TypeError, "LED channel 1.7: a whole number is needed"),
        (([True, 2], PLACES), TypeError, "LED channel True: a whole number"),
        (("01", PLACES), TypeError, "LED channel '0': a whole number"),
        ((np.array([1.0, 2.0]), PLACES), TypeError, "a whole number is needed"),
        (([0, 64], PLACES), ValueError, "LED channel 64: allowed are 0 to 63"),
        (([4, 4], PLACES), ValueError, "each may be used once"),
        (([0, 1, 2], PLACES), ValueError, "one row for each of 3 channels"),
        (([0, 1], [[0.0, 0.0], [math.nan, 0.0]]), ValueError, "positions = nan"),
        (([0, 1], [[-0.25, 0.0], [0.25, 0.0]]), ValueError, "0.5 mm apart .*in metres"),
        (([0, 1], PLACES, [0.0, 45.0]), ValueError, "45 rad: .*in degrees"),
        (([0, 1], PLACES, [0.0]), ValueError, r"facings has shape \(2,\)"),
    ],
)
def test_what_is_no_map_is_refused(
    arguments: tuple[Any, ...], error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        LedMap(*arguments)


def test_what_is_no_line_is_refused() -> None:
    with pytest.raises(ValueError, match=r"count = 2.5: allowed are whole numbers"):
        LedMap.line(2.5, 500.0)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="count = 0"):
        LedMap.line(0, 500.0)
    with pytest.raises(ValueError, match="pitch = nan"):
        LedMap.line(3, math.nan)
