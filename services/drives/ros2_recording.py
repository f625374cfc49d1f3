"""Recordings of ROS 2, read by rosbags: MCAP files, SQLite files, and folders of rosbag2.

Their origin may be unknown: rosbags is trusted with valid files, and its output is checked before
use.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

from schemas.signals import (
    AccelBatch,
    GnssFix,
    VehicleInfo,
    encode_accel,
    encode_gnss,
    encode_info,
    encode_location,
)
from schemas.site import Site
from schemas.site_file import vehicle_toml
from schemas.topics import Key, Message
from services.common.errors import InputError
from services.common.files import check_ordinary, read_text
from services.drives.ros2_decompression import limit_decompression
from services.drives.ros2_messages import RosType, check_rosbags, unknown_hash
from services.drives.ros2_truck import Accel, Ros2Truck

if TYPE_CHECKING:
    from rosbags.interfaces import Connection
    from rosbags.rosbag2 import Reader

_MAX_DEFINITION_CHARACTERS: Final = 65_536
"""Maximum length of a definition, ten times the longest known one with all comments."""
_SPECIAL_CHARACTERS = "?#%"
"""Special characters in the name by which rosbags opens an SQLite file: it would open another."""


class RosMessage(NamedTuple):
    """One message as recorded."""

    topic: str
    type: RosType
    payload: bytes
    recorded_ns: int


def is_ros2(source: Path) -> bool:
    """Return whether that looks like a recording of ROS 2."""
    return source.suffix in (".mcap", ".db3") or (source / "metadata.yaml").is_file()


def messages_of_ros2(
    source: Path, site: Site, site_name: str, realm: str, vehicle: str
) -> tuple[Ros2Truck, Iterator[Message]]:
    """Return the messages that the truck would have sent, and the counter of invalid ones.

    The boot is numbered by the first time in ns. InputError may also be raised during iteration.
    """
    check_rosbags()
    truck = Ros2Truck(site, site_name, vehicle)
    return truck, _encoded(source, truck, realm, vehicle, vehicle_toml(site, vehicle))


def read_ros2(source: Path, truck: Ros2Truck) -> Iterator[RosMessage]:
    """Yield the messages of a truck's topics in the order of the recording.

    InputError: it cannot be read, lacks a topic, or has it with another type.
    """
    from rosbags.rosbag2 import Reader

    for path in (source, *(sorted(source.iterdir()) if source.is_dir() else ())):
        _check_file(path)
    if source.is_dir():
        _check_metadata(source / "metadata.yaml")
    limit_decompression()
    try:
        reader = Reader(source)
        reader.open()
    except Exception as error:  # rosbags raises any exception
        raise _unreadable(source, error) from None
    try:
        types = _connections(source, reader, truck)
        messages = reader.messages([one for one in reader.connections if one.id in types])
        while True:
            try:
                found = next(messages, None)
            except Exception as error:
                raise _unreadable(source, error) from None
            if found is None:
                return
            connection, recorded_ns, payload = found
            # SQLite accepts anything in any column.
            if not isinstance(payload, bytes) or not isinstance(recorded_ns, int):
                raise _unreadable(
                    source, TypeError(f"{connection.topic} has a row without a message")
                )
            yield RosMessage(connection.topic, types[connection.id], payload, recorded_ns)
    finally:
        reader.close()


def _check_file(path: Path) -> None:
    """Raise InputError if opening a file would block, open another one, or miss its content."""
    check_ordinary(path)
    if path.suffix != ".db3":
        return
    if any(character in str(path) for character in _SPECIAL_CHARACTERS):
        raise InputError(
            f"{path}: cannot be opened, as its path contains ?, # or %; move it to another path"
        )
    log = path.with_name(f"{path.name}-wal")
    if log.is_file() and log.stat().st_size:
        raise InputError(
            f"{path}: its last messages are in {log.name} next to it, as its writer did not end "
            f"normally; sqlite3 {path.name} 'PRAGMA wal_checkpoint(TRUNCATE)' merges them"
        )


def _check_metadata(path: Path) -> None:
    """Raise InputError for aliases: a few nested ones expand to billions of words."""
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError
    from ruamel.yaml.events import AliasEvent

    text = read_text(path)
    if "*" not in text:
        return
    try:
        found = any(isinstance(e, AliasEvent) for e in YAML(typ="safe", pure=True).parse(text))
    except YAMLError:
        return  # reading it reports the error
    if found:
        raise InputError(f"{path}: has aliases (*NAME), which rosbag2 does not write")


def _unreadable(source: Path, error: Exception) -> InputError:
    words = " ".join(str(error).split())[:200] or type(error).__name__
    return InputError(f"{source}: cannot be read as a recording of ROS 2: {words}")


def _connections(source: Path, reader: "Reader", truck: Ros2Truck) -> dict[int, RosType]:
    """Return the types of a recording's connections for a truck's topics, by their ids."""
    found: dict[int, RosType] = {}
    for one in reader.connections:
        if not all(isinstance(names, str) for names in (one.topic, one.msgtype)):
            raise _unreadable(source, TypeError("a topic has no name or no type"))
    for topic in truck.table.topics():
        # The message counts of the topics are ignored: a recording need not state them correctly.
        named = [one for one in reader.connections if one.topic == topic]
        if not named:
            there = sorted({one.topic for one in reader.connections})[:10]
            raise InputError(
                f"{source}: has no topic {topic}; "
                f"it has {', '.join(name[:80] for name in there) or 'none'}"
            )
        found |= {one.id: _type_of(source, one, truck.types(topic)) for one in named}
    return found


def _type_of(source: Path, connection: "Connection", types: tuple[RosType, ...]) -> RosType:
    """Return the type of a topic, which its hash and its definition must match, if present."""
    for of in types:
        if connection.msgtype == of.name:
            break
    else:
        wanted = " or ".join(of.name for of in types)
        raise InputError(
            f"{source}: {connection.topic} is of {connection.msgtype[:80]}, {wanted} is expected"
        )
    for digest in (connection.digest, _hash_of_definition(connection)):
        problem = unknown_hash(of, str(digest)) if digest else None
        if problem:
            raise InputError(f"{source}: {connection.topic}: {problem}")
    return of


def _hash_of_definition(connection: "Connection") -> str:
    """Return the hash of the definition that the recording carries; empty without one."""
    from rosbags.interfaces import MessageDefinitionFormat
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    definition = connection.msgdef
    if definition.format != MessageDefinitionFormat.MSG or not definition.data:
        return ""
    if len(definition.data) > _MAX_DEFINITION_CHARACTERS:
        return "unreadable"
    try:
        types = get_typestore(Stores.EMPTY)
        # `register` would generate a program from the definition and run it, which a hash does not
        # need.
        types.fielddefs.update(get_types_from_msg(definition.data, connection.msgtype))
        return types.hash_rihs01(connection.msgtype)
    except Exception:  # an unreadable definition is not a known one
        return "unreadable"


def _encoded(
    source: Path, truck: Ros2Truck, realm: str, vehicle: str, toml: str
) -> Iterator[Message]:
    numbers = {"accel": 0, "gnss": 0}
    boot_id = 0
    for found in _measured(source, truck):
        if not boot_id:
            boot_id = found.wall_time_ns
            info = VehicleInfo(boot_id, 0, found.device_time_ns, boot_id, vehicle, toml)
            key = Key(realm, "vehicle", vehicle, "info")
            yield Message(key, encode_info(info), boot_id, 0, boot_id, boot_id)
        stream = "gnss" if isinstance(found, GnssFix) else "accel"
        sequence, time_ns = numbers[stream], found.wall_time_ns
        numbers[stream] += 1
        payloads: dict[str, bytes]
        if isinstance(found, GnssFix):
            fix = found._replace(boot_id=boot_id, sequence=sequence)
            payloads = {"gnss": encode_gnss(fix), "location": encode_location(fix)}
        else:
            payloads = {"accel": encode_accel(AccelBatch(boot_id, sequence, *found))}
        for name, payload in payloads.items():
            key = Key(realm, "vehicle", vehicle, name)
            yield Message(key, payload, boot_id, sequence, time_ns, time_ns)
    for stream, what in (("accel", "accelerations"), ("gnss", "positions")):
        if not numbers[stream]:
            why = "; ".join(truck.anomalies.news()[:3]) or "it has no message of these topics"
            raise InputError(f"{source}: gives no {what}: {why}")


def _measured(source: Path, truck: Ros2Truck) -> Iterator[Accel | GnssFix]:
    for message in read_ros2(source, truck):
        try:
            yield from truck.convert(*message)
        except InputError as error:
            raise InputError(f"{source}: {error}") from None
    yield from truck.finish()
