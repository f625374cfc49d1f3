"""The worker's results on disk: what this run finds, and what earlier runs left.

Every run has a file of its own, `results-TIME.mcap`, with the messages that it published, and all
results of that file as JSON beside it. Together the files of a folder hold each result once.
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
from schemas.results import BridgeResult, Crossing, Header, load_results
from schemas.results_on_the_wire import state_to_bridge
from schemas.signals import NS_PER_S, Identity
from schemas.topics import Key
from services.common.errors import FailureError
from services.common.files import replaced_atomically
from services.history.results_json import GrowingJson
from services.history.store import Store, Told
from services.identification.bridge_state import (
    NOTHING_STORED,
    Counted,
    Fusing,
    States,
    count_in,
    usable,
)
from services.identification.known import Known, search_hash
from services.recordings.recording import Message, is_being_written, read_info, read_messages
from services.recordings.writer import RecordingWriter

_log = logging.getLogger(__name__)
KNOWN_AGE_S = 2 * 86_400.0
"""Older files are not read: no truck still sends what they are about."""
_UNSURE_NS = 60 * NS_PER_S
"""What a run wrote in its last minute may not have reached every subscriber: it was killed, or the
router was away, which nobody tells a publisher."""


class ResultFiles:
    """What a run has found, as a recording and as JSON beside it; made with the first message."""

    def __init__(
        self,
        path: Path,
        site_toml: str,
        header: Header,
        previous: str | None,
        note: Callable[[Key, bytes], None] | None = None,
    ) -> None:
        """`previous` is the name of the file of the run before, if any.

        `note` is told of every message that is on the disk.
        """
        self._note = note
        self.path = path
        self._site_toml = site_toml
        self._json = GrowingJson(path.with_suffix(".json"), header)
        self._previous = previous
        self._writer: RecordingWriter | None = None
        self._sequences: Counter[Key] = Counter()
        self._crossings = 0

    def next_identity(self, key: Key, boot_id: int) -> Identity:
        """The identity of the next message of a key."""
        return Identity(boot_id, self._sequences[key])

    def write(
        self, message: Message, result: Crossing | None, bridges: dict[str, BridgeResult]
    ) -> None:
        """Bring a message to the disk, and a result or a state to the JSON file too.

        FailureError if that is not possible.
        """
        try:
            self._write(message, result, bridges)
        except OSError as error:
            raise FailureError(f"{self.path}: cannot be written: {error.strerror}") from error

    def _write(
        self, message: Message, result: Crossing | None, bridges: dict[str, BridgeResult]
    ) -> None:
        if self._writer is None:
            self._writer = RecordingWriter(
                self.path,
                reason="first result",
                realm=message.key.realm,
                site_toml=self._site_toml,
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
            self._json.retell(bridges)

    def begin_anew(self, path: Path, site_toml: str, header: Header) -> None:
        """What is written from now on goes to another file: it belongs to another site file.

        The messages go on where they were. FailureError if this one cannot be closed.
        """
        if self._writer is not None:
            self.finish("another site file")
            self._previous = self.path.name
        self.path, self._site_toml = path, site_toml
        self._json = GrowingJson(path.with_suffix(".json"), header)
        self._writer, self._crossings = None, 0

    def finish(self, reason: str = "stopped by a signal") -> None:
        """Close the recording of a run that ended well. FailureError if that is not possible."""
        if self._writer is None:
            return
        try:
            self._writer.finish(reason, {"crossings": self._crossings})
        except OSError as error:
            self._writer.abandon()
            raise FailureError(f"{self.path}: cannot be ended: {error.strerror}") from error

    def abandon(self) -> None:
        """Close the recording of a run that failed as it is on the disk, without an END: what it
        holds last may not have been published.
        """
        if self._writer is not None:
            self._writer.abandon()


def free_results_path(folder: Path) -> Path:
    """The name of a file for the results of a run, or of a part of it, that begins now."""
    stem = f"results-{datetime.now(UTC):%Y%m%dT%H%M%SZ}"
    path, number = folder / f"{stem}.mcap", 2
    while path.exists():
        # "_" comes after "." in the order of names, which is that of the runs
        path, number = folder / f"{stem}_{number}.mcap", number + 1
    return path


class MessageName(NamedTuple):
    """What tells a message from all others."""

    key: Key
    boot_id: int
    sequence: int


class Earlier(NamedTuple):
    """What earlier runs left."""

    crossings: tuple[Known, ...] = ()
    """All of which something was told, in order of their entries."""
    said: tuple[MessageName, ...] = ()
    """All messages, each once, in the order of the runs."""
    unsure: tuple[Message, ...] = ()
    """Those that may not have reached the bus: the last ones of runs that none went on with."""
    latched: tuple[Message, ...] = ()
    """The latest state of each bridge."""
    previous: str | None = None
    """The name of the last run's file."""

    def states(self) -> dict[tuple[str, str], BridgeResult]:
        """The latest states by realm and bridge, as far as they can be read."""
        found = {}
        for message in self.latched:
            try:
                name, _, state = state_to_bridge(pb.BridgeState.FromString(message.payload))
            except (ValueError, DecodeError) as error:
                _log.warning("a state of %s is left out: %s", message.key.identifier, error)
                continue
            found[message.key.realm, name] = state
        return found


