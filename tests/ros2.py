"""A truck that speaks ROS 2, made of the recording of one of ours: encoded by rosbags.

Not by ROS 2 itself, which is not needed to run the tests. Attachments and keys are written as
rmw_zenoh's sources do.
"""

import math
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import zenoh
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from zenoh import ext

from pre_core.constants import STANDARD_GRAVITY_M_PER_S2
from schemas.signals import NS_PER_S, GnssFix, decode_accel, decode_gnss
from services.drives.ros2_messages import FIX, IMU, TWIST, RosType
from services.recordings.recording import read_messages
from tests.waiting import until

STORE = get_typestore(Stores.ROS2_JAZZY)
TYPES = STORE.types
NINE = np.zeros(9)
TOPICS = {
    "sprung_front": "/imu/front/data",
    "sprung_rear": "/imu/rear/data",
    "unsprung_front": "/axle/front",
    "unsprung_rear": "/axle/rear",
}
FIX_TOPIC, VELOCITY_TOPIC = "/gps/fix", "/gps/vel"
ROS2 = f"""
[ros2]
vehicle = "truck-1"
gnss = "{FIX_TOPIC}"
velocity = "{VELOCITY_TOPIC}"
[ros2.imu]
""" + "".join(f'{name} = {{ topic = "{topic}" }}\n' for name, topic in TOPICS.items())


class Ros(NamedTuple):
    """A message of ROS, and when it was measured."""

    topic: str
    type: RosType
    payload: bytes
    stamp_ns: int


def make(name: str, *values: Any, **named: Any) -> Any:
    return TYPES[name](*values, **named)


def header(stamp_ns: int, frame: str = "base") -> Any:
    time = make("builtin_interfaces/msg/Time", *divmod(stamp_ns, NS_PER_S))
    return make("std_msgs/msg/Header", time, frame)


def vector(x: float, y: float, z: float) -> Any:
    return make("geometry_msgs/msg/Vector3", x, y, z)


def encoded(of: RosType, message: Any, *, little_endian: bool = True) -> bytes:
    return bytes(STORE.serialize_cdr(message, of.name, little_endian=little_endian))


def imu(
    stamp_ns: int,
    up_m_per_s2: float,
    frame: str = "base",
    *,
    gravity: float = STANDARD_GRAVITY_M_PER_S2,
    covariance: np.ndarray[Any, np.dtype[np.float64]] = NINE,
    little_endian: bool = True,
) -> bytes:
    message = make(
        IMU.name,
        header(stamp_ns, frame),
        make("geometry_msgs/msg/Quaternion", 0.0, 0.0, 0.0, 1.0),
        NINE,
        vector(0.0, 0.0, 0.0),
        NINE,
        vector(0.25, -0.5, up_m_per_s2 + gravity),
        covariance,
    )
    return encoded(IMU, message, little_endian=little_endian)


def fix(
    stamp_ns: int,
    latitude: float,
    longitude: float,
    altitude: float = 100.0,
    *,
    status: int = 0,
    variances: tuple[float, float, float] = (0.16, 0.16, 0.64),
    kind: int = 2,
) -> bytes:
    message = make(
        FIX.name,
        header(stamp_ns, "gps"),
        make("sensor_msgs/msg/NavSatStatus", status, 1),
        latitude,
        longitude,
        altitude,
        np.diag(variances).ravel(),
        kind,
    )
    return encoded(FIX, message)


def twist(stamp_ns: int, east: float, north: float) -> bytes:
    velocity = make("geometry_msgs/msg/Twist", vector(east, north, 0.1), vector(0.0, 0.0, 0.0))
    return encoded(TWIST, make(TWIST.name, header(stamp_ns, "gps"), velocity))


def of_recording(path: Path) -> list[Ros]:
    """What a ROS 2 truck would have said on the drive of a recording, by time."""
    messages = [ros for found in read_messages(path) for ros in _of_message(found)]
    return sorted(messages, key=lambda ros: ros.stamp_ns)


def _of_message(found: Any) -> Iterator[Ros]:
    if found.key.stream == "accel":
        batch = decode_accel(found.payload)
        for name, channel in batch.channels.items():
            for number, value in enumerate(channel.samples.tolist()):
                stamp_ns = batch.wall_time_ns + round(number * NS_PER_S / channel.rate_hz)
                yield Ros(TOPICS[name], IMU, imu(stamp_ns, value), stamp_ns)
    elif found.key.stream == "gnss":
        yield from of_fix(decode_gnss(found.payload))


def of_fix(known: GnssFix) -> Iterator[Ros]:
    stamp_ns, speed = known.wall_time_ns, known.speed_m_per_s
    place = fix(stamp_ns, known.latitude_deg, known.longitude_deg, known.altitude_m)
    yield Ros(FIX_TOPIC, FIX, place, stamp_ns)
    velocity = twist(stamp_ns, speed * math.sin(1.0), speed * math.cos(1.0))
    yield Ros(VELOCITY_TOPIC, TWIST, velocity, stamp_ns)


def record(
    folder: Path,
    messages: Iterable[Ros],
    storage: StoragePlugin,
    compression: CompressionMode = CompressionMode.NONE,
) -> Path:
    """Write a folder as rosbag2 does."""
    writer = Writer(folder, version=9, storage_plugin=storage)
    if compression != CompressionMode.NONE:
        writer.set_compression(compression, CompressionFormat.ZSTD)
    with writer:
        connections: dict[str, Any] = {}
        for topic, of, payload, stamp_ns in messages:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, of.name, typestore=STORE)
            writer.write(connections[topic], stamp_ns, payload)
    return folder


class RosNode:
    """Publishes as a node with rmw_zenoh does, through a session at its router."""

    def __init__(self, session: zenoh.Session, domain: int = 0, gid: bytes = bytes(range(16))):
        self._session = session
        self._domain = domain
        self._gid = gid
        self._publishers: dict[str, Any] = {}
        self._sequences: dict[str, int] = {}

    def publish(
        self, message: Ros, *, sent_ns: int | None = None, type_hash: str | None = None
    ) -> None:
        """Put a message, the first of its key once somebody subscribes to it."""
        topic, of, payload, stamp_ns = message
        sequence = self._sequences[topic] = self._sequences.get(topic, 0) + 1
        where = f"{self._domain}/{topic.strip('/')}/{of.dds_name}/{type_hash or of.hash}"
        if where not in self._publishers:
            self._publishers[where] = self._session.declare_publisher(
                where, congestion_control=zenoh.CongestionControl.BLOCK
            )
            until(lambda: self._publishers[where].matching_status.matching, f"who hears {where}")
        sent_ns = stamp_ns if sent_ns is None else sent_ns
        self._publishers[where].put(payload, attachment=attachment(sequence, sent_ns, self._gid))


def attachment(sequence: int, sent_ns: int, gid: bytes) -> bytes:
    """int64, int64 and an array of bytes, as Zenoh serialises them."""
    parts = [ext.Int64(sequence), ext.Int64(sent_ns), gid]
    return b"".join(ext.z_serialize(part).to_bytes() for part in parts)
