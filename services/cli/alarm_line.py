"""The printed line of an alarm."""

from typing import TYPE_CHECKING

from services.common.errors import one_line

if TYPE_CHECKING:
    from schemas.alarms import Alarm


def alarm_line(alarm: "Alarm") -> str:
    """Return the printed line of an alarm."""
    from services.common.language import utc_day

    note = alarm.acknowledged
    state = "active" if note is None else f"acknowledged by {note.by} on {utc_day(note.time)}"
    text = f" ({note.note})" if note is not None and note.note else ""
    return one_line(
        f"alarm {alarm.alarm_id} of {alarm.bridge}, raised {utc_day(alarm.raised)}, {state}: "
        f"{alarm.sentence()}{text}"
    )
