"""Change detection: train the baseline, compare every later period, until an alarm."""

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pre_core.arrays import FloatArray
from pre_core.constants import NORMAL_975
from pre_core.monitoring.baseline import (
    LEVEL_SPREAD,
    BaselineState,
    Innovation,
    Period,
    Scales,
    adopt_change,
    change_of,
    compress_shared_errors,
    filter_step,
    initial_baseline,
    predict_state,
    scales_compared,
    select_scales,
    standardised,
    update_state,
    with_change,
)
from pre_core.monitoring.chart import (
    MAX_STANDARDISED,
    Chart,
    ChartVerdict,
    chart_verdict,
    empty_chart,
    log_ratio,
    select_chart_scales,
    skip_period,
    update_chart,
)

SMALLEST_CHANGE = 0.05
SEASON_DAYS = 364.0
"""Time after the first period from which the season is known without temperatures."""
PROBABILITY = 0.975
"""Probability with which a change must exceed the smallest one of interest."""
_UNLIKELY, _WORTHWHILE = 1e-6, 0.75
"""Posterior weight below which scales are dropped, and share of the scales below which the
remaining ones must be for that to be worthwhile."""


class AlarmRules(NamedTuple):
    """Conditions of an alarm."""

    false_alarms_per_year: float = 0.01
    """Tolerated false alarms of one bridge, over all its elements and both directions."""
    periods_per_year: float = 52.0
    training: int = 8
    """Number of training periods before the first comparison."""
    at_least: float = SMALLEST_CHANGE
    """Smallest change of EI of interest."""

    @property
    def smallest(self) -> tuple[float, float]:
        """The limits of the changes of ln EI that are too small to be of interest: low, high."""
        return float(np.log1p(-self.at_least)), float(np.log1p(self.at_least))

    @property
    def threshold(self) -> float:
        """The threshold of ln R: the log of the mean number of periods until a false alarm."""
        return float(np.log(self.periods_per_year / self.false_alarms_per_year))


class AcknowledgedChange(NamedTuple):
    """An acknowledged change, given by numbers of periods."""

    since: int
    """First period of the changed bridge."""
    at: int
    """Period before which it was acknowledged."""


class Change(NamedTuple):
    """A detected change and the period in which it began."""

    element: int
    """Number of the element, from 0."""
    direction: Literal["weaker", "stiffer"]
    raised_at: int
    """Number of the period that raised it."""
    since: int
    """Number of the period in which it most likely began."""
    sum: float
    """Chart's statistic at the alarm, in standard deviations like `MonitoringResult.threshold`."""
    ratio: FloatArray  # (n,) EI now over EI before, of every element
    low: FloatArray
    """Lower ends (n,) of its 95 % intervals; `high` are the upper ones."""
    high: FloatArray


class MonitoringResult(NamedTuple):
    """Result of monitoring over all periods."""

    standardised: FloatArray
    """Innovations (periods, n) over their standard deviations; NaN during an alarm."""
    judged: NDArray[np.bool_]
    """Flags (periods,) of the periods that were compared with the baseline; others only trained it.
    """
    statistic: FloatArray
    """Chart statistic sqrt(2 ln R), (periods,); 0 where there is none."""
    threshold: float
    """Threshold of the statistic, in the same unit."""
    usual_change: float
    """Posterior root mean square of q, the standard deviation of ln EI between periods."""
    usual_drift: float
    """Posterior root mean square of s, the standard deviation of the slow drift of ln EI."""
    change: Change | None
    """The first change that was not acknowledged."""


class PeriodDifference(NamedTuple):
    """Ratio of EI in a later period to EI in an earlier one, of every element (n,)."""

    ratio: FloatArray
    low: FloatArray
    """Lower ends of the 95 % intervals; `high` are the upper ones."""
    high: FloatArray


def judged_periods(periods: Sequence[Period], training: int) -> NDArray[np.bool_]:
    """Return flags (periods,) of the periods that can be compared with earlier ones.

    These are periods of known temperature after the first `training` such periods, and any period
    a year after the first one, when the season is known without a thermometer.
    """
    out = np.zeros(len(periods), dtype=bool)
    warm = 0
    for number, period in enumerate(periods):
        is_year = period.time_days - periods[0].time_days >= SEASON_DAYS
        has_temperature = period.temperature_deg_c is not None
        out[number] = number >= training and (is_year or (has_temperature and warm >= training))
        warm += has_temperature
    return out


