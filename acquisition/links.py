"""Links to the microcontroller, real, virtual or recorded: everything above them is the same.

A link is opened by its name, `open_link`; packages add their own through entry points of the group
``linetrack.links``, each naming a function ``factory(argument, **options) -> Link``.
"""

from __future__ import annotations

import importlib
import logging
import re
import threading
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Protocol, Self, runtime_checkable

from acquisition.frames import MASTER_CLOCK, Frame, FrameFlags
from acquisition.protocol import (
    ORIGINAL_SIZE,
    STREAM_SIZE,
    BadMagic,
    Command,
    CommandError,
    Mode,
    Refusal,
    Status,
    encode_elements,
    encode_frame,
    encode_status,
)
from acquisition.wiring import PROTOCOL

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping
    from types import TracebackType

GROUP: Final = "linetrack.links"
"""The group of entry points that links are found by."""
SPI_CLOCK: Final = 15_600_000
"""Clock of the real link, Hz: the 16 MHz that the device stands, as a Raspberry Pi divides it."""
READY_PIN: Final = 18
"""GPIO of the Raspberry Pi (BCM number) that the handshake is wired to."""

_SPI_CLOCK_MAX: Final = PROTOCOL.spi_clock_max
_BUFSIZ: Final = Path("/sys/module/spidev/parameters/bufsiz")
_POLL: Final = 1e-4  # s

_log = logging.getLogger(__name__)


class LinkError(RuntimeError):
    """The link does not work; the message says what to do."""


class LinkUnavailable(LinkError):  # noqa: N818
    """The link cannot be opened here: a library, a device or a permission is missing."""


class LinkTimeout(LinkError):  # noqa: N818
    """The device does not answer, in spite of repeated commands."""


class LinkEnded(LinkError):  # noqa: N818
    """Nothing more will come: the recording is at its end."""


@runtime_checkable
class Link(Protocol):
    """The wires between host and microcontroller.

    A link may also have ``sleep(seconds)``, where time is not the host's, ``master_clock`` (Hz),
    where the sensor's differs from the prototype's, and ``lens_system``, a mapping that JSON can
    hold with at least a ``name``, where it knows the head in front of the sensor; see `pause`. One
    that sends what was recorded has ``recorded``, the `Frame` last transferred (None if it was
    none): LEDs, exposures and timestamp are taken from there.
    """

    def wait_ready(self, timeout: float) -> bool:
        """Wait until the handshake line is high, at most `timeout` s; return whether it is.

        The level is looked at before anything is waited for: a line that is high already counts.
        """
        ...

    def transfer(self, tx: bytes) -> bytes:
        """Clock the bytes out and return as many that came in meanwhile."""
        ...

    def close(self) -> None:
        """Give the link back; a second call does nothing."""
        ...

    def __enter__(self) -> Self: ...

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None: ...


def pause(link: Link, seconds: float) -> None:
    """Let time pass on the link's own clock: virtual where the link has ``sleep``, else real."""
    sleep: Callable[[float], None] = getattr(link, "sleep", time.sleep)
    sleep(seconds)


