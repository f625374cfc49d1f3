"""Response surface of a crossing's residuals: second order in its poorly determined coordinates.

The whitened residuals are fitted by parabolas over points drawn from a widened posterior (Box and
Wilson 1951). The elements enter as ln c, in which the parabolas hold over a wider range than in c.
Differences at the optimum alone miss the effect of restrained ends on a crossing whose own optimum
has none. All other coordinates are integrated out (`nuisances`).

What parabolas leave of the residuals, the remainder, is of third order. In fusion it counts as
noise with the remainder's covariance over the points. Otherwise the surfaces of many crossings,
each off by more than a log-likelihood of one, would add up to a narrow peak far from the truth: in
a survey of three elements, seven standard deviations from it.
"""

from collections.abc import Callable
from functools import reduce
from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from pre_core.arrays import FloatArray
from pre_core.crossing.nuisances import Nuisances, integrated_residuals, unexplained, with_mixture

POINTS, POINTS_OF_DRAWS = 1920, 960
"""Numbers of points to which a surface is fitted: for fusion (fourteen for each of its
coefficients), and for a single crossing. Fewer or repeated points leave so much of the third-order
remainder in the slopes that other points move a fused EI by twice its standard deviation.
"""
_TOGETHER = 160
"""Number of points evaluated together: their residuals take some ten megabytes."""
_EVERY = 4
"""One in so many points counts in the covariance of the remainder, which bounds memory."""
_LEAST_SIZE = 1e-9
_RIDGE = 1e-2
"""Weight against slopes and products that the points do not separate."""


class ResponseSurface(NamedTuple):
    """Residuals (m,), rotated, with all coordinates integrated out but those of `ResidualParts`.

    With moves u = (y - centre)/size of the curved coordinates and of the offset, l of the linear
    ones and coefficients w of waves, they are

        constant + slopes u + products (u_i u_j) + linear (l - at - follow u) + waves w

    with the products i <= j by rows.
    """

    centre: FloatArray  # (n + 1,) the offset last, as a coefficient of the trajectory in m
    size: FloatArray  # (n + 1,)
    constant: FloatArray  # (m,)
    slopes: FloatArray  # (m, n + 1)
    products: FloatArray  # (m, pairs)
    linear: FloatArray  # (m, t)
    at: FloatArray  # (t,)
    follow: FloatArray  # (t, n + 1)
    waves: FloatArray  # (m, q)
    evaluations: int
    """Number of evaluations that the fit took."""


def residuals_of(surface: ResponseSurface, y: FloatArray) -> FloatArray:
    """Return residuals (k, m) at curved coordinates and offset y (k, n + 1).

    All other coordinates follow these.
    """
    u = (y - surface.centre) / surface.size
    products = _products(u) @ surface.products.T
    return np.asarray(surface.constant + u @ surface.slopes.T + products)


def parabola_terms(u: FloatArray) -> FloatArray:
    """Return constant, moves and products (k, p) of moves u (k, n)."""
    return np.column_stack([np.ones(u.shape[0]), u, _products(u)])


def _products(u: FloatArray) -> FloatArray:
    """Return the products (k, pairs) u_i u_j, i <= j by rows, of moves (k, n)."""
    first, second = np.triu_indices(u.shape[1])
    return np.asarray(u[:, first] * u[:, second])


def response_surface(
    nuisances: Nuisances, jacobian: FloatArray, drawn: FloatArray, *, for_fusion: bool = False
) -> ResponseSurface:
    """Return the surface of a crossing fitted at points of its curved coordinates and offset.

    `jacobian` (rows, f) is that of its residuals at the optimum, in the coordinates y. `drawn`
    (k, n + 1) are the points. `for_fusion` the nuisances of each point take a Gauss-Newton step,
    and the remainder of the fit is noise.
    """
    parts, r = nuisances.parts, nuisances.mixture_size
    linear = unexplained(nuisances, with_mixture(jacobian[np.ix_(parts.rows, parts.linear)], r))
    waves = unexplained(nuisances, with_mixture(parts.waves, r))
    # A parameter that the site file excludes has the size zero.
    centre, size = drawn.mean(axis=0), np.maximum(drawn.std(axis=0), _LEAST_SIZE)
    fitted, error, remainder = _fit_parabolas(
        (drawn - centre) / size,
        lambda some: integrated_residuals(nuisances, drawn[some], has_step=for_fusion),
        with_remainder=for_fusion,
    )
    few = _root_of_squares(np.hstack([fitted, linear, waves]), error, remainder)
    n = nuisances.kept.size
    ends = np.cumsum([1, n, fitted.shape[1] - 1 - n, linear.shape[1]])
    constant, slopes, products, linear, waves = np.hsplit(few, ends)
    return ResponseSurface(
        centre,
        size,
        constant[:, 0],
        slopes,
        products,
        linear,
        nuisances.y[parts.linear] + nuisances.of_linear @ (centre - nuisances.y[nuisances.kept]),
        nuisances.of_linear * size,
        waves,
        nuisances.evaluations + (2 if for_fusion else 1) * drawn.shape[0],
    )


