"""Response of a mode to a force that is linear between samples: exact at any step.

For q'' + c q' + lambda q = p with p linear between samples (Nigam and Jennings 1969) the samples of
q obey

    q[n] + a_1 q[n-1] + a_2 q[n-2] = b_0 p[n] + b_1 p[n-1] + b_2 p[n-2],

a_1 = -2 exp(-s h) cos(w h), a_2 = exp(-2 s h), s = c/2, w^2 = lambda - s^2; the b follow from r_n,
the response to a unit ramp after n steps h:

    b_0 = r_1/h,  b_1 = (r_2 - 2 r_1)/h + a_1 b_0,  b_2 = (r_3 - 2 r_2 + r_1)/h + a_1 (…) + a_2 b_0.

Newmark's scheme, in contrast, shifts a mode at a fifth of the sampling rate by a tenth of its
frequency. Linear interpolation attenuates a force at omega by (omega h)^2/12; `precompensate_force`
restores this part.
"""

from typing import NamedTuple

import numpy as np

from pre_core.arrays import FloatArray
from pre_core.kernels.lanes import LANES, fma, fma_scalar, inner, kernel, load, mul, store
from pre_core.parameters import RHO_A
from pre_core.physics.beam_basis import (
    BeamBasis,
    ModalFilters,
    diagonalise_bridge,
    modal_damping,
    shape_cubics,
)

COEFFICIENTS = 5
"""Number of coefficients of a mode: -a_1, -a_2, and b_0, b_1, b_2 divided by the sum of the b."""


class LoadedStretch(NamedTuple):
    """Input and output of `advance`: samples during which each wheel stays in one part.

    `advance` adds to `deflection`.
    """

    front: int
    """Part under the front wheel; -1 off the bridge."""
    rear: int
    place: FloatArray  # (2, steps): 0..1 within the part
    force: FloatArray  # (2, steps or more, 4)
    deflection: FloatArray  # (2, steps or more, 4)


class EndStretch(NamedTuple):
    """The ends of the bridge over a stretch of samples."""

    force: FloatArray  # (2 ends, steps): acts in addition to the wheels' forces
    share: FloatArray
    """Share (2 wheels, 2 ends, steps) of an end's deflection that is added to a wheel's."""


@inner
def _ramp_response(time: float, damping: float, eigenvalue: float) -> float:
    """Return the displacement of a mode at rest, `time` after a unit ramp force began."""
    half = 0.5 * damping
    square = eigenvalue - half * half
    # q = t/lambda - c/lambda^2 + exp(-half t) (C cos + S sin/w) with q(0) = q'(0) = 0.
    c = damping / (eigenvalue * eigenvalue)
    s = half * c - 1.0 / eigenvalue
    if square > 0.0:
        root = np.sqrt(square)
        decay = np.exp(-half * time)
        cosine, sine = decay * np.cos(root * time), decay * np.sin(root * time) / root
    else:
        root = np.sqrt(-square)
        quick = np.exp(-(half + root) * time)
        slow = np.exp(-eigenvalue / (half + root) * time)
        cosine = 0.5 * (slow + quick)
        sine = 0.5 * (slow - quick) / root if root * time > 1e-6 else time * slow
    return time / eigenvalue - c + c * cosine + s * sine


