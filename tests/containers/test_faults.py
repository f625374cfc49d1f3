"""Containers are killed, paused and cut off at random moments while trucks drive.

FAULTS=20 SEED=1 LONGEST_S=30 give their number, moments and longest time. Every message that a
truck has accepted is recorded once, and every crossing that a truck has driven to its end has one
result.
"""

import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.containers.recorded import Drive, check_complete, drives_of
from tests.containers.stack import Faults, Stack, gone_at_the_end, until

pytestmark = [pytest.mark.containers, pytest.mark.timeout(7200)]

STRUCK = ["logger", "router", "worker", "truck"]


@pytest.fixture
def stack(engine: None) -> Iterator[Stack]:
    with gone_at_the_end(Stack("driveby-faults")) as made:
        yield made


def test_nothing_is_lost_nothing_twice_and_one_result_for_each_crossing(
    stack: Stack, folder: Path
) -> None:
    number, seed = int(os.environ.get("FAULTS", "20")), int(os.environ.get("SEED", "1"))
    longest_s = float(os.environ.get("LONGEST_S", "30"))
    stack.make("up")
    faults = Faults(stack, seed)
    for service, how, seconds in faults.plan(number, STRUCK, longest_s):
        if stack.has_ended("truck"):
            stack.docker("start", stack.name("truck"))
        faults.pause_before(15.0)
        if service == "truck" and stack.has_ended("truck"):
            stack.docker("start", stack.name("truck"))
        faults.strike(service, how, seconds)
    print("\n" + "\n".join(faults.done))
    until(lambda: all(stack.is_healthy(one) for one in STRUCK[:3]), "health after all faults")
    until(lambda: stack.has_ended("truck"), "the end of the drive")
    # A last drive offers what earlier ones left in the spool, and leaves when all is on disk.
    stack.docker("start", stack.name("truck"))
    until(lambda: stack.has_ended("truck"), "the end of the last drive")
    copies = iter(range(10_000))

    def is_spool_empty() -> bool:
        taken = stack.take("spool", folder / f"spool-{next(copies)}")
        return not list(taken.rglob("*.spool"))

    until(is_spool_empty, "everything on the logger's disk")
    drives: dict[int, Drive] = {}
    whole = 0

    def is_identified() -> bool:
        nonlocal drives, whole
        taken = stack.take("recordings", folder / f"recordings-{next(copies)}")
        drives = drives_of(taken)
        whole = max(drive.fixes for drive in drives.values())
        found = stack.results(folder / f"results-{next(copies)}")
        return all(
            [one for one in found if drive.begin_s <= one["entry_time"] <= drive.end_s]
            for drive in drives.values()
            if drive.fixes == whole
        )

    until(is_identified, "a result for each whole drive")
    check_complete(stack.take("recordings", folder / "last"))
    results = stack.results(folder / "all")
    names = [one["crossing_id"] for one in results]
    assert len(names) == len(set(names))
    complete = [drive for drive in drives.values() if drive.fixes == whole]
    assert complete
    for drive in complete:
        [one] = [o for o in results if drive.begin_s <= o["entry_time"] <= drive.end_s]
        assert one["verdict"] == "good", one["reasons"]
    print(f"{len(faults.done)} faults, {len(drives)} drives, {len(complete)} whole, 0 missing")
