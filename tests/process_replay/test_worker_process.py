"""The worker as a process: late, disturbed, stopped, killed and started again."""

import itertools
import os
import re
import resource
import signal
import subprocess
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import zenoh

from schemas.proto import driveby_pb2 as pb
from schemas.results import load_results
from schemas.signals import Identity, decode_info, encode_info
from schemas.topics import Message, key, selector
from services.bus.publisher import Publisher
from services.bus.session import open_session
from services.bus.subscription import RawSample, Subscription
from services.common.errors import InputError
from services.common.files import lock_folder
from services.common.geodesy import bridge_frame, to_lat_lon
from services.drives.runs import GnssTrack, run_to_messages
from services.recordings.recording import read_info, read_messages, read_site
from services.recordings.writer import RecordingWriter
from services.simulation.drive import SimulatedDrive, paper_site
from services.worker.run import run as run_worker
from services.worker.settings import WorkerSettings
from tests.builders.processes import stop
from tests.receiving import get_latest, several
from tests.waiting import LONGEST_S, until

pytestmark = pytest.mark.process

Start = Callable[..., subprocess.Popen[str]]
End = Callable[[subprocess.Popen[str]], None]
Begin = Callable[[], subprocess.Popen[str]]
REALM = "sim-worker"
LARGEST_FILE = 60_000
"""Bytes: more than the recording of one result, less than the same as JSON."""


@pytest.fixture(scope="module")
def drive_on(scenario_6: SimulatedDrive) -> list[Message]:
    """Scenario 6, and then half a minute of driving on: longer than the worker is patient."""
    run, site = scenario_6.run, paper_site()
    more = 30.0
    rng = np.random.default_rng(2)
    extra = run.accel_time_s[-1] + np.arange(1, round(more * run.rate_hz)) / run.rate_hz
    fixes = run.gnss.time_s[-1] + np.arange(1, round(more * 10)) / 10.0
    latitude, longitude = to_lat_lon(
        bridge_frame(site.bridges[0]), 60.0 + 10.0 * (fixes - run.gnss.time_s[-1])
    )
    still = np.full(fixes.size, 1.0)
    gnss = GnssTrack(
        np.append(run.gnss.time_s, fixes),
        np.append(run.gnss.latitude_deg, latitude),
        np.append(run.gnss.longitude_deg, longitude),
        np.append(run.gnss.altitude_m, 25.0 * still),
        np.append(run.gnss.speed_m_per_s, 10.0 * still),
        None,
    )
    channels = {
        name: np.append(values, 0.1 * rng.standard_normal(extra.size))
        for name, values in run.channels.items()
    }
    longer = run._replace(
        accel_time_s=np.append(run.accel_time_s, extra), channels=channels, gnss=gnss
    )
    return list(run_to_messages([longer], site, REALM, "truck-1"))


@pytest.fixture
def sample(project: Path, site: Path) -> list[Message]:
    """The sample's messages; the worker's site file becomes the sample's."""
    recording = project / "recordings" / "sample" / "crossing.mcap"
    text = read_site(recording)
    assert text is not None
    site.write_text(text)
    return list(read_messages(recording))


@pytest.fixture
def bus(start: Start, endpoint: str, tmp_path: Path) -> Iterator[zenoh.Session]:
    """A session of the test, behind the logger's router."""
    start(
        "services.logger",
        listen=endpoint,
        folder=tmp_path,
        file=tmp_path / "recorded.mcap",
        realms=("*",),
        site=None,
    )
    with open_session(connect=endpoint, timeout_s=LONGEST_S) as session:
        yield session


@pytest.fixture
def worker(
    start: Start, endpoint: str, site: Path, tmp_path: Path
) -> Callable[[], subprocess.Popen[str]]:
    def begin() -> subprocess.Popen[str]:
        return start(
            "services.worker",
            endpoint=endpoint,
            realm=REALM,
            site=site,
            folder=tmp_path,
            file=tmp_path / "results.mcap",
            method="least_squares",
            service_id="worker",
        )

    return begin


def publish(publisher: Publisher, messages: list[Message]) -> None:
    for message in messages:
        identity = Identity(message.boot_id, message.sequence)
        _, owner, identifier, stream = message.key
        publisher.put(owner, identifier, stream, message.payload, identity)


