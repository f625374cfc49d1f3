"""Variability of a bridge between crossings, beyond the uncertainty of each.

Every crossing has its own bridge: its compliances deviate from the common ones by a relative
standard deviation tau, of which a share rho is common to all elements. These changes are integrated
out; tau and rho are evaluated on a grid.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pre_core.arrays import FloatArray
from pre_core.crossing.splines import curves_at, interpolating_spline
from pre_core.fusion.information import (
    BridgePriors,
    CrossingInformation,
    JointInformation,
    add_bridge_priors,
    sum_information,
)

BETWEEN_SCALE = 0.04
"""Scale of the half-normal prior of tau: temperature changes a concrete bridge's EI by some per
cent."""
_TAUS = BETWEEN_SCALE * np.array(
    [0.0, 0.05, 0.1, 0.15, 0.2, 0.27, 0.36, 0.48, 0.64, 0.85, 1.1, 1.45, 1.9, 2.5, 3.2]
)
_RHOS = (0.0, 0.3, 0.7, 0.93, 0.99)
_FINE_POINTS = 12
"""Interpolated points in a grid cell of tau, whose posterior is narrower than a cell."""
_TAU_SHIFT = 0.002
"""Value added to tau before its logarithm, in which the evidence is smooth."""
_DENSITY_AT_95 = np.exp(-0.5 * 1.96**2)
"""Density of a normal at the ends of its 95 % interval, relative to its maximum."""


class VariabilityPosterior(NamedTuple):
    """Cell centres of tau and rho with their posterior weights, (k,) each."""

    tau: FloatArray
    rho: FloatArray
    weight: FloatArray
    fine: FloatArray
    """Points (cells, f) within the cells of tau."""
    within: FloatArray
    """Weights (k, f) of these points."""


class _SameLayout(NamedTuple):
    """The k crossings that have the same coordinates `places` (p,) among all."""

    places: NDArray[np.int64]
    across: FloatArray  # (k, e, p) rows of their precisions at the elements
    linear: FloatArray  # (k, e)


class VaryingBridge(NamedTuple):
    """The sum of all crossings, and the data to add a change of the bridge to each."""

    precision: FloatArray  # (n, n)
    linear: FloatArray  # (n,)
    alike: tuple[_SameLayout, ...]


def varying_bridge(information: JointInformation) -> VaryingBridge:
    """Return the crossings of `information`, grouped by coordinates."""
    elements = information.layout.elements
    alike: dict[bytes, list[CrossingInformation]] = {}
    for one in information.crossings:
        alike.setdefault(one.places.tobytes(), []).append(one)
    return VaryingBridge(
        *sum_information(information, information.crossings),
        tuple(
            _SameLayout(
                some[0].places,
                np.stack([one.precision[elements] for one in some]),
                np.stack([one.linear[elements] for one in some]),
            )
            for some in alike.values()
        ),
    )


def marginalise_variability(
    information: JointInformation, bridge: VaryingBridge, tau: float, rho: float
) -> tuple[FloatArray, FloatArray, float]:
    """Return precision (n, n) and linear part (n,) of all coordinates if the bridge varies.

    The third value is the change of the log evidence.
    """
    if tau == 0.0:
        return bridge.precision, bridge.linear, 0.0
    elements = information.layout.elements
    e = elements.size
    root = information.centre[elements][:, None] * change_root(e, tau, rho)
    precision, linear, evidence = bridge.precision.copy(), bridge.linear.copy(), 0.0
    for some in bridge.alike:
        across = root.T @ some.across
        pull = some.linear @ root
        factor = np.linalg.cholesky(np.eye(e) + across[:, :, elements] @ root)
        moved = np.linalg.solve(factor, np.concatenate([across, pull[:, :, None]], axis=2))
        rows = moved.reshape(-1, moved.shape[2])
        evidence += 0.5 * float(rows[:, -1] @ rows[:, -1])
        evidence -= float(np.log(np.diagonal(factor, axis1=1, axis2=2)).sum())
        precision[np.ix_(some.places, some.places)] -= rows[:, :-1].T @ rows[:, :-1]
        linear[some.places] -= rows[:, :-1].T @ rows[:, -1]
    return precision, linear, evidence


def change_root(elements: int, tau: float, rho: float) -> FloatArray:
    """Return a root (e, e) of the covariance of the elements' relative changes."""
    covariance = (1.0 - rho) * np.eye(elements) + rho
    return np.asarray(np.linalg.cholesky(covariance) * tau)


