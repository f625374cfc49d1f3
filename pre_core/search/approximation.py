"""What a target in sixty dimensions looks like near its optimum: normal, bent and cut off.

With y = T(v), where T maps a standard normal v to the approximation, chains and weighted draws
(`crank_nicolson`, `importance`) need only tell what the target differs from it.

A coordinate may be absent: part of the target lies on it being exactly zero, as where a bridge has
no spring at a support. The target is then a mixture over which of them are, every part with its own
density and its own approximation, that of the others given that these are zero (Carlin and Chib
1995), and a share by which it is proposed.

A coordinate may be bent: where y is the logarithm of a stiffness the data depend on its reciprocal,
and it is w = (1 - exp(-b (y - centre)))/b, not y, in which the posterior is nearly normal.
"""

from collections.abc import Callable
from itertools import combinations, product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cholesky
from scipy.special import log_ndtr, ndtri_exp

FloatArray = NDArray[np.float64]

_SMALLEST_SHIFT = 0.35
"""A mean that few draws put closer to where it was is their own scatter."""
_SMALLEST_STRETCH = 0.2
"""The same of a spread, relative to what it was."""
_ASIDE = (1.5, 3.0, 6.0)
"""Where the target is looked at along each axis, in standard deviations of the approximation:
further where nearer tells nothing."""
_FURTHEST = 2.0 / 3.0  # of where the target was looked at
_NARROWEST = 0.5
"""No axis becomes narrower at once than this share of what it was."""
_FLATTEST, _STEEPEST = 0.2, 4.0
"""Curvatures in v that are believed; one is what the approximation has."""
_PLAIN, _PLAIN_PAIR = 4.0, 5.0
"""So many standard errors of their scatter are slopes and curvatures that draws have to show; of
pairs there are thousands."""
_LOWEST = 6.0
"""Log weights so far below the others count as no lower: in the far tails nothing is a parabola."""
_STRAIGHTEST = 1e-9
"""What is left before the end of a bent coordinate, whose logarithm is taken."""
_LOG_TWO_PI = float(np.log(2.0 * np.pi))
_MASS_DRAWS = 500
"""For the share of a normal in which nothing is negative, to a few per cent."""
_SMALLEST_SHARE = 1e-5
"""A part that is less likely than this against the likeliest one is left out."""

LogDensity = Callable[[FloatArray], FloatArray]
"""Logarithm of the target at points (k, f), up to a constant; minus infinity where impossible."""


class Approximation(NamedTuple):
    """A normal with mean `centre`, cut off where the coordinates `positive` would be negative.

    In the order `order` (those that are absent first, then the other positive ones), the bent
    coordinates of y - centre are L z, where z is w = shift + scale v with standard normal v, those
    of the positive coordinates cut off one after the other. Where coordinates are absent their z is
    what makes them zero, and nothing depends on their v.
    """

    centre: FloatArray  # (f,)
    factor: FloatArray  # (f, f) lower triangle L
    order: NDArray[np.int64]  # (f,)
    absent: int
    positive: int
    """How many coordinates come first that are not negative, the absent ones included."""
    shift: FloatArray  # (f,) of w; zero until the approximation has been adapted
    scale: FloatArray  # (f,)
    bend: FloatArray  # (f,) zero: straight; of the positive ones it must be
    log_prior: float
    """Logarithm of what the part's density is to be multiplied by to be that of the mixture."""
    log_share: float
    """Logarithm of how often the part is proposed."""


class Mixture(NamedTuple):
    """The parts of the target, and what the random numbers follow from."""

    parts: tuple[Approximation, ...]
    seed: int


