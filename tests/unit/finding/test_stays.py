"""Passages over a bridge, found in positions that are noisy, missing, and of other roads."""

import itertools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

from services.common.arrays import Floats
from services.finding.stays import (
    CORRIDOR_M,
    STANDING_M_PER_S,
    AntennaFixes,
    Passage,
    Stay,
    _senses,
    find_stays,
)

SPAN_M = 30.0
WHEELBASE_M = 4.4


class Drive(NamedTuple):
    """Where the front axle is (start to end: antenna behind it), and how fast the truck is."""

    time_s: Floats
    front_m: Floats


def drive(front_m: Callable[[Floats], Floats], stop_s: float, rate_hz: float = 10.0) -> Drive:
    time_s = np.arange(round(stop_s * rate_hz) + 1) / rate_hz
    return Drive(time_s, front_m(time_s))


def legs(*points: tuple[float, float], rate_hz: float = 10.0) -> Drive:
    """Straight lines between (time, front axle)."""
    times, places = np.array(points).T
    return drive(lambda t: np.asarray(np.interp(t, times, places)), times[-1], rate_hz)


def stays_of(
    driven: Drive,
    *,
    antenna_m: float = 0.0,
    noise_m: float = 0.0,
    seed: int = 0,
    lateral_m: float | Floats = 0.0,
    kept: NDArray[np.bool_] | None = None,
    span_m: float = SPAN_M,
    reverses: bool = False,
    wander_m: float | Floats = 0.0,
) -> list[Stay]:
    time_s, front = driven
    rng = np.random.default_rng(seed)
    velocity = np.gradient(front, time_s)
    heading = np.sign(velocity)
    for n in range(1, heading.size):  # a truck that stands still looks where it came
        heading[n] = heading[n] or heading[n - 1]
    heading = np.full(front.size, heading[1]) if reverses else heading
    antenna = front - heading * antenna_m + noise_m * rng.standard_normal(front.size) + wander_m
    speed = np.abs(np.abs(velocity) + (0.07 if noise_m else 0.0) * rng.standard_normal(front.size))
    lateral = np.broadcast_to(np.asarray(lateral_m, float), front.shape)
    lateral = lateral + noise_m * rng.standard_normal(front.size)
    kept = np.ones(front.size, dtype=bool) if kept is None else kept
    return find_stays(
        AntennaFixes(time_s[kept], antenna[kept], lateral[kept], speed[kept]),
        span_m=span_m,
        wheelbase_m=WHEELBASE_M,
        antenna_to_front_axle_m=antenna_m,
    )


def only(stays: list[Stay]) -> Stay:
    assert len(stays) == 1, stays
    return stays[0]


@pytest.mark.parametrize("antenna_m", [-1.5, 0.0, 3.0, 9.0])
@pytest.mark.parametrize("direction", [1, -1])
@pytest.mark.parametrize("speed", [3.0, 11.3, 25.0])
def test_entry_and_exit_of_a_steady_drive(antenna_m: float, direction: int, speed: float) -> None:
    near, far = (0.0, SPAN_M) if direction > 0 else (SPAN_M, 0.0)
    driven = drive(lambda t: near + direction * (speed * t - 87.0), 200.0 / speed)
    stay = only(stays_of(driven, antenna_m=antenna_m))
    assert (stay.passage, stay.direction, stay.is_over) == (Passage.THROUGH, direction, True)
    assert stay.entry_s == pytest.approx(87.0 / speed, abs=1e-9)
    assert stay.exit_s == pytest.approx((87.0 + abs(far - near) + WHEELBASE_M) / speed, abs=1e-9)


@pytest.mark.parametrize("rate_hz", [1.0, 10.0])
@pytest.mark.parametrize("speed", [3.0, 5.0, 10.0, 25.0])
def test_noise_of_a_receiver_never_makes_two_of_one(speed: float, rate_hz: float) -> None:
    for seed in range(100):
        for direction in (1, -1):
            begin = 15.0 - direction * (100.0 + seed / 50.0)
            end = begin + direction * 200.0
            driven = legs((0.0, begin), (200.0 / speed, end), rate_hz=rate_hz)
            stay = only(stays_of(driven, antenna_m=1.0, noise_m=0.4, seed=seed))
            assert (stay.passage, stay.direction) == (Passage.THROUGH, direction)
            # Within the first metres the last passing counts: noise of 0.4 m once or twice.
            entry_s = (85.0 + seed / 50.0) / speed
            assert abs(stay.entry_s - entry_s) < 1.6 / speed + 0.1
            exit_s = (115.0 + WHEELBASE_M + seed / 50.0) / speed
            assert abs(stay.exit_s - exit_s) < 1.6 / speed + 0.1


