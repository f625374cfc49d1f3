"""What a survey will tell of a bridge: likelihoods at the truth, so many of each, priors once.

One crossing of the nominal truck over the nominal bridge, without noise but with all of it in the
model, has the information that a driven one will have on average: J'J of its white rows does not
depend on what the noise happens to be. Deflection is linear in the compliances c = EI_nominal/EI
(`crossing.compliances`), so that this information is that of a damaged bridge, too.

Crossings in one track share a part of the mismatch of the axles' roads (`fusion.joint`): it has its
place among the unknowns once for all of them, so that no number of crossings averages it out. What
is this crossing's own (truck, trajectory, delays, its part of the mismatch) is integrated out of
each. What scales all elements alike (total mass, gain of all sensors) no crossing shows: whoever
compares with a nominal value adds it.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pre_core.crossing import posterior
from pre_core.crossing.compliances import draws, marginal, of_normal
from pre_core.crossing.mismatch import Mismatch, common_shapes
from pre_core.crossing.optimum import Optimum
from pre_core.fusion.likelihood import (
    Likelihood,
    covariance_of_coefficients,
    likelihood,
    loosened,
)
from pre_core.fusion.tracks import root_of
from pre_core.search import levenberg_marquardt
from pre_core.search.loop import Ending

FloatArray = NDArray[np.float64]

_DRAWS, _CHAINS = 1000, 2
"""A standard deviation of so many draws is right to 2 %."""


class Truth(NamedTuple):
    """A crossing's posterior with y (f,) at the truth."""

    problem: posterior.Problem
    y: FloatArray


class Known(NamedTuple):
    """What is known of the bridge before any crossing: its unknowns (b,), the elements last."""

    sigma: FloatArray  # (e,) spread of ln EI
    half_normal: NDArray[np.int64]
    """Places of what must not be negative."""
    log_odds: FloatArray
    """(b,) of being exactly nothing, as in `posterior.log_odds_of_absence`."""
    second_moment: FloatArray  # (b - e,) of the priors of all but the elements


class Track(NamedTuple):
    """Crossings of which there are equally many, in one track."""

    precisions: tuple[FloatArray, ...]
    """(b + k, b + k) each: the bridge's unknowns, then the common mismatch in mm at k knots."""
    common: FloatArray | None
    """(k, k) prior precision of these; None where tracks share nothing."""


def known_before(problem: posterior.Problem) -> Known:
    """What a crossing's priors say of the bridge."""
    priors, where = problem.priors, posterior.layout(problem)
    absence = priors.absence[priors.estimated][where.bridge]
    e = where.elements.size
    return Known(
        posterior.rigidity_spread(priors),
        np.searchsorted(where.bridge, np.intersect1d(where.half_normal, where.bridge)),
        posterior.log_odds_of_absence(problem)[where.bridge],
        np.maximum(1.0 - absence[: absence.size - e], 1e-9),
    )


def track_of(truths: Sequence[Truth], whole: Mismatch, wander_m: float) -> Track:
    """What crossings in one track tell; tracks lie beside each other by `wander_m` (std)."""
    told = [_told(truth, whole) for truth in truths]
    if not whole.level_m3.any():
        return Track(tuple(_of_bridge(one, None) for one in told), None)
    shapes = whole.shapes
    n = shapes.cycles_per_m
    shared = whole.level_m3 @ common_shapes(*shapes.footprints, wander_m)
    # The crossings' own knots stand at the same places on the bridge and near it.
    knots_m = told[0].knots_m
    of_all = covariance_of_coefficients(knots_m, n, whole.level_m3 @ shapes.density)
    common = covariance_of_coefficients(knots_m, n, shared)
    own = root_of(of_all - common)
    return Track(tuple(_of_bridge(one, own) for one in told), np.asarray(np.linalg.inv(common)))


def _told(truth: Truth, whole: Mismatch) -> Likelihood:
    """The likelihood of one crossing: all that this room needs of `fusion`."""
    problem, y = truth
    mismatch = whole._replace(speed_m_per_s=problem.mismatch.speed_m_per_s)
    problem = problem._replace(mismatch=mismatch)
    state = levenberg_marquardt.begin(lambda at: posterior.all_rows(problem, at), y)
    return likelihood(Optimum(problem, state, Ending.CONVERGED, 1.0, 0, 1), with_bends=False)


def _of_bridge(told: Likelihood, own: FloatArray | None) -> FloatArray:
    """Precision (b + k, b + k): the truck and the crossing's own waves integrated out."""
    precision = told.root.T @ told.root
    b, t = len(told.bridge.names), len(told.truck.names)
    truck = b + np.arange(t)
    precision[truck, truck] += 1.0  # before the survey nothing but its data sheet is known
    linear = np.zeros(precision.shape[0])
    if own is not None:
        along = np.zeros((linear.size, own.shape[0]))
        along[b + t :] = np.eye(own.shape[0])
        precision, linear = loosened(precision, linear, along, own)
    return marginal(precision, linear, np.setdiff1d(np.arange(linear.size), truck))[0]


def together(tracks: Sequence[Track], crossings: float, bridge: int) -> FloatArray:
    """Precision (b, b) that so many crossings, shared evenly, have of the bridge's unknowns."""
    total = np.zeros((bridge, bridge))
    each = crossings / sum(len(track.precisions) for track in tracks)
    for track in tracks:
        precision = each * np.sum(track.precisions, axis=0)
        if track.common is not None:
            precision[bridge:, bridge:] += track.common
            precision, _ = marginal(precision, np.zeros(precision.shape[0]), np.arange(bridge))
        total += precision
    return total


class Spreads(NamedTuple):
    """Standard deviations of ln EI, of what is common to all elements free."""

    elements: FloatArray  # (e,)
    level: float
    """Of the mean over the bridge, by length."""


def spreads(
    known: Known,
    precision: FloatArray,
    lengths_m: FloatArray,
    truth: FloatArray | None = None,
    seed: int = 1,
) -> Spreads:
    """Of the posterior that a survey of this precision (b, b) ends in.

    `truth` (b,) is the bridge with c in place of ln EI, by default the nominal one. By Gibbs'
    draws of the normal in 1/EI times the priors: the posterior is far from normal in ln EI where
    hardly anything is known of an element.
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
    of = of_normal(
        whole,
        linear,
        elements,
        known.half_normal,
        known.sigma,
        known.log_odds,
        1.0,
        truth[elements],
        np.zeros(b),
    )
    drawn = np.concatenate([draws(of, _DRAWS, seed, chain) for chain in range(_CHAINS)])
    ln_ei = drawn[:, elements] * known.sigma
    return Spreads(ln_ei.std(axis=0), float((ln_ei @ lengths_m / lengths_m.sum()).std()))
