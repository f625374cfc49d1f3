"""Newmark's method with average acceleration (gamma = 1/2, beta = 1/4; paper Tables 4 and 6).

The scheme is implemented twice: with full matrices, and mode by mode. With Rayleigh damping both
agree to rounding, so that the modal one may be used where speed matters.
"""

from typing import NamedTuple

import numpy as np

from pre_core.arrays import FloatArray
from pre_core.kernels.lanes import compiled


class Response(NamedTuple):
    """Displacement, velocity and acceleration, each (steps, degrees of freedom)."""

    displacement: FloatArray
    velocity: FloatArray
    acceleration: FloatArray


def _march(
    damping: FloatArray,
    stiffness: FloatArray,
    inverse: FloatArray,
    force: FloatArray,
    step_s: float,
    response: Response,
) -> None:
    u, v, a = response
    for n in range(1, force.shape[0]):
        u_guess = u[n - 1] + step_s * v[n - 1] + 0.25 * step_s**2 * a[n - 1]
        v_guess = v[n - 1] + 0.5 * step_s * a[n - 1]
        a[n] = inverse @ (force[n] - damping @ v_guess - stiffness @ u_guess)
        u[n] = u_guess + 0.25 * step_s**2 * a[n]
        v[n] = v_guess + 0.5 * step_s * a[n]


def newmark(
    mass: FloatArray,
    damping: FloatArray,
    stiffness: FloatArray,
    force: FloatArray,
    step_s: float,
    displacement: FloatArray | None = None,
    velocity: FloatArray | None = None,
) -> Response:
    """Integrate M u'' + C u' + K u = f.

    Matrices are (d, d), `force` is (steps, d) at the times 0, step, 2 step, …; the initial
    displacement and velocity default to zero, the initial acceleration follows from the equation of
    motion at the first step.
    """
    u = np.zeros_like(force)
    v = np.zeros_like(force)
    a = np.zeros_like(force)
    if displacement is not None:
        u[0] = displacement
    if velocity is not None:
        v[0] = velocity
    a[0] = np.linalg.solve(mass, force[0] - damping @ v[0] - stiffness @ u[0])
    effective = mass + 0.5 * step_s * damping + 0.25 * step_s**2 * stiffness
    inverse = np.asarray(np.linalg.inv(effective), dtype=np.float64)
    response = Response(u, v, a)
    _march(damping, stiffness, inverse, force, step_s, response)
    return response


@compiled()
def newmark_modal(
    eigenvalues_per_s2: FloatArray, damping_per_s: FloatArray, force: FloatArray, step_s: float
) -> FloatArray:
    """Return modal displacements (steps, k) from rest for forces (steps, k) and unit masses."""
    steps, count = force.shape
    q = np.zeros((steps, count))
    for k in range(count):
        eigenvalue = eigenvalues_per_s2[k]
        damping = damping_per_s[k]
        effective = 1.0 + 0.5 * step_s * damping + 0.25 * step_s**2 * eigenvalue
        velocity = 0.0
        acceleration = force[0, k]
        for n in range(1, steps):
            q_guess = q[n - 1, k] + step_s * velocity + 0.25 * step_s**2 * acceleration
            v_guess = velocity + 0.5 * step_s * acceleration
            acceleration = (force[n, k] - damping * v_guess - eigenvalue * q_guess) / effective
            q[n, k] = q_guess + 0.25 * step_s**2 * acceleration
            velocity = v_guess + 0.5 * step_s * acceleration
    return q
