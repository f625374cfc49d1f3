"""Files that are whole or absent: written beside the target, synced, renamed.

Other files replace what was there. A recording is replaced only if somebody says so, and never
while it is being written: who writes it would go on into a file without a name.
"""

import fcntl
import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from services.common.errors import FailureError, InputError

_RECORDING_SUFFIX = ".mcap"
_RECORDING_MAGIC = b"\x89MCAP0\r\n"


def write_atomically(path: Path, content: str | bytes) -> None:
    """Replace `path` by `content` (text as UTF-8): readers see the old file or the whole new one.

    Raises InputError if nothing can be written there, FailureError if writing fails.
    """
    with replaced_atomically(path) as temporary:
        temporary.write_bytes(content.encode() if isinstance(content, str) else content)


@contextmanager
def replaced_atomically(path: Path, *, force: bool = False) -> Iterator[Path]:
    """Give a temporary path beside `path` to write to; rename it when the block ends well.

    The temporary name keeps the suffix, because writers choose the format by it. If the block
    raises, or there is a recording (see `check_writable`), the temporary file is removed and `path`
    stays as it was.
    """
    check_writable(path, force=force)
    temporary = path.with_name(f".{path.stem}.{secrets.token_hex(4)}.part{path.suffix}")
    try:
        try:
            yield temporary
            _sync(temporary)
            check_writable(path, force=force)  # it took a while to get here
            temporary.replace(path)
            _sync(path.parent)
        except OSError as error:
            raise FailureError(f"{path}: could not be written: {_reason(error)}") from error
    finally:
        temporary.unlink(missing_ok=True)


def check_writable(path: Path, *, force: bool = False) -> None:
    """Raise InputError if a file cannot be put at `path`. For use before hours of work.

    Nor may it be where there is a recording: that is replaced with `force` only, and never while
    somebody writes it.
    """
    if path.is_dir():
        raise InputError(f"{path}: is a folder, give the name of a file to write")
    if path.exists() and not path.is_file():
        # Renaming a file onto a device or a pipe would replace it.
        raise InputError(f"{path}: is no ordinary file, give the name of a file to write")
    if not path.parent.is_dir():
        raise InputError(f"{path}: the folder {path.parent} does not exist, make it first")
    if not os.access(path.parent, os.W_OK | os.X_OK):
        raise InputError(f"{path}: no permission to write in the folder {path.parent}")
    if path.exists():
        _check_replaceable(path, force=force)


def is_held(file: BinaryIO) -> bool:
    """Whether another process, or an earlier opening of this one, has an open file to itself."""
    try:
        fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    fcntl.flock(file, fcntl.LOCK_UN)
    return False


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
    except OSError:  # what may not be read is not lightly replaced
        if path.suffix != _RECORDING_SUFFIX:
            return
    if not force:
        raise InputError(
            f"{path}: is a recording, and none is replaced without --force; give another name"
        )


def check_folder_writable(folder: Path) -> None:
    """Raise InputError if nothing can be put into a folder, or into the first parent there is."""
    there = folder
    while not there.exists() and there != there.parent:
        there = there.parent
    if not there.is_dir():
        raise InputError(f"{folder}: cannot be made, {there} is a file")
    if not os.access(there, os.W_OK | os.X_OK):
        raise InputError(f"{folder}: no permission to write in the folder {there}")


def make_folder(folder: Path) -> None:
    """Make a folder and those above it; raise InputError if nothing can be written there.

    For use before hours of work, as `check_writable` is.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: cannot be made a folder: {_reason(error)}") from error
    check_folder_writable(folder)


def check_ordinary(path: Path) -> None:
    """Raise InputError if there is something at `path` that is neither a file nor a folder.

    A pipe to which nobody writes would be waited for without end.
    """
    if path.exists() and not path.is_file() and not path.is_dir():
        raise InputError(f"{path}: is no ordinary file (a pipe or a device), give one that is")


def read_text(path: Path) -> str:
    """Return the text of a UTF-8 file; raise InputError if that is not possible."""
    return decode_text(path, read_bytes(path))


def decode_text(path: Path, content: bytes) -> str:
    """Return the text of UTF-8 bytes that came from `path`."""
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        raise InputError(f"{path}: line {line}: is not UTF-8 text") from error


def read_bytes(path: Path) -> bytes:
    """Return the bytes of a file; raise InputError if it is missing or unreadable."""
    check_ordinary(path)
    try:
        return path.read_bytes()
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such file") from error
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {_reason(error)}") from error


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _reason(error: OSError) -> str:
    return error.strerror or type(error).__name__
