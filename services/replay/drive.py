"""Check and index of recordings before they are published."""

import logging
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

from schemas.site_file import load_site
from schemas.topics import Key, Message, parse_key, topic
from services.catalogue.contents import RecordingSummary, summarise_recording
from services.common.errors import InputError
from services.common.naming import count_of
from services.recordings.merge import TimedMessage, read_together, recordings_in
from services.recordings.recording import check_message, is_being_written
from services.replay.choice import (
    ReplaySelection,
    ReplayWindow,
    chosen_keys,
    utc_text,
    window_of,
    within,
)

_log = logging.getLogger(__name__)
_LONG_SILENCE_NS = 60_000_000_000
"""Shortest silence that needs an explanation to the user."""

Stretch = tuple[int, int]
"""First and last message of a period without long silence, ns since 1970 UTC."""


class ReplayDrive(NamedTuple):
    """The messages of several recordings to publish, as one drive."""

    files: tuple[tuple[int, Path], ...]
    """Files with the time at which each begins."""
    names: dict[Key, str]
    """Published identifier of each key; other keys are skipped."""
    window: ReplayWindow
    crossings_ns: tuple[int, ...]
    """Times at which trucks enter bridges, ascending."""
    stretches: tuple[Stretch, ...]

    def messages(self) -> Iterator[TimedMessage]:
        """Return the messages to publish in the order of time."""
        chosen = (one for one in read_together(self.files) if one.message.key in self.names)
        return within(chosen, self.window)


def open_drive(
    paths: Sequence[Path], realm: str, choice: ReplaySelection, site: Path | None
) -> ReplayDrive:
    """Check every message of all recordings before connecting.

    A message that no logger would accept could not be confirmed, and would look like a fault of the
    logger. Of a damaged recording the intact part is used, with a warning; an empty one in a folder
    is skipped with a warning too. Raise InputError as `services.replay.run` does.
    """
    if not paths:
        raise InputError("no recording: give one or more .mcap files")
    known = None if site is None else load_site(site)
    surveys: list[RecordingSummary] = []
    stretches: list[Stretch] = []
    for path in recordings_in(paths):
        times_ns: list[int] = []
        look = partial(_look, path, times_ns)
        try:
            found = summarise_recording(path, known, look)
            if not found.info.messages:
                raise InputError(f"{path}: holds no driveby message; a recording is expected")
        except InputError as error:
            if path in paths:
                raise
            _log.warning("%s; skipped", error)
            continue
        if found.info.truncated or found.info.damaged_chunks:
            grows = not found.info.damaged_chunks and is_being_written(path)
            state = "being written" if grows else "damaged"
            _log.warning("%s: %s, only its intact chunks are replayed", path, state)
        surveys.append(found)
        stretches += _stretches(times_ns)
    if not surveys:
        raise InputError(f"{paths[0]}: holds no recording that can be read")
    keys = dict.fromkeys(parse_key(name) for one in surveys for name in one.info.messages)
    names = chosen_keys(choice, keys)
    if any(where.realm == realm for where in names):
        raise InputError(
            f"realm {realm} is the one that was recorded, where nothing is ever published again; "
            "give another --name"
        )
    first_ns = min(one.first_ns for one in surveys)
    last_ns = max(one.last_ns for one in surveys)
    window = window_of(choice, first_ns, last_ns)
    entries = sorted(
        {
            passing.entry_ns
            for one in surveys
            for passing in one.passings
            if not choice.vehicles or passing.vehicle in choice.vehicles
        }
    )
    return ReplayDrive(
        tuple((one.first_ns, one.path) for one in surveys),
        names,
        ReplayWindow(window.begin_ns, min(window.end_ns, last_ns + 1)),
        tuple(ns for ns in entries if window.begin_ns <= ns < window.end_ns),
        tuple(_joined(stretches)),
    )


def warn_of_silence(drive: ReplayDrive) -> None:
    """Log long silences, so that they do not look like a fault."""
    begin_ns, end_ns = drive.window
    ends = [stop for start, stop in drive.stretches if stop < end_ns]
    silences = [
        (stop, start)
        for stop, (start, _) in zip(ends, drive.stretches[1:], strict=False)
        if start > begin_ns and start <= end_ns
    ]
    if silences:
        stop, start = max(silences, key=lambda silence: silence[1] - silence[0])
        _log.warning(
            "nothing was recorded for %.0f s after %s%s; --skip-gaps skips such gaps",
            (start - stop) * 1e-9,
            utc_text(stop),
            f", and in {count_of(len(silences) - 1, 'shorter gap')}" if len(silences) > 1 else "",
        )


def _look(path: Path, times_ns: list[int], message: Message) -> None:
    check_message(path, message)
    if not topic(message.key.owner, message.key.stream).latched:
        times_ns.append(message.log_time_ns)


def _stretches(times_ns: list[int]) -> Iterator[Stretch]:
    yield from _joined([(time_ns, time_ns) for time_ns in times_ns])


def _joined(stretches: Sequence[Stretch]) -> Iterator[Stretch]:
    """Yield the periods, merged where they overlap or follow closely."""
    begin = end = None
    for start, stop in sorted(stretches):
        if begin is None or end is None:
            begin, end = start, stop
        elif start - end > _LONG_SILENCE_NS:
            yield begin, end
            begin, end = start, stop
        else:
            end = max(end, stop)
    if begin is not None and end is not None:
        yield begin, end
