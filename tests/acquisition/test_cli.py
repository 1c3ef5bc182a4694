"""The command line: what it writes, what it says, and with which exit code it ends."""

from __future__ import annotations

import json
import os
import pty
import re
import select
import signal
import subprocess
import sys
import time
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import pytest
from PIL import Image

from acquisition import charts, cli
from acquisition.dat import read_dat
from acquisition.frames import ELEMENTS, Frame, FrameFlags
from acquisition.session import Metadata, SessionWriter, open_session
from acquisition.tables import read_csv

if TYPE_CHECKING:
    from collections.abc import Callable

SPIKES = (2400, 1250)
PLUGIN = """
import time
from pathlib import Path
from acquisition.links import ReplayLink
from acquisition.session import open_session

def greet(name: str) -> None:
    \"\"\"Greet someone.\"\"\"
    print("hello", name)

def fail() -> None:
    raise RuntimeError("oops")

class Silent:
    def wait_ready(self, timeout):
        Path("waiting").touch()
        time.sleep(timeout)
        return False

    def transfer(self, tx):
        return bytes(len(tx))

    def close(self):
        pass

    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass

class Stuck(Silent):
    def wait_ready(self, timeout):
        Path("waiting").touch()
        time.sleep(1000)

def silent(argument, **options):
    return Silent()

def stuck(argument, **options):
    return Stuck()

def endless(argument, **options):
    frames = list(open_session(argument))
    return ReplayLink(frames, loop=True, realtime=True)
"""
ENTRY_POINTS = """
[linetrack.links]
replay = acquisition.links:open_replay
endless = linetrack_plugin:endless
silent = linetrack_plugin:silent
stuck = linetrack_plugin:stuck
[linetrack.commands]
greet = linetrack_plugin:greet
fail = linetrack_plugin:fail
broken = linetrack_nowhere:command
several = linetrack_plugin:several
deep = linetrack_package.inner:app
"""
PACKAGE = {
    "__init__.py": "raise RuntimeError('imported')\n",
    "inner.py": '''
import typer

app = typer.Typer(
    add_completion=False,
)


@app.command(
    epilog="none",
)
@decorated
def main(
    name: str = "",

    more: str = "",
) -> None:
    """Deep down: in a package whose __init__ would fail."""


def other():
    """Not this."""
''',
}


def frame(number: int, *, light: float = 1800.0) -> Frame:
    at = np.arange(ELEMENTS) - 32 - SPIKES[number % 2]
    noise = np.random.default_rng(number).normal(0, 1.2, ELEMENTS)
    values = 3920 + noise - light * np.exp(-((at / 3) ** 2) / 2)
    return Frame(
        np.rint(values).astype(np.uint16),
        sequence=number,
        leds=1 << number % 2,
        exposures={number % 2: 100},
        sh_period=100,
        icg_period=14800,
        timestamp=1_000_000 + number * 3_700_000,
        utc_ns=1,
        monotonic_ns=number * 3_700_000,
    )


FRAMES = [frame(number) for number in range(60)]


def words(line: str) -> list[str]:
    return line.split()


class Result(NamedTuple):
    code: int
    out: str
    err: str


