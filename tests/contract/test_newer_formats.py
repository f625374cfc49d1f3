"""Files of a newer program are refused in one line or read with a remark, and never deleted."""

import gzip
import json
import logging
import shutil
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest

from schemas import events, signals
from schemas.json_file import load_json
from schemas.proto import driveby_pb2 as pb
from schemas.results import load_results
from schemas.results_on_the_wire import estimate_to_crossing, state_to_bridge
from schemas.site_file import load_site
from schemas.validation_records import load_validation
from services.catalogue.index import read_catalog
from services.common.errors import InputError
from services.common.stores import folder_at
from services.execution.result_store import kept_results
from services.history.history_store import file_error
from services.history.sql import query
from services.history.watch_files import WatchRecord
from services.recordings.recording import read_info, read_messages
from services.recordings.writer import write_recording
from services.truck.spool import Spool

BEFORE = Path(__file__).parents[1] / "data" / "before" / "0.1.0"
NEWER = "9.0.0"


def one_line(read: Callable[[], object]) -> str:
    with pytest.raises((InputError, ValueError)) as caught:
        read()
    (line,) = str(caught.value).splitlines()
    return line


# JSON


def forged(path: Path, content: bytes, *place: str | int, **fields: object) -> Path:
    """Write a JSON file with more fields at a place, declared to be of a newer program."""
    found = json.loads(content)
    found["version"] = NEWER
    at: Any = found
    for key in place:
        at = at[key]
    at.update(fields)
    path.write_text(json.dumps(found))
    return path


@pytest.mark.parametrize("place", [(), ("crossings", 0), ("bridges", "bridge-1")])
def test_results_with_new_fields_name_their_writer(
    tmp_path: Path, place: tuple[str | int, ...]
) -> None:
    """A baseline is a file of results, too."""
    content = gzip.decompress((BEFORE / "pre-result.json.gz").read_bytes())
    path = forged(tmp_path / "results.json", content, *place, new_field=1)
    line = one_line(lambda: load_results(path))
    assert line.startswith(f"{path}: {'.'.join(map(str, (*place, 'new_field')))}: ")
    assert f"(written by driveby {NEWER}, this is " in line


def test_results_of_a_newer_program_without_new_fields_are_read(tmp_path: Path) -> None:
    content = gzip.decompress((BEFORE / "pre-result.json.gz").read_bytes())
    assert load_results(forged(tmp_path / "results.json", content)).version == NEWER


def test_remark_stays_away_from_damaged_files(tmp_path: Path) -> None:
    path = tmp_path / "results.json"
    for content in (b"", b"{", b"[]", b'{"program": "driveby", "version": 9}', b"\xff"):
        path.write_bytes(content)
        assert "written by" not in one_line(lambda: load_results(path))


def test_validation_record_with_new_fields_names_its_writer(tmp_path: Path) -> None:
    (old,) = BEFORE.glob("certificates/*.json")
    path = forged(tmp_path / old.name, old.read_bytes(), new_field=1)
    line = one_line(lambda: load_validation(path))
    assert "new_field: is unknown here, read the file with the version of driveby that" in line
    assert f"wrote it (written by driveby {NEWER}" in line


def test_check_of_alarms_of_another_edition_is_refused(tmp_path: Path) -> None:
    old = next(BEFORE.glob("history/alarms/checks/*/*.json"))
    path = forged(tmp_path / "bridge.json", old.read_bytes(), edition=2)
    assert ": edition: " in one_line(lambda: load_json(WatchRecord, path, "a check of alarms"))


def test_site_file_with_a_new_key_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "site.toml"
    path.write_text((BEFORE / "paper.toml").read_text() + "\n[newer]\nkey = 1\n")
    assert "newer" in one_line(lambda: load_site(path))


# Parquet


def of_edition_2(path: Path, to: Path) -> Path:
    """Copy a Parquet file with another format version in its metadata."""
    table = pq.ParquetFile(path).read()
    (name,) = (key for key in pq.ParquetFile(path).metadata.metadata if b"driveby" in key)
    to.parent.mkdir(parents=True, exist_ok=True)
    with pq.ParquetWriter(to, table.schema, store_schema=False) as writer:
        writer.add_key_value_metadata({name.decode(): "2"})
        writer.write_table(table)
    return to


