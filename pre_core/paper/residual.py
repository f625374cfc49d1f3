"""The paper's residual: the road under the front wheel minus the road under the rear wheel.

r_i = u_i - y_i (input profile minus deflection) at each wheel; R_1(x) - R_2(x) vanishes for the
right parameters, and J = integral of (R_1 - R_2)^2 dx (paper eq. 21). A `PaperWindow` (`window`)
holds everything that does not depend on the parameters.
"""

from typing import NamedTuple

import numpy as np

from pre_core.arrays import FloatArray
from pre_core.kernels.lanes import (
    LANES,
    fma,
    fma_scalar,
    inner,
    kernel,
    load,
    mul,
    scale,
    store,
    sub,
)
from pre_core.paper.iep import iep_factors, input_profiles
from pre_core.paper.window import LONGEST_STRETCH, PaperWindow
from pre_core.parameters import D_1, KAPPA, M_U1
from pre_core.physics.beam_basis import (
    ModalFilters,
    WheelStretch,
    advance,
    modal_filters,
    modal_filters_one,
)
from pre_core.physics.vehicle import masses_above_axles, masses_on_axles


class Workspace(NamedTuple):
    """Work arrays of one thread; modified in place."""

    matrix: FloatArray  # (m, m, 4)
    vectors: FloatArray  # (m, m, 4)
    cubics: FloatArray  # (n, m, 4, 4)
    feedback: FloatArray  # (m, 2, 4)
    state: FloatArray  # (m, 2, 4)
    force: FloatArray  # (2, stretch, 4)
    road: FloatArray  # (2, n, 4): minus the two road profiles
    projection: FloatArray  # (q, 4): inner products of the residuals and the nuisance columns


def workspace(window: PaperWindow) -> Workspace:
    """Allocate the work arrays for this window."""
    elements, _, m = window.basis.cubics.shape
    return Workspace(
        np.zeros((m, m, LANES)),
        np.zeros((m, m, LANES)),
        np.zeros((elements, m, 4, LANES)),
        np.zeros((m, 2, LANES)),
        np.zeros((m, 2, LANES)),
        np.zeros((2, LONGEST_STRETCH, LANES)),
        np.zeros((2, window.signals.shape[2], LANES)),
        np.zeros((window.nuisance.shape[1], LANES)),
    )


@inner
def _vehicle_factors(
    theta: FloatArray, total_mass: float, wheelbase: float, gravity: float, out: FloatArray
) -> None:
    """Write minus IEP factors (6), loads (2), m_11, m_22, m_12, m_u1, m_u2 to `out` (13, 4)."""
    for lane in range(LANES):
        p = theta[lane]
        m_s = total_mass - p[M_U1] - p[M_U1 + 1]
        for w in range(2):
            mass, damping, stiffness = iep_factors(p, w)
            out[3 * w, lane], out[3 * w + 1, lane], out[3 * w + 2, lane] = (
                -mass,
                -damping,
                -stiffness,
            )
        on_front, on_rear = masses_on_axles(m_s, p[D_1], wheelbase, p[M_U1], p[M_U1 + 1])
        out[6, lane] = gravity * on_front
        out[7, lane] = gravity * on_rear
        m_11, m_22, m_12 = masses_above_axles(m_s, p[D_1], wheelbase, p[KAPPA])
        out[8, lane] = m_11
        out[9, lane] = m_22
        out[10, lane] = m_12
        out[11, lane] = p[M_U1]
        out[12, lane] = p[M_U1 + 1]


