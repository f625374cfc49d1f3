"""The files that a command reads and writes: none that it reads is ever replaced.

The command line declares both; a reader that finds a further input in a file, such as the baseline
of a site file, adds it. Every writer checks here (`services.common.files.check_writable`). Files
are compared by device and inode, so another path, a link or a hard link makes no difference.
"""

import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from stat import S_ISREG
from typing import Final

from services.common.errors import InputError

_Identity = tuple[int, int]

_inputs: Final[set[_Identity]] = set()
_outputs: Final[list[Path]] = []


@contextmanager
def declared(inputs: Iterable[Path], outputs: Iterable[Path]) -> Iterator[None]:
    """Protect the inputs of a command during the block.

    Raise InputError if an output is one of them, or if two outputs have one name.
    """
    _inputs.update(identity for identity in map(_identity, inputs) if identity is not None)
    named: dict[Path, Path] = {}
    try:
        for path in outputs:
            if named.setdefault(Path(os.path.realpath(path)), path) is not path:
                raise InputError(f"{path}: is given for two outputs; give each a name of its own")
            _outputs.append(path)
            check_no_input(path)
        yield
    finally:
        _inputs.clear()
        _outputs.clear()


def add_input(path: Path) -> None:
    """Protect one more file from replacement; raise InputError if it is an output as well."""
    identity = _identity(path)
    if identity is None:
        return
    _inputs.add(identity)
    for output in _outputs:
        check_no_input(output)


def check_no_input(path: Path) -> None:
    """Raise InputError if a file to write is one that the command reads."""
    if _inputs and _identity(path) in _inputs:
        raise InputError(
            f"{path}: is read by this command and would be replaced; give another name to write"
        )


def _identity(path: Path) -> _Identity | None:
    """Return device and inode of an ordinary file, None if it does not exist."""
    try:
        status = path.stat()
    except (OSError, ValueError):
        return None
    return (status.st_dev, status.st_ino) if S_ISREG(status.st_mode) else None