def mixture(
    centre: FloatArray,
    covariance: FloatArray,
    positive: NDArray[np.int64],
    bend: FloatArray,
    seed: int,
    log_odds: FloatArray | None = None,
) -> Mixture:
    """Bind a normal approximation (f,), (f, f) of the target; `bend` (f,) as above.

    `log_odds` (f,) is the logarithm of how many times the density of the target has to be taken
    where a coordinate is zero, against that per unit where it is not: minus infinity (the default)
    for one that is never absent, plus infinity for one that always is. Only what is positive can
    be. Parts that the approximation takes for impossible are left out.
    """
    f = centre.size
    odds = np.full(f, -np.inf) if log_odds is None else log_odds
    never = [i for i in positive if odds[i] == -np.inf]
    always = [i for i in positive if odds[i] == np.inf]
    perhaps = [i for i in positive if np.isfinite(odds[i])]
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(1 << 20,)))
    v = rng.standard_normal((_MASS_DRAWS, f))
    parts = []
    for which in product((False, True), repeat=len(perhaps)):
        absent = always + [i for i, is_absent in zip(perhaps, which, strict=True) if is_absent]
        present = [i for i, is_absent in zip(perhaps, which, strict=True) if not is_absent]
        first = np.array([*absent, *present, *never], dtype=np.int64)
        order = np.concatenate([first, np.setdiff1d(np.arange(f), first)])
        factor = np.asarray(cholesky(covariance[np.ix_(order, order)], lower=True))
        part = Approximation(
            centre,
            factor,
            order,
            len(absent),
            first.size,
            np.zeros(f),
            np.ones(f),
            bend,
            float(sum(odds[i] for i in absent if np.isfinite(odds[i]))),
            0.0,
        )
        parts.append(part._replace(log_share=part.log_prior + _log_mass(part, v)))
    most = max(part.log_share for part in parts)
    kept = [part for part in parts if part.log_share > most + np.log(_SMALLEST_SHARE)]
    total = float(np.logaddexp.reduce([part.log_share for part in kept]))
    return Mixture(tuple(p._replace(log_share=p.log_share - total) for p in kept), seed)


def _log_mass(part: Approximation, v: FloatArray) -> float:
    """Logarithm of the integral of the approximation, one at its optimum, over a part.

    The normal's own, and the share of it in which nothing is negative: the mean of the tails that
    cut draws off (Geweke, Hajivassiliou and Keane), over standard normals v (k, f).
    """
    z, log_tails = _cut_off(part, v)
    free = part.order.size - part.absent
    diagonal = np.diag(part.factor)[part.absent :]
    log_normal = 0.5 * free * _LOG_TWO_PI + float(np.log(diagonal).sum())
    away = 0.5 * float(np.sum(z[0, : part.absent] ** 2))
    mass = float(np.logaddexp.reduce(log_tails.sum(axis=1)) - np.log(v.shape[0]))
    return log_normal - away + mass


def adapted(mixed: Mixture, v: FloatArray) -> Mixture:
    """The approximation moved and stretched, coordinate by coordinate, to fit draws v (n, c, f).

    A posterior that leans to one side has its mean elsewhere than its optimum; draws tell where.
    Chains must be begun anew with it (`moved`), and the draws it was made of be thrown away. What
    is never negative stays: it means something else in every part.
    """
    mean, spread = v.mean(axis=(0, 1)), np.clip(v.std(axis=(0, 1)), 0.7, 1.6)
    # Few draws in many coordinates: only what stands out of their own scatter is taken over.
    mean = np.where(np.abs(mean) > _SMALLEST_SHIFT, mean, 0.0)
    spread = np.where(np.abs(spread - 1.0) > _SMALLEST_STRETCH, spread, 1.0)
    mean[: mixed.parts[0].positive] = 0.0
    spread[: mixed.parts[0].positive] = 1.0
    return mixed._replace(
        parts=tuple(
            part._replace(shift=part.shift + part.scale * mean, scale=part.scale * spread)
            for part in mixed.parts
        )
    )


def probed(
    target: LogDensity, mixed: Mixture, together: NDArray[np.int64] | None = None
) -> Mixture:
    """The approximation moved and stretched to fit the target along each of its own directions.

    Curvature at the optimum says little of a posterior that is flatter or steeper further away: the
    target is looked at 1.5 standard deviations to either side, and twice and four times as far
    where that is still within one standard deviation of what is seen. The coordinates `together`
    (d,) of y, of those that are never absent nor cut off, are then looked at two at a time, too.
    What is never negative stays.
    """
    part = mixed.parts[0]
    free = np.arange(part.positive, part.centre.size)
    shift, scale = part.shift.copy(), part.scale.copy()
    for aside in _ASIDE:
        ahead, behind, here = _log_densities_along(target, mixed, free, aside)
        with np.errstate(invalid="ignore", divide="ignore"):
            curvature = -(ahead + behind - 2.0 * here) / aside**2
            mean = (ahead - behind) / (2.0 * aside) / curvature
            spread = np.maximum(1.0 / np.sqrt(curvature), _NARROWEST)
        seen = np.isfinite(mean) & np.isfinite(spread) & (spread < aside)
        furthest = _FURTHEST * aside
        shift[free[seen]] += scale[free[seen]] * np.clip(mean[seen], -furthest, furthest)
        scale[free[seen]] *= spread[seen]
        free = free[~seen]
        if free.size == 0:
            break
    mixed = mixed._replace(parts=tuple(p._replace(shift=shift, scale=scale) for p in mixed.parts))
    if together is None:
        return mixed
    return _turned(mixed, np.zeros(part.centre.size), _curvature_of_pairs(target, mixed, together))


