"""Channels as smooth functions of time: integrals, derivatives and delays of known sines."""

import numpy as np
import pytest
from numpy.typing import NDArray

from pre_core.channels import A_1, A_2, A, V, Z, channel_signals

FloatArray = NDArray[np.float64]

ORDERS = {Z: -2, V: -1, A: 0, A_1: 1, A_2: 2}
"""How often each signal is the acceleration differentiated."""


def inner(values: FloatArray, step_s: float) -> FloatArray:
    """Without half a second at both ends, where a spline is poorer."""
    cut = round(0.5 / step_s)
    return values[..., cut:-cut]


def derivative_of_sine(order: int, omega: float, phase: float, t: FloatArray) -> FloatArray:
    """Derivative (or, below zero, integral) of sin(omega t + phase)."""
    return np.asarray(omega**order * np.sin(omega * t + phase + 0.5 * np.pi * order))


def without_polynomial(values: FloatArray, degree: int, t: FloatArray) -> FloatArray:
    """Unknown initial values add a constant (and a slope) to the integrals: leave them out."""
    fit = np.polynomial.Polynomial.fit(t, values, degree)
    return np.asarray(values - fit(t))


@pytest.mark.parametrize("frequency_hz", [1.3, 15.0])
def test_integrals_and_derivatives_of_a_sine(frequency_hz: float) -> None:
    step_s = 1e-3
    t = step_s * np.arange(4001, dtype=np.float64)
    omega = 2.0 * np.pi * frequency_hz
    phases = np.array([0.0, 0.7, 2.0, -1.1])
    signals = channel_signals(np.sin(omega * t + phases[:, None]), step_s)
    assert signals.shape == (4, 5, t.size)
    seen = inner(t, step_s)
    for channel, phase in enumerate(phases):
        for place, order in ORDERS.items():
            truth = inner(derivative_of_sine(order, omega, phase, t), step_s)
            ours = inner(signals[channel, place], step_s)
            if order < 0:
                degree = -order - 1
                truth = without_polynomial(truth, degree, seen)
                ours = without_polynomial(ours, degree, seen)
            error = np.abs(ours - truth).max() / omega**order
            assert error < 1e-6, (place, phase, error)


def test_integrals_begin_at_zero_in_the_middle() -> None:
    rng = np.random.default_rng(1)
    signals = channel_signals(rng.standard_normal((4, 1001)), 1e-3)
    np.testing.assert_allclose(signals[:, [Z, V], 500], 0.0, atol=1e-12)


def test_a_constant_integrates_to_a_parabola() -> None:
    step_s = 5e-3
    t = step_s * (np.arange(401) - 200)
    signals = channel_signals(np.full((4, 401), 2.0), step_s)
    np.testing.assert_allclose(signals[:, V], np.tile(2.0 * t, (4, 1)), atol=1e-10)
    np.testing.assert_allclose(signals[:, Z], np.tile(t**2, (4, 1)), atol=1e-10)


def test_integrals_of_a_sine_converge_with_the_sixth_order() -> None:
    """Degree 5: the error of what is integrated falls as step^6, that of the trapezoid as step^2.

    For samples of a sine a spline of degree d has the relative error 2 zeta(d + 1) (f step)^(d+1)
    in the component itself: its order is d + 1.
    """
    frequency_hz = 10.0
    omega = 2.0 * np.pi * frequency_hz
    steps = np.array([1 / 80, 1 / 120, 1 / 180])
    errors = []
    for step_s in steps:
        t = step_s * np.arange(round(4.0 / step_s) + 1)
        signals = channel_signals(np.tile(np.sin(omega * t), (4, 1)), float(step_s))
        seen = inner(t, step_s)
        ours = without_polynomial(inner(signals[0, V], step_s), 0, seen)
        truth = without_polynomial(inner(derivative_of_sine(-1, omega, 0.0, t), step_s), 0, seen)
        errors.append(omega * np.abs(ours - truth).max())
    order = np.polyfit(np.log(steps), np.log(errors), 1)[0]
    assert 5.5 < order < 7.5, (order, errors)


def test_a_delay_by_taylors_series_is_a_delay() -> None:
    """0.5 ms at 15 Hz, with the terms that pre_model keeps: three for displacement and velocity."""
    step_s, delay_s = 1e-3, 0.5e-3
    omega = 2.0 * np.pi * 15.0
    t = step_s * np.arange(4001, dtype=np.float64)
    z, v, a, a1, a2 = channel_signals(np.tile(np.sin(omega * t), (4, 1)), step_s)[0]
    d = delay_s
    shifted = {
        Z: z + d * v + d**2 / 2 * a + d**3 / 6 * a1,
        V: v + d * a + d**2 / 2 * a1 + d**3 / 6 * a2,
        A: a + d * a1 + d**2 / 2 * a2,
    }
    seen = inner(t, step_s)
    for place, ours in shifted.items():
        order = ORDERS[place]
        truth = inner(derivative_of_sine(order, omega, 0.0, t + d), step_s)
        got = inner(ours, step_s)
        if order < 0:
            truth = without_polynomial(truth, -order - 1, seen)
            got = without_polynomial(got, -order - 1, seen)
        error = np.abs(got - truth).max() / omega**order
        # The first term left out is (omega d)^4/24 = 2e-7 or, for the acceleration, ^3/6 = 1.7e-5.
        assert error < (2e-5 if place == A else 1e-5), (place, error)
