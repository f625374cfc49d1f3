"""What is compared of each kind of file, and the one list of what is exempt.

Text stays text. Binary files with times of writing in them (MCAP, Parquet, Rerun, NPZ) are taken
apart with their own libraries, never with ours, into text of full precision.
"""

import hashlib
import json
import re
from collections import defaultdict
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple


class Exempt(NamedTuple):
    """A pattern in text whose match is not compared, what stands instead, and why."""

    pattern: str
    instead: str
    reason: str


EXEMPT = (
    Exempt(r'("version": ?)"[^"]*"', r'\1"*"', "the program's version"),
    Exempt(r"driveby \d+\.\d+\.\d+\S*", "driveby *", "the program's version"),
    Exempt(r'("(?:created|written)(?:_s)?": ?)[-+.e\d]+', r"\1*", "time of creation"),
    Exempt(r"(?m)^\d{4}-\d\d-\d\d \d\d:\d\d:\d\d,\d{3} ", "", "time of a line of the log"),
    Exempt(r"(?m)^\d+(\.\d+)? s$", "* s", "seconds that the command took"),
)
"""Exempt from the comparison, in any text."""

FIELDS = {
    "version": "the program's version",
    "created_ns": "time of creation",
}
"""Fields of protobuf messages that are exempt."""

RANDOM_NAMES = (Exempt(r"results-\d{8}T\d{6}Z", "results-TIME", "the worker's start"),)
"""Exempt in file names."""

NOT_COMPARED = (".log",)
"""Endings of files that are not compared: logs of services name times and addresses."""


_DRIVEN_NS = 1_767_225_600 * 10**9
"""When all drives of the comparison begin."""
_DAY_NS = 86_400 * 10**9


def readable(text: str) -> str:
    """Return text with everything exempt replaced.

    Also exempt is a time in nanoseconds that is not within a day of the drives: it is the moment
    at which a service or a command of the comparison ran, or a boot number made of it.
    """
    for pattern, instead, _ in EXEMPT:
        text = re.sub(pattern, instead, text)
    return re.sub(r"\b[12]\d{18}\b", _without_clock, text)


def _without_clock(found: re.Match[str]) -> str:
    return found[0] if abs(int(found[0]) - _DRIVEN_NS) < _DAY_NS else "TIME"


def canonical(path: Path) -> str | bytes:
    """Return what is compared of a file; text where a difference in it can be read."""
    read = _READERS.get(path.suffix)
    if read is not None:
        return readable("\n".join(read(path)) + "\n")
    content = path.read_bytes()
    try:
        return readable(content.decode())
    except UnicodeDecodeError:
        return content


def name_of(path: Path) -> str:
    """Return a file's name without what is random in it."""
    name = path.as_posix()
    for pattern, instead, _ in RANDOM_NAMES:
        name = re.sub(pattern, instead, name)
    return name


def _hash(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:16]


def _mcap(path: Path) -> Iterator[str]:
    """Describe channels, messages, attachments and metadata of a recording.

    A service's boot number and times of logging are its clock's. Messages of one key keep their
    order; those of different keys, and of different crossings, may be written in either order.
    """
    from mcap.reader import make_reader

    with path.open("rb") as file:
        reader = make_reader(file)
        summary = reader.get_summary()
        assert summary is not None
        decode = decoder([(s.name, s.data) for s in summary.schemas.values()])
        schemas = {number: schema.name for number, schema in summary.schemas.items()}
        for channel in summary.channels.values():
            schema = schemas.get(channel.schema_id)
            yield f"channel {channel.topic} {channel.message_encoding} {schema}"
        by_key: dict[str, list[str]] = defaultdict(list)
        for of_message, channel, message in reader.iter_messages(log_time_order=False):
            if "/service/" in f"/{channel.topic}":
                continue  # health and progress follow the clock
            text = decode(of_message.name, message.data) if of_message else message.data.hex()
            crossing = re.search(r'crossing_id: ("[^"]*")', text)
            key = f"{channel.topic} {crossing[1] if crossing else ''}"
            times = ""
            if "/vehicle/" in channel.topic:
                times = f" {message.sequence} {message.log_time} {message.publish_time}"
            by_key[key].append(f"message {channel.topic}{times}\n{text}")
        for key in sorted(by_key):
            yield from by_key[key]
        for attachment in reader.iter_attachments():
            yield f"attachment {attachment.name} {attachment.media_type} {_hash(attachment.data)}"
            if attachment.name.endswith((".json", ".toml")):
                yield attachment.data.decode()
        for metadata in reader.iter_metadata():
            yield f"metadata {metadata.name} {json.dumps(metadata.metadata, sort_keys=True)}"


