"""Levenberg-Marquardt for any sum of squared residuals.

The coordinates are the caller's and have no bounds. A residual that is not finite marks an
impossible point, and the damping grows until the step avoids it (Nocedal and Wright, section 10.3).
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.linalg import qr, solve_triangular

from pre_core.arrays import FloatArray
from pre_core.search.loop import SearchResult, Termination, run_search

_FIRST_DAMPING = 1e-3
"""Initial damping relative to the Jacobian's columns: nearly a Gauss-Newton step."""
_SMALLEST_DAMPING = 1e-14
"""Smallest damping; less has no effect within rounding."""
_GIVE_UP_DAMPING = 1e8
"""Damping at which the search is stuck: very short steps do not help."""
_CONVERGED_STEP = 1e-9  # in logarithms
_KEPT = 0.5
"""Smallest improvement, relative to its prediction, for which an updated Jacobian is kept."""
_MISFIT_IMPROVEMENT = 1e-3
"""Improvement, relative to the objective, below which a search with a large misfit ends."""
_LARGEST_STEP = 1.0  # in logarithms: nothing changes by more than a factor of e in one step


class DifferenceScheme(NamedTuple):
    """Scheme of a Jacobian, and the improvement at which a search that uses it has converged."""

    step: float  # in search coordinates
    central: bool
    converged_improvement: float  # relative decrease of J that the linear model still predicts
    rounding: float  # a smaller relative rise of J is rounding and does not reject a step


FORWARD = DifferenceScheme(1e-6, central=False, converged_improvement=1e-7, rounding=0.0)
"""Scheme during the search: f evaluations, six digits. The other digits depend on the processor's
rounding and move the optimum by about 1e-6, little compared with a standard deviation of any real
crossing."""

CENTRAL = DifferenceScheme(1e-3, central=True, converged_improvement=1e-12, rounding=1e-9)
"""Scheme at the optimum: 2f evaluations, a rounding a thousand times smaller. The formula's error
is larger, about 2e-5 of a standard deviation, but the same on every processor: so is the optimum.
Uncertainties (`gauss_newton_covariance`) use `sixth_order_jacobian`."""

_SLOPE_STEP = 3e-3
_SLOPE_WEIGHTS = (3.0 / 4.0, -3.0 / 20.0, 1.0 / 60.0)
"""Weights of central differences over one, two and three steps, together exact for polynomials of
sixth degree. With this step the formula's error and rounding are similar."""


class LMState(NamedTuple):
    """State of the search at the search coordinates `y` (f,)."""

    y: FloatArray
    residual: FloatArray  # (m,)
    jacobian: FloatArray  # (m, f), d residual/d y
    objective: float
    damping: float
    differences: DifferenceScheme
    is_fresh: bool = True
    """Whether the Jacobian was computed at `y` and not updated from elsewhere (`_broyden_step`)."""


class LMInfo(NamedTuple):
    """Statistics of one step."""

    objective: float
    accepted: bool
    evaluations: int
    ending: Termination | None


Rows = Callable[[FloatArray], FloatArray]
"""Function from points (k, f) to their residuals (k, m); a value that is not finite marks an
impossible point."""


def initial_state(rows: Rows, y: FloatArray, differences: DifferenceScheme = FORWARD) -> LMState:
    """Return the state at search coordinates `y` (f,) of any least-squares problem."""
    residual = rows(y[None, :])[0]
    jacobian = _jacobian(rows, y, residual, differences)
    return LMState(y, residual, jacobian, _square(residual), _FIRST_DAMPING, differences)


class TrialStep(NamedTuple):
    """A step, before the Jacobian at its end is known."""

    y: FloatArray
    residual: FloatArray
    objective: float
    damping: float
    """Damping of the following step."""
    size: float  # largest change of a coordinate
    evaluations: int


