"""The firmware's reading of commands, compiled for this machine, against acquisition.protocol."""

from __future__ import annotations

import ctypes
import itertools
import struct
import subprocess
import sys
from functools import cache
from typing import TYPE_CHECKING, Any

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from acquisition.protocol import Command, CommandError, Mode, Refusal, crc32_words
from acquisition.wiring import PROTOCOL, WIRING, sh_edge
from tests.firmware.builds import FIRMWARE

if TYPE_CHECKING:
    from pathlib import Path

TABLE_MAX = PROTOCOL.stream.table_max
SIZE = 16 + TABLE_MAX * PROTOCOL.stream.entry_size + 4
CHAIN = WIRING.leds.chain_first
NO_STEP = 0xFF


class Step(ctypes.Structure):
    _fields_ = (
        ("leds", ctypes.c_uint64),
        ("tick", ctypes.c_uint32),
        ("latch", ctypes.c_uint8),
        ("next_latch", ctypes.c_uint8),
        ("reserved", ctypes.c_uint8 * 2),
    )


class Plan(ctypes.Structure):
    _fields_ = (
        ("sh_period", ctypes.c_uint32),
        ("icg_period", ctypes.c_uint32),
        ("count", ctypes.c_uint32),
        ("mode", ctypes.c_uint8),
        ("frames", ctypes.c_uint8),
        ("first_step", ctypes.c_uint8 * (TABLE_MAX + 1)),
        ("steps", Step * TABLE_MAX),
    )


@cache
def _compiled(folder: Path) -> Any:
    target = folder / "command.so"
    subprocess.run(
        (sys.executable, "-m", "ziglang", "cc", "-std=c11", "-O1", "-shared", "-fPIC", "-Wall",
         "-Werror", "-fsanitize=undefined", "-fsanitize-trap=undefined",
         str(FIRMWARE / "command.c"), "-o", str(target)),
        check=True,
    )  # fmt: skip
    library = ctypes.CDLL(str(target))
    library.crc_words.restype = library.command_read.restype = ctypes.c_uint32
    library.command_present.restype = library.periods_valid.restype = ctypes.c_bool
    return library


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> Any:
    return _compiled(tmp_path_factory.mktemp("command"))


def read(library: Any, data: bytes) -> tuple[Refusal, Plan]:
    plan = Plan()
    result = library.command_read(data.ljust(SIZE, b"\0")[:SIZE], ctypes.byref(plan))
    return Refusal(result), plan


def frames(plan: Plan) -> list[list[Step]]:
    starts = list(plan.first_step[: plan.frames + 1])
    return [plan.steps[a:b] for a, b in itertools.pairwise(starts)]


def expected_tick(command: Command, exposure: int) -> int:
    return command.icg_period + sh_edge(PROTOCOL) - exposure


sh_periods = st.one_of(
    st.integers(PROTOCOL.sh_min, 400),
    st.integers(PROTOCOL.sh_min, 0xFFFFFFFF),
    st.just(PROTOCOL.icg_min),
)


