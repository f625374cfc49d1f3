"""Response surface of a crossing's residuals: second order in its poorly determined coordinates.

The whitened residuals are fitted by parabolas over points drawn from a widened posterior (Box and
Wilson 1951). The elements enter as ln c, in which the parabolas hold further than in c. Differences
at the optimum alone miss what a bridge with restrained ends does to a crossing whose own optimum
has none.

All other coordinates are integrated out as a normal. The vibration before the crossing is a wave of
the bridge's own frequency, which moves with the bridge: removed at the frequency of the optimum it
would leave, or take, a wave in the residuals of any other bridge. So it is noise here, in the
mixture of its waves on the bridges of all points.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve, qr

from pre_core.arrays import FloatArray
from pre_core.crossing import posterior
from pre_core.crossing.fit import Optimum
from pre_core.crossing.posterior import PosteriorProblem

POINTS = 640
"""Number of points to which a surface is fitted, five for each of its coefficients. With half as
many the remainder of third order enters the slopes as if it were knowledge of the bridge."""
_SWINGING = 40
"""Number of these points whose waves of the initial vibration are computed for their mixture."""
_LEAST_WAVE = 0.03
"""Smallest wave that is kept, in standard deviations of a residual."""
_LEAST_SIZE = 1e-9
_RIDGE = 1e-2
"""Weight against slopes and products that the points do not separate."""


class SurfaceParts(NamedTuple):
    """The coordinates and residuals of a crossing that a surface distinguishes."""

    curved: NDArray[np.int64]
    """Indices (n,) in y of the coordinates whose effect is a parabola, without the offset."""
    linear: NDArray[np.int64]
    """Indices (t,) of coordinates that remain and enter linearly."""
    rows: NDArray[np.int64]
    """Indices (m,) of the residuals, without the priors of both."""
    waves: FloatArray
    """Effect (m, q) of waves of the mismatch that remain."""
    wave_precision: FloatArray
    """Prior precision (q, q) of their coefficients."""


class ResponseSurface(NamedTuple):
    """Residuals (m,), rotated, with all coordinates integrated out but those of `SurfaceParts`.

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


def place_of_offset(problem: PosteriorProblem) -> int:
    """Return the index in y of the coefficient that stands for the whole trajectory's offset."""
    where = posterior.layout(problem)
    return (where.trajectory.start + where.trajectory.stop) // 2


def residuals_of(surface: ResponseSurface, y: FloatArray) -> FloatArray:
    """Return residuals (k, m) at curved coordinates and offset y (k, n + 1), the others there."""
    u = (y - surface.centre) / surface.size
    products = _products(u) @ surface.products.T
    return np.asarray(surface.constant + u @ surface.slopes.T + products)


def _products(u: FloatArray) -> FloatArray:
    """Return the products (k, pairs) u_i u_j, i <= j by rows, of moves (k, n)."""
    first, second = np.triu_indices(u.shape[1])
    return np.asarray(u[:, first] * u[:, second])


