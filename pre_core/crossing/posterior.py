"""Method `pre`: the whitened likelihood of one crossing with its priors, and its optimum.

All unknowns are put into coordinates y in which their prior is a standard normal
(docs/method-pre.md): logarithms of positive quantities, multiples of the prior's spread for the
others. The trajectory's spline coefficients have no prior of their own; the receiver's fixes take
its place. The sum of squares of all rows is then -2 log posterior up to a constant, and its
Gauss-Newton curvature the precision of the normal that the Markov chains are steered by.
"""

from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import qr, solve_triangular

from pre_core.crossing import splines, whitening
from pre_core.crossing.layout import CHANNELS, Layout, laid_out
from pre_core.crossing.mismatch import Mismatch
from pre_core.crossing.residuals import (
    SWING_MODES,
    Crossing,
    Points,
    Work,
    evaluate,
    evaluate_white,
    largest_deflections,
    roads_and_deflections,
)
from pre_core.crossing.whitening import (
    RESIDUALS,
    RowFilter,
    Truck,
    Whitener,
    filter_rows,
    row_count,
    truck_of,
)
from pre_core.unknowns import EI_1, K_U1, M_U1

FloatArray = NDArray[np.float64]

# Three directions in which four gains differ; what is common to all comes beside them.
_CONTRASTS = np.array(
    [[0.5, 0.5, -0.5, -0.5], [0.5, -0.5, 0.5, -0.5], [0.5, -0.5, -0.5, 0.5]], dtype=np.float64
)
_INITIAL_SPREAD = np.array([0.1, 0.1, 0.1])  # m, m/s, m/s²: wide; they are nuisances
_SWING_M = 1e-3
"""Scale of the first mode's displacement, and velocity over omega, at its largest point: a 30 t
lorry that has left a tenth of a second ago leaves a bridge of 30 m swinging by a millimetre. Of the
second it is a quarter, of the third a ninth: a load bends a beam into its j-th mode by 1/j^4."""
_JERK_M_PER_S3 = 1.0
"""Root mean square of the jerk that a driver's changes of speed have, before anything is
measured."""
_DEGREE = 5
"""The trajectory is a spline of this degree: load moves with its second derivative, which must not
have kinks."""
_AT_ONCE = 100
"""Points whose trajectories are written out at once: they are long."""


class Priors(NamedTuple):
    """What is known before the crossing; relative spreads are those of a log-normal."""

    theta: FloatArray  # (p,) nominal values
    spread: FloatArray  # (p,) relative; absolute where the prior is half-normal
    half_normal: NDArray[np.bool_]  # (p,) at zero; log-normal about the nominal value elsewhere
    estimated: NDArray[np.bool_]  # (p,) which are unknown at all
    absence: FloatArray
    """(p,) probability before the crossing that an unknown with a half-normal prior is nothing."""
    wheelbase_m: float
    wheelbase_spread: float
    gain_spread: float
    """The spread of each channel's gain, independent of the others'."""
    common_gain_spread: float
    delay_spread_s: float


class Fixes(NamedTuple):
    """The receiver's fixes near the crossing, of the front axle's chainage; (m,) each."""

    time_s: FloatArray
    position_m: FloatArray
    velocity_m_per_s: FloatArray
    position_noise_m: float
    speed_noise_m_per_s: float
    offset_spread_m: float
    """Slow error and latency together: common to all fixes."""


class Problem(NamedTuple):
    """Everything that stays the same during a search."""

    crossing: Crossing
    priors: Priors
    rows: RowFilter
    noise: Whitener
    density: FloatArray  # (4,) one-sided, m/s²/√Hz
    force: FloatArray
    """(2, shapes) noise of springs and dampers, N²/Hz; see whitening.py."""
    mismatch: Mismatch
    """How the roads under both axles differ; without level where they are taken for the same."""
    basis_position: FloatArray  # (n, b): trajectory = basis @ coefficients
    basis_acceleration: FloatArray  # (n, b), positive when speeding up
    receiver_rows: FloatArray  # (r, b + 1): rows of (coefficients, offset)
    receiver_values: FloatArray  # (r,)
    noise_slope: FloatArray  # of the first coordinates: see `all_rows`
    works: tuple[Work, ...]


def layout(problem: Problem) -> Layout:
    """Theta (what is estimated), wheelbase, gains, delays, initial states, swing, trajectory."""
    priors = problem.priors
    return laid_out(
        priors.estimated.tobytes(), priors.half_normal.tobytes(), problem.basis_position.shape[1]
    )