def variability_posterior(
    information: JointInformation, priors: BridgePriors
) -> VariabilityPosterior:
    """Return the posterior of tau and rho; for one crossing it is the prior."""
    tau, rho = (grid.ravel() for grid in np.meshgrid(_TAUS, _RHOS, indexing="ij"))
    log = np.empty(tau.size)
    of = varying_bridge(information)
    for k in range(tau.size):
        precision, linear, log[k] = marginalise_variability(
            information, of, float(tau[k]), float(rho[k])
        )
        precision, linear = add_bridge_priors(information, priors, precision, linear)
        factor = np.linalg.cholesky(precision)
        at = np.linalg.solve(factor, linear)
        log[k] += 0.5 * float(at @ at) - float(np.log(np.diag(factor)).sum())
    fine, within = _fine_taus(log.reshape(_TAUS.size, -1))
    return VariabilityPosterior(
        tau, rho, within.sum(axis=2).ravel(), fine, within.reshape(tau.size, -1)
    )


def _fine_taus(log: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return points in each cell of tau (t, f), and their weights (t, r, f) for each rho.

    They follow from the log evidence (t, r), which is smooth between the cells; each sum is one.
    """
    edges = _edges()
    part = (np.arange(_FINE_POINTS) + 0.5) / _FINE_POINTS
    fine = edges[:-1, None] + np.diff(edges)[:, None] * part
    smooth = interpolating_spline(np.log(_TAUS + _TAU_SHIFT), log, 3)
    density = curves_at(smooth, np.log(fine.ravel() + _TAU_SHIFT)).reshape(*fine.shape, -1)
    density -= 0.5 * (fine[:, :, None] / BETWEEN_SCALE) ** 2
    weight = np.exp(density - density.max()) * np.diff(edges)[:, None, None]
    return fine, np.moveaxis(weight / weight.sum(), 2, 1)


def is_consistent_with_zero(between: VariabilityPosterior) -> bool:
    """Return whether zero variability is about as likely as the most likely value."""
    density = between.within.reshape(_TAUS.size, len(_RHOS), _FINE_POINTS).sum(axis=1)
    density /= np.diff(_edges())[:, None]
    return bool(density[0, 0] > _DENSITY_AT_95 * density.max())


def _edges() -> FloatArray:
    """Return the boundaries between the grid cells of tau."""
    return np.concatenate([[0.0], 0.5 * (_TAUS[1:] + _TAUS[:-1]), [_TAUS[-1]]])


def mean_variability(between: VariabilityPosterior) -> tuple[float, float]:
    """Return the root of the mean square of tau, and the mean share rho of those squares."""
    tau_squared = np.sum(between.within * between.fine[_cells(between)] ** 2, axis=1)
    total = float(np.sum(tau_squared))
    return float(np.sqrt(total)), float(tau_squared @ between.rho) / total


def draws_of_tau(between: VariabilityPosterior, count: int, rng: np.random.Generator) -> FloatArray:
    """Return draws (count,) of tau, over all cells."""
    fine = between.fine[_cells(between)]
    return np.asarray(rng.choice(fine.ravel(), count, p=between.within.ravel()))


def _cells(between: VariabilityPosterior) -> NDArray[np.int64]:
    return np.arange(between.tau.size) // len(_RHOS)


def draws_of_tau_within(
    between: VariabilityPosterior, k: int, shape: tuple[int, int], rng: np.random.Generator
) -> FloatArray:
    """Return draws of tau (…) in cell k, of the given shape."""
    share = between.within[k] / between.within[k].sum()
    return np.asarray(rng.choice(between.fine[k // len(_RHOS)], shape, p=share))
