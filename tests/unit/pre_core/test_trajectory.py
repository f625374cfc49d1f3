"""The curve through a receiver's fixes, against closed forms and an independent smoother."""

import numpy as np
import pytest

from pre_core.crossing.splines import Spline, value_at
from pre_core.crossing.trajectory import arrival_time_s, fit_trajectory, motion_at
from services.common.arrays import Floats

POSITION_NOISE_M = 0.4
SPEED_NOISE_M_PER_S = 0.07


def fitted(
    time_s: Floats, position_m: Floats, velocity: Floats, start_s: float = 0.0, stop_s: float = 8.0
) -> Spline:
    return fit_trajectory(
        time_s,
        position_m,
        velocity,
        position_noise_m=POSITION_NOISE_M,
        speed_noise_m_per_s=SPEED_NOISE_M_PER_S,
        start_s=start_s,
        stop_s=stop_s,
    )


@pytest.mark.parametrize("epoch_s", [0.0, 2.5e6])
@pytest.mark.parametrize("acceleration", [0.0, 0.7, -1.1])
@pytest.mark.parametrize("direction", [1, -1])
def test_constant_acceleration_is_recovered_exactly(
    direction: int, acceleration: float, epoch_s: float
) -> None:
    """Also between the fixes, before the first and after the last, and after a month of uptime."""
    fixes = np.arange(0.3, 7.75, 0.1)
    position = -30.0 + direction * (10.0 * fixes + 0.5 * acceleration * fixes**2)
    velocity = direction * (10.0 + acceleration * fixes)
    trajectory = fitted(epoch_s + fixes, position, velocity, epoch_s, epoch_s + 8.0)
    t = np.linspace(0.0, 8.0, 801)
    motion = motion_at(trajectory, epoch_s + t, direction)
    # A double holds a month to 5e-10 s.
    exact_m = -30.0 + direction * (10.0 * t + 0.5 * acceleration * t**2)
    np.testing.assert_allclose(motion.position_m, exact_m, rtol=0, atol=2e-8)
    np.testing.assert_allclose(
        motion.speed_m_per_s, direction * (10.0 + acceleration * t), rtol=0, atol=2e-7
    )
    np.testing.assert_allclose(motion.acceleration_m_per_s2, acceleration, rtol=0, atol=2e-6)


def smoother_weights(time_s: Floats, query_s: float) -> Floats:
    """Weights (2m,) of positions and speeds in the best estimate of x(query).

    An independent way to say the same: x is a parabola plus the triple integral of white noise of
    0.3 m/s³ per root second, drawn as one kick every 5 ms; ridge regression on all of them.
    """
    kicks = np.arange(0.0, 8.0, 0.005)

    def rows(t: Floats) -> Floats:
        since = np.maximum(t[:, None] - kicks, 0.0)
        scale = 0.3 * np.sqrt(0.005)
        place = np.hstack([t[:, None] ** np.arange(3), 0.5 * scale * since**2])
        zero = np.zeros_like(t)
        parabola = np.stack([zero, np.ones_like(t), 2.0 * t], axis=1)
        return np.stack([place, np.hstack([parabola, scale * since])])

    place, pace = rows(time_s)
    design = np.vstack([place / POSITION_NOISE_M, pace / SPEED_NOISE_M_PER_S])
    ridge = np.hstack([np.zeros((kicks.size, 3)), np.eye(kicks.size)])
    normal = design.T @ design + ridge.T @ ridge
    weights = np.linalg.solve(normal, design.T).T @ rows(np.array([query_s]))[0, 0]
    noise = np.repeat([POSITION_NOISE_M, SPEED_NOISE_M_PER_S], time_s.size)
    return np.asarray(weights / noise)


def test_the_error_under_noise_is_that_of_the_best_estimate() -> None:
    fixes = np.arange(0.0, 8.05, 0.1)
    queries = np.array([1.0, 4.0, 7.9])
    noise = np.repeat([POSITION_NOISE_M, SPEED_NOISE_M_PER_S], fixes.size)
    expected_m = np.array(
        [np.sqrt(np.sum((smoother_weights(fixes, query) * noise) ** 2)) for query in queries]
    )
    rng = np.random.default_rng(5)
    errors = np.empty((400, queries.size))
    for error in errors:
        drawn = noise * rng.standard_normal(noise.size)
        position = 12.0 * fixes + drawn[: fixes.size]
        trajectory = fitted(fixes, position, 12.0 + drawn[fixes.size :])
        error[:] = value_at(trajectory, queries) - 12.0 * queries
    # The standard error of a standard deviation of 400 draws is 3.5 %.
    np.testing.assert_allclose(errors.std(axis=0), expected_m, rtol=0.12)
    assert np.all(np.abs(errors.mean(axis=0)) < 4.0 * expected_m / np.sqrt(400))
    assert np.all(expected_m < 0.3 * POSITION_NOISE_M)


def test_two_fixes_are_enough_and_one_is_not() -> None:
    trajectory = fitted(np.array([1.0, 3.0]), np.array([10.0, 20.0]), np.array([5.0, 5.0]))
    assert float(value_at(trajectory, np.array([2.0]))[0]) == pytest.approx(15.0, abs=1e-6)
    with pytest.raises(ValueError, match="at least two fixes"):
        fitted(np.array([1.0]), np.array([10.0]), np.array([5.0]))


@pytest.mark.parametrize("direction", [1, -1])
def test_passing_times_of_an_accelerated_drive(direction: int) -> None:
    fixes = np.arange(0.0, 8.05, 0.1)
    travel = 4.0 * fixes + 0.25 * fixes**2
    trajectory = fitted(fixes, direction * travel, direction * (4.0 + 0.5 * fixes))
    for distance in (0.01, 3.0, 20.0, 47.0):
        exact = -8.0 + np.sqrt(64.0 + 4.0 * distance)
        found = arrival_time_s(trajectory, direction * distance, direction, 0.0, 8.0)
        assert found == pytest.approx(exact, abs=1e-8)


def test_a_place_that_is_not_passed_has_no_time() -> None:
    fixes = np.arange(0.0, 8.05, 0.1)
    trajectory = fitted(fixes, 5.0 * fixes, np.full(fixes.size, 5.0))
    assert np.isnan(arrival_time_s(trajectory, 41.0, 1, 0.0, 8.0))
    # Passed before the search begins: its first moment.
    assert arrival_time_s(trajectory, 4.0, 1, 2.0, 8.0) == 2.0


def test_the_first_of_several_passages_counts() -> None:
    """A truck that rolls back and comes again."""
    fixes = np.arange(0.0, 8.05, 0.1)
    position = 6.0 * np.sin(0.9 * fixes)
    trajectory = fitted(fixes, position, 5.4 * np.cos(0.9 * fixes))
    found = arrival_time_s(trajectory, 3.0, 1, 0.0, 8.0)
    assert found == pytest.approx(np.arcsin(0.5) / 0.9, abs=0.05)
