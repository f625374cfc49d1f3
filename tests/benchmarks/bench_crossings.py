"""Many crossings: in one process and in two, fused, and as they grow."""

import subprocess
import sys
import time
from pathlib import Path
from typing import NamedTuple

import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from schemas.results import CrossingResult, ResultHeader
from schemas.settings import IdentificationSettings
from schemas.site import Site
from services.execution.inline import InlineExecutor
from services.execution.offline import messages_of_trucks, site_of
from services.execution.processes import ProcessExecutor
from services.finding.order import in_measurement_order, index_messages
from services.identification.bridge_state import RecentCrossings, add_crossings, state_of, usable
from services.identification.engine import Engine
from services.identification.outputs import IdentificationTask
from services.recordings.recording import program_version
from tests.benchmarks import recordings, view

PROJECT = Path(__file__).parents[2]
SAMPLE = PROJECT / "recordings" / "sample" / "crossing.mcap"
CROSSINGS = {1: 60, 2: 200}
"""How many are identified in so many processes."""
FUSED = (25, 50, 100)

_MEMORY = """
import sys
from pathlib import Path
from schemas.settings import IdentificationSettings
from tests.identifications import identify_recordings
from services.simulation.drive import paper_site
identify_recordings([Path(sys.argv[1])], paper_site(), IdentificationSettings())
lines = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
print(1024 * int(lines["VmHWM"].split()[0]))
"""


class _Sample(NamedTuple):
    site: Site
    work: IdentificationTask
    result: CrossingResult


@pytest.fixture(scope="module")
def sample() -> _Sample:
    """The crossing of the sample, as an engine gives it to be identified, and its result."""
    site = site_of([SAMPLE], None)
    settings = IdentificationSettings(threads=1)
    header = ResultHeader(
        version=program_version(), created=0.0, site_hash="0" * 64,
        settings=settings.model_dump(mode="json"), seed=settings.seed,
    )  # fmt: skip
    engine = Engine(site, settings, header, publishes_states=False)
    drives = index_messages("sample", messages_of_trucks([SAMPLE]), site)
    for fix in drives.near:
        engine.expect(fix.key, fix.payload, for_ever=True)
    output = [
        one
        for message in in_measurement_order(drives)
        for one in engine.feed(message.key, message.payload)
    ]
    (work,) = (one for one in [*output, *engine.finish()] if isinstance(one, IdentificationTask))
    here = InlineExecutor()
    here.submit(work)
    (finished,) = here.collect()
    return _Sample(site, work, finished.result)


@pytest.mark.parametrize("processes", list(CROSSINGS))
def test_crossings_in_processes(
    benchmark: BenchmarkFixture, sample: _Sample, processes: int
) -> None:
    """The sample's crossing over and over; the processes are warm, and so is their first one."""
    count = CROSSINGS[processes]

    def run() -> None:
        given = taken = 0
        while taken < count:
            while given < count and not pool.is_full:
                pool.submit(sample.work._replace(number=given))
                given += 1
            for finished in pool.collect(0.1):
                assert finished.result.verdict == "good"
                taken += 1

    with ProcessExecutor(processes) as pool:
        pool.wait_until_warm()
        for number in range(processes):
            pool.submit(sample.work._replace(number=-1 - number))
        warmed = 0
        while warmed < processes:
            warmed += len(pool.collect(0.1))
        benchmark.pedantic(run, rounds=1)
    benchmark.extra_info["crossings"] = count


def test_fusing(benchmark: BenchmarkFixture, sample: _Sample) -> None:
    """So many crossings of one bridge by one truck, as the state of a bridge is made."""
    seconds = []

    def run() -> None:
        seconds.clear()
        for count in FUSED:
            counted = RecentCrossings()
            for number in range(count):
                again = sample.result.model_copy(
                    update={
                        "crossing_id": f"{sample.result.crossing_id}-{number}",
                        "entry_time": sample.result.entry_time + 3600.0 * number,
                        "exit_time": sample.result.exit_time + 3600.0 * number,
                    }
                )
                counted = add_crossings(counted, [one] if (one := usable(again)) else [])
            began = time.perf_counter()
            state = state_of(counted, sample.work.data.bridge.id)
            seconds.append(time.perf_counter() - began)
            assert state is not None
            assert len(state.crossings_used) == count

    benchmark.pedantic(run, rounds=5, warmup_rounds=1)
    benchmark.extra_info |= {"sizes": list(FUSED), "seconds": list(seconds)}


def test_memory_against_length(benchmark: BenchmarkFixture, tmp_path: Path) -> None:
    """Peak memory of `identify` over a drive of ten minutes and over one of an hour, no bridge."""
    sizes, peaks = (10, 60), []

    def peak(path: Path) -> int:
        command = [sys.executable, "-c", _MEMORY, str(path)]
        done = subprocess.run(command, cwd=PROJECT, check=True, capture_output=True, text=True)
        return int(done.stdout)

    for minutes in sizes:
        path = tmp_path / f"{minutes}.mcap"
        recordings.write(path, view.drive(minutes))
        found = benchmark.pedantic(peak, (path,), rounds=1) if minutes == 60 else peak(path)
        peaks.append(found)
    benchmark.extra_info |= {"minutes": list(sizes), "peaks": peaks}
