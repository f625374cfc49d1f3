"""What a killed worker left in its folder is completed, or removed, by the next one."""

import logging
import os
from pathlib import Path

import pytest

from schemas.results import load_results
from services.ledger.cut_off_results import recover_cut_off_results
from services.ledger.runs import read_earlier
from services.recordings.recording import is_closed, read_messages
from services.recordings.writer import RecordingWriter
from tests.unit.ledger.test_runs import NOW_S, REALM, SEARCH, estimate, written

FIRST, SECOND = (f"results-2026010{day}T000000Z.mcap" for day in (1, 2))


@pytest.mark.parametrize("share", [1.0, 0.9])
@pytest.mark.parametrize("lived_s", [0.02, 61.0])
def test_a_recording_that_was_cut_off_gets_its_end(
    tmp_path: Path, share: float, lived_s: float, caplog: pytest.LogCaptureFixture
) -> None:
    """The next run, and all after it, take from it what they took from it cut off."""
    caplog.set_level(logging.INFO)
    first = written(tmp_path / FIRST, *(estimate(n) for n in range(6)))
    first.write_bytes(first.read_bytes()[: round(share * first.stat().st_size)])
    os.utime(first, (NOW_S, NOW_S))
    later = estimate(7, boot_id=2, time_s=NOW_S + lived_s)
    second = written(tmp_path / SECOND, later, previous=FIRST, began_s=NOW_S)
    there = [message.sequence for message in read_messages(first)]
    assert there
    as_it_was = read_earlier(tmp_path, REALM, NOW_S, SEARCH)
    caplog.clear()
    recover_cut_off_results(tmp_path)
    assert is_closed(first)
    assert is_closed(second)
    lines = [r.getMessage() for r in caplog.records if "its worker was killed" in r.getMessage()]
    assert [line.partition(":")[0] for line in lines] == [str(first), str(second)]
    # Nobody need fear for what was in work: it has no result, so it is identified again.
    assert all("without a result are identified again" in line for line in lines)
    assert not any("lost" in line for line in lines)
    assert [message.sequence for message in read_messages(first)] == there
    assert read_earlier(tmp_path, REALM, NOW_S, SEARCH) == as_it_was
    assert first.stat().st_mtime == NOW_S
    assert load_results(first.with_suffix(".json")).crossings[0].crossing_id == "t.b.0"
    assert sorted(p.name for p in tmp_path.glob("*.mcap")) == [FIRST, SECOND]
    caplog.clear()
    recover_cut_off_results(tmp_path)
    assert not caplog.records


def test_its_json_file_is_completed_after_that(tmp_path: Path) -> None:
    first = written(tmp_path / FIRST, estimate(0), estimate(1))
    recover_cut_off_results(tmp_path)
    os.utime(first, (NOW_S, NOW_S))
    read_earlier(tmp_path, REALM, NOW_S, SEARCH)
    found = load_results(first.with_suffix(".json")).crossings
    assert [crossing.crossing_id for crossing in found] == ["t.b.0", "t.b.1"]


def test_what_was_not_renamed_is_removed_and_nothing_else(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    gone = [
        ".results-20260101T000000Z.0123abcd.part.json",
        ".results-20260101T000000Z_2.0123abcd.part.json",
        ".results-20260101T000000Z.recovered.mcap",
        "..results-20260101T000000Z.recovered.0123abcd.part.mcap",
    ]
    stays = [
        ".worker.lock",
        ".results-mine.0123abcd.part.json",  # another program writes it now
        "results-20260101T000000Z.json",
        ".drive.0123abcd.part.mcap",
    ]
    for name in gone + stays:
        (tmp_path / name).write_text("{")
    recover_cut_off_results(tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(stays)
    assert sum("removed" in record.getMessage() for record in caplog.records) == len(gone)


@pytest.mark.parametrize("content", [b"", b"\x89MC", b"no recording at all"])
def test_one_without_anything_is_set_aside(tmp_path: Path, content: bytes) -> None:
    (tmp_path / FIRST).write_bytes(content)
    recover_cut_off_results(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == [f"{FIRST}.crashed"]
    assert (tmp_path / f"{FIRST}.crashed").read_bytes() == content


def test_one_without_a_message_is_set_aside(tmp_path: Path) -> None:
    """Its worker was killed after the site file was written; no reader expects such a recording."""
    writer = RecordingWriter(tmp_path / FIRST, reason="test")
    writer.sync()
    writer.abandon()
    recover_cut_off_results(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == [f"{FIRST}.crashed"]


def test_closed_files_and_those_of_a_living_writer_are_left_alone(tmp_path: Path) -> None:
    closed = written(tmp_path / FIRST, estimate(0), end=True)
    writer = RecordingWriter(tmp_path / SECOND, reason="test")
    writer.write(estimate(1))
    writer.sync()
    (tmp_path / "other.mcap").write_bytes(b"of another program")
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    recover_cut_off_results(tmp_path)
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before
    assert closed in before
    writer.abandon()


def test_a_folder_that_is_full_is_a_warning(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    first = written(tmp_path / FIRST, estimate(0))
    before = first.read_bytes()
    monkeypatch.setattr(Path, "replace", _full)
    recover_cut_off_results(tmp_path)
    assert "results of a killed worker stay cut off" in caplog.text
    assert first.read_bytes() == before


def _full(*_: object) -> None:
    raise OSError(28, "No space left on device")
