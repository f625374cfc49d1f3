"""The query by which a truck gives again what it has on its own disk. No I/O.

The key is that of the data with `/spool` behind it. Without parameters a truck answers with what it
has, one `SpoolContents` for each stream; `*` may stand for vehicle and stream. With

    boot=BOOT;from=FIRST;to=LAST

it answers with messages: payload and attachment are those of the message as it was published. The
last reply has no attachment: a `SpoolPage`, which says from where to ask again if there is more. An
answer without it was cut off.
"""

import re
from collections.abc import Mapping
from typing import NamedTuple

from google.protobuf.message import DecodeError

from schemas.proto import driveby_pb2 as pb
from schemas.signals import MAX_BOOT_ID, MAX_SEQUENCE, SCHEMA_VERSION, check_version
from schemas.topics import PREFIX, Key, key, parse_key, realm_chunk

SUFFIX = "/spool"
PAGE_MESSAGES = 1000
PAGE_BYTES = 1 << 20
"""What one answer holds at most; a single message that is larger is given alone."""
MAX_RANGES = 10_000
"""More holes than that in what a truck holds are not told; each is a restart or a disk error."""
_DIGITS = re.compile(r"[0-9]{1,20}")

Range = tuple[int, int]
"""First and last sequence, both included."""


class Held(NamedTuple):
    """What a spool has of one stream and boot."""

    boot_id: int
    next_sequence: int
    """All that was sent so far has a lower one."""
    held: list[Range]
    """On the truck's disk now, ascending."""
    durable: int
    """A logger confirmed everything up to here; -1: nothing."""
    dropped: int
    """Messages given up for room before a logger had them."""


class Query(NamedTuple):
    """A part of one stream and boot."""

    boot_id: int
    first: int
    last: int

    def parameters(self) -> str:
        """Return the text behind the question mark."""
        return f"boot={self.boot_id};from={self.first};to={self.last}"


def spool_selector(realm: str | None, vehicle: str | None = None, stream: str | None = None) -> str:
    """Return the key expression of spools: of all realms, vehicles or streams where not given.

    `realm` may be a pattern as of `check_realms`.
    """
    return f"{PREFIX}/{realm_chunk(realm)}/vehicle/{vehicle or '*'}/{stream or '*'}{SUFFIX}"


def spool_key(where: Key) -> str:
    """Return the key of the spool of a stream."""
    return key(*where) + SUFFIX


def parse_spool_key(text: str) -> Key:
    """Return the key of the stream whose spool it is; ValueError if it is not one."""
    if not text.endswith(SUFFIX):
        raise ValueError(f"key {text[:100]!r} does not end in {SUFFIX}")
    where = parse_key(text.removesuffix(SUFFIX))
    if where.owner != "vehicle":
        raise ValueError(f"key {text[:100]!r}: only vehicles have a spool")
    return where


def parse_query(parameters: Mapping[str, str]) -> Query | None:
    """Return what is asked for, None if the contents are; ValueError if it cannot be read."""
    if not parameters:
        return None
    wanted = []
    for name, highest in (("boot", MAX_BOOT_ID), ("from", MAX_SEQUENCE), ("to", MAX_SEQUENCE)):
        text = parameters.get(name, "")
        if not _DIGITS.fullmatch(text) or int(text) > highest:
            raise ValueError(f"spool query: {name}={text[:40]!r}, 0 to {highest} is expected")
        wanted.append(int(text))
    return Query(*wanted)


def encode_contents(time_ns: int, boots: list[Held]) -> bytes:
    """Return the SpoolContents message; of more than `MAX_RANGES` ranges the newest."""
    message = pb.SpoolContents(schema_version=SCHEMA_VERSION, time_ns=time_ns)
    left = MAX_RANGES
    for boot in reversed(boots):
        one = message.boots.add(
            boot_id=boot.boot_id,
            next_sequence=boot.next_sequence,
            durable=boot.durable if boot.durable >= 0 else None,
            dropped=boot.dropped,
        )
        for first, last in boot.held[-left:] if left else []:
            one.held.add(first=first, last=last)
        left = max(0, left - len(boot.held))
    return message.SerializeToString(deterministic=True)


def decode_contents(payload: bytes) -> list[Held]:
    """Return what a spool has, oldest boot first; ValueError with one line if malformed."""
    try:
        message = pb.SpoolContents.FromString(payload)
    except DecodeError as error:
        raise ValueError(f"not a driveby.v1.SpoolContents: {error}") from None
    check_version(message.schema_version)
    if len(message.boots) + sum(len(boot.held) for boot in message.boots) > 2 * MAX_RANGES:
        raise ValueError(f"spool contents of more than {2 * MAX_RANGES} ranges")
    contents = []
    for boot in message.boots:
        ranges = [(one.first, one.last) for one in boot.held]
        before = -1
        for first, last in ranges:
            if not before < first <= last < boot.next_sequence:
                raise ValueError(f"spool contents: range {first} to {last} out of place")
            before = last
        durable = boot.durable if boot.HasField("durable") else -1
        if boot.next_sequence > MAX_SEQUENCE + 1 or durable >= max(1, boot.next_sequence):
            raise ValueError(f"spool contents: sequence {boot.next_sequence} or {durable} too high")
        contents.append(Held(boot.boot_id, boot.next_sequence, ranges, durable, boot.dropped))
    return sorted(contents)


def encode_page(query: Query, next_sequence: int | None) -> bytes:
    """Return the SpoolPage message."""
    return pb.SpoolPage(
        schema_version=SCHEMA_VERSION,
        boot_id=query.boot_id,
        first=query.first,
        last=query.last,
        next=next_sequence,
    ).SerializeToString(deterministic=True)


def decode_page(payload: bytes, query: Query) -> int | None:
    """Return where the rest begins (None: no more); ValueError if it is no answer to the query."""
    try:
        message = pb.SpoolPage.FromString(payload)
    except DecodeError as error:
        raise ValueError(f"not a driveby.v1.SpoolPage: {error}") from None
    check_version(message.schema_version)
    if Query(message.boot_id, message.first, message.last) != query:
        raise ValueError("spool page: answers another query")
    if not message.HasField("next"):
        return None
    if not query.first < message.next <= query.last:
        raise ValueError(f"spool page: next {message.next} is out of range")
    return message.next
