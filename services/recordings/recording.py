"""Recordings: MCAP files of the bytes that went over the bus, and what is needed to read them.

One MCAP channel per key and boot; its topic is the Zenoh key, its metadata holds the boot_id, the
message's `sequence` is MCAP's own, `log_time` the wall time of the first sample, `publish_time`
when the message came in. Schemas carry all that they import, so that Rerun and Foxglove decode
them. Besides the messages a file has

- metadata `driveby`: program, version, format, and realm and vehicle where there is only one;
- metadata `driveby.start` and `driveby.end`: reason, time, and at the end the counts. A file
  without `driveby.end` was cut off: everything up to its last whole chunk can still be read. A file
  that continues another one names it as `previous` in `driveby.start`, and begins with that many
  latched messages again as `repeated` says;
- metadata `driveby.identities`, every minute and before the end: by key and boot, the sequence
  numbers of all messages before it;
- metadata `driveby.recovered`, if the file was rewritten by `driveby recover`: what was lost;
- attachment `site.toml`, if the site was known to the writer.
"""

import contextlib
import fcntl
import logging
import os
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from importlib import metadata
from itertools import chain
from pathlib import Path
from typing import BinaryIO, Literal, NamedTuple

from mcap.records import Attachment, Channel, Metadata
from mcap.writer import MCAP0_MAGIC

from schemas.messages import check_stamp, descriptors
from schemas.signals import check_wall_time, encode_identity
from schemas.topics import Key, key, parse_key, topic
from services.common.disk import DISK, Disk, write_all
from services.common.errors import InputError
from services.common.files import check_ordinary, is_held, replaced_atomically
from services.common.intervals import Intervals
from services.recordings.mcap_file import McapWriter
from services.recordings.mcap_scan import Damage, RawMessage, last_metadata, scan

FORMAT = "1"
ABOUT = "driveby"
START = "driveby.start"
END = "driveby.end"
IDENTITIES = "driveby.identities"
RECOVERED = "driveby.recovered"
SITE = "site.toml"

_log = logging.getLogger(__name__)
CHUNK_BYTES = 64 * 1024
_BOOT_DIGITS = 20
"""Of a number of 64 bits."""
_IDENTITIES_PERIOD_S = 60.0
"""What is newer must be read message by message after a crash, before recording goes on."""

Identities = dict[tuple[Key, int], Intervals]
"""By key and boot_id: the sequence numbers of the messages."""


class Message(NamedTuple):
    """One message as it went over the bus; its identity is (key, boot_id, sequence)."""

    key: Key
    payload: bytes
    boot_id: int
    sequence: int
    log_time_ns: int
    """Wall time of the first sample, ns since 1970 UTC."""
    publish_time_ns: int
    """Wall time at which the writer got it, ns since 1970 UTC."""


Misplaced = Literal["deleted", "cut short", "moved"]
"""What can become of a recording that is being written. Moved, it still holds everything."""


class RecordingInfo(NamedTuple):
    """What a recording says of itself and what it holds."""

    about: dict[str, str]
    start: dict[str, str]
    end: dict[str, str] | None
    """None: the writer did not get to finish the file."""
    site_toml: str | None
    messages: dict[str, int]
    """Number of messages by key."""
    first_time_ns: int
    last_time_ns: int
    damaged_chunks: int
    """Places in the middle of the file that cannot be read, a chunk each as a rule."""
    truncated: bool
    """The file ends in the middle of a record or without MCAP's footer."""


