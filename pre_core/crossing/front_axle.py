"""Noise from the front axle of a truck with a tandem, whose own profile is not measured.

The inertia force m_u z'' of that axle follows from the profile that the tandem measured at the same
place (`tandem.lead_motion`). Its tyres are on other strips, though: the difference e(x) of the
profiles is unknown, and its inertia force deflects the bridge under all axles. With the spectrum
S_e of e, the axle's acceleration has an error of the spectrum (2 pi f)^4 |H|² S_e(f/v)/v, H its
response. While the axle is on the bridge, the residuals contain the bridge's response to m_u times
that error: noise B B' of low rank K, as the force lasts for seconds and matters up to about 15 Hz
only.

Residuals w that are white but for this noise are whitened by

    w - C C' w,    C = U diag(1 - (1 + s²)^-1/2)^1/2,    B = U diag(s) V',

because cov(w) = I + B B'. The response to the force at each knot is computed once and serves both
this and the roughness of the deck (`pavement.estimate_pavement`): the bridge's response has waves
as short as that roughness, and would be mistaken for it. In the few bands in which the bridge
responds, the noise is many times that of the sensors; it would be mistaken for damping or for
rotational restraint. All runs over one lane have the same e, which therefore does not average out:
in a fusion its power counts `RUNS` times. Errors of the axle's declared values (mass and tyre) add
to the covariance.
"""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cholesky, toeplitz

from pre_core.arrays import FloatArray
from pre_core.crossing.channels import A
from pre_core.crossing.mismatch import density_at, hann_taper, pavement_ratio
from pre_core.crossing.off_bridge import surface_level_at
from pre_core.crossing.posterior import PosteriorProblem, filtered_rows, points
from pre_core.crossing.residuals import roads_and_deflections
from pre_core.crossing.tandem import lead_motion
from pre_core.crossing.whitening import Whitener, project_out_noise, solve
from pre_core.physics.tandem import lead_response, shared_load

RUNS: Final = 12.0
"""Number of runs over one profile for which fusion is exact; it is conservative with fewer."""
_HIGHEST_HZ = 15.0
_LONGEST_KNOTS = 160
"""Largest number of knots of a force; it lowers the highest frequency for a slow truck."""
_OVERSAMPLED = 16
"""Frequencies for each value in the integral of the covariance."""
_SMALLEST = 0.05
"""Smallest noise of a direction, relative to the sensors' noise, that is kept."""
_JITTER = 1e-9
"""Relative increase of the covariance's diagonal that keeps it positive definite."""


class FrontAxleResponse(NamedTuple):
    """Response of the filtered residuals to the errors of the front axle's inertia force."""

    columns: FloatArray
    """Residuals (3, m, K) in m for an acceleration of 1 m/s² at each knot."""
    covariance: FloatArray
    """Covariance (K, K) in m²/s^4 of the acceleration's error at the knots, where the surface under
    the axle is as rough as off the bridge."""
    of_values: FloatArray
    """Covariance (K, K) in m²/s^4 that errors of the axle's declared values cause, expressed as
    acceleration of its nominal mass."""


def front_axle_response(problem: PosteriorProblem, y: FloatArray) -> FrontAxleResponse | None:
    """Return the response at y (f,), while the front axle is on the bridge.

    It is None for a truck without a tandem, without road off the bridge that shows how rough the
    surface is, and if the truck at y has no residuals.
    """
    surface = surface_level_at(problem, y) if problem.front_axle is not None else 0.0
    if not surface > 0.0:
        return None
    motions, apart_s = _unit_motions(problem, y)
    crossing = problem.crossing
    base = filtered_rows(problem, y)
    columns = np.empty((*base.shape, motions.shape[1]))
    for k in range(motions.shape[1]):
        moved = crossing._replace(lead_acceleration=crossing.lead_acceleration + motions[:, k])
        columns[:, :, k] = filtered_rows(problem._replace(crossing=moved), y) - base
    if not (columns.size and np.isfinite(columns).all()):
        return None
    count = columns.shape[2]
    covariance = _covariance(problem, surface, apart_s, count)
    of_values = _of_displaced_values(problem, y, apart_s, count)
    return FrontAxleResponse(columns, covariance, of_values)


