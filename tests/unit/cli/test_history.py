"""`driveby history add` of a folder that `driveby identify --into` keeps."""

from pathlib import Path

import pytest

from schemas.results import (
    BridgeResult,
    CrossingResult,
    ResultHeader,
    Results,
    RoadMismatch,
    RoadResult,
    Track,
    results,
    results_json,
)
from services.cli import main as cli
from services.cli.parsing import EXIT_SOMETHING_LOST
from services.common.files import make_folder, write_atomically
from services.execution import result_store as store_module
from services.execution.result_store import BRIDGES, ResultStore, StoredResult, kept_results
from services.history.alarm_files import alarms_folder
from services.history.history_store import partition, read_partition
from services.identification.bridge_state import with_common_shares
from services.identification.known import search_hash
from tests.fleet import DAY_S
from tests.unit.history.test_bridge_history import alarm
from tests.unit.history.test_history_store import BEGIN_S, crossings

HEADER = ResultHeader("0.1.0", BEGIN_S + 50 * DAY_S, "1" * 64, {"method": "pre"}, 7)
ENDED = HEADER._replace(created=BEGIN_S + 60 * DAY_S)
"""Of the run that ended last."""


@pytest.fixture
def found() -> list[CrossingResult]:
    """Four crossings of one truck, on roads that differ under the axles."""
    mismatch = RoadMismatch(A_m3=1e-6, n_0_per_m=0.1)
    flat = (0.0, 0.0)
    road = RoadResult(x_m=(0.0, 1.0), front_m=flat, rear_m=flat, mean_m=flat, mismatch=mismatch)
    return [one.model_copy(update={"road": road}) for one in crossings(4).crossings]


@pytest.fixture
def into(tmp_path: Path, found: list[CrossingResult]) -> Path:
    """Two files of two runs, one crossing in both, as after a client that was killed."""
    folder = tmp_path / "identified"
    rows = [StoredResult(f"content-{n}", one) for n, one in enumerate(found)]
    kept = ResultStore(folder)
    kept.put(rows[:2], HEADER)
    kept.put(rows[1:], HEADER._replace(created=HEADER.created + 60.0))
    (folder / BRIDGES).write_text(results_json(results(ENDED, [], bridges(found))))
    return folder


def bridges(found: list[CrossingResult]) -> dict[str, BridgeResult]:
    track = Track(vehicle=found[0].vehicle, direction=found[0].direction, common_share=0.4)
    return {"bridge-1": BridgeResult(tracks=(track,))}


def add(what: Path, folder: Path) -> int:
    return cli.main(["history", "add", str(what), "--history", str(folder / "history"), "--later"])


def test_a_folder_is_added_once_and_is_what_its_json_is(
    tmp_path: Path, into: Path, found: list[CrossingResult], capsys: pytest.CaptureFixture[str]
) -> None:
    as_json = tmp_path / "all.json"
    shared = with_common_shares(found, bridges(found))
    assert shared != found
    as_json.write_text(results_json(results(ENDED, shared, bridges(found))))
    assert add(into, tmp_path) == 0
    assert add(into, tmp_path) == 0
    assert add(as_json, tmp_path) == 0
    assert capsys.readouterr().out.splitlines() == [
        f"{into}: 4 crossings of bridge-1 added",
        f"{into}: 0 crossings added, 4 there already",
        f"{as_json}: 0 crossings added, 4 there already",
    ]
    rows = read_partition(partition(tmp_path / "history", "sim-fleet", "bridge-1")).crossings
    assert [one.crossing_id for one in rows] == [one.crossing_id for one in found]
    assert {(one.created_s, one.search_hash) for one in rows} == {
        (ENDED.created, search_hash(HEADER))
    }


