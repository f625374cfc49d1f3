"""The pictures of `driveby validate`: what is drawn is what was found, and nothing overlaps."""

import io
from pathlib import Path

import matplotlib
import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import imread
from matplotlib.patches import StepPatch

from pre_core.paper import experiment
from pre_core.search.loop import Termination
from services.common.errors import InputError
from services.viewer.drawing import STYLE
from studies.paper.figures import (
    describe,
    draw_overview,
    draw_posterior,
    overview_figure,
    posterior_figure,
)
from studies.paper.scenarios import NAMES, Cloud, Scenario, cloud_of
from studies.paper.tables import tables_of_paper
from tests.unit.words import assert_words_apart, words

PARTICLES = 400


@pytest.fixture(autouse=True)
def style():
    with matplotlib.rc_context(STYLE):
        yield


def scenario(number: int, ours: dict[str, float] | None = None, spread: float = 0.2) -> Scenario:
    rng = np.random.default_rng(number)
    truth = dict.fromkeys(NAMES, 1.0)
    ratios = experiment.scenario_ratios(number)
    truth |= {f"EI_{e + 1}": float(ratio) for e, ratio in enumerate(ratios)}
    values = np.array([truth[name] for name in NAMES])
    cloud = values + spread * rng.standard_normal((PARTICLES, len(NAMES)))
    answer = np.array([(ours or {}).get(name, truth[name]) for name in NAMES])
    return Scenario(
        number,
        NAMES,
        truth,
        rng.uniform(0.8, 1.2, (PARTICLES, len(NAMES))),
        cloud_of(cloud, NAMES, truth),
        cloud_of(answer[None, :], NAMES, truth),
        {"random_walk": Termination.STEPS_DONE, "least_squares": Termination.CONVERGED},
        {"random_walk": 1.0, "least_squares": 1.0},
    )


def histograms(axes: Axes) -> list[tuple[np.ndarray, np.ndarray]]:
    """Densities and edges: prior, then posterior."""
    data = [patch.get_data() for patch in axes.patches if isinstance(patch, StepPatch)]
    return [(np.asarray(step.values), np.asarray(step.edges)) for step in data]


def panel(figure: Figure, symbol: str) -> Axes:
    return next(axes for axes in figure.axes if axes.get_title(loc="right") == symbol)


def test_twenty_panels_vehicle_left_bridge_right() -> None:
    figure = draw_posterior(scenario(1), NAMES)
    assert len(figure.axes) == 20
    middle = {axes.get_title(loc="right"): axes.get_position().x0 for axes in figure.axes}
    bridge = {rf"$EI_{{{e}}}$" for e in range(1, 8)} | {r"$\rho A$", r"$\alpha$", r"$\beta$"}
    assert {symbol for symbol, x in middle.items() if x > 0.5} == bridge


def test_histograms_are_probability_densities_of_what_was_found() -> None:
    found = scenario(6)
    figure = draw_posterior(found, NAMES)
    axes = panel(figure, "$EI_{4}$")
    column = NAMES.index("EI_4")
    samples = (found.prior[:, column], found.random_walk.samples[:, column])
    for (density, edges), values in zip(histograms(axes), samples, strict=True):
        assert np.sum(density * np.diff(edges)) == pytest.approx(1.0)
        centres = (edges[:-1] + edges[1:]) / 2
        assert np.sum(centres * density * np.diff(edges)) == pytest.approx(values.mean(), abs=0.01)
        assert axes.get_ylim()[1] > density.max()  # nothing is cut off at the top
    line, truth = axes.lines
    assert line.get_xdata()[0] == pytest.approx(0.4)
    assert truth.get_xdata()[0] == pytest.approx(0.4)
    limits = {axes.get_xlim() for axes in figure.axes}
    assert len(limits) == 1  # widths can be compared between panels


