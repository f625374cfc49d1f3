"""The site file: what is accepted, what it means, and what is said of what is not."""

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from schemas.errors import InputError
from schemas.signals import MAX_RATE_HZ
from schemas.site import Bridge, Site
from schemas.site_damping import rayleigh_of
from schemas.site_file import (
    load_site,
    parse_site,
    read_site_text,
    site_hash,
    site_toml,
    vehicle_toml,
    with_values,
)

EXAMPLE = Path(__file__).parents[3] / "docs" / "site.example.toml"
TEXT = (Path(__file__).parents[2] / "data" / "csv_example" / "site.toml").read_text()
VEHICLE = TEXT[TEXT.index("[vehicle]") : TEXT.index("[bridge]")]
BRIDGE = TEXT[TEXT.index("[bridge]") : TEXT.index("[sensor]")]
SENSOR = TEXT[TEXT.index("[sensor]") :]


def with_line(key: str, value: str, text: str = TEXT) -> str:
    """Replace the value of a key where it comes first, or drop the line if the value is empty."""
    lines = text.splitlines()
    index = next(i for i, line in enumerate(lines) if line.startswith(f"{key} ="))
    lines[index] = f"{key} = {value}" if value else ""
    return "\n".join(lines)


def complaint(text: str) -> str:
    with pytest.raises(InputError) as caught:
        parse_site(text, "site.toml")
    line = str(caught.value)
    assert line.startswith("site.toml: ")
    assert "\n" not in line
    return line.removeprefix("site.toml: ")


def parsed(text: str) -> Site | str:
    try:
        return parse_site(text, "site.toml")
    except InputError as error:
        return str(error)


def test_defaults_are_those_of_the_contract() -> None:
    site = parse_site(TEXT, "site.toml")
    vehicle, bridge, sensor = site.vehicles[0], site.bridges[0], site.sensor
    assert vehicle.spread("total_mass_kg") == 0.01
    assert vehicle.spread("wheelbase_m") == 0.002
    for key in ("front_axle_to_cg_m", "tyre_stiffness_n_per_m", "unsprung_mass_kg"):
        assert vehicle.spread(key) == 0.15
    assert vehicle.pitch_inertia_ratio == 1
    assert vehicle.tyre_damping_ns_per_m == (0, 0)
    assert vehicle.cg_height_m is None
    assert bridge.spread("flexural_rigidity_nm2") == 0.55
    assert bridge.spread("mass_per_length_kg_per_m") == 0.1
    assert bridge.spread("rayleigh_alpha_per_s") == 0.5
    assert bridge.spread("rayleigh_beta_s") == 0.5
    assert bridge.nominal_flexural_rigidity_nm2 == (1.2e10,) * 5
    assert bridge.lengths_m == (4.0,) * 5
    assert bridge.support_rotational_stiffness_nm_per_rad_scale_at_zero == 1.2e10 / 20
    assert sensor.rate_hz == (100, 100, 100, 100)
    assert sensor.noise_density_ug_per_rthz == (25, 25, 25, 25)
    assert (sensor.gravity_included, sensor.up) == (False, (1, 1, 1, 1))
    assert (sensor.gain_spread, sensor.delay_spread_s, sensor.common_gain_spread) == (
        0.01,
        0.0005,
        0.01,
    )
    assert site.receiver.model_dump() == {
        "position_spread_m": 1.5,
        "position_noise_m": 0.4,
        "speed_noise_m_per_s": 0.07,
        "latency_s": 0.0,
        "latency_spread_s": 0.1,
    }


