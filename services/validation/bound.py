"""How well one crossing can be known at all: the Cramér-Rao bound of its data at the truth.

The bound is that of all rows of the posterior - white data, receiver, priors - differentiated at
the true values of every unknown of truck and bridge, with all nuisances (trajectory, gains, delays,
initial states) free: the inverse of J'J, of which J is the Jacobian by central differences. A
support spring cannot be negative, which the inverse does not know: its variance is replaced by
that of a normal about the true value cut off at zero, and what follows for the others is taken
along (`without_negative`).

Where the axles run over a surface their roads differ, and that is noise of the level which the
class of the road and the tyres have: no run knows it better. What several runs in one track have in
common of it is an unknown of all of them (`bound_of_runs`).
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pre_core import unknowns
from pre_core.crossing import posterior
from pre_core.crossing.bound import DIFFERENCE, central_jacobian, settle
from pre_core.crossing.compliances import in_compliances
from pre_core.crossing.mismatch import levels_on, shapes_of
from pre_core.crossing.preparation import in_spreads, prepare, with_noise_at
from pre_core.diagnostics.calibration import without_negative
from pre_core.physics.vehicle import total_mass_kg
from pre_core.survey.plan import Spreads, known_before, spreads, together, track_of
from pre_core.survey.plan import Truth as AtTruth
from services.simulation.data_alone import inputs_of_seen
from services.simulation.drawn import Drawn, Seen, Truth, true_values

Floats = NDArray[np.float64]


class Bound(NamedTuple):
    """Relative standard deviations (of supports absolute), by parameter name."""

    std: dict[str, float]
    """With the scale error, as results give it."""
    std_without_scale: dict[str, float]
    chi2_per_dof: float
    """What the truth leaves over of the data: it tells of the model, whatever a search finds."""


def bound_at_truth(seen: Seen, drawn: Drawn) -> dict[str, dict[str, float]]:
    """The bounds of a drawn crossing as JSON."""
    problem, y = at_truth(seen, drawn)
    return as_json(bound_of(problem, y, seen.data.vehicle.spread("total_mass_kg")))


def bound_at(
    seen: Seen, values: dict[str, float], wheelbase_m: float, entry_time: float
) -> dict[str, dict[str, float]]:
    """The bounds of a crossing of which only truck and bridge are known, as JSON.

    `values` are by the names of docs/contract.md; the trajectory is the receiver's, moved so that
    the front axle enters the bridge at `entry_time` (s since 1970).
    """
    problem, y, time_s = problem_of(seen)
    where = posterior.layout(problem)
    names = unknowns.names(_elements(problem))
    theta = np.array([values[name] for name in names])
    _set_theta(problem, y, theta, wheelbase_m)
    entry_m = np.interp(
        entry_time - seen.data.wall_offset_s,
        time_s,
        problem.basis_position @ y[where.trajectory],
    )
    begin_m = 0.0 if seen.data.stay.direction > 0 else seen.data.bridge.span_m
    y[where.trajectory] += begin_m - entry_m
    problem, y = _settled(problem, y)
    return as_json(bound_of(problem, y, seen.data.vehicle.spread("total_mass_kg")))


def at_truth(seen: Seen, drawn: Drawn) -> tuple[posterior.Problem, Floats]:
    """The posterior of a drawn crossing, and the truth in its coordinates (see `_settled`)."""
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
    return _settled(_on_its_road(problem, y, drawn.truth), y)


def _on_its_road(problem: posterior.Problem, y: Floats, truth: Truth) -> posterior.Problem:
    """The problem with the noise of roads that differ, where the truth's do."""
    if truth.paths is None:
        return problem
    front, rear = truth.paths.front, truth.paths.rear
    mismatch = problem.mismatch._replace(shapes=shapes_of(front, rear._replace(offset_m=0.0)))
    level = levels_on(front, rear, truth.conditions.road_class)
    # Springs are believed until the nuisances have settled: what they leave is read off the rows.
    return with_noise_at(problem._replace(mismatch=mismatch), y, problem.force, mismatch=level)


def _settled(problem: posterior.Problem, y: Floats) -> tuple[posterior.Problem, Floats]:
    """Truck and bridge as they are in y, with the noise of this truck and the best nuisances.

    Initial states are known of no truth, and a common delay of all channels is nearly the same as
    a shift along the road.
    """
    where = posterior.layout(problem)
    y[where.offset] = _best_offset(problem, y)
    nuisances = np.arange(where.gains.start, where.size)
    level = problem.mismatch.level_m3
    # What springs leave over is read off the rows: first without what the nuisances put there.
    y = settle(problem, y, nuisances)
    problem = with_noise_at(problem, y, mismatch=level)
    return problem, settle(problem, y, nuisances)


def as_json(bound: Bound) -> dict[str, dict[str, float]]:
    """Plain dictionaries."""
    return {
        "std": bound.std,
        "std_without_scale": bound.std_without_scale,
        "at_truth": {"chi2_per_dof": bound.chi2_per_dof},
    }


