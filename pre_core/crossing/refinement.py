"""Refinement of an optimum: starts from other offsets, bearings and bridges."""

from itertools import product

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
from pre_core.crossing.walk import better_neighbour, shifted_to
from pre_core.search.loop import Termination

_CLEAR_RESTRAINT = 0.5
"""Size of restraints, bearing compliance or torsion, in scales of their priors, above which the
search is repeated without them."""
_MAX_MOVES = 4
"""Limit of moves from an optimum to a neighbouring one."""
_TRIED_BRIDGES = 2
"""Limit of other bridges from which all parameters are fitted, after each optimum."""
_KEPT_RIVALS = 4
"""Limit of rivals: other bridges that fit nearly as well, near which draws begin, too."""
_FAILED_ROUNDS = 2
"""Number of rounds without a better bridge that end the search: one with both ends restrained or
compliant alike (`is_even`), one with a single end."""
_SHIFTS_M = (0.0, -1.2, 1.2)
"""Offsets from which other bridges are tried about a truck: from more than half a metre off, their
fits may end at a wrong one."""
_COMPLETED_CHI2, _HOPELESS_START_CHI2 = 12.0, 100.0
"""Values of chi2 after a few steps up to which fits from other bridges about a truck are completed,
and above which no other one is tried. Of five crossings four had 1 to 10 at the true offset and 1
to 22 at the first one tried; with a skew plate it was 4,500."""
_SAME_MISFIT = 0.02
"""Relative difference of chi2 up to which two fits end at the same misfit. With another vehicle on
the bridge or a span 10 % wrong, fits from other bridges ended within 0.013 of the first one's;
those of three crossings whose true bridge was found so had 0.1 to 2 times the first one's."""


def refined(found: Optimum, strategy: SearchStrategy, max_evaluations: int) -> tuple[Optimum, int]:
    """Return the best of an optimum and those found from it, and the number of evaluations."""
    if _needs_other_bridges(found):
        return _with_other_bridge(found, strategy, max_evaluations)
    return _refine_offset(found, strategy, max_evaluations)


def about_truck(
    found: Optimum,
    y: FloatArray,
    strategy: SearchStrategy,
    max_evaluations: int,
    reached_chi2: float,
) -> tuple[Optimum | None, int]:
    """Return the best optimum of bridges about a truck at y (f,), and the number of evaluations.

    The truck explains the residuals off the bridge, where no bridge acts, so a misfit of `found`
    may be due to a bridge that vibrates at another frequency. Bridges of other frequencies are
    tried about this truck from several offsets, up to an accepted one, then about the best of them.
    A fit that ends at `reached_chi2` again, that of earlier fits, is the last: no bridge explains
    such a misfit. None if no fit was worth completing.
    """
    best: Optimum | None = None
    evaluations = 0
    for is_even, shift_m in product((True, False), _SHIFTS_M):
        moved = y.copy()
        moved[layout(found.problem).trajectory] += shift_m
        fits, used = _fits_about(_at_full_weight(found, moved), strategy, 1, is_even=is_even)
        evaluations += used
        best = min(
            [*fits, *([] if best is None else [best])], key=_chi2_at_full_weight, default=None
        )
        if best is None or best.chi2_per_dof > _HOPELESS_START_CHI2:
            break
        if _is_fit(best) or evaluations > max_evaluations:
            break
        if _is_same_misfit(best, reached_chi2):
            return best, evaluations
    if best is None or best.unfinished is not None:
        return None, evaluations
    best, used = _best_bridge(best, strategy, max_evaluations - evaluations)
    return best, evaluations + used


def _best_bridge(
    best: Optimum, strategy: SearchStrategy, max_evaluations: int
) -> tuple[Optimum, int]:
    """Return the best of `best` and other bridges about it, and the number of evaluations.

    They are tried again about each better one: the bridge next to a wrong one may be the true one.
    """
    around = _at_full_weight(best, best.state.y)
    evaluations, failed, is_even = 0, 0, False
    while failed < _FAILED_ROUNDS and evaluations <= max_evaluations:
        fits, used = _fits_about(around, strategy, _TRIED_BRIDGES, is_even=is_even)
        evaluations += used
        failed, is_even = failed + 1, not is_even
        for fit in fits:
            here = _at_full_weight(fit, fit.state.y)
            if is_better(here, around):
                best, around, failed = fit, here, 0
    return best, evaluations


def _is_same_misfit(found: Optimum, reached_chi2: float) -> bool:
    """Return whether a completed fit ended at a misfit that other fits reached, too."""
    is_same = abs(found.chi2_per_dof - reached_chi2) < _SAME_MISFIT * reached_chi2
    return is_same and found.unfinished is None


def _is_fit(found: Optimum) -> bool:
    return is_accepted(found.problem, found.chi2_per_dof)


