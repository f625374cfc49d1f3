"""Simulation of a crossing in memory, with its truth, as by `driveby simulate`."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from schemas.site import Site
from schemas.topics import Message
from services.common.errors import InputError
from services.drives.runs import run_to_messages
from services.drives.signals import Signals, signals_of_run
from services.execution.blas import one_blas_thread
from services.finding.placed import middle_site
from services.notebook.read import Name, given_site
from services.simulation.drive import (
    DrivenRoad,
    Measurement,
    OutOfModelEffects,
    SimulatedDrive,
    declared_site,
    given_road,
    paper_site,
    ratios_of,
    simulate_drive,
    write_drive,
)
from services.simulation.lane import twist_of

_REALM = "sim-drive"
_SCENARIOS = range(1, 13)


class Simulation(NamedTuple):
    """A simulated crossing and the truth behind it."""

    drive: SimulatedDrive
    """Measurements, profile under the tyres, and the true ratios of EI to nominal."""
    site: Site
    """Site as the owner of this truck would declare it, with the noise of its sensors."""

    def __repr__(self) -> str:
        """Return one line."""
        vehicle, bridge, run = self.site.vehicles[0].id, self.site.bridges[0].id, self.drive.run
        ratios = " ".join(f"{ratio:.2f}" for ratio in self.ei_ratios)
        seconds = float(run.accel_time_s[-1] - run.accel_time_s[0])
        return (
            f"<Simulation {vehicle} over {bridge}: {seconds:.1f} s at {run.rate_hz:g} Hz, "
            f"EI of nominal {ratios}>"
        )

    @property
    def signals(self) -> Signals:
        """Measurements of the truck, in the form of `read`."""
        return signals_of_run(self.drive.run, self.site.vehicles[0].id)

    @property
    def ei_ratios(self) -> NDArray[np.float64]:
        """True EI of each element over its nominal value, (n,)."""
        return self.drive.rigidity_ratios

    @property
    def road_m(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """True profile under the tyres: chainage and height (m,), both in m."""
        return self.drive.road.x_m, self.drive.road.height_m

    def messages(self) -> Iterator[Message]:
        """Return the messages that the truck would have sent."""
        return run_to_messages([self.drive.run], self.site, _REALM, self.site.vehicles[0].id)

    def write(self, path: str | Path, *, force: bool = False) -> None:
        """Write the recording (.mcap) that the truck would have made.

        Raise InputError if there is a recording, which only `force` replaces, or if it cannot be
        written.
        """
        write_drive(Path(path), self.drive, self.site, force=force)


def simulate(
    *,
    scenario: int | None = None,
    ei: Sequence[float] | None = None,
    site: Name | Site | None = None,
    road: str | tuple[ArrayLike, ArrayLike] = "A",
    seed: int = 1,
    noise: float = 0.0,
    speed: float | tuple[float, float] = 10.0,
    direction: str = "start_to_end",
    gps_noise: bool = False,
    rate: float | None = None,
) -> Simulation:
    """Simulate a crossing of the site's first bridge by its first truck.

    The options are those of `driveby simulate`. The truth is a damage `scenario` of the paper (1 to
    12) or `ei`, the ratio of each element's EI to its nominal value. `site` is by default that of
    the paper. `road` is an ISO 8608 class, A to E, or a profile under both axles: chainages and
    heights (n,) in m, level beyond its ends; `noise` the accelerometers' noise density in
    µg/√Hz; `speed` in m/s, or a pair (start, end); `rate` in Hz is by default the site's. BLAS is
    limited to one thread meanwhile.

    Raise InputError, in one line, for an impossible value, FailureError if the simulation does not
    converge.
    """
    if (scenario is None) == (ei is None):
        raise InputError("give either scenario= or ei=")
    if scenario is not None and scenario not in _SCENARIOS:
        raise InputError(f"scenario is {scenario}, it must be 1 to 12")
    if direction not in ("start_to_end", "end_to_start"):
        raise InputError(f'direction is "{direction}", start_to_end or end_to_start expected')
    begin, end = speed if isinstance(speed, tuple) else (speed, speed)
    for what, value, low, high in (
        ("seed", seed, 0, (1 << 63) - 1),
        ("noise", noise, 0, 1e6),
        ("speed", begin, 0.1, 60),
        ("speed", end, 0.1, 60),
        ("rate", 1000.0 if rate is None else rate, 50, 50_000),
        *(("ei", ratio, 1e-3, 1e3) for ratio in ei or ()),
    ):
        if not low <= value <= high:
            raise InputError(f"{what} is {value:g}, it must be from {low:g} to {high:g}")
    known = paper_site() if site is None else middle_site(given_site(site))
    with one_blas_thread():
        drive = simulate_drive(
            known,
            ratios_of(known.bridges[0], scenario, ei),
            DrivenRoad(given_road(road), seed),
            Measurement(noise, rate_hz=rate, has_receiver_errors=gps_noise),
            speed_m_per_s=(begin, end),
            forward=direction == "start_to_end",
            beyond=OutOfModelEffects(twist=twist_of(known.bridges[0])),
        )
    return Simulation(drive, declared_site(known, noise, drive.run.rate_hz))
