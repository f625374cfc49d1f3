"""A simulated day in short: two trucks, twelve bridges, and a worker that is killed."""

from collections import Counter
from pathlib import Path

import pytest

from schemas.proto import driveby_pb2 as pb
from tests.faults.day import (
    Crossed,
    Picture,
    Plan,
    live,
    problems_of,
    problems_of_view,
    site,
    way,
)

pytestmark = pytest.mark.process


@pytest.mark.faults
@pytest.mark.timeout(1200)
def test_every_crossing_has_one_result_although_the_worker_is_killed(tmp_path: Path) -> None:
    """Four bridges of the road and the one beside them, there and back, at twelve times the speed:
    what the worker cannot keep up with waits."""
    published = live(tmp_path, rounds=1, bridges=4, speed=12.0, kills=1, away_s=0.0, seed=1)
    assert published.problems == []
    assert published.crossings == published.results == 16
    assert published.shown == published.to_show > 0


@pytest.mark.faults
@pytest.mark.timeout(1200)
def test_killed_five_times_and_away_for_longer_than_a_history(tmp_path: Path) -> None:
    published = live(tmp_path, rounds=3, bridges=9, speed=8.0, kills=5, away_s=600.0, seed=2)
    assert published.problems == []
    assert published.crossings == published.results == 108
    # It draws the first eight of twelve bridges that a truck comes near: two of these nobody
    # crosses, and two half as often as the others.
    assert published.shown == published.to_show >= 60


def test_the_day_sees_what_is_missing_twice_or_invented() -> None:
    """The comparison itself, or it would prove nothing."""
    there, back = Crossed("road-0", "start_to_end"), Crossed("road-0", "end_to_start")
    plans = {"truck-1": Plan(Path(), [there, back], 10.0)}

    def result(number: int, direction: pb.Direction, vehicle: str = "truck-1") -> pb.Estimate:
        return pb.Estimate(
            crossing_id=f"{vehicle}.{number}",
            vehicle=vehicle,
            bridge="road-0",
            direction=direction,
            entry_time_ns=number,
        )

    one, two = result(1, pb.START_TO_END), result(2, pb.END_TO_START)
    assert problems_of(plans, [two, one]) == []
    for wrong in (
        [one],
        [one, two, two],
        [two],
        [one, one],
        [one, two, result(3, pb.START_TO_END)],
    ):
        assert problems_of(plans, wrong), wrong
    assert problems_of(plans, [one, two, result(1, pb.START_TO_END, "truck-2")])


def test_the_day_sees_what_the_view_does_not_show_or_shows_twice() -> None:
    there, back = Crossed("road-0", "start_to_end"), Crossed("road-0", "end_to_start")
    far = Crossed("road-8", "start_to_end")  # behind the bridges that are drawn
    plans = {"truck-1": Plan(Path(), [there, far, back], 10.0)}
    drawn = {f"road-{n}" for n in range(8)}
    lane = ("road-0", "truck-1")
    assert problems_of_view(Picture(drawn, Counter({lane: 2})), plans) == []
    for wrong in (
        Picture(drawn, Counter({lane: 1})),
        Picture(drawn, Counter({lane: 3})),
        Picture(drawn, Counter({lane: 2, ("road-1", "truck-1"): 1})),
        Picture(drawn - {"road-1"}, Counter({lane: 2})),
    ):
        assert len(problems_of_view(wrong, plans)) == 1


def test_the_way_is_what_was_described() -> None:
    """Each bridge of the road there, one less back, and the other carriageway in its place."""
    _, crossings = way(2, 9)
    names = [crossed.bridge for _, crossed in crossings]
    assert len(names) == 36
    assert names.count("other-carriageway") == 2
    assert names.count("road-3") == 2
    assert names.count("road-5") == 4
    assert not {"above", "across"} & set(names)
    assert len(site().bridges) == 12
