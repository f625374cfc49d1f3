"""`driveby watch` as a process: line by line into a pipe, as a page on a terminal."""

import os
import pty
import re
import select
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from schemas.proto import driveby_pb2 as pb
from schemas.results import ResultHeader
from schemas.results_on_the_wire import crossing_to_protobuf
from schemas.site_file import load_site
from services.bus.publisher import Publisher
from services.bus.session import open_session
from tests.process_replay.starting import Start, start_logger
from tests.unit.cli.watching import result
from tests.waiting import LONGEST_S

pytestmark = pytest.mark.process
COMMAND = [sys.executable, "-m", "driveby", "watch", "--endpoint"]
LINE = re.compile(r"\d\d:\d\d:\d\d (.*)\n")


@pytest.fixture
def publisher(start: Start, endpoint: str, tmp_path: Path) -> Iterator[Publisher]:
    start_logger(start, endpoint, tmp_path / "live.mcap")
    with open_session(connect=endpoint, timeout_s=LONGEST_S) as bus:
        publisher = Publisher(bus, "live")
        yield publisher
        publisher.close()


def print_result(publisher: Publisher, project: Path) -> None:
    crossing = result(load_site(project / "docs/site.example.toml"), "a")
    message = crossing_to_protobuf(crossing, ResultHeader("0.1.0", 1.79e9, "hash", {}, 1))
    publisher.put("bridge", "bridge-1", "estimate", message.SerializeToString())


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_lines_into_a_pipe(
    publisher: Publisher, endpoint: str, project: Path, number: signal.Signals
) -> None:
    print_result(publisher, project)  # before it looks
    watch = subprocess.Popen(
        [*COMMAND, endpoint], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    try:
        assert watch.stdout is not None
        wanted = (
            "truck-1 → bridge-1, entry 2026-09-21 14:13:20: "
            "good, lowest EI_4 0.400 of nominal (95 % interval 0.377 to 0.424)"
        )
        for output in watch.stdout:
            found = LINE.fullmatch(output)
            assert found, output
            assert "\x1b" not in output
            if found[1] == wanted:
                break
        else:
            pytest.fail(f"it ended: {watch.communicate()[1]}")
        watch.send_signal(number)
        _, err = watch.communicate(timeout=LONGEST_S)
        assert (watch.returncode, err) == (0, "")
    finally:
        watch.kill()
        watch.communicate()


def test_killed_services_are_lines(start: Start, endpoint: str, tmp_path: Path) -> None:
    logger = start_logger(start, endpoint, tmp_path / "live.mcap")
    with open_session(connect=endpoint, timeout_s=LONGEST_S) as bus:
        publisher = Publisher(bus, "live")
        health = pb.Health(schema_version=1, time_ns=time.time_ns(), service="worker", ok=True)
        publisher.put("service", "worker", "health", health.SerializeToString())
        watch = subprocess.Popen([*COMMAND, endpoint], stdout=subprocess.PIPE, text=True)
        assert watch.stdout is not None
        lines = (output[9:].rstrip() for output in watch.stdout)
        next(one for one in lines if one == "worker is well")
    try:
        next(one for one in lines if one == "worker is silent")
        logger.kill()
        next(one for one in lines if one == "connection to the router lost")
        start_logger(start, endpoint, tmp_path / "again.mcap")
        next(one for one in lines if one == "connected again")
    finally:
        watch.kill()
        watch.communicate()


def test_wrong_realm_is_reported(publisher: Publisher, endpoint: str) -> None:
    publisher.put("vehicle", "truck-1", "info", b"")
    watch = subprocess.Popen(
        [*COMMAND, endpoint, "--realm", "sim-x"], stdout=subprocess.PIPE, text=True
    )
    try:
        assert watch.stdout is not None
        found = LINE.fullmatch(watch.stdout.readline())
        assert found
        assert found[1] == "nothing in realm sim-x, but truck-1 in live; use --realm live"
    finally:
        watch.kill()
        watch.communicate()


def test_a_page_on_a_terminal(publisher: Publisher, endpoint: str, project: Path) -> None:
    print_result(publisher, project)
    ours, theirs = pty.openpty()
    own = {**os.environ, "TERM": "xterm", "COLUMNS": "80", "LINES": "24"}
    watch = subprocess.Popen([*COMMAND, endpoint], stdout=theirs, stderr=theirs, env=own)
    os.close(theirs)
    try:
        text = ""
        deadline = time.monotonic() + LONGEST_S
        while "EI_4 0.40 (0.38–0.42)" not in text:
            assert time.monotonic() < deadline, text
            if select.select([ours], [], [], 1.0)[0]:
                text += os.read(ours, 65536).decode(errors="replace")
        assert text.count("▆") >= 6
        assert "\x1b[" in text  # drawn over itself
        watch.send_signal(signal.SIGINT)
        while select.select([ours], [], [], 0.1)[0] or watch.poll() is None:
            try:
                text += os.read(ours, 65536).decode(errors="replace")
            except OSError:  # the other end is closed
                break
        assert watch.wait(timeout=LONGEST_S) == 0
        assert text.rstrip().endswith("\x1b[?25h")  # the cursor is shown again
        assert "Traceback" not in text
    finally:
        watch.kill()
        watch.wait()
        os.close(ours)
