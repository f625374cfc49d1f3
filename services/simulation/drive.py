"""Simulated drives: the truth of a site file or of the paper's scenarios, driven and measured.

The truth is computed on a mesh ten times finer than the elements, with 40 modes for each span and
steps of at most 0.1 ms, so that no identification shares its discretisation.
"""

from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from pre_core.constants import STANDARD_GRAVITY_M_PER_S2
from pre_core.paper import experiment
from pre_core.parameters import SCALARS, TRUCK
from pre_core.physics.bridge import (
    Beam,
    modes,
    node_dofs,
    refine,
    supported_nodes,
    uniform_beam,
)
from pre_core.physics.free_vibration import free_vibration_after
from pre_core.physics.road import Profile, contact_patch_average, iso_8608_profile, under_axles
from pre_core.physics.sensors import Accelerometer, measure_acceleration
from pre_core.physics.simulate import (
    CoupledResponse,
    Discretisation,
    InitialVibration,
    constant_acceleration,
    simulate,
)
from pre_core.physics.vehicle import HalfCar, static_axle_loads_n
from schemas.signals import CHANNELS
from schemas.site import Bridge, Densities, Site, Vehicle
from schemas.site_file import parse_site, site_toml
from services.common.arrays import Floats
from services.common.errors import FailureError, InputError
from services.common.road_class import assumed_road
from services.drives.runs import Run, run_to_messages
from services.recordings.writer import write_recording
from services.simulation.lane import Twist
from services.simulation.positions import START_TIME_S as START_TIME_S
from services.simulation.positions import (
    AntennaTrack,
    Instruments,
    TimedMotion,
    gnss_track,
    receiver_of,
)
from services.simulation.recorded_road import times_s
from services.simulation.schedule import Schedule, begun_at
from services.simulation.wheel_paths import (
    AxleRoads,
    WheelPaths,
    roads_of_surface,
)

_PARTS = 10
_MODES = 40
"""Number of modes of each span."""
LONGEST_STEP_S = 1e-4
"""Longest time step: the truth must be far more exact than the tested method."""
SETTLE_S = 3.0
"""Duration of the drive before its recording, in which the start from rest decays."""
_ROAD_SPACING_M = 0.01
_CONTACT_PATCH_M = 0.2
TRUCK_KEYS: Final = tuple(
    dict.fromkeys(row.key for row in SCALARS if row.part == TRUCK and row.key in HalfCar._fields)
)
"""Quantities of a two-axle truck that are in the parameter table."""


class DepartedVehicle(NamedTuple):
    """A lorry that has left the bridge, as a constant force."""

    weight_n: float
    speed_m_per_s: float
    """Speed; negative from the bridge's end to its start."""
    seconds: float
    """Time between its exit and the entry of the first wheel."""


class OutOfModelEffects(NamedTuple):
    """Effects in truck and bridge that a site file does not describe."""

    support_rotational_stiffness_nm_per_rad: tuple[float, float] = (0.0, 0.0)
    support_compliance_m_per_n: tuple[float, float] = (0.0, 0.0)
    departed: DepartedVehicle | None = None
    friction_share: float = 0.0
    """Dry friction of the suspension over its static load."""
    friction_load_growth: float = 0.0
    bilinear_damping: float = 0.0
    air_spring_exponent: float = 0.0

    twist: Twist | None = None


NO_EFFECTS = OutOfModelEffects()


class DrivenRoad(NamedTuple):
    """The road under a simulated truck."""

    kind: str | Profile
    """ISO 8608 class, or the profile of both axles."""
    seed: int
    """Seed of the phases of a class."""
    paths: WheelPaths | None = None
    """Paths of the wheels on a surface of the class; None: one profile for both axles."""
    lane_offset_m: float = 0.0


class Measurement(NamedTuple):
    """Accelerometers and receiver of a simulated drive."""

    noise_ug_per_rthz: float | Densities = 0.0
    """Noise density of every accelerometer, or of each channel."""
    rate_hz: float | None = None
    """Sampling rate of the accelerometers; None: the highest of the site."""
    has_receiver_errors: bool = False
    """Whether the receiver has the errors of the site file, or none."""
    seed: int | tuple[int, ...] | None = None
    """Seed of noise and of the truck's lateral position; None: that of the road."""
    least_road_m: tuple[float, float] = (0.0, 0.0)
    """Least recorded road of the rear axle before and after the bridge."""


NO_ERRORS = Measurement()


class SimulatedDrive(NamedTuple):
    """The measurements of a truck, and the truth."""

    run: Run
    road: Profile
    """Profile under the tyres; on a surface, the front tyres."""
    rigidity_ratios: Floats
    """EI of each element over the site's nominal value."""
    rear_road: Profile | None = None
    """Profile under the rear tyres, on a surface."""


