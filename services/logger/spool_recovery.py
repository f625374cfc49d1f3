"""Recovery of missing messages from the trucks' own disks.

Every few seconds all trucks are asked for the contents of their spools (`schemas.spool`). Messages
missing for longer than one such round are requested a page at a time, with one query per truck and
few in all, and with growing pauses until the truck answers. A message is lost only when a truck
declares that it no longer holds it.

`SpoolListing` reads and decodes the lists in a thread of its own. Everything else runs in the
thread that calls `step`; nothing in it waits, and no call takes long whatever a truck lists: a step
processes a limited number of answers, and of boots in each; the others follow later.
"""

import logging
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import islice
from types import MappingProxyType
from typing import Any, NamedTuple

import zenoh
from zenoh import handlers

from schemas.signals import decode_identity
from schemas.spool import (
    MAX_RANGES,
    PAGE_BYTES,
    PAGE_MESSAGES,
    Range,
    SpoolBoot,
    SpoolQuery,
    decode_page,
    spool_key,
)
from schemas.topics import Key, key
from services.bus.subscription import RawSample, SeenSequences
from services.common.intervals import Intervals
from services.common.log_lines import about
from services.logger.rate_limited_log import RateLimitedLog
from services.logger.shared_names import shared_name
from services.logger.spool_listing import SHARERS, SpoolListed, SpoolListing

__all__ = ["Shortfall", "SpoolRecovery", "shortfall"]

_log = logging.getLogger(__name__)
LIST_PERIOD_S = 2.0
"""Interval of queries for contents."""
_HURRY_S = 0.3
"""Delay after a truck's token, which precedes its first answer."""
_PAGE_TIMEOUT_S = 10.0
"""Timeout of a page over a slow mobile network."""
_QUERIES_AT_ONCE = 8
"""Number of trucks with a page query at a time; live messages have priority."""
_MAX_REPLIES = 2 * PAGE_MESSAGES
"""Largest number of messages in a page, twice the regular limit."""
_MAX_BYTES = 2 * PAGE_BYTES
"""Largest answer: twice a page and its end, or a single larger message."""
_REPLIES_PER_STEP = 500
"""Number of answers before live messages are received again."""
_FIRST_PAUSE_S = 1.0
"""Pause after a truck did not answer; it doubles after each failure."""
_LONGEST_PAUSE_S = 60.0
"""Longest pause, because the truck may return any minute."""
_TRUCKS = 1000
"""Largest number of spools (trucks times realms), which bounds memory."""
REALMS_OF_ONE = 16
"""Largest number of realms in which one vehicle is asked or noted as present."""
_BOOTS_AT_ONCE = 64
"""Number of earlier boots read from an answer besides the newest; others follow in turn."""
_COMPARE_S = 0.01
"""Time after which a step leaves further answers to the next one."""
_NEAR = 200
"""Distance of gaps that are requested together: few queries rather than few bytes."""


class Shortfall(NamedTuple):
    """Missing messages of one stream and boot, by the possible action."""

    fetch: list[Range]
    """Messages that the truck has."""
    confirmed: list[Range]
    """Messages that were confirmed on a logger's disk before."""
    lost: list[Range]
    """Messages that are lost."""


def shortfall(boot: SpoolBoot, seen: Intervals, ripe: int, gone: Iterable[Range] = ()) -> Shortfall:
    """Compare the received messages of a boot with those of its truck, below sequence `ripe`.

    `gone` are messages that this logger had confirmed and lost again.
    """
    missing = seen.missing_of([(0, min(ripe, boot.next_sequence) - 1)])
    durable = Intervals()
    durable.add_range(0, boot.durable)
    for first, last in gone:
        durable.remove_range(first, last)
    open_ = durable.missing_of(missing)
    held = Intervals()
    for first, last in boot.held:
        held.add_range(first, last)
    lost = held.missing_of(open_)
    return Shortfall(_without(open_, lost), _without(missing, open_), lost)


@dataclass
class _Task:
    """A running query."""

    where: Key
    query: SpoolQuery
    handler: Any
    deadline_s: float
    got: Intervals = field(default_factory=Intervals)
    next_sequence: int | None = None
    """First sequence after the page; None at the end of the range."""
    is_ended: bool = False
    """Whether a closing page has come."""
    replies: int = 0
    bytes: int = 0


