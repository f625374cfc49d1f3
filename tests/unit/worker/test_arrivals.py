"""In which order and when the worker looks at what comes from the bus."""

import itertools
import queue
import threading
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import cast

import numpy as np
import pytest
import zenoh

from schemas.proto import driveby_pb2 as pb
from schemas.results import ResultHeader
from schemas.settings import IdentificationSettings
from schemas.signals import NS_PER_S, GnssFix, Identity, encode_gnss
from schemas.topics import Key, topic
from services.bus.publisher import Publisher
from services.bus.subscription import RawSample
from services.common.errors import FailureError
from services.execution.inline import InlineExecutor
from services.identification.engine import Engine
from services.identification.outputs import Output
from services.ledger.runs import ResultFiles
from services.simulation.drive import paper_site
from services.worker import loop, receiving
from services.worker.arrivals import ArrivalQueue, DepartedTruck, LivenessToken, TruckMessage
from services.worker.service import WorkerService
from tests.unit.worker.test_validation_runner import Places, certificates
from tests.waiting import LONGEST_S

REALM = "live"
SETTINGS = IdentificationSettings(method="least_squares")
HEADER = ResultHeader("0", 0.0, "abc", SETTINGS.model_dump(mode="json"), SETTINGS.seed)


def message(at_s: float, number: int = 0, truck: str = "truck-1", boot_id: int = 1) -> TruckMessage:
    payload = pb.AccelBatch(device_time_ns=number).SerializeToString()
    return TruckMessage(Key(REALM, "vehicle", truck, "accel"), boot_id, 0, payload, at_s)


def token(at_s: float, *, is_alive: bool, truck: str = "truck-1") -> LivenessToken:
    return LivenessToken(REALM, truck, is_alive, at_s)


def gone(*, for_good: bool = False, truck: str = "truck-1") -> DepartedTruck:
    return DepartedTruck(REALM, truck, for_good)


def test_the_first_second_of_a_truck_is_put_in_order_of_time() -> None:
    arrivals = ArrivalQueue()
    history = [message(0.0, 5), message(0.4, 2), message(0.9, 7)]
    assert [arrivals.add(one) for one in history] == [[], [], []]
    assert arrivals.due(0.99) == []
    assert arrivals.due(1.0) == [history[1], history[0], history[2]]
    assert arrivals.due(2.0) == []
    late = message(3.0, 1)
    assert arrivals.add(late) == [late]
    assert arrivals.add(message(3.0, 1, boot_id=2)) == []  # that boot is new


def test_a_truck_that_starts_again_and_again_takes_bounded_memory() -> None:
    arrivals = ArrivalQueue()
    for boot_id in range(100):
        arrivals.add(message(float(2 * boot_id), boot_id=boot_id))
        arrivals.add(message(float(2 * boot_id), truck="truck-2"))
        arrivals.due(2.0 * boot_id + 1.0)
    assert len(arrivals._highest) <= 9
    assert arrivals._known <= set(arrivals._highest)
    for boot_id in range(93, 100):
        late = message(200.0, boot_id=boot_id)
        assert arrivals.add(late) == [late]
    other = message(200.0, truck="truck-2")
    assert arrivals.add(other) == [other]


def numbered(at_s: float, number: int) -> TruckMessage:
    return message(at_s, number)._replace(sequence=number)


def test_history_with_gaps_waits_for_what_is_still_to_come() -> None:
    arrivals = ArrivalQueue()
    first, between, last = numbered(0.0, 0), numbered(5.0, 1), numbered(0.0, 2)
    for one in (first, last):
        arrivals.add(one)
    assert arrivals.due(5.0) == []
    assert arrivals.add(between) == []
    assert arrivals.due(5.0) == [first, between, last]


def test_history_whose_beginning_is_missing_waits_for_it() -> None:
    """What a truck sends meanwhile may come before what it has kept."""
    arrivals = ArrivalQueue()
    live = [numbered(0.02 * n, n) for n in range(50, 100)]
    kept = [numbered(5.0, n) for n in range(50)]
    for one in live:
        assert arrivals.add(one) == []
    assert arrivals.due(5.0) == []
    for one in reversed(kept):
        assert arrivals.add(one) == []
    assert arrivals.due(5.0) == kept + live


