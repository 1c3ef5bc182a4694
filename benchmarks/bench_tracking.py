"""Tracking on one core: frame to spike, spike to pose, whole frames to poses, and the first ones."""

from __future__ import annotations

import math
import pickle
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from acquisition.frames import ELEMENTS, LEADING, PIXELS, Frame
from benchmarks.measure import Result, interleaved, seconds

if TYPE_CHECKING:
    from collections.abc import Callable

    from tracking.calibration import Calibration
    from tracking.spikes import Detector

SENSOR_RATE = 4e6 / (4 * ELEMENTS)  # frames per second
ICG = 14800  # master clocks
PERIOD = 3_700_000  # ns
FRAMES = 300
ROUNDS = 9
STARTS = 5
WIDTHS = (6.0, 20.0)  # px; full width at half maximum
WINDOW = 128  # px
FULL = 1880 * 47.0  # electrons that fill a pixel


def run() -> list[Result]:
    """Time all parts in turns."""
    likelihood, gravity = (_finding(name) for name in ("likelihood", "gravity"))
    windowed = _finding("gravity", WINDOW)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "frames"
        path.write_bytes(pickle.dumps(_walk(FRAMES)))
        found, centred, within, filtered, tracked = interleaved(
            ROUNDS, likelihood, gravity, windowed, _filtering(), lambda: _tracking(path)
        )
        ready, longest = zip(*(_fresh(path) for _ in range(STARTS + 1)), strict=True)
    return [
        Result(
            "frame → spike, maximum likelihood, whole line",
            "µs",
            [1e6 * s for s in found],
            "lower",
            150,
        ),
        Result(
            "frame → spike, centre of gravity, whole line",
            "µs",
            [1e6 * s for s in centred],
            "lower",
            30,
        ),
        Result(
            "frame → spike, centre of gravity, window of 128 px",
            "µs",
            [1e6 * s for s in within],
            "lower",
            30,
        ),
        Result("spike → filtered pose", "µs", [1e6 * s for s in filtered], "lower", 100),
        Result(
            "frames → poses, three LEDs a frame / the sensor's rate",
            "×",
            [1 / (s * SENSOR_RATE) for s in tracked],
            "higher",
            10,
        ),
        # the first process may have had to compile
        Result("tracker ready, fresh process", "s", list(ready[1:]), "lower"),
        Result("longest of the first 300 updates", "ms", list(longest[1:]), "lower", 20),
    ]


def _frame(spikes: list[tuple[float, float]], width: float, **values: Any) -> Frame:
    """A frame with Gaussian spikes (px, electrons) of that FWHM, with noise."""
    rng = np.random.default_rng(values.get("sequence", 0))
    electrons = np.full(PIXELS, 300.0)
    for at, height in spikes:
        electrons += height * np.exp(-4 * math.log(2) * ((np.arange(PIXELS) - at) / width) ** 2)
    electrons = rng.poisson(np.minimum(electrons, FULL)) + rng.normal(0, 60, PIXELS)
    elements = np.full(ELEMENTS, 3900.0)
    elements[LEADING : LEADING + PIXELS] -= electrons / 47
    codes = np.rint(np.clip(elements, 0, 4095)).astype(np.uint16)
    return Frame(codes, sh_period=100, icg_period=ICG, **values)


