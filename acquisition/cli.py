"""The command line, ``linetrack``: what it takes. What it does is in `acquisition.commands`.

Nothing slow is imported before a command runs, so that ``--help`` answers at once. Further commands
come from entry points of the group ``linetrack.commands``, each naming a function or a
`typer.Typer`; they are listed by name, and loaded when they are called.
"""

from __future__ import annotations

import errno
import re
import sys
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

try:
    import typer
    from typer.core import TyperCommand, TyperGroup
except ModuleNotFoundError as missing:  # seen by who types `linetrack`, not a traceback
    raise SystemExit(
        f"linetrack: the command line needs {missing.name}: pip install 'linetrack[capture]'"
    ) from missing
except KeyboardInterrupt:  # importing takes a while
    raise SystemExit(130) from None

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

GROUP: Final = "linetrack.commands"
"""The group of entry points that further commands are found by."""

FAILED: Final = 1
"""Exit code: the link, the device or a file failed."""
USAGE: Final = 2
"""Exit code: the command line was wrong; nothing was done."""
DOUBTFUL: Final = 3
"""Exit code: finished, but some frames are invalid, damaged or lost on the way."""
INTERRUPTED: Final = 130
"""Exit code: ended with Ctrl-C before everything asked for, or anything, was there."""

_EPILOG: Final = """\
[bold]Examples[/]
  linetrack capture -i 30000 -s 100 -n 2 -o output
      [dim]two frames, as .dat files[/]
  linetrack capture --link twin --stream --seconds 10 -o run.h5
  linetrack plot output00001.dat output00002.dat
  linetrack live --link replay run.h5

[bold]Exit codes[/]
  0 done; an endless capture ends so with Ctrl-C, too
  1 link, device or file failed
  2 wrong usage; nothing was done
  3 done, but some frames are invalid, damaged or lost
  130 Ctrl-C before everything asked for was there"""

_CAPTURE: Final = """\
[bold]Examples[/]
  linetrack capture -i 30000 -s 100 -n 2 -o output
      [dim]original mode: output00001.dat (first LED), output00002.dat (second LED)[/]
  linetrack capture --link twin -n 2
      [dim]the same without hardware[/]
  linetrack capture --link replay run.h5 --stream -n 10 -o again
      [dim]from a recording: a session, a .dat file or the prefix of several[/]
  linetrack capture --stream --seconds 10 -o run.h5
      [dim]streaming at full rate into an HDF5 session[/]
  linetrack capture --firmware original -n 2
      [dim]from a board with the published firmware[/]
  linetrack capture --stream -n 300 --leds 0:80,1:80,- -o run.h5
      [dim]LED 0, LED 1, none, and so on, each lit for 80 clocks (20 us)[/]

Exit codes: linetrack --help"""

_PLOT: Final = """\
[bold]Examples[/]
  linetrack plot output00001.dat output00002.dat
  linetrack plot run.h5 --frames 1,2,10:12 --save chart.png

Exit codes: linetrack --help"""

_LIVE: Final = """\
[bold]Examples[/]
  linetrack live
  linetrack live --link twin --frames 100
  linetrack live --link replay run.h5

End with q or Ctrl-C. Exit codes: linetrack --help"""

_INFO: Final = """\
[bold]Example[/]
  linetrack info output00001.dat run.h5

Exit codes: linetrack --help"""

_CONVERT: Final = """\
[bold]Examples[/]
  linetrack convert output*.dat run.h5    [dim]many files into one session[/]
  linetrack convert run.h5 run.csv        [dim]one line per frame[/]
  linetrack convert run.h5 frame          [dim]frame00001.dat and so on[/]

Exit codes: linetrack --help"""


class UsageError(ValueError):
    """The command line asks for what cannot be; ends with the exit code `USAGE`."""


class _Group(TyperGroup):
    """The commands here, and by name those of other packages."""

    def list_commands(self, ctx: Any) -> list[str]:
        return [*super().list_commands(ctx), *sorted(_plugins())]

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        command = super().get_command(ctx, cmd_name)
        if command is None and (point := _plugins().get(cmd_name)) is not None:
            command = TyperCommand(cmd_name, help=_about(point))
            command.rich_help_panel = "From other packages"
        return command

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        if args[0] not in self.commands and (point := _plugins().get(args[0])) is not None:
            return args[0], _loaded(point), args[1:]
        return super().resolve_command(ctx, args)


def _plugins() -> dict[str, EntryPoint]:
    from importlib.metadata import entry_points

    return {point.name: point for point in entry_points(group=GROUP)}


