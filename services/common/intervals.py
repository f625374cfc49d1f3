"""A growing set of sequence numbers, stored as intervals: received and missing messages."""

from bisect import bisect_left, bisect_right
from collections.abc import Iterable


class Intervals:
    """A set of integers whose memory depends on the number of gaps, not on its size."""

    def __init__(self) -> None:
        self._first: list[int] = []
        self._last: list[int] = []
        self.size = 0
        """Number of elements of the set."""

    def add(self, number: int) -> bool:
        """Add a number; return False if it was present."""
        if self._last and number == self._last[-1] + 1:  # the usual case
            self._last[-1] = number
            self.size += 1
            return True
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

    def add_range(self, first: int, last: int) -> int:
        """Add all numbers from first to last; return how many were new."""
        if last < first:
            return 0
        # Merge every interval that overlaps or touches the new one.
        low = bisect_left(self._last, first - 1)
        high = bisect_right(self._first, last + 1)
        there = sum(
            min(b, last) - max(a, first) + 1
            for a, b in zip(self._first[low:high], self._last[low:high], strict=True)
            if a <= last and b >= first
        )
        if low < high:
            joined = (min(first, self._first[low]), max(last, self._last[high - 1]))
        else:
            joined = (first, last)
        self._first[low:high], self._last[low:high] = [joined[0]], [joined[1]]
        new = last - first + 1 - there
        self.size += new
        return new

    def remove_range(self, first: int, last: int) -> int:
        """Remove all numbers from first to last; return how many were present."""
        low, high = bisect_left(self._last, first), bisect_right(self._first, last)
        if last < first or low >= high:
            return 0
        left = [(a, b) for a, b in ((self._first[low], first - 1), (last + 1, self._last[high - 1]))
                if a <= b]  # fmt: skip
        before = sum(
            b - a + 1 for a, b in zip(self._first[low:high], self._last[low:high], strict=True)
        )
        self._first[low:high] = [a for a, _ in left]
        self._last[low:high] = [b for _, b in left]
        removed = before - sum(b - a + 1 for a, b in left)
        self.size -= removed
        return removed

    def __contains__(self, number: int) -> bool:
        at = bisect_right(self._first, number)
        return at > 0 and number <= self._last[at - 1]

    @property
    def contiguous_from_zero(self) -> int | None:
        """The highest number without a gap from 0; None if 0 is missing."""
        return self._last[0] if self._first and self._first[0] == 0 else None

    @property
    def highest(self) -> int | None:
        """The highest number; None if the set is empty."""
        return self._last[-1] if self._last else None

    def ranges(self) -> list[tuple[int, int]]:
        """Return (first, last) of every run of numbers in the set."""
        return list(zip(self._first, self._last, strict=True))

    def missing_of(self, ranges: Iterable[tuple[int, int]]) -> list[tuple[int, int]]:
        """Return the parts of the given (first, last) that are not in the set."""
        missing = []
        for first, last in ranges:
            at = bisect_left(self._last, first)
            while first <= last and at < len(self._first) and self._first[at] <= last:
                if first < self._first[at]:
                    missing.append((first, self._first[at] - 1))
                first = self._last[at] + 1
                at += 1
            if first <= last:
                missing.append((first, last))
        return missing

    @property
    def runs(self) -> int:
        """The number of runs, which determines the memory of the set."""
        return len(self._first)

    def gaps(self) -> list[tuple[int, int]]:
        """Return (first, last) of every gap between numbers in the set."""
        return [
            (last + 1, first - 1)
            for last, first in zip(self._last[:-1], self._first[1:], strict=True)
        ]

    def gaps_from_zero(self) -> list[tuple[int, int]]:
        """Return the gaps, and the one from 0 to the lowest number in the set."""
        before = [(0, self._first[0] - 1)] if self._first and self._first[0] > 0 else []
        return before + self.gaps()
