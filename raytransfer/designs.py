"""A design is a file: all that the twin, the mount and the tracker need to know of a head.

Lengths are in mm, angles in rad. A file is TOML::

    format = "linetrack design"
    version = 1
    name = "slit and two f 60"
    sensor = "TCD1304"
    sensor_distance = 0.82
    gaps = [10.0, 0.2, 24.5]

    [[element]]
    kind = "screen"
    part = "slit"
    x = 5.0

    [[element]]
    kind = "lens"
    part = "LJ1430L1"
    reversed = true

and so on, front to back. A lens named by its part number alone is the one of `CATALOGUE` or
`THESIS_LENSES`; with sizes and a material it is described in full. `DESIGNS` has those that come
with the package.
"""

from __future__ import annotations

import json
import math
import os
import tempfile
import tomllib
from dataclasses import dataclass, replace
from difflib import get_close_matches
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Self

from raytransfer import _checks as check
from raytransfer._data import FOLDER
from raytransfer.lenses import CATALOGUE, THESIS_LENSES, Aperture, Lens, Plate, SphericalLens
from raytransfer.materials import MATERIALS, ConstantIndex, Sellmeier
from raytransfer.sensors import SENSORS, TCD1304, LineSensor
from raytransfer.systems import NOMINAL, OpticalSystem, Placement

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping
    from importlib.resources.abc import Traversable

    from raytransfer.lenses import Element
    from raytransfer.materials import Material

FORMAT = "linetrack design"
"""What a design file says it is."""

VERSION = 1
"""Of the format, the only one so far."""

PARTS = MappingProxyType({**CATALOGUE, **THESIS_LENSES})
"""Lenses that a part number is enough for."""

_SIZES = {
    "lens": ("height", "length", "radius", "centre_thickness"),
    "spherical lens": ("diameter", "front_radius", "back_radius", "centre_thickness"),
    "plate": ("thickness",),
}


@dataclass(frozen=True)
class Design:
    """What a design file holds.

    Parameters
    ----------
    system : OpticalSystem
        With a sensor_distance, windows included.
    sensor : LineSensor
        One of `SENSORS`.
    notes : str
        Where the design comes from.

    Raises
    ------
    ValueError
        If the system has no sensor_distance or the sensor is none of `SENSORS`.
    """

    system: OpticalSystem
    sensor: LineSensor = TCD1304
    notes: str = ""

    def __post_init__(self) -> None:
        if not isinstance(self.system, OpticalSystem):
            raise TypeError(f"system = {self.system!r}: an OpticalSystem is needed")
        if self.system.sensor_distance is None:
            raise ValueError(
                f"{self.system.name}: a design needs sensor_distance, the air before the chip in mm"
            )
        if SENSORS.get(self.sensor.name) != self.sensor:
            raise ValueError(
                f"sensor {self.sensor.name!r}: a design names one of {', '.join(SENSORS)}, whose "
                "numbers are those of its file in data/sensors"
            )

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Self:
        """Read what a design file says once TOML is read, as a session's metadata keeps it.

        Raises
        ------
        ValueError, TypeError
            As `load_design`, without a path.
        """
        if data.get("format") != FORMAT:
            raise ValueError(f"this is no design file: it does not begin with format = {FORMAT!r}")
        version = data.get("version")
        if version != VERSION or isinstance(version, bool):
            raise ValueError(
                f"version = {version!r}: this program reads version {VERSION}; "
                "was the file written by a later one?"
            )
        table = Table("", dict(data))
        table.of({"format", "version", "name", "sensor", "sensor_distance", "gaps", "element"})
        table.and_maybe({"notes", "sensor_placement"})
        sensor = table.known("sensor", SENSORS)
        tables = [
            Table(f"element {number}, ", entry)
            for number, entry in enumerate(table.get("element", list), start=1)
        ]
        elements = tuple(_element(entry, sensor) for entry in tables)
        placements = tuple(_placement(at) for entry in tables if (at := entry.inner("placement")))
        if placements and len(placements) < len(elements):
            raise ValueError("placement: give one for each element, or none")
        sensor_at = table.inner("sensor_placement")
        system = OpticalSystem(
            table.get("name", str),
            elements,
            tuple(table.numbers("gaps")),
            table.number("sensor_distance"),
            placements,
            NOMINAL if sensor_at is None else _placement(sensor_at),
        )
        notes = table.get("notes", str) if "notes" in data else ""
        return cls(system, sensor, notes)