def detect_change(
    periods: Sequence[Period], rules: AlarmRules, acknowledged: Sequence[AcknowledgedChange] = ()
) -> MonitoringResult:
    """Compare each period with all earlier ones, until an alarm.

    Changes in `acknowledged`, in order of time, are part of the baseline of later periods. During
    an alarm the baseline is not updated.
    """
    count = len(periods)
    n = periods[0].observation.value.size if count else 0
    is_judged = judged_periods(periods, rules.training)
    rows, statistic = np.full((count, n), np.nan), np.zeros(count)
    threshold = _in_deviations(rules.threshold)
    if not is_judged.any():
        return MonitoringResult(rows, is_judged, statistic, threshold, 0.0, 0.0, None)
    some = compress_shared_errors(periods)
    state = initial_baseline(some, scales_compared())
    chart, notes = empty_chart(state), list(acknowledged)
    kept_for = {note.since for note in notes}
    before: dict[int, BaselineState] = {}
    """States before the periods in which a change may have begun."""
    found: Change | None = None
    standing = state
    for number, period in enumerate(some):
        if found is None:
            before[number] = state
            state, kept = predict_state(state, period.time_days)
            innovation = filter_step(state, period)
            rows[number] = standardised(state, innovation)
            inflation = max(1.0, (np.abs(rows[number]).max() / MAX_STANDARDISED) ** 2)
            drift = state.indices["drift"]
            if is_judged[number]:
                state, gain = _update_unless_outlier(state, innovation, inflation)
                chart = update_chart(chart, number, kept, drift, gain, innovation, inflation)
                ratio, _ = log_ratio(chart, state, number)
                statistic[number] = _in_deviations(ratio)
                found = _alarm(chart, state, number, ratio, rules)
                if found is not None:
                    standing = _since(before[found.since], some[found.since : number + 1])
            else:
                wider = innovation._replace(covariance=inflation * innovation.covariance)
                state, gain = update_state(state, wider)
                chart = skip_period(chart, kept, drift, gain, innovation)
            state, chart = _without_unlikely_scales(state, chart)
            stay = {*chart.begins, *kept_for}
            before = {begin_at: one for begin_at, one in before.items() if begin_at in stay}
        else:  # an alarm is active: later periods only estimate its size
            standing = _since(standing, [period], is_first=False)
        if notes and number + 1 >= notes[0].at:
            note = notes.pop(0)
            if note.since in before:
                state = adopt_change(_since(before[note.since], some[note.since : number + 1]))
            elif found is not None:
                state = adopt_change(standing)
            found, chart = None, empty_chart(state)
    if found is not None:
        found = _with_interval(found, standing)
    return MonitoringResult(rows, is_judged, statistic, threshold, *_usual(state), found)


def _update_unless_outlier(
    state: BaselineState, innovation: Innovation, inflation: float
) -> tuple[BaselineState, FloatArray | None]:
    """Return the state after a judged period, and the Kalman gain (`update_state`).

    An outlier, whose covariance is inflated, leaves the state as it is and has no gain: otherwise
    it would shift the baseline, and undamaged periods would look like a change.
    """
    return update_state(state, innovation) if inflation == 1.0 else (state, None)


def _alarm(
    chart: Chart, state: BaselineState, number: int, ratio: float, rules: AlarmRules
) -> Change | None:
    """Return the change that the chart shows, if it is probably of interest; `ratio` is ln R."""
    if ratio > rules.threshold:
        verdict = chart_verdict(chart, state, number, rules.smallest)
        if verdict.probability >= PROBABILITY:
            return _found(verdict, number, _in_deviations(ratio))
    return None


def _with_interval(change: Change, standing: BaselineState) -> Change:
    """Return a change with the ratios that a filter with the change in its state estimates."""
    mean, covariance = change_of(standing)
    half = NORMAL_975 * np.sqrt(np.diag(covariance))
    return change._replace(ratio=np.exp(mean), low=np.exp(mean - half), high=np.exp(mean + half))


def _without_unlikely_scales(state: BaselineState, chart: Chart) -> tuple[BaselineState, Chart]:
    """Return state and chart of the likely scales, if dropping the others saves enough."""
    likely = state.log_weight > np.log(_UNLIKELY)
    if likely.mean() < _WORTHWHILE:
        return select_scales(state, likely), select_chart_scales(chart, likely)
    return state, chart


def compare_periods(first: Period, last: Period) -> PeriodDifference:
    """Compare two periods without a correction for temperature, season or usual changes.

    Shared errors cancel; each period's own errors count.
    """
    plain = [period._replace(temperature_deg_c=0.0) for period in (first, last)]
    motionless = Scales(np.zeros(1), np.zeros(1), np.ones(1), np.zeros(1))
    state = initial_baseline(plain, motionless)
    at = state.indices["slope"]
    state.covariance[:, at, at] = 0.0
    state = _since(state, plain[:1], changes=False)
    mean, covariance = change_of(_since(state, plain[1:]))
    half = NORMAL_975 * np.sqrt(np.diag(covariance))
    return PeriodDifference(np.exp(mean), np.exp(mean - half), np.exp(mean + half))


def _since(
    state: BaselineState, periods: Sequence[Period], *, is_first: bool = True, changes: bool = True
) -> BaselineState:
    """Return the state after some periods; in the first of them everything may have changed."""
    if is_first and changes:
        state = with_change(state, LEVEL_SPREAD)
    for number, period in enumerate(periods):
        state, _ = predict_state(state, period.time_days)
        innovation = filter_step(state, period)
        if (is_first and number == 0) or not _is_outlier(state, innovation):
            state, _ = update_state(state, innovation)
    return state


def _is_outlier(state: BaselineState, innovation: Innovation) -> bool:
    return bool(np.abs(standardised(state, innovation)).max() > MAX_STANDARDISED)


def _usual(state: BaselineState) -> tuple[float, float]:
    weight = np.exp(state.log_weight)
    return (
        float(np.sqrt(weight @ state.scales.change**2)),
        float(np.sqrt(weight @ state.scales.drift**2)),
    )


def _in_deviations(log_of_ratio: float) -> float:
    """Return the deviate z of a standard normal that is as unlikely: ln R = z²/2."""
    return float(np.sqrt(2.0 * max(0.0, log_of_ratio)))


def _found(verdict: ChartVerdict, number: int, statistic: float) -> Change:
    empty = np.zeros(0)
    direction: Literal["weaker", "stiffer"] = "stiffer" if verdict.is_stiffer else "weaker"
    return Change(verdict.element, direction, number, verdict.begin, statistic, empty, empty, empty)
