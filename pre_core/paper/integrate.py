"""Integration of accelerations to velocities and displacements.

The paper integrates with Newmark's average acceleration, which reproduces a simulation by the same
scheme and step exactly and thus hides its own error. For samples of real sensors the antiderivative
of a cubic spline is far better (studies/reproduction.md measures both).
"""

from typing import NamedTuple

import numpy as np

from pre_core.arrays import FloatArray
from pre_core.kernels.lanes import compiled


class IntegratedMotion(NamedTuple):
    """Velocity and displacement, both zero at the first sample; the shape of the input."""

    velocity: FloatArray
    displacement: FloatArray


@compiled()
def _newmark(acceleration: FloatArray, step_s: float, v: FloatArray, u: FloatArray) -> None:
    for i in range(acceleration.shape[0]):
        for n in range(1, acceleration.shape[1]):
            a_before = acceleration[i, n - 1]
            a = acceleration[i, n]
            v[i, n] = v[i, n - 1] + 0.5 * step_s * (a_before + a)
            u[i, n] = u[i, n - 1] + step_s * v[i, n - 1] + 0.25 * step_s**2 * (a_before + a)


def newmark_integrate(acceleration: FloatArray, step_s: float) -> IntegratedMotion:
    """Integrate rows of evenly spaced samples (channels, n) twice by Newmark's scheme."""
    acceleration = np.ascontiguousarray(acceleration)
    v = np.zeros_like(acceleration)
    u = np.zeros_like(acceleration)
    _newmark(acceleration, step_s, v, u)
    return IntegratedMotion(v, u)


def spline_integrate(acceleration: FloatArray, step_s: float) -> IntegratedMotion:
    """Integrate rows of evenly spaced samples (channels, n) twice through a cubic spline."""
    from scipy.interpolate import CubicSpline  # slow to import; only the paper's method needs it

    t = step_s * np.arange(acceleration.shape[1])
    spline = CubicSpline(t, acceleration, axis=1)
    return IntegratedMotion(
        np.asarray(spline.antiderivative(1)(t)), np.asarray(spline.antiderivative(2)(t))
    )
