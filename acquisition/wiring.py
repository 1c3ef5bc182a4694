"""The prototype's wiring and the constants both sides share, read from wiring.toml and checked.

``python -m acquisition.wiring header`` prints ``firmware/wiring.h``, ``python -m
acquisition.wiring tables`` the README's tables of wires. Nothing but the standard library is
needed, so that a board without the project's other packages can make both.
"""

from __future__ import annotations

import re
import sys
import tomllib
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

SUPPLIES: Final = frozenset({"GND", "+5V", "+3V3"})
"""Nets that are no pin of the microcontroller."""

ALTERNATE_FUNCTIONS: Final[Mapping[str, Mapping[int, tuple[str, ...]]]] = MappingProxyType(
    {
        "PA0": {1: ("TIM2_CH1", "TIM2_ETR"), 2: ("TIM5_CH1",), 7: ("USART2_CTS",)},
        "PA1": {1: ("TIM2_CH2",), 2: ("TIM5_CH2",), 7: ("USART2_RTS",)},
        "PA5": {1: ("TIM2_CH1", "TIM2_ETR"), 5: ("SPI1_SCK",)},
        "PA6": {1: ("TIM1_BKIN",), 2: ("TIM3_CH1",), 5: ("SPI1_MISO",)},
        "PA7": {1: ("TIM1_CH1N",), 2: ("TIM3_CH2",), 5: ("SPI1_MOSI",)},
        "PB0": {1: ("TIM1_CH2N",), 2: ("TIM3_CH3",)},
        "PB1": {1: ("TIM1_CH3N",), 2: ("TIM3_CH4",)},
        "PB2": {},
        "PB8": {2: ("TIM4_CH3",), 3: ("TIM10_CH1",), 4: ("I2C1_SCL",), 12: ("SDIO_D4",)},
        "PB9": {
            2: ("TIM4_CH4",),
            3: ("TIM11_CH1",),
            4: ("I2C1_SDA",),
            5: ("SPI2_NSS", "I2S2_WS"),
            12: ("SDIO_D5",),
        },
        "PB12": {1: ("TIM1_BKIN",), 4: ("I2C2_SMBA",), 5: ("SPI2_NSS", "I2S2_WS")},
        "PB13": {1: ("TIM1_CH1N",), 5: ("SPI2_SCK", "I2S2_CK")},
        "PB14": {1: ("TIM1_CH2N",), 5: ("SPI2_MISO",), 6: ("I2S2ext_SD",)},
        "PB15": {0: ("RTC_REFIN",), 1: ("TIM1_CH3N",), 5: ("SPI2_MOSI", "I2S2_SD")},
        "PC0": {},
        "PC1": {},
        "PC2": {5: ("SPI2_MISO",), 6: ("I2S2ext_SD",)},
        "PC3": {5: ("SPI2_MOSI", "I2S2_SD")},
        "PC4": {},
        "PC5": {},
        "PC6": {2: ("TIM3_CH1",), 5: ("I2S2_MCK",), 8: ("USART6_TX",), 12: ("SDIO_D6",)},
        "PC7": {2: ("TIM3_CH2",), 6: ("I2S3_MCK",), 8: ("USART6_RX",), 12: ("SDIO_D7",)},
        "PC8": {2: ("TIM3_CH3",), 8: ("USART6_CK",), 12: ("SDIO_D0",)},
        "PC9": {
            0: ("MCO_2",),
            2: ("TIM3_CH4",),
            4: ("I2C3_SDA",),
            5: ("I2S_CKIN",),
            12: ("SDIO_D1",),
        },
        "PC10": {6: ("SPI3_SCK", "I2S3_CK"), 12: ("SDIO_D2",)},
        "PC11": {5: ("I2S3ext_SD",), 6: ("SPI3_MISO",), 12: ("SDIO_D3",)},
        "PC12": {6: ("SPI3_MOSI", "I2S3_SD"), 12: ("SDIO_CK",)},
    }
)
"""Signals by pin and alternate function number: table 9 of the STM32F401xE's datasheet, of the
pins that are wired or close by."""

