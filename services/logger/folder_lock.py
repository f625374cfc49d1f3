"""The lock of a folder of recordings, which one logger at a time holds."""

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from services.common.files import lock_folder

LOCK: Final = ".logger.lock"
_LONGEST_PID: Final = 20
_REMEDY: Final = "stop it first, or give this one another --folder"


@contextlib.contextmanager
def locked_folder(folder: Path) -> Iterator[None]:
    """Hold the lock of a folder; raise InputError, with the other's process, if one has it."""
    lock = lock_folder(folder, LOCK, f"another logger ({_holder(folder)}) records here; {_REMEDY}")
    try:
        with contextlib.suppress(OSError):  # a lock file of another user is readable only
            os.ftruncate(lock, 0)
            os.write(lock, str(os.getpid()).encode())
        yield
    finally:
        os.close(lock)


def _holder(folder: Path) -> str:
    """Return the process that the lock file names."""
    with contextlib.suppress(OSError), (folder / LOCK).open("rb") as file:
        pid = file.read(_LONGEST_PID)
        if pid.isdigit():
            return f"process {pid.decode()}"
    return "its process is unknown"
