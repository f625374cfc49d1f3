"""Recovery of a damaged recording: all valid content, and exact counts of the losses."""

import contextlib
import fcntl
import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import BinaryIO, NamedTuple

from mcap.records import Attachment, Channel, DataEnd, Metadata, Schema

from schemas.events import Event, EventKind, encode_event
from schemas.messages import descriptors
from schemas.topics import Key, check_realm, key, parse_key, topic
from services.common.errors import FailureError, InputError
from services.common.files import (
    check_ordinary,
    check_writable,
    remove_leftovers,
    replaced_atomically,
)
from services.common.interrupts import interrupts_held
from services.common.intervals import Intervals
from services.common.progress import Offset, no_progress
from services.recordings.mcap_file import McapWriter
from services.recordings.mcap_scan import ChannelCount, Damage, RawMessage, scan
from services.recordings.recording import (
    ABOUT,
    END,
    IDENTITIES,
    RECOVERED,
    find_channels,
    program_version,
    watched,
)
from services.recordings.writer import CHUNK_BYTES, identities_text

SUFFIX = ".recovered.mcap"
ASIDE = ".crashed"
"""Suffix of a damaged recording that another one has replaced."""
SERVICE = "recover"
"""Name of the service that writes the event in a recovered recording."""
NOT_FINISHED = "recovered, as its writer did not finish it"
"""Reason in the END of a recovered recording that had none."""


class Recovery(NamedTuple):
    """Result of a recovery."""

    messages: int
    """Number of messages written, all complete."""
    lost: int | None
    """Number of lost messages; None if the file does not show it."""
    missing_numbers: int
    """Number of absent sequence numbers of trucks' data, including those that events report.

    Other streams are spread over files, or sent again: absent numbers are no loss.
    """
    damaged_places: int
    damaged_bytes: int
    """Bytes in the damaged places, and at the end of a truncated file."""
    is_cut_off: bool
    """Whether there is no END sentinel: the writer died, or the end of the file is lost."""
    bytes: int
    """Size of the damaged file."""
    set_aside_as: str | None = None
    """New path of the damaged file; None if it was not renamed."""

    @property
    def is_lossy(self) -> bool:
        """Whether any content of the file may be missing."""
        return bool(self.is_cut_off or self.damaged_places or self.lost)


def recovered_path(source: Path) -> Path:
    """Return the default path of a recovered recording."""
    return source.with_name(source.name.removesuffix(ASIDE).removesuffix(".mcap") + SUFFIX)


def put_aside(source: Path) -> Path:
    """Rename a damaged recording so that `*.mcap` does not match; return its new name."""
    aside = source.with_name(source.name + ASIDE)
    number = 2
    while aside.exists():
        aside = source.with_name(f"{source.name}{ASIDE}-{number}")
        number += 1
    try:
        source.rename(aside)
    except OSError as error:
        raise FailureError(f"{source}: cannot be renamed: {error.strerror}") from None
    return aside


def is_name_taken(path: Path) -> bool:
    """Return whether a recording of that name exists, or a recovered or replaced one."""
    return (
        path.exists() or recovered_path(path).exists() or path.with_name(path.name + ASIDE).exists()
    )


def recover_recording(
    source: Path,
    target: Path,
    time_ns: int | None = None,
    *,
    force: bool = False,
    set_aside: bool = False,
    adds_event: bool = True,
    progress: Offset = no_progress,
) -> Recovery:
    """Write the valid content of `source` to `target`, next to it first and then renamed.

    Messages, channels, metadata and attachments are copied unchanged, foreign topics too. A lost
    schema is taken from our own tables. Damage after the END sentinel affects only the index, which
    is rebuilt. Metadata `driveby.recovered` and, with `adds_event`, an event document the recovery
    in the file. Memory is bounded whatever the file holds. `progress` receives the position in it.
    With `set_aside` the source is renamed then (see `put_aside`), and an interrupt does not leave
    both.

    Raise InputError if `source` is missing, is not MCAP, holds nothing readable, is being written,
    or is `target`, and if there is a recording at `target`, which only `force` replaces;
    FailureError if reading or writing failed. There is no other exception.
    """
    now_ns = time.time_ns() if time_ns is None else time_ns
    if target.exists() and source.exists() and target.samefile(source):
        raise InputError(f"{target}: is the damaged recording itself; give another name")
    check_ordinary(source)
    check_writable(target, force=force)
    try:
        file = source.open("rb")
    except FileNotFoundError:
        raise InputError(f"{source}: no such file") from None
    except OSError as error:
        raise InputError(f"{source}: cannot be read: {error.strerror}") from None
    with file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)  # two at once would conflict
        except BlockingIOError:
            raise InputError(
                f"{source}: is being written, or recovered by another process, at this moment"
            ) from None
        if not any(not isinstance(item, Damage) for item in _read(source, file)):
            raise InputError(f"{source}: holds nothing readable of an MCAP recording")
        if target == recovered_path(source):  # the lock of the source covers it
            remove_leftovers(target)
        with contextlib.ExitStack() as renaming:
            with replaced_atomically(target, force=force) as temporary:
                with temporary.open("wb") as out:
                    library = f"driveby {program_version()}"
                    writer = McapWriter(out.write, library=library, chunk_bytes=CHUNK_BYTES)
                    copy = _Copier(source, writer, adds_event=adds_event)
                    for item in _read(source, file, progress):
                        copy.take(item)
                    recovery = copy.finish(source, source.stat().st_size, now_ns)
                renaming.enter_context(interrupts_held())
            if set_aside:
                recovery = recovery._replace(set_aside_as=str(put_aside(source)))
        return recovery


