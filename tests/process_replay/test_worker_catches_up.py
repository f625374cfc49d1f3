"""A worker that was away finds in the logger's recordings what its trucks do not send any more."""

import signal
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import zenoh

from schemas.proto import driveby_pb2 as pb
from schemas.results import load_results
from schemas.site_file import site_hash, site_toml
from schemas.topics import selector
from services.bus.session import open_session
from services.bus.subscription import RawSample, Subscription
from services.recordings.recording import read_messages
from services.simulation.drive import SimulatedDrive, paper_site, write_drive
from tests.builders.processes import stop
from tests.process_replay.starting import Process, Start, start_logger
from tests.waiting import LONGEST_S, until

pytestmark = pytest.mark.process
REALM = "sim-away"
WHOLE = ["crossing"] * 3 + ["estimate", "crossing", "state"]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path / "recordings"


@pytest.fixture
def logger(start: Start, endpoint: str, folder: Path) -> Process:
    return start_logger(start, endpoint, None, folder=folder)


@pytest.fixture
def bus(logger: Process, endpoint: str) -> Iterator[zenoh.Session]:
    with open_session(connect=endpoint, timeout_s=LONGEST_S) as session:
        yield session


@pytest.fixture
def drive_by(
    start: Start, endpoint: str, tmp_path: Path, scenario_6: SimulatedDrive
) -> Callable[[], None]:
    """A truck comes, crosses the bridge of scenario 6, and leaves."""
    path = tmp_path / "drive.mcap"
    write_drive(path, scenario_6, paper_site())

    def one() -> None:
        truck = start(
            "services.truck",
            recording=path,
            endpoint=endpoint,
            realm=REALM,
            speed=1.0,  # else its two drives would seem to be at the same time
            vehicle=None,
        )
        _, log = truck.communicate(timeout=LONGEST_S)
        assert truck.returncode == 0, log

    return one


@pytest.fixture
def begin(start: Start, endpoint: str, site: Path, folder: Path) -> Callable[[], Process]:
    def one() -> Process:
        return start(
            "services.worker",
            endpoint=endpoint,
            realm=REALM,
            site=site,
            folder=folder,
            file=None,
            method="least_squares",
            service_id="worker",
        )

    return one


def test_trucks_that_came_and_left_while_the_worker_was_away(
    bus: zenoh.Session,
    logger: Process,
    begin: Callable[[], Process],
    drive_by: Callable[[], None],
    folder: Path,
) -> None:
    """One in a recording that is closed, one in a recording that is being written; the worker is
    killed as soon as it has published the first, and goes on where it was."""
    drive_by()
    logger.send_signal(signal.SIGUSR1)
    drive_by()
    until(lambda: len(list((folder / REALM).glob("*/truck-1-*.mcap"))) == 2, "two recordings")
    heard: list[RawSample] = []
    with Subscription(bus, selector(REALM, "bridge")) as results:

        def hears(number: int) -> bool:
            one = results.receive(0.1)
            if one is not None and (one.key(), one.identity()) not in (
                (other.key(), other.identity()) for other in heard
            ):
                heard.append(one)
            return sum(one.key().stream == "estimate" for one in heard) >= number

        process = begin()
        until(lambda: hears(1), "the first result")
        process.kill()
        process.communicate()
        process = begin()
        until(lambda: hears(2), "the second result")
        until(lambda: hears(2) and len(heard) >= 2 * len(WHOLE), "all that is published")
        stop(process)
        third = begin()  # and finds nothing left to do
        until(lambda: "republished" in (third.stderr or [""]).readline(), "its start")  # type: ignore[union-attr]
        stop(third)
        while results.receive(0.5) is not None:
            hears(0)
    assert sorted(one.key().stream for one in heard) == sorted(2 * WHOLE)
    estimates = [
        pb.Estimate.FromString(one.payload) for one in heard if one.key().stream == "estimate"
    ]
    assert [e.parameters["EI_4"].mean / 1.56e10 for e in estimates] == [
        pytest.approx(0.4, rel=0.01)
    ] * 2
    assert len({e.crossing_id for e in estimates}) == 2
    written = sorted((folder / REALM).glob("results-*.mcap"))
    on_disk = [m for path in written for m in read_messages(path) if m.key.stream == "estimate"]
    assert len(on_disk) == 2
    in_json = [load_results(p) for p in sorted((folder / REALM).glob("results-*.json"))]
    assert sum(len(one.crossings) for one in in_json) == 2


@pytest.mark.slow
def test_a_site_file_that_is_edited_while_the_worker_runs(
    bus: zenoh.Session,
    begin: Callable[[], Process],
    drive_by: Callable[[], None],
    site: Path,
    folder: Path,
) -> None:
    """A crossing before and one after, by their site files; a broken one in between; and a worker
    that starts with the edited one identifies neither again."""
    before = paper_site()
    bridge = before.bridges[0].model_copy(update={"owner_id": "B 27"})
    edited = before.model_copy(update={"bridges": (bridge,)})
    estimates: dict[str, str] = {}
    with Subscription(bus, selector(REALM, "bridge", "estimate")) as results:

        def heard(number: int) -> bool:
            one = results.receive(0.1)
            if one is not None:
                estimate = pb.Estimate.FromString(one.payload)
                published = estimates.setdefault(estimate.crossing_id, estimate.site_hash)
                assert published == estimate.site_hash
            return len(estimates) >= number

        process = begin()
        drive_by()
        until(lambda: heard(1), "the first result")
        site.write_text("nonsense")
        log = process.stderr
        assert log is not None
        until(lambda: "keeping the previous site file" in log.readline(), "a warning")
        site.write_text(site_toml(edited))
        until(lambda: "was edited" in log.readline(), "that it is taken up")
        drive_by()
        until(lambda: heard(2), "the second result")
        stop(process)
        again = begin()
        until(lambda: "republished" in (again.stderr or [""]).readline(), "its start")  # type: ignore[union-attr]
        drive_by()
        until(lambda: heard(3), "the third result")
        stop(again)
        heard(4)
    assert list(estimates.values()) == [site_hash(before), site_hash(edited), site_hash(edited)]
    found = [load_results(path) for path in sorted((folder / REALM).glob("results-*.json"))]
    assert [(one.site_hash, len(one.crossings)) for one in found] == [
        (site_hash(before), 1),
        (site_hash(edited), 1),
        (site_hash(edited), 1),
    ]
