"""A bridge's baseline: ln EI at a reference temperature, its slope, and what observations share.

Every period has an observation y of ln EI with own covariance R and loadings K on unit normals z
that other periods have too (trucks, tracks, the bridge's other unknowns):

    y = mu + beta (T - T_0) + K z + own + change,    change ~ N(0, q^2 ((1 - rho) I + rho 1 1')).

mu, beta and z are one normal state; what a period tells is added as in Kalman's filter without
motion. Its innovation is the observation less its prediction from all before, with the covariance S
of both: innovations of a bridge that does not change are independent of each other, whatever
periods share, for what they share is in the prediction.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pre_core.fusion.between import BETWEEN_SCALE
from pre_core.monitoring.observation import Observation

FloatArray = NDArray[np.float64]

REFERENCE_DEG_C = 10.0
LEVEL_SPREAD = 1.0
"""Of ln EI before any crossing: next to nothing is known."""
SLOPE_SPREAD, SLOPE_SPREAD_OWN = 4e-3, 1e-3
"""Of d ln EI/dT in 1/K, common to all elements and of each beside that: concrete and asphalt lose
some tenths of a per cent a kelvin."""
UNKNOWN_DEG_C = 8.0
"""Standard deviation of the temperature of a period of which it is not known."""
CHANGES = (0.0, 0.005, 0.01, 0.02, 0.03, 0.04)
"""Values of q that are compared."""
COMMON_CHANGE = 0.5
"""rho."""


class Period(NamedTuple):
    """What the crossings of some time say together."""

    observation: Observation
    temperature_deg_c: float | None


class State(NamedTuple):
    """What is known: a normal of mu (n), beta (n) and the shared unknowns."""

    mean: FloatArray
    covariance: FloatArray
    places: Mapping[str, slice]
    """Of what is shared, by name."""


class Innovation(NamedTuple):
    """What a period tells beyond what was predicted of it."""

    value: FloatArray  # (n,)
    covariance: FloatArray  # (n, n) of it
    predicted: FloatArray  # (n,) ln EI


def begin(first: Observation) -> State:
    """Nothing known but where the first observation is, roughly."""
    n = first.value.size
    covariance = np.zeros((2 * n, 2 * n))
    covariance[:n, :n] = LEVEL_SPREAD**2 * np.eye(n)
    covariance[n:, n:] = SLOPE_SPREAD**2 + SLOPE_SPREAD_OWN**2 * np.eye(n)
    return State(np.concatenate([first.value, np.zeros(n)]), covariance, {})


def innovation(state: State, period: Period, change: float) -> tuple[State, Innovation]:
    """The innovation of a period, and the state that knows of it; `change` is q."""
    state = _with_places(state, period.observation)
    across, noise = _rows(state, period, change)
    predicted = across @ state.mean
    gain = state.covariance @ across.T
    covariance = across @ gain + noise
    value = period.observation.value - predicted
    factor = np.linalg.cholesky(covariance)
    told = np.linalg.solve(factor, np.column_stack([value, gain.T]))
    mean = state.mean + told[:, 1:].T @ told[:, 0]
    after = State(mean, state.covariance - told[:, 1:].T @ told[:, 1:], state.places)
    return after, Innovation(value, covariance, predicted)


def log_evidence(of: Innovation) -> float:
    """Logarithm of the density of what was observed, but for a constant."""
    factor = np.linalg.cholesky(of.covariance)
    apart = np.linalg.solve(factor, of.value)
    return float(-0.5 * apart @ apart - np.log(np.diag(factor)).sum())


def usual_change(periods: Sequence[Period]) -> float:
    """q by how periods differ in which the bridge is taken not to change: root of its mean square.

    Over `CHANGES`, with a half-normal prior of scale 4 %, as between crossings.
    """
    log = np.array([-0.5 * (q / BETWEEN_SCALE) ** 2 for q in CHANGES])
    for number, q in enumerate(CHANGES):
        state = begin(periods[0].observation)
        for period in periods:
            state, found = innovation(state, period, q)
            log[number] += log_evidence(found)
    weight = np.exp(log - log.max()) * np.gradient(np.array(CHANGES))
    return float(np.sqrt(weight @ np.square(CHANGES) / weight.sum()))


def changed_since(
    state: State, periods: Sequence[Period], change: float, spread: float
) -> tuple[State, FloatArray, FloatArray]:
    """By how much ln EI (n,) is another in some periods than before, and its covariance.

    `state` knows of all before. And the state with what is now as its level, for what comes after.
    """
    n = periods[0].observation.value.size
    size = state.mean.size
    covariance = np.zeros((size + n, size + n))
    covariance[:size, :size] = state.covariance
    covariance[size:, size:] = spread**2 * np.eye(n)
    places = {**state.places, _CHANGE: slice(size, size + n)}
    now = State(np.concatenate([state.mean, np.zeros(n)]), covariance, places)
    for period in periods:
        now, _ = innovation(now, period, change)
    at = now.places[_CHANGE]
    return _moved(now), now.mean[at], now.covariance[at, at]


_CHANGE = "change"


def _moved(state: State) -> State:
    """The state with mu + change for mu, and without the change."""
    at = state.places[_CHANGE]
    n = at.stop - at.start
    move = np.eye(state.mean.size)
    move[:n, at] = np.eye(n)
    kept = np.delete(move, np.arange(at.start, at.stop), axis=0)
    places = {
        name: slice(where.start - n, where.stop - n) if where.start > at.start else where
        for name, where in state.places.items()
        if name != _CHANGE
    }
    return State(kept @ state.mean, _symmetric(kept @ state.covariance @ kept.T), places)


def _with_places(state: State, observation: Observation) -> State:
    """The state with unit normals for what it has not yet met."""
    new = [one for one in observation.shared if one.name not in state.places]
    if not new:
        return state
    places = dict(state.places)
    size = state.mean.size
    for one in new:
        r = one.loading.shape[1]
        places[one.name] = slice(size, size + r)
        size += r
    covariance = np.eye(size)
    before = state.mean.size
    covariance[:before, :before] = state.covariance
    return State(np.concatenate([state.mean, np.zeros(size - before)]), covariance, places)


def _rows(state: State, period: Period, change: float) -> tuple[FloatArray, FloatArray]:
    """How an observation goes with the state (n, size), and its own covariance (n, n)."""
    of = period.observation
    n = of.value.size
    across = np.zeros((n, state.mean.size))
    across[:, :n] = np.eye(n)
    noise = of.own + change**2 * ((1.0 - COMMON_CHANGE) * np.eye(n) + COMMON_CHANGE)
    if period.temperature_deg_c is None:
        noise = noise + (SLOPE_SPREAD * UNKNOWN_DEG_C) ** 2
    else:
        across[:, n : 2 * n] = (period.temperature_deg_c - REFERENCE_DEG_C) * np.eye(n)
    for name, loading in of.shared:
        across[:, state.places[name]] = loading
    if _CHANGE in state.places:
        across[:, state.places[_CHANGE]] = np.eye(n)
    return across, noise


def _symmetric(covariance: FloatArray) -> FloatArray:
    return np.asarray(0.5 * (covariance + covariance.T))
