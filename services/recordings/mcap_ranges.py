"""Reader of parts of a closed recording by its index: the summary first, then single chunks.

For remote files, or small parts of one. Works on anything that can seek and read. Files without an
intact index are refused; `mcap_scan` reads them from the beginning.
"""

import io
import struct
import zlib
from collections.abc import Collection, Iterator
from typing import BinaryIO, NamedTuple

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, ChunkIndex, MetadataIndex
from mcap.writer import MCAP0_MAGIC

from services.recordings.mcap_scan import MAX_RECORD_BYTES, RawMessage, chunk_items

_HEADER = struct.Struct("<BQ")
_FOOTER = struct.Struct("<BQQQI")
_TAIL_BYTES = _FOOTER.size + len(MCAP0_MAGIC)


class ChunkIndexes(NamedTuple):
    """The summary of a recording."""

    chunks: tuple[ChunkIndex, ...]
    """Indexes in the order of the file."""
    channels: dict[int, Channel]
    metadata: tuple[str, ...]
    """Names of its metadata records."""


def read_index(file: BinaryIO, size: int) -> ChunkIndexes | None:
    """Return the summary of a recording of `size` bytes; None without an intact one."""
    if size < _TAIL_BYTES + len(MCAP0_MAGIC):
        return None
    file.seek(size - _TAIL_BYTES)
    tail = file.read(_TAIL_BYTES)
    if len(tail) != _TAIL_BYTES or not tail.endswith(MCAP0_MAGIC):
        return None
    opcode, _, start, _, crc = _FOOTER.unpack_from(tail)
    end = size - _TAIL_BYTES
    if opcode != Opcode.FOOTER or not 0 < start <= end or end - start > MAX_RECORD_BYTES:
        return None
    file.seek(start)
    summary = file.read(end - start)
    if crc and zlib.crc32(tail[: _FOOTER.size - 4], zlib.crc32(summary)) != crc:
        return None
    try:
        return _parsed(summary)
    except (McapError, struct.error, UnicodeDecodeError, ValueError, EOFError):
        return None


def chunk_messages(
    file: BinaryIO, chunk: ChunkIndex, channels: Collection[int]
) -> Iterator[RawMessage]:
    """Yield the messages of some channels in a chunk; raise ValueError if it is damaged."""
    if not 0 < chunk.chunk_length <= MAX_RECORD_BYTES:
        raise ValueError(f"chunk at byte {chunk.chunk_start_offset} has an impossible length")
    file.seek(chunk.chunk_start_offset)
    items = chunk_items(file.read(chunk.chunk_length))
    if items is None:
        raise ValueError(f"damaged chunk at byte {chunk.chunk_start_offset}")
    for item in items:
        if isinstance(item, RawMessage) and item.channel_id in channels:
            yield item


def _parsed(summary: bytes) -> ChunkIndexes:
    chunks: list[ChunkIndex] = []
    channels: dict[int, Channel] = {}
    metadata: list[str] = []
    at = 0
    while at + _HEADER.size <= len(summary):
        opcode, length = _HEADER.unpack_from(summary, at)
        begin = at + _HEADER.size
        at = begin + length
        if at > len(summary):
            raise ValueError("a record is longer than the summary")
        data = ReadDataStream(io.BytesIO(summary[begin:at]))
        if opcode == Opcode.CHUNK_INDEX:
            chunks.append(ChunkIndex.read(data))
        elif opcode == Opcode.CHANNEL:
            channel = Channel.read(data)
            channels[channel.id] = channel
        elif opcode == Opcode.METADATA_INDEX:
            metadata.append(MetadataIndex.read(data).name)
    chunks.sort(key=lambda chunk: chunk.chunk_start_offset)
    return ChunkIndexes(tuple(chunks), channels, tuple(metadata))
