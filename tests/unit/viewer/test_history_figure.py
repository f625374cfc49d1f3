"""The picture of a bridge's past: what is in its panels, and what its head says."""

import matplotlib
import numpy as np
import pytest

from services.common.language import language_of
from services.history.bridge_history import Statement, StoredBaseline
from services.viewer.crossing_view import VERDICT_COLOURS
from services.viewer.drawing import STYLE
from services.viewer.history_figure import AlarmMark, HistoryView, PeriodPoint, draw_history
from tests.unit.words import assert_words_apart, words

WEEK_S = 7 * 86_400.0
BEGIN_S = 1.7364e9


def weeks(*ratios: float) -> tuple[PeriodPoint, ...]:
    """Of two elements; that of the second one is given, the other stays."""
    return tuple(
        PeriodPoint(
            BEGIN_S + number * WEEK_S,
            (16e9, 16e9 * ratio),
            (15.5e9, 15.5e9 * ratio),
            (16.5e9, 16.5e9 * ratio),
            "good",
            None,
        )
        for number, ratio in enumerate(ratios)
    )


def mark(acknowledged: str = "", note: str = "") -> AlarmMark:
    since_s = BEGIN_S + 150 * WEEK_S
    return AlarmMark(
        2, False, since_s, since_s + 3 * WEEK_S, "element 2 is weaker", acknowledged, note
    )


def drawn(history: HistoryView) -> matplotlib.figure.Figure:
    with matplotlib.rc_context(STYLE):
        return draw_history(history)


def test_the_newest_estimate_is_in_its_panel_however_few_are_like_it() -> None:
    """A loss of a third in the last of three years' weeks, which is less than one in a hundred."""
    figure = drawn(HistoryView("bridge-1", "week", weeks(*[1.0] * 150, 0.66), (), ()))
    _, second = figure.axes[:2]
    (points,) = [line for line in second.lines if line.get_marker() == "o"]
    low, high = second.get_ylim()
    shown = np.asarray(points.get_ydata(), dtype=float)
    assert shown.min() < 67.0
    assert low < shown.min() < shown.max() < high


def percents(history: HistoryView, element: int) -> list[float]:
    """Return the drawn values of an element's good periods."""
    axes = drawn(history).axes[element - 1]
    points, *_ = [line for line in axes.lines if line.get_marker() == "o"]
    return [round(float(value), 6) for value in np.asarray(points.get_ydata())]


def test_loss_in_most_periods_is_a_loss_and_not_an_early_gain() -> None:
    history = HistoryView("b-1", "week", weeks(1.0, 0.8, 0.8, 0.8, 0.8), (), ())
    assert percents(history, 2) == [100.0, 80.0, 80.0, 80.0, 80.0]
    texts = [text.get_text() for text in drawn(history).texts]
    assert "100 %: EI of each element in the first week with a usable result, 2025-01-06" in texts
    beside = [text.get_text() for text in drawn(history).axes[1].texts]
    assert "100 %:\n2025-01-06\n16.0 GN·m²" in beside


def test_reference_is_the_first_good_period_of_the_same_elements() -> None:
    points = list(weeks(0.5, 0.6, 1.0, 0.9))
    points[0] = points[0]._replace(verdict="suspect")
    points[1] = points[1]._replace(mean=(9e9,), low=(8e9,), high=(10e9,))
    history = HistoryView("b-1", "week", tuple(points), (), ())
    assert percents(history, 2) == [100.0, 90.0]
    assert history.reference(0).name == "2025-01-20"
    doubtful = tuple(point._replace(verdict="suspect") for point in points[2:])
    assert history._replace(points=doubtful).reference(1).ei_nm2 == 16e9


def test_element_that_was_weak_from_the_beginning_is_named() -> None:
    low = weeks(0.5, 0.5)
    sentence = (
        "EI_2: already below 75 % of the elements' median in this reference; an earlier loss is "
        "not shown here"
    )
    for points, is_named in ((low, True), (weeks(0.9, 0.5), False)):
        texts = [text.get_text() for text in drawn(HistoryView("b", "week", points, (), ())).texts]
        assert (sentence in texts) is is_named


def test_baseline_is_the_reference_if_its_elements_are_those() -> None:
    baseline = StoredBaseline("then.json", (16e9, 20e9))
    history = HistoryView("b-1", "week", weeks(1.0, 0.8), (), (), baseline)
    assert percents(history, 2) == [80.0, 64.0]
    figure = drawn(history)
    texts = [text.get_text() for text in figure.texts]
    assert "100 %: EI of each element in the baseline then.json" in texts
    assert "100 %:\nbaseline\n20.0 GN·m²" in [text.get_text() for text in figure.axes[1].texts]
    other = history._replace(baseline=StoredBaseline("then.json", (16e9,) * 3))
    assert percents(other, 2) == [100.0, 80.0]


