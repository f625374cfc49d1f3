"""Draws from the posterior of one crossing, by chains that run until they agree."""

from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pre_core.crossing import compliances, optimum, posterior
from pre_core.search import crank_nicolson
from pre_core.search.loop import Ending, Report, run
from pre_core.unknowns import element_count, table

FloatArray = NDArray[np.float64]

LARGEST_R_HAT = 1.05
SMALLEST_ESS = 100.0
"""Chains agree if no unknown that is told to users is beyond these."""
_LEARNING_SHARE = 0.4
"""Each stage of learning takes this share of the draws that are asked for."""
_LEARNING_STAGES = 3
"""So many stages at most; one with chains that are accepted often enough is the last."""
_WELL_ACCEPTED = 0.3
"""From here on the approximation is good enough, and nothing more is learnt."""
_MOST_RUNS = 14
"""So many times the draws that are asked for may be drawn before the chains are given up."""


class Sampled(NamedTuple):
    """What the chains found: draws (n, chains, f) in the coordinates of the posterior."""

    draws: FloatArray
    r_hat: float
    ess: float
    acceptance: float
    evaluations: int
    ending: Ending


def sample(
    found: optimum.Optimum,
    draws: int,
    seed: int,
    *,
    inflation: float = 1.0,
    report: Report = lambda stage, fraction: None,
) -> Sampled:
    """Draw from the posterior about its optimum, of noise `inflation` times what was declared.

    At least `draws` in all chains together; STEPS_EXHAUSTED if they do not agree.
    """
    problem = found.problem
    if problem.mismatch.level_m3.any():
        return _sampled_on_two_roads(found, draws, seed, inflation)
    where = posterior.layout(problem)
    centre, covariance = optimum.normal_approximation(found)
    mixed = crank_nicolson.mixture(
        centre,
        inflation**2 * covariance,
        where.half_normal,
        optimum.bends(problem),
        seed,
        posterior.log_odds_of_absence(problem, inflation),
    )

    def target(points: FloatArray) -> FloatArray:
        rows = posterior.all_rows(problem, points)
        return np.asarray(-0.5 / inflation**2 * np.sum(rows * rows, axis=1))

    wanted = draws // crank_nicolson.CHAINS
    state, mixed, steps = _learnt(target, mixed, round(_LEARNING_SHARE * wanted), report)
    told = _told(problem)
    kept: list[FloatArray] = []
    acceptance: list[float] = []
    r_hat, ess, ending = np.inf, 0.0, Ending.STEPS_EXHAUSTED
    for number in range(_MOST_RUNS):

        def step(
            before: crank_nicolson.State,
        ) -> tuple[crank_nicolson.State, crank_nicolson.Info]:
            after, info = crank_nicolson.step(target, mixed, before)
            kept.append(after.y)
            acceptance.append(info.acceptance)
            return after, info

        def tell(count: int, info: crank_nicolson.Info, number: int = number) -> None:
            done = (number + count / wanted) / (number + 1)
            report("sampling the posterior", 0.7 + 0.3 * done)

        state = run(partial(_begun, state), step, wanted, progress=tell).state
        steps += wanted
        r_hat, ess, ending = _agreement(np.stack(kept)[:, :, told])
        if ending is Ending.STEPS_DONE:
            break
    evaluations = crank_nicolson.CHAINS * (1 + crank_nicolson.MOVES * steps)
    return Sampled(np.stack(kept), r_hat, ess, float(np.mean(acceptance)), evaluations, ending)


def _sampled_on_two_roads(
    found: optimum.Optimum, draws: int, seed: int, inflation: float
) -> Sampled:
    """Draws where the axles' roads differ and elements are hardly known: those of `compliances`.

    The rows are not evaluated again. The truck's unknowns are known by its sensors alone, through
    rows so exact that their curvature keeps chains from moving; what it makes of EI is far below
    what the mismatch leaves open.
    """
    near = compliances.compliances(found, inflation)
    told = _told(found.problem)
    kept: list[FloatArray] = []
    r_hat, ess, ending = np.inf, 0.0, Ending.STEPS_EXHAUSTED
    for number in range(_MOST_RUNS):
        first = number * crank_nicolson.CHAINS
        streams = range(first, first + crank_nicolson.CHAINS)
        wanted = draws // crank_nicolson.CHAINS
        kept.append(
            np.stack([compliances.draws(near, wanted, seed, one) for one in streams], axis=1)
        )
        r_hat, ess, ending = _agreement(np.concatenate(kept)[:, :, told])
        if ending is Ending.STEPS_DONE:
            break
    return Sampled(np.concatenate(kept), r_hat, ess, 1.0, 0, ending)


def _agreement(draws: FloatArray) -> tuple[float, float, Ending]:
    """R-hat, effective sample size and what they say of draws (n, chains, unknowns)."""
    r_hat = float(crank_nicolson.split_r_hat(draws).max())
    ess = float(crank_nicolson.effective_sample_size(draws).min())
    agrees = r_hat < LARGEST_R_HAT and ess > SMALLEST_ESS
    return r_hat, ess, Ending.STEPS_DONE if agrees else Ending.STEPS_EXHAUSTED


def _begun(state: crank_nicolson.State) -> crank_nicolson.State:
    return state


def _learnt(
    target: crank_nicolson.LogDensity, mixed: crank_nicolson.Mixture, count: int, report: Report
) -> tuple[crank_nicolson.State, crank_nicolson.Mixture, int]:
    """A state and an approximation that is accepted often enough, and the steps it took."""
    mixed = crank_nicolson.probed(target, mixed)
    state = crank_nicolson.init(target, mixed)
    before, best, steps = mixed, 0.0, 0
    for stage in range(_LEARNING_STAGES):
        seen, acceptance = [], []
        for number in range(count):
            report("learning the posterior's shape", 0.5 + 0.1 * (stage + number / count))
            state, info = crank_nicolson.step(target, mixed, state)
            seen.append(state.v)
            acceptance.append(info.acceptance)
        steps += count
        accepted = float(np.mean(acceptance))
        if accepted < best:  # few draws teach nonsense now and then
            return crank_nicolson.moved(target, mixed, before, state), before, steps
        if accepted > _WELL_ACCEPTED or stage == _LEARNING_STAGES - 1:
            break
        best, before = accepted, mixed
        mixed = crank_nicolson.adapted(mixed, np.stack(seen[count // 3 :]))
        state = crank_nicolson.moved(target, before, mixed, state)
    return state, mixed, steps


def _told(problem: posterior.Problem) -> NDArray[np.int64]:
    """Places in y of the unknowns that must have converged.

    Not of those that may be nothing at all: a chain that seldom finds a spring says by that how
    unlikely it is, and the rest does not depend on it.
    """
    rows = table(element_count(problem.priors.theta))
    kept = [rows[i] for i in np.flatnonzero(problem.priors.estimated)]
    return np.flatnonzero([not row.may_be_zero for row in kept])
