"""Records of `alarm check`, one file per bridge: they give the absence of an alarm a meaning.

`alarms/checks/realm=R/bridge=B.json` is replaced at every check of the bridge. It may be deleted:
the bridge then counts as unmonitored, and the next check covers it again.
"""

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Final, Literal, NamedTuple

from pydantic import BaseModel, ConfigDict, Field

from schemas.alarms import Alarm
from schemas.json_file import load_json
from services.common.errors import InputError
from services.common.files import make_folder, write_atomically
from services.common.language import ENGLISH, Language, utc_day
from services.history.alarm_files import ALARMS
from services.history.history_store import HistoryRow
from services.history.periods import Unit, begin_of

_CHECKS: Final = "checks"
_CLOCK_S: Final = 60.0
"""Largest difference in s of two clocks that agree."""
Finite = Annotated[float, Field(allow_inf_nan=False)]
Count = Annotated[int, Field(ge=0)]


class WatchRecord(BaseModel):
    """Record of a bridge's last check; times in s since 1970 UTC."""

    model_config = ConfigDict(extra="ignore", frozen=True, allow_inf_nan=False)

    edition: Literal[1] = 1
    checked: Finite
    period: Unit
    until: Finite
    """End of the checked time: beginning of the period that was not complete."""
    crossings: Count
    """Number of crossings before `until`, whatever their verdicts."""
    newest: Finite | None = None
    """Entry of the newest crossing, before `until` or after it."""
    periods: Count
    """Number of periods with good crossings that can be compared."""
    judged: Count
    """Number of periods that were compared with the baseline."""
    training: Count
    """Number of training periods before any is judged."""
    at_least: Finite
    """Smallest change of interest."""
    judged_from: Finite | None = None
    """Beginning of the first judged period."""
    judged_to: Finite | None = None
    """End of the last judged period."""
    year_ends: Finite | None = None
    """End of the first year, which trains the season where a temperature is missing before it."""
    problem: str = ""
    """Reason why the bridge could not be monitored."""


State = Literal[
    "never_checked", "out_of_date", "failed", "no_crossings", "training", "season", "acknowledged",
    "alarm", "watched",
]  # fmt: skip


class MonitoringState(NamedTuple):
    """State of a bridge's monitoring."""

    state: State
    record: WatchRecord | None
    is_damaged: bool = False
    """Whether the record exists but is unreadable."""

    @property
    def sentence(self) -> str:
        """The state in words, in English."""
        return self.words(ENGLISH)

    def words(self, language: Language) -> str:
        """Return the state in words; the problem of a failed check stays in English."""
        record = self.record
        if record is None:
            return language.text(f"watch.{'damaged' if self.is_damaged else 'never_checked'}")
        judged = "many" if record.judged != 1 else "one"
        stated = language.text(
            f"watch.{self.state}" + (f".{judged}" if self.state == "watched" else ""),
            unit=language.text(record.period),
            units=language.text(f"{record.period}s"),
            checked=day_of(record.checked),
            problem=record.problem,
            periods=record.periods,
            training=record.training,
            until=day_of(record.until),
            year_ends=day_of(record.year_ends),
            judged=record.judged,
            first=day_of(record.judged_from),
            last=day_of(record.judged_to),
            change=language.number(100.0 * record.at_least, "g"),
        )
        if record.newest is None or record.newest <= record.checked + _CLOCK_S:
            return stated
        return f"{stated} {language.text('watch.future', newest=day_of(record.newest))}"

    @property
    def found_nothing(self) -> bool:
        """Whether periods were judged, up to now, and none raised an alarm."""
        return self.state == "watched"


def write_record(folder: Path, realm: str, bridge: str, record: WatchRecord) -> None:
    """Write the record of a bridge."""
    path = record_path(folder, realm, bridge)
    make_folder(path.parent)
    write_atomically(path, record.model_dump_json(indent=1) + "\n")


def record_path(folder: Path, realm: str, bridge: str) -> Path:
    """Return the path of a bridge's record."""
    return folder / ALARMS / _CHECKS / f"realm={realm}" / f"bridge={bridge}.json"


def record_of(folder: Path, realm: str, bridge: str) -> WatchRecord | None:
    """Return the record of a bridge; None where there is none.

    Raise InputError if the file is damaged.
    """
    path = record_path(folder, realm, bridge)
    return load_json(WatchRecord, path, "a record of a check") if path.exists() else None


def monitoring_state(
    folder: Path,
    realm: str,
    bridge: str,
    crossings: Iterable[HistoryRow] | None,
    alarms: Iterable[Alarm],
    now_s: float,
) -> tuple[MonitoringState, list[str]]:
    """Return the state of a bridge's monitoring, and a line if its record is unreadable.

    Without its crossings (None) none counts as added since the check.
    """
    try:
        record = record_of(folder, realm, bridge)
    except InputError as error:
        return MonitoringState("never_checked", None, is_damaged=True), [str(error)]
    if record is None:
        return MonitoringState("never_checked", None), []
    entries_s = None if crossings is None else [one.entry_s for one in crossings]
    return MonitoringState(_state(record, entries_s, tuple(alarms), now_s), record), []


def _state(
    record: WatchRecord, entries_s: list[float] | None, alarms: tuple[Alarm, ...], now_s: float
) -> State:
    if any(alarm.acknowledged is None for alarm in alarms):
        return "alarm"
    over_s = begin_of(now_s, record.period)
    checked, newest_s = record.crossings, record.newest
    if entries_s is not None:
        checked = sum(entry_s < record.until for entry_s in entries_s)
        newest_s = max((entry_s for entry_s in entries_s if entry_s < over_s), default=None)
    is_newer = newest_s is not None and record.until <= newest_s < over_s
    if checked != record.crossings or is_newer:
        return "out_of_date"
    if record.problem:
        return "failed"
    if not record.periods:
        return "no_crossings"
    if record.judged_to is None:
        return "season" if record.year_ends is not None else "training"
    noted_s = max((a.acknowledged.time for a in alarms if a.acknowledged is not None), default=0.0)
    return "acknowledged" if record.judged_to <= noted_s else "watched"


def day_of(time_s: float | None) -> str:
    """Return the day (UTC) of a time; an empty text for None."""
    return "" if time_s is None else utc_day(time_s)
