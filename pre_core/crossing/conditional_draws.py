"""Posterior draws of a crossing on one profile: a few coordinates first, the others given these.

Of about eighty coordinates those of bridge, wheelbase and delays have effects that are not linear;
badly known supports and rigidities bend the posterior so far that no normal is close to it
(`surrogate`). Given these and one offset, all others (truck, initial states, trajectory, gains and
the bridge's vibration before the crossing) are nearly normal: they are integrated out of the
residuals, whose surface proposes draws (`residual_draws`), and drawn from that normal. Draws are
weighted by the posterior of all coordinates, so that slight nonlinearity costs effective draws, but
no accuracy.

The vibration before the crossing is a wave of the bridge's own frequency. Its effect is computed
for each draw, and so is the determinant of its normal, which distinguishes bridges: without it
elements are off by a standard deviation.
"""

from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_solve, solve_triangular

from pre_core.arrays import FloatArray
from pre_core.crossing import compliances, posterior
from pre_core.crossing.fit import Optimum
from pre_core.crossing.nuisances import index_of_offset, moved, swing_effects
from pre_core.crossing.posterior import PosteriorProblem
from pre_core.crossing.residual_draws import (
    CompletedDraws,
    DrawnDensity,
    prior_centres,
    prior_squares,
    residual_draws,
)
from pre_core.crossing.weighted_draws import WeightedDraws
from pre_core.search.loop import Report

_WIDER = 1.2
"""Noise of the density of the first points, relative to the crossing's."""
_POINTS_PER_TERM = 1.2
"""Number of first points for each term of the surface."""
_ROUNDS = 5
"""Largest number of rounds of `residual_draws`."""
_LEVEL = 10.0
"""Residual that stands for the determinant at the optimum: half its square bounds the log density
that a smaller determinant adds."""


class ConditionalDraws(NamedTuple):
    """Weighted draws (k, f) of all coordinates, and the number of evaluations that they took."""

    weighted: WeightedDraws
    evaluations: int


class _Partition(NamedTuple):
    """Coordinates of an optimum, and the effects of the linear ones there."""

    problem: PosteriorProblem
    y: FloatArray  # (f,) the optimum, without vibration
    inflation: float
    kept: NDArray[np.int64]  # (n + 1,) coordinates that are drawn first, the offset last
    linear: NDArray[np.int64]  # (s,) without vibration
    swing: NDArray[np.int64]  # (w,) vibration before the crossing
    rows: NDArray[np.int64]  # (m,) residuals without the priors of `kept`
    effects: FloatArray  # (m, s) of the linear coordinates
    basis: FloatArray  # (m, s) orthonormal columns of the same span
    root: FloatArray  # (s, s) upper triangle R with R'R = effects' effects
    follow: FloatArray  # (s, n + 1) how the linear coordinates follow the kept ones


class _Integrated(NamedTuple):
    """One point with its linear coordinates integrated out."""

    residual: FloatArray  # (m,) the part that no linear coordinate explains
    log_determinant: float  # of the precision of the vibration
    root: FloatArray  # (w, w) upper triangle of that precision
    swing: FloatArray  # (w,) mean of the vibration


def conditional_draws(
    found: Optimum, draws: int, seed: int, inflation: float, report: Report
) -> ConditionalDraws:
    """Return weighted draws of all coordinates about an optimum without mismatch.

    The noise is `inflation` times the declared one. See `residual_draws` for when they end.
    """
    partition = _partition(found, inflation)
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(1 << 26,)))
    n = partition.kept.size
    count = round(_POINTS_PER_TERM * (n + 1) * (n + 2) / 2)
    first = compliances.present_points(found, count, _WIDER * inflation, seed)[:, partition.kept]
    at_optimum = _points(partition, partition.y[None, partition.kept]).integrated[0].log_determinant
    density = DrawnDensity(
        partial(_residuals, partition, at_optimum),
        partial(prior_squares, prior_centres(found, partition.kept[:-1])),
        np.searchsorted(partition.kept[:-1], posterior.layout(partition.problem).half_normal),
        posterior.log_odds_of_absence(partition.problem, inflation)[partition.kept],
        inflation,
        partial(_completed, partition, at_optimum, rng),
    )
    weighted = residual_draws(density, first, draws, rng, report, _ROUNDS)
    each = 1 + partition.swing.size
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
    kept = np.append(curved, index_of_offset(problem))
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


