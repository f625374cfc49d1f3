"""Cramér-Rao bound of one crossing: derivatives of all residuals at a given point.

The inverse of J'J, with J this Jacobian at the truth and all nuisances free, is the Cramér-Rao
bound including the priors.
"""

import numpy as np
from numpy.typing import NDArray

from pre_core.crossing import posterior

FloatArray = NDArray[np.float64]

DIFFERENCE = 1e-4
"""Step of a central difference in the posterior's coordinates: multiples of a prior's spread, and
metres of the trajectory. Halving it changes every bound by less than 0.1 %."""
_NUISANCE_STEPS = 20
"""Limit of steps; `_ENOUGH` usually ends the search earlier."""
_ENOUGH = 0.01
"""Gain in the sum of squares, whose standard deviation is tens, that ends the search."""


def central_jacobian(
    problem: posterior.PosteriorProblem,
    y: FloatArray,
    columns: NDArray[np.int64],
    step: float = DIFFERENCE,
) -> FloatArray:
    """Return derivatives (rows, columns) of all residuals at y (size,) by central differences.

    For coordinates that must not be negative both points are moved up so that none is below zero.
    """
    begin = y[columns] - step
    bounded = np.isin(columns, posterior.layout(problem).half_normal)
    begin[bounded] = np.maximum(begin[bounded], 0.0)
    moved = np.repeat(y[None, :], 2 * columns.size, axis=0)
    moved[np.arange(columns.size), columns] = begin + 2.0 * step
    moved[columns.size + np.arange(columns.size), columns] = begin
    values = posterior.all_rows(problem, moved)
    return np.asarray((values[: columns.size] - values[columns.size :]).T / (2.0 * step))


def optimise_subset(
    problem: posterior.PosteriorProblem,
    y: FloatArray,
    columns: NDArray[np.int64],
    steps: int = _NUISANCE_STEPS,
) -> FloatArray:
    """Return the best y (size,) in these columns, the others fixed: damped Gauss-Newton."""
    rows = posterior.all_rows(problem, y[None, :])[0]
    for _ in range(steps):
        jacobian = central_jacobian(problem, y, columns)
        move = np.linalg.lstsq(jacobian, -rows, rcond=None)[0]
        for share in (1.0, 0.5, 0.25, 0.1, 0.02):
            tried = y.copy()
            tried[columns] += share * move
            new = posterior.all_rows(problem, tried[None, :])[0]
            if np.all(np.isfinite(new)) and new @ new < rows @ rows:
                break
        else:
            return y
        is_there = rows @ rows - new @ new < _ENOUGH
        y, rows = tried, new
        if is_there:
            return y
    return y
