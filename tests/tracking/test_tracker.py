"""The tracker: from frames to poses, from the first light on, through loss and recovery."""

from __future__ import annotations

import math
import subprocess
import sys
from dataclasses import dataclass, field, replace
from itertools import islice, pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from scipy.stats import chi2  # type: ignore[import-untyped]

from acquisition.capture import Capture
from acquisition.frames import ELEMENTS, LEADING, PIXELS, Frame, FrameFlags, SpikeFrame
from acquisition.links import ReplayLink
from acquisition.protocol import Command, Mode
from raytransfer.designs import DESIGNS
from tracking.calibration import Calibration
from tracking.camera import Camera
from tracking.leds import LedMap
from tracking.motion import Outcome
from tracking.nominal import nominal_camera
from tracking.poses import Estimate, PoseFlags, Prior, optical
from tracking.spikes import Spike, SpikeFlags
from tracking.tracker import Step, Tracker, default_schedule, first_command, follow, track
from twin.link import TwinLink
from twin.rooms import load_room

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from numpy.typing import NDArray

ICG = 14800
PERIOD = 3_700_000  # ns
CAMERA = Camera(3500.0, 1830.0, (0.02,), pupil=8.0, model_error=0.01)
TWO = LedMap.line(2, 500.0)
NINE = LedMap.line(9, 500.0, 300.0)
GAIN = 47.0  # electrons per code
PEAK = 2.5e9  # electrons mm² per clock

Pose = tuple[float, float, float]


@dataclass
class Room:
    """Frames as a narrow-spiked head would see them; light as in the inverse square law."""

    leds: LedMap
    path: Callable[[float], Pose]
    hidden: Callable[[float], set[int]] = lambda _: set()
    ghosts: Callable[[float], list[tuple[float, float]]] = lambda _: []
    seed: int = 1304
    power: float = 1.0
    icg_period: int = ICG
    number: int = 0
    truth: dict[int, Pose] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._rng = np.random.default_rng(self.seed)

    def frame(self, lit: Mapping[int, int], **options: Any) -> Frame:
        t_ns = 30_000_000 + self.number * self.icg_period * 250
        self.truth[t_ns] = self.path(t_ns * 1e-9)
        electrons = np.full(PIXELS, 200.0)
        places = np.arange(PIXELS)
        hidden = self.hidden(t_ns * 1e-9)
        spikes = []
        for channel, clocks in lit.items():
            middle = self.path((t_ns - clocks * 125) * 1e-9)
            (point,) = optical(self.leds.positions[[self.leds.index(channel)]], *middle)
            if channel not in hidden and point[2] > 100:
                height = self.power * PEAK * clocks / float(point @ point)
                spikes.append((float(CAMERA.project(point)), height))
        for at, height in [*spikes, *self.ghosts(t_ns * 1e-9)]:
            electrons += height * np.exp(-(((places - at) / 5.0) ** 2) / 2)
        noisy = self._rng.poisson(np.minimum(electrons, 85_000)) + self._rng.normal(0, 60, PIXELS)
        elements = np.full(ELEMENTS, 3900.0)
        elements[LEADING : LEADING + PIXELS] -= noisy / GAIN
        values = {
            "sequence": self.number,
            "leds": sum(1 << channel for channel in lit),
            "exposures": dict(lit),
            "sh_period": 100,
            "icg_period": self.icg_period,
            "timestamp": t_ns,
            **options,
        }
        self.number += 1
        return Frame(np.rint(np.clip(elements, 0, 4095)).astype(np.uint16), **values)

    def run(self, tracker: Tracker, count: int) -> list[Step]:
        """Light what the tracker asks for, three frames late as over the link."""
        planned: list[dict[int, int]] = tracker.sequence() or []
        now, steps = planned, []
        waiting: list[tuple[int, list[dict[int, int]]]] = []
        for number in range(count):
            steps.append(tracker.step(self.frame(now[number % len(now)])))
            if (wanted := tracker.sequence()) is not None:
                waiting.append((number + 3, wanted))
            if waiting and waiting[0][0] <= number:
                now = waiting.pop(0)[1]
        return steps

    def errors(self, steps: Sequence[Step]) -> NDArray[np.float64]:
        """Estimate − truth of x, y and heading, of the steps with a pose."""
        return np.array(
            [np.subtract(pose(s.estimate), self.truth[s.t_ns]) for s in steps if s.estimate]
        )


def pose(estimate: Estimate) -> Pose:
    return estimate.x, estimate.y, estimate.heading


