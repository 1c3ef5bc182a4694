"""What the subcommands of the command line do; each returns an exit code of `acquisition.cli`."""

from __future__ import annotations

import json
import os
import re
import select
import signal
import sys
import threading
import time
import tomllib
from contextlib import ExitStack, closing, contextmanager, nullcontext, suppress
from dataclasses import asdict, dataclass, replace
from importlib.metadata import entry_points
from itertools import islice
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from rich.console import Console, Group
from rich.live import Live
from rich.markup import escape
from rich.progress import BarColumn, Progress, TextColumn
from rich.table import Table
from rich.text import Text

from acquisition import charts
from acquisition.capture import Capture
from acquisition.cli import DOUBTFUL, INTERRUPTED, UsageError
from acquisition.dat import DatWriter, numbered, read_dat, write_dat
from acquisition.frames import FULL_SCALE, MASTER_CLOCK, Frame, FrameFlags
from acquisition.links import GROUP, LinkError, LinkUnavailable, open_link
from acquisition.protocol import COUNT_MAX, ICG_MIN, Command, CommandError, Mode
from acquisition.session import (
    BATCH,
    Metadata,
    Session,
    SessionWriter,
    open_session,
    record,
    require_h5py,
)
from acquisition.tables import csv_writer, read_csv

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Iterable, Iterator, Sequence

    from numpy.typing import NDArray

    from acquisition.capture import Firmware
    from acquisition.links import Link

SESSION_SUFFIXES: Final = frozenset({".h5", ".hdf5"})
ORIGINAL_ICG: Final = 30000
"""ICG period of original mode if none is given, master clocks: the thesis's."""

_SAMPLE: Final = 1000  # frames of a session that `info` looks at
_HINT: Final = "  q or Ctrl-C ends"
_REFRESH: Final = 0.1  # s between two pictures of `live`
_PATIENCE: Final = 1.0  # s after the first Ctrl-C; a later one interrupts whatever is going on


# --- capture ------------------------------------------------------------------------------------


@dataclass
class Tally:
    """What came in so far.

    Parameters
    ----------
    source : Capture
        Where the frames come from; it knows what was damaged on the way.

    Attributes
    ----------
    frames, invalid : int
        Frames that came; those that contradict themselves.
    dropped, lost : int
        Read-outs that a newer one replaced on the device, since the link was still busy; those that
        did not arrive.
    reason : str
        What is wrong with the first invalid frame.
    """

    source: Capture | None = None
    frames: int = 0
    invalid: int = 0
    dropped: int = 0
    lost: int = 0
    reason: str = ""
    _first: Frame | None = None
    _last: Frame | None = None
    _expected: int = 0

    def take(self, frame: Frame) -> None:
        """Count a frame."""
        self.frames += 1
        if frame.flags & FrameFlags.INVALID:
            self.invalid += 1
            self.reason = self.reason or "; ".join(frame.invalid())
        gap = max(0, frame.sequence - self._expected)
        if frame.flags & FrameFlags.DROPPED and not frame.flags & FrameFlags.LOST:
            self.dropped += gap
        else:  # in original mode nobody counts them
            uncounted = frame.flags & FrameFlags.LOST and frame.timestamp is None
            self.lost += gap or bool(uncounted)
        self._expected = frame.sequence + 1
        if self._first is None:
            self._first = frame
        self._last = frame

    @property
    def corrupt(self) -> int:
        """Transfers that arrived damaged; their frames are among the lost."""
        return 0 if self.source is None else self.source.statistics.corrupt

    @property
    def doubtful(self) -> bool:
        """Whether anything went wrong; what the device drops for want of time is no mistake."""
        return bool(self.invalid or self.lost or self.corrupt)

    @property
    def seconds(self) -> float:
        """From first frame to last, by the device's clock where it tells, else the host's."""
        if self._first is None or self._last is None:
            return 0.0
        if self._first.timestamp is not None and self._last.timestamp is not None:
            return max(0.0, (self._last.timestamp - self._first.timestamp) / 1e9)
        return max(0.0, (self._last.monotonic_ns - self._first.monotonic_ns) / 1e9)

    @property
    def rate(self) -> float:
        """Frames per second, where the device tells its time; else 0."""
        known = self._last is not None and self._last.timestamp is not None
        return (self.frames - 1) / self.seconds if known and self.seconds else 0.0

    def line(self, asked: int | None = None, *, brief: bool = False) -> str:
        """All of it in one line.

        Parameters
        ----------
        asked : int, optional
            How many there should be; told if they are fewer.
        brief : bool
            Leave out what is 0.
        """
        count = f"{self.frames} frame{'' if self.frames == 1 else 's'}"
        if asked is not None and self.frames < asked:
            count = f"{self.frames} of {asked} read-outs"
        rate = f", {self.rate:.1f}/s" if self.rate else ""
        dropped = f", {self.dropped} dropped" if self.dropped else ""
        doubts = (
            (self.lost, "lost", "yellow"),
            (self.corrupt, "damaged", "yellow"),
            (self.invalid, "invalid", "red"),
        )
        return f"{count}{rate}{dropped}" + "".join(
            f", [{colour}]{number} {what}[/]" if number else f", 0 {what}"
            for number, what, colour in doubts
            if number or not brief
        )


