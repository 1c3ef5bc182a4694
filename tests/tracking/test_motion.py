import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.stats import chi2  # type: ignore[import-untyped]

from tracking.camera import Camera
from tracking.evaluation import nees, nees_band
from tracking.leds import LedMap
from tracking.motion import (
    CONFIRMATIONS,
    DOUBT,
    FEW,
    MANY,
    SQUARED,
    MotionFilter,
    Outcome,
    load_kernels,
)
from tracking.poses import Fix, PoseFlags, Prior, optical
from tracking.spikes import Spike, SpikeFlags

CAMERA = Camera(4244.0, 1823.5, (-0.42, 0.2), (0.4, 0.1), (0.001,), pupil=15.0)
LEDS = LedMap.line(9, 400.0, 300.0)
NARROW = LedMap.line(9, 250.0, 150.0)
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
    row, other = np.zeros(9), np.zeros(9)
    for _ in range(50):
        state = np.zeros(9)
        state[:3] = random.uniform(-500, 500), random.uniform(1500, 4000), random.uniform(-0.2, 0.2)
        state[6] = random.uniform(-300, 300)
        state[8] = state[6] ** 2 + random.uniform(0, 1e4)
        led = np.array([random.uniform(-300, 300), random.uniform(0, 300), random.uniform(-50, 50)])
        assert np.isfinite(kernels.project(state, led, lens, row))
        for i, step in ((0, 1e-3), (1, 1e-3), (2, 1e-6), (6, 1e-3), (8, 1.0)):
            ahead, behind = state.copy(), state.copy()
            ahead[i] += step
            behind[i] -= step
            slope = kernels.project(ahead, led, lens, other)
            slope = (slope - kernels.project(behind, led, lens, other)) / (2 * step)
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


