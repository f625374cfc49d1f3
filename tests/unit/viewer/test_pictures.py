"""Pictures of bridges, of doubtful and of rejected crossings; `identify --figures`."""

import re
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import pytest
from matplotlib.collections import LineCollection
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.image import imread
from matplotlib.patches import Rectangle

from schemas.results import CrossingResult, Results, results_json
from schemas.site import Site
from services.cli import main as cli
from services.common.language import ENGLISH, language_of
from services.report.style import style_sheet
from services.viewer.bridge_figure import _heading, draw_bridge
from services.viewer.bridge_view import BridgeView, view_of_bridge
from services.viewer.crossing_view import comparison_of, view_of_crossing
from services.viewer.crossings_figure import draw_crossings
from services.viewer.drawing import STYLE
from services.viewer.figure import draw_crossing
from services.viewer.panels.verdict import verdict_markdown
from services.viewer.pictures import write_pictures
from services.viewer.rerun_parts import MUTED, ratio_colours, rgb
from tests.unit.viewer.found import results_of, some_crossing
from tests.unit.words import assert_words_apart, words


@pytest.fixture(autouse=True)
def style() -> Any:
    with matplotlib.rc_context(STYLE):
        yield


def bars(figure: Figure) -> list[Rectangle]:
    return [patch for container in figure.axes[0].containers for patch in container.patches]


def written(figure: Figure) -> str:
    return "\n".join(text.get_text() for text in words(figure))


def bridge_of(site: Site, *crossings: dict[str, Any], used: str | None = None) -> BridgeView:
    return view_of_bridge(site.bridges[0], results_of(site, *crossings, used=used), None)


def luminance(colour: Any) -> float:
    return float(np.dot(to_rgb(colour), (0.299, 0.587, 0.114)))


def test_the_weak_element_stands_out_also_in_grey(site: Site) -> None:
    figure = draw_bridge(bridge_of(site, some_crossing("a"), used="a"))
    drawn = bars(figure)
    grey = [luminance(bar.get_facecolor()) for bar in drawn]
    assert all(grey[3] < other - 0.15 for n, other in enumerate(grey) if n != 3)
    assert drawn[3].get_linewidth() > drawn[0].get_linewidth()
    assert not any(bar.get_hatch() for bar in drawn)
    text = written(figure)
    assert "60 % less" in text
    assert "Element 4 (12.9 to 17.1 m) is 60 % less stiff than the other elements" in text
    assert_words_apart(figure)


def test_what_is_doubtful_looks_doubtful(site: Site) -> None:
    doubtful = some_crossing("a", verdict="suspect", reasons=("position_outage",))
    for figure in (
        draw_bridge(bridge_of(site, doubtful, used="a")),
        draw_crossing(
            view_of_crossing(results_of(site, doubtful).crossings[0], site.bridges[0]),
            element_truth=None,
            road_truth=None,
        ),
    ):
        assert all(bar.get_hatch() for bar in bars(figure))
        assert len({bar.get_facecolor() for bar in bars(figure)}) == 1  # none is called weak
        red, green, blue = to_rgb(bars(figure)[0].get_facecolor())
        assert red == green == blue
        assert "doubtful" in written(figure).lower()
        assert "The receiver reported no position" in written(figure)
        assert_words_apart(figure)


def test_all_reasons_of_a_suspect_crossing_can_be_read(site: Site) -> None:
    why = ("position_outage", "residuals_coloured", "implausible_bridge")
    doubtful = some_crossing("a", verdict="suspect", reasons=why)
    crossing = results_of(site, doubtful).crossings[0]
    view = view_of_crossing(crossing, site.bridges[0])
    for figure in (
        draw_crossing(view, element_truth=None, road_truth=None),
        draw_bridge(bridge_of(site, doubtful, some_crossing("b"), used="b")),
    ):
        text = " ".join(written(figure).split())
        for sentence in crossing.reason_texts:
            assert sentence in text
        assert "…" not in text
        assert_words_apart(figure)


