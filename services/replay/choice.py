"""Selection of recorded messages: time, topics, trucks and their names."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from datetime import UTC, datetime
from fnmatch import fnmatchcase
from typing import NamedTuple

from schemas.signals import NS_PER_S
from schemas.topics import Key, topic
from services.common.errors import InputError
from services.common.naming import checked_identifier
from services.recordings.merge import TimedMessage
from services.replay.settings import ReplaySettings


class ReplaySelection(NamedTuple):
    """The user's selection as given."""

    start: str | None = None
    """Seconds from the beginning of the drive, or a time in UTC."""
    end: str | None = None
    duration_s: float | None = None
    topics: tuple[str, ...] = ()
    """Patterns with * and ? of `STREAM` or `OWNER/ID/STREAM`; empty: all."""
    exclude: tuple[str, ...] = ()
    vehicles: tuple[str, ...] = ()
    """Trucks whose messages are published; empty: everything."""
    renames: tuple[tuple[str, str], ...] = ()
    """Old and new names of trucks."""


def selection_of(asked: ReplaySettings) -> ReplaySelection:
    """Return the selection of the options; raise InputError for a malformed name."""
    return ReplaySelection(
        asked.start,
        asked.end,
        asked.duration,
        asked.topics,
        asked.exclude,
        asked.vehicle,
        tuple(parsed_rename(text) for text in asked.rename),
    )


class ReplayWindow(NamedTuple):
    """A period of the drive; ns since 1970 UTC, without its end."""

    begin_ns: int
    end_ns: int


def window_of(choice: ReplaySelection, first_ns: int, last_ns: int) -> ReplayWindow:
    """Return the selected period; raise InputError if it holds nothing of the drive."""
    begin_ns = _moment("--start", choice.start, first_ns, last_ns) or first_ns
    end_ns = _moment("--end", choice.end, first_ns, last_ns)
    if choice.duration_s is not None:
        end_ns = begin_ns + round(choice.duration_s * NS_PER_S)
    if end_ns is None:
        end_ns = last_ns + 1
    if end_ns <= begin_ns:
        raise InputError(f"--end: is {choice.end}, it must be later than the start")
    return ReplayWindow(begin_ns, end_ns)


def chosen_keys(choice: ReplaySelection, keys: Iterable[Key]) -> dict[Key, str]:
    """Return the keys to publish with their identifiers; raise InputError if there is none.

    Every option must match something: a misspelt value is an error.
    """
    all_keys = [where for where in keys if topic(where.owner, where.stream).logged]
    trucks = sorted({where.identifier for where in all_keys if where.owner == "vehicle"})
    for option, names in (
        ("--vehicle", choice.vehicles),
        ("--rename", [old for old, _ in choice.renames]),
    ):
        for name in names:
            if name not in trucks:
                known = ", ".join(trucks) or "no truck"
                raise InputError(f'{option}: "{name}" is not in the recording, which has {known}')
    for option, patterns in (("--topics", choice.topics), ("--exclude", choice.exclude)):
        for pattern in patterns:
            if not any(_fits(pattern, where) for where in all_keys):
                known = ", ".join(sorted({_name(where) for where in all_keys})[:12])
                raise InputError(
                    f'{option}: "{pattern}" matches no topic of the recording, which has {known}'
                )
    renames = _renames(choice.renames, trucks)
    found = {
        where: renames.get(where.identifier, where.identifier)
        if where.owner == "vehicle"
        else where.identifier
        for where in all_keys
        if _is_wanted(choice, where)
    }
    if not found:
        raise InputError("nothing is left to replay: the options leave every topic out")
    return found


def within(messages: Iterable[TimedMessage], window: ReplayWindow) -> Iterator[TimedMessage]:
    """Yield the messages of a period, after the last values of latched topics before it."""
    latched: dict[Key, TimedMessage] = {}
    has_begun = False
    for timed in messages:
        due_ns, message = timed
        if due_ns >= window.begin_ns and not has_begun:
            has_begun = True
            for before in latched.values():
                yield before._replace(due_ns=window.begin_ns)
        if topic(message.key.owner, message.key.stream).latched:
            if not has_begun:
                latched[message.key] = timed
            elif due_ns < window.end_ns:
                yield timed
        elif window.begin_ns <= message.log_time_ns < window.end_ns:
            # A recovered message stands after the end, and the replay does not wait for it.
            yield TimedMessage(min(due_ns, window.end_ns), message)


def parsed_rename(text: str) -> tuple[str, str]:
    """Return the parts of `OLD=NEW`; raise InputError if it is malformed."""
    old, separator, new = text.partition("=")
    if not separator or not old:
        raise InputError(f'--rename: is "{text}", OLD=NEW is expected, as truck-1=truck-9')
    return old, checked_identifier(new, "--rename")


def _is_wanted(choice: ReplaySelection, where: Key) -> bool:
    if choice.vehicles and (where.owner != "vehicle" or where.identifier not in choice.vehicles):
        return False
    if choice.topics and not any(_fits(pattern, where) for pattern in choice.topics):
        return False
    return not any(_fits(pattern, where) for pattern in choice.exclude)


def _name(where: Key) -> str:
    return f"{where.owner}/{where.identifier}/{where.stream}"


def _fits(pattern: str, where: Key) -> bool:
    return fnmatchcase(where.stream if "/" not in pattern else _name(where), pattern)


def _renames(renames: Sequence[tuple[str, str]], trucks: Sequence[str]) -> Mapping[str, str]:
    named = {truck: dict(renames).get(truck, truck) for truck in trucks}
    for truck, name in named.items():
        others = [other for other, its in named.items() if its == name and other != truck]
        if others:
            raise InputError(f'--rename: {truck} and {others[0]} would both be "{name}"')
    return named


def _moment(option: str, text: str | None, first_ns: int, last_ns: int) -> int | None:
    if text is None:
        return None
    try:
        moment_ns = first_ns + round(float(text) * NS_PER_S)
    except (ValueError, OverflowError):
        moment_ns = _utc_ns(option, text)
    if not first_ns <= moment_ns <= last_ns + 1 and (option == "--start" or moment_ns < first_ns):
        raise InputError(
            f"{option}: is {text}, but the drive lasts {(last_ns - first_ns) / NS_PER_S:.1f} s, "
            f"from {utc_text(first_ns)} to {utc_text(last_ns)}"
        )
    return moment_ns


def _utc_ns(option: str, text: str) -> int:
    try:
        moment = datetime.fromisoformat(text)
    except ValueError:
        raise InputError(
            f'{option}: is "{text}", seconds from the beginning of the drive or a time in UTC '
            "such as 2026-09-21T22:33:20 are expected"
        ) from None
    moment = moment if moment.tzinfo is not None else moment.replace(tzinfo=UTC)
    return round(moment.timestamp() * 1e6) * 1000


def utc_text(time_ns: int) -> str:
    """Return a time in UTC to the millisecond, as `--start` accepts it."""
    moment = datetime.fromtimestamp(time_ns / NS_PER_S, UTC)
    return moment.isoformat(timespec="milliseconds").replace("+00:00", "Z")
