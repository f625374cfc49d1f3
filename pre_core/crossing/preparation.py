"""Preparation of one crossing for method `pre`: the problem to solve, and its noise."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from pre_core.arrays import FloatArray
from pre_core.constants import STANDARD_GRAVITY_M_PER_S2
from pre_core.crossing import lines
from pre_core.crossing.arguments import EvaluationPoints, GriddedCrossing, allocate_buffers
from pre_core.crossing.channels import A, GainsAndDelays, ModelSignals, channel_signals
from pre_core.crossing.errors_in_variables import ComparedStretch, mismatch_power
from pre_core.crossing.front_axles import (
    FrontAxlesResponse,
    front_axles_response,
    with_front_forces,
    without_front_axles,
)
from pre_core.crossing.mismatch import BridgePavement, Mismatch, mismatch_spectra, with_axle_roll
from pre_core.crossing.noise import (
    FRICTION_STATISTIC,
    NoisePath,
    no_suspension_noise,
    noise_path,
    noise_power,
    suspension_noise_levels,
)
from pre_core.crossing.off_bridge import levels_at
from pre_core.crossing.pavement import estimate_pavement, parts_of, without_joints
from pre_core.crossing.posterior import (
    ChainageFixes,
    PosteriorProblem,
    Priors,
    data_rows,
    filtered_rows,
    has_tandem,
    layout,
    noise_path_at,
    points,
    starting_point,
    trajectory_basis,
)
from pre_core.crossing.rows import RESIDUALS, row_count, row_filter
from pre_core.crossing.step_tables import sinc_table, step_table
from pre_core.crossing.suspension_noise import REDUCED_WEIGHT_FACTOR
from pre_core.crossing.whitening import Whitener, solve, whitener
from pre_core.parameters import FIRST_OF_BRIDGE, K_U1, M_U1, TORSION
from pre_core.physics.beam_basis import beam_basis, change_basis
from pre_core.physics.surface import TYPICAL_FOOTPRINTS, Footprint
from pre_core.physics.tandem import NO_TANDEM, TandemTruck
from pre_core.physics.torsion import NO_TORSION, TorsionBasis, torsion_basis

_KNOT_S = 0.4
"""Knot spacing of the trajectory: a driver changes the speed more slowly."""
_SLOPE_STEP = 1e-3
"""Step of the one-sided differences of the noise power with respect to truck and gains."""
_SWING_BEFORE_S = 0.1
"""Time before the truck's entry at which the initial vibration is defined, a margin for the search.
"""
_MARGIN_M = 3.0  # of road before the first residual, a margin for the trajectory


class CrossingInputs(NamedTuple):
    """Input of method `pre` for one crossing; times in s on one clock, chainage in m."""

    acceleration_m_per_s2: FloatArray  # (4, n)
    start_s: float
    step_s: float
    direction: int
    span_m: float
    element_lengths_m: FloatArray
    interior_supports: tuple[int, ...]
    """Number of elements before each interior support."""
    total_mass_kg: float
    cg_height_m: float
    density_m_per_s2_per_rthz: FloatArray  # (4,) one-sided
    slowest_rate_hz: float
    fixes: ChainageFixes
    priors: Priors
    parts: int
    """Number of finite elements in each element of the bridge."""
    threads: int
    footprints: tuple[Footprint, Footprint] = TYPICAL_FOOTPRINTS
    """Footprints of the front and the rear axle."""
    torsional_wave_speed_m_per_s: float = 0.0
    """Speed of torsional waves; positive where the deck may twist."""
    lane_factor: float = 1.0
    """Squared ratio of this run's distance from the bridge's axis to that of torsion's prior."""
    tandem: TandemTruck = NO_TANDEM
    """Truck with a tandem. Fixes, wheelbase, footprints and the last two signals are then those of
    the compared axles."""
    front_footprints: tuple[Footprint, ...] = ()
    """Footprints of the axles ahead of the tandem."""
    displaced_trucks: tuple[TandemTruck, ...] = ()
    """Trucks with one value of a front axle displaced by the standard deviation of its prior."""


