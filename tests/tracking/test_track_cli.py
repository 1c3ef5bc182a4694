"""The command `linetrack track`: what it prints and sends, what it refuses, how it ends."""

from __future__ import annotations

import csv
import io
import json
import math
import os
import re
import signal
import socket
import subprocess
import sys
import time
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import pytest

from acquisition import cli
from acquisition.dat import DatWriter
from acquisition.frames import ELEMENTS, LEADING, PIXELS, Frame, FrameFlags
from acquisition.session import Metadata, SessionWriter
from raytransfer.designs import DESIGNS, design_text
from tracking.calibration import Calibration
from tracking.camera import Camera
from tracking.cli import read_leds
from tracking.leds import LedMap
from tracking.output import (
    CSV_HEADER,
    KEYS,
    LineWriter,
    UdpWriter,
    as_csv,
    as_json,
    as_text,
    flag_names,
    host_and_port,
)
from tracking.poses import Estimate, PoseFlags, optical
from twin.rooms import load_room

if TYPE_CHECKING:
    from collections.abc import Callable

CAMERA = Camera(3500.0, 1830.0, pupil=8.0)
LEDS = LedMap.line(2, 500.0)
X, Y = 120.0, 1700.0
PERIOD = 3_700_000
LINETRACK = [sys.executable, "-m", "acquisition"]

COVARIANCE = np.array([[4.0, 0.5, 0.0], [0.5, 9.0, 1e-6], [0.0, 1e-6, 1e-4]])
ESTIMATE = Estimate(
    123_456_789, 1.25, 1300.5, -0.01, COVARIANCE, PoseFlags.PREDICTED | PoseFlags.HEADING_ASSUMED
)


def frame(number: int, **options: Any) -> Frame:
    """LEDs in turns, seen from (X, Y)."""
    rng = np.random.default_rng(number)
    at = CAMERA.project(optical(LEDS.positions, X, Y))[number % 2]
    light = 600 * np.exp(-(((np.arange(PIXELS) - at) / 5) ** 2) / 2)
    elements = 3900 + rng.normal(0, 1.3, ELEMENTS)
    elements[LEADING : LEADING + PIXELS] -= light
    values = {
        "sequence": number,
        "leds": 1 << number % 2,
        "exposures": {number % 2: 100},
        "sh_period": 100,
        "icg_period": 14800,
        "timestamp": 1_000_000 + number * PERIOD,
        **options,
    }
    return Frame(np.rint(elements).astype(np.uint16), **values)


class Result(NamedTuple):
    code: int
    out: str
    err: str

    @property
    def lines(self) -> list[str]:
        return self.out.splitlines()


