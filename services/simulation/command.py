"""The recording that `driveby simulate` asks for: its truth, drives and effects.

A truck of two axles is simulated in the plane (`drive`), one with a tandem with two sides
(`drive_tandem`).
"""

from typing import TYPE_CHECKING, Final

from schemas.site import Site
from schemas.site_file import load_site
from services.common.errors import InputError
from services.common.files import check_writable
from services.common.options import option_of
from services.common.progress import steps_bar
from services.finding.placed import middle_site
from services.simulation.drive import (
    DepartedVehicle,
    DrivenRoad,
    Measurement,
    OutOfModelEffects,
    declared_site,
    densities_of,
    noise_density_of,
    paper_site,
    ratios_of,
    road_class_of,
    road_note,
    simulate_drive,
    write_drives,
)
from services.simulation.drive_tandem import TandemDrive, simulate_tandem
from services.simulation.lane import driven_lane, twist_of
from services.simulation.pair import with_pair_first
from services.simulation.pavement import Pavement
from services.simulation.recorded_road import SURVEY_ROAD_M
from services.simulation.schedule import Schedule, schedule_of
from services.simulation.settings import SimulateOptions
from services.simulation.usual_trucks import usual_four_axles, usual_tandem
from services.simulation.wheel_paths import SurfaceOptions, wheel_paths_of

if TYPE_CHECKING:
    from rich.console import Console

_OF_PAVEMENT: Final = ("deck_roughness", "joints", "anisotropy")
_OF_SURFACE: Final = ("tyres", "rear_offset", "wander", *_OF_PAVEMENT)
_TIPPERS: Final = {3: usual_tandem, 4: usual_four_axles}
_NOT_OF_TANDEM: Final = (
    "bearing_stiffness", "departed_vehicle", "bilinear", "air_springs", *_OF_PAVEMENT,
)  # fmt: skip


def simulate_command(asked: SimulateOptions, console: "Console") -> int:
    """Write the recording of one simulated crossing, or of several over the same road.

    InputError: a bad site file, options that exclude each other, or a file that is not writable.
    """
    known = paper_site() if asked.site is None else load_site(asked.site)
    known = with_pair_first(known, asked.vehicle, asked.bridge)
    tandem = _with_tandem(asked, known)
    if tandem is not None:
        return _simulate_tandem(asked, tandem, console)
    surface, schedule = surface_of(asked), schedule_of(asked.runs, asked.days, asked.start)
    check_writable(asked.output, force=asked.force)
    plane = known if asked.site is None else middle_site(known)
    return _simulate_plane(asked, plane, surface, schedule, console)


def _simulate_plane(
    asked: SimulateOptions,
    known: Site,
    surface: SurfaceOptions | None,
    schedule: Schedule,
    console: "Console",
) -> int:
    ratios = ratios_of(known.bridges[0], asked.scenario, asked.ei)
    noise = noise_density_of(None if asked.site is None else known, asked.noise)
    twist = twist_of(known.bridges[0], asked.lane_offset, asked.torsion)
    effects = effects_of(asked)._replace(twist=twist)
    paths = None if surface is None else wheel_paths_of(known.vehicles[0], surface)
    of_noise = asked.seed if asked.drive_seed is None else asked.drive_seed
    road_class, drives = road_class_of(known, asked.road), []
    with steps_bar("simulating", console) as progress:
        for number in range(schedule.drives):
            progress(number, schedule.drives)
            drive = simulate_drive(
                known,
                ratios,
                DrivenRoad(road_class, asked.seed, paths),
                Measurement(
                    noise,
                    rate_hz=asked.rate,
                    has_receiver_errors=asked.gps_noise,
                    seed=(of_noise, number) if number else of_noise,
                    least_road_m=(0.0, 0.0) if asked.site is None else SURVEY_ROAD_M,
                ),
                speed_m_per_s=asked.speed,
                forward=asked.direction == "start_to_end",
                effects=effects,
            )
            drives.append(drive)
        site = declared_site(known, noise, drives[0].run.rate_hz)
        messages = write_drives(asked.output, drives, site, force=asked.force, schedule=schedule)
    times = drives[0].run.accel_time_s
    console.print(
        f"{asked.output}: {schedule.in_words(times[-1] - times[0])}, {messages} messages"
        f"{road_note(known, road_class)}"
    )
    return 0


