"""The advice of a forecast ranks alternatives as the table of the forecast does."""

import re
from itertools import pairwise, product
from typing import Any

import numpy as np
import pytest

from schemas.site import Site
from services.common.language import ENGLISH
from services.common.truck_choice import truck_to_try
from services.planning.advice import advice
from services.planning.alternatives import TANDEM, as_planned, with_noise
from services.planning.crossings import PlannedRoad
from services.planning.forecast_text import as_json, lines_of
from services.planning.survey import (
    PlanForecast,
    SpeedForecast,
    SurveyExpectation,
    SurveyForecast,
    SurveyQuestion,
)
from services.simulation.drive import paper_site
from services.simulation.usual_trucks import usual_tandem

SITE = with_noise(paper_site(), (25.0,) * 4)
NONE_HELPS = "No other change of truck, load, direction or sensors helps much."
Row = tuple[int | None, int | None, float]
"""Columns `needed`, `ends` and `smallest` of the table."""


def forecast(
    planned: Row,
    crossings: int = 12,
    site: Site = SITE,
    tandem: Row | None = None,
    **others: Row,
) -> SurveyForecast:
    plan = as_planned(site, 10.0)
    of_tandem = as_planned(site.model_copy(update={"vehicles": (usual_tandem(25.0),)}), 10.0)

    def row(name: str, values: Row) -> PlanForecast:
        middle, ends, smallest = values
        wide = np.full(7, 0.2)
        limit = np.full(7, smallest)
        expected = SurveyExpectation(crossings, wide, 0.1, wide, wide, limit, limit)
        of = of_tandem if name == TANDEM else plan
        return PlanForecast(of._replace(name=name), expected, expected, 3, middle, ends, None)

    rows = others if tandem is None else {**others, TANDEM: tandem}
    outlook = row("as planned", planned)
    return SurveyForecast(
        SurveyQuestion(0.2, crossings, 10.0, (10.0, 10.0)),
        PlannedRoad("A", 0.12),
        outlook,
        tuple(row(name, values) for name, values in rows.items()),
        (),
        None,
        (outlook.expected,),
        40.0,
    )


def named(found: SurveyForecast) -> list[str]:
    """Return the alternatives that the advice names, the best one first."""
    return re.findall(r"(?:helps most:|helps more:|Next best:) (\w+)", advice(found))


def test_fewer_crossings_come_before_a_smaller_loss() -> None:
    """The alternative with the smallest loss at 12 crossings never detects the loss in question."""
    found = forecast((None, None, 0.5), few=(20, None, 0.3), steep=(None, None, 0.25))
    assert named(found) == ["few", "steep"]
    assert "most: few; then 20 crossings detect it, and the ends would take more than 300." in (
        advice(found)
    )
    assert "Next best: steep (then 12 crossings detect a loss of 25 %)." in advice(found)


def test_alternative_that_needs_more_crossings_is_not_advised() -> None:
    assert NONE_HELPS in advice(forecast((9, 40, 0.2), more=(15, 60, 0.1), none=(None, None, 0.1)))


def test_alternative_that_alone_detects_the_loss_is_advised() -> None:
    """It need not detect a smaller loss at the planned number of crossings."""
    assert named(forecast((None, None, 0.5), late=(90, None, 0.5))) == ["late"]


def test_number_of_crossings_beyond_what_is_possible_is_no_advice() -> None:
    assert NONE_HELPS in advice(forecast((None, None, 0.5), late=(216, None, 0.5)))
    steep = advice(forecast((None, None, 0.5), steep=(216, None, 0.3)))
    assert "helps most: steep; then 12 crossings detect a loss of 30 %." in steep
    assert "216" not in steep
    assert NONE_HELPS in advice(forecast((9, None, 0.3), ends=(9, 216, 0.3)))
    assert named(forecast((None, None, 0.5), 250, late=(216, None, 0.5))) == ["late"]


def test_change_that_needs_as_many_crossings_names_only_the_ends() -> None:
    text = advice(forecast((2, 40, 0.2), ends=(2, 20, 0.2)))
    assert "helps most: ends; then the ends need 20." in text
    assert "then 2 crossings" not in text


def test_hardly_fewer_crossings_are_not_worth_a_sentence() -> None:
    assert NONE_HELPS in advice(forecast((100, None, 0.3), same=(99, None, 0.3)))
    assert named(forecast((100, None, 0.3), ends=(99, 100, 0.3))) == ["ends"]


def test_gain_of_less_than_a_quarter_is_not_worth_a_sentence() -> None:
    """Sensors of a quarter of the noise save 2 of 20 crossings at the ends: no help."""
    planned = (1, 20, 0.1)
    assert NONE_HELPS in advice(forecast(planned, quiet=(1, 18, 0.08), same=(1, 20, 0.08)))
    assert named(forecast(planned, better=(1, 14, 0.1))) == ["better"]


def test_ties_are_ranked_by_the_ends_then_by_the_loss() -> None:
    ties = forecast((9, None, 0.3), a=(5, None, 0.1), b=(5, 40, 0.2), c=(5, 40, 0.15))
    assert named(ties) == ["c", "b"]
    same = forecast((9, 40, 0.3), same=(9, 40, 0.2))
    assert "helps most: same; then 12 crossings detect a loss of 20 %." in advice(same)


