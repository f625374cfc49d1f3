"""The residual model at the truth of simulated crossings, and what each of its corrections undoes.

The truth has 70 elements, 40 modes and steps of 0.1 ms; what is left of the residual at the true
parameters is measured in units of the noise of 5 µg/√Hz, five times better than the sensors.
"""

from typing import TYPE_CHECKING

import numpy as np
import pytest

from pre_core.arrays import FloatArray
from pre_core.constants import STANDARD_GRAVITY_M_PER_S2
from pre_core.crossing.arguments import EvaluationPoints, GriddedCrossing, allocate_buffers
from pre_core.crossing.channels import A, V, Z
from pre_core.crossing.residuals import roads_and_deflections
from pre_core.crossing.rows import row_filter
from pre_core.paper import experiment
from pre_core.parameters import ALPHA, BETA, C_U1, EI_1, K_ROT, K_U1, KAPPA, RHO_A, F
from pre_core.physics.beam_basis import (
    LEAST_COMPLIANCE_M_PER_N,
    BeamBasis,
    beam_basis,
    change_basis,
)
from pre_core.physics.sensors import resample, white_noise
from services.simulation.drive import DrivenRoad, paper_site, simulate_drive, truck_of
from tests.numerics.crossings import (
    PARTS,
    Case,
    case,
    crossing,
    in_noise,
    little,
    part,
    point,
    residual,
    white,
)

if TYPE_CHECKING:
    from services.simulation.drive import SimulatedDrive

START, END = K_ROT, K_ROT + 1


@pytest.fixture(scope="module")
def truth(scenario_6: "SimulatedDrive") -> Case:
    return case(scenario_6, paper_site())


@pytest.fixture(scope="module")
def backward() -> Case:
    site = paper_site()
    drive = simulate_drive(site, experiment.scenario_ratios(6), DrivenRoad("A", 1), forward=False)
    return case(drive, site, forward=False)


@pytest.mark.parametrize("name", ["truth", "backward"])
def test_at_the_truth_little_of_the_noise_is_left(
    name: str, request: pytest.FixtureRequest
) -> None:
    """Measured: 0.001, 0.006, 0.026 of the noise power of 5 µg/√Hz, 0.9 µg/√Hz in all."""
    here: Case = request.getfixturevalue(name)
    left = in_noise(here, residual(here, point(here)))
    assert little(left), left


def test_modes_keep_their_signs_from_bridge_to_bridge(truth: Case) -> None:
    """The coordinate of a mode fixes how it swings: it must not turn round with the next bridge."""
    basis = crossing(truth).basis
    rng = np.random.default_rng(4)
    for _ in range(20):
        theta = truth.theta.copy()
        theta[EI_1:] *= np.exp(0.5 * rng.standard_normal(theta.size - EI_1))
        basis = change_basis(basis, theta)
        assert np.all(basis.cubics[0, 1] > 0.0)


def test_both_forms_of_the_road_row_say_the_same(truth: Case) -> None:
    """From masses or from springs: what is left of the noise is shared otherwise, no more."""
    left = []
    for is_inertial in (True, False):
        data = crossing(truth, is_inertial=is_inertial)
        rows = residual(truth, point(truth), data=data)
        left.append(in_noise(truth, rows, is_inertial=is_inertial))
    assert abs(left[0][0] - left[1][0]) > 0.02
    assert left[0].sum() == pytest.approx(left[1].sum(), rel=0.01)


@pytest.mark.parametrize("rate_hz", [100.0, 200.0, 250.0, 500.0])
def test_slower_sensors_leave_as_little(truth: Case, rate_hz: float) -> None:
    """Their rows end sooner, at 25 Hz for 100 Hz; what is below is seen as well as at 1 kHz."""
    read = np.stack([resample(row, truth.rate_hz, rate_hz, 0.0) for row in truth.acceleration])
    # Its own low-pass needs a fifth of a second of samples that are not invented, at both ends.
    cut = round(0.25 * rate_hz)
    here = part(truth._replace(acceleration=read, rate_hz=rate_hz), cut, read.shape[1] - cut)
    left = in_noise(here, residual(here, point(here)))
    # Where a wheel comes on or leaves, what it feels has a kink: sampled, its error is step^2.
    assert little(left, max(1.0, crossing(here).step_s / 3e-3) ** 2), left
    at = point(here)
    at.theta[0, EI_1 + 3] *= 1.05
    assert in_noise(here, residual(here, at)).sum() > 2.0


