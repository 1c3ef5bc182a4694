import math
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from acquisition.protocol import CHAIN_FIRST, CHAIN_STEP, EXPOSURE_MIN, Command, Mode
from tests.tracking.endurance import ICG_PERIOD, SH_PERIOD, Run, head, led_map, room
from tracking.calibration import Calibration
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
from tracking.tracker import Tracker
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


def missing() -> Any:
    return Spike(math.nan, math.inf, math.nan, math.nan, SpikeFlags.MISSING)


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
    for n in range(6):
        schedule.observe(n * 3_700_000, {first: 100}, {first: missing()})
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


def test_before_any_pose_leds_found_are_lit_more_often() -> None:
    """Three of 40 are in sight, which nobody knows: all are tried once, these then again."""
    schedule = PredictedVisible(ROOM, SH_PERIOD, ICG_PERIOD, latency=0)
    motion, seen, lit = MotionFilter(CAMERA, ROOM), {3, 17, 31}, []
    for number in range(100):
        t_ns = number * ICG_PERIOD * 250
        ((channel, clocks),) = schedule.sequence(motion, t_ns, 1)[0].items()
        lit.append(channel)
        found = spike() if channel in seen else missing()
        schedule.observe(t_ns, {channel: clocks}, {channel: found})
    assert set(lit[:60]) == set(range(40))
    again = [channel in seen for channel in lit[60:]]
    assert np.mean(again) > 0.4  # not 3 of 40
    assert len({*lit[60:]} - seen) > 5  # something else may be in sight soon


def test_search_lights_neighbours_of_what_was_found() -> None:
    """The tracker was turned in the dark: where it looked before, there is nothing any more."""
    motion = at((500.0, -200.0, 0.7))
    expected = motion.expected()
    unseen = [n for n, seen in zip(expected.channels, expected.visible, strict=True) if not seen]
    middle = unseen[len(unseen) // 2]
    motion.lost, motion.losses = True, 1
    schedule, lit = PredictedVisible(ROOM, SH_PERIOD, ICG_PERIOD, latency=0), []
    for number in range(200):
        t_ns = number * ICG_PERIOD * 250
        ((channel, clocks),) = schedule.sequence(motion, t_ns, 1)[0].items()
        lit.append(channel)
        found = spike() if channel == middle else missing()
        schedule.observe(t_ns, {channel: clocks}, {channel: found})
    counts = np.bincount(lit[lit.index(middle) :], minlength=40)
    near = [(middle + step) % 40 for step in (-1, 1)]
    far = [n for n in unseen if min(abs(n - middle), 40 - abs(n - middle)) > 5]
    assert counts[near].min() > 2 * counts[far].mean()
    assert counts[far].min() > 0


def test_a_search_in_turns_lights_one_led_a_frame() -> None:
    """Of several, of different walls, nobody could tell which is which."""
    schedule = RoundRobin(ROOM, SH_PERIOD, ICG_PERIOD, per_frame=3)
    motion = MotionFilter(CAMERA, ROOM)
    plans = [frame for _ in range(10) for frame in schedule.sequence(motion, 0, 4)]
    assert [next(iter(frame)) for frame in plans] == list(range(40))
    assert {len(frame) for frame in plans} == {1}


def test_before_any_pose_exposures_are_sought_by_each_led() -> None:
    """Long, medium, short until it is found; then as it needs; long again when it is gone."""
    schedule = RoundRobin(LedMap.line(2, 500.0), 400, ICG_PERIOD)
    motion = MotionFilter(CAMERA, LedMap.line(2, 500.0))

    def clocks(found: Any) -> Any:
        one, other = schedule.sequence(motion, 0, 2)
        lit = one | other
        schedule.observe(0, lit, {0: found, 1: missing()})
        return lit[0], lit[1]

    lit = [clocks(found) for found in (missing(), spike(8_000.0), spike(), missing(), missing())]
    assert [one for one, _ in lit] == [400, 100, 200, 200, 400]
    assert [other for _, other in lit] == [400, 100, 25, 400, 100]
    clocks(spike(36_000.0, SpikeFlags.SATURATED))
    assert clocks(spike())[0] == 25
    # nothing is learnt of how bright they are, as nobody knows how far away
    assert (schedule.exposure._learnt == -math.inf).all()


def test_a_schedule_forgets_with_its_clock() -> None:
    """What was learnt at times that are now in the future would never fade."""
    motion = at((500.0, -200.0, 0.7))
    schedule = Greedy(ROOM, SH_PERIOD, ICG_PERIOD)
    lit = {n: t for frame in schedule.sequence(motion, 0, 16) for n, t in frame.items()}
    hour = 3_600_000_000_000
    schedule.observe(hour, lit, {n: missing() if n % 2 else spike(1e5) for n in lit})
    alike = Greedy(ROOM, SH_PERIOD, ICG_PERIOD).exposure.fluxes(0.0, 0.0, 1.0)
    assert schedule.chances(1.0).min() < 0.6
    schedule.restart()
    assert (schedule.chances(1.0) == 1).all()
    gains = schedule.exposure.fluxes(0.0, 0.0, 1.0)[alike > 0] / alike[alike > 0]
    assert np.ptp(gains) < 1e-9 * gains.mean()  # of all LEDs the same: the mean stays


def test_slow_frames_are_forgotten_more_slowly() -> None:
    """A second is ten frames at 10 Hz: of 40 LEDs, each would be forgotten before its turn."""
    slow = Greedy(ROOM, SH_PERIOD, 400_000)
    slow.observe(0, {0: 100}, {0: missing()})
    assert slow.chances(2.0)[0] < 0.6


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
        tracker = Tracker(Calibration(camera, ROOM), schedule=schedule, led_error=0.0)
        result[policy] = Run(world, tracker).go(5000)
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
