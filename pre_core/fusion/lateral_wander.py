"""Lateral wander of a truck's runs, from the shared part of their mismatches off the bridge.

The runs of a wheel-path group are first aligned along the road: receivers err by about the length
of the waves that show the wander. The road profile aligns them to centimetres. The shared fraction
is the mean product of two runs' mismatches over the power that the estimated levels imply; so
sensor noise, which is independent between runs, does not count as mismatch.
"""

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from pre_core.arrays import FloatArray
from pre_core.crossing.mismatch import Mismatch, between_run_spectra
from pre_core.fusion.long_waves import OFF_BRIDGE_STEP_M, OffBridgeMismatch
from pre_core.physics.road import Profile
from pre_core.physics.surface import Footprint

_DIFFERENCE_STEPS = 4
"""Step, in values off the bridge, of the second difference that determines the shared fraction: it
passes waves of one to four metres."""
_MAX_SHIFT_M, _ROAD_STEP_M = 1.5, 0.05
_OFFSET_SPREAD_M = 0.5
"""Prior standard deviation of a run's longitudinal offset."""
_ALIGNMENTS, _FEWEST_RUNS = 3, 2
"""Number of rounds that align each run to the others, and fewest runs with a shared fraction."""
_USUAL_WANDER_M, _USUAL_SPREAD = 0.12, 0.7
"""Median of the wander's log-normal prior, and standard deviation of its logarithm: one driver who
is asked to keep to one path."""
_LEVEL_SPREAD = 0.15
"""Relative standard deviation of the estimated level of the mismatch."""
WANDERS_M = np.geomspace(0.01, 1.0, 25)
"""Grid of the wander."""
_FINE_POINTS = 481
"""Number of points of the finer grid on which the posterior is evaluated."""


class SharedFraction(NamedTuple):
    """Shared fraction of the mismatch's power at waves of one to four metres, with its error."""

    value: float
    std: float


class WanderPosterior(NamedTuple):
    """Estimate of the wander, and weights (g,) of the values in `WANDERS_M`."""

    wander_m: float
    weights: FloatArray


def align_runs_m(
    runs: Sequence[OffBridgeMismatch | None], roads: Sequence[Profile | None]
) -> FloatArray:
    """Return the shift (k,) in m of each run's road profile along the chainage.

    Unless every run has a road profile, the mismatches are compared instead.
    """
    known = [road for road in roads if road is not None]
    if len(known) == len(roads):
        return _shifts_m(_road_heights(known), _ROAD_STEP_M)
    return _shifts_m(_on_one_grid(runs), OFF_BRIDGE_STEP_M)


def _shifts_m(heights: FloatArray, step_m: float) -> FloatArray:
    """Return the likeliest shifts (k,) in m of heights (k, n) relative to the mean of the others.

    Their second differences over one metre are compared.
    """
    bent = _second_difference(heights, round(_DIFFERENCE_STEPS * OFF_BRIDGE_STEP_M / step_m))
    largest = round(_MAX_SHIFT_M / step_m)
    lags = sorted(range(-largest, largest + 1), key=abs)
    padded = np.pad(bent, ((0, 0), (largest, largest)), constant_values=np.nan)
    n = bent.shape[1]
    shifts = np.zeros(len(bent), dtype=np.int64)
    for _ in range(_ALIGNMENTS):
        for i in range(len(bent)):
            others = _mean_known(np.delete(bent, i, axis=0))
            moved = [padded[i, largest + lag : largest + lag + n] for lag in lags]
            gain = [_gain(one, others, step_m) for one in moved]
            best = int(
                np.argmax(np.array(gain) - 0.5 * (np.array(lags) * step_m / _OFFSET_SPREAD_M) ** 2)
            )
            shifts[i] = lags[best]
            bent[i] = moved[best]
    return np.asarray(shifts * step_m)


def _road_heights(roads: Sequence[Profile]) -> FloatArray:
    """Return profiles as heights (k, n) on one even grid; NaN where a profile ends."""
    first = min(float(road.x_m[0]) for road in roads)
    last = max(float(road.x_m[-1]) for road in roads)
    x = first + _ROAD_STEP_M * np.arange(round((last - first) / _ROAD_STEP_M) + 1)
    return np.stack([np.interp(x, road.x_m, road.height_m, np.nan, np.nan) for road in roads])


def _on_one_grid(runs: Sequence[OffBridgeMismatch | None]) -> FloatArray:
    """Return values (k, n) at common places; NaN where a run has none."""
    known = [run for run in runs if run is not None]
    if not known:
        return np.full((len(runs), 2 * _DIFFERENCE_STEPS + 1), np.nan)
    first = min(round(run.begin_m / OFF_BRIDGE_STEP_M) for run in known)
    last = max(round(run.begin_m / OFF_BRIDGE_STEP_M) + run.value_m.size for run in known)
    heights = np.full((len(runs), last - first), np.nan)
    for run, height in zip(runs, heights, strict=True):
        if run is not None:
            begin = round(run.begin_m / OFF_BRIDGE_STEP_M) - first
            height[begin : begin + run.value_m.size] = run.value_m
    return heights


def _second_difference(heights: FloatArray, step: int) -> FloatArray:
    return heights[:, 2 * step :] - 2.0 * heights[:, step:-step] + heights[:, : -2 * step]


