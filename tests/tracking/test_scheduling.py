import math
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from acquisition.protocol import CHAIN_FIRST, CHAIN_STEP, EXPOSURE_MIN, Command, Mode
from tests.tracking.endurance import ICG_PERIOD, SH_PERIOD, follow, head, led_map, room
from tracking.camera import Camera
from tracking.leds import LedMap
from tracking.motion import MotionFilter
from tracking.poses import Fix, PoseFlags
from tracking.scheduling import (
    ExposureControl,
    Greedy,
    PredictedVisible,
    RoundRobin,
    allowed,
)
from tracking.spikes import Spike, SpikeFlags
from twin.spikes import Faults, SpikeWorld, Wander

CAMERA = Camera(4244.0, 1823.5, (-0.42, 0.2))
ROOM = led_map(room())
POLICIES = [RoundRobin, PredictedVisible, Greedy]


def at(pose: Any, leds: Any = ROOM, sigmas: Any = (1.0, 1.0, 1e-3)) -> Any:
    motion = MotionFilter(CAMERA, leds)
    cov = np.diag(np.square(sigmas))
    x, y, heading = pose
    motion.start(
        Fix(x, y, heading, 0.0, cov, np.zeros(0), np.zeros(0, bool), 0.0, 0, PoseFlags.NONE), 0
    )
    return motion


def spike(height: Any = 16_000.0, flags: Any = SpikeFlags.NONE) -> Any:
    return Spike(1800.0, 0.05, 10.0, height, flags)


# -- what the firmware takes


def test_exposures_are_made_such_as_the_firmware_takes() -> None:
    random = np.random.default_rng(1)
    for _ in range(300):
        channels = random.choice(64, random.integers(1, 12), replace=False).tolist()
        wanted = {n: float(t) for n, t in zip(channels, random.uniform(0, 600, 12), strict=False)}
        lit = allowed(wanted, 400)
        Command(400, 14_800, 0, Mode.STREAM, [lit])  # it refuses what the firmware would
        assert lit.keys() == wanted.keys()
        for n, clocks in lit.items():
            assert clocks <= max(wanted[n], EXPOSURE_MIN)
            if n < CHAIN_FIRST:
                assert clocks == int(min(max(wanted[n], EXPOSURE_MIN), 400))
        steps = sorted({clocks for n, clocks in lit.items() if n >= CHAIN_FIRST})
        assert all(b - a >= CHAIN_STEP for a, b in pairwise(steps))


