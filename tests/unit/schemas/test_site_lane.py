"""What a site file says of the lane and of the deck, and the prior of torsion that follows."""

import math

import pytest

from schemas.errors import InputError
from schemas.site import Bridge
from schemas.site_file import parse_site, site_hash, site_toml
from services.simulation.drive import paper_site

SITE = paper_site()


def bridge(**keys: float) -> Bridge:
    return Bridge.model_validate(SITE.bridges[0].model_dump() | keys)


def test_file_without_a_lane_keeps_its_hash() -> None:
    """Results and site validations of files without these keys stay theirs."""
    assert site_hash(SITE) == "d72530fcf146610c"
    assert "lane" not in site_toml(SITE)
    other = SITE.model_copy(update={"bridges": (bridge(lane_offset_m=1.6),)})
    assert site_hash(other) != site_hash(SITE)
    assert parse_site(site_toml(other), "x") == other


def test_declared_lane_gives_a_log_normal_prior() -> None:
    """Of e²/(GJ), by the frequencies of a uniform beam: GJ = rho A r² (2 L ratio f_1)²."""
    deck = bridge(lane_offset_m=-1.5, torsional_frequency_ratio=2.0, deck_gyration_m=2.3)
    ei, rho_a, span = SITE.bridges[0].flexural_rigidity_nm2, 9360.0, 30.0
    rho_a = SITE.bridges[0].mass_per_length_kg_per_m
    f_1 = math.pi / (2.0 * span**2) * math.sqrt(ei / rho_a)
    rigidity = rho_a * 2.3**2 * (2.0 * span * 2.0 * f_1) ** 2
    assert deck.nominal("torsional_flexibility_per_n")[0] == pytest.approx(1.5**2 / rigidity)
    assert deck.torsional_wave_speed_m_per_s == pytest.approx(2.0 * span * 2.0 * f_1)
    expected = 2.0 * math.sqrt((0.3 / 1.5) ** 2 + 0.3**2 + 0.2**2)
    assert deck.spread("torsional_flexibility_per_n") == pytest.approx(expected)


def test_unknown_lane_gives_a_prior_at_zero() -> None:
    unknown, near = bridge(), bridge(lane_offset_m=0.2)
    assert unknown.nominal("torsional_flexibility_per_n") == (0.0,)
    assert near.nominal("torsional_flexibility_per_n") == (0.0,)
    ratio = near.scale_at_zero("torsional_flexibility_per_n") / unknown.scale_at_zero(
        "torsional_flexibility_per_n"
    )
    assert ratio == pytest.approx((0.3 / 2.0) ** 2)


def test_lane_on_the_axis_needs_no_torsion() -> None:
    on_axis = bridge(lane_offset_m=0.0, lane_offset_m_spread=0.02)
    assert on_axis.scale_at_zero("torsional_flexibility_per_n") == 0.0


@pytest.mark.parametrize(
    ("key", "value"),
    [("lane_offset_m", 30.0), ("torsional_frequency_ratio", 0.0), ("deck_gyration_m", -1.0)],
)
def test_impossible_lanes_are_refused_by_name(key: str, value: float) -> None:
    text = site_toml(SITE).replace("[bridge]\n", f"[bridge]\n{key} = {value}\n")
    with pytest.raises(InputError, match=f"bridge.{key}"):
        parse_site(text, "site.toml")


def test_spread_of_the_lane_is_named_as_a_length() -> None:
    text = site_toml(SITE).replace("[bridge]\n", "[bridge]\nlane_offset_m_spread = -1.0\n")
    with pytest.raises(InputError, match=r"lane_offset_m_spread is -1.* m\b"):
        parse_site(text, "site.toml")
