"""What is fetched from trucks' disks, what is given up, and what they answer: real sessions."""

import contextlib
import threading
import time
from collections.abc import Callable
from pathlib import Path
from queue import SimpleQueue
from typing import Any

import numpy as np
import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st

from schemas import spool as wire
from schemas.signals import AccelChannel, GnssFix, Identity, decode_accel, encode_identity
from schemas.spool import SpoolBoot, SpoolQuery
from schemas.topics import Key
from services.bus.subscription import RawSample, SeenSequences
from services.common.intervals import Intervals
from services.logger import spool_listing, spool_recovery
from services.logger.spool_listing import SpoolListed
from services.logger.spool_recovery import SpoolRecovery, shortfall
from services.truck.gateway import Gateway
from services.truck.spool import Spool
from tests.waiting import LONGEST_S

ACCEL = Key("live", "vehicle", "truck-1", "accel")
MIB = 1 << 20
small = st.integers(0, 30)


def intervals(numbers: set[int]) -> Intervals:
    made = Intervals()
    for number in numbers:
        made.add(number)
    return made


def flat(ranges: list[tuple[int, int]]) -> set[int]:
    return {n for first, last in ranges for n in range(first, last + 1)}


@given(st.sets(small), st.sets(small), st.integers(-1, 30), small, st.sets(small))
def test_every_missing_number_is_fetched_confirmed_or_lost(
    seen: set[int], held: set[int], durable: int, ripe: int, gone: set[int]
) -> None:
    """What is gone from this logger's disk is on none, whatever was reported to the truck."""
    boot = SpoolBoot(1, 31, intervals(held).ranges(), durable, 0)
    found = shortfall(boot, intervals(seen), ripe, intervals(gone).ranges())
    missing = set(range(ripe)) - seen
    safe = {n for n in missing if n <= durable} - gone
    assert flat(found.confirmed) == safe
    assert flat(found.fetch) == (missing - safe) & held
    assert flat(found.lost) == missing - safe - held


def test_near_holes_are_asked_for_at_once_from_the_first_to_the_last() -> None:
    near = [(5, 9), (20, 30), (200, 210)]
    assert spool_recovery._joined([*near, (411, 420)]) == [(5, 210), (411, 420)]
    assert spool_recovery._joined([*near, (410, 420)]) == [(5, 420)]


@given(
    st.lists(
        st.builds(
            lambda boot, numbers, durable, dropped: SpoolBoot(
                boot,
                max(numbers, default=0) + 1,
                intervals(numbers).ranges(),
                min(durable, max(numbers, default=0)),
                dropped,
            ),
            st.integers(0, 2**64 - 1),
            st.sets(small),
            st.integers(-1, 30),
            small,
        ),
        unique_by=lambda held: held.boot_id,
    )
)
def test_contents_round_trip(boots: list[SpoolBoot]) -> None:
    assert wire.decode_contents(wire.encode_contents(1, boots)) == sorted(boots)


@given(st.binary(max_size=200), st.dictionaries(st.text(max_size=6), st.text(max_size=30)))
def test_any_answer_and_any_query_is_read_or_a_value_error(
    payload: bytes, parameters: dict[str, str]
) -> None:
    for call in (
        lambda: wire.decode_contents(payload),
        lambda: wire.decode_page(payload, SpoolQuery(1, 2, 3)),
        lambda: wire.parse_query(parameters),
        lambda: wire.parse_spool_key(next(iter(parameters), "")),
    ):
        refused = ""
        try:
            call()
        except ValueError as error:
            refused = str(error)
        assert "\n" not in refused


@given(st.integers(0, 2**64 - 1), st.integers(0, 2**32 - 1), st.integers(0, 2**32 - 1))
def test_queries_and_pages_round_trip(boot_id: int, first: int, last: int) -> None:
    query = SpoolQuery(boot_id, first, last)
    parts = dict(part.split("=") for part in query.parameters().split(";"))
    assert wire.parse_query(parts) == query
    assert wire.decode_page(wire.encode_page(query, None), query) is None
    if first < last:
        assert wire.decode_page(wire.encode_page(query, last), query) == last
    with pytest.raises(ValueError, match=r"another query|out of range"):
        wire.decode_page(wire.encode_page(query, last + 1), query._replace(last=last))


