"""Services as processes of the command line, each with its own certificate."""

import contextlib
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import zenoh

from schemas.proto import driveby_pb2 as pb
from schemas.signals import AccelChannel
from schemas.spool import spool_selector
from schemas.topics import Key, selector
from services.bus.session import open_session
from services.bus.subscription import Subscription
from services.common.errors import InputError
from services.recordings.recording import read_messages, read_site
from services.security.certs import certs_command
from services.security.settings import CertsSettings
from services.truck.gateway import Gateway
from services.truck.spool import Spool
from tests import prepared
from tests.builders.commands import run
from tests.builders.processes import stop
from tests.waiting import LONGEST_S, until

pytestmark = pytest.mark.process

Driveby = Callable[..., subprocess.Popen[str]]


@pytest.fixture
def driveby() -> Iterator[Driveby]:
    """Start a sub-command; a logger is waited for."""
    started: list[subprocess.Popen[str]] = []

    def start(*arguments: object) -> subprocess.Popen[str]:
        process = prepared.Popen(
            [sys.executable, "-m", "services", *map(str, arguments)],
            has_server=arguments[0] == "worker",
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
        )
        started.append(process)
        if arguments[0] == "logger":
            assert process.stdout is not None
            line = process.stdout.readline()
            if not line.startswith("ready"):
                pytest.fail(f"the logger did not start: {process.communicate()[1]}")
        return process

    yield start
    for process in started:
        if process.poll() is None:
            process.kill()
        process.communicate()


def identities(folder: Path) -> list[tuple[Key, int, int]]:
    """Of every message of a vehicle in all recordings of a folder, duplicates included."""
    found = []
    for path in sorted(folder.rglob("*.mcap")):
        with contextlib.suppress(InputError):  # a logger was killed before its first second
            found += [
                (message.key, message.boot_id, message.sequence)
                for message in read_messages(path)
                if message.key.owner == "vehicle"
            ]
    return found


def test_everything_is_recorded_under_access_control(
    driveby: Driveby, credentials: Path, tls_endpoint: str, recording: Path, tmp_path: Path
) -> None:
    bus = ["--endpoint", tls_endpoint, "--tls"]
    logger = driveby(
        *("logger", "--listen", tls_endpoint, "--tls", credentials / "logger"),
        *("--folder", tmp_path / "r", "--realm", "live", "--realm", "replay-*"),
    )
    truck = driveby("truck", recording, "--speed", 50, *bus, credentials / "truck-1")
    _, log = truck.communicate(timeout=LONGEST_S)
    assert truck.returncode == 0, log  # it knows that all is on disk: it could read `durable`
    assert "401 messages of truck-1 published" in log
    replay = driveby("replay", recording, "--speed", 0, "--name", "x", *bus, credentials / "replay")
    _, log = replay.communicate(timeout=LONGEST_S)
    assert replay.returncode == 0, log
    logger.send_signal(signal.SIGTERM)
    _, log = logger.communicate(timeout=LONGEST_S)
    assert logger.returncode == 0, log
    found = identities(tmp_path / "r")
    assert len(found) == len(set(found)) == 802
    assert {key.realm for key, _, _ in found} == {"live", "replay-x"}
    for key in credentials.glob("*/key.pem"):
        assert key.read_text().splitlines()[1] not in log


def test_unlisted_truck_fails_named_and_its_spool_keeps_everything(
    driveby: Driveby, credentials: Path, tls_endpoint: str, recording: Path, tmp_path: Path
) -> None:
    """The list of the logger lacks the truck at first; its own credentials are valid."""
    lacking = tmp_path / "lacking"
    shutil.copytree(credentials, lacking)
    certs_command(CertsSettings(folder=lacking, revoke=["truck-1"]))

    def logger(listener: Path) -> subprocess.Popen[str]:
        return driveby(
            *("logger", "--listen", tls_endpoint, "--tls", listener, "--folder", tmp_path / "r")
        )

    first = logger(lacking / "logger")
    truck = driveby(
        *("truck", recording, "--speed", 50, "--spool", tmp_path / "spool"),
        *("--endpoint", tls_endpoint, "--tls", credentials / "truck-1"),
    )
    _, log = truck.communicate(timeout=LONGEST_S)
    assert truck.returncode == 1
    assert log.splitlines()[-1] == (
        "driveby: none of 401 messages was received: nothing at logger/logger subscribes to "
        "truck-1: its list of participants lacks this certificate, which is new or revoked, see "
        "docs/security.md#changes; the spool keeps the messages"
    )
    where = lacking / "logger" / "zenoh.json5"
    log = stop(first)
    assert log.count(f"truck/truck-1 is connected and not listed in {where}") == 1
    assert "unless it is revoked, copy the list" in log
    assert not identities(tmp_path / "r")
    second = logger(credentials / "logger")
    with open_session(
        connect=tls_endpoint, timeout_s=LONGEST_S, tls=credentials / "truck-1"
    ) as session:
        gateway = Gateway(session, "live", "truck-1", Spool(tmp_path / "spool"))
        until(lambda: len(set(identities(tmp_path / "r"))) == 401, "the first drive")
        gateway.close()
    assert "not listed" not in stop(second)


