"""Posterior of a crossing with profile mismatch, in the few coordinates that it hardly determines.

Elements, supports and offset are determined so poorly that their posterior is neither normal nor
near the optimum. Truck and trajectory follow them (`nuisances`) and are integrated out. The
remaining few are drawn and weighted: by the residuals where both axles have tyres of one kind,
otherwise by a surface of the residuals (`response_surface`). That surface is fitted twice: at
points of the normal in c about the optimum (`compliances`), and at points of the posterior on that
first surface, both widened.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cholesky, solve_triangular
from scipy.special import ndtr, ndtri

from pre_core.arrays import FloatArray
from pre_core.crossing import compliances, posterior, surrogate
from pre_core.crossing.fit import Optimum
from pre_core.crossing.mismatch import has_alike_tyres
from pre_core.crossing.nuisances import (
    Nuisances,
    ResidualParts,
    followed,
    index_of_offset,
    integrated_residuals,
    nuisances_of,
)
from pre_core.crossing.residual_draws import (
    DrawnDensity,
    log_density,
    prior_centres,
    prior_squares,
    residual_draws,
)
from pre_core.crossing.response_surface import (
    POINTS,
    POINTS_OF_DRAWS,
    ResponseSurface,
    residuals_of,
    response_surface,
)
from pre_core.crossing.weighted_draws import (
    WantedDraws,
    WeightedDraws,
    batch_size,
    importance_draws,
    is_enough,
)
from pre_core.search import importance
from pre_core.search.levenberg_marquardt import initial_state
from pre_core.search.loop import Report

_WIDENED = 2.0
"""Noise of the densities from which points are drawn, relative to the crossing's: the truth is
seldom outside, and is where many crossings are linearised in fusion."""
_WIDER = 1.2
"""The same for the first points of draws by the residuals."""
_BEYOND_DRAWS = 1.4
"""Width of the points of a surface in fusion relative to that of the posterior's draws: many
crossings determine a bridge that is beside the posterior of each."""
_NEGLIGIBLE = 4.0
"""Log of the ratio of posterior densities beyond which no first points are drawn about a less
likely bridge: with a fiftieth of the density it shifts no 95 % interval, and draws of both converge
slowly."""
_FIRST_POINTS = 320
"""Number of points of the first surface, which only locates the points of the second."""


class ResidualDraws(NamedTuple):
    """Draws weighted by the residuals."""

    weighted: WeightedDraws  # of the curved coordinates and the offset, (k, n + 1)
    evaluations: int


class SurfacePosterior(NamedTuple):
    """The surface of a crossing, and points of its widened posterior."""

    curved: NDArray[np.int64]
    """Indices (n,) in y of the bridge's coordinates and of others that must not be negative."""
    surface: ResponseSurface
    points: FloatArray  # (k, n + 1), the offset last
    evaluations: int

    def squares(self, y: FloatArray) -> FloatArray:
        """Return sums of squares (k,) of the residuals at points y (k, n + 1)."""
        return np.asarray(np.sum(residuals_of(self.surface, y) ** 2, axis=1))


def nuisances_at_optimum(found: Optimum, inflation: float, seed: int) -> Nuisances:
    """Return a crossing's nuisances, for bridges drawn from the normal about its optimum."""
    return nuisances_on(found, _points_of_normal(found, _FIRST_POINTS, inflation, seed))


def nuisances_on(found: Optimum, points: FloatArray) -> Nuisances:
    """Return a crossing's nuisances, for the bridges of points (k, n + 1)."""
    problem, curved = found.problem, curved_coordinates(found)
    rows = compliances.without_priors(problem, found.state.residual.size, curved)
    none = np.zeros((rows.size, 0))
    parts = ResidualParts(curved, np.zeros(0, dtype=np.int64), rows, none, np.zeros((0, 0)))
    return nuisances_of(found, problem, found.state.jacobian, parts, points)