def test_optional_values_are_read() -> None:
    text = (
        VEHICLE
        + "cg_height_m = 1.1\npitch_inertia_ratio = 0.9\ntyre_damping_ns_per_m = [100, 200]\n"
        + "wheelbase_m_spread = 0.02\n"
        + with_line("flexural_rigidity_nm2", "", BRIDGE)
        + "\nflexural_rigidity_per_element_nm2 = [1e10, 2e10, 3e10, 4e10, 5e10]\n"
        + "element_lengths_m = [2, 3, 4, 5, 6]\nbaseline = 'before.json'\n"
        + "support_rotational_stiffness_spread_nm_per_rad = 5e8\n"
        + "[sensor]\nrate_hz = [100, 200, 400, 800]\nnoise_density_ug_per_rthz = [1, 2, 3, 4]\n"
        + "gravity_included = true\nup = [1, 1, -1, -1]\n"
        + "[receiver]\nlatency_s = 0.2\n"
    )
    site = parse_site(text, "site.toml")
    assert site.vehicles[0].tyre_damping_ns_per_m == (100, 200)
    assert site.vehicles[0].spread("wheelbase_m") == 0.02
    bridge = site.bridges[0]
    assert bridge.nominal_flexural_rigidity_nm2 == (1e10, 2e10, 3e10, 4e10, 5e10)
    assert bridge.lengths_m == (2, 3, 4, 5, 6)
    assert bridge.support_rotational_stiffness_nm_per_rad_scale_at_zero == 5e8
    assert site.sensor.rate_hz == (100, 200, 400, 800)
    assert site.sensor.up == (1, 1, -1, -1)
    assert site.receiver.latency_s == 0.2


def with_supports(supports: str, elements: int, more: str = "") -> str:
    """The example's bridge of 20 m with supports between its ends."""
    bridge = with_line("elements", str(elements), BRIDGE)
    return f"{VEHICLE}\n{bridge}\ninterior_supports_m = {supports}\n{more}\n{SENSOR}"


@pytest.mark.parametrize(
    ("supports", "elements", "shares"),
    [
        ([10.0], 8, [4, 4]),
        ([12.0], 5, [3, 2]),  # 3, 2
        ([7.0], 6, [2, 4]),  # 2.1, 3.9: the larger remainder is the second's
        ([4.0, 9.0], 7, [1, 2, 4]),  # 1.4, 1.75, 3.85
        ([1.0, 2.0], 4, [1, 1, 2]),  # 0.2, 0.2, 3.6: at least one each
        ([1.0, 2.0], 3, [1, 1, 1]),
        ([], 5, [5]),
    ],
)
def test_elements_are_shared_among_the_spans(
    supports: list[float], elements: int, shares: list[int]
) -> None:
    bridge = parse_site(with_supports(str(supports), elements), "site.toml").bridges[0]
    edges = [0.0, *supports, 20.0]
    lengths = [
        (after - before) / share
        for before, after, share in zip(edges, edges[1:], shares, strict=False)
        for _ in range(share)
    ]
    assert bridge.lengths_m == pytest.approx(lengths)
    nodes = bridge.interior_support_nodes
    assert list(nodes) == [sum(shares[: k + 1]) for k in range(len(supports))]
    assert [math.fsum(bridge.lengths_m[:node]) for node in nodes] == pytest.approx(supports)


def test_given_elements_end_at_the_supports() -> None:
    lengths = "element_lengths_m = [3, 4.005, 5, 8]"
    bridge = parse_site(with_supports("[7, 12]", 4, lengths), "site.toml").bridges[0]
    assert bridge.lengths_m == (3, 4.005, 5, 8)
    assert bridge.interior_support_nodes == (2, 3)
    assert complaint(with_supports("[7, 13]", 4, lengths)) == (
        "bridge.element_lengths_m has no element that ends at 13 m, one must end at every "
        "interior support; the nearest ends at 12.005 m"
    )


