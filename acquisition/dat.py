r"""`.dat` files, as the original host program writes them: four lines of comment, 3694 of values.

Written exactly so (line ends ``\n``, ``mys`` for microseconds); read as they are found in the
wild: with ``\r\n``, ``us``, any run of blanks, empty lines, DOS's mark of a file's end (0x1A), and
from boards whose master clock is not 4 MHz. Such a file holds the elements, the two periods and, by way of the integration time,
the master clock; it knows no time, no LEDs and no sequence number.
"""

from __future__ import annotations

import os
import re
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, Final

import numpy as np

from acquisition.frames import ELEMENTS, Frame

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

HEADER: Final = (
    "#Data from the TCD1304 linear CCD\n"
    "#column 1 = pixelnumber , column 2 = pixelvalue\n"
    "#Pixel 1-32 and 3679-3694 and are dummy pixels\n"
    "#SH-period: {sh}    ICG-period: {icg}    Integration time: {time} mys\n"
)
"""The original's comment. (The last lit element is number 3680, whatever it says.)"""

_SIZE_LIMIT: Final = 4 << 20  # a file as written has 40 kB
_CLOCKS: Final = (4_000_000, 2_000_000)  # Hz; the boards in the wild
_CLOCK_RANGE: Final = (800_000, 4_000_000)  # Hz; the sensor's
_U32: Final = 0xFFFF_FFFF
_SETTINGS_LINE: Final = "'#SH-period: N    ICG-period: N    Integration time: T mys'"
_SETTINGS: Final = re.compile(
    r"#\s*SH-period:\s*([0-9]{1,20})\s+ICG-period:\s*([0-9]{1,20})\s+"
    r"Integration\s+time:\s*([0-9]{1,20}(?:\.[0-9]{0,20})?)\s*(?:my|u|\xb5|\xc2\xb5|\xce\xbc)s",
    re.IGNORECASE | re.ASCII,
)
_SETTINGS_START: Final = re.compile(r"#\s*SH-period", re.IGNORECASE | re.ASCII)
_VALUE: Final = re.compile(r"[ \t]*([0-9]{1,20})[ \t]+([0-9]{1,20})[ \t]*", re.ASCII)
_LINE_END: Final = re.compile("\r\n|\n|\r")


class DatError(ValueError):
    """A file is not a `.dat` of this sensor: names file, line, what was found and what expected.

    Parameters
    ----------
    path : Path
    line : int or None
        From 1; None if the file as a whole is wrong.
    message : str
    """

    def __init__(self, path: Path, line: int | None, message: str) -> None:
        super().__init__(f"{path}{'' if line is None else f', line {line}'}: {message}")
        self.path = path
        self.line = line


def numbered(prefix: str | Path, number: int) -> Path:
    """Return the name of a capture's n-th file.

    Parameters
    ----------
    prefix : str or Path
    number : int
        From 1.

    Examples
    --------
    >>> print(numbered("output", 1))
    output00001.dat
    """
    if number < 1:
        raise ValueError(f"number = {number}: files are numbered from 1")
    return Path(f"{prefix}{number:05d}.dat")


def write_dat(path: str | Path, frame: Frame) -> None:
    """Write a frame as the original host does.

    The file appears complete or not at all; one that was there is replaced.

    Parameters
    ----------
    path : str or Path
    frame : Frame
        Its LEDs, times, flags and number have no place in the file.

    Raises
    ------
    ValueError
        The frame's periods are unknown (0).
    OSError
        The file cannot be written.
    """
    if frame.sh_period < 1 or frame.icg_period < 1:
        raise ValueError(
            f"{path}: a .dat file names the SH and ICG periods, and this frame's are unknown"
        )
    time = frame.sh_period * 1e6 / frame.master_clock
    header = HEADER.format(sh=frame.sh_period, icg=frame.icg_period, time=repr(time))
    lines = "".join(f"{n} {value}\n" for n, value in enumerate(frame.elements.tolist(), start=1))
    with replacing(path) as file:
        file.write((header + lines).encode("ascii"))


@contextmanager
def replacing(path: str | Path) -> Iterator[BinaryIO]:
    """Open a file that takes the path's place when the block ends well, and vanishes otherwise.

    Whoever reads the path sees the old file or the whole new one, even if the writer is killed.
    (If the machine loses power, the new one may still be missing.)

    Parameters
    ----------
    path : str or Path

    Raises
    ------
    OSError
    """
    path = Path(path)
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        with part.open("wb") as file:
            yield file
        part.replace(path)
    except BaseException:
        with suppress(OSError):
            part.unlink()
        raise