def trial_step(
    rows: Rows, state: LMState, lower: FloatArray | None = None
) -> TrialStep | tuple[LMState, LMInfo]:
    """Return a step to a smaller objective, or the final state; `lower` (f,) as in `descend`."""
    if not (np.isfinite(state.objective) and np.all(np.isfinite(state.jacobian))):
        return state, LMInfo(state.objective, False, 0, Termination.NOT_FINITE)
    f = state.y.size
    free = np.full(f, True)
    if lower is not None:
        free = (state.y > lower) | (state.jacobian.T @ state.residual <= 0.0)
    count = int(free.sum())
    # LAPACK works column by column, in place.
    rows_of = np.empty((state.residual.size, count + 1), order="F")
    rows_of[:, :count] = state.jacobian[:, free] if count < f else state.jacobian
    rows_of[:, count] = state.residual
    scale = np.sqrt(np.einsum("ij,ij->j", rows_of[:, :count], rows_of[:, :count]))
    scale[scale == 0.0] = 1.0
    rows_of[:, :count] /= scale
    triangle, projected = _triangle(rows_of)
    # If even the full linear step predicts next to no improvement, the search has converged.
    if _square(projected) <= state.differences.converged_improvement * state.objective:
        return state, LMInfo(state.objective, False, 0, Termination.CONVERGED)
    damping = state.damping
    evaluations = 0
    while damping < _GIVE_UP_DAMPING:
        change = np.zeros(f)
        change[free] = _damped_step(triangle, projected, damping) / scale
        size = float(np.abs(change).max())
        if size > _LARGEST_STEP:
            change *= _LARGEST_STEP / size
            size = _LARGEST_STEP
        trial = state.y + change
        if lower is not None:
            trial = np.maximum(trial, lower)
        residual = rows(trial[None, :])[0]
        objective = _square(residual)
        evaluations += 1
        # False for NaN too.
        if objective < state.objective * (1.0 + state.differences.rounding):
            eased = max(damping * 0.1, _SMALLEST_DAMPING)
            return TrialStep(trial, residual, objective, eased, size, evaluations)
        if size < _CONVERGED_STEP:
            ending = Termination.CONVERGED
            return state, LMInfo(state.objective, False, evaluations, ending)
        damping *= 10.0
    return state, LMInfo(state.objective, False, evaluations, Termination.STUCK)


def descend(rows: Rows, state: LMState, lower: FloatArray | None = None) -> tuple[LMState, LMInfo]:
    """Take one Levenberg-Marquardt step: damping grows until the objective falls.

    No coordinate goes below `lower` (f,); one on its bound that would do so is fixed for the step.
    """
    there = trial_step(rows, state, lower)
    if not isinstance(there, TrialStep):
        return there
    slopes = _jacobian(rows, there.y, there.residual, state.differences)
    evaluations = there.evaluations + _evaluations(state.differences, state.y.size)
    ending = Termination.CONVERGED if there.size < _CONVERGED_STEP else None
    return (
        LMState(there.y, there.residual, slopes, there.objective, there.damping, state.differences),
        LMInfo(there.objective, True, evaluations, ending),
    )


def _broyden_step(rows: Rows, state: LMState, lower: FloatArray | None) -> tuple[LMState, LMInfo]:
    """Take a step as `descend` does, updating the Jacobian as long as steps succeed.

    Broyden's update (Dennis and Schnabel, section 8.1) is the nearest Jacobian that explains the
    change of the residuals along the step. It is recomputed where a step achieves too little of its
    prediction, and where a step with an updated Jacobian fails.
    """
    there = trial_step(rows, state, lower)
    if not isinstance(there, TrialStep):
        stays, info = there
        return (stays, info) if state.is_fresh else _refresh_jacobian(rows, stays, info)
    change = there.y - state.y
    predicted = state.jacobian @ change
    promised = state.objective - _square(state.residual + predicted)
    missed = there.residual - state.residual - predicted
    ending = Termination.CONVERGED if there.size < _CONVERGED_STEP else None
    following = state._replace(
        y=there.y,
        residual=there.residual,
        # Transposed, to keep the Jacobian's memory order.
        jacobian=state.jacobian + np.outer(change / max(_square(change), 1e-300), missed).T,
        objective=there.objective,
        damping=there.damping,
        is_fresh=False,
    )
    info = LMInfo(there.objective, True, there.evaluations, ending)
    if ending is None and state.objective - there.objective < _KEPT * promised:
        return _refresh_jacobian(rows, following, info)
    return following, info


def _refresh_jacobian(rows: Rows, state: LMState, info: LMInfo) -> tuple[LMState, LMInfo]:
    """Return the same point with a Jacobian computed there, to continue from."""
    jacobian = _jacobian(rows, state.y, state.residual, state.differences)
    evaluations = info.evaluations + _evaluations(state.differences, state.y.size)
    damping = min(state.damping, _FIRST_DAMPING)
    return (
        state._replace(jacobian=jacobian, damping=damping, is_fresh=True),
        info._replace(evaluations=evaluations, ending=None),
    )


def _square(residual: FloatArray) -> float:
    with np.errstate(over="ignore"):  # infinite at a distant point, where no step is taken
        return float(residual @ residual)


def _jacobian(
    rows: Rows, y: FloatArray, residual: FloatArray, differences: DifferenceScheme
) -> FloatArray:
    moves = differences.step * np.eye(y.size)
    if not differences.central:
        return np.asarray(((rows(y + moves) - residual) / differences.step).T)
    ahead, behind = np.split(rows(np.vstack([y + moves, y - moves])), 2)
    return np.asarray(((ahead - behind) / (2.0 * differences.step)).T)


