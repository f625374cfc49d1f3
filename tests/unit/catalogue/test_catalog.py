"""The catalogue of a folder: what it says, what it mends, and crossings from positions alone."""

import fcntl
import os
import re
import shutil
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from schemas.proto import driveby_pb2 as pb
from schemas.signals import AccelBatch, AccelChannel, GnssFix, encode_accel, encode_gnss
from schemas.site import Site
from schemas.topics import Key, Message
from services.catalogue import index as catalog
from services.catalogue.contents import summarise_recording
from services.catalogue.deletions import note_deletion
from services.catalogue.index import CATALOG, read_catalog, update_catalog
from services.catalogue.positions import crossings_of
from services.cli import main as cli
from services.common.errors import InputError
from services.common.extras import install_command
from services.common.parquet_files import encoded
from services.common.stores import folder_at, put
from services.finding.stays import Passage
from services.recordings.writer import write_recording
from tests.object_store import object_store

S = 1_000_000_000
START_NS = 1_700_000_000 * S
EAST_DEG_PER_S = 2.2e-4
"""Some 20 m/s along the bridge of the example."""


def drive(site: Site, seconds: range, turns_s: tuple[int, ...], boot: int = 7) -> Iterator[Message]:
    """A truck that is at the bridge at some times, and drives along its line, away and back."""
    (bridge,) = site.bridges
    slope = (bridge.end_latitude_deg - bridge.start_latitude_deg) / (
        bridge.end_longitude_deg - bridge.start_longitude_deg
    )
    middle = 0.5 * (bridge.start_longitude_deg + bridge.end_longitude_deg)
    rng = np.random.default_rng(5)
    for number in range(10 * seconds.start, 10 * seconds.stop):
        time_ns = START_NS + number * S // 10
        n = min(range(len(turns_s)), key=lambda k: abs(number / 10 - turns_s[k]))
        east = EAST_DEG_PER_S * (number / 10 - turns_s[n]) * (-1) ** n
        batch = AccelBatch(
            boot, number, number * S // 10, time_ns,
            {"sprung_front": AccelChannel(1000.0, rng.standard_normal(100))},
        )  # fmt: skip
        fix = GnssFix(
            boot, number, number * S // 10, time_ns,
            0.5 * (bridge.start_latitude_deg + bridge.end_latitude_deg) + slope * east,
            middle + east, 0.0, 20.0,
        )  # fmt: skip
        for stream, payload in (("accel", encode_accel(batch)), ("gnss", encode_gnss(fix))):
            where = Key("live", "vehicle", "truck-1", stream)
            yield Message(where, payload, boot, number, time_ns, time_ns)


def record(path: Path, messages: Iterator[Message]) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    write_recording(path, messages, site_toml=None, reason="test")
    return path


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory, site: Site) -> Path:
    """A drive in two recordings that meet while the truck is on the bridge; and one elsewhere."""
    folder = tmp_path_factory.mktemp("recorded")
    turns = (100, 900, 1700)
    record(folder / "live/2023-11-14/a.mcap", drive(site, range(900), turns))
    record(folder / "live/2023-11-14/b.mcap", drive(site, range(900, 1800), turns))
    record(folder / "live/2023-11-14/c.mcap", drive(site, range(4000, 4300), (9000,), boot=8))
    return folder


@pytest.fixture
def long(tmp_path: Path, recorded: Path) -> Path:
    """A copy of these recordings."""
    return shutil.copytree(recorded, tmp_path / "fleet")


@pytest.fixture(scope="module")
def short(tmp_path_factory: pytest.TempPathFactory, site: Site) -> Path:
    """Three recordings of half a minute, each of one crossing: for what is not about the drive."""
    folder = tmp_path_factory.mktemp("short")
    for name, middle_s, boot in (("a", 100, 7), ("b", 400, 7), ("c", 4100, 8)):
        seconds = range(middle_s - 15, middle_s + 15)
        path = folder / f"live/2023-11-14/{name}.mcap"
        record(path, drive(site, seconds, (middle_s,), boot))
    return folder


@pytest.fixture
def fleet(tmp_path: Path, short: Path) -> Path:
    """A copy of the short recordings."""
    return shutil.copytree(short, tmp_path / "fleet")


