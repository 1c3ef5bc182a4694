"""Light through lenses onto a line sensor: paraxial matrices, lens systems, the design studies.

The thesis's vocabulary works with numbers (numpy) and with symbols (sympy) alike. Plots are in
`raytransfer.plots`, the interactive explorer in `raytransfer.explorer`; neither is loaded before it
is asked for.
"""

from __future__ import annotations

from typing import Any

from raytransfer.casting import cast_rays, cast_rays_to_focal_length
from raytransfer.lenses import CATALOGUE, THESIS_LENSES, Aperture, Lens, Plate, SphericalLens
from raytransfer.materials import MATERIALS, ConstantIndex, Sellmeier
from raytransfer.matrices import RayMatrix, flat_mat, input_vec, refract_mat, trans_mat
from raytransfer.sensors import SENSORS, TCD1304, LineSensor
from raytransfer.systems import (
    CardinalPoints,
    OpticalSystem,
    Placement,
    collimating_pair,
    prototype_head,
    telecentric_pair,
)

__version__ = "0.1.0"

__all__ = [
    "CATALOGUE",
    "MATERIALS",
    "SENSORS",
    "TCD1304",
    "THESIS_LENSES",
    "Aperture",
    "CardinalPoints",
    "ConstantIndex",
    "Lens",
    "LineSensor",
    "OpticalSystem",
    "Placement",
    "Plate",
    "RayMatrix",
    "Sellmeier",
    "SphericalLens",
    "cast_rays",
    "cast_rays_to_focal_length",
    "collimating_pair",
    "flat_mat",
    "input_vec",
    "plot_ray_cast",
    "prototype_head",
    "refract_mat",
    "telecentric_pair",
    "trans_mat",
]


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


def __getattr__(name: str) -> Any:
    if name == "plot_ray_cast":
        from raytransfer.plots import plot_ray_cast  # loads matplotlib

        return plot_ray_cast
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
