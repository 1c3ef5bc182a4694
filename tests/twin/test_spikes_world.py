import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from raytransfer import TCD1304
from raytransfer.designs import DESIGNS
from raytransfer.irradiance import irradiance
from raytransfer.sources import Emitter
from tests.tracking import endurance
from tests.tracking.endurance import (
    ICG_PERIOD,
    INTERRUPTED,
    SH_PERIOD,
    Report,
    head,
    hours,
    room,
    run,
    show,
)
from tracking.spikes import SpikeFinder, SpikeFlags
from twin.spikes import Faults, SpikeTable, SpikeWorld, Wander
from twin.world import Led

NEVER = Faults.none()


class Still:
    """A path that stays where it is."""

    def __init__(self, x: Any, y: Any, heading: Any = 0.0) -> None:
        self.pose = np.array([x, y, heading])

    def at(self, seconds: Any) -> Any:
        return np.tile(self.pose, (len(seconds), 1))


def world(leds: Any, path: Any = None, **options: Any) -> Any:
    table, _ = head()
    options = {"faults": NEVER, "seed": 1, **options}
    path = Still(0.0, 3000.0) if path is None else path
    return SpikeWorld(leds, table, path, sh_period=SH_PERIOD, icg_period=ICG_PERIOD, **options)


# -- the table is exact light


@pytest.mark.parametrize(("degrees", "distance"), [(3.3, 1700.0), (-14.2, 3300.0), (19.7, 900.0)])
def test_between_its_points_the_table_is_exact_light(degrees: Any, distance: Any) -> None:
    table, _ = head()
    m = math.tan(math.radians(degrees))
    light = irradiance(
        DESIGNS["slit-4mm"].system,
        Emitter(power=1.0, extent=2.0),
        (-m * distance, 0.0, distance),
        TCD1304,
        integration_time=1e-5,
        rays=(384, 64),
    ).electrons
    direct = SpikeFinder().profile(light * (17_000 / light.max()))
    position, width, solid_angle = table.spike(m, distance)
    assert position == pytest.approx(direct.position, abs=0.15)
    assert width == pytest.approx(
        direct.width, rel=0.2, abs=1.2
    )  # of few px, it depends on where they lie
    # Lambertian, its axis along the head's
    expected = solid_angle * math.cos(math.radians(degrees)) / math.pi
    expected *= 1e-5 * table.electrons_per_joule
    assert light.max() == pytest.approx(expected, rel=0.25)


def test_on_the_axis_a_spike_is_in_the_middle_of_the_line() -> None:
    table, _ = head()
    for distance in (600.0, 2000.0, 8000.0):
        assert table.spike(0.0, distance)[0] == pytest.approx((TCD1304.pixels - 1) / 2, abs=0.01)


def test_beyond_the_line_there_is_nothing() -> None:
    table, _ = head()
    assert math.isnan(table.spike(0.6, 2000.0)[0])
    assert math.isnan(table.spike(0.52, 2000.0)[0])


def test_refuses_distances_out_of_order() -> None:
    with pytest.raises(ValueError, match="nearest"):
        SpikeTable(DESIGNS["slit-4mm"].system, nearest=2000.0, farthest=1000.0)


# -- noise, exposure


def test_positions_scatter_as_stated_about_the_exact_place() -> None:
    table, _ = head()
    place = world([Led(0, (400.0, 0.0, 0.0), power=0.25)])
    found = [place.expose(n, {0: 30})[0] for n in range(2000)]
    position = np.array([s.position for s in found])
    sigma = found[0].sigma
    exact = table.spike(400.0 / 3000.0, 3000.0)[0]
    assert np.std(position) == pytest.approx(sigma, rel=0.06)
    assert np.mean(position) == pytest.approx(exact, abs=4 * sigma / math.sqrt(2000))
    assert 0.01 < sigma < 0.2
    assert all(s.flags == SpikeFlags.NONE for s in found)


def test_longer_is_better_until_it_saturates() -> None:
    place = world([Led(0, (0.0, 0.0, 0.0), power=0.25)])
    spikes = [place.expose(0, {0: clocks})[0] for clocks in (5, 10, 20, 40)]
    heights = np.array([s.height for s in spikes])
    np.testing.assert_allclose(heights / heights[0], [1, 2, 4, 8], rtol=1e-9)
    sigmas = [s.sigma for s in spikes]
    assert sigmas == sorted(sigmas, reverse=True)
    full = place.expose(0, {0: 400})[0]
    assert full.flags & SpikeFlags.SATURATED
    assert full.sigma > 3 * sigmas[-1]
    assert full.height < 36_000