@inner
def _march_stretch(
    window: PaperWindow,
    work: Workspace,
    factors: FloatArray,
    begin: int,
    stop: int,
    element_front: int,
    element_rear: int,
) -> None:
    """Write minus the road under both wheels, y - u, of one stretch to `work.road`."""
    a = window.acceleration
    s = window.signals
    u1, c1, k1 = load(factors, 0), load(factors, 1), load(factors, 2)
    u2, c2, k2 = load(factors, 3), load(factors, 4), load(factors, 5)
    w1, w2 = load(factors, 6), load(factors, 7)
    m11, m22, m12 = load(factors, 8), load(factors, 9), load(factors, 10)
    mu1, mu2 = load(factors, 11), load(factors, 12)
    front, rear = work.road[0], work.road[1]
    p1, p2 = work.force[0], work.force[1]
    one = (1.0, 1.0, 1.0, 1.0)
    for n in range(begin, stop):
        r = fma_scalar(u1, s[0, 1, n], fma_scalar(c1, s[0, 2, n], scale(k1, s[0, 3, n])))
        store(front, n, fma_scalar(one, -s[0, 0, n], r))
        r = fma_scalar(u2, s[1, 1, n], fma_scalar(c2, s[1, 2, n], scale(k2, s[1, 3, n])))
        store(rear, n, fma_scalar(one, -s[1, 0, n], r))
        t = window.load_transfer_n[n]
        f = fma_scalar(m11, a[0, n], fma_scalar(m12, a[1, n], fma_scalar(mu1, a[2, n], w1)))
        store(p1, n - begin, (t - f[0], t - f[1], t - f[2], t - f[3]))
        f = fma_scalar(m22, a[1, n], fma_scalar(m12, a[0, n], fma_scalar(mu2, a[3, n], w2)))
        store(p2, n - begin, (-t - f[0], -t - f[1], -t - f[2], -t - f[3]))
    filters = ModalFilters(work.cubics, work.feedback, work.state)
    advance(filters, _wheels(window, work, begin, stop, element_front, element_rear))


@inner
def _wheels(
    window: PaperWindow, work: Workspace, begin: int, stop: int, front: int, rear: int
) -> WheelStretch:
    """Return a stretch of both wheels, in the parts `front` and `rear`, over `work.road`."""
    return WheelStretch(
        front,
        rear,
        window.place[0, begin:stop],
        window.place[1, begin:stop],
        work.force,
        work.road[0, begin:stop],
        work.road[1, begin:stop],
    )


@inner
def _all_beyond(values: tuple[float, float, float, float], limit: FloatArray) -> bool:
    beyond = True
    for lane in range(LANES):
        beyond = beyond and values[lane] > limit[lane]
    return beyond


@kernel
def march_four(
    window: PaperWindow, work: Workspace, theta: FloatArray, limit: FloatArray, total: FloatArray
) -> None:
    """Write J of four vectors `theta` (4, p) to `total` (4,), and minus the roads to `work.road`.

    Without nuisance columns an evaluation stops early once the J of every vector exceeds its
    `limit` (4,). This decides a comparison J <= limit exactly; `total` then exceeds the limit.
    Where J is not finite, `total` is infinite.
    """
    total[:] = np.inf
    for i in range(theta.shape[0]):
        for j in range(theta.shape[1]):
            if not np.isfinite(theta[i, j]):
                return
    basis = window.basis
    if not modal_filters(
        basis, theta, window.step_s, work.matrix, work.vectors, work.cubics, work.feedback
    ):
        return
    factors = np.empty((13, LANES))
    _vehicle_factors(
        theta, window.total_mass_kg, window.wheelbase_m, window.gravity_m_per_s2, factors
    )
    work.state[:] = 0.0
    work.projection[:] = 0.0
    columns = window.nuisance.shape[1]
    front, rear = work.road[0], work.road[1]
    rows = window.front_sample.size
    squares = (0.0, 0.0, 0.0, 0.0)
    for part in range(window.stretches.shape[0]):
        begin, stop, e1, e2 = window.stretches[part]
        _march_stretch(window, work, factors, begin, stop, e1, e2)
        for row in range(max(0, begin - window.first_row), min(rows, stop - window.first_row)):
            n = window.front_sample[row]
            w = window.front_weight[row]
            r = fma_scalar(load(front, n), -w[0], load(rear, row + window.first_row))
            r = fma_scalar(load(front, n + 1), -w[1], r)
            r = fma_scalar(load(front, n + 2), -w[2], r)
            r = scale(fma_scalar(load(front, n + 3), -w[3], r), window.row_weight[row])
            squares = fma(r, r, squares)
            for q in range(columns):
                projection = fma_scalar(r, window.nuisance[row, q], load(work.projection, q))
                store(work.projection, q, projection)
        if columns == 0 and _all_beyond(squares, limit):
            break
    for q in range(columns):
        projection = load(work.projection, q)
        squares = sub(squares, mul(projection, projection))
    for lane in range(LANES):
        if np.isfinite(squares[lane]):
            total[lane] = squares[lane]


