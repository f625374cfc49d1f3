"""Curvature of a crossing's likelihood: second-order terms in poorly determined directions.

With different wheel paths a single crossing determines its longitudinal offset to half a metre and
elements only roughly, and its optimum lies near the priors. A normal about that point lacks the
second-order terms from there to the truth. They are the same in all crossings of a survey, so that
their number does not average them out. These terms are therefore kept too, compressed
to the few significant sums, and fusion linearises each crossing again about the common
estimate.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from pre_core.arrays import FloatArray
from pre_core.crossing import posterior
from pre_core.crossing.compliances import compliance_normal
from pre_core.crossing.fit import Optimum

_STEP = 0.7
"""Step of the second differences, relative to a standard deviation."""
_LARGEST = 1.0
"""Largest move of a coordinate, in the prior's units and in m of the offset."""
_LARGEST_COMPLIANCE = 0.5
"""Largest move of a compliance, relative to itself."""
_PLAIN = 0.2
"""Smallest curvature term that is kept, if all moves are of unit size, in standard deviations."""
_MAX_BENDS = 40
_FARTHEST = _STEP
"""Largest size of a move from the optimum at which the terms apply: that of their differences.
Extrapolated to three sizes they made a bridge with a restrained end e times likelier, for each of
twelve runs of an independent simulator, than the best fit of the run to that bridge."""
_PLACE_STEPS = 4
_ROUNDED = 1e-12


class CurvatureTerms(NamedTuple):
    """Joint second-order effects of moves of the bridge parameters and of the offset.

    The moves are those along which the posterior extends: a single element that moves by its
    standard deviation while the others stay shifts the frequencies by many of theirs, far beyond
    the range of second-order terms.
    """

    about: FloatArray  # (b,) the bridge's coordinates at the optimum
    directions: FloatArray
    """Moves of unit size as columns (b + 1, b + 1), of the bridge and in m of the offset."""
    shapes: FloatArray
    """Coefficients (k, pairs) of each term in the products u_i u_j, i <= j by rows, of the sizes u
    of the moves."""


def curvature_terms(
    found: Optimum, problem: posterior.PosteriorProblem, rows: NDArray[np.int64], place: int
) -> tuple[CurvatureTerms, FloatArray]:
    """Return the terms at an optimum, and the effect of each on residuals `rows`: (rows, k).

    `problem` may have another noise than the optimum's. The coordinate of EI is c, the offset that
    of the trajectory's coefficient `place`. All other coordinates follow the moves as their
    conditional means do.
    """
    where = posterior.layout(problem)
    centre, _, covariance = compliance_normal(found)
    kept = np.append(where.bridge, place)
    ends = np.flatnonzero(np.isin(kept, where.half_normal))
    of_kept = covariance[np.ix_(kept, kept)]
    directions = _directions(of_kept, centre[where.bridge], where.elements.size, ends)
    full = covariance[:, kept] @ np.linalg.solve(of_kept, directions)
    differences = _second_differences(problem, centre, full, ends, rows)
    weight, shapes = np.linalg.eigh(differences @ differences.T)
    clear = np.flatnonzero(weight > _PLAIN**2)[::-1][:_MAX_BENDS]
    shapes = shapes[:, clear].T
    terms = CurvatureTerms(centre[where.bridge], directions, shapes)
    return terms, differences.T @ shapes.T


def _second_differences(
    problem: posterior.PosteriorProblem,
    centre: FloatArray,
    moves: FloatArray,
    ends: NDArray[np.int64],
    rows: NDArray[np.int64],
) -> FloatArray:
    """Return the second-order effect (pairs, rows) of the products of moves (f, n) on residuals.

    `centre` (f,) has c in place of the elements' coordinates. They are central differences but in
    the moves `ends`, which go upwards only.
    """
    where, sigma = posterior.layout(problem), posterior.rigidity_spread(problem.priors)
    n = moves.shape[1]
    first, second = np.triu_indices(n)
    up = np.eye(n)
    down = -up
    down[ends] = 0.0

    def at(steps: FloatArray) -> FloatArray:
        points = centre + _STEP * steps @ moves.T
        points[:, where.elements] = -np.log(points[:, where.elements]) / sigma
        return posterior.all_rows(problem, points)[:, rows]

    (here,) = at(np.zeros((1, n)))
    above, below = at(up), at(down)
    both = at(up[first] + up[second]) - above[first] - above[second] + here
    neither = at(down[first] + down[second]) - below[first] - below[second] + here
    out = 0.5 * (both + neither)
    of_ends = np.isin(first, ends).astype(int) + np.isin(second, ends)
    out[of_ends == 2] = both[of_ends == 2]
    one = np.flatnonzero(of_ends == 1)
    free = np.where(np.isin(first, ends), second, first)[one]
    end = np.where(np.isin(first, ends), first, second)[one]
    apart = at(up[end] - up[free]) - above[end] - below[free] + here
    out[one] = 0.5 * (both[one] - apart)
    out[first == second] *= 0.5
    return np.asarray(out / _STEP**2)


