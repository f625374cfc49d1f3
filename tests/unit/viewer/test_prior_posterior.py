"""Intervals against priors, all on one scale."""

import pytest

from schemas.results import Prior
from services.viewer.crossing_view import ParameterRow
from services.viewer.panels.learned import prior_posterior_rows


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
