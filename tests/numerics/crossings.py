"""Crossings for the tests of method `pre`: simulated finely, and the point that is their truth.

What is left of the residual at a truth is measured in units of the noise of 5 µg/√Hz, five times
better than the sensors.
"""

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from pre_core.arrays import FloatArray
from pre_core.constants import MICRO_G_M_PER_S2, STANDARD_GRAVITY_M_PER_S2
from pre_core.crossing.arguments import EvaluationPoints, GriddedCrossing, allocate_buffers
from pre_core.crossing.channels import channel_signals
from pre_core.crossing.deflection import SWING_MODES
from pre_core.crossing.noise import no_suspension_noise, noise_path
from pre_core.crossing.residuals import evaluate
from pre_core.crossing.rows import row_count, row_filter
from pre_core.crossing.step_tables import sinc_table, step_table
from pre_core.crossing.whitening import whitener
from pre_core.paper import experiment
from pre_core.physics.beam_basis import BeamBasis, beam_basis
from pre_core.physics.bridge import Beam, refine
from pre_core.physics.models import from_models
from pre_core.physics.road import contact_patch_average, iso_8608_profile, under_wheels
from pre_core.physics.sensors import Accelerometer, measure_acceleration
from pre_core.physics.simulate import (
    CoupledResponse,
    Discretisation,
    InitialVibration,
    constant_speed,
    simulate,
)
from pre_core.physics.vehicle import HalfCar
from schemas.signals import CHANNELS
from schemas.site import Site
from services.simulation import drive as site_drive
from services.simulation.drive import paper_site
from tests.numerics.whitened import white_rows

if TYPE_CHECKING:
    from services.simulation.drive import SimulatedDrive

NOISE_UG = 5.0
BEFORE_S = 3.0  # of driving in a simulated recording before the front axle enters
PARTS = 2


class Case(NamedTuple):
    acceleration: FloatArray  # (4, samples) as the sensors read it
    start_s: float
    rate_hz: float
    speeds: tuple[float, float]
    theta: FloatArray
    direction: int
    site: Site


def case(
    drive: "SimulatedDrive",
    site: Site,
    *,
    forward: bool = True,
    speeds: tuple[float, float] = (experiment.SPEED_M_PER_S, experiment.SPEED_M_PER_S),
) -> Case:
    vehicle, bridge = site.vehicles[0], site.bridges[0]
    here = Case(
        np.stack([drive.run.channels[name] for name in CHANNELS]),
        0.0,
        drive.run.rate_hz,
        speeds,
        from_models(
            site_drive.truck_of(vehicle), site_drive.beam_of(bridge, drive.rigidity_ratios)
        ),
        1 if forward else -1,
        site,
    )
    travel, _ = driven(here, np.arange(here.acceleration.shape[1]) / here.rate_hz)
    kept = np.flatnonzero((travel > -12.0) & (travel < bridge.span_m + vehicle.wheelbase_m + 8.0))
    return part(here, int(kept[0]), int(kept[-1]) + 1)


def part(case: Case, begin: int, stop: int) -> Case:
    """Samples begin … stop - 1."""
    return case._replace(
        acceleration=case.acceleration[:, begin:stop], start_s=case.start_s + begin / case.rate_hz
    )


def driven(case: Case, time_s: FloatArray) -> tuple[FloatArray, float]:
    """How far the front axle is beyond the end at which it enters, and its acceleration."""
    vehicle, bridge = case.site.vehicles[0], case.site.bridges[0]
    begin, end = case.speeds
    driven_s = BEFORE_S + (bridge.span_m + vehicle.wheelbase_m) / (0.5 * (begin + end)) + 2.5
    rate = (end - begin) / driven_s
    return begin * (time_s - BEFORE_S) + 0.5 * rate * (time_s**2 - BEFORE_S**2), rate


def crossing(
    case: Case,
    *,
    cg_height_m: float | None = None,
    parts: int = PARTS,
    is_inertial: bool = True,
) -> GriddedCrossing:
    vehicle, bridge = case.site.vehicles[0], case.site.bridges[0]
    basis = beam_basis(np.array(bridge.lengths_m), parts, has_compliant_bearings=True)
    model = channel_signals(case.acceleration, 1.0 / case.rate_hz, case.rate_hz)
    front = point(case).position_m[0]
    first = int(np.searchsorted(np.abs(front - front[0]), vehicle.wheelbase_m + 1.0))
    data = bare_crossing(
        model.step_s,
        model.signals,
        basis,
        bridge.span_m,
        vehicle.total_mass_kg,
        is_inertial=is_inertial,
    )
    return data._replace(
        direction=case.direction,
        cg_height_m=(vehicle.cg_height_m or 0.0) if cg_height_m is None else cg_height_m,
        first_row=first,
        rows=front.size - first,
    )


def bare_crossing(
    step_s: float,
    signals: FloatArray,
    basis: BeamBasis,
    span_m: float,
    total_mass_kg: float,
    *,
    is_inertial: bool,
) -> GriddedCrossing:
    """From start to end, with a mass at the height of the road; every sample of (4, 6, n) a row."""
    return GriddedCrossing(
        step_s,
        signals,
        1,
        span_m,
        total_mass_kg,
        0.0,
        STANDARD_GRAVITY_M_PER_S2,
        basis,
        np.concatenate([[0.0], np.cumsum(basis.lengths_m)]),
        0,
        signals.shape[2],
        sinc_table(),
        step_table(),
        is_inertial,
        0,
    )


