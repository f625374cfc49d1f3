"""Forces of the axles ahead of a tandem, whose profiles are not measured, and their errors.

The inertia force m_u z'' of such an axle follows from the profile that the tandem measured at the
same place (`tandem.axle_motion`). Several axles have springs of their own: the springs' nominal
law, with that profile under each axle, gives the forces S_i = k_i (z_i - z_b(o_i)) + c_i (z_i' -
z_b'(o_i)), of which the sum is replaced by that which inertia determines, E_i = S_i - rho_i sum S.
So an axle's own damper damps it, and friction that all springs have alike does no harm.

The tyres are on other strips than the tandem's, though: the difference e(x) of the profiles is
unknown, and the inertia force that it causes deflects the bridge under all axles. With the spectrum
S_e of e, an axle's acceleration has an error of the spectrum (2 pi f)^4 |H|² S_e(f/v)/v, H its
response. Axles with equal tyres follow one e(x), one after the other. While an axle is on the
bridge, the residuals contain the bridge's response to m_u times that error: noise B B' of low rank
K, as the force lasts for seconds and matters up to about 15 Hz only.

Residuals w that are white but for this noise are whitened by

    w - C C' w,    C = U diag(1 - (1 + s²)^-1/2)^1/2,    B = U diag(s) V',

because cov(w) = I + B B'. The response to the force at each knot is computed once and serves both
this and the roughness of the deck (`pavement.estimate_pavement`): the bridge's response has waves
as short as that roughness, and would be mistaken for it. In the few bands in which the bridge
responds, the noise is many times that of the sensors; it would be mistaken for damping or for
rotational restraint. All runs over one lane have the same e, which therefore does not average out:
in a fusion its power counts `RUNS` times. Errors of the axle's declared values add
to the covariance.
"""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag, cholesky, toeplitz

from pre_core.arrays import ComplexArray, FloatArray
from pre_core.crossing.arguments import GriddedCrossing
from pre_core.crossing.channels import A
from pre_core.crossing.mismatch import MismatchSpectra, density_at, hann_taper, pavement_ratio
from pre_core.crossing.off_bridge import surface_level_at
from pre_core.crossing.posterior import PosteriorProblem, filtered_rows, points
from pre_core.crossing.residuals import roads_and_deflections
from pre_core.crossing.tandem import axle_motion, motion_band, record_taper
from pre_core.crossing.whitening import Whitener, project_out_noise, solve
from pre_core.physics.tandem import axle_response, shared_load

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


class FrontAxlesResponse(NamedTuple):
    """Response of the filtered residuals to the errors of these axles' inertia forces."""

    columns: FloatArray
    """Residuals (3, m, K) in m for an acceleration of 1 m/s² at each knot of each axle."""
    covariance: FloatArray
    """Covariance (K, K) in m²/s^4 of the accelerations' errors at the knots, where the surface
    under the axles is as rough as off the bridge."""
    of_values: FloatArray
    """Covariance (K, K) in m²/s^4 that errors of the axles' declared values cause, expressed as
    acceleration of the nominal mass."""


class Knots(NamedTuple):
    """Knots of the acceleration's error of one axle, while it is on the bridge."""

    motions: FloatArray
    """Accelerations (n, k) of 1 m/s² at one knot each; zero off the bridge."""
    start_s: float
    """Time of the first knot, later by the time that the truck takes from the tandem's first axle
    to this one: equal tyres meet one place of the road at equal times."""


def front_axles_response(problem: PosteriorProblem, y: FloatArray) -> FrontAxlesResponse | None:
    """Return the response at y (f,), while a front axle is on the bridge.

    It is None for a truck without a tandem, without road off the bridge that shows how rough the
    surface is, and if the truck at y has no residuals.
    """
    surface = surface_level_at(problem, y) if problem.front_axles else 0.0
    if not surface > 0.0:
        return None
    knots, apart_s = _unit_motions(problem, y)
    crossing = problem.crossing
    base = filtered_rows(problem, y)
    counts = [one.motions.shape[1] for one in knots]
    columns = np.empty((*base.shape, sum(counts)))
    for j, first in enumerate(np.cumsum([0, *counts[:-1]])):
        for k in range(counts[j]):
            forces = crossing.front_force_n.copy()
            forces[j] += crossing.tandem.front.unsprung_mass_kg[j] * knots[j].motions[:, k]
            moved = problem._replace(crossing=crossing._replace(front_force_n=forces))
            columns[:, :, first + k] = filtered_rows(moved, y) - base
    if not (columns.size and np.isfinite(columns).all()):
        return None
    covariance = _covariance(problem, surface, apart_s, knots)
    of_values = _of_displaced_values(problem, y, apart_s, counts)
    return FrontAxlesResponse(columns, covariance, of_values)


