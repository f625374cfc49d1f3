"""The truth of drawn crossings: distributed as the site file says, driven as the conditions say."""

import numpy as np
import pytest
from numpy.typing import NDArray

from pre_core import parameters
from services.simulation.drawn import CrossingTruth, draw_truth, drive, motion_of
from studies.simulation.truths import default_site, true_values

SEEDS = range(600)
SITE = default_site()


@pytest.fixture(scope="module")
def truths() -> list[CrossingTruth]:
    return [draw_truth(SITE, seed) for seed in SEEDS]


def test_the_same_seed_gives_the_same_truth_and_another_another() -> None:
    assert true_values(draw_truth(SITE, 3)) == true_values(draw_truth(SITE, 3))
    assert true_values(draw_truth(SITE, 3)) != true_values(draw_truth(SITE, 4))


def test_logarithms_have_the_spreads_of_the_site(truths: list[CrossingTruth]) -> None:
    values = [true_values(truth) for truth in truths]
    vehicle, bridge = SITE.vehicles[0], SITE.bridges[0]
    expected = {
        "d_1": (vehicle.front_axle_to_cg_m, 0.15),
        "k_s2": (vehicle.suspension_stiffness_n_per_m[1], 0.15),
        "kappa": (vehicle.pitch_inertia_ratio, 0.15),
        "EI_1": (1.56e10, 0.55),
        "EI_7": (1.56e10, 0.55),
        "rhoA": (bridge.mass_per_length_kg_per_m, 0.1),
        "alpha": (bridge.rayleigh_alpha_per_s, 0.5),
    }
    n = len(truths)
    for name, (nominal, spread) in expected.items():
        logs = np.log([value[name] / nominal for value in values])
        assert abs(logs.mean()) < 4.0 * spread / np.sqrt(n), name
        assert logs.std() == pytest.approx(spread, rel=4.0 / np.sqrt(2.0 * n)), name


def test_what_no_residual_shows_is_drawn_too(truths: list[CrossingTruth]) -> None:
    masses = [t.car.body_mass_kg + sum(t.car.unsprung_mass_kg) for t in truths]
    nominal = SITE.vehicles[0].total_mass_kg
    assert np.std(np.log(np.array(masses) / nominal)) == pytest.approx(0.01, rel=0.15)
    assert np.std([t.channels.common_gain for t in truths]) == pytest.approx(0.01, rel=0.15)
    gains = np.array([t.channels.gain for t in truths])
    assert gains.std() == pytest.approx(0.01, rel=0.1)
    assert abs(np.corrcoef(gains.T)[0, 1]) < 0.2


def half_normal_where_there(values: NDArray[np.float64], scale: float, absent: float) -> None:
    """Exactly nothing with that probability, else half-normal."""
    there = values[values > 0.0] / scale
    assert values.min() >= 0.0
    assert np.mean(values == 0.0) == pytest.approx(absent, abs=0.07)
    assert np.mean(there**2) == pytest.approx(1.0, rel=0.25)
    assert np.mean(there) == pytest.approx(np.sqrt(2.0 / np.pi), rel=0.12)


def test_support_springs_and_bearings_may_be_there(truths: list[CrossingTruth]) -> None:
    scale = SITE.bridges[0].support_rotational_stiffness_nm_per_rad_scale_at_zero
    springs = np.array([t.beam.support_rotational_stiffness_nm_per_rad for t in truths])
    compliance = np.array([t.beam.support_compliance_m_per_n for t in truths])
    for end in range(2):
        half_normal_where_there(springs[:, end], scale, 0.5)
        half_normal_where_there(compliance[:, end], 1e-9, 0.5)
    assert abs(np.mean((springs[:, 0] > 0.0) == (springs[:, 1] > 0.0)) - 0.5) < 0.1


def test_tyres_have_some_damping(truths: list[CrossingTruth]) -> None:
    for wheel in range(2):
        damping = np.array([t.car.tyre_damping_ns_per_m[wheel] for t in truths])
        half_normal_where_there(damping, 1000.0, 0.0)


