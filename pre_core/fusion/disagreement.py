"""Which of several crossings of a bridge cannot be of the same bridge as the others.

Each crossing is given a change of the bridge's compliances of its own, all else as all others say.
What it tells of that change is as sure as it and they are, and a bridge changes between crossings.
By how much is not known before the odd one is out, which would pass for change: so crossings are
first judged by a usual one. Those that stand out then, a third of all at most, come back if the
change that those inside show explains them; and as those that agree best show too little change,
and each that comes back shows more of it, this goes on until none comes back. The rest is left out.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

from pre_core.fusion.between import between_of
from pre_core.fusion.joint import join
from pre_core.fusion.sums import BridgePriors, Joint, Ready, own_change, squared_distance, sum_of
from pre_core.fusion.tracks import Part

FloatArray = NDArray[np.float64]

_USUAL_CHANGE = 0.03
_SUSPICIOUS, _INCOMPATIBLE = 1e-3, 1e-4
"""Probabilities that one of all crossings is as far off as this by chance: to be looked at with the
change that the others show, and then to be left out."""
_FEWEST = 3
"""Of two that disagree nobody knows which is wrong; of more, a third may be."""
_UNLIKELY = 1e-6


class Judged(NamedTuple):
    """The crossings' names, by what became of them."""

    agree: tuple[str, ...]
    left_out: tuple[str, ...]
    disagree: bool
    """Those that are kept do not agree, and too few are there to say more."""


def judge(parts: Sequence[Part], joint: Joint, priors: BridgePriors) -> Judged:
    """Which of the crossings, of which `joint` is, to fuse."""
    names = joint.names
    if len(names) == 1:
        return Judged(names, (), False)
    nothing_more = np.array([[0.0, 0.0, 1.0]])
    chances = np.array(_chances(joint, priors, names, names, nothing_more))
    if len(names) < _FEWEST:
        return Judged(names, (), bool(chances.min() < _SUSPICIOUS / len(names)))
    worst = np.argsort(chances)[: len(names) // _FEWEST]
    odd = {names[i] for i in worst if chances[i] < _SUSPICIOUS / len(names)}
    if odd:
        # What is odd must not say about what the bridge changes.
        joint = join(parts, priors, trusted=set(names) - odd)
    back = odd
    while odd and back:
        inside = [name for name in names if name not in odd]
        found = between_of(joint._replace(ready=joint.of(inside)), priors)
        changes = np.column_stack([found.tau, found.rho, found.weight])[found.weight > _UNLIKELY]
        of = zip(sorted(odd), _chances(joint, priors, sorted(odd), inside, changes), strict=True)
        back = {name for name, chance in of if chance >= _INCOMPATIBLE / len(names)}
        odd = odd - back
    agree = tuple(name for name in names if name not in odd)
    return Judged(agree, tuple(sorted(odd)), False)


def _chances(
    joint: Joint,
    priors: BridgePriors,
    names: Sequence[str],
    beside: Sequence[str],
    changes: FloatArray,
) -> list[float]:
    """Of each of `names`, how likely it is to be so far or farther from `beside`, itself apart.

    `changes` (k, 3): tau, rho, and how likely these are. A usual change, each element's own, comes
    to them and is never held against a crossing, however little the others show.
    """
    elements = joint.layout.elements
    precision, linear = sum_of(joint, priors, joint.of(beside))
    at = np.diag(joint.centre[elements])
    out = []
    for name, one in zip(names, joint.of(names), strict=True):
        whole, pull = precision, linear
        if name not in beside:
            whole, pull = sum_of(joint, priors, [*joint.of(beside), one])
        told, need = _own_change(one, whole, pull, elements)
        chance = 0.0
        for tau, rho, weight in changes:
            own = _USUAL_CHANGE**2 + (1.0 - rho) * tau**2
            change = at @ (own * np.eye(elements.size) + rho * tau**2) @ at
            spread = told + told @ change @ told
            chance += float(weight * chdtrc(elements.size, squared_distance(need, spread)))
        out.append(chance)
    return out


def _own_change(
    one: Ready, precision: FloatArray, linear: FloatArray, elements: NDArray[np.int64]
) -> tuple[FloatArray, FloatArray]:
    """Precision (e, e) and linear part (e,) of a crossing's own change of the compliances.

    From the sum of all, this one included. Trucks, tracks and the bridge's other unknowns are what
    all others say, so that what is hardly told by one crossing alone is not held against it.
    """
    across = np.zeros((linear.size, elements.size))
    across[one.places] = one.precision[:, elements]
    own = one.precision[np.ix_(elements, elements)]
    return own_change(across, own, one.linear[elements], (precision, linear))
