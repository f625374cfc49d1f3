"""A bridge's baseline: ln EI at a reference temperature, its usual changes, and shared errors.

Every period has an observation y of ln EI with own covariance R and loadings K on unit normals z
that it shares with other periods (trucks, wheel-path groups, the other bridge parameters):

    y = mu + beta (T - T_0) + drift + K z + own + change,    own ~ N(0, R),
    change ~ N(0, q^2 C),    drift: Ornstein-Uhlenbeck, standard deviation s, correlation time T_c,

with C = (1 - rho) I + rho 1 1'. Without a temperature, beta (T - T_0) is replaced by an annual wave
of unknown amplitude and phase in each element, a semi-annual one and an offset common to all, and
the weather's deviation from it as noise.

mu, beta, drift, season and z are one normal state of a Kalman filter. q, s and T_c are unknown:
the filter runs for each of `scales_compared()` at once, and the weight of each run is its prior
times the density of the observations. Innovations of an unchanged bridge are independent even if
periods share errors, because the prediction contains the shared part.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pre_core.arrays import FloatArray
from pre_core.constants import SLOPE_SPREAD
from pre_core.fusion.variability import BETWEEN_SCALE
from pre_core.monitoring.observation import Observation, SharedError

REFERENCE_DEG_C = 10.0
LEVEL_SPREAD = 1.0
"""Prior standard deviation of ln EI, nearly uninformative."""
SLOPE_SPREAD_OWN = 1e-3
"""Prior standard deviation of the part of d ln EI/dT of a single element, 1/K."""
SEASON_K, HALF_SEASON_K, OFFSET_K, WEATHER_K = 11.0, 3.0, 8.0, 4.0
"""Standard deviations in K of an unknown temperature: of each part of the annual wave, of the
half-annual wave, of the annual mean, and of a period's weather."""
DAYS_PER_YEAR = 365.25
CHANGES = (0.0, 0.005, 0.015, 0.04)
"""Grid of q; half-normal prior of scale 4 %, as between crossings."""
DRIFTS = (0.0, 0.006, 0.012, 0.02)
"""Grid of s; larger values would explain a slow loss."""
DRIFT_SCALE = 0.012
"""Scale of the half-normal prior of s."""
CORRELATIONS_DAYS = (56.0, 280.0)
"""Grid of T_c, equally likely."""
COMMON_CHANGE = 0.5
"""Correlation rho of the changes of two elements."""
_NEGLIGIBLE = 0.01
"""Share of an observation's own variance below which a direction of shared error counts as own."""


class Period(NamedTuple):
    """The observation of a bridge in one period of time."""

    observation: Observation
    temperature_deg_c: float | None
    time_days: float
    """Middle of the period."""


class Scales(NamedTuple):
    """Grid of the sizes of usual changes, (m,) each."""

    change: FloatArray
    """Values of q."""
    drift: FloatArray
    """Values of s."""
    correlation_days: FloatArray
    """Values of T_c."""
    log_prior: FloatArray


class BaselineState(NamedTuple):
    """State of the filter for each of m scales: a normal of all variables (size,)."""

    mean: FloatArray  # (m, size)
    covariance: FloatArray  # (m, size, size)
    log_weight: FloatArray
    """Logarithm (m,) of the posterior weight, normalised."""
    indices: Mapping[str, slice]
    """Indices of each variable in the state, by name: level, drift, slope, season, change, or the
    name of a shared error."""
    scales: Scales
    time_days: float


class Innovation(NamedTuple):
    """Difference between the observation of a period and its prediction, for each scale."""

    value: FloatArray  # (m, n)
    covariance: FloatArray  # (m, n, n) of it
    across: FloatArray  # (n, size): observation matrix
    cross_covariance: FloatArray  # (m, size, n): of state and innovation


def scales_compared() -> Scales:
    """Return the grid of q, s and T_c with its prior."""
    drifts = [(0.0, CORRELATIONS_DAYS[0], 1.0)]
    drifts += [
        (s, days, 1.0 / len(CORRELATIONS_DAYS)) for s in DRIFTS[1:] for days in CORRELATIONS_DAYS
    ]
    widths_q = dict(zip(CHANGES, np.gradient(np.array(CHANGES)), strict=True))
    widths_s = dict(zip(DRIFTS, np.gradient(np.array(DRIFTS)), strict=True))
    rows = np.array(
        [
            (q, s, days, np.log(share * widths_q[q] * widths_s[s])
             - 0.5 * (q / BETWEEN_SCALE) ** 2 - 0.5 * (s / DRIFT_SCALE) ** 2)
            for q in CHANGES
            for s, days, share in drifts
        ]
    )  # fmt: skip
    log_prior = rows[:, 3] - log_sum(rows[:, 3])
    return Scales(rows[:, 0], rows[:, 1], rows[:, 2], log_prior)


