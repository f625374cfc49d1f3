"""Where a misfit is: the text of its reason."""

import numpy as np
import pytest

from services.identification.fit_reasons import _place_of_misfit


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