def test_a_rejected_crossing_says_why_and_shows_no_empty_panel(site: Site) -> None:
    why = ("model_misfit", "not_converged", "implausible_vehicle")
    crossing = results_of(site, some_crossing("a", verdict="rejected", reasons=why)).crossings[0]
    figure = draw_crossing(
        view_of_crossing(crossing, site.bridges[0]), element_truth=None, road_truth=None
    )
    assert bars(figure) == []
    text = written(figure)
    assert "verdict: rejected" in text
    for sentence in crossing.reason_texts:
        assert f"• {sentence}" in text
    assert "Road profile" not in text
    assert_words_apart(figure)


def test_a_bridge_that_nothing_is_known_of_says_why(site: Site) -> None:
    rejected = [
        some_crossing(name, verdict="rejected", reasons=("speed_too_low",)) for name in "abc"
    ]
    figure = draw_bridge(bridge_of(site, *rejected))
    text = written(figure)
    assert bars(figure) == []
    assert "No finding: none of 3 crossings could be used." in text
    assert "• The truck was so slow" in text
    assert_words_apart(figure)


def test_all_crossings_are_listed_and_drawn_with_their_verdict(site: Site) -> None:
    many = [some_crossing(f"c{n}", entry=n * 86400.0) for n in range(20)]
    many[3] |= {"verdict": "suspect", "reasons": ["position_outage"]}
    view = bridge_of(site, *many, used="c19")
    figure = draw_bridge(view)
    text = written(figure)
    assert "… and 8 earlier" in text
    assert text.count("good, used") == 1
    labels = {t.get_text() for t in figure.axes[0].get_legend().get_texts()}
    assert {"good crossing", "suspect crossing"} <= labels
    assert_words_apart(figure)


def test_no_label_hides_a_single_crossing(site: Site) -> None:
    """Plates of values and losses stood over the dots of the crossings beside the interval."""
    view = bridge_of(
        site, *(some_crossing(f"c{n}", entry=n * 86400.0) for n in range(4)), used="c3"
    )
    high = [c._replace(rigidity_nm2=1.5 * c.rigidity_nm2) for c in view.crossings]
    axes = draw_bridge(view._replace(crossings=tuple(high))).axes[0]
    dots = [line for line in axes.lines if line.get_marker() == "o"]
    assert len(dots) == 4
    assert min(d.get_zorder() for d in dots) > max(t.get_zorder() for t in axes.texts)
    (loss,) = (text for text in axes.texts if "less" in text.get_text())
    box = loss.get_window_extent().expanded(1.1, 1.3)
    places = np.concatenate([axes.transData.transform(d.get_xydata()) for d in dots])
    assert not np.any([box.contains(*place) for place in places])
    # Of the four good crossings one is in the numbers.
    assert [to_rgb(d.get_markerfacecolor()) == (1.0, 1.0, 1.0) for d in dots] == [True] * 3 + [
        False
    ]
    labels = [t.get_text() for t in axes.get_legend().get_texts()]
    assert {"good, not used", "good crossing"} <= set(labels)
    text = written(draw_bridge(view))
    assert [text.count(sign) for sign in "●○"] == [1, 3]


def test_no_label_below_an_interval_hides_a_single_crossing(site: Site) -> None:
    crossings = (some_crossing(f"c{n}", entry=n * 86400.0) for n in range(4))
    view = bridge_of(site, *crossings, used="c3")
    assert view.estimate is not None
    low = [c._replace(rigidity_nm2=0.9 * view.estimate.low) for c in view.crossings]
    axes = draw_bridge(view._replace(crossings=tuple(low))).axes[0]
    dots = [line for line in axes.lines if line.get_marker() == "o"]
    places = np.concatenate([axes.transData.transform(d.get_xydata()) for d in dots])
    numbers = [t for t in axes.texts if re.fullmatch(r"\d\.\d{3}", t.get_text())]
    assert len(numbers) == 7
    for text in numbers:
        box = text.get_window_extent().expanded(1.2, 1.2)
        assert not np.any([box.contains(*place) for place in places]), text.get_text()


