"""The printed circuit boards as data: parts, nets, connectors.

A board is a file of ``data/boards``. The file of a variant names its base and lists changes, each
with the hazard it removes. `BOARDS` has all of them. What a part is stands in ``data/parts.toml``,
where the other ends of the connectors are in ``acquisition/wiring.toml``;
`hardware.electrical.check_board` says what is wrong with a board.
"""

from __future__ import annotations

import math
import tomllib
from dataclasses import dataclass, field, replace
from decimal import Decimal
from functools import cached_property
from importlib.resources import files
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final, NamedTuple, Self

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping


DATA: Final = files("hardware") / "data"
"""The room's data files."""

SURROUNDINGS: Final[Mapping[str, Any]] = MappingProxyType(
    tomllib.loads((DATA / "surroundings.toml").read_text(encoding="utf-8"))
)
"""What the boards are connected to; meanings in ``data/surroundings.toml``."""


class BoardError(ValueError):
    """A board's file names what is not there."""


class Terminal(NamedTuple):
    """One pin of one part.

    Parameters
    ----------
    reference : str
        Of the part: U1.
    number : str
        Of the pin.
    """

    reference: str
    number: str

    def __str__(self) -> str:
        """As in a board's file: U1.21."""
        return f"{self.reference}.{self.number}"

    @classmethod
    def read(cls, text: str) -> Self:
        """Read U1.21."""
        reference, _, number = text.partition(".")
        return cls(reference, number)


class PartPin(NamedTuple):
    """Name and function of a pin; meanings in ``data/parts.toml``."""

    name: str
    function: str


@dataclass(frozen=True)
class PartType:
    """A type of part; meanings in ``data/parts.toml``.

    Parameters
    ----------
    name : str
        Its key there.
    type : str
        As bills of materials call it.
    kind : str
    package, footprint : str
        The footprint is a name of KiCad's libraries.
    pins : tuple of PartPin
        Pin 1 first.
    value : float or None
        Ohm or farad.
    price : Decimal or None
        Euro each; None where it is not known.
    limits, spice : mapping
    """

    name: str
    type: str
    kind: str
    package: str
    footprint: str
    pins: tuple[PartPin, ...]
    value: float | None = None
    price: Decimal | None = None
    limits: Mapping[str, Any] = field(default_factory=dict)
    spice: Mapping[str, Any] = field(default_factory=dict)

    @property
    def amount(self) -> float:
        """The value of a part that must have one.

        Raises
        ------
        BoardError
            If it has none.
        """
        if not self.value:
            raise BoardError(f"{self.name} of parts.toml has no value")
        return self.value


@dataclass(frozen=True)
class Part:
    """A part of a board.

    Parameters
    ----------
    reference : str
    type : PartType
    note : str
        What it is there for.
    only : str
        The assembly in which alone it is fitted; empty if in all.
    """

    reference: str
    type: PartType
    note: str = ""
    only: str = ""


@dataclass(frozen=True)
class Connector:
    """What the pins of a connector are called.

    Parameters
    ----------
    reference : str
        Of the part.
    to : str
        What is plugged in.
    pins : tuple of (str, str)
        Pin 1 first: name, and the pin of the microcontroller or the supply at the far end; empty
        where there is none.
    wiring : str
        The board's name in ``acquisition/wiring.toml``; empty if its wires are not there.
    """

    reference: str
    to: str
    pins: tuple[tuple[str, str], ...]
    wiring: str = ""


@dataclass(frozen=True)
class Change:
    """One difference between a variant and its base.

    Parameters
    ----------
    removes : str
        Name of the check whose hazard it removes.
    why : str
    """

    removes: str
    why: str