def test_dim_hidden_and_averted_leds_are_missing() -> None:
    leds = [
        Led(0, (0.0, 0.0, 0.0), power=1e-5),
        Led(1, (0.0, 0.0, 0.0), power=0.25, facing=math.pi),
        Led(2, (0.0, 6000.0, 0.0), power=0.25, facing=math.pi),
        Led(3, (3000.0, 0.0, 0.0), power=0.25),
        Led(4, (0.0, 0.0, 0.0), power=0.25),
    ]
    spikes = world(leds).expose(0, dict.fromkeys((0,), 10))
    assert not spikes[0].found
    place = world(leds)
    assert [place.expose(0, {n: 50})[n].found for n in range(1, 5)] == [False, False, False, True]
    assert place.visible(0) == 1


def test_windows_tell_whose_spike_it_is() -> None:
    leds = [Led(0, (-400.0, 0.0, 0.0), power=0.25), Led(1, (400.0, 0.0, 0.0), power=0.1)]
    place = world(leds)
    alone = {n: place.expose(0, {n: 60})[n].position for n in (0, 1)}
    whole = place.expose(0, {0: 60, 1: 60})
    for n in (0, 1):  # the stronger first
        assert whole[n].position == pytest.approx(alone[n], abs=0.5)
    backward = place.expose(0, {1: 60, 0: 60})
    assert backward[1].position == pytest.approx(alone[0], abs=0.5)
    windows = {n: (int(at) - 50, int(at) + 50) for n, at in alone.items()}
    both = place.expose(0, {0: 60, 1: 60}, windows)
    for n in (0, 1):
        assert both[n].position == pytest.approx(alone[n], abs=0.5)
    swapped = place.expose(0, {0: 60, 1: 60}, {0: windows[1], 1: (10, 40)})
    assert swapped[0].position == pytest.approx(alone[1], abs=0.5)
    assert not swapped[1].found


def test_spikes_that_touch_are_one() -> None:
    leds = [Led(0, (0.0, 0.0, 0.0), power=0.25), Led(1, (5.0, 0.0, 0.0), power=0.25)]
    both = world(leds).expose(0, {0: 40, 1: 40})
    assert both[0].flags & SpikeFlags.DOUBLE


# -- what goes wrong


def share(faults: Any, what: Any, frames: Any = 40_000) -> Any:
    place = world([Led(0, (0.0, 0.0, 0.0), power=0.25)], faults=faults, seed=2)
    return np.mean([what(place.expose(n, {0: 40})[0]) for n in range(frames)])


def off(**options: Any) -> Any:
    return Faults(**{**NEVER.__dict__, **options})


def test_leds_are_hidden_as_often_as_asked() -> None:
    part = share(off(blocked_every=4.0, blocked=0.5), lambda s: not s.found)
    assert part == pytest.approx(0.125, rel=0.35)
    part = share(off(dark_every=4.0, dark=0.5), lambda s: not s.found)
    assert part == pytest.approx(0.125, rel=0.35)


def test_gross_errors_come_as_often_as_asked() -> None:
    part = share(off(gross=0.01), lambda s: abs(s.position - 1823.56) > 4)
    assert part == pytest.approx(0.01, rel=0.3)


def test_reflections_are_found_where_the_led_is_hidden() -> None:
    faults = off(mirror_every=4.0, mirror=2.0, blocked_every=4.0, blocked=2.0)
    part = share(faults, lambda s: s.found and abs(s.position - 1823.56) > 25)
    assert 0.05 < part < 0.35


def test_the_same_seed_is_the_same_world_whatever_is_lit() -> None:
    leds = [Led(n, (100.0 * n, 0.0, 0.0), power=0.25) for n in range(4)]
    faults = Faults(blocked_every=3.0)
    one, other = (world(leds, faults=faults, seed=5) for _ in range(2))
    hidden = [one.expose(n, {0: 40})[0].found for n in range(0, 4000, 7)]
    assert hidden == [
        other.expose(n, {1: 40, 0: 40}, {0: (0, 1860), 1: (1861, 3647)})[0].found
        for n in range(0, 4000, 7)
    ]
    assert not all(hidden)
    assert one.expose(1, {0: 40}) != world(leds, seed=6).expose(1, {0: 40})