def rest(x: float, y: float, heading: float = 0.0) -> Callable[[float], Pose]:
    return lambda _: (x, y, heading)


def circle(seconds: float) -> Pose:
    """1 m/s around (0, 2500), turning by ± 10°."""
    angle = seconds / 0.6
    return (
        600 * math.sin(angle),
        2500 + 600 * math.cos(angle),
        math.radians(10) * math.sin(2 * seconds),
    )


def tracker(leds: LedMap, **options: Any) -> Tracker:
    return Tracker(Calibration(CAMERA, leds), **{"led_error": 0.0, **options})


# --- two LEDs ---------------------------------------------------------------------------------------


def test_two_leds_with_known_heading() -> None:
    room = Room(TWO, rest(120.0, 1700.0))
    steps = room.run(tracker(TWO), 60)
    assert [s.lit for s in steps[:3]] == [(), (0,), (1,)]  # first the background, then each LED
    assert [s.estimate is None for s in steps[:3]] == [True, True, False]
    assert all(s.estimate for s in steps[2:])
    last = steps[-1].estimate
    assert last is not None
    assert last.flags == PoseFlags.HEADING_ASSUMED | PoseFlags.UNCHECKED  # one by the other
    assert last.heading == 0
    assert last.covariance[2, 2] == 0
    error = room.errors(steps[20:])
    sigma = np.sqrt(np.diag(last.covariance))[:2]
    assert (np.abs(error[:, :2]).max(axis=0) < 4 * sigma).all()
    assert (sigma < (0.1, 1.0)).all()


def test_a_heading_that_is_given_is_used() -> None:
    turned = math.radians(12)
    room = Room(TWO, rest(-200.0, 2000.0, turned))
    wrong = room.errors(room.run(tracker(TWO), 40))[-1]
    right = room.errors(room.run(tracker(TWO, heading=Prior(turned, 0.0)), 40))[-1]
    assert abs(wrong[0]) > 300
    assert abs(right[0]) < 0.5
    assert abs(right[1]) < 2


def test_the_time_is_the_end_of_the_exposure() -> None:
    """LEDs that are lit for 1 ms show where the tracker was half of that earlier."""
    room = Room(TWO, lambda s: (1000 * (s - 0.1), 2000.0, 0.0), power=1 / 40)
    follower = tracker(TWO)
    steps = [follower.step(room.frame({0: 4000, 1: 4000}, sh_period=4000)) for _ in range(60)]
    assert abs(room.errors(steps[30:])[:, 0].mean()) < 0.1  # not 0.5 mm


# --- three and more -------------------------------------------------------------------------------


def test_heading_is_measured_with_three_and_more() -> None:
    leds = LedMap.line(3, 500.0, 300.0)
    turned = math.radians(-7)
    room = Room(leds, rest(50.0, 2200.0, turned))
    steps = room.run(tracker(leds), 150)
    last = steps[-1].estimate
    assert last is not None
    assert last.flags == PoseFlags.UNCHECKED  # three LEDs fit some pose whatever they say
    error = np.abs(room.errors(steps[80:])).max(axis=0)
    assert (error < 5 * np.sqrt(np.diag(last.covariance))).all()
    assert (error < (3, 1, 2e-3)).all()


def test_follows_at_a_metre_per_second() -> None:
    room = Room(NINE, circle)
    steps = room.run(tracker(NINE), 540)
    first = next(n for n, s in enumerate(steps) if s.estimate)
    assert first < 3 * len(NINE)
    known = steps[first + 20 :]
    assert not any(s.estimate.flags & PoseFlags.LOST for s in known if s.estimate)
    rms = np.sqrt((room.errors(known) ** 2).mean(axis=0))
    assert (rms < (1.0, 0.5, 5e-4)).all(), rms
    seen = [i for s in known for i in s.innovations]
    assert np.mean([i.outcome is Outcome.USED for i in seen]) > 0.98
    # several LEDs a frame, and their exposures such that no spike is full
    assert np.mean([len(s.lit) for s in known]) > 2.5
    for step in known:
        for channel, clocks in step.frame.exposures.items():
            at = room.leds.positions[room.leds.index(channel)]
            distance = math.dist(at[:2], room.truth[step.t_ns][:2])
            assert PEAK * clocks / distance**2 < 60_000