_ANALOG: Final = {
    f"P{port}{number}": f"ADC1_IN{first + number - low}"
    for port, low, high, first in (("A", 0, 7, 0), ("B", 0, 1, 8), ("C", 0, 5, 10))
    for number in range(low, high + 1)
}
_PIN: Final = re.compile(r"P([A-EH])([0-9]|1[0-5])")


class WiringError(ValueError):
    """wiring.toml says something that cannot be built."""


@dataclass(frozen=True)
class Mcu:
    """The microcontroller.

    Parameters
    ----------
    part : str
    clock : int
        Of its core and timers, Hz.
    master_clock : int
        That the sensor gets, Hz.
    """

    part: str
    clock: int
    master_clock: int


@dataclass(frozen=True)
class Pin:
    """One pin of the microcontroller, seen from there.

    Parameters
    ----------
    net : str
        What is connected to it.
    name : str
        As in the datasheet: PB13.
    direction : str
        ``"out"``, ``"in"`` or ``"analog"``.
    signal : str or None, optional
        Of the peripheral that has the pin; without one, software has it.
    af : int or None, optional
        Number of the alternate function that gives the signal.
    """

    net: str
    name: str
    direction: str
    signal: str | None = None
    af: int | None = None

    @property
    def port(self) -> str:
        """Letter of the port."""
        return self.name[1]

    @property
    def number(self) -> int:
        """Number within the port."""
        return int(self.name[2:])


@dataclass(frozen=True)
class Leds:
    """Which channel of the LED masks is where.

    Parameters
    ----------
    gpio : tuple of Pin
        Channels 0 and up.
    chain_first : int
        Channel of the first 74HC595's first output.
    chain_bits : int
        Outputs of the chain, wired or not.
    chain_step : int
        Shortest time from one pattern of the chain to the next, master clocks.
    last_two : tuple of int
        Channels that light the last two frames in original mode.
    """

    gpio: tuple[Pin, ...]
    chain_first: int
    chain_bits: int
    chain_step: int
    last_two: tuple[int, int]


@dataclass(frozen=True)
class Connector:
    """The wires to one other board.

    Parameters
    ----------
    name : str
    table : str or None
        The thesis's number of this table.
    other : str
        The board at the other end.
    wires : tuple of tuple of str
        Net and the other end's name of it.
    """

    name: str
    table: str | None
    other: str
    wires: tuple[tuple[str, str], ...]


@dataclass(frozen=True)
class Stream:
    """Constants of stream mode; meanings in wiring.toml."""

    version: int
    magic: int
    header_size: int
    frame_size: int
    table_at: int
    table_max: int
    entry_size: int
    exposure_min: int
    exposure_continues: int
    stall_us: int
    original_stall_us: int
    flags: Mapping[str, int]
    refusals: Mapping[str, int]


@dataclass(frozen=True)
class Spikes:
    """Constants of spikes mode; meanings in wiring.toml."""

    version: int
    frame_size: int
    table_at: int
    entry_size: int
    no_window: int
    window_min: int
    windows_max: int
    spikes_max: int
    position_scale: int
    width_scale: int
    dark_scale: int
    flags: Mapping[str, int]


@dataclass(frozen=True)
class Protocol:
    """Constants of the link and of the sensor's timing; meanings in wiring.toml."""

    elements: int
    clocks_per_element: int
    leading_elements: int
    pixels: int
    dark_first: int
    dark_count: int
    full_scale: int
    command_magic: tuple[int, int]
    sh_min: int
    icg_min: int
    icg_pulse: int
    sh_pulse: int
    icg_delay: int
    sh_delay: int
    flush_sh: int
    flush_icg: int
    flush_pulses: int
    spi_clock_max: int
    modes: Mapping[str, int]
    options: Mapping[str, int]
    stream: Stream
    spikes: Spikes

    @property
    def original_size(self) -> int:
        """Bytes of a transfer in original mode."""
        return 2 * self.elements


