"""Notes of recordings that were deleted on purpose, so that the catalogue reports no loss.

A note is a text file `_catalog/deleted/HASH.txt`, named by the path of its recording. It is written
before the recording is deleted, and removed together with the recording's row.
"""

import hashlib
from collections.abc import Iterable
from pathlib import Path
from typing import Final

from services.common.stores import Folder, files_below, folder_at, put, remove

CATALOG: Final = "_catalog"
"""Name of the catalogue's folder; no realm can have it."""
_NOTES: Final = f"{CATALOG}/deleted"


def note_deletion(folder: Path, recording: Path) -> None:
    """Write the note of a recording that is about to be deleted, where there is a catalogue.

    Raise InputError or FailureError if it cannot be written.
    """
    if not (folder / CATALOG).is_dir():
        return
    path = recording.relative_to(folder).as_posix()
    put(folder_at(str(folder)), _name(path), f"{path}\n".encode())


def noted_deletions(folder: Folder, paths: Iterable[str]) -> set[str]:
    """Return those of the missing recordings that were deleted on purpose."""
    paths = set(paths)
    if not paths:
        return set()
    notes = {entry.name for entry in files_below(folder, ".txt", _NOTES)}
    return {path for path in paths if _name(path) in notes}


def remove_notes(folder: Folder, paths: Iterable[str]) -> None:
    """Remove the notes of recordings whose rows are dropped."""
    for path in sorted(paths):
        remove(folder, _name(path))


def _name(path: str) -> str:
    return f"{_NOTES}/{hashlib.sha256(path.encode()).hexdigest()[:20]}.txt"
