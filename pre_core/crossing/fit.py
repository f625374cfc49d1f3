"""Least squares of a crossing from one offset of the bridge: steps, bounds and noise rounds.

Truck and trajectory reach the optimum near a start, while the noise is estimated from the residuals
again as the truck changes. `optimum` searches for the right start.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pre_core.arrays import FloatArray
from pre_core.crossing.noise import FRICTION_STATISTIC_OF_MISFIT, no_suspension_noise
from pre_core.crossing.posterior import (
    PosteriorProblem,
    all_rows,
    data_rows,
    has_tandem,
    layout,
    points,
    posterior_covariance,
    precision_root,
    suspension_equation_weight,
)
from pre_core.crossing.preparation import swing_sample, update_noise
from pre_core.crossing.rows import RESIDUALS
from pre_core.parameters import TORSION, F
from pre_core.search import levenberg_marquardt
from pre_core.search.levenberg_marquardt import Rows, minimise
from pre_core.search.loop import SearchResult, Termination

_FREE_STAGES = ((5.0, 8, 0.2), (1.0, 25, 0.1))
"""Temperatures (factors of the noise), steps at each, and the improvement of the sum of squares
that ends it."""
_CLEAR_FRICTION_WEIGHT = 0.05
"""Weight of the body equations below which full weight is not tried: friction is clear."""
NO_FIT_CHI2 = 10.0
"""Value of chi2 at five times the noise above which no fit is completed and a strategy with full
weight of the body equations ends: right starts of 90 simulated crossings had 1.6 at most, wrong
ones 10 to 70."""
_POOR_START_CHI2, WORTH_COMPLETING_CHI2 = 1.7, 5.0
"""Values of chi2 at five times the noise: above the first a fit is left unfinished until the other
offsets have been tried, above the second also until other strategies have been. Of 50 accepted fits
one had 3.7, all others 1.7 at most; fits without mismatch of fault-free crossings that have it had
2 to 20."""
FAR_OFF_CHI2 = 200.0
"""Value of chi2 at five times the noise, with reduced weight of the body equations, above which a
fit is not continued and, after a first fit, no other offset is tried: fault-free crossings had 13
at most from an offset, one with a second vehicle up to 1,900."""
HOPELESS_CHI2 = 25.0
"""Value of chi2 above which a fit is not repeated with other noise or free ends, and above which,
after two offsets, no third one is tried."""
_MAX_ROUNDS, _EARLY_ROUNDS = 6, 2
"""Limits of alternating fits and noise estimates: in the last stage and in earlier ones."""
_MAX_STEPS, _EARLY_STEPS = 25, 8
"""Limits of steps with mismatch, whose noise is estimated before every step: in the last stage and
in earlier ones."""
_MORE_STEPS = 50
"""Limit of further steps where the first ones ended at an accepted fit: the valley of one crossing
with equal tyres took 37, that of the same crossing at another time of day fewer than 25."""
_MIN_IMPROVEMENT_WITH_MISMATCH = 0.5
"""Improvement of the sum of squares that ends a search with mismatch, far within the uncertainty of
poorly determined parameters."""
_SAME_LEVEL = 0.1
"""Relative change of a noise level that counts as converged."""
_CLEAR_MISFIT = 5.0
"""Mean square of residuals and priors, with reduced weight of the body equations, above which
a minimum need not be exact."""
SMALL_IMPROVEMENT, _CLEAR_MISFIT_CHI2 = 0.05, 2.0
"""Relative reduction of chi2 below which no other noise or offset is tried at a clear misfit, and
the chi2 of such a misfit. Of 16 fault-free crossings with mismatch, fits without it from four
offsets had 1.9 to 12, within 12 % of each other."""
_ACCEPTED_Z, _ACCEPTED_EXCESS = 3.0, 0.05
"""Limits of chi2 above one for an accepted minimum: chance in standard deviations, plus errors of
the noise model."""
_EXCESS_WITH_MISMATCH = 0.25
"""Error of the noise model with mismatch, whose level follows from a few waves."""


class SearchStrategy(NamedTuple):
    """Simplifications of the model in a search, and its number of starts."""

    modes_at_rest: int
    """Number of the bridge's highest modes without initial vibration."""
    uses_suspension: bool
    """Whether the body equations have full weight; such a search stops at clear friction."""
    max_candidates: int
    """Maximum number of candidate offsets from which all parameters are fitted."""
    models_mismatch: bool
    """Whether profile mismatch is modelled from the first step; its level may become zero."""


