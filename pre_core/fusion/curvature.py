"""Curvature terms of a crossing's likelihood: second order in poorly determined directions.

With different wheel paths a single crossing determines elements only roughly, and its optimum lies
near the priors. A normal about that point lacks the curvature from there to the truth, which is the
same in all crossings of a survey, so that their number does not average it out. A crossing's
likelihood therefore keeps a surface of second order (`response_surface`), compressed to the few
significant sums of products, and fusion linearises each crossing again about the common estimate.
"""

from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from pre_core.arrays import FloatArray

_FARTHEST = 2.0
"""Largest size of a move at which the terms apply, relative to the standard deviation of the points
to which the surface was fitted."""
_FARTHEST_OF_DIFFERENCES = 0.7
"""The same for terms in compliances: differences with that step, from the optimum of the crossing.
Extrapolated to three sizes they made a bridge with a restrained end e times likelier, for each of
twelve runs of an independent simulator, than the best fit of the run to that bridge."""
_PLACE_STEPS = 4


class CurvatureTerms(NamedTuple):
    """Joint second-order effects of moves of the bridge's parameters and of the offset."""

    about: FloatArray  # (b,) the bridge's coordinates from which the moves count
    directions: FloatArray
    """Moves of unit size as columns (b + 1, b + 1), of the bridge and in m of the offset."""
    shapes: FloatArray
    """Coefficients (k, pairs) of each term in the products u_i u_j, i <= j by rows, of the sizes u
    of the moves."""
    logarithms: int = 0
    """Number of the last coordinates c of the bridge that enter as ln c, in moves and in the linear
    part: all elements, or none in the likelihoods of earlier versions."""


def to_surface_coordinates(bends: CurvatureTerms, at: FloatArray) -> FloatArray:
    """Return a bridge `at` (b,) in the coordinates (b,) of the linear part and the moves."""
    coordinates = at.copy()
    logs = slice(at.size - bends.logarithms, at.size)
    coordinates[logs] = np.log(at[logs])
    return coordinates


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
    farthest = _FARTHEST if bends.logarithms else _FARTHEST_OF_DIFFERENCES
    about = to_surface_coordinates(bends, bends.about)
    move, place = _within_reach(bends, inverse, to_surface_coordinates(bends, at) - about, farthest)
    at = about + move
    size = float(np.linalg.norm(bends.directions[b]))
    others = cho_factor(of_others.T @ of_others + priors)
    for _ in range(_PLACE_STEPS):
        bend, slope = _bent(bends, inverse, move, place)
        left = target - of_bridge @ at - of_place * place - of_bends @ bend
        along = of_place + of_bends @ slope[:, b]
        # Its part that the others do not explain.
        free = along - of_others @ cho_solve(others, of_others.T @ along)
        step = float(free @ left) / float(free @ along)
        place += float(np.clip(step, -size, size))
        place = float(np.clip(place, -farthest * size, farthest * size))
    bend, slope = _bent(bends, inverse, move, place)
    rows_at = np.hstack([of_bridge + of_bends @ slope[:, :b], of_others])
    along = of_place + of_bends @ slope[:, b]
    left = target - of_bridge @ at - of_place * place - of_bends @ bend
    logs = slice(b - bends.logarithms, b)
    at[logs] = np.exp(at[logs])
    rows_at[:, logs] /= at[logs]  # slopes by c
    left = left + rows_at[:, :b] @ at + along * place
    along = along / np.linalg.norm(along)
    return rows_at - np.outer(along, along @ rows_at), left - along * (along @ left)


def _within_reach(
    bends: CurvatureTerms, inverse: FloatArray, move: FloatArray, farthest: float
) -> tuple[FloatArray, float]:
    """Return the `move` (b,) as far as the terms apply, and the likeliest offset there.

    `inverse` is that of the directions, `farthest` the largest size of a move.
    """
    b = bends.about.size
    sizes, place = inverse[:, :b] @ move, inverse[:, b]
    sizes -= place * (place @ sizes) / (place @ place)
    moved = bends.directions @ np.clip(sizes, -farthest, farthest)
    return moved[:b], float(moved[b])


def _bent(
    bends: CurvatureTerms, inverse: FloatArray, move: FloatArray, place: float
) -> tuple[FloatArray, FloatArray]:
    """Return the terms (k,) and their derivative (k, b + 1) by the `move` (b,) and the offset."""
    sizes = inverse @ np.append(move, place)
    number = sizes.size
    first, second = np.triu_indices(number)
    bend = bends.shapes @ (sizes[first] * sizes[second])
    slope = np.zeros((number, first.size))
    pairs = np.arange(first.size)
    np.add.at(slope, (first, pairs), sizes[second])
    np.add.at(slope, (second, pairs), sizes[first])
    return bend, bends.shapes @ slope.T @ inverse
