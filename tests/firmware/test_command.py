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
from tests.acquisition.test_protocol import some_windows
from tests.firmware.builds import FIRMWARE

if TYPE_CHECKING:
    from pathlib import Path

TABLE_MAX = PROTOCOL.stream.table_max
SIZE = PROTOCOL.spikes.table_at + TABLE_MAX * PROTOCOL.spikes.entry_size + 4
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


class Window(ctypes.Structure):
    _fields_ = (("first", ctypes.c_uint16), ("last", ctypes.c_uint16))


class Plan(ctypes.Structure):
    _fields_ = (
        ("sh_period", ctypes.c_uint32),
        ("icg_period", ctypes.c_uint32),
        ("count", ctypes.c_uint32),
        ("mode", ctypes.c_uint8),
        ("frames", ctypes.c_uint8),
        ("first_step", ctypes.c_uint8 * (TABLE_MAX + 1)),
        ("steps", Step * TABLE_MAX),
        ("windows", Window * TABLE_MAX),
        ("first_window", ctypes.c_uint8 * (TABLE_MAX + 1)),
        ("saturated", ctypes.c_uint16),
        ("threshold", ctypes.c_uint16),
        ("await_sync", ctypes.c_bool),
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
    library.command_brief.restype = ctypes.c_bool
    return library


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> Any:
    return _compiled(tmp_path_factory.mktemp("command"))


def read(library: Any, data: bytes) -> tuple[Refusal, Plan]:
    plan = Plan()
    result = library.command_read(data.ljust(SIZE, b"\0")[:SIZE], ctypes.byref(plan))
    return Refusal(result), plan


def windows(plan: Plan) -> list[list[tuple[int, int]]]:
    starts = list(plan.first_window[: plan.frames + 1])
    return [[(w.first, w.last) for w in plan.windows[a:b]] for a, b in itertools.pairwise(starts)]


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
    mode = draw(st.sampled_from((Mode.STREAM, Mode.SPIKES)))
    count, sync = draw(st.integers(0, 0xFFFF)), draw(st.booleans())
    options: dict[str, Any] = {}
    if mode is Mode.SPIKES:
        code = st.integers(0, 4095)
        options["windows"] = [draw(some_windows()) for _ in sequence]
        options.update(saturated=draw(code), threshold=draw(code))
    try:
        return Command(sh, icg, count, mode, sequence, await_sync=sync, **options)
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
    assert (plan.count, plan.mode) == (command.count, command.mode)
    assert plan.await_sync == command.await_sync
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
    if command.mode is Mode.SPIKES:
        assert windows(plan) == [list(of_frame) for of_frame in command.windows]
        assert (plan.saturated, plan.threshold) == (command.saturated, command.threshold)


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
    spikes = command.mode is Mode.SPIKES
    length = (20 + 16 * raw[14] if spikes else 16 + 12 * raw[14]) + 4
    bit = data.draw(st.integers(0, 8 * length - 1))
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
    options: int = 0,
) -> bytes:
    number = len(table) // 12 if entries is None else entries
    data = b"ER" + struct.pack(">IIBHBBB", sh, icg, mode, 3, version, number, options) + table
    return data + crc32_words(data).to_bytes(4, "little")


def windowed(*entries: tuple[int, int, int, int], limits: tuple[int, int] = (0, 0)) -> bytes:
    table = b"".join(struct.pack("<QIHH", *values) for values in entries)
    return raw_command(struct.pack("<HH", *limits) + table, mode=2, version=2, entries=len(entries))


MORE = 1 << 31
NONE = (0xFFFF, 0xFFFF)


