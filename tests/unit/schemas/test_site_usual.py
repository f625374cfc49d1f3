"""What a site file implies is computed, and what is unusual is named with what was meant."""

import math
from pathlib import Path

import pytest

from schemas.errors import InputError
from schemas.site_file import load_site, parse_site, site_hash
from schemas.site_frequency import first_frequency_hz, given_frequencies
from schemas.site_usual import implied_by, warnings_of

ROOT = Path(__file__).parents[3]
TEXT = (ROOT / "docs/site.example.toml").read_text()
SITE = parse_site(TEXT, "site.toml")


def with_value(table: str, key: str, value: str) -> str:
    """The example with another value of one key."""
    begin = TEXT.index(f"[{table}]")
    place = TEXT.index(f"\n{key} = ", begin) + 1
    end = TEXT.index("\n", place)
    return f"{TEXT[:place]}{key} = {value}{TEXT[end:]}"


def scaled(table: str, key: str, factor: float) -> str:
    tables = {"vehicle": SITE.vehicles, "bridge": SITE.bridges, "sensor": (SITE.sensor,)}
    value = getattr(tables[table][0], key)
    values = [v * factor for v in value] if isinstance(value, tuple) else value * factor
    return with_value(table, key, repr(values))


def test_quantities_are_those_of_the_formulas() -> None:
    vehicle, bridge = SITE.vehicles[0], SITE.bridges[0]
    found = {one.name: one.value for one in implied_by(SITE, vehicle)}
    span, rigidity, mass = bridge.uniform()
    assert found["first_frequency"] == pytest.approx(
        (math.pi / span) ** 2 * math.sqrt(rigidity / mass) / (2 * math.pi)
    )
    force_n = 9.80665 * vehicle.total_mass_kg
    assert found["static_deflection"] * span == pytest.approx(force_n * span**3 / 48 / rigidity)
    share = vehicle.cg_to_rear_axle_m / vehicle.wheelbase_m
    front_kg = vehicle.sprung_mass_kg * share
    omega = 2 * math.pi * found["bounce_front"]
    assert omega**2 * front_kg == pytest.approx(vehicle.suspension_stiffness_n_per_m[0])
    hop = (2 * math.pi * found["hop_rear"]) ** 2 * vehicle.unsprung_mass_kg[1]
    assert hop == pytest.approx(
        vehicle.suspension_stiffness_n_per_m[1] + vehicle.tyre_stiffness_n_per_m[1]
    )
    omega = 2 * math.pi * found["first_frequency"]
    assert found["damping_ratio"] == pytest.approx(
        bridge.rayleigh_alpha_per_s / (2 * omega) + bridge.rayleigh_beta_s * omega / 2
    )


def test_known_sites_have_nothing_unusual(shared_sites: list[Path]) -> None:
    assert warnings_of(SITE) == []
    for path in (*shared_sites, ROOT / "tests/data/csv_example/site.toml"):
        if "[[vehicle.axles]]" not in path.read_text():
            assert warnings_of(load_site(path)) == [], path


SLIPS = [
    ("vehicle", "suspension_damping_ns_per_m", 1e-3, "in kN·s/m? then it is"),
    ("vehicle", "suspension_stiffness_n_per_m", 1e-3, "in kN/m? then it is"),
    ("vehicle", "tyre_stiffness_n_per_m", 1e-3, "in kN/m? then it is"),
    ("vehicle", "unsprung_mass_kg", 1e-3, "in t? then it is"),
    ("bridge", "flexural_rigidity_nm2", 1e-3, "in kN·m²? then it is"),
    ("bridge", "flexural_rigidity_nm2", 1e-6, "in MN·m²? then it is"),
    ("bridge", "mass_per_length_kg_per_m", 1e-3, "in t/m? then it is"),
    ("sensor", "noise_density_ug_per_rthz", 1e-3, "in mg/√Hz? then it is"),
    ("sensor", "noise_density_ug_per_rthz", 1e3, "in ng/√Hz? then it is"),
    ("sensor", "rate_hz", 5e-4, "in kHz? then it is"),
    ("vehicle", "tyre_stiffness_n_per_m", 1e3, "in N/m times 1000? then it is"),
    ("vehicle", "wheelbase_m", 1e3, "in mm? then it is"),
    ("vehicle", "wheelbase_m", 1e2, "in cm? then it is"),
    ("vehicle", "front_axle_to_cg_m", 1e3, "in mm? then it is"),
    ("bridge", "span_m", 1e3, "in mm? then it is"),
    ("bridge", "span_m", 1e2, "in cm? then it is"),
    ("bridge", "mass_per_length_kg_per_m", 30.0, "in kg of the whole span? then it is"),
]


