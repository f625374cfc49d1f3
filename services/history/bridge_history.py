"""The history of one bridge: fused periods, alarms and the state of its monitoring.

Periods are fused when a bridge is viewed, or ahead of it. For a bridge without monitoring the first
and the last period are compared.
"""

import contextlib
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from schemas.alarms import Alarm
from services.common.language import ENGLISH, Language
from services.common.progress import Steps, no_step_progress
from services.history.alarm_files import alarms_of
from services.history.history_store import (
    HistoryRow,
    partition,
    read_partition,
    unpacked_observation,
)
from services.history.periods import (
    FusedPeriod,
    Unit,
    begin_of,
    by_period,
    fused_periods,
    period_name,
)
from services.history.watch_files import MonitoringState, monitoring_state


class HistoryEntry(NamedTuple):
    """Realm, bridge and entry time of a crossing in a history."""

    realm: str
    bridge: str
    entry_s: float


class ElementChange(NamedTuple):
    """EI of an element in the last period over EI in the first, with its 95 % interval."""

    element: int
    """Number of the element, from 1."""
    ratio: float
    low: float
    high: float

    @property
    def is_clear(self) -> bool:
        """Whether the interval excludes an unchanged EI."""
        return not self.low <= 1.0 <= self.high


class PeriodComparison(NamedTuple):
    """Comparison of the first and the last period with good crossings."""

    first_s: float
    """Beginning in s since 1970 UTC, as for `last_s`."""
    last_s: float
    changes: tuple[ElementChange, ...]


class StoredBaseline(NamedTuple):
    """An earlier state of a bridge, to which a history is related."""

    name: str
    """Name of its results file."""
    mean_nm2: tuple[float, ...]
    """EI of each element in N·m²."""


class BridgeHistory(NamedTuple):
    """History of a bridge in one realm."""

    bridge: str
    realm: str
    unit: Unit
    periods: tuple[FusedPeriod, ...]
    alarms: tuple[Alarm, ...]
    watch: MonitoringState
    comparison: PeriodComparison | None = None
    """Comparison of two periods, for a bridge without monitoring."""
    baseline: StoredBaseline | None = None
    """Baseline that the site file or the caller names."""

    @property
    def active_alarms(self) -> tuple[Alarm, ...]:
        """Alarms without an acknowledgement."""
        return tuple(alarm for alarm in self.alarms if alarm.acknowledged is None)


class Statement(NamedTuple):
    """A sentence about whether a bridge has changed."""

    text: str
    is_reassuring: bool


def bridge_history(
    folder: Path,
    realm: str,
    bridge: str,
    unit: Unit,
    warn: Callable[[str], None],
    now_s: float | None = None,
    progress: Steps = no_step_progress,
) -> BridgeHistory:
    """Read a bridge of a history and fuse its periods; call `warn` with unreadable files.

    `progress` is called after each period.
    The state of its monitoring refers to `now_s`, by default the current time.
    """
    read = read_partition(partition(folder, realm, bridge), ("likelihood", "observation"))
    alarms, problems = alarms_of(folder, realm, bridge)
    now_s = time.time() if now_s is None else now_s
    watch, damaged = monitoring_state(folder, realm, bridge, read.crossings, alarms, now_s)
    for problem in (*read.problems, *problems, *damaged):
        warn(problem)
    periods = fused_periods(folder, realm, bridge, read.crossings, unit, warn, progress)
    comparison = None
    if watch.state not in ("watched", "alarm"):
        comparison = _compare_periods(read.crossings, unit)
    return BridgeHistory(bridge, realm, unit, tuple(periods), tuple(alarms), watch, comparison)


def statements(past: BridgeHistory, language: Language = ENGLISH) -> Iterator[Statement]:
    """Yield the sentences for a bridge without an active alarm."""
    watch = past.watch
    if past.active_alarms:
        return
    yield Statement(watch.words(language), watch.found_nothing)
    if watch.found_nothing:
        return
    sentence = change_over_time(past, language)
    if sentence is None:
        sentence = language.text("change.unseen", units=language.text(f"{past.unit}s"))
    yield Statement(sentence, is_reassuring=False)


