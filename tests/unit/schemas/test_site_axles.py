"""`[[vehicle.axles]]`: two become pairs, more are refused in one line."""

from math import hypot
from pathlib import Path

import pytest

from schemas.errors import InputError
from schemas.site import Vehicle
from schemas.site_file import faults_of_site, load_site, parse_site, site_hash, site_toml
from schemas.vehicle_info import differences, own_part
from services.identification.footprints import footprints_of

TEXT = (Path(__file__).parents[2] / "data" / "csv_example" / "site.toml").read_text()
BEHIND = TEXT[TEXT.index("[bridge]") :]
HEAD = """\
[vehicle]
id = "truck-x"
gps_antenna_to_front_axle_m = 0.5
total_mass_kg = 16000
"""
FRONT = """\
[[vehicle.axles]]
position_m = 0.0
load_kg = 6000
unsprung_mass_kg = 600
suspension_stiffness_n_per_m = 3.0e5
suspension_damping_ns_per_m = 20000
tyre_stiffness_n_per_m = 2.0e6
"""
REAR = """\
[[vehicle.axles]]
position_m = 5.0
load_kg = 10000
unsprung_mass_kg = 1100
suspension_stiffness_n_per_m = 8.0e5
suspension_damping_ns_per_m = 40000
tyre_stiffness_n_per_m = 4.0e6
"""


def vehicle_of(*parts: str) -> Vehicle:
    return parse_site("".join(parts) + BEHIND, "site.toml").vehicles[0]


def complaint(*parts: str) -> str:
    with pytest.raises(InputError) as caught:
        parse_site("".join(parts) + BEHIND, "site.toml")
    line = str(caught.value)
    assert "\n" not in line
    return line.removeprefix("site.toml: ")


def test_two_axles_are_pairs() -> None:
    vehicle = vehicle_of(HEAD, FRONT, REAR)
    assert vehicle.wheelbase_m == 5.0
    assert vehicle.unsprung_mass_kg == (600.0, 1100.0)
    assert vehicle.suspension_stiffness_n_per_m == (3.0e5, 8.0e5)
    assert vehicle.suspension_damping_ns_per_m == (20000.0, 40000.0)
    assert vehicle.tyre_stiffness_n_per_m == (2.0e6, 4.0e6)
    assert vehicle.tyre_damping_ns_per_m == (0.0, 0.0)
    # 16 t, of it 14.3 t sprung, 8.9 t of that on the rear axle.
    assert vehicle.front_axle_to_cg_m == pytest.approx(5.0 * 8900 / 14300)
    assert vehicle.twin_tyre_distance_m is vehicle.track_m is vehicle.rear_axle_offset_m is None
    assert vehicle.channels == ("sprung_front", "sprung_rear", "unsprung_front", "unsprung_rear")


def test_the_spread_of_the_centre_of_gravity_is_that_of_the_loads() -> None:
    of_load = 10000 * 0.375 * hypot(0.02, 0.02) / 8900
    of_axles = (0.15 * 1100 * (1 / 8900 - 1 / 14300), 0.15 * 600 / 14300)
    spread = vehicle_of(HEAD, FRONT, REAR).spread("front_axle_to_cg_m")
    assert spread == pytest.approx(hypot(of_load, *of_axles))
    told = vehicle_of(HEAD, "front_axle_to_cg_m_spread = 0.3\n", FRONT, REAR)
    assert told.spread("front_axle_to_cg_m") == 0.3
    rough = vehicle_of(HEAD, FRONT + "load_kg_spread = 0.1\n", REAR)
    assert rough.spread("front_axle_to_cg_m") > 2.0 * spread


@pytest.mark.parametrize(("front", "rear"), [("load_kg = 6000\n", ""), ("", "load_kg = 10000\n")])
def test_one_load_places_the_centre_of_gravity(front: str, rear: str) -> None:
    axles = (FRONT.replace("load_kg = 6000\n", front), REAR.replace("load_kg = 10000\n", rear))
    vehicle = vehicle_of(HEAD, *axles)
    assert vehicle.front_axle_to_cg_m == pytest.approx(5.0 * 8900 / 14300)
    assert 0.01 < vehicle.spread("front_axle_to_cg_m") < 0.05


def test_loads_are_scaled_to_the_total_mass() -> None:
    vehicle = vehicle_of(
        HEAD, FRONT.replace("6000", "6120"), REAR.replace("load_kg = 10000", "load_kg = 10200")
    )
    assert vehicle.front_axle_to_cg_m == pytest.approx(5.0 * 8900 / 14300)


