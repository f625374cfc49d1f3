"""Simulation of a crossing in memory, with its truth, as by `driveby simulate`."""

import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from schemas.site import Site
from schemas.topics import Message
from services.common.errors import InputError
from services.common.field_docs import with_field_docs
from services.drives.runs import run_to_messages
from services.drives.signals import Signals, signals_of_run
from services.execution.blas import one_blas_thread
from services.finding.placed import middle_site
from services.identification.identify import SLOWEST_M_PER_S
from services.notebook.arguments import (
    file_of,
    known_arguments,
    naming_force,
    number,
    numbers,
    one_or_two,
    whole,
    wrong,
)
from services.notebook.read import Name, given_site
from services.simulation.drive import (
    DrivenRoad,
    Measurement,
    OutOfModelEffects,
    SimulatedDrive,
    declared_site,
    given_road,
    noise_density_of,
    paper_site,
    ratios_of,
    road_class_of,
    simulate_drive,
    write_drive,
)
from services.simulation.lane import twist_of
from services.simulation.recorded_road import SURVEY_ROAD_M
from services.simulation.schedule import begun_at, schedule_of

_REALM: Final = "sim-drive"
_SCENARIOS: Final = 12
_TOO_SLOW: Final = (
    f"speed is {{:g}} m/s on average: identify() rejects crossings below {SLOWEST_M_PER_S:g} m/s"
)
_RATIOS: Final = "a ratio for each element, such as [1, 1, 0.4]"
_LARGEST_RATIO: Final = 10.0
"""EI over nominal above which per cent are likely."""
_FASTEST_M_PER_S: Final = 30.0
"""Speed above which km/h are likely."""
_NO_TRUTH: Final = (
    "give either scenario= or ei=, such as scenario=6 or ei=[1, 1, 1, 0.4, 1, 1, 1], a ratio for "
    "each element"
)


@with_field_docs
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
            f"EI / nominal {ratios}>"
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
        """True profile under the tyres: chainage and height (m,), both in m.

        It covers the truck's way, which is mirrored for a drive from end to start: at 10 m/s from
        66 m before the bridge to 35 m beyond it. It is the mean of the given road over a tyre's
        contact length, so its short waves are lower.
        """
        return self.drive.road.x_m, self.drive.road.height_m

    def messages(self) -> Iterator[Message]:
        """Return the messages that the truck would have sent."""
        return run_to_messages([self.drive.run], self.site, _REALM, self.site.vehicles[0].id)

    def started_at(self, start: str) -> "Simulation":
        """Return the same drive with another start, ISO 8601 with a zone; InputError otherwise.

        A crossing's identifier contains its time: crossings to be fused must differ in it.
        """
        if not isinstance(start, str):
            raise wrong("start", start, "a time as 2026-05-01T09:30:00Z")
        begin_s = schedule_of(1, 1, start, name="start").begin_s(0)
        return self._replace(drive=self.drive._replace(run=begun_at(self.drive.run, begin_s)))

    def write(self, path: str | Path, *, force: bool = False) -> None:
        """Write the recording (.mcap) that the truck would have made.

        Raise InputError if there is a recording, which only `force` replaces, or if it cannot be
        written.
        """
        with naming_force():
            write_drive(file_of(path), self.drive, self.site, force=force)


def check_truth(truth: Simulation | None) -> None:
    """Raise InputError if the argument `truth` of a plot is neither None nor a simulation."""
    if truth is not None and not isinstance(truth, Simulation):
        raise wrong("truth", truth, "what simulate() returns")