def _about(point: EntryPoint) -> str:
    """What a command of another package says of itself, read from its source: nothing is imported.

    That is the docstring of its function; of a `typer.Typer`, that of the one command it has.
    """
    import ast

    inner = r"(?:[ \t)].*\n|\n)*"  # lines of a definition after its first
    decorated = rf"@{point.attr}\.command\b.*\n{inner}(?:@.*\n{inner})*def "
    with suppress(ImportError, OSError, SyntaxError, ValueError):
        # to parse all of a file takes longer than all the rest of the help
        found = re.findall(
            rf"^(?:{decorated}|def {point.attr}\b).*\n{inner}", _source(point.module), re.MULTILINE
        )
        if len(found) == 1:
            (function,) = ast.parse(found[0]).body
            if isinstance(function, ast.FunctionDef) and (text := ast.get_docstring(function)):
                return text
    return f"From {point.module.partition('.')[0]}."


def _source(module: str) -> str:
    """Source of a module, found without importing the packages that it is in."""
    from importlib.machinery import PathFinder

    path, name = None, ""
    for part in module.split("."):
        name = f"{name}.{part}" if name else part
        spec = PathFinder.find_spec(name, path)
        if spec is None:
            raise ImportError(f"no module {name}")
        path = spec.submodule_search_locations
    assert spec is not None  # noqa: S101  # a name has a part
    return Path(spec.origin or "").read_text(encoding="utf-8")


def _loaded(point: EntryPoint) -> Any:
    try:
        target = point.load()
    except ImportError as error:
        raise UsageError(
            f"the command {point.name} cannot be loaded ({error}): is its package complete? Try "
            f"pip install 'linetrack[{point.name}]'"
        ) from error
    if not isinstance(target, typer.Typer):
        function, target = target, typer.Typer(add_completion=False)
        target.command(point.name)(function)
    command = typer.main.get_command(target)
    command.name = point.name
    return command


app = typer.Typer(
    cls=_Group,
    name="linetrack",
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
    epilog=_EPILOG,
    context_settings={"help_option_names": ["-h", "--help"]},
)
_debug = False


def _show_version(value: bool) -> None:
    if value:
        from acquisition.session import Metadata

        typer.echo(f"linetrack {Metadata().linetrack_version}")
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[  # noqa: ARG001
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Show it.")
    ] = False,
    debug: Annotated[
        bool, typer.Option("--debug", hidden=True, help="Show where an error came from.")
    ] = False,
) -> None:
    """Frames from a line sensor: capture, look, convert."""
    global _debug
    _debug = debug


Icg = Annotated[
    int | None,
    typer.Option(
        "--icg",
        "-i",
        metavar="CLOCKS",
        help="ICG period: from read-out to read-out, in master clocks (4 MHz); a multiple of -s, "
        "14776 or more.  \\[default: 30000; with --stream the shortest that -s allows]",
    ),
]
Sh = Annotated[
    int,
    typer.Option(
        "--sh",
        "-s",
        metavar="CLOCKS",
        help="SH period: how long light is gathered, in master clocks; 40 or more.",
    ),
]
Link = Annotated[
    str, typer.Option("--link", "-l", metavar="NAME", help="spi, twin (no hardware) or replay.")
]
Argument = Annotated[
    str | None,
    typer.Argument(
        metavar="FILE",
        show_default=False,
        help="For --link replay: the recording. For spi: the device, such as 0.0. For twin: the lens "
        "head, a design file or the name of one that comes along.",
    ),
]
Leds = Annotated[
    str | None,
    typer.Option(
        "--leds",
        metavar="LIST",
        help="Streaming mode: what is lit, frame by frame, over and over. CHANNEL:CLOCKS, joined by "
        "+ within a frame and by , between frames; - is an unlit frame. Without :CLOCKS for the "
        "whole SH period.  \\[default: 0,1]",
    ),
]
Firmware = Annotated[
    str,
    typer.Option(
        "--firmware",
        metavar="NAME",
        help="Which one is on the board: linetrack, or original, the published one, which sends "
        "one frame more than its command says and has no --stream.",
    ),
]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="No progress, only errors.")]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace files that are there.")]


