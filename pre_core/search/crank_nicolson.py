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

A coordinate may be absent: part of the target lies on it being exactly zero, as where a bridge has
no spring at a support. The target is then a mixture over which of them are, every part with its own
density and its own approximation, that of the others given that these are zero. The second move
proposes a part, too, by the share that the approximations give it, and is accepted by the ratio of
what the target and the proposal are there (Carlin and Chib 1995): how often the chains are in a
part is how likely it is.

A coordinate may be bent: where y is the logarithm of a stiffness the data depend on its reciprocal,
and it is w = (1 - exp(-b (y - centre)))/b, not y, in which the posterior is nearly normal.
"""

from collections.abc import Callable
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cholesky
from scipy.special import log_ndtr, ndtri_exp

from pre_core.search.loop import Ending

FloatArray = NDArray[np.float64]

CHAINS = 8
"""Split in halves they are sixteen, between which `split_r_hat` sees what does not mix."""
MOVES = 2
"""Each chain has so many in a step, and each costs one evaluation of the target."""
_RHO = 0.7
"""How much of where it was a chain keeps in a step's first move; in the second it keeps nothing."""
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


def probed(target: LogDensity, mixed: Mixture) -> Mixture:
    """The approximation moved and stretched to fit the target along each of its own directions.

    Curvature at the optimum says little of a posterior that is flatter or steeper further away: the
    target is looked at 1.5 standard deviations to either side, and twice and four times as far
    where that is still within one standard deviation of what is seen. What is never negative stays.
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
    return mixed._replace(parts=tuple(p._replace(shift=shift, scale=scale) for p in mixed.parts))


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
    y, log_q = _map(mixed, np.zeros(v.shape[0], dtype=np.int64), v)
    log_p = _weigh(target, y, log_q) - 0.5 * np.sum(v**2, axis=1)
    return log_p[:d], log_p[d:-1], float(log_p[-1])


def moved(target: LogDensity, before: Mixture, after: Mixture, state: State) -> State:
    """The same points as a state of another approximation with the same parts."""
    old, new = before.parts[0], after.parts[0]
    v = (old.shift + old.scale * state.v - new.shift) / new.scale
    y, log_q = _map(after, state.part, v)
    return State(v, y, state.part, _weigh(target, y, log_q), state.steps)


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


def _map(mixed: Mixture, which: NDArray[np.int64], v: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The same for points (k, f) in the parts `which` (k,)."""
    y, log_q = np.empty_like(v), np.empty(v.shape[0])
    for i in np.unique(which):
        there = which == i
        y[there], log_q[there] = _map_part(mixed.parts[i], v[there])
    return y, log_q


def _weigh(target: LogDensity, y: FloatArray, log_q: FloatArray) -> FloatArray:
    log_p = target(y)
    return np.where(np.isfinite(log_p), log_p, -np.inf) - log_q


def _any_part(mixed: Mixture, rng: np.random.Generator) -> NDArray[np.int64]:
    shares = np.exp([part.log_share for part in mixed.parts])
    return rng.choice(len(mixed.parts), CHAINS, p=shares / shares.sum())


def init(target: LogDensity, mixed: Mixture) -> State:
    """All chains at draws of the approximation."""
    rng = np.random.default_rng(np.random.SeedSequence(mixed.seed, spawn_key=(0,)))
    v = rng.standard_normal((CHAINS, mixed.parts[0].centre.size))
    part = _any_part(mixed, rng)
    y, log_q = _map(mixed, part, v)
    return State(v, y, part, _weigh(target, y, log_q), 0)


def step(target: LogDensity, mixed: Mixture, state: State) -> tuple[State, Info]:
    """One step of every chain: a Metropolis-Hastings move near by, and one anywhere."""
    rng = np.random.default_rng(np.random.SeedSequence(mixed.seed, spawn_key=(state.steps + 1,)))
    drawn = rng.standard_normal((MOVES, *state.v.shape))
    drawn[0] = _RHO * state.v + np.sqrt(1.0 - _RHO**2) * drawn[0]
    v = drawn.reshape(MOVES * CHAINS, -1)
    part = np.concatenate([state.part, _any_part(mixed, rng)])
    y, log_q = _map(mixed, part, v)
    log_weight = _weigh(target, y, log_q)
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
