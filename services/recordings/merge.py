"""Several recordings as one drive: their files, and their messages in the order of time."""

import heapq
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from schemas.topics import Message, topic
from services.common.errors import InputError
from services.common.files import check_readable_below
from services.common.intervals import Intervals
from services.recordings.recording import read_messages


class TimedMessage(NamedTuple):
    """A message and its time in the order of the drive."""

    due_ns: int
    """Latest log time of its file up to here: recovered messages stand late in a file and follow at
    once. A latched message may be hours older than its file and does not wait."""
    message: Message


def recordings_in(paths: Iterable[Path]) -> list[Path]:
    """Return the files and all recordings below folders; raise InputError for an empty folder."""
    found: list[Path] = []
    for path in paths:
        if not path.is_dir():
            found.append(path)
            continue
        check_readable_below(path)
        below = sorted(p for p in path.rglob("*.mcap") if p.is_file() and p.name[0] != ".")
        if not below:
            raise InputError(f"{path}: holds no recording (.mcap)")
        found += below
    return list(dict.fromkeys(found))


def read_together(files: Sequence[tuple[int, Path]]) -> Iterator[TimedMessage]:
    """Yield the messages of recordings in the order of time; each file comes with its first time.

    Within a file they keep the order of the file. A message in two files is yielded once, whatever
    their realms. A file is opened when its time has come, because a folder may hold thousands.
    """
    waiting = sorted(files, reverse=True)
    seen: dict[tuple[str, str, str, int], Intervals] = {}
    ahead: list[tuple[int, int, TimedMessage, Iterator[TimedMessage]]] = []

    def take(number: int, messages: Iterator[TimedMessage]) -> None:
        timed = next(messages, None)
        if timed is not None:
            heapq.heappush(ahead, (timed.due_ns, number, timed, messages))

    while ahead or waiting:
        while waiting and (not ahead or waiting[-1][0] <= ahead[0][0]):
            first_ns, path = waiting.pop()
            take(-len(waiting), _timed(first_ns, path))
        if not ahead:
            continue
        _, number, timed, messages = heapq.heappop(ahead)
        _, owner, identifier, stream = timed.message.key
        whose = (owner, identifier, stream, timed.message.boot_id)
        if seen.setdefault(whose, Intervals()).add(timed.message.sequence):
            yield timed
        take(number, messages)


def _timed(first_ns: int, path: Path) -> Iterator[TimedMessage]:
    reached_ns = first_ns
    for message in read_messages(path):
        if not topic(message.key.owner, message.key.stream).latched:
            reached_ns = max(reached_ns, message.log_time_ns)
        yield TimedMessage(reached_ns, message)
