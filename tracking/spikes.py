"""Spikes: where on the line an LED's light is, how sure that is, and what is wrong with it."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields
from enum import IntFlag
from functools import cache
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, Self, get_args

import numpy as np

from acquisition.frames import ELEMENTS, PIXELS, Frame, FrameFlags
from raytransfer import _checks as check

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from types import ModuleType

    from numpy.typing import ArrayLike, NDArray

Detector = Literal["minimum", "gravity", "derivative", "likelihood"]
"""How a spike's position is found."""

_DETECTORS = get_args(Detector)


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
        return not int(self.flags) & SpikeFlags.MISSING.value  # five times as fast as the enum's &


class Light(NamedTuple):
    """What a frame says of the light on each pixel."""

    electrons: NDArray[np.float64]
    """Shape (3648,), e⁻ over the dark level; noise makes some negative."""
    variance: NDArray[np.float64]
    """Of `electrons`, e⁻²: photons, read-out, quantisation, what is not known of the pixel."""
    saturated: NDArray[np.bool_]
    """Pixels that are full: they hold at least what `electrons` says."""


@dataclass(frozen=True, eq=False)
class Correction:
    """From codes to electrons: what is known of one specimen of the sensor.

    Parameters
    ----------
    pattern : array_like, shape (3648,)
        How far each pixel without light reads below the frame's dark reference, codes.
    response : array_like, shape (3648,)
        Of each pixel, relative to the mean of all: the flat field.
    electrons_per_code : float
        e⁻.
    read_noise : float
        Standard deviation of a reading without light, quantisation included, e⁻.
    saturation : float
        Codes below the dark reference from which on a pixel counts as full. Somewhat less than
        where the sensor saturates, so that its noise does not bring a full pixel above it.
    uncertainty : float
        Relative standard deviation of `response`: what of it is not known.

    Raises
    ------
    ValueError
        If shapes do not fit or a number is out of its range.
    """

    pattern: NDArray[np.float64]
    response: NDArray[np.float64]
    electrons_per_code: float
    read_noise: float
    saturation: float
    uncertainty: float = 0.0
    _gain: NDArray[np.float64] = field(init=False, repr=False)
    _inverse: NDArray[np.float64] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        arrays = {
            "pattern": check.array("pattern", self.pattern).copy(),
            "response": check.positive_array("response", self.response).copy(),
        }
        for name, values in arrays.items():
            if values.shape != (PIXELS,):
                raise ValueError(f"{name} has shape ({PIXELS},), one per pixel, not {values.shape}")
        for name in ("electrons_per_code", "read_noise", "saturation"):
            object.__setattr__(self, name, check.positive(name, getattr(self, name)))
        doubt = check.not_negative("uncertainty", self.uncertainty)
        if doubt >= 1:
            raise ValueError(f"uncertainty = {doubt:g}: allowed is below 1; given in percent?")
        object.__setattr__(self, "uncertainty", doubt)
        arrays["_gain"] = self.electrons_per_code / arrays["response"]
        arrays["_inverse"] = 1 / arrays["response"]
        for name, values in arrays.items():
            values.flags.writeable = False
            object.__setattr__(self, name, values)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Correction):
            return NotImplemented
        return all(np.array_equal(getattr(self, n), getattr(other, n)) for n in _FIELDS)

    __hash__ = None  # type: ignore[assignment]  # as every type that holds an array

    @classmethod
    def nominal(
        cls,
        *,
        electrons_per_code: float = 47.0,
        read_noise: float = 60.0,
        saturation: float = 1900.0,
        uncertainty: float = 0.015,
    ) -> Self:
        """Return what may be assumed of a specimen that was never measured: even, no pattern.

        Parameters
        ----------
        electrons_per_code : float
            e⁻; 47 is a figure for boards with a 12-bit converter. It scales heights, and tells
            photons' noise.
        read_noise : float
            Without light, e⁻. Quantisation, 1/12 code², is added.
        saturation : float
            Codes below the dark reference. The sensor's output falls by 1.6 V or so of 3.3.
        uncertainty : float
            Relative standard deviation of the pixels' response.
        """
        return cls(
            np.zeros(PIXELS),
            np.ones(PIXELS),
            electrons_per_code,
            math.hypot(
                check.not_negative("read_noise", read_noise),
                check.positive("electrons_per_code", electrons_per_code) / math.sqrt(12),
            ),
            saturation,
            uncertainty,
        )

    @classmethod
    def measure(
        cls,
        dark_frames: Sequence[Frame],
        flat_frames: Sequence[Frame],
        *,
        saturation: float = 1900.0,
    ) -> Self:
        """Measure a specimen on frames without light and on frames of even light.

        Electrons per code are from the photon transfer: light that gives n codes in the mean adds
        n / (electrons per code) to the variance. The lamp may flicker from frame to frame, and its
        shading along the line, a polynomial of fourth order, is not taken for the sensor's.

        Parameters
        ----------
        dark_frames, flat_frames : sequence of Frame
            Of one integration time, each at least 4; with 32 at half of saturation the response is
            known to 0.1 %. The flat ones best without a lens.
        saturation : float
            As in `Correction`, codes; flat and dark frames cannot tell it.

        Raises
        ------
        ValueError
            If there are too few frames, one is invalid, one of the dark ones is not dark, one of
            the others not even, too dark or saturated, or their integration times differ.
        """
        limit = check.positive("saturation", saturation)
        for kind, frames in (("dark", dark_frames), ("flat", flat_frames)):
            if len(frames) < _FEWEST:
                raise ValueError(
                    f"{len(frames)} {kind} frames: at least {_FEWEST} are needed, since their "
                    "scatter is measured too"
                )
            for n, frame in enumerate(frames):
                if reasons := frame.invalid():
                    raise ValueError(f"{kind} frame {n}: {reasons[0]}")
        periods = {f.sh_period for f in (*dark_frames, *flat_frames) if f.sh_period}
        if len(periods) > 1:
            raise ValueError(
                f"SH periods of {sorted(periods)} clocks: dark and flat frames need one "
                "integration time, since the dark signal grows with it"
            )
        darks, flats = (
            np.array([frame.dark_level - frame.pixels.astype(float) for frame in frames])
            for frames in (dark_frames, flat_frames)
        )
        for n, (depth, coarse) in enumerate(zip(darks, _coarse(darks), strict=True)):
            level = float(np.median(depth))
            if abs(level) > _DARK_LEVEL or np.ptp(coarse) > _DARK_LEVEL:
                raise ValueError(
                    f"dark frame {n} is not dark: its pixels read {level:g} codes below the dark "
                    f"reference, {coarse.max() - level:g} more where it is brightest; allowed are "
                    f"{_DARK_LEVEL}. Is the head covered?"
                )
        pattern = darks.mean(axis=0)
        for n, (depth, coarse) in enumerate(zip(flats, _coarse(flats - pattern), strict=True)):
            if depth.max() >= limit:
                raise ValueError(
                    f"flat frame {n} is saturated: a pixel reads {depth.max():g} codes below the "
                    f"dark reference; allowed is below {limit:g}"
                )
            if coarse.min() < _FLAT_LEVEL:
                raise ValueError(
                    f"flat frame {n} is too dark: {coarse.min():g} codes at its darkest; allowed "
                    f"is above {_FLAT_LEVEL}. Were dark and flat frames swapped?"
                )
            # what is left by the shading: a spike, a shadow
            left = coarse / _shading(coarse) - 1
            if coarse.max() > _FLAT_RATIO * coarse.min() or np.abs(left).max() > _FLAT_SPIKE:
                raise ValueError(
                    f"flat frame {n} is not even: from {coarse.min():g} to {coarse.max():g} codes, "
                    f"up to {np.abs(left).max():.0%} off a smooth shading; allowed are a ratio of "
                    f"{_FLAT_RATIO:g} and {_FLAT_SPIKE:.0%}. Is an LED or a shadow on it?"
                )
        light = flats - pattern
        level = light.mean(axis=1)
        even = light * (level.mean() / level)[:, None]
        quiet = darks - darks.mean(axis=1, keepdims=True)
        read = float(quiet.var(axis=0, ddof=1).mean())
        noise = even.var(axis=0, ddof=1)
        photons = float(noise.mean()) - read
        if not photons > 0:
            raise ValueError(
                f"flat frames scatter by {math.sqrt(noise.mean()):.3g} codes, dark ones by "
                f"{math.sqrt(read):.3g}: photons must add to it; are the flat frames saturated, "
                "or one frame many times?"
            )
        electrons_per_code = float(level.mean()) / photons
        mean = even.mean(axis=0)
        response = mean / _shading(mean)
        response /= response.mean()
        return cls(
            pattern,
            response,
            electrons_per_code,
            # all frames may be equal where a converter is coarse
            math.sqrt(max(read, 1 / 12)) * electrons_per_code,
            limit,
            math.sqrt(float(noise.mean()) / len(flats)) / float(level.mean()),
        )

    def light(self, frame: Frame, unlit: Frame | None = None) -> Light:
        """Return the light of a frame, less that of a frame with the LEDs off if one is given.

        What both frames hold (scene, dark signal) goes; variances add.
        """
        from tracking._spikes import convert

        def converted(elements: NDArray[np.uint16]) -> Light:
            electrons, variance = np.empty(PIXELS), np.empty(PIXELS)
            full = np.empty(PIXELS, np.bool_)
            convert(
                elements, self.pattern, self._gain, self._inverse, self._settings(), electrons,
                variance, full,
            )  # fmt: skip
            return Light(electrons, variance, full)

        lit = converted(_elements(frame))
        if unlit is None:
            return lit
        dark = converted(_elements(unlit))
        return Light(
            lit.electrons - dark.electrons,
            lit.variance + dark.variance,
            lit.saturated | dark.saturated,
        )

    def _settings(self, *others: float) -> NDArray[np.float64]:
        return np.array([self.read_noise**2, self.saturation, self.uncertainty**2, *others])

    def to_dict(self) -> dict[str, Any]:
        """Return what JSON can hold; `from_dict` gives back an equal correction."""
        return {
            name: value.tolist() if isinstance(value, np.ndarray) else value
            for name, value in ((name, getattr(self, name)) for name in _FIELDS)
        }

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Self:
        """Read what `to_dict` wrote.

        Raises
        ------
        ValueError
            If an entry is missing, unknown or out of its range.
        """
        if set(data) != set(_FIELDS):
            wrong = min(set(data) ^ set(_FIELDS))
            raise ValueError(
                f"entry {wrong!r} of a correction is {'unknown' if wrong in data else 'missing'}: "
                f"needed are {', '.join(_FIELDS)}"
            )
        return cls(**data)