def test_history_of_another_edition_is_left_out_by_name(tmp_path: Path) -> None:
    old = next(BEFORE.glob("history/crossings/*/*/*.parquet"))
    path = of_edition_2(old, tmp_path / old.relative_to(BEFORE / "history"))
    line = file_error(path)
    assert line is not None
    assert line.startswith(f"{path}: left out: is of format version 2 of ")
    assert " format version than 1 of " in one_line(
        lambda: query(tmp_path, "SELECT crossing_id FROM crossings")
    )
    assert path.is_file()


def test_stored_results_of_another_edition_are_left_out_by_name(tmp_path: Path) -> None:
    old = next(BEFORE.glob("into/*.parquet"))
    path = of_edition_2(old, tmp_path / old.name)
    shutil.copy(BEFORE / "into" / "bridges.json", tmp_path)
    problems: list[str] = []
    assert list(kept_results(tmp_path, problems.append)) == []
    (line,) = problems
    assert line.startswith(f"{path}: left out: is of format version 2 of ")
    assert path.is_file()


def test_catalogue_of_another_edition_is_left_out_and_stays(tmp_path: Path) -> None:
    folder = tmp_path / "drives"
    shutil.copytree(BEFORE / "drives", folder)
    (old,) = folder.rglob("*.parquet")
    of_edition_2(old, old)
    found = read_catalog(folder_at(str(folder)))
    assert not found.rows
    (line,) = found.problems
    assert "left out: is of format version 2 of " in line
    assert old.is_file()


# MCAP, spool, wire


def test_recording_in_another_format_is_read_with_a_remark(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    messages = list(read_messages(BEFORE / "drive.mcap"))
    monkeypatch.setattr("services.recordings.writer.FORMAT", "2")
    monkeypatch.setattr("services.recordings.writer.program_version", lambda: NEWER)
    path = tmp_path / "newer.mcap"
    write_recording(path, messages, reason="test", site_toml=None)
    remarks: list[str] = []
    assert list(read_messages(path, warn=remarks.append)) == messages
    assert remarks[0] == (
        f"{path}: is in format 2 of driveby {NEWER}, this program knows format 1 and may misread it"
    )
    with caplog.at_level(logging.WARNING):
        assert read_info(path).messages
    assert "is in format 2" in caplog.text


def test_spool_of_another_format_is_refused_and_stays(tmp_path: Path) -> None:
    spool = Spool(tmp_path)
    spool.append("accel", 0, b"payload")
    spool.sync()
    spool.close()
    (path,) = tmp_path.glob("*.spool")
    content = path.read_bytes()
    magic, boot = b"DBSPOOL2", content[8:16]
    newer = magic + boot + zlib.crc32(magic + boot).to_bytes(4, "big") + content[20:]
    path.write_bytes(newer)
    for _ in range(2):  # the lock was released
        line = one_line(lambda: Spool(tmp_path))
        assert line == (f"{path}: is of spool format b'DBSPOOL2', this program knows b'DBSPOOL1'")
    assert path.read_bytes() == newer
    path.write_bytes(content)
    reopened = Spool(tmp_path)
    assert reopened.discarded_bytes == 0
    reopened.close()


def test_messages_of_another_version_are_refused() -> None:
    stored = json.loads(gzip.decompress((BEFORE / "messages.json.gz").read_bytes()))
    decoders: dict[str, Callable[[bytes], object]] = {
        "AccelBatch": signals.decode_accel,
        "GnssFix": signals.decode_gnss,
        "VehicleInfo": signals.decode_info,
        "Event": events.decode_event,
    }
    for name, decode in decoders.items():
        message = getattr(pb, name).FromString(bytes.fromhex(stored[name]["payload"]))
        message.schema_version = 2
        payload = message.SerializeToString()
        with pytest.raises(ValueError, match="schema version 2"):
            decode(payload)
    with pytest.raises(ValueError, match="schema version 2"):
        estimate_to_crossing(pb.Estimate(schema_version=2))
    with pytest.raises(ValueError, match="schema version 2"):
        state_to_bridge(pb.BridgeState(schema_version=2))
