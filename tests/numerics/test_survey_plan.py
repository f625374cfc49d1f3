"""Survey plans: what is averaged out and what is not, and whether the tests alarm as they say."""

from functools import cache

import numpy as np
import pytest

from pre_core.crossing.mismatch import expected_levels
from pre_core.physics.road import REFERENCE_CYCLES_PER_M
from pre_core.physics.surface import TYPICAL_FOOTPRINTS, spectra, surface_density
from pre_core.survey import detection, plan
from pre_core.survey.plan import (
    BridgePrior,
    PlannedPathGroup,
    non_increasing,
    survey_information,
    survey_spreads,
)
from services.planning.alternatives import with_tyres
from services.planning.crossings import CrossingSimulator, PlannedCrossing, PlannedRoad, mismatch_of
from services.simulation.drive import paper_site
from services.simulation.usual_trucks import usual_tandem
from studies.validation.bound import bound_of

SITE = paper_site()
SENSOR = SITE.sensor.model_copy(update={"noise_density_ug_per_rthz": (25.0,) * 4})
CROSSING = PlannedCrossing(SITE.model_copy(update={"sensor": SENSOR}), 10.0)
LENGTHS_M = np.array(SITE.bridges[0].lengths_m)


@cache
def simulated(wander_m: float = 0.12, *, is_surface: bool = True) -> CrossingSimulator:
    return CrossingSimulator(PlannedRoad("A", wander_m, is_surface))


@cache
def information(
    wander_m: float = 0.12, *, is_surface: bool = True
) -> tuple[PlannedPathGroup, BridgePrior]:
    one = simulated(wander_m, is_surface=is_surface)
    return one.track((CROSSING,)), one.known(CROSSING)


def precision(crossings: float, wander_m: float = 0.12, *, is_surface: bool = True) -> np.ndarray:
    track, known = information(wander_m, is_surface=is_surface)
    return survey_information([track], crossings, known.log_odds.size)


def of_elements(matrix: np.ndarray) -> np.ndarray:
    """Return the information on each element where all others are known."""
    return np.diag(matrix)[-7:]


def test_levels_of_a_road_are_those_of_its_spectrum() -> None:
    front, rear = TYPICAL_FOOTPRINTS
    at = np.array([REFERENCE_CYCLES_PER_M])
    level = expected_levels(front, rear._replace(offset_m=0.005), "A")
    assert level[0] == pytest.approx(surface_density("A") * spectra(front, rear, at)[3][0])
    assert expected_levels(front, front, "A").tolist() == [0.0, 0.0]
    assert expected_levels(front, rear, "C")[0] == pytest.approx(
        16.0 * expected_levels(front, rear, "A")[0]
    )
    # An offset twice as large has four times the power.
    aside = [expected_levels(front, front._replace(offset_m=m), "A")[1] for m in (0.002, 0.004)]
    assert aside[1] / aside[0] == pytest.approx(4.0, rel=1e-3)


@pytest.mark.parametrize("tyres", ["single", "twin"])
def test_survey_information_is_the_same_for_a_split_mismatch(tyres: str) -> None:
    """At knots along the road or in the noise: the same process, the same information."""
    crossing = CROSSING._replace(site=with_tyres(CROSSING.site, tyres))
    found = []
    for wander_m in (0.02, 0.12, 1.0):  # almost all is shared, some, hardly anything
        one = simulated(wander_m)
        size = one.known(crossing).log_odds.size
        found.append(of_elements(survey_information([one.track((crossing,))], 1.0, size)))
    np.testing.assert_allclose(found[0], found[2], rtol=0.01)
    np.testing.assert_allclose(found[1], found[2], rtol=0.01)


def test_what_tracks_share_is_not_averaged_out() -> None:
    few, many = (of_elements(precision(n)) for n in (1, 100))
    assert np.all(many > few)
    assert np.all(many < 10.0 * few)
    # On one groove nothing is shared: a hundred crossings have a hundred times the information.
    groove = [of_elements(precision(n, is_surface=False)) for n in (1, 100)]
    np.testing.assert_allclose(groove[1] / groove[0], 100.0, rtol=1e-9)
    # In the other lane the mismatch is another one.
    track, known = information()
    apart = survey_information([track, track], 200.0, known.log_odds.size)
    np.testing.assert_allclose(of_elements(apart) / many, 2.0, rtol=1e-6)


def test_one_crossing_on_one_groove_reaches_its_bound() -> None:
    _, known = information(is_surface=False)
    problem, y = simulated(is_surface=False).truth(CROSSING)
    mismatch = mismatch_of(SITE.vehicles[0], PlannedRoad("A", 0.12, is_surface=False), problem)
    assert not mismatch.level_m3.any()
    bound = bound_of(problem, y, 0.0).std
    # The bound knows that springs are not negative, but not that they may be absent.
    present = known._replace(log_odds=np.full(known.log_odds.size, -np.inf))
    found = survey_spreads(present, precision(1.0, is_surface=False), LENGTHS_M).elements
    expected = np.array([bound[f"EI_{e + 1}"] for e in range(7)])
    np.testing.assert_allclose(found, expected, rtol=0.16)
    assert np.median(found / expected) == pytest.approx(1.0, abs=0.08)