def test_each_file_that_cannot_be_read_is_one_line(
    tmp_path: Path, into: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (into / "0.parquet").write_bytes(b"no rows")
    torn = the_larger_of(into)  # three crossings; the other file has one of them, too
    torn.write_bytes(torn.read_bytes()[:200])
    (into / BRIDGES).unlink()
    assert add(into, tmp_path) == EXIT_SOMETHING_LOST
    first, *lines = capsys.readouterr().out.splitlines()
    assert first == f"{into}: 2 crossings of bridge-1 added"
    for path in (into / "0.parquet", torn, into / BRIDGES):
        assert sum(one.startswith(f"{path}: ") for one in lines) == 1
    assert len(lines) == 3


def the_larger_of(into: Path) -> Path:
    return max(into.glob("*.parquet"), key=lambda one: one.stat().st_size)


def test_results_of_another_search_keep_their_own_head(
    into: Path, found: list[CrossingResult], monkeypatch: pytest.MonkeyPatch
) -> None:
    other = HEADER._replace(seed=8, created=BEGIN_S)
    ResultStore(into).put([StoredResult("other", found[0])], other)
    monkeypatch.setattr(store_module, "_MAX_AT_ONCE", 2)
    problems: list[str] = []
    files: list[Results] = list(kept_results(into, problems.append))
    assert problems == []
    assert max(len(one.crossings) for one in files) == 2
    (alone,) = [one for one in files if one.seed == 8]
    assert (alone.created, alone.crossings) == (other.created, (found[0],))
    rest = [crossing for one in files if one.seed == 7 for crossing in one.crossings]
    assert sorted(one.crossing_id for one in rest) == sorted(one.crossing_id for one in found)
    assert {one.created for one in files if one.seed == 7} == {ENDED.created}


def test_a_folder_without_results_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert add(tmp_path, tmp_path) == 2
    output = capsys.readouterr().err
    assert output.count("\n") == 1
    assert f"{tmp_path}: has no results; HASH.parquet of driveby identify --into" in output
    assert "results-TIME.json of driveby worker (in FOLDER/REALM) are expected" in output
    assert not (tmp_path / "history").exists()


def test_folder_of_workers_is_added(
    tmp_path: Path, found: list[CrossingResult], capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "recordings" / "live"
    (folder / "2026-08-27").mkdir(parents=True)
    for number, some in enumerate((found[:1], found[1:])):
        path = folder / f"results-20260827T10000{number}Z.json"
        path.write_text(results_json(results(HEADER, some, {})))
    assert add(folder, tmp_path) == 0
    torn = folder / "results-20260827T110000Z.json"
    torn.write_text("{")
    assert add(folder, tmp_path) == EXIT_SOMETHING_LOST
    first, again, line = capsys.readouterr().out.splitlines()
    assert first == f"{folder}: 4 crossings of bridge-1 added"
    assert again == f"{folder}: 0 crossings added, 4 there already"
    assert line.startswith(f"{torn}: ")


@pytest.mark.parametrize("is_newer_first", [False, True])
def test_add_counts_a_crossing_of_two_site_files_once(
    tmp_path: Path,
    found: list[CrossingResult],
    is_newer_first: bool,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """A worker continues with an edited site file; a later run identifies the crossings again."""
    folder = tmp_path / "live"
    folder.mkdir()
    headers = [HEADER, ENDED._replace(site_hash="2" * 64)]
    for number, header in enumerate(reversed(headers) if is_newer_first else headers):
        path = folder / f"results-20260827T10000{number}Z.json"
        path.write_text(results_json(results(header, found, {})))
    assert add(folder, tmp_path) == 0
    later = tmp_path / "later.json"
    third = ENDED._replace(site_hash="3" * 64, created=ENDED.created + 1.0)
    later.write_text(results_json(results(third, found[1:], {})))
    assert add(later, tmp_path) == 0
    assert capsys.readouterr().out.splitlines() == [
        f"{folder}: 4 crossings of bridge-1 added",
        f"{later}: 0 crossings of bridge-1 added, 3 replaced",
    ]


def test_list_of_alarms_of_a_single_bridge(
    tmp_path: Path, into: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert add(into, tmp_path) == 0
    capsys.readouterr()
    assert cli.main(["alarm", "list", "--history", str(tmp_path / "history")]) == 0
    first, second, third = capsys.readouterr().out.splitlines()
    assert (first, second) == ("no alarms", "the bridge is not monitored")
    assert third.startswith("bridge-1 in realm sim-fleet: Not monitored: ")


def test_advice_on_an_alarm_names_the_period_of_the_alarms(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    history = tmp_path / "history"
    one = alarm()
    where = alarms_folder(history, one.realm, one.bridge)
    make_folder(where)
    make_folder(history / f"crossings/realm={one.realm}/bridge={one.bridge}")
    write_atomically(where / f"{one.alarm_id}.json", one.model_dump_json())
    for period in ("week", "day"):
        asked = ["alarm", "list", "--history", str(history), "--period", period]
        assert cli.main(asked) == 0
        assert f"driveby history BRIDGE --period {period} " in capsys.readouterr().out
