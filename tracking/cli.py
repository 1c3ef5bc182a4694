"""The command ``linetrack track``: frames in, poses out, one line each.

Nothing slow is imported before it runs, so that ``linetrack track --help`` answers at once.
"""

from __future__ import annotations

import sys
from pathlib import Path  # noqa: TC003  # typer reads annotations
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from acquisition.cli import DOUBTFUL, INTERRUPTED, UsageError

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from rich.console import Console

    from acquisition.links import Link
    from raytransfer.designs import Design
    from tracking.calibration import Calibration, FourCorners
    from tracking.leds import LedMap
    from tracking.output import LineWriter, UdpWriter
    from tracking.tracker import Step

METHODS: Final = ("filter", "thesis")
STREAM_ICG: Final = 16_000
"""Master clocks: a frame takes 3.8 ms on the link, and some more until the host asks for it."""
PATIENCE: Final = 1.0
"""Device seconds without a pose until a word is said about it …"""
AGAIN: Final = 10.0
"""… and from then on until it is said again."""

_EPILOG: Final = """\
[bold]Examples[/]
  linetrack track
      [dim]two LEDs as in the thesis; one line per frame, until Ctrl-C[/]
  linetrack track --link twin --count 100 --json
      [dim]the same without hardware: t_ns, x, y, heading, cov, flags in ns, mm and rad[/]
  linetrack track --link twin walk --csv > walk.csv
      [dim]a room of the twin in which the tracker moves[/]
  linetrack track --link replay run.h5 --calibration room.json
  linetrack track --udp 192.168.0.7:5005
      [dim]one JSON object per datagram[/]
  linetrack track --method thesis --corners . --area=-400,400,1300,4150
      [dim]the thesis's own way: two frames, two lowest pixels, one position, again and again[/]

Exit codes: linetrack --help"""

app = typer.Typer(add_completion=False, rich_markup_mode="rich")


@app.command(epilog=_EPILOG)
def track(
    argument: Annotated[
        str | None,
        typer.Argument(
            metavar="FILE",
            show_default=False,
            help="For --link replay: the recording. For spi: the device, such as 0.0. For twin: "
            "the room or the lens head.",
        ),
    ] = None,
    link: Annotated[
        str, typer.Option("--link", "-l", metavar="NAME", help="spi, twin (no hardware) or replay.")
    ] = "spi",
    count: Annotated[
        int, typer.Option("--count", "-n", metavar="N", min=0, help="Poses; 0 is without end.")
    ] = 0,
    json: Annotated[
        bool,
        typer.Option(
            "--json",
            help="Per pose a JSON object: t_ns (device time), x and y (mm), heading (rad), cov "
            "(their covariance, 3 × 3) and flags (names).",
        ),
    ] = False,
    csv: Annotated[bool, typer.Option("--csv", help="The same as CSV, with a header.")] = False,
    udp: Annotated[
        str | None,
        typer.Option(
            "--udp",
            metavar="HOST:PORT",
            help="The JSON object as a UDP datagram. If the network refuses some, the exit code is "
            f"{DOUBTFUL}; whether anybody listens is not known.",
        ),
    ] = None,
    calibration: Annotated[
        Path | None,
        typer.Option(
            "--calibration",
            "-c",
            metavar="FILE",
            help="Camera and LEDs, measured. Left out: what the design of the lens head says.",
        ),
    ] = None,
    leds: Annotated[
        Path | None,
        typer.Option(
            "--leds",
            metavar="FILE",
            help="Where the LEDs are: lines of channel, x, y and z in mm, z may be left out. "
            "\\[default: the calibration's; or what the twin has; or two, 500 mm apart]",
        ),
    ] = None,
    head: Annotated[
        str | None,
        typer.Option(
            "--head",
            metavar="NAME",
            help="Lens head if there is no calibration: a design, or its file.  \\[default: the "
            "recording's or the twin's; or thesis]",
        ),
    ] = None,
    heading: Annotated[
        float | None,
        typer.Option(
            "--heading",
            metavar="DEGREES",
            help="It is known. Two LEDs cannot measure it.  \\[default: 0 with two LEDs; "
            "measured with three or more]",
        ),
    ] = None,
    height: Annotated[
        float,
        typer.Option("--height", metavar="MM", help="Of the tracker, as the LEDs' z counts."),
    ] = 0.0,
    height_error: Annotated[
        float, typer.Option("--height-error", metavar="MM", help="How well it is known, 1 σ.")
    ] = 0.0,
    spikes: Annotated[
        bool,
        typer.Option("--spikes", help="The microcontroller finds the spikes and sends only them."),
    ] = False,
    icg: Annotated[
        int | None,
        typer.Option(
            "--icg",
            "-i",
            metavar="CLOCKS",
            help="ICG period: from read-out to read-out, in master clocks (4 MHz); a multiple of "
            "-s.  \\[default: 16000, at which no frame waits for the link; with --spikes the "
            "shortest, 14776 or more]",
        ),
    ] = None,
    sh: Annotated[
        int,
        typer.Option(
            "--sh",
            "-s",
            metavar="CLOCKS",
            help="SH period: the longest that light is gathered, in master clocks; 40 or more.",
        ),
    ] = 100,
    method: Annotated[
        str, typer.Option("--method", metavar="NAME", help="filter, or thesis: as it was.")
    ] = "filter",
    corners: Annotated[
        Path | None,
        typer.Option(
            "--corners",
            metavar="FOLDER",
            help="--method thesis: where the folders lf, lb, rf and rb of the four corners are, "
            "for mm instead of pixels; needs --area.",
        ),
    ] = None,
    area: Annotated[
        str | None,
        typer.Option(
            "--area",
            metavar="X1,X2,Y1,Y2",
            help="Where these corners are, mm: left, right, front (next to the LEDs), back.",
        ),
    ] = None,
    quiet: Annotated[
        bool, typer.Option("--quiet", "-q", help="Only poses and errors, no summary.")
    ] = False,
) -> None:
    """Follow the tracker: one line per pose."""
    raise typer.Exit(_run(**locals()))


