"""Deviation of a receiver's speeds from those of a fit."""

import numpy as np

from pre_core.arrays import FloatArray
from pre_core.crossing.posterior import PosteriorProblem, layout


def speed_bias(problem: PosteriorProblem, y: FloatArray) -> float:
    """Return the mean excess of the receiver's speeds over those of y (f,).

    The unit is the standard deviation of one speed.
    """
    where, rows = layout(problem), problem.receiver_rows
    left = problem.receiver_values - rows @ y[where.trajectory.start : where.offset + 1]
    # Rows with the offset are those of the positions and its prior, the last; speeds come second.
    fixes = int(np.count_nonzero(rows[:, -1])) - 1
    return problem.crossing.direction * float(np.mean(left[fixes : 2 * fixes]))