def test_every_prefix_of_a_drive_gives_the_same_results() -> None:
    """Fix by fix, as the worker sees it: found once, and never undone."""
    for seed in range(4):
        driven = drive(lambda t: 4.0 * t - 60.0, 40.0)
        story: list[Stay] = []
        for size in range(2, driven.time_s.size + 1):
            kept = np.arange(driven.time_s.size) < size
            stays = stays_of(driven, noise_m=0.4, seed=seed, kept=kept)
            assert len(stays) <= 1
            assert len(stays) >= len(story)
            if stays:
                if story and stays[0].is_over:
                    assert stays[0].passage is Passage.THROUGH
                story = stays
        settled = [s for s in story if s.is_over]
        assert len(settled) == 1


def test_a_receiver_that_was_out_over_the_whole_bridge() -> None:
    driven = drive(lambda t: 10.0 * t - 50.0, 15.0)
    kept = (driven.front_m < -12.0) | (driven.front_m > 50.0)
    stay = only(stays_of(driven, kept=kept))
    assert stay.passage is Passage.THROUGH
    assert stay.entry_s == pytest.approx(5.0, abs=0.01)
    assert stay.exit_s == pytest.approx(8.44, abs=0.01)


@pytest.mark.parametrize("forward", [True, False])
@pytest.mark.parametrize("hole_s", [31.0, 591.0])
def test_no_crossing_is_assumed_in_a_long_silence(hole_s: float, *, forward: bool) -> None:
    """Its path is unknown; within half a minute it is known."""
    for silent_s, count in ((29.0, 1), (hole_s, 0)):
        way = [(0.0, -200.0), (10.0, -100.0), (10.0 + silent_s, 140.0), (20.0 + silent_s, 240.0)]
        driven = legs(*((t, x if forward else SPAN_M - x) for t, x in way))
        kept = out(driven, 10.05, 9.95 + silent_s)
        for noise_m in (0.0, 0.4):
            found = stays_of(driven, kept=kept, noise_m=noise_m)
            assert [stay.passage for stay in found] == [Passage.THROUGH] * count


@pytest.mark.parametrize("leaves", [True, False])
@pytest.mark.parametrize("hole_s", [60.0, 591.0])
def test_positions_are_bridged_for_eight_seconds(hole_s: float, *, leaves: bool) -> None:
    """Seen at 15 m, and then, or before that, far from the bridge after a silence."""
    way = [(0.0, -85.0), (10.0, 15.0), (10.0 + hole_s, 140.0), (20.0 + hole_s, 240.0)]
    if not leaves:
        way = [(0.0, -200.0), (10.0, -100.0), (10.0 + hole_s, 15.0), (20.0 + hole_s, 115.0)]
    driven = legs(*way)
    stay = only(stays_of(driven, kept=out(driven, 10.05, 9.95 + hole_s)))
    assert stay.passage is Passage.THROUGH
    assert stay.exit_s - stay.entry_s < 8.0 + 3.5
    on_it_s = 10.0 if leaves else 10.0 + hole_s
    assert stay.entry_s <= on_it_s <= stay.exit_s


def test_a_truck_at_the_end_of_the_bridge_is_not_on_it_in_a_silence() -> None:
    """Its receiver's noise has put it a metre onto the bridge."""
    driven = legs((0.0, -99.0), (10.0, 1.0), (601.0, 140.0), (611.0, 240.0))
    assert stays_of(driven, kept=out(driven, 10.05, 600.95)) == []


def out(driven: Drive, begin_s: float, stop_s: float) -> NDArray[np.bool_]:
    """The fixes that are left when the receiver, or the truck, was off for a while."""
    return np.asarray((driven.time_s < begin_s) | (driven.time_s >= stop_s))