def up_to(subscription: Subscription, stream: str) -> list[RawSample]:
    """Everything up to the first message of a stream."""
    received: list[RawSample] = []
    deadline = time.monotonic() + LONGEST_S
    while time.monotonic() < deadline:
        one = subscription.receive(0.2)
        if one is not None:
            received.append(one)
            if one.key().stream == stream:
                return received
    pytest.fail(f"no {stream} within {LONGEST_S} s, only {[r.key_text for r in received]}")


def after(subscription: Subscription, seconds: float) -> list[RawSample]:
    received = []
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        one = subscription.receive(0.2)
        if one is not None:
            received.append(one)
    return received


def ratio_of(estimate: RawSample) -> float:
    message = pb.Estimate.FromString(estimate.payload)
    return message.parameters["EI_4"].mean / 1.56e10


def test_a_worker_that_comes_late_gives_the_result_once(
    bus: zenoh.Session,
    worker: Begin,
    terminate: End,
    drive_on: list[Message],
    tmp_path: Path,
) -> None:
    """The truck has driven and fallen silent; its publisher still has everything."""
    with Subscription(bus, selector(REALM, "bridge")) as results:
        publisher = Publisher(bus, REALM)
        publish(publisher, drive_on)
        process = worker()
        published = up_to(results, "state") + after(results, 3.0)
        publisher.close()
        terminate(process)
    streams = [received.key().stream for received in published]
    assert streams == ["crossing"] * 3 + ["estimate", "crossing", "state"]
    assert ratio_of(published[3]) == pytest.approx(0.4, rel=0.01)

    found = load_results(tmp_path / "results.json")
    (crossing,) = found.crossings
    estimate = pb.Estimate.FromString(published[3].payload)
    assert crossing.crossing_id == estimate.crossing_id
    assert (found.site_hash, found.version) == (estimate.site_hash, estimate.version)
    info = read_info(tmp_path / "results.mcap")
    assert info.end is not None
    assert (info.end["reason"], info.end["crossings"]) == ("stopped by a signal", "1")
    assert info.site_toml is not None
    stored = [message.payload for message in read_messages(tmp_path / "results.mcap")]
    assert stored == [received.payload for received in published]


@pytest.mark.parametrize(
    ("who", "reason"),
    [("itself", "vehicle_differs_from_site"), ("a-stranger", "other_truck_on_bridge")],
)
def test_unusable_or_unknown_truck_is_reported_live(
    bus: zenoh.Session,
    worker: Begin,
    terminate: End,
    drive_on: list[Message],
    who: str,
    reason: str,
) -> None:
    """30 t and 7 m, said before the worker came; a truck unknown to the site, at the same place."""
    sent = drive_on
    if who == "itself":
        heavy = '[vehicle]\nid = "truck-1"\ntotal_mass_kg = 30000.0\nwheelbase_m = 7.0\n'
        output = decode_info(drive_on[0].payload)._replace(site_toml=heavy)
        sent = [drive_on[0]._replace(payload=encode_info(output)), *drive_on[1:]]
    else:
        theirs = [
            message._replace(key=message.key._replace(identifier=who))
            for message in drive_on
            if message.key.stream == "gnss"
        ]
        sent = [*theirs, *drive_on]
    with Subscription(bus, selector(REALM, "bridge")) as results:
        publisher = Publisher(bus, REALM)
        publish(publisher, sent)
        process = worker()
        published = up_to(results, "estimate")[-1]
        publisher.close()
        terminate(process)
    estimate = pb.Estimate.FromString(published.payload)
    assert list(estimate.reasons) == [reason]
    assert not estimate.parameters


