"""Intervals against Python's own set."""

from itertools import pairwise

from hypothesis import given
from hypothesis import strategies as st

from services.common.intervals import Intervals


@given(st.lists(st.integers(0, 40)))
def test_as_a_set(numbers: list[int]) -> None:
    intervals, reference = Intervals(), set[int]()
    for number in numbers:
        assert intervals.add(number) == (number not in reference)
        reference.add(number)
        assert intervals.size == len(reference)
    assert all((number in intervals) == (number in reference) for number in range(42))
    assert intervals.highest == max(reference, default=None)
    missing = [n for first, last in intervals.gaps_from_zero() for n in range(first, last + 1)]
    assert missing == sorted(set(range(max(reference, default=0))) - reference)
    inner = [n for first, last in intervals.gaps() for n in range(first, last + 1)]
    assert inner == [n for n in missing if n > min(reference)]
    contiguous = next(n for n in range(42) if n not in reference) - 1
    assert intervals.contiguous_from_zero == (contiguous if contiguous >= 0 else None)


RANGES = st.lists(st.tuples(st.integers(0, 40), st.integers(0, 40), st.booleans()))


@given(st.lists(st.integers(0, 40)), RANGES)
def test_ranges_as_a_set(numbers: list[int], ranges: list[tuple[int, int, bool]]) -> None:
    intervals, reference = Intervals(), set[int]()
    for number in numbers:
        intervals.add(number)
        reference.add(number)
    for first, last, is_added in ranges:
        wanted = set(range(first, last + 1))
        missing = [n for a, b in intervals.missing_of([(first, last)]) for n in range(a, b + 1)]
        assert missing == sorted(wanted - reference)
        if is_added:
            assert intervals.add_range(first, last) == len(wanted - reference)
            reference |= wanted
        else:
            assert intervals.remove_range(first, last) == len(wanted & reference)
            reference -= wanted
        runs = intervals.ranges()
        assert [n for a, b in runs for n in range(a, b + 1)] == sorted(reference)
        assert all(b + 1 < a for (_, b), (a, _) in pairwise(runs))
        assert (intervals.size, intervals.runs) == (len(reference), len(runs))


def test_memory_grows_with_holes_only() -> None:
    intervals = Intervals()
    for number in range(10_000):
        intervals.add(number)
    assert len(intervals._first) == 1
