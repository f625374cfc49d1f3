"""Detection of crossings that contradict the others of the same bridge.

Each crossing gets its own change of the bridge's compliances, with everything else as all others
determine it. The uncertainty of that change follows from the crossing and the others, and from the
bridge's variability. This is unknown before outliers, which resemble variability, are removed: so
crossings are first tested with a usual one. Outliers, at most a third of all, are accepted again if
the variability of the others explains them. The most consistent crossings show too little
variability, and each accepted one adds to it, so this repeats until none is accepted. The others
are excluded.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

from pre_core.arrays import FloatArray
from pre_core.fusion.information import (
    BridgePriors,
    CrossingInformation,
    JointInformation,
    leave_one_out_change,
    posterior_information,
    squared_distance,
)
from pre_core.fusion.joint import build_joint
from pre_core.fusion.path_groups import FusionInput
from pre_core.fusion.variability import variability_posterior

_USUAL_CHANGE = 0.03
"""Relative standard deviation of every element between crossings, added to the estimated one."""
_SUSPICIOUS, _INCOMPATIBLE = 1e-3, 1e-4
"""Limits of the probability that the worst of all crossings is as far away. Below the first one a
crossing is tested with the variability of the others; below the second one it is then excluded."""
_FEWEST = 3
"""Fewest crossings of which one can be excluded: of two that contradict each other either may be
wrong; of more, a third may be."""
_NEGLIGIBLE_WEIGHT = 1e-6
"""Posterior weight of a value of the variability below which it is omitted."""


class ConsistencyResult(NamedTuple):
    """Names of the consistent and of the excluded crossings."""

    consistent: tuple[str, ...]
    excluded: tuple[str, ...]
    is_contradictory: bool
    """Whether the kept crossings contradict each other and are too few to show which is wrong."""


def select_consistent(
    parts: Sequence[FusionInput], information: JointInformation, priors: BridgePriors
) -> ConsistencyResult:
    """Return the consistent and the excluded crossings of `information`."""
    names = information.names
    if len(names) == 1:
        return ConsistencyResult(names, (), False)
    nothing_more = np.array([[0.0, 0.0, 1.0]])
    chances = np.array(_tail_probabilities(information, priors, names, names, nothing_more))
    if len(names) < _FEWEST:
        return ConsistencyResult(names, (), bool(chances.min() < _SUSPICIOUS / len(names)))
    worst = np.argsort(chances)[: len(names) // _FEWEST]
    excluded = {names[i] for i in worst if chances[i] < _SUSPICIOUS / len(names)}
    if excluded:
        # An outlier must not affect the estimated variability.
        information = build_joint(parts, priors, consistent=set(names) - excluded)
    back = excluded
    while excluded and back:
        inside = [name for name in names if name not in excluded]
        found = variability_posterior(
            information._replace(crossings=information.select(inside)), priors
        )
        changes = np.column_stack([found.tau, found.rho, found.weight])[
            found.weight > _NEGLIGIBLE_WEIGHT
        ]
        of = zip(
            sorted(excluded),
            _tail_probabilities(information, priors, sorted(excluded), inside, changes),
            strict=True,
        )
        back = {name for name, chance in of if chance >= _INCOMPATIBLE / len(names)}
        excluded = excluded - back
    consistent = tuple(name for name in names if name not in excluded)
    return ConsistencyResult(consistent, tuple(sorted(excluded)), False)


def _tail_probabilities(
    information: JointInformation,
    priors: BridgePriors,
    names: Sequence[str],
    reference: Sequence[str],
    changes: FloatArray,
) -> list[float]:
    """Return for each of `names` the probability of its distance from `reference`, without itself.

    `changes` (k, 3) are tau, rho, and their probability. A usual change, independent for each
    element, is always added, however small the variability of the others.
    """
    elements = information.layout.elements
    precision, linear = posterior_information(information, priors, information.select(reference))
    at = np.diag(information.centre[elements])
    out = []
    for name, one in zip(names, information.select(names), strict=True):
        whole, pull = precision, linear
        if name not in reference:
            whole, pull = posterior_information(
                information, priors, [*information.select(reference), one]
            )
        sharp, need = _crossing_change(one, whole, pull, elements)
        chance = 0.0
        for tau, rho, weight in changes:
            own = _USUAL_CHANGE**2 + (1.0 - rho) * tau**2
            change = at @ (own * np.eye(elements.size) + rho * tau**2) @ at
            spread = sharp + sharp @ change @ sharp
            chance += float(weight * chdtrc(elements.size, squared_distance(need, spread)))
        out.append(chance)
    return out


def _crossing_change(
    one: CrossingInformation, precision: FloatArray, linear: FloatArray, elements: NDArray[np.int64]
) -> tuple[FloatArray, FloatArray]:
    """Return precision (e, e) and linear part (e,) of a crossing's own change of the compliances.

    They follow from the sum of all crossings, this one included. Trucks, wheel-path groups and the
    other bridge parameters have the values that all other crossings determine, so that poorly
    determined ones do not count.
    """
    across = np.zeros((linear.size, elements.size))
    across[one.places] = one.precision[:, elements]
    own = one.precision[np.ix_(elements, elements)]
    return leave_one_out_change(across, own, one.linear[elements], (precision, linear))
