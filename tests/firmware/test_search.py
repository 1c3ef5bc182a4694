"""The firmware's search for spikes, compiled for this machine, against tracking.onboard."""

from __future__ import annotations

import ctypes
import subprocess
import sys
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from acquisition.frames import ELEMENTS, LEADING, PIXELS, Frame, OnboardSpike
from acquisition.wiring import PROTOCOL
from tests.firmware.builds import FIRMWARE
from tracking.onboard import find_spikes

if TYPE_CHECKING:
    from numpy.typing import NDArray

_CONSTANTS = PROTOCOL.spikes


class _Window(ctypes.Structure):
    _fields_ = (("first", ctypes.c_uint16), ("last", ctypes.c_uint16))


class _Search(ctypes.Structure):
    _fields_ = (
        ("saturated", ctypes.c_uint16),
        ("threshold", ctypes.c_uint16),
        ("count", ctypes.c_uint8),
        ("alone", ctypes.c_bool),
        ("windows", _Window * _CONSTANTS.windows_max),
    )


class _Spike(ctypes.Structure):
    _fields_ = (
        ("position", ctypes.c_uint32),
        ("width", ctypes.c_uint16),
        ("height", ctypes.c_uint16),
        ("flags", ctypes.c_uint8),
        ("window", ctypes.c_uint8),
        ("reserved", ctypes.c_uint8 * 2),
    )


class _Found(ctypes.Structure):
    _fields_ = (
        ("count", ctypes.c_uint8),
        ("window_count", ctypes.c_uint8),
        ("dark", ctypes.c_uint16),
        ("reserved", ctypes.c_uint32),
        ("windows", _Window * _CONSTANTS.windows_max),
        ("spikes", _Spike * _CONSTANTS.spikes_max),
    )


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """Undefined behaviour is fatal, as an index is beyond an array; a pointer that strays is not."""
    target = tmp_path_factory.mktemp("spikes") / "spikes.so"
    subprocess.run(
        (sys.executable, "-m", "ziglang", "cc", "-std=c11", "-O1", "-shared", "-fPIC", "-Wall",
         "-Werror", "-fsanitize=undefined", "-fsanitize-trap=undefined",
         str(FIRMWARE / "spikes.c"), "-o", str(target)),
        check=True,
    )  # fmt: skip
    return ctypes.CDLL(str(target))


Windows = list[tuple[int, int]]


def agree(
    library: Any,
    elements: NDArray[np.uint16],
    windows: Windows,
    saturated: int = 1900,
    threshold: int = 0,
    leds: int = 0,
) -> tuple[OnboardSpike, ...]:
    """Both find the same, to the last bit; what they find."""
    array = (_Window * 8)(*[_Window(*window) for window in windows])
    alone = 0 < leds.bit_count() <= len(windows)
    search = _Search(saturated, threshold, len(windows), alone, array)
    found = _Found()
    ctypes.memset(ctypes.byref(found), 0xA5, ctypes.sizeof(found))
    elements = np.ascontiguousarray(elements)
    library.spikes_find(
        elements.ctypes.data_as(ctypes.c_void_p), ctypes.byref(search), ctypes.byref(found)
    )
    result = tuple(
        OnboardSpike(s.position / 1024, s.width / 16, s.height, s.flags, s.window)
        for s in found.spikes[: found.count]
    )
    frame = Frame(elements, leds=leds)
    expected = find_spikes(frame, windows, saturated=saturated, threshold=threshold)
    assert result == expected.spikes
    assert found.dark / 16 == expected.dark_level
    assert [(w.first, w.last) for w in found.windows[: found.window_count]] == windows
    assert not any(bytes(s) != bytes(12) for s in found.spikes[found.count :])
    return result


def scene(rng: np.random.Generator) -> NDArray[np.uint16]:
    """Spikes of all widths and heights on a background, some over the edge, some saturated."""
    pixels = np.arange(PIXELS)
    light = np.full(PIXELS, rng.choice([0.0, 300.0])) + rng.choice([0.0, 0.05]) * pixels
    for _ in range(rng.integers(0, 12)):
        middle, sigma = rng.uniform(-20, PIXELS + 20), 10 ** rng.uniform(-0.3, 2.3)
        light += 10 ** rng.uniform(0.5, 3.7) * np.exp(-0.5 * ((pixels - middle) / sigma) ** 2)
    light = np.minimum(light, 2060)
    light += rng.normal(0, np.sqrt(2 + np.maximum(light, 0) / 29))
    elements = 3920 + rng.normal(0, 1.5, ELEMENTS)
    elements[LEADING : LEADING + PIXELS] = 3920 - light
    return np.clip(np.rint(elements), 0, 4095).astype(np.uint16)


