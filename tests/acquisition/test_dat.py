"""`.dat` files: written as the original writes them, read as they are found."""

from __future__ import annotations

import os
import stat
from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from acquisition.dat import DatError, DatWriter, numbered, read_dat, replacing, write_dat
from acquisition.frames import ELEMENTS, Frame

if TYPE_CHECKING:
    from pathlib import Path

RAMP = (np.arange(ELEMENTS) % 4096).astype(np.uint16)
ORIGINAL = Frame(RAMP, sh_period=200, icg_period=100_000, master_clock=2_000_000)
TEXT = (
    "#Data from the TCD1304 linear CCD\n"
    "#column 1 = pixelnumber , column 2 = pixelvalue\n"
    "#Pixel 1-32 and 3679-3694 and are dummy pixels\n"
    "#SH-period: 200    ICG-period: 100000    Integration time: 100.0 mys\n"
    + "".join(f"{n + 1} {value}\n" for n, value in enumerate(RAMP.tolist()))
)


def test_written_as_the_original_does(tmp_path: Path) -> None:
    path = tmp_path / "output00001.dat"
    write_dat(path, ORIGINAL)
    assert path.read_bytes() == TEXT.encode()
    assert read_dat(path) == ORIGINAL


@pytest.mark.parametrize(
    "change",
    [
        pytest.param(lambda text: text.replace("\n", "\r\n"), id="crlf"),
        pytest.param(lambda text: text.replace(" mys", " us"), id="us"),
        pytest.param(lambda text: text.replace(" mys", "µs"), id="micro"),
        pytest.param(lambda text: text.replace("100.0 mys", "100 mys"), id="whole"),
        pytest.param(lambda text: text.replace("    ", "\t"), id="tabs-in-header"),
        pytest.param(lambda text: "\n".join(f"  {x}  " if x[:1].isdigit() else x for x in text.split("\n")), id="blanks-around"),
        pytest.param(lambda text: "\n".join(x.replace(" ", " \t  ") if x[:1].isdigit() else x for x in text.split("\n")), id="blanks-between"),
        pytest.param(lambda text: text.replace("1 0\n", "\n1 0\n\n") + "\n\n", id="empty-lines"),
        pytest.param(lambda text: text.rstrip("\n"), id="no-last-line-end"),
        pytest.param(lambda text: "\ufeff" + text, id="byte-order-mark"),
        pytest.param(lambda text: "\n".join(text.split("\n")[3:]), id="settings-only"),
        pytest.param(lambda text: text + "\x1a", id="dos-end"),
        pytest.param(lambda text: text.rstrip("\n") + "\x1a\x1a", id="dos-end-of-line"),
        pytest.param(lambda text: text.replace("#", " \t#"), id="indented-comments"),
    ],
)  # fmt: skip
def test_read_as_found_in_the_wild(change: object, tmp_path: Path) -> None:
    assert callable(change)
    path = tmp_path / "wild.dat"
    path.write_bytes(change(TEXT).encode())
    assert read_dat(path) == ORIGINAL


@pytest.mark.parametrize(
    ("sh_period", "time", "clock"),
    [
        *[(200, "50.0", 4_000_000), (200, "100.0", 2_000_000), (200, "100", 2_000_000)],
        *[(101, "25", 4_000_000), (101, "25.25", 4_000_000), (101, "50", 2_000_000)],
        *[(40, "10 ", 4_000_000), (40, "20", 2_000_000), (100, "100.0", 1_000_000)],
        *[(100, "33.333333333333336", 3_000_000), (100, "125", 800_000)],
    ],
)
def test_master_clock_follows_from_the_integration_time(
    sh_period: int, time: str, clock: int, tmp_path: Path
) -> None:
    path = tmp_path / "a.dat"
    path.write_text(
        TEXT.replace("SH-period: 200", f"SH-period: {sh_period}").replace("100.0", time)
    )
    frame = read_dat(path)
    assert (frame.sh_period, frame.icg_period, frame.master_clock) == (sh_period, 100_000, clock)


