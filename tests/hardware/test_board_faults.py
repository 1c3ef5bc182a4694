"""Faults put into the boards' data on purpose: each is found, by the check that is there for it."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from acquisition import wiring
from hardware import boards
from hardware.boards import BOARDS, read_board
from hardware.electrical import check_board

if TYPE_CHECKING:
    from hardware.boards import Terminal

WIRING_TEXT = Path(wiring.__file__).with_name("wiring.toml").read_text(encoding="utf-8")

# name of the fault: board, what to replace in its file, the check that finds it, and where
FAULTS = {
    "emitter and collector swapped": (
        "tcd1304",
        {'OS = ["Q1.1"': 'OS = ["Q1.2"', 'collector = ["Q1.2"': 'collector = ["Q1.1"'},
        ("transistor legs", "Q1"),
    ),
    "emitter and base swapped": (
        "tcd1304",
        {'OS = ["Q1.1"': 'OS = ["Q1.3"', '"R1.2", "Q1.3"': '"R1.2", "Q1.1"'},
        ("transistor legs", "Q1"),
    ),
    "collector and base swapped": (
        "tcd1304",
        {'collector = ["Q1.2"': 'collector = ["Q1.3"', '"R1.2", "Q1.3"': '"R1.2", "Q1.2"'},
        ("transistor legs", "Q1"),
    ),
    "gate and source swapped": (
        "led-driver",
        {'"P1.3", "Q3.1"': '"P1.3", "Q3.3"', '"Q3.3", "Q4.3"': '"Q3.1", "Q4.3"'},
        ("transistor legs", "Q3"),
    ),
    "drain and source swapped": (
        "led-driver",
        {'"Q3.2", "J3.2"': '"Q3.3", "J3.2"', '"Q3.3", "Q4.3"': '"Q3.2", "Q4.3"'},
        ("transistor legs", "Q3"),
    ),
    "pin on two nets": ("tcd1304", {'"P1.2", "U2.3"': '"P1.2", "U2.3", "U2.1"'}, ("short", "U2.1")),
    "clocks joined": (
        "tcd1304",
        {'fM = ["P1.1", "U2.1"]': 'fM = ["P1.1", "U2.1", "P1.2"]', '"P1.2", "U2.3"': '"U2.3"'},
        ("short", "fM"),
    ),
    "supply joined to ground": (
        "tcd1304",
        {'GND = ["P1.6"': 'GND = ["P1.6", "P1.5"', '"P1.5", "U3.1"': '"U3.1"'},
        ("short", "GND"),
    ),
    "bridged resistor": (
        "tcd1304",
        {'["U1.21", "R1.1"]': '["U1.21", "R1.1", "R1.2"]', '"R1.2", "Q1.3"': '"Q1.3"'},
        ("short", "R1"),
    ),
    "open net": ("tcd1304", {'["R1.2", "Q1.3"]': '["R1.2"]'}, ("open net", "base")),
    "open net with the regulator": (
        "tcd1304",
        {'BYP = ["U3.3", "C3.1"]': 'BYP = ["U3.3"]'},
        ("open net", "BYP"),
    ),
    "pin left out": ("tcd1304", {', "Q1.3"]': "]"}, ("unconnected pin", "Q1.3")),
    "marked as unconnected, but is not": (
        "tcd1304",
        {'["U2.8",': '["U2.9", "U2.8",'},
        ("unconnected pin", "U2.9"),
    ),
    "wrong pin of the sensor": (
        "tcd1304",
        {'["U1.21", "R1.1"]': '["U1.20", "R1.1"]', '"U1.20", "U2.7"': '"U1.21", "U2.7"'},
        ("sensor pin", "U1.21"),
    ),
    "clock on a pin without function": (
        "tcd1304",
        {'"U2.4", "U1.5"': '"U2.4", "U1.6"', '"U1.22", "U1.6"': '"U1.22", "U1.5"'},
        ("sensor pin", "U1.5"),
    ),
    "SH and ICG swapped at the sensor": (
        "tcd1304",
        {'"U2.4", "U1.5"': '"U2.4", "U1.3"', '"U2.6", "U1.3"': '"U2.6", "U1.5"'},
        ("sensor pin", "U1.3"),
    ),
    "inverter the wrong way round": (
        "tcd1304",
        {'"P1.1", "U2.1"': '"P1.1", "U2.2"', '["U2.2", "U1.4"]': '["U2.1", "U1.4"]'},
        ("sensor pin", "U1.4"),
    ),
    "two outputs joined": (
        "tcd1304",
        {'"U2.6", "U1.3"]': '"U2.6", "U1.3", "U2.8"]', '["U2.8", ': "["},
        ("drivers", "ICG_inverted"),
    ),
    "inverter's output on the microcontroller's": (
        "tcd1304",
        {'["P1.1", "U2.1"]': '["P1.1", "U2.1", "U2.8"]', '["U2.8", ': "["},
        ("drivers", "fM"),
    ),
    "regulator and its bypass": (
        "tcd1304",
        {'"about 4 V from 5 V", only = "regulated"': '"about 4 V from 5 V"'},
        ("drivers", "+5V"),
    ),
    "supply reversed": (
        "tcd1304",
        {'"U2.14", "R3.1"': '"U2.7", "R3.1"', '"U2.7", "U2.9"': '"U2.14", "U2.9"'},
        ("supply", "U2.14"),
    ),
    "missing ground": (
        "tcd1304",
        {'"U1.22", "U1.6"': '"U1.6"', '["U2.8",': '["U1.22", "U2.8",'},
        ("supply", "U1.22"),
    ),
    "regulator's resistors swapped": (
        "tcd1304",
        {'part = "resistor-2k7"': 'part = "resistor-1k2"', 'part = "resistor-1k2"': 'part = "resistor-2k7"'},
        ("supply", "U1.1"),
    ),
    "regulator asked for more than it is given": (
        "tcd1304",
        {'R4 = { part = "resistor-2k7"': 'R4 = { part = "resistor-6k8"'},
        ("regulator", "U3"),
    ),
    "74HCT04 from 4 V": ("tcd1304", {"SN74HC04": "SN74HCT04"}, ("supply", "U2.14")),
    "floating inverter": (
        "tcd1304",
        {'"U2.9", ': "", '["U2.8",': '["U2.9", "U2.8",'},
        ("floating input", "U2.9"),
    ),
    "missing decoupling": (
        "tcd1304",
        {'C2 = { part = "capacitor-100n"': 'C2 = { part = "capacitor-10n"'},
        ("decoupling", "VCC"),
    ),
    "electrolytic capacitor reversed": (
        "tcd1304",
        {'"C4.2"': '"C4.1"', '"C4.1", "R4.1"': '"C4.2", "R4.1"'},
        ("polarity", "C4"),
    ),
    "connector's nets in the wrong order": (
        "tcd1304",
        {'"P1.1", "U2.1"': '"P1.2", "U2.1"', '"P1.2", "U2.3"': '"P1.1", "U2.3"'},
        ("sensor pin", "U1.4"),
    ),
    "connector's names in the wrong order": (
        "tcd1304",
        {'["SH", "PA1"], ["ICG", "PA0"]': '["ICG", "PA0"], ["SH", "PA1"]'},
        ("sensor pin", "U1.5"),
    ),
    "connector's names swapped, not its wires": (
        "tcd1304",
        {'["SH", "PA1"], ["ICG", "PA0"]': '["SH", "PA0"], ["ICG", "PA1"]'},
        ("wiring", "P1.2"),
    ),
    "wire without a pin": ("tcd1304", {'["OS", "PC0"]': '["Os", "PC0"]'}, ("wiring", "P1")),
    "clock loaded with a small resistor": (
        "tcd1304-improved",
        {'R8 = { part = "resistor-10k"': 'R8 = { part = "resistor-150"'},
        ("drivers", "fM"),
    ),
    "gate pulled up": (
        "led-driver-improved",
        {'"R7.2", "R8.2"': '"R8.2"', '["R7.1"]': '["R7.1"], "+LED" = ["R7.2"]'},
        ("drivers", "gate1"),
    ),
    "divider's resistors swapped": (
        "tcd1304-improved",
        {'part = "resistor-2k2"': 'part = "resistor-6k8"', 'part = "resistor-6k8"': 'part = "resistor-2k2"'},
        ("converter range", "OS"),
    ),
    "no 5 V at the sensor's other supply": (
        "tcd1304",
        {'"U1.1", "U1.2", "U2.14"': '"U1.1", "U2.14"', '"P1.6", "U1.22"': '"P1.6", "U1.2", "U1.22"'},
        ("supply", "U1.2"),
    ),
    "grounds apart": (
        "led-driver",
        {'GND = ["P1.7", "J7.2", "Q1.3"': 'ground = ["J7.2", "Q1.3"', '"P1.1", "Q1.1"]': '"P1.1", "Q1.1"]\nGND = ["P1.7", "Q6.3"]', ', "Q6.3"]': "]"},
        ("supply", "GND"),
    ),
    "LEDs out of order": (
        "led-driver",
        {'"P1.1", "Q1.1"': '"P1.2", "Q1.1"', '"P1.2", "Q2.1"': '"P1.1", "Q2.1"'},
        ("LED order", "Q1"),
    ),
    "LED reversed": (
        "led-driver",
        {'"J4.1"': '"J4.2"', '"Q4.2", "J4.2"': '"Q4.2", "J4.1"'},
        ("LED order", "J4"),
    ),
    "LEDs' supply reversed": (
        "led-driver",
        {'"P1.7", "J7.2"': '"P1.7", "J7.1"', '["J7.1",': '["J7.2",'},
        ("short", "GND"),
    ),
    "two LEDs on one transistor": (
        "led-driver",
        {'"Q1.2", "J1.2"]': '"Q1.2", "J1.2", "J2.2"]', '["Q2.2", "J2.2"]': '["Q2.2"]'},
        ("transistor legs", "Q1"),
    ),
}  # fmt: skip


def changed(name: str, edits: dict[str, str]) -> boards.Board:
    """The board with all edits made at once, so that two can swap what they replace."""
    text = (boards.DATA / "boards" / f"{name}.toml").read_text(encoding="utf-8")
    for number, old in enumerate(edits):
        assert text.count(old) == 1, old
        text = text.replace(old, f"\0{number}\0")
    for number, new in enumerate(edits.values()):
        text = text.replace(f"\0{number}\0", new)
    return read_board(name, text, bases=BOARDS)


@pytest.mark.parametrize("fault", FAULTS)
def test_fault_is_found(fault: str) -> None:
    name, edits, (check, where) = FAULTS[fault]
    found = [finding for finding in check_board(changed(name, edits)) if not finding.hazard]
    assert (check, where) in {finding[:2] for finding in found}, [str(f) for f in found]


def test_an_led_that_is_not_driven_as_the_others() -> None:
    """The simulation takes the first for all."""
    edits = {'R3 = { part = "resistor-3r3"': 'R3 = { part = "resistor-150"'}
    found = check_board(changed("led-driver-improved", edits))
    assert [(f.check, f.where, f.hazard) for f in found] == [("LEDs alike", "LED 3", False)]


def test_flyback_diode_reversed() -> None:
    edits = {'"D2.1"': '"D2.2"', 'cathode2 = ["D2.2"]': 'cathode2 = ["D2.1"]'}
    found = check_board(changed("led-driver-improved", edits))
    assert ("polarity", "D2") in {finding[:2] for finding in found if not finding.hazard}


@pytest.mark.parametrize(
    ("old", "new", "where"),
    [
        ('"PB0",  direction = "out",    af = 2, signal = "TIM3_CH3"', '"PB12", direction = "out"', "fM"),
        ('"PA1",  direction = "out",    af = 1, signal = "TIM2_CH2"',
         '"PA1",  direction = "out", af = 7, signal = "USART2_RTS"', "SH"),
        ('"PC0",  direction = "analog",         signal = "ADC1_IN10"', '"PC0", direction = "in"', "OS"),
    ],
)  # fmt: skip
def test_pin_that_cannot_do_it(old: str, new: str, where: str) -> None:
    """A pin that exists and is free, but has neither the timer nor the converter."""
    assert WIRING_TEXT.count(old) == 1
    other, _ = wiring.read(WIRING_TEXT.replace(old, new))
    found = check_board(BOARDS["tcd1304"], other)
    assert ("pin function", where) in {finding[:2] for finding in found if not finding.hazard}


def test_input_cannot_switch_an_led() -> None:
    text = WIRING_TEXT.replace(
        'led1      = { pin = "PC5",  direction = "out" }',
        'led1      = { pin = "PC5",  direction = "in" }',
    )
    assert text != WIRING_TEXT
    found = check_board(BOARDS["led-driver"], wiring.read(text)[0])
    assert ("pin function", "1") in {finding[:2] for finding in found if not finding.hazard}


def test_inverter_that_wiring_does_not_know() -> None:
    """The firmware drives the sensor as wiring.toml says: through inverters, or not."""
    text = WIRING_TEXT.replace("inverted = true", "inverted = false")
    assert text != WIRING_TEXT
    found = check_board(BOARDS["tcd1304"], wiring.read(text)[0])
    assert {finding.where for finding in found if finding.check == "sensor pin"} == {
        "U1.3",
        "U1.4",
        "U1.5",
    }


def test_board_without_wires() -> None:
    text = WIRING_TEXT.replace('other = "TCD1304 board"', 'other = "another board"')
    found = check_board(BOARDS["tcd1304"], wiring.read(text)[0])
    assert {finding.where for finding in found if finding.check == "wiring"} == {
        f"P1.{number}" for number in range(1, 7)
    }


# where a moved pin does no harm: an input that is not used may be at any supply
HARMLESS = {
    "tcd1304": {f"U2.{n} to {net}" for n in (9, 11, 13) for net in ("+5V", "VCC")},
    "tcd1304-improved": {f"U2.{n} to +5V" for n in (9, 11, 13)},
}


@pytest.mark.parametrize("name", BOARDS)
def test_any_pin_left_out_moved_or_swapped_is_found(name: str) -> None:
    """Every pin on every other net, and with every other of its part."""
    board = BOARDS[name]
    as_built = set(check_board(board))

    def found(nets: dict[str, tuple[Terminal, ...]]) -> bool:
        return bool(set(check_board(replace(board, nets=nets))) - as_built)

    missed = set()
    for net, ends in board.nets.items():
        for end in ends:
            nets = {n: tuple(e for e in rest if e != end) for n, rest in board.nets.items()}
            if not found(nets):
                missed.add(f"without {end}")
            for other in board.nets.keys() - {net}:
                if not found({**nets, other: (*nets[other], end)}):
                    missed.add(f"{end} to {other}")
    of_part = [
        (end, other)
        for end, other in combinations([e for ends in board.nets.values() for e in ends], 2)
        if end.reference == other.reference
        and board.parts[end.reference].type.kind not in {"resistor", "capacitor"}
    ]
    for pair in of_part:
        swap = dict(zip(pair, reversed(pair), strict=True))
        nets = {n: tuple(swap.get(e, e) for e in ends) for n, ends in board.nets.items()}
        if {n: set(e) for n, e in nets.items()} != {n: set(e) for n, e in board.nets.items()} and (
            not found(nets)
        ):
            missed.add(f"{pair[0]} and {pair[1]}")
    assert missed == HARMLESS.get(name, set())