def test_the_head_says_what_to_do_while_an_alarm_stands() -> None:
    points = weeks(*[1.0] * 150, 0.9, 0.9, 0.9)
    output = [
        text.get_text() for text in drawn(HistoryView("b-1", "week", points, (mark(),), ())).texts
    ]
    assert "ALARM: element 2 is weaker" in output
    assert (
        "Inspect the bridge, then acknowledge the alarm: driveby alarm ack b-1 --by NAME "
        "--note TEXT" in output
    )
    noted = mark("the owner, 2025-06-23", "props were put in")
    output = [
        text.get_text() for text in drawn(HistoryView("b-1", "week", points, (noted,), ())).texts
    ]
    assert "acknowledged: element 2 is weaker (the owner, 2025-06-23)" in output
    assert "“props were put in”" in output
    assert not any("driveby" in text for text in output)
    long = mark("the owner, 2025-06-23", "x" * 500)
    output = [
        text.get_text() for text in drawn(HistoryView("b-1", "week", points, (long,), ())).texts
    ]
    assert max(map(len, output)) < 110


def test_the_head_is_green_only_where_a_watch_found_nothing() -> None:
    points = weeks(1.0, 0.8)
    for is_reassuring in (True, False):
        long = " ".join(["not watched"] * 20)
        output = (Statement(long, is_reassuring),)
        texts = drawn(HistoryView("b-1", "week", points, (), output)).texts
        about = [text for text in texts if "not watched" in text.get_text()]
        assert len(about) == 3
        assert " ".join(text.get_text() for text in about) == long
        green = VERDICT_COLOURS["good"]
        assert {text.get_color() == green for text in about} == {is_reassuring}
    texts = drawn(HistoryView("b-1", "week", points, (), ())).texts
    assert not any(text.get_color() == VERDICT_COLOURS["good"] for text in texts)


def test_every_good_interval_is_within_its_panel() -> None:
    wide = weeks(*[1.0] * 150)
    widest = wide[-1]._replace(low=(12e9, 15e9), high=(24e9, 17e9))
    figure = drawn(HistoryView("b-1", "week", (*wide[:-1], widest), (), ()))
    for axes in figure.axes[:2]:
        low, high = axes.get_ylim()
        assert low < 75.0
        assert high > 150.0
        figure.canvas.draw()
        assert len([tick for tick in axes.get_yticks() if low <= tick <= high]) >= 3


def test_one_month_is_shown_as_a_month_not_as_a_day_of_it() -> None:
    (first, _) = drawn(HistoryView("b-1", "month", weeks(1.0), (), ())).axes
    begin, end = first.get_xlim()
    assert 60.0 < end - begin < 90.0


def test_one_week_is_shown_over_weeks_not_years() -> None:
    (first, _) = drawn(HistoryView("b-1", "week", weeks(1.0), (), ())).axes
    begin, end = first.get_xlim()
    assert end - begin < 20.0


@pytest.mark.parametrize("code", ["en", "de"])
def test_letters_are_seven_points_in_a_column_and_apart(code: str) -> None:
    """A report's column is 180 mm wide."""
    points = tuple(
        one._replace(temperature_deg_c=10.0 + n)
        for n, one in enumerate(weeks(1.0, 0.98, 1.02, 0.97, 0.95, 0.99, 0.9))
    )
    marks = tuple(
        mark("the owner, 2025-06-23")._replace(
            element=element,
            since_s=BEGIN_S + since * WEEK_S,
            raised_s=BEGIN_S + (since + 0.5) * WEEK_S,
        )
        for element, since in ((1, 0.5), (2, 5.0))
    )
    for baseline in (None, StoredBaseline("then.json", (160e9, 200e9))):
        view = HistoryView("b-1", "week", points, marks, (), baseline)
        with matplotlib.rc_context(STYLE):
            figure = draw_history(view, with_heading=False, language=language_of(code))
        assert_words_apart(figure)
        scale = 180.0 / (25.4 * figure.get_figwidth())
        assert min(float(text.get_fontsize()) for text in words(figure)) * scale >= 7.0
    assert any("\n160 GN·m²" in text.get_text() for text in words(figure))
