"""The assembly instructions of a build package: one page that needs no other file.

Everything on it is calculated from the same plan as the package's files.
"""

from __future__ import annotations

import base64
import re
import struct
import zlib
from decimal import Decimal
from html import escape
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from acquisition.wiring import WIRING
from hardware import kicad
from hardware.boards import BOARDS, DATA, SURROUNDINGS
from hardware.circuits import assumptions, show
from hardware.electrical import check_board
from hardware.mesh import bounds, cross_section, volume
from hardware.mount import mechanics
from hardware.package import LEDS, Fault, overhang
from hardware.render import exploded, on_pole, picture, standing
from raytransfer.lenses import Lens, SphericalLens

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from numpy.typing import NDArray

    from hardware.bill import Bill
    from hardware.boards import Board
    from hardware.mount import LensMount
    from hardware.package import Plan
    from hardware.solids import Solid

LAYER: Final = 0.15
"""Layer height that the thesis printed with (section 4.4.1), mm."""

_PLA: Final = 1.24e-3  # density, g/mm³
_SUPPORT: Final = 100.0  # mm² in the air from which on a slicer should be let make supports
_TOGETHER: Final = 16  # rows of a table that is not cut by the end of a page


def page(plan: Plan, files: Sequence[str]) -> str:
    """Write the instructions of a plan.

    Parameters
    ----------
    plan : Plan
    files : sequence of str
        Paths of the package's other files.

    Returns
    -------
    str
        HTML; pictures and style are in it.
    """
    sections = {
        "What it is": _overview(plan),
        "Print the parts": _printing(plan),
        "What to buy": _bills(plan),
        "Boards": _boards(plan),
        "Put it together": _assembly(plan),
        "Wiring": _wiring(plan),
        "Firmware and first light": _first_light(plan),
        "Hazards of the circuits": _hazards(plan),
        "What was checked, and what was not": _checked(plan),
        "Files": _file_list(files),
    }
    titles = {title: re.sub(r"\W+", "-", title.lower()) for title in sections}
    contents = "".join(f'<li><a href="#{at}">{title}</a></li>' for title, at in titles.items())
    fresh = {"Print the parts", "What to buy", "Boards", "Put it together", "Wiring"}
    body = "\n".join(
        f'<h2 id="{titles[title]}"{" class=page" if title in fresh else ""}>{number}. {title}</h2>'
        f"\n{text}"
        for number, (title, text) in enumerate(sections.items(), start=1)
    )
    name = escape(plan.design.system.name)
    css = (DATA / "assembly.css").read_text(encoding="utf-8")
    return f"""\
<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>Build: {name}</title>
<style>
{css}</style>
</head>
<body>
<h1>How to build: {name}</h1>
<p class="under">Lens head, stand and electronics · boards: {plan.variant} variant ·
sensor: {escape(plan.design.sensor.name)}</p>
<p class="note warn"><strong>Calculated and simulated, never made.</strong> Nobody has printed,
soldered or measured anything from these files yet. Check a part before the next one depends on it.</p>
<nav><ol>{contents}</ol></nav>
{body}
</body>
</html>
"""


# --- sections -------------------------------------------------------------------------------------


def _overview(plan: Plan) -> str:
    mount = plan.mount
    size = " × ".join(f"{side:.1f}" for side in mount.size)
    rows = [
        ("Lens mount, outside (width × height × length)", f"{size} mm"),
        ("Halves held together by", f"{len(mount.screws)} × {plan.mount_screw}"),
        ("LEDs", f"{LEDS}, on a pole of {plan.led.rules['pole']:g} mm"),
        ("Supply of the LEDs", f"{plan.led_supply:g} V"),
        ("Parts whose price is known", f"{_total(plan.bills.values())} €"),
    ]
    heights = mount.heights()
    lenses = [e for e in plan.design.system.elements if isinstance(e, Lens | SphericalLens)]
    table = [
        (
            str(number),
            name,
            _facing(lens),
            f"{lens.centre_thickness:.2f}",
            f"{heights[name]:.2f}",
        )
        for number, (name, lens) in enumerate(zip(heights, lenses, strict=True), start=1)
    ]
    return f"""
{_table((), rows)}
<div class="pair">
{_figure(picture(exploded(mount, 24.0), pixels=640), "The head taken apart. Light comes from the right front.")}
{_figure(picture(standing(plan.stand), azimuth=215.0, elevation=35.0, pixels=760), "Head, computers and LED board on the stand, from behind.")}
</div>
<h3>Lenses, in the order in which light meets them</h3>
{_table(("No.", "Lens", "How it lies", "Thick, mm", "Above cover, mm"), table, "lllnn")}
<p>“Above cover” is from the lens's last vertex (on the sensor's side) to the outer face of the
sensor's cover glass.</p>
<figure>{section(mount)}<figcaption>The head cut where its halves meet, seen from above; lengths in
mm. Heights end at the sensor's cover glass (dashed); the lowest length is the mount's.</figcaption></figure>
"""


