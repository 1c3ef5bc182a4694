# ruff: noqa: ARG001, N999  (names are the original's)
"""Stand-in for RPi.GPIO: one input, whose level the server of the replaced SPI device knows.

Time is the device's own. With LINETRACK_SPI_EDGES set, a low level lets it go on until the line
rises, which is reported as an edge. Without, no edges are detected (as on a kernel that gives
RPi.GPIO none), so that its user has to poll: looking at the level waits up to 0.5 ms for it.
"""

from __future__ import annotations

import os
import socket
import struct
import threading
from typing import TYPE_CHECKING

BCM, IN, PUD_DOWN, RISING = 11, 1, 21, 31
_EDGES = "LINETRACK_SPI_EDGES" in os.environ
_connection: socket.socket | None = None
_waiting = threading.Event()  # for an edge
_closed = False
_thread: threading.Thread | None = None

if TYPE_CHECKING:
    from collections.abc import Callable


def setwarnings(on: bool) -> None:
    """Accept."""


def setmode(mode: int) -> None:
    """Accept the only mode that there is."""
    if mode != BCM:
        raise ValueError("An invalid mode was passed to setmode()")


def setup(channel: int, direction: int, pull_up_down: int = PUD_DOWN) -> None:
    """Connect."""
    global _connection
    assert (channel, direction, pull_up_down) == (18, IN, PUD_DOWN)
    _connection = _connected()


def _connected() -> socket.socket:
    result = socket.socket(socket.AF_UNIX)
    result.connect(os.environ["LINETRACK_SPI_SOCKET"])
    return result


def _ready_within(connection: socket.socket, microseconds: int) -> int:
    connection.sendall(b"W\0\0\0" + struct.pack("<I", microseconds))
    return connection.recv(1)[0]


def add_event_detect(channel: int, edge: int, callback: Callable[[int], None]) -> None:
    """Report edges, or refuse as RPi.GPIO does on kernels from 6.6 on."""
    global _thread
    if not _EDGES:
        raise RuntimeError("Failed to add edge detection")
    assert (channel, edge) == (18, RISING)
    _thread = threading.Thread(target=_report, args=(callback, _connected()))
    _thread.start()


def _report(callback: Callable[[int], None], connection: socket.socket) -> None:
    with connection:
        while _waiting.wait() and not _closed:
            _waiting.clear()
            if _ready_within(connection, 100_000):
                callback(18)


def input(channel: int) -> int:  # noqa: A001
    """Level of the handshake line."""
    assert _connection is not None
    level = _ready_within(_connection, 0 if _EDGES else 500)
    if _EDGES and not level:
        _waiting.set()
    return level


def cleanup(channel: int) -> None:
    """Disconnect."""
    global _closed
    assert _connection is not None
    _closed = True
    _waiting.set()
    if _thread is not None:
        _thread.join()
    _connection.close()
