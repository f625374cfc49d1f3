"""Channels as smooth functions of time: integrals, derivatives and delays of known sines."""

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from pre_core.arrays import FloatArray
from pre_core.crossing import channels
from pre_core.crossing.channels import (
    A_1,
    A_2,
    A_3,
    INTERPOLATION_REACH,
    MODEL_RATE_HZ,
    PASS_BAND,
    STOP,
    A,
    ModelSignals,
    V,
    Z,
    channel_signals,
    interpolate_at,
    low_pass,
)
from pre_core.physics.sensors import resample

ORDERS = {Z: -2, V: -1, A: 0, A_1: 1, A_2: 2, A_3: 3}
"""How often each signal is the acceleration differentiated."""
RATES_HZ = (100.0, 200.0, 250.0, 500.0, 1000.0, 2000.0)
PHASES = np.array([0.0, 0.7, 2.0, -1.1])
RIPPLE = 1e-4
"""Two filters of 90 dB one after the other; Kaiser's formula for their length is 2 dB off."""


def inner(values: FloatArray, step_s: float) -> FloatArray:
    """Without half a second at both ends, where a spline is poorer."""
    cut = round(0.5 / step_s)
    return values[..., cut:-cut]


def derivative_of_sine(order: int, omega: float, phase: float, t: FloatArray) -> FloatArray:
    """Derivative (or, below zero, integral) of sin(omega t + phase)."""
    return np.asarray(omega**order * np.sin(omega * t + phase + 0.5 * np.pi * order))


def without_polynomial(values: FloatArray, order: int, t: FloatArray) -> FloatArray:
    """Unknown initial values add a constant (and a slope) to the integrals: leave them out."""
    if order >= 0:
        return values
    fit = np.polynomial.Polynomial.fit(t, values, -order - 1)
    return np.asarray(values - fit(t))


def sampled_sines(frequency_hz: float, rate_hz: float, seconds: float = 5.0) -> FloatArray:
    """A sine of unit amplitude, in each of the four channels at another phase."""
    t = np.arange(round(seconds * rate_hz) + 1) / rate_hz
    return np.asarray(np.sin(2.0 * np.pi * frequency_hz * t + PHASES[:, None]))


def times_s(model: ModelSignals) -> FloatArray:
    return model.start_s + model.step_s * np.arange(model.signals.shape[2], dtype=np.float64)


def model_rate_hz(rate_hz: float) -> float:
    return 1.0 / channel_signals(np.zeros((4, round(2.0 * rate_hz))), 1.0 / rate_hz, rate_hz).step_s


@pytest.mark.parametrize("rate_hz", RATES_HZ)
def test_the_models_rate(rate_hz: float) -> None:
    """Of the samples, two for each of the model's or one for two, never quicker than wanted."""
    rate = model_rate_hz(rate_hz)
    assert 0.75 * MODEL_RATE_HZ < rate <= MODEL_RATE_HZ or rate == pytest.approx(2.0 * rate_hz)
    # Rows see nothing above an eighth of it: less than what even the slowest sensor passes.
    assert rate / 8.0 < 0.45 * rate_hz


@pytest.mark.parametrize("rate_hz", RATES_HZ)
@pytest.mark.parametrize("share", [None, 0.125, 0.99 * PASS_BAND])
def test_integrals_and_derivatives_of_a_sine(rate_hz: float, share: float | None) -> None:
    """At 10 Hz, at the end of what rows see and at the end of the pass band."""
    rate = model_rate_hz(rate_hz)
    frequency_hz = 10.0 if share is None else share * rate
    omega = 2.0 * np.pi * frequency_hz
    model = channel_signals(sampled_sines(frequency_hz, rate_hz), 1.0 / rate_hz, rate_hz)
    assert model.signals.shape[:2] == (4, 6)
    seen = inner(times_s(model), model.step_s)
    # At its own samples a quintic spline's second and third derivative lack 2 zeta(4) and 6 zeta(4)
    # times (f h)^4: images of the sine at 1/h - f and 1/h + f that fold back onto it.
    spline = (frequency_hz / max(800.0, rate_hz)) ** 4
    for channel, phase in enumerate(PHASES):
        for place, order in ORDERS.items():
            truth = derivative_of_sine(order, omega, phase, seen)
            ours = inner(model.signals[channel, place], model.step_s)
            difference = without_polynomial(ours - truth, order, seen)
            error = np.abs(difference).max() / omega**order
            allowed = RIPPLE + {A_2: 2.2, A_3: 6.6}.get(place, 0.0) * spline
            assert error < allowed, (place, phase, error)