def save_design(
    system: OpticalSystem,
    path: str | os.PathLike[str],
    *,
    sensor: LineSensor = TCD1304,
    notes: str = "",
) -> None:
    """Write a system as a design file.

    `load_design` gives back an equal system, bit for bit. A file of that name is replaced once the
    new one is complete, or not at all.

    Parameters
    ----------
    system : OpticalSystem
        With a sensor_distance.
    path : str or path-like
        Its suffix is ``.toml``.
    sensor : LineSensor
        One of `SENSORS`.
    notes : str

    Raises
    ------
    ValueError
        As `Design`; or if the path has another suffix.
    FileNotFoundError
        If there is no such folder.
    """
    target = Path(path)
    if target.suffix != ".toml":
        raise ValueError(f"{target}: a design file ends in .toml")
    if not target.parent.is_dir():
        raise FileNotFoundError(f"{target}: there is no folder {target.parent}; make it first")
    text = design_text(Design(system, sensor, notes))
    handle, part = tempfile.mkstemp(dir=target.parent, prefix=f".{target.stem}-", suffix=".part")
    try:
        with os.fdopen(handle, "w", encoding="utf-8", newline="\n") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        mask = os.umask(0)
        os.umask(mask)
        Path(part).chmod(0o666 & ~mask)  # a temporary file is its owner's alone
        Path(part).replace(target)
    except BaseException:
        Path(part).unlink(missing_ok=True)
        raise


def load_design(path: str | os.PathLike[str] | Traversable) -> Design:
    """Read a design file.

    Raises
    ------
    ValueError
        If it is no design file, of an unknown version, names a part, material or sensor that is
        unknown, lacks a key or has one too many, or its numbers make no system. The message begins
        with the path and says where.
    OSError
        If it cannot be read.
    """
    file = Path(path) if isinstance(path, str | os.PathLike) else path
    data = file.read_bytes()
    try:
        return Design.from_dict(tomllib.loads(data.decode("utf-8")))
    except tomllib.TOMLDecodeError as error:
        raise ValueError(f"{file}: no design file, which is TOML ({error})") from error
    except (ValueError, TypeError) as error:
        raise ValueError(f"{file}: {error}") from error


def find_design(name: str, folder: str | os.PathLike[str] = ".") -> Design:
    """Return the design that a name stands for: one of `DESIGNS`, or a file.

    Parameters
    ----------
    name : str
    folder : str or path-like
        Where a relative path begins.

    Raises
    ------
    LookupError
        If it is neither.
    ValueError, OSError
        As `load_design`.
    """
    if name in DESIGNS:
        return DESIGNS[name]
    path = Path(folder, name)
    if not path.is_file():
        raise LookupError(
            f"{name}: neither a design file nor one of the designs {', '.join(DESIGNS)}"
        )
    return load_design(path)


def design_text(design: Design) -> str:
    """Return the text of a design's file."""
    system = design.system
    lines = [
        "# A head for a line sensor, front to back. Lengths in mm, angles in rad.",
        *_lines({"format": FORMAT, "version": VERSION, "name": system.name}),
        *(_lines({"notes": design.notes}) if design.notes else ()),
        *_lines(
            {
                "sensor": design.sensor.name,
                "sensor_distance": system.sensor_distance,
                "gaps": list(system.gaps),
            }
        ),
    ]
    if system.sensor_placement != NOMINAL:
        lines += ["", "[sensor_placement]", *_lines(_placement_entry(system.sensor_placement))]
    for number, element in enumerate(system.elements):
        lines += ["", "[[element]]", *_lines(_entry(element, design.sensor))]
        if system.placements:
            lines += _lines({"placement": _placement_entry(system.placements[number])})
    return "\n".join(lines) + "\n"


def _lines(entry: Mapping[str, Any]) -> Iterable[str]:
    return (f"{key} = {_toml(value)}" for key, value in entry.items())


