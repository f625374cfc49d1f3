"""`recover` under damage in every place: every intact chunk comes back, never an exception."""

import json
import random
import signal
import struct
import subprocess
import sys
import tracemalloc
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest
import zstandard
from mcap.reader import make_reader
from mcap.stream_reader import StreamReader

from schemas.events import EventKind, decode_event
from schemas.messages import descriptors
from schemas.signals import GnssFix, encode_gnss
from schemas.topics import Key, Message
from services.cli import main as cli
from services.common.errors import FailureError, InputError
from services.recordings.mcap_scan import MAX_RECORD_BYTES
from services.recordings.recording import read_info, read_messages, read_site
from services.recordings.recovery import Recovery, recover_recording, recovered_path
from services.recordings.writer import RecordingOrigin, RecordingWriter, write_recording

NOW_NS = 1_700_000_000_000_000_000
CHUNKS = 60
PER_CHUNK = 9
DRAWS = 200
QUARTERS = (0, *(pytest.param(n, marks=pytest.mark.faults) for n in (1, 2, 3)))
SITE = '[vehicle]\nid = "truck-1"\n'


class Chunk(NamedTuple):
    begin: int
    end: int
    """Of the record itself."""
    messages: tuple[Message, ...]


class Whole(NamedTuple):
    content: bytes
    chunks: list[Chunk]
    data_end: int
    """Where the index of the last chunk ends: behind it stand only sentinels and summary."""

    @property
    def messages(self) -> list[Message]:
        return [message for chunk in self.chunks for message in chunk.messages]


def fixes(number: int, boot_id: int = 7) -> Iterator[Message]:
    rng = random.Random(boot_id)
    for sequence in range(number):
        time_ns = NOW_NS + sequence * 100_000_000
        fix = GnssFix(boot_id, sequence, 0, time_ns, 50 + rng.random(), rng.random(), 100.0, 10.0)
        where = Key("live", "vehicle", f"truck-{sequence % 3}", "gnss")
        yield Message(where, encode_gnss(fix), boot_id, sequence, time_ns, time_ns + 7)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Whole:
    path = tmp_path_factory.mktemp("whole") / "a.mcap"
    writer = RecordingWriter(path, reason="test", origin=RecordingOrigin("live", site_toml=SITE))
    messages = list(fixes(CHUNKS * PER_CHUNK))
    chunks = []
    for first in range(0, len(messages), PER_CHUNK):
        begin = writer.tell()
        some = messages[first : first + PER_CHUNK]
        for message in some:
            writer.write(message)
        writer.sync()
        length = struct.unpack_from("<Q", path.read_bytes(), begin + 1)[0]
        chunks.append(Chunk(begin, begin + 9 + length, tuple(some)))
    data_end = writer.tell()
    writer.finish("done", {"dropped": 0})
    return Whole(path.read_bytes(), chunks, data_end)


def damaged(tmp_path: Path, content: bytes) -> Path:
    path = tmp_path / "a.mcap"
    path.write_bytes(content)
    return path


def recovered(path: Path) -> tuple[Recovery, list[Message]]:
    """Recover, check that any MCAP reader opens the result, and return its data."""
    target = recovered_path(path)
    recovery = recover_recording(path, target, time_ns=NOW_NS, force=True)
    with target.open("rb") as file:
        summary = make_reader(file, validate_crcs=True).get_summary()
        assert summary is not None
        assert summary.statistics is not None
        file.seek(0)
        for _ in StreamReader(file, validate_crcs=True).records:
            pass
    info = read_info(target)
    assert info.end is not None
    assert (info.damaged_chunks, info.truncated) == (0, False)
    assert info.end["messages"] == str(summary.statistics.message_count)
    found = list(read_messages(target)) if summary.statistics.message_count else []
    events = [m for m in found if m.key.owner == "service"]
    assert len(events) == recovery.is_lossy
    assert all(decode_event(m.payload).kind == EventKind.RECORDING_RECOVERED for m in events)
    assert path.exists()
    data = [m for m in found if m.key.owner == "vehicle"]
    assert recovery.messages == len(data)
    return recovery, data


