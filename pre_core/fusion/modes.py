"""Several bridges that explain the crossings alike: with and without restraint at an end.

Where crossings determine elements poorly, a weak element next to a restrained end deflects like a
sound one next to a free end. The fused posterior has a maximum for each, and a normal about one of
them would be too certain. So the estimate is sought from several states of the ends, and drawn from
a mixture of what is found, weighted by the posterior densities of the maxima.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pre_core.fusion.information import BridgePriors, JointInformation, sum_information
from pre_core.fusion.joint import FusedDraws, build_joint, sample_joint
from pre_core.fusion.path_groups import FusionInput
from pre_core.search.loop import Report

FloatArray = NDArray[np.float64]

_RESTRAINED = 1.5
"""Restraint or compliance of an end from which another estimate is sought, in prior scales."""
_ANOTHER = 0.1
"""Distance of a coordinate beyond which an estimate is another one."""
_LEAST_WEIGHT = 0.02
_FEW = 30
"""Number of crossings up to which other estimates are sought; more determine the ends, and each
search takes as long as the fusion."""


class Mode(NamedTuple):
    """Crossings about one estimate of the bridge, and its weight among all."""

    information: JointInformation
    weight: float


def fuse(parts: Sequence[FusionInput], priors: BridgePriors, count: int, seed: int) -> FusedDraws:
    """Return draws of a bridge, `count` of each chain, from crossings in coordinates of `priors`.

    The order of the parts does not matter. Raise ValueError without parts.
    """
    if not parts:
        raise ValueError("no crossings to fuse")
    modes = bridge_modes(parts, priors, build_joint(parts, priors))
    return sample_modes(modes, priors, count, seed)


def bridge_modes(
    parts: Sequence[FusionInput], priors: BridgePriors, first: JointInformation
) -> tuple[Mode, ...]:
    """Return the estimates of the bridge, `first` (of `build_joint`) and others with their weights.

    Others are sought where axles follow different profiles, from each end alone with restraint or
    compliance.
    """
    found = [first]
    ends = np.flatnonzero(~priors.coordinates.is_log)
    if len(parts) <= _FEW and any(part.likelihood.bends is not None for part in parts):
        for end in ends:
            start = first.centre.copy()
            start[ends] = 0.0
            start[end] = _RESTRAINED
            other = build_joint(parts, priors, start=start)
            apart = [np.abs(other.centre - one.centre).max() for one in found]
            if min(apart) > _ANOTHER:
                found.append(other)
    density = np.array([log_posterior(one, priors) for one in found])
    weight = np.exp(density - density.max())
    weight /= weight.sum()
    kept = [
        Mode(*one) for one in zip(found, weight.tolist(), strict=True) if one[1] > _LEAST_WEIGHT
    ]
    whole = sum(mode.weight for mode in kept)
    return tuple(mode._replace(weight=mode.weight / whole) for mode in kept)


def log_posterior(information: JointInformation, priors: BridgePriors) -> float:
    """Return the log posterior density of the centre, up to a constant, all else integrated out."""
    layout, at = information.layout, information.centre
    precision, linear = sum_information(information, information.crossings)
    b, e = layout.bridge, layout.elements
    out = sum(one.constant for one in information.crossings)
    out += float(linear[:b] @ at) - 0.5 * float(at @ precision[:b, :b] @ at)
    factor = np.linalg.cholesky(precision[b:, b:])
    pull = np.linalg.solve(factor, linear[b:] - precision[b:, :b] @ at)
    out += 0.5 * float(pull @ pull) - float(np.log(np.diag(factor)).sum())
    y = np.concatenate([at[: e[0]], np.log(at[e]) / priors.coordinates.scale[e]])
    return out - 0.5 * float(y @ y)


def sample_modes(
    modes: Sequence[Mode],
    priors: BridgePriors,
    count: int,
    seed: int,
    report: Report = lambda stage, fraction: None,
    threads: int = 1,
) -> FusedDraws:
    """Return draws of the mixture as `sample_joint` does of one estimate, in random order."""
    numbers = [max(1, round(mode.weight * count)) for mode in modes]
    parts = [
        sample_joint(mode.information, priors, number, seed, report, threads)
        for mode, number in zip(modes, numbers, strict=True)
    ]
    if len(parts) == 1:
        return parts[0]
    order = np.random.default_rng(np.random.SeedSequence(seed)).permutation(sum(numbers))
    likeliest = int(np.argmax([mode.weight for mode in modes]))
    return parts[likeliest]._replace(
        draws=np.concatenate([part.draws for part in parts])[order],
        between=np.concatenate([part.between for part in parts])[order],
    )
