"""Which bridges are near, and on which of several beside or above each other a truck is."""

import random
from collections.abc import Callable

import numpy as np
import pytest

from schemas.site import Bridge, Receiver
from services.common.arrays import Floats
from services.common.geodesy import bridge_frame, to_lat_lon
from services.finding.bridges import Bridges, StaySearch
from services.finding.stays import Passage, Stay
from services.finding.streams import Fixes
from services.simulation.drive import paper_site
from services.simulation.positions import _altitude_m

ONE = paper_site().bridges[0]
TRUCK = paper_site().vehicles[0]
RECEIVER = Receiver()
FRAME = bridge_frame(ONE)
SPAN_M = ONE.span_m


def bridge(
    name: str,
    start: tuple[float, float],
    end: tuple[float, float],
    altitude_m: float | None = None,
) -> Bridge:
    """A bridge between two places in the paper's bridge's coordinates: (chainage, to the left)."""
    (a_lat, b_lat), (a_lon, b_lon) = to_lat_lon(FRAME, [start[0], end[0]], [start[1], end[1]])
    return ONE.model_copy(
        update={
            "id": name,
            "start_latitude_deg": float(a_lat),
            "start_longitude_deg": float(a_lon),
            "end_latitude_deg": float(b_lat),
            "end_longitude_deg": float(b_lon),
            "span_m": float(np.hypot(end[0] - start[0], end[1] - start[1])),
            "start_altitude_m": altitude_m,
            "end_altitude_m": altitude_m,
        }
    )


def fixes(
    place_m: Callable[[Floats], tuple[Floats, Floats]],
    stop_s: float = 20.0,
    altitude_m: float = 100.0,
    noise_m: float = 0.4,
    aside_m: float = 1.5,
) -> Fixes:
    """A drive by a receiver with noise and a slow error, in the same coordinates."""
    time_s = np.arange(round(10.0 * stop_s)) / 10.0
    along, aside = place_m(time_s)
    rng = np.random.default_rng(1)
    speed = np.hypot(np.gradient(along, time_s), np.gradient(aside, time_s))
    latitude, longitude = to_lat_lon(
        FRAME,
        along + noise_m * rng.standard_normal(time_s.size),
        aside + aside_m + noise_m * rng.standard_normal(time_s.size),
    )
    heights = altitude_m + 2.0 * rng.standard_normal(time_s.size)
    return Fixes(time_s, latitude, longitude, speed, heights)


def straight(lateral_m: float = 0.0, *, back: bool = False) -> Callable[[Floats], tuple]:  # type: ignore[type-arg]
    """Along the paper's bridge or beside it."""
    sign = -1.0 if back else 1.0
    return lambda t: (0.5 * SPAN_M + sign * (10.0 * t - 100.0), np.full(t.size, lateral_m))


def found(site: list[Bridge], drive: Fixes) -> list[tuple[str, Stay]]:
    bridges = Bridges(site, RECEIVER)
    return [(bridges.bridge(n).id, stay) for n, stay in bridges.all_stays(TRUCK, drive)]


def names(site: list[Bridge], drive: Fixes) -> list[str]:
    return [name for name, _ in found(site, drive)]


LEFT = bridge("left", (0.0, 14.0), (SPAN_M, 14.0))


@pytest.mark.parametrize("back", [False, True])
def test_of_two_carriageways_the_one_that_was_driven(back: bool) -> None:
    """Fourteen metres apart: either is within the corridor of the other."""
    both = [ONE, LEFT]
    assert names([ONE], fixes(straight(14.0, back=back))) == [ONE.id]
    for lateral_m, name in ((0.0, ONE.id), (14.0, "left")):
        drive = fixes(straight(lateral_m, back=back))
        ((where, stay),) = found(both, drive)
        assert (where, stay.direction) == (name, -1 if back else 1)
        assert names(both[::-1], drive) == [name]


def drawn_way(seed: int) -> Callable[[Floats], tuple[Floats, Floats]]:
    """To and fro about the bridge, with stops, and now and then on another road."""
    rng = np.random.default_rng(seed)
    ends = rng.choice([-120.0, -60.0, -20.0, 10.0, 40.0, 90.0, 150.0], 8)
    speed = rng.uniform(5.0, 25.0, 8)
    times, along = [0.0], [float(ends[0])]
    for end, fast, stop_s in zip(ends[1:], speed, rng.choice([0.0, 2.0], 8), strict=False):
        times += [times[-1] + max(abs(end - along[-1]) / fast, 0.1)]
        times += [times[-1] + stop_s + 0.01]
        along += [float(end)] * 2
    aside = rng.choice([0.0, 0.0, 0.0, 14.0, 80.0], len(times))

    def place(t: Floats) -> tuple[Floats, Floats]:
        return np.interp(t, times, along), np.interp(t, times, aside)

    return place


