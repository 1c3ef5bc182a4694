"""Circuit simulation of the boards with ngspice: what their values mean in volts, amperes, seconds.

Every deck is written from a board's netlist: its resistors, capacitors, diodes and transistors are
the simulation's, with the models of ``data/parts.toml``. Cables, LEDs, supply and microcontroller
are those of ``data/surroundings.toml``, most of them assumed. Nothing of this has been measured on
a board.

`measure` says how a board does, `check_circuits` which of its figures are hazards, `compare` writes
boards side by side.
"""

from __future__ import annotations

import math
import shutil
import subprocess
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from acquisition.wiring import PROTOCOL, WIRING
from hardware.boards import PART_TYPES, SURROUNDINGS
from hardware.electrical import high_level
from hardware.findings import Finding

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from numpy.typing import NDArray

    from hardware.boards import Board, Connector, Netlist, Part

ELEMENT_TIME: Final = PROTOCOL.clocks_per_element / WIRING.mcu.master_clock
"""s: the sensor shows each pixel so long."""

SHORTEST_INTEGRATION: Final = PROTOCOL.sh_min / WIRING.mcu.master_clock
"""s."""

_ON, _OFF, _END = 10e-6, 110e-6, 150e-6  # s: the LED is switched on and off, the simulation ends


class NoSimulatorError(RuntimeError):
    """There is no ngspice."""


@dataclass(frozen=True)
class Measurement:
    """One figure of a simulated board, and what it should be.

    Parameters
    ----------
    check : str
        The hazard if it is out of its limit; as `hardware.electrical.check_board` calls it.
    what : str
    value, limit, least : float
        In `unit`; most and least that it may be, nan where there is no limit.
    unit : str
        Without prefix.
    where : str
    change : str
        What brings it within the limit.
    """

    check: str
    what: str
    value: float
    unit: str
    limit: float
    where: str
    change: str = ""
    least: float = math.nan

    @property
    def holds(self) -> bool:
        """Whether it keeps within its limits."""
        return not (self.value > self.limit or self.value < self.least)


# --- decks ---------------------------------------------------------------------------------------


def _node(net: str) -> str:
    return "0" if net == "GND" else net.replace("+", "plus_")


def elements(netlist: Netlist) -> Iterator[str]:
    """Write the parts of a board that a simulation needs, but sensor, inverters and connectors.

    Parameters
    ----------
    netlist : Netlist

    Yields
    ------
    str
        A line of a deck.
    """
    for part in netlist.parts.values():
        nodes = [_node(net) for _, _, net in netlist.pins(part)]
        name, kind, spice = part.reference, part.type.kind, part.type.spice
        if kind == "resistor":
            yield f"R{name} {nodes[0]} {name}_inner {part.type.amount}"
            yield f"L{name} {name}_inner {nodes[1]} {spice.get('inductance', 0)}"
        elif kind in {"capacitor", "polarised capacitor"}:
            yield f"C{name} {nodes[0]} {name}_inner {part.type.amount}"
            yield f"R{name} {name}_inner {nodes[1]} {spice.get('resistance', 0.01)}"
        elif kind in {"pnp", "nmos", "diode"}:
            order, letter = {"pnp": ("CBE", "Q"), "nmos": ("DGS", "M"), "diode": ("AK", "D")}[kind]
            legs = " ".join(_node(netlist.at(part, leg)) for leg in order)
            yield f"{letter}{name} {legs} model_{name}"
            yield f".model model_{name} {spice['card']}"
        elif kind == "regulator":
            made = netlist.at(part, "OUT")
            yield f"V{name} {name}_inner 0 {netlist.volts[made]}"
            yield f"R{name} {name}_inner {_node(made)} 0.1"


def _supply(netlist: Netlist, factor: float = 1.0) -> Iterator[str]:
    """Write a source with its leads for every supply that a connector brings."""
    for net in netlist.nets:
        for _, name, _ in netlist.labels(net):
            volts = netlist.board.supplies.get(name, 0.0)
            if volts > 0:
                node, leads = _node(net), SURROUNDINGS["supply"]
                yield f"Vsupply_{node} source_{node} 0 {volts * factor}"
                yield f"Rsupply_{node} source_{node} leads_{node} {leads['ohm']}"
                yield f"Lsupply_{node} leads_{node} {node} {leads['henry']}"
                break


