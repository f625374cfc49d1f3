"""The distance of a run from the bridge's axis, by a receiver that is good enough."""

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from schemas.site import Bridge
from services.common.geodesy import bridge_frame, to_lat_lon
from services.finding.crossing_data import CrossingData
from services.finding.streams import Fixes
from services.identification.lane import lane_factor
from services.simulation.drive import paper_site

SITE = paper_site()


def driven(lateral_m: float, spread_m: float = 0.02, **lane: float) -> CrossingData:
    """Fixes every metre along a line beside the axis, of a site with keys of a `lane`."""
    bridge = Bridge.model_validate(SITE.bridges[0].model_dump() | lane)
    along = np.arange(-20.0, 50.0)
    latitude, longitude = to_lat_lon(bridge_frame(bridge), along, lateral_m)
    fixes = Fixes(along / 10.0, latitude, longitude, np.full(along.size, 10.0), 0.0 * along)
    data: Any = SimpleNamespace(
        bridge=bridge,
        receiver=SITE.receiver.model_copy(update={"position_spread_m": spread_m}),
        fixes=fixes,
        stay=SimpleNamespace(entry_s=0.0, exit_s=3.5),
    )
    return cast("CrossingData", data)


@pytest.mark.parametrize("lateral_m", [1.2, -1.9, 1.5])
def test_factor_is_the_square_of_the_measured_distance(lateral_m: float) -> None:
    found = lane_factor(driven(lateral_m, lane_offset_m=1.5))
    assert found == pytest.approx((lateral_m / 1.5) ** 2, rel=1e-3)


def test_poor_receiver_leaves_the_declared_lane() -> None:
    assert lane_factor(driven(1.2, spread_m=1.5, lane_offset_m=1.5)) == 1.0


def test_receiver_that_contradicts_the_declared_lane_is_not_followed() -> None:
    assert lane_factor(driven(0.1, lane_offset_m=1.5)) == 1.0


def test_undeclared_lane_is_not_taken_from_the_receiver() -> None:
    """The line between the ends may have been measured along the lane."""
    assert lane_factor(driven(0.0)) == 1.0
