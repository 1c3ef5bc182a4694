"""How well the firmware's way of finding spikes does: its reference in Python against the bound.

That the firmware's machine code does the same, to the last bit, is shown in tests/firmware and
tests/twin.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import erf  # type: ignore[import-untyped]

from acquisition.frames import ELEMENTS, LEADING, PIXELS, Frame, OnboardSpike
from acquisition.wiring import PROTOCOL
from raytransfer.localisation import Noise, spike_bound
from tracking.onboard import find_spikes
from tracking.spikes import Correction, SpikeFinder, SpikeFlags

NOISE = Noise()
DARK = 3920
FULL = round(NOISE.full_well / NOISE.electrons_per_code) - 5


def gaussian(middle: float, fwhm: float, height: float) -> np.ndarray:
    """Electrons of a spike on each pixel, integrated over it."""
    sigma = fwhm / np.sqrt(8 * np.log(2))
    edges = (np.arange(PIXELS + 1) - 0.5 - middle) / (np.sqrt(2) * sigma)
    return np.asarray(height * NOISE.full_well * np.sqrt(np.pi / 2) * sigma * np.diff(erf(edges)))


def read(
    electrons: np.ndarray,
    rng: np.random.Generator,
    noise: float = NOISE.read_noise,
    leds: int = 0,
) -> Frame:
    """Make a frame: photons and read-out scatter, wells are full, codes are whole."""
    charge = np.zeros(ELEMENTS)
    charge[LEADING : LEADING + PIXELS] = np.minimum(rng.poisson(electrons), NOISE.full_well)
    charge += rng.normal(0, noise, ELEMENTS)
    codes = np.rint(DARK - charge / NOISE.electrons_per_code)
    return Frame(np.clip(codes, 0, 4095).astype(np.uint16), leds=leds)


def scatter(
    fwhm: float, height: float, count: int = 150, window: int | None = None
) -> tuple[float, float, list[OnboardSpike]]:
    """RMS error over bound, mean error, and the spikes."""
    rng = np.random.default_rng(round(fwhm * 10))
    errors, bounds, spikes = [], [], []
    for _ in range(count):
        middle = 1800 + rng.uniform(-40, 40)
        light = gaussian(middle, fwhm, height)
        around = [(0, PIXELS - 1)]
        if window is not None:
            around = [(round(middle) - window // 2, round(middle) + window // 2)]
        (spike,) = find_spikes(read(light, rng), around, saturated=FULL).spikes
        spikes.append(spike)
        errors.append(spike.position - middle)
        bounds.append(spike_bound(np.minimum(light, NOISE.full_well)))
    ratio = float(np.sqrt(np.mean(np.square(errors))) / np.mean(bounds))
    print(f"FWHM {fwhm} px, {height} of full well: {ratio:.2f} x bound")
    return ratio, float(np.mean(errors)), spikes


@pytest.mark.parametrize("fwhm", [4, 6, 20, 64, 200])
@pytest.mark.parametrize("height", [0.7, 0.1])
def test_positions_scatter_little_more_than_they_must(fwhm: float, height: float) -> None:
    ratio, bias, spikes = scatter(fwhm, height)
    assert ratio < 1.3
    assert abs(bias) < 0.25 * ratio * spike_bound(gaussian(1800, fwhm, height))
    assert all(spike.flags == 0 for spike in spikes)
    assert np.mean([s.width for s in spikes]) == pytest.approx(fwhm, rel=0.04, abs=0.1)
    codes = height * NOISE.full_well / NOISE.electrons_per_code
    found = np.mean([s.height for s in spikes])
    sampled = gaussian(1800, fwhm, height).max() / NOISE.electrons_per_code
    assert 0.85 * sampled < found < codes * 1.02 + 4


@pytest.mark.parametrize("fwhm", [6, 20])
def test_a_window_that_holds_the_spike_costs_nothing(fwhm: float) -> None:
    whole, _, _ = scatter(fwhm, 0.7)
    windowed, _, spikes = scatter(fwhm, 0.7, window=round(5 * fwhm) + 16)
    assert windowed < 1.05 * whole
    assert all(spike.flags == 0 for spike in spikes)


@pytest.mark.parametrize("fwhm", [6, 20, 64, 200])
def test_saturated_spikes(fwhm: float) -> None:
    """Three times what the wells hold: the flanks are left, which the bound knows better to use."""
    ratio, _, spikes = scatter(fwhm, 3.0, count=100)
    assert ratio < 7
    assert all(spike.flags == SpikeFlags.SATURATED for spike in spikes)


@pytest.mark.parametrize("noise", [20.0, NOISE.read_noise, 60.0, 90.0, 150.0])
def test_darkness_has_no_spikes(noise: float) -> None:
    """Thirteen elements tell the noise to a quarter only: sometimes half of what it is."""
    rng = np.random.default_rng(1)
    for ambient in (0.0, 2000.0, 15000.0):
        light = np.full(PIXELS, ambient)
        assert not any(find_spikes(read(light, rng, noise)).spikes for _ in range(700))


@pytest.mark.parametrize("counts", [45, 120, 500, 2000])
def test_a_hot_pixel_is_no_spike_but_a_sharp_led_is(counts: int) -> None:
    rng = np.random.default_rng(9)
    electrons = counts * NOISE.electrons_per_code
    for n in range(100):
        light = gaussian(1800.0, 12, 0.3)
        light[200 + n] += electrons
        assert [round(s.position) for s in find_spikes(read(light, rng)).spikes] == [1800]
        # beside a spike's top it moves that, but does not hide it
        light[1796] += electrons
        assert len(find_spikes(read(light, rng)).spikes) == 1
    if counts >= 120:
        sharp = np.zeros(PIXELS)
        sharp[700:703] = np.array([0.12, 0.76, 0.12]) * electrons / 0.76
        assert len(find_spikes(read(sharp, rng)).spikes) == 1


def test_uneven_pixels_and_sloping_light_have_none_either() -> None:
    rng = np.random.default_rng(2)
    response = 1 + 0.015 * rng.standard_normal(PIXELS) + 0.005 * (-1) ** np.arange(PIXELS)
    slope = np.linspace(0, 8000, PIXELS)
    for light in (slope, slope[::-1], 4000 + 4000 * np.sin(np.linspace(0, np.pi, PIXELS))):
        for _ in range(30):
            for spike in find_spikes(read(light * response, rng)).spikes:
                assert spike.flags & SpikeFlags.CLIPPED or spike.width > 500
    for spread in (0.03, 0.05):  # under 1000 counts of daylight
        response = 1 + spread * rng.standard_normal((200, PIXELS))
        light = 1000 * NOISE.electrons_per_code * response
        found = sum(len(find_spikes(read(line, rng)).spikes) for line in light)
        print(f"{found} of 200 lines with pixels uneven by {spread}")
        assert found == 0


WINDOW = (900, 1200)


def both(light: np.ndarray, rng: np.random.Generator, *, leds: int = 1) -> list[SpikeFlags]:
    """Flags of the highest spike in a window: of the firmware, and of the host's `SpikeFinder`."""
    frame = read(light, rng, leds=leds)
    onboard = find_spikes(frame, [WINDOW], saturated=FULL).spikes[0]
    finder = SpikeFinder(Correction.nominal(saturation=FULL))
    (host,) = finder(frame, windows=[WINDOW])
    assert abs(onboard.position - host.position) < 0.05 * host.width
    return [SpikeFlags(onboard.flags), host.flags]


