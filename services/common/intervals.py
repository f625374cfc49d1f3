"""A growing set of sequence numbers, as few intervals: what came, what is missing."""

from bisect import bisect_right


class Intervals:
    """A set of integers that takes memory by its number of holes, not by its size."""

    def __init__(self) -> None:
        self._first: list[int] = []
        self._last: list[int] = []
        self.size = 0
        """How many numbers are in the set."""

    def add(self, number: int) -> bool:
        """Put a number in; False if it was there."""
        at = bisect_right(self._first, number)
        if at and number <= self._last[at - 1]:
            return False
        self.size += 1
        joins_left = at > 0 and self._last[at - 1] == number - 1
        joins_right = at < len(self._first) and self._first[at] == number + 1
        if joins_left and joins_right:
            self._last[at - 1] = self._last[at]
            del self._first[at], self._last[at]
        elif joins_left:
            self._last[at - 1] = number
        elif joins_right:
            self._first[at] = number
        else:
            self._first.insert(at, number)
            self._last.insert(at, number)
        return True

    def __contains__(self, number: int) -> bool:
        at = bisect_right(self._first, number)
        return at > 0 and number <= self._last[at - 1]

    @property
    def contiguous_from_zero(self) -> int | None:
        """The highest number with nothing missing from 0 to it; None if 0 is missing."""
        return self._last[0] if self._first and self._first[0] == 0 else None

    @property
    def highest(self) -> int | None:
        """The highest number; None if the set is empty."""
        return self._last[-1] if self._last else None

    def holes(self) -> list[tuple[int, int]]:
        """Return (first, last) of every run of missing numbers between numbers that are there."""
        return [
            (last + 1, first - 1)
            for last, first in zip(self._last[:-1], self._first[1:], strict=True)
        ]

    def holes_from_zero(self) -> list[tuple[int, int]]:
        """Return the holes, and what is missing from 0 to the lowest number that is there."""
        before = [(0, self._first[0] - 1)] if self._first and self._first[0] > 0 else []
        return before + self.holes()
