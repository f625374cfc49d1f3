"""Names that several trucks or workers share, as the logger's intake sees them."""

import pytest

from schemas.topics import Key
from services.logger.shared_names import SharedNames

S = 1_000_000_000
ACCEL = Key("live", "vehicle", "truck-1", "accel")


def sent(where: Key, *messages: tuple[int, float]) -> SharedNames:
    """Names after messages of (boot_id, arrival in s)."""
    names = SharedNames()
    for boot_id, at_s in messages:
        names.note(where, boot_id, round(at_s * S))
    return names


def test_restarted_truck_shares_its_name_with_none() -> None:
    names = sent(ACCEL, (1, 0.0), (2, 1.0), (1, 2.0), (2, 100.0))
    assert names.news() == []
    assert names.note_text(100 * S) == ""


@pytest.mark.parametrize(
    ("where", "what"),
    [
        (ACCEL, "several trucks in realm live are named truck-1"),
        (
            Key("live", "bridge", "bridge-1", "estimate"),
            "several workers in realm live publish results of bridge-1",
        ),
    ],
)
def test_boot_that_outlives_the_next_one_is_reported_once(where: Key, what: str) -> None:
    names = sent(where, (1, 0.0), (2, 1.0), (1, 12.0), (2, 12.1), (1, 13.0), (1, 60.0))
    [(sender, line)] = names.news()
    assert sender == where._replace(stream="")
    assert line.startswith(what)
    assert names.news() == []
    assert names.note_text(61 * S) == what
    assert names.note_text(600 * S) == ""
    names.note(where, 1, 601 * S)
    assert len(names.news()) == 1


def test_note_names_three_at_most() -> None:
    names = SharedNames()
    for number in range(5):
        for boot_id, at_s in ((2, 0), (1, 20)):
            names.note(ACCEL._replace(identifier=f"truck-{number}"), boot_id, at_s * S)
    assert names.note_text(21 * S).endswith("truck-2; 2 more")


def test_forgotten_streams_take_no_memory() -> None:
    names = sent(ACCEL, (2, 0.0), (1, 20.0))
    names.forget(ACCEL, 1)
    assert names.note_text(21 * S)
    names.forget(ACCEL, 2)
    assert len(names.news()) == 1
    assert names == SharedNames()