@pytest.mark.parametrize("rate_hz", [rate for rate in RATES_HZ if rate >= 500.0])
def test_nothing_is_left_above_the_stop_band(rate_hz: float) -> None:
    for frequency_hz in (1.01 * STOP * model_rate_hz(rate_hz), 0.37 * rate_hz, 0.48 * rate_hz):
        omega = 2.0 * np.pi * frequency_hz
        model = channel_signals(sampled_sines(frequency_hz, rate_hz), 1.0 / rate_hz, rate_hz)
        for place, order in ORDERS.items():
            ours = inner(model.signals[0, place], model.step_s)
            left = without_polynomial(ours, order, inner(times_s(model), model.step_s))
            assert np.abs(left).max() / omega**order < RIPPLE, (frequency_hz, place)


def test_slow_and_quick_sensors_give_the_same_signals() -> None:
    """Noise below 40 Hz, sampled at 2 kHz and at 200 Hz, read at the model's own moments."""
    rng = np.random.default_rng(5)
    quick = np.stack([resample(rng.standard_normal(500), 100.0, 2000.0, 0.0) for _ in range(4)])
    taps = low_pass(40.0 / 2000.0, 45.0 / 2000.0, 120.0)
    quick = np.stack([np.convolve(row, taps, mode="same") for row in quick])
    fine = channel_signals(quick, 1.0 / 2000.0, 2000.0)
    slow = channel_signals(np.ascontiguousarray(quick[:, ::10]), 1.0 / 200.0, 200.0)
    seen = inner(times_s(slow), slow.step_s)
    for place in (A, A_1):
        expected = CubicSpline(times_s(fine), fine.signals[:, place], axis=1)(seen)
        ours = inner(slow.signals[:, place], slow.step_s)
        # A cubic spline through samples 3 ms apart misses 2 zeta(4) (f h)^4 < 8e-4 of what is below
        # 45 Hz; a moment wrong by one fine sample, 1.25 ms, would be a fifth of it.
        assert np.std(ours - expected) < 1e-3 * np.std(expected), place


def test_a_record_shorter_than_the_filters_is_refused() -> None:
    for rate_hz in RATES_HZ:
        with pytest.raises(ValueError, match="shorter than the filters"):
            channel_signals(np.zeros((4, round(0.05 * rate_hz))), 1.0 / rate_hz, rate_hz)
        model = channel_signals(np.zeros((4, round(1.3 * rate_hz))), 1.0 / rate_hz, rate_hz)
        assert model.signals.shape[2] >= 2


def test_integrals_begin_at_zero_in_the_middle() -> None:
    """Of the record, up to what the low-pass takes: its mean over a few samples around there."""
    rng = np.random.default_rng(1)
    model = channel_signals(rng.standard_normal((4, 2001)), 1e-3, 1000.0)
    middle = np.argmin(np.abs(times_s(model) - 1.0))
    for place, order in ((Z, 2), (V, 1)):
        # A step of 3 ms at unit acceleration is (3 ms)^order.
        assert np.abs(model.signals[:, place, middle]).max() < 4.0 * model.step_s**order


@pytest.mark.parametrize("rate_hz", [200.0, 1000.0])
def test_a_constant_integrates_to_a_parabola(rate_hz: float) -> None:
    """The low-pass adds to a parabola half its own second moment and nothing else."""
    samples = round(4.0 * rate_hz) + 1
    model = channel_signals(np.full((4, samples), 2.0), 1.0 / rate_hz, rate_hz)
    t = times_s(model) - 2.0
    np.testing.assert_allclose(model.signals[:, A], 2.0, rtol=1e-12)
    np.testing.assert_allclose(
        model.signals[:, V] - model.signals[:, V, :1], np.tile(2.0 * (t - t[0]), (4, 1)), atol=1e-10
    )
    parabola = model.signals[:, Z] - t**2
    moved = parabola - np.polynomial.Polynomial.fit(t, parabola[0], 1)(t)
    np.testing.assert_allclose(moved, 0.0, atol=1e-10)
    np.testing.assert_allclose(model.signals[:, A_1:], 0.0, atol=1e-4)


