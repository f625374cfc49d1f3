"""A file that the logger is writing, and errors that name it."""

import contextlib
import logging
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from schemas.events import EventKind
from schemas.topics import Message
from services.common.errors import InputError
from services.logger.file_layout import FileName
from services.recordings.writer import Misplaced, RecordingWriter

_log = logging.getLogger(__name__)


class WriteError(Exception):
    """Failure to write a file; without a name the disk is at fault."""

    def __init__(self, name: FileName | None, reason: str, kind: EventKind) -> None:
        super().__init__(reason)
        self.name = name
        self.reason = reason
        self.kind = kind


@contextlib.contextmanager
def failing(name: FileName) -> Iterator[None]:
    """Add the name of the file to errors."""
    try:
        yield
    except (OSError, InputError) as error:
        raise failure_of(name, error) from error


def failure_of(name: FileName, error: OSError | InputError) -> WriteError:
    """Return an error with the name of the file."""
    reason = getattr(error, "strerror", None) or str(error)
    return WriteError(name, reason, EventKind.WRITE_ERROR)


@dataclass
class OpenFile:
    """A file that is being written."""

    file: RecordingWriter
    since_s: float
    last_s: float
    dropped_before: int
    has_failed: bool = False
    """Whether its END could not be written: then only `RecordingWriter.fail` may follow."""


def synced(name: FileName, opened: OpenFile) -> Misplaced | None:
    """Sync a file; return its displacement, None if it is in its place and complete."""
    with failing(name):
        opened.file.sync()
        return opened.file.displacement()


def finished(
    name: FileName, opened: OpenFile, reason: str, counts: Mapping[str, int]
) -> WriteError | None:
    """Write the END of a file and close it; return the error if that failed."""
    try:
        opened.file.finish(reason, counts)
    except OSError as error:
        opened.has_failed = True
        return failure_of(name, error)
    return None


def close_after_failure(
    opened: OpenFile, failure: str, counts: Mapping[str, int], event: Message, *, is_failed: bool
) -> int | None:
    """Close a file with an event; return its lost messages, None if unknown."""
    try:
        if is_failed or opened.has_failed:
            return opened.file.fail(failure, counts, [event])
        opened.file.sync()
    except OSError as error:
        _log.error("%s: %s", opened.file.path, error.strerror)
        return opened.file.fail(failure, counts, [event])
    try:
        opened.file.write(event)
        opened.file.finish(failure, counts)
    except OSError as error:  # everything except event and END is safe
        _log.error("%s: %s", opened.file.path, error.strerror)
        opened.file.fail(failure, counts, [event])
    return 0
