"""Recordings and folders in a real S3 server, which is killed, and refuses keys.

The server is OpenStack Swift; the first lines of s3_server.py install it.

SWIFT=…/bin pytest tests/containers/test_s3.py -m containers
"""

import os
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.builders.commands import Ended
from tests.containers import s3_server
from tests.containers.s3_server import S3Server
from tests.containers.stack import ROOT
from tests.drives import drives
from tests.faults.clusters import results_of

pytestmark = [pytest.mark.containers, pytest.mark.process, pytest.mark.timeout(3600)]

COMMAND = "import sys; from services.cli.main import main; sys.exit(main(sys.argv[1:]))"
QUICK = ("--method", "least-squares")
LARGE_BYTES = 1_000_000_000


def run(*words: object, env: dict[str, str]) -> Ended:
    done = subprocess.run(
        [sys.executable, "-c", COMMAND, *map(str, words)],
        env={**os.environ, **env},
        capture_output=True,
        text=True,
        check=False,
    )
    return Ended(done.returncode, done.stdout, done.stderr)


@pytest.fixture(scope="module")
def server() -> Iterator[S3Server]:
    programs = s3_server.find()
    if programs is None:
        pytest.skip("no Swift for containers: the first lines of s3_server.py install it")
    with s3_server.s3_server(programs) as started:
        python(started, "import s3fs; s3fs.S3FileSystem().mkdir('bucket')")
        yield started


def python(server: S3Server, program: str, *words: object) -> str:
    """Run a program with the keys of the bucket's owner; return what it prints."""
    return subprocess.run(
        [sys.executable, "-c", program, *map(str, words)],
        env={**os.environ, **server.environment()},
        check=True,
        stdout=subprocess.PIPE,
        text=True,
    ).stdout


def upload(server: S3Server, path: Path, to: str) -> None:
    """Copy a file into the bucket by s3fs, which sends a large one in parts."""
    program = "import sys, s3fs; s3fs.S3FileSystem().put_file(*sys.argv[1:])"
    python(server, program, path, f"bucket/{to}/{path.name}")


def names_below(server: S3Server, folder: str) -> list[str]:
    program = "import sys, s3fs; print(*s3fs.S3FileSystem().find(sys.argv[1]), sep='\\n')"
    return python(server, program, f"bucket/{folder}").splitlines()


def allow_everyone_to_read(server: S3Server) -> None:
    acl = "import boto3; boto3.client('s3').put_bucket_acl(Bucket='bucket', ACL='public-read')"
    python(server, acl)


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return drives(tmp_path_factory.mktemp("small"), 1)[0]