@st.composite
def periods(draw: st.DrawFn) -> tuple[int, int]:
    sh = draw(sh_periods)
    lowest = -(-PROTOCOL.icg_min // sh)
    icg = sh * draw(st.integers(lowest, max(lowest, min(lowest + 5, 0xFFFFFFFF // sh))))
    assume(icg <= 0xFFFFFFFF)
    return sh, icg


@st.composite
def commands(draw: st.DrawFn) -> Command:
    sh, icg = draw(periods())
    longest = min(sh, 0x7FFFFFFF)
    frame = st.dictionaries(st.integers(0, 63), st.integers(0, longest), max_size=5)
    sequence = draw(st.lists(frame, min_size=1, max_size=12))
    try:
        return Command(sh, icg, draw(st.integers(0, 0xFFFF)), Mode.STREAM, sequence)
    except CommandError:
        assume(False)
        raise


def test_checksum(library: Any) -> None:
    assert library.crc_words((0x12345678).to_bytes(4, "little"), 1) == 0xDF8A8A2B


@given(st.binary(max_size=200))
def test_checksum_of_anything(library: Any, data: bytes) -> None:
    data += bytes(-len(data) % 4)
    assert library.crc_words(data, len(data) // 4) == crc32_words(data)


@given(periods(), st.integers(1, 0xFFFF))
def test_original(library: Any, both: tuple[int, int], count: int) -> None:
    refusal, plan = read(library, Command(*both, count).encode())
    assert refusal is Refusal.NONE
    assert (plan.sh_period, plan.icg_period, plan.count, plan.mode) == (*both, count, 0)


@given(st.integers(0, 0xFFFFFFFF), st.integers(0, 0xFFFFFFFF))
def test_periods(library: Any, sh: int, icg: int) -> None:
    try:
        Command(sh, icg, 1)
    except CommandError:
        valid = False
    else:
        valid = True
    assert library.periods_valid(ctypes.c_uint32(sh), ctypes.c_uint32(icg)) is valid


@given(commands())
def test_plan(library: Any, command: Command) -> None:
    refusal, plan = read(library, command.encode())
    assert refusal is Refusal.NONE
    assert (plan.sh_period, plan.icg_period) == (command.sh_period, command.icg_period)
    assert (plan.count, plan.mode) == (command.count, Mode.STREAM)
    found = frames(plan)
    assert len(found) == len(command.sequence)
    for steps, lit in zip(found, command.sequence, strict=True):
        by_tick: dict[int, int] = {}
        mask = 0
        for exposure in sorted(set(lit.values()), reverse=True):
            mask |= sum(1 << channel for channel, e in lit.items() if e == exposure)
            by_tick[expected_tick(command, exposure)] = mask
        assert {step.tick: step.leds for step in steps} == by_tick
        ticks = [step.tick for step in steps]
        assert ticks == sorted(ticks)
        assert all(0 < tick < command.icg_period for tick in ticks)
        before = 0
        for step in steps:
            assert step.latch == (step.leds >> CHAIN != before >> CHAIN)
            before = step.leds


@given(commands())
def test_next_pattern_of_the_chain(library: Any, command: Command) -> None:
    _, plan = read(library, command.encode())
    steps = [step for frame in frames(plan) for step in frame]
    latches = [n for n, step in enumerate(steps) if step.latch]
    for n, step in enumerate(steps):
        following = [k for k in latches if k > n] or latches
        assert step.next_latch == (following[0] if following else NO_STEP)


@given(commands(), st.data())
def test_changed_bytes(library: Any, command: Command, data: st.DataObject) -> None:
    raw = bytearray(command.encode()[:SIZE])
    bit = data.draw(st.integers(0, 8 * (16 + 12 * raw[14] + 4) - 1))
    assume(bit // 8 not in {10})
    raw[bit // 8] ^= 1 << bit % 8
    refusal, _ = read(library, bytes(raw))
    assert refusal in {Refusal.CHECKSUM, Refusal.VERSION, Refusal.TABLE} or bit < 16


def entry(mask: int, exposure: int) -> bytes:
    return struct.pack("<QI", mask, exposure)


def raw_command(
    table: bytes,
    *,
    mode: int = 1,
    version: int = 1,
    entries: int | None = None,
    sh: int = 100,
    icg: int = 20000,
) -> bytes:
    number = len(table) // 12 if entries is None else entries
    data = b"ER" + struct.pack(">IIBHBBB", sh, icg, mode, 3, version, number, 0) + table
    return data + crc32_words(data).to_bytes(4, "little")


@pytest.mark.parametrize(
    ("data", "refusal"),
    [
        (raw_command(entry(1, 100)), Refusal.NONE),
        (raw_command(entry(1, 101)), Refusal.TABLE),
        (raw_command(entry(0, 101)), Refusal.NONE),
        (raw_command(entry(1, 0)), Refusal.NONE),
        (raw_command(entry(1, 100), version=2), Refusal.VERSION),
        (raw_command(entry(1, 100), mode=2), Refusal.MODE),
        (raw_command(entry(1, 100), mode=255), Refusal.MODE),
        (raw_command(entry(1, 100), sh=39), Refusal.PERIODS),
        (raw_command(entry(1, 100), icg=14700), Refusal.PERIODS),
        (raw_command(entry(1, 100), sh=0), Refusal.PERIODS),
        (raw_command(entry(1, 100), icg=0), Refusal.PERIODS),
        (raw_command(entry(1, 100), entries=0), Refusal.TABLE),
        (raw_command(entry(1, 10)), Refusal.NONE),
        (raw_command(entry(1, 9)), Refusal.TABLE),
        (raw_command(entry(1, 10) * 65), Refusal.TABLE),
        (raw_command(entry(1, 10) * 64), Refusal.NONE),
        (raw_command(entry(1, 100 | 1 << 31)), Refusal.TABLE),
        (raw_command(entry(1, 50 | 1 << 31) + entry(2, 50)), Refusal.TABLE),
        (raw_command(entry(1, 50 | 1 << 31) + entry(2, 49)), Refusal.NONE),
        (raw_command(entry(64, 50 | 1 << 31) + entry(128, 11)), Refusal.TABLE),
        (raw_command(entry(64, 50 | 1 << 31) + entry(128, 10)), Refusal.NONE),
        (raw_command(entry(64, 50 | 1 << 31) + entry(1, 11)), Refusal.NONE),
        (raw_command(entry(1, 100))[:-1] + b"\0", Refusal.CHECKSUM),
    ],
)
def test_refusals(library: Any, data: bytes, refusal: Refusal) -> None:
    assert read(library, data)[0] is refusal
    if refusal is Refusal.NONE:
        Command.decode(data.ljust(SIZE, b"\0"))
        return
    with pytest.raises(CommandError) as caught:
        Command.decode(data.ljust(SIZE, b"\0"))
    assert caught.value.refusal is refusal


@given(st.binary(min_size=SIZE, max_size=SIZE), st.booleans())
def test_anything(library: Any, data: bytes, sealed: bool) -> None:
    """Whatever comes: an answer, and a plan within its bounds."""
    raw = bytearray(data)
    raw[:2], raw[10], raw[13] = b"ER", 1, 1
    raw[14] = 1 + raw[14] % TABLE_MAX
    end = 16 + 12 * raw[14]
    if sealed:
        raw[end : end + 4] = crc32_words(bytes(raw[:end])).to_bytes(4, "little")
    refusal, plan = read(library, bytes(raw))
    assert plan.frames <= TABLE_MAX
    if refusal is Refusal.NONE:
        assert all(0 < s.tick < plan.icg_period for steps in frames(plan) for s in steps)


def test_presence(library: Any) -> None:
    assert library.command_present(b"ER")
    assert not library.command_present(b"\0R")
    assert not library.command_present(b"E\0")