def test_a_crossing_is_identified_under_access_control(
    driveby: Driveby, credentials: Path, tls_endpoint: str, project: Path, tmp_path: Path
) -> None:
    """Truck, logger, worker and viewer, each with what its own certificate lets it say and hear."""
    crossing = project / "tests" / "data" / "noise_free.mcap"
    site = tmp_path / "site.toml"
    site.write_text(read_site(crossing) or "")
    bus = ["--endpoint", tls_endpoint, "--tls"]
    folder = tmp_path / "r"
    driveby("logger", "--listen", tls_endpoint, "--tls", credentials / "logger", "--folder", folder)
    worker = driveby(
        *("worker", "--site", site, "--method", "least-squares", "--no-certificates"),
        *("--file", tmp_path / "results.mcap", *bus, credentials / "worker"),
    )
    with (
        open_session(
            connect=tls_endpoint, timeout_s=LONGEST_S, tls=credentials / "viewer"
        ) as session,
        Subscription(session, selector("live", "service", "health")) as health,
        Subscription(session, selector("live", "bridge")) as results,
    ):

        def is_listening() -> bool:
            one = health.receive(0.2)
            return one is not None and one.key().identifier == "worker"

        until(is_listening)
        truck = driveby("truck", crossing, "--speed", 20, *bus, credentials / "truck-1")
        assert truck.wait(timeout=LONGEST_S) == 0
        heard: dict[str, bytes] = {}

        def is_reported() -> bool:
            one = results.receive(0.2)
            if one is not None:
                heard[one.key().stream] = one.payload
            return "state" in heard

        until(is_reported)
    worker.terminate()
    assert worker.wait(timeout=LONGEST_S) == 0
    found = pb.Estimate.FromString(heard["estimate"]).parameters
    assert found["EI_4"].mean / found["EI_3"].mean == pytest.approx(0.4, rel=0.01)


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (
            ["truck", "{recording}", "--tls", "{certs}/truck-2"],
            "{certs}/truck-2: is the certificate of truck/truck-2, not of truck/truck-1",
        ),
        (
            ["replay", "{recording}", "--tls", "{certs}/truck-1"],
            "{certs}/truck-1: is the certificate of truck/truck-1, not of replay/…",
        ),
        (
            ["worker", "--site", "site.toml", "--tls", "{certs}/worker", "--id", "other"],
            "{certs}/worker: is the certificate of worker/worker, not of worker/other",
        ),
        (
            ["logger", "--tls", "{certs}/viewer"],
            "{certs}/viewer: is the certificate of viewer/viewer, not of logger/logger",
        ),
        (
            ["logger", "--listen", "tcp/0.0.0.0:7447"],
            (
                "tcp/0.0.0.0:7447 can be reached by other machines, and without --tls FOLDER "
                "anybody there could publish as a truck; add --insecure if that is intended "
                "(see docs/security.md)"
            ),
        ),
        (
            ["certs", "{certs}", "--trucks", "truck-1"],
            "{certs}/truck-1: exists and is not overwritten; --renew replaces it",
        ),
    ],
)
def test_what_would_be_dropped_without_a_word_is_refused_with_one_line(
    capsys: pytest.CaptureFixture[str],
    credentials: Path,
    recording: Path,
    arguments: list[str],
    line: str,
) -> None:
    values = {"recording": recording, "certs": credentials}
    ended = run(capsys, *(argument.format(**values) for argument in arguments))
    assert ended.code == 2
    assert ended.err == f"driveby: {line.format(**values)}\n"


def test_a_logger_killed_and_started_again_misses_nothing_under_access_control(
    driveby: Driveby, credentials: Path, tls_endpoint: str, tmp_path: Path
) -> None:
    """The router dies with it; what the truck said meanwhile comes from its cache."""
    arguments = [
        *("logger", "--listen", tls_endpoint, "--tls", credentials / "logger"),
        *("--folder", tmp_path / "r"),
    ]
    logger = driveby(*arguments)
    with open_session(
        connect=tls_endpoint, timeout_s=LONGEST_S, tls=credentials / "truck-1"
    ) as session:
        gateway = Gateway(session, "live", "truck-1")
        for number in range(60):
            if number == 20:
                logger.kill()
                logger.wait()
            if number == 40:
                logger = driveby(*arguments)
            say(gateway)
            time.sleep(0.02)
        missing = gateway.delivery.wait(LONGEST_S)
        gateway.close()
    logger.send_signal(signal.SIGTERM)
    _, log = logger.communicate(timeout=LONGEST_S)
    assert logger.returncode == 0, log
    assert {sequence for _, _, sequence in identities(tmp_path / "r")} == set(range(60))
    assert missing == 0


def say(gateway: Gateway) -> None:
    channels = {"sprung_front": AccelChannel(1000.0, np.zeros(50))}
    gateway.accel(channels, device_time_ns=time.monotonic_ns(), wall_time_ns=time.time_ns())


def test_a_real_spool_answers_the_logger_and_no_other_truck(
    credentials: Path, tls_endpoint: str, tmp_path: Path
) -> None:
    def answers(session: zenoh.Session) -> int:
        replies = session.get(
            spool_selector("live", "truck-1"),
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=LONGEST_S,
        )
        return sum(reply.ok is not None for reply in replies)

    with (
        open_session(listen=tls_endpoint, tls=credentials / "logger") as logger,
        open_session(
            connect=tls_endpoint, timeout_s=LONGEST_S, tls=credentials / "truck-1"
        ) as session,
        open_session(
            connect=tls_endpoint, timeout_s=LONGEST_S, tls=credentials / "truck-2"
        ) as other,
    ):
        gateway = Gateway(session, "live", "truck-1", Spool(tmp_path / "spool"))
        for _ in range(10):
            say(gateway)
        until(lambda: answers(logger), "an answer of the spool")
        assert answers(logger) == 1
        assert answers(other) == 0
        gateway.close()
