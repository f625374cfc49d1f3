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

from pre_core.crossing import posterior
from pre_core.crossing.fit import Optimum, normal_approximation

FloatArray = NDArray[np.float64]

_STEP = 0.4
"""Step of the second differences, relative to the coordinate's size."""
_LARGEST = 1.0
"""Largest size, in the prior's units and in m of the offset."""
_LARGEST_COMPLIANCE = 0.5
"""Largest size of a compliance, relative to itself."""
_PLAIN = 0.2
"""Smallest curvature term that is kept, if everything moves by its size, in standard deviations."""
_MAX_BENDS = 40
_FARTHEST = 3.0
"""Largest distance from the optimum, in sizes, at which the terms apply."""
_PLACE_STEPS = 4


class CurvatureTerms(NamedTuple):
    """Joint second-order effects of moves of the bridge parameters and of the offset."""

    about: FloatArray  # (b,) the bridge's coordinates at the optimum
    size: FloatArray  # (b + 1,) how far they are likely to be from there; the place last, in m
    shapes: FloatArray
    """Coefficients (k, pairs) of each term in the products u_i u_j, i <= j by rows, of moves u in
    units of `size`."""


def curvature_terms(
    found: Optimum, problem: posterior.PosteriorProblem, rows: NDArray[np.int64]
) -> tuple[CurvatureTerms, FloatArray]:
    """Return the terms at an optimum, and the effect of each on residuals `rows`: (rows, k).

    `problem` may have another noise than the optimum's. The coordinate of EI is c.
    """
    y = found.state.y
    where = posterior.layout(problem)
    sigma = posterior.rigidity_spread(problem.priors)
    about = y[where.bridge].copy()
    about[-sigma.size :] = np.exp(-sigma * y[where.elements])
    size = _sizes(found, about[-sigma.size :])
    b = where.bridge.size
    number = b + 1
    first, second = np.triu_indices(number)
    steps = np.concatenate([np.zeros((1, number)), np.eye(number), np.eye(number)[first]])
    steps[1 + number :] += np.eye(number)[second]
    points = np.repeat(y[None, :], steps.shape[0], axis=0)
    moved = _STEP * steps * size
    single = b - sigma.size
    points[:, where.bridge[:single]] += moved[:, :single]
    points[:, where.elements] = -np.log(about[single:] + moved[:, single:b]) / sigma
    points[:, where.trajectory] += moved[:, b:]
    values = posterior.all_rows(problem, points)[:, rows]
    here, once, twice = values[0], values[1 : 1 + number], values[1 + number :]
    differences = (twice - once[first] - once[second] + here) / _STEP**2
    differences[first == second] *= 0.5
    weight, shapes = np.linalg.eigh(differences @ differences.T)
    kept = np.flatnonzero(weight > _PLAIN**2)[::-1][:_MAX_BENDS]
    shapes = shapes[:, kept].T
    return CurvatureTerms(about, size, shapes), differences.T @ shapes.T


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
    far = _FARTHEST * bends.size
    at = bends.about + np.clip(at - bends.about, -far[:b], far[:b])
    place = 0.0
    others = cho_factor(of_others.T @ of_others + priors)
    for _ in range(_PLACE_STEPS):
        bend, slope = _bent(bends, at, place)
        left = target - of_bridge @ at - of_place * place - of_bends @ bend
        along = of_place + of_bends @ slope[:, b]
        # Its part that the others do not explain.
        free = along - of_others @ cho_solve(others, of_others.T @ along)
        step = float(free @ left) / float(free @ along)
        place += float(np.clip(step, -bends.size[b], bends.size[b]))
        place = float(np.clip(place, -far[b], far[b]))
    bend, slope = _bent(bends, at, place)
    rows_at = np.hstack([of_bridge + of_bends @ slope[:, :b], of_others])
    along = of_place + of_bends @ slope[:, b]
    left = target - of_bridge @ at - of_place * place - of_bends @ bend
    left = left + rows_at[:, :b] @ at + along * place
    along = along / np.linalg.norm(along)
    return rows_at - np.outer(along, along @ rows_at), left - along * (along @ left)


def _bent(bends: CurvatureTerms, at: FloatArray, place: float) -> tuple[FloatArray, FloatArray]:
    """Return the terms (k,) and their derivative (k, b + 1) by the coordinates and the offset."""
    number = bends.size.size
    move = np.append(at - bends.about, place) / bends.size
    first, second = np.triu_indices(number)
    bend = bends.shapes @ (move[first] * move[second])
    slope = np.zeros((number, first.size))
    pairs = np.arange(first.size)
    np.add.at(slope, (first, pairs), move[second])
    np.add.at(slope, (second, pairs), move[first])
    return bend, (bends.shapes @ slope.T) / bends.size


def _sizes(found: Optimum, compliance: FloatArray) -> FloatArray:
    """Return the likely distance (b + 1,) of bridge and offset from the optimum."""
    where = posterior.layout(found.problem)
    _, covariance = normal_approximation(found)
    spread = np.sqrt(np.diag(covariance))
    size = np.minimum(spread, _LARGEST)
    relative = posterior.rigidity_spread(found.problem.priors) * spread[where.elements]
    size[where.elements] = np.minimum(relative, _LARGEST_COMPLIANCE) * compliance
    along = covariance[where.trajectory, where.trajectory]
    place = float(np.sqrt(along.mean()))
    return np.append(size[where.bridge], min(place, _LARGEST))
