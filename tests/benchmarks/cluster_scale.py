"""Many crossings in one process and on a cluster of two workers, and then with everybody killed.

    python -m tests.benchmarks.cluster_scale --crossings 2000

The sample's crossing over and over, each at its own time, so each is a crossing of its own with its
own seed; method `pre`. A share of the crossings is identified in one process of one thread, from
its first result to its last, before and after the cluster: the machine may have other work.
Efficiency is how many crossings the cluster identifies in a minute, by twice those of one process;
or, by processor time, what one process takes for a crossing, by what all processes of cluster and
client take, which other work hardly changes. In the last run worker, scheduler and client are
killed in turn, and what is found is compared; with `--kills-only` it is the only one on a cluster.
"""

import argparse
import json
import os
import resource
import signal
import sys
import tempfile
import time
from pathlib import Path
from typing import Any, Final, NamedTuple

import psutil
import zstandard

from schemas.settings import IdentificationSettings
from services.common.parquet_files import decoded
from services.execution.archive import ArchiveJob, identify_archive
from services.execution.inline import InlineExecutor
from services.execution.offline import site_of
from services.execution.result_store import FORMAT_VERSION, KEY, ResultStore, files_of
from services.identification.bridge_state import NOTHING_STORED
from tests.drives import SAMPLE, drives
from tests.faults.clusters import Running, RunningCluster, cluster, contents, start

WORKERS: Final = 2
_EACH = 10
"""Crossings in a recording."""


def main() -> int:
    options = _options()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        recordings = drives(folder / "recordings", options.crossings, _EACH, SAMPLE)
        alone = recordings[: max(1, options.alone // _EACH)]
        print(f"{options.crossings} crossings in {len(recordings)} recordings", flush=True)
        before = in_one_process(alone, folder / "before")
        if not options.kills_only:
            with cluster(folder) as two:
                on_two = on_cluster(two, recordings, folder / "two", options.batch)
            after = in_one_process(alone, folder / "after")
            by_clock = 0.5 * (before.clock_s + after.clock_s) / (WORKERS * on_two.clock_s)
            by_processor = 0.5 * (before.processor_s + after.processor_s) / on_two.processor_s
            print(f"efficiency {by_clock:.2f} by the clock, {by_processor:.2f} by processor time")
        with cluster(folder) as two:
            killed(two, recordings, folder / "killed", options)
        whole, parts = results(folder / "killed"), results(folder / "before")
        assert len(whole) == options.crossings
        assert parts == {content: whole[content] for content in parts}
        same = f"{len(parts)} crossings of one process"
        if not options.kills_only:
            assert results(folder / "two") == whole
            same += f" and all {len(whole)} of the cluster's runs"
        print(f"{len(whole)}: nothing twice, nothing missing; {same} the same to the last bit")
    return 0


def _options() -> argparse.Namespace:
    p = argparse.ArgumentParser(description=__doc__, allow_abbrev=False)
    p.add_argument("--crossings", type=int, default=200)
    p.add_argument("--alone", type=int, default=40, help="of them in one process, twice")
    p.add_argument("--batch", type=int, default=50)
    p.add_argument("--kills", type=int, default=3)
    p.add_argument("--kills-only", action="store_true", help="no run without any, no efficiency")
    return p.parse_args()


class Taken(NamedTuple):
    """What a crossing takes."""

    clock_s: float
    processor_s: float

    def output(self, who: str) -> "Taken":
        print(
            f"{who}: {60.0 / self.clock_s:.1f} crossings a minute, "
            f"{self.processor_s:.2f} s of processor time each",
            flush=True,
        )
        return self


def in_one_process(recordings: list[Path], into: Path) -> Taken:
    settings = IdentificationSettings(threads=1)
    asked = ArchiveJob(tuple(recordings), site_of(recordings, None), settings, NOTHING_STORED, {})
    times: list[tuple[float, float]] = []

    class Timed(InlineExecutor):
        def submit(self, work: Any) -> None:
            super().submit(work)
            times.append((time.monotonic(), time.process_time()))

    identify_archive(asked, Timed(), ResultStore(into))
    number = len(times) - 1
    (began_s, began), (ended_s, ended) = times[0], times[-1]
    return Taken((ended_s - began_s) / number, (ended - began) / number).output("one process")


def on_cluster(two: RunningCluster, recordings: list[Path], into: Path, batch: int) -> Taken:
    """With start and end of the command, on workers that have their kernels loaded."""
    warm = drives(into.parent / "warm", 2 * WORKERS, 1, SAMPLE)
    finish(identification(two, warm, into.parent / "warmed", 1))
    began_s, began = time.monotonic(), processor_s(two)
    finish(identification(two, recordings, into, batch))
    number = len(contents(into))
    taken = Taken((time.monotonic() - began_s) / number, (processor_s(two) - began) / number)
    return taken.output(f"{WORKERS} workers")


def processor_s(two: RunningCluster) -> float:
    """Of all processes of a cluster, and of the clients that have ended."""
    cluster = psutil.Process(two.command.process.pid)
    clients = resource.getrusage(resource.RUSAGE_CHILDREN)
    total = clients.ru_utime + clients.ru_stime
    for process in (cluster, *cluster.children(recursive=True)):
        times = process.cpu_times()
        total += times.user + times.system
    return total


def killed(
    two: RunningCluster, recordings: list[Path], into: Path, options: argparse.Namespace
) -> None:
    """The same, with somebody killed whenever another part of the crossings is done."""
    began = time.monotonic()
    running = identification(two, recordings, into, options.batch)
    for kill in range(options.kills):
        wanted = options.crossings * (kill + 1) // (options.kills + 2)
        wait_for(into, wanted, running)
        whom = ("worker 1", "scheduler", "client")[kill % 3]
        print(f"{len(contents(into))} crossings are done: the {whom} is killed", flush=True)
        if whom == "client":
            running.process.kill()
            running.wait()
            running = identification(two, recordings, into, options.batch)
        else:
            os.kill(two.pids(whom)[-1], signal.SIGKILL)
    finish(running)
    names = contents(into)
    assert len(names) == len(set(names)) == options.crossings
    print(f"with {options.kills} killed: {time.monotonic() - began:.0f} s", flush=True)


def wait_for(into: Path, crossings: int, running: Running) -> None:
    """Until so many are done, however long that takes; the command must still be under way."""
    while len(contents(into)) < crossings and running.process.poll() is None:
        time.sleep(1.0)
    assert running.process.poll() is None, running.output()


def identification(two: RunningCluster, recordings: list[Path], into: Path, batch: int) -> Running:
    log = into.parent / f"{into.name}-{time.monotonic_ns()}.log"
    return start(
        log,
        *("identify", *map(str, recordings), "--into", str(into), "--batch", str(batch)),
        *("--scheduler", two.address),
    )


def finish(running: Running) -> None:
    while running.process.poll() is None:
        time.sleep(0.1)
    assert running.process.returncode == 0, running.output()


def results(into: Path) -> dict[str, str]:
    """All results by what they were made from, without the seconds that they took."""
    found: dict[str, str] = {}
    for path in files_of(into):
        rows = decoded(path, KEY, FORMAT_VERSION, ["content", "result"]).to_pylist()
        for row in rows:
            outcome = json.loads(zstandard.decompress(row["result"]))
            outcome["diagnostics"].pop("seconds", None)
            found[row["content"]] = json.dumps(outcome, sort_keys=True)
    return found


if __name__ == "__main__":
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    sys.exit(main())
