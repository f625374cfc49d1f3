"""Refinement of an optimum: starts from other offsets, bearings and bridges."""

import numpy as np

from pre_core.arrays import FloatArray
from pre_core.crossing.comparison import is_better
from pre_core.crossing.fit import (
    HOPELESS_CHI2,
    Optimum,
    SearchStrategy,
    chi2_per_dof,
    complete_fit,
    fit_all,
    is_accepted,
)
from pre_core.crossing.frequency_continuation import (
    ENOUGH,
    OtherBridge,
    distinct_bridges,
    other_bridges,
)
from pre_core.crossing.misfit import fit_off_bridge, is_explained_off_bridge
from pre_core.crossing.mismatch import has_alike_tyres
from pre_core.crossing.noise import no_suspension_noise
from pre_core.crossing.posterior import has_tandem, layout
from pre_core.crossing.preparation import update_noise
from pre_core.crossing.walk import better_neighbour, scan_offsets, shifted_to
from pre_core.search.loop import Termination

_CLEAR_RESTRAINT = 0.5
"""Size of restraints, bearing compliance or torsion, in scales of their priors, above which the
search is repeated without them."""
_MAX_MOVES = 4
"""Limit of moves from an optimum to a neighbouring one."""
_TRIED_BRIDGES = 2
"""Limit of other bridges from which all parameters are fitted, after each optimum."""
_KEPT_RIVALS = 4
"""Limit of other bridges near which the posterior is drawn, too."""
_FAILED_ROUNDS = 2
"""Rounds without a better bridge, ends alike and one at a time, after which no other is tried."""
_COMPLETED_CHI2 = 60.0
"""Value of chi2 up to which fits from other bridges about a truck are completed: with the true
truck one at 46 led to the true bridge."""


def refined(found: Optimum, strategy: SearchStrategy, max_evaluations: int) -> tuple[Optimum, int]:
    """Return the best of an optimum and those that follow from it, and the evaluations."""
    if _is_sharp(found):
        return _with_other_bridge(found, strategy, max_evaluations)
    return _refine_offset(found, strategy, max_evaluations)


def about_truck(
    found: Optimum, y: FloatArray, strategy: SearchStrategy, max_evaluations: int
) -> tuple[Optimum | None, int]:
    """Return the best optimum of bridges about a truck at y (f,), and the evaluations.

    The truck explains the residuals off the bridge, where no bridge acts, so a misfit of `found`
    may be due to a bridge that vibrates at another frequency. Bridges of other frequencies are
    tried about this truck and, if none of them is accepted, about the likeliest offset of a bridge
    under it. None if no fit from a bridge about this truck was worth completing.
    """
    truck = _at_full_weight(found, y)
    best, evaluations = _best_bridge(truck, None, strategy, max_evaluations)
    if best is None or is_accepted(best.problem, best.chi2_per_dof):
        return best, evaluations
    if evaluations > max_evaluations:
        return best, evaluations
    places, used = scan_offsets(truck.problem, y, strategy)
    evaluations += used
    if not places:
        return best, evaluations
    start = shifted_to(truck.problem, y, places[0])
    at_offset, used = _fitted(truck, start, strategy, _COMPLETED_CHI2)
    evaluations += used
    if at_offset is not None and at_offset.unfinished is None:
        around = _at_full_weight(at_offset, at_offset.state.y)
        other, used = _best_bridge(around, at_offset, strategy, max_evaluations - evaluations)
        evaluations += used
        best = min(best, other or best, key=lambda one: one.chi2_per_dof)
    return best, evaluations


def _best_bridge(
    around: Optimum, best: Optimum | None, strategy: SearchStrategy, max_evaluations: int
) -> tuple[Optimum | None, int]:
    """Return the best of `best` and optima of other bridges about `around`, and the evaluations.

    They are tried again about each better one: the bridge next to a wrong one may be the true one.
    """
    evaluations, failed, is_even = 0, 0, True
    while failed < _FAILED_ROUNDS and evaluations <= max_evaluations:
        others, used = other_bridges(around, strategy, is_even=is_even)
        fits, used_by_fits = _fits(around, others, strategy)
        evaluations += used + used_by_fits
        failed, is_even = failed + 1, not is_even
        for fit in fits:
            here = _at_full_weight(fit, fit.state.y)
            if best is None or is_better(here, around):
                best, around, failed = fit, here, 0
        if best is None:
            break
    return best, evaluations


def _at_full_weight(found: Optimum, y: FloatArray) -> Optimum:
    """Return an optimum displaced to y (f,), with full weight of the body equations."""
    problem = update_noise(found.problem, y, no_suspension_noise())
    return found._replace(
        problem=problem,
        state=found.state._replace(y=y),
        chi2_per_dof=chi2_per_dof(problem, y),
    )


def _fits(
    around: Optimum, others: list[OtherBridge], strategy: SearchStrategy
) -> tuple[list[Optimum], int]:
    """Return the completed fits from the likeliest other bridges, and the evaluations.

    An accepted one is the last.
    """
    fits: list[Optimum] = []
    evaluations = 0
    for other in _likeliest(others):
        fitted, used = _fitted(around, other.y, strategy, _COMPLETED_CHI2)
        evaluations += used
        if fitted is None or fitted.unfinished is not None:
            continue
        if fitted.chi2_per_dof <= HOPELESS_CHI2 and fitted.ending is not Termination.CONVERGED:
            # A bridge far from the first one may need more steps than a fit takes.
            again, used = fit_all(fitted.problem, fitted.state.y, strategy)
            evaluations += used
            fitted = fitted if again is None else again
        fits.append(fitted)
        if is_accepted(fitted.problem, fitted.chi2_per_dof):
            break
    return fits, evaluations