@pytest.mark.parametrize(("table", "key", "factor", "words"), SLIPS)
def test_other_unit_is_an_error_or_a_warning_that_names_it(
    table: str, key: str, factor: float, words: str
) -> None:
    try:
        output = warnings_of(parse_site(scaled(table, key, factor), "site.toml"))
    except InputError as error:
        output = [str(error)]
    assert any(key in line and words in line for line in output), output


def test_damping_ratio_for_a_coefficient_is_named() -> None:
    text = with_value("bridge", "rayleigh_beta_s", "0.04")
    (line,) = warnings_of(parse_site(text, "site.toml"))
    assert "rayleigh_beta_s is 0.04: a damping ratio? then it is 0.00" in line


PAIRS = [
    ("suspension_stiffness_n_per_m", "[3.0e6, 3.0e5]"),
    ("tyre_stiffness_n_per_m", "[9.0e6, 1.0e6]"),
    ("unsprung_mass_kg", "[1100, 500]"),
    ("twin_tyre_distance_m", "[0.33, 0.0]"),
]


@pytest.mark.parametrize(("key", "value"), PAIRS)
def test_swapped_pair_is_named(key: str, value: str) -> None:
    text = TEXT
    if f"\n{key} = " not in text:
        text = text.replace("[bridge]", f"{key} = {value}\n\n[bridge]", 1)
    else:
        text = with_value("vehicle", key, value)
    lines = warnings_of(parse_site(text, "site.toml"))
    assert any(f"{key}: [front, rear] swapped?" in line for line in lines), lines


def test_springs_for_tyres_are_named() -> None:
    text = with_value("vehicle", "tyre_stiffness_n_per_m", "[5e5, 8e5]")
    begin = text.index("\nsuspension_stiffness_n_per_m = ") + 1
    end = text.index("\n", begin)
    text = f"{text[:begin]}suspension_stiffness_n_per_m = [1.8e6, 3.5e6]{text[end:]}"
    lines = warnings_of(parse_site(text, "site.toml"))
    wanted = "tyre_stiffness_n_per_m and suspension_stiffness_n_per_m swapped?"
    assert any(wanted in line for line in lines), lines


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"total_mass_kg": "17.7"}, "total_mass_kg is 17.7: in t? then it is 17700"),
        ({"rayleigh_beta_s": "2.0"}, "a damping ratio in %? then it is 0.00"),
        ({"rayleigh_alpha_per_s": "0.0005", "rayleigh_beta_s": "0.7"}, "swapped with the other"),
        ({"suspension_damping_ns_per_m": "[0.2, 0.2]"}, "in parts of critical damping? then it is"),
        ({"span_m": "30,0"}, "30,0 has a decimal comma"),
        ({"span_m": "30.0 m"}, "a number without a unit expected: 30.0"),
        ({"total_mass_kg": "17.700,0"}, "a decimal comma, or points between thousands"),
    ],
)
def test_likely_slip_is_named(changes: dict[str, str], words: str) -> None:
    text = TEXT
    for key, value in changes.items():
        begin = text.index(f"\n{key} = ") + 1
        text = f"{text[:begin]}{key} = {value}{text[text.index(chr(10), begin) :]}"
    try:
        output = warnings_of(parse_site(text, "site.toml"))
    except InputError as error:
        output = [str(error)]
    assert any(words in line for line in output), output


