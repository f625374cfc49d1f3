"""What a subscription of a test must get."""

from services.bus.subscription import RawSample, Subscription
from tests.waiting import until


def several(subscription: Subscription, number: int) -> list[RawSample]:
    """The next messages, as many as there must be."""
    received: list[RawSample] = []
    until(
        lambda: (
            received.extend(one for one in [subscription.receive(0.2)] if one is not None)
            or len(received) >= number
        ),
        f"{number} messages",
    )
    return received
