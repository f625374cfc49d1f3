"""Identify an archive of recordings into a folder of results, for any number of crossings.

Recordings that follow each other closely, or overlap, are one drive. Drive after drive is read, and
its crossings are submitted to a `CrossingExecutor`, which may work on several drives at once. A
result is on the disk before it is reported. A crossing whose result is in the folder is not
identified again, so a killed command is run again to resume. Unreadable input is a problem, one
line each, and affects nothing else.
"""

import logging
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from itertools import chain
from pathlib import Path
from typing import Final, NamedTuple

from schemas.accel_check import check_accel
from schemas.reasons import Reason
from schemas.results import BridgeResult, CrossingResult, ResultHeader
from schemas.settings import IdentificationSettings
from schemas.signals import NS_PER_S, TRUCK_DECODERS
from schemas.site import Site
from schemas.topics import Message
from schemas.validation_records import VehicleBridgePair
from services.common.errors import InputError
from services.common.naming import first_of
from services.common.stores import opened, size_of
from services.execution.blas import one_blas_thread
from services.execution.dispatch import CrossingExecutor
from services.execution.offline import header_of
from services.execution.program import program
from services.execution.result_store import ResultStore, StoredResult
from services.execution.task_hash import task_hash
from services.finding.crossing_data import Complete
from services.finding.finder import Finder, Found
from services.finding.order import STREAMS, cached_reader, in_measurement_order, index_messages
from services.finding.stays import LONGEST_STAY_S
from services.identification.bridge_state import (
    FusionSettings,
    RecentCrossings,
    add_crossings,
    usable,
    with_loss_probability,
)
from services.identification.methods import window_of
from services.identification.outputs import FusionTask, IdentificationTask
from services.identification.usable import latest_realms
from services.recordings.mcap_ranges import ChunkIndexes, read_index
from services.recordings.recording import is_being_written, read_info, read_messages
from services.recordings.remote import LocalRecording, Recording, RemoteRecording, fetched

_log = logging.getLogger(__name__)
APART_NS: Final = round((LONGEST_STAY_S + 60.0) * NS_PER_S)
"""Recordings further apart in time have no crossing in common."""
_MAX_UNSAVED = 20
_LONGEST_UNSAVED_S = 10.0
_WAIT_S = 0.1
_NAMES = 2
"""Maximum number of recordings of a drive that are listed by name."""


class ArchiveJob(NamedTuple):
    """Recordings to identify, with the site and the settings."""

    recordings: tuple[Recording, ...]
    site: Site
    settings: IdentificationSettings
    fusing: FusionSettings
    certificates: Mapping[VehicleBridgePair, str]

    @property
    def header(self) -> ResultHeader:
        """Header of every result."""
        return header_of(self.site, self.settings, time.time())


class ArchiveResult(NamedTuple):
    """Outcome of identifying an archive."""

    verdicts: Counter[str]
    """Number of crossings by verdict."""
    there: int
    """Number of crossings whose results were in the folder before."""
    failed: tuple[str, ...]
    """Crossings whose identification failed unexpectedly; the next run tries them again."""
    problems: tuple[str, ...]
    """Unreadable recordings, messages and results, one line each."""
    bridges: dict[str, BridgeResult]


class _StoredCrossing(NamedTuple):
    crossing: CrossingResult
    was_there: bool


def identify_archive(
    job: ArchiveJob,
    execution: CrossingExecutor,
    store: ResultStore,
    on_result: Callable[[CrossingResult], object] = lambda crossing: None,
    report: Callable[[int], object] = lambda crossings: None,
) -> ArchiveResult:
    """Identify all crossings of recordings that have no result in `store`, and fuse all.

    `on_result` is called with every result, in any order, after it is on the disk; `report` with
    their number. Of each bridge the newest crossings are fused, as for the state of a bridge.
    """
    problems: list[str] = []
    verdicts: Counter[str] = Counter()
    there, failed = 0, []
    counted: dict[tuple[str, str], RecentCrossings] = {}
    with one_blas_thread():
        for crossing, was_there in _identified(job, problems, execution, store):
            crossing = with_loss_probability(crossing, job.fusing.baselines.get(crossing.bridge))
            verdicts[crossing.verdict] += 1
            there += was_there
            if is_failed(crossing):
                failed.append(crossing.crossing_id)
            counts = usable(crossing)
            if counts is not None:
                name = (crossing.realm, crossing.bridge)
                counted[name] = add_crossings(counted.get(name, RecentCrossings()), [counts])
            on_result(crossing)
            report(verdicts.total())
        bridges = _fused(counted, job.fusing, execution)
    return ArchiveResult(
        verdicts, there, tuple(sorted(failed)), (*problems, *store.problems), bridges
    )


def is_failed(crossing: CrossingResult) -> bool:
    """Return whether the identification failed unexpectedly."""
    return Reason.FAILED in crossing.reasons


