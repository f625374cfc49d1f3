"""Check of an AccelBatch without decoding it: the main computing cost of a logger of many trucks.

No I/O. As protobuf's own encoders write it, a batch is a header of five numbers. Then, for each
channel, follow bytes that are the same in every batch (tags, lengths, position, rate), the samples
and, for a channel without a position, its name. A payload that this form describes completely means
the same to protobuf. Any other payload goes through `decode_accel`, which knows every form and
reports the error.
"""

import re
import struct
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from google.protobuf.message import DecodeError

from schemas.proto import driveby_pb2 as pb
from schemas.signals import (
    ACCEL_NAMES,
    MAX_ACCELERATION_M_PER_S2,
    MAX_CHANNELS,
    Stamp,
    check_channel,
    check_header,
    decode_accel,
    stamp,
)
from schemas.topics import check_identifier

_VARINT = rb"[\x80-\xff]{0,9}[\x00-\x7f]"
_HEADER = re.compile(rb"\x08\x01" + b"".join(rb"\x%02x" % tag + _VARINT for tag in b"\x10\x18 ("))
"""Version 1, boot_id, sequence, device and wall time. A header with a zero has another form,
because a zero is not encoded."""
_BEFORE = re.compile(
    rb"\x32(%b)(\x08[\x00-\x7f])?\x11(.{8})\x1a(%b)" % (_VARINT, _VARINT), re.DOTALL
)
"""Tag and length of a channel, its position, its rate, tag and length of its samples."""
_SHORT, _LONG = 15, 17
"""Bytes before the samples of a channel, with lengths of one byte and of two."""
_POSITION, _NAME = b"\x08", b"\x22"
"""Tags; a position takes two bytes, which a channel with a name lacks."""
_RATE = struct.Struct("<d")
_FLOAT64 = np.dtype("<f8")


class _Channel(NamedTuple):
    """Content of the bytes before the samples of a channel."""

    name: str
    """Name of the channel's position; empty where the name follows the samples."""
    number: int
    """Number of samples; 0 if the bytes do not have the form or are invalid."""
    behind: int = 0
    """Number of bytes after the samples: tag, length and name."""


_NOTHING = _Channel("", 0)


def check_accel(payload: bytes) -> Stamp:
    """Return the times and identity of a batch; raise ValueError where `decode_accel` does."""
    return _stamp_if_usual(payload) or stamp(decode_accel(payload))


def _stamp_if_usual(payload: bytes) -> Stamp | None:
    """Return the stamp of a valid batch of the usual form, else None."""
    header = _HEADER.match(payload)
    if header is None:
        return None
    at, end = header.end(), len(payload)
    names = set()
    samples = []
    while at < end:
        is_short = payload[at + 1 : at + 2] < b"\x80"
        first = at + (_SHORT if is_short else _LONG)
        if not payload.startswith(_POSITION, at + (2 if is_short else 3)):
            first -= 2
        name, number, behind = _channel(payload[at:first])
        last = first + 8 * number
        at = last + behind
        if behind:
            name = _name(payload[last:at])
        if not number or not name or name in names or at > end:
            return None
        names.add(name)
        samples.append(payload[first:last])
    if not samples or len(names) > MAX_CHANNELS:
        return None
    every = np.frombuffer(b"".join(samples), _FLOAT64)
    # A product of arrays would release the interpreter's lock, which other threads would take.
    if not np.maximum.reduce(np.abs(every)) <= MAX_ACCELERATION_M_PER_S2:  # false for a NaN
        return None
    try:
        message = pb.AccelBatch.FromString(header[0])
        check_header(message)
    except (DecodeError, ValueError):
        return None
    return stamp(message)


@lru_cache(maxsize=10_000)  # a few values recur thousands of times a second
def _channel(before: bytes) -> _Channel:
    """Parse the bytes before the samples of a channel."""
    found = _BEFORE.fullmatch(before)
    if found is None:
        return _NOTHING
    channel_bytes, samples_bytes = _number(found[1]), _number(found[4])
    position = found[2] or b""
    name = ACCEL_NAMES.get(position[1]) if position else ""
    number, rest = divmod(samples_bytes, 8)
    behind = channel_bytes - (len(position) + 10 + len(found[4]) + samples_bytes)
    if name is None or rest or behind < 0 or bool(behind) == bool(name):
        return _NOTHING
    try:
        (rate_hz,) = _RATE.unpack(found[3])
        check_channel(name or "unnamed", rate_hz, number)
    except ValueError:
        return _NOTHING
    return _Channel(name, number, behind)


@lru_cache(maxsize=10_000)
def _name(behind: bytes) -> str:
    """Return the name after the samples of a channel; empty if it does not have the usual form."""
    if len(behind) < 3 or behind[:1] != _NAME or behind[1] != len(behind) - 2:
        return ""
    try:
        return check_identifier(behind[2:].decode())
    except ValueError:
        return ""


def _number(varint: bytes) -> int:
    return sum((byte & 0x7F) << 7 * place for place, byte in enumerate(varint))