def build_problem(inputs: CrossingInputs) -> tuple[PosteriorProblem, FloatArray]:
    """Return the problem and the coordinates (f,) of its nominal start.

    Raise ValueError if torsion is estimated without a speed of its waves, or if the record is
    shorter than the filters (`channel_signals`).
    """
    model = channel_signals(inputs.acceleration_m_per_s2, inputs.step_s, inputs.slowest_rate_hz)
    n = model.signals.shape[2]
    position, speeding, rows, values, best = trajectory_basis(
        inputs.fixes, inputs.start_s + model.start_s, model.step_s, n, inputs.direction, _KNOT_S
    )
    front = position @ best[:-1]
    crossing = _gridded(inputs, model, front)
    row = row_filter(model.step_s)
    theta = inputs.priors.theta
    speed = float(np.ptp(front)) / ((n - 1) * model.step_s)
    noise = whitener(
        row,
        row_count(row, crossing.rows),
        noise_path(
            theta,
            crossing.total_mass_kg,
            inputs.priors.wheelbase_m,
            False,
            crossing.tandem,
            speed,
        ),
        inputs.density_m_per_s2_per_rthz,
        no_suspension_noise(),
    )
    shapes = mismatch_spectra(*inputs.footprints)
    if inputs.tandem.ahead_m > 0.0:
        hop_hz = np.sqrt(theta[K_U1] / theta[M_U1]) / (2.0 * np.pi)
        shapes = with_axle_roll(shapes, float(hop_hz), speed)
    problem = PosteriorProblem(
        crossing,
        inputs.priors,
        row,
        noise,
        inputs.density_m_per_s2_per_rthz,
        no_suspension_noise(),
        Mismatch(shapes, np.zeros(shapes.density.shape[0]), speed),
        position,
        speeding,
        rows,
        values,
        np.zeros(0),
        tuple(allocate_buffers(crossing, theta.size, row) for _ in range(inputs.threads)),
        front_axles=tuple(
            mismatch_spectra(one, inputs.footprints[0]) for one in inputs.front_footprints
        ),
        displaced_trucks=inputs.displaced_trucks,
    )
    return problem, starting_point(problem, best)


def _gridded(inputs: CrossingInputs, model: ModelSignals, front_m: FloatArray) -> GriddedCrossing:
    """Return the crossing on the grid of `model`, with the front axle at chainages `front_m` (n,).

    Residuals begin where the rear axle has passed the chainage at which the front axle begins. The
    forces of several axles ahead of a tandem follow from the road under them (`front_axles`), so
    residuals end where the first of these is on the last road that the tandem measures.
    """
    n = front_m.size
    basis = beam_basis(
        inputs.element_lengths_m,
        inputs.parts,
        interior_supports=inputs.interior_supports,
        has_compliant_bearings=True,
    )
    travel = front_m if inputs.direction > 0 else inputs.span_m - front_m
    first = int(np.searchsorted(travel - inputs.priors.wheelbase_m, travel[0] + _MARGIN_M))
    ahead_m, stop = inputs.tandem.front.ahead_m, n
    if ahead_m.size > 1:
        stop = int(np.searchsorted(travel + ahead_m.max(), travel[-1]))
    crossing = GriddedCrossing(
        model.step_s,
        model.signals,
        inputs.direction,
        inputs.span_m,
        inputs.total_mass_kg,
        inputs.cg_height_m,
        STANDARD_GRAVITY_M_PER_S2,
        change_basis(basis, inputs.priors.theta),
        np.concatenate([[0.0], np.cumsum(basis.lengths_m)]),
        first,
        stop - first,
        sinc_table(),
        step_table(),
        False,
        0,
        _torsion(inputs, basis.lengths_m),
        inputs.tandem,
        np.zeros((inputs.tandem.front.ahead_m.size, n)),
        np.zeros(n),
    )
    return crossing._replace(swing_sample=swing_sample(crossing, front_m))


