"""`make up` on an engine that has only the two base images, and what is true of it from inside."""

import json
import re
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml

from schemas.topics import Key
from services.recordings.recording import read_messages
from tests.containers.stack import ROOT, Stack, gone_at_the_end, until

pytestmark = [pytest.mark.containers, pytest.mark.timeout(3000)]

SERVICE_MB, TRUCK_MB = 900, 250
LASTING = ("router", "logger", "worker")
WITH_SHELL = ("logger", "worker")


@pytest.fixture(scope="module")
def up(engine: None) -> Iterator[Stack]:
    with gone_at_the_end(Stack("driveby-up")) as stack:
        began_s = time.monotonic()
        stack.make("up")
        print(f"\nmake up: {time.monotonic() - began_s:.0f} s")
        print(stack.inside("router", "/zenohd", "--version").out)
        yield stack


@pytest.fixture(scope="module")
def taken(up: Stack, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The recordings once the truck has left and its crossing has a result."""
    until(lambda: up.has_ended("truck"), "the end of the drive")
    assert up.state("truck")["ExitCode"] == 0, up.log("truck")
    folder = tmp_path_factory.mktemp("taken")
    until(lambda: re.search(r"Z: (good|suspect|rejected)", up.log("worker")), "a result")
    return up.take("recordings", folder / "recordings")


def test_everything_is_healthy(up: Stack) -> None:
    assert all(up.is_healthy(service) for service in LASTING), up.compose("ps").out


def test_the_crossing_is_recorded_whole(taken: Path) -> None:
    numbers: dict[tuple[Key, int], list[int]] = {}
    for path in taken.rglob("*truck-1*.mcap"):
        for message in read_messages(path):
            numbers.setdefault((message.key, message.boot_id), []).append(message.sequence)
    streams = {key.stream for key, _ in numbers}
    assert streams >= {"accel", "gnss", "location", "info"}
    for name, found in numbers.items():
        assert sorted(found) == list(range(len(found))), name


def test_its_result_is_good_and_element_4_at_40_per_cent(taken: Path) -> None:
    [crossing] = [
        one
        for path in taken.rglob("results-*.json")
        for one in json.loads(path.read_text())["crossings"]
    ]
    assert (crossing["verdict"], crossing["vehicle"]) == ("good", "truck-1")
    found = crossing["parameters"]["EI_4"]
    nominal = found["prior"]["location"]
    assert found["mean"] / nominal == pytest.approx(0.40, abs=0.02)


def test_images_are_small(up: Stack) -> None:
    sizes = {
        name: int(up.docker("image", "inspect", "-f", "{{.Size}}", name).out) / 1e6
        for name in ("driveby", "driveby-truck")
    }
    print("\n" + ", ".join(f"{name}: {size:.0f} MB" for name, size in sizes.items()))
    assert sizes["driveby"] <= SERVICE_MB
    assert sizes["driveby-truck"] <= TRUCK_MB


@pytest.mark.parametrize("service", WITH_SHELL)
def test_no_privilege_from_inside(up: Stack, service: str) -> None:
    status = up.inside(service, "cat", "/proc/self/status").out
    values = dict(re.findall(r"^(\w+):\s*(\S+)", status, re.MULTILINE))
    assert values["Uid"] == "10001"
    assert values["NoNewPrivs"] == "1"
    assert {values[f"Cap{one}"] for one in ("Inh", "Prm", "Eff", "Bnd", "Amb")} == {"0" * 16}
    assert values["Seccomp"] == "2"


@pytest.mark.parametrize("service", WITH_SHELL)
def test_only_volumes_and_memory_can_be_written(up: Stack, service: str) -> None:
    for folder in ("/", "/app", "/etc", "/opt/driveby", "/home/driveby", "/opt", "/usr/bin"):
        done = up.inside(service, "touch", f"{folder}/tried")
        assert done.code != 0, folder
        assert "Read-only file system" in done.err, (folder, done.err)
    for folder in ("/app/recordings", "/tmp"):  # noqa: S108
        assert (
            up.inside(service, "sh", "-c", f"touch {folder}/tried && rm {folder}/tried").code == 0
        )
    assert up.inside(service, "touch", "/etc/driveby/tls/tried").code != 0


@pytest.mark.parametrize("service", WITH_SHELL)
def test_no_key_of_another_service_is_there(up: Stack, service: str) -> None:
    found = up.inside(service, "find", "/", "-xdev", "-name", "*key.pem").out.split()
    found += up.inside(service, "find", "/etc/driveby", "/app", "-name", "*key.pem").out.split()
    assert set(found) == {"/etc/driveby/tls/key.pem"}
    name = "import sys; from cryptography import x509; print(x509.load_pem_x509_certificate("
    name += "open('/etc/driveby/tls/cert.pem','rb').read()).subject.rfc4514_string())"
    assert up.inside(service, "python", "-c", name).out == f"CN={service}/{service}"


REACH = """
import socket, sys
for place in sys.argv[1:]:
    host, port = place.rsplit(":", 1)
    try:
        socket.create_connection((host, int(port)), 2).close()
        print(place)
    except OSError:
        pass
"""


def test_trucks_reach_the_router_alone_and_nobody_the_outside(up: Stack) -> None:
    """A truck's container with a program of ours in place of the drive, on the same network."""
    addresses = {
        service: yaml.safe_load(
            up.docker("inspect", "-f", "{{json .NetworkSettings.Networks}}", up.name(service)).out
        )
        for service in LASTING
    }
    ips = [f"{one['IPAddress']}:7447" for of in addresses.values() for one in of.values()]
    gateways = [f"{one['Gateway']}:22" for of in addresses.values() for one in of.values()]
    wanted = ["router:7447", "logger:7447", "worker:7447", "192.0.2.1:53", *ips, *gateways]
    found = up.compose(
        "run", "--rm", "--no-deps", "-T", "--entrypoint", "python", "truck", "-c", REACH, *wanted
    ).out.split()
    of_trucks = addresses["router"][f"{up.project}_trucks"]["IPAddress"]
    assert set(found) == {"router:7447", f"{of_trucks}:7447"}
    outside = up.inside("worker", "python", "-c", REACH, "192.0.2.1:53", "router:7447").out.split()
    assert outside == ["router:7447"]


def test_logs_are_bounded_and_json_when_asked(up: Stack, taken: Path) -> None:
    for service in LASTING:
        form = "{{json .HostConfig.LogConfig}}"
        found = json.loads(up.docker("inspect", "-f", form, up.name(service)).out)
        assert found["Config"] == {"max-size": "10m", "max-file": "3"}
    up.environment["DRIVEBY_LOG_FORMAT"] = "json"
    try:
        up.compose("up", "--detach", "--wait", "logger", "worker")
        began = {name: up.state(name)["StartedAt"] for name in ("logger", "router")}
        assert began["logger"] < began["router"]  # it reads what rules came with the new logger
        lines = [json.loads(line) for line in up.log("worker").splitlines() if line]
        assert {line["realm"] for line in lines} == {"sim-compose"}
        assert [line for line in lines if line["message"].startswith("ready")]
        up.compose("up", "--detach", "truck")
        until(lambda: up.has_ended("truck"), "the end of the second drive")
        result = '"verdict": "good"'
        until(lambda: result in up.log("worker"), "a second result")
        for service in ("logger", "worker", "truck"):
            lines = [json.loads(line) for line in up.log(service).splitlines() if line]
            assert all({"time", "level", "logger", "message"} <= line.keys() for line in lines)
        [found] = [json.loads(line) for line in up.log("worker").splitlines() if result in line]
        assert (found["vehicle"], found["realm"]) == ("truck-1", "sim-compose")
        assert found["crossing"].startswith("truck-1.")
    finally:
        del up.environment["DRIVEBY_LOG_FORMAT"]


def test_metrics_are_answered_on_loopback(up: Stack) -> None:
    up.compose("--profile", "metrics", "up", "--detach", "metrics")
    ask = "import urllib.request as r; print(r.urlopen('http://localhost:9464/metrics').read().decode())"

    def answer() -> str:
        return up.inside("metrics", "python", "-c", ask).out

    until(
        lambda: 'driveby_healthy{realm="sim-compose",service="worker"} 1.0' in answer(), "metrics"
    )
    assert 'driveby_messages_dropped_total{realm="sim-compose",service="logger"} 0.0' in answer()
    ports = up.docker("port", up.name("metrics")).out
    assert ports == "9464/tcp -> 127.0.0.1:9464"
    assert up.docker("port", up.name("router")).out == "7447/tcp -> 127.0.0.1:7447"


def test_view_draws_and_reports(up: Stack, taken: Path, tmp_path: Path) -> None:
    up.compose("build", "view")
    size = int(up.docker("image", "inspect", "-f", "{{.Size}}", "driveby-view").out) / 1e6
    print(f"\ndriveby-view: {size:.0f} MB")
    drawn = up.compose("run", "--rm", "view")
    assert "WARNING" not in drawn.out + drawn.err, drawn
    [results] = taken.rglob("results-*.json")
    of_results = f"recordings/{results.relative_to(taken)}"
    up.compose("run", "--rm", "view", "report", of_results, "--output", "recordings/report.html")
    made = up.take("recordings", tmp_path / "made")
    assert (made / "compose.rrd").read_bytes().startswith(b"RRF2")
    pictures = list((made / "figures").rglob("*.png"))
    assert pictures
    assert all(path.read_bytes().startswith(b"\x89PNG") for path in pictures)
    assert "</html>" in (made / "report.html").read_text()


def test_down_leaves_only_the_volumes(up: Stack) -> None:
    up.make("down")
    left = up.left()
    assert (left["containers"], left["networks"]) == ([], [])
    volumes = {"recordings", "drive", "spool", "certs"}
    declared = set(yaml.safe_load((ROOT / "compose.yaml").read_text())["volumes"])
    assert {name.removeprefix(f"{up.project}_") for name in left["volumes"]} <= declared
    assert {name.removeprefix(f"{up.project}_") for name in left["volumes"]} >= volumes
