"""Posterior of a crossing that determines its elements poorly, normal in 1/EI.

Deflections are linear in the compliances c = EI_nominal/EI, exactly for a statically determinate
bridge. So the residuals, as a function of coordinates x with c in place of ln EI, are r + J (x -
x_0) far beyond the range in which they are linear in ln EI. With the log-normal priors of EI, the
priors at zero and the point masses of absence, this density is cheap, and close to the posterior
even where an element is known only to a factor of several.

It is sampled by a Gibbs sampler: all coordinates that are conditionally normal are integrated
out; elements are drawn by slice sampling (Neal 2003); the conditional of a coordinate that may be
absent is a normal truncated at zero with a point mass there.
"""

from math import erf, exp, log, sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve, cholesky

from pre_core.arrays import FloatArray
from pre_core.crossing.fit import Optimum
from pre_core.crossing.posterior import (
    PosteriorProblem,
    layout,
    log_odds_of_absence,
    posterior_covariance,
    precision_root,
    rigidity_spread,
)
from pre_core.crossing.preparation import mismatch_gradient
from pre_core.kernels.lanes import inner, kernel
from pre_core.search.convergence import CHAINS

_BURN_IN = 500
"""Sweeps of burn-in before the first draw."""
_SWEEPS = 60
"""Sweeps between two draws, because neighbouring elements are strongly correlated."""
MISMATCH_BIAS_SPREAD = 0.25
"""Relative uncertainty of the gradient correction for the mismatch: its level is known to 15 %, the
tyres' widths and distance no better."""
_SLICE_WIDTH = 1.0
_MAX_WIDENINGS = 12


class _SampledDensity(NamedTuple):
    """The part of a `CompliancePosterior` that the Gibbs sampler needs."""

    precision: FloatArray  # (k, k)
    linear: FloatArray  # (k,)
    log_odds: FloatArray  # (k,)
    sigma: FloatArray  # (elements,)
    inflation: float


class CompliancePosterior(NamedTuple):
    """The density over y (f,), of which the coordinates `elements` are -ln(c)/sigma."""

    elements: NDArray[np.int64]
    sigma: FloatArray  # (elements,) spread of ln EI
    sampled: NDArray[np.int64]
    """Indices (k,) of the elements, then of coordinates that must not be negative."""
    others: NDArray[np.int64]
    centre: FloatArray  # (elements,) compliances at the optimum
    inflation: float
    precision: FloatArray  # (k, k) of the sampled, the others integrated out
    linear: FloatArray  # (k,)
    log_odds: FloatArray  # (k,) see `posterior.log_odds_of_absence`
    others_root: FloatArray
    """Lower triangle M (others, others): M' M is the covariance of the others given `sampled`."""
    others_linear: FloatArray
    others_sampled: FloatArray  # (others, k) block of the precision
    bias_direction: FloatArray
    """Change (f,) of the optimum if the whole mismatch part of the gradient is removed."""


def compliance_posterior(found: Optimum, inflation: float) -> CompliancePosterior:
    """Return the density about an optimum, for noise `inflation` times the declared one."""
    problem, state = found.problem, found.state
    where = layout(problem)
    kept = without_priors(problem, state.residual.size, where.elements)
    centre, jacobian = to_compliance_coordinates(problem, state.y, state.jacobian[kept])
    precision = jacobian.T @ jacobian / inflation**2
    linear = precision @ centre - jacobian.T @ state.residual[kept] / inflation**2
    posterior = from_normal(
        precision,
        linear,
        where.elements,
        where.half_normal,
        rigidity_spread(problem.priors),
        log_odds_of_absence(problem, inflation),
        centre[where.elements],
    )
    return posterior._replace(inflation=inflation, bias_direction=mismatch_bias(found))


