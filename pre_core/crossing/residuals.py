"""The residuals of one crossing at given parameters: profile mismatch and two body equations.

Everything that method `pre` estimates may change here from one evaluation to the next: truck,
bridge, wheelbase, trajectory, and each channel's gain, delay, initial state and bias. Residuals
follow the samples of the rear wheel: residual n compares the profile under the rear wheel at sample
n with that under the front wheel at the same place; the front body equation is evaluated at that
time too, so that the noise of all three is in phase. All of it happens at the model's own rate
(channels.py), in which every signal is smooth; the residuals are then whitened (whitening.py).
"""

from collections.abc import Callable
from threading import Thread

import numpy as np
from numpy.typing import NDArray

from pre_core.arrays import FloatArray
from pre_core.crossing import tandem
from pre_core.crossing.arguments import Buffers, EvaluationPoints, GriddedCrossing
from pre_core.crossing.channels import A_1, A_2, A_3, A, V, Z
from pre_core.crossing.deflection import add_deflection, update_modes
from pre_core.crossing.rows import RESIDUALS, RowFilter
from pre_core.crossing.step_tables import PHASES as _PHASES
from pre_core.crossing.step_tables import SINC_TAPS as _SINC_TAPS
from pre_core.crossing.suspension_noise import REDUCED_WEIGHT_SPRING_N_PER_M
from pre_core.crossing.tyre_damping import add_tyre_damping
from pre_core.crossing.whitening import Whitener, project_out_noise, whiten_into
from pre_core.kernels.lanes import inner, kernel, summing
from pre_core.parameters import C_S1, C_U1, D_1, K_S1, K_U1, KAPPA, M_U1
from pre_core.physics.vehicle import masses_above_axles, masses_on_axles

_FEW = 4  # points that are not worth starting a thread
_WHITE, _PLAIN, _DEFLECTIONS = range(3)
"""Outputs of `_evaluate`: whitened (3 m or more,), residuals (3 rows,), or deflections (2 n,)."""
_NOTHING = np.zeros(0)
_NO_ROWS = RowFilter(_NOTHING, 1, 0.0, _NOTHING, _NOTHING, np.zeros((0, 0), dtype=np.complex128))
_NO_FILTERS = (_NO_ROWS, Whitener(np.zeros((0, 0)), _NOTHING))


@inner
def _correct(
    signals: FloatArray,
    step: float,
    gain: FloatArray,
    delay: FloatArray,
    initial: FloatArray,
    out: FloatArray,
) -> None:
    """Compute displacement, velocity and acceleration (4, 3, n) above and on the axles."""
    n = signals.shape[2]
    middle = n // 2
    for c in range(4):
        g = 1.0 + gain[c]
        d = delay[c]
        d1, d2, d3 = g * d, g * 0.5 * d * d, g * d * d * d / 6.0
        z0, v0, b = initial[c, 0], initial[c, 1], initial[c, 2]
        z, v, a = signals[c, Z], signals[c, V], signals[c, A]
        a1, a2, a3 = signals[c, A_1], signals[c, A_2], signals[c, A_3]
        out_z, out_v, out_a = out[c, 0], out[c, 1], out[c, 2]
        # One store a loop: more keep the compiler from using the vector registers.
        for i in range(n):
            t = step * (i - middle)
            out_z[i] = g * z[i] + d1 * v[i] + d2 * a[i] + d3 * a1[i] + z0 + t * (v0 + 0.5 * b * t)
        for i in range(n):
            t = step * (i - middle)
            out_v[i] = g * v[i] + d1 * a[i] + d2 * a1[i] + d3 * a2[i] + v0 + b * t
        for i in range(n):
            out_a[i] = g * a[i] + d1 * a1[i] + d2 * a2[i] + d3 * a3[i] + b