@dataclass(frozen=True)
class Wiring:
    """All of wiring.toml but the protocol.

    Parameters
    ----------
    mcu : Mcu
    pins : mapping of str to Pin
        By net.
    leds : Leds
    inverted : bool
        Whether an inverter lies between the microcontroller and the sensor.
    direction : int
        +1: pixel 1 is at the -x end of the sensor line; -1: at its +x end.
    connectors : tuple of Connector
    places : mapping of str to mapping of str to str
        By board and pin: where on that board the pin comes out, for boards that are bought.
    """

    mcu: Mcu
    pins: Mapping[str, Pin]
    leds: Leds
    inverted: bool
    direction: int
    connectors: tuple[Connector, ...]
    places: Mapping[str, Mapping[str, str]]

    def rows(self, connector: Connector) -> list[tuple[str, str, str]]:
        """Return a connector's wires for people: net, and at both ends the pin and its place."""
        return [
            (
                net,
                self._end(self.mcu.part, self.pins[net].name if net in self.pins else net),
                self._end(connector.other, end),
            )
            for net, end in connector.wires
        ]

    def _end(self, board: str, pin: str) -> str:
        place = self.places.get(board, {}).get(pin, "")
        return f"{pin} ({place})" if place else pin


def read(text: str) -> tuple[Wiring, Protocol]:
    """Read and check a wiring.toml.

    Parameters
    ----------
    text : str

    Returns
    -------
    wiring : Wiring
    protocol : Protocol

    Raises
    ------
    WiringError
        A net is unknown, a pin is used twice or cannot do what is asked of it, or two constants
        contradict each other.
    """
    data = tomllib.loads(text)
    pins = {net: Pin(net, row.pop("pin"), **row) for net, row in data["pins"].items()}
    _check_pins(pins.values())
    leds = data["leds"]
    for net in (*leds["gpio"], *leds["last_two"]):
        if net not in pins:
            raise WiringError(f"leds: no pin has the net {net!r}")
    for net in leds["last_two"]:
        if net not in leds["gpio"]:
            raise WiringError(f"leds.last_two: {net} is none of {', '.join(leds['gpio'])}")
    connectors = tuple(
        Connector(
            row["name"], row.get("table"), row["other"], tuple((a, b) for a, b in row["wires"])
        )
        for row in data["connectors"]
    )
    for connector in connectors:
        for net, _ in connector.wires:
            if net not in pins and net not in SUPPLIES:
                raise WiringError(f"{connector.name}: no pin or supply has the net {net!r}")
        ends = [end for _, end in connector.wires]
        if len(set(ends)) < len(ends):
            raise WiringError(f"{connector.name}: two wires end at the same pin")
    wiring = Wiring(
        Mcu(**data["mcu"]),
        MappingProxyType(pins),
        Leds(
            tuple(pins[net] for net in leds["gpio"]),
            leds["chain_first"],
            leds["chain_bits"],
            leds["chain_step"],
            (leds["gpio"].index(leds["last_two"][0]), leds["gpio"].index(leds["last_two"][1])),
        ),
        data["sensor"]["inverted"],
        data["sensor"]["direction"],
        connectors,
        MappingProxyType({name: MappingProxyType(row) for name, row in data["places"].items()}),
    )
    for connector in connectors:
        for net, _ in connector.wires:
            name = pins[net].name if net in pins else net
            if name not in wiring.places[wiring.mcu.part]:
                raise WiringError(f"{connector.name}: places has no {name} of {wiring.mcu.part}")
    protocol = _protocol(data["protocol"])
    _check_constants(wiring, protocol)
    return wiring, protocol


