"""Values that no bridge, truck or sensor has are refused, unlikely ones are not."""

from pathlib import Path

import pytest

from schemas.site_file import faults_of_site, load_site, parse_site
from services.inspection.template import TEMPLATE
from services.simulation.drive import paper_site
from tests.unit.schemas.test_site import BRIDGE, TEXT, complaint, with_line

RECEIVER = f"{TEXT}\n[receiver]\n"


@pytest.mark.parametrize(
    ("key", "value", "line"),
    [
        ("flexural_rigidity_nm2", "1e15", "bridge.flexural_rigidity_nm2 is 1e+15, it must be a fl"),
        ("flexural_rigidity_nm2", "1e-300", "bridge.flexural_rigidity_nm2 is 1e-300, it must be a"),
        ("flexural_rigidity_nm2", "8.5e6", "bridge.flexural_rigidity_nm2 is 8.5e+06, it must be a"),
        ("mass_per_length_kg_per_m", "1e-300", "bridge.mass_per_length_kg_per_m is 1e-300, it mu"),
        ("rayleigh_beta_s", "1e15", "bridge.rayleigh_beta_s is 1e+15, it must be a time from 0 to"),
        ("rayleigh_beta_s", "2.0", "bridge.rayleigh_beta_s is 2, it must be a time from 0 to"),
        ("rayleigh_alpha_per_s", "1e3", "bridge.rayleigh_alpha_per_s is 1000, it must be a coeff"),
        ("total_mass_kg", "1e-9", "vehicle.unsprung_mass_kg adds up to"),
        ("unsprung_mass_kg", "[450, 1e-3]", "vehicle.unsprung_mass_kg[1] is 0.001, it must be a m"),
        ("suspension_stiffness_n_per_m", "[250, 550]", "vehicle.suspension_stiffness_n_per_m[0] "),
        ("suspension_damping_ns_per_m", "[1e9, 1]", "vehicle.suspension_damping_ns_per_m[0] is 1"),
        ("tyre_stiffness_n_per_m", "[4e6, 1e15]", "vehicle.tyre_stiffness_n_per_m[1] is 1e+15, i"),
        ("front_axle_to_cg_m", "1e-9", "vehicle.front_axle_to_cg_m is 1e-09, it must be a length"),
        ("wheelbase_m", "4.0\npitch_inertia_ratio = 1e-9", "vehicle.pitch_inertia_ratio is 1e-09"),
        ("wheelbase_m", "4.0\ntyre_width_m = [1e15, 0.3]", "vehicle.tyre_width_m[0] is 1e+15, it"),
        ("wheelbase_m", "4.0\ntrack_m = 1e-6", "vehicle.track_m[0] is 1e-06, it must be a length "),
        (
            "rate_hz",
            "1.0",
            "sensor.rate_hz is 1, it must be a rate of at least 10 Hz (Hz, not kHz)",
        ),
        ("elements", "2\ninterior_supports_m = [1e-9]", "bridge.interior_supports_m[0] is 1e-09,"),
        ("elements", "2\nelement_lengths_m = [1e-9, 20]", "bridge.element_lengths_m[0] is 1e-09,"),
        (
            "elements",
            "5\nsupport_rotational_stiffness_spread_nm_per_rad = 1e-300",
            "bridge.support_rotational_stiffness_spread_nm_per_rad is 1e-300, it must be a rotati",
        ),
        (
            "elements",
            "5\nsupport_compliance_spread_m_per_n = 1e-300",
            "bridge.support_compliance_spread_m_per_n is 1e-300, it must be a compliance from",
        ),
        (
            "elements",
            "5\nflexural_rigidity_per_element_nm2 = [1e10, 1e10, 1e10, 1e10, 1e-3]",
            "bridge.flexural_rigidity_per_element_nm2[4] is 0.001, it must be a flexural rigidity",
        ),
    ],
)
def test_impossible_values_are_named_with_their_range(key: str, value: str, line: str) -> None:
    assert complaint(with_line(key, value)).startswith(line)


@pytest.mark.parametrize(
    ("key", "most"),
    [("position_spread_m", "100 m"), ("position_noise_m", "100 m"), ("speed_noise_m_per_s", "10")],
)
def test_a_receiver_errs_by_less_than_a_bridge(key: str, most: str) -> None:
    assert f"receiver.{key} is 1e+06, it must be a " in (
        output := complaint(f"{RECEIVER}{key} = 1e6")
    )
    assert f"from 0 to {most}" in output


def test_the_range_says_what_it_follows_from() -> None:
    output = complaint(with_line("flexural_rigidity_nm2", "8.5e6"))
    assert output == (
        "bridge.flexural_rigidity_nm2 is 8.5e+06, it must be a flexural rigidity from 4.086e+07 to "
        "3.6e+12 N·m²: 20 m of 4000 kg/m vibrate at 0.4 to 118 Hz; in kN·m²? then it is 8.5e+09"
    )


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("flexural_rigidity_nm2", "1.2e8"),  # a hundredth
        ("flexural_rigidity_nm2", "1.2e11"),  # ten times
        ("mass_per_length_kg_per_m", "450"),
        ("mass_per_length_kg_per_m", "450000"),
        ("rayleigh_beta_s", "0.03"),
        ("rayleigh_alpha_per_s", "50"),
        ("rayleigh_beta_s", "0"),
        ("suspension_damping_ns_per_m", "[0, 0]"),
        ("suspension_damping_ns_per_m", "[240000, 290000]"),  # ten times
        ("rate_hz", "50"),
        ("noise_density_ug_per_rthz", "1e6"),
    ],
)
def test_unlikely_values_are_left_alone(key: str, value: str) -> None:
    parse_site(with_line(key, value), "site.toml")


def test_a_model_in_a_laboratory_is_a_bridge() -> None:
    """A truck of 21 kg on a beam of 5.4 m that weighs 50 kg/m."""
    vehicle = (
        '[vehicle]\nid = "model"\ntotal_mass_kg = 21.0\nwheelbase_m = 0.4\n'
        "front_axle_to_cg_m = 0.2\nsuspension_damping_ns_per_m = [20, 20]\n"
        "suspension_stiffness_n_per_m = [2800, 2800]\nunsprung_mass_kg = [1.0, 1.0]\n"
        "tyre_stiffness_n_per_m = [20000, 20000]\ngps_antenna_to_front_axle_m = 0.0\n"
    )
    bridge = BRIDGE
    for key, value in (
        ("span_m", "5.4"),
        ("end_longitude_deg", f"{8.0 + 0.00026296 * 0.27:.10f}"),
        ("flexural_rigidity_nm2", "1.2e5"),
        ("mass_per_length_kg_per_m", "50"),
    ):
        bridge = with_line(key, value, bridge)
    parse_site(vehicle + bridge + "\n" + TEXT[TEXT.index("[sensor]") :], "site.toml")


def test_sites_that_the_program_brings_pass(project: Path) -> None:
    paper_site()
    load_site(project / "docs" / "site.example.toml")
    assert not any("it must be" in line for line in faults_of_site(TEMPLATE, "t") if "from" in line)
