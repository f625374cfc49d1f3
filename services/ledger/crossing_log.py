"""The state of crossings, derived from recorded messages in one place.

A worker that starts again reads its results files (`runs`), a logger that frees space the
recordings (`processed`). Both use the records computed here: `CrossingRecord`, in
`services.identification.known`.
"""

import logging
from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import NamedTuple

from schemas.messages import decode
from schemas.proto import driveby_pb2 as pb
from schemas.results import CrossingResult, ResultHeader
from schemas.results_on_the_wire import estimate_to_crossing
from schemas.topics import Key, topic
from services.identification.known import CrossingRecord, search_hash
from services.identification.usable import usable

_log = logging.getLogger(__name__)
_Name = tuple[str, str]
"""Realm and crossing id."""
_Pair = tuple[str, str, str]
"""Realm, vehicle and bridge."""


class PublishedResult(NamedTuple):
    """A published result."""

    result: CrossingResult
    header: ResultHeader


class CrossingLog:
    """State of crossings, from messages in the order of their publication.

    It keeps no message, and of a result only what the state of a bridge needs. With a `search`
    (`search_hash`) only results of that search count; results of another search or site file do
    not, and their states are published again.
    """

    def __init__(self, search: str | None) -> None:
        self._search = search
        self._found: dict[_Name, CrossingRecord] = {}
        self._of_others: set[_Name] = set()
        self._open: dict[tuple[str, str], dict[str, CrossingRecord]] = {}
        """Usable results that no state includes yet: by realm and bridge, then by id."""

    def add(self, key: Key, payload: bytes) -> PublishedResult | None:
        """Add a message and return the result that it carries, if any.

        Messages other than a bridge's are ignored; a malformed one is a warning.
        """
        if key.owner != "bridge":
            return None
        try:
            message = decode(topic(key.owner, key.stream).message, payload)
            bridge = getattr(message, "bridge", key.identifier)
            if bridge != key.identifier:
                raise ValueError(f"it is about {bridge}, on the topic of {key.identifier}")
            if isinstance(message, pb.Crossing):
                self._add_state(key, message)
            elif isinstance(message, pb.Estimate):
                published = PublishedResult(*estimate_to_crossing(message))
                self._add_result(key, published)
                return published
            elif isinstance(message, pb.BridgeState):
                # A state includes the crossings it names; results may be published while it is
                # computed.
                of_bridge = self._open.get((key.realm, key.identifier), {})
                for name in crossings_named(message):
                    known = of_bridge.pop(name, None)
                    if known is not None:
                        known.is_in_state = True
        except ValueError as error:
            _log.warning("skipping %s of an earlier run: %s", key.stream, error)
        return None

    def crossings(self) -> list[CrossingRecord]:
        """Return all crossings in order of their entries."""
        for name, known in self._found.items():
            known.has_other_result = name in self._of_others
            if not known.has_result and name in self._of_others:
                known.states.clear()
        return sorted(self._found.values(), key=lambda known: known.entry_ns)

    def drain(self) -> list[CrossingRecord]:
        """Return and remove all crossings with messages added since the last call."""
        crossings = self.crossings()
        self._found.clear()
        self._of_others.clear()
        self._open.clear()
        return crossings

    def _add_state(self, key: Key, message: pb.Crossing) -> None:
        known = self._found.setdefault(
            (key.realm, message.crossing_id),
            CrossingRecord(key.realm, message.vehicle, key.identifier, message.crossing_id, 0),
        )
        known.entry_ns = message.entry_time_ns
        known.exit_ns = max(known.exit_ns, message.exit_time_ns)
        known.states.add(message.state)
        known.last = message

    def _add_result(self, key: Key, published: PublishedResult) -> None:
        result = published.result
        name = (key.realm, result.crossing_id)
        known = self._found.get(name)
        if known is not None:
            # States published before refer to another search's result.
            known.states.discard(pb.DONE)
            known.is_in_state = False
        if self._search not in (None, search_hash(published.header)):
            self._of_others.add(name)
            return
        if known is None:
            entry_ns = round(result.entry_time * 1e9)
            known = self._found[name] = CrossingRecord(
                key.realm, result.vehicle, key.identifier, result.crossing_id, entry_ns
            )
        known.exit_ns = max(known.exit_ns, round(result.exit_time * 1e9))
        known.has_result = True
        known.usable = usable(result)
        if known.usable is not None:
            self._open.setdefault((key.realm, key.identifier), {})[known.crossing_id] = known


class Ledger:
    """Crossings published so far, by earlier runs and by this one.

    It keeps names, times and states, and no results. Publication times are by the clock of the
    process that keeps the ledger: a truck's clock may be a year behind.
    """

    def __init__(self, known: Iterable[CrossingRecord], now_s: float = 0.0) -> None:
        self._log_of_new = CrossingLog(None)
        self._known: dict[_Pair, dict[str, CrossingRecord]] = {}
        self._published_s: dict[_Name, float] = {}
        for one in known:
            self._put(replace(one, states=set(one.states)), now_s)

    def note(self, key: Key, payload: bytes) -> None:
        """Record a published message."""
        self._log_of_new.add(key, payload)

    def commit(self, now_s: float) -> None:
        """Merge the messages recorded since the last call into the known crossings."""
        for one in self._log_of_new.drain():
            before = self._known.get(_pair_of(one), {}).get(one.crossing_id)
            if before is not None:
                one.states |= before.states
                one.entry_ns = one.entry_ns or before.entry_ns
                one.exit_ns = max(one.exit_ns, before.exit_ns)
                one.has_result |= before.has_result
                one.has_other_result |= before.has_other_result
            self._put(one, now_s)

    def about(self, realm: str, vehicle: str, bridge: str) -> list[CrossingRecord]:
        """Return the known crossings of a truck on a bridge."""
        return list(self._known.get((realm, vehicle, bridge), {}).values())

    def forget_before(self, time_s: float) -> None:
        """Forget crossings whose last message was published before a time."""
        for pair, crossings in list(self._known.items()):
            for name in [n for n in crossings if self._published_s[pair[0], n] < time_s]:
                del crossings[name], self._published_s[pair[0], name]
            if not crossings:
                del self._known[pair]

    def _put(self, known: CrossingRecord, now_s: float) -> None:
        known.last = known.usable = None  # they are large and not needed here
        self._known.setdefault(_pair_of(known), {})[known.crossing_id] = known
        self._published_s[known.realm, known.crossing_id] = now_s


def _pair_of(known: CrossingRecord) -> _Pair:
    return known.realm, known.vehicle, known.bridge


def crossings_named(state: pb.BridgeState) -> Iterator[str]:
    """Yield the ids of the crossings in a bridge's state, at most the newest hundred or so."""
    yield from state.crossings_used
    for left_out in state.crossings_left_out:
        yield left_out.crossing_id
