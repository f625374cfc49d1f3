"""The figure of one crossing or one bridge: flexural rigidity along the span, and the road."""

import matplotlib
from matplotlib.figure import Figure

from services.common.errors import InputError
from services.identification.comparison import estimate_of_state
from services.notebook.arguments import wrong
from services.notebook.fuse import Fusion
from services.notebook.simulate import Simulation, check_truth
from services.notebook.solution import Identification, Solution, one_solution
from services.viewer.bridge_figure import draw_bridge
from services.viewer.bridge_view import view_of_bridge
from services.viewer.crossing_view import view_of_crossing
from services.viewer.drawing import STYLE
from services.viewer.figure import draw_crossing, true_road_as_measured


def plot(
    found: Solution | Identification | Fusion,
    truth: Simulation | None = None,
    *,
    bridge: str | None = None,
) -> Figure:
    """Draw one crossing, with the truth next to it where it is known, or one fused bridge.

    The true road is drawn on the bridge, less the least-squares parabola of its distance from the
    estimate: twice integrated accelerations determine neither level, slope nor bend.

    An `Identification` of several crossings is refused with InputError: draw its `solutions` one by
    one. `bridge` selects one of several that are fused. Jupyter shows the figure after
    `%matplotlib inline`, `pyplot.show()` does not; `figure.savefig("crossing.png", dpi=200)` writes
    it.
    """
    check_truth(truth)
    if isinstance(found, Fusion):
        if truth is not None:
            raise InputError("truth is drawn with a single crossing, not with a fused bridge")
        return _plot_bridge(found, bridge)
    if not isinstance(found, Solution | Identification):
        raise wrong("found", found, "what identify() or fuse() returns, or one of its solutions")
    one = one_solution("found", found, "plot")
    road = one.crossing.road
    true_road = None if truth is None else truth.road_m
    if true_road is not None and road is not None:
        true_road = true_road_as_measured(road, true_road)
    with matplotlib.rc_context(STYLE):
        return draw_crossing(
            view_of_crossing(one.crossing, one.bridge),
            element_truth=None if truth is None else truth.ei_ratios.tolist(),
            road_truth=true_road,
        )


def _plot_bridge(fused: Fusion, name: str | None) -> Figure:
    names = list(fused.bridges)
    if name is None and len(names) == 1:
        (name,) = names
    if name not in names:
        raise wrong("bridge", name, f"one of {', '.join(names)}")
    bridge = fused.site_with([name]).bridge(name)
    stored = {} if fused.baseline is None else fused.baseline.bridges
    before = estimate_of_state(stored[name]) if name in stored else None
    with matplotlib.rc_context(STYLE):
        return draw_bridge(view_of_bridge(bridge, fused.results, before))
