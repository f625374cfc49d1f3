"""What sensor noise does to the residuals, and how to make it white.

Three residuals are taken at every row, all as displacements: the mismatch of the two roads and the
two body equations divided by k_s (by a constant where springs are doubted: `body_divisors`). White
acceleration noise of densities n_s, n_u enters them as

    s^2 R_i   : [1 + (m_u s^2 + c_s s + k_s)/K] n_u - [(c_s s + k_s)/K] n_s,  K = k_u + c_u s
    s^2 b_i   : [(m_ii s^2 + c_s s)/k_s + 1] n_s - [c_s s/k_s + 1] n_u + [m_12 s^2/k_s] n_s'

(front less rear in the mismatch; n_s' is the noise of the other body sensor). Rows are low-passed,
decimated and differenced twice by one FIR filter; the noise is then stationary with a covariance
that vanishes beyond the filter's length, so that a banded Cholesky factor whitens it exactly, ends
included. The front's residuals of a row are taken when the front wheel was where the rear wheel is
now, so that a sensor which speaks in both is taken for two.

Springs that rub and dampers that are not linear put a force into the body equations that is noise
of its own, of a level that the rows themselves tell (`force_noise`). The mismatch is then taken
from inertia alone, s^2 R_i: [1 + m_u s^2/K] n_u + [m_ii s^2/K] n_s + [m_12 s^2/K] n_s'. Both forms
differ by (k_s/K) b_i and tell the same; but which combination of rows is quiet depends on the
truck, and each form has it in a row of its own where it is needed. Friction remembers for a tenth
of a second; a window that keeps its covariance positive (Bohman's) ends that memory altogether, so
that the rows' covariance vanishes beyond it and the filter's length.

Where the two axles do not feel the same road, their difference is noise of the mismatch alone
(`crossing.mismatch`).

Longer than other modules: filter, levels of noise and covariance are all made of the responses
above, which stand once.
"""

from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pre_core.crossing import mismatch as _mismatch
from pre_core.crossing.channels import low_pass
from pre_core.crossing.mismatch import Mismatch
from pre_core.crossing.whittle import likeliest_levels
from pre_core.kernels.lanes import summing
from pre_core.physics.vehicle import masses_above_axles
from pre_core.unknowns import C_S1, C_U1, D_1, K_S1, K_U1, KAPPA, M_U1

FloatArray = NDArray[np.float64]

RESIDUALS = 3
DOUBTED_SPRING_N_PER_M = 4e5
"""What body equations are divided by where springs are doubted. Divided by the stiffness that is
sought, what the springs leave would be the smaller the stiffer they are taken to be: a pull, which
can be taken off only as well as its level is known. (Friction of 2 to 10 %: EI 0.4 standard
deviations too low.) Believed springs are divided by their own: the sensors' noise is known."""
_SOURCES = 6  # s1, s2, u1, u2; and the other body sensor at the front's and at the rear's moment
EVERY = 3
"""A row every so many samples of the model."""
PASS = 1.0 / 8.0
"""What is below this share of the model's rate passes whole; half is left at half the rows'
rate."""
_STOP_BAND_DB = 70.0
"""What leaks through is 3e-4 of a signal, which is then thinned out and must not alias."""
_TABLE = 1024  # frequencies of the numerical integral over the noise spectrum
_FEW_FREQUENCIES = 48
"""Middles of even intervals up to half the rows' rate, for a trace that is taken again and
again."""
_MANY_FREQUENCIES = 512
"""Enough for phases that turn with the time from axle to axle."""
_SETTLED = 1e-12
"""From a relative change by less than this on, rows of the factor repeat to rounding."""
_FORCE_CENTRES_HZ = np.arange(0.0, 60.0, 4.0)
FORCE_SHAPES = _FORCE_CENTRES_HZ.size
"""The spectrum of the force noise is a sum of bumps about these frequencies, a few hertz wide: that
of dry friction falls by six decades from the body's bounce to the rows' highest frequency."""
_FORCE_MEMORY_S = 0.3
"""Its covariance ends here, which is what makes the bumps as wide as they are."""
_MIDDLE_BAND, _TOP_BAND = (0.22, 0.54), (0.65, 0.757)
"""Shares of half the rows' rate: 12 to 30 and 36 to 42 Hz of sensors of 250 Hz and more."""
_EVENLY = 3.0
"""Noise of two to ten times the declared density has up to 1.6 times as much in the middle as at
the top before the truck is found; springs that rub, bilinear dampers and roads that differ 4 to
100 times."""
_BELIEVED_HZ = 30.0
"""Up to which springs are asked whether they are believed."""
DOUBTED, DOUBTED_OF_A_MISFIT = 60.0, 15.0
"""So much must twice the log-likelihood of an axle's rows gain for its springs to be doubted: less
where nothing else is known to explain why rows do not fit. Of 400 axles with nothing but sensors'
noise twelve gained more than 15, none more than 60."""