@pytest.mark.parametrize(
    ("front", "rear", "tyres"),
    [
        ('tyres = "single"\n', 'tyres = "twin"\n', ((0.25, 0.22), (0.0, 0.33), (0.2, 0.2))),
        ('tyres = "wide"\n', 'tyres = "single"\n', ((0.4, 0.25), (0.0, 0.0), (0.2, 0.2))),
        ("", 'tyres = "single"\n', ((0.25, 0.25), (0.0, 0.0), (0.2, 0.2))),
        ('tyres = "single"\n', "", ((0.25, 0.22), (0.0, 0.33), (0.2, 0.2))),
        ("", "twin_tyre_distance_m = 0.0\n", ((0.25, 0.25), (0.0, 0.0), (0.2, 0.2))),
        (
            'tyres = "single"\ntyre_width_m = 0.3\n',
            'tyres = "twin"\ntwin_tyre_distance_m = 0.35\ntyre_contact_length_m = 0.25\n',
            ((0.3, 0.22), (0.0, 0.35), (0.2, 0.25)),
        ),
    ],
)
def test_kinds_of_tyres_have_defaults(
    front: str, rear: str, tyres: tuple[tuple[float, float], ...]
) -> None:
    vehicle = vehicle_of(HEAD, FRONT + front, REAR + rear)
    assert (
        vehicle.tyre_width_m,
        vehicle.twin_tyre_distance_m,
        vehicle.tyre_contact_length_m,
    ) == tyres


def test_tracks_and_offsets_are_of_each_axle() -> None:
    vehicle = vehicle_of(
        HEAD,
        "track_m = 1.9\n",
        FRONT + "track_m = 2.05\nlateral_offset_m = 0.01\n",
        REAR + "lateral_offset_m = 0.03\n",
    )
    assert vehicle.track_m == (2.05, 1.9)
    assert vehicle.rear_axle_offset_m == pytest.approx(0.02)
    front, rear = footprints_of(vehicle)
    assert (front.track_m, rear.track_m) == (2.05, 1.9)
    assert rear.offset_m == pytest.approx(0.02)


@pytest.mark.parametrize(
    ("track", "tracks"), [("1.9", (1.9, 1.9)), ("[2.0, 1.8]", (2.0, 1.8)), ("2", (2, 2))]
)
def test_a_track_is_a_number_or_a_pair(track: str, tracks: tuple[float, float]) -> None:
    vehicle = parse_site(TEXT.replace("[bridge]", f"track_m = {track}\n[bridge]", 1), "a")
    assert vehicle.vehicles[0].track_m == tracks


def test_equal_tracks_have_one_hash() -> None:
    one, pair, other, none = (
        parse_site(TEXT.replace("[bridge]", f"{line}\n[bridge]", 1), "a")
        for line in ("track_m = 1.9", "track_m = [1.9, 1.9]", "track_m = [1.9, 1.8]", "")
    )
    assert site_hash(one) == site_hash(pair)
    assert len({site_hash(site) for site in (one, other, none)}) == 3


def test_trucks_of_before_are_written_as_before() -> None:
    text = site_toml(parse_site(TEXT.replace("[bridge]", "track_m = 1.9\n[bridge]", 1), "a"))
    assert "\ntrack_m = 1.9\n" in text
    assert "sensors" not in text


def test_axles_are_written_as_pairs() -> None:
    site = parse_site(HEAD + FRONT + REAR + BEHIND, "a")
    assert parse_site(site_toml(site), "b") == site


@pytest.mark.parametrize(
    ("key", "value", "other"),
    [
        ("wheelbase_m", "5.0", "axles.position_m"),
        ("front_axle_to_cg_m", "3.0", "axles.load_kg"),
        ("unsprung_mass_kg", "[600, 1100]", "axles.unsprung_mass_kg"),
        ("twin_tyre_distance_m", "[0.0, 0.3]", "axles.twin_tyre_distance_m"),
        ("rear_axle_offset_m", "0.01", "axles.lateral_offset_m"),
    ],
)
def test_both_spellings_are_refused_by_both_keys(key: str, value: str, other: str) -> None:
    line = complaint(HEAD, f"{key} = {value}\n", FRONT, REAR)
    assert line.startswith(f"vehicle.{key} and {other} are both there, keep one")


