"""`[[vehicle.axles]]`: two become pairs, a tandem keeps them, others are refused in one line."""

from math import hypot
from pathlib import Path

import pytest

from schemas.site import Vehicle
from schemas.site_file import faults_of_site, load_site, parse_site, site_hash, site_toml
from schemas.vehicle_info import differences, vehicle_part
from services.identification.footprints import footprints_of, tandem_truck_of
from tests.unit.schemas import test_site

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
    return test_site.complaint("".join(parts) + BEHIND)


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
    outcome = vehicle_of(HEAD, "front_axle_to_cg_m_spread = 0.3\n", FRONT, REAR)
    assert outcome.spread("front_axle_to_cg_m") == 0.3
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


@pytest.mark.parametrize(
    ("line", "pair"),
    [
        ("tyre_width_m = 0.25", (0.25, 0.25)),
        ("tyre_width_m = [0.25, 0.22]", (0.25, 0.22)),
        ("twin_tyre_distance_m = 0", (0.0, 0.0)),
        ("twin_tyre_distance_m = 0.0", (0.0, 0.0)),
        ("twin_tyre_distance_m = [0, 0.33]", (0.0, 0.33)),
    ],
)
def test_tyres_are_a_number_or_a_pair(line: str, pair: tuple[float, float]) -> None:
    key = line.split()[0]
    number = parse_site(TEXT.replace("[bridge]", f"{line}\n[bridge]", 1), "a")
    pairs = parse_site(TEXT.replace("[bridge]", f"{key} = {list(pair)}\n[bridge]", 1), "a")
    assert getattr(number.vehicles[0], key) == pair
    assert site_hash(number) == site_hash(pairs)
    assert parse_site(site_toml(number), "b") == number


@pytest.mark.parametrize("value", ["0.33", "false", '"none"'])
def test_one_twin_distance_for_both_axles_is_refused(value: str) -> None:
    text = TEXT.replace("[bridge]", f"twin_tyre_distance_m = {value}\n[bridge]", 1)
    assert test_site.complaint(text) == (
        f"vehicle.twin_tyre_distance_m is {value}, it must be 0 for single tyres or a pair "
        "[front, rear], such as [0, 0.33]: front tyres are single"
    )


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
        ((HEAD, FRONT), "vehicle.axles has 1 entry"),
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
            "vehicle.axles carry 19000 kg by their load_kg, but total_mass_kg is 16000",
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
            "vehicle.bogies joins axles of a two-axle truck, it must join axles of three or",
        ),
        (
            (HEAD, "track_m = 'wide'\n", FRONT, REAR),
            'vehicle.track_m is "wide", it must be a length in m or a pair [front, rear]',
        ),
    ],
)
def test_what_is_wrong_with_axles_is_one_line(parts: tuple[str, ...], line: str) -> None:
    assert complaint(*parts).startswith(line)


LAST = REAR.replace("= 5.0", "= 6.3").replace("10000", "9800").replace("1100", "1200")
FOURTH = LAST.replace("= 6.3", "= 7.6")
TANDEM_HEAD = HEAD.replace("16000", "25800")
BOGIE = "[[vehicle.bogies]]\naxles = [2, 3]\nequalised = true\n"
SENSORS = "".join(
    f'[[vehicle.sensors]]\nchannel = "{name}"\n{place}\nnoise_density_ug_per_rthz = 25\n'
    for name, place in (
        ("front", 'on = "body"\nposition_m = 0.0'),
        ("rear", 'on = "body"\nposition_m = 5.65'),
        ("axle_2", 'on = "axle"\naxle = 2'),
        ("axle_3", 'on = "axle"\naxle = 3'),
    )
)


def test_a_tandem_keeps_its_axles_next_to_pairs() -> None:
    vehicle = vehicle_of(TANDEM_HEAD, FRONT, REAR, LAST, BOGIE, SENSORS)
    tandem = vehicle.tandem
    assert tandem is not None
    assert (tandem.gap_m, tandem.share) == pytest.approx((1.3, 0.5))
    assert vehicle.wheelbase_m == pytest.approx(5.65)
    assert vehicle.length_m == 6.3
    assert vehicle.unsprung_mass_kg == (600.0, 2300.0)
    assert vehicle.tyre_stiffness_n_per_m == (2.0e6, 8.0e6)
    assert vehicle.sprung_mass_kg == 25800 - 2900
    # Of 22.9 t sprung 17.5 t are on the tandem.
    assert vehicle.front_axle_to_cg_m == pytest.approx(5.65 * 17500 / 22900)


