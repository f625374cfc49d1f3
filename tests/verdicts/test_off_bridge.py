"""Faults on the bridge and off it: which is named, and that neither costs more than it must."""

import numpy as np
import pytest

from schemas.reasons import Reason
from schemas.site import Bridge, Site
from tests.verdicts import faults
from tests.verdicts.faults import Fault, Truth

SOUND = Truth(seed=21)
FOLLOWER = Fault(second_vehicle_kg=2000.0, second_vehicle_gap_m=10.0)
MOST_EVALUATIONS = 16_000
"""Four times those of a good crossing with its draws; these took 40,000 to 106,000."""


def with_bridge(site: Site, **changes: object) -> Site:
    bridge = site.bridges[0]
    changed = Bridge.model_validate(bridge.model_dump() | changes)
    return site.model_copy(update={"bridges": (changed,)})


def without_support(site: Site) -> Site:
    return with_bridge(site, interior_supports_m=())


TWO_SPANS = SOUND._replace(
    site=with_bridge(SOUND.site, interior_supports_m=(15.0,), elements=8), ratios=(1.0,) * 8
)


def test_a_vehicle_that_follows_is_a_misfit_on_the_bridge() -> None:
    result = faults.identified(faults.crossing(SOUND, FOLLOWER))
    assert result.verdict == "rejected"
    assert Reason.MISFIT_ON_BRIDGE in result.reasons
    # The truck was as declared, and its sensors were: the fit of the bridge does not say otherwise.
    assert {Reason.CHANNEL_SLIPPED, Reason.IMPLAUSIBLE_VEHICLE}.isdisjoint(result.reasons)
    assert result.diagnostics["iterations"] < MOST_EVALUATIONS


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize(
    ("truth", "fault"),
    [
        (SOUND, Fault(second_vehicle_kg=5000.0)),
        (SOUND, Fault(second_vehicle_kg=15000.0, second_vehicle_gap_m=-15.0)),
        (SOUND, Fault(site=faults.span_believed(0.9))),
        (TWO_SPANS, Fault(site=without_support)),
        (SOUND, FOLLOWER._replace(car=lambda car: car._replace(bilinear_damping=0.2))),
    ],
    ids=["oncoming", "ahead", "shorter span", "support missing", "follower, bilinear dampers"],
)
def test_what_is_wrong_on_the_bridge_is_rejected_early(truth: Truth, fault: Fault) -> None:
    result = faults.identified(faults.crossing(truth, fault))
    assert result.verdict == "rejected"
    assert Reason.MISFIT_ON_BRIDGE in result.reasons
    assert result.diagnostics["iterations"] < MOST_EVALUATIONS


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_two_spans_that_are_declared_are_good() -> None:
    case = faults.crossing(TWO_SPANS)
    result = faults.identified(case)
    assert result.verdict == "good", result.reasons
    assert np.abs(faults.z_scores(case, result)).max() < 4.0
