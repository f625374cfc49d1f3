"""B-splines: values and derivatives of a basis and of a curve; interpolating curves.

Implemented here because `scipy.interpolate` takes as long to import as a crossing's search does
(studies/benchmarks.md); tests/numerics/test_splines.py compares the two. The recurrences are those
of de Boor (1972) and Cox (1972); the first and the last polynomial extend beyond the ends.
"""

from typing import NamedTuple

import numpy as np
from scipy.linalg import solve_banded

from pre_core.arrays import FloatArray, IntArray


class Spline(NamedTuple):
    """A curve: knots (b + degree + 1,), increasing, and coefficients (b,); (b, c) of c curves."""

    knots: FloatArray
    coefficients: FloatArray
    degree: int


def clamped_knots(inner: FloatArray, degree: int) -> FloatArray:
    """Return the knots (n,) of curves from the first to the last of the points `inner` (k,)."""
    ends = np.full(degree, inner[0]), np.full(degree, inner[-1])
    return np.concatenate([ends[0], inner, ends[1]])


def basis(knots: FloatArray, degree: int, x: FloatArray, derivative: int = 0) -> FloatArray:
    """Return the values (n, b) at x (n,) of each basis function or of a `derivative` of it."""
    if derivative > 0:
        inner = knots[1:-1]
        lower = basis(inner, degree - 1, x, derivative - 1)
        slope = degree / (inner[degree:] - inner[:-degree])
        out = np.zeros((x.size, lower.shape[1] + 1))
        out[:, 1:] += lower * slope
        out[:, :-1] -= lower * slope
        return out
    first, values = _not_zero(knots, degree, x)
    out = np.zeros((x.size, knots.size - degree - 1))
    for k, value in enumerate(values):
        out[np.arange(x.size), first + k] = value
    return out


def _not_zero(knots: FloatArray, degree: int, x: FloatArray) -> tuple[IntArray, FloatArray]:
    """Return the first nonzero basis function (n,) at x (n,), and values (degree + 1, n) from it.

    The sums of the recurrence are accumulated in place, from the last function to the first.
    """
    count = knots.size - degree - 1
    span = np.clip(np.searchsorted(knots, x, side="right") - 1, degree, count - 1)
    below = [x - knots[span - k] for k in range(degree)]
    above = [knots[span + 1 + k] - x for k in range(degree)]
    values = np.zeros((degree + 1, x.size))
    values[-1] = 1.0
    for k in range(1, degree + 1):
        # The nonzero functions of degree k - 1 are the last k.
        carried = np.zeros(x.size)
        for i in range(k):
            of = degree - k + 1 + i
            share = values[of] / (above[i] + below[k - 1 - i])
            values[of - 1] = carried + above[i] * share
            carried = below[k - 1 - i] * share
        values[-1] = carried
    return span - degree, values


def value_at(spline: Spline, x: FloatArray, derivative: int = 0) -> FloatArray:
    """Return the values (n,) at x (n,) of one curve or of a `derivative` of it."""
    return np.asarray(basis(spline.knots, spline.degree, x, derivative) @ spline.coefficients)


def interpolating_spline(x: FloatArray, y: FloatArray, degree: int) -> Spline:
    """Return the curves through y (n, c) at x (n,), increasing, n > degree; the degree is odd.

    All derivatives are continuous at the (degree - 1)/2 places next to each end (de Boor's "not a
    knot").
    """
    ends = (degree + 1) // 2
    knots = clamped_knots(np.concatenate([x[:1], x[ends:-ends], x[-1:]]), degree)
    first, values = _not_zero(knots, degree, x)
    banded = np.zeros((2 * degree + 1, x.size))
    for k, value in enumerate(values):
        banded[degree + np.arange(x.size) - first - k, first + k] = value
    return Spline(knots, solve_banded((degree, degree), banded, y), degree)


def curves_at(spline: Spline, x: FloatArray) -> FloatArray:
    """Return the values (n, c) of curves at x (n,)."""
    first, values = _not_zero(spline.knots, spline.degree, x)
    out = np.zeros((x.size, spline.coefficients.shape[1]))
    for k, value in enumerate(values):
        out += value[:, None] * spline.coefficients[first + k]
    return out


def derivative(spline: Spline) -> Spline:
    """Return the curves' derivatives."""
    knots, degree = spline.knots[1:-1], spline.degree
    width = knots[degree:] - knots[:-degree]
    rise = np.diff(spline.coefficients, axis=0) * (degree / width)[:, None]
    return Spline(knots, rise, degree - 1)


def antiderivative(spline: Spline) -> Spline:
    """Return the curves' integrals from the first knot."""
    knots, degree = spline.knots, spline.degree + 1
    width = (knots[degree:] - knots[:-degree]) / degree
    sums = np.cumsum(spline.coefficients * width[:, None], axis=0)
    around = np.concatenate([knots[:1], knots, knots[-1:]])
    return Spline(around, np.concatenate([np.zeros_like(sums[:1]), sums]), degree)