def _read(source: Path, file: BinaryIO, progress: Offset = no_progress) -> Iterable[object]:
    # An OSError of the source must not count as one of the target.
    try:
        yield from watched(scan(file), file, progress)
    except OSError as error:
        raise FailureError(f"{source}: reading failed: {error.strerror}") from None


class _Copier:
    """A copier of valid items from one file to another."""

    def __init__(self, source: Path, writer: McapWriter, *, adds_event: bool) -> None:
        self._source = source
        self._writer = writer
        self._adds_event = adds_event
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._new_schemas: dict[tuple[str, str, bytes], int] = {}
        self._new_channels: dict[int, int] = {}
        self._has_searched = False
        self._numbers: dict[int, Intervals] = {}
        self._about: dict[str, str] = {}
        self._end: dict[str, str] | None = None
        self._is_behind_data = False
        self._damaged_places = 0
        self._damaged_bytes = 0
        self._is_after_damage = False
        self._lost_by_index = 0
        self._unknown = 0
        self._last_ns = 0

    def take(self, item: object) -> None:
        """Copy what is to be copied, and count."""
        match item:
            case RawMessage():
                self._is_after_damage = False
                self._copy(item)
            case ChannelCount():
                # The index of a damaged chunk may be intact.
                self._lost_by_index += item.messages if self._is_after_damage else 0
            case Schema():
                self._schemas.setdefault(item.id, item)
            case Channel():
                self._channels.setdefault(item.id, item)
            case Attachment():
                self._writer.add_attachment(
                    item.name,
                    item.media_type,
                    item.data,
                    log_time=item.log_time,
                    create_time=item.create_time,
                )
            case Metadata():
                self._metadata(item)
            case DataEnd():
                self._is_behind_data = True
            case Damage() if not self._is_behind_data:
                self._is_after_damage = True
                self._damaged_places += item.size > 0
                self._damaged_bytes += item.size

    def finish(self, source: Path, size: int, now_ns: int) -> Recovery:
        """Write the data on the damage that a reader needs, and END."""
        written = self._writer.messages + self._writer.pending
        lost: int | None = None
        if self._end is not None:
            stated = self._end.get("messages", "")
            if stated.isascii() and stated.isdecimal():
                # Not negative: the number itself may be damaged.
                lost = max(0, int(stated) - written)
        elif self._lost_by_index or self._unknown:
            lost = self._lost_by_index + self._unknown
        recovery = Recovery(
            messages=written,
            lost=lost,
            missing_numbers=sum(map(_missing, self._numbers_of_trucks())),
            damaged_places=self._damaged_places,
            damaged_bytes=self._damaged_bytes,
            is_cut_off=self._end is None,
            bytes=size,
        )
        self._say(source, recovery, now_ns)
        return recovery

    def _numbers_of_trucks(self) -> Iterator[Intervals]:
        for channel_id, numbers in self._numbers.items():
            named = _name(self._channels[channel_id])
            if named is None or named[0].owner != "vehicle":
                continue
            if not topic("vehicle", named[0].stream).latched:
                yield numbers

    def _metadata(self, record: Metadata) -> None:
        if record.name == END:
            self._end = dict(record.metadata)
            self._is_behind_data = True
        elif record.name != IDENTITIES:  # written again below
            if record.name == ABOUT:
                self._about = dict(record.metadata)
            self._writer.add_metadata(record.name, record.metadata)

    def _copy(self, message: RawMessage) -> None:
        new_id = self._new_channels.get(message.channel_id)
        if new_id is None:
            channel = self._channel(message.channel_id)
            if channel is None:
                self._unknown += 1
                return
            new_id = self._new_channels[message.channel_id] = self._register(channel)
        self._numbers.setdefault(message.channel_id, Intervals()).add(message.sequence)
        self._last_ns = max(self._last_ns, message.log_time_ns)
        self._writer.add_message(
            new_id,
            message.sequence,
            message.log_time_ns,
            message.publish_time_ns,
            message.data,
        )

    def _channel(self, channel_id: int) -> Channel | None:
        if channel_id not in self._channels and not self._has_searched:
            # Its chunk is lost; another one or the summary may name the channel too.
            self._has_searched = True
            self._channels = find_channels(self._source) | self._channels
        return self._channels.get(channel_id)

    def _register(self, channel: Channel) -> int:
        found = self._schemas.get(channel.schema_id)
        schema = None if found is None else (found.name, found.encoding, found.data)
        if schema is None or not schema[2]:
            schema = _own_schema(channel) or schema
        schema_id = 0
        if schema is not None:
            schema_id = self._new_schemas.get(schema, 0) or self._writer.add_schema(*schema)
            self._new_schemas[schema] = schema_id
        return self._writer.add_channel(
            channel.topic, channel.message_encoding, schema_id, channel.metadata
        )

    def _say(self, source: Path, recovery: Recovery, now_ns: int) -> None:
        summary = {
            "version": program_version(),
            "time_ns": str(now_ns),
            "from": source.name,
            "bytes": str(recovery.bytes),
            "messages": str(recovery.messages),
            "lost": "unknown" if recovery.lost is None else str(recovery.lost),
            "missing_numbers": str(recovery.missing_numbers),
            "damaged_places": str(recovery.damaged_places),
            "damaged_bytes": str(recovery.damaged_bytes),
            "cut_off": str(recovery.is_cut_off).lower(),
        }
        self._writer.add_metadata(RECOVERED, summary)
        written = recovery.messages
        realm = self._realm()
        if self._adds_event and recovery.is_lossy and realm is not None:
            self._add_event(Key(realm, "service", SERVICE, "event"), recovery, now_ns)
            written += 1
        identities = {
            named: self._numbers[channel_id]
            for channel_id in self._numbers
            if (named := _name(self._channels[channel_id])) is not None
        }
        self._writer.add_metadata(IDENTITIES, identities_text(identities))
        end = self._end or {
            "reason": NOT_FINISHED,
            "time_ns": str(self._last_ns or now_ns),
        }
        self._writer.add_metadata(END, end | {"messages": str(written)})
        self._writer.finish()

    def _add_event(self, where: Key, recovery: Recovery, now_ns: int) -> None:
        name = topic(where.owner, where.stream).message
        schema_id = self._writer.add_schema(name, "protobuf", descriptors(name))
        metadata = {"boot_id": str(now_ns), "stream": where.stream}
        channel_id = self._writer.add_channel(key(*where), "protobuf", schema_id, metadata)
        event = Event(
            EventKind.RECORDING_RECOVERED,
            now_ns,
            describe(recovery),
            vehicle=self._about.get("vehicle", ""),
            messages=recovery.messages,
        )
        # At the end of the drive, so that a viewer's time axis need not reach to today.
        log_time_ns = self._last_ns or now_ns
        self._writer.add_message(channel_id, 0, log_time_ns, now_ns, encode_event(event))

    def _realm(self) -> str | None:
        names = [name for c in self._channels.values() if (name := _name(c)) is not None]
        candidates = [self._about.get("realm", ""), *(where.realm for where, _ in names)]
        for realm in candidates:
            try:
                return check_realm(realm)
            except ValueError:
                continue
        return None


