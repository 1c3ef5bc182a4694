"""Solids as exact surfaces: OpenCASCADE through build123d, for STEP files and drawings.

build123d is large and only needed here: ``pip install linetrack[cad]``.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from hardware.solids import (
    ACROSS,
    Box,
    Cylinder,
    Difference,
    Intersection,
    Lathe,
    Placed,
    Prism,
    Solid,
    Union,
)

if TYPE_CHECKING:
    import os
    from collections.abc import Mapping

_DIRECTIONS = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}


def shape(solid: Solid) -> Any:
    """Evaluate a description with build123d.

    Raises
    ------
    ModuleNotFoundError
        If build123d is not installed; the message says what to install.
    """
    cad = _kernel()
    match solid:
        case Box():
            size = [high - low for low, high in zip(solid.low, solid.high, strict=True)]
            return cad.Solid.make_box(*size, cad.Plane(origin=solid.low))
        case Cylinder():
            base = _point(solid.axis, solid.centre, solid.low)
            plane = cad.Plane(origin=base, z_dir=_DIRECTIONS[solid.axis])
            return cad.Solid.make_cylinder(solid.diameter / 2, solid.high - solid.low, plane)
        case Prism():
            corners = [_point(solid.axis, corner, solid.low) for corner in solid.outline]
            along = cad.Vector(*_DIRECTIONS[solid.axis]) * (solid.high - solid.low)
            return cad.Solid.extrude(_face(corners), along)
        case Lathe():
            corners = [(radius, 0.0, z) for radius, z in solid.outline]
            return cad.Solid.revolve(_face(corners), 360.0, cad.Axis.Z)
        case Union():
            return _join(solid.parts)
        case Intersection():
            first, *others = (shape(part) for part in solid.parts)
            for other in others:
                first = first & other
            return first
        case Difference():
            return shape(solid.body).cut(*(shape(part) for part in solid.cut))
        case Placed():
            turned = shape(solid.solid).rotate(
                cad.Axis((0, 0, 0), _DIRECTIONS[solid.axis]), 90.0 * solid.quarters
            )
            return turned.moved(cad.Location(solid.move))


def _kernel() -> Any:
    try:
        import build123d
    except ModuleNotFoundError as error:
        if error.name != "build123d":
            raise
        raise ModuleNotFoundError(
            "STEP files are made by build123d, which is not installed: pip install linetrack[cad]"
        ) from error
    return build123d


def _point(axis: str, across: tuple[float, float], along: float) -> tuple[float, float, float]:
    point = [along, along, along]
    for place, value in zip(ACROSS[axis], across, strict=True):  # type: ignore[index]
        point[place] = value
    return point[0], point[1], point[2]


def _face(corners: list[tuple[float, float, float]]) -> Any:
    cad = _kernel()
    return cad.Face(cad.Wire.make_polygon(corners, close=True))


def _join(parts: tuple[Solid, ...]) -> Any:
    first, *others = (shape(part) for part in parts)
    return first.fuse(*others) if others else first


def volume(solid: Solid) -> float:
    """Volume of the exact body, mm³."""
    return float(shape(solid).volume)


def write_step(parts: Mapping[str, Solid], path: str | os.PathLike[str]) -> Path:
    """Write parts, in their places and by their names, as one STEP file in mm.

    Raises
    ------
    FileNotFoundError
        If there is no such folder.
    """
    cad = _kernel()
    target = Path(path)
    if not target.parent.is_dir():
        raise FileNotFoundError(f"{target}: there is no folder {target.parent}; make it first")
    children = []
    for name, solid in parts.items():
        body = shape(solid)
        body.label = name
        children.append(body)
    cad.export_step(cad.Compound(label=target.stem, children=children), target)
    return target


def write_drawing(parts: Mapping[str, Solid], path: str | os.PathLike[str]) -> Path:
    """Write three views of parts as an SVG, true to scale in mm: hidden edges are thin and grey.

    From the front (along the light), from the side and from above, first-angle: each view lies on
    the far side of what it shows.

    Raises
    ------
    FileNotFoundError
        If there is no such folder.
    """
    cad = _kernel()
    target = Path(path)
    if not target.parent.is_dir():
        raise FileNotFoundError(f"{target}: there is no folder {target.parent}; make it first")
    whole = cad.Compound(children=[shape(solid) for solid in parts.values()])
    box = whole.bounding_box()
    middle = box.center()
    far = 10 * box.diagonal
    gap = 15.0
    right = (box.size.X + box.size.Z) / 2 + gap
    below = -(box.size.Y + box.size.Z) / 2 - gap
    views = {
        "front": ((0, 0, -far), (0, 1, 0), (0.0, 0.0)),
        "side": ((far, 0, 0), (0, 1, 0), (right, 0.0)),
        "top": ((0, far, 0), (0, 0, -1), (0.0, below)),
    }
    drawing = cad.ExportSVG(margin=5, line_weight=0.25)
    drawing.add_layer("hidden", line_color=cad.Color(0.6, 0.6, 0.6), line_weight=0.12)
    for origin, up, place in views.values():
        eye = tuple(m + o for m, o in zip(middle, origin, strict=True))
        visible, hidden = whole.project_to_viewport(eye, up, middle)
        move = cad.Location((*place, 0.0))
        drawing.add_shape([edge.moved(move) for edge in visible])
        drawing.add_shape([edge.moved(move) for edge in hidden], layer="hidden")
    drawing.write(str(target))
    return target