def effects_of(asked: SimulateOptions) -> OutOfModelEffects:
    """Return the effects that the site file does not declare, without the twist of the deck."""
    stiffness, departed = asked.bearing_stiffness, asked.departed_vehicle
    return OutOfModelEffects(
        asked.support_springs,
        (1.0 / stiffness[0], 1.0 / stiffness[1]) if stiffness else (0.0, 0.0),
        DepartedVehicle(*departed) if departed else None,
        asked.friction,
        asked.friction_growth,
        asked.bilinear,
        asked.air_springs,
    )


def surface_of(asked: SimulateOptions) -> SurfaceOptions | None:
    """Return the 2-D surface of the road; InputError for an option of it without it."""
    if asked.road_surface:
        pavement = Pavement(
            asked.deck_roughness or 1.0, 1e-3 * (asked.joints or 0.0), asked.anisotropy or 1.0
        )
        return SurfaceOptions(asked.tyres, asked.rear_offset, asked.wander or 0.0, pavement)
    for name in _OF_SURFACE:
        if getattr(asked, name) is not None:
            raise InputError(f"{option_of(name)}: has no effect without --road-surface")
    return None


def _with_tandem(asked: SimulateOptions, site: Site) -> Site | None:
    """Return the site whose truck has a tandem, by itself or by `--axles`; None for two axles."""
    truck = site.vehicles[0]
    if truck.tandem is not None:
        if asked.axles not in (None, len(truck.axles)):
            raise InputError(
                f"--axles: is {asked.axles}, but {truck.id} has {len(truck.axles)} axles"
            )
        if asked.tyres:
            raise InputError(
                "--tyres: the site file declares the tyres of each axle, leave the option out"
            )
        return site
    if asked.axles not in _TIPPERS:
        return None
    noise = noise_density_of(None if asked.site is None else site, asked.noise)
    tipper = _TIPPERS[asked.axles](max(densities_of(noise)), asked.tyres or "twin")
    rate = max(site.sensor.rate_hz)
    sensors = tuple(one.model_copy(update={"rate_hz": rate}) for one in tipper.sensors)
    tipper = tipper.model_copy(update={"sensors": sensors})
    return site.model_copy(update={"vehicles": (tipper,), "ros2": ()})


def _simulate_tandem(asked: SimulateOptions, site: Site, console: "Console") -> int:
    for name in _NOT_OF_TANDEM:
        if getattr(asked, name):
            raise InputError(f"{option_of(name)}: is not simulated for a truck with a tandem")
    begin, end = asked.speed
    if begin != end:
        raise InputError("--speed: is START:END, it must be one speed for a truck with a tandem")
    check_writable(asked.output, force=asked.force)
    lane_m, torsion = driven_lane(site.bridges[0], asked.lane_offset, asked.torsion)
    how = TandemDrive(
        (road_class_of(site, asked.road), asked.seed),
        asked.noise,
        begin,
        asked.direction == "start_to_end",
        asked.gps_noise,
        asked.rate,
        asked.friction,
        asked.support_springs,
        lane_m,
        torsion,
        surface_of(asked),
        schedule_of(asked.runs, asked.days, asked.start),
        asked.seed if asked.drive_seed is None else asked.drive_seed,
    )
    if asked.site is not None:
        how = how._replace(least_before_m=SURVEY_ROAD_M[0])
    ratios = ratios_of(site.bridges[0], asked.scenario, asked.ei)
    return simulate_tandem(site, ratios, how, asked.output, force=asked.force, console=console)
