"""What a user waits for and pays: starts of the commands, memory, parts of an identification.

Everything is measured in processes of their own, after one run that fills the caches.
"""

import json
import statistics
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
from pytest_benchmark.fixture import BenchmarkFixture

PROJECT = Path(__file__).parents[2]

_MEMORY = """
import json, resource
from functools import partial
from pathlib import Path

def peak_bytes():
    # ru_maxrss of a child begins at its parent's peak on Linux; VmHWM is this program's own.
    status = Path("/proc/self/status")
    if status.exists():
        for line in status.read_text().splitlines():
            if line.startswith("VmHWM"):
                return 1024 * int(line.split()[1])
    return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss

bare = peak_bytes()
from pre_core.paper import random_walk
from pre_core.search import loop as search
from tests.benchmarks import cases
walk = random_walk.problem(cases.paper_window(6), cases.NOMINAL, cases.FREE, seed=1)
random_walk.step(walk, random_walk.init(walk, 8))
before = peak_bytes()
search.run_search(
    partial(random_walk.init, walk), partial(random_walk.step, walk), random_walk.STEPS,
    at_limit=search.Termination.STEPS_DONE,
)
print(json.dumps({"interpreter": bare, "before": before, "whole": peak_bytes()}))
"""

_IDENTIFY = """
import cProfile, json, pstats, sys, time
from pathlib import Path
began = time.perf_counter()
from schemas.settings import IdentificationSettings
from services.execution.offline import site_of
from tests.identifications import identify_recordings
imported = time.perf_counter()
recordings = [Path(sys.argv[1])]
settings = IdentificationSettings.model_validate({"method": "least_squares", "seed": 0})

def work():
    begin = time.perf_counter()
    identify_recordings(recordings, site_of(recordings, None), settings)
    return time.perf_counter() - begin

first = work()
again = [work() for _ in range(5)]
profile = cProfile.Profile()
profile.enable()
work()
profile.disable()
own = {}
for (file, _, name), (_, _, seconds, _, _) in pstats.Stats(profile).stats.items():
    own[f"{file}:{name}"] = own.get(f"{file}:{name}", 0.0) + seconds
print(json.dumps({"imports": imported - began, "first": first, "again": again, "own": own}))
"""


_IDENTIFY_PRE = """
import json, resource, sys, time
from pathlib import Path

def peak_bytes():
    status = Path("/proc/self/status")
    if status.exists():
        lines = dict(line.split(":", 1) for line in status.read_text().splitlines())
        return 1024 * int(lines["VmHWM"].split()[0])
    return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss

marks = [("", time.perf_counter(), peak_bytes())]

def mark(what):
    marks.append((what, time.perf_counter(), peak_bytes()))

import pre_core  # numba and NumPy, and what of NumPy is put off before SciPy comes
import google.protobuf.message, mcap.records, pydantic, scipy.linalg, scipy.special, zstandard
mark("libraries imported: numba, SciPy, NumPy, pydantic, protobuf")
from schemas.settings import IdentificationSettings
from services.execution.offline import site_of
from tests.identifications import identify_recordings
from services.execution import warm_up
mark("our modules imported")
from pre_core.physics.vehicle import masses_above_axles
masses_above_axles(1e4, 2.0, 4.0, 1.0)
mark("numba sets itself up for its first kernel")
warm_up._warm_up_pre()
warm_up._warm_up_fusing()
mark("our other kernels loaded from the cache, and called once")
start = [(what, at - before, peak) for (_, before, _), (what, at, peak) in zip(marks, marks[1:])]
recordings = [Path(sys.argv[1])]
settings = IdentificationSettings.model_validate({"seed": 0})

def work():
    marks = [("reading", time.perf_counter())]

    def report(crossing, stage, fraction):
        stage = stage.split(",")[0]
        if stage != marks[-1][0]:
            marks.append((stage, time.perf_counter()))

    found = identify_recordings(recordings, site_of(recordings, None), settings, report)
    marks.append(("", time.perf_counter()))
    stages = {}
    for (stage, begin), (_, end) in zip(marks, marks[1:]):
        stages[stage] = stages.get(stage, 0.0) + end - begin
    return stages, dict(found.crossings[0].diagnostics)

first, _ = work()
with_one = peak_bytes()
runs = [work() for _ in range(5)]
runs.sort(key=lambda run: sum(run[0].values()))
stages, diagnostics = runs[len(runs) // 2]
print(json.dumps({
    "start": start, "first": sum(first.values()), "work": sum(stages.values()),
    "stages": stages, "diagnostics": diagnostics,
    "bare": marks[0][2], "with_one": with_one, "at_last": peak_bytes(),
}))
"""


