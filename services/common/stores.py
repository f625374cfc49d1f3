"""Folders on the local disk or in object storage, through fsspec: listing, ranges, whole files.

A file appears whole or not at all: locally it is written beside and renamed, an object store shows
an object when all of it has come. Nothing is ever changed in place.
"""

import errno
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, Final, NamedTuple

from services.common.errors import FailureError, InputError
from services.common.files import make_folder, write_atomically

if TYPE_CHECKING:
    from fsspec import AbstractFileSystem

READ_AHEAD_BYTES: Final = 64 * 1024
"""As long as a chunk of a recording: more would be fetched for nothing where chunks are skipped."""
_EXTRAS: Final = {"s3": ("s3fs", "s3"), "s3a": ("s3fs", "s3")}
"""By protocol: what it needs, and which extra of the program brings it."""
_NO_ROOM: Final = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


class Folder(NamedTuple):
    """A folder, as it was named and as it is reached."""

    name: str
    files: "AbstractFileSystem"
    root: str

    @property
    def is_local(self) -> bool:
        """Whether it is on a disk of this machine."""
        return "file" in _protocols(self.files)

    def path(self, name: str) -> str:
        """Where a file of the folder is."""
        return f"{self.root}/{name}" if name else self.root


class Entry(NamedTuple):
    """A file in a folder."""

    name: str
    """Relative to the folder, with forward slashes."""
    size_bytes: int
    modified_ns: int
    """0 where the store does not say."""


def folder_at(name: str) -> Folder:
    """The folder of a path or of a URL such as s3://bucket/fleet.

    InputError if the kind of store is not known, or what it needs is not installed.
    """
    from fsspec.core import url_to_fs  # slow to import, seldom needed

    protocol = name.split("://", 1)[0] if "://" in name else "file"
    try:
        files, root = url_to_fs(name)
    except ImportError:
        package, extra = _EXTRAS.get(protocol, (f"a package of fsspec for {protocol}", ""))
        how = f': pip install "driveby[{extra}]"' if extra else ""
        raise InputError(f"{name}: needs {package}, which is not installed{how}") from None
    except ValueError:
        raise InputError(
            f"{name}: no store is known as {protocol}://, give a folder or s3://BUCKET/FOLDER"
        ) from None
    return Folder(name, files, str(root).rstrip("/"))


def check_folder(folder: Folder) -> None:
    """InputError if there is no such folder."""
    if not is_folder(folder):
        raise InputError(f"{folder.name}: no such folder")


def is_folder(folder: Folder) -> bool:
    """Whether there is one. InputError if the store cannot be reached."""
    with _told(folder, ""):
        return bool(folder.files.isdir(folder.root))


def files_below(folder: Folder, suffix: str, below: str = "") -> list[Entry]:
    """The files below a folder whose names end so, in the order of their names; no hidden ones."""
    with _told(folder, below):
        top = folder.path(below)
        # An object store may hold on to an older listing.
        folder.files.invalidate_cache(top)
        try:
            found = folder.files.find(top, detail=True)
        except FileNotFoundError:
            return []
    entries = []
    for path, info in sorted(found.items()):
        name = str(path)[len(folder.root) + 1 :]
        if name.endswith(suffix) and not any(part[0] == "." for part in name.split("/") if part):
            # A float, as fsspec gives it, does not hold a time in ns.
            is_local = folder.is_local
            when_ns = Path(path).stat().st_mtime_ns if is_local else _modified_ns(info)
            entries.append(Entry(name, int(info.get("size") or 0), when_ns))
    return entries


@contextmanager
def opened(folder: Folder, name: str) -> Iterator[BinaryIO]:
    """A file of the folder to read in ranges. InputError if it cannot be read."""
    kind: dict[str, Any] = {} if folder.is_local else {"cache_type": "readahead"}
    with (
        _told(folder, name),
        folder.files.open(folder.path(name), "rb", block_size=READ_AHEAD_BYTES, **kind) as file,
    ):
        yield file


def read(folder: Folder, name: str) -> bytes:
    """The content of a file. InputError if it cannot be read."""
    with _told(folder, name):
        content: bytes = folder.files.cat_file(folder.path(name))
        return content


def read_head(folder: Folder, name: str, most: int) -> bytes:
    """The first bytes of a file, `most` of them. InputError if it cannot be read."""
    with _told(folder, name):
        content: bytes = folder.files.cat_file(folder.path(name), start=0, end=most)
        return content


def size_of(folder: Folder, name: str) -> int:
    """How many bytes a file has. InputError if it cannot be read."""
    with _told(folder, name):
        return int(folder.files.size(folder.path(name)) or 0)


def fetch(folder: Folder, name: str, to: Path) -> None:
    """Copy a file of the folder to this machine.

    InputError if it cannot be read, or changes meanwhile; FailureError if there is no room.
    """
    size, where = size_of(folder, name), f"{folder.name.rstrip('/')}/{name}"
    free = shutil.disk_usage(to.parent).free
    if size > free:
        raise FailureError(_no_room(where, size, to) + f", which has {free / 1e6:.1f} MB left")
    with _told(folder, name):
        try:
            folder.files.get_file(folder.path(name), str(to))
        except OSError as error:
            if error.errno in _NO_ROOM:
                raise FailureError(f"{_no_room(where, size, to)}: {error.strerror}") from error
            raise
    if to.stat().st_size != size:
        raise InputError(f"{where}: has changed while it was copied")


def _no_room(where: str, size: int, to: Path) -> str:
    return f"{where}: {size / 1e6:.1f} MB have no room in {to.parent.parent} (TMPDIR)"


def put(folder: Folder, name: str, content: bytes) -> bool:
    """Write a file whole, unless there is one of that name: then False, and it stays.

    InputError if it cannot be written there, FailureError if writing fails.
    """
    path = folder.path(name)
    if folder.is_local:
        local = Path(path)
        if local.exists():
            return False
        make_folder(local.parent)
        write_atomically(local, content)
        return True
    with _told(folder, name, is_written=True):
        if folder.files.exists(path):
            return False
        folder.files.pipe_file(path, content)
    return True


def remove(folder: Folder, name: str) -> None:
    """Remove a file; one that somebody else has removed is none."""
    with _told(folder, name, is_written=True):
        try:
            folder.files.rm_file(folder.path(name))
        except FileNotFoundError:
            return


@contextmanager
def _told(folder: Folder, name: str, *, is_written: bool = False) -> Iterator[None]:
    """Say in one line what a store refuses: every kind has errors of its own."""
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
        # What botocore raises (no credentials, no such endpoint) is no OSError.
        raise InputError(f"{where}: cannot be reached: {error}") from error


def _modified_ns(info: dict[str, Any]) -> int:
    found = info.get("mtime", info.get("LastModified", info.get("created")))
    if isinstance(found, datetime):
        return round(found.timestamp() * 1e9)
    return round(found * 1e9) if isinstance(found, int | float) else 0


def _protocols(files: "AbstractFileSystem") -> tuple[str, ...]:
    protocol = files.protocol
    return (protocol,) if isinstance(protocol, str) else tuple(protocol)
