"""Posterior of a bridge on the response surfaces of its crossings, without a common linearisation.

Where crossings determine elements poorly, a normal about the most likely bridge has the widths of
that bridge. If it has no rotational restraint, its ends are determined better than those of a true
bridge that has one, and that may be as likely and far away. So bridges are drawn
(`search.tempering`) with the likelihoods of all crossings at each drawn bridge itself. Variables
that are nearly linear there are integrated out: trucks, waves of the mismatch, changes of the
bridge, and each crossing's offset.
"""

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from pre_core.arrays import FloatArray
from pre_core.crossing.compliances import marginal
from pre_core.fusion.curvature import CurvedForm, curved_form
from pre_core.fusion.information import BridgePriors, JointInformation
from pre_core.fusion.likelihood import linearised_likelihood
from pre_core.fusion.mass import mass_sensitivity
from pre_core.fusion.path_groups import (
    FusionInput,
    PathGroup,
    PathGroupKey,
    path_group_key,
    wave_precision,
)
from pre_core.fusion.variability import change_root, marginalise_variability, varying_bridge
from pre_core.search import tempering
from pre_core.search.latent import LatentCoordinates, latent_coordinates

_WIDENED = 3.0
"""Width of the normal from which draws begin, relative to that about the most likely bridge."""
_WIDENED_AGAIN = 2.0
"""The same, relative to the covariance of first draws, whose correlations the second ones use."""
_LEAST_VARIANCE = 0.01
"""Variance of first draws, relative to the normal's, below which they are too few to use."""
_FIRST_MOVES, _MOVES = (6,), (45, 45)
"""Numbers of moves of first and second draws before each snapshot."""


class _CurvedCrossing(NamedTuple):
    """A crossing's log-likelihood as quadratic forms of its features and s shared variables.

    The crossing's own normal variables are integrated out.
    """

    form: CurvedForm
    squares: FloatArray  # (f, f) form of the features
    linear: FloatArray  # (f, s): features to the linear part of shared variables
    precision: FloatArray  # (s, s) of shared variables
    places: NDArray[np.int64]
    """Indices (s,) of these variables among all shared ones."""


class CurvedSum(NamedTuple):
    """Sum of the log-likelihoods of all crossings, as a function of the bridge alone."""

    crossings: tuple[_CurvedCrossing, ...]
    factor: tuple[FloatArray, bool]
    """Cholesky factor of the precision of all shared variables."""
    sigma: FloatArray  # (e,) spread of ln EI
    mean: FloatArray  # (b,) the most likely bridge y
    covariance: FloatArray
    """Covariance (b, b) of the normal from which draws begin, wider than the one about `mean`."""

    def log_posterior(self, y: FloatArray, pool: ThreadPoolExecutor) -> FloatArray:
        """Return the log posterior (k,) of bridges y (k, b), up to a constant."""
        e = self.sigma.size
        x = y.copy()
        x[:, -e:] = np.exp(-self.sigma * y[:, -e:])
        squares = np.sum(y * y, axis=1)
        linear = np.zeros((y.shape[0], self.factor[0].shape[0]))
        of_each = pool.map(partial(_squares_and_linear, x), self.crossings)
        for one, (of_squares, of_linear) in zip(self.crossings, of_each, strict=True):
            squares += of_squares
            linear[:, one.places] += of_linear
        squares -= np.sum(linear * cho_solve(self.factor, linear.T).T, axis=1)
        return np.asarray(-0.5 * squares)


def _squares_and_linear(x: FloatArray, crossing: _CurvedCrossing) -> tuple[FloatArray, FloatArray]:
    """Return a crossing's squares (k,) and linear parts (k, s) of shared variables, x (k, b)."""
    features = crossing.form.features(x)
    return np.sum((features @ crossing.squares) * features, axis=1), features @ crossing.linear


def curved_sum(
    parts: Sequence[FusionInput],
    tracks: Mapping[PathGroupKey, PathGroup],
    information: JointInformation,
    priors: BridgePriors,
    variability: tuple[float, float],
) -> CurvedSum:
    """Return the sum of `parts`, the crossings in `information`; `variability` is (tau, rho)."""
    layout = information.layout
    crossings = tuple(
        _curved_crossing(part, tracks, information, priors, variability) for part in parts
    )
    precision = information.prior[layout.bridge :, layout.bridge :].copy()
    for one in crossings:
        precision[np.ix_(one.places, one.places)] += one.precision
    sigma = priors.coordinates.scale[layout.elements]
    mean, slope = information.centre.copy(), np.ones(layout.bridge)
    mean[layout.elements] = -np.log(mean[layout.elements]) / sigma
    slope[layout.elements] = -sigma * information.centre[layout.elements]
    near = marginalise_variability(information, varying_bridge(information), *variability)
    of_bridge = marginal(*near[:2], np.arange(mean.size))[0] * np.outer(slope, slope)
    covariance = np.asarray(_WIDENED**2 * np.linalg.inv(of_bridge + np.eye(mean.size)))
    return CurvedSum(crossings, cho_factor(precision), sigma, mean, covariance)


