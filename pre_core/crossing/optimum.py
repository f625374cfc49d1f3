"""Method `pre`: search for the optimum of one crossing's posterior.

The negative log posterior has one deep minimum and many shallow ones: with every element free, a
bridge shifted by half a metre fits almost as well with other rigidities. So the search

    1. finds truck and trajectory while the bridge may change only as a whole, with a noise far
       above the actual one, reduced step by step;
    2. scans longitudinal offsets of the bridge (`walk`);
    3. fits all parameters (`fit`) from the best offset, and from the next best ones if that fit is
       poor but not hopeless.

If the result is a misfit because of hum, the search is repeated without the hum (`lines`).
"""

from typing import NamedTuple

import numpy as np

from pre_core.arrays import FloatArray
from pre_core.crossing.comparison import is_better
from pre_core.crossing.deflection import SWING_MODES
from pre_core.crossing.fit import (
    FAR_OFF_CHI2,
    HOPELESS_CHI2,
    NO_FIT_CHI2,
    SMALL_IMPROVEMENT,
    WORTH_COMPLETING_CHI2,
    Optimum,
    SearchStrategy,
    complete_fit,
    fit_all,
    fit_stage,
    is_accepted,
    is_refit_worthwhile,
    resting_mode_indices,
)
from pre_core.crossing.misfit import OffBridgeFit, fit_off_bridge, is_explained_off_bridge
from pre_core.crossing.mismatch import has_equal_tyres
from pre_core.crossing.noise import no_suspension_noise
from pre_core.crossing.off_bridge import levels_at, off_bridge_residuals
from pre_core.crossing.posterior import (
    PosteriorProblem,
    all_rows,
    data_rows,
    has_tandem,
    layout,
    noise_power_ratio,
)
from pre_core.crossing.preparation import (
    CrossingInputs,
    build_problem,
    strongest_line_at_hz,
    update_noise,
    with_line,
)
from pre_core.crossing.refinement import about_truck, refined, with_free_ends, with_full_weight
from pre_core.crossing.rows import RESIDUALS
from pre_core.crossing.walk import Placement, scan_offsets, shifted_to
from pre_core.search import levenberg_marquardt
from pre_core.search.loop import Report, Termination

_COARSE = ((300.0, 4), (100.0, 4), (30.0, 4))
"""Temperatures and steps of the first stage, with the bridge as a whole."""
_COARSE_WITH_MISMATCH = (*_COARSE, (10.0, 4))
"""First stage with mismatch, which is noise from the beginning, estimated again after every step:
with sensor noise alone the search would fail."""
NOISY, HOPELESS_NOISE = 2.0, 25.0
"""Noise power ratio, the same in all body equations, above which the fit inflates the noise; above
the second the sensor is not the declared one, or broken."""
_CLEAR_MISMATCH = 200.0
"""Mean square of whitened residuals off the bridge after the first stage: of 100 drawn crossings of
one profile 130 at most and mostly below 25, with twin tyres on the best class of road 200,000."""
_SAME_MINIMUM_M = 0.2
"""Distance within which offsets lead to one minimum."""
_HOPELESS_CHI2 = (FAR_OFF_CHI2, HOPELESS_CHI2)
"""Values of chi2 above which no other offset is tried, after one candidate and after more. Of 70
drawn fault-free crossings the first candidate was right in all; another one never reduced such a
chi2 to a usable one."""
_MAX_EVALUATIONS = 100_000
"""Limit of a whole search. The sample takes 2,000, a site file with two supports too many 65,000:
beyond this a search has failed, and its numbers are not reliable."""
_MAX_ABOUT_TRUCK = 16_000
"""Limit of evaluations for other bridges about a truck, five times those of a plain crossing."""
_WRONG_BRIDGE_CHI2 = 50.0
"""Value of chi2 above which no other bridge is tried about a truck: where the search had ended at
another frequency it was 1.5 to 25, with a vehicle following up to 1,900."""
_MAX_LINES = 3
"""Limit of removed lines, hum and its harmonics: a truck on a road causes no more."""
_SIMPLEST = SearchStrategy(SWING_MODES, True, 1, False)
_WITHOUT_MISMATCH = (
    SearchStrategy(SWING_MODES - 1, True, 4, False),
    SearchStrategy(0, False, 4, False),
)
WITH_MISMATCH = (SearchStrategy(SWING_MODES, True, 1, True), SearchStrategy(0, False, 4, True))
"""Strategies in the order of trial, the simplest first, until one ends at a fit: each superfluous
freedom may mislead the search. Of 40 drawn crossings and 36 with unexpected bearings, spans or
tyres the first found all but one, which the second found."""


