"""Free vibration of the bridge after a constant force has crossed it and left.

Each mode is an oscillator under -W phi(x(t)), which along an element is a cubic polynomial in time.
Particular solution and free motion are known in closed form, so the result does not depend on a
time step.
"""

import numpy as np

from pre_core.arrays import FloatArray
from pre_core.physics.bridge import Beam, Modes, element_cubics, supported_nodes


def free_motion(modes: Modes, state: FloatArray, seconds: float) -> FloatArray:
    """Return the state (2, k), displacement and velocity, after `seconds` without a force."""
    r = -0.5 * modes.damping_per_s
    s = np.sqrt(r * r - modes.eigenvalues_per_s2 + 0j)
    # Add exponents first: the hyperbolic cosine of an overdamped mode would overflow.
    forth, back = np.exp((r + s) * seconds), np.exp((r - s) * seconds)
    cosine, sine = 0.5 * (forth + back), 0.5 * (forth - back) / s
    start, rate = state[0], state[1] - r * state[0]
    q = cosine * start + sine * rate
    return np.stack([q.real, (r * q + s * s * sine * start + cosine * rate).real])


def free_vibration_after(
    beam: Beam, modes: Modes, weight_n: float, speed_m_per_s: float, seconds: float
) -> FloatArray:
    """Return the modal state (2, k), `seconds` after the force has left a bridge that was at rest.

    The sign of the speed is that of `simulate.Motion`: negative from the bridge's end to its start.
    """
    lengths = beam.element_lengths_m
    cubics = element_cubics(lengths, supported_nodes(beam), modes.shapes)
    elements = range(lengths.size)
    state = np.zeros((2, modes.eigenvalues_per_s2.size))
    for e in elements if speed_m_per_s > 0.0 else reversed(elements):
        c = cubics[e]
        if speed_m_per_s < 0.0:  # local coordinate, counted from the far end of the element
            c = np.array(
                [
                    c[0] + c[1] + c[2] + c[3],
                    -c[1] - 2.0 * c[2] - 3.0 * c[3],
                    c[2] + 3.0 * c[3],
                    -c[3],
                ]
            )
        rate = abs(speed_m_per_s) / lengths[e]
        force = -weight_n * c * rate ** np.arange(4)[:, None]
        state = _along_element(modes, state, force, 1.0 / rate)
    return free_motion(modes, state, seconds)


def _along_element(
    modes: Modes, state: FloatArray, force: FloatArray, seconds: float
) -> FloatArray:
    """Return the state after `seconds` of a force (4, k) of 1, t, t^2, t^3 per mode."""
    c, eigenvalues = modes.damping_per_s, modes.eigenvalues_per_s2
    a_3 = force[3] / eigenvalues
    a_2 = (force[2] - 3.0 * c * a_3) / eigenvalues
    a_1 = (force[1] - 2.0 * c * a_2 - 6.0 * a_3) / eigenvalues
    a_0 = (force[0] - c * a_1 - 2.0 * a_2) / eigenvalues

    def particular(t: float) -> FloatArray:
        return np.stack(
            [((a_3 * t + a_2) * t + a_1) * t + a_0, (3.0 * a_3 * t + 2.0 * a_2) * t + a_1]
        )

    return free_motion(modes, state - particular(0.0), seconds) + particular(seconds)
