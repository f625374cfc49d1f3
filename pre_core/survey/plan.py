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
from pre_core.fusion.joint import covariance
from pre_core.fusion.likelihood import KNOT_M, knots, likelihood
from pre_core.search import levenberg_marquardt
from pre_core.search.loop import Ending
from pre_core.unknowns import EI_1

FloatArray = NDArray[np.float64]

_JITTER = 1e-6
_SHORTEST_AT_KNOTS = 0.6
"""Cycles/m up to which knots can hold what tracks share; what is shorter is left to each crossing,
and hardly tells of a bridge."""
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
        priors.spread[EI_1:][priors.estimated[EI_1:]],
        np.searchsorted(where.bridge, np.intersect1d(where.half_normal, where.bridge)),
        posterior.log_odds_of_absence(problem)[where.bridge],
        np.maximum(1.0 - absence[: absence.size - e], 1e-9),
    )


def track_of(truths: Sequence[Truth], whole: Mismatch, wander_m: float) -> Track:
    """What crossings in one track tell; tracks lie beside each other by `wander_m` (std)."""
    if not whole.level_m3.any():
        return Track(tuple(_told(truth, whole, None) for truth in truths), None)
    shapes = whole.shapes
    n = shapes.cycles_per_m
    # By a bell, which lets no wave's memory grow: the rows' covariance is banded.
    at_knots = 0.5 ** ((n / _SHORTEST_AT_KNOTS) ** 2)
    common = at_knots * common_shapes(*shapes.footprints, wander_m)
    own = whole._replace(shapes=shapes._replace(density=shapes.density - common))
    places = _places(truths)
    apart_m = np.abs(places[:, None] - places[None, :])
    # A cubic B-spline passes on so much of the power of its coefficients.
    of_coefficients = whole.level_m3 @ common / np.sinc(np.minimum(n * KNOT_M, 0.5)) ** 8
    of_mm = 1e6 * covariance(n, of_coefficients, apart_m)
    of_mm += _JITTER * of_mm[0, 0] * np.eye(places.size)
    return Track(
        tuple(_told(truth, own, places) for truth in truths), np.asarray(np.linalg.inv(of_mm))
    )


def _told(truth: Truth, own: Mismatch, places: FloatArray | None) -> FloatArray:
    """Precision (b + k, b + k) of one crossing: all that this room needs of `fusion`."""
    problem, y = truth
    state = levenberg_marquardt.State(
        y, np.zeros(0), np.zeros((0, y.size)), 0.0, 0.0, levenberg_marquardt.FORWARD
    )
    at = own._replace(speed_m_per_s=problem.mismatch.speed_m_per_s)
    return likelihood(Optimum(problem, state, Ending.CONVERGED, 1.0, 0, 1), at, places).precision


def _places(truths: Sequence[Truth]) -> FloatArray:
    """Knots that cover what both axles drive over in all crossings."""
    fronts = [posterior.points(problem, y[None, :]).position_m[0] for problem, y in truths]
    wheelbase = max(problem.priors.wheelbase_m for problem, _ in truths)
    begin = min(float(front.min()) for front in fronts) - wheelbase
    return knots(begin, max(float(front.max()) for front in fronts) + wheelbase)


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