@pytest.mark.parametrize(
    ("supports", "line"),
    [
        (
            "[12, 8]",
            (
                "bridge.interior_supports_m[1] is 8, it must be a chainage beyond 12 m: supports "
                "between the ends are given from the start on"
            ),
        ),
        (
            "[8, 20]",
            "bridge.interior_supports_m[1] is 20, it must be a chainage between 0 and span_m, 20 m",
        ),
        ("[0]", "bridge.interior_supports_m[0] is 0, it must be a length greater than 0 m"),
        ("8", "bridge.interior_supports_m is 8, it must be a list of chainages in m"),
        ("[3, 6, 9, 12, 15]", "bridge.elements is 5, it must be at least 6, one for each span"),
    ],
)
def test_supports_that_cannot_be(supports: str, line: str) -> None:
    assert complaint(with_supports(supports, 5)) == line


def test_bearings_altitudes_and_what_is_for_planning() -> None:
    def bridge(more: str) -> Bridge:
        return parse_site(with_supports("[]", 5, more), "site.toml").bridges[0]

    assert bridge("").bearings == ("unknown", "unknown")
    assert bridge('bearings = "free"').bearings == ("free", "free")
    assert bridge('bearings = ["sprung", "unknown"]').bearings == ("sprung", "unknown")
    known = bridge(
        'start_altitude_m = 12.5\nend_altitude_m = -3\nowner_id = "A 7/113"\nroad_class = "C"\n'
        "survey_speed_m_per_s = 12"
    )
    assert (known.start_altitude_m, known.end_altitude_m) == (12.5, -3)
    assert (known.owner_id, known.road_class, known.survey_speed_m_per_s) == ("A 7/113", "C", 12)
    either = '"unknown", "free" or "sprung"'
    for value, line in (
        ('bearings = "loose"', f'bearings is "loose", it must be {either}, or a pair [start, end]'),
        ('bearings = ["free", "rigid"]', f'bearings[1] is "rigid", it must be {either}'),
        ('bearings = ["free"]', "bearings[1] is missing"),
        ('road_class = "F"', 'road_class is "F", it must be an ISO 8608 class, "A" to "E"'),
        ("survey_speed_m_per_s = 0", "survey_speed_m_per_s is 0, it must be a speed greater than"),
        ("start_altitude_m = 1e5", "start_altitude_m is 100000.0, it must be a length of at most"),
    ):
        assert complaint(with_supports("[]", 5, value)).startswith(f"bridge.{line}")


def test_scale_of_support_springs_is_that_of_a_span() -> None:
    bridge = parse_site(with_supports("[12]", 5), "site.toml").bridges[0]
    assert bridge.support_rotational_stiffness_nm_per_rad_scale_at_zero == 1.2e10 / 10


def test_lists_of_vehicles_and_bridges() -> None:
    def listed(table: str) -> str:
        return "[" + table.replace("]", "]]", 1)

    second_vehicle = listed(VEHICLE).replace("truck-x", "truck-y")
    second_bridge = listed(BRIDGE).replace("bridge-x", "bridge-y")
    text = listed(VEHICLE) + second_vehicle + listed(BRIDGE) + second_bridge + SENSOR
    site = parse_site(text, "site.toml")
    assert [v.id for v in site.vehicles] == ["truck-x", "truck-y"]
    assert site.vehicle("truck-y") == site.vehicles[1]
    assert site.bridge("bridge-y") == site.bridges[1]
    with pytest.raises(KeyError):
        site.bridge("bridge-z")
    twice = text.replace("truck-y", "truck-x")
    assert complaint(twice) == 'vehicle[1].id is "truck-x" again, ids must be unique'
    negative = text.replace("9000.0", "-9000.0", 1)
    assert complaint(negative).startswith("vehicle[0].total_mass_kg is -9000.0, it must be a mass ")


def test_one_table_in_a_list_is_the_same_site() -> None:
    listed = TEXT.replace("[vehicle]", "[[vehicle]]").replace("[bridge]", "[[bridge]]")
    assert parse_site(listed, "a") == parse_site(TEXT, "b")