def iter_tasks(job: ArchiveJob, problems: list[str]) -> Iterator[IdentificationTask]:
    """Yield all crossings of the recordings, drive after drive; append problems, one line each."""
    for drive in group_into_drives(job.recordings, problems):
        yield from _tasks_of_drive(drive, job, problems)


def group_into_drives(
    recordings: Iterable[Recording], problems: list[str]
) -> Iterator[list[Recording]]:
    """Yield groups of recordings that overlap or follow each other within minutes, by time."""
    spans: list[tuple[int, int, Recording]] = []
    for recording in dict.fromkeys(recordings):
        try:
            spans.append((*_times_of(recording), recording))
        except InputError as error:
            problems.append(str(error))
    drive: list[Recording] = []
    until_ns = 0
    for first_ns, last_ns, recording in sorted(spans, key=lambda one: (*one[:2], str(one[2]))):
        if drive and first_ns > until_ns + APART_NS:
            yield drive
            drive = []
        until_ns = max(until_ns, last_ns) if drive else last_ns
        drive.append(recording)
    if drive:
        yield drive


def _times_of(recording: Recording) -> tuple[int, int]:
    """Return the first and last time in a recording, ns since 1970 UTC."""
    index = _index_of(recording)
    if index is not None and index.chunks:
        first_ns = min(chunk.message_start_time for chunk in index.chunks)
        return first_ns, max(chunk.message_end_time for chunk in index.chunks)
    with fetched(recording) as file, _named(file):
        info = read_info(file.path)
    return info.first_time_ns, info.last_time_ns


def _index_of(recording: Recording) -> ChunkIndexes | None:
    """Return the index of a recording, read by ranges; None if it has no valid one."""
    if isinstance(recording, RemoteRecording):
        size = size_of(recording.folder, recording.name)
        with opened(recording.folder, recording.name) as file:
            return read_index(file, size)
    try:
        # A crossing that is not finished would be identified now, and again later as another one.
        if is_being_written(recording):
            raise InputError(f"{recording}: is being written; it is identified when it is closed")
        with recording.open("rb") as file:
            return read_index(file, recording.stat().st_size)
    except OSError:
        return None  # reading it reports what is wrong


@contextmanager
def _named(file: LocalRecording) -> Iterator[None]:
    """Replace the path in an InputError by the name that the user gave."""
    try:
        yield
    except InputError as error:
        raise InputError(file.relabel(str(error))) from None


def _tasks_of_drive(
    drive: list[Recording], job: ArchiveJob, problems: list[str]
) -> Iterator[IdentificationTask]:
    with ExitStack() as stack:
        files = []
        for recording in drive:
            try:
                files.append(stack.enter_context(fetched(recording)))
            except InputError as error:
                problems.append(str(error))
        if files:
            before = [_state_of(file) for file in files]
            yield from _tasks_of_files(files, job, problems)
            problems += (
                f"{file.name}: changed while it was read; run the command again to read it again"
                for file, was in zip(files, before, strict=True)
                if _state_of(file) != was
            )


def _state_of(file: LocalRecording) -> tuple[int, int, int] | None:
    """Return the file's inode, size and time, which a change alters; None if it is gone."""
    try:
        status = file.path.stat()
    except OSError:
        return None
    return status.st_ino, status.st_size, status.st_mtime_ns


def _tasks_of_files(
    files: list[LocalRecording], job: ArchiveJob, problems: list[str]
) -> Iterator[IdentificationTask]:
    names = [file.name for file in files]
    name = first_of(names, _NAMES)
    reading = _DriveReader(files, problems)
    try:
        drives = index_messages(name, cached_reader(reading.messages), job.site)
    except InputError as error:
        problems.append(str(error))
        return
    strangers = drives.drove - {vehicle.id for vehicle in job.site.vehicles}
    if strangers:
        _log.warning("%s: the site file has no vehicle %s", name, ", ".join(sorted(strangers)))
    finder = Finder(job.site, window_of(job.settings.method))
    for message in drives.near:
        finder.expect(message.key, message.payload, for_ever=True)
    found = chain.from_iterable(
        _found(finder, message, reading) for message in in_measurement_order(drives)
    )
    for one in chain(found, finder.finish()):
        if isinstance(one, Complete):
            pair = VehicleBridgePair(one.data.vehicle.id, one.data.bridge.id)
            yield IdentificationTask(0, one.data, job.settings, job.certificates.get(pair))
    if reading.changed:
        number = f"{reading.changed} message{' has' if reading.changed == 1 else 's have'}"
        problems.append(f"{name}: {number} changed while it was read")


def _found(finder: Finder, message: Message, reading: "_DriveReader") -> Iterator[Found]:
    """Feed a message; one that was valid at the first reading may be invalid now."""
    try:
        return finder.feed(message.key, message.payload)
    except ValueError:
        reading.changed += 1
        return iter(())