def probes(mixed: Mixture, together: NDArray[np.int64]) -> int:
    """How many points `probed` looks at, where it need not look further."""
    free = mixed.parts[0].centre.size - mixed.parts[0].positive
    return 2 * free + 1 + _signs(together.size).shape[0]


def learnt(
    mixed: Mixture, which: NDArray[np.int64], v: FloatArray, log_weight: FloatArray
) -> Mixture:
    """The approximation moved, stretched and turned to fit what weighted draws show.

    Of draws v (k, f) of the parts `which` (k,): the mean slope and curvature of their log weights
    over v, by Stein's identities, make a step of Newton's towards the normal that is closest to the
    target (Opper and Archambeau 2009). What does not stand out of the draws' own scatter is not
    taken over, and what is never negative stays.
    """
    seen = np.isfinite(log_weight)
    if seen.sum() <= v.shape[1]:  # too few to show anything
        return mixed
    v, log_weight = v[seen], log_weight[seen]
    in_part = which[seen, None] == np.unique(which[seen])
    rest = log_weight - in_part @ (in_part.T @ log_weight / in_part.sum(axis=0))
    rest = np.maximum(rest, -_LOWEST)
    rest -= rest.mean()
    error = rest.std() / np.sqrt(rest.size)
    slope = v.T @ rest / rest.size
    bend = (v.T * rest) @ v / rest.size
    own = np.diag(bend).copy()
    bend[np.abs(bend) < _PLAIN_PAIR * error] = 0.0
    # The square of a standard normal scatters by the root of two.
    np.fill_diagonal(bend, np.where(np.abs(own) > np.sqrt(2.0) * _PLAIN * error, own, 0.0))
    slope[np.abs(slope) < _PLAIN * error] = 0.0
    positive = mixed.parts[0].positive
    slope[:positive], bend[:positive], bend[:, :positive] = 0.0, 0.0, 0.0
    precision = _believed(np.eye(slope.size) - bend)
    return _turned(mixed, np.linalg.solve(precision, slope), precision)


def _believed(precision: FloatArray) -> FloatArray:
    """The same with no curvature beyond what is believed."""
    curvature, axes = np.linalg.eigh(precision)
    return np.asarray((axes * np.clip(curvature, _FLATTEST, _STEEPEST)) @ axes.T)


def _turned(mixed: Mixture, mean: FloatArray, precision: FloatArray) -> Mixture:
    """The approximation that is normal about `mean` (f,) with `precision` (f, f) in today's v."""
    turn = np.asarray(cholesky(np.linalg.inv(precision), lower=True))
    first = mixed.parts[0]
    stretch = first.scale[:, None] * turn
    shift = np.linalg.solve(stretch, first.shift + first.scale * mean)
    return mixed._replace(
        parts=tuple(
            part._replace(factor=part.factor @ stretch, shift=shift, scale=np.ones(shift.size))
            for part in mixed.parts
        )
    )


def _signs(count: int) -> NDArray[np.int64]:
    """Where two of so many coordinates are looked at together: (pairs of signs, count)."""
    signs = []
    for i, j in combinations(range(count), 2):
        for of_i, of_j in product((1, -1), repeat=2):
            one = np.zeros(count, dtype=np.int64)
            one[[i, j]] = of_i, of_j
            signs.append(one)
    return np.array(signs, dtype=np.int64).reshape(-1, count)


def _curvature_of_pairs(
    target: LogDensity, mixed: Mixture, together: NDArray[np.int64]
) -> FloatArray:
    """Curvatures (f, f) in v of the target: of pairs of some coordinates of y, one of all others.

    Not of one coordinate by itself: to that the approximation has been fitted.
    """
    part = mixed.parts[0]
    places = np.flatnonzero(np.isin(part.order, together))
    signs = _signs(places.size)
    v = np.zeros((signs.shape[0], part.centre.size))
    v[:, places] = _ASIDE[0] * signs
    y, log_q = mapped(mixed, np.zeros(v.shape[0], dtype=np.int64), v)
    log_p = weighed(target, y, log_q) - 0.5 * np.sum(v**2, axis=1)
    curvature = np.eye(part.centre.size)
    with np.errstate(invalid="ignore"):
        mixed_derivatives = (signs.T * log_p) @ signs / (4.0 * _ASIDE[0] ** 2)
    if np.isfinite(mixed_derivatives).all():
        apart = ~np.eye(places.size, dtype=bool)
        curvature[np.ix_(places, places)] -= np.where(apart, mixed_derivatives, 0.0)
    return _believed(curvature)


