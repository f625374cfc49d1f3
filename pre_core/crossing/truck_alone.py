"""Truck and road without the bridge: a fit of the residuals before and behind it alone.

Off the bridge the model has no bridge in it. Where one profile, linear springs and the declared
noise explain these residuals, neither friction nor mismatch is the cause of a misfit on the bridge.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pre_core.crossing.fit import (
    evaluations_of,
    is_accepted_chi2,
    lower_bounds,
    tempered_residuals,
)
from pre_core.crossing.noise import no_force_noise
from pre_core.crossing.off_bridge import off_bridge_residuals
from pre_core.crossing.posterior import PosteriorProblem, layout
from pre_core.crossing.preparation import update_noise
from pre_core.crossing.rows import RESIDUALS
from pre_core.physics.bridge import FloatArray
from pre_core.search.levenberg_marquardt import LMInfo, LMState, minimise
from pre_core.search.loop import SearchResult

_STAGES = ((300.0, 4, 0.5), (100.0, 4, 0.5), (30.0, 4, 0.5), (5.0, 6, 0.5), (1.0, 12, 0.5))
"""Temperatures, steps at each, and the gain in the sum of squares that ends it."""
_FEWEST = 60
"""Fewest residuals of each kind off the bridge that judge the truck: ten periods of an axle."""
_SPREADS = 2.0
"""Margin about the bridge's ends, in standard deviations of the receiver's slow error."""


class OffBridgeFit(NamedTuple):
    """Fit of truck and road to the residuals off the bridge, with one profile."""

    chi2_per_dof: float
    """Reduced chi-square of the judged residuals off the bridge; NaN where these are too few."""
    is_accepted: bool
    """Whether the model explains them."""
    problem: PosteriorProblem
    """The problem with the noise at y."""
    y: FloatArray
    evaluations: int


def fit_off_bridge(
    problem: PosteriorProblem, y: FloatArray, *, uses_suspension: bool = True
) -> OffBridgeFit:
    """Fit all but the bridge from y (size,) to the residuals off it.

    Without `uses_suspension` the suspension has the weight that its residuals allow, and only the
    profiles are judged.
    """
    off = off_bridge_mask(problem, y)
    if off.sum() < RESIDUALS * _FEWEST:
        return OffBridgeFit(np.nan, False, problem, y, 0)
    force = no_force_noise() if uses_suspension else None
    problem = update_noise(problem, y, force, mismatch=np.zeros_like(problem.mismatch.level_m3))
    where = layout(problem)
    held = np.union1d(where.bridge, np.arange(where.swing.start, where.swing.stop))
    free = np.delete(np.eye(y.size), held, axis=1)
    others = problem.receiver_values.size + where.trajectory.start
    kept = np.flatnonzero(np.concatenate([off, np.full(others, True)]))
    evaluations = 0
    for stage in _STAGES:
        found = _fit_at(problem, y, free, kept, stage)
        evaluations += evaluations_of(found)
        y = y + free @ found.state.y
        problem = update_noise(problem, y, force)
    stride = 1 if uses_suspension else RESIDUALS
    count = int(off.sum())
    white = found.state.residual[:count:stride]
    # Coordinates that only their priors determine take no degree of freedom.
    informed, _ = np.linalg.qr(found.state.jacobian)
    taken = float(np.sum(informed[:count:stride] ** 2))
    chi2 = float(white @ white) / max(1.0, white.size - taken)
    return OffBridgeFit(chi2, is_accepted_chi2(chi2, white.size), problem, y, evaluations)


def _fit_at(
    problem: PosteriorProblem,
    y: FloatArray,
    free: FloatArray,
    kept: NDArray[np.int64],
    stage: tuple[float, int, float],
) -> SearchResult[LMState, LMInfo]:
    """Fit the `kept` residuals along `free` (size, d) at a temperature."""
    temperature, steps, enough = stage
    rows = tempered_residuals(problem, y, free, temperature)
    lower = lower_bounds(problem, y, free, is_free=True)
    start = np.zeros(free.shape[1])
    return minimise(lambda v: rows(v)[:, kept], start, steps, enough, lower, is_followed=True)


def off_bridge_mask(problem: PosteriorProblem, y: FloatArray) -> NDArray[np.bool_]:
    """Return which whitened residuals (3 m,) neither see the bridge nor follow some that do."""
    apart_m = problem.rows.every * problem.rows.step_s * problem.mismatch.speed_m_per_s
    margin = int(np.ceil(_SPREADS / problem.receiver_rows[-1, -1] / apart_m))
    # A whitened residual contains the ones before it, as far as the filter reaches.
    reach = -(-problem.noise.factor.shape[1] // RESIDUALS)
    before, behind = off_bridge_residuals(problem, y)
    rows = np.zeros(problem.noise.reciprocal.size // RESIDUALS, dtype=np.bool_)
    rows[: max(0, before.stop - margin)] = True
    rows[behind.start + margin + reach :] = True
    return np.repeat(rows, RESIDUALS)
