"""Guesses by which files are read, and their lines: equal ones of several files are one."""

from collections.abc import Iterable
from typing import Final, Literal, NamedTuple

GuessKind = Literal["form", "lost", "open", "converts"]
_BY_NAMES: Final = ("by their names ", "by the order of the columns ")


class Guess(NamedTuple):
    """An interpretation that the files do not state explicitly."""

    text: str
    kind: GuessKind
    """Effect of the guess.

    It concerns the form of the text, data left out, a value that must be given before an import,
    or changed numbers that must be confirmed.
    """


def grouped(guesses: Iterable[Guess]) -> list[Guess]:
    """Return the guesses with equal ones of several files in one, in the order of the first."""
    files: dict[Guess, list[str]] = {}
    for name, one in ((one.text.partition(": ")[0], one) for one in dict.fromkeys(guesses)):
        files.setdefault(one._replace(text=one.text[len(name) :]), []).append(name)
    return [one._replace(text=f"{_named(names)}{one.text}") for one, names in files.items()]


def conversions(guesses: Iterable[Guess]) -> list[str]:
    """Return guesses to be confirmed, grouped: units and gravity before names of columns."""
    texts = [one.text for one in grouped(guesses) if one.kind == "converts"]
    return sorted(texts, key=lambda text: text.partition(": ")[2].startswith(_BY_NAMES))


def _named(names: list[str]) -> str:
    return names[0] if len(names) == 1 else f"{names[0]} and {len(names) - 1} more"