class _Closing:
    """`with link:` closes it."""

    def close(self) -> None:
        """Give the link back; a second call does nothing."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()


def open_link(name: str, argument: str | None = None, **options: Any) -> Link:
    """Open a link by its name.

    Parameters
    ----------
    name : str
        Of an entry point: "spi", "replay", "twin" where they are installed.
    argument : str, optional
        What the link needs to know, such as a device or a file.
    **options
        For the link's factory.

    Returns
    -------
    Link

    Raises
    ------
    LinkUnavailable
        There is no link of this name, or it cannot be opened here.
    """
    from importlib.metadata import entry_points

    points = {point.name: point for point in entry_points(group=GROUP)}
    if name not in points:
        known = ", ".join(sorted(points)) or "none: install linetrack with pip"
        raise LinkUnavailable(f"there is no link {name!r}; available: {known}")
    try:
        factory = points[name].load()
    except ImportError as error:
        raise LinkUnavailable(
            f"the link {name!r} cannot be loaded ({error}): pip install 'linetrack[{name}]'"
        ) from error
    link: Link = factory(argument, **options)
    return link


# --- the real one ---------------------------------------------------------------------------------


class SpiLink(_Closing):
    """SPI of a Raspberry Pi, with the handshake on one of its inputs.

    Transfers go through spidev's ``xfer3``, which cuts them into pieces of the kernel module's
    ``bufsiz``; the firmware looks at no chip select. A pause between two pieces of more than 1 ms
    costs a frame in stream mode: ``spidev.bufsiz=8192`` in the kernel's command line avoids it.

    Edges of the handshake only wake the waiting program; what counts is the line's level. Edge
    detection is armed for as long as the link is open, so that no edge falls between looking at
    the level and waiting. Where the kernel refuses it, the level is polled every 0.1 ms.

    Parameters
    ----------
    bus, device : int
        ``/dev/spidev<bus>.<device>``.
    speed : float
        Largest clock, Hz; the Pi takes the next lower one that it can make.
    ready_pin : int
        BCM number of the input that the handshake is wired to.

    Raises
    ------
    LinkUnavailable
        Says what is missing, and how to get it.
    """

    def __init__(
        self,
        bus: int = 0,
        device: int = 0,
        *,
        speed: float = SPI_CLOCK,
        ready_pin: int = READY_PIN,
    ) -> None:
        if not 0 < speed <= _SPI_CLOCK_MAX:
            raise ValueError(
                f"speed = {speed:g} Hz: allowed is > 0 up to {_SPI_CLOCK_MAX}; was MHz given?"
            )
        if isinstance(ready_pin, bool) or not 0 <= ready_pin <= 27:
            raise ValueError(
                f"ready_pin = {ready_pin}: allowed are the BCM numbers 0 to 27; was the number of "
                "the header's pin given?"
            )
        self.speed = int(speed)
        self.ready_pin = ready_pin
        self._edge = threading.Event()
        self._polling = False
        self._spi = self._gpio = None
        path = f"/dev/spidev{bus}.{device}"
        spidev = _module("spidev", "spidev")
        gpio = _module("RPi.GPIO", "rpi-lgpio")
        try:
            self._spi = _opened(spidev, bus, device, path)
            self._spi.mode = 0
            self._spi.bits_per_word = 8
            self._spi.max_speed_hz = self.speed
            self._gpio = gpio
            self._listen()
        except BaseException as error:
            self.close()
            if isinstance(error, OSError):
                raise LinkUnavailable(f"{path} cannot be set up: {error}") from error
            raise
        size = bufsiz()
        if size < STREAM_SIZE:
            _log.info(
                "spidev's bufsiz is %d: transfers are cut into pieces; spidev.bufsiz=8192 in "
                "/boot/firmware/cmdline.txt makes streaming safer",
                size,
            )

    def _listen(self) -> None:
        gpio: Any = self._gpio
        try:
            gpio.setwarnings(False)
            gpio.setmode(gpio.BCM)
            gpio.setup(self.ready_pin, gpio.IN, pull_up_down=gpio.PUD_DOWN)
        except Exception as error:  # rpi-lgpio's is none of Python's own
            raise LinkUnavailable(self._unreadable(error)) from error
        try:
            gpio.add_event_detect(self.ready_pin, gpio.RISING, callback=self._risen)
        except RuntimeError as error:
            self._polling = True
            _log.info("no edge detection (%s): polling; rpi-lgpio can do it on new kernels", error)
        except Exception as error:
            raise LinkUnavailable(self._unreadable(error)) from error

    def _unreadable(self, error: Exception) -> str:
        if "peripheral base address" in str(error):
            return (
                f"RPi.GPIO does not know this Raspberry Pi ({error}), a model 5 or later: replace "
                "it with 'pip uninstall RPi.GPIO' and 'pip install rpi-lgpio'"
            )
        return (
            f"GPIO {self.ready_pin} cannot be read ({error}): add yourself to its group with "
            "'sudo usermod -aG gpio $USER' and log in again; is another program using it?"
        )

    def _risen(self, _: int) -> None:
        self._edge.set()

    def wait_ready(self, timeout: float) -> bool:
        """Wait until the handshake line is high, at most `timeout` s; return whether it is."""
        gpio, pin = self._open_gpio(), self.ready_pin
        end = time.monotonic() + timeout
        while True:
            self._edge.clear()
            if self._level(gpio, pin):
                return True
            left = end - time.monotonic()
            if left <= 0:
                return False
            if self._polling:
                time.sleep(min(_POLL, left))
            elif self._edge.wait(left):
                return True  # the published firmware's pulse may be over by now

    def _level(self, gpio: Any, pin: int) -> bool:
        try:
            return bool(gpio.input(pin))
        except Exception as error:
            raise LinkError(self._unreadable(error)) from error

    def _open_gpio(self) -> Any:
        if self._gpio is None:
            raise LinkError("the link is closed")
        return self._gpio

    def transfer(self, tx: bytes) -> bytes:
        """Clock the bytes out and return as many that came in meanwhile."""
        if self._spi is None:
            raise LinkError("the link is closed")
        try:
            return bytes(self._spi.xfer3(tx, self.speed))
        except OSError as error:
            raise LinkError(f"the SPI transfer of {len(tx)} bytes failed: {error}") from error

    def close(self) -> None:
        """Give device and input back; a second call does nothing."""
        spi, self._spi = self._spi, None
        gpio, self._gpio = self._gpio, None
        try:
            if gpio is not None:
                gpio.cleanup(self.ready_pin)
        finally:
            if spi is not None:
                spi.close()


def bufsiz() -> int:
    """Longest message that the kernel's spidev takes, bytes; 4096, its default, if unknown."""
    try:
        return int(_BUFSIZ.read_text(encoding="ascii"))
    except (OSError, ValueError):
        return 4096


