"""`driveby import` of ROS 2: MCAP and SQLite, folders and single files, and what is wrong."""

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin, Writer

from schemas.site_file import site_toml
from services.cli.main import main
from services.drives.ros2_messages import FIX, IMU
from services.drives.signals import signals_of_recording
from services.recordings.recording import read_messages
from services.simulation.drive import paper_site
from tests import ros2

FIRST_NS = 1_700_000_000_000_000_000
BOTH = [StoragePlugin.MCAP, StoragePlugin.SQLITE3]
FRONT = ros2.TOPICS["sprung_front"]


def drive(seconds: float = 3.0) -> list[ros2.Ros]:
    """All topics: accelerometers at 1 kHz, fixes and velocities at 10 Hz."""
    found = []
    for number in range(round(seconds * 1000)):
        at = FIRST_NS + number * 1_000_000
        payload = ros2.imu(at, number / 100)
        found += [ros2.Ros(topic, IMU, payload, at) for topic in ros2.TOPICS.values()]
        if number % 100 == 0:
            place = ros2.fix(at, 50.0 + number * 9e-8, 8.0)
            found.append(ros2.Ros(ros2.FIX_TOPIC, FIX, place, at))
            found.append(ros2.Ros(ros2.VELOCITY_TOPIC, ros2.TWIST, ros2.twist(at, 0.0, 10.0), at))
    return found


@pytest.fixture(scope="module")
def messages() -> list[ros2.Ros]:
    return drive()


@pytest.fixture
def site(tmp_path: Path) -> Path:
    path = tmp_path / "site.toml"
    path.write_text(site_toml(paper_site()) + ros2.ROS2)
    return path


Complaint = Callable[[Path], str]


