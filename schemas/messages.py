"""Access from a topic's message name to its protobuf class, descriptors and checked message.

`foxglove.LocationFix` comes from the package foxglove-schemas-protobuf and is imported only when it
is needed.
"""

from collections.abc import Callable, Iterator
from functools import cache
from typing import Any

from google.protobuf import descriptor_pb2
from google.protobuf.descriptor import FileDescriptor
from google.protobuf.message import DecodeError, Message

from schemas import events, signals
from schemas.accel_check import check_accel
from schemas.proto import driveby_pb2
from schemas.signals import Stamp
from schemas.topics import TOPICS, Topic

LOCATION = "foxglove.LocationFix"
MESSAGES = tuple(sorted({row.message for row in TOPICS if row.message}))


@cache
def message_class(name: str) -> type[Message]:
    """Return the class of a full protobuf name; raise ValueError if no topic has it."""
    if name not in MESSAGES:
        raise ValueError(f"no message {name[:80]!r}; there are {', '.join(MESSAGES)}")
    if name == LOCATION:
        return signals.location_class()
    found: type[Message] = getattr(driveby_pb2, name.removeprefix("driveby.v1."))
    return found


@cache
def descriptors(name: str) -> bytes:
    """Return a serialised FileDescriptorSet: the message's file after everything that it imports.

    This is the schema data of an MCAP channel; readers such as Rerun decode with it alone.
    """
    files = descriptor_pb2.FileDescriptorSet()
    own: Any = message_class(name).DESCRIPTOR.file  # upb's class, which the stubs do not know
    for file in _with_imports(own, set()):
        file.CopyToProto(files.file.add())
    return files.SerializeToString(deterministic=True)


def _with_imports(file: FileDescriptor, done: set[str]) -> Iterator[FileDescriptor]:
    if file.name in done:
        return
    done.add(file.name)
    for imported in file.dependencies:
        yield from _with_imports(imported, done)
    yield file


def decode(name: str, payload: bytes) -> Message:
    """Return the message of a payload; raise ValueError in one line if it is malformed."""
    try:
        return message_class(name).FromString(payload)
    except DecodeError as error:
        raise ValueError(f"not a {name}: {error}") from None


def check_stamp(row: Topic, payload: bytes) -> Stamp:
    """Check a payload as far as its topic allows and return its times and identity.

    The time is the `log_time` of a recording: the wall time of the first sample of `accel`, of the
    fix of `gnss` and `location`, and of the creation of any other message. Raise a ValueError that
    names the topic and the fault: too large, another message, another version, impossible values.
    """
    try:
        if len(payload) > row.max_bytes:
            raise ValueError(f"{len(payload)} bytes; at most {row.max_bytes}")
        return _stamp(row.message, payload)
    except ValueError as error:
        raise ValueError(f"{row.owner}/{row.stream}: {error}") from None


def _stamp(name: str, payload: bytes) -> Stamp:
    check = _CHECKS.get(name)
    if check is not None:
        return check(payload)
    message = decode(name, payload)
    signals.check_version(getattr(message, "schema_version", 0))
    time_field = "created_ns" if name == "driveby.v1.Estimate" else "time_ns"
    return Stamp(signals.check_wall_time(getattr(message, time_field, 0)))


_CHECKS: dict[str, Callable[[bytes], Stamp]] = {
    "driveby.v1.AccelBatch": check_accel,
    "driveby.v1.GnssFix": lambda payload: signals.stamp(signals.decode_gnss(payload)),
    "driveby.v1.VehicleInfo": lambda payload: signals.stamp(signals.decode_info(payload)),
    "driveby.v1.Event": lambda payload: Stamp(
        signals.check_wall_time(events.decode_event(payload).time_ns)
    ),
    LOCATION: lambda payload: Stamp(signals.check_location(payload)),
}
