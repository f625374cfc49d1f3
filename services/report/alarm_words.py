"""An alarm in the words of a report."""

from schemas.alarms import Alarm
from services.common.language import Language, utc_day


def alarm_sentence(alarm: Alarm, language: Language) -> str:
    """Return an alarm in words; in English those of the alarm itself."""
    ends = sorted(100.0 * abs(1.0 - end) for end in (alarm.ratio_q025, alarm.ratio_q975))
    return language.text(
        f"history.{alarm.direction}",
        element=alarm.element,
        change=100.0 * abs(1.0 - alarm.ratio),
        since=utc_day(alarm.since),
        low=ends[0],
        high=ends[1],
    )
