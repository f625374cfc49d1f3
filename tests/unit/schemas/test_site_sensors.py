"""`[[vehicle.sensors]]`: which sensors show the middle of a truck, and which are refused."""

from pathlib import Path

import pytest

from schemas.signals import CHANNELS
from schemas.site import Site
from schemas.site_file import parse_site, site_hash, site_toml
from tests.unit.schemas.test_site import complaint

TEXT = (Path(__file__).parents[2] / "data" / "csv_example" / "site.toml").read_text()
BRIDGE = TEXT.index("[bridge]")
SENSOR = TEXT.index("[sensor]")
WHEELBASE_M = 4.0
BODY = (("f", 0.0, 0.0), ("r", WHEELBASE_M, 0.0))
AXLES = (("a", 1, 0.0), ("b", 2, 0.0))


def text_of(
    body: tuple[tuple[str, float, float], ...] = BODY,
    axles: tuple[tuple[str, int, float], ...] = AXLES,
    of_sensor: str = "rate_hz = 200.0\n",
    more: str = "",
) -> str:
    parts = [TEXT[:BRIDGE]]
    for channel, position, lateral in body:
        parts.append(
            f'[[vehicle.sensors]]\nchannel = "{channel}"\non = "body"\nposition_m = {position}\n'
            f"lateral_m = {lateral}\nnoise_density_ug_per_rthz = 25\n"
        )
    for channel, axle, lateral in axles:
        parts.append(
            f'[[vehicle.sensors]]\nchannel = "{channel}"\non = "axle"\naxle = {axle}\n'
            f"lateral_m = {lateral}\nnoise_density_ug_per_rthz = 25\n"
        )
    return "".join([*parts, more, TEXT[BRIDGE:SENSOR], "[sensor]\n", of_sensor])


def site_of(*body_and_axles: object) -> Site:
    return parse_site(text_of(*body_and_axles), "site.toml")  # type: ignore[arg-type]


def test_sensors_take_the_place_of_the_four() -> None:
    vehicle = site_of().vehicles[0]
    assert vehicle.wheelbase_m == WHEELBASE_M
    assert vehicle.channels == ("f", "r", "a", "b")
    assert parse_site(TEXT, "a").vehicles[0].channels == CHANNELS


PAIRS = (("fl", 0.0, 0.4), ("fr", 0.0, -0.4), ("rl", 4.0, 0.4), ("rr", 4.0, -0.4))


@pytest.mark.parametrize(
    "body",
    [
        BODY,
        PAIRS,
        PAIRS[:3],
        (PAIRS[0], *PAIRS[2:]),
        (*BODY, ("l", 2.0, 0.4)),
        (("f", 0.3, 0.0), ("r", 3.7, 0.02)),
    ],
)
def test_bodies_that_show_their_middle(body: tuple[tuple[str, float, float], ...]) -> None:
    assert site_of(body).vehicles[0].channels[:-2] == tuple(name for name, _, _ in body)


@pytest.mark.parametrize(
    "axle", [(("a", 1, 0.05),), (("l", 1, 0.9), ("s", 1, -0.3)), (("m", 1, 0.0), ("l", 1, 0.9))]
)
def test_axles_that_show_their_middle(axle: tuple[tuple[str, int, float], ...]) -> None:
    assert len(site_of(BODY, (*axle, ("b", 2, 0.0))).vehicles[0].sensors) == 3 + len(axle)


ADVICE = "put a second sensor on the other side, or this one in the middle"


@pytest.mark.parametrize(
    ("body", "axles", "number", "name", "part", "side"),
    [
        (BODY, (("a", 1, 0.9), AXLES[1]), 2, "a", "axle 1", "left"),
        (BODY, (AXLES[0], ("b", 2, -0.06)), 3, "b", "axle 2", "right"),
        (BODY, (("a", 1, 0.9), ("c", 1, 0.3), AXLES[1]), 2, "a", "axle 1", "left"),
        ((("f", 0.0, 0.4), ("r", 4.0, 0.4)), AXLES, 0, "f", "the body", "left"),
        (
            (("f", 0.0, 0.4), ("r", 4.0, -0.4)),
            AXLES,
            0,
            "f",
            "the body near the front axle",
            "left",
        ),
        ((BODY[0], ("r", 4.0, 0.4)), AXLES, 1, "r", "the body near the rear axle", "left"),
        (
            (("f", 0.0, 0.4), ("r", 4.0, 0.4)),
            (("a", 1, 0.9), ("b", 2, 0.9)),
            2,
            "a",
            "axle 1",
            "left",
        ),
    ],
)
def test_a_part_seen_from_one_side_is_refused(
    body: tuple[tuple[str, float, float], ...],
    axles: tuple[tuple[str, int, float], ...],
    number: int,
    name: str,
    part: str,
    side: str,
) -> None:
    assert complaint(text_of(body, axles)) == (
        f'vehicle.sensors[{number}] ("{name}") shows {part} on the {side} only, which hides its '
        f"roll (roll_not_seen): {ADVICE}"
    )


