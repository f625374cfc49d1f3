"""A day of a small fleet in real processes: every crossing gets one result, whoever is killed.

    python -m tests.faults.day [--minutes 60] [--speed 4] [--kills 5] [--away 600] [--seed 1]

Logger, worker, live view and two trucks, each a process of the command `driveby`. The site has
twelve bridges: nine on one road, the tenth beside one of them on the other carriageway, the
eleventh above another one and the twelfth across the road; trucks drive to and fro, the way back
over the other carriageway, and never over the last two. The worker is killed at random moments,
and once it is away for longer than a truck's history (seconds of the drive). Then each crossing
that was driven must have one result, in its order, and nothing else may have one.

The live view is killed, too, at a random moment before the worker is for the first time: a worker
that is there publishes to a new view all that it has published so far. So the view that follows
must show each crossing of the eight bridges that it draws, those that it met first, once and with a
verdict. What it shows is read as a viewer reads it, by one that writes what it gets into a file.
"""

import argparse
import contextlib
import logging
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import warnings
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from rerun.chunk import RrdReader

from pre_core.paper.experiment import scenario_ratios
from schemas.proto import driveby_pb2 as pb
from schemas.signals import CHANNELS
from schemas.site import Bridge, Site
from schemas.site_file import site_toml
from services.common.arrays import Floats
from services.common.geodesy import bridge_frame, to_lat_lon
from services.drives.runs import GnssTrack, Run, run_to_messages
from services.recordings.recording import read_info, read_messages
from services.recordings.writer import write_recording
from services.simulation.drive import DrivenRoad, SimulatedDrive, paper_site, simulate_drive
from services.viewer.crossing_view import VERDICT_COLOURS
from services.viewer.live_layout import lane_entity
from services.viewer.live_view import MAX_BRIDGES
from services.viewer.view import viewer_arguments, viewer_program
from tests.endpoints import free_endpoint, free_port
from tests.parent import parent_environment
from tests.waiting import LONGEST_S

REALM = "sim-day"
SPEED_M_PER_S = 10.0
APART_M = 200.0
"""From bridge to bridge."""
ASIDE_M = 14.0
"""From carriageway to carriageway."""
_LEAD_M = 30.0
"""What the simulated crossings begin before the bridge."""
_START_S = 1_767_225_600.0
_ON_THE_ROAD = 9
_TWIN = 3
"""Number of the bridge on the road that has another one beside it."""
_BELOW = 5
"""Number of the one that has another one above it."""
TRUCKS = ("truck-1", "truck-2")


class Crossed(NamedTuple):
    """What a result must say."""

    bridge: str
    direction: str


class Plan(NamedTuple):
    """A truck's drive."""

    recording: Path
    crossings: list[Crossed]
    seconds: float


def place(name: str, along_m: float, aside_m: float, altitude_m: float, *, turned: bool) -> Bridge:
    """A bridge like the paper's, somewhere along the road or across it."""
    one = paper_site().bridges[0]
    there = (0.0, one.span_m) if turned else (one.span_m, 0.0)
    along = [along_m, along_m + there[0]]
    aside = [aside_m, aside_m + there[1]]
    (a_lat, b_lat), (a_lon, b_lon) = to_lat_lon(bridge_frame(one), along, aside)
    ends = {
        "start_latitude_deg": float(a_lat),
        "start_longitude_deg": float(a_lon),
        "end_latitude_deg": float(b_lat),
        "end_longitude_deg": float(b_lon),
    }
    heights = {"start_altitude_m": altitude_m, "end_altitude_m": altitude_m}
    return one.model_copy(update={"id": name, **ends, **heights})


def site() -> Site:
    """Twelve bridges and two trucks."""
    span_m = paper_site().bridges[0].span_m
    road = [place(f"road-{n}", n * APART_M, 0.0, 100.0, turned=False) for n in range(_ON_THE_ROAD)]
    others = [
        place("other-carriageway", _TWIN * APART_M, ASIDE_M, 100.0, turned=False),
        place("above", _BELOW * APART_M, 0.0, 112.0, turned=False),
        place("across", 6.5 * APART_M, -0.5 * span_m, 108.0, turned=True),
    ]
    truck = paper_site().vehicles[0]
    trucks = tuple(truck.model_copy(update={"id": name}) for name in TRUCKS)
    return paper_site().model_copy(update={"vehicles": trucks, "bridges": (*others, *road)})


