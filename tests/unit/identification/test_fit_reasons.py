"""Where a misfit is: the text of its reason."""

from typing import Any

import numpy as np
import pytest

from pre_core.crossing.misfit import OffBridgeFit
from services.identification import fit_reasons


@pytest.mark.parametrize(
    ("chi2", "text"),
    [
        (np.inf, ""),
        (0.9, "only on the bridge"),
        (1.5, "only on the bridge"),
        (2.0, ""),
        (12.3, "also before and behind the bridge (χ² 12)"),
    ],
)
def test_the_text_of_a_misfit_says_where_it_is(
    chi2: float, text: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    fit = OffBridgeFit(np.zeros(1), chi2, 0)
    monkeypatch.setattr(fit_reasons, "fit_off_bridge", lambda _: fit)
    found: Any = None
    seen = fit_reasons._place_of_misfit(found)
    assert seen.startswith(text) if text else seen == ""
