"""Draws of a density with several or curved peaks: sequential Monte Carlo.

A population follows a path of densities from a wide normal to the target (Del Moral, Doucet and
Jasra 2006). Each step to the next density leaves half of the draws effective (Jasra et al. 2011),
resamples them, and moves each by differences of others (ter Braak 2006), which follow the scales
and directions of the population by themselves.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from pre_core.arrays import FloatArray
from pre_core.search import importance
from pre_core.search.importance import LogDensity

_EFFECTIVE_SHARE = 0.5
"""Effective share of the draws after a step to the next density."""
_HALVINGS = 40
"""Halvings of the interval that contains this step."""
_MOVES, _LAST_MOVES = 6, 30
"""Numbers of moves of every draw: at each density, and at the target before each snapshot."""
_MAX_STEPS = 60
_STEP = 2.38
"""Best length of moves along differences of draws from a normal, times the square root of twice the
number of coordinates moved."""
_STEP_SPREAD = 0.4
"""Spread of the logarithm of that length."""
_WHOLE = 0.1
"""Share of moves by a whole difference, from peak to peak."""
_FEW = 0.4
"""Share of the coordinates in every third move, which leaves the others as they are."""


class _Population(NamedTuple):
    x: FloatArray  # (k, d)
    log_target: FloatArray
    log_first: FloatArray


class _Wide(NamedTuple):
    """A normal, from which the population begins."""

    mean: FloatArray  # (d,)
    root: FloatArray  # (d, d) lower triangular root of the covariance

    def log_density(self, x: FloatArray) -> FloatArray:
        """Return the log density (k,) at x (k, d), up to a constant."""
        z = np.linalg.solve(self.root, (x - self.mean).T)
        return np.asarray(-0.5 * np.sum(z * z, axis=0))


def tempered_draws(
    target: LogDensity,
    mean: FloatArray,
    covariance: FloatArray,
    count: int,
    snapshots: int,
    rng: np.random.Generator,
    progress: Callable[[float], object] = lambda done: None,
) -> FloatArray:
    """Return draws (snapshots * count, d) of a density, from a normal that is wider.

    The normal has the `mean` (d,) and the `covariance` (d, d). The draws of a snapshot are
    independent of each other except for resampling, and follow those of the previous one by moves
    at the target. `progress` is called with the completed share.
    """
    wide = _Wide(mean, np.asarray(np.linalg.cholesky(covariance)))
    x = mean + rng.standard_normal((count, mean.size)) @ wide.root.T
    now = _Population(x, target(x), wide.log_density(x))
    power = 0.0
    for _ in range(_MAX_STEPS):
        progress(0.5 * power)
        ahead = _next_power(now, power)
        weight = np.exp(_relative(now, ahead - power))
        chosen = importance.systematic_resample(weight, count, rng)
        now, power = _Population(*(values[chosen] for values in now)), ahead
        now = _moved(target, wide, now, power, _MOVES, rng)
        if power == 1.0:
            break
    found = []
    for number in range(snapshots):
        progress(0.5 + 0.5 * number / snapshots)
        now = _moved(target, wide, now, 1.0, _LAST_MOVES, rng)
        found.append(now.x)
    return np.concatenate(found)


def _relative(now: _Population, step: float) -> FloatArray:
    """Return the log weights (k,) of draws after a step of the target's power, at most zero."""
    change = step * (now.log_target - now.log_first)
    return np.asarray(change - change.max())


def _next_power(now: _Population, power: float) -> float:
    """Return the largest power of the target that leaves enough effective draws."""

    def is_near(ahead: float) -> bool:
        weight = np.exp(_relative(now, ahead - power))
        return float(weight.sum() ** 2) > _EFFECTIVE_SHARE * weight.size * float(weight @ weight)

    if is_near(1.0):
        return 1.0
    low, high = power, 1.0
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if is_near(middle) else (low, middle)
    return high


def _moved(
    target: LogDensity,
    wide: _Wide,
    now: _Population,
    power: float,
    moves: int,
    rng: np.random.Generator,
) -> _Population:
    """Return the population after moves that keep first^(1 - power) target^power."""
    count, d = now.x.shape
    for number in range(moves):
        move = now.x[rng.integers(count, size=count)] - now.x[rng.integers(count, size=count)]
        length = np.exp(_STEP_SPREAD * rng.standard_normal(count))
        coordinates = np.full(count, float(d))
        if number % 3 == 2:
            some = rng.random((count, d)) < _FEW
            move *= some
            coordinates = np.maximum(some.sum(axis=1), 1.0)
        length *= _STEP / np.sqrt(2.0 * coordinates)
        length[rng.random(count) < _WHOLE] = 1.0
        x = now.x + length[:, None] * move
        new = _Population(x, target(x), wide.log_density(x))
        gain = power * (new.log_target - now.log_target)
        gain += (1.0 - power) * (new.log_first - now.log_first)
        taken = np.log(rng.random(count)) < gain
        now = _Population(
            np.where(taken[:, None], new.x, now.x),
            np.where(taken, new.log_target, now.log_target),
            np.where(taken, new.log_first, now.log_first),
        )
    return now