def drives() -> tuple[SimulatedDrive, SimulatedDrive]:
    """A crossing there and one back, without noise: what a truck feels on any of the bridges."""
    there, back = (
        simulate_drive(paper_site(), scenario_ratios(6), DrivenRoad("A", 1), forward=forward)
        for forward in (True, False)
    )
    return there, back


def way(
    rounds: int, bridges: int, lead_m: float = 0.0
) -> tuple[Floats, list[tuple[float, Crossed]]]:
    """Where a truck drives to and fro over so many bridges of the road, and what it crosses.

    It begins so far before the first one. Returns corners (n, 3) of time, chainage and lateral
    place of the front axle, and for each crossing the time at which its simulated one begins.
    """
    span_m = paper_site().bridges[0].span_m
    end_m = (bridges - 1) * APART_M + 120.0
    corners = [(0.0, -120.0 - lead_m, 0.0)]
    crossings: list[tuple[float, Crossed]] = []

    def drive_to(along_m: float, aside_m: float) -> None:
        time_s, along, aside = corners[-1]
        way_m = max(abs(along_m - along), abs(aside_m - aside))
        corners.append((time_s + way_m / SPEED_M_PER_S, along_m, aside_m))

    def cross(number: int, name: str, *, forward: bool) -> None:
        begin_m = number * APART_M + (-_LEAD_M if forward else span_m + _LEAD_M)
        drive_to(begin_m, corners[-1][2])
        direction = "start_to_end" if forward else "end_to_start"
        crossings.append((corners[-1][0], Crossed(name, direction)))

    for _ in range(rounds):
        for number in range(bridges):
            cross(number, f"road-{number}", forward=True)
        drive_to(end_m, 0.0)
        drive_to(end_m, 80.0)  # round a block
        drive_to(end_m + 20.0, 80.0)
        drive_to(end_m + 20.0, 0.0)
        drive_to(end_m, 0.0)
        for number in reversed(range(bridges)):
            if number != _TWIN:
                cross(number, f"road-{number}", forward=False)
                continue
            drive_to(number * APART_M + 120.0, 0.0)
            drive_to(number * APART_M + 100.0, ASIDE_M)
            cross(number, "other-carriageway", forward=False)
            drive_to(number * APART_M - 60.0, ASIDE_M)
            drive_to(number * APART_M - 80.0, 0.0)
        drive_to(-120.0, 0.0)
        drive_to(-120.0, 80.0)
        drive_to(-140.0, 80.0)
        drive_to(-140.0, 0.0)
        drive_to(-120.0, 0.0)
    drive_to(-120.0, 100.0)
    return np.array(corners), crossings


def write_drive(
    path: Path, vehicle: str, felt: tuple[SimulatedDrive, SimulatedDrive], rounds: int, bridges: int
) -> Plan:
    """The recording of a truck that drives there and back so often."""
    # One behind the other: two on a bridge at a time are rejected, which is a result as well.
    corners, crossings = way(rounds, bridges, 430.0 * TRUCKS.index(vehicle))
    known = site()
    end_s = float(corners[-1, 0])
    rate = felt[0].run.rate_hz
    time_s = np.arange(round(end_s * rate)) / rate
    rng = np.random.default_rng(TRUCKS.index(vehicle))
    channels = {name: 0.02 * rng.standard_normal(time_s.size) for name in CHANNELS}
    for begin_s, crossed in crossings:
        run = felt[crossed.direction == "end_to_start"].run
        first = round(begin_s * rate)
        for name, values in run.channels.items():
            channels[name][first : first + values.size] = values
    fixes = np.arange(round(10.0 * end_s)) / 10.0
    along, aside = (np.interp(fixes, corners[:, 0], corners[:, n]) for n in (1, 2))
    sense = np.sign(np.gradient(along))
    antenna = known.vehicle(vehicle).gps_antenna_to_front_axle_m
    latitude, longitude = to_lat_lon(
        bridge_frame(paper_site().bridges[0]), along - sense * antenna, aside
    )
    height, speed = np.full(fixes.size, 100.0), np.full(fixes.size, SPEED_M_PER_S)
    gnss = GnssTrack(_START_S + fixes, latitude, longitude, height, speed, None)
    run = Run("a day", _START_S + time_s, rate, channels, gnss)
    messages = run_to_messages([run], known, REALM, vehicle)
    write_recording(path, messages, site_toml=site_toml(known), reason="a day")
    return Plan(path, [crossed for _, crossed in crossings], end_s)


