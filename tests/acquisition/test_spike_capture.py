"""Capture in spikes mode against a fake device: as in stream mode, but for what is in a frame."""

from __future__ import annotations

from dataclasses import replace
from itertools import islice
from typing import TYPE_CHECKING

import numpy as np
import pytest

from acquisition.capture import Capture, Refused, SpikeCapture, capture
from acquisition.frames import Frame, FrameFlags, SpikeFrame
from acquisition.links import LinkError, LinkTimeout, ReplayLink
from acquisition.protocol import FULL_WINDOW, Command, CommandError, Mode, Refusal
from acquisition.session import SessionError, SessionWriter
from tests.acquisition.fake_mcu import LEDS, FakeMcu, FaultyWire, check, elements_at, spikes

if TYPE_CHECKING:
    from pathlib import Path


def test_spikes_come_with_all_that_is_known_of_their_frame() -> None:
    link = FakeMcu()
    frames = SpikeCapture(link, spikes(9))
    found = list(frames)
    check(found)
    assert [frame.sequence for frame in found] == list(range(9))
    assert [frame.exposures for frame in found[:4]] == LEDS
    assert found[1].windows == ((7, 300), (400, 500))
    assert found[2].windows == (FULL_WINDOW,)
    assert all(frame.utc_ns > 0 and frame.monotonic_ns > 0 for frame in found)
    assert (found[0].sh_period, found[0].icg_period) == (100, 20000)
    assert frames.statistics.good == 9
    assert frames.status is not None


@pytest.mark.parametrize("then", list(Mode))
def test_an_endless_capture_is_stopped_and_one_in_any_mode_follows(then: Mode) -> None:
    link = FakeMcu()
    with SpikeCapture(link, spikes()) as frames:
        check(islice(frames, 5))
    assert link.commands[-1].leds(0) == {}
    following = Capture(link, Command(100, 30000, 3, then))
    assert len(list(following)) == 3
    assert following.statistics.restarts == following.statistics.corrupt == 0


@pytest.mark.parametrize("then", list(Mode))
def test_a_running_capture_of_somebody_else_is_taken_over(then: Mode) -> None:
    """Its transfers have another length than the command's, which the new host cannot know."""
    link = FakeMcu()
    before = SpikeCapture(link, spikes())
    check(islice(before, 5))
    following = Capture(link, Command(200, 24000, 4, then))
    found = list(following)
    assert [frame.sequence for frame in found] == list(range(4))
    assert following.statistics.restarts == 0


def test_windows_and_leds_change_on_the_way() -> None:
    link = FakeMcu()
    frames = SpikeCapture(link, spikes())
    found = list(islice(frames, 5))
    change = Command(100, 20000, 0, Mode.SPIKES, [{3: 50}], [[(500, 600)]], await_sync=True)
    frames.send(change)
    found += islice(frames, 4)
    frames.send([{}, {5: 20}])
    found += islice(frames, 4)
    check(found)
    assert [frame.sequence for frame in found] == list(range(13))
    assert sum(bool(frame.flags & FrameFlags.CHANGED) for frame in found) == 3
    assert (found[8].windows, found[8].exposures) == (((500, 600),), {3: 50})
    assert not link.commands[1].await_sync, "a stream that runs waits for nothing"
    assert found[-1].windows == (FULL_WINDOW,)
    assert frames.statistics.restarts == 0


def test_what_cannot_be_sent_says_so_at_once() -> None:
    frames = SpikeCapture(FakeMcu(), spikes())
    with pytest.raises(CommandError, match="15 entries do not fit"):
        frames.send([{}] * 15)
    with pytest.raises(ValueError, match="in spikes mode cannot go over to stream mode"):
        frames.send(Command(100, 20000, 0, Mode.STREAM))
    with pytest.raises(ValueError, match="in stream mode cannot go over to spikes mode"):
        Capture(FakeMcu(), Command(100, 20000, 0, Mode.STREAM)).send(spikes())
    with pytest.raises(ValueError, match="SPIKES is needed here"):
        SpikeCapture(FakeMcu(), Command(100, 20000, 0, Mode.STREAM))
    # but a new capture takes them
    assert len(list(capture(FakeMcu(), Command(100, 20000, 70, Mode.SPIKES, [{}] * 64)))) == 70


