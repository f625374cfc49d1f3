"""Our B-splines against SciPy's: values, derivatives, beyond the ends, knots of any distance."""

import numpy as np
import pytest
from scipy.interpolate import BSpline, make_interp_spline

from pre_core.crossing.splines import (
    Spline,
    antiderivative,
    basis,
    clamped_knots,
    curves_at,
    derivative,
    interpolating_spline,
    value_at,
)


@pytest.mark.parametrize("degree", [1, 3, 5])
def test_basis_and_derivatives_are_those_of_scipy(degree: int) -> None:
    rng = np.random.default_rng(3)
    inner = np.cumsum(rng.uniform(0.2, 1.5, 14))
    x = np.concatenate([rng.uniform(inner[0] - 0.3, inner[-1] + 0.3, 300), inner])
    for knots in (clamped_knots(inner, degree), inner):
        count = knots.size - degree - 1
        theirs = BSpline(knots, np.eye(count), degree)
        for order in range(degree + 1):
            expected = theirs(x, nu=order)
            ours = basis(knots, degree, x, order)
            assert ours.shape == (x.size, count)
            assert np.allclose(ours, expected, rtol=1e-12, atol=1e-12 * np.abs(expected).max())


def test_a_curve_is_the_sum_of_its_basis() -> None:
    knots = clamped_knots(np.linspace(0.0, 3.0, 7), 3)
    coefficients = np.random.default_rng(4).standard_normal(knots.size - 4)
    x = np.linspace(-0.1, 3.1, 200)
    theirs = BSpline(knots, coefficients, 3)
    for order in (0, 1, 2):
        ours = value_at(Spline(knots, coefficients, 3), x, order)
        assert np.allclose(ours, theirs(x, nu=order), rtol=1e-12, atol=1e-11)


@pytest.mark.parametrize("degree", [1, 3, 5])
def test_curves_through_samples_their_slopes_and_integrals(degree: int) -> None:
    rng = np.random.default_rng(5)
    x = np.cumsum(rng.uniform(0.5, 1.5, 40))
    y = rng.standard_normal((40, 4))
    theirs, ours = make_interp_spline(x, y, k=degree), interpolating_spline(x, y, degree)
    at = np.concatenate([x, rng.uniform(x[0] - 0.2, x[-1] + 0.2, 100)])
    assert np.allclose(ours.knots, theirs.t, rtol=0.0, atol=1e-12)
    for _ in range(2):
        ours, theirs = antiderivative(ours), theirs.antiderivative()
        assert np.allclose(curves_at(ours, at), theirs(at), rtol=1e-11, atol=1e-11)
    for _ in range(1 + degree):
        ours, theirs = derivative(ours), theirs.derivative()
        expected = theirs(at)
        scale = np.abs(expected).max()
        assert np.allclose(curves_at(ours, at), expected, rtol=1e-11, atol=1e-11 * scale)
