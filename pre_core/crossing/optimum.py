"""Method `pre`: search for the optimum of one crossing's posterior.

The posterior has one deep minimum and many shallow ones: with every element free, a bridge placed
half a metre too far can be explained almost as well by other rigidities. So the search

    1. finds truck and trajectory while the bridge may change only as a whole, with a noise far
       above the actual one, reduced step by step;
    2. scans longitudinal offsets of the bridge (`walk`);
    3. frees everything (`fit`) from the best offset, and from the next best ones if that does not
       fit, unless it fits so badly that none would.

If this first way ends at a misfit, truck and road are fitted to the residuals off the bridge alone
(`truck_alone`). Where these fit, neither friction nor mismatch can explain the bridge: it is tried
once more from the truck so found, and then given up. Otherwise the other ways follow, those with
mismatch only where reduced suspension weight does not explain the residuals off the bridge either.

If the result is a misfit because of hum, the search is repeated without the hum (`lines`).
"""

import numpy as np

from pre_core.crossing.fit import (
    Optimum,
    SearchStrategy,
    chi2_per_dof,
    fit_stage,
    is_accepted,
    resting_mode_indices,
)
from pre_core.crossing.noise import no_force_noise
from pre_core.crossing.off_bridge import levels_at, off_bridge_residuals
from pre_core.crossing.placing import NOISY, no_optimum, refine_from_truck
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
from pre_core.crossing.residuals import SWING_MODES
from pre_core.crossing.rows import RESIDUALS
from pre_core.crossing.truck_alone import OffBridgeFit, fit_off_bridge
from pre_core.physics.bridge import FloatArray
from pre_core.search import levenberg_marquardt
from pre_core.search.loop import Report, Termination

_COARSE = ((300.0, 4), (100.0, 4), (30.0, 4))
"""Temperatures and steps of the first stage, with the bridge as a whole."""
_COARSE_WITH_MISMATCH = (*_COARSE, (10.0, 4))
"""First stage with mismatch, which is noise from the beginning, estimated again after every step:
with sensor noise alone the search would fail."""
HOPELESS_NOISE = 25.0
"""Noise power ratio above which the sensor is another one, or broken."""
_CLEAR_MISMATCH = 200.0
"""Mean square of whitened residuals off the bridge after the first stage: of 100 drawn crossings of
one profile 130 at most and mostly below 25, with twin tyres on the best class of road 200,000."""
_MAX_EVALUATIONS = 30_000
"""Limit of a whole search. The sample takes 2,000: beyond this a search has failed, and its numbers
are not reliable."""
_MAX_EVALUATIONS_OF_MISFIT, _MISFIT_CHI2 = 12_000, 2.0
"""Evaluations after which no other way or offset is tried where the best way so far ended above
this chi2, which is rejected: three times a whole search with its draws."""
_MAX_LINES = 3
"""Hum and its harmonics; a record with more lines is not one of a truck on a road."""
_SIMPLEST = SearchStrategy(SWING_MODES, True, 1, False)
_NOT_LINEAR_CHI2 = 10.0
"""Value of chi2 off the bridge above which full suspension weight and one profile are not tried
again."""
_CLEAR_MISFIT_CHI2 = 1.5
"""Value of chi2 with reduced suspension weight above which mismatch is tried only where the
residuals off the bridge ask for it."""
_AFTER_OFF_BRIDGE = SearchStrategy(0, True, 2, False)
"""Strategy from a truck that fits off the bridge."""
_MAX_EVALUATIONS_OF_RETRY = 4000
"""Evaluations after which no second offset is tried from there."""
_WITHOUT_MISMATCH = (
    SearchStrategy(SWING_MODES - 1, True, 4, False),
    SearchStrategy(0, False, 4, False),
)
_WITH_MISMATCH = (SearchStrategy(SWING_MODES, True, 1, True), SearchStrategy(0, False, 4, True))
"""The simplest strategy first, then others until one ends at a fit, because each superfluous
freedom may mislead. Of 40 drawn crossings and 36 with unexpected bearings, spans or tyres the first
found all but one, which the second did. Strategies with mismatch precede the others where the
residuals off the bridge show it."""