def capture(
    *,
    argument: str | None,
    icg: int | None,
    sh: int,
    count: int | None,
    output: str,
    link: str,
    stream: bool,
    seconds: float | None,
    leds: str | None,
    head: Path | None,
    firmware: str,
    overwrite: bool,
    quiet: bool,
) -> int:
    """Capture frames into files; returns the exit code."""
    published = _published(firmware, stream=stream)
    command = _command(sh, icg, count, seconds, leds, stream=stream)
    session = Path(output).suffix.lower() in SESSION_SUFFIXES
    if session:
        _check_target(Path(output), overwrite=overwrite, option="-o ")
        require_h5py()
    else:
        _check_prefix(output, option="-o ")
    lens_system = None if head is None else _description(head)
    console = Console(stderr=True, quiet=quiet)
    error: BaseException | None = None
    with ExitStack() as stack:
        device = stack.enter_context(open_device(link, argument))
        source = Capture(device, command, firmware=published)
        pressed = stack.enter_context(until_ctrl_c(source))
        tally = Tally(source)
        metadata = {
            "link": " ".join([link, *([argument] if argument else [])]),
            "command": _as_json(command),
            "lens_system": lens_system or getattr(device, "lens_system", {}),
            "master_clock": getattr(device, "master_clock", MASTER_CLOCK),
        }
        writer: _LateSession | DatWriter = DatWriter(output)
        if session:
            writer = _LateSession(Path(output), metadata, source, overwrite=overwrite)
        stack.callback(writer.close)
        in_time = None if seconds is None else max(1, round(seconds * command.frame_rate()))
        total = min((n for n in (command.count, in_time) if n), default=None)
        over = threading.Event()
        stored = record(_until(source, seconds, command, over), _Counting(writer, tally))
        update = stack.enter_context(_progress(console, "capture", total))
        try:
            with closing(stored):
                for _ in stored:
                    update(tally.frames, tally.line)
        except (Exception, KeyboardInterrupt) as caught:  # noqa: BLE001  (raised again below)
            error = caught
    kept, interrupted = tally.frames, pressed.is_set()
    if interrupted and isinstance(error, LinkError | KeyboardInterrupt):
        error = None
    if not kept and error is None and not interrupted:
        error = LinkError("the link has nothing to send: is the recording empty?")
    if kept or interrupted:
        line = tally.line(total if command.count else None)
        where = _where(output, kept, session=session)
        console.print(f"{where}: {line}", highlight=False, soft_wrap=True)
    if kept and not session:
        _warn_of_older(console, output, kept)
    if tally.reason:
        console.print(f"[red]invalid:[/] {escape(tally.reason)}", highlight=False, soft_wrap=True)
    if error is not None:
        raise error
    if interrupted and (total or not kept):
        of = f" of {total}" if total else ""
        console.print(f"ended with Ctrl-C; {kept}{of} frames are kept", highlight=False)
        return INTERRUPTED
    missing = command.count > kept + tally.dropped + tally.lost
    if missing and not interrupted and not over.is_set():
        console.print(f"[yellow]{command.count} frames were asked for[/]; the link had no more")
        return DOUBTFUL
    return DOUBTFUL if tally.doubtful else 0


def _published(firmware: str, *, stream: bool) -> Firmware:
    """Read the option --firmware."""
    if firmware == "linetrack":
        return "linetrack"
    if firmware != "original":
        raise UsageError(f"--firmware {firmware}: allowed are linetrack and original")
    if stream:
        raise UsageError("--firmware original: the published firmware knows no --stream")
    return "original"


