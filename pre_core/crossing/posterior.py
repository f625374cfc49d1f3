"""Method `pre`: the whitened likelihood of one crossing with its priors.

All parameters are mapped to coordinates y in which their prior is a standard normal
(docs/method-pre.md): logarithms of positive quantities, multiples of the prior's spread for the
others. The trajectory's spline coefficients have no prior of their own but the receiver's fixes.
The sum of squares of all residuals is then -2 log posterior up to a constant, and its Gauss-Newton
curvature the precision of its normal approximation.
"""

from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import qr, solve_triangular

from pre_core.arrays import FloatArray
from pre_core.crossing import noise as _noise
from pre_core.crossing import splines
from pre_core.crossing.arguments import Buffers, EvaluationPoints, GriddedCrossing
from pre_core.crossing.deflection import SWING_MODES
from pre_core.crossing.layout import CHANNELS, ParameterLayout, parameter_layout
from pre_core.crossing.lines import project_out
from pre_core.crossing.mismatch import Mismatch, MismatchSpectra
from pre_core.crossing.noise import NoisePath, force_masses, noise_path
from pre_core.crossing.residuals import (
    evaluate,
    evaluate_white,
    largest_deflections,
    roads_and_deflections,
)
from pre_core.crossing.rows import RESIDUALS, RowFilter, filter_rows, row_count
from pre_core.crossing.whitening import Whitener
from pre_core.parameters import EI_1, K_U1, M_U1
from pre_core.physics.tandem import TandemTruck

# Three directions in which four gains differ; the common gain is separate.
_CONTRASTS = np.array(
    [[0.5, 0.5, -0.5, -0.5], [0.5, -0.5, 0.5, -0.5], [0.5, -0.5, -0.5, 0.5]], dtype=np.float64
)
_INITIAL_SPREAD = np.array([0.1, 0.1, 0.1])  # m, m/s, m/s²: wide; they are nuisances
_SWING_M = 1e-3
"""Scale of the first mode's displacement, and velocity over omega, at its largest point: a 30 t
lorry that left a tenth of a second ago leaves a bridge of 30 m vibrating by a millimetre. For the
second it is a quarter, for the third a ninth, wider than the 1/j^4 by which a static load excites
the j-th mode of a beam."""
_JERK_M_PER_S3 = 1.0
"""Prior RMS jerk of a driver's speed changes."""
_DEGREE = 5
"""Degree of the trajectory spline: load moves with its second derivative, which must not have
kinks."""
_MAX_POINTS = 100
"""Number of points whose trajectories are evaluated at once, which bounds memory."""


class Priors(NamedTuple):
    """Priors of a crossing; relative spreads are those of a log-normal."""

    theta: FloatArray  # (p,) nominal values
    spread: FloatArray  # (p,) relative; absolute where the prior is half-normal
    half_normal: NDArray[np.bool_]  # (p,) at zero; log-normal about the nominal value elsewhere
    estimated: NDArray[np.bool_]  # (p,) the others are fixed at their nominal values
    absence: FloatArray
    """Prior probability (p,) that a parameter with a half-normal prior is zero."""
    wheelbase_m: float
    wheelbase_spread: float  # relative
    gain_spread: float
    """Standard deviation of each channel's gain, independent of the others'."""
    common_gain_spread: float
    """Standard deviation of the part of the gains that all channels share."""
    delay_spread_s: float


class ChainageFixes(NamedTuple):
    """Fixes near the crossing as chainage of the front axle, (m,) each."""

    time_s: FloatArray
    position_m: FloatArray
    velocity_m_per_s: FloatArray
    position_noise_m: float
    speed_noise_m_per_s: float
    offset_spread_m: float
    """Standard deviation of slow error and latency together, common to all fixes."""


class PosteriorProblem(NamedTuple):
    """The constants of a search."""

    crossing: GriddedCrossing
    priors: Priors
    rows: RowFilter
    noise: Whitener
    density: FloatArray  # (4,) one-sided, m/s²/√Hz
    force: FloatArray
    """Suspension noise (2, shapes) of springs and dampers, N²/Hz; see suspension_noise.py."""
    mismatch: Mismatch
    """Profile mismatch; without level where both axles follow one profile."""
    basis_position: FloatArray  # (n, b): trajectory = basis @ coefficients
    basis_acceleration: FloatArray  # (n, b), positive when speeding up
    receiver_rows: FloatArray  # (r, b + 1): rows of (coefficients, offset)
    receiver_values: FloatArray  # (r,)
    noise_slope: FloatArray  # of the first coordinates: see `all_rows`
    works: tuple[Buffers, ...]
    """Work arrays of each thread; modified by every evaluation."""
    lines_hz: tuple[float, ...] = ()
    """Frequencies in the residuals of the removed lines, see `lines`."""
    line_waves: FloatArray = np.zeros((0, 0))
    """(m, w) orthonormal waves of these lines."""
    front_axles: tuple[MismatchSpectra, ...] = ()
    """Spectra of the profile of each axle ahead of a tandem minus that of the tandem."""
    displaced_trucks: tuple[TandemTruck, ...] = ()
    """Trucks with one value of a front axle displaced by the standard deviation of its prior."""