def response_surface(
    found: Optimum,
    problem: PosteriorProblem,
    jacobian: FloatArray,
    parts: SurfaceParts,
    drawn: FloatArray,
) -> ResponseSurface:
    """Return the surface of a crossing fitted at points of its curved coordinates and offset.

    `problem` may have another noise than the optimum's, `jacobian` (rows, f) is that of its
    residuals there, in the coordinates y. `drawn` (POINTS, n + 1) are the points.
    """
    where = posterior.layout(problem)
    y = found.state.y.copy()
    swing = np.arange(where.swing.start, where.swing.stop)
    y[swing] = 0.0
    jacobian = jacobian[parts.rows]
    # The whole trajectory follows one coefficient, and its other coordinates are relative to it.
    kept = np.append(parts.curved, place_of_offset(problem))
    jacobian[:, kept[-1]] = jacobian[:, where.trajectory].sum(axis=1)
    own = np.setdiff1d(np.arange(y.size), np.concatenate([kept, parts.linear, swing]))
    moves = drawn - y[kept]
    points = np.repeat(y[None, :], drawn.shape[0], axis=0)
    points[:, parts.curved] = drawn[:, :-1]
    swung = _swing_waves(problem, points[:: drawn.shape[0] // _SWINGING], parts.rows)

    def extended(columns: FloatArray) -> FloatArray:
        """Return columns (m, n) with zeros for the priors of the mixture."""
        return np.vstack([columns, np.zeros((swung.shape[1], columns.shape[1]))])

    nuisances = np.hstack([extended(jacobian[:, own]), np.vstack([swung, np.eye(swung.shape[1])])])
    linear, waves = extended(jacobian[:, parts.linear]), extended(parts.waves)
    columns, of_kept = (nuisances, linear, waves), extended(jacobian[:, kept])
    of_own, of_linear = _follow(columns, parts.wave_precision, of_kept)
    points[:, where.trajectory] += moves[:, -1:]
    points[:, own] += moves @ of_own[: own.size].T
    points[:, parts.linear] += moves @ of_linear.T
    basis = np.linalg.qr(nuisances)[0]
    residuals = extended(posterior.all_rows(problem, points)[:, parts.rows].T)
    all_columns = (residuals, linear, waves)
    residuals, linear, waves = (some - basis @ (basis.T @ some) for some in all_columns)
    # Zero is what the site file excludes.
    centre, size = drawn.mean(axis=0), np.maximum(drawn.std(axis=0), _LEAST_SIZE)
    fitted = _fit_parabolas((drawn - centre) / size, residuals)
    # The residuals' squares are all that counts, so that a rotation makes them few.
    (few,) = qr(np.hstack([fitted, linear, waves]), mode="r")
    ends = np.cumsum([1, kept.size, fitted.shape[1] - 1 - kept.size, linear.shape[1]])
    constant, slopes, products, linear, waves = np.hsplit(few[: few.shape[1]], ends)
    return ResponseSurface(
        centre,
        size,
        constant[:, 0],
        slopes,
        products,
        linear,
        y[parts.linear] + of_linear @ (centre - y[kept]),
        of_linear * size,
        waves,
        drawn.shape[0] + (1 + swing.size) * _SWINGING,
    )


def _swing_waves(
    problem: PosteriorProblem, points: FloatArray, rows: NDArray[np.int64]
) -> FloatArray:
    """Return waves (m, r) whose covariance is that of the initial vibration at points (n, f)."""
    swing = posterior.layout(problem).swing
    residuals = posterior.all_rows(problem, points)[:, rows]
    waves = []
    for place in range(swing.start, swing.stop):
        swinging = points.copy()
        swinging[:, place] += 1.0
        waves.append(posterior.all_rows(problem, swinging)[:, rows] - residuals)
    directions, spread, _ = np.linalg.svd(np.concatenate(waves).T, full_matrices=False)
    spread /= np.sqrt(points.shape[0])
    clear = int((spread > _LEAST_WAVE).sum())
    return np.asarray(directions[:, :clear] * spread[:clear])


def _follow(
    parts: tuple[FloatArray, FloatArray, FloatArray], wave_precision: FloatArray, kept: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the slopes of conditional means by `kept` (m, n), of nuisances and linear ones.

    `parts` are the columns (m, …) of nuisances, linear coordinates and waves.
    """
    columns = np.hstack(parts)
    begin = parts[0].shape[1]
    end = begin + parts[1].shape[1]
    precision = columns.T @ columns
    precision[np.arange(begin, end), np.arange(begin, end)] += 1.0
    precision[end:, end:] += wave_precision
    slopes = -cho_solve(cho_factor(precision), columns.T @ kept)
    return slopes[:begin], slopes[begin:end]


def _fit_parabolas(u: FloatArray, values: FloatArray) -> FloatArray:
    """Return constant, slopes and products (m, 1 + n + pairs) of values (m, k) at u (k, n)."""
    design = np.column_stack([np.ones(u.shape[0]), u, _products(u)])
    normal = design.T @ design
    normal[1:, 1:] += _RIDGE * np.eye(normal.shape[0] - 1)
    return np.asarray(cho_solve(cho_factor(normal), design.T @ values.T).T)