@inner
def _wheels(
    crossing: GriddedCrossing,
    work: Buffers,
    theta: FloatArray,
    wheelbase: float,
    gravity: float,
    speeding: FloatArray,
) -> None:
    """Compute `road` (minus the profile), `load` and `body`; `gravity` is 1/common gain."""
    m_s = crossing.total_mass_kg - theta[M_U1] - theta[M_U1 + 1]
    m_11, m_22, m_12 = masses_above_axles(m_s, theta[D_1], wheelbase, theta[KAPPA])
    on_axles = masses_on_axles(m_s, theta[D_1], wheelbase, theta[M_U1], theta[M_U1 + 1])
    transfer = crossing.total_mass_kg * crossing.cg_height_m / wheelbase * gravity
    n = work.road.shape[1]
    step = crossing.step_s
    for w in range(2):
        sign = 1.0 - 2.0 * w
        m_ii = m_11 if w == 0 else m_22
        m_u = theta[M_U1 + w]
        c, k, k_u = theta[C_S1 + w], theta[K_S1 + w], theta[K_U1 + w]
        weight = gravity * crossing.gravity_m_per_s2 * on_axles[w]
        z_s, v_s, a_s = work.corrected[w, 0], work.corrected[w, 1], work.corrected[w, 2]
        z_u, v_u, a_u = work.corrected[2 + w, 0], work.corrected[2 + w, 1], work.corrected[2 + w, 2]
        a_other = work.corrected[1 - w, 2]
        road, load, body = work.road[w], work.load[w], work.body[w]
        soft = 1.0 / k_u
        hard = 1.0 / REDUCED_WEIGHT_SPRING_N_PER_M if crossing.is_inertial else 1.0 / k
        for i in range(n):
            inertial = m_ii * a_s[i] + m_12 * a_other[i]
            load[i] = sign * transfer * speeding[i] - weight - inertial - m_u * a_u[i]
        # The tyre force accelerates the masses above it, whatever springs are between; where these
        # are linear, they give the same with far less noise of the body sensors.
        force = work.precompensated[w]  # written later, by `precompensate_force`
        if crossing.is_inertial:
            for i in range(n):
                force[i] = -load[i] - weight
        else:
            for i in range(n):
                force[i] = m_u * a_u[i] + c * (v_u[i] - v_s[i]) + k * (z_u[i] - z_s[i])
        for i in range(n):
            road[i] = -z_u[i] - force[i] * soft
        add_tyre_damping(force, theta[C_U1 + w] / k_u / step, soft, road)
        for i in range(n):
            spring = c * (v_u[i] - v_s[i]) + k * (z_u[i] - z_s[i])
            inertial = m_ii * a_s[i] + m_12 * a_other[i]
            body[i] = (inertial - spring - sign * transfer * speeding[i]) * hard


@inner
def _locate(crossing: GriddedCrossing, work: Buffers, front: FloatArray, wheelbase: float) -> None:
    edges = crossing.edges_m
    parts = edges.size - 1
    n = front.size
    for w in range(work.part.shape[0]):
        offset = 0.0 if w == 0 else -crossing.direction * wheelbase
        if w >= 2:
            offset = crossing.direction * crossing.tandem.front.ahead_m[w - 2]
        e = 0 if crossing.direction > 0 else parts - 1
        for i in range(n):
            x = front[i] + offset
            if x < 0.0 or x > edges[parts]:
                work.part[w, i] = -1
                work.place[w, i] = 0.0
                continue
            while e < parts - 1 and x > edges[e + 1]:
                e += 1
            while e > 0 and x < edges[e]:
                e -= 1
            work.part[w, i] = e
            work.place[w, i] = (x - edges[e]) / (edges[e + 1] - edges[e])


@inner
def _locate_front_sample(
    crossing: GriddedCrossing,
    front: FloatArray,
    wheelbase: float,
    begin: NDArray[np.int64],
    between: FloatArray,
) -> bool:
    """Find when the front wheel was at the rear wheel's place; return False if it is unknown.

    Outputs by residual: first weighted sample (`begin`), place between its neighbours (`between`).
    """
    sign = 1.0 if crossing.direction > 0 else -1.0
    n = front.size
    ahead = _SINC_TAPS // 2
    j = ahead - 1
    for row in range(begin.size):
        i = crossing.first_row + row
        wanted = sign * front[i] - wheelbase
        while j < n - ahead - 1 and sign * front[j + 1] < wanted:
            j += 1
        x1, x2 = sign * front[j], sign * front[j + 1]
        if not (x1 <= wanted <= x2) or x2 <= x1:
            return False
        # Inverse of the parabola through the four samples around, to first order in its curvature,
        # which is a few thousandths of its slope; the neglected terms are a millionth of a sample.
        slope = 1.0 / (x2 - x1)
        f = (wanted - x1) * slope
        curvature = 0.5 * (sign * (front[j + 2] + front[j - 1]) - x1 - x2) * slope
        f -= 0.5 * f * (f - 1.0) * curvature
        begin[row] = j - ahead + 1
        between[row] = min(max(f, 0.0), 1.0)
    return True