@pytest.mark.parametrize(
    ("spikes", "flags"),
    [
        ([(1050.0, 20, 0.6)], SpikeFlags.NONE),
        ([(915.0, 20, 0.6)], SpikeFlags.CLIPPED),
        ([(1185.0, 20, 0.6)], SpikeFlags.CLIPPED),
        ([(925.0, 20, 0.6)], SpikeFlags.NONE),
        ([(1050.0, 20, 3.0)], SpikeFlags.SATURATED),
        ([(1050.0, 20, 1.05)], SpikeFlags.SATURATED),
        ([(1050.0, 20, 0.93)], SpikeFlags.NONE),
        ([(1000.0, 20, 0.6), (1060.0, 20, 0.1)], SpikeFlags.REFLECTION),
        ([(1000.0, 20, 0.6), (1070.0, 20, 0.5)], SpikeFlags.DOUBLE),
        ([(1000.0, 20, 0.6), (1300.0, 20, 0.5)], SpikeFlags.NONE),
    ],
)
def test_flags_mean_what_they_mean_on_the_host(
    spikes: list[tuple[float, float, float]], flags: SpikeFlags
) -> None:
    rng = np.random.default_rng(3)
    light = sum((gaussian(*spike) for spike in spikes), np.zeros(PIXELS))
    for _ in range(10):
        assert both(light, rng) == [flags, flags]


