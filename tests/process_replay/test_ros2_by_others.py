"""Trucks of ROS 2 whose clients others wrote, in programs of their own.

    python -m venv sdk && sdk/bin/pip install zenoh-ros2-sdk
    ROS2_SDK_PYTHON=sdk/bin/python pytest tests/process_replay/test_ros2_by_others.py -m slow

`zenoh-ros2-sdk` is in Python, its session a client of the router. `hiroz` is in Rust, its session
a peer; cargo compiles it for some minutes. Hashes of types, keys, attachments and CDR are their
own. The router is that of the Python package and, where `zenohd` is found (zenohd.py), this one.
"""

import json
import math
import os
import shutil
import subprocess
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pre_core.constants import STANDARD_GRAVITY_M_PER_S2
from schemas.signals import NS_PER_S, decode_accel, decode_gnss
from schemas.topics import selector
from services.bus.session import open_session
from services.bus.subscription import Subscription
from services.drives.ros2_messages import FIX, IMU, TWIST
from services.drives.signals import Signals
from services.recordings.recording import read_messages
from tests import ros2
from tests.builders.processes import stop
from tests.containers import zenohd
from tests.endpoints import free_endpoint
from tests.process_replay.starting import End, Process, Start, start_logger
from tests.process_replay.test_ros2_gateway import (
    ROUTER,
    assert_same,
    estimate,
    gateway,
    heard,
    one_run,
    opened,
    ros_site,
    simulate_to,
)
from tests.waiting import LONGEST_S

__all__ = ["gateway", "ros_site"]
pytestmark = [pytest.mark.process, pytest.mark.slow, pytest.mark.timeout(1800)]
SCRIPT = Path(__file__).parents[1] / "ros2_sdk_truck.py"
CRATE = Path(__file__).parents[1] / "hiroz_truck"
COMPILED = CRATE.parents[1] / "build" / "hiroz"


@pytest.fixture(scope="module", params=["zenoh-ros2-sdk", "hiroz"])
def client(request: pytest.FixtureRequest) -> list[str]:
    """Return the command of a truck."""
    return sdk() if request.param == "zenoh-ros2-sdk" else hiroz()


def sdk() -> list[str]:
    found = os.environ.get("ROS2_SDK_PYTHON")
    if not found:
        pytest.skip("ROS2_SDK_PYTHON names no Python with zenoh-ros2-sdk")
    return [found, str(SCRIPT)]


def hiroz() -> list[str]:
    if shutil.which("cargo") is None:
        pytest.skip("no cargo for hiroz: https://rustup.rs")
    jobs = {"CARGO_BUILD_JOBS": "2", **os.environ, "CARGO_TARGET_DIR": str(COMPILED)}
    cargo = partial(subprocess.run, cwd=CRATE, env=jobs, capture_output=True, text=True)
    fetched = cargo(["cargo", "fetch"])
    if fetched.returncode != 0:
        pytest.skip(f"no hiroz by cargo: {fetched.stderr.strip().splitlines()[-1]}")
    built = cargo(["cargo", "build", "--release", "--offline"])
    assert built.returncode == 0, built.stderr
    return [str(COMPILED / "release" / "hiroz_truck")]


@pytest.fixture(params=["zenoh", "zenohd"])
def ros_endpoint(
    request: pytest.FixtureRequest, client: list[str], tmp_path: Path
) -> Iterator[str]:
    """Run a router as rmw_zenoh configures it; return its endpoint."""
    endpoint = free_endpoint()
    program = zenohd.find()
    if request.param == "zenoh":
        router: AbstractContextManager[Any] = opened(
            mode="router", listen__endpoints=[endpoint], **ROUTER
        )
    elif program is None:
        pytest.skip("no zenohd for ROS 2: ZENOHD names it")
    else:
        settings = {name.replace("__", "/"): json.dumps(value) for name, value in ROUTER.items()}
        options = [f"--cfg={name}:{value}" for name, value in settings.items()]
        words = [program, f"--listen={endpoint}", *options]
        router = zenohd.listening(words, endpoint, tmp_path / "zenohd.log")
    with router:
        yield endpoint