@kernel
def mode_coefficients(eigenvalue: float, damping: float, step: float, out: FloatArray) -> float:
    """Write the coefficients (5,) of one mode (see COEFFICIENTS); return b_0 + b_1 + b_2."""
    half = 0.5 * damping
    square = eigenvalue - half * half
    if square > 0.0:
        a_1 = -2.0 * np.exp(-half * step) * np.cos(np.sqrt(square) * step)
    else:
        root = np.sqrt(-square)
        a_1 = -(np.exp(-(half + root) * step) + np.exp(-eigenvalue / (half + root) * step))
    a_2 = np.exp(-damping * step)
    r_1 = _ramp_response(step, damping, eigenvalue)
    r_2 = _ramp_response(2.0 * step, damping, eigenvalue)
    r_3 = _ramp_response(3.0 * step, damping, eigenvalue)
    h_0, h_1, h_2 = r_1 / step, (r_2 - 2.0 * r_1) / step, (r_3 - 2.0 * r_2 + r_1) / step
    b_0 = h_0
    b_1 = h_1 + a_1 * h_0
    b_2 = h_2 + a_1 * h_1 + a_2 * h_0
    total = b_0 + b_1 + b_2
    out[0], out[1] = -a_1, -a_2
    out[2], out[3], out[4] = b_0 / total, b_1 / total, b_2 / total
    return total


@kernel
def modal_filters(
    basis: BeamBasis,
    theta: FloatArray,
    step_s: float,
    matrix: FloatArray,
    vectors: FloatArray,
    filters: ModalFilters,
    modes: FloatArray,
) -> bool:
    """Compute the recursions of the modes of one bridge `theta` (p,), g groups of four lanes.

    `matrix` and `vectors` (m, m) are buffers. Outputs: `filters.cubics` (parts, g, 4, 4) [part,
    group, power, mode], mode shapes times the root of the sum of the b over rho A;
    `filters.feedback` (g, 5, 4), whose lanes beyond the last mode stay zero; `modes` (m, 3):
    omega^2, damping, and the factor from the recursion's q to the coordinate of the mass-normalised
    mode, with a sign that is the same for similar bridges. Return False if a value is not finite.
    """
    if not diagonalise_bridge(basis.stiffness, theta, matrix, vectors):
        return False
    cubics, feedback = filters.cubics, filters.feedback
    cubics[:] = 0.0
    feedback[:] = 0.0
    one = np.empty(COEFFICIENTS)
    scale = np.empty(basis.stiffness.shape[1])
    for k in range(scale.size):
        group, lane = k // LANES, k % LANES
        eigenvalue = matrix[k, k] / theta[RHO_A]
        damping = modal_damping(theta, eigenvalue)
        total = mode_coefficients(eigenvalue, damping, step_s, one)
        if not total > 0.0:
            return False
        for i in range(COEFFICIENTS):
            feedback[group, i, lane] = one[i]
        scale[k] = np.sqrt(total / theta[RHO_A])
        modes[k, 0], modes[k, 1] = eigenvalue, damping
        # In coordinates that diagonalise a similar bridge, a mode is nearly a unit vector.
        modes[k, 2] = np.sqrt(total) if vectors[k, k] >= 0.0 else -np.sqrt(total)
    shape_cubics(basis.cubics, vectors, scale, cubics)
    return True


@kernel
def precompensate_force(force: FloatArray, out: FloatArray) -> None:
    """Write p[n] - (p[n+1] - 2 p[n] + p[n-1])/12 of a force p (n,) to `out` (n,).

    This restores what linear interpolation between samples attenuates. The ends stay as they are.
    """
    last = force.size - 1
    out[0], out[last] = force[0], force[last]
    for n in range(1, last):
        out[n] = force[n] - (force[n + 1] - 2.0 * force[n] + force[n - 1]) / 12.0


