"""The Dask cluster of compose.yaml on two networks, with a third worker: one process's results.

CROSSINGS=300 gives their number. A worker is killed, one is cut off for longer than a silent one
counts as alive, and the scheduler is killed, while the client waits for results. FAULTS=0 leaves
them alone and measures the efficiency.
"""

import os
import re
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from services.cli import main as cli
from services.execution.result_store import kept_results
from tests.containers.stack import ROOT, Faults, Stack, gone_at_the_end, until
from tests.drives import drives
from tests.faults.clusters import contents

pytestmark = [pytest.mark.containers, pytest.mark.timeout(7200)]

SEEDS = range(1, 6)
"""Different crossings; each is driven several times."""
OVERRIDE = f"""
services:
  scheduler: {{ networks: [services, far] }}
  cluster-worker-3:
    extends: {{ file: {ROOT}/compose.yaml, service: cluster-worker-1 }}
    networks: !override [far]
  client:
    networks: !override [far]
networks:
  far: {{ internal: true }}
"""
CLUSTER = ("--scheduler=tls://scheduler:8786", "--tls=/etc/driveby/tls")
WORKERS = [f"cluster-worker-{n}" for n in (1, 2, 3)]
STRUCK = [("cluster-worker-1", "kill", 5.0), ("cluster-worker-3", "cut off", 65.0)]
STRUCK += [("scheduler", "kill", 5.0)]
TIMED = """
import resource, subprocess, sys
code = subprocess.run(sys.argv[1:]).returncode
used = resource.getrusage(resource.RUSAGE_CHILDREN)
print("processor time:", used.ru_utime + used.ru_stime)
sys.exit(code)
"""
"""A program that runs a command and prints its processor time in s."""
USED = "cat /sys/fs/cgroup/cpu.stat /sys/fs/cgroup/cpuacct/cpuacct.usage"
"""Control groups of version 2, and of version 1."""


@pytest.fixture
def stack(engine: None, tmp_path: Path) -> Iterator[Stack]:
    override = tmp_path / "two-networks.yaml"
    override.write_text(OVERRIDE)
    with gone_at_the_end(Stack("driveby-cluster", override)) as made:
        yield made


def archive(folder: Path, crossings: int) -> Path:
    """Write recordings of four crossings each, of as many kinds as there are seeds."""
    site = str(ROOT / "docs" / "site.example.toml")
    for seed in SEEDS:
        source = folder / f"{seed}.mcap"
        options = ("--scenario", "6", "--site", site, "--noise", "25", "--gps-noise")
        when = ("--seed", str(seed), "--start", f"2026-01-0{seed}T00:00:00Z")
        assert cli.main(["simulate", *options, *when, "-o", str(source)]) == 0
        drives(folder / "archive" / str(seed), crossings // len(SEEDS), each=4, source=source)
    return folder / "archive"


def results_of(folder: Path) -> dict[str, Any]:
    """Return the crossings of a folder but for their durations, and the bridges."""
    problems: list[str] = []
    found = {}
    for one in kept_results(folder, problems.append):
        for crossing in one.model_dump(mode="json")["crossings"]:
            assert crossing["crossing_id"] not in found
            crossing["diagnostics"].pop("seconds", None)
            found[crossing["crossing_id"]] = crossing
    assert not problems
    return found


def test_results_are_those_of_one_process(stack: Stack, tmp_path: Path) -> None:
    crossings = int(os.environ.get("CROSSINGS", "100"))
    stack.compose("build")
    stack.compose("run", "--rm", "cluster-certs")
    put(stack, archive(tmp_path, crossings))
    stack.compose("up", "--detach", "scheduler", *WORKERS)
    began_s = time.monotonic()
    client = start(stack, "client", "recordings/identified", "--batch=5", *CLUSTER)
    copies = iter(range(10_000))

    def stored() -> int:
        return len(contents(stack.take("recordings", tmp_path / f"{next(copies)}") / "identified"))

    def has_more_than(number: int) -> bool:
        assert is_running(stack, client), stack.docker("logs", client)
        return stored() > number

    faults = Faults(stack, 1)
    for service, how, seconds in STRUCK if os.environ.get("FAULTS") != "0" else []:
        until(partial(has_more_than, stored()), "further results")
        faults.strike(service, how, seconds)
        assert is_running(stack, client), stack.docker("logs", client)
    assert stack.docker("wait", client).out == "0", stack.docker("logs", client)
    ended_s = time.monotonic()
    alone = start(stack, "alone", "recordings/alone")
    assert stack.docker("wait", alone).out == "0", stack.docker("logs", alone)
    alone_s = time.monotonic() - ended_s
    taken = stack.take("recordings", tmp_path / "last")
    found = results_of(taken / "identified")
    assert len(found) == crossings
    assert found == results_of(taken / "alone")
    print(f"\n{crossings} crossings in {ended_s - began_s:.0f} s, alone in {alone_s:.0f} s")
    print(", ".join(faults.done) or efficiency(stack, client, alone))


def efficiency(stack: Stack, client: str, alone: str) -> str:
    """Return the processor time of both identifications and their ratio, as a sentence."""
    one_s, of_client_s = (
        float(stack.docker("logs", name).out.rpartition("processor time: ")[2])
        for name in (alone, client)
    )
    all_s = of_client_s + sum(used_s(stack, service) for service in ["scheduler", *WORKERS])
    return f"processor time {all_s:.0f} s, alone {one_s:.0f} s: efficiency {one_s / all_s:.2f}"


def used_s(stack: Stack, service: str) -> float:
    """Return the processor time of a container since its start."""
    found = stack.inside(service, "sh", "-c", USED).out
    of_2 = re.search(r"^usage_usec (\d+)$", found, re.MULTILINE)
    return int(of_2[1]) * 1e-6 if of_2 else int(found) * 1e-9


def put(stack: Stack, recordings: Path) -> None:
    """Copy recordings into the volume, where the user of the image may write."""
    mount = f"{stack.project}_recordings:/app/recordings"
    made = stack.docker("create", "--volume", mount, "driveby", "health").out
    stack.docker("cp", f"{recordings}/.", f"{made}:/app/recordings")
    stack.docker("rm", made)
    owned = ("--user=root", "--entrypoint=chown", "--volume", mount)
    stack.docker("run", "--rm", *owned, "driveby", "-R", "driveby:", "recordings")


def start(stack: Stack, name: str, into: str, *options: str) -> str:
    """Start an identification as the service `client` and return the container's name."""
    identify = ("driveby", "identify", "recordings", "--site=/site.toml", f"--into={into}")
    container = f"{stack.project}-{name}"
    command = ("python", "-c", TIMED, *identify, *options)
    stack.compose("run", "--detach", f"--name={container}", "client", *command)
    return container


def is_running(stack: Stack, container: str) -> bool:
    return stack.docker("inspect", "-f", "{{.State.Running}}", container).out == "true"
