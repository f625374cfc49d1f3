"""Crossings that nobody sends any more, from recordings: looked for, fetched, taken in.

Looked for at the start in all recordings, also in those that are being written, and from then on in
each when it is closed. That is done in a process of its own and of low priority, which is there
only while there is something to read. What is found waits in the recordings until no crossing of a
living truck waits for a process; a few at a time are held here.
"""

import logging
import os
import re
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Final, NamedTuple

from schemas.certificates import Pair
from schemas.results import Header
from schemas.settings import IdentificationSettings
from schemas.signals import NS_PER_S
from schemas.site import Site
from schemas.topics import IDENTIFIER
from services.common.errors import InputError
from services.execution.processes import Aftermath, Aside, Processes
from services.history.recorded import AROUND_NS, Looked, Stayed, Taken, look, take
from services.history.store import Ledger
from services.identification.engine import Engine
from services.identification.known import Known, are_one, overlap
from services.identification.outputs import Said
from services.identification.remembered import Found
from services.identification.stays import Passage
from services.recordings.recording import is_being_written

_log = logging.getLogger(__name__)
DAYS: Final = 2.0
"""So far back recordings are looked through: what is older somebody has asked for already."""
MARGIN_S: Final = 86_400.0
"""By so much a result may be older than the recording of its crossing: spools come late."""
_LOOK_EVERY_S: Final = 10.0
_RECORDED_S: Final = 60.0
"""A recording that has grown in this time is being written; the logger syncs twice a second."""
_QUIET_S: Final = 120.0
"""So long after the last of a truck was recorded what is missing is taken to be lost, as it is by
who listens (`arrivals`)."""
_FETCH_EVERY_S: Final = 1.0
_SETTLED_S: Final = 5.0
"""What the logger had later than this ago its truck is about to send here, too."""
_FILES_AT_ONCE: Final = 4
"""An hour of a truck, with the file before them, which a crossing may have begun in."""
_AT_ONCE: Final = 3
"""Crossings that are held here, half a megabyte each or more."""
_NICE: Final = 10
_NAME: Final = re.compile(rf"({IDENTIFIER})-\d{{8}}T\d{{6}}Z(?:-\d+)?(?:\.recovered)?\.mcap")
_Signature = tuple[int, int]
"""Size, and time of the last change in ns."""


class Source(NamedTuple):
    """Which recordings are looked through."""

    folder: Path
    """The logger's."""
    realm: str
    age_s: float


class _File(NamedTuple):
    path: Path
    signature: _Signature
    is_growing: bool


class _Group(NamedTuple):
    """Recordings of one truck that follow each other; the first may be there for what it began."""

    vehicle: str
    files: tuple[_File, ...]


class _Wanted(NamedTuple):
    """A stay that has no result."""

    stay: Stayed
    files: tuple[Path, ...]
    """That hold something of it."""