def point(case: Case, count: int = 1) -> EvaluationPoints:
    """`count` times the truth, without any correction."""
    model = channel_signals(np.zeros_like(case.acceleration), 1.0 / case.rate_hz, case.rate_hz)
    n = model.signals.shape[2]
    travel, rate = driven(case, case.start_s + model.start_s + model.step_s * np.arange(n))
    front = travel if case.direction > 0 else case.site.bridges[0].span_m - travel
    at = uncorrected(case.theta, case.site.vehicles[0].wheelbase_m, front, count)
    return at._replace(acceleration_m_per_s2=np.full((count, n), rate))


def uncorrected(
    theta: FloatArray, wheelbase_m: float, front_m: FloatArray, count: int = 1
) -> EvaluationPoints:
    """`count` times the same point at constant speed, front_m (n,), without any correction."""
    return EvaluationPoints(
        np.tile(theta, (count, 1)),
        np.full(count, wheelbase_m),
        np.tile(front_m, (count, 1)),
        np.zeros((count, front_m.size)),
        np.zeros((count, 4)),
        np.ones(count),
        np.zeros((count, 4)),
        np.zeros((count, 4, 3)),
        np.zeros((count, 2 * SWING_MODES)),
    )


def residual(
    case: Case, at: EvaluationPoints, *, data: GriddedCrossing | None = None, threads: int = 1
) -> FloatArray:
    data = crossing(case) if data is None else data
    rows = row_filter(data.step_s)
    works = tuple(allocate_buffers(data, case.theta.size, rows) for _ in range(threads))
    return evaluate(data, works, at)


def white(case: Case, residuals: FloatArray, *, is_inertial: bool = True) -> FloatArray:
    """White rows (k, 3 m), where one is the noise of 5 µg/√Hz."""
    rows = row_filter(crossing(case).step_s)
    vehicle = case.site.vehicles[0]
    truck = noise_path(case.theta, vehicle.total_mass_kg, vehicle.wheelbase_m, is_inertial)
    density = np.full(4, NOISE_UG * MICRO_G_M_PER_S2)
    noise = whitener(
        rows, row_count(rows, residuals.shape[2]), truck, density, no_suspension_noise()
    )
    return white_rows(rows, noise, residuals)


def in_noise(case: Case, residuals: FloatArray, *, is_inertial: bool = True) -> FloatArray:
    """Mean square of the three white rows, where 1 is the noise of 5 µg/√Hz: (3,)."""
    rows = white(case, residuals, is_inertial=is_inertial).reshape(-1, 3)
    return np.asarray(np.mean(rows**2, axis=0))


def little(left: FloatArray, factor: float = 1.0) -> bool:
    """Whether what is left (3,) of the noise's power in the white rows is little.

    How it is shared among the three rows of a sample depends on their order and on how they are
    written; their sum does not.
    """
    return bool(left[0] < 0.01 * factor and left.sum() < 0.12 * factor)


STEP_S = 1e-4
RATE_HZ = 1000.0


class Driven(NamedTuple):
    """A crossing of this module's own simulation, and all that truck and bridge did."""

    case: Case
    run: CoupledResponse
    start_s: float
    """When the simulation began, on the case's clock."""


def simulated(
    car: HalfCar,
    beam: Beam,
    *,
    speed_m_per_s: float = 10.0,
    forward: bool = True,
    road_class: str = "A",
    settle_s: float = 2.0,
    before_s: float = BEFORE_S,
    swing: FloatArray | None = None,
) -> Driven:
    """Drive `car` over `beam`, elements cut into ten, all modes, 0.1 ms.

    What is recorded begins `before_s` before the front axle enters, the simulation `settle_s`
    before that, with the bridge's `swing` (see `simulate`).

    An axle is on a bearing in the middle between two steps: Newmark's scheme takes a load that is
    there at a step and was not at the last for one that came in the middle.
    """
    site = paper_site()
    span = float(beam.element_lengths_m.sum())
    sign = 1 if forward else -1
    before = before_s - 0.5 * STEP_S
    driven_s = before_s + (span + car.wheelbase_m) / speed_m_per_s + 2.0
    steps = round((settle_s + driven_s) / STEP_S) + 1
    start = -speed_m_per_s * (settle_s + before)
    start = start if forward else span - start
    motion = constant_speed(start, sign * speed_m_per_s, steps, STEP_S)
    low, high = motion.position_m.min() - 6.0, motion.position_m.max() + 6.0
    raw = iso_8608_profile(np.floor(low), np.ceil(high), 0.01, road_class, 1)
    felt = under_wheels(contact_patch_average(raw, 0.2), motion, car.wheelbase_m, sign)
    state = None if swing is None else InitialVibration(np.stack(swing), 0)
    run = simulate(car, refine(beam, 10), motion, felt, Discretisation(STEP_S), swing=state)
    assert run.converged
    settle = round(settle_s / STEP_S)
    sensor = Accelerometer(RATE_HZ)
    rng = np.random.default_rng(0)
    acceleration = np.stack(
        [
            measure_acceleration(run.acceleration_m_per_s2[settle:, i], 1.0 / STEP_S, sensor, rng)
            for i in range(4)
        ]
    )
    # `driven` takes BEFORE_S for the moment of entry.
    speeds = (speed_m_per_s, speed_m_per_s)
    whole = Case(
        acceleration,
        BEFORE_S - before,
        RATE_HZ,
        speeds,
        from_models(car, beam),
        sign,
        site,
    )
    time = whole.start_s + np.arange(acceleration.shape[1]) / RATE_HZ
    travel, _ = driven(whole, time)
    seen = np.flatnonzero((travel > -12.0) & (travel < span + car.wheelbase_m + 8.0))
    first = int(seen[0])
    here = part(whole, first, int(seen[-1]) + 1)
    return Driven(here, run, whole.start_s - settle_s)