def test_errors_are_not_larger_than_stated() -> None:
    """Normalised by the covariance, over many runs: 3 on average for three unknowns, or less."""
    values = []
    for seed in range(12):
        room = Room(NINE, circle, seed=seed)
        step = room.run(tracker(NINE), 60)[-1]
        assert step.estimate is not None
        error = np.subtract(pose(step.estimate), room.truth[step.t_ns])
        values.append(error @ np.linalg.solve(step.estimate.covariance, error))
    assert np.mean(values) < chi2.ppf(0.999, 3 * len(values)) / len(values)


def test_a_reflection_outside_the_window_is_not_looked_at() -> None:
    room = Room(NINE, circle, ghosts=lambda s: [(500.0, 50_000.0)] if 0.3 < s < 0.6 else [])
    steps = [s for s in room.run(tracker(NINE), 170) if s.t_ns > 0.3e9]
    assert len(steps) > 75
    assert np.abs(room.errors(steps)).max(axis=0)[0] < 1
    assert all(s.estimate and s.estimate.flags == PoseFlags.NONE for s in steps if s.lit)


BAD = PoseFlags.LOST | PoseFlags.REJECTED | PoseFlags.PREDICTED | PoseFlags.INCONSISTENT


def test_a_lamp_that_a_spike_meets_is_told() -> None:
    """Brighter than the LED, and always on: what it pulls away is flagged, and comes back."""
    room = Room(NINE, circle, ghosts=lambda s: [(500.0, 50_000.0)] if 0.3 < s < 0.9 else [])
    steps = room.run(tracker(NINE, unlit_every=0), 400)
    assert all(s.lit for s in steps)
    met = [s.estimate.flags & BAD for s in steps if s.estimate and 0.6 < s.t_ns * 1e-9 < 0.8]
    assert sum(map(bool, met)) > 5
    plain = [s for s in steps[60:] if s.estimate and not s.estimate.flags & BAD]
    assert np.abs(room.errors(plain)).max(axis=0)[0] < 6
    after = [s for s in steps if s.t_ns * 1e-9 > 1.3]
    assert np.abs(room.errors(after)).max(axis=0)[0] < 1


def test_a_steady_lamp_is_subtracted() -> None:
    """The same lamp with frames between in which no LED is lit."""
    room = Room(NINE, circle, ghosts=lambda s: [(500.0, 50_000.0)] if 0.3 < s < 0.9 else [])
    steps = room.run(tracker(NINE), 400)
    unlit = [not s.lit for s in steps]
    assert 0.04 < np.mean(unlit) < 0.1
    met = [s for s in steps if s.estimate and s.t_ns * 1e-9 > 0.3]
    assert np.abs(room.errors(met)).max(axis=0)[0] < 1
    assert not any(s.estimate.flags & BAD for s in met if s.estimate and s.lit)


def test_two_leds_are_found_beside_a_brighter_lamp() -> None:
    """Without the unlit frame, the strongest spike of the line would be taken for either LED."""
    room = Room(TWO, rest(120.0, 1700.0), ghosts=lambda _: [(2500.0, 70_000.0)])
    steps = room.run(tracker(TWO), 60)
    assert steps[2].estimate is not None
    assert np.abs(room.errors(steps[20:])).max(axis=0)[:2].max() < 1
    blind = room.run(tracker(TWO, unlit_every=0), 60)
    assert np.abs(room.errors([s for s in blind if s.estimate])).max(initial=1e3) > 100


def test_a_lamp_that_has_moved_is_not_subtracted() -> None:
    """It would leave a hole where it was, and itself where it is; an LED over it only adds light."""
    lamps = [(1000.0, 30_000.0)]
    room = Room(TWO, rest(0.0, 2000.0), ghosts=lambda _: lamps)
    follower = tracker(TWO)
    dark = room.frame({})
    follower.update(dark)
    window = [(900, 1100)]
    assert follower._background(room.frame({0: 60}), window) is dark
    assert follower._background(room.frame({0: 60}), [(1100, 1200)]) is None  # it is not there
    assert follower._background(room.frame({0: 60})) is dark
    assert follower._background(room.frame({0: 60}, sh_period=200), window) is None
    lamps.append((1003.0, 20_000.0))
    assert follower._background(room.frame({0: 60}), window) is dark
    for moved in ([], [(1003.0, 30_000.0)], [(996.0, 30_000.0)], [(1000.0, 20_000.0)]):
        lamps[:] = moved
        assert follower._background(room.frame({0: 60}), window) is None
    lamps[:] = []
    follower.update(room.frame({}))
    assert follower._background(room.frame({0: 60})) is None  # nothing to subtract


