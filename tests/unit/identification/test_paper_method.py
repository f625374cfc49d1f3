"""What the paper's methods say of quantities that follow from the parameters they find."""

import numpy as np
import pytest

from pre_core import parameters
from pre_core.paper import experiment
from pre_core.paper.crossing import paper_window
from pre_core.paper.residual import deflections_m
from pre_core.physics.models import from_models
from pre_core.search.loop import Termination
from services.identification import paper_method

FREE = parameters.paper_subset(experiment.ELEMENTS)


def test_the_spread_of_the_largest_deflection_is_that_where_it_is_largest() -> None:
    """Against differences too small for another sample to become the largest."""
    rng = np.random.default_rng(2)
    for scenario in (1, 6, 8, 12):
        beam = experiment.beam(experiment.scenario_ratios(scenario))
        window = paper_window(experiment.TRUCK, beam, 0.0, 1)
        theta = from_models(experiment.TRUCK, beam)
        turned = rng.standard_normal((FREE.size, FREE.size)) * 1e-4 * theta[FREE][:, None]
        covariance = turned @ turned.T
        fit = paper_method._Fit(theta, FREE, covariance, None, Termination.CONVERGED, {})
        mean, std = paper_method._largest_deflection(window, fit)
        assert mean == deflections_m(window, theta).max()
        slopes = np.empty(FREE.size)
        for k, place in enumerate(FREE):
            ahead, behind = theta.copy(), theta.copy()
            ahead[place] *= 1.0 + 1e-6
            behind[place] *= 1.0 - 1e-6
            change = deflections_m(window, ahead).max() - deflections_m(window, behind).max()
            slopes[k] = change / (2e-6 * theta[place])
        assert std == pytest.approx(np.sqrt(slopes @ covariance @ slopes), rel=1e-6)
