"""Recordings: what goes in comes out, and damage costs only what was damaged."""

import fcntl
import io
import os
import random
import subprocess
import sys
import tracemalloc
from collections.abc import Iterator
from pathlib import Path

import pytest
from mcap.reader import make_reader

from schemas.messages import descriptors
from schemas.signals import GnssFix, encode_gnss, encode_location
from schemas.topics import Key, Message
from services.common.errors import InputError
from services.recordings.mcap_file import McapWriter
from services.recordings.recording import read_identities, read_info, read_messages, read_site
from services.recordings.writer import RecordingOrigin, RecordingWriter, write_recording

START_NS = 1_700_000_000_000_000_000
SITE = '[vehicle]\nid = "truck-1"  # ü\n'


def fixes(number: int, boot_id: int = 2**63 + 5) -> Iterator[Message]:
    for sequence in range(number):
        time_ns = START_NS + sequence * 100_000_000
        fix = GnssFix(boot_id, sequence, 0, time_ns, 50 + sequence * 1e-5, 8.0, 100.0, 10.0)
        for stream, encode in (("gnss", encode_gnss), ("location", encode_location)):
            where = Key("sim-test", "vehicle", "truck-1", stream)
            yield Message(where, encode(fix), boot_id, sequence, time_ns, time_ns + 7)


def test_everything_comes_back(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    messages = [*fixes(500), *fixes(3, boot_id=9)]
    assert write_recording(path, iter(messages), site_toml=SITE, reason="simulated") == 1006
    assert list(read_messages(path)) == messages
    assert read_site(path) == SITE
    info = read_info(path)
    assert info.about["program"] == "driveby"
    assert (info.about["realm"], info.about["vehicle"]) == ("sim-test", "truck-1")
    assert info.start["reason"] == "simulated"
    assert info.end is not None
    assert info.end["messages"] == "1006"
    assert info.messages == {
        "driveby/v1/sim-test/vehicle/truck-1/gnss": 503,
        "driveby/v1/sim-test/vehicle/truck-1/location": 503,
    }
    assert info.first_time_ns == START_NS
    assert info.last_time_ns == START_NS + 499 * 100_000_000
    assert (info.damaged_chunks, info.truncated) == (0, False)


def test_a_file_that_is_open_for_an_hour_takes_little_memory() -> None:
    """Its index is kept until the end: 7200 chunks, for each of hundreds of trucks."""
    writer = McapWriter(lambda _: None, library="", chunk_bytes=1 << 20)
    schema = writer.add_schema("a", "protobuf", b"")
    channels = [writer.add_channel(f"a/{n}", "protobuf", schema, {}) for n in range(3)]
    rng = random.Random(1)
    tracemalloc.start()
    try:
        for chunk in range(7200):
            for n, channel in enumerate(channels):
                time_ns = START_NS + chunk * 500_000_000 + rng.randrange(1_000_000)
                data = rng.randbytes(rng.randrange(50, 60) if n else 1)
                writer.add_message(channel, chunk, time_ns, time_ns, data)
            writer.flush()
        taken, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert taken < 300_000


def test_the_same_messages_give_the_same_bytes(tmp_path: Path) -> None:
    for name in ("a.mcap", "b.mcap"):
        write_recording(tmp_path / name, fixes(10), site_toml=SITE, reason="simulated")
    assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "b.mcap").read_bytes()


