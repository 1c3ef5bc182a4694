"""Noise and codes of the simulated sensor against the figures it is built from."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from raytransfer import TCD1304
from twin.sensor import SHIELDED, Electronics, SensorModel

LINE = slice(32, 32 + 3648)
QUIET = Electronics(
    read_noise=0, dark_rate=0, response_spread=0, register_imbalance=0, odd_even_offset=0
)


def volts(codes: object) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    return np.asarray(codes, dtype=float) * 3.3 / 4096


def test_dark_reads_as_real_captures_do() -> None:
    """3915 to 3930 counts, neighbours 0.7 to 1.8 counts apart, odd/even step about one count."""
    model = SensorModel(seed=1)
    frames = np.array([model.digitise(np.zeros(3648), 0.0)[0] for _ in range(40)], dtype=float)
    assert 3915 <= frames.mean() <= 3930
    assert 0.7 <= frames[:, 100:200:2].std(axis=0).mean() <= 1.8
    step = frames[:, LINE][:, 1::2].mean() - frames[:, LINE][:, ::2].mean()
    assert abs(step) == pytest.approx(1, abs=0.3)


def test_light_lowers_the_output_down_to_saturation() -> None:
    model = SensorModel(electronics=dataclasses.replace(QUIET, full_well=50_000))
    charge = np.linspace(0, 100_000, 3648)
    codes, idle = model.digitise(charge, 0.0)
    line = volts(codes[LINE])
    assert idle == codes[0]
    assert line[0] == pytest.approx(3.16, abs=1e-3)
    assert line[-1] == pytest.approx(3.16 - 1.66, abs=1e-3)
    half = np.searchsorted(charge, 25_000)
    assert line[half - 50 : half + 50].mean() == pytest.approx(3.16 - 0.83, abs=2e-3)


def test_shot_noise_is_poisson() -> None:
    model = SensorModel(electronics=QUIET)
    charge = np.full(3648, 20_000.0)
    frames = np.array([model.digitise(charge, 0.0)[0][LINE] for _ in range(50)], dtype=float)
    electrons = (frames[0].mean() - frames) * (3.3 / 4096) / QUIET.swing * QUIET.full_well
    quantisation = (3.3 / 4096 / QUIET.swing * QUIET.full_well) ** 2 / 12
    assert electrons.var() == pytest.approx(20_000 + quantisation, rel=0.02)


def test_fixed_pattern_is_of_the_specimen_noise_of_the_readout() -> None:
    one, same, other = SensorModel(seed=5), SensorModel(seed=5), SensorModel(seed=6)
    assert np.array_equal(one.response, same.response)
    assert not np.array_equal(one.response, other.response)
    first, again = one.digitise(np.zeros(3648), 0.0)[0], same.digitise(np.zeros(3648), 0.0)[0]
    assert np.array_equal(first, again)
    assert not np.array_equal(first, one.digitise(np.zeros(3648), 0.0)[0])


def test_response_spread_is_within_the_datasheets_prnu() -> None:
    response = SensorModel(seed=3).response
    assert np.abs(response / response.mean() - 1).max() < 0.10
    odd, even = response[::2].mean(), response[1::2].mean()
    assert odd / even - 1 == pytest.approx(0.01, abs=0.002)


def test_shielded_pixels_hold_dark_signal_only() -> None:
    model = SensorModel(electronics=dataclasses.replace(QUIET, dark_rate=1e6))
    codes, idle = model.digitise(np.zeros(3648), 0.02)
    dark = (
        (idle - codes[SHIELDED].astype(float).mean()) * 3.3 / 4096 / QUIET.swing * QUIET.full_well
    )
    assert dark == pytest.approx(20_000, rel=0.3)
    assert np.ptp(codes[:16].astype(int)) == 0
    assert model.dark_rates().mean() == pytest.approx(1e6, rel=0.03)
    assert model.dark_rates().min() > 0


def test_codes_are_clipped_at_the_adcs_ends() -> None:
    high = SensorModel(electronics=dataclasses.replace(QUIET, dark_voltage=4.0, swing=8.0))
    codes, idle = high.digitise(np.full(3648, 1e9), 0.0)
    assert idle == 4095
    assert codes[LINE].max() == 0


def test_wrong_figures_are_refused() -> None:
    with pytest.raises(ValueError, match="transfer_fraction"):
        Electronics(transfer_fraction=0)
    with pytest.raises(ValueError, match="read_noise"):
        Electronics(read_noise=-1)
    with pytest.raises(ValueError, match="seed"):
        SensorModel(seed=-1)
    assert TCD1304.elements == 3694