@dataclass(frozen=True)
class Board:
    """A board as its file describes it.

    Parameters
    ----------
    name : str
        Of the file.
    title, notes : str
    parts : mapping of str to Part
    nets : mapping of str to tuple of Terminal
    no_connect : tuple of Terminal
    connectors : mapping of str to Connector
    supplies : mapping of str to float
        V of the nets that a connector brings, by net and name of the connector's pin.
    assemblies : tuple of str
        Ways to fit the parts; the first is the one that was built.
    wires : tuple of (str, Terminal, Terminal)
        Assembly, and the two pins that a wire joins in it.
    base : str
        The variant's base, or empty.
    changes : tuple of Change
        From its base.
    """

    name: str
    title: str
    notes: str
    parts: Mapping[str, Part]
    nets: Mapping[str, tuple[Terminal, ...]]
    no_connect: tuple[Terminal, ...]
    connectors: Mapping[str, Connector]
    supplies: Mapping[str, float]
    assemblies: tuple[str, ...]
    wires: tuple[tuple[str, Terminal, Terminal], ...] = ()
    base: str = ""
    changes: tuple[Change, ...] = ()

    @property
    def leds(self) -> tuple[Connector, ...]:
        """Connectors that LEDs are plugged into."""
        return tuple(plug for plug in self.connectors.values() if plug.to.startswith("LED "))

    def netlist(self, assembly: str | None = None) -> Netlist:
        """Return what is connected once the parts are fitted.

        Parameters
        ----------
        assembly : str, optional
            One of `assemblies`; left out, the first.

        Raises
        ------
        ValueError
            If there is no such assembly.
        """
        assembly = assembly or self.assemblies[0]
        if assembly not in self.assemblies:
            raise ValueError(f"assembly {assembly!r}: {self.name} has {', '.join(self.assemblies)}")
        return Netlist(self, assembly)


class Netlist:
    """The nets of one assembly of a board: parts left out are gone, wires have joined nets.

    Parameters
    ----------
    board : Board
    assembly : str
    """

    def __init__(self, board: Board, assembly: str) -> None:
        self.board = board
        self.assembly = assembly
        self.parts: Mapping[str, Part] = {
            reference: part
            for reference, part in board.parts.items()
            if part.only in {"", assembly}
        }
        nets = {name: dict.fromkeys(terminals) for name, terminals in board.nets.items()}
        for when, *ends in board.wires:
            joined = [name for name, net in nets.items() if not net.keys().isdisjoint(ends)]
            if when == assembly:
                for gone in joined[1:]:
                    nets[joined[0]] |= nets.pop(gone)
        self.nets: Mapping[str, tuple[Terminal, ...]] = {
            name: tuple(end for end in net if end.reference in self.parts)
            for name, net in nets.items()
        }

    @cached_property
    def _net_of(self) -> dict[Terminal, str]:
        return {end: name for name, net in self.nets.items() for end in net}

    def of_kind(self, *kinds: str) -> Iterator[Part]:
        """Yield the fitted parts of some kinds."""
        return (part for part in self.parts.values() if part.type.kind in kinds)

    def pin(self, terminal: Terminal) -> PartPin:
        """Return name and function of a pin."""
        return self.parts[terminal.reference].type.pins[int(terminal.number) - 1]

    def net(self, terminal: Terminal) -> str:
        """Return the net of a pin, or an empty string."""
        return self._net_of.get(terminal, "")

    def at(self, part: Part, name: str) -> str:
        """Return the net of a part's first pin of a name, or an empty string."""
        return next(net for pin, _, net in self.pins(part) if pin.name == name)

    def pins(self, part: Part) -> tuple[tuple[PartPin, Terminal, str], ...]:
        """Return every pin of a part, where it is, and its net (or an empty string)."""
        return self._pins[part.reference]

    @cached_property
    def _pins(self) -> dict[str, tuple[tuple[PartPin, Terminal, str], ...]]:
        return {
            reference: tuple(
                (pin, end, self.net(end))
                for number, pin in enumerate(part.type.pins, start=1)
                for end in [Terminal(reference, str(number))]
            )
            for reference, part in self.parts.items()
        }

    def across(self, net: str, *kinds: str) -> Iterator[tuple[Part, str]]:
        """Yield the two-pin parts of some kinds on a net, and the net at their other end."""
        for end in self.nets.get(net, ()):
            part = self.parts[end.reference]
            if part.type.kind in kinds and len(part.type.pins) == 2:
                yield part, self.net(Terminal(end.reference, "21"[int(end.number) - 1]))

    def near(self, net: str, most: float = math.inf) -> set[str]:
        """Return the net itself and those behind one resistor of at most some ohm."""
        resistors = self.across(net, "resistor")
        return {net, *(other for part, other in resistors if part.type.amount <= most)}

    def labels(self, net: str) -> list[tuple[Connector, str, str]]:
        """Return the connectors' pins on a net: connector, name, far end."""
        return [
            (connector, *connector.pins[int(end.number) - 1])
            for end in self.nets.get(net, ())
            if (connector := self.board.connectors.get(end.reference))
        ]

    def plugged(self, connector: Connector, name: str) -> str:
        """Return the net of a connector's pin of a name, or an empty string."""
        names = [label for label, _ in connector.pins]
        return self.net(Terminal(connector.reference, str(names.index(name) + 1)))

    @cached_property
    def _brought(self) -> Mapping[str, float]:
        return {
            net: self.board.supplies[name]
            for net in self.nets
            for _, name, _ in self.labels(net)
            if name in self.board.supplies
        }

    @cached_property
    def volts(self) -> Mapping[str, float]:
        """V of every supply net: what connectors bring, and what a regulator makes of it."""
        made = {}
        for part in self.of_kind("regulator"):
            if share := self.share(self.at(part, "OUT"), self.at(part, "ADJ")):
                made[self.at(part, "OUT")] = part.type.limits["reference"] / share
        return {**made, **self._brought}

    def grounded(self, net: str) -> bool:
        """Whether a net is ground."""
        return self._brought.get(net) == 0.0

    def supply(self, net: str) -> float:
        """Return V of a positive supply net, else 0."""
        return self.volts.get(net, 0.0)

    def share(self, top: str, tap: str) -> float:
        """Tell which share of its volts resistors from one net to another and to ground leave."""
        if top == tap:
            return 1.0
        resistors = list(self.across(tap, "resistor"))
        upper = sum(1 / part.type.amount for part, net in resistors if net == top)
        lower = sum(1 / part.type.amount for part, net in resistors if self.grounded(net))
        return upper / (upper + lower) if upper else 0.0


