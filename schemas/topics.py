"""The table of topics, from which logger, replay, liveness, viewer and docs/contract.md derive.

A key is `driveby/v1/{realm}/{owner}/{identifier}/{stream}`, e.g.
`driveby/v1/live/vehicle/truck-1/accel`. This module needs the standard library only.
"""

import re
from collections.abc import Sequence
from functools import lru_cache
from typing import Literal, NamedTuple

PREFIX = "driveby/v1"
IDENTIFIER = r"[a-z0-9][a-z0-9_-]{0,62}"
REALM = rf"live|(?:replay|sim|import)-{IDENTIFIER}"

_IDENTIFIER = re.compile(IDENTIFIER)
_MAX_IDENTIFIER_CHARACTERS = 63
_REALM = re.compile(REALM)
_NAME_BEGIN = re.compile(r"[a-z0-9][a-z0-9_-]*")
MAX_KEY_CHARACTERS = 255
"""Length limit far above the longest valid key; bounds the cost of hostile keys."""

Owner = Literal["vehicle", "bridge", "service"]
Delivery = Literal["reliable", "latest"]


class Topic(NamedTuple):
    """One row of the table: the content of a stream and its handling."""

    owner: Owner
    stream: str
    message: str
    """Full protobuf name; empty where presence alone is the message (a Zenoh liveliness token)."""
    logged: bool
    """Whether the logger records the topic and replay publishes it again."""
    latched: bool
    """Whether a late subscriber receives the last message at once."""
    nominal_rate_hz: float | None
    """Messages per second while the owner works; None: on occasion."""
    delivery: Delivery
    """Kind of delivery. `reliable` blocks, caches and fetches again; `latest` may drop."""
    cache: int
    """Messages that the publisher keeps for absent subscribers."""
    queue: int
    """Messages that a subscriber keeps waiting before the publisher blocks."""
    max_bytes: int
    """Largest payload that is accepted."""
    description: str


class Key(NamedTuple):
    """The parts of a key. `str()` does not restore it: use `key(*k)`."""

    realm: str
    owner: Owner
    identifier: str
    stream: str


class Message(NamedTuple):
    """Message as it travelled on the bus, identified by (key, boot_id, sequence)."""

    key: Key
    payload: bytes
    boot_id: int
    sequence: int
    log_time_ns: int
    """Wall time of the first sample, ns since 1970 UTC."""
    publish_time_ns: int
    """Wall time at which the writer received it, ns since 1970 UTC."""


HEALTH_PERIOD_S = 60.0
"""Interval at which each service publishes its health."""

TOPICS: tuple[Topic, ...] = (
    Topic(
        "vehicle", "accel", "driveby.v1.AccelBatch", True, False, 20.0, "reliable",
        6000, 100_000, 1 << 18, "50-100 ms of every accelerometer, each at its own rate",
    ),
    Topic(
        "vehicle", "gnss", "driveby.v1.GnssFix", True, False, 10.0, "reliable",
        3000, 100_000, 1 << 12, "one fix of the GNSS receiver, with its accuracies",
    ),
    Topic(
        "vehicle", "location", "foxglove.LocationFix", True, False, 10.0, "reliable",
        3000, 100_000, 1 << 14, "the same fix in the form that map viewers draw",
    ),
    Topic(
        "vehicle", "info", "driveby.v1.VehicleInfo", True, True, None, "reliable",
        1, 1_000, 1 << 17, "the truck's parts of the site file",
    ),
    Topic(
        "vehicle", "alive", "", False, False, None, "reliable",
        0, 1_000, 0, "liveliness token: present while the truck's gateway runs",
    ),
    Topic(
        "bridge", "crossing", "driveby.v1.Crossing", True, False, None, "reliable",
        1000, 1_000, 1 << 14, "a change of state of one crossing",
    ),
    Topic(
        "bridge", "estimate", "driveby.v1.Estimate", True, False, None, "reliable",
        100, 1_000, 1 << 24, "the result of one crossing",
    ),
    Topic(
        "bridge", "state", "driveby.v1.BridgeState", True, True, None, "reliable",
        1, 1_000, 1 << 20, "the bridge's latest fused estimate; also answers queries",
    ),
    Topic(
        "bridge", "alarm", "driveby.v1.Alarm", True, True, None, "reliable",
        1, 1_000, 1 << 14, "the bridge has changed; active until it is acknowledged",
    ),
    Topic(
        "service", "health", "driveby.v1.Health", False, False, 1 / HEALTH_PERIOD_S, "latest",
        1, 1_000, 1 << 16, "state of a service: rate, lag, queue, lost, recovered, free disk",
    ),
    Topic(
        "service", "progress", "driveby.v1.Progress", False, False, None, "latest",
        1, 1_000, 1 << 12, "progress of a service's long task",
    ),
    Topic(
        "service", "event", "driveby.v1.Event", True, False, None, "reliable",
        1000, 10_000, 1 << 14, "every gap, drop, recovery, clock step and write error, counted",
    ),
    Topic(
        "service", "durable", "driveby.v1.Durable", False, True, 1.0, "reliable",
        1, 1_000, 1 << 20, "messages that a logger has on disk, per vehicle, stream and boot",
    ),
)  # fmt: skip