class RecordingWriter:
    """Writes a recording under its final name, so that a crash leaves a readable file.

    `sync()` must be called at least once a second: what was written before it survives `kill -9`
    and loss of power. Until it is closed the file is locked (flock), which tells a recording that
    is being written from one whose writer has died. Not thread-safe. Every method may raise
    OSError; then only `fail` may follow.
    """

    def __init__(
        self,
        path: Path,
        *,
        reason: str,
        realm: str | None = None,
        vehicle: str | None = None,
        site_toml: str | None = None,
        time_ns: int | None = None,
        previous: str | None = None,
        latched: Sequence[Message] = (),
        disk: Disk = DISK,
    ) -> None:
        """Create the file; InputError if it exists (recordings are never overwritten).

        `previous` is the name of the recording that this one continues, `latched` what a reader
        must know of it: those messages are written once more.
        """
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = disk.create(path)
        except FileExistsError:
            raise InputError(
                f"{path}: exists, and a recording is never overwritten; give another name"
            ) from None
        except OSError as error:
            raise InputError(f"{path}: cannot be written: {error.strerror}") from None
        self.path = path
        self.messages = 0
        """Number of messages written."""
        self.identities: Identities = {}
        self._disk = disk
        self._is_dirty = True
        self._has_failed_sync = False
        self._next_identities_s = time.monotonic() + _IDENTITIES_PERIOD_S
        fcntl.flock(self._file, fcntl.LOCK_EX)
        start = {"previous": previous} if previous else {}
        start |= {"repeated": str(len(latched))} if latched else {}
        try:
            self._mcap = _begin(
                lambda data: write_all(self._file, data),
                {"reason": reason} | start,
                realm=realm,
                vehicle=vehicle,
                site_toml=site_toml,
                time_ns=time_ns,
            )
            for message in latched:
                self.write(message)
            self.sync()
            disk.sync_folder(path.parent)
        except OSError:
            self._file.close()
            raise

    def write(self, message: Message) -> None:
        """Add one message; it is safe on disk only after `sync()`."""
        name = (message.key, message.boot_id)
        numbers = self.identities.get(name)
        if numbers is None:
            numbers = self.identities[name] = Intervals()
        numbers.add(message.sequence)
        self._is_dirty = True
        self.messages += 1
        _add(self._mcap, message)

    def sync(self) -> None:
        """Close the chunk and bring everything written so far to the disk itself."""
        if self._is_dirty:
            self._mcap.writer.flush()
            if time.monotonic() >= self._next_identities_s:
                self._next_identities_s = time.monotonic() + _IDENTITIES_PERIOD_S
                self._mcap.writer.add_metadata(IDENTITIES, identities_text(self.identities))
            self._sync_file()
            self._is_dirty = False

    def misplaced(self) -> Misplaced | None:
        """What somebody else has done to the file under its writer, after `sync`; None: nothing."""
        status = os.fstat(self._file.fileno())
        if status.st_nlink == 0:
            return "deleted"
        if status.st_size < self.tell():
            return "cut short"
        try:
            there = self.path.stat()
        except (FileNotFoundError, NotADirectoryError):
            return "moved"
        is_same = (there.st_dev, there.st_ino) == (status.st_dev, status.st_ino)
        return None if is_same else "moved"

    def tell(self) -> int:
        """Return the bytes in the file so far, without the open chunk."""
        return self._mcap.writer.offset

    def finish(
        self,
        reason: str,
        counts: Mapping[str, int] | None = None,
        time_ns: int | None = None,
    ) -> None:
        """Write the END sentinel with its reason and counts, the index, and close the file."""
        self._mcap.writer.add_metadata(IDENTITIES, identities_text(self.identities))
        _end(self._mcap.writer, reason, self.messages, counts or {}, time_ns)
        self._sync_file()
        self._file.close()

    def fail(self, reason: str, counts: Mapping[str, int], events: Iterable[Message]) -> int | None:
        """Close the file after an OSError, with END and what happened if there is room for that.

        Half a chunk at the end is cut off, and messages not yet in a chunk are given up: their
        number is returned, or None if what was written after the last `sync` may be lost too.
        Never raises OSError: without END the file is one that crashed, and as readable.
        """
        writer = self._mcap.writer
        discarded = writer.discard()
        self.messages -= discarded
        whole = writer.offset
        try:
            self._cut(whole)
            for event in events:
                self.messages += 1
                _add(self._mcap, event)
            counts = {**counts, "not_written": discarded}
            _end(writer, reason, self.messages, counts, None)
            self._sync_file()
        except OSError as error:
            _log.error("%s: not even its end could be written: %s", self.path, error.strerror)
            with contextlib.suppress(OSError):
                self._cut(whole)
                self._sync_file()
        self.abandon()
        # After one failure the next success says nothing: the system may have forgotten the pages.
        return None if self._has_failed_sync else discarded

    def abandon(self) -> None:
        """Close the file as it is: what was synced stays readable."""
        try:
            self._file.close()
        except OSError as error:  # the handle is closed anyway
            _log.error("%s: %s", self.path, error.strerror)

    def _sync_file(self) -> None:
        try:
            self._disk.sync(self._file.fileno())
        except OSError:
            self._has_failed_sync = True
            raise

    def _cut(self, size: int) -> None:
        self._file.truncate(size)
        self._file.seek(size)


