"""Guesses by which files are read, and their lines: equal ones of several files are one."""

from collections.abc import Iterable
from typing import Final, Literal, NamedTuple

GuessKind = Literal["form", "lost", "open", "converts", "columns"]
TO_CONFIRM: Final = ("converts", "columns")
"""Kinds that must be confirmed, in the order in which they are listed."""


class Guess(NamedTuple):
    """An interpretation that the files do not state explicitly."""

    file: str
    words: str
    kind: GuessKind
    """Effect of the guess.

    It concerns the form of the text, data left out, a value that must be given before an import,
    changed numbers, or the quantities of columns; the last two must be confirmed.
    """

    @property
    def text(self) -> str:
        """The guess with its file."""
        return f"{self.file}: {self.words}"


def grouped(guesses: Iterable[Guess]) -> list[Guess]:
    """Return the guesses with equal ones of several files in one, in the order of the first."""
    files: dict[tuple[str, GuessKind], list[str]] = {}
    for one in dict.fromkeys(guesses):
        files.setdefault((one.words, one.kind), []).append(one.file)
    return [Guess(_named(names), words, kind) for (words, kind), names in files.items()]


def conversions(guesses: Iterable[Guess]) -> list[str]:
    """Return guesses to be confirmed, grouped: units and gravity before columns."""
    found = [one for one in grouped(guesses) if one.kind in TO_CONFIRM]
    return [one.text for one in sorted(found, key=lambda one: TO_CONFIRM.index(one.kind))]


def _named(names: list[str]) -> str:
    return names[0] if len(names) == 1 else f"{names[0]} and {len(names) - 1} more"
