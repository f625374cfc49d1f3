"""An archive of recordings becomes results in a folder: any number of crossings, gone on with.

Recordings that follow each other closely, or overlap, are one drive; drive after drive is read, and
its crossings are given to an `Execution`, which may work on several drives at once. A result is on
the disk before it is told. A crossing whose result is in the folder is not identified again, so
who was killed is started again and goes on. What cannot be read is a problem, a line each, and
costs nothing but itself.
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
from schemas.certificates import Pair
from schemas.reasons import Reason
from schemas.results import BridgeResult, Crossing, Header
from schemas.settings import IdentificationSettings
from schemas.signals import NS_PER_S, TRUCK_DECODERS
from schemas.site import Site
from services.common.errors import InputError
from services.common.stores import opened, size_of
from services.execution.blas import one_blas_thread
from services.execution.content import content_of
from services.execution.dispatch import Execution
from services.execution.kept import Kept, Result
from services.execution.offline import header_of
from services.execution.overview import (
    STREAMS,
    as_they_were_made,
    look_over,
    remembered,
)
from services.execution.program import program
from services.identification.bridge_state import Counted, Fusing, against, count_in, usable
from services.identification.engine import Engine
from services.identification.known import LONGEST_STAY_S
from services.identification.outputs import Fuse, Said, Work
from services.recordings.away import AtHand, Away, Recording, at_hand
from services.recordings.mcap_ranges import ChunkIndexes, read_index
from services.recordings.recording import Message, is_being_written, read_info, read_messages

_log = logging.getLogger(__name__)
APART_NS: Final = round((LONGEST_STAY_S + 60.0) * NS_PER_S)
"""Recordings further apart in time have no crossing in common."""
_MOST_UNSAVED = 20
_LONGEST_UNSAVED_S = 10.0
_WAIT_S = 0.1
_NAMES = 2
"""So many recordings of a drive are named."""


class Asked(NamedTuple):
    """What is to be identified, and how."""

    recordings: tuple[Recording, ...]
    site: Site
    settings: IdentificationSettings
    fusing: Fusing
    certificates: Mapping[Pair, str]

    @property
    def header(self) -> Header:
        """What every result says of how it came about."""
        return header_of(self.site, self.settings, time.time())


class Archive(NamedTuple):
    """What came of an archive."""

    verdicts: Counter[str]
    """How many crossings have each."""
    there: int
    """Crossings whose results were in the folder before."""
    failed: tuple[str, ...]
    """Crossings that could not be identified for no reason of their own; tried anew next time."""
    problems: tuple[str, ...]
    """Recordings, messages and results that cannot be read, a line each."""
    bridges: dict[str, BridgeResult]


class _Done(NamedTuple):
    crossing: Crossing
    was_there: bool


def identify_archive(
    asked: Asked,
    execution: Execution,
    kept: Kept,
    take: Callable[[Crossing], object] = lambda crossing: None,
    report: Callable[[int], object] = lambda crossings: None,
) -> Archive:
    """Identify all crossings of recordings that have no result in `kept`, and fuse all.

    `take` is given every result, in any order, after it is on the disk; `report` is told how many
    there are. Of each bridge the newest crossings are fused, as for the state of a bridge.
    """
    problems: list[str] = []
    verdicts: Counter[str] = Counter()
    there, failed = 0, []
    counted: dict[tuple[str, str], Counted] = {}
    with one_blas_thread():
        for crossing, was_there in _identified(asked, problems, execution, kept):
            told = against(crossing, asked.fusing.baselines.get(crossing.bridge))
            verdicts[told.verdict] += 1
            there += was_there
            if is_failed(told):
                failed.append(told.crossing_id)
            counts = usable(told)
            if counts is not None:
                name = (told.realm, told.bridge)
                counted[name] = count_in(counted.get(name, Counted()), [counts])
            take(told)
            report(verdicts.total())
        bridges = _fused(counted, asked.fusing, execution)
    return Archive(verdicts, there, tuple(sorted(failed)), (*problems, *kept.problems), bridges)


def is_failed(crossing: Crossing) -> bool:
    """Whether its identification failed in a way that nobody foresaw."""
    return Reason.FAILED in crossing.reasons


def works_of(asked: Asked, problems: list[str]) -> Iterator[Work]:
    """All crossings of the recordings, drive after drive; `problems` gets a line for each."""
    for drive in drives_of(asked.recordings, problems):
        yield from _works_of_drive(drive, asked, problems)


def drives_of(recordings: Iterable[Recording], problems: list[str]) -> Iterator[list[Recording]]:
    """Recordings that overlap or follow each other within minutes, together, by time."""
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
    """Between which times something stands in a recording, ns since 1970 UTC."""
    index = _index_of(recording)
    if index is not None and index.chunks:
        first_ns = min(chunk.message_start_time for chunk in index.chunks)
        return first_ns, max(chunk.message_end_time for chunk in index.chunks)
    with at_hand(recording) as file, _named(file):
        info = read_info(file.path)
    return info.first_time_ns, info.last_time_ns


def _index_of(recording: Recording) -> ChunkIndexes | None:
    """The index of a recording, read by ranges; None if it has none that holds."""
    if isinstance(recording, Away):
        size = size_of(recording.folder, recording.name)
        with opened(recording.folder, recording.name) as file:
            return read_index(file, size)
    try:
        # A crossing that is not over would be identified now, and as another one later.
        if is_being_written(recording):
            raise InputError(f"{recording}: is being written; it is identified when it is closed")
        with recording.open("rb") as file:
            return read_index(file, recording.stat().st_size)
    except OSError:
        return None  # what is wrong with it is said where it is read


@contextmanager
def _named(file: AtHand) -> Iterator[None]:
    """Let an InputError call a recording as the user does."""
    try:
        yield
    except InputError as error:
        raise InputError(file.told(str(error))) from None


def _works_of_drive(drive: list[Recording], asked: Asked, problems: list[str]) -> Iterator[Work]:
    with ExitStack() as stack:
        files = []
        for recording in drive:
            try:
                files.append(stack.enter_context(at_hand(recording)))
            except InputError as error:
                problems.append(str(error))
        if files:
            before = [_state_of(file) for file in files]
            yield from _works_of_files(files, asked, problems)
            problems += (
                f"{file.name}: has changed while it was read; the same command again reads it anew"
                for file, was in zip(files, before, strict=True)
                if _state_of(file) != was
            )


def _state_of(file: AtHand) -> tuple[int, int, int] | None:
    """By what it is told that a file has changed; None if it is gone."""
    try:
        status = file.path.stat()
    except OSError:
        return None
    return status.st_ino, status.st_size, status.st_mtime_ns


def _works_of_files(files: list[AtHand], asked: Asked, problems: list[str]) -> Iterator[Work]:
    names = [file.name for file in files]
    name = ", ".join(names[:_NAMES]) + (" …" if len(names) > _NAMES else "")
    reading = _Reading(files, problems)
    try:
        drives = look_over(name, remembered(reading.messages), asked.site)
    except InputError as error:
        problems.append(str(error))
        return
    strangers = drives.drove - {vehicle.id for vehicle in asked.site.vehicles}
    if strangers:
        _log.warning("%s: the site has no vehicle %s", name, ", ".join(sorted(strangers)))
    engine = Engine(
        asked.site,
        asked.settings,
        asked.header,
        certificates=asked.certificates,
        tells_states=False,
    )
    for message in drives.near:
        engine.expect(message.key, message.payload, for_ever=True)
    said = chain.from_iterable(
        _said(engine, message, reading) for message in as_they_were_made(drives)
    )
    for one in chain(said, engine.finish()):
        if isinstance(one, Work):
            yield one
    if reading.changed:
        number = f"{reading.changed} message{' has' if reading.changed == 1 else 's have'}"
        problems.append(f"{name}: {number} changed while it was read")


def _said(engine: Engine, message: Message, reading: "_Reading") -> Iterator[Said]:
    """What the engine says of a message; one that was sound at the first reading may not be now."""
    try:
        return engine.feed(message.key, message.payload)
    except ValueError:
        reading.changed += 1
        return iter(())


class _Reading:
    """Messages of a drive, without those that cannot be decoded: a line for each recording."""

    def __init__(self, files: list[AtHand], problems: list[str]) -> None:
        self._files = files
        self._problems = problems
        self.changed = 0
        """Messages that could be decoded at the first reading only."""
        self._wrong: set[tuple[Path, int]] = set()
        """Messages that cannot be decoded, by their numbers in their files."""

    def messages(self, is_again: bool) -> Iterator[Message]:
        for file in self._files:
            try:
                yield from self._of_file(file, is_again)
            except InputError as error:
                line = file.told(str(error))
                if line not in self._problems:
                    self._problems.append(line)

    def _of_file(self, file: AtHand, is_again: bool) -> Iterator[Message]:
        wrong: list[str] = []
        path = file.path

        def warn(text: str) -> None:
            if not is_again:
                _log.warning("%s", file.told(text))

        for number, message in enumerate(read_messages(path, warn=warn)):
            if message.key.owner != "vehicle" or message.key.stream not in STREAMS:
                continue
            if not is_again and (why := _what_is_wrong(message)):
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


def _what_is_wrong(message: Message) -> str:
    try:
        if message.key.stream == "accel":
            check_accel(message.payload)
        else:
            TRUCK_DECODERS[message.key.stream](message.payload)
    except ValueError as error:
        return str(error)
    return ""


def _identified(
    asked: Asked, problems: list[str], execution: Execution, kept: Kept
) -> Iterator[_Done]:
    """Every crossing once with its result, as they come, after that is on the disk."""
    ours = program()
    seen: set[str] = set()
    under_way = _UnderWay(execution, kept, asked.header)
    try:
        for number, work in enumerate(works_of(asked, problems), start=1):
            content = content_of(work, ours)
            if content in seen:
                continue  # the same recording by two names
            seen.add(content)
            result = kept.result(content)
            if result is not None:
                yield _Done(result, was_there=True)
                continue
            under_way.start(work._replace(number=number), content)
            yield from under_way.done(0.0)
            while execution.is_full:
                yield from under_way.done(_WAIT_S)
        while execution.is_busy:
            yield from under_way.done(_WAIT_S)
    finally:
        saved = under_way.saved()
    yield from saved


class _UnderWay:
    """Crossings between their start and the moment in which their results are on the disk."""

    def __init__(self, execution: Execution, kept: Kept, header: Header) -> None:
        self._execution = execution
        self._kept = kept
        self._header = header
        self._contents: dict[int, str] = {}
        self._unsaved: list[Result] = []
        self._since_s = 0.0

    def start(self, work: Work, content: str) -> None:
        self._contents[work.number] = content
        self._execution.start(work)

    def done(self, timeout_s: float) -> Iterator[_Done]:
        """What is on the disk by now."""
        for work, result in self._execution.finished(timeout_s):
            content = self._contents.pop(work.number)
            if work.certificate is not None:
                result = result.model_copy(update={"certificate": work.certificate})
            if is_failed(result):
                yield _Done(result, was_there=False)
                continue
            self._since_s = self._since_s if self._unsaved else time.monotonic()
            self._unsaved.append(Result(content, result))
        is_late = self._unsaved and time.monotonic() - self._since_s > _LONGEST_UNSAVED_S
        if is_late or len(self._unsaved) >= _MOST_UNSAVED:
            yield from self.saved()

    def saved(self) -> list[_Done]:
        """Put on the disk what is not there yet."""
        self._kept.put(self._unsaved, self._header)
        done = [_Done(one.crossing, was_there=False) for one in self._unsaved]
        self._unsaved = []
        return done


def _fused(
    counted: Mapping[tuple[str, str], Counted], fusing: Fusing, execution: Execution
) -> dict[str, BridgeResult]:
    """The states of all bridges, those in several realms by the last one."""
    states: dict[str, BridgeResult] = {}
    for (realm, bridge), crossings in sorted(counted.items()):
        baseline = fusing.baselines.get(bridge)
        with_one = fusing._replace(baselines={} if baseline is None else {bridge: baseline})
        execution.fuse(Fuse(realm, bridge, crossings, with_one, crossings.newest[-1].exit_time))
    while execution.is_busy:
        execution.finished(_WAIT_S)
        for fuse, state in execution.fused():
            if state is None:
                _log.warning("%s: its crossings could not be fused", fuse.bridge)
            else:
                states[fuse.bridge] = state
    return dict(sorted(states.items()))
