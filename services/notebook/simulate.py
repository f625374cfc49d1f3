"""A simulated crossing in memory, with its truth: what `driveby simulate` writes."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from schemas.site import Site
from services.common.errors import InputError
from services.drives.runs import run_to_messages
from services.drives.signals import Signals, signals_of_run
from services.execution.blas import one_blas_thread
from services.identification.placed import middle_site
from services.notebook.read import Name, given_site
from services.recordings.recording import Message
from services.simulation.drive import (
    Drive,
    declared,
    paper_site,
    ratios_of,
    simulate_drive,
    write_drive,
)

_REALM = "sim-drive"
_SCENARIOS = range(1, 13)


class Simulation(NamedTuple):
    """A simulated crossing and the truth behind it."""

    drive: Drive
    """What was measured, the road as the tyres felt it, and the true ratios of EI to nominal."""
    site: Site
    """As the owner of this truck would declare it, with the noise of its sensors."""

    @property
    def signals(self) -> Signals:
        """What the truck measured, as `read` gives it."""
        return signals_of_run(self.drive.run, self.site.vehicles[0].id)

    @property
    def ei_ratios(self) -> NDArray[np.float64]:
        """True EI of each element over its nominal value."""
        return self.drive.rigidity_ratios

    @property
    def road_m(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """The true road as the tyres felt it: chainage and height."""
        return self.drive.road.x_m, self.drive.road.height_m

    def messages(self) -> Iterator[Message]:
        """What the truck would have sent."""
        return run_to_messages([self.drive.run], self.site, _REALM, self.site.vehicles[0].id)

    def write(self, path: str | Path, *, force: bool = False) -> None:
        """Write the recording (.mcap) that the truck would have made.

        InputError if there is a recording, which only `force` replaces, or it cannot be written.
        """
        write_drive(Path(path), self.drive, self.site, force=force)


def simulate(
    *,
    scenario: int | None = None,
    ei: Sequence[float] | None = None,
    site: Name | Site | None = None,
    road: str = "A",
    seed: int = 1,
    noise: float = 0.0,
    speed: float | tuple[float, float] = 10.0,
    direction: str = "start_to_end",
    gps_noise: bool = False,
    rate: float | None = None,
) -> Simulation:
    """Drive the site's first truck over its first bridge; the options are `driveby simulate`'s.

    The truth is a damage `scenario` of the paper (1 to 12) or `ei`, the ratio of each element's EI
    to its nominal value. `site` is by default that of the paper. `road` is an ISO 8608 class, A to
    E; `noise` the accelerometers' noise density in µg/√Hz; `speed` in m/s, or a pair (start, end);
    `rate` in Hz is by default the site's. BLAS is limited to one thread meanwhile.

    InputError, in one line, for what cannot be; FailureError if the simulation does not settle.
    """
    if (scenario is None) == (ei is None):
        raise InputError("give either scenario= or ei=")
    if scenario is not None and scenario not in _SCENARIOS:
        raise InputError(f"scenario is {scenario}, it must be 1 to 12")
    if road not in tuple("ABCDE"):
        raise InputError(f'road is "{road}", it must be a class from A to E')
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
            road_class=road,
            seed=seed,
            noise_ug_per_rthz=noise,
            speed_m_per_s=(begin, end),
            forward=direction == "start_to_end",
            receiver_errors=gps_noise,
            rate_hz=rate,
        )
    return Simulation(drive, declared(known, noise, drive.run.rate_hz))
