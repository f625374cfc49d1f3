"""The real router with the configuration that `driveby certs` writes, rule by rule.

All messages pass through `zenohd` alone: the other side is a session with a router's credentials,
which may publish and read everything and filters nothing.

    ZENOHD=…/zenohd pytest tests/containers/test_zenohd.py -m containers
"""

import shutil
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from fnmatch import fnmatchcase
from functools import partial
from pathlib import Path
from typing import NamedTuple

import pytest
import zenoh

from schemas.results import load_results
from schemas.topics import Key
from services.bus.credentials import CONFIGURATION
from services.recordings.recording import read_messages
from services.security.certs import PLACE, certs_command
from services.security.settings import CertsSettings
from tests.containers import zenohd
from tests.containers.stack import ROOT
from tests.endpoints import free_endpoint
from tests.intruders import V1, listen_to, put_all, raw_session, settle
from tests.waiting import LONGEST_S, until

pytestmark = [pytest.mark.containers, pytest.mark.process, pytest.mark.timeout(1800)]

STREAMS = {
    "vehicle": ("accel", "gnss", "location", "info", "alive", "nonsense", "accel/spool"),
    "bridge": ("crossing", "estimate", "state", "alarm"),
    "service": ("health", "progress", "event", "durable"),
}
OWNERS = {
    "vehicle": ("truck-1", "truck-2"),
    "bridge": ("b-1",),
    "service": ("logger", "worker", "gateway-truck-1", "gateway-truck-2"),
}
PLAIN = [
    f"{V1}/{realm}/{owner}/{name}/{stream}"
    for realm in ("live", "replay-x")
    for owner, names in OWNERS.items()
    for name in names
    for stream in STREAMS[owner]
]
KEYS = [
    *PLAIN,
    *(f"{key}/@adv/pub/1/1/_" for key in PLAIN),
    "driveby/v2/live/vehicle/truck-1/accel",
    "something/else",
]
WIDE = ["**", f"{V1}/live/vehicle/*/accel", f"{V1}/live/*/truck-1/accel"]
"""Key expressions: a message to one reaches every reader of a key that it matches."""


class Role(NamedTuple):
    """What docs/security.md promises of a credential: patterns of REALM/OWNER/NAME/STREAM."""

    may_publish: tuple[str, ...]
    may_read: tuple[str, ...]


def truck(name: str) -> Role:
    streams = [s for s in STREAMS["vehicle"] if s != "nonsense"]
    own = tuple(f"*/vehicle/{name}/{stream}" for stream in streams)
    return Role((*own, f"*/service/gateway-{name}/event"), ("*/service/*/durable",))


LOGGED = ("accel", "gnss", "location", "info", "crossing", "estimate", "state", "alarm", "event")
ROLES = {
    "truck-1": truck("truck-1"),
    "truck-2": truck("truck-2"),
    "logger": Role(tuple(f"*/service/logger/{s}" for s in ("health", "event", "durable")), ("*",)),
    "worker": Role(
        ("*/bridge/*", *(f"*/service/worker/{s}" for s in ("health", "progress", "event"))),
        ("*/vehicle/*", "*/bridge/*", "*/service/*/durable", "*/service/worker/health"),
    ),
    "viewer": Role((), ("*/bridge/*", "*/service/*/health", "*/service/*/progress")),
    "replay": Role(tuple(f"replay-x/*/*/{s}" for s in LOGGED), ("*/service/*/durable",)),
    "router": Role(("*",), ("*",)),
}


def allowed(patterns: Iterable[str]) -> set[str]:
    """Return the keys that match a pattern, each with what belongs to it."""
    found = {k for k in PLAIN for p in patterns if fnmatchcase(k.removeprefix(f"{V1}/"), p)}
    return found | {key for key in KEYS if key.partition("/@adv/")[0] in found}


@pytest.fixture(scope="session")
def program() -> str:
    found = zenohd.find()
    if found is None:
        pytest.skip(
            f"no zenohd {zenohd.VERSION}: name one in ZENOHD; "
            "sh tests/containers/images.sh compiles it"
        )
    there = zenohd.version_of(found)
    if there != zenohd.VERSION:
        pytest.skip(f"{found} is {there}, compose.yaml names zenohd {zenohd.VERSION}")
    return found


class Bus(NamedTuple):
    """A running router and a session behind it that may do everything."""

    endpoint: str
    credentials: Path
    observer: zenoh.Session

    @contextmanager
    def joined(self, who: str) -> Iterator[zenoh.Session]:
        with raw_session(self.endpoint, self.credentials / who) as session:
            yield session

    def settle(self, session: zenoh.Session) -> None:
        """Wait until what a session has sent has reached the observer, and the reverse."""
        for one in (session, self.observer, session):
            settle(one)


