"""A bridge watched: its baseline learned, every period after that compared, until one alarms."""

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pre_core.constants import NORMAL_975
from pre_core.monitoring.baseline import (
    LEVEL_SPREAD,
    Innovation,
    Period,
    Scales,
    State,
    begin,
    change_of,
    change_taken,
    compressed,
    innovation,
    learned,
    moved_on,
    of_scales,
    scales_compared,
    standardised,
    with_change,
)
from pre_core.monitoring.chart import (
    LARGEST,
    Verdict,
    by_scales,
    judged,
    log_ratio,
    moved,
    nothing,
    still,
)

FloatArray = NDArray[np.float64]

AT_LEAST = 0.05
SEASON_DAYS = 364.0
"""Time from the first period in which a season is learned that no thermometer has seen."""
PROBABILITY = 0.975
"""With which a change must be larger than the smallest one of interest."""
_UNLIKELY, _WORTHWHILE = 1e-6, 0.75
"""Scales of a smaller posterior weight are dropped as soon as fewer than this share is left."""


class Rules(NamedTuple):
    """When an alarm is given."""

    false_alarms_per_year: float = 0.01
    """Of one bridge, all its elements and both directions together, at most."""
    periods_per_year: float = 52.0
    learning: int = 8
    """Training periods: those before any is judged."""
    at_least: float = AT_LEAST
    """Smallest change of interest, of EI."""

    @property
    def smallest(self) -> tuple[float, float]:
        """Ends of the changes of ln EI that are too small to be of interest."""
        return float(np.log1p(-self.at_least)), float(np.log1p(self.at_least))

    @property
    def threshold(self) -> float:
        """Logarithm of the mean number of periods until a false alarm."""
        return float(np.log(self.periods_per_year / self.false_alarms_per_year))


class Noted(NamedTuple):
    """A change that was taken note of, by numbers of periods."""

    since: int
    """First period of the changed bridge."""
    at: int
    """Before this period."""


class Change(NamedTuple):
    """What has changed, and since which period."""

    element: int
    """Number from 0."""
    direction: Literal["weaker", "stiffer"]
    raised_at: int
    """Number of the period that raised it."""
    since: int
    """Number of the period in which it began, most likely."""
    sum: float
    """Chart's statistic when it was raised, in standard deviations as `Watched.threshold`."""
    ratio: FloatArray  # (n,) EI now over EI before, of every element
    low: FloatArray
    """(n,) ends of the 95 % interval of that, as `high`."""
    high: FloatArray


class Watched(NamedTuple):
    """What came of watching."""

    standardised: FloatArray
    """(periods, n) innovations over their own standard deviations; NaN while an alarm stands."""
    judged: NDArray[np.bool_]
    """(periods,) whether each was compared with the baseline; the others only taught it."""
    statistic: FloatArray
    """(periods,) sqrt(2 ln R) of the chart; 0 where it says nothing."""
    threshold: float
    """Of the statistic."""
    usual_change: float
    """Root of the mean square of q, of ln EI."""
    usual_wander: float
    """The same of the slow component."""
    change: Change | None
    """The first that was not acknowledged."""


class Difference(NamedTuple):
    """EI in a later period over EI in an earlier one, of every element (n,)."""

    ratio: FloatArray
    low: FloatArray
    """Ends of the 95 % interval, as `high`."""
    high: FloatArray


def judged_periods(periods: Sequence[Period], learning: int) -> NDArray[np.bool_]:
    """Return which periods can be compared with those before.

    A period of known temperature after so many of known temperature; any period a year after the
    first, for then a season is known that no thermometer has seen.
    """
    out = np.zeros(len(periods), dtype=bool)
    warm = 0
    for number, period in enumerate(periods):
        is_year = period.time_days - periods[0].time_days >= SEASON_DAYS
        has_temperature = period.temperature_deg_c is not None
        out[number] = number >= learning and (is_year or (has_temperature and warm >= learning))
        warm += has_temperature
    return out


