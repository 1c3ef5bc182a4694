"""Bills of materials: what to buy for boards, LEDs and a lens head, and what it costs.

Prices are those of the thesis's tables 4.3 to 4.5. What has no price there, lenses and screws for
one, is listed without, and the total says what it leaves out.
"""

from __future__ import annotations

import csv
import io
import math
import tomllib
from collections import Counter
from dataclasses import dataclass
from decimal import Decimal
from typing import TYPE_CHECKING, Any, Final

from hardware.boards import DATA
from raytransfer.lenses import CATALOGUE, Lens, SphericalLens

if TYPE_CHECKING:
    from collections.abc import Iterable

    from hardware.boards import Board, Part
    from raytransfer.systems import OpticalSystem


@dataclass(frozen=True)
class Line:
    """One line of a bill.

    Parameters
    ----------
    type : str
    amount : int
    price : Decimal or None
        Euro each; None where it is not known.
    references : tuple of str
        The board's parts.
    package, footprint : str
    optional : bool
        Whether one can do without.
    """

    type: str
    amount: int
    price: Decimal | None = None
    references: tuple[str, ...] = ()
    package: str = ""
    footprint: str = ""
    optional: bool = False

    @property
    def total(self) -> Decimal | None:
        """Euro for all; None where the price is not known."""
        return None if self.price is None else self.price * self.amount

    @property
    def label(self) -> str:
        """The type; what is optional has the thesis's asterisk."""
        return f"{self.type}*" if self.optional else self.type


@dataclass(frozen=True)
class Bill:
    """A bill of materials.

    Parameters
    ----------
    title : str
    lines : tuple of Line
    """

    title: str
    lines: tuple[Line, ...]

    @property
    def total(self) -> Decimal:
        """Euro for everything whose price is known."""
        return sum((line.total for line in self.lines if line.total is not None), Decimal(0))

    @property
    def unpriced(self) -> tuple[str, ...]:
        """Types whose price is not known."""
        return tuple(line.type for line in self.lines if line.price is None)

    def markdown(self) -> str:
        """Write a table as the thesis's, with the total."""
        rows = [f"**{self.title}**", "", "| Type | Amount | Price (Euro) |", "|---|--:|--:|"]
        rows += [f"| {line.label} | {line.amount} | {_euro(line.total)} |" for line in self.lines]
        amount = sum(line.amount for line in self.lines)
        priced = len(self.unpriced) < len(self.lines)
        rows.append(f"| **total** | {amount} | {f'**{_euro(self.total)}**' if priced else ''} |")
        if any(line.optional for line in self.lines):
            rows += ["", "\\* optional"]
        if self.unpriced:
            rows += ["", f"Not in the total, for want of a price: {', '.join(self.unpriced)}."]
        return "\n".join(rows) + "\n"

    def csv(self) -> str:
        """Write all columns as comma-separated values, without the total."""
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(
            ["type", "amount", "price", "total", "optional", "references", "package", "footprint"]
        )
        for line in self.lines:
            writer.writerow(
                [
                    line.type,
                    line.amount,
                    _euro(line.price),
                    _euro(line.total),
                    "yes" if line.optional else "no",
                    " ".join(line.references),
                    line.package,
                    line.footprint,
                ]
            )
        return text.getvalue()


def _euro(price: Decimal | None) -> str:
    return "" if price is None else f"{price:.2f}"


def board_bill(board: Board, *, optional: bool = True) -> Bill:
    """List a board's parts.

    Parameters
    ----------
    board : Board
    optional : bool, optional
        Whether to list parts that the board's first assembly does not need, such as the regulator.

    Returns
    -------
    Bill
        In the order of the board's file, equal parts on one line.
    """
    groups: dict[tuple[str, bool], list[Part]] = {}
    for part in board.parts.values():
        spare = part.only not in {"", board.assemblies[0]}
        if optional or not spare:
            groups.setdefault((part.type.name, spare), []).append(part)
    return Bill(
        board.title,
        tuple(
            Line(
                parts[0].type.type,
                len(parts),
                parts[0].type.price,
                tuple(part.reference for part in parts),
                parts[0].type.package,
                parts[0].type.footprint,
                spare,
            )
            for (_, spare), parts in groups.items()
        ),
    )


def led_bill(amount: int = 1) -> Bill:
    """List what LEDs with their coolers and cables are made of.

    Parameters
    ----------
    amount : int, optional
        LEDs.

    Raises
    ------
    ValueError
        If there are fewer than one.
    """
    if amount < 1:
        raise ValueError(f"amount = {amount}: at least one LED")
    title = _ASSEMBLIES["led"]["title"]
    return Bill(title if amount == 1 else f"{amount} × {title}", _bought("led", amount))


def head_bill(system: OpticalSystem) -> Bill:
    """List the lenses and screws of a head; windows belong to the sensor, screens are printed.

    Parameters
    ----------
    system : OpticalSystem
    """
    lenses = Counter(
        element for element in system.elements if isinstance(element, Lens | SphericalLens)
    )
    amounts: Counter[str] = Counter()
    for lens, amount in lenses.items():
        amounts[f"lens {_bought_as(lens)}"] += amount
    lines = tuple(Line(name, amount) for name, amount in amounts.items())
    return Bill(f"{_ASSEMBLIES['head']['title']}: {system.name}", lines + _bought("head"))


def _bought_as(lens: Lens | SphericalLens) -> str:
    """Name the catalogue's lens beside the thesis's, which has the same size and rounds the radius."""
    if lens.part in CATALOGUE or not isinstance(lens, Lens):
        return lens.part
    same = [
        part
        for part, listed in CATALOGUE.items()
        if (listed.height, listed.length) == (lens.height, lens.length)
        and math.isclose(listed.radius, lens.radius, rel_tol=0.01)
    ]
    return f"{lens.part} ({', '.join(same)})" if same else lens.part


def summary(bills: Iterable[Bill]) -> str:
    """Write bills one below the other, and what they cost together.

    Parameters
    ----------
    bills : iterable of Bill

    Returns
    -------
    str
        Markdown.
    """
    bills = list(bills)
    total = sum((bill.total for bill in bills), Decimal(0))
    text = "\n".join(bill.markdown() for bill in bills) + f"\n**All together: {_euro(total)} €**"
    unpriced = dict.fromkeys(name for bill in bills for name in bill.unpriced)
    return text + (f", without {', '.join(unpriced)}\n" if unpriced else "\n")


def _bought(name: str, times: int = 1) -> tuple[Line, ...]:
    return tuple(
        Line(row["type"].format(**_MECHANICS), times * row["amount"], row.get("price"))
        for row in _ASSEMBLIES[name]["lines"]
    )


_ASSEMBLIES: Final[dict[str, Any]] = tomllib.loads(
    (DATA / "assemblies.toml").read_text(encoding="utf-8"), parse_float=Decimal
)
_MECHANICS: Final[dict[str, Any]] = tomllib.loads(
    (DATA / "mechanics.toml").read_text(encoding="utf-8")
)
