"""Recordings that are not on this machine: found by their address, brought here one at a time.

Identifying reads a recording from its beginning to its end, perhaps twice. So it is copied to a
temporary folder (`TMPDIR`) for as long as it is wanted, and the disk has to hold what is read
together: the recordings of one drive.
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
"""The site file stands before all messages, and has some thousand bytes."""


class Away(NamedTuple):
    """A recording in a store."""

    folder: Folder
    name: str
    """Relative to the folder."""

    def __str__(self) -> str:
        return f"{self.folder.name.rstrip('/')}/{self.name}"


Recording = Path | Away
Source = Path | str
"""A recording or a folder, by its path or its address."""


class AtHand(NamedTuple):
    """A recording on this machine, and what the user calls it."""

    path: Path
    name: str

    def told(self, line: str) -> str:
        """A line about the file as one about the recording."""
        return line.replace(str(self.path), self.name)


def is_folder_of_recordings(source: Source) -> bool:
    """Whether it is a folder. InputError if its store cannot be reached."""
    return source.is_dir() if isinstance(source, Path) else is_folder(folder_at(source))


def recording_at(source: Source) -> Recording:
    """The recording of that path or address, whether or not it is there."""
    if isinstance(source, Path):
        return source
    whole = folder_at(source)
    above, _, name = source.rpartition("/")
    return Away(Folder(above, whole.files, whole.root.rpartition("/")[0]), name)


@contextmanager
def at_hand(recording: Recording) -> Iterator[AtHand]:
    """The recording on this machine while the block lasts.

    InputError if it cannot be read, FailureError if there is no room for it.
    """
    if isinstance(recording, Path):
        yield AtHand(recording, str(recording))
        return
    with TemporaryDirectory(prefix="driveby-") as folder:
        path = Path(folder) / Path(recording.name).name
        fetch(recording.folder, recording.name, path)
        yield AtHand(path, str(recording))


@contextmanager
def all_at_hand(sources: Sequence[Source]) -> Iterator[list[Path]]:
    """Recordings that are read together; an InputError of the block calls them by their names."""
    with ExitStack() as stack:
        files = [stack.enter_context(at_hand(recording_at(source))) for source in sources]
        try:
            yield [file.path for file in files]
        except InputError as error:
            line = str(error)
            for file in files:
                line = file.told(line)
            raise InputError(line) from error


def stored_site(recording: Recording) -> str | None:
    """The site file stored in a recording, of which the beginning is read; None if there is none.

    InputError if it cannot be read, or is no recording.
    """
    if isinstance(recording, Path):
        return read_site(recording)
    head = read_head(recording.folder, recording.name, _HEAD_BYTES)
    with TemporaryDirectory(prefix="driveby-") as folder:
        file = AtHand(Path(folder) / "head.mcap", str(recording))
        file.path.write_bytes(head)
        try:
            return read_site(file.path)
        except InputError as error:
            raise InputError(file.told(str(error))) from None
