"""Reader of MCAP files that may be damaged anywhere: every record is verified.

mcap's own readers need an intact index, or raise in the middle of a record that is cut off or
changed. Here a record is valid only if it is consistent: the lengths inside it agree with its own,
encoding it again gives the same bytes, the checksum of a chunk or attachment is right. After an
invalid record the search continues byte by byte for the next valid one. A chunk is also found when
its opcode, a length or its compression's name is damaged, because its checksum verifies the bytes.

Memory is bounded whatever the lengths in the file: by `MAX_RECORD_BYTES` for a record and for a
decompressed chunk.
"""

import io
import os
import re
import struct
import zlib
from collections.abc import Callable, Iterator
from functools import partial
from typing import BinaryIO, NamedTuple

import zstandard
from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from mcap.writer import MCAP0_MAGIC

from services.common.errors import InputError

MAX_RECORD_BYTES = 64 << 20
"""Largest valid record or decompressed chunk, a thousand times as large as ours."""

_SURE_BYTES = 64 << 20
_LARGEST_RATIO = 1000
"""Largest ratio of all decompressed chunks to the file, beyond the first chunk. Constant signals in
chunks of 64 KiB reach a tenth of it; more is a decompression bomb."""
_MAX_OTHERS = 200_000
"""Largest number of records other than messages in a chunk; MCAP has 65,536 channels and schemas.
"""

_HEADER = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<HIQQ")
_CHUNK = struct.Struct("<QQQI")
_LENGTH = struct.Struct("<Q")
_INDEX = struct.Struct("<HI")
_INDEX_ENTRY_BYTES = 16
_ZSTD = b"\x04\x00\x00\x00zstd"
_ZSTD_AT = _HEADER.size + _CHUNK.size
_FRAME = b"\x28\xb5\x2f\xfd"
_FRAME_AT = _ZSTD_AT + len(_ZSTD) + _LENGTH.size
_LZ4 = b"\x03\x00\x00\x00lz4"
_LZ4_FRAME = b"\x04\x22\x4d\x18"
_LZ4_BYTES = _ZSTD_AT + len(_LZ4) + _LENGTH.size + len(_LZ4_FRAME)
"""Length from the beginning of a chunk to the end of the magic number of an lz4 frame."""
# A record's header with a length below 2**40, or what marks a chunk whose header is damaged.
_CANDIDATE = re.compile(
    rb"(?=(?:([\x01-\x0f].{5}\x00{3})|(%b)|(%b)))" % (re.escape(_ZSTD), re.escape(_FRAME)), re.S
)
_CANDIDATE_BYTES = 9
_WINDOW_BYTES = 1 << 20
_ZEROS = bytes(_WINDOW_BYTES)
_READABLE: dict[int, type[McapRecord]] = {
    Opcode.HEADER: Header,
    Opcode.SCHEMA: Schema,
    Opcode.CHANNEL: Channel,
    Opcode.METADATA: Metadata,
    Opcode.ATTACHMENT: Attachment,
    Opcode.DATA_END: DataEnd,
    Opcode.FOOTER: Footer,
    Opcode.STATISTICS: Statistics,
    Opcode.CHUNK_INDEX: ChunkIndex,
    Opcode.ATTACHMENT_INDEX: AttachmentIndex,
    Opcode.METADATA_INDEX: MetadataIndex,
    Opcode.SUMMARY_OFFSET: SummaryOffset,
}
_UNREADABLE = (McapError, struct.error, UnicodeDecodeError, ValueError, EOFError)


class RawMessage(NamedTuple):
    """A message as MCAP stores it."""

    channel_id: int
    sequence: int
    log_time_ns: int
    publish_time_ns: int
    data: bytes


class ChannelCount(NamedTuple):
    """Number of messages of a channel in the previous chunk, according to its index."""

    channel_id: int
    messages: int


class Damage(NamedTuple):
    """Bytes of the file outside every valid record."""

    offset: int
    size: int
    text: str
    is_chunk: bool
    """Whether a chunk is in its place but its content is damaged."""
    is_cut_off: bool
    """Whether the file ends here."""


Item = (
    Schema | Channel | RawMessage | ChannelCount | Attachment | Metadata | DataEnd | Footer | Damage
)