@pytest.mark.parametrize(
    ("key", "value", "line"),
    [
        (
            "total_mass_kg",
            "-9530.0",
            "vehicle.total_mass_kg is -9530.0, it must be a mass greater than 0 kg",
        ),
        (
            "total_mass_kg",
            "nan",
            "vehicle.total_mass_kg is NaN (not filled in), it must be a mass in kg",
        ),
        ("total_mass_kg", "inf", "vehicle.total_mass_kg is Infinity, it must be a mass in kg"),
        ("total_mass_kg", '"9 t"', 'vehicle.total_mass_kg is "9 t", it must be a mass in kg'),
        ("total_mass_kg", "true", "vehicle.total_mass_kg is true, it must be a mass in kg"),
        ("total_mass_kg", "1000", "vehicle.unsprung_mass_kg adds up to 1200.0, it must be a mass"),
        ("wheelbase_m", "", "vehicle.wheelbase_m is missing, it must be a length in m"),
        ("front_axle_to_cg_m", "4.0", "vehicle.front_axle_to_cg_m is 4.0, it must be a length les"),
        ("unsprung_mass_kg", "450.0", "vehicle.unsprung_mass_kg is 450.0, it must be a pair"),
        ("unsprung_mass_kg", "[1, 2, 3]", "vehicle.unsprung_mass_kg is [1, 2, 3], it must be a pa"),
        ("unsprung_mass_kg", "[0, 2]", "vehicle.unsprung_mass_kg[0] is 0, it must be a mass great"),
        ("id", '"Truck X"', 'vehicle.id is "Truck X", it must be an identifier of a-z, 0-9'),
        ("id", '"-x"', 'vehicle.id is "-x", it must be an identifier'),
        ("id", '"x\\n"', 'vehicle.id is "x\\n", it must be an identifier'),
        ("span_m", "0", "bridge.span_m is 0, it must be a length greater than 0 m"),
        ("span_m", "30", "bridge.span_m is 30 but the ends are 20.0 m apart"),
        ("end_longitude_deg", "8.0", "bridge.end_latitude_deg and end_longitude_deg are the star"),
        (
            "end_longitude_deg",
            "188.0",
            "bridge.end_longitude_deg is 188.0, it must be an angle of ",
        ),
        ("elements", "7.5", "bridge.elements is 7.5, it must be a whole number"),
        ("elements", "0", "bridge.elements is 0, it must be a whole number of at least 1"),
        ("elements", "31", "bridge.elements is 31, it must be a whole number of at most 30"),
        ("elements", "5\nelement_lengths_m = [10, 10]", "bridge.element_lengths_m has 2 values"),
        (
            "elements",
            "5\nelement_lengths_m = [4, 4, 4, 4, 5]",
            "bridge.element_lengths_m adds up to 21 m",
        ),
        (
            "elements",
            "5\nflexural_rigidity_per_element_nm2 = [1e10]",
            "bridge.flexural_rigidity_per_element_nm2 has 1 values",
        ),
        (
            "flexural_rigidity_nm2",
            "",
            "bridge.flexural_rigidity_nm2 is missing, give the undamaged",
        ),
        ("rayleigh_beta_s", "-0.1", "bridge.rayleigh_beta_s is -0.1, it must be a time of at lea"),
        ("rate_hz", "[1, 2]", "sensor.rate_hz"),
        ("rate_hz", "0", "sensor.rate_hz is 0, it must be a rate of at least 1 Hz"),
        ("rate_hz", "100\nup = [1, 1, 1, 0]", "sensor.up[3] is 0, it must be 1 or -1"),
        ("rate_hz", "100\ngravity_included = 1", "sensor.gravity_included is 1, it must be true"),
        ("rate_hz", "100\nrate_khz = 1", "sensor.rate_khz is not a known field, did you mean rate"),
        ("rate_hz", "100\n[colour]\nx = 1", "colour is not a known field, check its spelling"),
        ("noise_density_ug_per_rthz", "5\n[receiver]\nlatency_s = 'x'", "receiver.latency_s is"),
        (
            "elements",
            "5\nrate_hz = 100",
            "bridge.rate_hz is not a known field, it belongs into [",
        ),
        ("wheelbase_m", "4.0\nwheelbase_m_spread = -1", "vehicle.wheelbase_m_spread is -1, it mus"),
        ("wheelbase_m", "=", "line 5, column 15: is not TOML: "),
        ("wheelbase_m", "4.0\nwheelbase_m = 4.0", "line 6, column 18: is not TOML: "),
    ],
)
def test_one_line_names_the_field_and_what_would_be_right(key: str, value: str, line: str) -> None:
    assert complaint(with_line(key, value)).startswith(line)