def test_frames_get_lost_late_and_twice() -> None:
    place = world([Led(0, (0.0, 0.0, 0.0))], faults=off(lost=0.1, late=0.1, twice=0.1), seed=3)
    arrived = [[reading.t_ns for reading in place.receive(n, {0: 40})] for n in range(5000)]
    times = [t for readings in arrived for t in readings]
    counts = np.unique(times, return_counts=True)[1]
    assert 1 - len(counts) / 5000 == pytest.approx(0.1, rel=0.2)
    assert np.mean(counts == 2) * len(counts) / 5000 == pytest.approx(0.1, rel=0.2)
    late = sum(t < place.time_ns(n) for n, readings in enumerate(arrived) for t in readings)
    assert late / 5000 == pytest.approx(0.1, rel=0.2)


# -- paths


@pytest.mark.parametrize("seed", range(5))
def test_wander_stays_in_its_area_and_below_its_speed(seed: Any) -> None:
    path = Wander(seed, (-4000.0, 4000.0, -3000.0, 4000.0), speed=1000.0, turning=1.0)
    times = np.arange(0, 600, 0.01)
    x, y, heading = path.at(times).T
    assert -4000 <= x.min() < x.max() <= 4000
    assert -3000 <= y.min() < y.max() <= 4000
    speed = np.hypot(np.diff(x), np.diff(y)) / 0.01
    assert 500 < speed.max() < 1001
    assert np.abs(np.diff(heading)).max() / 0.01 < 1.001
    assert np.ptp(x) > 1000
    assert path(1.0) == pytest.approx(tuple(path.at(np.array([1.0]))[0]))


def test_refuses_what_cannot_be() -> None:
    with pytest.raises(ValueError, match="area"):
        Wander(0, (1.0, -1.0, 0.0, 1.0))
    with pytest.raises(ValueError, match="probability"):
        Faults(lost=1.5)
    with pytest.raises(ValueError, match="inf is never"):
        Faults(dark_every=0.0)
    with pytest.raises(ValueError, match="z = 0"):
        world([Led(0, (0.0, 0.0, 100.0))])
    with pytest.raises(ValueError, match="once"):
        world([Led(0, (0.0, 0.0, 0.0)), Led(0, (1.0, 0.0, 0.0))])


# -- endurance: an hour, 40 LEDs, everything that can go wrong


def test_an_hour_of_everything() -> None:
    report = run(1.0, seed=1)
    assert not report.failures(), str(report)
    assert report.losses > 20, "nothing happened"
    assert len(report.recoveries) > 20
    assert report.possible > 0.9 * report.frames
    assert report.locked > 0.9 * report.possible


def test_a_run_that_is_interrupted_says_what_it_has(capsys: Any) -> None:
    def reports() -> Any:
        going = hours(0.001, seed=1)
        yield next(going)
        raise KeyboardInterrupt

    assert show("in a test", reports()) == INTERRUPTED
    far, end = capsys.readouterr().out.splitlines()[:2]
    assert far.startswith("… 0.1 min, 973 frames, at ")
    assert "in a test: 0.1 min, 973 frames, at " in end
    assert end.endswith("INTERRUPTED")
    assert show("in a test", iter([Report()])) == 0


def test_a_run_that_is_interrupted_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(endurance, "FRAMES", 1000)
    monkeypatch.setattr(endurance, "WARM", 300)
    state = tmp_path / "new" / "state"

    def seen(report: Report) -> list[object]:
        return [report.frames, report.locked, report.losses, report.useful, *report.errors]

    *_, straight = [seen(report) for report in hours(4.0, seed=1)]
    begun = hours(4.0, seed=1, state=state)
    assert [next(begun).frames for _ in range(4)] == [300, 1000, 2000, 3000]
    begun.close()
    state.with_suffix(".part").write_bytes(b"half")  # as if the machine had stopped while writing
    *_, again = [seen(report) for report in hours(4.0, seed=1, state=state)]
    assert again == straight


def test_room_is_seen_from_anywhere() -> None:
    leds = room()
    table, _ = head()
    for seed in range(3):
        path = Wander(seed, (-4000.0, 4000.0, -4000.0, 4000.0))
        place = SpikeWorld(leds, table, path, sh_period=400, icg_period=14_800, faults=NEVER)
        assert min(place.visible(n) for n in range(0, 20_000, 101)) >= 3
