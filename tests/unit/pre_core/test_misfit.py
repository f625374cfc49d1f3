"""Fits off the bridge are repeated with the noise of their own truck, while that helps."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pre_core.crossing import misfit
from pre_core.crossing.fit import Optimum
from pre_core.crossing.misfit import OffBridgeFit
from pre_core.search.loop import Termination


@pytest.mark.parametrize(
    ("values", "best", "fits"),
    [
        ([1.2], 1.2, 1),  # explained
        ([40.0], 40.0, 1),  # hopeless
        ([3.0, 2.0, 1.01], 1.01, 3),
        ([3.0, 2.0, 1.9], 2.0, 3),  # hardly better
        ([3.0, 5.0], 3.0, 2),
        ([9.0, 7.0, 5.5, 4.3, 3.4], 3.4, 5),  # the limit
    ],
)
def test_repeats(
    monkeypatch: pytest.MonkeyPatch, values: list[float], best: float, fits: int
) -> None:
    left = list(values)
    noise_of: list[float] = []

    def fit_once(problem: Any, y: Any) -> OffBridgeFit:
        number = len(values) - len(left)
        return OffBridgeFit(np.full(1, 1.0 + number), left.pop(0), 10)

    def update_noise(problem: Any, y: Any, force: Any) -> Any:
        noise_of.append(float(y[0]))
        return problem

    monkeypatch.setattr(misfit, "_fit_once", fit_once)
    monkeypatch.setattr(misfit, "update_noise", update_noise)
    unknown: Any = SimpleNamespace(y=np.zeros(1), force=np.zeros(1))
    fit = misfit.fit_off_bridge(Optimum(unknown, unknown, Termination.CONVERGED, 5.0, 1, 1))
    assert (fit.chi2, fit.evaluations) == (best, 10 * fits)
    assert fit.y[0] == 1.0 + values.index(best)
    assert noise_of == [float(number) for number in range(1, fits)]
