"""Whitening: sensor noise through plainly written residuals must come out white, of unit variance.

The residuals are written out here once more from displacements, velocities and accelerations; the
product's own residual code is not used. Pitch inertia is 0.3 of what keeps the axles apart, less
than any truck's, so that the noise of each body sensor reaches both body equations; what belongs to
the front is taken when the front wheel was where the rear wheel is now, 0.44 s before.
"""

from typing import NamedTuple

import numpy as np
import pytest
from scipy.linalg import cholesky_banded, solve_banded

from pre_core.arrays import FloatArray
from pre_core.constants import MICRO_G_M_PER_S2
from pre_core.crossing.channels import A_1, A_2, A, V, Z, channel_signals
from pre_core.crossing.noise import (
    NoisePath,
    no_suspension_noise,
    noise_power,
)
from pre_core.crossing.rows import (
    PASS_BAND,
    SAMPLES_PER_RESIDUAL,
    RowFilter,
    filter_rows,
    row_count,
    row_filter,
)
from pre_core.crossing.suspension_noise import REDUCED_WEIGHT_SPRING_N_PER_M
from pre_core.crossing.whitening import Whitener, whitener
from pre_core.parameters import C_S1, K_S1, K_U1, M_U1
from pre_core.physics.models import from_models
from pre_core.physics.sensors import white_noise
from pre_core.physics.vehicle import HalfCar, body_masses_kg
from services.simulation.drive import beam_of, paper_site, truck_of
from tests.numerics.whitened import white_rows

DENSITY_UG = np.array([25.0, 40.0, 60.0, 30.0])
"""Four different ones: swapped channels would show."""
RATES_HZ = (100.0, 200.0, 250.0, 500.0, 1000.0, 2000.0)
BETWEEN_AXLES_S = 0.44


class Case(NamedTuple):
    rate_hz: float
    rows: RowFilter
    noise: Whitener
    samples: int
    is_inertial: bool


def truck() -> HalfCar:
    return truck_of(paper_site().vehicles[0])._replace(
        pitch_inertia_ratio=0.3, tyre_damping_ns_per_m=(1100.0, 900.0)
    )


def theta() -> FloatArray:
    return from_models(truck(), beam_of(paper_site().bridges[0], np.ones(7)))


def declared_truck(*, is_inertial: bool = True) -> NoisePath:
    return NoisePath(theta(), *body_masses_kg(truck()), is_inertial)


def plain_residuals(signals: FloatArray, step_s: float, *, is_inertial: bool = True) -> FloatArray:
    """R_1 - R_2 and both body equations over k_s (3, n), at constant speed and off the bridge.

    The force on a tyre is that of the masses above it, or that of axle, spring and damper.
    """
    car = truck()
    m_11, m_22, m_12 = body_masses_kg(car)
    later = round(BETWEEN_AXLES_S / step_s)
    n = signals.shape[2] - later
    roads, bodies = [], []
    for w, mass in enumerate((m_11, m_22)):
        c, k = car.suspension_damping_ns_per_m[w], car.suspension_stiffness_n_per_m[w]
        m_u, k_u = car.unsprung_mass_kg[w], car.tyre_stiffness_n_per_m[w]
        then = signals[:, :, w * later : w * later + n]
        sprung, unsprung, other = then[w], then[2 + w], then[1 - w]
        # The tyre's force moves everything above it: F = k_u d + c_u d', solved for d by a series.
        # What is left out is (c_u s/k_u)^3, 0.4 % at 42 Hz.
        pull, *more = (
            c * (sprung[rate] - unsprung[rate]) + k * (sprung[order] - unsprung[order])
            for order, rate in ((Z, V), (V, A), (A, A_1))
        )
        force, rate, bend = (
            m_u * unsprung[order]
            + (mass * sprung[order] + m_12 * other[order] if is_inertial else -below)
            for order, below in zip((A, A_1, A_2), (pull, *more), strict=True)
        )
        tau = car.tyre_damping_ns_per_m[w] / k_u
        roads.append(unsprung[Z] + (force - tau * rate + tau**2 * bend) / k_u)
        over = REDUCED_WEIGHT_SPRING_N_PER_M if is_inertial else k
        bodies.append((mass * sprung[A] + m_12 * other[A] + pull) / over)
    return np.stack([roads[0] - roads[1], *bodies])


def case(
    rate_hz: float,
    samples: int,
    density_ug: FloatArray = DENSITY_UG,
    declared: NoisePath | None = None,
) -> Case:
    model = channel_signals(np.zeros((4, samples)), 1.0 / rate_hz, rate_hz)
    rows = row_filter(model.step_s)
    declared = declared_truck() if declared is None else declared
    noise = whitener(
        rows,
        row_count(rows, model.signals.shape[2] - round(BETWEEN_AXLES_S / model.step_s)),
        declared,
        density_ug * MICRO_G_M_PER_S2,
        no_suspension_noise(),
    )
    return Case(rate_hz, rows, noise, samples, declared.is_inertial)


