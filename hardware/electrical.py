"""Electrical checks of the boards' netlists: what cannot work, and what works beyond a part's limits.

Faults are found in the netlist itself, by the role that each pin has to have: a board is not
compared with another one. Hazards come from the limits in ``data/parts.toml``, each with the change
that removes it; `hardware.circuits` measures most of them.
"""

from __future__ import annotations

from collections import defaultdict
from typing import TYPE_CHECKING, Final

from acquisition.wiring import WIRING
from hardware.boards import SURROUNDINGS
from hardware.findings import Finding

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from acquisition.wiring import Pin as McuPin
    from acquisition.wiring import Wiring
    from hardware.boards import Board, Connector, Netlist, Part, PartType

_DECOUPLING: Final = 0.1e-6  # farad, for each integrated circuit
_BULK: Final = 100e-6  # farad, on a supply that is switched through a cable
_IN_SERIES: Final = 1e3  # ohm, the most in series with base, collector or gate
_LOAD: Final = 1e3  # ohm, the least that an output of the microcontroller is loaded with
_PULL: Final = 100e3  # ohm, the weakest resistor that still gives an input a level


def check_board(board: Board, wiring: Wiring = WIRING) -> list[Finding]:
    """Check a board in every assembly.

    Parameters
    ----------
    board : Board
    wiring : Wiring, optional
        Left out, that of ``acquisition/wiring.toml``.

    Returns
    -------
    list of Finding
        Faults first. A hazard has its `change`, a fault has none.
    """
    found = [
        finding
        for netlist in map(board.netlist, board.assemblies)
        for check in CHECKS
        for finding in check(netlist, wiring)
    ]
    return sorted(dict.fromkeys(found), key=lambda finding: finding.hazard)


def _open_nets(netlist: Netlist, _: Wiring) -> Iterator[Finding]:
    for net, ends in netlist.nets.items():
        if len(ends) == 1:
            yield Finding("open net", net, f"{ends[0]} is alone on it")


def _pins(netlist: Netlist, _: Wiring) -> Iterator[Finding]:
    for part in netlist.parts.values():
        for pin, end, net in netlist.pins(part):
            if not net and end not in netlist.board.no_connect:
                message = f"{pin.name} is on no net and not marked as unconnected"
                yield Finding("unconnected pin", str(end), message)
            if net and end in netlist.board.no_connect:
                yield Finding("unconnected pin", str(end), f"marked as unconnected, but on {net}")


def _shorts(netlist: Netlist, _: Wiring) -> Iterator[Finding]:
    nets = defaultdict(list)
    for net, ends in netlist.board.nets.items():
        for end in ends:
            nets[end].append(net)
    for end, several in nets.items():
        if len(several) > 1:
            yield Finding("short", str(end), f"is on {' and '.join(several)}")
    for part in netlist.parts.values():
        if len(part.type.pins) == 2 and part.type.kind != "header":
            first, second = (net for _, _, net in netlist.pins(part))
            if first and first == second:
                yield Finding("short", part.reference, f"both ends are on {first}")
    for net in netlist.nets:
        names = {
            name
            for connector, name, _ in netlist.labels(net)
            if connector.wiring or name in netlist.board.supplies
        }
        if len(names) > 1:
            yield Finding("short", net, f"joins {' and '.join(sorted(names))}")


def _supplies(netlist: Netlist, _: Wiring) -> Iterator[Finding]:
    for name in netlist.board.supplies:
        nets = [
            net for net in netlist.nets if name in {label for _, label, _ in netlist.labels(net)}
        ]
        if len(nets) > 1:
            yield Finding("supply", name, f"is on {' and '.join(nets)}")
    for part in netlist.parts.values():
        for pin, end, net in netlist.pins(part):
            where = net or "nothing"
            if pin.function == "ground" and not netlist.grounded(net):
                yield Finding("supply", str(end), f"{pin.name} is on {where}, no ground")
            if pin.function == "supply":
                low, high = part.type.limits["supply"]
                if not low <= netlist.supply(net) <= high:
                    yield Finding(
                        "supply",
                        str(end),
                        f"{pin.name} is on {where} with {netlist.supply(net):.3g} V "
                        f"({netlist.assembly}); {part.type.type} takes {low:g} to {high:g} V",
                    )


