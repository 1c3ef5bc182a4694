import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.stats import chi2  # type: ignore[import-untyped]

from tracking.camera import Camera
from tracking.leds import LedMap
from tracking.motion import CONFIRMATIONS, MotionFilter, Outcome, load_kernels
from tracking.poses import Fix, PoseFlags, Prior, optical
from tracking.spikes import Spike, SpikeFlags

CAMERA = Camera(4244.0, 1823.5, (-0.42, 0.2), (0.4, 0.1), (0.001,), pupil=15.0)
LEDS = LedMap.line(9, 400.0, 300.0)
FRAME = 3_700_000  # ns
NO_GATE: dict[str, Any] = {"gate": 1e12, "patience": 1e9, "uncertainty": (1e9, 1e9)}


def fix(x: Any = 0.0, y: Any = 2500.0, heading: Any = 0.0, sigmas: Any = (20.0, 20.0, 0.01)) -> Any:
    cov = np.diag(np.square(sigmas))
    return Fix(x, y, heading, 0.0, cov, np.zeros(0), np.zeros(0, bool), 0.0, 0, PoseFlags.NONE)


def spike(position: Any, sigma: Any = 0.1, flags: Any = SpikeFlags.NONE) -> Any:
    return Spike(position, sigma, 10.0, 20_000.0, flags)


MISSING = Spike(math.nan, math.inf, math.nan, math.nan, SpikeFlags.MISSING)


def pixels(pose: Any, leds: Any = LEDS, camera: Any = CAMERA, height: Any = 0.0) -> Any:
    x, y, heading = pose[:3]
    return camera.project(optical(leds.positions, x, y, heading, height))


def on_line(at: Any) -> Any:
    return np.flatnonzero((at >= 10) & (at <= 3637))


def frame(
    pose: Any,
    random: Any,
    rows: Any = None,
    sigma: Any = 0.1,
    leds: Any = LEDS,
    camera: Any = CAMERA,
    height: Any = 0.0,
) -> Any:
    at = pixels(pose, leds, camera, height)
    rows = on_line(at) if rows is None else rows
    noise = random.normal(0, sigma, len(rows))
    return {leds.channels[n]: spike(at[n] + e, sigma) for n, e in zip(rows, noise, strict=True)}


def locked(
    *arguments: Any, sigmas: Any = (1.0, 1.0, 1e-3), pose: Any = (0.0, 2500.0, 0.0), **options: Any
) -> Any:
    motion = MotionFilter(CAMERA, LEDS, *arguments, **options)
    motion.start(fix(pose[0], pose[1], pose[2], sigmas), 0)
    return motion


def settled(pose: Any = (0.0, 2500.0, 0.0), frames: Any = 30, **options: Any) -> Any:
    motion, random = locked(pose=pose, **options), np.random.default_rng(1)
    for n in range(1, frames + 1):
        motion.observe(n * FRAME, frame(pose, random))
    return motion, random


# -- the camera in the filter is the camera


def test_prediction_is_the_cameras() -> None:
    random = np.random.default_rng(2)
    for _ in range(50):
        pose = (random.uniform(-500, 500), random.uniform(1500, 4000), random.uniform(-0.2, 0.2))
        height = random.uniform(-200, 200)
        motion = MotionFilter(CAMERA, LEDS, height=Prior(height, 0.0))
        motion.start(fix(*pose), 0)
        at = pixels(pose, height=height)
        expected = motion.expected()
        np.testing.assert_allclose(expected.pixels[on_line(at)], at[on_line(at)], atol=1e-9)
        assert (expected.visible == ((at >= 0) & (at <= 3647))).all()