@pytest.mark.parametrize("off_s", [2.0, 20.0, 120.0, 3600.0])
@pytest.mark.parametrize("stands_s", [0.0, 30.0])
@pytest.mark.parametrize("forward", [True, False])
@pytest.mark.parametrize("noise_m", [0.0, 0.4])
def test_new_run_on_the_first_side_is_no_return_crossing(
    off_s: float, stands_s: float, noise_m: float, *, forward: bool
) -> None:
    """It was off meanwhile, and may stand for a while before and after that."""
    ends_s, begins_s = 20.0 + stands_s, 20.0 + stands_s + off_s
    goes_s = begins_s + stands_s
    way = [(0.0, -60.0), (20.0, 140.0), (ends_s, 140.0), (begins_s, -60.0), (goes_s, -60.0)]
    way = [*dict(way).items(), (goes_s + 20.0, 140.0)]
    driven = legs(*((t, x if forward else SPAN_M - x) for t, x in way))
    found = stays_of(driven, kept=out(driven, ends_s + 0.05, begins_s - 0.05), noise_m=noise_m)
    assert [stay.passage for stay in found] == [Passage.THROUGH] * 2
    assert [stay.direction for stay in found] == [1 if forward else -1] * 2


def test_nothing_is_published_before_it_is_known() -> None:
    """A message that it was detected could not be taken back."""
    driven = legs((0.0, -60.0), (20.0, 140.0), (620.0, -60.0), (640.0, 140.0))
    kept = out(driven, 20.05, 619.95)
    for stop_s in np.arange(620.0, 626.0, 0.1):
        assert len(stays_of(driven, kept=kept & (driven.time_s < stop_s))) == 1


def test_unseen_return_counts_as_a_crossing() -> None:
    """Its receiver was out from behind the bridge to before it."""
    driven = legs((0.0, -60.0), (15.0, 90.0), (16.0, 90.0), (31.0, -60.0), (41.0, -160.0))
    first, second = stays_of(driven, kept=out(driven, 14.5, 28.5))
    assert (first.passage, first.direction) == (Passage.THROUGH, 1)
    assert (second.passage, second.direction) == (Passage.THROUGH, -1)


def test_a_short_bridge_between_two_fixes() -> None:
    """6 m at 25 m/s with one fix a second: never seen on the bridge."""
    for begin in np.linspace(0.0, 1.0, 41):
        for direction in (1, -1):
            first = 3.0 - direction * (25.0 * begin + 103.0)
            driven = legs((0.0, first), (10.0, first + direction * 250.0), rate_hz=1.0)
            stay = only(stays_of(driven, span_m=6.0))
            assert (stay.passage, stay.direction) == (Passage.THROUGH, direction)
            assert stay.entry_s == pytest.approx(begin + 4.0, abs=1e-9)
            assert stay.exit_s == pytest.approx(begin + (106.0 + WHEELBASE_M) / 25.0, abs=1e-9)


def test_turning_back_on_the_bridge() -> None:
    stay = only(stays_of(legs((0, -60), (8, 20), (10, 20), (20, -80)), noise_m=0.2))
    assert stay.passage is Passage.TURNED_BACK
    assert stay.is_over
    assert stay.entry_s == pytest.approx(6.0, abs=0.1)


def test_turning_back_before_the_bridge_is_no_crossing() -> None:
    for seed in range(50):
        assert stays_of(legs((0, -60), (6, -0.5), (60, -0.5), (70, -90)), noise_m=0.4) == []
        assert stays_of(legs((0, -60), (6, 1.0), (70, -90)), noise_m=0.4, seed=seed) == []


@pytest.mark.parametrize("direction", [1, -1])
def test_beginning_and_ending_on_the_bridge(direction: int) -> None:
    begins = drive(lambda t: 15.0 + direction * 8.0 * t, 10.0)
    stay = only(stays_of(begins))
    assert (stay.passage, stay.direction) == (Passage.BEGINS_ON_BRIDGE, direction)
    assert stay.is_over
    assert stay.entry_s == 0.0
    ends = drive(lambda t: 15.0 + direction * (8.0 * t - 80.0), 10.0)
    stay = only(stays_of(ends))
    assert (stay.passage, stay.direction) == (Passage.ENDS_ON_BRIDGE, direction)
    assert not stay.is_over
    stay = only(stays_of(drive(lambda t: np.full(t.shape, 15.0), 10.0), noise_m=0.4))
    assert stay.passage is Passage.BEGINS_ON_BRIDGE
    assert not stay.is_over