class Fleet:
    """The processes, their logs and what they leave, below one folder."""

    def __init__(self, folder: Path, *, method: str, processes: int) -> None:
        self.folder = folder
        self.recordings = folder / "recordings"
        self.site = folder / "site.toml"
        self.site.write_text(site_toml(site()))
        self.endpoint = free_endpoint()
        self._worker_options = ("--method", method, "--processes", str(processes))
        self._started: list[subprocess.Popen[bytes]] = []
        self._views = 0

    def start(self, *arguments: str) -> subprocess.Popen[bytes]:
        log = (self.folder / f"{arguments[0]}-{len(self._started)}.log").open("wb")
        process = subprocess.Popen(
            [sys.executable, "-m", "tests.faults.command", *arguments],
            stdout=log,
            stderr=subprocess.STDOUT,
            env=os.environ | parent_environment(),
            cwd=Path(__file__).parents[2],
        )
        log.close()
        self._started.append(process)
        return process

    def start_logger(self) -> subprocess.Popen[bytes]:
        process = self.start(
            *("logger", "--listen", self.endpoint, "--folder", str(self.recordings)),
            *("--realm", REALM, "--site", str(self.site), "--rotate-minutes", "0.5"),
            *("--min-free", "0"),
        )
        self._wait_for("ready", process)
        return process

    def start_worker(self) -> subprocess.Popen[bytes]:
        return self.start(
            *("worker", "--endpoint", self.endpoint, "--realm", REALM),
            *("--site", str(self.site), "--folder", str(self.recordings), *self._worker_options),
        )

    def start_view(self) -> "View":
        """The live view, and a viewer without a screen that writes what it gets into a file."""
        process = self.start(
            *("view", "live", "--serve", "--endpoint", self.endpoint, "--realm", REALM),
            *("--site", str(self.site)),
        )
        self._wait_for("live at ", process)
        address = re.findall(r"live at (\S+);", self._log_of(process).read_text())[0]
        self._views += 1
        shown = self.folder / f"view-{self._views}.rrd"
        own = os.environ | {"HOME": str(self.folder), "XDG_CONFIG_HOME": str(self.folder)}
        subprocess.run(
            [viewer_program(), "analytics", "disable"], env=own, check=True, capture_output=True
        )
        arguments = viewer_arguments(address, web=False)
        arguments[arguments.index("--port") + 1] = str(free_port())
        viewer = subprocess.Popen(
            [*arguments, "--save", str(shown)], env=own, stderr=subprocess.DEVNULL
        )
        self._started.append(viewer)
        return View(process, viewer, shown)

    def start_truck(self, plan: Plan, speed: float) -> subprocess.Popen[bytes]:
        return self.start(
            *("truck", str(plan.recording), "--endpoint", self.endpoint, "--realm", REALM),
            *("--speed", f"{speed:g}"),
        )

    def _log_of(self, process: subprocess.Popen[bytes]) -> Path:
        return next(self.folder.glob(f"*-{self._started.index(process)}.log"))

    def _wait_for(self, text: str, process: subprocess.Popen[bytes]) -> None:
        log = self._log_of(process)
        deadline = time.monotonic() + LONGEST_S
        while text not in log.read_text():
            assert time.monotonic() < deadline, log.read_text()
            assert process.poll() is None, log.read_text()
            time.sleep(0.05)

    def results(self) -> list[pb.Estimate]:
        """All estimates in all results files, those of one identity once."""
        found = {}
        for path in sorted((self.recordings / REALM).glob("results-*.mcap")):
            try:
                messages = list(read_messages(path)) if read_info(path).messages else []
            except ValueError:  # it was begun in this moment
                continue
            for m in messages:
                if m.key.stream == "estimate":
                    found[m.key, m.boot_id, m.sequence] = pb.Estimate.FromString(m.payload)
        return list(found.values())

    def logs(self) -> str:
        return "\n".join(
            f"{path.name}:\n{path.read_text()[-1500:]}"
            for path in sorted(self.folder.glob("*.log"))
        )

    def close(self) -> None:
        for process in self._started:
            if process.poll() is None:
                process.kill()
            process.wait()


