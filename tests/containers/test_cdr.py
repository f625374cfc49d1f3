"""Messages of ROS 2 that others encode, in programs that have nothing of ours.

Eclipse Cyclone DDS runs in a container. Fast CDR is compiled here: apt install g++ libfastcdr-dev.
"""

import json
import random
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from services.drives.ros2_messages import FIX, IMU, Fix, Imu, RosType, decode
from tests import ros2
from tests.containers.conftest import base_images
from tests.containers.stack import ROOT, Stack

pytestmark = [pytest.mark.containers, pytest.mark.timeout(1800)]

CYCLONE = "cyclonedds==11.0.1"
MESSAGES = 500
"""Messages of each type."""


@pytest.fixture(scope="module")
def wheels(engine: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wheels")
    pip = (sys.executable, "-m", "pip", "download", "--quiet", "--no-deps")
    command = (*pip, "--only-binary", ":all:", "--dest", str(folder), CYCLONE)
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        pytest.skip(f"{CYCLONE} cannot be downloaded: {done.stderr.strip().splitlines()[-1]}")
    return folder


@pytest.fixture(scope="module")
def fast_cdr(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the compiled program of Fast CDR."""
    if shutil.which("g++") is None:
        pytest.skip("no g++ for Fast CDR: apt install g++ libfastcdr-dev")
    program = tmp_path_factory.mktemp("fast_cdr") / "fast_cdr"
    source = ROOT / "tests" / "containers" / "fast_cdr.cpp"
    command = ["g++", "-std=c++17", "-Wall", "-Werror", str(source), "-o", str(program)]
    done = subprocess.run([*command, "-lfastcdr"], capture_output=True, text=True, check=False)
    if "fastcdr/" in done.stderr and "No such file" in done.stderr:
        pytest.skip("no library Fast CDR: apt install g++ libfastcdr-dev")
    assert done.returncode == 0, done.stderr
    return program


def drawn(kind: str, random_: random.Random) -> dict[str, Any]:
    """Return a message with names of all lengths, because these move what follows."""
    return {
        "type": kind,
        "stamp": [random_.randrange(946_684_800, 2**31), random_.randrange(10**9)],
        "frame": "x" * random_.randrange(20),
        "numbers": [random_.gauss(0.0, 1e3) for _ in range(37 if kind == "Imu" else 12)],
        "integers": [random_.randint(-1, 2), random_.randrange(2**16), random_.randrange(4)],
    }


def made(one: dict[str, Any]) -> tuple[RosType, Any]:
    """Return the same message as rosbags has it."""
    time = ros2.make("builtin_interfaces/msg/Time", *one["stamp"])
    header = ros2.make("std_msgs/msg/Header", time, one["frame"])
    numbers = np.array(one["numbers"])
    if one["type"] == "Imu":
        quaternion = ros2.make("geometry_msgs/msg/Quaternion", *numbers[:4])
        rates = (ros2.vector(*numbers[13:16]), numbers[16:25])
        accelerations = (ros2.vector(*numbers[25:28]), numbers[28:37])
        parts = (quaternion, numbers[4:13], *rates, *accelerations)
        return IMU, ros2.make(IMU.name, header, *parts)
    status, service, kind = one["integers"]
    place = ros2.make("sensor_msgs/msg/NavSatStatus", status, service)
    return FIX, ros2.make(FIX.name, header, place, *numbers[:3], numbers[3:12], kind)


def test_messages_of_cyclone_dds_are_those_of_rosbags(wheels: Path, folder: Path) -> None:
    random_ = random.Random(1)
    messages = [drawn(kind, random_) for kind in ("Imu", "NavSatFix") for _ in range(MESSAGES)]
    (folder / "messages.json").write_text(json.dumps(messages))
    install = "pip install --quiet --no-index --no-deps --root-user-action ignore /wheels/*.whl"
    lines = (
        Stack("driveby-none")
        .docker(
            *("run", "--rm", "--network", "none", "-v", f"{wheels}:/wheels:ro"),
            *("-v", f"{ROOT}/tests/containers/cyclone_cdr.py:/cyclone_cdr.py:ro"),
            *("-v", f"{folder}/messages.json:/messages.json:ro", base_images()[0]),
            *("sh", "-c", f"{install} && python /cyclone_cdr.py /messages.json"),
        )
        .out.split()
    )
    assert len(lines) == 2 * len(messages)
    for one, little, big in zip(messages, lines[::2], lines[1::2], strict=True):
        of, message = made(one)
        for line, is_little in ((little, True), (big, False)):
            payload = bytes.fromhex(line)
            assert payload == ros2.encoded(of, message, little_endian=is_little)
            check(one, decode(of, payload))


def test_messages_of_fast_cdr_are_those_of_rosbags(fast_cdr: Path, folder: Path) -> None:
    random_ = random.Random(2)
    messages = [drawn(kind, random_) for kind in ("Imu", "NavSatFix") for _ in range(MESSAGES)]
    (folder / "messages.txt").write_text("".join(f"{line_of(one)}\n" for one in messages))
    command = [fast_cdr, folder / "messages.txt"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    version, *lines = done.stdout.split()
    print(f"Fast CDR {version}: {len(messages)} messages")
    assert len(lines) == 4 * len(messages)
    groups = zip(*(lines[place::4] for place in range(4)), strict=True)
    has_padding = 0
    for one, payloads in zip(messages, groups, strict=True):
        of, message = made(one)
        little, little_ones, big, big_ones = map(bytes.fromhex, payloads)
        assert little == ros2.encoded(of, message, little_endian=True)
        assert big == ros2.encoded(of, message, little_endian=False)
        # Fast CDR leaves whatever the memory holds between fields.
        for payload in (little, little_ones, big, big_ones):
            check(one, decode(of, payload))
        has_padding += little != little_ones
    assert has_padding > MESSAGES


def line_of(one: dict[str, Any]) -> str:
    """Return a message as fast_cdr.cpp reads it."""
    numbers = [number.hex() for number in one["numbers"]]
    return " ".join(
        map(str, [one["type"], *one["stamp"], json.dumps(one["frame"]), *one["integers"], *numbers])
    )


def check(one: dict[str, Any], decoded: object) -> None:
    seconds, nanoseconds = one["stamp"]
    stamp_ns = seconds * 10**9 + nanoseconds
    numbers = one["numbers"]
    if isinstance(decoded, Imu):
        axes = dict(zip("xyz", numbers[25:28], strict=True))
        assert decoded == Imu(stamp_ns, one["frame"], axes)
    else:
        assert isinstance(decoded, Fix)
        status = one["integers"][0]
        assert decoded[:5] == (stamp_ns, status >= 0, *numbers[:3])
