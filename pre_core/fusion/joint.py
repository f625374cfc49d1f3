"""One bridge from the likelihoods of several crossings: each prior once, the common mismatch apart.

Runs of one truck in one track share a part of the mismatch of its axles' roads, which no number of
them averages out. It is a Gaussian process along the road, with its values at knots among the
unknowns; they are integrated out together with everything else that is normal.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pre_core.crossing import posterior
from pre_core.crossing.compliances import draws, marginal, of_normal
from pre_core.crossing.mismatch import LONG_CYCLES_PER_M, MEMORY_M, Mismatch, common_shapes
from pre_core.crossing.optimum import Optimum
from pre_core.fusion.likelihood import Likelihood, knots, likelihood, mismatch_off_bridge
from pre_core.search.crank_nicolson import CHAINS
from pre_core.unknowns import EI_1, FIRST_OF_BRIDGE

FloatArray = NDArray[np.float64]

_GRID_M = 0.1
_APART_M = 0.5
"""Step of the second difference by which the common share is read: waves of half a metre to two."""
_WANDERS_M, _HALVINGS = (0.01, 1.0), 12
_LAG_M = 0.01
_JITTER = 1e-6


class Fused(NamedTuple):
    """Draws of the bridge's unknowns in the coordinates of `posterior`, and how they were made."""

    draws: FloatArray  # (n, chains, b): the bridge's, elements last
    common_share: float
    """What all runs have in common of the mismatch's power at waves of 20 m."""
    wander_m: float | None
    """How far the runs' tracks lie beside each other; None where that does not matter."""
    level_m3: FloatArray  # (s,)


def common_share(runs: Sequence[Optimum]) -> float:
    """Which part of the mismatch's short waves the runs have in common, by rows off the bridge."""
    if len(runs) < 2:
        return 0.0
    x = np.arange(-60.0, max(run.problem.crossing.span_m for run in runs) + 60.0, _GRID_M)
    step = round(_APART_M / _GRID_M)
    bent = []
    for run in runs:
        d = mismatch_off_bridge(run, x)
        bent.append(d[2 * step :] - 2.0 * d[step:-step] + d[: -2 * step])
    together = power = 0.0
    for i in range(len(bent)):
        for j in range(i):
            both = np.isfinite(bent[i]) & np.isfinite(bent[j])
            together += float(bent[i][both] @ bent[j][both])
            power += 0.5 * float(bent[i][both] @ bent[i][both] + bent[j][both] @ bent[j][both])
    return float(np.clip(together / power, 0.0, 1.0)) if power > 0.0 else 0.0


def wander(mismatch: Mismatch, share: float) -> float:
    """How far, in m, runs lie beside each other that have this `share` of short waves in common."""
    shapes = mismatch.shapes
    n = shapes.cycles_per_m
    # As the second differences of `common_share` see the waves.
    seen = np.sin(np.pi * n * _APART_M) ** 4
    whole = float(mismatch.level_m3 @ shapes.density @ seen)

    def of(wander_m: float) -> float:
        common = common_shapes(*shapes.footprints, wander_m)
        return float(mismatch.level_m3 @ common @ seen) / whole

    low, high = _WANDERS_M
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if of(middle) > share else (low, middle)
    return 0.5 * (low + high)


def covariance(grid: FloatArray, density: FloatArray, apart_m: FloatArray) -> FloatArray:
    """Covariance in m² at places `apart_m` from each other of a density (g,) on an even grid."""
    step = grid[1] - grid[0]
    weight = np.full(grid.size, step)
    weight[0] *= 0.5
    lags = np.arange(0.0, MEMORY_M + _LAG_M, _LAG_M)
    table = np.cos(2.0 * np.pi * np.outer(lags, grid)) @ (weight * density)
    return np.asarray(np.interp(apart_m, lags, table, right=0.0))


def fuse(runs: Sequence[Optimum], count: int, seed: int) -> Fused:
    """Draws of a bridge from runs of one truck in one direction: (count, chains, b).

    ValueError without runs.
    """
    if not runs:
        raise ValueError("no runs to fuse")
    whole = runs[0].problem.mismatch._replace(
        level_m3=np.mean([run.problem.mismatch.level_m3 for run in runs], axis=0)
    )
    shapes = whole.shapes
    common, places, wander_m = np.zeros_like(shapes.density), None, None
    if len(runs) > 1 and whole.level_m3.any():
        wander_m = wander(whole, common_share(runs))
        common = common_shapes(*shapes.footprints, wander_m)
        places = _places(runs)
    own = whole._replace(shapes=shapes._replace(density=shapes.density - common))
    parts = [
        likelihood(run, own._replace(speed_m_per_s=run.problem.mismatch.speed_m_per_s), places)
        for run in runs
    ]
    together = _together(parts, shapes.cycles_per_m, whole.level_m3 @ common, places)
    at_long = np.searchsorted(shapes.cycles_per_m, LONG_CYCLES_PER_M)
    densities = (whole.level_m3 @ common, whole.level_m3 @ shapes.density)
    share = float(densities[0][at_long] / densities[1][at_long]) if whole.level_m3.any() else 0.0
    return Fused(_drawn(together, runs[0], count, seed), share, wander_m, whole.level_m3)


def _places(runs: Sequence[Optimum]) -> FloatArray:
    fronts = [posterior.points(run.problem, run.state.y[None, :]).position_m[0] for run in runs]
    wheelbase = max(run.problem.priors.wheelbase_m for run in runs)
    begin = min(float(front.min()) for front in fronts) - wheelbase
    return knots(begin, max(float(front.max()) for front in fronts) + wheelbase)


def _together(
    parts: Sequence[Likelihood],
    grid: FloatArray,
    common: FloatArray,
    places: FloatArray | None,
) -> Likelihood:
    """The product of all, the common mismatch integrated out."""
    precision = np.sum([part.precision for part in parts], axis=0)
    linear = np.sum([part.linear for part in parts], axis=0)
    b = parts[0].bridge
    if places is None:
        return Likelihood(precision, linear, b)
    of_mm = 1e6 * covariance(grid, common, np.abs(places[:, None] - places[None, :]))
    of_mm += _JITTER * of_mm[0, 0] * np.eye(places.size)
    precision[b:, b:] += np.linalg.inv(of_mm)
    return Likelihood(*marginal(precision, linear, np.arange(b)), b)


def _drawn(all_runs: Likelihood, one: Optimum, count: int, seed: int) -> FloatArray:
    """Draws of the likelihood times the bridge's priors, each once."""
    problem = one.problem
    where = posterior.layout(problem)
    kept = np.flatnonzero(problem.priors.estimated)
    bridge = np.flatnonzero(kept >= FIRST_OF_BRIDGE)
    elements = np.searchsorted(bridge, where.elements)
    cut_off = np.searchsorted(bridge, np.intersect1d(where.half_normal, bridge))
    precision = all_runs.precision.copy()
    single = np.setdiff1d(np.arange(bridge.size), elements)
    precision[single, single] += 1.0
    of = of_normal(
        precision,
        all_runs.linear,
        elements,
        cut_off,
        problem.priors.spread[EI_1:][problem.priors.estimated[EI_1:]],
        posterior.log_odds_of_absence(problem)[bridge],
        1.0,
        np.ones(elements.size),
        np.zeros(bridge.size),
    )
    return np.stack([draws(of, count, seed, chain) for chain in range(CHAINS)], axis=1)
