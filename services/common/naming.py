"""Identifiers made from names of users and files, names of crossings, and counted nouns."""

import re
from collections.abc import Sequence
from datetime import UTC, datetime
from typing import Final

from schemas.topics import check_identifier
from services.common.errors import InputError

_MOMENT: Final = "%Y%m%dT%H%M%S.%f"
_DAY_S: Final = 86_400.0
_ENTRY: Final = re.compile(r"\.(\d{8}T\d{6}\.\d{3})Z$")


def name_of_crossing(vehicle: str, bridge: str, entry_s: float) -> str:
    """Return the name of a crossing that begins `entry_s` seconds after 1970 UTC."""
    moment = datetime.fromtimestamp(entry_s, UTC).strftime(_MOMENT)[:-3]
    return f"{vehicle}.{bridge}.{moment}Z"


def entry_in_name(crossing_id: str) -> datetime | None:
    """Return the entry in the name of a crossing in UTC, in whole ms; None without one."""
    found = _ENTRY.search(crossing_id)
    return None if found is None else datetime.strptime(f"{found[1]}+0000", f"{_MOMENT}%z")


def identifier_from(text: str) -> str:
    """Return an identifier for any text, e.g. for a file name: `Run 3.mcap` → `run-3-mcap`."""
    return re.sub(r"[^a-z0-9_-]+", "-", text.lower()).strip("-_")[:63] or "unnamed"


def checked_identifier(text: str, option: str) -> str:
    """Return the text if it is an identifier; raise an InputError that names the option if not."""
    try:
        return check_identifier(text)
    except ValueError as error:
        raise InputError(f"{option}: {error}") from error


def count_of(number: float, noun: str, plural: str = "") -> str:
    """Return a whole number with its noun in the right number: `1 truck`, `0 trucks`."""
    return f"{number:.0f} {noun if number == 1 else plural or f'{noun}s'}"


def first_of(names: Sequence[str], most: int) -> str:
    """Return the first names in a line, with `…` where there are more than `most`."""
    return ", ".join(names[:most]) + (" …" if len(names) > most else "")


def processes_in_words(number: int) -> str:
    """Return a number of processes with its noun."""
    return "1 process" if number == 1 else f"{number} processes"


def offset_in_words(seconds: float, digits: int) -> str:
    """Return a clock's offset in s with some digits, one of a day or more in days."""
    return f"{seconds / _DAY_S:.1f} days" if seconds >= _DAY_S else f"{seconds:.{digits}f} s"
