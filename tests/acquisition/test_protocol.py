"""The bytes on the wire: round trips, refusals, and that no damage goes unseen."""

from __future__ import annotations

import random
import struct
from contextlib import suppress
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from acquisition.frames import (
    CHANNELS,
    ELEMENTS,
    PIXELS,
    Frame,
    FrameFlags,
    OnboardSpike,
    SpikeFrame,
)
from acquisition.protocol import (
    CHAIN_FIRST,
    CHAIN_STEP,
    EXPOSURE_MIN,
    ICG_MIN,
    ORIGINAL_SIZE,
    SH_MIN,
    SPIKES_SIZE,
    STREAM_SIZE,
    TABLE_MAX,
    BadChecksum,
    BadHeader,
    BadMagic,
    BadVersion,
    Command,
    CommandError,
    DecodeError,
    Mode,
    Refusal,
    ShortFrame,
    Status,
    crc32_words,
    decode_elements,
    decode_frame,
    decode_spikes,
    encode_elements,
    encode_frame,
    encode_spikes,
    encode_status,
)

RNG = np.random.default_rng(7)
FRAME = Frame(
    RNG.integers(0, 4096, ELEMENTS, dtype=np.uint16),
    sequence=1234,
    leds=0x8000_0000_0000_0021,
    sh_period=100,
    icg_period=30000,
    timestamp=987_654_321_250,
    flags=FrameFlags.DROPPED,
)
DATA = encode_frame(FRAME)


def slow_crc(data: bytes, width: int = 4) -> int:
    """CRC-32/MPEG-2 bit by bit, over little-endian words of so many bytes."""
    crc = 0xFFFF_FFFF
    for at in range(0, len(data), width):
        for byte in reversed(data[at : at + width]):
            crc ^= byte << 24
            for _ in range(8):
                crc = (crc << 1) ^ (0x04C1_1DB7 if crc >> 31 else 0)
                crc &= 0xFFFF_FFFF
    return crc


def test_checksum_vectors() -> None:
    assert crc32_words(struct.pack("<I", 0x12345678)) == 0xDF8A8A2B
    assert slow_crc(b"123456789", 1) == 0x0376E6E7  # the published one, over bytes
    assert crc32_words(b"") == 0xFFFF_FFFF