@inner
def _two_wheels(
    front: FloatArray,
    rear: FloatArray,
    feedback: FloatArray,
    state: FloatArray,
    wheels: LoadedStretch,
) -> None:
    place, force, deflection = wheels.place, wheels.force, wheels.deflection
    a0, a1, a2, a3 = load(front, 0), load(front, 1), load(front, 2), load(front, 3)
    b0, b1, b2, b3 = load(rear, 0), load(rear, 1), load(rear, 2), load(rear, 3)
    f1, f2 = load(feedback, 0), load(feedback, 1)
    n0, n1, n2 = load(feedback, 2), load(feedback, 3), load(feedback, 4)
    w1, w2 = load(state, 0), load(state, 1)
    place_front, place_rear = place[0], place[1]
    force_front, force_rear = force[0], force[1]
    deflection_front, deflection_rear = deflection[0], deflection[1]
    for n in range(place.shape[1]):
        x = place_front[n]
        z = place_rear[n]
        a = fma_scalar(fma_scalar(fma_scalar(a3, x, a2), x, a1), x, a0)
        b = fma_scalar(fma_scalar(fma_scalar(b3, z, b2), z, b1), z, b0)
        p = fma(a, load(force_front, n), mul(b, load(force_rear, n)))
        w = fma(f1, w1, fma(f2, w2, p))
        q = fma(n0, w, fma(n1, w1, mul(n2, w2)))
        w2 = w1
        w1 = w
        store(deflection_front, n, fma(a, q, load(deflection_front, n)))
        store(deflection_rear, n, fma(b, q, load(deflection_rear, n)))
    store(state, 0, w1)
    store(state, 1, w2)


@inner
def _one_wheel(
    cubic: FloatArray,
    feedback: FloatArray,
    state: FloatArray,
    place: FloatArray,
    force: FloatArray,
    deflection: FloatArray,
) -> None:
    a0, a1, a2, a3 = load(cubic, 0), load(cubic, 1), load(cubic, 2), load(cubic, 3)
    f1, f2 = load(feedback, 0), load(feedback, 1)
    n0, n1, n2 = load(feedback, 2), load(feedback, 3), load(feedback, 4)
    w1, w2 = load(state, 0), load(state, 1)
    for n in range(place.size):
        x = place[n]
        a = fma_scalar(fma_scalar(fma_scalar(a3, x, a2), x, a1), x, a0)
        w = fma(f1, w1, fma(f2, w2, mul(a, load(force, n))))
        q = fma(n0, w, fma(n1, w1, mul(n2, w2)))
        w2 = w1
        w1 = w
        store(deflection, n, fma(a, q, load(deflection, n)))
    store(state, 0, w1)
    store(state, 1, w2)


@inner
def _no_wheel(feedback: FloatArray, state: FloatArray, steps: int) -> None:
    f1, f2 = load(feedback, 0), load(feedback, 1)
    w1, w2 = load(state, 0), load(state, 1)
    for _ in range(steps):
        w = fma(f1, w1, mul(f2, w2))
        w2 = w1
        w1 = w
    store(state, 0, w1)
    store(state, 1, w2)


@kernel
def advance(filters: ModalFilters, wheels: LoadedStretch) -> None:
    """Advance all modes over a stretch: update `filters.state`, and *add* to the deflections.

    Without a wheel on the bridge the modes vibrate freely.
    """
    cubics, feedback, state = filters.cubics, filters.feedback, filters.state
    place, force, deflection = wheels.place, wheels.force, wheels.deflection
    front, rear = wheels.front, wheels.rear
    for g in range(feedback.shape[0]):
        if front >= 0 and rear >= 0:
            _two_wheels(cubics[front, g], cubics[rear, g], feedback[g], state[g], wheels)
        elif front >= 0:
            _one_wheel(cubics[front, g], feedback[g], state[g], place[0], force[0], deflection[0])
        elif rear >= 0:
            _one_wheel(cubics[rear, g], feedback[g], state[g], place[1], force[1], deflection[1])
        else:  # a span shorter than the wheelbase vibrates freely between the axles
            _no_wheel(feedback[g], state[g], place.shape[1])


