"""Surfaces: circles by Pythagoras, the equation they promise, openings with their edges."""

from __future__ import annotations

import math
from dataclasses import FrozenInstanceError
from typing import Any, Literal

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from raytransfer.surfaces import Surface

BENDS: list[Literal["x", "y", "xy"]] = ["x", "y", "xy"]


@pytest.mark.parametrize("bends", BENDS)
@pytest.mark.parametrize("radius", [31.0, -31.0, 10.3])
def test_sag_is_a_circle(bends: str, radius: float) -> None:
    """Pythagoras about the centre of curvature, in all the meridians it bends."""
    surface = Surface(curvature=1 / radius, bends=bends)  # type: ignore[arg-type]
    x, y = np.random.default_rng(1).uniform(-7, 7, (2, 50))
    square = (x**2 if "x" in bends else 0) + (y**2 if "y" in bends else 0)
    depth = abs(radius) - np.sqrt(radius**2 - square)
    assert_allclose(surface.sag(x, y), math.copysign(1, radius) * depth, rtol=1e-13, atol=1e-14)


@settings(deadline=None)
@given(
    st.sampled_from(BENDS),
    st.floats(0.5, 1e4),
    st.booleans(),
    st.floats(-0.7, 0.7),
    st.floats(-0.7, 0.7),
)
def test_its_points_satisfy_its_equation(
    bends: Literal["x", "y", "xy"], radius: float, hollow: bool, across: float, up: float
) -> None:
    c = (-1 if hollow else 1) / radius
    surface = Surface(curvature=c, bends=bends)
    x, y = across * radius, up * radius
    z = float(surface.sag(x, y))
    left = c * (surface.ax * x**2 + surface.ay * y**2 + z**2)
    assert left == pytest.approx(2 * z, rel=1e-12, abs=1e-300)
    assert z * radius * (-1 if hollow else 1) >= 0
    assert abs(z) < radius  # the half with the vertex


def test_a_shallow_sag_keeps_its_digits() -> None:
    """R − √(R² − x²) would be 0 here."""
    assert float(Surface(curvature=1e-9, bends="x").sag(1.0, 0.0)) == pytest.approx(
        5e-10, rel=1e-15
    )


def test_a_plane_and_a_screen_have_no_sag() -> None:
    x = np.array([-1e6, 0, 1e6])
    assert_array_equal(Surface(z=3.0).sag(x, x), 0)
    assert_array_equal(Surface(screen=True).sag(x, x), 0)


@pytest.mark.parametrize("bends", BENDS)
def test_there_is_no_sag_beside_its_end(bends: Literal["x", "y", "xy"]) -> None:
    surface = Surface(curvature=-0.1, bends=bends)
    at = (10.001, 0.0) if "x" in bends else (0.0, 10.001)
    assert math.isnan(surface.sag(*at))
    assert float(surface.sag(at[1], at[0])) == 0 or bends == "xy"


@pytest.mark.parametrize("sign", [1, -1])
def test_a_half_cylinder_is_as_deep_as_its_radius_whatever_is_rounded(sign: int) -> None:
    """1/R × 1/R × R² may be more than 1 by a bit; that is the end, not beside it."""
    radii = np.arange(1, 2000) / 16
    ends = [Surface(curvature=sign / r, bends="x").sag(r, 0.0) for r in radii]
    assert_allclose(ends, sign * radii, rtol=1e-12)


def test_depth_is_the_sag_at_the_edge() -> None:
    cylinder = Surface(curvature=1 / 31, bends="x")
    assert cylinder.depth((15.0, 16.0)) == float(cylinder.sag(15.0, 0.0))
    assert Surface(curvature=1 / 31, bends="y").depth((16.0, 15.0)) == cylinder.depth((15.0, 16.0))
    ball = Surface(curvature=-1 / 16, bends="xy", round=True)
    # the corner of the square around it is beyond the sphere
    assert ball.depth((15.0, 15.0)) == pytest.approx(-(16 - math.sqrt(16**2 - 15**2)), rel=1e-14)
    assert Surface().depth((math.inf, math.inf)) == 0
    assert cylinder.depth((15.0, math.inf)) == cylinder.depth((15.0, 16.0))


def test_a_rectangular_opening_ends_with_its_edge() -> None:
    surface = Surface(half=(2.0, 3.0))
    beyond = np.nextafter([2.0, 3.0], 9)
    x = [0, 2, -2, 2, beyond[0], -beyond[0], 0]
    y = [0, 3, -3, -3, 0, 0, beyond[1]]
    assert_array_equal(surface.opens(x, y), [True, True, True, True, False, False, False])


def test_a_round_opening_has_no_corners() -> None:
    surface = Surface(half=(5.0, 5.0), round=True)
    x, y = [5, 3, -3, 0, 3.6, 4.9], [0, 4, -4, -5, 3.6, 4.9]
    assert_array_equal(surface.opens(x, y), [True, True, True, True, False, False])


def test_without_an_edge_everything_passes() -> None:
    assert Surface().opens(1e300, -1e300)
    assert not Surface(half=(1.0, math.inf)).opens(1.5, 0)
    assert Surface(half=(1.0, math.inf)).opens(0.5, 1e300)


def test_surfaces_are_values() -> None:
    surface: Any = Surface(1.0, 0.1, "x")
    assert surface == Surface(1.0, 0.1, "x")
    assert (surface.ax, surface.ay) == (1.0, 0.0)
    assert (Surface(bends="xy").ax, Surface(bends="xy").ay) == (1.0, 1.0)
    assert (Surface().ax, Surface().ay) == (0.0, 0.0)
    with pytest.raises(FrozenInstanceError):
        surface.z = 2.0
