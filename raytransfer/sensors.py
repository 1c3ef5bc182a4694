"""Line sensors as data: every file in ``data/sensors`` is one entry of `SENSORS`."""

from __future__ import annotations

from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from raytransfer import _checks as check
from raytransfer._data import FOLDER, read
from raytransfer.lenses import Plate
from raytransfer.materials import MATERIALS

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray


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
    """

    name: str
    pixels: int
    pitch: float
    pixel_height: float
    leading_elements: int | None = None
    trailing_elements: int | None = None
    window: Plate | None = None
    top_to_chip: float | None = None

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
    return LineSensor(**entry)


SENSORS = MappingProxyType(_sensors())
"""Line sensors by name."""

TCD1304 = SENSORS["TCD1304"]
"""The thesis's sensor: 3648 pixels of 8 µm."""