def read_dat(path: str | Path) -> Frame:
    """Read a `.dat` file.

    The master clock follows from SH period and integration time: 4 or 2 MHz if the time printed
    fits one of them, else whatever it gives within the sensor's 0.8 to 4 MHz.

    Parameters
    ----------
    path : str or Path

    Returns
    -------
    Frame
        With elements, periods and master clock; the rest is unknown.

    Raises
    ------
    DatError
        The file is something else, or damaged.
    OSError
        It cannot be read.
    """
    path = Path(path)
    with path.open("rb") as file:
        data = file.read(_SIZE_LIMIT + 1)
    if not data.strip(b" \t\r\n\v\f\x1a"):
        raise DatError(path, None, f"the file is empty; expected {ELEMENTS} lines 'n value'")
    if len(data) > _SIZE_LIMIT:
        raise DatError(
            path, None, f"longer than {_SIZE_LIMIT >> 20} MB; expected about 40 kB, one frame"
        )
    text = data.removeprefix(b"\xef\xbb\xbf").decode("latin-1").rstrip("\x1a")
    settings: tuple[int, int, int] | None = None
    values: list[int] = []
    number = 0
    for number, line in enumerate(_LINE_END.split(text), start=1):
        if match := _VALUE.fullmatch(line):
            values.append(_value(path, number, line, len(values) + 1, match))
        elif (comment := line.lstrip(" \t")).startswith("#"):
            if _SETTINGS_START.match(comment):
                if settings is not None:
                    message = f"a second {_shown(line)}; expected one frame a file"
                    raise DatError(path, number, message)
                settings = _settings(path, number, comment)
        elif line.strip(" \t"):
            raise DatError(path, number, f"found {_shown(line)}, expected {_wanted(values)}")
    if len(values) < ELEMENTS:
        message = f"the file ends after {len(values)} values, expected {ELEMENTS}; was it cut off?"
        raise DatError(path, number, message)
    if settings is None:
        raise DatError(path, None, f"no line {_SETTINGS_LINE}; expected one before the values")
    sh_period, icg_period, master_clock = settings
    return Frame(
        np.array(values, np.uint16),
        sh_period=sh_period,
        icg_period=icg_period,
        master_clock=master_clock,
    )


def _value(path: Path, line: int, text: str, wanted: int, match: re.Match[str]) -> int:
    number, value = int(match[1]), int(match[2])
    if wanted > ELEMENTS:
        raise DatError(path, line, f"found {_shown(text)} after the last of {ELEMENTS} values")
    if number != wanted:
        raise DatError(path, line, f"found value number {number}, expected number {wanted}")
    if value > 0xFFFF:
        raise DatError(path, line, f"found the value {value}, expected 0 to 65535")
    return value


def _wanted(values: list[int]) -> str:
    if len(values) >= ELEMENTS:
        return f"nothing more after {ELEMENTS} values"
    return f"'{len(values) + 1} value' or a comment that begins with #"


def _settings(path: Path, line: int, text: str) -> tuple[int, int, int]:
    match = _SETTINGS.match(text)
    if match is None:
        raise DatError(path, line, f"found {_shown(text)}, expected {_SETTINGS_LINE}")
    sh_period, icg_period = int(match[1]), int(match[2])
    for name, period in (("SH", sh_period), ("ICG", icg_period)):
        if not 1 <= period <= _U32:
            raise DatError(path, line, f"found {name} period {period}, expected 1 to {_U32}")
    return sh_period, icg_period, _clock(path, line, sh_period, match[3])


def _clock(path: Path, line: int, sh_period: int, printed: str) -> int:
    """Master clock in Hz; the time printed in us may be rounded or cut off."""
    time = float(printed)
    step = 10.0 ** -len(printed.partition(".")[2])
    error, clock = min((abs(sh_period * 1e6 / clock - time), -clock) for clock in _CLOCKS)
    if error < step:
        return -clock
    low, high = _CLOCK_RANGE
    if not sh_period * 1e6 / high < time + step or not time - step < sh_period * 1e6 / low:
        raise DatError(
            path,
            line,
            f"found SH period {sh_period} with an integration time of {_shown(printed)} us, "
            f"expected {sh_period * 1e6 / high:g} to {sh_period * 1e6 / low:g} us (a master clock "
            "of 4 to 0.8 MHz)",
        )
    return min(max(round(sh_period * 1e6 / time), low), high)


def _shown(text: str) -> str:
    text = ascii(text)
    return text if len(text) <= 60 else f"{text[:56]}...{text[0]}"


class DatWriter:
    """Writes frames to numbered files, prefix00001.dat and so on; `record` takes it.

    Parameters
    ----------
    prefix : str or Path
        Files of the same names are replaced.

    Attributes
    ----------
    stored : int
        Frames written so far.
    """

    def __init__(self, prefix: str | Path) -> None:
        self.prefix = prefix
        self.stored = 0

    def append(self, frames: Iterable[Frame]) -> None:
        """Write the frames; on return the files are there.

        Parameters
        ----------
        frames : iterable of Frame

        Raises
        ------
        ValueError, OSError
            As `write_dat`.
        """
        for frame in frames:
            write_dat(numbered(self.prefix, self.stored + 1), frame)
            self.stored += 1

    def close(self) -> None:
        """Nothing is left to do: every file was closed when it was written."""