def _facing(lens: Lens | SphericalLens) -> str:
    front, back = (surface.curvature for surface in lens.surfaces())
    shapes = [
        "flat" if not bend else "bulging" if bend > 0 else "hollow" for bend in (front, -back)
    ]
    if isinstance(lens, Lens):
        way = "pixel line" if lens.bends == "x" else "height"
        bent = f"; curved along the {way}"
    else:
        bent = ""
    return f"{shapes[0]} side to the light, {shapes[1]} side to the sensor{bent}"


def _printing(plan: Plan) -> str:
    rows = []
    for part in plan.printed:
        low, high = bounds(part.solid)
        size = " × ".join(f"{side:.1f}" for side in high - low)
        air = overhang(part.solid)
        rows.append(
            (
                part.name,
                str(part.amount),
                f"{size} mm",
                f"{volume(part.solid) / 1000:.1f} cm³",
                "yes" if air > _SUPPORT else "no",
                f"<code>{escape(part.path)}</code>",
            )
        )
    rules, grams = plan.mount.rules, _PLA * sum(volume(p.solid) * p.amount for p in plan.printed)
    settings = [
        ("Printer", f"{' × '.join(f'{side:g}' for side in mechanics()['printer']['size'])} mm at least: no part is larger"),
        ("Layers", f"{LAYER:g} mm (as the thesis printed)"),
        ("Nozzle, walls", (f"0.4 mm, at least three lines: no wall is thinner than "
         f"{rules.printable_wall:g} mm")),
        ("Infill", "30 % or more; 100 % around the screws where the slicer can do that"),
        ("Material", ("PLA, opaque and matt black for the mount's halves. The thesis took "
         "transparent PLA, which lets light from the side reach the sensor")),
        ("Filament", f"at most {grams:.0f} g, if everything were solid"),
        ("Position", "as in the files: z is up, the bed at 0; units are mm"),
        ("Supports", "only where the table says so, and never inside the lens mount"),
    ]  # fmt: skip
    header = ("Part", "Pieces", "On the bed", "Volume", "Supports", "File")
    return f"""
{_table((), settings)}
{_table(header, rows, "lnnnll", raw=(5,))}
<p>Before anything is mounted: each lens has to drop into its pocket by itself. It has
{rules.lateral_clearance:g} mm of room on every side and {rules.axial_clearance:g} mm before and
behind; scrape off what the first layers spread. The halves have to meet without a gap.</p>
"""


def _bills(plan: Plan) -> str:
    text = "".join(map(_bill, plan.bills.values()))
    without = sum(len(bill.unpriced) for bill in plan.bills.values())
    return f"""
<p>Prices are those the thesis paid; a dash means that no source gives one. Optional parts have an
asterisk. The same lists, with footprints, are in <code>bill/</code>.</p>
{text}
<p class="sum">All together: {_total(plan.bills.values())} €, without {without} lines that have no
price.</p>
"""


def _bill(bill: Bill) -> str:
    def euro(price: Decimal | None) -> str:
        return "–" if price is None else f"{price:.2f}"

    rows = [
        (line.label, " ".join(line.references), str(line.amount), euro(line.price),
         euro(line.total))
        for line in bill.lines
    ]  # fmt: skip
    foot = ("Total", "", str(sum(line.amount for line in bill.lines)), "", euro(bill.total or None))
    header = ("Type", "On the board", "Amount", "Each, €", "All, €")
    if not any(line.references for line in bill.lines):
        short = [(row[0], *row[2:]) for row in rows]
        return _table(
            (header[0], *header[2:]), short, "lnnn", caption=bill.title, foot=(foot[0], *foot[2:])
        )
    return _table(header, rows, "llnnn", caption=bill.title, foot=foot)