@pytest.mark.parametrize("name", ["truth", "backward"])
@pytest.mark.parametrize(
    ("place", "ratio"), [(EI_1 + 3, 1.05), (EI_1 + 1, 1.05), (KAPPA, 0.99), (K_U1 + 1, 1.02)]
)
def test_a_wrong_parameter_stands_out(
    name: str, place: int, ratio: float, request: pytest.FixtureRequest
) -> None:
    here: Case = request.getfixturevalue(name)
    at = point(here)
    at.theta[0, place] *= ratio
    assert in_noise(here, residual(here, at)).sum() > 2.0


def test_place_and_wheelbase_stand_out(truth: Case) -> None:
    at = point(truth)
    assert in_noise(truth, residual(truth, at._replace(position_m=at.position_m + 0.1))).sum() > 2.0
    longer = at._replace(wheelbase_m=at.wheelbase_m * 1.001)
    assert in_noise(truth, residual(truth, longer)).sum() > 2.0


def moved(
    case: Case, data: GriddedCrossing, at: EvaluationPoints, place_m: float, longer_m: float = 0.0
) -> FloatArray:
    """White rows with the bridge put elsewhere or with another wheelbase."""
    there = at._replace(position_m=at.position_m + place_m, wheelbase_m=at.wheelbase_m + longer_m)
    return white(case, residual(case, there, data=data))[0]


@pytest.fixture(scope="module")
def noisy(truth: Case) -> Case:
    rng = np.random.default_rng(6)
    noise = [white_noise(truth.acceleration.shape[1], 1e3, 2.5e-4, rng) for _ in range(4)]
    return truth._replace(acceleration=truth.acceleration + np.stack(noise))


def on_the_bearing(at: EvaluationPoints, axle: int, end_m: float, share: float) -> EvaluationPoints:
    """Moved so that the axle is on that bearing at a sample, or so much of a step beyond it."""
    wheel = at.position_m[0] - axle * at.wheelbase_m[0]
    step = wheel[1] - wheel[0]
    return at._replace(
        position_m=at.position_m + end_m - wheel[np.argmin(np.abs(wheel - end_m))] + share * step
    )


@pytest.mark.parametrize("direction", [(1.0, 0.0), (0.0, 1.0)], ids=["place", "wheelbase"])
def test_smooth_in_place_and_wheelbase(noisy: Case, direction: tuple[float, float]) -> None:
    """A difference of a micrometre agrees with one of a millimetre."""
    data = crossing(noisy)
    for share in (0.2, 0.5, 0.8):
        at = on_the_bearing(point(noisy), 0, 0.0, share)
        here = moved(noisy, data, at, 0.0)
        forward = (moved(noisy, data, at, *(1e-6 * d for d in direction)) - here) / 1e-6
        ahead = moved(noisy, data, at, *(1e-3 * d for d in direction))
        central = (ahead - moved(noisy, data, at, *(-1e-3 * d for d in direction))) / 2e-3
        assert np.linalg.norm(forward - central) < 1e-3 * np.linalg.norm(central), share


@pytest.mark.parametrize("axle", [0, 1])
@pytest.mark.parametrize("end_m", [0.0, 30.0])
def test_an_axle_on_the_bearing_at_a_sample(noisy: Case, axle: int, end_m: float) -> None:
    """On one side of it the axle is on the bridge a sample longer: nothing jumps.

    What it feels there has a kink, for a bridge that others already bend: the slope of that one
    sample differs.
    """
    data = crossing(noisy)
    at = on_the_bearing(point(noisy), axle, end_m, 0.0)
    before, here, after = (moved(noisy, data, at, d) for d in (-1e-6, 0.0, 1e-6))
    central = (moved(noisy, data, at, 1e-3) - moved(noisy, data, at, -1e-3)) / 2e-3
    for step in (here - before, after - here):
        assert np.linalg.norm(step / 1e-6 - central) < 0.2 * np.linalg.norm(central)


