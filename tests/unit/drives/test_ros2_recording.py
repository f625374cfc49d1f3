"""`driveby import` of ROS 2: MCAP and SQLite, folders and single files, and what is wrong."""

import os
import re
import shutil
import sqlite3
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import zstandard
from rosbags.rosbag2 import CompressionMode, StoragePlugin, Writer

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
    assert {found.key.realm for found in read_messages(output)} == {"import-drives"}


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


def test_excluded_data_are_reported(
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
    folder = ros2.record(tmp_path / "bag", messages[:1000], storage)
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
    assert "stamps too far from the time of sending (the first by 10.000 s)" in line


def test_a_recording_of_ours_is_none_of_ros(complaint: Complaint, project: Path) -> None:
    line = complaint(project / "recordings" / "sample" / "crossing.mcap")
    assert "has no topic" in line or "cannot be read" in line


def imported(source: Path, site: Path, output: Path) -> int:
    return main(["import", str(source), "--site", str(site), "-o", str(output), "--force"])


@pytest.mark.parametrize("mode", [CompressionMode.FILE, CompressionMode.MESSAGE])
def test_compressed_recordings_are_read(
    messages: list[ros2.Ros], site: Path, tmp_path: Path, mode: CompressionMode
) -> None:
    source = ros2.record(tmp_path / "bag", messages, StoragePlugin.SQLITE3, mode)
    assert imported(source, site, tmp_path / "out.mcap") == 0
    (run,) = signals_of_recording(tmp_path / "out.mcap")
    assert all(series.time_ns.size == 3000 for series in run.channels.values())


def test_a_message_that_unpacks_to_too_much_costs_only_itself(
    messages: list[ros2.Ros], site: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = ros2.record(tmp_path / "bag", messages, StoragePlugin.SQLITE3, CompressionMode.MESSAGE)
    with sqlite3.connect(folder / "bag.db3") as rows:
        bomb = zstandard.compress(bytes(1 << 28))
        rows.execute("UPDATE messages SET data = ? WHERE id = 1", (bomb,))
    assert len(bomb) < 20_000
    assert imported(folder, site, tmp_path / "out.mcap") == 0
    assert "1 message left out (the first has 4097 bytes, at most 4096" in capsys.readouterr().err


def a_chunk(compression: bytes, packed: bytes, size: int) -> bytes:
    """An MCAP file with one chunk and no index, which says that `size` bytes come out of it."""
    header = struct.pack("<I4sI0s", 4, b"ros2", 0, b"")
    chunk = struct.pack("<QQQI", 0, 2**62, size, 0)
    chunk += struct.pack(f"<I{len(compression)}sQ", len(compression), compression, len(packed))
    records = ((1, header), (6, chunk + packed), (2, bytes(20)))
    body = b"".join(struct.pack("<BQ", op, len(content)) + content for op, content in records)
    return b"\x89MCAP0\r\n" + body + b"\x89MCAP0\r\n"


@pytest.mark.parametrize("printed", [1000, 1 << 40])
@pytest.mark.parametrize("compression", ["zstd", "lz4"])
def test_what_unpacks_to_too_much_is_refused(
    tmp_path: Path, complaint: Complaint, compression: str, printed: int
) -> None:
    """Whether it says that so much comes, or that little does."""
    import lz4.frame

    zeros = bytes(1 << 28)
    packed = zstandard.compress(zeros) if compression == "zstd" else lz4.frame.compress(zeros)
    path = tmp_path / "drive.mcap"
    path.write_bytes(a_chunk(compression.encode(), packed, printed))
    line = complaint(path)
    expected = "expected 1000 bytes, got 1001" if printed == 1000 else f"a chunk of {printed} bytes"
    assert expected in line


def test_a_file_that_would_fill_the_disk_is_not_unpacked(
    messages: list[ros2.Ros], tmp_path: Path, complaint: Complaint, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = ros2.record(
        tmp_path / "bag", messages[:100], StoragePlugin.SQLITE3, CompressionMode.FILE
    )
    (path,) = folder.glob("*.zstd")
    path.write_bytes(zstandard.compress(bytes(1 << 22)))
    free = shutil.disk_usage(tmp_path)._replace(free=1 << 20)
    monkeypatch.setattr(shutil, "disk_usage", lambda path: free)
    assert "unpacked it is more than half of what is free in" in complaint(folder)


@pytest.mark.parametrize(
    "change",
    [
        "UPDATE messages SET data = 1000000000000 WHERE id = 5",
        "UPDATE messages SET data = 'text' WHERE id = 5",
        "UPDATE messages SET timestamp = 'noon' WHERE id = 5",
        "UPDATE messages SET timestamp = 1.5 WHERE id = 5",
        "UPDATE topics SET name = x'00ff' WHERE id = 1",
        "UPDATE topics SET type = 5.5 WHERE id = 1",
        "UPDATE topics SET type_description_hash = 'RIHS01_x'",
        "UPDATE message_definitions SET encoded_message_definition = x'ff'",
        "UPDATE message_definitions SET encoding = 'ros9msg'",
        "DROP TABLE schema; CREATE TABLE schema (schema_version); INSERT INTO schema VALUES ('x')",
        "DELETE FROM topics",
        "DROP TABLE messages",
        "ALTER TABLE messages RENAME TO x; CREATE VIEW messages AS SELECT * FROM x",
    ],
)
def test_rows_that_hold_something_else_are_refused_with_a_line(
    messages: list[ros2.Ros], tmp_path: Path, complaint: Complaint, change: str
) -> None:
    folder = ros2.record(tmp_path / "bag", messages[:400], StoragePlugin.SQLITE3)
    path = folder / "bag.db3"
    with sqlite3.connect(path) as rows:
        rows.executescript(change)
    complaint(path)


def test_how_many_messages_there_are_is_not_believed(
    messages: list[ros2.Ros], site: Path, tmp_path: Path
) -> None:
    folder = ros2.record(tmp_path / "bag", messages, StoragePlugin.SQLITE3)
    metadata = folder / "metadata.yaml"
    lied, changed = re.subn(r"message_count: \d+", "message_count: 0", metadata.read_text())
    assert changed >= 1 + len(ros2.TOPICS)
    metadata.write_text(lied)
    assert imported(folder, site, tmp_path / "out.mcap") == 0


def test_topics_that_hold_nothing_beside_others_that_do(
    tmp_path: Path, complaint: Complaint
) -> None:
    source = tmp_path / "bag"
    with Writer(source, version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        for name in ros2.TOPICS.values():
            writer.add_connection(name, IMU.name, typestore=ros2.STORE)
        writer.add_connection(ros2.FIX_TOPIC, FIX.name, typestore=ros2.STORE)
        writer.add_connection(ros2.VELOCITY_TOPIC, ros2.TWIST.name, typestore=ros2.STORE)
        camera = writer.add_connection("/camera", IMU.name, typestore=ros2.STORE)
        writer.write(camera, FIRST_NS, ros2.imu(FIRST_NS, 0.0))
    assert "gives no accelerations: it has no message of these topics" in complaint(source)


def test_a_good_hash_does_not_excuse_another_definition(
    messages: list[ros2.Ros], tmp_path: Path, complaint: Complaint
) -> None:
    """The hash in metadata.yaml is right, the definition in the MCAP file is another one."""
    source = tmp_path / "bag"
    definition = "float64 x\n"
    with Writer(source, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        for topic in {message.topic: None for message in messages}:
            of = next(message.type for message in messages if message.topic == topic)
            if of != IMU:
                writer.add_connection(topic, of.name, typestore=ros2.STORE)
            else:
                writer.add_connection(topic, of.name, msgdef=definition, rihs01=of.hash)
    assert f"{FRONT}: {IMU.name} has the type hash RIHS01_" in complaint(source)


def test_metadata_that_names_files_elsewhere_reads_none_of_them(
    messages: list[ros2.Ros], tmp_path: Path, complaint: Complaint
) -> None:
    other = ros2.record(tmp_path / "other", messages, StoragePlugin.SQLITE3)
    folder = ros2.record(tmp_path / "bag", messages[:100], StoragePlugin.SQLITE3)
    metadata = folder / "metadata.yaml"
    good = metadata.read_text()
    assert good.count("bag.db3")
    for elsewhere in (str(other / "other.db3"), "../other/other.db3", "..", "/", "."):
        metadata.write_text(good.replace("bag.db3", elsewhere))
        complaint(folder)


def test_metadata_with_aliases_is_refused(
    messages: list[ros2.Ros], site: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Ten of ten of ten …: its words would fill the memory in the error message."""
    folder = ros2.record(tmp_path / "bag", messages[:100], StoragePlugin.MCAP)
    metadata = folder / "metadata.yaml"
    nested = ", ".join(f"&a{n} [{', '.join([f'*a{n - 1}'] * 9)}]" for n in range(1, 10))
    changed = metadata.read_text().replace("compression_mode: ''", "compression_mode: FILE")
    line = f"compression_format: [&a0 [x, x], {nested}]"
    changed, number = re.subn(r"compression_format: ''", line, changed)
    assert number == 1
    metadata.write_text(changed)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("rosbags.rosbag2.Reader.open", lambda reader: pytest.fail("opened"))
        assert imported(folder, site, tmp_path / "out.mcap") == 2
    assert f"{metadata}: has aliases (*NAME)" in capsys.readouterr().err


def test_a_pipe_in_the_folder_is_not_waited_for(
    messages: list[ros2.Ros], site: Path, tmp_path: Path
) -> None:
    folder = ros2.record(tmp_path / "bag", messages[:100], StoragePlugin.SQLITE3)
    (folder / "bag.db3").unlink()
    os.mkfifo(folder / "bag.db3")
    with pytest.MonkeyPatch.context() as patch:
        # Opening it would wait for a writer for ever.
        patch.setattr("rosbags.rosbag2.Reader.open", lambda reader: pytest.fail("opened"))
        assert imported(folder, site, tmp_path / "out.mcap") == 2


def test_a_name_under_which_another_file_would_be_opened_is_refused(
    messages: list[ros2.Ros], tmp_path: Path, site: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = ros2.record(tmp_path / "bag", messages, StoragePlugin.SQLITE3)
    shutil.copy(folder / "bag.db3", tmp_path / "a")
    (tmp_path / "a?b.db3").write_bytes(b"something else")
    assert imported(tmp_path / "a?b.db3", site, tmp_path / "out.mcap") == 2
    assert "as its path contains ?, # or %" in capsys.readouterr().err


def test_messages_not_yet_in_the_file_are_reported(
    messages: list[ros2.Ros], tmp_path: Path, complaint: Complaint
) -> None:
    """As a recorder leaves it that was killed: what came last is in the log beside the file."""
    folder = ros2.record(tmp_path / "bag", messages, StoragePlugin.SQLITE3)
    path = folder / "bag.db3"
    rows = sqlite3.connect(path)
    rows.execute("PRAGMA journal_mode = WAL")
    rows.execute("UPDATE messages SET timestamp = timestamp + 1")
    rows.commit()
    shutil.copytree(folder, tmp_path / "killed")
    rows.close()
    killed = tmp_path / "killed/bag.db3"
    assert (tmp_path / "killed/bag.db3-wal").stat().st_size
    assert "its last messages are in bag.db3-wal next to it" in complaint(killed)


def test_names_that_a_terminal_would_obey_are_shown(
    messages: list[ros2.Ros], tmp_path: Path, complaint: Complaint
) -> None:
    folder = ros2.record(tmp_path / "bag", messages[:100], StoragePlugin.SQLITE3)
    path = folder / "bag.db3"
    with sqlite3.connect(path) as rows:
        rows.execute("UPDATE topics SET name = '/x' || char(27) || '[2J' || char(10) || '/y'")
    line = complaint(path)
    assert "it has /x\\x1b[2J /y" in line


def test_what_is_imported_is_never_written_over(
    messages: list[ros2.Ros], site: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = ros2.record(tmp_path / "bag", messages, StoragePlugin.MCAP)
    path = folder / "bag.mcap"
    before = path.read_bytes()
    for source, printed in (
        (path, "is read by this command"),
        (folder, "is the file to import"),
    ):
        assert imported(source, site, path) == 2
        assert printed in capsys.readouterr().err
    assert path.read_bytes() == before
