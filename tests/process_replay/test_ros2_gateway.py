"""`driveby gateway ros2`: from one router to the other, in processes, and what a file gives.

No ROS 2 runs here: messages are encoded by rosbags, keys and attachments as in rmw_zenoh's sources.
"""

import json
import subprocess
import sys
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import zenoh
from rosbags.rosbag2 import StoragePlugin

from schemas.events import decode_event
from schemas.signals import decode_accel, decode_gnss, decode_info
from schemas.site_file import load_site, site_toml
from schemas.topics import selector
from services.bus.session import open_session
from services.bus.subscription import Subscription
from services.cli.main import main
from services.drives.ros2_anomalies import DROPPED, TOO_LARGE
from services.drives.ros2_messages import FIX, IMU, TWIST
from services.drives.ros2_truck import Ros2Truck
from services.drives.signals import Signals, signals_of_recording
from services.recordings.recording import read_messages
from services.simulation.drive import paper_site
from services.truck import ros2 as gateway_of_ros2
from tests import prepared, ros2
from tests.builders.processes import stop
from tests.endpoints import free_endpoint
from tests.process_replay.starting import End, Process, Start, start_logger
from tests.waiting import LONGEST_S, until

pytestmark = pytest.mark.process

FIRST_NS = 1_700_000_000_000_000_000
ROUTER = {
    "scouting__multicast__enabled": False,
    "routing__router__peers_failover_brokering": False,
}
"""Settings of rmw_zenoh's router: it does not forward between peers, which connect themselves."""


class Ros(NamedTuple):
    """A router of ROS 2, and a session at it."""

    endpoint: str
    session: zenoh.Session


def opened(**settings: object) -> zenoh.Session:
    config = zenoh.Config()
    for name, value in settings.items():
        config.insert_json5(name.replace("__", "/"), json.dumps(value))
    return zenoh.open(config)


@pytest.fixture
def ros_endpoint() -> Iterator[str]:
    """Run a router as rmw_zenoh configures it; return its endpoint."""
    endpoint = free_endpoint()
    with opened(mode="router", listen__endpoints=[endpoint], **ROUTER):
        yield endpoint


@pytest.fixture
def ros(ros_endpoint: str) -> Iterator[Ros]:
    """Open a peer's session, as rmw_zenoh configures nodes: the router serves clients only."""
    with opened(
        mode="peer",
        connect__endpoints=[ros_endpoint],
        listen__endpoints=["tcp/127.0.0.1:0"],
        scouting__multicast__enabled=False,
    ) as session:
        yield Ros(ros_endpoint, session)


@pytest.fixture
def ros_site(tmp_path: Path) -> Path:
    path = tmp_path / "site.toml"
    path.write_text(site_toml(paper_site()) + ros2.ROS2)
    return path


@pytest.fixture
def gateway(ros_endpoint: str, endpoint: str, ros_site: Path) -> Iterator[Callable[..., Process]]:
    """Start the command; it listens when it is returned."""
    started: list[Process] = []

    def start(*options: str) -> Process:
        process = prepared.Popen(
            [
                *(sys.executable, "-m", "driveby", "gateway", "ros2", "--ros", ros_endpoint),
                *("--endpoint", endpoint, "--site", str(ros_site), "--realm", "sim-ros"),
                *options,
            ],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
        )
        started.append(process)
        assert process.stdout is not None
        assert process.stdout.readline().startswith("ready"), process.communicate()[1]
        return process

    yield start
    for process in started:
        if process.poll() is None:
            process.kill()
        process.communicate()


def heard(subscription: Subscription, samples: int) -> None:
    """Wait until so many samples of accelerometers have come."""
    found = 0

    def enough() -> bool:
        nonlocal found
        one = subscription.receive(0.1)
        if one is not None:
            found += sum(c.samples.size for c in decode_accel(one.payload).channels.values())
        return found >= samples

    until(enough, f"{samples} samples")


def one_run(path: Path) -> Signals:
    (run,) = signals_of_recording(path)
    return run


def assert_same(one: Signals, other: Signals, most: float = 0.0) -> None:
    assert set(one.channels) == set(other.channels)
    for name, series in one.channels.items():
        np.testing.assert_array_equal(series.time_ns, other.channels[name].time_ns)
        difference = series.acceleration_m_per_s2 - other.channels[name].acceleration_m_per_s2
        assert np.abs(difference).max() <= most
    for column, values in one.fixes._asdict().items():
        np.testing.assert_allclose(values, getattr(other.fixes, column), rtol=0, atol=most)


def simulate_to(path: Path) -> None:
    simulate = ["simulate", "--scenario", "6", "--noise", "25", "--gps-noise", "-o", str(path)]
    assert main(simulate) == 0


