"""Residuals of a crossing with its nuisances integrated out: truck, trajectory, sensors.

The residuals determine the nuisances so exactly that weighted draws of all coordinates would have
negligible weights; given the bridge, the nuisances are normal. So residuals are evaluated with
nuisances that follow the bridge, and the part that nuisances explain is projected out. The
nuisances follow the bridge linearly and, on demand, by a Gauss-Newton step for each bridge. Without
this step, a bridge metres from the optimum's offset could move the truck to where its residuals are
not linear, and fit better than any other.

The vibration before the crossing is a wave of the bridge's own frequency, which moves with the
bridge: removed at the frequency of the optimum it would leave, or take, a wave in the residuals of
any other bridge. So it is treated as noise here: a mixture of its waves on the bridges at many
points.

A truck that follows a bridge far from the optimum also changes the expected squares of the noise
(`expected_squares`). The priors contain their tangent; the deviation from it is one more residual.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from pre_core.arrays import FloatArray
from pre_core.crossing import posterior
from pre_core.crossing.expected_squares import ExpectedSquares, expected_squares
from pre_core.crossing.fit import Optimum
from pre_core.crossing.posterior import PosteriorProblem

_SWINGING = 40
"""Number of points whose waves of the initial vibration are computed for their mixture."""
_LEAST_WAVE = 0.03
"""Smallest wave that is kept, in standard deviations of a residual."""
_LEVEL = 10.0
"""Residual that stands for the expected squares at the optimum: half its square is the largest
excess above their tangent that counts. A far smaller residual would be nonlinear where the squares
are below the tangent; with a far larger one, relevant curvature would be below the least that
fusion keeps."""


class ResidualParts(NamedTuple):
    """Coordinates and residuals of a crossing that remain when its nuisances are integrated out."""

    curved: NDArray[np.int64]
    """Indices (n,) in y of the coordinates whose effect is not linear, without the offset."""
    linear: NDArray[np.int64]
    """Indices (t,) of coordinates that are not integrated out and have linear effects."""
    rows: NDArray[np.int64]
    """Indices (m,) of the residuals, without the priors of `curved` and `linear` coordinates."""
    waves: FloatArray
    """Effects (m, q) of waves of the mismatch that are not integrated out."""
    wave_precision: FloatArray
    """Prior precision (q, q) of their coefficients."""


class Nuisances(NamedTuple):
    """Nuisance coordinates of a crossing, which follow its curved coordinates and offset (n + 1,).

    Residuals (m + r + 1,) include r priors of the mixture of initial vibrations, and the expected
    squares of the noise.
    """

    problem: PosteriorProblem
    parts: ResidualParts
    y: FloatArray
    """The optimum (f,), without initial vibration."""
    kept: NDArray[np.int64]
    """Indices (n + 1,) in y of the curved coordinates and of the offset."""
    own: NDArray[np.int64]
    """Indices (s,) of the nuisances in y."""
    of_own: FloatArray  # (s, n + 1) derivatives of the nuisances with respect to `kept`
    of_linear: FloatArray  # (t, n + 1) derivatives of the linear coordinates likewise
    basis: FloatArray
    """Orthonormal columns (m + r + 1, s + r) that span all effects of nuisances and mixture."""
    step: FloatArray
    """Factors (s, m + r + 1) from residuals to the nuisances' Gauss-Newton step, in which mixture,
    linear coordinates and waves are free, too."""
    expected: ExpectedSquares
    evaluations: int
    """Number of evaluations that the nuisances took."""

    @property
    def mixture_size(self) -> int:
        """The number r of waves of the mixture."""
        return self.basis.shape[1] - self.own.size


def index_of_offset(problem: PosteriorProblem) -> int:
    """Return the index in y of the coefficient that stands for the whole trajectory's offset."""
    where = posterior.layout(problem)
    return (where.trajectory.start + where.trajectory.stop) // 2


def nuisances_of(
    found: Optimum,
    problem: PosteriorProblem,
    jacobian: FloatArray,
    parts: ResidualParts,
    drawn: FloatArray,
) -> Nuisances:
    """Return the nuisances of a crossing about its optimum.

    The noise of `problem` may differ from the optimum's; `jacobian` (rows, f) is that of its
    residuals there, in the coordinates y. `drawn` (k, n + 1) are points of the curved coordinates
    and the offset, for the mixture.
    """
    where = posterior.layout(problem)
    y = found.state.y.copy()
    swing = np.arange(where.swing.start, where.swing.stop)
    y[swing] = 0.0
    jacobian = jacobian[parts.rows]
    # The whole trajectory follows one coefficient, and its other coordinates are relative to it.
    kept = np.append(parts.curved, index_of_offset(problem))
    jacobian[:, kept[-1]] = jacobian[:, where.trajectory].sum(axis=1)
    own = np.setdiff1d(np.arange(y.size), np.concatenate([kept, parts.linear, swing]))
    swinging = np.repeat(y[None, :], min(_SWINGING, drawn.shape[0]), axis=0)
    every = drawn.shape[0] // swinging.shape[0]
    swinging[:, parts.curved] = drawn[::every, :-1][: swinging.shape[0]]
    mixture = _swing_waves(problem, swinging, parts.rows)
    r = mixture.shape[1]
    effects = np.hstack(
        [with_mixture(jacobian[:, own], r), np.vstack([mixture, np.eye(r), np.zeros((1, r))])]
    )
    linear, waves = with_mixture(jacobian[:, parts.linear], r), with_mixture(parts.waves, r)
    steps = _steps((effects, linear, waves), parts.wave_precision)
    follow = steps @ with_mixture(jacobian[:, kept], r)
    s, begin = own.size, effects.shape[1]
    return Nuisances(
        problem,
        parts,
        y,
        kept,
        own,
        follow[:s],
        follow[begin : begin + linear.shape[1]],
        np.linalg.qr(effects)[0],
        steps[:s],
        expected_squares(found.problem, found.state.y),
        (1 + swing.size) * swinging.shape[0],
    )


