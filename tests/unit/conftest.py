"""A bus with two sessions in this process, and the site file of the docs."""

from collections.abc import Iterator
from pathlib import Path

import pytest
import zenoh

from schemas.site import Site
from schemas.site_file import load_site
from services.bus.session import open_session
from tests.waiting import LONGEST_S


@pytest.fixture(scope="session")
def site(project: Path) -> Site:
    return load_site(project / "docs/site.example.toml")


@pytest.fixture
def router(endpoint: str) -> Iterator[zenoh.Session]:
    with open_session(listen=endpoint) as session:
        yield session


@pytest.fixture
def client(router: zenoh.Session, endpoint: str) -> Iterator[zenoh.Session]:
    with open_session(connect=endpoint, timeout_s=LONGEST_S) as session:
        yield session