def estimate(path: Path) -> dict[str, Any]:
    results = path.with_suffix(".json")
    assert main(["identify", str(path), "--json", str(results)]) == 0
    (crossing,) = json.loads(results.read_text())["crossings"]
    return dict(crossing)


def test_a_crossing_gives_the_same_as_directly_and_as_from_a_file(
    start: Start,
    terminate: End,
    gateway: Callable[..., Process],
    ros: Ros,
    ros_site: Path,
    endpoint: str,
    tmp_path: Path,
) -> None:
    direct, live = tmp_path / "direct.mcap", tmp_path / "live.mcap"
    simulate_to(direct)
    messages = ros2.of_recording(direct)
    logger = start_logger(start, endpoint, live, site=ros_site)
    process = gateway("--spool", str(tmp_path / "spool"))
    node = ros2.RosNode(ros.session)
    samples = sum(message.type == IMU for message in messages)
    with (
        open_session(connect=endpoint, timeout_s=LONGEST_S) as session,
        Subscription(session, selector("sim-ros", "vehicle", "accel")) as subscription,
    ):
        for message in messages:
            node.publish(message)
        heard(subscription, samples - 4 * 100)  # the last batch of each is not full
    log = stop(process)
    assert "WARNING" not in log
    terminate(logger)

    streams: dict[str, list[int]] = {}
    for found in read_messages(live):
        streams.setdefault(found.key.stream, []).append(found.sequence)
    for numbers in streams.values():
        assert sorted(numbers) == list(range(len(numbers)))
    (info,) = [found for found in read_messages(live) if found.key.stream == "info"]
    assert decode_info(info.payload).vehicle_id == "truck-1"
    assert list((tmp_path / "spool").glob("*.spool")) == []  # all of it is on the logger's disk

    # A rounding of float64: gravity is added to a sample and taken away again. Nobody says where
    # the truck is heading: of a velocity it is not known which way its axes point.
    drive = one_run(direct)
    nowhere = np.full(drive.fixes.time_ns.size, np.nan)
    drive = drive._replace(fixes=drive.fixes._replace(heading_deg=nowhere))
    assert_same(one_run(live), drive, most=4e-15)
    for storage in (StoragePlugin.MCAP, StoragePlugin.SQLITE3):
        folder = ros2.record(tmp_path / f"bag_{storage.name}", messages, storage)
        imported = tmp_path / f"{storage.name}.mcap"
        assert main(["import", str(folder), "--site", str(ros_site), "-o", str(imported)]) == 0
        assert_same(one_run(imported), one_run(live))

    gave, gives = estimate(direct), estimate(live)
    assert gives["verdict"] == gave["verdict"] == "good"
    for element in range(1, 8):
        before, now = (one["parameters"][f"EI_{element}"] for one in (gave, gives))
        # Draws have other seeds: the crossings have other names.
        assert abs(now["mean"] / before["mean"] - 1) < 0.2 * before["std"] / before["mean"]
        assert now["std"] == pytest.approx(before["std"], rel=0.2)


