"""The steps of `two_sided` in time: a truck on the modes of a bridge.

Fourth-order Runge-Kutta steps, in their exponential form (Cox and Matthews 2002, eq. 26-29):
the free motion of each mode is exact, so that modes of several kHz or with many times their
critical damping need no shorter steps. For the truck, which has no exponential part, they are the
classical steps. The bridge moves only while a wheel is on it.
"""

from typing import NamedTuple

import numpy as np

from pre_core.kernels.lanes import compiled
from services.common.arrays import Floats, Ints
from services.simulation.two_sided_deck import ExactModes

# Kernels that only kernels call; see pre_core/kernels/lanes.py.
_inner = compiled(error_model="numpy", no_cpython_wrapper=True)


class TruckSystem(NamedTuple):
    """The truck's equations: M q'' + C q' + K q + friction = forces of the tyres."""

    mass: Floats  # (n,): the coordinates are those of the centres of gravity
    damping: Floats  # (n, n)
    stiffness: Floats  # (n, n)
    tyre_rows: Floats  # (tyres, n)
    tyre_stiffness: Floats  # (tyres,)
    tyre_damping: Floats
    static_load: Floats
    friction_rows: Floats  # (springs, n)
    friction_n: Floats  # (springs,)
    friction_length: Floats


class WheelCourse(NamedTuple):
    """Positions of the wheels and the ground under them, at every half step."""

    step_s: float
    span_m: float
    first_on: int
    last_on: int
    """First and last step with a wheel on the bridge."""
    bending: int
    """Number of bending modes, the first ones."""
    places: Floats  # (half steps, axles)
    speed: Floats  # (half steps,)
    acceleration: Floats  # (half steps,)
    transfer: Floats  # (n,): forces on the coordinates over the acceleration
    tyre_axle: Ints  # (tyres,)
    lateral: Floats  # (tyres,): to the left of the bridge's axis
    height: Floats  # (half steps, tyres)
    rate: Floats  # (half steps, tyres)


class _Motion(NamedTuple):
    """The state of truck and bridge."""

    q: Floats  # (n,)
    qd: Floats
    friction: Floats  # (springs,)
    w: Floats  # (modes,)
    wd: Floats


class _Stages(NamedTuple):
    """The four evaluations of a step."""

    velocity: Floats  # (4, n)
    acceleration: Floats  # (4, n)
    friction_rate: Floats  # (4, springs)
    modal_force: Floats  # (4, modes)
    half_w: Floats  # (modes,): state at the first half step
    half_wd: Floats


class _Under(NamedTuple):
    """The bridge under the wheels at one moment, and the tyres' forces on it."""

    shapes: Floats  # (3 moments, axles, modes)
    slopes: Floats
    ahead: Floats  # (modes,): work array
    contact: Floats  # (tyres,)
    deflection: Floats  # (axles,)
    twist: Floats
    deflection_rate: Floats
    twist_rate: Floats


class WideResponse(NamedTuple):
    """Motion of truck and bridge at every step."""

    time_s: Floats
    position_m: Floats
    """Chainage of the first axle."""
    coordinates: Floats  # (steps, 3 bodies + 2 axles): bodies (z, theta, phi), axles (z, phi)
    acceleration: Floats  # likewise, their second derivatives
    contact_force_n: Floats  # (steps, tyres), up positive on the bridge: negative while loaded
    deflection_m: Floats  # (steps, axles): bending at the axle
    twist_rad: Floats  # (steps, axles)


@compiled(error_model="numpy")
def march_exactly(
    system: TruckSystem, modes: ExactModes, course: WheelCourse, out: WideResponse
) -> None:
    """March from rest and write the motion at every step to `out`."""
    steps, size = out.coordinates.shape[0] - 1, out.coordinates.shape[1]
    axles, tyres, springs = course.places.shape[1], course.lateral.size, system.friction_n.size
    count = modes.half.shape[0]
    needs_slopes = _is_any_positive(system.tyre_damping)
    now = _Motion(
        np.zeros(size), np.zeros(size), np.zeros(springs), np.zeros(count), np.zeros(count)
    )
    at = _Motion(
        np.zeros(size), np.zeros(size), np.zeros(springs), np.zeros(count), np.zeros(count)
    )
    stages = _Stages(
        np.zeros((4, size)),
        np.zeros((4, size)),
        np.zeros((4, springs)),
        np.zeros((4, count)),
        np.zeros(count),
        np.zeros(count),
    )
    under = _Under(
        np.zeros((3, axles, count)),
        np.zeros((3, axles, count)),
        np.zeros(count),
        np.zeros(tyres),
        np.zeros(axles),
        np.zeros(axles),
        np.zeros(axles),
        np.zeros(axles),
    )
    for n in range(steps + 1):
        is_on = course.first_on <= n <= course.last_on
        if is_on:
            _shape_step(n, course, modes, under, needs_slopes)
        else:
            under.deflection[:] = 0.0
            under.twist[:] = 0.0
            under.deflection_rate[:] = 0.0
            under.twist_rate[:] = 0.0
        for stage in range(4):
            _begin_stage(stage, course.step_s, is_on, modes, now, stages, at)
            _derivative(system, course, under, at, stages, (n, stage, is_on))
            if stage == 0:
                _write(out, n, now, stages, under)
                if n == steps:
                    return
        _end_step(course.step_s, is_on, modes, stages, now)


