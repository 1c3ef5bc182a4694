"""Schematics for KiCad 9, written from the boards.

Symbols are drawn from the parts' own pins, so that neither writing nor reading a schematic needs
KiCad's libraries. Places come from ``data/layout``. Pins of one net that face each other are joined
by a wire, neighbouring pins of one part by a line along them; everything else by the net's name.
"""

from __future__ import annotations

import re
import textwrap
import uuid
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from hardware.boards import Terminal

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

    from hardware.boards import Board, Part, PartType

LIBRARY: Final = "linetrack"
"""Name of the symbols' library."""

_NAMESPACE: Final = uuid.UUID("5d7a2b8e-4a51-4c0e-9d0b-1304f401e000")

Point = tuple[float, float]


class Symbol(str):
    """An unquoted word of KiCad's files."""

    __slots__ = ()


def identity(*names: object) -> str:
    """Return the same UUID whenever the names are the same."""
    return str(uuid.uuid5(_NAMESPACE, "/".join(map(str, names))))


_TOKEN: Final = re.compile(r'[()]|"(?:\\.|[^"\\])*"|"|[^\s()"]+')
_ESCAPE: Final = re.compile(r"\\(.)")
_MEANING: Final = {"n": "\n", '"': '"', "\\": "\\"}


# --- KiCad's files ------------------------------------------------------------------------------


def write(item: Any, depth: int = 0) -> str:
    """Return the text of nested lists: words are `Symbol`, other strings are quoted.

    Parameters
    ----------
    item : list, Symbol, str, int or float
    depth : int, optional
        Of the indentation.
    """
    if isinstance(item, Symbol):
        return item
    if isinstance(item, str):
        escaped = item.replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n")
        return f'"{escaped}"'
    if isinstance(item, float):
        text = f"{item:.4f}".rstrip("0").rstrip(".")
        return "0" if text == "-0" else text
    if not isinstance(item, list):
        return str(item)
    if any(isinstance(part, list) for part in item):
        indent = "\n" + "\t" * (depth + 1)
        parts = [
            (indent if isinstance(part, list) else " ") + write(part, depth + 1) for part in item
        ]
        return "(" + "".join(parts).lstrip() + "\n" + "\t" * depth + ")"
    return "(" + " ".join(write(part) for part in item) + ")"


def read(text: str) -> list[Any]:
    """Read nested lists from a file's text; the inverse of `write`, but every word is a str.

    Raises
    ------
    ValueError
        If brackets or quotes are not closed.
    """
    stack: list[list[Any]] = [[]]
    for word in _TOKEN.findall(text):
        if word == "(":
            stack.append([])
        elif word == ")":
            if len(stack) < 2:
                raise ValueError("a bracket closes that was not opened")
            done = stack.pop()
            stack[-1].append(done)
        elif word == '"':
            raise ValueError("a quote is not closed")
        elif word.startswith('"'):
            stack[-1].append(_ESCAPE.sub(lambda match: _MEANING[match[1]], word[1:-1]))
        else:
            stack[-1].append(word)
    if len(stack) != 1 or len(stack[0]) != 1:
        raise ValueError("a bracket is not closed")
    return list(stack[0][0])


def _s(name: str, *rest: Any) -> list[Any]:
    return [Symbol(name), *rest]


def _yes(flag: bool) -> Symbol:
    return Symbol("yes" if flag else "no")


def _font(size: float = 1.27, *, justify: str = "", hide: bool = False) -> list[Any]:
    effects = _s("effects", _s("font", _s("size", size, size)))
    if justify:
        effects.append(_s("justify", *map(Symbol, justify.split())))
    if hide:
        effects.append(_s("hide", Symbol("yes")))
    return effects


# --- symbols ------------------------------------------------------------------------------------
# In a symbol's frame x goes right and y up; its middle is at 0, 0. Lengths in mm.


class SymbolPin(NamedTuple):
    """A pin of a symbol: number, name, what KiCad takes it for, its free end, and the way out."""

    number: str
    name: str
    electrical: str
    at: Point
    out: Point
    length: float
    inverted: bool = False


