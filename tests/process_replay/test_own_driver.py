"""The driver shown in docs/examples is recorded."""

import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from schemas.signals import decode_accel
from schemas.topics import selector
from services.bus.session import open_session
from services.bus.subscription import Subscription
from services.recordings.recording import read_messages
from tests.waiting import LONGEST_S, until

pytestmark = pytest.mark.process


def test_it_is_recorded(
    start: Callable[..., subprocess.Popen[str]],
    terminate: Callable[[subprocess.Popen[str]], None],
    endpoint: str,
    tmp_path: Path,
    project: Path,
) -> None:
    file = tmp_path / "live.mcap"
    logger = start(
        "services.logger", listen=endpoint, folder=tmp_path, file=file, realms=("*",), site=None
    )
    driver = subprocess.Popen(
        [
            sys.executable,
            str(project / "docs" / "examples" / "own_driver.py"),
            endpoint,
            str(tmp_path / "spool"),
        ],
        env=os.environ | {"PYTHONPATH": str(project)},
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        batches = 0

        def has_driven() -> bool:
            nonlocal batches
            batches += heard.receive(0.1) is not None
            return batches >= 10

        with (
            open_session(connect=endpoint, timeout_s=LONGEST_S) as session,
            Subscription(session, selector(None, "vehicle", "accel")) as heard,
        ):
            until(has_driven, "ten batches of the driver")
        driver.send_signal(signal.SIGINT)
        _, log = driver.communicate(timeout=LONGEST_S)
    finally:
        driver.kill()
        driver.wait()
    assert driver.returncode == 0, log
    assert log == ""
    terminate(logger)
    streams: dict[str, list[int]] = {}
    for message in read_messages(file):
        streams.setdefault(message.key.stream, []).append(message.sequence)
    assert len(streams["accel"]) >= 10
    assert streams["info"] == [0]
    for numbers in streams.values():
        assert sorted(numbers) == list(range(len(numbers)))
    batch = next(m for m in read_messages(file) if m.key.stream == "accel")
    assert set(decode_accel(batch.payload).channels) == {"sprung_front", "unsprung_rear"}
    assert list((tmp_path / "spool").glob("*.spool")) == []  # all of it is on the logger's disk
