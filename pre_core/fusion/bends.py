"""A crossing's likelihood beyond the normal: its rows are bent in what it hardly tells.

On roads that differ a single crossing knows its place along the road to half a metre and elements
to a factor, and its optimum lies where the priors are. A normal about that point leaves out what
is of second order from there to the truth; it is the same in all crossings of a survey, so that no
number of them averages it out. So the products of such moves are kept as well, as few sums of them
as make a difference, and where crossings are fused each is made normal again about what all say.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from pre_core.crossing import posterior
from pre_core.crossing.optimum import Optimum, normal_approximation

FloatArray = NDArray[np.float64]

_STEP = 0.4
"""Of a coordinate's size, by which second differences are taken."""
_LARGEST = 1.0
"""Of a size in the prior's units, and in m of the place."""
_LARGEST_COMPLIANCE = 0.5
"""Of a size of a compliance, relative to itself."""
_PLAIN = 0.2
"""Of a bend where everything moves by its size, in standard deviations of white rows."""
_MOST_BENDS = 40
_FARTHEST = 3.0
"""Sizes from the optimum as far as the bends are believed."""
_PLACE_STEPS = 4


class Bends(NamedTuple):
    """What moves of the bridge's coordinates and of the place do together."""

    about: FloatArray  # (b,) the bridge's coordinates at the optimum
    size: FloatArray  # (b + 1,) how far they are likely to be from there; the place last, in m
    shapes: FloatArray
    """(k, pairs) bends as sums of the products of two moves in these sizes, i <= j row by row."""


def bends_of(
    found: Optimum, problem: posterior.Problem, rows: NDArray[np.int64]
) -> tuple[Bends, FloatArray]:
    """Bends at an optimum, and what each does to `rows` of the posterior (rows, k).

    `problem` may have another noise than the optimum's. EI's coordinate is c.
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
    kept = np.flatnonzero(weight > _PLAIN**2)[::-1][:_MOST_BENDS]
    shapes = shapes[:, kept].T
    return Bends(about, size, shapes), differences.T @ shapes.T


def straightened(
    root: FloatArray, target: FloatArray, bends: Bends, at: FloatArray, priors: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Root (m, p) and target (m,) of the normal about a bridge `at` (b,), the place integrated out.

    Those given are of x = (bridge, p - b others, place, bends), |root x - target|²/2. `priors` is
    the others' precision (p - b, p - b), by which the place is found that goes with `at`.
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
        # What is left of it when the others have taken their part.
        free = along - of_others @ cho_solve(others, of_others.T @ along)
        step = float(free @ left) / float(free @ along)
        place += float(np.clip(step, -bends.size[b], bends.size[b]))
        place = float(np.clip(place, -far[b], far[b]))
    bend, slope = _bent(bends, at, place)
    told = np.hstack([of_bridge + of_bends @ slope[:, :b], of_others])
    along = of_place + of_bends @ slope[:, b]
    left = target - of_bridge @ at - of_place * place - of_bends @ bend
    left = left + told[:, :b] @ at + along * place
    along = along / np.linalg.norm(along)
    return told - np.outer(along, along @ told), left - along * (along @ left)


def _bent(bends: Bends, at: FloatArray, place: float) -> tuple[FloatArray, FloatArray]:
    """The bends (k,), and how they change with each of the coordinates and the place (k, b + 1)."""
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
    """How far bridge and place are likely to be from the optimum: (b + 1,)."""
    where = posterior.layout(found.problem)
    _, covariance = normal_approximation(found)
    spread = np.sqrt(np.diag(covariance))
    size = np.minimum(spread, _LARGEST)
    relative = posterior.rigidity_spread(found.problem.priors) * spread[where.elements]
    size[where.elements] = np.minimum(relative, _LARGEST_COMPLIANCE) * compliance
    along = covariance[where.trajectory, where.trajectory]
    place = float(np.sqrt(along.mean()))
    return np.append(size[where.bridge], min(place, _LARGEST))
