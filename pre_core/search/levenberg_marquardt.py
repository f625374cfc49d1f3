"""Levenberg-Marquardt for any rows whose squares are to be summed to as little as can be.

The coordinates are the caller's, and without bounds; a row that is not finite marks a point that is
impossible, and the damping grows until the step avoids it (Nocedal and Wright, section 10.3).
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import qr, solve_triangular

from pre_core.search.loop import Ending, Solution, run

FloatArray = NDArray[np.float64]

_FIRST_DAMPING = 1e-3
"""Relative to the Jacobian's columns: nearly a Gauss-Newton step."""
_SMALLEST_DAMPING = 1e-14
"""Damping that is smaller changes nothing within rounding."""
_GIVE_UP_DAMPING = 1e8
"""Steps that are so short and do not help: the search is stuck."""
_CONVERGED_STEP = 1e-9  # in logarithms
_KEPT = 0.5
"""A step that gains less than this part of what slopes led on promise has them taken anew."""
_LARGEST_STEP = 1.0  # in logarithms: nothing changes by more than a factor of e in one step


class Differences(NamedTuple):
    """How a Jacobian is taken, and the gain at which a search that uses it is at the bottom."""

    step: float  # in search coordinates
    central: bool
    converged_gain: float  # relative decrease of J that the linear model still promises
    rounding: (
        float  # a relative rise of J by less than this is rounding, and no reason to turn back
    )


FORWARD = Differences(1e-6, central=False, converged_gain=1e-7, rounding=0.0)
"""On the way: f evaluations, six digits. What is in the others depends on the processor's rounding
and moves the bottom by about 1e-6, little beside a standard deviation of any real crossing."""

CENTRAL = Differences(1e-3, central=True, converged_gain=1e-12, rounding=1e-9)
"""At the bottom: 2f evaluations, a rounding a thousand times smaller. The error of the formula is
larger, and would be 2e-5 of a standard deviation, but the same on every processor: so is the
bottom. What is told of it, `covariance`, takes `slopes`."""

_SLOPE_STEP = 3e-3
_SLOPE_WEIGHTS = (3.0 / 4.0, -3.0 / 20.0, 1.0 / 60.0)
"""Weights of central differences over one, two and three steps, which are together exact for
polynomials of sixth degree. With this step the error of the formula and what rounding makes of it
are alike."""


class State(NamedTuple):
    """Where the search is: `y` are the transformed free parameters (f,)."""

    y: FloatArray
    residual: FloatArray  # (m,)
    jacobian: FloatArray  # (m, f), d residual/d y
    objective: float
    damping: float
    differences: Differences
    is_fresh: bool = True
    """Whether the Jacobian was taken here, and not led on from where it was (`_follow`)."""


class Info(NamedTuple):
    """What one step did."""

    objective: float
    step_size: float  # largest change of a logarithm
    damping: float
    accepted: bool
    evaluations: int
    ending: Ending | None


Rows = Callable[[FloatArray], FloatArray]
"""Residual rows (k, m) at points (k, f); a row that is not finite marks an impossible point."""


def begin(rows: Rows, y: FloatArray, differences: Differences = FORWARD) -> State:
    """The state at search coordinates `y` (f,) of any least-squares problem."""
    residual = rows(y[None, :])[0]
    jacobian = _jacobian(rows, y, residual, differences)
    return State(y, residual, jacobian, _square(residual), _FIRST_DAMPING, differences)


class Move(NamedTuple):
    """Where a step leads, before the slopes there are known."""

    y: FloatArray
    residual: FloatArray
    objective: float
    damping: float
    """Of the following step."""
    size: float  # largest change of a coordinate
    evaluations: int