# Each is a drive of its own; the second thirty are for `make test-all`.
DRIVES = [*range(30), *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(30, 60))]


@pytest.mark.parametrize("seed", DRIVES)
def test_skipped_recheck_would_give_the_same_result(seed: int) -> None:
    """After every fix of a drive in which the receiver is out now and then."""
    drive = fixes(drawn_way(seed), 40.0)
    rng = np.random.default_rng(seed)
    out = rng.integers(0, 400, 3)
    kept = np.array([n for n in range(400) if not any(a <= n < a + 40 for a in out)])
    drive = Fixes(*(column[kept] for column in drive))
    bridges = Bridges([ONE, LEFT] if seed % 3 == 0 else [ONE], RECEIVER)
    search_stays: StaySearch | None = None
    spared = 0
    for n in range(1, kept.size + 1):
        so_far = Fixes(*(column[:n] for column in drive))
        here = float(so_far.latitude_deg[-1]), float(so_far.longitude_deg[-1])
        if search_stays is not None and bridges.is_as_it_was(search_stays, 0, TRUCK, *here):
            spared += 1
        else:
            search_stays = bridges.search_stays(0, TRUCK, so_far, search_stays)
        assert search_stays.stays == bridges.stays(0, TRUCK, so_far)
    assert (spared == 0) == (seed % 3 == 0)  # of two beside each other none is spared


def test_the_way_back_is_on_the_other_carriageway() -> None:
    def there_and_back(t: Floats) -> tuple[Floats, Floats]:
        along = np.where(t < 20.0, 10.0 * t - 80.0, 120.0 - 10.0 * (t - 20.0))
        return along, np.where(t < 20.0, 0.0, 14.0)

    assert names([ONE, LEFT], fixes(there_and_back, 45.0)) == [ONE.id, "left"]


@pytest.mark.parametrize("angle_deg", [20.0, 45.0, 90.0, 135.0])
@pytest.mark.parametrize("is_known", [False, True])
def test_a_road_across_is_no_crossing(angle_deg: float, is_known: bool) -> None:
    """Below or above, at an angle; it may cross by a bridge of its own."""
    turn = np.radians(angle_deg)

    def across(t: Floats) -> tuple[Floats, Floats]:
        way = 10.0 * t - 100.0
        return 0.5 * SPAN_M + way * np.cos(turn), way * np.sin(turn)

    half = 0.5 * SPAN_M * np.array([np.cos(turn), np.sin(turn)])
    middle = np.array([0.5 * SPAN_M, 0.0])
    other = bridge("other", tuple(middle - half), tuple(middle + half))
    assert names([ONE, other] if is_known else [ONE], fixes(across)) == (
        ["other"] if is_known else []
    )


@pytest.mark.parametrize(("altitude_m", "where"), [(100.0, "low"), (107.0, "high")])
def test_of_two_decks_above_each_other_the_one_at_its_height(altitude_m: float, where: str) -> None:
    low = bridge("low", (0.0, 0.0), (SPAN_M, 0.0), 100.0)
    high = bridge("high", (0.0, 0.0), (SPAN_M, 0.0), 107.0)
    assert names([low, high], fixes(straight(), altitude_m=altitude_m)) == [where]


@pytest.mark.parametrize(("altitude_m", "count"), [(100.0, 1), (106.0, 1), (88.0, 0), (115.0, 0)])
def test_far_above_or_below_the_deck_is_another_road(
    altitude_m: float, count: int, caplog: pytest.LogCaptureFixture
) -> None:
    """Metres are the receiver's error; a site file without altitudes asks for nothing."""
    known = bridge("known", (0.0, 0.0), (SPAN_M, 0.0), 100.0)
    drive = fixes(straight(), altitude_m=altitude_m)
    assert len(names([known], drive)) == count
    output = [record.getMessage() for record in caplog.records]
    assert len(output) == 1 - count
    assert all("known: a truck drove along it, but 1" in line for line in output)
    assert len(names([ONE], drive)) == 1


