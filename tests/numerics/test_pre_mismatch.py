"""The roads' mismatch as noise: against drawn surfaces, drawn spectra and quadrature."""

from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import signal

from pre_core.arrays import FloatArray
from pre_core.crossing import mismatch as mm
from pre_core.crossing.channels import GainsAndDelays
from pre_core.crossing.compliances import CompliancePosterior, draws
from pre_core.crossing.errors_in_variables import ComparedStretch, mismatch_power
from pre_core.crossing.noise import (
    NoisePath,
    estimation_matrix,
    folded,
    mismatch_levels,
    no_suspension_noise,
    noise_path,
    noise_spectrum,
)
from pre_core.crossing.off_bridge import MIN_MISMATCH_STATISTIC
from pre_core.crossing.rows import RESIDUALS, filter_rows, row_count, row_filter
from pre_core.crossing.whitening import whitener
from pre_core.parameters import ALPHA, BETA, M_U1, TORSION
from pre_core.physics.models import from_models
from pre_core.physics.road import REFERENCE_CYCLES_PER_M
from pre_core.physics.surface import (
    TYPICAL_FOOTPRINTS,
    Footprint,
    axle_profile,
    random_surface,
    spectra,
    surface_density,
)
from pre_core.physics.torsion import NO_TORSION, torsion_basis
from services.simulation.drive import beam_of, paper_site
from services.simulation.drive import truck_of as car_of
from tests.numerics.bars import bar_receptance
from tests.numerics.whitened import white_rows

STEP_S = 3e-3
SPEED = 10.0
FRONT, REAR = TYPICAL_FOOTPRINTS
QUIET = np.full(4, 1e-6)


def truck(change: int | None = None, by: float = 0.0, flexibility_per_n: float = 0.0) -> NoisePath:
    site = paper_site()
    car = car_of(site.vehicles[0])
    theta = from_models(car, beam_of(site.bridges[0], np.ones(7)))
    theta[TORSION] = flexibility_per_n
    theta[BETA] = 1e-4
    if change is not None:
        theta[change] *= 1.0 + by
    return noise_path(theta, site.vehicles[0].total_mass_kg, car.wheelbase_m, False)


def of_level(level: float) -> mm.Mismatch:
    return mm.Mismatch(mm.mismatch_spectra(FRONT, REAR), np.array([level, 0.0]), SPEED)


def true_level(road_class: str) -> float:
    """What the spectrum of the difference is at 0.1 cycles/m, by the integral."""
    at = np.array([REFERENCE_CYCLES_PER_M])
    return surface_density(road_class) * float(spectra(FRONT, REAR, at)[3][0])


class Driven(NamedTuple):
    difference: FloatArray  # (n,) of both roads at a sample
    front: FloatArray


def driven(seed: int, samples: int = 2000) -> Driven:
    """Both axles' roads of class A at the samples of a steady drive."""
    spacing = STEP_S * SPEED
    surface = random_surface(0.0, spacing * (samples - 1), spacing, "A", seed)
    front, rear = axle_profile(surface, FRONT).height_m, axle_profile(surface, REAR).height_m
    return Driven((front - rear)[:samples], front[:samples])


def filtered(values: FloatArray) -> FloatArray:
    rows = row_filter(STEP_S)
    out = np.empty(row_count(rows, values.size))
    filter_rows(rows.taps, rows.every, np.ascontiguousarray(values), out)
    return out


def test_window_keeps_the_spectrum() -> None:
    shapes = mm.mismatch_spectra(FRONT, REAR)
    n = np.array([0.04, 0.1, 0.3, 1.0, 2.0])
    at = np.array([REFERENCE_CYCLES_PER_M])
    aside = Footprint(offset_m=0.005)
    for row, other, within in zip(shapes.density, (REAR, aside), (0.04, 0.35), strict=True):
        wanted = spectra(FRONT, other, n)[3] / spectra(FRONT, other, at)[3]
        found = np.interp(n, shapes.cycles_per_m, row)
        np.testing.assert_allclose(found, wanted, rtol=within)
    assert shapes.density.min() > -1e-9


def test_two_numbers_are_those_of_the_literature() -> None:
    # Twin tyres on class A: 2.7e-8 m³, n_0 1.43 by a fit over all waves.
    a, n_0 = mm.two_parameter_spectrum(of_level(true_level("A")))
    assert a == pytest.approx(2.74e-8, rel=0.03)
    assert n_0 == pytest.approx(1.43, rel=0.06)


