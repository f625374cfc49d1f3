"""What compose.yaml starts, as processes: every command, environment and health check of ours.

Not here: the engine, its limits, and the router's image. In its place stands a session of Zenoh's
library with the configuration that the image would get. tests/contract/test_compose.py looks at the
file itself.
"""

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import yaml
import zenoh

from services.bus.credentials import CONFIGURATION, link_settings
from tests.builders.compose_file import with_defaults
from tests.endpoints import free_endpoint

pytestmark = [pytest.mark.process, pytest.mark.slow, pytest.mark.timeout(900)]

ROOT = Path(__file__).parents[2]
SERVICES: dict[str, dict[str, Any]] = yaml.safe_load(
    with_defaults((ROOT / "compose.yaml").read_text())
)["services"]
IMAGE_ENV = dict(
    pair.split("=", 1)
    for line in re.findall(r"^ENV (.*)$", (ROOT / "Dockerfile").read_text(), re.MULTILINE)
    for pair in line.split()
)


class Host:
    """Folders in place of volumes, ports in place of names."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.app = folder / "app"
        (self.app / "recordings").mkdir(parents=True)
        self.kernels = folder / "kernels"
        self.logger, self.router = free_endpoint("tls"), free_endpoint("tls")

    def environment(self, name: str, container: str) -> dict[str, str]:
        """Nothing of this process's, but what the image and the file say."""
        output: dict[str, str] = IMAGE_ENV | SERVICES[name].get("environment", {})
        output["NUMBA_CACHE_DIR"] = str(self.cache(container))
        path = f"{Path(sys.executable).parent}:/usr/bin:/bin"
        return output | {"PATH": path, "HOME": "/nonexistent", "KERNELS": str(self.kernels)}

    def cache(self, container: str) -> Path:
        return self.folder / "run" / container / "kernels"

    def translated(self, name: str, words: list[str]) -> list[str]:
        tls = next(
            (
                str(self.app / "certs" / volume["volume"]["subpath"])
                for volume in SERVICES[name]["volumes"]
                if isinstance(volume, dict)
            ),
            "",
        )
        places = {
            "/etc/driveby/tls": tls,
            "tls/router:7447": self.router,
            "tls/0.0.0.0:7447": self.logger,
            "tls/localhost:7447": self.logger,
            "/site.toml": str(ROOT / "docs" / "site.example.toml"),
        }
        for place, here in places.items():
            words = [word.replace(place, here) for word in words]
        return words

    def start(self, name: str) -> subprocess.Popen[str]:
        """The service's command through the image's entrypoint, in a container never used."""
        with (self.folder / f"{name}.log").open("w") as log:
            return subprocess.Popen(
                [str(ROOT / "entrypoint.sh"), *self.translated(name, SERVICES[name]["command"])],
                cwd=self.app,
                env=self.environment(name, name),
                stdout=log,
                stderr=subprocess.STDOUT,
                text=True,
            )

    def log(self, name: str) -> str:
        return (self.folder / f"{name}.log").read_text()

    def run(self, name: str) -> None:
        assert self.start(name).wait(300) == 0, self.log(name)

    def check(self, name: str) -> subprocess.CompletedProcess[str]:
        """One run of the service's health check."""
        test = SERVICES[name]["healthcheck"]["test"]
        assert test[0] == "CMD"
        return subprocess.run(
            self.translated(name, test[1:]),
            cwd=self.app,
            env=self.environment(name, name),
            capture_output=True,
            text=True,
            timeout=60,
            check=False,
        )

    def wait_until_healthy(self, name: str, process: subprocess.Popen[str]) -> None:
        deadline = time.monotonic() + 240.0
        while True:
            assert process.poll() is None, self.log(name)
            done = self.check(name)
            if done.returncode == 0:
                assert done.stdout.startswith(f"{name} in realm sim-compose is well")
                return
            assert time.monotonic() < deadline, (done.stderr, self.log(name))

    @contextmanager
    def zenoh_router(self) -> Iterator[None]:
        """The router's configuration as `driveby certs` wrote it, with its folder where it is."""
        folder = self.app / "certs" / "router"
        config = zenoh.Config.from_file(folder / CONFIGURATION)
        for key, value in link_settings(folder).items():
            config.insert_json5(f"transport/link/{key}", json.dumps(value))
        config.insert_json5("listen/endpoints", json.dumps([self.router]))
        config.insert_json5("connect/endpoints", json.dumps([self.logger]))
        with zenoh.open(config):
            yield


def compiled(folder: Path) -> set[str]:
    return {path.name for path in folder.rglob("*.nb[ic]")}


def stop(process: subprocess.Popen[str], grace_s: float) -> int:
    process.send_signal(signal.SIGTERM)
    return process.wait(grace_s)


@pytest.fixture
def host(tmp_path: Path) -> Host:
    """An image: its kernels compiled from nothing, as the Dockerfile does."""
    made = Host(tmp_path)
    step = re.search(
        r"^RUN NUMBA_CACHE_DIR=/app/kernels /app/entrypoint.sh (python .*)$",
        dockerfile(),
        re.MULTILINE,
    )
    assert step is not None
    environment = {**os.environ, **IMAGE_ENV, "NUMBA_CACHE_DIR": str(made.kernels)}
    # In the wheel, and so in the image, what is `services` here lies inside `driveby` (setup.py).
    words = step[1].replace("driveby.services", "services").split()
    done = subprocess.run(
        [sys.executable, *words[1:]],
        cwd=tmp_path,
        env=environment | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert len(compiled(made.kernels)) > 50
    return made


def dockerfile() -> str:
    return (ROOT / "Dockerfile").read_text()


def test_everything_comes_up_in_its_order_and_identifies_the_crossing(host: Host) -> None:
    started: list[subprocess.Popen[str]] = []
    try:
        host.run("certs")
        host.run("simulation")
        host.run("simulation")  # `up` a second time: the volume keeps what the first wrote
        logger = host.start("logger")
        started.append(logger)
        host.wait_until_healthy("logger", logger)
        with host.zenoh_router():
            nobody = host.check("worker")
            assert nobody.returncode == 1
            assert nobody.stderr.startswith("driveby: worker in realm sim-compose sends nothing")
            worker = host.start("worker")
            started.append(worker)
            host.wait_until_healthy("worker", worker)
            # Nothing was compiled: the first crossing does not wait for a compiler.
            assert compiled(host.cache("worker")) == compiled(host.kernels)
            host.run("truck")
            results = wait_for_results(host)
            (crossing,) = results["crossings"]
            assert crossing["verdict"] == "good", crossing["reasons"]
            assert crossing["realm"] == "sim-compose"
            assert compiled(host.cache("worker")) == compiled(host.kernels)
            assert stop(worker, 60.0) == 0, host.log("worker")
            assert host.check("worker").returncode == 1
        assert stop(logger, 30.0) == 0, host.log("logger")
        assert host.check("logger").returncode == 1
        assert list((host.app / "recordings").rglob("*truck-1*.mcap"))
    finally:
        for process in started:
            if process.poll() is None:
                process.kill()
            process.wait()


def wait_for_results(host: Host) -> Any:
    deadline = time.monotonic() + 240.0
    while time.monotonic() < deadline:
        for path in (host.app / "recordings" / "sim-compose").glob("results-*.json"):
            found = json.loads(path.read_text())
            if found["crossings"]:
                return found
        time.sleep(0.2)
    pytest.fail(host.log("worker"))