def scan(file: BinaryIO, start: int = 0) -> Iterator[Item]:
    """Yield the valid records of a file in order, and the damage between; `start` is at a record.

    Of the summary only schemas, channels and the footer are yielded. A file without a footer ends
    with a `Damage` that is cut off, of size 0 if no record was torn; so does one whose chunks
    decompress to more than any recording's. Raise OSError if reading fails, InputError for an
    unsupported compression.
    """
    size = os.fstat(file.fileno()).st_size
    at = start or len(MCAP0_MAGIC)
    if not start and _read(file, 0, at) != MCAP0_MAGIC:
        at = 0
    is_whole = is_chunked = False
    left = _SURE_BYTES + _LARGEST_RATIO * size
    while at < size:
        if size - at == len(MCAP0_MAGIC) and _read(file, at, len(MCAP0_MAGIC)) == MCAP0_MAGIC:
            break
        record = _record_at(file, at, size, is_chunked=is_chunked)
        if record is None:
            begin = _next_record(file, at, size)
            yield from _torn_messages(file, at, size) if begin == size else ()
            if begin > at:
                cut = begin == size
                text = f"cut off at byte {at} of {size}" if cut else f"damaged at byte {at}"
                yield Damage(at, begin - at, text, is_chunk=False, is_cut_off=cut)
            if begin == size:
                return
            at = begin
            record = _strong_record_at(file, at, size)
            if record is None:  # it was valid a moment ago: another process writes to the file
                return
        left -= record.unpacked_bytes
        if left < 0:
            text = f"decompresses to more than any recording, from byte {at} of {size} on"
            yield Damage(at, size - at, text, is_chunk=False, is_cut_off=True)
            return
        is_chunked = is_chunked or record.is_chunk
        for item in record.items():
            is_whole = is_whole or isinstance(item, Footer)
            yield item
        at = record.end
    if not is_whole:
        text = f"cut off at byte {at} of {size}"
        yield Damage(at, 0, text, is_chunk=False, is_cut_off=True)


def chunk_items(data: bytes) -> Iterator[Item] | None:
    """Yield the content of a chunk's record; None if it is inconsistent."""
    chunk = _chunk_at(io.BytesIO(data), 0, len(data), len(data))
    return None if chunk is None else chunk.items()


def last_metadata(file: BinaryIO, name: str) -> tuple[Metadata, int] | None:
    """Return the last metadata record of a name and its end, reading from the file's end."""
    encoded = name.encode()
    mark = len(encoded).to_bytes(4, "little") + encoded
    size = os.fstat(file.fileno()).st_size
    end = size
    while end > 0:
        begin = max(0, end - _WINDOW_BYTES)
        window = _read(file, begin, end - begin + len(mark))
        found = -1 if window.startswith(_ZEROS) else window.rfind(mark)
        while found >= 0:
            record = _strong_record_at(file, max(0, begin + found - _HEADER.size), size)
            item = next(record.items(), None) if record is not None else None
            if record is not None and isinstance(item, Metadata) and item.name == name:
                return item, record.end
            found = window.rfind(mark, 0, found)
        end = begin
    return None


class _McapRecord(NamedTuple):
    end: int
    items: Callable[[], Iterator[Item]]
    is_chunk: bool = False
    unpacked_bytes: int = 0
    """Declared decompressed size of a chunk."""


def _record_at(file: BinaryIO, at: int, size: int, *, is_chunked: bool) -> _McapRecord | None:
    """Return the record at the end of the previous one; None if it is invalid."""
    record = _strong_record_at(file, at, size)
    if record is not None:
        return record
    opcode, length = _header_at(file, at, size) or (0, 0)
    end = at + _HEADER.size + length
    if opcode == Opcode.CHUNK and _is_lz4(_read(file, at, _LZ4_BYTES)):
        # None of ours is, and finding such a chunk among damage would require a second search.
        raise InputError(
            f"{file.name}: is compressed with lz4, which is not read; compress it with zstd, as "
            "`mcap compress` does"
        )
    if opcode not in (Opcode.CHUNK, Opcode.MESSAGE) or not _is_followed(file, end, size):
        return None
    if opcode == Opcode.CHUNK:
        # Only its content is wrong: its length is that of the record.
        text = f"damaged chunk at byte {at}"
        return _found(end, Damage(at, end - at, text, is_chunk=True, is_cut_off=False))
    # Nothing shows whether a message outside chunks is one. Where there are chunks it is none:
    # one bit makes an index a message.
    if is_chunked or length < _MESSAGE.size:
        return None
    return _found(end, _raw_message(_read(file, at + _HEADER.size, length), 0, length))


def _is_lz4(head: bytes) -> bool:
    """Return whether this is the beginning of a chunk compressed with lz4."""
    name, frame = _ZSTD_AT, _ZSTD_AT + len(_LZ4) + _LENGTH.size
    return head[name : name + len(_LZ4)] == _LZ4 and head[frame:] == _LZ4_FRAME


