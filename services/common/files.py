"""Files that are complete or absent: written next to the target, synced, renamed.

An output replaces a file of its own kind only, never a site file, and never a file that the command
reads (`services.common.outputs`). A recording is replaced only with `force`, and never while it is
being written: its writer would continue into an unlinked file.
"""

import errno
import fcntl
import glob
import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from services.common.errors import FailureError, InputError
from services.common.kinds import (
    EMPTY,
    HEAD_BYTES,
    OTHER,
    RECORDING,
    SITE,
    TEXT,
    Kind,
    described,
    family_of,
)
from services.common.outputs import check_no_input

_RECORDING_SUFFIX = ".mcap"
_LONGEST_NAME = 255
"""Longest name in bytes on the file systems of Linux and macOS."""
_RECORDING_MAGIC = b"\x89MCAP0\r\n"


def write_atomically(path: Path, content: str | bytes) -> None:
    """Replace `path` by `content` (text as UTF-8): readers see the old or the complete new file.

    Raise InputError if the place is not writable, FailureError if writing fails.
    """
    with replaced_atomically(path) as temporary:
        # A text may contain the name of a file, which need not be Unicode.
        encoded = content.encode(errors="backslashreplace") if isinstance(content, str) else content
        temporary.write_bytes(encoded)


@contextmanager
def replaced_atomically(path: Path, *, force: bool = False) -> Iterator[Path]:
    """Yield a temporary path next to `path` to write to; rename it when the block succeeds.

    The temporary name keeps the suffix, because writers choose the format by it. If the block
    raises, or `path` must not be replaced (see `check_writable`), the temporary file is removed and
    `path` is unchanged.
    """
    check_writable(path, force=force)
    temporary = _temporary(path)
    try:
        try:
            yield temporary
            sync(temporary)
            check_writable(path, force=force)  # check again: the block may have taken long
            _check_like(path, temporary)
            temporary.replace(path)
            sync(path.parent)
        except OSError as error:
            raise FailureError(f"{path}: could not be written: {_reason(error)}") from error
    finally:
        temporary.unlink(missing_ok=True)


def check_writable(path: Path, *, force: bool = False, kinds: tuple[Kind, ...] = ()) -> None:
    """Raise InputError if a file cannot be placed at `path`. For use before hours of work.

    An existing file must be of one of the `kinds`, if any are given, and must not be an input of
    the same command. A recording is replaced with `force` only, and never while it is being
    written.
    """
    try:
        if path.is_dir():
            raise InputError(f"{path}: is a folder, give the name of a file to write")
        if path.exists() and not path.is_file():
            # Renaming a file onto a device or a pipe would replace it.
            raise InputError(f"{path}: is not an ordinary file, give the name of a file to write")
        if not path.parent.is_dir():
            raise InputError(f"{path}: the folder {path.parent} does not exist, make it first")
        is_there = path.exists()
    except OSError as error:
        raise name_error(path, error) from error
    if not os.access(path.parent, os.W_OK | os.X_OK):
        raise InputError(f"{path}: no permission to write in the folder {path.parent}")
    check_no_input(path)
    if is_there:
        _check_replaceable(path, force=force)
        check_kind(path, kinds)


def is_unicode(name: str) -> bool:
    """Return whether a name is UTF-8 on the disk; libraries cannot handle others."""
    try:
        name.encode()
    except UnicodeEncodeError:
        return False
    return True


def name_error(path: Path, error: OSError) -> InputError:
    """Return the error for an unusable name, cut to fit a line."""
    if error.errno == errno.ENAMETOOLONG:
        return InputError(
            f"{str(path)[:60]}...: the name is too long, file systems take {_LONGEST_NAME} bytes"
        )
    return InputError(f"{path}: cannot be used: {_reason(error)}")


def _temporary(path: Path) -> Path:
    """Return a free name next to `path` with its suffix, within the limit of file systems."""
    token = secrets.token_hex(4)
    name = f".{path.stem}.{token}.part{path.suffix}"
    if len(os.fsencode(name)) > _LONGEST_NAME:
        name = f".{token}.part{path.suffix}"
    return path.with_name(name)


def remove_leftovers(path: Path) -> None:
    """Remove temporary files next to `path` that killed writers left.

    The caller makes sure that no process writes to `path` now.
    """
    pattern = f".{glob.escape(path.stem)}.{'[0-9a-f]' * 8}.part{glob.escape(path.suffix)}"
    for left in path.parent.glob(pattern):
        left.unlink(missing_ok=True)


def _head(path: Path) -> bytes:
    """Return the first bytes of a file; empty if it cannot be read."""
    try:
        with path.open("rb") as file:
            return file.read(HEAD_BYTES)
    except OSError:
        return b""


def check_kind(path: Path, kinds: tuple[Kind, ...]) -> None:
    """Raise InputError if a file at `path` is of none of the kinds that may be replaced.

    Recordings have a rule of their own (`check_writable`).
    """
    head = _head(path) if kinds and path.is_file() else b""
    if head and family_of(head) != RECORDING and not any(kind.matches(head) for kind in kinds):
        names = " or ".join(dict.fromkeys(kind.name for kind in kinds))
        raise InputError(
            f"{path}: is {described(head)}, and only {names} is replaced here; give another name"
        )


