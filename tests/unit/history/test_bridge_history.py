"""A bridge's past: fused when crossings are added, on a page of a report, and in the viewer."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from schemas.alarms import Acknowledgement, Alarm
from schemas.results import ElementState, Results, results_json
from services.cli import main as cli
from services.history.bridge_history import (
    BridgeHistory,
    StoredBaseline,
    bridge_history,
    statements,
)
from services.history.history_store import add_results
from services.identification.bridge_state import RecentCrossings, add_crossings, state_of, usable
from services.report.history_section import history_section, history_summary
from services.viewer.history_figure import history_view
from services.viewer.rerun_history import write_history
from tests.fleet import bridge_of, crossing_of, results_of, templates, trucks_of
from tests.unit.history.test_history_store import BEGIN_S, crossings
from tests.unit.report.test_report import Seen
from tests.viewer_screen import open_tab, opened, picture, pixels
from tests.waiting import LONGEST_S

DAY_S = 86_400.0


def fused(folder: Path) -> list[Path]:
    return sorted((folder / "fused").rglob("*.json"))


def added(folder: Path, results: Results, *options: str) -> None:
    found = folder / "results.json"
    found.write_text(results_json(results))
    words = ["history", "add", str(found), "--history", str(folder / "history"), *options]
    assert cli.main(words) == 0


def part(results: Results, first: int, last: int) -> Results:
    return results.model_copy(update={"crossings": results.crossings[first:last]})


def test_adding_crossings_fuses_and_reading_does_not(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    # From 2 March on, a day apart: thirty in March, some in April.
    some, history = crossings(34), tmp_path / "history"
    added(tmp_path, part(some, 0, 20))
    (march,) = fused(history)
    added(tmp_path, part(some, 20, 25))
    both = fused(history)
    assert len(both) == 2  # of March with 20 and with 25 crossings
    assert march in both
    added(tmp_path, part(some, 30, 34))
    assert len(fused(history)) == 3
    assert set(both) < set(fused(history))  # April alone is new
    before = {path: path.read_bytes() for path in fused(history)}
    capsys.readouterr()
    assert cli.main(["history", "bridge-1", "--history", str(history)]) == 0
    assert "29 crossings in 2 months" in capsys.readouterr().out
    assert {path: path.read_bytes() for path in fused(history)} == before


def test_later_postpones_fusion_to_first_view(tmp_path: Path) -> None:
    history = tmp_path / "history"
    added(tmp_path, crossings(3), "--later")
    assert fused(history) == []
    assert cli.main(["history", "bridge-1", "--history", str(history)]) == 0
    looked = [path.read_bytes() for path in fused(history)]
    other = tmp_path / "other"
    other.mkdir()
    added(other, crossings(3))
    assert [path.read_bytes() for path in fused(other / "history")] == looked


def alarm() -> Alarm:
    return Alarm(
        alarm_id="20260310-4-weaker",
        realm="sim-fleet",
        bridge="bridge-1",
        element=4,
        direction="weaker",
        since=BEGIN_S + 3 * DAY_S,
        raised=BEGIN_S + 8 * DAY_S,
        sum=12.0,
        threshold=8.0,
        ratio=0.8,
        ratio_q025=0.78,
        ratio_q975=0.82,
    )


@pytest.fixture(scope="module")
def past(tmp_path_factory: pytest.TempPathFactory) -> BridgeHistory:
    folder = tmp_path_factory.mktemp("history")
    add_results(folder, crossings(34))
    return bridge_history(folder, "sim-fleet", "bridge-1", "month", print)


def test_report_page_shows_months_elements_and_alarms(past: BridgeHistory) -> None:
    found = Seen(history_section(past, "h-"))
    assert "The bridge over time" in found.text
    assert "34 crossings in 2 months, 2026-03-01 to 2026-04-30." in found.text
    assert "No alarm" not in found.text
    never = "Not monitored: driveby alarm check has not been run on this bridge."
    assert never in found.text
    assert "From 2026-03 to 2026-04 no element changed by more than its 95 % interval" in found.text
    assert "First month, 2026-03 (GN·m²) Newest month (GN·m²)" in found.text
    assert "EI / first month" in found.text
    assert (
        "100 %: EI of each element in the first month with a usable result, 2026-03." in found.text
    )
    assert found.tags.count("tr") == 1 + 7
    newest, before = (
        one.state.elements["EI_4"] for one in reversed(past.periods) if one.state is not None
    )
    row = f"4 {before.mean / 1e9:.2f} {newest.mean / 1e9:.2f} {newest.q025 / 1e9:.2f}–"
    assert row in found.text
    assert f"{newest.mean / before.mean:.3f} 5 " in found.text
    assert found.tags.count("figure") == 1
    assert history_summary(past) == (
        "34 crossings in 2 months; not monitored for changes (see below)"
    )


def test_report_page_relates_periods_to_a_baseline(past: BridgeHistory) -> None:
    newest = [one.state for one in past.periods if one.state is not None][-1]
    baseline = StoredBaseline("then.json", (20e9,) * 7)
    text = Seen(history_section(past._replace(baseline=baseline), "h-")).text
    assert "100 %: EI of each element in the baseline then.json." in text
    assert "Baseline then.json (GN·m²) Newest month (GN·m²)" in text
    assert f"{newest.elements['EI_4'].mean / 20e9:.3f} 5 20.00 " in text


@pytest.fixture(scope="module")
def lost(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Results]:
    """Two months, element 4 a fifth weaker in the second."""
    folder = tmp_path_factory.mktemp("history")
    rng = np.random.default_rng(3)
    (truck,), bridge, some = trucks_of(rng, 1), bridge_of(rng, "bridge-1"), []
    for day in range(59):
        ei = bridge.ei_nm2.copy()
        ei[3] *= 0.8 if day >= 31 else 1.0
        entry_s = BEGIN_S - DAY_S + day * DAY_S  # from 1 March on
        some.append(crossing_of(rng, templates()[day % 3], truck, bridge, entry_s, ei))
    found = results_of(some, BEGIN_S + 100 * DAY_S)
    add_results(folder, found)
    return folder, found


def test_two_different_months_are_named_without_a_judgement(
    lost: tuple[Path, Results], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """As `identify --baseline` says it of the same data; in every form, and nowhere in green."""
    folder, found = lost
    past = bridge_history(folder, "sim-fleet", "bridge-1", "month", print)
    assert past.comparison is not None
    of_it = past.comparison.changes[3]
    assert of_it.low < 0.8 < of_it.high < 0.9
    assert [one.element for one in past.comparison.changes if one.is_clear] == [4]
    months = [part(found, 0, 31), part(found, 31, 59)]
    before, after = (fused_state(some) for some in months)
    theirs = after["EI_4"].mean / before["EI_4"].mean
    assert of_it.ratio == pytest.approx(theirs, abs=0.02)
    never, outcome = statements(past)
    assert not never.is_reassuring
    assert not outcome.is_reassuring
    assert outcome.text.startswith("EI from 2026-03 to 2026-04: element 4 −")
    assert outcome.text.endswith("not corrected for temperature or season.")
    assert cli.main(["history", "bridge-1", "--history", str(folder), "--json",
                     str(tmp_path / "h.json"), "--figures", str(tmp_path)]) == 0  # fmt: skip
    printed = capsys.readouterr().out
    assert never.text in printed
    assert outcome.text in printed
    assert "use driveby report --baseline" in printed
    kept = json.loads((tmp_path / "h.json").read_text())
    assert kept["watch"]["state"] == "never_checked"
    assert kept["comparison"]["elements"]["EI_4"]["q975"] == pytest.approx(of_it.high)
    page, drawn = Seen(history_section(past, "h-")).text, history_view(past)
    for form in (page, (tmp_path / "bridge-1-history.svg").read_text()):
        assert "more than chance" not in form.replace("more than chance, season", "")
        assert "No alarm" not in form
    assert outcome.text in page
    assert drawn.statements == (never, outcome)


def fused_state(some: Results) -> dict[str, ElementState]:
    kept = [usable(one) for one in some.crossings]
    state = state_of(
        add_crossings(RecentCrossings(), [one for one in kept if one is not None]), "bridge-1"
    )
    assert state is not None
    return dict(state.elements)


def test_one_month_is_nothing_to_compare_with(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    add_results(tmp_path, crossings(5))
    assert cli.main(["history", "bridge-1", "--history", str(tmp_path)]) == 0
    assert capsys.readouterr().out.splitlines()[-2:] == [
        "Not monitored: driveby alarm check has not been run on this bridge.",
        (
            "A change cannot be detected yet: fewer than two months have good crossings that can "
            "be compared."
        ),
    ]


def test_an_alarm_stands_until_somebody_has_taken_note_of_it(past: BridgeHistory) -> None:
    printed = "element 4 is 20 % less stiff than before 2026-03-05 (95 % interval 18 to 22 %)."
    standing = past._replace(alarms=(alarm(),))
    text = Seen(history_section(standing, "h-")).text
    assert f"Alarm of 2026-03-10: {printed} The alarm is active: it is not acknowledged." in text
    assert "; 1 active alarm (see" in history_summary(standing)
    note = Acknowledgement(by="<b>Anna</b>", time=BEGIN_S + 9 * DAY_S, note="frozen")
    noted = past._replace(alarms=(alarm().model_copy(update={"acknowledged": note}),))
    found = Seen(history_section(noted, "h-"))
    assert f"{printed} <b>Anna</b> acknowledged it on 2026-03-11: frozen" in found.text
    assert "b" not in found.tags  # what somebody wrote is text
    assert "; not monitored for changes (see" in history_summary(noted)
    both = past._replace(alarms=(alarm(), alarm()))
    assert "; 2 active alarms (see" in history_summary(both)


def test_the_command_puts_the_page_behind_the_first(
    tmp_path: Path, project: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    some = crossings(3)
    added(tmp_path, some)
    assert (
        cli.main(["fuse", str(tmp_path / "results.json"), "--json", str(tmp_path / "f.json")]) == 0
    )
    output = tmp_path / "r.html"
    words = ["report", str(tmp_path / "f.json"), "-o", str(output)]
    words += ["--site", str(project / "docs/site.example.toml")]
    assert cli.main([*words, "--history", str(tmp_path / "history")]) == 0
    text = Seen(output.read_text()).text
    assert "Over time 3 crossings in 1 month; not monitored for changes" in text
    places = [text.index(word) for word in ("What this does not mean", "The bridge over time",
                                            "Evidence: all crossings")]  # fmt: skip
    assert places == sorted(places)
    # A history that does not know the bridge: a line, and the page without it.
    other = tmp_path / "other"
    add_results(other, crossings(1, name="bridge-2"))
    capsys.readouterr()
    assert cli.main([*words, "--history", str(other)]) == 0
    assert f"{other}: has no bridge bridge-1 in realm sim-fleet" in capsys.readouterr().out
    assert "over time" not in Seen(output.read_text()).text
    assert cli.main([*words, "--history", str(tmp_path / "nowhere")]) == 2
    assert "no such folder" in capsys.readouterr().err


@pytest.mark.process
def test_the_viewer_shows_the_picture_and_each_element_over_the_whole_time(
    past: BridgeHistory, tmp_path: Path
) -> None:
    file = tmp_path / "past.rrd"
    write_history(file, past._replace(alarms=(alarm(),)))
    with opened(file, tmp_path) as viewer:
        views = viewer.get_state().views
        assert {view.view_class for view in views} == {"2D", "TextDocument", "TimeSeries"}
        assert [view.reports for view in views if view.reports] == []
        seen = pixels(picture(viewer))[:, :, :3]
        assert (seen.min(axis=2) > 0.98).mean() > 0.3  # the picture's paper
        open_tab(viewer, "EI_4")
        lines = pixels(picture(viewer))[:, :, :3]
        # Thin lines are mixed with the black behind them, so only their hue is certain.
        blue = (lines[:, :, 2] - lines[:, :, 0] > 0.1).any(axis=0)
        # Two months: the lines go from the middle of one to that of the other.
        assert blue.mean() > 0.3


@pytest.mark.process
def test_view_opens_the_viewer_with_what_was_asked_for(tmp_path: Path) -> None:
    """A stand-in for the viewer: the real one needs a screen."""
    history = tmp_path / "history"
    add_results(history, crossings(3))
    shown, program = tmp_path / "shown.rrd", tmp_path / "viewer"
    program.write_text(
        f'#!/bin/sh\n[ $1 = analytics ] && exit\nfor last; do :; done\ncp "$last" {shown}\n'
    )
    program.chmod(0o755)
    code = (
        "import sys; from pathlib import Path\n"
        "from services.cli import main\nfrom services.viewer import view\n"
        f"view.viewer_program = lambda: Path({str(program)!r})\n"
        f"sys.exit(main.main(['history', 'bridge-1', '--history', {str(history)!r}, '--view']))"
    )
    screen = {**os.environ, "DISPLAY": ":0"}
    subprocess.run([sys.executable, "-c", code], check=True, timeout=LONGEST_S, env=screen)
    assert shown.read_bytes().startswith(b"RRF2")
    assert shown.stat().st_size > 10_000