def _total(bills: Iterable[Bill]) -> str:
    return f"{sum((bill.total for bill in bills), Decimal(0)):.2f}"


def _boards(plan: Plan) -> str:
    text = """
<p>Send each archive of Gerber files to a maker of boards as it is: two copper layers, standard
copper, any colour. The schematics are in the PDF beside it.</p>"""
    for board in plan.boards:
        outline = kicad.outline(kicad.layout_of(board))
        width, height = outline["size"]
        pictures = "".join(
            _image(
                "svg+xml",
                (kicad.COMMITTED / board.name / f"{board.name}-{side}.svg").read_bytes(),
                f"{side.capitalize()} of the {board.title}",
            )
            for side in ("front", "back")
        )
        text += f"""
<h3>{escape(board.title)}</h3>
<p>{width:g} × {height:g} mm, {outline["thickness"]:g} mm thick. Order with
<code>boards/{board.name}-gerbers.zip</code>; schematic:
<code>boards/{board.name}-schematic.pdf</code>.</p>
<p>{escape(" ".join(board.notes.split()))}</p>
<div class="pair">{pictures}</div>"""
    return text


def _assembly(plan: Plan) -> str:
    mount, around = plan.mount, plan.stand
    sensor_board, led_board = plan.boards
    core = f"{mount.rules.core_hole:g}"
    groups: dict[str, list[str]] = {
        "Boards": [
            *_soldering(sensor_board),
            (
                "Solder the two socket strips for the sensor on the side where its outline is printed; "
                "leave the sensor itself aside until the head is closed."
            ),
            *_soldering(led_board),
        ],
        "Head": [
            (
                f"Cut M2.5 threads into the {len(mount.board.holes)} holes ({core} mm) in the mount's "
                "back, or let the screws do that now, without the board."
            ),
            (
                "Put the lower half on the table, open side up, front to the left. Wear gloves: "
                "fingerprints scatter light."
            ),
            *(
                f"Lay lens {number}, {name}, into its pocket: {_facing(lens)}."
                for number, (name, lens) in enumerate(
                    zip(
                        mount.heights(),
                        (e for e in mount.system.elements if isinstance(e, Lens | SphericalLens)),
                        strict=True,
                    ),
                    start=1,
                )
            ),
            (
                "Lower the upper half onto them. It has to close by its own weight; if it does not, a "
                "lens is turned round or has moved."
            ),
            (
                f"Set the head on the lens holder, {plan.mount_screw}s with washers "
                "from above through both halves and the holder, nuts below. Tighten crosswise until "
                "the halves touch, no more."
            ),
            (
                "Set the sensor into its strips with pin 1 at the mark on the board, and take off the "
                "cover's protection."
            ),
            (
                f"Screw the sensor's board to the back of the head with {len(mount.board.holes)} "
                f"{mechanics()['sensor_board']['screw']} screws, sensor inwards, {_connector_side(plan.boards[0])}, crosswise and only hand-tight."
            ),
        ],
        "Stand": [
            (
                f"Join the base and its feet with {len(around.foot_screws)} {plan.foot_screw}s: lens "
                "holder with the head in front, foot in the middle, LED board holder behind."
            ),
            *(
                f"Screw the {_computer(board.name)} to the {board.part} with {len(board.holes)} "
                f"{plan.board_screw}s."
                for board in around.boards
            ),
        ],
        f"LEDs ({LEDS} times)": [
            "Solder the two-core wire to the LED and to the two-pin socket; mark the anode.",
            (
                "Put thermal compound between LED and heat sink, and screw both to the plate of the LED "
                f"mount with {len(plan.led.screws)} M3 screws. Their length is the heat sink's "
                f"thickness and {plan.led.rules['core_depth'] - 1:g} mm more, at most."
            ),
            (
                f"Slide the mount onto the pole ({plan.led.rules['pole']:g} mm) and close the clamp "
                f"with {plan.clamp_screw.removesuffix(' screw')} and a nut."
            ),
        ],
    }
    text, number = "", 0
    for title, steps in groups.items():
        items = "".join(f"<li>{escape(step)}</li>" for step in steps)
        text += f'<h3>{title}</h3>\n<ol class="steps" style="--from: {number}">{items}</ol>\n'
        number += len(steps)
    image = picture(on_pole(plan.led), azimuth=40.0, elevation=20.0, pixels=420)
    return text + _figure(image, "LED mount on its pole; LED and heat sink go on the flat plate.")