def write_recording(
    path: Path,
    messages: Iterable[Message],
    *,
    site_toml: str | None,
    reason: str,
    force: bool = False,
) -> int:
    """Write a whole recording beside `path`, sync it and rename it; return how many messages.

    Realm and vehicle are those of the first message. The file depends on nothing but the arguments
    and this program's version: no clock is read. InputError if `path` cannot be written, is a
    recording (which `force` replaces, unless somebody writes it) or there is no message,
    FailureError if writing fails; then `path` is as it was before.
    """
    source = iter(messages)
    first = next(source, None)
    if first is None:
        raise InputError(f"{path}: there is no message to write")
    written = 0
    last_time_ns = first.log_time_ns
    realm = first.key.realm
    vehicle = first.key.identifier if first.key.owner == "vehicle" else None
    with replaced_atomically(path, force=force) as temporary, temporary.open("wb") as file:
        mcap = _begin(
            file.write,
            {"reason": reason},
            realm=realm,
            vehicle=vehicle,
            site_toml=site_toml,
            time_ns=first.log_time_ns,
        )
        for message in chain([first], source):
            _add(mcap, message)
            written += 1
            last_time_ns = max(last_time_ns, message.log_time_ns)
        _end(mcap.writer, reason, written, {}, last_time_ns)
    return written


def read_messages(path: Path) -> Iterator[Message]:
    """Yield the messages in the order of the file.

    A file that was cut off is read up to its last whole chunk, damaged places are left out; both
    are logged (and counted by `read_info`). InputError if the file is missing, is no MCAP file,
    holds no message of ours, or one of a truck that is larger than its topic allows: taking apart
    what fits the name of a message and nothing else can cost gigabytes.
    """
    found = False
    for item in _scan(path):
        if isinstance(item, Message):
            found = True
            owner, stream = item.key.owner, item.key.stream
            if owner == "vehicle" and len(item.payload) > topic(owner, stream).max_bytes:
                check_message(path, item)
            yield item
        elif isinstance(item, Damage):
            _log.warning("%s: %s", path, item.text)
    if not found:
        raise InputError(f"{path}: holds no driveby message; a recording of a truck is expected")


def check_message(path: Path, message: Message) -> None:
    """InputError if the bus would not take a message, or no logger: what is wrong, in one line."""
    _, owner, identifier, stream = message.key
    try:
        check_stamp(topic(owner, stream), message.payload)
        check_wall_time(message.log_time_ns)
        encode_identity(message.boot_id, message.sequence)
    except ValueError as error:
        where = f"message {message.sequence} of {identifier}"
        raise InputError(f"{path}: {where}: {error}") from None


def read_site(path: Path) -> str | None:
    """Return the site file stored in the recording, None if there is none; InputError as above."""
    for item in _scan(path):
        if isinstance(item, Attachment) and item.name == SITE:
            try:
                return item.data.decode()
            except UnicodeDecodeError:
                raise InputError(f"{path}: its attachment {SITE} is not UTF-8 text") from None
        if isinstance(item, Message):  # the attachment stands before all messages
            return None
    return None