def initial_baseline(periods: Sequence[Period], scales: Scales) -> BaselineState:
    """Return the state before the first of some periods, with all variables that they need."""
    n, m = periods[0].observation.value.size, scales.change.size
    blocks: dict[str, FloatArray] = {"level": LEVEL_SPREAD**2 * np.eye(n), "drift": _correlation(n)}
    if any(period.temperature_deg_c is not None for period in periods):
        blocks["slope"] = _of_slope(n)
    if any(period.temperature_deg_c is None for period in periods):
        season = np.zeros((2 * n + 3, 2 * n + 3))
        season[:n, :n] = season[n : 2 * n, n : 2 * n] = SEASON_K**2 * _of_slope(n)
        others_k = np.array([HALF_SEASON_K, HALF_SEASON_K, OFFSET_K])
        season[2 * n :, 2 * n :] = np.diag((SLOPE_SPREAD * others_k) ** 2)
        blocks["season"] = season
    for period in periods:
        for one in period.observation.shared:
            blocks.setdefault(one.name, np.eye(one.loading.shape[1]))
    indices, size = {}, 0
    for name, block in blocks.items():
        indices[name] = slice(size, size + len(block))
        size += len(block)
    covariance = np.zeros((m, size, size))
    for name, block in blocks.items():
        factor = scales.drift**2 if name == "drift" else np.ones(m)
        covariance[:, indices[name], indices[name]] = factor[:, None, None] * block
    mean = np.zeros((m, size))
    mean[:, :n] = periods[0].observation.value
    return BaselineState(mean, covariance, scales.log_prior, indices, scales, periods[0].time_days)


def predict_state(state: BaselineState, time_days: float) -> tuple[BaselineState, FloatArray]:
    """Return the state at a later time, and the remaining share (m,) of the drift."""
    passed = max(0.0, time_days - state.time_days)
    kept = np.exp(-passed / state.scales.correlation_days)
    at = state.indices["drift"]
    mean, covariance = state.mean.copy(), state.covariance.copy()
    mean[:, at] *= kept[:, None]
    covariance[:, at, :] *= kept[:, None, None]
    covariance[:, :, at] *= kept[:, None, None]
    added = state.scales.drift**2 * (1.0 - kept**2)
    covariance[:, at, at] += added[:, None, None] * _correlation(at.stop - at.start)
    return state._replace(mean=mean, covariance=covariance, time_days=time_days), kept


def filter_step(state: BaselineState, period: Period) -> Innovation:
    """Return the innovation of a period at the time of the state."""
    across, noise = _rows(state, period)
    n = len(across)
    cross_covariance = state.covariance @ across.T
    own = state.scales.change[:, None, None] ** 2 * _correlation(n)
    covariance = across @ cross_covariance + noise + own
    value = period.observation.value - state.mean @ across.T
    return Innovation(value, covariance, across, cross_covariance)


def update_state(state: BaselineState, innovation: Innovation) -> tuple[BaselineState, FloatArray]:
    """Return the state after an innovation, and the Kalman gain (m, size, n)."""
    gain = np.asarray(
        np.linalg.solve(
            innovation.covariance, innovation.cross_covariance.transpose(0, 2, 1)
        ).transpose(0, 2, 1)
    )
    mean = state.mean + (gain @ innovation.value[:, :, None])[:, :, 0]
    covariance = state.covariance - gain @ innovation.cross_covariance.transpose(0, 2, 1)
    covariance = 0.5 * (covariance + covariance.transpose(0, 2, 1))
    log = state.log_weight + log_density(innovation)
    return state._replace(mean=mean, covariance=covariance, log_weight=log - log_sum(log)), gain


def log_density(innovation: Innovation) -> FloatArray:
    """Return the log density (m,) of an innovation for each scale, up to a constant."""
    apart = np.linalg.solve(innovation.covariance, innovation.value[:, :, None])[:, :, 0]
    return np.asarray(
        -0.5 * np.sum(apart * innovation.value, axis=1)
        - 0.5 * np.linalg.slogdet(innovation.covariance)[1]
    )


def select_scales(state: BaselineState, kept: NDArray[np.bool_]) -> BaselineState:
    """Return the state with a subset of its scales (m,)."""
    log = state.log_weight[kept]
    return state._replace(
        mean=state.mean[kept],
        covariance=state.covariance[kept],
        log_weight=log - log_sum(log),
        scales=Scales(*(one[kept] for one in state.scales)),
    )


def standardised(state: BaselineState, innovation: Innovation) -> FloatArray:
    """Return the innovation (n,), averaged over the scales, divided by its standard deviation."""
    weight = np.exp(state.log_weight)
    mean = weight @ innovation.value
    spread = np.diagonal(innovation.covariance, axis1=1, axis2=2) + (innovation.value - mean) ** 2
    return np.asarray(mean / np.sqrt(weight @ spread))


def with_change(state: BaselineState, spread: float) -> BaselineState:
    """Return the state with a change of ln EI from now on, of prior standard deviation `spread`."""
    m, size = state.mean.shape
    n = state.indices["level"].stop
    covariance = np.zeros((m, size + n, size + n))
    covariance[:, :size, :size] = state.covariance
    covariance[:, size:, size:] = spread**2 * np.eye(n)
    mean = np.concatenate([state.mean, np.zeros((m, n))], axis=1)
    indices = {**state.indices, _CHANGE: slice(size, size + n)}
    return state._replace(mean=mean, covariance=covariance, indices=indices)


