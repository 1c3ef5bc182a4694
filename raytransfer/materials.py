"""Refractive indices: constant, or with dispersion by Sellmeier's formula.

`MATERIALS` maps names to materials and is read from ``data/materials.toml``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from types import MappingProxyType

from raytransfer import _checks as check
from raytransfer._data import FOLDER, read

D_LINE = 0.5875618
"""Wavelength in µm of the helium d line, at which catalogues state indices and focal lengths."""


@dataclass(frozen=True)
class ConstantIndex:
    """A medium with one refractive index for all wavelengths."""

    name: str
    n: float

    def __post_init__(self) -> None:
        check.refractive_index(f"index of {self.name}", self.n)

    def index(self, wavelength: float = D_LINE) -> float:
        """Refractive index; the wavelength (µm) is only checked."""
        check.positive("wavelength", wavelength, "wavelengths are in µm")
        return self.n


@dataclass(frozen=True)
class Sellmeier:
    """A glass with dispersion: n² − 1 = Σ B λ² / (λ² − C).

    Parameters
    ----------
    name : str
    B : tuple of float
        Strengths, dimensionless.
    C : tuple of float
        Squared resonance wavelengths, µm².
    valid : tuple of float
        Shortest and longest wavelength of the fit, µm.
    """

    name: str
    B: tuple[float, ...]
    C: tuple[float, ...]
    valid: tuple[float, float]

    def index(self, wavelength: float = D_LINE) -> float:
        """Refractive index at a wavelength in µm; `ValueError` outside the range of the fit."""
        square = check.positive("wavelength", wavelength, "wavelengths are in µm") ** 2
        low, high = self.valid
        if not low <= wavelength <= high:
            raise ValueError(
                f"wavelength = {wavelength:g} µm: {self.name} is known from {low:g} to {high:g} µm; "
                "was it given in nm?"
            )
        terms = (b * square / (square - c) for b, c in zip(self.B, self.C, strict=True))
        return math.sqrt(1 + sum(terms))


Material = ConstantIndex | Sellmeier


def _materials() -> dict[str, Material]:
    result: dict[str, Material] = {}
    for name, entry in read(FOLDER / "materials.toml").items():
        if "constant" in entry:
            result[name] = ConstantIndex(name, entry["constant"])
        else:
            low, high = entry["valid"]
            result[name] = Sellmeier(name, tuple(entry["B"]), tuple(entry["C"]), (low, high))
    return result


MATERIALS = MappingProxyType(_materials())
"""Materials by name."""