def _strong_record_at(file: BinaryIO, at: int, size: int) -> _McapRecord | None:
    """Return the record at a byte, if its own content proves that there is one."""
    opcode, length = _header_at(file, at, size) or (0, 0)
    outer_end = at + _HEADER.size + length if opcode else None
    chunk = _chunk_at(file, at, size, outer_end)
    if chunk is not None or outer_end is None:
        return chunk
    return _plain_record_at(file, at, opcode, length)


def _header_at(file: BinaryIO, at: int, size: int) -> tuple[int, int] | None:
    """Return opcode and length at a byte; None if that record would be too long."""
    header = _read(file, at, _HEADER.size)
    if len(header) < _HEADER.size:
        return None
    opcode, length = _HEADER.unpack(header)
    if length > min(MAX_RECORD_BYTES, size - at - _HEADER.size):
        return None
    return opcode, length


def _plain_record_at(file: BinaryIO, at: int, opcode: int, length: int) -> _McapRecord | None:
    end = at + _HEADER.size + length
    if opcode == Opcode.MESSAGE_INDEX:
        head = _read(file, at + _HEADER.size, _INDEX.size)
        if len(head) < _INDEX.size:
            return None
        channel_id, array_bytes = _INDEX.unpack(head)
        entries, rest = divmod(array_bytes, _INDEX_ENTRY_BYTES)
        if rest or array_bytes != length - _INDEX.size:
            return None
        return _found(end, ChannelCount(channel_id, entries))
    kind = _READABLE.get(opcode)
    if kind is None:
        return None
    body = _read(file, at + _HEADER.size, length)
    try:
        record = kind.read(ReadDataStream(io.BytesIO(body)))  # type: ignore[attr-defined]
        again = RecordBuilder()
        record.write(again)
        encoded: bytes = again.end()  # type: ignore[no-untyped-call]
        if encoded[_HEADER.size :] != body:
            return None
    except _UNREADABLE:
        return None
    if isinstance(record, Footer) and max(record.summary_start, record.summary_offset_start) > at:
        return None  # any 20 bytes make a footer; a true one follows its summary
    wanted = (Schema, Channel, Attachment, Metadata, DataEnd, Footer)
    return _found(end, *([record] if isinstance(record, wanted) else []))


def _found(end: int, *items: Item) -> _McapRecord:
    return _McapRecord(end, lambda: iter(items))


def _is_followed(file: BinaryIO, at: int, size: int) -> bool:
    """Return whether the end of the file or a plausible record is at a byte."""
    header = _read(file, at, _HEADER.size)
    if len(header) < _HEADER.size:
        return at == size
    opcode, length = _HEADER.unpack(header)
    known = opcode in _READABLE or opcode in (Opcode.CHUNK, Opcode.MESSAGE, Opcode.MESSAGE_INDEX)
    return known and length <= size - at - _HEADER.size


def _chunk_at(file: BinaryIO, at: int, size: int, outer_end: int | None) -> _McapRecord | None:
    """Return the chunk whose record begins at a byte, if its checksum is right.

    Both the record's length and the length of the compressed data define its end, and either may be
    damaged, as may its opcode and the name of the compression.
    """
    head = _read(file, at, _FRAME_AT + len(_FRAME))
    if len(head) < _FRAME_AT:
        return None
    crc = _CHUNK.unpack_from(head, _HEADER.size)[3]
    name_bytes = int.from_bytes(head[_ZSTD_AT : _ZSTD_AT + 4], "little")
    attempts: list[tuple[bool, int, int]] = []
    if head[0] == Opcode.CHUNK and name_bytes == 0:
        begin = at + _ZSTD_AT + 4 + _LENGTH.size
        attempts.append((False, begin, begin + _LENGTH.unpack_from(head, _ZSTD_AT + 4)[0]))
    # Also where the length of the compression's name is damaged to zero.
    if head[_FRAME_AT:] == _FRAME or head[_ZSTD_AT : _ZSTD_AT + len(_ZSTD)] == _ZSTD:
        begin = at + _FRAME_AT
        inner_end = begin + _LENGTH.unpack_from(head, _FRAME_AT - _LENGTH.size)[0]
        # The shorter first: compressed data mark their own end, so that too many bytes
        # decompress as well as the right ones.
        ends = sorted({end for end in (inner_end, outer_end) if end is not None})
        attempts += [(True, begin, end) for end in ends]
    for is_compressed, begin, end in attempts:
        if not begin <= end <= size or end - begin > MAX_RECORD_BYTES:
            continue
        data = _read(file, begin, end - begin)
        content = _decompressed(data) if is_compressed else data
        if content is not None and _holds(content, crc, is_certain=end == outer_end):
            records = partial(_records_of, content, at)
            return _McapRecord(end, records, is_chunk=True, unpacked_bytes=len(content))
    return None


