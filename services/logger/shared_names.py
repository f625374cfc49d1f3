"""Detection of several trucks of one name, and of several workers, by boots. No I/O and no clock.

A boot ends when the next one of its truck or worker begins. One that still sends long after that
belongs to another process.
"""

from dataclasses import dataclass, field
from typing import Final, NamedTuple

from schemas.signals import NS_PER_S
from schemas.topics import Key

_OVERLAP_S: Final = 10.0
"""Shortest time for which two boots send at once: longer than a connection keeps messages back."""
_REMEMBERED_S: Final = 180.0
"""Time since the last message of the older boot after which a name counts as repaired."""
_MAX_NAMED: Final = 3
_STREAMS: Final = {"vehicle": ("accel", "gnss"), "bridge": ("estimate",)}
"""Streams of one sender. A worker republishes messages of its previous boot only at its start."""


class _NewestBoot(NamedTuple):
    boot_id: int
    began_ns: int
    """Arrival of its first message."""


@dataclass
class SharedNames:
    """The newest boot of every stream, and names under which an older one sends as well."""

    _newest: dict[Key, _NewestBoot] = field(default_factory=dict)
    _shared_ns: dict[Key, int] = field(default_factory=dict)
    """Last message of an older boot, by its key without a stream."""
    _unlogged: list[Key] = field(default_factory=list)

    def note(self, where: Key, boot_id: int, now_ns: int) -> None:
        """Note a live message and its arrival."""
        if where.stream not in _STREAMS.get(where.owner, ()):
            return
        newest = self._newest.get(where)
        if newest is None or boot_id > newest.boot_id:
            self._newest[where] = _NewestBoot(boot_id, now_ns)
        elif boot_id < newest.boot_id and now_ns - newest.began_ns > _OVERLAP_S * NS_PER_S:
            sender = where._replace(stream="")
            before_ns = self._shared_ns.get(sender)
            if before_ns is None or now_ns - before_ns > _REMEMBERED_S * NS_PER_S:
                self._unlogged.append(sender)
            self._shared_ns[sender] = now_ns

    def forget(self, where: Key, boot_id: int) -> None:
        """Forget a stream whose newest boot is forgotten."""
        newest = self._newest.get(where)
        if newest is not None and newest.boot_id == boot_id:
            del self._newest[where]
            self._shared_ns.pop(where._replace(stream=""), None)

    def news(self) -> list[tuple[Key, str]]:
        """Return senders whose names are shared since the last call, each with a line on it."""
        found, self._unlogged = self._unlogged, []
        return [(sender, _line(sender)) for sender in found]

    def note_text(self, now_ns: int) -> str:
        """Return the names that are shared now, for `health`; empty without any."""
        shared = [
            sender
            for sender, at_ns in sorted(self._shared_ns.items())
            if now_ns - at_ns <= _REMEMBERED_S * NS_PER_S
        ]
        more = [f"{len(shared) - _MAX_NAMED} more"] if len(shared) > _MAX_NAMED else []
        return "; ".join([*map(shared_name, shared[:_MAX_NAMED]), *more])


def shared_name(sender: Key) -> str:
    """Return that several trucks or workers have the name of a key."""
    if sender.owner == "vehicle":
        return f"several trucks in realm {sender.realm} are named {sender.identifier}"
    return f"several workers in realm {sender.realm} publish results of {sender.identifier}"


def _line(sender: Key) -> str:
    if sender.owner == "vehicle":
        return f"{shared_name(sender)}: their crossings are mixed; give each truck an id of its own"
    return f"{shared_name(sender)}: crossings are identified repeatedly; stop all but one"