@pytest.mark.parametrize(
    ("data", "refusal"),
    [
        (raw_command(entry(1, 100), options=1), Refusal.VERSION),
        (raw_command(entry(1, 100), version=2, options=1), Refusal.NONE),
        (raw_command(entry(1, 100), version=2, options=4), Refusal.VERSION),
        (raw_command(entry(1, 100), version=2, options=2), Refusal.VERSION),
        (raw_command(entry(1, 100), version=3), Refusal.VERSION),
        (windowed((1, 100, 0, 3647)), Refusal.NONE),
        (windowed((1, 100, 0, 23)), Refusal.NONE),
        (windowed((1, 100, 3624, 3647)), Refusal.NONE),
        (windowed((1, 100, 0, 22)), Refusal.TABLE),
        (windowed((1, 100, 20, 5)), Refusal.TABLE),
        (windowed((1, 100, 0, 3648)), Refusal.TABLE),
        (windowed((1, 100, 0xFFFF, 3647)), Refusal.TABLE),
        (windowed((1, 100, *NONE)), Refusal.TABLE),
        (windowed((1, 100 | MORE, *NONE), (2, 50, 0, 99)), Refusal.NONE),
        (windowed((1, 100 | MORE, 90, 120), (0, MORE, 0, 89), (0, 0, 121, 3647)), Refusal.NONE),
        (windowed((1, 100 | MORE, 90, 120), (0, MORE, 0, 90), (0, 0, 121, 3647)), Refusal.TABLE),
        (windowed((1, 100 | MORE, 90, 120), (0, 0, 120, 160)), Refusal.TABLE),
        (windowed((1, 100 | MORE, 90, 120), (0, 0, 0, 3647)), Refusal.TABLE),
        (windowed((1, 100 | MORE, 0, 3647), (0, 0, 90, 120)), Refusal.TABLE),
        (windowed((1, 100, 90, 120), (1, 100, 100, 130)), Refusal.NONE),
        (windowed((1, 100 | MORE, 7, 99), (0, MORE, 200, 299), (1, 50, 350, 399)), Refusal.TABLE),
        (
            windowed(*[(0, MORE, n, n + 23) for n in range(24, 192, 24)], (0, 0, 0, 23)),
            Refusal.NONE,
        ),
        (
            windowed(*[(0, MORE, n, n + 23) for n in range(24, 216, 24)], (0, 0, 0, 23)),
            Refusal.TABLE,
        ),
        (windowed((1, 101, 0, 99)), Refusal.TABLE),
        (windowed((1, 100, 0, 99), limits=(4095, 4095)), Refusal.NONE),
        (windowed((1, 100, 0, 99), limits=(4096, 0)), Refusal.TABLE),
        (windowed((1, 100, 0, 99), limits=(0, 4096)), Refusal.TABLE),
        (windowed(*[(1, 100, 0, 99)] * 64), Refusal.NONE),
        (raw_command(entry(1, 100)), Refusal.NONE),
        (raw_command(entry(1, 101)), Refusal.TABLE),
        (raw_command(entry(0, 101)), Refusal.NONE),
        (raw_command(entry(1, 0)), Refusal.NONE),
        (raw_command(entry(1, 100), version=2), Refusal.NONE),
        (raw_command(entry(1, 100), mode=2), Refusal.VERSION),
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


@given(st.binary(min_size=SIZE, max_size=SIZE), st.booleans(), st.sampled_from((1, 2)))
def test_anything(library: Any, data: bytes, sealed: bool, mode: int) -> None:
    """Whatever comes: an answer, and a plan within its bounds."""
    raw = bytearray(data)
    raw[:2], raw[10], raw[13], raw[15] = b"ER", mode, mode, 0
    raw[14] = 1 + raw[14] % TABLE_MAX
    end = 16 + 12 * raw[14] if mode == 1 else 20 + 16 * raw[14]
    if sealed:
        raw[end : end + 4] = crc32_words(bytes(raw[:end])).to_bytes(4, "little")
    refusal, plan = read(library, bytes(raw))
    assert plan.frames <= TABLE_MAX
    if refusal is Refusal.NONE:
        assert all(0 < s.tick < plan.icg_period for steps in frames(plan) for s in steps)
        for of_frame in windows(plan) if mode == 2 else ():
            assert 1 <= len(of_frame) <= 8
            assert all(a + 23 <= b <= 3647 for a, b in of_frame)
            assert all(a[1] < b[0] for a, b in itertools.pairwise(sorted(of_frame)))


def test_short_transfers(library: Any) -> None:
    """A command for a stream that runs is obeyed at once, others when the clock rests."""
    command = Command(100, 20000, 3, Mode.SPIKES)
    assert library.command_brief(command.encode(256))
    assert not library.command_brief(command.encode())
    assert not library.command_brief(Command(100, 20000, 3, Mode.STREAM).encode(7424))


def test_presence(library: Any) -> None:
    assert library.command_present(b"ER")
    assert not library.command_present(b"\0R")
    assert not library.command_present(b"E\0")
