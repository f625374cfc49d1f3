"""Recordings: MCAP files of the bytes that went over the bus, and what is needed to read them.

One MCAP channel per key and boot; its topic is the Zenoh key, its metadata holds the boot_id, the
message's `sequence` is MCAP's own, `log_time` the wall time of the first sample, `publish_time`
when the message came in. Schemas carry all that they import, so that Rerun and Foxglove decode
them. Besides the messages a file has

- metadata `driveby`: program, version, format, and realm and vehicle where there is only one;
- metadata `driveby.start` and `driveby.end`: reason, time, and at the end the counts. A file
  without `driveby.end` was cut off: everything up to its last whole chunk can still be read;
- attachment `site.toml`, if the site was known to the writer.
"""

import io
import logging
import os
import struct
import time
import zlib
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from importlib import metadata
from itertools import chain
from pathlib import Path
from typing import BinaryIO, NamedTuple

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Metadata
from mcap.records import Message as McapMessage
from mcap.stream_reader import CRCValidationError, breakup_chunk
from mcap.writer import MCAP0_MAGIC, CompressionType, Writer

from schemas.messages import descriptors
from schemas.topics import Key, key, parse_key, topic
from services.common.errors import InputError
from services.common.files import replaced_atomically

FORMAT = "1"
ABOUT = "driveby"
START = "driveby.start"
END = "driveby.end"
SITE = "site.toml"

_log = logging.getLogger(__name__)
_CHUNK_BYTES = 64 * 1024
_RECORD_HEADER = struct.Struct("<BQ")
_DAMAGE = (
    McapError,
    CRCValidationError,
    zstandard.ZstdError,
    struct.error,
    UnicodeDecodeError,
    ValueError,
    zlib.error,
    EOFError,
)


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
    truncated: bool
    """The file ends in the middle of a record or without MCAP's footer."""


