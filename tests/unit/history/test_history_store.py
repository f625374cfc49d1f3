"""A history: what is added once, what is read, what is damaged, and a bridge by periods."""

import json
import shutil
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import zstandard

from schemas.results import CrossingResult, Results, results_json
from schemas.site import Site
from schemas.site_file import site_toml
from services.cli import main as cli
from services.common.errors import InputError
from services.common.parquet_files import encoded
from services.history import history_store
from services.history.add_summary import AddSummary
from services.history.history_store import (
    add_results,
    fusable_of,
    partition,
    read_partition,
    unpacked_observation,
)
from services.history.periods import begin_of, end_of, fused_periods
from services.history.sql import overview, query
from services.history.temperatures import temperatures_of
from services.identification import fusing
from services.identification.bridge_state import RecentCrossings, add_crossings, state_of, usable
from services.identification.observed import observation_of
from tests.fleet import DAY_S, bridge_of, crossing_of, results_of, templates, trucks_of
from tests.unit.viewer.found import results_of as results_of_site
from tests.unit.viewer.found import some_crossing

BEGIN_S = datetime(2026, 3, 2, tzinfo=UTC).timestamp()  # a Monday


def crossings(
    number: int, name: str = "bridge-1", seed: int = 1, apart_s: float = DAY_S
) -> Results:
    """Crossings a day apart."""
    rng = np.random.default_rng(seed)
    (truck,) = trucks_of(rng, 1)
    bridge = bridge_of(rng, name)
    some = [
        crossing_of(rng, templates()[k % 3], truck, bridge, BEGIN_S + k * DAY_S, bridge.ei_nm2)
        for k in range(number)
    ]
    return results_of(some, BEGIN_S + 100 * DAY_S)


def where(folder: Path, name: str = "bridge-1") -> Path:
    return partition(folder, "sim-fleet", name)


def files(folder: Path) -> list[Path]:
    return sorted(folder.rglob("*.parquet"))


def counts(of: AddSummary) -> tuple[int, int, int, tuple[str, ...]]:
    return len(of.added), len(of.replaced), len(of.known), of.bridges


def test_what_is_added_is_there_and_adding_it_again_changes_nothing(tmp_path: Path) -> None:
    some = crossings(3)
    assert counts(add_results(tmp_path, some)) == (3, 0, 0, ("bridge-1",))
    before = {path: path.read_bytes() for path in files(tmp_path)}
    assert len(before) == 1
    assert counts(add_results(tmp_path, some)) == (0, 0, 3, ())
    more = some.model_copy(update={"crossings": (*some.crossings, *crossings(5).crossings[3:])})
    assert counts(add_results(tmp_path, more)) == (2, 0, 3, ("bridge-1",))
    after = {path: path.read_bytes() for path in files(tmp_path)}
    assert before.items() <= after.items()
    kept = read_partition(where(tmp_path), ("likelihood", "observation")).crossings
    assert [one.crossing_id for one in kept] == [c.crossing_id for c in more.crossings]
    for one, crossing in zip(kept, more.crossings, strict=True):
        assert one.verdict == "good"
        assert fusable_of(one) == usable(crossing)
        outcome, found = unpacked_observation(one.observation or b""), observation_of(crossing)
        assert found is not None
        assert np.allclose(outcome.value, found.value, rtol=1e-12)
        assert np.allclose(outcome.own, found.own, rtol=1e-12)
        assert [s.name for s in outcome.shared] == [s.name for s in found.shared]
        for a, b in zip(outcome.shared, found.shared, strict=True):
            assert np.allclose(a.loading, b.loading, rtol=1e-6, atol=1e-12)


def test_of_two_results_of_a_crossing_the_newer_one_counts(tmp_path: Path) -> None:
    some = crossings(2)
    newer = some.model_copy(
        update={
            "created": some.created + 1.0,
            "crossings": tuple(c.model_copy(update={"chi2_per_dof": 1.5}) for c in some.crossings),
        }
    )
    add_results(tmp_path, newer)
    assert counts(add_results(tmp_path, some)) == (0, 0, 2, ())
    newest = newer.model_copy(update={"created": some.created + 2.0})
    newest = newest.model_copy(update={"site_hash": "2" * 64})
    assert counts(add_results(tmp_path, newest)) == (0, 2, 0, ("bridge-1",))
    kept = read_partition(where(tmp_path)).crossings
    assert [one.chi2_per_dof for one in kept] == [1.5, 1.5]


