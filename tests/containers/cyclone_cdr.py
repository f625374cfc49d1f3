"""Encodes messages of ROS 2 by Eclipse Cyclone DDS, in an interpreter that has nothing of ours.

    python cyclone_cdr.py MESSAGES.json

prints each message in both byte orders, as lines of hexadecimal digits.
"""
# mypy: disallow-subclassing-any=False

import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cyclonedds.idl import IdlStruct  # type: ignore[import-not-found]
from cyclonedds.idl._support import Endianness  # type: ignore[import-not-found]
from cyclonedds.idl.types import (  # type: ignore[import-not-found]
    array,
    float64,
    int8,
    int32,
    uint8,
    uint16,
    uint32,
)


@dataclass
class Time(IdlStruct):
    sec: int32
    nanosec: uint32


@dataclass
class Header(IdlStruct):
    stamp: Time
    frame_id: str


@dataclass
class Quaternion(IdlStruct):
    x: float64
    y: float64
    z: float64
    w: float64


@dataclass
class Vector3(IdlStruct):
    x: float64
    y: float64
    z: float64


@dataclass
class Imu(IdlStruct):
    header: Header
    orientation: Quaternion
    orientation_covariance: array[float64, 9]
    angular_velocity: Vector3
    angular_velocity_covariance: array[float64, 9]
    linear_acceleration: Vector3
    linear_acceleration_covariance: array[float64, 9]


@dataclass
class NavSatStatus(IdlStruct):
    status: int8
    service: uint16


@dataclass
class NavSatFix(IdlStruct):
    header: Header
    status: NavSatStatus
    latitude: float64
    longitude: float64
    altitude: float64
    position_covariance: array[float64, 9]
    position_covariance_type: uint8


def imu(header: Header, numbers: list[float]) -> Imu:
    return Imu(
        header,
        Quaternion(*numbers[:4]),
        numbers[4:13],
        Vector3(*numbers[13:16]),
        numbers[16:25],
        Vector3(*numbers[25:28]),
        numbers[28:37],
    )


def fix(header: Header, numbers: list[float], status: int, service: int, kind: int) -> NavSatFix:
    return NavSatFix(header, NavSatStatus(status, service), *numbers[:3], numbers[3:12], kind)


def main(path: str) -> None:
    messages: list[dict[str, Any]] = json.loads(Path(path).read_text())
    for one in messages:
        header = Header(Time(*one["stamp"]), one["frame"])
        message = (
            imu(header, one["numbers"])
            if one["type"] == "Imu"
            else fix(header, one["numbers"], *one["integers"])
        )
        for order in (Endianness.Little, Endianness.Big):
            print(message.serialize(endianness=order).hex())


if __name__ == "__main__":
    main(sys.argv[1])
