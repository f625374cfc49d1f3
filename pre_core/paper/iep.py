"""Input estimation problem (IEP): the profile under each wheel from its motion.

From the equation of motion of an axle (paper eq. 1, last two rows),

    u_i = z_ui + (m_ui z''_ui + c_si (z'_ui - z'_si) + k_si (z_ui - z_si)) / k_ui,

which is linear in four signals that do not depend on the parameters. Initial displacement, initial
velocity and a constant bias of any channel change these signals by 1, t and t^2 only.
"""

from collections.abc import Callable

import numpy as np

from pre_core.arrays import FloatArray
from pre_core.kernels.lanes import kernel
from pre_core.paper.integrate import IntegratedMotion
from pre_core.parameters import C_S1, K_S1, K_U1, M_U1


def iep_signals(
    acceleration_m_per_s2: FloatArray,
    step_s: float,
    integrate: Callable[[FloatArray, float], IntegratedMotion],
) -> FloatArray:
    """Return the four signals of each wheel: (2, 4, n) z_u, z''_u, z'_u - z'_s, z_u - z_s.

    `acceleration_m_per_s2` is (4, n): sprung front, sprung rear, unsprung front, unsprung rear.
    """
    velocity, displacement = integrate(acceleration_m_per_s2, step_s)
    sprung, unsprung = slice(0, 2), slice(2, 4)
    return np.stack(
        [
            displacement[unsprung],
            acceleration_m_per_s2[unsprung],
            velocity[unsprung] - velocity[sprung],
            displacement[unsprung] - displacement[sprung],
        ],
        axis=1,
    )


@kernel
def iep_factors(theta: FloatArray, wheel: int) -> tuple[float, float, float]:
    """Return the factors m_u/k_u, c_s/k_u and k_s/k_u of z''_u, z'_u - z'_s and z_u - z_s.

    `theta` is one vector (p,).
    """
    k_u = theta[K_U1 + wheel]
    return theta[M_U1 + wheel] / k_u, theta[C_S1 + wheel] / k_u, theta[K_S1 + wheel] / k_u


def input_profiles(signals: FloatArray, theta: FloatArray) -> FloatArray:
    """Return the input profiles u (2, n) of the two wheels for signals (2, 4, n) and theta (p,)."""
    factors = np.array([(1.0, *iep_factors(theta, wheel)) for wheel in range(2)])
    return np.asarray(np.einsum("wj,wjn->wn", factors, signals))