def test_common_gain_scales_all_but_the_weight(truth: Case) -> None:
    """Sensors that read 3 % too little: with their gain known the residuals are 3 % smaller, roads
    and deflections the same; with it unknown, the weight does not go with what they read."""
    gain = 1.03
    data = crossing(truth)
    low = data._replace(signals=data.signals / gain)
    at = point(truth)
    at.theta[0, EI_1 + 3] *= 1.1  # residuals that are not zero
    known = at._replace(common_gain=np.array([gain]))
    expected = residual(truth, at, data=data)
    scale = np.abs(expected).max()
    np.testing.assert_allclose(residual(truth, known, data=low), expected / gain, atol=1e-9 * scale)
    unknown = residual(truth, at, data=low) - expected / gain
    assert np.sum(white(truth, unknown) ** 2) > 10.0**2  # ten standard deviations
    work = allocate_buffers(data, at.theta.shape[1], row_filter(data.step_s))
    right = roads_and_deflections(data, work, at, 0)
    ours = roads_and_deflections(low, work, known, 0)
    for a, b in zip(ours, right, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-9 * np.abs(b).max())


def test_coordinates_of_another_bridge_leave_everything_alone(truth: Case) -> None:
    """Frequencies and residuals of any bridge, in coordinates in which one bridge is diagonal."""
    data = crossing(truth)
    weak = truth.theta.copy()
    weak[[EI_1 + 1, EI_1 + 5]] *= 0.5
    weak[[START, END]] = 5e8, 0.0
    weak[[F, F + 1]] = 3e-10, 1e-9
    other = change_basis(data.basis, weak)
    n = other.stiffness.shape[0] - 4

    def stiffness(basis: BeamBasis, theta: FloatArray) -> FloatArray:
        vertical = 1.0 / (theta[[F, F + 1]] + LEAST_COMPLIANCE_M_PER_N)
        factors = np.concatenate([theta[EI_1 : EI_1 + n], theta[[START, END]], vertical])
        return np.tensordot(factors, basis.stiffness, axes=1)

    own = stiffness(other, weak)
    np.testing.assert_allclose(own, np.diag(np.diag(own)), atol=1e-9 * own.max())
    for theta in (weak, truth.theta):
        np.testing.assert_allclose(
            np.linalg.eigvalsh(stiffness(other, theta)),
            np.linalg.eigvalsh(stiffness(data.basis, theta)),
            rtol=1e-9,
        )
    at = point(truth)
    expected = residual(truth, at, data=data)
    np.testing.assert_allclose(
        residual(truth, at, data=data._replace(basis=other)), expected, atol=1e-10
    )


def test_load_moves_between_the_axles_while_accelerating() -> None:
    """At 0.6 m/s² and with a centre of gravity at 1.2 m; left out, it stands out."""
    site = paper_site()
    high = site.vehicles[0].model_copy(update={"cg_height_m": 1.2})
    site = site.model_copy(update={"vehicles": (high,)})
    speeds = (9.0, 14.0)
    drive = simulate_drive(
        site, experiment.scenario_ratios(6), DrivenRoad("A", 3), speed_m_per_s=speeds
    )
    here = case(drive, site, speeds=speeds)
    assert point(here).acceleration_m_per_s2[0, 0] > 0.5
    left = in_noise(here, residual(here, point(here)))
    assert left.sum() < 0.3, left
    low = in_noise(here, residual(here, point(here), data=crossing(here, cg_height_m=0.0)))
    assert low.sum() > 2.0 * left.sum(), (left, low)
    wrong_sign = point(here)
    wrong_sign.acceleration_m_per_s2[:] *= -1.0
    assert in_noise(here, residual(here, wrong_sign)).sum() > 1.5 * low.sum()


def test_axles_coupled_by_the_pitch_inertia() -> None:
    """At 1, as in the paper, nothing couples them; at 0.8 each feels the other's acceleration."""
    site = paper_site()
    stubby = site.vehicles[0].model_copy(update={"pitch_inertia_ratio": 0.8})
    site = site.model_copy(update={"vehicles": (stubby,)})
    here = case(simulate_drive(site, experiment.scenario_ratios(6), DrivenRoad("A", 1)), site)
    left = in_noise(here, residual(here, point(here)))
    assert little(left), left
    uncoupled = point(here)
    uncoupled.theta[0, KAPPA] = 1.0
    assert in_noise(here, residual(here, uncoupled)).sum() > 100.0