def read_info(
    path: Path, look: Callable[[Message], object] = lambda message: None
) -> RecordingInfo:
    """Read the whole file and say what is in it; InputError if it is missing or not MCAP.

    `look` is given every message of a topic that is logged.
    """
    sentinels: dict[str, dict[str, str]] = {}
    site_toml: str | None = None
    counts: Counter[str] = Counter()
    first_time_ns, last_time_ns = 0, 0
    damaged_chunks, truncated = 0, False
    for item in _scan(path):
        match item:
            case Message():
                if topic(item.key.owner, item.key.stream).logged:
                    look(item)
                counts[key(*item.key)] += 1
                first_time_ns = min(first_time_ns or item.log_time_ns, item.log_time_ns)
                last_time_ns = max(last_time_ns, item.log_time_ns)
            case Metadata():
                sentinels[item.name] = dict(item.metadata)
            case Attachment() if item.name == SITE:
                site_toml = item.data.decode(errors="replace")
            case Damage():
                truncated = truncated or item.is_cut_off
                damaged_chunks += 0 if item.is_cut_off else 1
    return RecordingInfo(
        sentinels.get(ABOUT, {}),
        sentinels.get(START, {}),
        sentinels.get(END),
        site_toml,
        dict(counts),
        first_time_ns,
        last_time_ns,
        damaged_chunks,
        truncated,
    )


def read_identities(path: Path) -> Identities:
    """Return which messages a recording holds, without reading all of it if it is one of ours.

    InputError if the file is missing or not MCAP.
    """
    identities: Identities = {}
    start = 0
    with _opened(path) as file:
        stored = last_metadata(file, IDENTITIES)
    if stored is not None:
        try:
            identities = _parsed_identities(stored[0].metadata)
            start = stored[1]
        except ValueError:
            _log.warning("%s: its %s cannot be read", path, IDENTITIES)
    for item in _scan(path, start):
        if isinstance(item, Metadata) and item.name == END:
            break
        if isinstance(item, Message):
            numbers = identities.setdefault((item.key, item.boot_id), Intervals())
            numbers.add(item.sequence)
    return identities


def is_closed(path: Path) -> bool:
    """Whether a recording has an END sentinel and its index; InputError if it cannot be read."""
    with _opened(path) as file:
        size = os.fstat(file.fileno()).st_size
        file.seek(max(0, size - len(MCAP0_MAGIC)))
        return file.read() == MCAP0_MAGIC and last_metadata(file, END) is not None


def is_being_written(path: Path) -> bool:
    """Whether a living process writes to a recording; InputError if it cannot be opened."""
    with _opened(path) as file:
        return is_held(file)


class _Mcap(NamedTuple):
    writer: McapWriter
    schemas: dict[str, int]
    channels: dict[tuple[Key, int], int]


def _begin(
    write: Callable[[bytes], object],
    start: dict[str, str],
    *,
    realm: str | None,
    vehicle: str | None,
    site_toml: str | None,
    time_ns: int | None,
) -> _Mcap:
    writer = McapWriter(write, library=f"driveby {program_version()}", chunk_bytes=CHUNK_BYTES)
    about = {"program": "driveby", "version": program_version(), "format": FORMAT}
    about |= {"realm": realm} if realm else {}
    about |= {"vehicle": vehicle} if vehicle else {}
    writer.add_metadata(ABOUT, about)
    if site_toml is not None:
        writer.add_attachment(SITE, "application/toml", site_toml.encode())
    now_ns = time.time_ns() if time_ns is None else time_ns
    writer.add_metadata(START, start | {"time_ns": str(now_ns)})
    return _Mcap(writer, {}, {})


def _add(mcap: _Mcap, message: Message) -> None:
    name = (message.key, message.boot_id)
    channel = mcap.channels.get(name)
    if channel is None:
        channel = mcap.channels[name] = _register(mcap, *name)
    mcap.writer.add_message(
        channel,
        message.sequence,
        message.log_time_ns,
        message.publish_time_ns,
        message.payload,
    )


def _register(mcap: _Mcap, where: Key, boot_id: int) -> int:
    name = topic(where.owner, where.stream).message
    if not name:
        raise ValueError(f"{where.owner}/{where.stream} has no message to record")
    schema = mcap.schemas.get(name)
    if schema is None:
        schema = mcap.writer.add_schema(name, "protobuf", descriptors(name))
        mcap.schemas[name] = schema
    return mcap.writer.add_channel(
        key(*where), "protobuf", schema, {"boot_id": str(boot_id), "stream": where.stream}
    )


