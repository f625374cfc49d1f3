"""Results in a folder: read as they were written, whatever becomes of other files there."""

import os
import struct
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import zstandard

from schemas.results import ResultHeader
from schemas.results import results as results_file
from services.common.errors import InputError
from services.common.parquet_files import ReadLimits, encoded
from services.execution import result_store as store_module
from services.execution.result_store import (
    BRIDGES,
    FORMAT_VERSION,
    KEY,
    ResultStore,
    StoredResult,
    kept_results,
)
from tests.unit.identification.test_fusing import crossing

HEADER = ResultHeader("0.1.0", 1.79e9, "hash", {"method": "pre"}, 1)


def results(number: int) -> list[StoredResult]:
    return [StoredResult(f"content-{n}", crossing(n)) for n in range(number)]


def test_what_was_put_is_there_to_the_last_bit(tmp_path: Path) -> None:
    found = results(5)
    kept = ResultStore(tmp_path / "new" / "folder")
    kept.put(found[:2], HEADER)
    kept.put(found[2:], HEADER)
    assert kept.put([], HEADER) is None
    for one in (kept, ResultStore(tmp_path / "new" / "folder")):
        assert len(one) == 5
        assert [one.result(content) for content, _ in found] == [c for _, c in found]
        assert one.result("another") is None
        assert list(one.problems) == []


def test_the_same_results_are_the_same_file(tmp_path: Path) -> None:
    found = results(3)
    first = ResultStore(tmp_path).put(found, HEADER)
    assert ResultStore(tmp_path).put(reversed(found), HEADER) == first
    assert list(tmp_path.iterdir()) == [first]


@pytest.mark.parametrize("how", ["cut", "other"])
def test_a_damaged_file_is_a_line_and_costs_itself_only(tmp_path: Path, how: str) -> None:
    first, second = results(2)
    kept = ResultStore(tmp_path)
    path = kept.put([first], HEADER)
    kept.put([second], HEADER)
    assert path is not None
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2] if how == "cut" else b"something else")
    again = ResultStore(tmp_path)
    assert again.result(first.content) is None
    assert len(again.problems) == 1
    assert str(path) in again.problems[0]
    assert again.result(second.content) == second.crossing
    again.put([first], HEADER)  # it is made again, in the place of the damaged one
    assert ResultStore(tmp_path).result(first.content) == first.crossing
    assert ResultStore(tmp_path).problems == []


def test_a_result_that_cannot_be_read_is_a_line_and_no_result(tmp_path: Path) -> None:
    first = results(1)[0]
    path = ResultStore(tmp_path).put([first], HEADER)
    assert path is not None
    content = path.read_bytes()
    at = content.index(b"\x28\xb5\x2f\xfd") + 40  # in the middle of what zstd has made
    path.write_bytes(content[:at] + bytes(64) + content[at + 64 :])
    kept = ResultStore(tmp_path)
    assert kept.result(first.content) is None
    assert kept.result(first.content) is None
    assert len(kept.problems) == 1
    assert f"{path}: row 1: left out" in kept.problems[0]


@pytest.mark.parametrize("change", [{"header": None}, {"header": b"x"}, {"result": None}])
def test_what_others_cannot_read_is_no_result_either(
    tmp_path: Path, change: dict[str, object]
) -> None:
    """Else it would be known from before for ever, and never be in a history."""
    first, second = results(2)
    path = ResultStore(tmp_path).put([first, second], HEADER)
    assert path is not None
    outcome = pq.read_table(path).to_pylist()
    outcome[1] |= change
    path.write_bytes(encoded(pa.Table.from_pylist(outcome), KEY, FORMAT_VERSION))
    kept, problems = ResultStore(tmp_path), list[str]()
    assert kept.result(first.content) == first.crossing
    assert kept.result(second.content) is None
    assert len(kept.problems) == 1
    assert f"{path}: row 2: left out: " in kept.problems[0]
    found = [c for some in kept_results(tmp_path, problems.append) for c in some.crossings]
    assert found == [first.crossing]
    assert kept.problems[0] in problems
    kept.put([second], HEADER)
    assert ResultStore(tmp_path).result(second.content) == second.crossing


def test_what_a_writer_that_was_killed_has_left_is_no_file(tmp_path: Path) -> None:
    first, second = results(2)
    path = ResultStore(tmp_path).put([first], HEADER)
    assert path is not None
    (tmp_path / f".{path.stem}.0123abcd.part.parquet").write_bytes(path.read_bytes()[:100])
    kept = ResultStore(tmp_path)
    assert (len(kept), kept.problems) == (1, [])
    assert kept.result(second.content) is None