def test_what_is_not_known_is_refused_by_name_and_hash_and_nothing_ends_it(
    start: Start,
    terminate: End,
    gateway: Callable[..., Process],
    ros: Ros,
    endpoint: str,
    tmp_path: Path,
) -> None:
    logger = start_logger(start, endpoint, tmp_path / "live.mcap")
    process = gateway()
    node, other = ros2.RosNode(ros.session), ros2.RosNode(ros.session, gid=bytes(16))
    second = ros2.RosNode(ros.session, gid=bytes(reversed(range(16))))
    first_ns = 1_700_000_000_000_000_000
    stamps = [first_ns + number * 1_000_000 for number in range(2_400)]
    front = ros2.TOPICS["sprung_front"]
    with (
        open_session(connect=endpoint, timeout_s=LONGEST_S) as session,
        Subscription(session, selector("sim-ros", "vehicle", "accel")) as subscription,
    ):
        known = ros2.Ros(front, IMU, ros2.imu(stamps[0], 0.0), stamps[0])
        other.publish(known, type_hash="RIHS01_" + "0" * 64)
        other.publish(ros2.Ros(front, FIX, ros2.fix(stamps[0], 50.0, 8.0), stamps[0]))
        nasty = FIX._replace(dds_name="x\x1b[2J\ny")
        other.publish(ros2.Ros(front, nasty, b"", stamps[0]))
        where = f"0{front}/{IMU.dds_name}/{IMU.hash}"
        for payload, attachment in (
            (known.payload, None),
            (known.payload, b"short"),
            (known.payload[:-20], ros2.attachment(1, stamps[0], bytes(15))),
            (b"\x00" * 1_000_000, ros2.attachment(2, stamps[0], bytes(15))),
        ):
            ros.session.put(
                where,
                payload,
                attachment=attachment,
                congestion_control=zenoh.CongestionControl.BLOCK,
            )
        # An hour late: who plays a bag again does not stamp anew.
        other.publish(known, sent_ns=stamps[0] + 3_600_000_000_000)
        for number, stamp_ns in enumerate(stamps):
            node.publish(ros2.Ros(front, IMU, ros2.imu(stamp_ns, number / 100), stamp_ns))
            if number % 10 == 5:  # a second sensor of the same topic
                between_ns = stamp_ns + 400_000
                second.publish(ros2.Ros(front, IMU, ros2.imu(between_ns, 77.0), between_ns))
        heard(subscription, 2_400)
    log = stop(process)
    terminate(logger)
    assert f"{front}: {IMU.name} has the type hash RIHS01_{'0' * 64}, known is {IMU.hash}" in log
    assert f"{front}: is of {FIX.dds_name}, {IMU.name} is expected; refused" in log
    assert f"{front}: is of x\\x1b[2J y, {IMU.name} is expected; refused\n" in log
    assert "240 messages of a second sensor, left out" in log
    assert "3 messages left out (the first has no attachment" in log
    assert "1 message too large for a sensor, left out" in log
    assert f"{front}: 3 messages of another type, left out (the first {IMU.name} has the" in log
    assert "1 stamp too far from the time of sending (the first by 3600.000 s)" in log
    assert "Traceback" not in log
    samples = one_run(tmp_path / "live.mcap").channels["sprung_front"]
    np.testing.assert_array_equal(samples.time_ns, stamps)
    np.testing.assert_allclose(samples.acceleration_m_per_s2, np.arange(2_400) / 100, atol=4e-15)
    assert [m for m in read_messages(tmp_path / "live.mcap") if m.key.stream == "gnss"] == []


def test_a_domain_is_its_own_and_humble_has_no_hash(
    start: Start,
    terminate: End,
    gateway: Callable[..., Process],
    ros: Ros,
    ros_site: Path,
    endpoint: str,
    tmp_path: Path,
) -> None:
    ros_site.write_text(ros_site.read_text().replace("[ros2]\n", "[ros2]\ndomain = 7\n"))
    logger = start_logger(start, endpoint, tmp_path / "live.mcap")
    process = gateway()
    node = ros2.RosNode(ros.session, domain=7)
    first_ns = 1_700_000_000_000_000_000
    with (
        open_session(connect=endpoint, timeout_s=LONGEST_S) as session,
        Subscription(session, selector("sim-ros", "vehicle", "gnss")) as subscription,
    ):
        for number in range(3):
            stamp_ns = first_ns + number * 100_000_000
            place, velocity = ros2.fix(stamp_ns, 50.0, 8.0), ros2.twist(stamp_ns, 3.0, -4.0)
            for topic, of, payload in (
                (ros2.FIX_TOPIC, FIX, place),
                (ros2.VELOCITY_TOPIC, TWIST, velocity),
            ):
                node.publish(
                    ros2.Ros(topic, of, payload, stamp_ns), type_hash="TypeHashNotSupported"
                )
        ros.session.put(f"0{ros2.FIX_TOPIC}/{FIX.dds_name}/{FIX.hash}", b"of another domain")
        speeds: list[float] = []

        def three() -> bool:
            one = subscription.receive(0.1)
            if one is not None:
                speeds.append(decode_gnss(one.payload).speed_m_per_s)
            return len(speeds) == 3

        until(three, "three fixes")
    assert speeds == [5.0, 5.0, 5.0]
    assert "left out" not in stop(process)
    terminate(logger)