def test_sql_counts_each_crossing_once(tmp_path: Path) -> None:
    """A later result or a later temperature replaces the row; `results` keeps all."""
    some = crossings(2)
    add_results(tmp_path, some)
    add_results(tmp_path, some, {some.crossings[0].crossing_id: 12.0})
    newer = some.crossings[1].model_copy(update={"chi2_per_dof": 1.5})
    older = some.crossings[1].model_copy(update={"chi2_per_dof": 9.0})
    for at_s, one in ((1.0, newer), (-1.0, older)):
        update = {"created": some.created + at_s, "crossings": (one,)}
        add_results(tmp_path, some.model_copy(update=update))
    asked = "SELECT temperature_deg_c, chi2_per_dof FROM {} ORDER BY entry_s"
    found = query(tmp_path, asked.format("crossings")).rows
    kept = read_partition(where(tmp_path)).crossings
    assert found == tuple((one.temperature_deg_c, one.chi2_per_dof) for one in kept)
    assert (found[0][0], found[1][1]) == (12.0, 1.5)
    assert len(query(tmp_path, asked.format("results")).rows) == 5
    assert overview(tmp_path).rows[0][2:4] == (2, 2)


def test_rejected_crossing_is_kept_and_adds_no_information(tmp_path: Path) -> None:
    some = crossings(1)
    rejected = CrossingResult.model_validate(
        some.crossings[0].model_dump()
        | {"verdict": "rejected", "reasons": ["failed"], "parameters": None}
        | {"fusion_likelihood": None, "reason_texts": ["It failed."]}
    )
    add_results(tmp_path, some.model_copy(update={"crossings": (rejected,)}))
    (one,) = read_partition(where(tmp_path), ("likelihood", "observation")).crossings
    assert (one.verdict, one.reasons, one.elements) == ("rejected", ("failed",), ())
    assert (one.likelihood, one.observation) == (None, None)
    assert fusable_of(one) is None


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"bridge": "../elsewhere"}, r"identifier '\.\./elsewhere' must be"),
        ({"entry_time": 1e18}, r"1e\+18 is no time of a crossing"),
    ],
)
def test_name_or_time_that_is_none_is_refused_before_anything_is_written(
    tmp_path: Path, changed: dict[str, object], words: str
) -> None:
    some = crossings(2)
    bad = some.crossings[1].model_copy(update=changed)
    with pytest.raises(InputError, match=words):
        add_results(tmp_path, some.model_copy(update={"crossings": (some.crossings[0], bad)}))
    assert files(tmp_path) == []


