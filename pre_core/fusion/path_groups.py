"""Wheel-path groups: runs of one truck in one direction, and their shared mismatch.

Like the truck, the long waves of the shared part do not average out. The shared fraction follows
from the footprints and the lateral wander of the runs, which the residuals before and behind the
bridge determine.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pre_core.crossing.mismatch import (
    LONG_CYCLES_PER_M,
    Mismatch,
    between_run_spectra,
    mismatch_spectra,
)
from pre_core.fusion.likelihood import (
    OFF_BRIDGE_STEP_M,
    CrossingLikelihood,
    OffBridgeMismatch,
    covariance_of_coefficients,
)
from pre_core.physics.surface import Footprint

FloatArray = NDArray[np.float64]

_APART_STEPS = 4
"""Step of the second difference that determines the shared fraction: waves of one to four metres.
"""
_MAX_STEPS_BESIDE, _ALIGNMENTS, _FEWEST_RUNS = 6, 3, 2
_LAGS = sorted(range(-_MAX_STEPS_BESIDE, _MAX_STEPS_BESIDE + 1), key=abs)
_WANDERS_M, _HALVINGS = (0.01, 1.0), 12
_NOTHING = 1e-9
"""Relative variance of a sum of waves that is rounding."""


class FusionInput(NamedTuple):
    """A crossing to fuse."""

    name: str
    likelihood: CrossingLikelihood
    truck: str
    direction: int
    footprints: tuple[Footprint, Footprint]
    mass_spread: float
    """Relative standard deviation of the truck's total mass, one error in all its crossings."""


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


class PathGroup(NamedTuple):
    """A wheel-path group with the covariances of its long waves."""

    shared: SharedMismatch
    own_root: FloatArray
    whole: FloatArray
    """Precision (q, q) of their sum, own and shared."""
    common: FloatArray | None
    """Covariance (q, q) of the shared part in mm²; None for a single run, whose waves are its own.
    """


def path_groups(parts: Sequence[FusionInput]) -> dict[PathGroupKey, PathGroup]:
    """Return the wheel-path groups of all trucks whose axles follow different profiles."""
    runs: dict[PathGroupKey, list[FusionInput]] = {}
    for part in parts:
        if part.likelihood.knots_m.size:
            runs.setdefault(path_group_key(part), []).append(part)
    return {key: _track(key, some) for key, some in runs.items()}


def _track(key: PathGroupKey, runs: list[FusionInput]) -> PathGroup:
    shapes = mismatch_spectra(*runs[0].footprints)
    level = np.mean([run.likelihood.level_m3 for run in runs], axis=0)
    whole = level @ shapes.density
    knots = runs[0].likelihood.knots_m
    everything = covariance_of_coefficients(knots, shapes.cycles_per_m, whole)
    if len(runs) == 1:
        shared = SharedMismatch(key.truck, key.direction, 0.0, None, level)
        return PathGroup(
            shared, low_rank_root(everything), np.asarray(np.linalg.inv(everything)), None
        )
    share = common_share([run.likelihood.off_bridge for run in runs])
    wander_m = estimate_wander_m(Mismatch(shapes, level, 1.0), share)
    density = level @ between_run_spectra(*shapes.footprints, wander_m)
    common = covariance_of_coefficients(knots, shapes.cycles_per_m, density)
    at_long = np.searchsorted(shapes.cycles_per_m, LONG_CYCLES_PER_M)
    shared = SharedMismatch(
        key.truck, key.direction, float(density[at_long] / whole[at_long]), wander_m, level
    )
    own = low_rank_root(everything - common)
    return PathGroup(shared, own, np.asarray(np.linalg.inv(everything)), common)


def path_group_key(part: FusionInput) -> PathGroupKey:
    """Return the key of a crossing's wheel-path group."""
    knots_m = part.likelihood.knots_m
    first = round(float(knots_m[0] / (knots_m[1] - knots_m[0]))) if knots_m.size else 0
    return PathGroupKey(part.truck, part.direction, first, knots_m.size)


def low_rank_root(covariance: FloatArray) -> FloatArray:
    """Return a root (q, r) of a covariance (q, q) = root root', without rounding directions."""
    values, vectors = np.linalg.eigh(covariance)
    kept = values > _NOTHING * values[-1]
    return np.asarray(vectors[:, kept] * np.sqrt(values[kept]))


def common_share(runs: Sequence[OffBridgeMismatch | None]) -> float:
    """Return the shared fraction of the mismatch's short waves, from residuals off the bridge.

    A receiver aligns runs to half a metre, as long as the waves: so each run is first shifted to
    maximise its correlation with the others.
    """
    known = [run for run in runs if run is not None]
    if len(known) < _FEWEST_RUNS:
        return 0.0
    first = min(round(run.begin_m / OFF_BRIDGE_STEP_M) for run in known) - _MAX_STEPS_BESIDE
    last = max(round(run.begin_m / OFF_BRIDGE_STEP_M) + run.value_m.size for run in known)
    heights = np.full((len(known), last - first + _MAX_STEPS_BESIDE), np.nan)
    for run, height in zip(known, heights, strict=True):
        begin = round(run.begin_m / OFF_BRIDGE_STEP_M) - first
        height[begin : begin + run.value_m.size] = run.value_m
    step = _APART_STEPS
    bent = heights[:, 2 * step :] - 2.0 * heights[:, step:-step] + heights[:, : -2 * step]
    for _ in range(_ALIGNMENTS):
        for i in range(len(known)):
            others = _mean_known(np.delete(bent, i, axis=0))
            moved = [np.roll(bent[i], lag) for lag in _LAGS]
            bent[i] = moved[int(np.argmax([_likeness(one, others) for one in moved]))]
    together = power = 0.0
    for i in range(len(bent)):
        for j in range(i):
            both = np.isfinite(bent[i]) & np.isfinite(bent[j])
            together += float(bent[i][both] @ bent[j][both])
            power += 0.5 * float(bent[i][both] @ bent[i][both] + bent[j][both] @ bent[j][both])
    return float(np.clip(together / power, 0.0, 1.0)) if power > 0.0 else 0.0


def _mean_known(bent: FloatArray) -> FloatArray:
    """Return the mean (n,) of the runs (k, n) with a value; NaN without any."""
    known = np.isfinite(bent)
    count = known.sum(axis=0)
    total = np.where(known, bent, 0.0).sum(axis=0)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def _likeness(one: FloatArray, other: FloatArray) -> float:
    """Return the correlation where both have values."""
    both = np.isfinite(one) & np.isfinite(other)
    size = float(np.sqrt((one[both] @ one[both]) * (other[both] @ other[both])))
    return float(one[both] @ other[both]) / size if size > 0.0 else 0.0


def estimate_wander_m(mismatch: Mismatch, share: float) -> float:
    """Return the lateral wander in m of runs with this `share` of short waves in common."""
    shapes = mismatch.shapes
    n = shapes.cycles_per_m
    # Weighted as in the second differences of `common_share`.
    seen = np.sin(np.pi * n * _APART_STEPS * OFF_BRIDGE_STEP_M) ** 4
    whole = float(mismatch.level_m3 @ shapes.density @ seen)

    def of(wander_m: float) -> float:
        common = between_run_spectra(*shapes.footprints, wander_m)
        return float(mismatch.level_m3 @ common @ seen) / whole

    low, high = _WANDERS_M
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if of(middle) > share else (low, middle)
    return 0.5 * (low + high)
