"""Sessions: what goes in comes out, also while it is written, and damage is found."""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
import sys
import threading
import time
from importlib import import_module
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from acquisition.frames import ELEMENTS, MASTER_CLOCK, Frame, FrameFlags, stack
from acquisition.session import (
    Metadata,
    SessionError,
    SessionWriter,
    checksums,
    open_session,
    record,
)

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

h5py: Any = import_module("h5py")
RANDOM = np.random.default_rng(7)


def frame(number: int) -> Frame:
    return Frame(
        np.random.default_rng(number).integers(0, 4096, ELEMENTS, np.uint16),
        sequence=number,
        leds=1 << number % 64,
        exposures={number % 64: 80},
        sh_period=100,
        icg_period=14800,
        timestamp=number * 3_700_000,
        utc_ns=1_700_000_000_000_000_000 + number,
        monotonic_ns=number,
        flags=FrameFlags.DROPPED if number % 5 == 0 else FrameFlags.NONE,
    )


FRAMES = [frame(number) for number in range(150)]


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "run.h5"


def test_all_comes_back(path: Path) -> None:
    metadata = Metadata(
        link="twin",
        firmware_build="build 1",
        command={"mode": "stream", "sequence": [{"0": 80}]},
        lens_system={"name": "head", "gaps": [1.5, 2]},
        extra={"seed": 3},
        master_clock=2_000_000,
    )
    with SessionWriter(path, metadata) as writer:
        writer.append(FRAMES[0])
        writer.append(FRAMES[1:40])
        writer.append([])
        writer.append(FRAMES[40:])
        assert len(writer) == len(FRAMES)
    with open_session(path) as session:
        assert session.state == "closed"
        assert session.metadata == metadata
        assert len(session) == len(FRAMES)
        assert list(session) == FRAMES
        assert (session[0], session[-1]) == (FRAMES[0], FRAMES[-1])
        assert list(session.frames(10, 12)) == FRAMES[10:12]
        for name, values in stack(FRAMES[3:90]).items():
            np.testing.assert_array_equal(session.arrays(3, 90)[name], values)
            assert session.arrays(3, 90)[name].dtype == values.dtype
        assert session.table(5, 2).size == 0
        with pytest.raises(IndexError, match="frame 150 of 150"):
            session[150]


def test_a_long_description_fits(path: Path) -> None:
    metadata = Metadata(lens_system={"surface": list(range(50_000))}, wiring="", link="µ")
    SessionWriter(path, metadata).close()
    with open_session(path) as session:
        assert session.metadata == metadata


def test_metadata_tell_of_themselves() -> None:
    metadata = Metadata()
    assert "[pins]" in metadata.wiring
    assert metadata.master_clock == MASTER_CLOCK
    assert metadata.linetrack_version
    assert abs(metadata.created_utc_ns - time.time_ns()) < 60e9


@given(
    st.builds(
        Frame,
        st.just(FRAMES[0].elements),
        sequence=st.integers(0, 2**64 - 1),
        leds=st.integers(0, 2**64 - 1),
        exposures=st.dictionaries(st.integers(0, 63), st.integers(1, 2**32 - 1)),
        sh_period=st.integers(0, 2**32 - 1),
        icg_period=st.integers(0, 2**32 - 1),
        master_clock=st.integers(1, 2**32 - 1),
        timestamp=st.none() | st.integers(0, 2**63 - 1),
        utc_ns=st.integers(0, 2**63 - 1),
        monotonic_ns=st.integers(0, 2**63 - 1),
        flags=st.integers(0, 2**10 - 1).map(FrameFlags),
    )
)
def test_any_frame_comes_back(tmp_path_factory: pytest.TempPathFactory, some: Frame) -> None:
    path = tmp_path_factory.getbasetemp() / "any.h5"
    with SessionWriter(path, overwrite=True) as writer:
        writer.append(some)
    with open_session(path) as session:
        assert session[0] == some


