"""The worker's results on disk, of this run and of earlier runs.

Every run has a file of its own, `results-TIME.mcap`, with the messages that it published, and all
results of that file as JSON next to it. Together the files of a folder hold each result once.
"""

import logging
from collections import Counter, defaultdict, deque
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

from google.protobuf.message import DecodeError

from schemas.errors import InputError
from schemas.proto import driveby_pb2 as pb
from schemas.results import BridgeResult, CrossingResult, ResultHeader, load_results
from schemas.results_on_the_wire import state_to_bridge
from schemas.signals import NS_PER_S, Identity
from schemas.topics import Key, Message
from services.common.errors import FailureError
from services.common.files import replaced_atomically
from services.identification.bridge_state import (
    NOTHING_STORED,
    BridgeStateCache,
    FusionSettings,
    RecentCrossings,
    add_crossings,
    usable,
)
from services.identification.known import CrossingRecord, search_hash
from services.ledger.crossing_log import CrossingLog, PublishedResult
from services.ledger.growing_json import AppendableResults
from services.ledger.worker_results import files_of_workers
from services.recordings.recording import is_being_written, read_info, read_messages
from services.recordings.recovery import NOT_FINISHED
from services.recordings.writer import RecordingOrigin, RecordingWriter

_log = logging.getLogger(__name__)
KNOWN_AGE_S = 2 * 86_400.0
"""Maximum age of files to read: no truck still sends crossings of older ones."""
_UNCONFIRMED_NS = 60 * NS_PER_S
"""Span before a run's end in which its messages may not have reached every subscriber.

The run may have been killed, or the router lost, of which a publisher learns nothing.
"""


class ResultFiles:
    """Results of a run, as a recording and as JSON next to it; created with the first message."""

    def __init__(
        self,
        path: Path,
        site_toml: str,
        header: ResultHeader,
        previous: str | None,
        note: Callable[[Key, bytes], None] | None = None,
    ) -> None:
        """Prepare the files; `previous` is the name of the previous run's file, if any.

        `note` is called with every message that is on the disk.
        """
        self._note = note
        self.path = path
        self._site_toml = site_toml
        self._json = AppendableResults(path.with_suffix(".json"), header)
        self._previous = previous
        self._writer: RecordingWriter | None = None
        self._sequences: Counter[Key] = Counter()
        self._crossings = 0

    def next_identity(self, key: Key, boot_id: int) -> Identity:
        """Return the identity of the next message of a key."""
        return Identity(boot_id, self._sequences[key])

    def write(
        self, message: Message, result: CrossingResult | None, bridges: dict[str, BridgeResult]
    ) -> None:
        """Write a message to the disk, and a result or a state to the JSON file too.

        Raise FailureError if that is not possible.
        """
        try:
            self._write(message, result, bridges)
        except OSError as error:
            raise FailureError(f"{self.path}: cannot be written: {error.strerror}") from error

    def _write(
        self, message: Message, result: CrossingResult | None, bridges: dict[str, BridgeResult]
    ) -> None:
        if self._writer is None:
            self._writer = RecordingWriter(
                self.path,
                reason="first result",
                origin=RecordingOrigin(message.key.realm, site_toml=self._site_toml),
                previous=self._previous,
            )
        self._writer.write(message)
        self._writer.sync()
        self._sequences[message.key] += 1
        if self._note is not None:
            self._note(message.key, message.payload)
        if result is not None:
            self._crossings += 1
            self._json.add(result, bridges)
        elif message.key.stream == "state":
            self._json.replace_bridges(bridges)

    def rotate(self, path: Path, site_toml: str, header: ResultHeader) -> None:
        """Continue in another file, which belongs to another site file.

        The messages keep their sequence numbers. Raise FailureError if this file cannot be closed.
        """
        if self._writer is not None:
            self.finish("another site file")
            self._previous = self.path.name
        self.path, self._site_toml = path, site_toml
        self._json = AppendableResults(path.with_suffix(".json"), header)
        self._writer, self._crossings = None, 0

    def finish(self, reason: str = "stopped by a signal") -> None:
        """Close the recording of a run that ended normally. Raise FailureError if that fails."""
        if self._writer is None:
            return
        try:
            self._writer.finish(reason, {"crossings": self._crossings})
        except OSError as error:
            self._writer.abandon()
            raise FailureError(f"{self.path}: cannot be ended: {error.strerror}") from error

    def abandon(self) -> None:
        """Close the recording of a failed run without an END.

        The messages at its end may not have been published.
        """
        if self._writer is not None:
            self._writer.abandon()