def some_windows(rng: np.random.Generator) -> Windows:
    """Up to eight that do not overlap, of any lengths and in any order."""
    result: Windows = []
    for _ in range(rng.integers(1, 9)):
        length = min(24 + int(10 ** rng.uniform(0, 3.7)), PIXELS)
        first = int(rng.integers(0, PIXELS - length + 1))
        if all(first > last or first + length <= start for start, last in result):
            result.append((first, first + length - 1))
    return result


def test_scenes(library: Any) -> None:
    rng = np.random.default_rng(2021)
    spikes: list[OnboardSpike] = []
    for n in range(2000):
        windows = [(0, PIXELS - 1)] if n % 2 else some_windows(rng)
        limits = int(rng.choice([0, 1900])), int(rng.choice([0, 100, 2000]))
        spikes += agree(library, scene(rng), windows, *limits, leds=int(rng.choice([0, 1, 31])))
    flags = [spike.flags for spike in spikes]
    assert len(spikes) > 3000
    for flag in _CONSTANTS.flags.values():  # none of them went untested
        assert sum(found & flag > 0 for found in flags) > 50
    assert sum(found == 0 for found in flags) > 500


def test_any_values(library: Any) -> None:
    """Noise from end to end has hundreds of peaks."""
    rng = np.random.default_rng(7)
    for _ in range(300):
        elements = rng.integers(0, 4096, ELEMENTS).astype(np.uint16)
        agree(library, elements, some_windows(rng), int(rng.integers(4096)))
        agree(library, np.sort(elements)[:: rng.choice([-1, 1])], [(0, PIXELS - 1)])


@given(
    st.integers(0, 4095),
    st.lists(
        st.tuples(st.integers(0, PIXELS), st.integers(1, PIXELS), st.integers(0, 4095)),
        max_size=12,
    ),
    st.integers(0, PIXELS - 24),
    st.integers(24, PIXELS),
    st.integers(0, 4095),
)
@settings(max_examples=300)
def test_steps(
    library: Any,
    level: int,
    steps: list[tuple[int, int, int]],
    first: int,
    length: int,
    threshold: int,
) -> None:
    """Flat from edge to edge, so that ties and zero slopes are everywhere."""
    elements = np.full(ELEMENTS, level, np.uint16)
    for start, extent, value in steps:
        elements[LEADING + start : LEADING + min(start + extent, PIXELS)] = value
    window = (first, min(first + length, PIXELS) - 1)
    agree(library, elements, [window], 1900, threshold, leds=1)
    agree(library, elements, [(0, PIXELS - 1)], 1900, threshold, leds=1)


def test_spikes_at_the_end_of_the_line_are_compared_where_they_are_said_to_be(library: Any) -> None:
    """A weak one that ends with the last pixel, four widths from a strong one."""
    rng = np.random.default_rng(3)
    pixels = np.arange(PIXELS)
    flags = []
    for _ in range(300):
        width = rng.uniform(8, 30)
        middle = PIXELS - 1 - 4 * width + rng.uniform(-1, 1)
        light = 100 + 1500 * np.exp(-4 * np.log(2) * ((pixels - middle) / width) ** 2)
        light[-2:] = 0, rng.uniform(300, 600)
        elements = np.full(ELEMENTS, 3900.0)
        elements[LEADING : LEADING + PIXELS] -= light
        codes = np.rint(elements).astype(np.uint16)
        flags.append(agree(library, codes, [(0, PIXELS - 1)], leds=1)[0].flags)
    assert set(flags) == {0, _CONSTANTS.flags["reflection"]}


@pytest.mark.parametrize("length", range(96, 104))
def test_no_pixel_of_a_window_is_blind(library: Any, length: int) -> None:
    for middle in range(1002, 1000 + length - 2):
        elements = np.full(ELEMENTS, 3900.0)
        light = 1000 * np.exp(-4 * np.log(2) * ((np.arange(PIXELS) - middle - 0.3) / 3) ** 2)
        elements[LEADING : LEADING + PIXELS] -= light
        (spike,) = agree(library, np.rint(elements).astype(np.uint16), [(1000, 1000 + length - 1)])
        assert spike.position == pytest.approx(middle + 0.3, abs=0.2)