class Drawing(NamedTuple):
    """One unit of a symbol."""

    pins: tuple[SymbolPin, ...]
    shapes: tuple[list[Any], ...]
    texts: tuple[Point, Point]
    """Where reference and value are written."""
    names: bool = False
    """Whether the pins' names and numbers are shown."""


_ELECTRICAL: Final = {
    "passive": "passive",
    "input": "input",
    "output": "output",
    "supply": "power_in",
    "ground": "power_in",
    "regulated": "power_out",
    "nc": "free",
}

UP, DOWN, LEFT, RIGHT = (0.0, 1.0), (0.0, -1.0), (-1.0, 0.0), (1.0, 0.0)


def _line(*points: Point, width: float = 0.254, fill: str = "none") -> list[Any]:
    return _s(
        "polyline",
        _s("pts", *[_s("xy", x, y) for x, y in points]),
        _s("stroke", _s("width", width), _s("type", Symbol("default"))),
        _s("fill", _s("type", Symbol(fill))),
    )


def _rectangle(left: float, bottom: float, right: float, top: float) -> list[Any]:
    return _s(
        "rectangle",
        _s("start", left, top),
        _s("end", right, bottom),
        _s("stroke", _s("width", 0.254), _s("type", Symbol("default"))),
        _s("fill", _s("type", Symbol("background"))),
    )


def _circle(x: float, y: float, radius: float) -> list[Any]:
    return _s(
        "circle",
        _s("center", x, y),
        _s("radius", radius),
        _s("stroke", _s("width", 0.254), _s("type", Symbol("default"))),
        _s("fill", _s("type", Symbol("none"))),
    )


def _pins(
    type_: PartType, places: Mapping[str, tuple[Point, Point, float]]
) -> tuple[SymbolPin, ...]:
    """Put the pins where their names belong."""
    return tuple(
        SymbolPin(str(number), pin.name, _ELECTRICAL[pin.function], *places[pin.name])
        for number, pin in enumerate(type_.pins, start=1)
    )


def _upright(type_: PartType, length: float, *shapes: list[Any]) -> list[Drawing]:
    """Two pins, the first above."""
    ends = zip(
        (pin.name for pin in type_.pins), ((0.0, 3.81), (0.0, -3.81)), (UP, DOWN), strict=True
    )
    places = {name: (at, out, length) for name, at, out in ends}
    return [Drawing(_pins(type_, places), shapes, ((2.54, 1.27), (2.54, -1.27)))]


def _resistor(type_: PartType) -> list[Drawing]:
    return _upright(type_, 1.27, _rectangle(-1.016, -2.54, 1.016, 2.54))


def _capacitor(type_: PartType) -> list[Drawing]:
    plates = [_line((-2.032, y), (2.032, y), width=0.508) for y in (0.762, -0.762)]
    return _upright(type_, 3.048, *plates)


def _polarised(type_: PartType) -> list[Drawing]:
    (drawing,) = _capacitor(type_)
    plus = (_line((-2.286, 2.159), (-1.27, 2.159)), _line((-1.778, 1.651), (-1.778, 2.667)))
    return [drawing._replace(shapes=(*drawing.shapes, *plus))]


def _diode(type_: PartType) -> list[Drawing]:
    """Schottky: its cathode's bar has hooks."""
    triangle = _line((-1.27, -1.27), (1.27, -1.27), (0.0, 1.27), (-1.27, -1.27))
    bar = _line((-1.27, 0.762), (-1.27, 1.27), (1.27, 1.27), (1.27, 1.778))
    return _upright(type_, 2.54, triangle, bar)


def _pnp(type_: PartType) -> list[Drawing]:
    places = {
        "B": ((-5.08, 0.0), LEFT, 5.08),
        "E": ((2.54, 5.08), UP, 2.54),
        "C": ((2.54, -5.08), DOWN, 2.54),
    }
    shapes = (
        _line((0.0, 1.905), (0.0, -1.905), width=0.508),
        _line((0.0, 0.635), (2.54, 2.54)),
        _line((0.0, -0.635), (2.54, -2.54)),
        _line((0.66, 1.75), (1.52, 1.14), (0.46, 0.98), (0.66, 1.75), fill="outline"),
        _circle(1.016, 0.0, 2.921),
    )
    return [Drawing(_pins(type_, places), shapes, ((5.08, 1.27), (5.08, -1.27)))]


