"""Posterior draws of a crossing on one profile: few coordinates by residuals, others given these.

Of about eighty coordinates those of bridge, wheelbase and delays have effects that are not linear;
badly known supports and rigidities bend the posterior so far that no normal is close to it
(`surrogate`). Given these and one offset, all others (truck, initial states, trajectory, gains and
the bridge's vibration before the crossing) are nearly normal: they are integrated out of the
residuals, whose surface proposes draws (`residual_draws`), and drawn from that normal. Draws are
weighted by the posterior of all coordinates, so that what is not quite linear costs draws and no
accuracy.

The vibration before the crossing is a wave of the bridge's own frequency. Its effect is computed
for each draw, and so is the determinant of its normal, which distinguishes bridges: without it
elements were off by a standard deviation.
"""

from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_solve, solve_triangular

from pre_core.arrays import FloatArray
from pre_core.crossing import compliances, posterior
from pre_core.crossing.fit import Optimum
from pre_core.crossing.nuisances import place_of_offset
from pre_core.crossing.posterior import PosteriorProblem
from pre_core.crossing.residual_draws import CompletedDraws, DrawnDensity, residual_draws
from pre_core.crossing.weighted_draws import WeightedDraws
from pre_core.search.loop import Report

_WIDER = 1.2
"""Noise of the density of the first points, relative to the crossing's."""
_POINTS_PER_TERM = 1.2
"""Number of first points for each term of the surface."""
_ROUNDS = 5
_LEVEL = 10.0
"""Residual of the determinant at the optimum: half its square bounds how far it may be above."""


class ConditionalDraws(NamedTuple):
    """Weighted draws (k, f) of all coordinates, and the evaluations that they took."""

    weighted: WeightedDraws
    evaluations: int


class _Partition(NamedTuple):
    """Coordinates of an optimum, and the effects of the linear ones there."""

    problem: PosteriorProblem
    y: FloatArray  # (f,) the optimum, without vibration
    inflation: float
    kept: NDArray[np.int64]  # (n + 1,) what is drawn by residuals, the offset last
    linear: NDArray[np.int64]  # (s,) without vibration
    swing: NDArray[np.int64]  # (w,) vibration before the crossing
    rows: NDArray[np.int64]  # (m,) residuals without the priors of `kept`
    effects: FloatArray  # (m, s) of the linear coordinates
    basis: FloatArray  # (m, s) orthonormal columns of the same span
    root: FloatArray  # (s, s) upper triangle R with R'R = effects' effects
    follow: FloatArray  # (s, n + 1) how the linear coordinates follow the kept ones


class _Integrated(NamedTuple):
    """One point with its linear coordinates integrated out."""

    residual: FloatArray  # (m,) what no linear coordinate explains
    log_determinant: float  # of the precision of the vibration
    root: FloatArray  # (w, w) upper triangle of that precision
    swing: FloatArray  # (w,) mean of the vibration


def conditional_draws(
    found: Optimum, draws: int, seed: int, inflation: float, report: Report
) -> ConditionalDraws:
    """Return weighted draws of all coordinates about an optimum without mismatch.

    The noise is `inflation` times the declared one. See `residual_draws` for when they end.
    """
    of = _partition(found, inflation)
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(1 << 26,)))
    n = of.kept.size
    count = round(_POINTS_PER_TERM * (n + 1) * (n + 2) / 2)
    first = compliances.present_points(found, count, _WIDER * inflation, seed)[:, of.kept]
    at_optimum = _log_determinant(of, of.y[None, of.kept])
    density = DrawnDensity(
        partial(_residuals, of, at_optimum),
        partial(_prior_squares, _prior_centres(of)),
        np.searchsorted(of.kept[:-1], posterior.layout(of.problem).half_normal),
        posterior.log_odds_of_absence(of.problem, inflation)[of.kept],
        inflation,
        partial(_completed, of, at_optimum, rng),
    )
    weighted = residual_draws(density, first, draws, rng, report, _ROUNDS)
    each = 1 + of.swing.size
    evaluations = each * (1 + first.shape[0]) + (1 + each) * weighted.y.shape[0]
    return ConditionalDraws(weighted, evaluations)


def _partition(found: Optimum, inflation: float) -> _Partition:
    problem, state = found.problem, found.state
    where = posterior.layout(problem)
    curved = np.concatenate(
        [
            np.union1d(where.bridge, where.half_normal),
            [where.wheelbase],
            np.arange(where.delays.start, where.delays.stop),
        ]
    )
    kept = np.append(curved, place_of_offset(problem))
    swing = np.arange(where.swing.start, where.swing.stop)
    linear = np.setdiff1d(np.arange(state.y.size), np.concatenate([kept, swing]))
    rows = compliances.without_priors(problem, state.residual.size, curved)
    jacobian = state.jacobian[rows]
    # The whole trajectory follows one coefficient, and its other coordinates are relative to it.
    of_kept = jacobian[:, kept]
    of_kept[:, -1] = jacobian[:, where.trajectory].sum(axis=1)
    explained = jacobian[:, np.concatenate([linear, swing])]
    follow = np.linalg.lstsq(explained, -of_kept, rcond=None)[0][: linear.size]
    effects = jacobian[:, linear]
    basis, root = np.linalg.qr(effects)
    y = state.y.copy()
    y[swing] = 0.0
    return _Partition(
        problem,
        y,
        inflation,
        kept,
        linear,
        swing,
        rows,
        effects,
        basis,
        root,
        np.asarray(follow),
    )


