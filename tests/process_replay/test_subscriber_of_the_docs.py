"""The subscriber shown in docs/topics.md receives a truck, also when it comes late."""

import re
import subprocess
import sys
from pathlib import Path
from threading import Timer

import pytest

from tests.process_replay.starting import Start, start_logger

pytestmark = pytest.mark.process


def test_it_receives_a_truck(
    start: Start,
    endpoint: str,
    recording: Path,
    tmp_path: Path,
    project: Path,
) -> None:
    text = (project / "docs" / "topics.md").read_text()
    code = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    assert len(code) == 1
    file = tmp_path / "subscriber.py"
    file.write_text(code[0])
    start_logger(start, endpoint, tmp_path / "live.mcap")
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
    watchdog = Timer(30, subscriber.kill)
    watchdog.start()
    try:
        assert subscriber.stdout is not None
        expected = {"info", "accel", "gnss", "location", "durable"}
        for line in subscriber.stdout:
            found = re.fullmatch(r"live (truck-1|logger) ([a-z]+) \d+ bytes\n", line)
            assert found, line
            expected.discard(found[2])
            if not expected:
                break
        assert not expected
    finally:
        watchdog.cancel()
        subscriber.kill()
        subscriber.communicate()
