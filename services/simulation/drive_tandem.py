"""Drives of a site file's truck with a tandem: the truth of `two_sided` for `driveby simulate`.

The plane simulation of `drive` has two axles; this one has left and right wheels, and a bogie.
"""

from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from pre_core.constants import STANDARD_GRAVITY_M_PER_S2
from schemas.site import Bridge, Site, Vehicle
from schemas.site_axle_tables import Axle
from schemas.site_file import site_toml
from schemas.site_sensors import PlacedSensor
from services.common.arrays import Floats
from services.common.errors import InputError
from services.common.progress import steps_bar
from services.drives.runs import run_to_messages
from services.identification.footprints import footprints_of
from services.recordings.writer import write_recording
from services.simulation.drive import road_note
from services.simulation.schedule import ONCE, Schedule, begun_at
from services.simulation.two_sided import Body, WideAxle, WideBogie, WideTruck
from services.simulation.two_sided_deck import Deck, Torsion, bending_frequencies_hz
from services.simulation.wheel_paths import REAR_OFFSET_M, SurfaceOptions
from services.simulation.wide_crossings import (
    START_TIME_S,
    SatelliteErrors,
    WideCase,
    WideRun,
    WideSensor,
    drive_case,
)

if TYPE_CHECKING:
    from pathlib import Path

    from rich.console import Console

_ROLL_GYRATION_M: Final = 0.85
_FRONT_TRACK_M: Final = 2.05


class TandemDrive(NamedTuple):
    """Conditions of the drive of a truck with a tandem."""

    road: tuple[str, int]
    """ISO 8608 class, and the seed of the surface."""
    noise_ug_per_rthz: float | None = 0.0
    """Noise density of every sensor; None: those that the site declares."""
    speed_m_per_s: float = 10.0
    forward: bool = True
    has_receiver_errors: bool = False
    rate_hz: float | None = None
    friction_share: float = 0.0
    support_springs: tuple[float, float] = (0.0, 0.0)
    lane_offset_m: float = 0.0
    torsion: tuple[float, float] | None = None
    """Ratio of torsional to bending frequency, and deck gyration in m; None: no twist."""
    surface: SurfaceOptions | None = None
    """Surface on which every tyre has a path of its own; None: one profile for all."""
    schedule: Schedule = ONCE
    drive_seed: int = 1
    least_before_m: float = 0.0
    """Least recorded road of the last axle before the bridge."""


def simulate_tandem(
    site: Site, ratios: Floats, how: TandemDrive, output: "Path", *, force: bool, console: "Console"
) -> int:
    """Write the recording of runs of the site's first truck, which has a tandem."""
    case = tandem_case(site, ratios, how)
    runs = []
    with steps_bar("simulating", console) as progress:
        for number in range(how.schedule.drives):
            progress(number, how.schedule.drives)
            run = drive_case(case, number).run
            runs.append(begun_at(run, how.schedule.begin_s(number, START_TIME_S)))
    declared = site_of_sensors(site, how)
    messages = write_recording(
        output,
        run_to_messages(runs, declared, "sim-drive", declared.vehicles[0].id),
        site_toml=site_toml(declared),
        reason="simulation complete",
        force=force,
    )
    times = runs[0].accel_time_s
    console.print(
        f"{output}: {how.schedule.in_words(times[-1] - times[0])}, {messages} messages"
        f"{road_note(site, how.road[0])}"
    )
    return 0


def site_of_sensors(site: Site, how: TandemDrive) -> Site:
    """Return the site of the first truck alone, with noise and rate of the simulated sensors."""
    vehicle = site.vehicles[0]
    sensors = tuple(
        one.model_copy(
            update={
                "noise_density_ug_per_rthz": _density(one, how),
                "rate_hz": how.rate_hz or one.rate_hz,
            }
        )
        for one in vehicle.sensors
    )
    declared = vehicle.model_copy(update={"sensors": sensors})
    return site.model_copy(update={"vehicles": (declared,), "ros2": ()})


def _density(sensor: PlacedSensor, how: TandemDrive) -> float:
    declared = sensor.noise_density_ug_per_rthz
    return declared if how.noise_ug_per_rthz is None else how.noise_ug_per_rthz


def tandem_case(site: Site, ratios: Floats, how: TandemDrive) -> WideCase:
    """Return the site's first truck on its first bridge as a case; raise InputError if impossible.

    `ratios` are EI of each element over the nominal value.
    """
    vehicle, bridge = site.vehicles[0], site.bridges[0]
    rate = how.rate_hz or max(one.rate_hz or max(site.sensor.rate_hz) for one in vehicle.sensors)
    rng = np.random.default_rng(np.random.SeedSequence([how.drive_seed, 0x7A2E]))
    wander = 0.0 if how.surface is None else how.surface.wander_m
    of_receiver = site.receiver
    return WideCase(
        "simulation",
        how.drive_seed,
        truck_with_tandem(vehicle, how),
        _deck(bridge, ratios, how),
        max(bridge.nominal_flexural_rigidity_nm2),
        how.lane_offset_m,
        how.road[0],
        how.road[1],
        how.surface is None,
        tuple(
            WideSensor(
                one.channel,
                one.on,
                one.position_m or 0.0,
                one.axle or 0,
                one.lateral_m,
                noise_ug_per_rthz=_density(one, how),
            )
            for one in vehicle.sensors
        ),
        tuple(
            WideRun(how.speed_m_per_s, how.forward, wander * float(rng.standard_normal()))
            for _ in range(how.schedule.drives)
        ),
        _tables(site),
        rate,
        SatelliteErrors(
            of_receiver.position_spread_m,
            of_receiver.position_noise_m,
            of_receiver.speed_noise_m_per_s,
        )
        if how.has_receiver_errors
        else SatelliteErrors(0.0, 0.0, 0.0),
        vehicle.gps_antenna_to_front_axle_m,
        of_receiver.latency_s,
        how.least_before_m,
    )