def test_what_hides_a_spikes_place_widens_it() -> None:
    """A reflection beside it while there is no gate, and the end of the line."""
    follower = tracker(TWO)
    plain = Spike(1500.0, 0.02, 40.0, 3e4)
    for position, flags in ((1500.0, SpikeFlags.REFLECTION), (25.0, SpikeFlags.NONE)):
        judged = follower._judged(0, replace(plain, position=position, flags=flags))
        assert judged.flags & (SpikeFlags.DOUBLE | SpikeFlags.CLIPPED)
    assert follower._judged(0, plain) == plain
    caustic = replace(plain, flags=SpikeFlags.DOUBLE)
    assert follower._judged(0, caustic) == plain
    wide = replace(caustic, width=80.0)
    assert follower._judged(0, wide) == wide
    Room(TWO, rest(120.0, 1700.0)).run(follower, 20)
    assert follower.locked
    reflected = replace(plain, flags=SpikeFlags.REFLECTION)
    assert follower._judged(0, reflected) == reflected


# --- rooms and rates of all kinds -----------------------------------------------------------------

CORRIDOR = LedMap(range(4), [[-2500.0, 0.0], [2500.0, 0.0], [-2500.0, 1000.0], [2500.0, 1000.0]])


@pytest.mark.parametrize(
    ("leds", "options"),
    [
        (LedMap([0, 1], [[0.0, -2000.0], [0.0, 2000.0]]), {}),
        (LedMap([0, 1], [[-2000.0, 0.0], [2000.0, 0.0]]), {}),
        (CORRIDOR, {}),
        (NINE, {"height": Prior(1e9, 0.0)}),
        (NINE, {"height": Prior(0.0, 1e9)}),
    ],
)
def test_any_room_is_begun_in(leds: LedMap, options: dict[str, Any]) -> None:
    """From where, to warm up, one might have looked, some of these LEDs are not in the field."""
    assert not tracker(leds, **options).locked


COMPILED = """
from tests.tracking.test_tracker import CORRIDOR, Room, rest, tracker
from tracking import _motion, _poses, _spikes

def compiled():
    kernels = [k for m in (_motion, _poses, _spikes) for k in vars(m).values()]
    return sum(len(k.signatures) for k in kernels if hasattr(k, "signatures"))

follower = tracker(CORRIDOR)
before = compiled()
steps = Room(CORRIDOR, rest(100.0, 7000.0)).run(follower, 80)
assert steps[-1].estimate, "no pose"
print(before, compiled())
"""


def test_no_frame_waits_for_a_compiler() -> None:
    out = subprocess.run(
        [sys.executable, "-c", COMPILED], capture_output=True, text=True, check=True
    )
    before, after = map(int, out.stdout.split())
    assert before == after > 10


@pytest.mark.parametrize(
    ("leds", "seen"),
    [
        (LedMap.line(11, 300.0, 300.0), {3, 5, 8}),
        (
            LedMap(range(40), [(300.0 * (n - 20), 0 if n % 2 else 300) for n in range(40)]),
            {18, 20, 23},
        ),
    ],
    ids=["11", "40"],
)
def test_three_leds_of_many_are_enough(leds: LedMap, seen: set[int]) -> None:
    """The others are behind something: those found must not wait for all of these."""
    room = Room(leds, rest(0.0, 2500.0), hidden=lambda _: set(leds.channels) - seen)
    steps = room.run(tracker(leds), 135)
    assert steps[-1].t_ns - steps[0].t_ns < 0.5e9
    assert steps[-1].estimate is not None
    assert np.abs(room.errors(steps[-1:])).max(axis=1)[0] < 1


@pytest.mark.parametrize(
    ("leds", "icg_period"),
    [(LedMap.line(3, 500.0, 300.0), 60_000), (NINE, 60_000), (NINE, 200_000), (TWO, 400_000)],
    ids=["3 at 67 Hz", "9 at 67 Hz", "9 at 20 Hz", "2 at 10 Hz"],
)
def test_slow_frames(leds: LedMap, icg_period: int) -> None:
    """At rest a pose is found, and held. The first one, still rough, may be lost once more."""
    room = Room(leds, rest(0.0, 2500.0), icg_period=icg_period)
    follower = tracker(leds, schedule=default_schedule(leds, 100, icg_period))
    steps = room.run(follower, 100)
    first = next(n for n, s in enumerate(steps) if s.estimate)
    assert first < 25
    assert follower.losses <= 1
    settled = steps[40:]
    assert not any(s.estimate.flags & PoseFlags.LOST for s in settled if s.estimate)
    errors = np.abs(room.errors(settled))
    sigmas = np.array([np.sqrt(np.diag(s.estimate.covariance)) for s in settled if s.estimate])
    assert (errors[:, :2] < 5 * sigmas[:, :2]).all()


