"""Recordings looked through before they are published: what is in them, what of it is wanted."""

import logging
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

from schemas.site_file import load_site
from schemas.topics import Key, parse_key, topic
from services.common.errors import InputError
from services.drives.survey import Survey, survey
from services.recordings.recording import Message, check_message
from services.recordings.together import Timed, read_together, recordings_in
from services.replay.choice import Choice, Window, chosen_keys, utc_text, window_of, within

_log = logging.getLogger(__name__)
_LONG_SILENCE_NS = 60_000_000_000
"""Who sees nothing for longer thinks that something is broken."""

Stretch = tuple[int, int]
"""From the first to the last message of a time without long silence, ns since 1970 UTC."""


class Drive(NamedTuple):
    """What is to be published of several recordings, as one drive."""

    files: tuple[tuple[int, Path], ...]
    """With the time at which each begins."""
    names: dict[Key, str]
    """The identifier under which each key is published; other keys are left out."""
    window: Window
    crossings_ns: tuple[int, ...]
    """When trucks come onto bridges, ascending."""
    stretches: tuple[Stretch, ...]

    def messages(self) -> Iterator[Timed]:
        """The messages to publish, in the order of time."""
        chosen = (one for one in read_together(self.files) if one.message.key in self.names)
        return within(chosen, self.window)


def open_drive(paths: list[Path], realm: str, choice: Choice, site: Path | None) -> Drive:
    """Look at every message of all recordings before anybody is connected to.

    What no logger would take could not be confirmed, and the logger is not to blame. Of a damaged
    recording what is intact is taken, with a warning; one in a folder that holds nothing at all is
    passed over with a warning too. InputError as of `services.replay.run`.
    """
    if not paths:
        raise InputError("no recording: give one or more .mcap files")
    known = None if site is None else load_site(site)
    surveys: list[Survey] = []
    stretches: list[Stretch] = []
    for path in recordings_in(paths):
        times_ns: list[int] = []
        look = partial(_look, path, times_ns)
        try:
            found = survey(path, known, look)
            if not found.info.messages:
                raise InputError(f"{path}: holds no driveby message; a recording is expected")
        except InputError as error:
            if path in paths:
                raise
            _log.warning("%s; it is passed over", error)
            continue
        if found.info.truncated or found.info.damaged_chunks:
            _log.warning("%s: damaged, only its whole chunks are replayed", path)
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
    return Drive(
        tuple((one.first_ns, one.path) for one in surveys),
        names,
        Window(window.begin_ns, min(window.end_ns, last_ns + 1)),
        tuple(ns for ns in entries if window.begin_ns <= ns < window.end_ns),
        tuple(_joined(stretches)),
    )


def warn_of_silence(drive: Drive) -> None:
    """Say where nothing comes for long, so that nobody thinks that something is broken."""
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
            "nothing was recorded for %.0f s after %s%s; --skip-gaps passes over it",
            (start - stop) * 1e-9,
            utc_text(stop),
            f", nor {len(silences) - 1} times more" if len(silences) > 1 else "",
        )


def _look(path: Path, times_ns: list[int], message: Message) -> None:
    check_message(path, message)
    if not topic(message.key.owner, message.key.stream).latched:
        times_ns.append(message.log_time_ns)


def _stretches(times_ns: list[int]) -> Iterator[Stretch]:
    yield from _joined([(time_ns, time_ns) for time_ns in times_ns])


def _joined(stretches: Sequence[Stretch]) -> Iterator[Stretch]:
    """Join what overlaps or follows soon."""
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
