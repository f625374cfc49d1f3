"""Draws of a density with several or curved peaks: sequential Monte Carlo.

A population follows a path of densities from a wide normal to the target (Del Moral, Doucet and
Jasra 2006). Each step to the next density leaves half of the draws effective (Jasra et al. 2011),
resamples them, and moves each by differences of others (ter Braak 2006), which follow the scales
and directions of the population by themselves. Some moves change only a few coordinates. The first
normal is white in these coordinates.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from pre_core.arrays import FloatArray
from pre_core.search import importance
from pre_core.search.importance import LogDensity

_EFFECTIVE_SHARE = 0.5
"""Effective share of the draws after a step to the next density."""
_HALVINGS = 40
"""Number of bisections by which this step is found."""
_MOVES = 6
"""Number of moves of every draw at each density."""
_MAX_STEPS = 60
_STEP = 2.38
"""Best length of moves along differences of draws from a normal, times the square root of twice the
number of coordinates moved."""
_STEP_SPREAD = 0.4
"""Spread of the logarithm of that length."""
_WHOLE = 0.1
"""Share of moves by a whole difference, from peak to peak."""
_FEW, _FEWER = 0.4, 2.0
"""Share of the coordinates that the second of three moves changes, and mean number that the third
changes: the second follows curved peaks, the third switches values between zero and positive."""


class _Population(NamedTuple):
    x: FloatArray  # (k, d)
    log_target: FloatArray
    log_first: FloatArray


def _log_normal(z: FloatArray) -> FloatArray:
    """Return the log density (k,) of a standard normal at z (k, d), up to a constant."""
    return np.asarray(-0.5 * np.sum(z * z, axis=1))


def tempered_draws(
    target: LogDensity,
    mean: FloatArray,
    covariance: FloatArray,
    count: int,
    moves: Sequence[int],
    rng: np.random.Generator,
    progress: Callable[[float], object] = lambda done: None,
) -> FloatArray:
    """Return draws (len(moves) * count, d) of the density `target`, starting from a wider normal.

    The normal has the `mean` (d,) and the `covariance` (d, d). Each entry of `moves` gives a
    snapshot of `count` draws: the number of moves at the target before it. Draws of a snapshot are
    independent of each other except for resampling. `progress` is called with the completed share.
    """
    root = np.asarray(np.linalg.cholesky(covariance))

    def whitened(z: FloatArray) -> FloatArray:
        return target(mean + z @ root.T)

    x = rng.standard_normal((count, mean.size))
    now = _Population(x, whitened(x), _log_normal(x))
    power = 0.0
    for _ in range(_MAX_STEPS):
        progress(0.5 * power)
        ahead = _next_power(now, power)
        weight = np.exp(_relative(now, ahead - power))
        chosen = importance.systematic_resample(weight, count, rng)
        now, power = _Population(*(values[chosen] for values in now)), ahead
        now = _moved(whitened, now, power, _MOVES, rng)
        if power == 1.0:
            break
    found = []
    for number, some in enumerate(moves):
        progress(0.5 + 0.5 * number / len(moves))
        now = _moved(whitened, now, 1.0, some, rng)
        found.append(now.x)
    return np.asarray(mean + np.concatenate(found) @ root.T)


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
        if number % 3 > 0:
            some = rng.random((count, d)) < (_FEW if number % 3 == 1 else _FEWER / d)
            move *= some
            coordinates = np.maximum(some.sum(axis=1), 1.0)
        length *= _STEP / np.sqrt(2.0 * coordinates)
        length[rng.random(count) < _WHOLE] = 1.0
        x = now.x + length[:, None] * move
        new = _Population(x, target(x), _log_normal(x))
        gain = power * (new.log_target - now.log_target)
        gain += (1.0 - power) * (new.log_first - now.log_first)
        taken = np.log(rng.random(count)) < gain
        now = _Population(
            np.where(taken[:, None], new.x, now.x),
            np.where(taken, new.log_target, now.log_target),
            np.where(taken, new.log_first, now.log_first),
        )
    return now
