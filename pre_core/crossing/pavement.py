"""Profile mismatch on the bridge, whose pavement differs from the road's.

Relative to the road's, the amplitude of the mismatch on the bridge is

    exp(r + t L(n)),   L(n) = ln(n/n_p), n limited to some waves,

with normal priors of r and t about zero. Both are estimated from waves of the residuals on the
bridge that are too short for a deflection, so a weak element does not resemble a rough deck; the
prior of t extends them to long waves. The noise has the expectation of the power under their
posterior, exp(2 (r + t L) + 2 L'CL); the uncertainty that the short waves leave thus widens the
intervals.

A joint at an end of the deck excites both axles; only local waves differ. Where the residuals at
an end exceed the noise, all local waves there are removed from the whitened residuals.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pre_core.arrays import FloatArray
from pre_core.crossing import mismatch as _mismatch
from pre_core.crossing.front_axles import FrontAxlesResponse, front_axles_power
from pre_core.crossing.mismatch import BridgePavement, Mismatch, PeriodogramSegment
from pre_core.crossing.noise import no_suspension_noise, noise_spectrum
from pre_core.crossing.off_bridge import FEWEST_ROWS, rear_axle_chainage_m, rear_axle_samples_m
from pre_core.crossing.posterior import PosteriorProblem, filtered_rows, noise_path_at
from pre_core.crossing.rows import RESIDUALS, autocovariances, filter_rows
from pre_core.crossing.whitening import Whitener, solve

RATIO_SPREAD, TILT_SPREAD = 0.7, 0.12
"""Standard deviations of r and t. A measured deck was 2.5 to 3.8 times as
rough as the road before it (studies/pavement.md)."""
_SHORT_CYCLES_PER_M = (0.3, 4.0)
"""Spatial frequencies that no deflection of the bridge has, and that tyres do not average out."""
_JOINT_M = 0.5
"""Distance from an end of the deck within which a joint acts."""
_BLEND_M = 0.5
"""Half of the distance over which the noise changes from the road's to the bridge's."""
_PASSES, _LONGEST_STEP = 40, 0.5
_CONVERGED = 1e-4
_KNOT_M = 0.1
"""Spacing of the splines at an end."""
_KNOTS = np.arange(-3.0, 4.0)
"""Centres of the cubic splines at an end, in units of their spacing; a step is added to them."""
_JOINT_SIZE_M = 1e-3
"""Size of a joint's mismatch; local waves that do not affect the residuals at this size are
kept."""
_CLEAR_JOINT = 8.0
"""Smallest excess of local power at the ends that counts as a joint, in its standard deviations."""


def estimate_pavement(
    problem: PosteriorProblem,
    y: FloatArray,
    level_m3: FloatArray,
    front_axles: FrontAxlesResponse | None = None,
) -> BridgePavement:
    """Return the mismatch on the bridge relative to levels (s,) off it, at y (f,).

    The noise from a tandem's front axles has waves as short, and scales with the deck's
    roughness.
    """
    inside = _distance_inside_m(problem, y)
    share = _share_on_bridge(inside)
    mismatch = problem.mismatch._replace(level_m3=level_m3)
    rows = problem.rows
    half_m = 0.5 * rows.taps.size * rows.step_s * mismatch.speed_m_per_s
    middle = np.flatnonzero(inside > half_m + _JOINT_M)
    if middle.size < FEWEST_ROWS:
        prior = np.diag([RATIO_SPREAD**2, TILT_SPREAD**2])
        return BridgePavement(np.zeros(2), prior, share)
    part = _periodogram(problem, y, mismatch, middle)
    known, shape = part.sensors, part.shapes[0]
    if front_axles is not None:
        by_surface, by_values = front_axles_power(front_axles, middle)
        known, shape = known + by_values, shape + by_surface
    length_m = middle.size * (rows.every * rows.step_s) * mismatch.speed_m_per_s
    n = np.arange(1, part.observed.size + 1) / length_m
    low, high = _SHORT_CYCLES_PER_M
    short = (n > low) & (n < high)
    found, covariance = fit_ratio(part.observed[short], known[short], shape[short], n[short])
    return BridgePavement(found, covariance, share)


def _periodogram(
    problem: PosteriorProblem, y: FloatArray, mismatch: Mismatch, segment: NDArray[np.int64]
) -> PeriodogramSegment:
    """Return the periodogram of successive residuals `segment` (m,), with its expectation."""
    rows, omega = problem.rows, problem.rows.omega
    table = _mismatch.unwindowed(mismatch.shapes)
    density = omega**4 * (mismatch.level_m3 @ _mismatch.density_at(mismatch, omega, table))
    truck, sensor = noise_path_at(problem, y)
    of_sensors = noise_spectrum(truck, sensor, no_suspension_noise(), None, omega)[0, 0].real
    covariances = autocovariances(rows, np.stack([of_sensors, density]), segment.size)
    return _mismatch.tapered_periodogram(
        filtered_rows(problem, y)[0, segment], covariances[0], covariances[1:]
    )


def known_pavement(problem: PosteriorProblem, y: FloatArray, ratio: float) -> BridgePavement:
    """Return a mismatch on the bridge that is exactly `ratio` times the road's, at y (f,)."""
    share = _share_on_bridge(_distance_inside_m(problem, y))
    return BridgePavement(np.array([np.log(ratio), 0.0]), np.zeros((2, 2)), share)