def test_the_period_is_that_of_the_frames() -> None:
    """A recording is slower than the schedule, by which nobody goes."""
    leds = LedMap.line(3, 500.0, 300.0)
    room = Room(leds, rest(0.0, 2500.0), icg_period=60_000)
    steps = room.run(tracker(leds), 60)
    assert steps[-1].estimate is not None
    assert not steps[-1].estimate.flags & PoseFlags.LOST
    with pytest.raises(ValueError, match=r"a frame every 0\.2 s, heading not known: allowed is up"):
        tracker(leds).update(Room(leds, rest(0.0, 2500.0), icg_period=800_000).frame({0: 60}))


# --- loss and recovery ----------------------------------------------------------------------------


@pytest.mark.parametrize(("leds", "path"), [(TWO, rest(0, 1800)), (NINE, circle)])
def test_lock_is_lost_and_found_again(leds: LedMap, path: Callable[[float], Pose]) -> None:
    gone, back = 0.5, 1.2
    room = Room(leds, path, hidden=lambda s: set(leds.channels) if gone < s < back else set())
    steps = room.run(tracker(leds), 540)
    times = np.array([s.t_ns * 1e-9 for s in steps])
    flags = [s.estimate.flags if s.estimate else PoseFlags.LOST for s in steps]
    lost = np.array([bool(f & PoseFlags.LOST) for f in flags])
    assert not lost[(times > 0.2) & (times < gone)].any()
    assert lost[(times > gone + 0.45) & (times < back)].all()
    before = [f for f, t in zip(flags, times, strict=True) if gone < t < gone + 0.2]
    assert all(f & (PoseFlags.PREDICTED | PoseFlags.LOST) for f in before)
    found = times[~lost & (times > back)][0]
    assert found - back < 0.5
    assert not lost[times >= found].any()
    again = [t for f, t in zip(flags, times, strict=True) if f & PoseFlags.RELOCALISED]
    assert again == [found]  # and not in the beginning
    settled = [s for s in steps if s.t_ns * 1e-9 > found + 0.1]
    assert np.abs(room.errors(settled)).max(axis=0)[:2].max() < 10


def test_a_lost_pose_gets_less_sure_and_stays() -> None:
    room = Room(TWO, rest(0, 1800), hidden=lambda s: {0, 1} if s > 0.3 else set())
    steps = room.run(tracker(TWO), 350)
    lost = [s.estimate for s in steps if s.estimate and s.estimate.flags & PoseFlags.LOST]
    assert len(lost) > 50
    assert {pose(e) for e in lost} == {pose(lost[0])}
    sigmas = [math.sqrt(e.covariance[0, 0]) for e in lost]
    assert sigmas == sorted(sigmas)
    assert sigmas[-1] > 500


def test_a_tracker_that_was_carried_away_is_found() -> None:
    """As if lifted and put down elsewhere within a frame: spikes are where none should be."""
    jump = 0.6
    room = Room(NINE, lambda s: (-500.0, 2000.0, 0.0) if s < jump else (400.0, 3200.0, 0.2))
    steps = room.run(tracker(NINE), 440)
    late = [s for s in steps if s.t_ns * 1e-9 > jump + 0.9]
    assert np.abs(room.errors(late)).max(axis=0)[:2].max() < 5
    wrong = [
        s
        for s in steps
        if s.t_ns * 1e-9 > jump
        and s.estimate
        and abs(room.errors([s])[0][0]) > 100
        and not s.estimate.flags & (PoseFlags.LOST | PoseFlags.PREDICTED | PoseFlags.REJECTED)
    ]
    assert not wrong


# --- recordings -----------------------------------------------------------------------------------


def test_several_leds_from_the_first_frame_on() -> None:
    """A recording whose frames all have two LEDs lit: they are told apart by their order."""
    room = Room(TWO, rest(150.0, 2000.0))
    follower = tracker(TWO)
    steps = [follower.step(room.frame({0: 60, 1: 60})) for _ in range(30)]
    assert steps[0].estimate is not None
    assert np.abs(room.errors(steps)).max(axis=0)[:2].max() < 3


