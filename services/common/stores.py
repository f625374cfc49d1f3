"""Folders on the local disk or in object storage, through fsspec: listing, ranges, whole files.

A file appears completely or not at all: locally it is written under another name, an object store
shows an object once its upload is complete. Nothing is ever changed in place.
"""

import errno
import logging
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, Final, NamedTuple

from services.common.errors import FailureError, InputError
from services.common.extras import check_installed, install_command
from services.common.files import check_readable_below, make_folder, write_atomically

if TYPE_CHECKING:
    from fsspec import AbstractFileSystem

READ_AHEAD_BYTES: Final = 64 * 1024
"""Read-ahead of the length of a recording's chunk; more is wasted where chunks are skipped."""
_EXTRAS: Final = {"s3": ("s3fs", "s3"), "s3a": ("s3fs", "s3")}
"""Required package and extra of the program, by protocol."""
_NO_ROOM: Final = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


class Folder(NamedTuple):
    """A folder with its name and its file system."""

    name: str
    files: "AbstractFileSystem"
    root: str

    @property
    def is_local(self) -> bool:
        """Whether the folder is on a disk of this machine."""
        return "file" in _protocols(self.files)

    def path(self, name: str) -> str:
        """Return the path of a file in the folder."""
        return f"{self.root}/{name}" if name else self.root


class Entry(NamedTuple):
    """A file in a folder."""

    name: str
    """Path relative to the folder, with forward slashes."""
    size_bytes: int
    modified_ns: int
    """Time of the last change; 0 where the store does not provide it."""


def folder_at(name: str) -> Folder:
    """Return the folder of a path or of a URL such as s3://bucket/fleet.

    Raise InputError if the kind of store is unknown or its packages are not installed.
    """
    check_installed(name, "fsspec", extra="history")
    from fsspec.core import url_to_fs  # slow to import, seldom needed

    protocol = name.split("://", 1)[0] if "://" in name else "file"
    try:
        files, root = url_to_fs(name)
    except ImportError:
        package, extra = _EXTRAS.get(protocol, (f"a package of fsspec for {protocol}", ""))
        how = f": {install_command(extra)}" if extra else ""
        raise InputError(f"{name}: needs {package}, which is not installed{how}") from None
    except ValueError:
        raise InputError(
            f"{name}: no store is known as {protocol}://, give a folder or s3://BUCKET/FOLDER"
        ) from None
    logging.getLogger("asyncio").addFilter(_is_worth_logging)
    return Folder(name, files, str(root).rstrip("/"))


def _is_worth_logging(record: logging.LogRecord) -> bool:
    """Return False for aiohttp's record of an unclosed connection.

    A failed download leaves one for each connection, and has a line of its own.
    """
    return not record.getMessage().startswith("Unclosed c")


def check_folder(folder: Folder) -> None:
    """Raise InputError if the folder does not exist."""
    if not is_folder(folder):
        raise InputError(f"{folder.name}: no such folder")


def is_folder(folder: Folder) -> bool:
    """Return whether the folder exists; raise InputError if the store cannot be reached."""
    with _one_line_error(folder, ""):
        return bool(folder.files.isdir(folder.root))


def files_below(folder: Folder, suffix: str, below: str = "") -> list[Entry]:
    """Return the files below a folder with a suffix, in the order of their names; none hidden."""
    with _one_line_error(folder, below):
        top = folder.path(below)
        # An object store may cache an older listing.
        folder.files.invalidate_cache(top)
        if folder.is_local:
            check_readable_below(Path(top))
        try:
            found = folder.files.find(top, detail=True)
        except FileNotFoundError:
            return []
    entries = []
    for path, info in sorted(found.items()):
        name = str(path)[len(folder.root) + 1 :]
        if name.endswith(suffix) and not any(part[0] == "." for part in name.split("/") if part):
            # A float, which fsspec returns, cannot represent a time in ns.
            is_local = folder.is_local
            when_ns = Path(path).stat().st_mtime_ns if is_local else _modified_ns(info)
            entries.append(Entry(name, int(info.get("size") or 0), when_ns))
    return entries


