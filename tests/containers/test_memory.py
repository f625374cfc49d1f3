"""A logger and a worker that the memory limits of their containers end."""

import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from schemas.errors import InputError
from schemas.proto import driveby_pb2 as pb
from services.recordings.recording import read_messages
from tests.containers.recorded import check_complete
from tests.containers.stack import ROOT, Stack, gone_at_the_end, until

pytestmark = [pytest.mark.containers, pytest.mark.timeout(3600)]

HOG = (ROOT / "tests" / "containers" / "memory_hog.py").read_text()
CHILDREN_OF_INIT = """
from pathlib import Path
for path in Path("/proc").glob("[0-9]*"):
    if (path / "stat").read_text().rpartition(")")[2].split()[1] == "1":
        print(path.name)
"""


@pytest.fixture
def stack(engine: None) -> Iterator[Stack]:
    with gone_at_the_end(Stack("driveby-memory")) as made:
        yield made


def exhaust(stack: Stack, service: str) -> None:
    """Fill the container's memory until the kernel has ended the service."""
    since_s = time.time()
    [pid] = stack.inside(service, "python", "-c", CHILDREN_OF_INIT).out.split()
    hog = stack.inside(service, "python", "-c", HOG, pid)
    name = f"container={stack.name(service)}"
    times = ("--since", f"{since_s:.3f}", "--until", f"{time.time():.3f}")
    events = stack.docker("events", *times, "--filter", name, "--filter", "event=oom").out
    assert " oom " in events, (events, hog)


def test_logger_out_of_memory_keeps_what_it_called_durable(stack: Stack, folder: Path) -> None:
    """A truck deletes what a logger has called durable from its spool, so nobody else has it."""
    stack.make("up")
    exhaust(stack, "logger")
    restarts = stack.docker("inspect", "-f", "{{.RestartCount}}", stack.name("logger"))
    until(lambda: stack.is_healthy("logger"), "the logger")
    copies = iter(range(1000))

    def is_spool_empty() -> bool:
        until(lambda: stack.has_ended("truck"), "the end of a drive")
        taken = stack.take("spool", folder / f"spool-{next(copies)}")
        return not list(taken.rglob("*.spool"))

    while not is_spool_empty():  # another drive, that offers what is left of the first
        stack.docker("start", stack.name("truck"))
    assert restarts.out == "1"
    check_complete(stack.take("recordings", folder / "recordings"))


def states_of(folder: Path) -> list[list[int]]:
    """Return the crossings' states that each run of the worker has published, in their order."""
    runs: list[list[int]] = []
    for path in sorted(folder.rglob("results-*.mcap")):
        try:
            messages = [one for one in read_messages(path) if one.key.stream == "crossing"]
        except InputError:  # nothing in it yet
            continue
        runs.append([int(pb.Crossing.FromString(one.payload).state) for one in messages])
    return runs


@pytest.fixture
def unchecked(engine: None, folder: Path) -> Iterator[Stack]:
    """The stack with one check of the worker's health: it takes memory of the same container."""
    override = folder / "unchecked.yaml"
    override.write_text("services: { worker: { healthcheck: { interval: 1h } } }")
    with gone_at_the_end(Stack("driveby-memory", override)) as made:
        yield made


def test_worker_out_of_memory_leaves_one_result(unchecked: Stack, folder: Path) -> None:
    """Its limit is 4 MiB above what it uses when idle; an identification takes 25 MiB."""
    stack, name = unchecked, unchecked.name("worker")
    stack.compose("build")
    stack.compose("run", "--rm", "certs")
    stack.compose("up", "--detach", "--wait", "worker")
    [pid] = stack.inside("worker", "python", "-c", CHILDREN_OF_INIT).out.split()
    # The kernel would end the child that identifies, which counts as a try of the crossing.
    stack.inside("worker", "sh", "-c", f"echo 1000 >/proc/{pid}/oom_score_adj", check=True)
    used = stack.docker("stats", "--no-stream", "--format", "{{.MemUsage}}", name).out.split()[0]
    assert used.endswith("MiB"), used
    limit = f"{int(float(used.removesuffix('MiB')) + 4) << 20}"
    stack.docker("update", "--restart", "no", "--memory", limit, "--memory-swap", limit, name)
    stack.compose("up", "--detach", "truck")
    until(lambda: stack.has_ended("worker"), "the end of the worker")
    state = stack.state("worker")
    assert (state["ExitCode"], state["OOMKilled"]) == (137, True), state
    [first] = states_of(stack.take("recordings", folder / "ended"))
    assert first[-1] == pb.IDENTIFYING
    stack.docker("update", "--memory", "2g", "--memory-swap", "2g", name)
    stack.docker("start", name)
    until(lambda: "Z: good" in stack.log("worker"), "a result of the next run")
    until(lambda: stack.has_ended("truck"), "the end of the drive")
    _, second = states_of(stack.take("recordings", folder / "whole"))
    assert second.count(pb.DONE) == 1
    [result] = stack.results(folder / "results")
    assert result["verdict"] == "good", result["reasons"]