@summing
def _read(
    sinc: FloatArray, place: float, begin: int, wheel: int, road: FloatArray, body: FloatArray
) -> tuple[float, float]:
    """Return `road` and `body` (2, n) of a wheel at `place` (0 to 1) between the middle two taps.

    Samples start at `begin`. Indices are unsigned: with signed ones every access would test for
    counting from the end, and the compiler would not use the vector registers, four times as slow.
    """
    phase = min(int(place * _PHASES), _PHASES - 1)
    share = place * _PHASES - phase
    low, first, w = np.uintp(phase), np.uintp(begin), np.uintp(wheel)
    high = low + np.uintp(1)
    rest = 1.0 - share
    value_high = share * share * (3.0 - 2.0 * share)
    value_low = 1.0 - value_high
    slope_low = share * rest * rest
    slope_high = -share * share * rest
    sum_road = sum_body = 0.0
    for k in range(np.uintp(_SINC_TAPS)):
        weight = (value_low * sinc[low, 0, k] + value_high * sinc[high, 0, k]) + (
            slope_low * sinc[low, 1, k] + slope_high * sinc[high, 1, k]
        )
        sum_road += weight * road[w, first + k]
        sum_body += weight * body[w, first + k]
    return sum_road, sum_body


@inner
def _compare(crossing: GriddedCrossing, work: Buffers, out: FloatArray) -> None:
    """Write all residuals to `out` (3, rows), at the times of `_locate_front_sample`."""
    road, body = work.road, work.body
    first = np.uintp(crossing.first_row)
    for row in range(np.uintp(crossing.rows)):
        front_road, front_body = _read(
            crossing.sinc, work.between[row], work.begin[row], 0, road, body
        )
        out[0, row] = road[1, first + row] - front_road  # both hold y - u, minus the road
        out[1, row] = front_body
        out[2, row] = body[1, first + row]


@kernel
def _evaluate(
    crossing: GriddedCrossing,
    filters: tuple[RowFilter, Whitener],
    work: Buffers,
    points: EvaluationPoints,
    part: tuple[int, int],
    output: int,
    out: FloatArray,
) -> None:
    """Write the `output` of points `part[0]` to `part[1]` to `out`, NaN for impossible ones.

    One kernel serves all three outputs: three kernels would each contain a copy of the model and
    take as long to load.
    """
    rows, noise = filters
    for k in range(part[0], part[1]):
        row = out[k]
        if not (
            _is_possible(points.theta[k], points.wheelbase_m[k], crossing.tandem.readings_apart_m)
            and _roads(crossing, work, points, k)
        ):
            row[:] = np.nan
            continue
        road = work.road.reshape(work.road.size)
        if output == _DEFLECTIONS:
            for i in range(row.size):
                row[i] = road[i]
        elif not _locate_front_sample(
            crossing, points.position_m[k], points.wheelbase_m[k], work.begin, work.between
        ):
            row[:] = np.nan
            continue
        add_deflection(crossing, work, points, k)
        if output == _DEFLECTIONS:
            for i in range(row.size):
                row[i] = road[i] - row[i]
            continue
        _compare(crossing, work, work.residual)
        if output == _PLAIN:
            residual = work.residual.reshape(work.residual.size)
            for i in range(row.size):
                row[i] = residual[i]
        else:
            whiten_into(rows, noise, work.residual, work.row, row[: noise.reciprocal.size])


@inner
def _is_possible(theta: FloatArray, wheelbase_m: float, readings_apart_m: float) -> bool:
    for i in range(theta.size):
        if not np.isfinite(theta[i]):
            return False
    return theta[D_1] < max(wheelbase_m, readings_apart_m)


