"""What one crossing says of the bridge and of the part of the road's mismatch that runs share.

The likelihood alone, priors of the bridge left out so that each counts once: normal in the bridge's
unknowns, with c = EI_nominal/EI in place of ln EI (`crossing.compliances`), and in the values of
the common mismatch d_c at knots along the road; everything of this crossing's own - truck,
trajectory, delays, its own part of the mismatch - is integrated out.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline

from pre_core.crossing import posterior
from pre_core.crossing.compliances import in_compliances, marginal, without_priors
from pre_core.crossing.mismatch import Mismatch
from pre_core.crossing.optimum import Optimum
from pre_core.crossing.preparation import off_bridge, with_noise_at
from pre_core.crossing.residuals import Crossing, Points, evaluate
from pre_core.crossing.whitening import RESIDUALS, filter_rows, row_count, solve
from pre_core.physics.simulate import rear_position_m
from pre_core.search import levenberg_marquardt
from pre_core.unknowns import FIRST_OF_BRIDGE

FloatArray = NDArray[np.float64]

KNOT_M = 0.4
"""Between knots of the common mismatch, cubic between: waves of a metre are still there."""
_CUBIC = 3


class Likelihood(NamedTuple):
    """-(x'Ax)/2 + b'x up to a constant, of x: the bridge's unknowns, then d_c in mm at knots."""

    precision: FloatArray  # (b + k, b + k)
    linear: FloatArray  # (b + k,)
    bridge: int
    """How many of x are the bridge's; elements are the last of them."""


def knots(begin_m: float, end_m: float) -> FloatArray:
    """Chainages of the knots that cover a stretch of road."""
    return np.arange(begin_m - 2.0 * KNOT_M, end_m + 3.0 * KNOT_M, KNOT_M)


def likelihood(found: Optimum, own: Mismatch, knots_m: FloatArray | None = None) -> Likelihood:
    """Return that of a crossing at its optimum.

    `own` is its own part of the mismatch, at its own speed.
    """
    y = found.state.y
    apart = found.problem._replace(mismatch=own)
    problem = with_noise_at(apart, y, found.problem.force, mismatch=own.level_m3)
    state = levenberg_marquardt.begin(lambda at: posterior.all_rows(problem, at), y)
    kept = np.flatnonzero(problem.priors.estimated)
    bridge = np.flatnonzero(kept >= FIRST_OF_BRIDGE)
    rows = without_priors(problem, state.residual.size, bridge)
    centre, jacobian = in_compliances(problem, y, state.jacobian[rows])
    if knots_m is not None:
        common = np.zeros((rows.size, knots_m.size))
        white = _white_knots(problem, y, knots_m)
        common[: white.shape[0]] = white
        jacobian = np.hstack([jacobian, common])
        centre = np.concatenate([centre, np.zeros(knots_m.size)])
    told = np.concatenate([bridge, np.arange(y.size, centre.size)])
    precision = jacobian.T @ jacobian
    linear = precision @ centre - jacobian.T @ state.residual[rows]
    return Likelihood(*marginal(precision, linear, told), bridge.size)


def _rear_m(crossing: Crossing, at: Points) -> FloatArray:
    """Where the rear axle is at every row's sample: (rows,)."""
    rear = rear_position_m(at.position_m[0], float(at.wheelbase_m[0]), crossing.direction)
    return rear[crossing.first_row :]


def _white_knots(problem: posterior.Problem, y: FloatArray, knots_m: FloatArray) -> FloatArray:
    """What 1 mm of d_c at each knot does to the white rows: (3 m, k)."""
    crossing, rows = problem.crossing, problem.rows
    at = posterior.points(problem, y[None, :])
    rear = _rear_m(crossing, at)
    padded = np.concatenate(
        [
            knots_m[0] - KNOT_M * np.arange(2, 0, -1),
            knots_m,
            knots_m[-1] + KNOT_M * np.arange(1, 3),
        ]
    )
    basis = BSpline(padded, np.eye(knots_m.size), _CUBIC, extrapolate=False)
    shape = 1e-3 * np.nan_to_num(np.asarray(basis(rear)))
    out = np.zeros((problem.noise.reciprocal.size, knots_m.size))
    filtered = np.empty(row_count(rows, rear.size))
    for k in range(knots_m.size):
        filter_rows(rows.taps, rows.every, np.ascontiguousarray(shape[:, k]), filtered)
        column = np.zeros(out.shape[0])
        column[::RESIDUALS] = filtered
        solve(problem.noise.factor, problem.noise.reciprocal, column)
        out[:, k] = column
    return out


def mismatch_off_bridge(found: Optimum, x_m: FloatArray) -> FloatArray:
    """What the axles' roads differ by at x (k,) in m, off the bridge; NaN elsewhere."""
    problem, y = found.problem, found.state.y
    crossing, rows = problem.crossing, problem.rows
    at = posterior.points(problem, y[None, :])
    rear = _rear_m(crossing, at)
    (residual,) = evaluate(crossing, problem.works, at)
    out = np.full(x_m.size, np.nan)
    for one in off_bridge(problem, y):
        samples = slice(one.start * rows.every, one.stop * rows.every)
        place, value = rear[samples], residual[0][samples]
        if place.size < 2:
            continue
        order = np.argsort(place)
        inside = (x_m > place.min()) & (x_m < place.max())
        out[inside] = np.interp(x_m[inside], place[order], value[order])
    return out
