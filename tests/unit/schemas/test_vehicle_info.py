"""What a truck says of itself: only its own part, and the same truck as in the site file."""

from pathlib import Path

import pytest

from schemas.errors import InputError
from schemas.signals import MAX_SITE_BYTES
from schemas.site_file import parse_site, vehicle_toml
from schemas.vehicle_info import differences, vehicle_part

TEXT = (Path(__file__).parents[2] / "data" / "csv_example" / "site.toml").read_text()
SITE = parse_site(TEXT, "site.toml")
TRUCK = SITE.vehicles[0]
OWN = vehicle_toml(SITE, "truck-x")


def changed(**values: object) -> str:
    lines = [f"{key} = {value}" for key, value in values.items()]
    return '[vehicle]\nid = "truck-x"\n' + "\n".join(lines) + "\n"


def test_of_a_site_file_a_truck_says_its_own_part_only() -> None:
    two = TEXT.replace("[vehicle]", "[[vehicle]]").replace(
        "[bridge]",
        TEXT[TEXT.index("[vehicle]") : TEXT.index("[bridge]")]
        .replace("[vehicle]", "[[vehicle]]")
        .replace("truck-x", "truck-y")
        + "[bridge]",
    )
    parse_site(two, "two")  # it is one
    output = vehicle_part(two, "truck-y")
    assert "truck-x" not in output
    assert "bridge" not in output
    bridge = TEXT[TEXT.index("[bridge]") : TEXT.index("[sensor]")]
    assert parse_site(output + bridge, "said").vehicles[0].id == "truck-y"
    assert parse_site(vehicle_part(TEXT, "truck-x") + bridge, "said") == SITE


def test_own_vehicle_text_is_returned_unchanged() -> None:
    assert vehicle_part(OWN, "truck-x") == OWN
    assert vehicle_part('# mine\n[vehicle]\nid = "t"\n', "t") == '# mine\n[vehicle]\nid = "t"\n'


@pytest.mark.parametrize(
    ("text", "output"),
    [
        ("", "has no \\[vehicle\\]"),
        (TEXT, "has no \\[vehicle\\] with id"),
        ("x = ", "is not TOML"),
        (".".join(["a"] * 9000) + " = 1", "a key is more than 8 deep"),
        (f'[vehicle]\nid = "other"\nbaseline = "{"x" * MAX_SITE_BYTES}"', "at most 65536"),
        ('[vehicle]\nid = "other"\ncg_height_m = inf\n[bridge]\n', "is not TOML"),
    ],
)
def test_text_without_the_vehicle_gives_one_line(text: str, output: str) -> None:
    with pytest.raises(InputError, match=output):
        vehicle_part(text, "other")


def test_the_same_truck_differs_in_nothing() -> None:
    assert differences(OWN, TRUCK) == []
    assert differences(changed(), TRUCK) == []  # says nothing


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("total_mass_kg", 30_000),
        ("wheelbase_m", 7.0),
        ("wheelbase_m", 4.1),
        ("unsprung_mass_kg", [450.0, 3000.0]),
        ("tyre_stiffness_n_per_m", [480.0e3, 4.3e6]),
    ],
)
def test_other_truck_is_named(field: str, value: object) -> None:
    (found,) = differences(changed(**{field: value}), TRUCK)
    assert found.field == field


@pytest.mark.parametrize(
    ("values", "differs"),
    [
        # 4 standard deviations of a difference of two values of 1 % each are 5.8 %.
        ({"total_mass_kg": 9000.0 * 1.055}, False),
        ({"total_mass_kg": 9000.0 * 1.062}, True),
        ({"total_mass_kg": 9000.0 / 1.062}, True),
        ({"total_mass_kg": 9000.0 * 1.5, "total_mass_kg_spread": 0.2}, False),
        ({"total_mass_kg": 9000.0 * 1.062, "total_mass_kg_spread": 0.0}, True),
        ({"front_axle_to_cg_m": 1.2 * 1.8}, False),
    ],
)
def test_the_spreads_say_how_much_is_too_much(values: dict[str, object], differs: bool) -> None:
    assert bool(differences(changed(**values), TRUCK)) == differs


def test_values_known_exactly_may_still_be_rounded() -> None:
    exact = TRUCK.model_copy(update={"total_mass_kg_spread": 0.0})
    output = changed(total_mass_kg=9001.0, total_mass_kg_spread=0.0)
    assert differences(output, exact) == []


@pytest.mark.parametrize(
    "text",
    [
        "",
        "x = ",
        "vehicle = 3",
        '[vehicle]\nid = "truck-y"\ntotal_mass_kg = 30000',
        changed(total_mass_kg='"heavy"'),
        changed(total_mass_kg="true"),
        changed(total_mass_kg="[1, 2]"),
        changed(total_mass_kg="nan"),
        changed(total_mass_kg="-inf"),
        changed(total_mass_kg="1" + "0" * 400),
        changed(total_mass_kg="-9000"),
        changed(total_mass_kg="30000", total_mass_kg_spread='"much"'),
        ".".join(["a"] * 9000) + " = 1",
    ],
)
def test_what_says_nothing_sensible_says_nothing(text: str) -> None:
    assert [d for d in differences(text, TRUCK) if d.declared != 30000] == []
