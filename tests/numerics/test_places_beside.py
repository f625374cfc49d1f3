"""Where a bearing gives and the axles' roads hardly differ, optima lie a hand's breadth apart."""

import pytest

from schemas.results import CrossingResult
from schemas.settings import IdentificationSettings
from studies.simulation.truths import default_site
from studies.validation.surveys import one_crossing


@pytest.mark.slow
def test_the_right_one_of_optima_beside_each_other_is_found() -> None:
    """A crossing for which the walk along the road chooses the next but one: chi2 is 1.3 there."""
    settings = IdentificationSettings(method="pre", threads=1)
    record = one_crossing(default_site(), "single-5", 0, 2, settings)
    result = CrossingResult.model_validate(record["result"])
    assert result.verdict == "good"
    assert result.chi2_per_dof is not None
    assert result.chi2_per_dof < 1.1
    assert result.parameters is not None
    for n, truth in enumerate(record["truth"], start=1):
        found = result.parameters[f"EI_{n}"]
        assert abs(found.mean - truth) < 4.0 * found.std
