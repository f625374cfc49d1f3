"""The file of each message, names of files, and the limit of open ones."""

from collections.abc import Callable, Container, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

from schemas.messages import decode
from schemas.topics import Key, Message, topic
from services.recordings.recovery import is_name_taken

MAX_OPEN_FILES = 256
"""Largest number of open recordings: each costs a descriptor, buffers and a sync."""
MAX_FILES_OF_ONE = 4
"""Largest number for one vehicle, which usually drives in one realm but may appear in any number.
"""
MAX_SERVICE_FILES = 32
"""Largest number of files for messages without a vehicle, one per realm."""
_SHORTEST_QUIET_S = 10.0
"""Shortest silence after which a file is closed if too many are open."""
SERVICE_FILE = "_service"  # no vehicle can be called that
FileName = tuple[str, str]
"""Realm and vehicle, or `SERVICE_FILE`; both empty for a single requested file."""


class RecordingTarget(NamedTuple):
    """Target of recordings: one file, or one per realm and vehicle below a folder."""

    folder: Path
    file: Path | None
    realm: str | None
    site_text: Callable[[], str] | None
    """Reader of the site file, called for each new recording; None without one."""

    @property
    def top(self) -> Path:
        """Folder that holds all recordings, at any depth."""
        return self.folder if self.file is None else self.file.parent


def file_of(place: RecordingTarget, message: Message, open_: Container[FileName]) -> FileName:
    """Return the file of a message; messages of services about a vehicle go to its open one."""
    if place.file is not None:
        return ("", "")
    realm, vehicle = message.key.realm, vehicle_of(message)
    if message.key.owner != "vehicle" and (realm, vehicle) not in open_:
        return (realm, SERVICE_FILE)
    return (realm, vehicle)


class FileSlot(NamedTuple):
    """Permission to open one more file."""

    close: FileName | None = None
    """File to close first."""
    why_not: str = ""
    """Reason for a refusal; empty if there is none."""


def file_slot(name: FileName, open_: Mapping[FileName, float], now_s: float) -> FileSlot:
    """Return whether a file may be opened; `open_` holds the last write of the open ones."""
    is_service = name[1] == SERVICE_FILE
    limit = MAX_SERVICE_FILES if is_service else MAX_FILES_OF_ONE
    closable = [one for one in open_ if one[1] == name[1]]
    owner = "of services" if is_service else "of this vehicle"
    why = f"had no file: {limit} files {owner} are open, one for each realm"
    if len(closable) < limit:
        if len(open_) < MAX_OPEN_FILES:
            return FileSlot()
        closable = list(open_)
        why = f"had no file: {MAX_OPEN_FILES} files of all vehicles are open"
    quietest = min(closable, key=lambda one: open_[one])
    if now_s - open_[quietest] < _SHORTEST_QUIET_S:
        return FileSlot(why_not=why)
    return FileSlot(close=quietest)


def belongs_to(latched: Key, name: FileName) -> bool:
    """Return whether a file begins with the latched messages of a key."""
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


def free_path(place: RecordingTarget, realm: str, name: str) -> Path:
    """Return the name of a new file that never existed before."""
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
