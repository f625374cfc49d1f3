"""What white rows show after a fit: noise of another power, a misfit in one place, or nothing."""

from typing import Any

import numpy as np
import pytest
from scipy.fft import dct

from pre_core.diagnostics import quality
from schemas.reasons import Reason
from services.common.arrays import Floats
from services.finding.crossing_data import CrossingData
from services.identification.checks import (
    BODY_FRONT,
    ROAD,
    FitDiagnostics,
    reasons_after_fit,
    stiffer_elements,
)
from tests.verdicts.steady import steady_crossing

STEP_S = 0.005
ROWS = 1100


def crossing(**vehicle: Any) -> CrossingData:
    return steady_crossing(np.empty(0), **vehicle)


def fit(white: Floats, **changes: Any) -> FitDiagnostics:
    place = np.linspace(-15.0, 40.0, white.shape[0])
    chi2 = float(np.mean(white**2))
    return FitDiagnostics(
        white, STEP_S, place, chi2, {"c_s1": 0.3}, 0.1, np.full(7, 0.05), False, 50.0
    )._replace(**changes)


def normals(seed: int = 0) -> Floats:
    return np.random.default_rng(seed).standard_normal((ROWS, 3))


def on_bridge() -> Floats:
    place = np.linspace(-15.0, 40.0, ROWS)
    return ((place >= 0.0) & (place <= 30.0)).astype(np.float64)


def test_white_rows_raise_no_alarm() -> None:
    """400 crossings of pure noise; 36 cells each at z = 4.5 with slack."""
    alarms = [seed for seed in range(400) if reasons_after_fit(crossing(), fit(normals(seed)))]
    assert alarms == []


@pytest.mark.parametrize("power", [0.8, 1.0, 1.1])
def test_noise_nearly_as_declared_is_good(power: float) -> None:
    assert reasons_after_fit(crossing(), fit(np.sqrt(power) * normals())) == []


@pytest.mark.parametrize("factor", [1.5, 3.0, 10.0])
def test_noise_above_declared_is_distinguished_from_misfit(factor: float) -> None:
    assert reasons_after_fit(crossing(), fit(factor * normals())) == [Reason.NOISE_ABOVE_DECLARED]


def test_noise_of_one_sensor_above_the_declared() -> None:
    """The kinds of residual feel the sensors differently: each has its own power."""
    white = normals() * np.array([1.0, 2.5, 1.0])
    assert reasons_after_fit(crossing(), fit(white)) == [Reason.NOISE_ABOVE_DECLARED]


def test_noise_far_below_the_declared() -> None:
    assert reasons_after_fit(crossing(), fit(0.5 * normals())) == [Reason.NOISE_BELOW_DECLARED]


def test_a_small_misfit_on_the_bridge_is_seen_where_chi2_is_not() -> None:
    """A mode's free vibration, 1.5 standard deviations high: chi2 stays near 1.2."""
    white = normals()
    time_s = STEP_S * np.arange(ROWS)
    white[:, ROAD] += 1.5 * on_bridge() * np.sin(2.0 * np.pi * 3.3 * time_s)
    left_over = fit(white)
    assert left_over.chi2_per_dof < 1.25
    assert reasons_after_fit(crossing(), left_over) == [Reason.RESIDUALS_COLOURED]


def test_a_large_misfit_is_a_misfit() -> None:
    white = normals()
    white[:, ROAD] += 4.0 * on_bridge() * np.sin(2.0 * np.pi * 3.3 * STEP_S * np.arange(ROWS))
    assert reasons_after_fit(crossing(), fit(white)) == [Reason.MODEL_MISFIT]


def test_a_misfit_in_noise_that_is_too_large_is_a_misfit() -> None:
    """It is not noise what is larger in one place than elsewhere."""
    white = 3.0 * normals()
    white[:, BODY_FRONT] += 9.0 * on_bridge() * np.sin(2.0 * np.pi * 8.0 * STEP_S * np.arange(ROWS))
    assert Reason.MODEL_MISFIT in reasons_after_fit(crossing(), fit(white))


def test_rows_of_a_short_stretch_are_not_overrated() -> None:
    """Ten rows before the bridge: a cell of a few numbers needs much to stand out."""
    place = np.concatenate([np.linspace(-0.5, -0.01, 10), np.linspace(0.0, 30.0, ROWS - 10)])
    alarms = [
        s for s in range(200) if reasons_after_fit(crossing(), fit(normals(s), chainage_m=place))
    ]
    assert alarms == []


def test_a_truck_that_is_not_the_one_of_the_site_file() -> None:
    odd = fit(normals(), prior_z={"k_s1": 1.0, "wheelbase": -15.0})
    assert reasons_after_fit(crossing(), odd) == [Reason.IMPLAUSIBLE_VEHICLE]


@pytest.mark.parametrize("field", ["mismatch_excess", "mismatch_bias"])
def test_mismatch_that_no_declared_tyre_causes_is_named(field: str) -> None:
    assert reasons_after_fit(crossing(), fit(normals(), **{field: 20.0})) == []
    odd = fit(normals(), **{field: 60.0})
    assert reasons_after_fit(crossing(), odd) == [Reason.MISMATCH_IMPLAUSIBLE]


def test_deck_far_rougher_than_any_other_is_named() -> None:
    assert reasons_after_fit(crossing(), fit(normals(), pavement_ratio=3.8)) == []
    odd = fit(normals(), pavement_ratio=7.0)
    assert reasons_after_fit(crossing(), odd) == [Reason.MISMATCH_IMPLAUSIBLE]


def test_a_position_that_the_receiver_denies() -> None:
    assert reasons_after_fit(crossing(), fit(normals(), position_z=-5.0)) == [
        Reason.POSITION_INCONSISTENT
    ]


