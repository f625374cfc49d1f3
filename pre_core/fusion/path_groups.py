"""Wheel-path groups: runs of one truck in one direction, and their shared mismatch.

Like errors of the truck, the long waves of the shared part do not average out. The shared fraction
follows from the footprints and the lateral wander of the runs, which the residuals before and after
the bridge determine.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from pre_core.arrays import FloatArray
from pre_core.crossing.mismatch import LONG_CYCLES_PER_M, Mismatch, mismatch_spectra
from pre_core.fusion.lateral_wander import (
    align_runs_m,
    between_runs,
    shared_fraction,
    wander_posterior,
)
from pre_core.fusion.likelihood import CrossingLikelihood
from pre_core.fusion.long_waves import covariance_of_coefficients, long_share
from pre_core.fusion.short_waves import shared_error_roots
from pre_core.physics.road import Profile
from pre_core.physics.surface import Footprint

_ROUNDED = 1e-9
"""Variance of a direction, relative to the largest, below which it is rounding."""


class FusionInput(NamedTuple):
    """A crossing to fuse."""

    name: str
    likelihood: CrossingLikelihood
    truck: str
    direction: int
    """1 from the bridge's start to its end, -1 in the other direction."""
    footprints: tuple[Footprint, Footprint]
    mass_spread: float
    """Relative standard deviation of the truck's total mass, one error in all its crossings."""
    road: Profile | None = None
    """Profile of the road on the bridge, which aligns the runs of a group."""


class SharedMismatch(NamedTuple):
    """The shared part of the profile mismatch in a wheel-path group."""

    truck: str
    direction: int
    common_share: float
    """Shared fraction of the mismatch's power at waves of 20 m."""
    wander_m: float | None
    """Lateral wander of the runs; None for a single run."""
    level_m3: FloatArray


class PathGroupKey(NamedTuple):
    """Key of a wheel-path group; runs on other stretches or with other knots share no waves."""

    truck: str
    direction: int
    first_knot: int
    knots: int
    spacing_mm: int


class PathGroup(NamedTuple):
    """A wheel-path group with the covariances of its long waves."""

    shared: SharedMismatch
    own_root: FloatArray
    """Root (q, r) of the covariance of a run's own part in mm²."""
    whole: FloatArray
    """Precision (q, q) of the long-wave coefficients, own and shared parts together."""
    common: FloatArray | None
    """Covariance (q, q) of the shared part in mm²; None for a single run, whose waves are its own.
    """
    short_roots: dict[str, FloatArray]
    """Root (b, r) by run of the covariance of its short-wave errors with those of the others."""


def path_groups(parts: Sequence[FusionInput]) -> dict[PathGroupKey, PathGroup]:
    """Return the wheel-path groups of all trucks whose axles follow different profiles."""
    runs: dict[PathGroupKey, list[FusionInput]] = {}
    for part in parts:
        if part.likelihood.knots_m.size:
            runs.setdefault(path_group_key(part), []).append(part)
    return {key: _path_group(key, some) for key, some in runs.items()}


def _path_group(key: PathGroupKey, runs: list[FusionInput]) -> PathGroup:
    shapes = mismatch_spectra(*runs[0].footprints)
    level = np.mean([run.likelihood.level_m3 for run in runs], axis=0)
    whole = level @ shapes.density
    knots = runs[0].likelihood.knots_m
    everything = covariance_of_coefficients(knots, shapes.cycles_per_m, whole)
    if len(runs) == 1:
        shared = SharedMismatch(key.truck, key.direction, 0.0, None, level)
        return PathGroup(
            shared, low_rank_root(everything), np.asarray(np.linalg.inv(everything)), None, {}
        )
    mismatch = Mismatch(shapes, level, 1.0)
    off_bridge = [run.likelihood.off_bridge for run in runs]
    shifts_m = align_runs_m(off_bridge, [run.road for run in runs])
    wander = wander_posterior(mismatch, shared_fraction(off_bridge, shifts_m, mismatch))
    density = level @ np.tensordot(wander.weights, between_runs(*shapes.footprints), 1)
    common = covariance_of_coefficients(knots, shapes.cycles_per_m, density)
    at_long = np.searchsorted(shapes.cycles_per_m, LONG_CYCLES_PER_M)
    shared = SharedMismatch(
        key.truck,
        key.direction,
        float(density[at_long] / whole[at_long]),
        wander.wander_m,
        level,
    )
    own = low_rank_root(everything - common)
    whole_inverse = np.asarray(np.linalg.inv(everything))
    short = density * (1.0 - long_share(shapes.cycles_per_m, float(knots[1] - knots[0])))
    roots = _short_roots(runs, shapes.cycles_per_m, short)
    return PathGroup(shared, own, whole_inverse, common, roots)


def _short_roots(
    runs: list[FusionInput], cycles_per_m: FloatArray, density: FloatArray
) -> dict[str, FloatArray]:
    """Return `PathGroup.short_roots` for short waves of a density (g,) in m³.

    Runs without a response are omitted.
    """
    have = {run.name: run.likelihood.short_waves for run in runs}
    responses = {name: one for name, one in have.items() if one is not None}
    if len(responses) < 2:
        return {}
    first = next(iter(responses.values()))
    at_waves = np.interp(first.cycles_per_m, cycles_per_m, density)
    return dict(zip(responses, shared_error_roots([*responses.values()], at_waves), strict=True))


def path_group_key(part: FusionInput) -> PathGroupKey:
    """Return the key of a crossing's wheel-path group."""
    knots_m = part.likelihood.knots_m
    spacing = float(knots_m[1] - knots_m[0]) if knots_m.size else 1.0
    first = round(float(knots_m[0]) / spacing) if knots_m.size else 0
    return PathGroupKey(part.truck, part.direction, first, knots_m.size, round(1e3 * spacing))


def wave_precision(part: FusionInput, groups: Mapping[PathGroupKey, PathGroup]) -> FloatArray:
    """Return the precision (q, q) of a crossing's long waves, own and shared parts together."""
    group = groups.get(path_group_key(part))
    return np.zeros((0, 0)) if group is None else group.whole


def low_rank_root(covariance: FloatArray) -> FloatArray:
    """Return a root (q, r) of a covariance (q, q) = root root'; its rounding errors are dropped."""
    values, vectors = np.linalg.eigh(covariance)
    kept = values > _ROUNDED * values[-1]
    return np.asarray(vectors[:, kept] * np.sqrt(values[kept]))