def read_with(
    case: Case, gain: FloatArray, delay_s: FloatArray, bias: FloatArray
) -> tuple[Case, EvaluationPoints]:
    """The truth as imperfect channels read it, and the point that undoes their errors."""
    read = np.stack(
        [
            (1.0 + gain[c]) * resample(case.acceleration[c], case.rate_hz, case.rate_hz, delay_s[c])
            + bias[c]
            for c in range(4)
        ]
    )
    # Beyond its ends `resample` takes the signal for constant: those ends are left out.
    here = part(case._replace(acceleration=read), 100, read.shape[1] - 100)
    undo = 1.0 / (1.0 + gain) - 1.0
    corrected = point(here)._replace(gain=undo[None], delay_s=delay_s[None])
    corrected.initial[0, :, 2] = -bias / (1.0 + gain)
    return here, corrected


GAIN = np.array([0.02, -0.01, 0.015, -0.02])
DELAY_S = np.array([0.2e-3, -0.15e-3, 0.25e-3, -0.1e-3])
BIAS = np.array([0.05, -0.03, 0.02, 0.04])


def test_gains_delays_and_biases_are_undone(truth: Case) -> None:
    here, corrected = read_with(truth, GAIN, DELAY_S, BIAS)
    left = in_noise(here, residual(here, corrected))
    assert little(left), left
    # Each of them matters: leave out one kind in one channel and the residual stands out.
    for c in range(4):
        for wrong in (corrected.gain, corrected.delay_s):
            right = wrong[0, c]
            wrong[0, c] = 0.0
            assert in_noise(here, residual(here, corrected)).sum() > 1.0, c
            wrong[0, c] = right
    assert in_noise(here, residual(here, point(here))).sum() > 100.0


def test_delays_of_two_standard_deviations_are_undone(truth: Case) -> None:
    """1 ms is twice the default spread."""
    here, corrected = read_with(truth, 0.0 * GAIN, 4.0 * DELAY_S, 0.0 * BIAS)
    left = in_noise(here, residual(here, corrected))
    assert little(left), left