def _regulator(netlist: Netlist, _: Wiring) -> Iterator[Finding]:
    for part in netlist.of_kind("regulator"):
        made, given = netlist.at(part, "OUT"), netlist.at(part, "IN")
        most = netlist.supply(given) - part.type.limits["dropout"]
        if netlist.supply(made) > most:
            message = f"is to make {netlist.supply(made):.3g} V, but can make {most:.3g} V"
            yield Finding("regulator", part.reference, message)
        capacitors = list(netlist.across(made, "capacitor", "polarised capacitor"))
        if not any(netlist.grounded(net) and c.type.amount >= 1e-6 for c, net in capacitors):
            yield Finding("regulator", part.reference, f"{made} has no 1 µF to ground")
        if netlist.at(part, "BYP") not in {net for _, net in capacitors}:
            yield Finding("regulator", part.reference, "no capacitor from OUT to BYP")


def _decoupling(netlist: Netlist, _: Wiring) -> Iterator[Finding]:
    served = defaultdict(set)
    for part in netlist.of_kind("sensor", "inverter"):
        for pin, _end, net in netlist.pins(part):
            if pin.function == "supply":
                served[net].add(part.reference)
    for net, parts in served.items():
        capacitors = [
            part
            for part, other in netlist.across(net, "capacitor")
            if netlist.grounded(other) and part.type.amount >= _DECOUPLING
        ]
        if len(capacitors) < len(parts):
            message = (
                f"{len(capacitors)} capacitors of 0.1 µF to ground for {', '.join(sorted(parts))}"
            )
            yield Finding("decoupling", net or "no net", message)


def _polarity(netlist: Netlist, _: Wiring) -> Iterator[Finding]:
    for part in netlist.of_kind("polarised capacitor"):
        plus, minus = netlist.at(part, "+"), netlist.at(part, "-")
        if not (netlist.supply(plus) and netlist.grounded(minus)):
            message = f"+ on {plus}, - on {minus}: not from a supply to ground"
            yield Finding("polarity", part.reference, message)
    for part in netlist.of_kind("diode"):
        if netlist.supply(netlist.at(part, "A")) > netlist.supply(netlist.at(part, "K")):
            yield Finding(
                "polarity", part.reference, "conducts the supply: anode and cathode swapped"
            )


def _inverted(netlist: Netlist, net: str) -> str:
    """Return the input net of the inverter that drives a net, or an empty string."""
    for end in netlist.nets.get(net, ()):
        part = netlist.parts[end.reference]
        if part.type.kind == "inverter" and netlist.pin(end).function == "output":
            return netlist.at(part, netlist.pin(end).name[0] + "A")
    return ""


def _sensor(netlist: Netlist, wiring: Wiring) -> Iterator[Finding]:
    """Whether each pin of the sensor does what the datasheet's pin of this number does."""
    for part in netlist.of_kind("sensor"):
        for pin, end, net in netlist.pins(part):
            if pin.function == "nc" and net and not netlist.grounded(net):
                yield Finding("sensor pin", str(end), f"{pin.name} may be grounded, not on {net}")
            if pin.function == "input":
                source = _inverted(netlist, net) if wiring.inverted else net
                names = [name for _, name, _ in netlist.labels(source)]
                if names != [pin.name]:
                    through = "through an inverter " if wiring.inverted else ""
                    yield Finding(
                        "sensor pin",
                        str(end),
                        f"{pin.name} is driven {through}by {' and '.join(names) or 'nothing'}",
                    )
            if pin.function == "output":
                bases = [netlist.at(follower, "B") for follower in netlist.of_kind("pnp")]
                if not netlist.near(net, _IN_SERIES) & set(bases):
                    yield Finding("sensor pin", str(end), f"{pin.name} drives no follower")


def _follower(netlist: Netlist, _: Wiring) -> Iterator[Finding]:
    """Whether every leg of the emitter follower has its role."""
    outputs = {
        net
        for part in netlist.of_kind("sensor")
        for pin, _end, net in netlist.pins(part)
        if pin.function == "output"
    }
    for part in netlist.of_kind("pnp"):
        emitter, collector, base = (netlist.at(part, leg) for leg in "ECB")
        where = part.reference
        if not netlist.near(base, _IN_SERIES) & outputs:
            yield Finding("transistor legs", where, f"base on {base}: not the sensor's output")
        loads = [net for _, net in netlist.across(emitter, "resistor") if netlist.supply(net) > 0]
        if not loads:
            yield Finding("transistor legs", where, f"emitter on {emitter}: no load to a supply")
        if not any(netlist.grounded(net) for net in netlist.near(collector, _IN_SERIES)):
            yield Finding("transistor legs", where, f"collector on {collector}: no way to ground")
        names = {name for net in netlist.near(emitter) for _, name, _ in netlist.labels(net)}
        if "OS" not in names:
            yield Finding("transistor legs", where, f"emitter on {emitter}: does not reach OS")