def test_an_existing_file_is_kept_unless_asked(path: Path) -> None:
    path.write_text("precious")
    with pytest.raises(SessionError, match="exists"):
        SessionWriter(path)
    assert path.read_text() == "precious"
    with SessionWriter(path, overwrite=True) as writer:
        writer.append(FRAMES[0])
    assert [p.name for p in path.parent.iterdir()] == ["run.h5"]
    with open_session(path) as session:
        assert session[0] == FRAMES[0]


def test_no_folder_no_session(tmp_path: Path) -> None:
    with pytest.raises(SessionError, match=r"none.x\.h5: cannot be written"):
        SessionWriter(tmp_path / "none" / "x.h5")


def test_h5py_is_asked_for(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(SessionError, match=r"pip install 'linetrack\[capture\]'"):
        SessionWriter(path)


def test_what_does_not_fit_is_refused_and_nothing_stored(path: Path) -> None:
    with SessionWriter(path) as writer:
        writer.append(FRAMES[:3])
        with pytest.raises(SessionError, match="cannot be written"):
            writer.append([FRAMES[3], dataclasses.replace(FRAMES[4], sequence=2**64)])
        writer.append(FRAMES[3:6])
    with open_session(path) as session:
        assert list(session) == FRAMES[:6]


READER = """
import sys
from acquisition.session import open_session
session = open_session(sys.argv[1])
for line in sys.stdin:
    print(session.refresh(), session.state, session[-1].sequence if len(session) else None, flush=True)
"""


def test_read_while_it_is_written(path: Path) -> None:
    """Another process follows, and h5py alone can look, too."""
    with SessionWriter(path) as writer:
        command = [sys.executable, "-c", READER, str(path)]
        with subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        ) as reader:
            assert reader.stdin is not None

            def ask() -> str:
                print(file=reader.stdin, flush=True)
                assert reader.stdout is not None
                return reader.stdout.readline().strip()

            assert ask() == "0 being written None"
            for count in (1, 2, 20, 100):
                writer.append(FRAMES[len(writer) : count])
                assert ask() == f"{count} being written {count - 1}"
            writer.close()
            assert ask() == "100 closed 99"
            reader.stdin.close()
    with h5py.File(path, "r", swmr=True) as file:
        assert file["elements"].shape == (100, ELEMENTS)
        assert json.loads(file.attrs["units"])["timestamp"].startswith("ns")


def test_damage_is_found(path: Path) -> None:
    with SessionWriter(path) as writer:
        writer.append(FRAMES)
    good = path.read_bytes()
    at = good.index(FRAMES[70].elements[100:200].tobytes())
    path.write_bytes(good[:at] + bytes([good[at] ^ 4]) + good[at + 1 :])
    with open_session(path) as session:
        assert list(session.frames(0, 64)) == FRAMES[:64]
        with pytest.raises(SessionError, match="frame 70 is damaged"):
            session[70]
        with pytest.raises(SessionError, match="frame 70 is damaged"):
            list(session)
    at = good.index(np.array([FRAMES[70].utc_ns], "<i8").tobytes())
    path.write_bytes(good[:at] + bytes([good[at] ^ 4]) + good[at + 1 :])
    with open_session(path) as session, pytest.raises(SessionError, match="frame 70 is damaged"):
        session.table()