def _tables(site: Site) -> dict[str, dict[str, Any]]:
    return {
        "vehicle": site.vehicles[0].shortest(),
        "bridge": site.bridges[0].model_dump(),
        "sensor": site.sensor.model_dump(),
    }


def truck_with_tandem(vehicle: Vehicle, how: TandemDrive) -> WideTruck:
    """Return the site's nominal truck with two sides; raise ValueError for one without a tandem.

    Springs that do not share their load carry what the site file declares of each axle.
    """
    tandem = vehicle.tandem
    if tandem is None:
        raise ValueError("the truck has two axles")
    d_1, lever = vehicle.front_axle_to_cg_m, vehicle.wheelbase_m
    behind = vehicle.sprung_mass_kg * d_1 / lever
    carried = [
        *(one.share * (vehicle.sprung_mass_kg - behind) for one in tandem.front_axles),
        tandem.share * behind,
        (1.0 - tandem.share) * behind,
    ]
    prints = footprints_of(vehicle)
    offset = prints[1].offset_m or (0.0 if how.surface is None else REAR_OFFSET_M)
    if how.surface is not None and how.surface.rear_offset_m is not None:
        offset = how.surface.rear_offset_m
    own: list[dict[str, Any]] = [
        {
            "track_m": one.track_m,
            "tyre_width_m": one.width_m,
            "twin_distance_m": one.twin_distance_m,
            "contact_length_m": one.length_m,
        }
        for one in prints
    ]
    ahead: list[dict[str, Any]] = [
        {"track_m": one.axle.track_m or _FRONT_TRACK_M, "spring_track_m": 0.84}
        for one in tandem.front_axles
    ]
    offsets = (*(0.0 for _ in ahead), 0.0, offset)
    axles = tuple(
        _axle(axle, body_kg, how.friction_share, shape | {"offset_m": offset_m})
        for axle, body_kg, offset_m, shape in zip(
            vehicle.axles, carried, offsets, (*ahead, *own), strict=True
        )
    )
    pitch = vehicle.pitch_inertia_ratio * vehicle.sprung_mass_kg * d_1 * (lever - d_1)
    body = Body(
        vehicle.sprung_mass_kg,
        tandem.front.position_m + d_1,
        pitch,
        vehicle.sprung_mass_kg * _ROLL_GYRATION_M**2,
        cg_height_m=vehicle.cg_height_m or 0.0,
    )
    first = len(ahead)
    shared = (WideBogie((first, first + 1), (tandem.share, 1.0 - tandem.share)),)
    return WideTruck((body,), axles, shared if tandem.is_equalised else ())


def _axle(axle: Axle, body_kg: float, friction_share: float, shape: dict[str, Any]) -> WideAxle:
    """Return an axle that carries `body_kg` of the body on a flat road."""
    return WideAxle(
        axle.position_m,
        axle.unsprung_mass_kg,
        axle.suspension_stiffness_n_per_m,
        axle.suspension_damping_ns_per_m,
        axle.tyre_stiffness_n_per_m,
        axle.tyre_damping_ns_per_m,
        friction_n=friction_share * body_kg * STANDARD_GRAVITY_M_PER_S2,
        preload_n=body_kg * STANDARD_GRAVITY_M_PER_S2,
        **shape,
    )


def _deck(bridge: Bridge, ratios: Floats, how: TandemDrive) -> Deck:
    lengths = np.array(bridge.lengths_m)
    if bridge.interior_supports_m or np.ptp(lengths) > 1e-9 * lengths[0]:
        raise InputError(
            f"{bridge.id}: elements or spans differ, a truck with a tandem is simulated on one "
            "span of equal elements"
        )
    rigidity = np.array(bridge.nominal_flexural_rigidity_nm2)
    deck = Deck(
        bridge.span_m,
        tuple((rigidity * ratios).tolist()),
        bridge.mass_per_length_kg_per_m,
        bridge.rayleigh_alpha_per_s,
        bridge.rayleigh_beta_s,
        support_rotational_stiffness_nm_per_rad=how.support_springs,
    )
    if how.torsion is None:
        return deck
    undamaged = deck._replace(flexural_rigidity_nm2=tuple(rigidity.tolist()))
    first = float(bending_frequencies_hz(undamaged, 1)[0])
    return deck._replace(torsion=Torsion(how.torsion[0] * first, how.torsion[1]))