def test_free_change_comes_before_better_sensors() -> None:
    """The sensors detect more, and are bought; a loaded truck costs nothing."""
    quiet, loaded = "sensors of a quarter of the noise", "half of the runs at 13.7 t"
    rows: dict[str, Any] = {quiet: (20, None, 0.3), loaded: (None, None, 0.4)}
    found = forecast((None, None, 0.5), **rows)
    assert (
        f"What helps at no cost: {loaded}; then 12 crossings detect a loss of 40 %. "
        "What helps more: sensors with 1/4 of the noise (then 20 crossings detect it"
    ) in advice(found)
    weak = forecast((None, None, 0.5), **(rows | {quiet: (None, None, 0.45)}))
    quiet_label = "sensors with 1/4 of the noise"
    assert f"Next best: {quiet_label} (then 12 crossings detect a loss of 45 %)." in advice(weak)


def test_other_tyres_come_before_better_sensors() -> None:
    quiet, tyres = "sensors of a quarter of the noise", "equal single tyres on both axles"
    rows: dict[str, Any] = {quiet: (20, None, 0.3), tyres: (40, None, 0.3)}
    found = forecast((None, None, 0.5), **rows)
    assert f"What helps at the least cost: {tyres}, on equal tracks" in advice(found)
    assert "What helps more: sensors with 1/4 of the noise (" in advice(found)


def test_speed_that_helps_is_a_free_change() -> None:
    def at(speed: float, smallest: float) -> SpeedForecast:
        return SpeedForecast(speed, 0.2, 0.1, 0.1, smallest)

    found = forecast((None, None, 0.5))
    slow = found._replace(speeds=(at(5.0, 0.4), at(10.0, 0.48), at(20.0, 0.6)))
    assert "What helps at no cost: driving at 5 m/s; then 12 crossings detect a loss of 40 %" in (
        advice(slow)
    )
    # One speed instead of several is the cause here, not another speed.
    assert NONE_HELPS in advice(found._replace(speeds=(at(5.0, 0.4), at(10.0, 0.41))))


def test_single_crossing_has_its_verb() -> None:
    one = forecast((9, None, 0.3), one=(1, 1, 0.1))
    assert "then 1 crossing detects it, and the ends need no more." in advice(one)
    alone = forecast((None, None, 0.3), 1, better=(None, None, 0.2))
    assert "then 1 crossing detects a loss of 20 %." in advice(alone)


@pytest.mark.parametrize("planned", [(9, 40, 0.2), (9, None, 0.2), (None, None, 0.2)])
def test_no_row_of_the_table_beats_the_advised_one(planned: Row) -> None:
    """In every pair of alternatives, by the columns that the table prints."""
    rows = list(product((4, 9, 30, None), (None, 40, 60), (0.1, 0.2, 0.3)))
    for a, b in product(rows, rows):
        names = named(forecast(planned, a=a, b=b))
        table = {"a": a, "b": b}
        for better, worse in pairwise(names):
            assert key(table[better]) <= key(table[worse])
        if names:
            assert key(table[names[0]]) <= key(planned)
        left_out = table.keys() - set(names)
        assert not [one for one in left_out if key(table[one])[0] < key(planned)[0]]


def key(row: Row) -> tuple[float, float, float]:
    middle, ends, smallest = row
    if middle is None:
        return (np.inf, np.inf, smallest)
    return (middle, np.inf if ends is None else ends, smallest)


def test_table_names_the_rows_without_advice() -> None:
    text = " ".join(lines_of(forecast((9, 40, 0.2))))
    assert "The advice does not rank tandems, whose forecast is too optimistic, nor fewer" in text


@pytest.mark.parametrize("twin_m", [0.33, 0.0])
@pytest.mark.parametrize("supports_m", [(), (15.0,)])
def test_survey_and_report_advise_a_tandem_for_the_same_trucks(
    twin_m: float, supports_m: tuple[float, ...]
) -> None:
    """Each truck on each bridge; the row of the table is optimistic, and better than the plan."""
    bridge = SITE.bridges[0].model_copy(
        update={"interior_supports_m": supports_m, "elements": 6, "element_lengths_m": None}
    )
    truck = SITE.vehicles[0].model_copy(update={"twin_tyre_distance_m": (0.0, twin_m)})
    site = SITE.model_copy(update={"vehicles": (truck,), "bridges": (bridge,)})
    found = forecast((None, None, 0.5), site=site, tandem=(6, 43, 0.17))
    is_advised = f"What helps is {TANDEM}, but less" in advice(found)
    words = ENGLISH.text(f"advice.open_{truck_to_try(truck, bridge)}")
    assert is_advised == ("equalised tandem" in words)
    assert is_advised == (twin_m > 0.0 and not supports_m)


def test_tandem_that_does_not_help_is_not_advised() -> None:
    assert NONE_HELPS in advice(forecast((9, 40, 0.2), tandem=(9, 40, 0.19)))
    better = forecast((None, None, 0.5), few=(20, None, 0.3), tandem=(6, 43, 0.17))
    assert advice(better).endswith(
        f"{TANDEM.capitalize()} helps, too, but less than its optimistic row states."
    )


def test_legend_says_why_equal_deviations_are_seen_unequally() -> None:
    text = " ".join(lines_of(forecast((9, 40, 0.2))))
    assert "Next to supports of unknown restraint, seen is lower" in text


def test_forecast_states_the_draws_behind_its_deviations() -> None:
    found = forecast((9, 40, 0.2))
    assert "(from 2,000 draws, with a relative error of 2 %)" in " ".join(lines_of(found))
    assert as_json(found)["draws"] == 2000
