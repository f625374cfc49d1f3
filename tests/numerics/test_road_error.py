"""The estimated road against that of the simulation, in units of its standard deviation."""

import numpy as np
import pytest

import driveby
from pre_core.constants import NORMAL_975
from pre_core.physics.road import Profile
from services.common.arrays import Floats
from services.identification.result_parts import detrended
from studies.validation.calibration import road_z


@pytest.mark.parametrize("seed", [7, 11, 12])
def test_road_error_without_bend_is_within_its_std(seed: int) -> None:
    simulation = driveby.simulate(scenario=6, noise=25.0, gps_noise=True, seed=seed)
    (solution,) = driveby.identify(simulation).solutions
    road = solution.crossing.road
    assert road is not None
    assert road.std_m is not None
    x_m, std_m = np.array(road.x_m), np.array(road.std_m)
    error_m = np.array(road.mean_m) - np.interp(x_m, *simulation.road_m)

    def z(degree: int) -> Floats:
        return np.asarray(detrended(x_m, error_m, degree) / std_m)

    assert np.mean(np.abs(z(2)) < NORMAL_975) > 0.85
    rms = road_z(solution.crossing, Profile(*simulation.road_m))
    assert rms == pytest.approx(np.sqrt(np.mean(z(2) ** 2)))
    assert rms is not None
    assert 0.5 < rms < 1.5
    # The bend is not in it: with only offset and tilt removed, most of the error is outside.
    assert np.mean(np.abs(z(1)) < NORMAL_975) < 0.5


@pytest.mark.parametrize("speed", [18.0, 25.0])
def test_road_waves_above_a_metre_err_within_std_at_speed(speed: float) -> None:
    """Shorter waves are interpolated between samples a decimetre apart, which `std_m` lacks."""
    simulation = driveby.simulate(scenario=6, noise=25.0, gps_noise=True, seed=7, speed=speed)
    (solution,) = driveby.identify(simulation).solutions
    road = solution.crossing.road
    assert road is not None
    assert road.std_m is not None
    x_m, std_m = np.array(road.x_m), np.array(road.std_m)
    error_m = detrended(x_m, np.array(road.mean_m) - np.interp(x_m, *simulation.road_m), 2)
    waves = np.fft.rfft(error_m)
    waves[np.fft.rfftfreq(x_m.size, x_m[1] - x_m[0]) > 1.0] = 0.0
    z = np.fft.irfft(waves, x_m.size) / std_m
    assert 0.2 < np.sqrt(np.mean(z**2)) < 1.0