@pytest.mark.parametrize("offset_m", [40.0, -40.0, 300.0])
def test_a_parallel_road(offset_m: float) -> None:
    driven = drive(lambda t: 10.0 * t - 90.0, 20.0)
    assert stays_of(driven, lateral_m=offset_m, noise_m=0.4) == []
    assert stays_of(driven, lateral_m=offset_m, kept=np.abs(driven.front_m - 15.0) > 40.0) == []
    assert len(stays_of(driven, lateral_m=0.2 * offset_m * (abs(offset_m) < 100.0))) == 1


@pytest.mark.parametrize("length_m", [45.0, 500.0])
def test_a_road_that_passes_below(length_m: float) -> None:
    """Across the bridge: along its line the truck stands in the middle all the time."""
    time_s = np.linspace(0.0, 2.0 * length_m / 10.0, 200)
    lateral = np.linspace(-length_m, length_m, 200)
    below = Drive(time_s, 15.0 + 0.02 * lateral)
    assert stays_of(below, lateral_m=lateral) == []


def test_a_curved_road_before_and_behind() -> None:
    driven = drive(lambda t: 10.0 * t - 150.0, 35.0)
    away = np.maximum(np.abs(driven.front_m - 15.0) - 50.0, 0.0)
    assert only(stays_of(driven, lateral_m=3.0 * away)).passage is Passage.THROUGH


def test_one_wild_fix_beside_the_road() -> None:
    driven = drive(lambda t: 10.0 * t - 90.0, 20.0)
    for wild in range(85, 130):
        lateral = np.where(np.arange(driven.time_s.size) == wild, 200.0, 0.0)
        assert only(stays_of(driven, lateral_m=lateral)).passage is Passage.THROUGH


@pytest.mark.parametrize("antenna_m", [0.0, 3.0])
@pytest.mark.parametrize("where", ["before", "on", "behind"])
def test_a_truck_that_waits(where: str, antenna_m: float) -> None:
    place = {"before": -0.4, "on": 12.0, "behind": SPAN_M + WHEELBASE_M + 0.4}[where]
    begin = (place + 60.0) / 10.0
    driven = legs((0, -60), (begin, place), (begin + 90, place), (begin + 100, place + 100))
    for seed in range(40):
        stay = only(stays_of(driven, noise_m=0.4, seed=seed, antenna_m=antenna_m))
        assert stay.passage is Passage.THROUGH
        entry_s, exit_s = {
            "before": (begin + 90.0, begin + 93.5),
            "on": (6.0, begin + 92.2),
            "behind": (6.0, begin),
        }[where]
        assert stay.exit_s == pytest.approx(exit_s, abs=0.4)
        # Whoever waits this near may be thought to have entered at his last move before.
        assert stay.entry_s == pytest.approx(entry_s, abs=0.4)


def test_wandering_positions_of_a_truck_that_stands_do_not_turn_it() -> None:
    """A slow error of 4 m, larger than the margin; the truck stands with its tail on the bridge."""
    driven = legs((0, -60), (9.1, 31), (99.1, 31), (109.1, 131))
    wander = 2.0 * np.sin(driven.time_s / 7.0)
    stay = only(stays_of(driven, wander_m=wander))
    assert stay.passage is Passage.THROUGH
    assert stay.exit_s == pytest.approx(99.1 + 0.34, abs=0.3)


def senses_fix_by_fix(antenna_m: Floats, speed_m_per_s: Floats, margin_m: float) -> Floats:
    """What `_senses` must give, as a driver would see it."""
    sense = np.zeros(antenna_m.size)
    current = 0.0
    lowest = highest = farthest = 0
    for n in np.flatnonzero(np.abs(speed_m_per_s) >= STANDING_M_PER_S):
        here = antenna_m[n]
        if current == 0.0:
            lowest = n if here < antenna_m[lowest] else lowest
            highest = n if here > antenna_m[highest] else highest
            if max(here - antenna_m[lowest], antenna_m[highest] - here) > margin_m:
                current = 1.0 if here - antenna_m[lowest] > margin_m else -1.0
                sense[0], farthest = current, n
        elif (here - antenna_m[farthest]) * current > 0.0:
            farthest = n
        elif (antenna_m[farthest] - here) * current > margin_m:
            sense[farthest + 1] = -2.0 * current
            current, farthest = -current, n
    return np.asarray(np.cumsum(sense)) if current else np.ones(antenna_m.size)


