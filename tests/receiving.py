"""What a subscription of a test must get."""

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
