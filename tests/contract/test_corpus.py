"""Files of earlier commits (tests/data/corpus) are read today with the meaning that they had."""

import gzip
import shutil
from pathlib import Path

import pytest

from schemas.results import Results, load_results
from schemas.signals import decode_accel, decode_gnss
from schemas.site_file import load_site
from services.catalogue.index import read_catalog
from services.common.stores import folder_at
from services.execution.result_store import kept_results
from services.history.history_store import bridges_of, read_partition
from services.recordings.recording import read_info, read_messages
from services.truck.spool import Spool

FOLDERS = sorted(
    path for path in (Path(__file__).parents[1] / "data" / "corpus").iterdir() if path.is_dir()
)
MOST_BYTES = 40_000


def commit(folder: Path) -> str:
    return folder.name


def having(name: str) -> list[Path]:
    """Return the folders of the commits that wrote files of a kind."""
    found = [folder for folder in FOLDERS if (folder / name).is_dir()]
    assert len(found) > 1
    return found


@pytest.fixture(scope="module", params=FOLDERS, ids=commit)
def corpus(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the files of one commit, unpacked; no reader can change the files themselves."""
    folder: Path = tmp_path_factory.mktemp("corpus") / request.param.name
    shutil.copytree(request.param, folder)
    for path in folder.glob("*.gz"):
        path.with_suffix("").write_bytes(gzip.decompress(path.read_bytes()))
        path.unlink()
    return folder


def results_of(corpus: Path) -> Results:
    return load_results(corpus / "results.json")


def test_recording_of_a_commit_is_read(corpus: Path) -> None:
    remarks: list[str] = []
    messages = list(read_messages(corpus / "drive.mcap", warn=remarks.append))
    info = read_info(corpus / "drive.mcap")
    assert (len(messages), remarks) == (16, [])
    assert (info.end is not None, info.truncated, info.damaged_chunks) == (True, False, 0)
    batches = [decode_accel(one.payload) for one in messages if one.key.stream == "accel"]
    assert batches
    for batch in batches:
        assert len(batch.channels) == 4
        for channel in batch.channels.values():
            assert channel.rate_hz == pytest.approx(1000.0)
            assert 0 < abs(channel.samples).max() < 50
    fixes = [decode_gnss(one.payload) for one in messages if one.key.stream == "gnss"]
    assert all(9.5 < fix.speed_m_per_s < 10.5 for fix in fixes)


def test_site_file_of_a_commit_is_read(corpus: Path) -> None:
    site = load_site(corpus / "site.toml")
    assert (site.vehicles[0].id, site.bridges[0].id) == ("truck-1", "bridge-1")
    assert site.bridges[0].elements == 7
    assert site.bridges[0].nominal_flexural_rigidity_nm2 == (1.56e10,) * 7


def test_results_of_a_commit_are_read(corpus: Path) -> None:
    results = results_of(corpus)
    (crossing,) = results.crossings
    assert (crossing.vehicle, crossing.bridge) == ("truck-1", "bridge-1")
    assert crossing.parameters is not None
    assert crossing.parameters["EI_1"].mean == pytest.approx(1.56e10, rel=0.05)
    assert results.bridges["bridge-1"].elements["EI_1"].mean == pytest.approx(1.56e10, rel=0.05)


def test_spool_of_a_commit_is_read(corpus: Path) -> None:
    spool = Spool(corpus / "spool")
    try:
        assert spool.discarded_bytes == 0
        held = {stream: spool.contents(stream) for stream in spool.streams()}
        assert held
        for stream, (boot,) in held.items():
            page = spool.read(stream, boot.boot_id, 0, 1 << 40)
            assert page.messages
            assert page.next_sequence is None
    finally:
        spool.close()


@pytest.mark.parametrize("corpus", having("history"), indirect=True, ids=commit)
def test_history_of_a_commit_is_read(corpus: Path) -> None:
    ((realm, bridge),) = bridges_of(corpus / "history")
    assert (realm, bridge) == ("live", "bridge-1")
    partition = corpus / "history" / "crossings" / f"realm={realm}" / f"bridge={bridge}"
    read = read_partition(partition)
    (row,) = read.crossings
    assert row.crossing_id == results_of(corpus).crossings[0].crossing_id
    assert row.temperature_deg_c == 9.5


@pytest.mark.parametrize("corpus", having("into"), indirect=True, ids=commit)
def test_folder_of_results_of_a_commit_is_read(corpus: Path) -> None:
    problems: list[str] = []
    (found,) = kept_results(corpus / "into", problems.append)
    assert found.crossings == results_of(corpus).crossings
    assert all("bridges.json" in line for line in problems)


@pytest.mark.parametrize("corpus", having("_catalog"), indirect=True, ids=commit)
def test_catalogue_of_a_commit_is_read(corpus: Path) -> None:
    found = read_catalog(folder_at(str(corpus)))
    assert (list(found.rows), found.problems) == (["drive.mcap"], ())
    assert found.rows["drive.mcap"].messages == 16


def test_corpus_is_small() -> None:
    for folder in FOLDERS:
        size = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
        assert size < MOST_BYTES, folder.name
