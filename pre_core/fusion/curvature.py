"""Curvature terms of a crossing's likelihood: second order in poorly determined directions.

With different wheel paths a single crossing determines elements only roughly, and its optimum lies
near the priors. A normal about that point lacks the curvature from there to the truth, which is the
same in all crossings of a survey and does not average out. A crossing's likelihood therefore keeps
a surface of second order (`response_surface`), compressed to the few significant sums of products,
and fusion linearises each crossing again about the common estimate. The offset is the crossing's
longitudinal offset, which these terms contain, too.
"""

from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from pre_core.arrays import FloatArray

_FARTHEST = 2.0
"""Largest size of a move at which the terms apply, relative to the standard deviation of the points
to which the surface was fitted."""
_FARTHEST_OF_DIFFERENCES = 0.7
"""The same for terms in compliances, which are differences of this step about the crossing's
optimum. Extrapolated to a size of three, they overestimate the likelihood of a bridge with a
restrained end by a factor of e, in each of twelve runs of an independent simulator."""
_OFFSET_STEPS = 4
"""Number of Newton steps to the likeliest offset."""


class CurvatureTerms(NamedTuple):
    """Joint second-order effects of moves of the bridge's parameters and of the offset."""

    about: FloatArray  # (b,) the bridge's coordinates from which the moves start
    directions: FloatArray
    """Columns (b + 1, b + 1): moves of size one, of the bridge's b coordinates and of the offset in
    m."""
    shapes: FloatArray
    """Coefficients (k, pairs) of each term in the products u_i u_j, i <= j by rows, of the sizes u
    of the moves."""
    logarithms: int = 0
    """Number of the last coordinates c of the bridge that enter as ln c, in moves and in the linear
    part: all elements, or none in the likelihoods of earlier versions."""


def to_surface_coordinates(bends: CurvatureTerms, at: FloatArray) -> FloatArray:
    """Return bridges `at` (…, b) in the coordinates (…, b) of the linear part and the moves."""
    coordinates = at.copy()
    logs = slice(at.shape[-1] - bends.logarithms, at.shape[-1])
    coordinates[..., logs] = np.log(at[..., logs])
    return coordinates


