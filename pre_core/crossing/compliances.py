"""The posterior of a crossing that tells little of its elements: normal in 1/EI, prior in ln EI.

Deflections are linear in the compliances c = EI_nominal/EI, of a statically determinate bridge
exactly. So with all other unknowns x, and c in place of ln EI, the rows are r + J (x - x_0) far
beyond where they are linear in ln EI; with the log-normal priors of EI, the priors at zero and what
may be absent altogether, that is a density which costs nothing and is close to the posterior even
where an element is known to no better than a factor.

It is drawn from by Gibbs' sampler: all unknowns that are normal given the others are integrated
out; an element's conditional is drawn by slices (Neal 2003), that of what may be absent is a normal
cut off at zero beside a point mass.
"""

from math import erf, exp, log, sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve, cholesky

from pre_core.crossing.optimum import Optimum
from pre_core.crossing.posterior import Problem, layout, log_odds_of_absence, rigidity_spread
from pre_core.crossing.preparation import slope_of_mismatch
from pre_core.kernels.lanes import kernel

FloatArray = NDArray[np.float64]

_SETTLING = 500
_SWEEPS = 60
"""From one draw to the next: an element is known by what its neighbours are not."""
LEANING_SPREAD = 0.25
"""What is taken off the slope for the mismatch is known to this share: its level to 15 %, the
tyres' widths and distance as little."""
_SLICE_WIDTH = 1.0
_MOST_WIDENINGS = 12


class Compliances(NamedTuple):
    """The density over y (f,), of which the coordinates `elements` are -ln(c)/sigma."""

    elements: NDArray[np.int64]
    sigma: FloatArray  # (elements,) spread of ln EI
    told: NDArray[np.int64]
    """Elements, then what must not be negative: (k,)."""
    others: NDArray[np.int64]
    centre: FloatArray  # (elements,) compliances at the optimum
    inflation: float
    precision: FloatArray  # (k, k) of the told, the others integrated out
    linear: FloatArray  # (k,)
    log_odds: FloatArray  # (k,) of being exactly zero, against the density per unit
    others_root: FloatArray
    """(others, others) lower triangle M: M' M is the covariance of the others given the told."""
    others_linear: FloatArray
    others_told: FloatArray  # (others, k) block of the precision
    leaning: FloatArray
    """(f,) where the optimum goes if all is taken off that the mismatch makes of the slope."""


def compliances(found: Optimum, inflation: float) -> Compliances:
    """About the optimum, of noise `inflation` times what was declared."""
    problem, state = found.problem, found.state
    where = layout(problem)
    kept = without_priors(problem, state.residual.size, where.elements)
    centre, jacobian = in_compliances(problem, state.y, state.jacobian[kept])
    precision = jacobian.T @ jacobian / inflation**2
    linear = precision @ centre - jacobian.T @ state.residual[kept] / inflation**2
    return of_normal(
        precision,
        linear,
        where.elements,
        where.half_normal,
        rigidity_spread(problem.priors),
        log_odds_of_absence(problem, inflation),
        inflation,
        centre[where.elements],
        led_by_mismatch(found),
    )


def without_priors(problem: Problem, rows: int, places: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return which of so many `rows` of the posterior are not the priors of some places in y."""
    # Rows of the priors come last, in the order of y up to the trajectory.
    return np.setdiff1d(np.arange(rows), rows - layout(problem).trajectory.start + places)


def in_compliances(
    problem: Problem, y: FloatArray, jacobian: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """The point y (f,) and a Jacobian (m, f) there with c in place of the elements' coordinates."""
    elements = layout(problem).elements
    sigma = rigidity_spread(problem.priors)
    centre, changed = y.copy(), jacobian.copy()
    centre[elements] = np.exp(-sigma * y[elements])
    changed[:, elements] /= -sigma * centre[elements]
    return centre, changed


def marginal(
    precision: FloatArray, linear: FloatArray, told: NDArray[np.int64]
) -> tuple[FloatArray, FloatArray]:
    """Precision and linear part of a normal's coordinates `told`, the others integrated out."""
    others = np.delete(np.arange(linear.size), told)
    factor = cho_factor(precision[np.ix_(others, others)], lower=True)
    across = precision[np.ix_(others, told)]
    led = across.T @ cho_solve(factor, np.column_stack([across, linear[others]]))
    return precision[np.ix_(told, told)] - led[:, :-1], linear[told] - led[:, -1]


def of_normal(
    precision: FloatArray,
    linear: FloatArray,
    elements: NDArray[np.int64],
    cut_off: NDArray[np.int64],
    sigma: FloatArray,
    log_odds: FloatArray,
    inflation: float,
    centre: FloatArray,
    leaning: FloatArray,
) -> Compliances:
    """Return those of a normal (f,), c at `elements`, times their priors, cut off at `cut_off`.

    `log_odds` (f,) as in `posterior.log_odds_of_absence`.
    """
    told = np.concatenate([elements, cut_off])
    others = np.setdiff1d(np.arange(linear.size), told)
    return Compliances(
        elements,
        sigma,
        told,
        others,
        centre,
        inflation,
        *marginal(precision, linear, told),
        log_odds[told],
        np.linalg.inv(cholesky(precision[np.ix_(others, others)], lower=True)),
        linear[others],
        precision[np.ix_(others, told)],
        leaning,
    )


def led_by_mismatch(found: Optimum) -> FloatArray:
    """Where the optimum goes if all is taken off that the mismatch makes of the slope: (f,).

    Nothing of what must not be negative, and of the elements, for which it is negligible.
    """
    problem, y, jacobian = found.problem, found.state.y, found.state.jacobian
    moved = np.zeros(y.size)
    if not problem.mismatch.level_m3.any():
        return moved
    slope = slope_of_mismatch(problem, y)
    moved[: slope.size] = slope
    moved = cho_solve(cho_factor(jacobian.T @ jacobian), moved)
    where = layout(problem)
    moved[where.half_normal] = 0.0
    moved[where.elements] = 0.0
    return np.asarray(moved)


def draws(
    of: Compliances, count: int, seed: int, stream: int, after: FloatArray | None = None
) -> FloatArray:
    """(count, f) draws of one of Gibbs' chains; `stream` tells chains of one seed apart.

    A chain that goes on `after` a draw (f,) of a density much like this one settles sooner.
    """
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(1 << 21, stream)))
    e = of.elements.size
    if after is not None:
        start = after[of.told]
    else:
        start = np.concatenate([np.log(of.centre) / -of.sigma, np.ones(of.told.size - e)])
        start[:e] += 0.3 * rng.standard_normal(e)
    told = np.empty((count, of.told.size))
    _gibbs(
        of.precision,
        of.linear,
        of.log_odds,
        of.sigma,
        of.inflation,
        start,
        _SETTLING if after is None else _SWEEPS,
        rng,
        told,
    )
    x = told.copy()
    x[:, :e] = np.exp(-of.sigma * told[:, :e])
    mean = of.others_linear - x @ of.others_told.T
    normal = rng.standard_normal((count, of.others.size))
    # With the covariance M' M the mean is M' M of the above, and the noise M' of a normal.
    y = np.empty((count, of.told.size + of.others.size))
    y[:, of.told] = told
    y[:, of.others] = (mean @ of.others_root.T + normal) @ of.others_root
    return y + LEANING_SPREAD * rng.standard_normal((count, 1)) * of.leaning


