"""A year of a fleet: 12 bridges, 3 trucks, seasons, one bridge that weakens, one that is repaired.

    python -m tests.faults.year --out build/year

Every week what the trucks found is added to the history by `driveby history add`, with the
temperatures of a weather station, and `driveby alarm check` looks at it. One bridge loses 10 % of
an element on 10 August; an element of another is made a quarter stiffer on 20 May, and its owner
acknowledges the alarm that this raises. At the end it is compared which alarms there are: the right
ones and no other, or the exit code is 1. The pages that an owner would look at are drawn.

Crossings are drawn from the method's own statistics and not driven (tests/fleet.py).
"""

import argparse
import contextlib
import io
import sys
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from schemas.results import CrossingResult, results_json
from services.cli import main as cli
from services.common.files import make_folder, write_atomically
from services.common.language import utc_day
from services.execution.blas import one_blas_thread
from services.history.alarm_files import acknowledge, alarms_of
from services.history.alarms import AlarmSettings, check
from tests.fleet import (
    WEEK_S,
    Bridge,
    bridge_of,
    crossing_of,
    results_of,
    season_deg_c,
    templates,
    trucks_of,
)

BRIDGES, TRUCKS, WEEKS = 12, 3, 52
BEGIN_S = datetime(2025, 1, 6, tzinfo=UTC).timestamp()  # a Monday
WEAKENS, WEAK_ELEMENT, LOSS = "bridge-07", 4, 0.10
WEAKENS_S = datetime(2025, 8, 10, tzinfo=UTC).timestamp()
REPAIRED, REPAIRED_ELEMENT, GAIN = "bridge-03", 5, 0.25
REPAIRED_S = datetime(2025, 5, 20, tzinfo=UTC).timestamp()
CHANGE = 0.005
"""Of every element from crossing to crossing, beside the temperature's."""
_WEATHER_K = 4.0


def main() -> int:
    """Simulate the year, print what was found; 1 if it is not what happened."""
    parser = argparse.ArgumentParser(description="a year of a simulated fleet")
    parser.add_argument("--out", type=Path, default=Path("build/year"), help="a new folder")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--weeks", type=int, default=WEEKS)
    options = parser.parse_args()
    if (options.out / "history").exists():
        print(f"{options.out}: has a history already, give another --out", file=sys.stderr)
        return 2
    with one_blas_thread():
        return year(options.out, options.seed, options.weeks)


def year(out: Path, seed: int, weeks: int = WEEKS) -> int:
    """The same, into a folder."""
    rng = np.random.default_rng(seed)
    history = out / "history"
    make_folder(out)
    kinds, trucks = templates(), trucks_of(rng, TRUCKS)
    bridges = [bridge_of(rng, f"bridge-{n + 1:02d}") for n in range(BRIDGES)]
    weather = _weather(rng, weeks)
    station = out / "temperatures.csv"
    lines = (f"{time_s:.0f},{value:.2f}\n" for time_s, value in weather)
    write_atomically(station, "time_s,temperature_deg_c\n" + "".join(lines))
    number = 0
    for week in range(weeks):
        crossings: list[CrossingResult] = []
        for bridge in bridges:
            for _ in range(int(rng.integers(2, 5))):
                entry_s = BEGIN_S + (week + rng.random()) * WEEK_S
                ei = _truth(bridge, entry_s, weather, rng)
                truck = trucks[int(rng.integers(TRUCKS))]
                kind = kinds[int(rng.integers(len(kinds)))]
                crossings.append(crossing_of(rng, kind, truck, bridge, entry_s, ei))
        crossings.sort(key=lambda crossing: crossing.entry_time)
        number += len(crossings)
        found = out / f"week-{week + 1:02d}.json"
        monday_s = BEGIN_S + (week + 1) * WEEK_S
        write_atomically(found, results_json(results_of(crossings, monday_s)))
        words = ["history", "add", str(found), "--later", "--history", str(history)]
        if not _done([*words, "--temperature", str(station)]):
            return 1
        for alarm in check(history, AlarmSettings(), monday_s).raised:
            print(f"{utc_day(monday_s)}  {alarm.bridge}: {alarm.sentence()}")
            if alarm.bridge == REPAIRED and alarm.direction == "stiffer":
                noted_s = monday_s + 2.0 * WEEK_S
                acknowledge(history, alarm, "owner", "element 5 was strengthened in May", noted_s)
                print(f"{utc_day(noted_s)}  {alarm.bridge}: acknowledged by its owner")
    print(f"{number} crossings of {BRIDGES} bridges by {TRUCKS} trucks in {weeks} weeks")
    for name in (WEAKENS, REPAIRED, "bridge-01"):
        words = ["history", name, "--history", str(history), "--period", "week"]
        if not _done([*words, "--figures", str(out / "figures")]):
            return 1
        print(out / "figures" / f"{name}-history.png")
    return _judged(history)