def _finding(name: Detector, window: int | None = None) -> Callable[[], float]:
    """Return what times a detector on spikes of `WIDTHS`, of the whole line or of a window."""
    from tracking.spikes import SpikeFinder

    finder = SpikeFinder(detector=name, limit=1)
    finder.load_kernels()
    places = [700.3 + 211.7 * n for n in range(10)]
    frames = [
        (
            _frame([(at, 0.7 * FULL)], width, sequence=n),
            None if window is None else [(int(at) - window // 2, int(at) + window // 2 - 1)],
        )
        for n, at in enumerate(places)
        for width in WIDTHS
    ]
    for frame, windows in frames:
        (spike,) = finder(frame, windows=windows)
        if abs(spike.position - places[frame.sequence]) > 0.5:
            raise ValueError(f"{name} finds {spike}")
    call = seconds(lambda: [finder(frame, windows=windows) for frame, windows in frames], 5)
    return lambda: call() / len(frames)


def _calibration() -> Calibration:
    from tracking.calibration import Calibration
    from tracking.camera import Camera
    from tracking.leds import LedMap

    return Calibration(Camera(3500.0, pupil=8.0, model_error=0.02), LedMap.line(9, 500.0, 300.0))


def _pose(t_ns: int) -> tuple[float, float, float]:
    """At 1 m/s round a place 2.5 m in front of the LEDs."""
    angle = t_ns * 1e-9 / 0.6
    return 600 * math.sin(angle), 2500 + 600 * math.cos(angle), 0.1 * math.sin(angle)


def _seen(t_ns: int) -> dict[int, float]:
    """Spikes on the line by channel, px."""
    from tracking.poses import optical

    known = _calibration()
    pixels = known.camera.project(optical(known.leds.positions, *_pose(t_ns)))
    return {n: float(u) for n, u in zip(known.leds.channels, pixels, strict=True) if 30 < u < 3617}


def _walk(count: int) -> list[Frame]:
    """Frames of a walk: first one LED each, then three at once."""
    frames = []
    for number in range(count):
        t_ns = 50_000_000 + number * PERIOD
        seen = _seen(t_ns)
        several = number >= 20
        lit = [*seen][:: max(1, len(seen) // 3)][:3] if several else [[*seen][number % len(seen)]]
        spikes = [(seen[n], 0.5 * FULL) for n in lit]
        leds = sum(1 << n for n in lit)
        frames.append(_frame(spikes, 10.0, sequence=number, leds=leds, timestamp=t_ns))
    return frames


def _filtering() -> Callable[[], float]:
    """Return what times a spike taken in and the pose that comes of it."""
    from tracking.motion import MotionFilter, Outcome
    from tracking.poses import Fix, PoseFlags
    from tracking.spikes import Spike

    known = _calibration()
    start = 50_000_000
    fix = Fix(
        *_pose(start),
        height=0.0,
        covariance=np.diag([25.0, 25.0, 1e-4]),
        residuals=np.zeros(0),
        rejected=np.zeros(0, bool),
        chi2=0.0,
        degrees=0,
        flags=PoseFlags.NONE,
    )
    spikes = []
    for number in range(1, 1001):
        t_ns = start + number * PERIOD
        seen = [*_seen(t_ns).items()]
        channel, pixel = seen[number % len(seen)]
        spikes.append((t_ns, channel, Spike(pixel, 0.03, 10.0, 4e4)))

    def measure() -> float:
        motion = MotionFilter(known.camera, known.leds)
        motion.start(fix, start)
        begun = time.perf_counter()
        for t_ns, channel, spike in spikes:
            motion.update(t_ns, channel, spike)
            motion.estimate()
        taken = time.perf_counter() - begun
        if motion.lost or motion.innovations[-1].outcome is not Outcome.USED:
            raise RuntimeError("the filter has lost the walk")
        return taken / len(spikes)

    return measure


def _updates(frames: list[Frame]) -> tuple[float, list[float]]:
    """Seconds until a tracker is ready, and of the processor for each update."""
    begun = time.perf_counter()
    from tracking.poses import PoseFlags
    from tracking.tracker import Tracker

    tracker = Tracker(_calibration())
    ready = time.perf_counter() - begun
    taken = []
    for frame in frames:
        begun = time.process_time()
        estimate = tracker.update(frame)
        taken.append(time.process_time() - begun)
    truth = _pose(frames[-1].timestamp or 0)
    if estimate is None or estimate.flags & PoseFlags.LOST or abs(estimate.x - truth[0]) > 2:
        raise RuntimeError(f"the tracker is at {estimate}, not at {truth}")
    return ready, taken


def _read(path: Path) -> list[Frame]:
    """Frames as a link makes them: pickled ones could be written to, for which code is compiled."""
    return [replace(frame) for frame in pickle.loads(path.read_bytes())]  # noqa: S301  # from above


def _tracking(path: Path) -> float:
    """Mean seconds of an update once a pose is known."""
    taken = _updates(_read(path))[1][30:]
    return sum(taken) / len(taken)


def _fresh(path: Path) -> tuple[float, float]:
    """Seconds until ready and ms of the longest update, in a process of its own."""
    command = [sys.executable, "-m", "benchmarks.bench_tracking", str(path)]
    printed = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    ready, longest = (float(word) for word in printed.split())
    return ready, longest


if __name__ == "__main__":
    first, updates = _updates(_read(Path(sys.argv[1])))
    print(first, 1e3 * max(updates))