@given(st.binary(max_size=256).map(lambda data: data[: len(data) // 4 * 4]))
def test_checksum_is_the_units(data: bytes) -> None:
    assert crc32_words(data) == slow_crc(data)
    assert crc32_words(bytearray(data)) == crc32_words(memoryview(data)) == slow_crc(data)


def test_checksum_needs_words() -> None:
    with pytest.raises(ValueError, match="words of 4"):
        crc32_words(b"12345")


# --- commands


def test_the_longest_sh_period_has_a_default_sequence() -> None:
    longest = Command(2**31, 2**31, 2, Mode.STREAM)
    assert [set(lit.values()) for lit in longest.sequence] == [{2**31 - 1}] * 2
    assert Command.decode(longest.encode()) == longest


@st.composite
def periods(draw: st.DrawFn) -> tuple[int, int]:
    sh = draw(st.one_of(st.integers(SH_MIN, 200), st.integers(SH_MIN, 2**31)))
    lowest, highest = -(-ICG_MIN // sh), (2**32 - 1) // sh
    return sh, sh * draw(st.integers(lowest, highest))


@st.composite
def exposures(draw: st.DrawFn, sh: int) -> dict[int, int]:
    pins = draw(
        st.dictionaries(
            st.integers(0, CHAIN_FIRST - 1),
            st.just(0) | st.integers(EXPOSURE_MIN, min(sh, 2**31 - 1)),
        )
    )
    steps = range(CHAIN_STEP, min(sh, 400) + 1, CHAIN_STEP)
    chain = st.dictionaries(st.integers(CHAIN_FIRST, CHANNELS - 1), st.sampled_from(steps))
    return {**pins, **draw(chain)}


@st.composite
def commands(draw: st.DrawFn) -> Command:
    sh, icg = draw(periods())
    if draw(st.booleans()):
        return Command(sh, icg, draw(st.integers(1, 65535)))
    sequence = draw(st.lists(exposures(sh), max_size=4))
    count, sync = draw(st.integers(0, 65535)), draw(st.booleans())
    if draw(st.booleans()):
        return Command(sh, icg, count, Mode.STREAM, sequence, await_sync=sync)
    frames = len(sequence) or 2
    windows = [draw(some_windows()) for _ in range(frames)]
    code = st.integers(0, 4095)
    return Command(*(sh, icg, count, Mode.SPIKES, sequence, windows, draw(code), draw(code), sync))


@st.composite
def some_windows(draw: st.DrawFn) -> list[tuple[int, int]]:
    """Up to eight that do not overlap, in any order."""
    ends = draw(st.lists(st.integers(0, PIXELS), max_size=16, unique=True).map(sorted))
    pairs = zip(ends[::2], ends[1::2], strict=False)
    return draw(st.permutations([(a, b - 1) for a, b in pairs if b - a >= 24]))


@settings(max_examples=300)
@given(commands(), st.sampled_from([ORIGINAL_SIZE, STREAM_SIZE]))
def test_commands_come_back(command: Command, size: int) -> None:
    data = command.encode(size)
    assert len(data) == size
    assert Command.decode(data) == command
    assert command.encode() == command.encode(ORIGINAL_SIZE)


def test_original_command_byte_for_byte() -> None:
    data = Command(100, 30000, 2).encode()
    assert data == bytes.fromhex("4552 00000064 00007530 00 0002").ljust(7388, b"\0")


def test_extended_command_byte_for_byte() -> None:
    command = Command(100, 30000, 0x0102, Mode.STREAM, [{0: 50, 1: 50, 63: 90}, {}])
    table = struct.pack("<QIQIQI", 1 << 63, 90 | 1 << 31, 3, 50, 0, 0)
    head = bytes.fromhex("4552 00000064 00007530 01 0102 01 03 00") + table
    assert command.encode() == (head + struct.pack("<I", slow_crc(head))).ljust(7388, b"\0")


def test_command_of_spikes_mode_byte_for_byte() -> None:
    command = Command(
        *(100, 30000, 0x0102, Mode.SPIKES, [{0: 50, 63: 90}, {1: 30}]),
        windows=[[(1, 24)], [(107, 199), (2, 100)]],
        threshold=0x123,
        await_sync=True,
    )
    table = struct.pack("<QIHH", 1 << 63, 90 | 1 << 31, 1, 24)
    table += struct.pack("<QIHH", 1, 50, 0xFFFF, 0xFFFF)
    table += struct.pack("<QIHH", 2, 30 | 1 << 31, 107, 199) + struct.pack("<QIHH", 0, 0, 2, 100)
    for size, options in ((ORIGINAL_SIZE, 1), (SPIKES_SIZE, 3)):
        head = bytes.fromhex("4552 00000064 00007530 02 0102 02 04") + bytes([options])
        head += bytes.fromhex("6c07 2301") + table
        assert command.encode(size) == (head + struct.pack("<I", slow_crc(head))).ljust(size, b"\0")
    assert command.windows == (((1, 24),), ((107, 199), (2, 100)))
    assert Command(100, 30000, 1, Mode.SPIKES, [{}]).windows == (((0, 3647),),)


def test_default_sequence_is_the_thesis_pair() -> None:
    assert Command(100, 30000, 0, Mode.STREAM).sequence == ({0: 100}, {1: 100})


def test_leds_of_a_frame() -> None:
    command = Command(100, 30000, 4)
    assert [command.leds(n) for n in range(5)] == [{}, {}, {0: 100}, {1: 100}, {}]
    assert Command(100, 30000, 1).leds(0) == {1: 100}
    command = Command(100, 30000, 4, Mode.STREAM, [{7: 41}, {}])
    assert [command.leds(n) for n in range(3)] == [{7: 41}, {}, {7: 41}]


NINE = [(100 * n, 100 * n + 99) for n in range(9)]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((30000, 100, 2), "-i 100 is below 14776.*are -i and -s swapped"),
        ((100, 14700, 2), "-i 14700 is below 14776"),
        ((30, 30000, 2), "-s 30 is below 40"),
        ((0, 30000, 2), "-s 0 is below 40"),
        ((-100, 30000, 2), "-s -100 is below"),
        ((100, 30050, 2), "no multiple of -s 100.*30000 or 30100"),
        ((30000, 20000, 2), "swapped"),
        ((100, 14780, 2), "-i may be 14800"),
        ((100, 2**32, 2), "-i 4294967296 is above"),
        ((100, 30000, 0), "-n 0: allowed are 1 to 65535 frames; only stream"),
        ((100, 30000, 65536), "-n 65536"),
        ((100, 30000, -1, Mode.STREAM), "-n -1: allowed are 0 to"),
        ((100.0, 30000, 2), "whole number"),
        ((100, True, 2), "whole number"),
        ((100, 30000, 2, 9), "mode = 9"),
        ((100, 30000, 2, Mode.STREAM, [{}], [[(0, 99)]]), "Mode.SPIKES meant"),
        ((100, 30000, 2, Mode.SPIKES, [{}], [[(0, 22)]]), "0 to 22: allowed are 24 pixels"),
        (
            (100, 30000, 2, Mode.SPIKES, [{}], [[(0, 99), (99, 200)]]),
            "99 to 200 overlaps 0 to 99: a pixel is in one window",
        ),
        ((100, 30000, 2, Mode.SPIKES, [{}], [[(0, 3648)]]), "within 0 to 3647"),
        ((100, 30000, 2, Mode.SPIKES, [{}], [[(-1, 30)]]), "within 0 to 3647"),
        ((100, 30000, 2, Mode.SPIKES, [{}], [(0, 99)]), "one window given instead of a list"),
        ((100, 30000, 2, Mode.SPIKES, [{}], [[(0.5, 99)]]), "whole number"),
        ((100, 30000, 2, Mode.SPIKES, [{}], [NINE]), "9: allowed are 1 to 8"),
        ((100, 30000, 2, Mode.SPIKES, [{}], [[], []]), "2 for a sequence of 1 frames"),
        ((100, 30000, 2, Mode.SPIKES, [{}] * 9, [NINE[:8]] * 9), "72 entries.*holds 64"),
        ((100, 30000, 2, Mode.SPIKES, [{}], [], 4096), "saturated = 4096"),
        ((100, 30000, 2, Mode.SPIKES, [{}], [], 0, -1), "threshold = -1"),
        ((100, 30000, 2, Mode.ORIGINAL, [], [], 0, 0, True), "original mode begins at once"),
        ((100, 30000, 2, Mode.ORIGINAL, [{0: 10}]), "stream mode meant"),
        ((100, 30000, 2, Mode.STREAM, [{64: 10}]), "channels 0 to 63"),
        ((100, 30000, 2, Mode.STREAM, [{0: 101}]), "10 up to the SH period, 100"),
        ((100, 30000, 2, Mode.STREAM, [{0: 9}]), "allowed are 0 .dark. and 10"),
        ((100, 30000, 2, Mode.STREAM, [{0: -1}]), "0 up to the SH period"),
        ((100, 30000, 2, Mode.STREAM, [3]), "a mapping from LED channel"),
        ((100, 30000, 2, Mode.STREAM, [{0: 1.5}]), "whole number"),
        ((100, 30000, 2, Mode.STREAM, [{6: 10, 7: 49}]), "49 and 10 clocks.*40 between"),
        ((100, 30000, 2, Mode.STREAM, [{0: 10}] * (TABLE_MAX + 1)), "65 entries.*holds 64"),
        ((100, 30000, 2, Mode.STREAM, [{0: 10, 1: 11}] * 33), "66 entries"),
    ],
)
def test_bad_commands(arguments: tuple[object, ...], words: str) -> None:
    with pytest.raises(CommandError, match=words):
        Command(*arguments)  # type: ignore[arg-type]


def test_size_of_a_transfer() -> None:
    with pytest.raises(
        ValueError, match="7388 bytes in original mode, 7424 in stream mode and 256"
    ):
        Command(100, 30000, 2).encode(7000)
    assert Command(100, 30000, 2).size == ORIGINAL_SIZE
    assert Command(100, 30000, 2, Mode.STREAM).size == STREAM_SIZE
    assert Command(100, 30000, 2, Mode.SPIKES).size == SPIKES_SIZE
    assert len(Command(100, 30000, 2, Mode.SPIKES, [{}] * 14).encode(SPIKES_SIZE)) == SPIKES_SIZE
    with pytest.raises(CommandError, match="15 entries do not fit into a transfer of spikes mode"):
        Command(100, 30000, 2, Mode.SPIKES, [{}] * 15).encode(SPIKES_SIZE)
    assert Command(100, 30000, 2).frame_rate() == pytest.approx(133.333, rel=1e-5)


def sealed(head: bytes, table: bytes) -> bytes:
    data = head + table
    return data + struct.pack("<I", crc32_words(data))


HEAD = bytes.fromhex("4552 00000064 00007530 01 0000 01 01 00")
ENTRY = struct.pack("<QI", 1, 50)


@pytest.mark.parametrize(
    ("data", "refusal"),
    [
        (HEAD[:13] + b"\x03" + HEAD[14:] + ENTRY, Refusal.VERSION),
        (sealed(HEAD[:15] + b"\x01", ENTRY), Refusal.VERSION),
        (sealed(HEAD[:13] + b"\x02\x01\x04", ENTRY), Refusal.VERSION),
        (sealed(HEAD[:14] + b"\0\0", b""), Refusal.TABLE),
        (HEAD[:14] + b"\x41\0" + bytes(800), Refusal.TABLE),
        (HEAD + ENTRY + bytes(4), Refusal.CHECKSUM),
        (sealed(HEAD[:10] + b"\x02" + HEAD[11:], ENTRY), Refusal.VERSION),
        (sealed(HEAD[:10] + b"\xff" + HEAD[11:], ENTRY), Refusal.MODE),
        (sealed(HEAD[:5] + b"\x03" + HEAD[6:], ENTRY), Refusal.PERIODS),
        (sealed(HEAD, struct.pack("<QI", 1, 101)), Refusal.TABLE),
        (sealed(HEAD, struct.pack("<QI", 1, 50 | 1 << 31)), Refusal.TABLE),
        (
            sealed(HEAD[:14] + b"\x02\0", struct.pack("<QIQI", 1, 9 | 1 << 31, 2, 9)),
            Refusal.TABLE,
        ),
        (b"ER" + bytes(20), Refusal.PERIODS),
    ],
)
def test_what_the_device_refuses(data: bytes, refusal: Refusal) -> None:
    with pytest.raises(CommandError) as caught:
        Command.decode(data.ljust(7388, b"\0"))
    assert caught.value.refusal is refusal


@given(st.binary(max_size=900), st.booleans())
@settings(max_examples=500)
def test_any_bytes_as_a_command(data: bytes, magic: bool) -> None:
    with suppress(CommandError, DecodeError):
        Command.decode(b"ER" + data if magic else data)


@given(commands(), st.data())
@settings(max_examples=200)
def test_damaged_extended_command_is_refused(command: Command, data: st.DataObject) -> None:
    encoded = bytearray(command.encode()[:1100])
    end = 20 + 12 * encoded[14] if command.mode is not Mode.SPIKES else 24 + 16 * encoded[14]
    at, bit = data.draw(st.integers(2, end - 1)), data.draw(st.integers(0, 7))
    encoded[at] ^= 1 << bit
    try:
        found = Command.decode(bytes(encoded))
    except (CommandError, DecodeError):
        return
    # the original format has no checksum, and a changed bit may make that of it
    assert command.mode is Mode.ORIGINAL or found.mode is Mode.ORIGINAL


# --- frames


@given(
    st.integers(0, 2**32 - 1),
    st.integers(0, 2**64 - 1),
    st.integers(0, 2**55),
    st.integers(0, 2**32 - 1),
    st.integers(0, 2**32 - 1),
    st.integers(0, 7),
    st.integers(0, 2**32 - 1),
    st.integers(800_000, 4_000_000),
)
def test_frames_come_back(
    sequence: int, leds: int, clocks: int, sh: int, icg: int, flags: int, seed: int, clock: int
) -> None:
    frame = Frame(
        np.random.default_rng(seed).integers(0, 65536, ELEMENTS, dtype=np.uint16),
        sequence=sequence,
        leds=leds,
        exposures={3: 7},
        sh_period=sh,
        icg_period=icg,
        master_clock=clock,
        timestamp=clocks * 10**9 // clock,
        utc_ns=5,
        monotonic_ns=6,
        flags=FrameFlags(flags),
    )
    data = encode_frame(frame)
    assert len(data) == STREAM_SIZE
    assert struct.unpack_from("<Q", data, 16) == (clocks,)
    again = decode_frame(data, exposures={3: 7}, master_clock=clock, utc_ns=5, monotonic_ns=6)
    assert again == frame
    np.testing.assert_array_equal(decode_elements(encode_elements(frame)), frame.elements)


def test_frame_byte_for_byte() -> None:
    assert DATA[:4] == b"LT\x01\x01"
    assert struct.unpack_from("<IQQII", DATA, 4) == (
        1234,
        0x8000_0000_0000_0021,
        987_654_321_250 // 250,
        30000,
        100,
    )
    assert DATA[32:-4] == FRAME.elements.astype("<u2").tobytes()
    assert DATA[-4:] == struct.pack("<I", slow_crc(DATA[:-4]))


@given(
    st.sampled_from(Refusal),
    st.text(st.characters(min_codepoint=33, max_codepoint=126), max_size=32),
    st.integers(0, 2**32 - 1),
    st.integers(0, 2**32 - 1),
)
def test_answers_come_back(refusal: Refusal, build: str, sh: int, icg: int) -> None:
    status = Status(refusal, build, sh, icg, timestamp=1000, sequence=3)
    assert decode_frame(encode_status(status)) == status


def test_frames_it_does_not_know() -> None:
    def changed(at: int, value: int, *, seal: bool = True) -> bytes:
        data = bytearray(DATA)
        data[at] = value
        if seal:
            data[-4:] = struct.pack("<I", crc32_words(bytes(data[:-4])))
        return bytes(data)

    with pytest.raises(BadMagic, match="out of step"):
        decode_frame(changed(0, 0))
    with pytest.raises(BadChecksum, match="changed on the link"):
        decode_frame(changed(2, 9, seal=False))
    with pytest.raises(BadVersion, match=r"frame version 9.*same release"):
        decode_frame(changed(2, 9))
    with pytest.raises(BadHeader, match="flags 0x80"):
        decode_frame(changed(3, 0x80))
    for data in (b"", DATA[:-1], DATA + b"\0"):
        with pytest.raises(ShortFrame, match="7424"):
            decode_frame(data)
    with pytest.raises(ShortFrame, match="7388"):
        decode_elements(DATA)
    status = bytearray(encode_status(Status(Refusal.NONE, "", 100, 30000)))
    status[32] = 77
    status[-4:] = struct.pack("<I", crc32_words(bytes(status[:-4])))
    with pytest.raises(BadHeader, match="refusal 77"):
        decode_frame(bytes(status))


def test_every_single_flipped_bit_is_seen() -> None:
    data = bytearray(DATA)
    for at in range(STREAM_SIZE):
        for bit in range(8):
            data[at] ^= 1 << bit
            with pytest.raises(DecodeError):
                decode_frame(data)
            data[at] ^= 1 << bit
    assert decode_frame(data) == FRAME


def damaged(rng: random.Random) -> bytes:
    """A frame after one of the accidents of a wire."""
    data = bytearray(DATA)
    kind, at = rng.randrange(7), rng.randrange(STREAM_SIZE)
    if kind == 0:  # flipped bits
        for _ in range(rng.randint(1, 8)):
            data[rng.randrange(STREAM_SIZE)] ^= 1 << rng.randrange(8)
    elif kind == 1:  # a burst
        length = rng.randint(1, 32)
        start = rng.randrange(8 * STREAM_SIZE - length)
        burst = (rng.getrandbits(length) | 1 | 1 << (length - 1)) << start
        data = bytearray((int.from_bytes(data, "little") ^ burst).to_bytes(STREAM_SIZE, "little"))
    elif kind == 2:  # dropped bytes
        del data[at : at + rng.randint(1, 9)]
        data = data.ljust(STREAM_SIZE, rng.choice([b"\0", b"\xff"]))
    elif kind == 3:  # doubled ones
        end = min(STREAM_SIZE, at + rng.randint(1, 9))
        data = (data[:end] + data[at:])[:STREAM_SIZE]
    elif kind == 4:  # cut off, and filled up by an idle line
        data = data[:at].ljust(STREAM_SIZE, rng.choice([b"\0", b"\xff"]))
    elif kind == 5:  # of another length
        data = data[:at] if rng.random() < 0.5 else data + data[: at + 1]
    else:  # two frames in one
        data = data[at:] + data[:at]
    return bytes(data)


def test_hundred_thousand_damaged_frames() -> None:
    rng = random.Random(1304)  # noqa: S311
    same = 0
    for _ in range(100_000):
        data = damaged(rng)
        try:
            found = decode_frame(data)
        except DecodeError:
            continue
        assert data == DATA, "a damaged frame was taken for a good one"
        assert found == FRAME
        same += 1
    assert same < 1000  # such as two bits that undo each other


SPIKES = SpikeFrame(
    (OnboardSpike(2.25, 7.5, 999, 5, 0), OnboardSpike(3647.0, 3648.0, 4095, 8, 1)),
    windows=((0, 15), (1, 3647)),
    dark_level=3901.0625,
    sequence=0x12345678,
    leds=0x8000_0000_0000_0021,
    sh_period=100,
    icg_period=30000,
    timestamp=987_654_321_250,
    flags=FrameFlags.DROPPED,
)


def test_spikes_byte_for_byte() -> None:
    clocks = 987_654_321_250 * 4 // 1000
    data = struct.pack("<HBBIQQII", 0x544C, 2, 1, 0x12345678, 1 << 63 | 33, clocks, 30000, 100)
    data += struct.pack("<BBHI4H", 2, 2, 3901 * 16 + 1, 0, 0, 15, 1, 3647) + bytes(24)
    data += struct.pack("<IHHBBH", 2304, 120, 999, 5, 0, 0)
    data += struct.pack("<IHHBBH", 3647 * 1024, 58368, 4095, 8, 1, 0)
    data = data.ljust(252, b"\0")
    data += struct.pack("<I", slow_crc(data))
    assert encode_spikes(SPIKES) == data
    assert decode_spikes(data) == SPIKES
    lit = decode_spikes(data, exposures={0: 7}, master_clock=2_000_000, utc_ns=3, monotonic_ns=4)
    assert isinstance(lit, SpikeFrame)
    assert (lit.exposures, lit.utc_ns, lit.monotonic_ns) == ({0: 7}, 3, 4)
    assert lit.timestamp == 2 * 987_654_321_250
    assert SPIKES.channels == (0, 5, 63)
    with pytest.raises(ValueError, match="master_clock"):
        SpikeFrame((), master_clock=0)
    with pytest.raises(ValueError, match="9 spikes in 2 windows"):
        encode_spikes(replace(SPIKES, spikes=SPIKES.spikes[:1] * 9))
    with pytest.raises(ValueError, match="2 spikes in 0 windows"):
        encode_spikes(replace(SPIKES, windows=()))


def test_status_in_spikes_mode() -> None:
    status = Status(Refusal.TABLE, "linetrack 0.1", 100, 30000, timestamp=250)
    data = encode_status(status, mode=Mode.SPIKES)
    assert len(data) == SPIKES_SIZE
    assert decode_spikes(data) == status


@pytest.mark.parametrize(
    ("at", "value", "error"),
    [
        (0, 0, BadMagic),
        (2, 1, BadVersion),
        (3, 16, BadHeader),
        (32, 9, BadHeader),
        (33, 0, BadHeader),
        (33, 9, BadHeader),
        (72 + 9, 2, BadHeader),
        (72 + 8, 16, BadHeader),  # a flag that none knows
        (72 + 12, 1, BadHeader),  # beyond the last pixel
        (40 + 2 + 1, 0x0F, BadHeader),  # a window off the line
        (40 + 4 + 1, 0x0F, BadHeader),  # one that ends before it begins
    ],
)
def test_intact_but_wrong_spikes(at: int, value: int, error: type[DecodeError]) -> None:
    data = bytearray(encode_spikes(SPIKES)[:-4])
    data[at] = value
    with pytest.raises(error):
        decode_spikes(bytes(data) + struct.pack("<I", slow_crc(bytes(data))))


def test_damaged_spikes() -> None:
    rng = random.Random(2304)  # noqa: S311
    good = encode_spikes(SPIKES)
    for _ in range(20_000):
        data = bytearray(good)
        for _ in range(rng.randint(1, 8)):
            data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
        at = rng.randrange(len(data))
        if rng.random() < 0.5:
            data = (data[:at] + data[at + rng.randint(1, 9) :]).ljust(SPIKES_SIZE, b"\0")
        if data != good:
            with pytest.raises(DecodeError):
                decode_spikes(data)
    with pytest.raises(ShortFrame, match="in spikes mode has 256"):
        decode_spikes(DATA)


def test_garbage_is_no_frame() -> None:
    rng = random.Random(7)  # noqa: S311
    for _ in range(2000):
        data = rng.randbytes(STREAM_SIZE)
        for start in (b"", b"LT", b"LT\x01\0"):
            with pytest.raises(DecodeError):
                decode_frame(start + data[len(start) :])