def _run(*, json: bool, csv: bool, udp: str | None, method: str, **given: Any) -> int:
    formats = [name for name, on in (("--json", json), ("--csv", csv), ("--udp", udp)) if on]
    if len(formats) > 1:
        raise UsageError(f"{' and '.join(formats)}: one form of output at a time")
    if method not in METHODS:
        raise UsageError(f"--method {method}: allowed are {' and '.join(METHODS)}")
    if udp is None and sys.stdout is None:
        raise UsageError("standard output is closed, and poses are written there; or use --udp")
    if method == "thesis":
        if formats:
            raise UsageError(
                f"--method thesis has neither errors nor times: leave out {formats[0]}"
            )
        return _silent_end(_thesis, **given)
    for name in ("corners", "area"):
        if given.pop(name) is not None:
            raise UsageError(f"--{name} needs --method thesis; else there is --calibration")
    return _silent_end(_follow, writer=_writer(json=json, csv=csv, udp=udp), **given)


def _silent_end(action: Callable[..., int], **given: Any) -> int:
    """Run; where nobody reads any more, leave nothing that would complain at the very end."""
    try:
        return action(**given)
    except BrokenPipeError:
        import os

        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise


def _writer(*, json: bool, csv: bool, udp: str | None) -> LineWriter | UdpWriter:
    from tracking import output

    if udp is not None:
        try:
            host, port = output.host_and_port(udp)
        except ValueError as error:
            raise UsageError(f"--udp {error}") from error
        try:
            return output.UdpWriter(host, port)
        except OSError as error:
            raise UsageError(f"--udp {udp}: {error.strerror or error}") from error
        except UnicodeError as error:  # of a name that the domain name system cannot hold
            raise UsageError(f"--udp {udp}: {host!r} is no name of a host") from error
    if json:
        return output.LineWriter(sys.stdout, output.as_json)
    if csv:
        return output.LineWriter(sys.stdout, output.as_csv, output.CSV_HEADER)
    return output.LineWriter(sys.stdout)


