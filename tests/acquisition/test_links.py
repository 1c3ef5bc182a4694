"""Links: the real one against stand-ins for its libraries, recorded ones, and opening by name."""

from __future__ import annotations

import importlib
import logging
import sys
import threading
import time
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from acquisition import links
from acquisition.capture import Capture, Refused, capture
from acquisition.dat import numbered, write_dat
from acquisition.frames import Frame, FrameFlags
from acquisition.links import (
    Link,
    LinkError,
    LinkUnavailable,
    ReplayLink,
    SpiLink,
    open_link,
    open_replay,
    open_spi,
    pause,
)
from acquisition.protocol import Command, Mode
from acquisition.session import Metadata, SessionWriter
from acquisition.tables import csv_writer
from tests.acquisition.fake_mcu import FakeMcu, elements_at

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

ORIGINAL = Command(100, 30000, 3)
STREAM = Command(100, 20000, 6, Mode.STREAM, [{0: 50}, {1: 60}, {}])


# --- by name


def test_links_are_found_by_name() -> None:
    with pytest.raises(LinkUnavailable, match=r"no link 'nonsense'; available: .*replay.*spi"):
        open_link("nonsense")


def test_link_of_another_package(monkeypatch: pytest.MonkeyPatch) -> None:
    point = SimpleNamespace(
        name="mine", load=lambda: lambda argument, **options: (argument, options)
    )
    monkeypatch.setattr("importlib.metadata.entry_points", lambda group: [point][: len(group)])
    found: object = open_link("mine", "here", speed=3)
    assert found == ("here", {"speed": 3})

    def missing() -> None:
        raise ImportError("No module named 'unicorn'")

    point.load = missing
    with pytest.raises(LinkUnavailable, match=r"unicorn.*pip install 'linetrack\[mine\]'"):
        open_link("mine")


def test_time_passes_on_the_links_own_clock() -> None:
    link = FakeMcu()
    before = time.monotonic()
    pause(link, 60)
    assert time.monotonic() - before < 10
    assert link.now == pytest.approx(60)
    assert isinstance(link, Link)


# --- SPI


class Spidev:
    """Stand-in for the module spidev."""

    def __init__(self, error: OSError | None = None) -> None:
        self.error = error
        self.opened: tuple[int, int] | None = None
        self.closed = 0
        self.fails = False

    def SpiDev(self) -> Spidev:
        return self

    def open(self, bus: int, device: int) -> None:
        if self.error is not None:
            raise self.error
        self.opened = (bus, device)

    def xfer3(self, tx: bytes, speed: int) -> tuple[int, ...]:
        if self.fails:
            raise OSError(90, "Message too long")
        assert speed == self.max_speed_hz
        return tuple(reversed(tx))

    def close(self) -> None:
        self.closed += 1

    max_speed_hz = mode = bits_per_word = -1


class Gpio:
    """Stand-in for the module RPi.GPIO."""

    BCM, IN, PUD_DOWN, RISING = 11, 1, 21, 31

    def __init__(self) -> None:
        self.level = 0
        self.callback: Callable[[int], None] | None = None
        self.looks = 0
        self.no_edges: Exception | None = None
        self.no_access: Exception | None = None
        self.cleaned: list[int] = []
        self.on_look: Callable[[], None] = lambda: None

    def setwarnings(self, on: bool) -> None:
        assert on is False

    def setmode(self, mode: int) -> None:
        assert mode == self.BCM

    def setup(self, pin: int, direction: int, pull_up_down: int) -> None:
        assert (direction, pull_up_down) == (self.IN, self.PUD_DOWN)
        if self.no_access:
            raise self.no_access
        self.pin = pin

    def add_event_detect(self, pin: int, edge: int, callback: Callable[[int], None]) -> None:
        assert (pin, edge) == (self.pin, self.RISING)
        if self.no_edges:
            raise self.no_edges
        self.callback = callback

    def input(self, pin: int) -> int:
        assert pin == self.pin
        self.looks += 1
        level = self.level
        self.on_look()
        return level

    def rise(self) -> None:
        self.level = 1
        assert self.callback is not None
        self.callback(self.pin)

    def cleanup(self, pin: int) -> None:
        self.cleaned.append(pin)