@app.command(epilog=_CAPTURE)
def capture(
    argument: Argument = None,
    icg: Icg = None,
    sh: Sh = 100,
    count: Annotated[
        int | None,
        typer.Option(
            "--count",
            "-n",
            metavar="N",
            help="Read-outs, 1 to 65535; with --stream those that the link was too slow for count "
            "too, and 0 is without end. Original mode lights the last but one by the first LED and "
            "the last by the second.  \\[default: 2; with --stream 0, until --seconds or Ctrl-C]",
        ),
    ] = None,
    output: Annotated[
        str,
        typer.Option(
            "--output",
            "-o",
            metavar="NAME",
            help="NAME.h5: one HDF5 session. Anything else: prefix of .dat files, NAME00001.dat "
            "and so on; as with the original program, they replace older ones. Its folder must "
            "exist.",
        ),
    ] = "output",
    link: Link = "spi",
    stream: Annotated[
        bool, typer.Option("--stream", help="Streaming mode: full rate, checksums, any LEDs.")
    ] = False,
    seconds: Annotated[
        float | None,
        typer.Option("--seconds", metavar="T", help="How long, in the device's time."),
    ] = None,
    leds: Leds = None,
    head: Annotated[
        Path | None,
        typer.Option(
            "--head",
            metavar="FILE",
            help="Description of the lens head (TOML or JSON), to be kept in the session.",
        ),
    ] = None,
    firmware: Firmware = "linetrack",
    overwrite: Overwrite = False,
    quiet: Quiet = False,
) -> None:
    """Capture frames into files.

    What was captured before Ctrl-C or an error is kept. A capture without end (--stream without -n
    and --seconds) is meant to end with Ctrl-C: its exit code is then 0.
    """
    _run("capture", **locals())


@app.command(epilog=_PLOT)
def plot(
    files: Annotated[
        list[Path], typer.Argument(metavar="FILES...", help=".dat files and sessions.")
    ],
    save: Annotated[
        Path | None,
        typer.Option("--save", metavar="PNG", help="Write a picture instead of opening a window."),
    ] = None,
    frames: Annotated[
        str | None,
        typer.Option(
            "--frames",
            metavar="LIST",
            help="Which frames of a session, from 1: 1,2,10:12; -1 is the last.  \\[default: the "
            "first with each LED]",
        ),
    ] = None,
    elements: Annotated[
        bool,
        typer.Option("--elements", help="All 3694 elements instead of the 3648 pixels."),
    ] = False,
) -> None:
    """Draw intensity charts: all files in one picture."""
    _run("plot", **locals())


@app.command(epilog=_LIVE)
def live(
    argument: Argument = None,
    icg: Icg = None,
    sh: Sh = 100,
    link: Link = "spi",
    stream: Annotated[
        bool | None,
        typer.Option(
            "--stream/--original",
            help="Streaming mode, or original: two frames a command. "
            "\\[default: --stream; --original for .dat files and --firmware original]",
            show_default=False,
        ),
    ] = None,
    leds: Leds = None,
    firmware: Firmware = "linetrack",
    frames: Annotated[
        int | None, typer.Option("--frames", metavar="N", min=1, help="End after so many.")
    ] = None,
) -> None:
    """Watch what the sensor sees, in the terminal."""
    _run("live", **locals())


@app.command(epilog=_INFO)
def info(
    files: Annotated[
        list[Path], typer.Argument(metavar="FILES...", help=".dat files and sessions.")
    ],
) -> None:
    """Tell what is in files: periods, clock, rate, losses, range of values."""
    _run("info", **locals())


@app.command(epilog=_CONVERT)
def convert(
    files: Annotated[
        list[str],
        typer.Argument(
            metavar="IN... OUT",
            help="Last the target: NAME.h5, NAME.csv, NAME.dat (one frame) or a prefix for "
            "numbered .dat files. Before it .dat, .h5 and .csv files.",
        ),
    ],
    overwrite: Overwrite = False,
    quiet: Quiet = False,
) -> None:
    """Convert between .dat, HDF5 sessions and CSV; says what the target cannot hold."""
    _run("convert", **locals())


def _run(name: str, **arguments: Any) -> None:
    from acquisition import commands

    raise typer.Exit(getattr(commands, name)(**arguments))


def main(arguments: list[str] | None = None) -> None:
    """Run the command line; ends with one of the exit codes above.

    Parameters
    ----------
    arguments : list of str, optional
        Left out, those of the process.
    """
    try:
        app(arguments, prog_name="linetrack")
    except KeyboardInterrupt:  # before click catches it
        sys.exit(INTERRUPTED)
    except Exception as error:
        if _debug:
            raise
        if not (isinstance(error, OSError) and error.errno == errno.EPIPE):
            _complain(error)
        sys.exit(USAGE if isinstance(error, UsageError) else FAILED)


def _complain(error: Exception) -> None:
    from rich.console import Console
    from rich.text import Text

    if isinstance(error, OSError) and error.strerror:
        text = f"{error.filename}: {error.strerror}" if error.filename else error.strerror
    elif type(error).__module__.startswith(("acquisition", "twin", "tracking")) or (
        isinstance(error, ValueError) and str(error)
    ):
        text = str(error)
    elif isinstance(error, ModuleNotFoundError):
        text = f"{error.name} is not installed: pip install 'linetrack[capture]'"
    else:
        text = (
            f"unexpected {type(error).__name__} ({error}); linetrack --debug ... shows where, "
            "please report it"
        )
    line = Text.assemble(("linetrack: ", "bold red"), " ".join(text.split()))
    Console(stderr=True).print(line, soft_wrap=True)
