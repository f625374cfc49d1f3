"""Which of several crossings of a bridge cannot be of the same bridge as the others.

Each crossing's compliances are set beside those that all others give together. Their difference has
the covariance of both, and that of a bridge that changes between crossings. What changes it is not
known before the odd one is out, which would pass for change: so crossings are first judged by a
usual change. Those that stand out then, a third of all at most, come back if the change that those
inside show explains them; and as those that agree best show too little change, and each that comes
back shows more of it, this goes on until none comes back. The rest is left out.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from pre_core.crossing.compliances import marginal
from pre_core.fusion.joint import Between, BridgePriors, Joint, Part, between_of, join, sum_of

FloatArray = NDArray[np.float64]

_USUAL_CHANGE = 0.03
_SUSPICIOUS, _INCOMPATIBLE = 1e-3, 1e-4
"""Probabilities that one of all crossings is as far off as this by chance: to be looked at with the
change that the others show, and then to be left out."""
_FEWEST = 3
"""Of two that disagree nobody knows which is wrong; of more, a third may be."""
_USUAL = Between(np.array([_USUAL_CHANGE]), np.zeros(1), np.ones(1))


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
    chances = np.array(_chances(joint, priors, names, names, _USUAL))
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
        between = between_of(joint._replace(ready=joint.of(inside)), priors)
        # A usual change is never held against a crossing, however little the others show.
        between = between._replace(tau=np.maximum(between.tau, _USUAL_CHANGE))
        chances = _chances(joint, priors, sorted(odd), inside, between)
        of = zip(sorted(odd), chances, strict=True)
        back = {name for name, chance in of if chance >= _INCOMPATIBLE / len(names)}
        odd = odd - back
    agree = tuple(name for name in names if name not in odd)
    return Judged(agree, tuple(sorted(odd)), False)


def _chances(
    joint: Joint,
    priors: BridgePriors,
    names: Sequence[str],
    beside: Sequence[str],
    between: Between,
) -> list[float]:
    """Of each of `names`, how likely it is to be so far or farther from `beside`, itself apart."""
    elements = joint.layout.elements
    precision, linear = sum_of(joint, priors, joint.of(beside))
    at = np.diag(joint.centre[elements])
    out = []
    for name, one in zip(names, joint.of(names), strict=True):
        rest, pull = precision.copy(), linear.copy()
        if name in beside:
            rest[np.ix_(one.places, one.places)] -= one.precision
            pull[one.places] -= one.linear
        alone = marginal(*sum_of(joint, priors, [one]), elements)
        others = marginal(rest, pull, elements)
        apart = np.linalg.solve(*others) - np.linalg.solve(*alone)
        spread = np.linalg.inv(others[0]) + np.linalg.inv(alone[0])
        chance = 0.0
        for tau, rho, weight in zip(*between, strict=True):
            own_change = tau**2 * ((1.0 - rho) * np.eye(elements.size) + rho)
            distance = apart @ np.linalg.solve(spread + at @ own_change @ at, apart)
            chance += float(weight * chi2.sf(distance, elements.size))
        out.append(chance)
    return out
