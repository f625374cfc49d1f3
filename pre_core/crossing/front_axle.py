"""Noise from the front axle of a truck with a tandem, whose own profile is not measured.

The inertia force m_u z'' of that axle follows from the profile that the tandem found at the same
place (`tandem.lead_motion`). Its tyres are on other strips, though: the difference e(x) of the
profiles is unknown, and its inertia force deflects the bridge under all axles. With the spectrum
S_e of e, the axle's acceleration has an error of the spectrum (2 pi f)^4 |H|² S_e(f/v)/v, H its
response. While the axle is on the bridge, the residuals contain the bridge's response to m_u times
that error: noise B B' of low rank K, as the force lasts for seconds and matters up to about 15 Hz
only.

Residuals w that are white but for this noise are whitened by

    w - C C' w,    C = U diag(1 - (1 + s²)^-1/2)^1/2,    B = U diag(s) V',

because cov(w) = I + B B'. In the few bands in which the bridge responds, the noise is many times
that of the sensors; it would be taken for damping or for support springs. All runs over one lane
have the same e, so that it does not average out: in a fusion its power counts `RUNS` times.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cholesky, toeplitz

from pre_core.crossing.mismatch import MismatchSpectra, density_at, pavement_ratio
from pre_core.crossing.off_bridge import surface_level_at
from pre_core.crossing.posterior import PosteriorProblem, data_rows, points
from pre_core.crossing.whitening import Whitener
from pre_core.physics.tandem import lead_response

FloatArray = NDArray[np.float64]

RUNS: Final = 12.0
"""Number of runs over one profile for which fusion is exact; it is conservative with fewer."""
_HIGHEST_HZ = 15.0
_LONGEST_KNOTS = 160
"""Largest number of values of a force; a slower truck's counts up to a lower frequency."""
_OVERSAMPLED = 16
"""Frequencies for each value in the integral of the covariance."""
_KNOWN = 0.15
"""Relative error of the force that nominal mass and tyre of the front axle leave."""
_SMALLEST = 0.05
"""Smallest noise of a direction relative to the sensors' that is kept."""
_JITTER = 1e-9


def without_front_axle(
    problem: PosteriorProblem, y: FloatArray, noise: Whitener, runs: float = 1.0
) -> Whitener:
    """Return the whitener with the front axle's noise at y (size,), `runs` times its power.

    `noise` is that of the other sources. It is returned as it is for a truck without a tandem, or
    without road off the bridge that shows how rough the surface is.
    """
    shapes = problem.front_axle
    surface = surface_level_at(problem, y) if shapes is not None else 0.0
    noise = noise._replace(low_rank=np.zeros((0, 0)))
    if shapes is None or not surface > 0.0:
        return noise
    motions = _motions(problem, y, shapes, runs * surface)
    crossing = problem.crossing
    still = problem._replace(noise=noise)
    base = data_rows(still, y[None, :])[0]
    columns = np.empty((base.size, motions.shape[1]))
    for k in range(motions.shape[1]):
        moved = crossing._replace(lead_acceleration=crossing.lead_acceleration + motions[:, k])
        columns[:, k] = data_rows(still._replace(crossing=moved), y[None, :])[0] - base
    if not np.isfinite(columns).all():
        return noise
    left, size, _ = np.linalg.svd(columns, full_matrices=False)
    left[~columns.any(axis=1)] = 0.0  # residuals that do not exist, but for rounding
    kept = size > _SMALLEST
    taken = np.sqrt(1.0 - 1.0 / np.sqrt(1.0 + size[kept] ** 2))
    return noise._replace(low_rank=np.ascontiguousarray(left[:, kept] * taken))


def _motions(
    problem: PosteriorProblem, y: FloatArray, shapes: MismatchSpectra, surface: float
) -> FloatArray:
    """Return accelerations (n, K) in m/s² of the axle, whose sum with unit weights has its error.

    `surface` is Phi k^3 in m². They are zero off the bridge.
    """
    crossing = problem.crossing
    at = points(problem, y[None, :])
    chainage = at.position_m[0] + crossing.direction * crossing.lead.ahead_m
    on = np.flatnonzero((chainage >= 0.0) & (chainage <= crossing.span_m))
    out = np.zeros((chainage.size, 0))
    if on.size < 2:
        return out
    lasts_s = (on[-1] - on[0]) * crossing.step_s
    highest_hz = min(_HIGHEST_HZ, 0.5 * _LONGEST_KNOTS / lasts_s)
    apart_s = 0.5 / highest_hz
    count = int(np.ceil(lasts_s / apart_s)) + 1
    hz = highest_hz * (np.arange(_OVERSAMPLED * count) + 0.5) / (_OVERSAMPLED * count)
    power = _acceleration_power(problem, shapes, surface, hz)
    lags = apart_s * np.arange(count)
    row = np.cos(2.0 * np.pi * np.outer(lags, hz)) @ power * (hz[1] - hz[0])
    row[0] *= 1.0 + _JITTER
    root = cholesky(toeplitz(row), lower=True)
    time = crossing.step_s * (on - on[0])
    out = np.zeros((chainage.size, count))
    out[on] = np.sinc(time[:, None] / apart_s - np.arange(count)) @ root
    return out


def _acceleration_power(
    problem: PosteriorProblem, shapes: MismatchSpectra, surface: float, hz: FloatArray
) -> FloatArray:
    """Return the one-sided spectrum (f,) in m²/s^4/Hz of the error of the axle's acceleration."""
    omega = 2.0 * np.pi * hz
    road = problem.mismatch._replace(shapes=shapes)
    # The window, which keeps covariances short, would spread the profile's long waves.
    table = np.concatenate([shapes.density, (shapes.road / shapes.road_spread)[None, :]])
    weights = surface * np.append(shapes.expected_m, _KNOWN**2)
    weights[:-1] *= pavement_ratio(problem.mismatch) ** 2
    profile = weights @ density_at(road, omega, table)
    answer = np.abs(lead_response(problem.crossing.lead, omega)) ** 2
    return np.asarray(omega**4 * answer * profile)
