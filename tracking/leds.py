"""Where the LEDs are: what a tracker is told, or a calibration has found."""

from __future__ import annotations

import math
from dataclasses import dataclass
from numbers import Integral
from typing import TYPE_CHECKING, Self

import numpy as np

from acquisition.frames import CHANNELS
from raytransfer import _checks as check

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import ArrayLike, NDArray


@dataclass(frozen=True, eq=False)
class LedMap:
    """LEDs at known places of the room.

    Parameters
    ----------
    channels : sequence of int
        0 to 63, each once.
    positions : array_like, shape (N, 3)
        Room x, y and z, mm. With shape (N, 2) z is 0.
    facings : array_like, shape (N,), optional
        Directions in which they shine, rad, counter-clockwise from +y; 0 when left out.

    Raises
    ------
    TypeError
        If a channel is no whole number.
    ValueError
        If shapes do not fit, a channel is out of range or used twice, a number is not finite, all
        LEDs are within 20 mm (metres were given), or a direction is beyond ±2π (degrees were).
    """

    channels: tuple[int, ...]
    positions: NDArray[np.float64]
    facings: NDArray[np.float64]

    def __init__(
        self, channels: Sequence[int], positions: ArrayLike, facings: ArrayLike | None = None
    ) -> None:
        given: list[object] = list(channels)
        if wrong := [n for n in given if isinstance(n, bool) or not isinstance(n, Integral)]:
            raise TypeError(f"LED channel {wrong[0]!r}: a whole number is needed")
        numbers = tuple(int(channel) for channel in channels)
        points = check.array("positions", positions).copy()
        if points.ndim != 2 or points.shape[1] not in (2, 3) or len(points) != len(numbers):
            raise ValueError(
                f"positions has shape (N, 3) with one row for each of {len(numbers)} channels, "
                f"not {points.shape}"
            )
        if points.shape[1] == 2:
            points = np.column_stack([points, np.zeros(len(points))])
        turned = check_facings(0.0 if facings is None else facings, len(numbers))
        check_extent(points)
        if outside := [n for n in numbers if not 0 <= n < CHANNELS]:
            raise ValueError(f"LED channel {outside[0]}: allowed are 0 to {CHANNELS - 1}")
        if len(set(numbers)) != len(numbers):
            raise ValueError(f"LED channels {list(numbers)}: each may be used once")
        points.flags.writeable = turned.flags.writeable = False
        object.__setattr__(self, "channels", numbers)
        object.__setattr__(self, "positions", points)
        object.__setattr__(self, "facings", turned)

    def __len__(self) -> int:
        return len(self.channels)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, LedMap):
            return NotImplemented
        return (
            self.channels == other.channels
            and np.array_equal(self.positions, other.positions)
            and np.array_equal(self.facings, other.facings)
        )

    __hash__ = None  # type: ignore[assignment]  # as every type that holds an array

    def index(self, channel: int) -> int:
        """Row of a channel's LED.

        Raises
        ------
        KeyError
            If no LED has this channel.
        """
        try:
            return self.channels.index(channel)
        except ValueError:
            raise KeyError(
                f"no LED has channel {channel}: the map has {list(self.channels)}"
            ) from None

    @classmethod
    def line(
        cls, count: int, pitch: float, stagger: float = 0.0, *, first_channel: int = 0
    ) -> Self:
        """LEDs along x around 0, every second one `stagger` mm nearer to the tracker (+y).

        Channels rise with x.
        """
        number = np.arange(check.whole("count", count))
        x = (number - (count - 1) / 2) * check.number("pitch", pitch, "mm")
        y = np.where(number % 2, check.number("stagger", stagger, "mm"), 0.0)
        return cls([first_channel + int(n) for n in number], np.column_stack([x, y]))


LEAST_EXTENT = 20.0
"""mm; LEDs nearer together than this tell no pose, and rooms in metres are smaller."""


def check_extent(positions: NDArray[np.float64]) -> None:
    """Refuse LEDs that are all in one place, or in metres."""
    extent = float(np.ptp(positions, axis=0).max()) if len(positions) > 1 else math.inf
    if extent < LEAST_EXTENT:
        raise ValueError(
            f"LEDs are {extent:g} mm apart at most: allowed is {LEAST_EXTENT:g} or more; "
            "were their positions given in metres?"
        )


def check_facings(facings: ArrayLike, count: int) -> NDArray[np.float64]:
    """Return a direction for each LED, rad; one may stand for all."""
    given = check.array("facings", facings)
    if given.shape not in {(), (count,)}:
        raise ValueError(f"facings has shape ({count},), one per LED, not {given.shape}")
    if (far := np.abs(given)[np.abs(given) > math.tau]).size:
        raise ValueError(
            f"facings: {far.flat[0]:g} rad: allowed are −2π to 2π; was it given in degrees?"
        )
    return np.broadcast_to(given, count).copy()
