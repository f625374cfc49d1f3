"""Remote recordings: found by their address and copied to this machine one at a time.

Identification reads a recording from beginning to end, perhaps twice. So it is copied to a
temporary folder (`TMPDIR`) while it is needed, and the disk has to hold the recordings of one
drive.
"""

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final, NamedTuple

from services.common.errors import InputError
from services.common.stores import Folder, fetch, folder_at, is_folder, read_head
from services.recordings.recording import read_site

_HEAD_BYTES: Final = 1 << 20
"""Bytes read for the site file, which precedes all messages and has some thousand bytes."""


class RemoteRecording(NamedTuple):
    """A recording in a store."""

    folder: Folder
    name: str
    """Name relative to the folder."""

    def __str__(self) -> str:
        return f"{self.folder.name.rstrip('/')}/{self.name}"


Recording = Path | RemoteRecording
Source = Path | str
"""A recording or a folder, by its path or its address."""


class LocalRecording(NamedTuple):
    """A recording on this machine, and the user's name for it."""

    path: Path
    name: str

    def relabel(self, line: str) -> str:
        """Return a line about the file with the name of the recording."""
        return line.replace(str(self.path), self.name)


def is_folder_of_recordings(source: Source) -> bool:
    """Return whether a source is a folder; raise InputError if its store cannot be reached."""
    return source.is_dir() if isinstance(source, Path) else is_folder(folder_at(source))


def recording_at(source: Source) -> Recording:
    """Return the recording of a path or address, whether or not it exists."""
    if isinstance(source, Path):
        return source
    whole = folder_at(source)
    above, _, name = source.rpartition("/")
    return RemoteRecording(Folder(above, whole.files, whole.root.rpartition("/")[0]), name)


@contextmanager
def fetched(recording: Recording) -> Iterator[LocalRecording]:
    """Yield the recording on this machine during the block.

    Raise InputError if it cannot be read, FailureError if there is no space for it.
    """
    if isinstance(recording, Path):
        yield LocalRecording(recording, str(recording))
        return
    with TemporaryDirectory(prefix="driveby-") as folder:
        path = Path(folder) / Path(recording.name).name
        fetch(recording.folder, recording.name, path)
        yield LocalRecording(path, str(recording))


@contextmanager
def all_fetched(sources: Sequence[Source]) -> Iterator[list[Path]]:
    """Yield recordings to read together; an InputError of the block contains their names."""
    with ExitStack() as stack:
        files = [stack.enter_context(fetched(recording_at(source))) for source in sources]
        try:
            yield [file.path for file in files]
        except InputError as error:
            line = str(error)
            for file in files:
                line = file.relabel(line)
            raise InputError(line) from error


def stored_site(recording: Recording) -> str | None:
    """Return the site file in a recording, reading only its beginning; None if there is none.

    Raise InputError if it cannot be read or is not a recording.
    """
    if isinstance(recording, Path):
        return read_site(recording)
    head = read_head(recording.folder, recording.name, _HEAD_BYTES)
    with TemporaryDirectory(prefix="driveby-") as folder:
        file = LocalRecording(Path(folder) / "head.mcap", str(recording))
        file.path.write_bytes(head)
        try:
            return read_site(file.path)
        except InputError as error:
            raise InputError(file.relabel(str(error))) from None
