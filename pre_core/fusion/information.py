"""Information of crossings, and its sum with the priors, each of which is counted once."""

from collections.abc import Collection, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pre_core.arrays import FloatArray
from pre_core.fusion.likelihood import Coordinates
from pre_core.fusion.path_groups import PathGroupKey, SharedMismatch

_ROUGH_SPREAD = 0.6
"""Standard deviation of a normal prior of c that replaces the log-normal one in evidence ratios."""
_ROUNDED = 1e-10
"""Eigenvalue of a covariance, relative to the largest, below which it counts as zero."""


class BridgePriors(NamedTuple):
    """Priors in the order of the likelihoods' bridge coordinates; the last `elements` are EI."""

    coordinates: Coordinates
    mass_powers: FloatArray  # (b,)
    log_odds: FloatArray  # (b,) of absence; `posterior.log_odds_of_absence`
    elements: int


class JointLayout(NamedTuple):
    """Indices of the bridge, of each truck and of each wheel-path group among all coordinates."""

    bridge: int
    elements: NDArray[np.int64]
    trucks: dict[str, NDArray[np.int64]]
    """Coordinates of each truck, the error of its mass last."""
    tracks: dict[PathGroupKey, NDArray[np.int64]]
    size: int


class CrossingInformation(NamedTuple):
    """A crossing's likelihood with its own part of the long waves integrated out."""

    precision: FloatArray  # (s, s)
    linear: FloatArray  # (s,): precision times the estimate
    places: NDArray[np.int64]
    """Indices (s,) of its coordinates among all."""


class JointInformation(NamedTuple):
    """Information of several crossings in n common coordinates."""

    names: tuple[str, ...]
    layout: JointLayout
    crossings: tuple[CrossingInformation, ...]
    prior: FloatArray
    """Prior precision (n, n) of trucks and wheel-path groups."""
    centre: FloatArray
    """Bridge coordinates (b,) to which changes of compliances are relative."""
    shared: tuple[SharedMismatch, ...]

    def select(self, names: Collection[str] | None) -> tuple[CrossingInformation, ...]:
        """Return the crossings of these names; None: all."""
        if names is None:
            return self.crossings
        crossings = zip(self.names, self.crossings, strict=True)
        return tuple(one for name, one in crossings if name in names)


def posterior_information(
    information: JointInformation, priors: BridgePriors, crossings: Sequence[CrossingInformation]
) -> tuple[FloatArray, FloatArray]:
    """Return precision (n, n) and linear part (n,) of `crossings` with all priors."""
    return add_bridge_priors(information, priors, *sum_information(information, crossings))


def add_bridge_priors(
    information: JointInformation, priors: BridgePriors, precision: FloatArray, linear: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return precision (n, n) and linear part (n,) plus normal priors of the bridge."""
    layout = information.layout
    precision, linear = precision.copy(), linear.copy()
    single = np.arange(layout.bridge - priors.elements)
    precision[single, single] += 1.0
    rough = _ROUGH_SPREAD**-2
    precision[layout.elements, layout.elements] += rough
    linear[layout.elements] += rough
    return precision, linear


def sum_information(
    information: JointInformation, crossings: Sequence[CrossingInformation]
) -> tuple[FloatArray, FloatArray]:
    """Return precision (n, n) and linear part (n,) of `crossings` without priors of the bridge."""
    precision, linear = information.prior.copy(), np.zeros(information.layout.size)
    for one in crossings:
        precision[np.ix_(one.places, one.places)] += one.precision
        linear[one.places] += one.linear
    return precision, linear


def leave_one_out_change(
    across: FloatArray,
    precision: FloatArray,
    linear: FloatArray,
    whole: tuple[FloatArray, FloatArray],
) -> tuple[FloatArray, FloatArray]:
    """Return precision (e, e) and linear part (e,) of one crossing's change from all others.

    `precision` (e, e), `linear` (e,) and `across` (n, e) are the crossing's own, the last between
    its change and all n coordinates; `whole` are precision (n, n) and linear part (n,) of the sum
    of all crossings, this one included.
    """
    explained = np.linalg.solve(whole[0], np.column_stack([across, whole[1]]))
    conditional = precision - across.T @ explained[:, :-1]
    return 0.5 * (conditional + conditional.T), linear - across.T @ explained[:, -1]


def squared_distance(linear: FloatArray, spread: FloatArray) -> float:
    """Return the squared Mahalanobis distance from zero of a linear part with covariance (e, e)."""
    return float(linear @ np.linalg.pinv(spread, _ROUNDED, hermitian=True) @ linear)
