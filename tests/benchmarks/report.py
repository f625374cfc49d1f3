"""Run every benchmark once, write studies/benchmarks.md: `python -m tests.benchmarks.report`."""

import argparse
import json
import os
import platform
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

from tests.benchmarks.cases import slope

PROJECT = Path(__file__).parents[2]
FOLDER = PROJECT / "tests" / "benchmarks"
PAGE = PROJECT / "studies" / "benchmarks.md"

_BUSY = 1.5  # one is ourselves, compiling

Entry = dict[str, Any]
"""One benchmark of pytest-benchmark's JSON."""


def main() -> int:
    """Compile the kernels, run the benchmarks, write the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--page", type=Path, default=PAGE, help="where to write the page")
    parser.add_argument("--save", type=Path, help="keep the figures as JSON")
    parser.add_argument("--load", type=Path, help="write the page from figures that were kept")
    options = parser.parse_args()
    if options.load is not None:
        run = json.loads(options.load.read_text("utf-8"))
    else:
        load = os.getloadavg()[0]
        subprocess.run(
            [sys.executable, "-m", "services.execution.warm_up"],
            cwd=PROJECT,
            env=_as_installed(),
            check=True,
        )
        run = _run() | {"load": load}
    if options.save is not None:
        options.save.write_text(json.dumps(run, indent=1), encoding="utf-8")
    options.page.write_text(_page(run), encoding="utf-8")
    print(f"{options.page} written")
    return 0


def _as_installed() -> dict[str, str]:
    """The environment of the commands: with bytecode, which some say must not be written."""
    kept = {k: v for k, v in os.environ.items() if k != "PYTHONDONTWRITEBYTECODE"}
    return {"OPENBLAS_NUM_THREADS": "1"} | kept


def _run() -> Entry:
    began = time.perf_counter()
    with tempfile.TemporaryDirectory() as temporary:
        result = Path(temporary) / "benchmarks.json"
        done = subprocess.run(
            [
                *(sys.executable, "-m", "pytest", *map(str, sorted(FOLDER.glob("bench_*.py")))),
                *("-o", "timeout=0", "-v", "--no-header", "--benchmark-columns=median"),
                *("--benchmark-enable", "--benchmark-only", f"--benchmark-json={result}"),
            ],
            cwd=PROJECT,
            env=_as_installed(),
            check=False,
        )
        if done.returncode != 0:
            sys.exit("a benchmark failed: the page is left as it was")
        run: Entry = json.loads(result.read_text("utf-8"))
    run["minutes"] = (time.perf_counter() - began) / 60.0
    return run


class _Row(NamedTuple):
    work: str
    must: float | None
    aim: float | None
    measured: float
    show: Callable[[float], str]
    remark: str = ""


def _page(run: Entry) -> str:
    found = {entry["name"]: entry for entry in run["benchmarks"]}
    parts = [
        "# Benchmarks",
        (
            "Written by one run of `make bench`, which takes some minutes; do not edit by hand. "
            "The benchmarks are in `tests/benchmarks` and are no part of the default tests; no "
            "test asserts a time."
        ),
        _machine(run),
        "## What was asked for and what was measured",
        "Medians, unless it says otherwise. *Must* and *aim* are for two cores.",
        _targets(found),
        "## Other ways to evaluate J",
        (
            "The plain implementations (`tests/benchmarks/plain_numpy.py`) were written apart from "
            "ours; `tests/benchmarks/test_plain_numpy.py` checks that all agree to 1e-9."
        ),
        _evaluations(found),
        "## Other ways to search",
        (
            "To S_A ≥ 0.99 in all twenty rows of the paper's tables (m_s1 and m_s2 derived), on "
            "the noise-free J of each scenario, from the paper's range 0.8 to 1.2. Every peer has "
            "our batch kernel on two threads and searches in logarithms. Medians of three seeds; "
            "the paper's own search once, judged here by its best particle. The peers stop as soon "
            "as their best vector is near enough to the truth, which only the benchmark knows; "
            "ours stops when it has converged. Settings: `tests/benchmarks/bench_peers.py`."
        ),
        _peers(run["benchmarks"]),
        "## Growth",
        (
            "Time of one evaluation (of all particles in the last row), amortised over a batch on "
            "one thread: its processor time, least of fourteen. The exponent k of time ~ size^k is "
            "fitted to all sizes on log axes; the last exponent is between the two largest."
        ),
        _growth(found),
        _memory(found),
        "## Where the time goes",
        _where(found),
    ]
    return "\n\n".join(parts) + "\n"


def _machine(run: Entry) -> str:
    info = run["machine_info"]
    cpu = info.get("cpu", {})
    name = cpu.get("brand_raw") or platform.processor() or "unknown processor"
    packages = ", ".join(f"{p} {version(p)}" for p in ("numba", "llvmlite", "numpy", "scipy"))
    peers = ", ".join(f"{p} {version(p)}" for p in ("cma", "emcee"))
    rows = [
        ("processor", f"{name}, {cpu.get('count', '?')} cores"),
        ("system", f"{info['system']} {info['release']}, {info['machine']}"),
        ("Python", f"{info['python_implementation']} {info['python_version']}"),
        ("packages", f"{packages}; {peers}"),
        ("date", str(run["datetime"])[:10]),
    ]
    if run.get("minutes") is not None:
        rows.append(("the run took", f"{run['minutes']:.1f} min"))
    load = run.get("load")
    if load is not None:
        busy = ": **busy with other work, times are too long**" if load > _BUSY else ""
        rows.append(("load average before it", f"{load:.1f}{busy}"))
    return _table(["machine", ""], rows)


def _targets(found: dict[str, Entry]) -> str:
    batch = _median(found["test_one_evaluation_of_500"]) / 500.0
    memory = found["test_memory_of_the_search"]["extra_info"]
    identify = found["test_start_of_identify"]
    whole, work = _median(identify), identify["extra_info"]["work"]
    pre = found["test_identify_pre"]
    warm, diagnostics = pre["extra_info"]["work"], pre["extra_info"]["diagnostics"]
    squares = found["test_least_squares"]
    walk = found["test_paper_search"]
    one, two = (_a_minute(found[f"test_crossings_in_processes[{n}]"]) for n in (1, 2))
    fused = found["test_fusing"]["extra_info"]
    at_start = pre["extra_info"]["start"][-1][2]
    rows = [
        _Row(
            "`driveby identify` of one crossing, 10 s at 1 kHz, everything included",
            2.0,
            1.5,
            _median(pre),
            _time,
            f"{diagnostics['iterations']:.0f} evaluations to the optimum, "
            f"{diagnostics['chain_evaluations']:.0f} for the draws",
        ),
        _Row("the same in a process that is warm", 1.0, 0.7, warm, _time, "reading included"),
        _Row(
            "its memory",
            200e6,
            None,
            pre["extra_info"]["with_one"],
            _size,
            f"{_size(at_start)} before a recording is opened, see below; after five more "
            f"{_size(pre['extra_info']['at_last'])}",
        ),
        _Row(
            "200 crossings on 2 processes, seconds a crossing",
            60.0 / 90.0,
            None,
            60.0 / two,
            _time,
            f"{two:.0f} a minute; one process {one:.0f}: {two / one:.2f} times as many "
            "(1.9 asked for)",
        ),
        _Row("fusing 100 crossings", 1.0, None, fused["seconds"][-1], _time),
        _Row(
            "one evaluation of J, alone",
            0.09e-3,
            0.06e-3,
            _median(found["test_one_evaluation_alone"]),
            _time,
        ),
        _Row("one evaluation of J, amortised over 500, one thread", 0.12e-3, 0.03e-3, batch, _time),
        _Row(
            "the paper's whole search, 500 × 600, scenario 6",
            8.0,
            5.0,
            _median(walk),
            _time,
            f"{_time(_median(walk) / walk['extra_info']['evaluations'])} an evaluation, "
            "which stops when the comparison is decided",
        ),
        _Row(
            "least squares on one crossing, noise-free, random start",
            0.5,
            0.1,
            _median(squares),
            _time,
            f"20 starts, slowest {_time(squares['stats']['max'])}, "
            f"{squares['extra_info']['evaluations']:.0f} evaluations, "
            f"least S_A {squares['extra_info']['worst_accuracy']:.6f}",
        ),
        _Row(
            "forward simulation of a crossing, 7 elements, 1 ms",
            5e-3,
            None,
            _median(found["test_simulation"]),
            _time,
            f"{found['test_simulation']['extra_info']['steps']} steps, forces to 1e-12",
        ),
        _Row(
            "memory of the 500-particle search, whole process",
            500e6,
            200e6,
            memory["whole"],
            _size,
            f"{_size(max(0, memory['whole'] - memory['before']))} of it for the search; the rest "
            "is Python, NumPy, SciPy and numba",
        ),
        _Row("start of `driveby --help`", None, 0.5, _median(found["test_start_of_help"]), _time),
        _Row(
            "`driveby identify` beyond the work itself, least squares",
            None,
            3.0,
            whole - work,
            _time,
            f"the whole command {_time(whole)}, of which work {_time(work)}",
        ),
    ]
    return _table(
        ["work", "must", "aim", "measured", "", "remark"],
        [
            (
                row.work,
                "" if row.must is None else f"≤ {row.show(row.must)}",
                "" if row.aim is None else f"≤ {row.show(row.aim)}",
                f"**{row.show(row.measured)}**",
                _verdict(row),
                row.remark,
            )
            for row in rows
        ],
    )


def _a_minute(entry: Entry) -> float:
    return 60.0 * float(entry["extra_info"]["crossings"]) / _median(entry)


def _verdict(row: _Row) -> str:
    if row.aim is not None and row.measured <= row.aim:
        return "aim met"
    if row.aim is None and row.must is not None:
        return "must met" if row.measured <= row.must else "**must missed**"
    if row.must is None:
        return "aim missed"
    return "must met, aim missed" if row.measured <= row.must else "**must missed**"


def _evaluations(found: dict[str, Entry]) -> str:
    alone = _median(found["test_one_evaluation_alone"])
    batch = _median(found["test_one_evaluation_of_500"]) / 500.0
    rows = [
        ("ours, in a batch of 500", batch),
        ("ours, alone", alone),
        (
            "NumPy and one scipy.signal.lfilter a mode",
            _median(found["test_plain_numpy[filters]"]),
        ),
        ("NumPy, Newmark step by step in a Python loop", _median(found["test_plain_numpy[nodal]"])),
    ]
    return _table(
        ["implementation", "one evaluation", "of ours alone"],
        [(name, _time(seconds), f"{seconds / alone:.2g} ×") for name, seconds in rows],
    )


def _peers(benchmarks: Iterable[Entry]) -> str:
    methods: dict[str, dict[int, list[dict[str, float]]]] = {}
    for entry in benchmarks:
        info = entry["extra_info"]
        if "runs" in info:
            methods.setdefault(info["method"], {})[info["scenario"]] = info["runs"]
    scenarios = sorted({number for runs in methods.values() for number in runs})
    order = sorted(methods, key=lambda name: not name.startswith("ours"))
    return _table(
        ["method", *(f"scenario {number}" for number in scenarios)],
        [(name, *(_race(methods[name].get(number, [])) for number in scenarios)) for name in order],
    )


def _race(runs: list[dict[str, float]]) -> str:
    if not runs:
        return "—"
    reached = [run for run in runs if run["worst_accuracy"] >= 0.99]
    seconds = statistics.median(run["seconds"] for run in runs)
    if 2 * len(reached) <= len(runs):
        worst = statistics.median(run["worst_accuracy"] for run in runs)
        return f"not reached in 300,000 evaluations ({_time(seconds)}); S_A ≥ {worst:.2f}"
    evaluations = statistics.median(run["evaluations"] for run in runs)
    missed = len(runs) - len(reached)
    remark = f" ({missed} of {len(runs)} not reached)" if missed else ""
    return f"{evaluations:,.0f} evaluations, {_time(seconds)}{remark}"


_GROWTHS = {
    "test_growth_with_steps": "time steps (speeds of 40 to 2.5 m/s)",
    "test_growth_with_modes": "modes (7 elements, 4 parts each)",
    "test_growth_with_elements": "elements (in 14 modes)",
    "test_growth_with_elements_and_all_modes": "elements (with all their modes, two an element)",
    "test_growth_with_particles": "particles",
}


def _growth(found: dict[str, Entry]) -> str:
    rows = []
    for name, what in _GROWTHS.items():
        info = found[name]["extra_info"]
        figures = " · ".join(
            f"{size}: {_time(seconds)}"
            for size, seconds in zip(info["sizes"], info["seconds"], strict=True)
        )
        rows.append((what, f"{info['exponent']:.2f}", f"{info['last_exponent']:.2f}", figures))
    fused = found["test_fusing"]["extra_info"]
    figures = " · ".join(
        f"{size}: {_time(seconds)}"
        for size, seconds in zip(fused["sizes"], fused["seconds"], strict=True)
    )
    sizes, seconds = fused["sizes"], fused["seconds"]
    exponents = slope(sizes, seconds), slope(sizes[-2:], seconds[-2:])
    rows.append(("crossings that are fused", *(f"{one:.2f}" for one in exponents), figures))
    return _table(["time against", "exponent", "last exponent", "size: time"], rows)


def _memory(found: dict[str, Entry]) -> str:
    info = found["test_memory_against_length"]["extra_info"]
    peaks = ", ".join(
        f"{_size(peak)} of {minutes} minutes"
        for minutes, peak in zip(info["minutes"], info["peaks"], strict=True)
    )
    return f"Most memory of `identify` over a drive at 1 kHz that crosses no bridge: {peaks}."


def _where(found: dict[str, Entry]) -> str:
    one = found["test_parts_of_an_evaluation"]["extra_info"]
    identify = found["test_start_of_identify"]
    info = identify["extra_info"]
    shares = [
        ("once for each vector: stiffness, eigenproblem, filters", one["before_the_steps"]),
        ("the 14 modes, step by step", one["modes"]),
        ("input profiles, contact forces, comparison of the roads", one["without_modes"]),
    ]
    pre = found["test_identify_pre"]
    loading = info["first"] - info["work"]
    stages = [
        ("Python starts", info["python"]),
        ("imports", info["imports"]),
        ("kernels loaded from the cache, other first calls", loading),
        ("the work", info["work"]),
    ]
    total = sum(info["profile"].values())
    return "\n\n".join(
        [
            (
                "One evaluation, amortised. Inferred from four: at 10 and 5 m/s (twice the steps), "
                "with 14 and with 7 modes."
            ),
            _table(
                ["part", "time", "share"],
                [(part, _time(t), f"{t / one['whole']:.0%}") for part, t in shares],
            ),
            (
                f"The command `driveby identify` with least squares on one crossing of 1 kHz, "
                f"{_time(_median(identify))} by the clock:"
            ),
            _table(["stage", "time"], [(stage, _time(t)) for stage, t in stages]),
            "The work, by where the time is spent (own time of the functions under cProfile):",
            _table(
                ["place", "time", "share"],
                [(place, _time(t), f"{t / total:.0%}") for place, t in info["profile"].items()],
            ),
            (
                f"The same with method pre and real sensors, {_time(_median(pre))} by the clock. "
                "What comes before the reading is the floor of any program with these libraries; "
                "beside it the most memory up to there."
            ),
            _table(["stage", "time", "memory"], _stages(pre, info)),
        ]
    )


def _stages(pre: Entry, plain: dict[str, Any]) -> list[tuple[str, str, str]]:
    """What a cold command does, and the most memory up to there; one process of its own."""
    info = pre["extra_info"]
    begin = [("Python starts", plain["python"], info["bare"]), *map(tuple, info["start"])]
    floor = sum(seconds for _, seconds, _ in begin)
    rest = _median(pre) - floor - info["first"]
    return [
        *((stage, _time(seconds), _size(peak)) for stage, seconds, peak in begin),
        ("**all of that**", f"**{_time(floor)}**", f"**{_size(begin[-1][2])}**"),
        *((stage, _time(seconds), "") for stage, seconds in info["stages"].items()),
        ("what is done for the first time", _time(info["first"] - info["work"]), ""),
        ("arguments, results as JSON, Python ends", _time(rest), _size(info["with_one"])),
    ]


def _median(entry: Entry) -> float:
    return float(entry["stats"]["median"])


def _time(seconds: float) -> str:
    if abs(seconds) < 1e-3:
        return f"{seconds * 1e3:.3f} ms"
    if abs(seconds) < 1.0:
        return f"{seconds * 1e3:.3g} ms"
    return f"{seconds:.3g} s"


def _size(count: float) -> str:
    return f"{count / 1e6:.0f} MB"


def _table(header: list[str], rows: Iterable[tuple[str, ...]]) -> str:
    lines = ["| " + " | ".join(header) + " |", "|" + " --- |" * len(header)]
    return "\n".join([*lines, *("| " + " | ".join(row) + " |" for row in rows)])


if __name__ == "__main__":
    sys.exit(main())