def linearise_with_curvature(
    root: FloatArray, target: FloatArray, bends: CurvatureTerms, at: FloatArray, priors: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return root (m, p), target (m,) of the normal about a bridge `at` (b,), without the offset.

    With the inputs, the negative log-likelihood is |root x - target|²/2 of x = (bridge, p - b
    others, offset, terms). The likeliest offset for `at` also depends on `priors`, the precision (p
    - b, p - b) of the others.
    """
    b = bends.about.size
    k = bends.shapes.shape[0]
    of_bridge, of_others = root[:, :b], root[:, b : root.shape[1] - 1 - k]
    of_offset, of_bends = root[:, -1 - k], root[:, root.shape[1] - k :]
    inverse = np.asarray(np.linalg.inv(bends.directions))
    farthest = farthest_of(bends)
    about = to_surface_coordinates(bends, bends.about)
    wanted = to_surface_coordinates(bends, at) - about
    moves, offsets = _within_reach(bends, inverse, wanted[None, :], farthest)
    move, offset = moves[0], float(offsets[0])
    at = about + move
    size = float(np.linalg.norm(bends.directions[b]))
    others = cho_factor(of_others.T @ of_others + priors)
    for _ in range(_OFFSET_STEPS):
        bend, slope = _terms_at(bends, inverse, move, offset)
        left = target - of_bridge @ at - of_offset * offset - of_bends @ bend
        along = of_offset + of_bends @ slope[:, b]
        # The part of the offset's effect that the others do not explain.
        free = along - of_others @ cho_solve(others, of_others.T @ along)
        step = float(free @ left) / float(free @ along)
        offset += float(np.clip(step, -size, size))
        offset = float(np.clip(offset, -farthest * size, farthest * size))
    bend, slope = _terms_at(bends, inverse, move, offset)
    rows_at = np.hstack([of_bridge + of_bends @ slope[:, :b], of_others])
    along = of_offset + of_bends @ slope[:, b]
    left = target - of_bridge @ at - of_offset * offset - of_bends @ bend
    logs = slice(b - bends.logarithms, b)
    at[logs] = np.exp(at[logs])
    rows_at[:, logs] /= at[logs]  # derivatives with respect to c, not ln c
    left = left + rows_at[:, :b] @ at + along * offset
    along = along / np.linalg.norm(along)
    return rows_at - np.outer(along, along @ rows_at), left - along * (along @ left)


class CurvedForm(NamedTuple):
    """Residuals (m,) at any bridge as `rows` times features (f,), at the likeliest offset.

    The features are 1, the bridge's coordinates (b,) and, if there are terms, the offset and the
    terms (k,).
    """

    rows: FloatArray  # (m, f)
    bends: CurvatureTerms | None
    inverse: FloatArray
    """Inverse (b + 1, b + 1) of the directions of moves."""
    products: FloatArray
    """Symmetric form (k, (b + 1)²) of each term."""
    free: FloatArray
    """Quadratic form (f, f) of features that the likeliest offset minimises: everything but bridge
    and offset is eliminated."""

    def features(self, at: FloatArray) -> FloatArray:
        """Return the features (n, f) of bridges `at` (n, b)."""
        if self.bends is None:
            return np.column_stack([np.ones(at.shape[0]), at])
        constant, slope, square = self._by_offset(at)
        offset = self._likeliest_offset(constant, slope, square)[:, None]
        return constant + offset * slope + offset**2 * square

    def offset_projection(self, at: FloatArray) -> FloatArray:
        """Return the projection (m, m) that removes the offset's effect at a bridge (b,)."""
        unit = np.zeros(self.rows.shape[0])
        if self.bends is not None:
            constant, slope, square = self._by_offset(at[None, :])
            offset = self._likeliest_offset(constant, slope, square)[0]
            unit = self.rows @ (slope[0] + 2.0 * offset * square)
            unit /= np.linalg.norm(unit)
        return np.asarray(np.eye(unit.size) - np.outer(unit, unit))

    def _by_offset(self, at: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the features of bridges `at` (n, b) as a quadratic in a move of the offset.

        These are the constant (n, f), slope (n, f) and square (f,). The move starts at the
        likeliest offset of the bridges' moves within the terms' reach.
        """
        bends = self.bends
        assert bends is not None  # noqa: S101 - the caller has checked
        b, k = bends.about.size, bends.shapes.shape[0]
        about = to_surface_coordinates(bends, bends.about)
        wanted = to_surface_coordinates(bends, at) - about
        moves, offset = _within_reach(bends, self.inverse, wanted, farthest_of(bends))
        # Beyond their reach the terms continue linearly in c.
        beyond = wanted - moves
        logs = slice(b - bends.logarithms, b)
        beyond[:, logs] = np.expm1(beyond[:, logs])
        unit = self.inverse[:, b]
        sizes = moves @ self.inverse[:, :b].T + offset[:, None] * unit
        twice = sizes + 2.0 * (beyond @ self.inverse[:, :b].T)
        forms = self.products.reshape(k, b + 1, b + 1)
        outer = (sizes[:, :, None] * twice[:, None, :]).reshape(sizes.shape[0], -1)
        constant = np.column_stack(
            [np.ones(at.shape[0]), about + moves + beyond, offset, outer @ self.products.T]
        )
        slope = np.zeros_like(constant)
        slope[:, b + 1] = 1.0
        slope[:, b + 2 :] = (sizes + twice) @ (forms @ unit).T
        square = np.zeros(constant.shape[1])
        square[b + 2 :] = forms @ unit @ unit
        return constant, slope, square

    def _likeliest_offset(
        self, constant: FloatArray, slope: FloatArray, square: FloatArray
    ) -> FloatArray:
        """Return the move (n,) of the offset that minimises the squares; shapes as `_by_offset`."""
        assert self.bends is not None  # noqa: S101 - the caller has checked
        b = self.bends.about.size
        size = float(np.linalg.norm(self.bends.directions[b]))
        largest = farthest_of(self.bends) * size
        of_slope, of_square = slope @ self.free, self.free @ square
        first = np.sum(of_slope * constant, axis=1)
        second = np.sum(of_slope * slope, axis=1)
        bent, third, fourth = constant @ of_square, slope @ of_square, float(square @ of_square)
        moved = np.zeros(constant.shape[0])
        for _ in range(_OFFSET_STEPS):
            gradient = first + moved * (second + 2.0 * bent)
            gradient += 3.0 * moved**2 * third + 2.0 * moved**3 * fourth
            curvature = second + 4.0 * moved * third + 4.0 * moved**2 * fourth
            moved = moved - np.clip(gradient / curvature, -size, size)
            offset = constant[:, b + 1]
            moved = np.clip(offset + moved, -largest, largest) - offset
        return np.asarray(moved)


def curved_form(
    of_bridge: FloatArray,
    target: FloatArray,
    of_terms: FloatArray,
    bends: CurvatureTerms | None,
    free: FloatArray,
) -> CurvedForm:
    """Return the residuals target - root x of a likelihood with all other coordinates zero.

    `of_bridge` (m, b) and `of_terms` (m, 1 + k) are columns of its root; `free` (m, m)
    removes the part of residuals that the others explain; what remains determines the offset.
    """
    rows = np.column_stack([target, -of_bridge, -of_terms])
    if bends is None:
        return CurvedForm(rows, None, np.zeros((0, 0)), np.zeros((0, 0)), np.zeros((0, 0)))
    moves = bends.about.size + 1
    first, second = np.triu_indices(moves)
    forms = np.zeros((bends.shapes.shape[0], moves, moves))
    forms[:, first, second] += 0.5 * bends.shapes
    forms[:, second, first] += 0.5 * bends.shapes
    return CurvedForm(
        rows,
        bends,
        np.asarray(np.linalg.inv(bends.directions)),
        forms.reshape(forms.shape[0], -1),
        rows.T @ free @ rows,
    )


def farthest_of(bends: CurvatureTerms) -> float:
    """Return the largest size of a move at which the terms apply."""
    return _FARTHEST if bends.logarithms else _FARTHEST_OF_DIFFERENCES


def _within_reach(
    bends: CurvatureTerms, inverse: FloatArray, move: FloatArray, farthest: float
) -> tuple[FloatArray, FloatArray]:
    """Return moves (n, b) as far as the terms apply, and the likeliest offsets (n,) there.

    `inverse` is the inverse of the directions, `farthest` the largest size of a move.
    """
    b = bends.about.size
    sizes, by_offset = move @ inverse[:, :b].T, inverse[:, b]
    sizes -= np.outer(sizes @ by_offset, by_offset) / (by_offset @ by_offset)
    moved = np.clip(sizes, -farthest, farthest) @ bends.directions.T
    return moved[:, :b], moved[:, b]


def _terms_at(
    bends: CurvatureTerms, inverse: FloatArray, move: FloatArray, offset: float
) -> tuple[FloatArray, FloatArray]:
    """Return the terms (k,) and their derivatives (k, b + 1) at a `move` (b,) and an offset."""
    sizes = inverse @ np.append(move, offset)
    number = sizes.size
    first, second = np.triu_indices(number)
    bend = bends.shapes @ (sizes[first] * sizes[second])
    slope = np.zeros((number, first.size))
    pairs = np.arange(first.size)
    np.add.at(slope, (first, pairs), sizes[second])
    np.add.at(slope, (second, pairs), sizes[first])
    return bend, bends.shapes @ slope.T @ inverse
