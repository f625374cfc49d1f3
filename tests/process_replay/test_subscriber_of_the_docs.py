"""The subscriber shown in docs/programmer.md receives a truck, also when it comes late."""

import re
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from threading import Timer

import pytest

from schemas.results import ResultHeader
from schemas.results_on_the_wire import crossing_to_protobuf
from schemas.site_file import load_site
from services.bus.publisher import Publisher
from services.bus.session import open_session
from tests.process_replay.starting import Start, start_logger
from tests.unit.viewer.found import results_of, some_crossing
from tests.waiting import LONGEST_S

pytestmark = pytest.mark.process


@pytest.fixture
def stack() -> Iterator[ExitStack]:
    with ExitStack() as stack:
        yield stack


def written(project: Path, folder: Path) -> Path:
    """The subscriber of the page as a file."""
    text = (project / "docs" / "programmer.md").read_text()
    code = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    assert len(code) == 1
    file = folder / "subscriber.py"
    file.write_text(code[0])
    return file


def subscribe(project: Path, file: Path, *arguments: object) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, str(file), *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={"PYTHONPATH": str(project)},
    )


def test_subscriber_receives_results_over_tls(
    credentials: Path, tls_endpoint: str, tmp_path: Path, project: Path, stack: ExitStack
) -> None:
    """With the arguments of the page, but for the address."""
    text = (project / "docs" / "programmer.md").read_text()
    (shown,) = re.findall(r"subscriber.py tls/\S+ '(\S+)' certs/([a-z]+)", text)
    stack.enter_context(open_session(listen=tls_endpoint, tls=credentials / "logger"))
    worker = stack.enter_context(
        open_session(connect=tls_endpoint, timeout_s=LONGEST_S, tls=credentials / "worker")
    )
    publisher = Publisher(worker, "live")
    stack.callback(publisher.close)
    publisher.put("bridge", "bridge-1", "state", b"")
    file = written(project, tmp_path)
    process = subscribe(project, file, tls_endpoint, shown[0], credentials / shown[1])
    watchdog = Timer(LONGEST_S, process.kill)
    watchdog.start()
    try:
        assert process.stdout is not None
        assert process.stdout.readline() == "live bridge-1 state\n"
    finally:
        watchdog.cancel()
        process.kill()
        process.communicate()


def test_subscriber_ends_with_one_line_on_a_wrong_folder(tmp_path: Path, project: Path) -> None:
    folder = tmp_path / "none"
    file = written(project, tmp_path)
    process = subscribe(project, file, "tls/127.0.0.1:1", "driveby/v1/*/bridge/**", folder)
    _, log = process.communicate(timeout=LONGEST_S)
    assert process.returncode == 1
    assert len(log.splitlines()) == 1
    assert log.startswith(f"{folder}/cert.pem: ")


def test_it_receives_a_truck_and_prints_its_result(
    start: Start,
    endpoint: str,
    recording: Path,
    tmp_path: Path,
    project: Path,
    stack: ExitStack,
) -> None:
    file = written(project, tmp_path)
    start_logger(start, endpoint, tmp_path / "live.mcap")
    bus = stack.enter_context(open_session(connect=endpoint, timeout_s=LONGEST_S))
    found = results_of(load_site(project / "docs/site.example.toml"), some_crossing("a"))
    message = crossing_to_protobuf(found.crossings[0], ResultHeader("0.1.0", 1.79e9, "hash", {}, 1))
    publisher = Publisher(bus, "live")
    for _ in range(2):  # as a worker does that starts again
        publisher.put("bridge", "bridge-1", "estimate", message.SerializeToString())
    start(
        "services.truck",
        recording=recording,
        endpoint=endpoint,
        realm="live",
        speed=5.0,
        vehicle=None,
    )
    subscriber = subprocess.Popen(
        [sys.executable, str(file), endpoint, "driveby/v1/**"],
        stdout=subprocess.PIPE,
        text=True,
        env={"PYTHONPATH": str(project)},
    )
    watchdog = Timer(LONGEST_S, subscriber.kill)
    watchdog.start()
    try:
        assert subscriber.stdout is not None
        estimates = 0
        expected = {"info", "accel", "gnss", "location", "durable", "estimate"}
        for line in subscriber.stdout:
            shown = re.fullmatch(r"live (truck-1|logger|bridge-1) ([a-z]+)(.*)\n", line)
            assert shown, line
            expected.discard(shown[2])
            if shown[2] == "estimate":
                assert shown[3].count(" EI_") == 7
                assert shown[3].endswith(" (1 results)")
                estimates += 1
                assert " EI_4 5.88e+09 to 6.61e+09 EI_5 " in shown[3]
            else:
                assert not shown[3]
            if not expected and estimates == 2:
                break
        assert not expected
    finally:
        publisher.close()
        watchdog.cancel()
        subscriber.kill()
        subscriber.communicate()
