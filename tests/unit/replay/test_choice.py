"""Which recorded messages are published."""

from collections.abc import Iterator

import pytest

from schemas.topics import Key, Message
from services.common.errors import InputError
from services.recordings.merge import TimedMessage
from services.replay.choice import (
    ReplaySelection,
    ReplayWindow,
    chosen_keys,
    parsed_rename,
    utc_text,
    window_of,
    within,
)

S = 1_000_000_000
FIRST_NS, LAST_NS = 1_790_030_000 * S, 1_790_030_100 * S
ACCEL, GNSS, INFO = (Key("live", "vehicle", "truck-1", s) for s in ("accel", "gnss", "info"))
OTHER = Key("live", "vehicle", "truck-2", "accel")
RESULT, EVENT = Key("live", "bridge", "b", "estimate"), Key("live", "service", "logger", "event")
HEALTH = Key("live", "service", "logger", "health")  # is not logged
KEYS = (ACCEL, GNSS, INFO, OTHER, RESULT, EVENT, HEALTH)


@pytest.mark.parametrize(
    ("choice", "begin_s", "end_s"),
    [
        (ReplaySelection(), 0, 100),
        (ReplaySelection(start="12.5"), 12.5, 100),
        (ReplaySelection(start="10", end="20"), 10, 20),
        (ReplaySelection(start="10", duration_s=5.0), 10, 15),
        (ReplaySelection(duration_s=5.0), 0, 5),
        (ReplaySelection(start="90", duration_s=500.0), 90, 590),
        (ReplaySelection(end="1000"), 0, 1000),
        (ReplaySelection(start="2026-09-21T22:33:30"), 10, 100),
        (ReplaySelection(start="2026-09-21T22:33:30Z", end="2026-09-22T00:33:40+02:00"), 10, 20),
    ],
)
def test_a_stretch_is_given_in_seconds_or_as_a_time(
    choice: ReplaySelection, begin_s: float, end_s: float
) -> None:
    window = window_of(choice, FIRST_NS, LAST_NS)
    assert window.begin_ns == FIRST_NS + round(begin_s * S)
    assert window.end_ns == pytest.approx(FIRST_NS + round(end_s * S), abs=1)


