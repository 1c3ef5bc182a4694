"""The boards' circuits in ngspice, beside closed forms and beside each other."""

from __future__ import annotations

import math
import os
import shutil
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hardware import circuits
from hardware.boards import BOARDS, SURROUNDINGS
from hardware.circuits import (
    ELEMENT_TIME,
    SHORTEST_INTEGRATION,
    Measurement,
    NoSimulatorError,
    assumptions,
    check_circuits,
    compare,
    measure,
    settled,
    show,
    simulate,
)
from hardware.electrical import check_board

README = (Path(__file__).parents[2] / "README.md").read_text(encoding="utf-8")

needs_ngspice = pytest.mark.skipif(
    shutil.which("ngspice") is None and not os.environ.get("CI"),
    reason="ngspice is missing: apt install ngspice",
)


@cache
def measured(name: str, assembly: str | None = None) -> dict[str, Measurement]:
    return {m.what: m for m in measure(BOARDS[name], assembly)}


def value(name: str, what: str, assembly: str | None = None) -> float:
    found = measured(name, assembly)
    if what in found:
        return found[what].value
    (key,) = (key for key in found if what in key)
    return found[key].value


def test_without_ngspice(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "/nowhere")
    with pytest.raises(NoSimulatorError, match="apt install ngspice"):
        measure(BOARDS["tcd1304"])


@needs_ngspice
def test_simulator_beside_a_closed_form() -> None:
    deck = ["Vin in 0 PWL(0 0 1n 1)", "Rin in out 1k", "Cout out 0 1n"]
    time, out = simulate(deck, "tran 2n 12u 0 2n", ["v(out)"])
    late = time > 0.1e-6
    exact = 1 - np.exp(-(time[late] - 0.5e-9) / 1e-6)
    np.testing.assert_allclose(out[late], exact, atol=2e-4)
    assert settled(time, out) == pytest.approx(math.log(100) * 1e-6, rel=0.01)


@needs_ngspice
def test_deck_that_cannot_run() -> None:
    with pytest.raises(RuntimeError, match="ngspice failed"):
        simulate(["Vin in 0 1", "Xno in 0 nothing"], "op", ["v(in)"])


def test_settled() -> None:
    time = np.arange(5.0) + 10
    assert settled(time, np.array([0.0, 2.0, 1.1, 1.001, 1.0])) == 3.0
    assert settled(time, np.ones(5)) == 0.0


@needs_ngspice
def test_times_are_those_of_the_link() -> None:
    assert ELEMENT_TIME == 1e-6
    assert SHORTEST_INTEGRATION == 10e-6


@needs_ngspice
def test_output_settles_within_an_element() -> None:
    """About 130 ns at the sensor's highest output resistance; the divider costs some of it."""
    built = value("tcd1304", "sensor's output 1000 Ω")
    assert 100e-9 < built < 160e-9
    assert value("tcd1304", "sensor's output 500 Ω") < built
    assert built < value("tcd1304-improved", "sensor's output 1000 Ω") < ELEMENT_TIME / 2


@needs_ngspice
@pytest.mark.parametrize("dark", [1.5, 2.5, 3.5])
def test_converter_sees_the_follower(dark: float) -> None:
    """An emitter-base voltage above the sensor's output, then the divider."""
    built = value("tcd1304", f"dark level ({dark:g} V)")
    assert built - dark == pytest.approx(0.65, abs=0.05)
    improved = value("tcd1304-improved", f"dark level ({dark:g} V)")
    assert improved == pytest.approx(6.8 / 9.0 * built, abs=0.05)


@needs_ngspice
def test_converter_range() -> None:
    assert 4.0 < value("tcd1304", "highest dark level") < 4.2
    assert value("tcd1304-improved", "highest dark level") < 3.3
    assert value("tcd1304", "gain") == pytest.approx(1.0, abs=0.02)
    assert value("tcd1304-improved", "gain") == pytest.approx(6.8 / 9.0, abs=0.02)
    # the thesis's 12-bit captures: 3915 to 3930 counts in the dark
    assert value("tcd1304", "typical dark level") / 3.3 * 4095 == pytest.approx(3920, abs=30)


@needs_ngspice
@pytest.mark.parametrize(
    ("name", "assembly", "level"),
    [
        ("tcd1304", "bypassed", 3.5),
        ("tcd1304", "regulated", 0.7 * 1.22 * (1 + 2700 / 1200)),
        ("tcd1304-improved", "complete", 2.0 * (1 + 50 / 10e3)),  # 10 kΩ load the output
    ],
)
def test_logic_level(name: str, assembly: str, level: float) -> None:
    for net in ("fM", "SH", "ICG"):
        assert value(name, f"{net} is surely high from", assembly) == pytest.approx(
            level, abs=0.002
        )


@needs_ngspice
def test_led_current_beside_ohms_law() -> None:
    """Supply less the LED's junction, over all resistances in the loop."""
    cable = SURROUNDINGS["cable"]
    for name, volts, series in (("led-driver", 5.0, 0.0), ("led-driver-improved", 9.0, 3.3)):
        ohm = 0.25 + cable["metres"] * cable["ohm_per_metre"] + 0.065 + 0.05 + series
        assert value(name, "LED current") == pytest.approx((volts - 2.95) / ohm, rel=0.03)