def test_a_missing_table_and_a_text_that_is_no_toml() -> None:
    assert complaint(VEHICLE + BRIDGE) == "the table [sensor] is missing"
    assert complaint("").startswith(
        "the table [vehicle] is missing (and 2 more, driveby check lists them)"
    )
    assert complaint("vehicle = 3").startswith("vehicle is 3, it must be a table [vehicle]")
    assert complaint("[vehicle]\nid = '").startswith("line 2: is not TOML: ")


def test_other_mistakes_are_counted() -> None:
    text = with_line("wheelbase_m", "-4", with_line("total_mass_kg", "-9"))
    assert complaint(text).endswith("(and 1 more, driveby check lists them)")


def test_a_missing_or_unreadable_file(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"none\.toml: no such file"):
        load_site(tmp_path / "none.toml")
    with pytest.raises(InputError, match="cannot be read"):
        load_site(tmp_path)
    (tmp_path / "latin.toml").write_bytes("# Brücke\n".encode("latin-1"))
    with pytest.raises(InputError, match="is not UTF-8 text"):
        read_site_text(tmp_path / "latin.toml")


def test_the_sites_of_the_independent_crossings_are_read(shared_sites: list[Path]) -> None:
    for path in shared_sites:
        bridge = load_site(path).bridges[0]
        # Coordinates are given to 1e-8 degrees, 1.1 mm: each end is off by up to 0.8 mm.
        assert math.isclose(bridge.ends_distance_m, bridge.span_m, rel_tol=0, abs_tol=1.6e-3)


def test_the_hash_is_of_the_values_not_of_the_layout() -> None:
    plain = site_hash(parse_site(TEXT, "a"))
    assert len(plain) == 16
    assert int(plain, 16) >= 0
    assert site_hash(parse_site(SENSOR + "# moved\n" + BRIDGE + VEHICLE, "b")) == plain
    assert site_hash(parse_site(with_line("total_mass_kg", "9_000"), "c")) == plain
    assert site_hash(parse_site(with_line("total_mass_kg", "9000.0001"), "d")) != plain


def test_what_a_truck_says_of_itself_leaves_out_the_bridges() -> None:
    site = parse_site(TEXT, "a")
    toml = vehicle_toml(site, "truck-x")
    assert "bridge" not in toml
    assert parse_site(toml + BRIDGE, "b") == site


small = st.floats(0, 10)