def _channels(netlist: Netlist, _: Wiring) -> Iterator[Finding]:
    """Whether every LED has its own transistor, with every leg in its role."""
    used = set()
    for part in netlist.of_kind("nmos"):
        gate, drain, source = (netlist.at(part, leg) for leg in "GDS")
        where = part.reference
        controls = [
            name for net in netlist.near(gate, _IN_SERIES) for _, name, _ in netlist.labels(net)
        ]
        controls = [name for name in controls if name != "GND"]
        if len(controls) != 1:
            yield Finding("transistor legs", where, f"gate on {gate}: no pin controls it alone")
        if not netlist.grounded(source):
            yield Finding("transistor legs", where, f"source on {source}: not ground")
        leds = [plug for plug, name, _ in netlist.labels(drain) if name == "cathode"]
        if len(leds) != 1:
            yield Finding("transistor legs", where, f"drain on {drain}: {len(leds)} LEDs' cathodes")
            continue
        used.add(leds[0].reference)
        for diode in netlist.of_kind("diode"):
            if drain == netlist.at(diode, "A") and not netlist.supply(netlist.at(diode, "K")):
                message = f"cathode on {netlist.at(diode, 'K')}: no supply that takes LED's current"
                yield Finding("polarity", diode.reference, message)
        if controls and leds[0].to != f"LED {controls[0]}":
            yield Finding("LED order", where, f"pin {controls[0]} switches {leds[0].to}")
        anode = netlist.plugged(leds[0], "anode")
        if not any(netlist.supply(net) > 0 for net in netlist.near(anode)):
            yield Finding("LED order", leds[0].reference, f"anode on {anode}: no supply")
    for led in netlist.board.leds:
        if led.reference not in used:
            yield Finding("LED order", led.reference, "its cathode is on no drain")


def _drivers(netlist: Netlist, wiring: Wiring) -> Iterator[Finding]:
    high = SURROUNDINGS["microcontroller"]["supply"]
    for net, ends in netlist.nets.items():
        driving = [str(end) for end in ends if netlist.pin(end).function in {"output", "regulated"}]
        supplied = False
        for connector, name, _ in netlist.labels(net):
            supplied |= name in netlist.board.supplies
            pin = _mcu_pin(connector, name, wiring)
            if pin is None or pin.direction != "out":
                continue
            driving.append(f"{connector.reference} ({name})")
            for part, other in netlist.across(net, "resistor"):
                volts = netlist.volts.get(other)
                if volts is not None and (part.type.amount < _LOAD or volts > high):
                    message = f"{name} is loaded: {part.type.type} {part.reference} to {volts:g} V"
                    yield Finding("drivers", net, message)
        if len(driving) + supplied > 1 and driving:
            others = " and a supply" if supplied else ""
            yield Finding("drivers", net, f"driven by {' and '.join(driving)}{others}")


def _floating(netlist: Netlist, _: Wiring) -> Iterator[Finding]:
    for part in netlist.of_kind("inverter", "nmos", "sensor"):
        for pin, end, net in netlist.pins(part):
            if pin.function != "input":
                continue
            if part.type.kind == "inverter" and not netlist.at(part, pin.name[0] + "Y"):
                if net not in netlist.volts:
                    message = f"{pin.name} is not used, but on {net or 'no net'}, not at a supply"
                    yield Finding("floating input", str(end), message)
                continue
            driven = net in netlist.volts or any(
                netlist.pin(other).function in {"output", "regulated"}
                for other in netlist.nets.get(net, ())
            )
            pulled = any(
                netlist.grounded(other) and resistor.type.amount <= _PULL
                for resistor, other in netlist.across(net, "resistor")
            )
            if driven or pulled:
                continue
            if netlist.labels(net):
                message = f"{net} has no level while the microcontroller starts or no wire is there"
                yield Finding("floating input", str(end), message, "add a resistor to ground")
            else:
                message = f"nothing drives {pin.name}, on {net or 'no net'}"
                yield Finding("floating input", str(end), message)