def front_axle_power(
    response: FrontAxleResponse, segment: NDArray[np.int64]
) -> tuple[FloatArray, FloatArray]:
    """Return two expected tapered periodograms (f,) of the axle's noise in mismatch residuals.

    They are of the successive residuals `segment` (m,), see `tapered_periodogram`. The first is
    caused by a surface on the bridge as rough as off it, the second by errors of the axle's values.
    """
    taper = hann_taper(segment.size)[:, None]
    of_knots = np.fft.rfft(taper * response.columns[0, segment], axis=0)[1:]
    by_surface, by_values = (
        np.einsum("fk,kl,fl->f", of_knots, covariance, of_knots.conj(), optimize=True).real
        for covariance in (response.covariance, response.of_values)
    )
    return by_surface, by_values


def without_front_axle(
    problem: PosteriorProblem,
    response: FrontAxleResponse | None,
    noise: Whitener,
    runs: float = 1.0,
) -> Whitener:
    """Return the whitener with the front axle's noise, `runs` times its power.

    `noise` is that of the other sources. Without a `response` it is returned unchanged.
    """
    noise = noise._replace(low_rank=np.zeros((0, 0)))
    if response is None:
        return noise
    covariance = pavement_ratio(problem.mismatch) ** 2 * response.covariance + response.of_values
    covariance[np.diag_indices_from(covariance)] *= 1.0 + _JITTER
    root = cholesky(covariance, lower=True)
    forced = response.columns @ root
    forced = np.sqrt(runs) * np.moveaxis(forced, 0, 1).reshape(-1, forced.shape[2])
    rows = np.ascontiguousarray(forced.T)
    for row in rows:
        solve(noise.factor, noise.reciprocal, row)
    columns = project_out_noise(noise, rows).T
    left, size, _ = np.linalg.svd(columns, full_matrices=False)
    left[~columns.any(axis=1)] = 0.0  # residuals that do not exist, but for rounding
    kept = size > _SMALLEST
    taken = np.sqrt(1.0 - 1.0 / np.sqrt(1.0 + size[kept] ** 2))
    return noise._replace(low_rank=np.ascontiguousarray(left[:, kept] * taken))


def _unit_motions(problem: PosteriorProblem, y: FloatArray) -> tuple[FloatArray, float]:
    """Return accelerations (n, K) of 1 m/s² at one knot each, and the time between knots.

    They are zero off the bridge.
    """
    crossing = problem.crossing
    at = points(problem, y[None, :])
    chainage = at.position_m[0] + crossing.direction * crossing.lead.ahead_m
    on = np.flatnonzero((chainage >= 0.0) & (chainage <= crossing.span_m))
    out = np.zeros((chainage.size, 0))
    if on.size < 2:
        return out, 0.0
    lasts_s = (on[-1] - on[0]) * crossing.step_s
    highest_hz = min(_HIGHEST_HZ, 0.5 * _LONGEST_KNOTS / lasts_s)
    apart_s = 0.5 / highest_hz
    count = int(np.ceil(lasts_s / apart_s)) + 1
    time = crossing.step_s * (on - on[0])
    out = np.zeros((chainage.size, count))
    out[on] = np.sinc(time[:, None] / apart_s - np.arange(count))
    return out, apart_s