@inner
def _rows(window: PaperWindow, road: FloatArray, lane: int, out: FloatArray) -> None:
    """Write weighted residuals of one vector to `out` (m,), nuisance columns not yet removed."""
    front, rear = road[0], road[1]
    for row in range(out.size):
        n = window.front_sample[row]
        r = rear[row + window.first_row, lane]
        for j in range(4):
            r -= window.front_weight[row, j] * front[n + j, lane]
        out[row] = r * window.row_weight[row]


@kernel
def objective_batch(
    window: PaperWindow, work: Workspace, theta: FloatArray, limit: FloatArray, total: FloatArray
) -> None:
    """Compute J of many vectors by fours: `theta` (k, p), `limit` (k,), output `total` (k,)."""
    count = theta.shape[0]
    four = np.empty((LANES, theta.shape[1]))
    four_limit = np.empty(LANES)
    four_total = np.empty(LANES)
    for begin in range(0, count, LANES):
        for lane in range(LANES):
            source = min(begin + lane, count - 1)
            for i in range(theta.shape[1]):
                four[lane, i] = theta[source, i]
            four_limit[lane] = limit[source]
        march_four(window, work, four, four_limit, four_total)
        for lane in range(min(LANES, count - begin)):
            total[begin + lane] = four_total[lane]


@kernel
def _residual_batch(
    window: PaperWindow, work: Workspace, theta: FloatArray, out: FloatArray
) -> None:
    count = theta.shape[0]
    four = np.empty((LANES, theta.shape[1]))
    no_limit = np.full(LANES, np.inf)
    for begin in range(0, count, LANES):
        for lane in range(LANES):
            source = min(begin + lane, count - 1)
            for i in range(theta.shape[1]):
                four[lane, i] = theta[source, i]
        totals = np.empty(LANES)
        march_four(window, work, four, no_limit, totals)
        for lane in range(min(LANES, count - begin)):
            if np.isfinite(totals[lane]):
                _rows(window, work.road, lane, out[begin + lane])
            else:
                out[begin + lane] = np.nan


def residual_batch(window: PaperWindow, work: Workspace, theta: FloatArray) -> FloatArray:
    """Return weighted residuals (k, m) of vectors (k, p), NaN if not finite; squares sum to J."""
    theta = np.ascontiguousarray(theta)
    out = np.empty((theta.shape[0], window.front_sample.size))
    _residual_batch(window, work, theta, out)
    if window.nuisance.shape[1]:
        out -= (out @ window.nuisance) @ window.nuisance.T
    return out


@kernel
def objective(window: PaperWindow, work: Workspace, theta: FloatArray) -> float:
    """Return J of one vector (p,), faster than a batch of one: modes share the lanes."""
    if not np.all(np.isfinite(theta)):
        return np.inf
    basis = window.basis
    elements, modes = work.cubics.shape[0], work.cubics.shape[1]
    groups = (modes + LANES - 1) // LANES
    cubics = np.empty((elements, groups, 4, LANES))
    feedback = np.empty((groups, 2, LANES))
    matrix = np.empty((modes, modes))
    vectors = np.empty((modes, modes))
    if not modal_filters_one(
        basis,
        theta,
        window.step_s,
        matrix,
        vectors,
        cubics,
        feedback,
    ):
        return np.inf
    filters = ModalFilters(cubics, feedback, work.state)
    four = np.empty((LANES, theta.size))
    for lane in range(LANES):
        for i in range(theta.size):
            four[lane, i] = theta[i]
    scratch = np.empty((2, LONGEST_STRETCH))
    factors = np.empty((13, LANES))
    _vehicle_factors(
        four, window.total_mass_kg, window.wheelbase_m, window.gravity_m_per_s2, factors
    )
    work.state[:] = 0.0
    work.projection[:] = 0.0
    columns = window.nuisance.shape[1]
    rows = window.front_sample.size
    total = 0.0
    front, rear = work.road[0], work.road[1]
    for part in range(window.stretches.shape[0]):
        begin, stop, e1, e2 = window.stretches[part]
        _one_vector_stretch(window, work, factors, begin, stop, scratch)
        advance(filters, _wheels(window, work, begin, stop, e1, e2))
        for n in range(begin, stop):
            front[n, 0] = (front[n, 0] + front[n, 1]) + (front[n, 2] + front[n, 3])
            rear[n, 0] = (rear[n, 0] + rear[n, 1]) + (rear[n, 2] + rear[n, 3])
        for row in range(max(0, begin - window.first_row), min(rows, stop - window.first_row)):
            n = window.front_sample[row]
            w = window.front_weight[row]
            r = w[0] * front[n, 0] + w[1] * front[n + 1, 0]
            r += w[2] * front[n + 2, 0] + w[3] * front[n + 3, 0]
            r = (r - rear[row + window.first_row, 0]) * window.row_weight[row]
            total += r * r
            for q in range(columns):
                work.projection[q, 0] += window.nuisance[row, q] * r
    for q in range(columns):
        total -= work.projection[q, 0] ** 2
    return total if np.isfinite(total) else np.inf


