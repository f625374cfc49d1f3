"""A viewer that reads everything: `python subscriber_process.py ENDPOINT`."""

import sys

from schemas.topics import selector
from services.bus.session import open_session
from services.bus.subscription import Subscription
from tests.parent import die_with_parent


def main(endpoint: str) -> None:
    with (
        open_session(connect=endpoint, timeout_s=300) as session,
        Subscription(session, selector("live", "vehicle")) as subscription,
    ):
        print("ready", flush=True)
        while True:
            subscription.receive(1.0)


if __name__ == "__main__":
    die_with_parent()
    main(*sys.argv[1:])