def _of_displaced_values(
    problem: PosteriorProblem, y: FloatArray, apart_s: float, count: int
) -> FloatArray:
    """Return the covariance (K, K) in m²/s^4 at `count` knots from errors of the axle's values.

    The error of the inertia force that each value causes is known but for a factor. It is treated
    as random, with the spectrum that it has in the record: it contains the sensors' noise, which is
    in the residuals too, so that known columns would bias the estimate. The effect of a mass error
    on the loads of the body is left to the uncertainty of the centre of gravity.
    """
    lead = problem.crossing.lead
    nominal = with_lead_motion(problem, y).crossing.lead_acceleration
    n = nominal.size
    hz = np.fft.fftfreq(n, problem.crossing.step_s)
    power = np.zeros(n)
    for one in problem.displaced_leads:
        moved = problem._replace(crossing=problem.crossing._replace(lead=one))
        motion = with_lead_motion(moved, y).crossing.lead_acceleration
        force = one.unsprung_mass_kg / lead.unsprung_mass_kg * motion
        power += np.abs(np.fft.fft(force - nominal)) ** 2 / n**2
    some = np.abs(hz) < 0.5 / apart_s
    return np.asarray(toeplitz(_turns(apart_s, count, hz[some]) @ power[some]))


def _covariance(
    problem: PosteriorProblem, surface: float, apart_s: float, count: int
) -> FloatArray:
    """Return the covariance (K, K) in m²/s^4 of the acceleration's error at `count` knots.

    `surface` is Phi k^3 in m².
    """
    highest_hz = 0.5 / apart_s
    hz = highest_hz * (np.arange(_OVERSAMPLED * count) + 0.5) / (_OVERSAMPLED * count)
    turns = _turns(apart_s, count, hz) * (hz[1] - hz[0])
    return np.asarray(toeplitz(turns @ _acceleration_power(problem, surface, hz)))


def _turns(apart_s: float, count: int, hz: FloatArray) -> FloatArray:
    """Return the factors (K, f) from a power spectrum to the covariance at lags of the knots."""
    return np.asarray(np.cos(2.0 * np.pi * np.outer(apart_s * np.arange(count), hz)))


def _acceleration_power(problem: PosteriorProblem, surface: float, hz: FloatArray) -> FloatArray:
    """Return the one-sided spectrum (f,) in m²/s^4/Hz of the error of the axle's acceleration."""
    shapes = problem.front_axle
    assert shapes is not None  # noqa: S101 - there is a response
    omega = 2.0 * np.pi * hz
    road = problem.mismatch._replace(shapes=shapes)
    profile = surface * shapes.expected_m @ density_at(road, omega, shapes.density)
    answer = np.abs(lead_response(problem.crossing.lead, omega)) ** 2
    return np.asarray(omega**4 * answer * profile)


def with_lead_motion(problem: PosteriorProblem, y: FloatArray) -> PosteriorProblem:
    """Return the problem with the motion of the axle ahead of the tandem, at y (f,)."""
    crossing = problem.crossing
    at = points(problem, y[None, :])
    work = problem.works[0]
    work.under_lead[:] = 0.0
    heights, _ = roads_and_deflections(crossing, work, at, 0)
    chainage = at.position_m[0] * crossing.direction
    ahead = chainage + crossing.lead.ahead_m
    profile = 0.5 * (
        np.interp(ahead, chainage, heights[0])
        + np.interp(ahead, chainage - float(at.wheelbase_m[0]), heights[1])
    )
    on = shared_load(crossing.lead, at.theta[0], crossing.total_mass_kg, float(at.wheelbase_m[0]))
    force = on.lead_1 * crossing.signals[0, A] + on.lead_2 * crossing.signals[1, A]
    if not crossing.lead.is_equalised:
        own = crossing.lead.unsprung_mass_kg * crossing.lead_acceleration
        static = (on.lead_kg + crossing.lead.unsprung_mass_kg) * crossing.gravity_m_per_s2
        force = -work.load[2] - own - static / float(at.common_gain[0])
    motion = lead_motion(crossing.lead, crossing.step_s, profile + work.under_lead, force)
    return problem._replace(crossing=crossing._replace(lead_acceleration=motion))
