"""When messages are published, by a clock of its own, and what keys do to it."""

from collections.abc import Callable, Iterator

import pytest

from schemas.topics import Key, Message
from services.recordings.merge import TimedMessage
from services.replay.player import (
    LEAD_S,
    Command,
    Controls,
    PlaybackResult,
    PlaybackSettings,
    Status,
    play,
)

S = 1_000_000_000
START_NS = 1_700_000_000 * S
WHERE = Key("live", "vehicle", "truck-1", "gnss")


class User:
    """A clock that goes on only while the player waits, and keys pressed at given times."""

    def __init__(self, **pressed: float) -> None:
        self.now_s = 1000.0
        self.presses = sorted((at_s + 1000.0, name) for name, at_s in pressed.items())
        self.shown: list[Status] = []

    def wait(self, seconds: float) -> Command | None:
        until = self.now_s + seconds
        if self.presses and self.presses[0][0] <= until:
            at_s, name = self.presses.pop(0)
            self.now_s = max(self.now_s, at_s)
            return Command[name.rstrip("_0123456789")]
        self.now_s = until
        return None

    def played(
        self,
        messages: Iterator[TimedMessage],
        course: PlaybackSettings,
        put: Callable[[Message], None] | None = None,
    ) -> tuple[PlaybackResult, list[tuple[int, float]]]:
        """What came of it, and the number of each message with the time when it was put."""
        came: list[tuple[int, float]] = []

        def note(message: Message) -> None:
            came.append((message.sequence, round(self.now_s - 1000.0, 6)))
            if put is not None:
                put(message)

        controls = Controls(self.wait, self.shown.append)
        return play(messages, note, course, controls, lambda: self.now_s), came


def recorded(*times_s: float, latched: tuple[int, ...] = ()) -> Iterator[TimedMessage]:
    reached_s = 0.0
    for number, time_s in enumerate(times_s):
        where = WHERE._replace(stream="info") if number in latched else WHERE
        reached_s = reached_s if number in latched else max(reached_s, time_s)
        time_ns = START_NS + round(time_s * S)
        message = Message(where, b"", 1, number, time_ns, 0)
        yield TimedMessage(START_NS + round(reached_s * S), message)


@pytest.mark.parametrize("speed", [0.5, 1.0, 5.0])
def test_the_spacing_is_kept_and_what_was_held_up_is_made_up_for(speed: float) -> None:
    user = User()

    def hold_up(message: Message) -> None:
        if message.sequence == 2:
            user.now_s += 0.3 / speed

    times_s = (0.0, 0.1, 0.2, 0.3, 0.2, 1.0, 3.0)
    _, came = user.played(recorded(*times_s), PlaybackSettings(speed), hold_up)
    due_s = (0.0, 0.1, 0.2, 0.5, 0.5, 1.0, 3.0)  # the fifth stands late in the recording
    assert [at_s for _, at_s in came] == pytest.approx([due / speed for due in due_s])


def test_as_fast_as_possible_waits_for_nothing() -> None:
    played, came = (user := User()).played(recorded(0.0, 1e6, 2e6), PlaybackSettings(0.0))
    assert [number for number, _ in came] == [0, 1, 2]
    assert user.now_s == 1000.0
    assert played == PlaybackResult(
        round(2e6 * S), 0, 0, has_quit=False, course=PlaybackSettings(0.0)
    )


def test_a_latched_message_neither_waits_nor_is_waited_for() -> None:
    """A file that goes on begins with what the truck said of itself hours before."""
    user = User()
    _, came = user.played(recorded(-7200.0, 0.0, 1.0, 0.5, latched=(0, 3)), PlaybackSettings(1.0))
    assert came == [(0, 0.0), (1, 0.0), (2, 1.0), (3, 1.0)]


def test_a_pause_lasts_until_it_is_ended_and_nothing_is_made_up_for() -> None:
    user = User(PAUSE_1=1.5, PAUSE_2=101.5)
    _, came = user.played(recorded(0.0, 1.0, 2.0, 3.0), PlaybackSettings(1.0))
    assert came == [(0, 0.0), (1, 1.0), (2, 102.0), (3, 103.0)]
    assert [status.is_paused for status in user.shown].count(True) > 100  # shown all the time


def test_a_step_is_one_message_each_also_when_two_are_asked_for_at_once() -> None:
    user = User(STEP_1=1.5, STEP_2=1.5, PAUSE_3=20.0)
    _, came = user.played(recorded(0.0, 1.0, 2.0, 3.0, 4.0, 6.0), PlaybackSettings(1.0))
    assert came == [(0, 0.0), (1, 1.0), (2, 1.5), (3, 1.5), (4, 21.0), (5, 23.0)]


def test_the_next_round_goes_on_at_the_speed_and_with_the_pause_of_this_one() -> None:
    begun = PlaybackSettings(1.0, start_paused=True, crossings_ns=(START_NS,))
    played, _ = User(PAUSE=1.0, FASTER=1.5).played(recorded(0.0, 1.0), begun)
    assert played.course == begun._replace(speed=2.0, start_paused=False)
    stepping = User(STEP_1=0.5, STEP_2=0.5)
    played, came = stepping.played(recorded(0.0, 1.0), begun)
    assert len(came) == 2
    assert played.course == begun


