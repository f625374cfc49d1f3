"""What no damage does to a bridge is doubted, damage never; a search that fails gives no number."""

import numpy as np
import pytest

from pre_core.crossing import optimum
from pre_core.crossing.fit import Optimum
from pre_core.search.loop import Termination
from schemas.reasons import Reason
from schemas.settings import IdentificationSettings
from services.identification import pre_method
from tests.verdicts import faults
from tests.verdicts.faults import Fault, Truth

SETTINGS = IdentificationSettings(method="pre", seed=0, draws=300)
STIFF = (1.0, 1.0, 2.2, 1.0, 1.0, 0.5, 1.0)


def declared_per_element(site: faults.Site) -> faults.Site:
    """The owner knows which element is built stiffer."""
    bridge = site.bridges[0]
    nominal = np.array(bridge.nominal_flexural_rigidity_nm2) * [1.0, 1.0, 2.2, 1.0, 1.0, 1.0, 1.0]
    other = bridge.model_copy(update={"flexural_rigidity_per_element_nm2": tuple(nominal.tolist())})
    return site.model_copy(update={"bridges": (other,)})


def test_element_that_is_clearly_too_stiff_is_named() -> None:
    result = faults.identified(faults.crossing(Truth(ratios=STIFF)), SETTINGS)
    assert (result.verdict, result.reasons) == ("suspect", (Reason.IMPLAUSIBLE_BRIDGE,))
    assert result.reason_texts[0].endswith(": EI_3.")


@pytest.mark.parametrize(
    ("ratios", "fault"),
    [
        (STIFF, Fault(site=declared_per_element)),
        ((0.4, 1.0, 0.4, 1.0, 0.4, 0.4, 0.4), Fault()),
    ],
    ids=["declared", "damaged"],
)
def test_bridge_is_plausible(ratios: tuple[float, ...], fault: Fault) -> None:
    result = faults.identified(faults.crossing(Truth(ratios=ratios), fault), SETTINGS)
    assert (result.verdict, result.reasons) == ("good", ())


def test_search_that_does_not_converge_gives_no_number(monkeypatch: pytest.MonkeyPatch) -> None:
    def found(*arguments: object) -> Optimum:
        return real(*arguments)._replace(ending=Termination.STEPS_EXHAUSTED)  # type: ignore[arg-type]

    def no_chains(*_: object) -> None:
        raise AssertionError("chains were begun")

    real = optimum.find_optimum
    monkeypatch.setattr(optimum, "find_optimum", found)
    monkeypatch.setattr(pre_method, "sample", no_chains)
    result = faults.identified(faults.crossing(Truth()), SETTINGS)
    assert (result.verdict, result.parameters) == ("rejected", None)
    assert result.reasons == (Reason.NOT_CONVERGED,)
    assert result.reason_texts == ("The search did not converge: it reached its limit of steps.",)