RefreshNoise = Callable[[PosteriorProblem, FloatArray], PosteriorProblem]
"""Function that returns the problem with its noise estimated at a point y (f,)."""


class Optimum(NamedTuple):
    """Result of a search; `chi2_per_dof` is of the data relative to the declared noise."""

    problem: PosteriorProblem
    state: levenberg_marquardt.LMState
    ending: Termination
    chi2_per_dof: float
    evaluations: int
    starts: int
    """Number of offsets from which all parameters were fitted."""
    stopped_by_friction: bool = False
    """Whether a search with full weight of the body equations was abandoned for friction."""
    stopped_by_mismatch: bool = False
    """Whether a search without mismatch was abandoned because of a clear mismatch."""
    unfinished: SearchStrategy | None = None
    """Strategy of a fit whose first stage ended at a poor start: `complete_fit` continues it."""
    noise_power: float = 1.0
    """Noise power ratio where it clearly exceeds one, which resembles friction and mismatch. Up to
    `HOPELESS_NOISE` the fit used it."""
    rivals: tuple[FloatArray, ...] = ()
    """Points (f,) with other bridges that explain the residuals nearly as well."""


def chi2_per_dof(problem: PosteriorProblem, y: FloatArray) -> float:
    """Return the mean square of whitened residuals at y (f,), per degree of freedom.

    Each search coordinate and each removed wave takes one degree of freedom. With reduced weight of
    the body equations only the mismatch residuals count, and a third of these coordinates and
    waves.
    """
    rows = data_rows(problem, y[None, :])[0, :: chi2_stride(problem)]
    taken = (y.size + problem.noise.lines.shape[1]) / chi2_stride(problem)
    return float(rows @ rows) / max(1.0, rows.size - taken)


def chi2_stride(problem: PosteriorProblem) -> int:
    """Return the stride between the whitened residuals that chi2 covers."""
    return RESIDUALS if problem.force.any() or has_tandem(problem) else 1


def tempered_residuals(
    problem: PosteriorProblem, y: FloatArray, directions: FloatArray, temperature: float
) -> Rows:
    """Return the function from steps v (k, d) along directions (f, d) from y (f,) to residuals."""
    return lambda v: all_rows(problem, y + v @ directions.T, temperature)


def _descend(
    problem: PosteriorProblem,
    y: FloatArray,
    directions: FloatArray,
    temperature: float,
    steps: int,
    tolerance: float,
    is_free: bool = False,
) -> tuple[FloatArray, levenberg_marquardt.LMState, Termination, int]:
    """Minimise along `directions` (f, d) from y until a step improves by less than `tolerance`."""
    rows = tempered_residuals(problem, y, directions, temperature)
    start = np.zeros(directions.shape[1])
    lower = lower_bounds(problem, y, directions, is_free=is_free)
    misfit = _CLEAR_MISFIT if problem.force.any() else np.inf
    found = minimise(rows, start, steps, tolerance, lower, uses_broyden=is_free, misfit=misfit)
    return y + directions @ found.state.y, found.state, found.ending, evaluations_of(found)


def lower_bounds(
    problem: PosteriorProblem, y: FloatArray, directions: FloatArray, *, is_free: bool
) -> FloatArray:
    """Return lower bounds (d,) of the steps along directions (f, d), -inf where there is none.

    Each restricted coordinate changes along one direction only. During the search (`is_free`)
    stiffness and damping coordinates may become negative, which avoids getting stuck at zero;
    bearing compliance and torsional flexibility may not.
    """
    lower = np.full(directions.shape[1], -np.inf)
    held = layout(problem).half_normal
    if is_free:
        kept = np.flatnonzero(problem.priors.estimated)
        held = held[np.isin(kept[held], (F, F + 1, TORSION))]
    for place in held:
        for along in np.flatnonzero(directions[place]):
            lower[along] = -y[place] / directions[place, along]
    return lower