def _sensor_deck(netlist: Netlist, output: str, output_ohm: float) -> list[str]:
    """Write a sensor board with a source at its output, and the converter."""
    (sensor,) = netlist.of_kind("sensor")
    mcu, jumper = SURROUNDINGS["microcontroller"], SURROUNDINGS["jumper"]
    at = _node(_labelled(netlist, "OS"))
    return [
        *elements(netlist),
        *_supply(netlist),
        f"Vsensor sensor 0 {output}",
        f"Rsensor sensor {_node(netlist.at(sensor, 'OS'))} {output_ohm}",
        f"Cjumper {at} 0 {jumper['farad'] + mcu['pin_farad']}",
        f"Rsample {at} sample {mcu['sample_ohm']}",
        f"Csample sample 0 {mcu['sample_farad']}",
        *_resting_inputs(netlist),
    ]


def _labelled(netlist: Netlist, name: str) -> str:
    """Return the net of the connector's pin of a name."""
    return next(net for net in netlist.nets for _, label, _ in netlist.labels(net) if label == name)


def _resting_inputs(netlist: Netlist) -> Iterator[str]:
    """Write what keeps nodes without a current path at a level: inverters and their ends."""
    for part in netlist.of_kind("inverter"):
        for pin, end, net in netlist.pins(part):
            if pin.function in {"input", "output"} and net:
                yield f"R{end.reference}_{end.number} {_node(net)} 0 1e9"


def _led_deck(netlist: Netlist, factor: float = 1.0) -> list[str]:
    """Write a LED board with its cables and LEDs; the first channel is pulsed."""
    mcu, cable = SURROUNDINGS["microcontroller"], SURROUNDINGS["cable"]
    deck = [
        *elements(netlist),
        *_supply(netlist, factor),
        f".model led {SURROUNDINGS['led']['spice']}",
    ]
    for number, led in enumerate(netlist.board.leds):
        anode, cathode = (_node(netlist.plugged(led, end)) for end in ("anode", "cathode"))
        name = led.reference
        deck += [
            f"L{name} {anode} {name}_a {cable['metres'] * cable['henry_per_metre']}",
            f"R{name} {name}_a {name}_b {cable['metres'] * cable['ohm_per_metre']}",
            f"V{name} {name}_b {name}_c 0",
            f"D{name} {name}_c {cathode} led",
        ]
        drive = (
            f"PWL(0 0 {_ON} 0 {_ON + 5e-9} {mcu['supply']} {_OFF} {mcu['supply']} {_OFF + 5e-9} 0)"
        )
        gate = netlist.at(_switch(netlist, led), "G")
        deck += [
            f"Vpin{number} pin{number} 0 {'0' if number else drive}",
            f"Rpin{number} pin{number} {_node(gate)} {mcu['output_ohm']}",
        ]
    return deck


def _switch(netlist: Netlist, led: Connector) -> Part:
    """Return the transistor that switches an LED."""
    cathode = netlist.plugged(led, "cathode")
    return next(part for part in netlist.of_kind("nmos") if netlist.at(part, "D") == cathode)