@kernel
def _gibbs(
    precision: FloatArray,
    linear: FloatArray,
    log_odds: FloatArray,
    sigma: FloatArray,
    inflation: float,
    start: FloatArray,
    settling: int,
    rng: np.random.Generator,
    out: FloatArray,
) -> None:
    """Fill out (count, k) from `start` (k,): y of elements, then what is not negative."""
    k, e = start.size, sigma.size
    y = start.copy()
    x = start.copy()
    for i in range(e):
        x[i] = exp(-sigma[i] * y[i])
    for sweep in range(settling + _SWEEPS * out.shape[0]):
        for i in range(k):
            pull = linear[i]
            for j in range(k):
                if j != i:
                    pull -= precision[i, j] * x[j]
            if i < e:
                y[i] = _slice(rng, y[i], pull, precision[i, i], sigma[i], inflation)
                x[i] = exp(-sigma[i] * y[i])
            else:
                x[i] = _cut_off(rng, pull, precision[i, i], log_odds[i])
                y[i] = x[i]
        done = sweep - settling
        if done >= 0 and done % _SWEEPS == _SWEEPS - 1:
            out[done // _SWEEPS] = y


@kernel
def _log_conditional(y: float, pull: float, own: float, sigma: float, inflation: float) -> float:
    c = exp(-sigma * y)
    return pull * c - 0.5 * own * c * c - 0.5 * (y / inflation) ** 2


@kernel
def _slice(
    rng: np.random.Generator, y: float, pull: float, own: float, sigma: float, inflation: float
) -> float:
    """One step from y by a slice of the conditional, widened and narrowed again."""
    level = _log_conditional(y, pull, own, sigma, inflation) + log(rng.random())
    low = y - _SLICE_WIDTH * rng.random()
    high = low + _SLICE_WIDTH
    for _ in range(_MOST_WIDENINGS):
        if _log_conditional(low, pull, own, sigma, inflation) < level:
            break
        low -= _SLICE_WIDTH
    for _ in range(_MOST_WIDENINGS):
        if _log_conditional(high, pull, own, sigma, inflation) < level:
            break
        high += _SLICE_WIDTH
    while high - low > 1e-12:
        new = low + (high - low) * rng.random()
        if _log_conditional(new, pull, own, sigma, inflation) >= level:
            return new
        if new < y:
            low = new
        else:
            high = new
    return y


@kernel
def _cut_off(rng: np.random.Generator, pull: float, own: float, log_odds: float) -> float:
    """From a normal cut off at zero beside a point mass there."""
    if log_odds == np.inf:
        return 0.0
    scale = 1.0 / sqrt(own)
    mean = pull / own
    at = mean / scale
    if log_odds > -np.inf:
        # Mass above zero over the density at zero; far below, what is left of it is scale/-at.
        if at > -6.0:
            above = log(scale * sqrt(2.0 * np.pi) * 0.5 * (1.0 + erf(at / sqrt(2.0))))
            above += 0.5 * at * at
        else:
            above = log(scale / -at)
        if rng.random() * (1.0 + exp(min(above - log_odds, 700.0))) < 1.0:
            return 0.0
    while True:
        if at > -1.0:
            new = mean + scale * rng.standard_normal()
            if new >= 0.0:
                return new
        else:  # an exponential about zero (Robert 1995)
            rate = 0.5 * (-at + sqrt(at * at + 4.0))
            new = -log(rng.random()) / rate
            if rng.random() < exp(-0.5 * (new - at - rate) ** 2):
                return new * scale