class _Budget(NamedTuple):
    """Limits of the search by one strategy."""

    evaluations: int
    """Number after which no other candidate is tried."""
    chi2: float
    """Value of chi2 above which an unfinished fit is not completed."""


def _whole_bridge(problem: PosteriorProblem, strategy: SearchStrategy) -> FloatArray:
    """Return directions (f, d) in which all elements change together, the ends and torsion not."""
    where = layout(problem)
    unit = np.eye(where.size)
    elements = where.elements
    ends = where.half_normal[where.half_normal >= where.bridge[0]]
    held = [*elements, *ends, *resting_mode_indices(problem, strategy)]
    single = np.setdiff1d(np.arange(where.size), held)
    together = unit[:, elements].sum(axis=1) / np.sqrt(elements.size)
    return np.column_stack([unit[:, single], together])


def find_optimum(inputs: CrossingInputs, report: Report = lambda stage, fraction: None) -> Optimum:
    """Return the optimum of the posterior; a search that fails is a value, too.

    Its `ending` is NOT_FINITE if no offset gave finite residuals, and STEPS_EXHAUSTED if the search
    took more than `_MAX_EVALUATIONS` without a fit.
    """
    problem, y = build_problem(inputs)
    latest = found = _run_strategies(problem, y, report, _MAX_EVALUATIONS)
    while not _is_final(latest[-1]):
        line_hz = next((hz for hz in map(_line_hz, reversed(latest)) if hz > 0.0), 0.0)
        if line_hz == 0.0:
            break
        problem = with_line(problem, y, line_hz)
        left = _MAX_EVALUATIONS - _evaluations_of_all(found)
        latest = _run_strategies(problem, y, report, left)
        found = [*found, *latest]
    best = min(found, key=lambda one: (one.noise_power <= HOPELESS_NOISE, one.chi2_per_dof))
    evaluations = _evaluations_of_all(found)
    is_lost = evaluations > _MAX_EVALUATIONS and not _is_final(best)
    if is_lost and best.ending is not Termination.NOT_FINITE:
        best = best._replace(ending=Termination.STEPS_EXHAUSTED)
    return best._replace(evaluations=evaluations, starts=sum(one.starts for one in found))


def _evaluations_of_all(found: list[Optimum]) -> int:
    return sum(one.evaluations for one in found)


def _run_strategies(
    problem: PosteriorProblem, y: FloatArray, report: Report, max_evaluations: int
) -> list[Optimum]:
    """Return the optima of the strategies, up to the first that is final or shows a line.

    If there is none, the best one is fitted to its end, then other bridges are tried.
    """
    simplest = _SIMPLEST
    if has_tandem(problem):
        simplest = WITH_MISMATCH[0 if problem.crossing.tandem.is_equalised else 1]
    budget = _Budget(max_evaluations, WORTH_COMPLETING_CHI2)
    found = [_refine_candidates(problem, y, simplest, report, budget)]
    if _has_ended(found):
        return [with_full_weight(found[0], _WITHOUT_MISMATCH[0], _MAX_ABOUT_TRUCK)]
    first = found[0]
    strategies, alone = _other_strategies(first)
    found[0] = first._replace(evaluations=first.evaluations + alone.evaluations)
    found += _try_strategies(problem, y, strategies, found[0], report, max_evaluations)
    best = min(range(len(found)), key=lambda k: found[k].chi2_per_dof)
    if found[best].chi2_per_dof <= NO_FIT_CHI2 and not _has_ended(found):
        found.append(complete_fit(found.pop(best)))
    if not _has_ended(found) and is_explained_off_bridge(first.problem, alone):
        other, used = _about_truck(first, alone, found, report, max_evaluations)
        found[-1] = found[-1]._replace(evaluations=found[-1].evaluations + used)
        found += [] if other is None else [other._replace(evaluations=0)]
    return found


