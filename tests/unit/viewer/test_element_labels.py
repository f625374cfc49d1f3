"""Intervals of elements that leave their axis, and labels that lie on no line."""

from typing import Any

import matplotlib
import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.lines import Line2D
from matplotlib.markers import CARETUP
from matplotlib.text import Text

from schemas.results import Results
from schemas.site import Site
from services.viewer.bridge_figure import draw_bridge
from services.viewer.bridge_view import BridgeView, view_of_bridge
from services.viewer.crossing_view import view_of_crossing
from services.viewer.crossings_figure import draw_crossings
from services.viewer.drawing import STYLE
from services.viewer.figure import draw_crossing
from tests.unit.viewer.found import results_of, some_crossing
from tests.unit.words import assert_words_apart

OPEN_END = {"mean": 3e10, "std": 2e10, "q025": 1.1e10, "q975": 1.02e11}


@pytest.fixture(autouse=True)
def style() -> Any:
    with matplotlib.rc_context(STYLE):
        yield


def with_open_end(site: Site) -> Results:
    """Results of which only the last element is not resolved: 11 to 102 GN·m²."""
    given = [some_crossing(name, entry=n * 600.0) for n, name in enumerate("ab")]
    found = results_of(site, *given, used="a").model_dump(mode="json")
    found["bridges"][site.bridges[0].id]["EI_7"] |= OPEN_END
    level = {"unit": "1", "mean": 0.97, "std": 0.1, "q025": 0.8, "q50": 0.97, "q975": 1.2}
    for crossing in found["crossings"]:
        crossing["parameters"]["EI_7"] |= OPEN_END
        crossing["derived"] |= {"ei_level": level}
    return Results.model_validate(found)


def arrows(axes: Axes) -> list[Line2D]:
    """The arrows of cut intervals; a bearing is the same sign below the axis."""
    carets = (line for line in axes.lines if line.get_marker() == CARETUP)
    return [line for line in carets if line.get_transform() == axes.transData]


def interval_points(axes: Axes) -> np.ndarray:
    """Points along all drawn intervals, in pixels."""
    found = []
    for lines in axes.collections:
        if isinstance(lines, LineCollection):
            for first, last in lines.get_segments():
                found += list(np.linspace(first, last, 60))
    return axes.transData.transform(np.array(found))


def legend(axes: Axes) -> list[str]:
    drawn = axes.get_legend()
    assert drawn is not None
    return [text.get_text() for text in drawn.get_texts()]


def drawn_axes(site: Site) -> dict[str, Axes]:
    bridge, results = site.bridges[0], with_open_end(site)
    state = view_of_bridge(bridge, results, None)
    sound = view_of_bridge(
        bridge, results_of(site, some_crossing("z"), used="z", ratios=np.ones(7)), None
    )
    views = [view_of_crossing(one, bridge) for one in results.crossings]
    figures = {
        "bridge": draw_bridge(state),
        "change": draw_bridge(view_of_bridge(bridge, results, sound.estimate)),
        "crossing": draw_crossing(views[0], element_truth=None, road_truth=None),
        "crossings": draw_crossings(list(enumerate(views, start=1))),
    }
    for figure in figures.values():
        assert_words_apart(figure)
    return {name: figure.axes[0] for name, figure in figures.items()}


def test_unresolved_element_leaves_the_axis_to_the_others(site: Site) -> None:
    for name, axes in drawn_axes(site).items():
        top = axes.get_ylim()[1]
        assert top < 2.6 * 15.6, name  # of nominal; 102 before
        drawn = arrows(axes)
        assert drawn, name
        assert all(np.max(arrow.get_ydata()) < top for arrow in drawn), name
        assert legend(axes)[-1] == "beyond the axis", name
        assert legend(axes).count("beyond the axis") == 1, name


def test_legend_with_arrows_is_no_wider_than_its_panel(site: Site) -> None:
    for name, axes in drawn_axes(site).items():
        drawn = axes.get_legend()
        assert drawn is not None
        room = axes.get_window_extent().width
        assert drawn.get_window_extent().width <= 1.02 * room, name


def test_legend_with_the_truth_lies_on_no_title(site: Site) -> None:
    view = view_of_crossing(with_open_end(site).crossings[0], site.bridges[0])
    chainage_m = np.linspace(-5.0, 40.0, 100)
    truth = (chainage_m, 1e-3 * np.sin(chainage_m))
    figure = draw_crossing(view, element_truth=[1.0] * 7, road_truth=truth)
    assert_words_apart(figure)
    for axes in figure.axes[:3]:
        drawn = axes.get_legend()
        assert drawn is not None
        (title,) = (t for t in axes.findobj(Text) if t.get_text() == axes.get_title("left"))
        assert drawn.get_window_extent().x0 > title.get_window_extent().x1, title.get_text()
        assert float(drawn.get_texts()[0].get_fontsize()) > 8.0


def test_bridge_of_resolved_elements_has_no_arrow(site: Site) -> None:
    view = view_of_bridge(site.bridges[0], results_of(site, some_crossing("a"), used="a"), None)
    axes = draw_bridge(view).axes[0]
    assert not arrows(axes)
    assert "beyond the axis" not in legend(axes)


