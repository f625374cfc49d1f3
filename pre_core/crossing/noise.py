"""Propagation of sensor noise, suspension noise and profile mismatch to the residuals.

There are three kinds of residuals, all as displacements: the profile mismatch and the two body
equations divided by k_s (by a constant where their weight is reduced: `body_divisors`). White
acceleration noise of one-sided amplitude densities n_s, n_u in m/s²/√Hz (the argument `density`
(4,) of the functions below: s1, s2, u1, u2) enters them as

    s^2 R_i   : [1 + (m_u s^2 + c_s s + k_s)/K] n_u - [(c_s s + k_s)/K] n_s,  K = k_u + c_u s
    s^2 b_i   : [(m_ii s^2 + c_s s)/k_s + 1] n_s - [c_s s/k_s + 1] n_u + [m_12 s^2/k_s] n_s'

(front minus rear in the mismatch; n_s' is the noise of the other body sensor). The front axle's
residuals are taken when its wheel was at the rear wheel's present place, so a sensor that enters
both counts as two independent ones.

Friction and nonlinear dampers put a random force, the suspension noise, into the body equations, of
a level that the residuals determine (`suspension_noise_levels`). The mismatch is then computed from
inertia alone, s^2 R_i: [1 + m_u s^2/K] n_u + [m_ii s^2/K] n_s + [m_12 s^2/K] n_s'. The two forms
differ by (k_s/K) b_i and contain the same information; but which combination has little noise
depends on the truck, and each form isolates it where it is needed. Friction is
correlated over a tenth of a second; the Bohman window, which keeps its covariance positive,
truncates this, so that the residuals' covariance vanishes beyond it and the filter's length.

Where the two axles follow different profiles, their difference is noise of the mismatch alone
(`crossing.mismatch`).
"""

from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pre_core.arrays import FloatArray
from pre_core.crossing import mismatch as _mismatch
from pre_core.crossing.mismatch import Mismatch
from pre_core.crossing.rows import RESIDUALS, RowFilter, autocovariances
from pre_core.crossing.suspension_noise import (
    FORCE_SHAPES,
    REDUCED_WEIGHT_FACTOR,
    REDUCED_WEIGHT_SPRING_N_PER_M,
    force_shapes,
)
from pre_core.crossing.whittle import maximum_likelihood_levels
from pre_core.parameters import C_S1, C_U1, D_1, K_S1, K_U1, KAPPA, M_U1, SHARE
from pre_core.physics import tandem as tandem_equations
from pre_core.physics.tandem import NO_TANDEM, TandemTruck
from pre_core.physics.vehicle import masses_above_axles

_SOURCES = 6  # s1, s2, u1, u2; and the other body sensor at the front's and at the rear's moment
_FEW_FREQUENCIES = 48
"""Midpoints of even intervals up to half the residuals' rate, for a trace that is computed
repeatedly."""
_MIDDLE_BAND, _TOP_BAND = (0.22, 0.54), (0.65, 0.757)
"""Bands relative to half the residuals' rate: 12 to 30 and 36 to 42 Hz for sensors of 250 Hz and
more."""
_EVEN_NOISE_RATIO = 3.0
"""Largest ratio of the middle to the top band of sensor noise. Noise of two to ten times the
declared density has up to 1.6 before the truck is found; friction, bilinear dampers and mismatch 4
to 100."""
_SUSPENSION_BAND_HZ = 30.0
"""Highest frequency in the weight of the body equations."""
FRICTION_STATISTIC, FRICTION_STATISTIC_OF_MISFIT = 60.0, 15.0
"""Likelihood-ratio statistic (`whittle`) of an axle's residuals that reduces the weight of its
body equations: the second where nothing else explains a misfit. Of 400 axles with sensor
noise alone twelve had more than 15, none more than 60."""
_EQUAL_TYRES = 0.05
"""Level of unequal tyres, relative to the declared tyres' level, below which tyres count as equal.
The mismatch is then that of an axle's offset, whose long waves are twice as large; short waves
hardly distinguish the two."""


class NoisePath(NamedTuple):
    """Parameters of a truck that determine how sensor noise enters the residuals."""

    theta: FloatArray
    m_11: float
    m_22: float
    m_12: float
    is_inertial: bool
    """Whether the tyre force is computed from the masses above it (`arguments.GriddedCrossing`)."""
    tandem: TandemTruck = NO_TANDEM
    """Truck with a tandem: then the masses above are not used, and the body has no
    equations."""
    total_mass_kg: float = 0.0
    gap_m: float = 0.0
    """Distance between the axles of the tandem."""
    lag_s: float = 0.0
    """Time in which the truck covers `gap_m`."""