def test_rows_of_drawn_surfaces_become_white() -> None:
    rows = row_filter(STEP_S)
    mean_square, slow = [], []
    noise = None
    for seed in range(12):
        difference = driven(seed).difference
        if noise is None:
            count = row_count(rows, difference.size)
            road = of_level(true_level("A"))
            noise = whitener(rows, count, truck(), QUIET, no_suspension_noise(), road)
        residuals = np.zeros((RESIDUALS, difference.size))
        residuals[0] = difference
        white = white_rows(rows, noise, residuals).reshape(-1, RESIDUALS)[:, 0]
        mean_square.append(np.mean(white**2))
        # Waves longer than 5 m are what a bridge is seen by: 2 Hz and less at this speed.
        power = np.abs(np.fft.rfft(white)) ** 2 / white.size
        frequency = np.fft.rfftfreq(white.size, rows.every * STEP_S)
        slow.append(power[(frequency > 0.2) & (frequency < 2.0)].mean())
    # Twelve drives of 660 rows: 1.6 % of the one, 12 % of the other.
    assert np.mean(mean_square) == pytest.approx(1.0, abs=0.06)
    assert np.mean(slow) == pytest.approx(1.0, abs=0.4)


def test_levels_of_drawn_surfaces() -> None:
    rows = row_filter(STEP_S)
    found = []
    for seed in range(100):
        drive = driven(seed, 900)  # 27 m
        level, gain, _ = mismatch_levels(
            rows, truck(), QUIET, of_level(0.0), [filtered(drive.difference)],
            [filtered(drive.front)],
        )  # fmt: skip
        assert gain > 10.0 * MIN_MISMATCH_STATISTIC
        found.append(level[0] / true_level("A"))
    # A level from 27 m scatters by 11 %. The window's fill of high waves would take 4 % of it.
    assert np.mean(found) == pytest.approx(1.0, abs=0.025)
    assert np.std(found) < 0.15


ROLL_HZ, ROLL_DAMPING, OFFSET_M, TRACK_M = 14.0, 0.05, 0.005, 1.83
TWIN = Footprint(track_m=TRACK_M, twin_distance_m=0.33)


def rolling(seed: int, samples: int = 1200) -> Driven:
    """Return what an axle reads of a twin's road whose sensor is beside the middle that rolls."""
    spacing = STEP_S * SPEED
    surface = random_surface(0.0, spacing * (samples + 400), spacing, "A", seed)
    left, right = (
        axle_profile(surface, Footprint(track_m=0.0, twin_distance_m=0.33, offset_m=side)).height_m
        for side in (0.5 * TRACK_M, -0.5 * TRACK_M)
    )
    omega = 2.0 * np.pi * ROLL_HZ
    roll = signal.TransferFunction([omega**2], [1.0, 2.0 * ROLL_DAMPING * omega, omega**2])
    slope = (left - right) / TRACK_M
    _, angle, _ = signal.lsim(roll, slope - slope[0], STEP_S * np.arange(slope.size))
    front = axle_profile(surface, TWIN).height_m
    aside = axle_profile(surface, TWIN._replace(offset_m=OFFSET_M)).height_m
    settled = slice(400, 400 + samples)
    return Driven((front - aside + OFFSET_M * angle)[settled], front[settled])


def test_roll_of_the_axles_is_no_larger_offset() -> None:
    rows = row_filter(STEP_S)
    known = mm.mismatch_spectra(TWIN, TWIN)
    # The axle on its tyres would hop at 10 Hz.
    with_bands = mm.with_axle_roll(known, 10.0, SPEED)
    at = np.array([REFERENCE_CYCLES_PER_M])
    aside = TWIN._replace(offset_m=OFFSET_M)
    true = surface_density("A") * float(spectra(TWIN, aside, at)[3][0])
    found = []
    for seed in range(30):
        drive = rolling(seed)
        of = [filtered(drive.difference)], [filtered(drive.front)]
        found.append(
            [
                mismatch_levels(
                    rows,
                    truck(),
                    QUIET,
                    mm.Mismatch(shapes, np.zeros(shapes.density.shape[0]), SPEED),
                    *of,
                    has_only_offset=True,
                )[0][1]
                / true
                for shapes in (known, with_bands)
            ]
        )
    without, with_roll = np.mean(found, axis=0)
    # A level scatters by 12 %: 2 % in the mean of 30.
    assert without > 1.2
    assert with_roll == pytest.approx(1.0, abs=0.08)