def evaluations_of(
    found: SearchResult[levenberg_marquardt.LMState, levenberg_marquardt.LMInfo],
) -> int:
    """Return the number of evaluations by forward differences, the first Jacobian included."""
    return found.state.y.size + 1 + sum(info.evaluations for info in found.infos)


def resting_mode_indices(problem: PosteriorProblem, strategy: SearchStrategy) -> NDArray[np.int64]:
    """Return the indices (m,) in y of the modes without initial vibration."""
    swing = layout(problem).swing
    return np.arange(swing.stop - 2 * strategy.modes_at_rest, swing.stop)


def _not_negative(problem: PosteriorProblem, y: FloatArray) -> FloatArray:
    """Return y with negative values of restricted coordinates replaced by zero."""
    zero = layout(problem).half_normal
    y = y.copy()
    y[zero] = np.maximum(y[zero], 0.0)
    return y


def is_accepted(problem: PosteriorProblem, chi2: float) -> bool:
    """Return whether a minimum of this chi2 is accepted."""
    judged = problem.noise.reciprocal.size // chi2_stride(problem)
    excess = _EXCESS_WITH_MISMATCH if problem.mismatch.level_m3.any() else _ACCEPTED_EXCESS
    return chi2 < 1.0 + excess + _ACCEPTED_Z * float(np.sqrt(2.0 / judged))


def is_refit_worthwhile(chi2: float, last: float) -> bool:
    """Return whether another fit is worthwhile after one that took chi2 from `last` to `chi2`."""
    return chi2 <= max(_CLEAR_MISFIT_CHI2, (1.0 - SMALL_IMPROVEMENT) * last)


def fit_all(
    problem: PosteriorProblem, y: FloatArray, strategy: SearchStrategy
) -> tuple[Optimum | None, int]:
    """Fit all parameters from y (f,); return the optimum, if there is one, and evaluations.

    Negative stiffness and damping coordinates are fixed at zero, and the others brought to the
    neighbouring optimum. `normal_approximation` accounts for the remaining gradient.

    The residuals of the body equations and their weight depend on each other: with low weight the
    truck need not fit. So the first fit has full weight, which is reduced only where these
    residuals then exceed sensor noise. A strategy with full weight ends without optimum at clear
    friction.
    """
    front = points(problem, y[None, :]).position_m[0]
    crossing = problem.crossing
    problem = problem._replace(
        crossing=crossing._replace(swing_sample=swing_sample(crossing, front))
    )
    start = y.copy()
    start[layout(problem).swing] = 0.0
    free = np.eye(start.size)
    first = _first_directions(problem, strategy)
    at_full_weight = _at_full_weight(problem, start)
    at_full_weight, y, ending, evaluations = fit_stage(
        at_full_weight, start, first, _FREE_STAGES[0], _at_full_weight
    )
    at_full_weight = _at_full_weight(at_full_weight, y)
    problem = update_noise(at_full_weight, y)
    has_friction = (
        problem.force.any() and suspension_equation_weight(problem, y) < _CLEAR_FRICTION_WEIGHT
    )
    if strategy.uses_suspension and has_friction:
        return None, evaluations
    is_reduced = has_friction or (problem.force.any() and not strategy.uses_suspension)
    problem = at_full_weight
    if is_reduced:
        problem = update_noise(at_full_weight, start)
        problem, y, ending, used = fit_stage(problem, start, free, _FREE_STAGES[0], update_noise)
        evaluations += used
    if chi2_per_dof(problem, y) > _POOR_START_CHI2:
        found = _optimum_at(problem, y, ending)._replace(unfinished=strategy)
    else:
        found = _completed(problem, y, strategy)
    evaluations += found.evaluations
    return found._replace(evaluations=evaluations), evaluations