def test_the_sense_of_travel_is_the_same_fix_by_fix() -> None:
    rng = np.random.default_rng(0)
    turns = 0
    for _ in range(500):
        size = rng.integers(2, 100)
        steps = rng.choice([0.5, 1.0, 3.0]) * rng.standard_normal(size)
        place = np.round(np.cumsum(steps)) if rng.random() < 0.3 else np.cumsum(steps)
        speed = rng.choice([0.2, 5.0], size) if rng.random() < 0.5 else np.full(size, 5.0)
        found = _senses(place, speed, 3.0)
        assert np.array_equal(found, senses_fix_by_fix(place, speed, 3.0))
        turns += np.count_nonzero(np.diff(found))
    assert turns > 500


@pytest.mark.parametrize("antenna_m", [-1.5, 0.0, 3.0])
def test_a_truck_that_backs_away_was_not_on_the_bridge(antenna_m: float) -> None:
    driven = legs((0, -60), (6, -0.5), (16, -0.5), (30, -90))
    assert stays_of(driven, reverses=True, antenna_m=antenna_m, noise_m=0.1) == []


def test_return_within_five_seconds_is_one_crossing() -> None:
    stay = only(stays_of(legs((0, -20), (2, 4), (4, -1), (14, 99)), reverses=True))
    assert stay.passage is Passage.THROUGH
    stays = stays_of(legs((0, -20), (2, 4), (4, -1), (9, -1), (19, 99)), reverses=True)
    assert [one.passage for one in stays] == [Passage.TURNED_BACK, Passage.THROUGH]


def test_an_oblique_road_below() -> None:
    """It passes under the bridge's middle, but comes from 45 m beside its end."""
    driven = drive(lambda t: 15.0 + 3.0 * (t - 20.0), 40.0)
    assert stays_of(driven, lateral_m=3.0 * (driven.front_m - 15.0)) == []


def test_to_and_fro() -> None:
    driven = legs((0, -60), (13, 70), (16, 70), (30, -70), (33, -70), (46, 60))
    stays = stays_of(driven, noise_m=0.3, antenna_m=2.0)
    assert [(s.passage, s.direction) for s in stays] == [
        (Passage.THROUGH, 1),
        (Passage.THROUGH, -1),
        (Passage.THROUGH, 1),
    ]
    assert all(a.exit_s < b.entry_s for a, b in itertools.pairwise(stays))


def test_two_bridges_in_a_row() -> None:
    """The same positions in the chainage of each: 20 m of road between them."""
    driven = drive(lambda t: 10.0 * t - 90.0, 30.0)
    first = only(stays_of(driven, noise_m=0.4))
    second = only(stays_of(Drive(driven.time_s, driven.front_m - SPAN_M - 20.0), noise_m=0.4))
    assert first.exit_s < second.entry_s
    assert second.entry_s - first.entry_s == pytest.approx(5.0, abs=0.3)


def test_a_truck_longer_than_the_bridge() -> None:
    driven = drive(lambda t: 5.0 * t - 40.0, 16.0)
    for seed in range(50):
        stay = only(stays_of(driven, span_m=4.0, noise_m=0.4, seed=seed))
        assert stay.passage is Passage.THROUGH
        assert stay.exit_s - stay.entry_s == pytest.approx((4.0 + WHEELBASE_M) / 5.0, abs=0.6)


def test_no_fixes_no_stays() -> None:
    for size in (0, 1):
        nothing = np.zeros(size)
        sizes = {"span_m": 30.0, "wheelbase_m": 4.4, "antenna_to_front_axle_m": 0.0}
        assert find_stays(AntennaFixes(nothing, nothing, nothing, nothing), **sizes) == []


def test_the_corridor_is_as_wide_as_it_says() -> None:
    driven = drive(lambda t: 10.0 * t - 90.0, 20.0)
    assert len(stays_of(driven, lateral_m=CORRIDOR_M - 0.1)) == 1
    assert stays_of(driven, lateral_m=CORRIDOR_M + 0.1) == []