def test_bands_of_the_roll_add_up_to_the_spectrum_of_an_offset() -> None:
    known = mm.mismatch_spectra(TWIN, TWIN)
    shapes = mm.with_axle_roll(known, 10.0, SPEED)
    n = np.linspace(1.0, 2.1, 40)  # 1.0 to 2.1 times 10 Hz at 10 m/s
    for whole, parts in zip(known[2:4], shapes[2:4], strict=True):
        of_offset = np.interp(n, known.cycles_per_m, whole[1])
        summed = np.interp(n, shapes.cycles_per_m, parts[mm.TRACK_SHAPES :].sum(axis=0))
        np.testing.assert_allclose(summed, of_offset, rtol=0.02)
    assert not shapes.expected_m[mm.TRACK_SHAPES :].any()


def test_cross_spectra_up_to_the_zero_of_the_contact_length() -> None:
    road = of_level(true_level("A"))
    n = np.array([0.06, 0.3, 1.0, 3.0, 4.0, 4.6])
    of_front, of_rear, common, _ = (surface_density("A") * one for one in spectra(FRONT, REAR, n))
    found = np.array(mm.cross_spectra(road, 2.0 * np.pi * SPEED * n)) * SPEED
    np.testing.assert_allclose(found, [of_front - common, common - of_rear], rtol=0.02)


def test_sensors_noise_is_no_mismatch() -> None:
    rows, one = row_filter(STEP_S), truck()
    density = np.full(4, 25.0 * 9.80665e-6)
    noise = whitener(rows, 200, one, density, no_suspension_noise())
    rng = np.random.default_rng(5)
    gains = []
    for _ in range(40):
        white = rng.standard_normal(RESIDUALS * 200)
        values = np.zeros(white.size)
        band = noise.factor.shape[1] - 1
        for i in range(white.size):
            low = max(0, i - band)
            values[i] = noise.factor[i, low - i + band :] @ white[low : i + 1]
        road = filtered(driven(1, 900).front)
        stretch = values[::RESIDUALS]
        gains.append(mismatch_levels(rows, one, density, of_level(0.0), [stretch], [road])[1])
    assert max(gains) < MIN_MISMATCH_STATISTIC


WAVE_M_PER_S = 400.0
DECK = torsion_basis(np.full(7, 30.0 / 7.0), (), WAVE_M_PER_S)


def on_deck(one: NoisePath, omega: FloatArray) -> NDArray[np.complex128]:
    """Equations (f, 4, 4) of a truck on a deck whose twist each axle's own force causes."""
    theta = one.theta
    equations = np.moveaxis(estimation_matrix(one, omega), 2, 0)
    if not theta[TORSION]:
        return equations
    mass = np.array([[one.m_11, one.m_12], [one.m_12, one.m_22]])
    axles = np.diag([theta[M_U1], theta[M_U1 + 1]])
    damping = float(theta[ALPHA]), float(theta[BETA])
    receptance = theta[TORSION] * bar_receptance(np.array([30.0]), WAVE_M_PER_S, damping, omega)
    equations[:, :2] -= (omega**2 * receptance)[:, None, None] * np.hstack([mass, axles])
    return equations