@dataclass
class _Truck:
    ripe: dict[str, dict[int, int]] = field(default_factory=dict)
    """Sequence below which all are at least a round old, by stream and newest boot."""
    turn: Counter[str] = field(default_factory=Counter)
    """Number of earlier boots of each stream that have had their turn."""
    unlisted: set[tuple[Key, int]] = field(default_factory=set)
    todo: deque[tuple[Key, SpoolQuery]] = field(default_factory=deque)
    task: _Task | None = None
    failures: int = 0
    not_before_s: float = 0.0
    is_shared: bool = False
    """Whether trucks of the same name have answered: what one does not list, another may have."""


class SpoolRecovery:
    """The queries to all trucks and their progress."""

    def __init__(
        self,
        bus: zenoh.Session,
        realms: Sequence[str],
        seen: SeenSequences,
        *,
        gone: Mapping[tuple[Key, int], Intervals] = MappingProxyType({}),
        confirmed: Callable[[Key, int, int, int], None],
        lost: Callable[[Key, int, int, int], None],
    ) -> None:
        """Create the recovery; callbacks receive (stream's key, boot_id, first, last).

        `seen` and `gone` are only read; `gone` were on the disk, and trucks may still have them.
        """
        self._bus = bus
        self._seen = seen
        self._gone = gone
        self._confirmed = confirmed
        self._lost = lost
        self._trucks: dict[tuple[str, str], _Truck] = {}
        self._trucks_of: Counter[str] = Counter()
        self._complaints = RateLimitedLog(_log)
        self._listing = SpoolListing(bus, realms, self._complaints)
        self._next_list_s = 0.0
        self._with_gaps: dict[Key, set[int]] | None = None
        self._busy = False

    def step(self, now_s: float, *, hold: bool = False) -> list[RawSample]:
        """Advance without waiting; return fetched messages. With `hold`, start no queries."""
        if now_s >= self._next_list_s:
            self._next_list_s = now_s + LIST_PERIOD_S
            self._listing.ask()
            self._with_gaps = None
            self._complaints.flush()
        began_s = time.monotonic()
        while time.monotonic() - began_s < _COMPARE_S and (answer := self._listing.next_answer()):
            self._compare(answer)
        if not self._busy:
            return []
        received: list[RawSample] = []
        running = 0
        for truck in self._trucks.values():
            if truck.task is not None:
                self._read(truck, truck.task, now_s, received)
            running += truck.task is not None
        self._busy = running > 0
        for truck in self._trucks.values():
            if truck.task is None and truck.todo:
                self._busy = True
                if running < _QUERIES_AT_ONCE and not hold and now_s >= truck.not_before_s:
                    self._ask(truck, now_s)
                    running += truck.task is not None
        return received

    def waiting(self) -> int:
        """Return the number of messages still to be requested."""
        return sum(
            query.last - query.first + 1
            for truck in self._trucks.values()
            for _, query in [*truck.todo, *_under_way(truck)]
        )

    def hurry(self, now_s: float) -> None:
        """Request the contents soon: a new truck may not stay long."""
        self._next_list_s = min(self._next_list_s, now_s + _HURRY_S)

    def pause(self, where: Key, now_s: float) -> None:
        """Pause a truck, longer each time, because there was no room for its messages."""
        truck = self._trucks.get((where.realm, where.identifier))
        if truck is not None and now_s >= truck.not_before_s:
            _pause(truck, now_s)

    def close(self) -> None:
        """Stop all queries."""
        self._listing.close()
        self._complaints.flush(closing=True)

    def _compare(self, answer: SpoolListed) -> None:
        where, boots, is_shared = answer
        truck = self._truck(where)
        if truck is None or not boots:
            return
        if is_shared:
            _note_shared(truck, where)
        listed = {boot.boot_id for boot in boots}
        newest = boots[-1].boot_id
        turn = _turn(truck, where.stream, boots)
        taken = {boot.boot_id for boot in turn}
        todo = deque(
            (key_, query)
            for key_, query in truck.todo
            if key_ != where or (query.boot_id in listed and query.boot_id not in taken)
        )
        ripe = truck.ripe.setdefault(where.stream, {})
        for boot in turn:
            seen = self._seen.streams.get((where, boot.boot_id), Intervals())
            # A message just sent may still arrive; an earlier boot sends nothing.
            below = boot.next_sequence
            if boot.boot_id == newest:
                below = ripe.get(newest, 0)
            gone = self._gone.get((where, boot.boot_id))
            missing = shortfall(boot, seen, below, () if gone is None else gone.ranges())
            for first, last in missing.confirmed:
                self._confirmed(where, boot.boot_id, first, last)
            for first, last in missing.lost:
                self._lost(where, boot.boot_id, first, last)
            for first, last in _joined(missing.fetch):
                query = (where, SpoolQuery(boot.boot_id, first, last))
                if query not in _under_way(truck):
                    todo.append(query)
        ripe.pop(newest, None)
        ripe[newest] = boots[-1].next_sequence
        while len(ripe) > SHARERS:
            del ripe[next(iter(ripe))]
        truck.todo = deque(islice(todo, MAX_RANGES))
        self._busy = self._busy or bool(todo)
        if not truck.is_shared:
            self._forgotten(truck, where, listed, newest)

    def _truck(self, where: Key) -> _Truck | None:
        name = (where.realm, where.identifier)
        truck = self._trucks.get(name)
        if truck is None:
            if self._trucks_of[where.identifier] >= REALMS_OF_ONE:
                self._complaints.warn(
                    "a truck in many realms",
                    "%s: is in more than %d realms, its spool is not read in %s",
                    where.identifier, REALMS_OF_ONE, where.realm,
                )  # fmt: skip
                return None
            if len(self._trucks) >= _TRUCKS:
                self._complaints.warn(
                    "many trucks", "%s: more than %d trucks, its spool is not read",
                    where.identifier, _TRUCKS,
                )  # fmt: skip
                return None
            truck = self._trucks[name] = _Truck()
            self._trucks_of[where.identifier] += 1
        return truck

    def _forgotten(self, truck: _Truck, where: Key, listed: set[int], newest: int) -> None:
        """Give up the gaps of earlier boots that the truck has not listed for two rounds."""
        if self._with_gaps is None:
            self._with_gaps = {}
            for (one, boot_id), numbers in self._seen.streams.items():
                if numbers.runs > 1:
                    self._with_gaps.setdefault(one, set()).add(boot_id)
            for one, boot_id in self._gone:
                self._with_gaps.setdefault(one, set()).add(boot_id)
        unlisted = {
            (where, boot_id)
            for boot_id in self._with_gaps.get(where, ())
            if boot_id < newest and boot_id not in listed
        }
        for name in unlisted & truck.unlisted:
            seen = self._seen.streams.get(name, Intervals())
            gone = self._gone.get(name, Intervals())
            for first, last in [*seen.gaps(), *seen.missing_of(gone.ranges())]:
                self._lost(*name, first, last)
        truck.unlisted = {name for name in truck.unlisted if name[0] != where} | unlisted

    def _ask(self, truck: _Truck, now_s: float) -> None:
        where, query = truck.todo.popleft()
        seen = self._seen.streams.get((where, query.boot_id), Intervals())
        missing = seen.missing_of([(query.first, query.last)])
        if not missing:  # it has come in the meantime
            return
        query = query._replace(first=missing[0][0], last=missing[-1][1])
        try:
            handler = self._bus.get(
                f"{spool_key(where)}?{query.parameters()}",
                handlers.FifoChannel(_MAX_REPLIES),
                target=zenoh.QueryTarget.ALL,
                consolidation=zenoh.ConsolidationMode.NONE,
                timeout=_PAGE_TIMEOUT_S,
                congestion_control=zenoh.CongestionControl.BLOCK,
                priority=zenoh.Priority.DATA_LOW,  # the reply's, too: live messages have priority
            )
        except zenoh.ZError as error:
            _log.debug("spool query: %s", error)
            _pause(truck, now_s)
            return
        truck.task = _Task(where, query, handler, now_s + 2 * _PAGE_TIMEOUT_S)

    def _read(self, truck: _Truck, task: _Task, now_s: float, received: list[RawSample]) -> None:
        for _ in range(_REPLIES_PER_STEP):
            try:
                reply = task.handler.try_recv()
            except zenoh.ZError:  # all have answered
                if task.is_ended:
                    self._page_complete(truck, task)
                else:
                    _failed(truck, task, now_s)
                return
            if reply is None:
                if now_s >= task.deadline_s:
                    _failed(truck, task, now_s)
                return
            task.replies += 1
            task.bytes += 0 if reply.ok is None else len(reply.ok.payload)
            if task.replies > _MAX_REPLIES or task.bytes > _MAX_BYTES:
                self._complaints.warn(
                    "long pages", "%s: spool: a page without end", task.where.identifier
                )
                _failed(truck, task, now_s)  # waiting answers are dropped with the handler
                return
            if reply.ok is None:
                continue
            sample = reply.ok
            attachment = None if sample.attachment is None else sample.attachment.to_bytes()
            payload = sample.payload.to_bytes()
            try:
                if attachment is None:
                    if _is_complete(task, decode_page(payload, task.query)):
                        self._page_complete(truck, task)
                        return
                    continue
                identity = decode_identity(attachment)
            except ValueError as error:
                self._complaints.warn("spool", "%s: spool: %s", task.where.identifier, error)
                continue
            boot_id, first, last = task.query
            if identity.boot_id == boot_id and first <= identity.sequence <= last:
                task.got.add(identity.sequence)
                seen = self._seen.streams.get((task.where, boot_id))
                if seen is None or identity.sequence not in seen:
                    received.append(RawSample(key(*task.where), payload, attachment, True, True))

    def _page_complete(self, truck: _Truck, task: _Task) -> None:
        truck.task = None
        truck.failures = 0
        where, (boot_id, first, last) = task.where, task.query
        if task.next_sequence is not None:
            truck.todo.appendleft((where, SpoolQuery(boot_id, task.next_sequence, last)))
            last = task.next_sequence - 1
        if truck.is_shared:
            return  # the truck that has them may not have answered
        seen = self._seen.streams.get((where, boot_id), Intervals())
        # Listed, but no longer readable: a damaged disk.
        for gap in task.got.missing_of([(first, last)]):
            for a, b in seen.missing_of([gap]):
                self._lost(where, boot_id, a, b)


