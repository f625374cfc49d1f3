"""The worker in realm live: real crossings wait for a certificate, and get their result with it."""

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import zenoh

from schemas.proto import driveby_pb2 as pb
from schemas.settings import IdentificationSettings
from schemas.signals import Identity
from schemas.site_file import load_site
from schemas.topics import selector
from schemas.validation_records import (
    VehicleBridgePair,
    load_validation,
    pair_hash,
    validation_path,
)
from services.bus.publisher import Publisher
from services.bus.session import open_session
from services.bus.subscription import RawSample, Subscription
from services.cli.health import health_command
from services.common.errors import InputError
from services.history.validation_files import save
from services.recordings.recording import read_messages, read_site
from services.worker.run import run as run_worker
from services.worker.settings import WorkerSettings
from tests.builders.certificates import certificate
from tests.builders.processes import stop
from tests.process_replay.starting import Process, Start, start_logger
from tests.waiting import LONGEST_S, until

pytestmark = pytest.mark.process

PAIR = VehicleBridgePair("truck-1", "bridge-1")
SETTINGS = IdentificationSettings()
Begin = Callable[[], Process]


@pytest.fixture
def site(project: Path, tmp_path: Path) -> Path:
    """That of the sample, which is what will be driven."""
    text = read_site(project / "recordings" / "sample" / "crossing.mcap")
    assert text is not None
    path = tmp_path / "site.toml"
    path.write_text(text)
    return path


@pytest.fixture
def bus(start: Start, endpoint: str, tmp_path: Path) -> Iterator[zenoh.Session]:
    start_logger(start, endpoint, tmp_path / "recorded.mcap")
    with open_session(connect=endpoint, timeout_s=LONGEST_S) as session:
        yield session


@pytest.fixture
def begin(start: Start, endpoint: str, site: Path, tmp_path: Path) -> Begin:
    def one() -> Process:
        return start(
            "services.worker",
            endpoint=endpoint,
            realm="live",
            site=site,
            folder=tmp_path / "runs",
            file=None,
            method="pre",
            service_id="worker",
        )

    return one


@pytest.fixture
def driven(bus: zenoh.Session, project: Path) -> Iterator[None]:
    """The sample has been driven, and its publisher still has everything."""
    publisher = Publisher(bus, "live")
    for message in read_messages(project / "recordings" / "sample" / "crossing.mcap"):
        if message.key.owner == "vehicle":
            identity = Identity(message.boot_id, message.sequence)
            key = message.key
            publisher.put(key.owner, key.identifier, key.stream, message.payload, identity)
    yield
    publisher.close()


class Heard:
    """What has been said of the bridge, each message once."""

    def __init__(self, subscription: Subscription) -> None:
        self._subscription = subscription
        self._received: dict[tuple[str, int, int], RawSample] = {}

    def _take(self) -> None:
        one = self._subscription.receive(0.1)
        if one is not None:
            self._received.setdefault((one.key().stream, *one.identity()), one)

    def states(self) -> list[pb.CrossingState]:
        self._take()
        return [
            pb.Crossing.FromString(one.payload).state
            for one in self._received.values()
            if one.key().stream == "crossing"
        ]

    def estimates(self) -> list[pb.Estimate]:
        self._take()
        return [
            pb.Estimate.FromString(one.payload)
            for one in self._received.values()
            if one.key().stream == "estimate"
        ]


WAITS = [pb.DETECTED, pb.COMPLETE, pb.WAITING_NOT_VALIDATED]
WHOLE = [*WAITS, pb.IDENTIFYING, pb.DONE]


def test_a_crossing_waits_until_a_certificate_has_passed(
    bus: zenoh.Session, endpoint: str, begin: Begin, driven: None, site: Path, tmp_path: Path
) -> None:
    """One that failed is there; the worker is started again; then one is put there that passed."""
    folder = tmp_path / "runs" / "certificates"
    known = load_site(site)
    save(folder, certificate(known, PAIR, passed=False, reason="it was so"))
    with (
        Subscription(bus, selector("live", "bridge")) as results,
        Subscription(bus, selector("live", "service", "health")) as health,
    ):
        heard = Heard(results)
        process = begin()
        until(lambda: heard.states() == WAITS, "a crossing that waits")
        notes: list[str] = []

        def noted() -> bool:
            one = health.receive(0.1)
            if one is not None:
                notes.append(pb.Health.FromString(one.payload).note)
            return "truck-1 on bridge-1 is not validated: it was so" in notes

        until(noted, "the reason")
        line = health_command(service="worker", endpoint=endpoint, tls=None, realm="live")
        assert line.endswith("; truck-1 on bridge-1 is not validated: it was so")
        log = stop(process)
        assert log.count("it was so") == 1
        assert "1 crossing still waiting for a site validation" in log

        process = begin()
        notes.clear()
        until(noted, "the reason, again")
        assert heard.states() == WAITS
        assert heard.estimates() == []
        save(folder, certificate(known, PAIR))
        until(lambda: heard.states() == WHOLE, "its result")
        log = stop(process)
        assert "1 crossing waited for a site validation when an earlier run ended" in log
    (estimate,) = heard.estimates()
    assert estimate.certificate == pair_hash(known, PAIR, SETTINGS)
    assert estimate.verdict == pb.GOOD


@pytest.mark.slow
def test_a_worker_makes_the_certificate_itself(
    bus: zenoh.Session, begin: Begin, driven: None, site: Path, tmp_path: Path
) -> None:
    """All of it: the crossing waits, its truck and bridge are simulated, it gets its result."""
    digest = pair_hash(load_site(site), PAIR, SETTINGS)
    with (
        Subscription(bus, selector("live", "bridge")) as results,
        Subscription(bus, selector("live", "service", "progress")) as progress,
    ):
        heard = Heard(results)
        process = begin()
        until(lambda: heard.states() == WAITS, "a crossing that waits")
        until(lambda: heard.states() == WHOLE, "its result")
        log = stop(process)
        stages = set()
        while (one := progress.receive(0.1)) is not None:
            stages.add(pb.Progress.FromString(one.payload).stage)
    (estimate,) = heard.estimates()
    assert estimate.certificate == digest
    made = load_validation(validation_path(tmp_path / "runs" / "certificates", digest))
    assert made.passed
    assert made.figures.good >= 8
    assert "is validated" in log
    assert f"validating {PAIR}" in stages


def test_other_methods_have_no_certificates(endpoint: str, site: Path) -> None:
    with pytest.raises(InputError, match=r"^--method least-squares: has no site validation"):
        run_worker(
            WorkerSettings(
                endpoint=endpoint,
                realm="live",
                site=site,
                folder=site.parent,
                file=None,
                method="least_squares",
                service_id="worker",
            )
        )
