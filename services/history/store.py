"""What is known of crossings, read from messages that were recorded: the one place for it.

A worker that starts again reads its results files (`result_files`), a logger that makes room the
recordings (`processed`). Both ask what is made here: `Known`, in `services.identification.known`.
"""

import logging
from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import NamedTuple

from schemas.messages import decode
from schemas.proto import driveby_pb2 as pb
from schemas.results import Crossing, Header
from schemas.results_on_the_wire import estimate_to_crossing
from schemas.topics import Key, topic
from services.identification.bridge_state import usable
from services.identification.known import Known, search_hash

_log = logging.getLogger(__name__)
_Name = tuple[str, str]
"""Realm and crossing id."""
_Whose = tuple[str, str, str]
"""Realm, vehicle and bridge."""


class Told(NamedTuple):
    """A result that was told."""

    result: Crossing
    header: Header


class Store:
    """Takes messages in the order in which they were told, and keeps what they say of crossings.

    It keeps no message: of a result only what counts in the state of a bridge. With a `search`
    (`search_hash`) only results of that search are results: what another search or another site
    file gave does not count, and its states are told anew.
    """

    def __init__(self, search: str | None) -> None:
        self._search = search
        self._found: dict[_Name, Known] = {}
        self._of_others: set[_Name] = set()
        self._open: dict[tuple[str, str], dict[str, Known]] = {}
        """By realm and bridge: the usable results of which no state has taken account, by id."""

    def add(self, key: Key, payload: bytes) -> Told | None:
        """Take a message in, and return the result that it tells, if any.

        What is none of a bridge's messages is ignored, what is malformed a warning.
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
                told = Told(*estimate_to_crossing(message))
                self._add_result(key, told)
                return told
            elif isinstance(message, pb.BridgeState):
                # It was made of what it names: results may have been told while it was made.
                of_bridge = self._open.get((key.realm, key.identifier), {})
                for name in crossings_named(message):
                    known = of_bridge.pop(name, None)
                    if known is not None:
                        known.is_in_state = True
        except ValueError as error:
            _log.warning("%s of an earlier run left out: %s", key.stream, error)
        return None

    def crossings(self) -> list[Known]:
        """All crossings in order of their entries."""
        for name, known in self._found.items():
            known.has_other_result = name in self._of_others
            if not known.has_result and name in self._of_others:
                known.states.clear()
        return sorted(self._found.values(), key=lambda known: known.entry_ns)

    def take_all(self) -> list[Known]:
        """All crossings of which something has been added since the last call."""
        crossings = self.crossings()
        self._found.clear()
        self._of_others.clear()
        self._open.clear()
        return crossings

    def _add_state(self, key: Key, message: pb.Crossing) -> None:
        known = self._found.setdefault(
            (key.realm, message.crossing_id),
            Known(key.realm, message.vehicle, key.identifier, message.crossing_id, 0),
        )
        known.entry_ns = message.entry_time_ns
        known.exit_ns = max(known.exit_ns, message.exit_time_ns)
        known.states.add(message.state)
        known.last = message

    def _add_result(self, key: Key, told: Told) -> None:
        result = told.result
        name = (key.realm, result.crossing_id)
        known = self._found.get(name)
        if known is not None:
            # What was told before it was told of another search's result.
            known.states.discard(pb.DONE)
            known.is_in_state = False
        if self._search not in (None, search_hash(told.header)):
            self._of_others.add(name)
            return
        if known is None:
            entry_ns = round(result.entry_time * 1e9)
            known = self._found[name] = Known(
                key.realm, result.vehicle, key.identifier, result.crossing_id, entry_ns
            )
        known.exit_ns = max(known.exit_ns, round(result.exit_time * 1e9))
        known.has_result = True
        known.usable = usable(result)
        if known.usable is not None:
            self._open.setdefault((key.realm, key.identifier), {})[known.crossing_id] = known


class Ledger:
    """What has been told of crossings so far, by earlier runs and by this one.

    It keeps their names, times and states, and no results. When something was told is by the clock
    of whoever keeps it: a truck's may be a year behind.
    """

    def __init__(self, known: Iterable[Known], now_s: float = 0.0) -> None:
        self._store = Store(None)
        self._known: dict[_Whose, dict[str, Known]] = {}
        self._told_s: dict[_Name, float] = {}
        for one in known:
            self._put(replace(one, states=set(one.states)), now_s)

    def note(self, key: Key, payload: bytes) -> None:
        """Take in what is told."""
        self._store.add(key, payload)

    def settle(self, now_s: float) -> None:
        """Bring what was noted, now or shortly before, to what was known."""
        for one in self._store.take_all():
            before = self._known.get(_whose(one), {}).get(one.crossing_id)
            if before is not None:
                one.states |= before.states
                one.entry_ns = one.entry_ns or before.entry_ns
                one.exit_ns = max(one.exit_ns, before.exit_ns)
                one.has_result |= before.has_result
                one.has_other_result |= before.has_other_result
            self._put(one, now_s)

    def about(self, realm: str, vehicle: str, bridge: str) -> list[Known]:
        """What is known of the crossings of a truck and a bridge."""
        return list(self._known.get((realm, vehicle, bridge), {}).values())

    def forget_told_before(self, time_s: float) -> None:
        """Forget crossings of which the last was told before a time."""
        for whose, crossings in list(self._known.items()):
            for name in [n for n in crossings if self._told_s[whose[0], n] < time_s]:
                del crossings[name], self._told_s[whose[0], name]
            if not crossings:
                del self._known[whose]

    def _put(self, known: Known, now_s: float) -> None:
        known.last = known.usable = None  # they are large, and nobody asks for them here
        self._known.setdefault(_whose(known), {})[known.crossing_id] = known
        self._told_s[known.realm, known.crossing_id] = now_s


def _whose(known: Known) -> _Whose:
    return known.realm, known.vehicle, known.bridge


def crossings_named(state: pb.BridgeState) -> Iterator[str]:
    """The ids of the crossings that a state of a bridge counts, the newest hundred or so."""
    yield from state.crossings_used
    for left_out in state.crossings_left_out:
        yield left_out.crossing_id


def known_crossings(
    messages: Iterable[tuple[Key, bytes]], search: str | None = None
) -> list[Known]:
    """What messages, in the order in which they were told, say of crossings."""
    store = Store(search)
    for key, payload in messages:
        store.add(key, payload)
    return store.crossings()