def noise_path(
    theta: FloatArray,
    total_mass_kg: float,
    wheelbase_m: float,
    is_inertial: bool,
    tandem: TandemTruck = NO_TANDEM,
    speed_m_per_s: float = 0.0,
) -> NoisePath:
    """Return the noise path of theta (p,); `wheelbase_m` is between the compared axles.

    The speed matters only for a tandem whose axles have springs of their own.
    """
    if tandem.ahead_m > 0.0:
        lag_s = wheelbase_m / speed_m_per_s if speed_m_per_s > 0.0 else 0.0
        return NoisePath(theta, 0.0, 0.0, 0.0, True, tandem, total_mass_kg, wheelbase_m, lag_s)
    m_s = total_mass_kg - theta[M_U1] - theta[M_U1 + 1]
    masses = masses_above_axles(m_s, theta[D_1], wheelbase_m, theta[KAPPA])
    return NoisePath(theta, *masses, is_inertial)


def force_masses(truck: NoisePath) -> FloatArray:
    """Return the masses (2, 2) in kg that multiply the body's readings in the axles' forces."""
    if truck.tandem.ahead_m == 0.0:
        return np.array([[truck.m_11, truck.m_12], [truck.m_12, truck.m_22]])
    load = tandem_equations.shared_load(truck.tandem, truck.theta, truck.total_mass_kg, truck.gap_m)
    share = truck.theta[SHARE]
    return np.outer([share, 1.0 - share], [load.bogie_1, load.bogie_2])


def no_suspension_noise() -> FloatArray:
    """Return zero levels (2, shapes) of suspension noise, in N²/Hz."""
    return np.zeros((2, FORCE_SHAPES))


def estimation_matrix(truck: NoisePath, omega: FloatArray) -> NDArray[np.complex128]:
    """Return the truck's equations as factors (4, 4, f) of its accelerations, at `omega` (f,).

    Rows are s² times the input profiles R_1, R_2 and s² times the body equations divided by
    `body_divisors`; columns are the accelerations s1, s2, u1, u2.
    """
    s = 1j * omega
    theta = truck.theta
    if truck.tandem.ahead_m > 0.0:
        of_tandem = tandem_equations.profile_equations(
            truck.tandem, theta, truck.total_mass_kg, truck.gap_m, omega
        )
        of_tandem[3] /= REDUCED_WEIGHT_SPRING_N_PER_M
        return of_tandem
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


def _responses(truck: NoisePath, omega: FloatArray) -> NDArray[np.complex128]:
    """Return the response (3, 6, f) from the noise of six sources to displacement residuals."""
    estimation = estimation_matrix(truck, omega)
    if not truck.tandem.is_equalised:
        return tandem_equations.sensor_responses(estimation)
    out = np.zeros((RESIDUALS, _SOURCES, omega.size), dtype=np.complex128)
    for w, sign in ((0, 1.0), (1, -1.0)):
        # The other axle's body sensor enters at another time: sources 4 and 5.
        for source, channel in ((w, w), (2 + w, 2 + w), (4 + w, 1 - w)):
            out[0, source] = sign * estimation[w, channel]
            if truck.tandem.ahead_m == 0.0:
                out[1 + w, source] = estimation[2 + w, channel]
    return out


def body_divisors(truck: NoisePath) -> FloatArray:
    """Return the divisors (2,) of the body equations, in N/m."""
    if truck.is_inertial:
        return np.full(2, REDUCED_WEIGHT_SPRING_N_PER_M)
    return truck.theta[K_S1 : K_S1 + 2]


def noise_spectrum(
    truck: NoisePath,
    density: FloatArray,
    force: FloatArray,
    mismatch: Mismatch | None,
    omega: FloatArray,
) -> NDArray[np.complex128]:
    """Return one-sided spectra of the residuals' noise as accelerations: (3, 3, f).

    `force` (2, shapes) in N²/Hz are the levels of suspension noise, multiplied by
    `REDUCED_WEIGHT_FACTOR` for the body equations; `omega` is (f,).
    """
    responses = _responses(truck, omega)
    sources = np.concatenate([density, density[[1, 0, 3, 2]]])[: responses.shape[1]]
    weighted = responses * (sources**2)[None, :, None]
    spectrum = np.asarray(np.einsum("icf,jcf->ijf", weighted, responses.conj()))
    if truck.tandem.ahead_m > 0.0:  # residuals that are always zero get some independent noise
        zero = [1, 2] if truck.tandem.is_equalised else [1]
        spectrum[zero, zero] += float(density @ density)
    if truck.tandem.ahead_m > 0.0 and force.any():
        over = body_divisors(truck)[1]
        friction = (force[1] @ force_shapes(omega)) * omega**4
        spectrum[2, 2] += friction / over**2
        spectrum[0, 0] += (
            friction
            / REDUCED_WEIGHT_FACTOR
            * tandem_equations.friction_transfer(
                truck.tandem, truck.theta, truck.gap_m, truck.lag_s, omega
            )
        )
    elif force.any():
        spectrum[[1, 2], [1, 2]] += _suspension_noise_spectra(truck, force, omega)
    if mismatch is not None:
        spectrum[0, 0] += omega**4 * _mismatch.spectrum(mismatch, omega)
    return spectrum


