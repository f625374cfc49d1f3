"""Markov chains on the posterior, steered by the normal approximation at its optimum.

The posterior of one crossing is close to normal in sixty dimensions. With y = T(w), where T maps a
standard normal w to the approximation, the chains move by

    w' = rho w + sqrt(1 - rho^2) xi,    xi standard normal,

which leaves the approximation itself invariant, and accept by what the posterior differs from it
(preconditioned Crank-Nicolson; Cotter et al. 2013). rho = 0 proposes anew and is accepted about
every third time; rho near one gets a chain away from where the approximation is too thin. Many
short chains start from draws of the approximation; their agreement (split R-hat; Gelman et al.,
BDA 3, section 11.4) tells whether to believe them.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cholesky
from scipy.special import log_ndtr, ndtri_exp

from pre_core.search import Ending

FloatArray = NDArray[np.float64]

CHAINS = 20
RHO = (0.0, 0.8, 0.6, 0.95)
"""Taken in turn."""

LogDensity = Callable[[FloatArray], FloatArray]
"""Logarithm of the target at points (k, f), up to a constant; minus infinity where impossible."""


class Approximation(NamedTuple):
    """A normal with mean `centre`, cut off where the coordinates `positive` would be negative.

    In the order `order` (the positive ones first), y = centre + L z with standard normal z, those
    of the positive coordinates cut off one after the other.
    """

    centre: FloatArray  # (f,)
    factor: FloatArray  # (f, f) lower triangle L
    order: NDArray[np.int64]  # (f,)
    positive: int
    seed: int


class State(NamedTuple):
    """Where the chains are: normals and points (c, f), log weights (c,), and steps taken."""

    w: FloatArray
    y: FloatArray
    log_weight: FloatArray
    steps: int


class Info(NamedTuple):
    """One step of all chains."""

    acceptance: float
    objective: float
    ending: Ending | None


def approximation(
    centre: FloatArray, covariance: FloatArray, positive: NDArray[np.int64], seed: int
) -> Approximation:
    """Bind a normal approximation (f,), (f, f) of the target."""
    others = np.setdiff1d(np.arange(centre.size), positive)
    order = np.concatenate([positive, others])
    factor = cholesky(covariance[np.ix_(order, order)], lower=True)
    return Approximation(centre, np.asarray(factor), order, positive.size, seed)


def _map(normal: Approximation, w: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Points T(w) of standard normals (k, f) and their log density, up to a constant."""
    z = w.copy()
    log_q = -0.5 * np.sum(w[:, normal.positive :] ** 2, axis=1)
    for i in range(normal.positive):
        # The i-th ordered coordinate, centre + sum over j <= i of L_ij z_j, must stay >= 0.
        before = normal.centre[normal.order[i]] + z[:, :i] @ normal.factor[i, :i]
        lowest = -before / normal.factor[i, i]
        log_tail = log_ndtr(-lowest)
        # The upper tail probability of w_i, shrunk to the part above `lowest`.
        z[:, i] = np.maximum(-ndtri_exp(log_ndtr(-w[:, i]) + log_tail), lowest)
        log_q += -0.5 * z[:, i] ** 2 - log_tail
    y = np.empty_like(w)
    y[:, normal.order] = normal.centre[normal.order] + z @ normal.factor.T
    cut = normal.order[: normal.positive]
    y[:, cut] = np.maximum(y[:, cut], 0.0)
    return y, log_q


def _weigh(target: LogDensity, y: FloatArray, log_q: FloatArray) -> FloatArray:
    log_p = target(y)
    return np.where(np.isfinite(log_p), log_p, -np.inf) - log_q


def init(target: LogDensity, normal: Approximation) -> State:
    """All chains at draws of the approximation."""
    rng = np.random.default_rng(np.random.SeedSequence(normal.seed, spawn_key=(0,)))
    w = rng.standard_normal((CHAINS, normal.centre.size))
    y, log_q = _map(normal, w)
    return State(w, y, _weigh(target, y, log_q), 0)


def step(target: LogDensity, normal: Approximation, state: State) -> tuple[State, Info]:
    """One Metropolis-Hastings step of every chain."""
    rng = np.random.default_rng(np.random.SeedSequence(normal.seed, spawn_key=(state.steps + 1,)))
    rho = RHO[state.steps % len(RHO)]
    w = rho * state.w + np.sqrt(1.0 - rho**2) * rng.standard_normal(state.w.shape)
    y, log_q = _map(normal, w)
    log_weight = _weigh(target, y, log_q)
    with np.errstate(invalid="ignore"):  # both impossible: infinity less infinity
        gain = log_weight - state.log_weight
    accepted = np.log(rng.uniform(size=CHAINS)) < gain
    accepted |= ~np.isfinite(state.log_weight) & np.isfinite(log_weight)
    new = State(
        np.where(accepted[:, None], w, state.w),
        np.where(accepted[:, None], y, state.y),
        np.where(accepted, log_weight, state.log_weight),
        state.steps + 1,
    )
    ending = None if np.any(np.isfinite(new.log_weight)) else Ending.NOT_FINITE
    return new, Info(float(accepted.mean()), -2.0 * float(np.max(new.log_weight)), ending)


def split_r_hat(draws: FloatArray) -> FloatArray:
    """Split R-hat (f,) of draws (n, c, f)."""
    half = draws.shape[0] // 2
    parts = np.concatenate([draws[:half], draws[half : 2 * half]], axis=1)
    within = parts.var(axis=0, ddof=1).mean(axis=0)
    between = half * parts.mean(axis=0).var(axis=0, ddof=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio = np.sqrt(((half - 1) / half * within + between / half) / within)
    return np.asarray(np.where(within > 0.0, ratio, 1.0))


def effective_sample_size(draws: FloatArray) -> FloatArray:
    """Effective number (f,) of draws (n, c, f): Geyer's initial positive sequence."""
    n, chains, f = draws.shape
    centred = draws - draws.mean(axis=(0, 1))
    size = 1 << (2 * n - 1).bit_length()
    spectrum = np.fft.rfft(centred, size, axis=0)
    autocovariance = np.fft.irfft(np.abs(spectrum) ** 2, size, axis=0)[:n].mean(axis=1) / n
    ess = np.empty(f)
    for j in range(f):
        if autocovariance[0, j] <= 0.0:
            ess[j] = n * chains
            continue
        rho = autocovariance[:, j] / autocovariance[0, j]
        pairs = rho[: 2 * (n // 2)].reshape(-1, 2).sum(axis=1)
        negative = np.flatnonzero(pairs < 0.0)
        stop = negative[0] if negative.size else pairs.size
        tau = max(2.0 * float(np.minimum.accumulate(pairs[:stop]).sum()) - 1.0, 1.0 / (n * chains))
        ess[j] = n * chains / tau
    return ess
