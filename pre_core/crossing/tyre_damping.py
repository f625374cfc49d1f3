"""Kernel for the deflection of a damped tyre under a sampled force.

The deflection d of a tyre of stiffness k and damping c under the force F obeys k d + c d' = F. With
tau = c/k its exact solution over a step h is

    k d(t + h) = exp(-h/tau) k d(t) + integral of exp(-(h - s)/tau) F(t + s)/tau ds, s from 0 to h.

F between two samples is the polynomial through the ten nearest ones, so that each step is a
recursion whose weights depend on tau/h alone. Its error is that of the interpolation, 2e-5 of F at
an eighth of the sampling rate, for any damping. A series in tau would need tau times the angular
frequency to be small: it is 0.4 for a tyre of 1.5 ms at 42 Hz.
"""

from typing import Final

import numpy as np

from pre_core.arrays import FloatArray
from pre_core.kernels.lanes import inner

_BEFORE, _POINTS = 4, 10
"""Number of samples before the one at which a step begins, and of all that the polynomial uses."""
_POWERS: Final = np.linalg.inv(
    np.vander(np.arange(-_BEFORE, _POINTS - _BEFORE, dtype=np.float64), increasing=True)
)
"""Coefficients (powers, samples) of the polynomial through samples at whole steps."""
_FORWARD = 0.5
"""Ratio tau/h up to which the recursion of the moments is stable forwards; above it, backwards."""
_BACKWARD_FROM = 40


@inner
def _moments(lag_steps: float, moments: FloatArray) -> None:
    """Write the integrals of exp(-(1 - s)/r) s^m / r over s from 0 to 1 to `moments` (m,).

    r > 0 is `lag_steps`. By parts I_m = 1 - m r I_(m - 1), and I_0 = 1 - exp(-1/r).
    """
    if lag_steps <= _FORWARD:
        moments[0] = 1.0 - np.exp(-1.0 / lag_steps)
        for m in range(1, moments.size):
            moments[m] = 1.0 - m * lag_steps * moments[m - 1]
        return
    value = 0.0
    for m in range(_BACKWARD_FROM, 0, -1):
        value = (1.0 - value) / (m * lag_steps)
        if m <= moments.size:
            moments[m - 1] = value


@inner
def add_tyre_damping(force: FloatArray, lag_steps: float, soft: float, road: FloatArray) -> None:
    """Add to `road` (n,), the negative profile, the part of a tyre's deflection due to damping.

    `force` (n,) is the tyre's compressive force, `lag_steps` tau over the step, `soft` 1/k. At both
    ends, where samples are missing, the force is linear between two of them. Negative damping, by
    which a search passes zero, has the opposite effect of positive one.
    """
    if lag_steps == 0.0:
        return
    if lag_steps < 0.0:
        lag_steps, soft = -lag_steps, -soft
    moments, weights = np.empty(_POINTS), np.zeros(_POINTS)
    _moments(lag_steps, moments)
    for m in range(_POINTS):
        for j in range(_POINTS):
            weights[j] += moments[m] * _POWERS[m, j]
    kept = np.exp(-1.0 / lag_steps)
    n = force.size
    strained = force[0]
    for i in range(1, n):
        first = i - 1 - _BEFORE
        if first >= 0 and first + _POINTS <= n:
            given = 0.0
            for j in range(_POINTS):
                given += weights[j] * force[first + j]
        else:
            given = moments[0] * force[i - 1] + moments[1] * (force[i] - force[i - 1])
        strained = kept * strained + given
        road[i] += (force[i] - strained) * soft