@contextmanager
def bus(program: str, credentials: Path, log: Path, *further: str) -> Iterator[Bus]:
    listen, nowhere = free_endpoint("tls"), free_endpoint("tls")
    with (
        zenohd.running(program, credentials / "router", listen, nowhere, log, *further),
        raw_session(listen, credentials / "router") as observer,
    ):
        yield Bus(listen, credentials, observer)


@pytest.fixture
def filtered(program: str, credentials: Path, tmp_path: Path) -> Iterator[Bus]:
    with bus(program, credentials, tmp_path / "zenohd.log") as made:
        yield made


@pytest.fixture
def careless(program: str, credentials: Path, tmp_path: Path) -> Iterator[Bus]:
    """The negative control: the same router, but everybody who is let in may do everything."""
    off = "--cfg=access_control/enabled:false"
    with bus(program, credentials, tmp_path / "zenohd.log", off) as made:
        yield made


class Done(NamedTuple):
    """Keys on which each kind of message came through."""

    put: set[str]
    deleted: set[str]
    replied: set[str]
    announced: set[str]


def between(bus: Bus, sender: zenoh.Session, receiver: zenoh.Session) -> Done:
    """Send each kind of message once on each key; return what came through."""
    everything = [f"{V1}/**", f"{V1}/**/@adv/**"]
    heard = listen_to(receiver, everything if receiver is bus.observer else [*WIDE, *KEYS])
    bus.settle(receiver if sender is bus.observer else sender)
    for key in [*WIDE, *KEYS]:
        sender.put(key, key.encode(), congestion_control=zenoh.CongestionControl.BLOCK)
        sender.delete(key, congestion_control=zenoh.CongestionControl.BLOCK)
    with ExitStack() as stack:
        for key in KEYS:
            answer = sender.declare_queryable(key, partial(reply, key))
            stack.callback(answer.undeclare)
            stack.callback(sender.liveliness().declare_token(key).undeclare)
        bus.settle(receiver if sender is bus.observer else sender)
        get = receiver.get, receiver.liveliness().get
        replied = answers(
            KEYS, lambda k: get[0](k, target=zenoh.QueryTarget.ALL, timeout=LONGEST_S)
        )
        announced = answers(KEYS, lambda k: get[1](k, timeout=LONGEST_S))
        bus.settle(receiver if sender is bus.observer else sender)
    put, deleted = ({k for k, payload in heard if bool(payload) is one} for one in (True, False))
    return Done(put, deleted, replied, announced)


def reply(key: str, query: zenoh.Query) -> None:
    query.reply(key, key.encode())


def answers(keys: Iterable[str], ask: Callable[[str], Iterable[zenoh.Reply]]) -> set[str]:
    return {str(one.ok.key_expr) for key in keys for one in ask(key) if one.ok is not None}


@pytest.mark.parametrize("who", ROLES)
def test_credential_publishes_answers_and_announces_only_its_own(who: str, filtered: Bus) -> None:
    wanted = allowed(ROLES[who].may_publish)
    with filtered.joined(who) as session:
        done = between(filtered, session, filtered.observer)
    put = wanted | ({*WIDE[1:]} if who == "router" else set())
    assert done == Done(put, set(), wanted, wanted)


@pytest.mark.parametrize("who", ROLES)
def test_credential_reads_asks_and_watches_only_what_it_may(who: str, filtered: Bus) -> None:
    wanted = allowed(ROLES[who].may_read)
    with filtered.joined(who) as session:
        done = between(filtered, filtered.observer, session)
    assert done._replace(put=done.put - {*WIDE}) == Done(wanted, set(), wanted, wanted)


def test_without_access_control_a_viewer_does_everything(careless: Bus) -> None:
    every = {key for key in KEYS if key.startswith(V1)}
    with careless.joined("viewer") as session:
        done = between(careless, session, careless.observer)
        assert done == Done(every | {*WIDE}, every | {*WIDE}, {*KEYS}, {*KEYS})
    with careless.joined("viewer") as session:
        done = between(careless, careless.observer, session)
        assert done == Done({*KEYS, *WIDE}, {*KEYS, *WIDE}, {*KEYS}, {*KEYS})


def admin_space(session: zenoh.Session) -> set[str]:
    """Return the keys of the router's admin space; every session also has its own."""
    found = answers(["@/**"], lambda key: session.get(key, timeout=LONGEST_S))
    return {key for key in found if not key.startswith(f"@/{session.zid()}/")}


@pytest.mark.parametrize("who", ROLES)
def test_admin_space_is_closed(who: str, filtered: Bus) -> None:
    with filtered.joined(who) as session:
        assert admin_space(session) == set()


def test_admin_space_is_open_without_access_control(careless: Bus) -> None:
    """Negative control."""
    with careless.joined("viewer") as session:
        assert admin_space(session)