def _torsion(inputs: CrossingInputs, lengths_m: FloatArray) -> TorsionBasis:
    """Return the torsion of a deck of finite elements of these lengths (e,), if it is estimated."""
    if not inputs.priors.estimated[TORSION]:
        return NO_TORSION
    if not inputs.torsional_wave_speed_m_per_s > 0.0:
        raise ValueError("torsion is estimated, so its waves need a speed")
    return torsion_basis(
        lengths_m,
        tuple(inputs.parts * node for node in inputs.interior_supports),
        inputs.torsional_wave_speed_m_per_s,
        inputs.lane_factor,
    )


def swing_sample(crossing: GriddedCrossing, front: FloatArray) -> int:
    """Return the sample shortly before the truck's first axle enters the bridge.

    `front` are the chainages (n,) of the first of the compared axles.
    """
    begin, sign = (0.0, 1.0) if crossing.direction > 0 else (crossing.span_m, -1.0)
    ahead_m = float(crossing.tandem.front.ahead_m.max(initial=0.0))
    entry = int(np.searchsorted(sign * front + ahead_m, sign * begin))
    return max(0, entry - round(_SWING_BEFORE_S / crossing.step_s))


def update_noise(
    problem: PosteriorProblem,
    y: FloatArray,
    force: FloatArray | None = None,
    friction_statistic: float = FRICTION_STATISTIC,
    mismatch: FloatArray | None = None,
    pavement: BridgePavement | None = None,
) -> PosteriorProblem:
    """Return the problem with noise and modal coordinates for truck and bridge at y (f,).

    The work arrays are shared with the given problem; the modes that they hold are discarded.

    The suspension noise is `force` (2, shapes), by default that of the body equations at y if it is
    at least `friction_statistic` (`suspension_noise_levels`). Mismatch levels are `mismatch` (s,),
    by default those of the residuals off the bridge at y if the problem has levels already. With
    mismatch, that on the bridge is `pavement`, by default estimated at y.
    """
    where = layout(problem)
    coordinates = where.gains.stop
    if has_tandem(problem):
        force = no_suspension_noise() if problem.crossing.tandem.is_equalised else force
        problem = with_front_forces(problem, y)
    if force is None:
        body = filtered_rows(problem, y)[1:]
        force = suspension_noise_levels(
            problem.rows, *noise_path_at(problem, y), body, friction_statistic
        )
    if mismatch is None:
        mismatch = problem.mismatch.level_m3
        if mismatch.any():
            mismatch = levels_at(problem, y)
    differs = bool(mismatch.any())
    front_axles = front_axles_response(problem, y)
    if differs and pavement is None:
        pavement = estimate_pavement(problem, y, mismatch, front_axles)
    road = problem.mismatch._replace(level_m3=mismatch, pavement=pavement if differs else None)
    at, trucks = _displaced_points(problem, y, coordinates, is_inertial=bool(force.any()))
    density = problem.density * (1.0 + at.gain)
    count = row_count(problem.rows, problem.crossing.rows)
    residual_force = REDUCED_WEIGHT_FACTOR * force
    profile_noise = road if differs else None
    noise = whitener(problem.rows, count, trucks[0], density[0], residual_force, profile_noise)
    noise = _with_local_noise(problem._replace(mismatch=road), y, noise, front_axles)
    changed = problem._replace(force=force, mismatch=road)
    slope = _noise_gradient(changed, trucks, density)
    if differs:
        slope = np.concatenate([slope, np.zeros(where.delays.stop - coordinates)])
        slope += mismatch_gradient(changed, y)
    basis = change_basis(problem.crossing.basis, at.theta[0])
    for work in problem.works:
        work.modes_of[:] = np.nan
    return problem._replace(
        noise=noise,
        force=force,
        mismatch=road,
        noise_slope=slope,
        crossing=problem.crossing._replace(basis=basis, is_inertial=bool(force.any())),
    )