def test_what_is_no_session_is_refused(path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        open_session(path)
    for content in (b"", b"#Data", b"\x89HDF\r\n\x1a\n", b"\x89HDF\r\n\x1a\n" + bytes(5000)):
        path.write_bytes(content)
        with pytest.raises(SessionError, match=r"run\.h5: no "):
            open_session(path)
    path.unlink()
    with h5py.File(path, "w", libver="latest") as file:
        file["x"] = 1
    with pytest.raises(SessionError, match="an HDF5 file, but no session of linetrack"):
        open_session(path)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("schema_version", 2, "version 2, expected 1; is there a newer linetrack"),
        ("schema_version", np.bytes_(b"x"), "version x, expected 1"),
        ("command", np.bytes_(b"[1]"), "attribute command is no JSON object"),
        ("command", np.bytes_(b"{"), "no session of linetrack, or damaged"),
        ("wiring", 5, "attribute wiring is of type int"),
        ("wiring", "text", "neither text of a fixed length nor a number"),
        ("wiring", np.bytes_(b"\xff"), "no session of linetrack, or damaged"),
        ("writer", np.bytes_(b"{"), "no session of linetrack, or damaged"),
        ("master_clock", None, "no session of linetrack, or damaged"),
    ],
)
def test_strange_attributes_are_refused(name: str, value: object, message: str, path: Path) -> None:
    with SessionWriter(path) as writer:
        writer.append(FRAMES[0])
    with h5py.File(path, "r+") as file:
        del file.attrs[name]
        if value is not None:
            file.attrs[name] = value
    with pytest.raises(SessionError, match=message):
        open_session(path)


def test_strange_tables_are_refused(path: Path, tmp_path: Path) -> None:
    def spoil_by(change: str) -> None:
        with SessionWriter(path, overwrite=True) as writer:
            writer.append(FRAMES[:4])
        with h5py.File(path, "r+") as file:
            if change == "external link":
                del file["elements"]
                file["elements"] = h5py.ExternalLink(str(tmp_path / "other.h5"), "/elements")
            elif change == "group":
                del file["frames"]
                file.create_group("frames")
            elif change == "dtype":
                del file["elements"]
                file["elements"] = np.zeros((4, ELEMENTS))
            elif change == "filter":
                del file["elements"]
                file.create_dataset(
                    "elements", data=np.zeros((4, ELEMENTS), "<u2"), compression="gzip"
                )
            elif change == "endless":
                for name in ("elements", "frames"):
                    file[name].resize(1 << 40, axis=0)
        open_session(path).close()

    for change in ("external link", "group", "dtype", "filter", "endless"):
        with pytest.raises(SessionError, match=r"not what a session has|longer than the file"):
            spoil_by(change)


def test_after_a_failed_write_the_shorter_table_counts(path: Path) -> None:
    for longer in ("elements", "frames"):
        with SessionWriter(path, overwrite=True) as writer:
            writer.append(FRAMES[:4])
        with h5py.File(path, "r+") as file:
            file[longer].resize(7, axis=0)
        with open_session(path) as session:
            assert session.state == "cut off"
            assert list(session) == FRAMES[:4]


FULL = """
import resource, signal, sys
from acquisition import cli
from acquisition.dat import read_dat
from acquisition.session import SessionWriter
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
limit = int(sys.argv.pop(1))
resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
cli.main(sys.argv[1:])
"""


@pytest.mark.parametrize("limit", [0, 4000, 9000, 1 << 18, 700_000, 1 << 20])
def test_a_full_disk_costs_no_frame_that_was_acknowledged(limit: int, tmp_path: Path) -> None:
    source, target = tmp_path / "source.h5", tmp_path / "full.h5"
    with SessionWriter(source) as writer:
        writer.append(FRAMES)
    command = f"capture --link replay {source} --stream -n 150 -o {target}"
    run = subprocess.run(
        [sys.executable, "-c", FULL, str(limit), *command.split()],
        capture_output=True,
        text=True,
        check=False,
        timeout=60,
    )
    assert run.returncode == 1, run
    assert f"{target}: cannot be written (" in run.stderr
    assert "File too large" in run.stderr or limit < 1 << 16
    assert [p.name for p in tmp_path.iterdir() if p.suffix == ".part"] == []
    stored = 0
    if target.exists():
        with open_session(target) as session:
            assert session.state == "closed"
            stored = len(session)
            for some, sent in zip(session, FRAMES, strict=False):
                assert np.array_equal(some.elements, sent.elements)
        assert f"full.h5: {stored} of 150 read-outs" in run.stderr or not stored
    assert stored > 0 or limit < 1 << 20