def test_swapped_coordinates_of_the_ends_are_named() -> None:
    text = (ROOT / "tests/data/csv_example/site.toml").read_text()
    swapped = text.replace("_latitude_", "_x_").replace("_longitude_", "_latitude_")
    with pytest.raises(InputError, match=r"latitude and longitude swapped\?$"):
        parse_site(swapped.replace("_x_", "_longitude_"), "site.toml")
    far = text.replace("start_latitude_deg = 47.0", "start_latitude_deg = 147.0")
    with pytest.raises(InputError, match=r"angle of at most 89 degrees; a longitude\?"):
        parse_site(far, "site.toml")


def test_survey_speed_in_km_per_h_is_named() -> None:
    text = TEXT.replace("[sensor]", "survey_speed_m_per_s = 50.0\n\n[sensor]", 1)
    (line,) = warnings_of(parse_site(text, "site.toml"))
    assert "survey_speed_m_per_s is 50: in km/h? then it is 13.8889" in line


def by_frequency(first_hz: float, rigidity: float) -> str:
    """The example with damping ratio and first frequency in place of the coefficients."""
    text = with_value("bridge", "flexural_rigidity_nm2", repr(rigidity))
    lines = [line for line in text.split("\n") if not line.startswith("rayleigh_")]
    where = lines.index("[bridge]") + 1
    return "\n".join(
        [
            *lines[:where],
            "damping_ratio = 0.02",
            f"first_frequency_hz = {first_hz}",
            *lines[where:],
        ]
    )


def test_declared_first_frequency_is_kept_without_a_change_of_the_hash() -> None:
    site = parse_site(by_frequency(3.29, 1.56e10), "site.toml")
    (bridge,) = site.bridges
    assert bridge.first_frequency_hz == 3.29
    bare = bridge.model_copy(update={"first_frequency_hz": None})
    assert site_hash(site) == site_hash(site.model_copy(update={"bridges": (bare,)}))
    assert SITE.bridges[0].first_frequency_hz is None


@pytest.mark.parametrize(("factor", "names_it"), [(1.0, False), (0.5, True), (2.0, True)])
def test_rigidity_that_contradicts_the_first_frequency_is_named(
    factor: float, names_it: bool
) -> None:
    text = by_frequency(3.29, factor * 1.56e10)
    lines = warnings_of(parse_site(text, "site.toml"), text)
    if not names_it:
        assert lines == []
        return
    (line,) = lines
    assert "flexural_rigidity_nm2" in line
    assert "3.29 Hz needs 1.56e+10" in line
    assert line.endswith(f", or a span_m of {30.0 * factor**0.25:.3g}")  # frequency by 1/span²


@pytest.mark.parametrize(
    ("given_hz", "state"),
    [
        (7.1, "ok"),
        (6.2, "ok"),
        (5.9, "open"),
        (5.1, "wrong"),  # restraint of bearings only raises a frequency
        (2.4, "wrong"),
        (9.0, "open"),
        (13.5, "open"),
        (20.0, "wrong"),  # both ends clamped give 11.4 Hz
    ],
)
def test_first_frequency_of_two_spans_is_compared_with_ei(given_hz: float, state: str) -> None:
    """Two spans of 14 m have the frequency of one: 7.32 Hz."""
    lines = by_frequency(given_hz, 7.5e9).split("\n")
    lines.insert(lines.index("[bridge]") + 1, "interior_supports_m = [15.0]")
    text = (
        "\n".join(lines)
        .replace("elements = 7", "elements = 6")
        .replace("mass_per_length_kg_per_m = 4400.0", "mass_per_length_kg_per_m = 6829.4")
    )
    (found,) = given_frequencies(text)
    assert f"first_frequency_hz is {given_hz:g}, EI, mass and spans imply 7.32 Hz " in found.text
    assert found.text.endswith("; damping_ratio is 0.02")
    assert ("wrong" if found.is_far else "open" if found.is_unusual else "ok") == state
    fitting = 7.5e9 * (given_hz / 7.3166) ** 2
    assert f"flexural_rigidity_nm2 is 7.5e+09; {given_hz:g} Hz needs {fitting:.3g}" in found.advice
    clamped = f"{fitting / 2.441:.3g} with clamped ends"
    assert (clamped in found.advice) == (given_hz > 7.32)
    assert found.advice.endswith(", or other spans (span_m, interior_supports_m)")
    assert bool(warnings_of(parse_site(text, "site.toml"), text)) == (state != "ok")


