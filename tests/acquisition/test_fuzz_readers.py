"""Readers of files: whatever the bytes, they return frames or raise the documented error."""

from __future__ import annotations

import random
import subprocess
import sys
from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from acquisition.dat import DatError, read_dat, write_dat
from acquisition.frames import ELEMENTS, Frame
from acquisition.session import SessionWriter
from acquisition.tables import TableError, csv_writer, read_csv

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

MUTATIONS = 900  # of each text format
SESSIONS = 400
FRAMES = [
    Frame(
        np.random.default_rng(number).integers(0, 4096, ELEMENTS, np.uint16),
        sequence=number,
        leds=1,
        exposures={0: 80},
        sh_period=100,
        icg_period=14800,
        timestamp=number,
    )
    for number in range(40)
]
PIECES = [
    b"",
    b"\0",
    b"\n",
    b"\r",
    b",",
    b" ",
    b"-",
    b"#",
    b"#SH-period: 1    ICG-period: 1    Integration time: 0 us\n",
    b"9" * 30,
    b"1" + b"0" * 5000,
    b"nan",
    b"1e9",
    b"\xff\xfe",
    b"\xd9\xa3",
    b"0x",
    b'"',
    b"99:99",
]


def mutated(good: bytes, choose: random.Random) -> bytes:
    """Damage bytes in one to four places."""
    data = bytearray(good)
    for _ in range(choose.randint(1, 4)):
        # half of the places in the header, where most of the meaning is
        limit = len(data) if choose.random() < 0.5 else min(len(data), 300)
        at = choose.randrange(limit + 1)
        match choose.randrange(6):
            case 0:
                data[at : at + 1] = bytes([choose.randrange(256)])
            case 1:
                data[at:at] = choose.choice(PIECES)
            case 2:
                del data[at : at + choose.choice([1, 2, 10, 1000])]
            case 3:
                data[at:] = b""
            case 4:
                length = choose.choice([1, 10, 100, 10000])
                data[at:at] = data[at : at + length]
            case _:
                start, size = choose.randrange(len(data) + 1), choose.randrange(200)
                data[at : at + size] = data[start : start + size]
    return bytes(data)


def check_dat(path: Path) -> bool:
    try:
        read_dat(path)
    except DatError as error:
        assert str(path) in str(error)  # noqa: PT017
        assert len(str(error)) < 400  # noqa: PT017
        return False
    return True


def check_csv(path: Path) -> bool:
    try:
        list(read_csv(path))
    except TableError as error:
        assert str(path) in str(error)  # noqa: PT017
        assert len(str(error)) < 400  # noqa: PT017
        return False
    return True


@pytest.mark.parametrize("check", [check_dat, check_csv])
@given(data=st.binary(max_size=3000))
def test_random_bytes(
    check: Callable[[Path], bool], data: bytes, tmp_path_factory: pytest.TempPathFactory
) -> None:
    path = tmp_path_factory.getbasetemp() / "random"
    path.write_bytes(data)
    assert not check(path)


@given(
    text=st.text(st.sampled_from("0123456789 \t\r\n#-.:SHICGtimeus"), max_size=300),
)
def test_random_text_after_a_header(text: str, tmp_path_factory: pytest.TempPathFactory) -> None:
    path = tmp_path_factory.getbasetemp() / "text.dat"
    header = "#SH-period: 200    ICG-period: 100000    Integration time: 100.0 mys\n1 2\n"
    path.write_bytes((header + text).encode())
    assert not check_dat(path)


def test_damaged_dat_files(tmp_path: Path) -> None:
    path, choose = tmp_path / "a.dat", random.Random(1)  # noqa: S311
    write_dat(path, FRAMES[0])
    good, readable = path.read_bytes(), 0
    for _ in range(MUTATIONS):
        path.write_bytes(mutated(good, choose))
        readable += check_dat(path)
    assert readable < 0.5 * MUTATIONS