@pytest.fixture
def pi(monkeypatch: pytest.MonkeyPatch) -> tuple[Spidev, Gpio]:
    spidev, gpio = Spidev(), Gpio()
    monkeypatch.setitem(sys.modules, "spidev", spidev)
    monkeypatch.setitem(sys.modules, "RPi", SimpleNamespace(GPIO=gpio))
    monkeypatch.setitem(sys.modules, "RPi.GPIO", gpio)
    return spidev, gpio


def test_spi_link(pi: tuple[Spidev, Gpio]) -> None:
    spidev, gpio = pi
    with open_spi("/dev/spidev1.2", speed=8e6, ready_pin=22) as link:
        assert spidev.opened == (1, 2)
        assert (spidev.mode, spidev.bits_per_word, spidev.max_speed_hz) == (0, 8, 8_000_000)
        assert gpio.pin == 22
        assert link.transfer(b"abc") == b"cba"
        assert isinstance(link, Link)
    link.close()
    assert (spidev.closed, gpio.cleaned) == (1, [22])
    for call in (lambda: link.transfer(b""), lambda: link.wait_ready(0)):
        with pytest.raises(LinkError, match="closed"):
            call()


def test_level_counts_before_any_edge(pi: tuple[Spidev, Gpio]) -> None:
    _, gpio = pi
    link = SpiLink()
    gpio.level = 1
    assert link.wait_ready(0)
    assert gpio.looks == 1


def test_no_edge_is_lost_between_looking_and_waiting(pi: tuple[Spidev, Gpio]) -> None:
    _, gpio = pi
    link = SpiLink()
    gpio.on_look = lambda: gpio.rise() if gpio.looks == 1 else None  # just after the look
    before = time.monotonic()
    assert link.wait_ready(30)
    assert time.monotonic() - before < 10


def test_an_edge_of_before_does_not_count_but_a_short_pulse_does(pi: tuple[Spidev, Gpio]) -> None:
    _, gpio = pi
    link = SpiLink()
    gpio.rise()
    gpio.level = 0
    assert not link.wait_ready(0.01)

    def pulse() -> None:
        gpio.rise()
        gpio.level = 0

    gpio.on_look = pulse
    assert link.wait_ready(30)


def test_an_edge_wakes(pi: tuple[Spidev, Gpio]) -> None:
    _, gpio = pi
    link = SpiLink()
    timer = threading.Timer(0.05, gpio.rise)
    timer.start()
    assert link.wait_ready(30)
    timer.join()
    assert gpio.looks <= 2  # it did not have to poll


def test_polling_where_there_are_no_edges(
    pi: tuple[Spidev, Gpio], caplog: pytest.LogCaptureFixture
) -> None:
    _, gpio = pi
    gpio.no_edges = RuntimeError("Failed to add edge detection")
    with caplog.at_level(logging.INFO):
        link = SpiLink()
    assert "polling" in caplog.text
    assert not link.wait_ready(0.05)
    assert gpio.looks > 2
    gpio.level = 1
    assert link.wait_ready(0)


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (FileNotFoundError(2, "No such file"), r"raspi-config.*dtparam=spi=on.*--link twin"),
        (PermissionError(13, "Permission denied"), r"usermod -aG spi,gpio"),
        (OSError(16, "Device busy"), "Device busy"),
    ],
)
def test_device_that_cannot_be_opened(pi: tuple[Spidev, Gpio], error: OSError, words: str) -> None:
    pi[0].error = error
    with pytest.raises(LinkUnavailable, match=words):
        SpiLink()


class LgpioError(Exception):
    """As lgpio.error: none of Python's own."""