class CatchingUp:
    """Looks, fetches and hands over; used by one thread."""

    def __init__(
        self,
        source: Source,
        site: Site,
        settings: IdentificationSettings,
        header: Header,
        ledger: Ledger,
        *,
        reader: Callable[[], Processes] = lambda: Processes(1, prepare=_gently),
        look_every_s: float = _LOOK_EVERY_S,
        settled_s: float = _SETTLED_S,
        quiet_s: float = _QUIET_S,
    ) -> None:
        self._source = source
        self._site = site
        self._settings = settings
        self._header = header
        self._ledger = ledger
        self._open_reader = reader
        self._reader: Processes | None = None
        self._look_every_s = look_every_s
        self._settled_ns = round(settled_s * NS_PER_S)
        self._quiet_s = quiet_s
        self._next_look_s = self._next_fetch_s = 0.0
        self._is_first = True
        self._read: dict[Path, _Signature] = {}
        self._groups: deque[_Group] = deque()
        self._looking: _Group | None = None
        self._stays: dict[str, list[_Wanted]] = {}
        """By vehicle, all that was found in recordings: who else was there counts, too."""
        self._open: list[_Wanted] = []
        """Those of them that have no result, as far as is known."""
        self._final: set[str] = set()
        """Trucks of which nothing more is recorded."""
        self._taking: tuple[_Wanted, ...] = ()
        self._is_final = False
        self._found: deque[tuple[Stayed, Found]] = deque()
        self._given_up: set[Stayed] = set()
        self._later: dict[Stayed, int] = {}
        """Those in which something is missing, and how often had been read by then."""
        self._reads = 0
        self._warned: set[str] = set()
        self._asked: set[Pair] = set()
        self.waiting = 0
        """How many crossings in recordings have no result, as far as it is known."""

    def close(self) -> None:
        """End the process that reads."""
        if self._reader is not None:
            self._reader.close()
            self._reader = None

    def retarget(self, site: Site, header: Header) -> None:
        """From now on the bridges and trucks of another site file."""
        self._site, self._header = site, header
        self._read.clear()
        self._groups.clear()
        self._stays.clear()
        self._open.clear()
        self._given_up.clear()
        self._later.clear()
        self._asked.clear()
        self._found.clear()
        self._looking, self._taking = None, ()
        self._next_look_s = 0.0
        self.close()

    def advance(
        self, engine: Engine, now_s: float, *, has_room: bool, want: Callable[[Pair], None]
    ) -> Iterator[Said]:
        """Go on by any steady clock; yield what the engine says of a crossing it is given.

        It is given one if it `has_room`: if no other crossing waits. `want` is told of pairs whose
        certificates crossings in recordings wait for.
        """
        if now_s >= self._next_look_s:
            self._next_look_s = now_s + self._look_every_s
            self._list(engine)
        self._hear()
        self._ledger.settle(time.time())
        if self._looking is None and not self._taking:
            if self._groups:
                self._begin_look(self._groups.popleft())
            elif now_s >= self._next_fetch_s and not self._found:
                self._next_fetch_s = now_s + _FETCH_EVERY_S
                self._fetch(engine, want)
        if has_room and self._found:
            stay, found = self._found.popleft()
            if self._is_open(engine, stay):
                yield from engine.take(found, self._others(found))
        if not (self._groups or self._looking or self._taking or self._found):
            self.close()

    # What there is to read

    def _list(self, engine: Engine) -> None:
        """See which recordings have changed, and who is being recorded."""
        by_vehicle: dict[str, list[_File]] = {}
        now = time.time()
        for path in sorted((self._source.folder / self._source.realm).glob("*/*.mcap")):
            named = _NAME.fullmatch(path.name)
            if named is None:
                continue
            try:
                status = path.stat()
                if now - status.st_mtime > self._source.age_s:
                    continue
                is_fresh = now - status.st_mtime < _RECORDED_S
                is_growing = is_fresh and is_being_written(path)
            except (InputError, OSError):
                continue  # it was recovered or deleted in this moment
            signature = (status.st_size, status.st_mtime_ns)
            by_vehicle.setdefault(named[1], []).append(_File(path, signature, is_growing))
        growing = {v for v, files in by_vehicle.items() if any(f.is_growing for f in files)}
        engine.recorded = frozenset(growing)
        quiet_ns = round((now - self._quiet_s) * NS_PER_S)
        self._final = {
            vehicle
            for vehicle, files in by_vehicle.items()
            if vehicle not in growing and max(f.signature[1] for f in files) < quiet_ns
        }
        seen = {file.path for files in by_vehicle.values() for file in files}
        self._read = {path: signature for path, signature in self._read.items() if path in seen}
        for vehicle, files in by_vehicle.items():
            self._groups += self._changed(vehicle, files)
        self._is_first = False
        self._ledger.forget_told_before(now - self._source.age_s - MARGIN_S)

    def _changed(self, vehicle: str, files: list[_File]) -> Iterator[_Group]:
        """Those that have not been read as they are now, with the ones before them."""
        waiting = {f.path for group in self._groups for f in group.files[1:]}
        if self._looking is not None:
            waiting |= {f.path for f in self._looking.files}
        new = [
            n
            for n, file in enumerate(files)
            if self._read.get(file.path) != file.signature
            and file.path not in waiting
            and (self._is_first or not file.is_growing)
        ]
        while new:
            part = [n for n in new[:_FILES_AT_ONCE] if n - new[0] < _FILES_AT_ONCE]
            new = new[len(part) :]
            begin = max(part[0] - 1, 0)
            for n in part:
                self._read[files[n].path] = files[n].signature
            yield _Group(vehicle, tuple(files[begin : part[-1] + 1]))

    # The process that reads

    def _aside(self, aside: Aside) -> None:
        if self._reader is None:
            self._reader = self._open_reader()
        self._reader.start_aside(aside)

    def _hear(self) -> None:
        if self._reader is None:
            return
        self._reader.finished()
        for aftermath in self._reader.aftermaths():
            if self._looking is not None and aftermath.aside.name.startswith("look"):
                self._has_looked(self._looking, aftermath)
                self._looking = None
            elif self._taking and aftermath.aside.name.startswith("take"):
                self._has_taken(aftermath)
                self._taking = ()

    def _begin_look(self, group: _Group) -> None:
        self._looking = group
        paths = tuple(file.path for file in group.files)
        run = partial(look, paths, self._source.realm, group.vehicle, self._site)
        self._aside(Aside(f"look into recordings of {group.vehicle}", run))

    def _has_looked(self, group: _Group, aftermath: Aftermath) -> None:
        looked = aftermath.outcome
        if not isinstance(looked, Looked):
            names = ", ".join(file.path.name for file in group.files)
            self._warn(f"{names}: could not be read, crossings in them are left out")
            return
        for warning in looked.warnings:
            self._warn(warning)
        known = self._stays.setdefault(group.vehicle, [])
        for stay in looked.stays:
            files = tuple(
                path
                for path, (first_ns, last_ns) in looked.ranges.items()
                if first_ns <= stay.exit_ns + AROUND_NS and stay.entry_ns - AROUND_NS <= last_ns
            )
            found = stay
            for one in [one for one in known if _is_same(one.stay, stay)]:
                known.remove(one)  # of the file before, or of one that has grown
                files = tuple(dict.fromkeys((*one.files, *files)))
                if one.stay.passage is Passage.THROUGH:
                    found = one.stay
            known.append(_Wanted(found, files))
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

    # What is fetched

    def _fetch(self, engine: Engine, want: Callable[[Pair], None]) -> None:
        """Fetch the next crossings that may be identified, of one boot of a truck."""
        self._open = [
            one
            for one in self._open
            if one.stay not in self._given_up and not self._is_over(one.stay)
        ]
        ready = []
        self.waiting = 0
        for one in self._open:
            if not self._is_open(engine, one.stay):
                continue
            self.waiting += 1
            pair = Pair(one.stay.vehicle, one.stay.bridge)
            if not engine.is_certified(pair):
                if pair not in self._asked:
                    self._asked.add(pair)
                    want(pair)
            elif self._is_due(one.stay):
                ready.append(one)
        if ready:
            first = ready[0].stay
            whose = (first.vehicle, first.boot_id)
            same = (one for one in ready if (one.stay.vehicle, one.stay.boot_id) == whose)
            self._begin_take(tuple(islice(same, _AT_ONCE)))

    def _begin_take(self, wanted: tuple[_Wanted, ...]) -> None:
        self._taking = wanted
        vehicle = wanted[0].stay.vehicle
        self._is_final = vehicle in self._final
        paths = dict.fromkeys(path for one in wanted for path in one.files)
        known = {
            k.crossing_id: k
            for one in wanted
            for k in self._ledger.about(self._source.realm, vehicle, one.stay.bridge)
            if _is_about(k, one.stay)
        }
        run = partial(
            take,
            tuple(path for path in paths if path.exists()),
            self._source.realm,
            tuple(one.stay for one in wanted),
            tuple(known.values()),
            self._site,
            self._settings,
            self._header,
            is_final=self._is_final,
        )
        self._aside(Aside(f"take crossings of {vehicle}", run))

    def _is_due(self, stay: Stayed) -> bool:
        """Whether it may be whole by now; one that was not is asked for when more has been read."""
        before = self._later.get(stay)
        return before is None or before < self._reads or stay.vehicle in self._final

    def _has_taken(self, aftermath: Aftermath) -> None:
        taken = aftermath.outcome
        if not isinstance(taken, Taken):
            self._given_up |= {one.stay for one in self._taking}
            return
        self._found += taken.found
        for stay in taken.missing:
            if self._is_final:
                self._given_up.add(stay)
                self._warn(
                    f"{stay.vehicle} on {stay.bridge}: its recording does not hold enough of a "
                    "crossing to decide it"
                )
            self._later[stay] = self._reads

    def _is_over(self, stay: Stayed) -> bool:
        """Whether a stay has a result, by whatever search."""
        return any(
            (known.is_identified or known.has_other_result) and _is_about(known, stay)
            for known in self._ledger.about(self._source.realm, stay.vehicle, stay.bridge)
        )

    def _is_open(self, engine: Engine, stay: Stayed) -> bool:
        """Whether nobody has identified a stay, is about to, or will be sent it by its truck."""
        if stay.received_ns > time.time_ns() - self._settled_ns or self._is_over(stay):
            return False
        realm = self._source.realm
        if engine.has_in_hand(realm, stay.vehicle, stay.boot_id, stay.bridge, stay.entry_s):
            return False
        in_hand = engine.ids_in_hand()
        return not any(
            known.crossing_id in in_hand and _is_about(known, stay)
            for known in self._ledger.about(realm, stay.vehicle, stay.bridge)
        )

    def _others(self, found: Found) -> Iterable[str]:
        """Who else was on the bridge, as their recordings tell."""
        data = found.waiting.work.data
        return {
            vehicle
            for vehicle, known in self._stays.items()
            if vehicle != data.vehicle.id
            for one in known
            if one.stay.bridge == data.bridge.id
            and overlap(one.stay.entry_ns, one.stay.exit_ns, found.entry_ns, found.exit_ns)
        }


def _is_same(one: Stayed, other: Stayed) -> bool:
    if (one.boot_id, one.bridge) != (other.boot_id, other.bridge):
        return False
    return _near(one.entry_ns, one.exit_ns, other)


def _is_about(known: Known, stay: Stayed) -> bool:
    """Whether a stay is a crossing of the same truck and bridge; see `is_stay_of`."""
    return _near(known.entry_ns, known.exit_ns, stay)


def _near(entry_ns: int, exit_ns: int, stay: Stayed) -> bool:
    return are_one(entry_ns, max(exit_ns, entry_ns + 1), stay.entry_ns, stay.exit_ns)


def _gently() -> None:
    """Give way to what identifies and listens."""
    os.nice(_NICE)