def _nmos(type_: PartType) -> list[Drawing]:
    places = {
        "G": ((-5.08, 0.0), LEFT, 5.08),
        "D": ((2.54, 5.08), UP, 2.54),
        "S": ((2.54, -5.08), DOWN, 2.54),
    }
    shapes = (
        _line((0.0, 1.905), (0.0, -1.905)),
        *(_line((0.762, y + 0.508), (0.762, y - 0.508), width=0.508) for y in (1.778, 0.0, -1.778)),
        _line((0.762, 1.778), (2.54, 1.778), (2.54, 2.54)),
        _line((2.54, -2.54), (2.54, 0.0), (0.762, 0.0)),
        _line((0.762, -1.778), (2.54, -1.778)),
        _line((1.016, 0.0), (1.778, 0.381), (1.778, -0.381), (1.016, 0.0), fill="outline"),
        _circle(1.27, 0.0, 2.921),
    )
    return [Drawing(_pins(type_, places), shapes, ((5.08, 1.27), (5.08, -1.27)))]


def _inverter(type_: PartType) -> list[Drawing]:
    """A unit for each gate, one for the supply."""
    numbered = list(enumerate(type_.pins, start=1))
    triangle = _line((-3.81, 3.81), (3.81, 0.0), (-3.81, -3.81), (-3.81, 3.81), fill="background")
    gates = []
    for gate in sorted({pin.name[0] for pin in type_.pins if pin.name[0].isdecimal()}):
        pins = []
        for number, pin in numbered:
            if pin.name[0] == gate:
                out = pin.function == "output"
                end, way = ((7.62, 0.0), RIGHT) if out else ((-7.62, 0.0), LEFT)
                electrical = _ELECTRICAL[pin.function]
                pins.append(SymbolPin(str(number), pin.name, electrical, end, way, 3.81, out))
        gates.append(Drawing(tuple(pins), (triangle,), ((0.0, 5.08), (0.0, -5.08))))
    places = {"supply": ((0.0, 7.62), UP), "ground": ((0.0, -7.62), DOWN)}
    power = tuple(
        SymbolPin(str(number), pin.name, _ELECTRICAL[pin.function], *places[pin.function], 2.54)
        for number, pin in numbered
        if pin.function in places
    )
    box = _rectangle(-3.81, -5.08, 3.81, 5.08)
    return [*gates, Drawing(power, (box,), ((5.08, 1.27), (5.08, -1.27)))]


def _header(type_: PartType) -> list[Drawing]:
    top = (len(type_.pins) - 1) * 1.27
    pins = tuple(
        SymbolPin(str(n + 1), pin.name, "passive", (-5.08, top - 2.54 * n), LEFT, 3.81)
        for n, pin in enumerate(type_.pins)
    )
    shapes = [_rectangle(-1.27, -top - 1.27, 1.27, top + 1.27)]
    shapes += [_line((-1.27, pin.at[1]), (0.0, pin.at[1]), width=0.508) for pin in pins]
    return [Drawing(pins, tuple(shapes), ((0.0, top + 5.08), (0.0, top + 3.175)), names=True)]


