"""What a new file begins with: the last latched messages, within a limit."""

import pytest

from schemas.topics import Key, Message
from services.common.intervals import Intervals
from services.logger import latched
from services.logger.latched import LatchedMessages


def info(vehicle: str, sequence: int, payload: bytes = b"12345") -> Message:
    return Message(Key("live", "vehicle", vehicle, "info"), payload, 7, sequence, 0, 0)


def test_file_begins_with_the_last_messages_of_its_truck() -> None:
    kept = LatchedMessages()
    first, second, other = info("truck-1", 1), info("truck-1", 2), info("truck-2", 1)
    for message in (first, second, other):
        kept.add(message)
    assert kept.of_file(("live", "truck-1"), without=other.key) == [second]
    assert kept.of_file(("live", "truck-1"), without=second.key) == []
    numbers = Intervals()
    numbers.add(1)
    assert kept.among({(other.key, 7): numbers, (first.key, 7): numbers}) == [other]


def test_oldest_messages_are_omitted_beyond_the_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(latched, "_MAX_BYTES", 12)
    kept = LatchedMessages()
    messages = [info(f"truck-{n}", 1) for n in range(3)]
    for message in (*messages, info("truck-2", 2)):
        kept.add(message)
    numbers = Intervals()
    numbers.add_range(1, 2)
    found = kept.among({(message.key, 7): numbers for message in messages})
    assert [(m.key.identifier, m.sequence) for m in found] == [("truck-1", 1), ("truck-2", 2)]
