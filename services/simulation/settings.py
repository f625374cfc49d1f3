"""Options of `driveby simulate`."""

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Final

from services.common.options import (
    count_option,
    flag,
    force_option,
    noise_option,
    number,
    numbers,
    opt,
    recording_option,
    scenario,
    seed_option,
    site_option,
    whole,
)

_TRUTH: Final = "truth"
_RECEIVER: Final = "receiver"
_RUNS: Final = "several runs"
_SURFACE: Final = "2-D road surface"
_of_surface = partial(opt, group=_SURFACE)
_BEYOND: Final = "further effects (default: none, or the site's)"
_beyond = partial(opt, group=_BEYOND)


def _ratios(text: str) -> tuple[float, ...]:
    ratio = number("ratios", low=1e-3, high=1e3)
    return tuple(ratio(part) for part in text.split(","))


def _speed_range(text: str) -> tuple[float, float]:
    speed = number("a speed in m/s (or START:END)", low=0.1, high=60)
    start, _, end = text.partition(":")
    return speed(start), speed(end if ":" in text else start)


@dataclass(frozen=True, kw_only=True)
class SimulateOptions:
    """Options of `driveby simulate`: truth, drive, effects and the recording."""

    scenario: int | None = opt(
        "damage scenario of the paper, 1 to 12, see docs/validation.md",
        scenario,
        alternatives=_TRUTH,
        required=True,
        metavar="N",
    )
    ei: tuple[float, ...] | None = opt(
        "flexural rigidity of each element as a share of its undamaged value",
        _ratios,
        alternatives=_TRUTH,
        required=True,
        metavar="1,1,.4,…",
    )
    site: Path | None = site_option("site file (default: truck and bridge of the paper)")
    vehicle: str | None = opt(
        "identifier of the vehicle to simulate (default: the site's first)", metavar="ID"
    )
    bridge: str | None = opt(
        "identifier of the bridge to cross (default: the site's first)", metavar="ID"
    )
    axles: int | None = opt(
        "number of axles of the truck; 3 or 4: a loaded tipper with an equalised tandem, unless "
        "the site's truck has one (default: the site's truck, or 2)",
        int,
        choices=(2, 3, 4),
    )
    road: str | None = opt(
        "road class by ISO 8608 (default: the site's road_class, or A)", choices=tuple("ABCDE")
    )
    seed: int = seed_option()
    noise: float | None = noise_option(
        "accelerometers' noise density in µg/√Hz (default: the site's, or 0)", default=None
    )
    speed: tuple[float, float] = opt(
        "speed in m/s, or START:END for a constant acceleration (default: 10)",
        _speed_range,
        default=(10.0, 10.0),
        metavar="M_PER_S",
    )
    direction: str = opt(
        "direction of travel, in the same lane (default: start_to_end)",
        default="start_to_end",
        choices=("start_to_end", "end_to_start"),
    )
    gps_noise: bool = flag("simulate the errors of a real GNSS receiver", alternatives=_RECEIVER)
    perfect_gps: bool = flag(
        "simulate exact positions and speeds (default)", alternatives=_RECEIVER
    )
    rate: float | None = opt(
        "sampling rate in Hz (default: the site's, or 1000)",
        number("a rate in Hz", low=50, high=50_000),
        metavar="HZ",
    )
    runs: int = count_option(
        "number of runs over the same road, ten minutes apart, in one recording",
        "a number of runs",
        1,
        1,
        100,
        group=_RUNS,
    )
    days: int = count_option(
        "number of days, each with these runs, in one recording",
        "a number of days",
        1,
        1,
        1000,
        group=_RUNS,
    )
    start: str | None = opt(
        "start of the first run, ISO 8601 with a zone (default: 2026-01-01T00:00:00Z)",
        group=_RUNS,
        metavar="TIME",
    )
    drive_seed: int | None = _of_surface(
        "seed of noise and lateral position (default: --seed; the road always uses --seed)",
        whole("a seed", 0),
        metavar="SEED",
    )
    road_surface: bool = flag(
        "simulate a 2-D road surface, so that the axles follow different profiles "
        "(default: one profile for both)",
        group=_SURFACE,
    )
    tyres: str | None = _of_surface(
        "tyres of the rear axle, on a 2-D surface (default: the site's, or twin)",
        choices=("single", "twin"),
    )
    rear_offset: float | None = _of_surface(
        "lateral offset of the rear from the front axle in m, on a 2-D surface (default: "
        "the site's, or 0.005)",
        number("an offset in m", low=-1, high=1),
        metavar="M",
    )
    wander: float | None = _of_surface(
        "lateral wander: standard deviation of the lateral position between runs in m, on a 2-D "
        "surface (default: 0)",
        number("a standard deviation in m", low=0, high=2),
        metavar="M",
    )
    deck_roughness: float | None = _of_surface(
        "roughness on the bridge relative to that off it, on a 2-D surface (default: 1)",
        number("a factor", low=0.1, high=10),
        metavar="FACTOR",
    )
    joints: float | None = _of_surface(
        "largest height in mm of a dip or step at each end of the bridge, on a 2-D surface "
        "(default: 0)",
        number("a height in mm", low=0, high=50),
        metavar="MM",
    )
    anisotropy: float | None = _of_surface(
        "lateral correlation length relative to that of an isotropic surface, on a 2-D "
        "surface (default: 1)",
        number("a factor", low=0.2, high=20),
        metavar="FACTOR",
    )
    support_springs: tuple[float, float] = _beyond(
        "rotational stiffness of the supports in N·m/rad",
        numbers("rotational stiffnesses in N·m/rad (START:END)", (0, 1e13), (0, 1e13)),
        default=(0.0, 0.0),
        metavar="START:END",
    )
    bearing_stiffness: tuple[float, float] | None = _beyond(
        "vertical stiffness of the bearings in N/m",
        numbers("vertical stiffnesses in N/m (START:END)", (1e7, 1e15), (1e7, 1e15)),
        metavar="START:END",
    )
    departed_vehicle: tuple[float, float, float] | None = _beyond(
        "weight in N and speed in m/s of a vehicle that left the bridge S seconds before the truck"
        " entered it",
        numbers(
            "a weight in N, a speed in m/s and seconds before (N:M_PER_S:S)",
            (0, 1e7),
            (0.5, 60),
            (0, 1000),
        ),
        metavar="N:M_PER_S:S",
    )
    friction: float = _beyond(
        "suspension friction as a share of the static load",
        number("a share of the springs' load", low=0, high=0.5),
        default=0.0,
        metavar="SHARE",
    )
    friction_growth: float = _beyond(
        "share of the friction that grows with the load; 1: proportional",
        number("a growth with the load", low=0, high=1),
        default=0.0,
        metavar="SHARE",
    )
    bilinear: float = _beyond(
        "damper asymmetry: stronger in rebound, weaker in compression by this share",
        number("a share", low=0, high=0.9),
        default=0.0,
        metavar="SHARE",
    )
    air_springs: float = _beyond(
        "polytropic exponent of air springs; 1.38 is typical",
        number("a polytropic exponent", low=1, high=2),
        default=0.0,
        metavar="EXPONENT",
    )
    lane_offset: float | None = _beyond(
        "distance of the lane's centre line from the bridge's axis in m, positive to the left "
        "looking from start to end; with --torsion the load of this lane twists the deck "
        "(default: the site's, or 0)",
        number("a distance in m", low=-20, high=20),
        metavar="M",
    )
    torsion: tuple[float, float] | None = _beyond(
        "ratio of the deck's first torsional to its first bending frequency, and its radius of "
        "gyration in m; needs a lane offset (2:2.3 is typical; default: the site's, or no twist)",
        numbers("a frequency ratio and a radius of gyration in m (RATIO:M)", (0.2, 100), (0.1, 30)),
        metavar="RATIO:M",
    )
    output: Path = recording_option(required=True)
    force: bool = force_option()
