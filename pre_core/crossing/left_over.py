"""What a crossing's fit leaves over, from its signals and what was found: no search.

A result keeps truck, bridge and shift along the road, and not the sixty unknowns of trajectory,
sensors and swing. About what was found these are nearly linear: a few steps of least squares bring
them back, and with them the white rows that chi2 is of.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pre_core.crossing.optimum import chi2_per_dof
from pre_core.crossing.posterior import Problem, all_rows, data_rows, layout
from pre_core.crossing.preparation import (
    Inputs,
    in_spreads,
    levels_at,
    prepare,
    rear_at_rows_m,
    with_noise_at,
)
from pre_core.crossing.whitening import DOUBTED_OF_A_MISFIT, RESIDUALS, linear_springs
from pre_core.physics.bridge import FloatArray
from pre_core.search.levenberg_marquardt import minimised

BEFORE, ON, AFTER = range(3)
_STEPS, _ENOUGH = 25, 0.1
_ROUNDS = 2
"""The second is for the noise, which is told at what the first has found."""


class Found(NamedTuple):
    """What is known of a crossing from its result."""

    theta: FloatArray
    """(p,) in the order of `pre_core.unknowns`; nothing where a value is unknown."""
    shift_m: float
    """The receiver's slow error."""
    differs: bool
    """Whether the axles' roads were taken to differ."""
    believes: bool
    """Whether the truck's springs were believed whole."""


class LeftOver(NamedTuple):
    """The white rows at the bottom beside a result."""

    white: FloatArray
    """(m, 3): mismatch of the roads, front and rear body equation, of unit variance."""
    stretch: NDArray[np.int64]
    """(m,) whether a row compares the roads `BEFORE`, `ON` or `AFTER` the bridge."""
    step_s: float
    """Between rows."""
    chi2_per_dof: float
    """That of the result, if signals and site file are those that it was found from."""


def left_over(inputs: Inputs, found: Found) -> LeftOver:
    """The rows that the fit of a crossing leaves over, against the noise that is declared."""
    problem, y = prepare(inputs)
    y = _coordinates(problem, y, found)
    for _ in range(_ROUNDS):
        problem = with_noise_at(
            problem,
            y,
            linear_springs() if found.believes else None,
            DOUBTED_OF_A_MISFIT,
            levels_at(problem, y) if found.differs else None,
        )
        y = _bottom(problem, y)
    white = data_rows(problem, y[None, :])[0].reshape(-1, RESIDUALS)
    rows = problem.rows
    return LeftOver(
        white,
        _stretches(problem, y),
        rows.every * rows.step_s,
        chi2_per_dof(problem, y),
    )


def _coordinates(problem: Problem, y: FloatArray, found: Found) -> FloatArray:
    """y (size,) with what was found in it, all else as it was."""
    where, priors = layout(problem), problem.priors
    y = y.copy()
    y[where.theta] = in_spreads(priors, found.theta)
    y[where.offset] = found.shift_m
    y[where.trajectory] -= found.shift_m
    return y


def _bottom(problem: Problem, y: FloatArray) -> FloatArray:
    lower = np.full(y.size, -np.inf)
    lower[layout(problem).half_normal] = 0.0
    return minimised(lambda at: all_rows(problem, at), y, _STEPS, _ENOUGH, lower).state.y


def _stretches(problem: Problem, y: FloatArray) -> NDArray[np.int64]:
    """By where the rear axle is at the middle of each row (m,)."""
    crossing, middle = problem.crossing, rear_at_rows_m(problem, y)
    travelled = middle if crossing.direction > 0 else crossing.span_m - middle
    stretch = np.where(travelled < 0.0, BEFORE, np.where(travelled > crossing.span_m, AFTER, ON))
    return stretch.astype(np.int64)
