"""The PNG of a crossing: what is drawn is what was found, and nothing is cut off or overlaps."""

import io
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.image import imread
from matplotlib.patches import Rectangle

from schemas.reasons import REASON_TEXTS, Reason
from services.common.errors import InputError
from services.common.language import ENGLISH
from services.viewer.crossing_view import (
    CrossingView,
    RoadView,
    comparison_of,
    describe_crossing,
)
from services.viewer.drawing import STYLE, finding_lines
from services.viewer.figure import crossing_figure, draw_crossing
from tests.unit.words import assert_words_apart, words

RATIOS = np.array([1.0, 0.98, 1.01, 0.4, 1.02, 1.0, 0.99])
NOMINAL_NM2 = 15.6e9
X_M = np.linspace(-4.0, 34.0, 400)
PROFILE_M = 3e-3 * np.sin(X_M)


def view(**changes: object) -> CrossingView:
    rigidity = RATIOS * NOMINAL_NM2
    crossing = CrossingView(
        crossing_id="truck-1-bridge-1-1790010001",
        vehicle="truck-1",
        bridge="bridge-1",
        forward=True,
        entry_time_s=1_790_010_001.0,
        exit_time_s=1_790_010_004.44,
        speed_m_per_s=10.0,
        method="least_squares",
        verdict="good",
        reasons=(),
        reason_texts=(),
        chi2_per_dof=1.0,
        element_edges_m=np.linspace(0.0, 30.0, 8),
        nominal_nm2=np.full(7, NOMINAL_NM2),
        rigidity_nm2=rigidity,
        interval_nm2=np.column_stack((0.9 * rigidity, 1.2 * rigidity)),
        road=RoadView(X_M, PROFILE_M + 2e-6, PROFILE_M),
        parameters=(),
    )
    return crossing._replace(**changes)


def draw(crossing: CrossingView, truth: bool = True) -> Figure:
    return draw_crossing(
        crossing,
        element_truth=[1, 1, 1, 0.4, 1, 1, 1] if truth else None,
        road_truth=(np.array([-10.0, 0.0, 30.0]), np.zeros(3)) if truth else None,
    )


@pytest.fixture(autouse=True)
def style():
    import matplotlib

    with matplotlib.rc_context(STYLE):
        yield


def bars(axes: Axes) -> list[Rectangle]:
    return [patch for container in axes.containers for patch in container.patches]


def labels(axes: Axes) -> set[str]:
    legend = axes.get_legend()
    return set() if legend is None else {text.get_text() for text in legend.get_texts()}


def test_bars_stand_on_their_elements_with_their_rigidity() -> None:
    edges = np.array([0.0, 3.0, 8.0, 12.0, 16.0, 20.0, 25.0, 30.0])
    rigidity = draw(view(element_edges_m=edges)).axes[0]
    drawn = bars(rigidity)
    assert [bar.get_height() for bar in drawn] == pytest.approx(RATIOS * 15.6)
    middles = [bar.get_x() + bar.get_width() / 2 for bar in drawn]
    assert middles == pytest.approx((edges[:-1] + edges[1:]) / 2)
    for bar, left, right in zip(drawn, edges, edges[1:], strict=False):
        assert left < bar.get_x() < bar.get_x() + bar.get_width() < right
        assert bar.get_width() > (right - left) / 2


def test_interval_truth_and_nominal_are_drawn_where_they_are() -> None:
    rigidity = draw(view()).axes[0]
    whiskers = next(c for c in rigidity.collections if c.get_label() == "95 % interval")
    ends = np.array([path.vertices[:, 1] for path in whiskers.get_paths()])
    assert ends == pytest.approx(np.column_stack((0.9 * RATIOS, 1.2 * RATIOS)) * 15.6)
    truth = next(line for line in rigidity.lines if line.get_label() == "truth")
    assert truth.get_ydata() == pytest.approx(np.array([1, 1, 1, 0.4, 1, 1, 1]) * 15.6)
    assert rigidity.get_ylim()[1] > 1.2 * 1.02 * 15.6  # nothing is cut off at the top
    assert rigidity.get_ylim()[0] == 0.0