def test_an_undamaged_recording_is_clean(whole: Whole, tmp_path: Path) -> None:
    recovery, data = recovered(damaged(tmp_path, whole.content))
    assert data == whole.messages
    assert not recovery.is_lossy
    assert (recovery.lost, recovery.damaged_bytes, recovery.missing_numbers) == (0, 0, 1074)
    target = tmp_path / "a.recovered.mcap"
    assert read_site(target) == SITE
    info = read_info(target)
    assert info.about["realm"] == "live"
    assert info.start["reason"] == "test"
    assert info.end is not None
    assert (info.end["reason"], info.end["dropped"]) == ("done", "0")


def test_absent_numbers_of_other_streams_are_no_loss(tmp_path: Path) -> None:
    """Events of one service are spread over the files of all trucks, `info` is sent again."""
    path = tmp_path / "a.mcap"
    keys = [
        *(Key("live", "service", "logger", "event"), Key("live", "bridge", "bridge-1", "estimate")),
        *(Key("live", "vehicle", "truck-1", "info"), Key("live", "vehicle", "truck-1", "gnss")),
    ]
    some = [Message(where, b"", 7, n, NOW_NS, NOW_NS) for where in keys for n in (0, 4, 9)]
    write_recording(path, some, site_toml=None, reason="test")
    assert recover_recording(path, recovered_path(path)).missing_numbers == 7


@pytest.mark.parametrize("cut", ["begin", "end"])
def test_cut_off_at_every_record_of_the_end(whole: Whole, tmp_path: Path, cut: str) -> None:
    """Behind the data only END counts: without it the recording is not known to be whole."""
    offset = whole.data_end if cut == "begin" else len(whole.content) - 1
    recovery, data = recovered(damaged(tmp_path, whole.content[:offset]))
    assert data == whole.messages
    assert recovery.is_cut_off == (cut == "begin")
    assert recovery.lost == (None if cut == "begin" else 0)


@pytest.mark.parametrize("part", QUARTERS)
def test_cut_off_at_200_places(whole: Whole, tmp_path: Path, part: int) -> None:
    rng = random.Random(1)
    offsets = [rng.randrange(len(whole.content)) for _ in range(DRAWS)]
    offsets[:10] = [0, 1, 7, 8, 9, 17, 25, whole.chunks[0].begin, whole.chunks[0].begin + 9, 60]
    for offset in offsets[part::4]:
        path = damaged(tmp_path, whole.content[:offset])
        intact = [m for c in whole.chunks if c.end <= offset for m in c.messages]
        if offset < 25:
            with pytest.raises(InputError):
                recovered(path)
            continue
        if offset < whole.chunks[0].begin and not intact:
            try:
                _, data = recovered(path)
            except InputError:
                continue
            assert data == []
            continue
        recovery, data = recovered(path)
        assert data == intact, offset
        assert recovery.is_lossy or offset > whole.data_end
        assert recovery.is_cut_off or offset > whole.data_end


@pytest.mark.parametrize("part", QUARTERS)
def test_a_bit_flipped_in_200_places(whole: Whole, tmp_path: Path, part: int) -> None:
    """Anywhere, and on purpose in the header, in every field of chunks, index and summary."""
    rng = random.Random(2)
    places = [rng.randrange(len(whole.content)) for _ in range(100)]
    places += list(range(0, 25, 2))  # magic and header
    for chunk in (whole.chunks[0], whole.chunks[30], whole.chunks[-1]):
        places += [chunk.begin + n for n in (0, 1, 3, 8, 9, 17, 25, 28, 33, 37, 41, 45, 48, 53, 60)]
        places += [chunk.end + n for n in (0, 2, 9, 11, 20)]  # its message index
    places += [whole.data_end + n for n in range(27)]
    assert len(places) >= DRAWS
    for place in places[part::4]:
        content = bytearray(whole.content)
        content[place] ^= 1 << rng.randrange(8)
        hit = [c for c in whole.chunks if c.begin <= place < c.end]
        intact = [m for c in whole.chunks if c not in hit for m in c.messages]
        recovery, data = recovered(damaged(tmp_path, bytes(content)))
        # A chunk whose header alone is damaged comes back as well.
        assert data in (intact, whole.messages), place
        assert data == whole.messages or recovery.is_lossy
        if data != whole.messages and not recovery.is_cut_off:
            assert recovery.lost == PER_CHUNK
        if hit and 28 + 9 <= place - hit[0].begin < 53:
            assert data == whole.messages, place  # the frame itself says how it is compressed