def paper_site() -> Site:
    """Return the site of the paper: Tables 1 and 2."""
    text = resources.files("services").joinpath("data/paper.toml").read_text(encoding="utf-8")
    return parse_site(text, "paper.toml")


def densities_of(noise_ug_per_rthz: float | Densities) -> Densities:
    """Return the noise density of each channel in µg/√Hz; one number is that of all four."""
    if isinstance(noise_ug_per_rthz, float | int):
        return (noise_ug_per_rthz,) * 4
    return noise_ug_per_rthz


def noise_density_of(site: Site | None, asked_ug_per_rthz: float | None) -> float | Densities:
    """Return the noise density in µg/√Hz that is asked for, else that of a given site, else 0."""
    if asked_ug_per_rthz is not None:
        return asked_ug_per_rthz
    return 0.0 if site is None else site.sensor.noise_density_ug_per_rthz


def road_class_of(site: Site, asked: str | None) -> str:
    """Return the ISO 8608 class that is asked for, else that of the site's first bridge, else A."""
    return asked or site.bridges[0].road_class or "A"


def road_note(site: Site, road_class: str) -> str:
    """Return a note on a road class that the site's first bridge does not declare, or ""."""
    assumed = assumed_road(road_class, site.bridges[0].road_class, "--road")
    return assumed and f"; {assumed}"


def declared_site(site: Site, noise_ug_per_rthz: float | Densities, rate_hz: float) -> Site:
    """Return the site as the owner of this simulated truck would declare it, with sensor noise."""
    sensor = site.sensor.model_copy(
        update={
            "noise_density_ug_per_rthz": densities_of(noise_ug_per_rthz),
            "rate_hz": (rate_hz,) * 4,
        }
    )
    return site.model_copy(update={"sensor": sensor})


def write_drive(
    path: Path, drive: SimulatedDrive, site: Site, realm: str = "sim-drive", *, force: bool = False
) -> int:
    """Write the recording that the truck would have made, at the drive's own time."""
    own_time = Schedule(start_s=float(drive.run.accel_time_s[0]))
    return write_drives(path, [drive], site, realm, force=force, schedule=own_time)


def write_drives(
    path: Path,
    drives: Sequence[SimulatedDrive],
    site: Site,
    realm: str = "sim-drive",
    *,
    force: bool = False,
    schedule: Schedule | None = None,
) -> int:
    """Write the recording of several drives, ten minutes apart without another schedule."""
    at = schedule or Schedule(len(drives))
    runs = [begun_at(drive.run, at.begin_s(number)) for number, drive in enumerate(drives)]
    messages = run_to_messages(runs, site, realm, site.vehicles[0].id)
    return write_recording(
        path, messages, site_toml=site_toml(site), reason="simulation complete", force=force
    )


def simulate_drive(
    site: Site,
    rigidity_ratios: Floats,
    road: DrivenRoad,
    measurement: Measurement = NO_ERRORS,
    *,
    speed_m_per_s: tuple[float, float] = (experiment.SPEED_M_PER_S, experiment.SPEED_M_PER_S),
    forward: bool = True,
    effects: OutOfModelEffects = NO_EFFECTS,
) -> SimulatedDrive:
    """Drive the site's first truck over its first bridge.

    The speed changes evenly from the first to the second value over the recording. A twist in
    `effects` gives the offset of the lane. Raise FailureError if the coupled simulation does not
    converge.
    """
    vehicle, bridge = site.vehicles[0], site.bridges[0]
    car, beam = with_effects(truck_of(vehicle), beam_of(bridge, rigidity_ratios), effects)
    if effects.twist is not None:
        road = road._replace(lane_offset_m=effects.twist.lane_offset_m)
    rate = measurement.rate_hz or max(site.sensor.rate_hz)
    every = max(1, round(1.0 / (rate * LONGEST_STEP_S)))
    step_s = 1.0 / (rate * every)
    begin, end = speed_m_per_s
    on_bridge_m = bridge.span_m + vehicle.wheelbase_m
    before_s, driven_s = times_s(
        speed_m_per_s, on_bridge_m, vehicle.wheelbase_m, measurement.least_road_m
    )
    acceleration = (end - begin) / driven_s
    settle = round(SETTLE_S * rate) * every
    steps = settle + int(np.ceil(driven_s * rate)) * every + 1
    # When the recording begins the truck has its first speed.
    first_speed = begin - acceleration * SETTLE_S
    approach = begin * before_s + 0.5 * acceleration * before_s**2
    approach += first_speed * SETTLE_S + 0.5 * acceleration * SETTLE_S**2
    sign = 1 if forward else -1
    start = -approach if forward else bridge.span_m + approach
    motion = constant_acceleration(start, sign * first_speed, acceleration, steps, step_s)
    densities = densities_of(measurement.noise_ug_per_rthz)
    run, roads = measured_run(
        bridge,
        car,
        beam,
        TimedMotion(motion, step_s, settle),
        road,
        Instruments(
            tuple(Accelerometer(rate, noise_density_ug_per_rthz=one) for one in densities),
            receiver_of(site, perfect=not measurement.has_receiver_errors),
            np.random.default_rng(road.seed if measurement.seed is None else measurement.seed),
            vehicle.gps_antenna_to_front_axle_m,
        ),
        effects.departed,
    )[:2]
    ratios = np.asarray(rigidity_ratios, dtype=np.float64)
    return SimulatedDrive(run, roads.front, ratios, None if road.paths is None else roads.rear)