def _turn(truck: _Truck, stream: str, boots: list[SpoolBoot]) -> list[SpoolBoot]:
    """Return the boots to compare now: the newest one, and others in turn."""
    earlier = boots[:-1]
    if len(earlier) > _BOOTS_AT_ONCE:
        first = truck.turn[stream] % len(earlier)
        truck.turn[stream] = first + _BOOTS_AT_ONCE
        earlier = (earlier + earlier)[first : first + _BOOTS_AT_ONCE]
    return [*earlier, boots[-1]]


def _failed(truck: _Truck, task: _Task, now_s: float) -> None:
    truck.task = None
    truck.todo.appendleft((task.where, task.query))
    _pause(truck, now_s)


def _pause(truck: _Truck, now_s: float) -> None:
    pause_s = min(_LONGEST_PAUSE_S, _FIRST_PAUSE_S * 2.0**truck.failures)
    truck.failures = min(truck.failures + 1, 10)
    truck.not_before_s = now_s + pause_s


def _note_shared(truck: _Truck, where: Key) -> None:
    if truck.is_shared:
        return
    truck.is_shared = True
    _log.warning(
        "%s; all their spools are read, but give each truck an id of its own",
        shared_name(where),
        extra=about(realm=where.realm, vehicle=where.identifier),
    )


def _is_complete(task: _Task, next_sequence: int | None) -> bool:
    """Note a closing page; return whether no other truck of this name may send more of it."""
    task.is_ended = True
    task.next_sequence = task.next_sequence if next_sequence is None else next_sequence
    last = task.query.last if task.next_sequence is None else task.next_sequence - 1
    return not task.got.missing_of([(task.query.first, last)])


def _under_way(truck: _Truck) -> list[tuple[Key, SpoolQuery]]:
    return [] if truck.task is None else [(truck.task.where, truck.task.query)]


def _without(ranges: Iterable[Range], others: Iterable[Range]) -> list[Range]:
    taken = Intervals()
    for first, last in others:
        taken.add_range(first, last)
    return taken.missing_of(ranges)


def _joined(ranges: Iterable[Range]) -> list[Range]:
    joined: list[Range] = []
    for first, last in ranges:
        if joined and first - joined[-1][1] <= _NEAR:
            joined[-1] = (joined[-1][0], last)
        else:
            joined.append((first, last))
    return joined