def test_a_chunk_comes_back_if_its_header_alone_is_damaged(whole: Whole, tmp_path: Path) -> None:
    """Opcode, lengths, times, name of the compression; all but the checksum itself."""
    begin = whole.chunks[30].begin
    for place in (*range(33), *range(37, 53)):
        content = bytearray(whole.content)
        content[begin + place] ^= 1 << (place % 8)
        recovery, data = recovered(damaged(tmp_path, bytes(content)))
        assert data == whole.messages, place
        assert recovery.lost == 0


@pytest.mark.parametrize("size", [1, 100, 512, 4096])
def test_a_stretch_of_zeros_costs_only_what_it_covers(
    whole: Whole, tmp_path: Path, size: int
) -> None:
    rng = random.Random(size)
    for _ in range(25):
        begin = rng.randrange(whole.chunks[0].begin, whole.data_end)
        content = bytearray(whole.content)
        content[begin : begin + size] = bytes(len(content[begin : begin + size]))
        hit = [c for c in whole.chunks if c.begin < begin + size and begin < c.end]
        must = {m for c in whole.chunks if c not in hit for m in c.messages}
        _, data = recovered(damaged(tmp_path, bytes(content)))
        assert must <= set(data) <= set(whole.messages)
        assert data == sorted(data, key=lambda m: m.sequence)


def test_index_gives_the_message_count_of_a_damaged_chunk(whole: Whole, tmp_path: Path) -> None:
    content = bytearray(whole.content[: whole.data_end])  # no END that would show it
    content[whole.chunks[5].begin + 80] ^= 0xFF
    content[whole.chunks[9].begin + 80] ^= 0xFF
    recovery, data = recovered(damaged(tmp_path, bytes(content)))
    assert recovery.lost == 2 * PER_CHUNK
    assert len(data) == (CHUNKS - 2) * PER_CHUNK
    assert recovery.damaged_places == 2


def chunk_of(content: bytes, *, size: int | None = None, data: bytes | None = None) -> bytes:
    data = zstandard.compress(content) if data is None else data
    body = struct.pack("<QQQI", 1, 1, len(content) if size is None else size, zlib.crc32(content))
    body += struct.pack("<I4sQ", 4, b"zstd", len(data)) + data
    return struct.pack("<BQ", 6, len(body)) + body


def test_bombs_and_huge_lengths_ask_for_no_memory(whole: Whole, tmp_path: Path) -> None:
    """A chunk of 512 MiB of zeros in 16 KiB, and lengths of every size in every kind of record."""
    middle = whole.chunks[20].begin
    compressor = zstandard.ZstdCompressor().compressobj(size=8 * MAX_RECORD_BYTES)
    zeros = bytes(MAX_RECORD_BYTES // 16)
    bomb = b"".join(compressor.compress(zeros) for _ in range(8 * 16)) + compressor.flush()
    strange = [chunk_of(b"", size=1 << 62, data=bomb)]
    for opcode in range(1, 16):
        strange += [struct.pack("<BQ", opcode, 1 << n) + b"\xff" * 30 for n in (20, 33, 40, 62)]
    content = whole.content[:middle] + b"".join(strange) + whole.content[middle:]
    path = damaged(tmp_path, content)
    tracemalloc.start()
    recovery, data = recovered(path)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert data == whole.messages
    assert recovery.is_lossy
    assert peak < 3 * MAX_RECORD_BYTES


def test_later_chunks_identify_the_truck_without_the_first(whole: Whole, tmp_path: Path) -> None:
    """Schemas stand in the first chunk only; its loss must not cost the rest of the drive."""
    first = whole.chunks[0]
    content = whole.content[: first.begin] + whole.content[first.end : whole.data_end]
    recovery, data = recovered(damaged(tmp_path, content))
    assert data == whole.messages[PER_CHUNK:]
    assert recovery.is_cut_off
    with (tmp_path / "a.recovered.mcap").open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    assert {schema.name for schema in summary.schemas.values()} == {
        "driveby.v1.GnssFix",
        "driveby.v1.Event",
    }


def test_an_older_recording_without_its_first_chunk_is_read_by_its_summary(
    tmp_path: Path,
) -> None:
    """mcap's own writer names a channel once, and again in the summary."""
    from mcap.writer import CompressionType, Writer

    path = tmp_path / "a.mcap"
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=2000, compression=CompressionType.ZSTD)
        writer.start()
        channel = writer.register_channel("driveby/v1/live/vehicle/t/gnss", "protobuf", 0)
        for message in fixes(200):
            writer.add_message(channel, message.log_time_ns, message.payload, 0, message.sequence)
        writer.finish()
    content = bytearray(path.read_bytes())
    first = content.index(b"zstd")
    content[first + 40] ^= 0xFF
    path.write_bytes(content)
    recovery, data = recovered(path)
    assert 100 < len(data) < 200
    assert recovery.lost is not None
    assert recovery.lost == 200 - len(data)
    assert [m for m in read_messages(path) if m.key.owner == "vehicle"] == data


