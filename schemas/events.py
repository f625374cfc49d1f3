"""Events in a recording that its readers must know."""

from enum import StrEnum
from typing import NamedTuple

from google.protobuf.message import DecodeError

from schemas.proto import driveby_pb2 as pb

SCHEMA_VERSION = 1
_MAX_TEXT_CHARACTERS = 1000


class EventKind(StrEnum):
    """Kind of an event. The codes are part of the recording format."""

    GAP = "gap"
    LOST = "lost"
    RECOVERED = "recovered"
    DROPPED = "dropped"
    REFUSED = "refused"
    DUPLICATES = "duplicates"
    CLOCK_STEP = "clock_step"
    CLOCK_DRIFT = "clock_drift"
    RECONNECTED = "reconnected"
    RESTARTED = "restarted"
    QUEUE_FULL = "queue_full"
    WRITE_ERROR = "write_error"
    DISK_LOW = "disk_low"
    RECORDING_RECOVERED = "recording_recovered"
    RECORDING_DELETED = "recording_deleted"
    RECORDING_GONE = "recording_gone"


class Event(NamedTuple):
    """One event. Fields that do not apply are empty or 0."""

    kind: EventKind
    time_ns: int
    """Wall time, ns since 1970 UTC."""
    text: str = ""
    vehicle: str = ""
    stream: str = ""
    boot_id: int = 0
    first_sequence: int = 0
    last_sequence: int = 0
    messages: int = 0
    """Number of messages concerned."""


def encode_event(event: Event) -> bytes:
    """Return the Event message; cut its text to 1000 characters."""
    return pb.Event(
        schema_version=SCHEMA_VERSION,
        time_ns=event.time_ns,
        kind=str(event.kind),
        vehicle=event.vehicle,
        stream=event.stream,
        boot_id=event.boot_id,
        first_sequence=event.first_sequence,
        last_sequence=event.last_sequence,
        count=event.messages,
        text=event.text[:_MAX_TEXT_CHARACTERS],
    ).SerializeToString(deterministic=True)


def decode_event(payload: bytes) -> Event:
    """Return the event; raise ValueError in one line if it is malformed or of an unknown kind."""
    try:
        message = pb.Event.FromString(payload)
    except DecodeError as error:
        raise ValueError(f"not a driveby.v1.Event: {error}") from None
    if message.schema_version != SCHEMA_VERSION:
        version = message.schema_version
        raise ValueError(f"schema version {version}; this program reads {SCHEMA_VERSION}")
    return Event(
        EventKind(message.kind),
        message.time_ns,
        message.text,
        message.vehicle,
        message.stream,
        message.boot_id,
        message.first_sequence,
        message.last_sequence,
        message.count,
    )