def test_values_beyond_the_axis_are_named() -> None:
    found = scenario(1, {"EI_7": 9.8e7, "alpha": -4.0})
    samples = found.random_walk.samples.copy()
    samples[:3, NAMES.index("EI_7")] = 40.0
    found = found._replace(random_walk=found.random_walk._replace(samples=samples))
    figure = draw_posterior(found, NAMES)
    assert {text.get_text() for text in panel(figure, "$EI_{7}$").texts} == {
        "9.8e+07 →",
        "3 beyond",
    }
    assert {text.get_text() for text in panel(figure, r"$\alpha$").texts} == {"← -4"}
    assert_words_apart(figure)


def test_overview_draws_truth_paper_and_both_searches() -> None:
    found = scenario(6, {"EI_4": 0.45, "EI_7": 3.0})
    axes = draw_overview([found], tables_of_paper()).axes[0]
    steps = axes.collections[0].get_paths()
    assert [path.vertices[0, 1] for path in steps] == [1, 1, 1, 0.4, 1, 1, 1]
    theirs, walk = (container.lines[0].get_ydata() for container in axes.containers)
    rows = tables_of_paper()["table7_normalised_estimates"]
    assert theirs == pytest.approx([rows[f"EI_{e}"]["mean"][5] for e in range(1, 8)])
    assert walk == pytest.approx([found.random_walk.mean[f"EI_{e}"] for e in range(1, 8)])
    spread = axes.containers[1].lines[2][0].get_segments()
    assert [end[1] - begin[1] for begin, end in spread] == pytest.approx(
        [2 * found.random_walk.std[f"EI_{e}"] for e in range(1, 8)]
    )
    ours, beyond = axes.lines[-2:]
    assert ours.get_ydata() == pytest.approx([1, 1, 1, 0.45, 1, 1])
    assert beyond.get_marker() == "^"
    assert beyond.get_xdata() == pytest.approx([7.25])


def test_overview_without_the_paper_does_not_name_it() -> None:
    figure = draw_overview([scenario(6)], None)
    assert not any("paper" in text.get_text() for text in words(figure))
    assert len(figure.axes[0].containers) == 1


@pytest.mark.parametrize("count", [1, 2, 5, 12])
def test_words_stand_apart_in_the_overview(count: int) -> None:
    assert_words_apart(
        draw_overview([scenario(n) for n in experiment.SCENARIOS[:count]], tables_of_paper())
    )


@pytest.mark.parametrize("spread", [0.02, 1.0])
def test_words_stand_apart_in_the_posterior(spread: float) -> None:
    assert_words_apart(draw_posterior(scenario(9, spread=spread), NAMES))


def test_fewer_parameters_leave_no_empty_panel() -> None:
    names = tuple(name for name in NAMES if name != "alpha")
    kept = [NAMES.index(name) for name in names]
    found = scenario(1)

    def without(cloud: Cloud) -> Cloud:
        return cloud._replace(samples=cloud.samples[:, kept])

    found = found._replace(
        names=names, prior=found.prior[:, kept], random_walk=without(found.random_walk)
    )
    assert len(draw_posterior(found, names).axes) == 19


def test_scenarios_are_described_in_words() -> None:
    described = {n: describe(scenario(n)) for n in (1, 3, 6, 8)}
    assert described == {
        1: "undamaged",
        3: "all elements at 0.8",
        6: "element 4 at 0.4",
        8: "elements 5 and 6 at 0.7",
    }


def test_png_is_wide_enough_for_a_page_and_the_same_each_time(tmp_path: Path) -> None:
    one, two, three = (tmp_path / f"{i}.png" for i in range(3))
    posterior_figure(one, scenario(6), NAMES)
    posterior_figure(two, scenario(6), NAMES)
    overview_figure(three, [scenario(6)], None)
    assert one.read_bytes() == two.read_bytes()
    for path in (one, three):
        assert imread(io.BytesIO(path.read_bytes())).shape[1] == 1800
    with pytest.raises(InputError, match="does not exist"):
        overview_figure(tmp_path / "no" / "a.png", [scenario(6)], None)
    assert len(list(tmp_path.iterdir())) == 3