_RIDGES = (1e-10, 1e-7, 1e-5, 1e-3)
"""Relative white noise that is added, for rounding; more where the roads of a truck that was not
yet found seem to differ by so much that the sensors' noise is lost in the covariance's rounding."""


_ALIKE = 0.05
"""Tyres of which so little of the mismatch is seen that unlike ones make are alike, and what is
seen is an axle's offset, whose long waves are twice as large: short ones hardly tell them apart."""


class RowFilter(NamedTuple):
    """Low-pass, decimation and second difference in one: row k sees samples from k `every` on."""

    taps: FloatArray
    every: int
    step_s: float
    """The step of the samples before the filter."""
    omega: FloatArray  # (f,) middles of even intervals of angular frequency, up to where it stops
    power: FloatArray  # (f,) from white noise of an acceleration to the rows, times the interval
    turn: NDArray[np.complex128]  # (f, lags) phase that a wave gains from row to row


class Truck(NamedTuple):
    """What the sensors' noise passes through: parameters and the body's masses above the axles."""

    theta: FloatArray
    m_11: float
    m_22: float
    m_12: float
    is_inertial: bool
    """How the force on a tyre is found, see `residuals.Crossing`."""


def truck_of(
    theta: FloatArray, total_mass_kg: float, wheelbase_m: float, is_inertial: bool
) -> Truck:
    """The truck of theta (p,) as noise meets it."""
    m_s = total_mass_kg - theta[M_U1] - theta[M_U1 + 1]
    masses = masses_above_axles(m_s, theta[D_1], wheelbase_m, theta[KAPPA])
    return Truck(theta, *masses, is_inertial)


def linear_springs() -> FloatArray:
    """Levels (2, shapes) of force noise where springs and dampers are believed."""
    return np.zeros((2, FORCE_SHAPES))


def _force_shapes(omega: FloatArray) -> FloatArray:
    """(shapes, f): spectra of B(t) cos(omega_k t) with Bohman's window B, a half at their tops.

    B is the half wave cos(pi t/T) convolved with itself, so that its spectrum is a square.
    """
    centre = 2.0 * np.pi * _FORCE_CENTRES_HZ[:, None]
    return _bohman(omega - centre) + _bohman(omega + centre)


def _bohman(omega: FloatArray) -> FloatArray:
    """Spectrum of Bohman's window that ends at +-`_FORCE_MEMORY_S`, a half at frequency zero."""
    turn = omega * _FORCE_MEMORY_S
    apart = 1.0 - (turn / np.pi) ** 2
    near = np.abs(apart) < 1e-6
    wave = np.where(near, 0.25 * np.pi, np.cos(0.5 * turn) / np.where(near, 1.0, apart))
    return np.asarray(0.5 * wave**2)


class Whitener(NamedTuple):
    """Lower banded Cholesky factor of the noise covariance of the interleaved filtered rows."""

    factor: FloatArray  # (3 m, band + 1): row i holds columns i - band … i
    reciprocal: FloatArray  # (3 m,) of the diagonal