def drawn_by_residuals(
    found: Optimum, draws: int, seed: int, inflation: float, report: Report
) -> ResidualDraws:
    """Return draws weighted by the residuals, about the optimum and its rivals."""
    nuisances = nuisances_at_optimum(found, inflation, seed)
    curved = curved_coordinates(found)
    half_normal = _half_normal(found)
    odds = posterior.log_odds_of_absence(found.problem, inflation)[nuisances.kept]
    density = DrawnDensity(
        partial(integrated_residuals, nuisances, has_step=True),
        partial(prior_squares, prior_centres(found, curved)),
        half_normal,
        odds,
        inflation,
    )
    rivals, evaluations = _likely_rivals(found, nuisances, density)
    first = _points_about_all([found, *rivals], batch_size(draws), _WIDER * inflation, seed)
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(1 << 25,)))
    weighted = residual_draws(density, first, draws, rng, report)
    evaluations += nuisances.evaluations + 2 * (first.shape[0] + weighted.y.shape[0])
    return ResidualDraws(weighted, evaluations)


def _own_generator(found: Optimum, seed: int) -> np.random.Generator:
    """Return a generator for points of this crossing alone.

    Points that crossings have in common would have errors that add up in fusion.
    """
    own = (1 << 23, found.problem.noise.reciprocal.size)
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=own))


def points_about_draws(found: Optimum, weighted: WeightedDraws, seed: int) -> FloatArray:
    """Return points (POINTS, n + 1) for a surface in fusion: a wider posterior than `weighted`.

    Points of a normal about the optimum, or of one twice as wide, lie where the posterior is not:
    parabolas that also have to fit there are wrong where it is.
    """
    return _widened(weighted, _half_normal(found), _own_generator(found, seed))


def _widened(
    weighted: WeightedDraws, half_normal: NDArray[np.int64], rng: np.random.Generator
) -> FloatArray:
    """Return POINTS (k, n + 1): weighted draws, further from their median.

    Coordinates `half_normal` are reflected at zero.
    """
    points = _unweighted(weighted, rng)
    middle = np.median(points, axis=0)
    points = middle + _BEYOND_DRAWS * (points - middle)
    points[:, half_normal] = np.abs(points[:, half_normal])
    return np.asarray(points)


def _unweighted(weighted: WeightedDraws, rng: np.random.Generator) -> FloatArray:
    """Return POINTS (k, n + 1), none repeated, with about the distribution of weighted draws."""
    chosen = importance.systematic_resample(weighted.weights.weight, POINTS, rng)
    return copula_draws(weighted.y[chosen], POINTS, rng)


def _likely_rivals(
    found: Optimum, nuisances: Nuisances, density: DrawnDensity
) -> tuple[list[Optimum], int]:
    """Return the likely rivals of an optimum, as optima, and the number of evaluations.

    Their nuisances follow them, as in the posterior that is drawn.
    """
    if not found.rivals:
        return [], 0
    drawn = np.stack([found.state.y, *found.rivals])[:, nuisances.kept]
    log_posterior = log_density(density, drawn, np.sum(density.residuals(drawn) ** 2, axis=0))
    is_likely = log_posterior[1:] > log_posterior[0] - _NEGLIGIBLE
    points = followed(nuisances, drawn[1:][is_likely], has_step=True)
    rows = partial(posterior.all_rows, found.problem)
    likely = [found._replace(state=initial_state(rows, y)) for y in points]
    return likely, 2 * len(drawn) + len(likely) * (found.state.y.size + 2)


def curved_coordinates(found: Optimum) -> NDArray[np.int64]:
    """Return the indices (n,) in y of the coordinates of surface and points, without the offset."""
    where = posterior.layout(found.problem)
    return np.union1d(where.bridge, where.half_normal)


def _half_normal(found: Optimum) -> NDArray[np.int64]:
    """Return the indices, among curved coordinates, of those that must not be negative."""
    return np.searchsorted(curved_coordinates(found), posterior.layout(found.problem).half_normal)


def surface_points(found: Optimum, inflation: float, seed: int) -> FloatArray:
    """Return points (POINTS, n + 1) of a crossing's curved coordinates and offset, for a surface.

    With tyres of one kind the normal about the optimum is close to the posterior.
    """
    if has_alike_tyres(found.problem.mismatch):
        return _points_of_normal(found, POINTS, inflation, seed)
    return surface_posterior(found, inflation, seed).points


