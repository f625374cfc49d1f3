"""The page of topics is that of the table, and the subscriber that it shows works."""

from schemas.topics_page import PAGE, SUBSCRIBER, page


def test_the_page_is_in_step_with_the_table() -> None:
    assert PAGE.read_text() == page(), "docs/topics.md is old: run python -m schemas.topics_page"


def test_the_subscriber_is_short() -> None:
    assert sum(bool(line) for line in SUBSCRIBER.splitlines()) <= 15
