"""Spectra of suspension noise, which friction and nonlinear dampers cause, as basis functions."""

import numpy as np

from pre_core.arrays import FloatArray

REDUCED_WEIGHT_SPRING_N_PER_M = 4e5
"""Divisor of body equations with reduced weight. Divided by the estimated stiffness, the suspension
noise would decrease with it: a bias that can be corrected only as well as its level is
known. (Friction of 2 to 10 %: EI 0.4 standard deviations too low.) With full weight the divisor is
the stiffness: the sensor noise is known."""
REDUCED_WEIGHT_FACTOR = 100.0
"""Factor of the suspension noise where the equations' weight is reduced. Friction is not noise: it
follows the truck's motion, and could pass for a heavier axle or another centre of gravity. Without
the factor EI was 0.34 standard deviations too low (the median of 36 crossings with friction) and
the coverage 93 %; with it 0.09 and 97 %, with intervals of the same width."""
_FORCE_CENTRES_HZ = np.arange(0.0, 60.0, 4.0)
FORCE_SHAPES = _FORCE_CENTRES_HZ.size
"""Number of basis functions, a few hertz wide, in the spectrum of the suspension noise: that of dry
friction falls by six decades from the body's bounce to the residuals' highest frequency."""
FORCE_MEMORY_S = 0.3
"""Lag in s beyond which the suspension noise has no covariance; it sets the width of its shapes."""


def force_rms_n(force: FloatArray) -> FloatArray:
    """Return the root mean squares (2,) in N of suspension noise `force` (2, shapes)."""
    hz = np.linspace(0.0, 2.0 * _FORCE_CENTRES_HZ[-1], 1000)
    density = force @ force_shapes(np.asarray(2.0 * np.pi * hz))
    return np.asarray(np.sqrt(np.trapezoid(density, hz, axis=1)))


def force_shapes(omega: FloatArray) -> FloatArray:
    """Return the spectra (shapes, f) of B(t) cos(omega_k t), B the Bohman window; maxima 1/2.

    B is the half wave cos(pi t/T) convolved with itself, so its spectrum is a square.
    """
    centre = 2.0 * np.pi * _FORCE_CENTRES_HZ[:, None]
    return _bohman(omega - centre) + _bohman(omega + centre)


def _bohman(omega: FloatArray) -> FloatArray:
    """Return the spectrum of the Bohman window ending at +-`FORCE_MEMORY_S`; its maximum is 1/2."""
    turn = omega * FORCE_MEMORY_S
    apart = 1.0 - (turn / np.pi) ** 2
    near = np.abs(apart) < 1e-6
    wave = np.where(near, 0.25 * np.pi, np.cos(0.5 * turn) / np.where(near, 1.0, apart))
    return np.asarray(0.5 * wave**2)
