"""Which crossings are taken from recordings, when, and that none is twice."""

import fcntl
import logging
import os
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import cast

import pytest

from schemas.proto import driveby_pb2 as pb
from schemas.results import CrossingResult
from schemas.signals import NS_PER_S
from schemas.topics import Key, Message
from schemas.validation_records import VehicleBridgePair
from services.execution.dispatch import collect, dispatch
from services.execution.inline import InlineExecutor
from services.execution.processes import BackgroundResult, BackgroundTask, ProcessExecutor
from services.identification.engine import Engine
from services.identification.known import search_hash
from services.identification.waiting import Validations
from services.ledger.crossing_log import Ledger
from services.recordings.writer import RecordingOrigin, RecordingWriter
from services.worker.backfill import Backfill, WaitingCounts
from services.worker.recording_list import BackfillSource
from tests.builders.ledger import known_crossings
from tests.identifications import Identifications
from tests.unit.identification.test_engine_resume import (
    HEADER,
    REALM,
    SETTINGS,
    SITE,
    START_S,
    TWO,
    WHOLE,
    EngineOutput,
    output_of,
    until,
)

DAY_S = 86_400.0
LONG_AGO_S = 1000.0
"""More than any patience here."""


class Reader:
    """In the place of a process that reads: reads at once."""

    def __init__(self) -> None:
        self._over: list[BackgroundResult] = []
        self.names: list[str] = []

    def submit_background(self, task: BackgroundTask) -> None:
        self.names.append(task.name)
        self._over.append(BackgroundResult(task, task.run()))

    def collect(self) -> list[object]:
        return []

    def collect_background(self) -> list[BackgroundResult]:
        over, self._over = self._over, []
        return over

    def close(self) -> None:
        """There is nothing to end."""


class Worker:
    """What a worker does with what it finds, without a bus."""

    def __init__(self, folder: Path, sent: EngineOutput = (), **engine: object) -> None:  # type: ignore[assignment]
        known = known_crossings(sent, search_hash(HEADER))
        self.engine = Engine(SITE, SETTINGS, HEADER, **engine)  # type: ignore[arg-type]
        self.ledger = Ledger(known, time.time())
        self.recorded: dict[str, int] = {}
        noted = self.engine.note_recorded

        def note_recorded(until_ns: Mapping[str, int]) -> None:
            self.recorded = dict(until_ns)
            noted(until_ns)

        self.engine.note_recorded = note_recorded  # type: ignore[method-assign]
        list(self.engine.resume(known))
        self.reader = Reader()
        self.backfill = Backfill(
            BackfillSource(folder, REALM, 2.0 * DAY_S),
            SITE,
            SETTINGS,
            self.ledger,
            reader=lambda: cast(ProcessExecutor, self.reader),
        )
        self.here = InlineExecutor(identify=Identifications(), stopwatch=lambda: 0.0)
        self.wanted: list[VehicleBridgePair] = []
        self.sent: EngineOutput = []
        self._now_s = 0.0

    def feed(self, messages: list[Message]) -> list[CrossingResult]:
        return self._published(o for m in messages for o in self.engine.feed(m.key, m.payload))

    def leave(self, *, for_good: bool) -> list[CrossingResult]:
        """The truck is silent."""
        return self._published(self.engine.gone(REALM, "truck-1", for_good=for_good))

    def go_on(self, times: int = 20) -> list[CrossingResult]:
        """The results of so many rounds, each long after the one before."""
        results = []
        for _ in range(times):
            self._now_s += 20.0
            sent = self.backfill.advance(
                self.engine, self._now_s, has_room=True, want=self.wanted.append
            )
            results += self._published(sent)
        return results

    def _published(self, sent: Iterator[object]) -> list[CrossingResult]:
        results = []
        outputs = dispatch(self.engine, self.here, sent, self.wanted.append)  # type: ignore[arg-type]
        for output in (*outputs, *collect(self.engine, self.here)):
            self.sent.append((output.key, output.payload))
            self.ledger.note(output.key, output.payload)
            if output.result is not None:
                results.append(output.result)
        return results