def _protocol(data: dict[str, Any]) -> Protocol:
    stream, spikes = dict(data["stream"]), dict(data["spikes"])
    for name in ("flags", "refusals"):
        stream[name] = MappingProxyType(stream[name])
    spikes["flags"] = MappingProxyType(spikes["flags"])
    return Protocol(
        **{
            **data,
            "command_magic": tuple(data["command_magic"]),
            "modes": MappingProxyType(data["modes"]),
            "options": MappingProxyType(data["options"]),
            "stream": Stream(**stream),
            "spikes": Spikes(**spikes),
        }
    )


def _check_pins(pins: Any) -> None:
    nets: dict[str, str] = {}
    for pin in pins:
        if not _PIN.fullmatch(pin.name) or pin.name not in ALTERNATE_FUNCTIONS:
            raise WiringError(
                f"{pin.net}: {pin.name} is no pin of table 9 kept here; add its row to "
                "ALTERNATE_FUNCTIONS"
            )
        if pin.name in nets:
            raise WiringError(f"{pin.name} is both {nets[pin.name]} and {pin.net}")
        nets[pin.name] = pin.net
    for pin in pins:
        if pin.direction not in {"out", "in", "analog"}:
            raise WiringError(
                f"{pin.net}: direction {pin.direction!r}: allowed are out, in and analog"
            )
        if pin.direction == "analog":
            if pin.signal != _ANALOG.get(pin.name) or pin.af is not None:
                raise WiringError(
                    f"{pin.net}: {pin.name} is {_ANALOG.get(pin.name, 'no analog input')}, "
                    f"not {pin.signal}"
                )
        elif (pin.af is None) != (pin.signal is None):
            raise WiringError(f"{pin.net}: signal and af go together")
        elif pin.af is not None:
            offered = ALTERNATE_FUNCTIONS[pin.name].get(pin.af, ())
            if pin.signal not in offered:
                raise WiringError(
                    f"{pin.net}: alternate function {pin.af} of {pin.name} is "
                    f"{' or '.join(offered) or 'nothing'}, not {pin.signal}"
                )


def _check_constants(wiring: Wiring, protocol: Protocol) -> None:
    stream = protocol.stream
    if wiring.mcu.clock % wiring.mcu.master_clock:
        raise WiringError("mcu: the master clock does not divide the clock")
    if not 0 < len(wiring.leds.gpio) <= wiring.leds.chain_first:
        raise WiringError("leds: channels of pins and chain overlap")
    if wiring.leds.chain_bits % 8 or wiring.leds.chain_bits < 64 - wiring.leds.chain_first:
        raise WiringError("leds.chain_bits: 74HC595 have 8 outputs, and all channels need one")
    first = wiring.leds.gpio[0]
    if [(p.port, p.number - n) for n, p in enumerate(wiring.leds.gpio)] != (
        [(first.port, first.number)] * len(wiring.leds.gpio)
    ):
        raise WiringError("leds.gpio: not one port's adjacent pins, so they cannot switch at once")
    if protocol.icg_min != protocol.elements * protocol.clocks_per_element:
        raise WiringError("protocol.icg_min is not the time of one read-out")
    if stream.frame_size != stream.header_size + 2 * protocol.elements + 4 or stream.frame_size % 4:
        raise WiringError("protocol.stream.frame_size is not header, elements and checksum")
    if stream.header_size % 4 or stream.entry_size % 4:
        raise WiringError("protocol.stream: the CRC unit takes words of 4 bytes")
    spikes = protocol.spikes
    if spikes.frame_size % 4 or spikes.table_at % 4 or spikes.entry_size % 4:
        raise WiringError("protocol.spikes: the CRC unit takes words of 4 bytes")
    if spikes.version == stream.version:
        raise WiringError(
            "protocol.spikes.version: that of stream mode has neither windows nor options"
        )
    if sh_edge(protocol) >= protocol.icg_pulse:
        raise WiringError("protocol: the SH pulse ends after the ICG pulse")


def sh_edge(protocol: Protocol) -> int:
    """Tell how many master clocks after ICG's edge the SH pulse ends, and the integration."""
    return protocol.sh_delay - protocol.icg_delay + protocol.sh_pulse