@pytest.fixture
def complaint(site: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Complaint:
    def of(source: Path) -> str:
        output = tmp_path / "out.mcap"
        assert main(["import", str(source), "--site", str(site), "-o", str(output)]) == 2
        assert not output.exists()
        (line,) = capsys.readouterr().err.splitlines()
        assert line.startswith(f"driveby: {source}: ")
        return line

    return of


@pytest.mark.parametrize("storage", BOTH)
@pytest.mark.parametrize("alone", [False, True])
def test_a_recording_becomes_one_of_ours(
    messages: list[ros2.Ros],
    site: Path,
    tmp_path: Path,
    storage: StoragePlugin,
    alone: bool,
) -> None:
    source = ros2.record(tmp_path / "Drive 3", messages, storage)
    if alone:
        (source,) = [path for path in source.iterdir() if path.suffix in (".mcap", ".db3")]
    output = tmp_path / "out.mcap"
    assert main(["import", str(source), "--site", str(site), "-o", str(output)]) == 0
    (run,) = signals_of_recording(output)
    for series in run.channels.values():
        np.testing.assert_array_equal(series.time_ns, FIRST_NS + np.arange(3000) * 1_000_000)
        np.testing.assert_allclose(
            series.acceleration_m_per_s2, np.arange(3000) / 100, rtol=0, atol=4e-15
        )
    assert set(run.channels) == set(ros2.TOPICS)
    assert run.fixes.speed_m_per_s.tolist() == [10.0] * 30
    assert {found.key.realm for found in read_messages(output)} == {"import-drive-3"}


def test_a_channel_that_the_site_does_not_name_is_not_there(
    messages: list[ros2.Ros], site: Path, tmp_path: Path
) -> None:
    site.write_text(
        "\n".join(line for line in site.read_text().splitlines() if "unsprung_front =" not in line)
    )
    source = ros2.record(tmp_path / "bag", messages, StoragePlugin.MCAP)
    output = tmp_path / "out.mcap"
    assert main(["import", str(source), "--site", str(site), "-o", str(output)]) == 0
    (run,) = signals_of_recording(output)
    assert set(run.channels) == set(ros2.TOPICS) - {"unsprung_front"}


def test_what_was_left_out_is_told(
    messages: list[ros2.Ros], site: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lacking = [
        m for m in messages if m.topic != FRONT or m.stamp_ns % 500_000_000 or not m.stamp_ns
    ]
    source = ros2.record(tmp_path / "bag", lacking, StoragePlugin.SQLITE3)
    output = tmp_path / "out.mcap"
    assert main(["import", str(source), "--site", str(site), "-o", str(output)]) == 0
    assert f"{FRONT}: 5 samples missing, left as gaps" in capsys.readouterr().err


@pytest.mark.parametrize("storage", BOTH)
def test_files_that_are_cut_off_or_damaged_are_refused_with_a_line(
    messages: list[ros2.Ros], tmp_path: Path, storage: StoragePlugin, complaint: Complaint
) -> None:
    folder = ros2.record(tmp_path / "bag", messages[:4000], storage)
    (path,) = [path for path in folder.iterdir() if path.suffix in (".mcap", ".db3")]
    whole = path.read_bytes()
    rng = np.random.default_rng(1)
    for size in (0, 3, 10, 100, len(whole) // 2, len(whole) - 5000):
        path.write_bytes(whole[:size])
        for source in (folder, path):
            complaint(source)
    for _ in range(5):
        path.write_bytes(rng.bytes(len(whole)))
        complaint(path)


@pytest.mark.parametrize("storage", BOTH)
def test_flipped_bytes_are_refused_or_read_and_never_end_in_a_traceback(
    messages: list[ros2.Ros],
    site: Path,
    tmp_path: Path,
    storage: StoragePlugin,
    capsys: pytest.CaptureFixture[str],
) -> None:
    folder = ros2.record(tmp_path / "bag", messages[:4000], storage)
    (path,) = [path for path in folder.iterdir() if path.suffix in (".mcap", ".db3")]
    whole = path.read_bytes()
    rng = np.random.default_rng(2)
    output = tmp_path / "out.mcap"
    for number in range(40):
        damaged = bytearray(whole)
        # Half of them where the file says what is where.
        reach = len(whole) if number % 2 else 4096
        for place in rng.integers(0, reach, 10):
            damaged[-1 - place if number % 4 == 0 else place] = rng.integers(0, 256)
        path.write_bytes(damaged)
        arguments = ["import", str(path), "--site", str(site), "-o", str(output), "--force"]
        assert main(arguments) in (0, 2)
        assert "internal error" not in capsys.readouterr().err


def test_a_folder_without_its_files_and_with_bad_metadata(
    messages: list[ros2.Ros], tmp_path: Path, complaint: Complaint
) -> None:
    folder = ros2.record(tmp_path / "bag", messages[:100], StoragePlugin.MCAP)
    metadata = folder / "metadata.yaml"
    good = metadata.read_text()
    for bad in ("", "[", "a: 1", good.replace("version: 9", "version: 99"),
                good.replace("mcap", "paper")):  # fmt: skip
        metadata.write_text(bad)
        complaint(folder)
    metadata.write_text(good)
    shutil.move(folder / "bag.mcap", tmp_path / "gone.mcap")
    assert "missing" in complaint(folder)


def test_a_topic_that_is_not_there_is_named_with_those_that_are(
    messages: list[ros2.Ros], tmp_path: Path, complaint: Complaint
) -> None:
    lacking = [message for message in messages if message.topic != ros2.VELOCITY_TOPIC]
    source = ros2.record(tmp_path / "bag", lacking, StoragePlugin.MCAP)
    line = complaint(source)
    assert f"has no topic {ros2.VELOCITY_TOPIC}; it has /axle/front, " in line


def test_a_topic_of_another_type_is_refused(tmp_path: Path, complaint: Complaint) -> None:
    wrong = [message._replace(topic=FRONT) if message.topic == ros2.FIX_TOPIC else message
             for message in drive(0.2) if message.topic != FRONT]  # fmt: skip
    source = ros2.record(tmp_path / "bag", wrong, StoragePlugin.MCAP)
    assert f"{FRONT} is of {FIX.name}, {IMU.name} is expected" in complaint(source)


@pytest.mark.parametrize("storage", BOTH)
def test_a_type_with_another_definition_is_refused_by_its_hash(
    messages: list[ros2.Ros], tmp_path: Path, storage: StoragePlugin, complaint: Complaint
) -> None:
    """The same name, but another definition: in the metadata, or in the MCAP file alone."""
    definition = "std_msgs/Header header\nfloat64 acceleration\n"
    definition += "=" * 80 + "\nMSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame\n"
    definition += "=" * 80 + "\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
    other = "RIHS01_" + "1" * 64
    source = tmp_path / "bag"
    with Writer(source, version=9, storage_plugin=storage) as writer:
        for topic in {message.topic: None for message in messages}:
            of = next(message.type for message in messages if message.topic == topic)
            if topic == FRONT:
                writer.add_connection(topic, of.name, msgdef=definition, rihs01=other)
            else:
                writer.add_connection(topic, of.name, typestore=ros2.STORE)
    assert f"{FRONT}: {IMU.name} has the type hash {other}, known is {IMU.hash}" in complaint(
        source
    )
    if storage == StoragePlugin.MCAP:
        line = complaint(source / "bag.mcap")
        assert f"{FRONT}: {IMU.name} has the type hash RIHS01_" in line


def test_a_rate_that_is_not_the_declared_one_is_refused(
    messages: list[ros2.Ros], tmp_path: Path, complaint: Complaint
) -> None:
    slow = [m for m in messages if m.topic != FRONT or m.stamp_ns % 2_000_000 == 0]
    line = complaint(ros2.record(tmp_path / "bag", slow, StoragePlugin.SQLITE3))
    assert f"{FRONT}: its stamps give a rate of 500 Hz, but sensor.rate_hz of" in line


def test_a_drive_that_gives_nothing_is_refused_with_what_was_wrong(
    messages: list[ros2.Ros], tmp_path: Path, complaint: Complaint
) -> None:
    late = [message._replace(stamp_ns=message.stamp_ns + 10**10) for message in messages]
    line = complaint(ros2.record(tmp_path / "bag", late, StoragePlugin.MCAP))
    assert "gives no accelerations: " in line
    assert "stamps too far from when they were sent (the first by 10.000 s)" in line


def test_a_recording_of_ours_is_none_of_ros(complaint: Complaint, project: Path) -> None:
    line = complaint(project / "recordings" / "sample" / "crossing.mcap")
    assert "has no topic" in line or "cannot be read" in line
