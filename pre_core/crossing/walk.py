"""Scan of longitudinal offsets: fit of the bridge at each, everything else to first order.

At every offset the bridge's parameters are fitted, with the effects of all others projected out of
the residuals: this is cheap, and the fit improves towards the right offset.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pre_core.arrays import FloatArray
from pre_core.crossing.fit import (
    Optimum,
    SearchStrategy,
    evaluations_of,
    lower_bounds,
    resting_mode_indices,
    tempered_residuals,
)
from pre_core.crossing.posterior import PosteriorProblem, has_tandem, layout
from pre_core.search import levenberg_marquardt
from pre_core.search.levenberg_marquardt import minimise

_WALK_TEMPERATURE = 3.0
"""Temperature of the offset scan, at which minima are wide."""
_WALK_STEPS = 6
"""Steps at each offset, enough to compare it with the others."""
_WALK_MIN_IMPROVEMENT = 0.5
"""Improvement of the sum of squares that ends the fit of an offset."""
_STRIDE_M = 0.6
"""Distance between scanned offsets."""
_REFINED_M = (0.3, 0.15)
"""Distances of further offsets to either side of the best one, one after the other."""
_NEIGHBOUR_M, _NEIGHBOURS = 0.1, 6
"""Distance and number of offsets tried on either side of an optimum with mismatch: a compliant
bearing makes minima 0.2 m apart, which the truck of the scan does not distinguish."""
_FAR_STRIDE_M = 1.2
"""Distance between offsets tried farther away: minima metres apart are as wide."""
_PATIENCE = 1.5  # strides beyond the best offset after which the scan ends, except for a tandem
_REACH = 3.0  # largest offset in standard deviations of its prior
_MAX_STRIDES = 60
"""Limit of strides to either side, however uncertain the offset."""


class Placement(NamedTuple):
    """Fit of the bridge with a longitudinal offset `shift_m`."""

    objective: float
    shift_m: float
    bridge: FloatArray
    """Changes (b,) of the bridge's coordinates."""
    indices: NDArray[np.int64]
    """Indices in y of the bridge's parameters."""


LocalFit = Callable[[float, FloatArray], tuple[Placement, int]]
"""Function from a shift in m and initial changes (b,) of the bridge to a candidate and the number
of evaluations."""


def others_effects(
    problem: PosteriorProblem, y: FloatArray, held: NDArray[np.int64], temperature: float
) -> FloatArray:
    """Return an orthonormal basis (rows, f - h) of the effects of all coordinates but `held` (h,).

    The effects are the residuals' derivatives at y (f,), which take f + 1 evaluations.
    """
    rows = tempered_residuals(problem, y, np.eye(y.size), temperature)
    here = levenberg_marquardt.initial_state(rows, np.zeros(y.size))
    return np.asarray(np.linalg.qr(np.delete(here.jacobian, held, axis=1))[0])


def _local_fit(problem: PosteriorProblem, y: FloatArray, strategy: SearchStrategy) -> LocalFit:
    """Return the fit of the bridge alone at an offset, all else to first order about y (f,)."""
    where = layout(problem)
    indices = where.bridge
    free = np.eye(y.size)
    held = np.union1d(indices, resting_mode_indices(problem, strategy))
    others = others_effects(problem, y, held, _WALK_TEMPERATURE)

    def fit_at(shift: float, start: FloatArray) -> tuple[Placement, int]:
        moved = y.copy()
        moved[where.trajectory] += shift
        rows = tempered_residuals(problem, moved, free[:, indices], _WALK_TEMPERATURE)

        def projected(v: FloatArray) -> FloatArray:
            values = rows(v)
            return np.asarray(values - (values @ others) @ others.T)

        lower = lower_bounds(problem, moved, free[:, indices], is_free=True)
        found = minimise(
            projected, start, _WALK_STEPS, _WALK_MIN_IMPROVEMENT, lower, uses_broyden=True
        )
        place = Placement(found.state.objective, shift, found.state.y, indices)
        return place, evaluations_of(found)

    return fit_at


def scan_offsets(
    problem: PosteriorProblem, y: FloatArray, strategy: SearchStrategy
) -> tuple[list[Placement], int]:
    """Return candidates along the road about y (f,), best first, and the number of evaluations.

    The fit improves towards the right offset from afar, so the scan ends soon after the best one.
    The axles of a tandem are too close together for that: other minima metres away fit well enough
    to be accepted, with a wrong bridge, and all offsets that the receiver allows are scanned.
    """
    local_fit = _local_fit(problem, y, strategy)
    nothing = np.zeros(layout(problem).bridge.size)
    evaluations = y.size + 1
    candidates: list[Placement] = []

    def fit_at(shift: float, start: FloatArray) -> None:
        nonlocal evaluations
        place, used = local_fit(shift, start)
        evaluations += used
        if np.isfinite(place.objective):
            candidates.append(place)

    def best() -> Placement:
        return min(candidates, key=lambda place: place.objective)

    fit_at(0.0, nothing)
    reach = _reach_m(problem)
    for sign in (1.0, -1.0):
        shift = sign * _STRIDE_M
        while abs(shift) <= reach:
            fit_at(shift, nothing)
            is_behind = candidates and sign * (shift - best().shift_m) > _PATIENCE * _STRIDE_M
            if is_behind and not has_tandem(problem):
                break
            shift += sign * _STRIDE_M
    for stride in _REFINED_M if candidates else ():
        centre = best()
        for sign in (1.0, -1.0):
            fit_at(centre.shift_m + sign * stride, centre.bridge)
    return sorted(candidates, key=lambda place: place.objective), evaluations


def better_neighbour(found: Optimum, strategy: SearchStrategy) -> tuple[Placement | None, int]:
    """Return the best candidate about an optimum if it fits better; and the evaluations.

    All offsets that the receiver allows are tried again, with the truck of the optimum: with that
    of the first scan a wrong bridge may fit as well, metres from the right place.
    """
    y = found.state.y
    local_fit = _local_fit(found.problem, y, strategy)
    nothing = np.zeros(layout(found.problem).bridge.size)
    here, evaluations = local_fit(0.0, nothing)
    evaluations += y.size + 1
    best = here
    for shift in _other_offsets_m(found.problem):
        place, used = local_fit(shift, nothing)
        evaluations += used
        best = min(best, place, key=lambda one: one.objective)
    return (best if best.objective < here.objective - _WALK_MIN_IMPROVEMENT else None), evaluations


def _other_offsets_m(problem: PosteriorProblem) -> list[float]:
    """Return offsets near an optimum, and others as far as the receiver allows.

    For a tandem the others have been scanned already.
    """
    near = [_NEIGHBOUR_M * number for number in range(1, _NEIGHBOURS + 1)]
    strides = 0 if has_tandem(problem) else int(_reach_m(problem) / _FAR_STRIDE_M)
    far = [_FAR_STRIDE_M * number for number in range(1, strides + 1)]
    return [sign * shift for shift in near + far for sign in (-1.0, 1.0)]


def _reach_m(problem: PosteriorProblem) -> float:
    """Return the largest offset that the receiver allows."""
    return float(min(_STRIDE_M + _REACH / problem.receiver_rows[-1, -1], _MAX_STRIDES * _STRIDE_M))


def shifted_to(problem: PosteriorProblem, y: FloatArray, place: Placement) -> FloatArray:
    """Return y (f,) with the bridge at a candidate's offset."""
    moved = y.copy()
    moved[layout(problem).trajectory] += place.shift_m
    moved[place.indices] += place.bridge
    return moved
