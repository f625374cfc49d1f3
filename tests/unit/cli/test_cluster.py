"""`driveby cluster`, `identify --scheduler` and `--into`: what is refused, and what is printed."""

import importlib.util
import os
import socket
import tempfile
from pathlib import Path

import pytest

from services.catalogue.index import CATALOG, update_catalog
from services.cli import main as cli
from services.cli.parsing import EXIT_SOMETHING_LOST
from services.common.extras import install_command
from services.common.stores import files_below, folder_at, put
from services.execution import cluster
from services.execution.result_store import BRIDGES
from services.security.certs import certs_command
from services.security.settings import CertsSettings
from tests.drives import EXACT, drives
from tests.faults.clusters import results_of
from tests.object_store import object_store, read_only, use_keys

QUICK = ("--method", "least-squares")


def output(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str]:
    code = cli.main([str(one) for one in arguments])
    return code, capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "line"),
    [
        (["--scheduler", "proceses"], "it must be processes, processes:N, tcp://HOST:PORT"),
        (["--scheduler", "processes:0"], "the number must be from 1 to 256"),
        (["--scheduler", "processes:x"], "the number must be from 1 to 256"),
        (["--scheduler", "tcp://127.0.0.1"], "it must be processes"),
        (["--scheduler", "tcp://127.0.0.1:99999"], "it must be processes"),
        (["--scheduler", "tcp://127.0.0.1:8786#@10.0.0.1:8786"], "it must be processes"),
        (["--scheduler", "tcp://somebody@127.0.0.1:8786"], "it must be processes"),
        (["--scheduler", "http://127.0.0.1:8786"], "it must be processes"),
        (["--scheduler", "tcp://10.0.0.1:8786"], "is another machine: without TLS anyone"),
        (["--scheduler", "tcp://scheduler:8786"], "is another machine"),
        (["--scheduler", "tls://127.0.0.1:8786"], "needs --tls FOLDER"),
        (["--batch", "5"], "--batch: belongs to a cluster"),
        (
            ["--scheduler", "processes", "--reconnect-timeout", "5"],
            "--reconnect-timeout: belongs to a cluster",
        ),
        (["--scheduler", "tcp://127.0.0.1:1", "--batch", "201"], "from 1 to 200"),
        (["--into", "s3://bucket/new"], "a folder of this machine is expected"),
        (["--into", "new", "--rrd", "x.rrd"], "--rrd: cannot be combined with --into"),
        (["--scheduler", "processes", "--draws", "x.npz"], "--draws"),
    ],
)
def test_what_is_refused_is_one_line(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, options: list[str], line: str
) -> None:
    code, err = output(capsys, "identify", EXACT, *options)
    assert (code, err.count("\n")) == (2, 1)
    assert line in err


def test_credentials_must_be_those_of_a_client(
    capsys: pytest.CaptureFixture[str], credentials: Path, tmp_path: Path
) -> None:
    certs = tmp_path / "certs"
    certs_command(CertsSettings(folder=certs, cluster=True))
    for folder in (credentials / "truck-1", certs / "scheduler", tmp_path / "none"):
        where = ("--scheduler", "tls://127.0.0.1:8786", "--tls", folder)
        code, err = output(capsys, "identify", EXACT, *where)
        assert (code, err.count("\n")) == (2, 1)
        assert str(folder) in err
    where = ("--scheduler", "tcp://127.0.0.1:8786", "--tls", certs / "client")
    assert "is an address without TLS" in output(capsys, "identify", EXACT, *where)[1]