def test_a_worker_outlives_what_strangers_send(
    bus: zenoh.Session,
    worker: Begin,
    terminate: End,
    drive_on: list[Message],
) -> None:
    """Tokens and keys that are none, messages that are none, and a truck nobody knows."""
    prefix = f"driveby/v1/{REALM}/vehicle"
    with (
        Subscription(bus, selector(REALM, "bridge")) as results,
        Subscription(bus, selector(REALM, "service", "health")) as health,
    ):
        process = worker()
        up_to(health, "health")
        token = bus.liveliness().declare_token(f"{prefix}/TRUCK/alive")
        publisher = Publisher(bus, REALM)
        half = len(drive_on) // 20
        publish(publisher, drive_on[:half])
        bus.put(f"{prefix}/TRUCK/accel", b"x")
        bus.put(f"{prefix}/truck-1/gnss", b"x")
        bus.put(f"{prefix}/truck-1/nonsense", b"x", attachment=b"1" * 16)
        for number, payload in enumerate((b"", b"\xff" * 50, b"\x00" * 10_000)):
            publisher.put(
                "vehicle",
                "truck-1",
                "accel",
                payload,
                Identity(drive_on[0].boot_id, 70_000 + number),
            )
        # Before the bridge: on it, it would count.
        stranger = [m._replace(key=m.key._replace(identifier="stranger")) for m in drive_on[:half]]
        publish(publisher, stranger)
        token.undeclare()
        publish(publisher, drive_on[half:])
        published = up_to(results, "state")
        publisher.close()
        terminate(process)
    estimates = [received for received in published if received.key().stream == "estimate"]
    assert [ratio_of(one) for one in estimates] == [pytest.approx(0.4, rel=0.01)]


def test_a_second_truck_does_not_keep_the_first_from_leaving(
    bus: zenoh.Session,
    worker: Begin,
    terminate: End,
    drive_on: list[Message],
) -> None:
    """The first recording ends right after its exit; a busy stranger drives all the while.

    Elsewhere: it says nothing of where.
    """
    began_ns = drive_on[0].log_time_ns
    short = [m for m in drive_on if m.log_time_ns - began_ns < 7_200_000_000]
    with (
        Subscription(bus, selector(REALM, "bridge")) as results,
        Subscription(bus, selector(REALM, "service", "health")) as health,
    ):
        process = worker()
        up_to(health, "health")
        publisher = Publisher(bus, REALM)
        token = bus.liveliness().declare_token(f"driveby/v1/{REALM}/vehicle/truck-1/alive")
        publish(publisher, short)
        token.undeclare()
        estimates: list[RawSample] = []
        deadline = time.monotonic() + LONGEST_S
        stranger = itertools.cycle(
            m._replace(key=m.key._replace(identifier="stranger"))
            for m in drive_on
            if m.key.stream == "accel"
        )
        while not estimates and time.monotonic() < deadline:
            publish(publisher, [next(stranger)])
            one = results.receive(0.02)
            if one is not None and one.key().stream == "estimate":
                estimates.append(one)
        publisher.close()
        terminate(process)
    assert [ratio_of(one) for one in estimates] == [pytest.approx(0.4, rel=0.01)]


def test_last_health_of_a_worker_is_its_end(
    bus: zenoh.Session, worker: Begin, terminate: End
) -> None:
    with Subscription(bus, selector(REALM, "service", "health")) as health:
        process = worker()
        up_to(health, "health")
        terminate(process)
        while True:
            one = health.receive(LONGEST_S)
            assert one is not None, "the end was not published"
            if pb.Health.FromString(one.payload).ended:
                break


def test_a_signal_ends_a_worker_that_waits_for_a_router(
    worker: Begin,
) -> None:
    process = worker()
    assert process.stderr is not None
    assert "starting: loading kernels" in process.stderr.readline()
    assert any("no router answers" in line for line in process.stderr)  # and it tries on
    os.kill(process.pid, signal.SIGTERM)
    _, log = process.communicate(timeout=LONGEST_S)
    assert process.returncode == 0, log
    assert "stopped by a signal before a router answered" in log


def test_results_that_exist_are_left_alone(site: Path, endpoint: str, tmp_path: Path) -> None:
    file = tmp_path / "results.mcap"
    file.write_bytes(b"precious")
    with pytest.raises(InputError, match=re.escape(f"{file}: exists")):
        run_worker(
            WorkerSettings(
                endpoint=endpoint,
                realm=REALM,
                site=site,
                folder=tmp_path,
                file=file,
                method="least_squares",
                service_id="worker",
            )
        )
    assert file.read_bytes() == b"precious"


class Restartable(NamedTuple):
    """A worker that finds what earlier runs left, and what all runs together have said."""

    begin: Callable[..., subprocess.Popen[str]]
    folder: Path

    def stored(self) -> list[Message]:
        """All messages of all results files."""
        # Who is killed right after it made its file leaves one without a message.
        whole = [path for path in self.paths() if read_info(path).messages]
        return [m for path in whole for m in read_messages(path)]

    def paths(self) -> list[Path]:
        return sorted((self.folder / REALM).glob("results-2*.mcap"))

    def in_json(self) -> list[str]:
        """Crossing ids in all JSON files."""
        paths = sorted((self.folder / REALM).glob("results-*.json"))
        found = (load_results(path) for path in paths)
        return [crossing.crossing_id for one in found for crossing in one.crossings]


