"""Recordings are checked before they are published."""

import fcntl
from pathlib import Path

import pytest

from services.replay.choice import ReplaySelection
from services.replay.drive import open_drive


def test_a_recording_that_is_being_written_is_not_called_damaged(
    project: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "drive.mcap"
    path.write_bytes((project / "recordings/sample/crossing.mcap").read_bytes()[:-100])
    for is_written, state in ((True, "being written"), (False, "damaged")):
        caplog.clear()
        with path.open("r+b") as writer:
            if is_written:
                fcntl.flock(writer, fcntl.LOCK_EX)
            open_drive([path], "replay-a", ReplaySelection(), None)
        assert f"{path}: {state}, only its intact chunks are replayed" in caplog.messages
