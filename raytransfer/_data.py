"""The package's data files: lenses, materials, sensors, the plots' style."""

from __future__ import annotations

import tomllib
from importlib.resources import files
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from importlib.resources.abc import Traversable

FOLDER = files("raytransfer") / "data"


def read(file: Traversable) -> dict[str, Any]:
    """Return what a TOML file of the package says."""
    return tomllib.loads(file.read_text(encoding="utf-8"))
