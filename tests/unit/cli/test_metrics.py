"""`driveby health --metrics` with a real logger's and a real worker's figures, and over HTTP."""

import http.client
import threading
import time
import urllib.error
import urllib.request
from collections import Counter
from pathlib import Path
from typing import Any

import pytest
import zenoh

from schemas.metrics import METRICS
from schemas.proto import driveby_pb2 as pb
from services.bus.publisher import Publisher
from services.bus.session import open_session
from services.bus.subscription import RawSample
from services.cli.health import OLDEST_S
from services.cli.metrics import HealthBoard, metrics_command, serve_metrics
from services.common.errors import FailureError, InputError
from services.execution.inline import InlineExecutor
from services.logger.completeness import Completeness
from services.logger.file_layout import RecordingTarget
from services.logger.intake import Intake
from services.logger.writer import FileWriter, count_all
from services.worker.backfill import WaitingCounts
from services.worker.health import QueueLag, Workload, publish_health
from tests.endpoints import free_endpoint
from tests.waiting import until

NAMES = {metric.figure for metric in METRICS}
OF_WORKER = QueueLag(3, 0.5), Workload(("a",), 1, 2, WaitingCounts(1, 2))


def health(time_s: float, *, ended: bool = False, **figures: float) -> bytes:
    message = pb.Health(
        schema_version=1, time_ns=round(time_s * 1e9), service="logger", ok=True, ended=ended,
        figures=figures,
    )  # fmt: skip
    return message.SerializeToString()


def sample(name: str, payload: bytes, realm: str = "live", stream: str = "health") -> RawSample:
    return RawSample(f"driveby/v1/{realm}/service/{name}/{stream}", payload, None, False)


def of_worker() -> pb.Health:
    sent: list[bytes] = []
    publish_health(
        sent.append, "worker", InlineExecutor(), *OF_WORKER, verdicts={"good": 2}, note="a note"
    )
    return pb.Health.FromString(sent[0])


def test_every_figure_of_the_worker_is_a_metric() -> None:
    figures = of_worker().figures
    assert figures["crossings/good"] == 2.0
    assert {name.partition("/")[0] + "/" * ("/" in name) for name in figures} <= NAMES


def test_every_figure_of_the_logger_is_a_metric(tmp_path: Path, endpoint: str) -> None:
    writer = FileWriter(RecordingTarget(tmp_path, tmp_path / "a.mcap", "live", None))
    intake = Intake("live", "logger", 1)
    with open_session(listen=endpoint) as session:
        completeness = Completeness(session, None, ("live",), intake, writer)
        completeness.report(time.monotonic())
        figures = count_all(intake.counts, writer) | writer.take_figures() | completeness.figures()
        completeness.close()
    writer.finish("done", Counter())
    assert {"durable_lag_s", "queue", "rate_per_s"} <= figures.keys() <= NAMES


def test_silent_service_is_not_well_and_has_no_figures() -> None:
    board = HealthBoard()
    assert board.add(sample("logger", health(1000.0, dropped=1.0)))
    [now] = board.services(1010.0)
    assert (now.is_well, dict(now.figures)) == (True, {"dropped": 1.0})
    assert board.add(sample("logger", health(1005.0, ended=True)))
    assert not board.services(1010.0)[0].is_well
    assert board.add(sample("logger", health(1000.0, dropped=1.0)))
    [late] = board.services(1000.0 + OLDEST_S + 1.0)
    assert (late.is_well, dict(late.figures)) == (False, {})
    assert late.time_s == pytest.approx(1000.0)
    assert board.services(1000.0 + 90_000.0) == []


@pytest.mark.parametrize(
    "received",
    [sample("logger", b"\xff"), sample("logger", b"", stream="event"), sample("UPPER", b"")],
)
def test_other_messages_are_ignored(received: RawSample) -> None:
    board = HealthBoard()
    assert not board.add(received)
    assert board.services(0.0) == []


def published(session: zenoh.Session, *names: str) -> list[Publisher]:
    publishers = []
    for name in names:
        publisher = Publisher(session, "sim-a")
        publisher.put("service", name, "health", health(time.time(), queue=4.0))
        publishers.append(publisher)
    return publishers


def test_one_service_or_all_are_printed(endpoint: str) -> None:
    with open_session(listen=endpoint) as session:
        publishers = published(session, "logger", "worker")
        asked: dict[str, Any] = {"endpoint": endpoint, "tls": None}
        one = metrics_command(service="worker", realm="sim-a", **asked)
        everything = metrics_command(service=None, realm="*", **asked)
        silent = f"every service in realm live sends nothing at {endpoint}; it answers with --realm"
        with pytest.raises(FailureError, match=f"^{silent} sim-a$"):
            metrics_command(service=None, realm="live", patience_s=0.5, **asked)
        with pytest.raises(InputError, match="identifier"):
            metrics_command(service="A/B", realm="live", **asked)
        for publisher in publishers:
            publisher.close()
    assert 'driveby_queue_messages{realm="sim-a",service="worker"} 4.0\n' in one
    assert "logger" not in one
    assert {'service="logger"', 'service="worker"'} <= set(everything.split("{")[1].split(",")) | {
        part for line in everything.splitlines() for part in line.rstrip("} 1.0").split(",")
    }


def test_requests_are_answered_until_the_end(
    endpoint: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The signal is in its place an event: signals come to the main thread only."""
    stop, urls = threading.Event(), list[str]()

    class Stopped:
        def __enter__(self) -> threading.Event:
            return stop

        def __exit__(self, *_: object) -> None: ...

    monkeypatch.setattr("services.cli.metrics.stopped_by_signals", Stopped)
    server = threading.Thread(
        target=serve_metrics,
        kwargs={
            "service": None, "endpoint": endpoint, "tls": None, "realm": "sim-a",
            "address": ("127.0.0.1", 0), "ready": urls.append,
        },
    )  # fmt: skip
    server.start()
    until(lambda: bool(urls), "an address")
    [url] = urls
    assert answer(url) == ""  # no router yet
    with open_session(listen=endpoint) as session:
        publishers = published(session, "logger")
        until(lambda: "driveby_queue_messages" in answer(url), "the logger's figures")
        with pytest.raises(urllib.error.HTTPError, match="404"):
            answer(url.replace("/metrics", "/etc/passwd"))
        connection = http.client.HTTPConnection("127.0.0.1", int(url.split(":")[2].split("/")[0]))
        connection.request("POST", "/metrics")
        assert connection.getresponse().status == 501
        connection.close()
        stop.set()
        server.join(60.0)
        assert not server.is_alive()
        for publisher in publishers:
            publisher.close()


def answer(url: str) -> str:
    with urllib.request.urlopen(url, timeout=60.0) as response:  # noqa: S310 - our own
        assert response.headers["Content-Type"].startswith("text/plain; version=0.0.4")
        return str(response.read().decode())


def test_an_address_in_use_is_one_line(endpoint: str) -> None:
    host, port = free_endpoint().removeprefix("tcp/").split(":")
    with (
        open_session(listen=f"tcp/{host}:{port}"),
        pytest.raises(FailureError, match=f"cannot listen at {host}:{port}: "),
    ):
        serve_metrics(
            service=None, endpoint=endpoint, tls=None, realm="live",
            address=(host, int(port)), ready=print,
        )  # fmt: skip
