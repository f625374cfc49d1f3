"""Location of a misfit: on the bridge, or in the truck and its road."""

from typing import NamedTuple

import numpy as np

from pre_core.arrays import FloatArray
from pre_core.crossing.fit import Optimum, chi2_stride, evaluations_of
from pre_core.crossing.off_bridge import levels_at, off_bridge_residuals
from pre_core.crossing.posterior import PosteriorProblem, all_rows, layout
from pre_core.crossing.preparation import update_noise
from pre_core.crossing.rows import RESIDUALS
from pre_core.search.levenberg_marquardt import minimise

EXPLAINED_CHI2 = 1.5
"""Value of `OffBridgeFit.chi2` up to which truck and road are explained. Where another vehicle, a
wrong span or an undeclared support acted on the bridge it was 1.0. With full weight of the
body equations and one profile it was 25 or more where springs or profiles of fault-free
crossings needed another model."""
_MAX_REPEATS, _CLEARLY_LESS = 4, 0.8
"""Largest number of repeated fits, and the chi2 relative to the previous fit's that each must
reach."""
_MAX_REPEATED_CHI2 = 500.0
"""Value of `OffBridgeFit.chi2` above which the noise of another truck explains nothing."""
_STEPS, _IMPROVEMENT = 12, 10.0
"""Limit of steps, and the improvement of the sum of squares that ends the fit, whose chi2 is judged
coarsely."""


class OffBridgeFit(NamedTuple):
    """A fit to the residuals off the bridge alone, where neither bridge nor other vehicles act."""

    y: FloatArray
    chi2: float
    """Sum of squares of these residuals per degree of freedom; infinite if there are none."""
    evaluations: int


def fit_off_bridge(found: Optimum) -> OffBridgeFit:
    """Return the fit of truck and trajectory to the residuals off the bridge, from an optimum.

    The truck of a wrong bridge is a wrong one, and so is the noise that it transmits: the fit is
    repeated with the noise of its own truck as long as this explains clearly more, and from the
    nominal truck if it explains too little.
    """
    problem = found.problem
    best = _fit_with_own_noise(problem, found.state.y)
    if best.chi2 <= EXPLAINED_CHI2 or not np.isfinite(best.chi2):
        return best
    nominal = np.zeros_like(found.state.y)
    trajectory = layout(problem).trajectory
    nominal[trajectory] = found.state.y[trajectory]
    other = _fit_with_own_noise(update_noise(problem, nominal, problem.force), nominal)
    evaluations = best.evaluations + other.evaluations
    return min(best, other, key=lambda fit: fit.chi2)._replace(evaluations=evaluations)


def _fit_with_own_noise(problem: PosteriorProblem, y: FloatArray) -> OffBridgeFit:
    """Return the fit from y (f,), repeated with the noise of its own truck."""
    best = _fit_once(problem, y)
    evaluations = best.evaluations
    for _ in range(_MAX_REPEATS):
        if not EXPLAINED_CHI2 < best.chi2 <= _MAX_REPEATED_CHI2:
            break
        problem = update_noise(problem, best.y, problem.force)
        again = _fit_once(problem, best.y)
        evaluations += again.evaluations
        if again.chi2 > _CLEARLY_LESS * best.chi2:
            break
        best = again
    return best._replace(evaluations=evaluations)


def _fit_once(problem: PosteriorProblem, y: FloatArray) -> OffBridgeFit:
    """Return the fit from y (f,) with the noise of the problem."""
    count = problem.noise.reciprocal.size
    is_off = np.zeros(count // RESIDUALS, dtype=np.bool_)
    for one in off_bridge_residuals(problem, y):
        is_off[one] = True
    if not is_off.any():
        return OffBridgeFit(y, np.inf, 0)
    data = np.flatnonzero(np.repeat(is_off, RESIDUALS))
    free = np.delete(np.eye(y.size), layout(problem).bridge, axis=1)

    def rows(v: FloatArray) -> FloatArray:
        values = all_rows(problem, y + v @ free.T)
        return np.concatenate([values[:, data], values[:, count:]], axis=1)

    there = minimise(rows, np.zeros(free.shape[1]), _STEPS, _IMPROVEMENT, uses_broyden=True)
    stride = chi2_stride(problem)
    white = there.state.residual[: data.size : stride]
    chi2 = float(white @ white) / max(1.0, white.size - free.shape[1] / stride)
    return OffBridgeFit(y + free @ there.state.y, chi2, evaluations_of(there))


def is_explained_off_bridge(problem: PosteriorProblem, fit: OffBridgeFit) -> bool:
    """Return whether a linear truck on one profile explains the residuals off the bridge."""
    return fit.chi2 <= EXPLAINED_CHI2 and not levels_at(problem, fit.y).any()
