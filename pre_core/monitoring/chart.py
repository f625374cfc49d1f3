"""Chart for a step in one element, in any past period, by more than a smallest change.

A step delta of ln EI in period k adds G(t, k) delta to every later innovation of the Kalman filter
(A. S. Willsky and H. L. Jones, IEEE Trans. Automatic Control 21 (1976)), with G known:

    G = I - H F,    F <- Phi F + W G,

H the observation, Phi the state-transition matrix, W the Kalman gain. So no filter has to be run
for each possible change: sums of G' S^-1 G and G' S^-1 e suffice. With delta ~ N(0, s^2) of one
element j, L_jk is the ratio of the densities with and without it, the scales of the usual changes
integrated out in both. The Shiryaev-Roberts statistic

    R_t = sum over k of the mean over j of L_jk(t)

has the mean t without a change: R_t - t is a martingale, so the mean time to a false alarm at R > A
is at least A (M. Pollak, Annals of Statistics 13 (1985)), whatever the uncertainty of the baseline,
if its priors are true.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from pre_core.arrays import FloatArray
from pre_core.monitoring.baseline import LEVEL_SPREAD, BaselineState, Innovation, log_sum

STEP_SPREAD = 0.15
"""Prior standard deviation s of a step of one element's ln EI."""
MAX_STANDARDISED = 4.0
"""Limit of an innovation, in standard deviations."""
MIN_PERIODS = 3
"""Fewest periods since the change for an alarm."""
_ALL_KEPT = 8
"""Number of latest beginnings that are all kept; of older ones, two in each doubling of the lag."""


class Chart(NamedTuple):
    """The c possible beginnings of a change, and the statistics of later innovations for each."""

    begins: tuple[int, ...]
    """Numbers of periods."""
    response: FloatArray  # (m, size, c, n): F
    information: FloatArray  # (m, c, n, n): sum of G' S^-1 G
    score: FloatArray  # (m, c, n): sum of G' S^-1 e


class ChartVerdict(NamedTuple):
    """Result of the chart after a period."""

    log_ratio: float
    """Logarithm of R."""
    element: int
    """Element, from 0, that most likely changed."""
    begin: int
    """Number of the period in which the change most likely began."""
    is_stiffer: bool
    probability: float
    """Probability that a change, if any, exceeds the smallest one of interest."""


def empty_chart(state: BaselineState) -> Chart:
    """Return a chart without periods."""
    m, size = state.mean.shape
    n = state.indices["level"].stop
    return Chart((), np.zeros((m, size, 0, n)), np.zeros((m, 0, n, n)), np.zeros((m, 0, n)))


def select_chart_scales(chart: Chart, kept: NDArray[np.bool_]) -> Chart:
    """Return the chart with a subset of its scales (m,)."""
    return Chart(chart.begins, chart.response[kept], chart.information[kept], chart.score[kept])


def skip_period(
    chart: Chart, kept: FloatArray, drift: slice, gain: FloatArray, innovation: Innovation
) -> Chart:
    """Return the chart after a period that is not tested.

    `kept` (m,), `drift` and `gain` (m, size, n) are as in `update_chart`.
    """
    return chart._replace(response=_responded(chart, kept, drift, gain, innovation)[0])