def bound_of(
    problem: posterior.Problem, y: Floats, scale_error: float, step: float = DIFFERENCE
) -> Bound:
    """The bound at y (size,); `scale_error` is of what scales all EI and no residual shows."""
    where = posterior.layout(problem)
    jacobian = central_jacobian(problem, y, np.arange(where.size), step)
    covariance = posterior.covariance(posterior.precision_root(jacobian))
    for zero in where.half_normal:
        covariance = without_negative(covariance, int(zero), float(y[zero]))
    std = np.sqrt(np.diag(covariance))
    rows = unknowns.table(_elements(problem))
    alone, full = {}, {}
    for at, i in enumerate(np.flatnonzero(problem.priors.estimated)):
        name, power = rows[i].name, rows[i].mass_power
        alone[name] = float(problem.priors.spread[i] * std[at])
        # What is scaled has a relative standard deviation, but for what is nominally zero.
        is_relative = not problem.priors.half_normal[i]
        full[name] = float(np.hypot(alone[name], power * scale_error if is_relative else 0.0))
    return Bound(full, alone, _chi2_per_dof(problem, y))


def bound_of_runs(
    truths: Sequence[AtTruth], wander_m: float, lengths_m: Floats, scale_error: float
) -> Spreads:
    """Standard deviations of ln EI by several crossings in one track, at their truth.

    Tracks lie beside each other by `wander_m` (standard deviation); what they share of the
    mismatch is an unknown of all. By draws in 1/EI (`pre_core.survey.plan`), with `scale_error`.
    """
    problem, y = truths[0]
    track = track_of(truths, problem.mismatch, wander_m)
    known = known_before(problem)
    precision = together([track], len(truths), known.log_odds.size)
    where = posterior.layout(problem)
    centre, _ = in_compliances(problem, y, np.zeros((1, y.size)))
    found = spreads(known, precision, lengths_m, centre[where.bridge])
    return Spreads(np.hypot(found.elements, scale_error), float(np.hypot(found.level, scale_error)))


def _chi2_per_dof(problem: posterior.Problem, y: Floats) -> float:
    """Mean square of the white data; only the nuisances were fitted to them."""
    where = posterior.layout(problem)
    rows = posterior.data_rows(problem, y[None, :])[0]
    degrees: int = rows.size - (where.offset - where.gains.start)
    return float(rows @ rows) / max(1, degrees)


def equivalent_theta(values: dict[str, float], elements: int, scale: float) -> Floats:
    """The parameters (p,) that the method would find without noise.

    The method takes the total mass for the nominal one. All forces are then off by `scale`, nominal
    over true mass, and so are masses, springs, dampers and rigidities.
    """
    theta = np.array([values[name] for name in unknowns.names(elements)])
    return np.asarray(theta * scale ** unknowns.mass_powers(elements))


def _elements(problem: posterior.Problem) -> int:
    return unknowns.element_count(problem.priors.theta)


def problem_of(seen: Seen) -> tuple[posterior.Problem, Floats, Floats]:
    """The posterior as the method sets it up for this crossing, its nominal start, its times (n,).

    Times are of the rows of `basis_position`, on the truck's clock.
    """
    inputs = inputs_of_seen(seen)
    problem, y = prepare(inputs)
    return problem, y, _times(problem, inputs.fixes)


def _times(problem: posterior.Problem, fixes: posterior.Fixes) -> Floats:
    """When the trajectory is at the rows of its basis: that spline which is the time itself.

    The rows of the receiver determine it: at the fixes it is their time, its slope is one and its
    third derivative nothing.
    """
    rows = problem.receiver_rows[:-1, :-1]
    moments = fixes.time_s - fixes.time_s[0]
    values = np.zeros(rows.shape[0])
    values[: moments.size] = moments / fixes.position_noise_m
    values[moments.size : 2 * moments.size] = 1.0 / fixes.speed_noise_m_per_s
    coefficients = np.linalg.lstsq(rows, values, rcond=None)[0]
    return np.asarray(fixes.time_s[0] + problem.basis_position @ coefficients)


def _set_theta(problem: posterior.Problem, y: Floats, theta: Floats, wheelbase_m: float) -> None:
    """Put physical values (p,) into the coordinates y; modified in place."""
    priors, where = problem.priors, posterior.layout(problem)
    y[where.theta] = in_spreads(priors, theta)
    y[where.wheelbase] = np.log(wheelbase_m / priors.wheelbase_m) / priors.wheelbase_spread


def _set_gains(problem: posterior.Problem, y: Floats, correction: Floats) -> None:
    """Put relative corrections (4,) of the gains into y; modified in place."""
    where, priors = posterior.layout(problem), problem.priors
    common = 1.0 + float(correction.mean())
    y[where.common_gain] = np.log(common) / posterior.common_gain_spread(priors)
    unit = np.zeros((4, where.size))
    unit[np.arange(3), np.arange(where.gains.start, where.gains.stop)] = 1.0
    directions = posterior.points(problem, unit).gain[:3]
    y[where.gains] = np.linalg.lstsq(directions.T, (1.0 + correction) / common - 1.0, rcond=None)[0]


def _best_offset(problem: posterior.Problem, y: Floats) -> float:
    """The offset of all fixes from the trajectory in y."""
    where = posterior.layout(problem)
    column = problem.receiver_rows[:, -1]
    on = column != 0.0
    trajectory = problem.receiver_rows[:, :-1] @ y[where.trajectory]
    return float(
        column[on] @ (problem.receiver_values - trajectory)[on] / (column[on] @ column[on])
    )
