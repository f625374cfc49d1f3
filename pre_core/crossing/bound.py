"""How well one crossing can be known: derivatives of all rows of the posterior at a given point.

The inverse of J'J, of which J is this Jacobian at the truth with all nuisances free, is the
Cramér-Rao bound with the priors in it.
"""

import numpy as np
from numpy.typing import NDArray

from pre_core.crossing import posterior

FloatArray = NDArray[np.float64]

DIFFERENCE = 1e-4
"""The step of a central difference, in the coordinates of the posterior: multiples of a prior's
spread, and metres of the trajectory. Halving it moves no bound by a thousandth of itself."""
_NUISANCE_STEPS = 20
"""The most steps; `_ENOUGH` ends the way sooner as a rule."""
_ENOUGH = 0.01
"""A gain in the sum of squares, whose standard deviation is tens, that is no step."""


def central_jacobian(
    problem: posterior.Problem, y: FloatArray, columns: NDArray[np.int64], step: float = DIFFERENCE
) -> FloatArray:
    """Derivatives (rows, columns) of all rows at y by central differences.

    What must not be negative, and for which there may be no model then, is not made so: at zero
    both points of the difference lie above.
    """
    begin = y[columns] - step
    bounded = np.isin(columns, posterior.layout(problem).half_normal)
    begin[bounded] = np.maximum(begin[bounded], 0.0)
    moved = np.repeat(y[None, :], 2 * columns.size, axis=0)
    moved[np.arange(columns.size), columns] = begin + 2.0 * step
    moved[columns.size + np.arange(columns.size), columns] = begin
    values = posterior.all_rows(problem, moved)
    return np.asarray((values[: columns.size] - values[columns.size :]).T / (2.0 * step))


def settle(
    problem: posterior.Problem,
    y: FloatArray,
    columns: NDArray[np.int64],
    steps: int = _NUISANCE_STEPS,
) -> FloatArray:
    """The best y in these columns alone, the others held: Gauss-Newton with halved steps."""
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
