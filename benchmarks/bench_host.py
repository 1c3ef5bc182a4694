"""The host's side: frames decoded, checked and stored; the command line's start."""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from acquisition.frames import ELEMENTS, Frame
from acquisition.protocol import decode_frame, encode_frame
from acquisition.session import Metadata, SessionWriter, record
from benchmarks.measure import Result, interleaved, ratios

SENSOR_LIMIT = 4e6 / (4 * ELEMENTS)  # frames per second
FRAMES = 2000
ROUNDS = 9
STARTS = 15

_TWO_COMMANDS = """
import typer
app = typer.Typer(help="Two commands.")

@app.command()
def one(count: int = typer.Option(1, help="How often.")) -> None:
    "Do one thing."

@app.command()
def two(name: str) -> None:
    "Do another."

app()
"""


def run() -> list[Result]:
    """Frames per second, as a multiple of what the sensor can do; start of the command line."""
    rng = np.random.default_rng(1304)
    wire = [
        encode_frame(
            Frame(
                rng.integers(3800, 3930, ELEMENTS, dtype=np.uint16),
                sequence=number,
                sh_period=200,
                icg_period=14800,
                timestamp=number * 3_700_000,
            )
        )
        for number in range(FRAMES)
    ]
    (stored,) = interleaved(ROUNDS, lambda: _decode_check_store(wire))
    with tempfile.TemporaryDirectory() as folder:
        other = Path(folder) / "two.py"
        other.write_text(_TWO_COMMANDS)
        ours = [str(Path(sys.executable).with_name("linetrack")), "--help"]
        helps, others = interleaved(
            STARTS, lambda: _start(ours), lambda: _start([sys.executable, str(other), "--help"])
        )
    return [
        Result(
            "host: decode, check, store / the sensor's limit",
            "×",
            [rate / SENSOR_LIMIT for rate in stored],
            target=20,
        ),
        Result(
            "linetrack --help / a typer program of two commands",
            "×",
            ratios(helps, others),
            "lower",
            1.3,
        ),
    ]


def _decode_check_store(wire: list[bytes]) -> float:
    """Frames per second from bytes to a file, each acknowledged after it was flushed."""
    with (
        tempfile.TemporaryDirectory() as folder,
        SessionWriter(Path(folder) / "speed.h5", Metadata(link="benchmark")) as writer,
    ):
        start = time.perf_counter()
        frames = (frame for frame in map(decode_frame, wire) if isinstance(frame, Frame))
        stored = sum(1 for _ in record(frames, writer))
        return stored / (time.perf_counter() - start)


def _start(command: list[str]) -> float:
    start = time.perf_counter()
    subprocess.run(command, check=True, capture_output=True)
    return time.perf_counter() - start