def _prior_centres(of: _Partition) -> FloatArray:
    """Return the centres (n,) of the priors of the kept coordinates (`posterior.all_rows`)."""
    return np.asarray(np.pad(of.problem.noise_slope, (0, of.y.size))[of.kept[:-1]])


def _prior_squares(centres: FloatArray, drawn: FloatArray) -> FloatArray:
    """Return the squares (k,) of the priors at points (k, n + 1), the offset without any."""
    return np.asarray(np.sum((drawn[:, :-1] - centres) ** 2, axis=1))


def _followed(of: _Partition, drawn: FloatArray) -> FloatArray:
    """Return points y (k, f) whose linear coordinates follow points (k, n + 1); no vibration."""
    moves = drawn - of.y[of.kept]
    points = np.repeat(of.y[None, :], drawn.shape[0], axis=0)
    points[:, posterior.layout(of.problem).trajectory] += moves[:, -1:]
    points[:, of.kept[:-1]] = drawn[:, :-1]
    points[:, of.linear] += moves @ of.follow.T
    return points


def _rows(of: _Partition, points: FloatArray) -> FloatArray:
    return np.asarray(posterior.all_rows(of.problem, points)[:, of.rows])


def _waves(of: _Partition, points: FloatArray, residuals: FloatArray) -> FloatArray:
    """Return the effects (k, m, w) of the vibration at points (k, f) with these residuals."""
    waves = np.empty((*residuals.shape, of.swing.size))
    for number, place in enumerate(of.swing):
        moved = points.copy()
        moved[:, place] += 1.0
        waves[:, :, number] = _rows(of, moved) - residuals
    return waves


def _integrated(of: _Partition, residual: FloatArray, waves: FloatArray) -> _Integrated:
    """Integrate the linear coordinates out of the residuals (m,) of one point.

    `waves` (m, w) are the effects of the vibration there.
    """
    unexplained = np.column_stack([residual, waves])
    unexplained -= of.basis @ (of.basis.T @ unexplained)
    basis, root = np.linalg.qr(unexplained[:, 1:])
    along = basis.T @ unexplained[:, 0]
    return _Integrated(
        unexplained[:, 0] - basis @ along,
        2.0 * float(np.sum(np.log(np.abs(np.diag(root))))),
        root,
        -solve_triangular(root, along),
    )


def _log_determinant(of: _Partition, drawn: FloatArray) -> float:
    points = _followed(of, drawn)
    residuals = _rows(of, points)
    return _integrated(of, residuals[0], _waves(of, points, residuals)[0]).log_determinant


def _with_determinant(of: _Partition, one: _Integrated, at_optimum: float) -> FloatArray:
    """Return the residuals (m + 1,) whose squares include the determinant."""
    excess = of.inflation**2 * (one.log_determinant - at_optimum)
    return np.append(one.residual, np.sqrt(max(_LEVEL**2 + excess, 0.0)))


def _residuals(of: _Partition, at_optimum: float, drawn: FloatArray) -> FloatArray:
    """Return residuals (m + 1, k) at points (k, n + 1), all other coordinates integrated out."""
    points = _followed(of, drawn)
    residuals = _rows(of, points)
    waves = _waves(of, points, residuals)
    out = np.full((of.rows.size + 1, drawn.shape[0]), np.nan)
    for k in np.flatnonzero(_are_finite(residuals, waves)):
        out[:, k] = _with_determinant(of, _integrated(of, residuals[k], waves[k]), at_optimum)
    return out


def _completed(
    of: _Partition, at_optimum: float, rng: np.random.Generator, drawn: FloatArray
) -> CompletedDraws:
    """Return draws (k, n + 1) with all linear coordinates drawn given these."""
    points = _followed(of, drawn)
    residuals = _rows(of, points)
    waves = _waves(of, points, residuals)
    out = np.full((of.rows.size + 1, drawn.shape[0]), np.nan)
    squares = np.full(drawn.shape[0], np.nan)
    normal = rng.standard_normal((drawn.shape[0], of.swing.size + of.linear.size))
    for k in np.flatnonzero(_are_finite(residuals, waves)):
        one = _integrated(of, residuals[k], waves[k])
        of_swing, of_linear = np.split(normal[k], [of.swing.size])
        swing = one.swing + of.inflation * solve_triangular(one.root, of_swing)
        left = of.effects.T @ (residuals[k] + waves[k] @ swing)
        linear = of.inflation * solve_triangular(of.root, of_linear)
        points[k, of.swing] = swing
        points[k, of.linear] += linear - cho_solve((of.root, False), left)
        out[:, k] = _with_determinant(of, one, at_optimum)
        # The density of the completion: its determinant, and the squares of its normal.
        squares[k] = of.inflation**2 * (one.log_determinant - normal[k] @ normal[k])
    return CompletedDraws(out, points, squares + np.sum(_rows(of, points) ** 2, axis=1))


def _are_finite(residuals: FloatArray, waves: FloatArray) -> NDArray[np.bool_]:
    return np.asarray(np.isfinite(residuals).all(axis=1) & np.isfinite(waves).all(axis=(1, 2)))