@kernel
def add_free_vibration(
    feedback: FloatArray, state: FloatArray, mode: FloatArray, k: int, q: float, v: float
) -> None:
    """Add free vibration of mode k to `state`: displacement q and velocity v at the next sample.

    `mode` (3,) is its row of the `modes` of `modal_filters`, `feedback` is (g, 5, 4), `state` (g,
    2, 4). The recursion's w[n] is the real part of B z^n, z = exp((-s + i omega) step), where q[n]
    is that of B (n_0 + n_1/z + n_2/z^2) z^n. An overdamped mode stays at rest.
    """
    half = 0.5 * mode[1]
    square = mode[0] - half * half
    if not square > 0.0:
        return
    root = np.sqrt(square)
    group, lane = k // LANES, k % LANES
    f1, f2 = feedback[group, 0, lane], feedback[group, 1, lane]
    n0, n1, n2 = feedback[group, 2, lane], feedback[group, 3, lane], feedback[group, 4, lane]
    # From z = exp(-s h) (cos + i sin) follow f1 = 2 Re z and f2 = -|z|^2.
    size = np.sqrt(-f2)
    real = 0.5 * f1
    imaginary = np.sqrt(max(size * size - real * real, 0.0))
    back_r, back_i = real / (size * size), -imaginary / (size * size)  # 1/z
    square_r, square_i = back_r * back_r - back_i * back_i, 2.0 * back_r * back_i
    filter_r, filter_i = n0 + n1 * back_r + n2 * square_r, n1 * back_i + n2 * square_i
    # Amplitude A in q(t) = Re A exp((-s + i omega) t); then B = A/filter.
    a_r, a_i = q / mode[2], -(v + half * q) / (root * mode[2])
    norm = filter_r * filter_r + filter_i * filter_i
    b_r = (a_r * filter_r + a_i * filter_i) / norm
    b_i = (a_i * filter_r - a_r * filter_i) / norm
    state[group, 0, lane] += b_r * back_r - b_i * back_i
    state[group, 1, lane] += b_r * square_r - b_i * square_i


@inner
def _group_with_ends(
    filters: ModalFilters, g: int, wheels: LoadedStretch, ends: EndStretch
) -> None:
    cubics, feedback, state = filters.cubics, filters.feedback[g], filters.state[g]
    front, rear = cubics[max(wheels.front, 0), g], cubics[max(wheels.rear, 0), g]
    first, last = cubics[0, g], cubics[cubics.shape[0] - 1, g]
    front_on, rear_on = wheels.front >= 0, wheels.rear >= 0
    place, force, deflection = wheels.place, wheels.force, wheels.deflection
    end_force, end_share = ends.force, ends.share
    for lane in range(LANES):
        f1, f2 = feedback[0, lane], feedback[1, lane]
        n0, n1, n2 = feedback[2, lane], feedback[3, lane], feedback[4, lane]
        w1, w2 = state[0, lane], state[1, lane]
        start = first[0, lane]
        end = last[0, lane] + last[1, lane] + last[2, lane] + last[3, lane]
        for n in range(place.shape[1]):
            x, z = place[0, n], place[1, n]
            a = b = 0.0
            if front_on:
                a = ((front[3, lane] * x + front[2, lane]) * x + front[1, lane]) * x + front[
                    0, lane
                ]
            if rear_on:
                b = ((rear[3, lane] * z + rear[2, lane]) * z + rear[1, lane]) * z + rear[0, lane]
            p = a * force[0, n, lane] + b * force[1, n, lane]
            p += start * end_force[0, n] + end * end_force[1, n]
            w = f1 * w1 + f2 * w2 + p
            q = n0 * w + n1 * w1 + n2 * w2
            w2 = w1
            w1 = w
            at_start, at_end = start * q, end * q
            deflection[0, n, lane] += (
                a * q + end_share[0, 0, n] * at_start + end_share[0, 1, n] * at_end
            )
            deflection[1, n, lane] += (
                b * q + end_share[1, 0, n] * at_start + end_share[1, 1, n] * at_end
            )
        state[0, lane], state[1, lane] = w1, w2


@inner
def advance_with_ends(filters: ModalFilters, wheels: LoadedStretch, ends: EndStretch) -> None:
    """Advance as `advance` does, with forces at the bridge's ends and shares of their motion."""
    for g in range(filters.feedback.shape[0]):
        _group_with_ends(filters, g, wheels, ends)
