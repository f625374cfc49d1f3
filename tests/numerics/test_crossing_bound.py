"""The Cramér-Rao bound of a crossing at its truth: it belongs to a model that is right there."""

from typing import NamedTuple

import numpy as np
import pytest

from pre_core.crossing import posterior
from pre_core.survey.plan import PosteriorAtTruth
from schemas.settings import IdentificationSettings
from services.simulation.data_alone import crossing_data_only
from services.simulation.drawn import IdentifiedCrossing, SimulatedCrossing, draw_truth, drive
from studies.simulation.out_of_model import draw_out_of_model
from studies.simulation.truths import default_site, true_values
from studies.validation.bound import (
    at_truth,
    bound_at,
    bound_at_truth,
    bound_of,
    bound_of_runs,
    optimise_subset,
)

SITE = default_site()
SETTINGS = IdentificationSettings(method="pre", threads=1)
SEED = 29


def plain_drive(noise_ug: float = 40.0, **conditions: float) -> SimulatedCrossing:
    """A steady crossing whose sensors have noise, but neither gain nor delay; true total mass."""
    truth = draw_truth(SITE, SEED)
    zero = np.zeros(4)
    errors = truth.channels._replace(common_gain=0.0, gain=zero, delay_s=zero)
    how = truth.conditions._replace(
        rate_hz=1000.0,
        noise_ug_per_rthz=noise_ug,
        change_m_per_s=0.0,
        speed_m_per_s=15.0,
        **conditions,
    )
    mass = SITE.vehicles[0].total_mass_kg
    car = truth.car._replace(body_mass_kg=mass - sum(truth.car.unsprung_mass_kg))
    return drive(SITE, truth._replace(car=car, channels=errors, conditions=how), SEED)


def data_of(drawn: SimulatedCrossing) -> IdentifiedCrossing:
    (seen,) = crossing_data_only([drawn.run], drawn.site, SETTINGS)
    return seen


class Plain(NamedTuple):
    """A plain drive, what is seen of it, and its bound as JSON."""

    drawn: SimulatedCrossing
    seen: IdentifiedCrossing
    bound: dict[str, dict[str, float]]


@pytest.fixture(scope="module")
def plain() -> Plain:
    drawn = plain_drive()
    seen = data_of(drawn)
    return Plain(drawn, seen, bound_at_truth(seen, drawn))


def test_the_model_is_right_at_the_truth(plain: Plain) -> None:
    """No search has been there: a generator or a model that were wrong would show here."""
    found = plain.bound
    assert 0.9 < found["at_truth"]["chi2_per_dof"] < 1.08
    rigidities = [found["std"][f"EI_{e + 1}"] for e in range(7)]
    assert 0.01 < min(rigidities) < max(rigidities) < 0.4
    # With the scale error every one is wider, by as much as the total mass says at least.
    for e in range(7):
        name = f"EI_{e + 1}"
        assert found["std"][name] ** 2 - found["std_without_scale"][name] ** 2 > 0.99 * 0.01**2


def test_the_bound_grows_with_the_noise() -> None:
    quiet, loud = (
        bound_at_truth(data_of(drawn), drawn)["std_without_scale"]
        for drawn in (plain_drive(25.0), plain_drive(50.0))
    )
    # The third element is known by the data: its bound is nearly proportional to their noise.
    assert loud["EI_3"] / quiet["EI_3"] == pytest.approx(2.0, rel=0.15)


def test_a_truth_known_by_its_entry_gives_the_same_bound(plain: Plain) -> None:
    drawn, seen, full = plain
    near = 0.0 if drawn.truth.conditions.forward else SITE.bridges[0].span_m
    entry = drawn.start_s + drawn.step_s * np.argmin(np.abs(drawn.motion.position_m - near))
    part = bound_at(seen, true_values(drawn.truth), drawn.truth.car.wheelbase_m, float(entry))
    assert part["at_truth"]["chi2_per_dof"] == pytest.approx(
        full["at_truth"]["chi2_per_dof"], abs=0.01
    )
    for e in range(7):
        name = f"EI_{e + 1}"
        assert part["std"][name] == pytest.approx(full["std"][name], rel=0.03)


def test_differences_are_fine_enough_and_nuisances_settle(plain: Plain) -> None:
    problem, y = at_truth(plain.seen, plain.drawn)
    where = posterior.layout(problem)
    nuisances = np.arange(where.gains.start, where.size)
    moved = y.copy()
    moved[where.delays] += [2.0, -2.0, 1.0, -1.0]  # of 0.5 ms
    moved[where.gains] += 1.0
    settled = optimise_subset(problem, moved, nuisances)
    np.testing.assert_array_equal(settled[: nuisances[0]], y[: nuisances[0]])
    rows = posterior.all_rows(problem, np.stack([y, moved, settled]))
    squares = np.sum(rows * rows, axis=1)
    assert squares[1] > squares[0] + 100.0
    assert squares[2] == pytest.approx(squares[0], abs=0.1)
    coarse, fine = (bound_of(problem, y, 0.0, step=step).std for step in (1e-4, 5e-5))
    for name, value in fine.items():
        assert coarse[name] == pytest.approx(value, rel=1e-3), name


def test_roads_that_differ_are_noise_at_the_truth() -> None:
    """On a drawn surface the rows are white by its class and the tyres; without that, far off."""
    world = draw_out_of_model(SITE, "surface", 1)
    drawn = drive(world.site, world.truth, 1)
    seen = data_of(drawn)
    problem, y = at_truth(seen, drawn)
    assert problem.mismatch.level_m3[0] > 1e-8
    with_noise = bound_of(problem, y, 0.0)
    assert 0.8 < with_noise.chi2_per_dof < 1.25
    one_road = drawn._replace(truth=drawn.truth._replace(paths=None))
    assert bound_of(*at_truth(seen, one_road), 0.0).chi2_per_dof > 10.0
    # Twin tyres hardly observe the elements; several runs in one track more, and less
    # more than as many independent ones would.
    lengths_m = np.array(world.site.bridges[0].lengths_m)
    once, often, apart = (
        bound_of_runs([PosteriorAtTruth(problem, y)] * runs, wander_m, lengths_m, 0.01)
        for runs, wander_m in ((1, 0.12), (6, 0.12), (6, 1.0))
    )
    assert 0.08 < once.level < 0.2
    assert np.median(apart.elements) < np.median(often.elements) < np.median(once.elements)
    assert np.median(once.elements / [with_noise.std[f"EI_{e + 1}"] for e in range(7)]) < 1.2