def with_mixture(columns: FloatArray, size: int) -> FloatArray:
    """Return columns (m + size + 1, n): `columns` (m, n) and zeros for mixture and squares.

    `size` is the number of priors of the mixture; the last row is that of the expected squares.
    """
    return np.vstack([columns, np.zeros((size + 1, columns.shape[1]))])


def unexplained(nuisances: Nuisances, columns: FloatArray) -> FloatArray:
    """Return the part of columns (m + r + 1, n) that no nuisance explains."""
    return np.asarray(columns - nuisances.basis @ (nuisances.basis.T @ columns))


def integrated_residuals(nuisances: Nuisances, drawn: FloatArray, *, has_step: bool) -> FloatArray:
    """Return residuals (m + r + 1, k) at points (k, n + 1), with nuisances integrated out.

    Each point takes an evaluation, and another one if it `has_step` of its own.
    """
    points = followed(nuisances, drawn, has_step=has_step)
    residuals = unexplained(nuisances, _residuals(nuisances, points))
    squares = _LEVEL**2 - 2.0 * nuisances.expected.beyond_tangent(points)
    residuals[-1] = np.sqrt(np.maximum(squares, 0.0))
    return residuals


def followed(nuisances: Nuisances, drawn: FloatArray, *, has_step: bool) -> FloatArray:
    """Return points y (k, f) with the nuisances that follow points (k, n + 1).

    Each takes an evaluation if it `has_step` of its own.
    """
    points, moves = moved(nuisances.problem, nuisances.y, nuisances.kept, drawn)
    points[:, nuisances.own] += moves @ nuisances.of_own.T
    points[:, nuisances.parts.linear] += moves @ nuisances.of_linear.T
    if has_step:
        points[:, nuisances.own] += (nuisances.step @ _residuals(nuisances, points)).T
    return points


def moved(
    problem: PosteriorProblem, y: FloatArray, kept: NDArray[np.int64], drawn: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return points (k, f) with y (f,) at `kept` coordinates (k, n + 1), and the moves of these.

    The offset is last, and moves the whole trajectory.
    """
    moves = drawn - y[kept]
    points = np.repeat(y[None, :], drawn.shape[0], axis=0)
    points[:, kept[:-1]] = drawn[:, :-1]
    points[:, posterior.layout(problem).trajectory] += moves[:, -1:]
    return points, moves


def _residuals(nuisances: Nuisances, points: FloatArray) -> FloatArray:
    """Return residuals (m + r + 1, k) at points y (k, f), without the expected squares."""
    return with_mixture(
        posterior.all_rows(nuisances.problem, points)[:, nuisances.parts.rows].T,
        nuisances.mixture_size,
    )


def _swing_waves(
    problem: PosteriorProblem, points: FloatArray, rows: NDArray[np.int64]
) -> FloatArray:
    """Return waves (m, r) whose covariance is that of the initial vibration at points (n, f)."""
    _, waves = swing_effects(problem, points, rows)
    directions, spread, _ = np.linalg.svd(np.concatenate(waves).T, full_matrices=False)
    spread /= np.sqrt(points.shape[0])
    clear = int((spread > _LEAST_WAVE).sum())
    return np.asarray(directions[:, :clear] * spread[:clear])


def swing_effects(
    problem: PosteriorProblem, points: FloatArray, rows: NDArray[np.int64]
) -> tuple[FloatArray, FloatArray]:
    """Return residuals (k, m) at points (k, f), and the initial vibration's effects (w, k, m)."""
    swing = posterior.layout(problem).swing
    residuals = posterior.all_rows(problem, points)[:, rows]
    effects = []
    for place in range(swing.start, swing.stop):
        swinging = points.copy()
        swinging[:, place] += 1.0
        effects.append(posterior.all_rows(problem, swinging)[:, rows] - residuals)
    return residuals, np.stack(effects)


def _steps(
    parts: tuple[FloatArray, FloatArray, FloatArray], wave_precision: FloatArray
) -> FloatArray:
    """Return the factors (…, m) from residuals to the Gauss-Newton steps of all `parts`.

    The parts are columns (m, …): effects of nuisances, linear coordinates and waves.
    """
    columns = np.hstack(parts)
    begin = parts[0].shape[1]
    end = begin + parts[1].shape[1]
    precision = columns.T @ columns
    precision[np.arange(begin, end), np.arange(begin, end)] += 1.0
    precision[end:, end:] += wave_precision
    return np.asarray(-cho_solve(cho_factor(precision), columns.T))
