"""How ROS 2 speaks Zenoh (rmw_zenoh_cpp): its keys, and what it attaches to messages.

A key is `<domain>/<topic>/<type>/<hash of the type>`, the topic without its slash at the begin,
e.g. `0/imu/data/sensor_msgs::msg::dds_::Imu_/RIHS01_7d9a…`. An attachment is a sequence number and
the time of sending (ns since 1970), both int64, little-endian, and an array of bytes, its length
before it, that names the publisher. Nodes are peers and rmw_zenoh's router hands nothing from peer
to peer, so a subscriber that is no ROS node must be a client.
"""

import struct
from typing import Final, NamedTuple

_NUMBERS: Final = struct.Struct("<qqB")
_LONGEST_GID: Final = 24
"""RMW_GID_STORAGE_SIZE: 16, or 24 in distributions of before."""
MAX_KEY_CHARACTERS: Final = 600
"""A topic and a type of 255 each, a hash and a domain."""


class Attachment(NamedTuple):
    """What comes with a message of ROS 2."""

    sequence: int
    sent_ns: int
    publisher: bytes


def key_expression(domain: int, topic: str) -> str:
    """All messages of a topic, whatever their type: what cannot be used is to be told, too."""
    return f"{domain}/{topic.strip('/')}/*/*"


def type_and_hash(key: str) -> tuple[str, str]:
    """The type and its hash at the end of a key; ValueError if it has none."""
    parts = key[:MAX_KEY_CHARACTERS].split("/")
    if len(parts) < 4 or len(key) > MAX_KEY_CHARACTERS:
        raise ValueError(f"key {key[:80]!r}: DOMAIN/TOPIC/TYPE/HASH is expected")
    return parts[-2], parts[-1]


def decode_attachment(attachment: bytes | None) -> Attachment:
    """Return what rmw_zenoh attached; ValueError if it is missing or malformed."""
    if attachment is None:
        raise ValueError("has no attachment, a publisher of rmw_zenoh gives one")
    size = len(attachment) - _NUMBERS.size
    if not 0 < size <= _LONGEST_GID:
        raise ValueError(f"has an attachment of {len(attachment)} bytes, 33 are expected")
    sequence, sent_ns, length = _NUMBERS.unpack_from(attachment)
    if length != size:
        raise ValueError(f"has an attachment whose array is said to be {length} bytes, not {size}")
    return Attachment(sequence, sent_ns, attachment[_NUMBERS.size :])