@pytest.fixture
def router(router: zenoh.Session, monkeypatch: pytest.MonkeyPatch) -> zenoh.Session:
    """As everywhere, but trucks are asked five times a second."""
    monkeypatch.setattr(spool_recovery, "LIST_PERIOD_S", 0.2)
    return router


class Logger:
    """The part of a logger that asks; `seen` is what it has."""

    def __init__(self, router: zenoh.Session) -> None:
        self.seen = SeenSequences()
        self.confirmed: set[int] = set()
        self.lost: set[int] = set()
        self.received: list[RawSample] = []

        def settle(into: set[int]) -> Callable[[Key, int, int, int], None]:
            def call(where: Key, boot_id: int, first: int, last: int) -> None:
                numbers = self.seen.streams.setdefault((where, boot_id), Intervals())
                numbers.add_range(first, last)
                if where.stream == "accel":
                    into.update(range(first, last + 1))

            return call

        self.recovery = SpoolRecovery(
            router, ["live"], self.seen, confirmed=settle(self.confirmed), lost=settle(self.lost)
        )

    def run(self, until: Callable[[], bool], clock: Callable[[], float] = time.monotonic) -> None:
        deadline = time.monotonic() + LONGEST_S
        while not until():
            assert time.monotonic() < deadline
            for one in self.recovery.step(clock()):
                assert one.recovered
                assert one.spooled
                assert self.seen.add(one.key(), one.identity())
                self.received.append(one)
            time.sleep(0.005)

    def numbers(self, boot_id: int) -> list[int]:
        return sorted(
            one.identity().sequence
            for one in self.received
            if one.key() == ACCEL and one.identity().boot_id == boot_id
        )


def drive(gateway: Gateway, batches: int) -> None:
    for number in range(batches):
        now = {"device_time_ns": number * 50_000_000, "wall_time_ns": time.time_ns()}
        gateway.accel({"sprung_front": AccelChannel(1000.0, np.full(50, float(number)))}, **now)


def test_what_an_earlier_boot_left_is_fetched_in_pages(
    router: zenoh.Session, client: zenoh.Session, tmp_path: Path
) -> None:
    gateway = Gateway(client, "live", "truck-1", Spool(tmp_path))
    first = gateway.boot_id
    drive(gateway, 2500)
    gateway.close()
    gateway = Gateway(client, "live", "truck-1", Spool(tmp_path))
    logger = Logger(router)
    for sequence in (*range(100), 700, 701, 702):
        logger.seen.add(ACCEL, Identity(first, sequence))
    logger.run(lambda: len(logger.received) >= 2397)
    had = {*range(100), 700, 701, 702}
    assert logger.numbers(first) == [n for n in range(2500) if n not in had]
    assert not logger.lost
    batch = decode_accel(logger.received[5].payload)
    assert batch.channels["sprung_front"].samples[0] == batch.sequence
    gateway.close()