def of_drive(path: Path) -> list[tuple[str, str, int, list[float]]]:
    """What a truck of ROS 2 would have published on the drive of a recording, by time."""
    found: list[tuple[str, str, int, list[float]]] = []
    for message in read_messages(path):
        if message.key.stream == "accel":
            batch = decode_accel(message.payload)
            for name, channel in batch.channels.items():
                for number, value in enumerate(channel.samples.tolist()):
                    stamp_ns = batch.wall_time_ns + round(number * NS_PER_S / channel.rate_hz)
                    up = [0.25, -0.5, value + STANDARD_GRAVITY_M_PER_S2]
                    found.append((ros2.TOPICS[name], IMU.name, stamp_ns, up))
        elif message.key.stream == "gnss":
            fix = decode_gnss(message.payload)
            place = [fix.latitude_deg, fix.longitude_deg, fix.altitude_m, 0.16, 0.16, 0.64]
            speed = fix.speed_m_per_s
            velocity = [speed * math.sin(1.0), speed * math.cos(1.0), 0.1]
            found.append((ros2.FIX_TOPIC, FIX.name, fix.wall_time_ns, place))
            found.append((ros2.VELOCITY_TOPIC, TWIST.name, fix.wall_time_ns, velocity))
    return sorted(found, key=lambda one: one[2])


def shifted(drive: Signals, shift_ns: int) -> Signals:
    """Return a drive at another time, without headings: ROS has none."""
    channels = {
        name: series._replace(time_ns=series.time_ns + shift_ns)
        for name, series in drive.channels.items()
    }
    fixes = drive.fixes._replace(
        time_ns=drive.fixes.time_ns + shift_ns,
        heading_deg=np.full(drive.fixes.time_ns.size, np.nan),
    )
    return drive._replace(channels=channels, fixes=fixes)


def test_crossing_of_another_client_gives_the_same_as_directly(
    client: list[str],
    start: Start,
    terminate: End,
    gateway: Callable[..., Process],
    ros_endpoint: str,
    ros_site: Path,
    endpoint: str,
    tmp_path: Path,
) -> None:
    direct, live = tmp_path / "direct.mcap", tmp_path / "live.mcap"
    simulate_to(direct)
    messages = of_drive(direct)
    written = [(*one, [repr(number) for number in numbers]) for *one, numbers in messages]
    (tmp_path / "messages.json").write_text(json.dumps(written))
    # A busy machine may publish seconds late.
    late = ros_site.read_text().replace("[ros2]\n", "[ros2]\nlargest_delay_s = 60.0\n", 1)
    ros_site.write_text(late)
    logger = start_logger(start, endpoint, live, site=ros_site)
    process = gateway("--spool", str(tmp_path / "spool"))
    host, port = ros_endpoint.removeprefix("tcp/").rsplit(":", 1)
    with (
        open_session(connect=endpoint, timeout_s=LONGEST_S) as session,
        Subscription(session, selector("sim-ros", "vehicle", "accel")) as subscription,
        subprocess.Popen(
            [*client, host, port, str(tmp_path / "messages.json")],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        ) as truck,
    ):
        heard(subscription, sum(of == IMU.name for _, of, *_ in messages) - 4 * 100)
        assert truck.stdout is not None
        done: dict[str, Any] = json.loads(truck.stdout.readline())
        hashes = {key.rsplit("/", 1)[1] for key in done["keys"]}
        assert hashes == {IMU.hash, FIX.hash, TWIST.hash}
        assert truck.stdin is not None
        truck.stdin.close()
    assert "WARNING" not in stop(process)
    terminate(logger)
    assert_same(one_run(live), shifted(one_run(direct), done["shift_ns"]), most=4e-15)
    gave, gives = estimate(direct), estimate(live)
    assert gives["verdict"] == gave["verdict"] == "good"
    for element in range(1, 8):
        before, now = (one["parameters"][f"EI_{element}"] for one in (gave, gives))
        # Draws have other seeds: the crossings have other names.
        assert abs(now["mean"] / before["mean"] - 1) < 0.2 * before["std"] / before["mean"]
