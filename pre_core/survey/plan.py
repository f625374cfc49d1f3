"""Information of a planned survey: likelihoods times numbers of crossings, plus priors.

One crossing of the nominal truck over the nominal bridge, simulated without the noise that the
model contains, has the mean information of a real one: J'J of its whitened residuals does not
depend on the noise realisation. Deflection is linear in the compliances c = EI_nominal/EI
(`crossing.compliances`), so this is also the information on a damaged bridge.

Crossings of a wheel-path group share a part of the profile mismatch (`fusion.joint`): it has
coordinates of its own, once for all of them, and does not average out. The variables of a single
crossing (truck, trajectory, delays, its part of the mismatch) are integrated out of each. A common
scale of all elements (total mass, gain of all sensors) is not observable: a comparison with nominal
values has to add it.
"""

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pre_core.arrays import FloatArray
from pre_core.crossing import posterior
from pre_core.crossing.compliances import draws, from_normal, marginal
from pre_core.crossing.fit import Optimum
from pre_core.crossing.mismatch import Mismatch, between_run_spectra
from pre_core.fusion.likelihood import CrossingLikelihood, add_covariance, likelihood
from pre_core.fusion.long_waves import covariance_of_coefficients
from pre_core.fusion.path_groups import low_rank_root
from pre_core.search import levenberg_marquardt
from pre_core.search.loop import Termination

DRAWS: Final = 2000
"""Number of draws of a forecast, from which a standard deviation has a relative error of 2 %."""
_CHAINS = 2
_SEED = 1


class PosteriorAtTruth(NamedTuple):
    """The posterior of a simulated crossing, and its true search coordinates y (f,)."""

    problem: posterior.PosteriorProblem
    y: FloatArray


class BridgePrior(NamedTuple):
    """Prior of the bridge: its parameters (b,), the elements last."""

    sigma: FloatArray  # (e,) spread of ln EI
    half_normal: NDArray[np.int64]
    """Indices of the parameters with half-normal priors at zero."""
    log_odds: FloatArray
    """Log odds (b,) of absence, as in `posterior.log_odds_of_absence`."""
    second_moment: FloatArray  # (b - e,) of the priors of all but the elements


class PlannedPathGroup(NamedTuple):
    """One wheel-path group; each of its planned crossings is repeated equally often."""

    precisions: tuple[FloatArray, ...]
    """Precision (b + k, b + k) of each crossing: the bridge's parameters, then the shared mismatch
    in mm at k knots."""
    common: FloatArray | None
    """Prior precision (k, k) of the shared mismatch; None where runs share nothing."""


def bridge_prior(problem: posterior.PosteriorProblem) -> BridgePrior:
    """Return the prior of the bridge in a crossing's problem."""
    priors, where = problem.priors, posterior.layout(problem)
    absence = priors.absence[priors.estimated][where.bridge]
    e = where.elements.size
    return BridgePrior(
        posterior.rigidity_spread(priors),
        np.searchsorted(where.bridge, np.intersect1d(where.half_normal, where.bridge)),
        posterior.log_odds_of_absence(problem)[where.bridge],
        np.maximum(1.0 - absence[: absence.size - e], 1e-9),
    )


def planned_path_group(
    truths: Sequence[PosteriorAtTruth], whole: Mismatch, wander_m: float
) -> PlannedPathGroup:
    """Return the information of a wheel-path group whose runs have a lateral wander of `wander_m`.

    `whole` is the mismatch of a single run, before it is split into shared and own parts.
    """
    likelihoods = [_crossing_likelihood(truth, whole) for truth in truths]
    if not whole.level_m3.any():
        return PlannedPathGroup(tuple(_of_bridge(one, None) for one in likelihoods), None)
    shapes = whole.shapes
    n = shapes.cycles_per_m
    shared = whole.level_m3 @ between_run_spectra(*shapes.footprints, wander_m)
    # The crossings' own knots coincide on the bridge and near it.
    knots_m = likelihoods[0].knots_m
    of_all = covariance_of_coefficients(knots_m, n, whole.level_m3 @ shapes.density)
    common = covariance_of_coefficients(knots_m, n, shared)
    own = low_rank_root(of_all - common)
    return PlannedPathGroup(
        tuple(_of_bridge(one, own) for one in likelihoods), np.asarray(np.linalg.inv(common))
    )