@pytest.fixture
def run(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> Callable[..., Result]:
    """Run a command line in a folder with a recording, run.h5, and its calibration, room.json."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "110")
    with SessionWriter("run.h5", Metadata(link="test")) as writer:
        writer.append([frame(number) for number in range(60)])
    Calibration(CAMERA, LEDS).save("room.json")

    def function(line: str) -> Result:
        capfd.readouterr()
        with pytest.raises(SystemExit) as ended:
            cli.main(line.split())
        out, err = capfd.readouterr()
        code = ended.value.code
        return Result(code if isinstance(code, int) else 0, out, err)

    return function


REPLAY = "track --link replay run.h5 --calibration room.json"


# --- forms of output ------------------------------------------------------------------------------


def test_json_has_exactly_these_keys(run: Callable[..., Result]) -> None:
    result = run(f"{REPLAY} --count 5 --json")
    assert result.code == 0
    poses = [json.loads(line) for line in result.lines]
    assert len(poses) == 5
    for number, pose in enumerate(poses, start=1):  # the first pose comes with the second LED
        assert tuple(pose) == KEYS == ("t_ns", "x", "y", "heading", "cov", "flags")
        assert pose["t_ns"] == 1_000_000 + number * PERIOD
        cov = np.array(pose["cov"])
        assert cov.shape == (3, 3)
        assert np.array_equal(cov, cov.T)
        assert pose["heading"] == 0
        assert "heading_assumed" in pose["flags"]
    assert abs(poses[-1]["x"] - X) < 1
    assert abs(poses[-1]["y"] - Y) < 5


def test_csv_says_the_same(run: Callable[..., Result]) -> None:
    result = run(f"{REPLAY} --count 5 --csv")
    assert result.code == 0
    assert result.lines[0] == CSV_HEADER
    rows = list(csv.DictReader(io.StringIO(result.out)))
    poses = [json.loads(line) for line in run(f"{REPLAY} --count 5 --json").lines]
    assert len(rows) == 5
    for row, pose in zip(rows, poses, strict=True):
        assert [float(row[key]) for key in ("t_ns", "x", "y", "heading")] == [
            pose[key] for key in ("t_ns", "x", "y", "heading")
        ]
        assert float(row["cov_xy"]) == pose["cov"][0][1]
        assert float(row["cov_hh"]) == pose["cov"][2][2]
        assert row["flags"].split("|") == pose["flags"]


def test_lines_for_people(run: Callable[..., Result]) -> None:
    result = run(f"{REPLAY} --count 3")
    assert result.code == 0
    number = r"-?\d+\.\d+ +"
    pattern = rf" *{number}s +x +{number}± {number}mm +y +{number}± {number}mm +heading +{number}.*"
    for line in result.lines:
        assert re.fullmatch(pattern, line), line
        assert line.endswith("heading assumed, unchecked")  # as with any two LEDs
    assert "3 poses of 4 frames, 270.3/s, 0 lost, 0 damaged, 0 invalid" in result.err
    assert run(f"{REPLAY} --count 3 --quiet").err == ""


def test_a_pose_in_all_forms() -> None:
    assert json.loads(as_json(ESTIMATE)) == {
        "t_ns": 123_456_789,
        "x": 1.25,
        "y": 1300.5,
        "heading": -0.01,
        "cov": COVARIANCE.tolist(),
        "flags": ["predicted", "heading_assumed"],
    }
    values = "123456789,1.25,1300.5,-0.01,4.0,0.5,0.0,9.0,1e-06,0.0001"
    assert as_csv(ESTIMATE) == f"{values},predicted|heading_assumed"
    text = as_text(ESTIMATE)
    for part in ("0.123457 s", "1.25 ± 2.00", "1300.50 ± 3.00", "-0.573 ± 0.573", "predicted, "):
        assert part in text
    assert flag_names(PoseFlags.NONE) == []


def test_what_is_not_known_is_null() -> None:
    cov = np.diag([math.inf, 4.0, math.inf])
    estimate = Estimate(0, 0.0, 1.0, 0.0, cov)
    assert json.loads(as_json(estimate))["cov"] == [[None, 0, 0], [0, 4, 0], [0, 0, None]]
    assert as_csv(estimate) == "0,0.0,1.0,0.0,,0.0,0.0,4.0,0.0,,"
    assert "x      0.00 ± ?" in as_text(estimate)


def test_every_line_is_flushed() -> None:
    class Pipe(io.StringIO):
        flushed = 0

        def flush(self) -> None:
            self.flushed = len(self.getvalue())

    pipe = Pipe()
    writer = LineWriter(pipe, as_csv, CSV_HEADER)
    assert pipe.getvalue() == ""  # as long as there is no pose
    for number in (2, 3):
        writer(ESTIMATE)
        assert pipe.flushed == len(pipe.getvalue())
        assert len(pipe.getvalue().splitlines()) == number
    assert pipe.getvalue().splitlines().count(CSV_HEADER) == 1


# --- UDP ------------------------------------------------------------------------------------------


def test_udp_sends_a_datagram_for_each_pose(run: Callable[..., Result]) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        receiver.settimeout(10)
        result = run(f"{REPLAY} --count 7 --udp 127.0.0.1:{receiver.getsockname()[1]}")
        poses = [json.loads(receiver.recv(65536)) for _ in range(7)]
    assert result.code == 0
    assert result.out == ""
    assert [tuple(pose) for pose in poses] == [KEYS] * 7
    assert [pose["t_ns"] for pose in poses] == [1_000_000 + n * PERIOD for n in range(1, 8)]


def test_nobody_at_the_port_does_not_end_it(run: Callable[..., Result]) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        port = receiver.getsockname()[1]
    result = run(f"{REPLAY} --udp 127.0.0.1:{port}")
    assert result.code == 0
    assert "59 poses of 60 frames" in result.err


def test_what_the_network_refuses_is_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    writer = UdpWriter("127.0.0.1", 9)

    class Down:
        def sendto(self, *_: object) -> None:
            raise OSError(101, "Network is unreachable")

        def close(self) -> None:
            pass

    assert writer.complaint() == ""
    writer.close()
    monkeypatch.setattr(writer, "_socket", Down())
    for _ in range(3):
        writer(ESTIMATE)
    assert writer.complaint() == "3 of 3 datagrams were not sent: Network is unreachable"


@pytest.mark.parametrize("options", ["", " --quiet", " --count 5 -q"])
def test_datagrams_that_are_refused_are_no_success(
    options: str, run: Callable[..., Result]
) -> None:
    """A broadcast, which the socket is not allowed."""
    result = run(f"{REPLAY} --udp 255.255.255.255:5005{options}")
    assert result.code == cli.DOUBTFUL
    number = 5 if "5" in options else 59
    said = result.err.splitlines()
    assert said[-1] == f"{number} of {number} datagrams were not sent: Permission denied"
    assert len(said) == (2 if not options else 1)


@pytest.mark.parametrize(("count", "code"), [([], cli.DOUBTFUL), (["-n", "9999"], cli.INTERRUPTED)])
def test_datagrams_refused_until_ctrl_c(count: list[str], code: int) -> None:
    arguments = ["track", "--link", "twin", "--udp", "255.255.255.255:5005", "-q", *count]
    starter = """
import os, signal, sys, threading
from acquisition import cli
from tracking.output import UdpWriter

send = UdpWriter.__call__

def sending(self, estimate):
    send(self, estimate)
    if self.failed == 3:
        os.kill(os.getpid(), signal.SIGINT)

UdpWriter.__call__ = sending
cli.main(sys.argv[1:])
"""
    result = subprocess.run(
        [sys.executable, "-c", starter, *arguments],
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
    )
    assert result.returncode == code, result.stderr
    assert re.fullmatch(r"(\d+) of \1 datagrams were not sent: .*\n", result.stderr)


@pytest.mark.parametrize(
    ("text", "found"),
    [("10.0.0.7:5005", ("10.0.0.7", 5005)), ("[::1]:1", ("::1", 1)), ("pi:65535", ("pi", 65535))],
)
def test_hosts_and_ports(text: str, found: tuple[str, int]) -> None:
    assert host_and_port(text) == found


@pytest.mark.parametrize("text", ["", "host", ":5", "host:0", "host:65536", "::1:5", "host:5x"])
def test_what_is_no_host_and_port(text: str) -> None:
    with pytest.raises(ValueError, match="is no HOST:PORT"):
        host_and_port(text)


# --- what ends it ---------------------------------------------------------------------------------


def test_the_end_of_the_recording(run: Callable[..., Result]) -> None:
    result = run(f"{REPLAY} --json")
    assert result.code == 0
    assert len(result.lines) == 59
    result = run(f"{REPLAY} --json --count 100")
    assert result.code == cli.DOUBTFUL
    assert "100 poses were asked for; the link had no more frames" in result.err


def test_frames_that_are_missing_are_told(run: Callable[..., Result]) -> None:
    kept = [frame(n) for n in range(20) if n not in (7, 8)]
    kept[7] = frame(9, flags=FrameFlags.LOST)
    with SessionWriter("gaps.h5") as writer:
        writer.append(kept)
    result = run("track --link replay gaps.h5 --calibration room.json --json")
    assert result.code == cli.DOUBTFUL
    assert "2 lost" in result.err
    assert len(result.lines) == 17


def test_a_reader_that_goes_away_ends_it_quietly(tmp_path: Path) -> None:
    with SessionWriter(tmp_path / "long.h5") as writer:
        writer.append([frame(n) for n in range(400)])
    Calibration(CAMERA, LEDS).save(tmp_path / "room.json")
    arguments = "track --link replay long.h5 --calibration room.json --json".split()
    with subprocess.Popen(
        [*LINETRACK, *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(Path.cwd())},
        text=True,
    ) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        assert json.loads(process.stdout.readline())["t_ns"] > 0
        process.stdout.close()
        err = process.stderr.read()
        process.wait(timeout=30)
    assert err == ""
    assert process.returncode == cli.FAILED  # as for every command


@pytest.mark.parametrize(("count", "code"), [([], 0), (["--count", "100000"], cli.INTERRUPTED)])
def test_ctrl_c_ends_it_cleanly(count: list[str], code: int) -> None:
    """With the twin, which would go on for ever."""
    with subprocess.Popen(
        [*LINETRACK, "track", "--link", "twin", "--json", *count],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        assert process.stdout is not None
        for _ in range(3):
            assert tuple(json.loads(process.stdout.readline())) == KEYS
        process.send_signal(signal.SIGINT)
        begun = time.monotonic()
        out, err = process.communicate(timeout=60)
    assert time.monotonic() - begun < 30
    assert process.returncode == code, err
    assert "Traceback" not in err
    assert re.search(r"\d+ poses of \d+ frames", err)
    for line in out.splitlines():
        assert tuple(json.loads(line)) == KEYS  # the last one is whole


def test_the_twin_is_followed() -> None:
    """The real firmware's image, two LEDs, the tracker 1300 mm before them, nothing calibrated."""
    result = subprocess.run(
        [*LINETRACK, *"track --link twin --count 5 --json".split()],
        capture_output=True,
        text=True,
        check=True,
        timeout=120,
    )
    poses = [json.loads(line) for line in result.stdout.splitlines()]
    assert len(poses) == 5
    assert np.diff([pose["t_ns"] for pose in poses]).min() >= PERIOD
    assert abs(poses[-1]["x"]) < 2
    assert abs(poses[-1]["y"] - 1300) < 10  # as drawn, not as measured


def test_the_walk_is_followed() -> None:
    """A room of the twin: heading is measured, LEDs are those of the room's plan."""
    result = subprocess.run(
        [*LINETRACK, *"track --link twin walk --count 20 --csv".split()],
        capture_output=True,
        text=True,
        check=True,
        timeout=120,
    )
    rows = list(csv.DictReader(io.StringIO(result.stdout)))
    assert len(rows) == 20
    assert "heading_assumed" not in rows[-1]["flags"]
    at, x, y, heading = (float(rows[-1][key]) for key in ("t_ns", "x", "y", "heading"))
    true = load_room("walk").world.pose(0.7e-3 + at * 1e-9)  # it boots in about so long
    assert math.dist((x, y), (true.x, true.y)) < 10
    assert abs(heading - true.heading) < 5e-3


# --- options --------------------------------------------------------------------------------------


def test_leds_from_a_file(run: Callable[..., Result], tmp_path: Path) -> None:
    (tmp_path / "leds.csv").write_text("# channel, x, y, z\n0, -500, 0\n\n1 500 0 0  # right\n")
    assert read_leds(tmp_path / "leds.csv") == LedMap([0, 1], [[-500, 0], [500, 0]])
    half = json.loads(run(f"{REPLAY} --json").lines[-1])
    result = run(f"{REPLAY} --json --leds leds.csv")
    wide = json.loads(result.lines[-1])
    assert abs(wide["x"] - 2 * half["x"]) < 1  # twice as far apart: everything is
    assert abs(wide["y"] + 8 - 2 * (half["y"] + 8)) < 5


def test_a_heading_is_given_in_degrees(run: Callable[..., Result]) -> None:
    pose = json.loads(run(f"{REPLAY} --json --heading 5").lines[-1])
    assert pose["heading"] == round(math.radians(5), 9)
    assert abs(pose["x"] - X) > 50


def test_the_head_comes_with_the_recording(run: Callable[..., Result]) -> None:
    with SessionWriter("other.h5", Metadata(lens_system={"name": "a", "description": {}})) as file:
        file.append([frame(n) for n in range(6)])
    result = run("track --link replay other.h5")
    assert result.code == cli.USAGE
    assert "'a', is no design" in result.err
    assert "give --head or --calibration" in result.err
    with SessionWriter("none.h5") as file:
        file.append([frame(n) for n in range(6)])
    assert run("track --link replay none.h5 --head thesis").code == 0


def test_another_head_than_the_recordings_is_told(run: Callable[..., Result]) -> None:
    """With it poses come out that are wrong and look right."""
    text = design_text(DESIGNS["slit-4mm"])
    about = Metadata(lens_system={"name": "slit", "description": tomllib.loads(text)})
    with SessionWriter("slit.h5", about) as file:
        file.append([frame(n) for n in range(6)])
    result = run("track --link replay slit.h5 --head thesis --quiet")
    assert result.code == 0
    assert "--head thesis is not the head that the frames come from: that is head" in " ".join(
        result.err.split()
    )
    for same in ("", " --head slit-4mm"):
        assert run(f"track --link replay slit.h5 --quiet{same}").err == ""


@pytest.mark.parametrize(
    ("line", "code", "message"),
    [
        ("track --json --csv", 2, "--json and --csv: one form of output at a time"),
        ("track --json --udp a:1", 2, "--json and --udp: one form"),
        ("track --udp nowhere", 2, "--udp 'nowhere' is no HOST:PORT"),
        ("track --udp a..b:5005", 2, "--udp a..b:5005: 'a..b' is no name of a host"),
        (f"track --udp {'a' * 300}:5005", 2, "a' is no name of a host"),
        (f"{REPLAY} --heading nan", 2, "--heading nan: a number of degrees is needed"),
        (f"{REPLAY} --heading=-inf", 2, "--heading -inf: a number of degrees is needed"),
        ("track --link replay none.h5 --csv", 1, "none.h5 cannot be read"),
        ("track --link replay blind.h5 -c room.json --csv", 1, "were not seen well enough"),
        (f"{REPLAY} --leds run.h5", 2, "--leds run.h5: it is no text"),
        ("track --method best", 2, "--method best: allowed are filter and thesis"),
        ("track --method thesis --json", 2, "neither errors nor times: leave out --json"),
        ("track --method thesis --heading 3", 2, "--heading: --method thesis does not use it"),
        ("track --method thesis --height-error 3", 2, "--height-error: --method thesis does not"),
        ("track --method thesis --corners .", 2, "--corners and --area belong together"),
        ("track --method thesis --corners . --area 1,2", 2, "--area 1,2: four numbers"),
        ("track --method thesis --corners . --area 1,2,3,4", 1, "lf: no folder"),
        ("track --corners .", 2, "--corners needs --method thesis"),
        ("track --area 1,2,3,4", 2, "--area needs --method thesis"),
        ("track --count -1", 2, "greater than or equal to 0"),
        ("track --link nowhere", 2, "there is no link 'nowhere'"),
        ("track --link replay none.h5", 1, "none.h5 cannot be read"),
        (f"{REPLAY} --head thesis", 2, "--head thesis: the calibration has a camera already"),
        (f"{REPLAY} -s 20", 2, "-s 20 is below 40"),
        (f"{REPLAY} -i 14801", 2, "-i 14801 is no multiple"),
        (f"{REPLAY} --leds one.csv", 2, "1 LED in the map: a pose needs two"),
        (f"{REPLAY} --leds bad.csv", 2, "--leds bad.csv, line 2: '1, x' is not channel, x"),
        (f"{REPLAY} --leds empty.csv", 2, "there is no LED in it"),
        (f"{REPLAY} --leds twice.csv", 2, r"--leds twice.csv: .* each may be used once"),
        (f"{REPLAY} --leds other.csv", 1, "is lit by LED 0, and the LED map has 4, 5"),
        ("track --link replay run.h5 --head no", 2, "--head no: neither a design file nor one"),
        ("track --link replay run.h5 -c run.h5", 1, "run.h5: "),
        ("track --link replay none.dat", 1, "none.dat cannot be read"),
        ("track --link replay dark.h5 -c room.json", 1, "no LED is lit in 3 frames, or nothing"),
        ("track --link replay blind.h5 -c room.json", 1, "LEDs 0, 1 were not seen well enough"),
        ("track --link replay void.h5 -c room.json", 1, "nothing to send: is the recording empty"),
        ("track --link replay d -c room.json", 1, r"\.dat files do not, record with --stream"),
    ],
)
def test_errors_say_what_to_do(
    line: str, code: int, message: str, run: Callable[..., Result], tmp_path: Path
) -> None:
    for name, text in {
        "one": "0, 0, 0",
        "bad": "0, 0, 0\n1, x",
        "empty": "# nothing",
        "twice": "0 0 0\n0 500 0",
        "other": "4 -250 0\n5 250 0",
    }.items():
        (tmp_path / f"{name}.csv").write_text(text)
    dark = np.full(ELEMENTS, 3900, np.uint16)
    dark[::2] -= 1
    for name, frames in {
        "dark": [frame(n, leds=0, exposures={}) for n in range(3)],
        "blind": [Frame(dark, sequence=n, leds=1 << n % 2, timestamp=n) for n in range(3)],
        "void": [],
    }.items():
        with SessionWriter(f"{name}.h5") as writer:
            writer.append(frames)
    DatWriter("d").append([frame(0), frame(1)])
    result = run(line)
    assert result.code == code, result
    assert re.search(message, result.err), result.err
    assert "Traceback" not in result.err
    assert result.out == ""


@pytest.mark.parametrize("options", [[], ["--csv"], ["--method", "thesis"]])
def test_standard_output_that_is_closed_is_told(options: list[str]) -> None:
    result = subprocess.run(
        [*LINETRACK, "track", "--link", "twin", *options],
        preexec_fn=lambda: os.close(1),
        stderr=subprocess.PIPE,
        text=True,
        check=False,
        timeout=60,
    )
    assert result.returncode == cli.USAGE
    assert re.fullmatch(r"linetrack: standard output is closed, .*\n", result.stderr)


def test_no_pose_is_told_while_it_lasts(run: Callable[..., Result]) -> None:
    noise = np.random.default_rng(1).normal(3900, 1.3, ELEMENTS)
    night = np.rint(noise).astype(np.uint16)
    dark = [replace(frame(n, leds=0, exposures={}), elements=night) for n in range(300)]
    with SessionWriter("late.h5") as writer:
        writer.append([*dark, *(frame(n) for n in range(300, 310))])
    result = run("track --link replay late.h5 -c room.json --json")
    assert result.code == 0
    assert result.err.count("no pose yet") == 1
    assert len(result.lines) == 9


def test_that_there_is_no_pose_is_said_again_and_of_which_leds(
    run: Callable[..., Result], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a map of another room, say: nobody waits before a line that stands still."""
    monkeypatch.setattr("tracking.cli.AGAIN", 0.4)
    with SessionWriter("one.h5") as writer:
        writer.append([frame(n, leds=1, exposures={0: 60}) for n in range(700)])
    result = run("track --link replay one.h5 -c room.json --json")
    assert result.err.count("no pose yet") > 2
    assert "(1 never)" in " ".join(result.err.split())


# --- the thesis's way -----------------------------------------------------------------------------


def test_the_thesiss_method(run: Callable[..., Result]) -> None:
    result = run("track --method thesis --link twin --count 3")
    assert result.code == 0
    assert len(result.lines) == 3
    for line in result.lines:
        x, y = (float(word) for word in line.split())
        assert abs(x - 1855.5) < 5  # midpoint in the file's lines: 32 more than the pixel
        assert abs(abs(y) - 1377) < 30
    assert re.fullmatch(r"3 positions \(.*, pixels\), 0 invalid\n", result.err)


def test_the_thesiss_method_in_millimetres(run: Callable[..., Result], tmp_path: Path) -> None:
    for corner, left, far in (("lf", -1, 1), ("lb", -1, 2), ("rf", 1, 1), ("rb", 1, 2)):
        (tmp_path / corner).mkdir()
        spikes = [_spike_frame(1823 - 600 * left / far + side * 700 / far) for side in (-1, 1)]
        DatWriter(tmp_path / corner / "output").append(spikes)
    DatWriter("here").append([_spike_frame(1823 + side * 700 / 1.5) for side in (-1, 1)])
    line = "track --method thesis --link replay here --corners . --area=-1000,1000,1000,2000"
    result = run(f"{line} -n 1")
    assert result.code == 0
    x, y = (float(word) for word in result.out.split())
    assert abs(x) < 5
    assert 1200 < y < 1700
    assert result.err.count("\n") == 5  # four corners, and the summary


def _spike_frame(at: float) -> Frame:
    light = 900 * np.exp(-(((np.arange(PIXELS) - at) / 4) ** 2) / 2)
    elements = np.full(ELEMENTS, 3900.0)
    elements[LEADING : LEADING + PIXELS] -= light
    elements[:LEADING:2] -= 1
    return Frame(np.rint(elements).astype(np.uint16), sh_period=100, icg_period=30000)


# --- help -----------------------------------------------------------------------------------------


def test_help_has_examples_and_loads_nothing_slow() -> None:
    code = """
import json, sys
from acquisition import cli
try:
    cli.main(sys.argv[1:])
finally:
    print(json.dumps(sorted(sys.modules)), file=sys.stderr)
"""
    for arguments in (["--help"], ["track", "--help"]):
        result = subprocess.run(
            [sys.executable, "-c", code, *arguments],
            capture_output=True,
            text=True,
            check=True,
            env={**os.environ, "COLUMNS": "100"},
        )
        loaded = set(json.loads(result.stderr))
        slow = {"numpy", "scipy", "numba", "h5py", "matplotlib", "acquisition.commands"}
        assert not loaded & slow
        assert "track" in result.stdout
    assert "linetrack track " in result.stdout.partition("Examples")[2]
    assert not loaded & {"raytransfer", "twin"}