def _computer(name: str) -> str:
    return {
        "raspberry_pi": "Raspberry Pi",
        "nucleo": "Nucleo board",
        "led_control": "LED control board",
    }[name]


def _connector_side(board: Board) -> str:
    """Say how the sensor's board is turned: its screw holes would take it any way round."""
    x, y = kicad.layout_of(board)["board"]["parts"]["P1"][:2]  # seen from the light, y up
    sides = ("right", "left") if abs(x) > abs(y) else ("bottom", "top")
    return f"connector P1 at the {sides[max(x, y, key=abs) > 0]} seen from behind"


def _soldering(board: Board) -> Iterator[str]:
    built = board.assemblies[0]
    spare = [part.reference for part in board.parts.values() if part.only not in {"", built}]
    left = f" Leave out {', '.join(spare)}." if spare else ""
    front = kicad.layout_of(board)["board"]["front"]
    sides = "" if front == "all" else f" All but {', '.join(front)} go on the back."
    yield (
        f"Solder the {board.title}, low parts first: resistors, diodes, sockets and small "
        "capacitors, then the rest, each on the side where its outline is "
        f"printed.{sides}{left}"
    )
    for assembly, *ends in board.wires:
        if assembly == built:
            yield (
                f"{board.title}: solder a wire from {ends[0]} to {ends[1]} (part and number of its "
                "pin), which bypasses the regulator."
            )


def _wiring(plan: Plan) -> str:
    text = """
<p>Jumper wires, all boards without power. Every connector needs its own ground wire.</p>"""
    for connector in WIRING.connectors:
        if connector.table is None:
            continue  # an extension, of which nothing is in the package
        title = f"{connector.name} (thesis, table {connector.table})"
        text += _table(
            ("Net", WIRING.mcu.part, connector.other), WIRING.rows(connector), "lll", caption=title
        )
    board = plan.boards[-1]
    (control,) = (c for c in WIRING.connectors if c.other == board.connectors["P1"].wiring)
    nets = {f"LED {end}": net for net, end in control.wires}
    free = [pin for pin in WIRING.leds.gpio if pin.net not in nets.values()]
    unlit = [plug.to.removeprefix("LED ") for plug in board.leds if plug.to not in nets]
    more = ", ".join(
        f"{pin.net} ({pin.name}, {WIRING.places[WIRING.mcu.part][pin.name]}) to {end}"
        for pin, end in zip(free, unlit, strict=True)
    )
    sockets = [
        (reference, plug.to, nets.get(plug.to, ""), *(name for name, _ in plug.pins))
        for reference, plug in board.connectors.items()
        if plug.to in nets or not (plug in board.leds or plug.wiring)
    ]
    columns = ("Socket", "For", "Lit by", "Pin 1 (square)", "Pin 2")
    return (
        text
        + _table(columns, sockets, "lllll", caption=f"{board.title} to LEDs and their supply")
        + """
<p>Two LEDs, as the thesis wires them, tell a position whose heading is known. For the three or more that tell the
heading as well, wire further outputs of the microcontroller to the control board's inputs, """
        + more
        + """, and a
LED to each one's socket; nothing else changes.</p>
<p>The LED lit by led0 is channel 0 of the programs, that by led1 channel 1. <code>linetrack track</code> takes them to
stand 500 mm apart, channel 0 on the right for who looks at them from the tracker, unless it is told where they are
(<code>--leds</code>).</p>
<p>The same tables, and those of extensions, are in <code>wiring/wiring.md</code>; <code>wiring/wiring.h</code> is the header
that the firmware is compiled with. All come from one file, so that they agree.</p>"""
    )


