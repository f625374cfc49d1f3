"""What a ROS 2 truck says as one of ours would: axes, gravity, frames, stamps, fixes."""

import math
from collections.abc import Callable

import numpy as np
import pytest

from schemas.signals import GnssFix, encode_gnss
from schemas.site import Site
from schemas.site_file import parse_site, site_toml
from services.common.errors import InputError
from services.drives.ros2_anomalies import WRONG_RATE
from services.drives.ros2_messages import FIX, IMU, TWIST
from services.drives.ros2_samples import RateError
from services.drives.ros2_truck import Accel, Ros2Truck
from services.simulation.drive import paper_site
from tests import ros2

FIRST_NS = 1_700_000_000_000_000_000
FRONT = ros2.TOPICS["sprung_front"]


def site(text: str = ros2.ROS2, *, speed_noise: float = 0.07) -> Site:
    declared = site_toml(paper_site())
    noise = "speed_noise_m_per_s = 0.07"
    assert noise in declared
    declared = declared.replace(noise, f"speed_noise_m_per_s = {speed_noise}")
    return parse_site(declared + text, "site.toml")


def truck(
    text: str = ros2.ROS2,
    *,
    speed_noise: float = 0.07,
    wrong_rate: Callable[[RateError], None] | None = None,
) -> Ros2Truck:
    return Ros2Truck(site(text, speed_noise=speed_noise), "site.toml", "truck-1", wrong_rate)


def accelerations(of: Ros2Truck, make: Callable[[int], bytes], count: int = 20) -> np.ndarray:
    found: list[Accel | GnssFix] = []
    for number in range(count):
        stamp_ns = FIRST_NS + number * 1_000_000
        found += of.convert(FRONT, IMU, make(stamp_ns), stamp_ns)
    found += of.finish()
    batches = [one.channels["sprung_front"].samples for one in found if isinstance(one, Accel)]
    return np.concatenate(batches) if batches else np.empty(0)


def test_topics_become_the_channels_that_the_vehicle_names() -> None:
    sensors = "".join(
        f'[[vehicle.sensors]]\nchannel = "{name}"\nnoise_density_ug_per_rthz = 25\n{where}\n'
        for name, where in (
            ("f", 'on = "body"\nposition_m = 0.0'),
            ("r", 'on = "body"\nposition_m = 4.4'),
            ("a", 'on = "axle"\naxle = 1\nrate_hz = 500.0'),
            ("b", 'on = "axle"\naxle = 2'),
        )
    )
    declared = site_toml(paper_site()).replace("[bridge]", f"{sensors}[bridge]")
    text = f"""
[ros2]
vehicle = "truck-1"
gnss = "/gps/fix"
velocity = "/gps/vel"
[ros2.imu]
a = {{ topic = "{FRONT}" }}
"""
    one = Ros2Truck(parse_site(declared + text, "site.toml"), "site.toml", "truck-1")
    found: list[Accel | GnssFix] = []
    for number in range(20):
        stamp_ns = FIRST_NS + number * 2_000_000
        found += one.convert(FRONT, IMU, ros2.imu(stamp_ns, 1.5), stamp_ns)
    found += one.finish()
    batches = [batch for batch in found if isinstance(batch, Accel)]
    assert {name for batch in batches for name in batch.channels} == {"a"}
    assert sum(batch.channels["a"].samples.size for batch in batches) == 20


@pytest.mark.parametrize(
    ("extra", "gravity", "expected"),
    [
        ("", 9.80665, 1.5),
        (', axis = "z"', 9.80665, 1.5),
        (', axis = "-z"', -9.80665 - 3.0, 1.5),
        (', axis = "x", gravity_included = false', 0.0, 0.25),
        (', axis = "-y", gravity_included = false', 0.0, 0.5),
        (', axis = "y"', 0.0, -0.5 - 9.80665),
        (", gravity_included = false", 0.0, 1.5),
    ],
)
def test_the_axis_that_is_up_is_taken_and_gravity_is_off(
    extra: str, gravity: float, expected: float
) -> None:
    # The axis z says 1.5 m/s² and gravity as it is seen; x and y always 0.25 and −0.5.
    text = ros2.ROS2.replace(f'"{FRONT}"', f'"{FRONT}"{extra}')
    found = accelerations(truck(text), lambda at: ros2.imu(at, 1.5, gravity=gravity))
    np.testing.assert_allclose(found, np.full(20, expected), atol=1e-12)