@inner
def _roads(crossing: GriddedCrossing, work: Buffers, points: EvaluationPoints, k: int) -> bool:
    """Compute the work arrays of point k up to the deflection; return False if impossible."""
    _correct(
        crossing.signals,
        crossing.step_s,
        points.gain[k],
        points.delay_s[k],
        points.initial[k],
        work.corrected,
    )
    gravity = 1.0 / points.common_gain[k]
    speeding = points.acceleration_m_per_s2[k]
    if work.part.shape[0] > 2:
        gap = points.wheelbase_m[k]
        tandem.wheels(crossing, work, points.theta[k], gap, gravity, speeding)
    else:
        _wheels(crossing, work, points.theta[k], points.wheelbase_m[k], gravity, speeding)
    _locate(crossing, work, points.position_m[k], points.wheelbase_m[k])
    return update_modes(crossing, work, points.theta[k])


def evaluate(
    crossing: GriddedCrossing, works: tuple[Buffers, ...], points: EvaluationPoints
) -> FloatArray:
    """Return residuals (k, 3, rows) in m: R_1 - R_2, front and rear body equation over k_s.

    NaN for an impossible point or a trajectory that turns back. `works`: one per thread.
    """
    out = np.empty((points.theta.shape[0], RESIDUALS * crossing.rows))

    def part(work: Buffers, begin: int, stop: int) -> None:
        _evaluate(crossing, _NO_FILTERS, work, points, (begin, stop), _PLAIN, out)

    _in_threads(part, works, out.shape[0])
    return out.reshape(-1, RESIDUALS, crossing.rows)


def evaluate_white(
    crossing: GriddedCrossing,
    rows: RowFilter,
    noise: Whitener,
    works: tuple[Buffers, ...],
    points: EvaluationPoints,
    out: FloatArray,
) -> None:
    """Write whitened residuals to the first 3 m columns of `out` (k, 3 m or more).

    Impossible points are NaN, as in `evaluate`.
    """

    def part(work: Buffers, begin: int, stop: int) -> None:
        _evaluate(crossing, (rows, noise), work, points, (begin, stop), _WHITE, out)

    _in_threads(part, works, out.shape[0])
    if noise.lines.size or noise.low_rank.size:
        white = out[:, : noise.reciprocal.size]
        white[:] = project_out_noise(noise, white)


def _in_threads(
    part: Callable[[Buffers, int, int], None],
    works: tuple[Buffers, ...],
    count: int,
) -> None:
    if count < _FEW or len(works) == 1:
        part(works[0], 0, count)
        return
    bounds = [count * i // len(works) for i in range(len(works) + 1)]
    others = [
        Thread(target=part, args=(works[i], bounds[i], bounds[i + 1])) for i in range(1, len(works))
    ]
    for thread in others:
        thread.start()
    part(works[0], 0, bounds[1])
    for thread in others:
        thread.join()


def roads_and_deflections(
    crossing: GriddedCrossing, work: Buffers, points: EvaluationPoints, k: int
) -> tuple[FloatArray, FloatArray]:
    """Return profile heights (2, n) in m under both wheels at every sample, and deflections (2, n).

    Raise FloatingPointError for an impossible point.
    """
    deflection = _deflections(crossing, work, points, k)
    if np.isnan(deflection[0, 0]):
        raise FloatingPointError("the bridge of this point has no modes")
    gain = points.common_gain[k]
    return -gain * work.road, gain * deflection


def largest_deflections(
    crossing: GriddedCrossing, works: tuple[Buffers, ...], points: EvaluationPoints
) -> FloatArray:
    """Return the largest deflection (k,) in m under a wheel, down positive; NaN if impossible."""
    out = np.empty(points.theta.shape[0])

    def part(work: Buffers, begin: int, stop: int) -> None:
        for k in range(begin, stop):
            out[k] = -_deflections(crossing, work, points, k).min()

    _in_threads(part, works, out.size)
    return points.common_gain * out


def _deflections(
    crossing: GriddedCrossing, work: Buffers, points: EvaluationPoints, k: int
) -> FloatArray:
    """Return deflections (2, n) of point k, up positive, or NaN; leave -profiles in `work.road`."""
    one = EvaluationPoints(*(of[k : k + 1] for of in points))
    out = np.empty((1, work.road.size))
    _evaluate(crossing, _NO_FILTERS, work, one, (0, 1), _DEFLECTIONS, out)
    return out.reshape(work.road.shape)
