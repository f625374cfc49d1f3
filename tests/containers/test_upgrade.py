"""The program of an early commit, today's, back again and forth, while a truck drives.

The truck has the server's previous program until both have changed.
The early image runs as another user, knows none of today's health checks and access rules, and has
its own compose.yaml. What an operator does in between is read from docs/containers.md.
"""

import json
import re
import subprocess
import tarfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.containers.conftest import base_images
from tests.containers.recorded import Drive, check_complete, drives_of
from tests.containers.stack import ROOT, Stack, gone_at_the_end, until

pytestmark = [pytest.mark.containers, pytest.mark.timeout(3600)]

EARLY = "2b7e05c"
PROJECT = "driveby-upgrade"
IMAGE = "driveby-early"
SETTINGS = (
    "RUN --mount=type=secret,id=pip,target=/etc/pip.conf --mount=type=secret,id=authorities "
    "if [ -s /run/secrets/authorities ]; then export PIP_CERT=/run/secrets/authorities; fi; "
)
"""As in today's Dockerfile: a mirror of PyPI."""
DRIVES = """
until [ -e /far/stop ]; do
    driveby truck /far/compose.mcap --endpoint tls/router:7447 --tls /far/truck-1 \\
        --realm sim-compose --spool /far/spool
    code=$?
done
exit $code
"""
"""A drive that no logger confirms in time leaves its data in the spool to the next one."""