def _python(*arguments: str) -> str:
    done = subprocess.run(
        [sys.executable, *arguments], cwd=PROJECT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_memory_of_the_search(benchmark: BenchmarkFixture) -> None:
    _python("-c", _MEMORY.replace("random_walk.STEPS", "2"))
    output = benchmark.pedantic(lambda: _python("-c", _MEMORY), rounds=1)
    benchmark.extra_info |= json.loads(output)


def test_start_of_help(benchmark: BenchmarkFixture) -> None:
    program = Path(sys.executable).with_name("driveby")
    command = [str(program)] if program.exists() else [sys.executable, "-m", "services"]

    def start() -> None:
        subprocess.run([*command, "--help"], cwd=PROJECT, capture_output=True, check=True)

    benchmark.pedantic(start, rounds=15, warmup_rounds=2)


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("identify") / "drive.mcap"
    _python("-m", "services", "simulate", "--scenario", "6", "--road", "A", "-o", str(path))
    return path


def test_start_of_identify(benchmark: BenchmarkFixture, recording: Path) -> None:
    """The command as a user runs it; what is beyond the work: that wall time less the work's."""
    command = ["-m", "services", "identify", str(recording), "--method", "least-squares"]
    benchmark.pedantic(lambda: _python(*command), rounds=7, warmup_rounds=1)
    inside: dict[str, Any] = json.loads(_python("-c", _IDENTIFY, str(recording)))
    seconds = []
    for _ in range(7):
        began = time.perf_counter()
        _python("-c", "pass")
        seconds.append(time.perf_counter() - began)
    parts = _by_place(inside["own"])
    benchmark.extra_info |= {
        "python": statistics.median(seconds),
        "imports": inside["imports"],
        "first": inside["first"],
        "work": statistics.median(inside["again"]),
        "profile": parts,
    }


@pytest.fixture(scope="module")
def noisy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Ten seconds at 1 kHz: the paper's truck and bridge, real sensors, 8.1 m/s."""
    path = tmp_path_factory.mktemp("identify") / "noisy.mcap"
    truth = ("--scenario", "6", "--noise", "25", "--gps-noise", "--speed", "8.1")
    _python("-m", "services", "simulate", *truth, "-o", str(path))
    return path


def test_identify_pre(benchmark: BenchmarkFixture, noisy: Path) -> None:
    """One crossing from recording to result as a user waits for it, and where the time goes."""
    command = ["-m", "services", "identify", str(noisy)]
    benchmark.pedantic(lambda: _python(*command), rounds=7, warmup_rounds=1)
    benchmark.extra_info |= json.loads(_python("-c", _IDENTIFY_PRE, str(noisy)))


_PLACES = {
    "the kernels of J (pre_core/paper/residual.py)": ("pre_core/paper/residual.py",),
    "linear algebra of the steps (least_squares.py, SciPy, NumPy)": (
        "pre_core/search/levenberg_marquardt.py",
        "scipy",
        "numpy",
    ),
    "reading and decoding (MCAP, protobuf, zstd, schemas)": (
        "mcap",
        "google/",
        "zstandard",
        "schemas/signals.py",
        "schemas/topics.py",
        "services/recordings/recording.py",
        "services/finding/streams.py",
        "struct",
        "decompress",
    ),
    "the site file and the results (pydantic, TOML)": ("pydantic", "tomllib", "schemas/"),
    "the rest of pre_core": ("pre_core/",),
    "the rest of services": ("services/",),
}


def _by_place(own: dict[str, float]) -> dict[str, float]:
    """Own seconds of every function, summed by where it is; built-ins count as Python's."""
    parts = dict.fromkeys([*_PLACES, "Python itself"], 0.0)
    for function, seconds in own.items():
        for place, marks in _PLACES.items():
            if any(mark in function for mark in marks):
                parts[place] += seconds
                break
        else:
            parts["Python itself"] += seconds
    return parts