def _follow(
    *,
    writer: LineWriter | UdpWriter,
    argument: str | None,
    link: str,
    count: int,
    calibration: Path | None,
    leds: Path | None,
    head: str | None,
    heading: float | None,
    height: float,
    height_error: float,
    spikes: bool,
    icg: int | None,
    sh: int,
    quiet: bool,
) -> int:
    import math
    from contextlib import ExitStack, closing

    from rich.console import Console

    from acquisition.capture import Capture
    from acquisition.commands import Tally, open_device, until_ctrl_c
    from acquisition.links import LinkError
    from tracking.poses import Prior
    from tracking.tracker import Tracker, default_schedule, first_command, follow

    if heading is not None and not math.isfinite(heading):
        raise UsageError(f"--heading {heading}: a number of degrees is needed")
    console = Console(stderr=True, quiet=quiet, highlight=False, soft_wrap=True)
    led_map = None if leds is None else read_leds(leds)
    if icg is None and not spikes and sh > 0:
        icg = -(-STREAM_ICG // sh) * sh
    with ExitStack() as stack:
        stack.callback(writer.close)
        device = stack.enter_context(open_device(link, argument))
        known = _calibration(device, calibration, led_map, head)
        try:
            tracker = Tracker(
                known,
                heading=None if heading is None else Prior(math.radians(heading), 0.0),
                height=Prior(height, height_error),
                schedule=default_schedule(known.leds, sh, icg),
            )
            command = first_command(tracker, spikes=spikes)
        except ValueError as error:
            raise UsageError(str(error)) from error
        source = Capture(device, command)
        pressed = stack.enter_context(until_ctrl_c(source))
        tally = Tally(source)
        watch = _Watch(console, known.leds)
        poses = 0
        with closing(follow(source, tracker, steer=not hasattr(device, "recorded"))) as steps:
            for step in steps:
                tally.take(step.frame)  # type: ignore[arg-type]  # of spikes it counts the same
                watch.take(step)
                if step.estimate is not None:
                    writer(step.estimate)
                    poses += 1
                    if poses == count:
                        break
    if not poses and not pressed.is_set():
        raise LinkError(watch.why())
    console.print(f"{poses} pose{'' if poses == 1 else 's'} of {tally.line()}")
    if complaint := writer.complaint():
        console.quiet = False  # no summary: an error
        console.print(complaint, style="yellow", markup=False)
    if pressed.is_set() and (poses < count or not poses):
        return INTERRUPTED
    if poses < count:
        console.print(f"[yellow]{count} poses were asked for[/]; the link had no more frames")
        return DOUBTFUL
    return DOUBTFUL if tally.doubtful or complaint else 0


def _thesis(
    *,
    argument: str | None,
    link: str,
    count: int,
    corners: Path | None,
    area: str | None,
    icg: int | None,
    sh: int,
    quiet: bool,
    **others: Any,
) -> int:
    from contextlib import suppress

    from acquisition.commands import ORIGINAL_ICG, open_device
    from acquisition.links import LinkError
    from acquisition.protocol import Command, CommandError
    from tracking.baseline import positions

    for name, value in others.items():
        if value not in (None, 0, False):
            raise UsageError(f"--{name.replace('_', '-')}: --method thesis does not use it")
    try:
        command = Command(sh, ORIGINAL_ICG if icg is None else icg, 2)
    except CommandError as error:
        raise UsageError(str(error)) from error
    mapping = _four_corners(corners, area)
    number = invalid = 0
    with open_device(link, argument) as device, suppress(KeyboardInterrupt):
        for reading in positions(device, mapping, count=count or None, command=command):
            sys.stdout.write(f"{reading}\n")
            sys.stdout.flush()
            number += 1
            invalid += bool(reading.invalid)
    if not number and count:
        raise LinkError("the link had no two frames to send: is the recording empty?")
    if not quiet:
        unit = "x and y, mm" if mapping else "middle of the two spikes and their distance, pixels"
        typer.echo(f"{number} positions ({unit}), {invalid} invalid", err=True)
    return DOUBTFUL if invalid or number < count else 0


def _four_corners(folder: Path | None, area: str | None) -> FourCorners | None:
    """The mapping to mm that corners measured at known places give."""
    from contextlib import redirect_stdout

    from tracking.baseline import CORNERS, print_tracking_area
    from tracking.calibration import Corner, FourCorners

    if folder is None and area is None:
        return None
    if folder is None or area is None:
        raise UsageError("--corners and --area belong together: what was measured, and where")
    try:
        left, right, front, back = (float(number) for number in area.split(","))
    except ValueError as error:
        raise UsageError(f"--area {area}: four numbers are needed, X1,X2,Y1,Y2 in mm") from error
    places = dict(
        zip(CORNERS, [(left, front), (left, back), (right, front), (right, back)], strict=True)
    )
    with redirect_stdout(sys.stderr):
        measured = print_tracking_area(folder, places)
    if missing := [corner for corner in CORNERS if corner not in measured]:
        raise UsageError(f"--corners {folder}: no valid measurement of {', '.join(missing)}")
    return FourCorners(*(Corner(*places[name], *measured[name]) for name in CORNERS))


class _Watch:
    """Says what is wrong while no pose comes."""

    def __init__(self, console: Console, leds: LedMap) -> None:
        self._console, self._leds = console, leds
        self._frames = self._lit = 0
        from tracking.motion import Outcome

        self._missing = Outcome.MISSING
        self._seen: set[int] = set()
        self._due: int | None = None  # when to say it, device time in ns
        self._known = False

    def take(self, step: Step) -> None:
        """Look at what a frame led to."""
        self._frames += 1
        self._lit |= step.frame.leds
        self._seen |= {i.channel for i in step.innovations if i.outcome is not self._missing}
        if self._due is None:
            self._due = step.t_ns + round(PATIENCE * 1e9)
        if self._known or step.estimate is not None:
            self._known = True  # from now on, flags tell
        elif step.t_ns >= self._due:
            self._due = step.t_ns + round(AGAIN * 1e9)
            self._console.print(f"[yellow]no pose yet:[/] {self.why()}; going on, Ctrl+C ends")

    def why(self) -> str:
        """Why there is no pose."""
        if not self._frames:
            return "the link has nothing to send: is the recording empty?"
        frames = f"{self._frames} frame{'' if self._frames == 1 else 's'}"
        if not self._lit:
            return (
                f"no LED is lit in {frames}, or nothing says which: .dat files do not, record "
                "with --stream into a session; for pairs of .dat files there is --method thesis"
            )
        channels = ", ".join(str(n) for n in self._leds.channels)
        never = ", ".join(str(n) for n in self._leds.channels if n not in self._seen)
        unseen = f" ({never} never)" if never else ""
        return (
            f"{frames} in which LEDs {channels} were not seen well enough at once{unseen}: are they "
            "on and in sight, and is the LED map (--calibration, --leds) that of this room?"
        )


def read_leds(path: Path) -> LedMap:
    """Read an LED map: lines of channel, x, y and z (mm), z may be left out; # begins a comment.

    Raises
    ------
    UsageError
        It holds something else; the message names the line.
    OSError
        It cannot be read.
    """
    from tracking.leds import LedMap

    channels: list[int] = []
    positions: list[list[float]] = []
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except UnicodeDecodeError as error:
        raise UsageError(f"--leds {path}: it is no text") from error
    for number, line in enumerate(lines, start=1):
        text = line.partition("#")[0].replace(",", " ").split()
        if not text:
            continue
        try:
            channel, x, y, *rest = int(text[0]), *(float(word) for word in text[1:])
            if len(rest) > 1:
                raise ValueError
        except ValueError as error:
            raise UsageError(
                f"--leds {path}, line {number}: {line.strip()!r} is not channel, x, y and z in mm, "
                "such as 0, -250, 0"
            ) from error
        channels.append(channel)
        positions.append([x, y, *(rest or [0.0])])
    if not channels:
        raise UsageError(f"--leds {path}: there is no LED in it")
    try:
        return LedMap(channels, positions)
    except ValueError as error:
        raise UsageError(f"--leds {path}: {error}") from error


def _calibration(
    device: Link, path: Path | None, leds: LedMap | None, head: str | None
) -> Calibration:
    """What is known of camera and LEDs: measured, or nominal."""
    from dataclasses import replace

    from tracking.calibration import Calibration, load_calibration
    from tracking.nominal import nominal_camera

    if path is not None:
        if head is not None:
            raise UsageError(f"--head {head}: the calibration has a camera already; one of the two")
        measured = load_calibration(path)
        return measured if leds is None else replace(measured, leds=leds)
    camera = nominal_camera(design(getattr(device, "lens_system", {}), head))
    return Calibration(camera, _leds(device) if leds is None else leds)


def design(about: Mapping[str, Any], head: str | None) -> Design:
    """Return the lens head: the one named, or the one described, or the thesis's.

    Where both are there and differ, that is said: poses would come out wrong, and look right.

    Parameters
    ----------
    about : mapping
        ``lens_system`` of a link or of a session; may be empty.
    head : str, optional
        A design, or its file.

    Raises
    ------
    UsageError
        There is none of that name, or what is described is no design.
    """
    from raytransfer.designs import DESIGNS, Design, find_design

    known: Design | None = None
    why = ""
    if about:
        try:
            known = Design.from_dict(about["description"])
        except (ValueError, TypeError, KeyError) as error:
            why = str(error)
    if head is not None:
        try:
            named = find_design(head)
        except LookupError as error:
            raise UsageError(f"--head {error}") from error
        if known is not None and (named.system, named.sensor) != (known.system, known.sensor):
            typer.secho(
                f"--head {head} is not the head that the frames come from: that is "
                f"{known.system.name}, which is taken without --head",
                fg="yellow",
                err=True,
            )
        return named
    if why:
        raise UsageError(
            f"the head described in the recording, {about.get('name', '')!r}, is no design "
            f"({why}): give --head or --calibration"
        )
    return known or DESIGNS["thesis"]


def _leds(device: Link) -> LedMap:
    """The LEDs that the link knows of, or the thesis's two."""
    from tracking.leds import LedMap

    known = getattr(device, "known_leds", None)
    return LedMap.line(2, 500.0) if known is None else LedMap(*known)