# --- reading -------------------------------------------------------------------------------------


def read_parts(text: str) -> dict[str, PartType]:
    """Read types of parts from the text of a parts.toml."""
    exact = tomllib.loads(text, parse_float=Decimal)
    types = {}
    for name, row in tomllib.loads(text).items():
        pins = tuple(PartPin(*pin) for pin in row.pop("pins"))
        if "price" in row:
            row["price"] = Decimal(exact[name]["price"])
        types[name] = PartType(name, pins=pins, **row)
    return types


def read_board(
    name: str,
    text: str,
    *,
    bases: Mapping[str, Board] = MappingProxyType({}),
    types: Mapping[str, PartType] | None = None,
    without: str = "",
) -> Board:
    """Read a board, or a variant of one.

    Parameters
    ----------
    name : str
    text : str
        TOML, as in ``data/boards``.
    bases : mapping of str to Board, optional
        Where a variant finds its base.
    types : mapping of str to PartType, optional
        Left out, `PART_TYPES`.
    without : str, optional
        Leave out the change that removes this hazard.

    Raises
    ------
    BoardError
        A part, pin, net or base is named that does not exist.
    """
    data = tomllib.loads(text)
    types = PART_TYPES if types is None else types
    if "base" not in data:
        draft = _Draft({}, {}, [], ["complete"], [])
        supplies, connectors = data["supplies"], data["connectors"]
        draft.change(data | {"add": data["parts"], "connect": data["nets"]}, types)
        draft.no_connect = [Terminal.read(end) for end in data["no_connect"]["pins"]]
        changes: tuple[Change, ...] = ()
    else:
        if data["base"] not in bases:
            raise BoardError(f"{name}: no board is called {data['base']!r}")
        base = bases[data["base"]]
        draft = _Draft(
            dict(base.parts),
            {net: list(ends) for net, ends in base.nets.items()},
            list(base.no_connect),
            list(base.assemblies),
            list(base.wires),
        )
        supplies, connectors = {**base.supplies, **data.get("supplies", {})}, {}
        applied = [change for change in data["changes"] if change["removes"] != without]
        for change in applied:
            draft.change(change, types)
        changes = tuple(Change(change["removes"], change["why"]) for change in applied)
    plugs = {
        reference: Connector(
            reference, row["to"], tuple((a, b) for a, b in row["pins"]), row.get("wiring", "")
        )
        for reference, row in connectors.items()
    } or dict(base.connectors)
    board = Board(
        name,
        data["title"],
        data["notes"].strip(),
        MappingProxyType(draft.parts),
        MappingProxyType({net: tuple(ends) for net, ends in draft.nets.items()}),
        tuple(draft.no_connect),
        MappingProxyType(plugs),
        MappingProxyType(supplies),
        tuple(draft.assemblies),
        tuple(draft.wires),
        data.get("base", ""),
        changes,
    )
    _check_names(board)
    return board


