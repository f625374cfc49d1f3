"""Deflections of a bridge under static loads."""

import numpy as np

from pre_core.arrays import FloatArray
from pre_core.physics.bridge import Beam, interpolation_matrix, stiffness_matrix


def static_deflection_m(
    beam: Beam, load_x_m: FloatArray, load_n: FloatArray, x_m: FloatArray
) -> FloatArray:
    """Return the deflection (m,) at `x_m` (m,) under static loads (k,), up positive like these."""
    force = interpolation_matrix(beam, load_x_m).T @ np.asarray(load_n, dtype=np.float64)
    return np.asarray(
        interpolation_matrix(beam, x_m) @ np.linalg.solve(stiffness_matrix(beam), force)
    )
