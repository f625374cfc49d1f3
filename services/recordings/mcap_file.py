"""Writer of MCAP files whose parts depend as little as possible on each other.

mcap's own writer puts a channel only into the first chunk that uses it: damage there makes the
messages of all later chunks unreadable. Here every chunk repeats the channels of its messages (150
bytes each before compression), and a chunk with its index is one write, so that a failed write
leaves the writer unchanged.
"""

import struct
import threading
import zlib
from collections.abc import Callable, Iterable, Mapping

import zstandard
from mcap.data_stream import RecordBuilder
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

_HEADER = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<BQHIQQ")
_MESSAGE_BYTES = _MESSAGE.size - _HEADER.size
_CHUNK = struct.Struct("<BQQQQII4sQ")
_INDEX = struct.Struct("<BQHI")
_ENTRY = struct.Struct("<QQ")
_FOOTER_SUMMARY = struct.Struct("<BQQQ")
_FOOTER_BYTES = 20
_INDEX_BLOCK_BYTES = 8192
_LEVEL = 2
"""Half the time of zstd's default 3, for files of the same size (quantised samples: 1 % more)."""
_THREAD = threading.local()


class McapWriter:
    """A writer of one MCAP file through `write`, which must write all bytes or raise OSError.

    After an OSError the writer is in the state before the call, and the caller must restore the
    file: truncate it to `offset` bytes.
    """

    def __init__(self, write: Callable[[bytes], object], *, library: str, chunk_bytes: int) -> None:
        self._write = write
        self._chunk_bytes = chunk_bytes
        self.offset = 0
        """Bytes written."""
        self.messages = 0
        self._schemas: list[Schema] = []
        self._channels: list[Channel] = []
        self._encoded_channels: list[bytes] = []
        self._written_schemas = 0
        self._channel_messages: dict[int, int] = {}
        self._times: tuple[int, int] | None = None
        self._chunks = 0
        self._chunk_index = _Compressed()  # an hour has 7200 entries
        self._attachments: list[AttachmentIndex] = []
        self._metadata: list[MetadataIndex] = []
        self._content: list[bytes] = []
        self._content_bytes = 0
        self._entries: dict[int, bytearray] = {}
        self._entry_times: tuple[int, int] = (0, 0)
        self._put(MCAP0_MAGIC + _encoded(Header("", library)))

    @property
    def pending(self) -> int:
        """The number of messages in the open chunk."""
        return sum(len(entries) for entries in self._entries.values()) // _ENTRY.size

    def add_schema(self, name: str, encoding: str, data: bytes) -> int:
        """Register a schema and return its id."""
        self._schemas.append(Schema(len(self._schemas) + 1, data, encoding, name))
        return len(self._schemas)

    def add_channel(
        self, topic: str, encoding: str, schema_id: int, metadata: Mapping[str, str]
    ) -> int:
        """Register a channel and return its id; raise ValueError if MCAP's ids are used up."""
        if len(self._channels) >= (1 << 16) - 1:
            raise ValueError(f"more than {(1 << 16) - 1} channels in one file")
        channel = Channel(len(self._channels) + 1, topic, encoding, dict(metadata), schema_id)
        self._channels.append(channel)
        self._encoded_channels.append(_encoded(channel))
        return channel.id

    def add_message(
        self, channel_id: int, sequence: int, log_time_ns: int, publish_time_ns: int, data: bytes
    ) -> None:
        """Add a message to the chunk; write the chunk when it is full."""
        entries = self._entries.get(channel_id)
        if entries is None:
            self._begin_channel(channel_id)
            entries = self._entries[channel_id] = bytearray()
            if len(self._entries) == 1:
                self._entry_times = (log_time_ns, log_time_ns)
        entries += _ENTRY.pack(log_time_ns, self._content_bytes)
        length = _MESSAGE_BYTES + len(data)
        self._add(
            _MESSAGE.pack(
                Opcode.MESSAGE, length, channel_id, sequence, log_time_ns, publish_time_ns
            )
        )
        self._add(data)
        first_ns, last_ns = self._entry_times
        self._entry_times = (min(first_ns, log_time_ns), max(last_ns, log_time_ns))
        if self._content_bytes >= self._chunk_bytes:
            self.flush()

    def flush(self) -> None:
        """Write the chunk with its index, if it holds a message."""
        if not self._entries:
            return
        content = b"".join(self._content)
        data = _compressed(content)
        first_ns, last_ns = self._entry_times
        length = _CHUNK.size - _HEADER.size + len(data)
        head = _CHUNK.pack(
            Opcode.CHUNK, length, first_ns, last_ns, len(content), zlib.crc32(content),
            4, b"zstd", len(data),
        )  # fmt: skip
        chunk_bytes = len(head) + len(data)
        index = bytearray()
        offsets = {}
        for channel_id, entries in self._entries.items():
            offsets[channel_id] = self.offset + chunk_bytes + len(index)
            index += _INDEX.pack(Opcode.MESSAGE_INDEX, 6 + len(entries), channel_id, len(entries))
            index += entries
        known = ChunkIndex(
            chunk_length=chunk_bytes,
            chunk_start_offset=self.offset,
            compression="zstd",
            compressed_size=len(data),
            message_end_time=last_ns,
            message_index_length=len(index),
            message_index_offsets=offsets,
            message_start_time=first_ns,
            uncompressed_size=len(content),
        )
        self._put(head + data + index)
        self._chunks += 1
        self._chunk_index.add(_encoded(known))
        for channel_id, entries in self._entries.items():
            number = len(entries) // _ENTRY.size
            before = self._channel_messages.get(channel_id, 0)
            self._channel_messages[channel_id] = before + number
            self.messages += number
        earliest_ns, latest_ns = self._times or (first_ns, last_ns)
        self._times = (min(earliest_ns, first_ns), max(latest_ns, last_ns))
        self._clear()

    def discard(self) -> int:
        """Discard the open chunk; return the number of its messages."""
        number = self.pending
        # A schema in it has not been written.
        self._written_schemas = 0
        self._clear()
        return number

    def add_metadata(self, name: str, metadata: Mapping[str, str]) -> None:
        """Write the chunk, then a metadata record."""
        self.flush()
        offset = self.offset
        encoded = _encoded(Metadata(name, dict(metadata)))
        self._put(encoded)
        self._metadata.append(MetadataIndex(offset, len(encoded), name))

    def add_attachment(
        self, name: str, media_type: str, data: bytes, *, log_time: int = 0, create_time: int = 0
    ) -> None:
        """Write the chunk, then an attachment."""
        self.flush()
        offset = self.offset
        encoded = _encoded(Attachment(create_time, log_time, name, media_type, data))
        self._put(encoded)
        index = AttachmentIndex(
            offset, len(encoded), log_time, create_time, len(data), name, media_type
        )
        self._attachments.append(index)

    def finish(self) -> None:
        """Write the chunk, the summary and the footer; nothing may be added afterwards."""
        self.flush()
        end = _encoded(DataEnd(0))
        start = self.offset + len(end)
        summary = bytearray()
        groups: list[SummaryOffset] = []
        for opcode, encoded in self._summary():
            if encoded:
                groups.append(SummaryOffset(opcode, start + len(summary), len(encoded)))
                summary += encoded
        offsets_at = start + len(summary)
        summary += _joined(groups)
        crc = zlib.crc32(
            _FOOTER_SUMMARY.pack(Opcode.FOOTER, _FOOTER_BYTES, start, offsets_at),
            zlib.crc32(summary),
        )
        footer = _encoded(Footer(start, offsets_at, crc))
        self._put(end + summary + footer + MCAP0_MAGIC)

    def _summary(self) -> tuple[tuple[int, bytes], ...]:
        first_ns, last_ns = self._times or (0, 0)
        statistics = Statistics(
            attachment_count=len(self._attachments),
            channel_count=len(self._channels),
            channel_message_counts=self._channel_messages,
            chunk_count=self._chunks,
            message_count=self.messages,
            message_end_time=last_ns,
            message_start_time=first_ns,
            metadata_count=len(self._metadata),
            schema_count=len(self._schemas),
        )
        return (
            (Opcode.SCHEMA, _joined(self._schemas)),
            (Opcode.CHANNEL, _joined(self._channels)),
            (Opcode.STATISTICS, _encoded(statistics)),
            (Opcode.CHUNK_INDEX, self._chunk_index.joined()),
            (Opcode.ATTACHMENT_INDEX, _joined(self._attachments)),
            (Opcode.METADATA_INDEX, _joined(self._metadata)),
        )

    def _begin_channel(self, channel_id: int) -> None:
        """Add the records that a channel needs to the chunk."""
        # Schemas stand before the channels that need them, and once: they are large, and a reader
        # of ours finds them in its own tables.
        for schema in self._schemas[self._written_schemas :]:
            self._add(_encoded(schema))
        self._written_schemas = len(self._schemas)
        self._add(self._encoded_channels[channel_id - 1])

    def _add(self, data: bytes) -> None:
        self._content.append(data)
        self._content_bytes += len(data)

    def _put(self, data: bytes) -> None:
        self._write(data)
        self.offset += len(data)

    def _clear(self) -> None:
        self._content.clear()
        self._content_bytes = 0
        self._entries.clear()


class _Compressed:
    """Bytes that are needed only at the end, compressed until then."""

    def __init__(self) -> None:
        self._blocks: list[bytes] = []
        self._last = bytearray()

    def add(self, data: bytes) -> None:
        self._last += data
        if len(self._last) >= _INDEX_BLOCK_BYTES:
            # A copy: zstandard's own bytes keep their reserved memory.
            self._blocks.append(bytes(memoryview(_compressed(self._last))))
            self._last.clear()

    def joined(self) -> bytes:
        return b"".join([*map(zstandard.decompress, self._blocks), self._last])


def _compressed(data: bytes | bytearray) -> bytes:
    # One per thread and not per file, because creating one takes as long as using it.
    compressor: zstandard.ZstdCompressor | None = getattr(_THREAD, "compressor", None)
    if compressor is None:
        compressor = _THREAD.compressor = zstandard.ZstdCompressor(level=_LEVEL)
    return compressor.compress(data)


def _joined(records: Iterable[McapRecord]) -> bytes:
    return b"".join(map(_encoded, records))


def _encoded(record: McapRecord) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    data: bytes = builder.end()  # type: ignore[no-untyped-call]
    return data
