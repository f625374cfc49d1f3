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
    State,
    begin,
    changed_since,
    innovation,
    usual_change,
)
from pre_core.monitoring.cusum import LARGEST, moved, nothing, threshold_for

FloatArray = NDArray[np.float64]


class Rules(NamedTuple):
    """When an alarm is given."""

    false_alarms_per_year: float = 0.01
    """Of one bridge, all its elements and both directions together."""
    periods_per_year: float = 52.0
    learning: int = 8
    """Periods before any chart begins."""


class Change(NamedTuple):
    """What has changed, and since which period."""

    element: int
    """From 0: that whose sum passed the threshold, by the most if several did."""
    direction: Literal["weaker", "stiffer"]
    raised_at: int
    """Number of the period in which the sum passed the threshold."""
    since: int
    """Number of the period in which it began, most likely."""
    sum: float
    ratio: FloatArray  # (n,) EI now over EI before, of every element
    low: FloatArray
    """(n,) ends of the 95 % interval of that, as `high`."""
    high: FloatArray


class Watched(NamedTuple):
    """What came of watching."""

    standardised: FloatArray
    """(periods, n) innovations over their own standard deviations; NaN while it was learned."""
    sums: FloatArray  # (periods, 2, n): up and down
    threshold: float
    usual_change: float
    change: Change | None
    """The first that was not acknowledged."""


def watch(periods: Sequence[Period], rules: Rules, acknowledged: Sequence[int] = ()) -> Watched:
    """Compare each period with all before, until an alarm.

    `acknowledged` are numbers of periods, rising, before which a change was taken note of: what is
    then is the baseline of what follows. Nothing is learned while an alarm stands.
    """
    count = len(periods)
    n = periods[0].observation.value.size if count else 0
    standardised = np.full((count, n), np.nan)
    sums = np.zeros((count, 2, n))
    threshold = threshold_for(rules.false_alarms_per_year, 2 * max(n, 1), rules.periods_per_year)
    if count < rules.learning:
        return Watched(standardised, sums, threshold, 0.0, None)
    change_of_periods = usual_change(periods[: rules.learning])
    states = [begin(periods[0].observation)]
    for period in periods[: rules.learning]:
        after, told = innovation(states[-1], period, change_of_periods)
        states.append(_learned(states[-1], after, _standardised(told)))
    chart = nothing(n)
    start = rules.learning
    found: Change | None = None
    notes = [number for number in acknowledged if number > start]
    number = start
    while number < count:
        if found is None:
            after, told = innovation(states[-1], periods[number], change_of_periods)
            standardised[number] = _standardised(told)
            chart = moved(chart, standardised[number])
            states.append(_learned(states[-1], after, standardised[number]))
            sums[number] = chart
            found = _passed(sums, standardised, threshold, number, start)
        else:  # it stands: what comes is told, not learned
            told = innovation(states[found.since], periods[number], change_of_periods)[1]
            standardised[number] = _standardised(told)
            sums[number] = sums[number - 1]
        number += 1
        if notes and number >= notes[0]:
            note = notes.pop(0)
            if found is not None:
                during = periods[found.since : note]
                moved_state = changed_since(
                    states[found.since], during, change_of_periods, LEVEL_SPREAD
                )[0]
                states = states[: found.since] + [moved_state] * (note + 1 - found.since)
                found, start = None, note
            chart = nothing(n)
    if found is None:
        return Watched(standardised, sums, threshold, change_of_periods, None)
    _, mean, covariance = changed_since(
        states[found.since], periods[found.since :], change_of_periods, LEVEL_SPREAD
    )
    half = NORMAL_975 * np.sqrt(np.diag(covariance))
    told_change = found._replace(
        ratio=np.exp(mean), low=np.exp(mean - half), high=np.exp(mean + half)
    )
    return Watched(standardised, sums, threshold, change_of_periods, told_change)


def _learned(before: State, after: State, standardised: FloatArray) -> State:
    """What is known behind a period: nothing is learned from one that can hardly be of this bridge.

    One wild estimate would move the baseline, and sound periods after it would pass for a change.
    """
    return before if np.abs(standardised).max() > LARGEST else after


def _standardised(of: Innovation) -> FloatArray:
    return np.asarray(of.value / np.sqrt(np.diag(of.covariance)))


def _passed(
    sums: FloatArray, standardised: FloatArray, threshold: float, number: int, start: int
) -> Change | None:
    if sums[number].max() <= threshold:
        return None
    side, element = np.unravel_index(int(sums[number].argmax()), sums[number].shape)
    of_it = sums[start : number + 1, side, element]
    zeros = np.flatnonzero(of_it == 0.0)
    first = start + (int(zeros[-1]) + 1 if zeros.size else 0)
    # From which on the mean of the innovations is furthest from zero: the likeliest.
    backwards = np.cumsum(standardised[first : number + 1, element][::-1])
    likeliest = np.argmax(np.square(backwards) / np.arange(1, backwards.size + 1))
    since = number - int(likeliest)
    empty = np.zeros(0)
    direction: Literal["weaker", "stiffer"] = "stiffer" if side == 0 else "weaker"
    largest = float(sums[number, side, element])
    return Change(int(element), direction, number, since, largest, empty, empty, empty)