@st.composite
def sites(draw: st.DrawFn) -> Site:
    wheelbase = draw(st.floats(1, 20))
    unsprung = draw(st.tuples(st.floats(10, 1e3), st.floats(10, 1e3)))
    span = draw(st.floats(5, 200))
    elements = draw(st.integers(1, 30))
    sprung = min(unsprung) * draw(st.floats(1, 300))
    spring = st.floats(0.1, 10).map(lambda hz: 0.01 * sprung * (2 * math.pi * 10 * hz) ** 2)
    tyre = st.floats(1, 10).map(lambda hz: sprung * (2 * math.pi * hz) ** 2)
    mass = draw(st.floats(1, 1e5))
    rigidity = st.floats(2, 1000).map(lambda share: share * mass * span**3)
    vehicle = {
        "id": draw(st.from_regex(r"[a-z0-9][a-z0-9_-]{0,62}", fullmatch=True)),
        "total_mass_kg": sum(unsprung) + sprung,
        "wheelbase_m": wheelbase,
        "front_axle_to_cg_m": wheelbase * draw(st.floats(0.02, 0.98)),
        "suspension_damping_ns_per_m": draw(st.tuples(small, small)),
        "suspension_stiffness_n_per_m": draw(st.tuples(spring, spring)),
        "unsprung_mass_kg": unsprung,
        "tyre_stiffness_n_per_m": draw(st.tuples(tyre, tyre)),
        "gps_antenna_to_front_axle_m": draw(st.floats(-50, 50)),
        "cg_height_m": draw(st.none() | st.floats(0.1, 5)),
    }
    latitude = draw(st.floats(-80, 80))
    bridge = {
        "id": "b",
        "span_m": span,
        "start_latitude_deg": latitude,
        "start_longitude_deg": 8.0,
        "end_latitude_deg": latitude + span / 111_132,
        "end_longitude_deg": 8.0,
        "elements": elements,
        "flexural_rigidity_nm2": draw(rigidity),
        "flexural_rigidity_per_element_nm2": draw(
            st.none() | st.lists(rigidity, min_size=elements, max_size=elements)
        ),
        "mass_per_length_kg_per_m": mass,
        "rayleigh_alpha_per_s": draw(st.floats(0, 0.5)),
        "rayleigh_beta_s": draw(st.floats(0, 0.001)),
        "baseline": draw(st.none() | st.text(min_size=1, max_size=20)),
    }
    sensor = {
        "rate_hz": draw(st.floats(10, 1e4)),
        "noise_density_ug_per_rthz": draw(st.lists(st.floats(0, 1e3), min_size=4, max_size=4)),
        "up": draw(st.lists(st.sampled_from([1, -1]), min_size=4, max_size=4)),
    }
    return Site.model_validate({"vehicle": [vehicle], "bridge": [bridge], "sensor": sensor})


def test_writing_escapes_what_toml_forbids() -> None:
    site = parse_site(with_line("elements", '5\nbaseline = "a\\u007f\\u0000\\n\\"ü𝕏"'), "a")
    assert site.bridges[0].baseline == 'a\x7f\0\n"ü𝕏'
    assert parse_site(site_toml(site), "b") == site


@given(sites())
def test_writing_and_reading_gives_the_same_site(site: Site) -> None:
    again = parse_site(site_toml(site), "again")
    assert again == site
    assert site_hash(again) == site_hash(site)


@given(st.text(max_size=200))
@example("a = 1979-13-01")
@example("[" * 5000)
def test_any_text_is_a_site_or_one_line(text: str) -> None:
    outcome = parsed(text)
    if isinstance(outcome, str):
        assert outcome.startswith("site.toml: ")
        assert len(outcome.splitlines()) == 1


scalars = (
    st.floats(width=64).map(repr)
    | st.integers().map(str)
    | st.sampled_from(['"x"', "true", "1979-05-27", "[]", "{}", "[[1]]", '["a", "b"]', "{a = 1}"])
    | st.lists(st.floats().map(repr), max_size=6).map(lambda parts: f"[{', '.join(parts)}]")
)
keys = [
    line.split(" = ")[0] for line in TEXT.splitlines() if " = " in line and "id" not in line[:3]
]


@given(st.sampled_from(keys), scalars)
def test_any_value_of_any_field_is_accepted_or_named(key: str, value: str) -> None:
    site = parsed(with_line(key, value))
    if isinstance(site, str):
        assert len(site.splitlines()) == 1
        assert len(site) < 400
        assert any(name in site for name in keys)
    else:
        numbers = [
            number
            for table in (site.vehicles[0], site.bridges[0], site.sensor)
            for field in table.model_dump().values()
            for number in (field if isinstance(field, tuple) else (field,))
            if isinstance(number, float)
        ]
        assert all(map(math.isfinite, numbers))