@pytest.fixture
def restartable(start: Start, endpoint: str, site: Path, tmp_path: Path) -> Restartable:
    folder = tmp_path / "of_runs"

    def begin(method: str = "least_squares", realm: str = REALM) -> subprocess.Popen[str]:
        return start(
            "services.worker",
            endpoint=endpoint,
            realm=realm,
            site=site,
            folder=folder,
            file=None,
            method=method,
            service_id="worker",
        )

    return Restartable(begin, folder)


def test_one_worker_at_a_time_writes_a_folder(
    restartable: Restartable, site: Path, endpoint: str
) -> None:
    """Whatever its name on the bus; a killed one is in nobody's way, nor one of another realm."""
    first = restartable.begin()
    assert first.stderr is not None
    assert any("no router answers" in line for line in first.stderr)
    here = WorkerSettings(
        endpoint=endpoint,
        realm=REALM,
        site=site,
        folder=restartable.folder,
        method="least_squares",
        service_id="another",
    )
    with pytest.raises(InputError) as refused:
        run_worker(here)
    where = restartable.folder / REALM
    assert str(refused.value).startswith(f"{where}: another worker writes its results here; ")
    assert "\n" not in str(refused.value)
    os.close(lock_folder(restartable.folder / "sim-other", ".worker.lock", "in use"))
    kill(first)
    left = where / "results-20260101T000000Z.mcap"
    RecordingWriter(left, reason="test").abandon()
    second = restartable.begin()
    assert second.stderr is not None
    assert any("no router answers" in line for line in second.stderr)
    assert not left.exists()  # without a message it is set aside by the next run
    assert left.with_name(f"{left.name}.crashed").exists()
    kill(second)


@pytest.mark.parametrize(("name", "lines"), [("worker", 1), ("another", 0)])
def test_worker_warns_of_one_with_its_name(
    bus: zenoh.Session, worker: Begin, name: str, lines: int
) -> None:
    publisher = Publisher(bus, REALM)
    health = pb.Health(schema_version=1, time_ns=time.time_ns(), service=name, ok=True)
    publisher.put("service", name, "health", health.SerializeToString())
    with Subscription(bus, key(REALM, "service", "worker", "health")) as listening:
        process = worker()
        until(
            lambda: (one := listening.receive(0.2)) and one.payload != health.SerializeToString(),
            "the worker's own health",
        )
        log = stop(process)
    publisher.close()
    assert log.count(f"another worker worker runs in realm {REALM}") == lines


WHOLE = ["crossing"] * 3 + ["estimate", "crossing", "state"]
STATES = [pb.DETECTED, pb.COMPLETE, pb.IDENTIFYING, pb.DONE]
Name = tuple[str, int, int]


def name_of(message: RawSample | Message) -> Name:
    if isinstance(message, Message):
        return message.key.stream, message.boot_id, message.sequence
    return message.key().stream, *message.identity()


def once(received: Iterable[RawSample]) -> dict[Name, bytes]:
    """Messages of a subscriber that detects duplicates by identity: the first of each."""
    first: dict[Name, bytes] = {}
    for one in received:
        assert first.setdefault(name_of(one), one.payload) == one.payload
    return first


def until_whole(subscription: Subscription, published: list[RawSample]) -> list[RawSample]:
    """Go on until everything of one crossing has been published, and a little longer."""
    published = list(published)
    deadline = time.monotonic() + LONGEST_S
    while len(once(published)) < len(WHOLE) and time.monotonic() < deadline:
        published += after(subscription, 0.2)
    return published + after(subscription, 1.5)


def kill(process: subprocess.Popen[str]) -> str:
    """Kill it; return its log."""
    process.kill()
    return process.communicate()[1]


