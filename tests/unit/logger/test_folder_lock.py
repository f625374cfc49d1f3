"""Two loggers in one folder would delete and recover each other's recordings."""

import os
import re
from pathlib import Path

import pytest

from services.common.errors import InputError
from services.logger import run as logger
from services.logger.folder_lock import LOCK, locked_folder
from services.logger.settings import LoggerSettings


def test_second_logger_in_a_folder_is_refused(tmp_path: Path, endpoint: str) -> None:
    folder = tmp_path / "recordings"
    line = f"{folder}: another logger (process {os.getpid()}) records here; stop it first"
    asked = LoggerSettings(listen=endpoint, folder=folder, min_free=0.0)
    with locked_folder(folder), pytest.raises(InputError, match=re.escape(line)):
        logger.run(asked)


def test_lock_ends_with_its_logger(tmp_path: Path) -> None:
    for _ in range(2):
        with locked_folder(tmp_path):
            assert (tmp_path / LOCK).read_text() == str(os.getpid())
