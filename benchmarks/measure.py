"""Take samples in turns, judge them, write them down: shared by all benchmarks."""

from __future__ import annotations

import json
import statistics
import timeit
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence
    from pathlib import Path

    from numpy.typing import ArrayLike

Direction = Literal["higher", "lower"]


def holds(samples: Sequence[float], direction: Direction, target: float) -> bool:
    """Judge samples by their median.

    Parameters
    ----------
    samples : sequence of float
        At least one.
    direction : {"higher", "lower"}
        Which side of the target is good; the target itself is good too.
    target : float
        In the unit of the samples.
    """
    value = statistics.median(samples)
    return value >= target if direction == "higher" else value <= target


@dataclass(frozen=True)
class Result:
    """What was measured: a row of the table and an entry of bench.json.

    Parameters
    ----------
    name, unit : str
    samples : list of float
        In the order they were taken; for a ratio, that of each round.
    direction : {"higher", "lower"}
        Which is better.
    target : float, optional
        Left out, the row only informs.
    """

    name: str
    unit: str
    samples: list[float]
    direction: Direction = "higher"
    target: float | None = None

    @property
    def value(self) -> float:
        """The median of the samples."""
        return statistics.median(self.samples)

    @property
    def holds(self) -> bool | None:
        """Whether the target is met; None without a target."""
        if self.target is None:
            return None
        return holds(self.samples, self.direction, self.target)


def write_json(results: Iterable[Result], path: Path) -> None:
    """Write all results, with their samples, as one JSON list."""
    rows = [
        {
            "name": result.name,
            "value": result.value,
            "unit": result.unit,
            "direction": result.direction,
            "target": result.target,
            "samples": result.samples,
            "holds": result.holds,
        }
        for result in results
    ]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(rows, indent=1, allow_nan=False) + "\n", encoding="utf-8")


def interleaved(rounds: int, *contenders: Callable[[], float]) -> list[list[float]]:
    """Let contenders measure in turns, A B A B …, so that a busy machine slows all of them.

    Parameters
    ----------
    rounds : int
        How many measurements to keep of each; one more, the first, is thrown away.
    contenders : callable
        Each call is one measurement and returns it.

    Returns
    -------
    list of list of float
        The measurements of each contender, round by round.
    """
    taken = [[contender() for contender in contenders] for _ in range(rounds + 1)]
    return [list(samples) for samples in zip(*taken[1:], strict=True)]


def seconds(call: Callable[[], object], number: int = 1) -> Callable[[], float]:
    """Return a contender that times the call.

    Parameters
    ----------
    call : callable
        What to time; timeit collects no garbage meanwhile.
    number : int
        How often to call it for one measurement, the mean. A quick call beside a slow one is
        repeated, so that both find the machine as they left it themselves.
    """
    return lambda: timeit.timeit(call, number=number) / number


def ratios(numerators: Iterable[float], denominators: Iterable[float]) -> list[float]:
    """Divide the samples of the same rounds."""
    return [over / under for over, under in zip(numerators, denominators, strict=True)]


def require_same(name: str, theirs: ArrayLike, ours: ArrayLike, tolerance: float = 1e-6) -> None:
    """Refuse to compare the speed of things that do not compute the same.

    Raises
    ------
    ValueError
        If shapes differ, or any two numbers by more than the tolerance, absolute and relative.
    """
    theirs, ours = np.asarray(theirs, dtype=float), np.asarray(ours, dtype=float)
    if theirs.shape != ours.shape:
        raise ValueError(f"{name}: shape {theirs.shape} instead of {ours.shape}")
    if not np.allclose(theirs, ours, rtol=tolerance, atol=tolerance):
        raise ValueError(f"{name}: results differ by up to {np.abs(theirs - ours).max():g}")
