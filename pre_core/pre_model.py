"""The residuals of one crossing for one set of unknowns: road mismatch and two body equations.

Everything that method `pre` estimates may change here from one evaluation to the next: truck,
bridge, wheelbase, trajectory, and each channel's gain, delay, initial state and bias. Rows follow
the samples of the rear wheel: row n compares the road under the rear wheel at sample n with the
road under the front wheel when it was at the same place; the front body equation is taken at that
moment too, so that the noise of all three residuals of a row meets at no delay.
"""

from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pre_core.drs import BeamBasis, advance, modal_filters_one
from pre_core.lanes import LANES, kernel
from pre_core.parameters import C_S1, D_1, K_S1, K_U1, KAPPA, M_U1

FloatArray = NDArray[np.float64]

_LONGEST_STRETCH = 128


class Crossing(NamedTuple):
    """The data of one crossing on an even grid of n samples."""

    step_s: float
    signals: FloatArray  # (4, 5, n): see channels.py
    direction: int
    span_m: float
    total_mass_kg: float
    cg_height_m: float
    gravity_m_per_s2: float
    basis: BeamBasis
    edges_m: FloatArray  # (parts + 1,)
    first_row: int
    rows: int
    """Samples first_row … first_row + rows - 1 of the rear wheel are compared."""


class Points(NamedTuple):
    """k points at which to evaluate; see `evaluate`."""

    theta: FloatArray  # (k, p): truck and bridge, as in parameters.py
    wheelbase_m: FloatArray  # (k,)
    position_m: FloatArray  # (k, n): chainage of the front axle
    acceleration_m_per_s2: FloatArray  # (k, n): positive when speeding up
    gain: FloatArray  # (k, 4): relative corrections
    delay_s: FloatArray  # (k, 4): corrections, read from Taylor's series
    initial: FloatArray  # (k, 4, 3): displacement, velocity, bias to be added


class Work(NamedTuple):
    """Work arrays of one thread; modified in place."""

    matrix: FloatArray  # (m, m)
    vectors: FloatArray  # (m, m)
    cubics: FloatArray  # (parts, groups, 4, 4)
    feedback: FloatArray  # (groups, 2, 4)
    state: FloatArray  # (groups, 2, 4)
    force: FloatArray  # (2, stretch, 4)
    lanes: FloatArray  # (2, stretch, 4)
    place: FloatArray  # (2, n)
    part: NDArray[np.int64]  # (2, n)
    corrected: FloatArray  # (4, 3, n)
    load: FloatArray  # (2, n)
    road: FloatArray  # (2, n)
    body: FloatArray  # (2, n)
    modes_of: FloatArray  # (p,) the bridge whose modes are in `cubics`


def workspace(crossing: Crossing, parameters: int) -> Work:
    """Allocate for this crossing."""
    parts, _, m = crossing.basis.cubics.shape
    groups = (m + LANES - 1) // LANES
    n = crossing.signals.shape[2]
    return Work(
        np.zeros((m, m)),
        np.zeros((m, m)),
        np.zeros((parts, groups, 4, LANES)),
        np.zeros((groups, 2, LANES)),
        np.zeros((groups, 2, LANES)),
        np.zeros((2, _LONGEST_STRETCH, LANES)),
        np.zeros((2, _LONGEST_STRETCH, LANES)),
        np.zeros((2, n)),
        np.zeros((2, n), dtype=np.int64),
        np.zeros((4, 3, n)),
        np.zeros((2, n)),
        np.zeros((2, n)),
        np.zeros((2, n)),
        np.full(parameters, np.nan),
    )


@kernel
def _correct(
    signals: FloatArray,
    step: float,
    gain: FloatArray,
    delay: FloatArray,
    initial: FloatArray,
    out: FloatArray,
) -> None:
    """Displacement, velocity and acceleration (4, 3, n) of the four points."""
    n = signals.shape[2]
    middle = n // 2
    for c in range(4):
        g = 1.0 + gain[c]
        d = delay[c]
        d1, d2, d3 = g * d, g * 0.5 * d * d, g * d * d * d / 6.0
        z0, v0, b = initial[c, 0], initial[c, 1], initial[c, 2]
        z, v, a, a1, a2 = signals[c, 0], signals[c, 1], signals[c, 2], signals[c, 3], signals[c, 4]
        out_z, out_v, out_a = out[c, 0], out[c, 1], out[c, 2]
        for i in range(n):
            t = step * (i - middle)
            out_z[i] = g * z[i] + d1 * v[i] + d2 * a[i] + d3 * a1[i] + z0 + t * (v0 + 0.5 * b * t)
            out_v[i] = g * v[i] + d1 * a[i] + d2 * a1[i] + d3 * a2[i] + v0 + b * t
            out_a[i] = g * a[i] + d1 * a1[i] + d2 * a2[i] + b