def has_tandem(problem: PosteriorProblem) -> bool:
    """Return whether a tandem's axles are compared; the body then has no equations."""
    return problem.crossing.tandem.ahead_m > 0.0


def layout(problem: PosteriorProblem) -> ParameterLayout:
    """Return the layout: truck and bridge, channels, initial vibration, and trajectory."""
    priors = problem.priors
    return parameter_layout(
        priors.estimated.tobytes(), priors.half_normal.tobytes(), problem.basis_position.shape[1]
    )


def trajectory_basis(
    fixes: ChainageFixes, start_s: float, step_s: float, count: int, direction: int, knot_s: float
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return the trajectory's bases at the samples, the receiver's residuals, and their best fit.

    The bases (n, b) give position and acceleration of `count` = n samples for b coefficients. The
    residuals are rows (r, b + 1) times coefficients and offset, minus values (r,): of the fixes and
    of the priors of jerk and offset. The best fit is (b + 1,).
    """
    time = start_s + step_s * np.arange(count, dtype=np.float64)
    first = min(float(time[0]), float(fixes.time_s[0]))
    last = max(float(time[-1]), float(fixes.time_s[-1]))
    spans = max(2, round((last - first) / knot_s))
    inner = np.linspace(first, last, spans + 1)
    of = partial(splines.basis, splines.clamped_knots(inner, _DEGREE), _DEGREE)
    # The third derivative is a parabola between knots: Gauss quadrature at two points integrates
    # its square well enough for a prior.
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
    """Return the standard deviation of the mean of four gains, common and individual parts."""
    return float(np.hypot(priors.common_gain_spread, 0.5 * priors.gain_spread))


def rigidity_spread(priors: Priors) -> FloatArray:
    """Return the standard deviations of ln EI of the estimated elements, (elements,)."""
    return np.asarray(priors.spread[EI_1:][priors.estimated[EI_1:]])


class PhysicalValues(NamedTuple):
    """Physical values of points, without trajectory and the channels' own errors."""

    theta: FloatArray  # (k, p)
    wheelbase_m: FloatArray  # (k,)
    common_gain: FloatArray  # (k,)


def values_of(problem: PosteriorProblem, y: FloatArray) -> PhysicalValues:
    """Return truck, bridge and common gain of the points y (k, f)."""
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
    return PhysicalValues(
        theta,
        priors.wheelbase_m * np.exp(priors.wheelbase_spread * y[:, where.wheelbase]),
        np.exp(common_gain_spread(priors) * y[:, where.common_gain]),
    )


def points(problem: PosteriorProblem, y: FloatArray) -> EvaluationPoints:
    """Return the physical points of y (k, f), with the truck's chainage at every sample."""
    where = layout(problem)
    priors = problem.priors
    values = values_of(problem, y)
    coefficients = y[:, where.trajectory]
    return EvaluationPoints(
        values.theta,
        values.wheelbase_m,
        coefficients @ problem.basis_position.T,
        coefficients @ problem.basis_acceleration.T,
        priors.gain_spread * (y[:, where.gains] @ _CONTRASTS),
        values.common_gain,
        priors.delay_spread_s * y[:, where.delays],
        (y[:, where.initial].reshape(-1, CHANNELS, 3) * _INITIAL_SPREAD),
        y[:, where.swing] * np.repeat(_SWING_M / np.arange(1, SWING_MODES + 1) ** 2, 2),
    )


def data_rows(problem: PosteriorProblem, y: FloatArray) -> FloatArray:
    """Return whitened residuals (k, 3 m) of the data alone, for y (k, f)."""
    out = np.empty((y.shape[0], problem.noise.reciprocal.size))
    evaluate_white(
        problem.crossing, problem.rows, problem.noise, problem.works, points(problem, y), out
    )
    return out


def filtered_rows(problem: PosteriorProblem, y: FloatArray) -> FloatArray:
    """Return residuals (3, m) of the data at one point y (f,), filtered and not whitened."""
    (residual,) = evaluate(problem.crossing, problem.works, points(problem, y[None, :]))
    out = np.empty((RESIDUALS, row_count(problem.rows, problem.crossing.rows)))
    for kind in range(RESIDUALS):
        filter_rows(problem.rows.taps, problem.rows.every, residual[kind], out[kind])
    return project_out(problem.line_waves, out) if problem.lines_hz else out


def filtered_rear_road(problem: PosteriorProblem, y: FloatArray) -> FloatArray:
    """Return filtered residuals (m,) of the rear wheel's own profile, at one point y (f,)."""
    crossing, rows = problem.crossing, problem.rows
    at = points(problem, y[None, :])
    heights, _ = roads_and_deflections(crossing, problem.works[0], at, 0)
    out = np.empty(row_count(rows, crossing.rows))
    own = np.ascontiguousarray(heights[1, crossing.first_row :][: crossing.rows])
    filter_rows(rows.taps, rows.every, own, out)
    return project_out(problem.line_waves, out) if problem.lines_hz else out


def noise_path_at(problem: PosteriorProblem, y: FloatArray) -> tuple[NoisePath, FloatArray]:
    """Return the truck's noise path at y (f,), and its sensors' densities (4,) with gains."""
    at = points(problem, y[None, :])
    crossing = problem.crossing
    truck = noise_path(
        at.theta[0],
        crossing.total_mass_kg,
        float(at.wheelbase_m[0]),
        crossing.is_inertial,
        crossing.tandem,
        problem.mismatch.speed_m_per_s,
    )
    return truck, problem.density * (1.0 + at.gain[0])


def suspension_equation_weight(problem: PosteriorProblem, y: FloatArray) -> float:
    """Return the weight of the body equations, 0 to 1, at y (f,); 0 for an equalised tandem."""
    if has_tandem(problem) and problem.crossing.tandem.is_equalised:
        return 0.0
    return _noise.suspension_equation_weight(
        problem.rows, *noise_path_at(problem, y), problem.force
    )


def noise_power_ratio(problem: PosteriorProblem, y: FloatArray) -> float:
    """Return the ratio of sensor noise power to its declared value, for the truck at y (f,)."""
    body = filtered_rows(problem, y)[1:]
    return _noise.noise_power_ratio(problem.rows, *noise_path_at(problem, y), body)


def all_rows(problem: PosteriorProblem, y: FloatArray, temperature: float = 1.0) -> FloatArray:
    """Return residuals (k, rows) of data, receiver and priors: squares sum to -2 log posterior.

    A `temperature` above one multiplies the noise of the data.

    The data's noise is itself a function of the truck: a softer damper transmits less of it.
    Whitened for one truck, |W e|^2 has the expectation tr(C_0^-1 C(y)) for noise alone and so
    biases the search towards trucks that transmit less. The gradient of that trace is subtracted:
    by shifting the centre of the existing quadratic priors (`noise_slope`, half the gradient).
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


def log_odds_of_absence(problem: PosteriorProblem, inflation: float = 1.0) -> FloatArray:
    """Return the log ratio (f,) of the point mass at zero to the prior density at zero.

    The noise is `inflation` times as large and the prior as much wider. The ratio is minus infinity
    for coordinates that cannot be absent.
    """
    where, priors = layout(problem), problem.priors
    odds = np.full(where.size, -np.inf)
    odds[where.theta] = log_odds(priors.absence[priors.estimated], inflation)
    return odds


def log_odds(absence: FloatArray, inflation: float = 1.0) -> FloatArray:
    """Return ln[P / ((1 - P) 2 phi(0))] of probabilities P (k,), for a half-normal prior."""
    with np.errstate(divide="ignore"):
        return np.asarray(
            np.log(absence) - np.log1p(-absence) + 0.5 * np.log(0.5 * np.pi * inflation**2)
        )


def starting_point(problem: PosteriorProblem, trajectory: FloatArray) -> FloatArray:
    """Return the coordinates (f,) of the nominal values and of a trajectory (b + 1,)."""
    where = layout(problem)
    y = np.zeros(where.size)
    y[where.trajectory.start :] = trajectory
    return y


def precision_root(jacobian: FloatArray) -> FloatArray:
    """Return the upper triangle R (f, f) with R'R the Gauss-Newton precision of y."""
    (r,) = qr(jacobian, mode="r")
    f = jacobian.shape[1]
    signs = np.sign(np.diag(r[:f]))
    return np.asarray(signs[:, None] * r[:f])


def posterior_covariance(root: FloatArray) -> FloatArray:
    """Return (R'R)^-1 for a root R (f, f)."""
    inverse = solve_triangular(root, np.eye(root.shape[0]))
    return np.asarray(inverse @ inverse.T)


def wheel_profiles(
    problem: PosteriorProblem, y: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return chainage (m,) and profiles (m,) under both wheels there, at one point y (f,).

    Chainages are on the bridge only, in the order of the rear wheel's samples. A bias common to all
    sensors bends the whole record into a parabola, which residuals at constant speed do not show:
    so the parabola of the whole record is subtracted.
    """
    crossing = problem.crossing
    at = points(problem, y[None, :])
    height, _ = roads_and_deflections(crossing, problem.works[0], at, 0)
    x, front, rear = _align_profiles(crossing, at, height[0], height[1])
    basis = _parabolas(x)
    bend = basis @ (basis.T @ (0.5 * (front + rear)))
    on_bridge = (x >= 0.0) & (x <= crossing.span_m)
    return x[on_bridge], (front - bend)[on_bridge], (rear - bend)[on_bridge]


def _align_profiles(
    crossing: GriddedCrossing,
    at: EvaluationPoints,
    front_height: FloatArray,
    rear_height: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return chainage and heights under both wheels where the rear wheel follows the front."""
    sign = 1.0 if crossing.direction > 0 else -1.0
    front = at.position_m[0]
    rear = (front - sign * at.wheelbase_m[0])[crossing.first_row :]
    return (
        rear,
        np.interp(sign * rear, sign * front, front_height),
        rear_height[crossing.first_row :],
    )


def _parabolas(x: FloatArray) -> FloatArray:
    """Return orthonormal columns (m, 3) that span all parabolas at x (m,)."""
    basis, _ = np.linalg.qr(np.vander((x - x.mean()) / np.ptp(x), 3))
    return np.asarray(basis)


def road_noise(
    problem: PosteriorProblem, y: FloatArray, count: int, rng: np.random.Generator
) -> FloatArray:
    """Return draws (count, m) in m of the error that sensor noise causes in the mean profile.

    Its chainages are those of `wheel_profiles` for y (f,). White noise of the accelerations
    passes the integrals and the input estimation of the truck at y; its effect on the deflection is
    omitted.
    """
    crossing = problem.crossing
    at = points(problem, y[None, :])
    theta = at.theta[0]
    n = crossing.signals.shape[2]
    step = crossing.step_s
    spread = problem.density * np.sqrt(0.5 / step)
    total, tandem = crossing.total_mass_kg, crossing.tandem
    truck = noise_path(theta, total, float(at.wheelbase_m[0]), True, tandem)
    force = force_masses(truck)
    x, *_ = _align_profiles(crossing, at, np.zeros(n), np.zeros(n))
    on_bridge = (x >= 0.0) & (x <= crossing.span_m)
    basis = _parabolas(x)
    drawn = []
    for _ in range(count):  # one by one, to bound memory
        a = spread[:, None] * rng.standard_normal((CHANNELS, n))
        z = step * np.cumsum(step * np.cumsum(a, axis=1), axis=1)
        front_error, rear_error = (
            z[2 + w]
            + (force[w, w] * a[w] + force[w, 1 - w] * a[1 - w] + theta[M_U1 + w] * a[2 + w])
            / theta[K_U1 + w]
            for w in range(2)
        )
        _, at_front, at_rear = _align_profiles(crossing, at, front_error, rear_error)
        mean = 0.5 * (at_front + at_rear)
        drawn.append((mean - basis @ (basis.T @ mean))[on_bridge])
    return np.stack(drawn)


def largest_deflections_m(problem: PosteriorProblem, y: FloatArray) -> FloatArray:
    """Return the largest deflection under a wheel (k,), positive downwards, for y (k, f).

    Raise FloatingPointError for an impossible point.
    """
    found = [
        largest_deflections(
            problem.crossing, problem.works, points(problem, y[n : n + _MAX_POINTS])
        )
        for n in range(0, y.shape[0], _MAX_POINTS)
    ]
    largest = np.concatenate(found)
    if np.isnan(largest).any():
        raise FloatingPointError("the bridge of this point has no modes")
    return largest