def test_a_schema_without_content_is_filled_in_where_its_message_is_known(
    tmp_path: Path,
) -> None:
    """One of a topic of ours by our own; what somebody else recorded beside it stays his."""
    from mcap.writer import Writer

    path = tmp_path / "a.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        ours = writer.register_schema("driveby.v1.GnssFix", "protobuf", b"")
        theirs = writer.register_schema("their.Text", "jsonschema", b"")
        fix = next(fixes(1))
        topic = "driveby/v1/live/vehicle/t/gnss"
        for name, encoding, schema, payload in (
            (topic, "protobuf", ours, fix.payload),
            ("/their/text", "json", theirs, b"{}"),
        ):
            channel = writer.register_channel(name, encoding, schema)
            writer.add_message(channel, NOW_NS, payload, NOW_NS)
        writer.finish()
    target = recovered_path(path)
    assert recover_recording(path, target, time_ns=NOW_NS).messages == 2
    with target.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    found = {
        channel.topic: summary.schemas[channel.schema_id] for channel in summary.channels.values()
    }
    assert found[topic].name == "driveby.v1.GnssFix"
    assert found[topic].data == descriptors("driveby.v1.GnssFix")
    kept = found["/their/text"]
    assert (kept.name, kept.encoding, kept.data) == ("their.Text", "jsonschema", b"")


def test_a_large_torn_chunk_gives_back_its_first_blocks(tmp_path: Path) -> None:
    """Of chunks beyond 128 KiB, such as other programs write, zstd returns the blocks before."""
    from mcap.writer import CompressionType, Writer

    path = tmp_path / "a.mcap"
    rng = random.Random(3)
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=1 << 22, compression=CompressionType.ZSTD)
        writer.start()
        channel = writer.register_channel("/camera", "raw", 0)
        for n in range(1000):
            writer.add_message(channel, n + 1, rng.randbytes(1000), n + 1, n)
        writer.finish()
    path.write_bytes(path.read_bytes()[:600_000])
    target = recovered_path(path)
    recovery = recover_recording(path, target)
    assert 300 < recovery.messages < 600
    assert recovery.is_lossy