def test_only_the_first_start_awaits_an_edge() -> None:
    link = FaultyWire(1, 1.0, ["reset"])
    link.quiet = link.once = True
    command = Command(100, 20000, 0, Mode.SPIKES, await_sync=True)
    frames = SpikeCapture(link, command)
    check(islice(frames, 3))
    assert link.commands[-1].await_sync
    link.quiet = False
    check(islice(frames, 3))
    assert link.injected == ["reset"]
    assert not link.commands[-1].await_sync


def test_older_firmware_refuses() -> None:
    class Older(FakeMcu):
        def _act(self, received: bytes) -> None:
            if received[:2] == b"ER" and received[10]:
                self._refuse(Mode.STREAM, Refusal.VERSION)

    link = Older()
    with pytest.raises(Refused, match=r"version.*same release"):
        list(capture(link, spikes(3)))
    assert link.mode is Mode.STREAM
    # it does the same while a stream of somebody else goes on, but says less
    link._start(Command(100, 20000, 0, Mode.STREAM))
    with pytest.raises(Refused, match=r"goes on.*same release"):
        list(capture(link, spikes(3)))


@pytest.mark.parametrize("mode", [Mode.STREAM, Mode.SPIKES])
def test_refused_while_a_stream_of_somebody_else_goes_on(mode: Mode) -> None:
    class Picky(FakeMcu):
        def _act(self, received: bytes) -> None:
            if received[:2] == b"ER" and self.commands:
                self._refuse(received[10], Refusal.TABLE)
            else:
                super()._act(received)

    for running in (Mode.STREAM, Mode.SPIKES):
        link = Picky()
        before = Capture(link, Command(100, 20000, 0, running))
        assert len(list(islice(before, 3))) == 3
        why = "goes on" if mode is running else "table"
        with pytest.raises(Refused, match=why):
            list(capture(link, Command(100, 20000, 3, mode)))


@pytest.mark.parametrize("mode", [Mode.STREAM, Mode.SPIKES])
def test_a_command_that_awaits_an_edge_is_sent_once(mode: Mode) -> None:
    command = Command(100, 20000, 3, mode, await_sync=True)
    link = FakeMcu()
    link.edge_after = 0.8
    frames = Capture(link, command, timeout=0.3)
    assert len(list(frames)) == 3
    assert frames.statistics.restarts == 0
    assert len(link.commands) == 1
    # without an edge the line is named, and nothing stays armed
    link.edge_after = None
    with (
        pytest.raises(LinkTimeout, match=r"sync line.*PB1"),
        Capture(link, replace(command, count=0), timeout=0.3) as frames,
    ):
        next(frames)
    assert link.commands[-1].count == 1
    assert not link.commands[-1].await_sync


def test_a_device_that_was_reset_while_it_waited_is_told_again() -> None:
    class Unsteady(FakeMcu):
        def wait_ready(self, timeout: float) -> bool:
            if len(self.commands) == 1 and self.now > 0.1:
                self.reset()
            return super().wait_ready(timeout)

    link = Unsteady()
    link.edge_after = 0.5
    command = Command(100, 20000, 3, Mode.SPIKES, await_sync=True)
    frames = Capture(link, command, timeout=0.3, retries=5)
    assert len(list(frames)) == 3
    assert frames.statistics.restarts == 1
    assert [command.await_sync for command in link.commands] == [True, True]


def test_a_damaged_command_does_not_end_the_wait() -> None:
    link = FakeMcu()
    link.edge_after = None
    command = Command(100, 20000, 3, Mode.SPIKES, await_sync=True)
    link.exchange(command.encode())
    link.sleep(0.01)
    link.exchange(bytes(256))
    damaged = bytearray(command.encode(256))
    damaged[20] ^= 1
    link.exchange(bytes(damaged))
    assert link.ready
    assert link.left == 3


def test_recordings_have_pixels(tmp_path: Path) -> None:
    frame = Frame(elements_at(0), sh_period=100, icg_period=20000)
    with pytest.raises(LinkError, match="replay it in stream mode"):
        list(capture(ReplayLink([frame] * 3), spikes(3)))
    with (
        SessionWriter(tmp_path / "spikes.h5") as writer,
        pytest.raises(SessionError, match="record in stream mode"),
    ):
        writer.append([SpikeFrame(())])  # type: ignore[list-item]
    assert np.array_equal(frame.elements, elements_at(0))