def _toml(value: Any) -> str:
    """Write a value as TOML; floats so that they are read back bit for bit."""
    match value:
        case bool():
            return "true" if value else "false"
        case str():
            # JSON's escapes are TOML's, which also wants one for DEL
            return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
        case int():
            return str(value)
        case list() | tuple():
            return f"[{', '.join(map(_toml, value))}]"
        case dict():
            return f"{{ {', '.join(_lines(value))} }}"
    return repr(float(value))


def _entry(element: Element, sensor: LineSensor) -> dict[str, Any]:
    """Return what a file says of an element."""
    entry: dict[str, Any]
    match element:
        case Lens():
            plain = replace(element, bends="x", reversed=False, clear=None)
            entry = {"kind": "lens", "part": element.part}
            if PARTS.get(element.part) != plain:
                entry |= _described(element, "lens")
            entry |= {"bends": element.bends, "reversed": element.reversed}
            if element.clear is not None:
                entry["clear"] = [float(size) for size in element.clear]
            return entry
        case SphericalLens():
            entry = {"kind": "spherical lens", "part": element.part}
            return entry | _described(element, "spherical lens")
        case Plate() if element == sensor.window:
            return {"kind": "window"}
        case Plate():
            return {"kind": "plate", "part": element.part, **_described(element, "plate")}
        case Aperture():
            sizes = {m: float(element.aperture(m)) for m in ("x", "y")}
            finite = {name: size for name, size in sizes.items() if math.isfinite(size)}
            return {"kind": "screen", "part": element.part, **finite}


def _described(element: Lens | SphericalLens | Plate, kind: str) -> dict[str, Any]:
    sizes = {name: float(getattr(element, name)) for name in _SIZES[kind]}
    return {**sizes, "material": _material_entry(element.material)}


def _material_entry(material: Material) -> str | dict[str, Any]:
    if MATERIALS.get(material.name) == material:
        return material.name
    if isinstance(material, ConstantIndex):
        return {"name": material.name, "n": float(material.n)}
    numbers = {key: [float(v) for v in getattr(material, key)] for key in ("B", "C", "valid")}
    return {"name": material.name, **numbers}


def _placement_entry(placement: Placement) -> dict[str, list[float]]:
    return {"decentre": list(placement.decentre), "tilt": list(placement.tilt)}


class Table:
    """A table of a TOML file, read strictly; messages say which table they are about.

    Parameters
    ----------
    where : str
        Its name, as messages begin: ``"element 2, "``; empty for the file itself.
    data : dict
        What it holds.

    Raises
    ------
    TypeError
        If it is no table.
    """

    def __init__(self, where: str, data: Any) -> None:
        if not isinstance(data, dict):
            raise TypeError(f"{where.removesuffix(', ')} = {data!r}: a table is needed")
        self.where, self.data = where, data
        self._needed: set[str] = set()

    def of(self, needed: set[str]) -> None:
        """Refuse a table that lacks one of these keys."""
        self._needed = needed
        if missing := sorted(needed - set(self.data)):
            slips = [
                n for name in missing for n in get_close_matches(name, set(self.data) - needed)
            ]
            meant = f"; was {slips[0]} meant to be it?" if slips else ""
            raise ValueError(f"{self.where}missing: {', '.join(missing)}{meant}")

    def and_maybe(self, more: set[str]) -> None:
        """Refuse a table with any but the needed keys and these."""
        if unknown := set(self.data) - self._needed - more:
            known = ", ".join(sorted(self._needed | more))
            raise ValueError(
                f"{self.where}unknown: {', '.join(sorted(unknown))}; known are {known}"
            )

    def get(self, key: str, kind: type) -> Any:
        """Return a value of this kind."""
        value = self.data[key]
        if not isinstance(value, kind):
            kinds = {str: "text", list: "a list", bool: "true or false"}
            raise TypeError(f"{self.where}{key} = {value!r}: {kinds[kind]} is needed")
        return value

    def known(self, key: str, table: Mapping[str, Any]) -> Any:
        """Return what a name stands for."""
        name = self.get(key, str)
        if name not in table:
            raise ValueError(f"{self.where}{key} = {name!r}: known are {', '.join(table)}")
        return table[name]

    def number(self, key: str, *, endless: bool = False) -> float:
        """Return a number; infinite only where there may be no edge or no curvature."""
        value = self.data[key]
        if endless and isinstance(value, float) and math.isinf(value):
            return value
        return check.number(f"{self.where}{key}", value)

    def numbers(self, key: str, length: int | None = None) -> list[float]:
        """Return a list of numbers."""
        values = self.get(key, list)
        if length is not None and len(values) != length:
            raise ValueError(f"{self.where}{key} = {values}: {length} numbers are needed")
        return [check.number(f"{self.where}{key}[{i}]", value) for i, value in enumerate(values)]

    def inner(self, key: str) -> Table | None:
        """Return a table within this one, if it is there."""
        return Table(f"{self.where}{key}, ", self.data[key]) if key in self.data else None