def _at_full_weight(found: Optimum, y: FloatArray) -> Optimum:
    """Return an optimum displaced to y (f,), with full weight of the body equations."""
    problem = update_noise(found.problem, y, no_suspension_noise())
    return found._replace(
        problem=problem,
        state=found.state._replace(y=y),
        chi2_per_dof=chi2_per_dof(problem, y),
    )


def _chi2_at_full_weight(found: Optimum) -> float:
    return _at_full_weight(found, found.state.y).chi2_per_dof


def _fits_about(
    around: Optimum, strategy: SearchStrategy, tried: int, *, is_even: bool
) -> tuple[list[Optimum], int]:
    """Return fits from at most `tried` other bridges, and the number of evaluations.

    They are completed up to `_COMPLETED_CHI2`; an accepted one is the last.
    """
    others, evaluations = other_bridges(around, strategy, is_even=is_even)
    fits: list[Optimum] = []
    for other in _likeliest(others)[:tried]:
        fitted, used = _fitted(around, other.y, strategy, _COMPLETED_CHI2)
        evaluations += used
        if fitted is None:
            continue
        if fitted.unfinished is None and fitted.ending is not Termination.CONVERGED:
            # A bridge far from the first one may need more steps than a fit takes.
            again, used = fit_all(fitted.problem, fitted.state.y, strategy)
            evaluations += used
            fitted = fitted if again is None else again
        fits.append(fitted)
        if _is_fit(fitted):
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


def _needs_other_bridges(found: Optimum) -> bool:
    """Return whether to try bridges of other frequencies: for equal tyres and nearly a fit.

    They are not tried for a tandem, whose offsets have been scanned over the whole error of the
    receiver: four such searches found no other bridge with 40 % more evaluations.
    """
    mismatch = found.problem.mismatch
    has_little_mismatch = mismatch.level_m3.any() and has_alike_tyres(mismatch)
    is_tried = has_little_mismatch and not has_tandem(found.problem)
    return bool(is_tried and found.unfinished is None and found.chi2_per_dof <= HOPELESS_CHI2)


def _with_other_bridge(
    found: Optimum, strategy: SearchStrategy, max_evaluations: int
) -> tuple[Optimum, int]:
    """Return the best of an optimum and those of other bridges, and the number of evaluations."""
    evaluations = 0
    rivals: list[OtherBridge] = []
    failed, is_even = 0, True
    while (
        failed < _FAILED_ROUNDS and evaluations <= max_evaluations and _needs_other_bridges(found)
    ):
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
    """Return the best of an optimum and, with mismatch, its neighbours, and evaluations used."""
    evaluations = 0
    for _ in range(_MAX_MOVES):
        if evaluations > max_evaluations or not found.problem.mismatch.level_m3.any():
            break
        candidate, used = better_neighbour(found, strategy)
        evaluations += used
        if candidate is None:
            break
        other, used = fit_all(
            found.problem, shifted_to(found.problem, found.state.y, candidate), strategy
        )
        evaluations += used
        if other is None or not is_better(other, found):
            break
        found = other
    return found, evaluations


def with_full_weight(found: Optimum, strategy: SearchStrategy, max_evaluations: int) -> Optimum:
    """Return an optimum at reduced weight of the body equations, or a better one at full weight.

    The body equations of a linear truck contradict a wrong bridge, which is therefore accepted only
    at their reduced weight. Real friction and nonlinear springs act off the bridge, too: where a
    linear truck explains the residuals there, bridges about this truck are tried.
    """
    if not found.problem.force.any() or not is_accepted(found.problem, found.chi2_per_dof):
        return found
    alone = fit_off_bridge(found)
    other, evaluations = None, alone.evaluations
    if alone.chi2 < found.chi2_per_dof and is_explained_off_bridge(found.problem, alone):
        other, used = about_truck(found, alone.y, strategy, max_evaluations, found.chi2_per_dof)
        evaluations += used
    best = found if other is None or not is_better(other, found) else other
    return best._replace(evaluations=found.evaluations + evaluations)


def with_free_ends(found: Optimum, strategy: SearchStrategy) -> tuple[Optimum, int]:
    """Return the better optimum, rotationally restrained or not, and the number of evaluations.

    A bridge restrained at both ends with less than half its stiffness deflects nearly as one on
    free bearings, with a truck that is wrong by a third of its prior's standard deviation: a search
    that gets there stays there. Fits of `other_bridges` have such starts already.
    """
    where, y = layout(found.problem), found.state.y
    ends = np.intersect1d(where.half_normal, where.bridge)
    is_restrained = found.unfinished is None and np.any(y[ends] > _CLEAR_RESTRAINT)
    if not is_restrained or _needs_other_bridges(found) or found.chi2_per_dof > HOPELESS_CHI2:
        return found, 0
    start = y.copy()
    start[where.bridge] = 0.0
    other, used = fit_all(found.problem, start, strategy)
    if other is None:
        return found, used
    other = complete_fit(other)
    return (other if is_better(other, found) else found), other.evaluations