def _whole_bridge(problem: PosteriorProblem, strategy: SearchStrategy) -> FloatArray:
    """Return directions in which all elements change together, without restraint and compliance."""
    where = layout(problem)
    unit = np.eye(where.size)
    elements = where.elements
    ends = where.half_normal[where.half_normal >= where.bridge[0]]
    held = [*elements, *ends, *resting_mode_indices(problem, strategy)]
    single = np.setdiff1d(np.arange(where.size), held)
    together = unit[:, elements].sum(axis=1) / np.sqrt(elements.size)
    return np.column_stack([unit[:, single], together])


def find_optimum(inputs: CrossingInputs, report: Report = lambda stage, fraction: None) -> Optimum:
    """Return the optimum of the posterior; NOT_FINITE if no offset gave finite residuals.

    Its `ending` is STEPS_EXHAUSTED if the search took more than `_MAX_EVALUATIONS` without a fit.
    """
    problem, y = build_problem(inputs)
    found = _run_strategies(problem, y, report, _MAX_EVALUATIONS)
    while not _is_final(found[-1]) and len(problem.lines_hz) < _MAX_LINES:
        line_hz = strongest_line_at_hz(found[-1].problem, found[-1].state.y)
        if line_hz == 0.0:
            break
        problem = with_line(problem, y, line_hz)
        found += _run_strategies(problem, y, report, _MAX_EVALUATIONS - _evaluations_of_all(found))
    best = min(found, key=lambda one: (one.noise_power <= HOPELESS_NOISE, one.chi2_per_dof))
    evaluations = _evaluations_of_all(found)
    is_given_up = bool(found[-1].fits_off_bridge)
    is_lost = evaluations > _MAX_EVALUATIONS and not (is_given_up or _is_final(best))
    if is_lost and best.ending is not Termination.NOT_FINITE:
        best = best._replace(ending=Termination.STEPS_EXHAUSTED)
    return best._replace(
        evaluations=evaluations,
        starts=sum(one.starts for one in found),
        fits_off_bridge=found[-1].fits_off_bridge,
        off_bridge_y=found[-1].off_bridge_y,
    )


def _evaluations_of_all(found: list[Optimum]) -> int:
    return sum(one.evaluations for one in found)


def _run_strategies(
    problem: PosteriorProblem, y: FloatArray, report: Report, max_evaluations: int
) -> list[Optimum]:
    """Return what the ways led to, up to the first that is final or shows a line."""
    simplest = _SIMPLEST
    if has_tandem(problem):
        simplest = _WITH_MISMATCH[0 if problem.crossing.lead.is_equalised else 1]
    first = _refine_candidates(problem, y, simplest, report, max_evaluations)
    if _has_ended(first):
        return [first]
    is_linear = True
    if not has_tandem(problem):
        off_bridge = fit_off_bridge(problem._replace(density=first.problem.density), y)
        first = first._replace(evaluations=first.evaluations + off_bridge.evaluations)
        if off_bridge.is_accepted:
            return [first, _retry_from(first, off_bridge, report)]
        is_linear = not off_bridge.chi2_per_dof > _NOT_LINEAR_CHI2
    found = _try_other_strategies(problem, y, first, report, max_evaluations, is_linear=is_linear)
    return [first, *found]