def _module(name: str, package: str) -> Any:
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise LinkUnavailable(
            f"{name} is not installed: 'pip install {package}' on the Raspberry Pi; without one, "
            "use --link twin"
        ) from error
    except RuntimeError as error:  # RPi.GPIO's way to say where it is
        raise LinkUnavailable(
            f"{name} does not work here ({error}): the link spi needs a Raspberry Pi; without one, "
            "use --link twin"
        ) from error


def _opened(spidev: Any, bus: int, device: int, path: str) -> Any:
    spi = spidev.SpiDev()
    try:
        spi.open(bus, device)
    except FileNotFoundError as error:
        raise LinkUnavailable(
            f"{path} does not exist: switch SPI on with 'sudo raspi-config' (Interface Options), "
            "or dtparam=spi=on in /boot/firmware/config.txt (/boot/config.txt before 2023), and "
            "restart; without a Raspberry Pi, use --link twin"
        ) from error
    except PermissionError as error:
        raise LinkUnavailable(
            f"{path} may not be used: add yourself to its group with "
            "'sudo usermod -aG spi,gpio $USER' and log in again"
        ) from error
    except OSError as error:
        raise LinkUnavailable(f"{path} cannot be opened: {error}") from error
    return spi


def open_spi(argument: str | None = None, **options: Any) -> SpiLink:
    """Open the real link.

    Parameters
    ----------
    argument : str, optional
        The device as ``0.0`` (bus and chip select; the default) or ``/dev/spidev0.0``.
    **options
        `speed` (Hz) and `ready_pin` (BCM number) of `SpiLink`.
    """
    match = re.fullmatch(r"(?:/dev/spidev)?(\d{1,3})\.(\d{1,3})", argument or "0.0")
    if match is None:
        raise LinkUnavailable(
            f"{argument!r} names no SPI device: give bus and chip select, such as 0.0; a file needs "
            "--link twin or --link replay"
        )
    return SpiLink(int(match[1]), int(match[2]), **options)


# --- recorded ones --------------------------------------------------------------------------------


