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
    ("values", "best", "noise"),
    [
        ([1.2], 1.2, []),  # explained
        ([3.0, 2.0, 1.01], 1.01, [1.0, 2.0]),
        ([600.0, 700.0], 600.0, [0.0]),  # hopeless, from the nominal truck too
        ([3.0, 2.0, 1.9, 390.0, 1.4], 1.4, [1.0, 2.0, 0.0, 4.0]),  # hardly better: nominal truck
        ([3.0, 5.0, 4.0, 4.0], 3.0, [1.0, 0.0, 3.0]),
        # The limit of repeats.
        ([9.0, 7.0, 5.5, 4.3, 3.4, 600.0], 3.4, [1.0, 2.0, 3.0, 4.0, 0.0]),
    ],
)
def test_fits_are_repeated_and_begun_again(
    monkeypatch: pytest.MonkeyPatch, values: list[float], best: float, noise: list[float]
) -> None:
    left = list(values)
    noise_of: list[float] = []

    def fit_once(problem: Any, y: Any) -> OffBridgeFit:
        number = len(values) - len(left)
        return OffBridgeFit(np.full(2, 1.0 + number), left.pop(0), 10)

    def update_noise(problem: Any, y: Any, force: Any) -> Any:
        noise_of.append(float(y[0]))
        return problem

    monkeypatch.setattr(misfit, "_fit_once", fit_once)
    monkeypatch.setattr(misfit, "update_noise", update_noise)
    monkeypatch.setattr(misfit, "layout", lambda _: SimpleNamespace(trajectory=slice(1, 2)))
    unknown: Any = SimpleNamespace(y=np.full(2, 9.0), force=np.zeros(1))
    fit = misfit.fit_off_bridge(Optimum(unknown, unknown, Termination.CONVERGED, 5.0, 1, 1))
    assert (fit.chi2, fit.evaluations) == (best, 10 * len(values))
    assert fit.y[0] == 1.0 + values.index(best)
    assert noise_of == noise
    assert not left
