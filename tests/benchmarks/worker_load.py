"""A worker under load: twenty trucks at real speed over a hundred bridges, on one bus.

    python -m tests.benchmarks.worker_load [--seconds 180] [--trucks 20] [--processes 1 2]

Every truck has a road of its own with five bridges, one every 14 s: 84 crossings a minute, far
more than two cores identify. Logger and worker are processes of the command `driveby`, all trucks
are this one. Printed is how long a message waits at most before the worker looks at it, how many
crossings it identifies in a minute by method `pre` while the trucks drive, and what is left for
later.
"""

import argparse
import os
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pre_core.paper.experiment import scenario_ratios
from schemas.proto import driveby_pb2 as pb
from schemas.signals import CHANNELS, Identity
from schemas.site import Site
from schemas.site_file import site_toml
from schemas.topics import Key, Message, selector
from services.bus.publisher import Publisher
from services.bus.session import open_session
from services.bus.subscription import Subscription
from services.common.geodesy import bridge_frame, to_lat_lon
from services.drives.runs import GnssTrack, Run, run_to_messages
from services.simulation.drive import (
    DrivenRoad,
    Measurement,
    declared_site,
    paper_site,
    simulate_drive,
)
from tests.faults.day import APART_M, Fleet, place
from tests.waiting import LONGEST_S

REALM = "sim-day"
BRIDGES_OF_ONE = 5
SPEED_M_PER_S = 14.0
"""So fast that the road that is looked at before a bridge was simulated, too."""
_NOISE = 25.0
_BESIDE_M = 1000.0
_LEAD_M = 120.0


class Load(NamedTuple):
    """What came of it."""

    crossings: int
    """That the trucks have driven."""
    results: int
    per_minute: float
    longest_lag_s: float
    """That a message waited for the worker to look at it."""
    latest_s: float
    """That a message was published after its time: then the trucks were too slow."""
    left: int
    """Crossings that wait at the end, in the worker or in recordings."""


def site_of(trucks: int) -> Site:
    """Five bridges for each truck, on its own road."""
    bridges = [
        place(f"b{truck}-{n}", n * APART_M, truck * _BESIDE_M, 100.0, turned=False)
        for truck in range(trucks)
        for n in range(BRIDGES_OF_ONE)
    ]
    one = paper_site().vehicles[0]
    vehicles = [one.model_copy(update={"id": f"truck-{truck}"}) for truck in range(trucks)]
    site = paper_site().model_copy(update={"vehicles": tuple(vehicles), "bridges": tuple(bridges)})
    return declared_site(site, _NOISE, max(site.sensor.rate_hz))


def drive_of(truck: int, site: Site, seconds: float) -> list[Message]:
    """To the fifth bridge, back by another road, and over the first one again, for so long."""
    felt = simulate_drive(
        paper_site(),
        scenario_ratios(6),
        DrivenRoad("A", 1),
        Measurement(_NOISE),
        speed_m_per_s=(SPEED_M_PER_S, SPEED_M_PER_S),
    ).run
    way_s = (BRIDGES_OF_ONE * APART_M) / SPEED_M_PER_S
    rate = felt.rate_hz
    time_s = np.arange(round(seconds * rate)) / rate
    rng = np.random.default_rng(truck)
    channels = {name: 0.02 * rng.standard_normal(time_s.size) for name in CHANNELS}
    for begin_s in (
        np.arange(_LEAD_M - 3.0 * SPEED_M_PER_S, seconds * SPEED_M_PER_S, APART_M) / SPEED_M_PER_S
    ):
        first = round(begin_s * rate)
        for name, values in felt.channels.items():
            part = channels[name][first : first + values.size]
            part[:] = values[: part.size]
    fixes = np.arange(round(10.0 * seconds)) / 10.0
    along = (fixes % way_s) * SPEED_M_PER_S - _LEAD_M
    latitude, longitude = to_lat_lon(
        bridge_frame(paper_site().bridges[0]),
        along + 0.4 * rng.standard_normal(fixes.size),
        truck * _BESIDE_M + 0.4 * rng.standard_normal(fixes.size),
    )
    # From the end to the beginning it is carried in no time, which is no way over the bridges.
    speed, height = np.full(fixes.size, SPEED_M_PER_S), np.full(fixes.size, 100.0)
    start_s = time.time()
    gnss = GnssTrack(start_s + fixes, latitude, longitude, height, speed, None)
    run = Run("load", start_s + time_s, rate, channels, gnss)
    return list(run_to_messages([run], site, REALM, f"truck-{truck}"))


