"""Sensors anywhere on a rigid truck become the readings in its middle."""

import numpy as np
import pytest

from pre_core.crossing.middle import (
    Reduction,
    SensorPlaces,
    centre_readings,
    centre_reduction,
)
from services.common.arrays import Floats

WHEELBASE_M = 5.0
TOLERANCE_M = 0.05


def reduced(rows: list[tuple[int, float, float, float]]) -> Reduction:
    axle, behind, lateral, density = np.array(rows).T
    places = SensorPlaces(axle.astype(np.int64), behind, lateral)
    return centre_reduction(places, density, WHEELBASE_M, TOLERANCE_M)


def readings(rows: list[tuple[int, float, float, float]], count: int = 50) -> tuple[Floats, Floats]:
    """Four middle accelerations with three rolls, and what rigid parts show at the sensors."""
    rng = np.random.default_rng(5)
    four = rng.standard_normal((4, count))
    roll = 3.0 * rng.standard_normal((3, count))
    shown = []
    for axle, behind, lateral, _ in rows:
        if axle == 0:
            share = behind / WHEELBASE_M
            shown.append((1.0 - share) * four[0] + share * four[1] + lateral * roll[0])
        else:
            shown.append(four[1 + axle] + lateral * roll[axle])
    return four, np.array(shown)


AXLES = [(1, 0.0, 0.9, 25.0), (1, 0.0, -0.9, 25.0), (2, 0.0, 0.8, 25.0), (2, 0.0, -0.5, 25.0)]
MIDDLE = [(0, 0.0, 0.0, 25.0), (0, 5.0, 0.0, 25.0)]


@pytest.mark.parametrize(
    "body",
    [
        MIDDLE,
        [(0, 0.4, 0.0, 25.0), (0, 4.2, 0.0, 10.0)],
        [(0, 0.0, 0.4, 25.0), (0, 0.0, -0.4, 25.0), (0, 5.0, 0.4, 25.0), (0, 5.0, -0.4, 25.0)],
        [(0, 0.2, 0.4, 25.0), (0, 4.9, 0.4, 25.0), (0, 5.1, -0.5, 50.0)],
        [(0, 0.0, 0.0, 25.0), (0, 5.0, 0.0, 25.0), (0, 2.0, 0.4, 25.0)],
    ],
)
def test_middle_of_a_rigid_truck_is_exact(body: list[tuple[int, float, float, float]]) -> None:
    rows = body + AXLES
    four, shown = readings(rows)
    np.testing.assert_allclose(centre_readings(reduced(rows), shown), four, atol=1e-12)


def test_average_of_two_sides_has_the_noise_of_both() -> None:
    rows = [
        *((0, 0.0, e, n) for e, n in ((0.4, 20.0), (-0.4, 48.0))),
        *((0, 5.0, e, n) for e, n in ((0.4, 30.0), (-0.4, 40.0))),
        *((1, 0.0, e, n) for e, n in ((0.9, 3.0), (-0.9, 4.0))),
        (2, 0.0, 0.0, 7.0),
    ]
    found = reduced(rows)
    np.testing.assert_allclose(found.density[2:], [2.5, 7.0])
    # With its fourth corner a body has one reading more than motions: less noise than an average.
    assert found.density[0] < 26.0
    assert found.density[1] < 25.0
    np.testing.assert_allclose(found.weights[2, 4:6], [0.5, 0.5], rtol=1e-14)


def test_noise_of_the_readings_is_the_density_that_is_stated() -> None:
    rows = [(0, 0.3, 0.4, 20.0), (0, 0.1, -0.4, 40.0), (0, 4.0, 0.1, 10.0), (0, 5.0, -0.3, 30.0)]
    rows += AXLES
    found = reduced(rows)
    noise = np.array([n for *_, n in rows])[:, None]
    shown = noise * np.random.default_rng(1).standard_normal((len(rows), 200_000))
    np.testing.assert_allclose(centre_readings(found, shown).std(axis=1), found.density, rtol=0.01)