def _box(type_: PartType) -> list[Drawing]:
    """Supplies and inputs on the left, outputs on the right, ground and pins without use below."""
    sides: dict[Point, list[tuple[int, Any]]] = {LEFT: [], RIGHT: [], DOWN: []}
    for number, pin in enumerate(type_.pins, start=1):
        below = pin.function in {"ground", "nc"}
        right = pin.function in {"output", "regulated"} or pin.name in {"ADJ", "BYP"}
        sides[DOWN if below else RIGHT if right else LEFT].append((number, pin))
    rows = max(len(sides[LEFT]), len(sides[RIGHT]))
    half_width = max(7.62, 2.54 * round(len(sides[DOWN]) / 2 + 1))
    half_height = 2.54 * (rows // 2 + 2)
    pins = []
    for way, members in sides.items():
        for n, (number, pin) in enumerate(members):
            if way == DOWN:
                end = (2.54 * (n - len(members) // 2), -half_height - 2.54)
            else:
                end = (way[0] * (half_width + 2.54), half_height - 2.54 * (n + 1))
            pins.append(SymbolPin(str(number), pin.name, _ELECTRICAL[pin.function], end, way, 2.54))
    box = _rectangle(-half_width, -half_height, half_width, half_height)
    texts = ((0.0, half_height + 3.81), (0.0, half_height + 1.27))
    return [Drawing(tuple(pins), (box,), texts, names=True)]


_DRAWN: Final[Mapping[str, Callable[[PartType], list[Drawing]]]] = {
    "resistor": _resistor,
    "capacitor": _capacitor,
    "polarised capacitor": _polarised,
    "diode": _diode,
    "pnp": _pnp,
    "nmos": _nmos,
    "inverter": _inverter,
    "header": _header,
}


def drawings(type_: PartType) -> list[Drawing]:
    """Return the units of a part's symbol."""
    return _DRAWN.get(type_.kind, _box)(type_)


def _power(name: str) -> Drawing:
    """Draw a supply (above its pin), ground (below), or the mark of a net that is supplied."""
    electrical = "power_out" if name == "PWR_FLAG" else "power_in"
    pin = SymbolPin("1", name, electrical, (0.0, 0.0), DOWN, 0.0)
    if name == "GND":
        pin = pin._replace(out=UP)
        shapes = [
            _line((0.0, 0.0), (0.0, -1.27)),
            _line((1.27, -1.27), (0.0, -2.54), (-1.27, -1.27), (1.27, -1.27)),
        ]
        return Drawing((pin,), tuple(shapes), ((0.0, -5.08), (0.0, -3.81)))
    if name == "PWR_FLAG":
        shapes = [
            _line(
                (0.0, 0.0), (0.0, 1.27), (-1.016, 1.905), (0.0, 2.54), (1.016, 1.905), (0.0, 1.27)
            )
        ]
    else:
        shapes = [
            _line((0.0, 0.0), (0.0, 2.54)),
            _line((-0.762, 1.27), (0.0, 2.54), (0.762, 1.27)),
        ]
    return Drawing((pin,), tuple(shapes), ((0.0, 5.08), (0.0, 3.81)))


def _rotation(out: Point) -> int:
    """Degrees of a pin whose free end looks this way: KiCad counts from the free end inwards."""
    return {RIGHT: 180, LEFT: 0, UP: 270, DOWN: 90}[out]


def _library_symbol(name: str, units: Sequence[Drawing], *, power: bool = False) -> list[Any]:
    short = name.rpartition(":")[2]
    first = units[0]
    symbol = _s("symbol", name)
    if power:
        symbol.append(_s("power"))
    if not first.names:
        symbol.append(_s("pin_numbers", _s("hide", Symbol("yes"))))
        symbol.append(_s("pin_names", _s("offset", 0), _s("hide", Symbol("yes"))))
    elif all(pin.electrical == "passive" for pin in first.pins):
        symbol.append(_s("pin_names", _s("offset", 1.016), _s("hide", Symbol("yes"))))
    else:
        symbol.append(_s("pin_names", _s("offset", 1.016)))
    symbol += [
        _s("exclude_from_sim", Symbol("no")),
        _s("in_bom", _yes(not power)),
        _s("on_board", _yes(not power)),
    ]
    fields = {"Reference": "#PWR" if power else "U", "Value": short}
    for (key, value), (x, y) in zip(fields.items(), first.texts, strict=True):
        symbol.append(_s("property", key, value, _s("at", x, y, 0), _font(hide=power)))
    for key in ("Footprint", "Datasheet", "Description"):
        symbol.append(_s("property", key, "", _s("at", 0, 0, 0), _font(hide=True)))
    for number, unit in enumerate(units, start=1):
        body = _s("symbol", f"{short}_{number}_1", *unit.shapes)
        for pin in unit.pins:
            body.append(
                _s(
                    "pin",
                    Symbol(pin.electrical),
                    Symbol("inverted" if pin.inverted else "line"),
                    _s("at", *pin.at, _rotation(pin.out)),
                    _s("length", pin.length),
                    _s("name", pin.name, _font()),
                    _s("number", pin.number, _font()),
                )
            )
        symbol.append(body)
    symbol.append(_s("embedded_fonts", Symbol("no")))
    return symbol


# --- a sheet ------------------------------------------------------------------------------------


class PlacedPin(NamedTuple):
    """A pin on the sheet, where y goes down; `net` is empty where nothing is connected."""

    terminal: Terminal
    net: str
    at: Point
    out: Point


@dataclass(frozen=True)
class Unit:
    """One unit of a part on the sheet.

    Parameters
    ----------
    part : Part
    number : int
        From 1.
    drawing : Drawing
    at : tuple of float
        mm from the sheet's upper left corner.
    rotation : int
        Degrees, counterclockwise.
    """

    part: Part
    number: int
    drawing: Drawing
    at: Point
    rotation: int

    def place(self, point: Point) -> Point:
        """Return where a point of the symbol is on the sheet."""
        x, y = _turn(point, self.rotation)
        return (round(self.at[0] + x, 4), round(self.at[1] - y, 4))

    def pins(self, board: Board) -> Iterator[PlacedPin]:
        """Yield the pins with their nets."""
        nets = {end: net for net, ends in board.nets.items() for end in ends}
        for pin in self.drawing.pins:
            end = Terminal(self.part.reference, pin.number)
            x, y = _turn(pin.out, self.rotation)
            yield PlacedPin(end, nets.get(end, ""), self.place(pin.at), (x, -y))


def _turn(point: Point, degrees: int) -> Point:
    x, y = point
    for _ in range(degrees // 90):
        x, y = 0.0 - y, x
    return (x, y)


def value(board: Board, part: Part) -> str:
    """Return what is written at a part on schematic and board: its value, or what is plugged in."""
    if part.reference in board.connectors:
        return board.connectors[part.reference].to
    text = part.type.type
    for noun in (" resistor", " capacitor", " transistor"):
        text = text.replace(noun, "")
    return text


def fitted(board: Board, part: Part) -> bool:
    """Whether a part is fitted in the assembly that was built."""
    return part.only in {"", board.assemblies[0]}


def net_names(board: Board) -> dict[Terminal, str]:
    """Return what KiCad calls the net of each pin.

    Names of supplies hold everywhere, others on their sheet; a pin without a net has one of its own.
    """
    supplies = supply_nets(board)
    names = {
        end: net if net in supplies else f"/{net}"
        for net, ends in board.nets.items()
        for end in ends
    }
    for reference, part in board.parts.items():
        drawn = drawings(part.type)
        for unit, drawing in enumerate(drawn):
            letter = chr(ord("A") + unit) if len(drawn) > 1 else ""
            for pin in drawing.pins:
                alone = f"unconnected-({reference}{letter}-{pin.name}-Pad{pin.number})"
                names.setdefault(Terminal(reference, pin.number), alone)
    return names


def supply_nets(board: Board) -> set[str]:
    """Return the nets that are a supply or ground in any assembly."""
    return {net for assembly in board.assemblies for net in board.netlist(assembly).volts}


def symbol_name(part: Part) -> str:
    """Return the library's name of a part's symbol."""
    return f"{LIBRARY}:{part.type.name}"


def part_identity(board: Board, part: Part) -> str:
    """Return the UUID by which schematic and layout know a part."""
    return identity(board.name, part.reference, 1)


def units(board: Board, layout: Mapping[str, Any]) -> list[Unit]:
    """Return every unit of every part where the layout has it.

    Raises
    ------
    KeyError
        If the layout lacks a part.
    ValueError
        If it has more or fewer places than a part has units.
    """
    placed = []
    for reference, part in board.parts.items():
        drawn = drawings(part.type)
        places = layout["schematic"][reference]
        places = places if isinstance(places[0], list) else [places]
        if len(places) != len(drawn):
            raise ValueError(f"{reference} has {len(drawn)} units, {len(places)} are placed")
        for number, (drawing, (x, y, degrees)) in enumerate(
            zip(drawn, places, strict=True), start=1
        ):
            placed.append(Unit(part, number, drawing, (2.54 * x, 2.54 * y), degrees))
    return placed


def _along(pin: PlacedPin, length: float) -> Point:
    return (
        round(pin.at[0] + pin.out[0] * length, 4),
        round(pin.at[1] + pin.out[1] * length, 4),
    )


def _middle(a: Point, b: Point, back: float) -> Point:
    """Return the point of KiCad's grid nearest to the middle of a wire, moved left."""
    x, y = (a[0] + b[0]) / 2 - back, (a[1] + b[1]) / 2
    return (round(1.27 * round(x / 1.27), 4), round(1.27 * round(y / 1.27), 4))


def _between(a: Point, b: Point, point: Point) -> bool:
    """Whether a point lies on a line along an axis, its ends excluded."""
    return point not in {a, b} and all(
        min(a[i], b[i]) - 1e-6 <= point[i] <= max(a[i], b[i]) + 1e-6 for i in (0, 1)
    )


def join(pins: Sequence[PlacedPin]) -> list[tuple[PlacedPin, PlacedPin]]:
    """Return the pairs of pins that a straight wire joins."""
    places = {pin.at for pin in pins}
    pairs = []
    for n, a in enumerate(pins):
        for b in pins[n + 1 :]:
            if not a.net or a.net != b.net or any(_between(a.at, b.at, at) for at in places):
                continue
            step = (b.at[0] - a.at[0], b.at[1] - a.at[1])
            length = abs(step[0]) + abs(step[1])
            straight = step[0] == 0 or step[1] == 0
            facing = a.out == (-b.out[0], -b.out[1]) and _along(a, length) == b.at
            beside = (
                a.terminal.reference == b.terminal.reference
                and a.out == b.out
                and length < 2.55
                and step[0] * a.out[0] + step[1] * a.out[1] == 0
            )
            if straight and (facing or beside):
                pairs.append((a, b))
    return pairs


def _clusters(
    pins: Iterable[PlacedPin], pairs: Iterable[tuple[PlacedPin, PlacedPin]]
) -> list[list[PlacedPin]]:
    """Return the groups of pins that wires have joined."""
    group = {pin.terminal: [pin] for pin in pins}
    for a, b in pairs:
        kept, gone = group[a.terminal], group[b.terminal]
        if kept is not gone:
            kept += gone
            for pin in gone:
                group[pin.terminal] = kept
    return list({id(members): members for members in group.values()}.values())


class Sheet:
    """A schematic while it is drawn.

    Parameters
    ----------
    board : Board
    layout : mapping
        Its file of ``data/layout``.
    """

    def __init__(self, board: Board, layout: Mapping[str, Any]) -> None:
        self.board = board
        self.layout = layout
        self.root = identity(board.name, "sheet")
        self.items: list[list[Any]] = []
        self.library: dict[str, list[Any]] = {}
        self._count = 0

    def _id(self) -> list[Any]:
        self._count += 1
        return _s("uuid", identity(self.board.name, "item", self._count))

    def _wire(self, a: Point, b: Point) -> None:
        self.items.append(
            _s(
                "wire",
                _s("pts", _s("xy", *a), _s("xy", *b)),
                _s("stroke", _s("width", 0), _s("type", Symbol("default"))),
                self._id(),
            )
        )

    def _label(self, net: str, at: Point, out: Point) -> None:
        degrees = {(1.0, 0.0): 0, (0.0, -1.0): 90, (-1.0, 0.0): 180, (0.0, 1.0): 270}[out]
        side = "left" if degrees in {0, 90} else "right"
        self.items.append(
            _s("label", net, _s("at", *at, degrees), _font(justify=f"{side} bottom"), self._id())
        )

    def _text(self, text: str, at: Point, size: float = 1.27) -> None:
        self.items.append(
            _s(
                "text",
                text,
                _s("exclude_from_sim", Symbol("no")),
                _s("at", *at, 0),
                _font(size, justify="left top"),
                self._id(),
            )
        )

    def _instance(
        self,
        name: str,
        unit: int,
        at: Point,
        degrees: int,
        identifier: str,
        fields: Mapping[str, tuple[str, Point, bool]],
        pins: Iterable[str],
        *,
        on_board: bool = True,
        fit: bool = True,
    ) -> None:
        symbol = _s(
            "symbol",
            _s("lib_id", name),
            _s("at", *at, degrees),
            _s("unit", unit),
            _s("exclude_from_sim", Symbol("no")),
            _s("in_bom", _yes(on_board)),
            _s("on_board", _yes(on_board)),
            _s("dnp", _yes(not fit)),
            _s("uuid", identifier),
        )
        upright = 0 if degrees in {0, 180} else 90
        for key, (text, place, shown) in fields.items():
            centred = abs(place[0] - at[0]) < 0.01
            effects = _font(justify="" if centred else "left", hide=not shown)
            symbol.append(_s("property", key, text, _s("at", *place, upright), effects))
        for number in pins:
            symbol.append(_s("pin", number, _s("uuid", identity(identifier, "pin", number))))
        path = _s(
            "path", f"/{self.root}", _s("reference", fields["Reference"][0]), _s("unit", unit)
        )
        symbol.append(_s("instances", _s("project", self.board.name, path)))
        self.items.append(symbol)

    def _tag(self, net: str, at: Point, out: Point) -> None:
        """Write a supply's symbol."""
        name = f"{LIBRARY}:{net}"
        drawing = _power(net)
        self.library.setdefault(name, _library_symbol(name, [drawing], power=True))
        natural = (0.0, 1.0) if net == "GND" else (0.0, -1.0)
        degrees = 180 if out == (-natural[0], -natural[1]) else 0
        above = _turn(drawing.texts[1], degrees)[1]
        self._count += 1
        reference = f"{'#FLG' if net == 'PWR_FLAG' else '#PWR'}{self._count:03d}"
        self._instance(
            name,
            1,
            at,
            degrees,
            identity(self.board.name, reference),
            {"Reference": (reference, at, False), "Value": (net, (at[0], at[1] - above), True)},
            ["1"],
            on_board=False,
        )

    def draw(self) -> None:
        """Draw everything."""
        board = self.board
        placed = units(board, self.layout)
        for unit in placed:
            self._unit(unit)
        pins = [pin for unit in placed for pin in unit.pins(board)]
        pairs = join(pins)
        for a, b in pairs:
            if a.at != b.at:
                self._wire(a.at, b.at)
        joined = {(pin.terminal, other.at) for a, b in pairs for pin, other in ((a, b), (b, a))}
        supplies = supply_nets(board)
        beside: dict[tuple[str, Point], list[str]] = {}
        for pin in pins:
            if pin.out[1] == 0:
                beside.setdefault((pin.terminal.reference, pin.out), []).append(pin.net)
        for members in _clusters(pins, pairs):
            net = members[0].net
            if not net:
                self.items.append(_s("no_connect", _s("at", *members[0].at), self._id()))
                continue
            free = [
                pin
                for pin in members
                if not any(
                    end == pin.terminal
                    and _along(pin, abs(at[0] - pin.at[0]) + abs(at[1] - pin.at[1])) == at
                    for end, at in joined
                )
            ]
            if net in supplies:
                natural = (0.0, 1.0) if net == "GND" else (0.0, -1.0)
                pin = min(free or members, key=lambda pin: pin.out != natural)
                in_row = len(beside.get((pin.terminal.reference, pin.out), ())) > 1
                past = 10.16 if in_row else 5.08 if pin.out[1] == 0 else 2.54  # names beside it
                end = _along(pin, past)
                self._wire(pin.at, end)
                self._tag(net, end, pin.out)
            elif free:
                pin = free[0]
                end = _along(pin, 2.54 * -(-len(net) * 1.1 // 2.54))
                self._wire(pin.at, end)
                self._label(net, end, (-pin.out[0], -pin.out[1]))  # the text lies on the wire
            else:
                a, b = next(pair for pair in pairs if pair[0] in members)
                back = 0.55 * len(net) if a.at[1] == b.at[1] else 0.0
                self._label(net, _middle(a.at, b.at, back), (1.0, 0.0))
        self._flags(supplies)
        x, y = self.layout["schematic"]["notes"]
        self._text(_notes(board), (2.54 * x, 2.54 * y))

    def _unit(self, unit: Unit) -> None:
        part, name = unit.part, symbol_name(unit.part)
        self.library.setdefault(name, _library_symbol(name, drawings(part.type)))
        below = unit.drawing.texts
        if unit.rotation in {90, 270}:  # beside an upright symbol becomes above a lying one
            texts = [(unit.at[0], unit.at[1] - 4.191), (unit.at[0], unit.at[1] - 2.286)]
        else:
            texts = [(unit.at[0] + x, unit.at[1] - y) for x, y in below]
        gate = len(drawings(part.type)) > 1 and len(unit.drawing.pins) == 2 and unit.number > 1
        fields = {
            "Reference": (part.reference, texts[0], True),
            "Value": (value(self.board, part), texts[1], not gate),
            "Footprint": (part.type.footprint, unit.at, False),
            "Datasheet": ("", unit.at, False),
            "Description": (part.note, unit.at, False),
        }
        self._instance(
            name,
            unit.number,
            unit.at,
            unit.rotation,
            identity(self.board.name, part.reference, unit.number),
            fields,
            [pin.number for pin in unit.drawing.pins],
            fit=fitted(self.board, part),
        )

    def _flags(self, supplies: set[str]) -> None:
        """Tell KiCad which nets a connector supplies."""
        netlist = self.board.netlist()
        x, y = self.layout["schematic"]["flags"]
        brought = [
            net
            for net in self.board.nets
            if net in supplies
            and any(name in self.board.supplies for _, name, _ in netlist.labels(net))
        ]
        for n, net in enumerate(brought):
            at = (2.54 * (x + 7 * n), 2.54 * y)
            end = (at[0] + 10.16, at[1])
            self._wire(at, end)
            self._tag(net, at, (0.0, 1.0) if net == "GND" else (0.0, -1.0))
            self._tag("PWR_FLAG", end, (0.0, -1.0))

    def text(self) -> str:
        """Return the file."""
        board = self.board
        title = _s("title_block", _s("title", board.title), _s("company", "linetrack"))
        sheet = _s(
            "kicad_sch",
            _s("version", 20250114),
            _s("generator", "eeschema"),
            _s("generator_version", "9.0"),
            _s("uuid", self.root),
            _s("paper", self.layout["schematic"]["paper"]),
            title,
            _s("lib_symbols", *[self.library[name] for name in sorted(self.library)]),
            *self.items,
            _s("sheet_instances", _s("path", "/", _s("page", "1"))),
            _s("embedded_fonts", Symbol("no")),
        )
        return write(sheet) + "\n"


def _notes(board: Board) -> str:
    lines = textwrap.wrap(board.notes, 100)
    for change in board.changes:
        lines += ["", *textwrap.wrap(f"Removes “{change.removes}”: {change.why}.", 100)]
    for assembly, *ends in board.wires:
        lines += [
            "",
            f"Built as “{assembly}”: a wire joins {ends[0]} and {ends[1]}; crossed-out parts are left out.",
        ]
    return "\n".join(lines)


def draw(board: Board, layout: Mapping[str, Any]) -> tuple[str, str]:
    """Draw a board.

    Parameters
    ----------
    board : Board
    layout : mapping
        Its file of ``data/layout``: table ``schematic`` has the place of each part (of each of its
        units) in steps of 2.54 mm from the upper left corner, and degrees.

    Returns
    -------
    tuple of str
        Texts of the schematic and of the symbols' library.
    """
    sheet = Sheet(board, layout)
    sheet.draw()
    symbols = [
        [Symbol("symbol"), name.partition(":")[2], *symbol[2:]]
        for name, symbol in sorted(sheet.library.items())
    ]
    library = _s(
        "kicad_symbol_lib",
        _s("version", 20241209),
        _s("generator", "kicad_symbol_editor"),
        _s("generator_version", "9.0"),
        *symbols,
    )
    return sheet.text(), write(library) + "\n"