@kernel
def _wheels(
    crossing: Crossing,
    work: Work,
    theta: FloatArray,
    wheelbase: float,
    speeding: FloatArray,
) -> None:
    """Minus the input profile (`road`), contact force (`load`) and body equation (`body`)."""
    d_1 = theta[D_1]
    d_2 = wheelbase - d_1
    m_s = crossing.total_mass_kg - theta[M_U1] - theta[M_U1 + 1]
    inertia = theta[KAPPA] * m_s * d_1 * d_2
    square = wheelbase * wheelbase
    m_12 = (m_s * d_1 * d_2 - inertia) / square
    transfer = crossing.total_mass_kg * crossing.cg_height_m / wheelbase
    n = work.road.shape[1]
    for w in range(2):
        sign = 1.0 - 2.0 * w
        d_far = d_2 if w == 0 else d_1
        m_ii = (m_s * d_far * d_far + inertia) / square
        m_u = theta[M_U1 + w]
        c, k, k_u = theta[C_S1 + w], theta[K_S1 + w], theta[K_U1 + w]
        weight = crossing.gravity_m_per_s2 * (m_s * d_far / wheelbase + m_u)
        z_s, v_s, a_s = work.corrected[w, 0], work.corrected[w, 1], work.corrected[w, 2]
        z_u, v_u, a_u = work.corrected[2 + w, 0], work.corrected[2 + w, 1], work.corrected[2 + w, 2]
        a_other = work.corrected[1 - w, 2]
        road, load, body = work.road[w], work.load[w], work.body[w]
        for i in range(n):
            spring = c * (v_u[i] - v_s[i]) + k * (z_u[i] - z_s[i])
            inertial = m_ii * a_s[i] + m_12 * a_other[i]
            shift = sign * transfer * speeding[i]
            road[i] = -z_u[i] - (m_u * a_u[i] + spring) / k_u
            load[i] = shift - weight - inertial - m_u * a_u[i]
            body[i] = (inertial - spring - shift) / k


@kernel
def _locate(crossing: Crossing, work: Work, front: FloatArray, wheelbase: float) -> None:
    edges = crossing.edges_m
    parts = edges.size - 1
    n = front.size
    for w in range(2):
        offset = 0.0 if w == 0 else -crossing.direction * wheelbase
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


@kernel
def _bridge(crossing: Crossing, work: Work, theta: FloatArray) -> bool:
    """Modes of this bridge into the work arrays, unless they are there already."""
    same = True
    for i in range(10, theta.size):
        if theta[i] != work.modes_of[i]:
            same = False
    if same:
        return True
    basis = crossing.basis
    if not modal_filters_one(
        basis.stiffness,
        basis.cubics,
        theta,
        crossing.step_s,
        work.matrix,
        work.vectors,
        work.cubics,
        work.feedback,
    ):
        work.modes_of[:] = np.nan
        return False
    work.modes_of[:] = theta
    return True


@kernel
def _deflect(work: Work) -> None:
    """Add the bridge's deflection to `road` (which is minus the input profile)."""
    work.state[:] = 0.0
    n = work.road.shape[1]
    begin = 0
    while begin < n:
        e1, e2 = work.part[0, begin], work.part[1, begin]
        stop = begin + 1
        while (
            stop < n
            and stop - begin < _LONGEST_STRETCH
            and work.part[0, stop] == e1
            and work.part[1, stop] == e2
        ):
            stop += 1
        if e1 >= 0 or e2 >= 0:
            for w in range(2):
                for i in range(begin, stop):
                    p = work.load[w, i]
                    for lane in range(LANES):
                        work.force[w, i - begin, lane] = p
                        work.lanes[w, i - begin, lane] = 0.0
            advance(
                work.cubics[max(e1, 0)],
                work.cubics[max(e2, 0)],
                e1 >= 0,
                e2 >= 0,
                work.feedback,
                work.state,
                work.place[0, begin:stop],
                work.place[1, begin:stop],
                work.force,
                work.lanes[0],
                work.lanes[1],
            )
            for w in range(2):
                for i in range(begin, stop):
                    y = work.lanes[w, i - begin]
                    work.road[w, i] += (y[0] + y[1]) + (y[2] + y[3])
        begin = stop