def watch(periods: Sequence[Period], rules: Rules, acknowledged: Sequence[Noted] = ()) -> Watched:
    """Compare each period with all before, until an alarm.

    `acknowledged`, in order, are changes that were taken note of: what is then is the baseline of
    what follows. Nothing is learned while an alarm stands.
    """
    count = len(periods)
    n = periods[0].observation.value.size if count else 0
    is_judged = judged_periods(periods, rules.learning)
    rows, statistic = np.full((count, n), np.nan), np.zeros(count)
    threshold = _in_deviations(rules.threshold)
    if not is_judged.any():
        return Watched(rows, is_judged, statistic, threshold, 0.0, 0.0, None)
    some = compressed(periods)
    state = begin(some, scales_compared())
    chart, notes = nothing(state), list(acknowledged)
    kept_for = {note.since for note in notes}
    before: dict[int, State] = {}
    """States before the periods in which a change may have begun."""
    found: Change | None = None
    standing = state
    for number, period in enumerate(some):
        if found is None:
            before[number] = state
            state, kept = moved_on(state, period.time_days)
            told = innovation(state, period)
            rows[number] = standardised(state, told)
            inflation = max(1.0, (np.abs(rows[number]).max() / LARGEST) ** 2)
            wander = state.places["wander"]
            weight: FloatArray | None = None
            if is_judged[number]:
                # One wild estimate would move the baseline, and sound periods after it would pass
                # for a change: nothing is learned from it.
                after = state
                if inflation == 1.0:
                    after, weight = learned(state, told)
                chart = moved(chart, number, kept, wander, weight, told, inflation)
                state = after
                ratio, _ = log_ratio(chart, state, number)
                statistic[number] = _in_deviations(ratio)
                if ratio > rules.threshold:
                    verdict = judged(chart, state, number, rules.smallest)
                    if verdict.probability >= PROBABILITY:
                        found = _found(verdict, number, statistic[number])
                        standing = _since(before[found.since], some[found.since : number + 1])
            else:
                wider = told._replace(covariance=inflation * told.covariance)
                state, weight = learned(state, wider)
                chart = still(chart, kept, wander, weight, told)
            likely = state.log_weight > np.log(_UNLIKELY)
            if likely.mean() < _WORTHWHILE:
                state, chart = of_scales(state, likely), by_scales(chart, likely)
            stay = {*chart.begins, *kept_for}
            before = {begin_at: one for begin_at, one in before.items() if begin_at in stay}
        else:  # it stands: what comes says how large it is, and teaches nothing else
            standing = _since(standing, [period], is_first=False)
        if notes and number + 1 >= notes[0].at:
            note = notes.pop(0)
            if note.since in before:
                state = change_taken(_since(before[note.since], some[note.since : number + 1]))
            elif found is not None:
                state = change_taken(standing)
            found, chart = None, nothing(state)
    sizes = _usual(state)
    if found is not None:
        mean, covariance = change_of(standing)
        half = NORMAL_975 * np.sqrt(np.diag(covariance))
        found = found._replace(
            ratio=np.exp(mean), low=np.exp(mean - half), high=np.exp(mean + half)
        )
    return Watched(rows, is_judged, statistic, threshold, *sizes, found)


def difference(first: Period, last: Period) -> Difference:
    """Compare two periods as they were, temperature and season included.

    What they share is in both and is taken out; what one of them has alone counts as its error.
    """
    plain = [period._replace(temperature_deg_c=0.0) for period in (first, last)]
    motionless = Scales(np.zeros(1), np.zeros(1), np.ones(1), np.zeros(1))
    state = begin(plain, motionless)
    at = state.places["slope"]
    state.covariance[:, at, at] = 0.0
    state = _since(state, plain[:1], changes=False)
    mean, covariance = change_of(_since(state, plain[1:]))
    half = NORMAL_975 * np.sqrt(np.diag(covariance))
    return Difference(np.exp(mean), np.exp(mean - half), np.exp(mean + half))


def _since(
    state: State, periods: Sequence[Period], *, is_first: bool = True, changes: bool = True
) -> State:
    """The state behind some periods; in the first of them everything may have changed."""
    if is_first and changes:
        state = with_change(state, LEVEL_SPREAD)
    for number, period in enumerate(periods):
        state, _ = moved_on(state, period.time_days)
        told = innovation(state, period)
        if (is_first and number == 0) or not _is_wild(state, told):
            state, _ = learned(state, told)
    return state


def _is_wild(state: State, told: Innovation) -> bool:
    return bool(np.abs(standardised(state, told)).max() > LARGEST)


def _usual(state: State) -> tuple[float, float]:
    weight = np.exp(state.log_weight)
    return (
        float(np.sqrt(weight @ state.scales.change**2)),
        float(np.sqrt(weight @ state.scales.wander**2)),
    )


def _in_deviations(log_of_ratio: float) -> float:
    """Standard deviations by which a normal is as unlikely: ln R = z²/2."""
    return float(np.sqrt(2.0 * max(0.0, log_of_ratio)))


def _found(verdict: Verdict, number: int, statistic: float) -> Change:
    empty = np.zeros(0)
    direction: Literal["weaker", "stiffer"] = "stiffer" if verdict.is_stiffer else "weaker"
    return Change(verdict.element, direction, number, verdict.begin, statistic, empty, empty, empty)
