"""Calibration: from pixels at known places to a camera and a map of LEDs that hold over the area.

Two ways. `FourCorners` is the thesis's: two LEDs, measured at the corners of the area, and in
between an interpolation. `bundle` adjusts everything at once, camera, LEDs and the poses from which
they were seen, so that all spikes fit best; it says how sure each number is, and refuses where the
observations cannot tell.

A file is JSON: what it holds, units included, is said in `UNITS` and `save_calibration`.
"""

from __future__ import annotations

import json
import math
import operator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final, Literal, NamedTuple, Self, get_args

import numpy as np

from acquisition.dat import replacing
from raytransfer import _checks as check
from raytransfer.designs import Design
from raytransfer.sensors import TCD1304
from tracking.camera import Camera
from tracking.leds import LedMap
from tracking.nominal import nominal_camera
from tracking.poses import UNKNOWN, Prior, by_pose, closed_form, optical
from tracking.spikes import Correction

if TYPE_CHECKING:
    import os
    from collections.abc import Mapping, Sequence

    from numpy.typing import ArrayLike, NDArray

    from raytransfer import OpticalSystem

Loss = Literal["linear", "huber", "soft_l1", "cauchy"]
"""How much a residual of many σ counts, as `scipy.optimize.least_squares` names it."""

LOSS_SCALE = 3.0
"""Residuals beyond so many σ count less than their square."""

OUTLIER = 5.0
"""Residuals beyond so many σ are named in the notes."""

TELLING = 5.0
"""px RMS: a parameter whose σ would move the spikes by more is not determined."""

RANK = 1e-7
"""Singular values of the scaled Jacobian below this part of the largest are rounding."""

FORMAT: Final = "linetrack calibration"
"""What a calibration file says it is."""

VERSION: Final = 1
"""Of the format, the only one so far."""

UNITS: Final = {"length": "mm", "angle": "rad", "place on the line": "px", "charge": "electrons"}
"""Of all numbers in a file; `scale` of the camera is in px per unit of tangent."""


class Corner(NamedTuple):
    """What two LEDs show at a known place.

    Attributes
    ----------
    x, y : float
        Of the tracker, mm.
    midpoint, separation : float
        Of the two spikes, px.
    """

    x: float
    y: float
    midpoint: float
    separation: float


