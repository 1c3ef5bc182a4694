"""Two sensors on one tracker: two microcontrollers with the real firmware, one line that syncs them.

Each head has a board and a link of its own, as on a Raspberry Pi with both SPI buses in use. The
boards run on one virtual time: an edge of the sync line comes to both at the same time, whatever
their hosts are doing. Their clocks are one: of real boards, each on its own RC oscillator, that is
not true without a wire. One board drives the LEDs; the other takes the same command, and the light
on its sensor follows its own outputs, which are wired to nothing. That stands for the first one's
light as long as both switch alike, and `TwinPair.capture` sees to it that they do: the same LEDs in
each exposure, for as long but for `ALIKE`, and exposures that end at the same cycle.
"""

from __future__ import annotations

from contextlib import ExitStack, closing
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from acquisition.capture import Capture
from acquisition.frames import Frame
from acquisition.links import LinkError
from twin.link import TwinLink
from twin.machine import CLOCK, TICKS
from twin.world import STRAIGHT, Mount

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from acquisition.protocol import Command
    from twin.world import World

PERPENDICULAR = Mount(np.pi / 2, (0.0, 60.0, 0.0))
"""The second head: its line is vertical, its front vertex 60 mm above the first one's."""

SYNC = "PB1"
"""The input that the sync line is wired to, as in wiring.toml."""

PULSE = 1e-4
"""Length of a pulse of the sync line, s."""

ALIKE = 5e-7
"""Difference of the times for which an LED is lit, s: an interrupt that the link delays is 60 ns late."""


class SyncedLink(TwinLink):
    """A `TwinLink` whose sync input has edges at given virtual times.

    Takes the arguments of `TwinLink`.
    """

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._edges: list[tuple[int, bool]] = []
        self.machine.drive(SYNC, level=False)

    @property
    def ticks(self) -> int:
        """Virtual time in the unit of `twin.machine.TICKS`."""
        return round(self.machine.seconds * TICKS)

    def pulse_at(self, ticks: int) -> None:
        """Have a pulse on the sync input at a virtual time to come."""
        if ticks < self.ticks:
            raise ValueError(f"pulse_at {ticks}: the time is {self.ticks} already")
        self._edges = [(ticks, True), (ticks + round(PULSE * TICKS), False)]

    def wait_ready(self, timeout: float) -> bool:
        """As `TwinLink.wait_ready`; the sync line goes its own way meanwhile."""
        self._check_open()
        end = self.ticks + round(timeout * TICKS)
        while self._edges and self._edges[0][0] <= end:
            left = self._edges[0][0] - self.ticks
            if left > 0 and self.machine.wait_pin("PB2", level=True, timeout=left / TICKS):
                break
            self._drive_due()
        ready = self.machine.wait_pin("PB2", level=True, timeout=max(end - self.ticks, 0) / TICKS)
        if ready and self.host_latency:
            self.sleep(self.host_latency)
        return ready

    def transfer(self, tx: bytes) -> bytes:
        """As `TwinLink.transfer`; an edge of the sync line may come in the middle."""
        self._check_open()
        received = b""
        while self._edges:
            before = int((self._edges[0][0] - self.ticks) / TICKS * self.spi_clock / 8)
            if before >= len(tx):
                break
            if before > 0:
                received += super().transfer(tx[:before])
                tx = tx[before:]
            super().sleep(max(self._edges[0][0] - self.ticks, 0) / TICKS)
            self._drive_due()
        return received + super().transfer(tx)

    def sleep(self, seconds: float) -> None:
        """As `TwinLink.sleep`; the sync line goes its own way meanwhile."""
        end = self.ticks + round(seconds * TICKS)
        while self._edges and self._edges[0][0] <= end:
            super().sleep(max(self._edges[0][0] - self.ticks, 0) / TICKS)
            self._drive_due()
        super().sleep(max(end - self.ticks, 0) / TICKS)

    def _drive_due(self) -> None:
        while self._edges and self._edges[0][0] <= self.ticks:
            _, level = self._edges.pop(0)
            self.machine.drive(SYNC, level=level)