def _distance_inside_m(problem: PosteriorProblem, y: FloatArray) -> FloatArray:
    """Return the distance (m,) of each residual from the nearer end; negative off the bridge."""
    x = rear_axle_chainage_m(problem, y)
    return np.minimum(x, problem.crossing.span_m - x)


def _share_on_bridge(inside_m: FloatArray) -> FloatArray:
    return np.clip(0.5 + 0.5 * inside_m / _BLEND_M, 0.0, 1.0)


def fit_ratio(
    observed: FloatArray, known: FloatArray, shape: FloatArray, cycles_per_m: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return (r, t) and their covariance (2, 2) from a tapered periodogram (f,).

    `known` (f,) is its expectation without mismatch, `shape` (f,) that of the mismatch of the road.
    The method is Fisher scoring. A taper correlates neighbours, so only every other frequency
    counts.
    """
    columns = np.stack([np.ones_like(cycles_per_m), _mismatch.tilt_of(cycles_per_m)], axis=1)
    prior = np.diag([RATIO_SPREAD**-2, TILT_SPREAD**-2])
    found = np.zeros(2)
    information = prior
    for _ in range(_PASSES):
        of_mismatch = shape * np.exp(2.0 * columns @ found)
        expected = known + of_mismatch
        relative = 2.0 * (of_mismatch / expected)[:, None] * columns
        gradient = 0.5 * relative.T @ (1.0 - observed / expected) + prior @ found
        information = 0.5 * relative.T @ relative + prior
        step = np.linalg.solve(information, gradient)
        step *= min(1.0, _LONGEST_STEP / max(float(np.abs(step).max()), _CONVERGED))
        found = found - step
        if np.abs(step).max() < _CONVERGED:
            break
    return found, np.linalg.inv(information)


class RoadPart(NamedTuple):
    """A part of the residuals with its mismatch."""

    mismatch: Mismatch
    residuals: float
    """Number of residuals."""
    is_bridge: bool


def parts_of(mismatch: Mismatch, count: int) -> list[RoadPart]:
    """Return the parts off and on the bridge of `count` residuals; one if both are alike."""
    pavement = mismatch.pavement
    if pavement is None:
        return [RoadPart(mismatch, float(count), False)]
    on = float(pavement.share.sum())
    return [
        RoadPart(mismatch._replace(pavement=None), count - on, False),
        RoadPart(_mismatch.on_bridge(mismatch), on, True),
    ]


def without_joints(problem: PosteriorProblem, y: FloatArray, noise: Whitener) -> Whitener:
    """Return the whitener that removes local waves at both ends, if a joint is clear at y (f,).

    The result is the same `noise` without a clear joint.
    """
    waves = _white_joints(problem, y, noise)
    if waves.shape[1] == 0:
        return noise
    white = np.ascontiguousarray(filtered_rows(problem, y).T).ravel()
    solve(noise.factor, noise.reciprocal, white)
    power, chance = float(np.sum((waves.T @ white) ** 2)), float(waves.shape[1])
    if not power > chance + _CLEAR_JOINT * np.sqrt(2.0 * chance):
        return noise
    both = np.hstack([noise.lines, waves]) if noise.lines.size else waves
    return noise._replace(lines=np.ascontiguousarray(np.linalg.qr(both)[0]))


def _white_joints(problem: PosteriorProblem, y: FloatArray, noise: Whitener) -> FloatArray:
    """Return orthonormal columns (3 m, w): whitened residuals of local waves at both ends."""
    rear = rear_axle_samples_m(problem, y)
    columns = []
    for end in (0.0, problem.crossing.span_m):
        aside = np.abs((rear - end)[None, :] / _KNOT_M - _KNOTS[:, None])
        columns += [*(np.maximum(2.0 - aside, 0.0) ** 3 - 4.0 * np.maximum(1.0 - aside, 0.0) ** 3)]
        columns.append(np.clip((rear - end) / _KNOT_M, -1.0, 1.0))
    white = np.zeros((noise.reciprocal.size, len(columns)))
    filtered = np.empty(noise.reciprocal.size // RESIDUALS)
    for k, column in enumerate(columns):
        filter_rows(problem.rows.taps, problem.rows.every, _JOINT_SIZE_M * column, filtered)
        of_all = np.zeros(noise.reciprocal.size)
        of_all[::RESIDUALS] = filtered
        solve(noise.factor, noise.reciprocal, of_all)
        white[:, k] = of_all
    if not np.isfinite(white).all():
        return white[:, :0]
    left, size, _ = np.linalg.svd(white, full_matrices=False)
    return np.asarray(left[:, size > 1.0])