def _integrated(partition: _Partition, residual: FloatArray, waves: FloatArray) -> _Integrated:
    """Integrate the linear coordinates out of the residuals (m,) of one point.

    `waves` (m, w) are the effects of the vibration there.
    """
    unexplained = np.column_stack([residual, waves])
    unexplained -= partition.basis @ (partition.basis.T @ unexplained)
    basis, root = np.linalg.qr(unexplained[:, 1:])
    along = basis.T @ unexplained[:, 0]
    return _Integrated(
        unexplained[:, 0] - basis @ along,
        2.0 * float(np.sum(np.log(np.abs(np.diag(root))))),
        root,
        -solve_triangular(root, along),
    )


class _IntegratedPoints(NamedTuple):
    """Points with their residuals; `integrated` where these are finite."""

    y: FloatArray  # (k, f) whose linear coordinates follow, without vibration
    residuals: FloatArray  # (k, m)
    waves: FloatArray  # (k, m, w) effects of the vibration
    integrated: dict[int, _Integrated]


def _points(partition: _Partition, drawn: FloatArray) -> _IntegratedPoints:
    """Return the points at kept coordinates (k, n + 1)."""
    y, moves = moved(partition.problem, partition.y, partition.kept, drawn)
    y[:, partition.linear] += moves @ partition.follow.T
    residuals, effects = swing_effects(partition.problem, y, partition.rows)
    waves = np.moveaxis(effects, 0, 2)
    are_finite = np.isfinite(residuals).all(axis=1) & np.isfinite(waves).all(axis=(1, 2))
    integrated = {
        int(k): _integrated(partition, residuals[k], waves[k]) for k in np.flatnonzero(are_finite)
    }
    return _IntegratedPoints(y, residuals, waves, integrated)


def _with_determinant(
    partition: _Partition, at_optimum: float, points: _IntegratedPoints
) -> FloatArray:
    """Return residuals (m + 1, k) whose squares include the determinant."""
    out = np.full((partition.rows.size + 1, points.y.shape[0]), np.nan)
    for k, one in points.integrated.items():
        excess = partition.inflation**2 * (one.log_determinant - at_optimum)
        out[:, k] = np.append(one.residual, np.sqrt(max(_LEVEL**2 + excess, 0.0)))
    return out


def _residuals(partition: _Partition, at_optimum: float, drawn: FloatArray) -> FloatArray:
    """Return residuals (m + 1, k) at points (k, n + 1), all other coordinates integrated out."""
    return _with_determinant(partition, at_optimum, _points(partition, drawn))


def _completed(
    partition: _Partition, at_optimum: float, rng: np.random.Generator, drawn: FloatArray
) -> CompletedDraws:
    """Return draws (k, n + 1) with all linear coordinates drawn given these."""
    points = _points(partition, drawn)
    y, squares = points.y, np.full(drawn.shape[0], np.nan)
    normal = rng.standard_normal((drawn.shape[0], partition.swing.size + partition.linear.size))
    for k, one in points.integrated.items():
        of_swing, of_linear = np.split(normal[k], [partition.swing.size])
        swing = one.swing + partition.inflation * solve_triangular(one.root, of_swing)
        left = partition.effects.T @ (points.residuals[k] + points.waves[k] @ swing)
        linear = partition.inflation * solve_triangular(partition.root, of_linear)
        y[k, partition.swing] = swing
        y[k, partition.linear] += linear - cho_solve((partition.root, False), left)
        # The density of the completion: its determinant, and the squares of its normal.
        squares[k] = partition.inflation**2 * (one.log_determinant - normal[k] @ normal[k])
    squares += np.sum(posterior.all_rows(partition.problem, y)[:, partition.rows] ** 2, axis=1)
    return CompletedDraws(_with_determinant(partition, at_optimum, points), y, squares)
