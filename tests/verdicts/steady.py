"""What is known of a crossing of the paper's bridge at 10 m/s before anything is fitted."""

import numpy as np

from services.common.arrays import Floats
from services.finding.crossing_data import CrossingData
from services.finding.stays import Passage, Stay
from services.finding.streams import Fixes
from services.simulation.drive import paper_site

ENTRY_S, EXIT_S = 3.0, 6.44
_SITE = paper_site()


def steady_crossing(fix_times_s: Floats, **vehicle: object) -> CrossingData:
    """A receiver that spoke at these times, and a truck whose site file differs in these fields."""
    place_m = 10.0 * (fix_times_s - ENTRY_S)
    return CrossingData(
        crossing_id="x",
        realm="sim-x",
        vehicle=_SITE.vehicles[0].model_copy(update=vehicle),
        bridge=_SITE.bridges[0],
        sensor=_SITE.sensor,
        receiver=_SITE.receiver,
        stay=Stay(Passage.THROUGH, 1, ENTRY_S, EXIT_S),
        fixes=Fixes(
            fix_times_s, fix_times_s, fix_times_s, np.full(fix_times_s.size, 10.0), fix_times_s
        ),
        chainage_m=place_m,
        samples=None,
        wall_offset_s=0.0,
    )