def test_names_of_elements_lie_on_no_interval(site: Site) -> None:
    for figure, axes in drawn_axes(site).items():
        names = [text for text in axes.texts if text.get_text().startswith("$EI")]
        assert len(names) == 7
        points = interval_points(axes)
        for text in names:
            box = text.get_window_extent()
            assert not any(box.contains(*point) for point in points), (figure, text.get_text())
            assert box.y1 <= axes.get_window_extent().y1


def with_suspect(site: Site) -> BridgeView:
    kinds: tuple[dict[str, Any], ...] = (
        {},
        {"verdict": "suspect", "reasons": ("position_outage",)},
    )
    crossings = (some_crossing(f"c{n}", entry=n * 600.0, **kind) for n, kind in enumerate(kinds))
    view = view_of_bridge(site.bridges[0], results_of(site, *crossings, used="c0"), None)
    first, second = view.crossings
    assert second.rigidity_nm2 is not None
    return view._replace(crossings=(first, second._replace(rigidity_nm2=1.2 * second.rigidity_nm2)))


def test_labels_stay_at_their_interval_below_a_suspect_crossing(site: Site) -> None:
    view = with_suspect(site)
    axes = draw_bridge(view).axes[0]
    (suspect,) = (line for line in axes.lines if line.get_marker() == "D")
    heights = axes.transData.transform(suspect.get_xydata())
    loss = next(text for text in axes.texts if "less" in text.get_text())
    values = [text for text in axes.texts if text.get_text()[:2] in ("0.", "1.")]
    assert len(values) == 7
    for text, (x, y) in [*zip(values, heights, strict=True), (loss, heights[3])]:
        box = text.get_window_extent()
        # It stands lower than the diamond, or to the right of it, not on top of it.
        assert box.y1 < y or box.x0 > x + 3.0, text.get_text()
        assert box.y0 < y + 20.0, text.get_text()


def test_far_suspect_crossing_leaves_the_axis_to_the_others(site: Site) -> None:
    view = with_suspect(site)
    used, suspect = view.crossings
    assert suspect.rigidity_nm2 is not None
    far = suspect.rigidity_nm2 * np.array([1.0, 1.0, 1.0, 1.0, 12.0, 1.0, 1.0])
    axes = draw_bridge(view._replace(crossings=(used, suspect._replace(rigidity_nm2=far)))).axes[0]
    top = axes.get_ylim()[1]
    assert top < 2.6 * 15.6  # of nominal; 12 times as high before
    (diamonds,) = (line for line in axes.lines if line.get_marker() == "D")
    drawn = np.isfinite(np.asarray(diamonds.get_ydata(), dtype=float))
    (arrow,) = arrows(axes)
    assert drawn.tolist() == [n != 4 for n in range(7)]
    assert np.size(arrow.get_xdata()) == 1
    assert 4.0 < np.max(arrow.get_xdata()) / site.bridges[0].span_m * 7.0 < 5.0
    assert np.max(arrow.get_ydata()) < top


def test_no_change_is_written_at_an_unresolved_element(site: Site) -> None:
    axes = drawn_axes(site)["change"]
    changes = [text for text in axes.texts if text.get_text().endswith("%")]
    centres = [text.get_window_extent().x0 for text in changes]
    (last,) = (text.get_window_extent().x0 for text in axes.texts if "7" in text.get_text())
    assert len(changes) == 6
    assert max(centres) < last - 50.0


def test_suspect_crossing_has_one_sign_in_all_figures(site: Site) -> None:
    view = with_suspect(site)
    axes = draw_crossings(list(enumerate(view.crossings, start=1))).axes[0]
    dots = [line for line in axes.lines if line.get_marker() in ("o", "D")]
    assert [line.get_marker() for line in dots] == ["o", "D"]
    assert legend(axes) == ["No. 1", "No. 2, suspect"]
    many = [(n, view.crossings[n % 2]) for n in range(10)]
    assert legend(draw_crossings(many).axes[0]) == ["No. 0 to 9", "suspect crossing"]


@pytest.mark.parametrize("verdict", ["good", "suspect"])
def test_crossing_is_compared_with_the_baseline_like_its_bridge(site: Site, verdict: str) -> None:
    bridge, reasons = site.bridges[0], () if verdict == "good" else ("position_outage",)
    given = some_crossing("a", verdict=verdict, reasons=reasons)
    view = view_of_crossing(results_of(site, given).crossings[0], bridge)
    sound = view_of_bridge(
        bridge, results_of(site, some_crossing("z"), used="z", ratios=np.ones(7)), None
    )
    figure = draw_crossing(view, element_truth=None, road_truth=None, baseline=sound.estimate)
    axes = figure.axes[0]
    assert "numbers: change from the baseline" in axes.get_title("left")
    assert "baseline" in legend(axes)
    texts = [text.get_text() for text in axes.texts]
    assert "−60 %" in texts
    assert not any(text.endswith("less") for text in texts)
    written = "\n".join(text.get_text() for text in figure.texts)
    said = "Element 4 (12.9 to 17.1 m) is 60 % less stiff than the baseline" in written
    assert said == (verdict == "good")
    assert_words_apart(figure)
