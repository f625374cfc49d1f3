"""Expected size of the difference of two road profiles, from sensor noise and profile mismatch."""

from typing import Final

import numpy as np

from pre_core.constants import NORMAL_975, STANDARD_GRAVITY_M_PER_S2
from schemas.results import CrossingResult, RoadMismatch, RoadResult
from schemas.site import Site
from services.common.arrays import Floats
from services.finding.placed import middle_sensor

TREND_DEGREE: Final = 3
"""Degree of the trend that is removed: it takes the drift of twice integrated noise."""


def expected_reach_m(
    crossing: CrossingResult, road: RoadResult, site: Site | None
) -> Floats | None:
    """Return the half width (n,) of the 95 % band of front_m − rear_m about its cubic trend.

    Noise of the axles' accelerometers, white and of the declared density, integrates twice to a
    process with the covariance q (a³/3 + a² |s − t|/2), where a is the earlier of the times s and t
    and q half the one-sided spectrum. The profile mismatch has the spectrum of `RoadMismatch`.
    None if there is neither: without a site file the noise is unknown. Other errors are not in it.
    """
    x_m = np.asarray(road.x_m)
    covariance = np.zeros((x_m.size, x_m.size))
    if road.mismatch is not None:
        covariance += _of_mismatch(x_m, road.mismatch)
    if site is not None:
        vehicle = site.vehicle(crossing.vehicle)
        density = middle_sensor(site.sensor, vehicle).noise_density_ug_per_rthz[-2:]
        covariance += _of_noise((x_m - x_m[0]) / crossing.speed_m_per_s, density)
    if not covariance.any():
        return None
    basis, _ = np.linalg.qr(np.vander(x_m - x_m.mean(), TREND_DEGREE + 1))
    remove = np.eye(x_m.size) - basis @ basis.T
    variance = np.einsum("ij,jk,ik->i", remove, covariance, remove, optimize=True)
    return np.asarray(NORMAL_975 * np.sqrt(np.maximum(variance, 0.0)))


def _of_noise(time_s: Floats, density_ug_per_rthz: tuple[float, ...]) -> Floats:
    """Return the covariance (n, n) in m² of the difference of two twice integrated readings."""
    density = 1e-6 * STANDARD_GRAVITY_M_PER_S2 * np.array(density_ug_per_rthz)
    earlier = np.minimum.outer(time_s, time_s)
    apart = np.abs(np.subtract.outer(time_s, time_s))
    both = float(np.sum(0.5 * density**2))
    return np.asarray(both * (earlier**3 / 3.0 + earlier**2 * apart / 2.0))


def _of_mismatch(x_m: Floats, mismatch: RoadMismatch) -> Floats:
    """Return the covariance (n, n) in m² of the mismatch, whose points are all on the bridge."""
    decay = 2.0 * np.pi * mismatch.n_0_per_m
    apart = decay * np.abs(np.subtract.outer(x_m, x_m))
    variance = 0.25 * np.pi * mismatch.A_m3 * mismatch.n_0_per_m
    on_bridge = (mismatch.bridge_ratio or 1.0) ** 2
    return np.asarray(on_bridge * variance * (1.0 + apart) * np.exp(-apart))