def test_what_the_site_allows_can_be_sent() -> None:
    """The wire takes 50 kHz: a site file that says more would promise what no message can hold."""
    assert complaint(with_line("rate_hz", "50001")).startswith("sensor.rate_hz")
    rates = parse_site(with_line("rate_hz", "50000"), "a").sensor.rate_hz
    assert rates[0] == MAX_RATE_HZ


ROS2 = """
[ros2]
vehicle = "truck-1"
gnss = "/gps/fix"
velocity = "/gps/vel"
[ros2.imu]
sprung_front = { topic = "/imu/front", axis = "-z", frame = "front \\"left\\"" }
unsprung_rear = { topic = "/imu/axle", gravity_included = false }
"""


def with_ros2(old: str = "", new: str = "") -> str:
    text = ROS2.replace("truck-1", parse_site(TEXT, "site.toml").vehicles[0].id)
    assert old in text
    return TEXT + text.replace(old, new)


def test_topics_of_ros_are_read_and_written_and_are_no_part_of_the_hash() -> None:
    site = parse_site(with_ros2(), "site.toml")
    (ros2,) = site.ros2
    assert (ros2.domain, ros2.largest_delay_s, ros2.velocity) == (0, 1.0, "/gps/vel")
    imus = ros2.imu.by_channel()
    assert list(imus) == ["sprung_front", "unsprung_rear"]
    front, rear = imus.values()
    assert (front.axis, front.gravity_included, front.frame) == ("-z", True, 'front "left"')
    assert (rear.axis, rear.gravity_included, rear.frame) == ("z", False, None)
    assert ros2.topics() == ["/imu/front", "/imu/axle", "/gps/fix", "/gps/vel"]
    assert parse_site(site_toml(site), "again") == site
    without = parse_site(TEXT, "site.toml")
    assert site_hash(site) == site_hash(without)
    vehicle = site.vehicles[0].id
    assert vehicle_toml(site, vehicle) == vehicle_toml(without, vehicle)


def test_name_of_imports_is_read_and_written_and_is_no_part_of_the_hash() -> None:
    site = parse_site(TEXT + '[import]\nname = "isar"\n', "site.toml")
    assert site.imports is not None
    assert site.imports.name == "isar"
    assert parse_site(site_toml(site), "again") == site
    without = parse_site(TEXT, "site.toml")
    assert without.imports is None
    assert site_hash(site) == site_hash(without)
    vehicle = site.vehicles[0].id
    assert vehicle_toml(site, vehicle) == vehicle_toml(without, vehicle)


def test_several_trucks_have_a_table_of_ros_each() -> None:
    first = VEHICLE.replace("[vehicle]", "[[vehicle]]")
    identifier = parse_site(TEXT, "site.toml").vehicles[0].id
    second = first.replace(identifier, "other")
    one = ROS2.replace("[ros2", "[[ros2", 1).replace("]", "]]", 1)
    tables = one.replace("truck-1", identifier) + one.replace("truck-1", "other")
    site = parse_site(first + second + BRIDGE + SENSOR + tables, "site.toml")
    assert [table.vehicle for table in site.ros2] == [identifier, "other"]
    assert parse_site(site_toml(site), "again") == site


@pytest.mark.parametrize(
    ("old", "new", "line"),
    [
        ('"/imu/front"', '"imu/front"', 'ros2.imu.sprung_front.topic is "imu/front", it must be'),
        ('"/gps/fix"', "7", "ros2.gnss is 7, it must be the whole name of a topic of ROS"),
        ('"-z"', '"up"', 'ros2.imu.sprung_front.axis is "up", it must be "x", "y" or "z"'),
        ("sprung_front", "sprung_middle", "ros2.imu.sprung_middle is not a known field"),
        ('"/imu/axle"', '"/gps/vel"', 'ros2 has the topic "/gps/vel" twice'),
        ("gnss =", "gps =", "ros2.gps is not a known field"),
        ("[ros2]", "[ros2]\ndomain = 300", "ros2.domain is 300"),
        ("false", '"no"', 'ros2.imu.unsprung_rear.gravity_included is "no"'),
    ],
)  # fmt: skip
def test_what_is_wrong_with_topics_of_ros_is_named(old: str, new: str, line: str) -> None:
    assert complaint(with_ros2(old, new)).startswith(line)


