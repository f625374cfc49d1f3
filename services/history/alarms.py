"""Alarms of a history, raised where the periods of a bridge differ from earlier ones.

While an alarm is active, no other of that bridge is raised. `alarm_files` holds its file.
"""

import json
import logging
from collections.abc import Iterable, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Final, NamedTuple

from pre_core.monitoring.baseline import Period
from pre_core.monitoring.change_detection import (
    SEASON_DAYS,
    SMALLEST_CHANGE,
    AcknowledgedChange,
    AlarmRules,
    MonitoringResult,
    detect_change,
)
from pre_core.monitoring.observation import Observation, combine_observations
from schemas.alarms import Alarm
from services.common.child_process import ChildPool
from services.common.files import make_folder, write_atomically
from services.history.alarm_files import ALARMS, active_alarms, alarms_folder, alarms_of
from services.history.history_store import (
    HistoryRow,
    bridges_of,
    partition,
    read_partition,
    unpacked_observation,
)
from services.history.periods import PER_YEAR, Unit, begin_of, by_period, end_of, mean_temperature
from services.history.watch_files import (
    MonitoringState,
    WatchRecord,
    monitoring_state,
    record_path,
    write_record,
)

_log = logging.getLogger(__name__)
_CHECKED: Final = "checked.json"
DEFAULT_UNIT: Final[Unit] = "week"
DEFAULT_FALSE_ALARMS: Final = 0.01
"""Tolerated false alarms per bridge and year."""
DAY_S: Final = 86_400.0
_CLOCK_S: Final = 60.0
"""Longest time in s between reading a bridge and writing its record."""
_BATCH = 50
"""Number of bridges that a process checks at a time."""


class AlarmSettings(NamedTuple):
    """Settings of a history's alarms."""

    unit: Unit = DEFAULT_UNIT
    false_alarms_per_year: float = DEFAULT_FALSE_ALARMS
    training: int = 8
    """Number of training periods."""
    at_least: float = SMALLEST_CHANGE
    """Smallest change of interest, relative to EI."""

    def rules(self) -> AlarmRules:
        """Return these settings for `detect_change`."""
        return AlarmRules(
            self.false_alarms_per_year, PER_YEAR[self.unit], self.training, self.at_least
        )


class MonitoredBridge(NamedTuple):
    """Result of monitoring one bridge; times in s since 1970 UTC."""

    result: MonitoringResult | None
    """Result of the detection; None without usable crossings."""
    alarm: Alarm | None
    """Alarm that the periods raise, whether it is written or not."""
    record: WatchRecord
    """Summary of the judged periods."""
    problems: tuple[str, ...]


class AlarmCheck(NamedTuple):
    """Outcome of a check of all bridges."""

    raised: tuple[Alarm, ...]
    """Alarms that are new."""
    active: tuple[Alarm, ...]
    """Alarms without an acknowledgement, new ones included."""
    bridges: int
    """Number of bridges checked."""
    problems: tuple[str, ...]


def monitoring_states(
    folder: Path, now_s: float
) -> tuple[dict[tuple[str, str], MonitoringState], list[str]]:
    """Return the state of monitoring by realm and bridge, and lines of what is unreadable.

    Crossings are read only of bridges to which some may have been added since the last check.
    """
    found, problems = {}, []
    for (realm, bridge), where in bridges_of(folder).items():
        alarms, _ = alarms_of(folder, realm, bridge)
        path = record_path(folder, realm, bridge)
        is_unchanged = path.exists() and where.stat().st_mtime < path.stat().st_mtime - _CLOCK_S
        crossings = None if is_unchanged else read_partition(where).crossings
        found[(realm, bridge)], wrong = monitoring_state(
            folder, realm, bridge, crossings, alarms, now_s
        )
        problems += wrong
    return found, problems