def flag_checksum(frame_size: int, flag: int) -> int:
    """Tell what a header flag does to the frame's checksum.

    A CRC is linear: changing one bit of the frame changes the checksum by a constant. So a flag
    that is only known when the frame is sent need not be known when the checksum is computed.

    Parameters
    ----------
    frame_size : int
        Bytes of the frame, its checksum included.
    flag : int
        Bit of the header's flags.

    Returns
    -------
    int
        To be xored to the checksum.
    """
    crc = flag << 24  # the flags are the fourth byte, the highest of the first word
    for _ in range(8 * (frame_size - 4)):
        crc = (crc << 1) ^ (0x104C11DB7 if crc & 0x80000000 else 0)
    return crc


def c_header() -> str:
    """Write the header that the firmware is compiled with.

    Returns
    -------
    str
        Text of firmware/wiring.h.
    """
    lines = [
        "/* Written by `python -m acquisition.wiring header` from acquisition/wiring.toml. */",
        "#ifndef WIRING_H",
        "#define WIRING_H",
        "",
        *_define("CLOCK_HZ", WIRING.mcu.clock),
        *_define("MASTER_CLOCK_HZ", WIRING.mcu.master_clock),
        "",
        "/* pins: port, number, alternate function where a peripheral has them */",
    ]
    for net, pin in WIRING.pins.items():
        name = net.upper()
        lines.append(f"#define {name}_PORT GPIO{pin.port}")
        lines.append(f"#define {name}_PIN {pin.number}u")
        if pin.af is not None:
            lines.append(f"#define {name}_AF {pin.af}u /* {pin.signal} */")
    channel = WIRING.pins["OS"].signal or ""
    lines += ["", *_define("OS_CHANNEL", int(channel.removeprefix("ADC1_IN")))]
    lines += ["", "/* LED channels */", f"#define LED_PORT GPIO{WIRING.leds.gpio[0].port}"]
    lines += _define("LED_FIRST_PIN", WIRING.leds.gpio[0].number)
    lines += _define("LED_GPIO_COUNT", len(WIRING.leds.gpio))
    lines += _define("LED_CHAIN_FIRST", WIRING.leds.chain_first)
    lines += _define("LED_CHAIN_BITS", WIRING.leds.chain_bits)
    lines += _define("LED_CHAIN_STEP", WIRING.leds.chain_step)
    lines += _define("LED_SECOND_TO_LAST", WIRING.leds.last_two[0])
    lines += _define("LED_LAST", WIRING.leds.last_two[1])
    lines += ["", "/* sensor timing in master clocks, and the link */"]
    for name, value in vars(PROTOCOL).items():
        if isinstance(value, int):
            lines += _define(name.upper(), value)
    lines += _define("SH_EDGE", sh_edge(PROTOCOL))
    lines += [f"#define COMMAND_MAGIC_{n} {byte:#04x}u" for n, byte in enumerate(_MAGIC)]
    lines += _define("ORIGINAL_SIZE", PROTOCOL.original_size)
    for name, value in PROTOCOL.modes.items():
        lines += _define(f"MODE_{name.upper()}", value)
    lines += ["", "/* stream mode */"]
    for name, value in vars(PROTOCOL.stream).items():
        if isinstance(value, int):
            lines += _define(f"STREAM_{name.upper()}", value)
    for name, value in PROTOCOL.stream.flags.items():
        lines += _define(f"FLAG_{name.upper()}", value)
    for name, value in PROTOCOL.stream.refusals.items():
        lines += _define(f"REFUSAL_{name.upper()}", value)
    lines += ["", "/* spikes mode, and the options of both */"]
    for name, value in vars(PROTOCOL.spikes).items():
        if isinstance(value, int):
            lines += _define(f"SPIKES_{name.upper()}", value)
    for name, value in PROTOCOL.spikes.flags.items():
        lines += _define(f"SPIKE_{name.upper()}", value)
    for name, value in PROTOCOL.options.items():
        lines += _define(f"OPTION_{name.upper()}", value)
    lines += ["", "/* what toggling a flag, by bit, does to the checksum: a CRC is linear */"]
    bits = [1 << n for n in range(max(PROTOCOL.stream.flags.values()).bit_length())]
    for mode, size in (
        ("STREAM", PROTOCOL.stream.frame_size),
        ("SPIKES", PROTOCOL.spikes.frame_size),
    ):
        checksums = ", ".join(f"{flag_checksum(size, bit):#010x}u" for bit in bits)
        lines.append(f"#define {mode}_FLAG_CHECKSUMS {checksums}")
    lines += [
        "",
        *_ASSERTS,
        "",
        "#endif",
    ]
    return "\n".join(lines) + "\n"


