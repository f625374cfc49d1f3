"""A Markov chain on the posterior: independence proposals from the curvature at its optimum.

The posterior of one crossing is close to Gaussian, so that draws from a slightly wider Student t
with the Gauss-Newton covariance are accepted about every second time, in sixty dimensions where a
random walk would need a hundred times the evaluations (Tierney 1994, section 2.3.1). Proposals do
not depend on the state: a whole block is evaluated at once. Four chains start from draws of the
proposal, and tell by their agreement (split R-hat; Gelman et al., BDA 3, section 11.4) whether to
believe them.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from pre_core.search import Ending

FloatArray = NDArray[np.float64]

CHAINS = 4
BLOCK = 25
DEGREES_OF_FREEDOM = 60.0
"""Of the proposal: heavier tails than the target's, yet not so heavy that most draws are lost."""

LogDensity = Callable[[FloatArray], FloatArray]
"""Logarithm of the target at points (k, f), up to a constant; minus infinity where impossible."""


class Proposal(NamedTuple):
    """A Student t about `centre` with precision R'R, restricted to `positive` coordinates >= 0."""

    centre: FloatArray  # (f,)
    root: FloatArray  # (f, f) upper triangle R
    positive: NDArray[np.int64]
    seed: int


class State(NamedTuple):
    """Where the chains are: points (c, f), log target less log proposal (c,), and blocks taken."""

    y: FloatArray
    log_weight: FloatArray
    blocks: int


class Info(NamedTuple):
    """One block: the draws (block, c, f), and how many proposals were accepted."""

    draws: FloatArray
    acceptance: float
    objective: float
    ending: Ending | None


def _draw(proposal: Proposal, count: int, stream: int) -> tuple[FloatArray, FloatArray]:
    """`count` draws and the logarithm of their density up to a constant."""
    rng = np.random.default_rng(np.random.SeedSequence(proposal.seed, spawn_key=(stream,)))
    f = proposal.centre.size
    nu = DEGREES_OF_FREEDOM
    kept: list[FloatArray] = []
    squares: list[FloatArray] = []
    missing = count
    for _ in range(1000):
        z = rng.standard_normal((2 * missing + 16, f))
        scale = np.sqrt(nu / rng.chisquare(nu, z.shape[0]))
        white = z * scale[:, None]
        y = proposal.centre + solve_triangular(proposal.root, white.T).T
        allowed = np.all(y[:, proposal.positive] >= 0.0, axis=1)
        kept.append(y[allowed][:missing])
        squares.append(np.sum(white[allowed][:missing] ** 2, axis=1))
        missing -= kept[-1].shape[0]
        if missing == 0:
            break
    y = np.concatenate(kept)
    r2 = np.concatenate(squares)
    return y, -0.5 * (nu + f) * np.log1p(r2 / nu)


def init(target: LogDensity, proposal: Proposal) -> State:
    """Four chains at draws of the proposal."""
    y, log_q = _draw(proposal, CHAINS, 0)
    return State(y, target(y) - log_q, 0)


def step(target: LogDensity, proposal: Proposal, state: State) -> tuple[State, Info]:
    """One block of Metropolis-Hastings steps of every chain."""
    y, log_q = _draw(proposal, BLOCK * CHAINS, 2 * state.blocks + 1)
    if y.shape[0] < BLOCK * CHAINS:
        return state, Info(np.empty((0, *state.y.shape)), 0.0, np.inf, Ending.NOT_FINITE)
    log_p = target(y)
    log_weight = np.where(np.isfinite(log_p), log_p, -np.inf) - log_q
    rng = np.random.default_rng(
        np.random.SeedSequence(proposal.seed, spawn_key=(2 * state.blocks + 2,))
    )
    uniform = np.log(rng.uniform(size=(BLOCK, CHAINS)))
    now, weight = state.y.copy(), state.log_weight.copy()
    draws = np.empty((BLOCK, CHAINS, now.shape[1]))
    accepted = 0
    for n in range(BLOCK):
        for c in range(CHAINS):
            candidate = n * CHAINS + c
            gain = log_weight[candidate] - weight[c]
            if np.isnan(weight[c]) or uniform[n, c] < gain:
                now[c], weight[c] = y[candidate], log_weight[candidate]
                accepted += 1
        draws[n] = now
    ending = None if np.any(np.isfinite(weight)) else Ending.NOT_FINITE
    best = -2.0 * float(np.max(log_p))
    info = Info(draws, accepted / (BLOCK * CHAINS), best, ending)
    return State(now, weight, state.blocks + 1), info


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
