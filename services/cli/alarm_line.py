"""The printed line of an alarm."""

from datetime import UTC, datetime
from typing import TYPE_CHECKING

from services.common.errors import one_line

if TYPE_CHECKING:
    from schemas.alarms import Alarm


def alarm_line(alarm: "Alarm") -> str:
    """Return the printed line of an alarm."""
    note = alarm.acknowledged
    state = "active" if note is None else f"acknowledged by {note.by} on {day(note.time)}"
    said = f": {note.note}" if note is not None and note.note else ""
    return one_line(
        f"alarm {alarm.alarm_id} of {alarm.bridge}, raised {day(alarm.raised)}, {state}{said}; "
        f"{alarm.sentence()}"
    )


def day(time_s: float) -> str:
    """Return the day of a time in s since 1970, in UTC."""
    return f"{datetime.fromtimestamp(time_s, UTC):%Y-%m-%d}"
