"""`python -m tests.same` can fail: every kind of file is compared, only the listed exempt."""

import json
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
import rerun as rr
from pyarrow import parquet

from schemas.proto import driveby_pb2 as pb
from schemas.topics import Key, Message
from services.recordings.writer import write_recording
from tests.same.__main__ import FAILED, compared
from tests.same.canonical import name_of
from tests.same.parts import PARTS

RUN_NS = 1_795_428_582_129_818_413
DRIVEN_NS = 1_767_225_600_000_000_000


def put(path: Path, kind: str, value: float, *, created: int = 0) -> Path:
    """Write a file of a kind that holds a number, and the moment at which it was made."""
    match kind:
        case "results.json":
            text = {"version": f"0.{created}", "created": created + 0.5, "mean": value}
            (path / kind).write_text(json.dumps(text, indent=1))
        case "printed.out":
            (path / kind).write_text(f"EI {value}\n{created + 0.5} s\n")
        case "picture.svg":
            (path / kind).write_text(f"<svg><path d='{value}'/></svg>")
        case "page.html":
            (path / kind).write_text(f"<p>{value}</p><p>driveby 0.{created}.0</p>")
        case "picture.png":
            (path / kind).write_bytes(b"\x89PNG\xff" + np.float64(value).tobytes())
        case "rows.parquet":
            table = pa.table({"ei": [value], "read": [f"at {RUN_NS + created}"]})
            parquet.write_table(table, path / kind)
        case "draws.npz":
            np.savez(path / kind, ei=np.array([value]))
        case "view.rrd":
            stream = rr.RecordingStream("same", recording_id=f"r{created}")
            stream.save(path / kind)
            stream.set_time("drive", duration=1.0)
            stream.log("ei", rr.Scalars(value))
            stream.disconnect()
        case "worker.mcap":
            estimate = pb.Estimate(crossing_id="x", created_ns=RUN_NS + created)
            estimate.speed_m_per_s = value
            key = Key("sim-a", "bridge", "bridge-1", "estimate")
            boot = RUN_NS + created
            message = Message(key, estimate.SerializeToString(), boot, 0, boot, boot)
            write_recording(path / kind, [message], site_toml=None, reason="test")
        case "messages.jsonl":
            payload = pb.Estimate(crossing_id="x", speed_m_per_s=value).SerializeToString()
            line = {"after": 1, "key": "a/bridge/b/estimate", "payload": payload.hex()}
            (path / kind).write_text(json.dumps(line | {"result": None}) + "\n")
    return path


KINDS = (
    *("results.json", "printed.out", "picture.svg", "page.html", "picture.png", "rows.parquet"),
    *("draws.npz", "worker.mcap", "messages.jsonl", "view.rrd"),
)


@pytest.fixture
def folders(tmp_path: Path) -> tuple[Path, Path]:
    for name in ("before", "after"):
        (tmp_path / name).mkdir()
    return tmp_path / "before", tmp_path / "after"


@pytest.mark.parametrize("kind", KINDS)
def test_another_last_digit_is_a_difference(kind: str, folders: tuple[Path, Path]) -> None:
    before, after = folders
    put(before, kind, 1.0)
    number, found = compared(before, put(after, kind, np.nextafter(1.0, 2.0)))
    assert number == 1
    assert [one.name for one in found] == [kind]
    assert found[0].excerpt


@pytest.mark.parametrize("kind", KINDS)
def test_version_and_time_of_writing_are_none(kind: str, folders: tuple[Path, Path]) -> None:
    before, after = folders
    put(before, kind, 1.0)
    assert compared(before, put(after, kind, 1.0, created=7)) == (1, [])


def test_another_time_of_a_drive_is_a_difference(folders: tuple[Path, Path]) -> None:
    for folder, time_ns in zip(folders, (DRIVEN_NS, DRIVEN_NS + 1), strict=True):
        (folder / "a.json").write_text(json.dumps({"time_ns": time_ns}))
    _, (found,) = compared(*folders)
    assert found.excerpt[1:] == [f'-{{"time_ns": {DRIVEN_NS}}}', f'+{{"time_ns": {DRIVEN_NS + 1}}}']


def test_a_file_of_one_tree_alone_is_a_difference(folders: tuple[Path, Path]) -> None:
    before, after = folders
    put(before, "results.json", 1.0)
    put(after, "printed.out", 1.0)
    number, found = compared(before, after)
    assert number == 2
    assert found == [
        ("printed.out", ["only in the working tree"]),
        ("results.json", ["only in the revision"]),
    ]


def test_two_trees_that_both_fail_are_not_the_same(folders: tuple[Path, Path]) -> None:
    for folder in folders:
        (folder / FAILED).write_text("no worker\n")
    assert [one.excerpt for one in compared(*folders)[1]] == [["no worker"], ["no worker"]]


def test_the_first_differing_byte_is_named(folders: tuple[Path, Path]) -> None:
    for folder, end in zip(folders, (b"ab", b"ac"), strict=True):
        (folder / "a.bin").write_bytes(b"\xff" + end)
    _, (found,) = compared(*folders)
    assert found.excerpt == ["byte 2 of 3 and 3 is the first that differs"]


def test_names_of_files_are_compared_but_for_the_clock() -> None:
    assert name_of(Path("a/results-20260101T000000Z.mcap")) == "a/results-TIME.mcap"
    assert name_of(Path("a/0123abcd.parquet")) == "a/0123abcd.parquet"


def test_every_method_is_compared_on_three_recordings() -> None:
    for method in ("pre", "least-squares", "random-walk"):
        for recording in ("sample", "exact", "many"):
            names = {f"{what}-{method}-{recording}" for what in ("identify", "engine")}
            assert names & PARTS.keys()
