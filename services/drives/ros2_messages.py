"""ROS 2 messages of a truck's sensors, decoded from CDR by rosbags.

Their definitions have not changed since ROS 2 Humble: one hash each (REP 2016) represents all
distributions, and any other hash is another message.
"""

import math
from functools import cache
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from schemas.signals import NS_PER_S, check_wall_time
from services.common.extras import check_installed

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

MAX_PAYLOAD_BYTES: Final = 4096
"""Maximum size: the frame's name is the only part of these messages with variable length."""
NO_HASH: Final = "TypeHashNotSupported"
"""Hash that ROS 2 Humble sends, as it has none."""
_NO_FIX: Final = 0
"""Lowest NavSatStatus of a fix."""


class Imu(NamedTuple):
    """Readings of an accelerometer in its own axes, from sensor_msgs/Imu."""

    stamp_ns: int
    frame: str
    acceleration_m_per_s2: dict[str, float] | None
    """Accelerations by axis; None if the sensor has no accelerometer."""


class Fix(NamedTuple):
    """A fix from sensor_msgs/NavSatFix; accuracies are standard deviations, None if unknown."""

    stamp_ns: int
    is_fix: bool
    latitude_deg: float
    longitude_deg: float
    altitude_m: float
    horizontal_accuracy_m: float | None
    vertical_accuracy_m: float | None


class Velocity(NamedTuple):
    """A receiver's velocity, from geometry_msgs/TwistStamped or TwistWithCovarianceStamped."""

    stamp_ns: int
    speed_m_per_s: float
    """Speed over ground, for any horizontal axes."""


class RosType(NamedTuple):
    """A type of message: its names and its hash."""

    name: str
    """Name in recordings."""
    dds_name: str
    """Name in keys of Zenoh."""
    hash: str


def _type(package: str, name: str, digest: str) -> RosType:
    return RosType(f"{package}/msg/{name}", f"{package}::msg::dds_::{name}_", f"RIHS01_{digest}")


IMU: Final = _type(
    "sensor_msgs", "Imu", "7d9a00ff131080897a5ec7e26e315954b8eae3353c3f995c55faf71574000b5b"
)
FIX: Final = _type(
    "sensor_msgs", "NavSatFix", "62223ab3fe210a15976021da7afddc9e200dc9ec75231c1b6a557fc598a65404"
)
TWIST: Final = _type(
    "geometry_msgs",
    "TwistStamped",
    "5f0fcd4f81d5d06ad9b4c4c63e3ea51b82d6ae4d0558f1d475229b1121db6f64",
)
TWIST_WITH_COVARIANCE: Final = _type(
    "geometry_msgs",
    "TwistWithCovarianceStamped",
    "77b67434531e6529b7a0091357b186b6ebdb17fd9ffd3e0c7ce9d3fb11a44563",
)
VELOCITIES: Final = (TWIST, TWIST_WITH_COVARIANCE)


def check_rosbags() -> None:
    """Raise InputError with the command of installation if the ROS 2 decoder is not installed."""
    check_installed("ROS 2", "rosbags", extra="ros2")


def decode(ros_type: RosType, payload: bytes) -> Imu | Fix | Velocity:
    """Return the content of a message; ValueError if it is of another type or impossible."""
    if len(payload) > MAX_PAYLOAD_BYTES:
        raise ValueError(f"has {len(payload)} bytes, at most {MAX_PAYLOAD_BYTES} are expected")
    try:
        message: Any = _types().deserialize_cdr(payload, ros_type.name)
    except Exception as error:  # bytes of unknown origin may break the decoder in any way
        raise ValueError(f"is no {ros_type.name}: {error}") from None
    stamp_ns = _stamp_ns(message.header.stamp)
    if ros_type == IMU:
        return _imu(stamp_ns, message)
    if ros_type == FIX:
        return _fix(stamp_ns, message)
    twist = message.twist if ros_type == TWIST else message.twist.twist
    speed = math.hypot(twist.linear.x, twist.linear.y)
    if not math.isfinite(speed):
        raise ValueError("has a velocity that is not finite")
    return Velocity(stamp_ns, speed)


def unknown_hash(ros_type: RosType, declared: str) -> str | None:
    """Return what is wrong with a type's declared hash; None if nothing is."""
    if declared in (ros_type.hash, NO_HASH):
        return None
    return f"{ros_type.name} has the type hash {declared[:80]}, known is {ros_type.hash}"


@cache
def _types() -> "Typestore":
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_JAZZY)


def _stamp_ns(stamp: Any) -> int:
    if stamp.sec == 0 and stamp.nanosec == 0:
        raise ValueError("has no header.stamp: the driver must set it when it samples")
    if not 0 <= stamp.nanosec < NS_PER_S:
        raise ValueError(f"has a header.stamp of {stamp.nanosec} ns after the second")
    return check_wall_time(stamp.sec * NS_PER_S + stamp.nanosec)


def _imu(stamp_ns: int, message: Any) -> Imu:
    # REP 145: -1 as the first covariance declares that there is no such estimate.
    if message.linear_acceleration_covariance[0] == -1.0:
        return Imu(stamp_ns, message.header.frame_id, None)
    measured = message.linear_acceleration
    axes = {"x": measured.x, "y": measured.y, "z": measured.z}
    return Imu(stamp_ns, message.header.frame_id, axes)


def _fix(stamp_ns: int, message: Any) -> Fix:
    covariance = message.position_covariance
    is_known = message.position_covariance_type != 0
    east, north, up = (float(covariance[i]) if is_known else math.nan for i in (0, 4, 8))
    return Fix(
        stamp_ns,
        message.status.status >= _NO_FIX,
        message.latitude,
        message.longitude,
        message.altitude,
        _deviation((east + north) / 2),
        _deviation(up),
    )


def _deviation(variance: float) -> float | None:
    """Return the deviation; None for an impossible variance, and without one."""
    return math.sqrt(variance) if 0.0 < variance < 1e12 else None
