"""Summary of results that were added to a history, each crossing counted once."""

from collections.abc import Iterable
from typing import NamedTuple

CrossingKey = tuple[str, str, str]
"""Realm, bridge and name of a crossing."""


class AddSummary(NamedTuple):
    """Crossings by what adding their results changed, each in one of the sets."""

    added: frozenset[CrossingKey] = frozenset()
    replaced: frozenset[CrossingKey] = frozenset()
    """Crossings that were stored, and whose new result counts."""
    known: frozenset[CrossingKey] = frozenset()
    """Crossings whose stored result counts as before."""

    @property
    def bridges(self) -> tuple[str, ...]:
        """Bridges of which a crossing was added or replaced."""
        return tuple(sorted({bridge for _, bridge, _ in self.added | self.replaced}))


def summed(parts: Iterable[AddSummary]) -> AddSummary:
    """Return the summary of several additions; one of them may replace what another added."""
    total = AddSummary()
    for one in parts:
        added = total.added | one.added
        replaced = (total.replaced | one.replaced) - added
        known = (total.known | one.known) - added - replaced
        total = AddSummary(added, replaced, known)
    return total