def row_filter(step_s: float) -> RowFilter:
    """Pass what is below an eighth of the model's rate; see `PASS`."""
    stop = 1.0 / EVERY - PASS
    apart = EVERY * step_s
    second_difference = np.zeros(2 * EVERY + 1)
    second_difference[[0, EVERY, 2 * EVERY]] = np.array([1.0, -2.0, 1.0]) / apart**2
    taps = np.convolve(low_pass(PASS, stop, _STOP_BAND_DB), second_difference)
    interval = 1.1 * stop / step_s / _TABLE
    omega = 2.0 * np.pi * interval * (np.arange(_TABLE) + 0.5)
    # The taps are symmetrical: their response is real but for a delay.
    offsets = np.arange(taps.size) - taps.size // 2
    response = np.cos(np.outer(omega * step_s, offsets)) @ taps
    # Noise of an acceleration reaches displacements through 1/omega^2; the taps contain the second
    # difference, so that the product is finite at low frequencies.
    power = response**2 / omega**4 * interval
    lags = (taps.size - 1) // EVERY + 1
    turn = np.exp(1j * np.outer(omega * apart, np.arange(lags)))
    return RowFilter(taps, EVERY, step_s, np.asarray(omega), power, turn)


def row_count(rows: RowFilter, samples: int) -> int:
    """How many rows see no end of so many samples."""
    return max(0, (samples - rows.taps.size) // rows.every + 1)


@summing
def filter_rows(taps: FloatArray, every: int, x: FloatArray, out: FloatArray) -> None:
    """Rows of x (n,) into out (m,); the taps are symmetrical."""
    for k in range(out.size):
        seen = x[k * every : k * every + taps.size]
        total = 0.0
        for j in range(taps.size):
            total += taps[j] * seen[j]
        out[k] = total


def _estimation(truck: Truck, omega: FloatArray) -> NDArray[np.complex128]:
    """What the truck's equations make of its accelerations: (4, 4, f).

    Rows are s² times the input profiles R_1, R_2 and the body equations; columns s1, s2, u1, u2.
    """
    s = 1j * omega
    theta = truck.theta
    out = np.zeros((4, 4, omega.size), dtype=np.complex128)
    for w, m_ii in enumerate((truck.m_11, truck.m_22)):
        c, k = theta[C_S1 + w], theta[K_S1 + w]
        tyre, m_u = theta[K_U1 + w] + theta[C_U1 + w] * s, theta[M_U1 + w]
        if truck.is_inertial:
            out[w, 2 + w] = 1.0 + m_u * s**2 / tyre
            out[w, w] = m_ii * s**2 / tyre
            out[w, 1 - w] = truck.m_12 * s**2 / tyre
        else:
            out[w, 2 + w] = 1.0 + (m_u * s**2 + c * s + k) / tyre
            out[w, w] = -(c * s + k) / tyre
        over = body_divisors(truck)[w]
        out[2 + w, w] = (m_ii * s**2 + c * s + k) / over
        out[2 + w, 2 + w] = -(c * s + k) / over
        out[2 + w, 1 - w] = truck.m_12 * s**2 / over
    return out


def _responses(truck: Truck, omega: FloatArray) -> NDArray[np.complex128]:
    """From the noise of the six sources to the residuals: (3, 6, f), displacements."""
    estimation = _estimation(truck, omega)
    out = np.zeros((RESIDUALS, _SOURCES, omega.size), dtype=np.complex128)
    for w, sign in ((0, 1.0), (1, -1.0)):
        # Another body sensor than the axle's own speaks at another moment: sources 4 and 5.
        for source, channel in ((w, w), (2 + w, 2 + w), (4 + w, 1 - w)):
            out[0, source] = sign * estimation[w, channel]
            out[1 + w, source] = estimation[2 + w, channel]
    return out


def body_divisors(truck: Truck) -> FloatArray:
    """What the body equations (2,) are divided by, in N/m."""
    if truck.is_inertial:
        return np.full(2, DOUBTED_SPRING_N_PER_M)
    return truck.theta[K_S1 : K_S1 + 2]


def _spectrum(
    truck: Truck,
    density: FloatArray,
    force: FloatArray,
    road: Mismatch | None,
    omega: FloatArray,
) -> NDArray[np.complex128]:
    """One-sided spectra of the residuals' noise as accelerations: (3, 3, f).

    `force` (2, shapes) in N²/Hz is that of what springs and dampers do besides their linear part,
    `road` what the axles' roads differ by.
    """
    responses = _responses(truck, omega)
    sources = np.concatenate([density, density[[1, 0]]])
    weighted = responses * (sources**2)[None, :, None]
    spectrum = np.asarray(np.einsum("icf,jcf->ijf", weighted, responses.conj()))
    if force.any():
        spectrum[[1, 2], [1, 2]] += _of_force(truck, force, omega)
    if road is not None:
        spectrum[0, 0] += omega**4 * _mismatch.spectrum(road, omega)
    return spectrum


def _of_body(truck: Truck, density: FloatArray, force: FloatArray, omega: FloatArray) -> FloatArray:
    """The spectra of the body equations (2, f) out of `_spectrum`."""
    return np.asarray(_spectrum(truck, density, force, None, omega)[[1, 2], [1, 2]].real)


def _of_force(truck: Truck, force: FloatArray, omega: FloatArray) -> FloatArray:
    """What the force noise adds to the spectra of the body equations: (2, f)."""
    over = body_divisors(truck)[:, None]
    return np.asarray((force @ _force_shapes(omega)) * omega**4 / over**2)


def whitener(
    rows: RowFilter,
    count: int,
    truck: Truck,
    density: FloatArray,
    force: FloatArray,
    road: Mismatch | None = None,
) -> Whitener:
    """Factor for `count` filtered rows; `density` (4,) is one-sided, in m/s²/√Hz.

    `force` (2, shapes) is the springs' noise in N²/Hz (`linear_springs` where there is none),
    `road` the mismatch of the axles' roads. Raises ValueError where the densities leave some row
    without noise.
    """
    spectrum = _spectrum(truck, density, force, road, rows.omega) * rows.power
    memory = _FORCE_MEMORY_S if force.any() else 0.0
    if road is not None:
        memory = max(memory, _mismatch.memory_s(road))
    covariance = np.real(spectrum @ _turn(rows, memory))  # E[e_i(t + lag) e_j(t)]
    lags = covariance.shape[2]
    band = RESIDUALS * lags - 1
    one = np.zeros((RESIDUALS, band + 1))
    for lag in range(lags):
        for i in range(RESIDUALS):
            for j in range(RESIDUALS):
                offset = RESIDUALS * lag + i - j  # row (k + lag, i) against column (k, j)
                if 0 <= offset <= band:
                    one[i, band - offset] = covariance[i, j, lag]
    diagonal = one[:, band].copy()
    for more in _RIDGES:
        one[:, band] = diagonal * (1.0 + more)
        factor = np.zeros((RESIDUALS * count, band + 1))
        if _cholesky(one, factor):
            return Whitener(factor, 1.0 / factor[:, band])
    raise ValueError("the noise covariance is not positive: are all densities above zero?")


def _turn(rows: RowFilter, memory_s: float) -> NDArray[np.complex128]:
    """Phases (f, lags) from row to row, for noise that itself remembers for `memory_s`."""
    if memory_s == 0.0:
        return rows.turn
    apart = rows.every * rows.step_s
    first = rows.turn.shape[1]
    more = np.arange(first, first + int(np.ceil(memory_s / apart)))
    return np.concatenate([rows.turn, np.exp(1j * np.outer(rows.omega * apart, more))], axis=1)


class _Folded(NamedTuple):
    """Frequencies up to half the rate of the rows, and those that fold on to them."""

    below: FloatArray
    above: FloatArray
    power_below: FloatArray
    power_above: FloatArray


def _folded(rows: RowFilter, count: int) -> _Folded:
    half = 0.5 / (rows.every * rows.step_s)
    step = 2.0 * np.pi * half / count
    below = step * (np.arange(count, dtype=np.float64) + 0.5)
    above = 4.0 * np.pi * half - below
    power_below, power_above = (
        np.interp(omega, rows.omega, rows.power) for omega in (below, above)
    )
    return _Folded(below, above, power_below, power_above)


def _folded_spectrum(
    at: _Folded, truck: Truck, density: FloatArray, force: FloatArray, road: Mismatch | None
) -> NDArray[np.complex128]:
    """Spectra of the rows (f, 3, 3), with what folds on to them."""
    both = np.concatenate([at.below, at.above])
    power = np.concatenate([at.power_below, at.power_above])
    whole = _spectrum(truck, density, force, road, both) * power
    low, high = np.split(whole, 2, axis=2)
    return np.moveaxis(low + high.conj(), 2, 0)


def noise_power(
    rows: RowFilter,
    trucks: list[Truck],
    density: FloatArray,
    force: FloatArray,
    which: list[int],
    road: Mismatch | None = None,
) -> FloatArray:
    """What tr(C_0^-1 C) per row becomes for other trucks, less what it is for the first: (w,).

    `which` (w,) counts from the second truck on; `density` (trucks, 4). The rows' spectra are those
    of an endless record, folded at half the rate of the rows.
    """
    at = _folded(rows, _FEW_FREQUENCIES)
    folded = partial(_folded_spectrum, at, force=force, road=road)
    first = np.linalg.inv(folded(trucks[0], density[0]))
    traces = [
        np.einsum("fij,fji->", first, folded(trucks[1 + k], density[1 + k])).real for k in which
    ]
    return np.asarray(traces) / _FEW_FREQUENCIES - RESIDUALS


def mismatch_power(
    rows: RowFilter,
    trucks: list[Truck],
    gains: FloatArray,
    delays_s: FloatArray,
    density: FloatArray,
    force: FloatArray,
    road: Mismatch,
    wheelbase_m: float,
    which: list[int],
) -> FloatArray:
    """E[r' C_0^-1 (r_k - r)] per row, of what the mismatch alone leaves in them: (w,).

    The wheels answer to the road that they feel, so that the mismatch is in the rows and in what
    the truck makes of its accelerations too: errors in variables, which would pull towards trucks
    that see less of it. With r the rows of the first truck and r_k those of another (of channels
    with `gains` and `delays_s`, (trucks, 4) each), E = M_k M_0^-1 - 1 says how the latter mixes the
    input profiles, which differ by d; the front is read when it was where the rear is now.
    """
    at = _folded(rows, _MANY_FREQUENCIES)

    def crossed(omega: FloatArray, power: FloatArray) -> NDArray[np.complex128]:
        """(w, 3, f): E[(r_k - r)_l conj(r_0)], of which r_0, the mismatch, is d itself."""
        s = 1j * omega

        def estimation(k: int) -> NDArray[np.complex128]:
            channel = (1.0 + gains[k])[:, None] * np.exp(np.outer(delays_s[k], s))
            return np.moveaxis(_estimation(trucks[k], omega) * channel, 2, 0)

        inverse = np.linalg.inv(estimation(0))
        of_all = omega**4 * power * _mismatch.spectrum(road, omega)
        of_front = omega**4 * power * _mismatch.leaning(road, omega)
        of_rear = of_front - of_all  # what the rear feels, with d
        turn = np.exp(s * wheelbase_m / road.speed_m_per_s)
        out = np.empty((len(which), RESIDUALS, omega.size), dtype=np.complex128)
        for number, k in enumerate(which):
            e = np.moveaxis(estimation(1 + k) @ inverse, 0, 2) - np.eye(4)[:, :, None]
            out[number, 0] = of_front * (e[0, 0] - turn * e[1, 0])
            out[number, 0] += of_rear * (turn.conj() * e[0, 1] - e[1, 1])
            out[number, 1] = of_front * e[2, 0] + of_rear * turn.conj() * e[2, 1]
            out[number, 2] = of_front * turn * e[3, 0] + of_rear * e[3, 1]
        return out

    weight = np.linalg.inv(_folded_spectrum(at, trucks[0], density, force, road))[:, 0]
    both = crossed(at.below, at.power_below) + crossed(at.above, at.power_above).conj()
    return np.einsum("fl,wlf->w", weight, both).real / _MANY_FREQUENCIES


def mismatch_levels(
    rows: RowFilter,
    truck: Truck,
    density: FloatArray,
    road: Mismatch,
    stretches: list[FloatArray],
    roads: list[FloatArray],
) -> tuple[FloatArray, float, FloatArray]:
    """Return levels (s,) in m³ that stretches of the mismatch's rows show, and what they gain.

    The gain is that of their likelihood over nothing; the third are the levels (s,) that the
    declared axles have on a surface as rough as the road.

    Each stretch (m,) is of consecutive filtered rows to which no bridge adds anything; `roads` are
    rows of what one axle felt there, taken for the front one, by which an axle's offset is not
    taken for larger than offsets are.
    """
    omega, shapes = rows.omega, road.shapes
    table = np.concatenate([shapes.density, shapes.road[None, :]])
    shape = omega**4 * _mismatch.density_at(road, omega, table) * rows.power
    longest = max(stretch.size for stretch in stretches)
    memory = min(_mismatch.memory_s(road), longest * rows.every * rows.step_s)
    turn = _turn(rows, memory)
    sensors = _spectrum(truck, density, linear_springs(), None, omega)[0, 0].real * rows.power
    of_sensors, of_shapes = (sensors @ turn).real, (shape @ turn).real
    whole = [_mismatch.segment(one, of_sensors, of_shapes[-1:]) for one in roads]
    metres = rows.every * rows.step_s * road.speed_m_per_s
    surface = _mismatch.surface_level(shapes, whole, [metres * one.size for one in roads])
    expected = surface * shapes.expected_m
    usual = np.array([np.inf, expected[1]])
    parts = [_mismatch.segment(one, of_sensors, of_shapes[:-1]) for one in stretches]
    level, gain = _mismatch.levels(parts, usual)
    if level[0] >= _ALIKE * expected[0]:
        return level, gain, expected
    alike = [part._replace(shapes=part.shapes[1:]) for part in parts]
    level, gain = _mismatch.levels(alike, usual[1:])
    return np.concatenate([[0.0], level]), gain, expected


def force_noise(
    rows: RowFilter,
    truck: Truck,
    density: FloatArray,
    body: FloatArray,
    enough: float = DOUBTED,
) -> FloatArray:
    """Levels (2, shapes) of the springs' noise in N²/Hz that the body equations' rows (2, m) show.

    The most likely ones beside the sensors' noise, by the periodogram (`whittle`). An axle
    whose springs are as linear as its sensors can tell has none: one that gains no more than
    `enough`.
    """
    _, shown, sensors, shapes = _body_periodogram(rows, truck, density, body)
    over = body_divisors(truck)
    levels = linear_springs()
    for axle in range(2):
        shape = shapes / over[axle] ** 2
        seen, known = shown[axle], sensors[axle]
        level = np.full(FORCE_SHAPES, seen.mean()) / shape.mean(axis=1)
        level, gain = likeliest_levels(seen, known, shape, level)
        if gain > enough:
            levels[axle] = level
    return levels


def _body_periodogram(
    rows: RowFilter, truck: Truck, density: FloatArray, body: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Frequencies (f,) of the body equations' rows (2, m), and what is there.

    Their periodogram (2, f), what the sensors' noise makes of it (2, f), and each shape of force
    noise (shapes, f).
    """
    m = body.shape[1]
    window = np.hanning(m)
    apart = rows.every * rows.step_s
    shown = np.abs(np.fft.rfft(body * window, axis=1)[:, 1:]) ** 2
    shown *= 2.0 * apart / np.sum(window**2)
    omega = np.asarray(2.0 * np.pi * np.fft.rfftfreq(m, apart)[1:], dtype=np.float64)
    shapes = np.zeros((FORCE_SHAPES, omega.size))
    sensors = np.zeros((2, omega.size))
    interval = (rows.omega[1] - rows.omega[0]) / (2.0 * np.pi)
    for at in (omega, 4.0 * np.pi * (0.5 / apart) - omega):  # what is above half the rate folds
        power = np.interp(at, rows.omega, rows.power) / interval
        sensors += _of_body(truck, density, linear_springs(), at) * power
        shapes += _force_shapes(at) * at**4 * power
    return omega, shown, sensors, shapes


def noise_floor(rows: RowFilter, truck: Truck, density: FloatArray, body: FloatArray) -> float:
    """So many times the sensors' declared power the body equations' rows (2, m) have, if evenly.

    The lesser of both axles, in the highest band of the rows, where nothing but noise is; one where
    lower frequencies have more than `_EVENLY` times that, as what springs or a wrong truck leave.
    """
    omega, shown, sensors, _ = _body_periodogram(rows, truck, density, body)
    share = omega * (rows.every * rows.step_s / np.pi)
    ratio = shown / sensors
    low, top = (
        np.median(ratio[:, (share > begin) & (share < end)], axis=1) / np.log(2.0)
        for begin, end in (_MIDDLE_BAND, _TOP_BAND)
    )
    return float(top.min()) if np.all(low < _EVENLY * top) else 1.0


def belief_in_springs(
    rows: RowFilter, truck: Truck, density: FloatArray, force: FloatArray
) -> float:
    """0 to 1: which part of what the sensors could tell by the body equations the springs leave."""
    low = rows.omega[rows.omega < 2.0 * np.pi * _BELIEVED_HZ]
    sensors = _of_body(truck, density, linear_springs(), low)
    return float((sensors / _of_body(truck, density, force, low)).mean())


@summing
def _cholesky(one: FloatArray, a: FloatArray) -> bool:
    """Factor the banded covariance that repeats the rows `one` (3, band + 1) into a (n, band + 1).

    Rows of the factor converge to rows that repeat too; from there on they are copied.
    """
    n, width = a.shape
    band = width - 1
    kinds = one.shape[0]
    settled = False
    for i in range(n):
        if settled:
            for j in range(width):
                a[i, j] = a[i - kinds, j]
            continue
        change = 0.0
        for j in range(max(0, i - band), i + 1):
            low = max(0, i - band)  # columns before it are zero in row i
            total = one[i % kinds, j - i + band]
            x = a[i, low - i + band : j - i + band]
            y = a[j, low - j + band : band]
            for k in range(x.size):
                total -= x[k] * y[k]
            if i == j:
                if not total > 0.0:
                    return False
                a[i, band] = np.sqrt(total)
            else:
                a[i, j - i + band] = total / a[j, band]
        if i >= band + kinds and i % kinds == kinds - 1:
            for back in range(kinds):
                for j in range(width):
                    step = a[i - back, j] - a[i - back - kinds, j]
                    change = max(change, abs(step) / a[i - back, band])
            settled = change < _SETTLED
    return True


@summing
def solve(factor: FloatArray, reciprocal: FloatArray, b: FloatArray) -> None:
    """Forward substitution of one right-hand side b (n,) in place."""
    n, width = factor.shape
    band = width - 1
    for i in range(n):
        low = max(0, i - band)
        x = factor[i, low - i + band : band]
        y = b[low:i]
        total = b[i]
        for k in range(x.size):
            total -= x[k] * y[k]
        b[i] = total * reciprocal[i]


@summing
def whiten_into(
    rows: RowFilter, noise: Whitener, residuals: FloatArray, row: FloatArray, out: FloatArray
) -> None:
    """Filter and interleave residuals (3, n), and whiten them into `out` (3 m,).

    `row` (m,) is a work array.
    """
    for i in range(RESIDUALS):
        filter_rows(rows.taps, rows.every, residuals[i], row)
        for k in range(row.size):
            out[RESIDUALS * k + i] = row[k]
    solve(noise.factor, noise.reciprocal, out)


def white_rows(rows: RowFilter, noise: Whitener, residuals: FloatArray) -> FloatArray:
    """White rows (…, 3 m) of residuals (…, 3, n): filtered, interleaved, of unit variance.

    Raises ValueError if the whitener was made for another number of rows.
    """
    *many, kinds, n = residuals.shape
    count = row_count(rows, n)
    if kinds != RESIDUALS or noise.reciprocal.size != RESIDUALS * count:
        raise ValueError(
            f"residuals of shape {residuals.shape} give {kinds} x {count} rows, the whitener is "
            f"for {RESIDUALS} x {noise.reciprocal.size // RESIDUALS}"
        )
    flat = np.ascontiguousarray(residuals).reshape(-1, RESIDUALS, n)
    out = np.empty((flat.shape[0], RESIDUALS * count))
    row = np.empty(count)
    for k in range(flat.shape[0]):
        whiten_into(rows, noise, flat[k], row, out[k])
    return out.reshape(*many, RESIDUALS * count)
