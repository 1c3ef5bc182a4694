"""The same descriptions by another kernel: OpenCASCADE and manifold3d agree; STEP and drawing."""

from __future__ import annotations

import math
import os
import re
import subprocess
import sys
from dataclasses import replace
from importlib.util import find_spec
from typing import TYPE_CHECKING

import pytest

from hardware import brep, mesh
from hardware.mount import lens_mount
from hardware.solids import (
    Box,
    Cylinder,
    Difference,
    Intersection,
    Lathe,
    Placed,
    Prism,
    Solid,
    Union,
    frustum,
)
from hardware.stand import led_mount, stand
from raytransfer.designs import DESIGNS

if TYPE_CHECKING:
    from pathlib import Path

HALF = Difference(Box((0, 0, 0), (6, 5, 4)), (Cylinder("y", (3.0, 2.0), -1.0, 6.0, 3.0),))
OUTLINE = ((0.0, 0.0), (4.0, 0.0), (4.0, 1.0), (1.0, 1.0), (1.0, 3.0), (0.0, 3.0))


@pytest.fixture(autouse=True)
def _kernel() -> None:
    """Skip without build123d; in CI it has to be there."""
    if find_spec("build123d") is None:
        if os.environ.get("CI"):
            pytest.fail("build123d is missing, and this is CI")
        pytest.skip("build123d is not installed: pip install linetrack[cad]")


@pytest.mark.parametrize(
    "solid",
    [
        Box((-1, -2, -3), (4, 5, 6)),
        *(Prism(axis, OUTLINE, -1.0, 4.0) for axis in ("x", "y", "z")),
        *(Prism(axis, OUTLINE[::-1], -1.0, 4.0) for axis in ("x", "y", "z")),
        HALF,
        Union((HALF, Box((4, 4, 3), (9, 9, 9)))),
        Intersection((HALF, Box((1, 1, 1), (9, 9, 9)))),
        Placed(HALF, (1.0, -2.0, 3.0), "x", 1),
        Placed(HALF, (1.0, -2.0, 3.0), "y", 3),
        Placed(HALF, (0.0, 0.0, 3.0), "z", 2),
        Lathe(((0.0, 0.0), (3.0, 0.0), (0.0, 4.0))),
        frustum(1.0, (2.0, 3.0), 4.0, (1.0, 1.0)),
    ],
)
def test_kernels_agree(solid: Solid) -> None:
    """In volume, but for corners on circles (0.16 % of a whole one), and in place."""
    assert brep.volume(solid) == pytest.approx(mesh.volume(solid), rel=2e-3)
    box = brep.shape(solid).bounding_box()
    low, high = mesh.bounds(solid)
    assert [*box.min, *box.max] == pytest.approx([*low, *high], abs=1e-3)


@pytest.mark.parametrize("axis", ["x", "y", "z"])
def test_cylinders_are_round(axis: str) -> None:
    bar = Cylinder(axis, (1.0, -2.0), -3.0, 5.0, 6.0)  # type: ignore[arg-type]
    assert brep.volume(bar) == pytest.approx(math.pi * 9 * 8, rel=1e-9)


@pytest.mark.parametrize("name", DESIGNS)
def test_kernels_agree_on_mounts(name: str) -> None:
    mount = lens_mount(DESIGNS[name].system)
    for solid in (*mount.halves.values(), *(lens.glass for lens in mount.lenses)):
        assert brep.volume(solid) == pytest.approx(mesh.volume(solid), rel=1e-3)
    box = brep.shape(Union((mount.lower, mount.upper))).bounding_box()
    assert [*box.size] == pytest.approx(mount.size, abs=0.05)


def test_kernels_agree_on_what_stands_around() -> None:
    parts = stand(lens_mount(DESIGNS["thesis"].system)).parts
    for solid in (*parts.values(), led_mount().solid):
        assert brep.volume(solid) == pytest.approx(mesh.volume(solid), rel=1e-3)


def test_step_reads_back_with_names(tmp_path: Path) -> None:
    import build123d

    mount = lens_mount(DESIGNS["thesis"].system)
    path = brep.write_step(mount.halves, tmp_path / "mount.step")
    text = path.read_text()
    assert "'lower'" in text
    assert "'upper'" in text
    read = build123d.import_step(path)
    assert len(read.solids()) == 2
    assert read.volume == pytest.approx(2 * mesh.volume(mount.lower), rel=1e-3)
    assert [*read.bounding_box().size] == pytest.approx(mount.size, abs=0.05)


def test_drawing_is_true_to_scale(tmp_path: Path) -> None:
    """Three views side by side, each as large as the part, with margins and gaps between."""
    bar = Box((0, 0, 0), (10, 20, 30))
    text = brep.write_drawing({"bar": bar}, tmp_path / "bar.svg").read_text()
    width, height = (float(v) for v in re.findall(r'(?:width|height)="([\d.]+)mm"', text)[:2])
    assert width == pytest.approx(10 + 30 + 15 + 2 * 5, abs=0.5)
    assert height == pytest.approx(20 + 30 + 15 + 2 * 5, abs=0.5)
    x = [float(v) for v in re.findall(r'x[12]="([-\d.]+)"', text)]
    assert sorted({round(v, 3) for v in x}) == pytest.approx([-5, 5, 20, 50])


def test_a_folder_that_is_not_there(tmp_path: Path) -> None:
    for write in (brep.write_step, brep.write_drawing):
        with pytest.raises(FileNotFoundError, match="make it first"):
            write({"half": HALF}, tmp_path / "no" / "file")


def test_build123d_is_only_loaded_when_asked_for() -> None:
    code = "import sys, hardware.brep, hardware.checks; assert 'build123d' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_without_build123d_the_message_says_what_to_install(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(sys.modules, "build123d", None)
    with pytest.raises(ModuleNotFoundError, match=r"pip install linetrack\[cad\]"):
        brep.volume(replace(HALF))