def test_history_without_what_the_truck_no_longer_keeps_is_complete() -> None:
    arrivals = ArrivalQueue()
    first = 700
    kept = [numbered(0.0, n) for n in range(first, first + topic("vehicle", "accel").cache)]
    for one in kept[1:]:
        arrivals.add(one)
    assert arrivals.due(1.0) == []
    arrivals.add(kept[0])
    assert arrivals.due(1.0) == kept


def test_replay_may_begin_anywhere() -> None:
    arrivals = ArrivalQueue()
    key = Key("replay-1", "vehicle", "truck-1", "accel")
    replayed = numbered(0.0, 700)._replace(key=key)
    arrivals.add(replayed)
    assert arrivals.due(1.0) == [replayed]


def test_history_whose_gaps_stay_is_processed_ten_seconds_after_the_last_older_message() -> None:
    arrivals = ArrivalQueue()
    history = [numbered(0.0, 1), numbered(0.0, 5), numbered(8.0, 3), numbered(17.0, 6)]
    for one in history:
        arrivals.add(one)
    assert arrivals.due(17.9) == []
    assert len(arrivals.due(18.0)) == 4


def test_no_history_is_collected_for_longer_than_a_minute() -> None:
    arrivals = ArrivalQueue()
    for n in range(60):
        arrivals.add(numbered(float(n), 2 * (100 - n)))
        assert arrivals.due(float(n)) == []
    assert len(arrivals.due(60.0)) == 60


def of_stream(stream: str, at_s: float, numbers: range) -> list[TruckMessage]:
    """Return messages of the seconds `numbers` of a drive."""
    kind = {"accel": pb.AccelBatch, "gnss": pb.GnssFix}[stream]
    key = Key(REALM, "vehicle", "truck-1", stream)
    return [
        TruckMessage(key, 1, n, kind(device_time_ns=n * 10**9).SerializeToString(), at_s)
        for n in numbers
    ]


def test_positions_wait_for_the_accelerations_of_the_same_time() -> None:
    """Those are ten times as large, and come one after the other over a slow line."""
    arrivals = ArrivalQueue()
    history = of_stream("gnss", 0.0, range(300))
    for one in history:
        arrivals.add(one)
    for second in range(30):
        assert arrivals.due(float(second)) == []
        for one in of_stream("accel", float(second), range(10 * second, 10 * second + 10)):
            history.append(one)
            arrivals.add(one)
    due = arrivals.due(30.0)
    assert [one.sequence for one in due] == sorted(one.sequence for one in history)


def test_positions_without_accelerations_are_processed_after_ten_seconds() -> None:
    arrivals = ArrivalQueue()
    fixes = of_stream("gnss", 0.0, range(11))
    for one in fixes:
        arrivals.add(one)
    assert arrivals.due(9.9) == []
    assert arrivals.due(10.0) == fixes


@pytest.mark.parametrize("in_transit", [0, 10])
def test_history_that_a_broken_connection_cuts_off_is_continued(in_transit: int) -> None:
    """A logger that hosts the router was killed: truck and rest are back within half a minute.

    Messages and tokens come by two ways, so some messages may come after the token's loss.
    """
    arrivals = ArrivalQueue()
    arrivals.note(token(0.0, is_alive=True))
    history = of_stream("gnss", 0.0, range(100)) + of_stream("accel", 0.0, range(40))
    for one in history[: len(history) - in_transit]:
        arrivals.add(one)
    arrivals.note(token(0.5, is_alive=False))
    for one in history[len(history) - in_transit :]:
        arrivals.add(one._replace(received_s=0.6))
    departures = []
    for tenth in range(35, 290):
        assert arrivals.due(tenth / 10) == []
        departures += arrivals.gone(tenth / 10)
    assert departures == [gone()]
    arrivals.note(token(30.0, is_alive=True))
    assert arrivals.due(30.5) == []
    rest = of_stream("accel", 31.0, range(40, 100))
    for one in rest:
        assert arrivals.add(one) == []
    due = arrivals.due(31.0)
    assert [one.sequence for one in due] == sorted(2 * list(range(100)))


