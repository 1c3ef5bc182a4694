"""What parts cost: the thesis's tables 4.3 to 4.5 to the cent."""

from __future__ import annotations

import csv
import io
from decimal import Decimal

import pytest

from hardware.bill import Bill, Line, board_bill, head_bill, led_bill, summary
from hardware.boards import BOARDS
from raytransfer.designs import DESIGNS

TABLE_4_3 = [
    ("150 Ω resistor", 2, "0.32"),
    ("2200 Ω resistor", 1, "0.12"),
    ("2700 Ω resistor*", 1, "0.19"),
    ("1200 Ω resistor*", 1, "0.12"),
    ("0.1 µF capacitor", 2, "0.30"),
    ("10 nF capacitor*", 1, "0.14"),
    ("10 µF capacitor*", 1, "0.14"),
    ("2SA1015 transistor", 1, "0.04"),
    ("SN74HC04 hex inverter", 1, "0.28"),
    ("TCD1304 linear image sensor", 1, "4.30"),
    ("6-pin strip", 1, "0.40"),
    ("LT1761IS5-BYP LDO*", 1, "3.49"),
]
TABLE_4_4 = [
    ("IRLZ34N transistor", 6, "5.16"),
    ("2-pin strip", 7, "2.03"),
    ("7-pin strip", 1, "0.70"),
]
TABLE_4_5 = ["3.89", "1.13", "1.40", "0.52", "0.90"]


def rows(bill: Bill) -> list[tuple[str, int, str]]:
    return [(line.label, line.amount, f"{line.total}") for line in bill.lines]


def test_table_4_3() -> None:
    bill = board_bill(BOARDS["tcd1304"])
    assert rows(bill) == TABLE_4_3
    assert bill.total == Decimal("9.84")
    assert bill.unpriced == ()


def test_table_4_3_without_regulator() -> None:
    bill = board_bill(BOARDS["tcd1304"], optional=False)
    assert rows(bill) == [row for row in TABLE_4_3 if not row[0].endswith("*")]
    assert bill.total == Decimal("9.84") - Decimal("4.08")
    assert "optional" not in bill.markdown()


def test_table_4_4() -> None:
    bill = board_bill(BOARDS["led-driver"])
    assert rows(bill) == TABLE_4_4
    assert bill.total == Decimal("7.89")
    assert bill == board_bill(BOARDS["led-driver"], optional=False)


def test_table_4_5() -> None:
    assert [f"{line.total}" for line in led_bill().lines] == TABLE_4_5
    assert led_bill().total == Decimal("7.84")
    assert led_bill(6).total == 6 * Decimal("7.84")
    with pytest.raises(ValueError, match="at least one LED"):
        led_bill(0)


@pytest.mark.parametrize("name", BOARDS)
def test_every_part_is_on_one_line(name: str) -> None:
    bill = board_bill(BOARDS[name])
    assert sorted(r for line in bill.lines for r in line.references) == sorted(BOARDS[name].parts)
    assert all(line.amount == len(line.references) for line in bill.lines)


def test_improved_boards_say_what_has_no_price() -> None:
    bill = board_bill(BOARDS["tcd1304-improved"])
    assert set(bill.unpriced) == {
        "SN74HCT04 hex inverter", "1000 Ω resistor", "6800 Ω resistor", "10 kΩ resistor"
    }  # fmt: skip
    assert bill.total == Decimal("0.32") + Decimal("0.12") + Decimal("0.30") + Decimal("0.14") + (
        Decimal("0.04") + Decimal("4.30") + Decimal("0.40")
    )
    assert "Not in the total, for want of a price: " in bill.markdown()


def test_head_of_the_thesis() -> None:
    lines = {line.type: line.amount for line in head_bill(DESIGNS["thesis"].system).lines}
    assert lines.pop("lens PCX_30_32_60 (LJ1430L1)") == 2
    assert lines.pop("lens PCV_15_30_20 (LK1085L2)") == 1
    assert lines.pop("lens PCX_15_30_20 (LJ1328L2)") == 1
    screws = {name: n for name, n in lines.items() if name.endswith("screw")}
    assert {name[:3].strip(): n for name, n in screws.items()} == {"M3": 4, "M2.": 4}


@pytest.mark.parametrize("name", DESIGNS)
def test_every_lens_is_bought(name: str) -> None:
    system = DESIGNS[name].system
    bill = head_bill(system)
    lenses = [e.part for e in system.elements if hasattr(e, "centre_thickness")]
    assert sum(line.amount for line in bill.lines if line.type.startswith("lens ")) == len(lenses)
    assert all(any(lens in line.type for line in bill.lines) for lens in lenses)
    assert bill.total == 0
    assert len(bill.unpriced) == len(bill.lines)


def test_markdown() -> None:
    lines = board_bill(BOARDS["led-driver"]).markdown().splitlines()
    assert lines[0] == "**LED control board**"
    assert lines[4] == "| IRLZ34N transistor | 6 | 5.16 |"
    assert lines[-1] == "| **total** | 14 | **7.89** |"


def test_csv() -> None:
    bill = board_bill(BOARDS["tcd1304"])
    table = list(csv.DictReader(io.StringIO(bill.csv())))
    assert sum(Decimal(row["total"]) for row in table) == bill.total
    assert [row["references"] for row in table if row["optional"] == "yes"] == [
        "R4", "R5", "C3", "C4", "U3"
    ]  # fmt: skip
    assert table[0]["footprint"] == BOARDS["tcd1304"].parts["R1"].type.footprint


def test_summary() -> None:
    bills = [board_bill(BOARDS["tcd1304"]), board_bill(BOARDS["led-driver"]), led_bill(2)]
    text = summary(bills)
    assert text.endswith("**All together: 33.41 €**\n")
    unknown = Bill("rest", (Line("screw", 2),))
    assert summary([*bills, unknown]).endswith("33.41 €**, without screw\n")
