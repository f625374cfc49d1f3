"""Draws from the posterior of one crossing: weighted ones or, where those fail, chains."""

from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import log_ndtr

from pre_core.crossing import compliances, optimum, posterior
from pre_core.physics.torsion import NO_TORSION
from pre_core.search import approximation, crank_nicolson, importance, levenberg_marquardt
from pre_core.search.loop import Ending, Report, run
from pre_core.unknowns import TORSION, element_count, table

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
_BATCH_SHARE = 0.25
"""Weighted draws come in batches of this share of those that are asked for, in such numbers:"""
_FEWEST_BATCHES, _MOST_BATCHES = 4, 10
_TAME_BATCHES = 6
"""Weights whose tail is still too heavy by then are given up: the fit of few scatters."""
_LARGEST_PARETO_K = 0.7
_IMPROBABLE = 0.02
"""Odds below which torsion is left out of the draws: it changes no interval, and a chain that has
to find it now and then takes longer to agree."""
_WORTH = 1.0 / 3.0
"""Weighted draws are enough if they are worth this share of those that are asked for. It is more
than is asked of chains: what weights are worth is an estimate from the weights themselves."""


_Weighted = tuple[importance.Draws, importance.Smoothed]
"""Draws, and what they are worth."""


class Sampled(NamedTuple):
    """Draws (n, chains, f) in the coordinates of the posterior; `pareto_k` of weighted ones.

    Weighted ones are drawn again by their weights and dealt out; their `acceptance` is what each is
    worth.
    """

    draws: FloatArray
    r_hat: float
    ess: float
    acceptance: float
    evaluations: int
    ending: Ending
    pareto_k: float | None = None


def sample(
    found: optimum.Optimum,
    draws: int,
    seed: int,
    *,
    inflation: float = 1.0,
    report: Report = lambda stage, fraction: None,
) -> Sampled:
    """Draw from the posterior about its optimum, of noise `inflation` times what was declared.

    At least `draws` in all chains together; STEPS_EXHAUSTED if they do not agree. Torsion that is
    improbable is left out: zero in all draws.
    """
    if found.problem.mismatch.level_m3.any():
        return _sampled_on_two_roads(found, draws, seed, inflation)
    place = _improbable_torsion(found, inflation)
    if place is None:
        return _sampled_on_one_road(found, draws, seed, inflation, report)
    stiff = _sampled_on_one_road(without_torsion(found, place), draws, seed, inflation, report)
    return stiff._replace(draws=np.insert(stiff.draws, place, 0.0, axis=2))


def _improbable_torsion(found: optimum.Optimum, inflation: float) -> int | None:
    """Return the place in y of torsion that is hardly there, by the normal about the optimum."""
    problem = found.problem
    where = posterior.layout(problem)
    kept = np.flatnonzero(problem.priors.estimated)
    places = np.intersect1d(np.flatnonzero(kept == TORSION), where.half_normal)
    if places.size == 0:
        return None
    place = int(places[0])
    centre, covariance = optimum.normal_approximation(found)
    scale = inflation * np.sqrt(covariance[place, place])
    at = float(centre[place] / scale)
    # Mass above zero over the density at zero, as in `compliances`.
    log_above = np.log(scale * np.sqrt(2.0 * np.pi)) + log_ndtr(at) + 0.5 * at * at
    log_odds = float(posterior.log_odds_of_absence(problem, inflation)[place])
    return place if log_above - log_odds < np.log(_IMPROBABLE) else None


def without_torsion(found: optimum.Optimum, place: int) -> optimum.Optimum:
    """Return the optimum of the deck that does not twist, whose unknown was at `place` in y."""
    problem = found.problem
    priors = problem.priors
    estimated = priors.estimated.copy()
    estimated[TORSION] = False
    stiff = problem._replace(
        priors=priors._replace(estimated=estimated),
        crossing=problem.crossing._replace(torsion=NO_TORSION),
        noise_slope=np.delete(problem.noise_slope, place),
    )
    y = np.delete(found.state.y, place)
    state = levenberg_marquardt.begin(lambda at: posterior.all_rows(stiff, at), y)
    return found._replace(problem=stiff, state=state)


def _sampled_on_one_road(
    found: optimum.Optimum, draws: int, seed: int, inflation: float, report: Report
) -> Sampled:
    problem = found.problem
    mixed = _approximation(found, inflation, seed)

    def target(points: FloatArray) -> FloatArray:
        rows = posterior.all_rows(problem, points)
        return np.asarray(-0.5 / inflation**2 * np.sum(rows * rows, axis=1))

    where = posterior.layout(problem)
    delays = np.arange(where.delays.start, where.delays.stop)
    mixed = approximation.probed(target, mixed, delays)
    spent = approximation.probes(mixed, delays)
    weighted, mixed, drawn = _weighted(target, mixed, draws, report)
    spent += drawn
    if weighted is not None:
        return _dealt_out(*weighted, _told(problem), draws, seed, spent)
    return _by_chains(target, mixed, draws, _told(problem), spent, report)


