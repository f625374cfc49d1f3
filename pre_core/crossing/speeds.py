"""How far a receiver's speeds are from those that a fit drives."""

import numpy as np
from numpy.typing import NDArray

from pre_core.crossing.posterior import Problem, layout

FloatArray = NDArray[np.float64]


def speed_bias(problem: Problem, y: FloatArray) -> float:
    """Return how far the receiver's speeds are above those of y (size,), on average.

    In multiples of the noise of one speed.
    """
    where, rows = layout(problem), problem.receiver_rows
    left = problem.receiver_values - rows @ y[where.trajectory.start : where.offset + 1]
    # The offset is in the rows of the positions and in its own, the last; speeds follow positions.
    fixes = int(np.count_nonzero(rows[:, -1])) - 1
    return problem.crossing.direction * float(np.mean(left[fixes : 2 * fixes]))