@pytest.mark.parametrize(
    ("text", "line"),
    [
        (text_of(axles=AXLES[:1]), "vehicle.sensors has none on axle 2"),
        (text_of(body=()), "vehicle.sensors has none on the body"),
        (
            text_of(body=BODY[:1]),
            "vehicle.sensors of the body do not show its motion above the rear axle",
        ),
        (
            text_of(body=(("f", 2.0, 0.0), ("r", 2.5, 0.0))),
            "vehicle.sensors of the body do not show its motion above the front axle",
        ),
        (
            text_of(axles=(*AXLES, ("f", 1, 0.0))),
            'vehicle.sensors[4].channel is "f" again, a channel is one sensor',
        ),
        (
            text_of(axles=(*AXLES, ("c", 3, 0.0))),
            "vehicle.sensors[4].axle is 3, it must be the number of an axle, 1 or 2",
        ),
        (
            text_of().replace("axle = 1\n", ""),
            "vehicle.sensors[2].axle is missing, it must be the number of an axle, 1 or 2",
        ),
        (
            text_of().replace("position_m = 0.0\n", ""),
            "vehicle.sensors[0].position_m is missing",
        ),
        (
            text_of().replace("axle = 1\n", "axle = 1\nposition_m = 0.0\n"),
            "vehicle.sensors[2].position_m is of a sensor on an axle",
        ),
        (
            text_of().replace("position_m = 0.0\n", "position_m = 0.0\naxle = 1\n"),
            "vehicle.sensors[0].axle is of a sensor on the body",
        ),
        (
            text_of().replace('on = "axle"', 'on = "wheel"', 1),
            'vehicle.sensors[2].on is "wheel", it must be "body" or "axle"',
        ),
        (
            text_of().replace('"f"', '"Front left"'),
            'vehicle.sensors[0].channel is "Front left", it must be an identifier of a-z, 0-9',
        ),
        (
            text_of().replace("noise_density_ug_per_rthz = 25\n", "", 1),
            "vehicle.sensors[0].noise_density_ug_per_rthz is missing, it must be a noise density",
        ),
        (
            text_of(of_sensor="rate_hz = [100, 100, 200, 200]\n"),
            "vehicle.sensors[0].rate_hz is missing",
        ),
        (
            text_of(of_sensor="rate_hz = 200\nup = [1, 1, 1, -1]\n"),
            "sensor.up applies to the four usual channels only, [[vehicle.sensors]] must point up",
        ),
        (
            TEXT.replace("noise_density_ug_per_rthz", "# "),
            "sensor.noise_density_ug_per_rthz is missing, it must be a noise density in µg/√Hz",
        ),
        (
            text_of(axles=tuple((f"a{k}", 1 + k % 2, 0.0) for k in range(31))),
            "vehicle.sensors has 33 entries, it must be at most 32 [[vehicle.sensors]]",
        ),
        (
            TEXT[:BRIDGE] + "sensors = []\n" + TEXT[BRIDGE:],
            "vehicle.sensors is [], it must be [[vehicle.sensors]] with all accelerometers",
        ),
        (
            text_of().replace('"f"', '"time_s"'),
            'vehicle.sensors[0].channel is "time_s", it must be another name: that is the time',
        ),
        (
            text_of(body=(*BODY, ("far", 50.0, 0.0))),
            "vehicle.sensors[2].position_m is 50, it must be a length from -5 to 14 m",
        ),
        (
            text_of(axles=(*AXLES, ("wide", 1, -3.0))),
            "vehicle.sensors[4].lateral_m is -3, it must be a length from -2 to 2 m",
        ),
    ],
)
def test_what_is_wrong_with_sensors_is_one_line(text: str, line: str) -> None:
    assert complaint(text).startswith(line)


def test_sensors_are_written_and_count_in_the_hash() -> None:
    site = site_of(PAIRS)
    again = parse_site(site_toml(site), "again")
    assert again == site
    assert site_hash(again) == site_hash(site)
    moved = site_of((("fl", 0.1, 0.4), *PAIRS[1:]))
    assert site_hash(moved) != site_hash(site)


def test_a_ros_2_truck_has_the_channels_of_its_sensors() -> None:
    ros2 = """\
[ros2]
vehicle = "truck-x"
gnss = "/gps/fix"
[ros2.imu]
f = { topic = "/imu/front" }
b = { topic = "/imu/axle", axis = "-z" }
"""
    site = parse_site(text_of() + ros2, "site.toml")
    imus = site.ros2[0].imu.by_channel()
    assert list(imus) == ["f", "b"]
    assert (imus["b"].topic, imus["b"].axis) == ("/imu/axle", "-z")
    assert parse_site(site_toml(site), "again") == site
    line = complaint(text_of() + ros2.replace("f =", "sprung_front ="))
    assert line == (
        "ros2.imu.sprung_front is not a known field, it must be a channel of truck-x: f, r, a, b"
    )
    wrong = complaint(text_of() + ros2.replace('"/imu/front"', '"imu"'))
    assert wrong.startswith('ros2.imu.f.topic is "imu", it must be')
