"""Likelihood of one crossing for bridge, truck and the long waves of its profile mismatch.

It contains no prior, because each prior must count once in a fusion. It is normal in

- the bridge's parameters, with c = EI_nominal/EI in place of ln EI (`crossing.compliances`),
- the truck's, its wheelbase and the common sensor gain, which are the same in all its runs,
- the waves of the mismatch d that are long enough to resemble a deflection, as coefficients of
  cubic splines along the road. Part of them is the same in all runs of a wheel-path group, which
  a single crossing cannot separate.

If the axles follow different profiles, it includes the longitudinal offset and its curvature terms
with the bridge (`fusion.curvature`).

All other variables of the crossing (trajectory, delays, gains, initial vibration, short waves of
the mismatch) are integrated out. The likelihood is small and is stored with the crossing's result.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve, qr

from pre_core import parameters
from pre_core.arrays import FloatArray
from pre_core.crossing import front_axles, posterior
from pre_core.crossing.compliances import (
    MISMATCH_BIAS_SPREAD,
    marginal,
    mismatch_bias,
    without_priors,
)
from pre_core.crossing.fit import Optimum
from pre_core.crossing.mismatch import TRACK_SHAPES, long_wave_power
from pre_core.crossing.nuisances import ResidualParts, nuisances_of
from pre_core.crossing.off_bridge import rear_axle_samples_m
from pre_core.crossing.preparation import replace_mismatch
from pre_core.crossing.response_surface import response_surface
from pre_core.crossing.surface_posterior import curved_coordinates, surface_points
from pre_core.fusion.curvature import CurvatureTerms, linearise_with_curvature
from pre_core.fusion.linearised import of_optimum, of_surface
from pre_core.fusion.long_waves import (
    OffBridgeMismatch,
    add_adjacent_prior,
    covariance_of_all,
    knots_of,
    off_bridge_mismatch,
    short_wave_part,
    white_knots,
)
from pre_core.fusion.short_waves import ShortWaveResponse, short_wave_response
from pre_core.search import levenberg_marquardt

_ROUNDED = 1e-12
"""Eigenvalue of the precision, relative to the largest, below which it counts as zero."""
_SEED = 1


class Coordinates(NamedTuple):
    """Names, nominal values and scales (k,) of entries of x, which for elements are location/EI."""

    names: tuple[str, ...]
    location: FloatArray
    """Nominal values."""
    scale: FloatArray
    is_log: NDArray[np.bool_]
    """Flags (k,): x = ln(value/location)/scale; otherwise x = value/scale. Not for elements."""


class CrossingLikelihood(NamedTuple):
    """The log-likelihood -|root x - target|²/2 of x = (bridge, truck, coefficients of d in mm)."""

    root: FloatArray  # (m, m) upper triangular
    target: FloatArray  # (m,)
    bridge: Coordinates
    truck: Coordinates
    knots_m: FloatArray
    """Knots (q,) of the long waves of d; empty where both axles follow one profile."""
    level_m3: FloatArray  # (s,) levels of the mismatch on the bridge as the crossing estimates them
    off_bridge: OffBridgeMismatch | None
    bends: CurvatureTerms | None = None
    """Curvature terms; with them x continues with the longitudinal offset in m and the terms."""
    short_waves: ShortWaveResponse | None = None


def likelihood(
    found: Optimum, *, with_bends: bool = True, points: FloatArray | None = None
) -> CrossingLikelihood:
    """Return the likelihood at an optimum.

    Without `with_bends` it has no curvature terms, no offset and no response to short waves. The
    terms are of a surface fitted at `points` (k, n + 1), see `PosteriorDraws`; None: new draws.
    """
    problem, state = _in_fusion(found)
    where, mismatch = posterior.layout(problem), found.problem.mismatch
    differs = bool(mismatch.level_m3.any())
    grid, inner = np.zeros(0), np.zeros(0, dtype=np.int64)
    if differs:
        grid, inner = knots_of(problem, state.y)
    bridge = where.bridge
    truck = np.concatenate(
        [np.setdiff1d(np.arange(where.theta.stop), bridge), [where.wheelbase, where.common_gain]]
    )
    kept = np.concatenate([bridge, truck])
    rows = without_priors(problem, state.residual.size, kept)
    waves = np.zeros((rows.size, grid.size))
    if differs:
        white = white_knots(problem, state.y, grid)
        waves[: white.shape[0]] = white
    bends, others = None, state.y.size - kept.size
    if differs and with_bends:
        prior = np.asarray(np.linalg.inv(covariance_of_all(mismatch, grid)))
        parts = ResidualParts(bridge, truck, rows, waves, prior)
        given = surface_points(found, 1.0, _SEED) if points is None else points
        curved = curved_coordinates(found)
        given = given[:, np.append(np.searchsorted(curved, bridge), curved.size)]
        of = nuisances_of(found, problem, state.jacobian, parts, given)
        surface = response_surface(of, state.jacobian, given, for_fusion=True)
        bends, linearised = of_surface(surface, posterior.rigidity_spread(problem.priors))
        others = 0
    else:
        linearised = of_optimum(problem, state, rows, kept, waves)
    jacobian, residual, centre = linearised
    # The correction of the gradient is in the rows of the priors, which are excluded.
    slope = np.zeros(centre.size)
    slope[: kept.size] = np.pad(problem.noise_slope, (0, state.y.size))[kept]
    precision = jacobian.T @ jacobian
    linear = precision @ centre - jacobian.T @ residual + slope
    if differs:
        add_adjacent_prior(precision, mismatch, grid, inner, kept.size)
    outer = kept.size + np.setdiff1d(np.arange(grid.size), inner)
    shared = np.setdiff1d(np.arange(centre.size - others), outer)
    precision, linear = marginal(precision, linear, shared)
    if differs:
        precision, linear = _with_mismatch_bias(found, precision, linear, truck)
    return CrossingLikelihood(
        *_as_root(precision, linear),
        _coordinates(problem, bridge),
        _coordinates(problem, truck),
        grid[inner],
        mismatch.level_m3[:TRACK_SHAPES] * long_wave_power(mismatch),
        off_bridge_mismatch(found) if differs else None,
        bends,
        _response_to_short_waves(found) if differs and with_bends else None,
    )


def _in_fusion(
    found: Optimum,
) -> tuple[posterior.PosteriorProblem, levenberg_marquardt.LMState]:
    """Return problem and state at an optimum, with the noise that a run in a fusion has.

    Long waves of the mismatch are parameters, and the noise from a tandem's front axles is
    shared.
    """
    problem, y = found.problem, found.state.y
    differs = bool(problem.mismatch.level_m3.any())
    if not (differs or posterior.has_tandem(problem)):
        return problem, found.state
    short = short_wave_part(problem.mismatch) if differs else None
    problem = replace_mismatch(problem, y, short, front_axles.RUNS)
    state = levenberg_marquardt.initial_state(lambda at: posterior.all_rows(problem, at), y)
    return problem, state


def _with_mismatch_bias(
    found: Optimum, precision: FloatArray, linear: FloatArray, truck: NDArray[np.int64]
) -> tuple[FloatArray, FloatArray]:
    """Return precision (n, n) and linear part (n,) with the uncertainty of the mismatch bias.

    `truck` (t,) are the truck's indices in y; the bias of other parameters is neglected.
    """
    b = posterior.layout(found.problem).bridge.size
    led = np.zeros(linear.size)
    led[b : b + truck.size] = mismatch_bias(found)[truck]
    return add_covariance(precision, linear, led[:, None], np.array([[MISMATCH_BIAS_SPREAD]]))


def linearised_likelihood(
    crossing: CrossingLikelihood, at: FloatArray, mismatch: FloatArray
) -> CrossingLikelihood:
    """Return the normal about a bridge `at` (b,) in its coordinates, without offset and terms.

    `mismatch` is the precision (q, q) of the coefficients of d, on which the offset depends.
    """
    if crossing.bends is None:
        return crossing
    truck = len(crossing.truck.names)
    q = crossing.knots_m.size
    priors = np.zeros((truck + q, truck + q))
    priors[:truck, :truck] = np.eye(truck)
    priors[truck:, truck:] = mismatch
    root, target = linearise_with_curvature(
        crossing.root, crossing.target, crossing.bends, at, priors
    )
    return crossing._replace(root=root, target=target, bends=None)


def in_coordinates(
    crossing: CrossingLikelihood, coordinates: Coordinates, elements: int
) -> CrossingLikelihood:
    """Return the likelihood for other nominal values and spreads of the bridge's parameters.

    These are the same parameters in the same order, `elements` of them last.
    """
    mine = crossing.bridge
    b = len(mine.names)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = coordinates.location / mine.location
        aside = np.where(mine.is_log, np.log(ratio) / mine.scale, 0.0)
    factor = coordinates.scale / mine.scale
    # EI is location/x, so x scales with the location.
    factor[b - elements :] = 1.0 / ratio[b - elements :]
    aside[b - elements :] = 0.0
    root, bends = crossing.root.copy(), crossing.bends
    slope, shift = factor.copy(), aside
    if bends is not None and bends.logarithms:
        # Here c enters as its logarithm, which is shifted.
        slope[b - elements :] = 1.0
        shift = aside.copy()
        shift[b - elements :] = -np.log(ratio[b - elements :])
    target = crossing.target - root[:, :b] @ shift
    root[:, :b] *= slope
    if bends is not None:
        bends = bends._replace(
            about=(bends.about - aside) / factor,
            directions=bends.directions / np.append(slope, 1.0)[:, None],
        )
    short = crossing.short_waves
    if short is not None:
        by = 1.0 / factor[:, None]
        short = short._replace(cosine=by * short.cosine, sine=by * short.sine)
    return crossing._replace(
        root=root, target=target, bridge=coordinates, bends=bends, short_waves=short
    )


def add_covariance(
    precision: FloatArray, linear: FloatArray, along: FloatArray, root: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return precision (n, n) and linear part (n,) of a normal with more covariance along columns.

    The columns `along` (n, r) add A S A' to the covariance; `root` (r, r) is a root of S, S = root
    root'. The precision may be singular.
    """
    moved = along @ root
    across = precision @ moved
    inner = np.eye(root.shape[1]) + moved.T @ across
    factor = cho_factor(inner, lower=True)
    return (
        precision - across @ cho_solve(factor, across.T),
        linear - across @ cho_solve(factor, moved.T @ linear),
    )


