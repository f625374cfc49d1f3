"""What a subscription of a test must get, and what is latched."""

import zenoh

from services.bus.subscription import RawSample, Subscription
from tests.waiting import until


def several(subscription: Subscription, number: int) -> list[RawSample]:
    """The next messages, as many as there must be."""
    received: list[RawSample] = []

    def has_enough() -> bool:
        if (one := subscription.receive(0.2)) is not None:
            received.append(one)
        return len(received) >= number

    until(has_enough, f"{number} messages")
    return received


def get_latest(session: zenoh.Session, key_expression: str, timeout_s: float = 5.0) -> list[bytes]:
    """Return the last payload of every latched topic under a key expression."""
    replies = session.get(key_expression, target=zenoh.QueryTarget.ALL, timeout=timeout_s)
    samples = [reply.ok for reply in replies]
    return [sample.payload.to_bytes() for sample in samples if sample is not None]