def test_initial_states_and_bias_are_undone_to_rounding(truth: Case) -> None:
    """What unknown initial values add to the signals is a parabola about the record's middle."""
    data = crossing(truth)
    expected = residual(truth, point(truth), data=data)
    z_0, v_0, b = np.random.default_rng(3).normal(0.0, 0.05, (3, 4, 1))
    n = data.signals.shape[2]
    t = data.step_s * (np.arange(n) - n // 2)
    signals = data.signals.copy()
    signals[:, Z] += z_0 + v_0 * t + 0.5 * b * t**2
    signals[:, V] += v_0 + b * t
    signals[:, A] += b
    at = point(truth)
    spoilt = residual(truth, at, data=data._replace(signals=signals))
    assert np.abs(spoilt - expected).max() > 1e-2
    at = at._replace(initial=-np.concatenate([z_0, v_0, b], axis=1)[None])
    undone = residual(truth, at, data=data._replace(signals=signals))
    np.testing.assert_allclose(undone, expected, atol=1e-11)


def test_mirrored_crossing_gives_the_same_residuals(truth: Case) -> None:
    """The same signals on the mirrored bridge in the other direction, elements of unlike length."""
    lengths = np.array([2.0, 5.0, 4.0, 6.0, 3.0, 7.0, 3.0])
    theta = truth.theta.copy()
    theta[EI_1 : EI_1 + 7] *= np.linspace(0.6, 1.3, 7)
    theta[START], theta[END] = 3e8, 9e8
    theta[F], theta[F + 1] = 4e-10, 2e-10

    def one(direction: int) -> FloatArray:
        order = slice(None, None, direction)
        basis = beam_basis(lengths[order], PARTS, has_compliant_bearings=True)
        at = point(truth)
        at.theta[0] = theta
        at.theta[0, EI_1 : EI_1 + 7] = theta[EI_1 : EI_1 + 7][order]
        if direction < 0:
            at.theta[0, [START, END]] = theta[[END, START]]
            at.theta[0, [F, F + 1]] = theta[[F + 1, F]]
            at = at._replace(position_m=30.0 - at.position_m)
        data = crossing(truth)._replace(
            direction=direction,
            basis=basis,
            edges_m=np.concatenate([[0.0], np.cumsum(basis.lengths_m)]),
        )
        return residual(truth, at, data=data)

    forth, back = one(1), one(-1)
    np.testing.assert_allclose(back, forth, atol=1e-9 * np.abs(forth).max())


def changes(case: Case, count: int) -> EvaluationPoints:
    """Points that differ in one or another group only, in random order, many of them twice."""
    rng = np.random.default_rng(11)
    at = point(case, count)
    places = [EI_1, EI_1 + 6, RHO_A, ALPHA, BETA, K_U1, KAPPA]
    for k in range(count):
        which = int(rng.integers(0, len(places) + 6))
        if which < len(places):
            at.theta[k, places[which]] *= rng.choice([0.9, 1.1])
        elif which == len(places):
            at.theta[k, [START, END]] = rng.choice([0.0, 1e9], 2)
        elif which == len(places) + 1:
            at.position_m[k] += rng.choice([-0.2, 0.2])
        elif which == len(places) + 2:
            at.theta[k, [F, F + 1]] = rng.choice([0.0, 1e-9], 2)
        elif which == len(places) + 3:
            at.theta[k, C_U1 + 1] = 1e3
        elif which == len(places) + 4:
            at.swing[k, 2] = 1e-3
    return at


def test_modes_are_never_those_of_another_bridge(truth: Case) -> None:
    data = crossing(truth)
    at = changes(truth, 60)
    together = residual(truth, at, data=data)
    assert np.isfinite(together).all()
    for k in range(60):
        alone = EvaluationPoints(*(part[k : k + 1] for part in at))
        np.testing.assert_array_equal(residual(truth, alone, data=data)[0], together[k])
    assert len({together[k].tobytes() for k in range(60)}) > 12


@pytest.mark.parametrize("threads", [2, 3, 7])
def test_threads_change_nothing(truth: Case, threads: int) -> None:
    at = changes(truth, 20)
    np.testing.assert_array_equal(
        residual(truth, at, threads=threads), residual(truth, at, threads=1)
    )


def test_impossible_points_are_not_numbers_and_spoil_no_other(truth: Case) -> None:
    at = point(truth, 6)
    at.theta[0, EI_1] = np.nan
    at.theta[1, 0] = 5.0  # centre of gravity behind the rear axle
    at.theta[2, EI_1 + 2] = np.inf
    at.position_m[3] = np.sin(np.linspace(0.0, 6.0, at.position_m.shape[1]))  # turns round
    out = residual(truth, at)
    assert np.isnan(out[:4]).all()
    expected = residual(truth, point(truth))[0]
    np.testing.assert_array_equal(out[4], expected)
    np.testing.assert_array_equal(out[5], expected)


def test_at_rest_the_bridge_bends_by_its_weight(truth: Case) -> None:
    """A truck that creeps over with silent sensors: the static deflection of a uniform beam.

    Under the load P at a: P a^2 b^2 / (3 EI L), and between two loads Maxwell's coefficients.
    """
    silent = truth._replace(acceleration=np.zeros_like(truth.acceleration))
    rigidity, span, wheelbase = 1.56e10, 30.0, 4.4
    data = crossing(silent)
    at = point(silent)
    at.theta[0, EI_1 : EI_1 + 7] = rigidity
    at.theta[0, ALPHA], at.theta[0, BETA] = 20.0, 0.02  # heavily damped
    # 0.2 of the speed would need a longer record: the mass is made small instead.
    at.theta[0, RHO_A] = 40.0
    work = allocate_buffers(data, at.theta.shape[1], row_filter(data.step_s))
    _, deflection = roads_and_deflections(data, work, at, 0)
    car = truck_of(silent.site.vehicles[0])
    d_1 = car.front_axle_to_cg_m
    g = STANDARD_GRAVITY_M_PER_S2
    loads = g * (
        car.body_mass_kg * np.array([wheelbase - d_1, d_1]) / wheelbase
        + np.array(car.unsprung_mass_kg)
    )

    def influence(x: float, a: float) -> float:
        low, high = min(x, a), max(x, a)
        b = span - high
        return b * low * (span**2 - b**2 - low**2) / (6.0 * rigidity * span)

    i = int(np.argmin(np.abs(at.position_m[0] - 17.0)))
    wheels = (at.position_m[0, i], at.position_m[0, i] - wheelbase)
    for w in range(2):
        static = -sum(p * influence(wheels[w], a) for p, a in zip(loads, wheels, strict=True))
        assert deflection[w, i] == pytest.approx(static, rel=0.02)