def test_a_misspelt_file_ends_the_router(program: str, credentials: Path, tmp_path: Path) -> None:
    """It would be worse if a router without access control came up."""
    folder = tmp_path / "router"
    shutil.copytree(credentials / "router", folder)
    written = (folder / CONFIGURATION).read_text()
    (folder / CONFIGURATION).write_text(written.replace('"access_control"', '"acces_control"'))
    words = zenohd.command(program, folder, free_endpoint("tls"), free_endpoint("tls"))
    done = subprocess.run(words, capture_output=True, timeout=LONGEST_S, check=False)
    assert done.returncode != 0


def test_strangers_are_not_let_in_and_the_revoked_not_heard(
    program: str, credentials: Path, tmp_path: Path
) -> None:
    ours, foreign = tmp_path / "ours", tmp_path / "foreign"
    shutil.copytree(credentials, ours)
    certs_command(CertsSettings(folder=ours, revoke=["truck-1"]))
    certs_command(CertsSettings(folder=foreign, trucks=["truck-2"]))
    shutil.copy(ours / "truck-2" / "ca.pem", foreign / "truck-2")  # it believes our router
    with bus(program, ours, tmp_path / "zenohd.log") as made:
        plain = made.endpoint.replace("tls/", "tcp/")
        for endpoint, folder in ((made.endpoint, foreign / "truck-2"), (plain, None)):
            with pytest.raises(zenoh.ZError):
                raw_session(endpoint, folder, timeout_s=2.0)
        heard = listen_to(made.observer, [f"{V1}/**"])
        for name in ("truck-1", "truck-2"):
            with made.joined(name) as session:
                put_all(session, [f"{V1}/live/vehicle/{name}/accel"])
        settle(made.observer)
    assert [key for key, _ in heard] == [f"{V1}/live/vehicle/truck-2/accel"]


def test_a_crossing_through_the_router_gives_element_4_at_40_per_cent(
    program: str, credentials: Path, tmp_path: Path
) -> None:
    """compose.yaml's commands as processes: truck and worker meet the logger through `zenohd`."""
    logger_at, router_at = free_endpoint("tls"), free_endpoint("tls")
    places = {
        "tls/0.0.0.0:7447": logger_at,
        "tls/router:7447": router_at,
        "/site.toml": str(ROOT / "docs" / "site.example.toml"),
        "recordings/compose.mcap": str(tmp_path / "compose.mcap"),
        "--folder=recordings": f"--folder={tmp_path / 'recordings'}",
        "--spool=spool": f"--spool={tmp_path / 'spool'}",
    }
    log = {name: tmp_path / f"{name}.log" for name in ("logger", "router", "worker", "truck")}

    @contextmanager
    def started(service: str, subject: str) -> Iterator[subprocess.Popen[bytes]]:
        words = zenohd.command_of(service, places | {PLACE: str(credentials / subject)})
        with log.get(service, tmp_path / "log").open("wb") as output:
            process = subprocess.Popen(
                [sys.executable, "-m", "services", *words], cwd=ROOT, stdout=output, stderr=output
            )
        try:
            yield process
        finally:
            process.terminate()
            process.wait(LONGEST_S)

    def is_ready(service: str) -> bool:
        return "ready" in log[service].read_text()

    def results() -> list[Path]:
        return [p for p in tmp_path.rglob("results-*.json") if load_results(p).crossings]

    with started("simulation", "router") as simulation:
        assert simulation.wait(LONGEST_S) == 0
    router = zenohd.running(program, credentials / "router", router_at, logger_at, log["router"])
    with started("logger", "logger") as logger:
        until(lambda: is_ready("logger"), "a logger")
        with router, started("worker", "worker"):
            until(lambda: is_ready("worker"), "a worker")
            with started("truck", "truck-1") as truck:
                # It ends well only when it has read that everything is on the logger's disk.
                assert truck.wait(LONGEST_S) == 0, log["truck"].read_text()
            until(results, "a result")
        logger.terminate()
        assert logger.wait(LONGEST_S) == 0, log["logger"].read_text()
    [crossing] = load_results(results()[0]).crossings
    assert crossing.verdict == "good", crossing.reasons
    assert crossing.parameters is not None
    found = crossing.parameters["EI_4"]
    assert found.prior is not None
    ratio = found.mean / found.prior.location
    print(f"\nEI_4: {ratio:.3f} of nominal, through {Path(program).name}")
    assert ratio == pytest.approx(0.40, abs=0.02)
    numbers: dict[tuple[Key, int], list[int]] = {}
    for path in tmp_path.rglob("*truck-1*.mcap"):
        for message in read_messages(path):
            numbers.setdefault((message.key, message.boot_id), []).append(message.sequence)
    assert {key.stream for key, _ in numbers} >= {"accel", "gnss", "location", "info"}
    for name, sequence in numbers.items():
        assert sorted(sequence) == list(range(len(sequence))), name
