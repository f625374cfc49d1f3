"""The worker's results on disk: what this run finds, and what earlier runs left.

Every run has a file of its own, `results-TIME.mcap`, with the messages that it published, and all
results of that file as JSON beside it. Together the files of a folder hold each result once.
"""

import logging
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

from schemas.errors import InputError
from schemas.messages import decode
from schemas.proto import driveby_pb2 as pb
from schemas.results import (
    BridgeResult,
    Crossing,
    Header,
    estimate_to_crossing,
    load_results,
    results,
    results_json,
)
from schemas.signals import Identity
from schemas.topics import Key
from services.common.errors import FailureError
from services.common.files import write_atomically
from services.identification.engine import latest_state, usable_of
from services.recordings.recording import (
    Message,
    RecordingWriter,
    is_being_written,
    read_info,
    read_messages,
)

_log = logging.getLogger(__name__)
_KNOWN_AGE_S = 2 * 86_400.0
"""Older files are not read: no truck still sends what they are about."""
_UNSURE_NS = 60 * 1_000_000_000
"""What a run wrote in its last minute may not have reached every subscriber: it was killed, or the
router was away, which nobody tells a publisher."""


class ResultFiles:
    """What a run has found, as a recording and as JSON beside it; made with the first message."""

    def __init__(self, path: Path, site_toml: str, header: Header, previous: str | None) -> None:
        """`previous` is the name of the file of the run before, if any."""
        self.path = path
        self._site_toml = site_toml
        self._header = header
        self._previous = previous
        self._writer: RecordingWriter | None = None
        self._sequences: Counter[Key] = Counter()
        self._crossings: list[Crossing] = []

    def next_identity(self, key: Key, boot_id: int) -> Identity:
        """The identity of the next message of a key."""
        return Identity(boot_id, self._sequences[key])

    def write(
        self, message: Message, result: Crossing | None, bridges: dict[str, BridgeResult]
    ) -> None:
        """Bring a message to the disk, and a result to the JSON file too.

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
        if result is not None:
            self._crossings.append(result)
            content = results(self._header, self._crossings, bridges)
            write_atomically(self.path.with_suffix(".json"), results_json(content))

    def finish(self) -> None:
        """Close the recording of a run that ended well. FailureError if that is not possible."""
        if self._writer is None:
            return
        try:
            self._writer.finish("stopped by a signal", {"crossings": len(self._crossings)})
        except OSError as error:
            self._writer.abandon()
            raise FailureError(f"{self.path}: cannot be ended: {error.strerror}") from error

    def abandon(self) -> None:
        """Close the recording of a run that failed as it is on the disk, without an END: what it
        holds last may not have been published.
        """
        if self._writer is not None:
            self._writer.abandon()


class Earlier(NamedTuple):
    """What earlier runs left."""

    said: tuple[Message, ...] = ()
    """All messages, each once, in the order of the runs."""
    unsure: tuple[Message, ...] = ()
    """Those that may not have reached the bus: the last ones of runs that none went on with."""
    latched: tuple[Message, ...] = ()
    """The latest state of each bridge."""
    previous: str | None = None
    """The name of the last run's file."""


class _Run(NamedTuple):
    """One file."""

    path: Path
    messages: list[Message]
    previous: str | None
    began_s: float
    goes_on: bool
    """Another worker writes it."""
    was_killed: bool

    def last_ns(self) -> int:
        return max(message.publish_time_ns for message in self.messages)


def read_earlier(folder: Path, realm: str, now_s: float) -> Earlier:
    """What earlier runs left of a realm in a folder, in the last two days.

    `now_s` is the wall clock. A file that cannot be read is a warning; one that was cut off is
    read as far as it goes, and its JSON file is made to hold all that it holds.
    """
    runs = list(_runs(folder, realm, now_s))
    said: dict[tuple[Key, int, int], Message] = {}
    unsure: list[Message] = []
    # Who names it as the one before has published its last messages again, if it had the time.
    continued = {run.previous for run in runs if not run.was_killed or _lived_long(run)}
    for run in runs:
        said |= {(m.key, m.boot_id, m.sequence): m for m in run.messages}
        if run.was_killed:
            _complete_json(run, list(said.values()))
        if not run.goes_on and run.path.name not in continued:
            since_ns = run.last_ns() - _UNSURE_NS
            unsure += [m for m in run.messages if m.publish_time_ns >= since_ns]
    states = {message.key: message for message in said.values() if message.key.stream == "state"}
    previous = runs[-1].path.name if runs else None
    return Earlier(tuple(said.values()), tuple(unsure), tuple(states.values()), previous)


def _lived_long(run: _Run) -> bool:
    return run.last_ns() - run.began_s * 1e9 > _UNSURE_NS


def _runs(folder: Path, realm: str, now_s: float) -> Iterable[_Run]:
    for path in sorted(folder.glob("results-*.mcap")):
        try:
            if now_s - path.stat().st_mtime > _KNOWN_AGE_S:
                continue
            goes_on = is_being_written(path)
            info = read_info(path)
            messages = [m for m in read_messages(path) if m.key.realm == realm]
            began_s = int(info.start.get("time_ns", "0")) * 1e-9
        except (ValueError, OSError) as error:  # any field may be damaged
            _log.warning("results of an earlier run are left out: %s", error)
            continue
        if messages:
            was_killed = info.end is None and not goes_on
            yield _Run(path, messages, info.start.get("previous"), began_s, goes_on, was_killed)


def _complete_json(run: _Run, said: list[Message]) -> None:
    """Write results that a run that was killed had no time for into its JSON file."""
    path = run.path.with_suffix(".json")
    found = _crossings_in(run.messages)
    if not found:
        return
    try:
        written = load_results(path) if path.exists() else None
        known = {crossing.crossing_id for crossing in written.crossings} if written else set()
        if all(crossing.crossing_id in known for crossing, _ in found):
            return
        created_s = written.created if written else run.began_s
        header = found[-1][1]._replace(created=created_s)
        bridges = _bridges(c for c, h in _crossings_in(said) if h.site_hash == header.site_hash)
        content = results(header, [crossing for crossing, _ in found], bridges)
        write_atomically(path, results_json(content))
    except (InputError, FailureError) as error:
        _log.warning("results of an earlier run are in its recording only: %s", error)


def _crossings_in(messages: Iterable[Message]) -> list[tuple[Crossing, Header]]:
    found = []
    for message in messages:
        if message.key.stream != "estimate":
            continue
        try:
            estimate = decode("driveby.v1.Estimate", message.payload)
            if isinstance(estimate, pb.Estimate):
                found.append(estimate_to_crossing(estimate))
        except ValueError as error:
            _log.warning("an estimate of an earlier run is left out: %s", error)
    return found


def _bridges(crossings: Iterable[Crossing]) -> dict[str, BridgeResult]:
    usable = usable_of((crossing.bridge, crossing) for crossing in crossings)
    return {bridge: latest_state(of_bridge) for bridge, of_bridge in usable.items()}