@dataclass
class _Draft:
    """A board while its file is read."""

    parts: dict[str, Part]
    nets: dict[str, list[Terminal]]
    no_connect: list[Terminal]
    assemblies: list[str]
    wires: list[tuple[str, Terminal, Terminal]]

    def change(self, row: Mapping[str, Any], types: Mapping[str, PartType]) -> None:
        """Do what a [[changes]] says; the keys in the order in which they take effect."""
        for reference in row.get("remove", ()):
            part = self.parts.pop(self._known(reference))
            self._drop({Terminal(reference, str(n + 1)) for n in range(len(part.type.pins))})
        for reference in row.get("refit", ()):
            self.parts[reference] = replace(self.parts[self._known(reference)], only="")
        for reference, name in row.get("replace", {}).items():
            old = self.parts[self._known(reference)]
            self.parts[reference] = replace(old, type=_type(types, name))
        for reference, part in row.get("add", {}).items():
            made = _type(types, part["part"])
            self.parts[reference] = Part(
                reference, made, part.get("note", ""), part.get("only", "")
            )
        self._drop(set(map(Terminal.read, row.get("disconnect", ()))))
        for old_name, new in row.get("rename", {}).items():
            self.nets = {new if net == old_name else net: ends for net, ends in self.nets.items()}
        for gone, kept in row.get("merge", {}).items():
            self.nets[kept] += self.nets.pop(gone)
        for net, ends in row.get("connect", {}).items():
            self.nets.setdefault(net, []).extend(map(Terminal.read, ends))
        if "assemblies" in row:
            self.assemblies = list(row["assemblies"])
            self.wires = [
                (wire["assembly"], *(Terminal.read(end) for end in wire["ends"]))
                for wire in row["wires"]
            ]

    def _known(self, reference: str) -> str:
        if reference not in self.parts:
            raise BoardError(f"no part is called {reference}")
        return reference

    def _drop(self, gone: set[Terminal]) -> None:
        nets = {net: [end for end in ends if end not in gone] for net, ends in self.nets.items()}
        self.nets = {net: ends for net, ends in nets.items() if ends}
        self.no_connect = [end for end in self.no_connect if end not in gone]


def _type(types: Mapping[str, PartType], name: str) -> PartType:
    if name not in types:
        raise BoardError(f"no part of parts.toml is called {name!r}")
    return types[name]


def _check_names(board: Board) -> None:
    ends = [(net, end) for net, terminals in board.nets.items() for end in terminals]
    ends += [("no_connect", end) for end in board.no_connect]
    ends += [(f"wire {assembly}", end) for assembly, *both in board.wires for end in both]
    for where, end in ends:
        part = board.parts.get(end.reference)
        if part is None or not end.number.isdecimal():
            raise BoardError(f"{board.name}: {where}: no part has the pin {end}")
        if not 1 <= int(end.number) <= len(part.type.pins):
            raise BoardError(f"{board.name}: {where}: {part.type.type} has no pin {end.number}")
    for reference, connector in board.connectors.items():
        if reference not in board.parts:
            raise BoardError(f"{board.name}: connector {reference} is no part")
        if len(connector.pins) != len(board.parts[reference].type.pins):
            raise BoardError(
                f"{board.name}: {reference} has {len(board.parts[reference].type.pins)} pins, "
                f"{len(connector.pins)} are named"
            )
    for part in board.parts.values():
        if part.only not in {"", *board.assemblies}:
            raise BoardError(f"{board.name}: {part.reference}: no assembly {part.only!r}")


def _load() -> dict[str, Board]:
    texts = {
        path.name.removesuffix(".toml"): path.read_text(encoding="utf-8")
        for path in sorted((DATA / "boards").iterdir(), key=lambda path: path.name)
        if path.name.endswith(".toml")
    }
    boards: dict[str, Board] = {}
    for name in sorted(texts, key=lambda name: "base" in tomllib.loads(texts[name])):
        boards[name] = read_board(name, texts[name], bases=boards)
    return boards


PART_TYPES: Final[Mapping[str, PartType]] = MappingProxyType(
    read_parts((DATA / "parts.toml").read_text(encoding="utf-8"))
)
"""Types of parts by name."""

BOARDS: Final[Mapping[str, Board]] = MappingProxyType(_load())
"""Boards by the name of their file, bases first."""