def test_where_nothing_can_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="file"):
        ResultStore(tmp_path / "file")


def foreign(**columns: Any) -> bytes:
    return encoded(pa.table(columns), KEY, FORMAT_VERSION)


@pytest.mark.parametrize(
    "columns",
    [
        {"content": [1, 2]},
        {"content": [["a"], ["b"]]},
        {"content": ["a"], "crossing_id": [1], "realm": [2], "header": [3], "result": [4]},
        {"other": ["a"]},
    ],
)
def test_a_table_of_another_kind_is_a_line_and_harms_nobody(
    tmp_path: Path, columns: dict[str, Any]
) -> None:
    (first,) = results(1)
    ResultStore(tmp_path).put([first], HEADER)
    (tmp_path / "foreign.parquet").write_bytes(foreign(**columns))
    kept = ResultStore(tmp_path)
    assert list(kept.crossings()) == [first.crossing]
    problems: list[str] = []
    (file,) = kept_results(tmp_path, problems.append)
    assert file.crossings == (first.crossing,)
    for lines in (kept.problems, problems):
        (line,) = [line for line in lines if BRIDGES not in line]
        assert line.startswith(f"{tmp_path / 'foreign.parquet'}: ")
        assert "\n" not in line


def test_what_is_no_file_is_a_line(tmp_path: Path) -> None:
    """A pipe would be waited for without end."""
    (first,) = results(1)
    path = ResultStore(tmp_path).put([first], HEADER)
    os.mkfifo(tmp_path / "pipe.parquet")
    (tmp_path / "folder.parquet").mkdir()
    (tmp_path / "circle.parquet").symlink_to(tmp_path / "circle.parquet")
    kept = ResultStore(tmp_path)
    assert list(kept.crossings()) == [first.crossing]
    assert len(kept.problems) == 3
    assert str(path) not in "".join(kept.problems)


def test_what_a_link_leads_to_is_not_written_to(tmp_path: Path) -> None:
    (first,) = results(1)
    path = ResultStore(tmp_path / "one").put([first], HEADER)
    assert path is not None
    other = tmp_path / "other"
    other.write_text("somebody else's")
    path.unlink()
    path.symlink_to(other)
    ResultStore(tmp_path / "one").put([first], HEADER)
    assert other.read_text() == "somebody else's"
    assert not path.is_symlink()


def test_what_says_that_it_is_huge_is_a_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A result of 2⁴⁰ bytes in twenty; more rows than there may be."""
    # The header of a frame: magic, what follows, the window, the size.
    frame = struct.pack("<IBBQ", 0xFD2FB528, 0b1100_0000, 0, 1 << 40)
    head = zstandard.compress(results_file(HEADER, [], {}).model_dump_json().encode())
    content = foreign(
        content=["a"],
        header=pa.array([head], pa.binary()),
        result=pa.array([frame], pa.binary()),
    )
    (tmp_path / "bomb.parquet").write_bytes(content)
    kept = ResultStore(tmp_path)
    assert kept.result("a") is None
    assert kept.problems == [
        f"{tmp_path / 'bomb.parquet'}: row 1: left out: {1 << 40} bytes are no result"
    ]
    monkeypatch.setattr(store_module, "_MOST", ReadLimits(1, 1 << 20))
    found = results(3)
    path = ResultStore(tmp_path).put(found, HEADER)
    again = ResultStore(tmp_path)
    assert again.result(found[0].content) is None
    assert any(line.startswith(f"{path}: left out: holds 3 rows of") for line in again.problems)


def test_of_two_results_of_one_crossing_by_one_search_the_newer_one_counts(
    tmp_path: Path,
) -> None:
    """Its recording was cut off, and then made whole: the same crossing, from other data."""
    for name, wanted in (("a", "b"), ("b", "a")):  # whichever comes first in the folder
        folder = tmp_path / name
        old, new = crossing(0), crossing(0).model_copy(update={"speed_m_per_s": 9.0})
        ResultStore(folder).put([StoredResult(name, old)], HEADER)
        ResultStore(folder).put(
            [StoredResult(wanted, new)], HEADER._replace(created=HEADER.created + 60.0)
        )
        problems: list[str] = []
        found = [c for file in kept_results(folder, problems.append) for c in file.crossings]
        assert found == [new]
