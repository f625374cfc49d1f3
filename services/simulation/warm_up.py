"""Compile the kernels of simulations ahead of time: `python -m services.simulation.warm_up`.

`make install` runs it after `services.execution.warm_up`, which gives the reason. Without it the
first `driveby survey` would compile for half a minute.
"""

import sys

import numpy as np

from pre_core.paper import experiment
from pre_core.paper.crossing import paper_window
from services.execution.warm_up import report_on
from services.simulation.two_sided import Body, WideAxle, WideTruck, cross, even_motion
from services.simulation.two_sided_deck import Deck
from services.simulation.two_sided_surface import draw_waves
from services.simulation.wide_crossings import road_under


def main(*, strict: bool = False) -> int:
    """Compile missing kernels of simulations, see `services.execution.warm_up.main`."""
    return report_on(warm_up, "kernels of simulations", strict=strict)


def warm_up() -> None:
    """Run every kernel of simulations once: in a plane, and with a left and a right side."""
    paper_window(experiment.TRUCK, experiment.beam(np.ones(experiment.ELEMENTS)), 0.0, 0)
    axles = tuple(WideAxle(at, 1e3, 1e6, 1e4, 2e6) for at in (0.0, 4.0))
    truck = WideTruck((Body(1e4, 2.0, 2e4, 1e4),), axles)
    road = road_under(truck, draw_waves("A", 1), -6.0, 6.0)
    cross(truck, Deck(4.0, (1e9,), 1e3, 0.1, 1e-4), road, even_motion(-1.0, 10.0, 0.1, 1e-3))


if __name__ == "__main__":
    sys.exit(main(strict="--strict" in sys.argv[1:]))