def test_what_the_site_knows_of_bearings_and_tyres_is_drawn() -> None:
    bridge = SITE.bridges[0].model_copy(update={"bearings": ("free", "sprung")})
    vehicle = SITE.vehicles[0].model_copy(update={"tyre_damping_ns_per_m": (1500.0, 2000.0)})
    site = SITE.model_copy(update={"bridges": (bridge,), "vehicles": (vehicle,)})
    drawn = [draw_truth(site, seed) for seed in range(60)]
    springs = np.array([t.beam.support_rotational_stiffness_nm_per_rad for t in drawn])
    assert springs[:, 0].max() == 0.0
    assert springs[:, 1].min() > 0.0
    logs = np.log([t.car.tyre_damping_ns_per_m[1] / 2000.0 for t in drawn])
    assert logs.std() == pytest.approx(0.15, rel=0.3)
    assert abs(logs.mean()) < 0.08


def test_all_kinds_of_drives_come(truths: list[CrossingTruth]) -> None:
    how = [t.conditions for t in truths]
    assert {c.road_class for c in how} == {"A", "B"}
    assert {c.forward for c in how} == {True, False}
    assert {c.rate_hz for c in how} == {200.0, 500.0, 1000.0, 2000.0}
    speeds = np.array([c.speed_m_per_s for c in how])
    assert speeds.min() < 6.0
    assert speeds.max() > 24.0
    noise = np.array([c.noise_ug_per_rthz for c in how])
    assert noise.min() >= 25.0
    assert noise.max() <= 100.0
    largest = np.array([2.0 * np.pi * c.change_m_per_s / c.period_s for c in how])
    assert largest.max() <= 1.0
    assert 0.2 < np.mean(largest > 0.1) < 0.5


@pytest.mark.parametrize("forward", [True, False])
def test_motion_enters_the_bridge_at_its_moment_and_is_smooth(forward: bool) -> None:
    truth = draw_truth(SITE, 5)
    how = truth.conditions._replace(
        forward=forward, speed_m_per_s=12.0, change_m_per_s=2.0, period_s=8.0, phase=1.0
    )
    truth = truth._replace(conditions=how)
    bridge, step_s = SITE.bridges[0], 1e-3
    motion = motion_of(truth, bridge, step_s, 1)
    sign = 1.0 if forward else -1.0
    near = 0.0 if forward else bridge.span_m
    entry = np.argmin(np.abs(motion.position_m - near))
    assert abs(motion.position_m[entry] - near) < 1e-9
    assert motion.speed_m_per_s[entry] == pytest.approx(sign * 12.0)
    assert entry * step_s == pytest.approx(7.0)
    np.testing.assert_allclose(
        np.gradient(motion.position_m, step_s)[1:-1], motion.speed_m_per_s[1:-1], atol=1e-5
    )
    # Positive when the truck speeds up, whatever way it drives.
    np.testing.assert_allclose(
        sign * np.gradient(motion.speed_m_per_s, step_s)[1:-1],
        motion.acceleration_m_per_s2[1:-1],
        atol=1e-5,
    )
    rear_left = sign * (motion.position_m[-1] - near) - bridge.span_m - truth.car.wheelbase_m
    assert rear_left > 3.0 * np.abs(motion.speed_m_per_s).min()


def test_a_crossing_is_measured_with_the_errors_that_were_drawn() -> None:
    """Biases, gains and delays show between a clean and a measured recording of one drive."""
    truth = draw_truth(SITE, 17)
    how = truth.conditions._replace(noise_ug_per_rthz=0.0, rate_hz=1000.0)
    errors = truth.channels
    zero = np.zeros(4)
    plain = errors._replace(common_gain=0.0, gain=zero, delay_s=zero, bias_m_per_s2=zero)
    clean = drive(SITE, truth._replace(conditions=how, channels=plain), 17)
    erring = drive(SITE, truth._replace(conditions=how), 17)
    for c, name in enumerate(erring.run.channels):
        true, read = clean.run.channels[name], erring.run.channels[name]
        rate = np.gradient(true, 1e-3)
        # Taylor's series of a shifted signal.
        bend = np.gradient(rate, 1e-3)
        design = np.column_stack([true, -rate, np.ones_like(true), bend])[100:-100]
        factor, shifted, bias, _ = np.linalg.lstsq(design, read[100:-100], rcond=None)[0]
        expected = (1.0 + errors.common_gain) * (1.0 + errors.gain[c])
        assert factor == pytest.approx(expected, abs=2e-3)
        assert shifted / factor == pytest.approx(errors.delay_s[c], abs=5e-5)
        assert bias == pytest.approx(errors.bias_m_per_s2[c], abs=1e-3)
    assert erring.site.sensor.noise_density_ug_per_rthz == (0.0,) * 4
    names = parameters.names(7)
    assert set(names) < set(true_values(truth))
