"""A logger that the memory limit of its container ends."""

import time
from collections.abc import Iterator
from pathlib import Path

import pytest

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