def _body_spectra(
    truck: NoisePath, density: FloatArray, force: FloatArray, omega: FloatArray
) -> FloatArray:
    """Return the spectra (2, f) of the body equations in `noise_spectrum`, without mismatch."""
    return np.asarray(noise_spectrum(truck, density, force, None, omega)[[1, 2], [1, 2]].real)


def _suspension_noise_spectra(truck: NoisePath, force: FloatArray, omega: FloatArray) -> FloatArray:
    """Return the contribution of suspension noise to the spectra of the body equations: (2, f)."""
    over = body_divisors(truck)[:, None]
    return np.asarray((force @ force_shapes(omega)) * omega**4 / over**2)


class AliasedBands(NamedTuple):
    """Frequencies up to half the rate of the residuals, and those that alias to them.

    All arrays are (f,): angular frequencies, and the power that the filter passes there.
    """

    below: FloatArray
    above: FloatArray
    power_below: FloatArray
    power_above: FloatArray


def folded(rows: RowFilter, count: int) -> AliasedBands:
    """Return midpoints of `count` even bands up to half the residuals' rate, and their aliases."""
    half = 0.5 / (rows.every * rows.step_s)
    step = 2.0 * np.pi * half / count
    below = step * (np.arange(count, dtype=np.float64) + 0.5)
    above = 4.0 * np.pi * half - below
    power_below, power_above = (
        np.interp(omega, rows.omega, rows.power) for omega in (below, above)
    )
    return AliasedBands(below, above, power_below, power_above)


def folded_spectrum(
    at: AliasedBands,
    truck: NoisePath,
    density: FloatArray,
    force: FloatArray,
    mismatch: Mismatch | None,
) -> NDArray[np.complex128]:
    """Return `noise_spectrum` of the filtered residuals (f, 3, 3), including aliases."""
    both = np.concatenate([at.below, at.above])
    power = np.concatenate([at.power_below, at.power_above])
    whole = noise_spectrum(truck, density, force, mismatch, both) * power
    low, high = np.split(whole, 2, axis=2)
    return np.moveaxis(low + high.conj(), 2, 0)


def noise_power(
    rows: RowFilter,
    trucks: list[NoisePath],
    density: FloatArray,
    force: FloatArray,
    which: list[int],
    mismatch: Mismatch | None = None,
) -> FloatArray:
    """Return tr(C_0^-1 C) per residual sample for other trucks, minus that of the first: (w,).

    `which` (w,) are indices of these trucks, 0 for the second of `trucks`; `density` is (trucks,
    4), `force` (2, shapes). The spectra are those of an endless record of residuals, aliased at
    half their rate.
    """
    spectrum = partial(
        folded_spectrum, folded(rows, _FEW_FREQUENCIES), force=force, mismatch=mismatch
    )
    first = np.linalg.inv(spectrum(trucks[0], density[0]))
    traces = [
        np.einsum("fij,fji->", first, spectrum(trucks[1 + k], density[1 + k])).real for k in which
    ]
    return np.asarray(traces) / _FEW_FREQUENCIES - RESIDUALS