@pytest.mark.parametrize(
    ("parts", "line"),
    [
        ((HEAD, FRONT), "vehicle.axles is "),
        (
            (HEAD, FRONT + "tyre = 3\n", REAR),
            "vehicle.axles[0].tyre is not a known field, did you mean tyres?",
        ),
        (
            (HEAD, FRONT, REAR + 'tyres = "triple"\n'),
            'vehicle.axles[1].tyres is "triple", it must be "single", "twin" or "wide"',
        ),
        (
            (HEAD, FRONT, REAR.replace("1100", "[600, 1100]")),
            "vehicle.axles[1].unsprung_mass_kg is [600, 1100], it must be a mass in kg",
        ),
        (
            (HEAD, REAR, FRONT),
            "vehicle.axles[0].position_m is 5, it must be 0",
        ),
        (
            (HEAD, FRONT, REAR.replace("= 5.0", "= 0.0")),
            "vehicle.axles[1].position_m is 0, it must be a length greater than 0 m",
        ),
        (
            (HEAD, FRONT.replace("load_kg = 6000\n", ""), REAR.replace("load_kg = 10000\n", "")),
            "vehicle.axles[0].load_kg is missing",
        ),
        (
            (HEAD, FRONT, REAR.replace("load_kg = 10000", "load_kg = 13000")),
            "vehicle.axles carry 19000 kg by their load_kg but total_mass_kg is 16000",
        ),
        (
            (HEAD, FRONT, REAR.replace("1100", "10100")),
            "vehicle.axles[1].unsprung_mass_kg is 10100, it must be a mass less than the load",
        ),
        (
            (HEAD, FRONT + "track_m = 1.9\n", REAR),
            "vehicle.axles[1].track_m is missing, give the track of both axles or of none",
        ),
        (
            (HEAD.replace("total_mass_kg = 16000\n", ""), FRONT, REAR),
            "vehicle.total_mass_kg is missing, it must be a mass in kg",
        ),
        (
            (HEAD, FRONT, REAR, "[[vehicle.bogies]]\naxles = [1, 4]\n"),
            "vehicle.bogies[0].axles names axle 4, it must be numbers from 1 to 2",
        ),
        (
            (HEAD, FRONT, REAR, "[[vehicle.bogies]]\naxles = [1, 2]\nshares = [1.0]\n"),
            "vehicle.bogies[0].shares has 1 values, it must have one for each of its 2 axles",
        ),
        (
            (HEAD, FRONT, REAR, "[[vehicle.bogies]]\naxles = [1, 2]\n"),
            "vehicle.axles has a bogie: identification with more than two axles is not there yet",
        ),
        (
            (HEAD, FRONT, REAR, REAR.replace("= 5.0", "= 6.3")),
            "vehicle.axles has 3 axles: identification with more than two axles is not there yet",
        ),
        (
            (HEAD, "track_m = 'wide'\n", FRONT, REAR),
            'vehicle.track_m is "wide", it must be a length in m or a pair [front, rear]',
        ),
    ],
)
def test_what_is_wrong_with_axles_is_one_line(parts: tuple[str, ...], line: str) -> None:
    assert complaint(*parts).startswith(line)


def test_a_tandem_is_refused_by_its_axles_alone(shared: Path) -> None:
    path = shared / "crossings" / "d12_tandem_8_runs" / "site.toml"
    (line,) = faults_of_site(path.read_text(), "site.toml")
    assert line == (
        "site.toml: vehicle.axles has 3 axles: identification with more than two axles is not "
        "there yet, it must be a truck of two axles"
    )


def test_a_truck_that_says_its_axles_is_the_truck_of_the_pairs() -> None:
    text = HEAD + FRONT + REAR
    known = vehicle_of(text)
    own = own_part(text + BEHIND, "truck-x")
    assert "bridge" not in own
    assert parse_site(own + BEHIND[: BEHIND.index("[sensor]")], "a").vehicles[0] == known
    assert differences(own, known) == []
    lighter = own_part(text.replace("1100", "300") + BEHIND, "truck-x")
    assert [one.field for one in differences(lighter, known)][-1] == "unsprung_mass_kg"


def test_the_two_sided_crossings_have_two_axles(shared: Path) -> None:
    vehicle = load_site(shared / "crossings/d10_left_and_right_8_runs/site.toml").vehicles[0]
    assert vehicle.track_m == (1.9, 1.9)
    assert vehicle.twin_tyre_distance_m == (0.0, 0.0)
    assert vehicle.front_axle_to_cg_m == pytest.approx(3.1, abs=0.15)
    assert len(vehicle.channels) == 8
