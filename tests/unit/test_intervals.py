"""Intervals against Python's own set."""

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
    missing = [n for first, last in intervals.holes_from_zero() for n in range(first, last + 1)]
    assert missing == sorted(set(range(max(reference, default=0))) - reference)
    inner = [n for first, last in intervals.holes() for n in range(first, last + 1)]
    assert inner == [n for n in missing if n > min(reference)]
    contiguous = next(n for n in range(42) if n not in reference) - 1
    assert intervals.contiguous_from_zero == (contiguous if contiguous >= 0 else None)


def test_memory_grows_with_holes_only() -> None:
    intervals = Intervals()
    for number in range(10_000):
        intervals.add(number)
    assert len(intervals._first) == 1