def _has_ended(found: list[Optimum]) -> bool:
    """Return whether the search ended: at a final optimum, or at a line to remove."""
    return _is_final(found[-1]) or any(_line_hz(one) > 0.0 for one in found)


def _line_hz(found: Optimum) -> float:
    """Return the frequency in Hz of a line to remove before a repeated search, 0 without any."""
    if len(found.problem.lines_hz) == _MAX_LINES:
        return 0.0
    return strongest_line_at_hz(found.problem, found.state.y)


def _about_truck(
    first: Optimum, alone: OffBridgeFit, found: list[Optimum], report: Report, max_evaluations: int
) -> tuple[Optimum | None, int]:
    """Return the best optimum of other bridges about the truck off the bridge, and evaluations.

    The truck explains what is off the bridge better than `found` explain all; None if no bridge
    fits better than these.
    """
    chi2 = min(one.chi2_per_dof for one in found)
    if not alone.chi2 < chi2 <= _WRONG_BRIDGE_CHI2:
        return None, 0
    report("trying other bridges", 0.55)
    left = min(_MAX_ABOUT_TRUCK, max_evaluations - _evaluations_of_all(found))
    other, used = about_truck(first, alone.y, _WITHOUT_MISMATCH[0], left, chi2)
    return (None if other is None or other.chi2_per_dof >= chi2 else other), used


def _other_strategies(fit: Optimum) -> tuple[tuple[SearchStrategy, ...], OffBridgeFit]:
    """Return the strategies to try after the simplest one, and the fit of the truck alone.

    Where a linear truck on one profile explains the residuals off the bridge, no other truck is
    tried. A suspension that is not linear resembles mismatch until its weight is reduced.
    """
    full_weight, reduced_weight = _WITHOUT_MISMATCH
    strategies: tuple[SearchStrategy, ...] = (reduced_weight, *WITH_MISMATCH, full_weight)
    if fit.stopped_by_mismatch or fit.stopped_by_friction or fit.problem.mismatch.level_m3.any():
        return strategies, OffBridgeFit(fit.state.y, np.inf, 0)
    alone = fit_off_bridge(fit)
    if is_explained_off_bridge(fit.problem, alone):
        strategies = (full_weight,)
    return strategies, alone


def _try_strategies(
    problem: PosteriorProblem,
    y: FloatArray,
    strategies: tuple[SearchStrategy, ...],
    first: Optimum,
    report: Report,
    max_evaluations: int,
) -> list[Optimum]:
    """Return the optima of the strategies after the first one, up to the first that is final.

    A line ends them, too, but only if mismatch is modelled or no longer to be tried: unmodelled
    mismatch resembles a line.
    """
    found: list[Optimum] = []
    has_friction, has_line = first.stopped_by_friction, False
    for strategy in strategies:
        if has_line and not strategy.models_mismatch:
            break
        if has_friction and strategy.uses_suspension:
            continue
        budget = _budget_left(max_evaluations, [first, *found])
        if budget.evaluations <= 0:
            break
        found.append(_refine_candidates(problem, y, strategy, report, budget))
        has_friction = found[-1].stopped_by_friction
        if _is_final(found[-1]):
            break
        has_line = has_line or _line_hz(found[-1]) > 0.0
        if has_line and strategy.models_mismatch:
            break
    return found


