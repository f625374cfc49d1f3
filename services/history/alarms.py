"""Alarms of a history: raised where the periods of a bridge are unlike those before.

While an alarm stands, no other of that bridge is raised. Its file is `alarm_files`' matter.
"""

import json
import logging
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from datetime import UTC, datetime
from multiprocessing import get_context
from pathlib import Path
from typing import Final, NamedTuple

from pre_core.monitoring.baseline import Period
from pre_core.monitoring.observation import Observation, fused
from pre_core.monitoring.watch import AT_LEAST, SEASON_DAYS, Noted, Rules, Watched, watch
from schemas.alarms import Alarm
from services.common.files import make_folder, write_atomically
from services.history.alarm_files import ALARMS, alarms_folder, alarms_of, standing
from services.history.archive import (
    Kept,
    bridges_of,
    partition,
    read_partition,
    unpacked_observation,
)
from services.history.periods import PER_YEAR, Unit, begin_of, by_period, end_of, mean_temperature
from services.history.watch_files import Watch, WatchRecord, record_path, watch_of, write_record

_log = logging.getLogger(__name__)
_CHECKED: Final = "checked.json"
DEFAULT_UNIT: Final[Unit] = "week"
DEFAULT_FALSE_ALARMS: Final = 0.01
"""Of one bridge in a year."""
DAY_S: Final = 86_400.0
_CLOCK_S: Final = 60.0
"""A check takes less than that from reading a bridge to writing down what was judged of it."""
_BATCH = 50
"""Bridges that a process takes at a time."""


class Settings(NamedTuple):
    """What is asked of the alarms of a history."""

    unit: Unit = DEFAULT_UNIT
    false_alarms_per_year: float = DEFAULT_FALSE_ALARMS
    learning: int = 8
    """Training periods."""
    at_least: float = AT_LEAST
    """Smallest change of interest, of EI."""

    def rules(self) -> Rules:
        """The same for `watch`."""
        return Rules(self.false_alarms_per_year, PER_YEAR[self.unit], self.learning, self.at_least)


class WatchedBridge(NamedTuple):
    """A bridge as it was watched; times in s since 1970 UTC."""

    begins_s: tuple[float, ...]
    """Of the periods."""
    watched: Watched | None
    """None without crossings that could be watched."""
    alarm: Alarm | None
    """That the periods raise, whether it is written down or not."""
    record: WatchRecord
    """What was judged."""
    problems: tuple[str, ...]


class Checked(NamedTuple):
    """What came of looking at all bridges."""

    raised: tuple[Alarm, ...]
    """New ones."""
    standing: tuple[Alarm, ...]
    """All that nobody has acknowledged, the new ones among them."""
    bridges: int
    """That were looked at."""
    problems: tuple[str, ...]


def watches(folder: Path, now_s: float) -> tuple[dict[tuple[str, str], Watch], list[str]]:
    """Return by realm and bridge whether each is watched; and lines of what cannot be read.

    Crossings are read only of bridges to which some may have been added since the last check.
    """
    found, problems = {}, []
    for (realm, bridge), where in bridges_of(folder).items():
        alarms, _ = alarms_of(folder, realm, bridge)
        path = record_path(folder, realm, bridge)
        is_unchanged = path.exists() and where.stat().st_mtime < path.stat().st_mtime - _CLOCK_S
        crossings = None if is_unchanged else read_partition(where).crossings
        found[(realm, bridge)], wrong = watch_of(folder, realm, bridge, crossings, alarms, now_s)
        problems += wrong
    return found, problems


def watch_bridge(
    folder: Path, realm: str, bridge: str, settings: Settings, now_s: float
) -> WatchedBridge:
    """Compare the periods of a bridge that are over with each other, and raise what they raise."""
    read = read_partition(partition(folder, realm, bridge), ("observation",))
    problems = list(read.problems)
    alarms, wrong = alarms_of(folder, realm, bridge)
    problems += wrong
    begins, periods = _periods(read.crossings, settings.unit, now_s, problems)
    record = _record(read.crossings, begins, settings, now_s)
    if not periods:
        return WatchedBridge((), None, None, record, tuple(problems))
    notes = [
        Noted(
            since=sum(begin < alarm.since for begin in begins),
            at=sum(end_of(begin, settings.unit) <= alarm.acknowledged.time for begin in begins),
        )
        for alarm in alarms
        if alarm.acknowledged is not None
    ]
    try:
        watched = watch(periods, settings.rules(), sorted(notes, key=lambda note: note.at))
    except ArithmeticError as error:
        problem = f"cannot be watched: {error}"
        problems.append(f"{partition(folder, realm, bridge)}: {problem}")
        record = record.model_copy(update={"problem": problem})
        return WatchedBridge(tuple(begins), None, None, record, tuple(problems))
    record = _judged(record, periods, begins, watched, settings)
    alarm = None
    if watched.change is not None:
        of = watched.change
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
            threshold=watched.threshold,
            ratio=float(of.ratio[of.element]),
            ratio_q025=float(of.low[of.element]),
            ratio_q975=float(of.high[of.element]),
        )
    return WatchedBridge(tuple(begins), watched, alarm, record, tuple(problems))


