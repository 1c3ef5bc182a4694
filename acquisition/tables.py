"""Frames as CSV: a line of names, then one line per frame, its 3694 elements behind the rest.

The columns are ``sequence, leds, exposures, sh_period, icg_period, master_clock, timestamp_ns,
utc_ns, monotonic_ns, flags, e1 ... e3694``. Periods and exposures are in master clocks, the clock
in Hz; ``leds`` is a mask in hexadecimal; ``exposures`` are pairs such as ``0:80 1:80``; an empty
timestamp is an unknown one. Nothing of a `Frame` is lost.
"""

from __future__ import annotations

import csv
import io
import re
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from acquisition.dat import replacing
from acquisition.frames import CHANNELS, ELEMENTS, Frame, FrameFlags

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

COLUMNS: Final = (
    *("sequence", "leds", "exposures", "sh_period", "icg_period", "master_clock"),
    *("timestamp_ns", "utc_ns", "monotonic_ns", "flags"),
    *(f"e{n}" for n in range(1, ELEMENTS + 1)),
)
"""Names of the columns."""

_LEAD: Final = len(COLUMNS) - ELEMENTS
_LINE_LIMIT: Final = 1 << 20  # characters; a line as written has some 20 thousand
_NUMBER: Final = re.compile("[0-9]{1,20}")
_PAIR: Final = re.compile("([0-9]{1,2}):([0-9]{1,10})")
_U32: Final = 0xFFFF_FFFF
_I64: Final = (1 << 63) - 1
_LIMITS: Final = {
    "sequence": (1 << 64) - 1,
    "sh_period": _U32,
    "icg_period": _U32,
    "master_clock": _U32,
    "timestamp_ns": _I64,
    "utc_ns": _I64,
    "monotonic_ns": _I64,
    "flags": _U32,
}


class TableError(ValueError):
    """A file is no such CSV: names file, line, what was found and what expected."""


@contextmanager
def csv_writer(path: str | Path) -> Iterator[Callable[[Frame], None]]:
    """Write frames to a CSV file, which appears when the block ends well.

    Parameters
    ----------
    path : str or Path

    Yields
    ------
    callable
        Takes one frame after the other.

    Raises
    ------
    OSError
    """
    with replacing(path) as raw, io.TextIOWrapper(raw, "ascii", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(COLUMNS)
        yield lambda frame: writer.writerow(_cells(frame))


def _cells(frame: Frame) -> list[object]:
    return [
        frame.sequence,
        f"{frame.leds:#x}",
        " ".join(f"{channel}:{clocks}" for channel, clocks in frame.exposures.items()),
        frame.sh_period,
        frame.icg_period,
        frame.master_clock,
        "" if frame.timestamp is None else frame.timestamp,
        frame.utc_ns,
        frame.monotonic_ns,
        int(frame.flags),
        *frame.elements.tolist(),
    ]


def read_csv(path: str | Path) -> Iterator[Frame]:
    """Yield the frames of a CSV file, one after the other.

    Parameters
    ----------
    path : str or Path

    Raises
    ------
    TableError
        The file is something else, or damaged.
    OSError
        It cannot be read.
    """
    path = Path(path)
    with path.open(encoding="latin-1", newline="") as file:
        names = _cut(path, 1, file.readline(_LINE_LIMIT).removeprefix("\xef\xbb\xbf"))
        if tuple(names) != COLUMNS:
            raise TableError(
                f"{path}, line 1: found {_shown(','.join(names))}, expected the names of "
                f"{len(COLUMNS)} columns, from {COLUMNS[0]} to {COLUMNS[-1]}"
            )
        number = 1
        while line := file.readline(_LINE_LIMIT):
            number += 1
            if line.strip():
                yield _frame(path, number, _cut(path, number, line))


def _cut(path: Path, number: int, line: str) -> list[str]:
    if len(line) >= _LINE_LIMIT:
        raise TableError(f"{path}, line {number}: longer than {_LINE_LIMIT} characters")
    return [cell.strip(' \t"') for cell in line.rstrip("\r\n").split(",")]


def _frame(path: Path, number: int, cells: list[str]) -> Frame:
    where = f"{path}, line {number}"
    if len(cells) != len(COLUMNS):
        raise TableError(
            f"{where}: found {len(cells)} columns, expected {len(COLUMNS)}; was it cut off?"
        )
    lead = dict(zip(COLUMNS, cells[:_LEAD], strict=False))
    values = {
        name: _whole(where, name, lead[name], limit)
        for name, limit in _LIMITS.items()
        if name != "timestamp_ns" or lead[name]
    }
    elements = [
        _whole(where, f"e{n}", cell, 0xFFFF) for n, cell in enumerate(cells[_LEAD:], start=1)
    ]
    try:
        leds = int(lead["leds"][:20], 16)
        return Frame(
            np.array(elements, np.uint16),
            sequence=values["sequence"],
            leds=leds,
            exposures=_exposures(where, lead["exposures"]),
            sh_period=values["sh_period"],
            icg_period=values["icg_period"],
            master_clock=values["master_clock"],
            timestamp=values.get("timestamp_ns"),
            utc_ns=values["utc_ns"],
            monotonic_ns=values["monotonic_ns"],
            flags=FrameFlags(values["flags"]),
        )
    except TableError:
        raise
    except ValueError as error:
        raise TableError(f"{where}: {error}") from error


def _whole(where: str, name: str, text: str, limit: int) -> int:
    if not _NUMBER.fullmatch(text) or int(text) > limit:
        raise TableError(f"{where}, {name}: found {_shown(text)}, expected 0 to {limit}")
    return int(text)


def _exposures(where: str, text: str) -> dict[int, int]:
    result = {}
    for pair in text.split():
        match = _PAIR.fullmatch(pair)
        if not match or int(match[1]) >= CHANNELS or int(match[2]) > _U32:
            message = f"{where}, exposures: found {_shown(pair)}, expected CHANNEL:CLOCKS"
            raise TableError(message)
        result[int(match[1])] = int(match[2])
    return result


def _shown(text: str) -> str:
    text = ascii(text)
    return text if len(text) <= 60 else f"{text[:56]}...{text[0]}"