def front_axles_power(
    response: FrontAxlesResponse, segment: NDArray[np.int64]
) -> tuple[FloatArray, FloatArray]:
    """Return two expected tapered periodograms (f,) of these axles' noise in mismatch residuals.

    They are of the successive residuals `segment` (m,), see `tapered_periodogram`. The first is
    caused by a surface on the bridge as rough as off it, the second by errors of the axles' values.
    """
    taper = hann_taper(segment.size)[:, None]
    of_knots = np.fft.rfft(taper * response.columns[0, segment], axis=0)[1:]
    by_surface, by_values = (
        np.einsum("fk,kl,fl->f", of_knots, covariance, of_knots.conj(), optimize=True).real
        for covariance in (response.covariance, response.of_values)
    )
    return by_surface, by_values


def without_front_axles(
    problem: PosteriorProblem,
    response: FrontAxlesResponse | None,
    noise: Whitener,
    runs: float = 1.0,
) -> Whitener:
    """Return the whitener with these axles' noise, `runs` times its power.

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


def _unit_motions(problem: PosteriorProblem, y: FloatArray) -> tuple[list[Knots], float]:
    """Return the knots of each axle that is on the bridge, and the time between knots."""
    crossing = problem.crossing
    at = points(problem, y[None, :])
    travelled = at.position_m[0] * crossing.direction
    on_bridge = []
    for ahead_m in crossing.tandem.front.ahead_m:
        chainage = at.position_m[0] + crossing.direction * ahead_m
        on_bridge.append(np.flatnonzero((chainage >= 0.0) & (chainage <= crossing.span_m)))
    lasts_s = max(on[-1] - on[0] if on.size > 1 else 0 for on in on_bridge) * crossing.step_s
    nowhere = Knots(np.zeros((travelled.size, 0)), 0.0)
    if not lasts_s > 0.0:
        return [nowhere] * len(on_bridge), 0.0
    apart_s = 0.5 / min(_HIGHEST_HZ, 0.5 * _LONGEST_KNOTS / lasts_s)
    knots = []
    for on, ahead_m in zip(on_bridge, crossing.tandem.front.ahead_m, strict=True):
        if on.size < 2:
            knots.append(nowhere)
            continue
        count = int(np.ceil((on[-1] - on[0]) * crossing.step_s / apart_s)) + 1
        time = crossing.step_s * (on - on[0])
        motions = np.zeros((travelled.size, count))
        motions[on] = np.sinc(time[:, None] / apart_s - np.arange(count))
        reached = np.interp(travelled[on[0]] + ahead_m, travelled, np.arange(travelled.size))
        knots.append(Knots(motions, float(crossing.step_s * reached)))
    return knots, apart_s


def _of_displaced_values(
    problem: PosteriorProblem, y: FloatArray, apart_s: float, counts: list[int]
) -> FloatArray:
    """Return the covariance (K, K) in m²/s^4 at the axles' knots from errors of their values.

    The error of the inertia force that each value causes is known but for a factor. It is treated
    as random, with the spectrum that it has in the record: it contains the sensors' noise, which is
    in the residuals too, so that known columns would bias the estimate. The effect of a mass error
    on the loads of the body is left to the uncertainty of the centre of gravity.
    """
    nominal_kg = problem.crossing.tandem.front.unsprung_mass_kg[:, None]
    nominal = with_front_forces(problem, y).crossing.front_force_n / nominal_kg
    n = nominal.shape[1]
    hz = np.fft.fftfreq(n, problem.crossing.step_s)
    power = np.zeros(nominal.shape)
    for one in problem.displaced_trucks:
        moved = problem._replace(crossing=problem.crossing._replace(tandem=one))
        force = with_front_forces(moved, y).crossing.front_force_n / nominal_kg
        power += np.abs(np.fft.fft(force - nominal)) ** 2 / n**2
    some = np.abs(hz) < 0.5 / apart_s
    return block_diag(
        *(
            toeplitz(_turns(apart_s * np.arange(count), hz[some]) @ power[j, some])
            for j, count in enumerate(counts)
        )
    )


def _covariance(
    problem: PosteriorProblem, surface: float, apart_s: float, knots: list[Knots]
) -> FloatArray:
    """Return the covariance (K, K) in m²/s^4 of the accelerations' errors at the knots.

    `surface` is Phi k^3 in m². The errors of axles with equal tyres are those of one profile, met
    one after the other; others are independent.
    """
    counts = [one.motions.shape[1] for one in knots]
    highest_hz, longest = 0.5 / apart_s, max(counts)
    hz = highest_hz * (np.arange(_OVERSAMPLED * longest) + 0.5) / (_OVERSAMPLED * longest)
    powers = [_profile_power(problem, surface, shapes, hz) for shapes in problem.front_axles]
    responses = [
        axle_response(problem.crossing.tandem.front, j, 2.0 * np.pi * hz) for j in range(len(knots))
    ]
    blocks = [[np.zeros((a, b)) for b in counts] for a in counts]
    for i, one in enumerate(knots):
        for j, other in enumerate(knots):
            if i != j and not np.array_equal(powers[i], powers[j]):
                continue
            both = powers[i] * responses[i] * responses[j].conj() * (hz[1] - hz[0])
            later_s = one.start_s - other.start_s
            column, row = (
                _lagged(later_s + apart_s * np.arange(counts[i]), hz, both),
                _lagged(later_s - apart_s * np.arange(counts[j]), hz, both),
            )
            blocks[i][j] = toeplitz(column, row)
    return np.block(blocks)


def _turns(lag_s: NDArray[np.floating], hz: FloatArray) -> FloatArray:
    """Return the factors (k, f) from a power spectrum to the covariance at lags (k,)."""
    return np.asarray(np.cos(2.0 * np.pi * np.outer(lag_s, hz)))


def _lagged(lag_s: FloatArray, hz: FloatArray, power: ComplexArray) -> FloatArray:
    """Return the covariance at lags (k,) of two signals with a one-sided cross-spectrum (f,)."""
    angle = 2.0 * np.pi * np.outer(lag_s, hz)
    return np.asarray(np.cos(angle) @ power.real - np.sin(angle) @ power.imag)


def _profile_power(
    problem: PosteriorProblem, surface: float, shapes: MismatchSpectra, hz: FloatArray
) -> FloatArray:
    """Return the one-sided spectrum (f,) in m²/s^4/Hz of the profile error's acceleration."""
    omega = 2.0 * np.pi * hz
    road = problem.mismatch._replace(shapes=shapes)
    profile = surface * shapes.expected_m @ density_at(road, omega, shapes.density)
    return np.asarray(omega**4 * profile)


