"""Access control of the bus by role: Zenoh's settings, derived from the table of topics.

Pure: names in, settings out. A router with these settings drops every message that no rule allows.
It identifies a client by the common name of its certificate.

A rule of Zenoh is about one direction of one kind of message. A publisher of a key also answers
queries of it (the cache of an advanced publisher, the last message of a latched topic, the truck's
spool) and announces itself; a reader of a key also queries it. So two sets of keys per subject,
published and read ones, give all rules. To each key belongs the tree `KEY/@adv/**`, where advanced
publishers have their cache, their announcements and their liveliness; `**` does not match it.
"""

from collections.abc import Iterable
from typing import Any

from schemas.topics import PREFIX, TOPICS, gateway_service
from services.bus.credentials import Subject

_PUBLISHES = ("put", "reply", "declare_queryable", "liveliness_token")
_QUERIES = ("declare_subscriber", "query", "declare_liveliness_subscriber", "liveliness_query")
_EVERYTHING = [f"{PREFIX}/**"]
_REPLAYS = "replay-$*"
_SERVICE_STREAMS = {
    "logger": ("health", "event", "durable"),
    "worker": ("health", "progress", "event"),
}
"""Streams by role; `durable` makes a truck delete data, so only loggers publish it."""


def access_control(subjects: Iterable[Subject]) -> dict[str, Any]:
    """Return the value of Zenoh's key `access_control` that admits these subjects only.

    A truck publishes its own keys and events of its gateway, which is a service of its own name,
    and reads `durable`, which permits it to delete data. A logger publishes about itself and reads
    everything; a worker publishes results and alarms and reads trucks, those and its own health; a
    viewer reads results and alarms. A replay publishes in realms of replays only. Routers trust
    each other: each filters the messages of its own clients.
    """
    rules: list[dict[str, Any]] = []
    named: list[dict[str, Any]] = []
    policies: list[dict[str, Any]] = []
    for subject in sorted(subjects):
        own = _rules(str(subject), published_by(subject), read_by(subject))
        rules += own
        named.append({"id": str(subject), "cert_common_names": [str(subject)]})
        policies.append({"rules": [rule["id"] for rule in own], "subjects": [str(subject)]})
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": named,
        "policies": policies,
    }


def published_by(subject: Subject) -> list[str]:
    """Return the key expressions on which a subject may publish and answer."""
    role, name = subject
    match role:
        case "truck":
            return [
                *_keys("vehicle", name),
                f"{PREFIX}/*/vehicle/{name}/*/spool",
                *_keys("service", gateway_service(name), ("event",)),
            ]
        case "logger":
            return _keys("service", name, _SERVICE_STREAMS[role])
        case "worker":
            return [*_keys("bridge"), *_keys("service", name, _SERVICE_STREAMS[role])]
        case "replay":
            logged = [row for row in TOPICS if row.logged]
            return [f"{PREFIX}/{_REPLAYS}/{row.owner}/*/{row.stream}" for row in logged]
        case "router":
            return _EVERYTHING
    return []


def read_by(subject: Subject) -> list[str]:
    """Return the key expressions that a subject may subscribe to and query."""
    role, name = subject
    match role:
        case "truck" | "replay":
            return _keys("service", streams=("durable",))
        case "logger" | "router":
            return _EVERYTHING
        case "worker":
            return [
                f"{PREFIX}/*/vehicle/**",
                f"{PREFIX}/*/bridge/**",
                *_keys("service", streams=("durable",)),
                *_keys("service", name, ("health",)),
            ]
        case "viewer":
            return [f"{PREFIX}/*/bridge/**", *_keys("service", streams=("health", "progress"))]
    return []


def _keys(owner: str, identifier: str = "*", streams: Iterable[str] | None = None) -> list[str]:
    """Return one expression for each stream of the table, in every realm."""
    return [
        f"{PREFIX}/*/{owner}/{identifier}/{row.stream}"
        for row in TOPICS
        if row.owner == owner and (streams is None or row.stream in streams)
    ]


def _rules(name: str, published: list[str], read: list[str]) -> list[dict[str, Any]]:
    # Queries of other clients arrive with their key expression, which may be wider than one's own
    # keys. A rule applies only to expressions that it includes, hence everything; Zenoh passes on
    # only messages that match the receiver's keys.
    rules = [
        ("publishes", "ingress", _PUBLISHES, published),
        ("is asked", "egress", _QUERIES, _EVERYTHING if published else []),
        ("asks", "ingress", _QUERIES, read),
        ("reads", "egress", _PUBLISHES, read),
    ]
    return [
        {
            "id": f"{name} {what}",
            "permission": "allow",
            "flows": [flow],
            "messages": list(messages),
            "key_exprs": [*keys, *(f"{key}/@adv/**" for key in keys)],
        }
        for what, flow, messages, keys in rules
        if keys
    ]
