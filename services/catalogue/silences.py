"""Silences of a truck's streams within a boot: gaps in their data, or pauses of the truck."""

from array import array
from collections.abc import Iterable, Iterator
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from schemas.signals import NS_PER_S
from schemas.topics import Key, topic

LONGEST_SILENCE_S: Final = 1.0
"""Longest time in s between two messages that is no silence: batches take 50 to 100 ms."""


class Arrivals(NamedTuple):
    """Times and sequence numbers of a stream's messages, in arrays: a day has a million."""

    times_ns: "array[int]"
    sequences: "array[int]"

    def add(self, time_ns: int, sequence: int) -> None:
        """Add a message."""
        self.times_ns.append(time_ns)
        self.sequences.append(sequence)


class Silence(NamedTuple):
    """Two successive messages of a stream more than a second apart; times in ns."""

    where: Key
    boot_id: int
    begin_ns: int
    end_ns: int
    is_pause: bool
    """Whether the truck paused: no number is missing, and its other streams are silent too."""


def no_arrivals() -> Arrivals:
    """Return the arrivals of a stream without messages."""
    return Arrivals(array("q"), array("q"))


def silences(streams: Iterable[tuple[tuple[Key, int], Arrivals]]) -> Iterator[Silence]:
    """Yield the silences of trucks' regular streams; between two boots a truck was off."""
    boots: dict[tuple[str, str, int], dict[Key, _Steps]] = {}
    for (where, boot_id), arrivals in streams:
        if where.owner == "vehicle" and topic(where.owner, where.stream).nominal_rate_hz:
            of_boot = boots.setdefault((where.realm, where.identifier, boot_id), {})
            of_boot[where] = _Steps(arrivals)
    for (_, _, boot_id), of_boot in boots.items():
        for where, steps in of_boot.items():
            others = [one for other, one in of_boot.items() if other != where]
            for begin_ns, end_ns, is_whole in steps.inner():
                is_pause = is_whole and all(one.is_silent(begin_ns, end_ns) for one in others)
                yield Silence(where, boot_id, begin_ns, end_ns, is_pause)


class _Steps:
    """Silences of one stream in order of time."""

    def __init__(self, arrivals: Arrivals) -> None:
        times_ns, sequences = (np.array(one, dtype=np.int64) for one in arrivals)
        order = np.argsort(times_ns, kind="stable")
        times_ns = times_ns[order]
        at = np.flatnonzero(np.diff(times_ns) > LONGEST_SILENCE_S * NS_PER_S)
        self._begins_ns: NDArray[np.int64] = times_ns[at]
        self._ends_ns: NDArray[np.int64] = times_ns[at + 1]
        self._are_whole = np.diff(sequences[order])[at] == 1
        self._first_ns, self._last_ns = int(times_ns[0]), int(times_ns[-1])

    def inner(self) -> Iterator[tuple[int, int, bool]]:
        """Yield begin and end of each silence, and whether no number is missing in it."""
        columns = (self._begins_ns, self._ends_ns, self._are_whole)
        yield from zip(*(one.tolist() for one in columns), strict=True)

    def is_silent(self, begin_ns: int, end_ns: int) -> bool:
        """Return whether one silence covers at least half of a time."""
        first = np.searchsorted(self._ends_ns, begin_ns, side="right")
        last = np.searchsorted(self._begins_ns, end_ns, side="left")
        begins_ns = [self._last_ns, begin_ns, *self._begins_ns[first:last].tolist()]
        ends_ns = [end_ns, self._first_ns, *self._ends_ns[first:last].tolist()]
        return any(
            2 * (min(end, end_ns) - max(begin, begin_ns)) >= end_ns - begin_ns
            for begin, end in zip(begins_ns, ends_ns, strict=True)
        )