def test_axles_alike_say_nothing() -> None:
    """The reason needs both: loads that are alike, and rigidities that nothing was learnt of."""
    uninformed = fit(normals(), rigidity_spread=np.full(7, 0.95))
    alike = crossing(front_axle_to_cg_m=2.2, unsprung_mass_kg=(700.0, 700.0))
    assert reasons_after_fit(alike, uninformed) == [Reason.AXLES_ALIKE]
    assert reasons_after_fit(alike, fit(normals())) == []
    assert reasons_after_fit(crossing(), uninformed) == []


@pytest.mark.parametrize(
    ("unsprung_mass_kg", "alike"),
    [((1000.0, 1000.0), True), ((300.0, 2000.0), False), ((2000.0, 300.0), False)],
)
def test_an_axle_load_is_what_stands_on_it_and_the_axle_itself(
    unsprung_mass_kg: tuple[float, float], *, alike: bool
) -> None:
    """10 t in the middle: 6 t and 6 t, or 5.3 t and 7 t, where a tenth of the sum is the limit."""
    wheelbase_m = crossing().vehicle.wheelbase_m
    truck = crossing(
        sprung_mass_kg=10_000.0,
        front_axle_to_cg_m=wheelbase_m / 2.0,
        unsprung_mass_kg=unsprung_mass_kg,
    )
    uninformed = fit(normals(), rigidity_spread=np.full(7, 0.95))
    assert (Reason.AXLES_ALIKE in reasons_after_fit(truck, uninformed)) is alike


@pytest.mark.parametrize("count", [1, 2, 7, 500])
def test_the_cosine_transform_is_that_of_scipy(count: int) -> None:
    rows = np.random.default_rng(count).standard_normal((count, 3))
    theirs = dct(rows, type=2, axis=0, norm="ortho")
    np.testing.assert_allclose(quality.cosine_transform(rows), theirs, rtol=0.0, atol=1e-13)


def test_cells_hold_all_the_power() -> None:
    """The cosine transform is orthogonal: cells, weighted by their sizes, add up to the rows."""
    white = normals()
    stretches = np.repeat([0, 1, 2], [100, 700, 300])
    found = quality.residual_bins(white, stretches, STEP_S, np.array([0.0, 6.0, 30.0, np.inf]))
    for kind in range(3):
        whole = quality.merge_bins([cell for key, cell in found.items() if key[0] == kind])
        assert whole.size == ROWS
        assert whole.mean_square == pytest.approx(np.mean(white[:, kind] ** 2), rel=1e-12)


def test_a_tone_falls_into_its_own_cell() -> None:
    time_s = STEP_S * np.arange(ROWS)
    tone = np.zeros((ROWS, 3))
    tone[:, 1] = np.sin(2.0 * np.pi * 9.0 * time_s)
    found = quality.residual_bins(
        tone, np.zeros(ROWS, dtype=np.int64), STEP_S, np.array([0.0, 6.0, 12.0, np.inf])
    )
    power = {key: cell.mean_square * cell.size for key, cell in found.items()}
    assert power[1, 0, 1] > 0.95 * np.sum(tone**2)
    assert power[0, 0, 1] == 0.0


@pytest.mark.parametrize("size", [5, 50, 2000])
def test_excess_is_a_standard_normal(size: int) -> None:
    """Wilson and Hilferty's approximation, at its mean, its spread and in its tail."""
    rng = np.random.default_rng(size)
    squares = rng.chisquare(size, 40_000) / size
    z = np.array([quality.bin_excess(quality.ResidualBin(float(s), size)) for s in squares])
    assert abs(z.mean()) < 0.03
    assert z.std() == pytest.approx(1.0, abs=0.03)
    assert np.mean(z > 3.0) < 0.003


def test_a_short_approach_is_named_where_the_roads_seem_to_differ() -> None:
    data = crossing()
    white = np.random.default_rng(3).standard_normal((ROWS, 3))
    for changes, named in (
        ({"off_bridge_m": 11.0, "has_mismatch": True}, True),
        ({"off_bridge_m": 13.0, "has_mismatch": True}, False),
        ({"off_bridge_m": 11.0}, False),
        ({"off_bridge_m": 11.0, "chi2_per_dof": 1.5}, True),
    ):
        reasons = reasons_after_fit(data, fit(white, **changes))
        assert (Reason.APPROACH_TOO_SHORT in reasons) is named


def ratios(means: list[float], spread: float = 0.05) -> Floats:
    """Draws of EI over nominal, (2000, n)."""
    rng = np.random.default_rng(0)
    return np.array(means) * np.exp(spread * rng.standard_normal((2000, len(means))))


@pytest.mark.parametrize(
    ("means", "spread", "found"),
    [
        ([1.0, 0.4, 2.0, 1.0, 2.1, 1.0, 1.0], 0.05, [2, 4]),
        ([1.0, 1.0, 1.0, 2.0], 0.05, [3]),
        ([1.0, 2.0], 0.05, [1]),
        # Wide draws show nothing.
        ([1.0, 0.4, 2.0, 1.0, 2.1, 1.0, 1.0], 0.3, []),
        # However low the others are, and wherever: damage is no reason.
        ([0.1, 0.1, 1.0, 0.1, 0.1], 0.05, []),
        ([0.3, 1.0, 0.3, 1.0, 0.3], 0.05, []),
        # The whole bridge is stiffer than nominal.
        ([1.9, 2.0, 1.9, 2.0], 0.05, []),
        ([3.0], 0.05, []),
    ],
)
def test_stiffer_elements_are_those_that_damage_cannot_make(
    means: list[float], spread: float, found: list[int]
) -> None:
    assert stiffer_elements(ratios(means, spread)) == found