def test_many_small_files_are_packed_and_a_kill_between_leaves_rows_that_count_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    some = crossings(20)

    def killed(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    for k, one in enumerate(some.crossings[:12]):
        add_results(tmp_path, some.model_copy(update={"crossings": (one,)}))
        assert len(files(tmp_path)) == k + 1
    with monkeypatch.context() as patch:
        patch.setattr(Path, "unlink", killed)
        with pytest.raises(KeyboardInterrupt):
            add_results(tmp_path, some.model_copy(update={"crossings": some.crossings[12:13]}))
    assert len(read_partition(where(tmp_path)).crossings) == 13
    add_results(tmp_path, some)
    assert len(files(tmp_path)) == 1
    assert len(read_partition(where(tmp_path)).crossings) == 20


def test_damaged_files_and_other_editions_get_a_line_and_stay(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    some = crossings(4)
    for one in some.crossings[:3]:
        add_results(tmp_path, some.model_copy(update={"crossings": (one,)}))
    torn, noise = files(tmp_path)[0], where(tmp_path) / "noise.parquet"
    torn.write_bytes(torn.read_bytes()[:-100])
    noise.write_bytes(b"PAR1 this is no table PAR1")
    with monkeypatch.context() as patch:
        patch.setattr(history_store, "FORMAT_VERSION", "2")
        add_results(tmp_path, some.model_copy(update={"crossings": some.crossings[3:]}))
    read = read_partition(where(tmp_path))
    assert len(read.crossings) == 2
    lines = "\n".join(read.problems)
    assert f"{torn}: left out: is not a file of driveby.history" in lines
    assert f"{noise}: left out: is not a file of driveby.history" in lines
    assert "left out: is of format version 2 of driveby.history, this program knows 1" in lines
    assert len(read.problems) == 3
    # What is lost is added again; what cannot be read is never removed.
    monkeypatch.setattr(history_store, "_MAX_FILES", 0)
    assert len(add_results(tmp_path, some).added) == 2
    assert len(read_partition(where(tmp_path)).crossings) == 4
    assert torn.exists()
    assert noise.exists()
    # Questions leave them out too.
    answer = query(tmp_path, "SELECT count(DISTINCT crossing_id) FROM crossings")
    assert answer.rows == ((4,),)
    assert len(answer.problems) == 3


def test_a_row_whose_bytes_are_damaged_gets_a_line(tmp_path: Path) -> None:
    some = crossings(3)
    add_results(tmp_path, some)
    kept = list(read_partition(where(tmp_path), ("likelihood", "observation")).crossings)
    kept[1] = kept[1]._replace(likelihood=(kept[1].likelihood or b"")[:-9], content="f" * 32)
    output: list[str] = []
    (period,) = fused_periods(tmp_path, "sim-fleet", "bridge-1", kept, "week", output.append)
    assert period.state is not None
    assert len(period.state.crossings_used) == 2
    (line,) = output
    assert line.startswith(f"{kept[1].crossing_id}: left out: its likelihood cannot be read")


def test_periods_are_fused_as_fuse_does_it_and_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    some = crossings(9)
    add_results(tmp_path, some, {some.crossings[0].crossing_id: 4.0})
    kept = read_partition(where(tmp_path), ("likelihood",)).crossings
    steps: list[tuple[int, int]] = []
    first, second = fused_periods(
        *(tmp_path, "sim-fleet", "bridge-1", kept, "week"),
        progress=lambda done, of: steps.append((done, of)),
    )
    assert steps == [(1, 2), (2, 2)]
    assert (first.crossings, second.crossings) == (7, 2)
    assert (first.temperature_deg_c, second.temperature_deg_c) == (4.0, None)
    counts = [one for one in map(usable, some.crossings[:7]) if one is not None]
    assert first.state == state_of(add_crossings(RecentCrossings(), counts), "bridge-1")
    monkeypatch.delattr("services.identification.bridge_state.state_of")
    assert fused_periods(tmp_path, "sim-fleet", "bridge-1", kept, "week") == [first, second]
    # What was kept and cut off is fused again, and not believed.
    cut = sorted((tmp_path / "fused").rglob("*.json"))[0]
    cut.write_bytes(cut.read_bytes()[:50])
    with pytest.raises(ImportError):
        fused_periods(tmp_path, "sim-fleet", "bridge-1", kept, "week")


def test_periods_begin_where_calendars_do() -> None:
    time_s = datetime(2026, 2, 26, 13, tzinfo=UTC).timestamp()

    def day(at_s: float) -> str:
        return f"{datetime.fromtimestamp(at_s, UTC):%Y-%m-%d %H}"

    begins = [begin_of(time_s, unit) for unit in ("day", "week", "month")]
    assert [day(b) for b in begins] == ["2026-02-26 00", "2026-02-23 00", "2026-02-01 00"]
    ends = [end_of(b, u) for b, u in zip(begins, ("day", "week", "month"), strict=True)]
    assert [day(e) for e in ends] == ["2026-02-27 00", "2026-03-02 00", "2026-03-01 00"]


def test_temperatures_beside_crossings(tmp_path: Path) -> None:
    some = crossings(3)
    path = tmp_path / "t.csv"
    at = some.crossings[0].entry_time + 2.0
    rows = f"{at - 3600},10,\n{at + 3600},14,\n{at + DAY_S},20,other\n"
    path.write_text(f"time_s,temperature_deg_c,bridge\n{rows}")
    assert temperatures_of(path, some.crossings) == {some.crossings[0].crossing_id: 12.0}
    path.write_text("time_s,temperature_deg_c\n1,2\n5,900\n")
    with pytest.raises(InputError, match=r"t\.csv: line 3: 900 is not a temperature"):
        temperatures_of(path, some.crossings)
    path.write_text("time,temp\n1,2\n")
    with pytest.raises(InputError, match=r"t\.csv: has no column time_s, but time, temp"):
        temperatures_of(path, some.crossings)


def test_temperatures_without_a_match_are_explained(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    some = crossings(1)
    found, path = tmp_path / "r.json", tmp_path / "t.csv"
    found.write_text(results_json(some))
    at_s = 0.5 * (some.crossings[0].entry_time + some.crossings[0].exit_time)
    tail = " away (time_s is Unix time in s)"
    for rows, why in (
        (f"{at_s - 4 * 3600},10,", f"the nearest row of {path} is 4.0 hours{tail}"),
        (f"{at_s + 9 * DAY_S},10,", f"the nearest row of {path} is 9 days{tail}"),
        (f"{at_s},10,other", f"no row of {path} applies to these bridges"),
    ):
        path.write_text(f"time_s,temperature_deg_c,bridge\n{rows}\n")
        words = ["history", "add", str(found), "--temperature", str(path), "--defer-fusion"]
        assert cli.main([*words, "--history", str(tmp_path / "h")]) == 0
        assert capsys.readouterr().out.endswith(f", 0 with a temperature: {why}\n")
    path.write_text(f"time_s,temperature_deg_c\n{at_s * 1e3},10\n")
    assert cli.main([*words, "--history", str(tmp_path / "h")]) == 0
    assert capsys.readouterr().out.endswith("; the rows seem to be in milliseconds\n")


def test_the_commands(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    history, found = str(tmp_path / "history"), tmp_path / "r.json"
    found.write_text(results_json(crossings(5)))
    assert cli.main(["history", "add", str(found), "--history", history]) == 0
    assert capsys.readouterr().out == f"{found}: 5 crossings of bridge-1 added\n"
    assert cli.main(["history", "add", str(found), "--history", history]) == 0
    assert capsys.readouterr().out == f"{found}: 0 crossings added, 5 there already\n"
    table, outcome, folder = tmp_path / "h.csv", tmp_path / "h.json", tmp_path / "figures"
    drawn = ["--figures", str(folder), "--rrd", str(tmp_path / "h.rrd")]
    written = ["--csv", str(table), "--json", str(outcome), *drawn]
    assert cli.main(["history", "bridge-1", "--history", history, *written]) == 0
    output = capsys.readouterr().out
    assert "bridge-1 in realm sim-fleet: 5 crossings in 1 month" in output
    assert len(table.read_text().splitlines()) == 1 + 7
    (period,) = json.loads(outcome.read_text())["periods"]
    assert period["crossings"] == 5
    assert {path.name for path in folder.iterdir()} == {
        "bridge-1-history.png",
        "bridge-1-history.svg",
    }
    assert (tmp_path / "h.rrd").stat().st_size > 1000
    assert cli.main(["history", "--history", history]) == 0
    assert "sim-fleet  bridge-1  5          5     1       2026-03-02  2026-03-06" in (
        capsys.readouterr().out
    )


def test_history_is_drawn_against_the_baseline_of_a_site_file(
    tmp_path: Path, site: Site, capsys: pytest.CaptureFixture[str]
) -> None:
    history, then = tmp_path / "history", tmp_path / "then.json"
    add_results(history, crossings(5))
    then.write_text(results_json(results_of_site(site, some_crossing("a"), used="a")))
    bridge = site.bridges[0].model_copy(update={"baseline": "then.json"})
    known = tmp_path / "site.toml"
    known.write_text(site_toml(site.model_copy(update={"bridges": (bridge,)})))
    show = ["history", "bridge-1", "--history", str(history), "--figures", str(tmp_path)]
    assert cli.main([*show, "--site", str(known)]) == 0
    assert "the baseline then.json" in (tmp_path / "bridge-1-history.svg").read_text()
    assert cli.main(show) == 0
    assert (
        "the first month with a usable result, 2026-03"
        in (tmp_path / "bridge-1-history.svg").read_text()
    )
    then.unlink()
    capsys.readouterr()
    assert cli.main([*show, "--site", str(known)]) == 2
    assert "then.json: no such file" in capsys.readouterr().err
    other = bridge.model_copy(update={"id": "bridge-9"})
    known.write_text(site_toml(site.model_copy(update={"bridges": (other,)})))
    assert cli.main([*show, "--site", str(known)]) == 2
    assert capsys.readouterr().err.endswith("site.toml: has no bridge bridge-1\n")


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (["bridge-9"], "has no bridge bridge-9; there are bridge-1"),
        (["bridge-1", "--realm", "live"], "bridge-1 is in sim-fleet, not in live"),
        (["bridge-1", "bridge-2"], "one bridge is expected, or add RESULTS …"),
        (["--sql", "SELECT nothing"], "--sql: "),
        (["--sql", "DROP VIEW crossings"], "SELECT … is expected"),
        (["add", "nowhere.json"], "nowhere.json: no such file, a results file (JSON)"),
    ],
)
def test_what_is_wrong_gets_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], line: str
) -> None:
    add_results(tmp_path, crossings(1))
    assert cli.main(["history", *arguments, "--history", str(tmp_path)]) == 2
    error = capsys.readouterr().err
    assert line in error
    assert error.count("\n") == 1