@pytest.fixture
def plugins(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A package that brings a link and three commands."""
    folder = tmp_path / "site"
    about = folder / "linetrack_plugin-1.dist-info"
    about.mkdir(parents=True)
    (folder / "linetrack_plugin.py").write_text(PLUGIN)
    (folder / "linetrack_package").mkdir()
    for name, text in PACKAGE.items():
        (folder / "linetrack_package" / name).write_text(text)
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: linetrack-plugin\nVersion: 1\n")
    (about / "entry_points.txt").write_text(ENTRY_POINTS)
    monkeypatch.syspath_prepend(str(folder))
    monkeypatch.setenv("PYTHONPATH", f"{folder}:{Path.cwd()}")
    return folder


@pytest.fixture
def run(
    plugins: Path,
    capfd: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> Callable[..., Result]:
    """Run a command line in a folder with a recording, run.h5."""
    folder = plugins.parent / "work"
    folder.mkdir()
    monkeypatch.chdir(folder)
    monkeypatch.setenv("COLUMNS", "110")
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "MPLBACKEND"):
        monkeypatch.delenv(name, raising=False)
    with SessionWriter("run.h5", Metadata(link="test", firmware_build="f1")) as writer:
        writer.append(FRAMES)

    def function(*arguments: str) -> Result:
        capfd.readouterr()
        with pytest.raises(SystemExit) as ended:
            cli.main(list(arguments))
        out, err = capfd.readouterr()
        code = ended.value.code
        return Result(code if isinstance(code, int) else 0, out, err)

    return function


def lowest(some: Frame) -> int:
    return int(some.pixels.argmin())


# --- capture


def test_capture_writes_the_files_of_the_original(run: Callable[..., Result]) -> None:
    result = run(*words("capture -i 14800 -s 100 -n 2 -o output --link replay run.h5"))
    assert result.code == 0
    assert "output00001.dat and output00002.dat: 2 frames" in result.err
    assert result.out == ""
    for name, number in (("output00001.dat", 0), ("output00002.dat", 1)):
        read = read_dat(name)
        assert np.array_equal(read.elements, FRAMES[number].elements)
        assert (read.sh_period, read.icg_period, read.master_clock) == (100, 14800, 4_000_000)
        assert lowest(read) == SPIKES[number]


def test_long_options_do_the_same(run: Callable[..., Result]) -> None:
    line = "capture run.h5 --icg 14800 --sh 100 --count 1 --output a --link replay --quiet"
    assert run(*line.split()) == Result(0, "", "")
    assert np.array_equal(read_dat("a00001.dat").elements, FRAMES[0].elements)


def test_stream_into_a_session(run: Callable[..., Result], tmp_path: Path) -> None:
    (tmp_path / "head.toml").write_text('name = "f60 pair"\ngaps = [1.5]\n')
    head = str(tmp_path / "head.toml")
    line = "capture --link replay run.h5 --stream -n 20 --leds 0:100,1:100 -o out.h5 --head"
    result = run(*line.split(), head)
    assert result.code == 0
    assert "out.h5: 20 frames, 270.3/s, 0 lost, 0 damaged, 0 invalid" in result.err
    with open_session("out.h5") as session:
        assert session.state == "closed"
        for stored, sent in zip(session, FRAMES[:20], strict=True):
            assert np.array_equal(stored.elements, sent.elements)
            assert stored.exposures == sent.exposures
            assert stored.utc_ns
        about = session.metadata
    assert about.firmware_build == "f1"  # as recorded
    assert about.link == "replay run.h5"
    assert about.command["sequence"] == [{"0": 100}, {"1": 100}]
    assert about.command["icg_period"] == 14800  # the shortest with -s 100
    assert about.lens_system == {
        "name": "head.toml",
        "description": {"name": "f60 pair", "gaps": [1.5]},
    }


def test_seconds_are_the_devices(run: Callable[..., Result]) -> None:
    result = run(*words("capture --link replay run.h5 --stream --seconds 0.1 -o out.h5"))
    assert result.code == 0
    with open_session("out.h5") as session:
        assert len(session) == round(0.1 / 3.7e-3)
    line = "capture --link replay run.h5 -i 14800 --seconds 0.037 -o out"
    assert "out00001.dat to out00010.dat: 10 frames" in run(*line.split()).err


def test_fewer_than_asked_for_is_told(run: Callable[..., Result]) -> None:
    result = run(*words("capture --link replay run.h5 --stream -n 100 -o out.h5"))
    assert result.code == cli.DOUBTFUL
    assert "100 frames were asked for" in result.err
    with open_session("out.h5") as session:
        assert len(session) == 60


def test_invalid_frames_are_stored_told_and_end_with_3(run: Callable[..., Result]) -> None:
    shifted = Frame(np.roll(FRAMES[0].elements, -2400), sh_period=100, icg_period=30000)
    with SessionWriter("bad.h5") as writer:
        writer.append(shifted)
    result = run(*words("capture --link replay bad.h5 -n 1 -o out"))
    assert result.code == cli.DOUBTFUL
    assert "1 invalid" in result.err
    assert "invalid: the dark reference" in result.err
    result = run("info", "out00001.dat")
    assert result.code == cli.DOUBTFUL
    assert "the dark reference" in result.out


def test_an_empty_recording_is_a_failure(run: Callable[..., Result]) -> None:
    SessionWriter("none.h5").close()
    result = run(*words("capture --link replay none.h5 --stream -n 2 -o out.h5"))
    assert result.code == cli.FAILED
    assert "nothing to send" in result.err


@pytest.mark.parametrize(
    ("line", "code", "message"),
    [
        ("capture -i 100 -s 30000", 2, "-i 100 is below 14776, .*; are -i and -s swapped"),
        ("capture -i 30000 -s 101", 2, "-i 30000 is no multiple of -s 101"),
        ("capture -i 30000 -s 20", 2, "-s 20 is below 40"),
        ("capture -n 0", 2, "-n 0: allowed are 1 to 65535"),
        ("capture -n 65536", 2, "-n 65536: allowed are 1 to 65535"),
        ("capture -n two", 2, "valid integer"),
        ("capture --seconds -1", 2, "--seconds -1: allowed is > 0"),
        ("capture --seconds 1000", 2, "original mode sends 65535 at most: take --stream"),
        ("capture --leds 0", 2, "--leds needs --stream"),
        ("capture --stream --leds 0:x", 2, "'0:x' is not CHANNEL or CHANNEL:CLOCKS"),
        ("capture --stream --leds 0+0", 2, "LED 0 twice in one frame"),
        ("capture --stream --leds 64", 2, "LED 64: allowed are channels 0 to 63"),
        (
            "capture --stream --leds 0:800",
            2,
            "= 800 clocks: allowed are 0 .dark. and 10 up to the SH period, 100",
        ),
        ("capture -o none/x", 2, "there is no folder none"),
        ("capture -o run.h5", 2, "-o run.h5: exists; take another name, or --overwrite"),
        ("capture --head run.h5", 2, "--head run.h5: neither TOML nor JSON"),
        ("capture --head none.toml", 1, "none.toml: No such file"),
        ("capture --link nowhere", 2, "there is no link 'nowhere'; available: .*replay"),
        ("capture --link replay", 1, "needs a recording: --link replay FILE"),
        ("capture --link replay none.h5", 1, "none.h5 cannot be read"),
        ("capture --link replay run.h5", 1, "recorded with -s 100 -i 14800; give the same"),
        ("capture -o none/", 2, "-o none/00001.dat: there is no folder none"),
        ("capture -o out.dat", 2, "would be out.dat00001.dat .* give the prefix alone: out"),
        ("capture --stream -o site.h5", 2, "-o site.h5: is a folder"),
        ("capture --firmware old", 2, "--firmware old: allowed are linetrack and original"),
        ("capture --firmware original --stream", 2, "knows no --stream"),
        ("plot run.h5 --frames 3:1", 2, "3:1 ends before it begins"),
        ("plot none.dat", 1, "none.dat: No such file"),
        ("plot run.h5 --frames 61", 2, "run.h5 has frames 1 to 60"),
        ("plot run.h5 --frames x", 2, "'x' is no number and no range"),
        ("plot run.h5 --save a.xyz", 1, "'xyz' is not supported"),
        ("plot run.h5", 1, "there is no display .* --save chart.png"),
        ("info site", 1, "site: No such file"),
        ("convert run.h5", 2, "convert needs what to read and, last, what to write"),
        ("convert run.h5 run.h5", 2, "to be read and written at once"),
        ("convert run.h5 one.dat", 2, "one.dat holds one frame, .* give the prefix alone: one"),
        ("nonsense", 2, "No such command 'nonsense'"),
        ("plot", 2, "Missing argument 'FILES...'"),
        ("broken", 2, "the command broken cannot be loaded"),
        ("fail", 1, r"unexpected RuntimeError \(oops\); linetrack --debug"),
    ],
)
def test_errors_say_what_to_do(
    line: str, code: int, message: str, run: Callable[..., Result]
) -> None:
    Path("site.h5").mkdir()
    result = run(*line.split())
    assert result.code == code, result
    assert re.search(message, result.err), result.err
    assert not list(Path().glob("*.dat"))
    assert "Traceback" not in result.err
    if result.err.startswith("linetrack: "):
        assert result.err.count("\n") == 1


def test_debug_shows_where(run: Callable[..., Result]) -> None:
    with pytest.raises(RuntimeError, match="oops"):
        cli.main(["--debug", "fail"])
    assert run("info", "run.h5").code == 0  # does not stick


@pytest.mark.parametrize(("count", "code"), [([], 0), (["-n", "60000"], cli.INTERRUPTED)])
@pytest.mark.usefixtures("run")
def test_ctrl_c_keeps_what_was_captured(count: list[str], code: int) -> None:
    arguments = ["capture", "--link", "endless", "run.h5", "--stream", "-o", "out.h5", *count]
    with subprocess.Popen(
        [sys.executable, "-m", "acquisition", *arguments], stderr=subprocess.PIPE, text=True
    ) as process:
        wait_for(lambda: Path("out.h5").exists() and stored() > 10)
        process.send_signal(signal.SIGINT)
        _, err = process.communicate(timeout=20)
    assert process.returncode == code, err
    assert "Traceback" not in err
    with open_session("out.h5") as session:
        assert session.state == "closed"
        asked = " of 60000 read-outs" if count else " frames"
        assert f"out.h5: {len(session)}{asked}" in err
        if count:
            assert f"ended with Ctrl-C; {len(session)} of 60000 frames are kept" in err
        for number, some in enumerate(session):
            assert np.array_equal(some.elements, FRAMES[number % 60].elements)


@pytest.mark.parametrize(("link", "presses"), [("silent", [0.0]), ("stuck", [0.0, 1.3, 0.3])])
@pytest.mark.usefixtures("run")
def test_ctrl_c_ends_a_long_wait(link: str, presses: list[float]) -> None:
    """A link that looks up now and then ends with the first one, one that hangs with the others."""
    arguments = ["capture", "--link", link, "-i", "4000000", "-o", "out"]
    with subprocess.Popen(
        [sys.executable, "-m", "acquisition", *arguments], stderr=subprocess.PIPE, text=True
    ) as process:
        wait_for(Path("waiting").exists)
        begun = time.monotonic()
        for pause in presses:
            time.sleep(pause)
            process.send_signal(signal.SIGINT)
        _, err = process.communicate(timeout=20)
    assert time.monotonic() - begun < sum(presses) + 2
    assert process.returncode == cli.INTERRUPTED, err
    assert "ended with Ctrl-C; 0 of 2 frames are kept" in err
    assert "Traceback" not in err


def test_what_is_missing_is_counted(run: Callable[..., Result]) -> None:
    gaps = [FRAMES[0], FRAMES[1], replace(FRAMES[5], flags=FrameFlags.LOST)]
    with SessionWriter("gaps.h5") as writer:
        writer.append([*gaps, replace(FRAMES[8], flags=FrameFlags.DROPPED)])
    result = run(*words("capture --link replay gaps.h5 --stream -n 9 -o out.h5"))
    assert result.code == cli.DOUBTFUL
    assert re.search(r"out.h5: 4 of 9 read-outs, \S+/s, 2 dropped, 3 lost, 0 damaged", result.err)
    assert "were asked for" not in result.err


def test_the_first_of_two_limits_counts(run: Callable[..., Result]) -> None:
    result = run(*words("capture --link replay run.h5 --stream -n 1000 --seconds 0.05 -o a.h5"))
    assert result.code == 0
    assert "a.h5: 14 frames" in result.err
    result = run(*words("capture --link replay run.h5 --stream --seconds 1e-9 -o b.h5"))
    assert result.code == 0
    assert "b.h5: 1 frame," in result.err


def test_older_files_are_told(run: Callable[..., Result]) -> None:
    line = words("capture --link replay run.h5 -i 14800 -o out -n")
    assert "older files" not in run(*line, "5").err
    assert "older files" not in run(*line, "5").err
    assert "older files remain, up to out00005.dat: a replay" in run(*line, "2").err
    assert Path("out00003.dat").exists()


def test_a_folder_that_may_not_be_written_to(
    run: Callable[..., Result], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "access", lambda *_: False)  # root may write anywhere
    result = run(*words("capture --link replay run.h5 -o out"))
    assert result.code == cli.USAGE
    assert "the folder . may not be written to" in result.err


def test_no_name_is_refused(run: Callable[..., Result]) -> None:
    result = run(*words("capture --link replay run.h5 -o"), "")
    assert result.code == cli.USAGE
    assert "a name is needed" in result.err


def test_h5py_is_asked_for_before_the_capture(
    run: Callable[..., Result], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "h5py", None)
    result = run(*words("capture --link nowhere --stream -o out.h5"))
    assert result.code == cli.FAILED
    assert "pip install 'linetrack[capture]'" in result.err


def test_without_typer_the_command_says_so() -> None:
    code = "import sys; sys.modules['typer'] = None; from acquisition.cli import main; main()"
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False
    )
    assert result.returncode == cli.FAILED
    expected = "linetrack: the command line needs typer: pip install 'linetrack[capture]'\n"
    assert result.stderr == expected


def stored() -> int:
    with open_session("out.h5") as session:
        return len(session)


def wait_for(condition: Callable[[], bool], seconds: float = 20) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.05)


# --- plot


def test_plot_saves_all_files_in_one_chart(run: Callable[..., Result]) -> None:
    run(*words("capture -i 14800 -n 2 -o output --link replay run.h5"))
    result = run(*words("plot output00001.dat output00002.dat run.h5 --save chart.png"))
    assert result == Result(0, "", "wrote chart.png\n")
    with Image.open("chart.png") as image:
        assert image.size == (900, 450)
        colours = {colour for _, colour in image.convert("RGB").getcolors(1 << 20) or []}
    for colour in charts.COLOURS[:4]:
        assert tuple(bytes.fromhex(colour[1:])) in colours
    assert run(*words("plot run.h5 --frames 1,-1,3:5 --elements --save b.svg")).code == 0
    assert "run.h5 frame 60, LED 1" in Path("b.svg").read_text(encoding="utf-8")


# --- live


def test_live_shows_a_chart_for_each_led(run: Callable[..., Result]) -> None:
    result = run(*words("live --link replay run.h5 --frames 30"))
    assert result.code == 0
    for text in (f"LED 0  spike at {SPIKES[0]}.", f"LED 1  spike at {SPIKES[1]}."):
        assert text in result.out
    assert "30 frames, 270.3/s\n" in result.out
    # in each chart the spike is the only thing that reaches down, at its place
    rows = [line[6:] for line in result.out.splitlines() if any(c > "⠀" for c in line[6:])]
    assert all(len(row) <= 104 for row in rows)
    result = run(*words("live --link replay run.h5 --original -i 14800"))
    assert result.code == 0
    assert "60 frames" in result.out


@pytest.mark.usefixtures("run")
def test_live_ends_with_q() -> None:
    master, slave = pty.openpty()
    command = [sys.executable, "-m", "acquisition", "live", "--link", "endless", "run.h5"]
    with subprocess.Popen(command, stdin=slave, stdout=slave, stderr=slave) as process:
        os.close(slave)
        seen = b""
        end = time.monotonic() + 20
        while b"spike at 2400" not in seen and time.monotonic() < end:
            if select.select([master], [], [], 0.1)[0]:
                seen += os.read(master, 65536)
        os.write(master, b"q")
        with suppress(OSError):  # once the other end is closed
            while time.monotonic() < end:
                if select.select([master], [], [], 0.1)[0]:
                    seen += os.read(master, 65536)
        assert process.wait(timeout=20) == 0
    os.close(master)
    assert b"q or Ctrl-C ends" in seen
    assert b"q or Ctrl-C ends" not in seen[seen.rindex(b" frame") :]
    assert b"Traceback" not in seen


@pytest.mark.parametrize("plain", [False, True])
@pytest.mark.parametrize("width", [20, 77, 200])
@pytest.mark.parametrize("pixel", [0, 1, 1234, 3646, 3647])
def test_a_spike_of_one_pixel_is_never_lost(*, plain: bool, width: int, pixel: int) -> None:
    values = np.full(3648, 3900, np.uint16)
    values[pixel] = 2000
    span = charts.Span()
    span.take(values)
    lines = charts.text_chart(values, width, 10, span, plain=plain)
    assert [len(line) for line in lines] == [width] * 10
    empty = " " if plain else "⠀"
    down = [n for n, cell in enumerate(lines[7]) if cell != empty]
    assert len(down) in (1, 2)
    assert abs(down[0] - pixel * width / 3648) <= 1


def test_the_axis_only_grows() -> None:
    span = charts.Span()
    span.take(np.array([2000, 3900], np.uint16))
    before = (span.low, span.high)
    span.take(np.array([3000, 3100], np.uint16))
    assert (span.low, span.high) == before
    span.take(np.array([0, 3100], np.uint16))
    assert (span.low, span.high) == (0, before[1])


# --- info


def test_info_about_everything(run: Callable[..., Result]) -> None:
    run(*words("convert run.h5 frame"))
    result = run("info", "run.h5", "frame00002.dat")
    assert result.code == 0
    for text in (
        *("session (HDF5), complete", "f1", "100 clocks = 25 us, the integration time"),
        *("14800 clocks = 3.7 ms, 270.27 frames/s", "4 MHz", "LED 0: 30, LED 1: 30"),
        *("frame00002.dat", f"lowest at pixel {SPIKES[1]}", "dark 39"),
    ):
        assert text in result.out


def test_info_tells_losses_and_the_state(run: Callable[..., Result]) -> None:
    with SessionWriter("open.h5") as writer:
        writer.append([FRAMES[0], FRAMES[1], FRAMES[5]])
        writer.append(replace(FRAMES[8], flags=FrameFlags.DROPPED))
        out = run("info", "open.h5").out
    assert "being written just now" in out
    assert re.search(r"lost +3 read-outs", out)
    assert re.search(r"dropped +2 read-outs, the link was busy", out)


# --- convert


def test_convert_there_and_back(run: Callable[..., Result]) -> None:
    result = run("convert", "run.h5", "run.csv")
    assert result.code == 0
    assert "60 frames; not kept: firmware, wiring, lens head and command" in result.err
    assert list(read_csv("run.csv")) == FRAMES
    assert run("convert", "run.csv", "back.h5").code == 0
    with open_session("back.h5") as session:
        assert list(session) == FRAMES
        assert session.metadata.extra == {"converted_from": ["run.csv"]}
    result = run("convert", "back.h5", "f")
    assert (
        "f00001.dat to f00060.dat: 60 frames; not kept: the frames' numbers, LEDs, times and flags"
        in result.err
    )
    result = run("convert", *(f"f{n:05d}.dat" for n in (1, 2, 3)), "three.h5")
    assert result.err == "three.h5: 3 frames\n"
    with open_session("three.h5") as session:
        assert [some.sequence for some in session] == [0, 1, 2]
        assert np.array_equal(session[2].elements, FRAMES[2].elements)
    assert run("convert", "f00003.dat", "g.dat", "-q") == Result(0, "", "")
    assert read_dat("g.dat") == read_dat("f00003.dat")


def test_convert_keeps_a_sessions_description(run: Callable[..., Result]) -> None:
    run("convert", "run.h5", "copy.h5")
    with open_session("copy.h5") as copy, open_session("run.h5") as session:
        assert copy.metadata == session.metadata
        assert list(copy) == list(session)


def test_convert_replaces_nothing_unasked(run: Callable[..., Result]) -> None:
    for target in ("a.csv", "a.h5", "a"):
        assert run("convert", "run.h5", target).code == 0
        assert run("convert", "run.h5", target).code == cli.USAGE
        assert run("convert", "run.h5", target, "--overwrite").code == 0


def test_convert_leaves_no_half_file(run: Callable[..., Result]) -> None:
    run("convert", "run.h5", "a.csv")
    os.truncate("a.csv", 300_000)
    result = run("convert", "a.csv", "b.csv")
    assert result.code == cli.FAILED
    assert re.search(r"a\.csv, line \d+: found \d+ columns, expected 3704", result.err)
    assert not Path("b.csv").exists()


def test_a_broken_input_costs_no_older_file(run: Callable[..., Result]) -> None:
    run("convert", "run.h5", "f")
    run("convert", "run.h5", "good.h5")
    before = {path.name: path.read_bytes() for path in Path().iterdir() if path.is_file()}
    Path("broken.dat").write_text("#")
    names = [*(f"f{n:05d}.dat" for n in range(1, 61)), *["run.h5", "broken.dat"]]
    for target in ("good.h5", "new.h5", "f", "g", "new.csv"):
        assert run("convert", *names, target, "--overwrite").code == cli.FAILED
    Path("broken.dat").unlink()
    assert {path.name: path.read_bytes() for path in Path().iterdir()} == before


def test_convert_looks_at_every_number(run: Callable[..., Result]) -> None:
    Path("keep00002.dat").write_text("precious")
    result = run("convert", "run.h5", "keep")
    assert result.code == cli.USAGE
    assert "keep00002.dat: exists; take another name, or --overwrite" in result.err
    assert [path.name for path in Path().glob("keep*")] == ["keep00002.dat"]


def test_many_sessions_into_one_keep_what_they_said(run: Callable[..., Result]) -> None:
    head = {"name": "f60 pair"}
    with SessionWriter("b.h5", Metadata(link="b", firmware_build="f1", lens_system=head)) as writer:
        writer.append(FRAMES[:2])
    assert run("convert", "run.h5", "b.h5", "all.h5").code == 0
    with open_session("all.h5") as session:
        about = session.metadata
    assert about.firmware_build == "f1"
    assert about.lens_system == {}  # they differ
    assert "[pins]" in about.wiring
    assert [one["file"] for one in about.extra["sessions"]] == ["run.h5", "b.h5"]
    assert about.extra["sessions"][1]["lens_system"] == head


def test_frames_are_of_sessions(run: Callable[..., Result]) -> None:
    run("convert", "run.h5", "f")
    result = run("plot", "f00001.dat", "--frames", "1", "--save", "a.png")
    assert result.code == cli.USAGE
    assert "only sessions have more" in result.err


@pytest.mark.parametrize(("first", "last"), [(0, 9), (1000, 1195), (3638, 3647)])
def test_a_spike_is_measured(first: int, last: int) -> None:
    values = np.full(3648, 3900, np.uint16)
    values[::2] += 3
    assert charts.spike(values) is None
    values[first : last + 1] -= np.uint16(1000)
    found = charts.spike(values)
    assert found is not None
    centre, width, depth = found
    assert abs(centre - (first + last) / 2) < 0.1
    assert width == last - first + 1
    assert abs(depth - 1000) <= 3


@pytest.mark.usefixtures("plugins")
def test_help_fits_80_columns(run: Callable[..., Result], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    lines = [line.strip() for line in run("--help").out.splitlines()]
    for text in (
        "linetrack capture -i 30000 -s 100 -n 2 -o output",
        "two frames, as .dat files",
        "3 done, but some frames are invalid, damaged or lost",
    ):
        assert text in lines


# --- help and plug-ins

LAZY = """
import json, sys
from acquisition import cli
try:
    cli.main(sys.argv[1:])
finally:
    print(json.dumps(sorted(sys.modules)), file=sys.stderr)
"""


@pytest.mark.usefixtures("plugins")
def test_help_loads_nothing_slow() -> None:
    run = subprocess.run(
        [sys.executable, "-c", LAZY, "--help"],
        capture_output=True,
        text=True,
        check=True,
        env={**os.environ, "COLUMNS": "100"},
    )
    loaded = set(json.loads(run.stderr))
    slow = {"numpy", "h5py", "matplotlib", "scipy", "linetrack_plugin", "acquisition.commands"}
    assert not loaded & slow
    for text in ("capture", "plot", "live", "info", "convert", "track"):
        assert text in run.stdout
    # of other packages what their source says, if it can be read
    for line in ("greet +Greet someone.", "several +From linetrack_plugin.", "broken +From line"):
        assert re.search(line, run.stdout), run.stdout
    assert re.search(r"deep +Deep down: in a package whose __init__ would fail\.", run.stdout)
    assert "linetrack capture -i 30000 -s 100 -n 2 -o output" in run.stdout
    assert "Exit codes" in run.stdout


@pytest.mark.parametrize("command", ["capture", "plot", "live", "info", "convert"])
def test_every_command_has_examples(command: str, run: Callable[..., Result]) -> None:
    result = run(command, "--help")
    assert result.code == 0
    assert f"linetrack {command} " in result.out.partition("Example")[2]


def test_commands_of_other_packages(run: Callable[..., Result]) -> None:
    result = run("greet", "Ann")
    assert (result.code, result.out) == (0, "hello Ann\n")
    assert "Greet someone." in run("greet", "--help").out


def test_version(run: Callable[..., Result]) -> None:
    assert re.fullmatch(r"linetrack \S+\n", run("--version").out)


def test_flags_are_kept_through_a_session(run: Callable[..., Result]) -> None:
    flagged = Frame(FRAMES[0].elements, flags=FrameFlags.INVALID | FrameFlags.LOST)
    with SessionWriter("flags.h5") as writer:
        writer.append(flagged)
    result = run("info", "flags.h5")
    assert result.code == cli.DOUBTFUL
    assert re.search(r"invalid +1 frame", result.out)


def test_ctrl_c_while_it_is_imported(tmp_path: Path) -> None:
    (tmp_path / "typer.py").write_text("raise KeyboardInterrupt")
    result = subprocess.run(
        [sys.executable, "-m", "acquisition"],
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path), str(Path.cwd())])},
        capture_output=True,
        text=True,
        check=False,
    )
    assert (result.returncode, result.stdout, result.stderr) == (cli.INTERRUPTED, "", "")


def test_ctrl_c_before_a_command_is_known(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(cli, "app", interrupted)
    with pytest.raises(SystemExit) as ended:
        cli.main([])
    assert ended.value.code == cli.INTERRUPTED
    assert capfd.readouterr() == ("", "")
