"""Every feature of the sensor models, measured on their output."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import csd, welch

from pre_core.arrays import FloatArray
from pre_core.constants import MICRO_G_M_PER_S2
from pre_core.physics.sensors import (
    Accelerometer,
    ReceiverModel,
    gauss_markov,
    measure_acceleration,
    measure_position,
)


def noise(sensor: Accelerometer, seconds: float, seed: int = 1) -> FloatArray:
    still = np.zeros(round(seconds * sensor.rate_hz) + 1)
    return measure_acceleration(still, sensor.rate_hz, sensor, np.random.default_rng(seed))


def tone(frequency_hz: float, rate_hz: float, seconds: float) -> FloatArray:
    t = np.arange(round(seconds * rate_hz) + 1) / rate_hz
    return np.asarray(np.sin(2.0 * np.pi * frequency_hz * t))


def test_perfect_sensor_changes_nothing() -> None:
    signal = np.random.default_rng(3).standard_normal(1000)
    read = measure_acceleration(signal, 1000.0, Accelerometer(1000.0), np.random.default_rng(0))
    np.testing.assert_array_equal(read, signal)


def test_same_seed_same_reading() -> None:
    sensor = Accelerometer(500.0, 25.0, pink_corner_hz=1.0)
    np.testing.assert_array_equal(noise(sensor, 2.0, seed=4), noise(sensor, 2.0, seed=4))
    assert not np.array_equal(noise(sensor, 2.0, seed=4), noise(sensor, 2.0, seed=5))


@pytest.mark.parametrize("rate_hz", [200.0, 1000.0])
def test_white_noise_has_its_declared_density(rate_hz: float) -> None:
    """Welch's one-sided density over 100 s; 1.5 % is five times its expected scatter."""
    reading = noise(Accelerometer(rate_hz, noise_density_ug_per_rthz=25.0), 100.0)
    frequency, power = welch(reading, fs=rate_hz, nperseg=1024)
    density = np.sqrt(power[(frequency > 1.0) & (frequency < 0.45 * rate_hz)].mean())
    assert density / MICRO_G_M_PER_S2 == pytest.approx(25.0, rel=0.015)
    assert reading.std() == pytest.approx(25e-6 * 9.80665 * np.sqrt(rate_hz / 2.0), rel=0.015)


def test_noise_of_a_decimated_channel_has_its_declared_density_too() -> None:
    sensor = Accelerometer(200.0, noise_density_ug_per_rthz=100.0)
    reading = measure_acceleration(np.zeros(400_001), 4000.0, sensor, np.random.default_rng(2))
    assert reading.size == 20_001
    assert reading.std() == pytest.approx(100.0 * MICRO_G_M_PER_S2 * 10.0, rel=0.025)


def test_pink_noise_slope_and_corner() -> None:
    """Slope -1 below the corner; at the corner twice the power of the white noise."""
    sensor = Accelerometer(100.0, noise_density_ug_per_rthz=50.0, pink_corner_hz=5.0)
    frequency, power = welch(noise(sensor, 4000.0), fs=100.0, nperseg=8192)
    power = power / (50.0 * MICRO_G_M_PER_S2) ** 2
    low = (frequency > 0.05) & (frequency < 0.5)
    slope = np.polyfit(np.log(frequency[low]), np.log(power[low]), 1)[0]
    corrected = power[low] - 1.0
    pink_slope = np.polyfit(np.log(frequency[low]), np.log(corrected), 1)[0]
    assert pink_slope == pytest.approx(-1.0, abs=0.03)
    assert slope > pink_slope  # the white part flattens the sum
    corner = (frequency > 4.5) & (frequency < 5.5)
    assert power[corner].mean() == pytest.approx(2.0, rel=0.03)
    white = frequency > 40.0
    assert power[white].mean() == pytest.approx(1.0 + 5.0 / 45.0, rel=0.02)


def test_bias_and_gain() -> None:
    sensor = Accelerometer(1000.0, bias_m_per_s2=0.05, gain_error=0.01)
    signal = tone(7.0, 1000.0, 1.0)
    read = measure_acceleration(signal, 1000.0, sensor, np.random.default_rng(0))
    gain, bias = np.polyfit(signal, read, 1)
    assert gain == pytest.approx(1.01, rel=1e-12)
    assert bias == pytest.approx(0.05, rel=1e-10)


