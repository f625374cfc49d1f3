"""The command `driveby simulate`: crossings with a known truth and out-of-model effects."""

import argparse
from typing import TYPE_CHECKING, Any

from services.cli.parsing import (
    a_console,
    add_noise,
    add_output,
    add_seed,
    add_site,
    command,
    option_of,
    scenario,
)
from services.common.errors import InputError
from services.common.options import number, numbers, whole

if TYPE_CHECKING:
    from schemas.site import Site


def _ratios(text: str) -> tuple[float, ...]:
    ratio = number("ratios", low=1e-3, high=1e3)
    return tuple(ratio(part) for part in text.split(","))


def _speed_range(text: str) -> tuple[float, float]:
    speed = number("a speed in m/s (or START:END)", low=0.1, high=60)
    start, _, end = text.partition(":")
    return speed(start), speed(end if ":" in text else start)


def add_simulate(commands: Any) -> None:
    """Add `driveby simulate`: write the recording of a simulated crossing."""
    p = command(
        commands,
        "simulate",
        _simulate,
        "write the recording of a simulated crossing",
        "driveby simulate --scenario 6 --noise 25 -o run.mcap",
    )
    damage = p.add_mutually_exclusive_group(required=True)
    damage.add_argument(
        "--scenario", type=scenario, metavar="N", help="damage scenario of the paper, 1 to 12"
    )
    damage.add_argument(
        "--ei",
        type=_ratios,
        metavar="1,1,.4,…",
        help="flexural rigidity of each element over its undamaged value",
    )
    add_site(p, "truck and bridge (default: those of the paper)")
    _add_axles(p)
    p.add_argument(
        "--road", choices=tuple("ABCDE"), default="A", help="ISO 8608 class (default: A)"
    )
    add_seed(p)
    add_noise(p, "accelerometers' noise density in µg/√Hz (default: 0)")
    p.add_argument(
        "--speed",
        type=_speed_range,
        default=(10.0, 10.0),
        metavar="M_PER_S",
        help="speed in m/s, or START:END for a constant acceleration (default: 10)",
    )
    p.add_argument(
        "--direction",
        choices=("start_to_end", "end_to_start"),
        default="start_to_end",
        help="direction of travel (default: start_to_end)",
    )
    receiver = p.add_mutually_exclusive_group()
    receiver.add_argument(
        "--gps-noise", action="store_true", help="simulate the errors of a real GNSS receiver"
    )
    receiver.add_argument(
        "--perfect-gps",
        dest="gps_noise",
        action="store_false",
        help="simulate exact positions and speeds (default)",
    )
    p.set_defaults(gps_noise=False)
    p.add_argument(
        "--rate",
        type=number("a rate in Hz", low=50, high=50_000),
        metavar="HZ",
        help="sampling rate (default: the site's, or 1000)",
    )
    _add_schedule(p.add_argument_group("several runs"))
    _add_surface(p.add_argument_group("two-dimensional road surface"))
    _add_beyond(p.add_argument_group("effects that a site file does not declare (default: none)"))
    add_output(p)


def _add_axles(p: Any) -> None:
    p.add_argument(
        "--axles",
        type=int,
        choices=(2, 3),
        help="axles of the truck; 3: a loaded tipper with an equalised tandem, unless the site's "
        "truck has one (default: the site's truck, or 2)",
    )


def _add_schedule(p: Any) -> None:
    p.add_argument(
        "--runs",
        type=whole("a number of runs", 1, 100),
        default=1,
        help="number of runs over the same road, ten minutes apart, in one recording (default: 1)",
    )
    p.add_argument(
        "--days",
        type=whole("a number of days", 1, 1000),
        default=1,
        help="number of days with these runs each, in one recording (default: 1)",
    )
    p.add_argument(
        "--start",
        metavar="TIME",
        help="start of the first run, ISO 8601 with a zone (default: 2026-01-01T00:00:00Z)",
    )


