"""Markov chains on the posterior, steered by the normal approximation at its optimum.

The posterior of one crossing is close to normal in sixty dimensions. With y = T(v), where T maps a
standard normal v to the approximation, the chains move by

    v' = rho v + sqrt(1 - rho^2) xi,    xi standard normal,

which leaves the approximation itself invariant, and accept by what the posterior differs from it
(preconditioned Crank-Nicolson; Cotter et al. 2013). rho = 0 proposes anew and is accepted about
every third time; rho near one gets a chain away from where the approximation is too thin. A step is
one move of each kind. What is proposed anew does not depend on where the first move ends, so that
both are evaluated together. Many short chains start from draws of the approximation; their
agreement (split R-hat; Gelman et al., BDA 3, section 11.4) tells whether to believe them.

A coordinate may be bent: where y is the logarithm of a stiffness the data depend on its reciprocal,
and it is w = (1 - exp(-b (y - centre)))/b, not y, in which the posterior is nearly normal.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cholesky
from scipy.special import log_ndtr, ndtri_exp

from pre_core.search.loop import Ending

FloatArray = NDArray[np.float64]

CHAINS = 8
MOVES = 2
"""Of every chain in a step: each costs one evaluation of the target."""
_RHO = 0.7
"""Of a step's first move; that of the second is zero."""
_SMALLEST_SHIFT = 0.35
_SMALLEST_STRETCH = 0.2
_STRAIGHTEST = 1e-9

LogDensity = Callable[[FloatArray], FloatArray]
"""Logarithm of the target at points (k, f), up to a constant; minus infinity where impossible."""


class Approximation(NamedTuple):
    """A normal with mean `centre`, cut off where the coordinates `positive` would be negative.

    In the order `order` (the positive ones first), the bent coordinates of y - centre are L z,
    where z is w = shift + scale v with standard normal v, those of the positive coordinates cut off
    one after the other.
    """

    centre: FloatArray  # (f,)
    factor: FloatArray  # (f, f) lower triangle L
    order: NDArray[np.int64]  # (f,)
    positive: int
    shift: FloatArray  # (f,) of w; zero until the approximation has been adapted
    scale: FloatArray  # (f,)
    bend: FloatArray  # (f,) zero: straight; of the positive ones it must be
    seed: int


class State(NamedTuple):
    """Where the chains are: normals and points (c, f), log weights (c,), and steps taken."""

    v: FloatArray
    y: FloatArray
    log_weight: FloatArray
    steps: int


class Info(NamedTuple):
    """One step of all chains."""

    acceptance: float
    objective: float
    ending: Ending | None


def approximation(
    centre: FloatArray,
    covariance: FloatArray,
    positive: NDArray[np.int64],
    bend: FloatArray,
    seed: int,
) -> Approximation:
    """Bind a normal approximation (f,), (f, f) of the target; `bend` (f,) as above."""
    others = np.setdiff1d(np.arange(centre.size), positive)
    order = np.concatenate([positive, others])
    factor = cholesky(covariance[np.ix_(order, order)], lower=True)
    f = centre.size
    return Approximation(
        centre, np.asarray(factor), order, positive.size, np.zeros(f), np.ones(f), bend, seed
    )


def adapted(normal: Approximation, v: FloatArray) -> Approximation:
    """The approximation moved and stretched, coordinate by coordinate, to fit draws v (n, c, f).

    A posterior that leans to one side has its mean elsewhere than its optimum; draws tell where.
    Chains must be begun anew with it (`moved`), and the draws it was made of be thrown away.
    """
    mean, spread = v.mean(axis=(0, 1)), np.clip(v.std(axis=(0, 1)), 0.7, 1.6)
    # Few draws in many coordinates: only what stands out of their own scatter is taken over.
    mean = np.where(np.abs(mean) > _SMALLEST_SHIFT, mean, 0.0)
    spread = np.where(np.abs(spread - 1.0) > _SMALLEST_STRETCH, spread, 1.0)
    return normal._replace(shift=normal.shift + normal.scale * mean, scale=normal.scale * spread)


def moved(target: LogDensity, before: Approximation, after: Approximation, state: State) -> State:
    """The same points as a state of another approximation."""
    v = (before.shift + before.scale * state.v - after.shift) / after.scale
    y, log_q = _map(after, v)
    return State(v, y, _weigh(target, y, log_q), state.steps)


