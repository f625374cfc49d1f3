"""Which of a truck's crossings are by another truck.

Fusing takes a truck's unknowns for the same in all its crossings, and each crossing tells some of
them to a thousandth. One by another truck under the same name, even one of the same make, leads
all of them astray, and the bridge with them; by itself it may look sound. So before crossings are
put together each truck's are compared by what they say of the truck: every one with all others,
each with a bridge and waves of its own, for the bridge is another question. The one that is
farthest off is left out, and the rest compared again, until they agree.
"""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from pre_core.crossing.compliances import marginal
from pre_core.fusion.joint import alone
from pre_core.fusion.sums import BridgePriors, own_change, squared_distance, sum_of
from pre_core.fusion.tracks import Part

FloatArray = NDArray[np.float64]

_USUAL_CHANGE = 0.03
"""Of an unknown from run to run, in standard deviations of its prior: fuel, warm dampers, and what
a normal likelihood lacks."""
_INCOMPATIBLE = 1e-4
"""Probability that one of all crossings is as far off as this by chance."""
_FEWEST = 3
"""Of two that disagree nobody knows which is wrong; of more, a third may be."""


class Compared(NamedTuple):
    """What became of the crossings' trucks."""

    strangers: tuple[str, ...]
    """The names of crossings by other trucks."""
    disagree: bool
    """There are others that do not agree, and nobody can say which is wrong."""


class _Told(NamedTuple):
    """What crossings tell of their truck: precision (t, t) and linear part (t,), no prior in it.

    Each crossing's truck may be a usual change away from that of all. So none tells more of it than
    that leaves open, and the surest does not outweigh all others.
    """

    precision: FloatArray
    linear: FloatArray


def compare_trucks(parts: Sequence[Part], priors: BridgePriors) -> Compared:
    """Which crossings are not by the truck that the others of its name are by."""
    trucks: dict[str, dict[str, _Told]] = {}
    for part in sorted(parts, key=lambda part: part.name):
        trucks.setdefault(part.truck, {})[part.name] = _told(part, priors)
    strangers: list[str] = []
    disagree = False
    for told in trucks.values():
        most = len(told) // _FEWEST
        limit = float(chdtri(_sum(told.values()).linear.size, _INCOMPATIBLE / len(parts)))
        inside = dict(told)
        odd: list[str] = []
        while len(inside) > 1:
            name, distance = _farthest(inside)
            if distance < limit:
                break
            if len(odd) == most:
                disagree = True
                break
            odd.append(name)
            del inside[name]
        strangers += odd
    return Compared(tuple(sorted(strangers)), disagree)


def _told(part: Part, priors: BridgePriors) -> _Told:
    """By one crossing alone; its bridge, the error of its mass and the change integrated out."""
    joint = alone(part, priors)
    precision, linear = sum_of(joint, priors, joint.ready)
    truck = joint.layout.trucks[part.truck][:-1]
    precision[truck, truck] -= 1.0  # its prior, which counts once for all
    precision, linear = marginal(precision, linear, truck)
    bound = precision + np.eye(truck.size) / _USUAL_CHANGE**2
    explained = np.linalg.solve(bound, np.column_stack([precision, linear]))
    return _Told(precision - precision @ explained[:, :-1], linear - precision @ explained[:, -1])


def _sum(told: Iterable[_Told]) -> _Told:
    precisions, linear = zip(*told, strict=True)
    return _Told(np.sum(precisions, axis=0), np.sum(linear, axis=0))


def _farthest(told: dict[str, _Told]) -> tuple[str, float]:
    """The name of the crossing that is farthest from all others, and its squared distance."""
    whole = _sum(told.values())
    before = whole.precision + np.eye(whole.linear.size)
    distances = {}
    for name, one in told.items():
        own, need = own_change(one.precision, *one, (before, whole.linear))
        distances[name] = squared_distance(need, own)
    name = max(distances, key=distances.__getitem__)
    return name, distances[name]