def _noise_gradient(
    problem: PosteriorProblem, trucks: list[NoisePath], density: FloatArray
) -> FloatArray:
    """Return half the gradient (n,) of tr(C_0^-1 C) over truck, wheelbase and gains.

    `trucks` and `density` (1 + n, 4) are those of `_displaced_points`.
    """
    road, changing = problem.mismatch, _truck_and_gains(problem)
    force = REDUCED_WEIGHT_FACTOR * problem.force
    slope = np.zeros(layout(problem).gains.stop)
    for part in parts_of(road, row_count(problem.rows, problem.crossing.rows)):
        profile_noise = part.mismatch if road.level_m3.any() else None
        power = noise_power(problem.rows, trucks, density, force, changing, profile_noise)
        slope[changing] += 0.5 * part.residuals * power / _SLOPE_STEP
    return slope


def _truck_and_gains(problem: PosteriorProblem) -> list[int]:
    """Return the indices in y of truck, wheelbase and gains, which change the noise."""
    where = layout(problem)
    truck = int(problem.priors.estimated[:FIRST_OF_BRIDGE].sum())
    return [*range(truck), *range(where.wheelbase, where.gains.stop)]


def replace_mismatch(
    problem: PosteriorProblem, y: FloatArray, mismatch: Mismatch | None, runs: float = 1.0
) -> PosteriorProblem:
    """Return the problem with another mismatch, or none, in its noise at y (f,).

    The noise from a tandem's front axles has `runs` times its power.
    """
    truck, density = noise_path_at(problem, y)
    noise = whitener(
        problem.rows,
        row_count(problem.rows, problem.crossing.rows),
        truck,
        density,
        REDUCED_WEIGHT_FACTOR * problem.force,
        mismatch,
    )
    front_axles = front_axles_response(problem, y)
    return problem._replace(noise=_with_local_noise(problem, y, noise, front_axles, runs))


def _with_local_noise(
    problem: PosteriorProblem,
    y: FloatArray,
    noise: Whitener,
    front_axles: FrontAxlesResponse | None,
    runs: float = 1.0,
) -> Whitener:
    """Return the whitener that removes lines and joints, with the noise of front axles."""
    noise = _without_lines(problem, noise)
    if problem.mismatch.level_m3.any():
        noise = without_joints(problem, y, noise)
    return without_front_axles(problem, front_axles, noise, runs)


def strongest_line_at_hz(problem: PosteriorProblem, y: FloatArray) -> float:
    """Return the clearest line's frequency in Hz in the residuals at y (f,), 0 without any."""
    white = data_rows(problem, y[None, :])[0].reshape(-1, RESIDUALS)
    if not np.isfinite(white).all():
        return 0.0
    return lines.strongest_line_hz(white, problem.rows.every * problem.rows.step_s)


def with_line(problem: PosteriorProblem, y: FloatArray, line_hz: float) -> PosteriorProblem:
    """Return the problem, before a search from y (f,), with one more line removed."""
    all_hz = (*problem.lines_hz, line_hz)
    count = row_count(problem.rows, problem.crossing.rows)
    line_waves = lines.line_waves(all_hz, count, problem.rows.every * problem.rows.step_s)
    one_road = np.zeros_like(problem.mismatch.level_m3)
    problem = problem._replace(lines_hz=all_hz, line_waves=line_waves)
    return update_noise(problem, y, no_suspension_noise(), mismatch=one_road)


def lines_hz(problem: PosteriorProblem) -> list[float]:
    """Return the frequencies in Hz, in the sensors' signals, of the removed lines."""
    crossing, rows = problem.crossing, problem.rows
    signals = np.ascontiguousarray(crossing.signals[:, A])
    apart_s = rows.every * rows.step_s
    return [lines.unfolded_hz(signals, rows.step_s, apart_s, hz) for hz in problem.lines_hz]