def _decompressed(data: bytes) -> bytes | None:
    try:
        # Reading one byte too many detects a bomb without decompressing it.
        with zstandard.ZstdDecompressor().stream_reader(data) as reader:
            content: bytes = reader.read(MAX_RECORD_BYTES + 1)
    except (zstandard.ZstdError, MemoryError):
        return None
    return content if len(content) <= MAX_RECORD_BYTES else None


def _holds(content: bytes, crc: int, *, is_certain: bool) -> bool:
    if crc:
        return zlib.crc32(content) == crc
    at = 0  # a writer may leave the checksum out
    while is_certain and at < len(content):
        if len(content) - at < _HEADER.size:
            return False
        at += _HEADER.size + _HEADER.unpack_from(content, at)[1]
    return is_certain and at == len(content)


def _records_of(content: bytes, offset: int) -> Iterator[Item]:
    """Yield the content of the chunk at a byte of the file as far as it is valid."""
    at = others = 0
    while at + _HEADER.size <= len(content):
        opcode, length = _HEADER.unpack_from(content, at)
        others += opcode != Opcode.MESSAGE
        if opcode == 0 or others > _MAX_OTHERS:  # no record has the opcode 0
            text = f"damaged chunk at byte {offset}: no more messages {at} bytes into it"
            yield Damage(offset, 0, text, is_chunk=True, is_cut_off=False)
            return
        begin = at + _HEADER.size
        at = begin + length
        if at > len(content):
            return
        if opcode == Opcode.MESSAGE:
            if length >= _MESSAGE.size:
                yield _raw_message(content, begin, at)
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            kind = Schema if opcode == Opcode.SCHEMA else Channel
            try:
                yield kind.read(ReadDataStream(io.BytesIO(content[begin:at])))
            except _UNREADABLE:
                continue


def _raw_message(content: bytes, begin: int, end: int) -> RawMessage:
    channel_id, sequence, log_time_ns, publish_time_ns = _MESSAGE.unpack_from(content, begin)
    data = content[begin + _MESSAGE.size : end]
    return RawMessage(channel_id, sequence, log_time_ns, publish_time_ns, data)


def _torn_messages(file: BinaryIO, at: int, size: int) -> Iterator[Item]:
    """Yield the readable messages of a chunk that the end of the file cuts off.

    zstd restores whole blocks only, of 128 KiB before compression: nothing of our own chunks.
    """
    head = _read(file, at, _FRAME_AT)
    compressed = head[_ZSTD_AT : _ZSTD_AT + len(_ZSTD)] == _ZSTD
    if len(head) < _FRAME_AT or head[0] != Opcode.CHUNK or not compressed:
        return
    length = _HEADER.unpack_from(head)[1]
    if at + _HEADER.size + length <= size or length > MAX_RECORD_BYTES:
        return  # damaged, not torn: the output is arbitrary
    content = bytearray()
    data = _read(file, at + _FRAME_AT, size - at - _FRAME_AT)
    try:
        with zstandard.ZstdDecompressor().stream_reader(data) as reader:
            while len(content) < MAX_RECORD_BYTES and (piece := reader.read(1 << 16)):
                content += piece
    except zstandard.ZstdError:
        pass
    yield from _records_of(bytes(content), at)


def _next_record(file: BinaryIO, at: int, size: int) -> int:
    """Return the place of the next valid record, at a byte or after it; `size` if none."""
    begin = at
    while begin < size:
        window = _read(file, begin, _WINDOW_BYTES)
        # Space that was reserved and not written is no candidate; skip it at the speed of memory.
        for match in () if window == _ZEROS else _CANDIDATE.finditer(window):
            behind = (0, _ZSTD_AT, _FRAME_AT)[(match.lastindex or 1) - 1]
            start = begin + match.start() - behind
            if start >= at and _strong_record_at(file, start, size) is not None:
                return start
        if len(window) <= _CANDIDATE_BYTES:
            break
        begin += len(window) - _CANDIDATE_BYTES + 1
    return size


def _read(file: BinaryIO, at: int, length: int) -> bytes:
    file.seek(at)
    return file.read(length)
