"""A queue that is bounded in messages and bytes, and counts what it drops."""

from services.truck.bounded_queue import BoundedQueue, DroppedItems


def test_queue_keeps_the_newest_within_both_bounds_and_counts_the_rest() -> None:
    queue = BoundedQueue[int](most_messages=3, most_bytes=100)
    for number in range(5):
        queue.put(number, 10)
    assert queue.dropped() == DroppedItems(2, 20)
    assert queue.dropped() == DroppedItems(0, 0)
    queue.put(5, 85)  # with 10 bytes of one before it
    assert queue.dropped() == DroppedItems(2, 20)
    assert [queue.get(), queue.get(), queue.get()] == [4, 5, None]


def test_item_larger_than_the_queue_pushes_nothing_out() -> None:
    queue = BoundedQueue[int](most_messages=3, most_bytes=100)
    queue.put(0, 100)
    queue.put(1, 101)
    assert queue.dropped() == DroppedItems(1, 101)
    assert (len(queue), queue.get(), queue.get()) == (1, 0, None)


def test_room_of_what_was_taken_is_free_again() -> None:
    queue = BoundedQueue[int](most_messages=2, most_bytes=100)
    for number in range(50):
        queue.put(number, 60)
        assert queue.get() == number
    assert queue.dropped() == DroppedItems(0, 0)