def left_by(only: TruckMessage, at_s: float) -> ArrivalQueue:
    """Return the queue of a truck that sent one message and left."""
    arrivals = ArrivalQueue()
    arrivals.note(token(0.0, is_alive=True))
    arrivals.add(only)
    arrivals.note(token(at_s, is_alive=False))
    return arrivals


def test_history_cut_off_for_ever_is_processed_when_the_truck_is_lost() -> None:
    only = numbered(0.0, 700)
    arrivals = left_by(only, 2.0)
    assert arrivals.due(5.0) == []
    assert arrivals.gone(5.0) == [gone()]
    assert arrivals.due(121.9) == []
    assert arrivals.due(122.0) == [only]
    assert arrivals.gone(122.0) == [gone(for_good=True)]


def test_complete_history_of_a_truck_that_has_left_is_processed_before_its_departure() -> None:
    only = numbered(0.0, 0)
    arrivals = left_by(only, 0.1)
    assert arrivals.due(3.1) == [only]
    assert arrivals.gone(3.1) == [gone()]


def test_messages_of_a_returned_truck_are_put_in_order_of_time() -> None:
    """It sends stream by stream what it measured meanwhile, minutes of each."""
    arrivals = ArrivalQueue()
    arrivals.note(token(0.0, is_alive=True))
    before = numbered(0.0, 0)
    arrivals.add(before)
    assert arrivals.due(1.0) == [before]
    arrivals.note(token(2.0, is_alive=False))
    assert arrivals.gone(5.0) == [gone()]
    arrivals.note(token(600.0, is_alive=True))
    burst = [numbered(600.0, n) for n in (5, 3, 4, 2)]
    for one in burst:
        assert arrivals.add(one) == []
    assert arrivals.due(601.0) == []  # 1 is missing, and 0 came before
    first = numbered(601.0, 1)
    assert arrivals.add(first) == []
    assert arrivals.due(601.0) == sorted([*burst, first], key=lambda one: one.sequence)
    now = numbered(602.0, 6)
    assert arrivals.add(now) == [now]


def test_messages_of_a_truck_whose_link_was_short_of_a_moment_are_not_held_up() -> None:
    arrivals = ArrivalQueue()
    arrivals.note(token(0.0, is_alive=True))
    arrivals.add(numbered(0.0, 0))
    assert len(arrivals.due(1.0)) == 1
    arrivals.note(token(2.0, is_alive=False))
    assert arrivals.gone(4.0) == []
    arrivals.note(token(4.0, is_alive=True))
    now = numbered(4.0, 1)
    assert arrivals.add(now) == [now]


def test_what_is_malformed_is_looked_at_all_the_same() -> None:
    arrivals = ArrivalQueue()
    broken = message(0.0)._replace(payload=b"\xff\xff")
    arrivals.add(broken)
    assert arrivals.due(1.0) == [broken]


def test_a_truck_whose_token_has_gone() -> None:
    arrivals = ArrivalQueue()
    arrivals.note(token(0.0, is_alive=True))
    arrivals.add(message(0.0))
    assert arrivals.gone(500.0) == []
    arrivals.note(token(500.0, is_alive=False))
    assert arrivals.gone(502.9) == []
    assert arrivals.gone(503.0) == [gone()]
    assert arrivals.gone(619.9) == []
    assert arrivals.gone(620.0) == [gone(for_good=True)]
    assert arrivals.gone(1e6) == []


@pytest.mark.parametrize("back_s", [502.0, 600.0])
def test_a_truck_whose_token_comes_back(back_s: float) -> None:
    arrivals = ArrivalQueue()
    arrivals.note(token(500.0, is_alive=False))
    before = arrivals.gone(back_s)
    assert before == ([] if back_s < 503.0 else [gone()])
    arrivals.note(token(back_s, is_alive=True))
    assert arrivals.gone(1e6) == []


def test_a_truck_without_token_has_gone_when_it_is_silent() -> None:
    arrivals = ArrivalQueue()
    arrivals.add(message(0.0))
    arrivals.add(message(9.0))
    assert arrivals.gone(18.9) == []
    assert arrivals.is_leaving(message(0.0).key)
    assert arrivals.leaving() == {(REALM, "truck-1"): True}
    arrivals.due(18.9)
    assert arrivals.leaving() == {(REALM, "truck-1"): False}
    assert arrivals.gone(19.0) == [gone()]
    arrivals.add(message(100.0))
    assert arrivals.gone(110.0) == [gone()]  # and not for good: it has spoken


