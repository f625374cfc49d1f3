"""Results in a folder: read as they were written, whatever becomes of other files there."""

from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from schemas.results import Header
from services.common.errors import InputError
from services.common.parquet_files import encoded
from services.execution import kept as kept_module
from services.execution.kept import Kept, Result, kept_results
from tests.unit.identification.test_fusing import crossing

HEADER = Header("0.1.0", 1.79e9, "hash", {"method": "pre"}, 1)


def results(number: int) -> list[Result]:
    return [Result(f"content-{n}", crossing(n)) for n in range(number)]


def test_what_was_put_is_there_to_the_last_bit(tmp_path: Path) -> None:
    found = results(5)
    kept = Kept(tmp_path / "new" / "folder")
    kept.put(found[:2], HEADER)
    kept.put(found[2:], HEADER)
    assert kept.put([], HEADER) is None
    for one in (kept, Kept(tmp_path / "new" / "folder")):
        assert len(one) == 5
        assert [one.result(content) for content, _ in found] == [c for _, c in found]
        assert one.result("another") is None
        assert list(one.problems) == []


def test_the_same_results_are_the_same_file(tmp_path: Path) -> None:
    found = results(3)
    first = Kept(tmp_path).put(found, HEADER)
    assert Kept(tmp_path).put(reversed(found), HEADER) == first
    assert list(tmp_path.iterdir()) == [first]


@pytest.mark.parametrize("how", ["cut", "other"])
def test_a_damaged_file_is_a_line_and_costs_itself_only(tmp_path: Path, how: str) -> None:
    first, second = results(2)
    kept = Kept(tmp_path)
    path = kept.put([first], HEADER)
    kept.put([second], HEADER)
    assert path is not None
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2] if how == "cut" else b"something else")
    again = Kept(tmp_path)
    assert again.result(first.content) is None
    assert len(again.problems) == 1
    assert str(path) in again.problems[0]
    assert again.result(second.content) == second.crossing
    again.put([first], HEADER)  # it is made again, in the place of the damaged one
    assert Kept(tmp_path).result(first.content) == first.crossing
    assert Kept(tmp_path).problems == []


def test_a_result_that_cannot_be_read_is_a_line_and_no_result(tmp_path: Path) -> None:
    first = results(1)[0]
    path = Kept(tmp_path).put([first], HEADER)
    assert path is not None
    content = path.read_bytes()
    at = content.index(b"\x28\xb5\x2f\xfd") + 40  # in the middle of what zstd has made
    path.write_bytes(content[:at] + bytes(64) + content[at + 64 :])
    kept = Kept(tmp_path)
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
    path = Kept(tmp_path).put([first, second], HEADER)
    assert path is not None
    told = pq.read_table(path).to_pylist()
    told[1] |= change
    path.write_bytes(encoded(pa.Table.from_pylist(told), kept_module.KEY, kept_module.EDITION))
    kept, problems = Kept(tmp_path), list[str]()
    assert kept.result(first.content) == first.crossing
    assert kept.result(second.content) is None
    assert len(kept.problems) == 1
    assert f"{path}: row 2: left out: " in kept.problems[0]
    found = [c for some in kept_results(tmp_path, problems.append) for c in some.crossings]
    assert found == [first.crossing]
    assert kept.problems[0] in problems
    kept.put([second], HEADER)
    assert Kept(tmp_path).result(second.content) == second.crossing


def test_what_a_writer_that_was_killed_has_left_is_no_file(tmp_path: Path) -> None:
    first, second = results(2)
    path = Kept(tmp_path).put([first], HEADER)
    assert path is not None
    (tmp_path / f".{path.stem}.0123abcd.part.parquet").write_bytes(path.read_bytes()[:100])
    kept = Kept(tmp_path)
    assert (len(kept), kept.problems) == (1, [])
    assert kept.result(second.content) is None


def test_where_nothing_can_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="file"):
        Kept(tmp_path / "file")