def test_a_bridge_in_two_realms_has_to_be_chosen(tmp_path: Path) -> None:
    some = crossings(1)
    live = some.crossings[0].model_copy(update={"realm": "live"})
    add_results(tmp_path, some.model_copy(update={"crossings": (some.crossings[0], live)}))
    with pytest.raises(InputError, match="bridge-1 is in live, sim-fleet; choose with --realm"):
        history_store.realm_of(tmp_path, "bridge-1", None)
    assert history_store.realm_of(tmp_path, "bridge-1", "live") == "live"
    with pytest.raises(InputError, match=r"bridge-1 is in live, sim-fleet, not in sim-typo$"):
        history_store.realm_of(tmp_path, "bridge-1", "sim-typo")
    assert len(overview(tmp_path).rows) == 2


def test_a_history_that_is_none(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such folder"):
        overview(tmp_path / "nowhere")
    shutil.rmtree(tmp_path / "history", ignore_errors=True)
    with pytest.raises(InputError, match="is not a history"):
        overview(tmp_path)


def test_what_a_killed_writer_left_is_no_damage(tmp_path: Path) -> None:
    add_results(tmp_path, crossings(3))
    (file,) = files(tmp_path)
    file.with_name(".0123.abcd.part.parquet").write_bytes(file.read_bytes()[:100])
    read = read_partition(where(tmp_path))
    assert (len(read.crossings), read.problems) == (3, ())
    assert query(tmp_path, "SELECT count(*) FROM crossings").rows == ((3,),)


def rewritten(path: Path, row: int, change: dict[str, object]) -> None:
    """Another value in a row; where it is of another kind, in all of the column."""
    outcome = pq.read_table(path).to_pylist()
    for name, value in change.items():
        is_alike = value is None or type(value) is type(outcome[row][name])
        for number, one in enumerate(outcome):
            if number == row:
                one[name] = value
            elif not is_alike:
                one[name] = type(value)()
    path.write_bytes(
        encoded(pa.Table.from_pylist(outcome), history_store.KEY, history_store.FORMAT_VERSION)
    )


BAD_ROWS: list[dict[str, object]] = [
    {"crossing_id": None},
    {"crossing_id": 5},
    {"vehicle": None},
    {"direction": "sideways"},
    {"entry_s": None},
    {"entry_s": float("nan")},
    {"entry_s": 1e300},
    {"entry_s": -5.0},
    {"entry_s": "noon"},
    {"exit_s": float("inf")},
    {"speed_m_per_s": None},
    {"verdict": "splendid"},
    {"reasons": "none"},
    {"chi2_per_dof": float("nan")},
    {"temperature_deg_c": "warm"},
    {"temperature_deg_c": float("inf")},
    {"created_s": None},
    {"site_hash": None},
    {"search_hash": None},
    {"version": None},
    {"content": None},
    {"ei_mean_nm2": None},
    {"ei_std_nm2": [1.0]},
    {"ei_q025_nm2": [float("nan")] * 7},
    {"ei_q975_nm2": "stiff"},
    {"likelihood": b"no zstd"},
    {"likelihood": "text"},
    {"likelihood": zstandard.compress(b"{}")},
    {"observation": b"nothing"},
    {"observation": 5},
]


@pytest.mark.parametrize("change", BAD_ROWS, ids=str)
def test_bad_rows_get_a_line_and_the_others_are_read(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    change: dict[str, object],
) -> None:
    monkeypatch.setattr(fusing, "_DRAWS_PER_CHAIN", 20)  # no number is compared
    some = crossings(4)
    history, found = tmp_path / "history", tmp_path / "r.json"
    found.write_text(results_json(some))
    there = ["--history", str(history)]
    assert cli.main(["history", "add", str(found), "--later", *there]) == 0
    (path,) = files(history)
    rewritten(path, 1, change)
    before = path.read_bytes()
    capsys.readouterr()
    name = some.crossings[1].crossing_id
    lines: list[str] = []
    for words in (["history", "bridge-1"], ["history"], ["alarm", "check", "--all"]):
        assert cli.main([*words, *there]) in (0, 2)
        output = capsys.readouterr()
        assert "internal error" not in output.err
        lost = [one for one in (output.out + output.err).splitlines() if "left out" in one]
        assert len(lost) <= 1
        assert all(one.startswith((f"{path}: ", f"{name}: ")) for one in lost)
        lines += lost
    assert lines
    assert cli.main(["history", "add", str(found), *there]) in (0, 3)
    assert "internal error" not in capsys.readouterr().err
    assert path.read_bytes() == before
    # What can be read of the two files together is all that there was.
    assert len(read_partition(where(history), ("likelihood", "observation")).crossings) == 4


def test_what_is_lost_is_written_beside_the_damaged_file_that_has_its_name(tmp_path: Path) -> None:
    """The same rows make the same name: else nothing would be written, and it was lost."""
    some = crossings(3)
    add_results(tmp_path, some)
    (path,) = files(tmp_path)
    torn = path.read_bytes()[:-100]
    path.write_bytes(torn)
    for count in (3, 0):
        bridges = ("bridge-1",) if count else ()
        assert counts(add_results(tmp_path, some)) == (count, 0, 3 - count, bridges)
        read = read_partition(where(tmp_path))
        assert len(read.crossings) == 3
        assert len(read.problems) == 1
    assert path.read_bytes() == torn
    assert len(files(tmp_path)) == 2


def test_questions_leave_out_another_edition_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    some = crossings(3)
    add_results(tmp_path, some.model_copy(update={"crossings": some.crossings[:2]}))
    with monkeypatch.context() as patch:
        patch.setattr(history_store, "FORMAT_VERSION", "2")
        add_results(tmp_path, some.model_copy(update={"crossings": some.crossings[2:]}))
    assert cli.main(["history", "--history", str(tmp_path)]) == 0
    line, _, row = capsys.readouterr().out.splitlines()
    assert "left out: is of format version 2 of driveby.history, this program knows 1" in line
    assert row.split()[:3] == ["sim-fleet", "bridge-1", "2"]


def test_adding_again_without_temperatures_takes_none_away(tmp_path: Path) -> None:
    some = crossings(8)
    add_results(tmp_path, some, {one.crossing_id: 7.0 for one in some.crossings})
    add_results(tmp_path, some)
    kept = read_partition(where(tmp_path)).crossings
    assert [one.temperature_deg_c for one in kept] == [7.0] * 8