def test_doubt_of_a_prediction_has_terms_of_second_order() -> None:
    random, sigmas = np.random.default_rng(1), np.array([1e-3, 400.0, 1e-6])
    leds = LedMap([0], [(400.0, 0.0)])
    motion = MotionFilter(CAMERA, leds, **NO_GATE)
    motion.start(fix(sigmas=sigmas), 0)
    first_order = motion.expected().sigmas[0] ** 2
    stated = motion.update(0, 0, spike(1800.0)).sigma ** 2
    poses = [0.0, 2500.0, 0.0] + sigmas * random.normal(size=(4000, 3))
    scatter = np.var([pixels(pose, leds)[0] for pose in poses])
    assert 1.01 * first_order < stated < scatter


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
    random: Any,
    start: Any,
    steps: Any = 100,
    acceleration: Any = 1000.0,
    angular: Any = 1.0,
) -> Any:
    """States of the model itself from one on: white acceleration."""
    truth, dt = np.array(start), FRAME * 1e-9
    root = np.linalg.cholesky([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
    for _ in range(steps):
        pushed = root @ (random.normal(size=(2, 3)) * [acceleration, acceleration, angular])
        truth[:3] += dt * truth[3:] + pushed[0]
        truth[3:] += pushed[1]
        yield truth.copy()


def consistency(seed: Any, together: Any) -> Any:
    """One run: NEES of the six states at every step, NIS of all measurements."""
    random = np.random.default_rng(seed)
    motion = MotionFilter(CAMERA, LEDS, model_error=0.0, speed=500.0, turning=0.3, **NO_GATE)
    sigmas = np.array([10.0, 10.0, 5e-3, 500.0, 500.0, 0.3])
    motion.start(fix(sigmas=sigmas[:3]), 0)
    off, stated, nis = [], [], []
    start = [0.0, 2500.0, 0.0, 0, 0, 0] + sigmas * random.normal(size=6)
    for n, truth in enumerate(drawn(random, start), 1):
        rows = on_line(pixels(truth))
        rows = rows if together else rows[[n % len(rows)]]
        motion.observe(n * FRAME, frame(truth, random, rows))
        nis += [entry.nis for entry in list(motion.innovations)[-len(rows) :]]
        off.append(motion.state[:6] - truth)
        stated.append(motion.covariance[:6, :6])
    return nees(off, stated), nis


@pytest.mark.parametrize("together", [False, True])
def test_errors_are_as_large_as_stated(together: Any) -> None:
    runs = 25
    results = [consistency(seed, together) for seed in range(runs)]
    mean = np.mean([values for values, _ in results], axis=0)
    low, high = nees_band(runs, 6)
    # the steps of a run are not independent; of all, 95 % are within the band
    within = (mean[10:] > low) & (mean[10:] < high)
    assert within.mean() > 0.8
    assert low < mean[10:].mean() < high
    nis = np.concatenate([nis for _, nis in results])
    low, high = nees_band(len(nis), 1)
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


# -- 1 m/s


@pytest.mark.parametrize("y", [1400.0, 4000.0])
@pytest.mark.parametrize(("together", "most"), [(False, 4.0), (True, 1.0)])
def test_a_metre_per_second(y: Any, together: Any, most: Any) -> None:
    """Speed of 1 m/s RMS and the acceleration that the filter is told of; its own gate is on."""
    runs, begun, steps, apart = 20, 60, 180, 20
    density: dict[str, Any] = {"acceleration": 300.0, "angular": 0.3}
    errors, values = [], []
    for seed in range(runs):
        random = np.random.default_rng(seed)
        rates = random.normal(size=3) * [707.0, 707.0, 0.3]
        start = np.concatenate([[0.0, y, 0.0] - 0.3 * rates, rates])  # across the middle
        motion = MotionFilter(CAMERA, NARROW, **density)
        sigmas = np.array([5.0, 5.0, 3e-3])
        x, y0, heading = start[:3] + sigmas * random.normal(size=3)
        motion.start(fix(x, y0, heading, sigmas), 0)
        off, stated = [], []
        for n, truth in enumerate(drawn(random, start, steps, **density), 1):
            rows = on_line(pixels(truth, NARROW))
            rows = rows if together else rows[[n % len(rows)]]
            estimate = motion.observe(n * FRAME, frame(truth, random, rows, leds=NARROW))
            off.append([estimate.x, estimate.y, estimate.heading] - truth[:3])
            stated.append(estimate.covariance)
        assert not motion.losses
        errors += off[begun:]
        values.append(nees(off[begun:], stated[begun:]))
    assert np.hypot(*np.sqrt(np.mean(np.square(errors), axis=0))[:2]) < most
    low, high = nees_band(runs, 3)
    mean = np.mean(values, axis=0)
    assert np.mean((mean > low) & (mean < high)) > 0.9
    # poses 20 frames apart are independent but for a correlation of 0.03
    some = np.array(values)[:, ::apart]
    low, high = nees_band(some.size, 3)
    assert low < some.mean() < high


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
    motion = MotionFilter(CAMERA, NARROW, **options)
    random, errors, stated = np.random.default_rng(5), [], []
    motion.start(fix(*lissajous(0, y)), 0)
    for n in range(1, round(seconds * 1e9 / FRAME)):
        pose = lissajous(n * FRAME * 1e-9, y)
        rows = on_line(pixels(pose, NARROW))
        rows = rows if together else rows[[n % len(rows)]]
        estimate = motion.observe(n * FRAME, frame(pose, random, rows, leds=NARROW, camera=camera))
        if n > 100:
            errors.append(np.array([estimate.x, estimate.y, estimate.heading]) - pose)
            stated.append(estimate.covariance)
    rms = np.sqrt(np.mean(np.square(errors), axis=0))
    return motion, rms[:2], nees(errors, stated)


@pytest.mark.parametrize("y", [1400.0, 4000.0])
@pytest.mark.parametrize(("together", "most", "least"), [(False, 4.0, 1.0), (True, 1.0, 2.5)])
def test_a_smooth_path_is_followed_better_than_stated(
    y: Any, together: Any, most: Any, least: Any
) -> None:
    """The filter's own options are for a hand, whose acceleration changes sooner than here."""
    motion, rms, values = followed(y, together)
    assert np.hypot(*rms) < most
    assert motion.losses == 0
    assert least < values.mean() < 3.0
    assert (values < chi2.ppf(0.9999, 3)).mean() > 0.999


def test_calibration_a_little_wrong() -> None:
    wrong = replace(CAMERA, scale=CAMERA.scale * 1.00005, centre=CAMERA.centre + 0.05)
    _, rms, values = followed(4000.0, True, camera=wrong, model_error=0.3)
    assert np.hypot(*rms) < 1.0
    assert np.mean(values > chi2.ppf(0.9973, 3)) < 0.01


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


def test_clock_that_is_set_back_is_found_out() -> None:
    motion, random = settled(patience=0.1)
    pose, begun, step = (0.0, 2500.0, 0.0), -(10**10), 1_000_000
    n = 0
    while not motion.lost and n < 200:
        n += 1
        estimate = motion.observe(begun + n * step, frame(pose, random, [3]))
    assert n * step == pytest.approx(0.1e9, abs=2 * step)  # patience
    assert motion.losses == 1
    assert estimate.flags & PoseFlags.LOST
    assert np.isinf(np.diag(estimate.covariance)).all()  # how long ago was the last pose?
    for _ in range(30):
        n += 1
        estimate = motion.observe(begun + n * step, frame(pose, random))
    assert estimate.flags == PoseFlags.NONE
    assert estimate.t_ns == begun + n * step
    assert np.hypot(estimate.x, estimate.y - 2500) < 1.0


def test_a_late_frame_now_and_then_does_not_pass_for_the_clock() -> None:
    motion, random = settled()
    for n in range(31, 200):
        motion.observe(n * FRAME, frame((0.0, 2500.0, 0.0), random))
        motion.observe((n - 20) * FRAME, frame((0.0, 2500.0, 0.0), random))
    assert motion.losses == 0


def test_nothing_is_known_in_the_beginning() -> None:
    motion = MotionFilter(CAMERA, LEDS)
    motion.observe(FRAME, {0: MISSING}, gyro=(0.1, 1e-3))
    for covariance in (motion.estimate().covariance, motion.covariance):
        assert np.isinf(np.diag(covariance)).all()
    assert np.isinf(motion.expected().sigmas).all()
    motion.start(fix(), 2 * FRAME)
    assert np.isfinite(motion.covariance).all()


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


def turning(motion: Any, random: Any, first: Any, last: Any, rate: Any) -> Any:
    for n in range(first, last):
        noise = random.normal(0, 1e-3)
        spikes = frame((0.0, 2500.0, 0.0), random)
        estimate = motion.observe(n * FRAME, spikes, gyro=(rate + noise, 1e-3))
    return estimate


def test_a_gyroscope_that_is_wrong_is_refused_and_flagged() -> None:
    motion, random = settled(frames=60)
    before = motion.state[5]
    flags = turning(motion, random, 61, 62, 0.5).flags
    assert flags == PoseFlags.REJECTED
    assert motion.innovations[-len(on_line(pixels((0.0, 2500.0, 0.0)))) - 1].channel == -1
    assert abs(motion.state[5] - before) < 0.05
    assert turning(motion, random, 62, 63, 0.0).flags == PoseFlags.NONE
    flags = turning(motion, random, 63, 100, 0.5).flags  # a bias that was said not to be there
    assert flags == PoseFlags.REJECTED | PoseFlags.INCONSISTENT


def test_bias_learnt_outlasts_a_loss_of_lock() -> None:
    motion, random = settled(bias=Prior(0.0, 0.1))
    turning(motion, random, 31, 400, 0.05)
    sigma = math.sqrt(motion.covariance[7, 7])
    n = 400
    while not motion.lost:
        motion.observe(n * FRAME, {0: MISSING})
        n += 1
    while motion.lost:
        motion.observe(n * FRAME, frame((0.0, 2500.0, 0.0), random))
        n += 1
    assert motion.state[7] == pytest.approx(0.05, abs=4 * sigma)
    assert math.sqrt(motion.covariance[7, 7]) == pytest.approx(2 * sigma, rel=0.05)
    # one that does not fit is forgotten
    turning(motion, random, n, n + 60, -0.5)
    motion.start(fix(), (n + 60) * FRAME)
    assert motion.state[7] == 0.0
    assert motion.covariance[7, 7] == pytest.approx(0.01)


def test_a_rate_is_taken_in_once_also_with_spikes_that_came_before() -> None:
    motion, random = settled(frames=60)
    spikes = frame((0.0, 2500.0, 0.0), random)
    motion.observe(61 * FRAME, spikes)
    variances = [motion.covariance[5, 5]]
    for _ in range(2):
        motion.observe(61 * FRAME, spikes, gyro=(0.0, 1e-3))
        variances.append(motion.covariance[5, 5])
    assert variances[1] < variances[0] / 2
    assert variances[2] == variances[1]


def test_height_and_bias_walk() -> None:
    """Closed form: of h + w the square is h² + 2 h w + w²."""
    motion = locked(height=Prior(300.0, 0.0), height_walk=20.0, bias=Prior(0.0, 0.1), bias_walk=0.2)
    for n in range(1, 5):
        motion.predict(n * 10**9)
    walk = 4 * 20.0**2
    assert motion.state[[6, 8]] == pytest.approx([300.0, 300.0**2 + walk])
    cov = motion.covariance[np.ix_([6, 8], [6, 8])]
    both = 2 * 300.0 * walk
    expected = np.array([[walk, both], [both, 4 * 300.0**2 * walk + 2 * walk**2]])
    np.testing.assert_allclose(cov, expected, rtol=1e-12)
    assert motion.covariance[7, 7] == pytest.approx(0.1**2 + 4 * 0.2**2)


def uneven() -> Any:
    """LEDs at different heights."""
    places = LEDS.positions.copy()
    places[:, 2] = [-20.0, 60.0, -80.0, 40.0, -40.0, 80.0, -60.0, 20.0, 0.0]
    return LedMap(LEDS.channels, places)


@pytest.mark.parametrize("leds", [LEDS, uneven()])
@pytest.mark.parametrize("prior", [(0.0, 50.0), (0.0, 100.0), (0.0, 200.0), (300.0, 100.0)])
def test_poses_are_as_sure_as_stated_at_unknown_heights(leds: Any, prior: Any) -> None:
    runs, off, stated, beyond = 25, [], [], 0
    for seed in range(runs):
        random = np.random.default_rng(seed)
        height = prior[0] + prior[1] * random.normal()
        pose = (random.uniform(-300, 300), 2500.0, random.uniform(-0.1, 0.1))
        rows = on_line(pixels(pose, leds, height=height))
        motion = MotionFilter(CAMERA, leds, height=Prior(*prior))
        for n in range(1, 100):
            some = rows if n > 20 else rows[[n % len(rows)]]
            spikes = frame(pose, random, some, leds=leds, height=height)
            estimate = motion.observe(n * FRAME, spikes)
            error = np.array([estimate.x, estimate.y, estimate.heading]) - pose
            if n > 40:
                sigmas = np.sqrt(np.diag(estimate.covariance))
                beyond += bool(not estimate.flags and (np.abs(error) > 5 * sigmas).any())
            if n in (39, 59, 79, 99):
                off.append(error)
                stated.append(estimate.covariance)
        assert not motion.lost
    assert beyond == 0
    low, high = nees_band(len(off), 3)
    # one degree of freedom in three, that of the height, may be taken for SQUARED times as uncertain
    assert low * (2 + SQUARED**-2) / 3 < nees(off, stated).mean() < high


def test_a_wide_start_at_unknown_height_is_not_taken_for_straight() -> None:
    """Slopes by the height's square change with pose and height: terms of second order."""
    leds, off, stated = uneven(), [], []
    quiet: dict[str, Any] = {"acceleration": 10.0, "angular": 0.01, "speed": 1.0, "turning": 1e-3}
    for seed in range(60):
        random = np.random.default_rng(seed)
        height = 200.0 * random.normal()
        pose = [0.0, 2500.0, 0.0] + np.array([20.0, 20.0, 0.01]) * random.normal(size=3)
        motion = MotionFilter(CAMERA, leds, height=Prior(0.0, 200.0), **quiet)
        motion.start(fix(), 0)
        for n in range(1, 21):
            motion.observe(n * FRAME, frame(pose, random, leds=leds, height=height))
        off.append(motion.state[:3] - pose)
        stated.append(motion.covariance[:3, :3])
    assert nees(off, stated).mean() < 5.5  # 6.5 without; 3 would be right


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


def test_three_of_many_leds_are_enough() -> None:
    """Most of the spikes that are sought are not there, and what is kept is not enough to be sure."""
    motion, random = MotionFilter(CAMERA, LEDS), np.random.default_rng(8)
    pose = (50.0, 2500.0, 0.02)
    rows = on_line(pixels(pose))[[0, 2, 4]]
    n = 0
    while motion.lost and n < 135:  # 0.5 s
        n += 1
        row = rows[n // 4 % 3]
        spikes = {LEDS.channels[row]: MISSING} if n % 4 else frame(pose, random, [row])
        motion.observe(n * FRAME, spikes)
    assert n < 135
    assert motion.unchecked
    assert np.hypot(*(motion.state[:2] - pose[:2])) < 10


@pytest.mark.parametrize(("memory", "found"), [(0.25, False), (2.0, True)])
def test_slow_frames_need_a_longer_memory(memory: Any, found: Any) -> None:
    slow: dict[str, Any] = {"acceleration": 200.0, "angular": 0.1, "patience": 1.0}
    motion = MotionFilter(CAMERA, LEDS, memory=memory, **slow)
    random, pose = np.random.default_rng(8), (50.0, 2500.0, 0.02)
    rows = on_line(pixels(pose))
    for n in range(40):
        motion.observe(n * 50_000_000, frame(pose, random, rows[[n % 3]]))
    assert motion.lost != found


def test_few_leds_are_not_believed_far_from_where_the_tracker_was() -> None:
    there = (500.0, 2500.0, -0.15)
    rows = on_line(pixels(there))
    assert len(rows) >= MANY
    for some, least, most in ((rows[:3], 0.95, 1.1), (rows, 0.08, 0.15)):
        motion, random = settled(pose=(-300.0, 2500.0, 0.0), speed=500.0)
        n = 30
        while not motion.lost:
            n += 1
            motion.observe(n * FRAME, {0: MISSING})
        while motion.lost:
            n += 1
            motion.observe(n * FRAME, frame(there, random, some[[n % len(some)]]))
        assert least < (n - 30) * FRAME * 1e-9 < most
        assert np.hypot(*(motion.state[:2] - there[:2])) < 10


def found_while_moving(seed: Any, seen: Any, led_error: Any = 0.0) -> Any:
    """Errors and covariance of the pose with which a filter begins, motion drawn from its model."""
    random = np.random.default_rng(seed)
    motion = MotionFilter(CAMERA, LEDS, model_error=0.0, led_error=led_error, speed=500.0)
    places = LEDS.positions + random.normal(0.0, led_error, (len(LEDS), 3)) * [1, 1, 0]
    leds = LedMap(LEDS.channels, places)
    start = [50.0, 3500.0, 0.02, *(random.normal(size=3) * [500.0, 500.0, 1.5])]
    for n, truth in enumerate(drawn(random, start, 135)):
        row = seen[n % len(seen)]
        motion.observe(n * FRAME, frame(truth, random, [row], leds=leds))
        if motion._to_confirm:
            return motion.state[:6] - truth, motion.covariance[:6, :6]
    raise AssertionError("none in half a second")


@pytest.mark.parametrize("led_error", [0.0, 0.5])
def test_a_pose_found_while_moving_is_as_sure_as_stated(led_error: Any) -> None:
    """From spikes of different times, between which the tracker went on."""
    runs = 120
    results = [found_while_moving(seed, [2, 4, 6, 3], led_error) for seed in range(runs)]
    off, stated = (np.array(column) for column in zip(*results, strict=True))
    errors = nees(off[:, :3], stated[:, :3, :3])  # χ² of three degrees of freedom
    assert 1.8 < np.median(errors) < 3.0  # 2.4
    assert np.mean(errors > 7.8) < 0.12  # 0.05


def test_what_moves_all_spikes_alike_leaves_a_pose_sure() -> None:
    """Acceleration that is common to spikes of about one time, not an error of each on its own."""
    motion, random = MotionFilter(CAMERA, LEDS), np.random.default_rng(3)
    pose = np.array([0.0, 4500.0, 0.0])
    for n in range(21):
        motion.observe(n * FRAME, frame(pose, random, [(1, 2, 7)[n % 3]]))
    kept = np.array(motion._kept)
    ages, rows = (kept[:, 0] - motion.t_ns) * 1e-9, kept[:, 1].astype(int)
    found = motion._path(np.ones(21, bool), ages, rows, kept[:, 2], kept[:, 3])
    assert found is not None
    steps = np.diag([1e-2, 1e-2, 1e-6])
    slopes = np.column_stack(
        [(pixels(pose + s) - pixels(pose - s))[rows] / (2 * s.max()) for s in steps]
    )
    moved = np.abs(ages) ** 3 / 3 * (slopes**2 @ [1e6, 1e6, 1.0])
    along = np.hstack([slopes, ages[:, None] * slopes]) / np.sqrt(kept[:, 3] + moved)[:, None]
    prior = np.diag([0, 0, 0, 1e-6, 1e-6, 1.5**-2])
    alone = np.sqrt(np.diag(np.linalg.inv(along.T @ along + prior)))
    assert np.all(np.sqrt(np.diag(found[1]))[:3] < 0.5 * alone[:3])


def test_leds_that_were_confused_are_forgotten_sooner() -> None:
    """Several lit at once, one hidden and another reflected: each takes the next one's spike."""
    pose = (100.0, 2500.0, 0.05)
    motion, random = settled(pose=pose)
    n = 30
    while not motion.lost:
        n += 1
        motion.observe(n * FRAME, {0: MISSING})
    seen = frame(pose, random)
    channels = list(seen)
    moved = dict(zip(channels, [seen[c] for c in channels[1:] + channels[:1]], strict=True))
    motion.observe((n + 1) * FRAME, moved)
    rows = on_line(pixels(pose))
    first = n = n + 1
    while motion.lost and n < first + 60:
        n += 1
        motion.observe(n * FRAME, frame(pose, random, rows[[n % len(rows)]]))
    assert (n - first) * FRAME < 0.1e9  # not all of the memory
    assert np.hypot(*(motion.state[:2] - pose[:2])) < 20


def test_of_four_leds_that_fit_no_pose_the_one_that_lies_is_left_out() -> None:
    """A reflection instead of an LED: three more fit a pose that can be reached, other threes not."""
    pose = (100.0, 2500.0, 0.05)
    rows = on_line(pixels(pose))[[0, 1, 3, 4]]
    for wrong in range(4):
        motion, random = settled(pose=pose)
        n = 30
        while not motion.lost:
            n += 1
            motion.observe(n * FRAME, {0: MISSING})
        lost = n
        while motion.lost and n < lost + 60:
            n += 1
            seen = frame(pose, random, rows[[n % 4]])
            if n % 4 == wrong:
                (channel,) = seen
                seen[channel] = replace(seen[channel], position=seen[channel].position + 400.0)
            motion.observe(n * FRAME, seen)
        assert not motion.lost
        assert motion.unchecked
        assert np.hypot(*(motion.state[:2] - pose[:2])) < 20


def test_which_of_four_lies_is_not_guessed() -> None:
    """Neither before any pose, when several threes fit; nor from a spike or two of each."""
    pose = (100.0, 2500.0, 0.05)
    rows = on_line(pixels(pose))[[0, 1, 3, 4]]
    for known, spikes in ((False, 40), (True, FEW)):
        motion, random = settled(pose=pose)
        if not known:
            motion = MotionFilter(CAMERA, LEDS)
        n = 30
        while not motion.lost:
            n += 1
            motion.observe(n * FRAME, {0: MISSING})
        for _ in range(spikes):
            n += 1
            seen = frame(pose, random, rows[[n % 4]])
            if n % 4 == 1:
                (channel,) = seen
                seen[channel] = replace(seen[channel], position=seen[channel].position + 400.0)
            motion.observe(n * FRAME, seen)
            assert not motion._to_confirm
        assert motion.lost


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


def test_an_led_that_was_easy_to_please_does_not_vouch_for_a_pose() -> None:
    """While a pose is confirmed, what is taken in after a pause passes wherever it nearly is."""
    motion, random = MotionFilter(CAMERA, LEDS), np.random.default_rng(9)
    pose = (50.0, 2500.0, 0.02)
    rows = on_line(pixels(pose))
    seen, fourth = rows[[0, 2, 4]], rows[[1]]
    n = 0
    while not np.isfinite(motion.covariance).all():
        n += 1
        motion.observe(n * FRAME, frame(pose, random, seen[[n % 3]]))
    n += 12  # of 4 ms
    motion.observe(n * FRAME, frame(pose, random, fourth))
    (innovation,) = (i for i in motion.innovations if i.channel == LEDS.channels[fourth[0]])
    assert innovation.outcome is Outcome.USED
    assert innovation.sigma > 2 * DOUBT
    for _ in range(20):
        n += 1
        motion.observe(n * FRAME, frame(pose, random, [seen[n % 2], fourth[0]]))
    assert not motion.lost
    assert motion.unchecked
    motion.observe((n + 1) * FRAME, frame(pose, random, rows[[3]]))
    assert not motion.unchecked


def test_four_leds_that_go_on_to_agree_are_enough() -> None:
    """There is no fifth, and one of them was easy to please when the pose was confirmed."""
    random = np.random.default_rng(9)
    pose = (50.0, 2500.0, 0.02)
    rows = on_line(pixels(pose))[:4]
    few = LedMap([LEDS.channels[row] for row in rows], LEDS.positions[rows])
    motion, n = MotionFilter(CAMERA, few), 0
    while not np.isfinite(motion.covariance).all():
        n += 1
        motion.observe(n * FRAME, frame(pose, random, rows[[n % 3]]))
    n += 12
    motion.observe(n * FRAME, frame(pose, random, rows[[3]]))
    for _ in range(20):
        n += 1
        motion.observe(n * FRAME, frame(pose, random, rows[[n % 3]]))
    assert motion.unchecked
    for _ in range(12):
        n += 1
        motion.observe(n * FRAME, frame(pose, random, rows[[n % 4]]))
    assert not motion.unchecked


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


def test_a_refusal_soon_after_doubt_raises_it_again() -> None:
    """The LED that agreed may have done so with the pose that a reflection had moved."""
    motion, random = settled(frames=60)
    pose = (0.0, 2500.0, 0.0)
    rows = on_line(pixels(pose))
    for n in range(61, 73):
        motion.observe(n * FRAME, {LEDS.channels[rows[0]]: MISSING})
    motion.observe(73 * FRAME, frame(pose, random, rows[[0]]))
    assert motion.unchecked
    n = 73
    while motion.unchecked:
        n += 1
        motion.observe(n * FRAME, frame(pose, random, rows[[1, 2, 3]]))
    far = {
        c: replace(s, position=s.position + 30) for c, s in frame(pose, random, rows[[3]]).items()
    }
    estimate = motion.observe((n + 1) * FRAME, far)
    assert estimate.flags & PoseFlags.REJECTED
    assert estimate.flags & PoseFlags.UNCHECKED
    estimate = motion.observe((n + 2) * FRAME, frame(pose, random, rows[[1, 2]]))
    assert estimate.flags == PoseFlags.UNCHECKED
    for k in range(n + 3, n + 12):
        estimate = motion.observe(k * FRAME, frame(pose, random, rows[[1, 2]]))
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
        {"memory": -1.0},
        {"uncertainty": (1.0,)},
        {"uncertainty": (1.0, 2.0, 3.0)},
        {"uncertainty": 50.0},
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
