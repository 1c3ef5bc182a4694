"""The wiring file, and what is written from it."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from acquisition import wiring
from acquisition.wiring import PROTOCOL, WIRING, WiringError

ROOT = Path(__file__).parents[2]
TEXT = (ROOT / "acquisition" / "wiring.toml").read_text(encoding="utf-8")


def test_header_is_up_to_date() -> None:
    committed = (ROOT / "firmware" / "wiring.h").read_text()
    assert committed == wiring.c_header(), (
        "run: python -m acquisition.wiring header > firmware/wiring.h"
    )
    assert committed.count("_Static_assert") >= 5


def test_readme_is_up_to_date() -> None:
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    found = re.search(r"<!-- wiring -->\n(.*?)<!-- /wiring -->", readme, re.DOTALL)
    assert found is not None, "README.md has no <!-- wiring --> ... <!-- /wiring -->"
    assert found[1].strip() == wiring.markdown().strip(), "run: python -m acquisition.wiring tables"


def test_pins_of_the_thesis() -> None:
    pins = {net: pin.name for net, pin in WIRING.pins.items()}
    assert pins["fM"] == "PB0"
    assert (pins["SH"], pins["ICG"], pins["OS"]) == ("PA1", "PA0", "PC0")
    assert (pins["SCLK"], pins["MISO"], pins["MOSI"]) == ("PB13", "PB14", "PB15")
    assert pins["ready"] == "PB2"
    assert (pins["led0"], pins["led1"]) == ("PC4", "PC5")
    assert {c.table for c in WIRING.connectors} == {"4.6", "4.7", "4.8", None}


def test_places_on_the_boards_are_told() -> None:
    (host,) = (c for c in WIRING.connectors if c.table == "4.6")
    assert WIRING.rows(host)[0] == ("MOSI", "PB15 (CN10-26)", "GPIO10 (pin 19)")
    for places in WIRING.places.values():
        assert len(set(places.values())) == len(places)


def test_constants() -> None:
    assert PROTOCOL.original_size == 7388
    assert PROTOCOL.stream.frame_size == 7424
    assert PROTOCOL.spikes.frame_size == 256
    assert wiring.sh_edge(PROTOCOL) == 9
    assert WIRING.leds.last_two == (0, 1)
    assert WIRING.mcu.clock == 21 * WIRING.mcu.master_clock


def test_objects_cannot_change() -> None:
    with pytest.raises(AttributeError):
        WIRING.mcu.clock = 1  # type: ignore[misc]
    with pytest.raises(TypeError):
        WIRING.pins["SH"] = WIRING.pins["ICG"]  # type: ignore[index]


@pytest.mark.parametrize("flag", [1, 2, 4, 8])
@pytest.mark.parametrize("size", [PROTOCOL.stream.frame_size, PROTOCOL.spikes.frame_size])
def test_flag_checksum(size: int, flag: int) -> None:
    protocol = pytest.importorskip("acquisition.protocol")
    frame = bytearray(b"\x5a" * (size - 4))
    before = protocol.crc32_words(bytes(frame))
    frame[3] ^= flag
    assert protocol.crc32_words(bytes(frame)) ^ before == wiring.flag_checksum(size, flag)


def test_command_line() -> None:
    for name, expected in (("header", wiring.c_header()), ("tables", wiring.markdown())):
        run = subprocess.run(
            (sys.executable, "-m", "acquisition.wiring", name),
            cwd=ROOT, capture_output=True, text=True, check=True,
        )  # fmt: skip
        assert run.stdout == expected
    assert wiring.main([]) == 2


def test_standard_library_only() -> None:
    run = subprocess.run(
        (sys.executable, "-I", "-c",
         ("import sys; sys.path.insert(0, sys.argv[1]); import acquisition.wiring\n"
         "print(*{m.split('.')[0] for m in sys.modules} - sys.stdlib_module_names)"), str(ROOT)),
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert not {"numpy", "scipy", "typer"} & set(run.stdout.split())


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('pin = "PA1"', 'pin = "PA0"', "PA0 is both SH and ICG"),
        ('pin = "PB2"', 'pin = "PD9"', "PD9 is no pin"),
        ('pin = "PB2"', 'pin = "PC16"', "PC16 is no pin"),
        ('af = 1, signal = "TIM2_CH2"', 'af = 3, signal = "TIM2_CH2"', "is nothing, not TIM2_CH2"),
        ('signal = "TIM5_CH1"', 'signal = "TIM5_CH2"', "is TIM5_CH1, not TIM5_CH2"),
        ('signal = "ADC1_IN10"', 'signal = "ADC1_IN11"', "PC0 is ADC1_IN10, not ADC1_IN11"),
        ('"PC0",  direction = "analog"', '"PC6",  direction = "analog"', "both OS and led2"),
        ('direction = "out" }   # hand', 'direction = "both" }   # hand', "allowed are out, in"),
        ('"PB2",  direction = "out"', '"PB2",  direction = "out", af = 1', "go together"),
        ('["SH", "SH"]', '["SHH", "SH"]', "no pin or supply has the net 'SHH'"),
        ('["SH", "SH"]', '["SH", "fM"]', "two wires end"),
        ('gpio = ["led0", "led1",', 'gpio = ["led1", "led0",', "adjacent pins"),
        ('gpio = ["led0",', 'gpio = ["led9",', "no pin has the net 'led9'"),
        ('last_two = ["led0"', 'last_two = ["SH"', "SH is none of led0"),
        ("chain_first = 6", "chain_first = 5", "overlap"),
        ("chain_bits = 64", "chain_bits = 56", "all channels need one"),
        ("icg_min = 14776", "icg_min = 14775", "not the time of one read-out"),
        ("frame_size = 7424", "frame_size = 7420", "not header, elements and checksum"),
        ("header_size = 32", "header_size = 30", "not header, elements and checksum"),
        ("frame_size = 256 ", "frame_size = 254 ", "spikes: the CRC unit takes words"),
        ("table_at = 20 ", "table_at = 18 ", "spikes: the CRC unit takes words"),
        ("version = 2 ", "version = 1 ", "has neither windows nor options"),
        ('sync      = { pin = "PB1"', 'sync      = { pin = "PB0"', "PB0 is both fM and sync"),
        ("sh_pulse = 8", "sh_pulse = 19", "SH pulse ends after"),
        ("master_clock = 4_000_000", "master_clock = 3_900_000", "does not divide"),
        ('PB2 = "CN10-22"', "", "places has no PB2 of STM32F401RE"),
    ],
)
def test_what_cannot_be_built_is_refused(old: str, new: str, message: str) -> None:
    assert TEXT.count(old) == 1, old
    with pytest.raises(WiringError, match=re.escape(message)):
        wiring.read(TEXT.replace(old, new))