def measured_run(
    bridge: Bridge,
    car: HalfCar,
    beam: Beam,
    driven: TimedMotion,
    road: DrivenRoad,
    instruments: Instruments,
    departed: DepartedVehicle | None = None,
) -> tuple[Run, AxleRoads, CoupledResponse]:
    """Drive `car` over `beam` along a motion and measure it with one sensor per channel.

    After a `departed` vehicle the bridge vibrates when the first wheel enters. Return the
    recording, the road under the tyres and the response of truck and bridge. Raise FailureError if
    the coupled simulation does not converge.
    """
    motion, step_s, settling_steps = driven
    sensors = instruments.sensors
    accel_rng, gnss_rng, place_rng = instruments.rng.spawn(3)
    sign = 1 if motion.speed_m_per_s[0] >= 0.0 else -1
    reach = car.wheelbase_m + 1.0
    if road.paths is None:
        low, high = motion.position_m.min() - reach, motion.position_m.max() + reach
        profile = contact_patch_average(_profile(low, high, road.kind, road.seed), _CONTACT_PATCH_M)
        roads = AxleRoads(profile, profile)
    else:
        assert isinstance(road.kind, str)  # noqa: S101 - a profile has no width
        of_class, spacing_m = (road.kind, road.seed), _ROAD_SPACING_M
        roads = roads_of_surface(bridge, motion, reach, spacing_m, of_class, road.paths, place_rng)
    under = under_axles(*roads, motion, car.wheelbase_m, sign)
    mesh = refine(beam, _PARTS)
    count = min(_MODES * (1 + len(mesh.interior_supports)), _freedoms(mesh))
    swing = None
    if departed is not None:
        swing = InitialVibration(free_vibration_after(mesh, modes(mesh, count), *departed))
    fine = simulate(car, mesh, motion, under, Discretisation(step_s, count), swing=swing)
    if not fine.converged:
        raise FailureError("the simulation did not converge: are the site's values possible?")
    recorded = fine.acceleration_m_per_s2[settling_steps:]
    rate = sensors[0].rate_hz
    channels = {
        name: measure_acceleration(recorded[:, i], 1.0 / step_s, sensors[i], accel_rng)
        for i, name in enumerate(CHANNELS)
    }
    time_s = START_TIME_S + np.arange(channels[CHANNELS[0]].size) / rate
    chainage_m = motion.position_m[settling_steps:] - sign * instruments.antenna_to_front_axle_m
    speed = np.abs(motion.speed_m_per_s[settling_steps:])
    antenna = AntennaTrack(chainage_m, np.full_like(chainage_m, road.lane_offset_m), speed)
    gnss = gnss_track(bridge, step_s, antenna, instruments.receiver, gnss_rng, forward=sign > 0)
    return Run("simulation", time_s, rate, channels, gnss), roads, fine


def _profile(low_m: float, high_m: float, road: str | Profile, seed: int) -> Profile:
    """Return the road between two chainages; beyond a given profile it stays level."""
    start, stop = float(np.floor(low_m)), float(np.ceil(high_m))
    if isinstance(road, str):
        return iso_8608_profile(start, stop, _ROAD_SPACING_M, road, seed)
    x_m: Floats = np.arange(start, stop + 0.5 * _ROAD_SPACING_M, _ROAD_SPACING_M)
    return Profile(x_m, np.interp(x_m, road.x_m, road.height_m))