class RecordingWriter:
    """Writes a recording under its final name, so that a crash leaves a readable file.

    `sync()` must be called at least once a second: what was written before it survives `kill -9`
    and loss of power. Not thread-safe. Every method may raise OSError.
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
    ) -> None:
        """Create the file; InputError if it exists (recordings are never overwritten)."""
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = path.open("xb")
        except FileExistsError:
            raise InputError(
                f"{path}: exists, and a recording is never overwritten; give another name"
            ) from None
        except OSError as error:
            raise InputError(f"{path}: cannot be written: {error.strerror}") from None
        self.path = path
        self.messages = 0
        """Number of messages written."""
        self._mcap = _begin(self._file, reason, realm, vehicle, site_toml, time_ns)
        self.sync()
        _sync_folder(path.parent)

    def write(self, message: Message) -> None:
        """Add one message; it is safe on disk only after `sync()`."""
        _add(self._mcap, message)
        self.messages += 1

    def sync(self) -> None:
        """Close the chunk and bring everything written so far to the disk itself."""
        self._mcap.writer.flush()  # type: ignore[no-untyped-call]
        self._file.flush()
        os.fsync(self._file.fileno())

    def tell(self) -> int:
        """Return the bytes in the file so far, without the open chunk."""
        return self._file.tell()

    def finish(
        self,
        reason: str,
        counts: Mapping[str, int] | None = None,
        time_ns: int | None = None,
    ) -> None:
        """Write the END sentinel with its reason and counts, the index, and close the file."""
        try:
            _end(self._mcap.writer, reason, self.messages, counts or {}, time_ns)
            self._file.flush()
            os.fsync(self._file.fileno())
        finally:
            self._file.close()

    def abandon(self) -> None:
        """Close the file as it is, after a write error: what was synced stays readable."""
        try:
            self._file.close()
        except OSError as error:  # the buffer could not be written; the handle is closed anyway
            _log.error("%s: %s", self.path, error.strerror)


def write_recording(
    path: Path,
    messages: Iterable[Message],
    *,
    site_toml: str | None,
    reason: str,
) -> int:
    """Write a whole recording beside `path`, sync it and rename it; return how many messages.

    Realm and vehicle are those of the first message. The file depends on nothing but the arguments
    and this program's version: no clock is read. InputError if `path` cannot be written or there
    is no message, FailureError if writing fails; then `path` is as it was before.
    """
    source = iter(messages)
    first = next(source, None)
    if first is None:
        raise InputError(f"{path}: there is no message to write")
    written = 0
    last_time_ns = first.log_time_ns
    realm = first.key.realm
    vehicle = first.key.identifier if first.key.owner == "vehicle" else None
    with replaced_atomically(path) as temporary, temporary.open("wb") as file:
        mcap = _begin(file, reason, realm, vehicle, site_toml, first.log_time_ns)
        for message in chain([first], source):
            _add(mcap, message)
            written += 1
            last_time_ns = max(last_time_ns, message.log_time_ns)
        _end(mcap.writer, reason, written, {}, last_time_ns)
    return written


def read_messages(path: Path) -> Iterator[Message]:
    """Yield the messages in the order of the file.

    A file that was cut off is read up to its last whole chunk, a damaged chunk is left out; both
    are logged (and counted by `read_info`). InputError if the file is missing, is no MCAP file or
    holds no message of ours.
    """
    found = False
    for item in _scan(path):
        if isinstance(item, Message):
            found = True
            yield item
        elif isinstance(item, _Damage):
            _log.warning("%s: %s", path, item.text)
    if not found:
        raise InputError(f"{path}: holds no driveby message; a recording of a truck is expected")


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


def read_info(path: Path) -> RecordingInfo:
    """Read the whole file and say what is in it; InputError if it is missing or not MCAP."""
    sentinels: dict[str, dict[str, str]] = {}
    site_toml: str | None = None
    counts: Counter[str] = Counter()
    first_time_ns, last_time_ns = 0, 0
    damaged_chunks, truncated = 0, False
    for item in _scan(path):
        match item:
            case Message():
                counts[key(*item.key)] += 1
                first_time_ns = min(first_time_ns or item.log_time_ns, item.log_time_ns)
                last_time_ns = max(last_time_ns, item.log_time_ns)
            case Metadata():
                sentinels[item.name] = dict(item.metadata)
            case Attachment() if item.name == SITE:
                site_toml = item.data.decode(errors="replace")
            case _Damage():
                truncated = truncated or item.truncated
                damaged_chunks += 0 if item.truncated else 1
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


class _Mcap(NamedTuple):
    writer: Writer
    schemas: dict[str, int]
    channels: dict[tuple[Key, int], int]


class _Damage(NamedTuple):
    text: str
    truncated: bool


def _begin(
    file: BinaryIO,
    reason: str,
    realm: str | None,
    vehicle: str | None,
    site_toml: str | None,
    time_ns: int | None,
) -> _Mcap:
    writer = Writer(file, chunk_size=_CHUNK_BYTES, compression=CompressionType.ZSTD)
    writer.start(library=f"driveby {program_version()}")
    about = {"program": "driveby", "version": program_version(), "format": FORMAT}
    about |= {"realm": realm} if realm else {}
    about |= {"vehicle": vehicle} if vehicle else {}
    writer.add_metadata(ABOUT, about)
    if site_toml is not None:
        writer.add_attachment(0, 0, SITE, "application/toml", site_toml.encode())
    now_ns = time.time_ns() if time_ns is None else time_ns
    writer.add_metadata(START, {"reason": reason, "time_ns": str(now_ns)})
    return _Mcap(writer, {}, {})


def _add(mcap: _Mcap, message: Message) -> None:
    name = (message.key, message.boot_id)
    channel = mcap.channels.get(name)
    if channel is None:
        channel = mcap.channels[name] = _register(mcap, *name)
    mcap.writer.add_message(
        channel_id=channel,
        log_time=message.log_time_ns,
        data=message.payload,
        publish_time=message.publish_time_ns,
        sequence=message.sequence,
    )


def _register(mcap: _Mcap, where: Key, boot_id: int) -> int:
    name = topic(where.owner, where.stream).message
    if not name:
        raise ValueError(f"{where.owner}/{where.stream} has no message to record")
    schema = mcap.schemas.get(name)
    if schema is None:
        schema = mcap.writer.register_schema(name, "protobuf", descriptors(name))
        mcap.schemas[name] = schema
    return mcap.writer.register_channel(
        key(*where), "protobuf", schema, {"boot_id": str(boot_id), "stream": where.stream}
    )


def _end(
    writer: Writer, reason: str, messages: int, counts: Mapping[str, int], time_ns: int | None
) -> None:
    writer.flush()  # type: ignore[no-untyped-call]  # else the sentinel would stand before the last chunk
    now_ns = time.time_ns() if time_ns is None else time_ns
    figures = {name: str(value) for name, value in counts.items()}
    known = {"reason": reason, "time_ns": str(now_ns), "messages": str(messages)}
    writer.add_metadata(END, figures | known)
    writer.finish()  # type: ignore[no-untyped-call]


def _scan(path: Path) -> Iterator[Message | Metadata | Attachment | _Damage]:
    """Yield all that is of use in a file, in its order, and what is damaged.

    mcap's readers need an intact index or raise in the middle of a cut-off record; here every
    record is measured against what is left of the file before it is read.
    """
    channels: dict[int, Channel] = {}
    keys: dict[int, Key | None] = {}
    try:
        with path.open("rb") as file:
            size = os.fstat(file.fileno()).st_size
            if size == 0:
                raise InputError(f"{path}: is empty; an MCAP recording is expected")
            if file.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC:
                raise InputError(f"{path}: is not an MCAP file; a recording (.mcap) is expected")
            for record in _records(file, size):
                if isinstance(record, Channel):
                    channels[record.id] = record
                    keys[record.id] = _our_key(path, record)
                elif isinstance(record, McapMessage):
                    message = _message(record, channels, keys)
                    if message is not None:
                        yield message
                else:
                    yield record
    except OSError as error:
        missing = isinstance(error, FileNotFoundError)
        why = "no such file" if missing else f"cannot be read: {error.strerror}"
        raise InputError(f"{path}: {why}") from None


def _message(
    record: McapMessage, channels: dict[int, Channel], keys: dict[int, Key | None]
) -> Message | None:
    where = keys.get(record.channel_id)
    if where is None:
        return None
    boot_id = channels[record.channel_id].metadata.get("boot_id", "0")
    return Message(
        where,
        record.data,
        int(boot_id) if boot_id.isdecimal() else 0,
        record.sequence,
        record.log_time,
        record.publish_time,
    )


def _our_key(path: Path, channel: Channel) -> Key | None:
    try:
        return parse_key(channel.topic)
    except ValueError:
        _log.warning("%s: topic %.80r is not ours and is left out", path, channel.topic)
        return None


def _records(
    file: BinaryIO, size: int
) -> Iterator[Channel | McapMessage | Metadata | Attachment | _Damage]:
    while True:
        offset = file.tell()
        header = file.read(_RECORD_HEADER.size)
        if len(header) < _RECORD_HEADER.size:
            yield _Damage(f"cut off at byte {offset} of {size}", truncated=True)
            return
        opcode, length = _RECORD_HEADER.unpack(header)
        if length > size - file.tell():
            yield _Damage(f"cut off at byte {offset} of {size}", truncated=True)
            return
        if opcode == Opcode.FOOTER:
            return
        body = file.read(length)
        try:
            yield from _parse(opcode, body)
        except _DAMAGE as error:
            yield _Damage(f"damaged record at byte {offset}: {error}", truncated=False)


def _parse(opcode: int, body: bytes) -> Iterator[Channel | McapMessage | Metadata | Attachment]:
    stream = ReadDataStream(io.BytesIO(body))
    match opcode:
        case Opcode.CHUNK:
            for record in breakup_chunk(Chunk.read(stream), validate_crc=True):
                if isinstance(record, (Channel, McapMessage)):
                    yield record
        case Opcode.CHANNEL:
            yield Channel.read(stream)
        case Opcode.MESSAGE:
            yield McapMessage.read(stream, len(body))
        case Opcode.METADATA:
            yield Metadata.read(stream)
        case Opcode.ATTACHMENT:
            yield Attachment.read(stream)


def program_version() -> str:
    """Return this program's version, as recordings and results carry it."""
    try:
        return metadata.version("driveby")
    except metadata.PackageNotFoundError:  # run from a checkout that was not installed
        return "0"


def _sync_folder(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