def test_paused_start_publishes_nothing_before_the_first_key() -> None:
    user = User(PAUSE=50.0)
    _, came = user.played(recorded(0.0, 1.0), PlaybackSettings(1.0, start_paused=True))
    assert came == [(0, 50.0), (1, 51.0)]


def test_faster_and_slower_count_from_now_on() -> None:
    user = User(FASTER=1.0, SLOWER=2.0)
    _, came = user.played(recorded(0.0, 1.5, 2.9, 4.0), PlaybackSettings(1.0))
    # 1 s at 1, 1 s at 2, the rest at 1 again.
    assert came == [(0, 0.0), (1, 1.25), (2, 1.95), (3, 3.0)]


def test_the_fastest_is_without_waiting_and_slower_comes_back_from_it() -> None:
    keys = {f"FASTER_{n}": 0.0 for n in range(20)}
    user = User(**keys)
    _, came = user.played(recorded(0.0, 1e6), PlaybackSettings(1.0))
    assert came == [(0, 0.0), (1, 0.0)]
    assert user.shown[-1].speed == 0.0
    slow = User(**{f"SLOWER_{n}": 0.05 for n in range(20)})
    _, came = slow.played(recorded(0.0, 0.1), PlaybackSettings(1.0))
    assert slow.shown[-1].speed == 0.1
    assert came[1][1] == pytest.approx(0.05 + 0.05 / 0.1)


def test_a_jump_goes_to_just_before_the_next_crossing() -> None:
    crossings = tuple(START_NS + s * S for s in (3, 100, 200))
    user = User(NEXT_CROSSING=1.5)
    played, came = user.played(
        recorded(0.0, 1.0, 50.0, 60.0, 95.5, 96.0, latched=(3,)),
        PlaybackSettings(1.0, crossings_ns=crossings),
    )
    # The crossing at 3 s is too near to jump to; what is latched is said on the way.
    assert came == [(0, 0.0), (1, 1.0), (3, 1.5), (4, 1.5), (5, 2.0)]
    assert played.jumped_over == 1


def test_two_jumps_at_once_pass_two_crossings_and_a_third_says_that_there_is_none() -> None:
    crossings = tuple(START_NS + s * S for s in (100, 200))
    user = User(NEXT_CROSSING_1=1.0, NEXT_CROSSING_2=1.0)
    times_s = (0.0, 50.0, 99.0, 150.0, 196.0, 197.0)
    _, came = user.played(recorded(*times_s), PlaybackSettings(1.0, crossings_ns=crossings))
    assert came == [(0, 0.0), (2, 1.0), (4, 1.0), (5, 2.0)]
    lost = User(NEXT_CROSSING=0.5)
    _, came = lost.played(recorded(0.0, 1.0), PlaybackSettings(1.0, crossings_ns=()))
    assert came == [(0, 0.0), (1, 1.0)]
    assert "no crossing ahead" in {status.note for status in lost.shown}


def test_a_jump_from_where_a_jump_ended_goes_on() -> None:
    """There is a message in the very moment that lies `LEAD_S` before the crossing."""
    crossings = tuple(START_NS + s * S for s in (100, 200))
    user = User(NEXT_CROSSING_1=1.0, NEXT_CROSSING_2=1.0)
    times_s = (0.0, 50.0, 100.0 - LEAD_S, 150.0, 196.0)
    _, came = user.played(recorded(*times_s), PlaybackSettings(1.0, crossings_ns=crossings))
    assert came == [(0, 0.0), (2, 1.0), (4, 1.0)]


def test_a_jump_into_a_silence_ends_at_what_follows_it() -> None:
    user = User(NEXT_CROSSING=1.0)
    _, came = user.played(
        recorded(0.0, 500.0, 501.0), PlaybackSettings(1.0, crossings_ns=(START_NS + 300 * S,))
    )
    assert came == [(0, 0.0), (1, 1.0), (2, 2.0)]


@pytest.mark.parametrize(("skip", "third_s", "skipped_s"), [(False, 601.0, 0), (True, 1.0, 600)])
def test_gaps_are_passed_over_where_that_is_wanted(
    skip: bool, third_s: float, skipped_s: int
) -> None:
    user = User()
    played, came = user.played(
        recorded(0.0, 1.0, 601.0, 602.9), PlaybackSettings(1.0, skip_gaps=skip)
    )
    assert came[2:] == [(2, third_s), (3, pytest.approx(third_s + 1.9))]
    assert played.skipped_ns == skipped_s * S


def test_quitting_ends_it_at_once_also_in_a_pause_and_at_full_speed() -> None:
    played, came = User(PAUSE=1.5, QUIT=60.0).played(recorded(0.0, 1.0, 2.0), PlaybackSettings(1.0))
    assert (len(came), played.has_quit) == (2, True)
    assert played.covered_ns == S
    user = User(QUIT=0.0)
    played, came = user.played(recorded(0.0, 1.0), PlaybackSettings(0.0))
    assert (came, played.has_quit) == ([], True)
