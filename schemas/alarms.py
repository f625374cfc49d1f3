"""Alarms of bridges, in the files of a history and on the wire."""

from datetime import UTC, datetime
from typing import Annotated, Final, Literal

from pydantic import AfterValidator, Field

from schemas.proto import driveby_pb2 as pb
from schemas.strict_model import Finite, StrictModel
from schemas.topics import IDENTIFIER, check_realm

SCHEMA_VERSION: Final = 1
_MAX_TEXT_CHARACTERS = 1000


class Acknowledgement(StrictModel):
    """An operator's acknowledgement of an alarm; the state at this time is the new baseline."""

    edition: Literal[1] = 1
    """Format version."""
    by: Annotated[str, Field(min_length=1, max_length=200)]
    time: Finite
    """Seconds since 1970 UTC."""
    note: Annotated[str, Field(max_length=_MAX_TEXT_CHARACTERS)] = ""


class Alarm(StrictModel):
    """A detected change of a bridge. Times are seconds since 1970 UTC."""

    edition: Literal[1] = 1
    """Format version."""
    alarm_id: Annotated[str, Field(pattern=rf"^{IDENTIFIER}$")]
    realm: Annotated[str, AfterValidator(check_realm)]
    bridge: Annotated[str, Field(pattern=rf"^{IDENTIFIER}$")]
    element: Annotated[int, Field(ge=1, le=99)]
    direction: Literal["weaker", "stiffer"]
    since: Finite
    """Beginning of the period in which the change most likely began."""
    raised: Finite
    """End of the period that raised the alarm."""
    sum: Finite
    """Chart statistic that raised the alarm, in standard deviations: √(2 ln R); a CUSUM in earlier
    versions. Comparable with the threshold of the same alarm only."""
    threshold: Finite
    ratio: Finite
    """Ratio of the element's EI after the change to EI before; the next two bound its 95 %
    interval."""
    ratio_q025: Finite
    ratio_q975: Finite
    acknowledged: Acknowledgement | None = None

    def sentence(self) -> str:
        """Return the alarm in words."""
        change = 100.0 * abs(1.0 - self.ratio)
        how = "less stiff" if self.direction == "weaker" else "stiffer"
        ends = sorted(100.0 * abs(1.0 - end) for end in (self.ratio_q025, self.ratio_q975))
        return (
            f"element {self.element} is {change:.0f} % {how} than before "
            f"{datetime.fromtimestamp(self.since, UTC):%Y-%m-%d} "
            f"(95 % interval {ends[0]:.0f} to {ends[1]:.0f} %)"
        )


def encode_alarm(alarm: Alarm, time_ns: int) -> bytes:
    """Return the Alarm message."""
    note = alarm.acknowledged
    return pb.Alarm(
        schema_version=SCHEMA_VERSION,
        time_ns=time_ns,
        bridge=alarm.bridge,
        alarm_id=alarm.alarm_id,
        element=alarm.element,
        is_stiffer=alarm.direction == "stiffer",
        since_ns=round(alarm.since * 1e9),
        raised_ns=round(alarm.raised * 1e9),
        sum=alarm.sum,
        threshold=alarm.threshold,
        ratio=alarm.ratio,
        ratio_q025=alarm.ratio_q025,
        ratio_q975=alarm.ratio_q975,
        text=alarm.sentence(),
        is_acknowledged=note is not None,
        acknowledged_by="" if note is None else note.by,
        acknowledged_ns=0 if note is None else round(note.time * 1e9),
        note="" if note is None else note.note,
    ).SerializeToString(deterministic=True)


def alarm_of(message: pb.Alarm, realm: str) -> Alarm:
    """Return the alarm of a message; raise ValueError if its version or a value is invalid."""
    if message.schema_version != SCHEMA_VERSION:
        raise ValueError(f"Alarm has schema version {message.schema_version}, not 1")
    note = None
    if message.is_acknowledged:
        note = Acknowledgement(
            by=message.acknowledged_by, time=message.acknowledged_ns / 1e9, note=message.note
        )
    return Alarm(
        alarm_id=message.alarm_id,
        realm=realm,
        bridge=message.bridge,
        element=message.element,
        direction="stiffer" if message.is_stiffer else "weaker",
        since=message.since_ns / 1e9,
        raised=message.raised_ns / 1e9,
        sum=message.sum,
        threshold=message.threshold,
        ratio=message.ratio,
        ratio_q025=message.ratio_q025,
        ratio_q975=message.ratio_q975,
        acknowledged=note,
    )
