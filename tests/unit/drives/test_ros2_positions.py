"""Speeds of fixes: the receiver's own, or slopes of positions."""

import math

import pytest

from schemas.wgs84 import SEMI_MAJOR_AXIS_M
from services.drives.ros2_anomalies import AnomalyCounts
from services.drives.ros2_messages import Fix, Velocity
from services.drives.ros2_positions import FixWithSpeed, SpeedEstimator

FIRST_NS = 1_700_000_000_000_000_000
TENTH_NS = 100_000_000
PAST = "stamps repeated or in the past, left out"


def fix(stamp_ns: int, longitude_deg: float = 8.0) -> Fix:
    return Fix(stamp_ns, True, 0.0, longitude_deg, 100.0, None, None)


def test_a_velocity_of_the_same_stamp_is_taken_whichever_comes_first() -> None:
    stamps = [FIRST_NS + number * TENTH_NS for number in range(30)]
    expected = [FixWithSpeed(fix(stamp), float(number)) for number, stamp in enumerate(stamps)]
    for lead in (0, 1, 25):
        positions = SpeedEstimator("/fix", "/vel", AnomalyCounts())
        found: list[FixWithSpeed] = []
        for number in range(len(stamps) + lead):
            if number < len(stamps):
                found += positions.add_fix(fix(stamps[number]))
            if number >= lead:
                found += positions.add_velocity(Velocity(stamps[number - lead], number - lead))
        assert found + positions.finish() == expected


def test_between_two_velocities_the_speed_is_linear() -> None:
    positions = SpeedEstimator("/fix", "/vel", AnomalyCounts())
    assert positions.add_velocity(Velocity(FIRST_NS, 10.0)) == []
    assert positions.add_fix(fix(FIRST_NS + TENTH_NS)) == []
    (found,) = positions.add_velocity(Velocity(FIRST_NS + 4 * TENTH_NS, 14.0))
    assert found.speed_m_per_s == pytest.approx(11.0)


def test_fix_without_a_near_velocity_is_excluded_and_reported() -> None:
    anomalies = AnomalyCounts()
    positions = SpeedEstimator("/fix", "/vel", anomalies)
    positions.add_velocity(Velocity(FIRST_NS, 10.0))
    positions.add_fix(fix(FIRST_NS + 10 * TENTH_NS))
    assert positions.add_velocity(Velocity(FIRST_NS + 20 * TENTH_NS, 10.0)) == []
    # Where none comes any more, fixes are held for half a minute.
    for number in range(400):
        assert positions.add_fix(fix(FIRST_NS + (30 + number) * TENTH_NS)) == []
    assert anomalies.count("/fix", "fixes without a velocity, left out") == 1 + 99
    assert positions.finish() == []
    assert anomalies.count("/fix", "fixes without a velocity, left out") == 401


def test_without_a_topic_of_velocities_the_speed_is_the_slope_of_the_positions() -> None:
    positions = SpeedEstimator("/fix", None, AnomalyCounts())
    found: list[FixWithSpeed] = []
    for number in range(40):
        # At the equator, eastward at 12 m/s over the line where longitudes begin anew.
        turn = math.degrees(12.0 * (number - 20) / 10 / SEMI_MAJOR_AXIS_M)
        longitude = 180.0 + turn if turn < 0 else turn - 180.0
        found += positions.add_fix(fix(FIRST_NS + number * TENTH_NS, longitude))
        assert len(found) == max(0, number - 9)  # a second later
    found += positions.finish()
    assert [one.fix.stamp_ns for one in found] == [FIRST_NS + n * TENTH_NS for n in range(40)]
    assert [one.speed_m_per_s for one in found] == pytest.approx([12.0] * 40, rel=1e-6)


def test_a_fix_that_is_alone_has_no_speed() -> None:
    anomalies = AnomalyCounts()
    positions = SpeedEstimator("/fix", None, anomalies)
    for number in range(3):
        assert positions.add_fix(fix(FIRST_NS + number * 50 * TENTH_NS)) == []
    assert positions.finish() == []
    reported = "fixes without another near enough for a speed, left out"
    assert anomalies.count("/fix", reported) == 3


def test_what_comes_twice_is_left_out_and_a_clock_that_went_back_is_followed() -> None:
    anomalies = AnomalyCounts()
    positions = SpeedEstimator("/fix", None, anomalies)
    stamps = [FIRST_NS + number * TENTH_NS for number in range(60)]
    found: list[FixWithSpeed] = []
    for stamp in [*stamps[:30], stamps[29], *stamps[30:]]:
        found += positions.add_fix(fix(stamp))
    assert anomalies.count("/fix", PAST) == 1
    for stamp in stamps:
        found += positions.add_fix(fix(stamp - 3600 * 10 * TENTH_NS))
    found += positions.finish()
    assert anomalies.count("/fix", "steps back of the clock") == 1
    assert len(found) == 60 + 60 - 20


def test_duplicate_velocities_are_reported() -> None:
    anomalies = AnomalyCounts()
    positions = SpeedEstimator("/fix", "/vel", anomalies)
    for _ in range(3):
        positions.add_velocity(Velocity(FIRST_NS, 10.0))
    assert anomalies.count("/vel", PAST) == 2
