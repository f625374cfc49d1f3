"""Zenoh keys and attachments of ROS 2 (rmw_zenoh_cpp).

A key is `<domain>/<topic>/<type>/<hash of the type>`, the topic without its leading slash, e.g.
`0/imu/data/sensor_msgs::msg::dds_::Imu_/RIHS01_7d9a…`. An attachment is a sequence number and the
time of sending (ns since 1970), both int64, little-endian, and an array of bytes, preceded by its
length, that names the publisher. Nodes are peers and rmw_zenoh's router forwards nothing from peer
to peer, so a subscriber outside ROS must be a client.
"""

import struct
from typing import Final, NamedTuple

_NUMBERS: Final = struct.Struct("<qqB")
_LONGEST_GID: Final = 24
"""Largest RMW_GID_STORAGE_SIZE: 16, or 24 in older distributions."""
MAX_KEY_CHARACTERS: Final = 600
"""Longest key: topic and type of 255 each, a hash and a domain."""


class Attachment(NamedTuple):
    """The attachment of a ROS 2 message."""

    sequence: int
    sent_ns: int
    publisher: bytes


def key_expression(domain: int, topic: str) -> str:
    """Return the expression of all messages of a topic; wrong types are reported, too."""
    return f"{domain}/{topic.strip('/')}/*/*"


def type_and_hash(key: str) -> tuple[str, str]:
    """Return the type and its hash at the end of a key; raise ValueError if they are missing."""
    parts = key[:MAX_KEY_CHARACTERS].split("/")
    if len(parts) < 4 or len(key) > MAX_KEY_CHARACTERS:
        raise ValueError(f"key {key[:80]!r}: DOMAIN/TOPIC/TYPE/HASH is expected")
    return parts[-2], parts[-1]


def decode_attachment(attachment: bytes | None) -> Attachment:
    """Return rmw_zenoh's attachment; raise ValueError if it is missing or malformed."""
    if attachment is None:
        raise ValueError("has no attachment, a publisher of rmw_zenoh gives one")
    size = len(attachment) - _NUMBERS.size
    if not 0 < size <= _LONGEST_GID:
        raise ValueError(f"has an attachment of {len(attachment)} bytes, 33 are expected")
    sequence, sent_ns, length = _NUMBERS.unpack_from(attachment)
    if length != size:
        raise ValueError(f"has an attachment whose array has {length} bytes, not {size}")
    return Attachment(sequence, sent_ns, attachment[_NUMBERS.size :])
