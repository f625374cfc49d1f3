"""Intervals against priors, all on one scale."""

from pathlib import Path

import numpy as np
import pytest

from schemas.results import CrossingResult, Prior
from schemas.site_file import load_site
from services.viewer.crossing_view import ParameterRow
from services.viewer.panels.learned import prior_posterior_rows
from services.viewer.rerun_file import RerunContent, write_rrd
from tests.unit.viewer.found import results_of, some_crossing
from tests.viewer_screen import open_tab, opened, picture, pixels, view_named


def row(name: str, low: float, mean: float, high: float, prior: Prior | None) -> ParameterRow:
    return ParameterRow(name, "1", mean, low, high, prior)


def log_normal(location: float, scale: float) -> Prior:
    return Prior(distribution="log_normal", location=location, scale=scale)


def test_an_unknown_of_which_nothing_was_learned_is_as_wide_as_its_prior() -> None:
    e = 2.718281828459045
    nothing = row("k_s1", e**-0.2939946, 1.0, e**0.2939946, log_normal(1.0, 0.15))
    (found,) = prior_posterior_rows([nothing])
    assert (found.low, found.estimate, found.high) == pytest.approx((-1.96, 0.0, 1.96), abs=1e-3)
    assert found.prior == pytest.approx((-1.96, 1.96), abs=1e-3)
    assert found.share == pytest.approx(1.0, abs=1e-3)


def test_a_lost_element_is_as_many_standard_deviations_away_as_its_logarithm() -> None:
    (found,) = prior_posterior_rows([row("EI_4", 0.39, 0.40, 0.41, log_normal(1.0, 0.55))])
    assert found.estimate == pytest.approx(-0.916291 / 0.55, abs=1e-5)
    assert found.share == pytest.approx(0.0232, abs=1e-3)


@pytest.mark.parametrize(
    ("form", "location", "value", "expected", "limits"),
    [
        ("half_normal", 0.0, 500.0, 0.5, (0.0313, 2.2414)),
        ("normal", 100.0, 600.0, 0.5, (-1.96, 1.96)),
        ("uniform", 100.0, 600.0, 0.5, (-0.95, 0.95)),
    ],
)
def test_each_form_of_a_prior_has_its_scale(form, location, value, expected, limits):
    prior = Prior(distribution=form, location=location, scale=1000.0)
    (found,) = prior_posterior_rows([row("c_u1", value, value, value, prior)])
    assert found.estimate == pytest.approx(expected)
    assert found.prior == pytest.approx(limits, abs=1e-3)


def test_elements_come_first_and_what_is_derived_is_left_out() -> None:
    rows = [
        row("d_1", 1.0, 1.0, 1.0, log_normal(1.0, 0.1)),
        row("EI_1", 1.0, 1.0, 1.0, log_normal(1.0, 0.5)),
        row("m_s", 1.0, 1.0, 1.0, None),
    ]
    assert [found.name for found in prior_posterior_rows(rows)] == ["EI_1", "d_1"]


def test_what_no_logarithm_has_stays_on_the_picture() -> None:
    rows = [row("d_1", -1.0, 0.0, 1e9, log_normal(1.0, 0.1)), row("x", 1, 1, 1, log_normal(1, 0))]
    wild, fixed = prior_posterior_rows(rows)
    assert (wild.low, wild.high) == (-4.5, 4.5)
    assert fixed.estimate == 0.0


@pytest.mark.process
def test_an_interval_is_drawn_over_its_prior(tmp_path: Path, project: Path) -> None:
    site = load_site(project / "docs/site.example.toml")
    (crossing,) = results_of(site, some_crossing("one")).crossings
    values = crossing.model_dump()
    ei = values["parameters"]["EI_1"]
    ei["q025"], ei["q975"] = 0.6 * ei["q50"], 1.6 * ei["q50"]
    ei["prior"] = log_normal(ei["q50"], 0.5).model_dump()
    wide = CrossingResult.model_validate(values)
    write_rrd(tmp_path / "wide.rrd", RerunContent({}, [wide], site))
    with opened(tmp_path / "wide.rrd", tmp_path) as viewer:
        viewer.set_time(play_state="paused")
        open_tab(viewer, "Posterior and")
        shown = pixels(picture(viewer, view_named(viewer, "Posterior and")))
    blue = np.abs(shown - np.array([0x56, 0xB4, 0xE9]) / 255.0).max(axis=2) < 0.1
    grey = np.abs(shown - np.array([0x3A, 0x41, 0x48]) / 255.0).max(axis=2) < 0.03
    # The interval is half of its prior's bar, whose ends are round; the estimate alone is a dot.
    widths = [np.ptp(np.flatnonzero(line.any(axis=0))) for line in (blue, grey)]
    assert 0.4 < widths[0] / widths[1] < 0.6