def open_device(link: str, argument: str | None, **options: Any) -> Link:
    """Open what ``--link`` names, as `open_link` does.

    Raises
    ------
    UsageError
        If there is no link of this name.
    LinkUnavailable, LinkError
        As from `open_link`.
    """
    try:
        return open_link(link, argument, **options)
    except LinkUnavailable as error:
        if link in entry_points(group=GROUP).names:
            raise
        raise UsageError(str(error)) from error


@contextmanager
def until_ctrl_c(source: Capture) -> Iterator[threading.Event]:
    """Let Ctrl-C end a capture, and yield what it sets; the capture is closed at the end.

    It interrupts nothing but waiting; one that comes when that has not helped does.
    """
    pressed, first = threading.Event(), 0.0

    def note(*_: object) -> None:
        nonlocal first
        if not pressed.is_set():
            first = time.monotonic()
            pressed.set()
            source.interrupt()
        elif time.monotonic() - first > _PATIENCE:
            raise KeyboardInterrupt

    before = signal.signal(signal.SIGINT, note)
    try:
        yield pressed
    finally:
        signal.signal(signal.SIGINT, before)
        with suppress(ValueError):  # its thread hangs in the link: given up with the second Ctrl-C
            source.close()


def _until(
    source: Capture, seconds: float | None, command: Command, over: threading.Event
) -> Iterator[Frame]:
    """Yield frames until one is later than the first by so many seconds; then `over` is set."""
    first: int | None = None
    # as many read-outs as fit, whatever the rounding of the timestamps; at least one
    end = None if seconds is None else max(1, (seconds - 0.5 / command.frame_rate()) * 1e9)
    for frame in source:
        if end is not None and frame.timestamp is not None:
            first = frame.timestamp if first is None else first
            if frame.timestamp - first >= end:
                over.set()
                return
        yield frame


class _Counting:
    """Counts what was stored, also that which nobody waited for any more."""

    def __init__(self, writer: _LateSession | DatWriter, tally: Tally) -> None:
        self._writer, self._tally = writer, tally

    def append(self, frames: Sequence[Frame]) -> None:
        self._writer.append(frames)
        for frame in frames:
            self._tally.take(frame)