@_inner
def _copy(values: Floats, out: Floats) -> None:
    for k in range(out.size):
        out[k] = values[k]


@_inner
def _is_any_positive(values: Floats) -> bool:
    largest = 0.0
    for k in range(values.size):
        largest = max(largest, values[k])
    return largest > 0.0


@_inner
def _write(out: WideResponse, n: int, now: _Motion, stages: _Stages, under: _Under) -> None:
    """Write the motion at the begin of step n."""
    _copy(now.q, out.coordinates[n])
    _copy(stages.acceleration[0], out.acceleration[n])
    _copy(under.contact, out.contact_force_n[n])
    _copy(under.deflection, out.deflection_m[n])
    _copy(under.twist, out.twist_rad[n])


@_inner
def _shape(x: float, span: float, modes: ExactModes, out: Floats) -> None:
    """Write the mass-normalised modes at the chainage x to `out` (modes,), 0 off the bridge."""
    bending = modes.bending.shape[1]
    if not 0.0 < x < span:
        out[:] = 0.0
        return
    cell = min(int(x / modes.cell_m), modes.bending.shape[0] - 2)
    a = modes.cell_m
    s = x / a - cell
    n_1 = 1.0 - s * s * (3.0 - 2.0 * s)
    n_2 = a * s * (1.0 - s) * (1.0 - s)
    n_3 = s * s * (3.0 - 2.0 * s)
    n_4 = a * s * s * (s - 1.0)
    for k in range(bending):
        out[k] = (
            n_1 * modes.bending[cell, k]
            + n_2 * modes.slope[cell, k]
            + n_3 * modes.bending[cell + 1, k]
            + n_4 * modes.slope[cell + 1, k]
        )
    # sin((j + 1) a) = 2 cos(a) sin(j a) - sin((j - 1) a)
    angle = np.pi * x / span
    before, sine, twice = 0.0, np.sin(angle), 2.0 * np.cos(angle)
    for j in range(modes.torsion.size):
        out[bending + j] = modes.torsion[j] * sine
        before, sine = sine, twice * sine - before


@_inner
def _move_bridge(
    course: WheelCourse, under: _Under, moment: int, speed: float, at: _Motion
) -> None:
    """Compute deflection and twist at each axle, and their rates, for modes in motion."""
    shapes, slopes, w, wd = under.shapes, under.slopes, at.w, at.wd
    for i in range(under.deflection.size):
        under.deflection[i], under.twist[i] = 0.0, 0.0
        under.deflection_rate[i], under.twist_rate[i] = 0.0, 0.0
        for k in range(w.size):
            y = shapes[moment, i, k] * w[k]
            yd = shapes[moment, i, k] * wd[k] + speed * slopes[moment, i, k] * w[k]
            if k < course.bending:
                under.deflection[i] += y
                under.deflection_rate[i] += yd
            else:
                under.twist[i] += y
                under.twist_rate[i] += yd


@_inner
def _derivative(
    system: TruckSystem,
    course: WheelCourse,
    under: _Under,
    at: _Motion,
    stages: _Stages,
    step: tuple[int, int, bool],
) -> None:
    """Write the right-hand sides of a stage to `stages`, the forces to `under`.

    `step` is its number, stage, and whether a wheel is on the bridge.
    """
    n_step, stage, is_on = step
    moment = _moment(stage)
    index = min(2 * n_step + moment, course.places.shape[0] - 1)
    q, qd, friction = at.q, at.qd, at.friction
    qdd, modal_force = stages.acceleration[stage], stages.modal_force[stage]
    size, modes = q.size, modal_force.size
    if is_on:
        _move_bridge(course, under, moment, course.speed[index], at)
    for n in range(size):
        stages.velocity[stage, n] = qd[n]
        qdd[n] = course.transfer[n] * course.acceleration[index]
        for m in range(size):
            qdd[n] -= system.damping[n, m] * qd[m] + system.stiffness[n, m] * q[m]
    for s in range(friction.size):
        sliding = 0.0
        for n in range(size):
            sliding += system.friction_rows[s, n] * qd[n]
            qdd[n] -= system.friction_rows[s, n] * friction[s]
        stages.friction_rate[stage, s] = (
            system.friction_n[s] * sliding - friction[s] * abs(sliding)
        ) / system.friction_length[s]
    for k in range(modes):
        modal_force[k] = 0.0
    for t in range(course.tyre_axle.size):
        i, lateral = course.tyre_axle[t], course.lateral[t]
        z, zd = 0.0, 0.0
        for n in range(size):
            z += system.tyre_rows[t, n] * q[n]
            zd += system.tyre_rows[t, n] * qd[n]
        ground = course.height[index, t] + under.deflection[i] + lateral * under.twist[i]
        rate = course.rate[index, t] + under.deflection_rate[i] + lateral * under.twist_rate[i]
        force = system.tyre_stiffness[t] * (ground - z) + system.tyre_damping[t] * (rate - zd)
        for n in range(size):
            qdd[n] += system.tyre_rows[t, n] * force
        under.contact[t] = -(system.static_load[t] + force)
        if is_on:
            for k in range(modes):
                arm = 1.0 if k < course.bending else lateral
                modal_force[k] += under.shapes[moment, i, k] * arm * under.contact[t]
    for n in range(size):
        qdd[n] /= system.mass[n]


