"""A history of 10^6 crossings of 10^4 bridges: how large it is, and how long questions to it take.

    python -m tests.benchmarks.fleet --out /tmp/fleet [--all]

100 bridges are drawn (tests/fleet.py), a hundred crossings in ten batches each over two years; the
others are copies of their files, real ones of their own. Processor time of several processes is
not counted: see what one takes for 200 bridges. The folder takes 5 to 6 GB and is left
for another look; a history that is there is used again. Times are processor seconds of the command
and its children, and by the clock.
"""

import argparse
import json
import resource
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from services.catalogue.index import _file_of
from services.catalogue.row import CatalogRow
from services.execution.blas import one_blas_thread
from services.finding.bridges import Box
from services.history.alarms import (
    AlarmSettings,
    change_markers,
    check,
    monitor_bridge,
    save_markers,
)
from services.history.history_store import HistoryRow, history_row, partition, write_batch
from services.history.sql import overview
from tests.fleet import HEADER, bridge_of, crossing_of, season_deg_c, templates, trucks_of

REALM = "sim-fleet"
DRAWN, BATCHES = 100, 10
BEGIN_S = datetime(2024, 1, 1, tzinfo=UTC).timestamp()
YEARS = 2.0
OF_ONE = 200
A_NIGHT = 2740
"""Crossings in a night of a million a year, each of another bridge."""


def main() -> None:
    """Make the history if it is not there, and measure."""
    parser = argparse.ArgumentParser(description="a history of a million crossings")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--bridges", type=int, default=10_000)
    parser.add_argument("--crossings", type=int, default=100)
    parser.add_argument("--all", action="store_true", help="alarms of all bridges too")
    options = parser.parse_args()
    history: Path = options.out / "history"
    if not history.exists():
        took("made", lambda: make(history, options.bridges, options.crossings))
    size = sum(path.stat().st_size for path in history.rglob("*.parquet"))
    number = options.bridges * options.crossings
    print(f"{number} crossings of {options.bridges} bridges: {size / 1e9:.2f} GB of Parquet, "
          f"{size / number:.0f} bytes a crossing")  # fmt: skip
    print(f"catalogue: {catalogue_bytes():.0f} bytes a recording, packed by days")
    bridge = f"bridge-{options.bridges // 2:05d}"
    shutil.rmtree(history / "fused", ignore_errors=True)
    command = [sys.executable, "-m", "services", "history", bridge, "--history", str(history)]
    for what in ("first", "again"):
        took(f"driveby history {bridge}, {what}", lambda: output(command))
    now_s = BEGIN_S + YEARS * 365.25 * 86_400.0
    settings = AlarmSettings()
    with one_blas_thread():
        some = [f"bridge-{n:05d}" for n in range(min(OF_ONE, options.bridges))]
        took(
            f"alarms of {len(some)} bridges in this process",
            lambda: sum(
                monitor_bridge(history, REALM, b, settings, now_s).alarm is not None for b in some
            ),
        )
        if options.all:
            shutil.rmtree(history / "alarms", ignore_errors=True)
            took("alarms of all bridges, 2 processes", lambda: looked(history, now_s))
        save_markers(history, change_markers(history, settings, now_s))
        night(history, options.bridges)
        took("alarms of a night, 2 processes", lambda: looked(history, now_s))
    took("all bridges in a table (DuckDB)", lambda: len(overview(history).rows))


def make(history: Path, bridges: int, crossings: int) -> str:
    """Draw some bridges and copy them."""
    rng = np.random.default_rng(1)
    kinds, trucks = templates(), trucks_of(rng, 100)
    folders = []
    for n in range(min(DRAWN, bridges)):
        bridge = bridge_of(rng, f"bridge-{n:05d}")
        mine = [trucks[k] for k in rng.choice(100, 4, replace=False)]
        where = partition(history, REALM, bridge.name)
        times = np.sort(rng.uniform(0.0, YEARS * 365.25 * 86_400.0, crossings)) + BEGIN_S
        rows: list[HistoryRow] = []
        for time_s in times.tolist():
            warm = season_deg_c(time_s) + 4.0 * float(rng.standard_normal())
            ei = bridge.ei_nm2 * np.exp(bridge.slope_per_k * (warm - 10.0))
            ei = ei * np.exp(0.005 * rng.standard_normal(ei.size))
            kind, truck = kinds[int(rng.integers(len(kinds)))], mine[int(rng.integers(4))]
            crossing = crossing_of(rng, kind, truck, bridge, time_s, ei)
            rows.append(history_row(crossing, HEADER._replace(created=time_s), warm))
        for batch in np.array_split(np.arange(crossings), BATCHES):
            write_batch(where, [rows[k] for k in batch.tolist()])
        folders.append(where)
    for n in range(len(folders), bridges):
        shutil.copytree(folders[n % len(folders)], partition(history, REALM, f"bridge-{n:05d}"))
    return f"{len(folders)} bridges drawn"


def night(history: Path, bridges: int) -> None:
    """Crossings are added to some bridges: a file of another bridge's newest batch."""
    rng = np.random.default_rng(2)
    for n in rng.choice(bridges, min(A_NIGHT, bridges), replace=False).tolist():
        where = partition(history, REALM, f"bridge-{n:05d}")
        newest = sorted(where.glob("*[!z].parquet"))[-1]  # not one of an earlier night
        shutil.copy(newest, where / f"{newest.stem[:-1]}z.parquet")


def looked(history: Path, now_s: float) -> str:
    found = check(history, AlarmSettings(), now_s, processes=2)
    return f"{found.bridges} bridges, {len(found.active)} alarms active"


def catalogue_bytes() -> float:
    """Of rows of a day of a hundred trucks that begin a file every quarter of an hour."""
    rng = np.random.default_rng(3)
    rates = dict.fromkeys(("sprung_front", "sprung_rear", "unsprung_front", "unsprung_rear"), 1e3)
    rows = [
        CatalogRow(
            f"live/2026-01-01/truck-{n % 100}-20260101T{n:06d}Z.mcap",
            int(rng.integers(20e6, 30e6)), int(rng.integers(1 << 60)), rng.bytes(32), ("live",),
            (f"truck-{n % 100}",), 10**18 + n * 9 * 10**9, 10**18 + (n + 100) * 9 * 10**9, 27_000,
            {**rates, "gnss": 10.0}, 0, 0.0, Box(*rng.uniform(8.0, 50.0, 4).tolist()),
        )
        for n in range(9600)
    ]  # fmt: skip
    return len(_file_of(rows)) / len(rows)


def output(command: list[str]) -> str:
    out = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    return out.splitlines()[0]


def took(what: str, work: Callable[[], object]) -> None:
    """Do it, and print how long it took."""
    before, began_s = processor_s(), time.perf_counter()
    result = work()
    wall_s, used_s = time.perf_counter() - began_s, processor_s() - before
    line = {"what": what, "wall_s": round(wall_s, 2), "processor_s": round(used_s, 2)}
    print(json.dumps(line), result, flush=True)


def processor_s() -> float:
    """Of this process and of its children that have ended."""
    own = resource.getrusage(resource.RUSAGE_SELF)
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return own.ru_utime + own.ru_stime + children.ru_utime + children.ru_stime


if __name__ == "__main__":
    main()