@pytest.fixture(scope="module")
def large(server: S3Server, small: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A gigabyte in parts: a recording that nothing but its beginning is read of."""
    path = tmp_path_factory.mktemp("large") / "large.mcap"
    shutil.copy(small, path)
    os.truncate(path, LARGE_BYTES)
    began_s = time.monotonic()
    upload(server, path, "large")
    print(f"\n{LARGE_BYTES / 1e6:.0f} MB uploaded in {time.monotonic() - began_s:.0f} s")
    size = "import sys, s3fs; print(s3fs.S3FileSystem().size(sys.argv[1]))"
    assert int(python(server, size, f"bucket/large/{path.name}")) == LARGE_BYTES
    return path


def test_recording_in_a_bucket_gives_what_it_gives_here(
    server: S3Server, small: Path, tmp_path: Path
) -> None:
    upload(server, small, "day")
    env = server.environment()
    found = [tmp_path / f"{number}.json" for number in range(2)]
    for source, path in zip((small, f"s3://bucket/day/{small.name}"), found, strict=True):
        ended = run("identify", source, *QUICK, "--json", path, env=env)
        assert (ended.code, ended.err) == (0, "")
    here, there = map(results_of, found)
    assert len(here["crossings"]) == 1
    assert there == here


def test_folder_in_a_bucket_gives_what_it_gives_here(server: S3Server, tmp_path: Path) -> None:
    """Its catalogue, results and history; with keys that may only read, nothing is written."""
    paths = drives(tmp_path / "recordings", 3)
    for path in paths:
        upload(server, path, "fleet/day")
    fleet, site = "s3://bucket/fleet", ROOT / "docs" / "site.example.toml"
    found = [tmp_path / f"{number}.json" for number in range(3)]
    histories = [tmp_path / name for name in ("history", "read-only", "catalogued")]
    allow_everyone_to_read(server)
    env, reader = server.environment(), server.environment(s3_server.READER)

    def compare(source: object, number: int, env: dict[str, str]) -> Ended:
        into, history = tmp_path / f"into-{number}", histories[number]
        ended = run("identify", source, *QUICK, "--into", into, "--json", found[number], env=env)
        assert ended.code == 0, ended
        assert run("history", "add", into, "--history", history, env=env).code == 0
        return ended

    compare(paths[0].parent, 0, env)
    ended = compare(fleet, 1, reader)
    assert ended.err.count("\n") == 1
    assert f"{fleet}: cannot write its catalogue" in ended.err
    before = [f"bucket/fleet/day/{path.name}" for path in sorted(paths)]
    assert names_below(server, "fleet") == before
    ended = run("catalog", fleet, env=reader)
    assert (ended.code, ended.err.count("\n")) == (1, 1), ended
    assert "could not be written: Access Denied" in ended.err
    first, again = (run("catalog", fleet, "--site", site, env=env) for _ in range(2))
    assert (first.code, first.err, again.code, again.err) == (0, "", 0, "")
    assert "3 recordings (3 new to the catalogue)" in first.out, first.out
    assert "3 recordings (0 new to the catalogue)" in again.out, again.out
    assert first.out.count(" over bridge-1, start to end") == len(paths), first.out
    assert len(names_below(server, "fleet")) > len(before)
    assert compare(fleet, 2, env).err == ""
    here, *there = map(results_of, found)
    assert len(here["crossings"]) == 3
    assert there == [here, here]
    shown = [run("history", "--history", history, env=env).out for history in histories]
    assert "sim-drive  bridge-1  3 " in shown[0], shown[0]
    assert shown[1:] == [shown[0], shown[0]]


def test_server_killed_in_the_middle_of_a_gigabyte_is_one_line(
    server: S3Server, large: Path, small: Path, tmp_path: Path
) -> None:
    """Once the server is there again, it is read as before."""
    upload(server, small, "killed")
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    env = {**server.environment(), "TMPDIR": str(temporary)}
    enough = server.bytes_read() + LARGE_BYTES // 4
    is_over = threading.Event()

    def kill() -> None:
        while not is_over.wait(0.01) and server.bytes_read() < enough:
            pass
        server.kill()

    killer = threading.Thread(target=kill)
    killer.start()
    source = f"s3://bucket/large/{large.name}"
    ended = run("identify", source, *QUICK, env=env)
    is_over.set()
    killer.join()
    print(f"\n{ended.err}")
    assert (ended.code, ended.err.count("\n")) == (2, 1), ended
    assert ended.err.startswith(f"driveby: {source}: cannot be re"), ended.err
    assert list(temporary.iterdir()) == []
    server.start()
    again = run("identify", f"s3://bucket/killed/{small.name}", *QUICK, env=env)
    assert (again.code, again.err) == (0, "")


@pytest.mark.parametrize("keys", [("driveby", "another secret"), ("nobody", "nothing")])
def test_wrong_keys_of_the_server_are_one_line(
    server: S3Server, small: Path, keys: tuple[str, str]
) -> None:
    upload(server, small, "keys")
    source = f"s3://bucket/keys/{small.name}"
    for command, *options in (("identify", *QUICK), ("catalog",)):
        ended = run(command, source, *options, env=server.environment(*keys))
        assert (ended.code, ended.err.count("\n")) == (2, 1), ended
        assert ended.err.startswith(f"driveby: {source}: cannot be read: "), ended.err
