"""Posterior draws of one crossing by adaptive importance sampling.

Draws of a cheap density near the posterior (`surrogate`) are weighted by the posterior, and refine
that density for the next draws. All batches are weighted as draws of one mixture density.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import log_ndtr

from pre_core.arrays import FloatArray
from pre_core.crossing import compliances, posterior, surrogate
from pre_core.crossing.fit import Optimum, normal_approximation
from pre_core.parameters import RHO_A, TORSION
from pre_core.physics.torsion import NO_TORSION
from pre_core.search import convergence, importance, levenberg_marquardt
from pre_core.search.loop import Report, Termination

LogDensity = Callable[[FloatArray], FloatArray]
"""Logarithm of the posterior (k,) at points (k, f), up to a constant."""

_LARGEST_R_HAT = 1.05
"""Convergence limit of R-hat of rigidities and mass."""
_MIN_EFFECTIVE_SHARE = 1.0 / 3.0
"""Required effective size of the draws, relative to the requested ones."""
_BATCH_SHARE = 1.0 / 3.0
"""Size of a batch of weighted draws, relative to the requested ones."""
_UNWEIGHTED_BATCHES = 2
"""Number of first batches whose refinement ignores the weights: their draws are too far from the
posterior for informative weights."""
_MAX_BATCHES = 25
_MAX_RUNS = 14
"""Limit of draws with mismatch, relative to the requested ones."""
_LARGEST_PARETO_K = 0.7
_NEGLIGIBLE_ODDS = 0.02
"""Odds below which torsion is omitted from the draws: it changes no interval and costs draws."""
_MAX_POINTS = 100
"""Number of points evaluated together: their residuals take some megabytes."""


class PosteriorDraws(NamedTuple):
    """Draws (n, chains, f) in the coordinates of the posterior, with their diagnostics.

    Weighted draws are resampled by their weights into chains; their `acceptance` is the relative
    effective sample size.
    """

    draws: FloatArray
    r_hat: float
    ess: float
    acceptance: float
    evaluations: int
    ending: Termination
    pareto_k: float | None = None


def sample(
    found: Optimum,
    draws: int,
    seed: int,
    *,
    inflation: float = 1.0,
    report: Report = lambda stage, fraction: None,
) -> PosteriorDraws:
    """Draw from the posterior about its optimum, for noise `inflation` times the declared one.

    Return at least `draws` in all chains together; it ends with STEPS_EXHAUSTED if not converged.
    Improbable torsion is zero in all draws.
    """
    if found.problem.mismatch.level_m3.any():
        return _mismatch_draws(found, draws, seed, inflation)
    place = _improbable_torsion(found, inflation)
    if place is None:
        return _single_profile_draws(found, draws, seed, inflation, report)
    stiff = _single_profile_draws(without_torsion(found, place), draws, seed, inflation, report)
    return stiff._replace(draws=np.insert(stiff.draws, place, 0.0, axis=2))


def _improbable_torsion(found: Optimum, inflation: float) -> int | None:
    """Return the index in y of improbable torsion, by the normal about the optimum; else None."""
    problem = found.problem
    where = posterior.layout(problem)
    kept = np.flatnonzero(problem.priors.estimated)
    places = np.intersect1d(np.flatnonzero(kept == TORSION), where.half_normal)
    if places.size == 0:
        return None
    place = int(places[0])
    centre, covariance = normal_approximation(found)
    scale = inflation * np.sqrt(covariance[place, place])
    at = float(centre[place] / scale)
    # Mass above zero over the density at zero, as in `compliances`.
    log_above = np.log(scale * np.sqrt(2.0 * np.pi)) + log_ndtr(at) + 0.5 * at * at
    log_odds = float(posterior.log_odds_of_absence(problem, inflation)[place])
    return place if log_above - log_odds < np.log(_NEGLIGIBLE_ODDS) else None


def without_torsion(found: Optimum, place: int) -> Optimum:
    """Return the optimum without its torsion coordinate `place`, not refitted."""
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
    state = levenberg_marquardt.initial_state(lambda at: posterior.all_rows(stiff, at), y)
    return found._replace(problem=stiff, state=state)


def _single_profile_draws(
    found: Optimum, draws: int, seed: int, inflation: float, report: Report
) -> PosteriorDraws:
    problem = found.problem

    def target(points: FloatArray) -> FloatArray:
        rows = posterior.all_rows(problem, points)
        return np.asarray(-0.5 / inflation**2 * np.sum(rows * rows, axis=1))

    coordinates = surrogate.coordinates(found, inflation)
    first = surrogate.gauss_newton_surrogate(found, coordinates)
    weighted = _importance_draws(target, coordinates, first, found.state.y, draws, seed, report)
    return _resample_to_chains(weighted, _monitored_indices(problem), draws, seed)


class _WeightedDraws(NamedTuple):
    """Points y (k, f) and their smoothed weights."""

    y: FloatArray
    worth: importance.SmoothedWeights


def _importance_draws(
    target: LogDensity,
    coordinates: surrogate.SurrogateCoordinates,
    now: surrogate.Surrogate,
    start: FloatArray,
    draws: int,
    seed: int,
    report: Report,
) -> _WeightedDraws:
    """Return weighted draws in batches until they suffice, or all of `_MAX_BATCHES`.

    Each batch is of a surrogate, `now` at first, that is refined by the draws so far; its chains
    start about `start` (f,). All draws are weighted as of the mixture of the surrogates.
    """
    centre = surrogate.transform(coordinates, start)
    count = convergence.CHAINS * -(-round(_BATCH_SHARE * draws) // convergence.CHAINS)
    used: list[surrogate.Surrogate] = []
    y, x = np.empty((0, centre.size)), np.empty((0, centre.size))
    log_target = np.empty(0)
    while True:
        report("weighting draws of the posterior", 0.5 + 0.02 * len(used))
        new = surrogate.draw(now, coordinates, centre, count, seed, len(used))
        used.append(now)
        log_posterior = _in_parts(target, new)
        y, x = np.concatenate([y, new]), np.concatenate([x, surrogate.transform(coordinates, new)])
        log_target = np.concatenate(
            [log_target, log_posterior - surrogate.log_prior(coordinates, new)]
        )
        log_density = np.stack([surrogate.log_likelihood(one, x) for one in used], axis=1)
        counts = np.full(len(used), count)
        worth = importance.pareto_smooth(
            importance.mixture_log_weights(log_target, log_density, counts)
        )
        if _is_enough(worth, draws) or len(used) == _MAX_BATCHES:
            return _WeightedDraws(y, worth)
        now = surrogate.refine(
            now, coordinates, x, log_target, count, is_weighted=len(used) > _UNWEIGHTED_BATCHES
        )


def _in_parts(target: LogDensity, y: FloatArray) -> FloatArray:
    """Return the target (k,) at y (k, f), minus infinity where it is not finite."""
    found = np.concatenate(
        [target(y[i : i + _MAX_POINTS]) for i in range(0, y.shape[0], _MAX_POINTS)]
    )
    return np.where(np.isfinite(found), found, -np.inf)


def _is_enough(worth: importance.SmoothedWeights, draws: int) -> bool:
    return worth.pareto_k <= _LARGEST_PARETO_K and worth.ess >= _MIN_EFFECTIVE_SHARE * draws


def _resample_to_chains(
    weighted: _WeightedDraws, monitored: NDArray[np.int64], draws: int, seed: int
) -> PosteriorDraws:
    """Return weighted draws resampled by their weights, in the form of chains."""
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(1 << 22,)))
    y, worth = weighted
    count = -(-max(draws, y.shape[0]) // convergence.CHAINS)
    chosen = importance.systematic_resample(worth.weight, count * convergence.CHAINS, rng)
    dealt = y[chosen].reshape(count, convergence.CHAINS, -1)
    return PosteriorDraws(
        dealt,
        float(convergence.split_r_hat(dealt[:, :, monitored]).max()),
        worth.ess,
        worth.ess / y.shape[0],
        y.shape[0],
        Termination.STEPS_DONE if _is_enough(worth, draws) else Termination.STEPS_EXHAUSTED,
        worth.pareto_k,
    )


def _mismatch_draws(found: Optimum, draws: int, seed: int, inflation: float) -> PosteriorDraws:
    """Return draws with mismatch and poorly determined elements: those of `compliances`.

    The residuals are not evaluated again. The truck is determined by its own sensors, through
    residuals so exact that their curvature keeps chains from moving; its effect on EI is far below
    the uncertainty by the mismatch.
    """
    near = compliances.compliance_posterior(found, inflation)
    monitored = _monitored_indices(found.problem)
    kept: list[FloatArray] = []
    r_hat, ess, ending = np.inf, 0.0, Termination.STEPS_EXHAUSTED
    for number in range(_MAX_RUNS):
        first = number * convergence.CHAINS
        streams = range(first, first + convergence.CHAINS)
        wanted = draws // convergence.CHAINS
        kept.append(
            np.stack([compliances.draws(near, wanted, seed, one) for one in streams], axis=1)
        )
        r_hat, ess, ending = _convergence(
            np.concatenate(kept)[:, :, monitored], _MIN_EFFECTIVE_SHARE * draws
        )
        if ending is Termination.STEPS_DONE:
            break
    return PosteriorDraws(np.concatenate(kept), r_hat, ess, 1.0, 0, ending)


def _convergence(draws: FloatArray, least_ess: float) -> tuple[float, float, Termination]:
    """Return R-hat, effective sample size and the verdict on draws (n, chains, parameters)."""
    r_hat = float(convergence.split_r_hat(draws).max())
    ess = float(convergence.effective_sample_size(draws).min())
    agrees = r_hat < _LARGEST_R_HAT and ess > least_ess
    return r_hat, ess, Termination.STEPS_DONE if agrees else Termination.STEPS_EXHAUSTED


def _monitored_indices(problem: posterior.PosteriorProblem) -> NDArray[np.int64]:
    """Return the indices in y of the parameters that must converge: rigidities and mass.

    Overall stiffness and frequencies follow from these. The parameters of truck and supports that
    they depend on have then converged, too; the others do not affect the verdict.
    """
    kept = np.flatnonzero(problem.priors.estimated)
    mass = np.flatnonzero(kept == RHO_A)
    return np.concatenate([posterior.layout(problem).elements, mass])
