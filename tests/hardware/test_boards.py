"""The boards as data: what they hold, and that nothing is wrong with them but the known hazards."""

from __future__ import annotations

import pytest

from acquisition.wiring import WIRING
from hardware import boards
from hardware.boards import BOARDS, PART_TYPES, BoardError, Terminal, read_board
from hardware.electrical import check_board

TEXTS = {
    name: (boards.DATA / "boards" / f"{name}.toml").read_text(encoding="utf-8") for name in BOARDS
}
IMPROVED = {name: board for name, board in BOARDS.items() if board.base}


def hazards(name: str) -> set[str]:
    return {finding.check for finding in check_board(BOARDS[name]) if finding.hazard}


@pytest.mark.parametrize("name", BOARDS)
def test_no_board_has_a_fault(name: str) -> None:
    assert [str(f) for f in check_board(BOARDS[name]) if not f.hazard] == []


def test_every_base_has_an_improved_variant() -> None:
    assert set(BOARDS) == {"tcd1304", "led-driver", *IMPROVED}
    assert {board.base for board in IMPROVED.values()} == {"tcd1304", "led-driver"}


def test_hazards_of_the_boards_as_built() -> None:
    assert hazards("tcd1304") == {
        "logic level",
        "converter range",
        "floating input",
        "master clock",
    }
    assert hazards("led-driver") == {
        "series resistor",
        "flyback path",
        "floating input",
        "bulk capacitor",
    }


@pytest.mark.parametrize("name", IMPROVED)
def test_improved_boards_have_no_hazard(name: str) -> None:
    assert check_board(BOARDS[name]) == []


@pytest.mark.parametrize(
    ("name", "removes"),
    [(name, change.removes) for name, board in IMPROVED.items() for change in board.changes],
)
def test_each_change_removes_its_hazard(name: str, removes: str) -> None:
    """Without it, that hazard is back, and no other."""
    board = read_board(name, TEXTS[name], bases=BOARDS, without=removes)
    assert {f.check for f in check_board(board) if f.hazard} == {removes}


@pytest.mark.parametrize("name", IMPROVED)
def test_changes_name_the_hazards_of_the_base(name: str) -> None:
    board = BOARDS[name]
    assert sorted(change.removes for change in board.changes) == sorted(hazards(board.base))
    assert all(change.why for change in board.changes)


def test_parts_of_the_thesis() -> None:
    assert [len(BOARDS[name].parts) for name in ("tcd1304", "led-driver")] == [14, 14]
    assert [len(BOARDS[name].nets) for name in ("tcd1304", "led-driver")] == [15, 14]
    for name in ("tcd1304", "led-driver"):
        assert "figure" in BOARDS[name].notes
        assert all(part.type.price is not None for part in BOARDS[name].parts.values())


def test_regulator_makes_about_4_volts_and_can_be_bypassed() -> None:
    board = BOARDS["tcd1304"]
    regulated, bypassed = board.netlist("regulated"), board.netlist("bypassed")
    assert regulated.supply("VCC") == pytest.approx(1.22 * (1 + 2700 / 1200))
    assert regulated.supply("+5V") == 5.0
    assert bypassed.supply(bypassed.net(Terminal("U1", "1"))) == 5.0
    assert set(regulated.parts) - set(bypassed.parts) == {"U3", "R4", "R5", "C3", "C4"}
    with pytest.raises(ValueError, match="tcd1304 has bypassed, regulated"):
        board.netlist("neither")


def test_connectors_lead_to_the_wiring() -> None:
    """Every wire to a board ends at one of its pins, and carries the name it has there."""
    for board in BOARDS.values():
        (table,) = (t for t in WIRING.connectors if t.other == board.connectors["P1"].wiring)
        named = {name: far for name, far in board.connectors["P1"].pins if far}
        assert named == {
            end: WIRING.pins[net].name if net in WIRING.pins else net for net, end in table.wires
        }


def test_variant_keeps_connectors_but_not_its_base() -> None:
    for board in IMPROVED.values():
        assert board.connectors == BOARDS[board.base].connectors
        assert board.parts != BOARDS[board.base].parts
    assert "R6" not in BOARDS["tcd1304"].parts


@pytest.mark.parametrize(
    ("name", "old", "new", "message"),
    [
        ("tcd1304", '"Q1.3"]', '"Q1.4"]', "2SA1015 transistor has no pin 4"),
        ("tcd1304", '"Q1.3"]', '"Q9.3"]', "no part has the pin Q9.3"),
        ("tcd1304", '"Q1.3"]', '"Q1"]', "no part has the pin Q1."),
        ("tcd1304", 'part = "2SA1015"', 'part = "2SC1815"', "is called '2SC1815'"),
        ("tcd1304", '["GND", "GND"]]', '["GND", "GND"], ["", ""]]', "6 pins, 7 are named"),
        ("tcd1304", "[connectors.P1]", "[connectors.P2]", "connector P2 is no part"),
        ("tcd1304", 'U3 = { part = "LT1761-BYP", note = "about 4 V from 5 V", only = "regulated"',
         'U3 = { part = "LT1761-BYP", only = "never"', "no assembly 'never'"),
        ("tcd1304-improved", 'base = "tcd1304"', 'base = "tcd1703"', "no board is called"),
        ("tcd1304-improved", 'refit = ["C4"]', 'refit = ["C9"]', "no part is called C9"),
    ],
)  # fmt: skip
def test_names_that_are_not_there(name: str, old: str, new: str, message: str) -> None:
    assert TEXTS[name].count(old) == 1
    with pytest.raises(BoardError, match=message.replace("[", r"\[")):
        read_board(name, TEXTS[name].replace(old, new), bases=BOARDS)


def test_sensor_has_the_datasheets_pins() -> None:
    """The pins that have a function, as two open boards number them, too."""
    pins = {n: pin.name for n, pin in enumerate(PART_TYPES["TCD1304"].pins, start=1)}
    assert len(pins) == 22
    assert {n: name for n, name in pins.items() if name != "NC"} == {
        1: "VDD", 2: "VAD", 3: "ICG", 4: "fM", 5: "SH", 21: "OS", 22: "SS"
    }  # fmt: skip


def test_parts_are_complete() -> None:
    used = {part.type.name for board in BOARDS.values() for part in board.parts.values()}
    assert used == set(PART_TYPES)
    for part in PART_TYPES.values():
        assert part.footprint.count(":") == 1
        assert {pin.function for pin in part.pins} <= {
            "passive", "input", "output", "supply", "ground", "regulated", "nc"
        }  # fmt: skip
        if part.kind in {"resistor", "capacitor", "polarised capacitor"}:
            assert part.amount > 0


def test_what_is_missing_in_a_part() -> None:
    with pytest.raises(BoardError, match=r"2SA1015 of parts\.toml has no value"):
        _ = PART_TYPES["2SA1015"].amount
