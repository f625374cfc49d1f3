"""The services of compose.yaml in an engine of containers, for tests."""

import json
import os
import random
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

ROOT = Path(__file__).parents[2]
SOCKETS = Path("/var/tmp/driveby-engine/sockets")  # noqa: S108 - where engine.sh puts it
LONGEST_S = 900.0
"""A guard against waiting for ever, not a limit of speed."""


def until(is_so: Callable[[], object], what: str) -> None:
    deadline = time.monotonic() + LONGEST_S
    while not is_so():
        assert time.monotonic() < deadline, f"{what} has not come within {LONGEST_S:.0f} s"
        time.sleep(0.5)


def engine_settings() -> dict[str, str]:
    """Return the environment by which `docker` meets the engine of engine.sh, if it is there."""
    if "DOCKER_HOST" in os.environ or not (SOCKETS / "docker.sock").exists():
        return {}
    config = SOCKETS.parent / "config"
    return {"DOCKER_HOST": f"unix://{SOCKETS}/docker.sock", "DOCKER_CONFIG": str(config)}


class Done(NamedTuple):
    """The end of a command."""

    code: int
    out: str
    err: str


class Stack:
    """A project of Compose with volumes of its own."""

    def __init__(self, project: str, override: Path | None = None) -> None:
        self.project = project
        files = [ROOT / "compose.yaml", *([override] if override else [])]
        self.environment = {
            **os.environ,
            **engine_settings(),
            "COMPOSE_PROJECT_NAME": project,
            "COMPOSE_FILE": os.pathsep.join(map(str, files)),
        }

    def run(self, *command: str, check: bool = True) -> Done:
        done = subprocess.run(
            command, cwd=ROOT, env=self.environment, capture_output=True, text=True, check=False
        )
        if check:
            assert done.returncode == 0, (command, done.stdout[-3000:], done.stderr[-3000:])
        return Done(done.returncode, done.stdout.strip(), done.stderr.strip())

    def docker(self, *arguments: str, check: bool = True) -> Done:
        return self.run("docker", *arguments, check=check)

    def compose(self, *arguments: str, check: bool = True) -> Done:
        return self.run("docker", "compose", *arguments, check=check)

    def make(self, target: str) -> Done:
        return self.run("make", target)

    def name(self, service: str) -> str:
        """Return the name of a service's container."""
        return f"{self.project}-{service}-1"

    def state(self, service: str) -> dict[str, Any]:
        """Return `State` of a service's container; empty if there is none."""
        done = self.docker("inspect", "-f", "{{json .State}}", self.name(service), check=False)
        found: dict[str, Any] = json.loads(done.out) if done.code == 0 else {}
        return found

    def is_healthy(self, service: str) -> bool:
        state = self.state(service)
        return bool(state.get("Health", {}).get("Status") == "healthy")

    def has_ended(self, service: str) -> bool:
        return self.state(service).get("Status") == "exited"

    def log(self, service: str) -> str:
        done = self.docker("logs", self.name(service), check=False)
        return f"{done.out}\n{done.err}"

    def inside(self, service: str, *command: str, check: bool = False) -> Done:
        return self.docker("exec", self.name(service), *command, check=check)

    def take(self, volume: str, folder: Path) -> Path:
        """Copy a volume as it is now; a file may be in the middle of being written."""
        folder.mkdir(parents=True)
        mount = f"{self.project}_{volume}:/volume:ro"
        # A container that was never started: its files are read by the engine.
        made = self.docker("create", "-v", mount, "driveby", "health").out
        try:
            self.docker("cp", f"{made}:/volume/.", str(folder))
        finally:
            self.docker("rm", made)
        return folder

    def results(self, folder: Path) -> list[dict[str, Any]]:
        """Return all results of the worker."""
        taken = self.take("recordings", folder)
        found = []
        for path in sorted(taken.rglob("results-*.json")):
            try:
                found += json.loads(path.read_text())["crossings"]
            except json.JSONDecodeError:  # in the middle of being written; the next look has it
                continue
        return found

    def left(self) -> dict[str, list[str]]:
        """Return what the engine has of the project."""
        of = f"label=com.docker.compose.project={self.project}"
        asked = {
            "containers": ("ps", "--all", "--quiet"),
            "networks": ("network", "ls", "--quiet"),
            "volumes": ("volume", "ls", "--quiet"),
        }
        return {
            what: self.docker(*command, "--filter", of).out.split()
            for what, command in asked.items()
        }

    def remove(self) -> None:
        self.compose("--profile", "*", "down", "--remove-orphans", "--volumes", "--timeout", "5")


class Faults:
    """What befalls containers, at random moments of a stated seed."""

    def __init__(self, stack: Stack, seed: int) -> None:
        self._stack = stack
        self._random = random.Random(seed)
        self.done: list[str] = []

    def strike(self, service: str, how: str, seconds: float) -> None:
        stack, name = self._stack, self._stack.name(service)
        self.done.append(f"{how} {service} for {seconds:.0f} s")
        match how:
            case "kill":
                stack.docker("kill", name)
                time.sleep(seconds)
                stack.docker("start", name)
            case "pause":
                stack.docker("pause", name)
                time.sleep(seconds)
                stack.docker("unpause", name)
            case "cut off":
                networks = self._networks(name)
                for network in networks:
                    stack.docker("network", "disconnect", network, name)
                time.sleep(seconds)
                for network in networks:
                    stack.docker("network", "connect", "--alias", service, network, name)

    def _networks(self, name: str) -> list[str]:
        template = "{{range $name, $_ := .NetworkSettings.Networks}}{{$name}} {{end}}"
        return self._stack.docker("inspect", "-f", template, name).out.split()

    def plan(
        self, number: int, services: list[str], longest_s: float = 30.0
    ) -> Iterator[tuple[str, str, float]]:
        """Yield faults: every service and kind in turn, for one second to the longest time."""
        kinds = ("kill", "pause", "cut off")
        every = [(service, how) for service in services for how in kinds]
        self._random.shuffle(every)
        for n in range(number):
            service, how = every[n % len(every)]
            yield service, how, self._random.uniform(1.0, longest_s)

    def pause_before(self, most_s: float) -> None:
        time.sleep(self._random.uniform(0.0, most_s))


@contextmanager
def gone_at_the_end(stack: Stack) -> Iterator[Stack]:
    stack.remove()
    try:
        yield stack
    finally:
        stack.remove()