def test_stranger_with_a_wrong_rate_costs_the_truck_nothing(
    start: Start,
    terminate: End,
    gateway: Callable[..., Process],
    ros: Ros,
    endpoint: str,
    tmp_path: Path,
) -> None:
    """It speaks first on a topic of the truck, and goes on beside the truck's own sensor."""
    live = tmp_path / "live.mcap"
    logger = start_logger(start, endpoint, live)
    process = gateway("--spool", str(tmp_path / "spool"))
    own, stranger = ros2.RosNode(ros.session), ros2.RosNode(ros.session, gid=bytes(16))
    front, rear = ros2.TOPICS["sprung_front"], ros2.TOPICS["sprung_rear"]
    first_ns = 1_700_000_000_000_000_000
    stamps = [first_ns + number * 1_000_000 for number in range(2_400)]
    with (
        open_session(connect=endpoint, timeout_s=LONGEST_S) as session,
        Subscription(session, selector("sim-ros", "vehicle", "accel")) as subscription,
    ):
        for number in range(900):  # its rate is known after two seconds of its stamps
            stamp_ns = first_ns + number * 2_500_000
            stranger.publish(ros2.Ros(front, IMU, ros2.imu(stamp_ns, 77.0), stamp_ns))
        for number, stamp_ns in enumerate(stamps):
            for topic in (front, rear):
                own.publish(ros2.Ros(topic, IMU, ros2.imu(stamp_ns, number / 100), stamp_ns))
            if number % 10 == 5:
                between_ns = stamp_ns + 400_000
                stranger.publish(ros2.Ros(front, IMU, ros2.imu(between_ns, 77.0), between_ns))
        heard(subscription, 2 * 2_400)
    log = stop(process)
    terminate(logger)
    line = (
        "messages at a wrong rate, left out (its stamps give a rate of 400 Hz, but sensor.rate_hz"
    )
    assert f"{front}: 900 {line}" in log
    assert f"{front}: 240 messages of a second sensor, left out" in log
    assert "Traceback" not in log
    for name in ("sprung_front", "sprung_rear"):
        samples = one_run(live).channels[name]
        np.testing.assert_array_equal(samples.time_ns, stamps)
        measured = samples.acceleration_m_per_s2
        np.testing.assert_allclose(measured, np.arange(2_400) / 100, atol=4e-15)
    events = [
        decode_event(found.payload)
        for found in read_messages(live)
        if found.key[1:] == ("service", "gateway-truck-1", "event")
    ]
    assert {(event.kind, event.vehicle, event.stream) for event in events} == {
        ("refused", "truck-1", "accel")
    }
    assert sum(event.messages for event in events) == 900 + 240
    assert f"{front}: 900 {line}" in " ".join(event.text for event in events)


def test_flood_fills_no_memory_and_costs_other_topics_nothing(
    ros: Ros, ros_site: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nobody takes what waits meanwhile. What was dropped or never kept is counted."""
    monkeypatch.setattr(gateway_of_ros2, "_WAITING_BYTES", 1 << 20)
    truck = Ros2Truck(load_site(ros_site), str(ros_site), "truck-1")
    front, rear = ros2.TOPICS["sprung_front"], ros2.TOPICS["sprung_rear"]
    where = f"0{front}/{IMU.dds_name}/{IMU.hash}"
    with (
        open_session(connect=ros.endpoint, timeout_s=LONGEST_S) as session,
        gateway_of_ros2._RosSubscriptions(session, truck) as hearing,
    ):

        def is_counted(number: int) -> bool:
            return hearing._too_large[front] == number

        node = ros2.RosNode(ros.session)
        node.publish(ros2.Ros(front, IMU, ros2.imu(FIRST_NS, 0.0), FIRST_NS))
        for sent in range(1, 31):
            ros.session.put(
                where, bytes(10_000_000), congestion_control=zenoh.CongestionControl.BLOCK
            )
            # Zenoh closes a link that is blocked for seconds, as on a busy machine.
            until(partial(is_counted, sent), "a message that is too large")
        for _ in range(1_000):
            ros.session.put(where, bytes(4_000), congestion_control=zenoh.CongestionControl.BLOCK)
        for number in range(100):
            stamp_ns = FIRST_NS + number * 1_000_000
            node.publish(ros2.Ros(rear, IMU, ros2.imu(stamp_ns, 0.0), stamp_ns))
        until(
            lambda: len(hearing._waiting[rear]) == 100, "the messages of the other topic's sensor"
        )
        kept = 0
        while (heard := hearing.next(front)) is not None:
            kept += 1
            assert len(heard.payload) == 4_000
        hearing.count_drops()
    dropped = truck.anomalies.count(front, DROPPED)
    assert truck.anomalies.count(front, TOO_LARGE) == 30
    assert kept * 4_000 < 1 << 20
    assert kept + dropped == 1_001
    (refusals,) = truck.anomalies.refusals()
    assert (refusals.refused, refusals.dropped) == (30, dropped)


def test_without_a_router_of_ros_it_says_so(ros_site: Path, endpoint: str) -> None:
    command = [sys.executable, "-m", "driveby", "gateway", "ros2", "--ros", free_endpoint()]
    done = subprocess.run(
        [*command, "--site", str(ros_site), "--endpoint", endpoint],
        capture_output=True,
        text=True,
        timeout=LONGEST_S,
        check=False,
    )
    assert done.returncode == 1
    assert "no router of ROS 2 answers at" in done.stderr.splitlines()[-1]
