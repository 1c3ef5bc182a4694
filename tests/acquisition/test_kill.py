"""`kill -9` at any moment of a capture: every frame that was acknowledged is in the file."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import time
from importlib import import_module
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from acquisition import cli
from acquisition.frames import ELEMENTS
from acquisition.session import open_session

if TYPE_CHECKING:
    from pathlib import Path

h5py: Any = import_module("h5py")
CASES = 100
LATEST = 0.25  # s after the start of the capture

# A process that has everything imported forks one process for each capture: a whole Python would
# take longer to start than the capture lasts. The frame's contents follow from its number.
WRITER = """
import os, random, sys, time
import numpy as np
from acquisition.capture import Capture
from acquisition.frames import ELEMENTS, Frame
from acquisition.links import ReplayLink
from acquisition.protocol import Command, Mode
from acquisition.session import Metadata, SessionWriter, record
import h5py

def frames(seed):
    pause = random.Random(seed)
    number = 0
    while True:
        elements = (np.arange(ELEMENTS) * (number + 1) % 4096).astype(np.uint16)
        yield Frame(elements, sequence=number, leds=1 << number % 2, sh_period=100,
                    icg_period=14800, timestamp=number * 3_700_000)
        number += 1
        if pause.random() < 0.1:
            time.sleep(pause.choice([0, 0.001, 0.01]))

def capture(path, seed):
    capture = Capture(ReplayLink(frames(seed)), Command(100, 14800, 0, Mode.STREAM))
    with SessionWriter(path, Metadata(link="replay")) as writer:
        for frame in record(capture, writer):
            os.write(1, b"%d\\n" % frame.sequence)

for line in sys.stdin:
    seed, path = line.rstrip("\\n").split(" ", 1)
    pid = os.fork()
    if pid == 0:
        os.write(1, b"pid %d\\n" % os.getpid())
        capture(path, int(seed))
    status = os.waitpid(pid, 0)[1]
    os.write(1, b"ended %d\\n" % status)
"""


def test_every_acknowledged_frame_survives(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    moments = random.Random(20240)  # noqa: S311
    opened, acknowledged_in_all = [], 0
    with subprocess.Popen(
        [sys.executable, "-c", WRITER], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as server:
        assert server.stdin is not None
        assert server.stdout is not None
        for case in range(CASES):
            path = tmp_path / f"killed{case}.h5"
            print(case, path, file=server.stdin, flush=True)
            pid = int(server.stdout.readline().removeprefix("pid "))
            time.sleep(moments.uniform(0, LATEST))
            os.kill(pid, signal.SIGKILL)
            acknowledged = []
            while not (line := server.stdout.readline()).startswith("ended"):
                if line.endswith("\n"):
                    acknowledged.append(int(line))
            assert line == f"ended {int(signal.SIGKILL)}\n"
            assert acknowledged == list(range(len(acknowledged)))
            acknowledged_in_all += len(acknowledged)
            if path.exists():
                opened.append(path)
                check(path, len(acknowledged))
            else:
                assert not acknowledged
        server.stdin.close()
    assert len(opened) > 0.5 * CASES
    assert acknowledged_in_all > 3 * CASES
    with pytest.raises(SystemExit) as ended:
        cli.main(["info", *map(str, opened)])
    assert ended.value.code == 0
    assert capsys.readouterr().out.count("cut off") == len(opened)


def check(path: Path, acknowledged: int) -> None:
    with open_session(path) as session:
        assert session.state == "cut off"
        assert len(session) >= acknowledged
        for number, frame in enumerate(session):
            assert frame.sequence == number
            assert frame.timestamp == number * 3_700_000
            assert frame.leds == 1 << number % 2
            expected = np.arange(ELEMENTS) * (number + 1) % 4096
            assert np.array_equal(frame.elements, expected)
    with h5py.File(path, "r", swmr=True) as file:
        assert len(file["elements"]) >= acknowledged
        assert len(file["frames"]) >= acknowledged