class View(NamedTuple):
    """A live view, and what it shows."""

    process: subprocess.Popen[bytes]
    viewer: subprocess.Popen[bytes]
    shown: Path

    def kill(self) -> None:
        """Both, and what was shown is of no use any more."""
        for process in (self.process, self.viewer):
            process.kill()
            process.wait()

    def picture(self) -> "Picture":
        """What it shows so far; nothing, if there is no file yet or it ends amid a chunk."""
        known = site()
        lanes = {
            f"/{lane_entity(bridge.id, vehicle.id)}": (bridge.id, vehicle.id)
            for bridge in known.bridges
            for vehicle in known.vehicles
        }
        pages = {f"/newest/{bridge.id}": bridge.id for bridge in known.bridges}
        found = Picture(set(), Counter())
        with warnings.catch_warnings(), contextlib.suppress(RuntimeError, ValueError):
            # The file is still being written: it has no footer.
            warnings.simplefilter("ignore")
            for chunk in RrdReader(self.shown).stream():
                if chunk.entity_path in pages:
                    found.bridges.add(pages[chunk.entity_path])
                if chunk.entity_path not in lanes or chunk.is_static:
                    continue
                rows = chunk.to_record_batch()
                (name,) = (n for n in rows.schema.names if n.endswith("StateChange:state"))
                states = [one[0] for one in rows[name].to_pylist() if one]
                verdicts = sum(state in VERDICT_COLOURS for state in states)
                found.verdicts[lanes[chunk.entity_path]] += verdicts
        return found


class Picture(NamedTuple):
    """What a live view shows of crossings."""

    bridges: set[str]
    """Those that it draws: not more than some, which it met first."""
    verdicts: Counter[tuple[str, str]]
    """How many crossings have one, by bridge and truck."""


def driven_in(picture: Picture, plans: dict[str, Plan]) -> Counter[tuple[str, str]]:
    """What a picture must show of what was driven."""
    return Counter(
        (crossed.bridge, vehicle)
        for vehicle, plan in plans.items()
        for crossed in plan.crossings
        if crossed.bridge in picture.bridges
    )


def problems_of_view(picture: Picture, plans: dict[str, Plan]) -> list[str]:
    """Where a picture has too few or too many crossings with a verdict."""
    driven = driven_in(picture, plans)
    found = [
        f"live view: {picture.verdicts[lane]} crossings of {lane[1]} over {lane[0]} instead of "
        f"{driven[lane]}"
        for lane in sorted(driven | picture.verdicts)
        if picture.verdicts[lane] != driven[lane]
    ]
    if len(picture.bridges) != MAX_BRIDGES:
        found.append(f"live view: {len(picture.bridges)} bridges instead of {MAX_BRIDGES}")
    return found


class DayOutcome(NamedTuple):
    """What a day came to."""

    crossings: int
    results: int
    shown: int
    """Crossings with a verdict in the picture of the live view, on the bridges that it draws."""
    to_show: int
    kills: int
    seconds: float
    longest_backlog: int
    problems: list[str]


def problems_of(plans: dict[str, Plan], results: Sequence[pb.Estimate]) -> list[str]:
    """What is missing, twice or invented; nothing, if all is well."""
    found = []
    for vehicle, plan in plans.items():
        theirs = sorted((r for r in results if r.vehicle == vehicle), key=lambda r: r.entry_time_ns)
        published = [
            Crossed(r.bridge, "start_to_end" if r.direction == pb.START_TO_END else "end_to_start")
            for r in theirs
        ]
        if len({r.crossing_id for r in theirs}) != len(theirs):
            found.append(f"{vehicle}: a crossing has two results")
        if published != plan.crossings:
            first = next(
                (
                    n
                    for n, pair in enumerate(zip(published, plan.crossings, strict=False))
                    if pair[0] != pair[1]
                ),
                min(len(published), len(plan.crossings)),
            )
            found.append(
                f"{vehicle}: {len(published)} results of {len(plan.crossings)} crossings, the "
                f"first difference at number {first}: {published[first : first + 3]} for "
                f"{plan.crossings[first : first + 3]}"
            )
    others = {r.vehicle for r in results} - set(plans)
    return found + [f"results of {name}" for name in sorted(others)]


