"""`driveby survey` from its arguments to its files: one plan, and what is refused."""

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import pytest

from schemas.site import Site
from schemas.site_file import site_toml
from services.cli import main as cli
from services.identification.comparison import Element, clear_loss_detectable
from services.planning import plan_survey
from services.planning import survey as planning
from services.planning.advice import advice, warnings
from services.planning.alternatives import alternatives, as_planned, with_noise
from services.planning.crossings import PlannedRoad
from services.planning.figure import draw_survey
from services.planning.forecast_text import lines_of
from services.planning.survey import PlanForecast, SurveyExpectation, SurveyForecast, SurveyQuestion
from services.simulation.drive import paper_site
from services.viewer.drawing import STYLE
from tests.unit.words import assert_words_apart


def test_a_plan_of_the_example(
    project: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Twin tyres on the best class of road: blind at midspan, and single ones are what helps."""
    found, picture = tmp_path / "plan.json", tmp_path / "plan.png"
    arguments = ["survey", "--site", str(project / "docs/site.example.toml"), "--speed", "10"]
    assert cli.main([*arguments, "--json", str(found), "--figure", str(picture)]) == 0
    out, errors = capsys.readouterr()
    assert "forecasting 12 crossings of bridge-1 by truck-1 and the alternatives: 10 p" in errors
    assert "at … t: at most 18 t, with three axles 26 t, as in the EU" in out
    assert "\nmidspan: EI_4, at the middle of the longest span\n" in out
    plan = json.loads(found.read_text(encoding="utf-8"))
    last, middle = plan["growth"][-1], plan["planned"]["middle_element"] - 1
    assert last["crossings"] == 300
    assert last["smallest_clear_loss"][middle] > plan["loss"]
    assert plan["planned"]["crossings_needed"]["clear_middle"] is None
    tandem = next(one for one in plan["alternatives"] if "tandem" in one["name"])
    assert tandem["crossings_needed"]["clear_middle"] > tandem["crossings_needed"]["middle"]
    assert picture.stat().st_size > 10_000
    planned = plan["planned"]["all_crossings"]
    assert 0.06 < planned["level_std"] < 0.16
    assert planned["probability_seen"][3] < 0.2
    assert plan["planned"]["crossings_needed"]["middle"] is None
    single = {one["name"]: one for one in plan["alternatives"]}["equal single tyres on both axles"]
    assert single["all_crossings"]["probability_seen"][3] > 0.9
    assert single["crossings_needed"]["middle"] < 30
    once, whole = (plan["planned"][key]["std_ln_ei"] for key in ("one_crossing", "all_crossings"))
    assert np.median(whole) < np.median(once)
    growth = {one["crossings"]: one["std_ln_ei"] for one in plan["growth"]}
    assert (np.diff([growth[count] for count in sorted(growth)], axis=0) <= 0.0).all()
    assert growth[planned["crossings"]] == whole
    best = "equal single tyres on both axles, on equal tracks to a centimetre"
    assert best in plan["advice"]
    assert "\nequal single tyres: on tracks that are equal to a centimetre\n" in out
    assert plan["advice"] in out
    assert "tyres are not declared" in out
    assert plan["speeds"] == []
    table = [line for line in out.splitlines() if not line.startswith(("warning", "Even 300"))]
    assert max(len(line) for line in table) <= 80


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--speed", "20:5"], "SLOWEST:FASTEST"),
        (["--loss", "1.5"], "a share of EI from 0.01 to 0.95"),
        (["--loss", "20"], "20 % is 0.2"),
        (["--crossings", "0"], "a number of crossings"),
        (["--figure", "plan.gif"], ".png or .svg"),
        (["--road", "F"], "invalid choice"),
    ],
)
def test_what_is_refused(
    project: Path, arguments: Sequence[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    site = str(project / "docs/site.example.toml")
    assert cli.main(["survey", "--site", site, *arguments]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


def expected(std: float, crossings: int = 12) -> SurveyExpectation:
    wide = np.full(7, std)
    loss = np.minimum(0.9, 3.0 * wide)
    return SurveyExpectation(crossings, wide, std / 3.0, wide, wide, loss, loss)


def made_up(needed: int | None, others: dict[str, float], speed: float = 10.0) -> SurveyForecast:
    site = with_noise(paper_site(), (25.0,) * 4)
    plan = as_planned(site, speed)
    planned = PlanForecast(plan, expected(0.3, 1), expected(0.2), 3, needed, None, 30)
    return SurveyForecast(
        SurveyQuestion(0.2, 12, speed, (speed, speed)),
        PlannedRoad("A", 0.12),
        planned,
        tuple(
            PlanForecast(plan._replace(name=name), expected(std, 1), expected(std), 3, 4, 60, 25)
            for name, std in others.items()
        ),
        (),
        None,
        tuple(expected(0.3 / np.sqrt(n), n) for n in (1, 12, 300)),
        40.0,
    )


def test_the_advice_names_what_helps_most() -> None:
    found = made_up(9, {"a trailer": 0.19, "two trucks": 0.1, "a slower truck": 0.15})
    text = advice(found)
    assert text.startswith("9 crossings at 10 m/s with twin rear tyres detect a 20 % loss")
    assert "the ends would take more than 300" in text
    assert "What helps most: two trucks; then 4 crossings detect it, and the ends need 60." in text
    assert "Next best: a slower truck" in text
    assert "a trailer" not in text
    # Fewer elements are another question, not a better truck.
    coarse = made_up(9, {"a trailer": 0.15, "3 elements": 0.05})
    bridge = coarse.planned.plan.site.bridges[0].model_copy(update={"elements": 3})
    site = coarse.planned.plan.site.model_copy(update={"bridges": (bridge,)})
    few = coarse.others[1]._replace(plan=as_planned(site, 10.0))
    assert "most: a trailer" in advice(coarse._replace(others=(coarse.others[0], few)))
    alike = made_up(None, {"a trailer": 0.199})
    (never,) = (one._replace(needed_middle=None, needed_ends=None) for one in alike.others)
    blind = advice(alike._replace(others=(never,)))
    assert blind.startswith("Even 300 crossings")
    assert "60 % or more" in blind
    assert blind.endswith("No other change of truck, load, direction or sensors helps much.")


def test_advice_states_what_a_report_calls_clear() -> None:
    found = made_up(9, {})
    assert "ends would take more than 300. A report calls it clear after 30 cr" in advice(found)
    never = found._replace(planned=found.planned._replace(clear_middle=None))
    assert "not call it clear even after 300; after 12 it calls a loss of 60 % clear" in advice(
        never
    )


def test_what_makes_a_survey_blind_is_warned_of() -> None:
    usual = list(warnings(made_up(9, {})))
    assert not [line for line in usual if "3 m/s" in line and "rejected" in line]
    slow = list(warnings(made_up(9, {}, 2.5)))
    assert [line for line in slow if "below 3 m/s a crossing is rejected" in line]
    short = list(warnings(made_up(9, {})._replace(compared_m=8.0)))
    assert [line for line in short if "8 m of road before and after the bridge" in line]


def test_sensors_are_named_and_their_middle_is_planned(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    planned: list[Site] = []

    def kept(site: Site, *_: object) -> SurveyForecast:
        planned.append(site)
        return made_up(9, {})

    monkeypatch.setattr(plan_survey, "forecast_survey", kept)
    site, found = tmp_path / "site.toml", tmp_path / "plan.json"
    text = site_toml(paper_site())
    places = (("body", 0.0), ("body", 4.4), ("axle", 1), ("axle", 2))
    for number, (on, place) in enumerate(places):
        for side, lateral in (("left", 0.5), ("right", -0.5)):
            where = f"axle = {place}" if on == "axle" else f"position_m = {place}"
            text = text.replace(
                "[bridge]",
                f'[[vehicle.sensors]]\nchannel = "s{number}_{side}"\non = "{on}"\n{where}\n'
                f"lateral_m = {lateral}\nnoise_density_ug_per_rthz = 10.0\n[bridge]",
                1,
            )
    site.write_text(text)
    assert cli.main(["survey", "--site", str(site), "--json", str(found)]) == 0
    out = capsys.readouterr().out
    assert "sensor s2_left: axle 1, 0.5 m to the left, 10 µg/√Hz" in out
    sensors = json.loads(found.read_text(encoding="utf-8"))["sensors"]
    assert [one["channel"] for one in sensors][:2] == ["s0_left", "s0_right"]
    assert planned[0].vehicles[0].sensors == ()
    assert planned[0].sensor.noise_density_ug_per_rthz == pytest.approx((10.0 / 2**0.5,) * 4)


def test_every_word_of_the_picture_can_be_read() -> None:
    with matplotlib.rc_context(STYLE):
        assert_words_apart(draw_survey(made_up(9, {})))


def test_lines_fit_on_a_terminal() -> None:
    found = made_up(None, {"half of the runs the other way": 0.2})
    assert any(line.startswith("half in the other direction  ") for line in lines_of(found))
    assert not any("other way" in line for line in lines_of(found))
    tables = [line for line in lines_of(found) if not line.startswith(("warning", "Even 300"))]
    assert max(map(len, tables)) <= 80


def test_each_number_of_crossings_is_forecast_once(monkeypatch: pytest.MonkeyPatch) -> None:
    counted: list[int] = []

    def expected_once(simulated: object, plan: object, tracks: object, count: int, _: float) -> Any:
        counted.append(count)
        return expected(0.3 / np.sqrt(count), count)

    monkeypatch.setattr(planning, "_expected", expected_once)
    found = made_up(9, {})
    question = found.question._replace(crossings=12)
    planned = found.planned._replace(once=expected(0.3, 1), expected=expected(0.1, 12))

    class NoSimulator:
        """A stand-in whose tracks are never used."""

        def track(self, _: object) -> None:
            return None

    growth = planning._growth(NoSimulator(), planned, question)  # type: ignore[arg-type]
    assert [one.crossings for one in growth] == sorted({*planning._COUNTS, 12})
    assert not {1, 12} & set(counted)


def test_needed_is_the_fewest() -> None:
    def enough(number: int) -> Callable[[int], bool]:
        return lambda crossings: crossings >= number

    for number in (1, 2, 3, 17, 63, 64, 65, 299, 300):
        assert planning._needed(enough(number)) == number
    assert planning._needed(enough(301)) is None
    assert planning._needed(enough(1), fewest=2) == 2


def test_half_of_the_runs_takes_at_least_two_crossings() -> None:
    plans = list(alternatives(paper_site(), 10.0))
    halves = [plan for plan in plans if plan.label.startswith("half")]
    assert len(halves) == 3
    assert {plan.fewest_crossings for plan in halves} == {2}
    assert {plan.fewest_crossings for plan in plans if plan not in halves} == {1}


def test_the_loss_that_a_report_calls_clear_is_forecast() -> None:
    """It is the report's own figure for a survey that is as accurate as forecast."""
    lines = list(lines_of(made_up(9, {})))
    assert lines[6].endswith("smallest  clear")
    assert "the whole 95 % interval is more than 10 % below the others" in " ".join(lines)
    (clear,) = clear_loss_detectable(np.array([1.96 * 0.05]))
    ratio, high = 1.0 - clear, (1.0 - clear) * np.exp(1.96 * 0.05)
    loss = Element(1, 0.0, 5.0, ratio, 0.5, high).detectable_loss
    assert clear == pytest.approx(loss, rel=1e-9)
    assert clear == pytest.approx(1.0 - 0.9 * np.exp(-(1.96 + 1.645) * 0.05), abs=1e-4)


def test_picture_names_bridge_truck_and_threshold() -> None:
    with matplotlib.rc_context(STYLE):
        figure = draw_survey(made_up(9, {}))
    words = [text.get_text() for text in figure.texts]
    assert words[0] == "Survey of bridge-1 by truck-1"
    assert "10 m/s" in words[1]
    legend = figure.axes[0].get_legend()
    assert legend is not None
    assert "95 %" in [text.get_text() for text in legend.get_texts()]


def test_forecast_says_what_a_comparison_of_two_surveys_takes() -> None:
    text = " ".join(lines_of(made_up(9, {})))
    assert "Two compared surveys of 12 crossings have √2 times the ± of one" in text
    assert "so each needs at least twice the crossings stated here" in text


def test_forecast_of_a_declared_road_assumes_none() -> None:
    found = made_up(9, {})
    site = found.planned.plan.site
    bridge = site.bridges[0].model_copy(update={"road_class": "A"})
    plan = as_planned(site.model_copy(update={"bridges": (bridge,)}), 10.0)
    text = "\n".join(lines_of(found._replace(planned=found.planned._replace(plan=plan))))
    assert "road class A, 12 crossings\n" in text


def test_forecast_prints_the_speeds_it_assumes() -> None:
    text = "\n".join(lines_of(made_up(9, {})))
    assert "assumed road class A (--road), 12 crossings\n" in text
    assert "\nassumed speeds: half at 8.5 m/s, half at 11.5 m/s\n" in text