def white_noise_rows(case: Case, seed: int) -> FloatArray:
    """White rows (m, 3) of one drive of nothing but sensor noise."""
    rng = np.random.default_rng(seed)
    noise = np.stack(
        [
            white_noise(case.samples, case.rate_hz, density * MICRO_G_M_PER_S2, rng)
            for density in DENSITY_UG
        ]
    )
    model = channel_signals(noise, 1.0 / case.rate_hz, case.rate_hz)
    residuals = plain_residuals(model.signals, model.step_s, is_inertial=case.is_inertial)
    return white_rows(case.rows, case.noise, residuals).reshape(-1, 3)


@pytest.mark.parametrize("is_inertial", [True, False])
@pytest.mark.parametrize("rate_hz", RATES_HZ)
def test_sensor_noise_becomes_white_with_unit_variance(rate_hz: float, is_inertial: bool) -> None:
    declared = declared_truck(is_inertial=is_inertial)
    noise = case(rate_hz, round(6.0 * rate_hz) + 1, declared=declared)
    white = np.stack([white_noise_rows(noise, seed) for seed in range(8)])
    n = white.size
    # The mean square of n independent standard normals has the standard deviation sqrt(2/n).
    assert np.mean(white**2) == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 / n))
    for i in range(3):
        own = white[:, :, i]
        assert np.mean(own**2) == pytest.approx(1.0, abs=4.5 * np.sqrt(2.0 / own.size)), i
        for lag in (1, 2, 5):
            product = white[:, lag:, i] * white[:, :-lag, i]
            assert abs(product.mean()) < 4.5 / np.sqrt(product.size), (i, lag)
        for j in range(3):
            for lag in (0, 1, 2):
                if i == j:
                    continue
                product = white[:, lag:, i] * white[:, : white.shape[1] - lag, j]
                assert abs(product.mean()) < 4.5 / np.sqrt(product.size), (i, j, lag)


def test_both_ends_are_whitened_like_the_middle() -> None:
    noise = case(1000.0, 1441)
    white = np.stack([white_noise_rows(noise, seed) for seed in range(200)])
    square = np.mean(white**2, axis=(0, 2))
    assert np.abs(square - 1.0).max() < 5.0 * np.sqrt(2.0 / (200 * 3))


def test_twice_the_declared_density_gives_a_quarter() -> None:
    """Negative control: the check above can fail."""
    noise = case(1000.0, 6001, density_ug=2.0 * DENSITY_UG)
    white = np.stack([white_noise_rows(noise, seed) for seed in range(4)])
    assert np.mean(white**2) == pytest.approx(0.25, abs=4.0 * 0.25 * np.sqrt(2.0 / white.size))


def test_swapped_densities_are_noticed() -> None:
    """Negative control: with the densities of the axles on the wrong channels nothing is white."""
    noise = case(1000.0, 6001, density_ug=DENSITY_UG[[2, 3, 0, 1]])
    white = np.concatenate([white_noise_rows(noise, seed) for seed in range(4)])
    squares = np.mean(white**2, axis=0)
    assert np.abs(squares - 1.0).max() > 20.0 * np.sqrt(2.0 / white.shape[0])


def test_body_rows_left_uncoupled_are_too_loud() -> None:
    """Negative control: without what each body sensor adds to the other axle's equation."""
    m_11, m_22, m_12 = body_masses_kg(truck())
    assert abs(m_12) > 0.01 * m_11
    uncoupled = case(1000.0, 6001, declared=NoisePath(theta(), m_11, m_22, 0.0, True))
    white = np.concatenate([white_noise_rows(uncoupled, seed) for seed in range(8)])
    squares = np.mean(white[:, 1:] ** 2, axis=0)
    assert np.all(squares - 1.0 > 4.5 * np.sqrt(2.0 / white.shape[0])), squares


def of_each_sample(rate_hz: float, samples: int) -> tuple[FloatArray, float]:
    """What a one in every sample of a channel becomes: signals (samples, 6, n); the step."""
    out = []
    for begin in range(0, samples, 4):
        unit = np.zeros((4, samples))
        for k in range(begin, min(begin + 4, samples)):
            unit[k - begin, k] = 1.0
        model = channel_signals(unit, 1.0 / rate_hz, rate_hz)
        out.append(model.signals)
    return np.concatenate(out)[:samples], model.step_s