def simulate(deck: Sequence[str], analysis: str, vectors: Sequence[str]) -> NDArray[np.float64]:
    """Run ngspice.

    Parameters
    ----------
    deck : sequence of str
        The circuit.
    analysis : str
        As for ngspice: ``tran 1n 5u``, ``dc Vsensor 0 4 0.01``.
    vectors : sequence of str
        What to return.

    Returns
    -------
    ndarray, shape (1 + len(vectors), N)
        The sweep or time, s, then the vectors.

    Raises
    ------
    NoSimulatorError
        If ngspice is not installed.
    RuntimeError
        If it fails.
    """
    ngspice = shutil.which("ngspice")
    if ngspice is None:
        raise NoSimulatorError("ngspice is missing: apt install ngspice")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder)
        text = ["* written from a board's data", *deck]
        text += [".control", "set wr_singlescale", "set numdgt=12", analysis]
        text += [f"wrdata waves.txt {' '.join(vectors)}", "quit", ".endc", ".end"]
        (path / "board.cir").write_text("\n".join(text) + "\n")
        run = subprocess.run(  # noqa: S603
            (ngspice, "-b", "board.cir"), cwd=path, capture_output=True, text=True, check=False
        )
        if not (path / "waves.txt").exists():
            raise RuntimeError(f"ngspice failed:\n{run.stdout[-2000:]}{run.stderr[-2000:]}")
        return np.loadtxt(path / "waves.txt", ndmin=2).T


# --- what is measured ----------------------------------------------------------------------------


def settled(time: NDArray[np.float64], wave: NDArray[np.float64], share: float = 0.01) -> float:
    """Tell when a wave stays within a share of its step of where it ends.

    Parameters
    ----------
    time, wave : ndarray, shape (N,)
    share : float
        Of the difference between the wave's first and last value.

    Returns
    -------
    float
        After the first time; 0 where it is always within.
    """
    outside = np.abs(wave - wave[-1]) > share * abs(wave[-1] - wave[0])
    return float(time[np.flatnonzero(outside)[-1] + 1] - time[0]) if outside.any() else 0.0


def _settling(netlist: Netlist) -> Iterator[Measurement]:
    (sensor,) = netlist.of_kind("sensor")
    limits = sensor.type.limits
    for what, output_ohm in zip(("typical", "at most"), limits["output_ohm"], strict=True):
        slowest = 0.0
        for dark in limits["dark"]:
            light = dark - limits["swing"]
            step = f"PWL(0 {dark} 1u {dark} 1.005u {light} 3u {light} 3.005u {dark})"
            deck = _sensor_deck(netlist, step, output_ohm)
            os = f"v({_node(_labelled(netlist, 'OS'))})"
            time, wave = simulate(deck, "tran 1n 5u 0 1n", [os])
            for begin, end in ((1e-6, 3e-6), (3e-6, 5e-6)):
                part = (time >= begin) & (time < end)
                if np.ptp(wave[part]) > 0.1 * limits["swing"]:  # else the supply clips it
                    slowest = max(slowest, settled(time[part], wave[part]))
        yield Measurement(
            "settling",
            f"output settles to 1 %, sensor's output {output_ohm:g} Ω ({what})",
            slowest,
            "s",
            ELEMENT_TIME,
            "OS",
            "make the follower's load smaller",
        )


def converter_input(netlist: Netlist) -> NDArray[np.float64]:
    """Voltage at the converter, for voltages of the sensor's output.

    Parameters
    ----------
    netlist : Netlist
        Of a sensor's board.

    Returns
    -------
    ndarray, shape (2, N)
        The sensor's, the converter's, V.
    """
    (sensor,) = netlist.of_kind("sensor")
    deck = _sensor_deck(netlist, "0", min(sensor.type.limits["output_ohm"]))
    os = f"v({_node(_labelled(netlist, 'OS'))})"
    return simulate(deck, "dc Vsensor 0.5 4 0.01", [os])


def _converter(netlist: Netlist) -> Iterator[Measurement]:
    (sensor,) = netlist.of_kind("sensor")
    dark, swing = sensor.type.limits["dark"], sensor.type.limits["swing"]
    sweep, wave = converter_input(netlist)
    names = ("least", "typical", "highest")
    for name, level in zip(names, dark, strict=True):
        yield Measurement(
            "converter range",
            f"converter's input at the {name} dark level ({level:g} V)",
            float(np.interp(level, sweep, wave)),
            "V",
            SURROUNDINGS["microcontroller"]["supply"],
            "OS",
            "divide OS behind the follower",
        )
    low, high = np.interp((dark[1] - swing, dark[1]), sweep, wave)
    yield Measurement(
        "gain",
        "gain from the sensor to the converter",
        float((high - low) / swing),
        "",
        math.nan,
        "OS",
        "divide OS by less",
        least=SURROUNDINGS["limits"]["gain"],
    )