def test_damaged_csv_files(tmp_path: Path) -> None:
    path, choose = tmp_path / "a.csv", random.Random(2)  # noqa: S311
    with csv_writer(path) as write:
        write(FRAMES[0])
    good = path.read_bytes()
    assert list(read_csv(path)) == FRAMES[:1]
    head, line = good.split(b"\n", 1)
    for _ in range(MUTATIONS // 3):
        path.write_bytes(head + b"\n" + mutated(line, choose))
        check_csv(path)
        path.write_bytes(mutated(good, choose))
        check_csv(path)


# HDF5 is a large library of C: what it does to the process must not happen to the tests
READER = """
import faulthandler, resource, signal, sys
from acquisition.session import SessionError, open_session
import h5py
faulthandler.enable()
resource.setrlimit(resource.RLIMIT_AS, (4 << 30, 4 << 30))
for line in sys.stdin:
    path = line.rstrip("\\n")
    signal.alarm(10)
    try:
        with open_session(path) as session:
            result = [session.state.replace(" ", "-")]
            for frame in session:
                result.append(f"{frame.sequence}:{hash(frame.elements.tobytes())}")
    except SessionError as error:
        result = ["refused" if path in str(error) and "\\n" not in str(error) else repr(error)]
    print(path, *result, flush=True)
"""


def damaged_session(good: bytes, choose: random.Random) -> bytes:
    kind = choose.randrange(10)
    if kind == 0:
        return good[: choose.randrange(len(good))]
    if kind == 1:
        return choose.randbytes(choose.randrange(20000))
    if kind == 2:
        return good[:8] + choose.randbytes(choose.randrange(20000))
    data = bytearray(good)
    # the structure lies at the beginning, and wherever there are few zeros between the tables
    limit = choose.choice([48, 2000, 20000, len(data)])
    for _ in range(choose.choice([1, 1, 2, 8])):
        at, size = choose.randrange(limit), choose.choice([1, 1, 4, 64])
        match choose.randrange(4):
            case 0:
                data[at] ^= 1 << choose.randrange(8)
            case 1:
                data[at : at + size] = choose.randbytes(len(data[at : at + size]))
            case 2:
                data[at : at + size] = bytes(len(data[at : at + size]))
            case _:
                start = choose.randrange(len(data) - size)
                data[at : at + size] = data[start : start + size][: len(data[at : at + size])]
    return bytes(data)


def test_damaged_sessions(tmp_path: Path) -> None:
    """They are refused, or give the frames that were stored, up to some point if cut off."""
    closed, choose = tmp_path / "closed.h5", random.Random(3)  # noqa: S311
    with SessionWriter(closed) as writer:
        for frame in FRAMES:
            writer.append(frame)
        cut_off = closed.read_bytes()
    good = closed.read_bytes()
    assert cut_off != good
    paths = []
    for number in range(SESSIONS):
        path = tmp_path / f"damaged{number}.h5"
        path.write_bytes(damaged_session((good, cut_off)[number % 2], choose))
        paths.append(str(path))
    (tmp_path / "cut.h5").write_bytes(cut_off)
    paths += [str(closed), str(tmp_path / "cut.h5")]
    run = subprocess.run(
        [sys.executable, "-c", READER],
        input="\n".join(paths) + "\n",
        capture_output=True,
        text=True,
        check=False,
        timeout=300,
        env={"PYTHONHASHSEED": "0", "PYTHONPATH": ":".join(sys.path)},
    )
    lines = [line.split(" ") for line in run.stdout.splitlines()]
    assert run.returncode == 0, (run.stderr, len(lines))
    assert [line[0] for line in lines] == paths
    # this process still writes the one that was copied before it was closed
    assert lines[-1][1] == "being-written"
    whole = lines[-2][2:]
    assert len(whole) == len(FRAMES)
    refused = 0
    for name, state, *frames in lines:
        if state == "refused":
            refused += 1
            continue
        assert state in ("closed", "being-written", "cut-off"), (name, state)
        assert frames == whole[: len(frames)], name
        assert state != "closed" or frames == whole, name
    assert refused > 0.3 * SESSIONS
