"""Diagnostics of draws: of those that were weighted, also where others take their place."""

from typing import Any

import numpy as np
import pytest

from pre_core.crossing import sampling
from pre_core.crossing.sampling import PosteriorDraws
from pre_core.crossing.surface_posterior import ResidualDraws
from pre_core.crossing.weighted_draws import WeightedDraws
from pre_core.search.importance import SmoothedWeights
from pre_core.search.loop import Termination
from services.identification.pre_method import _diagnostics_of_draws

DRAWS = PosteriorDraws(np.zeros((10, 4, 2)), 1.004, 1156.0, 1.0, 0, Termination.STEPS_DONE)


def test_failed_draws_of_alike_tyres_keep_their_diagnostics(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    weights = SmoothedWeights(np.full(200, 1.0 / 200.0), 1.2, 12.0)
    weighted = WeightedDraws(np.zeros((200, 3)), weights)
    drawn = ResidualDraws(weighted, 407)
    monkeypatch.setattr(sampling, "drawn_by_residuals", lambda *given: drawn)
    monkeypatch.setattr(sampling, "_compliance_draws", lambda *given: DRAWS)
    found: Any = None
    chains = sampling._alike_tyres_draws(found, 1200, 1, 1.0, lambda stage, fraction: None)
    assert chains.draws is DRAWS.draws
    assert chains.ending is Termination.STEPS_EXHAUSTED
    assert (chains.ess, chains.acceptance, chains.pareto_k) == (12.0, 12.0 / 200.0, 1.2)
    assert chains.evaluations == 407
    assert chains.points is None


@pytest.mark.parametrize("k", [None, np.inf])
def test_results_hold_finite_diagnostics_only(k: float | None) -> None:
    assert "pareto_k" not in _diagnostics_of_draws(DRAWS._replace(pareto_k=k))
    assert _diagnostics_of_draws(DRAWS._replace(pareto_k=0.71))["pareto_k"] == 0.71
