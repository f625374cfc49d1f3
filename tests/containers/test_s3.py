"""Recordings by their addresses in a real S3 server, which is killed, and refuses wrong keys.

s3s-fs 0.14.1 lists nothing where a request names an empty delimiter, as those of s3fs do: folders
in a bucket are tested with moto alone.

cargo install s3s-fs --version 0.14.1 --locked --features binary --root build/containers
S3S_FS=…/s3s-fs pytest tests/containers/test_s3.py -m containers
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
    program = s3_server.find()
    if program is None:
        pytest.skip("no s3s-fs for containers: the first lines of test_s3.py build it")
    with s3_server.s3_server(program) as started:
        yield started


def upload(server: S3Server, path: Path, to: str) -> None:
    """Copy a file into the bucket by s3fs, which sends a large one in parts."""
    program = "import sys, s3fs; s3fs.S3FileSystem().put_file(*sys.argv[1:])"
    subprocess.run(
        [sys.executable, "-c", program, str(path), f"bucket/{to}/{path.name}"],
        env={**os.environ, **server.environment()},
        check=True,
    )


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
    assert (server.bucket / "large" / path.name).stat().st_size == LARGE_BYTES
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
