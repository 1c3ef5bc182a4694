"""Frames: what they hold, and what in them no sensor can have sent."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from acquisition.frames import ELEMENTS, LEADING, PIXELS, Frame, FrameFlags, stack
from tests.acquisition.fake_mcu import elements_at


def frame(n: int = 0) -> Frame:
    return Frame(elements_at(n), sequence=n, leds=5, exposures={0: 10, 2: 3}, sh_period=100)


def test_parts() -> None:
    elements = np.arange(ELEMENTS, dtype=np.uint16)
    found = Frame(elements, sh_period=100, leds=0b101)
    assert found.pixels.size == PIXELS
    assert found.pixels[0] == LEADING == 32
    assert found.pixels[-1] == 3679
    assert found.dark.tolist() == list(range(16, 29))
    assert found.dark_level == 22
    assert found.integration_time == pytest.approx(25e-6)
    assert found.channels == (0, 2)
    with pytest.raises(ValueError, match="read-only"):
        found.elements[0] = 1
    assert elements.flags.writeable


def test_equality_and_pickling() -> None:
    assert frame() == frame()
    assert frame() != frame(1)
    assert frame() != 3
    assert pickle.loads(pickle.dumps(frame())) == frame()  # noqa: S301


@pytest.mark.parametrize(
    "elements",
    [np.zeros(PIXELS, np.uint16), np.zeros(ELEMENTS), np.zeros((1, ELEMENTS), np.uint16), [1]],
)
def test_elements_are_checked(elements: object) -> None:
    with pytest.raises(ValueError, match="3694 values of uint16"):
        Frame(elements)  # type: ignore[arg-type]


def test_values_are_checked() -> None:
    with pytest.raises(ValueError, match="master_clock = 0"):
        Frame(elements_at(0), master_clock=0)
    with pytest.raises(ValueError, match="64 bits"):
        Frame(elements_at(0), leds=1 << 64)


def test_stack() -> None:
    found = stack([frame(n) for n in range(3)])
    assert found["elements"].shape == (3, ELEMENTS)
    assert found["exposures"].shape == (3, 64)
    assert found["exposures"][1, :3].tolist() == [10, 0, 3]
    assert found["sequence"].tolist() == [0, 1, 2]
    assert found["timestamp"].tolist() == [-1, -1, -1]
    assert found["flags"].dtype == np.uint32
    assert stack([])["elements"].shape == (0, ELEMENTS)


def test_good_frames_are_not_complained_about() -> None:
    rng = np.random.default_rng(0)
    for n in range(100):
        assert Frame(elements_at(n)).invalid() == []
    for level, noise in ((1900, 5), (3600, 2), (4090, 2)):
        for light in (0, 1500):
            elements = rng.normal(level, noise, ELEMENTS)
            elements[1000:2000] -= light
            assert Frame(np.clip(elements, 0, 4095).astype(np.uint16)).invalid() == []


def reasons(data: bytes) -> str:
    found = Frame(np.frombuffer(data[: 2 * ELEMENTS].ljust(2 * ELEMENTS, b"\0"), np.uint16))
    return " / ".join(found.invalid())


def test_what_a_wire_does_to_a_frame() -> None:
    good = elements_at(3).astype("<u2").tobytes()
    assert "above 4095" in reasons(good[1:])
    assert "above 4095" in reasons(good[:3001] + good[3000:])
    assert "MISO is stuck" in reasons(bytes(len(good)))
    assert "MISO is stuck" in reasons(b"\xff" * len(good))
    assert "in a row read 0" in reasons(good[:7000])
    lit = elements_at(0).copy()
    lit[LEADING:-14] -= np.uint16(1000)
    for shift in (-10, 100, 3640):
        assert "shifted" in reasons(np.roll(lit, shift).tobytes())
    assert "inverted" in reasons((4095 - lit).astype("<u2").tobytes())
    high = lit.copy()
    high[500] = 4095
    assert "above the dark reference" in reasons(high.tobytes())


@pytest.mark.parametrize("at", [16, 22, 28])
def test_how_far_the_dark_reference_may_spread(at: int) -> None:
    elements = np.full(ELEMENTS, 3000, np.uint16)
    elements[0] = 2990
    elements[at] = 3000 - 128
    assert Frame(elements).invalid() == []
    elements[at] -= np.uint16(1)
    (reason,) = Frame(elements).invalid()
    assert "spreads over 129 counts, more than 128" in reason


@given(st.binary(min_size=40, max_size=40), st.integers(0, 100))
def test_any_frame_can_be_judged(part: bytes, at: int) -> None:
    elements = elements_at(0).copy()
    elements[at : at + 20] = np.frombuffer(part, np.uint16)
    assert isinstance(Frame(elements).invalid(), list)


def test_flags_of_the_device_and_of_the_host() -> None:
    device = FrameFlags.DROPPED | FrameFlags.CHANGED | FrameFlags.REFUSED | FrameFlags.STATUS
    assert int(device) == 15
    assert not device & (FrameFlags.INVALID | FrameFlags.LOST)
    assert int(FrameFlags.INVALID | FrameFlags.LOST) >= 256