BUSY = LgpioError("'GPIO busy'")


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (RuntimeError("No access to /dev/mem.  Try running as root!"), "usermod -aG gpio"),
        (BUSY, "GPIO 18 .*GPIO busy.*is another program using it"),
        (
            RuntimeError("Cannot determine SOC peripheral base address"),
            r"pip uninstall RPi\.GPIO.*pip install rpi-lgpio",
        ),
    ],
)
def test_input_that_cannot_be_read(pi: tuple[Spidev, Gpio], error: Exception, words: str) -> None:
    spidev, gpio = pi
    gpio.no_access = error
    with pytest.raises(LinkUnavailable, match=words):
        SpiLink()
    assert spidev.closed == 1


def test_input_that_somebody_else_takes(pi: tuple[Spidev, Gpio]) -> None:
    spidev, gpio = pi
    gpio.no_edges = BUSY
    with pytest.raises(LinkUnavailable, match="is another program using it"):
        SpiLink()
    assert spidev.closed == 1
    gpio.no_edges = None
    link = SpiLink()

    def fail() -> None:
        raise BUSY

    gpio.on_look = fail
    with pytest.raises(LinkError, match=r"GPIO 18 .*is another program using it"):
        link.wait_ready(1)


def test_transfer_that_fails(pi: tuple[Spidev, Gpio]) -> None:
    link = SpiLink()
    pi[0].fails = True
    with pytest.raises(LinkError, match=r"7388 bytes failed.*Message too long"):
        link.transfer(bytes(7388))


@pytest.mark.usefixtures("pi")
@pytest.mark.parametrize("name", ["spidev", "RPi.GPIO"])
@pytest.mark.parametrize("error", [ImportError("none"), RuntimeError("not on a Raspberry Pi!")])
def test_library_that_is_missing(
    monkeypatch: pytest.MonkeyPatch, name: str, error: Exception
) -> None:
    plain = importlib.import_module

    def fail(wanted: str) -> Any:
        if wanted == name:
            raise error
        return plain(wanted)

    monkeypatch.setattr(importlib, "import_module", fail)
    with pytest.raises(LinkUnavailable, match=rf"{name} .*--link twin"):
        SpiLink()


def test_options_of_the_spi_link() -> None:
    with pytest.raises(ValueError, match="up to 16000000"):
        SpiLink(speed=20e6)
    with pytest.raises(ValueError, match="BCM"):
        SpiLink(ready_pin=40)
    with pytest.raises(LinkUnavailable, match=r"such as 0\.0"):
        open_spi("COM3")


