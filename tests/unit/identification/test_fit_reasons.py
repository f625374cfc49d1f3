"""Where a misfit is: the text of its reason."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pre_core.crossing import posterior
from services.identification import fit_reasons
from services.identification.fit_reasons import _place_of_misfit, _wrong_bridge


@pytest.mark.parametrize(
    ("off_bridge_chi2", "text"),
    [
        (np.inf, ""),
        (0.9, "only on the bridge"),
        (1.5, "only on the bridge"),
        (2.0, ""),
        (12.3, "also before and after the bridge (χ² 12)"),
    ],
)
def test_the_text_of_a_misfit_says_where_it_is(off_bridge_chi2: float, text: str) -> None:
    seen = _place_of_misfit(off_bridge_chi2)
    assert seen.startswith(text) if text else seen == ""


@pytest.mark.parametrize(
    ("declared_hz", "fitted_hz", "is_named"),
    [(3.3, 5.1, True), (5.1, 3.3, True), (3.3, 3.9, False), (3.9, 3.3, False), (None, 5.1, False)],
)
def test_misfit_names_a_first_frequency_far_from_the_declared_one(
    monkeypatch: pytest.MonkeyPatch, declared_hz: float | None, fitted_hz: float, is_named: bool
) -> None:
    point: Any = SimpleNamespace(theta=np.zeros((1, 1)))
    monkeypatch.setattr(posterior, "values_of", lambda *_: point)
    monkeypatch.setattr(fit_reasons, "first_frequencies_hz", lambda *_: np.array([fitted_hz]))
    data: Any = SimpleNamespace(bridge=SimpleNamespace(first_frequency_hz=declared_hz))
    problem = SimpleNamespace(crossing=SimpleNamespace(basis=None))
    found: Any = SimpleNamespace(problem=problem, state=SimpleNamespace(y=np.zeros(1)))
    seen = _wrong_bridge(data, found)
    expected = f"the estimated first frequency is {fitted_hz} Hz, declared {declared_hz} Hz, so"
    assert seen.startswith(expected) if is_named else seen == ""