def given_road(given: str | tuple[ArrayLike, ArrayLike]) -> str | Profile:
    """Return a class, or the profile of chainages and heights (n,) in m; InputError if invalid."""
    right = "it must be a class from A to E or a pair of arrays (x_m, height_m)"
    if isinstance(given, str):
        if given not in tuple("ABCDE"):
            raise InputError(f'road is "{given}", {right}')
        return given
    if not isinstance(given, Sequence | np.ndarray) or len(given) != 2:
        shape = np.shape(given) if isinstance(given, np.ndarray) else ()
        what = f"an array of shape {shape}" if shape else f"of type {type(given).__name__}"
        raise InputError(f"road is {what}, {right}")
    x_m, height_m = given[0], given[1]
    try:
        road = Profile(np.asarray(x_m, dtype=np.float64), np.asarray(height_m, dtype=np.float64))
    except (TypeError, ValueError) as error:
        raise InputError("road has values that are no numbers") from error
    if road.x_m.ndim != 1 or road.x_m.shape != road.height_m.shape or road.x_m.size < 2:
        raise InputError(
            f"road has shapes {road.x_m.shape} and {road.height_m.shape}, it must have as many "
            "heights as chainages, at least two"
        )
    if not np.all(np.isfinite(road)):
        raise InputError("road has values that are not finite numbers")
    if not np.all(np.diff(road.x_m) > 0.0):
        raise InputError("road has chainages that do not increase")
    return road


def with_two_axles(vehicle: Vehicle) -> Vehicle:
    """Return the truck; raise InputError for a tandem, which the plane simulation does not have."""
    if vehicle.tandem is not None:
        raise InputError(
            f"{vehicle.id}: has a tandem, it must be a truck of two axles; `driveby simulate`, "
            "`survey` and `validate --site` compute crossings of a tandem"
        )
    return vehicle


def truck_of(vehicle: Vehicle) -> HalfCar:
    """Return the site's nominal truck; raise InputError for one with a tandem."""
    vehicle = with_two_axles(vehicle)
    values = {key: getattr(vehicle, key) for key in TRUCK_KEYS}
    return half_car(values, vehicle.total_mass_kg, vehicle.wheelbase_m, vehicle.cg_height_m)


def half_car(
    values: Mapping[str, Any], total_mass_kg: float, wheelbase_m: float, cg_height_m: float | None
) -> HalfCar:
    """Return the truck whose quantities of the parameter table (TRUCK_KEYS) have these values."""
    return HalfCar(
        body_mass_kg=total_mass_kg - sum(values["unsprung_mass_kg"]),
        wheelbase_m=wheelbase_m,
        cg_height_m=cg_height_m or 0.0,
        **values,
    )


def beam_of(bridge: Bridge, rigidity_ratios: Floats) -> Beam:
    """Return the site's nominal bridge with these ratios of the flexural rigidity."""
    return uniform_beam(
        bridge.span_m,
        np.array(bridge.nominal_flexural_rigidity_nm2) * rigidity_ratios,
        bridge.mass_per_length_kg_per_m,
        bridge.rayleigh_alpha_per_s,
        bridge.rayleigh_beta_s,
    )._replace(
        element_lengths_m=np.array(bridge.lengths_m),
        interior_supports=bridge.interior_support_nodes,
    )


def with_effects(car: HalfCar, beam: Beam, effects: OutOfModelEffects) -> tuple[HalfCar, Beam]:
    """Return the truck and bridge with out-of-model effects."""
    loads = static_axle_loads_n(car, STANDARD_GRAVITY_M_PER_S2)
    friction = [
        effects.friction_share * (load - STANDARD_GRAVITY_M_PER_S2 * unsprung)
        for load, unsprung in zip(loads, car.unsprung_mass_kg, strict=True)
    ]
    return car._replace(
        dry_friction_n=(friction[0], friction[1]),
        friction_load_growth=effects.friction_load_growth,
        bilinear_damping=effects.bilinear_damping,
        air_spring_exponent=effects.air_spring_exponent,
    ), beam._replace(
        support_rotational_stiffness_nm_per_rad=effects.support_rotational_stiffness_nm_per_rad,
        support_compliance_m_per_n=effects.support_compliance_m_per_n,
        torsional_flexibility_per_n=effects.twist.flexibility_per_n if effects.twist else 0.0,
        torsional_wave_speed_m_per_s=effects.twist.wave_speed_m_per_s if effects.twist else 0.0,
    )


def ratios_of(
    bridge: Bridge, scenario: int | None, ei: Sequence[float] | None, *, prefix: str = "--"
) -> Floats:
    """Return EI over nominal by scenario or by element; raise InputError for a wrong number.

    `prefix` precedes the name of the option in the message.
    """
    if scenario is not None:
        ratios = experiment.scenario_ratios(scenario)
        option = "scenario"
    else:
        ratios = np.array(ei or (), dtype=np.float64)
        option = "ei"
    if ratios.size != bridge.elements:
        remedy = f": {prefix}ei takes one ratio for each" if scenario is not None else ""
        raise InputError(
            f"{prefix}{option}: gives {ratios.size} elements, but {bridge.id} of the site has "
            f"{bridge.elements}{remedy}"
        )
    return ratios


def _freedoms(beam: Beam) -> int:
    return int(node_dofs(beam.element_lengths_m.size, supported_nodes(beam)).max()) + 1