def _end(
    writer: McapWriter, reason: str, messages: int, counts: Mapping[str, int], time_ns: int | None
) -> None:
    now_ns = time.time_ns() if time_ns is None else time_ns
    figures = {name: str(value) for name, value in counts.items()}
    known = {"reason": reason, "time_ns": str(now_ns), "messages": str(messages)}
    writer.add_metadata(END, figures | known)
    writer.finish()


def identities_text(identities: Identities) -> dict[str, str]:
    """Return the content of the metadata `driveby.identities`."""
    return {
        f"{key(*where)} {boot_id}": ",".join(f"{a}-{b}" for a, b in numbers.ranges())
        for (where, boot_id), numbers in identities.items()
    }


def _parsed_identities(stored: Mapping[str, str]) -> Identities:
    identities: Identities = {}
    for name, ranges in stored.items():
        where, _, boot_id = name.partition(" ")
        numbers = identities[(parse_key(where), int(boot_id))] = Intervals()
        for text in ranges.split(","):
            first, _, last = text.partition("-")
            numbers.add_range(int(first), int(last))
    return identities


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[BinaryIO]:
    check_ordinary(path)
    try:
        with path.open("rb") as file:
            yield file
    except OSError as error:
        missing = isinstance(error, FileNotFoundError)
        why = "no such file" if missing else f"cannot be read: {error.strerror}"
        raise InputError(f"{path}: {why}") from None


def _scan(path: Path, start: int = 0) -> Iterator[Message | Metadata | Attachment | Damage]:
    """Yield all that is of use in a file, in its order, and what is damaged."""
    with _opened(path) as file:
        size = os.fstat(file.fileno()).st_size
        if size == 0:
            raise InputError(f"{path}: is empty; an MCAP recording is expected")
        if file.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC:
            raise InputError(f"{path}: is not an MCAP file; a recording (.mcap) is expected")
        channels: dict[int, tuple[Key, int] | None] = {}
        has_looked = False
        for item in scan(file, start):
            if isinstance(item, RawMessage):
                if item.channel_id not in channels and not has_looked:
                    has_looked = True
                    # The chunk that said it is lost. Ours say it again in every chunk; of older
                    # files only the summary does.
                    everywhere = find_channels(path).items()
                    channels |= {
                        n: _our_channel(path, c) for n, c in everywhere if n not in channels
                    }
                known = channels.setdefault(item.channel_id, None)
                if known is not None:
                    where, boot_id = known
                    _, sequence, log_time_ns, publish_time_ns, data = item
                    yield Message(where, data, boot_id, sequence, log_time_ns, publish_time_ns)
            elif isinstance(item, Channel):
                if item.id not in channels:
                    channels[item.id] = _our_channel(path, item)
            elif isinstance(item, (Metadata, Attachment, Damage)):
                yield item


def find_channels(path: Path) -> dict[int, Channel]:
    """Return all channels that are named anywhere in a file; of several, the first."""
    channels: dict[int, Channel] = {}
    with _opened(path) as file:
        for item in scan(file):
            if isinstance(item, Channel):
                channels.setdefault(item.id, item)
    return channels


def _our_channel(path: Path, channel: Channel) -> tuple[Key, int] | None:
    boot_id = channel.metadata.get("boot_id", "0")
    try:
        where = parse_key(channel.topic)
    except ValueError:
        _log.warning("%s: topic %.80r is not ours and is left out", path, channel.topic)
        return None
    is_number = boot_id.isascii() and boot_id.isdecimal() and len(boot_id) <= _BOOT_DIGITS
    return where, int(boot_id) if is_number else 0


def program_version() -> str:
    """Return this program's version, as recordings and results carry it."""
    try:
        return metadata.version("driveby")
    except metadata.PackageNotFoundError:  # run from a checkout that was not installed
        return "0"