def test_messages_of_another_frame_and_without_accelerometer_are_left_out() -> None:
    text = ros2.ROS2.replace(f'"{FRONT}"', f'"{FRONT}", frame = "front"')
    of = truck(text)
    assert accelerations(of, lambda at: ros2.imu(at, 0.0, "front")).size == 20
    of = truck(text)
    assert accelerations(of, lambda at: ros2.imu(at, 0.0, "rear")).size == 0
    kind = "messages of another frame, left out"
    assert f"{FRONT}: 20 {kind} (the first 'rear', not 'front')" in of.anomalies.news()
    of = truck()
    none = np.array([-1.0, *np.zeros(8)])
    assert accelerations(of, lambda at: ros2.imu(at, 0.0, covariance=none)).size == 0
    assert of.anomalies.count(FRONT, "messages declared to be without acceleration, left out") == 20


def test_a_topic_is_one_sensor_s() -> None:
    """Two of one topic, distinguished by who publishes or by their frames: the first is heard."""
    for publishers, frames in (((b"one", b"two"), ("a", "a")), ((b"", b""), ("a", "b"))):
        of = truck()
        found: list[Accel | GnssFix] = []
        for number in range(3000):
            at = FIRST_NS + number * 1_000_000
            for which in (0, 1):
                stamp_ns = at + which * 300_000
                payload = ros2.imu(stamp_ns, float(which), frames[which])
                found += of.convert(FRONT, IMU, payload, stamp_ns, publishers[which])
        found += of.finish()
        batches = [one.channels["sprung_front"] for one in found if isinstance(one, Accel)]
        assert {batch.rate_hz for batch in batches} == {1000.0}
        samples = np.concatenate([batch.samples for batch in batches])
        np.testing.assert_allclose(samples, np.zeros(3000), atol=4e-15)
        assert of.anomalies.count(FRONT, "messages of a second sensor, left out") == 3000


def test_a_sensor_that_was_started_anew_goes_on() -> None:
    of = truck()
    found: list[Accel | GnssFix] = []
    for publisher, frame, begin in ((b"one", "a", 0), (b"two", "a", 4000), (b"two", "b", 8000)):
        for number in range(begin, begin + 2500):
            stamp_ns = FIRST_NS + number * 1_000_000
            found += of.convert(FRONT, IMU, ros2.imu(stamp_ns, 1.0, frame), stamp_ns, publisher)
    found += of.finish()
    batches = [one.channels["sprung_front"] for one in found if isinstance(one, Accel)]
    assert sum(batch.samples.size for batch in batches) == 7500
    assert of.anomalies.count(FRONT, "changes to another sensor") == 2


def drive(
    of: Ros2Truck, publisher: bytes, begin_s: float, count: int, rate_hz: float
) -> list[float]:
    """Publish `count` samples, whose value is their rate; return the values published."""
    found: list[Accel | GnssFix] = []
    for number in range(count):
        stamp_ns = FIRST_NS + round((begin_s + number / rate_hz) * 1e9)
        found += of.convert(FRONT, IMU, ros2.imu(stamp_ns, rate_hz), stamp_ns, publisher)
    return values(found)


def values(found: list[Accel | GnssFix]) -> list[float]:
    batches = [one.channels["sprung_front"].samples for one in found if isinstance(one, Accel)]
    return [round(value) for batch in batches for value in batch.tolist()]


