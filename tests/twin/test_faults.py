"""A bad cable between host and firmware: nothing false is delivered, and the stream comes back."""

from __future__ import annotations

import os
from itertools import islice

import numpy as np
import pytest

from acquisition.capture import Capture, capture
from acquisition.frames import FrameFlags
from acquisition.protocol import Command
from tests.twin.faults import DEVICE_FAULTS, LINK_FAULTS, SPIKES, STREAM, FaultyLink, torture

CASES = 2000 if "CI" in os.environ else 400
SHARE = 0.15  # of the cases for faults after which the host must begin anew: they take longer


@pytest.mark.parametrize("command", [STREAM, SPIKES], ids=["pixels", "spikes"])
def test_stream_survives_a_bad_link(command: Command) -> None:
    faults = round(CASES * (1 - SHARE))
    report = torture(seed=11, faults=faults, kinds=LINK_FAULTS, command=command)
    print(f"\n{report}")
    assert report.corrupt == 0
    assert set(report.lost) == set(LINK_FAULTS)
    assert sum(report.faults.values()) >= faults
    for kind, lost in report.lost.items():
        assert max(lost) <= 2, kind
    # a short or broken transfer costs at most its own frame
    for kind in ("bits flipped in", "bits flipped out", "bytes dropped", "truncated", "overlong"):
        assert max(report.missing[kind]) <= 1, kind
    # pulses too many may begin the next frame: the time to notice can make the link miss that one
    assert max(report.missing["bytes doubled"]) <= 2


@pytest.mark.parametrize("command", [STREAM, SPIKES], ids=["pixels", "spikes"])
def test_stream_survives_resets_and_garbage_commands(command: Command) -> None:
    """The device may have left its mode: the host finds out, and begins anew."""
    faults = round(CASES * SHARE)
    report = torture(seed=12, faults=faults, kinds=DEVICE_FAULTS, command=command)
    print(f"\n{report}")
    assert report.corrupt == 0
    assert set(report.faults) == set(DEVICE_FAULTS)
    assert sum(report.faults.values()) >= faults
    for kind, silent in report.silent.items():
        assert max(silent) < 0.2, kind


def test_every_fault_is_one() -> None:
    """Most faults lose or delay something; those that may not, because the firmware copes, do strike."""
    for kind in (*LINK_FAULTS, *DEVICE_FAULTS):
        hurt = 0
        for seed in range(10, 18):
            with FaultyLink(seed) as link, Capture(link, STREAM, retries=8) as frames:
                list(islice(frames, 3))
                start = link.machine.seconds
                link.strike(kind)
                numbers = [frame.sequence for frame in islice(frames, 3)]
                late = link.machine.seconds - start > 3.5 * STREAM.icg_period / 4e6
                hurt += numbers != [3, 4, 5] or late or frames.statistics.corrupt > 0
                assert link.struck[kind] == 1
        harmless = (
            "bits flipped out",
            "garbage sent",
            "stuck high",
            "bouncing",
            "paused",
            "overlong",
        )
        expected = 0 if kind in harmless else 1
        assert hurt >= expected, kind


@pytest.mark.parametrize("kind", ["bytes dropped", "bytes doubled", "truncated", "reset"])
def test_original_mode_reports_invalid_data_where_it_can_be_seen(kind: str) -> None:
    """Twelve bits, dummies and a dark reference are all the format has to check."""
    seen = 0
    for seed in range(12):
        with FaultyLink(seed) as link:
            link.strike(kind, after=2)  # the command and the first frame are left alone
            rest = list(capture(link, Command(100, 30000, 3), retries=8))
            assert link.struck[kind] == 1
            assert not rest[0].flags & FrameFlags.INVALID
            right = [frame.pixels.tobytes() in link.readouts for frame in rest]
            flagged = [bool(frame.flags & FrameFlags.INVALID) for frame in rest]
            # after a reset nothing more comes: the call is begun anew, and nothing wrong delivered
            seen += any(flagged) or (kind == "reset" and all(right))
            # odd numbers of bytes shift low and high: 16 bits where the ADC has 12
            for good, invalid, frame in zip(right, flagged, rest, strict=True):
                if not good and not invalid:
                    elements = frame.elements
                    assert elements.max() <= 4095
                    assert np.ptp(frame.dark) <= 128
            # the next call is whole again
            link.sleep(0.06)
            again = list(capture(link, Command(100, 30000, 2), retries=8))
            assert [frame.pixels.tobytes() in link.readouts for frame in again] == [True, True]
    assert seen >= 6