def surface_posterior(found: Optimum, inflation: float, seed: int) -> SurfacePosterior:
    """Return the surface of a crossing, for noise `inflation` times the declared one."""
    curved = curved_coordinates(found)

    def fitted(points: FloatArray) -> SurfacePosterior:
        surface = response_surface(nuisances_on(found, points), found.state.jacobian, points)
        return SurfacePosterior(curved, surface, points, surface.evaluations)

    widened = _WIDENED * inflation
    first = fitted(_points_of_normal(found, _FIRST_POINTS, widened, seed))
    wide = draw_curved(found, first.squares, POINTS, seed, widened, may_be_absent=False)
    if not is_enough(wide.weights, POINTS):
        return first._replace(points=_points_of_normal(found, POINTS, widened, seed))
    points = _unweighted(wide, _own_generator(found, seed))
    second = fitted(points[:POINTS_OF_DRAWS])
    return second._replace(points=points, evaluations=first.evaluations + second.evaluations)


def _points_of_normal(found: Optimum, count: int, inflation: float, seed: int) -> FloatArray:
    """Return at least `count` points (k, n + 1) of the normal in c about the optimum."""
    kept = np.append(curved_coordinates(found), index_of_offset(found.problem))
    return compliances.present_points(found, count, inflation, seed)[:, kept]


def _points_about_all(optima: list[Optimum], count: int, inflation: float, seed: int) -> FloatArray:
    """Return at least `count` points (k, n + 1) of normals about optima, half about the first."""
    if len(optima) == 1:
        return _points_of_normal(optima[0], count, inflation, seed)
    each = -(-count // (2 * len(optima) - 2))
    counts = [-(-count // 2), *([each] * (len(optima) - 1))]
    return np.concatenate(
        [
            _points_of_normal(one, number, inflation, seed)
            for one, number in zip(optima, counts, strict=True)
        ]
    )


def draw_curved(
    found: Optimum,
    squares: Callable[[FloatArray], FloatArray],
    draws: int,
    seed: int,
    inflation: float,
    report: Report = lambda stage, fraction: None,
    *,
    may_be_absent: bool = True,
) -> WeightedDraws:
    """Return weighted draws (k, n + 1) of the curved coordinates and the offset.

    `squares` returns the sums of squares (k,) of the residuals there, without the priors of the
    curved coordinates. Unless they `may_be_absent`, restraint and bearing compliance are present in
    all draws.
    """
    kept = np.append(curved_coordinates(found), index_of_offset(found.problem))
    centres = prior_centres(found, kept[:-1])

    def target(y: FloatArray) -> FloatArray:
        return np.asarray(-0.5 / inflation**2 * (squares(y) + prior_squares(centres, y)))

    full = surrogate.coordinates(found, inflation)
    coordinates = surrogate.restricted(full, kept)
    if not may_be_absent:
        coordinates = coordinates._replace(log_odds=compliances.never_absent(coordinates.log_odds))
    near = surrogate.gauss_newton_surrogate(found, full)
    first = surrogate.Surrogate(*compliances.marginal(near.precision, near.linear, kept))
    start, wanted = found.state.y[kept], WantedDraws(draws)
    return importance_draws(target, coordinates, first, start, wanted, seed, report)


def complete(
    found: Optimum,
    drawn: FloatArray,
    inflation: float,
    rng: np.random.Generator,
) -> FloatArray:
    """Return y (k, f): curved coordinates and offset `drawn` (k, n + 1), all others drawn here."""
    y, jacobian = found.state.y, found.state.jacobian
    kept = np.append(curved_coordinates(found), index_of_offset(found.problem))
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


def copula_draws(draws: FloatArray, count: int, rng: np.random.Generator) -> FloatArray:
    """Return independent draws (count, n) with the marginals and rank correlations of `draws`.

    `draws` are (k, n). The new ones have a Gaussian copula, so that none is repeated. A coordinate
    that is the same in all draws stays so.
    """
    new = np.repeat(draws[:1], count, axis=0)
    varying = np.flatnonzero(np.ptp(draws, axis=0) > 0.0)
    ranks = draws[:, varying].argsort(axis=0, kind="stable").argsort(axis=0)
    scores = ndtri((ranks + 0.5) / draws.shape[0])
    variance, directions = np.linalg.eigh(np.atleast_2d(np.corrcoef(scores.T)))
    root = directions * np.sqrt(np.maximum(variance, 0.0))
    # A product with the symmetric root does not depend on the signs of the directions.
    normal = rng.standard_normal((count, varying.size)) @ (root @ directions.T)
    for place, probability in zip(varying, ndtr(normal).T, strict=True):
        new[:, place] = np.quantile(draws[:, place], probability)
    return new