def test_wrong_rate_ends_a_truck_only_where_nobody_takes_it() -> None:
    with pytest.raises(
        RateError, match=r"a rate of 400 Hz, but sensor.rate_hz of site.toml is 1000"
    ):
        drive(truck(), b"one", 0.0, 900, 400.0)
    errors: list[RateError] = []
    of = truck(wrong_rate=errors.append)
    assert drive(of, b"one", 0.0, 900, 400.0) == []
    assert [error.samples for error in errors] == [801]  # of two seconds
    assert of.anomalies.count(FRONT, WRONG_RATE) == 900
    (refusals,) = of.anomalies.refusals()
    assert (refusals.topic, refusals.refused, refusals.dropped) == (FRONT, 900, 0)
    assert "900 messages at a wrong rate, left out (its stamps give a rate of 400" in refusals.text
    of.anomalies.reported(FRONT)
    assert of.anomalies.refusals() == []


def test_topic_of_a_stranger_with_a_wrong_rate_is_free_again() -> None:
    of = truck(wrong_rate=lambda error: None)
    assert drive(of, b"stranger", 0.0, 900, 400.0) == []
    assert drive(of, b"one", 2.5, 3000, 1000.0) == [1000] * 3000


def test_stranger_is_not_put_on_the_grid_of_a_silent_sensor() -> None:
    """Its rate is measured, as that of every sensor that takes a topic over."""
    of = truck(wrong_rate=lambda error: None)
    assert drive(of, b"one", 0.0, 3000, 1000.0) == [1000] * 3000
    assert drive(of, b"stranger", 5.0, 900, 400.0) == []
    assert drive(of, b"one", 8.0, 2500, 1000.0) == [1000] * 2500


def test_sensor_with_a_wrong_rate_is_measured_again() -> None:
    """It was set right meanwhile, without being another publisher."""
    of = truck(wrong_rate=lambda error: None)
    assert drive(of, b"one", 0.0, 900, 400.0) == []
    assert drive(of, b"one", 5.0, 3000, 1000.0) == []
    assert drive(of, b"one", 20.0, 3000, 1000.0) == [1000] * 3000


def test_end_of_a_drive_is_not_lost_by_a_wrong_rate() -> None:
    of = truck(wrong_rate=lambda error: None)
    rear = ros2.TOPICS["sprung_rear"]
    for number in range(50):
        stamp_ns = FIRST_NS + number * 2_500_000
        of.convert(FRONT, IMU, ros2.imu(stamp_ns, 0.0), stamp_ns)
        stamp_ns = FIRST_NS + number * 1_000_000
        of.convert(rear, IMU, ros2.imu(stamp_ns, 0.0), stamp_ns)
    left = of.finish()
    assert [tuple(one.channels) for one in left if isinstance(one, Accel)] == [("sprung_rear",)]
    assert of.anomalies.count(FRONT, WRONG_RATE) == 50


def test_a_clock_that_was_ahead_at_first_does_not_stop_the_truck_s_own() -> None:
    """Set back by an hour, as by NTP: times on the truck's own clock still ascend."""
    of = truck()
    found: list[Accel | GnssFix] = []
    for ahead_s, count in ((3600, 3000), (0, 5000)):
        for number in range(count):
            stamp_ns = FIRST_NS + ahead_s * 10**9 + number * 1_000_000
            found += of.convert(FRONT, IMU, ros2.imu(stamp_ns, 0.0), stamp_ns)
    found += of.finish()
    times = [one.device_time_ns for one in found if isinstance(one, Accel)]
    assert times == sorted(set(times))
    assert len(times) == 30 + 40  # a second of the new time has shown that it is one


def test_stamps_must_be_near_the_time_of_sending() -> None:
    of = truck()
    payload = ros2.imu(FIRST_NS, 0.0)
    for sent_ns in (FIRST_NS + 1_000_000_001, FIRST_NS - 1_000_000_001, 0):
        assert of.convert(FRONT, IMU, payload, sent_ns) == []
    assert of.anomalies.count(FRONT, "stamps too far from the time of sending") == 3
    of.convert(FRONT, IMU, payload, FIRST_NS + 1_000_000_000)
    assert of.anomalies.count(FRONT, "stamps too far from the time of sending") == 3


