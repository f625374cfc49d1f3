"""Least squares on the paper's residual: Levenberg-Marquardt in logarithms of the unknowns.

Without noise the surface is benign (docs/reproduction.md): from anywhere in the paper's prior about
ten steps lead to the one minimum. All unknowns are positive, so the search moves in logarithms and
needs no bounds, except that d_1 must lie between the axles: there it moves in the logit.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import qr, solve_triangular

from pre_core.parameters import D_1
from pre_core.residual import Window, Workspace, residual_batch
from pre_core.search import Ending

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

MAX_STEPS = 60
_DIFFERENCE = 1e-6  # in logarithms; forward differences are then good to about six digits
_FIRST_DAMPING = 1e-3
_SMALLEST_DAMPING = 1e-14
_GIVE_UP_DAMPING = 1e8
_CONVERGED_STEP = 1e-9  # in logarithms
_CONVERGED_GAIN = 1e-7  # relative decrease of J that the linear model still promises
_LARGEST_STEP = 1.0  # in logarithms: nothing changes by more than a factor of e in one step


class Problem(NamedTuple):
    """What stays the same during a search: the data, all parameters, and which of them are free."""

    window: Window
    fixed: FloatArray  # (p,) values of the parameters that are not searched for
    free: IntArray  # (f,)


class State(NamedTuple):
    """Where the search is: `y` are the transformed free parameters (f,)."""

    y: FloatArray
    residual: FloatArray  # (m,)
    jacobian: FloatArray  # (m, f), d residual/d y
    objective: float
    damping: float


class Info(NamedTuple):
    """What one step did."""

    objective: float
    step_size: float  # largest change of a logarithm
    damping: float
    accepted: bool
    evaluations: int
    ending: Ending | None


def transform(problem: Problem, values: FloatArray) -> FloatArray:
    """Free parameters (…, f) in physical units to search coordinates."""
    y = np.log(values)
    at = np.flatnonzero(problem.free == D_1)
    d_1 = values[..., at]
    y[..., at] = np.log(d_1 / (problem.window.wheelbase_m - d_1))
    return np.asarray(y)


def untransform(problem: Problem, y: FloatArray) -> FloatArray:
    """Search coordinates (…, f) to free parameters in physical units."""
    values = np.exp(y)
    at = np.flatnonzero(problem.free == D_1)
    values[..., at] = problem.window.wheelbase_m / (1.0 + np.exp(-y[..., at]))
    return np.asarray(values)


def full_vector(problem: Problem, y: FloatArray) -> FloatArray:
    """All parameters (…, p) in physical units for search coordinates (…, f)."""
    theta = np.broadcast_to(problem.fixed, (*y.shape[:-1], problem.fixed.size)).copy()
    theta[..., problem.free] = untransform(problem, y)
    return theta


def derivative_of_values(problem: Problem, y: FloatArray) -> FloatArray:
    """d value/d y (f,) at y: for carrying a covariance into physical units."""
    values = untransform(problem, y)
    slope = values.copy()
    at = np.flatnonzero(problem.free == D_1)
    slope[at] = values[at] * (1.0 - values[at] / problem.window.wheelbase_m)
    return slope


Rows = Callable[[FloatArray], FloatArray]
"""Residual rows (k, m) at points (k, f); a row that is not finite marks an impossible point."""


def begin(rows: Rows, y: FloatArray) -> State:
    """The state at search coordinates `y` (f,) of any least-squares problem."""
    residual = rows(y[None, :])[0]
    return State(y, residual, _jacobian(rows, y, residual), _square(residual), _FIRST_DAMPING)


def descend(rows: Rows, state: State) -> tuple[State, Info]:
    """One Levenberg-Marquardt step of any problem: damping grows until the objective falls."""
    if not (np.isfinite(state.objective) and np.all(np.isfinite(state.jacobian))):
        return state, Info(state.objective, 0.0, state.damping, False, 0, Ending.NOT_FINITE)
    scale = np.linalg.norm(state.jacobian, axis=0)
    scale[scale == 0.0] = 1.0
    (r,) = qr(np.column_stack([state.jacobian / scale, state.residual]), mode="r")
    f = state.y.size
    triangle, projected = r[:f, :f], r[:f, f]
    # Where even the full linear step promises next to nothing, the search is at the bottom.
    if _square(projected) <= _CONVERGED_GAIN * state.objective:
        return state, Info(state.objective, 0.0, state.damping, False, 0, Ending.CONVERGED)
    damping = state.damping
    evaluations = 0
    while damping < _GIVE_UP_DAMPING:
        change = _damped(triangle, projected, damping) / scale
        size = float(np.abs(change).max())
        if size > _LARGEST_STEP:
            change *= _LARGEST_STEP / size
            size = _LARGEST_STEP
        trial = state.y + change
        residual = rows(trial[None, :])[0]
        objective = _square(residual)
        evaluations += 1
        if objective < state.objective:  # false for NaN too
            eased = max(damping * 0.1, _SMALLEST_DAMPING)
            jacobian = _jacobian(rows, trial, residual)
            ending = Ending.CONVERGED if size < _CONVERGED_STEP else None
            return (
                State(trial, residual, jacobian, objective, eased),
                Info(objective, size, damping, True, evaluations + f, ending),
            )
        if size < _CONVERGED_STEP:
            return state, Info(state.objective, size, damping, False, evaluations, Ending.CONVERGED)
        damping *= 10.0
    return state, Info(state.objective, 0.0, damping, False, evaluations, Ending.STUCK)


def _square(residual: FloatArray) -> float:
    return float(residual @ residual)


def _jacobian(rows: Rows, y: FloatArray, residual: FloatArray) -> FloatArray:
    moved = rows(y + _DIFFERENCE * np.eye(y.size))
    return np.asarray(((moved - residual) / _DIFFERENCE).T)


def _damped(triangle: FloatArray, projected: FloatArray, damping: float) -> FloatArray:
    """Minimiser of |R x + p|^2 + damping |x|^2."""
    f = projected.size
    stacked = np.vstack([triangle, np.sqrt(damping) * np.eye(f)])
    q, small = qr(stacked, mode="economic")
    return np.asarray(solve_triangular(small, q.T @ np.concatenate([-projected, np.zeros(f)])))


def _rows_of(problem: Problem, work: Workspace) -> Rows:
    return lambda y: residual_batch(problem.window, work, full_vector(problem, y))


def init(problem: Problem, work: Workspace, start: FloatArray) -> State:
    """Begin at the free parameters `start` (f,) in physical units."""
    return begin(_rows_of(problem, work), transform(problem, start))


def step(problem: Problem, work: Workspace, state: State) -> tuple[State, Info]:
    """One step on the paper's residual."""
    return descend(_rows_of(problem, work), state)


def covariance(state: State) -> FloatArray:
    """Gauss-Newton covariance (f, f) of y, scaled by the residual's own variance.

    It takes the rows for independent, which double-integrated sensor noise is not: a formal figure,
    not an uncertainty.
    """
    rows, f = state.jacobian.shape
    scale = np.linalg.norm(state.jacobian, axis=0)
    scale[scale == 0.0] = 1.0
    (r,) = qr(state.jacobian / scale, mode="r")
    inverse = solve_triangular(r[:f], np.eye(f)) / scale[:, None]
    return np.asarray(inverse @ inverse.T * state.objective / max(1, rows - f))
