"""Messages of ROS 2 out of CDR: what they say, and that nothing in them does harm."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_typestore

from services.drives.ros2_messages import (
    FIX,
    IMU,
    TWIST,
    TWIST_WITH_COVARIANCE,
    Fix,
    Imu,
    RosType,
    Velocity,
    decode,
    unknown_hash,
)
from tests import ros2

STAMP_NS = 1_700_000_000_123_456_789
TYPES = (IMU, FIX, TWIST, TWIST_WITH_COVARIANCE)


@pytest.mark.parametrize(
    "store",
    [Stores.ROS2_HUMBLE, Stores.ROS2_IRON, Stores.ROS2_JAZZY, Stores.ROS2_KILTED,
     Stores.ROS2_LYRICAL],
)  # fmt: skip
@pytest.mark.parametrize("of", TYPES)
def test_hashes_are_those_of_the_definitions_of_every_distribution(
    store: Stores, of: RosType
) -> None:
    assert get_typestore(store).hash_rihs01(of.name) == of.hash


def test_an_imu_is_read_in_either_order_of_bytes() -> None:
    for little in (True, False):
        found = decode(IMU, ros2.imu(STAMP_NS, 1.5, "imu_link", gravity=0.0, little_endian=little))
        assert found == Imu(STAMP_NS, "imu_link", {"x": 0.25, "y": -0.5, "z": 1.5})


def test_an_imu_may_have_no_accelerometer() -> None:
    covariance = np.array([-1.0, *np.zeros(8)])
    found = decode(IMU, ros2.imu(STAMP_NS, 1.5, covariance=covariance))
    assert isinstance(found, Imu)
    assert found.acceleration_m_per_s2 is None


def test_a_fix_has_accuracies_where_its_covariance_is_known() -> None:
    known = decode(FIX, ros2.fix(STAMP_NS, 50.5, 8.25, 90.0, variances=(0.09, 0.25, 1.0)))
    assert known == Fix(STAMP_NS, True, 50.5, 8.25, 90.0, math.sqrt((0.09 + 0.25) / 2), 1.0)
    for covariance in ({"kind": 0}, {"variances": (-1.0, -1.0, math.nan)}):
        found = decode(FIX, ros2.fix(STAMP_NS, 50.5, 8.25, 90.0, **covariance))
        assert isinstance(found, Fix)
        assert found[5:] == (None, None)


@pytest.mark.parametrize(("status", "is_fix"), [(-2, False), (-1, False), (0, True), (2, True)])
def test_a_fix_that_is_none_says_so(status: int, is_fix: bool) -> None:
    found = decode(FIX, ros2.fix(STAMP_NS, 50.5, 8.25, status=status))
    assert isinstance(found, Fix)
    assert found.is_fix is is_fix


def test_a_velocity_is_the_horizontal_one() -> None:
    assert decode(TWIST, ros2.twist(STAMP_NS, 3.0, 4.0)) == Velocity(STAMP_NS, 5.0)
    with pytest.raises(ValueError, match="not finite"):
        decode(TWIST, ros2.twist(STAMP_NS, math.nan, 4.0))


def test_a_velocity_may_have_a_covariance() -> None:
    make = ros2.make
    of = TWIST_WITH_COVARIANCE
    still = ros2.vector(0.0, 0.0, 0.0)
    twist = make("geometry_msgs/msg/Twist", ros2.vector(-3.0, 4.0, 9.0), still)
    inner = make("geometry_msgs/msg/TwistWithCovariance", twist, np.zeros(36))
    payload = ros2.encoded(of, make(of.name, ros2.header(STAMP_NS), inner))
    assert decode(of, payload) == Velocity(STAMP_NS, 5.0)


@pytest.mark.parametrize(
    ("payload", "why"),
    [
        (ros2.imu(0, 0.0), "no header.stamp"),
        (ros2.imu(12, 0.0), "between the years"),
        (ros2.imu(STAMP_NS, 0.0)[:-1], "is no sensor_msgs/msg/Imu"),
        (ros2.imu(STAMP_NS, 0.0) + bytes(8), "is no sensor_msgs/msg/Imu"),
        (ros2.fix(STAMP_NS, 50.0, 8.0), "is no sensor_msgs/msg/Imu"),
        (b"\x00\x03" + ros2.imu(STAMP_NS, 0.0)[2:], "encapsulation"),
        (b"", "is no sensor_msgs/msg/Imu"),
        (ros2.imu(STAMP_NS, 0.0, "f" * 5000), "at most 4096"),
    ],
)
def test_wrong_input_is_named(payload: bytes, why: str) -> None:
    with pytest.raises(ValueError, match=why):
        decode(IMU, payload)


GOOD = {
    IMU: ros2.imu(STAMP_NS, 1.5),
    FIX: ros2.fix(STAMP_NS, 50.5, 8.25),
    TWIST: ros2.twist(STAMP_NS, 3.0, 4.0),
}


@given(st.sampled_from(TYPES), st.binary(max_size=600))
def test_any_bytes_are_decoded_or_refused(of: RosType, payload: bytes) -> None:
    try:
        found = decode(of, b"\x00\x01\x00\x00" + payload)
    except ValueError:
        return
    assert found.stamp_ns > 0


@given(
    st.sampled_from(list(GOOD)),
    st.lists(st.tuples(st.integers(0, 400), st.integers(0, 255)), max_size=8),
    st.integers(0, 400),
)
def test_damaged_messages_are_decoded_or_refused(
    of: RosType, changes: list[tuple[int, int]], kept: int
) -> None:
    payload = bytearray(GOOD[of])
    for place, value in changes:
        payload[place % len(payload)] = value
    try:
        decode(of, bytes(payload[:kept] if kept % 3 == 0 else payload))
    except ValueError:
        return


def test_hashes_that_are_not_known_are_named() -> None:
    assert unknown_hash(IMU, IMU.hash) is None
    assert unknown_hash(IMU, "TypeHashNotSupported") is None  # ROS 2 Humble
    line = unknown_hash(IMU, FIX.hash)
    assert line is not None
    assert FIX.hash in line
    assert IMU.hash in line