def test_bufsiz(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(links, "_BUFSIZ", tmp_path / "bufsiz")
    assert links.bufsiz() == 4096
    (tmp_path / "bufsiz").write_text("8192\n")
    assert links.bufsiz() == 8192


# --- recordings


def recorded(command: Command) -> list[Frame]:
    return list(capture(FakeMcu(), command))


def same(found: list[Frame], wanted: list[Frame]) -> None:
    assert len(found) == len(wanted)
    for one, other in zip(found, wanted, strict=True):
        np.testing.assert_array_equal(one.elements, other.elements)
        assert one.leds == other.leds
        assert one.sh_period == other.sh_period


def test_replay_of_original_mode() -> None:
    frames = recorded(ORIGINAL)
    with ReplayLink(frames) as link:
        same(list(capture(link, ORIGINAL)), frames)
        assert list(capture(link, ORIGINAL)) == []
    with pytest.raises(LinkError, match="recorded with -s 100 -i 30000"):
        list(capture(ReplayLink(frames), Command(200, 30000, 2)))


def test_replay_of_stream_mode() -> None:
    frames = recorded(STREAM)
    found = list(capture(ReplayLink(frames), STREAM))
    same(found, frames)
    assert [f.timestamp for f in found] == [f.timestamp for f in frames]
    assert [f.exposures for f in found] == [f.exposures for f in frames]
    same(list(capture(ReplayLink(frames), ORIGINAL_AS_STREAM)), frames[:3])
    source = Capture(ReplayLink(frames), STREAM)
    next(source)
    source.send([{9: 50}])
    assert [dict(f.exposures) for f in source][-1] == {}  # it cannot light what was not lit
    assert source.status is not None
    assert source.status.firmware == "replay"


ORIGINAL_AS_STREAM = Command(50, 20000, 3, Mode.STREAM)


def test_replay_in_circles_and_in_real_time() -> None:
    frames = recorded(STREAM)
    many = Command(100, 20000, 20, Mode.STREAM)
    same(list(capture(ReplayLink(frames, loop=True), many))[:6], frames)
    before = time.monotonic()
    list(capture(ReplayLink(frames, realtime=True), STREAM))
    assert time.monotonic() - before >= 5 * 5e-3


def test_replay_refuses_like_the_device() -> None:
    link = ReplayLink(recorded(STREAM))
    broken = bytearray(STREAM.encode())
    broken[20] ^= 1
    link.transfer(bytes(broken))
    source = Capture(link, STREAM)
    same(list(source), recorded(STREAM))
    streaming = ReplayLink(recorded(STREAM))
    streaming.transfer(STREAM.encode())
    assert streaming.wait_ready(0)
    streaming.transfer(bytes(7424))
    assert streaming.wait_ready(0)
    streaming.transfer(bytes(broken).ljust(7424, b"\0"))
    assert streaming.wait_ready(0)
    assert streaming.transfer(bytes(7424))[3] & FrameFlags.REFUSED
    with pytest.raises(LinkError, match="3 bytes"):
        link.transfer(b"abc")
    assert issubclass(Refused, LinkError)


def test_replay_of_files(tmp_path: Path) -> None:
    frames = recorded(ORIGINAL)
    prefix = tmp_path / "output"
    for number, frame in enumerate(frames, 1):
        write_dat(numbered(prefix, number), frame)
    with SessionWriter(tmp_path / "run.h5") as writer:
        writer.append(frames)
    with csv_writer(tmp_path / "run.csv") as write:
        for frame in frames:
            write(frame)
    for name in ("run.h5", "run.csv"):
        same(list(capture(open_replay(str(tmp_path / name)), ORIGINAL)), frames)
    unlit = [frame.replaced(leds=0) for frame in frames]  # such files do not tell
    same(list(capture(open_replay(str(prefix)), ORIGINAL)), unlit)
    one = Command(100, 30000, 1)
    (found,) = capture(open_replay(str(numbered(prefix, 2))), one)
    np.testing.assert_array_equal(found.elements, frames[1].elements)


def test_replay_of_a_session_tells_what_it_was_recorded_with(tmp_path: Path) -> None:
    frames = recorded(STREAM)
    about = Metadata(firmware_build="build 7", lens_system={"name": "head", "gaps": [1.5]})
    with SessionWriter(tmp_path / "run.h5", about) as writer:
        writer.append(frames)
    with open_replay(str(tmp_path / "run.h5"), loop=True) as link:
        assert link.lens_system == {"name": "head", "gaps": [1.5]}
        assert link.firmware_build == "build 7"
        assert link.recorded is None
        source = Capture(link, STREAM)
        for frame in frames:
            next(source)
            assert link.recorded == frame
        assert source.status is not None
        assert source.status.firmware == "build 7"
    assert ReplayLink(frames).lens_system == {}
    with open_replay(str(tmp_path / "run.h5")) as half:
        assert half.recorded is None  # and closes what it has not read


def test_replay_keeps_the_recordings_clock(tmp_path: Path) -> None:
    slow = Frame(elements_at(0), sh_period=100, icg_period=30000, master_clock=2_000_000)
    write_dat(tmp_path / "slow.dat", slow)
    link = open_replay(str(tmp_path / "slow.dat"))
    (found,) = capture(link, Command(100, 30000, 1))
    assert found.master_clock == 2_000_000
    assert found.integration_time == pytest.approx(50e-6)


def test_replay_needs_a_file(tmp_path: Path) -> None:
    for argument in (None, ""):
        with pytest.raises(LinkUnavailable, match="--link replay FILE"):
            open_replay(argument)
    with pytest.raises(LinkUnavailable, match="No such file"):
        open_replay(str(tmp_path / "none"))
