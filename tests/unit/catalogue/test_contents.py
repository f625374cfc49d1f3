"""What a recording holds, against recordings of which that is known."""

import shutil
from collections.abc import Iterable, Iterator
from pathlib import Path

import pytest

from schemas.signals import decode_accel, encode_accel
from schemas.site_file import load_site
from schemas.topics import Key, Message
from services.catalogue.contents import Gap, summarise_recording
from services.catalogue.index import update_catalog
from services.common.errors import InputError
from services.common.stores import folder_at
from services.drives.importing import import_command
from services.drives.settings import ImportOptions
from services.finding.stays import Passage
from services.recordings.writer import write_recording
from tests.unit.drives.recorded import START_NS, S, drive


def test_trucks_times_rates_and_gaps(tmp_path: Path) -> None:
    path = tmp_path / "r.mcap"
    both = [*drive(leave_out=range(100, 130)), *drive("truck-2", leave_out=range(50, 55))]
    write_recording(path, both, site_toml=None, reason="test")
    found = summarise_recording(path)
    first, second = found.trucks
    assert (first.vehicle, second.vehicle) == ("truck-1", "truck-2")
    assert first.streams["accel"] == (170, 30, pytest.approx(20.0))
    assert first.streams["gnss"] == (100, 0, pytest.approx(10.0))
    assert first.channel_rates_hz == {"sprung_front": 1000.0}
    assert (first.first_ns, first.last_ns) == (START_NS, START_NS + 9_950_000_000)
    # A quarter of a second is no silence, but a gap in the samples.
    assert second.streams["accel"].missing == 5
    assert first.sample_gaps == (1, pytest.approx(1.5), pytest.approx(1.5))
    assert second.sample_gaps == (1, pytest.approx(0.25), pytest.approx(0.25))
    begin_ns = START_NS + 99 * 50_000_000
    assert found.gaps == (Gap("truck-1", "accel", begin_ns, begin_ns + 31 * 50_000_000),)
    assert (found.site, found.site_error, found.passings) == (None, None, ())


def test_between_two_boots_a_truck_was_off(tmp_path: Path) -> None:
    path = tmp_path / "r.mcap"
    both = [*drive(), *drive(boot_id=8, begin_s=3600.0)]
    write_recording(path, both, site_toml=None, reason="test")
    found = summarise_recording(path)
    assert found.gaps == ()
    assert found.trucks[0].sample_gaps == (0, 0.0, 0.0)
    assert found.trucks[0].boots == 2
    assert found.trucks[0].streams["accel"] == (400, 0, pytest.approx(20.0))


def as_one_boot(later: Iterable[Message]) -> Iterator[Message]:
    """Yield the messages of a second drive an hour later as of the first one's boot."""
    for message in later:
        number = message.sequence + (200 if message.key.stream == "accel" else 100)
        payload = message.payload
        if message.key.stream == "accel":
            batch = decode_accel(payload)
            device_time_ns = batch.device_time_ns + 3600 * S
            payload = encode_accel(batch._replace(sequence=number, device_time_ns=device_time_ns))
        yield message._replace(payload=payload, sequence=number)


@pytest.mark.parametrize("lost", [range(0), range(195, 200)])
def test_pause_of_a_truck_without_lost_messages_is_no_gap(tmp_path: Path, lost: range) -> None:
    """Drives that `driveby truck` publishes as one boot, with or without --skip-gaps."""
    path = tmp_path / "r.mcap"
    both = [*drive(leave_out=lost), *as_one_boot(drive(begin_s=3600.0))]
    write_recording(path, both, site_toml=None, reason="test")
    found = summarise_recording(path)
    (row,) = update_catalog(folder_at(str(tmp_path))).rows.values()
    assert found.trucks[0].streams["accel"].missing == len(lost)
    assert [gap.stream for gap in found.gaps] == ["accel"] * bool(lost)
    assert found.trucks[0].sample_gaps.number == bool(lost)
    assert row.gaps == bool(lost)


def test_silence_of_one_stream_without_lost_messages_is_a_gap(tmp_path: Path) -> None:
    path = tmp_path / "r.mcap"
    silent = [*drive(leave_out=range(100, 200))]
    rest = [m for m in drive(begin_s=5.0, leave_out=range(30)) if m.key.stream == "accel"]
    rest = [m._replace(sequence=m.sequence + 70) for m in rest]
    write_recording(path, [*silent, *rest], site_toml=None, reason="test")
    found = summarise_recording(path)
    assert found.trucks[0].streams["accel"].missing == 0
    assert [gap.stream for gap in found.gaps] == ["accel"]


def test_gap_between_batches_in_sequence_is_counted(tmp_path: Path, csv_example: Path) -> None:
    folder = tmp_path / "drive"
    folder.mkdir()
    lines = (csv_example / "accel_00.csv").read_text().splitlines(keepends=True)
    (folder / "accel_00.csv").write_text("".join(lines[:200] + lines[230:]))
    shutil.copy(csv_example / "gps_00.csv", folder)
    path = tmp_path / "r.mcap"
    import_command(ImportOptions(sources=(folder,), site=csv_example / "site.toml"), path)
    (truck,) = summarise_recording(path).trucks
    assert truck.streams["accel"].missing == 0
    assert truck.sample_gaps == (1, pytest.approx(0.3), pytest.approx(0.3))


def test_crossings_are_those_that_are_identified(
    tmp_path: Path, project: Path, csv_example: Path
) -> None:
    """The sample has one crossing, whose entry the identification publishes (docs/contract.md)."""
    found = summarise_recording(project / "recordings/sample/crossing.mcap")
    (passing,) = found.passings
    assert (passing.vehicle, passing.bridge, passing.forward) == ("truck-1", "bridge-1", True)
    assert passing.passage is Passage.THROUGH
    assert passing.entry_ns / S == pytest.approx(1_767_225_602.644, abs=0.3)
    # In the site file of another place there is no such bridge.
    elsewhere = load_site(csv_example / "site.toml")
    assert (
        summarise_recording(project / "recordings/sample/crossing.mcap", elsewhere).passings == ()
    )
    path = tmp_path / "example.mcap"
    import_command(ImportOptions(sources=(csv_example,), site=csv_example / "site.toml"), path)
    assert [p.bridge for p in summarise_recording(path).passings] == [elsewhere.bridges[0].id]


def test_unusable_site_file_is_reported_without_crossings(tmp_path: Path) -> None:
    path = tmp_path / "r.mcap"
    write_recording(path, drive(), site_toml="[bridge]\n", reason="test")
    found = summarise_recording(path)
    assert found.site is None
    assert found.site_error is not None
    assert found.site_error.startswith(f"{path}: site.toml: ")


def test_what_cannot_be_decoded_is_counted_and_says_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "r.mcap"
    where = Key("live", "vehicle", "truck-1", "gnss")
    broken = Message(where, b"\xff\xff", 7, 100, START_NS + 10 * S, START_NS)
    write_recording(path, [*drive(), broken], site_toml=None, reason="test")
    assert summarise_recording(path).trucks[0].streams["gnss"].messages == 101
    with pytest.raises(InputError, match="no such file"):
        summarise_recording(tmp_path / "none.mcap")