@kernel
def _compare(
    crossing: Crossing, work: Work, front: FloatArray, wheelbase: float, out: FloatArray
) -> bool:
    """The residuals of every row into `out` (3, rows); False if the front is not known there."""
    sign = 1.0 if crossing.direction > 0 else -1.0
    n = front.size
    j = 1
    for row in range(crossing.rows):
        i = crossing.first_row + row
        wanted = sign * front[i] - wheelbase
        while j < n - 3 and sign * front[j + 1] < wanted:
            j += 1
        # `wanted` lies between samples j and j + 1: fraction of the cubic through j - 1 … j + 2.
        x0, x1, x2, x3 = (
            sign * front[j - 1],
            sign * front[j],
            sign * front[j + 1],
            sign * front[j + 2],
        )
        if not (x1 <= wanted <= x2) or x2 <= x1:
            return False
        f = (wanted - x1) / (x2 - x1)
        for _ in range(2):
            w0 = -f * (f - 1.0) * (f - 2.0) / 6.0
            w1 = (f + 1.0) * (f - 1.0) * (f - 2.0) / 2.0
            w2 = -(f + 1.0) * f * (f - 2.0) / 2.0
            w3 = (f + 1.0) * f * (f - 1.0) / 6.0
            f += (wanted - (w0 * x0 + w1 * x1 + w2 * x2 + w3 * x3)) / (x2 - x1)
        w0 = -f * (f - 1.0) * (f - 2.0) / 6.0
        w1 = (f + 1.0) * (f - 1.0) * (f - 2.0) / 2.0
        w2 = -(f + 1.0) * f * (f - 2.0) / 2.0
        w3 = (f + 1.0) * f * (f - 1.0) / 6.0
        r, b = work.road[0], work.body[0]
        front_road = w0 * r[j - 1] + w1 * r[j] + w2 * r[j + 1] + w3 * r[j + 2]
        out[0, row] = work.road[1, i] - front_road  # road holds y - u, minus the road
        out[1, row] = w0 * b[j - 1] + w1 * b[j] + w2 * b[j + 1] + w3 * b[j + 2]
        out[2, row] = work.body[1, i]
    return True


@kernel
def _evaluate(
    crossing: Crossing, work: Work, points: Points, begin: int, stop: int, out: FloatArray
) -> None:
    for k in range(begin, stop):
        theta = points.theta[k]
        front = points.position_m[k]
        wheelbase = points.wheelbase_m[k]
        ok = theta[D_1] < wheelbase
        for i in range(theta.size):
            ok = ok and np.isfinite(theta[i])
        if ok:
            _correct(
                crossing.signals,
                crossing.step_s,
                points.gain[k],
                points.delay_s[k],
                points.initial[k],
                work.corrected,
            )
            _wheels(crossing, work, theta, wheelbase, points.acceleration_m_per_s2[k])
            _locate(crossing, work, front, wheelbase)
            ok = _bridge(crossing, work, theta)
        if ok:
            _deflect(work)
            ok = _compare(crossing, work, front, wheelbase, out[k])
        if not ok:
            out[k] = np.nan


def evaluate(crossing: Crossing, works: tuple[Work, ...], points: Points) -> FloatArray:
    """Residuals (k, 3, rows) in m: R_1 - R_2, front and rear body equation over k_s.

    NaN where a point is impossible (or its trajectory turns round). One thread for each of `works`.
    """
    count = points.theta.shape[0]
    out = np.empty((count, 3, crossing.rows))
    bounds = np.linspace(0, count, len(works) + 1).astype(int)
    if count == 1 or len(works) == 1:
        _evaluate(crossing, works[0], points, 0, count, out)
        return out

    def part(i: int) -> None:
        _evaluate(crossing, works[i], points, bounds[i], bounds[i + 1], out)

    with ThreadPoolExecutor(len(works)) as pool:
        list(pool.map(part, range(len(works))))
    return out


@kernel
def _one(crossing: Crossing, work: Work, points: Points, k: int, deflection: FloatArray) -> bool:
    """Leave point k's roads in `work.road` (minus the road) and the deflections in (2, n)."""
    front = points.position_m[k]
    _correct(
        crossing.signals,
        crossing.step_s,
        points.gain[k],
        points.delay_s[k],
        points.initial[k],
        work.corrected,
    )
    _wheels(crossing, work, points.theta[k], points.wheelbase_m[k], points.acceleration_m_per_s2[k])
    _locate(crossing, work, front, points.wheelbase_m[k])
    if not _bridge(crossing, work, points.theta[k]):
        return False
    deflection[:] = work.road
    _deflect(work)
    for w in range(2):
        for i in range(front.size):
            deflection[w, i] = work.road[w, i] - deflection[w, i]
    return True


def roads_and_deflections(
    crossing: Crossing, work: Work, points: Points, k: int
) -> tuple[FloatArray, FloatArray]:
    """Road heights (2, n) under both wheels at every sample, and the bridge's deflections (2, n).

    Raises ValueError for an impossible point.
    """
    deflection = np.empty_like(work.road)
    if not _one(crossing, work, points, k, deflection):
        raise ValueError("the bridge of this point has no modes")
    return -work.road, deflection