def _logic_level(netlist: Netlist) -> Iterator[Measurement]:
    (sensor,) = netlist.of_kind("sensor")
    mcu = SURROUNDINGS["microcontroller"]
    (part,) = netlist.of_kind("inverter")
    supply = netlist.supply(netlist.at(part, "VCC"))
    spice = part.type.spice
    # an inverter that is only just as good as it must be: where "high" is sure its output is 0.1 VCC
    switch = high_level(part.type, supply) - math.atanh(0.8) / spice["gain"]
    for name in ("fM", "SH", "ICG"):
        net = _node(_labelled(netlist, name))
        deck = [
            *elements(netlist),
            *_supply(netlist),
            f"Vpin pin 0 {mcu['supply']}",
            f"Rpin pin {net} {mcu['output_ohm']}",
            f"Bgate gate 0 V={supply / 2}*(1-tanh({spice['gain']}*(V({net})-{switch})))",
            *_resting_inputs(netlist),
            f"Rsensor {_node(netlist.at(sensor, 'OS'))} 0 1e6",
        ]
        volts, gate = simulate(deck, f"dc Vpin 0 {supply} 0.005", ["v(gate)"])
        yield Measurement(
            "logic level",
            f"{name} is surely high from",
            float(np.interp(-0.1 * supply, -gate, volts)),
            "V",
            mcu["supply"],
            part.reference,
            "take a 74HCT04",
        )


def led_pulse(netlist: Netlist, factor: float = 1.0) -> NDArray[np.float64]:
    """Switch the first LED on and off.

    Parameters
    ----------
    netlist : Netlist
        Of a board that switches LEDs.
    factor : float
        Of the supply's voltage.

    Returns
    -------
    ndarray, shape (3, N)
        Time since it was switched on, s; the LED's current, A; voltage at the transistor's drain.
    """
    led = netlist.board.leds[0]
    drain = f"v({_node(netlist.at(_switch(netlist, led), 'D'))})"
    vectors = [f"i(v{led.reference})", drain]
    pulse = simulate(_led_deck(netlist, factor), f"tran 50n {_END} 0 50n", vectors)
    pulse[0] -= _ON
    return pulse


def _led(netlist: Netlist) -> Iterator[Measurement]:
    led = netlist.board.leds[0]
    switch = _switch(netlist, led)
    tolerance = SURROUNDINGS["supply"]["tolerance"]
    supplied = [led_pulse(netlist, factor) for factor in (1.0, 1 - tolerance, 1 + tolerance)]
    time, current, drain = supplied[0]
    lasting = _OFF - _ON
    on = (time >= 0) & (time < lasting)
    full = float(current[on][-1])
    rise = settled(time[on], current[on])
    quick = [float(time[on][np.argmax(current[on] >= share * full)]) for share in (0.1, 0.9)]
    resistors = [
        part
        for part, net in netlist.across(netlist.plugged(led, "anode"), "resistor")
        if netlist.supply(net)
    ]
    limits = SURROUNDINGS["limits"]
    change = "add a series resistor, and raise the supply"
    place = led.to
    yield Measurement(
        "series resistor",
        "LED current",
        full,
        "A",
        SURROUNDINGS["led"]["ampere"],
        place,
        change,
        least=limits["current"] * SURROUNDINGS["led"]["ampere"],
    )
    yield Measurement(
        "series resistor",
        "LED current rises to 99 %",
        rise,
        "s",
        SHORTEST_INTEGRATION,
        place,
        change,
    )
    yield Measurement(
        "rise", "LED current rises from 10 to 90 %", quick[1] - quick[0], "s", math.nan, place
    )
    for span in (SHORTEST_INTEGRATION, SURROUNDINGS["integration"]["thesis"]):
        lit = (time >= 0) & (time <= span)
        share = float(np.trapezoid(current[lit], time[lit])) / (full * span)
        what = f"light of {span * 1e6:g} µs, of what full current would give"
        yield Measurement("light", what, share, "", math.nan, place)
    low, high = (float(c[(t >= 0) & (t < lasting)][-1]) for t, c, _ in supplied[1:])
    yield Measurement(
        "series resistor",
        f"LED current's change for ± {100 * tolerance:g} % of the supply",
        (high - low) / 2 / full,
        "",
        limits["change"],
        place,
        change,
    )
    yield Measurement(
        "flyback path",
        "transistor's drain at switch-off, at most",
        float(drain[time >= lasting].max()),
        "V",
        limits["derating"] * switch.type.limits["drain_source"],
        switch.reference,
        "add a diode from the cathode to the supply",
    )
    for part in resistors:
        yield Measurement(
            "power",
            f"power of {part.reference} while the LED is on",
            full**2 * part.type.amount,
            "W",
            float(part.type.limits.get("power_w", limits["resistor_watt"])),
            part.reference,
            "take a larger one",
        )


