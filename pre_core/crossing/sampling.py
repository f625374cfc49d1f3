"""Posterior draws of one crossing by adaptive importance sampling.

Draws of a cheap density near the posterior (`surrogate`) are weighted by the posterior, and refine
that density for the next draws. All batches are weighted as draws of one mixture density. Where
these do not suffice, draws of a density that may be curved are weighted (`conditional_draws`).
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import log_ndtr

from pre_core.arrays import FloatArray
from pre_core.crossing import compliances, posterior, surrogate
from pre_core.crossing.conditional_draws import conditional_draws
from pre_core.crossing.fit import Optimum, normal_approximation
from pre_core.crossing.mismatch import has_alike_tyres
from pre_core.crossing.surface_posterior import (
    complete,
    draw_curved,
    drawn_by_residuals,
    points_about_draws,
    surface_posterior,
)
from pre_core.crossing.weighted_draws import (
    MIN_EFFECTIVE_SHARE,
    WantedDraws,
    WeightedDraws,
    importance_draws,
    is_enough,
)
from pre_core.parameters import RHO_A, TORSION
from pre_core.physics.torsion import NO_TORSION
from pre_core.search import convergence, importance, levenberg_marquardt
from pre_core.search.loop import Report, Termination

_LARGEST_R_HAT = 1.05
"""Convergence limit of R-hat of rigidities and mass."""
_MAX_RUNS = 14
"""Limit of draws with tyres of one kind, relative to the requested ones."""
_PATIENCE = 10
"""Number of batches after which draws of a normal likelihood go on only if they are on course."""
_LEAST_ESS = 30.0
"""Effective number of draws below which their quantiles are meaningless."""
_NEGLIGIBLE_ODDS = 0.02
"""Odds below which torsion is omitted from the draws: it changes no interval and costs draws."""


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
    points: FloatArray | None = None
    """Points (`response_surface.POINTS` at least, n + 1) with mismatch, for a surface in fusion."""


def sample(
    found: Optimum,
    draws: int,
    seed: int,
    *,
    inflation: float = 1.0,
    report: Report = lambda stage, fraction: None,
) -> PosteriorDraws:
    """Draw from the posterior about its optimum, for noise `inflation` times the declared one.

    Return at least `draws` in all chains together; their `ending` is STEPS_EXHAUSTED if they have
    not converged. Improbable torsion is zero in all draws.
    """
    if found.problem.mismatch.level_m3.any():
        return _mismatch_draws(found, draws, seed, inflation, report)
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
    weighted = surrogate_draws(found, draws, seed, inflation, report)
    evaluations = weighted.y.shape[0]
    if not is_enough(weighted.weights, draws):
        other = conditional_draws(found, draws, seed, inflation, report)
        evaluations += other.evaluations
        weighted = max(weighted, other.weighted, key=lambda one: one.weights.ess)
    chains = _resample_to_chains(weighted, _monitored_indices(found.problem), draws, seed)
    return chains._replace(evaluations=evaluations)


def surrogate_draws(
    found: Optimum, draws: int, seed: int, inflation: float, report: Report
) -> WeightedDraws:
    """Return weighted draws (k, f) of all coordinates at once, as long as they are on course."""

    def target(points: FloatArray) -> FloatArray:
        rows = posterior.all_rows(found.problem, points)
        return np.asarray(-0.5 / inflation**2 * np.sum(rows * rows, axis=1))

    coordinates = surrogate.coordinates(found, inflation)
    first = surrogate.gauss_newton_surrogate(found, coordinates)
    wanted = WantedDraws(draws, _PATIENCE)
    return importance_draws(target, coordinates, first, found.state.y, wanted, seed, report)


def _resample_to_chains(
    weighted: WeightedDraws, monitored: NDArray[np.int64], draws: int, seed: int
) -> PosteriorDraws:
    """Return weighted draws resampled by their weights, in the form of chains."""
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(1 << 22,)))
    y, weights = weighted
    count = -(-max(draws, y.shape[0]) // convergence.CHAINS)
    chosen = importance.systematic_resample(weights.weight, count * convergence.CHAINS, rng)
    dealt = y[chosen].reshape(count, convergence.CHAINS, -1)
    return PosteriorDraws(
        dealt,
        float(convergence.split_r_hat(dealt[:, :, monitored]).max()),
        weights.ess,
        weights.ess / y.shape[0],
        y.shape[0],
        Termination.STEPS_DONE if is_enough(weights, draws) else Termination.STEPS_EXHAUSTED,
        weights.pareto_k,
    )


def _mismatch_draws(
    found: Optimum, draws: int, seed: int, inflation: float, report: Report
) -> PosteriorDraws:
    """Return draws with mismatch, weighted by the residuals or by a surface of these.

    With tyres of one kind the posterior is so narrow that no surface is exact enough. Weighted
    draws on a surface that do not suffice are replaced by draws of the normal in c (`compliances`).
    """
    if has_alike_tyres(found.problem.mismatch):
        return _alike_tyres_draws(found, draws, seed, inflation, report)
    of = surface_posterior(found, inflation, seed)
    weighted = draw_curved(found, of.squares, draws, seed, inflation, report)
    if is_enough(weighted.weights, draws):
        chains = _completed_to_chains(found, weighted, draws, seed, inflation)
        points = points_about_draws(found, weighted, seed)
    else:
        chains = _compliance_draws(found, draws, seed, inflation)
        points = of.points
    return chains._replace(evaluations=of.evaluations, points=points)


def _alike_tyres_draws(
    found: Optimum, draws: int, seed: int, inflation: float, report: Report
) -> PosteriorDraws:
    """Return draws weighted by the residuals, even if these have not converged.

    Draws of the normal in c, which can be wrong by six standard deviations here, replace them only
    if hardly any are effective.
    """
    weighted, evaluations = drawn_by_residuals(found, draws, seed, inflation, report)
    points: FloatArray | None = None
    if weighted.weights.ess < _LEAST_ESS:
        # Diagnostics are of the draws that failed, not of those in their place.
        chains = _compliance_draws(found, draws, seed, inflation)._replace(
            ess=weighted.weights.ess,
            acceptance=weighted.weights.ess / weighted.y.shape[0],
            pareto_k=weighted.weights.pareto_k,
            ending=Termination.STEPS_EXHAUSTED,
        )
    else:
        chains = _completed_to_chains(found, weighted, draws, seed, inflation)
        points = points_about_draws(found, weighted, seed)
    return chains._replace(evaluations=evaluations, points=points)


def _completed_to_chains(
    found: Optimum, weighted: WeightedDraws, draws: int, seed: int, inflation: float
) -> PosteriorDraws:
    """Return weighted draws (k, n + 1) of a few coordinates with all others, in chains."""
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(1 << 24,)))
    drawn = complete(found, weighted.y, inflation, rng)
    drawn += compliances.MISMATCH_BIAS_SPREAD * np.outer(
        rng.standard_normal(drawn.shape[0]), compliances.mismatch_bias(found)
    )
    of_all = WeightedDraws(drawn, weighted.weights)
    return _resample_to_chains(of_all, _monitored_indices(found.problem), draws, seed)


def _compliance_draws(found: Optimum, draws: int, seed: int, inflation: float) -> PosteriorDraws:
    """Return draws of the normal in c about the optimum, times the exact priors."""
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
            np.concatenate(kept)[:, :, monitored], MIN_EFFECTIVE_SHARE * draws
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