def _add_surface(p: Any) -> None:
    p.add_argument(
        "--drive-seed",
        type=whole("a seed", 0),
        metavar="SEED",
        help="seed of noise and lateral position (default: --seed, which also seeds the road)",
    )
    p.add_argument(
        "--road-surface",
        action="store_true",
        help="simulate a 2-D road surface, so that the axles follow different profiles "
        "(default: one profile for both)",
    )
    p.add_argument(
        "--tyres",
        choices=("single", "twin"),
        help="tyres of the rear axle, on a 2-D surface (default: the site's, or twin)",
    )
    p.add_argument(
        "--rear-offset",
        type=number("an offset in m", low=-1, high=1),
        metavar="M",
        help="lateral offset of the rear from the front axle in m, on a 2-D surface (default: "
        "the site's, or 0.005)",
    )
    p.add_argument(
        "--wander",
        type=number("a standard deviation in m", low=0, high=2),
        metavar="M",
        help="lateral standard deviation between runs in m, on a 2-D surface (default: 0)",
    )
    p.add_argument(
        "--deck-roughness",
        type=number("a factor", low=0.1, high=10),
        metavar="FACTOR",
        help="roughness on the bridge over that off it, on a 2-D surface (default: 1)",
    )
    p.add_argument(
        "--joints",
        type=number("a height in mm", low=0, high=50),
        metavar="MM",
        help="largest height in mm of a dip or step at each end of the bridge, on a 2-D surface "
        "(default: 0)",
    )
    p.add_argument(
        "--anisotropy",
        type=number("a factor", low=0.2, high=20),
        metavar="FACTOR",
        help="lateral correlation length over that of an isotropic surface, on a 2-D surface "
        "(default: 1)",
    )


_OF_PAVEMENT = ("deck_roughness", "joints", "anisotropy")


def _on_surface(options: argparse.Namespace) -> Any:
    from services.simulation.pavement import Pavement
    from services.simulation.wheel_paths import SurfaceOptions

    if options.road_surface:
        pavement = Pavement(
            options.deck_roughness or 1.0,
            1e-3 * (options.joints or 0.0),
            options.anisotropy or 1.0,
        )
        return SurfaceOptions(options.tyres, options.rear_offset, options.wander or 0.0, pavement)
    for name in ("tyres", "rear_offset", "wander", *_OF_PAVEMENT):
        if getattr(options, name) is not None:
            raise InputError(f"{option_of(name)}: only a --road-surface has it")
    return None


def _add_beyond(p: Any) -> None:
    p.add_argument(
        "--support-springs",
        type=numbers("rotational stiffnesses in N·m/rad (START:END)", (0, 1e13), (0, 1e13)),
        default=(0.0, 0.0),
        metavar="START:END",
        help="rotational stiffness of the supports in N·m/rad",
    )
    p.add_argument(
        "--bearing-stiffness",
        type=numbers("vertical stiffnesses in N/m (START:END)", (1e7, 1e15), (1e7, 1e15)),
        metavar="START:END",
        help="vertical stiffness of the bearings in N/m",
    )
    p.add_argument(
        "--departed-vehicle",
        type=numbers(
            "a weight in N, a speed in m/s and seconds before (N:M_PER_S:S)",
            (0, 1e7),
            (0.5, 60),
            (0, 1000),
        ),
        metavar="N:M_PER_S:S",
        help="weight and speed of a vehicle that left S seconds before the truck came",
    )
    p.add_argument(
        "--friction",
        type=number("a share of the springs' load", low=0, high=0.5),
        default=0.0,
        metavar="SHARE",
        help="suspension friction over the static load",
    )
    p.add_argument(
        "--friction-growth",
        type=number("a growth with the load", low=0, high=1),
        default=0.0,
        metavar="SHARE",
        help="share of the friction that grows with the load; 1: proportional",
    )
    p.add_argument(
        "--bilinear",
        type=number("a share", low=0, high=0.9),
        default=0.0,
        metavar="SHARE",
        help="damper asymmetry: stronger in rebound, weaker in compression by this share",
    )
    p.add_argument(
        "--air-springs",
        type=number("a polytropic exponent", low=1, high=2),
        default=0.0,
        metavar="EXPONENT",
        help="polytropic exponent of air springs; 1.38 is usual",
    )
    p.add_argument(
        "--lane-offset",
        type=number("a distance in m", low=-20, high=20),
        metavar="M",
        help="distance of the lane's middle to the left of the bridge's axis, looking from start "
        "to end; with --torsion the deck twists under it (default: the site's, or 0)",
    )
    p.add_argument(
        "--torsion",
        type=numbers(
            "a frequency ratio and a radius of gyration in m (RATIO:M)", (0.2, 100), (0.1, 30)
        ),
        metavar="RATIO:M",
        help="first torsional over first bending frequency of the deck and its radius of "
        "gyration, with a lane offset (2:2.3 is usual; default: the site's, or no twist)",
    )