def test_ratio_axis_agrees_with_the_axis_of_rigidity() -> None:
    figure = draw(view())
    rigidity, ratio = figure.axes[0], figure.axes[-1]
    assert ratio.get_ylabel() == "EI / nominal"
    assert np.array(rigidity.get_ylim()) == pytest.approx(np.array(ratio.get_ylim()) * 15.6)


def test_no_ratio_axis_where_the_elements_have_different_nominal_values() -> None:
    figure = draw(view(nominal_nm2=np.linspace(10e9, 20e9, 7)))
    assert not any(axes.get_ylabel() == "EI / nominal" for axes in figure.axes)


def test_truth_is_neither_drawn_nor_named_where_there_is_none() -> None:
    figure = draw(view(), truth=False)
    assert all("truth" not in label for axes in figure.axes for label in labels(axes))


def test_interval_without_a_noise_model_is_named_as_such() -> None:
    with_model, without = (
        labels(draw(view(reasons=reasons)).axes[0]) for reasons in ((), ("no_noise_model",))
    )
    assert "95 % interval" in with_model
    assert "95 % interval" not in without
    assert "interval (not valid)" in without


def test_rejected_crossing_shows_its_reason_and_no_number() -> None:
    reason = "The truck lacks one of the four accelerometers that the method needs."
    figure = draw(
        view(
            verdict="rejected",
            reasons=("channel_missing",),
            reason_texts=(reason,),
            rigidity_nm2=None,
            interval_nm2=None,
            road=None,
        ),
        truth=False,
    )
    assert bars(figure.axes[0]) == []
    written = [text.get_text() for text in words(figure)]
    assert any(reason in text for text in written)
    assert "verdict: rejected" in written
    advice = ENGLISH.advice[Reason.CHANNEL_MISSING]
    assert any(advice[:60] in text for text in written)
    assert not any(text.startswith("$EI") for text in written)


def test_explanation_of_a_rejection_hides_no_truth() -> None:
    why = [Reason.MODEL_MISFIT, Reason.NOT_CONVERGED, Reason.IMPLAUSIBLE_VEHICLE]
    rejected = view(
        verdict="rejected",
        reasons=tuple(why),
        reason_texts=tuple(REASON_TEXTS[one] for one in why),
        rigidity_nm2=None,
        interval_nm2=None,
        road=None,
    )
    figure = draw(rejected)
    assert_words_apart(figure)
    written = " ".join(" ".join(text.get_text() for text in words(figure)).split())
    for one in why:
        assert f"• {REASON_TEXTS[one]}" in written
        assert f"• {ENGLISH.remedy(one, rejected.method)}" in written
    rigidity, profiles = figure.axes[:2]
    truths = [line for axes in (rigidity, profiles) for line in axes.lines]
    truths = [line for line in truths if line.get_label() == "truth"]
    assert len(truths) == 2
    for line in truths:
        points = line.get_transform().transform(line.get_xydata())
        for text in words(figure):
            box = text.get_window_extent().padded(5.0)
            assert not any(box.contains(x, y) for x, y in points), text.get_text()
    for axes in (rigidity, profiles):
        panel = axes.get_window_extent()
        assert not any(panel.overlaps(text.get_window_extent()) for text in axes.texts)
    assert profiles.get_title("left") == "Road profile (none was estimated)"
    assert len(profiles.get_yticks()) > 2  # heights of the truth


def test_differences_are_between_wheels_and_from_the_truth_where_it_is_known() -> None:
    figure = draw(view())
    lines = {line.get_label(): line for line in figure.axes[2].lines}
    assert figure.axes[2].get_ylabel() == "mm"
    between = np.full(400, 2e-3)
    assert lines["front − rear"].get_ydata() == pytest.approx(between)
    assert lines["cubic trend: mostly drift"].get_ydata() == pytest.approx(between)
    error = np.asarray(lines["mean − truth, without offset, tilt and bend"].get_ydata())
    known = X_M <= 30.0  # the truth of this test ends there
    whole = PROFILE_M[known] * 1e3
    line = np.polyval(np.polyfit(X_M[known], whole, 1), X_M[known])
    assert error[known] == pytest.approx(whole - line)
    assert np.isnan(error[~known]).all()