@pytest.mark.parametrize("policy", POLICIES)
@pytest.mark.parametrize("per_frame", [1, 3])
@pytest.mark.parametrize("lost", [False, True])
def test_sequences_are_commands(policy: Any, per_frame: Any, lost: Any) -> None:
    motion = at((500.0, -200.0, 0.7)) if not lost else MotionFilter(CAMERA, ROOM)
    schedule = policy(ROOM, SH_PERIOD, ICG_PERIOD, per_frame=per_frame)
    sequence = schedule.sequence(motion, 0, 16)
    assert len(sequence) == 16
    assert all(1 <= len(lit) <= per_frame for lit in sequence)
    command = Command(SH_PERIOD, ICG_PERIOD, 0, Mode.STREAM, sequence)
    assert list(command.sequence) == sequence
    with pytest.raises(ValueError, match="table"):
        schedule.sequence(motion, 0, 64 // per_frame + 1)


# -- which LEDs


def test_round_robin_takes_one_after_the_other() -> None:
    schedule = RoundRobin(ROOM, SH_PERIOD, ICG_PERIOD)
    lit = [next(iter(frame)) for _ in range(10) for frame in schedule.sequence(at((0, 0, 0)), 0, 8)]
    assert lit == list(range(40)) * 2


@pytest.mark.parametrize("policy", [PredictedVisible, Greedy])
def test_only_leds_that_can_be_seen_are_lit(policy: Any) -> None:
    motion = at((500.0, -200.0, 0.7))
    expected = motion.expected()
    visible = {n for n, seen in zip(expected.channels, expected.visible, strict=True) if seen}
    schedule = policy(ROOM, SH_PERIOD, ICG_PERIOD, per_frame=2)
    lit = {n for frame in schedule.sequence(motion, 0, 24) for n in frame}
    assert lit <= visible
    assert len(lit) >= 3


@pytest.mark.parametrize("policy", [PredictedVisible, Greedy])
def test_spikes_of_a_frame_are_apart(policy: Any) -> None:
    # 20 LEDs 60 mm apart: from 4 m their spikes are 64 px apart
    leds = LedMap.line(20, 60.0)
    motion = at((0.0, 4000.0, 0.0), leds)
    schedule = policy(leds, SH_PERIOD, ICG_PERIOD, per_frame=4, apart=150.0, latency=0)
    expected = motion.expected()
    for lit in schedule.sequence(motion, 0, 10):
        assert len(lit) >= 3
        places = sorted(expected.pixels[expected.channels.index(n)] for n in lit)
        assert min(np.diff(places)) > 150.0


def test_greedy_seeks_what_is_not_known() -> None:
    # range is told by LEDs far from each other, place along the line by any
    leds = LedMap([0, 1, 2], [(-1000.0, 0.0), (0.0, 0.0), (1000.0, 0.0)])
    schedule = Greedy(leds, SH_PERIOD, ICG_PERIOD, latency=0)
    across = at((0.0, 4000.0, 0.0), leds, (100.0, 0.01, 1e-6))
    along = at((0.0, 4000.0, 0.0), leds, (0.01, 100.0, 1e-6))
    assert next(iter(schedule.sequence(across, 0, 1)[0])) in (0, 1, 2)
    assert next(iter(schedule.sequence(along, 0, 1)[0])) in (0, 2)


def test_an_led_that_is_not_found_waits_and_comes_back() -> None:
    motion = at((500.0, -200.0, 0.7))
    schedule = Greedy(ROOM, SH_PERIOD, ICG_PERIOD)
    first = next(iter(schedule.sequence(motion, 0, 1)[0]))
    missing = Spike(math.nan, math.inf, math.nan, math.nan, SpikeFlags.MISSING)
    for n in range(6):
        schedule.observe(n * 3_700_000, {first: 100}, {first: missing})
    row = ROOM.index(first)
    assert schedule.chances(0.02)[row] < 0.1
    assert first not in schedule.sequence(motion, 20_000_000, 1)[0]
    assert schedule.chances(5.0)[row] > 0.95
    schedule.observe(30_000_000, {first: 100}, {first: spike()})
    assert schedule.chances(0.03)[row] == 1.0


def test_search_lights_everything_but_first_what_should_be_seen() -> None:
    motion = at((500.0, -200.0, 0.7))
    expected = motion.expected()
    visible = {n for n, seen in zip(expected.channels, expected.visible, strict=True) if seen}
    motion.lost, motion.losses = True, 1
    schedule = Greedy(ROOM, SH_PERIOD, ICG_PERIOD, per_frame=3)
    lit = [next(iter(frame)) for frame in schedule.sequence(motion, 0, 21)]
    assert sum(n in visible for n in lit[:15]) > 8
    for _ in range(8):
        lit += [next(iter(frame)) for frame in schedule.sequence(motion, 0, 21)]
    assert set(lit) == set(range(40))


# -- how long


def test_exposure_follows_the_heights_measured() -> None:
    leds = LedMap([0, 1], [(0.0, 0.0), (500.0, 0.0)])
    control = ExposureControl(leds, 400, peak=16_000.0, gain=1e8)
    true = np.array([3e7, 3e8])  # one LED is weaker, one stronger than expected
    for n in range(20):
        flux = control.fluxes(0.0, 3000.0, n * 0.01)
        clocks = control.clocks(flux).astype(int)
        real = flux / control_gains(control, n * 0.01) * true
        for row in (0, 1):
            height = float(real[row] * clocks[row])
            full = height > 30_000
            flag = SpikeFlags.SATURATED if full else SpikeFlags.NONE
            control.learn(
                row, int(clocks[row]), spike(min(height, 30_000.0), flag), flux[row], n * 0.01
            )
    clocks = control.clocks(control.fluxes(0.0, 3000.0, 0.2))
    heights = control.fluxes(0.0, 3000.0, 0.2) / control_gains(control, 0.2) * true * clocks
    # the stronger one gets 12 clocks: whole ones are 8 % apart
    assert heights[0] == pytest.approx(16_000, rel=0.05)
    assert heights[1] == pytest.approx(16_000, rel=0.15)


def control_gains(control: Any, seconds: Any) -> Any:
    """What the control takes for the LEDs' gains at a time."""
    weight = np.exp(np.minimum(control._learnt - seconds, 0.0))
    return np.exp(control._common + weight * (control._gains - control._common))


def test_near_leds_are_lit_for_less_and_from_behind_not_at_all() -> None:
    leds = LedMap([0, 1, 2], [(0.0, 0.0), (0.0, 3000.0), (0.0, 0.0)], [0.0, 0.0, math.pi])
    control = ExposureControl(leds, 400)
    fluxes = control.fluxes(0.0, 4000.0, 0.0)
    assert fluxes[1] > 5 * fluxes[0] > 0
    assert fluxes[2] == 0
    assert control.clocks(fluxes)[1] < control.clocks(fluxes)[0]
    assert control.clocks(fluxes).min() >= EXPOSURE_MIN
    assert control.clocks(fluxes).max() <= 400


# -- what must be shown: 40 LEDs in 10 × 10 m


@pytest.fixture(scope="module")
def outcomes() -> Any:
    table, camera = head()
    result = {}
    for policy, per_frame in ((RoundRobin, 1), (PredictedVisible, 1), (Greedy, 3)):
        world = SpikeWorld(
            room(),
            table,
            Wander(3, (-4000.0, 4000.0, -4000.0, 4000.0)),
            sh_period=SH_PERIOD,
            icg_period=ICG_PERIOD,
            faults=Faults.none(),
            seed=3,
        )
        schedule = policy(ROOM, SH_PERIOD, ICG_PERIOD, per_frame=per_frame)
        result[policy] = follow(world, MotionFilter(camera, ROOM), schedule, 5000)
    return result


def test_six_times_the_useful_exposures(outcomes: Any) -> None:
    useful = {policy: report.useful for policy, report in outcomes.items()}
    assert useful[Greedy] >= 6 * useful[RoundRobin]
    # one LED a frame cannot be better than all of them useful: 40 over the number that is seen
    assert useful[PredictedVisible] > 0.95 * outcomes[PredictedVisible].lit
    assert useful[PredictedVisible] > 5 * useful[RoundRobin]
    for policy in (PredictedVisible, Greedy):
        assert useful[policy] > 0.9 * outcomes[policy].lit


def test_and_the_pose_is_better_for_it(outcomes: Any) -> None:
    for policy, most in ((PredictedVisible, 2.0), (Greedy, 1.5)):
        assert np.median(outcomes[policy].errors) < most
        assert outcomes[policy].losses <= 1
    # 26 ms from one spike to the next: lock is lost again and again, and what is between is doubtful
    assert outcomes[RoundRobin].losses > 20
    assert outcomes[RoundRobin].locked < 0.5 * outcomes[Greedy].locked
    for report in outcomes.values():
        assert report.wrong == 0


# -- edges


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"per_frame": 0}, "per_frame"),
        ({"per_frame": 41}, "per_frame"),
        ({"latency": -1}, "latency"),
        ({"apart": -1.0}, "apart"),
    ],
)
def test_refuses_numbers_out_of_range(options: Any, message: Any) -> None:
    with pytest.raises(ValueError, match=message):
        Greedy(ROOM, SH_PERIOD, ICG_PERIOD, **options)


def test_refuses_periods_that_the_firmware_would() -> None:
    with pytest.raises(ValueError, match="multiple"):
        Greedy(ROOM, 399, ICG_PERIOD)