def _command(
    sh: int,
    icg: int | None,
    count: int | None,
    seconds: float | None,
    leds: str | None,
    *,
    stream: bool,
) -> Command:
    if leds is not None and not stream:
        raise UsageError("--leds needs --stream: original mode lights its two LEDs itself")
    if seconds is not None and not 0 < seconds <= 1e6:
        raise UsageError(f"--seconds {seconds:g}: allowed is > 0 up to a million")
    if icg is None:
        icg = -(-ICG_MIN // sh) * sh if stream and sh > 0 else ORIGINAL_ICG
    if stream:
        count = count or 0
    else:
        wanted = None if seconds is None else max(1, round(seconds * MASTER_CLOCK / max(icg, 1)))
        if wanted is not None and wanted > COUNT_MAX and count is None:
            raise UsageError(
                f"--seconds {seconds:g} is {wanted} frames; original mode sends {COUNT_MAX} at "
                "most: take --stream, or a longer -i"
            )
        count = min(x for x in (wanted, count) if x is not None) if wanted or count else count
        count = 2 if count is None else count
    mode = Mode.STREAM if stream else Mode.ORIGINAL
    try:
        return Command(sh, icg, count, mode, _sequence(leds, sh))
    except CommandError as error:
        raise UsageError(str(error)) from error


def _sequence(leds: str | None, sh_period: int) -> list[dict[int, int]]:
    """Read the option --leds."""
    result: list[dict[int, int]] = []
    for frame in [] if leds is None else leds.split(","):
        lit: dict[int, int] = {}
        for part in [] if frame.strip() == "-" else frame.split("+"):
            channel, colon, clocks = part.strip().partition(":")
            if not (channel.isdecimal() and (clocks.isdecimal() or not colon)):
                raise UsageError(
                    f"--leds {leds}: {part.strip()!r} is not CHANNEL or CHANNEL:CLOCKS; such as "
                    "0:80,1:80 or 0+1,-"
                )
            if int(channel) in lit:
                raise UsageError(f"--leds {leds}: LED {channel} twice in one frame")
            lit[int(channel)] = int(clocks) if colon else sh_period
        result.append(lit)
    return result


def _check_target(path: Path, *, overwrite: bool, option: str = "") -> None:
    """Find out before anything is captured that it cannot be written."""
    if not path.parent.is_dir():
        raise UsageError(f"{option}{path}: there is no folder {path.parent}; make it first")
    if not os.access(path.parent, os.W_OK):
        raise UsageError(f"{option}{path}: the folder {path.parent} may not be written to")
    if path.is_dir():
        raise UsageError(f"{option}{path}: is a folder; name a file in it")
    if not overwrite and path.exists():
        raise UsageError(f"{option}{path}: exists; take another name, or --overwrite")


def _check_prefix(prefix: str, *, option: str = "") -> None:
    """The same for numbered files."""
    if not prefix:
        raise UsageError(f"{option}'': a name is needed, such as output for output00001.dat")
    path = Path(prefix)
    if path.suffix.lower() in (".dat", ".csv"):
        raise UsageError(
            f"{option}{prefix}: the files get numbers, and would be {numbered(prefix, 1)} and so "
            f"on; give the prefix alone: {path.with_suffix('')}"
        )
    _check_target(numbered(prefix, 1), overwrite=True, option=option)


def _highest(prefix: str) -> int:
    """Largest number among a prefix's files, 0 if there are none."""
    path = Path(f"{prefix}#")
    name = re.compile(re.escape(path.name[:-1]) + r"([0-9]{5,})\.dat")
    matches = (name.fullmatch(entry.name) for entry in path.parent.iterdir())
    return max((int(match[1]) for match in matches if match), default=0)


def _warn_of_older(console: Console, prefix: str, kept: int) -> None:
    if (highest := _highest(prefix)) > kept:
        console.print(
            f"[yellow]older files remain,[/] up to {escape(str(numbered(prefix, highest)))}: a "
            "replay would mix them in; delete them, or take another name",
            highlight=False,
            soft_wrap=True,
        )


def _description(path: Path) -> dict[str, Any]:
    text = path.read_bytes()
    try:
        value = json.loads(text) if path.suffix == ".json" else tomllib.loads(text.decode())
    except ValueError as error:  # also what is no UTF-8
        raise UsageError(f"--head {path}: neither TOML nor JSON ({error})") from error
    if not isinstance(value, dict):
        raise UsageError(f"--head {path}: names with values are needed, not a {type(value)}")
    return {"name": path.name, "description": json.loads(json.dumps(value, default=str))}


def _as_json(command: Command) -> dict[str, Any]:
    return {
        "mode": command.mode.name.lower(),
        "sh_period": command.sh_period,
        "icg_period": command.icg_period,
        "count": command.count,
        "sequence": [{str(n): clocks for n, clocks in lit.items()} for lit in command.sequence],
        "unit": "master clocks",
    }


class _LateSession:
    """A session that is made with its first frame, when the device has told its firmware."""

    def __init__(
        self, path: Path, metadata: dict[str, Any], source: Capture, *, overwrite: bool
    ) -> None:
        self._path, self._metadata, self._source = path, metadata, source
        self._overwrite = overwrite
        self._writer: SessionWriter | None = None

    def append(self, frames: Sequence[Frame]) -> None:
        if self._writer is None and frames:
            status = self._source.status
            build = "" if status is None else status.firmware
            metadata = Metadata(**self._metadata, firmware_build=build)
            self._writer = SessionWriter(self._path, metadata, overwrite=self._overwrite)
        if self._writer is not None:
            self._writer.append(frames)

    def close(self) -> None:
        if self._writer is not None:
            self._writer.close()


def _where(output: str, kept: int, *, session: bool) -> str:
    if session:
        return escape(output) if kept else "nothing written"
    if not kept:
        return "nothing written"
    names = [str(numbered(output, n)) for n in sorted({1, kept})]
    return escape((" and " if kept == 2 else " to ").join(names))


@contextmanager
def _progress(
    console: Console, what: str, total: float | None
) -> Iterator[Callable[[int, Callable[[], str]], None]]:
    """Yield a function that takes how many frames there are, and what tells more about them."""
    if console.quiet or not console.is_terminal:
        yield lambda *_: None
        return
    columns = (TextColumn(what), BarColumn(), TextColumn("{task.fields[line]}"))
    with Progress(*columns, console=console, transient=True) as progress:
        task = progress.add_task(what, total=total, line="waiting for the first frame")
        shown = 0.0

        def update(frames: int, line: Callable[[], str]) -> None:
            nonlocal shown
            if time.monotonic() - shown >= _REFRESH:
                shown = time.monotonic()
                progress.update(task, completed=frames, line=line())

        yield update


# --- plot ---------------------------------------------------------------------------------------


def plot(*, files: Sequence[Path], save: Path | None, frames: str | None, elements: bool) -> int:
    """Draw intensity charts; returns the exit code."""
    curves: list[tuple[str, Frame]] = []
    sessions = [path for path in files if is_session(path)]
    if frames is not None and not sessions:
        raise UsageError(f"--frames {frames}: a .dat file holds one frame; only sessions have more")
    for path in files:
        if path in sessions:
            with open_session(path) as session:
                for index in _chosen(session, frames):
                    frame = session[index]
                    curves.append((f"{path.name} frame {index + 1}, {_lit(frame)}", frame))
        else:
            curves.append((path.name, read_dat(path)))
    if save is None:
        charts.show_chart(curves, whole=elements)
    else:
        charts.save_chart(curves, str(save), whole=elements)
        Console(stderr=True).print(f"wrote {escape(str(save))}", highlight=False, soft_wrap=True)
    return 0


def is_session(path: Path) -> bool:
    """Whether a file is to be read as a session: it is HDF5, or named so.

    Raises
    ------
    OSError
        It cannot be read.
    """
    with path.open("rb") as file:
        return file.read(4) == b"\x89HDF" or path.suffix.lower() in SESSION_SUFFIXES


def _chosen(session: Session, frames: str | None) -> list[int]:
    """Indices of the frames that --frames asks for."""
    count = len(session)
    if not count:
        raise UsageError(f"{session.path}: there is no frame in it")
    if frames is None:
        leds = session.table(0, 4 * BATCH)["leds"]
        return sorted(np.unique(leds, return_index=True)[1].tolist())[:7]
    result: list[int] = []
    for part in frames.split(","):
        first, colon, last = part.partition(":")
        try:
            numbers = [int(first), int(last) if colon else int(first)]
        except ValueError as error:
            message = f"--frames {frames}: {part!r} is no number and no range such as 10:12"
            raise UsageError(message) from error
        for number in numbers:
            if number == 0 or abs(number) > count:
                message = (
                    f"--frames {frames}: {session.path} has frames 1 to {count} (-1: the last)"
                )
                raise UsageError(message)
        start, end = (n - 1 if n > 0 else n + count for n in numbers)
        if start > end:
            message = f"--frames {frames}: {part} ends before it begins; the smaller number first"
            raise UsageError(message)
        result += range(start, end + 1)
    return result


def _lit(frame: Frame) -> str:
    return f"LED {'+'.join(map(str, frame.channels))}" if frame.channels else "no LED"


# --- live ---------------------------------------------------------------------------------------


def live(
    *,
    argument: str | None,
    icg: int | None,
    sh: int,
    link: str,
    stream: bool | None,
    leds: str | None,
    firmware: str,
    frames: int | None,
) -> int:
    """Show frames in the terminal as they come; returns the exit code."""
    published = _published(firmware, stream=bool(stream))
    if stream is None:
        stream = published != "original" and (
            link != "replay" or Path(argument or "").suffix.lower() in SESSION_SUFFIXES
        )
    command = _command(sh, icg, None, None, leds, stream=stream)
    options = {"realtime": True} if link == "replay" else {}
    console, tally, view = Console(), Tally(), _View()
    with open_device(link, argument, **options) as device, _keys() as pressed:
        source = _endless(device, command, published, tally)
        screen = Live(console=console, auto_refresh=False, vertical_overflow="crop")
        with closing(source), screen if console.is_terminal else nullcontext():
            shown = 0.0
            with suppress(KeyboardInterrupt):
                for frame in islice(source, frames):
                    tally.take(frame)
                    view.take(frame)
                    if console.is_terminal and time.monotonic() - shown >= _REFRESH:
                        shown = time.monotonic()
                        screen.update(view.picture(console, tally, hint=_HINT), refresh=True)
                    if pressed() == "q":
                        break
            if console.is_terminal:
                screen.update(view.picture(console, tally), refresh=True)
            else:
                console.print(view.picture(console, tally))
    return DOUBTFUL if tally.doubtful else 0


def _endless(device: Link, command: Command, firmware: Firmware, tally: Tally) -> Generator[Frame]:
    """Yield frames until there are no more; original mode is asked again and again."""
    more = True
    while more:
        with Capture(device, command, firmware=firmware) as tally.source:
            more = False
            for frame in tally.source:
                more = command.mode is Mode.ORIGINAL
                yield frame


class _View:
    """The latest frame of each LED pattern, as text."""

    def __init__(self) -> None:
        self._latest: dict[int, Frame] = {}
        self._span = charts.Span()

    def take(self, frame: Frame) -> None:
        self._latest[frame.leds] = frame
        self._span.take(frame.pixels)

    def picture(self, console: Console, tally: Tally, *, hint: str = "") -> Group:
        plain = not console.encoding.startswith("utf")
        width = max(20, min(console.width, 240) - 6)
        most = max(1, (console.height - 2) // 6)
        shown = sorted(self._latest)[:most]
        height = max(2, min(20, (console.height - 2) // max(1, len(shown)) - 3))
        parts: list[Text] = []
        for number, mask in enumerate(shown):
            frame = self._latest[mask]
            pixels, colour = frame.pixels, charts.COLOURS[number % 6]
            head = Text.assemble(
                (_lit(frame), f"bold {colour}"),
                ("  invalid" if frame.flags & FrameFlags.INVALID else "", "bold red"),
                f"  {_spike(pixels)}; dark {frame.dark_level:g}",
                f", integration {_time(frame.integration_time)}",
                no_wrap=True,
                overflow="ellipsis",
            )
            parts.append(head)
            lines = charts.text_chart(pixels, width, height, self._span, plain=plain)
            marks = {0: f"{self._span.high:.0f}", height - 1: f"{self._span.low:.0f}"}
            for row, line in enumerate(lines):
                parts.append(Text.assemble((f"{marks.get(row, ''):>5} ", "dim"), (line, colour)))
            parts.append(Text("      " + _ruler(width), "dim"))
        hidden = len(self._latest) - len(shown)
        foot = Text.from_markup(tally.line(brief=True))
        if hidden:
            foot.append(f"  ({hidden} more LED patterns: make the window higher)")
        foot.append(hint if sys.stdin.isatty() else "", "dim")
        foot.no_wrap, foot.overflow = True, "ellipsis"
        return Group(*parts, foot)


def _spike(pixels: NDArray[np.uint16]) -> str:
    found = charts.spike(pixels)
    if found is None:
        return "no spike"
    centre, width, depth = found
    return f"spike at {centre:.1f}, {width} wide, {depth:.0f} deep"


def _ruler(width: int) -> str:
    """Pixel numbers under a chart."""
    line = [" "] * width
    last = 3647
    for pixel in (0, 1000, 2000, 3000, last):
        text = str(pixel)
        at = min(round(pixel / last * (width - 1)), width - len(text))
        if all(cell == " " for cell in line[max(at - 1, 0) : at + len(text)]):
            line[at : at + len(text)] = text
    return "".join(line)


@contextmanager
def _keys() -> Iterator[Callable[[], str]]:
    """Yield a function that returns the key pressed, or nothing."""
    if not sys.stdin.isatty():
        yield lambda: ""
        return
    import termios
    import tty

    before = termios.tcgetattr(sys.stdin)
    try:
        tty.setcbreak(sys.stdin)

        def pressed() -> str:
            ready, _, _ = select.select([sys.stdin], [], [], 0)
            return os.read(sys.stdin.fileno(), 1).decode("latin-1") if ready else ""

        yield pressed
    finally:
        termios.tcsetattr(sys.stdin, termios.TCSADRAIN, before)


# --- info ---------------------------------------------------------------------------------------


def info(*, files: Sequence[Path]) -> int:
    """Tell what is in files; returns the exit code."""
    console = Console()
    doubtful = False
    for number, path in enumerate(files):
        if is_session(path):
            with open_session(path) as session:
                rows = _about_session(session)
        else:
            rows = _about_dat(read_dat(path))
        table = Table(show_header=False, box=None, padding=(0, 2, 0, 0))
        for name, value in rows.items():
            doubtful = doubtful or name == "invalid"
            table.add_row(Text(name, "dim"), value)
        console.print(Text(("\n" if number else "") + str(path), "bold"), soft_wrap=True)
        console.print(table)
    return DOUBTFUL if doubtful else 0


def _clocks(clocks: int, master_clock: int) -> str:
    if not clocks:
        return "unknown"
    return f"{clocks} clocks = {_time(clocks / master_clock)}"


def _time(seconds: float) -> str:
    if seconds < 1e-3:
        return f"{seconds * 1e6:.6g} us"
    return f"{seconds * 1e3:.6g} ms" if seconds < 1 else f"{seconds:.6g} s"


def _timing(frame: Frame) -> dict[str, str]:
    clock = frame.master_clock
    icg = _clocks(frame.icg_period, clock)
    if frame.icg_period:
        icg += f", {clock / frame.icg_period:.6g} frames/s"
    return {
        "SH period": f"{_clocks(frame.sh_period, clock)}, the integration time",
        "ICG period": icg,
        "master clock": f"{clock / 1e6:g} MHz",
    }


def _values(lowest: int, highest: int, dark: float) -> str:
    text = f"{lowest} to {highest} counts, dark {dark:g}"
    return text + (" (at the converter's end)" if highest >= FULL_SCALE else "")


def _about_dat(frame: Frame) -> dict[str, str]:
    pixels = frame.pixels
    rows = {
        "file": ".dat, 1 frame",
        **_timing(frame),
        "pixels": _values(int(pixels.min()), int(pixels.max()), frame.dark_level)
        + f", lowest at pixel {int(pixels.argmin())}",
    }
    if reasons := frame.invalid():
        rows["invalid"] = f"[red]{escape('; '.join(reasons))}[/]"
    return rows


def _about_session(session: Session) -> dict[str, str]:
    metadata, count = session.metadata, len(session)
    state = {
        "closed": "complete",
        "being written": "[yellow]being written[/] just now",
        "cut off": "[yellow]cut off[/]: its writer could not finish it; the frames are good",
    }[session.state]
    rows = {
        "file": f"session (HDF5), {state}",
        "made": time.strftime("%Y-%m-%d %H:%M:%S UTC", time.gmtime(metadata.created_utc_ns / 1e9))
        + f", linetrack {escape(metadata.linetrack_version)}",
        "link": escape(metadata.link) or "unknown",
        "firmware": escape(metadata.firmware_build) or "unknown",
        "lens head": escape(str(metadata.lens_system.get("name", "")) or "not described"),
        "frames": str(count),
    }
    if not count:
        return rows
    table = session.table()
    first = session[0]
    rows |= _timing(first)
    gaps = np.maximum(np.diff(table["sequence"].astype(np.int64)) - 1, 0)
    own = table["flags"][1:] & int(FrameFlags.DROPPED | FrameFlags.LOST) == FrameFlags.DROPPED
    times = table["timestamp"] if (table["timestamp"] >= 0).all() else table["monotonic_ns"]
    span = (int(times[-1]) - int(times[0])) / 1e9
    if span > 0:
        rows["rate"] = f"{(count - 1) / span:.6g} frames/s over {_time(span)}"
    rows["dropped"] = f"{gaps[own].sum()} read-outs, the link was busy"
    rows["lost"] = f"{gaps[~own].sum()} read-outs, they did not arrive"
    invalid = int(np.count_nonzero(table["flags"] & int(FrameFlags.INVALID)))
    _, firsts, numbers = np.unique(table["leds"], return_index=True, return_counts=True)
    shown = [
        f"{_lit(session[int(at)])}: {n}" for at, n in zip(firsts[:8], numbers[:8], strict=True)
    ]
    rows["lit"] = ", ".join(shown) + (" ..." if firsts.size > 8 else "")
    indices = np.unique(np.linspace(0, count - 1, min(count, _SAMPLE)).astype(int))
    lowest, highest, dark = FULL_SCALE, 0, []
    for frame in map(session.__getitem__, indices.tolist()):
        lowest = min(lowest, int(frame.pixels.min()))
        highest = max(highest, int(frame.pixels.max()))
        dark.append(frame.dark_level)
    rows["pixels"] = _values(lowest, highest, float(np.median(dark)))
    if indices.size < count:
        rows["pixels"] += f" (of {indices.size} frames)"
    if invalid:
        rows["invalid"] = f"[red]{invalid} frames[/]"
    return rows


# --- convert ------------------------------------------------------------------------------------


def convert(*, files: Sequence[str], overwrite: bool, quiet: bool) -> int:
    """Convert between the formats; returns the exit code."""
    if len(files) < 2:
        raise UsageError("convert needs what to read and, last, what to write")
    *names, output = files
    sources, target = [Path(name) for name in names], Path(output)
    if target in sources:
        raise UsageError(f"{target} is to be read and written at once")
    console = Console(stderr=True, quiet=quiet)
    suffix, lost = target.suffix.lower(), ""
    if suffix in SESSION_SUFFIXES | {".csv", ".dat"}:
        _check_target(target, overwrite=overwrite)
    else:
        _check_prefix(output)
        if not overwrite and (highest := _highest(output)):
            name = numbered(output, highest)
            raise UsageError(f"{name}: exists; take another name, or --overwrite")
    sessions, total = _about(sources)
    with _progress(console, "convert", total) as update:
        frames = _shown(_read_all(sources), update)
        if suffix in SESSION_SUFFIXES:
            written = _to_session(frames, target, sources, sessions)
        elif suffix == ".csv":
            written = _to_csv(frames, target)
            lost = "firmware, wiring, lens head and command" if sessions else ""
        else:
            written = _to_dat(frames, output)
            lost = "the frames' numbers, LEDs, times and flags"
            lost = lost + "; firmware, wiring, lens head and command" if sessions else lost
            if all(path.suffix.lower() == ".dat" for path in sources):
                lost = ""
    numbers = suffix not in SESSION_SUFFIXES | {".csv", ".dat"}
    console.print(
        f"{_where(output, written, session=not numbers)}: {written} frame{'' if written == 1 else 's'}"
        + (f"; [yellow]not kept:[/] {lost}" if lost else ""),
        highlight=False,
        soft_wrap=True,
    )
    if numbers:
        _warn_of_older(console, output, written)
    return 0


def _about(sources: Iterable[Path]) -> tuple[dict[Path, Metadata], int | None]:
    """What the sessions say about themselves, and how many frames there are, if that is known."""
    sessions: dict[Path, Metadata] = {}
    total, known = 0, True
    for path in sources:
        if is_session(path):
            with open_session(path) as session:
                sessions[path] = session.metadata
                total += len(session)
        else:
            total += 1
            known = known and path.suffix.lower() != ".csv"
    return sessions, total if known else None


def _read_all(sources: Iterable[Path]) -> Iterator[Frame]:
    """Yield the frames of all files."""
    for number, path in enumerate(sources):
        if is_session(path):
            with open_session(path) as session:
                yield from session
        elif path.suffix.lower() == ".csv":
            yield from read_csv(path)
        else:
            yield replace(read_dat(path), sequence=number)


def _shown(
    frames: Iterator[Frame], update: Callable[[int, Callable[[], str]], None]
) -> Iterator[Frame]:
    for number, frame in enumerate(frames, start=1):
        update(number, f"{number} frames".__str__)
        yield frame


def _merged(sources: Sequence[Path], sessions: dict[Path, Metadata], clock: int) -> Metadata:
    """What a session made from these files says: all that the sessions among them did."""
    if len(sources) == 1 and sessions:
        return sessions[sources[0]]
    extra: dict[str, Any] = {"converted_from": [path.name for path in sources]}
    if sessions:
        extra["sessions"] = [{"file": p.name, **asdict(about)} for p, about in sessions.items()]
    result = Metadata(link="files", extra=extra, master_clock=clock, wiring="")
    if len(sessions) == len(sources):
        first, *others = sessions.values()
        for name in ("firmware_build", "command", "lens_system", "wiring"):
            value = getattr(first, name)
            if all(getattr(other, name) == value for other in others):
                result = replace(result, **{name: value})
    return result


def _to_session(
    frames: Iterator[Frame],
    target: Path,
    sources: Sequence[Path],
    sessions: dict[Path, Metadata],
) -> int:
    batch = list(islice(frames, BATCH))
    about = _merged(sources, sessions, batch[0].master_clock if batch else MASTER_CLOCK)
    with TemporaryDirectory(prefix=f".{target.name}.", dir=target.parent) as folder:
        part = Path(folder) / target.name
        with SessionWriter(part, about) as writer:
            while batch:
                writer.append(batch)
                batch = list(islice(frames, BATCH))
        part.replace(target)  # not before all of it is there
        return len(writer)


def _to_csv(frames: Iterator[Frame], target: Path) -> int:
    count = 0
    with csv_writer(target) as write:
        for frame in frames:
            write(frame)
            count += 1
    return count


def _to_dat(frames: Iterator[Frame], output: str) -> int:
    """One frame for NAME.dat; else numbered files after a prefix."""
    target = Path(output)
    if target.suffix.lower() != ".dat":
        folder = numbered(output, 1).parent
        with TemporaryDirectory(prefix=".", dir=folder) as parts:
            writer = DatWriter(Path(parts) / "f")
            while batch := list(islice(frames, BATCH)):
                writer.append(batch)
            for number in range(1, writer.stored + 1):  # not before all of them are there
                numbered(writer.prefix, number).replace(numbered(output, number))
        return writer.stored
    two = list(islice(frames, 2))
    if len(two) != 1:
        raise UsageError(
            f"{output} holds one frame, and there are {'more' if two else 'none'}; for numbered "
            f"files give the prefix alone: {target.with_suffix('')}"
        )
    write_dat(target, two[0])
    return 1