def _mean_known(bent: FloatArray) -> FloatArray:
    """Return the mean (n,) of the runs (k, n) with a value; NaN without any."""
    known = np.isfinite(bent)
    count = known.sum(axis=0)
    total = np.where(known, bent, 0.0).sum(axis=0)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def _gain(one: FloatArray, other: FloatArray, step_m: float) -> float:
    """Return the log-likelihood gain by a common part of two series (n,).

    Both have one independent value per metre.
    """
    both = np.isfinite(one) & np.isfinite(other)
    size = float(np.sqrt((one[both] @ one[both]) * (other[both] @ other[both])))
    correlation = float(one[both] @ other[both]) / size if size > 0.0 else 0.0
    return 0.5 * step_m * int(both.sum()) * max(correlation, 0.0) ** 2


def shared_fraction(
    runs: Sequence[OffBridgeMismatch | None], shifts_m: FloatArray, mismatch: Mismatch
) -> SharedFraction | None:
    """Return the shared fraction of the mismatch of `runs`, aligned by `shifts_m` (k,).

    `mismatch` has the mean levels of the runs. None if no two runs have values at one place.
    """
    if sum(run is not None for run in runs) < _FEWEST_RUNS:
        return None
    heights = _on_one_grid(runs)
    steps = shifts_m / OFF_BRIDGE_STEP_M
    bent = _second_difference(
        np.stack([_shifted(one, by) for one, by in zip(heights, steps, strict=True)]),
        _DIFFERENCE_STEPS,
    )
    known = np.isfinite(bent)
    count = known.sum(axis=0)
    value = np.where(known, bent, 0.0)
    squares = (value**2).sum(axis=0)
    pairs = 0.5 * float((count * (count - 1)).sum())
    if pairs == 0.0:
        return None
    implied, bandwidth = _implied_power(mismatch)
    share = 0.5 * float((value.sum(axis=0) ** 2 - squares).sum()) / pairs / implied
    noisy = float(squares.sum() / count.sum()) / implied
    # A band of B cycles/m over L metres has 2 B L independent values.
    places = int((count > 1).sum())
    independent = 2.0 * bandwidth * OFF_BRIDGE_STEP_M * places
    of_all = float(np.clip(share, 0.0, 1.0))
    variance = (2.0 * of_all**2 + noisy**2 * places / pairs) / independent
    return SharedFraction(share, float(np.sqrt(variance + (_LEVEL_SPREAD * of_all) ** 2)))


def _shifted(values: FloatArray, steps: float) -> FloatArray:
    """Return values (n,) read `steps` samples later, by cubics through four neighbours."""
    whole = int(np.floor(steps))
    f = steps - whole
    weights = (
        -f * (f - 1.0) * (f - 2.0) / 6.0,
        (f + 1.0) * (f - 1.0) * (f - 2.0) / 2.0,
        -(f + 1.0) * f * (f - 2.0) / 2.0,
        (f + 1.0) * f * (f - 1.0) / 6.0,
    )
    if f == 0.0:
        weights = (0.0, 1.0, 0.0, 0.0)
    places = np.arange(values.size) + whole
    out = np.zeros(values.size)
    for k, weight in enumerate(weights):
        if weight != 0.0:
            at = places + k - 1
            inside = (at >= 0) & (at < values.size)
            out += weight * np.where(inside, values[np.clip(at, 0, values.size - 1)], np.nan)
    return out


def _power_gain(cycles_per_m: FloatArray) -> FloatArray:
    """Return the power gain (g,) of the second difference at spatial frequencies (g,)."""
    return np.asarray(
        16.0 * np.sin(np.pi * cycles_per_m * _DIFFERENCE_STEPS * OFF_BRIDGE_STEP_M) ** 4
    )


def _implied_power(mismatch: Mismatch) -> tuple[float, float]:
    """Return the variance in m² of second differences that the levels imply, and their bandwidth.

    The bandwidth is in cycles/m.
    """
    grid = mismatch.shapes.cycles_per_m
    passed = (mismatch.level_m3 @ mismatch.shapes.density) * _power_gain(grid)
    step = float(grid[1] - grid[0])
    power = step * float(passed.sum())
    return power, power**2 / (step * float(passed @ passed))


def wander_posterior(mismatch: Mismatch, share: SharedFraction | None) -> WanderPosterior:
    """Return the posterior of the wander, given the shared fraction of the runs' mismatch.

    Without a shared fraction it is the prior.
    """
    weight = _power_gain(mismatch.shapes.cycles_per_m)
    whole = float(mismatch.level_m3 @ mismatch.shapes.density @ weight)
    common = [
        float(mismatch.level_m3 @ spectra @ weight) / whole
        for spectra in between_runs(*mismatch.shapes.footprints)
    ]
    at = np.log(WANDERS_M)
    fine = np.linspace(at[0], at[-1], _FINE_POINTS)
    score = -0.5 * ((fine - np.log(_USUAL_WANDER_M)) / _USUAL_SPREAD) ** 2
    if share is not None:
        score -= 0.5 * ((np.interp(fine, at, common) - share.value) / share.std) ** 2
    density = np.exp(score - score.max())
    density /= density.sum()
    weights = np.array([np.interp(fine, at, hat) @ density for hat in np.eye(at.size)])
    return WanderPosterior(float(np.exp(density @ fine)), weights)


@lru_cache(maxsize=8)
def between_runs(front: Footprint, rear: Footprint) -> FloatArray:
    """Return `between_run_spectra` (g, s, f) of all values in `WANDERS_M`."""
    return np.stack([between_run_spectra(front, rear, float(w)) for w in WANDERS_M])
