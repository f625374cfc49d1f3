"""Disk operations of recordings: the few calls that can fail, in one place."""

import errno
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple, Protocol

from services.common.files import sync


class RawFile(Protocol):
    """An unbuffered file opened for writing, as `open(path, "xb", buffering=0)` returns it."""

    def write(self, data: memoryview, /) -> int | None:
        """Write some of the data; return the number of bytes."""

    def truncate(self, size: int, /) -> int:
        """Truncate the file."""

    def seek(self, offset: int, /) -> int:
        """Move to an offset for the next write."""

    def fileno(self) -> int:
        """Return the descriptor."""

    def close(self) -> None:
        """Close the file."""


class Disk(NamedTuple):
    """The disk operations of a recording's writer. Each may raise OSError."""

    create: Callable[[Path], RawFile]
    """Create a new file; raise FileExistsError if it exists."""
    sync: Callable[[int], None]
    """Sync a file, by its descriptor, to the disk."""
    sync_folder: Callable[[Path], None]
    """Sync the names in a folder to the disk."""
    free_bytes: Callable[[Path], int]
    """Free space for this user on the disk of a folder."""


def write_all(file: RawFile, data: bytes) -> None:
    """Write all of the data, in as many calls as necessary; raise OSError if none is accepted."""
    view = memoryview(data)
    while view:
        taken = file.write(view)
        if not taken:
            raise OSError(errno.EIO, "the disk took no more bytes")
        view = view[taken:]


def _free_bytes(folder: Path) -> int:
    while not folder.exists() and folder != folder.parent:
        folder = folder.parent
    return shutil.disk_usage(folder).free


DISK = Disk(
    create=lambda path: path.open("xb", buffering=0),
    sync=lambda descriptor: os.fsync(descriptor),
    sync_folder=sync,
    free_bytes=_free_bytes,
)