def _directions(
    covariance: FloatArray, about: FloatArray, elements: int, ends: NDArray[np.int64]
) -> FloatArray:
    """Return moves (n, n) of bridge and offset, one in each column, from their covariance (n, n).

    `ends` are coordinates that must not be negative: each moves upwards, and the others follow as
    their conditional means do. The other moves are the principal ones of the conditional
    covariance. No coordinate moves further than its largest move.
    """
    n = covariance.shape[0]
    free = np.setdiff1d(np.arange(n), ends)
    largest = np.full(n, _LARGEST)
    largest[about.size - elements : about.size] = _LARGEST_COMPLIANCE * about[-elements:]
    moves = np.zeros((n, n))
    moves[ends, ends] = np.sqrt(np.diag(covariance)[ends])
    follow = np.linalg.solve(covariance[np.ix_(ends, ends)], covariance[np.ix_(ends, free)])
    moves[np.ix_(free, ends)] = follow.T * moves[ends, ends]
    left = covariance[np.ix_(free, free)] - follow.T @ covariance[np.ix_(ends, free)]
    unit = np.minimum(np.sqrt(np.diag(left)), largest[free])
    value, vectors = np.linalg.eigh(left / np.outer(unit, unit))
    moves[np.ix_(free, free)] = unit[:, None] * vectors * np.sqrt(np.maximum(value, _ROUNDED))
    return np.asarray(moves / np.maximum(1.0, np.abs(moves / largest[:, None]).max(axis=0)))


def linearise_with_curvature(
    root: FloatArray, target: FloatArray, bends: CurvatureTerms, at: FloatArray, priors: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return root (m, p), target (m,) of the normal about a bridge `at` (b,), without the offset.

    The inputs are those of x = (bridge, p - b others, offset, terms), |root x - target|²/2.
    `priors` is the precision (p - b, p - b) of the others, which determines the offset for `at`.
    """
    b = bends.about.size
    k = bends.shapes.shape[0]
    of_bridge, of_others = root[:, :b], root[:, b : root.shape[1] - 1 - k]
    of_place, of_bends = root[:, -1 - k], root[:, root.shape[1] - k :]
    inverse = np.asarray(np.linalg.inv(bends.directions))
    at, place = _within_reach(bends, inverse, at)
    size = float(np.linalg.norm(bends.directions[b]))
    others = cho_factor(of_others.T @ of_others + priors)
    for _ in range(_PLACE_STEPS):
        bend, slope = _bent(bends, inverse, at, place)
        left = target - of_bridge @ at - of_place * place - of_bends @ bend
        along = of_place + of_bends @ slope[:, b]
        # Its part that the others do not explain.
        free = along - of_others @ cho_solve(others, of_others.T @ along)
        step = float(free @ left) / float(free @ along)
        place += float(np.clip(step, -size, size))
        place = float(np.clip(place, -_FARTHEST * size, _FARTHEST * size))
    bend, slope = _bent(bends, inverse, at, place)
    rows_at = np.hstack([of_bridge + of_bends @ slope[:, :b], of_others])
    along = of_place + of_bends @ slope[:, b]
    left = target - of_bridge @ at - of_place * place - of_bends @ bend
    left = left + rows_at[:, :b] @ at + along * place
    along = along / np.linalg.norm(along)
    return rows_at - np.outer(along, along @ rows_at), left - along * (along @ left)


def _within_reach(
    bends: CurvatureTerms, inverse: FloatArray, at: FloatArray
) -> tuple[FloatArray, float]:
    """Return the bridge (b,) towards `at` (b,) as far as the terms apply, and its likeliest offset.

    `inverse` is that of the directions.
    """
    b = bends.about.size
    move, place = inverse[:, :b] @ (at - bends.about), inverse[:, b]
    move -= place * (place @ move) / (place @ place)
    moved = bends.directions @ np.clip(move, -_FARTHEST, _FARTHEST)
    return bends.about + moved[:b], float(moved[b])


def _bent(
    bends: CurvatureTerms, inverse: FloatArray, at: FloatArray, place: float
) -> tuple[FloatArray, FloatArray]:
    """Return the terms (k,) and their derivative (k, b + 1) by the coordinates and the offset."""
    move = inverse @ np.append(at - bends.about, place)
    number = move.size
    first, second = np.triu_indices(number)
    bend = bends.shapes @ (move[first] * move[second])
    slope = np.zeros((number, first.size))
    pairs = np.arange(first.size)
    np.add.at(slope, (first, pairs), move[second])
    np.add.at(slope, (second, pairs), move[first])
    return bend, bends.shapes @ slope.T @ inverse
