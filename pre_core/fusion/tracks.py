"""Runs of one truck in one direction, and what they share of the mismatch of its axles' roads.

The long waves of the shared part are no more averaged out than the truck is. How much is shared
follows from the footprints and from how far the runs' tracks lie beside each other, which the rows
before and behind the bridge tell.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pre_core.crossing.mismatch import LONG_CYCLES_PER_M, Mismatch, common_shapes, shapes_of
from pre_core.fusion.likelihood import (
    OFF_BRIDGE_STEP_M,
    Likelihood,
    OffBridge,
    covariance_of_coefficients,
)
from pre_core.physics.surface import Footprint

FloatArray = NDArray[np.float64]

_APART_STEPS = 4
"""Of the second difference by which the common share is read: waves of one metre to four."""
_MOST_STEPS_BESIDE, _ALIGNMENTS, _FEWEST_RUNS = 6, 3, 2
_LAGS = sorted(range(-_MOST_STEPS_BESIDE, _MOST_STEPS_BESIDE + 1), key=abs)
_WANDERS_M, _HALVINGS = (0.01, 1.0), 12
_NOTHING = 1e-9
"""Of the largest variance of a sum of waves: a smaller one is rounding."""


class Part(NamedTuple):
    """A crossing to fuse."""

    name: str
    likelihood: Likelihood
    truck: str
    direction: int
    footprints: tuple[Footprint, Footprint]
    mass_spread: float
    """Relative, of the truck's total mass: the same error in all its crossings."""


class Shared(NamedTuple):
    """What runs of a truck in one track have in common of the road's mismatch."""

    truck: str
    direction: int
    common_share: float
    """Of the mismatch's power at waves of 20 m."""
    wander_m: float | None
    """How far the runs' tracks lie beside each other; None where one run tells nothing of it."""
    level_m3: FloatArray


class Key(NamedTuple):
    """Of a track: runs that tell other stretches of road, or by other knots, share no waves."""

    truck: str
    direction: int
    first_knot: int
    knots: int


class Track(NamedTuple):
    """What the runs of a truck in one direction share, and the covariances of their long waves."""

    shared: Shared
    own_root: FloatArray
    whole: FloatArray
    """Precision (q, q) of all of them, own and shared."""
    common: FloatArray | None
    """(q, q) mm²; None where there is one run: what it would share with others is its own."""


def tracks_of(parts: Sequence[Part]) -> dict[Key, Track]:
    """Of every truck in each direction in which its axles feel different roads."""
    runs: dict[Key, list[Part]] = {}
    for part in parts:
        if part.likelihood.knots_m.size:
            runs.setdefault(key_of(part), []).append(part)
    return {key: _track(key, some) for key, some in runs.items()}


def _track(key: Key, runs: list[Part]) -> Track:
    shapes = shapes_of(*runs[0].footprints)
    level = np.mean([run.likelihood.level_m3 for run in runs], axis=0)
    whole = level @ shapes.density
    knots = runs[0].likelihood.knots_m
    everything = covariance_of_coefficients(knots, shapes.cycles_per_m, whole)
    if len(runs) == 1:
        shared = Shared(key.truck, key.direction, 0.0, None, level)
        return Track(shared, root_of(everything), np.asarray(np.linalg.inv(everything)), None)
    share = common_share([run.likelihood.off_bridge for run in runs])
    wander_m = wander(Mismatch(shapes, level, 1.0), share)
    density = level @ common_shapes(*shapes.footprints, wander_m)
    common = covariance_of_coefficients(knots, shapes.cycles_per_m, density)
    at_long = np.searchsorted(shapes.cycles_per_m, LONG_CYCLES_PER_M)
    shared = Shared(
        key.truck, key.direction, float(density[at_long] / whole[at_long]), wander_m, level
    )
    own = root_of(everything - common)
    return Track(shared, own, np.asarray(np.linalg.inv(everything)), common)


def key_of(part: Part) -> Key:
    """The track of a crossing."""
    knots_m = part.likelihood.knots_m
    first = round(float(knots_m[0] / (knots_m[1] - knots_m[0]))) if knots_m.size else 0
    return Key(part.truck, part.direction, first, knots_m.size)


def root_of(covariance: FloatArray) -> FloatArray:
    """(q, r) of which root root' is the covariance (q, q), what is rounding left out."""
    values, vectors = np.linalg.eigh(covariance)
    kept = values > _NOTHING * values[-1]
    return np.asarray(vectors[:, kept] * np.sqrt(values[kept]))


def common_share(runs: Sequence[OffBridge | None]) -> float:
    """Which part of the mismatch's short waves the runs have in common, by rows off the bridge.

    A receiver puts runs beside each other by half a metre, as long as the waves: so each run is
    first moved to where it is most like the others.
    """
    known = [run for run in runs if run is not None]
    if len(known) < _FEWEST_RUNS:
        return 0.0
    first = min(round(run.begin_m / OFF_BRIDGE_STEP_M) for run in known) - _MOST_STEPS_BESIDE
    last = max(round(run.begin_m / OFF_BRIDGE_STEP_M) + run.value_m.size for run in known)
    heights = np.full((len(known), last - first + _MOST_STEPS_BESIDE), np.nan)
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
    """The mean (n,) of those of the runs (k, n) that tell something there; nothing: NaN."""
    told = np.isfinite(bent)
    count = told.sum(axis=0)
    total = np.where(told, bent, 0.0).sum(axis=0)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def _likeness(one: FloatArray, other: FloatArray) -> float:
    """The correlation of what both tell."""
    both = np.isfinite(one) & np.isfinite(other)
    size = float(np.sqrt((one[both] @ one[both]) * (other[both] @ other[both])))
    return float(one[both] @ other[both]) / size if size > 0.0 else 0.0


def wander(mismatch: Mismatch, share: float) -> float:
    """How far, in m, runs lie beside each other that have this `share` of short waves in common."""
    shapes = mismatch.shapes
    n = shapes.cycles_per_m
    # As the second differences of `common_share` see the waves.
    seen = np.sin(np.pi * n * _APART_STEPS * OFF_BRIDGE_STEP_M) ** 4
    whole = float(mismatch.level_m3 @ shapes.density @ seen)

    def of(wander_m: float) -> float:
        common = common_shapes(*shapes.footprints, wander_m)
        return float(mismatch.level_m3 @ common @ seen) / whole

    low, high = _WANDERS_M
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if of(middle) > share else (low, middle)
    return 0.5 * (low + high)
