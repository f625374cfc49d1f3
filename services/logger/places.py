"""Which file a message goes to, how files are called, and how many may be open."""

from collections.abc import Container, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

from schemas.messages import decode
from schemas.topics import Key, topic
from services.recordings.recording import Message
from services.recordings.recovery import is_name_taken

MAX_OPEN_FILES = 256
"""Recordings open at a time, of all vehicles: each costs a descriptor, buffers and a sync."""
MAX_FILES_OF_ONE = 4
"""A vehicle drives in one realm as a rule, and can show itself in any number."""
MAX_SERVICE_FILES = 32
"""Each realm has one for what concerns no vehicle."""
_SHORTEST_QUIET_S = 10.0
"""Where too many files are open, the quietest is closed sooner, but no sooner than this."""
SERVICE_FILE = "_service"  # no vehicle can be called that
FileName = tuple[str, str]
"""Realm and vehicle, or `SERVICE_FILE`; both empty for the one file that was asked for."""


class Place(NamedTuple):
    """Where recordings go: one file, or below a folder one file per realm and vehicle."""

    folder: Path
    file: Path | None
    realm: str | None
    site_toml: str | None


def file_of(place: Place, message: Message, open_: Container[FileName]) -> FileName:
    """Return the file that a message goes to; what services say of a vehicle to its open one."""
    if place.file is not None:
        return ("", "")
    realm, vehicle = message.key.realm, vehicle_of(message)
    if message.key.owner != "vehicle" and (realm, vehicle) not in open_:
        return (realm, SERVICE_FILE)
    return (realm, vehicle)


class Room(NamedTuple):
    """Whether one more file can be open."""

    close: FileName | None = None
    """This one first."""
    why_not: str = ""
    """What there is too much of; empty: it can."""


def room_for(name: FileName, open_: Mapping[FileName, float], now_s: float) -> Room:
    """Say whether there is room for a file; `open_` says when what is open was last written to."""
    is_service = name[1] == SERVICE_FILE
    limit = MAX_SERVICE_FILES if is_service else MAX_FILES_OF_ONE
    closable = [one for one in open_ if one[1] == name[1]]
    owner = "of services" if is_service else "of this vehicle"
    why = f"had no file: {limit} {owner} are open, in as many realms"
    if len(closable) < limit:
        if len(open_) < MAX_OPEN_FILES:
            return Room()
        closable = list(open_)
        why = f"had no file: {MAX_OPEN_FILES} of all vehicles are open"
    quietest = min(closable, key=lambda one: open_[one])
    if now_s - open_[quietest] < _SHORTEST_QUIET_S:
        return Room(why_not=why)
    return Room(close=quietest)


def belongs_to(latched: Key, name: FileName) -> bool:
    """Whether a file begins with what is latched of a key."""
    is_vehicle = latched.owner == "vehicle"
    return latched.realm == name[0] and (
        latched.identifier == name[1] if is_vehicle else name[1] == SERVICE_FILE
    )


def vehicle_of(message: Message) -> str:
    """Return the vehicle that a message concerns; empty if none."""
    if message.key.owner == "vehicle":
        return message.key.identifier
    name = topic(message.key.owner, message.key.stream).message
    vehicle: str = getattr(decode(name, message.payload), "vehicle", "")
    return vehicle


def free_path(place: Place, realm: str, name: str) -> Path:
    """Return the name of a new file, which nothing has or had."""
    now = datetime.now(UTC)
    if place.file is not None:
        folder, stem = place.file.parent, place.file.stem
    else:
        folder = place.folder / realm / f"{now:%Y-%m-%d}"
        stem = f"{name}-{now:%Y%m%dT%H%M%SZ}"
    path = folder / f"{stem}.mcap"
    number = 2
    while is_name_taken(path):
        path = folder / f"{stem}-{number}.mcap"
        number += 1
    return path