@pytest.fixture(scope="module")
def catalogued(short: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The short recordings with their catalogue."""
    folder = shutil.copytree(short, tmp_path_factory.mktemp("catalogued") / "fleet")
    update_catalog(folder_at(str(folder)))
    return folder


def test_a_row_says_what_is_in_a_recording(long: Path) -> None:
    rows = update_catalog(folder_at(str(long))).rows
    assert list(rows) == [f"live/2023-11-14/{name}.mcap" for name in "abc"]
    row = rows["live/2023-11-14/a.mcap"]
    assert (row.vehicles, row.realms) == (("truck-1",), ("live",))
    assert (row.first_ns, row.last_ns) == (START_NS, START_NS + 8999 * S // 10)
    assert row.messages == 18_000
    assert row.rates_hz == {"sprung_front": 1000.0, "gnss": 10.0}
    assert (row.gaps, row.gap_s) == (0, 0.0)
    assert row.box is not None
    assert row.box.east_deg - row.box.west_deg == pytest.approx(500.0 * EAST_DEG_PER_S, rel=0.01)


def test_a_gap_is_counted(tmp_path: Path, site: Site) -> None:
    messages = [m for m in drive(site, range(20), (100,)) if not 50 <= m.sequence < 90]
    record(tmp_path / "a.mcap", iter(messages))
    (row,) = update_catalog(folder_at(str(tmp_path))).rows.values()
    assert (row.gaps, row.gap_s) == (2, pytest.approx(8.2))  # of two streams


def test_crossings_from_positions_alone(long: Path, site: Site) -> None:
    folder = folder_at(str(long))
    found = crossings_of(folder, update_catalog(folder).rows.values(), site)
    assert found.problems == ()
    assert [c.passage for c in found.crossings] == [Passage.THROUGH] * 3
    # The recordings by themselves know of two: the third goes on from one into the next.
    alone = [
        p
        for n in "ab"
        for p in summarise_recording(long / f"live/2023-11-14/{n}.mcap", site).passings
    ]
    through = [p for p in alone if p.passage is Passage.THROUGH]
    assert len(through) == 2
    times = [(c.entry_ns, c.exit_ns) for c in found.crossings]
    assert [(p.entry_ns, p.exit_ns) for p in through] == [times[0], times[2]]
    assert [len(c.recordings) for c in found.crossings] == [1, 2, 1]
    # The third drive's box is far from the bridge; of the others a part of the chunks is read.
    assert found.files_read == 2
    assert found.chunks_read < 0.65 * found.chunks


def test_a_recording_far_from_bridges_is_hardly_read(tmp_path: Path, site: Site) -> None:
    """Its box holds the bridge's place, but the truck was there for seconds only."""
    record(tmp_path / "a.mcap", drive(site, range(3000), (100,)))
    folder = folder_at(str(tmp_path))
    found = crossings_of(folder, update_catalog(folder).rows.values(), site)
    assert len(found.crossings) == 1
    assert found.chunks_read < 0.25 * found.chunks


def test_truck_away_at_both_ends_may_have_crossed(tmp_path: Path, site: Site) -> None:
    """Out over the bridge and back to where the drive began, two kilometres from it."""
    record(tmp_path / "a.mcap", drive(site, range(400), (100, 300)))
    folder = folder_at(str(tmp_path))
    found = crossings_of(folder, update_catalog(folder).rows.values(), site)
    assert [c.forward for c in found.crossings] == [True, False]


def test_mending_names_what_is_gone_and_changed(fleet: Path, site: Site) -> None:
    folder = folder_at(str(fleet))
    assert update_catalog(folder).added == 3
    assert update_catalog(folder)[1:] == (0, 0, (), 0, 0)
    a, b, c = (fleet / f"live/2023-11-14/{name}.mcap" for name in "abc")
    a.unlink()
    record(b.with_name("new.mcap"), drive(site, range(20), (10,)))
    b.with_name("new.mcap").replace(b)
    # Another content of the same size: the time shows it.
    data = bytearray(c.read_bytes())
    data[len(data) // 2] ^= 1
    status = c.stat()
    c.write_bytes(bytes(data))
    os.utime(c, ns=(status.st_atime_ns, status.st_mtime_ns + S))
    mended = update_catalog(folder)
    assert set(mended.rows) == {"live/2023-11-14/b.mcap"}
    gone, smaller, *damaged = mended.problems
    assert gone.endswith("a.mcap: is gone; its row is dropped")
    assert "b.mcap: has " in smaller
    assert damaged[0].endswith("is not the file of its row, but of the same size; "
                               "its row is computed again if it can be read")  # fmt: skip
    assert "c.mcap: damaged chunk" in damaged[1]
    assert read_catalog(folder).rows == mended.rows


def test_deletion_by_a_budget_is_no_loss(fleet: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The next recording that disappears without a note is reported, even at the same path."""
    folder = folder_at(str(fleet))
    update_catalog(folder)
    path = fleet / "live/2023-11-14/a.mcap"
    content = path.read_bytes()
    note_deletion(fleet, path)
    path.unlink()
    assert cli.main(["catalog", str(fleet)]) == 0
    assert "1 recording deleted by a logger to keep its budget\n" in capsys.readouterr().out
    assert update_catalog(folder)[1:] == (0, 0, (), 0, 0)
    path.write_bytes(content)
    assert cli.main(["catalog", str(fleet)]) == 0
    path.unlink()
    assert cli.main(["catalog", str(fleet)]) == 3
    assert "a.mcap: is gone; its row is dropped" in capsys.readouterr().out


def test_a_file_that_was_touched_keeps_its_row(fleet: Path) -> None:
    folder = folder_at(str(fleet))
    before = update_catalog(folder).rows
    path = fleet / "live/2023-11-14/a.mcap"
    os.utime(path, ns=(0, path.stat().st_mtime_ns + S))
    mended = update_catalog(folder)
    assert mended[1:] == (0, 0, (), 0, 0)
    assert {r.content for r in mended.rows.values()} == {r.content for r in before.values()}


@pytest.mark.parametrize(
    ("what", "value"),
    [("first_ns", 5), ("content", bytes(32)), ("box", None), ("messages", 1), ("size_bytes", 3)],
)
def test_a_catalogue_that_lies_is_found_out(fleet: Path, what: str, value: object) -> None:
    folder = folder_at(str(fleet))
    truth = update_catalog(folder).rows
    shutil.rmtree(fleet / CATALOG)
    lie = next(iter(truth.values()))._replace(**{what: value})  # type: ignore[arg-type]
    for row in [lie, *list(truth.values())[1:]]:
        catalog.add(folder, row)
    mended = update_catalog(folder, verify=True)
    (problem,) = mended.problems
    assert "a.mcap: " in problem
    assert "row" in problem
    assert mended.rows == truth


def test_a_row_is_less_than_a_kilobyte(fleet: Path) -> None:
    folder = folder_at(str(fleet))
    row = next(iter(update_catalog(folder).rows.values()))
    shutil.rmtree(fleet / CATALOG)
    rows = {
        f"live/{n}.mcap": row._replace(path=f"live/{n}.mcap", content=os.urandom(32))
        for n in range(100)
    }
    for one in rows.values():
        catalog.add(folder, one)
    size = sum(path.stat().st_size for path in (fleet / CATALOG).rglob("*.parquet"))
    assert size < 1600 * len(rows)
    catalog._pack(folder, rows, read_catalog(folder))
    packed = list((fleet / CATALOG).rglob("*.parquet"))
    assert len(packed) == 1
    assert packed[0].stat().st_size < 300 * len(rows)
    assert read_catalog(folder).rows == rows


def test_kill_during_packing_leaves_rows_that_count_once(
    fleet: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = folder_at(str(fleet))
    truth = update_catalog(folder).rows
    shutil.rmtree(fleet / CATALOG)
    for row in truth.values():
        assert catalog.add(folder, row)
        assert not catalog.add(folder, row)  # by a second writer

    def killed(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(catalog, "remove", killed)
        with pytest.raises(KeyboardInterrupt):
            update_catalog(folder)
    assert len(list((fleet / CATALOG).rglob("*.parquet"))) == 4
    assert read_catalog(folder).rows == truth
    assert update_catalog(folder) == (truth, 0, 0, (), 0, 0)
    assert len(list((fleet / CATALOG).rglob("*.parquet"))) == 1


def test_files_that_are_no_rows_get_a_line_and_stay(fleet: Path) -> None:
    folder = folder_at(str(fleet))
    update_catalog(folder)
    (file,) = (fleet / CATALOG).rglob("*.parquet")
    torn = file.with_name("torn.parquet")
    torn.write_bytes(file.read_bytes()[:-40])
    other = file.with_name("other.parquet")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(catalog, "FORMAT_VERSION", "2")
        rows = read_catalog(folder_at(str(fleet))).problems
        assert len(rows) == 2
        other.write_bytes(catalog._file_of([catalog.row_of(folder, catalog.files_below(
            folder, ".mcap")[0])]))  # fmt: skip
    mended = update_catalog(folder)
    assert len(mended.rows) == 3
    newer, cut = sorted(mended.problems)
    assert newer.endswith("other.parquet: left out: is of format version 2 of driveby.catalog, "
                          "this program knows 1")  # fmt: skip
    assert "torn.parquet: left out: is not a file of driveby.catalog" in cut
    assert torn.exists()
    assert other.exists()


def test_rows_of_a_damaged_file_are_written_again_beside_it(fleet: Path) -> None:
    """They would have the same name; else all recordings were read anew each time."""
    folder = folder_at(str(fleet))
    truth = update_catalog(folder).rows
    (file,) = (fleet / CATALOG).rglob("*.parquet")
    file.write_bytes(file.read_bytes()[:-40])
    assert update_catalog(folder).added == 3
    (problem,) = update_catalog(folder).problems
    assert f"{file}: left out" in problem
    assert update_catalog(folder)[:2] == (truth, 0)
    assert len(list((fleet / CATALOG).rglob("*.parquet"))) == 2


@pytest.mark.parametrize(
    "change",
    [
        {"path": None},
        {"first_ns": "noon"},
        {"first_ns": -1},
        {"first_ns": 2**62},
        {"size_bytes": None},
        {"content": None},
        {"south_deg": float("nan")},
        {"west_deg": None},
        {"details": None},
        {"details": "{"},
        {"details": "[]"},
        {"details": '{"realms": 5}'},
    ],
)
def test_rows_that_hold_something_else_get_a_line_and_are_made_anew(
    catalogued: Path,
    tmp_path: Path,
    change: dict[str, object],
    capsys: pytest.CaptureFixture[str],
    project: Path,
) -> None:
    fleet = shutil.copytree(catalogued, tmp_path / "fleet")
    folder = folder_at(str(fleet))
    truth = read_catalog(folder).rows
    assert len(truth) == 3
    (file,) = (fleet / CATALOG).rglob("*.parquet")
    outcome = pq.read_table(file).to_pylist()
    outcome[1] |= change
    for row in outcome:
        row |= {name: str(row[name]) for name in change if isinstance(outcome[1][name], str)}
    file.write_bytes(encoded(pa.Table.from_pylist(outcome), catalog._KEY, catalog.FORMAT_VERSION))
    site = str(project / "docs/site.example.toml")
    assert cli.main(["catalog", str(fleet), "--site", site]) == 3
    output = capsys.readouterr()
    assert output.err == ""
    assert sum(f"{file}: left out: " in line for line in output.out.splitlines()) == 1
    assert read_catalog(folder).rows == truth


def test_a_recording_that_is_not_closed_is_named(fleet: Path) -> None:
    path = fleet / "live/2023-11-14/a.mcap"
    path.write_bytes(path.read_bytes()[:-200])
    mended = update_catalog(folder_at(str(fleet)))
    (problem,) = mended.problems
    assert problem == (
        f"{path}: has no end: it was being written when it was copied, or its writer was killed "
        "(driveby recover FILE --set-aside makes it complete), unless another machine is writing it"
    )
    assert (len(mended.rows), mended.without_row) == (2, 1)


def test_a_copy_of_an_open_recording_is_incomplete_until_it_is_recovered(
    fleet: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = fleet / "live/2023-11-14/a.mcap"
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    assert cli.main(["catalog", str(fleet), "--verify"]) == 3
    out = capsys.readouterr().out
    assert f"{path}: has no end" in out
    assert "damaged" not in out
    assert "\n2 recordings (2 new to the catalogue, 1 more file not counted: see above), " in out
    assert cli.main(["recover", str(path), "--set-aside"]) == 3
    capsys.readouterr()
    assert cli.main(["catalog", str(fleet), "--verify"]) == 0
    assert capsys.readouterr().out.startswith("3 recordings (1 new to the catalogue), ")


@pytest.mark.parametrize(
    ("damage", "why"),
    [
        (lambda whole: b"", "is empty; an MCAP recording is expected"),
        (lambda whole: whole[:8], "has no end: "),
        (lambda whole: b"a table" * 99, "is not an MCAP file; a recording (.mcap) is expected"),
        # The offset of the summary in the footer, before its checksum and the magic bytes.
        (lambda whole: whole[:-28] + bytes(8) + whole[-20:], "its index is damaged (driveby "),
    ],
)
def test_why_a_file_has_no_index(fleet: Path, damage: Callable[[bytes], bytes], why: str) -> None:
    path = fleet / "live/2023-11-14/a.mcap"
    path.write_bytes(damage(path.read_bytes()))
    (problem,) = update_catalog(folder_at(str(fleet))).problems
    assert problem.startswith(f"{path}: {why}")


def test_a_recording_that_is_being_written_is_no_problem(
    fleet: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = fleet / "live/2023-11-14/a.mcap"
    whole = path.read_bytes()
    path.write_bytes(whole[:-200])
    with path.open("r+b") as writer:
        fcntl.flock(writer, fcntl.LOCK_EX)
        assert cli.main(["catalog", str(fleet)]) == 0
        assert "1 more recording being written" in capsys.readouterr().out
    path.write_bytes(whole)
    assert update_catalog(folder_at(str(fleet)))[1:] == (1, 0, (), 0, 0)


def test_a_damaged_recording_is_no_success(fleet: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["catalog", str(fleet)]) == 0
    path = fleet / "live/2023-11-14/a.mcap"
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    status = path.stat()
    path.write_bytes(bytes(data))
    os.utime(path, ns=(status.st_atime_ns, status.st_mtime_ns))
    assert cli.main(["catalog", str(fleet)]) == 0
    capsys.readouterr()
    assert cli.main(["catalog", str(fleet), "--verify"]) == 3
    out = capsys.readouterr().out
    assert "\n2 recordings (0 new to the catalogue, 1 more file not counted: see above), " in out
    assert f"{path}: damaged chunk" in out


def upload(fleet: Path, url: str) -> None:
    away = folder_at(url)
    for path in sorted(fleet.rglob("*.mcap")):
        assert put(away, path.relative_to(fleet).as_posix(), path.read_bytes())


def check_away(fleet: Path, url: str, site: Site) -> None:
    """The same rows and crossings as on the disk."""
    upload(fleet, url)
    here, away = folder_at(str(fleet)), folder_at(url)
    truth = {path: row.content for path, row in update_catalog(here).rows.items()}
    first, again = update_catalog(away), update_catalog(away)
    assert {path: row.content for path, row in first.rows.items()} == truth
    assert (first.added, first.problems) == (3, ())
    assert again == (first.rows, 0, 0, (), 0, 0)
    found = crossings_of(away, again.rows.values(), site)
    assert found == crossings_of(here, update_catalog(here).rows.values(), site)
    assert len(found.crossings) == 3


def test_in_the_memory_of_fsspec(fleet: Path, site: Site) -> None:
    check_away(fleet, "memory://bucket/fleet", site)


@pytest.mark.xdist_group("object store")
def test_in_an_object_store(fleet: Path, site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    with object_store(monkeypatch) as address:
        check_away(fleet, f"{address}/fleet", site)


def test_without_what_a_store_needs_a_line_says_how_to_get_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(sys.modules, "s3fs", None)
    # What this process has already used counts as installed.
    monkeypatch.delitem(sys.modules["fsspec.registry"]._registry, "s3", raising=False)
    line = f"s3://x: needs s3fs, which is not installed: {install_command('s3')}"
    with pytest.raises(InputError, match=f"^{re.escape(line)}$"):
        folder_at("s3://x")
    with pytest.raises(InputError, match=r"^gopher://x: no store is known as gopher://"):
        folder_at("gopher://x")


def test_the_command(
    fleet: Path, project: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    table = tmp_path / "crossings.csv"
    site = str(project / "docs/site.example.toml")
    assert cli.main(["catalog", str(fleet), "--site", site, "--csv", str(table)]) == 0
    output = capsys.readouterr().out
    assert output.startswith("3 recordings (3 new to the catalogue), 1 truck, ")
    assert "truck-1 over bridge-1" in output
    assert table.read_text().count("through") == 3
    assert cli.main(["catalog", str(tmp_path / "nowhere")]) == 2
    assert capsys.readouterr().err == f"driveby: {tmp_path / 'nowhere'}: no such folder\n"


def test_a_recording_without_measurements_does_not_begin_the_fleet(
    fleet: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Nor does it stand in a folder of 1970."""
    assert cli.main(["catalog", str(fleet)]) == 0
    before = capsys.readouterr().out.partition(" gap")[2].partition("\n")[0]
    later_ns = START_NS + 86_400 * S
    health = pb.Health(schema_version=1, service="logger", time_ns=later_ns).SerializeToString()
    where = Key("live", "service", "logger", "health")
    record(fleet / "_service.mcap", iter([Message(where, health, 1, 1, later_ns, later_ns)]))
    assert cli.main(["catalog", str(fleet)]) == 0
    output = capsys.readouterr().out
    assert output.startswith("4 recordings (1 new to the catalogue)")
    assert output.partition(" gap")[2].partition("\n")[0] == before
    assert read_catalog(folder_at(str(fleet))).rows["_service.mcap"].first_ns == later_ns


def test_an_import_adds_its_row_where_there_is_a_catalogue(
    fleet: Path, csv_example: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["import", str(csv_example), "--site", str(csv_example / "site.toml"), "-o"]
    assert cli.main([*command, str(fleet / "before.mcap")]) == 0
    assert not (fleet / CATALOG).exists()
    update_catalog(folder_at(str(fleet)))
    assert cli.main([*command, str(fleet / "live/after.mcap")]) == 0
    assert "live/after.mcap" in read_catalog(folder_at(str(fleet))).rows
