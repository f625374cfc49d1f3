"""Completeness of recordings: nothing missing, nothing twice.

The receiving thread calls `step` and `report`; nothing in them waits.
"""

import logging
import time
from collections import Counter, deque
from collections.abc import Iterable, Iterator, Sequence
from itertools import chain, islice
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import zenoh
from zenoh import handlers

from schemas.topics import Key, is_from_recording, parse_key, selector, topic
from services.bus.subscription import RawSample
from services.common.errors import InputError
from services.common.intervals import Intervals
from services.common.log_lines import about
from services.logger.intake import Intake
from services.logger.rate_limited_log import RateLimitedLog
from services.logger.spool_recovery import REALMS_OF_ONE, SpoolRecovery
from services.recordings.recording import Identities, read_identities

__all__ = ["Completeness", "RecordedRange", "known_on_disk"]

_log = logging.getLogger(__name__)
KNOWN_AGE_S = 2 * 86_400.0
"""Largest age of recordings that are read at the start: older messages are already confirmed."""
_TRUCKS = 1000
"""Largest number of watched tokens (trucks times realms), which bounds memory."""
_TOKENS_WAITING = 1000
"""Tokens between two polls before the bus blocks."""
_HISTORY = 60
"""Number of reports over which rate and lag are computed; one a second."""
_KEPT_BY = ("vehicle", "bridge")
"""Owners whose publishers outlive a logger and send the next one everything again."""


class RecordedRange(NamedTuple):
    """Sequences in a recording of an earlier run."""

    where: Key
    boot_id: int
    first: int
    last: int


class DurableSink(Protocol):
    """The part of a writer that completeness needs."""

    withdrawn: deque[Identities]
    """Messages whose files are gone."""
    unwritten: deque[Identities]
    """Messages for which there was no file."""

    def mark_accounted(
        self, where: Key, boot_id: int, first: int, last: int, *, on_disk: bool
    ) -> None:
        """Note sequences that need not come: already on disk, or lost for ever."""

    def forget(self, names: Iterable[tuple[Key, int]]) -> None:
        """Remove these streams and boots from `durable`."""


def known_on_disk(folder: Path, realms: Sequence[str], now_s: float) -> Iterator[RecordedRange]:
    """Yield the content of recordings below a folder by stream, file by file.

    Only those of the last two days (`now_s` is the wall clock) and of realms in which trucks drive.
    A recording that is recovered meanwhile is found under its new name.
    """
    looked_at: set[Path] = set()
    # A file that has been renamed meanwhile is found under its new name.
    while found := sorted(
        {path for realm in realms for path in folder.glob(f"{realm}/*/[!.]*.mcap")} - looked_at
    ):
        looked_at.update(found)
        for path in found:
            try:
                if now_s - path.stat().st_mtime > KNOWN_AGE_S or path.stat().st_size == 0:
                    continue
                identities = read_identities(path)
            except (InputError, OSError) as error:
                if path.exists():
                    _log.warning("%s: not read: %s", path, error)
                continue
            for (where, boot_id), numbers in identities.items():
                if where.owner in _KEPT_BY and not is_from_recording(where.realm):
                    for first, last in numbers.ranges():
                        yield RecordedRange(where, boot_id, first, last)