def with_front_forces(problem: PosteriorProblem, y: FloatArray) -> PosteriorProblem:
    """Return the problem with the front axles' own forces and their moment, at y (f,)."""
    crossing = problem.crossing
    front = crossing.tandem.front
    at = points(problem, y[None, :])
    work = problem.works[0]
    work.under_front[:] = 0.0
    heights, _ = roads_and_deflections(crossing, work, at, 0)
    chainage = at.position_m[0] * crossing.direction
    gap = float(at.wheelbase_m[0])
    profiles = work.under_front.copy()
    for j, ahead_m in enumerate(front.ahead_m):
        ahead = chainage + ahead_m
        profiles[j] += 0.5 * (
            np.interp(ahead, chainage, heights[0]) + np.interp(ahead, chainage - gap, heights[1])
        )
    apart = _spring_differences(crossing, profiles)
    moment = (crossing.tandem.ahead_m - front.ahead_m) @ apart
    on = shared_load(crossing.tandem, at.theta[0], crossing.total_mass_kg, gap)
    if crossing.tandem.is_equalised:
        of_all = on.front_1 * crossing.signals[0, A] + on.front_2 * crossing.signals[1, A]
        of_all += moment / on.lever_m
    else:
        carried = on.front_kg + front.unsprung_mass_kg.sum()
        static = carried * crossing.gravity_m_per_s2 / float(at.common_gain[0])
        of_all = -np.sum(work.load[2:] + crossing.front_force_n, axis=0) - static
    forces = apart.copy()
    for j, share in enumerate(front.share):
        motion = axle_motion(front, j, crossing.step_s, profiles[j], share * of_all + apart[j])
        forces[j] += front.unsprung_mass_kg[j] * motion
    return problem._replace(
        crossing=crossing._replace(front_force_n=forces, front_moment_nm=moment)
    )


def _spring_differences(crossing: GriddedCrossing, profiles: FloatArray) -> FloatArray:
    """Return the spring forces (k, n) of front axles besides their shares of the sum.

    They follow from the nominal springs over `profiles` (k, n), which contain the deflection of the
    bridge.
    """
    front, step_s = crossing.tandem.front, crossing.step_s
    count, n = profiles.shape
    out = np.zeros((count, n))
    if count < 2:
        return out
    s = 2j * np.pi * np.fft.rfftfreq(n, step_s)
    s[0] = 1.0  # `motion_band` leaves it out
    weight = motion_band(n, step_s) / s**2
    taper = record_taper(n, step_s)
    curvature = np.zeros((count, n))
    curvature[:, 1:-1] = np.diff(profiles, 2, axis=1) / step_s**2
    front_a, rear_a = crossing.signals[0, A], crossing.signals[1, A]
    springs = np.empty((count, s.size), dtype=np.complex128)
    for j in range(count):
        place = (crossing.tandem.ahead_m - front.ahead_m[j]) / crossing.tandem.readings_apart_m
        body = np.fft.rfft(taper * (front_a + place * (rear_a - front_a)))
        road = np.fft.rfft(taper * curvature[j])
        tyre = front.tyre_stiffness_n_per_m[j] + front.tyre_damping_ns_per_m[j] * s
        law = front.suspension_stiffness_n_per_m[j] + front.suspension_damping_ns_per_m[j] * s
        wheel = front.unsprung_mass_kg[j] * s**2 + tyre
        springs[j] = weight * law * (tyre * road - wheel * body) / (wheel + law)
    apart = springs - front.share[:, None] * springs.sum(axis=0)
    return np.asarray(np.fft.irfft(apart, n, axis=1))
