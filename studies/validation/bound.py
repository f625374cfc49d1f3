"""The Cramér–Rao bound of one crossing's data at the truth.

The bound is that of all residuals of the posterior (white data, receiver, priors), differentiated
at the true values of every parameter of truck and bridge, with all nuisances (trajectory, gains,
delays, initial states) free: the inverse of J'J with the Jacobian J by central differences. A
support spring cannot be negative, which the inverse ignores: its variance is replaced by that of a
normal about the true value truncated at zero, with its effect on the others
(`truncated_covariance`).

Where the axles run over a surface their profiles differ, which is noise of the level that the road
class and the tyres imply: no run determines it better. The part common to several runs of one
wheel-path group is a parameter of all of them (`bound_of_runs`). The ratio of the deck's roughness
to the road's is known.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pre_core import parameters
from pre_core.crossing import posterior
from pre_core.crossing.compliances import to_compliance_coordinates
from pre_core.crossing.mismatch import expected_levels, mismatch_spectra
from pre_core.crossing.pavement import known_pavement
from pre_core.crossing.preparation import build_problem, to_standardised, update_noise
from pre_core.physics.vehicle import total_mass_kg
from pre_core.survey.plan import PosteriorAtTruth as AtTruth
from pre_core.survey.plan import (
    SurveySpreads,
    bridge_prior,
    planned_path_group,
    survey_information,
    survey_spreads,
)
from services.common.arrays import Floats
from services.simulation.data_alone import inputs_of_seen
from services.simulation.drawn import CrossingTruth, IdentifiedCrossing, SimulatedCrossing
from studies.simulation.truths import true_values
from studies.validation.calibration_statistics import truncated_covariance

DIFFERENCE = 1e-4
"""Step of a central difference in the posterior's coordinates: multiples of a prior's spread, and
metres of the trajectory. Halving it changes every bound by less than 0.1 %."""
_NUISANCE_STEPS = 20
"""Limit of steps; `_ENOUGH` usually ends the search earlier."""
_ENOUGH = 0.01
"""Gain in the sum of squares, whose standard deviation is tens, that ends the search."""


class Bound(NamedTuple):
    """Relative standard deviations (absolute for supports), by parameter name."""

    std: dict[str, float]
    """Standard deviations with the common scale uncertainty, as in results."""
    std_without_scale: dict[str, float]
    chi2_per_dof: float
    """Reduced chi-square at the truth: it judges the model, independently of a search."""


def bound_at_truth(
    seen: IdentifiedCrossing, drawn: SimulatedCrossing
) -> dict[str, dict[str, float]]:
    """Return the bounds of a simulated crossing as JSON."""
    problem, y = at_truth(seen, drawn)
    return as_json(bound_of(problem, y, seen.data.vehicle.spread("total_mass_kg")))


def bound_at(
    seen: IdentifiedCrossing, values: dict[str, float], wheelbase_m: float, entry_time: float
) -> dict[str, dict[str, float]]:
    """Return the bounds of a crossing with known truck and bridge only, as JSON.

    `values` have the names of docs/contract.md; the trajectory is the receiver's, shifted so that
    the front axle enters the bridge at `entry_time` (s since 1970).
    """
    problem, y, time_s = problem_of(seen)
    where = posterior.layout(problem)
    names = parameters.names(_elements(problem))
    theta = np.array([values[name] for name in names])
    _set_theta(problem, y, theta, wheelbase_m)
    entry_m = np.interp(
        entry_time - seen.data.wall_offset_s,
        time_s,
        problem.basis_position @ y[where.trajectory],
    )
    begin_m = 0.0 if seen.data.stay.direction > 0 else seen.data.bridge.span_m
    y[where.trajectory] += begin_m - entry_m
    problem, y = _at_best_nuisances(problem, y)
    return as_json(bound_of(problem, y, seen.data.vehicle.spread("total_mass_kg")))


def at_truth(
    seen: IdentifiedCrossing, drawn: SimulatedCrossing
) -> tuple[posterior.PosteriorProblem, Floats]:
    """Return the posterior of a simulated crossing, and the truth in its coordinates (size,)."""
    problem, y, time_s = problem_of(seen)
    where = posterior.layout(problem)
    errors = drawn.truth.channels
    correction = 1.0 / ((1.0 + errors.common_gain) * (1.0 + errors.gain)) - 1.0
    theta = equivalent_theta(
        true_values(drawn.truth),
        _elements(problem),
        drawn.site.vehicles[0].total_mass_kg / total_mass_kg(drawn.truth.car),
    )
    _set_gains(problem, y, correction)
    _set_theta(problem, y, theta, drawn.truth.car.wheelbase_m)
    y[where.delays] = errors.delay_s / problem.priors.delay_spread_s
    true_m = np.interp(
        time_s + seen.data.wall_offset_s,
        drawn.start_s + drawn.step_s * np.arange(drawn.motion.position_m.size),
        drawn.motion.position_m,
    )
    y[where.trajectory] = np.linalg.lstsq(problem.basis_position, true_m, rcond=None)[0]
    return _at_best_nuisances(_on_its_road(problem, y, drawn.truth), y)


def _on_its_road(
    problem: posterior.PosteriorProblem, y: Floats, truth: CrossingTruth
) -> posterior.PosteriorProblem:
    """Return the problem with the noise of profile mismatch, where the truth has it."""
    if truth.paths is None:
        return problem
    front, rear = truth.paths.front, truth.paths.rear
    mismatch = problem.mismatch._replace(
        shapes=mismatch_spectra(front, rear._replace(offset_m=0.0))
    )
    level = expected_levels(front, rear, truth.conditions.road_class)
    # The body equations have full weight until the nuisances are fitted: their residuals are
    # taken from the rows.
    ratio = truth.paths.pavement.deck_roughness
    return update_noise(
        problem._replace(mismatch=mismatch),
        y,
        problem.force,
        mismatch=level,
        pavement=known_pavement(problem, y, ratio),
    )


def _at_best_nuisances(
    problem: posterior.PosteriorProblem, y: Floats
) -> tuple[posterior.PosteriorProblem, Floats]:
    """Return the problem with truck and bridge fixed at y (size,), its noise and best nuisances.

    Initial states are unknown even of a truth, and a common delay of all channels is nearly the
    same as a longitudinal offset.
    """
    where = posterior.layout(problem)
    y[where.offset] = _best_offset(problem, y)
    nuisances = np.arange(where.gains.start, where.size)
    level = problem.mismatch.level_m3
    # The suspension's residuals are read off the rows: first without the part of the nuisances.
    y = optimise_subset(problem, y, nuisances)
    problem = update_noise(problem, y, mismatch=level, pavement=problem.mismatch.pavement)
    return problem, optimise_subset(problem, y, nuisances)


def as_json(bound: Bound) -> dict[str, dict[str, float]]:
    """Return plain dictionaries."""
    return {
        "std": bound.std,
        "std_without_scale": bound.std_without_scale,
        "at_truth": {"chi2_per_dof": bound.chi2_per_dof},
    }


def bound_of(
    problem: posterior.PosteriorProblem, y: Floats, scale_error: float, step: float = DIFFERENCE
) -> Bound:
    """Return the bound at y (size,); `scale_error` scales all EI and shows in no residual."""
    where = posterior.layout(problem)
    jacobian = central_jacobian(problem, y, np.arange(where.size), step)
    covariance = posterior.posterior_covariance(posterior.precision_root(jacobian))
    for zero in where.half_normal:
        covariance = truncated_covariance(covariance, int(zero), float(y[zero]))
    std = np.sqrt(np.diag(covariance))
    rows = parameters.table(_elements(problem))
    alone, full = {}, {}
    for at, i in enumerate(np.flatnonzero(problem.priors.estimated)):
        name, power = rows[i].name, rows[i].mass_power
        alone[name] = float(problem.priors.spread[i] * std[at])
        # Scaled parameters have a relative standard deviation, unless they are nominally zero.
        is_relative = not problem.priors.half_normal[i]
        full[name] = float(np.hypot(alone[name], power * scale_error if is_relative else 0.0))
    return Bound(full, alone, _chi2_per_dof(problem, y))


def bound_of_runs(
    truths: Sequence[AtTruth], wander_m: float, lengths_m: Floats, scale_error: float
) -> SurveySpreads:
    """Return standard deviations of ln EI for several crossings in one wheel-path group.

    Wheel paths differ by `wander_m` (standard deviation); the shared mismatch is a parameter of
    all. The result comes from draws in 1/EI (`pre_core.survey.plan`), with `scale_error`.
    """
    problem, y = truths[0]
    whole = problem.mismatch._replace(pavement=None)  # its residuals are those of one run
    track = planned_path_group(truths, whole, wander_m)
    known = bridge_prior(problem)
    precision = survey_information([track], len(truths), known.log_odds.size)
    where = posterior.layout(problem)
    centre, _ = to_compliance_coordinates(problem, y, np.zeros((1, y.size)))
    found = survey_spreads(known, precision, lengths_m, centre[where.bridge])
    return SurveySpreads(
        np.hypot(found.elements, scale_error), float(np.hypot(found.level, scale_error))
    )


def _chi2_per_dof(problem: posterior.PosteriorProblem, y: Floats) -> float:
    """Return the mean square of the white data; only the nuisances were fitted to them."""
    where = posterior.layout(problem)
    rows = posterior.data_rows(problem, y[None, :])[0]
    degrees: int = rows.size - (where.offset - where.gains.start)
    return float(rows @ rows) / max(1, degrees)


def equivalent_theta(values: dict[str, float], elements: int, scale: float) -> Floats:
    """Return the parameters (p,) that the method would find without noise.

    The method takes the total mass for the nominal one. All forces are then wrong by `scale`,
    nominal over true mass, and so are masses, springs, dampers and rigidities.
    """
    theta = np.array([values[name] for name in parameters.names(elements)])
    return np.asarray(theta * scale ** parameters.mass_powers(elements))


def _elements(problem: posterior.PosteriorProblem) -> int:
    return parameters.element_count(problem.priors.theta)


def problem_of(seen: IdentifiedCrossing) -> tuple[posterior.PosteriorProblem, Floats, Floats]:
    """Return the posterior for this crossing, its nominal start (size,) and its times (n,).

    Times are of the rows of `basis_position`, on the truck's clock.
    """
    inputs = inputs_of_seen(seen)
    problem, y = build_problem(inputs)
    return problem, y, _times(problem, inputs.fixes)


def _times(problem: posterior.PosteriorProblem, fixes: posterior.ChainageFixes) -> Floats:
    """Return when the trajectory is at the rows of its basis (n,): the spline of the time itself.

    The residuals of the receiver determine it: at the fixes it is their time, its slope is one and
    its third derivative zero.
    """
    rows = problem.receiver_rows[:-1, :-1]
    moments = fixes.time_s - fixes.time_s[0]
    values = np.zeros(rows.shape[0])
    values[: moments.size] = moments / fixes.position_noise_m
    values[moments.size : 2 * moments.size] = 1.0 / fixes.speed_noise_m_per_s
    coefficients = np.linalg.lstsq(rows, values, rcond=None)[0]
    return np.asarray(fixes.time_s[0] + problem.basis_position @ coefficients)


def _set_theta(
    problem: posterior.PosteriorProblem, y: Floats, theta: Floats, wheelbase_m: float
) -> None:
    """Set physical values (p,) in the coordinates y (size,); modified in place."""
    priors, where = problem.priors, posterior.layout(problem)
    y[where.theta] = to_standardised(priors, theta)
    y[where.wheelbase] = np.log(wheelbase_m / priors.wheelbase_m) / priors.wheelbase_spread


def _set_gains(problem: posterior.PosteriorProblem, y: Floats, correction: Floats) -> None:
    """Set relative corrections (4,) of the gains in y (size,); modified in place."""
    where, priors = posterior.layout(problem), problem.priors
    common = 1.0 + float(correction.mean())
    y[where.common_gain] = np.log(common) / posterior.common_gain_spread(priors)
    unit = np.zeros((4, where.size))
    unit[np.arange(3), np.arange(where.gains.start, where.gains.stop)] = 1.0
    directions = posterior.points(problem, unit).gain[:3]
    y[where.gains] = np.linalg.lstsq(directions.T, (1.0 + correction) / common - 1.0, rcond=None)[0]


def _best_offset(problem: posterior.PosteriorProblem, y: Floats) -> float:
    """Return the offset of all fixes from the trajectory in y (size,)."""
    where = posterior.layout(problem)
    column = problem.receiver_rows[:, -1]
    on = column != 0.0
    trajectory = problem.receiver_rows[:, :-1] @ y[where.trajectory]
    return float(
        column[on] @ (problem.receiver_values - trajectory)[on] / (column[on] @ column[on])
    )


def central_jacobian(
    problem: posterior.PosteriorProblem,
    y: Floats,
    columns: NDArray[np.int64],
    step: float = DIFFERENCE,
) -> Floats:
    """Return derivatives (rows, columns) of all residuals at y (size,) by central differences.

    For coordinates that must not be negative both points are moved up so that none is below zero.
    """
    begin = y[columns] - step
    bounded = np.isin(columns, posterior.layout(problem).half_normal)
    begin[bounded] = np.maximum(begin[bounded], 0.0)
    moved = np.repeat(y[None, :], 2 * columns.size, axis=0)
    moved[np.arange(columns.size), columns] = begin + 2.0 * step
    moved[columns.size + np.arange(columns.size), columns] = begin
    values = posterior.all_rows(problem, moved)
    return np.asarray((values[: columns.size] - values[columns.size :]).T / (2.0 * step))


def optimise_subset(
    problem: posterior.PosteriorProblem,
    y: Floats,
    columns: NDArray[np.int64],
    steps: int = _NUISANCE_STEPS,
) -> Floats:
    """Return the best y (size,) in these columns, the others fixed: damped Gauss-Newton."""
    rows = posterior.all_rows(problem, y[None, :])[0]
    for _ in range(steps):
        jacobian = central_jacobian(problem, y, columns)
        move = np.linalg.lstsq(jacobian, -rows, rcond=None)[0]
        for share in (1.0, 0.5, 0.25, 0.1, 0.02):
            tried = y.copy()
            tried[columns] += share * move
            new = posterior.all_rows(problem, tried[None, :])[0]
            if np.all(np.isfinite(new)) and new @ new < rows @ rows:
                break
        else:
            return y
        is_there = rows @ rows - new @ new < _ENOUGH
        y, rows = tried, new
        if is_there:
            return y
    return y