def test_shares_move_the_force_of_a_tandem() -> None:
    bogie = BOGIE + "shares = [0.55, 0.45]\nshare_spread = 0.02\n"
    vehicle = vehicle_of(TANDEM_HEAD, FRONT, REAR, LAST, bogie, SENSORS)
    assert vehicle.wheelbase_m == pytest.approx(0.55 * 5.0 + 0.45 * 6.3)
    assert vehicle.nominal("tandem_share") == pytest.approx((0.55,))
    assert vehicle.spread("tandem_share") == 0.02
    swapped = BOGIE.replace("[2, 3]", "[3, 2]") + "shares = [0.45, 0.55]\n"
    again = vehicle_of(TANDEM_HEAD, FRONT, REAR, LAST, swapped, SENSORS)
    assert again.tandem_share == pytest.approx(0.55)


FOUR_HEAD = HEAD.replace("16000", "32000")
SECOND = FRONT.replace("= 0.0", "= 1.9").replace("6000", "6200")
ON_3_AND_4 = SENSORS.replace("axle = 3", "axle = 4").replace("axle = 2", "axle = 3")


@pytest.mark.parametrize("ahead", ["", "[[vehicle.bogies]]\naxles = [1, 2]\n"])
def test_two_steered_axles_are_one_at_their_common_force(ahead: str) -> None:
    behind = BOGIE.replace("[2, 3]", "[3, 4]")
    parts = (FOUR_HEAD, FRONT, SECOND, REAR, LAST, ahead, behind, ON_3_AND_4)
    vehicle = vehicle_of(*parts)
    tandem = vehicle.tandem
    assert tandem is not None
    assert (tandem.number, tandem.gap_m) == pytest.approx((3, 1.3))
    front_m = 1.9 * 5600 / 11000
    assert [one.share for one in tandem.front_axles] == pytest.approx([5400 / 11000, 5600 / 11000])
    assert vehicle.front_force_m == pytest.approx(front_m)
    assert vehicle.wheelbase_m == pytest.approx(5.65 - front_m)
    assert vehicle.unsprung_mass_kg == (1200.0, 2300.0)
    assert vehicle.front_axle_to_cg_m == pytest.approx((5.65 - front_m) * 17500 / 28500)
    site = parse_site("".join(parts) + BEHIND, "a")
    assert parse_site(site_toml(site), "b") == site
    unknown = SECOND.replace("load_kg = 6200\n", "")
    line = complaint(FOUR_HEAD, FRONT, unknown, REAR, LAST, behind, ON_3_AND_4)
    assert line.startswith("vehicle.axles[1].load_kg is missing, it must be a mass in kg: two or")


@pytest.mark.parametrize("bogie", ["", BOGIE.replace("true", "false")])
def test_axles_on_springs_of_their_own_are_weighed(bogie: str) -> None:
    vehicle = vehicle_of(TANDEM_HEAD, FRONT, REAR, LAST, bogie, SENSORS)
    tandem = vehicle.tandem
    assert tandem is not None
    assert not tandem.is_equalised
    # Of 10.0 and 9.8 t 8.9 and 8.6 t are on the springs, each known to 2 % of the load.
    assert tandem.share == pytest.approx(8.9 / 17.5)
    assert tandem.share_spread == pytest.approx(8.6 / 17.5 * hypot(0.2 / 8.9, 0.196 / 8.6))
    assert tandem_truck_of(vehicle).front.suspension_stiffness_n_per_m == [3.0e5]
    unknown = LAST.replace("load_kg = 9800\n", "")
    line = complaint(TANDEM_HEAD, FRONT, REAR, unknown, bogie, SENSORS)
    assert line.startswith("vehicle.axles[2].load_kg is missing, it must be a mass in kg")


@pytest.mark.parametrize("bogie", [BOGIE, ""])
def test_a_tandem_is_written_as_it_was_read(bogie: str) -> None:
    text = TANDEM_HEAD + "track_m = 1.85\n" + FRONT + REAR + LAST + bogie + SENSORS + BEHIND
    site = parse_site(text, "a")
    again = parse_site(site_toml(site), "b")
    assert again == site
    assert site_hash(again) == site_hash(site)
    assert [axle.track_m for axle in site.vehicles[0].axles] == [1.85] * 3
    first, second = footprints_of(site.vehicles[0])
    assert (first.twin_distance_m, second.track_m) == (0.33, 1.85)
    assert differences(vehicle_part(text, "truck-x"), site.vehicles[0]) == []