def _retry_from(first: Optimum, off_bridge: OffBridgeFit, report: Report) -> Optimum:
    """Return the optimum reached from the truck that fits off the bridge, a misfit at worst."""
    problem, y, used = off_bridge.problem, off_bridge.y, 0
    try:
        # The bridge may still swing from what left it, which no stage so far has looked for.
        problem, y, used = _find_truck(problem, y, _AFTER_OFF_BRIDGE, report, no_force_noise())
        found, nearest = refine_from_truck(
            problem, y, _AFTER_OFF_BRIDGE, report, _MAX_EVALUATIONS_OF_RETRY
        )
    except (FloatingPointError, np.linalg.LinAlgError):
        found, nearest = no_optimum(problem, y, 0, 0), y
    if found.ending is Termination.NOT_FINITE:
        state = levenberg_marquardt.initial_state(lambda at: all_rows(problem, at), nearest)
        found = found._replace(
            problem=problem,
            state=state,
            ending=Termination.STEPS_EXHAUSTED,
            chi2_per_dof=chi2_per_dof(problem, nearest),
            evaluations=found.evaluations + y.size + 1,
        )
    found = found._replace(
        evaluations=found.evaluations + used,
        noise_power=max(found.noise_power, first.noise_power),
    )
    if is_accepted(found.problem, found.chi2_per_dof):
        return found
    return found._replace(fits_off_bridge=True, off_bridge_y=off_bridge.y)


def _has_ended(found: Optimum) -> bool:
    """Whether no other way is tried: this is final, or a line is to be silenced first."""
    if _is_final(found) or len(found.problem.lines_hz) == _MAX_LINES:
        return _is_final(found)
    return strongest_line_at_hz(found.problem, found.state.y) > 0.0


def _try_other_strategies(
    problem: PosteriorProblem,
    y: FloatArray,
    first: Optimum,
    report: Report,
    max_evaluations: int,
    *,
    is_linear: bool,
) -> list[Optimum]:
    """Return the optima of the other strategies, up to the first that is final.

    Full suspension weight and one profile are tried again only if `is_linear`, by the residuals off
    the bridge.
    """
    differs = first.differs
    if first.ending is not Termination.NOT_FINITE:
        differs = bool(levels_at(first.problem, first.state.y).any())
    full_weight, reduced_weight = _WITHOUT_MISMATCH
    strategies = (*_WITHOUT_MISMATCH, *_WITH_MISMATCH)
    if differs:
        # A suspension that is not linear resembles mismatch until its weight is reduced, which a
        # first stage shows.
        strategies = (reduced_weight, *_WITH_MISMATCH, full_weight)
    found: list[Optimum] = []
    has_friction = first.stopped_by_friction
    for strategy in strategies:
        if has_friction and strategy.uses_suspension:
            continue
        if strategy is full_weight and not is_linear:
            continue
        evaluations_left = _evaluations_left([first, *found], max_evaluations)
        if evaluations_left <= 0:
            break
        found.append(_refine_candidates(problem, y, strategy, report, evaluations_left))
        has_friction = found[-1].stopped_by_friction
        if _has_ended(found[-1]):
            break
        if strategy is reduced_weight and not has_tandem(problem):
            found[-1] = _judge_off_bridge(found[-1], problem, y)
            if found[-1].fits_off_bridge and found[-1].chi2_per_dof > _CLEAR_MISFIT_CHI2:
                break
    return _with_verdict_off_bridge(found)


def _judge_off_bridge(found: Optimum, problem: PosteriorProblem, y: FloatArray) -> Optimum:
    """Return an optimum with whether its model explains the residuals off the bridge."""
    problem = problem._replace(density=found.problem.density)
    off_bridge = fit_off_bridge(problem, y, uses_suspension=False)
    return found._replace(
        evaluations=found.evaluations + off_bridge.evaluations,
        fits_off_bridge=None if np.isnan(off_bridge.chi2_per_dof) else off_bridge.is_accepted,
        off_bridge_y=off_bridge.y if off_bridge.is_accepted else None,
    )


def _with_verdict_off_bridge(found: list[Optimum]) -> list[Optimum]:
    """Return the optima with the last one's verdict on the residuals off the bridge."""
    judged = [one for one in found if one.fits_off_bridge is not None]
    if not judged or is_accepted(found[-1].problem, found[-1].chi2_per_dof):
        return found
    last = found[-1]._replace(
        fits_off_bridge=judged[-1].fits_off_bridge, off_bridge_y=judged[-1].off_bridge_y
    )
    return [*found[:-1], last]