def test_slopes_are_differences() -> None:
    kernels, random = load_kernels(), np.random.default_rng(3)
    lens = MotionFilter(CAMERA, LEDS)._lens
    row, other = np.zeros(8), np.zeros(8)
    for _ in range(50):
        state = np.zeros(8)
        state[:3] = random.uniform(-500, 500), random.uniform(1500, 4000), random.uniform(-0.2, 0.2)
        state[6] = random.uniform(-300, 300)
        led = np.array([random.uniform(-300, 300), random.uniform(0, 300), random.uniform(-50, 50)])
        assert np.isfinite(kernels.project(state, 0.0, led, lens, row))
        for i, step in ((0, 1e-3), (1, 1e-3), (2, 1e-6), (6, 1e-3)):
            ahead, behind = state.copy(), state.copy()
            ahead[i] += step
            behind[i] -= step
            slope = kernels.project(ahead, 0.0, led, lens, other)
            slope = (slope - kernels.project(behind, 0.0, led, lens, other)) / (2 * step)
            assert slope == pytest.approx(row[i], rel=1e-6, abs=1e-6)
        assert not row[[3, 4, 5, 7]].any()


def test_beyond_the_field_nothing_is_predicted() -> None:
    # the polynomial of a wide angle comes back to the line
    camera = Camera(4244.0, 1823.5, (-0.42,))
    at = camera.project([[-4000.0, 0.0, 2500.0]])
    assert 0 < at[0] < 3647
    leds = LedMap([0], [(4000.0, 0.0)])
    motion = MotionFilter(camera, leds)
    motion.start(fix(), 0)
    expected = motion.expected()
    assert np.isnan(expected.pixels[0])
    assert not expected.visible[0]
    assert motion.update(FRAME, 0, spike(at[0])).outcome is Outcome.UNSEEN


def test_led_that_shines_away_is_not_visible() -> None:
    leds = LedMap([0, 1], [(-50.0, 0.0), (50.0, 0.0)], [0.0, math.pi])
    motion = MotionFilter(CAMERA, leds)
    motion.start(fix(), 0)
    assert motion.expected().visible.tolist() == [True, False]


# -- covariance


def test_covariance_stays_symmetric_and_positive() -> None:
    motion = locked(
        sigmas=(500.0, 500.0, 0.3), height=Prior(0.0, 50.0), bias=Prior(0.0, 0.1), **NO_GATE
    )
    random = np.random.default_rng(4)
    for n in range(1, 400):
        spikes = frame((0.0, 2500.0, 0.0), random, sigma=1e-6)
        motion.observe(n * FRAME, spikes, gyro=(0.0, 1e-6))
        cov = motion.covariance
        assert (cov == cov.T).all()
        scale = np.sqrt(np.diag(cov))
        assert (scale > 0).all()
        assert np.linalg.eigvalsh(cov / np.outer(scale, scale)).min() > -1e-9


def test_steps_of_prediction_do_not_matter() -> None:
    at_once, in_steps = locked(bias_walk=0.1), locked(bias_walk=0.1)
    at_once.predict(10 * FRAME)
    for n in range(1, 11):
        in_steps.predict(n * FRAME)
    np.testing.assert_allclose(at_once.covariance, in_steps.covariance, rtol=1e-12)
    np.testing.assert_allclose(at_once.state, in_steps.state)


# -- consistency on motion drawn from the model