def _log_densities_along(
    target: LogDensity, mixed: Mixture, free: NDArray[np.int64], aside: float
) -> tuple[FloatArray, FloatArray, float]:
    """Log density of the target over v, `aside` ahead of zero and behind (d,), and there.

    Along the axes `free` (d,): of the points, times what the map stretches.
    """
    d = free.size
    v = np.zeros((2 * d + 1, mixed.parts[0].centre.size))
    v[np.arange(d), free] = aside
    v[d + np.arange(d), free] = -aside
    y, log_q = mapped(mixed, np.zeros(v.shape[0], dtype=np.int64), v)
    log_p = weighed(target, y, log_q) - 0.5 * np.sum(v**2, axis=1)
    return log_p[:d], log_p[d:-1], float(log_p[-1])


def _cut_off(part: Approximation, v: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The z of standard normals v (k, f), and the logarithms (k, cut off) of the tails it is in."""
    w = part.shift + part.scale * v
    z = w.copy()
    log_tails = np.zeros((v.shape[0], part.positive - part.absent))
    for i in range(part.positive):
        # The i-th ordered coordinate, centre + sum over j <= i of L_ij z_j, must stay >= 0.
        before = part.centre[part.order[i]] + z[:, :i] @ part.factor[i, :i]
        lowest = -before / part.factor[i, i]
        if i < part.absent:
            z[:, i] = lowest
            continue
        log_tail = log_ndtr(-lowest)
        # The upper tail probability of w_i, shrunk to the part above `lowest`.
        z[:, i] = np.maximum(-ndtri_exp(log_ndtr(-w[:, i]) + log_tail), lowest)
        log_tails[:, i - part.absent] = log_tail
    return z, log_tails


def _map_part(part: Approximation, v: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Points of standard normals v (k, f) in one part, and the log density with which they come.

    That of being proposed there at all is in it, less what the target's density there is to be
    multiplied by: one and the same target is then weighed against it in every part.
    """
    z, log_tails = _cut_off(part, v)
    free = slice(part.absent, None)
    cut = slice(part.absent, part.positive)
    w = part.shift[cut] + part.scale[cut] * v[:, cut]
    # The density of v, over dw/dv, dz/dw (of what is cut off) and dy/dz.
    log_q = -0.5 * np.sum(v[:, free] ** 2, axis=1) + 0.5 * np.sum(w**2 - z[:, cut] ** 2, axis=1)
    log_q -= log_tails.sum(axis=1)
    stretch = part.scale[free] * np.diag(part.factor)[free]
    log_q -= 0.5 * stretch.size * _LOG_TWO_PI + float(np.log(stretch).sum())
    y = np.empty_like(z)
    y[:, part.order] = z @ part.factor.T
    for k in np.flatnonzero(part.bend):
        inner = 1.0 - part.bend[k] * y[:, k]
        impossible = inner <= _STRAIGHTEST  # beyond the end of the bent coordinate
        inner = np.where(impossible, _STRAIGHTEST, inner)
        y[:, k] = -np.log(inner) / part.bend[k]
        log_q += np.where(impossible, np.inf, np.log(inner))
    y += part.centre
    ends = part.order[: part.positive]
    y[:, ends] = np.maximum(y[:, ends], 0.0)
    y[:, part.order[: part.absent]] = 0.0
    return y, log_q + part.log_share - part.log_prior


def mapped(
    mixed: Mixture, which: NDArray[np.int64], v: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Points (k, f) of standard normals v (k, f) in the parts `which` (k,), and the log densities.

    With which they come; those of the parts' shares are in them.
    """
    y, log_q = np.empty_like(v), np.empty(v.shape[0])
    for i in np.unique(which):
        there = which == i
        y[there], log_q[there] = _map_part(mixed.parts[i], v[there])
    return y, log_q


def weighed(target: LogDensity, y: FloatArray, log_q: FloatArray) -> FloatArray:
    """Log weights (k,) of points (k, f) that come with the log densities `log_q` (k,)."""
    log_p = target(y)
    return np.where(np.isfinite(log_p), log_p, -np.inf) - log_q