@pytest.mark.parametrize(("rate_hz", "delay_s"), [(1000.0, 0.0004), (500.0, 0.0023), (200.0, 0.01)])
def test_delay_is_the_slope_of_the_phase(rate_hz: float, delay_s: float) -> None:
    """Cross spectrum of what a late and a prompt channel make of the same broad-band signal."""
    truth = np.random.default_rng(8).standard_normal(40_001)
    prompt = measure_acceleration(truth, 2000.0, Accelerometer(rate_hz), np.random.default_rng(0))
    late = measure_acceleration(
        truth, 2000.0, Accelerometer(rate_hz, delay_s=delay_s), np.random.default_rng(0)
    )
    frequency, cross = csd(prompt, late, fs=rate_hz, nperseg=1024)
    band = (frequency > 0.02 * rate_hz) & (frequency < 0.25 * rate_hz)
    phase = np.unwrap(np.angle(cross[band]))
    measured = -np.polyfit(frequency[band], phase, 1)[0] / (2.0 * np.pi)
    assert measured == pytest.approx(delay_s, rel=0.01)


def test_a_sample_stamped_t_shows_what_was_at_t_less_the_delay() -> None:
    t = np.arange(2001) / 1000.0
    signal = np.sin(2.0 * np.pi * 3.0 * t)
    sensor = Accelerometer(1000.0, delay_s=0.0123)
    read = measure_acceleration(signal, 1000.0, sensor, np.random.default_rng(0))
    inner = slice(200, 1800)
    np.testing.assert_allclose(
        read[inner], np.sin(2.0 * np.pi * 3.0 * (t[inner] - 0.0123)), atol=1e-4
    )


@pytest.mark.parametrize("frequency_hz", [110.0, 190.0, 333.0])
def test_tones_above_half_the_output_rate_do_not_fold_back(frequency_hz: float) -> None:
    """Without the low-pass every one of these would appear at full size: the attenuation is 80 dB.

    The ends are left out: before its first sample the signal is taken for constant.
    """
    sensor = Accelerometer(200.0)
    signal = tone(frequency_hz, 1000.0, 5.0)
    read = measure_acceleration(signal, 1000.0, sensor, np.random.default_rng(0))
    assert np.abs(read[100:-100]).max() < 1e-4
    folded = signal[::5]
    assert np.abs(folded[100:-100]).max() > 0.5


@pytest.mark.parametrize("frequency_hz", [0.5, 20.0, 75.0])
def test_tones_below_four_tenths_of_the_output_rate_pass(frequency_hz: float) -> None:
    read = measure_acceleration(
        tone(frequency_hz, 1000.0, 5.0), 1000.0, Accelerometer(200.0), np.random.default_rng(0)
    )
    np.testing.assert_allclose(read[100:-100], tone(frequency_hz, 200.0, 5.0)[100:-100], atol=1e-4)


def test_output_rate_need_not_divide_the_input_rate() -> None:
    read = measure_acceleration(
        tone(5.0, 1000.0, 2.0), 1000.0, Accelerometer(300.0), np.random.default_rng(0)
    )
    assert read.size == 601
    np.testing.assert_allclose(read[60:-60], tone(5.0, 300.0, 2.0)[60:-60], atol=1e-4)


def test_a_sensor_quicker_than_its_input_is_refused() -> None:
    with pytest.raises(ValueError, match="cannot be fed"):
        measure_acceleration(np.zeros(10), 100.0, Accelerometer(200.0), np.random.default_rng(0))


def test_quantisation_and_saturation() -> None:
    step = 40.0 / 4096.0
    sensor = Accelerometer(1000.0, quantisation_m_per_s2=step, range_m_per_s2=20.0)
    signal = np.linspace(-25.0, 25.0, 200_001)
    read = measure_acceleration(signal, 1000.0, sensor, np.random.default_rng(0))
    levels = np.unique(read)
    np.testing.assert_allclose(np.diff(levels), step, rtol=1e-9)
    assert levels[0] == -20.0
    assert levels[-1] == 20.0
    within = np.abs(signal) < 20.0
    error = (read - signal)[within]
    assert np.abs(error).max() <= 0.5 * step * (1.0 + 1e-9)
    assert error.std() == pytest.approx(step / np.sqrt(12.0), rel=0.01)


