"""Messages of trucks, decoded once and grouped by boot."""

from collections.abc import Iterable
from itertools import chain
from typing import NamedTuple

from schemas.signals import AccelBatch, GnssFix, decode_accel, decode_gnss
from schemas.topics import Message

_BootName = tuple[str, str, int]
"""Realm, vehicle and boot."""


class DriveMessages(NamedTuple):
    """Messages of one boot of one truck by their sequence; a duplicate counts once."""

    realm: str
    vehicle: str
    boot_id: int
    accelerations: dict[int, AccelBatch]
    fixes: dict[int, GnssFix]

    def batches(self) -> list[AccelBatch]:
        """Return the accelerations in their order."""
        return [self.accelerations[sequence] for sequence in sorted(self.accelerations)]

    def fixes_in_order(self) -> list[GnssFix]:
        """Return the fixes in their order."""
        return [self.fixes[sequence] for sequence in sorted(self.fixes)]


class Drives:
    """Collector of messages by truck and boot.

    Of each boot at most the first `most_batches` valid accelerations are decoded.
    """

    def __init__(self, most_batches: int | None = None) -> None:
        self._most_batches = most_batches
        self._accel: dict[_BootName, dict[int, AccelBatch]] = {}
        self._gnss: dict[_BootName, dict[int, GnssFix]] = {}
        self._others: dict[_BootName, None] = {}

    def add(self, message: Message) -> bool:
        """Add a message; return whether it was decoded.

        An undecodable message is skipped: the logger has counted it.
        """
        key = message.key
        if key.owner != "vehicle":
            return False
        name = key.realm, key.identifier, message.boot_id
        try:
            if key.stream == "gnss":
                fix = decode_gnss(message.payload)
                self._gnss.setdefault(name, {})[message.sequence] = fix
                return True
            if key.stream == "accel" and self._wants_batch(name):
                batch = decode_accel(message.payload)
                self._accel.setdefault(name, {})[message.sequence] = batch
                return True
        except ValueError:
            pass
        self._others[name] = None
        return False

    def _wants_batch(self, name: _BootName) -> bool:
        return self._most_batches is None or len(self._accel.get(name, ())) < self._most_batches

    def all(self) -> list[DriveMessages]:
        """Return all boots in order of their first accelerations; boots without any come last."""
        return [
            DriveMessages(*name, self._accel.get(name, {}), self._gnss.get(name, {}))
            for name in dict.fromkeys(chain(self._accel, self._gnss, self._others))
        ]


def drives_of(messages: Iterable[Message], most_batches: int | None = None) -> list[DriveMessages]:
    """Group messages by truck and boot; skip those of other topics."""
    drives = Drives(most_batches)
    for message in messages:
        drives.add(message)
    return drives.all()
