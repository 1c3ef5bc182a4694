"""Chapter 5 on the twin: the figures that must come out, and what they are made of."""

from __future__ import annotations

import math
import sys
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from raytransfer import prototype_head
from raytransfer.designs import DESIGNS
from tracking.calibration import Calibration
from tracking.camera import Camera
from tracking.leds import LedMap
from tracking.poses import Prior, optical
from tracking.spikes import Spike
from twin import experiments
from twin.experiments import (
    BETTER,
    CALLS,
    DISTANCES,
    MOVES,
    Bench,
    Evaluation,
    Measured,
    Move,
    Placed,
    Prototype,
    Rest,
    Sight,
    Stage,
    Timing,
    Vibration,
    camera_constant,
    causes,
    comparison,
    fixed,
    looked,
    measured,
    prototype,
    respaced,
    rested,
    room,
    shaking,
    streamed,
)
from twin.link import TwinLink
from twin.world import Pose

if TYPE_CHECKING:
    from pathlib import Path

NEAR, FAR = DISTANCES


@pytest.fixture(scope="module")
def own() -> Prototype:
    return prototype()


@pytest.fixture(scope="module")
def inferred(own: Prototype) -> dict[float, Move]:
    return respaced(own.spacing)


@pytest.fixture(scope="module")
def both() -> tuple[Measured, ...]:
    return measured([prototype_head(), DESIGNS[BETTER].system])


@pytest.fixture(scope="module")
def better(both: tuple[Measured, ...]) -> Measured:
    return both[1]


@pytest.fixture(scope="module")
def timing() -> Timing:
    return streamed()


# --- the thesis's way


def test_x_scale_is_the_thesis(own: Prototype) -> None:
    assert own.x[FAR].scale == pytest.approx(83, rel=0.1)  # E1
    assert own.x[NEAR].scale == pytest.approx(253, rel=0.1)
    for line in own.x[FAR].slopes:  # every series of 21 on its own
        assert abs(100 * line.slope) == pytest.approx(83, rel=0.1)


def test_y_scale_is_the_thesis_once_the_spacing_is_inferred(
    own: Prototype, inferred: dict[float, Move]
) -> None:
    assert inferred[NEAR].middle == pytest.approx(1536, rel=0.01)
    assert 500 < own.spacing < 600
    assert inferred[FAR].scale == pytest.approx(12, rel=0.1)  # E2


def test_y_scale_at_130_cm_does_not_fit_the_thesis_own_separation(
    own: Prototype, inferred: dict[float, Move]
) -> None:
    # 82 px, where 1536 px that go with 1/y change by 110 or more
    for moves in (own.y, inferred):
        assert moves[NEAR].scale > 1.3 * 82


def test_exact_light_and_a_narrow_aperture_have_no_peaks_to_hop_between(own: Prototype) -> None:
    # what is named as the cause of the midpoint errors must be able to take them away
    x, y = experiments.gravity_moves(prototype_head(), FAR)
    assert x.scale == pytest.approx(own.x[FAR].scale, rel=0.02)
    assert x.midpoint_rms < 0.1 * own.x[FAR].midpoint_rms
    assert y.midpoint_rms < 0.1 * own.y[FAR].midpoint_rms


def test_vibration_adds_what_spikes_have_in_common(own: Prototype) -> None:
    still, shaken = own.jitter(own.still[0]), own.jitter(own.shaken)
    assert still[0].count == shaken[0].count == CALLS
    assert shaken[0].sigma > still[0].sigma
    assert shaken[0].sigma > 0.5 * 0.436


def test_a_call_takes_what_the_thesis_says(own: Prototype) -> None:
    assert own.call == pytest.approx(48.75e-3, abs=5e-3)  # R4
    assert 1 / own.call == pytest.approx(20, rel=0.15)  # R5


def few(seed: int) -> Rest:
    stage = Stage(Pose(50.0, NEAR))
    with TwinLink(room(prototype_head(), LedMap.line(2, 500), stage), seed=seed) as link:
        stage.vibration = shaking(seed)
        return rested(link, stage, Pose(50.0, NEAR), calls=6)


def test_same_seed_same_numbers() -> None:
    one, two, other = few(1), few(1), few(2)
    assert one.midpoint.tolist() == two.midpoint.tolist()
    assert one.separation.tolist() == two.separation.tolist()
    assert one.midpoint.tolist() != other.midpoint.tolist()


def test_camera_constant_of_the_head_with_and_without_its_glass() -> None:
    constant, front = camera_constant(prototype_head())
    # by the same matrices, but traced: a ray aimed at the front principal point keeps its angle
    system = prototype_head().matrix("x", wavelength=0.63)
    height, angle = (
        float(v)
        for v in np.array([[system.A, system.B], [system.C, system.D]]) @ [-front * 1e-3, 1e-3]
    )
    assert angle == pytest.approx(1e-3)
    assert height + angle * (prototype_head().sensor_distance or 0) == pytest.approx(
        constant * 1e-3
    )
    assert 28 < constant < 29.2