def measure(board: Board, assembly: str | None = None) -> list[Measurement]:
    """Simulate a board.

    Parameters
    ----------
    board : Board
        With a sensor, or with transistors that switch LEDs.
    assembly : str, optional
        Left out, the board's first.

    Returns
    -------
    list of Measurement

    Raises
    ------
    NoSimulatorError
        If ngspice is not installed.
    """
    netlist = board.netlist(assembly)
    found: list[Measurement] = []
    if any(netlist.of_kind("sensor")):
        found += [*_settling(netlist), *_converter(netlist), *_logic_level(netlist)]
    if any(netlist.of_kind("nmos")):
        found += _led(netlist)
    return found


def check_circuits(board: Board) -> list[Finding]:
    """Report what a simulated board does outside its limits, in every assembly.

    Parameters
    ----------
    board : Board

    Returns
    -------
    list of Finding
        Hazards.

    Raises
    ------
    NoSimulatorError
        If ngspice is not installed.
    """
    return [
        Finding(
            m.check,
            m.where,
            f"{m.what}: {show(m)} ({assembly}), limit "
            + show(m, m.least if m.value < m.least else m.limit),
            m.change,
        )
        for assembly in board.assemblies
        for m in measure(board, assembly)
        if not m.holds
    ]


def assumptions() -> str:
    """Write down which models the simulation takes, and where from.

    Returns
    -------
    str
        A list in Markdown.
    """
    lines = [f"- {name}: {row['source']}" for name, row in SURROUNDINGS.items()]
    lines += [
        f"- {part.type}: {part.spice['source']}" for part in PART_TYPES.values() if part.spice
    ]
    return "Simulated; nothing has been measured on a board.\n\n" + "\n".join(lines) + "\n"


def show(measurement: Measurement, value: float | None = None) -> str:
    """Write a value of a measurement's unit for people: 130 ns."""
    value = measurement.value if value is None else value
    if math.isnan(value):
        return ""
    if not measurement.unit:
        return f"{value:.2g}" if value > 1 else f"{100 * value:.2g} %"
    for factor, prefix in ((1.0, ""), (1e-3, "m"), (1e-6, "µ"), (1e-9, "n")):
        if abs(value) >= factor * 0.9995:
            return f"{value / factor:.3g} {prefix}{measurement.unit}"
    return f"{value:.3g} {measurement.unit}"


def compare(boards: Iterable[Board]) -> str:
    """Write boards side by side.

    Parameters
    ----------
    boards : iterable of Board
        A board and its variants.

    Returns
    -------
    str
        A table in Markdown; what is out of its limit is bold.
    """
    boards = list(boards)
    columns = [{m.what: m for m in measure(board)} for board in boards]
    lines = ["| | limit | " + " | ".join(board.title for board in boards) + " |"]
    lines.append("|---|---|" + "---|" * len(boards))
    for what in dict.fromkeys(what for column in columns for what in column):
        found = [column.get(what) for column in columns]
        first = next(m for m in found if m is not None)
        cells = ["" if m is None else show(m) if m.holds else f"**{show(m)}**" for m in found]
        lines.append(f"| {what} | {show(first, first.limit)} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"