class ReplayLink(_Closing):
    """Frames from a recording, sent again as the device would send them.

    Commands are answered in original and in stream mode. In original mode the host believes its
    own command, so one with other periods than the recording's is an error there; in stream mode
    each frame tells its own.

    Parameters
    ----------
    frames : iterable of Frame
        Taken one by one, as they are asked for.
    loop : bool, optional
        Begin again at the end; the frames are then kept in memory.
    realtime : bool, optional
        Take as long as the recording did (by its ICG period), for looking at it.
    firmware_build : str, optional
        Of the device recorded; it is what the answers to commands name.
    lens_system : mapping, optional
        Description of the lens head recorded with.

    Attributes
    ----------
    recorded : Frame or None
        What was transferred last, as it was recorded; None if that was no frame.

    Raises
    ------
    LinkEnded
        From `wait_ready`, when all frames have been sent.
    """

    def __init__(
        self,
        frames: Iterable[Frame],
        *,
        loop: bool = False,
        realtime: bool = False,
        firmware_build: str = "replay",
        lens_system: Mapping[str, Any] | None = None,
    ) -> None:
        self.firmware_build = firmware_build
        self.lens_system = dict(lens_system or {})
        self.recorded: Frame | None = None
        self._offered: Frame | None = None
        self._frames = _looped(frames) if loop else iter(frames)
        self._next = next(self._frames, None)
        self.master_clock = MASTER_CLOCK if self._next is None else self._next.master_clock
        self._realtime = realtime
        self._mode = Mode.ORIGINAL
        self._answer: bytes | None = None
        self._left: float = 0
        self._flags = FrameFlags.NONE  # of the next frame
        self._periods = (0, 0)
        self._number = 0

    def wait_ready(self, timeout: float) -> bool:
        """Tell whether a frame (or an answer) is there."""
        if self._answer is not None:
            return True
        if self._left <= 0:
            self.sleep(timeout)
            return False
        if self._next is None:
            raise LinkEnded(f"the recording has ended after {self._number} frames")
        self.sleep(self._next.icg_period / self._next.master_clock)
        self._answer, self._offered = self._encoded(self._next), self._next
        self._next = next(self._frames, None)
        self._number += 1
        self._left -= 1
        return True

    def sleep(self, seconds: float) -> None:
        """Let time pass: real time if the replay is in real time, else none."""
        if self._realtime:
            time.sleep(seconds)

    def _encoded(self, frame: Frame) -> bytes:
        if self._mode is Mode.ORIGINAL:
            periods = (frame.sh_period, frame.icg_period)
            if any(periods) and periods != self._periods:
                raise LinkError(
                    f"this was recorded with -s {periods[0]} -i {periods[1]}; give the same, not "
                    f"-s {self._periods[0]} -i {self._periods[1]}"
                )
            return encode_elements(frame)
        flags, self._flags = frame.flags | self._flags, FrameFlags.NONE
        return encode_frame(replace(frame, flags=flags))

    def transfer(self, tx: bytes) -> bytes:
        """Return the frame that is there (zeros if none), and take the command in `tx`."""
        size = STREAM_SIZE if self._mode is Mode.STREAM else ORIGINAL_SIZE
        if len(tx) not in (ORIGINAL_SIZE, STREAM_SIZE):
            raise LinkError(f"{len(tx)} bytes: transfers have {size} in this mode")
        rx = (self._answer or b"").ljust(len(tx), b"\0")[: len(tx)]
        self.recorded, self._answer, self._offered = self._offered, None, None
        try:
            self._take(Command.decode(tx))
        except BadMagic:
            pass
        except CommandError as error:
            self._refuse(error.refusal)
        return rx

    def _take(self, command: Command) -> None:
        if command.mode is Mode.SPIKES:
            raise LinkError(
                "a recording has pixels, but no firmware that looks for spikes in them: replay it "
                "in stream mode"
            )
        self._periods = (command.sh_period, command.icg_period)
        streaming = self._mode is Mode.STREAM and self._left > 0
        self._mode = command.mode
        self._left = command.count or float("inf")
        self._flags = FrameFlags.CHANGED
        if command.mode is Mode.STREAM and not streaming:
            self._answer = self._status(Refusal.NONE)

    def _refuse(self, refusal: Refusal) -> None:
        if self._mode is Mode.STREAM and self._left > 0:
            self._flags |= FrameFlags.REFUSED
        elif self._mode is Mode.STREAM or refusal is not Refusal.PERIODS:
            self._mode = Mode.STREAM
            self._answer = self._status(refusal)

    def _status(self, refusal: Refusal) -> bytes:
        frame = self._next
        sh, icg = (frame.sh_period, frame.icg_period) if frame else (0, 0)
        return encode_status(Status(refusal, self.firmware_build, sh, icg))

    def close(self) -> None:
        """Close the recording; a second call does nothing."""
        close: Callable[[], None] = getattr(self._frames, "close", lambda: None)
        close()


def _looped(frames: Iterable[Frame]) -> Iterator[Frame]:
    kept = list(frames)
    while kept:
        yield from kept


def open_replay(argument: str | None = None, **options: Any) -> ReplayLink:
    """Open a recording as a link.

    Parameters
    ----------
    argument : str
        A session (HDF5), a `.csv` or `.dat` file, or the prefix of numbered `.dat` files (``output`` for
        ``output00001.dat`` and so on).
    **options
        `loop` and `realtime` of `ReplayLink`.

    Raises
    ------
    LinkUnavailable
        No file is named, or it cannot be read.
    """
    if not argument:
        raise LinkUnavailable("the link replay needs a recording: --link replay FILE")
    path = Path(argument)
    first = Path(f"{argument}00001.dat")
    try:
        if not path.is_file() and first.is_file():
            return ReplayLink(_numbered(argument), **options)
        with path.open("rb") as file:
            start = file.read(4)
        if start == b"\x89HDF":
            return _session(path, options)
        if path.suffix.lower() == ".csv":
            from acquisition.tables import read_csv

            return ReplayLink(read_csv(path), **options)
        return ReplayLink(_dat([path]), **options)
    except OSError as error:
        raise LinkUnavailable(f"{argument} cannot be read: {error.strerror or error}") from error


def _session(path: Path, options: Mapping[str, Any]) -> ReplayLink:
    from acquisition.session import open_session

    session = open_session(path)
    about = session.metadata

    def frames() -> Iterator[Frame]:
        with session:
            yield from session

    return ReplayLink(
        frames(), firmware_build=about.firmware_build, lens_system=about.lens_system, **options
    )


def _numbered(prefix: str) -> Iterator[Frame]:
    def files() -> Iterator[Path]:
        number = 1
        while (path := Path(f"{prefix}{number:05d}.dat")).is_file():
            yield path
            number += 1

    return _dat(files())


def _dat(paths: Iterable[Path]) -> Iterator[Frame]:
    from acquisition.dat import read_dat

    for number, path in enumerate(paths):
        yield replace(read_dat(path), sequence=number)
