"""Detection of crossings by a truck other than the named one.

Fusion assumes the same truck parameters in all crossings of a truck, and each crossing determines
some of them to a thousandth. A crossing by another truck under this name, even one of the same
make, biases all of them and the bridge; judged alone it may be good. So each truck's crossings are
compared first by their truck parameters: every one with all others, each with its own bridge and
waves, which may differ. The most distant one is excluded and the rest compared again, until they
agree.
"""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri

from pre_core.arrays import FloatArray
from pre_core.crossing.compliances import marginal
from pre_core.fusion.information import (
    BridgePriors,
    leave_one_out_change,
    posterior_information,
    squared_distance,
)
from pre_core.fusion.joint import single_crossing_joint
from pre_core.fusion.path_groups import FusionInput

_USUAL_CHANGE = 0.03
"""Change of a parameter from run to run, in standard deviations of its prior: fuel, warm dampers,
and the error of a normal likelihood."""
_INCOMPATIBLE = 1e-4
"""Probability that the most distant of all crossings is as far away, below which it is excluded."""
_FEWEST = 3
"""Fewest crossings of which one can be excluded: of two that contradict each other either may be
wrong; of more, a third may be."""


class VehicleConsistency(NamedTuple):
    """Result of the comparison of trucks."""

    misattributed: tuple[str, ...]
    """Names of misattributed crossings."""
    is_contradictory: bool
    """Whether others contradict each other, without showing which is wrong."""


class _VehicleInformation(NamedTuple):
    """Information of crossings on their truck: precision (t, t), linear part (t,), without prior.

    Each crossing's truck may deviate from the common one by a usual change. This limits the
    information of each, so that the most precise one does not outweigh all others.
    """

    precision: FloatArray
    linear: FloatArray


def find_misattributed(parts: Sequence[FusionInput], priors: BridgePriors) -> VehicleConsistency:
    """Return the crossings recorded under another truck's name, and whether others disagree."""
    trucks: dict[str, dict[str, _VehicleInformation]] = {}
    for part in sorted(parts, key=lambda part: part.name):
        trucks.setdefault(part.truck, {})[part.name] = _vehicle_information(part, priors)
    misattributed: list[str] = []
    disagree = False
    for information in trucks.values():
        most = len(information) // _FEWEST
        limit = float(chdtri(_sum(information.values()).linear.size, _INCOMPATIBLE / len(parts)))
        inside = dict(information)
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
        misattributed += odd
    return VehicleConsistency(tuple(sorted(misattributed)), disagree)


def _vehicle_information(part: FusionInput, priors: BridgePriors) -> _VehicleInformation:
    """Return a crossing's information with bridge, mass error and change integrated out."""
    joint = single_crossing_joint(part, priors)
    precision, linear = posterior_information(joint, priors, joint.crossings)
    truck = joint.layout.trucks[part.truck][:-1]
    precision[truck, truck] -= 1.0  # without its prior, which counts once
    precision, linear = marginal(precision, linear, truck)
    bound = precision + np.eye(truck.size) / _USUAL_CHANGE**2
    explained = np.linalg.solve(bound, np.column_stack([precision, linear]))
    return _VehicleInformation(
        precision - precision @ explained[:, :-1], linear - precision @ explained[:, -1]
    )


def _sum(information: Iterable[_VehicleInformation]) -> _VehicleInformation:
    precisions, linear = zip(*information, strict=True)
    return _VehicleInformation(np.sum(precisions, axis=0), np.sum(linear, axis=0))


def _farthest(information: dict[str, _VehicleInformation]) -> tuple[str, float]:
    """Return the name of the crossing farthest from all others, and its squared distance."""
    whole = _sum(information.values())
    before = whole.precision + np.eye(whole.linear.size)
    distances = {}
    for name, one in information.items():
        own, need = leave_one_out_change(one.precision, *one, (before, whole.linear))
        distances[name] = squared_distance(need, own)
    name = max(distances, key=distances.__getitem__)
    return name, distances[name]
