"""Line sensors as data: every file in ``data/sensors`` is one entry of `SENSORS`."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np

from raytransfer import _checks as check
from raytransfer._data import FOLDER, read
from raytransfer.lenses import Plate
from raytransfer.materials import MATERIALS

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray


@dataclass(frozen=True)
class SpectralResponse:
    """How many electrons a photon leaves in a pixel.

    Parameters
    ----------
    wavelengths : tuple of float
        µm, rising.
    relative : tuple of float
        Response to equal power there, relative to its largest value.
    peak_quantum_efficiency : float
        Electrons per photon at the wavelength of the largest response, 0 to 1.
    """

    wavelengths: tuple[float, ...]
    relative: tuple[float, ...]
    peak_quantum_efficiency: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "wavelengths", tuple(self.wavelengths))
        object.__setattr__(self, "relative", tuple(self.relative))
        if len(self.wavelengths) != len(self.relative) or len(self.wavelengths) < 2:
            raise ValueError("a response needs as many relative values as wavelengths, 2 or more")
        if any(b <= a for a, b in pairwise(self.wavelengths)):
            raise ValueError(f"wavelengths of a response rise; {self.wavelengths} do not")
        if not 0 < check.number("peak_quantum_efficiency", self.peak_quantum_efficiency) <= 1:
            raise ValueError(
                f"peak_quantum_efficiency = {self.peak_quantum_efficiency:g}: allowed is > 0 to 1; "
                "was it given in percent?"
            )

    def quantum_efficiency(self, wavelength: ArrayLike) -> NDArray[Any]:
        """Electrons per photon at wavelengths in µm; 0 outside the charted ones."""
        wavelength = check.array("wavelength", wavelength)
        relative = np.interp(wavelength, self.wavelengths, self.relative, left=0.0, right=0.0)
        peak = self.wavelengths[int(np.argmax(self.relative))]
        # the chart is per power: a shorter wave brings fewer photons
        efficiency = self.peak_quantum_efficiency * relative * peak / wavelength
        return np.asarray(efficiency)


@dataclass(frozen=True)
class LineSensor:
    """One row of pixels.

    Parameters
    ----------
    name : str
    pixels : int
        Pixels that see light, numbered from 0.
    pitch, pixel_height : float
        Pixel size along and across the line, mm.
    leading_elements, trailing_elements : int, optional
        What the sensor puts out before and after the pixels; None if unknown.
    window : Plate, optional
        The glass over the chip; None if unknown.
    top_to_chip : float, optional
        From the window's outer face to the pixels, mm.
    response : SpectralResponse, optional
        None if unknown.
    """

    name: str
    pixels: int
    pitch: float
    pixel_height: float
    leading_elements: int | None = None
    trailing_elements: int | None = None
    window: Plate | None = None
    top_to_chip: float | None = None
    response: SpectralResponse | None = None

    def __post_init__(self) -> None:
        check.whole(f"pixels of {self.name}", self.pixels)
        for name in ("pitch", "pixel_height"):
            check.positive(f"{name} of {self.name}", getattr(self, name))
        if (self.window is None) != (self.top_to_chip is None):
            raise ValueError(f"{self.name}: give window and top_to_chip both, or neither")
        if self.window is None or self.top_to_chip is None:
            return
        if check.number(f"top_to_chip of {self.name}", self.top_to_chip) < self.window.thickness:
            raise ValueError(
                f"top_to_chip of {self.name} = {self.top_to_chip:g} mm: it includes the window, "
                f"{self.window.thickness:g} mm; was only the air below it given?"
            )

    @property
    def length(self) -> float:
        """Length of the pixel line, mm."""
        return self.pixels * self.pitch

    @property
    def elements(self) -> int:
        """Elements put out in one read-out; `ValueError` if the data file does not say."""
        if self.leading_elements is None or self.trailing_elements is None:
            raise ValueError(f"{self.name}: its data file does not give the elements around pixels")
        return self.leading_elements + self.pixels + self.trailing_elements

    def position(self, pixel: ArrayLike) -> NDArray[Any]:
        """Position on the line in mm, 0 in the middle, of (fractional) pixel numbers from 0."""
        return (check.array("pixel", pixel) - (self.pixels - 1) / 2) * self.pitch

    def pixel(self, position: ArrayLike) -> NDArray[Any]:
        """Return the fractional pixel number at a position in mm; beyond the ends it goes on."""
        return check.array("position", position) / self.pitch + (self.pixels - 1) / 2


def _sensors() -> dict[str, LineSensor]:
    result: dict[str, LineSensor] = {}
    for file in sorted((FOLDER / "sensors").iterdir(), key=lambda file: file.name):
        if not file.name.endswith(".toml"):
            continue
        try:
            sensor = _sensor(read(file))
        except (KeyError, TypeError, ValueError) as error:
            raise ValueError(
                f"{file.name}: {error} (see tcd1304.toml for what is needed)"
            ) from error
        if sensor.name in result:
            raise ValueError(f"{file.name}: there is a sensor named {sensor.name} already")
        result[sensor.name] = sensor
    return result


def _sensor(entry: dict[str, Any]) -> LineSensor:
    window = entry.pop("window", None)
    if window is not None:
        entry["top_to_chip"] = window["top_to_chip"]
        material = MATERIALS[window["material"]]
        entry["window"] = Plate(f"{entry['name']} window", window["thickness"], material)
    if "response" in entry:
        entry["response"] = SpectralResponse(**entry["response"])
    return LineSensor(**entry)


SENSORS = MappingProxyType(_sensors())
"""Line sensors by name."""

TCD1304 = SENSORS["TCD1304"]
"""The thesis's sensor: 3648 pixels of 8 µm."""