def test_order_of_integrals_and_derivatives() -> None:
    """Degree 5: errors at the samples fall as step^6, of second and third derivative as step^4.

    For samples of a sine a spline of degree d has the relative error 2 zeta(d + 1) (f step)^(d+1)
    in the component itself; that of the trapezoid rule falls as step^2.
    """
    omega = 2.0 * np.pi * 10.0
    steps = np.array([1 / 80, 1 / 120, 1 / 180])
    expected = {Z: (5.5, 7.0), V: (5.5, 7.0), A_1: (5.5, 7.0), A_2: (3.8, 4.4), A_3: (3.8, 4.4)}
    for place, (low, high) in expected.items():
        errors = []
        for step_s in steps:
            t = step_s * np.arange(round(4.0 / step_s) + 1)
            rows = channels._derivatives(np.tile(np.sin(omega * t), (4, 1)), float(step_s))
            seen = inner(t, step_s)
            truth = derivative_of_sine(ORDERS[place], omega, 0.0, seen)
            difference = inner(rows[0, place], step_s) - truth
            errors.append(np.abs(without_polynomial(difference, ORDERS[place], seen)).max())
        order = np.polyfit(np.log(steps), np.log(errors), 1)[0]
        assert low < order < high, (place, order, errors)


@pytest.mark.parametrize("delay_s", [0.5e-3, -1e-3])
def test_a_delay_by_taylors_series_is_a_delay(delay_s: float) -> None:
    """At the end of what rows see, with the terms that pre_model keeps: up to delay^3."""
    rate_hz = 1000.0
    omega = 2.0 * np.pi * model_rate_hz(rate_hz) / 8.0
    model = channel_signals(sampled_sines(omega / (2.0 * np.pi), rate_hz), 1.0 / rate_hz, rate_hz)
    z, v, a, a1, a2, a3 = model.signals[0]
    d = delay_s
    shifted = {
        Z: z + d * v + d**2 / 2 * a + d**3 / 6 * a1,
        V: v + d * a + d**2 / 2 * a1 + d**3 / 6 * a2,
        A: a + d * a1 + d**2 / 2 * a2 + d**3 / 6 * a3,
    }
    seen = inner(times_s(model), model.step_s)
    for place, ours in shifted.items():
        order = ORDERS[place]
        truth = derivative_of_sine(order, omega, 0.0, seen + d)
        difference = without_polynomial(inner(ours, model.step_s) - truth, order, seen)
        error = np.abs(difference).max() / omega**order
        # The first term left out is (omega d)^4/24: 2e-4 for 1 ms at 42 Hz.
        assert error < 1.05 * (omega * d) ** 4 / 24.0 + RIPPLE, (place, error)
        if place == A and abs(d) == 1e-3:  # negative control: without the third derivative
            short = ours - d**3 / 6 * a3
            assert np.abs(inner(short, model.step_s) - truth).max() > 2e-3


def test_low_pass_has_unit_gain_and_stops() -> None:
    for pass_share, stop_share, db in ((0.05, 0.1, 90.0), (0.125, 0.2083, 70.0)):
        taps = low_pass(pass_share, stop_share, db)
        assert taps.size % 2 == 1
        assert taps.sum() == pytest.approx(1.0, abs=1e-12)
        np.testing.assert_allclose(taps, taps[::-1])
        frequency = np.linspace(0.0, 0.5, 3000)
        offsets = np.arange(taps.size) - taps.size // 2
        response = np.cos(2.0 * np.pi * np.outer(frequency, offsets)) @ taps
        allowed = 10 ** (-(db - 3.0) / 20.0)
        assert np.abs(response[frequency <= pass_share] - 1.0).max() < 2.0 * allowed
        assert np.abs(response[frequency >= stop_share]).max() < allowed


@pytest.mark.parametrize("share", [0.0, 0.05, 0.3, 0.44])
def test_reading_between_samples(share: float) -> None:
    """Sines up to 0.45 of the rate to 1e-4, at samples too; NaN where it does not see enough."""
    n = 300
    samples = np.cos(2.0 * np.pi * share * np.arange(n) + 0.3)
    rng = np.random.default_rng(9)
    place = np.concatenate(
        [rng.uniform(INTERPOLATION_REACH, n - INTERPOLATION_REACH - 1, 500), [40.0, 41.0]]
    )
    truth = np.cos(2.0 * np.pi * share * place + 0.3)
    np.testing.assert_allclose(interpolate_at(samples, place), truth, atol=RIPPLE)
    ends = np.array([-1.0, 0.5, INTERPOLATION_REACH - 1.5, n - INTERPOLATION_REACH + 0.5, n + 3.0])
    assert np.isnan(interpolate_at(samples, ends)).all()