def test_recent_messages_are_not_requested(
    router: zenoh.Session, client: zenoh.Session, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It may still be on its way; only what is missing for a round is fetched."""
    gateway = Gateway(client, "live", "truck-1", Spool(tmp_path))
    drive(gateway, 10)
    logger = Logger(router)
    rounds: list[object] = []
    compare = logger.recovery._compare
    monkeypatch.setattr(logger.recovery, "_compare", lambda *of: (compare(*of), rounds.append(of)))
    # Asked until the router knows who answers; two answers at once would be two rounds.
    logger.run(lambda: bool(rounds))
    assert logger.recovery.waiting() == 0 or len(rounds) > 1
    logger.run(lambda: len(logger.received) == 10)
    assert len(rounds) > 1
    gateway.close()


def test_two_trucks_of_one_name_lose_nothing_and_are_reported(
    router: zenoh.Session, client: zenoh.Session, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    spools = [Spool(tmp_path / name) for name in "ab"]
    boots = [spool.boot_id for spool in spools]
    trucks = [Gateway(client, "live", "truck-1", spool) for spool in spools]
    for truck, batches in zip(trucks, (1200, 300), strict=True):
        drive(truck, batches)
    logger = Logger(router)
    for boot_id in boots:  # gaps, which a truck that does not list the boot would give up
        logger.seen.add(ACCEL, Identity(boot_id, 5))
    logger.run(lambda: len(logger.received) + len(logger.lost) >= 1498)
    assert not logger.lost
    assert logger.numbers(boots[0]) == [n for n in range(1200) if n != 5]
    assert logger.numbers(boots[1]) == [n for n in range(300) if n != 5]
    [line] = [r.getMessage() for r in caplog.records if "several trucks" in r.getMessage()]
    assert "realm live" in line
    assert "truck-1" in line
    for truck in trucks:
        truck.close()


def test_what_no_one_has_is_lost_and_what_was_confirmed_is_not(
    router: zenoh.Session, client: zenoh.Session, tmp_path: Path
) -> None:
    spool = Spool(tmp_path, budget_bytes=MIB)
    gateway = Gateway(client, "live", "truck-1", spool)
    boot_id = gateway.boot_id
    drive(gateway, 500)
    spool.confirm({("accel", boot_id): 99})
    drive_on = 0
    while not spool.dropped():
        gateway.accel(
            {"sprung_front": AccelChannel(1000.0, np.zeros(50))},
            device_time_ns=drive_on, wall_time_ns=time.time_ns(),
        )  # fmt: skip
        drive_on += 1
        if drive_on % 200 == 0:
            spool.sync()
    gateway.close()
    gateway = Gateway(client, "live", "truck-1", Spool(tmp_path, budget_bytes=MIB))
    [held] = [boot for boot in gateway._spool.spool.contents("accel") if boot.boot_id == boot_id]
    logger = Logger(router)
    logger.seen.add(ACCEL, Identity(boot_id, 50))
    present = flat(held.held)
    expected = {n for n in present if n > held.durable}
    logger.run(lambda: len(logger.numbers(boot_id)) >= len(expected))
    assert set(logger.numbers(boot_id)) == expected
    assert logger.lost == set(range(held.durable + 1, min(present)))
    assert logger.confirmed == set(range(held.durable + 1)) - {50}
    assert held.dropped == len(logger.lost)
    gateway.close()


def test_a_damaged_record_is_lost_and_not_asked_for_for_ever(
    router: zenoh.Session, client: zenoh.Session, tmp_path: Path
) -> None:
    gateway = Gateway(client, "live", "truck-1", Spool(tmp_path))
    boot_id = gateway.boot_id
    drive(gateway, 20)
    [segment] = tmp_path.glob("*.spool")
    content = bytearray(segment.read_bytes())
    record = (len(content) - 20) // 20
    content[20 + 7 * record + 100] ^= 1
    segment.write_bytes(content)
    logger = Logger(router)
    logger.run(lambda: len(logger.received) == 19 and bool(logger.lost))
    assert logger.lost == {7}
    assert logger.numbers(boot_id) == [n for n in range(20) if n != 7]
    gateway.close()


def test_a_truck_that_does_not_answer_holds_up_no_other(
    router: zenoh.Session, client: zenoh.Session, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(spool_listing, "_TIMEOUT_S", 2 * LONGEST_S)
    mute = client.declare_queryable(
        wire.spool_selector("live", "truck-0"), zenoh.handlers.FifoChannel(100)
    )
    gateway = Gateway(client, "live", "truck-1", Spool(tmp_path))
    drive(gateway, 50)
    logger = Logger(router)
    logger.run(lambda: len(logger.received) == 50)
    gateway.close()
    mute.undeclare()


def test_a_refused_batch_uses_up_no_number(
    router: zenoh.Session, client: zenoh.Session, tmp_path: Path
) -> None:
    """A sensor that gives NaN must not leave a hole that nobody can fill."""
    gateway = Gateway(client, "live", "truck-1", Spool(tmp_path))
    drive(gateway, 1)
    with pytest.raises(ValueError, match="not finite"):
        gateway.accel(
            {"sprung_front": AccelChannel(1000.0, np.full(50, np.nan))},
            device_time_ns=0, wall_time_ns=time.time_ns(),
        )  # fmt: skip
    with pytest.raises(ValueError, match="latitude"):
        gateway.gnss(GnssFix(0, 0, 0, time.time_ns(), 91.0, 0.0, 0.0, 0.0))
    drive(gateway, 1)
    assert gateway._spool is not None
    [held] = gateway._spool.spool.contents("accel")
    assert held.held == [(0, 1)]
    gateway.close()


def test_a_full_disk_on_the_truck_stops_nothing(
    router: zenoh.Session, client: zenoh.Session, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from schemas.topics import selector
    from services.bus.subscription import Subscription

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    with Subscription(router, selector("live", "vehicle")) as subscription:
        gateway = Gateway(client, "live", "truck-1", Spool(tmp_path))
        monkeypatch.setattr(Spool, "append", full)
        drive(gateway, 30)
        found = [subscription.receive(5.0) for _ in range(30)]
        assert None not in found
        assert gateway.unspooled == 30
        gateway.close()


def answering(client: zenoh.Session, answer: Callable[[zenoh.Query], None]) -> Callable[[], None]:
    """A truck that answers every question as it likes; return what ends it."""
    # Not a channel of Zenoh: one cannot be undeclared while a thread waits for it.
    queries: SimpleQueue[zenoh.Query | None] = SimpleQueue()
    queryable = client.declare_queryable(wire.spool_selector("live", "truck-1"), queries.put)

    def run() -> None:
        while (query := queries.get()) is not None:
            with query, contextlib.suppress(zenoh.ZError):
                answer(query)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()

    def end() -> None:
        queryable.undeclare()
        queries.put(None)
        thread.join()

    return end


def test_a_thousand_boots_take_turns(
    router: zenoh.Session, client: zenoh.Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A step that compared 9,000 at once held up everything else for 10.6 s."""
    boots = [SpoolBoot(boot_id, 10, [(0, 9)], -1, 0) for boot_id in range(1, 1001)]
    contents = wire.encode_contents(1, boots)
    compared: set[int] = set()
    in_step: list[int] = []
    real = shortfall

    def counted(boot: SpoolBoot, *arguments: Any) -> Any:
        compared.add(boot.boot_id)
        in_step[-1] += 1
        return real(boot, *arguments)

    monkeypatch.setattr(spool_recovery, "shortfall", counted)

    def answer(query: zenoh.Query) -> None:
        if not dict(query.parameters):  # pages it does not give
            query.reply(wire.spool_key(ACCEL), contents)

    end = answering(client, answer)
    logger = Logger(router)
    deadline = time.monotonic() + LONGEST_S
    while len(compared) < len(boots):
        assert time.monotonic() < deadline, len(compared)
        in_step.append(0)
        logger.recovery.step(time.monotonic())
        time.sleep(0.005)
    assert max(in_step) <= spool_recovery._BOOTS_AT_ONCE + 1
    assert logger.recovery.waiting() > 9000 - spool_recovery._QUERIES_AT_ONCE * 10
    logger.recovery.close()
    end()


def test_endless_answers_are_read_once_and_complained_of_a_few_times(
    router: zenoh.Session, client: zenoh.Session, monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture, tmp_path: Path,
) -> None:  # fmt: skip
    contents = wire.encode_contents(1, [SpoolBoot(1, 10, [(0, 9)], -1, 0)])
    decoded: list[bytes] = []
    rounds: list[int] = []
    real = wire.decode_contents

    def decode(payload: bytes) -> list[SpoolBoot]:
        decoded.append(payload)
        return real(payload)

    def answer(query: zenoh.Query) -> None:
        if dict(query.parameters):
            return
        rounds.append(0)
        for _ in range(2000):
            query.reply(wire.spool_key(ACCEL), contents)
            rounds[-1] += 1

    monkeypatch.setattr(spool_listing, "decode_contents", decode)
    end = answering(client, answer)
    gateway = Gateway(client, "live", "truck-2", Spool(tmp_path))
    drive(gateway, 50)
    logger = Logger(router)
    truck_2 = ACCEL._replace(identifier="truck-2")
    logger.run(lambda: len(rounds) >= 3 and sum(o.key() == truck_2 for o in logger.received) == 50)
    assert sum(rounds) > 2000
    assert decoded.count(contents) <= len(rounds)
    logger.recovery.close()
    output = [r.getMessage() for r in caplog.records if "spool contents" in r.getMessage()]
    assert 0 < len(output) <= 6
    assert "truck-1 answers more than once for accel" in output[0]
    assert "more warnings of this kind" in output[-1]
    gateway.close()
    end()


def test_a_listing_of_endless_length_is_not_taken_apart(
    router: zenoh.Session, client: zenoh.Session, caplog: pytest.LogCaptureFixture
) -> None:
    end = answering(client, lambda query: query.reply(wire.spool_key(ACCEL), bytes(2 << 20)))
    logger = Logger(router)
    logger.run(lambda: bool(caplog.records))
    assert "truck-1 lists more than 1048576 bytes" in caplog.records[0].getMessage()
    logger.recovery.close()
    end()


@pytest.mark.parametrize("size", [10, 250_000])
def test_a_page_without_end_is_given_up(
    router: zenoh.Session, client: zenoh.Session, size: int, caplog: pytest.LogCaptureFixture
) -> None:
    """It filled 1.4 GB, for its deadline was looked at only when nothing waited."""
    contents = wire.encode_contents(
        1, [SpoolBoot(1, 10, [(0, 9)], -1, 0), SpoolBoot(2, 1, [], 0, 0)]
    )
    sent: list[int] = []
    is_given_up = threading.Event()

    def answer(query: zenoh.Query) -> None:
        if not dict(query.parameters):
            query.reply(wire.spool_key(ACCEL), contents)
            return
        sent.append(0)
        while sent[-1] < 20_000 and not is_given_up.is_set():
            query.reply(wire.spool_key(ACCEL), bytes(size), attachment=encode_identity(1, 100))
            sent[-1] += 1

    end = answering(client, answer)
    logger = Logger(router)
    logger.run(lambda: any("a page without end" in r.getMessage() for r in caplog.records))
    is_given_up.set()
    assert logger.received == []
    [truck] = logger.recovery._trucks.values()
    assert truck.task is None
    assert (truck.failures, len(truck.todo)) == (1, 1)  # it is asked again, later and later
    logger.recovery.close()
    end()


def test_a_truck_in_many_realms_leaves_room_for_the_others(router: zenoh.Session) -> None:
    logger = Logger(router)
    boots = [SpoolBoot(1, 10, [(0, 9)], 9, 0)]
    for number in range(2000):
        where = ACCEL._replace(realm=f"sim-{number}", identifier="truck-evil")
        logger.recovery._compare(SpoolListed(where, boots, False))
    for _ in range(2):  # what is new is compared in the second round
        logger.recovery._compare(SpoolListed(ACCEL, boots, False))
    assert len(logger.recovery._trucks) == spool_recovery.REALMS_OF_ONE + 1
    assert logger.confirmed == set(range(10))


def test_a_boot_that_is_gone_from_disk_and_truck_is_lost(router: zenoh.Session) -> None:
    """And what the truck still has of it is asked for, though it was reported to be safe."""
    logger = Logger(router)
    logger.recovery._gone = {(ACCEL, 1): intervals({0, 1, 2}), (ACCEL, 2): intervals({5, 6})}
    logger.seen.numbers(ACCEL, 2).add_range(0, 4)
    boots = [SpoolBoot(2, 7, [(6, 6)], 6, 0), SpoolBoot(3, 1, [(0, 0)], 0, 0)]
    for _ in range(2):
        logger.recovery._with_gaps = None
        logger.recovery._compare(SpoolListed(ACCEL, boots, False))
    assert logger.seen.streams[(ACCEL, 1)].ranges() == [(0, 2)]
    assert logger.lost == {0, 1, 2, 5}
    assert [query for _, query in logger.recovery._trucks[("live", "truck-1")].todo] == [
        SpoolQuery(2, 6, 6)
    ]