def _approximation(found: optimum.Optimum, inflation: float, seed: int) -> approximation.Mixture:
    problem = found.problem
    centre, covariance = optimum.normal_approximation(found)
    return approximation.mixture(
        centre,
        inflation**2 * covariance,
        posterior.layout(problem).half_normal,
        optimum.bends(problem),
        seed,
        posterior.log_odds_of_absence(problem, inflation),
    )


def _weighted(
    target: approximation.LogDensity, mixed: approximation.Mixture, draws: int, report: Report
) -> tuple[_Weighted | None, approximation.Mixture, int]:
    """Weighted draws that are worth enough or none, the approximation, the evaluations.

    Where the first are not, the approximation is fitted to what they show, they are thrown away,
    and others are drawn.
    """
    first, worth = _worth_enough(target, mixed, draws, 0, report)
    if _is_enough(worth, draws):
        return (first, worth), mixed, first.log_weight.size
    fitted = approximation.learnt(mixed, first.part, first.v, first.log_weight)
    second, worth_now = _worth_enough(target, fitted, draws, _MOST_BATCHES, report)
    spent = first.log_weight.size + second.log_weight.size
    if _is_enough(worth_now, draws):
        return (second, worth_now), fitted, spent
    per_draw = worth.ess / first.log_weight.size, worth_now.ess / second.log_weight.size
    return None, fitted if per_draw[1] > per_draw[0] else mixed, spent


def _is_enough(worth: importance.Smoothed, draws: int) -> bool:
    return worth.pareto_k <= _LARGEST_PARETO_K and worth.ess >= _WORTH * draws


def _worth_enough(
    target: approximation.LogDensity,
    mixed: approximation.Mixture,
    draws: int,
    number: int,
    report: Report,
) -> _Weighted:
    """Weighted draws in batches from `number` on, until they are enough or will not be."""
    batches: list[importance.Draws] = []
    while True:
        report("weighting draws of the posterior", 0.5 + 0.02 * (number + len(batches)))
        count = round(_BATCH_SHARE * draws)
        batches.append(importance.draw(target, mixed, count, number + len(batches)))
        together = importance.Draws(*map(np.concatenate, zip(*batches, strict=True)))
        if len(batches) < _FEWEST_BATCHES:
            continue
        worth = importance.smoothed(together.log_weight)
        hopeless = worth.ess * _MOST_BATCHES / len(batches) < _WORTH * draws
        if worth.pareto_k > _LARGEST_PARETO_K and len(batches) >= _TAME_BATCHES:
            hopeless = True
        if _is_enough(worth, draws) or hopeless or len(batches) >= _MOST_BATCHES:
            return together, worth


def _dealt_out(
    weighted: importance.Draws,
    worth: importance.Smoothed,
    told: NDArray[np.int64],
    draws: int,
    seed: int,
    evaluations: int,
) -> Sampled:
    """Weighted draws, each as often as its weight says, as if chains had drawn them."""
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(1 << 22,)))
    count = -(-max(draws, weighted.log_weight.size) // crank_nicolson.CHAINS)
    chosen = importance.evenly(worth.weight, count * crank_nicolson.CHAINS, rng)
    dealt = weighted.y[chosen].reshape(count, crank_nicolson.CHAINS, -1)
    return Sampled(
        dealt,
        float(crank_nicolson.split_r_hat(dealt[:, :, told]).max()),
        worth.ess,
        worth.ess / weighted.log_weight.size,
        evaluations,
        Ending.STEPS_DONE,
        worth.pareto_k,
    )


def _by_chains(
    target: approximation.LogDensity,
    mixed: approximation.Mixture,
    draws: int,
    told: NDArray[np.int64],
    spent: int,
    report: Report,
) -> Sampled:
    """Chains that are run until they agree; STEPS_EXHAUSTED if they do not."""
    wanted = draws // crank_nicolson.CHAINS
    state, mixed, steps = _learnt(target, mixed, round(_LEARNING_SHARE * wanted), report)
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
    evaluations = spent + crank_nicolson.CHAINS * (1 + crank_nicolson.MOVES * steps)
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
    target: approximation.LogDensity, mixed: approximation.Mixture, count: int, report: Report
) -> tuple[crank_nicolson.State, approximation.Mixture, int]:
    """A state and an approximation that is accepted often enough, and the steps it took."""
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
        mixed = approximation.adapted(mixed, np.stack(seen[count // 3 :]))
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