def check(
    folder: Path, settings: Settings, now_s: float, *, processes: int = 1, everything: bool = False
) -> Checked:
    """Look at all bridges of which something may have changed since the last time; write alarms.

    A bridge is looked at again when crossings were added or another period is over; `everything`:
    all of them.
    """
    seen = {} if everything else _checked(folder)
    marks = marks_of(folder, settings, now_s)
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
        with ProcessPoolExecutor(processes, get_context("forkserver")) as pool:
            results = list(pool.map(_checked_batch, given))
    else:
        results = [_checked_batch(one) for one in given]
    for some, wrong in results:
        raised += some
        problems += wrong
    remember(folder, marks)
    now_standing, wrong = standing(folder)
    return Checked(
        tuple(raised), tuple(now_standing), len(work), tuple(dict.fromkeys([*problems, *wrong]))
    )


def marks_of(folder: Path, settings: Settings, now_s: float) -> dict[tuple[str, str], list[object]]:
    """By realm and bridge: what is another as soon as the bridge has to be looked at again."""
    today = [settings.unit, begin_of(now_s, settings.unit)]
    rules = [settings.false_alarms_per_year, settings.learning, settings.at_least]
    bridges = bridges_of(folder).items()
    return {name: [where.stat().st_mtime_ns, *today, *rules] for name, where in bridges}


def remember(folder: Path, marks: Mapping[tuple[str, str], list[object]]) -> None:
    """Write down at what bridges were looked."""
    make_folder(folder / ALARMS)
    told = {"/".join(name): mark for name, mark in marks.items()}
    write_atomically(folder / ALARMS / _CHECKED, json.dumps(told))


def _checked_batch(
    given: tuple[Path, Sequence[tuple[str, str]], Settings, float],
) -> tuple[list[Alarm], list[str]]:
    folder, batch, settings, now_s = given
    raised: list[Alarm] = []
    problems: list[str] = []
    for realm, bridge in batch:
        found = watch_bridge(folder, realm, bridge, settings, now_s)
        problems += found.problems
        write_record(folder, realm, bridge, found.record)
        if found.alarm is not None and _raise(folder, found.alarm):
            raised.append(found.alarm)
    return raised, problems


def _raise(folder: Path, alarm: Alarm) -> bool:
    """Write an alarm down, unless one of that bridge stands."""
    if any(one.acknowledged is None for one in alarms_of(folder, alarm.realm, alarm.bridge)[0]):
        return False
    path = alarms_folder(folder, alarm.realm, alarm.bridge) / f"{alarm.alarm_id}.json"
    if path.exists():
        return False
    make_folder(path.parent)
    write_atomically(path, alarm.model_dump_json(indent=1) + "\n")
    return True


def _periods(
    crossings: Iterable[Kept], unit: Unit, now_s: float, problems: list[str]
) -> tuple[list[float], list[Period]]:
    """Periods that are over, of crossings that are good and of the elements of the latest."""
    usable: list[tuple[Kept, Observation]] = []
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
            together = fused([alike[one.crossing_id] for one in some], elements)
            middle_s = 0.5 * (begin + end_of(begin, unit))
            begins.append(begin)
            periods.append(Period(together, mean_temperature(some), middle_s / DAY_S))
    return begins, periods


def _record(
    crossings: Sequence[Kept], begins: Sequence[float], settings: Settings, now_s: float
) -> WatchRecord:
    """What there is to judge."""
    until = begin_of(now_s, settings.unit)
    return WatchRecord(
        checked=now_s,
        period=settings.unit,
        until=until,
        crossings=sum(one.entry_s < until for one in crossings),
        newest=max((one.entry_s for one in crossings), default=None),
        periods=len(begins),
        judged=0,
        training=settings.learning,
        at_least=settings.at_least,
    )


def _judged(
    record: WatchRecord,
    periods: Sequence[Period],
    begins: Sequence[float],
    watched: Watched,
    settings: Settings,
) -> WatchRecord:
    """The same, with what was judged."""
    judged = [begin for begin, one in zip(begins, watched.judged, strict=True) if one]
    if judged:
        to = end_of(judged[-1], settings.unit)
        found = {"judged": len(judged), "judged_from": judged[0], "judged_to": to}
        return record.model_copy(update=found)
    known = sum(period.temperature_deg_c is not None for period in periods)
    if len(periods) < settings.learning or known == len(periods):
        return record
    return record.model_copy(update={"year_ends": begins[0] + SEASON_DAYS * DAY_S})


def _checked(folder: Path) -> dict[str, list[object]]:
    """What was looked at, as it was then; nothing where that is not known."""
    path = folder / ALARMS / _CHECKED
    try:
        found = json.loads(path.read_bytes())
    except FileNotFoundError:
        return {}
    except (OSError, ValueError):
        _log.warning("%s: cannot be read; all bridges are looked at", path)
        return {}
    return found if isinstance(found, dict) else {}