def check_once(published: list[RawSample], restartable: Restartable, recorded: Path) -> None:
    """One crossing, published once: on the bus, in results files and the logger's recording."""
    on_bus = once(published)
    stored = {name_of(message): message.payload for message in restartable.stored()}
    assert len(stored) == len(restartable.stored())  # none in two files
    assert on_bus == stored
    assert sorted(stream for stream, _, _ in on_bus) == sorted(WHOLE)
    states = [pb.Crossing.FromString(p) for name, p in on_bus.items() if name[0] == "crossing"]
    assert sorted(state.state for state in states) == STATES
    (estimate,) = (pb.Estimate.FromString(p) for n, p in on_bus.items() if n[0] == "estimate")
    assert {state.crossing_id for state in states} == {estimate.crossing_id}
    assert restartable.in_json() == [estimate.crossing_id]
    logged = [name_of(m) for m in read_messages(recorded) if m.key.owner == "bridge"]
    assert sorted(logged) == sorted(on_bus)


def test_killed_in_the_middle_of_an_identification(
    bus: zenoh.Session,
    restartable: Restartable,
    sample: list[Message],
    tmp_path: Path,
) -> None:
    """Method pre, which takes seconds; killed as soon as it says how far it is."""
    with (
        Subscription(bus, selector(REALM, "bridge")) as results,
        Subscription(bus, selector(REALM, "service", "progress")) as progress,
    ):
        publisher = Publisher(bus, REALM)
        publish(publisher, sample)
        process = restartable.begin("pre")
        up_to(progress, "progress")
        kill(process)
        before = several(results, 3)
        assert [received.key().stream for received in before] == ["crossing"] * 3
        process = restartable.begin("pre")
        published = until_whole(results, before)
        publisher.close()
        stop(process)
    check_once(published, restartable, tmp_path / "recorded.mcap")
    assert len(restartable.paths()) == 2


def test_killed_worker_of_a_replay_needs_the_replay_again(
    bus: zenoh.Session, restartable: Restartable, sample: list[Message]
) -> None:
    """Its next run reads no recording and no earlier run: a crossing of an ended replay is lost."""
    realm = "replay-drive"
    with (
        Subscription(bus, selector(realm, "bridge")) as results,
        Subscription(bus, selector(realm, "service", "progress")) as progress,
        Subscription(bus, selector(realm, "service", "health")) as health,
    ):
        process = restartable.begin("pre", realm)
        up_to(health, "health")
        replay = Publisher(bus, realm)
        publish(replay, sample)
        up_to(progress, "progress")
        replay.close()
        kill(process)
        assert [one.key().stream for one in several(results, 3)] == ["crossing"] * 3
        after(health, 0.5)
        process = restartable.begin("pre", realm)
        up_to(health, "health")
        assert after(results, 4.0) == []  # longer than after a truck has left
        again = Publisher(bus, realm)
        publish(again, sample)
        up_to(results, "estimate")
        again.close()
        stop(process)


def test_a_second_signal_ends_it_in_the_middle_of_an_identification(
    bus: zenoh.Session, restartable: Restartable, sample: list[Message]
) -> None:
    with Subscription(bus, selector(REALM, "service", "progress")) as progress:
        publisher = Publisher(bus, REALM)
        publish(publisher, sample)
        process = restartable.begin("pre")
        up_to(progress, "progress")
        process.terminate()
        time.sleep(0.3)
        assert process.poll() is None  # the first one lets it finish
        process.terminate()
        _, log = process.communicate(timeout=LONGEST_S)
        publisher.close()
    assert process.returncode == 130, log
    assert [message.key.stream for message in restartable.stored()] == ["crossing"] * 3


