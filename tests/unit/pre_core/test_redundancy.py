"""What redundant sensors of a part say against one another."""

import numpy as np
import pytest

from pre_core.diagnostics.redundancy import RedundancyResidual, motion_ratio, redundancy_residual
from services.common.arrays import Floats

STEP_S = 0.002
DENSITY = 25e-6 * 9.80665
PARITY = np.array([[1.0, -1.0, -1.0, 1.0]]) / (2.0 * DENSITY)


def corners(seed: int = 1, seconds: float = 8.0) -> Floats:
    """Four corners of a rigid body that heaves, pitches and rolls, with noise."""
    rng = np.random.default_rng(seed)
    size = round(seconds / STEP_S)
    frequency = np.fft.rfftfreq(size, STEP_S)
    shape = np.exp(-(((frequency - 2.0) / 1.5) ** 2))
    drawn = np.fft.irfft(np.fft.rfft(rng.standard_normal((3, size)), axis=1) * shape, size)
    heave, pitch, roll = drawn / drawn.std(axis=1, keepdims=True) * [[0.15], [0.05], [0.03]]
    noise = DENSITY * np.sqrt(0.5 / STEP_S) * rng.standard_normal((4, size))
    signs = [(1.0, 1.0), (1.0, -1.0), (-1.0, 1.0), (-1.0, -1.0)]
    return np.array([heave + p * pitch + r * roll for p, r in signs]) + noise


def judged(acceleration: Floats) -> RedundancyResidual:
    return redundancy_residual(PARITY, acceleration, STEP_S, 0.01, 0.0005, 2.5)


def test_sound_sensors_leave_their_noise_alone() -> None:
    found = [judged(corners(seed)) for seed in range(20)]
    bins = 8.0 * (12.0 - 0.7)
    assert np.mean([one.power for one in found]) == pytest.approx(bins, rel=0.1)
    assert all(one.power < 0.1 * one.expected for one in found)


def test_gains_and_delays_within_their_spreads_are_expected() -> None:
    rng = np.random.default_rng(3)
    for seed in range(20):
        signals = corners(seed) * (1.0 + 0.01 * rng.standard_normal((4, 1)))
        slopes = np.gradient(signals, STEP_S, axis=1)
        signals = signals - 0.0005 * rng.standard_normal((4, 1)) * slopes
        found = judged(signals)
        assert found.power < found.expected


def test_delays_alone_are_expected_by_their_spread() -> None:
    rng = np.random.default_rng(4)
    for seed in range(20):
        signals = corners(seed)
        late = 0.004 * rng.standard_normal((4, 1))
        signals = signals - late * np.gradient(signals, STEP_S, axis=1)
        found = redundancy_residual(PARITY, signals, STEP_S, 1e-4, 0.004, 2.5)
        assert found.power < found.expected


@pytest.mark.parametrize("channel", range(4))
@pytest.mark.parametrize("gain", [0.8, 0.9, 1.1, 1.3])
def test_wrong_gain_is_the_channels_own(channel: int, gain: float) -> None:
    signals = corners()
    signals[channel] *= gain
    found = judged(signals)
    assert found.power > found.expected
    assert int(np.argmin(found.unexplained)) == channel
    assert found.unexplained[channel] < 0.1
    assert found.gain[channel] == pytest.approx(1.0 - 1.0 / gain, abs=0.01)
    assert abs(found.delay_s[channel]) < 0.5e-3


@pytest.mark.parametrize("channel", range(4))
def test_late_sensor_is_found_with_its_delay(channel: int) -> None:
    signals = corners()
    signals[channel] = np.roll(signals[channel], 4)
    found = judged(signals)
    assert found.power > found.expected
    assert int(np.argmin(found.unexplained)) == channel
    assert found.delay_s[channel] == pytest.approx(8e-3, rel=0.1)


def test_loose_sensor_is_nobodys_gain() -> None:
    signals = corners()
    signals[2] += 0.5 * np.roll(corners(9)[0], 100)
    found = judged(signals)
    assert found.power > found.expected
    assert np.nanmin(found.unexplained) > 0.5


def test_sides_that_move_apart_are_compared_by_size() -> None:
    one = corners()[0]
    assert motion_ratio(one, one, STEP_S) == pytest.approx(1.0)
    assert motion_ratio(one, -3.0 * one, STEP_S) == pytest.approx(3.0)
    assert motion_ratio(one, np.zeros_like(one), STEP_S) == np.inf