def free_results_path(folder: Path) -> Path:
    """Return an unused path for the results of a run, or part of a run, that starts now."""
    stem = f"results-{datetime.now(UTC):%Y%m%dT%H%M%SZ}"
    path, number = folder / f"{stem}.mcap", 2
    while path.exists():
        # Names are in the order of the runs: "_" sorts behind ".".
        path, number = folder / f"{stem}_{number}.mcap", number + 1
    return path


class MessageName(NamedTuple):
    """The unique name of a message."""

    key: Key
    boot_id: int
    sequence: int


class EarlierRuns(NamedTuple):
    """Messages and crossings of earlier runs."""

    crossings: tuple[CrossingRecord, ...] = ()
    """Crossings with published messages, in order of their entries."""
    published: tuple[MessageName, ...] = ()
    """Names of all messages, each once, in the order of the runs."""
    unconfirmed: tuple[Message, ...] = ()
    """Messages that may not have reached the bus: the last ones of runs without a successor."""
    latched: tuple[Message, ...] = ()
    """The latest state of each bridge."""
    previous: str | None = None
    """Name of the last run's file."""

    def states(self) -> dict[tuple[str, str], BridgeResult]:
        """Return the latest readable states by realm and bridge."""
        found = {}
        for message in self.latched:
            try:
                name, _, state = state_to_bridge(pb.BridgeState.FromString(message.payload))
            except (ValueError, DecodeError) as error:
                _log.warning("skipping a state of %s: %s", message.key.identifier, error)
                continue
            found[message.key.realm, name] = state
        return found


class _Run(NamedTuple):
    """A results file of a run."""

    path: Path
    previous: str | None
    began_s: float
    goes_on: bool
    """Whether another worker writes the file now."""
    was_killed: bool


class _EarlierReader:
    """Collected content of the files; of the messages only those needed later."""

    def __init__(self, search: str, fusing: FusionSettings) -> None:
        self._states = BridgeStateCache(fusing)
        self.log = CrossingLog(search)
        self.published: dict[MessageName, None] = {}
        self.states: dict[Key, Message] = {}
        self.counted: defaultdict[str, dict[str, RecentCrossings]] = defaultdict(dict)
        """Recent crossings by search and bridge."""

    def add(self, message: Message) -> PublishedResult | None:
        """Add a message and return its result, if it is a new one."""
        name = MessageName(message.key, message.boot_id, message.sequence)
        if name in self.published:
            return None
        self.published[name] = None
        if message.key.stream == "state":
            self.states[message.key] = message
        published = self.log.add(message.key, message.payload)
        counts = None if published is None else usable(published.result)
        if published is not None and counts is not None:
            bridges = self.counted[search_hash(published.header)]
            before = bridges.get(published.result.bridge, RecentCrossings())
            bridges[published.result.bridge] = add_crossings(before, [counts])
        return published

    def bridges(self, search: str) -> dict[str, BridgeResult]:
        """Return the states of all bridges after the messages read, by a search."""
        states = {
            name: self._states.of(counted, name, (search, name))
            for name, counted in self.counted[search].items()
        }
        return {name: state for name, state in states.items() if state is not None}