def mismatch_levels(
    rows: RowFilter,
    truck: NoisePath,
    density: FloatArray,
    mismatch: Mismatch,
    segments: list[FloatArray],
    roads: list[FloatArray],
    *,
    has_only_offset: bool = False,
) -> tuple[FloatArray, float, FloatArray]:
    """Return levels (s,) in m³ of segments of mismatch residuals, and a statistic.

    The statistic compares them with zero levels (`whittle`); the third value holds the
    levels (s,) of the declared axles on a surface as rough as the road. With `has_only_offset` the
    level of unequal tyres is zero.

    Each segment (m,) has consecutive filtered residuals unaffected by a bridge; `roads` are
    residuals of one axle's profile there, treated as the front one, which bound an axle's offset.
    """
    omega, shapes = rows.omega, mismatch.shapes
    table = np.concatenate([_mismatch.unwindowed(shapes), shapes.road[None, :]])
    sensors = noise_spectrum(truck, density, no_suspension_noise(), None, omega)[0, 0].real
    spectra = np.vstack([sensors, omega**4 * _mismatch.density_at(mismatch, omega, table)])
    longest = max(segment.size for segment in segments)
    covariances = autocovariances(rows, spectra, longest)
    of_sensors, of_shapes = covariances[0], covariances[1:]
    whole = [_mismatch.tapered_periodogram(one, of_sensors, of_shapes[-1:]) for one in roads]
    metres = rows.every * rows.step_s * mismatch.speed_m_per_s
    surface = _mismatch.surface_level(shapes, whole, [metres * one.size for one in roads])
    expected = surface * shapes.expected_m
    bands = expected.size - _mismatch.TRACK_SHAPES
    usual = np.append([np.inf, expected[1]], np.full(bands, np.inf))
    parts = [_mismatch.tapered_periodogram(one, of_sensors, of_shapes[:-1]) for one in segments]
    if not has_only_offset:
        level, statistic = _mismatch.estimate_levels(parts, usual, bands)
        if level[0] >= _EQUAL_TYRES * expected[0]:
            return level, statistic, expected
    alike = [part._replace(shapes=part.shapes[1:]) for part in parts]
    offset, statistic = _mismatch.estimate_levels(alike, usual[1:], bands)
    return np.append(0.0, offset), statistic, expected


def suspension_noise_levels(
    rows: RowFilter,
    truck: NoisePath,
    density: FloatArray,
    body: FloatArray,
    friction_statistic: float = FRICTION_STATISTIC,
) -> FloatArray:
    """Return levels (2, shapes) of suspension noise in N²/Hz from body equations (2, m).

    They are the most likely levels in addition to sensor noise (`whittle`). An axle with
    at most `friction_statistic` has linear suspension within sensor noise, and level zero.
    """
    _, shown, sensors, shapes = _body_periodogram(rows, truck, density, body)
    over = body_divisors(truck)
    levels = no_suspension_noise()
    for axle in range(2):
        shape = shapes / over[axle] ** 2
        observed, known = shown[axle], sensors[axle]
        level = np.full(FORCE_SHAPES, observed.mean()) / shape.mean(axis=1)
        level, statistic = maximum_likelihood_levels(observed, known, shape, level)
        if statistic > friction_statistic:
            levels[axle] = level
    return levels


def _body_periodogram(
    rows: RowFilter, truck: NoisePath, density: FloatArray, body: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return frequencies (f,) and spectra of the body equations' residuals (2, m).

    These are their periodogram (2, f), the expected sensor noise (2, f), and each shape of force
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
    for at in (omega, 4.0 * np.pi * (0.5 / apart) - omega):  # frequencies above half the rate alias
        power = np.interp(at, rows.omega, rows.power) / interval
        sensors += _body_spectra(truck, density, no_suspension_noise(), at) * power
        shapes += force_shapes(at) * at**4 * power
    return omega, shown, sensors, shapes


def noise_power_ratio(
    rows: RowFilter, truck: NoisePath, density: FloatArray, body: FloatArray
) -> float:
    """Return the ratio of sensor noise power to its declared value, from body equations (2, m).

    It is the smaller ratio of both axles in the highest band, which contains noise only. The result
    is 1.0 where lower frequencies exceed it by a factor of `_EVEN_NOISE_RATIO`, as with friction or
    wrong parameters of the truck.
    """
    omega, shown, sensors, _ = _body_periodogram(rows, truck, density, body)
    share = omega * (rows.every * rows.step_s / np.pi)
    ratio = shown / sensors
    low, top = (
        np.median(ratio[:, (share > begin) & (share < end)], axis=1) / np.log(2.0)
        for begin, end in (_MIDDLE_BAND, _TOP_BAND)
    )
    return float(top.min()) if np.all(low < _EVEN_NOISE_RATIO * top) else 1.0


def suspension_equation_weight(
    rows: RowFilter, truck: NoisePath, density: FloatArray, force: FloatArray
) -> float:
    """Return the body equations' weight: sensor noise's mean share (0 to 1) of all noise.

    `density` (4,) is that of the sensors, `force` (2, shapes) the suspension noise in N²/Hz.
    """
    low = rows.omega[rows.omega < 2.0 * np.pi * _SUSPENSION_BAND_HZ]
    sensors = _body_spectra(truck, density, no_suspension_noise(), low)
    weight = sensors / _body_spectra(truck, density, force, low)
    return float(weight[1 if truck.tandem.ahead_m > 0.0 else 0 :].mean())
