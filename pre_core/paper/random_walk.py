"""The paper's search (section 3.1): particles that walk downhill at random.

A particle makes a random step if its J does not grow, and stays otherwise (paper eq. 23). The paper
calls it MCMC, but it does not sample a posterior, because acceptance is not probabilistic. The
spread of its particles is not an uncertainty: it follows from the width of the step. The search is
kept for comparison.

The paper does not print the distribution of the step. Here it is Gaussian with a standard deviation
of 7 % of the undamaged value, in all coordinates at once (derivation in studies/reproduction.md).
"""

from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np

from pre_core.arrays import FloatArray, IntArray
from pre_core.kernels.lanes import LANES
from pre_core.paper.residual import Workspace, objective_batch, workspace
from pre_core.paper.window import PaperWindow
from pre_core.parameters import D_1
from pre_core.search.loop import Termination

PARTICLES = 500
STEPS = 600
PRIOR_LOW, PRIOR_HIGH = 0.8, 1.2
STEP_RATIO = 0.07


class RandomWalkProblem(NamedTuple):
    """The constants of a search: data, undamaged values, free indices, a workspace per thread."""

    window: PaperWindow
    nominal: FloatArray  # (p,)
    free: IntArray  # (f,)
    step_ratio: float
    seed: int
    workspaces: tuple[Workspace, ...]


class RandomWalkState(NamedTuple):
    """The particles (k, f) as ratios to the undamaged values, their J (k,), and the steps taken."""

    ratios: FloatArray
    objective: FloatArray
    steps: int


class RandomWalkInfo(NamedTuple):
    """Statistics of one step."""

    objective: float  # the smallest J of all particles
    acceptance: float
    ending: Termination | None


def problem(
    window: PaperWindow,
    nominal: FloatArray,
    free: IntArray,
    seed: int,
    *,
    step_ratio: float = STEP_RATIO,
    threads: int = 2,
) -> RandomWalkProblem:
    """Bind data, values (p,) and free indices (f,); threads do not affect the results."""
    return RandomWalkProblem(
        window, nominal, free, step_ratio, seed, tuple(workspace(window) for _ in range(threads))
    )


def _random(seed: int, count: int) -> np.random.Generator:
    """Return the random numbers of one step, which follow from the seed and the step alone."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(count,)))


def _evaluate(bound: RandomWalkProblem, ratios: FloatArray, limit: FloatArray) -> FloatArray:
    """Return J (k,) of particles; exact wherever it does not exceed `limit` (k,)."""
    theta = np.repeat(bound.nominal[None, :], ratios.shape[0], axis=0)
    theta[:, bound.free] *= ratios
    physical = np.all(theta[:, bound.free] > 0.0, axis=1)
    physical &= theta[:, D_1] < bound.window.wheelbase_m
    total = np.full(ratios.shape[0], np.inf)
    candidates = np.flatnonzero(physical)
    if candidates.size == 0:
        return total
    blocks = (candidates.size + LANES - 1) // LANES
    bounds = np.linspace(0, blocks, len(bound.workspaces) + 1).astype(int) * LANES

    def part(i: int) -> None:
        chosen = candidates[bounds[i] : bounds[i + 1]]
        if chosen.size:
            out = np.empty(chosen.size)
            objective_batch(bound.window, bound.workspaces[i], theta[chosen], limit[chosen], out)
            total[chosen] = out

    with ThreadPoolExecutor(len(bound.workspaces)) as pool:
        list(pool.map(part, range(len(bound.workspaces))))
    return total


def init(bound: RandomWalkProblem, particles: int = PARTICLES) -> RandomWalkState:
    """Return particles uniform between 0.8 and 1.2 of the undamaged values."""
    rng = _random(bound.seed, 0)
    ratios = rng.uniform(PRIOR_LOW, PRIOR_HIGH, (particles, bound.free.size))
    return RandomWalkState(ratios, _evaluate(bound, ratios, np.full(particles, np.inf)), 0)


def step(
    bound: RandomWalkProblem, state: RandomWalkState
) -> tuple[RandomWalkState, RandomWalkInfo]:
    """Propose one random step for every particle and accept those that do not increase J."""
    rng = _random(bound.seed, state.steps + 1)
    proposal = state.ratios + bound.step_ratio * rng.standard_normal(state.ratios.shape)
    objective = _evaluate(bound, proposal, state.objective)
    accepted = np.isfinite(objective) & (objective <= state.objective)
    ratios = np.where(accepted[:, None], proposal, state.ratios)
    kept = np.where(accepted, objective, state.objective)
    best = float(kept.min())
    ending = None if np.isfinite(best) else Termination.NOT_FINITE
    return RandomWalkState(ratios, kept, state.steps + 1), RandomWalkInfo(
        best, float(accepted.mean()), ending
    )
