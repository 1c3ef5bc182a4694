"""Refractive indices against the catalogues' values."""

from __future__ import annotations

import math
from dataclasses import FrozenInstanceError
from typing import Any

import pytest

from raytransfer import MATERIALS, ConstantIndex, Sellmeier
from raytransfer.materials import D_LINE

F_LINE, C_LINE = 0.4861327, 0.6562725
GLASSES = ["N-BK7", "N-SF11", "fused silica", "CaF2"]


@pytest.mark.parametrize(
    ("name", "n_d"),
    [("N-BK7", 1.51680), ("N-SF11", 1.78472), ("fused silica", 1.45846), ("CaF2", 1.43384)],
)
def test_index_at_the_d_line(name: str, n_d: float) -> None:
    assert MATERIALS[name].index() == pytest.approx(n_d, abs=2e-5)
    assert MATERIALS[name].index(D_LINE) == MATERIALS[name].index()


@pytest.mark.parametrize(
    ("name", "number"), [("N-BK7", 64.17), ("N-SF11", 25.68), ("fused silica", 67.82)]
)
def test_abbe_number(name: str, number: float) -> None:
    index = MATERIALS[name].index
    assert (index() - 1) / (index(F_LINE) - index(C_LINE)) == pytest.approx(number, abs=0.05)


def test_crown_glass_at_other_lines() -> None:
    assert MATERIALS["N-BK7"].index(F_LINE) == pytest.approx(1.52238, abs=2e-5)
    assert MATERIALS["N-BK7"].index(C_LINE) == pytest.approx(1.51432, abs=2e-5)


@pytest.mark.parametrize("name", GLASSES)
def test_blue_is_refracted_more_than_red(name: str) -> None:
    index = MATERIALS[name].index
    wavelengths = [0.40, 0.45, 0.50, 0.55, 0.60, 0.65, 0.70]
    values = [index(wavelength) for wavelength in wavelengths]
    assert values == sorted(values, reverse=True)
    assert len(set(values)) == len(values)


def test_one_term_of_sellmeier_by_hand() -> None:
    glass = Sellmeier("by hand", B=(1.25,), C=(0.01,), valid=(0.3, 2.0))
    assert glass.index(0.5) == pytest.approx(math.sqrt(1 + 1.25 * 0.25 / 0.24), rel=1e-15)


@pytest.mark.parametrize(
    ("name", "n"), [("air", 1.0), ("thesis glass", 1.52), ("sensor window", 1.5)]
)
@pytest.mark.parametrize("wavelength", [0.2, D_LINE, 10.0])
def test_constant_indices(name: str, n: float, wavelength: float) -> None:
    assert MATERIALS[name].index(wavelength) == n


@pytest.mark.parametrize("name", GLASSES)
@pytest.mark.parametrize("wavelength", [587.5618, 850, 0.1, 12])
def test_wavelengths_outside_the_fit_are_refused(name: str, wavelength: float) -> None:
    with pytest.raises(ValueError, match="given in nm") as refusal:
        MATERIALS[name].index(wavelength)
    assert f"wavelength = {wavelength:g} µm" in str(refusal.value)
    assert name in str(refusal.value)


@pytest.mark.parametrize("name", GLASSES)
def test_the_ends_of_the_fit_are_allowed(name: str) -> None:
    material = MATERIALS[name]
    assert isinstance(material, Sellmeier)
    low, high = material.valid
    assert material.index(low) > material.index(high) > 1
    for beyond in (math.nextafter(low, 0), math.nextafter(high, 99)):
        with pytest.raises(ValueError, match="wavelength"):
            material.index(beyond)


@pytest.mark.parametrize("name", ["N-BK7", "air"])
@pytest.mark.parametrize("bad", [0, -0.5, math.nan, math.inf])
def test_wavelengths_that_are_not_positive_are_refused(name: str, bad: float) -> None:
    with pytest.raises(ValueError, match=f"^wavelength = {bad:g}: .*µm"):
        MATERIALS[name].index(bad)


@pytest.mark.parametrize("name", ["N-BK7", "air"])
@pytest.mark.parametrize("bad", [True, "0.5", 1j, None, [0.5]])
def test_wavelengths_that_are_not_numbers_are_refused(name: str, bad: Any) -> None:
    with pytest.raises(TypeError) as refusal:
        MATERIALS[name].index(bad)
    assert str(refusal.value).startswith(f"wavelength = {bad!r}:")


@pytest.mark.parametrize("bad", [0.9, 0, -1.5, math.nan, math.inf])
def test_a_constant_index_below_1_is_refused(bad: float) -> None:
    with pytest.raises(ValueError, match=f"index of jelly = {bad:g}:"):
        ConstantIndex("jelly", bad)


def test_materials_are_read_only() -> None:
    materials: Any = MATERIALS
    with pytest.raises(TypeError):
        materials["N-BK7"] = ConstantIndex("N-BK7", 1.0)
    crown: Any = MATERIALS["N-BK7"]
    with pytest.raises(FrozenInstanceError):
        crown.B = (0.0,)
    assert all(material.name == name for name, material in MATERIALS.items())