@contextmanager
def opened(folder: Folder, name: str) -> Iterator[BinaryIO]:
    """Yield a file of the folder for reading ranges; raise InputError if it cannot be read."""
    kind: dict[str, Any] = {} if folder.is_local else {"cache_type": "readahead"}
    with (
        _one_line_error(folder, name),
        folder.files.open(folder.path(name), "rb", block_size=READ_AHEAD_BYTES, **kind) as file,
    ):
        yield file


def read(folder: Folder, name: str) -> bytes:
    """Return the content of a file; raise InputError if it cannot be read."""
    with _one_line_error(folder, name):
        content: bytes = folder.files.cat_file(folder.path(name))
        return content


def read_head(folder: Folder, name: str, most: int) -> bytes:
    """Return the first `most` bytes of a file; raise InputError if it cannot be read."""
    with _one_line_error(folder, name):
        content: bytes = folder.files.cat_file(folder.path(name), start=0, end=most)
        return content


def size_of(folder: Folder, name: str) -> int:
    """Return the size of a file in bytes; raise InputError if it cannot be read."""
    with _one_line_error(folder, name):
        return int(folder.files.size(folder.path(name)) or 0)


def fetch(folder: Folder, name: str, to: Path) -> None:
    """Copy a file of the folder to this machine.

    Raise InputError if it cannot be read or changes meanwhile; FailureError if there is no space.
    """
    size, where = size_of(folder, name), f"{folder.name.rstrip('/')}/{name}"
    free = shutil.disk_usage(to.parent).free
    if size > free:
        raise FailureError(_no_room(where, size, to) + f", which has {free / 1e6:.1f} MB left")
    with _one_line_error(folder, name):
        try:
            folder.files.get_file(folder.path(name), str(to))
        except OSError as error:
            if error.errno in _NO_ROOM:
                raise FailureError(f"{_no_room(where, size, to)}: {error.strerror}") from error
            raise
    if to.stat().st_size != size:
        raise InputError(f"{where}: has changed while it was copied")


def _no_room(where: str, size: int, to: Path) -> str:
    return f"{where}: {size / 1e6:.1f} MB do not fit in {to.parent.parent} (TMPDIR)"


def put(folder: Folder, name: str, content: bytes) -> bool:
    """Write a file completely; return False, without writing, if one of that name exists.

    Raise InputError if the place is not writable, FailureError if writing fails.
    """
    path = folder.path(name)
    if folder.is_local:
        local = Path(path)
        if local.exists():
            return False
        make_folder(local.parent)
        write_atomically(local, content)
        return True
    with _one_line_error(folder, name, is_written=True):
        if folder.files.exists(path):
            return False
        folder.files.pipe_file(path, content)
    return True


def remove(folder: Folder, name: str) -> None:
    """Remove a file; ignore one that is already gone."""
    with _one_line_error(folder, name, is_written=True):
        try:
            folder.files.rm_file(folder.path(name))
        except FileNotFoundError:
            return


@contextmanager
def _one_line_error(folder: Folder, name: str, *, is_written: bool = False) -> Iterator[None]:
    """Convert the errors of any store to one line."""
    where = f"{folder.name.rstrip('/')}/{name}" if name else folder.name
    try:
        yield
    except (InputError, FailureError):
        raise
    except FileNotFoundError:
        raise InputError(f"{where}: no such file") from None
    except OSError as error:
        reason = error.strerror or str(error) or type(error).__name__
        if is_written:
            raise FailureError(f"{where}: could not be written: {reason}") from error
        raise InputError(f"{where}: cannot be read: {reason}") from error
    except Exception as error:
        if folder.is_local:
            raise
        # Errors of botocore (no credentials, no such endpoint) are not OSErrors.
        raise InputError(f"{where}: cannot be reached: {error}") from error


def _modified_ns(info: dict[str, Any]) -> int:
    found = info.get("mtime", info.get("LastModified", info.get("created")))
    if isinstance(found, datetime):
        return round(found.timestamp() * 1e9)
    return round(found * 1e9) if isinstance(found, int | float) else 0


def _protocols(files: "AbstractFileSystem") -> tuple[str, ...]:
    protocol = files.protocol
    return (protocol,) if isinstance(protocol, str) else tuple(protocol)