def test_a_table_of_ros_is_of_a_vehicle_and_has_a_channel() -> None:
    assert complaint(TEXT + ROS2.replace("truck-1", "nobody")).startswith(
        'ros2.vehicle is "nobody", it must be one of '
    )
    head = with_ros2()[: with_ros2().index("[ros2.imu]")]
    assert complaint(head).startswith("ros2.imu is missing")
    assert complaint(head + "[ros2.imu]\n").startswith("ros2.imu names no channel")


def test_values_are_replaced_by_name() -> None:
    site = load_site(EXAMPLE)
    changed = with_values(
        site,
        {
            "bridge.mass_per_length_kg_per_m_spread": 0.03,
            "truck-1.unsprung_mass_kg": np.array([500.0, 800.0]),
            "sensor.gain_spread": 0.02,
        },
    )
    assert changed.bridges[0].mass_per_length_kg_per_m_spread == 0.03
    assert changed.vehicles[0].unsprung_mass_kg == (500.0, 800.0)
    assert changed.sensor.gain_spread == 0.02
    restored = {"bridge.mass_per_length_kg_per_m_spread": None, "sensor.gain_spread": None}
    again = with_values(changed, restored | {"vehicle.unsprung_mass_kg": (469.0, 751.0)})
    assert again == site


@pytest.mark.parametrize(
    ("name", "value", "line"),
    [
        (
            "bridge.mass_per_lenght_kg_per_m",
            1.0,
            "the site: bridge.mass_per_lenght_kg_per_m is not a known field, did you mean mass",
        ),
        ("bridge.spann_m", None, "the site: bridge.spann_m is not a known field"),
        ("bridge-1.spann_m", None, "the site: bridge.spann_m is not a known field"),
        (
            "vehicle.total_mass_kg",
            -1.0,
            "the site: vehicle.total_mass_kg is -1.0, it must be a mass greater than 0 kg",
        ),
        (
            "truck.total_mass_kg",
            1.0,
            "truck.total_mass_kg: is unknown, it must be TABLE.KEY of a table of ",
        ),
        ("total_mass_kg", 1.0, "total_mass_kg: is unknown, it must be TABLE.KEY"),
    ],
)
def test_misspelt_value_is_one_line(name: str, value: object, line: str) -> None:
    with pytest.raises(InputError) as caught:
        with_values(load_site(EXAMPLE), {name: value})
    assert str(caught.value).startswith(line)
    assert "\n" not in str(caught.value)


def test_densities_are_a_number_or_a_list_of_four() -> None:
    site = parse_site(TEXT, "site.toml")
    with pytest.raises(InputError, match=r'is "25", it must be a number, or a list of four in'):
        with_values(site, {"sensor.noise_density_ug_per_rthz": "25"})


def test_damping_ratio_replaces_the_coefficients_of_a_loaded_site() -> None:
    """Its two keys suffice: the coefficients are what a site keeps of them."""
    site = load_site(EXAMPLE)
    values = {"bridge.damping_ratio": 0.02, "bridge.first_frequency_hz": 3.0}
    (bridge,) = with_values(site, values).bridges
    alpha, beta = rayleigh_of(0.02, 3.0)
    assert (bridge.rayleigh_alpha_per_s, bridge.rayleigh_beta_s) == (alpha, beta)
    with pytest.raises(InputError, match="given together with damping_ratio"):
        with_values(site, {**values, "bridge.rayleigh_beta_s": 1e-3})
    with pytest.raises(InputError, match="first_frequency_hz is missing"):
        with_values(site, {"bridge.damping_ratio": 0.02})
