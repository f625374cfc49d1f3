"""The four accelerations as smooth functions of time: what is integrated, differentiated, shifted.

A cubic spline through the samples gives velocity and displacement by its antiderivatives and the
jerk by its derivative; with them a channel can be moved by a small delay without interpolating it
anew, by Taylor's series.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import make_interp_spline

FloatArray = NDArray[np.float64]

Z, V, A, A_1, A_2 = range(5)
"""Places of displacement, velocity, acceleration and its two derivatives."""
_DEGREE = 5


def channel_signals(acceleration_m_per_s2: FloatArray, step_s: float) -> FloatArray:
    """Displacement, velocity, acceleration, jerk and its rate (4, 5, n) of samples (4, n).

    Integrals begin at zero in the middle of the record, so that what unknown initial values add is
    as small as can be.
    """
    n = acceleration_m_per_s2.shape[1]
    t = step_s * np.arange(n)
    middle = t[n // 2]
    spline = make_interp_spline(t, acceleration_m_per_s2, k=_DEGREE, axis=1)
    velocity = spline.antiderivative(1)
    displacement = spline.antiderivative(2)
    v, z = velocity(t), displacement(t)
    v_middle, z_middle = velocity(middle)[:, None], displacement(middle)[:, None]
    z = z - z_middle - v_middle * (t - middle)
    return np.ascontiguousarray(
        np.stack([z, v - v_middle, spline(t), spline(t, 1), spline(t, 2)], axis=1)
    )
