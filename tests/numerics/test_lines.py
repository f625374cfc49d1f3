"""Hum: what is taken for a line, and what its waves take out."""

import numpy as np
import pytest
from scipy import signal

from pre_core.crossing import lines
from services.common.arrays import Floats

APART_S = 0.009
COUNT = 900


def noise(seed: int, count: int = COUNT) -> Floats:
    return np.random.default_rng(seed).standard_normal((count, 3))


def times(count: int = COUNT) -> Floats:
    return APART_S * np.arange(count)


def hum(hz: float, amplitude: float, phase: float = 0.4) -> Floats:
    """A line in all three kinds of rows."""
    return amplitude * np.sin(2.0 * np.pi * hz * times()[:, None] + phase * np.arange(3))


def test_noise_has_no_line() -> None:
    found = [lines.strongest_line_hz(noise(seed), APART_S) for seed in range(500)]
    assert found == [0.0] * 500


@pytest.mark.parametrize("hz", [10.9, 16.7, 25.0, 33.3, 49.9])
def test_a_line_is_found_where_it_is(hz: float) -> None:
    found = lines.strongest_line_hz(noise(1) + hum(hz, 0.8), APART_S)
    assert found == pytest.approx(hz, abs=0.07)


def test_a_line_in_one_kind_of_rows_is_found() -> None:
    rows = noise(2)
    rows[:, 0] += hum(30.0, 1.0)[:, 0]
    assert lines.strongest_line_hz(rows, APART_S) == pytest.approx(30.0, abs=0.07)


def test_a_body_that_swings_below_ten_hertz_is_no_line() -> None:
    assert lines.strongest_line_hz(noise(3) + hum(6.0, 3.0), APART_S) == 0.0


@pytest.mark.parametrize("seed", range(20))
@pytest.mark.parametrize("damping", [0.05, 0.1])
def test_a_resonance_is_no_line(seed: int, damping: float) -> None:
    """A wheel that hops at 12 Hz on a random road, ten times as loud as the noise."""
    omega, step = 2.0 * np.pi * 12.0, APART_S
    pole = np.exp((-damping + 1j * np.sqrt(1.0 - damping**2)) * omega * step)
    hops = signal.lfilter([1.0], np.poly([pole, pole.conj()]).real, noise(seed)[:, 0])
    rows = noise(seed + 100)
    rows[:, 1] += 10.0 * hops / hops.std()
    assert lines.strongest_line_hz(rows, APART_S) == 0.0


@pytest.mark.parametrize("part", [slice(300, 600), slice(450, 900)])
def test_what_rings_on_the_bridge_alone_is_no_line(part: slice) -> None:
    rows = noise(4)
    rows[part] += hum(14.0, 3.0)[part]
    assert lines.strongest_line_hz(rows, APART_S) == 0.0


def test_waves_take_out_hum_whose_amplitude_and_phase_drift() -> None:
    time = times()
    line_waves = lines.line_waves([33.0], COUNT, APART_S)
    assert line_waves.T @ line_waves == pytest.approx(np.eye(line_waves.shape[1]), abs=1e-12)
    drifting = (1.0 + 0.5 * np.sin(0.7 * time)) * np.cos(2.0 * np.pi * 33.1 * time + 0.3 * time)
    left = lines.project_out(line_waves, drifting[None, :])
    assert np.sqrt(np.mean(left**2)) < 0.01
    beside = np.cos(2.0 * np.pi * 30.0 * time)[None, :]
    assert np.mean(lines.project_out(line_waves, beside) ** 2) > 0.98 * np.mean(beside**2)


def test_two_lines_are_taken_out_together() -> None:
    rows = (hum(20.0, 1.0) + hum(40.0, 0.5)).T
    line_waves = lines.line_waves([20.0, 40.0], COUNT, APART_S)
    assert np.abs(lines.project_out(line_waves, rows)).max() < 1e-3


@pytest.mark.parametrize("hz", [25.0, 50.0, 60.0, 70.0])
def test_a_line_has_the_frequency_that_the_sensors_feel(hz: float) -> None:
    """Rows at 111 Hz fold what is above 55 Hz; the signals at 333 Hz know better."""
    time = 0.003 * np.arange(3 * COUNT)
    signals = np.random.default_rng(5).standard_normal((4, time.size))
    signals[2] += np.sin(2.0 * np.pi * hz * time)
    folded = lines.folded_hz(hz, APART_S)
    assert folded <= 0.5 / APART_S
    assert lines.unfolded_hz(signals, 0.003, APART_S, folded) == pytest.approx(hz)
