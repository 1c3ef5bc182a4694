"""Where the LEDs are: what a tracker is told, or a calibration has found."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Self

import numpy as np

from acquisition.frames import CHANNELS

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
    ValueError
        If shapes do not fit, a channel is out of range or used twice, or a number is not finite.
    """

    channels: tuple[int, ...]
    positions: NDArray[np.float64]
    facings: NDArray[np.float64]

    def __init__(
        self, channels: Sequence[int], positions: ArrayLike, facings: ArrayLike | None = None
    ) -> None:
        numbers = tuple(int(channel) for channel in channels)
        points = np.array(positions, dtype=float)
        if points.ndim != 2 or points.shape[1] not in (2, 3) or len(points) != len(numbers):
            raise ValueError(
                f"positions has shape (N, 3) with one row for each of {len(numbers)} channels, "
                f"not {points.shape}"
            )
        if points.shape[1] == 2:
            points = np.column_stack([points, np.zeros(len(points))])
        turned = np.zeros(len(numbers)) if facings is None else np.array(facings, dtype=float)
        if turned.shape != (len(numbers),):
            raise ValueError(f"facings has shape ({len(numbers)},), not {turned.shape}")
        if not (np.isfinite(points).all() and np.isfinite(turned).all()):
            raise ValueError("positions and facings: all must be finite")
        if wrong := [n for n in numbers if not 0 <= n < CHANNELS]:
            raise ValueError(f"LED channel {wrong[0]}: allowed are 0 to {CHANNELS - 1}")
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
        if count < 1:
            raise ValueError(f"count = {count}: allowed is >= 1")
        number = np.arange(count)
        x = (number - (count - 1) / 2) * pitch
        y = np.where(number % 2, stagger, 0.0)
        return cls([first_channel + int(n) for n in number], np.column_stack([x, y]))
