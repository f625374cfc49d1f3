"""What a worker's ledger knows of crossings."""

from collections.abc import Iterable

from schemas.topics import Key
from services.identification.known import CrossingRecord
from services.ledger.crossing_log import CrossingLog


def known_crossings(
    messages: Iterable[tuple[Key, bytes]], search: str | None = None
) -> list[CrossingRecord]:
    """Return the crossings that messages, in the order of their publication, describe."""
    log = CrossingLog(search)
    for key, payload in messages:
        log.add(key, payload)
    return log.crossings()
