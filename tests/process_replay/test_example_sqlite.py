"""The subscriber of docs/examples/sqlite stores what a worker publishes."""

import os
import re
import signal
import sqlite3
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from schemas.results import ResultHeader
from schemas.results_on_the_wire import crossing_to_protobuf
from schemas.site_file import load_site
from services.bus.publisher import Publisher
from services.bus.session import open_session
from tests.unit.viewer.found import results_of, some_crossing
from tests.waiting import LONGEST_S, until

pytestmark = pytest.mark.process


class Bus(NamedTuple):
    """Address of a bus, and the arguments with which the subscriber joins it."""

    endpoint: str
    credentials: Path | None = None

    @property
    def joined_with(self) -> list[Path]:
        return [] if self.credentials is None else [self.credentials / "viewer"]


@pytest.fixture(params=["open", "secured"])
def bus(request: pytest.FixtureRequest) -> Bus:
    if request.param == "open":
        return Bus(request.getfixturevalue("endpoint"))
    return Bus(*map(request.getfixturevalue, ("tls_endpoint", "credentials")))


@pytest.fixture
def publisher(bus: Bus) -> Iterator[Publisher]:
    tls = None if bus.credentials is None else bus.credentials / "logger"
    with open_session(listen=bus.endpoint, tls=tls) as session:
        publisher = Publisher(session, "live")
        yield publisher
        publisher.close()


def put(publisher: Publisher, project: Path, *, created: float, **crossing: Any) -> None:
    site = load_site(project / "docs/site.example.toml")
    found = results_of(site, some_crossing(**crossing)).crossings[0]
    message = crossing_to_protobuf(found, ResultHeader("0.1.0", created, "hash", {}, 1))
    publisher.put("bridge", "bridge-1", "estimate", message.SerializeToString())


def rows(path: Path, query: str) -> list[tuple[object, ...]]:
    if not path.exists():
        return []
    with closing(sqlite3.connect(path, timeout=LONGEST_S)) as database:
        try:
            return database.execute(query).fetchall()
        except sqlite3.OperationalError:  # its tables are being created
            return []


def test_each_crossing_is_stored_once_with_its_newest_result(
    publisher: Publisher, bus: Bus, tmp_path: Path, project: Path
) -> None:
    folder = project / "docs/examples/sqlite"
    path = tmp_path / "results.sqlite"
    put(publisher, project, created=2e9, name="before the start")
    program = subprocess.Popen(
        [sys.executable, folder / "results_to_sqlite.py", bus.endpoint, path, *bus.joined_with],
        env=os.environ | {"PYTHONPATH": str(project)},
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        of_crossings = "SELECT crossing_id, verdict, reasons FROM crossing ORDER BY entry_time"

        def has(count: int) -> bool:
            assert program.poll() is None, "the program has ended"
            return len(rows(path, of_crossings)) == count

        until(lambda: has(1), "the result from before the start")
        put(publisher, project, created=1e9, name="before the start", verdict="suspect")
        put(publisher, project, created=1e9, name="again", entry=60.0, verdict="suspect")
        put(publisher, project, created=2e9, name="again", entry=60.0)
        lost = {"verdict": "rejected", "reasons": ("channel_missing",)}
        put(publisher, project, created=2e9, name="rejected", entry=120.0, **lost)
        until(lambda: has(3), "three crossings")
        assert rows(path, of_crossings) == [
            ("before the start", "GOOD", ""),
            ("again", "GOOD", ""),
            ("rejected", "REJECTED", "channel_missing"),
        ]
        program.send_signal(signal.SIGINT)
        assert program.communicate(timeout=LONGEST_S)[1] == ""
        assert program.returncode == 0
    finally:
        program.kill()
        program.communicate()
    counted = "SELECT crossing_id, count(*) FROM element GROUP BY crossing_id ORDER BY 1"
    assert rows(path, counted) == [("again", 7), ("before the start", 7)]
    (query,) = re.findall(r"```sql\n(.*?)```", (folder / "README.md").read_text(), re.DOTALL)
    weak = rows(path, query)
    assert [row[:3] for row in weak] == [
        ("bridge-1", 4, "2026-09-21 14:13:20"),
        ("bridge-1", 4, "2026-09-21 14:14:20"),
    ]
    assert all(0.3 < float(str(low)) / 1.56e10 < 0.6 for *_, low, _ in weak)
