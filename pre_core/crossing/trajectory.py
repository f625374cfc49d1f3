"""Trajectory of the front axle: a smooth curve through a receiver's fixes.

The curve is a cubic B-spline x(t) that minimises

    sum ((x(t_i) - x_i)/s_x)^2 + sum ((x'(t_i) - v_i)/s_v)^2 + integral (x'''/s_j)^2 dt,

which leaves constant speed and constant acceleration unpenalised (P-splines; Eilers and Marx 1996).
"""

import numpy as np
from scipy.linalg import lstsq

from pre_core.arrays import FloatArray
from pre_core.crossing.splines import Spline, basis, clamped_knots, value_at
from pre_core.physics.simulate import Motion

_KNOT_SPACING_S = 0.5
_JERK_M_PER_S3 = 0.3
"""Scale s_j of the jerk of a steadily driven truck: root of its square integrated over a second."""


def fit_trajectory(
    time_s: FloatArray,
    position_m: FloatArray,
    velocity_m_per_s: FloatArray,
    *,
    position_noise_m: float,
    speed_noise_m_per_s: float,
    start_s: float,
    stop_s: float,
) -> Spline:
    """Return x(t) over [start, stop] fitted to fixes (m,) of position and signed velocity.

    Raise ValueError for fewer than two fixes.
    """
    if time_s.size < 2:
        raise ValueError("a trajectory needs at least two fixes")
    degree = 3
    first = min(start_s, float(time_s[0]))
    last = max(stop_s, float(time_s[-1]))
    spans = max(1, round((last - first) / _KNOT_SPACING_S))
    inner = np.linspace(first, last, spans + 1)
    knots = clamped_knots(inner, degree)
    # The third derivative of a cubic spline is constant between knots.
    middles = 0.5 * (inner[1:] + inner[:-1])
    jerk = basis(knots, degree, middles, 3) * np.sqrt(np.diff(inner))[:, None]
    fixes = np.vstack([basis(knots, degree, time_s, order) for order in (0, 1)])
    weight = np.concatenate(
        [
            np.full(time_s.size, 1.0 / position_noise_m),
            np.full(time_s.size, 1.0 / speed_noise_m_per_s),
        ]
    )
    # Fit relative to the straight line through the fixes, to keep the digits of small numbers.
    line = np.polynomial.Polynomial.fit(time_s, position_m, 1)
    measured = np.concatenate([position_m - line(time_s), velocity_m_per_s - line.deriv()(time_s)])
    system = np.vstack([fixes * weight[:, None], jerk / _JERK_M_PER_S3])
    right = np.concatenate([measured * weight, np.zeros(jerk.shape[0])])
    coefficients = lstsq(system, right)[0]
    greville = np.lib.stride_tricks.sliding_window_view(knots[1:-1], degree).mean(axis=1)
    return Spline(knots, coefficients + line(greville), degree)


def motion_at(trajectory: Spline, time_s: FloatArray, direction: int) -> Motion:
    """Return position, speed and acceleration of the front axle at times (n,).

    The acceleration is positive when speeding up.
    """
    return Motion(
        value_at(trajectory, time_s),
        value_at(trajectory, time_s, 1),
        direction * value_at(trajectory, time_s, 2),
    )


def arrival_time_s(
    trajectory: Spline, position_m: float, direction: int, start_s: float, stop_s: float
) -> float:
    """Return the first time from `start_s` to `stop_s` at which the front axle reaches a chainage.

    NaN if it does not.
    """
    t = np.linspace(start_s, stop_s, max(2, round((stop_s - start_s) / 0.01) + 1))
    beyond = direction * (value_at(trajectory, t) - position_m) >= 0.0
    first = int(np.argmax(beyond))
    if not beyond[first]:
        return float("nan")
    if first == 0:
        return float(t[0])
    low, high = float(t[first - 1]), float(t[first])
    for _ in range(60):
        middle = 0.5 * (low + high)
        if direction * (value_at(trajectory, np.array([middle]))[0] - position_m) >= 0.0:
            high = middle
        else:
            low = middle
    return high