def monitor_bridge(
    folder: Path, realm: str, bridge: str, settings: AlarmSettings, now_s: float
) -> MonitoredBridge:
    """Compare the completed periods of a bridge with each other; return the alarm they raise."""
    read = read_partition(partition(folder, realm, bridge), ("observation",))
    problems = list(read.problems)
    alarms, wrong = alarms_of(folder, realm, bridge)
    problems += wrong
    begins, periods = _periods(read.crossings, settings.unit, now_s, problems)
    record = _record(read.crossings, begins, settings, now_s)
    if not periods:
        return MonitoredBridge(None, None, record, tuple(problems))
    notes = [
        AcknowledgedChange(
            since=sum(begin < alarm.since for begin in begins),
            at=sum(end_of(begin, settings.unit) <= alarm.acknowledged.time for begin in begins),
        )
        for alarm in alarms
        if alarm.acknowledged is not None
    ]
    try:
        result = detect_change(periods, settings.rules(), sorted(notes, key=lambda note: note.at))
    except ArithmeticError as error:
        problem = f"cannot be watched: {error}"
        problems.append(f"{partition(folder, realm, bridge)}: {problem}")
        record = record.model_copy(update={"problem": problem})
        return MonitoredBridge(None, None, record, tuple(problems))
    record = _judged(record, periods, begins, result, settings)
    alarm = None
    if result.change is not None:
        of = result.change
        raised = end_of(begins[of.raised_at], settings.unit)
        day = datetime.fromtimestamp(raised, UTC)
        alarm = Alarm(
            alarm_id=f"{day:%Y%m%d}-{of.element + 1}-{of.direction}",
            realm=realm,
            bridge=bridge,
            element=of.element + 1,
            direction=of.direction,
            since=begins[of.since],
            raised=raised,
            sum=of.sum,
            threshold=result.threshold,
            ratio=float(of.ratio[of.element]),
            ratio_q025=float(of.low[of.element]),
            ratio_q975=float(of.high[of.element]),
        )
    return MonitoredBridge(result, alarm, record, tuple(problems))


def check(
    folder: Path,
    settings: AlarmSettings,
    now_s: float,
    *,
    processes: int = 1,
    everything: bool = False,
) -> AlarmCheck:
    """Check all bridges that may have changed since the last check; write their alarms.

    A bridge is checked again when crossings were added or another period is over; with `everything`
    all bridges are.
    """
    seen = {} if everything else _checked(folder)
    marks = change_markers(folder, settings, now_s)
    work = [
        name
        for name, mark in marks.items()
        if seen.get("/".join(name)) != mark or not record_path(folder, *name).exists()
    ]
    batches = [work[n : n + _BATCH] for n in range(0, len(work), _BATCH)]
    raised: list[Alarm] = []
    problems: list[str] = []
    given = ((folder, batch, settings, now_s) for batch in batches)
    if processes > 1 and len(batches) > 1:
        with ChildPool(processes, "forkserver") as pool:
            results = list(pool.map(_checked_batch, given))
    else:
        results = [_checked_batch(one) for one in given]
    for some, wrong in results:
        raised += some
        problems += wrong
    save_markers(folder, marks)
    now_active, wrong = active_alarms(folder)
    return AlarmCheck(
        tuple(raised), tuple(now_active), len(work), tuple(dict.fromkeys([*problems, *wrong]))
    )


def change_markers(
    folder: Path, settings: AlarmSettings, now_s: float
) -> dict[tuple[str, str], list[object]]:
    """Return by realm and bridge the values that change when it has to be checked again."""
    today = [settings.unit, begin_of(now_s, settings.unit)]
    rules = [settings.false_alarms_per_year, settings.training, settings.at_least]
    bridges = bridges_of(folder).items()
    return {name: [where.stat().st_mtime_ns, *today, *rules] for name, where in bridges}


def save_markers(folder: Path, marks: Mapping[tuple[str, str], list[object]]) -> None:
    """Write the markers of the bridges checked."""
    make_folder(folder / ALARMS)
    entries = {"/".join(name): mark for name, mark in marks.items()}
    write_atomically(folder / ALARMS / _CHECKED, json.dumps(entries))