def _crossing_likelihood(truth: PosteriorAtTruth, whole: Mismatch) -> CrossingLikelihood:
    """Return the likelihood of one crossing at its true parameters."""
    problem, y = truth
    mismatch = whole._replace(speed_m_per_s=problem.mismatch.speed_m_per_s)
    problem = problem._replace(mismatch=mismatch)
    state = levenberg_marquardt.initial_state(lambda at: posterior.all_rows(problem, at), y)
    return likelihood(Optimum(problem, state, Termination.CONVERGED, 1.0, 0, 1), with_bends=False)


def _of_bridge(crossing: CrossingLikelihood, own: FloatArray | None) -> FloatArray:
    """Return the precision (b + k, b + k) without the crossing's truck and own mismatch.

    Both are integrated out; the covariance of the own mismatch at the knots is own own'.
    """
    precision = crossing.root.T @ crossing.root
    b, t = len(crossing.bridge.names), len(crossing.truck.names)
    truck = b + np.arange(t)
    precision[truck, truck] += 1.0  # before the survey, the truck is known by its data sheet only
    linear = np.zeros(precision.shape[0])
    if own is not None:
        along = np.zeros((linear.size, own.shape[0]))
        along[b + t :] = np.eye(own.shape[0])
        precision, linear = add_covariance(precision, linear, along, own)
    return marginal(precision, linear, np.setdiff1d(np.arange(linear.size), truck))[0]


def survey_information(
    groups: Sequence[PlannedPathGroup], crossings: float, bridge: int
) -> FloatArray:
    """Return the precision (b, b) of the bridge after a number of `crossings`.

    They are divided evenly among the planned crossings of all groups. `bridge` is the number b of
    its parameters.
    """
    total = np.zeros((bridge, bridge))
    each = crossings / sum(len(group.precisions) for group in groups)
    for group in groups:
        precision = each * np.sum(group.precisions, axis=0)
        if group.common is not None:
            precision[bridge:, bridge:] += group.common
            precision, _ = marginal(precision, np.zeros(precision.shape[0]), np.arange(bridge))
        total += precision
    return total


class SurveySpreads(NamedTuple):
    """Standard deviations of ln EI, conditional on the scale common to all elements."""

    elements: FloatArray  # (e,)
    level: float
    """Standard deviation of the length-weighted mean over the bridge."""


def survey_spreads(
    known: BridgePrior,
    precision: FloatArray,
    lengths_m: FloatArray,
    truth: FloatArray | None = None,
) -> SurveySpreads:
    """Return the posterior spreads of a survey with this precision (b, b).

    `lengths_m` is (e,). `truth` (b,) is the bridge with c in place of ln EI, by default the nominal
    bridge. The spreads are those of Gibbs draws of the normal in 1/EI times the priors, because the
    posterior of poorly determined elements is far from normal in ln EI.
    """
    b, e = precision.shape[0], known.sigma.size
    elements = np.arange(b - e, b)
    if truth is None:
        truth = np.zeros(b)
        truth[elements] = 1.0
    linear = precision @ truth
    single = np.arange(b - e)
    whole = precision.copy()
    whole[single, single] += 1.0
    of = from_normal(
        whole,
        linear,
        elements,
        known.half_normal,
        known.sigma,
        known.log_odds,
        truth[elements],
    )
    drawn = np.concatenate([draws(of, DRAWS // _CHAINS, _SEED, chain) for chain in range(_CHAINS)])
    ln_ei = drawn[:, elements] * known.sigma
    return SurveySpreads(ln_ei.std(axis=0), float((ln_ei @ lengths_m / lengths_m.sum()).std()))


def non_increasing(spreads: FloatArray) -> FloatArray:
    """Return the non-increasing columns closest to `spreads` (n, k) in least squares.

    More crossings never widen a posterior: an increase between two rows is an error of a standard
    deviation from a finite number of draws.
    """
    from scipy.optimize import isotonic_regression  # slow to import; only plans need it

    columns = [isotonic_regression(column, increasing=False).x for column in spreads.T]
    return np.stack(columns, axis=1)