def trajectory_basis(
    fixes: Fixes, start_s: float, step_s: float, count: int, direction: int, knot_s: float
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """Spline basis at the samples, the receiver's rows, and the coefficients that fit them best.

    Returns (n, b) positions, (n, b) accelerations, (r, b + 1), (r,) and (b + 1,).
    """
    time = start_s + step_s * np.arange(count, dtype=np.float64)
    first = min(float(time[0]), float(fixes.time_s[0]))
    last = max(float(time[-1]), float(fixes.time_s[-1]))
    spans = max(2, round((last - first) / knot_s))
    inner = np.linspace(first, last, spans + 1)
    of = partial(splines.basis, splines.clamped_knots(inner, _DEGREE), _DEGREE)
    # The third derivative is a parabola between knots: two points of Gauss integrate its square
    # well enough for a prior.
    apart = np.diff(inner)
    middles, aside = 0.5 * (inner[1:] + inner[:-1]), apart / np.sqrt(12.0)
    at = np.concatenate([middles - aside, middles + aside])
    weight = np.sqrt(0.5 * np.concatenate([apart, apart])) / _JERK_M_PER_S3
    jerk = of(at, 3) * weight[:, None]
    position = of(fixes.time_s) / fixes.position_noise_m
    velocity = of(fixes.time_s, 1) / fixes.speed_noise_m_per_s
    b = position.shape[1]
    rows = np.zeros((position.shape[0] + velocity.shape[0] + jerk.shape[0] + 1, b + 1))
    m = fixes.time_s.size
    rows[:m, :b] = position
    rows[:m, b] = 1.0 / fixes.position_noise_m
    rows[m : 2 * m, :b] = velocity
    rows[2 * m : -1, :b] = jerk
    rows[-1, b] = 1.0 / fixes.offset_spread_m
    values = np.concatenate(
        [
            fixes.position_m / fixes.position_noise_m,
            fixes.velocity_m_per_s / fixes.speed_noise_m_per_s,
            np.zeros(jerk.shape[0] + 1),
        ]
    )
    best = np.linalg.lstsq(rows, values, rcond=None)[0]
    return of(time), direction * of(time, 2), rows, values, best


def common_gain_spread(priors: Priors) -> float:
    """The spread of the mean of four gains: what is common to them, and the mean of each's own."""
    return float(np.hypot(priors.common_gain_spread, 0.5 * priors.gain_spread))


def rigidity_spread(priors: Priors) -> FloatArray:
    """Spreads of ln EI of the elements that are estimated, (elements,)."""
    return np.asarray(priors.spread[EI_1:][priors.estimated[EI_1:]])


class Values(NamedTuple):
    """What points mean but for the drive and each channel's own errors."""

    theta: FloatArray  # (k, p)
    wheelbase_m: FloatArray  # (k,)
    common_gain: FloatArray  # (k,)


def values_of(problem: Problem, y: FloatArray) -> Values:
    """Truck, bridge and common gain of the points y (k, size)."""
    where = layout(problem)
    priors = problem.priors
    k = y.shape[0]
    p = priors.theta.size
    theta = np.repeat(priors.theta[None, :], k, axis=0)
    values = np.zeros((k, p))
    values[:, priors.estimated] = y[:, where.theta]
    logs = np.flatnonzero(priors.estimated & ~priors.half_normal)
    theta[:, logs] = priors.theta[logs] * np.exp(priors.spread[logs] * values[:, logs])
    zero = np.flatnonzero(priors.estimated & priors.half_normal)
    theta[:, zero] = priors.spread[zero] * values[:, zero]
    return Values(
        theta,
        priors.wheelbase_m * np.exp(priors.wheelbase_spread * y[:, where.wheelbase]),
        np.exp(common_gain_spread(priors) * y[:, where.common_gain]),
    )


def points(problem: Problem, y: FloatArray) -> Points:
    """What the points y (k, size) mean, the truck's place at every sample included."""
    where = layout(problem)
    priors = problem.priors
    told = values_of(problem, y)
    coefficients = y[:, where.trajectory]
    return Points(
        told.theta,
        told.wheelbase_m,
        coefficients @ problem.basis_position.T,
        coefficients @ problem.basis_acceleration.T,
        priors.gain_spread * (y[:, where.gains] @ _CONTRASTS),
        told.common_gain,
        priors.delay_spread_s * y[:, where.delays],
        (y[:, where.initial].reshape(-1, CHANNELS, 3) * _INITIAL_SPREAD),
        y[:, where.swing] * np.repeat(_SWING_M / np.arange(1, SWING_MODES + 1) ** 2, 2),
    )


def data_rows(problem: Problem, y: FloatArray) -> FloatArray:
    """White rows (k, 3 m) of the data alone."""
    out = np.empty((y.shape[0], problem.noise.reciprocal.size))
    evaluate_white(
        problem.crossing, problem.rows, problem.noise, problem.works, points(problem, y), out
    )
    return out


def filtered_rows(problem: Problem, y: FloatArray) -> FloatArray:
    """Rows (3, m) of the data of one point y (size,), filtered and not whitened."""
    (residual,) = evaluate(problem.crossing, problem.works, points(problem, y[None, :]))
    out = np.empty((RESIDUALS, row_count(problem.rows, problem.crossing.rows)))
    for kind in range(RESIDUALS):
        filter_rows(problem.rows.taps, problem.rows.every, residual[kind], out[kind])
    return out


def filtered_rear_road(problem: Problem, y: FloatArray) -> FloatArray:
    """Filtered rows (m,) of what the rear wheel itself feels, of one point y (size,)."""
    crossing, rows = problem.crossing, problem.rows
    at = points(problem, y[None, :])
    heights, _ = roads_and_deflections(crossing, problem.works[0], at, 0)
    out = np.empty(row_count(rows, crossing.rows))
    own = np.ascontiguousarray(heights[1, crossing.first_row :])
    filter_rows(rows.taps, rows.every, own, out)
    return out


def truck_at(problem: Problem, y: FloatArray) -> tuple[Truck, FloatArray]:
    """The truck at y (size,) as noise meets it, and its sensors' densities (4,) with gains."""
    at = points(problem, y[None, :])
    crossing = problem.crossing
    wheelbase = float(at.wheelbase_m[0])
    truck = truck_of(at.theta[0], crossing.total_mass_kg, wheelbase, crossing.is_inertial)
    return truck, problem.density * (1.0 + at.gain[0])


def belief_in_springs(problem: Problem, y: FloatArray) -> float:
    """0 to 1, of the truck at y (size,): how much its springs leave of what the sensors tell."""
    return whitening.belief_in_springs(problem.rows, *truck_at(problem, y), problem.force)


def noise_floor(problem: Problem, y: FloatArray) -> float:
    """So many times its declared power the sensors' noise has, by the truck at y (size,)."""
    body = filtered_rows(problem, y)[1:]
    return whitening.noise_floor(problem.rows, *truck_at(problem, y), body)


def all_rows(problem: Problem, y: FloatArray, temperature: float = 1.0) -> FloatArray:
    """Rows of data, receiver and priors: their squares sum to -2 log posterior + constant.

    At a `temperature` above one the data count as if their noise were so many times what it is.

    The data's noise is itself a function of the truck: a softer damper passes less of it. Whitened
    for one truck, |W e|^2 is expected to be tr(C_0^-1 C(y)) of noise alone and so pulls towards
    trucks that pass less. The slope of that trace is taken off: as a quadratic prior is there
    already, by moving its centre (`noise_slope`, half the slope).
    """
    where = layout(problem)
    data = problem.noise.reciprocal.size
    receiver = data + problem.receiver_values.size
    out = np.empty((y.shape[0], receiver + where.trajectory.start))
    evaluate_white(
        problem.crossing, problem.rows, problem.noise, problem.works, points(problem, y), out
    )
    out[:, data:receiver] = (
        y[:, where.trajectory.start : where.offset + 1] @ problem.receiver_rows.T
    )
    out[:, data:receiver] -= problem.receiver_values
    out[:, receiver:] = y[:, : where.trajectory.start]
    out[:, receiver : receiver + problem.noise_slope.size] -= problem.noise_slope / temperature**2
    if temperature != 1.0:
        out[:, :data] /= temperature
    return out


def log_odds_of_absence(problem: Problem, inflation: float = 1.0) -> FloatArray:
    """For each coordinate of y (size,): what its density at exactly zero is against per unit.

    Of noise `inflation` times as large, with a prior as much wider; minus infinity where there is
    none.
    """
    where, priors = layout(problem), problem.priors
    odds = np.full(where.size, -np.inf)
    odds[where.theta] = log_odds(priors.absence[priors.estimated], inflation)
    return odds


def log_odds(absence: FloatArray, inflation: float = 1.0) -> FloatArray:
    """ln[P / ((1 - P) 2 phi(0))] of probabilities P of absence (k,), beside a half-normal prior."""
    with np.errstate(divide="ignore"):
        return np.asarray(
            np.log(absence) - np.log1p(-absence) + 0.5 * np.log(0.5 * np.pi * inflation**2)
        )


def start(problem: Problem, trajectory: FloatArray) -> FloatArray:
    """Coordinates of the nominal values and of a trajectory (b + 1,)."""
    where = layout(problem)
    y = np.zeros(where.size)
    y[where.trajectory.start :] = trajectory
    return y


def precision_root(jacobian: FloatArray) -> FloatArray:
    """Upper triangle R (f, f) with R'R the Gauss-Newton precision of y."""
    (r,) = qr(jacobian, mode="r")
    f = jacobian.shape[1]
    signs = np.sign(np.diag(r[:f]))
    return np.asarray(signs[:, None] * r[:f])


def covariance(root: FloatArray) -> FloatArray:
    """(R'R)^-1."""
    inverse = solve_triangular(root, np.eye(root.shape[0]))
    return np.asarray(inverse @ inverse.T)


def roads(problem: Problem, y: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Chainage (m,), road (m) under the front and the rear wheel there, for one point y.

    On the bridge only, in the order of the rear wheel's samples. A bias common to all sensors bends
    the whole record into a parabola, and nothing in the residuals shows it at constant speed: so
    the record's own parabola, on the bridge and off, is taken off.
    """
    crossing = problem.crossing
    at = points(problem, y[None, :])
    height, _ = roads_and_deflections(crossing, problem.works[0], at, 0)
    x, front, rear = _at_same_places(crossing, at, height[0], height[1])
    basis = _parabolas(x)
    bend = basis @ (basis.T @ (0.5 * (front + rear)))
    on_bridge = (x >= 0.0) & (x <= crossing.span_m)
    return x[on_bridge], (front - bend)[on_bridge], (rear - bend)[on_bridge]


def _at_same_places(
    crossing: Crossing, at: Points, front_height: FloatArray, rear_height: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Chainage and heights under both wheels wherever the rear wheel follows the front one."""
    sign = 1.0 if crossing.direction > 0 else -1.0
    front = at.position_m[0]
    rear = (front - sign * at.wheelbase_m[0])[crossing.first_row :]
    return (
        rear,
        np.interp(sign * rear, sign * front, front_height),
        rear_height[crossing.first_row :],
    )


def _parabolas(x: FloatArray) -> FloatArray:
    """Orthonormal columns (m, 3) of which all parabolas at x (m,) are made."""
    basis, _ = np.linalg.qr(np.vander((x - x.mean()) / np.ptp(x), 3))
    return np.asarray(basis)


def road_noise(problem: Problem, y: FloatArray, count: int, rng: np.random.Generator) -> FloatArray:
    """Draws (count, m) in m of the error of the wheels' mean road that the sensors' noise makes.

    Where `roads` gives the road for y. White noise of the accelerations goes through the integrals
    and the input estimation of the truck at y; what it does to the deflection is left out.
    """
    crossing = problem.crossing
    at = points(problem, y[None, :])
    theta = at.theta[0]
    n = crossing.signals.shape[2]
    step = crossing.step_s
    spread = problem.density * np.sqrt(0.5 / step)
    truck = truck_of(theta, crossing.total_mass_kg, float(at.wheelbase_m[0]), True)
    x, *_ = _at_same_places(crossing, at, np.zeros(n), np.zeros(n))
    on_bridge = (x >= 0.0) & (x <= crossing.span_m)
    basis = _parabolas(x)
    drawn = []
    for _ in range(count):  # one by one, to bound memory
        a = spread[:, None] * rng.standard_normal((CHANNELS, n))
        z = step * np.cumsum(step * np.cumsum(a, axis=1), axis=1)
        front_error, rear_error = (
            z[2 + w]
            + (m_ii * a[w] + truck.m_12 * a[1 - w] + theta[M_U1 + w] * a[2 + w]) / theta[K_U1 + w]
            for w, m_ii in enumerate((truck.m_11, truck.m_22))
        )
        _, at_front, at_rear = _at_same_places(crossing, at, front_error, rear_error)
        mean = 0.5 * (at_front + at_rear)
        drawn.append((mean - basis @ (basis.T @ mean))[on_bridge])
    return np.stack(drawn)


def largest_deflections_m(problem: Problem, y: FloatArray) -> FloatArray:
    """Largest deflection under a wheel (k,), positive downwards, of the points y (k, size).

    Raises FloatingPointError for an impossible point.
    """
    found = [
        largest_deflections(problem.crossing, problem.works, points(problem, y[n : n + _AT_ONCE]))
        for n in range(0, y.shape[0], _AT_ONCE)
    ]
    largest = np.concatenate(found)
    if np.isnan(largest).any():
        raise FloatingPointError("the bridge of this point has no modes")
    return largest