def _far_net(connector: Connector, name: str, wiring: Wiring) -> str:
    """Return wiring.toml's net of a connector's pin, or an empty string."""
    for table in wiring.connectors:
        if connector.wiring and table.other == connector.wiring:
            return next((net for net, end in table.wires if end == name), "")
    return ""


def _mcu_pin(connector: Connector, name: str, wiring: Wiring) -> McuPin | None:
    """Return the microcontroller's pin that is wired to a connector's pin."""
    return wiring.pins.get(_far_net(connector, name, wiring))


def _far_end(connector: Connector, name: str, wiring: Wiring) -> str:
    """Return the microcontroller's pin, or supply, that is wired to a connector's pin."""
    pin = _mcu_pin(connector, name, wiring)
    return _far_net(connector, name, wiring) if pin is None else pin.name


def _wiring(netlist: Netlist, wiring: Wiring) -> Iterator[Finding]:
    """Whether the connectors' pins are where wiring.toml has them."""
    for connector in netlist.board.connectors.values():
        if not connector.wiring:
            continue
        wires = dict.fromkeys(
            end
            for table in wiring.connectors
            if table.other == connector.wiring
            for _, end in table.wires
        )
        for number, (name, far) in enumerate(connector.pins, start=1):
            wires.pop(name, None)
            wired = _far_end(connector, name, wiring)
            if wired != far:
                message = f"{name} is for {far or 'nothing'}, but wired to {wired or 'nothing'}"
                yield Finding("wiring", f"{connector.reference}.{number}", message)
        for end in wires:
            yield Finding("wiring", connector.reference, f"no pin for the wire {end}")


def _functions(netlist: Netlist, wiring: Wiring) -> Iterator[Finding]:
    """Whether the microcontroller's pins can do what the nets they are wired to need."""
    for net, ends in netlist.nets.items():
        kinds = {
            netlist.parts[end.reference].type.kind
            for end in ends
            if netlist.pin(end).function == "input"
        }
        for connector, name, _ in netlist.labels(net):
            pin = _mcu_pin(connector, name, wiring)
            if pin is None:
                continue  # a supply, or no wire
            can = pin.signal or "no peripheral"
            if kinds & {"inverter", "sensor"}:
                if pin.direction != "out" or not can.startswith("TIM"):
                    yield Finding(
                        "pin function", name, f"needs a timer's output; {pin.name}: {can}"
                    )
            elif "nmos" in kinds:
                if pin.direction != "out":
                    yield Finding("pin function", name, f"needs an output; {pin.name}: {can}")
            elif pin.direction != "analog" or not can.startswith("ADC"):
                yield Finding("pin function", name, f"needs the converter; {pin.name}: {can}")


# hazards: each from the parts' limits, and with the change that removes it


def _logic_level(netlist: Netlist, _: Wiring) -> Iterator[Finding]:
    given = SURROUNDINGS["microcontroller"]["supply"]
    for part in netlist.of_kind("inverter"):
        supply = netlist.supply(netlist.at(part, "VCC"))
        sure = high_level(part.type, supply)
        if sure > given:
            yield Finding(
                "logic level",
                part.reference,
                f"{part.type.type} wants {sure:.3g} V for a high at {supply:.3g} V "
                f"({netlist.assembly}); the microcontroller gives {given:g} V",
                "take a 74HCT04",
            )


def high_level(inverter: PartType, supply: float) -> float:
    """Tell from which V on an inverter's input is surely high.

    Parameters
    ----------
    inverter : PartType
    supply : float
        V.
    """
    limits = inverter.limits
    return float(limits["high"] if "high" in limits else limits["high_of_supply"] * supply)


def _converter(netlist: Netlist, _: Wiring) -> Iterator[Finding]:
    most = SURROUNDINGS["microcontroller"]["supply"]
    for part in netlist.of_kind("pnp"):
        emitter = netlist.at(part, "E")
        for net in netlist.near(emitter):
            if any(name == "OS" for _, name, _ in netlist.labels(net)):
                level = _darkest(netlist, part) * netlist.share(emitter, net)
                where = f"at the sensor's highest dark level ({netlist.assembly})"
                if level > most:
                    yield Finding(
                        "converter range",
                        "OS",
                        f"reaches {level:.2g} V {where}; the converter takes {most:g} V",
                        "divide OS behind the follower",
                    )
                if level < most / 2:
                    message = f"reaches but {level:.2g} V {where}, of the converter's {most:g} V"
                    yield Finding("converter range", "OS", message)


