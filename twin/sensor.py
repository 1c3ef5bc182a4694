"""What the TCD1304 and the ADC make of charge: noise, defects, inverted output, codes.

The event loop (twin/core) integrates mean charge from the real edges of SH, ICG and LED pins; here it
becomes what the ADC reads. Everything random comes from one seed.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from raytransfer import TCD1304, LineSensor
from raytransfer import _checks as check

if TYPE_CHECKING:
    from numpy.typing import NDArray

SHIELDED = slice(16, 29)
"""Elements D16 to D28: light-shielded pixels."""


@dataclass(frozen=True)
class Electronics:
    """Figures of sensor, output stage and ADC at 25 °C.

    Parameters
    ----------
    full_well : float
        Electrons that reach the output at saturation. Makers of open boards quote 40,000 to
        90,000. As one SH pulse moves only `transfer_fraction` of it, a pixel holds more.
    transfer_fraction : float
        Part of a pixel's charge that one SH pulse moves; the rest is image lag. Measured on such
        boards: 0.44 to 0.54.
    read_noise : float
        Electrons, rms. Makers of open boards: 28 to 60.
    dark_rate, dark_spread : float
        Mean dark signal in electrons/s (datasheet: 2 mV of 600 mV in 10 ms) and its relative
        standard deviation from pixel to pixel.
    response_spread : float
        Relative standard deviation of the pixels' response; the datasheet's PRNU ≤ 10 % is the
        extreme of all pixels.
    register_imbalance : float
        Relative difference of the gains of odd and even pixels; datasheet ≤ 3 %.
    odd_even_offset : float
        Difference of their dark levels, V; real captures show about 1 count.
    dark_voltage, swing : float
        At the ADC's pin: without light, and how far saturation lowers it, V. Real captures have
        3915 to 3930 counts without light; makers of boards quote 1.5 V saturated.
    adc_reference : float
        V.
    adc_bits : int
    """

    full_well: float = 60_000.0
    transfer_fraction: float = 0.5
    read_noise: float = 40.0
    dark_rate: float = 20_000.0
    dark_spread: float = 0.3
    response_spread: float = 0.015
    register_imbalance: float = 0.01
    odd_even_offset: float = 0.0008
    dark_voltage: float = 3.16
    swing: float = 1.66
    adc_reference: float = 3.3
    adc_bits: int = 12

    def __post_init__(self) -> None:
        for name in ("full_well", "dark_voltage", "swing", "adc_reference"):
            check.positive(name, getattr(self, name))
        for name in (
            *("read_noise", "dark_rate", "dark_spread"),
            *("response_spread", "register_imbalance", "odd_even_offset"),
        ):
            check.not_negative(name, getattr(self, name))
        if not 0 < self.transfer_fraction <= 1:
            raise ValueError(f"transfer_fraction = {self.transfer_fraction:g}: allowed is > 0 to 1")

    @property
    def max_code(self) -> int:
        """Largest code of the ADC."""
        return (1 << self.adc_bits) - 1

    def code(self, voltage: NDArray[np.float64]) -> NDArray[np.uint16]:
        """ADC code of voltages at its pin."""
        codes = np.rint(voltage / self.adc_reference * (1 << self.adc_bits))
        return np.clip(codes, 0, self.max_code).astype(np.uint16)


class SensorModel:
    """One specimen of the sensor: its fixed pattern, and the noise of its read-outs.

    Parameters
    ----------
    seed : int
        Two models of the same seed are the same specimen and draw the same noise.
    electronics : Electronics
    sensor : LineSensor
    """

    def __init__(
        self,
        seed: int = 1304,
        electronics: Electronics | None = None,
        sensor: LineSensor = TCD1304,
    ) -> None:
        if seed < 0:
            raise ValueError(f"seed = {seed!r}: allowed are whole numbers from 0 on")
        electronics = Electronics() if electronics is None else electronics
        self.electronics = electronics
        self.sensor = sensor
        pattern, self._noise = (
            np.random.Generator(np.random.Philox(child))
            for child in np.random.SeedSequence(seed).spawn(2)
        )
        odd = np.arange(sensor.pixels) % 2 == 0  # S1 is the first odd pixel
        self.response = 1 + electronics.response_spread * pattern.standard_normal(sensor.pixels)
        self.response *= 1 + electronics.register_imbalance * np.where(odd, 0.5, -0.5)
        # a lognormal: no pixel has negative dark current, a few are hot
        spread = np.sqrt(np.log1p(electronics.dark_spread**2))
        normal = pattern.standard_normal(sensor.elements)
        self._dark = electronics.dark_rate * np.exp(spread * normal - spread**2 / 2)
        self._offset = np.where(np.arange(sensor.elements) % 2, 0.5, -0.5)
        self._offset *= electronics.odd_even_offset

    @property
    def _line(self) -> slice:
        first = self.sensor.leading_elements or 0
        return slice(first, first + self.sensor.pixels)

    def dark_rates(self) -> NDArray[np.float64]:
        """Dark signal of every pixel, electrons/s, shape (pixels,)."""
        return np.asarray(self._dark[self._line])

    def digitise(
        self, charge: NDArray[np.float64], dark_seconds: float
    ) -> tuple[NDArray[np.uint16], int]:
        """Codes of one read-out.

        Parameters
        ----------
        charge : ndarray, shape (pixels,)
            Mean electrons moved from each pixel to the register, dark signal included.
        dark_seconds : float
            The time for which they gathered it: what the light-shielded pixels hold is their dark
            rate times this.

        Returns
        -------
        codes : ndarray of uint16, shape (elements,)
        idle : int
            Code between read-outs, without the noise.
        """
        electronics = self.electronics
        mean = np.zeros(self.sensor.elements)
        mean[self._line] = charge
        mean[SHIELDED] = self._dark[SHIELDED] * dark_seconds
        # a Poisson number split at random is two Poisson numbers: what stays behind in the pixel
        # has noise of its own, so means are enough to remember between read-outs
        electrons = self._noise.poisson(mean).astype(float)
        np.minimum(electrons, electronics.full_well, out=electrons)
        electrons += electronics.read_noise * self._noise.standard_normal(len(mean))
        voltage = electronics.dark_voltage + self._offset
        voltage -= electrons * (electronics.swing / electronics.full_well)
        idle = electronics.code(np.array([electronics.dark_voltage]))
        return electronics.code(voltage), int(idle[0])
