"""Backfill: crossings that are no longer sent, read from a logger's recordings.

At the start all recordings are scanned, also growing ones, and from then on each one that is
closed. A process of low priority does this; it exists only while there is something to read.
Crossings found stay in the recordings until no crossing of a live truck waits for a process; a few
at a time are held in memory.
"""

import logging
import os
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Final, NamedTuple

from schemas.settings import IdentificationSettings
from schemas.signals import NS_PER_S
from schemas.site import Site
from schemas.validation_records import VehicleBridgePair
from services.execution.processes import BackgroundResult, BackgroundTask, ProcessExecutor
from services.finding.stays import Passage, are_one, overlap
from services.identification.engine import Engine
from services.identification.known import CrossingRecord
from services.identification.outputs import EngineOutput
from services.identification.waiting import CrossingFromRecording
from services.ledger.crossing_log import Ledger
from services.ledger.recorded_crossings import (
    AROUND_NS,
    FetchResult,
    RecordedStay,
    StayScan,
    fetch_crossings,
    scan_stays,
)
from services.worker.recording_list import BackfillSource, RecordingGroup, RecordingList

_log = logging.getLogger(__name__)
MARGIN_S: Final = 86_400.0
"""Time in s by which a result may be older than its recording, as spools arrive late."""
_SCAN_EVERY_S: Final = 10.0
_FETCH_EVERY_S: Final = 1.0
_TRANSIT_NS: Final = 5 * NS_PER_S
"""Time in which the truck itself is about to send what the logger has received."""
_AT_ONCE: Final = 3
"""Number of crossings held in memory, half a megabyte each or more."""
_NICE: Final = 10
_Request = Callable[[VehicleBridgePair], None]


class WaitingCounts(NamedTuple):
    """Numbers of recorded crossings without a result that are not in progress."""

    for_process: int = 0
    for_validation: int = 0
    for_data: int = 0
    """Number of crossings whose missing samples may still arrive."""

    @property
    def total(self) -> int:
        """Number of all these crossings."""
        return sum(self)


class _MissingStay(NamedTuple):
    """A stay without a result."""

    stay: RecordedStay
    files: tuple[Path, ...]
    """Files with data of the stay."""