def test_draws_agree_with_the_normal_where_all_is_known() -> None:
    known = BridgePrior(
        np.full(2, 0.55), np.array([], dtype=np.int64), np.full(2, -np.inf), np.ones(0)
    )
    matrix = np.array([[2500.0, 900.0], [900.0, 1600.0]])
    expected = np.sqrt(np.diag(np.linalg.inv(matrix + np.eye(2) / 0.55**2)))
    found = survey_spreads(known, matrix, np.array([10.0, 20.0]))
    np.testing.assert_allclose(found.elements, expected, rtol=0.08)
    # Of two that are known alike and apart the mean by length.
    apart = survey_spreads(known, 2500.0 * np.eye(2), np.array([10.0, 20.0]))
    assert apart.level == pytest.approx(0.02 * np.sqrt(5.0) / 3.0, rel=0.08)


def test_draws_give_a_deviation_to_two_per_cent(monkeypatch: pytest.MonkeyPatch) -> None:
    """As the forecast states; 16 seeds give the scatter itself to a fifth."""
    _, known = information()
    found = []
    for seed in range(16):
        monkeypatch.setattr(plan, "_SEED", seed)
        wide = survey_spreads(known, precision(12), LENGTHS_M)
        found.append([*wide.elements, wide.level])
    scatter = np.std(found, axis=0) / np.mean(found, axis=0)
    assert 0.01 < np.sqrt(np.mean(scatter**2)) < 0.025


def test_more_crossings_never_widen_a_spread() -> None:
    """Two draws' errors that rise are averaged, a column for itself; what falls stays."""
    spreads = np.array([[0.5, 0.30], [0.4, 0.28], [0.44, 0.20], [0.1, 0.1]])
    expected = np.array([[0.5, 0.30], [0.42, 0.28], [0.42, 0.20], [0.1, 0.1]])
    np.testing.assert_allclose(non_increasing(spreads), expected, rtol=1e-12)


def test_alarms_are_as_often_as_they_say() -> None:
    """On drawn data: normal in c about the truth, the other elements drawn from their priors."""
    rng = np.random.default_rng(5)
    root = np.tril(rng.standard_normal((4, 4))) + 3.0 * np.eye(4)
    matrix = root @ root.T
    known = BridgePrior(
        np.full(4, 0.55), np.array([], dtype=np.int64), np.full(4, -np.inf), np.ones(0)
    )
    errors = detection.detection_errors(known, matrix, 0.0)
    prior = np.diag(np.r_[0.0, np.full(3, 1.0 / 0.55**2)])
    draws = 60_000
    for loss, expected in (
        (0.0, 0.01),
        (0.5, detection.detection_probability(0.5, errors.of_nominal)[0]),
    ):
        truth = 1.0 + np.c_[np.zeros(draws), 0.55 * rng.standard_normal((draws, 3))]
        truth[:, 0] = 1.0 / (1.0 - loss)
        information_c = truth + rng.standard_normal((draws, 4)) @ np.linalg.inv(root)
        best = np.linalg.solve(matrix + prior, (information_c @ matrix + prior @ np.ones(4)).T)
        alarm = best[0] - 1.0 > 2.3263 * errors.of_nominal[0]
        assert alarm.mean() == pytest.approx(expected, abs=4.0 * np.sqrt(expected / draws) + 1e-3)


def test_losses_probabilities_and_the_scale() -> None:
    std = np.array([0.01, 0.1, 0.5])
    assert detection.detection_probability(0.0, std).tolist() == pytest.approx([0.01] * 3)
    smallest = detection.minimum_detectable_loss(std)
    for k in range(3):
        assert detection.detection_probability(smallest[k], std)[k] == pytest.approx(0.95)
    matrix = 1e6 * np.eye(3)
    known = BridgePrior(
        np.full(3, 0.55), np.array([], dtype=np.int64), np.full(3, -np.inf), np.ones(0)
    )
    with_scale = detection.detection_errors(known, matrix, 0.02)
    np.testing.assert_allclose(with_scale.of_nominal, 0.02, rtol=2e-3)
    # Against the others a scale that all have does not matter: an element and the mean of two.
    np.testing.assert_allclose(with_scale.of_others, 1e-3 * np.sqrt(1.5), rtol=1e-3)


def information_of_tandem(damping_ns_per_m: float) -> np.ndarray:
    vehicle = usual_tandem(25.0)
    lead, *behind = vehicle.axles
    damped = (a.model_copy(update={"tyre_damping_ns_per_m": damping_ns_per_m}) for a in behind)
    truck = vehicle.model_copy(update={"axles": (lead, *damped)})
    site = SITE.model_copy(update={"vehicles": (truck,)})
    simulated_now = CrossingSimulator(PlannedRoad("A", 0.12))
    crossing = PlannedCrossing(site, 10.0)
    track, known = simulated_now.track((crossing,)), simulated_now.known(crossing)
    return of_elements(survey_information([track], 1.0, known.log_odds.size))


def test_a_planned_tandem_without_tyre_damping_has_the_median_of_its_prior() -> None:
    # Its axles would bounce undamped, and the bridge's response to that pass for information.
    assert (information_of_tandem(1.0) / information_of_tandem(0.0)).max() > 1.5