def test_flags_are_the_bits_of_the_wire() -> None:
    assert PROTOCOL.spikes.flags == {
        name: SpikeFlags[name.upper()].value
        for name in ("saturated", "clipped", "double", "reflection")
    }


def test_flags() -> None:
    rng = np.random.default_rng(3)

    def found(*spikes: tuple[float, float, float], leds: int = 1) -> list[OnboardSpike]:
        light = sum((gaussian(*spike) for spike in spikes), np.zeros(PIXELS))
        return list(find_spikes(read(light, rng, leds=leds)).spikes)

    (edge,) = found((-1.0, 30, 0.5))
    assert edge.flags == SpikeFlags.CLIPPED
    (edge,) = found((3649.0, 30, 0.5))
    assert edge.flags == SpikeFlags.CLIPPED
    # two peaks with light between them are one spike, in the middle
    (double,) = found((1000.0, 20, 0.4), (1026.0, 20, 0.5))
    assert double.flags == SpikeFlags.DOUBLE
    assert 1005 < double.position < 1021
    # with a deep valley they are two
    first, second = found((1000.0, 20, 0.4), (1070.0, 20, 0.5))
    assert (first.flags, second.flags) == (SpikeFlags.DOUBLE, 0)
    assert abs(first.position - 1070) < 0.1
    assert abs(second.position - 1000) < 0.1
    strong, weak = found((1000.0, 20, 0.6), (1060.0, 20, 0.1))
    assert strong.flags == SpikeFlags.REFLECTION
    assert weak.flags == 0
    strong, weak = found((1000.0, 20, 0.6), (1400.0, 20, 0.1))
    assert strong.flags == weak.flags == 0
    # with two LEDs lit, or none, who knows
    for leds in (0, 3):
        for height in (0.1, 0.5):
            strong, weak = found((1000.0, 20, 0.6), (1070.0, 20, height), leds=leds)
            assert strong.flags == weak.flags == 0


def test_the_highest_eight_of_many() -> None:
    rng = np.random.default_rng(4)
    heights = rng.permutation(np.linspace(0.1, 0.9, 12))
    light = sum((gaussian(150 + 300 * n, 12, h) for n, h in enumerate(heights)), np.zeros(PIXELS))
    spikes = find_spikes(read(light, rng)).spikes
    expected = 150 + 300 * np.argsort(-heights)[:8]
    assert np.allclose([spike.position for spike in spikes], expected, atol=0.2)
    # each window has one at least, though the first could fill all eight
    windows = [(300, 3299), (0, 299), (3300, 3599)]
    spikes = find_spikes(read(light, rng), windows).spikes
    assert [spike.window for spike in spikes] == [0] * 6 + [1, 2]


def test_threshold_is_light_over_eight_pixels() -> None:
    rng = np.random.default_rng(5)
    light = gaussian(1804, 5, 0.2)  # within one block, about 790 counts in all
    assert find_spikes(read(light, rng), threshold=500).spikes
    assert not find_spikes(read(light, rng), threshold=1000).spikes


def test_what_is_asked_for_is_checked() -> None:
    frame = read(np.zeros(PIXELS), np.random.default_rng(6))
    for windows in ([], [(30 * n, 30 * n + 29) for n in range(9)]):
        with pytest.raises(ValueError, match="allowed are 1 to 8"):
            find_spikes(frame, windows)
    for window in ((0, 22), (3620, 3648), (-1, 30)):
        with pytest.raises(ValueError, match="24 pixels or more"):
            find_spikes(frame, [window])
    with pytest.raises(ValueError, match="20 to 60 overlaps 60 to 90"):
        find_spikes(frame, [(60, 90), (20, 60)])
