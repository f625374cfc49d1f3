"""Least squares on the paper's residual: Levenberg-Marquardt in logarithms of the parameters.

Without noise the objective is benign (studies/reproduction.md): from anywhere in the paper's prior
about ten steps lead to its only minimum. All parameters are positive, so the search coordinates are
logarithms and need no bounds, except that d_1 must lie between the axles: its coordinate is a
logit.
"""

from typing import NamedTuple

import numpy as np

from pre_core.arrays import FloatArray, IntArray
from pre_core.paper.residual import Workspace, residual_batch
from pre_core.paper.window import PaperWindow
from pre_core.parameters import D_1
from pre_core.search import levenberg_marquardt
from pre_core.search.levenberg_marquardt import (
    LMInfo,
    LMState,
    Rows,
    descend,
    initial_state,
    polish,
)

MAX_STEPS = 60
"""Limit of steps; without noise ten to fifteen reach the minimum (studies/reproduction.md)."""


class LeastSquaresProblem(NamedTuple):
    """The constants of a search: data, fixed values, and the indices of the free parameters."""

    window: PaperWindow
    fixed: FloatArray  # (p,) values of the fixed parameters
    free: IntArray  # (f,)


def transform(problem: LeastSquaresProblem, values: FloatArray) -> FloatArray:
    """Return the search coordinates (…, f) of free parameters given in physical units."""
    y = np.log(values)
    at = np.flatnonzero(problem.free == D_1)
    d_1 = values[..., at]
    y[..., at] = np.log(d_1 / (problem.window.wheelbase_m - d_1))
    return np.asarray(y)


def untransform(problem: LeastSquaresProblem, y: FloatArray) -> FloatArray:
    """Return the free parameters (…, f), in physical units, for search coordinates (…, f)."""
    values = np.exp(y)
    at = np.flatnonzero(problem.free == D_1)
    values[..., at] = problem.window.wheelbase_m / (1.0 + np.exp(-y[..., at]))
    return np.asarray(values)


def full_vector(problem: LeastSquaresProblem, y: FloatArray) -> FloatArray:
    """Return all parameters (…, p) in physical units for search coordinates (…, f)."""
    theta = np.broadcast_to(problem.fixed, (*y.shape[:-1], problem.fixed.size)).copy()
    theta[..., problem.free] = untransform(problem, y)
    return theta


def _derivative_of_values(problem: LeastSquaresProblem, y: FloatArray) -> FloatArray:
    """Return d value/d y (f,) at y, to convert a covariance to physical units."""
    values = untransform(problem, y)
    slope = values.copy()
    at = np.flatnonzero(problem.free == D_1)
    slope[at] = values[at] * (1.0 - values[at] / problem.window.wheelbase_m)
    return slope


def _rows_of(problem: LeastSquaresProblem, work: Workspace) -> Rows:
    return lambda y: residual_batch(problem.window, work, full_vector(problem, y))


def init(problem: LeastSquaresProblem, work: Workspace, start: FloatArray) -> LMState:
    """Return the state at the free parameters `start` (f,) in physical units."""
    return initial_state(_rows_of(problem, work), transform(problem, start))


def step(problem: LeastSquaresProblem, work: Workspace, state: LMState) -> tuple[LMState, LMInfo]:
    """Take one step on the paper's residual; at the end, central differences replace forward ones.

    The search then costs no more than necessary, and its end does not depend on the processor.
    """
    return polish(_rows_of(problem, work), *descend(_rows_of(problem, work), state))


def formal_covariance(problem: LeastSquaresProblem, work: Workspace, y: FloatArray) -> FloatArray:
    """Return the formal covariance (f, f) of the free parameters, in physical units, at y (f,)."""
    slope = _derivative_of_values(problem, y)
    in_logarithms = levenberg_marquardt.gauss_newton_covariance(_rows_of(problem, work), y)
    return np.asarray(in_logarithms * np.outer(slope, slope))
