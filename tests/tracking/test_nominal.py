"""Cameras that come along are those that their designs give today."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from raytransfer.designs import DESIGNS, Design
from tracking.camera import Camera
from tracking.nominal import nominal_camera


@pytest.mark.parametrize("name", DESIGNS)
def test_a_camera_that_comes_along_is_up_to_date(name: str) -> None:
    """Over the field; else: python -m tracking.nominal. Processors' rounding moves a fit by 6e-6 px."""
    design = DESIGNS[name]
    kept, fitted = nominal_camera(design), Camera.from_system(design.system, design.sensor)
    distance, tangent, rise = np.meshgrid(
        [1000.0, 2000.0, 4150.0], np.linspace(-0.45, 0.45, 91), [0.0, 0.1, kept.elevation]
    )
    points = np.stack([tangent * distance, rise * distance, distance], axis=-1)
    there = kept.sees(points)
    assert there.sum() > 500
    assert np.abs(kept.project(points) - fitted.project(points))[there].max() < 1e-4
    assert kept.model_error == pytest.approx(fitted.model_error, rel=1e-6)
    assert kept.elevation == fitted.elevation


def test_cameras_that_come_along_are_not_fitted(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a design that a session describes neither; of another head they are."""
    asked = []
    monkeypatch.setattr(
        Camera, "from_system", lambda system, sensor: asked.append((system, sensor))
    )
    for design in DESIGNS.values():
        assert isinstance(nominal_camera(replace(design, notes="as the session has it")), Camera)
    assert not asked
    thesis = DESIGNS["thesis"]
    assert thesis.system.sensor_distance != 3.0
    nearer = replace(thesis.system, sensor_distance=3.0)
    nominal_camera(Design(nearer, thesis.sensor))
    assert asked == [(nearer, thesis.sensor)]