class TwinPair:
    """Two links to twins in one room, on one tracker, at one virtual time.

    Parameters
    ----------
    world : World
        Its mount is replaced by each head's.
    mounts : sequence of Mount
        Of the heads; straight, and perpendicular above it, when left out.
    seed : int
        Of the first sensor; the next ones have the next numbers.
    **options
        For `TwinLink`.
    """

    def __init__(
        self,
        world: World,
        mounts: Sequence[Mount] = (STRAIGHT, PERPENDICULAR),
        *,
        seed: int = 1304,
        **options: Any,
    ) -> None:
        with ExitStack() as stack:
            self.links = tuple(
                stack.enter_context(
                    SyncedLink(replace(world, mount=mount), seed=seed + number, **options)
                )
                for number, mount in enumerate(mounts)
            )
            self._stack = stack.pop_all()

    def sync(self, delay: float) -> None:
        """Have a pulse on the sync line, on all boards at the same virtual time, s from now."""
        latest = max(link.ticks for link in self.links)
        for link in self.links:
            link.pulse_at(latest + round(delay * TICKS))

    def capture(self, command: Command, *, delay: float = 0.05) -> Iterator[tuple[Frame, ...]]:
        """Yield the frames of all sensors of each exposure.

        All boards take the command, wait for the sync line, and begin with its edge.

        Parameters
        ----------
        command : Command
            In stream mode.
        delay : float
            From now to the edge, virtual s: 0.02 to 0.2. The boards need the time to take the
            command; later they would be asked what keeps them.

        Yields
        ------
        tuple of Frame
            One of each link, of one sequence number; exposures that a link lost are left out.

        Raises
        ------
        LinkError
            From a link, or if the boards did not expose at the same times or light the same LEDs.
        ValueError
            If the delay is out of its range.
        """
        if not 0.02 <= delay <= 0.2:
            raise ValueError(f"delay = {delay:g} s: allowed is 0.02 to 0.2; in ms?")
        self.sync(delay)
        begun = max(link.machine.time for link in self.links) + round(delay * CLOCK)
        started = replace(command, await_sync=True)
        with ExitStack() as stack:
            captures = [stack.enter_context(closing(Capture(k, started))) for k in self.links]
            while True:
                frames = [next(capture, None) for capture in captures]
                while True:
                    there = [frame for frame in frames if isinstance(frame, Frame)]
                    if len(there) < len(frames):
                        return
                    newest = max(frame.sequence for frame in there)
                    if all(frame.sequence == newest for frame in there):
                        break
                    frames = [
                        frame if frame.sequence == newest else next(capture, None)
                        for frame, capture in zip(there, captures, strict=True)
                    ]
                begun = self._check_alike(begun)
                yield tuple(there)

    def _check_alike(self, begun: int) -> int:
        """Compare the exposures that ended after a time, in cycles; return the end of the last one."""
        # one board may be ahead, and only so many read-outs are kept
        logs = [link.machine.readouts for link in self.links]
        ended = min(link.machine.time for link in self.links)
        begun = max([begun, *(int(log["transfer"][0]) - 1 for log in logs)])
        logs = [log[(log["transfer"] > begun) & (log["start"] < ended)] for log in logs]
        first = logs[0]
        for number, log in enumerate(logs[1:], 1):
            if log["transfer"].tolist() != first["transfer"].tolist():
                raise LinkError(
                    f"exposures of board 0 ended at {first['transfer'].tolist()} cycles, of board "
                    f"{number} at {log['transfer'].tolist()}: did both get the edge of the sync line?"
                )
            # of sources 0 is what is always there
            apart = np.abs(
                log["lit"][:, 1:].astype(np.int64) - first["lit"][:, 1:].astype(np.int64)
            )
            if apart.size and apart.max() > ALIKE * CLOCK:
                at, channel = np.unravel_index(apart.argmax(), apart.shape)
                raise LinkError(
                    f"LED {channel} was lit for {first['lit'][at, 1 + channel]} cycles by board 0, "
                    f"and as long as {log['lit'][at, 1 + channel]} by board {number}, which sees it "
                    "only if both light it"
                )
        return int(first["transfer"][-1]) if len(first) else begun

    def close(self) -> None:
        """Free the emulators."""
        self._stack.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