def test_unknown_altitude_is_no_other_road(caplog: pytest.LogCaptureFixture) -> None:
    known = bridge("known", (0.0, 0.0), (SPAN_M, 0.0), 100.0)
    drive = fixes(straight(), altitude_m=np.nan)
    assert names([known], drive) == ["known"]
    some = fixes(straight())
    some.altitude_m[::2] = np.nan
    assert names([known], some) == ["known"]
    far = fixes(straight(), altitude_m=88.0)
    far.altitude_m[::2] = np.nan
    assert names([known], far) == []
    assert len(caplog.records) == 1


def test_an_outage_over_the_bridge_is_a_passage() -> None:
    """Whose fixes are 700 m apart: both ends of it lie far from the bridge."""
    drive = fixes(lambda t: (25.0 * t - 1200.0, np.zeros(t.size)), 100.0)
    away = (drive.time_s < 35.0) | (drive.time_s > 63.0)
    gap = Fixes(*(column[away] for column in drive))
    ((where, stay),) = found([ONE], gap)
    assert (where, stay.passage) == (ONE.id, Passage.THROUGH)


def test_near_is_what_a_plain_search_finds() -> None:
    """Everywhere on the globe, also where longitudes end and where degrees are short."""
    rng = random.Random(1)
    places = [(rng.uniform(-88.0, 88.0), rng.uniform(-180.0, 180.0)) for _ in range(50)]
    places += [(10.0, 180.0), (-45.0, -180.0), (88.9, 179.9), (0.0, 0.0)]
    many = []
    for latitude, longitude in places:
        for n in range(20):
            step = 0.002 * n
            end = (longitude + step + 3e-4 + 180.0) % 360.0 - 180.0
            moved = (longitude + step + 180.0) % 360.0 - 180.0
            many.append(
                ONE.model_copy(
                    update={
                        "id": f"b{len(many)}",
                        "start_latitude_deg": latitude,
                        "start_longitude_deg": moved,
                        "end_latitude_deg": latitude,
                        "end_longitude_deg": end,
                    }
                )
            )
    bridges = Bridges(many, RECEIVER)
    for number in range(len(many)):
        frame = bridges.frame(number)
        for along in (-40.0, 0.0, 0.5 * SPAN_M, SPAN_M + 40.0):
            latitude, longitude = to_lat_lon(frame, along, 20.0)
            assert number in bridges.between(*2 * (float(latitude), float(longitude)))
            assert number in bridges.around(float(latitude), float(longitude))
        there = to_lat_lon(frame, [-3000.0, 3000.0], [500.0, -500.0])
        (a_lat, b_lat), (a_lon, b_lon) = there
        assert number in bridges.between(float(a_lat), float(a_lon), float(b_lat), float(b_lon))
        assert number not in bridges.between(*2 * (float(a_lat), float(a_lon)))


def test_what_is_asked_of_the_map_does_not_grow_with_it() -> None:
    """So many bridges are looked at for one fix, of ten or ten thousand."""
    looked = []
    for count in (10, 10_000):
        rng = np.random.default_rng(2)
        many = [ONE]
        for n in range(count - 1):
            north, east = rng.uniform(-0.5, 0.5, 2)
            update = {"id": f"b{n}"} | {
                f"{end}_{what}_deg": getattr(ONE, f"{end}_{what}_deg") + shift
                for end in ("start", "end")
                for what, shift in (("latitude", 0.01 + north), ("longitude", 0.01 + east))
            }
            many.append(ONE.model_copy(update=update))
        bridges = Bridges(many, RECEIVER)
        here = (ONE.start_latitude_deg, ONE.start_longitude_deg)
        looked.append(len(bridges.between(*here, *here)))
        assert 0 in bridges.between(*here, *here)
    assert looked[1] <= looked[0] + 2


def test_a_simulated_truck_drives_at_the_altitude_of_its_bridge() -> None:
    known = bridge("known", (0.0, 0.0), (SPAN_M, 0.0), 812.0)
    slope = known.model_copy(update={"end_altitude_m": 813.0})
    chainage_m = np.array([-50.0, 0.0, 0.5 * SPAN_M, SPAN_M, 100.0])
    assert list(_altitude_m(slope, chainage_m)) == [812.0, 812.0, 812.5, 813.0, 813.0]
    assert list(_altitude_m(ONE, chainage_m)) == [25.0] * 5
