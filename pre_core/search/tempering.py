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
_BISECTIONS = 40
"""Number of bisections by which this step is found."""
_MOVES = 6
"""Number of moves of every draw at each density."""
_MAX_STEPS = 60
"""Limit of densities on the path to the target."""
_STEP = 2.38
"""Best length of moves along differences of draws from a normal, times the square root of twice the
number of coordinates moved."""
_STEP_SPREAD = 0.4
"""Standard deviation of the logarithm of that length."""
_WHOLE_SHARE = 0.1
"""Share of moves by a whole difference, which lead from peak to peak."""
_CHANGED_SHARE, _CHANGED_NUMBER = 0.4, 2.0
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
    population = _Population(x, whitened(x), _log_normal(x))
    power = 0.0
    for _ in range(_MAX_STEPS):
        progress(0.5 * power)
        next_power = _next_power(population, power)
        weight = np.exp(_relative(population, next_power - power))
        chosen = importance.systematic_resample(weight, count, rng)
        population, power = _Population(*(values[chosen] for values in population)), next_power
        population = _moved(whitened, population, power, _MOVES, rng)
        if power == 1.0:
            break
    found = []
    for number, moves_before in enumerate(moves):
        progress(0.5 + 0.5 * number / len(moves))
        population = _moved(whitened, population, 1.0, moves_before, rng)
        found.append(population.x)
    return np.asarray(mean + np.concatenate(found) @ root.T)


def _relative(population: _Population, step: float) -> FloatArray:
    """Return the log weights (k,) of draws after a step of the target's power, at most zero."""
    change = step * (population.log_target - population.log_first)
    return np.asarray(change - change.max())


def _next_power(population: _Population, power: float) -> float:
    """Return the largest power of the target that leaves enough effective draws."""

    def is_near(next_power: float) -> bool:
        weight = np.exp(_relative(population, next_power - power))
        return float(weight.sum() ** 2) > _EFFECTIVE_SHARE * weight.size * float(weight @ weight)

    if is_near(1.0):
        return 1.0
    low, high = power, 1.0
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if is_near(middle) else (low, middle)
    return high


def _moved(
    target: LogDensity,
    population: _Population,
    power: float,
    moves: int,
    rng: np.random.Generator,
) -> _Population:
    """Return the population after moves that keep first^(1 - power) target^power."""
    count, d = population.x.shape
    for number in range(moves):
        move = (
            population.x[rng.integers(count, size=count)]
            - population.x[rng.integers(count, size=count)]
        )
        length = np.exp(_STEP_SPREAD * rng.standard_normal(count))
        coordinates = np.full(count, float(d))
        if number % 3 > 0:
            is_changed = rng.random((count, d)) < (
                _CHANGED_SHARE if number % 3 == 1 else _CHANGED_NUMBER / d
            )
            move *= is_changed
            coordinates = np.maximum(is_changed.sum(axis=1), 1.0)
        length *= _STEP / np.sqrt(2.0 * coordinates)
        length[rng.random(count) < _WHOLE_SHARE] = 1.0
        x = population.x + length[:, None] * move
        new = _Population(x, target(x), _log_normal(x))
        log_ratio = power * (new.log_target - population.log_target)
        log_ratio += (1.0 - power) * (new.log_first - population.log_first)
        is_accepted = np.log(rng.random(count)) < log_ratio
        population = _Population(
            np.where(is_accepted[:, None], new.x, population.x),
            np.where(is_accepted, new.log_target, population.log_target),
            np.where(is_accepted, new.log_first, population.log_first),
        )
    return population
