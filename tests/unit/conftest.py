"""A bus with two sessions in this process."""

from collections.abc import Iterator

import pytest
import zenoh

from services.bus.session import open_session
from tests.waiting import LONGEST_S


@pytest.fixture
def router(endpoint: str) -> Iterator[zenoh.Session]:
    with open_session(listen=endpoint) as session:
        yield session


@pytest.fixture
def client(router: zenoh.Session, endpoint: str) -> Iterator[zenoh.Session]:
    with open_session(connect=endpoint, timeout_s=LONGEST_S) as session:
        yield session
