"""B-splines: values and derivatives of a basis, of a curve.

Written out because `scipy.interpolate` takes as long to import as a crossing's search does
(docs/benchmarks.md); tests/numerics/test_splines.py compares the two. The recurrences are those of
de Boor (1972) and Cox (1972); beyond the ends the first and the last polynomial go on.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


class Spline(NamedTuple):
    """A curve: knots (b + degree + 1,), increasing, and coefficients (b,)."""

    knots: FloatArray
    coefficients: FloatArray
    degree: int


def clamped_knots(inner: FloatArray, degree: int) -> FloatArray:
    """Knots of curves that begin at the first and end at the last of `inner`."""
    ends = np.full(degree, inner[0]), np.full(degree, inner[-1])
    return np.concatenate([ends[0], inner, ends[1]])


def basis(knots: FloatArray, degree: int, x: FloatArray, derivative: int = 0) -> FloatArray:
    """Values (n, b) at x (n,) of each basis function, or of its derivative."""
    if derivative > 0:
        inner = knots[1:-1]
        lower = basis(inner, degree - 1, x, derivative - 1)
        slope = degree / (inner[degree:] - inner[:-degree])
        out = np.zeros((x.size, lower.shape[1] + 1))
        out[:, 1:] += lower * slope
        out[:, :-1] -= lower * slope
        return out
    count = knots.size - degree - 1
    span = np.clip(np.searchsorted(knots, x, side="right") - 1, degree, count - 1)
    values = np.zeros((x.size, degree + 1))
    values[:, -1] = 1.0
    for k in range(1, degree + 1):
        # Those of degree k - 1 that are not zero are the last k; the others stay zero.
        of = span[:, None] + np.arange(-k, 1)
        first, width = knots[of[:, 1:]], knots[of[:, 1:] + k] - knots[of[:, 1:]]
        share = values[:, degree - k + 1 :] * ((x[:, None] - first) / width)
        rest = values[:, degree - k + 1 :] - share
        values[:, degree - k + 1 :] = share
        values[:, degree - k : degree] += rest
    out = np.zeros((x.size, count))
    out[np.arange(x.size)[:, None], span[:, None] + np.arange(-degree, 1)] = values
    return out


def value_at(spline: Spline, x: FloatArray, derivative: int = 0) -> FloatArray:
    """Values (n,) of a curve or of its derivative at x (n,)."""
    return np.asarray(basis(spline.knots, spline.degree, x, derivative) @ spline.coefficients)
