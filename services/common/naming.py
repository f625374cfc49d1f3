"""Names that users and files give, as identifiers of keys, and counted nouns."""

import re

from schemas.topics import check_identifier
from services.common.errors import InputError


def identifier_from(text: str) -> str:
    """Return an identifier for any text, e.g. for a file name: `Run 3.mcap` → `run-3-mcap`."""
    return re.sub(r"[^a-z0-9_-]+", "-", text.lower()).strip("-_")[:63] or "unnamed"


def checked_identifier(text: str, option: str) -> str:
    """Return the text if it is an identifier; raise an InputError that names the option if not."""
    try:
        return check_identifier(text)
    except ValueError as error:
        raise InputError(f"{option}: {error}") from error


def count_of(number: float, noun: str) -> str:
    """Return a whole number with its noun in the right number: `1 truck`, `0 trucks`."""
    return f"{number:.0f} {noun}{'' if number == 1 else 's'}"


def processes_in_words(number: int) -> str:
    """Return a number of processes with its noun."""
    return "1 process" if number == 1 else f"{number} processes"
