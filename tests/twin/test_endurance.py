"""Two minutes through the firmware, half of them with whole frames and half with its own spikes."""

from __future__ import annotations

import pytest

from tests.twin.endurance import DARK_EVERY, run


@pytest.mark.parametrize("spikes", [False, True], ids=["frames", "spikes"])
def test_a_minute_of_everything_through_the_firmware(spikes: bool) -> None:
    report = run(1.0, seed=1, spikes=spikes)
    print(f"\n{report}")
    assert not report.failures(), str(report)
    assert report.losses >= 60 / DARK_EVERY / 2, "nothing happened"
    assert len(report.recoveries) >= report.losses
    assert report.locked > 0.75 * report.frames
