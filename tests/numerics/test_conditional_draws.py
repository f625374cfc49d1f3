"""Draws of few coordinates with all others given these, against weighted draws of all at once."""

from typing import NamedTuple

import numpy as np
import pytest

from pre_core.arrays import FloatArray
from pre_core.crossing import posterior, sampling
from pre_core.crossing.conditional_draws import conditional_draws
from pre_core.crossing.fit import Optimum
from pre_core.crossing.optimum import find_optimum
from pre_core.crossing.weighted_draws import (
    WantedDraws,
    WeightedDraws,
    is_enough,
)
from pre_core.search.importance import SmoothedWeights
from pre_core.search.loop import Termination
from schemas.settings import IdentificationSettings
from services.simulation.data_alone import crossing_data_only, inputs_of_seen
from services.simulation.drawn import draw_truth, drive
from studies.simulation.truths import default_site

DRAWS = 1200
pytestmark = pytest.mark.xdist_group("conditional draws")


def silent(stage: str, fraction: float) -> None:
    """Report nothing."""


@pytest.fixture(scope="module")
def found() -> Optimum:
    site = default_site()
    driven = drive(site, draw_truth(site, 4), 4)
    settings = IdentificationSettings(method="pre", threads=1)
    (seen,) = crossing_data_only([driven.run], driven.site, settings)
    return find_optimum(inputs_of_seen(seen))


class Moments(NamedTuple):
    mean: FloatArray
    spread: FloatArray


def moments(drawn: WeightedDraws) -> Moments:
    weight = drawn.weights.weight
    mean = weight @ drawn.y
    return Moments(mean, np.sqrt(weight @ (drawn.y - mean) ** 2))


@pytest.mark.parametrize("inflation", [1.0, 2.0])
def test_both_ways_draw_the_same_posterior(found: Optimum, inflation: float) -> None:
    """They share the residuals, and neither the density of the draws nor its coordinates."""
    all_at_once = sampling.surrogate_draws(found, DRAWS, 2, inflation, silent)
    some = conditional_draws(found, DRAWS, 2, inflation, silent)
    assert is_enough(all_at_once.weights, DRAWS)
    assert is_enough(some.weighted.weights, DRAWS)
    expected, seen = moments(all_at_once), moments(some.weighted)
    where = posterior.layout(found.problem)
    normal = np.setdiff1d(np.arange(where.size), where.half_normal)
    z = (seen.mean - expected.mean)[normal] / expected.spread[normal]
    assert np.abs(z[np.isin(normal, where.elements)]).max() < 0.4
    assert np.sqrt(np.mean(z**2)) < 0.2
    ratio = seen.spread[normal] / expected.spread[normal]
    assert np.median(ratio) == pytest.approx(1.0, abs=0.06)


def test_hopeless_draws_are_replaced(found: Optimum, monkeypatch: pytest.MonkeyPatch) -> None:
    """Draws of a normal likelihood that do not suffice: others are weighted, and all counted."""
    poor = SmoothedWeights(np.full(400, 1.0 / 400.0), 0.9, 40.0)
    asked: list[WantedDraws] = []

    def few(*given: object) -> WeightedDraws:
        asked.extend(one for one in given if isinstance(one, WantedDraws))
        return WeightedDraws(np.repeat(found.state.y[None, :], 400, axis=0), poor)

    monkeypatch.setattr(sampling, "importance_draws", few)
    drawn = sampling._single_profile_draws(found, DRAWS, 1, 1.0, silent)
    assert asked == [WantedDraws(DRAWS, sampling._PATIENCE)]
    assert drawn.ending is Termination.STEPS_DONE
    assert drawn.ess > 400.0
    assert drawn.evaluations > 400