class _DriveReader:
    """Messages of a drive, without undecodable ones: one problem line for each recording."""

    def __init__(self, files: list[LocalRecording], problems: list[str]) -> None:
        self._files = files
        self._problems = problems
        self.changed = 0
        """Number of messages that were decodable at the first reading only."""
        self._wrong: set[tuple[Path, int]] = set()
        """Undecodable messages, by their numbers in their files."""

    def messages(self, is_again: bool) -> Iterator[Message]:
        for file in self._files:
            try:
                yield from self._of_file(file, is_again)
            except InputError as error:
                line = file.relabel(str(error))
                if line not in self._problems:
                    self._problems.append(line)

    def _of_file(self, file: LocalRecording, is_again: bool) -> Iterator[Message]:
        wrong: list[str] = []
        path = file.path

        def warn(text: str) -> None:
            if not is_again:
                _log.warning("%s", file.relabel(text))

        for number, message in enumerate(read_messages(path, warn=warn)):
            if message.key.owner != "vehicle" or message.key.stream not in STREAMS:
                continue
            if not is_again and (why := _decoding_error(message)):
                wrong.append(f"{message.key.stream} {message.sequence}: {why}")
                self._wrong.add((path, number))
            if (path, number) not in self._wrong:
                yield message
        if wrong:
            are = "is" if len(wrong) == 1 else "are"
            messages = "message" if len(wrong) == 1 else "messages"
            self._problems.append(
                f"{file.name}: {len(wrong)} {messages} {are} left out, first {wrong[0]}"
            )


def _decoding_error(message: Message) -> str:
    try:
        if message.key.stream == "accel":
            check_accel(message.payload)
        else:
            TRUCK_DECODERS[message.key.stream](message.payload)
    except ValueError as error:
        return str(error)
    return ""


def _identified(
    job: ArchiveJob, problems: list[str], execution: CrossingExecutor, store: ResultStore
) -> Iterator[_StoredCrossing]:
    """Yield every crossing once with its result, after that is on the disk."""
    ours = program()
    seen: set[str] = set()
    unsaved = _UnsavedResults(execution, store, job.header)
    try:
        for number, task in enumerate(iter_tasks(job, problems), start=1):
            content = task_hash(task, ours)
            if content in seen:
                continue  # the same recording by two names
            seen.add(content)
            result = store.result(content)
            if result is not None:
                yield _StoredCrossing(result, was_there=True)
                continue
            unsaved.submit(task._replace(number=number), content)
            yield from unsaved.done(0.0)
            while execution.is_full:
                yield from unsaved.done(_WAIT_S)
        while execution.is_busy:
            yield from unsaved.done(_WAIT_S)
    finally:
        saved = unsaved.saved()
    yield from saved


class _UnsavedResults:
    """Crossings between their submission and the moment when their results are on the disk."""

    def __init__(
        self, execution: CrossingExecutor, store: ResultStore, header: ResultHeader
    ) -> None:
        self._execution = execution
        self._store = store
        self._header = header
        self._contents: dict[int, str] = {}
        self._unsaved: list[StoredResult] = []
        self._since_s = 0.0

    def submit(self, task: IdentificationTask, content: str) -> None:
        self._contents[task.number] = content
        self._execution.submit(task)

    def done(self, timeout_s: float) -> Iterator[_StoredCrossing]:
        """Return the crossings whose results are on the disk by now."""
        for task, result in self._execution.collect(timeout_s):
            content = self._contents.pop(task.number)
            if task.certificate is not None:
                result = result.model_copy(update={"certificate": task.certificate})
            if is_failed(result):
                yield _StoredCrossing(result, was_there=False)
                continue
            self._since_s = self._since_s if self._unsaved else time.monotonic()
            self._unsaved.append(StoredResult(content, result))
        is_late = self._unsaved and time.monotonic() - self._since_s > _LONGEST_UNSAVED_S
        if is_late or len(self._unsaved) >= _MAX_UNSAVED:
            yield from self.saved()

    def saved(self) -> list[_StoredCrossing]:
        """Write the unsaved results to the disk."""
        self._store.put(self._unsaved, self._header)
        done = [_StoredCrossing(one.crossing, was_there=False) for one in self._unsaved]
        self._unsaved = []
        return done


def _fused(
    counted: Mapping[tuple[str, str], RecentCrossings],
    fusing: FusionSettings,
    execution: CrossingExecutor,
) -> dict[str, BridgeResult]:
    """Return the states of all bridges; of one in several realms that of the last crossing's."""
    states: dict[str, BridgeResult] = {}
    for bridge, realm in sorted(latest_realms(counted).items()):
        crossings = counted[realm, bridge]
        baseline = fusing.baselines.get(bridge)
        with_one = fusing._replace(baselines={} if baseline is None else {bridge: baseline})
        execution.submit_fusion(
            FusionTask(realm, bridge, crossings, with_one, crossings.newest[-1].exit_time)
        )
    while execution.is_busy:
        execution.collect(_WAIT_S)
        for fuse, state in execution.collect_fusions():
            if state is None:
                _log.warning("%s: fusing its crossings failed", fuse.bridge)
            else:
                states[fuse.bridge] = state
    return dict(sorted(states.items()))