def fixes(of: Ros2Truck, payloads: list[bytes]) -> list[GnssFix]:
    found: list[Accel | GnssFix] = []
    for number, payload in enumerate(payloads):
        stamp_ns = FIRST_NS + number * 100_000_000
        found += of.convert(ros2.FIX_TOPIC, FIX, payload, stamp_ns)
        if of.table.velocity is not None:
            twist = ros2.twist(stamp_ns, 6.0, 8.0)
            found += of.convert(ros2.VELOCITY_TOPIC, TWIST, twist, stamp_ns)
    found += of.finish()
    return [one for one in found if isinstance(one, GnssFix)]


def place(number: int, **changes: float) -> bytes:
    at = {"latitude": 50.0 + number * 9e-6, "longitude": 8.0, "altitude": 100.0} | changes
    return ros2.fix(FIRST_NS + number * 100_000_000, **at)  # type: ignore[arg-type]


def test_fixes_have_place_speed_and_accuracies() -> None:
    found = fixes(truck(), [place(number) for number in range(5)])
    assert [one.wall_time_ns - FIRST_NS for one in found] == [n * 100_000_000 for n in range(5)]
    for one in found:
        assert (one.longitude_deg, one.altitude_m, one.speed_m_per_s) == (8.0, 100.0, 10.0)
        assert one.heading_deg is None
        assert one.horizontal_accuracy_m == pytest.approx(0.4)
        assert one.vertical_accuracy_m == pytest.approx(0.8)
        encode_gnss(one._replace(boot_id=1))  # nothing in it is impossible


@pytest.mark.parametrize(
    ("bad", "outcome"),
    [
        (place(2, status=-1), "messages without a fix, left out"),
        (place(2, status=-2), "messages without a fix, left out"),
        (place(2, altitude=math.nan), "fixes without an altitude, left out"),
        (place(2, latitude=math.nan), "fixes without a latitude, left out"),
        (place(2, longitude=math.inf), "fixes without a longitude, left out"),
        (place(2, latitude=91.0), "fixes without a latitude, left out"),
    ],
)
def test_invalid_positions_are_excluded_and_reported(bad: bytes, outcome: str) -> None:
    of = truck()
    found = fixes(of, [place(0), place(1), bad, place(3)])
    assert len(found) == 3
    assert of.anomalies.count(ros2.FIX_TOPIC, outcome) == 1


def test_slopes_of_positions_are_speeds_only_where_the_site_does_not_trust_them() -> None:
    text = ros2.ROS2.replace(f'velocity = "{ros2.VELOCITY_TOPIC}"\n', "")
    with pytest.raises(InputError) as caught:
        truck(text)
    assert "receiver.speed_noise_m_per_s is 0.07, it must be at least 0.5" in str(caught.value)
    found = fixes(truck(text, speed_noise=0.5), [place(number) for number in range(30)])
    assert [one.speed_m_per_s for one in found] == pytest.approx([10.01] * 30, abs=0.01)
    assert max(abs(one.speed_m_per_s) for one in found) < 10.02


def test_a_jump_of_the_position_is_no_speed() -> None:
    text = ros2.ROS2.replace(f'velocity = "{ros2.VELOCITY_TOPIC}"\n', "")
    of = truck(text, speed_noise=0.5)
    assert fixes(of, [place(0), place(1, latitude=60.0)]) == []
    outcome = "fixes with an impossible speed, left out"
    assert of.anomalies.count(ros2.FIX_TOPIC, outcome) == 2


def test_a_truck_needs_its_table() -> None:
    with pytest.raises(InputError, match=r'site.toml: has no \[ros2\] with vehicle = "truck-1"'):
        truck("")