def _first_directions(problem: PosteriorProblem, strategy: SearchStrategy) -> FloatArray:
    """Return the directions (f, d) of a first fit, with the highest modes at rest."""
    free = np.eye(layout(problem).size)
    return np.delete(free, resting_mode_indices(problem, strategy), axis=1)


def complete_fit(found: Optimum) -> Optimum:
    """Return the optimum to which an unfinished one leads; the same if it is finished."""
    if found.unfinished is None:
        return found
    there = _completed(found.problem, found.state.y, found.unfinished)
    return there._replace(
        evaluations=found.evaluations + there.evaluations,
        starts=found.starts,
        noise_power=found.noise_power,
    )


def _completed(problem: PosteriorProblem, y: FloatArray, strategy: SearchStrategy) -> Optimum:
    """Return the optimum to which y (f,) leads after the first stage."""
    ending, evaluations = Termination.STEPS_EXHAUSTED, 0
    free = np.eye(y.size)
    if not problem.force.any():
        first = _first_directions(problem, strategy)
        for is_free, rounds in ((True, _EARLY_ROUNDS), (False, _MAX_ROUNDS)):
            y = y if is_free else _not_negative(problem, y)
            problem = _at_full_weight(problem, y)
            along = first if is_free else free
            problem, y, ending, used = _fit_in_noise_rounds(
                problem, y, along, rounds, _at_full_weight, is_free=is_free
            )
            evaluations += used
    problem = update_noise(problem, y)
    y = _not_negative(problem, y)
    if not (problem.force.any() or is_accepted(problem, chi2_per_dof(problem, y))):
        problem = _at_misfit(problem, y)
    if problem.force.any():
        problem, y, ending, used = _fit_at_misfit(problem, y, free)
        evaluations += used
    found = _optimum_at(problem, y, ending)
    return found._replace(evaluations=evaluations + found.evaluations)


def _optimum_at(problem: PosteriorProblem, y: FloatArray, ending: Termination) -> Optimum:
    """Return the optimum at y, of one start, with the evaluations of its Jacobian."""
    state = levenberg_marquardt.initial_state(lambda at: all_rows(problem, at), y)
    return Optimum(problem, state, ending, chi2_per_dof(problem, y), y.size + 1, 1)


def _at_full_weight(problem: PosteriorProblem, y: FloatArray) -> PosteriorProblem:
    return update_noise(problem, y, no_suspension_noise())


def _fit_at_misfit(
    problem: PosteriorProblem, y: FloatArray, directions: FloatArray
) -> tuple[PosteriorProblem, FloatArray, Termination, int]:
    """Fit along `directions` (f, d) at reduced weight of the suspension, unless y is far off."""
    if chi2_per_dof(problem, y) > FAR_OFF_CHI2:
        return problem, y, Termination.STEPS_EXHAUSTED, 0
    return _fit_in_noise_rounds(problem, y, directions, _MAX_ROUNDS, _at_misfit)


def _at_misfit(problem: PosteriorProblem, y: FloatArray) -> PosteriorProblem:
    return update_noise(problem, y, friction_statistic=FRICTION_STATISTIC_OF_MISFIT)


def _fit_in_noise_rounds(
    problem: PosteriorProblem,
    y: FloatArray,
    directions: FloatArray,
    rounds: int,
    refresh_noise: RefreshNoise,
    *,
    is_free: bool = False,
) -> tuple[PosteriorProblem, FloatArray, Termination, int]:
    """Fit from y until the noise estimated from the residuals converges.

    `refresh_noise` estimates it: without mismatch after each of at most `rounds` fits, with
    mismatch before every step (`_fit_in_noise_steps`).
    """
    temperature, steps, tolerance = _FREE_STAGES[-1]
    evaluations = 0
    if problem.mismatch.level_m3.any():
        for most in (_EARLY_STEPS,) if is_free else (_MAX_STEPS, _MORE_STEPS):
            problem, y, ending, used = _fit_in_noise_steps(
                problem, y, directions, temperature, most, refresh_noise, is_free=is_free
            )
            evaluations += used
            is_done = ending is not Termination.STEPS_EXHAUSTED
            if is_done or not is_accepted(problem, chi2_per_dof(problem, y)):
                break
        if problem.mismatch.level_m3.any():
            return problem, y, ending, evaluations
    chi2 = np.inf
    for _ in range(rounds):
        y, _, ending, used = _descend(
            problem, y, directions, temperature, steps, tolerance, is_free=is_free
        )
        evaluations += used
        last_chi2, chi2 = chi2, chi2_per_dof(problem, y)
        if not problem.force.any() or chi2 > HOPELESS_CHI2:
            break
        if not is_refit_worthwhile(chi2, last_chi2):
            break
        before, problem = problem, refresh_noise(problem, y)
        if abs(before.force.sum() - problem.force.sum()) <= _SAME_LEVEL * before.force.sum():
            break
    return problem, y, ending, evaluations