def _first_light(plan: Plan) -> str:
    led = plan.boards[-1]
    ampere = SURROUNDINGS["led"]["ampere"]
    source = "" if led.base else " The thesis does not state this voltage; it is assumed."
    steps = [
        "Compare every wire with the tables once more. Measure that no supply is shorted to ground.",
        (
            "Without LEDs and their supply: plug in the Nucleo board and load the firmware as "
            "wiring/firmware.md says."
        ),
        "Measure the supply at the sensor's board: 5 V.",
        (
            "On the Raspberry Pi: linetrack capture -n 2, then linetrack plot output00001.dat. A line "
            "that is all 0 or all 65535 means a wrong or loose wire; a saturated one means room light."
        ),
        (
            f"Now the LEDs' supply: {plan.led_supply:g} V, limited to {ampere:g} A, which is one LED's. Plug "
            f"in one; it must stay dark while nothing is captured.{source}"
        ),
        (
            "Capture again: each LED makes one spike. linetrack track lights several at once: raise "
            f"the supply's limit to {ampere:g} A times the LEDs that are plugged in."
        ),
    ]
    items = "".join(f"<li>{escape(step)}</li>" for step in steps)
    return f"""
<ol class="steps">{items}</ol>
<p class="note warn"><strong>Eyes and fingers.</strong> Never look into an LED of this power. Heat
sinks and series resistors get hot when an LED is lit for long; in normal use it flashes for
microseconds.</p>"""


def _hazards(plan: Plan) -> str:
    improved = plan.variant != "thesis"
    bases = [BOARDS[board.base or board.name] for board in plan.boards]
    if improved:
        found = [Fault(b.title, f) for b in bases for f in check_board(b) if f.hazard]
        intro = (
            "The thesis's boards work, but not within the limits of every part. The boards of this "
            "package are another design, which the thesis did not build; no check finds any of "
            "these hazards on them."
        )
    else:
        found = list(plan.hazards)
        intro = (
            "These boards are the thesis's. They work, but not within the limits of every part. "
            "Know the list before you switch on; the boards of the improved variant are free of it."
        )
    rows: dict[tuple[str, str], tuple[list[str], dict[str, str]]] = {}
    for title, finding in found:
        places, messages = rows.setdefault((title, finding.check), ([], {}))
        if finding.where not in places:
            places.append(finding.where)
        messages.setdefault(re.sub(r"[\d.]+", "", finding.message), finding.message)
    removed = {
        (base.title, change.removes): change.why
        for base in bases
        for other in BOARDS.values()
        if other.base == base.name
        for change in other.changes
    }
    text = f"<p>{intro}</p>"
    for base in bases:
        table = [
            (check, ", ".join(places), "; ".join(messages.values()), removed[title, check])
            for (title, check), (places, messages) in rows.items()
            if title == base.title
        ]
        last = "Removed here by" if improved else "What removes it"
        text += _table(("Hazard", "Where", "What happens", last), table, "llll", caption=base.title)
    if plan.measurements is None:
        return text + (
            '<p class="note">The circuits were <strong>not simulated</strong> for this package: '
            "ngspice was not installed.</p>"
        )
    for board in plan.boards:
        figures = [
            (
                m.what,
                escape(show(m)) if m.holds else f'<span class="bad">{escape(show(m))}</span>',
                show(m, m.limit) or "–",
            )
            for m in plan.measurements[board.name]
        ]
        caption = f"{board.title}: simulated with ngspice"
        text += _table(("Figure", "Value", "At most"), figures, "lnn", caption=caption, raw=(1,))
    lines = [line.removeprefix("- ") for line in assumptions().splitlines() if line[:2] == "- "]
    items = "".join(f"<li>{escape(line)}</li>" for line in lines)
    return text + f"<h3>What the simulation takes for granted</h3><ul>{items}</ul>"


