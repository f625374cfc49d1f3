"""Clusters of real processes, and identifications on them as processes that can be killed."""

import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from schemas.results import load_results
from services.common.parquet_files import decoded
from services.execution.result_store import FORMAT_VERSION, KEY, files_of
from tests import prepared
from tests.endpoints import free_port
from tests.parent import parent_environment
from tests.waiting import LONGEST_S, until

COMMAND = Path(__file__).parent / "command.py"
PROJECT = Path(__file__).parents[2]


class Running(NamedTuple):
    """A command that runs, and what it says."""

    process: subprocess.Popen[str]
    log: Path

    def output(self) -> str:
        return self.log.read_text()

    def wait(self) -> int:
        return self.process.wait(LONGEST_S)


class RunningCluster(NamedTuple):
    address: str
    command: Running

    def pids(self, name: str) -> list[int]:
        """Of a process by its name, the newest last."""
        return [int(n) for n in re.findall(rf"{name} is process (\d+)", self.command.output())]


def start(log: Path, *arguments: str, env: dict[str, str] | None = None) -> Running:
    with log.open("w") as file:
        process = prepared.Popen(
            [sys.executable, str(COMMAND), *arguments],
            stdout=file,
            stderr=subprocess.STDOUT,
            cwd=log.parent,
            env=os.environ | {"PYTHONPATH": str(PROJECT)} | parent_environment() | (env or {}),
        )
    return Running(process, log)


@contextmanager
def cluster(
    folder: Path, *options: str, scheme: str = "tcp", env: dict[str, str] | None = None
) -> Iterator[RunningCluster]:
    """`driveby cluster`, ready; it must end well."""
    port = free_port()
    running = start(
        folder / f"cluster-{port}.log",
        "cluster",
        "--port",
        str(port),
        "--workers",
        "2",
        *options,
        env=env,
    )
    try:
        until(lambda: "ready: " in running.output() or running.process.poll() is not None)
        assert running.process.poll() is None, running.output()
        yield RunningCluster(f"{scheme}://127.0.0.1:{port}", running)
        assert running.process.poll() is None, running.output()
    finally:
        running.process.send_signal(signal.SIGTERM)
        code = running.wait()
    assert code == 0, running.output()


def contents(into: Path) -> list[str]:
    """What the results of a folder were made from, one for each row of each file."""
    return [
        content
        for path in files_of(into)
        for content in decoded(path, KEY, FORMAT_VERSION, ["content"])["content"].to_pylist()
    ]


def results_of(path: Path) -> dict[str, Any]:
    """A results file without what may differ between two runs: when, and how long it took."""
    published = load_results(path).model_dump(mode="json")
    del published["created"]
    for crossing in published["crossings"]:
        crossing["diagnostics"].pop("seconds", None)
    return published


def of(recordings: Sequence[Path], *options: str) -> list[str]:
    """The arguments of an identification by least squares."""
    return ["identify", *map(str, recordings), "--method", "least-squares", *options]


def computing(worker: int) -> list[int]:
    """The processes that compute for a process."""
    found = []
    for path in Path("/proc").glob("[0-9]*"):
        try:
            parent = int((path / "stat").read_text().rpartition(")")[2].split()[1])
            is_one = parent == worker and b"spawn_main" in (path / "cmdline").read_bytes()
        except (OSError, ValueError, IndexError):
            continue  # it has just ended
        if is_one:
            found.append(int(path.name))
    return found


@contextmanager
def other_worker(address: str, folder: Path, preload: Path) -> Iterator[str]:
    """A worker that is started as on any machine, with something changed; its address."""
    log = folder / "other.log"
    port = free_port()
    with log.open("w") as file:
        process = subprocess.Popen(
            [
                *(
                    sys.executable,
                    "-m",
                    "services.common.child_process",
                    "distributed.cli.dask_worker",
                ),
                *(address, "--no-nanny", "--nthreads", "1", "--host", "127.0.0.1"),
                *("--worker-port", str(port), "--preload", str(preload)),
                *("--no-dashboard", "--dashboard-address", "127.0.0.1:0"),
                *("--local-directory", str(folder)),
            ],
            stdin=subprocess.PIPE,
            stdout=file,
            stderr=subprocess.STDOUT,
            text=True,
            cwd=PROJECT,
        )
    own = f"tcp://127.0.0.1:{port}"
    try:
        until(lambda: f"Registered to: {address}" in re.sub(" +", " ", log.read_text()))
        yield own
    finally:
        assert process.stdin is not None
        process.stdin.close()
        process.wait(LONGEST_S)