@pytest.mark.parametrize("unknown", [3, 5, 7, TORSION])
def test_pull_of_the_mismatch_against_drawn_spectra(unknown: int) -> None:
    """Rows made of drawn road spectra, with the truck's equations right and 1 % wrong.

    The last case is a deck that twists, and whose flexibility is wrong.
    """
    rows, level = row_filter(STEP_S), true_level("A")
    road = of_level(level)
    deck, flexibility = (DECK, 3e-9) if unknown == TORSION else (NO_TORSION, 0.0)
    right, wrong = truck(None, 0.0, flexibility), truck(unknown, 0.01, flexibility)
    wheelbase = paper_site().vehicles[0].wheelbase_m
    expected_power = mismatch_power(
        rows,
        [right, wrong],
        GainsAndDelays(np.zeros((2, 4)), np.zeros((2, 4))),
        QUIET,
        no_suspension_noise(),
        ComparedStretch(road, wheelbase, deck),
    )[0]
    omega = folded(rows, 4000).below
    n = omega / (2.0 * np.pi * SPEED)
    at = surface_density("A")
    s_11, s_22, s_12, _ = (at * s for s in spectra(FRONT, REAR, np.maximum(n, 1e-3)))
    rng = np.random.default_rng(unknown)
    waves = rng.standard_normal((2, 2, 400, omega.size))
    z_1, z_2 = (waves[0] + 1j * waves[1]) / np.sqrt(2.0)
    front = np.sqrt(s_11) * z_1
    rest = np.sqrt(np.maximum(s_22 - s_12**2 / s_11, 0.0))
    rear = s_12 / np.sqrt(s_11) * z_1 + rest * z_2
    later = np.exp(-1j * omega * wheelbase / SPEED)
    zero = np.zeros_like(front)
    felt = np.stack([front, later * rear, zero, zero])

    def residuals(made: NDArray[np.complex128]) -> NDArray[np.complex128]:
        return np.stack([later * made[0] - made[1], later * made[2], made[3]])

    # What the other truck's equations make of the accelerations that this road gives the first.
    mixing = on_deck(wrong, omega) @ np.linalg.inv(on_deck(right, omega))
    seen = residuals(felt)
    change = residuals(np.einsum("fij,jsf->isf", mixing, felt)) - seen
    spectrum = noise_spectrum(right, QUIET, no_suspension_noise(), road, omega) / omega**4
    weight = np.linalg.inv(np.moveaxis(spectrum, 2, 0))
    drawn = np.einsum("isf,fij,jsf->sf", seen.conj(), weight, change).real / SPEED
    mean, error = drawn.mean(), drawn.mean(axis=1).std() / np.sqrt(drawn.shape[0])
    assert abs(expected_power) > 5e-5
    assert mean == pytest.approx(expected_power, abs=4.0 * error + 0.1 * abs(expected_power))


def test_draws_of_compliances_against_quadrature() -> None:
    """A poorly observed element, and a bearing that may give or not."""
    precision = np.array([[6.0, 2.0], [2.0, 3.0]])
    linear = np.array([8.0, 3.5])
    sigma, odds = 0.55, -0.3
    of = CompliancePosterior(
        elements=np.array([0]), sigma=np.array([sigma]), sampled=np.array([0, 1]),
        others=np.array([2]), centre=np.array([1.0]), inflation=1.0, precision=precision,
        linear=linear, log_odds=np.array([-np.inf, odds]), others_root=np.array([[0.5]]),
        others_linear=np.array([1.0]), others_sampled=np.array([[0.5, -0.4]]),
        bias_direction=np.zeros(3),
    )  # fmt: skip
    drawn = np.concatenate([draws(of, 1500, 3, stream) for stream in range(4)])
    y = np.linspace(-6.0, 6.0, 2401)
    f = np.linspace(0.0, 6.0, 1201)
    c = np.exp(-sigma * y)

    def log_density(c: FloatArray, f: FloatArray) -> FloatArray:
        x = np.stack(np.broadcast_arrays(c, f))
        square = np.einsum("i...,ij,j...->...", x, precision, x)
        return np.asarray(np.einsum("i...,i->...", x, linear) - 0.5 * square)

    prior = np.exp(-0.5 * y**2)
    slab = np.exp(log_density(c[:, None], f[None, :])) * prior[:, None] * (f[1] - f[0])
    spike = np.exp(log_density(c, np.zeros_like(c)) + odds) * prior
    slab[:, 0] *= 0.5
    total = slab.sum() + spike.sum()
    of_y = (slab.sum(axis=1) + spike) / total
    mean_y = of_y @ y
    assert np.mean(drawn[:, 1] == 0.0) == pytest.approx(spike.sum() / total, abs=0.03)
    assert drawn[:, 0].mean() == pytest.approx(mean_y, abs=0.05)
    assert drawn[:, 0].std() == pytest.approx(np.sqrt(of_y @ (y - mean_y) ** 2), rel=0.05)
    x = np.stack([np.exp(-sigma * drawn[:, 0]), drawn[:, 1]])
    rest = drawn[:, 2] - (1.0 - of.others_sampled[0] @ x) / 4.0
    assert rest.mean() == pytest.approx(0.0, abs=0.03)
    assert rest.std() == pytest.approx(0.5, rel=0.05)
