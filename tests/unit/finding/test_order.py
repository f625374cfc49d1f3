"""Recordings are identified as they are read: in the order of the trucks' clocks, held by none."""

import gc
import random
from collections.abc import Iterator

import pytest

from schemas.proto import driveby_pb2 as pb
from schemas.signals import GnssFix, encode_gnss
from schemas.site import Site
from schemas.topics import Key, Message
from services.common.errors import InputError
from services.finding import order as overview
from services.finding.order import cached_reader, in_measurement_order, index_messages
from services.simulation.drive import paper_site

SITE: Site = paper_site()
PADDING = "x" * 2000


def fix(truck: str, boot: int, number: int) -> Message:
    """One a second, far from any bridge."""
    at = number * 10**9
    sent = GnssFix(boot, number, at, 1_767_225_600 * 10**9 + at, 1.0, 1.0, 0.0, 10.0)
    return _message(truck, "gnss", boot, number, encode_gnss(sent))


def batch(truck: str, boot: int, number: int) -> Message:
    """Half a second after the fix of the same number."""
    message = pb.AccelBatch(
        boot_id=boot, sequence=number, device_time_ns=number * 10**9 + 5 * 10**8
    )
    return _message(truck, "accel", boot, number, message.SerializeToString())


def info(truck: str, boot: int, number: int) -> Message:
    message = pb.VehicleInfo(boot_id=boot, sequence=number, site_toml=PADDING)
    return _message(truck, "info", boot, number, message.SerializeToString())


def _message(truck: str, stream: str, boot: int, number: int, payload: bytes) -> Message:
    return Message(Key("sim", "vehicle", truck, stream), payload, boot, number, 0, 0)


def a_drive(trucks: list[str], boots: list[int], count: int) -> list[Message]:
    return [
        one
        for boot in boots
        for number in range(count)
        for truck in trucks
        for one in (fix(truck, boot, number), batch(truck, boot, number))
    ]


def names(messages: Iterator[Message]) -> dict[str, list[tuple[int, int, str]]]:
    """Of each truck boot, sequence and stream, in the order in which they come."""
    found: dict[str, list[tuple[int, int, str]]] = {}
    for message in messages:
        key = message.key
        found.setdefault(key.identifier, []).append((message.boot_id, message.sequence, key.stream))
    return found


@pytest.mark.parametrize("seed", range(3))
def test_whatever_the_order_in_which_they_came(seed: int) -> None:
    """Two trucks, two boots, all shuffled; what a truck says of itself comes before its boot."""
    sent = a_drive(["a", "b"], [7, 9], 20)
    mixed = [*sent, info("a", 9, 1), info("a", 7, 1), info("a", 7, 2)]
    random.Random(seed).shuffle(mixed)
    found = names(in_measurement_order(index_messages("x.mcap", lambda: mixed, SITE)))
    expected = {
        truck: [
            (boot, number, stream)
            for boot in (7, 9)
            for number in range(20)
            for stream in ("gnss", "accel")
        ]
        for truck in "ab"
    }
    assert found["b"] == expected["b"]
    of_a = found["a"]
    assert [one for one in of_a if one[2] != "info"] == expected["a"]
    first = next(at for at, one in enumerate(of_a) if one[0] == 9)
    assert sorted(of_a[:2]) == [(7, 1, "info"), (7, 2, "info")]
    assert of_a[first] == (9, 1, "info")


def test_what_came_in_order_is_not_held(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a long drive a few messages are alive at any time, those that came late beside them."""
    monkeypatch.setattr(overview, "_SMALL_BYTES", 1000)
    late = 30

    def read(again: bool) -> Iterator[Message]:
        for number in range(2000):
            yield fix("held", 1, number)
            if number >= late:
                yield batch("held", 1, number - late)
        for number in range(2000 - late, 2000):
            yield batch("held", 1, number)

    drives = index_messages("x.mcap", cached_reader(read), SITE)
    most = 0
    for number, _ in enumerate(in_measurement_order(drives)):
        if number % 1000 == 500:
            gc.collect()
            most = max(most, _alive("held"))
    assert number == 3999
    assert most < 3 * late


def _alive(truck: str) -> int:
    """How many messages of a truck there are in this process."""
    # Not `isinstance`, which would ask what proxies of objects that have gone are.
    return sum(one.key.identifier == truck for one in gc.get_objects() if type(one) is Message)


def test_small_ones_are_read_once_and_large_ones_twice(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[bool] = []

    def read(again: bool) -> Iterator[Message]:
        asked.append(again)
        yield from a_drive(["a"], [1], 5)

    for small, times in ((10**6, [False]), (100, [False, True])):
        asked.clear()
        monkeypatch.setattr(overview, "_SMALL_BYTES", small)
        drives = index_messages("x.mcap", cached_reader(read), SITE)
        assert len(list(in_measurement_order(drives))) == 10
        assert asked == times


def test_a_file_that_grows_or_shrinks_meanwhile() -> None:
    sent = a_drive(["a"], [1], 10)
    drives = index_messages("x.mcap", lambda: sent, SITE)
    longer = drives._replace(read=lambda: [*sent, fix("a", 1, 10), fix("new", 1, 0)])
    assert names(in_measurement_order(longer)) == names(iter(sent))
    shorter = drives._replace(read=lambda: sent[:-3])
    assert names(in_measurement_order(shorter)) == names(iter(sent[:-3]))


@pytest.mark.parametrize(
    ("sent", "output"),
    [
        ([fix("a", 1, 0)], "x.mcap: no accelerations (accel), a recording of a truck is expected"),
        ([batch("a", 1, 0)], "x.mcap: no positions (gnss), a recording of a truck is expected"),
        ([_message("a", "accel", 1, 4, b"\xff")], "x.mcap: accel 4: not a driveby.v1.AccelBatch"),
    ],
)
def test_what_is_no_drive(sent: list[Message], output: str) -> None:
    with pytest.raises(InputError) as caught:
        index_messages("x.mcap", lambda: sent, SITE)
    assert str(caught.value).startswith(output)


def test_drives_of_one_start_are_warned_of(caplog: pytest.LogCaptureFixture) -> None:
    """Only the first counts, so the user must learn how many are not identified."""
    others = [
        one._replace(payload=one.payload + bytes((0x20, extra)))
        for extra in (5, 6, 7)
        for one in a_drive(["a"], [7], 3)
    ]
    same = a_drive(["a", "b"], [7], 3)
    index_messages("one.mcap", lambda: [*same, *same], SITE)
    assert not caplog.records
    for sent, number in ((others[:6], 2), (others, 4)):
        caplog.clear()
        index_messages("one.mcap, two.mcap", [*same, *sent].copy, SITE)
        (warning,) = caplog.messages
        expected = f"one.mcap, two.mcap: a has {number} drives with the same start; only the first"
        assert warning.startswith(expected)
