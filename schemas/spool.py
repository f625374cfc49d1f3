"""The query for messages in a truck's spool. No I/O.

The key is that of the data followed by `/spool`. Without parameters a truck replies with its
contents, one `SpoolContents` for each stream; `*` may replace vehicle and stream. With

    boot=BOOT;from=FIRST;to=LAST

it replies with messages, whose payload and attachment are those that were published. The last reply
has no attachment: a `SpoolPage` with the sequence to continue from, if there is more. An answer
without it is incomplete.
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
"""Largest size of one answer; a larger single message is sent alone."""
MAX_RANGES = 10_000
"""Largest number of ranges in one answer; each gap is a restart or a disk error."""
_DIGITS = re.compile(r"[0-9]{1,20}")

Range = tuple[int, int]
"""First and last sequence, both included."""


class SpoolBoot(NamedTuple):
    """The contents of a spool for one stream and boot."""

    boot_id: int
    next_sequence: int
    """Sequence of the next message; every message sent so far has a lower one."""
    held: list[Range]
    """Ranges on the truck's disk now, ascending."""
    durable: int
    """Last sequence of the messages that a logger confirmed without gap; -1: none."""
    dropped: int
    """Number of messages dropped for space before a logger had them."""


class SpoolQuery(NamedTuple):
    """A range of messages of one stream and boot."""

    boot_id: int
    first: int
    last: int

    def parameters(self) -> str:
        """Return the text after the question mark."""
        return f"boot={self.boot_id};from={self.first};to={self.last}"


def spool_selector(realm: str | None, vehicle: str | None = None) -> str:
    """Return the key expression of the spools of all streams of a vehicle, or of all vehicles.

    `realm` may be a pattern as in `check_realms`; None is any realm.
    """
    return f"{PREFIX}/{realm_chunk(realm)}/vehicle/{vehicle or '*'}/*{SUFFIX}"


def spool_key(where: Key) -> str:
    """Return the key of the spool of a stream."""
    return key(*where) + SUFFIX


def parse_spool_key(text: str) -> Key:
    """Return the key of the stream whose spool a key names; raise ValueError for other keys."""
    if not text.endswith(SUFFIX):
        raise ValueError(f"key {text[:100]!r} does not end in {SUFFIX}")
    where = parse_key(text.removesuffix(SUFFIX))
    if where.owner != "vehicle":
        raise ValueError(f"key {text[:100]!r}: only vehicles have a spool")
    return where


def parse_query(parameters: Mapping[str, str]) -> SpoolQuery | None:
    """Return the requested range, None for the contents; raise ValueError if it is malformed."""
    if not parameters:
        return None
    wanted = []
    for name, highest in (("boot", MAX_BOOT_ID), ("from", MAX_SEQUENCE), ("to", MAX_SEQUENCE)):
        text = parameters.get(name, "")
        if not _DIGITS.fullmatch(text) or int(text) > highest:
            raise ValueError(f"spool query: {name}={text[:40]!r}, 0 to {highest} is expected")
        wanted.append(int(text))
    return SpoolQuery(*wanted)


def encode_contents(time_ns: int, boots: list[SpoolBoot]) -> bytes:
    """Return the SpoolContents message, with the newest `MAX_RANGES` ranges at most."""
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


def decode_contents(payload: bytes) -> list[SpoolBoot]:
    """Return the contents of a spool, oldest boot first; raise ValueError if malformed."""
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
        contents.append(SpoolBoot(boot.boot_id, boot.next_sequence, ranges, durable, boot.dropped))
    return sorted(contents)


def encode_page(query: SpoolQuery, next_sequence: int | None) -> bytes:
    """Return the SpoolPage message."""
    return pb.SpoolPage(
        schema_version=SCHEMA_VERSION,
        boot_id=query.boot_id,
        first=query.first,
        last=query.last,
        next=next_sequence,
    ).SerializeToString(deterministic=True)


def decode_page(payload: bytes, query: SpoolQuery) -> int | None:
    """Return the next sequence to request, None at the end; raise ValueError for a wrong page."""
    try:
        message = pb.SpoolPage.FromString(payload)
    except DecodeError as error:
        raise ValueError(f"not a driveby.v1.SpoolPage: {error}") from None
    check_version(message.schema_version)
    if SpoolQuery(message.boot_id, message.first, message.last) != query:
        raise ValueError("spool page: answers another query")
    if not message.HasField("next"):
        return None
    if not query.first < message.next <= query.last:
        raise ValueError(f"spool page: next {message.next} is out of range")
    return message.next