def test_vibration_has_the_rms_asked_for() -> None:
    vibration = Vibration(1e-3, seed=3)
    seconds = np.arange(0, 200, 0.0213)
    heading = np.array([vibration(t) for t in seconds.tolist()])
    assert math.sqrt(np.mean(heading**2)) == pytest.approx(1e-3, rel=0.05)
    assert abs(heading.mean()) < 1e-5
    # in two frames of a call, 7.5 ms apart, it is nearly the same
    later = np.array([vibration(t + 7.5e-3) for t in seconds.tolist()])
    assert np.std(later - heading) < 0.2e-3
    assert Vibration(1e-3, seed=4)(1.0) != vibration(1.0)


def test_move_of_a_pinhole() -> None:
    places = np.stack([MOVES, MOVES + 10])
    x = Move("x", 1300.0, places, 1824 - 2.5 * places)
    assert x.scale == pytest.approx(250)
    assert x.resolution == pytest.approx(0.4)
    assert x.spread == pytest.approx(0, abs=1e-9)
    assert x.midpoint_errors.shape == (2, 19)
    assert x.midpoint_rms == pytest.approx(0, abs=1e-9)
    y = Move("y", 1300.0, places, 2e6 / (1300 + places))
    assert y.middle == pytest.approx(2e6 / 1300)
    # the midpoint of a hyperbola: s (50/y)² / (1 - (50/y)²)
    at = y.midpoint_errors[0, 9]
    assert -at == pytest.approx(2e6 / 1300 * (50 / 1300) ** 2 / (1 - (50 / 1300) ** 2))


# --- the new way


def test_better_head_at_rest(better: Measured) -> None:
    x, y = better.still[NEAR].jitter
    assert (x.sigma <= 0.02, y.sigma <= 0.1) == (True, True), (x, y)
    x, y = better.still[FAR].jitter
    assert (x.sigma <= 0.4, y.sigma <= 0.1) == (True, True), (x, y)
    assert x.count >= CALLS


def test_better_head_is_accurate_where_it_was_not_calibrated(better: Measured) -> None:
    for distance, most in ((NEAR, 1.0), (FAR, 2.0)):
        x, y = better.placed[distance].errors
        assert math.hypot(x.rms, y.rms) <= most
        assert x.count == experiments.PLACES
    heading = better.placed[FAR].found[:, 2] - better.placed[FAR].true[:, 2]
    assert np.std(heading) < 1e-3  # found, of headings between -5 and 5 degrees
    assert np.ptp(better.placed[FAR].true[:, 2]) > math.radians(6)


def test_better_head_sees_a_known_heading_shake(better: Measured) -> None:
    sigma = shaking().sigma * NEAR  # mm sideways, if the heading is taken for known
    x, _ = better.shaken.jitter
    assert x.sigma == pytest.approx(sigma, rel=0.4)
    assert x.sigma > 10 * better.still[NEAR].jitter[0].sigma


def test_heads_are_compared_on_equal_terms(both: tuple[Measured, ...]) -> None:
    same, better = both
    for distance in DISTANCES:
        ours, theirs = better.rest[distance], same.rest[distance]
        assert ours.channels == theirs.channels
        assert ours.clocks == theirs.clocks
        assert len(ours.spikes) == len(theirs.spikes)
        assert len(ours.channels) >= (2 if distance == NEAR else 5)
        assert np.array_equal(better.placed[distance].true, same.placed[distance].true)


def test_no_pixel_is_full(both: tuple[Measured, ...]) -> None:
    longest = experiments.STREAM[0]
    for distance in DISTANCES:
        rests = [one.rest[distance] for one in both]
        fullest = max(rest.fill for rest in rests)
        assert fullest < 0.8  # FILL of them, in a survey's light, and noise
        # and the light that could be had is used
        assert fullest > 0.5 or max(rests[0].clocks) > longest - experiments.SURVEY


def test_every_led_has_its_own_exposure(better: Measured) -> None:
    for sight in better.rest.values():
        assert all(experiments.SURVEY <= count <= experiments.STREAM[0] for count in sight.clocks)
    assert len(set(better.rest[FAR].clocks)) > 1


def test_the_head_with_the_highest_spike_sets_the_exposures_of_all() -> None:
    leds = LedMap.line(2, 500.0)
    names = BETTER, experiments.OTHER
    benches = [Bench(DESIGNS[name].system, leds) for name in names]
    pose = Pose(0.0, 2000.0)
    alone = [bench.look(pose) for bench in benches]
    shared = looked(benches, pose)
    for bench in benches:
        bench.close()
    assert shared[0].clocks == shared[1].clocks
    for channel in range(2):
        longest, shortest = (sight.clocks[channel] for sight in alone)
        assert longest > shortest + experiments.SURVEY
        # in steps, and by another survey's noise
        assert abs(shared[0].clocks[channel] - shortest) <= experiments.SURVEY
    # that the other's spikes are less high is not made up for
    assert shared[0].fill < 0.9 * shared[1].fill