def with_lines_of(
    problem: PosteriorProblem, y: FloatArray, sensors_hz: Sequence[float]
) -> PosteriorProblem:
    """Return the problem at y (f,) with lines at the sensor frequencies removed."""
    apart_s = problem.rows.every * problem.rows.step_s
    for hz in sensors_hz:
        problem = with_line(problem, y, lines.folded_hz(hz, apart_s))
    return problem


def _without_lines(problem: PosteriorProblem, noise: Whitener) -> Whitener:
    """Return the whitener with the whitened columns that remove the problem's lines."""
    if not problem.lines_hz:
        return noise
    line_waves = problem.line_waves
    columns = np.zeros((line_waves.shape[1], RESIDUALS, RESIDUALS * line_waves.shape[0]))
    for kind in range(RESIDUALS):
        columns[:, kind, kind::RESIDUALS] = line_waves.T
    white = columns.reshape(-1, columns.shape[2])
    for column in white:
        solve(noise.factor, noise.reciprocal, column)
    return noise._replace(lines=np.ascontiguousarray(np.linalg.qr(white.T)[0]))


def _displaced_points(
    problem: PosteriorProblem, y: FloatArray, count: int, *, is_inertial: bool
) -> tuple[EvaluationPoints, list[NoisePath]]:
    """Return 1 + `count` points and noise paths: at y, and a step along each first coordinate."""
    near = np.repeat(y[None, :], 1 + count, axis=0)
    near[np.arange(1, 1 + count), np.arange(count)] += _SLOPE_STEP
    at = points(problem, near)
    total, tandem = problem.crossing.total_mass_kg, problem.crossing.tandem
    speed = problem.mismatch.speed_m_per_s
    return at, [
        noise_path(theta, total, float(wheelbase), is_inertial, tandem, speed)
        for theta, wheelbase in zip(at.theta, at.wheelbase_m, strict=True)
    ]


def mismatch_gradient(problem: PosteriorProblem, y: FloatArray) -> FloatArray:
    """Return the part of the gradient at `y` (f,) that the mismatch causes, shape (n,)."""
    where, crossing = layout(problem), problem.crossing
    is_inertial = bool(problem.force.any())
    at, trucks = _displaced_points(problem, y, where.delays.stop, is_inertial=is_inertial)
    estimated = problem.priors.estimated
    changing = [*_truck_and_gains(problem), *range(where.delays.start, where.delays.stop)]
    if estimated[TORSION]:
        changing.append(int(estimated[:TORSION].sum()))
    some = [0, *(1 + k for k in changing)]
    channels = GainsAndDelays(at.gain[some], at.delay_s[some])
    slope = np.zeros(where.delays.stop)
    count = row_count(problem.rows, crossing.rows)
    for part in parts_of(problem.mismatch, count):
        deck = crossing.torsion if part.is_bridge else NO_TORSION
        power = mismatch_power(
            problem.rows,
            [trucks[k] for k in some],
            channels,
            problem.density * (1.0 + at.gain[0]),
            REDUCED_WEIGHT_FACTOR * problem.force,
            ComparedStretch(part.mismatch, float(at.wheelbase_m[0]), deck),
        )
        slope[changing] += part.residuals * power / _SLOPE_STEP
    return slope


def to_standardised(priors: Priors, theta: FloatArray) -> FloatArray:
    """Return the coordinates (t,) in y of values (p,) of estimated truck and bridge parameters."""
    values = np.zeros(theta.size)
    logs = np.flatnonzero(priors.estimated & ~priors.half_normal)
    values[logs] = np.log(theta[logs] / priors.theta[logs]) / priors.spread[logs]
    zero = np.flatnonzero(priors.estimated & priors.half_normal)
    values[zero] = theta[zero] / priors.spread[zero]
    return values[priors.estimated]