def test_least_squares_is_the_quietest_of_all_unbiased_weights() -> None:
    rows = [(0, 0.0, 0.4, 10.0), (0, 0.0, -0.4, 40.0), (0, 5.0, 0.4, 20.0), (0, 5.0, -0.4, 20.0)]
    found = reduced(rows + AXLES)
    density = np.array([n for *_, n in rows + AXLES])
    (parity,) = found.parities
    for row in (0, 1):
        for step in (-1e-3, 1e-3):
            other = found.weights[row] + step * parity[0] / np.abs(parity[0]).max()
            assert np.sqrt(other**2 @ density**2) > found.density[row]


def test_sensors_without_noise_weigh_alike() -> None:
    rows = [(0, *row[1:3], 0.0) for row in readings_of_corners()] + [(1, 0, 0, 0.0), (2, 0, 0, 0.0)]
    found = reduced(rows)
    np.testing.assert_allclose(found.weights[0, :4], [0.5, 0.5, 0.0, 0.0], atol=1e-12)
    np.testing.assert_array_equal(found.density, 0.0)


def readings_of_corners() -> list[tuple[int, float, float, float]]:
    return [(0, o, e, 25.0) for o in (0.0, 5.0) for e in (0.4, -0.4)]


def test_four_sensors_in_the_middle_pass_bit_for_bit() -> None:
    rows = [(0, 0.0, 0.03, 25.0), (0, 5.0, 0.0, 10.0), (1, 0.0, 0.0, 3.0), (2, 0.0, -0.02, 0.0)]
    shown = np.random.default_rng(2).standard_normal((4, 1000)) * 1e-3
    shown[:, 7] = -0.0  # of which a sum of products would make 0.0
    found = reduced(rows)
    assert centre_readings(found, shown).tobytes() == shown.tobytes()
    np.testing.assert_array_equal(found.weights, np.eye(4))
    np.testing.assert_array_equal(found.density, [25.0, 10.0, 3.0, 0.0])
    assert found.parities == ()


@pytest.mark.parametrize(
    ("rows", "hidden"),
    [
        ([*MIDDLE, (1, 0.0, 0.9, 25.0), (2, 0.0, 0.0, 25.0)], [2]),
        ([*MIDDLE, (1, 0.0, 0.9, 25.0), (1, 0.0, 0.3, 25.0), (2, 0.0, 0.0, 25.0)], [2]),
        ([*MIDDLE, (1, 0.0, 0.0, 25.0)], [3]),
        ([(0, 0.0, 0.4, 25.0), (0, 5.0, -0.4, 25.0), *AXLES], [0, 1]),
        ([(0, 0.0, 0.4, 25.0), (0, 5.0, 0.4, 25.0), *AXLES], [0, 1]),
        ([(0, 0.0, 0.0, 25.0), *AXLES], [1]),
        ([(0, 0.0, 0.4, 25.0), (0, 0.0, -0.4, 25.0), *AXLES], [1]),
    ],
)
def test_reading_that_is_not_shown_is_nan(
    rows: list[tuple[int, float, float, float]], hidden: list[int]
) -> None:
    weights = reduced(rows).weights
    assert np.flatnonzero(np.isnan(weights).all(axis=1)).tolist() == hidden
    assert np.flatnonzero(np.isnan(weights).any(axis=1)).tolist() == hidden


def test_parities_see_no_motion_and_unit_noise() -> None:
    rows = readings_of_corners() + AXLES + [(1, 0.0, 0.1, 50.0)]
    found = reduced(rows)
    _, shown = readings(rows)
    assert [parity.shape[0] for parity in found.parities] == [1, 1]
    noise = np.array([n for *_, n in rows])
    for parity in found.parities:
        np.testing.assert_allclose(parity @ shown, 0.0, atol=1e-12)
        np.testing.assert_allclose((parity * noise) @ (parity * noise).T, 1.0)