def move(rows: Rows, state: State, lower: FloatArray | None = None) -> Move | tuple[State, Info]:
    """The way to a smaller objective from `state`, or why there is none; see `descend`."""
    if not (np.isfinite(state.objective) and np.all(np.isfinite(state.jacobian))):
        return state, Info(state.objective, 0.0, state.damping, False, 0, Ending.NOT_FINITE)
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
    # Where even the full linear step promises next to nothing, the search is at the bottom.
    if _square(projected) <= state.differences.converged_gain * state.objective:
        return state, Info(state.objective, 0.0, state.damping, False, 0, Ending.CONVERGED)
    damping = state.damping
    evaluations = 0
    while damping < _GIVE_UP_DAMPING:
        change = np.zeros(f)
        change[free] = _damped(triangle, projected, damping) / scale
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
            return Move(trial, residual, objective, eased, size, evaluations)
        if size < _CONVERGED_STEP:
            return state, Info(state.objective, size, damping, False, evaluations, Ending.CONVERGED)
        damping *= 10.0
    return state, Info(state.objective, 0.0, damping, False, evaluations, Ending.STUCK)


def descend(rows: Rows, state: State, lower: FloatArray | None = None) -> tuple[State, Info]:
    """One Levenberg-Marquardt step of any problem: damping grows until the objective falls.

    No coordinate goes below `lower` (f,); one that lies there and would is held for this step.
    """
    there = move(rows, state, lower)
    if not isinstance(there, Move):
        return there
    slopes = _jacobian(rows, there.y, there.residual, state.differences)
    evaluations = there.evaluations + _evaluations(state.differences, state.y.size)
    ending = Ending.CONVERGED if there.size < _CONVERGED_STEP else None
    return (
        State(there.y, there.residual, slopes, there.objective, there.damping, state.differences),
        Info(there.objective, there.size, there.damping, True, evaluations, ending),
    )


def _follow(rows: Rows, state: State, lower: FloatArray | None) -> tuple[State, Info]:
    """`descend` with slopes that are led on from step to step, as long as steps lead there.

    Broyden's update (Dennis and Schnabel, section 8.1): of all slopes that explain the change of
    the rows along the step those that are nearest to the last ones. Where a step kept too little of
    its promise slopes are taken anew; and where one with slopes led on leads no further.
    """
    there = move(rows, state, lower)
    if not isinstance(there, Move):
        stays, info = there
        return (stays, info) if state.is_fresh else _refreshed(rows, stays, info)
    change = there.y - state.y
    told = state.jacobian @ change
    promised = state.objective - _square(state.residual + told)
    missed = there.residual - state.residual - told
    ending = Ending.CONVERGED if there.size < _CONVERGED_STEP else None
    following = state._replace(
        y=there.y,
        residual=there.residual,
        # Column by column, as the Jacobian stands.
        jacobian=state.jacobian + np.outer(change / max(_square(change), 1e-300), missed).T,
        objective=there.objective,
        damping=there.damping,
        is_fresh=False,
    )
    info = Info(there.objective, there.size, there.damping, True, there.evaluations, ending)
    if ending is None and state.objective - there.objective < _KEPT * promised:
        return _refreshed(rows, following, info)
    return following, info


def _refreshed(rows: Rows, state: State, info: Info) -> tuple[State, Info]:
    """The same place with slopes taken there, from which a search goes on."""
    jacobian = _jacobian(rows, state.y, state.residual, state.differences)
    evaluations = info.evaluations + _evaluations(state.differences, state.y.size)
    damping = min(state.damping, _FIRST_DAMPING)
    return (
        state._replace(jacobian=jacobian, damping=damping, is_fresh=True),
        info._replace(evaluations=evaluations, ending=None),
    )


def _square(residual: FloatArray) -> float:
    with np.errstate(over="ignore"):  # of a point far off: infinite, and no step is taken there
        return float(residual @ residual)


def _jacobian(
    rows: Rows, y: FloatArray, residual: FloatArray, differences: Differences
) -> FloatArray:
    moves = differences.step * np.eye(y.size)
    if not differences.central:
        return np.asarray(((rows(y + moves) - residual) / differences.step).T)
    ahead, behind = np.split(rows(np.vstack([y + moves, y - moves])), 2)
    return np.asarray(((ahead - behind) / (2.0 * differences.step)).T)


def _evaluations(differences: Differences, f: int) -> int:
    return 2 * f if differences.central else f