def _budget_left(max_evaluations: int, found: list[Optimum]) -> _Budget:
    """Return the budget of another strategy after those that ended at `found`."""
    reached = min((one.chi2_per_dof for one in found if one.unfinished is None), default=np.inf)
    return _Budget(
        max_evaluations - _evaluations_of_all(found),
        min(WORTH_COMPLETING_CHI2, (1.0 - SMALL_IMPROVEMENT) * reached),
    )


def _is_final(found: Optimum) -> bool:
    """Return whether no other strategy is worth a try: a fit, or a hopeless case."""
    is_hopeless = found.noise_power > HOPELESS_NOISE
    return is_hopeless or is_accepted(found.problem, found.chi2_per_dof)


def _refine_candidates(
    problem: PosteriorProblem,
    y: FloatArray,
    strategy: SearchStrategy,
    report: Report,
    budget: _Budget,
) -> Optimum:
    """Return the best optimum of a strategy; the result of `_no_optimum` if it diverges."""
    try:
        return _refine_likeliest(problem, y, strategy, report, budget)
    except (FloatingPointError, np.linalg.LinAlgError):
        return _no_optimum(problem, y, 0, 0)


def _refine_likeliest(
    problem: PosteriorProblem,
    y: FloatArray,
    strategy: SearchStrategy,
    report: Report,
    budget: _Budget,
) -> Optimum:
    """Return the best optimum reached from the most likely offsets.

    It is the result of `_no_optimum` as soon as a candidate shows that the strategy is wrong.
    """
    force = no_suspension_noise() if strategy.uses_suspension else None
    # With the noise of a tandem's front axles, offsets metres apart would fit alike.
    front_axles, problem = problem.front_axles, problem._replace(front_axles=())
    problem, y, evaluations = _find_truck(problem, y, strategy, report, force)
    power = noise_power_ratio(problem, y)
    if power > HOPELESS_NOISE:
        return _no_optimum(problem, y, evaluations, 0)._replace(noise_power=power)
    if power > NOISY:
        problem = problem._replace(density=problem.density * np.sqrt(power))
        problem = update_noise(problem, y, force)
    else:
        power = 1.0
    if not strategy.models_mismatch and _has_clear_mismatch(problem, y):
        return _no_optimum(problem, y, evaluations, 0, has_mismatch=True)
    report("finding the bridge", 0.2)
    places, used = scan_offsets(problem, y, strategy)
    problem, evaluations = problem._replace(front_axles=front_axles), evaluations + used
    budget = budget._replace(evaluations=budget.evaluations - evaluations)
    best, tried, used, has_friction = _fit_candidates(problem, y, places, strategy, report, budget)
    evaluations += used
    if best is None:
        return _no_optimum(problem, y, evaluations, tried, has_friction=has_friction)
    if best.unfinished is not None and best.chi2_per_dof <= budget.chi2:
        completed = complete_fit(best)
        evaluations += completed.evaluations - best.evaluations
        best, used = refined(completed, strategy, budget.evaluations - used)
        evaluations += used
    best, used = with_free_ends(best, strategy)
    return best._replace(
        evaluations=evaluations + used,
        starts=tried,
        stopped_by_friction=has_friction,
        noise_power=power * _excess_noise_power(best),
    )


class _FittedCandidates(NamedTuple):
    """Best optimum of the candidates, if any; number tried, evaluations, and clear friction."""

    best: Optimum | None
    tried: int
    evaluations: int
    has_friction: bool


def _fit_candidates(
    problem: PosteriorProblem,
    y: FloatArray,
    places: list[Placement],
    strategy: SearchStrategy,
    report: Report,
    budget: _Budget,
) -> _FittedCandidates:
    """Fit all parameters from the candidate offsets, best first, until no other is worth a try."""
    best: Optimum | None = None
    evaluations, has_friction = 0, False
    tried: list[float] = []
    for place in places:
        if any(abs(place.shift_m - other) < _SAME_MINIMUM_M for other in tried):
            continue
        tried.append(place.shift_m)
        report(f"freeing the elements, start {len(tried)}", 0.3 + 0.05 * len(tried))
        found, used = fit_all(problem, shifted_to(problem, y, place), strategy)
        evaluations += used
        if found is None:
            has_friction = True
            break
        if found.unfinished is None:
            found, used = refined(found, strategy, budget.evaluations - evaluations)
            evaluations += used
        last_chi2 = np.inf if best is None else best.chi2_per_dof
        if best is None or is_better(found, best):
            best = found
        is_last = len(tried) == strategy.max_candidates or evaluations > budget.evaluations
        if is_last or _is_last_offset(best, found, last_chi2, len(tried)):
            break
    return _FittedCandidates(best, len(tried), evaluations, has_friction)