@pytest.fixture
def record(tmp_path: Path) -> Callable[..., Path]:
    """Write what a logger would have, so many seconds ago."""

    def write(
        messages: list[Message],
        name: str = "truck-1-20260101T000000Z.mcap",
        ago_s: float = LONG_AGO_S,
    ) -> Path:
        path = tmp_path / REALM / "2026-01-01" / name
        writer = RecordingWriter(path, reason="test", origin=RecordingOrigin(REALM))
        now_ns = time.time_ns() - round(ago_s * 1e9)
        for message in messages:
            writer.write(message._replace(publish_time_ns=now_ns))
        writer.finish("test", {})
        os.utime(path, ns=(now_ns, now_ns))
        return path

    return write


IDS = [o.result.crossing_id for o in WHOLE if o.result is not None]


def ids(results: list[CrossingResult]) -> list[str]:
    return [result.crossing_id for result in results]


def test_what_nobody_sends_any_more_gets_its_result_once(
    tmp_path: Path, record: Callable[..., Path], caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    record(TWO)
    worker = Worker(tmp_path)
    assert ids(worker.go_on()) == IDS
    assert caplog.text.count("reading 1 recording for crossings without a result") == 1
    assert sorted(worker.sent) == sorted(output_of(WHOLE))  # byte for byte, states too
    assert worker.backfill.waiting.total == 0
    assert worker.go_on() == []


@pytest.mark.parametrize("number", range(len(WHOLE) + 1))
def test_wherever_a_run_was_cut_off_the_next_says_the_rest(
    tmp_path: Path, record: Callable[..., Path], number: int
) -> None:
    record(TWO)
    before = output_of(WHOLE[:number])
    worker = Worker(tmp_path, before)
    again = list(worker.engine.resume(()))
    worker.go_on()
    estimates = [key for key, _ in (*before, *worker.sent) if key.stream == "estimate"]
    assert again == []
    assert len(estimates) == 2
    crossing_states = [one for one in (*before, *worker.sent) if one[0].stream == "crossing"]
    # What `resume` itself finishes has its own tests.
    assert len(crossing_states) == len(set(crossing_states)) >= 7


def test_what_another_search_has_identified_is_left_alone(
    tmp_path: Path, record: Callable[..., Path]
) -> None:
    """A site file that is edited never identifies again what has a result."""
    record(TWO)
    known = known_crossings(output_of(WHOLE[:6]), "another search")
    worker = Worker(tmp_path)
    worker.ledger = Ledger(known, time.time())
    worker.backfill._ledger = worker.ledger
    assert ids(worker.go_on()) == IDS[1:]


def test_what_the_truck_itself_sends_is_no_second_crossing(
    tmp_path: Path, record: Callable[..., Path]
) -> None:
    """Whichever comes first; and in the moment between fetching and taking in, too."""
    record(TWO)
    first = Worker(tmp_path)
    assert ids(first.feed(TWO)) == IDS
    assert first.go_on() == []
    other = Worker(tmp_path)
    assert ids(other.go_on()) == IDS
    assert other.feed(TWO) == []
    between = Worker(tmp_path)
    for _ in range(3):
        between._now_s += 20.0
        sent = between.backfill.advance(
            between.engine, between._now_s, has_room=False, want=between.wanted.append
        )
        assert list(sent) == []
    assert len(between.backfill._found) == 2
    assert ids(between.feed(TWO)) == IDS
    assert between.go_on() == []


@pytest.mark.parametrize("restarts", [True, False])
@pytest.mark.parametrize("has_spool", [True, False])
def test_a_truck_lost_on_the_bridge_gives_one_result(
    tmp_path: Path, record: Callable[..., Path], *, has_spool: bool, restarts: bool
) -> None:
    """Killed there, or out of reach: its recording decides, and it comes a quarter later."""
    worker = Worker(tmp_path)
    assert worker.feed(until(8.0)) == []
    for for_good in (False, True):
        assert worker.leave(for_good=for_good) == []
    record(until(8.0))
    assert ids(worker.go_on()) == IDS[:1]
    if has_spool:
        rest = [m for m in until(8.7) if m not in until(8.0)]
        record(rest, "truck-1-20260101T000500Z.mcap")
        assert worker.go_on() == []
    later = [restarted(m) for m in until(20.0)] if restarts else TWO
    found = ids(worker.feed(later))
    assert IDS[0] not in found
    assert len(found) == 1  # the next crossing
    assert worker.go_on() == []


def restarted(message: Message) -> Message:
    """The same a quarter of an hour later, in the truck's next boot."""
    kinds: dict[str, type[pb.AccelBatch | pb.GnssFix]] = {
        "accel": pb.AccelBatch,
        "gnss": pb.GnssFix,
    }
    kind = kinds.get(message.key.stream)
    boot_id, time_ns = message.boot_id + 1, message.log_time_ns + 900 * NS_PER_S
    payload = message.payload
    if kind is not None:
        later = kind.FromString(payload)
        later.boot_id = boot_id
        later.wall_time_ns += 900 * NS_PER_S
        payload = later.SerializeToString(deterministic=True)
    return message._replace(boot_id=boot_id, log_time_ns=time_ns, payload=payload)


@pytest.mark.parametrize("is_killed", [False, True])
@pytest.mark.parametrize(
    ("sent", "in_recording"),
    [
        ([m for m in TWO if m.log_time_ns * 1e-9 - START_S > 7.5], IDS[:1]),
        ([m for m in TWO if m.key.stream != "accel"], IDS),
    ],
    ids=["from the middle of the bridge on", "positions alone"],
)
def test_a_crossing_of_which_a_part_is_sent_is_left_to_the_recording(
    tmp_path: Path,
    record: Callable[..., Path],
    sent: list[Message],
    in_recording: list[str],
    *,
    is_killed: bool,
) -> None:
    """The truck is recorded; a logger that is killed writes no more, and has what it has."""
    path = record(TWO, ago_s=10.0)
    alone = Worker(tmp_path / "nowhere")
    assert len(alone.feed(sent) + alone.leave(for_good=True)) == 2
    worker = Worker(tmp_path)
    with path.open("r+b") as writer:
        if not is_killed:
            fcntl.flock(writer, fcntl.LOCK_EX)
        assert worker.go_on(1) == []
        assert set(worker.recorded) == {"truck-1"}
        here = worker.feed(sent)
    here += worker.leave(for_good=True)
    assert set(ids(here)).isdisjoint(in_recording)
    found = worker.go_on()
    assert sorted(ids([*here, *found])) == IDS
    assert {result.verdict for result in found} == {"good"}


def test_without_a_certificate_they_stay_in_the_recording(
    tmp_path: Path, record: Callable[..., Path]
) -> None:
    record(TWO)
    worker = Worker(tmp_path, validations=Validations(are_required=True))
    assert worker.go_on() == []
    pair = VehicleBridgePair("truck-1", "bridge-1")
    assert worker.wanted == [pair]
    assert worker.backfill.waiting == WaitingCounts(for_validation=2)
    assert worker.sent == []
    worker.engine.certify(pair, "0123456789abcdef")
    results = worker.go_on()
    assert ids(results) == IDS
    assert {result.certificate for result in results} == {"0123456789abcdef"}


def test_company_on_the_bridge_is_found_in_recordings(
    tmp_path: Path, record: Callable[..., Path]
) -> None:
    """A truck that the site file does not know, at the same time."""
    record(TWO)
    record(strangers(), "stranger-20260101T000000Z.mcap")
    assert reasons_against(Worker(tmp_path)) == [("other_truck_on_bridge",), ()]


def test_a_silent_truck_is_no_company(tmp_path: Path, record: Callable[..., Path]) -> None:
    """It was last seen on one side and, ten minutes later, on the other."""
    record(TWO)
    theirs = strangers()
    early_ns, late_ns = theirs[0].log_time_ns + 3 * NS_PER_S, theirs[-1].log_time_ns - 3 * NS_PER_S
    apart = [moved(m, -150 * NS_PER_S) for m in theirs if m.log_time_ns < early_ns]
    apart += [moved(m, 450 * NS_PER_S) for m in theirs if m.log_time_ns > late_ns]
    record(apart, "stranger-20260101T000000Z.mcap")
    assert reasons_against(Worker(tmp_path)) == [(), ()]


def reasons_against(worker: Worker) -> list[tuple[str, ...]]:
    """The known faults of both crossings."""
    seen: list[tuple[str, ...]] = []
    inner = Identifications()

    def identify(data, *arguments, **others):  # type: ignore[no-untyped-def]
        seen.append(tuple(data.against))
        return inner(data, *arguments, **others)

    worker.here = InlineExecutor(identify=identify)
    assert ids(worker.go_on()) == IDS
    return seen


def strangers() -> list[Message]:
    """Positions of another truck on its first crossing."""
    return [m._replace(key=m.key._replace(identifier="stranger")) for m in TWO if is_first(m)]


def moved(message: Message, by_ns: int) -> Message:
    """A position at another time."""
    fix = pb.GnssFix.FromString(message.payload)
    fix.device_time_ns += by_ns + 1000 * NS_PER_S
    fix.wall_time_ns += by_ns
    payload = fix.SerializeToString(deterministic=True)
    return message._replace(payload=payload, log_time_ns=message.log_time_ns + by_ns)


def is_first(message: Message) -> bool:
    return message.key.stream == "gnss" and message.log_time_ns * 1e-9 - START_S < 20.0


def test_older_recordings_and_other_files_are_not_read(
    tmp_path: Path, record: Callable[..., Path]
) -> None:
    record(TWO, ago_s=3.0 * DAY_S)
    record(TWO, "_service-20260101T000000Z.mcap")
    record(TWO, ".truck-1-20260101T000000Z.mcap")
    worker = Worker(tmp_path)
    assert worker.go_on() == []
    assert worker.reader.names == []


def test_one_that_may_still_become_whole_waits_until_nothing_more_is_recorded(
    tmp_path: Path, record: Callable[..., Path]
) -> None:
    path = record([m for m in TWO if not is_in_hole(m)], ago_s=10.0)
    worker = Worker(tmp_path)
    assert ids(worker.go_on()) == IDS[1:]
    assert worker.backfill.waiting == WaitingCounts(for_data=1)
    names = len(worker.reader.names)
    assert worker.go_on() == []
    assert len(worker.reader.names) == names  # it is not asked for again and again
    os.utime(path, (time.time() - LONG_AGO_S,) * 2)
    (result,) = worker.go_on()
    assert (result.crossing_id, result.reasons) == (IDS[0], ("gap_on_bridge",))


def test_what_a_spool_brings_later_makes_it_whole(
    tmp_path: Path, record: Callable[..., Path]
) -> None:
    record([m for m in TWO if not is_in_hole(m)], ago_s=10.0)
    worker = Worker(tmp_path)
    assert ids(worker.go_on()) == IDS[1:]
    record([m for m in TWO if is_in_hole(m)], "truck-1-20260101T001500Z.mcap", ago_s=6.0)
    (result,) = worker.go_on()
    assert (result.crossing_id, result.verdict) == (IDS[0], "good")


def is_in_hole(message: Message) -> bool:
    time_s = message.log_time_ns * 1e-9 - START_S
    return message.key.stream == "accel" and 7.0 < time_s < 8.0


def test_running_and_done_crossings_do_not_wait_in_recordings(
    tmp_path: Path, record: Callable[..., Path]
) -> None:
    """Also while another recording is scanned, when nothing is fetched."""
    record(TWO)
    worker = Worker(tmp_path)
    for _ in range(3):
        worker._now_s += 20.0
        list(worker.backfill.advance(worker.engine, worker._now_s, has_room=False, want=print))
    assert worker.backfill.waiting == WaitingCounts(for_process=2)
    for left in (1, 0):
        for has_room in (True, False):
            worker._now_s += 0.1
            worker._published(
                worker.backfill.advance(worker.engine, worker._now_s, has_room=has_room, want=print)
            )
        assert worker.backfill.waiting == WaitingCounts(for_process=left)
    record(strangers(), "stranger-20260101T000000Z.mcap")
    worker.go_on(1)
    assert worker.backfill.waiting.total == 0


def test_key_of_another_realm(tmp_path: Path, record: Callable[..., Path]) -> None:
    """A folder of one realm holds what is of that realm."""
    record([m._replace(key=Key("live", *m.key[1:])) for m in TWO])
    assert Worker(tmp_path).go_on() == []
