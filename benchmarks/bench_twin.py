"""Virtual seconds of the twin to each wall second, and what a long capture does to memory."""

from __future__ import annotations

import tempfile
import time
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING

from acquisition.capture import Capture
from acquisition.protocol import Command, Mode
from acquisition.session import Metadata, SessionWriter, record
from benchmarks.measure import Result, interleaved
from twin.link import TwinLink

if TYPE_CHECKING:
    from collections.abc import Callable

ROUNDS = 9
ORIGINAL = Command(100, 30000, 2)
FULL_RATE = Command(200, 14800, 0, mode=Mode.STREAM, sequence=[{0: 200}, {1: 200}])
LONG = Command(100, 30000, 0, mode=Mode.STREAM, sequence=[{0: 100}, {1: 100}])
LONG_SECONDS = 600.0
SETTLED = 5000  # frames after which memory is looked at for the first time


def run() -> list[Result]:
    """Take both modes in turns, each on a twin that lives as long as a session."""
    with TwinLink() as original, TwinLink() as stream:
        frames = Capture(stream, FULL_RATE)
        next(frames)
        originals, streams = interleaved(
            ROUNDS,
            lambda: _ratio(original, lambda: list(Capture(original, ORIGINAL))),
            lambda: _ratio(stream, lambda: list(islice(frames, 100))),
        )
    return [
        Result("twin, original mode with flush", "virtual s/s", originals, target=2),
        Result("twin, streaming at the sensor's limit", "virtual s/s", streams, target=1),
        Result(
            "memory gained in 10 virtual minutes of capture",
            "MB",
            [_memory_gained()],
            "lower",
            5,
        ),
    ]


def _ratio(link: TwinLink, call: Callable[[], object]) -> float:
    virtual, wall = link.machine.seconds, time.perf_counter()
    call()
    return (link.machine.seconds - virtual) / (time.perf_counter() - wall)


def _memory_gained() -> float:
    with tempfile.TemporaryDirectory() as folder, TwinLink() as link:
        writer = SessionWriter(Path(folder) / "long.h5", Metadata(link="twin"))
        settled = 0.0
        with writer, Capture(link, LONG) as frames:
            for number, _ in enumerate(record(frames, writer)):
                if number == SETTLED:
                    settled = _resident()
                if link.machine.seconds >= LONG_SECONDS:
                    break
            return _resident() - settled


def _resident() -> float:
    """Memory of this process, MB."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("VmRSS:"):
            return int(line.split()[1]) / 1024
    raise RuntimeError("/proc/self/status lacks VmRSS: only Linux tells a process's memory")