def _likeliest(others: list[OtherBridge]) -> list[OtherBridge]:
    """Return the bridges from which all parameters are fitted, best first as given."""
    return [one for one in others if one.gain > ENOUGH][:_TRIED_BRIDGES]


def _fitted(
    around: Optimum, y: FloatArray, strategy: SearchStrategy, completed_to: float = np.inf
) -> tuple[Optimum | None, int]:
    """Return the fit of all parameters from y (f,), if there is one, and evaluations.

    It is completed up to a chi2 of `completed_to`.
    """
    fitted, used = fit_all(around.problem, y, strategy)
    if fitted is None or fitted.chi2_per_dof > completed_to:
        return fitted, used
    completed = complete_fit(fitted)
    return completed, used + completed.evaluations - fitted.evaluations


def _is_sharp(found: Optimum) -> bool:
    """Return whether bridges of other frequencies are tried: tyres of one kind, and nearly a fit.

    They are not tried for a tandem, whose offsets have been scanned over the whole error of the
    receiver: four such searches found no other bridge with 40 % more evaluations.
    """
    mismatch = found.problem.mismatch
    is_sharp = mismatch.level_m3.any() and has_alike_tyres(mismatch)
    is_tried = is_sharp and not has_tandem(found.problem)
    return bool(is_tried and found.unfinished is None and found.chi2_per_dof <= HOPELESS_CHI2)


def _with_other_bridge(
    found: Optimum, strategy: SearchStrategy, max_evaluations: int
) -> tuple[Optimum, int]:
    """Return the best of an optimum and those of other bridges, and the evaluations."""
    evaluations = 0
    rivals: list[OtherBridge] = []
    failed, is_even = 0, True
    while failed < _FAILED_ROUNDS and evaluations <= max_evaluations and _is_sharp(found):
        others, used = other_bridges(found, strategy, is_even=is_even)
        evaluations += used
        before = found
        for other in _likeliest(others):
            fitted, used = _fitted(found, other.y, strategy)
            evaluations += used
            if fitted is not None and is_better(fitted, found):
                found = fitted
                break
        is_same = found is before
        failed, rivals = (failed + 1, [*rivals, *others]) if is_same else (0, [])
        is_even = not is_even
    distinct = distinct_bridges(found, rivals)[:_KEPT_RIVALS]
    return found._replace(rivals=tuple(one.y for one in distinct)), evaluations


def _refine_offset(
    found: Optimum, strategy: SearchStrategy, max_evaluations: int
) -> tuple[Optimum, int]:
    """Return the best of an optimum and, with mismatch, its neighbours; and the evaluations."""
    evaluations = 0
    for _ in range(_MAX_MOVES):
        if evaluations > max_evaluations or not found.problem.mismatch.level_m3.any():
            break
        place, used = better_neighbour(found, strategy)
        evaluations += used
        if place is None:
            break
        other, used = fit_all(
            found.problem, shifted_to(found.problem, found.state.y, place), strategy
        )
        evaluations += used
        if other is None or not is_better(other, found):
            break
        found = other
    return found, evaluations


def with_full_weight(found: Optimum, strategy: SearchStrategy, max_evaluations: int) -> Optimum:
    """Return the better optimum, at reduced weight of the body equations or about another bridge.

    A wrong bridge moves the truck as its springs would not, and is accepted at reduced weight. Real
    friction and nonlinear springs act off the bridge, too: where a linear truck explains the
    residuals there, bridges about this truck are tried.
    """
    if not found.problem.force.any() or not is_accepted(found.problem, found.chi2_per_dof):
        return found
    alone = fit_off_bridge(found)
    other, evaluations = None, alone.evaluations
    if alone.chi2 < found.chi2_per_dof and is_explained_off_bridge(found.problem, alone):
        other, used = about_truck(found, alone.y, strategy, max_evaluations)
        evaluations += used
    best = found if other is None or not is_better(other, found) else other
    return best._replace(evaluations=found.evaluations + evaluations)


def with_free_ends(found: Optimum, strategy: SearchStrategy) -> tuple[Optimum, int]:
    """Return the better optimum, with rotational restraints or without, and the evaluations.

    A bridge restrained at both ends with less than half its stiffness deflects nearly as one on
    free bearings, with a truck that is wrong by a third of its prior: a search that gets there
    stays there. Fits of `other_bridges` have such starts already.
    """
    where, y = layout(found.problem), found.state.y
    ends = np.intersect1d(where.half_normal, where.bridge)
    is_restrained = found.unfinished is None and np.any(y[ends] > _CLEAR_RESTRAINT)
    if not is_restrained or _is_sharp(found) or found.chi2_per_dof > HOPELESS_CHI2:
        return found, 0
    start = y.copy()
    start[where.bridge] = 0.0
    other, used = fit_all(found.problem, start, strategy)
    if other is None:
        return found, used
    other = complete_fit(other)
    return (other if is_better(other, found) else found), other.evaluations