def _is_last_offset(best: Optimum, found: Optimum, last_chi2: float, tried: int) -> bool:
    """Return whether no other offset is worth a try after `found`, the last of `tried`.

    `last_chi2` is that of the best one before.
    """
    if is_accepted(best.problem, best.chi2_per_dof):
        return True
    strategy = found.unfinished
    if strategy is not None and strategy.uses_suspension and found.chi2_per_dof > NO_FIT_CHI2:
        return True
    may_be_last = strategy is not None or found.problem.force.any()
    if may_be_last and not is_refit_worthwhile(found.chi2_per_dof, last_chi2):
        return True
    return best.chi2_per_dof > _HOPELESS_CHI2[min(tried, len(_HOPELESS_CHI2)) - 1]


def _find_truck(
    problem: PosteriorProblem,
    y: FloatArray,
    strategy: SearchStrategy,
    report: Report,
    force: FloatArray | None,
) -> tuple[PosteriorProblem, FloatArray, int]:
    """Return problem, y (f,) and evaluations of the first stage, which scales the whole bridge.

    Similar profiles (tandem, equal tyres) differ less than a wrong truck makes them differ, so the
    truck is fitted before the mismatch. Otherwise the search would follow a spurious mismatch
    towards ever softer tyres.
    """
    whole = _whole_bridge(problem, strategy)
    is_alike = has_tandem(problem) or has_equal_tyres(*problem.mismatch.shapes.footprints)

    def with_force(problem: PosteriorProblem, y: FloatArray) -> PosteriorProblem:
        return update_noise(problem, y, force)

    evaluations = 0
    if strategy.models_mismatch and not is_alike:
        problem = update_noise(problem, y, force, mismatch=levels_at(problem, y))
    for temperature, steps in _COARSE_WITH_MISMATCH if strategy.models_mismatch else _COARSE:
        report("finding the truck", 0.05)
        problem, y, _, used = fit_stage(problem, y, whole, (temperature, steps, 0.5), with_force)
        evaluations += used
        problem = update_noise(problem, y, force)
    if strategy.models_mismatch and is_alike:
        problem = update_noise(problem, y, force, mismatch=levels_at(problem, y))
    return problem, y, evaluations


def _excess_noise_power(found: Optimum) -> float:
    """Return `noise_power_ratio` at an optimum, 1 if it is not clear."""
    power = noise_power_ratio(found.problem, found.state.y)
    return power if power > NOISY else 1.0


def _no_optimum(
    problem: PosteriorProblem,
    y: FloatArray,
    evaluations: int,
    starts: int,
    *,
    has_friction: bool = False,
    has_mismatch: bool = False,
) -> Optimum:
    """Return the result of a search that ended without an optimum."""
    state = levenberg_marquardt.initial_state(lambda at: all_rows(problem, at), y)
    ending = Termination.NOT_FINITE
    return Optimum(problem, state, ending, np.inf, evaluations, starts, has_friction, has_mismatch)


def _has_clear_mismatch(problem: PosteriorProblem, y: FloatArray) -> bool:
    """Return whether residuals off the bridge exceed those of one profile after the first stage."""
    rows = data_rows(problem, y[None, :])[0].reshape(-1, RESIDUALS)[:, 0]
    off = np.concatenate([rows[one] for one in off_bridge_residuals(problem, y)])
    return off.size > 0 and float(off @ off) / off.size > _CLEAR_MISMATCH