@inner
def _one_vector_stretch(
    window: PaperWindow,
    work: Workspace,
    factors: FloatArray,
    begin: int,
    stop: int,
    scratch: FloatArray,
) -> None:
    """Write minus the input profiles to lane 0 of `work.road`, forces to all of `work.force`."""
    a = window.acceleration
    s = window.signals
    for w in range(2):
        own, other = a[w], a[1 - w]
        unsprung = a[2 + w]
        z, acceleration, rate, stroke = s[w, 0], s[w, 1], s[w, 2], s[w, 3]
        inertia, damping = factors[3 * w, 0], factors[3 * w + 1, 0]
        stiffness = factors[3 * w + 2, 0]
        load_n, m_own, m_other = factors[6 + w, 0], factors[8 + w, 0], factors[10, 0]
        m_u = factors[11 + w, 0]
        sign = 1.0 - 2.0 * w
        # One store a loop: with more, the compiler gives up proving that the arrays do not overlap
        # and leaves the vector registers unused.
        u, p = scratch[0], scratch[1]
        a_u, rate_w, stroke_w, z_w = (
            acceleration[begin:stop],
            rate[begin:stop],
            stroke[begin:stop],
            z[begin:stop],
        )
        for i in range(a_u.size):
            u[i] = inertia * a_u[i] + damping * rate_w[i] + stiffness * stroke_w[i] - z_w[i]
        own_w, other_w, unsprung_w, transfer = (
            own[begin:stop],
            other[begin:stop],
            unsprung[begin:stop],
            window.load_transfer_n[begin:stop],
        )
        for i in range(own_w.size):
            inertial = m_own * own_w[i] + m_other * other_w[i] + m_u * unsprung_w[i]
            p[i] = sign * transfer[i] - load_n - inertial
        road, force = work.road[w], work.force[w]
        for i in range(stop - begin):
            store(road, begin + i, (u[i], 0.0, 0.0, 0.0))
            store(force, i, (p[i], p[i], p[i], p[i]))


class ImpliedProfiles(NamedTuple):
    """The two road profiles that a parameter vector implies on the bridge."""

    x_m: FloatArray  # (m,)
    front_m: FloatArray  # (m,)
    rear_m: FloatArray  # (m,)


def road_profiles(window: PaperWindow, work: Workspace, theta: FloatArray) -> ImpliedProfiles:
    """Return the profiles under both wheels (m,) at the residuals' chainages, for theta (p,)."""
    four = np.repeat(theta[None, :], LANES, axis=0)
    march_four(window, work, four, np.full(LANES, np.inf), np.empty(LANES))
    front = -work.road[0, :, 0]
    gathered = front[window.front_sample[:, None] + np.arange(4)]
    rear = -work.road[1, window.first_row : window.first_row + window.x_m.size, 0]
    front = np.einsum("mj,mj->m", window.front_weight, gathered)
    return ImpliedProfiles(window.x_m.copy(), front, rear)


def deflections_m(window: PaperWindow, theta: FloatArray) -> FloatArray:
    """Return the deflection (2, n) under front and rear wheel, down positive, for theta (p,)."""
    work = workspace(window)
    four = np.repeat(theta[None, :], LANES, axis=0)
    march_four(window, work, four, np.full(LANES, np.inf), np.empty(LANES))
    # `work.road` holds minus r, and y = u - r.
    return np.asarray(-input_profiles(window.signals, theta) - work.road[:, :, 0])