def read_earlier(
    folder: Path,
    realm: str,
    now_s: float,
    search: str,
    fusing: FusionSettings = NOTHING_STORED,
    age_s: float = KNOWN_AGE_S,
) -> EarlierRuns:
    """Read the files of earlier runs of a realm in a folder, no older than `age_s`.

    `now_s` is the wall clock; `search` identifies the results that count (`search_hash`). An
    unreadable file is a warning; a truncated one is read up to its end, and its JSON file is
    completed.
    """
    read = _EarlierReader(search, fusing)
    continued: set[str | None] = set()
    tails: list[tuple[_Run, list[Message]]] = []
    for run in _runs(folder, now_s, age_s):
        tail = _read_run(run, realm, read)
        if tail is None:
            continue
        # A run that names this file as the previous one has republished its last messages, if it
        # had the time.
        if not run.was_killed or tail[-1].publish_time_ns - run.began_s * 1e9 > _UNCONFIRMED_NS:
            continued.add(run.previous)
        tails.append((run, tail))
    unconfirmed = [
        message
        for run, tail in tails
        if not run.goes_on and run.path.name not in continued
        for message in tail
    ]
    return EarlierRuns(
        tuple(read.log.crossings()),
        tuple(read.published),
        tuple(unconfirmed),
        tuple(read.states.values()),
        tails[-1][0].path.name if tails else None,
    )


def _runs(folder: Path, now_s: float, age_s: float) -> Iterator[_Run]:
    for path in files_of_workers(folder, "mcap"):
        try:
            if now_s - path.stat().st_mtime > age_s:
                continue
            goes_on = is_being_written(path)
            info = read_info(path)
            began_s = int(info.start.get("time_ns", "0")) * 1e-9
        except (ValueError, OSError) as error:  # any field may be damaged
            _log.warning("skipping the results of an earlier run: %s", error)
            continue
        is_finished = info.end is not None and info.end.get("reason") != NOT_FINISHED
        was_killed = not is_finished and not goes_on
        yield _Run(path, info.start.get("previous"), began_s, goes_on, was_killed)


def _read_run(run: _Run, realm: str, read: _EarlierReader) -> list[Message] | None:
    """Read a file; return its last minute, None if it holds nothing of the realm."""
    tail: deque[Message] = deque()
    latest_ns = 0
    found: dict[str, ResultHeader] = {}
    try:
        for message in read_messages(run.path):
            if message.key.realm != realm:
                continue
            published = read.add(message)
            if published is not None:
                found[published.result.crossing_id] = published.header
            tail.append(message)
            latest_ns = max(latest_ns, message.publish_time_ns)
            while tail[0].publish_time_ns < latest_ns - _UNCONFIRMED_NS:
                tail.popleft()
    except (ValueError, OSError) as error:
        _log.warning("skipping the results of an earlier run: %s", error)
    if not tail:
        return None
    if run.was_killed and found:
        _complete_json(run, found, read)
    return list(tail)


def _complete_json(run: _Run, found: dict[str, ResultHeader], read: _EarlierReader) -> None:
    """Write the JSON file of a killed run again, if it lacks one of its results."""
    path = run.path.with_suffix(".json")
    created_s = run.began_s
    try:
        written = load_results(path)
        created_s = written.created
        if {crossing.crossing_id for crossing in written.crossings}.issuperset(found):
            return
    except InputError:
        pass  # it is absent, or the run was killed while writing it
    last = list(found.values())[-1]
    try:
        with replaced_atomically(path) as temporary:
            content = AppendableResults(temporary, last._replace(created=created_s))
            once = CrossingLog(None)
            for message in read_messages(run.path):
                published = once.add(message.key, message.payload)
                if published is not None and published.result.crossing_id in found:
                    content.add(published.result, read.bridges(search_hash(last)))
    except (InputError, FailureError) as error:
        _log.warning("results of an earlier run are in its recording only: %s", error)