class ParabolaSums(NamedTuple):
    """Sums over points u (k, n) for least-squares parabolas of values (m,)."""

    gram: FloatArray  # (p, p) of constant, slopes and products
    image: FloatArray  # (p, m)
    squares: float
    points: float


def sums_of(u: FloatArray, values: FloatArray, weight: FloatArray | None = None) -> ParabolaSums:
    """Return the sums of values (m, k) at points u (k, n), which count by `weight` (k,)."""
    design = parabola_terms(u)
    if weight is not None:
        design, values = design * np.sqrt(weight)[:, None], values * np.sqrt(weight)
    return ParabolaSums(
        design.T @ design, design.T @ values.T, float(np.sum(values * values)), u.shape[0]
    )


def added(one: ParabolaSums, other: ParabolaSums) -> ParabolaSums:
    """Return the sums over the points of both."""
    return ParabolaSums(
        one.gram + other.gram,
        one.image + other.image,
        one.squares + other.squares,
        one.points + other.points,
    )


def parabolas(sums: ParabolaSums) -> tuple[FloatArray, FloatArray]:
    """Return constant, slopes and products (m, p) of the values, and their error.

    The error (p, p) is the covariance that the remainder causes, summed over the m values.
    """
    normal = sums.gram.copy()
    normal[1:, 1:] += _RIDGE * np.eye(normal.shape[0] - 1)
    inverse = cho_solve(cho_factor(normal), np.eye(normal.shape[0]))
    fitted = inverse @ sums.image
    degrees = max(1.0, sums.points - float(np.sum(inverse * sums.gram)))
    remainder = (sums.squares - float(np.sum(fitted * sums.image))) / degrees
    return np.asarray(fitted.T), remainder * inverse


def _fit_parabolas(
    u: FloatArray, values_at: Callable[[slice], FloatArray], *, with_remainder: bool = True
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the `parabolas` of values at points u (k, n), and their remainder (m, s).

    The remainder is a root of its covariance, from one in `_EVERY` points, or empty unless asked
    for. `values_at` returns the values (m, …) of some points, so that not all are in memory. Points
    without a finite value do not count: so far away, a truck may never reach the bridge.
    """
    some_u: list[FloatArray] = []
    some_values: list[FloatArray] = []

    def sums(some: slice) -> ParabolaSums:
        at, values = u[some], values_at(some)
        is_possible = np.isfinite(values).all(axis=0)
        if not is_possible.all():
            at, values = at[is_possible], values[:, is_possible]
        if with_remainder:
            some_u.append(at[::_EVERY])
            some_values.append(values[:, ::_EVERY])
        return sums_of(at, values)

    parts = [slice(first, first + _TOGETHER) for first in range(0, u.shape[0], _TOGETHER)]
    whole = reduce(added, map(sums, parts))
    fitted, error = parabolas(whole)
    if not with_remainder:
        return fitted, error, np.zeros((fitted.shape[0], 0))
    remainder = np.hstack(some_values) - fitted @ parabola_terms(np.concatenate(some_u)).T
    # The fit takes its number of coefficients from the degrees of freedom of all points.
    free = max(1.0, whole.points - fitted.shape[1]) / whole.points
    return fitted, error, remainder / np.sqrt(free * remainder.shape[1])


def _root_of_squares(columns: FloatArray, error: FloatArray, noise: FloatArray) -> FloatArray:
    """Return R (q, q) with R'R = A' (I + N N')^-1 A minus the error of A's first columns.

    A = `columns` (m, q), N = `noise` (m, s). Only the squares of the residuals matter, so R
    replaces A. Without the subtraction, the `error` (p, p) of fitted coefficients would count as
    information on the bridge, in every crossing.
    """
    across, of_noise = noise.T @ columns, noise.T @ noise
    solved = np.linalg.solve(np.eye(noise.shape[1]) + of_noise, np.hstack([across, of_noise]))
    squares = columns.T @ columns - across.T @ solved[:, : columns.shape[1]]
    # The error is the remainder's, so that noise reduces both by the same share.
    total = float(np.trace(of_noise))
    share = float(np.trace(solved[:, columns.shape[1] :])) / total if total else 1.0
    squares[: error.shape[0], : error.shape[0]] -= share * error
    values, vectors = np.linalg.eigh(squares)
    return np.asarray(np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T)