def _response_to_short_waves(found: Optimum) -> ShortWaveResponse:
    return short_wave_response(found, rear_axle_samples_m(found.problem, found.state.y))


def _as_root(precision: FloatArray, linear: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return upper triangular R and z with R'R the precision and R'z the linear part."""
    values, vectors = np.linalg.eigh(0.5 * (precision + precision.T))
    kept = values > _ROUNDED * values[-1]
    size = np.sqrt(np.where(kept, values, 1.0))
    rows = np.where(kept, size, 0.0)[:, None] * vectors.T
    target = np.where(kept, vectors.T @ linear, 0.0) / size
    (both,) = qr(np.column_stack([rows, target]), mode="r")
    m = linear.size
    return np.asarray(both[:m, :m]), np.asarray(both[:m, m])


def _coordinates(problem: posterior.PosteriorProblem, places: NDArray[np.int64]) -> Coordinates:
    """Return the coordinates at indices of y; wheelbase and common gain come last."""
    priors, where = problem.priors, posterior.layout(problem)
    elements = parameters.element_count(priors.theta)
    table = parameters.table(elements, problem.crossing.tandem.front.share.size + 1)
    kept = np.flatnonzero(priors.estimated)
    of_truck = {
        where.wheelbase: ("wheelbase", priors.wheelbase_m, priors.wheelbase_spread),
        where.common_gain: ("common_gain", 1.0, posterior.common_gain_spread(priors)),
    }
    rows = [
        of_truck.get(int(place))
        or (table[kept[place]].name, priors.theta[kept[place]], priors.spread[kept[place]])
        for place in places
    ]
    names, location, scale = zip(*rows, strict=True)
    zero = np.isin(places, where.half_normal)
    return Coordinates(names, np.array(location, float), np.array(scale, float), ~zero)