@_inner
def _moment(stage: int) -> int:
    """Return the moment of a stage in half steps: begin, middle, middle, end."""
    return 0 if stage == 0 else (2 if stage == 3 else 1)


@_inner
def _shape_step(
    n: int, course: WheelCourse, modes: ExactModes, under: _Under, needs_slopes: bool
) -> None:
    """Compute the modes at the axles at begin, middle and end; the begin is the last step's end."""
    shapes, slopes = under.shapes, under.slopes
    near = 1e-4
    for moment in range(3):
        index = min(2 * n + moment, course.places.shape[0] - 1)
        for i in range(shapes.shape[1]):
            if moment == 0 and n > course.first_on:
                _copy(shapes[2, i], shapes[0, i])
                _copy(slopes[2, i], slopes[0, i])
                continue
            x = course.places[index, i]
            _shape(x, course.span_m, modes, shapes[moment, i])
            if needs_slopes:
                slopes[moment, i] = 0.0
                if near < x < course.span_m - near:
                    _shape(x + near, course.span_m, modes, under.ahead)
                    for k in range(under.ahead.size):
                        slopes[moment, i, k] = (under.ahead[k] - shapes[moment, i, k]) / near


@_inner
def _begin_stage(
    stage: int,
    step_s: float,
    is_on: bool,
    modes: ExactModes,
    now: _Motion,
    stages: _Stages,
    at: _Motion,
) -> None:
    """Compute the state of a stage from that at the begin of the step and the stages before."""
    if stage == 0:
        _copy(now.q, at.q)
        _copy(now.qd, at.qd)
        _copy(now.friction, at.friction)
        _copy(now.w, at.w)
        _copy(now.wd, at.wd)
        return
    of = stage - 1
    ahead_s = step_s if stage == 3 else 0.5 * step_s
    for k in range(now.q.size):
        at.q[k] = now.q[k] + ahead_s * stages.velocity[of, k]
        at.qd[k] = now.qd[k] + ahead_s * stages.acceleration[of, k]
    for k in range(now.friction.size):
        at.friction[k] = now.friction[k] + ahead_s * stages.friction_rate[of, k]
    if not is_on:
        return
    p, half, drive = stages.modal_force, modes.half, modes.half_drive
    for k in range(now.w.size):
        w, wd, force = now.w[k], now.wd[k], p[of, k]
        if stage == 3:
            w, wd = stages.half_w[k], stages.half_wd[k]
            force = 2.0 * p[2, k] - p[0, k]
        at.w[k] = half[k, 0, 0] * w + half[k, 0, 1] * wd + drive[k, 0] * force
        at.wd[k] = half[k, 1, 0] * w + half[k, 1, 1] * wd + drive[k, 1] * force
    if stage == 1:
        _copy(at.w, stages.half_w)
        _copy(at.wd, stages.half_wd)


@_inner
def _end_step(step_s: float, is_on: bool, modes: ExactModes, stages: _Stages, now: _Motion) -> None:
    """Compute the state at the end of the step from its four stages."""
    v, a, f, p = stages.velocity, stages.acceleration, stages.friction_rate, stages.modal_force
    sixth = step_s / 6.0
    for k in range(now.q.size):
        now.q[k] += sixth * (v[0, k] + 2.0 * v[1, k] + 2.0 * v[2, k] + v[3, k])
        now.qd[k] += sixth * (a[0, k] + 2.0 * a[1, k] + 2.0 * a[2, k] + a[3, k])
    for k in range(now.friction.size):
        now.friction[k] += sixth * (f[0, k] + 2.0 * f[1, k] + 2.0 * f[2, k] + f[3, k])
    if not is_on:
        return
    full, g = modes.full, modes.weights
    for k in range(now.w.size):
        w = full[k, 0, 0] * now.w[k] + full[k, 0, 1] * now.wd[k]
        wd = full[k, 1, 0] * now.w[k] + full[k, 1, 1] * now.wd[k]
        middle = p[1, k] + p[2, k]
        w += g[k, 0, 0] * p[0, k] + g[k, 1, 0] * middle + g[k, 2, 0] * p[3, k]
        wd += g[k, 0, 1] * p[0, k] + g[k, 1, 1] * middle + g[k, 2, 1] * p[3, k]
        now.w[k], now.wd[k] = w, wd