def live(
    folder: Path,
    *,
    rounds: int,
    bridges: int,
    speed: float,
    kills: int,
    away_s: float,
    seed: int,
    method: str = "least-squares",
    processes: int = 1,
) -> DayOutcome:
    """Drive, kill, wait until all is published, and compare."""
    felt = drives()
    plans = {
        name: write_drive(folder / f"{name}.mcap", name, felt, rounds, bridges) for name in TRUCKS
    }
    wanted = sum(len(plan.crossings) for plan in plans.values())
    moments = random.Random(seed)
    # The results are looked at while they are written.
    log = logging.getLogger(read_messages.__module__)
    earlier_output = log.level
    log.setLevel(logging.ERROR)
    fleet = Fleet(folder, method=method, processes=processes)
    began = time.monotonic()
    longest_backlog = 0
    try:
        logger = fleet.start_logger()
        worker = fleet.start_worker()
        view = fleet.start_view()
        trucks = [fleet.start_truck(plan, speed) for plan in plans.values()]
        drive_s = max(plan.seconds for plan in plans.values()) / speed
        events = sorted(moments.uniform(0.05, 0.95) * drive_s for _ in range(kills))
        aways = {events[len(events) // 2]: away_s / speed} if away_s and events else {}
        view_at_s = moments.uniform(0.0, events[0] if events else 0.95 * drive_s)
        drove = time.monotonic()
        for at_s in sorted([view_at_s, *events]):
            time.sleep(max(0.0, drove + at_s - time.monotonic()))
            if at_s == view_at_s:
                view.kill()
                view = fleet.start_view()
                continue
            worker.kill()
            worker.wait()
            time.sleep(aways.get(at_s, 0.0))
            worker = fleet.start_worker()
        for truck in trucks:
            assert truck.wait(drive_s + LONGEST_S) == 0, fleet.logs()
        deadline = time.monotonic() + LONGEST_S
        count = -1
        while (now := len(fleet.results())) < wanted and time.monotonic() < deadline:
            if now > count:  # what is waited for is progress, however slow
                deadline, count = time.monotonic() + LONGEST_S, now
                longest_backlog = max(longest_backlog, wanted - now)
            assert worker.poll() is None, fleet.logs()
            time.sleep(0.5)
        seconds = time.monotonic() - began
        deadline = time.monotonic() + LONGEST_S
        picture = view.picture()
        while problems_of_view(picture, plans) and time.monotonic() < deadline:
            assert view.process.poll() is None, fleet.logs()
            assert view.viewer.poll() is None, fleet.logs()
            time.sleep(0.5)
            picture = view.picture()
        view.process.send_signal(signal.SIGTERM)
        assert view.process.wait(LONGEST_S) == 0, fleet.logs()
        worker.send_signal(signal.SIGTERM)
        assert worker.wait(LONGEST_S) == 0, fleet.logs()
        logger.send_signal(signal.SIGTERM)
        assert logger.wait(LONGEST_S) == 0, fleet.logs()
        results = fleet.results()
    finally:
        fleet.close()
        log.setLevel(earlier_output)
    problems = problems_of(plans, results) + problems_of_view(picture, plans)
    if problems:
        problems.append(fleet.logs())
    shown, to_show = picture.verdicts.total(), driven_in(picture, plans).total()
    counts = (wanted, len(results), shown, to_show, kills)
    return DayOutcome(*counts, seconds, longest_backlog, problems)


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, default=60.0, help="of driving")
    parser.add_argument("--speed", type=float, default=4.0, help="times real speed")
    parser.add_argument("--kills", type=int, default=5)
    parser.add_argument("--away", type=float, default=600.0, help="seconds of the drive")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--method", default="least-squares")
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--folder", type=Path, help="kept; else what is left is thrown away")
    options = parser.parse_args(arguments)
    round_s = float(way(1, _ON_THE_ROAD)[0][-1, 0])
    folder = options.folder or Path(tempfile.mkdtemp(prefix="driveby-day-"))
    folder.mkdir(parents=True, exist_ok=True)
    try:
        outcome = live(
            folder,
            rounds=max(1, round(60.0 * options.minutes / round_s)),
            bridges=_ON_THE_ROAD,
            speed=options.speed,
            kills=options.kills,
            away_s=options.away,
            seed=options.seed,
            method=options.method,
            processes=options.processes,
        )
    finally:
        if options.folder is None:
            shutil.rmtree(folder)
    print(
        f"{outcome.crossings} crossings, {outcome.results} results; of {outcome.to_show} on the "
        f"bridges that it draws the live view shows {outcome.shown}; {outcome.kills} kills of the "
        f"worker, one of the view, {outcome.seconds:.0f} s; {outcome.longest_backlog} were left "
        "when the trucks had arrived"
    )
    for problem in outcome.problems:
        print(problem)
    return 1 if outcome.problems else 0


if __name__ == "__main__":
    sys.exit(main())