def fit_stage(
    problem: PosteriorProblem,
    y: FloatArray,
    directions: FloatArray,
    stage: tuple[float, int, float],
    refresh_noise: RefreshNoise,
) -> tuple[PosteriorProblem, FloatArray, Termination, int]:
    """Fit along directions (f, d) in one stage before the last.

    Return problem, y, termination and number of evaluations. With mismatch `refresh_noise`
    estimates the noise before every step. `stage`: temperature, steps, `tolerance` of `_descend`.
    """
    temperature, steps, tolerance = stage
    if problem.mismatch.level_m3.any():
        return _fit_in_noise_steps(
            problem, y, directions, temperature, steps, refresh_noise, is_free=True
        )
    y, _, ending, used = _descend(
        problem, y, directions, temperature, steps, tolerance, is_free=True
    )
    return problem, y, ending, used


def _fit_in_noise_steps(
    problem: PosteriorProblem,
    y: FloatArray,
    directions: FloatArray,
    temperature: float,
    steps: int,
    refresh_noise: RefreshNoise,
    *,
    is_free: bool = False,
) -> tuple[PosteriorProblem, FloatArray, Termination, int]:
    """Take steps along `directions` (f, d) from y, estimating the noise before each of them.

    The gradient correction for the mismatch (errors in variables) is as large as the information of
    the residuals on a truck with friction, and belongs to the truck at which it was computed: along
    a valley of loads, axle masses and tyres with equal profiles it turns with the valley. Fixed for
    a few steps, it led a third of such trucks away without end; updated in each step it ends at the
    right one, starting from the data sheet.
    """
    evaluations = 0
    ending = Termination.STEPS_EXHAUSTED
    damping: float | None = None
    last, share = np.zeros(1), 1.0
    for _ in range(steps):
        problem = refresh_noise(problem, y)
        rows = tempered_residuals(problem, y, directions, temperature)
        here = levenberg_marquardt.initial_state(rows, np.zeros(directions.shape[1]))
        if damping is not None:
            here = here._replace(damping=damping)
        there = levenberg_marquardt.trial_step(
            rows, here, lower_bounds(problem, y, directions, is_free=is_free)
        )
        evaluations += here.y.size + 1
        if not isinstance(there, levenberg_marquardt.TrialStep):
            ending = there[1].ending or ending
            evaluations += there[1].evaluations
            if ending is Termination.STUCK:
                ending = Termination.CONVERGED
            break
        evaluations += there.evaluations
        # A step that turns back has passed its target, which moves with the noise.
        step = here.jacobian @ there.y
        share = 0.5 * share if float(np.sum(step * last)) < 0.0 else min(1.0, 2.0 * share)
        y = y + share * (directions @ there.y)
        last, damping = step, there.damping
        if here.objective - there.objective < _MIN_IMPROVEMENT_WITH_MISMATCH:
            ending = Termination.CONVERGED
            break
    return problem, y, ending, evaluations


def normal_approximation(found: Optimum) -> tuple[FloatArray, FloatArray]:
    """Return mean (f,) and covariance (f, f) of the Gauss-Newton approximation at the optimum."""
    spread = posterior_covariance(precision_root(found.state.jacobian))
    slope = found.state.jacobian.T @ found.state.residual
    return found.state.y - spread @ slope, spread