def decoder(schemas: list[tuple[str, bytes]]) -> Callable[[str, bytes], str]:
    """Return a function that turns a protobuf payload into text, by descriptors from the file.

    The text ends with a hash of the payload: of its bytes as they are, or, where a field of it is
    exempt, of the message written again without that field.
    """
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory, text_format
    from google.protobuf.message import DecodeError

    pools = {}
    for name, data in schemas:
        pool = descriptor_pool.DescriptorPool()
        for one in descriptor_pb2.FileDescriptorSet.FromString(data).file:
            pool.Add(one)
        pools[name] = pool

    def text_of(name: str, payload: bytes) -> str:
        kind = message_factory.GetMessageClass(pools[name].FindMessageTypeByName(name))
        try:
            message = kind.FromString(payload)
        except DecodeError:
            return payload.hex()
        exempt = [field for field in FIELDS if field in kind.DESCRIPTOR.fields_by_name]
        for field in exempt:
            message.ClearField(field)
        content = message.SerializeToString(deterministic=True) if exempt else payload
        return f"{text_format.MessageToString(message)}hash {_hash(content)}"

    return text_of


def _engine(path: Path) -> Iterator[str]:
    """Decode the payloads of the engine's messages."""
    from google.protobuf import descriptor_pb2

    from schemas.proto import driveby_pb2

    proto = descriptor_pb2.FileDescriptorProto()
    driveby_pb2.DESCRIPTOR.CopyToProto(proto)
    data = descriptor_pb2.FileDescriptorSet(file=[proto]).SerializeToString()
    kinds = {"crossing": "Crossing", "estimate": "Estimate", "state": "BridgeState"}
    names = {kind: f"{proto.package}.{kind}" for kind in kinds.values()}
    decode = decoder([(name, data) for name in names.values()])
    for line in path.read_text().splitlines():
        one = json.loads(line)
        if "payload" in one:
            payload = bytes.fromhex(one.pop("payload"))
            kind = kinds.get(one["key"].rsplit("/", 1)[-1])
            one_text = payload.hex() if kind is None else decode(names[kind], payload)
            yield f"message {one['key']} after {one['after']}\n{one_text}"
        yield json.dumps(one, indent=1)


def _parquet(path: Path) -> Iterator[str]:
    """Describe schema, metadata and every row."""
    from pyarrow import parquet

    table = parquet.read_table(path)
    yield str(table.schema.remove_metadata())
    for key, value in sorted((table.schema.metadata or {}).items()):
        yield f"metadata {key.decode()} {value.decode(errors='replace')}"
    for row in table.to_pylist():
        for name, value in row.items():
            yield f"{name}: {_plain(value)}"


def _plain(value: Any) -> str:
    """Return a value as text, compressed bytes as what is in them."""
    if not isinstance(value, bytes):
        return repr(value)
    import zstandard

    try:
        return zstandard.ZstdDecompressor().decompressobj().decompress(value).decode()
    except (zstandard.ZstdError, UnicodeDecodeError):
        return value.hex()


def _npz(path: Path) -> Iterator[str]:
    """Describe every array and hash its bytes; a ZIP file stores when it was made."""
    import numpy as np

    with np.load(path) as arrays:
        for name in sorted(arrays):
            array = arrays[name]
            head = np.array2string(array.ravel()[:3]) if array.size else ""
            yield f"{name} {array.dtype} {array.shape} {_hash(array.tobytes())} {head}"


_OF_THE_WRITER = ("rerun.controls.RowId", "RecordingInfo:start_time", "log_time", "log_tick")
"""Exempt columns of Rerun chunks: random numbers of rows, and the clock of the writing program."""


def _rerun(path: Path) -> Iterator[str]:
    """Describe what is logged at each entity.

    Numbers of chunks are random and not described.
    """
    from rerun.chunk import RrdReader

    by_entity: dict[str, list[str]] = defaultdict(list)
    for chunk in RrdReader(path).stream():
        batch = chunk.to_record_batch()
        for name in batch.schema.names:
            if name in _OF_THE_WRITER:
                continue
            values = batch.column(name).to_pylist()
            content = json.dumps(values, default=_plain)
            described = f"{name} {len(values)} {_hash(content.encode())} {content[:200]}"
            by_entity[str(chunk.entity_path)].append(described)
    for entity in sorted(by_entity):
        yield f"entity {entity}"
        yield from sorted(by_entity[entity])


_READERS: dict[str, Callable[[Path], Iterator[str]]] = {
    ".mcap": _mcap,
    ".jsonl": _engine,
    ".parquet": _parquet,
    ".npz": _npz,
    ".rrd": _rerun,
}
