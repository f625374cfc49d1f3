"""A real Prometheus scrapes what `driveby health --metrics --serve` answers."""

import json
import shutil
import signal
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from schemas.proto import driveby_pb2 as pb
from services.bus.publisher import Publisher
from services.bus.session import open_session
from tests.endpoints import free_endpoint
from tests.waiting import LONGEST_S, until

pytestmark = [pytest.mark.containers, pytest.mark.process]


@pytest.fixture(scope="module")
def prometheus() -> str:
    found = shutil.which("prometheus")
    if found is None:
        pytest.skip("no prometheus for containers: apt install prometheus")
    return found


@contextmanager
def running(*command: str, log: Path) -> Iterator[subprocess.Popen[str]]:
    with log.open("w") as errors:
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=errors, text=True)
    try:
        yield process
        process.send_signal(signal.SIGTERM)
        assert process.wait(LONGEST_S) == 0, log.read_text()
    finally:
        process.kill()
        process.communicate()


def free_port() -> str:
    return free_endpoint().rpartition(":")[2]


def test_figures_are_scraped_under_their_names(
    prometheus: str, endpoint: str, tmp_path: Path
) -> None:
    metrics, page = free_port(), free_port()
    (tmp_path / "prometheus.yml").write_text(
        "global: { scrape_interval: 1s }\n"
        "scrape_configs:\n"
        "  - job_name: driveby\n"
        f"    static_configs: [{{ targets: ['127.0.0.1:{metrics}'] }}]\n"
    )
    serve = [sys.executable, "-m", "services", "health", "--metrics", "--serve", metrics]

    def asked(query: str) -> list[dict[str, Any]]:
        url = f"http://127.0.0.1:{page}/api/v1/query?query={query}"
        try:
            with urllib.request.urlopen(url) as response:
                found: list[dict[str, Any]] = json.load(response)["data"]["result"]
                return found
        except OSError:  # not yet up
            return []

    with (
        open_session(listen=endpoint) as session,
        running(*serve, "--endpoint", endpoint, "--realm", "sim-a", log=tmp_path / "e") as server,
        running(
            prometheus,
            f"--config.file={tmp_path}/prometheus.yml",
            f"--storage.tsdb.path={tmp_path}/data",
            f"--web.listen-address=127.0.0.1:{page}",
            log=tmp_path / "p",
        ),
    ):
        assert server.stdout is not None
        url = server.stdout.readline().split()[-1]
        publisher = Publisher(session, "sim-a")
        health = pb.Health(schema_version=1, time_ns=time.time_ns(), service="worker", ok=True)
        health.figures["crossings/good"] = 3.0
        health.figures["queue"] = 2.0
        publisher.put("service", "worker", "health", health.SerializeToString())
        until(lambda: asked("driveby_crossings_total"), "a scraped figure")
        [found] = asked("driveby_crossings_total")
        labels = {"realm": "sim-a", "service": "worker", "verdict": "good"}
        assert labels.items() <= found["metric"].items()
        assert float(found["value"][1]) == 3.0
        with urllib.request.urlopen(url) as response:  # noqa: S310 - our own
            text = response.read()
        checked = subprocess.run(
            ["promtool", "check", "metrics"], input=text, capture_output=True, check=False
        )
        assert (checked.returncode, checked.stdout + checked.stderr) == (0, b"")
        publisher.close()