class _Run(NamedTuple):
    """One file."""

    path: Path
    previous: str | None
    began_s: float
    goes_on: bool
    """Another worker writes it."""
    was_killed: bool


class _Read:
    """What has been read of the files so far; of the messages only those that are needed."""

    def __init__(self, search: str, fusing: Fusing) -> None:
        self._states = States(fusing)
        self.store = Store(search)
        self.said: dict[MessageName, None] = {}
        self.states: dict[Key, Message] = {}
        self.counted: defaultdict[str, dict[str, Counted]] = defaultdict(dict)
        """By search and bridge."""

    def take(self, message: Message) -> Told | None:
        """Take a message in; its result, if it is one that was not known."""
        name = MessageName(message.key, message.boot_id, message.sequence)
        if name in self.said:
            return None
        self.said[name] = None
        if message.key.stream == "state":
            self.states[message.key] = message
        told = self.store.add(message.key, message.payload)
        counts = None if told is None else usable(told.result)
        if told is not None and counts is not None:
            bridges = self.counted[search_hash(told.header)]
            before = bridges.get(told.result.bridge, Counted())
            bridges[told.result.bridge] = count_in(before, [counts])
        return told

    def bridges(self, search: str) -> dict[str, BridgeResult]:
        """The states of all bridges after what has been read, by a search."""
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
    fusing: Fusing = NOTHING_STORED,
    age_s: float = KNOWN_AGE_S,
) -> Earlier:
    """What earlier runs left of a realm in a folder, in files that are no older than `age_s`.

    `now_s` is the wall clock, `search` tells which results are ours (`search_hash`). A file that
    cannot be read is a warning; one that was cut off is read as far as it goes, and its JSON file
    is made to hold all that it holds.
    """
    read = _Read(search, fusing)
    continued: set[str | None] = set()
    tails: list[tuple[_Run, list[Message]]] = []
    for run in _runs(folder, now_s, age_s):
        tail = _read_run(run, realm, read)
        if tail is None:
            continue
        # Who names it as the one before has published its last messages again, if it had the time.
        if not run.was_killed or tail[-1].publish_time_ns - run.began_s * 1e9 > _UNSURE_NS:
            continued.add(run.previous)
        tails.append((run, tail))
    unsure = [
        message
        for run, tail in tails
        if not run.goes_on and run.path.name not in continued
        for message in tail
    ]
    return Earlier(
        tuple(read.store.crossings()),
        tuple(read.said),
        tuple(unsure),
        tuple(read.states.values()),
        tails[-1][0].path.name if tails else None,
    )


def _runs(folder: Path, now_s: float, age_s: float) -> Iterator[_Run]:
    for path in sorted(folder.glob("results-*.mcap")):
        try:
            if now_s - path.stat().st_mtime > age_s:
                continue
            goes_on = is_being_written(path)
            info = read_info(path)
            began_s = int(info.start.get("time_ns", "0")) * 1e-9
        except (ValueError, OSError) as error:  # any field may be damaged
            _log.warning("results of an earlier run are left out: %s", error)
            continue
        was_killed = info.end is None and not goes_on
        yield _Run(path, info.start.get("previous"), began_s, goes_on, was_killed)


def _read_run(run: _Run, realm: str, read: _Read) -> list[Message] | None:
    """Read a file; return its last minute, None if it holds nothing of the realm."""
    tail: deque[Message] = deque()
    latest_ns = 0
    found: dict[str, Header] = {}
    try:
        for message in read_messages(run.path):
            if message.key.realm != realm:
                continue
            told = read.take(message)
            if told is not None:
                found[told.result.crossing_id] = told.header
            tail.append(message)
            latest_ns = max(latest_ns, message.publish_time_ns)
            while tail[0].publish_time_ns < latest_ns - _UNSURE_NS:
                tail.popleft()
    except (ValueError, OSError) as error:
        _log.warning("results of an earlier run are left out: %s", error)
    if not tail:
        return None
    if run.was_killed and found:
        _complete_json(run, found, read)
    return list(tail)


def _complete_json(run: _Run, found: dict[str, Header], read: _Read) -> None:
    """Write the JSON file of a run that was killed anew, if it lacks one of its results."""
    path = run.path.with_suffix(".json")
    created_s = run.began_s
    try:
        written = load_results(path)
        created_s = written.created
        if {crossing.crossing_id for crossing in written.crossings}.issuperset(found):
            return
    except InputError:
        pass  # there is none, or the run was killed while it wrote it
    last = list(found.values())[-1]
    try:
        with replaced_atomically(path) as temporary:
            content = GrowingJson(temporary, last._replace(created=created_s))
            once = Store(None)
            for message in read_messages(run.path):
                told = once.add(message.key, message.payload)
                if told is not None and told.result.crossing_id in found:
                    content.add(told.result, read.bridges(search_hash(last)))
    except (InputError, FailureError) as error:
        _log.warning("results of an earlier run are in its recording only: %s", error)