_BY_NAME = {(row.owner, row.stream): row for row in TOPICS}


def topic(owner: str, stream: str) -> Topic:
    """Return the row of the table; raise ValueError if there is none."""
    try:
        return _BY_NAME[(owner, stream)]  # type: ignore[index]
    except KeyError:
        known = ", ".join(f"{row.owner}/{row.stream}" for row in TOPICS)
        name = f"{owner}/{stream}"[:80]
        raise ValueError(f"no topic {name!r}; there are {known}") from None


def check_identifier(text: str) -> str:
    """Return `text` if it may name a vehicle, bridge or service; raise ValueError if not."""
    if not _IDENTIFIER.fullmatch(text):
        raise ValueError(
            f"identifier {text[:80]!r} must be 1 to 63 of a-z, 0-9, '_' and '-', "
            "beginning with a letter or digit"
        )
    return text


def gateway_service(vehicle: str) -> str:
    """Return the name of the service under which a truck's gateway publishes events."""
    return f"gateway-{check_identifier(vehicle)}"[:_MAX_IDENTIFIER_CHARACTERS]


def check_realm(text: str) -> str:
    """Return `text` if it is a realm; raise ValueError if not."""
    if not _REALM.fullmatch(text):
        raise ValueError(
            f"realm {text[:80]!r} must be live, replay-NAME, sim-NAME or import-NAME, "
            "NAME of a-z, 0-9, '_' and '-'"
        )
    return text


def check_realms(text: str) -> str:
    """Return `text` if it is a realm or a pattern: the beginning of realms followed by `*`.

    `*` is every realm, `sim-*` those of simulations. Raise ValueError if it is neither.
    """
    begin = text.removesuffix("*")
    is_one = begin != text and any(
        kind.startswith(begin)
        or (begin.startswith(kind) and _NAME_BEGIN.fullmatch(begin, len(kind)))
        for kind in ("live", "replay-", "sim-", "import-")
    )
    return text if is_one else check_realm(text)


def single_realm(realms: Sequence[str]) -> str | None:
    """Return the realm if there is exactly one and it is not a pattern; else None."""
    return realms[0] if len(realms) == 1 and "*" not in realms[0] else None


def is_from_recording(realm: str) -> bool:
    """Return whether a realm's messages come from a recording, so that repeats are intended."""
    return realm.startswith(("replay-", "import-"))


def is_simulated(realm: str) -> bool:
    """Return whether a realm's messages come from a simulation."""
    return realm.startswith("sim-")


def key(realm: str, owner: str, identifier: str, stream: str) -> str:
    """Return the Zenoh key; raise ValueError if a part is malformed or the topic does not exist."""
    topic(owner, stream)
    check_realm(realm)
    check_identifier(identifier)
    return f"{PREFIX}/{realm}/{owner}/{identifier}/{stream}"


@lru_cache(maxsize=10_000)  # a few keys recur thousands of times a second
def parse_key(text: str) -> Key:
    """Return the parts of a key; raise ValueError if it is not one of ours."""
    if len(text) > MAX_KEY_CHARACTERS:
        raise ValueError(f"key of {len(text)} characters; at most {MAX_KEY_CHARACTERS}")
    parts = text.split("/")
    if len(parts) != 6 or "/".join(parts[:2]) != PREFIX:
        raise ValueError(f"key {text!r} is not {PREFIX}/REALM/OWNER/ID/STREAM")
    _, _, realm, owner, identifier, stream = parts
    row = topic(owner, stream)
    return Key(check_realm(realm), row.owner, check_identifier(identifier), row.stream)


def selector(realm: str | None, owner: str, stream: str = "*") -> str:
    """Return the key expression of one stream, or of all, of all owners of a kind.

    `realm` may be a pattern as in `check_realms`; None is any realm.
    """
    return f"{PREFIX}/{realm_chunk(realm)}/{owner}/*/{stream}"


def realm_chunk(realm: str | None) -> str:
    """Return the part of a key expression for a realm, a pattern of realms or any realm (None)."""
    return "*" if realm in (None, "*") else str(realm).replace("*", "$*")
