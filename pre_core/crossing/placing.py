"""From a truck to the optimum: the scan of the bridge's offsets, and all parameters from there."""

import numpy as np

from pre_core.crossing.fit import (
    HOPELESS_CHI2,
    AbandonReason,
    Optimum,
    SearchStrategy,
    fit_all,
    is_accepted,
)
from pre_core.crossing.posterior import PosteriorProblem, all_rows, layout, noise_power_ratio
from pre_core.crossing.walk import better_neighbour, scan_offsets, shifted_to
from pre_core.physics.bridge import FloatArray
from pre_core.search import levenberg_marquardt
from pre_core.search.loop import Report, Termination

NOISY = 2.0
"""Noise power ratio, even over the body equations, above which noise is inflated."""
_CLEAR_RESTRAINT = 0.5
"""Scales of their prior above which restraints, bearing compliance and torsion are tried without.
"""
_MAX_MOVES = 4
"""Limit of moves from an optimum to a neighbouring one."""
_SAME_MINIMUM_M = 0.2
"""Distance within which offsets lead to one minimum."""
_HOPELESS_CHI2 = (100.0, HOPELESS_CHI2)
"""Values of chi2 above which no other offset is tried, after one candidate and after more. Of 70
drawn sound crossings the first candidate was right in all; another one never reduced such a chi2 to
a usable one."""


def refine_from_truck(
    problem: PosteriorProblem,
    y: FloatArray,
    strategy: SearchStrategy,
    report: Report,
    max_evaluations: int,
) -> tuple[Optimum, FloatArray]:
    """Return the best optimum with the truck of y (size,), and the likeliest start for the bridge.

    The optimum's noise power is relative to the problem's.
    """
    report("finding the bridge", 0.2)
    places, evaluations = scan_offsets(problem, y, strategy)
    likeliest = shifted_to(problem, y, places[0]) if places else y
    best: Optimum | None = None
    has_friction = False
    tried: list[float] = []
    for place in places:
        if any(abs(place.shift_m - other) < _SAME_MINIMUM_M for other in tried):
            continue
        tried.append(place.shift_m)
        report(f"freeing the elements, start {len(tried)}", 0.3 + 0.05 * len(tried))
        found, used = fit_all(problem, shifted_to(problem, y, place), strategy)
        evaluations += used
        if isinstance(found, Optimum) and _may_move(found):
            found, used = _refine_offset(found, strategy, max_evaluations - evaluations)
            evaluations += used
        if not isinstance(found, Optimum):
            has_friction = found is AbandonReason.CLEAR_FRICTION
            break
        if best is None or found.chi2_per_dof < best.chi2_per_dof:
            best = found
        if is_accepted(best.problem, best.chi2_per_dof) or len(tried) == strategy.max_candidates:
            break
        hopeless = _HOPELESS_CHI2[min(len(tried), len(_HOPELESS_CHI2)) - 1]
        if best.chi2_per_dof > hopeless or evaluations > max_evaluations:
            break
    if best is None:
        nothing = no_optimum(problem, y, evaluations, len(tried), has_friction=has_friction)
        return nothing, likeliest
    best, used = _with_free_ends(best, strategy)
    evaluations += used
    best = best._replace(
        evaluations=evaluations,
        starts=len(tried),
        stopped_by_friction=has_friction,
        noise_power=_excess_noise_power(best),
    )
    return best, likeliest


def _with_free_ends(found: Optimum, strategy: SearchStrategy) -> tuple[Optimum, int]:
    """Return the better of an optimum with rotational restraints and one without, and evaluations.

    A bridge restrained at both ends with less than half its stiffness deflects nearly as one on
    free bearings, with a truck that is wrong by a third of its prior: a search that gets there
    stays there.
    """
    where, y = layout(found.problem), found.state.y
    ends = np.intersect1d(where.half_normal, where.bridge)
    if not np.any(y[ends] > _CLEAR_RESTRAINT) or found.chi2_per_dof > HOPELESS_CHI2:
        return found, 0
    start = y.copy()
    start[where.bridge] = 0.0
    other, used = fit_all(found.problem, start, strategy)
    if isinstance(other, Optimum) and other.chi2_per_dof < found.chi2_per_dof:
        found = other
    return found, used


def _may_move(found: Optimum) -> bool:
    """Return whether a neighbouring offset is worth a try: with mismatch, near a fit."""
    return bool(found.problem.mismatch.level_m3.any()) and found.chi2_per_dof < HOPELESS_CHI2


def _refine_offset(
    found: Optimum, strategy: SearchStrategy, max_evaluations: int
) -> tuple[Optimum, int]:
    """Return the best of an optimum with mismatch and its neighbours, and the evaluations."""
    evaluations = 0
    for _ in range(_MAX_MOVES):
        if evaluations > max_evaluations:
            break
        place, used = better_neighbour(found, strategy)
        evaluations += used
        if place is None:
            break
        other, used = fit_all(
            found.problem, shifted_to(found.problem, found.state.y, place), strategy
        )
        evaluations += used
        if not isinstance(other, Optimum) or other.chi2_per_dof >= found.chi2_per_dof:
            break
        found = other
    return found, evaluations


def _excess_noise_power(found: Optimum) -> float:
    """Return `noise_power_ratio` at an optimum, 1 if it is not clear."""
    power = noise_power_ratio(found.problem, found.state.y)
    return power if power > NOISY else 1.0


def no_optimum(
    problem: PosteriorProblem,
    y: FloatArray,
    evaluations: int,
    starts: int,
    *,
    has_friction: bool = False,
    differs: bool = False,
) -> Optimum:
    """Return the result of a search from y (size,) that ended without an optimum."""
    state = levenberg_marquardt.initial_state(lambda at: all_rows(problem, at), y)
    ending = Termination.NOT_FINITE
    return Optimum(problem, state, ending, np.inf, evaluations, starts, has_friction, differs)