def test_a_long_legend_stays_on_the_page(site: Site) -> None:
    german = language_of("de")
    kinds = ({}, {}, {"verdict": "suspect", "reasons": ("position_outage",)})
    crossings = (some_crossing(f"c{n}", entry=n * 86400.0, **k) for n, k in enumerate(kinds))
    view = bridge_of(site, *crossings, used="c0")
    view = view._replace(baseline=view.estimate, is_doubtful=False)
    figure = draw_bridge(view, with_heading=False, language=german)
    legend = figure.axes[0].get_legend()
    assert len(legend.get_texts()) > 6
    assert legend.get_window_extent().x0 >= 0.0


@pytest.mark.parametrize("name", ["x" * 60, "A 13 / <b>bridge</b> over $\\frac$ \\river"])
def test_long_and_strange_names_of_an_owner_stand_on_the_page(site: Site, name: str) -> None:
    view = bridge_of(site, some_crossing("a"), used="a")._replace(owner_id=name)
    assert_words_apart(draw_bridge(view))


def test_pictures_are_written_in_both_forms_the_same_each_time(site: Site, tmp_path: Path) -> None:
    results = results_of(site, some_crossing("../a b"), used="../a b")
    first = write_pictures(tmp_path / "one" / "new", results, site)
    second = write_pictures(tmp_path / "two", results, site)
    assert [path.name for path in first] == ["-a-b.png", "-a-b.svg", "bridge-1.png", "bridge-1.svg"]
    assert [p.read_bytes() for p in first] == [p.read_bytes() for p in second]
    assert {path.parent for path in first} == {tmp_path / "one" / "new"}
    assert imread(first[0]).shape[1] == 1800
    svg = first[1].read_text()
    assert svg.startswith("<?xml")
    assert "http://" not in re.sub(r'(xmlns\S*|"-//W3C\S*|"http://www.w3.org\S*)', "", svg)