def check_site_kept(path: Path, text: str) -> None:
    """Raise InputError if there is a site file at `path` whose content is not `text`."""
    if family_of(_head(path)) == SITE and path.read_bytes() != text.encode():
        raise InputError(f"{path}: is a site file, and none is replaced; give another name")


def _check_like(path: Path, temporary: Path) -> None:
    """Raise InputError if `path` holds another kind of file than its replacement.

    A damaged file is not recognised and may be replaced; a site file may not, unless the text is
    equal.
    """
    if not path.exists():
        return
    there, new = _head(path), _head(temporary)
    family = family_of(there)
    if family == SITE:
        if path.read_bytes() != temporary.read_bytes():
            raise InputError(f"{path}: is a site file, and none is replaced; give another name")
    elif family not in (EMPTY, OTHER, TEXT, family_of(new)):
        raise InputError(
            f"{path}: is {described(there)}, and would be replaced by "
            f"{described(new) or 'an empty file'}; give another name"
        )


def is_held(file: BinaryIO) -> bool:
    """Return whether another process, or an earlier opening of this one, locks an open file."""
    try:
        fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    fcntl.flock(file, fcntl.LOCK_UN)
    return False


def lock_folder(folder: Path, lock: str, in_use: str) -> int:
    """Create a folder if it is absent and lock a file `lock` in it; return its open descriptor.

    The lock ends when the descriptor is closed or its process ends, however it ends; the file
    stays. Raise InputError, with the text `in_use` if another process has the lock.
    """
    check_folder_writable(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        path = folder / lock
        # The file may be another user's, of a container that shares the volume.
        is_readable_only = path.exists() and not os.access(path, os.W_OK)
        flags = os.O_RDONLY if is_readable_only else os.O_RDWR | os.O_CREAT
        file = os.open(path, flags, 0o644)
    except OSError as error:
        raise InputError(f"{folder}: cannot be created or written: {_reason(error)}") from None
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        os.close(file)
        reason = in_use if isinstance(error, BlockingIOError) else f"{lock}: {_reason(error)}"
        raise InputError(f"{folder}: {reason}") from None
    return file


def _check_replaceable(path: Path, *, force: bool) -> None:
    try:
        with path.open("rb") as file:
            begins_as_one = file.read(len(_RECORDING_MAGIC)) == _RECORDING_MAGIC
            if not begins_as_one and path.suffix != _RECORDING_SUFFIX:
                return
            if is_held(file):
                raise InputError(
                    f"{path}: is a recording that is being written at this moment, and never "
                    "replaced; give another name"
                )
    except OSError:  # an unreadable file is not replaced
        if path.suffix != _RECORDING_SUFFIX:
            return
    if not force:
        raise InputError(
            f"{path}: is a recording, which is replaced only with --force; give another name"
        )


def check_folder_writable(folder: Path) -> None:
    """Raise InputError if a folder, or its first existing parent, is not writable."""
    there = folder
    while not os.path.lexists(there) and there != there.parent:
        there = there.parent
    if not there.is_dir():
        what = "a file" if there.exists() else "a link to nothing"
        raise InputError(f"{folder}: cannot be created, {there} is {what}")
    if not os.access(there, os.W_OK | os.X_OK):
        raise InputError(f"{folder}: no permission to write in the folder {there}")


def make_folder(folder: Path) -> None:
    """Create a folder and its parents; raise InputError if nothing can be written there.

    For use before hours of work, like `check_writable`.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: cannot be created as a folder: {_reason(error)}") from error
    check_folder_writable(folder)


def check_readable_below(folder: Path) -> None:
    """Raise InputError for a folder in `folder` that cannot be listed.

    A search leaves it out silently, and its files would count as absent. Hidden folders and the
    lost+found of a file system hold no data.
    """

    def refuse(error: OSError) -> None:
        if not isinstance(error, FileNotFoundError | NotADirectoryError):
            raise InputError(f"{error.filename}: cannot be read: {_reason(error)}") from None

    for _, below, _ in os.walk(folder, onerror=refuse):
        below[:] = [name for name in below if name[0] != "." and name != "lost+found"]


def check_ordinary(path: Path) -> None:
    """Raise InputError if `path` is neither a file nor a folder.

    Opening a pipe without a writer would block for ever.
    """
    if path.exists() and not path.is_file() and not path.is_dir():
        raise InputError(
            f"{path}: is not an ordinary file but a pipe or a device; give an ordinary one"
        )


def read_text(path: Path) -> str:
    """Return the text of a UTF-8 file; raise InputError if it is not readable."""
    return decode_text(path, read_bytes(path))


def decode_text(path: Path, content: bytes) -> str:
    """Return the text of UTF-8 bytes from `path`."""
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        raise InputError(f"{path}: line {line}: is not UTF-8 text") from error


def read_bytes(path: Path) -> bytes:
    """Return the bytes of a file; raise InputError if it is missing or unreadable."""
    try:
        check_ordinary(path)
        return path.read_bytes()
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such file") from error
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {_reason(error)}") from error


def sync(path: Path) -> None:
    """Sync a file, or a folder, so that a new name in it survives a loss of power."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _reason(error: OSError) -> str:
    return error.strerror or type(error).__name__