def test_three_leds_solve_the_degree_that_costs_two_centimetres() -> None:
    # single frames, the camera as drawn and the LEDs where they are
    leds = LedMap.line(3, 500.0, 300.0)
    bench = Bench(DESIGNS[BETTER].system, leds)
    calibration = Calibration(Camera.from_system(bench.head), leds)
    turn = math.radians(1)
    for distance in (NEAR, 2500.0, FAR):
        sight = bench.look(Pose(0.0, distance, turn), 10)
        assert sight.channels == (0, 1, 2)
        off = fixed(calibration, sight) - (0.0, distance, turn)
        assert math.hypot(*np.sqrt(np.mean(off[:, :2] ** 2, axis=0))) <= 1.0, distance
        assert np.abs(off[:, 2]).max() <= math.radians(0.02)
        pair = replace(sight, channels=(0, 2), spikes=[frame[::2] for frame in sight.spikes])
        assumed = fixed(calibration, pair, Prior(0.0, 0.0))
        assert assumed[:, 0].mean() == pytest.approx(
            turn * (distance + 500**2 / distance), rel=0.02
        )
    bench.close()


def test_leds_are_not_seen_from_behind() -> None:
    # reversed, a line of LEDs has a pose behind it, where these do not shine
    leds = LedMap.line(4, 500.0, 200.0)
    camera = Camera(4000.0, 1823.5)
    pixels = camera.project(optical(leds.positions, 100.0, -2000.0, math.pi))
    spikes = [Spike(float(at), 0.05, 20.0, 1e4) for at in pixels]
    sight = Sight(leds.channels, [spikes], (100,) * 4, 0.5, np.array([0]), np.array([0]))
    with pytest.raises(ValueError, match="lit side"):
        fixed(Calibration(camera, leds), sight)
    back = LedMap(leds.channels, leds.positions, [math.pi] * 4)
    (found,) = fixed(Calibration(camera, back), sight)
    assert found[:2] == pytest.approx([100.0, -2000.0], abs=0.1)


def test_stream_is_as_fast_as_it_should_be(timing: Timing) -> None:
    sh, icg = experiments.STREAM
    assert icg % sh == 0
    assert timing.rate == pytest.approx(4e6 / icg, rel=1e-3)  # nothing is dropped
    assert timing.latency <= 8e-3
    assert timing.latency > 3.694e-3 + 7424 * 8 / 15.625e6  # read-out and transfer cannot be less


def test_placed() -> None:
    true = np.zeros((3, 3))
    placed = Placed(np.array([[1.0, 2, 0], [1, 2, 0], [4, 2, 0]]), true)
    assert [error.rms for error in placed.errors] == [pytest.approx(math.sqrt(6)), 2.0]
    assert placed.deviations.tolist() == [[0, 0], [0, 0], [3, 0]]
    assert placed.jitter[0].sigma == pytest.approx(math.sqrt(3))


def test_command_prints_the_table(
    own: Prototype,
    inferred: dict[float, Move],
    both: tuple[Measured, ...],
    timing: Timing,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    same, better = both
    # some columns stand in for others, which would take as long again
    found = Evaluation(own, own, inferred, same, better, better, timing)
    seeds: list[int] = []

    def evaluated(*, seed: int) -> Evaluation:
        seeds.append(seed)
        return found

    monkeypatch.setattr(experiments, "evaluate", evaluated)
    folder = tmp_path / "new"
    monkeypatch.setattr(sys, "argv", ["experiments", "--output", str(folder), "--seed", "7"])
    assert experiments.main() == 0
    assert seeds == [7]
    said = capsys.readouterr().out
    assert (folder / "evaluation.txt").read_text(encoding="utf-8") in said
    for claim in ("E1", "E2", "E3", "E4", "E5", "E6", "E7", "R4", "R5"):
        assert claim in said
    rows = {row[1]: row for row in comparison(found).rows}
    assert rows["100 mm along x at 4.15 m, px"][2:4] == ("83", f"{own.x[FAR].scale:.1f}")
    jitter = better.still[NEAR].jitter[0].sigma
    assert rows["jitter x at 1.30 m, σ, mm (d)"][-2:] == (f"{jitter:.4f}",) * 2
    clocks = better.rest[NEAR].clocks
    lit = f"{len(clocks)}: {min(clocks)}–{max(clocks)}"
    assert rows["LEDs lit at 1.30 m: clocks (g)"][2:] == ("2: 100", "2: 100", lit, lit, lit)
    why = causes(found)
    assert {"slabs", "aperture", "caustics", "spacing", "common", "1/y"} <= {r[0] for r in why.rows}
    markdown = why._repr_markdown_().splitlines()
    assert len(markdown) == 2 + len(why.rows)
    assert {line.count("|") for line in markdown} == {5}


def test_command_says_where_it_cannot_write(
    own: Prototype,
    inferred: dict[float, Move],
    both: tuple[Measured, ...],
    timing: Timing,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    (tmp_path / "file").write_text("")
    same, better = both
    found = Evaluation(own, own, inferred, same, better, better, timing)
    monkeypatch.setattr(experiments, "evaluate", lambda **_: found)
    monkeypatch.setattr(sys, "argv", ["experiments", "--output", str(tmp_path / "file")])
    assert experiments.main() == 1
    assert "cannot be written" in capsys.readouterr().err