def change_over_time(past: BridgeHistory, language: Language = ENGLISH) -> str | None:
    """Return the sentence on the first and the last period; None where they are not compared."""
    if past.comparison is None:
        return None
    return _comparison_sentence(past.comparison, past.unit, language)


def _comparison_sentence(found: PeriodComparison, unit: Unit, language: Language) -> str:
    times = {
        "first": period_name(found.first_s, unit),
        "last": period_name(found.last_s, unit),
        "how": language.text("change.how"),
    }
    size = sorted(found.changes, key=_deviations, reverse=True)
    clear = [one for one in size if one.is_clear]
    if not clear:
        return language.text("change.none", **times, **_in_per_cent(size[0], language))
    changed = ", ".join(
        language.text("change.element", **_in_per_cent(one, language))
        for one in clear[:_MAX_ELEMENTS]
    )
    more = len(clear) - _MAX_ELEMENTS
    others = language.choice("change.more", more) if more > 0 else ""
    return language.text("change.clear", **times, changed=changed + others)


_MAX_ELEMENTS = 3


def _deviations(one: ElementChange) -> float:
    """Return the change in units of its own uncertainty."""
    return float(abs(np.log(one.ratio)) / np.log(one.high / one.low))


def _in_per_cent(one: ElementChange, language: Language) -> dict[str, str | int]:
    change = {
        name: f"{language.number(100.0 * (ratio - 1.0), '+.0f')} %"
        for name, ratio in (("change", one.ratio), ("low", one.low), ("high", one.high))
    }
    return {"element": one.element, **change}


def _compare_periods(crossings: Iterable[HistoryRow], unit: Unit) -> PeriodComparison | None:
    """Compare the first and the last period that have good crossings of the same elements."""
    periods = []
    for begin_s, some in by_period(crossings, unit):
        content = [one.observation for one in some if one.verdict == "good" and one.observation]
        observations = []
        for packed in content:
            with contextlib.suppress(ValueError, EOFError, OSError):
                observations.append(unpacked_observation(packed))
        if observations:
            periods.append((begin_s, observations))
    if len(periods) < 2:
        return None
    # Kernels are slow to import, and usually there is nothing to compare.
    from pre_core.monitoring.baseline import Period
    from pre_core.monitoring.change_detection import compare_periods
    from pre_core.monitoring.observation import combine_observations

    n = periods[-1][1][-1].value.size
    alike = [(begin_s, [o for o in some if o.value.size == n]) for begin_s, some in periods]
    alike = [(begin_s, some) for begin_s, some in alike if some]
    if len(alike) < 2:
        return None
    first, last = (
        Period(combine_observations(some, n), None, begin / 86_400.0)
        for begin, some in (alike[0], alike[-1])
    )
    found = compare_periods(first, last)
    changes = tuple(
        ElementChange(number, float(ratio), float(low), float(high))
        for number, (ratio, low, high) in enumerate(zip(*found, strict=True), start=1)
    )
    return PeriodComparison(alike[0][0], alike[-1][0], changes)


def prefuse_periods(
    folder: Path,
    added: Iterable[HistoryEntry],
    unit: Unit,
    warn: Callable[[str], None],
    progress: Steps = no_step_progress,
) -> int:
    """Fuse the periods to which crossings were added, before they are viewed; return how many.

    `progress` is called after each period, of all bridges.
    """
    touched: defaultdict[tuple[str, str], set[float]] = defaultdict(set)
    for crossing in added:
        where = (crossing.realm, crossing.bridge)
        touched[where].add(begin_of(crossing.entry_s, unit))
    number, before = sum(map(len, touched.values())), 0
    for (realm, bridge), begins in sorted(touched.items()):
        read = read_partition(partition(folder, realm, bridge), ("likelihood",))
        some = [one for one in read.crossings if begin_of(one.entry_s, unit) in begins]

        def step(done: int, _: int, before: int = before) -> None:
            progress(before + done, number)

        fused_periods(folder, realm, bridge, some, unit, warn, step)
        before += len(begins)
    return number