def drawn(
    seed: Any, together: Any, steps: Any = 100, acceleration: Any = 1000.0, angular: Any = 1.0
) -> Any:
    """One run: NEES of the six states at every step, NIS of all measurements."""
    random = np.random.default_rng(seed)
    rates: dict[str, Any] = {"speed": 500.0, "turning": 0.3}
    motion = MotionFilter(
        CAMERA,
        LEDS,
        acceleration=acceleration,
        angular=angular,
        model_error=0.0,
        **rates,
        **NO_GATE,
    )
    sigmas = np.array([10.0, 10.0, 5e-3, 500.0, 500.0, 0.3])
    motion.start(fix(sigmas=sigmas[:3]), 0)
    truth = np.array([0.0, 2500.0, 0.0, 0, 0, 0]) + sigmas * random.normal(size=6)
    dt = FRAME * 1e-9
    root = np.linalg.cholesky([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
    nees, nis = [], []
    for n in range(1, steps + 1):
        pushed = root @ (random.normal(size=(2, 3)) * [acceleration, acceleration, angular])
        truth[:3] += dt * truth[3:] + pushed[0]
        truth[3:] += pushed[1]
        rows = on_line(pixels(truth))
        rows = rows if together else rows[[n % len(rows)]]
        motion.observe(n * FRAME, frame(truth, random, rows))
        nis += [entry.nis for entry in list(motion.innovations)[-len(rows) :]]
        off = motion.state[:6] - truth
        nees.append(off @ np.linalg.solve(motion.covariance[:6, :6], off))
    return nees, nis


@pytest.mark.parametrize("together", [False, True])
def test_errors_are_as_large_as_stated(together: Any) -> None:
    runs = 25
    results = [drawn(seed, together) for seed in range(runs)]
    mean = np.mean([nees for nees, _ in results], axis=0)
    low, high = chi2.ppf([0.025, 0.975], 6 * runs) / runs
    # steps half a second apart are nearly independent; of all, 95 % are within the band
    within = (mean[10:] > low) & (mean[10:] < high)
    assert within.mean() > 0.8
    assert low < mean[10:].mean() < high
    nis = np.concatenate([nis for _, nis in results])
    low, high = chi2.ppf([0.025, 0.975], len(nis)) / len(nis)
    assert low < nis.mean() < high


@pytest.mark.parametrize(("factor", "above"), [(0.3, True), (3.0, False)])
def test_consistency_would_show_a_wrong_sigma(factor: Any, above: Any) -> None:
    """The test above can fail: spikes that are worse or better than they say are found out."""
    motion, random = settled(model_error=0.0, gate=1e6)
    nis = []
    for n in range(31, 200):
        spikes = frame((0.0, 2500.0, 0.0), random)
        motion.observe(
            n * FRAME, {c: replace(s, sigma=s.sigma * factor) for c, s in spikes.items()}
        )
        nis += [entry.nis for entry in list(motion.innovations)[-len(spikes) :]]
    assert (np.mean(nis) > 2) == above
    assert (np.mean(nis) < 0.5) != above
    assert bool(motion.estimate().flags & PoseFlags.INCONSISTENT) == above


# -- motion that is not the model: 1 m/s


def lissajous(t: Any, y: Any) -> Any:
    """Up to 1.1 m/s, 0.8 m/s RMS, and 0.33 rad/s."""
    rate = 1000 / math.hypot(300, 150)
    return (
        300 * math.sin(rate * t),
        y + 150 * math.sin(1.5 * rate * t + 0.5),
        0.1 * math.sin(1.1 * rate * t),
    )


def followed(
    y: Any, together: Any, camera: Any = CAMERA, seconds: Any = 5.0, **options: Any
) -> Any:
    leds = LedMap.line(9, 250.0, 150.0)
    motion = MotionFilter(CAMERA, leds, **options)
    random, errors, nees = np.random.default_rng(5), [], []
    motion.start(fix(*lissajous(0, y)), 0)
    for n in range(1, round(seconds * 1e9 / FRAME)):
        pose = lissajous(n * FRAME * 1e-9, y)
        rows = on_line(pixels(pose, leds))
        rows = rows if together else rows[[n % len(rows)]]
        estimate = motion.observe(n * FRAME, frame(pose, random, rows, leds=leds, camera=camera))
        off = np.array([estimate.x, estimate.y, estimate.heading]) - pose
        if n > 100:
            errors.append(off[:2])
            nees.append(off @ np.linalg.solve(estimate.covariance, off))
    return motion, np.sqrt(np.mean(np.square(errors), axis=0)), np.array(nees)


@pytest.mark.parametrize("y", [1400.0, 4000.0])
@pytest.mark.parametrize(("together", "most"), [(False, 4.0), (True, 1.0)])
def test_a_metre_per_second(y: Any, together: Any, most: Any) -> None:
    motion, rms, nees = followed(y, together)
    assert np.hypot(*rms) < most
    assert motion.losses == 0
    assert nees.mean() < 4.0  # of 3: what is stated is not too little
    assert (nees < chi2.ppf(0.9999, 3)).mean() > 0.999


def test_calibration_a_little_wrong() -> None:
    wrong = replace(CAMERA, scale=CAMERA.scale * 1.00005, centre=CAMERA.centre + 0.05)
    _, rms, nees = followed(4000.0, True, camera=wrong, model_error=0.3)
    assert np.hypot(*rms) < 1.0
    assert np.mean(nees > chi2.ppf(0.9973, 3)) < 0.01


# -- gate, times


def test_gross_error_is_refused_and_flagged() -> None:
    motion, random = settled()
    before = motion.state
    spikes = frame((0.0, 2500.0, 0.0), random)
    channel = next(iter(spikes))
    spikes[channel] = replace(spikes[channel], position=spikes[channel].position + 30.0)
    estimate = motion.observe(31 * FRAME, spikes)
    assert estimate.flags == PoseFlags.REJECTED
    innovation = motion.innovations[-len(spikes)]
    assert (innovation.channel, innovation.outcome) == (channel, Outcome.REJECTED)
    assert innovation.residual == pytest.approx(30, abs=5)
    assert np.hypot(*(motion.state[:2] - before[:2])) < 1.0
    assert motion.observe(32 * FRAME, frame((0.0, 2500.0, 0.0), random)).flags == PoseFlags.NONE


def test_old_and_repeated_measurements_change_nothing() -> None:
    motion, random = settled()
    spikes = frame((0.0, 2500.0, 0.0), random)
    motion.observe(40 * FRAME, spikes)
    state, cov = motion.state, motion.covariance
    for t_ns in (40 * FRAME, 39 * FRAME):
        for channel, found in spikes.items():
            assert motion.update(t_ns, channel, found).outcome is Outcome.STALE
    motion.observe(39 * FRAME, {})
    assert (motion.state == state).all()
    assert (motion.covariance == cov).all()
    assert motion.stale == 2 * len(spikes)
    with pytest.raises(ValueError, match="present and the future"):
        motion.estimate(39 * FRAME)


def test_prediction_to_now() -> None:
    motion = locked(acceleration=0.0, angular=0.0)
    motion._state[3:6] = 100.0, -200.0, 0.5
    estimate = motion.estimate(1_000_000_000)
    assert (estimate.x, estimate.y, estimate.heading) == pytest.approx((100.0, 2300.0, 0.5))
    assert estimate.flags & PoseFlags.PREDICTED
    assert motion.t_ns == 0  # and the filter itself did not move
    motion._state[5] = 4.0
    assert motion.estimate(1_000_000_000).heading == pytest.approx(4.0 - math.tau)


def test_window_is_around_the_spike() -> None:
    motion, _ = settled()
    expected = motion.expected()
    row = int(np.flatnonzero(expected.visible)[1])
    first, last = expected.window(expected.channels[row], extent=20.0, sigmas=5.0)
    half = 20 + 5 * expected.sigmas[row]
    at = expected.pixels[row]
    assert first == pytest.approx(at - half, abs=1)
    assert last == pytest.approx(at + half, abs=1)
    hidden = int(np.flatnonzero(np.isnan(MotionFilter(CAMERA, LEDS).expected().pixels))[0])
    assert MotionFilter(CAMERA, LEDS).expected().window(LEDS.channels[hidden]) == (0, 3647)


# -- gyroscope, height, LEDs


def test_gyroscope_tells_rate_and_its_bias_is_found() -> None:
    motion, random = settled(bias=Prior(0.0, 0.1), angular=1.0)
    for n in range(31, 400):
        spikes = frame((0.0, 2500.0, 0.0), random)
        motion.observe(n * FRAME, spikes, gyro=(0.05 + random.normal(0, 1e-3), 1e-3))
    assert motion.state[7] == pytest.approx(0.05, abs=4 * math.sqrt(motion.covariance[7, 7]))
    assert math.sqrt(motion.covariance[7, 7]) < 0.02
    without, _ = settled(frames=60)
    assert motion.covariance[2, 2] < without.covariance[2, 2]
    with pytest.raises(ValueError, match="gyroscope"):
        motion.observe(400 * FRAME, {}, gyro=(0.0, 0.0))


def test_unknown_height_widens_the_covariance_and_is_estimated() -> None:
    pose, height = (100.0, 2500.0, 0.05), 150.0
    known, unknown = (
        MotionFilter(CAMERA, LEDS, height=prior) for prior in (Prior(0.0, 0.0), Prior(0.0, 200.0))
    )
    random = np.random.default_rng(6)
    for motion in (known, unknown):
        motion.start(fix(*pose, (20.0, 20.0, 0.01)), 0)
    for n in range(1, 200):
        spikes = frame(pose, random, height=height)
        known.observe(n * FRAME, spikes)
        unknown.observe(n * FRAME, spikes)
    assert unknown.covariance[1, 1] > 2 * known.covariance[1, 1]
    off = unknown.state[:3] - pose
    assert off @ np.linalg.solve(unknown.covariance[:3, :3], off) < 20
    assert abs(known.state[1] - pose[1]) > 3 * abs(off[1])  # who believes in height 0 is wrong


def test_uncertain_leds_count_less() -> None:
    sure, unsure = settled()[0], settled(led_error=1.0)[0]
    assert unsure.covariance[0, 0] > 4 * sure.covariance[0, 0]


@pytest.mark.parametrize("flag", [SpikeFlags.CLIPPED, SpikeFlags.DOUBLE])
def test_uncertain_spikes_count_less(flag: Any) -> None:
    motion, _ = settled()
    at = motion.expected(40 * FRAME).pixels
    row = int(on_line(at)[0])
    innovation = motion.update(40 * FRAME, LEDS.channels[row], spike(at[row], flags=flag))
    assert innovation.sigma > 10 / 4


# -- loss of lock


def test_without_spikes_lock_is_lost_and_found_again() -> None:
    motion, random = settled()
    assert not motion.lost
    n = 30
    while not motion.lost:
        n += 1
        estimate = motion.observe(n * FRAME, {0: MISSING})
        assert estimate.flags & PoseFlags.PREDICTED
    assert (n - 30) * FRAME <= 0.4e9
    assert motion.losses == 1
    there = (400.0, 2200.0, 0.15)
    for number in range(200):
        n += 1
        rows = on_line(pixels(there))
        estimate = motion.observe(n * FRAME, frame(there, random, rows[[number % len(rows)]]))
        if not motion.lost:
            break
        assert estimate.flags & PoseFlags.LOST
    assert number * FRAME < 0.1e9
    assert estimate.flags == PoseFlags.RELOCALISED
    assert np.hypot(estimate.x - there[0], estimate.y - there[1]) < 30.0
    assert motion.observe((n + 1) * FRAME, frame(there, random)).flags == PoseFlags.NONE


def test_moved_elsewhere_lock_is_lost() -> None:
    motion, random = settled()
    for n in range(31, 100):
        motion.observe(n * FRAME, frame((300.0, 2000.0, 0.1), random))
        if motion.lost:
            break
    assert motion.losses == 1
    assert n < 36


@pytest.mark.parametrize("seed", range(6))
def test_starts_by_itself_while_moving_despite_gross_errors(seed: Any) -> None:
    random = np.random.default_rng(seed)
    motion = MotionFilter(CAMERA, LEDS)
    assert motion.estimate().flags & PoseFlags.LOST
    for n in range(1, 136):  # 0.5 s
        t = n * FRAME * 1e-9
        pose = (-300 + 800 * t, 3000 - 600 * t, 0.15 - 0.8 * t)
        rows = on_line(pixels(pose))
        spikes = frame(pose, random, rows[[n % len(rows)]])
        if random.random() < 0.1:
            channel = next(iter(spikes))
            spikes[channel] = replace(spikes[channel], position=random.uniform(0, 3647))
        motion.observe(n * FRAME, spikes)
    estimate = motion.estimate()
    assert not motion.lost
    off = np.array([estimate.x, estimate.y, estimate.heading]) - pose
    assert off @ np.linalg.solve(estimate.covariance, off) < 30
    assert np.hypot(*off[:2]) < 10


def test_a_pose_must_be_confirmed() -> None:
    motion, random = MotionFilter(CAMERA, LEDS), np.random.default_rng(7)
    pose = (0.0, 2500.0, 0.0)
    rows = on_line(pixels(pose))
    for number in range(40):
        motion.update(
            (number + 1) * FRAME,
            LEDS.channels[rows[number % len(rows)]],
            next(iter(frame(pose, random, rows[[number % len(rows)]]).values())),
        )
        if not motion.lost:
            break
    outcomes = [entry.outcome for entry in motion.innovations]
    assert outcomes[-CONFIRMATIONS:] == [Outcome.USED] * CONFIRMATIONS
    assert set(outcomes[:-CONFIRMATIONS]) == {Outcome.KEPT}


def test_three_leds_at_rest_are_enough() -> None:
    motion, random = MotionFilter(CAMERA, LEDS), np.random.default_rng(8)
    pose = (50.0, 2500.0, 0.02)
    rows = on_line(pixels(pose))[[0, 2, 4]]
    for n in range(1, 60):
        motion.observe(n * FRAME, frame(pose, random, rows[[n % 3]]))
    assert not motion.lost
    assert np.hypot(*(motion.state[:2] - pose[:2])) < 10


def test_three_leds_are_unchecked_until_a_fourth_agrees() -> None:
    """One of them a reflection: some pose fits, and is flagged; the fourth LED finds it out."""
    motion, random = MotionFilter(CAMERA, LEDS), np.random.default_rng(9)
    pose = (50.0, 2500.0, 0.02)
    rows = on_line(pixels(pose))
    seen, further = rows[[0, 2, 4]], rows[[1]]
    n = 0
    while motion.lost and n < 100:
        n += 1
        motion.observe(n * FRAME, frame(pose, random, seen[[n % 3]]))
    assert motion.estimate().flags & PoseFlags.UNCHECKED
    for _ in range(30):
        n += 1
        estimate = motion.observe(n * FRAME, frame(pose, random, seen[[n % 3]]))
        assert estimate.flags & PoseFlags.UNCHECKED
    motion.observe((n + 1) * FRAME, frame(pose, random, further))
    estimate = motion.observe((n + 2) * FRAME, frame(pose, random, further))
    assert not motion.unchecked
    assert estimate.flags == PoseFlags.NONE


def test_a_lone_spike_after_darkness_is_unchecked() -> None:
    motion, random = settled(frames=60)
    pose = (0.0, 2500.0, 0.0)
    rows = on_line(pixels(pose))
    for n in range(61, 73):
        motion.observe(n * FRAME, {LEDS.channels[rows[0]]: MISSING})
    assert not motion.lost
    assert not motion.unchecked
    alone = frame(pose, random, rows[[0]])
    for n in range(73, 78):
        estimate = motion.observe(n * FRAME, alone)
        assert motion.innovations[-1].outcome is Outcome.USED
        assert estimate.flags & PoseFlags.UNCHECKED
    for n in range(78, 83):
        estimate = motion.observe(n * FRAME, frame(pose, random, rows[[n % len(rows)]]))
    assert estimate.flags == PoseFlags.NONE


def test_what_was_refused_and_passes_later_is_unchecked() -> None:
    """The gate widens with time: a reflection that stays where it is comes in at some time."""
    motion, random = settled(frames=60)
    rows = on_line(pixels((0.0, 2500.0, 0.0)))
    ghost = {
        c: replace(s, position=s.position + 4.0)
        for c, s in frame((0.0, 2500.0, 0.0), random, rows[[1]]).items()
    }
    refused = False
    for n in range(61, 90):
        estimate = motion.observe(n * FRAME, ghost)
        if motion.innovations[-1].outcome is Outcome.USED:
            break
        refused = True
    assert refused
    assert estimate.flags & PoseFlags.UNCHECKED


# -- edges


@pytest.mark.parametrize(
    "options",
    [
        {"acceleration": -1.0},
        {"angular": math.nan},
        {"gate": 0.0},
        {"patience": 0.0},
        {"height": Prior(0.0, -1.0)},
        {"led_error": -1.0},
    ],
)
def test_refuses_numbers_out_of_range(options: Any) -> None:
    with pytest.raises(ValueError, match=next(iter(options))):
        MotionFilter(CAMERA, LEDS, **options)


def test_refuses_what_is_no_measurement() -> None:
    motion, _ = settled()
    with pytest.raises(KeyError, match="channel 50"):
        motion.update(40 * FRAME, 50, spike(100.0))
    with pytest.raises(ValueError, match="finite position"):
        motion.update(40 * FRAME, 0, spike(math.nan))
    with pytest.raises(ValueError, match="finite"):
        motion.start(fix(sigmas=(math.inf, 1.0, 1.0)), 0)
