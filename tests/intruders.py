"""Sessions of somebody who tries more than is allowed: none of our own programs' checks run."""

import json
from collections.abc import Iterable
from pathlib import Path

import zenoh

from services.bus.credentials import link_settings
from tests.waiting import LONGEST_S

V1 = "driveby/v1"


def raw_session(
    endpoint: str,
    folder: Path | None,
    *,
    listen: bool = False,
    timeout_s: float = LONGEST_S,
    settings: dict[str, object] | None = None,
) -> zenoh.Session:
    """A session that checks nothing beforehand, with any credentials and any further settings."""
    config = zenoh.Config()
    link = {} if folder is None else link_settings(folder)
    everything: dict[str, object] = {
        "mode": "router" if listen else "client",
        "listen/endpoints": [endpoint] if listen else [],
        "connect/endpoints": [] if listen else [endpoint],
        "connect/timeout_ms": round(timeout_s * 1000),
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "transport/shared_memory/enabled": False,
        "timestamping/enabled": True,
        **{f"transport/link/{name}": value for name, value in link.items()},
        **(settings or {}),
    }
    for name, value in everything.items():
        config.insert_json5(name, json.dumps(value))
    return zenoh.open(config)


def listen_to(session: zenoh.Session, keys: Iterable[str]) -> list[tuple[str, bytes]]:
    """Subscribe to each alone, for a rule must include it whole; what comes fills the list.

    It does so in the thread that receives: what was said before an answer (`settle`) is in the
    list when the answer has come. A thread of its own, which is Zenoh's custom, may come later.
    """
    heard: list[tuple[str, bytes]] = []

    def hear(sample: zenoh.Sample) -> None:
        heard.append((str(sample.key_expr), sample.payload.to_bytes()))

    for key in keys:
        session.declare_subscriber(key, zenoh.handlers.Callback(hear, indirect=False))
    return heard


def settle(session: zenoh.Session) -> None:
    """Wait until the other side has treated all that was sent: a query comes after it."""
    for key in (f"{V1}/live/service/none/durable", f"{V1}/live/bridge/none/state"):
        list(session.get(key, target=zenoh.QueryTarget.ALL, timeout=LONGEST_S))


def put_all(session: zenoh.Session, keys: Iterable[str]) -> None:
    for key in keys:
        session.put(key, key.encode(), congestion_control=zenoh.CongestionControl.BLOCK)
    settle(session)
