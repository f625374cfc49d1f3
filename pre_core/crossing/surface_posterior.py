"""Posterior of a crossing with profile mismatch, on a response surface of its residuals.

Where the axles' tyres differ, elements, supports and offset are determined so poorly that their
posterior is neither normal nor near the optimum. Truck and trajectory are determined by residuals
so exact that no weighted draw of all coordinates would ever be likely; given the others they are
normal. So they are integrated out (`response_surface`), and the few others are drawn from the
surface. It is fitted twice: at points of the normal about the optimum, linear in c
(`compliances`), and at points of the posterior on that first surface, both widened.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cholesky, solve_triangular

from pre_core.arrays import FloatArray
from pre_core.crossing import compliances, posterior, surrogate
from pre_core.crossing.fit import Optimum
from pre_core.crossing.mismatch import has_alike_tyres
from pre_core.crossing.response_surface import (
    POINTS,
    ResponseSurface,
    SurfaceParts,
    place_of_offset,
    residuals_of,
    response_surface,
)
from pre_core.crossing.weighted_draws import WeightedDraws, importance_draws, is_enough
from pre_core.search import convergence, importance
from pre_core.search.loop import Report

_WIDENED = 2.0
"""Noise of the densities from which points are drawn, relative to the crossing's: the truth is
seldom outside, and is where many crossings are linearised in fusion."""
_FIRST_POINTS = 320
"""Number of points of the first surface, which only says where the second is wanted."""
_SHARE_OF_POINTS = 3
"""Weighted draws for each point, which is then rarely drawn twice."""


class SurfacePosterior(NamedTuple):
    """The surface of a crossing and the points to which it was fitted."""

    curved: NDArray[np.int64]
    """Indices (n,) in y of the bridge's coordinates and of others that must not be negative."""
    surface: ResponseSurface
    points: FloatArray  # (k, n + 1), the offset last
    evaluations: int


def curved_coordinates(found: Optimum) -> NDArray[np.int64]:
    """Return the indices (n,) in y of the coordinates of surface and points, without the offset."""
    where = posterior.layout(found.problem)
    return np.union1d(where.bridge, where.half_normal)


def surface_points(found: Optimum, inflation: float, seed: int) -> FloatArray:
    """Return points (POINTS, n + 1) of a crossing's curved coordinates and offset, for a surface.

    With alike tyres the normal about the optimum is close to the posterior.
    """
    if has_alike_tyres(found.problem.mismatch):
        return _points_of_normal(found, POINTS, inflation, seed)
    return surface_posterior(found, inflation, seed).points


def surface_posterior(found: Optimum, inflation: float, seed: int) -> SurfacePosterior:
    """Return the surface of a crossing, for noise `inflation` times the declared one."""
    problem, curved = found.problem, curved_coordinates(found)
    rows = compliances.without_priors(problem, found.state.residual.size, curved)
    none = np.zeros((rows.size, 0))
    parts = SurfaceParts(curved, np.zeros(0, dtype=np.int64), rows, none, np.zeros((0, 0)))

    def fitted(points: FloatArray) -> SurfacePosterior:
        surface = response_surface(found, problem, found.state.jacobian, parts, points)
        return SurfacePosterior(curved, surface, points, surface.evaluations)

    widened = _WIDENED * inflation
    first = fitted(_points_of_normal(found, _FIRST_POINTS, widened, seed))
    wanted = _SHARE_OF_POINTS * POINTS
    wide = draw_curved(found, first, wanted, seed, widened, may_be_absent=False)
    if not is_enough(wide.worth, wanted):
        return first
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(1 << 23,)))
    second = fitted(wide.y[importance.systematic_resample(wide.worth.weight, POINTS, rng)])
    return second._replace(evaluations=first.evaluations + second.evaluations)


def _points_of_normal(found: Optimum, count: int, inflation: float, seed: int) -> FloatArray:
    """Return points (count, n + 1) of the normal about the optimum, linear in c."""
    near = compliances.compliance_posterior(found, inflation)
    near = near._replace(log_odds=_never_absent(near.log_odds))
    kept = np.append(curved_coordinates(found), place_of_offset(found.problem))
    chains = convergence.CHAINS
    drawn = [compliances.draws(near, count // chains, seed, chain) for chain in range(chains)]
    return np.concatenate(drawn)[:, kept]


def _never_absent(log_odds: FloatArray) -> FloatArray:
    """Return log odds (n,) without chance of absence: only what the site file excludes is zero."""
    return np.where(np.isposinf(log_odds), log_odds, -np.inf)


def draw_curved(
    found: Optimum,
    of: SurfacePosterior,
    draws: int,
    seed: int,
    inflation: float,
    report: Report = lambda stage, fraction: None,
    *,
    may_be_absent: bool = True,
) -> WeightedDraws:
    """Return weighted draws (k, n + 1) of the curved coordinates and the offset.

    Unless they `may_be_absent`, springs and bearings are present in all.
    """
    problem = found.problem
    kept = np.append(of.curved, place_of_offset(problem))
    centres = np.pad(problem.noise_slope, (0, found.state.y.size))[of.curved]

    def target(y: FloatArray) -> FloatArray:
        squares = np.sum(residuals_of(of.surface, y) ** 2, axis=1)
        squares += np.sum((y[:, :-1] - centres) ** 2, axis=1)
        return np.asarray(-0.5 / inflation**2 * squares)

    full = surrogate.coordinates(found, inflation)
    coordinates = surrogate.restricted(full, kept)
    if not may_be_absent:
        coordinates = coordinates._replace(log_odds=_never_absent(coordinates.log_odds))
    near = surrogate.gauss_newton_surrogate(found, full)
    first = surrogate.Surrogate(*compliances.marginal(near.precision, near.linear, kept))
    return importance_draws(target, coordinates, first, found.state.y[kept], draws, seed, report)


def complete(
    found: Optimum,
    of: SurfacePosterior,
    drawn: FloatArray,
    inflation: float,
    rng: np.random.Generator,
) -> FloatArray:
    """Return y (k, f) with the others drawn given the curved coordinates and offset (k, n + 1)."""
    y, jacobian = found.state.y, found.state.jacobian
    kept = np.append(of.curved, place_of_offset(found.problem))
    others = np.setdiff1d(np.arange(y.size), kept)
    root = cholesky(jacobian[:, others].T @ jacobian[:, others])

    def solved(columns: FloatArray) -> FloatArray:
        half = solve_triangular(root, jacobian[:, others].T @ columns, trans="T")
        return np.asarray(solve_triangular(root, half))

    mean = solved(-found.state.residual) - (drawn - y[kept]) @ solved(jacobian[:, kept]).T
    noise = rng.standard_normal((drawn.shape[0], others.size))
    out = np.empty((drawn.shape[0], y.size))
    out[:, kept] = drawn
    out[:, others] = y[others] + mean + inflation * solve_triangular(root, noise.T).T
    return out
