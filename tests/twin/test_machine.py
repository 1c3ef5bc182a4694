"""The firmware on the machine: original mode and stream, as a host would use them."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from twin.machine import Machine

if TYPE_CHECKING:
    from numpy.typing import NDArray

ELF = Path(__file__).parents[2] / "firmware" / "build" / "F401_FW_TCD1304.elf"
CLOCK = 15.6e6
CODES = np.r_[np.arange(3694) % 4096, 4000].astype(np.uint16)


def power_on(**options: Any) -> Machine:
    if not ELF.exists():
        pytest.fail(f"{ELF} is missing: run `make -C firmware`")
    machine = Machine(ELF, **options)
    machine.run(0.01)
    return machine


def original(sh: int, icg: int, count: int) -> bytes:
    command = b"ER" + struct.pack(">II", sh, icg) + b"\0" + struct.pack(">H", count)
    return command.ljust(7388, b"\0")


def crc(data: bytes) -> int:
    value = 0xFFFFFFFF
    for (word,) in struct.iter_unpack("<I", data):
        value ^= word
        for _ in range(32):
            value = ((value << 1) ^ (0x04C11DB7 if value >> 31 else 0)) & 0xFFFFFFFF
    return value


def stream(sh: int, icg: int, count: int, table: list[tuple[int, int]], size: int) -> bytes:
    command = b"ER" + struct.pack(">II", sh, icg) + b"\1" + struct.pack(">H", count)
    command += bytes([1, len(table), 0]) + b"".join(struct.pack("<QI", *entry) for entry in table)
    return (command + struct.pack("<I", crc(command))).ljust(size, b"\0")


def capture(machine: Machine, sh: int, icg: int, count: int) -> list[NDArray[np.uint16]]:
    machine.transfer(original(sh, icg, count), CLOCK)
    frames = []
    for i in range(count):
        if i:
            assert machine.wait_pin("PB2", False, 0.5)
        assert machine.wait_pin("PB2", True, 0.5)
        frames.append(np.frombuffer(machine.transfer(bytes(7388), CLOCK), "<u2"))
    return frames


def test_original_mode() -> None:
    with power_on(digitise=lambda _charge, _time: CODES, record=True) as m:
        frames = capture(m, 100, 30000, 4)
        for frame in frames:
            np.testing.assert_array_equal(frame, CODES[:-1])
        assert m.readouts["sampled"].sum() == 4
        assert not m.readouts["problems"][m.readouts["sampled"] == 1].any()
        # unlit, unlit, the first LED, the second one
        led0 = m.edges("PC4")
        led1 = m.edges("PC5")
        assert led0["level"].tolist() == led1["level"].tolist() == [1, 0]
        lit = m.readouts["lit"][m.readouts["sampled"] == 1]
        assert lit[:, 1].tolist()[:2] == lit[:, 2].tolist()[:2] == [0, 0]
        assert lit[2, 1] > 0.9 * 2100
        assert lit[3, 2] > 0.9 * 2100
        assert lit[2, 2] == lit[3, 1] == 0
        assert m.underruns == 0


def test_elements_are_held_where_they_have_settled() -> None:
    with power_on(digitise=lambda _charge, _time: CODES, record=True) as m:
        capture(m, 100, 30000, 1)
        start = int(m.readouts["start"][m.readouts["sampled"] == 1][0])
        window = m.edges("ADC")
        hold = window["time"][window["level"] == 0].astype(int) - start
        hold = hold[hold >= 0][:3694]
        assert set(np.diff(hold)) == {84}
        assert 50 <= hold[0] <= 70


@pytest.mark.parametrize("chain", [False, True])
def test_stream(chain: bool) -> None:
    table = [(1 << 6 | 1 << 63, 2000), (1 << 1, 1000)] if chain else [(0, 0)]
    with power_on(digitise=lambda _charge, _time: CODES) as m:
        m.transfer(stream(14776, 14776, 0, table, 7388), CLOCK)
        assert m.wait_pin("PB2", True, 0.1)
        status = m.transfer(bytes(7424), CLOCK)
        assert status[:4] == b"LT\x01\x08"
        assert struct.unpack_from("<I", status, 32)[0] == 0
        for i in range(8):
            assert m.wait_pin("PB2", True, 0.1)
            frame = m.transfer(bytes(7424), CLOCK)
            assert struct.unpack_from("<I", frame, 7420)[0] == crc(frame[:7420])
            elements = np.frombuffer(frame[32:7420], "<u2")
            np.testing.assert_array_equal(elements[:3680], CODES[:3680])
            mask = struct.unpack_from("<Q", frame, 8)[0]
            assert mask == table[i % len(table)][0]
        lit = m.readouts["lit"][m.readouts["sampled"] == 1] / 21
        if chain:
            even = lit[:, 1 + 6] > 0
            np.testing.assert_array_equal(lit[:, 1 + 6], lit[:, 1 + 63])
            np.testing.assert_allclose(lit[even, 1 + 6], 2000, atol=3)
            np.testing.assert_allclose(lit[~even, 1 + 1], 1000, atol=3)
            assert not lit[~even, 1 + 6].any()
            assert not lit[even, 1 + 1].any()


def everything(**options: Any) -> list[bytes]:
    """All that can be seen of a session with original frames, a stream, a reset."""
    rates = np.random.default_rng(2).uniform(0, 1e8, (65, 3648))

    def digitise(charge: NDArray[np.float64], time: int) -> NDArray[np.uint16]:
        codes = np.full(3695, 4000, np.uint16)
        codes[32:3680] = np.clip(4000 - charge / 20, 0, 4095).astype(np.uint16)
        codes[0] = time % 4096
        return codes

    with power_on(rates=rates, digitise=digitise, record=True, log_exceptions=True, **options) as m:
        seen = [frame.tobytes() for frame in capture(m, 200, 20000, 3)]
        m.transfer(stream(14776, 14776, 3, [(5, 3000), (1 << 40, 100)], 7388), CLOCK)
        for _ in range(5):
            m.wait_pin("PB2", True, 0.01)
            seen.append(m.transfer(bytes(7424), CLOCK))
        m.transfer(bytes(100), 5e6)
        m.reset()
        m.run(0.004)
        seen.append(m.transfer(original(50, 15000, 2), 7e6))
        m.run(0.02)
        seen.append(m.transfer(bytes(7388), CLOCK))
        seen.append(m.edges().tobytes())
        seen.append(m.exception_log.tobytes())
        seen.append(repr((m.violations, m.time, m.underruns)).encode())
        seen.append(m.readouts.tobytes())
        seen.append(m.charge.tobytes())
        seen.append(m.read(0x20000000, 0x18000))
    return seen


def test_equal_inputs_give_equal_bits() -> None:
    assert everything() == everything()


def test_bursts_change_nothing() -> None:
    singly, together = everything(singly=True), everything()
    assert [len(part) for part in singly] == [len(part) for part in together]
    assert singly == together


def test_unusable_arguments() -> None:
    with pytest.raises(ValueError, match="not a little-endian ELF"):
        Machine(b"no ELF at all")
    with pytest.raises(ValueError, match="rates: expected"):
        Machine(ELF, rates=np.zeros((2, 3)))
    with power_on() as m:
        with pytest.raises(ValueError, match="'PZ1' is no pin"):
            m.wait_pin("PZ1")
        with pytest.raises(ValueError, match="neither RAM nor flash"):
            m.read(0x1000, 4)
        with pytest.raises(KeyError):
            m.symbol("not a symbol")
        with pytest.raises(ValueError, match="clock"):
            m.transfer(b"", 0)