@pytest.mark.parametrize(
    ("parts", "line"),
    [
        (
            (BOGIE.replace("true", "false") + "shares = [0.5, 0.5]\n", SENSORS),
            "vehicle.bogies[0].shares are of an equalised tandem, remove them or set",
        ),
        (
            (BOGIE + BOGIE, SENSORS),
            "vehicle.bogies[1].axles are of a bogie already, remove one",
        ),
        (
            (BOGIE + "shares = [0.9, 0.1]\n", SENSORS),
            "vehicle.bogies[0].shares give one axle 90 % of the force, it must be at most 80 %",
        ),
        (
            (BOGIE.replace("[2, 3]", "[1, 2]"), SENSORS),
            "vehicle.bogies[0].axles are 1 and 2, they must be the last two axles, 2 and 3",
        ),
        ((BOGIE,), "vehicle.sensors is missing, it must place two accelerometers on the body"),
        (
            (BOGIE, SENSORS.replace("axle = 3", "axle = 1")),
            "vehicle.sensors has none on axle 3, one in the middle or two are expected",
        ),
        (
            (BOGIE, SENSORS.replace("axle = 3", "axle = 4")),
            "vehicle.sensors[3].axle is 4, it must be the number of an axle, 1 to 3",
        ),
        (
            (FOURTH, BOGIE, SENSORS),
            "vehicle.bogies[0].axles are 2 and 3, they must be the last two axles, 3 and 4",
        ),
        (
            (FOURTH, BOGIE.replace("[2, 3]", "[1, 2]"), SENSORS),
            "vehicle.bogies[0].equalised is true for axles 1 and 2, it must be false: only the",
        ),
        (
            (FOURTH, BOGIE.replace("[2, 3]", "[2, 3, 4]"), SENSORS),
            "vehicle.bogies[0].axles are 2 and 3 and 4, they must be the last two axles, 3 and 4",
        ),
    ],
)
def test_other_trucks_of_many_axles_are_refused(parts: tuple[str, ...], line: str) -> None:
    assert complaint(TANDEM_HEAD, FRONT, REAR, LAST, *parts).startswith(line)


def test_the_shared_tandem_is_read(shared: Path) -> None:
    path = shared / "crossings" / "d12_tandem_8_runs" / "site.toml"
    assert faults_of_site(path.read_text(), "site.toml") == []
    tandem = load_site(path).vehicles[0].tandem
    assert tandem is not None
    assert tandem.gap_m == pytest.approx(1.35)


def test_a_truck_that_says_its_axles_is_the_truck_of_the_pairs() -> None:
    text = HEAD + FRONT + REAR
    known = vehicle_of(text)
    own = vehicle_part(text + BEHIND, "truck-x")
    assert "bridge" not in own
    assert parse_site(own + BEHIND[: BEHIND.index("[sensor]")], "a").vehicles[0] == known
    assert differences(own, known) == []
    lighter = vehicle_part(text.replace("1100", "300") + BEHIND, "truck-x")
    assert [one.field for one in differences(lighter, known)][-1] == "unsprung_mass_kg"


def test_the_two_sided_crossings_have_two_axles(shared: Path) -> None:
    vehicle = load_site(shared / "crossings/d10_left_and_right_8_runs/site.toml").vehicles[0]
    assert vehicle.track_m == (1.9, 1.9)
    assert vehicle.twin_tyre_distance_m == (0.0, 0.0)
    assert vehicle.front_axle_to_cg_m == pytest.approx(3.1, abs=0.15)
    assert len(vehicle.channels) == 8


def _with_bogie(keys: str) -> str:
    return f"{REAR}{REAR.replace('5.0', '6.3')}[[vehicle.bogies]]\n{keys}\n"


@pytest.mark.parametrize(
    ("parts", "line"),
    [
        (FRONT, "vehicle.axles has 1 entry, it must be two [[vehicle.axles]], or more with a"),
        (
            FRONT + "".join(REAR.replace("5.0", f"{5 + k}.0") for k in range(20)),
            "vehicle.axles has 21 entries, it must be two [[vehicle.axles]], or more with a",
        ),
        (
            FRONT + _with_bogie("axles = [2]"),
            "vehicle.bogies[0].axles has 1 entry, it must be a list of the numbers of its axles",
        ),
        (
            FRONT + _with_bogie("equalised = true"),
            "vehicle.bogies[0].axles is missing, it must be a list of the numbers of its axles",
        ),
        (
            FRONT + _with_bogie("axles = [2, 3]") + "[[vehicle.bogies]]\naxles = [2, 3]\n" * 20,
            "vehicle.bogies has 21 entries, it must be one [[vehicle.bogies]], with axles = [2, 3]",
        ),
    ],
)
def test_wrong_number_of_axles_is_one_clear_line(parts: str, line: str) -> None:
    assert complaint(HEAD, parts).startswith(line)