def change_of(state: BaselineState) -> tuple[FloatArray, FloatArray]:
    """Return mean (n,) and covariance (n, n) of the change that `with_change` has added."""
    at = state.indices[_CHANGE]
    weight = np.exp(state.log_weight)
    means = state.mean[:, at]
    mean = weight @ means
    between = np.einsum("m,mi,mj->ij", weight, means - mean, means - mean)
    return mean, np.einsum("m,mij->ij", weight, state.covariance[:, at, at]) + between


def adopt_change(state: BaselineState) -> BaselineState:
    """Return the state with level + change as the level, and without the change."""
    at = state.indices[_CHANGE]
    n = at.stop - at.start
    move = np.eye(state.mean.shape[1])
    move[:n, at] = np.eye(n)
    kept = np.delete(move, np.arange(at.start, at.stop), axis=0)
    indices = {name: where for name, where in state.indices.items() if name != _CHANGE}
    covariance = kept @ state.covariance @ kept.T
    return state._replace(mean=state.mean @ kept.T, covariance=covariance, indices=indices)


_CHANGE = "change"


def compress_shared_errors(periods: Sequence[Period]) -> list[Period]:
    """Return periods whose shared errors have as few variables as necessary.

    For each name, directions that carry more than a hundredth of an observation's own variance in
    any period are kept; the rest is added to the own covariance.
    """
    stacked: dict[str, list[FloatArray]] = {}
    for period in periods:
        # Whitened by the observation's own covariance.
        root = np.linalg.inv(np.linalg.cholesky(period.observation.own))
        for one in period.observation.shared:
            stacked.setdefault(one.name, []).append(root @ one.loading)
    kept = {name: _directions(some) for name, some in stacked.items()}
    return [_with_directions(period, kept) for period in periods]


def _directions(whitened: Iterable[FloatArray]) -> FloatArray:
    """Return an orthonormal basis (r, p) of the significant directions of loadings (n, r)."""
    some = list(whitened)
    basis = np.linalg.svd(np.concatenate(some), full_matrices=False)[2].T
    size = np.array([np.sum((one @ basis) ** 2, axis=0) for one in some])  # (periods, p)
    behind = size[:, ::-1].cumsum(axis=1)[:, ::-1].max(axis=0)
    return np.asarray(basis[:, behind > _NEGLIGIBLE])


def _with_directions(period: Period, kept: Mapping[str, FloatArray]) -> Period:
    of = period.observation
    own, shared = of.own, []
    for name, loading in of.shared:
        moved = loading @ kept[name]
        rest = loading - moved @ kept[name].T
        own = own + rest @ rest.T
        if moved.shape[1]:
            shared.append(SharedError(name, moved))
    return period._replace(observation=Observation(of.value, own, tuple(shared)))


def _rows(state: BaselineState, period: Period) -> tuple[FloatArray, FloatArray]:
    """Return the observation matrix (n, size) and the noise covariance (n, n) without q."""
    of = period.observation
    n = of.value.size
    across = np.zeros((n, state.mean.shape[1]))
    noise = of.own
    for name in ("level", "drift", _CHANGE):
        if name in state.indices:
            across[:, state.indices[name]] = np.eye(n)
    if period.temperature_deg_c is not None:
        warmer = period.temperature_deg_c - REFERENCE_DEG_C
        across[:, state.indices["slope"]] = warmer * np.eye(n)
    else:
        phase = 2.0 * np.pi * period.time_days / DAYS_PER_YEAR
        at = state.indices["season"].start
        across[:, at : at + n] = np.cos(phase) * np.eye(n)
        across[:, at + n : at + 2 * n] = np.sin(phase) * np.eye(n)
        across[:, at + 2 * n : at + 2 * n + 3] = np.cos(2.0 * phase), np.sin(2.0 * phase), 1.0
        noise = noise + (SLOPE_SPREAD * WEATHER_K) ** 2
    for name, loading in of.shared:
        across[:, state.indices[name]] = loading
    return across, noise


def _of_slope(n: int) -> FloatArray:
    return SLOPE_SPREAD**2 + SLOPE_SPREAD_OWN**2 * np.eye(n)


def _correlation(n: int) -> FloatArray:
    """Return the matrix C."""
    return (1.0 - COMMON_CHANGE) * np.eye(n) + COMMON_CHANGE


def log_sum(log: FloatArray) -> FloatArray:
    """Return the logarithm of the sum of exponentials over the first axis of (k, …)."""
    top = log.max(axis=0)
    top = np.where(np.isfinite(top), top, 0.0)
    with np.errstate(divide="ignore"):  # where all terms are zero
        return np.asarray(top + np.log(np.exp(log - top).sum(axis=0)))