@pytest.mark.slow
def test_killed_right_after_the_estimate(
    bus: zenoh.Session,
    restartable: Restartable,
    drive_on: list[Message],
    tmp_path: Path,
) -> None:
    """The truck still has everything and would have its crossing identified again. Files that
    are none, and one that was cut off, lie in the way."""
    folder = restartable.folder / REALM
    folder.mkdir(parents=True)
    (folder / "results-19990101T000000Z.mcap").write_bytes(b"")
    (folder / "results-19990101T000001Z.mcap").write_bytes(b"no recording" * 1000)
    with (
        Subscription(bus, selector(REALM, "bridge")) as results,
        Subscription(bus, selector(REALM, "service", "health")) as health,
    ):
        publisher = Publisher(bus, REALM)
        publish(publisher, drive_on)
        process = restartable.begin()
        published = up_to(results, "estimate")
        log = kill(process)
        (path,) = restartable.paths()
        cut_off = path.read_bytes()
        (folder / "results-19990101T000002Z.mcap").write_bytes(cut_off[: len(cut_off) // 2])
        after(health, 0.1)
        process = restartable.begin()
        up_to(health, "health")
        published = until_whole(results, published) + after(
            results, 2.5
        )  # the history is looked at by now
        latest = [
            pb.BridgeState.FromString(p)
            for p in get_latest(bus, selector(REALM, "bridge", "state"))
        ]
        publisher.close()
        stop(process)
    check_once(published, restartable, tmp_path / "recorded.mcap")
    (state,) = latest
    estimate = next(
        pb.Estimate.FromString(r.payload) for r in published if r.key().stream == "estimate"
    )
    assert list(state.crossings_used) == [estimate.crossing_id]
    for number in range(2):
        name = f"results-19990101T00000{number}Z.mcap"
        assert name in log
        assert (folder / f"{name}.crashed").exists()


def test_what_is_on_the_disk_and_not_on_the_bus(
    bus: zenoh.Session,
    restartable: Restartable,
    drive_on: list[Message],
    tmp_path: Path,
) -> None:
    """The estimate is in the recording, the larger JSON file does not fit on the disk any more,
    and so the worker ends between the two. Its truck has gone when the next run begins."""
    with (
        Subscription(bus, selector(REALM, "bridge")) as results,
        Subscription(bus, selector(REALM, "service", "health")) as health,
    ):
        process = restartable.begin()
        up_to(health, "health")
        resource.prlimit(process.pid, resource.RLIMIT_FSIZE, (LARGEST_FILE, LARGEST_FILE))
        publisher = Publisher(bus, REALM)
        publish(publisher, drive_on)
        _, log = process.communicate(timeout=LONGEST_S)
        assert process.returncode == 1, log
        publisher.close()
        published = several(results, 3)
        assert [received.key().stream for received in published] == ["crossing"] * 3
        assert [m.key.stream for m in restartable.stored()] == ["crossing"] * 3 + ["estimate"]
        process = restartable.begin()
        published = until_whole(results, published)
        stop(process)
    check_once(published, restartable, tmp_path / "recorded.mcap")


@pytest.mark.slow
def test_a_signal_while_a_truck_that_may_have_left_is_waited_for(
    bus: zenoh.Session,
    restartable: Restartable,
    drive_on: list[Message],
    tmp_path: Path,
) -> None:
    """Nobody would give the next run its data: the crossing is decided before the end."""
    began_ns = drive_on[0].log_time_ns
    short = [m for m in drive_on if m.log_time_ns - began_ns < 7_200_000_000]
    with (
        Subscription(bus, selector(REALM, "bridge")) as results,
        Subscription(bus, selector(REALM, "service", "health")) as health,
    ):
        process = restartable.begin()
        up_to(health, "health")
        publisher = Publisher(bus, REALM)
        publish(publisher, short)
        published = up_to(results, "crossing")
        publisher.close()
        stop(process)
        published += after(results, 1.5)
        check_once(published, restartable, tmp_path / "recorded.mcap")
        after(health, 0.1)
        process = restartable.begin()
        again = up_to(results, "state") + up_to(health, "health") + after(results, 1.5)
        stop(process)
    again = [received for received in again if received.key().owner == "bridge"]
    assert once(again) == once(published)  # the last minute, with its old identities
    check_once(published + again, restartable, tmp_path / "recorded.mcap")


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(8))
def test_killed_at_random_moments(
    bus: zenoh.Session,
    restartable: Restartable,
    drive_on: list[Message],
    tmp_path: Path,
    seed: int,
) -> None:
    """Three times, each from the time on at which the worker has begun to listen."""
    rng = np.random.default_rng(seed)
    with (
        Subscription(bus, selector(REALM, "bridge")) as results,
        Subscription(bus, selector(REALM, "service", "health")) as health,
    ):
        publisher = Publisher(bus, REALM)
        publish(publisher, drive_on)
        for _ in range(3):
            process = restartable.begin()
            up_to(health, "health")
            time.sleep(rng.uniform(0.8, 2.5))  # after a second the history is looked at
            kill(process)
        process = restartable.begin()
        up_to(health, "health")
        published = until_whole(results, []) + after(
            results, 2.5
        )  # the history is looked at by now
        publisher.close()
        stop(process)
        published += after(results, 0.5)
    check_once(published, restartable, tmp_path / "recorded.mcap")