@given(
    rate=st.sampled_from([100.0, 250.0, 400.0, 1000.0]),
    constant=st.floats(-5.0, 5.0),
    delay=st.floats(-0.01, 0.01),
)
@settings(max_examples=20, deadline=None, derandomize=True)
def test_a_constant_stays_constant(rate: float, constant: float, delay: float) -> None:
    sensor = Accelerometer(rate, delay_s=delay)
    read = measure_acceleration(np.full(501, constant), 1000.0, sensor, np.random.default_rng(0))
    np.testing.assert_allclose(read, constant, atol=1e-12)


TIME = np.arange(0, 600_001) / 1000.0  # 600 s at 10 m/s
CHAINAGE, LATERAL, SPEED = 10.0 * TIME - 50.0, np.full(TIME.size, 1.5), np.full(TIME.size, 10.0)


def drive(receiver: ReceiverModel, seed: int = 6) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Times of the fixes and errors of chainage and of lateral position."""
    fixes = measure_position(TIME, CHAINAGE, LATERAL, SPEED, receiver, np.random.default_rng(seed))
    return fixes.time_s, fixes.chainage_m - (10.0 * fixes.time_s - 50.0), fixes.lateral_m - 1.5


def test_perfect_receiver() -> None:
    time_s, chainage_error, lateral_error = drive(ReceiverModel(10.0))
    np.testing.assert_allclose(np.diff(time_s), 0.1, rtol=1e-9)
    assert time_s.size == 6001
    np.testing.assert_allclose(chainage_error, 0.0, atol=1e-9)
    np.testing.assert_allclose(lateral_error, 0.0, atol=1e-9)


def test_white_position_and_speed_errors() -> None:
    receiver = ReceiverModel(10.0, position_noise_m=0.4, speed_noise_m_per_s=0.07)
    _, chainage_error, lateral_error = drive(receiver)
    assert chainage_error.std() == pytest.approx(0.4, rel=0.04)
    assert lateral_error.std() == pytest.approx(0.4, rel=0.04)
    neighbours = np.corrcoef(chainage_error[1:], chainage_error[:-1])[0, 1]
    assert abs(neighbours) < 0.05
    assert abs(np.corrcoef(chainage_error, lateral_error)[0, 1]) < 0.05
    fixes = measure_position(TIME, CHAINAGE, LATERAL, SPEED, receiver, np.random.default_rng(1))
    assert fixes.speed_m_per_s.std() == pytest.approx(0.07, rel=0.04)
    assert fixes.speed_m_per_s.mean() == pytest.approx(10.0, abs=0.004)


def test_slow_error_has_its_spread_and_its_correlation_time() -> None:
    """Over many processes: the variance at every time, and 1/e after the correlation time."""
    rng = np.random.default_rng(9)
    time_s = np.arange(301) / 10.0
    many = np.array([gauss_markov(time_s, 1.5, 10.0, rng) for _ in range(4000)])
    np.testing.assert_allclose(many.std(axis=0)[[0, 100, 300]], 1.5, rtol=0.05)
    correlation = np.corrcoef(many[:, 0], many[:, 100])[0, 1]
    assert correlation == pytest.approx(np.exp(-1.0), abs=0.06)


def test_infinite_correlation_time_is_a_constant_bias() -> None:
    _, chainage_error, lateral_error = drive(ReceiverModel(10.0, position_spread_m=1.5))
    assert np.ptp(chainage_error) < 1e-9
    assert 0.01 < abs(chainage_error[0]) < 6.0
    assert abs(lateral_error[0] - chainage_error[0]) > 1e-3


def test_latency_shows_where_the_truck_was() -> None:
    time_s, chainage_error, _ = drive(ReceiverModel(10.0, latency_s=0.25))
    np.testing.assert_allclose(chainage_error, -2.5, atol=1e-9)
    assert time_s[0] == pytest.approx(0.3)  # before, the drive had not begun


def test_outages_take_fixes_out_and_change_no_other() -> None:
    whole = ReceiverModel(10.0, position_noise_m=0.4, position_spread_m=1.0, correlation_s=20.0)
    all_times, all_errors, _ = drive(whole)
    times, errors, _ = drive(whole._replace(outages_s=((100.0, 103.0), (200.0, 200.5))))
    out = ((all_times >= 100.0) & (all_times < 103.0)) | (
        (all_times >= 200.0) & (all_times < 200.5)
    )
    assert out.sum() == 35
    np.testing.assert_array_equal(times, all_times[~out])
    np.testing.assert_array_equal(errors, all_errors[~out])