def test_what_is_no_recording_is_bad_input(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    for content in (
        b"",
        b"accel,time\n1,2\n" * 100,
        b"\x89MCAP0\r\n",
        random.Random(4).randbytes(50_000),
    ):
        path.write_bytes(content)
        with pytest.raises(InputError, match="holds nothing"):
            recover_recording(path, recovered_path(path))
    with pytest.raises(InputError, match="no such file"):
        recover_recording(tmp_path / "b.mcap", recovered_path(path))
    with pytest.raises(InputError, match="cannot be read"):
        recover_recording(tmp_path, recovered_path(path))
    assert [p.name for p in tmp_path.iterdir()] == ["a.mcap"]


def test_a_recording_that_is_being_written_is_left_alone(tmp_path: Path) -> None:
    writer = RecordingWriter(tmp_path / "a.mcap", reason="test")
    with pytest.raises(InputError, match="being written"):
        recover_recording(writer.path, recovered_path(writer.path))
    writer.abandon()
    recover_recording(writer.path, recovered_path(writer.path))


def test_what_was_set_aside_is_recovered_to_the_same_place(tmp_path: Path) -> None:
    expected = tmp_path / "a.recovered.mcap"
    assert recovered_path(tmp_path / "a.mcap") == expected
    assert recovered_path(tmp_path / "a.mcap.crashed") == expected


def test_interrupt_between_the_two_names_leaves_the_recording_once(
    whole: Whole, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A logger that ends interrupts the child that recovers for it, at any moment."""
    path = damaged(tmp_path, whole.content[: whole.data_end // 2])
    before = signal.getsignal(signal.SIGINT)
    replace = Path.replace

    def renamed_and_interrupted(self: Path, target: Path) -> Path:
        done = replace(self, target)
        signal.raise_signal(signal.SIGINT)
        return done

    monkeypatch.setattr(Path, "replace", renamed_and_interrupted)
    with pytest.raises(KeyboardInterrupt):
        recover_recording(path, recovered_path(path), set_aside=True)
    assert sorted(p.name for p in tmp_path.iterdir()) == [
        path.name + ".crashed",
        recovered_path(path).name,
    ]
    assert signal.getsignal(signal.SIGINT) is before


def test_the_damaged_file_is_never_the_target(whole: Whole, tmp_path: Path) -> None:
    path = damaged(tmp_path, whole.content)
    (tmp_path / "link.mcap").symlink_to(path)
    for target in (path, tmp_path / "link.mcap"):
        with pytest.raises(InputError, match="give another name"):
            recover_recording(path, target)
    assert path.read_bytes() == whole.content


def test_a_failed_write_leaves_the_former_result(whole: Whole, tmp_path: Path) -> None:
    import resource

    path = damaged(tmp_path, whole.content)
    recovered_path(path).write_bytes(b"as before")
    limit = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2000, limit[1]))
    try:
        with pytest.raises(FailureError, match="could not be written: File too large"):
            recover_recording(path, recovered_path(path), force=True)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limit)
    assert recovered_path(path).read_bytes() == b"as before"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.mcap", "a.recovered.mcap"]


def test_recovering_what_was_recovered_changes_nothing_more(whole: Whole, tmp_path: Path) -> None:
    path = damaged(tmp_path, whole.content[: whole.data_end - 50])
    recovery, data = recovered(path)
    assert recovery.is_lossy
    again = recover_recording(recovered_path(path), tmp_path / "b.mcap")
    assert not again.is_lossy
    assert list(read_messages(tmp_path / "b.mcap")) == list(read_messages(recovered_path(path)))
    assert again.messages == len(data) + 1


@pytest.mark.parametrize(("cut", "code"), [(0, 0), (20_000, 3)])
def test_the_command_says_what_it_found(
    whole: Whole, tmp_path: Path, cut: int, code: int, capsys: pytest.CaptureFixture[str]
) -> None:
    path = damaged(tmp_path, whole.content[: len(whole.content) - cut])
    assert cli.main(["recover", str(path)]) == code
    out = capsys.readouterr().out
    assert out.startswith(f"{tmp_path}/a.recovered.mcap: ")
    assert out.count("\n") == 1
    assert cli.main(["recover", str(path), "-o", str(tmp_path / "c.mcap")]) == code
    assert (tmp_path / "c.mcap").exists()
    assert cli.main(["recover", str(path), "--set-aside", "--force"]) == code
    assert (tmp_path / "a.mcap.crashed").exists()
    assert not path.exists()
    out = capsys.readouterr().out
    assert out.splitlines()[-1].endswith(f"; {path} is renamed to {path}.crashed")
    assert cli.main(["recover", str(path)]) == 2
    assert cli.main(["recover", str(tmp_path / "c.mcap"), "-o", "/nowhere/at/all.mcap"]) == 2


def test_the_name_of_a_second_file_that_is_set_aside_is_printed(
    whole: Whole, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "a.mcap.crashed").write_bytes(b"as before")
    path = damaged(tmp_path, whole.content)
    assert cli.main(["recover", str(path), "--set-aside", "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed["recording"] == str(tmp_path / "a.recovered.mcap")
    assert printed["set_aside_as"] == f"{path}.crashed-2"
    assert (tmp_path / "a.mcap.crashed").read_bytes() == b"as before"


def test_the_command_as_a_process(whole: Whole, tmp_path: Path) -> None:
    path = damaged(tmp_path, whole.content[:-20_000])
    command = [sys.executable, "-m", "services", "recover", str(path), "--json"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 3, done.stderr
    assert '"lossy": true' in done.stdout