_FIELDS = tuple(entry.name for entry in fields(Correction) if entry.init)

_FEWEST = 4  # frames
_DARK_LEVEL = 150  # codes; of long integration, at 25 °C
_FLAT_LEVEL = 50  # codes
_FLAT_RATIO = 2.0
_FLAT_SPIKE = 0.1
_BLOCK = 24  # px


def _coarse(lines: NDArray[np.float64]) -> NDArray[np.float64]:
    """Means of blocks of pixels."""
    return np.asarray(lines.reshape(*lines.shape[:-1], -1, _BLOCK).mean(axis=-1))


def _shading(line: NDArray[np.float64]) -> NDArray[np.float64]:
    """The smooth part of light on a line."""
    place = np.linspace(-1, 1, line.size)
    return np.asarray(np.polynomial.Legendre.fit(place, line, 4, domain=[-1, 1])(place))


def _elements(frame: Frame) -> NDArray[np.uint16]:
    """The frame's elements as the compiled code wants them: in one piece, read-only."""
    elements = frame.elements
    if not elements.flags.c_contiguous:
        elements = elements.copy()
        elements.flags.writeable = False
    return elements


MISSING = Spike(math.nan, math.inf, math.nan, math.nan, SpikeFlags.MISSING)
"""What stands for a spike where there is none."""

