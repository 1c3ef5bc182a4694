"""Cameras of the designs that come along, fitted beforehand: that takes some seconds each.

``python -m tracking.nominal`` fits them again, after a change of a design, the tracer or the finder of
spikes; a test compares.
"""

from __future__ import annotations

import json
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING

from raytransfer.designs import DESIGNS
from tracking.camera import Camera

if TYPE_CHECKING:
    from raytransfer.designs import Design

_FILE = files("tracking") / "data" / "cameras.json"


def nominal_camera(design: Design) -> Camera:
    """Return the camera that the drawing of a head says, of one of `DESIGNS` at once.

    It is that of `Camera.from_system` with all that it takes left out.

    Parameters
    ----------
    design : Design
    """
    for name, known in DESIGNS.items():
        if (known.system, known.sensor) == (design.system, design.sensor):
            return Camera.from_dict(json.loads(_FILE.read_text(encoding="utf-8"))[name])
    return Camera.from_system(design.system, design.sensor)


def main() -> None:
    """Fit all of them, and write the package's file."""
    cameras = {
        name: Camera.from_system(design.system, design.sensor).to_dict()
        for name, design in DESIGNS.items()
    }
    text = json.dumps(cameras, indent=1) + "\n"
    Path(str(_FILE)).write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