def test_identify_draws_what_it_found(
    tmp_path: Path, project: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recording, folder = project / "tests/data/noise_free.mcap", tmp_path / "pictures"
    options = ("--method", "least-squares", "--figures", str(folder))
    assert cli.main(["identify", str(recording), *options]) == 0
    assert f"4 figures in {folder}" in capsys.readouterr().out
    assert len(list(folder.iterdir())) == 4
    (tmp_path / "file").touch()
    code = cli.main(["identify", str(recording), "--figures", str(tmp_path / "file" / "x")])
    assert code == 2
    assert "is a file" in capsys.readouterr().err


def test_identify_draws_the_baseline_that_it_compares_with(
    tmp_path: Path, site: Site, project: Path
) -> None:
    recording, folder = project / "tests/data/noise_free.mcap", tmp_path / "pictures"
    then = tmp_path / "then.json"
    then.write_text(results_json(results_of(site, some_crossing("a"), used="a")))
    options = ("--method", "least-squares", "--figures", str(folder))
    command = ["identify", str(recording), *options, "--baseline", str(then)]
    assert cli.main(command) == 0
    svg = (folder / "bridge-1.svg").read_text()
    assert "<!-- baseline -->" in svg
    assert "<!-- Flexural rigidity EI (numbers: change from the baseline) -->" in svg


def test_picture_of_a_crossing_shows_the_baseline_of_its_bridge(site: Site, tmp_path: Path) -> None:
    results = results_of(site, some_crossing("a"), used="a")
    write_pictures(tmp_path, results, site, baselines=results.bridges)
    title = "<!-- Flexural rigidity EI (numbers: change from the baseline) -->"
    assert title in (tmp_path / "a.svg").read_text()


def test_picture_names_an_element_that_was_weak_in_its_baseline(site: Site) -> None:
    results = results_of(site, some_crossing("a"), used="a")
    alone = view_of_bridge(site.bridges[0], results, None)
    words = "Element 4 (60 %, 95 % interval"
    assert not any(words in line for line in _heading(alone))
    lines = _heading(view_of_bridge(site.bridges[0], results, alone.estimate))
    text = " ".join(lines)
    assert words in text
    assert "was already clearly less stiff than the others in the baseline" in text
    assert not any(line.startswith("%") for line in lines)


def test_results_of_a_bridge_without_its_state_are_drawn(site: Site) -> None:
    results = results_of(site, some_crossing("a"))
    assert isinstance(results, Results)
    assert view_of_bridge(site.bridges[0], results, None).estimate is None


def test_a_good_crossing_says_what_is_weak_and_by_how_much(site: Site) -> None:
    view = view_of_crossing(results_of(site, some_crossing("a")).crossings[0], site.bridges[0])
    figure = draw_crossing(view, element_truth=None, road_truth=None)
    text = written(figure)
    assert "60 % less" in text
    assert "from one crossing alone (not fused)" in text
    assert "Element 4 (12.9 to 17.1 m) is 60 % less stiff than the other elements" in text
    assert_words_apart(figure)
    sound = results_of(site, some_crossing("a"), ratios=np.ones(7)).crossings[0]
    output = written(
        draw_crossing(view_of_crossing(sound, site.bridges[0]), element_truth=None, road_truth=None)
    )
    assert "% less" not in output
    assert ENGLISH.text("all.others", within=1) in output


def test_what_is_not_resolved_is_an_empty_bar_and_agrees_with_nothing(site: Site) -> None:
    crossing = results_of(site, some_crossing("a")).crossings[0]
    wide = crossing.model_dump(mode="json")
    for n in (1, 7):
        wide["parameters"][f"EI_{n}"] |= {"std": 0.5 * wide["parameters"][f"EI_{n}"]["mean"]}
    level = {"unit": "1", "mean": 0.97, "std": 0.1, "q025": 0.8, "q50": 0.97, "q975": 1.2}
    wide["derived"] |= {"ei_level": level}
    view = view_of_crossing(CrossingResult.model_validate(wide), site.bridges[0])
    assert view.unresolved == {1, 7}
    figure = draw_crossing(view, element_truth=None, road_truth=None)
    empty = [to_rgb(bar.get_facecolor()) == (1.0, 1.0, 1.0) for bar in bars(figure)]
    assert empty == [True, False, False, False, False, False, True]
    assert "not resolved" in written(figure)
    spread_out = view._replace(reasons=(), rigidity_nm2=np.array(view.nominal_nm2))
    line = written(draw_crossing(spread_out, element_truth=None, road_truth=None))
    assert "Overall stiffness / nominal 0.97 ± 10 %, 2 of 7 elements not resolved." in line
    assert "60 % less stiff" in written(figure)
    assert "clearly" not in verdict_markdown(view, comparison_of(view))
    assert "2 of 7 elements not resolved" in verdict_markdown(view, comparison_of(view))
    ratios = view.resolved_ratio
    assert ratios is not None
    colours = ratio_colours(ratios, 7, doubtful=False)
    assert colours[0] == colours[6] == rgb(MUTED)
    assert colours[1] != rgb(MUTED)


def wide_state(site: Site, *crossings: dict[str, Any]) -> Results:
    """A state and crossings as of twin tyres: all but one element reach to 2.4 times nominal."""
    found = results_of(site, *crossings, used="a").model_dump(mode="json")
    nominal = site.bridges[0].nominal_flexural_rigidity_nm2[0]
    for n in range(1, 8):
        wide = {"mean": 1.1 * nominal, "std": 0.5 * nominal, "q025": 0.3 * nominal}
        wide["q975"] = (2.0 + 0.13 * (n % 4)) * nominal
        if n == 4:
            wide = {"mean": 0.4 * nominal, "std": 0.02 * nominal}
            wide |= {"q025": 0.36 * nominal, "q975": 0.44 * nominal}
        found["bridges"][site.bridges[0].id][f"EI_{n}"] |= wide
        for crossing in found["crossings"]:
            crossing["parameters"][f"EI_{n}"] |= wide
    level = {"unit": "1", "mean": 0.97, "std": 0.1, "q025": 0.8, "q50": 0.97, "q975": 1.2}
    for crossing in found["crossings"]:
        crossing["derived"] |= {"ei_level": level}
    return Results.model_validate(found)


@pytest.mark.parametrize("code", ["en", "de"])
@pytest.mark.parametrize("with_heading", [True, False])
def test_values_above_long_intervals_keep_off_title_and_legend(
    site: Site, code: str, with_heading: bool
) -> None:
    results = wide_state(site, some_crossing("a"), some_crossing("b", entry=60.0))
    view = view_of_bridge(site.bridges[0], results, None)
    figure = draw_bridge(view, with_heading=with_heading, language=language_of(code))
    assert_words_apart(figure)
    axes = figure.axes[0]
    top = axes.get_window_extent().y1
    values = [text for text in axes.texts if text.get_text()[:1].isdigit()]
    assert len(values) == 8
    assert all(text.get_window_extent().y1 <= top for text in values)


@pytest.mark.parametrize("code", ["en", "de"])
def test_report_letters_pictures_in_7_points_on_paper(site: Site, code: str) -> None:
    """Pictures are as wide as the text: A4 less both margins."""
    language, sheet = language_of(code), style_sheet(language_of(code)).partition("@media print")
    assert "@page { size: A4; margin: 8mm 15mm 11mm;" in sheet[0]
    narrowed = [line for line in sheet[2].splitlines() if "svg" in line]
    assert narrowed == ["  .past figure svg { max-height: 175mm; }"]
    results = results_of(site, some_crossing("a"), some_crossing("b", entry=60.0), used="a")
    bridge = site.bridges[0]
    baseline = view_of_bridge(bridge, results, None).estimate
    views = [(n, view_of_crossing(one, bridge)) for n, one in enumerate(results.crossings)]
    for figure in (
        draw_bridge(
            view_of_bridge(bridge, results, baseline), with_heading=False, language=language
        ),
        draw_crossings(views, language),
    ):
        points_per_point = (210.0 - 2.0 * 15.0) / (25.4 * figure.get_figwidth())
        assert min(text.get_fontsize() for text in words(figure)) * points_per_point > 7.0


def test_values_above_long_intervals_of_one_crossing_keep_off_the_title(site: Site) -> None:
    crossing = wide_state(site, some_crossing("a")).crossings[0]
    view = view_of_crossing(crossing, site.bridges[0])
    figure = draw_crossing(view, element_truth=None, road_truth=None)
    assert_words_apart(figure)
    top = figure.axes[0].get_window_extent().y1
    values = [text for text in figure.axes[0].texts if text.get_text()[:1].isdigit()]
    assert len(values) == 8
    assert all(text.get_window_extent().y1 <= top for text in values)


def test_no_interval_of_a_crossing_is_cut(site: Site) -> None:
    results = wide_state(site, some_crossing("a"), some_crossing("b", entry=60.0))
    views = [(n, view_of_crossing(one, site.bridges[0])) for n, one in enumerate(results.crossings)]
    assert views[0][1].unresolved
    figure = draw_crossings(views)
    ends = [
        point[1]
        for lines in figure.axes[0].collections
        if isinstance(lines, LineCollection)
        for segment in lines.get_segments()
        for point in segment
    ]
    low, high = figure.axes[0].get_ylim()
    assert len(ends) == 2 * 2 * 7
    assert low < min(ends) < max(ends) < high
    assert_words_apart(figure)


def test_dots_of_single_crossings_have_their_values(site: Site) -> None:
    """They are written in the list, each below its element."""
    rejected = some_crossing("c", verdict="rejected", reasons=("channel_missing",), entry=180.0)
    crossings = (some_crossing("a"), some_crossing("b", entry=90.0), rejected)
    figure = draw_bridge(bridge_of(site, *crossings, used="a"))
    figure.draw_without_rendering()
    values = [text for text in figure.texts if re.fullmatch(r"\d\.\d{3}", text.get_text())]
    expected = ["1.000", "0.980", "1.010", "0.400", "1.020", "1.000", "0.990"]
    assert [text.get_text() for text in values] == 2 * expected
    (axes, *_) = figure.axes
    edges_m = np.linspace(0.0, 30.0, 8)
    for text, centre_m in zip(
        values, 2 * (0.5 * (edges_m[1:] + edges_m[:-1])).tolist(), strict=True
    ):
        box = text.get_window_extent()
        at = axes.transData.transform((centre_m, 0.0))[0]
        assert 0.5 * (box.x0 + box.x1) == pytest.approx(at, abs=1.0)
    assert_words_apart(figure)
    alone = draw_bridge(bridge_of(site, some_crossing("a"), used="a"))
    labels = [text.get_text() for text in alone.texts]
    assert "EI / nominal" not in labels