class FourCorners:
    """The thesis's mapping: midpoint and separation of two spikes, known at four places.

    Both coordinates are bilinear functions of two numbers a and b, ``c₀ + c₁ a + c₂ b + c₃ a b``,
    that are right at the four corners. The thesis says only that "tracking within the borders of
    the premeasured tracking space maps the tracking data to absolute positions"; `bilinear` takes
    the midpoint and the separation as they are. They are not linear in x and y: a pinhole shows
    midpoint = centre + f x / y and separation = f B / y. `rational` takes midpoint / separation
    and 1 / separation, of which x and y are linear functions, so that only the lens's distortion,
    a heading and the pupil are left.

    Parameters
    ----------
    left_front, left_back, right_front, right_back : Corner

    Raises
    ------
    ValueError
        If a separation is 0 or has another sign than the rest, or the corners do not span an area.
    """

    def __init__(
        self, left_front: Corner, left_back: Corner, right_front: Corner, right_back: Corner
    ) -> None:
        names = "left front", "left back", "right front", "right back"
        self.corners = (left_front, left_back, right_front, right_back)
        table = np.array(
            [
                [check.number(f"{key} of the corner {name}", v) for key, v in c._asdict().items()]
                for name, corner in zip(names, self.corners, strict=True)
                for c in (Corner(*corner),)
            ]
        )
        x, y, midpoint, separation = table.T
        signs = np.sign(separation)
        if not signs.all() or (signs != signs[0]).any():
            shown = ", ".join(f"{name} {s:g}" for name, s in zip(names, separation, strict=True))
            raise ValueError(
                f"separations in px: {shown}: allowed are four of one sign, not 0; was the same "
                "LED's frame taken twice, or were the LEDs swapped at one corner?"
            )
        self._sign = float(signs[0])
        places = np.column_stack([x, y])
        self._bilinear = self._solved("midpoint and separation", midpoint, separation, places)
        self._rational = self._solved(
            "midpoint / separation and 1 / separation",
            midpoint / separation,
            1 / separation,
            places,
        )

    def bilinear(
        self, midpoint: ArrayLike, separation: ArrayLike
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Place of the tracker, x and y in mm, bilinear in midpoint and separation, px."""
        return self._place(self._bilinear, *self._measured(midpoint, separation))

    def rational(
        self, midpoint: ArrayLike, separation: ArrayLike
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Place of the tracker, x and y in mm, bilinear in midpoint / separation and 1 / separation.

        Raises
        ------
        ValueError
            If a separation is 0 or of another sign than at the corners.
        """
        a, b = self._measured(midpoint, separation)
        if a.size and (wrong := b * self._sign).min() <= 0:
            raise ValueError(
                f"separation = {b.flat[wrong.argmin()]:g} px: allowed is of the sign that it has at "
                "the corners, not 0; were the two spikes swapped, or are they the same LED's?"
            )
        return self._place(self._rational, a / b, 1 / b)

    @staticmethod
    def _measured(
        midpoint: ArrayLike, separation: ArrayLike
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        return check.array("midpoint", midpoint, "px"), check.array("separation", separation, "px")

    @staticmethod
    def _place(
        solved: tuple[NDArray[np.float64], ...], a: NDArray[np.float64], b: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        shift, size, c = solved
        a, b = (a - shift[0]) / size[0], (b - shift[1]) / size[1]
        x, y = (k[0] + k[1] * a + k[2] * b + k[3] * a * b for k in c.T)
        return x, y

    @staticmethod
    def _solved(
        what: str, a: NDArray[np.float64], b: NDArray[np.float64], places: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Shift and size of a and b, and the four coefficients of x and of y."""
        pair = np.stack([a, b])
        shift = pair.mean(axis=1)
        size: NDArray[np.float64] = np.ptp(pair, axis=1)
        if (size > 0).all():
            a, b = (pair - shift[:, None]) / size[:, None]
            system = np.column_stack([np.ones(4), a, b, a * b])
            if np.linalg.cond(system) < 1e6:
                return shift, size, np.asarray(np.linalg.solve(system, places))
        raise ValueError(
            f"{what} at the four corners do not span an area: {pair.T.round(6).tolist()}; are two "
            "corners the same measurement, or do all lie on one line?"
        )


BEYOND = 1000.0
"""px: no spike lies so far beyond the ends of the line."""


@dataclass(frozen=True)
class Observation:
    """Spikes seen from one pose.

    Parameters
    ----------
    channels : sequence of int
        LEDs.
    pixels : array_like, shape (N,)
        Their spikes, px.
    sigma : array_like
        Standard deviation of each, px: shape (N,), or one for all.
    x, y : Prior
        What is known of the tracker's place, mm. An infinite σ is "nothing"; the value is then
        ignored.
    heading : Prior
        The same of its heading, rad.
    height : float
        Of the tracker, mm; taken as known.

    Raises
    ------
    ValueError
        If shapes do not fit, an LED is seen twice, or a number is out of its range.
    """

    channels: Sequence[int]
    pixels: ArrayLike
    sigma: ArrayLike
    x: Prior = UNKNOWN
    y: Prior = UNKNOWN
    heading: Prior = UNKNOWN
    height: float = 0.0

    def __post_init__(self) -> None:
        channels = tuple(_whole("LED channel", channel) for channel in self.channels)
        pixels = check.array("pixels", self.pixels, "leave out LEDs that were not found")
        sigma = check.positive_array("sigma", self.sigma, "leave out LEDs that were not found")
        if pixels.shape != (len(channels),):
            raise ValueError(
                f"pixels has shape {pixels.shape}: one spike for each of {len(channels)} channels "
                "is needed"
            )
        if sigma.shape not in {(), pixels.shape}:
            raise ValueError(f"sigma is one number, or has shape {pixels.shape}, not {sigma.shape}")
        sigma = np.broadcast_to(sigma, pixels.shape)
        middle = (TCD1304.pixels - 1) / 2
        if pixels.size and (far := np.abs(pixels - middle)).max() > middle + BEYOND:
            raise ValueError(
                f"pixels = {pixels[far.argmax()]:g}: allowed is the line, 0 to {2 * middle:.0f} px, "
                f"or up to {BEYOND:.0f} px beyond; were samples or mm given?"
            )
        if len(set(channels)) != len(channels):
            raise ValueError(f"LED channels {list(channels)}: each is seen once from a pose")
        for name in ("x", "y", "heading"):
            value, spread = getattr(self, name)
            check.number(name, value)
            if not spread >= 0:
                raise ValueError(
                    f"σ of {name} = {spread}: allowed is 0 (known) to infinity (unknown)"
                )
        spread = self.heading.sigma
        check.angle("heading", self.heading.value)
        if 2 * math.pi < spread < math.inf:
            raise ValueError(
                f"σ of heading = {spread:g} rad: allowed is up to 2π, or infinity (unknown); were "
                "degrees given?"
            )
        check.number("height", self.height, "mm")
        for name, value in (("channels", channels), ("pixels", pixels), ("sigma", sigma)):
            object.__setattr__(self, name, value)


@dataclass(frozen=True, eq=False)
class Calibration:
    """All that a tracker must know of its head, its sensor and its LEDs.

    Parameters
    ----------
    camera : Camera
    leds : LedMap
    correction : Correction, optional
        Of the sensor's pixels.
    names : tuple of str
        Of the parameters that were estimated: those of `Camera.names`, and ``"LED 3 x"``.
    covariance : ndarray, shape (P, P), optional
        Of these, in the squares and products of their units; None where nothing was measured.
    rms : float
        Of the residuals, px; NaN where nothing was measured.
    spikes : int
        Spikes that it is based on.
    redundancy : int
        Spikes and priors more than parameters.
    notes : str
        For people.
    """

    camera: Camera
    leds: LedMap
    correction: Correction | None = None
    names: tuple[str, ...] = ()
    covariance: NDArray[np.float64] | None = None
    rms: float = math.nan
    spikes: int = 0
    redundancy: int = 0
    notes: str = ""

    def __post_init__(self) -> None:
        shape = () if self.covariance is None else np.shape(self.covariance)
        if shape != ((len(self.names),) * 2 if self.covariance is not None else ()):
            raise ValueError(
                f"covariance has shape {shape}: a row and a column for each of {len(self.names)} "
                "names are needed"
            )
        if self.covariance is None and self.names:
            raise ValueError("names of estimated parameters come with their covariance")
        if len(set(self.names)) != len(self.names):
            raise ValueError(f"names {list(self.names)}: each may be there once")
        if self.covariance is not None:
            _refuse_no_covariance(np.asarray(self.covariance))
        if not math.isnan(self.rms):
            check.not_negative("rms", self.rms, "px")
        if _whole("spikes", self.spikes) < 0:
            raise ValueError(f"spikes = {self.spikes}: allowed is >= 0")
        _whole("redundancy", self.redundancy)
        middle = (TCD1304.pixels - 1) / 2
        if abs(self.camera.centre - middle) > 2 * TCD1304.pixels:
            raise ValueError(
                f"centre of the camera = {self.camera.centre:g} px: the line has {TCD1304.pixels}"
            )
        if abs(self.camera.pupil) > FARTHEST_PUPIL:
            raise ValueError(
                f"pupil of the camera = {self.camera.pupil:g} mm: allowed is within "
                f"± {FARTHEST_PUPIL:g} mm of the first vertex"
            )
        if unknown := set(self.names) - set(_names(self.camera, self.leds)):
            raise ValueError(f"names: neither camera nor LEDs have {', '.join(sorted(unknown))}")

    @classmethod
    def nominal(
        cls,
        head: Design | OpticalSystem,
        leds: LedMap,
        *,
        correction: Correction | None = None,
        **options: Any,
    ) -> Self:
        """Calibration without data: the camera that the drawing says, and LEDs where they should be.

        Parameters
        ----------
        head : Design or OpticalSystem
        leds : LedMap
        correction : Correction, optional
        **options
            As for `Camera.from_system`; without any, the camera of one of `DESIGNS` is there at once.
        """
        design = head if isinstance(head, Design) else Design(head)
        if options:
            camera = Camera.from_system(design.system, **{"sensor": design.sensor, **options})
        else:
            camera = nominal_camera(design)
        notes = (
            f"Nominal: {design.system.name}, traced as drawn; no head is as drawn, and nothing was "
            "measured."
        )
        return cls(camera, leds, correction, notes=notes)

    def sigma(self, name: str) -> float:
        """Standard deviation of a parameter; 0 of one that was held, NaN where nothing was measured.

        Raises
        ------
        KeyError
            If there is no such parameter.
        """
        known = _names(self.camera, self.leds)
        if name not in known:
            raise KeyError(f"{name!r}: known are {', '.join(known)}")
        if self.covariance is None:
            return math.nan
        if name not in self.names:
            return 0.0
        at = self.names.index(name)
        return math.sqrt(self.covariance[at, at])

    def pose_covariance(
        self,
        channels: Sequence[int],
        x: float,
        y: float,
        heading: float = 0.0,
        *,
        height: float = 0.0,
        sigma: float = 0.05,
        sigma_heading: float = math.inf,
    ) -> NDArray[np.float64]:
        """Covariance of a pose that comes from the calibration's own uncertainty alone.

        It does not average out while the tracker rests: what a tracker calls accuracy, beside the
        jitter that its spikes have.

        Parameters
        ----------
        channels : sequence of int
            LEDs that the pose is found from.
        x, y, heading, height : float
            Tracker, mm and rad.
        sigma : float
            Of the spikes, px: only its ratio to `sigma_heading` matters.
        sigma_heading : float
            What is known of the heading, rad: 0 if it is known, infinite if not.

        Returns
        -------
        ndarray, shape (3, 3)
            Of x, y and heading.

        Raises
        ------
        ValueError
            If nothing was measured, or the LEDs do not tell a pose.
        """
        led = np.array([self.leds.index(channel) for channel in channels], dtype=int)
        rows = _Rows(np.zeros(len(led), dtype=int), led)
        pose = np.array([[x, y, heading, height]])
        told, covariance = self._pose_covariances(rows, pose, sigma, sigma_heading)
        if not told[0]:
            raise ValueError(f"LEDs {list(channels)} do not tell the pose from there")
        return np.asarray(covariance[0])

    def _pose_covariances(
        self, rows: _Rows, poses: NDArray[np.float64], sigma: float, sigma_heading: float
    ) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
        """Whether rows tell each pose, and its covariance, shape (poses, 3, 3)."""
        if self.covariance is None:
            raise ValueError(
                "this calibration has no covariance: it is nominal, nothing was measured"
            )
        common, moved = rows.blocks(self.camera, self.leds.positions, poses)
        known = _names(self.camera, self.leds)
        of_names = rows.by_pose(common[:, [known.index(name) for name in self.names]], len(poses))
        size = 2 if sigma_heading == 0 else 3
        along = rows.by_pose(moved[:, :size], len(poses))
        normal = along.mT @ along
        if sigma_heading != 0:
            normal[:, 2, 2] += (sigma / sigma_heading) ** 2
        scale = np.sqrt(np.diagonal(normal, axis1=1, axis2=2))
        scale[scale == 0] = 1.0
        scaled = normal / (scale[:, :, None] * scale[:, None, :])
        told = np.linalg.cond(scaled) <= 1e12
        change = np.zeros((len(poses), 3, len(self.names)))
        change[told, :size] = np.linalg.solve(normal[told], (along.mT @ of_names)[told])
        return told, change @ self.covariance @ change.mT

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the calibration as a file, which `load_calibration` reads back bit for bit.

        A file of that name is replaced once the new one is complete, or not at all. The same
        calibration gives the same bytes.

        Raises
        ------
        ValueError
            If the name does not end in ``.json``.
        OSError
            If it cannot be written.
        """
        if not str(path).endswith(".json"):
            raise ValueError(f"{path}: a calibration file ends in .json")
        data = {
            "format": FORMAT,
            "version": VERSION,
            "units": UNITS,
            "notes": self.notes,
            "camera": self.camera.to_dict(),
            "leds": [
                {"channel": channel, "position": position, "facing": facing}
                for channel, position, facing in zip(
                    self.leds.channels,
                    self.leds.positions.tolist(),
                    self.leds.facings.tolist(),
                    strict=True,
                )
            ],
            "correction": None if self.correction is None else self.correction.to_dict(),
            "parameters": list(self.names),
            "covariance": None if self.covariance is None else self.covariance.tolist(),
            "rms": None if math.isnan(self.rms) else self.rms,
            "spikes": self.spikes,
            "redundancy": self.redundancy,
        }
        text = json.dumps(data, indent=1, ensure_ascii=False, allow_nan=False)
        with replacing(str(path)) as file:
            file.write(f"{text}\n".encode())


FARTHEST_PUPIL = 500.0
"""mm; far more than a head is long."""


def _whole(name: str, value: Any) -> int:
    """Return a whole number as int; neither cut off what is none nor take a truth value."""
    try:
        if isinstance(value, bool | np.bool_):
            raise TypeError
        return operator.index(value)
    except TypeError:
        raise TypeError(f"{name} = {value!r}: a whole number is needed") from None


def _refuse_no_covariance(covariance: NDArray[np.float64]) -> None:
    """Refuse a square matrix that is no covariance: not symmetric, or with a negative variance."""
    check.array("covariance", covariance)
    variance = np.diag(covariance)
    if variance.size and variance.min() < 0:
        raise ValueError(f"covariance has a variance of {variance.min():g}: allowed is >= 0")
    size = np.sqrt(variance)
    scaled = covariance / np.where(size > 0, size, 1.0) / np.where(size > 0, size, 1.0)[:, None]
    if scaled.size and np.abs(scaled - scaled.T).max() > ROUNDING:
        raise ValueError("covariance is not symmetric")
    if scaled.size and np.linalg.eigvalsh(scaled)[0] < -ROUNDING * len(scaled):
        raise ValueError("covariance gives a sum of parameters a negative variance")


ROUNDING = 1e-8
"""Of a covariance whose variances are 1."""


def load_calibration(path: str | os.PathLike[str]) -> Calibration:
    """Read a calibration file.

    Raises
    ------
    ValueError
        If it is no calibration file, of an unknown version, lacks a field or has one too many, or
        its numbers make no calibration. The message begins with the path.
    OSError
        If it cannot be read.
    """
    with open(path, "rb") as file:  # noqa: PTH123  # whatever names a file
        content = file.read()
    try:
        return _calibration(json.loads(content.decode("utf-8"), object_pairs_hook=_once))
    except json.JSONDecodeError as error:
        raise ValueError(f"{path}: no calibration, which is JSON ({error})") from error
    except (ValueError, TypeError, KeyError) as error:
        raise ValueError(f"{path}: {error}") from error


_KINDS: Final[dict[str, tuple[type, ...]]] = {
    "notes": (str,),
    "camera": (dict,),
    "leds": (list,),
    "correction": (dict, type(None)),
    "parameters": (list,),
    "covariance": (list, type(None)),
    "rms": (int, float, type(None)),
    "spikes": (int,),
    "redundancy": (int,),
}
_JSON: Final[dict[type, str]] = {
    str: "a text",
    dict: "a table",
    list: "a list",
    type(None): "null",
    int: "a whole number",
    float: "a number",
}
_FIELDS = {"format", "version", "units", *_KINDS}


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return a table of JSON; one in which a name stands twice is refused."""
    table = dict(pairs)
    if len(table) != len(pairs):
        names = [name for name, _ in pairs]
        twice = next(name for name in names if names.count(name) > 1)
        raise ValueError(f"{twice} is there twice")
    return table


def _calibration(data: Any) -> Calibration:
    if not isinstance(data, dict) or data.get("format") != FORMAT:
        raise ValueError(f"this is no calibration file: it does not say format = {FORMAT!r}")
    version = data.get("version")
    if version != VERSION or isinstance(version, bool):
        raise ValueError(
            f"version = {version!r}: this program reads version {VERSION}; "
            "was the file written by a later one?"
        )
    _refuse_other("", data, _FIELDS)
    if data["units"] != UNITS:
        raise ValueError(f"units = {data['units']}: this program reads {UNITS}")
    for name, kinds in _KINDS.items():
        if not isinstance(data[name], kinds) or isinstance(data[name], bool):
            names = " or ".join(_JSON[kind] for kind in kinds)
            raise TypeError(f"{name} = {data[name]!r:.60}: {names} is needed")
    for number, led in enumerate(data["leds"], start=1):
        where = f"LED number {number}: "
        _refuse_other(where, led, {"channel", "position", "facing"})
        place = led["position"]
        if not isinstance(place, list) or len(place) != 3:
            raise TypeError(
                f"{where}position = {place!r:.60}: a list of x, y and z in mm is needed"
            )
        for value in (*place, led["facing"]):
            check.number(f"{where}position and facing", value)
    for name in data["parameters"]:
        if not isinstance(name, str):
            raise TypeError(f"parameters: {name!r:.60}: a name is needed")
    rows = data["covariance"] or []
    if any(not isinstance(row, list) or len(row) != len(rows) for row in rows):
        raise TypeError("covariance: a square table is needed, as many lists of as many numbers")
    if not data["leds"]:
        raise ValueError("leds: none; a tracker needs one at least")
    leds = LedMap(
        *([led[key] for led in data["leds"]] for key in ("channel", "position", "facing"))
    )
    covariance = data["covariance"]
    return Calibration(
        Camera.from_dict(data["camera"]),
        leds,
        None if data["correction"] is None else Correction.from_dict(data["correction"]),
        tuple(data["parameters"]),
        None if covariance is None else check.array("covariance", covariance),
        math.nan if data["rms"] is None else check.not_negative("rms", data["rms"], "px"),
        data["spikes"],
        data["redundancy"],
        data["notes"],
    )


def _refuse_other(where: str, data: Any, fields: set[str]) -> None:
    """Refuse what is no table of exactly these fields."""
    if not isinstance(data, dict):
        raise TypeError(f"{where}{data!r:.60}: a table of {', '.join(sorted(fields))} is needed")
    if wrong := set(data) ^ fields:
        raise ValueError(
            f"{where}unknown or missing: {', '.join(sorted(wrong))}; "
            f"known are {', '.join(sorted(fields))}"
        )


class UndeterminedError(ValueError):
    """Observations that cannot determine what they are asked for.

    Attributes
    ----------
    parameters : tuple of str
        What is not determined.
    calibration : Calibration or None
        What came out all the same, with its covariance; None where even that cannot be computed.
    """

    def __init__(
        self, message: str, parameters: tuple[str, ...], calibration: Calibration | None = None
    ) -> None:
        super().__init__(message)
        self.parameters = parameters
        self.calibration = calibration


def bundle(
    observations: Sequence[Observation],
    leds: LedMap,
    camera: Camera,
    *,
    led_sigma: ArrayLike = math.inf,
    camera_sigma: Mapping[str, float] | None = None,
    distortion: int = 2,
    decentring: int = 2,
    loss: Loss = "cauchy",
    correction: Correction | None = None,
    notes: str = "",
) -> Calibration:
    """Adjust camera, LEDs and poses at once, so that all spikes fit best.

    Minimised are the squares of all residuals over their σ, those of spikes weakened by `loss`,
    those of what is known beforehand as they are. What the camera model cannot follow is estimated
    from the residuals and becomes `Camera.model_error`, which counts in every σ.

    Only bearings are measured, so that nothing tells where the room's origin is, where its x axis
    points and how large it is, unless LEDs or poses are known: exactly (σ 0) or about (a finite σ).

    Parameters
    ----------
    observations : sequence of Observation
        Of poses all over the area and as far aside as the line sees: 20 or more.
    leds : LedMap
        Where the LEDs are, about.
    camera : Camera
        To begin with, such as that of `Camera.from_system`.
    led_sigma : array_like
        σ with which the LEDs' x and y are known, mm: one for all, shape (N,) or (N, 2). 0 holds
        them, infinite leaves them to the observations. z is held.
    camera_sigma : mapping of str to float, optional
        The same for the camera's numbers, by `Camera.names`. When nothing is said the pupil is known
        to `PUPIL`, since without turned poses it cannot be told from the LEDs' y; the coupling of
        height, for which LEDs of different z would be needed, is held; the others are left to the
        observations.
    distortion, decentring : int
        Fewest terms of these kinds; missing ones are added as 0. A head out of the box has more
        than its drawing: what is tilted is not the same on both sides.
    loss : {"linear", "huber", "soft_l1", "cauchy"}
        The last one forgets gross errors; the others let them pull.
    correction : Correction, optional
        Passed on.
    notes : str
        Passed on, before what is said here.

    Returns
    -------
    Calibration

    Raises
    ------
    UndeterminedError
        If the observations do not determine all that was left to them: it names what, and what to
        do. A straight rail of LEDs seen from unknown poses does not tell the scale.
    ValueError
        If an LED is unknown, or a pose cannot be found to begin with; if what is given contradicts
        itself: the line runs the other way, headings are clockwise, channels are swapped.
    RuntimeError
        If no minimum is found, or none at which the camera fits.
    """
    if loss not in get_args(Loss):
        raise ValueError(f"loss = {loss!r}: allowed are {', '.join(get_args(Loss))}")
    problem = _Bundle(observations, leds, _with_terms(camera, distortion, decentring))
    problem.know(led_sigma, camera_sigma or {})
    problem.refuse_gauge()
    problem.refuse_contradiction()
    model_error, failed = FIRST_ERROR, 0
    for _ in range(REWEIGHTINGS):
        problem.solve(loss, model_error)
        before, model_error = model_error, problem.left_over(model_error)
        if abs(model_error - before) <= max(0.02 * model_error, 0.1 * problem.noise.min()):
            break
        failed = 0 if problem.converged else failed + 1
        if failed == 2:  # it is lost, and would stay so for minutes
            break
    else:
        problem.said.append(
            f"The model's error had not settled after {REWEIGHTINGS} rounds: {before:.3g}, then "
            f"{model_error:.3g} px; all σ are about as uncertain."
        )
    return problem.result(loss, before, correction, notes)


PUPIL = 5.0
"""mm: σ of the camera's pupil when nothing is said; a drawing gives it to a few."""

FIRST_ERROR = 3.0
"""px: what the camera model is taken to leave over at first, so that no spike is refused too early."""

REWEIGHTINGS = 12
"""Most rounds in which what the camera model leaves over is estimated anew."""

_ROOM = {"place along x": 0, "place along y": 1, "orientation": 2, "size": 3}


def _with_terms(camera: Camera, distortion: int, decentring: int) -> Camera:
    """Return the camera with at least so many terms."""
    terms = {
        name: (*(old := getattr(camera, name)), *(0.0,) * (check.whole(name, n + 1) - 1 - len(old)))
        for name, n in (("distortion", distortion), ("decentring", decentring))
    }
    return replace(camera, **terms)  # type: ignore[arg-type]


def _names(camera: Camera, leds: LedMap) -> tuple[str, ...]:
    """Names of all that a calibration may estimate."""
    return (*camera.names, *(f"LED {channel} {axis}" for channel in leds.channels for axis in "xy"))


class _Rows(NamedTuple):
    """Which pose saw which LED: a row for each spike.

    Columns of a Jacobian are the camera's parameters, x and y of every LED, and x, y and heading of
    every pose.
    """

    pose: NDArray[np.intp]
    led: NDArray[np.intp]

    def points(
        self, positions: NDArray[np.float64], poses: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Optical X, Y and distance of each, shape (rows, 3)."""
        return np.asarray(optical(positions, *poses.T)[self.pose, self.led])

    def blocks(
        self, camera: Camera, positions: NDArray[np.float64], poses: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Change of the spikes with camera and LEDs, and with the pose of each, px per unit."""
        points = self.points(positions, poses)
        by_x, _, by_distance = camera.jacobian(points).T
        turned = poses[self.pose, 2]
        moved = by_pose(
            by_x, by_distance, points[:, 0], points[:, 2], np.cos(turned), np.sin(turned)
        )
        first = len(camera.names)
        common = np.zeros((len(points), first + 2 * len(positions)))
        common[:, :first] = camera.parameter_jacobian(points)
        number = np.arange(len(points))
        for axis in (0, 1):
            common[number, first + 2 * self.led + axis] = -moved[axis]
        return common, np.stack(moved, axis=1)

    def jacobian(
        self, camera: Camera, positions: NDArray[np.float64], poses: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Change of the spikes with everything, px per unit."""
        common, moved = self.blocks(camera, positions, poses)
        jacobian = np.zeros((len(common), common.shape[1] + 3 * len(poses)))
        jacobian[:, : common.shape[1]] = common
        for axis in (0, 1, 2):
            column = common.shape[1] + 3 * self.pose + axis
            jacobian[np.arange(len(common)), column] = moved[:, axis]
        return jacobian

    def by_pose(self, values: NDArray[np.float64], poses: int) -> NDArray[np.float64]:
        """Put what each row has, shape (rows, …), to its pose: (poses, most rows of one, …), else 0."""
        counts = np.bincount(self.pose, minlength=poses)
        slot = np.arange(len(self.pose)) - np.repeat(np.cumsum(counts) - counts, counts)
        table = np.zeros((len(counts), counts.max(initial=0), *values.shape[1:]))
        table[self.pose, slot] = values
        return table


class _Bundle:
    """A bundle's numbers: all of them in one vector, some held, some known about."""

    def __init__(self, observations: Sequence[Observation], leds: LedMap, camera: Camera) -> None:
        if not observations:
            raise ValueError(
                "observations: none; a bundle needs spikes from poses all over the area"
            )
        for number, seen in enumerate(observations, start=1):
            if unknown := set(seen.channels) - set(leds.channels):
                raise ValueError(
                    f"observation {number} has LED {min(unknown)}: the map has {list(leds.channels)}"
                )
        self.leds, self.camera, self.observations = leds, camera, observations
        self.said: list[str] = []
        self.rows = _Rows(
            np.repeat(np.arange(len(observations)), [len(o.channels) for o in observations]),
            np.array([leds.index(c) for o in observations for c in o.channels], dtype=int),
        )
        self.pixels = np.concatenate([np.asarray(o.pixels) for o in observations])
        self.noise = np.concatenate([np.asarray(o.sigma) for o in observations])
        self.heights = np.array([o.height for o in observations])
        self.names = (
            *_names(camera, leds),
            *(
                f"pose {n} {what}"
                for n in range(1, len(observations) + 1)
                for what in ("x", "y", "heading")
            ),
        )
        tangents = np.split(
            camera.tangent(self.pixels), np.cumsum([len(o.channels) for o in observations])
        )
        starts = [
            _start(number, seen, leds, camera, tangents[number - 1])
            for number, seen in enumerate(observations, start=1)
        ]
        self.first = len(camera.names)
        self.last = self.first + 2 * len(leds)
        self.values = np.concatenate(
            [camera.parameters, leds.positions[:, :2].ravel(), np.ravel(starts)]
        )

    def know(self, led_sigma: ArrayLike, camera_sigma: Mapping[str, float]) -> None:
        """Take what is known beforehand: a value and a σ for every number."""
        spread = np.asarray(led_sigma, dtype=float)
        if spread.shape == (len(self.leds),):
            spread = spread[:, None]
        if spread.shape not in {(), (len(self.leds), 1), (len(self.leds), 2)}:
            raise ValueError(
                f"led_sigma is one number, or has shape ({len(self.leds)},) or "
                f"({len(self.leds)}, 2), not {spread.shape}"
            )
        if unknown := set(camera_sigma) - set(self.camera.names):
            raise ValueError(
                f"camera_sigma: {', '.join(sorted(unknown))}: known are {', '.join(self.camera.names)}"
            )
        usual = {"pupil": PUPIL, "coupling": 0.0}
        of_camera = [
            camera_sigma.get(name, usual.get(name.partition("[")[0], math.inf))
            for name in self.camera.names
        ]
        poses = np.array([(o.x, o.y, o.heading) for o in self.observations])
        self.known = self.values.copy()
        self.known[self.last :] = poses[..., 0].ravel()
        self.sigma = np.concatenate(
            [
                of_camera,
                np.broadcast_to(spread, (len(self.leds), 2)).ravel(),
                poses[..., 1].ravel(),
            ]
        )
        if not (self.sigma >= 0).all():
            wrong = self.sigma[~(self.sigma >= 0)][0]
            raise ValueError(f"σ = {wrong}: allowed is 0 (held) to infinity (unknown)")
        self.free = np.flatnonzero(self.sigma > 0)
        self.prior = np.flatnonzero((self.sigma > 0) & np.isfinite(self.sigma))
        self.redundancy = len(self.pixels) + len(self.prior) - len(self.free)

    def refuse_gauge(self) -> None:
        """Refuse a room that may be moved, turned or stretched without anyone noticing."""
        unit = 1000.0  # mm; of a turn and a stretch, so that all are about as large
        pairs = np.concatenate(
            [
                self.values[self.first : self.last].reshape(-1, 2),
                self.values[self.last :].reshape(-1, 3)[:, :2],
            ]
        )
        motions = np.zeros((len(self.values), len(_ROOM)))
        is_pose = np.arange(len(self.values)) >= self.last
        kind = np.where(is_pose, (np.arange(len(self.values)) - self.last) % 3, -1)
        kind[self.first : self.last] = np.arange(self.last - self.first) % 2
        x, y = kind == 0, kind == 1
        motions[x, 0] = motions[y, 1] = 1
        motions[x, 2], motions[y, 2] = -pairs[:, 1] / unit, pairs[:, 0] / unit
        motions[kind == 2, 2] = 1
        motions[x, 3], motions[y, 3] = pairs[:, 0] / unit, pairs[:, 1] / unit
        _, strength, basis = np.linalg.svd(motions[np.isfinite(self.sigma)])
        strength = np.pad(strength, (0, len(_ROOM) - len(strength)))
        loose = basis[strength <= 1e-6 * max(strength.max(), 1.0)]
        if not len(loose):
            return
        weights = (loose**2).sum(axis=0)
        names = tuple(f"the room's {name}" for name, at in _ROOM.items() if weights[at] > 0.05)
        raise UndeterminedError(
            f"nothing fixes {', '.join(names)}: bearings alone do not. Hold two LEDs (led_sigma = 0 "
            "for them), or say how well LEDs or poses are known",
            names,
        )

    def refuse_contradiction(self) -> None:
        """Refuse signs and orders that another one explains far better.

        Over the tangents at which LEDs are from poses that are known about, spikes lie on a smooth
        curve, whatever the lens; how far from it tells a mistake before the adjustment, which would
        look for a camera that makes up for it.
        """
        told = np.array([all(math.isfinite(p.sigma) for p in (o.x, o.y, o.heading))
                         for o in self.observations])[self.rows.pose]  # fmt: skip
        if told.sum() < ENOUGH:
            return
        _, given, poses = self.state(self.values[self.free])
        order = np.argsort(given[:, 0])
        turned = np.empty_like(given)
        turned[order] = given[order[::-1]]
        cases = {
            "as given": (given, poses),
            "if headings were clockwise": (given, poses * [1, 1, -1, 1]),
            "if x of the tracker ran the other way": (given, poses * [-1, 1, 1, 1]),
            "if channels ran along the LEDs the other way": (turned, poses),
        }
        found = {case: self._curve(told, *of) for case, of in cases.items()}
        off, scale = found["as given"]
        best = min(found, key=lambda case: found[case][0])
        if off > SUSPECT and found[best][0] < off / 5:
            raise ValueError(
                f"spikes are {off:.0f} px (median) from any smooth curve over the directions that "
                f"poses and LEDs give, and {found[best][0]:.2g} px {best}"
            )
        if off < abs(scale) / 10 and scale * self.camera.scale < 0:
            raise ValueError(
                f"scale of the camera = {self.camera.scale:.0f} px, but poses, LEDs and spikes say "
                f"about {scale:+.0f}: is the line read from its other end?"
            )

    def _curve(
        self, told: NDArray[np.bool_], positions: NDArray[np.float64], poses: NDArray[np.float64]
    ) -> tuple[float, float]:
        """How far spikes are from a smooth curve over their tangents, and its slope at the axis, px."""
        x, _, distance = self.rows.points(positions, poses)[told].T
        if (distance <= 0).any():
            return math.inf, 0.0
        m = -x / distance
        rows = np.stack([m, np.ones_like(m), m**2, m**3], axis=1)
        weight = np.ones_like(m)
        for _ in range(20):  # least sum of absolute values, which gross errors do not move
            best = np.linalg.lstsq(rows * weight[:, None], self.pixels[told] * weight, rcond=None)[
                0
            ]
            off = np.abs(self.pixels[told] - rows @ best)
            weight = 1 / np.sqrt(np.maximum(off, 0.1))
        return float(np.median(off)), float(best[0])

    def state(
        self, free: NDArray[np.float64]
    ) -> tuple[Camera, NDArray[np.float64], NDArray[np.float64]]:
        """Camera, positions and poses (x, y, heading, height) for values of the free numbers."""
        values = self.values.copy()
        values[self.free] = free
        positions = self.leds.positions.copy()
        positions[:, :2] = values[self.first : self.last].reshape(-1, 2)
        poses = np.column_stack([values[self.last :].reshape(-1, 3), self.heights])
        return self.camera.with_parameters(values[: self.first]), positions, poses

    def misfit(self, free: NDArray[np.float64]) -> NDArray[np.float64]:
        """Measured minus expected spikes, px; NaN, which makes a step too long, of no camera."""
        try:
            camera, positions, poses = self.state(free)
        except ValueError:
            return np.full(len(self.pixels), math.nan)
        return np.asarray(self.pixels - camera.project(self.rows.points(positions, poses)))

    def weighted(
        self, free: NDArray[np.float64], spread: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """All residuals over their σ: of spikes, then of what is known beforehand."""
        values = self.values.copy()
        values[self.free] = free
        known = (self.known[self.prior] - values[self.prior]) / self.sigma[self.prior]
        return np.concatenate([self.misfit(free) / spread, known])

    def slopes(self, free: NDArray[np.float64], spread: NDArray[np.float64]) -> NDArray[np.float64]:
        """Jacobian of `weighted`."""
        jacobian = self.rows.jacobian(*self.state(free))[:, self.free]
        known = np.zeros((len(self.prior), len(self.free)))
        known[np.arange(len(self.prior)), np.searchsorted(self.free, self.prior)] = 1
        return -np.vstack([jacobian / spread[:, None], known / self.sigma[self.prior][:, None]])

    def solve(self, loss: Loss, model_error: float) -> None:
        """Find the minimum from where the numbers are."""
        from scipy.optimize import least_squares  # type: ignore[import-untyped]  # slow to load

        spread = np.hypot(self.noise, model_error)

        def rho(z: NDArray[np.float64]) -> NDArray[np.float64]:
            table = np.stack([z, np.ones_like(z), np.zeros_like(z)])
            table[:, : len(spread)] = _loss(loss, z[: len(spread)])
            return table

        found = least_squares(
            self.weighted,
            self.values[self.free],
            self.slopes,
            loss="linear" if loss == "linear" else rho,
            f_scale=LOSS_SCALE,
            x_scale="jac",
            ftol=1e-12,
            xtol=1e-12,
            gtol=1e-12,
            max_nfev=ITERATIONS,
            kwargs={"spread": spread},
        )
        self.values[self.free] = found.x
        self.converged = bool(found.success)

    def left_over(self, model_error: float) -> float:
        """What must be added to the spikes' σ so that residuals are as large as they should be, px.

        Half of them are to be below the median of χ² of one degree, whatever the rest are.
        """
        from scipy.optimize import brentq

        free = self.values[self.free]
        basis = np.linalg.qr(self.slopes(free, np.hypot(self.noise, model_error)))[0]
        # a spike that the fit must follow leaves no residual, whatever its error
        left = 1 - (basis[: len(self.noise)] ** 2).sum(axis=1)
        checked = left > REDUNDANT
        if not checked.any():
            return 0.0
        squares = self.misfit(free)[checked] ** 2 / left[checked]
        noise = self.noise[checked] ** 2

        def excess(error: float) -> float:
            return float(np.median(squares / (noise + error**2))) - MEDIAN_CHI2

        if excess(0.0) <= 0:
            return 0.0
        return float(brentq(excess, 0.0, 2 * math.sqrt(squares.max() / MEDIAN_CHI2), rtol=1e-3))

    def result(
        self, loss: Loss, model_error: float, correction: Correction | None, notes: str
    ) -> Calibration:
        """Return what was found, or refuse it."""
        free = self.values[self.free]
        spread = np.hypot(self.noise, model_error)
        residuals = self.misfit(free)
        jacobian = self.slopes(free, spread)
        # a residual that counts less tells less
        count = len(residuals)
        jacobian[:count] *= np.sqrt(_loss(loss, (residuals / spread / LOSS_SCALE) ** 2)[1])[:, None]
        norms = np.linalg.norm(jacobian, axis=0)
        norms[norms == 0] = 1
        lacking = max(jacobian.shape[1] - len(jacobian), 0)  # fewer numbers than are sought
        square = np.pad(jacobian / norms, ((0, lacking), (0, 0)))
        _, strength, basis = np.linalg.svd(square, full_matrices=False)
        told = strength > RANK * strength[0]
        loose = (basis[~told] ** 2).sum(axis=0)
        half = basis[told] / strength[told, None] / norms
        covariance = half.T @ half
        names = np.array(self.names)[self.free]
        flat = names[loose > 0.01 * loose.max()] if loose.size and loose.max() > 0 else names[:0]
        sigma = np.sqrt(np.diag(covariance))
        # what it would do to the spikes that depend on it
        plain = self.rows.jacobian(*self.state(free))[:, self.free]
        felt = np.sqrt((plain**2).sum(axis=0) / np.maximum((plain != 0).sum(axis=0), 1))
        unknown = np.isinf(self.sigma[self.free])
        adjusted = self.free < self.last
        weak = names[unknown & adjusted & (sigma * felt > TELLING)]
        loose_poses = any(name.startswith("pose") for name in flat.tolist())
        undetermined = tuple(
            name
            for name in names[adjusted].tolist()
            if name in flat.tolist() or name in weak.tolist()
        ) + (("poses",) if loose_poses else ())
        keep = np.flatnonzero(adjusted)
        camera, positions, poses = self.state(free)
        said = [*([notes] if notes else []), *self.said]
        for name, s, before in zip(
            names[keep], sigma[keep], self.sigma[self.free][keep], strict=True
        ):
            if s > 0.9 * before:
                said.append(
                    f"{name}: as known beforehand, ± {before:g}; the observations add little."
                )
        far = np.flatnonzero(np.abs(residuals) > OUTLIER * spread)
        said += [
            f"Observation {self.rows.pose[i] + 1}, LED {self.leds.channels[self.rows.led[i]]}: "
            f"{residuals[i]:+.3g} px, {abs(residuals[i]) / spread[i]:.0f} σ; "
            "it counts little."
            for i in far[:10]
        ]
        if len(far) > 10:
            said.append(f"So it is with {len(far) - 10} more, {len(far)} of {len(residuals)}.")
        self._refuse_misfit(np.abs(residuals), spread, model_error)
        calibration = Calibration(
            replace(camera, model_error=model_error),
            LedMap(self.leds.channels, positions, self.leds.facings),
            correction,
            tuple(names[keep].tolist()),
            covariance[np.ix_(keep, keep)],
            float(np.sqrt(np.mean(residuals**2))),
            count,
            self.redundancy,
            "\n".join(said),
        )
        implied = self._implied(calibration, poses)
        if implied:
            calibration = replace(calibration, notes="\n".join([*said, implied]))
        if undetermined:
            spreads = dict(zip(names.tolist(), sigma.tolist(), strict=True))
            values = ", ".join(
                f"{name} (± {spreads[name]:.3g})" if name in weak.tolist() else name
                for name in undetermined
            )
            raise UndeterminedError(
                f"the observations do not determine {values}. {_advice(undetermined)}",
                undetermined,
                calibration,
            )
        if not self.converged:
            raise RuntimeError(
                f"no minimum found in {ITERATIONS} steps; residuals are {calibration.rms:.3g} px RMS: "
                "are the LEDs' places and channels right?"
            )
        return calibration

    def _refuse_misfit(
        self, off: NDArray[np.float64], spread: NDArray[np.float64], model_error: float
    ) -> None:
        """Refuse what no camera makes fit, and LEDs whose spikes are nearly all gross errors."""
        if model_error > LOST:
            raise RuntimeError(
                f"no camera fits: spikes are {model_error:.0f} px from the best one; are signs and "
                "units of poses and LEDs, and the LEDs' channels right?"
            )
        gross = off > OUTLIER * spread
        wrong = []
        for row, channel in enumerate(self.leds.channels):
            own = self.rows.led == row
            if own.sum() >= 3 and gross[own].mean() >= DISOWNED:
                wrong.append(
                    f"LED {channel}: {gross[own].sum()} of {own.sum()} spikes are off, by "
                    f"{np.median(off[own]):.3g} px (median)"
                )
        if wrong:
            raise ValueError(
                f"{'; '.join(wrong)}. Were channels swapped, is the map wrong about them, or "
                "led_sigma too small?"
            )

    def _implied(self, calibration: Calibration, poses: NDArray[np.float64]) -> str:
        """Say what all that is not known does to poses such as those observed."""
        said = []
        for case, sigma_heading in (("known", 0.0), ("found", math.inf)):
            # some have too few LEDs for that
            told, covariance = calibration._pose_covariances(self.rows, poses, 1.0, sigma_heading)
            spreads = np.sqrt(np.diagonal(covariance[told], axis1=1, axis2=2))
            if len(spreads):
                x, y = np.median(spreads, axis=0)[:2]
                worst_x, worst_y = np.max(spreads, axis=0)[:2]
                said.append(
                    f"± {x:.2g} mm in x and ± {y:.2g} mm in y with a {case} heading (at worst "
                    f"{worst_x:.2g} and {worst_y:.2g})"
                )
        return f"What is left open moves poses such as these by {'; '.join(said)}." if said else ""


ENOUGH = 12
"""Spikes from poses that are known about, for signs and orders to be judged by them."""

SUSPECT = 20.0
"""px: lenses are smoother, LEDs are known better and gross errors are rarer than that."""

LOST = 100.0
"""px: a camera that leaves more than this is none of the head."""

DISOWNED = 0.8
"""Part of an LED's spikes, of three or more, that may not be gross errors."""

REDUNDANT = 0.1
"""Least part of a spike's error that must show in its residual for it to tell how large errors are."""

MEDIAN_CHI2 = 0.4549
"""Median of χ² of one degree of freedom."""

ITERATIONS = 200
"""Most steps of the minimisation."""


def _advice(undetermined: tuple[str, ...]) -> str:
    """Say what would determine these."""
    if any(name.startswith("LED") for name in undetermined):
        return "See these LEDs from more poses, farther apart, or say how well LEDs or poses are known."
    if set(undetermined) <= {"centre", "decentring[0]"}:
        return (
            "A line that is shifted shows what a turned head shows: give headings that are known, or "
            "hold one of the two (camera_sigma), which then says what heading 0 is."
        )
    return (
        "LEDs on a straight line show the same from poses that are turned and moved a little: "
        "stagger an LED by some 0.3 m toward the tracker, give poses known to a millimetre, or hold "
        "what is known (camera_sigma)."
    )


def _loss(loss: Loss, z: NDArray[np.float64]) -> NDArray[np.float64]:
    """ρ(z), ρ′ and ρ″ for squares of residuals z, shape (3, N)."""
    match loss:
        case "linear":
            return np.stack([z, np.ones_like(z), np.zeros_like(z)])
        case "huber":
            root = np.sqrt(np.maximum(z, 1.0))
            within = z <= 1
            return np.stack(
                [
                    np.where(within, z, 2 * root - 1),
                    1 / root,
                    np.where(within, 0.0, -0.5 / root**3),
                ]
            )
        case "soft_l1":
            root = np.sqrt(1 + z)
            return np.stack([2 * (root - 1), 1 / root, -0.5 / root**3])
        case "cauchy":
            return np.stack([np.log1p(z), 1 / (1 + z), -1 / (1 + z) ** 2])


def _start(
    number: int, seen: Observation, leds: LedMap, camera: Camera, tangents: NDArray[np.float64]
) -> tuple[float, float, float]:
    """A pose to begin with: what is known of it, and the rest from the spikes."""
    positions = leds.positions[[leds.index(channel) for channel in seen.channels]]
    placed = math.isfinite(seen.x.sigma) and math.isfinite(seen.y.sigma)
    turned = math.isfinite(seen.heading.sigma)
    x, y, heading = seen.x.value, seen.y.value, seen.heading.value
    if not placed:
        try:
            x, y, heading = closed_form(
                tangents, positions[:, :2], heading=heading if turned else None
            )
        except ValueError as error:
            raise ValueError(
                f"observation {number}: {error} Leave it out, or say what is known of its pose"
            ) from error
        x += camera.pupil * math.sin(heading)
        y -= camera.pupil * math.cos(heading)
    elif not turned:
        bearing = np.arctan2(positions[:, 0] - x, y - positions[:, 1])
        heading = float(np.mean(bearing - np.arctan(tangents)))
    if not (optical(positions, x, y, heading)[:, 2] + camera.pupil > 0).all():
        raise ValueError(
            f"observation {number}: from x = {x:.0f}, y = {y:.0f} mm, heading {heading:.3g} rad an "
            "LED is behind the tracker; are channels, signs and units (rad, mm) right?"
        )
    return x, y, heading
