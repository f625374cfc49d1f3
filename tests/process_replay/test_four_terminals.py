"""The four terminals of the README, literally: what is typed there, and what is then seen."""

import contextlib
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import pytest

from services.bus.publisher import Publisher
from services.bus.session import open_session
from services.recordings.recording import read_messages, read_site
from tests.process_replay.starting import Start, start_logger
from tests.waiting import LONGEST_S, until

pytestmark = pytest.mark.process


def typed(project: Path) -> list[list[str]]:
    """The commands of the section, each as words."""
    section = (project / "README.md").read_text().split("\n## Live\n")[1].split("\n## ")[0]
    (block,) = re.findall(r"```sh\n(.*?)```", section, re.DOTALL)
    return [shlex.split(line) for line in block.splitlines()]


@contextlib.contextmanager
def terminals(folder: Path) -> Iterator[dict[str, subprocess.Popen[bytes]]]:
    started: dict[str, subprocess.Popen[bytes]] = {}
    try:
        yield started
    finally:
        for process in started.values():
            process.kill()
            process.wait()


def test_what_the_readme_says_happens(endpoint: str, project: Path, tmp_path: Path) -> None:
    """Only the address is added, so that it does not meet another bus of this machine."""
    shutil.copytree(project / "recordings/sample", tmp_path / "recordings/sample")
    (tmp_path / "docs").mkdir()
    shutil.copy(project / "docs/site.example.toml", tmp_path / "docs")
    commands = typed(project)
    assert [words[:2] for words in commands] == [
        [".venv/bin/driveby", name] for name in ("logger", "worker", "watch", "truck")
    ]
    own = {**os.environ, "PYTHONUNBUFFERED": "1", "PYTHONPATH": str(project)}
    with terminals(tmp_path) as started:

        def seen(name: str) -> str:
            return (tmp_path / f"{name}.log").read_text()

        def is_ready(name: str) -> bool:
            return "ready, " in seen(name)

        for _, name, *words in commands:
            where = "--listen" if name == "logger" else "--endpoint"
            line = [sys.executable, "-m", "driveby", name, *words, where, endpoint]
            with (tmp_path / f"{name}.log").open("wb") as log:
                started[name] = subprocess.Popen(
                    line, cwd=tmp_path, env=own, stdout=log, stderr=log
                )
            if name in ("logger", "worker"):
                until(partial(is_ready, name), f"the {name}")
        assert started["truck"].wait(timeout=LONGEST_S) == 0, seen("truck")
        lowest = r"good, lowest EI_4 0\.4\d\d of nominal \(95 % interval 0\.3\d\d to 0\.4\d\d\)\n"
        shown = rf"truck-1 → bridge-1, entry [\d: -]+: {lowest}"
        until(lambda: re.search(shown, seen("watch")), "the result")
        for state in ("truck-1 drives", "on the bridge", "complete", "identifying"):
            assert state in seen("watch")
        assert re.search(rf"truck-1\.bridge-1\.\S+Z: {lowest}", seen("worker"))
        for name in ("watch", "worker", "logger"):
            started[name].send_signal(signal.SIGINT)
            assert started[name].wait(timeout=LONGEST_S) == 0, seen(name)
        assert "stopped by a signal; 1 result in this run" in seen("worker")
    recorded = [*(tmp_path / "recordings/sim-first").glob("*/truck-1-*.mcap")]
    streams = {m.key.stream for path in recorded for m in read_messages(path)}
    assert {"accel", "gnss", "info", "estimate"} <= streams
    for path in recorded:  # else `identify` would ask for a site file
        assert read_site(path) == (tmp_path / "docs/site.example.toml").read_text()


def test_a_worker_in_the_wrong_realm_says_so(
    start: Start, endpoint: str, tmp_path: Path, project: Path
) -> None:
    start_logger(start, endpoint, tmp_path / "live.mcap")
    worker = start(
        "services.worker",
        endpoint=endpoint,
        realm="sim-one",
        site=project / "docs/site.example.toml",
        folder=tmp_path,
        file=None,
        method="least_squares",
        service_id="worker",
    )
    with open_session(connect=endpoint, timeout_s=LONGEST_S) as bus:
        publisher = Publisher(bus, "sim-two")
        publisher.put("vehicle", "truck-1", "info", b"")
        assert worker.stderr is not None
        output = ""
        while "nothing in realm" not in output:
            output = worker.stderr.readline()
            assert output, "it has ended"
        assert output.endswith(
            "nothing in realm sim-one, but truck-1 in sim-two; use --realm sim-two\n"
        )
        publisher.close()