def without_priors(
    problem: PosteriorProblem, rows: int, indices: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Return the indices (m,) of `rows` residuals but the priors of the coordinates `indices`."""
    # The priors' residuals come last, in the order of y up to the trajectory.
    return np.setdiff1d(np.arange(rows), rows - layout(problem).trajectory.start + indices)


def to_compliance_coordinates(
    problem: PosteriorProblem, y: FloatArray, jacobian: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return y (f,) and a Jacobian (m, f) there with c in place of the elements' coordinates."""
    elements = layout(problem).elements
    sigma = rigidity_spread(problem.priors)
    centre, changed = y.copy(), jacobian.copy()
    centre[elements] = np.exp(-sigma * y[elements])
    changed[:, elements] /= -sigma * centre[elements]
    return centre, changed


class ComplianceNormal(NamedTuple):
    """Gauss-Newton approximation of a posterior, with c in place of the elements' coordinates."""

    centre: FloatArray  # (f,)
    jacobian: FloatArray  # (m, f)
    covariance: FloatArray  # (f, f)


def compliance_normal(found: Optimum) -> ComplianceNormal:
    """Return the approximation at an optimum."""
    centre, jacobian = to_compliance_coordinates(found.problem, found.state.y, found.state.jacobian)
    return ComplianceNormal(centre, jacobian, posterior_covariance(precision_root(jacobian)))


def marginal(
    precision: FloatArray, linear: FloatArray, kept: NDArray[np.int64]
) -> tuple[FloatArray, FloatArray]:
    """Return precision (k, k) and linear part (k,) of the coordinates `kept` (k,) alone.

    All other coordinates of the normal with this precision (f, f) and linear part (f,) are
    integrated out.
    """
    others = np.delete(np.arange(linear.size), kept)
    factor = cho_factor(precision[np.ix_(others, others)], lower=True)
    across = precision[np.ix_(others, kept)]
    led = across.T @ cho_solve(factor, np.column_stack([across, linear[others]]))
    return precision[np.ix_(kept, kept)] - led[:, :-1], linear[kept] - led[:, -1]


def from_normal(
    precision: FloatArray,
    linear: FloatArray,
    elements: NDArray[np.int64],
    cut_off: NDArray[np.int64],
    sigma: FloatArray,
    log_odds: FloatArray,
    centre: FloatArray,
) -> CompliancePosterior:
    """Return the posterior of a normal likelihood `precision` (f, f), `linear` (f,) and the priors.

    Coordinates `elements` (e,) are compliances c; `sigma` (e,) are the spreads of ln EI, `centre`
    (e,) the compliances at the optimum. Coordinates `cut_off` (k,) are truncated at zero.
    `log_odds` (f,) are those of `posterior.log_odds_of_absence`. The noise is as declared, without
    bias of the mismatch.
    """
    sampled = np.concatenate([elements, cut_off])
    others = np.setdiff1d(np.arange(linear.size), sampled)
    return CompliancePosterior(
        elements,
        sigma,
        sampled,
        others,
        centre,
        1.0,
        *marginal(precision, linear, sampled),
        log_odds[sampled],
        np.linalg.inv(cholesky(precision[np.ix_(others, others)], lower=True)),
        linear[others],
        precision[np.ix_(others, sampled)],
        np.zeros(linear.size),
    )


def mismatch_bias(found: Optimum) -> FloatArray:
    """Return the change (f,) of the optimum if the mismatch part of the gradient is removed.

    It is zero for coordinates that must not be negative, and for the elements, where it is
    negligible.
    """
    problem, y, jacobian = found.problem, found.state.y, found.state.jacobian
    moved = np.zeros(y.size)
    if not problem.mismatch.level_m3.any():
        return moved
    slope = mismatch_gradient(problem, y)
    moved[: slope.size] = slope
    moved = cho_solve(cho_factor(jacobian.T @ jacobian), moved)
    where = layout(problem)
    moved[where.half_normal] = 0.0
    moved[where.elements] = 0.0
    return np.asarray(moved)


def draws(
    posterior: CompliancePosterior,
    count: int,
    seed: int,
    stream: int,
    after: FloatArray | None = None,
) -> FloatArray:
    """Return draws (count, f) of one Gibbs chain; `stream` distinguishes chains of one seed.

    A chain that continues `after` a draw (f,) of a similar density converges sooner.
    """
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(1 << 21, stream)))
    e = posterior.elements.size
    if after is not None:
        start = after[posterior.sampled]
    else:
        start = np.concatenate(
            [np.log(posterior.centre) / -posterior.sigma, np.ones(posterior.sampled.size - e)]
        )
        start[:e] += 0.3 * rng.standard_normal(e)
    sampled = np.empty((count, posterior.sampled.size))
    density = _SampledDensity(
        posterior.precision,
        posterior.linear,
        posterior.log_odds,
        posterior.sigma,
        posterior.inflation,
    )
    _gibbs(density, start, _BURN_IN if after is None else _SWEEPS, rng, sampled)
    x = sampled.copy()
    x[:, :e] = np.exp(-posterior.sigma * sampled[:, :e])
    mean = posterior.others_linear - x @ posterior.others_sampled.T
    normal = rng.standard_normal((count, posterior.others.size))
    # With the covariance M' M the mean is M' M of the above, and the noise M' of a normal.
    y = np.empty((count, posterior.sampled.size + posterior.others.size))
    y[:, posterior.sampled] = sampled
    y[:, posterior.others] = (mean @ posterior.others_root.T + normal) @ posterior.others_root
    return y + MISMATCH_BIAS_SPREAD * rng.standard_normal((count, 1)) * posterior.bias_direction