class Backfill:
    """Scan, fetch and hand-over of recorded crossings; used by one thread."""

    def __init__(
        self,
        source: BackfillSource,
        site: Site,
        settings: IdentificationSettings,
        ledger: Ledger,
        *,
        reader: Callable[[], ProcessExecutor] = lambda: ProcessExecutor(1, prepare=_lower_priority),
    ) -> None:
        self._source = source
        self._site = site
        self._settings = settings
        self._ledger = ledger
        self._open_reader = reader
        self._reader: ProcessExecutor | None = None
        self._recordings = RecordingList(source)
        self._next_scan_s = self._next_fetch_s = 0.0
        self._scanning: RecordingGroup | None = None
        self._stays: dict[str, list[_MissingStay]] = {}
        """All stays in recordings by vehicle: other trucks on the bridge matter too."""
        self._open: list[_MissingStay] = []
        """Stays without a known result."""
        self._fetching: tuple[_MissingStay, ...] = ()
        self._is_final = False
        self._found: deque[tuple[RecordedStay, CrossingFromRecording]] = deque()
        self._given_up: set[RecordedStay] = set()
        self._later: dict[RecordedStay, int] = {}
        """Stays with missing data, with the number of scans up to then."""
        self._reads = 0
        self._warned: set[str] = set()
        self._asked: set[VehicleBridgePair] = set()
        self._next_count_s = 0.0
        self.waiting = WaitingCounts()

    def close(self) -> None:
        """End the reading process."""
        if self._reader is not None:
            self._reader.close()
            self._reader = None

    def retarget(self, site: Site) -> None:
        """Continue with the bridges and trucks of another site file."""
        self._site = site
        self._recordings.clear()
        self._stays.clear()
        self._open.clear()
        self._given_up.clear()
        self._later.clear()
        self._asked.clear()
        self._found.clear()
        self._scanning, self._fetching = None, ()
        self._next_scan_s = 0.0
        self.close()

    def advance(
        self, engine: Engine, now_s: float, *, has_room: bool, want: _Request
    ) -> Iterator[EngineOutput]:
        """Advance by any steady clock; yield the engine's messages about a crossing handed to it.

        A crossing is handed over if it `has_room`: if no other one waits. `want` is called with
        pairs whose site validation recorded crossings wait for.
        """
        if now_s >= self._next_scan_s:
            self._next_scan_s = now_s + _SCAN_EVERY_S
            now = time.time()
            self._recordings.update(now, self._scanning)
            engine.note_recorded(self._recordings.until_ns)
            self._ledger.forget_before(now - self._source.age_s - MARGIN_S)
        self._collect()
        self._ledger.commit(time.time())
        if now_s >= self._next_count_s:
            self._next_count_s = now_s + _FETCH_EVERY_S
            self._count(engine, want)
        if self._scanning is None and not self._fetching:
            if self._recordings.groups:
                self._begin_scan(self._recordings.groups.popleft())
            elif now_s >= self._next_fetch_s and not self._found:
                self._next_fetch_s = now_s + _FETCH_EVERY_S
                self._fetch(engine, want)
        if has_room and self._found:
            stay, found = self._found.popleft()
            if self._is_open(engine, stay):
                yield from engine.take(found, self._others(found))
            self._next_count_s = 0.0
        if not (self._recordings.groups or self._scanning or self._fetching or self._found):
            self.close()

    # The reading process.

    def _submit(self, task: BackgroundTask) -> None:
        if self._reader is None:
            self._reader = self._open_reader()
        self._reader.submit_background(task)

    def _collect(self) -> None:
        if self._reader is None:
            return
        self._reader.collect()
        for finished in self._reader.collect_background():
            if self._scanning is not None and finished.task.name.startswith("scan"):
                self._finish_scan(self._scanning, finished)
                self._scanning = None
            elif self._fetching and finished.task.name.startswith("fetch"):
                self._finish_fetch(finished)
                self._fetching = ()

    def _begin_scan(self, group: RecordingGroup) -> None:
        self._scanning = group
        paths = tuple(file.path for file in group.files if file.path.exists())
        run = partial(scan_stays, paths, self._source.realm, group.vehicle, self._site)
        self._submit(BackgroundTask(f"scan recordings of {group.vehicle}", run))

    def _finish_scan(self, group: RecordingGroup, finished: BackgroundResult) -> None:
        scan = finished.outcome
        if not isinstance(scan, StayScan):
            names = ", ".join(file.path.name for file in group.files)
            self._warn(f"{names}: unreadable; skipping the crossings in them")
            return
        for warning in scan.warnings:
            self._warn(warning)
        known = self._stays.setdefault(group.vehicle, [])
        for stay in scan.stays:
            files = tuple(
                path
                for path, (first_ns, last_ns) in scan.ranges.items()
                if first_ns <= stay.exit_ns + AROUND_NS and stay.entry_ns - AROUND_NS <= last_ns
            )
            found = stay
            for one in [one for one in known if _is_same(one.stay, stay)]:
                known.remove(one)  # from the preceding file, or an earlier state of a growing one
                files = tuple(dict.fromkeys((*one.files, *files)))
                if one.stay.passage is Passage.THROUGH:
                    found = one.stay
            known.append(_MissingStay(found, files))
        self._reads += 1
        oldest_ns = round((time.time() - self._source.age_s) * NS_PER_S)
        known[:] = [one for one in known if one.stay.received_ns >= oldest_ns]
        if group.vehicle in {vehicle.id for vehicle in self._site.vehicles}:
            self._open = [one for one in self._open if one.stay.vehicle != group.vehicle]
            self._open += [one for one in known if not self._is_over(one.stay)]
            self._open.sort(key=lambda one: one.stay.entry_ns)

    def _warn(self, warning: str) -> None:
        if warning not in self._warned:
            self._warned.add(warning)
            _log.warning("%s", warning)

    # The crossings to fetch.

    def _count(self, engine: Engine, want: _Request) -> list[_MissingStay]:
        """Count the waiting crossings and request validations; return those that may be fetched."""
        self._open = [
            m for m in self._open if m.stay not in self._given_up and not self._is_over(m.stay)
        ]
        waiting = [one for one in self._open if self._is_open(engine, one.stay)]
        proven = [one for one in waiting if engine.is_certified(_pair_of(one.stay))]
        due = [one for one in proven if self._is_due(one.stay)]
        self.waiting = WaitingCounts(len(due), len(waiting) - len(proven), len(proven) - len(due))
        for pair in dict.fromkeys(_pair_of(one.stay) for one in waiting):
            if pair not in self._asked and not engine.is_certified(pair):
                self._asked.add(pair)
                want(pair)
        return due

    def _fetch(self, engine: Engine, want: _Request) -> None:
        """Fetch the next crossings that may be identified, of one boot of a truck."""
        ready = self._count(engine, want)
        if ready:
            first = ready[0].stay
            boot = (first.vehicle, first.boot_id)
            same = (one for one in ready if (one.stay.vehicle, one.stay.boot_id) == boot)
            self._begin_fetch(tuple(islice(same, _AT_ONCE)))

    def _begin_fetch(self, wanted: tuple[_MissingStay, ...]) -> None:
        self._fetching = wanted
        vehicle = wanted[0].stay.vehicle
        self._is_final = vehicle in self._recordings.final
        paths = dict.fromkeys(path for one in wanted for path in one.files)
        known = {
            k.crossing_id: k
            for one in wanted
            for k in self._ledger.about(self._source.realm, vehicle, one.stay.bridge)
            if _belongs_to(k, one.stay)
        }
        run = partial(
            fetch_crossings,
            tuple(path for path in paths if path.exists()),
            self._source.realm,
            tuple(one.stay for one in wanted),
            tuple(known.values()),
            self._site,
            self._settings,
            is_final=self._is_final,
        )
        self._submit(BackgroundTask(f"fetch crossings of {vehicle}", run))

    def _is_due(self, stay: RecordedStay) -> bool:
        """Return whether it may be complete by now; an incomplete one waits for another scan."""
        before = self._later.get(stay)
        return before is None or before < self._reads or stay.vehicle in self._recordings.final

    def _finish_fetch(self, finished: BackgroundResult) -> None:
        fetched = finished.outcome
        if not isinstance(fetched, FetchResult):
            self._given_up |= {one.stay for one in self._fetching}
            return
        self._found += fetched.found
        for stay in fetched.missing:
            if self._is_final:
                self._given_up.add(stay)
                self._warn(
                    f"{stay.vehicle} on {stay.bridge}: its recording shows too little of the "
                    "crossing to judge it"
                )
            self._later[stay] = self._reads

    def _is_over(self, stay: RecordedStay) -> bool:
        """Return whether a stay has a result, by whatever search."""
        return any(
            (known.is_identified or known.has_other_result) and _belongs_to(known, stay)
            for known in self._ledger.about(self._source.realm, stay.vehicle, stay.bridge)
        )

    def _is_open(self, engine: Engine, stay: RecordedStay) -> bool:
        """Return whether a stay has no result, is not in progress and will not be sent again."""
        if stay.received_ns > time.time_ns() - _TRANSIT_NS or self._is_over(stay):
            return False
        realm = self._source.realm
        if engine.is_tracking(realm, stay.vehicle, stay.boot_id, stay.bridge, stay.entry_s):
            return False
        in_hand = engine.pending_ids()
        return not any(
            known.crossing_id in in_hand and _belongs_to(known, stay)
            for known in self._ledger.about(realm, stay.vehicle, stay.bridge)
        )

    def _others(self, found: CrossingFromRecording) -> Iterable[str]:
        """Return the other trucks on the bridge, as their recordings show."""
        data = found.pending.task.data
        return {
            vehicle
            for vehicle, known in self._stays.items()
            if vehicle != data.vehicle.id
            for one in known
            if one.stay.bridge == data.bridge.id
            and overlap(one.stay.entry_ns, one.stay.exit_ns, found.entry_ns, found.exit_ns)
        }


def _pair_of(stay: RecordedStay) -> VehicleBridgePair:
    return VehicleBridgePair(stay.vehicle, stay.bridge)


def _is_same(one: RecordedStay, other: RecordedStay) -> bool:
    if (one.boot_id, one.bridge) != (other.boot_id, other.bridge):
        return False
    return _near(one.entry_ns, one.exit_ns, other)


def _belongs_to(known: CrossingRecord, stay: RecordedStay) -> bool:
    """Return whether a stay belongs to a known crossing; see `is_stay_of`."""
    return _near(known.entry_ns, known.exit_ns, stay)


def _near(entry_ns: int, exit_ns: int, stay: RecordedStay) -> bool:
    return are_one(entry_ns, max(exit_ns, entry_ns + 1), stay.entry_ns, stay.exit_ns)


def _lower_priority() -> None:
    """Lower the priority below that of identification and reception."""
    os.nice(_NICE)