def test_a_finished_session_is_no_longer_than_it_must_be(path: Path) -> None:
    with SessionWriter(path) as writer:
        writer.append(FRAMES[0])
    size = path.stat().st_size
    with h5py.File(path, "r") as file:
        assert size == file.id.get_filesize()
    assert size < 400_000


def test_a_writer_that_is_a_zombie_writes_no_more(path: Path) -> None:
    """It has ended, but its parent has not asked how."""
    code = (
        "import os, sys; from acquisition.session import SessionWriter; "
        "writer = SessionWriter(sys.argv[1]); os._exit(0)"
    )
    with subprocess.Popen([sys.executable, "-c", code, str(path)]) as process:
        os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT)
        with open_session(path) as session:
            assert session.state == "cut off"


def test_checksums_cover_every_field() -> None:
    from acquisition.session import ROW

    rows = np.zeros(1, ROW)
    elements = np.zeros((1, ELEMENTS), "<u2")
    before = checksums(rows, elements)
    for name in ROW.names or ():
        if name != "row_crc32":
            changed = rows.copy()
            changed[name] = 1
            assert checksums(changed)[1] != checksums(rows)[1], name
    elements[0, 17] = 1
    assert checksums(rows, elements) != before


class Slow:
    """A writer that takes its time, and notes the batches."""

    def __init__(self, seconds: float = 0.0, fails_at: int | None = None) -> None:
        self.batches: list[list[int]] = []
        self.seconds = seconds
        self.fails_at = fails_at

    @property
    def numbers(self) -> list[int]:
        return [number for batch in self.batches for number in batch]

    def append(self, frames: Sequence[Frame]) -> None:
        time.sleep(self.seconds)
        if self.fails_at is not None and len(self.batches) >= self.fails_at:
            raise SessionError("the disk is full")
        if frames:
            self.batches.append([frame.sequence for frame in frames])


def test_recorded_before_it_is_handed_on() -> None:
    writer = Slow()
    for number, some in enumerate(record(iter(FRAMES), writer)):
        assert some is FRAMES[number]
        assert some.sequence in writer.numbers
    assert writer.numbers == list(range(len(FRAMES)))


def test_frames_that_come_faster_are_stored_at_one_go() -> None:
    writer = Slow(seconds=0.02)
    assert list(record(iter(FRAMES), writer, batch=32)) == FRAMES
    assert writer.numbers == list(range(len(FRAMES)))
    assert len(writer.batches) < 12
    assert max(map(len, writer.batches)) == 32


def test_what_came_before_an_error_is_stored() -> None:
    def failing() -> Iterator[Frame]:
        yield from FRAMES[:10]
        raise TimeoutError("silent")

    writer = Slow()
    recording = record(failing(), writer)
    assert [next(recording).sequence for _ in range(10)] == list(range(10))
    with pytest.raises(TimeoutError, match="silent"):
        next(recording)
    assert writer.numbers == list(range(10))


def test_ending_early_closes_the_source_and_loses_nothing_that_had_come() -> None:
    closed = threading.Event()
    given_out = []

    def source() -> Iterator[Frame]:
        try:
            for some in FRAMES:
                given_out.append(some.sequence)
                yield some
                time.sleep(0.001)
        finally:
            closed.set()

    writer = Slow(seconds=0.01)
    recording = record(source(), writer)
    for some in recording:
        if some.sequence == 5:
            break
    recording.close()
    assert closed.is_set()
    assert writer.numbers == given_out
    assert len(given_out) < len(FRAMES)


def test_a_full_disk_ends_it() -> None:
    writer = Slow(fails_at=1, seconds=0.001)
    seen = []

    def run() -> None:
        for some in record(iter(FRAMES), writer, batch=8):
            seen.append(some.sequence)  # noqa: PERF401  (an error ends it)

    with pytest.raises(SessionError, match="disk is full"):
        run()
    assert seen == writer.numbers