def _checked(plan: Plan) -> str:
    done = [
        (
            "Lens mount: closed surfaces, outer size, no lens collides, every lens is held in six "
            "directions and can be put in, light of the whole field reaches the sensor (exact rays "
            "against the printed triangles), slits stop what they should, screw holes, room for the "
            "sensor's board, wall thickness."
        ),
        (
            "Stand and LED mount: closed surfaces, collisions, holes, wall thickness. No part is larger "
            "than the printer."
        ),
        (
            "Boards: open nets, shorts, unconnected pins, supplies, every pin's role, agreement with "
            "the wiring tables and the sensor's pins, six LEDs' switches alike."
        ),
        (
            "Board files: schematic and layout are those of the boards' data, pads and holes those of the "
            "layout, and every file is as KiCad wrote it, whose own checks had passed."
        ),
    ]
    if plan.measurements is not None:
        done.append("Circuits: simulated with ngspice, in every way to fit the parts.")
    left = [
        "Nothing has been fabricated: no print, no board, no measurement.",
        "Whether light gets in through walls, screw holes or the seam was not followed.",
        *(f"Left out here: {what}." for what in plan.left_out()),
    ]
    lists = ("".join(f"<li>{escape(item)}</li>" for item in items) for items in (done, left))
    return """
<p>All of this passed before anything was written:</p>
<ul>{}</ul>
<p>What is not known:</p>
<ul>{}</ul>""".format(*lists)


def _file_list(files: Sequence[str]) -> str:
    about = {
        "print/": "for the printer, STL in mm, already lying as printed",
        "cad/": "exact bodies (STEP) and drawings true to scale (SVG)",
        "boards/": "Gerber and drill files for the board maker, schematics",
        "bill/": "what to buy",
        "wiring/": "wires, firmware",
        "design.toml": "the lens design that everything follows from",
    }
    rows = []
    for start, what in about.items():
        names = [name for name in files if name.startswith(start)]
        if names:
            listed = "<br>".join(f"<code>{escape(name)}</code>" for name in names)
            rows.append((listed, what))
    rows.append(("<code>manifest.json</code>", "size and SHA-256 of every file, versions, figures"))
    return _table(("File", "What it is"), rows, "ll", raw=(0,))


# --- pictures -------------------------------------------------------------------------------------


def section(mount: LensMount) -> str:
    """Draw the cut between the halves, with the lenses' heights above the sensor's cover, as SVG.

    Parameters
    ----------
    mount : LensMount
    """
    half, front, window = mount.half_size[0], mount.front, mount.window
    depth = mount.face + mount.board.thickness
    heights = mount.heights()
    step = 6.0
    low, high = -half - 9.0, half + 6.0 + step * (len(heights) + 1)
    left, right = front - 14.0, depth + 8.0
    shapes = [_cut(mount.lower, "#d9d3c5", "#6b665c")]
    shapes += [_cut(lens.glass, "#a9cbe6", "#2d5f8b") for lens in mount.lenses]
    board = mount.board.parts(mount.face)
    shapes += [_cut(board["board"], "#3c7a52", "#1f4a30")]
    # the package lies between the strips of its pins, which are not cut
    shapes += [_cut(board["package"], "#4b4b52", "#222")]
    marks = [
        (
            f'<line class="d" x1="{window:.2f}" y1="{-half:.2f}" x2="{window:.2f}" y2="{high:.2f}" '
            'stroke-dasharray="1.2 .8"/>'
        )
    ]
    for number, (lens, height) in enumerate(
        zip(mount.lenses, heights.values(), strict=True), start=1
    ):
        middle, y = sum(lens.box) / 2, half + step * number
        crowd = -half - 3.2 if number % 2 else -half - 6.6  # two lenses may lie close together
        marks.append(
            f'<line class="d" x1="{middle:.2f}" y1="{crowd:.2f}" x2="{middle:.2f}" y2="{-lens.half[0]:.2f}"/>'
        )
        marks.append(f'<circle cx="{middle:.2f}" cy="{crowd:.2f}" r="2" fill="#0b5cad"/>')
        marks.append(_label(middle, crowd + 0.95, str(number), "w"))
        marks += _dimension(window - height, window, y, lens.half[0], f"{height:.2f}")
    marks += _dimension(
        front, mount.face, half + step * (len(heights) + 1), half, f"{mount.face - front:.2f}"
    )
    marks.append(f'<path class="a" d="M{front - 11:.2f} 0h8m-2 -1.4l2 1.4l-2 1.4"/>')
    marks.append(_label(front - 7.5, -2.2, "light", "t"))
    scale = 9
    return (
        f'<svg viewBox="{left:.2f} {low:.2f} {right - left:.2f} {high + 2 - low:.2f}" '
        f'width="{scale * (right - left):.0f}" height="{scale * (high + 2 - low):.0f}" role="img" '
        'aria-label="Section of the lens mount">'
        "<style>.d{stroke:#333;stroke-width:.18;fill:none}.a{stroke:#c77700;stroke-width:.5;"
        "fill:none}.t,.w{font:2.6px sans-serif;text-anchor:middle;fill:#1b1f24}.w{fill:#fff;"
        f"font-weight:700}}</style>{''.join(shapes + marks)}</svg>"
    )