class Completeness:
    """The messages on disk, those on trucks, and the trucks that are present."""

    def __init__(
        self,
        bus: zenoh.Session,
        folder: Path | None,
        realms: Sequence[str],
        intake: Intake,
        writer: DurableSink,
    ) -> None:
        """Read the recordings of earlier runs in `folder`; None: this run has a file of its own."""
        self._intake = intake
        self._writer = writer
        self._latched: dict[tuple[Key, int], Intervals] = {}
        self._gone: Identities = {}
        self._gone_for_ever = 0
        if folder is not None:
            for known in known_on_disk(folder, realms, time.time()):
                self._on_disk(*known)
        self._recovery = SpoolRecovery(
            bus, realms, intake.seen, gone=self._gone, confirmed=self._on_disk, lost=self._lost
        )
        self._alive: dict[tuple[str, str], bool] = {}
        self._alive_of: Counter[str] = Counter()
        self._tokens: list[Any] = [
            bus.liveliness().declare_subscriber(
                selector(realm, "vehicle", "alive"),
                handlers.FifoChannel(_TOKENS_WAITING),
                history=True,
            )
            for realm in realms
        ]
        self._complaints = RateLimitedLog(_log)
        self._figures: dict[str, float] = {}
        self._history: deque[tuple[float, int, float]] = deque(maxlen=_HISTORY)

    def step(self, now_s: float, *, hold: bool = False) -> list[RawSample]:
        """Return messages that trucks sent again. With `hold`, request no more of them now."""
        return self._recovery.step(now_s, hold=hold)

    def report(self, now_s: float) -> None:
        """Update the writer with sequences that need not come any more, and count."""
        intake = self._intake
        while self._writer.withdrawn:
            self._withdraw(self._writer.withdrawn.popleft())
        for where, boot_id, first, last in intake.settled:
            self._writer.mark_accounted(where, boot_id, first, last, on_disk=False)
        intake.settled.clear()
        if intake.forgotten:
            self._writer.forget(intake.forgotten)
            for name in intake.forgotten:
                self._latched.pop(name, None)
            intake.forgotten.clear()
        while self._writer.unwritten:
            for (where, boot_id), numbers in self._writer.unwritten.popleft().items():
                intake.forget_seen(where, boot_id, numbers)
                self._recovery.pause(where, now_s)
        self._read_tokens(now_s)
        self._complaints.flush()
        self._figures = self._counted(now_s)

    def gone(self) -> int:
        """Return the number of messages in lost files that have not come again."""
        seen = self._intake.seen.streams
        return self._gone_for_ever + sum(
            last - first + 1
            for name, numbers in self._gone.items()
            for first, last in seen.get(name, Intervals()).missing_of(numbers.ranges())
        )

    def figures(self) -> dict[str, float]:
        """Return the last counts of `report`; thread-safe."""
        return self._figures

    def close(self) -> None:
        """Stop all queries."""
        for tokens in self._tokens:
            tokens.undeclare()
        self._recovery.close()
        self._complaints.flush(closing=True)

    def _on_disk(self, where: Key, boot_id: int, first: int, last: int) -> None:
        if topic(where.owner, where.stream).latched:
            # Known, but written again when it comes: every file has its own copy.
            known = self._latched.setdefault((where, boot_id), Intervals())
            if known.add_range(first, last):
                self._writer.mark_accounted(where, boot_id, first, last, on_disk=True)
        elif self._intake.adopt(where, boot_id, first, last, time.time_ns()):
            self._writer.mark_accounted(where, boot_id, first, last, on_disk=True)

    def _withdraw(self, identities: Identities) -> None:
        for (where, boot_id), numbers in identities.items():
            if (where.identifier, boot_id) != (self._intake.own_service, self._intake.own_boot_id):
                self._intake.forget_seen(where, boot_id, numbers)
                gone = self._gone.setdefault((where, boot_id), Intervals())
                for first, last in numbers.ranges():
                    gone.add_range(first, last)

    def _lost(self, where: Key, boot_id: int, first: int, last: int) -> None:
        gone = self._gone.get((where, boot_id))
        if gone is not None:
            self._gone_for_ever += gone.remove_range(first, last)
        self._intake.mark_lost(where, boot_id, first, last, time.time_ns())

    def _read_tokens(self, now_s: float) -> None:
        waiting = (islice(iter(one.try_recv, None), _TOKENS_WAITING) for one in self._tokens)
        for sample in chain.from_iterable(waiting):
            try:
                where = parse_key(str(sample.key_expr))
            except ValueError as error:
                self._complaints.warn("liveliness", "liveliness: %s", error)
                continue
            name = (where.realm, where.identifier)
            if name not in self._alive:
                number = self._alive_of[where.identifier]
                if number >= REALMS_OF_ONE or len(self._alive) >= _TRUCKS:
                    continue
                self._alive_of[where.identifier] += 1
            is_here = sample.kind == zenoh.SampleKind.PUT
            if self._alive.get(name, False) != is_here:
                if is_here:
                    self._recovery.hurry(now_s)
                event = "connected" if is_here else "disconnected"
                fields = about(realm=where.realm, vehicle=where.identifier)
                _log.info("%s in realm %s %s", name[1], name[0], event, extra=fields)
            self._alive[name] = is_here

    def _counted(self, now_s: float) -> dict[str, float]:
        self._history.append((now_s, self._intake.counts["received"], self._intake.lag_s()))
        (first_s, before, _), (last_s, received, _) = self._history[0], self._history[-1]
        alive = {f"alive/{vehicle}": float(here) for (_, vehicle), here in self._alive.items()}
        return (
            {
                "rate_per_s": (received - before) / max(1.0, last_s - first_s),
                "lag_s": max(lag_s for _, _, lag_s in self._history),
                "gone": float(self.gone()),
                "to_fetch": float(self._recovery.waiting()),
                "trucks_alive": sum(alive.values()),
            }
            | alive
            | self._intake.clock_figures()
        )