def _curved_crossing(
    part: FusionInput,
    tracks: Mapping[PathGroupKey, PathGroup],
    information: JointInformation,
    priors: BridgePriors,
    variability: tuple[float, float],
) -> _CurvedCrossing:
    likelihood, layout, centre = part.likelihood, information.layout, information.centre
    b, t, q = layout.bridge, len(likelihood.truck.names), likelihood.knots_m.size
    key = path_group_key(part)
    track = tracks.get(key)
    whole = wave_precision(part, tracks)
    near = linearised_likelihood(likelihood, centre, whole)
    m = near.target.size
    others = likelihood.root[:, b : b + t + q]
    of_priors = np.eye(t + q)
    of_priors[t:, t:] = whole
    free = np.eye(m) - others @ np.linalg.solve(others.T @ others + of_priors, others.T)
    form = curved_form(
        likelihood.root[:, :b],
        likelihood.target,
        likelihood.root[:, b + t + q :],
        likelihood.bends,
        free,
    )
    of_bridge, of_truck, of_waves = np.hsplit(near.root[:, : b + t + q], [b, b + t])
    changes = of_bridge[:, layout.elements] * centre[layout.elements]
    own = [changes @ change_root(priors.elements, *variability)]
    heavier = of_bridge @ (part.mass_spread * mass_sensitivity(priors, centre))
    shared = [of_truck, heavier[:, None]]
    places = [layout.trucks[part.truck]]
    if track is not None:
        own.append(of_waves @ track.own_root)
        if part.name in track.short_roots:
            own.append(of_bridge @ track.short_roots[part.name])
        if key in layout.tracks:
            shared.append(of_waves)
            places.append(layout.tracks[key])
    noise = np.hstack(own)
    weight = np.asarray(np.linalg.inv(np.eye(m) + noise @ noise.T))
    without_offset = form.offset_projection(centre)
    weight = np.asarray(without_offset @ weight @ without_offset)
    effects = np.hstack(shared)
    return _CurvedCrossing(
        form,
        form.rows.T @ weight @ form.rows,
        form.rows.T @ weight @ effects,
        effects.T @ weight @ effects,
        np.concatenate(places) - b,
    )


def curved_draws(
    curved: CurvedSum,
    priors: BridgePriors,
    count: int,
    rng: np.random.Generator,
    progress: Callable[[float], object] = lambda done: None,
    threads: int = 1,
) -> FloatArray:
    """Return draws y (count, b) of the bridge's coordinates; they do not depend on `threads`."""
    near = curved.covariance / _WIDENED**2
    cut_off = np.flatnonzero(~priors.coordinates.is_log)
    each = -(-count // len(_MOVES))
    with ThreadPoolExecutor(threads) as pool:

        def log_posterior(latent: LatentCoordinates, v: FloatArray) -> FloatArray:
            found = curved.log_posterior(latent.values(v), pool) + latent.log_share(v)
            return np.where(np.isfinite(found), found, -np.inf)

        # The correlations with restraints and bearings at the most likely bridge do not hold far
        # from it, so that the first coordinates are independent.
        alone = latent_coordinates(cut_off, priors.log_odds, curved.mean, np.diag(np.diag(near)))
        target = partial(log_posterior, alone)
        first = tempering.tempered_draws(
            target,
            curved.mean,
            curved.covariance,
            each,
            _FIRST_MOVES,
            rng,
            lambda done: progress(0.5 * done),
        )
        y = alone.values(first)
        mean, covariance = y.mean(axis=0), _covariance(y, near)
        latent = latent_coordinates(cut_off, priors.log_odds, mean, covariance)
        root = _WIDENED_AGAIN * latent.unexplained(np.asarray(np.linalg.cholesky(covariance)))
        drawn = tempering.tempered_draws(
            partial(log_posterior, latent),
            latent.unexplained(mean),
            root @ root.T,
            each,
            _MOVES,
            rng,
            lambda done: progress(0.5 + 0.5 * done),
        )
    return latent.values(drawn[:count])


def _covariance(y: FloatArray, near: FloatArray) -> FloatArray:
    """Return the covariance (b, b) of draws y (k, b); `near` (b, b) gives too small variances."""
    covariance = np.cov(y.T)
    for index in np.flatnonzero(np.diag(covariance) < _LEAST_VARIANCE * np.diag(near)):
        covariance[index] = covariance[:, index] = 0.0
        covariance[index, index] = near[index, index]
    return np.asarray(covariance)
