"""Poses: from spikes of LEDs at known places to where the tracker is, and how sure that is."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntFlag
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


class PoseFlags(IntFlag):
    """What a pose must not be trusted in; 0 is nothing."""

    NONE = 0
    PREDICTED = 1
    """No LED was found: motion alone was carried on."""
    LOST = 2
    """Lock was lost: the pose is of the last time that it was known."""
    RELOCALISED = 4
    """The first pose after lock was lost."""
    REJECTED = 8
    """A measurement was refused as a gross error."""
    AMBIGUOUS = 16
    """Another pose explains the measurements as well."""
    DANGER_CIRCLE = 32
    """LEDs and tracker lie near one circle: position and heading cannot be told apart."""
    INCONSISTENT = 64
    """Residuals are larger than the errors stated: something is wrong with the calibration."""
    HEADING_ASSUMED = 128
    """Heading was not measured but given."""


@dataclass(frozen=True)
class Estimate:
    """A pose at a time, one line of the output.

    Parameters
    ----------
    t_ns : int
        Device time, ns: the end of the exposure, or the time predicted to.
    x, y : float
        mm.
    heading : float
        rad.
    covariance : ndarray, shape (3, 3)
        Of x, y and heading.
    flags : PoseFlags
    """

    t_ns: int
    x: float
    y: float
    heading: float
    covariance: NDArray[np.float64]
    flags: PoseFlags = PoseFlags.NONE
