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


def is_virtual(folder: Path) -> bool:
    """Return whether the file system of a folder has no room at all, as /proc."""
    return shutil.disk_usage(_existing(folder)).total == 0


def _free_bytes(folder: Path) -> int:
    return shutil.disk_usage(_existing(folder)).free


def _existing(folder: Path) -> Path:
    """Return the folder, or its nearest parent that exists."""
    while not folder.exists() and folder != folder.parent:
        folder = folder.parent
    return folder


DISK = Disk(
    create=lambda path: path.open("xb", buffering=0),
    sync=lambda descriptor: os.fsync(descriptor),
    sync_folder=sync,
    free_bytes=_free_bytes,
)