_ASSERTS: Final = (
    '_Static_assert(CLOCK_HZ % MASTER_CLOCK_HZ == 0, "whole clocks");',
    '_Static_assert(ICG_MIN == ELEMENTS * CLOCKS_PER_ELEMENT, "one read-out");',
    '_Static_assert(ORIGINAL_SIZE == 2 * ELEMENTS, "elements have two bytes");',
    "_Static_assert(STREAM_FRAME_SIZE == STREAM_HEADER_SIZE + ORIGINAL_SIZE + 4,",
    '               "header, elements, checksum");',
    '_Static_assert(STREAM_FRAME_SIZE % 4 == 0, "the CRC unit takes words");',
    "_Static_assert(SPIKES_TABLE_AT + STREAM_TABLE_MAX * SPIKES_ENTRY_SIZE + 4 <= ORIGINAL_SIZE,",
    '               "a command fits in a transfer");',
    '_Static_assert(SH_EDGE < STREAM_EXPOSURE_MIN, "an LED goes on before ICG\'s edge");',
    '_Static_assert(SH_EDGE < ICG_PULSE && ICG_PULSE < SH_MIN, "pulses do not overlap");',
    '_Static_assert(LED_GPIO_COUNT <= LED_CHAIN_FIRST, "pins, then the chain");',
    '_Static_assert(LED_CHAIN_BITS == 64, "one pattern is a uint64_t");',
)


def _define(name: str, value: int) -> list[str]:
    return [f"#define {name} {value:#x}u" if value > 0xFFFFFFF else f"#define {name} {value}u"]


def markdown() -> str:
    """Write the tables of wires: the thesis's 4.6 to 4.8 and the LED chain.

    Returns
    -------
    str
        Markdown.
    """
    parts = []
    for connector in WIRING.connectors:
        title = connector.name
        if connector.table is not None:
            title += f" (thesis, table {connector.table})"
        rows = [("Net", WIRING.mcu.part, connector.other), *WIRING.rows(connector)]
        parts.append(f"**{title}**\n\n{_table(rows)}")
    return "\n\n".join(parts) + "\n"


def _table(rows: Sequence[tuple[str, ...]]) -> str:
    widths = [max(len(row[n]) for row in rows) for n in range(len(rows[0]))]
    lines = ["| " + " | ".join(c.ljust(w) for c, w in zip(row, widths, strict=True)) + " |"
             for row in rows]  # fmt: skip
    lines.insert(1, "|" + "|".join("-" * (w + 2) for w in widths) + "|")
    return "\n".join(lines)


def main(arguments: Sequence[str]) -> int:
    """Print what the only argument names: ``header`` or ``tables``.

    Parameters
    ----------
    arguments : sequence of str

    Returns
    -------
    int
        Exit status.
    """
    writers = {"header": c_header, "tables": markdown}
    if len(arguments) != 1 or arguments[0] not in writers:
        sys.stderr.write("usage: python -m acquisition.wiring header|tables\n")
        return 2
    sys.stdout.write(writers[arguments[0]]())
    return 0


WIRING, PROTOCOL = read(Path(__file__).with_name("wiring.toml").read_text(encoding="utf-8"))
_MAGIC: Final = PROTOCOL.command_magic

if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