def _evaluations(differences: DifferenceScheme, f: int) -> int:
    return 2 * f if differences.central else f


def _damped_step(triangle: FloatArray, projected: FloatArray, damping: float) -> FloatArray:
    """Return the minimiser of |R x + p|^2 + damping |x|^2."""
    f = projected.size
    stacked = np.zeros((2 * f, f + 1), order="F")
    stacked[:f, :f] = triangle
    stacked[:f, f] = projected
    stacked[np.arange(f, 2 * f), np.arange(f)] = np.sqrt(damping)
    small, image = _triangle(stacked)
    return np.asarray(-solve_triangular(small, image, check_finite=False))


def _triangle(stacked: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return R (f, f) and Q'b (f,) of columns A and b side by side (m, f + 1), overwriting them."""
    f = stacked.shape[1] - 1
    _, r = qr(stacked, mode="raw", overwrite_a=True, check_finite=False)
    return r[:f, :f], r[:f, f]


def polish(rows: Rows, state: LMState, info: LMInfo) -> tuple[LMState, LMInfo]:
    """Continue with central differences where a search with forward ones has ended.

    The search then costs no more than necessary, and its end does not depend on the processor.
    """
    if state.differences.central or info.ending not in (Termination.CONVERGED, Termination.STUCK):
        return state, info
    jacobian = _jacobian(rows, state.y, state.residual, CENTRAL)
    evaluations = info.evaluations + _evaluations(CENTRAL, state.y.size)
    return (
        state._replace(jacobian=jacobian, differences=CENTRAL),
        info._replace(evaluations=evaluations, ending=None),
    )


def minimise(
    rows: Rows,
    start: FloatArray,
    steps: int,
    min_improvement: float,
    lower: FloatArray | None = None,
    *,
    uses_broyden: bool = False,
    misfit: float = np.inf,
) -> SearchResult[LMState, LMInfo]:
    """Return the minimum near `start` (f,), after at most `steps` steps.

    A step that improves by less than `min_improvement` ends the search at a minimum. Where the mean
    square of the residuals exceeds `misfit`, an improvement by less than a thousandth of the
    objective also ends the search: its exact minimum is not needed. Where no step helps, forward
    differences have reached their rounding, which counts as a minimum. With `uses_broyden` the
    Jacobian is computed at the start, and then only where updates (`_broyden_step`) fail. A step
    that improves too little ends the search only with a fresh Jacobian. The Jacobian at the end
    need not be fresh (`LMState.is_fresh`). No coordinate goes below `lower` (f,).
    """

    def step(state: LMState) -> tuple[LMState, LMInfo]:
        following, info = (_broyden_step if uses_broyden else descend)(rows, state, lower)
        if info.ending is Termination.STUCK:
            return following, info._replace(ending=Termination.CONVERGED)
        is_misfit = following.objective > misfit * state.residual.size
        least = (
            max(min_improvement, _MISFIT_IMPROVEMENT * state.objective)
            if is_misfit
            else min_improvement
        )
        if info.ending is None and state.objective - following.objective < least:
            if state.is_fresh:
                return following, info._replace(ending=Termination.CONVERGED)
            if not following.is_fresh:
                return _refresh_jacobian(rows, following, info)
        return following, info

    return run_search(lambda: initial_state(rows, start), step, steps)


def sixth_order_jacobian(rows: Rows, y: FloatArray) -> FloatArray:
    """Return d residuals/d y (m, f) at y (f,) by central differences of sixth order.

    It takes 6f evaluations and serves uncertainties rather than the search. The error is step^6/140
    of the seventh derivative.
    """
    differences = []
    for count, weight in enumerate(_SLOPE_WEIGHTS, start=1):
        moves = count * _SLOPE_STEP * np.eye(y.size)
        ahead, behind = np.split(rows(np.vstack([y + moves, y - moves])), 2)
        differences.append(weight * (ahead - behind))
    return np.asarray((np.sum(differences, axis=0) / _SLOPE_STEP).T)


def gauss_newton_covariance(rows: Rows, y: FloatArray) -> FloatArray:
    """Return the Gauss-Newton covariance (f, f) at y (f,), scaled by the residual variance.

    It assumes independent residuals, which double-integrated sensor noise is not: a formal value,
    not an uncertainty.
    """
    residual = rows(y[None, :])[0]
    jacobian = sixth_order_jacobian(rows, y)
    count, f = jacobian.shape
    scale = np.linalg.norm(jacobian, axis=0)
    scale[scale == 0.0] = 1.0
    (r,) = qr(jacobian / scale, mode="r")
    inverse = solve_triangular(r[:f], np.eye(f)) / scale[:, None]
    return np.asarray(inverse @ inverse.T * _square(residual) / max(1, count - f))
