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


def test_it_receives_a_truck_and_prints_its_result(
    start: Start,
    endpoint: str,
    recording: Path,
    tmp_path: Path,
    project: Path,
    stack: ExitStack,
) -> None:
    text = (project / "docs" / "programmer.md").read_text()
    code = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    assert len(code) == 1
    file = tmp_path / "subscriber.py"
    file.write_text(code[0])
    start_logger(start, endpoint, tmp_path / "live.mcap")
    bus = stack.enter_context(open_session(connect=endpoint, timeout_s=LONGEST_S))
    found = results_of(load_site(project / "docs/site.example.toml"), some_crossing("a"))
    message = crossing_to_protobuf(found.crossings[0], ResultHeader("0.1.0", 1.79e9, "hash", {}, 1))
    publisher = Publisher(bus, "live")
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
        [sys.executable, str(file), endpoint],
        stdout=subprocess.PIPE,
        text=True,
        env={"PYTHONPATH": str(project)},
    )
    watchdog = Timer(LONGEST_S, subscriber.kill)
    watchdog.start()
    try:
        assert subscriber.stdout is not None
        expected = {"info", "accel", "gnss", "location", "durable", "estimate"}
        for line in subscriber.stdout:
            shown = re.fullmatch(r"live (truck-1|logger|bridge-1) ([a-z]+)(.*)\n", line)
            assert shown, line
            expected.discard(shown[2])
            if shown[2] == "estimate":
                assert shown[3].count(" EI_") == 7
                assert " EI_4 5.88e+09 to 6.61e+09 EI_5 " in shown[3]
            else:
                assert not shown[3]
            if not expected:
                break
        assert not expected
    finally:
        publisher.close()
        watchdog.cancel()
        subscriber.kill()
        subscriber.communicate()