def _evaluations_left(found: list[Optimum], max_evaluations: int) -> int:
    """Return what may still be spent, by how near to a fit the best of the ways came."""
    best = min(one.chi2_per_dof for one in found)
    if best > _MISFIT_CHI2:
        max_evaluations = min(max_evaluations, _MAX_EVALUATIONS_OF_MISFIT)
    return max_evaluations - _evaluations_of_all(found)


def _is_final(found: Optimum) -> bool:
    """Return whether no other strategy is worth a try: a fit, or a hopeless case."""
    is_hopeless = found.noise_power > HOPELESS_NOISE
    return is_hopeless or is_accepted(found.problem, found.chi2_per_dof)


def _refine_candidates(
    problem: PosteriorProblem,
    y: FloatArray,
    strategy: SearchStrategy,
    report: Report,
    max_evaluations: int,
) -> Optimum:
    """Return the best optimum of a strategy; none, as without finite numbers, if it diverges."""
    try:
        return _refine_likeliest(problem, y, strategy, report, max_evaluations)
    except (FloatingPointError, np.linalg.LinAlgError):
        return no_optimum(problem, y, 0, 0)


def _refine_likeliest(
    problem: PosteriorProblem,
    y: FloatArray,
    strategy: SearchStrategy,
    report: Report,
    max_evaluations: int,
) -> Optimum:
    """Return the best optimum reached from the most likely offsets.

    There is none, as without finite residuals, as soon as a candidate shows that the strategy is
    wrong. After `max_evaluations` evaluations no other candidate is tried.
    """
    force = no_force_noise() if strategy.uses_suspension else None
    problem, y, evaluations = _find_truck(problem, y, strategy, report, force)
    power = noise_power_ratio(problem, y)
    if power > HOPELESS_NOISE:
        return no_optimum(problem, y, evaluations, 0)._replace(noise_power=power)
    if power > NOISY:
        problem = problem._replace(density=problem.density * np.sqrt(power))
        problem = update_noise(problem, y, force)
    else:
        power = 1.0
    if not strategy.differs and _has_clear_mismatch(problem, y):
        return no_optimum(problem, y, evaluations, 0, differs=True)
    found, _ = refine_from_truck(problem, y, strategy, report, max_evaluations - evaluations)
    if found.ending is Termination.NOT_FINITE:
        power = 1.0
    return found._replace(
        evaluations=found.evaluations + evaluations, noise_power=power * found.noise_power
    )


def _find_truck(
    problem: PosteriorProblem,
    y: FloatArray,
    strategy: SearchStrategy,
    report: Report,
    force: FloatArray | None,
) -> tuple[PosteriorProblem, FloatArray, int]:
    """Return the first stage's problem, coordinates and evaluations, the bridge as a whole.

    The profiles of a tandem differ less than a wrong truck makes them differ, so that its truck
    comes before its mismatch.
    """
    whole = _whole_bridge(problem, strategy)

    def with_force(problem: PosteriorProblem, y: FloatArray) -> PosteriorProblem:
        return update_noise(problem, y, force)

    evaluations = 0
    if strategy.differs and not has_tandem(problem):
        problem = update_noise(problem, y, force, mismatch=levels_at(problem, y))
    for temperature, steps in _COARSE_WITH_MISMATCH if strategy.differs else _COARSE:
        report("finding the truck", 0.05)
        problem, y, _, used = fit_stage(problem, y, whole, (temperature, steps, 0.5), with_force)
        evaluations += used
        problem = update_noise(problem, y, force)
    if strategy.differs and has_tandem(problem):
        problem = update_noise(problem, y, force, mismatch=levels_at(problem, y))
    return problem, y, evaluations


def _has_clear_mismatch(problem: PosteriorProblem, y: FloatArray) -> bool:
    """Return whether residuals off the bridge exceed those of one profile after the first stage."""
    rows = data_rows(problem, y[None, :])[0].reshape(-1, RESIDUALS)[:, 0]
    off = np.concatenate([rows[one] for one in off_bridge_residuals(problem, y)])
    return off.size > 0 and float(off @ off) / off.size > _CLEAR_MISMATCH
