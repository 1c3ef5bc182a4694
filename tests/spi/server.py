"""Serves a device to programs whose /dev/spidev and RPi.GPIO are replaced (shim.c, RPi/GPIO.py).

Requests on the Unix socket: from the shim, ``S`` (settings) and ``T`` (transfer); from the GPIO
stand-in, ``W`` (wait for the handshake so many µs, then tell its level). Time is the device's own.
"""

from __future__ import annotations

import importlib.util
import os
import shutil
import socket
import struct
import subprocess
import sys
import threading
from pathlib import Path
from typing import TYPE_CHECKING, Protocol, Self

if TYPE_CHECKING:
    from types import TracebackType

HERE = Path(__file__).parent
FLAGS = ("-O1", "-Wall", "-Wextra", "-Werror", "-shared", "-fPIC", "-U_FORTIFY_SOURCE")


class Device(Protocol):
    """What is served: a `Link`, or anything that has the same two methods."""

    def wait_ready(self, timeout: float) -> bool: ...

    def transfer(self, tx: bytes) -> bytes: ...


class SpiServer:
    """Serve a device on a socket in a thread, until closed.

    Parameters
    ----------
    device : Device
    folder : Path
        Where the socket is put.

    Attributes
    ----------
    sizes : list of int
        Bytes of each transfer as the driver was asked for it.
    settings : set of tuple of int
        (mode, Hz, bits per word) of the transfers.
    """

    def __init__(self, device: Device, folder: Path) -> None:
        self.device = device
        self.path = folder / "spi"
        self.sizes: list[int] = []
        self.settings: set[tuple[int, ...]] = set()
        self.error: BaseException | None = None
        self._lock = threading.Lock()
        self._socket = socket.socket(socket.AF_UNIX)
        self._socket.bind(str(self.path))
        self._socket.listen()
        self._threads = [threading.Thread(target=self._accept)]
        self._threads[0].start()

    def _accept(self) -> None:
        while True:
            try:
                connection, _ = self._socket.accept()
            except OSError:
                return
            thread = threading.Thread(target=self._serve, args=(connection,))
            self._threads.append(thread)
            thread.start()

    def _serve(self, connection: socket.socket) -> None:
        with connection, connection.makefile("rb") as stream:
            while kind := stream.read(4):
                try:
                    with self._lock:
                        connection.sendall(self._answer(kind[:1], stream))
                except BaseException as error:  # noqa: BLE001  (raised by close)
                    self.error = error
                    return

    def _answer(self, kind: bytes, stream: object) -> bytes:
        read = stream.read  # type: ignore[attr-defined]
        if kind == b"S":
            self.settings.add(struct.unpack("<III", read(12)))
            return b""
        (number,) = struct.unpack("<I", read(4))
        if kind == b"W":
            return bytes([self.device.wait_ready(number * 1e-6)])
        self.sizes.append(number)
        return self.device.transfer(read(number))

    def run(
        self, shim: Path, code: str, *, bufsiz: int | None = None, edges: bool = False
    ) -> subprocess.CompletedProcess[str]:
        """Run Python code with the shim and the GPIO stand-in; returns what it printed."""
        environment = {
            **os.environ,
            "LD_PRELOAD": str(shim),
            "LINETRACK_SPI_SOCKET": str(self.path),
            "PYTHONPATH": os.pathsep.join([str(HERE), str(HERE.parent.parent)]),
        }
        if bufsiz is not None:
            environment["LINETRACK_SPI_BUFSIZ"] = str(bufsiz)
        if edges:
            environment["LINETRACK_SPI_EDGES"] = "1"
        return subprocess.run(  # the code is the test's own
            [sys.executable, "-W", "error", "-c", code],
            env=environment,
            capture_output=True,
            text=True,
            timeout=120,
            check=False,
        )

    def close(self) -> None:
        """End the service; an error of the device is raised here."""
        self._socket.shutdown(socket.SHUT_RDWR)
        self._socket.close()
        for thread in self._threads:
            thread.join(10)
        self.path.unlink()
        if self.error is not None:
            raise self.error

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()


def build_shim(folder: Path) -> Path:
    """Compile shim.c with whatever compiler there is: cc, or the one in ziglang.

    Raises
    ------
    FileNotFoundError
        There is none.
    """
    target = folder / "spi-shim.so"
    if shutil.which("cc"):
        compiler = ["cc"]
    elif importlib.util.find_spec("ziglang"):
        compiler = [sys.executable, "-m", "ziglang", "cc"]
    else:
        raise FileNotFoundError("no C compiler: neither cc nor ziglang is installed")
    subprocess.run(
        [*compiler, *FLAGS, "-o", str(target), str(HERE / "shim.c"), "-ldl"],
        check=True,
    )
    return target
