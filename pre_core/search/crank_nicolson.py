"""Markov chains on the posterior, steered by the normal approximation at its optimum.

With y = T(v), where T maps a standard normal v to the approximation, the chains move by

    v' = rho v + sqrt(1 - rho^2) xi,    xi standard normal,

which leaves the approximation itself invariant, and accept by what the posterior differs from it
(preconditioned Crank-Nicolson; Cotter et al. 2013). rho = 0 proposes anew and is accepted about
every third time; rho near one gets a chain away from where the approximation is too thin. A step is
one move of each kind. What is proposed anew does not depend on where the first move ends, so that
both are evaluated together. The second move proposes a part of the mixture, too, by its share, and
is accepted by the ratio of what the target and the proposal are there (Carlin and Chib 1995): how
often the chains are in a part is how likely it is. Many short chains start from draws of the
approximation; their agreement (split R-hat; Gelman et al., BDA 3, section 11.4) tells whether to
believe them.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pre_core.search.approximation import LogDensity, Mixture, mapped, weighed
from pre_core.search.loop import Ending

FloatArray = NDArray[np.float64]

CHAINS = 8
"""Split in halves they are sixteen, between which `split_r_hat` sees what does not mix."""
MOVES = 2
"""Each chain has so many in a step, and each costs one evaluation of the target."""
_RHO = 0.7
"""How much of where it was a chain keeps in a step's first move; in the second it keeps nothing."""


class State(NamedTuple):
    """Where the chains are: normals and points (c, f), log weights (c,), and steps taken."""

    v: FloatArray
    y: FloatArray
    part: NDArray[np.int64]
    log_weight: FloatArray
    steps: int


class Info(NamedTuple):
    """One step of all chains."""

    acceptance: float
    objective: float
    ending: Ending | None


def moved(target: LogDensity, before: Mixture, after: Mixture, state: State) -> State:
    """The same points as a state of another approximation with the same parts."""
    old, new = before.parts[0], after.parts[0]
    v = (old.shift + old.scale * state.v - new.shift) / new.scale
    y, log_q = mapped(after, state.part, v)
    return State(v, y, state.part, weighed(target, y, log_q), state.steps)


def _any_part(mixed: Mixture, rng: np.random.Generator) -> NDArray[np.int64]:
    shares = np.exp([part.log_share for part in mixed.parts])
    return rng.choice(len(mixed.parts), CHAINS, p=shares / shares.sum())


def init(target: LogDensity, mixed: Mixture) -> State:
    """All chains at draws of the approximation."""
    rng = np.random.default_rng(np.random.SeedSequence(mixed.seed, spawn_key=(0,)))
    v = rng.standard_normal((CHAINS, mixed.parts[0].centre.size))
    part = _any_part(mixed, rng)
    y, log_q = mapped(mixed, part, v)
    return State(v, y, part, weighed(target, y, log_q), 0)


def step(target: LogDensity, mixed: Mixture, state: State) -> tuple[State, Info]:
    """One step of every chain: a Metropolis-Hastings move near by, and one anywhere."""
    rng = np.random.default_rng(np.random.SeedSequence(mixed.seed, spawn_key=(state.steps + 1,)))
    drawn = rng.standard_normal((MOVES, *state.v.shape))
    drawn[0] = _RHO * state.v + np.sqrt(1.0 - _RHO**2) * drawn[0]
    v = drawn.reshape(MOVES * CHAINS, -1)
    part = np.concatenate([state.part, _any_part(mixed, rng)])
    y, log_q = mapped(mixed, part, v)
    log_weight = weighed(target, y, log_q)
    acceptance = 0.0
    for move in range(MOVES):
        proposed = slice(move * CHAINS, (move + 1) * CHAINS)
        proposal = State(v[proposed], y[proposed], part[proposed], log_weight[proposed], 0)
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
            np.where(accepted, proposal.part, state.part),
            np.where(accepted, proposal.log_weight, state.log_weight),
            state.steps,
        ),
        float(accepted.mean()),
    )


def split_r_hat(draws: FloatArray) -> FloatArray:
    """Split R-hat (f,) of draws (n, c, f): infinite for fewer than four draws a chain."""
    half = draws.shape[0] // 2
    if half < 2:
        return np.full(draws.shape[2], np.inf)
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