def test_clamped_ends_raise_the_first_frequency_as_in_the_textbook() -> None:
    bridge = SITE.bridges[0]
    free_hz = first_frequency_hz(bridge)
    assert first_frequency_hz(bridge, is_clamped=True) / free_hz == pytest.approx(
        (4.730041 / math.pi) ** 2, rel=1e-5
    )


def test_damping_ratio_for_alpha_is_named_with_the_probable_value() -> None:
    text = with_value("bridge", "rayleigh_alpha_per_s", "0.02")
    (line,) = warnings_of(parse_site(text, "site.toml"))
    first_hz = next(
        one.value for one in implied_by(SITE, SITE.vehicles[0]) if one.name == "first_frequency"
    )
    probable = 2 * 0.02 * 2 * math.pi * first_hz * 4 / 5
    assert f"a damping ratio? then it is {probable:.3g} 1/s" in line


@pytest.mark.parametrize(("cg_m", "names_it"), [(2.7, False), (1.8, True)])
def test_centre_of_gravity_measured_from_the_rear_axle_is_named(
    cg_m: float, names_it: bool
) -> None:
    truck = SITE.vehicles[0].model_copy(
        update={
            "total_mass_kg": 16000.0,
            "wheelbase_m": 4.5,
            "front_axle_to_cg_m": cg_m,
            "suspension_stiffness_n_per_m": (5e5, 1.1e6),
            "suspension_damping_ns_per_m": (2e4, 4e4),
            "unsprung_mass_kg": (700.0, 1100.0),
            "tyre_stiffness_n_per_m": (2e6, 4e6),
        }
    )
    lines = warnings_of(SITE.model_copy(update={"vehicles": (truck,)}))
    if not names_it:
        assert lines == []
        return
    (line,) = lines
    assert "measured from the rear axle? then it is 2.7" in line


def test_single_element_is_named_with_a_usual_number() -> None:
    text = with_value("bridge", "elements", "1")
    (line,) = warnings_of(parse_site(text, "site.toml"))
    assert "elements is 1: 7 are typical here" in line


def test_masses_in_tonnes_are_named_and_no_spring_is_blamed() -> None:
    text = TEXT
    for key, values in (
        ("total_mass_kg", SITE.vehicles[0].total_mass_kg),
        ("unsprung_mass_kg", list(SITE.vehicles[0].unsprung_mass_kg)),
    ):
        less = [v / 1e3 for v in values] if isinstance(values, list) else values / 1e3
        begin = text.index(f"\n{key} = ") + 1
        text = f"{text[:begin]}{key} = {less}{text[text.index(chr(10), begin) :]}"
    lines = warnings_of(parse_site(text, "site.toml"))
    assert any(f"in t? then it is {SITE.vehicles[0].total_mass_kg:g}" in line for line in lines)
    assert any("unsprung_mass_kg[0] is" in line and "in t?" in line for line in lines), lines
    assert not [line for line in lines if "stiffness_n_per_m[" in line], lines


@pytest.mark.parametrize(
    ("ratio", "words"),
    [
        (
            "2",
            "damping_ratio is 2, it must be a damping ratio of at most 0.5; in %? then it is 0.02",
        ),
        ("0.5", "damping_ratio is 0.5: in %? then it is 0.005"),
        ("0.0003", "check units and values"),
    ],
)
def test_damping_ratio_in_per_cent_is_named_by_its_own_key(ratio: str, words: str) -> None:
    text = by_frequency(3.29, 1.56e10).replace("damping_ratio = 0.02", f"damping_ratio = {ratio}")
    try:
        (line,) = warnings_of(parse_site(text, "site.toml"))
    except InputError as error:
        line = str(error)
    assert words in line
    assert "rayleigh" not in line
