"""A truck of ROS 2 by zenoh-ros2-sdk, in an interpreter of its own that has it and nothing of ours.

python ros2_sdk_truck.py HOST PORT MESSAGES.json

The file is a list of [topic, type, stamp in ns, numbers as text]. The drive is shifted to the
present and takes as long as it took: the attachments have the time of sending. Keys, hashes of
types, attachments and CDR are the SDK's; definitions of messages are those of common_interfaces
without comments.
"""

import json
import sys
import time
from typing import Any

import numpy as np
from zenoh_ros2_sdk import ROS2Publisher  # type: ignore[import-not-found]
from zenoh_ros2_sdk.session import ZenohSession  # type: ignore[import-not-found]
from zenoh_ros2_sdk.utils import get_type_hash  # type: ignore[import-not-found]

NESTED = {
    "builtin_interfaces/msg/Time": "int32 sec\nuint32 nanosec\n",
    "std_msgs/msg/Header": "builtin_interfaces/Time stamp\nstring frame_id\n",
    "geometry_msgs/msg/Quaternion": ("float64 x 0\nfloat64 y 0\nfloat64 z 0\nfloat64 w 1\n"),
    "geometry_msgs/msg/Vector3": "float64 x\nfloat64 y\nfloat64 z\n",
    "geometry_msgs/msg/Twist": "Vector3 linear\nVector3 angular\n",
    "sensor_msgs/msg/NavSatStatus": (
        "int8 STATUS_UNKNOWN=-2\nint8 STATUS_NO_FIX=-1\nint8 STATUS_FIX=0\nint8 STATUS_SBAS_FIX=1\n"
        "int8 STATUS_GBAS_FIX=2\nint8 status -2\nuint16 SERVICE_UNKNOWN=0\nuint16 SERVICE_GPS=1\n"
        "uint16 SERVICE_GLONASS=2\nuint16 SERVICE_COMPASS=4\nuint16 SERVICE_GALILEO=8\n"
        "uint16 service\n"
    ),
}
DEFINITIONS = {
    "sensor_msgs/msg/Imu": (
        "std_msgs/Header header\ngeometry_msgs/Quaternion orientation\n"
        "float64[9] orientation_covariance\ngeometry_msgs/Vector3 angular_velocity\n"
        "float64[9] angular_velocity_covariance\ngeometry_msgs/Vector3 linear_acceleration\n"
        "float64[9] linear_acceleration_covariance\n"
    ),
    "sensor_msgs/msg/NavSatFix": (
        "std_msgs/Header header\nNavSatStatus status\nfloat64 latitude\nfloat64 longitude\n"
        "float64 altitude\nfloat64[9] position_covariance\nuint8 COVARIANCE_TYPE_UNKNOWN=0\n"
        "uint8 COVARIANCE_TYPE_APPROXIMATED=1\nuint8 COVARIANCE_TYPE_DIAGONAL_KNOWN=2\n"
        "uint8 COVARIANCE_TYPE_KNOWN=3\nuint8 position_covariance_type\n"
    ),
    "geometry_msgs/msg/TwistStamped": "std_msgs/Header header\nTwist twist\n",
}
NEEDS = {
    "sensor_msgs/msg/Imu": ("Time", "Header", "Quaternion", "Vector3"),
    "sensor_msgs/msg/NavSatFix": ("Time", "Header", "NavSatStatus"),
    "geometry_msgs/msg/TwistStamped": ("Time", "Header", "Vector3", "Twist"),
}


def dependencies(of: str) -> dict[str, str]:
    return {name: text for name, text in NESTED.items() if name.split("/")[-1] in NEEDS[of]}


def publisher(topic: str, of: str, host: str, port: int) -> Any:
    session = ZenohSession.get_instance(host, port)
    for name, text in dependencies(of).items():
        session.register_message_type(text, name)
    return ROS2Publisher(
        topic=topic,
        msg_type=of,
        msg_definition=DEFINITIONS[of],
        router_ip=host,
        router_port=port,
        type_hash=get_type_hash(of, msg_definition=DEFINITIONS[of], dependencies=dependencies(of)),
    )


def fields(of: str, stamp_ns: int, numbers: list[float], types: Any) -> dict[str, Any]:
    def made(name: str, *values: Any) -> Any:
        return types[name](*values)

    def vector(*values: float) -> Any:
        return made("geometry_msgs/msg/Vector3", *values)

    stamp = made("builtin_interfaces/msg/Time", *divmod(stamp_ns, 10**9))
    header = made("std_msgs/msg/Header", stamp, "base")
    if of == "sensor_msgs/msg/Imu":
        return {
            "header": header,
            "orientation": made("geometry_msgs/msg/Quaternion", 0.0, 0.0, 0.0, 1.0),
            "orientation_covariance": np.zeros(9),
            "angular_velocity": vector(0.0, 0.0, 0.0),
            "angular_velocity_covariance": np.zeros(9),
            "linear_acceleration": vector(*numbers),
            "linear_acceleration_covariance": np.zeros(9),
        }
    if of == "sensor_msgs/msg/NavSatFix":
        latitude, longitude, altitude, *variances = numbers
        return {
            "header": header,
            "status": made("sensor_msgs/msg/NavSatStatus", 0, 1),
            "latitude": latitude,
            "longitude": longitude,
            "altitude": altitude,
            "position_covariance": np.diag(variances).ravel(),
            "position_covariance_type": 2,
        }
    twist = made("geometry_msgs/msg/Twist", vector(*numbers), vector(0.0, 0.0, 0.0))
    return {"header": header, "twist": twist}


def main(host: str, port: str, path: str) -> None:
    with open(path) as file:  # noqa: PTH123 - nothing of ours here
        messages = json.load(file)
    publishers = {}
    for topic, of, *_ in messages:
        if topic not in publishers:
            publishers[topic] = publisher(topic, of, host, int(port))
    for one in publishers.values():
        while not one.pub.matching_status.matching:
            time.sleep(0.01)
    types = ZenohSession.get_instance(host, int(port)).store.types
    shift_ns = time.time_ns() - messages[0][2]
    for topic, of, stamp_ns, words in messages:
        # The SDK's publishers drop where the network holds them up, so it is not flooded.
        early_s = (stamp_ns + shift_ns - time.time_ns()) * 1e-9
        if early_s > 0.005:
            time.sleep(early_s)
        numbers = [float(word) for word in words]
        publishers[topic].publish(**fields(of, stamp_ns + shift_ns, numbers, types))
    keys = [one.keyexpr for one in publishers.values()]
    print(json.dumps({"shift_ns": shift_ns, "keys": keys}), flush=True)
    sys.stdin.read()  # the session stays until all has arrived


if __name__ == "__main__":
    main(*sys.argv[1:])