def _cut(solid: Solid, fill: str, edge: str) -> str:
    """Return a cut just below y = 0, seen from above: light to the right, +X up."""
    path = "".join(
        "M" + "L".join(f"{z:.2f} {-x:.2f}" for z, x in ring) + "Z"
        for ring in cross_section(solid, "y", -0.02)
    )
    return f'<path d="{path}" fill="{fill}" stroke="{edge}" stroke-width=".2" fill-rule="evenodd"/>'


def _dimension(low: float, high: float, y: float, start: float, text: str) -> Iterator[str]:
    yield f'<path class="d" d="M{low:.2f} {start:.2f}V{y + 1:.2f}M{high:.2f} {start:.2f}V{y + 1:.2f}"/>'
    yield f'<path class="d" d="M{low:.2f} {y:.2f}H{high:.2f}"/>'
    for end, way in ((low, 1), (high, -1)):
        yield f'<path d="M{end:.2f} {y:.2f}l{1.5 * way} -.5v1z" fill="#333"/>'
    if high - low > 9:
        yield _label((low + high) / 2, y - 0.7, text, "t")
    else:
        yield _label(low - 4.5, y + 0.9, text, "t")


def _label(x: float, y: float, text: str, style: str) -> str:
    return f'<text class="{style}" x="{x:.2f}" y="{y:.2f}">{escape(text)}</text>'


def png(image: NDArray[np.uint8]) -> bytes:
    """Return a picture (H, W, 3) as a PNG file, without any library for it."""
    height, width, _ = image.shape
    rows = np.zeros((height, 1 + 3 * width), dtype=np.uint8)  # each begins with its filter
    rows[0, 1:] = image[0].reshape(-1)
    rows[1:, 0] = 2  # what differs from the row above
    rows[1:, 1:] = (image[1:] - image[:-1]).reshape(height - 1, -1)
    chunks = {
        b"IHDR": struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0),
        b"IDAT": zlib.compress(rows.tobytes(), 9),
        b"IEND": b"",
    }
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))
        for name, data in chunks.items()
    )


# --- HTML -----------------------------------------------------------------------------------------


def _figure(image: NDArray[np.uint8], caption: str) -> str:
    return _image("png", png(image), caption)


def _image(kind: str, content: bytes, caption: str) -> str:
    data = base64.b64encode(content).decode()
    text = escape(caption)
    return (
        f'<figure><img alt="{text}" src="data:image/{kind};base64,{data}">'
        f"<figcaption>{text}</figcaption></figure>"
    )


def _table(
    header: Sequence[str],
    rows: Sequence[Sequence[str]],
    align: str = "ll",
    *,
    caption: str = "",
    foot: Sequence[str] = (),
    raw: Sequence[int] = (),
) -> str:
    """Write a table; `align` has l or n (a number) for each column, `raw` the columns of HTML."""

    def row(cells: Sequence[str], tag: str = "td", raw: Sequence[int] = ()) -> str:
        return "<tr>{}</tr>".format(
            "".join(
                f"<{tag}{' class=n' if kind == 'n' else ''}>"
                f"{cell if number in raw else escape(cell)}</{tag}>"
                for number, (cell, kind) in enumerate(zip(cells, align, strict=True))
            )
        )

    parts: list[Any] = [
        f"<caption>{escape(caption)}</caption>" if caption else "",
        f"<thead>{row(header, 'th')}</thead>" if header else "",
        f"<tbody>{''.join(row(cells, raw=raw) for cells in rows)}</tbody>",
        f"<tfoot>{row(foot)}</tfoot>" if foot else "",
    ]
    keep = " class=keep" if len(rows) <= _TOGETHER else ""
    return f"<table{keep}>{''.join(parts)}</table>\n"
