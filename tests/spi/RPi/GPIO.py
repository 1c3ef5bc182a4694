# ruff: noqa: ARG001, N999  (names are the original's)
"""Stand-in for RPi.GPIO: one input, whose level the server of the replaced SPI device knows.

Time is the device's own: looking at the level waits up to 0.5 ms for it, and no edges are detected, so that
its user has to poll (as on a kernel that gives RPi.GPIO no edges).
"""

from __future__ import annotations

import os
import socket
import struct

BCM, IN, PUD_DOWN, RISING = 11, 1, 21, 31
_connection: socket.socket | None = None


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
    _connection = socket.socket(socket.AF_UNIX)
    _connection.connect(os.environ["LINETRACK_SPI_SOCKET"])


def add_event_detect(channel: int, edge: int, callback: object = None) -> None:
    """Refuse, as RPi.GPIO does on kernels from 6.6 on."""
    raise RuntimeError("Failed to add edge detection")


def input(channel: int) -> int:  # noqa: A001
    """Level of the handshake line."""
    assert _connection is not None
    _connection.sendall(b"W\0\0\0" + struct.pack("<I", 500))
    return _connection.recv(1)[0]


def cleanup(channel: int) -> None:
    """Disconnect."""
    assert _connection is not None
    _connection.close()
