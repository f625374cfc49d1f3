"""Consistency of a GNSS receiver's speeds with its positions."""

import numpy as np

from pre_core.arrays import FloatArray

_FEWEST = 4
_DRIFT_S = 300.0
"""Correlation time of a receiver's slow error."""


def speed_scale(
    time_s: FloatArray,
    position_m: FloatArray,
    speed_m_per_s: FloatArray,
    *,
    noise_m: float,
    spread_m: float,
) -> tuple[float, float]:
    """Return the relative excess of the speeds over the positions, and its standard deviation.

    Positions (m,) are modelled as a + b times the integral of the speeds (m,), plus white noise
    with the standard deviation `noise_m` and an exponentially correlated error with `spread_m`. For
    fewer than four fixes the excess is zero and its standard deviation infinite.
    """
    if time_s.size < _FEWEST:
        return 0.0, np.inf
    mean = 0.5 * (speed_m_per_s[1:] + speed_m_per_s[:-1])
    travelled = np.concatenate([[0.0], np.cumsum(mean * np.diff(time_s))])
    apart = np.abs(time_s[:, None] - time_s[None, :])
    covariance = spread_m**2 * np.exp(-apart / _DRIFT_S) + noise_m**2 * np.eye(time_s.size)
    columns = np.stack([np.ones_like(travelled), travelled], axis=1)
    weighted = np.linalg.solve(covariance, columns)
    spread = np.linalg.inv(columns.T @ weighted)
    slope = float((spread @ (weighted.T @ position_m))[1])
    return 1.0 / abs(slope) - 1.0, float(np.sqrt(spread[1, 1]))
