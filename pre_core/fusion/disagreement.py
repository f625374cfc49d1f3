"""Which of several crossings of a bridge cannot be of the same bridge as the others.

Each crossing's compliances are set beside those that all others give together. Their difference has
the covariance of both, and that of a bridge that changes between crossings. What changes it is not
known before the odd one is out, which would pass for change: so crossings are first judged by a
usual change, and those that stand out then, a third of all at most, by the change that the others
show.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from pre_core.crossing.compliances import marginal
from pre_core.fusion.joint import BridgePriors, Joint, Part, between_of, join, sum_of

FloatArray = NDArray[np.float64]

_USUAL_CHANGE = 0.03
_SUSPICIOUS, _INCOMPATIBLE = 1e-3, 1e-4
"""Probabilities that one of all crossings is as far off as this by chance: to be looked at with the
change that the others show, and then to be left out."""
_FEWEST = 3
"""Of two that disagree nobody knows which is wrong; of more, a third may be."""


class Judged(NamedTuple):
    """The crossings' names, by what became of them."""

    agree: tuple[str, ...]
    left_out: tuple[str, ...]
    disagree: bool
    """Those that are kept do not agree, and too few are there to say more."""


def judge(parts: Sequence[Part], priors: BridgePriors) -> Judged:
    """Which crossings to fuse."""
    parts = sorted(parts, key=lambda part: part.name)
    names = tuple(part.name for part in parts)
    if len(parts) == 1:
        return Judged(names, (), False)
    joint = join(parts, priors)
    chances = _chances(joint, priors, _USUAL_CHANGE)
    if len(parts) < _FEWEST:
        return Judged(names, (), bool(chances.min() < _SUSPICIOUS / len(parts)))
    worst = np.argsort(chances)[: len(parts) // _FEWEST]
    odd = [i for i in worst if chances[i] < _SUSPICIOUS / len(parts)]
    if not odd:
        return Judged(names, (), False)
    sound = [part for i, part in enumerate(parts) if i not in odd]
    between = between_of(join(sound, priors), priors)
    change = max(float(np.sqrt(between.weight @ between.tau**2)), _USUAL_CHANGE)
    left_out = []
    for i in odd:
        beside = join([*sound, parts[i]], priors)
        chance = _chances(beside, priors, change)[beside.names.index(names[i])]
        if chance < _INCOMPATIBLE / len(parts):
            left_out.append(names[i])
    agree = tuple(name for name in names if name not in left_out)
    return Judged(agree, tuple(sorted(left_out)), False)


def _chances(joint: Joint, priors: BridgePriors, change: float) -> FloatArray:
    """The probability (crossings,) of being so far from all others together."""
    elements = joint.layout.elements
    precision, linear = sum_of(joint, priors, joint.ready)
    own_change = np.diag((change * joint.centre[elements]) ** 2)
    out = []
    for one in joint.ready:
        rest, pull = precision.copy(), linear.copy()
        rest[np.ix_(one.places, one.places)] -= one.precision
        pull[one.places] -= one.linear
        alone = sum_of(joint, priors, [one])
        (a, b), (c, d) = marginal(rest, pull, elements), marginal(*alone, elements)
        apart = np.linalg.solve(a, b) - np.linalg.solve(c, d)
        spread = np.linalg.inv(a) + np.linalg.inv(c) + own_change
        distance = float(apart @ np.linalg.solve(spread, apart))
        out.append(float(chi2.sf(distance, elements.size)))
    return np.array(out)