def test_hurried_queue_waits_as_for_a_token() -> None:
    arrivals = ArrivalQueue()
    arrivals.add(message(0.0))
    arrivals.hurry()
    assert arrivals.gone(2.9) == []
    assert arrivals.gone(3.0) == [gone()]


NOBODY_WAITS = certificates(Path("not made"), Places())


def service_of(engine: Engine, files: ResultFiles) -> WorkerService:
    return WorkerService("w", engine, InlineExecutor(), NOBODY_WAITS, Publisher(None, REALM), files)


class Watched(Engine):
    """An engine that notes what it is given, and stops the service at a payload."""

    def __init__(self, stop: threading.Event, last: bytes) -> None:
        super().__init__(paper_site(), SETTINGS, HEADER)
        self.stop, self.last = stop, last
        self.seen: list[DepartedTruck | bytes] = []

    def feed(self, key: Key, payload: bytes) -> Iterator[Output]:
        self.seen.append(payload)
        if payload == self.last:
            self.stop.set()
        return iter(())

    def gone(self, realm: str, vehicle: str, *, for_good: bool = False) -> Iterator[Output]:
        self.seen.append(DepartedTruck(realm, vehicle, for_good))
        return iter(())


@pytest.fixture
def files(tmp_path: Path) -> ResultFiles:
    return ResultFiles(tmp_path / "results.mcap", "", HEADER, None)


@pytest.mark.parametrize("away_s", [1.0, 50.0])
def test_requeued_crossing_is_not_lost(
    files: ResultFiles, monkeypatch: pytest.MonkeyPatch, away_s: float
) -> None:
    """All this came during an identification of a quarter of an hour, and is looked at after it."""
    monkeypatch.setattr(WorkerService, "publish_health", lambda *_: None)
    monkeypatch.setattr("services.worker.loop.time.monotonic", lambda: 1000.0)
    queued: queue.Queue[TruckMessage | LivenessToken] = queue.Queue()
    with_token = [
        token(0.0, is_alive=True),
        message(0.0, 1),
        message(5.0, 2),
        token(6.0, is_alive=False),
        token(6.0 + away_s, is_alive=True),
        message(7.0 + away_s, 3),
    ]
    for one in with_token:
        queued.put(one)
    stop = threading.Event()
    engine = Watched(stop, message(0.0, 3).payload)
    loop.Loop(service_of(engine, files), queued, stop).run()
    assert engine.seen == [message(0.0, number).payload for number in (1, 2, 3)]


class Undecided(Watched):
    """The truck stands on the bridge."""

    def has_undecided(self, realm: str, vehicle: str) -> bool:
        return True