@pytest.mark.parametrize("turn", [0.0, math.pi / 2, math.pi, -2.0])
def test_several_leds_are_told_apart_on_any_wall(turn: float) -> None:
    """Their order is that along the wall, not that of x."""
    sin, cos = math.sin(turn), math.cos(turn)

    def turned(x: float, y: float) -> tuple[float, float]:
        return x * cos - y * sin, x * sin + y * cos

    facings = [math.remainder(turn + error, math.tau) for error in (0.0, 0.001, 0.0, 0.0)]
    wall = LedMap(range(4), [turned(x, 0.0) for x in (-600.0, -100.0, 300.0, 700.0)], facings)
    pose = (*turned(150.0, 2000.0), turn)
    room = Room(wall, rest(*pose))
    follower = tracker(wall)
    lit = dict.fromkeys(range(4), 60)
    steps = [follower.step(room.frame(lit)) for _ in range(30)]
    assert steps[-1].estimate is not None
    assert np.abs(room.errors(steps)).max(axis=0)[:2].max() < 5


@pytest.mark.parametrize(
    ("places", "facings"),
    [
        (
            [(-400.0, 0.0), (400.0, 0.0), (1000.0, 600.0), (1000.0, 1000.0)],
            [0.0, 0.0, math.pi / 2, math.pi / 2],
        ),
        ([(-400.0, 0.0), (0.0, 0.0), (100.0, 1000.0), (800.0, 0.0)], [0.0] * 4),
        ([(-400.0, 0.0, 0.0), (0.0, 0.0, 0.0), (400.0, 0.0, 0.0), (400.0, 0.0, 50.0)], [0.0] * 4),
    ],
    ids=["corner", "one far before the others", "one above the other"],
)
def test_several_leds_whose_order_is_not_known_are_not_guessed(places: Any, facings: Any) -> None:
    corner = LedMap(range(4), places, facings)
    room = Room(corner, rest(0.0, 3000.0, 0.2))
    follower = tracker(corner)
    for _ in range(30):
        step = follower.step(room.frame(dict.fromkeys(range(4), 60)))
        assert not step.innovations
    assert step.estimate is None
    for number in range(30):
        step = follower.step(room.frame({number % 4: 60}))
    assert step.estimate is not None


def test_frames_without_a_time_follow_each_other() -> None:
    room = Room(TWO, rest(0.0, 1500.0))
    follower = tracker(TWO)
    steps = [follower.step(room.frame({n % 2: 60}, timestamp=None)) for n in range(8)]
    assert np.diff([s.t_ns for s in steps]).tolist() == [PERIOD] * 7
    assert steps[-1].estimate is not None


def test_a_time_that_runs_back_begins_anew() -> None:
    room = Room(TWO, rest(0.0, 1500.0))
    follower = tracker(TWO)
    steps = room.run(follower, 20)
    assert follower.locked
    assert not any(s.estimate.flags & PoseFlags.RELOCALISED for s in steps if s.estimate)
    assert follower.update(room.frame({0: 60}, timestamp=1000, sequence=0)) is None
    assert follower.losses == 1
    estimate = follower.update(room.frame({1: 60}, timestamp=1000 + PERIOD, sequence=1))
    assert estimate is not None
    assert estimate.t_ns == 1000 + PERIOD
    assert estimate.flags & PoseFlags.RELOCALISED


def test_a_device_that_begins_anew_at_once_is_told_from_a_late_frame() -> None:
    """Time goes back by three frames as it might of a late one, but the number is the first."""
    room = Room(TWO, rest(0.0, 1500.0))
    follower = tracker(TWO)
    steps = room.run(follower, 20)
    back = steps[-4].t_ns
    assert follower.update(room.frame({0: 60}, timestamp=back, sequence=0)) is None
    assert not follower.locked


def test_the_schedule_does_not_remember_another_clock() -> None:
    hidden = {2, 3}
    room = Room(NINE, rest(0.0, 2500.0), hidden=lambda _: hidden)
    follower = tracker(NINE)
    room.run(follower, 120)
    assert follower.schedule.chances(0.5)[[2, 3]].max() < 0.7
    room.number = 0  # the device was reset
    follower.update(room.frame({0: 60}))
    assert (follower.schedule.chances(0.03)[1:] == 1).all()