@pytest.mark.parametrize(
    ("difference_m", "unit"), [(3e-3, "mm"), (3e-6, "µm"), (3e-9, "nm"), (0.0, "nm")]
)
def test_differences_have_a_unit_that_gives_readable_ticks(difference_m: float, unit: str) -> None:
    road = RoadView(X_M, PROFILE_M + difference_m, PROFILE_M)
    assert draw(view(road=road), truth=False).axes[2].get_ylabel() == unit


LONG = {
    "vehicle": "v" * 40,
    "bridge": "b" * 40,
    "verdict": "suspect",
    "reason_texts": ("A sentence that says at some length why this crossing is suspect.",) * 4,
}


@pytest.mark.parametrize("changes", [{}, {"reasons": ("no_noise_model",)}, LONG])
def test_all_words_stand_on_the_page_and_apart(changes: dict[str, object]) -> None:
    figure = draw(view(**changes))
    assert isinstance(figure.canvas, FigureCanvasAgg)
    assert_words_apart(figure)


def test_png_is_wide_enough_for_a_page_and_the_same_each_time(tmp_path: Path) -> None:
    pictures = [tmp_path / "one.png", tmp_path / "two.png"]
    for picture in pictures:
        crossing_figure(picture, crossing=view(), element_truth=None, road_truth=None)
    first, second = (picture.read_bytes() for picture in pictures)
    assert first == second
    height, width, _ = imread(io.BytesIO(first)).shape
    assert width == 1800
    assert 1000 < height < width


def test_nothing_is_left_behind_where_it_cannot_be_written(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="does not exist"):
        crossing_figure(
            tmp_path / "no" / "a.png", crossing=view(), element_truth=None, road_truth=None
        )
    assert list(tmp_path.iterdir()) == []


def test_pyplot_and_its_global_state_are_not_touched() -> None:
    code = "import sys, services.viewer.figure; sys.exit('matplotlib.pyplot' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_profiles_of_a_tandem_are_named_by_axle_number() -> None:
    figure = draw(view(first_axle=2), truth=False)
    written = {text.get_text() for text in words(figure)}
    assert {"profile of axle 2", "profile of axle 3", "axle 2 − axle 3"} < written
    assert not any("front" in text for text in written)
    of_two = {text.get_text() for text in words(draw(view()))}
    assert {"profile of the front wheel", "profile of the rear wheel", "front − rear"} < of_two


def test_whole_finding_is_written_next_to_a_good_verdict() -> None:
    crossing = view(method="pre")
    sentences = describe_crossing(crossing, comparison_of(crossing))
    assert len(sentences) > 2
    figure = draw(crossing)
    written = " ".join(" ".join(text.get_text() for text in words(figure)).split())
    assert " ".join(sentences) in written
    assert "…" not in written
    assert_words_apart(figure)


@pytest.mark.parametrize("length", range(60, 130))
def test_finding_is_wrapped_without_losing_a_word(length: int) -> None:
    first = "x" * (length - 30) + " (95 % interval 59 to 61 %)."
    lines = finding_lines([first, "b", "c"])
    assert " ".join(lines) == f"{first} b c"
    assert max(map(len, lines)) <= 108
    assert not any(line.startswith("%") for line in lines)


def test_finding_of_many_elements_ends_with_a_whole_sentence_and_a_note() -> None:
    every = [f"Element {n}: {'x' * 60} (95 % interval 59 to 61 %)." for n in range(1, 21)]
    lines = finding_lines(every)
    assert len(lines) == 6
    text = " ".join(lines)
    shown = text.count("Element")
    assert text == " ".join([*every[:shown], f"(and {20 - shown} more sentences)"])