def test_other_readers_find_schemas_that_decode_by_themselves(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    write_recording(path, fixes(3), site_toml=None, reason="simulated")
    with path.open("rb") as file:
        summary = make_reader(file, validate_crcs=True).get_summary()
    assert summary is not None
    assert summary.statistics is not None
    assert summary.statistics.message_count == 6
    schemas = {schema.name: schema for schema in summary.schemas.values()}
    assert set(schemas) == {"driveby.v1.GnssFix", "foxglove.LocationFix"}
    for name, schema in schemas.items():
        assert schema.encoding == "protobuf"
        assert schema.data == descriptors(name)
    for channel in summary.channels.values():
        assert channel.message_encoding == "protobuf"
        assert channel.metadata["boot_id"] == str(2**63 + 5)
    assert read_site(path) is None


def test_a_file_that_is_being_written_is_not_called_cut_off(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    write_recording(path, fixes(2000), site_toml=SITE, reason="simulated")
    path.write_bytes(path.read_bytes()[:-100])
    for is_written, words in ((True, "is being written"), (False, "cut off at byte")):
        heard: list[str] = []
        with path.open("r+b") as writer:
            if is_written:
                fcntl.flock(writer, fcntl.LOCK_EX)
            assert list(read_messages(path, warn=heard.append)) == list(fixes(2000))
        (line,) = heard
        assert line.startswith(f"{path}: {words}")


def test_a_file_cut_off_anywhere_keeps_its_whole_chunks(tmp_path: Path) -> None:
    whole = tmp_path / "whole.mcap"
    messages = list(fixes(3000))
    write_recording(whole, messages, site_toml=SITE, reason="simulated")
    content = whole.read_bytes()
    cut = tmp_path / "cut.mcap"
    before = 0
    for size in range(100, len(content), len(content) // 60):
        cut.write_bytes(content[:size])
        info = read_info(cut)
        assert info.truncated
        assert info.damaged_chunks == 0
        number = sum(info.messages.values())
        assert number >= before
        before = number
        if number:
            assert list(read_messages(cut)) == messages[:number]
        else:
            with pytest.raises(InputError, match="no driveby message"):
                list(read_messages(cut))
    # Chunks are small enough for a cut near the end to cost little.
    assert before >= 0.8 * len(messages)


def test_a_damaged_chunk_costs_only_itself(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    messages = list(fixes(3000))
    write_recording(path, messages, site_toml=None, reason="simulated")
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 0x10
    path.write_bytes(content)
    info = read_info(path)
    assert info.damaged_chunks == 1
    assert not info.truncated
    read = list(read_messages(path))
    assert len(messages) * 0.5 < len(read) < len(messages)
    assert set(read) < set(messages)


def test_a_damaged_length_does_not_ask_for_memory(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    write_recording(path, fixes(3), site_toml=None, reason="simulated")
    content = bytearray(path.read_bytes())
    content[9:17] = (2**62).to_bytes(8, "little")  # of the header, the first record
    path.write_bytes(content)
    info = read_info(path)
    assert (info.damaged_chunks, info.truncated) == (1, False)
    assert list(read_messages(path)) == list(fixes(3))


def test_what_was_synced_is_readable_without_an_end(tmp_path: Path) -> None:
    path = tmp_path / "new" / "folder" / "a.mcap"
    writer = RecordingWriter(path, reason="test", origin=RecordingOrigin("live", site_toml=SITE))
    messages = list(fixes(10))
    for message in messages[:15]:
        writer.write(message)
    writer.sync()
    for message in messages[15:]:
        writer.write(message)
    # As after kill -9: nothing that is still in the writer's memory reaches the file.
    copy = tmp_path / "copy.mcap"
    copy.write_bytes(path.read_bytes())
    assert list(read_messages(copy)) == messages[:15]
    assert read_info(copy).end is None
    assert read_site(copy) == SITE
    writer.finish("done", {"lost": 3})
    info = read_info(path)
    assert info.end is not None
    assert (info.end["reason"], info.end["lost"], info.end["messages"]) == ("done", "3", "20")
    assert list(read_messages(path)) == messages


@pytest.mark.parametrize("ending", ["closed", "crashed", "damaged"])
def test_which_messages_are_in_a_recording(
    tmp_path: Path, ending: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    if ending != "closed":
        monkeypatch.setattr("services.recordings.writer._IDENTITIES_PERIOD_S", 0.0)
    path = tmp_path / "a.mcap"
    writer = RecordingWriter(path, reason="test")
    messages = [m for m in fixes(1000) if m.sequence not in (5, 6, 500)]
    for n, message in enumerate(messages):
        writer.write(message)
        if n % 100 == 0:
            writer.sync()
        if n == 1500:
            half_way = path.stat().st_size
    if ending == "closed":
        writer.finish("done")
    else:
        writer.sync()
        writer.abandon()
    content = bytearray(path.read_bytes())
    if ending == "damaged":  # the last one cannot be read, nor what stood before it
        content[-20:] = bytes(20)
    elif ending == "closed":
        content[half_way // 2 : half_way] = bytes(half_way - half_way // 2)  # it is not read
    path.write_bytes(content)
    found = read_identities(path)
    for stream in ("gnss", "location"):
        numbers = found[(Key("sim-test", "vehicle", "truck-1", stream), 2**63 + 5)]
        expected = [m.sequence for m in messages if m.key.stream == stream]
        assert [n for a, b in numbers.ranges() for n in range(a, b + 1)] == expected
    assert len(found) == 2


def test_sync_reaches_the_disk_itself(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    writer = RecordingWriter(tmp_path / "a.mcap", reason="test")
    synced: list[int] = []
    real = os.fsync
    monkeypatch.setattr(os, "fsync", lambda fd: synced.append(os.fstat(fd).st_size) or real(fd))
    before = (tmp_path / "a.mcap").stat().st_size
    writer.write(next(fixes(1)))
    writer.sync()
    assert synced[-1] > before
    writer.finish("done")
    assert len(synced) == 2


def test_a_recording_is_never_overwritten(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    path.write_bytes(b"precious")
    with pytest.raises(InputError, match="never overwritten"):
        RecordingWriter(path, reason="test")
    assert path.read_bytes() == b"precious"


def test_a_failed_source_leaves_nothing_behind(tmp_path: Path) -> None:
    def broken() -> Iterator[Message]:
        yield from fixes(2)
        raise InputError("accel.csv: line 7")

    path = tmp_path / "a.mcap"
    path.write_bytes(b"as before")
    with pytest.raises(InputError, match="line 7"):
        write_recording(path, broken(), site_toml=None, reason="import", force=True)
    assert path.read_bytes() == b"as before"
    assert [file.name for file in tmp_path.iterdir()] == ["a.mcap"]


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (None, "no such file"),
        (b"", "is empty"),
        (b"accel,time\n1,2\n", "not an MCAP file"),
        (b"\x89MCAP0\r\n", "no driveby message"),
    ],
)
def test_what_is_no_recording(tmp_path: Path, content: bytes | None, reason: str) -> None:
    path = tmp_path / "a.mcap"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(InputError, match=rf"a\.mcap: .*{reason}"):
        list(read_messages(path))


def test_a_folder_is_no_recording(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be read"):
        list(read_messages(tmp_path))


def test_topics_of_others_are_left_out(tmp_path: Path) -> None:
    from mcap.writer import Writer

    buffer = io.BytesIO()
    writer = Writer(buffer)
    writer.start()
    channel = writer.register_channel("/camera", "json", 0)
    writer.add_message(channel, 1, b"{}", 1)
    ours = writer.register_channel("driveby/v1/live/vehicle/t/gnss", "protobuf", 0)
    writer.add_message(ours, START_NS, b"x", START_NS, 3)
    writer.finish()
    path = tmp_path / "a.mcap"
    path.write_bytes(buffer.getvalue())
    assert list(read_messages(path)) == [
        Message(Key("live", "vehicle", "t", "gnss"), b"x", 0, 3, START_NS, START_NS)
    ]


def test_rerun_draws_the_track_of_a_recording_opened_directly(tmp_path: Path) -> None:
    """Rerun's own importer must find positions for a map; in a process, for it keeps threads."""
    recording, drawn = tmp_path / "a.mcap", tmp_path / "a.rrd"
    write_recording(recording, fixes(20), site_toml=SITE, reason="simulated")
    code = (
        "import sys, rerun\n"
        "rerun.init('test')\n"
        "rerun.save(sys.argv[2])\n"
        "rerun.log_file_from_path(sys.argv[1])\n"
        "rerun.disconnect()\n"
    )
    subprocess.run([sys.executable, "-c", code, recording, drawn], check=True)
    content = drawn.read_bytes()
    assert b"GeoPoints:positions" in content
    assert b"driveby.v1.GnssFix:message" in content