def _done(words: list[str]) -> bool:
    """Run a command; print its output only if it fails."""
    with contextlib.redirect_stdout(io.StringIO()) as output:
        code = cli.main(words)
    if code != 0:
        print(output.getvalue(), end="")
    return code == 0


def _judged(history: Path) -> int:
    """0 if the alarms are those of what happened, and no others."""
    found = []
    for n in range(BRIDGES):
        name = f"bridge-{n + 1:02d}"
        for alarm in alarms_of(history, "sim-fleet", name)[0]:
            found.append((name, alarm.element, alarm.direction, alarm.acknowledged is not None))
            change_s = REPAIRED_S if name == REPAIRED else WEAKENS_S
            print(
                f"{name}: raised {(alarm.raised - change_s) / WEEK_S:.1f} weeks after the change, "
                f"which it dates {abs(alarm.since - change_s) / WEEK_S:.1f} weeks off"
            )
    expected = [
        (REPAIRED, REPAIRED_ELEMENT, "stiffer", True),
        (WEAKENS, WEAK_ELEMENT, "weaker", False),
    ]
    if found == expected:
        print("the right alarms, and no others")
        return 0
    print(f"expected {expected}, found {found}")
    return 1


def _truth(
    bridge: Bridge, time_s: float, weather: list[tuple[float, float]], rng: np.random.Generator
) -> "np.ndarray[tuple[int], np.dtype[np.float64]]":
    """EI at a time: by its temperature, its chance, and what has happened to it."""
    warm = float(np.interp(time_s, *zip(*weather, strict=True)))
    ln = np.log(bridge.ei_nm2) + bridge.slope_per_k * (warm - 10.0)
    ln = ln + CHANGE * rng.standard_normal(ln.size)
    if bridge.name == WEAKENS and time_s >= WEAKENS_S:
        ln[WEAK_ELEMENT - 1] += np.log(1.0 - LOSS)
    if bridge.name == REPAIRED and time_s >= REPAIRED_S:
        ln[REPAIRED_ELEMENT - 1] += np.log(1.0 + GAIN)
    return np.asarray(np.exp(ln))


def _weather(rng: np.random.Generator, weeks: int) -> list[tuple[float, float]]:
    """Every hour: the season, warm afternoons, and days that are warmer or colder."""
    days = 7 * weeks + 2
    of_day = np.convolve(rng.standard_normal(days + 4), np.ones(5) / 5.0**0.5, "valid")
    out = []
    for hour in range(24 * days):
        time_s = BEGIN_S + 3600.0 * hour
        day = float(_WEATHER_K * np.interp(hour / 24.0, np.arange(days), of_day[:days]))
        noon = -3.0 * float(np.cos(2.0 * np.pi * (hour / 24.0 - 3.0 / 24.0)))
        out.append((time_s, season_deg_c(time_s) + day + noon))
    return out


if __name__ == "__main__":
    sys.exit(main())
