"""The residuals of a crossing's fit, from its signals and its result, without a search.

A result contains truck, bridge and longitudinal offset, but not the sixty coordinates of
trajectory, sensors and initial vibration. About the estimate these are nearly linear: a few steps
of least squares restore them, and the whitened residuals of chi2.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pre_core.arrays import FloatArray
from pre_core.crossing.fit import chi2_per_dof
from pre_core.crossing.noise import FRICTION_STATISTIC_OF_MISFIT, no_suspension_noise
from pre_core.crossing.off_bridge import levels_at, rear_axle_chainage_m
from pre_core.crossing.posterior import PosteriorProblem, all_rows, data_rows, layout
from pre_core.crossing.preparation import (
    CrossingInputs,
    build_problem,
    to_standardised,
    update_noise,
    with_lines_of,
)
from pre_core.crossing.rows import RESIDUALS
from pre_core.search.levenberg_marquardt import minimise

BEFORE, ON, AFTER = range(3)
_STEPS, _ENOUGH = 25, 0.1
_ROUNDS = 2
"""Number of fits; the second uses the noise at the first one."""


class FittedValues(NamedTuple):
    """The values of a crossing in its result."""

    theta: FloatArray
    """Parameters (p,) in the order of `pre_core.parameters`; nominal where a value is unknown."""
    shift_m: float
    """Longitudinal offset of the truck's positions, the slow error of the receiver."""
    has_mismatch: bool
    """Whether the fit modelled profile mismatch."""
    uses_suspension: bool
    """Whether the body equations had their full weight."""
    lines_hz: tuple[float, ...] = ()
    """Frequencies of the removed hum."""


class FittedResiduals(NamedTuple):
    """The whitened residuals at the minimum of a result."""

    white: FloatArray
    """Residuals (m, 3): mismatch, front and rear body equation, of unit variance."""
    segment: NDArray[np.int64]
    """Label (m,) of residuals `BEFORE`, `ON` or `AFTER` the bridge."""
    step_s: float
    """Time between residuals."""
    chi2_per_dof: float
    """Reduced chi-square, that of the result for the same signals and site file."""


def fitted_residuals(inputs: CrossingInputs, found: FittedValues) -> FittedResiduals:
    """Return the residuals of a crossing's fit relative to the declared noise."""
    problem, y = build_problem(inputs)
    y = _coordinates(problem, y, found)
    problem = with_lines_of(problem, y, found.lines_hz)
    for _ in range(_ROUNDS):
        problem = update_noise(
            problem,
            y,
            no_suspension_noise() if found.uses_suspension else None,
            FRICTION_STATISTIC_OF_MISFIT,
            levels_at(problem, y) if found.has_mismatch else None,
        )
        y = _minimum(problem, y)
    white = data_rows(problem, y[None, :])[0].reshape(-1, RESIDUALS)
    rows = problem.rows
    return FittedResiduals(
        white,
        _segment_labels(problem, y),
        rows.every * rows.step_s,
        chi2_per_dof(problem, y),
    )


def _coordinates(problem: PosteriorProblem, y: FloatArray, found: FittedValues) -> FloatArray:
    """Return y (f,) with the estimated values, other coordinates unchanged."""
    where, priors = layout(problem), problem.priors
    y = y.copy()
    y[where.theta] = to_standardised(priors, found.theta)
    y[where.offset] = found.shift_m
    y[where.trajectory] -= found.shift_m
    return y


def _minimum(problem: PosteriorProblem, y: FloatArray) -> FloatArray:
    lower = np.full(y.size, -np.inf)
    lower[layout(problem).half_normal] = 0.0
    return minimise(lambda at: all_rows(problem, at), y, _STEPS, _ENOUGH, lower).state.y


def _segment_labels(problem: PosteriorProblem, y: FloatArray) -> NDArray[np.int64]:
    """Return the labels (m,) by the rear axle's place at the middle of each residual."""
    crossing, middle = problem.crossing, rear_axle_chainage_m(problem, y)
    travelled = middle if crossing.direction > 0 else crossing.span_m - middle
    stretch = np.where(travelled < 0.0, BEFORE, np.where(travelled > crossing.span_m, AFTER, ON))
    return stretch.astype(np.int64)
