"""Crossings that are ready to be added, and their sum with the priors, each once."""

from collections.abc import Collection, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pre_core.fusion.likelihood import Coordinates
from pre_core.fusion.tracks import Key, Shared

FloatArray = NDArray[np.float64]

_ROUGH_SPREAD = 0.6
"""A normal prior of c that stands for the log-normal one where evidence is compared."""
_ROUNDED = 1e-10


class BridgePriors(NamedTuple):
    """In the order of the likelihoods' coordinates of the bridge, which have `elements` last."""

    coordinates: Coordinates
    mass_powers: FloatArray  # (b,)
    log_odds: FloatArray  # (b,) of being exactly zero; `posterior.log_odds_of_absence`
    elements: int


class Layout(NamedTuple):
    """Where among all unknowns stand those of the bridge, of each truck, of each track."""

    bridge: int
    elements: NDArray[np.int64]
    trucks: dict[str, NDArray[np.int64]]
    """The truck's coordinates, the error of its mass last."""
    tracks: dict[Key, NDArray[np.int64]]
    size: int


class Ready(NamedTuple):
    """A crossing's likelihood with what is its own of the long waves integrated out."""

    precision: FloatArray
    linear: FloatArray
    places: NDArray[np.int64]
    """Where its coordinates are among all."""


class Joint(NamedTuple):
    """Crossings that are ready to be added."""

    names: tuple[str, ...]
    layout: Layout
    ready: tuple[Ready, ...]
    prior: FloatArray
    """Precision (n, n) of trucks and tracks before any crossing."""
    centre: FloatArray
    """(b,) about which the bridge's unknowns are: changes of compliances are relative to it."""
    shared: tuple[Shared, ...]

    def of(self, names: Collection[str] | None) -> tuple[Ready, ...]:
        """The crossings of these names; None: all."""
        if names is None:
            return self.ready
        ready = zip(self.names, self.ready, strict=True)
        return tuple(one for name, one in ready if name in names)


def sum_of(
    joint: Joint, priors: BridgePriors, ready: Sequence[Ready]
) -> tuple[FloatArray, FloatArray]:
    """Precision and linear part of all unknowns, with normal priors of the bridge's."""
    return with_priors(joint, priors, *told(joint, ready))


def with_priors(
    joint: Joint, priors: BridgePriors, precision: FloatArray, linear: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """A sum of crossings with normal priors of the bridge's unknowns."""
    layout = joint.layout
    precision, linear = precision.copy(), linear.copy()
    single = np.arange(layout.bridge - priors.elements)
    precision[single, single] += 1.0
    rough = _ROUGH_SPREAD**-2
    precision[layout.elements, layout.elements] += rough
    linear[layout.elements] += rough
    return precision, linear


def told(joint: Joint, ready: Sequence[Ready]) -> tuple[FloatArray, FloatArray]:
    """Precision and linear part of all unknowns, without priors of the bridge's."""
    precision, linear = joint.prior.copy(), np.zeros(joint.layout.size)
    for one in ready:
        precision[np.ix_(one.places, one.places)] += one.precision
        linear[one.places] += one.linear
    return precision, linear


def own_change(
    across: FloatArray,
    precision: FloatArray,
    linear: FloatArray,
    whole: tuple[FloatArray, FloatArray],
) -> tuple[FloatArray, FloatArray]:
    """Precision (e, e) and linear part (e,) of how coordinates of one crossing differ from all.

    Of it alone they are `precision` and `linear`, and `across` (n, e) is how all n unknowns go with
    them; `whole` are precision and linear part of the sum of all, this one included.
    """
    explained = np.linalg.solve(whole[0], np.column_stack([across, whole[1]]))
    told = precision - across.T @ explained[:, :-1]
    return 0.5 * (told + told.T), linear - across.T @ explained[:, -1]


def squared_distance(linear: FloatArray, spread: FloatArray) -> float:
    """Squared distance from zero of a linear part (e,) with the covariance `spread` (e, e)."""
    return float(linear @ np.linalg.pinv(spread, _ROUNDED, hermitian=True) @ linear)