@known_arguments(
    "; simulate_recording() has every option of driveby simulate, and Simulation.started_at() sets "
    "the start"
)
def simulate(
    *,
    scenario: int | None = None,
    ei: "ArrayLike | None" = None,
    site: Name | Site | None = None,
    road: "str | tuple[ArrayLike, ArrayLike] | None" = None,
    seed: int = 1,
    noise: float | None = None,
    speed: "ArrayLike" = 10.0,
    direction: str = "start_to_end",
    gps_noise: bool = False,
    rate: float | None = None,
) -> Simulation:
    """Simulate a crossing of the site's first bridge by its first truck.

    `simulate_recording` has every option of `driveby simulate`. The truth is a damage `scenario` of
    the paper (1 to 12) or `ei` (n,), the ratio of each element's EI to its nominal value. `site` is
    by default that of the paper. `road` is an ISO 8608 class, A to E (by default the site's, or A),
    or a profile under both axles: chainages from the start of the bridge and heights (n,) in m,
    level beyond its ends; `seed` draws road, noise and receiver errors. `noise` is the
    accelerometers' noise density in µg/√Hz, by default that of a given site, else 0; method pre
    needs some. `speed` is in m/s, or a pair (start, end); below 3 m/s, where identification rejects
    a crossing, it brings a warning, as do values that are likely of another unit. `rate` in Hz is
    by default the site's. BLAS is limited to one thread meanwhile.

    All drives begin at one time; crossings to be fused need others: `Simulation.started_at`.

    Raise InputError, in one line, for an impossible value, FailureError if the simulation does not
    converge.
    """
    if (scenario is None) == (ei is None):
        raise InputError(_NO_TRUTH)
    number_of = None if scenario is None else whole("scenario", scenario, 1, _SCENARIOS)
    ratios = None if ei is None else numbers("ei", ei, 1e-3, 1e3, _RATIOS)
    speeds = one_or_two("speed", speed, 0.1, 60, "(start, end)")
    if sum(speeds) / 2.0 < SLOWEST_M_PER_S:
        warnings.warn(_TOO_SLOW.format(sum(speeds) / 2.0), stacklevel=3)
    known = paper_site() if site is None else middle_site(given_site(site))
    asked = None if noise is None else number("noise", noise, 0, 1e6)
    density = noise_density_of(None if site is None else known, asked)
    kind = road_class_of(known, None) if road is None else given_road(road)
    driven = DrivenRoad(kind, whole("seed", seed, 0, (1 << 63) - 1))
    for line in _doubts(ratios, max(speeds), driven):
        warnings.warn(line, stacklevel=3)
    with one_blas_thread():
        drive = simulate_drive(
            known,
            ratios_of(known.bridges[0], number_of, ratios, prefix=""),
            driven,
            Measurement(
                density,
                rate_hz=None if rate is None else number("rate", rate, 50, 50_000),
                has_receiver_errors=gps_noise,
                least_road_m=(0.0, 0.0) if site is None else SURVEY_ROAD_M,
            ),
            speed_m_per_s=speeds,
            forward=_is_forward(direction),
            effects=OutOfModelEffects(twist=twist_of(known.bridges[0])),
        )
    return Simulation(drive, declared_site(known, density, drive.run.rate_hz))


def _is_forward(direction: str) -> bool:
    """Return whether a direction is from the start to the end; raise InputError for another."""
    if direction not in ("start_to_end", "end_to_start"):
        raise InputError(f'direction is "{direction}", start_to_end or end_to_start expected')
    return direction == "start_to_end"


def _doubts(
    ratios: Sequence[float] | None, speed_m_per_s: float, driven: DrivenRoad
) -> Iterator[str]:
    """Yield a sentence for each value that is likely of another unit."""
    if ratios is not None and max(ratios) > _LARGEST_RATIO:
        yield f"ei is up to {max(ratios):g} times nominal: is it in per cent? Ratios are expected"
    if speed_m_per_s > _FASTEST_M_PER_S:
        yield (
            f"speed is {speed_m_per_s:g} m/s, {3.6 * speed_m_per_s:.0f} km/h: is it in km/h? "
            "m/s are expected"
        )
    road = driven.kind
    if not isinstance(road, str):
        slope = float(np.sqrt(np.mean((np.diff(road.height_m) / np.diff(road.x_m)) ** 2)))
        if slope > 1.0:
            yield f"road has an rms slope of {slope:.2g}: are its heights in mm? m are expected"