def update_chart(
    chart: Chart,
    number: int,
    kept: FloatArray,
    drift: slice,
    gain: FloatArray | None,
    innovation: Innovation,
    inflation: float,
) -> Chart:
    """Return the chart after a period.

    `number` is the period's, `kept` (m,) the remaining share of the drift since the previous
    period, `drift` the drift's indices in the state, `gain` (m, size, n) the Kalman gain (None
    without an update), `inflation` the factor of the innovation's covariance.
    """
    m, size, _, n = chart.response.shape
    chart = Chart(
        (*chart.begins, number),
        np.concatenate([chart.response, np.zeros((m, size, 1, n))], axis=2),
        np.concatenate([chart.information, np.zeros((m, 1, n, n))], axis=1),
        np.concatenate([chart.score, np.zeros((m, 1, n))], axis=1),
    )
    c = len(chart.begins)
    response, shown = _responded(chart, kept, drift, gain, innovation)
    flat = shown.reshape(m, n, c * n)
    covariance = inflation * innovation.covariance
    solved = np.linalg.solve(
        covariance, np.concatenate([flat, innovation.value[:, :, None]], axis=2)
    )
    by_begin = solved[:, :, :-1].reshape(m, n, c, n)
    information = chart.information + np.matmul(
        shown.transpose(0, 2, 3, 1), by_begin.transpose(0, 2, 1, 3)
    )
    score = chart.score + (flat.transpose(0, 2, 1) @ solved[:, :, -1:]).reshape(m, c, n)
    stay = [at for at, begin in enumerate(chart.begins) if _is_kept(begin, number - begin)]
    return Chart(
        tuple(chart.begins[at] for at in stay),
        response[:, :, stay],
        information[:, stay],
        score[:, stay],
    )


def _responded(
    chart: Chart,
    kept: FloatArray,
    drift: slice,
    gain: FloatArray | None,
    innovation: Innovation,
) -> tuple[FloatArray, FloatArray]:
    """Return F after a period, and G (m, n, c, n)."""
    m, size, c, n = chart.response.shape
    before = chart.response.copy()
    before[:, drift] *= kept[:, None, None, None]
    shown = -(innovation.across @ before.reshape(m, size, c * n)).reshape(m, n, c, n)
    shown += np.eye(n)[:, None, :]
    if gain is not None:
        before += (gain @ shown.reshape(m, n, c * n)).reshape(m, size, c, n)
    return before, shown


def _is_kept(begin: int, lag: int) -> bool:
    if lag < _ALL_KEPT:
        return True
    return begin % (2 ** int(np.log2(lag / 2.0))) == 0


def log_ratio(chart: Chart, state: BaselineState, number: int) -> tuple[float, FloatArray]:
    """Return ln R after a period, and ln L (c, n), minus infinity where it is too early."""
    n = state.indices["level"].stop
    if not chart.begins:
        return -np.inf, np.zeros((0, n))
    of_it = np.diagonal(chart.information, axis1=2, axis2=3)
    by_scale = 0.5 * chart.score**2 / (of_it + STEP_SPREAD**-2)
    by_scale = by_scale - 0.5 * np.log1p(STEP_SPREAD**2 * of_it)
    log = log_sum(by_scale + state.log_weight[:, None, None])
    log[[number - begin + 1 < MIN_PERIODS for begin in chart.begins]] = -np.inf
    return float(log_sum(log.ravel()) - np.log(n)), log


def chart_verdict(
    chart: Chart, state: BaselineState, number: int, smallest: tuple[float, float]
) -> ChartVerdict:
    """Return the chart's result; changes of ln EI within `smallest` (low, high) are of no interest.

    The probability is that of the element's own change, with all elements free to change, averaged
    over elements and beginnings by their probability.
    """
    total, log = log_ratio(chart, state, number)
    n = chart.score.shape[2]
    precision = chart.information + LEVEL_SPREAD**-2 * np.eye(n)
    covariance = np.linalg.inv(precision)
    mean = (covariance @ chart.score[..., None])[..., 0]
    by_scale = 0.5 * np.sum(chart.score * mean, axis=2) - 0.5 * np.linalg.slogdet(precision)[1]
    by_scale = by_scale + state.log_weight[:, None]
    weight = np.exp(by_scale - log_sum(by_scale))[..., None]
    spread = np.sqrt(np.diagonal(covariance, axis1=2, axis2=3))
    low, high = smallest
    larger = np.sum(weight * (ndtr((low - mean) / spread) + ndtr((mean - high) / spread)), axis=0)
    share = np.exp(log - log_sum(log.ravel()))
    element = int(share.sum(axis=0).argmax())
    at = int(share[:, element].argmax())
    is_stiffer = bool(np.sum(weight[:, at, 0] * mean[:, at, element]) > 0.0)
    return ChartVerdict(
        total, element, chart.begins[at], is_stiffer, float(min(1.0, np.sum(share * larger)))
    )
