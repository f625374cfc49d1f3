"""What earlier runs of the worker have told of crossings, from the messages they left. No I/O."""

import json
import logging
from collections.abc import Iterable
from dataclasses import dataclass, field
from itertools import chain

from schemas.messages import decode
from schemas.proto import driveby_pb2 as pb
from schemas.results import Crossing, Header, estimate_to_crossing
from schemas.topics import Key, topic

_log = logging.getLogger(__name__)


@dataclass
class Told:
    """One crossing as earlier runs left it; times are ns since 1970 UTC."""

    realm: str
    vehicle: str
    bridge: str
    crossing_id: str
    entry_ns: int
    exit_ns: int = 0
    """0: not told."""
    states: set[pb.CrossingState] = field(default_factory=set)
    last: pb.Crossing | None = None
    """The state that was told last."""
    result: Crossing | None = None
    """None: none by these settings and this site file."""
    is_in_state: bool = False
    """A state of the bridge takes account of it."""


def told_of(said: Iterable[tuple[Key, bytes]], header: Header) -> list[Told]:
    """The crossings of `said` in order of their entries, malformed messages left out.

    A result is identified by method, settings and site file too (docs/contract.md): what another
    search or another site file gave does not count, and its states are told anew.
    """
    found: dict[tuple[str, str], Told] = {}
    in_states: set[tuple[str, str]] = set()
    others: set[tuple[str, str]] = set()
    for key, payload in said:
        try:
            message = decode(topic(key.owner, key.stream).message, payload)
            if isinstance(message, pb.Crossing):
                _add_state(found, key, message)
            elif isinstance(message, pb.Estimate):
                result, its_header = estimate_to_crossing(message)
                # What was told before it was told of another search's result.
                name = (key.realm, result.crossing_id)
                in_states.discard(name)
                if name in found:
                    found[name].states.discard(pb.DONE)
                if _same_search(its_header, header):
                    _add_result(found, key, result)
                else:
                    others.add(name)
            elif isinstance(message, pb.BridgeState):
                left_out = (crossing.crossing_id for crossing in message.crossings_left_out)
                ids = chain(message.crossings_used, left_out)
                in_states.update((key.realm, crossing_id) for crossing_id in ids)
        except ValueError as error:
            _log.warning("%s of an earlier run left out: %s", key.stream, error)
    for name, told in found.items():
        told.is_in_state = name in in_states
        if told.result is None and name in others:
            told.states.clear()
    return sorted(found.values(), key=lambda told: told.entry_ns)


def _add_state(found: dict[tuple[str, str], Told], key: Key, message: pb.Crossing) -> None:
    told = found.setdefault(
        (key.realm, message.crossing_id),
        Told(key.realm, message.vehicle, key.identifier, message.crossing_id, 0),
    )
    told.entry_ns = message.entry_time_ns
    told.exit_ns = max(told.exit_ns, message.exit_time_ns)
    told.states.add(message.state)
    told.last = message


def _add_result(found: dict[tuple[str, str], Told], key: Key, result: Crossing) -> None:
    entry_ns, exit_ns = round(result.entry_time * 1e9), round(result.exit_time * 1e9)
    told = found.setdefault(
        (key.realm, result.crossing_id),
        Told(key.realm, result.vehicle, key.identifier, result.crossing_id, entry_ns),
    )
    told.exit_ns = max(told.exit_ns, exit_ns)
    told.result = result


def _same_search(one: Header, other: Header) -> bool:
    def text(header: Header) -> str:  # as it stands in a message
        return json.dumps(header.settings, sort_keys=True)

    return (one.site_hash, one.seed, text(one)) == (other.site_hash, other.seed, text(other))