def describe(recovery: Recovery) -> str:
    """Return the result of a recovery in one line."""
    lost = "an unknown number of messages" if recovery.lost is None else _messages(recovery.lost)
    parts = [f"{_messages(recovery.messages)} recovered"]
    if recovery.is_lossy:
        parts.append(f"{lost} lost")
    if recovery.missing_numbers:
        parts.append(f"{recovery.missing_numbers:,} sequence numbers missing")
    if recovery.damaged_places:
        places = "1 place" if recovery.damaged_places == 1 else f"{recovery.damaged_places} places"
        parts.append(f"{recovery.damaged_bytes:,} of {recovery.bytes:,} bytes damaged in {places}")
    parts += ["the file ends without its summary"] if recovery.is_cut_off else []
    return ", ".join(parts)


def _messages(number: int) -> str:
    return f"{number:,} message{'' if number == 1 else 's'}"


def _own_schema(channel: Channel) -> tuple[str, str, bytes] | None:
    named = _name(channel)
    if named is None or channel.message_encoding != "protobuf":
        return None
    where, _ = named
    name = topic(where.owner, where.stream).message
    return (name, "protobuf", descriptors(name)) if name else None


def _name(channel: Channel) -> tuple[Key, int] | None:
    boot_id = channel.metadata.get("boot_id", "0")
    try:
        return parse_key(channel.topic), int(boot_id) if boot_id.isascii() else 0
    except ValueError:
        return None


def _missing(numbers: Intervals) -> int:
    return sum(last - first + 1 for first, last in numbers.gaps())