@pytest.mark.parametrize(("rate_hz", "seconds"), [(200.0, 1.25), (1000.0, 0.85)])
def test_covariance_against_the_sum_over_all_samples(rate_hz: float, seconds: float) -> None:
    """Every sample of every channel sent through by itself: covariance = G G' times its variance.

    Compared after whitening, where the covariance must be the identity. All rows see less
    than the time between the axles, so that no sample reaches a front row and a rear row.
    """
    samples = round(seconds * rate_hz) + 1
    noise = case(rate_hz, samples)
    units, step_s = of_each_sample(rate_hz, samples)
    covariance: FloatArray = np.zeros((noise.noise.reciprocal.size,) * 2)
    for channel in range(4):
        residuals = []
        for unit in units:
            signals = np.zeros((4, *unit.shape))
            signals[channel] = unit
            residuals.append(plain_residuals(signals, step_s))
        white = white_rows(noise.rows, noise.noise, np.stack(residuals))
        variance = 0.5 * rate_hz * (DENSITY_UG[channel] * MICRO_G_M_PER_S2) ** 2
        covariance = covariance + variance * white.T @ white
    assert covariance.shape[0] >= 30
    seen_s = step_s * ((covariance.shape[0] // 3 - 1) * noise.rows.every + noise.rows.taps.size)
    assert seen_s < BETWEEN_AXLES_S
    error = np.abs(covariance - np.eye(covariance.shape[0]))
    assert np.max(error) < 0.02, (np.max(error), np.unravel_index(np.argmax(error), error.shape))


def filtered(rows: RowFilter, x: FloatArray) -> FloatArray:
    """Rows of x (k, n), one after the other."""
    out = np.empty((x.shape[0], row_count(rows, x.shape[1])))
    for k in range(x.shape[0]):
        filter_rows(rows.taps, rows.every, np.ascontiguousarray(x[k]), out[k])
    return out


MODEL_RATES_HZ = (200.0, 1000.0 / 3.0)


@pytest.mark.parametrize("rate_hz", MODEL_RATES_HZ)
def test_taps_are_a_second_derivative_of_what_is_slow(rate_hz: float) -> None:
    rows = row_filter(1.0 / rate_hz)
    t = np.arange(rows.taps.size + 3 * rows.every) / rate_hz
    out = filtered(rows, np.stack([np.ones_like(t), t, t**2 / 2.0]))
    assert out.shape == (3, 4)
    np.testing.assert_allclose(out[:2], 0.0, atol=1e-8)
    np.testing.assert_allclose(out[2], 1.0, rtol=1e-9)


@pytest.mark.parametrize("rate_hz", MODEL_RATES_HZ)
def test_pass_and_stop_band(rate_hz: float) -> None:
    """Whole below an eighth of the rate but for the second difference, half at half the rows' rate.

    Above twice the distance nothing is left, so that what the rows fold onto what passes is gone.
    """
    rows = row_filter(1.0 / rate_hz)
    frequency = np.linspace(1.0, 0.5 * rate_hz, 1500)
    k = np.arange(rows.taps.size)
    response = np.abs(np.exp(-2j * np.pi * np.outer(frequency, k) / rate_hz) @ rows.taps)
    apart = rows.every / rate_hz
    second_difference = (2.0 * np.sin(np.pi * frequency * apart) / apart) ** 2
    passes = frequency <= PASS_BAND * rate_hz
    np.testing.assert_allclose(response[passes] / second_difference[passes], 1.0, atol=2e-3)
    half = np.argmin(np.abs(frequency - 0.5 / apart))
    assert response[half] / second_difference[half] == pytest.approx(0.5, abs=0.02)
    stops = frequency >= (1.0 / SAMPLES_PER_RESIDUAL - PASS_BAND) * rate_hz
    assert np.max(response[stops] * apart**2 / 4.0) < 10 ** (-65 / 20)
    # The power that the whitener integrates is that response, from noise of an acceleration.
    np.testing.assert_allclose(
        np.interp(2.0 * np.pi * frequency[passes], rows.omega, rows.power) * frequency[passes] ** 4,
        (response[passes] ** 2 / (2.0 * np.pi) ** 4) * (rows.omega[1] - rows.omega[0]) / 2 / np.pi,
        rtol=1e-2,
    )


def test_rows_are_at_their_stated_places() -> None:
    rows = row_filter(3e-3)
    x = np.random.default_rng(4).standard_normal((2, 700))
    out = filtered(rows, x)
    for k in (0, 3, out.shape[1] - 1):
        expected = np.sum(rows.taps * x[:, k * rows.every : k * rows.every + rows.taps.size], -1)
        np.testing.assert_allclose(out[:, k], expected, rtol=1e-9, atol=1e-9 * rows.taps.max())
    assert (out.shape[1] - 1) * rows.every + rows.taps.size <= 700
    assert out.shape[1] * rows.every + rows.taps.size > 700
    assert row_count(rows, rows.taps.size - 1) == 0


def test_factor_and_substitution_against_scipy() -> None:
    """The factor's own product gives back a banded matrix that scipy factors and solves alike."""
    here = case(1000.0, 1201)
    noise = here.noise
    n, width = noise.factor.shape
    lower = np.zeros((width, n))  # scipy's form: row d holds the d-th subdiagonal
    for d in range(width):
        lower[d, : n - d] = noise.factor[d:, width - 1 - d]
    dense = np.zeros((n, n))
    for d in range(width):
        dense += np.diag(lower[d, : n - d], -d)
    matrix = dense @ dense.T
    banded = np.zeros_like(lower)
    for d in range(width):
        banded[d, : n - d] = np.diag(matrix, -d)
    np.testing.assert_allclose(
        cholesky_banded(banded, lower=True), lower, rtol=1e-6, atol=1e-9 * lower[0].max()
    )
    residuals = np.random.default_rng(2).standard_normal((5, 3, 59 + 3 * (n // 3 - 1)))
    before = residuals.copy()
    white = white_rows(here.rows, noise, residuals)
    np.testing.assert_array_equal(residuals, before)  # the argument is left alone
    rows = np.stack([filtered(here.rows, one) for one in residuals])
    interleaved = np.moveaxis(rows, 1, 2).reshape(5, n)
    expected = solve_banded((width - 1, 0), lower, interleaved.T).T
    np.testing.assert_allclose(white, expected, rtol=1e-7, atol=1e-7 * np.abs(expected).max())
    np.testing.assert_array_equal(white_rows(here.rows, noise, residuals[2]), white[2])


def test_densities_of_zero_are_refused() -> None:
    with pytest.raises(ValueError, match="densities above zero"):
        whitener(row_filter(3e-3), 20, declared_truck(), np.zeros(4), no_suspension_noise())


def changed_trucks() -> list[NoisePath]:
    """The declared truck, and four whose dampers, springs and masses differ by 20 %."""
    trucks = [declared_truck(is_inertial=False)]
    for place in (C_S1, K_S1 + 1, M_U1, K_U1):
        other = theta()
        other[place] *= 1.2
        trucks.append(NoisePath(other, *body_masses_kg(truck()), False))
    return trucks


def test_power_of_the_noise_of_other_trucks() -> None:
    """tr(C_0^-1 C) per row against the covariances of finite records, from banded factors.

    The formula is that of an endless record: what 60 further rows add to the trace.
    """
    rows = row_filter(3e-3)
    trucks = changed_trucks()
    density = np.tile(DENSITY_UG * MICRO_G_M_PER_S2, (len(trucks) + 1, 1))
    density[-1, 2] *= 1.1  # and the declared truck with one sensor noisier
    trucks.append(trucks[0])
    which = list(range(len(trucks) - 1))
    ours = noise_power(rows, trucks, density, no_suspension_noise(), which)
    traces = []
    for count in (80, 140):
        dense = [
            dense_covariance(whitener(rows, count, one, d, no_suspension_noise()))
            for one, d in zip(trucks, density, strict=True)
        ]
        traces.append([np.trace(np.linalg.solve(dense[0], dense[1 + k])) for k in which])
    expected = np.diff(traces, axis=0)[0] / 60.0 - 3.0
    assert np.abs(expected).min() > 0.02
    # Its 48 frequencies are 1.2 Hz apart: half a per cent where the body resonates.
    np.testing.assert_allclose(ours, expected, rtol=1e-2)


def test_slope_of_the_noise_power_is_that_of_drawn_noise() -> None:
    """The mean square of rows of drawn noise of a truck, whitened for another: by Monte Carlo."""
    car = truck()
    softer = theta()
    softer[C_S1] *= 0.7
    declared = NoisePath(softer, *body_masses_kg(car), True)
    here = case(1000.0, 6001, declared=declared)
    drawn = np.mean([3.0 * np.mean(white_noise_rows(here, seed) ** 2) for seed in range(12)])
    density = np.tile(DENSITY_UG * MICRO_G_M_PER_S2, (2, 1))
    (expected,) = noise_power(
        here.rows, [declared, declared_truck()], density, no_suspension_noise(), [0]
    )
    n = 12 * here.noise.reciprocal.size
    assert abs(expected) > 0.05
    assert drawn - 3.0 == pytest.approx(expected, abs=4.0 * 3.0 * np.sqrt(2.0 * 1.3 / n))


def dense_covariance(noise: Whitener) -> FloatArray:
    n, width = noise.factor.shape
    dense = np.zeros((n, n))
    for d in range(width):
        dense += np.diag(noise.factor[d:, width - 1 - d], -d)
    return np.asarray(dense @ dense.T)
