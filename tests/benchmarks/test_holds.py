"""The verdicts of the benchmarks and the file they are written to, from made-up samples."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import pytest

from benchmarks.measure import Direction, Result, holds, interleaved, ratios, write_json

if TYPE_CHECKING:
    from pathlib import Path


@pytest.mark.parametrize(
    ("samples", "direction", "target", "expected"),
    [
        ([3.0, 1.0, 2.0], "higher", 1.9, True),
        ([3.0, 1.0, 2.0], "higher", 2.1, False),
        ([3.0, 1.0, 2.0], "lower", 2.1, True),
        ([3.0, 1.0, 2.0], "lower", 1.9, False),
        ([2.0], "higher", 2.0, True),
        ([2.0], "lower", 2.0, True),
        ([1.0, 2.0], "higher", 1.5, True),  # the mean of the middle two
        ([1.0, 2.0], "higher", 1.6, False),
        ([-0.2, -0.1, 0.3], "lower", 0.0, True),
    ],
)
def test_the_median_is_judged(
    samples: list[float], direction: Direction, target: float, expected: bool
) -> None:
    assert holds(samples, direction, target) is expected


@pytest.mark.parametrize("outlier", [1e-9, 1e9])
@pytest.mark.parametrize("direction", ["higher", "lower"])
def test_one_outlier_does_not_change_the_verdict(outlier: float, direction: Direction) -> None:
    calm = [10.0, 10.1, 9.9, 10.0]
    for target in (9.0, 11.0):
        assert holds([*calm, outlier], direction, target) is holds(calm, direction, target)


def test_no_samples_are_refused() -> None:
    with pytest.raises(ValueError, match="median"):
        holds([], "higher", 1.0)


def test_json_has_every_field(tmp_path: Path) -> None:
    path = tmp_path / "new" / "bench.json"
    write_json(
        [
            Result("fast enough", "rays/s", [5.0, 1.0, 3.0], target=3.0),
            Result("too slow", "s", [0.2, 0.4], "lower", 0.25),
            Result("only to know", "rays/s", [7.0]),
        ],
        path,
    )
    assert json.loads(path.read_text(encoding="utf-8")) == [
        {
            "name": "fast enough",
            "value": 3.0,
            "unit": "rays/s",
            "direction": "higher",
            "target": 3.0,
            "samples": [5.0, 1.0, 3.0],
            "holds": True,
        },
        {
            "name": "too slow",
            "value": pytest.approx(0.3),
            "unit": "s",
            "direction": "lower",
            "target": 0.25,
            "samples": [0.2, 0.4],
            "holds": False,
        },
        {
            "name": "only to know",
            "value": 7.0,
            "unit": "rays/s",
            "direction": "higher",
            "target": None,
            "samples": [7.0],
            "holds": None,
        },
    ]


def test_json_refuses_what_is_not_a_number(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="JSON"):
        write_json([Result("broken", "s", [float("nan")])], tmp_path / "bench.json")


def test_contenders_take_turns_and_ratios_pair_the_rounds() -> None:
    turns: list[str] = []

    def contender(name: str, step: float) -> float:
        turns.append(name)
        return step * len(turns)

    a, b = interleaved(3, lambda: contender("A", 1.0), lambda: contender("B", 10.0))
    assert turns == ["A", "B"] * 4
    assert a == [3.0, 5.0, 7.0]  # the first round warms up
    assert b == [40.0, 60.0, 80.0]
    assert ratios(b, a) == pytest.approx([40 / 3, 12.0, 80 / 7])