def present_points(found: Optimum, count: int, inflation: float, seed: int) -> FloatArray:
    """Return at least `count` points (k, f) of the density about an optimum, without absence."""
    near = compliance_posterior(found, inflation)
    near = near._replace(log_odds=never_absent(near.log_odds))
    each = -(-count // CHAINS)
    return np.concatenate([draws(near, each, seed, chain) for chain in range(CHAINS)])


def never_absent(log_odds: FloatArray) -> FloatArray:
    """Return log odds (n,) that exclude absence, except where the site file excludes presence."""
    return np.where(np.isposinf(log_odds), log_odds, -np.inf)


@kernel
def _gibbs(
    density: _SampledDensity,
    start: FloatArray,
    burn_in: int,
    rng: np.random.Generator,
    out: FloatArray,
) -> None:
    """Fill out (count, k) from `start` (k,): y of elements, then non-negative coordinates."""
    precision, linear, log_odds = density.precision, density.linear, density.log_odds
    sigma, inflation = density.sigma, density.inflation
    k, e = start.size, sigma.size
    y = start.copy()
    x = start.copy()
    for i in range(e):
        x[i] = exp(-sigma[i] * y[i])
    for sweep in range(burn_in + _SWEEPS * out.shape[0]):
        for i in range(k):
            pull = linear[i]
            for j in range(k):
                if j != i:
                    pull -= precision[i, j] * x[j]
            if i < e:
                y[i] = _slice(rng, y[i], pull, precision[i, i], sigma[i], inflation)
                x[i] = exp(-sigma[i] * y[i])
            else:
                x[i] = _truncated_draw(rng, pull, precision[i, i], log_odds[i])
                y[i] = x[i]
        done = sweep - burn_in
        if done >= 0 and done % _SWEEPS == _SWEEPS - 1:
            for i in range(k):
                out[done // _SWEEPS, i] = y[i]


@inner
def _log_conditional(y: float, pull: float, own: float, sigma: float, inflation: float) -> float:
    c = exp(-sigma * y)
    return pull * c - 0.5 * own * c * c - 0.5 * (y / inflation) ** 2


@inner
def _slice(
    rng: np.random.Generator, y: float, pull: float, own: float, sigma: float, inflation: float
) -> float:
    """Take one step from y by a slice of the conditional, stepping out and shrinking."""
    level = _log_conditional(y, pull, own, sigma, inflation) + log(rng.random())
    low = y - _SLICE_WIDTH * rng.random()
    high = low + _SLICE_WIDTH
    for _ in range(_MAX_WIDENINGS):
        if _log_conditional(low, pull, own, sigma, inflation) < level:
            break
        low -= _SLICE_WIDTH
    for _ in range(_MAX_WIDENINGS):
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


@inner
def _truncated_draw(rng: np.random.Generator, pull: float, own: float, log_odds: float) -> float:
    """Draw from a normal truncated at zero with a point mass there."""
    if log_odds == np.inf:
        return 0.0
    scale = 1.0 / sqrt(own)
    mean = pull / own
    at = mean / scale
    if log_odds > -np.inf:
        # Mass above zero over the density at zero; for a mean far below zero it is scale/-at.
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