def _placement(table: Table) -> Placement:
    table.of({"decentre", "tilt"})
    table.and_maybe(set())
    across, up = table.numbers("decentre", 2)
    about_x, about_y, about_z = table.numbers("tilt", 3)
    return Placement((across, up), (about_x, about_y, about_z))


def _material(table: Table) -> Material:
    if isinstance(table.data["material"], str):
        material: Material = table.known("material", MATERIALS)
        return material
    glass = Table(f"{table.where}material, ", table.data["material"])
    if "n" in glass.data:
        glass.of({"name", "n"})
        glass.and_maybe(set())
        return ConstantIndex(glass.get("name", str), glass.number("n"))
    glass.of({"name", "B", "C", "valid"})
    glass.and_maybe(set())
    strengths, resonances = glass.numbers("B"), glass.numbers("C")
    if len(strengths) != len(resonances):
        raise ValueError(
            f"{glass.where}B and C: as many of the one as of the other are needed, not "
            f"{len(strengths)} and {len(resonances)}"
        )
    low, high = glass.numbers("valid", 2)
    return Sellmeier(glass.get("name", str), tuple(strengths), tuple(resonances), (low, high))


def _element(table: Table, sensor: LineSensor) -> Element:
    kinds = ("lens", "spherical lens", "plate", "window", "screen")
    kind = table.data.get("kind")
    if kind not in kinds:
        raise ValueError(f"{table.where}kind = {kind!r}: known are {', '.join(kinds)}")
    if kind == "window":
        table.of({"kind"})
        table.and_maybe({"placement"})
        if sensor.window is None:
            raise ValueError(f"{table.where}kind = 'window': of {sensor.name} none is known")
        return sensor.window
    if kind == "screen":
        table.of({"kind", "part"})
        table.and_maybe({"x", "y", "placement"})
        return Aperture(
            table.get("part", str), **{m: table.number(m) for m in ("x", "y") if m in table.data}
        )
    described = {*_SIZES[kind], "material"}
    if kind == "lens":
        return _lens(table, described)
    table.of({"kind", "part", *described})
    table.and_maybe({"placement"})
    make = Plate if kind == "plate" else SphericalLens
    return make(table.get("part", str), material=_material(table), **_sizes(table, kind))


def _lens(table: Table, described: set[str]) -> Lens:
    full = bool(described & set(table.data))
    table.of({"kind", "part", *(described if full else ())})
    table.and_maybe({"bends", "reversed", "clear", "placement"})
    lens: Lens
    if full:
        height, length, radius, thickness = (table.number(size) for size in _SIZES["lens"])
        lens = Lens(table.get("part", str), height, length, radius, thickness, _material(table))
    else:
        lens = table.known("part", PARTS)
    if "bends" in table.data:
        lens = lens.bending(table.data["bends"])
    if "reversed" in table.data:
        lens = replace(lens, reversed=table.get("reversed", bool))
    if "clear" in table.data:
        across, along = table.numbers("clear", 2)
        lens = replace(lens, clear=(across, along))
    return lens


def _sizes(table: Table, kind: str) -> dict[str, float]:
    return {
        size: table.number(size, endless=size in ("front_radius", "back_radius"))
        for size in _SIZES[kind]
    }


def _shipped() -> dict[str, Design]:
    files = sorted((FOLDER / "designs").iterdir(), key=lambda file: file.name)
    return {
        file.name.removesuffix(".toml"): load_design(file)
        for file in files
        if file.name.endswith(".toml")
    }


DESIGNS = MappingProxyType(_shipped())
"""Designs of the package, by the names of their files in ``data/designs``."""
