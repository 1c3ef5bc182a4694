"""One pin changes in wiring.toml, and everything else that says where it is objects."""

from __future__ import annotations

from pathlib import Path

import pytest

import tests.acquisition.test_wiring as others
from acquisition import wiring
from hardware.boards import BOARDS
from hardware.electrical import check_board

TEXT = Path(wiring.__file__).with_name("wiring.toml").read_text(encoding="utf-8")
FM = '"PB0",  direction = "out",    af = 2, signal = "TIM3_CH3"'
SH = '"PA1",  direction = "out",    af = 1, signal = "TIM2_CH2"'
ICG = '"PA0",  direction = "out",    af = 2, signal = "TIM5_CH1"'
OS = '"PC0",  direction = "analog",         signal = "ADC1_IN10"'

PINS = {
    "fM": {FM: '"PA6", direction = "out", af = 2, signal = "TIM3_CH1"'},
    "SH": {SH: '"PB8", direction = "out", af = 2, signal = "TIM4_CH3"'},
    "ICG": {ICG: '"PA7", direction = "out", af = 2, signal = "TIM3_CH2"'},
    "OS": {OS: '"PC1", direction = "analog", signal = "ADC1_IN11"'},
    "SH and ICG swapped": {SH: ICG, ICG: SH},
    "fM and SH swapped": {FM: SH, SH: FM},
}


def objections(text: str, monkeypatch: pytest.MonkeyPatch) -> set[str]:
    """Who objects to a wiring.toml."""
    changed, protocol = wiring.read(text)
    found = {
        name
        for name, board in BOARDS.items()
        if any(not finding.hazard for finding in check_board(board, changed))
    }
    with monkeypatch.context() as patch:
        patch.setattr(wiring, "WIRING", changed)
        patch.setattr(wiring, "PROTOCOL", protocol)
        for name, check in (
            ("header", others.test_header_is_up_to_date),
            ("tables", others.test_readme_is_up_to_date),
        ):
            try:
                check()
            except AssertionError:
                found.add(name)
    return found


def edited(edits: dict[str, str]) -> str:
    text = TEXT
    for number, old in enumerate(edits):
        assert text.count(old) == 1, old
        text = text.replace(old, f"\0{number}\0")
    for number, new in enumerate(edits.values()):
        text = text.replace(f"\0{number}\0", new)
    return text


def test_nobody_objects_to_what_is_there(monkeypatch: pytest.MonkeyPatch) -> None:
    assert objections(TEXT, monkeypatch) == set()


@pytest.mark.parametrize("change", PINS)
def test_sensor_pin(change: str, monkeypatch: pytest.MonkeyPatch) -> None:
    assert objections(edited(PINS[change]), monkeypatch) == {
        "header",
        "tables",
        "tcd1304",
        "tcd1304-improved",
    }


def test_led_pins(monkeypatch: pytest.MonkeyPatch) -> None:
    """They are one port's adjacent pins, so that they move together."""
    edits = {
        f'led{n}      = {{ pin = "PC{n + 4}"': f'led{n} = {{ pin = "PC{n + 3}"' for n in range(6)
    }
    edits['chain_latch  = { pin = "PC3"'] = 'chain_latch  = { pin = "PC9"'
    assert objections(edited(edits), monkeypatch) == {
        "header",
        "tables",
        "led-driver",
        "led-driver-improved",
    }


@pytest.mark.parametrize(
    ("edits", "boards"),
    [
        (
            {'["fM", "fM"]': '["fM", "SH"]', '["SH", "SH"]': '["SH", "fM"]'},
            {"tcd1304", "tcd1304-improved"},
        ),
        (
            {'["led1", "1"]': '["led1", "2"]', '["led0", "2"]': '["led0", "1"]'},
            {"led-driver", "led-driver-improved"},
        ),
        ({'["led0", "2"]': '["led2", "2"]'}, {"led-driver", "led-driver-improved"}),
        ({'["led0", "2"]': '["led0", "8"]'}, {"led-driver", "led-driver-improved"}),
    ],
)
def test_wire_to_another_pin(
    edits: dict[str, str], boards: set[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The microcontroller's pins stay where they are: its header has nothing to object to."""
    assert objections(edited(edits), monkeypatch) == {"tables", *boards}


def test_pin_that_no_board_has(monkeypatch: pytest.MonkeyPatch) -> None:
    edits = {'ready     = { pin = "PB2"': 'ready     = { pin = "PB12"'}
    assert objections(edited(edits), monkeypatch) == {"header", "tables"}