@pytest.mark.parametrize(
    ("choice", "words"),
    [
        (ReplaySelection(start="100.5"), "--start: is 100.5, but the drive lasts 100.0 s"),
        (ReplaySelection(start="-1"), "--start: is -1, but the drive lasts"),
        (
            ReplaySelection(start="2026-09-21T22:33"),
            "from 2026-09-21T22:33:20.000Z to 2026-09-21T22:35:00",
        ),
        (ReplaySelection(end="2026-09-20"), "--end: is 2026-09-20, but the drive lasts"),
        (ReplaySelection(start="soon"), '--start: is "soon", seconds from the beginning'),
        (ReplaySelection(start="nan"), '--start: is "nan"'),
        (ReplaySelection(end="inf"), '--end: is "inf"'),
        (ReplaySelection(start="20", end="20"), "--end: is 20, it must be later than the start"),
    ],
)
def test_a_stretch_without_anything_in_it_is_refused(choice: ReplaySelection, words: str) -> None:
    with pytest.raises(InputError) as caught:
        window_of(choice, FIRST_NS, LAST_NS)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_time_is_written_as_it_is_read() -> None:
    window = window_of(ReplaySelection(start=utc_text(FIRST_NS + S // 2)), FIRST_NS, LAST_NS)
    assert window.begin_ns == FIRST_NS + S // 2


@pytest.mark.parametrize(
    ("choice", "keys"),
    [
        (ReplaySelection(), {ACCEL, GNSS, INFO, OTHER, RESULT, EVENT}),
        (ReplaySelection(topics=("accel",)), {ACCEL, OTHER}),
        (ReplaySelection(topics=("vehicle/truck-1/*",)), {ACCEL, GNSS, INFO}),
        (ReplaySelection(topics=("g*", "vehicle/*/info")), {GNSS, INFO}),
        (ReplaySelection(topics=("vehicle/*",), exclude=("info", "*/truck-2/*")), {ACCEL, GNSS}),
        (ReplaySelection(exclude=("service/*",)), {ACCEL, GNSS, INFO, OTHER, RESULT}),
        (ReplaySelection(vehicles=("truck-2",)), {OTHER}),
        (ReplaySelection(vehicles=("truck-1", "truck-2"), exclude=("info",)), {ACCEL, GNSS, OTHER}),
    ],
)
def test_topics_and_trucks_are_chosen(choice: ReplaySelection, keys: set[Key]) -> None:
    assert chosen_keys(choice, KEYS) == {key: key.identifier for key in keys}


def test_a_truck_is_renamed_and_a_result_of_that_name_is_not() -> None:
    keys = (ACCEL, RESULT._replace(identifier="truck-1"))
    found = chosen_keys(ReplaySelection(renames=(("truck-1", "truck-9"),)), keys)
    assert list(found.values()) == ["truck-9", "truck-1"]
    swapped = ReplaySelection(renames=(("truck-1", "truck-2"), ("truck-2", "truck-1")))
    assert chosen_keys(swapped, (ACCEL, OTHER)) == {ACCEL: "truck-2", OTHER: "truck-1"}


@pytest.mark.parametrize(
    ("choice", "words"),
    [
        (
            ReplaySelection(vehicles=("truck-3",)),
            '--vehicle: "truck-3" is not in the recording, which has',
        ),
        (
            ReplaySelection(renames=(("b", "c"),)),
            '--rename: "b" is not in the recording, which has truck-1',
        ),
        (
            ReplaySelection(renames=(("truck-1", "truck-2"),)),
            'truck-1 and truck-2 would both be "truck-2"',
        ),
        (
            ReplaySelection(topics=("acc",)),
            '--topics: "acc" matches no topic of the recording, which has bridge/b/estimate, ',
        ),
        (
            ReplaySelection(exclude=("health",)),
            '--exclude: "health" matches no topic of the recording',
        ),
        (ReplaySelection(exclude=("*",)), "nothing is left to replay"),
        (ReplaySelection(topics=("gnss",), vehicles=("truck-2",)), "nothing is left to replay"),
    ],
)
def test_option_without_effect_is_named(choice: ReplaySelection, words: str) -> None:
    with pytest.raises(InputError) as caught:
        chosen_keys(choice, KEYS)
    assert words in str(caught.value)


@pytest.mark.parametrize("text", ["truck-1", "=x", "truck-1=", "truck-1=No Name"])
def test_a_rename_is_old_and_new(text: str) -> None:
    assert parsed_rename("truck-1=truck-9") == ("truck-1", "truck-9")
    with pytest.raises(InputError, match="--rename: "):
        parsed_rename(text)


def recorded(*messages: tuple[Key, float, float]) -> Iterator[TimedMessage]:
    for number, (key, time_s, due_s) in enumerate(messages):
        message = Message(key, b"", 1, number, FIRST_NS + round(time_s * S), 0)
        yield TimedMessage(FIRST_NS + round(due_s * S), message)


def test_a_stretch_begins_with_what_was_latched_and_has_what_was_recovered() -> None:
    messages = recorded(
        (INFO, -100, 0),
        (ACCEL, 1, 1),
        (INFO, 2, 2),  # the truck said it again
        (ACCEL, 12, 12),
        (INFO, 13, 13),
        (ACCEL, 30, 30),
        (ACCEL, 15, 30),  # came late
        (INFO, 31, 31),
    )
    window = ReplayWindow(FIRST_NS + 10 * S, FIRST_NS + 20 * S)
    found = [
        (timed.message.sequence, (timed.due_ns - FIRST_NS) / S)
        for timed in within(messages, window)
    ]
    assert found == [(2, 10.0), (3, 12.0), (4, 13.0), (6, 20.0)]
