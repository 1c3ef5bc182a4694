"""A survey: recordings of a resting tracker at measured places, as `bundle` takes them."""

from __future__ import annotations

import math
import shlex
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from acquisition.cli import UsageError
from acquisition.frames import FrameFlags
from raytransfer.sensors import TCD1304
from tracking.calibration import Observation
from tracking.poses import UNKNOWN, Prior
from tracking.spikes import MISSING, SpikeFlags
from tracking.tracker import END

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence
    from pathlib import Path

    from acquisition.frames import Frame
    from tracking.spikes import Spike, SpikeFinder

UNSTEADY: Final = 1.0
"""px: half of a resting LED's spikes are within much less of their median."""

_USELESS: Final = {
    SpikeFlags.MISSING.value: "not seen",
    SpikeFlags.SATURATED.value: "saturated",
    SpikeFlags.CLIPPED.value: "cut off by the end of the line",
    SpikeFlags.REFLECTION.value: "beside a reflection",
}


@dataclass(frozen=True)
class Place:
    """A line of a survey: a recording, and where the tracker was.

    Parameters
    ----------
    line : int
        Of the file, from 1.
    recording : Path
    x, y : float
        mm.
    heading : float
        rad; NaN where it is not said.
    """

    line: int
    recording: Path
    x: float
    y: float
    heading: float

    def observed(
        self, sights: Mapping[int, Sight], place_error: float, heading_error: float, height: float
    ) -> Observation:
        """Return what was seen from here; errors in mm and degrees."""
        good = {channel: sight for channel, sight in sights.items() if not sight.why}
        return Observation(
            list(good),
            [sight.pixel for sight in good.values()],
            [sight.sigma for sight in good.values()],
            Prior(self.x, place_error),
            Prior(self.y, place_error),
            UNKNOWN
            if math.isnan(self.heading)
            else Prior(self.heading, math.radians(heading_error)),
            height,
        )


def read_survey(path: Path) -> list[Place]:
    """Read a survey: lines of a recording, x and y (mm), and maybe a heading (degrees).

    Recordings are relative to the survey's folder; names with a blank, a comma or # are quoted.

    Raises
    ------
    UsageError
        It holds something else, or names a recording that is not there, or one twice; the message
        names the line.
    OSError
        It cannot be read.
    """
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        raise UsageError(f"{path}: it is no text; a survey names recordings and places") from error
    places: list[Place] = []
    for number, line in enumerate(lines, start=1):
        try:
            cut = shlex.shlex(line, posix=True)
            cut.whitespace, cut.whitespace_split = " \t,", True
            if not (words := list(cut)):
                continue
            name, x, y, *rest = words
            (heading,) = rest or ["nan"]
            place = Place(
                number, path.parent / name, float(x), float(y), math.radians(float(heading))
            )
            told = (place.x, place.y, *([place.heading] if rest else []))
            if not np.isfinite(told).all() or (rest and abs(place.heading) > 2 * math.pi):
                raise ValueError
        except ValueError as error:
            raise UsageError(
                f"{path}, line {number}: {line.strip()!r} is not recording, x, y in mm and heading "
                "in degrees, such as spot01.h5 -400 1500 5"
            ) from error
        if not place.recording.is_file():
            raise UsageError(f"{path}, line {number}: there is no file {place.recording}")
        if before := [other.line for other in places if other.recording == place.recording]:
            raise UsageError(
                f"{path}, line {number}: {name} stands in line {before[0]} too; one place each"
            )
        places.append(place)
    if not places:
        raise UsageError(f"{path}: there is no recording in it")
    return places


@dataclass(frozen=True)
class Sight:
    """How a resting tracker saw an LED.

    Parameters
    ----------
    pixel, sigma : float
        Median of its spikes, px, and standard deviation of that; NaN where there is none.
    why : str
        Why it is of no use, such as "saturated"; empty otherwise.
    """

    pixel: float
    sigma: float
    why: str = ""


def look(frames: Iterable[Frame], finder: SpikeFinder) -> dict[int, Sight]:
    """Return what frames of a resting tracker show of each LED, by channel.

    Frames in which several LEDs are lit are left out: which is which is not known before there is a
    calibration. One without LEDs is subtracted from those that follow. Of several exposures of an
    LED, that with the surest spikes is taken of those that do not saturate in most frames.
    """
    spikes: dict[tuple[int, int], list[Spike]] = {}
    unlit: Frame | None = None
    for frame in frames:
        if frame.flags & FrameFlags.INVALID:
            continue
        if not frame.channels:
            unlit = frame
        elif len(frame.channels) == 1:
            found = finder(frame, unlit=unlit)
            (channel,) = frame.channels
            lit = frame.exposures.get(channel, frame.sh_period)
            spikes.setdefault((channel, lit), []).extend(found[:1] or [MISSING])
    sights: dict[int, Sight] = {}
    for (channel, _), those in sorted(spikes.items()):
        sight, before = _sight(those), sights.get(channel)
        if before is None or before.why or sight.sigma < before.sigma:
            sights[channel] = sight
    return sights


def _sight(spikes: Sequence[Spike]) -> Sight:
    flags = np.array([int(spike.flags) for spike in spikes])
    places = np.array([spike.position for spike in spikes])
    for flag, why in _USELESS.items():
        if 2 * np.count_nonzero(flags & flag) > len(flags):
            return Sight(math.nan, math.nan, why)
    good = (flags & sum(_USELESS)) == 0
    if 2 * np.count_nonzero(good) <= len(flags):
        return Sight(math.nan, math.nan, "not clear in most frames")
    pixel = float(np.median(places[good]))
    if not END <= pixel <= TCD1304.pixels - 1 - END:
        return Sight(math.nan, math.nan, "at the end of the line")
    wanders = float(np.median(np.abs(places[good] - pixel)))
    if wanders > UNSTEADY:
        return Sight(math.nan, math.nan, f"wandering by {wanders:.1f} px")
    stated = np.median([spike.sigma for spike, ok in zip(spikes, good, strict=True) if ok])
    # of a normal distribution, the deviation from its median and the spread of that
    sigma = max(float(stated), 1.4826 * wanders)
    return Sight(pixel, sigma * math.sqrt(math.pi / 2 / np.count_nonzero(good)))