def together(drives: list[list[Message]]) -> Iterator[tuple[float, Message]]:
    """All trucks' messages and when each is due, one truck a second after the other."""
    timed = [
        ((m.publish_time_ns - drive[0].publish_time_ns) * 1e-9 + truck, m)
        for truck, drive in enumerate(drives)
        for m in drive
        if m.key.stream != "location"
    ]
    yield from sorted(timed, key=lambda one: one[0])


def measure(folder: Path, *, trucks: int, seconds: float, processes: int) -> Load:
    """Drive, and listen to what the worker says."""
    fleet = Fleet(folder, method="pre", processes=processes)
    site = site_of(trucks)
    fleet.site.write_text(site_toml(site))
    drives = [drive_of(truck, site, seconds) for truck in range(trucks)]
    outcome: dict[str, float] = {}
    lags, left = [0.0], 0.0
    latest_s = 0.0
    try:
        fleet.start_logger()
        worker = fleet.start_worker()
        with (
            open_session(connect=fleet.endpoint, timeout_s=LONGEST_S) as bus,
            Subscription(bus, selector(REALM, "bridge", "estimate")) as estimates,
            Subscription(bus, selector(REALM, "service", "health")) as healths,
        ):
            while healths.receive(0.5) is None:  # until it listens
                assert worker.poll() is None, fleet.logs()
            publisher = Publisher(bus, REALM)
            began = time.monotonic()
            listened = 0.0
            for due_s, message in together(drives):
                wait_s = began + due_s - time.monotonic()
                latest_s = max(latest_s, -wait_s)
                time.sleep(max(0.0, wait_s))
                key: Key = message.key
                identity = Identity(message.boot_id, message.sequence)
                publisher.put("vehicle", key.identifier, key.stream, message.payload, identity)
                if time.monotonic() < listened:
                    continue
                listened = time.monotonic() + 0.2
                while (one := estimates.receive()) is not None:
                    name = pb.Estimate.FromString(one.payload).crossing_id
                    outcome.setdefault(name, time.monotonic() - began)
                while (one := healths.receive()) is not None:
                    health = pb.Health.FromString(one.payload)
                    if health.service != "worker":
                        continue
                    lags.append(health.figures["lag_s"])
                    left = sum(v for k, v in health.figures.items() if k.startswith("waiting"))
            publisher.close()
    finally:
        fleet.close()
    times = sorted(outcome.values())
    span_s = times[-1] - times[0] if len(times) > 1 else 0.0
    driven = trucks * int((seconds * SPEED_M_PER_S - _LEAD_M - 65.0) / APART_M + 1)
    rate = 60.0 * (len(times) - 1) / span_s if span_s else 0.0
    return Load(driven, len(times), rate, max(lags), latest_s, round(left))


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=180.0)
    parser.add_argument("--trucks", type=int, default=20)
    parser.add_argument("--processes", type=int, nargs="+", default=[1, 2])
    options = parser.parse_args(arguments)
    for processes in options.processes:
        with tempfile.TemporaryDirectory(prefix="driveby-load-") as folder:
            load = measure(
                Path(folder),
                trucks=options.trucks,
                seconds=options.seconds,
                processes=processes,
            )
        print(
            f"{options.trucks} trucks, {BRIDGES_OF_ONE * options.trucks} bridges, "
            f"{processes} processes, load average {os.getloadavg()[0]:.1f}: "
            f"{load.crossings} crossings driven, {load.results} identified, "
            f"{load.per_minute:.1f} a minute; a message waited {load.longest_lag_s:.2f} s at most "
            f"(published {load.latest_s:.2f} s late at most); {load.left} crossings wait"
        )


if __name__ == "__main__":
    main()
