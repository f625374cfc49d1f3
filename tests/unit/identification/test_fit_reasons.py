"""Where a misfit is: the text of its reason."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pre_core import parameters
from pre_core.crossing import posterior
from services.identification import fit_reasons
from services.identification.fit_reasons import _place_of_misfit, _wrong_bridge, contradictions


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


def test_bridge_parameter_beyond_four_priors_deviations_is_a_diagnostic() -> None:
    """Log-normal priors count in logarithms, half-normal ones from zero; EI has no remark."""
    nominal = np.ones(parameters.EI_1 + 1)
    spread = np.full(nominal.size, 0.1)
    half_normal = np.zeros(nominal.size, dtype=bool)
    half_normal[parameters.F : parameters.F + 2] = True
    estimated = np.ones(nominal.size, dtype=bool)
    estimated[parameters.TORSION] = False
    theta = np.tile(nominal, (2, 1))
    theta[:, parameters.RHO_A] = np.exp(-0.22 * np.array([9.0, 11.0]))
    theta[:, parameters.ALPHA] = np.exp(0.39)
    theta[:, parameters.F] = 0.41
    theta[:, parameters.F + 1] = 0.39
    theta[:, parameters.TORSION] = theta[:, parameters.EI_1] = 9.0
    coordinates = np.where(half_normal, theta, np.log(theta / nominal)) / spread
    further = np.full((2, 3), 50.0)  # those of the channels follow the parameters'
    draws = np.hstack([coordinates[:, estimated], further])[None]
    problem: Any = SimpleNamespace(priors=SimpleNamespace(estimated=estimated))

    def found(f1_hz: float, declared_hz: float | None) -> dict[str, float]:
        bridge: Any = SimpleNamespace(first_frequency_hz=declared_hz)
        derived: Any = SimpleNamespace(f1_hz=SimpleNamespace(mean=f1_hz))
        return contradictions(bridge, problem, draws, derived)

    alone = found(5.1, None)
    assert alone == pytest.approx({"prior_z_rhoA": -22.0, "prior_z_f_start": 4.1})
    assert found(3.9, 3.3) == alone
    assert found(5.1, 3.0) == pytest.approx(alone | {"f1_over_declared": 1.7})