def _map(normal: Approximation, v: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Points of standard normals v (k, f) and their log density, up to a constant."""
    w = normal.shift + normal.scale * v
    z = w.copy()
    # The density of z times that of v over that of w; dw/dv is constant.
    log_q = 0.5 * np.sum(w[:, : normal.positive] ** 2, axis=1) - 0.5 * np.sum(v**2, axis=1)
    for i in range(normal.positive):
        # The i-th ordered coordinate, centre + sum over j <= i of L_ij z_j, must stay >= 0.
        before = normal.centre[normal.order[i]] + z[:, :i] @ normal.factor[i, :i]
        lowest = -before / normal.factor[i, i]
        log_tail = log_ndtr(-lowest)
        # The upper tail probability of w_i, shrunk to the part above `lowest`.
        z[:, i] = np.maximum(-ndtri_exp(log_ndtr(-w[:, i]) + log_tail), lowest)
        log_q += -0.5 * z[:, i] ** 2 - log_tail
    y = np.empty_like(w)
    y[:, normal.order] = z @ normal.factor.T
    for k in np.flatnonzero(normal.bend):
        inner = 1.0 - normal.bend[k] * y[:, k]
        impossible = inner <= _STRAIGHTEST  # beyond the end of the bent coordinate
        inner = np.where(impossible, _STRAIGHTEST, inner)
        y[:, k] = -np.log(inner) / normal.bend[k]
        log_q += np.where(impossible, np.inf, np.log(inner))
    y += normal.centre
    cut = normal.order[: normal.positive]
    y[:, cut] = np.maximum(y[:, cut], 0.0)
    return y, log_q


def _weigh(target: LogDensity, y: FloatArray, log_q: FloatArray) -> FloatArray:
    log_p = target(y)
    return np.where(np.isfinite(log_p), log_p, -np.inf) - log_q


def init(target: LogDensity, normal: Approximation) -> State:
    """All chains at draws of the approximation."""
    rng = np.random.default_rng(np.random.SeedSequence(normal.seed, spawn_key=(0,)))
    v = rng.standard_normal((CHAINS, normal.centre.size))
    y, log_q = _map(normal, v)
    return State(v, y, _weigh(target, y, log_q), 0)


def step(target: LogDensity, normal: Approximation, state: State) -> tuple[State, Info]:
    """One step of every chain: a Metropolis-Hastings move near by, and one anywhere."""
    rng = np.random.default_rng(np.random.SeedSequence(normal.seed, spawn_key=(state.steps + 1,)))
    drawn = rng.standard_normal((MOVES, *state.v.shape))
    drawn[0] = _RHO * state.v + np.sqrt(1.0 - _RHO**2) * drawn[0]
    v = drawn.reshape(MOVES * CHAINS, -1)
    y, log_q = _map(normal, v)
    log_weight = _weigh(target, y, log_q)
    acceptance = 0.0
    for move in range(MOVES):
        proposed = slice(move * CHAINS, (move + 1) * CHAINS)
        proposal = State(v[proposed], y[proposed], log_weight[proposed], state.steps)
        state, share = _accepted(state, proposal, rng.uniform(size=CHAINS))
        acceptance += share / MOVES
    ending = None if np.any(np.isfinite(state.log_weight)) else Ending.NOT_FINITE
    return (
        state._replace(steps=state.steps + 1),
        Info(acceptance, -2.0 * float(np.max(state.log_weight)), ending),
    )


def _accepted(state: State, proposal: State, uniform: FloatArray) -> tuple[State, float]:
    """Each chain at its proposal if that is accepted; the share of them that are."""
    with np.errstate(invalid="ignore"):  # both impossible: infinity less infinity
        gain = proposal.log_weight - state.log_weight
    accepted = np.log(uniform) < gain
    accepted |= ~np.isfinite(state.log_weight) & np.isfinite(proposal.log_weight)
    return (
        State(
            np.where(accepted[:, None], proposal.v, state.v),
            np.where(accepted[:, None], proposal.y, state.y),
            np.where(accepted, proposal.log_weight, state.log_weight),
            state.steps,
        ),
        float(accepted.mean()),
    )


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
