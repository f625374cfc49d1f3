"""Recordings of ROS 2, read by rosbags: MCAP files, SQLite files, and folders of rosbag2.

They may be anybody's: rosbags is believed to be right about files that are, and what it hands over
is looked at before it is used.
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
from schemas.topics import Key
from services.common.errors import InputError
from services.common.files import check_ordinary, read_text
from services.drives.ros2_messages import RosType, check_rosbags, unknown_hash
from services.drives.ros2_truck import Accel, Ros2Truck
from services.drives.ros2_unpacking import bound_unpacking
from services.recordings.recording import Message

if TYPE_CHECKING:
    from rosbags.interfaces import Connection
    from rosbags.rosbag2 import Reader

_MOST_DEFINITION_CHARACTERS: Final = 65_536
"""Ten times as long as that of any message that is known here, with all its comments."""
_MEANS_SOMETHING = "?#%"
"""In the name under which rosbags opens an SQLite file: it would open another one."""


class RosMessage(NamedTuple):
    """One message as it was recorded."""

    topic: str
    type: RosType
    payload: bytes
    recorded_ns: int


def is_ros2(source: Path) -> bool:
    """Whether that looks like a recording of ROS 2."""
    return source.suffix in (".mcap", ".db3") or (source / "metadata.yaml").is_file()


def messages_of_ros2(
    source: Path, site: Site, site_name: str, realm: str, vehicle: str
) -> tuple[Ros2Truck, Iterator[Message]]:
    """The messages that the truck would have sent, and who counts what was wrong with its own.

    The boot is numbered by the first time in ns. InputError, also while they are iterated over.
    """
    check_rosbags()
    truck = Ros2Truck(site, site_name, vehicle)
    return truck, _encoded(source, truck, realm, vehicle, vehicle_toml(site, vehicle))


def read_ros2(source: Path, truck: Ros2Truck) -> Iterator[RosMessage]:
    """The messages of a truck's topics in the order of the recording.

    InputError: it cannot be read, lacks a topic, or has it with another type.
    """
    from rosbags.rosbag2 import Reader

    for path in _files_of(source):
        _check_file(path)
    if source.is_dir():
        _check_metadata(source / "metadata.yaml")
    bound_unpacking()
    try:
        reader = Reader(source)
        reader.open()
    except Exception as error:  # rosbags raises what it stumbles over
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
            # SQLite keeps anything in any column.
            if not isinstance(payload, bytes) or not isinstance(recorded_ns, int):
                raise _unreadable(source, TypeError(f"{connection.topic} has no message in a row"))
            yield RosMessage(connection.topic, types[connection.id], payload, recorded_ns)
    finally:
        reader.close()


def _files_of(source: Path) -> list[Path]:
    return [source, *sorted(source.iterdir())] if source.is_dir() else [source]


def _check_file(path: Path) -> None:
    """InputError if opening a file would wait for ever, open another one, or miss what is in it."""
    check_ordinary(path)
    if path.suffix != ".db3":
        return
    if any(character in str(path) for character in _MEANS_SOMETHING):
        raise InputError(
            f"{path}: cannot be opened, as there is a ?, # or % in its path; give it another one"
        )
    log = path.with_name(f"{path.name}-wal")
    if log.is_file() and log.stat().st_size:
        raise InputError(
            f"{path}: its last messages are in {log.name} beside it, as its writer did not end "
            f"well; sqlite3 {path.name} 'PRAGMA wal_checkpoint(TRUNCATE)' puts them into it"
        )


def _check_metadata(path: Path) -> None:
    """InputError if it has aliases: a few of them of each other are billions of words when told."""
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError
    from ruamel.yaml.events import AliasEvent

    text = read_text(path)
    if "*" not in text:
        return
    try:
        found = any(isinstance(e, AliasEvent) for e in YAML(typ="safe", pure=True).parse(text))
    except YAMLError:
        return  # said where it is read
    if found:
        raise InputError(f"{path}: has aliases (*NAME), which rosbag2 does not write")


def _unreadable(source: Path, error: Exception) -> InputError:
    words = " ".join(str(error).split())[:200] or type(error).__name__
    return InputError(f"{source}: cannot be read as a recording of ROS 2: {words}")


def _connections(source: Path, reader: "Reader", truck: Ros2Truck) -> dict[int, RosType]:
    """The types of those of a recording's connections that are a truck's topics, by their ids."""
    found: dict[int, RosType] = {}
    for one in reader.connections:
        if not all(isinstance(said, str) for said in (one.topic, one.msgtype)):
            raise _unreadable(source, TypeError("a topic has no name or no type"))
    for topic in truck.table.topics():
        # How many messages there are of each is not looked at: a recording need not say so truly.
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
    """The type of a topic, which both its hash and its definition must be of, where it has them."""
    for of in types:
        if connection.msgtype == of.name:
            break
    else:
        wanted = " or ".join(of.name for of in types)
        raise InputError(
            f"{source}: {connection.topic} is of {connection.msgtype[:80]}, {wanted} is expected"
        )
    for told in (connection.digest, _hash_of_definition(connection)):
        problem = unknown_hash(of, str(told)) if told else None
        if problem:
            raise InputError(f"{source}: {connection.topic}: {problem}")
    return of


def _hash_of_definition(connection: "Connection") -> str:
    """The hash of the definition that the recording carries; empty if it carries none."""
    from rosbags.interfaces import MessageDefinitionFormat
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    definition = connection.msgdef
    if definition.format != MessageDefinitionFormat.MSG or not definition.data:
        return ""
    if len(definition.data) > _MOST_DEFINITION_CHARACTERS:
        return "unreadable"
    try:
        types = get_typestore(Stores.EMPTY)
        # `register` would make a program of the definition and run it, which a hash does not need.
        types.fielddefs.update(get_types_from_msg(definition.data, connection.msgtype))
        return types.hash_rihs01(connection.msgtype)
    except Exception:  # a definition that cannot be read is none that is known
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
            why = "; ".join(truck.complaints.news()[:3]) or "no message of theirs is in it"
            raise InputError(f"{source}: gives no {what}: {why}")


def _measured(source: Path, truck: Ros2Truck) -> Iterator[Accel | GnssFix]:
    for message in read_ros2(source, truck):
        try:
            yield from truck.take(*message)
        except InputError as error:
            raise InputError(f"{source}: {error}") from None
    yield from truck.finish()