def _darkest(netlist: Netlist, follower: Part) -> float:
    """V at the follower's emitter at the sensor's highest dark level."""
    dark = max(max(sensor.type.limits["dark"]) for sensor in netlist.of_kind("sensor"))
    loads = netlist.across(netlist.at(follower, "E"), "resistor")
    supply = max((netlist.supply(net) for _, net in loads), default=0.0)
    return min(float(dark + follower.type.limits["emitter_base"]), supply)


def _master_clock(netlist: Netlist, wiring: Wiring) -> Iterator[Finding]:
    for part in netlist.of_kind("sensor"):
        supply = netlist.supply(netlist.at(part, "VDD"))
        needed = part.type.limits["supply_for_4_mhz"]
        if wiring.mcu.master_clock > 2_400_000 and supply < needed:
            yield Finding(
                "master clock",
                part.reference,
                f"runs from {supply:.3g} V ({netlist.assembly}), and takes more than 2.4 MHz from "
                f"{needed:g} V on; fM has {wiring.mcu.master_clock / 1e6:g} MHz",
                "leave the regulator out",
            )


def _led_current(netlist: Netlist, _: Wiring) -> Iterator[Finding]:
    for part in netlist.of_kind("nmos"):
        drain = netlist.at(part, "D")
        for led, name, _far in netlist.labels(drain):
            if name != "cathode":
                continue
            anode = netlist.plugged(led, "anode")
            if netlist.supply(anode) > 0:
                yield Finding(
                    "series resistor",
                    led.to,
                    "nothing but cable and LED sets its current, and its rise takes L/R of these",
                    "add a resistor, and raise the supply",
                )
            returns = {netlist.at(diode, "K") for diode in netlist.of_kind("diode")
                       if netlist.at(diode, "A") == drain}  # fmt: skip
            if not any(netlist.supply(net) > 0 for net in returns):
                yield Finding(
                    "flyback path",
                    led.to,
                    f"the cable's current ends in the transistor's breakdown "
                    f"({part.type.limits['drain_source']:g} V)",
                    "add a diode from the cathode to the supply",
                )


def _alike(netlist: Netlist, _: Wiring) -> Iterator[Finding]:
    """All LEDs are switched alike: the simulation is of the first."""

    def parts(led: Connector) -> list[str]:
        drain = netlist.plugged(led, "cathode")
        nets = {drain, netlist.plugged(led, "anode")}
        nets |= {
            netlist.at(part, "G")
            for part in netlist.of_kind("nmos")
            if netlist.at(part, "D") == drain
        }
        nets -= set(netlist.volts)
        return sorted(
            str(part.type)
            for part in netlist.parts.values()
            if any(net in nets for _, _, net in netlist.pins(part))
        )

    leds = netlist.board.leds
    for led in leds[1:]:
        if (other := parts(led)) != (first := parts(leds[0])):
            message = f"has {', '.join(other)}; {leds[0].to} has {', '.join(first)}"
            yield Finding("LEDs alike", led.to, message)


def _bulk(netlist: Netlist, _: Wiring) -> Iterator[Finding]:
    if not any(netlist.of_kind("nmos")):
        return
    for net, volts in netlist.volts.items():
        if volts > 0 and not any(
            netlist.grounded(other) and part.type.amount >= _BULK
            for part, other in netlist.across(net, "polarised capacitor")
        ):
            yield Finding(
                "bulk capacitor",
                net,
                "pulses of the LEDs' current pass the supply's leads",
                f"add {_BULK * 1e6:g} µF or more at its socket",
            )


CHECKS: Final[Sequence[Callable[[Netlist, Wiring], Iterator[Finding]]]] = (
    _open_nets,
    _pins,
    _shorts,
    _supplies,
    _regulator,
    _decoupling,
    _polarity,
    _sensor,
    _follower,
    _channels,
    _drivers,
    _floating,
    _wiring,
    _functions,
    _logic_level,
    _converter,
    _master_clock,
    _led_current,
    _alike,
    _bulk,
)
"""Every check of a netlist."""
