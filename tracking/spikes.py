"""Spikes: where on the line an LED's light is, how sure that is, and what is wrong with it."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntFlag


class SpikeFlags(IntFlag):
    """What is wrong with a spike; 0 is nothing."""

    NONE = 0
    SATURATED = 1
    """Pixels of it are full."""
    CLIPPED = 2
    """It reaches over the end of the line or of the window."""
    DOUBLE = 4
    """Two peaks: another LED in the window, or a caustic's two horns."""
    REFLECTION = 8
    """A second, weaker spike of the same LED is near, as from a shiny wall."""
    MISSING = 16
    """No light was found: position and the rest are NaN, sigma is infinite."""


@dataclass(frozen=True, slots=True)
class Spike:
    """Light of an LED on the line.

    Parameters
    ----------
    position : float
        px; p is the middle of pixel p, 0 to 3647.
    sigma : float
        Standard deviation of the position, px; infinite if there is none.
    width : float
        Full width at half maximum, px.
    height : float
        Of its peak over the background, electrons.
    flags : SpikeFlags
    """

    position: float
    sigma: float
    width: float
    height: float
    flags: SpikeFlags = SpikeFlags.NONE

    @property
    def found(self) -> bool:
        """Whether there is a position."""
        return not self.flags & SpikeFlags.MISSING