def test_a_frame_that_comes_late_or_twice_changes_nothing() -> None:
    room = Room(NINE, circle)
    follower, other = tracker(NINE), tracker(NINE)
    frames = []
    for follows in (follower, other):
        room.number = 0
        room._rng = np.random.default_rng(1)
        frames = [step.frame for step in room.run(follows, 100)]
    late, newest = room.frame({0: 60}), room.frame({4: 60})
    expected = follower.update(newest)
    assert expected is not None
    assert other.update(newest) is not None
    for frame in (late, newest, frames[-3]):
        step = other.step(frame)
        assert step.estimate is None
        assert step.t_ns == frame.timestamp
        assert {found.outcome for found in step.innovations} <= {Outcome.STALE}
    assert other.locked
    assert other.losses == 0
    after = room.frame({0: 60, 4: 60})
    one, two = follower.update(after), other.update(after)
    assert one is not None
    assert two is not None
    assert pose(one) == pose(two)
    assert one.flags == two.flags
    assert not two.flags & PoseFlags.RELOCALISED


def test_an_invalid_frame_is_not_measured_on() -> None:
    room = Room(TWO, rest(0.0, 1500.0))
    follower = tracker(TWO)
    room.run(follower, 20)
    estimate = follower.update(room.frame({0: 60}, flags=FrameFlags.INVALID))
    assert estimate is not None
    assert estimate.flags & PoseFlags.PREDICTED
    assert follower.innovations == ()


def test_spikes_that_meet_are_left_out() -> None:
    """Two LEDs one behind the other, from there: what shows is one spike."""
    leds = LedMap([0, 1, 2], [[-400.0, 0.0], [0.0, 0.0], [0.0, 600.0]])
    room = Room(leds, rest(0.0, 2500.0))
    follower = tracker(leds, heading=Prior(0.0, 0.0))
    for number in range(12):
        follower.step(room.frame({number % 3: 60}))
    step = follower.step(room.frame({0: 60, 1: 60, 2: 60}))
    assert [i.channel for i in step.innovations] == [0]


def test_an_led_that_the_map_lacks_is_an_error() -> None:
    room = Room(LedMap.line(6, 300.0), rest(0.0, 1500.0))
    with pytest.raises(ValueError, match=r"is lit by LED 5, and the LED map has 0, 1: .*another"):
        tracker(TWO).update(room.frame({5: 60}))


