"""The picture of one crossing: flexural rigidity along the span, and the road."""

import matplotlib
from matplotlib.figure import Figure

from services.common.errors import InputError
from services.notebook.simulate import Simulation
from services.notebook.solution import Identification, Solution
from services.viewer.crossing_view import view_of_crossing
from services.viewer.drawing import STYLE
from services.viewer.figure import draw_crossing


def plot(found: Solution | Identification, truth: Simulation | None = None) -> Figure:
    """Draw one crossing, with the truth next to it where it is known.

    An `Identification` of several crossings is refused with InputError: draw its `solutions` one by
    one. The figure is no pyplot's: Jupyter shows it after `%matplotlib inline`, and
    `figure.savefig("crossing.png", dpi=200)` writes it.
    """
    if isinstance(found, Identification):
        if len(found.solutions) != 1:
            raise InputError(
                f"plot draws one crossing, these are {len(found.solutions)}: "
                "plot(found.solutions[0]), …"
            )
        (found,) = found.solutions
    with matplotlib.rc_context(STYLE):
        return draw_crossing(
            view_of_crossing(found.crossing, found.bridge),
            element_truth=None if truth is None else truth.ei_ratios.tolist(),
            road_truth=None if truth is None else truth.road_m,
        )