_NOTHING = np.empty(0, np.uint16)
_NOTHING.flags.writeable = False
_NO_CHARGE = np.empty(0)
_WHOLE_LINE = np.empty((0, 2), np.int64)
_FLAGS = tuple(SpikeFlags(n) for n in range(32))
_COLUMNS = 5
# as integers: an IntFlag's operators are slow
_INVALID = int(FrameFlags.INVALID)
_MISSING = int(SpikeFlags.MISSING)


class SpikeFinder:
    """Finds the spikes of a frame.

    All detectors get the same places, found by the significance of light over what is beside it, at
    widths from 4 to 256 px: a step or a broad spectrum is no spike. Two peaks with light between
    them are a caustic's horns, and one spike. They differ in how the position is read. `minimum` is the thesis's pixel with the lowest code. `gravity` is the
    centre of gravity of what is above a tenth of the height. `derivative` is where the light has no
    slope once it is smoothed by a Gaussian of 0.35 widths. `likelihood` fits position, amplitude,
    width, background and gradient, at first of a Gaussian; where noise cannot explain what that
    leaves, together with a second, smaller Gaussian beside it, or of a box with soft edges and
    bright rims, which has two parameters more. Full pixels count only as far as the fit must not
    stay below them.

    One pixel alone is taken for a hot one, unless the correction has a dark pattern or an unlit
    frame is given: then hot pixels are known, and it is an LED in sharp focus. Without, such an LED
    is found where it leaves 3 % of its light beside the pixel. As to where in its pixel it is, sigma
    says what is not known; nothing narrower than a pixel is told from one as wide.

    A position's standard deviation is what noise alone makes of it: photons, reading, and what the
    correction says of unknown response. Where a line is noisier than the correction says, its own
    noise is taken.

    Parameters
    ----------
    correction : Correction, optional
        `Correction.nominal` when left out.
    detector : {"minimum", "gravity", "derivative", "likelihood"}
    limit : int
        Most spikes to return of a whole line.
    threshold : float
        Least significance of a spike, in standard deviations of the light on its width. At 6, one
        frame in 1000 at most has a spike that is only noise.

    Raises
    ------
    ValueError
        If there is no such detector, or a number is out of its range.
    """

    def __init__(
        self,
        correction: Correction | None = None,
        *,
        detector: Detector = "likelihood",
        limit: int = 8,
        threshold: float = 6.0,
    ) -> None:
        if detector not in _DETECTORS:
            raise ValueError(f"detector = {detector!r}: allowed are {', '.join(_DETECTORS)}")
        self.correction = Correction.nominal() if correction is None else correction
        self.detector: Detector = detector
        self.limit = check.whole("limit", limit)
        self.threshold = check.positive("threshold", threshold)
        self._kind = _DETECTORS.index(detector)
        known = float(np.any(self.correction.pattern))
        self._settings = self.correction._settings(self.threshold, _FRACTION, known)

    def __call__(
        self,
        frame: Frame,
        *,
        windows: Sequence[tuple[int, int]] | None = None,
        unlit: Frame | None = None,
    ) -> list[Spike]:
        """Find the spikes of a frame.

        Parameters
        ----------
        frame : Frame
            A frame with the flag `FrameFlags.INVALID` has no spikes.
        windows : sequence of (first, last), optional
            Pixels among which one spike each is expected, both included; at least 12 to tell a
            spike from its background, best 5 times as wide as the spike. Parts beyond the line are
            cut off. The whole line is searched when left out.
        unlit : Frame, optional
            A frame of the same scene with the LEDs off, to subtract.

        Returns
        -------
        list of Spike
            One for each window, `MISSING` where there is none, and the highest where there are
            more, wherever in the window it is: not the one nearest to its middle. Of the whole
            line, the strongest first.
        """
        correction = self.correction
        if windows is None:
            places, rows = _WHOLE_LINE, self.limit
        else:
            rows = len(windows)
            if not rows:
                return []
            places = np.array(windows, dtype=np.int64)
            if places.shape != (rows, 2):
                raise ValueError(f"windows: pairs (first, last) are needed, not {windows!r}")
        if int(frame.flags) & _INVALID:
            return [] if windows is None else [MISSING] * rows
        out = np.empty((rows, _COLUMNS))
        count = _kernels().find(
            _elements(frame), _NOTHING if unlit is None else _elements(unlit), _NO_CHARGE,
            correction.pattern, correction._gain, correction._inverse,
            places, self.limit, self._kind, self._settings, out,
        )  # fmt: skip
        return [_spike(row) for row in out[:count].tolist()]

    def profile(self, electrons: ArrayLike, window: tuple[int, int] | None = None) -> Spike:
        """Find the strongest spike of a profile without noise, as exact optics give it.

        Parameters
        ----------
        electrons : array_like, shape (N,)
            Expected charge per pixel, e⁻.
        window : (first, last), optional
            As for a frame.

        Returns
        -------
        Spike
            Its sigma is that of a reading of this light.
        """
        charge = np.ascontiguousarray(check.array("electrons", electrons))
        if charge.ndim != 1 or not charge.size:
            raise ValueError(f"electrons has shape (N,), not {charge.shape}")
        places = _WHOLE_LINE if window is None else np.array([window], dtype=np.int64)
        correction = self.correction
        out = np.empty((1, _COLUMNS))
        count = _kernels().find(
            _NOTHING, _NOTHING, charge, correction.pattern, correction._gain, correction._inverse,
            places, 1, self._kind, self._settings, out,
        )  # fmt: skip
        return _spike(out[0].tolist()) if count else MISSING

    def load_kernels(self) -> None:
        """Compile all code, or load it, so that no later call stalls."""
        frame = Frame(np.full(ELEMENTS, 3000, np.uint16))
        self.correction.light(frame)
        self(frame)
        self.profile(np.zeros(PIXELS))


_FRACTION = 0.1  # of the height: the centre of gravity of what is above


@cache
def _kernels() -> ModuleType:
    """The compiled code; numba is slow to load."""
    from tracking import _spikes

    return _spikes


def _spike(row: list[float]) -> Spike:
    position, sigma, width, height, flags = row
    if flags == _MISSING:
        return MISSING
    return Spike(position, sigma, width, height, _FLAGS[int(flags)])
