"""The thesis's tracking, function by function (section 4.3.2): two frames, two minima, x and y.

It is the baseline that everything else is compared with, so it is as simple as it was: a spike is
where the intensity is least, and numbers are in pixels until four measured corners turn them into
mm. What is new is that a frame which no sensor can have sent is told by its contents.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from acquisition.capture import capture
from acquisition.dat import DatError, numbered, read_dat
from acquisition.protocol import Command

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from acquisition.frames import Frame
    from acquisition.links import Link
    from tracking.calibration import FourCorners

CORNERS: Final = ("lf", "lb", "rf", "rb")
"""Folders of the measured corners: left or right, front (next to the LEDs) or back."""

CALL: Final = Command(sh_period=100, icg_period=30000, count=2)
"""The thesis's call of its host program: ``-i 30000 -s 100 -n 2``."""

INVALID: Final = "invalid data"
"""What the thesis's program says of a damaged measurement."""


class Reading(NamedTuple):
    """What one call of the thesis's program comes to.

    Attributes
    ----------
    x, y : float
        Midpoint and separation of the spikes in px, or the place in mm where corners are given;
        NaN if the data is invalid.
    utc_ns : int
        The host's clock when the second frame had arrived: original mode knows no other time.
    invalid : tuple of str
        Why the data is; empty if nothing is wrong.
    """

    x: float
    y: float
    utc_ns: int = 0
    invalid: tuple[str, ...] = ()

    def __str__(self) -> str:
        if self.invalid:
            return f"{INVALID}: {'; '.join(self.invalid)}"
        return f"{self.x:g} {self.y:g}"


def read_data(path: str | Path) -> list[int]:
    """Return the intensities of a `.dat` file.

    Parameters
    ----------
    path : str or Path

    Returns
    -------
    list of int
        All 3694 values in the file's order, so entry n is line n + 1, and pixel n − 32.

    Raises
    ------
    DatError
        The file is cut off or damaged, or its values are none that the sensor can have sent.
    OSError
        It cannot be read.
    """
    frame = read_dat(path)
    if reasons := frame.invalid():
        raise DatError(Path(path), None, "; ".join(reasons))
    values: list[int] = frame.elements.tolist()
    return values


def simple_spike_tracking(data1: Sequence[int], data2: Sequence[int]) -> tuple[float, float]:
    """Return midpoint and separation of two spikes.

    A spike is the first of the least values: light lowers them. Noise and anything else that is
    dark count as well, and a line without any light has a minimum, too.

    Parameters
    ----------
    data1, data2 : sequence of int
        Intensities with the first and with the second LED lit, equally many.

    Returns
    -------
    x : float
        Midpoint, in list indices.
    y : float
        First spike minus second one.

    Raises
    ------
    ValueError
        If the lists are empty or not equally long.
    """
    if not len(data1) or len(data1) != len(data2):
        raise ValueError(
            f"{len(data1)} and {len(data2)} intensities: two lines of the same sensor are needed"
        )
    spike1, spike2 = int(np.argmin(data1)), int(np.argmin(data2))
    return (spike1 + spike2) / 2, float(spike1 - spike2)


def tracking_2d(
    prefix: str | Path = "output", *, number: int = 1, corners: FourCorners | None = None
) -> tuple[float, float] | None:
    """Print where the tracker is, from two files of a capture; or that they are invalid.

    Parameters
    ----------
    prefix : str or Path
        Of the files, as for the capture: ``output00001.dat`` and ``output00002.dat``.
    number : int
        Of the first file.
    corners : FourCorners, optional
        Turns pixels into mm, by its `bilinear`.

    Returns
    -------
    tuple of float, or None
        What was printed: x and y; None if the data is invalid.

    Raises
    ------
    OSError
        A file cannot be read.
    """
    reading = _of_files(prefix, number, corners)
    sys.stdout.write(f"{reading}\n")
    return None if reading.invalid else (reading.x, reading.y)


def print_tracking_area(
    folder: str | Path = ".", places: Mapping[str, tuple[float, float]] | None = None
) -> dict[str, tuple[float, float]]:
    """Print midpoint and separation at the corners of a tracking area.

    Parameters
    ----------
    folder : str or Path
        Holds the folders `CORNERS`, and each of them the files of one or more captures with
        ``-n 2`` and the prefix ``output``. Of several valid measurements the mean is taken.
    places : mapping of str to tuple of float, optional
        Where the corners are, x and y in mm, to be printed as well.

    Returns
    -------
    dict
        Midpoint and separation in px by corner; a corner without valid data is left out, and the
        warning says so.

    Raises
    ------
    FileNotFoundError
        A folder is missing, or holds no measurement.
    """
    result: dict[str, tuple[float, float]] = {}
    for corner in CORNERS:
        place = Path(folder) / corner
        if not place.is_dir():
            raise FileNotFoundError(f"{place}: no folder of this corner's measurements")
        first = numbered(place / "output", 1)
        if not first.is_file():
            raise FileNotFoundError(f"{first}: no measurement of this corner")
        valid = []
        number = 1
        while numbered(place / "output", number + 1).is_file():
            reading = _of_files(place / "output", number, None)
            if reading.invalid:
                sys.stdout.write(f"{corner} {reading}\n")
            else:
                valid.append((reading.x, reading.y))
            number += 2
        if not valid:
            sys.stdout.write(f"{corner} {INVALID}: no pair of files is left\n")
            continue
        x, y = np.mean(valid, axis=0).tolist()
        result[corner] = (x, y)
        where = "" if places is None else " at {:g} {:g} mm".format(*places[corner])
        sys.stdout.write(f"{corner} {x:g} {y:g}{where}\n")
    return result


def positions(
    link: Link,
    corners: FourCorners | None = None,
    *,
    count: int | None = None,
    command: Command = CALL,
) -> Iterator[Reading]:
    """Call after call, as the thesis's ``run.sh`` did, but without files in between.

    Parameters
    ----------
    link : Link
    corners : FourCorners, optional
        Turns pixels into mm, by its `bilinear`.
    count : int, optional
        Calls; without end when left out.
    command : Command
        Original mode, two frames.

    Yields
    ------
    Reading
        One for each call, valid or not; no more once a recording has ended.

    Raises
    ------
    LinkError
        As `capture`.
    """
    done = 0
    while count is None or done < count:
        frames = list(capture(link, command))
        if len(frames) < 2:
            return
        yield _of_frames(frames[-2], frames[-1], corners)
        done += 1


def _of_frames(first: Frame, second: Frame, corners: FourCorners | None) -> Reading:
    reasons = tuple(
        f"frame {number}: {reason}"
        for number, frame in enumerate((first, second), start=1)
        for reason in frame.invalid()
    )
    at = second.utc_ns or time.time_ns()
    if reasons:
        return Reading(np.nan, np.nan, at, reasons)
    return _reading(first.elements.tolist(), second.elements.tolist(), corners, at)


def _of_files(prefix: str | Path, number: int, corners: FourCorners | None) -> Reading:
    """Read two files; invalid data is part of the answer."""
    paths = [numbered(prefix, number + n) for n in range(2)]
    try:
        first, second = (read_data(path) for path in paths)
    except DatError as error:
        return Reading(np.nan, np.nan, 0, (str(error),))
    return _reading(first, second, corners, paths[1].stat().st_mtime_ns)


def _reading(
    first: Sequence[int], second: Sequence[int], corners: FourCorners | None, utc_ns: int
) -> Reading:
    x, y = simple_spike_tracking(first, second)
    if corners is not None:
        x, y = (float(place) for place in corners.bilinear(x, y))
    return Reading(x, y, utc_ns)