def _simulate(options: argparse.Namespace) -> int:
    from schemas.site_file import load_site
    from services.simulation.drive import DepartedVehicle, OutOfModelEffects, simulate_command
    from services.simulation.schedule import schedule_of

    stiffness = options.bearing_stiffness
    known = None if options.site is None else load_site(options.site)
    of_tandem = _with_tandem(options, known)
    if of_tandem is not None:
        return _simulate_tandem(options, of_tandem)
    return simulate_command(
        site=options.site,
        scenario=options.scenario,
        ei=options.ei,
        road=options.road,
        seed=options.seed,
        noise=options.noise,
        speed=options.speed,
        direction=options.direction,
        gps_noise=options.gps_noise,
        rate=options.rate,
        beyond=OutOfModelEffects(
            options.support_springs,
            (1.0 / stiffness[0], 1.0 / stiffness[1]) if stiffness else (0.0, 0.0),
            DepartedVehicle(*options.departed_vehicle) if options.departed_vehicle else None,
            options.friction,
            options.friction_growth,
            options.bilinear,
            options.air_springs,
        ),
        lane=(options.lane_offset, options.torsion),
        surface=_on_surface(options),
        schedule=schedule_of(options.runs, options.days, options.start),
        drive_seed=options.drive_seed,
        output=options.output,
        force=options.force,
        console=a_console(),
    )


def _with_tandem(options: argparse.Namespace, known: "Site | None") -> "Site | None":
    """Return the site whose truck has a tandem, by itself or by `--axles`; None for two axles."""
    from services.simulation.drive import paper_site
    from services.simulation.usual_trucks import usual_tandem

    truck = None if known is None else known.vehicles[0]
    if truck is not None and truck.tandem is not None:
        if options.axles == 2:
            raise InputError(f"--axles: is 2, but {truck.id} has 3 axles")
        if options.tyres:
            raise InputError("--tyres: the site file has the tyres of its axles")
        return known
    if options.axles != 3:
        return None
    site = known or paper_site()
    tipper = usual_tandem(options.noise, options.tyres or "twin")
    rate = max(site.sensor.rate_hz)
    sensors = tuple(one.model_copy(update={"rate_hz": rate}) for one in tipper.sensors)
    tipper = tipper.model_copy(update={"sensors": sensors})
    return site.model_copy(update={"vehicles": (tipper,), "ros2": ()})


def _simulate_tandem(options: argparse.Namespace, site: Any) -> int:
    from services.common.files import check_writable
    from services.simulation.drive import ratios_of
    from services.simulation.drive_tandem import TandemDrive, simulate_tandem
    from services.simulation.lane import driven_lane
    from services.simulation.schedule import schedule_of

    names = ("bearing_stiffness", "departed_vehicle", "bilinear", "air_springs")
    for name in (*names, *_OF_PAVEMENT):
        if getattr(options, name):
            raise InputError(f"{option_of(name)}: is not simulated for a truck with a tandem")
    begin, end = options.speed
    if begin != end:
        raise InputError("--speed: is START:END, it must be one speed for a truck with a tandem")
    check_writable(options.output, force=options.force)
    lane_m, torsion = driven_lane(site.bridges[0], options.lane_offset, options.torsion)
    how = TandemDrive(
        (options.road, options.seed),
        options.noise,
        begin,
        options.direction == "start_to_end",
        options.gps_noise,
        options.rate,
        options.friction,
        options.support_springs,
        lane_m,
        torsion,
        _on_surface(options),
        schedule_of(options.runs, options.days, options.start),
        options.seed if options.drive_seed is None else options.drive_seed,
    )
    ratios = ratios_of(site.bridges[0], options.scenario, options.ei)
    return simulate_tandem(
        site, ratios, how, options.output, force=options.force, console=a_console()
    )