def _checked_batch(
    given: tuple[Path, Sequence[tuple[str, str]], AlarmSettings, float],
) -> tuple[list[Alarm], list[str]]:
    folder, batch, settings, now_s = given
    raised: list[Alarm] = []
    problems: list[str] = []
    for realm, bridge in batch:
        found = monitor_bridge(folder, realm, bridge, settings, now_s)
        problems += found.problems
        write_record(folder, realm, bridge, found.record)
        if found.alarm is not None and _raise(folder, found.alarm):
            raised.append(found.alarm)
    return raised, problems


def _raise(folder: Path, alarm: Alarm) -> bool:
    """Write an alarm, unless one of that bridge is active; return whether it was written."""
    if any(one.acknowledged is None for one in alarms_of(folder, alarm.realm, alarm.bridge)[0]):
        return False
    path = alarms_folder(folder, alarm.realm, alarm.bridge) / f"{alarm.alarm_id}.json"
    if path.exists():
        return False
    make_folder(path.parent)
    write_atomically(path, alarm.model_dump_json(indent=1) + "\n")
    return True


def _periods(
    crossings: Iterable[HistoryRow], unit: Unit, now_s: float, problems: list[str]
) -> tuple[list[float], list[Period]]:
    """Return the completed periods of good crossings that have the latest one's elements."""
    usable: list[tuple[HistoryRow, Observation]] = []
    for one in crossings:
        if one.verdict != "good" or one.observation is None:
            continue
        try:
            usable.append((one, unpacked_observation(one.observation)))
        except (ValueError, EOFError, OSError) as error:
            problems.append(f"{one.crossing_id}: left out: its observation is damaged: {error}")
    if not usable:
        return [], []
    elements = usable[-1][1].value.size
    alike = {one.crossing_id: o for one, o in usable if o.value.size == elements}
    kept = [one for one, _ in usable if one.crossing_id in alike]
    begins, periods = [], []
    for begin, some in by_period(kept, unit):
        if end_of(begin, unit) <= now_s:
            together = combine_observations([alike[one.crossing_id] for one in some], elements)
            middle_s = 0.5 * (begin + end_of(begin, unit))
            begins.append(begin)
            periods.append(Period(together, mean_temperature(some), middle_s / DAY_S))
    return begins, periods


def _record(
    crossings: Sequence[HistoryRow], begins: Sequence[float], settings: AlarmSettings, now_s: float
) -> WatchRecord:
    """Return the record of a bridge before anything is judged."""
    until = begin_of(now_s, settings.unit)
    return WatchRecord(
        checked=now_s,
        period=settings.unit,
        until=until,
        crossings=sum(one.entry_s < until for one in crossings),
        newest=max((one.entry_s for one in crossings), default=None),
        periods=len(begins),
        judged=0,
        training=settings.training,
        at_least=settings.at_least,
    )


def _judged(
    record: WatchRecord,
    periods: Sequence[Period],
    begins: Sequence[float],
    result: MonitoringResult,
    settings: AlarmSettings,
) -> WatchRecord:
    """Return the record with the judged periods."""
    judged = [begin for begin, one in zip(begins, result.judged, strict=True) if one]
    if judged:
        to = end_of(judged[-1], settings.unit)
        found = {"judged": len(judged), "judged_from": judged[0], "judged_to": to}
        return record.model_copy(update=found)
    known = sum(period.temperature_deg_c is not None for period in periods)
    if len(periods) < settings.training or known == len(periods):
        return record
    return record.model_copy(update={"year_ends": begins[0] + SEASON_DAYS * DAY_S})


def _checked(folder: Path) -> dict[str, list[object]]:
    """Return the markers of the last check; none where they are unknown."""
    path = folder / ALARMS / _CHECKED
    try:
        found = json.loads(path.read_bytes())
    except FileNotFoundError:
        return {}
    except (OSError, ValueError):
        _log.warning("%s: unreadable; checking all bridges", path)
        return {}
    return found if isinstance(found, dict) else {}