def test_a_truck_without_token_that_goes_on_talking_does_not_hold_up_the_end(
    files: ResultFiles, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A message every tenth of a second, each of which says that it has not gone yet."""
    monkeypatch.setattr(WorkerService, "publish_health", lambda *_: None)
    monkeypatch.setattr("services.worker.loop.time.monotonic", lambda: 10.0)
    queued: queue.Queue[TruckMessage | LivenessToken] = queue.Queue()
    for number in range(1000):
        queued.put(message(0.1 * number, number))
    stop = threading.Event()
    engine = Undecided(stop, message(0.0, 100).payload)
    loop.Loop(service_of(engine, files), queued, stop).run()
    assert engine.seen == [message(0.0, number).payload for number in range(131)]


def test_truck_silent_before_a_stop_is_decided_before_the_end(
    files: ResultFiles, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(WorkerService, "publish_health", lambda *_: None)
    moments = itertools.count(10.0, 0.04)
    monkeypatch.setattr("services.worker.loop.time.monotonic", lambda: next(moments))
    monkeypatch.setattr(loop, "POLL_S", 0.001)
    queued: queue.Queue[TruckMessage | LivenessToken] = queue.Queue()
    queued.put(message(8.9, 1))
    queued.put(message(10.0, 2))
    stop = threading.Event()
    engine = Undecided(stop, message(0.0, 2).payload)
    loop.Loop(service_of(engine, files), queued, stop).run()
    assert engine.seen == [message(0.0, 1).payload, message(0.0, 2).payload, gone()]


def test_a_receiver_that_fails_in_any_way_is_not_taken_for_a_quiet_one(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def take_all(*_: object) -> None:
        raise RuntimeError("unforeseen")

    monkeypatch.setattr(receiving.MessageReceiver, "_receive_all", take_all)
    has_ended = threading.Event()
    receiver = receiving.MessageReceiver(cast("zenoh.Session", None), REALM, has_ended.set)
    receiver.start()
    assert has_ended.wait(LONGEST_S)
    receiver.close()
    assert receiver.has_failed
    assert "unforeseen" in caplog.text


class Broken(Watched):
    """Takes every message, and fails in what follows from it."""

    def feed(self, key: Key, payload: bytes) -> Iterator[Output]:
        yield from super().feed(key, payload)
        raise np.linalg.LinAlgError("singular")  # a ValueError


def test_an_error_of_the_program_is_not_blamed_on_a_message(
    files: ResultFiles, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(WorkerService, "publish_health", lambda *_: None)
    queued: queue.Queue[TruckMessage | LivenessToken] = queue.Queue()
    queued.put(message(0.0, 1))
    queued.put(message(2.0, 2))
    stop = threading.Event()
    engine = Broken(stop, message(0.0, 1).payload)
    with pytest.raises(FailureError, match="could not be processed: singular"):
        loop.Loop(service_of(engine, files), queued, stop).run()
    assert "refused" not in caplog.text


def test_a_malformed_message_is_refused_and_named(
    files: ResultFiles, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(WorkerService, "publish_health", lambda *_: None)
    queued: queue.Queue[TruckMessage | LivenessToken] = queue.Queue()
    queued.put(message(0.0)._replace(payload=b"\xff"))
    queued.put(message(2.0)._replace(payload=b"\xfe"))
    engine = Engine(paper_site(), SETTINGS, HEADER)
    stop = threading.Event()
    ready = threading.Timer(0.5, stop.set)
    service = service_of(engine, files)
    loop.Loop(service, queued, stop).run(ready.start)
    assert caplog.text.count("refused accel of truck-1") == 2
    assert service.refused == {"engine": 2}


def test_receiver_counts_what_it_refuses() -> None:
    """The loop publishes this number; without it a refusal is a line of the log only."""
    refused: Counter[str] = Counter()
    receiver = receiving.MessageReceiver(cast("zenoh.Session", None), REALM, print, refused)
    one = message(0.0)
    other_schema = pb.AccelBatch(schema_version=99, boot_id=1).SerializeToString()
    for payload in (b"\xff", other_schema, bytes(1 << 20)):
        sample = RawSample(str(one.key), payload, None, False)
        receiver._take(sample, one.key, Identity(1, 0), 0.0)
    assert refused.total() == 3
    assert receiver.queued.empty()


@pytest.mark.parametrize(
    ("realm", "offset_s", "words"),
    [
        ("live", -2200 * 86_400.0, "the clock of truck-1 is 2200.0 days behind this machine's"),
        ("live", 90.0, "the clock of truck-1 is 90 s ahead of this machine's"),
        ("live", -3600.0, ""),
        ("sim-x", -2200 * 86_400.0, ""),
        ("replay-x", -2200 * 86_400.0, ""),
    ],
)
def test_wrong_clock_of_a_truck_is_logged_once(
    realm: str,
    offset_s: float,
    words: str,
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    receiver = receiving.MessageReceiver(cast("zenoh.Session", None), realm, print)
    now_ns = 1_800_000_000 * NS_PER_S
    monkeypatch.setattr("services.worker.receiving.time.time", lambda: now_ns / NS_PER_S)
    key = Key(realm, "vehicle", "truck-1", "gnss")
    for sequence in range(3):
        fix = GnssFix(1, sequence, 0, now_ns + round(offset_s * NS_PER_S), 50.0, 8.0, 0.0, 9.0)
        sample = RawSample("", encode_gnss(fix), None, False)
        receiver._take(sample, key, Identity(1, sequence), 0.0)
    assert receiver.queued.qsize() == 3
    lines = [record.getMessage() for record in caplog.records]
    assert len(lines) == bool(words)
    assert words in "".join(lines)