@pytest.mark.parametrize(
    ("leds", "options", "message"),
    [
        (LedMap([3], [[0.0, 0.0]]), {}, "1 LED in the map: a pose needs two"),
        (TWO, {"heading": Prior(0.0, 0.1)}, "sigma of heading = 0.1: allowed is 0"),
        (TWO, {"heading": Prior(0.0, math.inf)}, "two LEDs do not tell the heading"),
        (TWO, {"unlit_every": 1}, "unlit_every = 1: allowed are 2 and more"),
        (TWO, {"heading": Prior(math.nan, 0.0)}, "value of heading = nan: allowed are finite"),
        (TWO, {"heading": Prior(math.inf, 0.0)}, "value of heading = inf: allowed are finite"),
        (NINE, {"heading": Prior(0.0, math.nan)}, "sigma of heading = nan: allowed is 0"),
        (NINE, {"schedule": default_schedule(TWO)}, "the schedule lights LEDs 0, 1 of a map that"),
        (
            NINE,
            {"schedule": default_schedule(NINE, 100, 200_100)},
            "every 0.050025 s, heading not known: allowed is up to 0.05 s, .* of 200000 clocks",
        ),
        (
            TWO,
            {"schedule": default_schedule(TWO, 100, 1_000_000)},
            "every 0.25 s, heading known: allowed is up to 0.1 s, .* of 400000 clocks",
        ),
    ],
)
def test_what_tells_no_pose_is_refused(leds: LedMap, options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        tracker(leds, **options)


# --- links ----------------------------------------------------------------------------------------


def test_a_replay_gives_the_same_poses() -> None:
    room = Room(NINE, circle)
    live = room.run(tracker(NINE), 120)
    estimates = [s.estimate for s in live if s.estimate]
    frames = [s.frame for s in live if isinstance(s.frame, Frame)]
    replayed = list(track(ReplayLink(frames), Calibration(CAMERA, NINE), led_error=0.0))
    assert len(replayed) == len(estimates) > 80
    for one, other in zip(replayed, estimates, strict=True):
        assert pose(one) == pose(other)
        assert one.flags == other.flags
        assert np.array_equal(one.covariance, other.covariance)


def test_track_ends_with_its_count() -> None:
    room = Room(TWO, rest(0.0, 1500.0))
    frames = [room.frame({n % 2: 60}) for n in range(50)]
    assert len(list(track(ReplayLink(frames), Calibration(CAMERA, TWO), count=20))) == 20
    some = track(ReplayLink(frames), Calibration(CAMERA, TWO))
    assert len(list(islice(some, 5))) == 5


def test_recordings_are_not_steered(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Capture, "send", lambda *_: pytest.fail("a recording cannot change"))
    room = Room(TWO, rest(0.0, 1500.0))
    frames = [room.frame({n % 2: 60}) for n in range(50)]
    assert list(track(ReplayLink(frames), Calibration(CAMERA, TWO)))


def test_the_first_command_has_the_schedules_periods() -> None:
    follower = tracker(NINE, schedule=default_schedule(NINE, 400, 16000))
    command = first_command(follower, count=7)
    assert (command.sh_period, command.icg_period, command.count) == (400, 16000, 7)
    assert command.mode is Mode.STREAM
    assert [len(lit) for lit in command.sequence] == [0, 1, 1, 1]  # blind: one by one
    spikes = first_command(tracker(NINE), spikes=True)
    assert all(len(lit) == 1 for lit in spikes.sequence)
    assert first_command(tracker(NINE)).icg_period == ICG


# --- the twin -------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def walk() -> tuple[Any, Calibration]:
    """A room in which the tracker walks, and what is known of it: the drawing and the plan."""
    room = load_room("walk")
    return room, Calibration(nominal_camera(DESIGNS["slit-4mm"]), LedMap(*room.known_leds()))


@pytest.mark.parametrize(
    ("spikes", "icg_period", "latest"), [(False, 16000, 8e-3), (True, 14800, 4.8e-3)]
)
def test_a_walk_through_the_firmware(
    walk: tuple[Any, Calibration], spikes: bool, icg_period: int, latest: float
) -> None:
    """Followed, in time, and no further off than it says: LEDs stand 0.3 mm off the plan."""
    room, calibration = walk
    there = []
    with TwinLink(room.world, seed=room.seed) as link:
        schedule = default_schedule(calibration.leds, icg_period=icg_period)
        follower = Tracker(calibration, schedule=schedule)
        with Capture(link, first_command(follower, count=150, spikes=spikes)) as capture:
            steps = []
            for step in follow(capture, follower):
                steps.append(step)
                there.append(link.machine.seconds)
            assert capture.statistics.good == 150
            assert capture.statistics.dropped == 0
        begin = link.clock_offset
    assert isinstance(steps[0].frame, SpikeFrame if spikes else Frame)
    times = np.array([s.t_ns for s in steps]) * 1e-9
    assert (np.array(there) - begin - times).max() < latest
    known = [s for s in steps if s.estimate]
    assert len(known) > 120
    errors, sigmas = [], []
    for step in known[20:]:
        assert step.estimate is not None
        assert not step.estimate.flags & PoseFlags.LOST
        true = room.world.pose(begin + step.t_ns * 1e-9)
        errors.append(np.subtract(pose(step.estimate), (true.x, true.y, true.heading)))
        sigmas.append(np.sqrt(np.diag(step.estimate.covariance)))
    assert (np.abs(errors) < 4 * np.array(sigmas)).all()
    assert (np.abs(errors).max(axis=0) < (12, 4, 4e-3)).all()
    # once a pose is known, three LEDs a frame, and nearly all of them are found
    lit = [s for s in known[20:] if s.lit]
    found = [i.outcome for s in lit for i in s.innovations]
    assert len(found) > 2.5 * len(lit)
    assert np.mean([outcome is Outcome.USED for outcome in found]) > 0.95


def test_windows_of_a_frame_do_not_overlap() -> None:
    """The device refuses such; LEDs may pass each other between now and when they are lit."""
    room = Room(NINE, circle)
    follower = tracker(NINE)
    room.run(follower, 200)
    merged = 0
    for first in range(len(NINE) - 1):
        lit = [dict.fromkeys(NINE.channels[first : first + 2 + first % 3], 40)] * 4
        for windows in follower.windows(lit):
            assert windows == sorted(windows)
            assert all(a[1] < b[0] for a, b in pairwise(windows))
            merged += 0 < len(windows) < len(lit[0])
            Command(100, 14800, 0, Mode.SPIKES, [lit[0]], [windows or [(0, 3647)]])
    assert merged
