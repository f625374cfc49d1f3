"""Which of several crossings of a bridge cannot be of the same bridge as the others.

Each crossing's compliances are set beside those that all others give together. Their difference has
the covariance of both, and that of a bridge that changes between crossings. What changes it is not
known before the odd one is out, which would pass for change: so crossings are first judged by a
usual change, and those that stand out then by the change that the others show.
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
"""Of two that disagree nobody knows which is wrong."""


class Judged(NamedTuple):
    """The crossings' names, by what became of them."""

    agree: tuple[str, ...]
    left_out: tuple[str, ...]
    disagree: bool
    """Those that are kept do not agree, and too few are there to say more."""


def judge(parts: Sequence[Part], priors: BridgePriors) -> Judged:
    """Which crossings to fuse."""
    kept = sorted(parts, key=lambda part: part.name)
    out: list[Part] = []
    while len(kept) > 1:
        joint = join(kept, priors)
        chances = _chances(joint, priors, _USUAL_CHANGE)
        worst = int(np.argmin(chances))
        if chances[worst] > _SUSPICIOUS / len(kept):
            break
        if len(kept) < _FEWEST:
            break
        out.append(kept.pop(worst))
    out = _taken_back(kept, out, priors)
    kept = sorted([part for part in parts if part not in out], key=lambda part: part.name)
    left_out = tuple(sorted(part.name for part in out))
    return Judged(tuple(part.name for part in kept), left_out, _disagree(kept, priors))


def _disagree(kept: list[Part], priors: BridgePriors) -> bool:
    if not 1 < len(kept) < _FEWEST:
        return False
    chances = _chances(join(kept, priors), priors, _USUAL_CHANGE)
    return bool(chances.min() < _SUSPICIOUS / len(kept))


def _taken_back(kept: list[Part], out: list[Part], priors: BridgePriors) -> list[Part]:
    """Those of `out` that stay out when the change between the others is taken for what it is."""
    if not out:
        return out
    joint = join(kept, priors)
    between = between_of(joint, priors)
    change = float(np.sqrt(between.weight @ between.tau**2))
    stay = []
    for part in out:
        joint = join([*kept, part], priors)
        chance = _chances(joint, priors, max(change, _USUAL_CHANGE))[joint.names.index(part.name)]
        if chance < _INCOMPATIBLE / (len(kept) + len(out)):
            stay.append(part)
    return stay


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