@pytest.fixture(scope="module")
def early(engine: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The checkout of the early commit, whose image is built."""
    folder = tmp_path_factory.mktemp("early")
    archive = folder / "early.tar"
    done = subprocess.run(["git", "archive", "-o", archive, EARLY], cwd=ROOT, check=False)
    if done.returncode != 0:
        pytest.skip(f"commit {EARLY} is not in this clone")
    with tarfile.open(archive) as files:
        files.extractall(folder, filter="data")
    text = (folder / "Dockerfile").read_text()
    text = text.replace("FROM python:3.11-slim\n", f"FROM {base_images()[0]}\n")
    (folder / "Dockerfile").write_text(text.replace("RUN pip ", f"{SETTINGS}pip "))
    stack = Stack(PROJECT)
    secrets = [
        f"--secret=id={name},src={stack.environment.get(variable, '/dev/null')}"
        for name, variable in (("pip", "PIP_CONFIG_FILE"), ("authorities", "PIP_CERT"))
    ]
    stack.docker("build", "--quiet", "--tag", IMAGE, *secrets, str(folder))
    services = ("certs", "logger", "worker", "simulation", "truck")
    of_early = {"services": {name: {"image": IMAGE} for name in services}}
    (folder / "images.yaml").write_text(json.dumps(of_early))
    return folder


class Far:
    """A truck on another machine: it has its own credentials and reaches the published port."""

    def __init__(self, stack: Stack, image: str) -> None:
        self._stack, self._name = stack, f"{PROJECT}-far"
        self.remove()
        copy = "cp -rp /certs/truck-1 /drive/compose.mcap /far; chown -R driveby: /far"
        mounts = ("certs:/certs:ro", "recordings:/drive:ro", "far:/far")
        volumes = [f"--volume={PROJECT}_{mount}" for mount in mounts]
        once = ("run", "--rm", "--user=root", "--entrypoint=sh", *volumes)
        stack.docker(*once, image, "-c", copy)
        network = ("--network=host", "--add-host=router:127.0.0.1", "--entrypoint=sh")
        drive = ("run", "--detach", f"--name={self._name}", *network, volumes[-1], "--tmpfs=/tmp")
        stack.docker(*drive, image, "-c", DRIVES)

    def stop(self) -> None:
        """Let it finish its drive: it leaves when a logger has everything on its disk."""
        self._stack.docker("exec", self._name, "touch", "/far/stop")
        assert self._stack.docker("wait", self._name).out == "0", self.log()

    def log(self) -> str:
        done = self._stack.docker("logs", self._name)
        return f"{done.out}\n{done.err}"

    def remove(self) -> None:
        self._stack.docker("rm", "--force", self._name)
        self._stack.docker("volume", "rm", "--force", f"{PROJECT}_far")


def of_early(folder: Path) -> Stack:
    stack = Stack(PROJECT)
    stack.environment["COMPOSE_FILE"] = f"{folder / 'compose.yaml'}:{folder / 'images.yaml'}"
    return stack


@pytest.fixture
def today(engine: None, tmp_path: Path) -> Iterator[Stack]:
    override = tmp_path / "far.yaml"
    # Two trucks of one name at once would be one truck to everybody.
    override.write_text("services: { truck: { command: [health, --help] } }")
    with gone_at_the_end(Stack(PROJECT, override)) as stack:
        yield stack
        stack.docker("rm", "--force", f"{PROJECT}-far")
    stack.docker("volume", "rm", "--force", f"{PROJECT}_far")
    stack.docker("network", "rm", "--force", f"{PROJECT}_default")  # of the early compose.yaml


def change_owner(stack: Stack, image: str) -> None:
    """Run the page's commands for volumes of another user; compose.yaml is the stack's."""
    page = (ROOT / "docs" / "containers.md").read_text()
    section = page.partition("## Update")[2].partition("\n## ")[0]
    [commands] = re.findall(r"```sh\n(.*?)```", section, re.DOTALL)
    commands = commands.replace("driveby_$volume", f"{PROJECT}_$volume")
    assert "chown driveby -R" in commands
    if image != "driveby":
        commands = commands.replace("docker compose build\n", "")
        commands = commands.replace("chown driveby -R", f"chown {image} -R")
    stack.run("sh", "-ec", commands)


def whole(drives: dict[int, Drive]) -> list[Drive]:
    most = max((drive.fixes for drive in drives.values()), default=0)
    return [drive for drive in drives.values() if drive.fixes == most]


def results_of(drive: Drive, results: list[dict[str, Any]]) -> list[dict[str, Any]]:
    return [one for one in results if drive.begin_s <= one["entry_time"] <= drive.end_s]


def test_upgrade_and_back_while_trucks_drive(today: Stack, early: Path, tmp_path: Path) -> None:
    before = of_early(early)
    copies = iter(range(10_000))

    def looked() -> tuple[Path, list[Drive], list[dict[str, Any]]]:
        taken = today.take("recordings", tmp_path / f"taken-{next(copies)}")
        return taken, whole(drives_of(taken)), today.results(tmp_path / f"results-{next(copies)}")

    def all_have_results() -> bool:
        _, drives, results = looked()
        return all(results_of(drive, results) for drive in drives)

    def one_has_a_result(since_s: float = 0.0) -> bool:
        _, drives, results = looked()
        return any(results_of(drive, results) for drive in drives if drive.begin_s > since_s)

    def check() -> int:
        taken, drives, results = looked()
        check_complete(taken)
        names = [one["crossing_id"] for one in results]
        assert len(names) == len(set(names))
        for drive in drives:
            [one] = results_of(drive, results)
            element = one["parameters"]["EI_4"]
            assert element["mean"] / element["prior"]["location"] == pytest.approx(0.40, abs=0.02)
        return len(drives)

    before.compose("run", "--rm", "certs")
    before.compose("up", "--detach", "--no-build", "worker", "simulation")
    until(lambda: before.has_ended("simulation"), "the recording that the truck drives")
    far = Far(before, IMAGE)
    until(one_has_a_result, "a result of the early worker")
    change_owner(today, "driveby")
    today.make("up")
    done = len(looked()[1])
    until(lambda: len(looked()[1]) > done, "a drive with today's logger")
    far.stop()
    until(all_have_results, "a result for each drive")
    forth = check()
    assert "messages of earlier runs" in today.log("worker")
    far.remove()

    far = Far(today, "driveby-truck")
    today.compose("--profile", "*", "down", "--remove-orphans")
    before.compose("up", "--detach", "--no-build", "worker")
    until(lambda: "Permission denied" in before.log("logger"), "what the early logger lacks")
    change_owner(before, IMAGE)
    before.compose("up", "--detach", "--no-build", "worker")
    until(lambda: "messages of earlier runs" in before.log("worker"), "the early worker")
    ready_s = time.time()
    until(lambda: one_has_a_result(ready_s), "a result of the early worker")
    far.stop()
    change_owner(today, "driveby")
    today.make("up")
    # The early worker does not read recordings: a drive that ended before its start is left.
    until(all_have_results, "a result for each drive")
    back = check()
    print(f"\n{forth} drives forth, {back - forth} back, 0 missing, 0 twice, a result each")
