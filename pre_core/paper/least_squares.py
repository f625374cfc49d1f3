"""Least squares on the paper's residual: Levenberg-Marquardt in logarithms of the unknowns.

Without noise the surface is benign (docs/reproduction.md): from anywhere in the paper's prior about
ten steps lead to the one minimum. All unknowns are positive, so the search moves in logarithms and
needs no bounds, except that d_1 must lie between the axles: there it moves in the logit.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pre_core.paper.residual import Window, Workspace, residual_batch
from pre_core.search import levenberg_marquardt
from pre_core.search.levenberg_marquardt import Info, Rows, State, begin, descend, polish
from pre_core.unknowns import D_1

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


MAX_STEPS = 60
"""Ten to fifteen lead to the minimum without noise (docs/reproduction.md); who needs this many is
lost."""


class Problem(NamedTuple):
    """What stays the same during a search: the data, all parameters, and which of them are free."""

    window: Window
    fixed: FloatArray  # (p,) values of the parameters that are not searched for
    free: IntArray  # (f,)


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


def _derivative_of_values(problem: Problem, y: FloatArray) -> FloatArray:
    """d value/d y (f,) at y: for carrying a covariance into physical units."""
    values = untransform(problem, y)
    slope = values.copy()
    at = np.flatnonzero(problem.free == D_1)
    slope[at] = values[at] * (1.0 - values[at] / problem.window.wheelbase_m)
    return slope


def _rows_of(problem: Problem, work: Workspace) -> Rows:
    return lambda y: residual_batch(problem.window, work, full_vector(problem, y))


def init(problem: Problem, work: Workspace, start: FloatArray) -> State:
    """Begin at the free parameters `start` (f,) in physical units."""
    return begin(_rows_of(problem, work), transform(problem, start))


def step(problem: Problem, work: Workspace, state: State) -> tuple[State, Info]:
    """One step on the paper's residual; at the bottom forward differences give way to central ones.

    So the way costs no more than it must, and where it ends does not depend on the processor.
    """
    return polish(_rows_of(problem, work), *descend(_rows_of(problem, work), state))


def covariance(problem: Problem, work: Workspace, y: FloatArray) -> FloatArray:
    """Formal covariance (f, f) of the free parameters, in physical units, at the bottom y (f,)."""
    slope = _derivative_of_values(problem, y)
    in_logarithms = levenberg_marquardt.covariance(_rows_of(problem, work), y)
    return np.asarray(in_logarithms * np.outer(slope, slope))