def _damped(triangle: FloatArray, projected: FloatArray, damping: float) -> FloatArray:
    """Minimiser of |R x + p|^2 + damping |x|^2."""
    f = projected.size
    stacked = np.zeros((2 * f, f + 1), order="F")
    stacked[:f, :f] = triangle
    stacked[:f, f] = projected
    stacked[np.arange(f, 2 * f), np.arange(f)] = np.sqrt(damping)
    small, image = _triangle(stacked)
    return np.asarray(-solve_triangular(small, image, check_finite=False))


def _triangle(stacked: FloatArray) -> tuple[FloatArray, FloatArray]:
    """R (f, f) and Q'b (f,) of columns A and b side by side (m, f + 1), which are overwritten."""
    f = stacked.shape[1] - 1
    _, r = qr(stacked, mode="raw", overwrite_a=True, check_finite=False)
    return r[:f, :f], r[:f, f]


def polish(rows: Rows, state: State, info: Info) -> tuple[State, Info]:
    """Where a search with forward differences has ended, let it go on with central ones.

    So the way costs no more than it must, and where it ends does not depend on the processor.
    """
    if state.differences.central or info.ending not in (Ending.CONVERGED, Ending.STUCK):
        return state, info
    jacobian = _jacobian(rows, state.y, state.residual, CENTRAL)
    evaluations = info.evaluations + _evaluations(CENTRAL, state.y.size)
    return (
        state._replace(jacobian=jacobian, differences=CENTRAL),
        info._replace(evaluations=evaluations, ending=None),
    )


def minimised(
    rows: Rows,
    start: FloatArray,
    steps: int,
    enough: float,
    lower: FloatArray | None = None,
    *,
    is_followed: bool = False,
) -> Solution[State, Info]:
    """The bottom below `start` (f,), reached when a step gains less than `enough`.

    Where no step helps any more, forward differences have reached their rounding: the bottom too.
    With `is_followed` slopes are taken where the search begins, and then only where those that are
    led on (`_follow`) no longer tell the way. A step that gains too little ends the search only if
    its slopes were taken where it began. The slopes at the end need not be (`State.is_fresh`).
    """

    def step(state: State) -> tuple[State, Info]:
        following, info = (_follow if is_followed else descend)(rows, state, lower)
        if info.ending is Ending.STUCK:
            return following, info._replace(ending=Ending.CONVERGED)
        if info.ending is None and state.objective - following.objective < enough:
            if state.is_fresh:
                return following, info._replace(ending=Ending.CONVERGED)
            if not following.is_fresh:
                return _refreshed(rows, following, info)
        return following, info

    return run(lambda: begin(rows, start), step, steps)


def slopes(rows: Rows, y: FloatArray) -> FloatArray:
    """d rows/d y (m, f) at y (f,) by central differences of sixth order: 6f evaluations.

    For what is told of a point rather than for the way there. The error is step^6/140 of the
    seventh derivative.
    """
    differences = []
    for count, weight in enumerate(_SLOPE_WEIGHTS, start=1):
        moves = count * _SLOPE_STEP * np.eye(y.size)
        ahead, behind = np.split(rows(np.vstack([y + moves, y - moves])), 2)
        differences.append(weight * (ahead - behind))
    return np.asarray((np.sum(differences, axis=0) / _SLOPE_STEP).T)


def covariance(rows: Rows, y: FloatArray) -> FloatArray:
    """Gauss-Newton covariance (f, f) of the bottom y (f,), scaled by the residual's own variance.

    It takes the rows for independent, which double-integrated sensor noise is not: a formal figure,
    not an uncertainty.
    """
    residual = rows(y[None, :])[0]
    jacobian = slopes(rows, y)
    count, f = jacobian.shape
    scale = np.linalg.norm(jacobian, axis=0)
    scale[scale == 0.0] = 1.0
    (r,) = qr(jacobian / scale, mode="r")
    inverse = solve_triangular(r[:f], np.eye(f)) / scale[:, None]
    return np.asarray(inverse @ inverse.T * _square(residual) / max(1, count - f))