@given(
    elements=arrays(np.uint16, ELEMENTS),
    sh_period=st.integers(1, 0xFFFF_FFFF),
    icg_period=st.integers(1, 0xFFFF_FFFF),
    clock=st.integers(800_000, 4_000_000),
)
def test_any_frame_comes_back(
    elements: np.ndarray[tuple[int], np.dtype[np.uint16]],
    sh_period: int,
    icg_period: int,
    clock: int,
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    path = tmp_path_factory.getbasetemp() / "any.dat"
    frame = Frame(elements, sh_period=sh_period, icg_period=icg_period, master_clock=clock)
    write_dat(path, frame)
    read = read_dat(path)
    assert read.elements.tolist() == frame.elements.tolist()
    assert (read.sh_period, read.icg_period) == (sh_period, icg_period)
    assert read.master_clock == pytest.approx(clock, rel=1e-6)  # 1e-6: printed times round


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("", "the file is empty; expected 3694 lines"),
        (" \r\n\n", "the file is empty"),
        ("\x1a", "the file is empty"),
        (TEXT.replace("\n7 6\n", "\n7 6\x1a\n"), r"line 11: found '7 6\x1a'"),
        (TEXT.replace("\n7 6\n", "\n"), "line 11: found value number 8, expected number 7"),
        (TEXT.replace("\n7 6\n", "\n7 6\n7 6\n"), "line 12: found value number 7, expected number 8"),
        (TEXT.replace("\n7 6\n", "\n7 x\n"), "line 11: found '7 x', expected '7 value' or a comment"),
        (TEXT.replace("\n7 6\n", "\n7\n"), "line 11: found '7', expected '7 value'"),
        (TEXT.replace("\n7 6\n", "\n7 6 5\n"), "line 11: found '7 6 5', expected '7 value'"),
        (TEXT.replace("\n7 6\n", "\n7 -6\n"), "line 11: found '7 -6', expected '7 value'"),
        (TEXT.replace("\n7 6\n", "\n7 65536\n"), "line 11: found the value 65536, expected 0 to 65535"),
        (TEXT.replace("\n7 6\n", "\n7 " + "9" * 5000 + "\n"), "line 11: found '7 99"),
        (TEXT.replace("\n7 6\n", "\n7 6\0\n"), r"line 11: found '7 6\x00'"),
        (TEXT.replace("\n7 6\n", "\n7 ٣\n"), "line 11: found '7 "),
        (TEXT[:-20], "the file ends after 3692 values, expected 3694; was it cut off?"),
        (TEXT + "3695 0\n", "line 3699: found '3695 0' after the last of 3694 values"),
        (TEXT + "end\n", "line 3699: found 'end', expected nothing more after 3694 values"),
        (TEXT.replace("#SH-period", "#SH"), "no line '#SH-period: N    ICG-period: N"),
        (TEXT.replace("100.0 mys", "soon"), "line 4: found '#SH-period: 200"),
        (TEXT.replace("100.0 mys", "0.0 mys"), "line 4: found SH period 200 with an integration time"),
        (TEXT.replace("100.0 mys", "10.0 mys"), "expected 50 to 250 us"),
        (TEXT.replace("SH-period: 200", "SH-period: 0"), "line 4: found SH period 0, expected 1 to"),
        (TEXT.replace("ICG-period: 1", "ICG-period: 9999999999"), "found ICG period 9999999999"),
        (TEXT + TEXT, "after the last of 3694|a second '#SH-period"),
        (TEXT.replace("#column", "#SH-period: 200    ICG-period: 100000    Integration time: 1e2 us\n#"), "line 2"),
    ],
)  # fmt: skip
def test_refused_with_place_and_reason(change: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "bad.dat"
    path.write_bytes(change.encode())
    with pytest.raises(DatError) as caught:
        read_dat(path)
    assert str(path) in str(caught.value)
    assert any(part in str(caught.value) for part in message.split("|"))
    assert len(str(caught.value)) < 400


def test_something_huge_is_not_read(tmp_path: Path) -> None:
    path = tmp_path / "huge.dat"
    with path.open("wb") as file:
        file.write(b"#")
        file.truncate(1 << 40)
    with pytest.raises(DatError, match="longer than 4 MB"):
        read_dat(path)


def test_what_cannot_be_opened_is_an_oserror(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        read_dat(tmp_path / "none.dat")
    with pytest.raises(IsADirectoryError):
        read_dat(tmp_path)
    with pytest.raises(FileNotFoundError):
        write_dat(tmp_path / "none" / "a.dat", ORIGINAL)


def test_periods_must_be_known(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="this frame's are unknown"):
        write_dat(tmp_path / "a.dat", Frame(RAMP))
    assert not list(tmp_path.iterdir())


def test_the_file_is_complete_or_not_there(tmp_path: Path) -> None:
    path = tmp_path / "a.dat"

    def fail() -> None:
        with replacing(path) as file:
            file.write(b"half")
            file.flush()
            assert not path.exists() or path.read_bytes() == b"old"
            raise KeyboardInterrupt

    for old in (None, b"old"):
        if old:
            path.write_bytes(old)
        with pytest.raises(KeyboardInterrupt):
            fail()
        assert [p.name for p in tmp_path.iterdir()] == (["a.dat"] if old else [])
    write_dat(path, ORIGINAL)
    assert read_dat(path) == ORIGINAL
    umask = os.umask(0)
    os.umask(umask)
    assert stat.S_IMODE(path.stat().st_mode) == 0o666 & ~umask  # as any other file


def test_numbered_files(tmp_path: Path) -> None:
    assert numbered("output", 1).name == "output00001.dat"
    assert numbered("output", 65535).name == "output65535.dat"
    with pytest.raises(ValueError, match="numbered from 1"):
        numbered("output", 0)
    writer = DatWriter(tmp_path / "output")
    writer.append([ORIGINAL, ORIGINAL])
    writer.append([ORIGINAL])
    assert writer.stored == 3
    assert sorted(p.name for p in tmp_path.iterdir()) == [f"output0000{n}.dat" for n in (1, 2, 3)]