def test_a_scheduler_that_does_not_answer_is_one_line(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with socket.socket() as taken:  # bound, and nobody listens
        taken.bind(("127.0.0.1", 0))
        address = f"tcp://127.0.0.1:{taken.getsockname()[1]}"
        where = ("--scheduler", address, "--reconnect-timeout", 1)
        code, err = output(capsys, "identify", EXACT, *QUICK, *where)
    assert (code, err.count("\n")) == (1, 1)
    assert f"{address}: no scheduler answers" in err


def test_missing_dask_names_the_install_command(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    find = importlib.util.find_spec
    monkeypatch.setattr(
        "services.common.extras.find_spec",
        lambda name: None if name == "distributed" else find(name),
    )
    scheduler = ["--scheduler", "tcp://127.0.0.1:8786"]
    for arguments in (["cluster"], ["identify", EXACT, *QUICK, *scheduler]):
        code, err = output(capsys, *arguments)
        assert (code, err.count("\n")) == (2, 1)
        assert install_command("cluster") in err
    assert cluster.BATCH == 50


def test_a_cluster_listens_here_only_unless_it_has_certificates(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    code, err = output(capsys, "cluster", "--listen", "0.0.0.0")  # noqa: S104 - it is refused
    assert (code, err.count("\n")) == (2, 1)
    assert "without TLS anyone who reaches it runs programs" in err
    code, err = output(capsys, "cluster", "--tls", tmp_path / "none")
    assert (code, err.count("\n")) == (2, 1)
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        code, err = output(capsys, "cluster", "--port", taken.getsockname()[1])
    assert (code, err.count("\n")) == (2, 1)
    assert "cannot listen at 127.0.0.1 port" in err


def test_a_folder_needs_a_place_for_its_results(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    drives(tmp_path / "recordings", 1)
    code, err = output(capsys, "identify", tmp_path / "recordings", *QUICK)
    assert (code, err.count("\n")) == (2, 1)
    assert "--into" in err


def test_a_folder_is_identified_by_its_catalogue_and_gone_on_with(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    folder, into = tmp_path / "recordings", tmp_path / "into"
    first, second, third = drives(folder, 3)
    update_catalog(folder_at(str(folder)))
    third.unlink()  # the catalogue does not know
    second.write_bytes(first.read_bytes())  # nor that
    (folder / "none.mcap").write_bytes(b"no recording")
    (folder / CATALOG / "bad.parquet").write_bytes(b"no rows")
    assert cli.main(["identify", str(folder), *QUICK, "--into", str(into)]) == EXIT_SOMETHING_LOST
    out = capsys.readouterr().out
    for path, line in (
        (third, "is gone"),
        (second, "its row is computed again"),
        (folder / "none.mcap", ""),
        (folder / CATALOG / "bad.parquet", "left out"),
    ):
        assert sum(f"{path}: " in one and line in one for one in out.splitlines()) == 1, out
    assert "1 crossing, 0 from earlier runs: 1 suspect" in out
    assert (into / BRIDGES).is_file()
    (folder / "none.mcap").unlink()
    (folder / CATALOG / "bad.parquet").unlink()
    drives(tmp_path / "later", 2)[1].rename(folder / "later.mcap")
    assert cli.main(["identify", str(folder), *QUICK, "--into", str(into)]) == 0
    assert "2 crossings, 1 from earlier runs: 2 suspect" in capsys.readouterr().out


def test_unwritable_output_is_refused_at_the_beginning(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    into = tmp_path / "into"
    (into / BRIDGES).mkdir(parents=True)
    code, err = output(capsys, "identify", EXACT, *QUICK, "--into", into)
    assert (code, err.count("\n")) == (2, 1)
    assert f"{into / BRIDGES}: is a folder" in err
    assert [path.name for path in into.iterdir()] == [BRIDGES]


@pytest.mark.xdist_group("object store")
def test_recordings_in_an_object_store_give_what_they_give_here(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A folder by its catalogue, and a recording by its address; site files are in them."""
    paths = drives(tmp_path / "recordings", 3)
    found = [tmp_path / f"{n}.json" for n in range(4)]
    here = ("identify", *paths, *QUICK, "--into", tmp_path / "here", "--json", found[0])
    assert output(capsys, *here) == (0, "")
    assert output(capsys, "identify", paths[0], *QUICK, "--json", found[1]) == (0, "")
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(temporary))
    with object_store(monkeypatch) as address:
        fleet = f"{address}/fleet"
        for path in paths:
            put(folder_at(fleet), f"day/{path.name}", path.read_bytes())
        there = ("identify", fleet, *QUICK, "--into", tmp_path / "there", "--json", found[2])
        assert output(capsys, *there) == (0, "")
        one = f"{fleet}/day/{paths[0].name}"
        assert output(capsys, "identify", one, *QUICK, "--json", found[3]) == (0, "")
        gone = f"{fleet}/day/gone.mcap"
        assert output(capsys, "identify", gone, *QUICK) == (2, f"driveby: {gone}: no such file\n")
        put(folder_at(fleet), "bad.mcap", b"no recording at all")
        bad = f"{fleet}/bad.mcap"
        code, err = output(capsys, "identify", bad, *QUICK)
        assert (code, err) == (
            2,
            f"driveby: {bad}: is not an MCAP file; a recording (.mcap) is expected\n",
        )
        assert output(capsys, "identify", fleet, *QUICK) == (
            2,
            f"driveby: {fleet}: is a folder; give recordings, or --into DIR for its results\n",
        )
        capsys.readouterr()
        assert cli.main([str(a) for a in there]) == EXIT_SOMETHING_LOST  # bad.mcap
        out = capsys.readouterr().out
        assert "3 crossings, 3 from earlier runs" in out
        assert sum(line.startswith(f"{bad}: ") for line in out.splitlines()) == 1
    assert list(temporary.iterdir()) == []
    whole, alone, from_there, one_from_there = map(results_of, found)
    assert from_there == whole
    assert one_from_there == alone


@pytest.mark.xdist_group("object store")
def test_bucket_that_may_only_be_read_is_identified(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A server that checks keys against a policy which allows GetObject and ListBucket only."""
    paths = drives(tmp_path / "recordings", 2)
    found = [tmp_path / f"{n}.json" for n in range(3)]
    here = ("identify", *paths, *QUICK, "--into", tmp_path / "here", "--json", found[0])
    assert output(capsys, *here) == (0, "")
    with object_store(monkeypatch) as address:
        fleet = f"{address}/fleet"
        for path in paths:
            put(folder_at(fleet), f"day/{path.name}", path.read_bytes())
        with read_only(monkeypatch):
            there = ("identify", fleet, *QUICK, "--into", tmp_path / "there", "--json", found[1])
            code, err = output(capsys, *there)
            assert (code, err.count("\n")) == (0, 1), err
            assert f"{fleet}: cannot write its catalogue" in err
            single = f"{fleet}/day/{paths[0].name}"
            assert output(capsys, "identify", single, *QUICK, "--json", found[2]) == (0, "")
            code, err = output(capsys, "catalog", fleet)  # whose work is to write it
            assert (code, err.count("\n")) == (1, 1)
            assert "could not be written: Access Denied" in err
            names = [entry.name for entry in files_below(folder_at(fleet), "")]
    assert names == [f"day/{path.name}" for path in sorted(paths)]
    whole, from_there, one = map(results_of, found)
    assert from_there == whole
    assert one["crossings"] == whole["crossings"][:1]


@pytest.mark.xdist_group("object store")
def test_wrong_keys_of_a_store_are_one_line(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (path,) = drives(tmp_path / "recordings", 1)
    with object_store(monkeypatch) as address:
        fleet = f"{address}/fleet"
        put(folder_at(fleet), path.name, path.read_bytes())
        with read_only(monkeypatch):
            key = os.environ["AWS_ACCESS_KEY_ID"]
            for key_id, why in ((key, "signature"), ("AKIAXXXXXXXXXXXXXXXX", "does not exist")):
                use_keys(monkeypatch, key_id, "not the secret")
                for source in (fleet, f"{fleet}/{path.name}"):
                    for options in ((), ("--into", tmp_path / "into")):
                        code, err = output(capsys, "identify", source, *QUICK, *options)
                        assert (code, err.count("\n")) == (2, 1), err
                        assert err.startswith(f"driveby: {source}: cannot be read: "), err
                        assert why in err
    assert list((tmp_path / "into").iterdir()) == []
