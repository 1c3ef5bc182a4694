"""Poses as lines of text: for people, for programs (JSON, CSV), and as UDP datagrams."""

from __future__ import annotations

import json
import math
import re
import socket
from typing import TYPE_CHECKING, Final, TextIO

from tracking.poses import PoseFlags

if TYPE_CHECKING:
    from collections.abc import Callable

    from tracking.poses import Estimate

KEYS: Final = ("t_ns", "x", "y", "heading", "cov", "flags")
"""Keys of a JSON object: device time in ns, mm, mm, rad, covariance in these units, names."""

CSV_HEADER: Final = "t_ns,x,y,heading,cov_xx,cov_xy,cov_xh,cov_yy,cov_yh,cov_hh,flags"
"""The first line of CSV; the covariance is symmetric, its upper triangle is there."""

_UPPER: Final = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
_UNKNOWN: Final = 1e5  # mm, degrees; a standard deviation above says nothing


def flag_names(flags: PoseFlags) -> list[str]:
    """Names of the flags that are set, in lower case: ``["heading_assumed"]``."""
    return [flag.name.lower() for flag in PoseFlags if flag.name and flag & flags]


def as_json(estimate: Estimate) -> str:
    """One JSON object with `KEYS`; a variance that is infinite becomes null."""
    covariance = [[_number(float(value)) for value in row] for row in estimate.covariance]
    x, y, heading = _rounded(estimate)
    values = (estimate.t_ns, x, y, heading, covariance, flag_names(estimate.flags))
    return json.dumps(dict(zip(KEYS, values, strict=True)), allow_nan=False)


def as_csv(estimate: Estimate) -> str:
    """One line of CSV as `CSV_HEADER` has it; flags are joined by ``|``, infinite is empty."""
    numbers = [_number(float(estimate.covariance[place])) for place in _UPPER]
    values = [estimate.t_ns, *_rounded(estimate), *numbers]
    texts = ["" if value is None else repr(value) for value in values]
    return ",".join([*texts, "|".join(flag_names(estimate.flags))])


def as_text(estimate: Estimate) -> str:
    """One line for people: seconds, mm and degrees, each with its standard deviation."""
    x, y, heading = estimate.x, estimate.y, math.degrees(estimate.heading)
    sigma_x, sigma_y, turn = (
        math.sqrt(max(float(estimate.covariance[n, n]), 0.0)) for n in range(3)
    )
    flags = ", ".join(flag_names(estimate.flags)).replace("_", " ")
    return (
        f"{estimate.t_ns / 1e9:11.6f} s   x {x:9.2f} {_sigma(sigma_x)} mm   "
        f"y {y:9.2f} {_sigma(sigma_y)} mm   heading {heading:8.3f} {_sigma(math.degrees(turn), 3)}°"
        f"   {flags}"
    ).rstrip()


def _rounded(estimate: Estimate) -> tuple[float, float, float]:
    """To a pm and a nrad: what is printed does not depend on the last bit of a machine."""
    return round(estimate.x, 6), round(estimate.y, 6), round(estimate.heading, 9)


def _number(value: float) -> float | None:
    return float(f"{value:.6g}") if math.isfinite(value) else None


def _sigma(value: float, digits: int = 2) -> str:
    return f"± {value:<7.{digits}f}" if value < _UNKNOWN else "± ?      "


class LineWriter:
    """Writes one line per pose, each flushed, so that a pipe has it at once.

    Parameters
    ----------
    stream : file-like
    line : callable
        `as_text`, `as_json` or `as_csv`.
    header : str
        Written before the first pose, unless empty: without a pose, nothing is.
    """

    def __init__(
        self, stream: TextIO, line: Callable[[Estimate], str] = as_text, header: str = ""
    ) -> None:
        self._stream, self._line = stream, line
        self._before = f"{header}\n" if header else ""

    def __call__(self, estimate: Estimate) -> None:
        """Write a pose."""
        self._stream.write(f"{self._before}{self._line(estimate)}\n")
        self._stream.flush()
        self._before = ""

    def complaint(self) -> str:
        """Say nothing: a stream that does not take a line raises."""
        return ""

    def close(self) -> None:
        """Nothing is left to do; the stream stays open."""


class UdpWriter:
    """Sends one datagram per pose: the JSON object of `as_json`.

    What the network does not take is lost and counted; nothing waits for it.

    Parameters
    ----------
    host : str
        Name or address; IPv6 addresses without brackets.
    port : int
        1 to 65535.

    Attributes
    ----------
    sent, failed : int
        Datagrams that the network took, and that it did not.
    reason : str
        Why it did not take the last of those.

    Raises
    ------
    OSError
        The host has no address.
    """

    def __init__(self, host: str, port: int) -> None:
        found = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)
        family, kind, protocol, _, address = found[0]
        self._address = address
        self._socket = socket.socket(family, kind, protocol)
        self._socket.setblocking(False)
        self.sent = self.failed = 0
        self.reason = ""

    def __call__(self, estimate: Estimate) -> None:
        """Send a pose."""
        try:
            self._socket.sendto(as_json(estimate).encode(), self._address)
        except OSError as error:  # also a buffer that is full, and a port where nobody listens
            self.failed += 1
            self.reason = error.strerror or str(error)
        else:
            self.sent += 1

    def complaint(self) -> str:
        """Say what was lost, in one line; empty if nothing was."""
        if not self.failed:
            return ""
        return f"{self.failed} of {self.failed + self.sent} datagrams were not sent: {self.reason}"

    def close(self) -> None:
        """Close the socket; a second call does nothing."""
        self._socket.close()


def host_and_port(text: str) -> tuple[str, int]:
    """Read ``HOST:PORT``, with an IPv6 address in brackets.

    Raises
    ------
    ValueError
        It is something else.
    """
    match = re.fullmatch(r"(?:\[([^\]]+)\]|([^:\[\]]+)):(\d{1,5})", text)
    if match is None or not 1 <= int(match[3]) <= 65535:
        raise ValueError(
            f"{text!r} is no HOST:PORT with a port of 1 to 65535, such as 127.0.0.1:5005"
        )
    return match[1] or match[2], int(match[3])