def test_led_names() -> None:
    assert [show(m) for m in (
        Measurement("", "", 1.3e-7, "s", math.nan, ""),
        Measurement("", "", 0.12, "", math.nan, ""),
        Measurement("", "", 56.2, "V", math.nan, ""),
    )] == ["130 ns", "12 %", "56.2 V"]  # fmt: skip


@needs_ngspice
def test_led_current_rises_within_an_integration() -> None:
    """Its time constant is L/R: 5 µH and about 1 Ω as built, four times that improved."""
    built, improved = (
        value(name, "rises to 99 %") for name in ("led-driver", "led-driver-improved")
    )
    assert 18e-6 < built < 28e-6
    assert improved < SHORTEST_INTEGRATION
    assert value("led-driver", "light of 10 µs") < 0.6
    assert value("led-driver-improved", "light of 10 µs") > 0.8


@needs_ngspice
def test_drain_at_switch_off() -> None:
    """The breakdown as built, a diode's drop above the supply improved."""
    assert 55.0 < value("led-driver", "switch-off") < 58.0
    assert 9.0 < value("led-driver-improved", "switch-off") < 10.5


@needs_ngspice
def test_hazards_are_those_of_the_netlist() -> None:
    """What can be seen in parts alone, the simulation sees, too; the rest it cannot."""
    unseen = {"floating input", "bulk capacitor", "master clock"}
    for name in ("tcd1304", "led-driver"):
        static = {finding.check for finding in check_board(BOARDS[name])} - unseen
        found = check_circuits(BOARDS[name])
        assert {finding.check for finding in found} == static
        assert all(finding.hazard for finding in found)


@needs_ngspice
@pytest.mark.parametrize("name", [name for name, board in BOARDS.items() if board.base])
def test_improved_boards_keep_within_all_limits(name: str) -> None:
    assert [str(finding) for finding in check_circuits(BOARDS[name])] == []


@needs_ngspice
def test_values_of_the_board_are_those_of_the_deck() -> None:
    """A weaker load of the follower settles slower, and is found where it is too slow."""
    board = BOARDS["tcd1304"]
    load = board.parts["R3"]
    slow = replace(load, type=replace(load.type, value=100e3))
    changed = replace(board, parts={**board.parts, "R3": slow})
    found = {m.what: m for m in measure(changed) if m.check == "settling"}
    assert not any(m.holds for m in found.values())
    assert all(measured("tcd1304")[what].holds for what in found)


@needs_ngspice
@pytest.mark.parametrize(
    ("name", "part", "values", "check", "limit"),
    [
        ("tcd1304-improved", "R6", {"value": 6800.0}, "gain", "60 %"),
        ("led-driver-improved", "R1", {"value": 10.0, "limits": {}}, "series resistor", "900 mA"),
        ("led-driver-improved", "R1", {"limits": {}}, "power", "250 mW"),
    ],
)
def test_values_that_are_too_small_or_too_weak(
    name: str, part: str, values: dict[str, Any], check: str, limit: str
) -> None:
    board = BOARDS[name]
    other = replace(board.parts[part], type=replace(board.parts[part].type, **values))
    found = check_circuits(replace(board, parts={**board.parts, part: other}))
    assert [f for f in found if f.check == check and f.message.endswith(f"limit {limit}")], found


@needs_ngspice
def test_side_by_side() -> None:
    text = compare([BOARDS["led-driver"], BOARDS["led-driver-improved"]])
    rows = {row[1].strip(): [cell.strip() for cell in row[2:-1]]
            for row in (line.split("|") for line in text.splitlines())}  # fmt: skip
    limit, built, improved = rows["LED current rises to 99 %"]
    assert limit == "10 µs"
    assert built.startswith("**")
    assert not improved.startswith("**")
    assert rows["power of R1 while the LED is on"][1] == ""
    assert circuits.show(measured("led-driver")["LED current"]) in rows["LED current"][1]


def test_assumptions_are_named() -> None:
    text = assumptions()
    for name in ("cable", "led", "supply", "2SA1015", "IRLZ34N", "1N5822"):
        assert name in text
    assert text.count("assumed") >= 5
    assert "nothing has been measured" in text


@needs_ngspice
@pytest.mark.parametrize(
    ("row", "kind", "what", "unit"),
    [
        ("highest voltage at the ADC", "tcd1304", "highest dark level", "V"),
        ("level that the inverter takes for high", "tcd1304", "fM is surely high from", "V"),
        ("drain of an LED's transistor", "led-driver", "drain at switch-off", "V"),
        ("LED current to 99 %", "led-driver", "rises to 99 %", "µs"),
        ("the sensor's output to 1 %", "tcd1304", "sensor's output 1000 Ω", "µs"),
    ],
)
def test_readme_says_what_is_simulated(row: str, kind: str, what: str, unit: str) -> None:
    (line,) = (line for line in README.splitlines() if line.startswith(f"| {row}"))
    scale = {"V": 1.0, "µs": 1e-6}[unit]
    for name, cell in zip((kind, f"{kind}-improved"), line.split("|")[2:4], strict=True):
        number, its_unit = cell.split()
        assert its_unit == unit
        # half of the last digit, and what one release of ngspice differs from another
        least = 10.0 ** -len(number.partition(".")[2])
        assert float(number) * scale == pytest.approx(
            value(name, what), abs=0.6 * least * scale, rel=0.005
        )
