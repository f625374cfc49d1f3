"""Sensors with a place: reduced to middle readings, and checked against one another."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from pre_core.physics.simulate import Motion
from schemas.errors import InputError
from schemas.reasons import Reason
from schemas.results import CrossingResult, load_results
from schemas.settings import IdentificationSettings
from schemas.signals import CHANNELS
from schemas.site import Site, Vehicle
from schemas.site_file import load_site
from schemas.site_sensors import PlacedSensor
from services.cli import main as cli
from services.common.arrays import Floats
from services.common.geodesy import bridge_frame, to_chainage
from services.drives.csv_import import read_folder
from services.drives.runs import Run
from services.finding.placed import (
    densities_ug_per_rthz,
    middle_names,
    middle_of,
    middle_sensor,
    middle_site,
    one_sided_channels,
    rates_hz,
    sensors_in_words,
)
from services.identification.signal_checks import reasons_before_fit
from services.simulation.drawn import identify_simulated
from services.simulation.drive import paper_site
from tests.unit.identification.test_engine import drive, legs, rejected

PAPER = paper_site()


def sensor(
    channel: str, place: int | float, lateral_m: float = 0.0, noise: float = 25.0
) -> PlacedSensor:
    """A sensor on an axle, by its number, or on the body, by its distance in m (a float)."""
    on = {"axle": place} if isinstance(place, int) else {"position_m": place}
    return PlacedSensor.model_validate(
        {
            "channel": channel,
            "on": next(iter(on)).replace("position_m", "body"),
            "lateral_m": lateral_m,
            "noise_density_ug_per_rthz": noise,
            **on,
        }
    )


def with_sensors(site: Site, *sensors: PlacedSensor) -> Site:
    vehicle = site.vehicles[0].model_copy(update={"sensors": sensors})
    return site.model_copy(update={"vehicles": (vehicle,)})


WHEELBASE_M = PAPER.vehicles[0].wheelbase_m
BODY = (sensor("body_front", 0.0), sensor("body_rear", WHEELBASE_M))
SIDES = (
    sensor("left_1", 1, 0.9, 30.0),
    sensor("right_1", 1, -0.9, 40.0),
    sensor("left_2", 2, 0.9),
    sensor("right_2", 2, -0.9),
)
TWO_SIDED = with_sensors(PAPER, *BODY, *SIDES)


def test_four_channels_are_their_own_middle() -> None:
    vehicle, signals = PAPER.vehicles[0], np.random.default_rng(1).standard_normal((4, 100))
    assert middle_of(vehicle, signals) is signals
    assert middle_sensor(PAPER.sensor, vehicle) is PAPER.sensor
    assert middle_names(vehicle) is CHANNELS
    assert middle_site(PAPER) is PAPER
    assert sensors_in_words(PAPER.sensor, vehicle) == []
    assert one_sided_channels(vehicle, ()) == ""


def test_middle_readings_have_their_own_noise_rates_and_names() -> None:
    vehicle = TWO_SIDED.vehicles[0]
    slow = PAPER.sensor.model_copy(update={"rate_hz": (200.0,) * 4, "up": (1, 1, 1, -1)})
    fast = vehicle.sensors[2].model_copy(update={"rate_hz": 100.0})
    one = vehicle.model_copy(update={"sensors": (*BODY, fast, *SIDES[1:])})
    found = middle_sensor(slow, one)
    assert found.noise_density_ug_per_rthz == pytest.approx((25.0, 25.0, 25.0, 25 / 2**0.5))
    assert found.rate_hz == (200.0, 200.0, 100.0, 200.0)
    assert found.up == (1, 1, 1, 1)
    assert middle_names(one) == (
        "body_front",
        "body_rear",
        "left_1 and right_1",
        "left_2 and right_2",
    )
    assert rates_hz(slow, one)["left_1"] == 100.0
    assert densities_ug_per_rthz(slow, one)["right_1"] == 40.0
    assert sensors_in_words(slow, one)[1:3] == [
        "body_rear: body, 4.4 m behind the first axle, in the middle, 25 µg/√Hz, 200 Hz",
        "left_1: axle 1, 0.9 m to the left, 30 µg/√Hz, 100 Hz",
    ]


def test_simulated_truck_has_the_middle_readings_of_its_sensors() -> None:
    site = middle_site(TWO_SIDED)
    assert site.vehicles[0].channels == CHANNELS
    assert site.sensor == middle_sensor(TWO_SIDED.sensor, TWO_SIDED.vehicles[0])


def test_parts_seen_from_one_side_are_named() -> None:
    vehicle = TWO_SIDED.vehicles[0]
    assert one_sided_channels(vehicle, vehicle.channels) == ""
    assert (
        one_sided_channels(vehicle, [name for name in vehicle.channels if name != "right_2"])
        == "left_2"
    )
    assert one_sided_channels(vehicle, ["left_1", "body_front", "body_rear"]) == "left_1"


def through(site: Site, channels: tuple[str, ...]) -> Run:
    return drive(legs((0.0, -60.0), (16.0, 100.0)), 16.0, site=site, channels=channels)


def test_missing_side_hides_the_roll() -> None:
    channels = tuple(name for name in TWO_SIDED.vehicles[0].channels if name != "right_1")
    crossing = rejected(through(TWO_SIDED, channels), TWO_SIDED)
    assert crossing.reasons == ("channel_missing", "roll_not_seen")
    assert crossing.reason_texts[0].endswith(": right_1.")
    assert crossing.reason_texts[1].endswith("separated from its heave: left_1.")


def test_sensors_of_one_side_are_refused_by_name() -> None:
    """As they could be where no site file was read."""
    site = with_sensors(
        PAPER,
        *(sensor(f"body_{k}", k * WHEELBASE_M, 0.4) for k in (0, 1)),
        *(sensor(f"axle_{k}", k, 0.9) for k in (1, 2)),
    )
    crossing = rejected(through(site, site.vehicles[0].channels), site)
    assert crossing.reasons == ("roll_not_seen",)
    assert crossing.reason_texts[0].endswith(": body_0, body_1, axle_1, axle_2.")


def test_channel_that_the_site_does_not_name_is_not_looked_at() -> None:
    run = through(PAPER, (*CHANNELS, "cabin"))
    run.channels["cabin"][:] = 0.0
    run.channels["sprung_rear"][:] = 0.0
    crossing = rejected(run)
    assert crossing.reasons == ("channel_stuck",)
    assert crossing.reason_texts[0].endswith(": sprung_rear.")


# Two sides, by the independent simulator.


class TwoSided:
    """One of its runs, as a check before the fit sees it."""

    def __init__(self, folder: Path) -> None:
        self.site = load_site(folder / "site.toml")
        self.vehicle = self.site.vehicles[0]
        self.runs = read_folder(folder, channels=self.vehicle.channels)
        self.truth: list[float] = json.loads((folder / "truth.json").read_text())["EI"]

    def reasons(
        self, change: Callable[[dict[str, Floats]], None] = lambda signals: None, run: int = 0
    ) -> dict[Reason, str]:
        one, bridge = self.runs[run], self.site.bridges[0]
        chainage, _ = to_chainage(
            bridge_frame(bridge), one.gnss.latitude_deg, one.gnss.longitude_deg
        )
        ends = np.interp([0.0, bridge.span_m + self.vehicle.wheelbase_m], chainage, one.gnss.time_s)
        near = slice(*np.searchsorted(one.accel_time_s, ends + np.array([-1.0, 1.0])).tolist())
        signals = {name: values[near].copy() for name, values in one.channels.items()}
        change(signals)
        time_s = one.accel_time_s[near]
        speed = float(np.median(one.gnss.speed_m_per_s))
        still = np.zeros(time_s.size)
        motion = Motion(speed * (time_s - time_s[0]), still + speed, still)
        acceleration = np.stack([signals[name] for name in self.vehicle.channels])
        return dict(reasons_before_fit(self.vehicle, acceleration, 0.002, motion, 1))


@pytest.fixture(scope="module")
def two_sided() -> TwoSided:
    folder = Path(__file__).parents[4] / "shared/crossings/d10_left_and_right_8_runs"
    if not folder.is_dir():
        pytest.skip("the folder ../shared with reference data and recordings is not there")
    return TwoSided(folder)


def scaled(name: str, factor: float) -> Callable[[dict[str, Floats]], None]:
    def change(signals: dict[str, Floats]) -> None:
        signals[name] *= factor

    return change


def swapped(one: str, other: str) -> Callable[[dict[str, Floats]], None]:
    def change(signals: dict[str, Floats]) -> None:
        signals[one], signals[other] = signals[other], signals[one]

    return change


def stuck(name: str) -> Callable[[dict[str, Floats]], None]:
    def change(signals: dict[str, Floats]) -> None:
        signals[name][1000:1300] = signals[name][1000]

    return change


def doubled(one: str, other: str) -> Callable[[dict[str, Floats]], None]:
    def change(signals: dict[str, Floats]) -> None:
        signals[one][:] = signals[other]

    return change


def late(name: str, samples: int) -> Callable[[dict[str, Floats]], None]:
    def change(signals: dict[str, Floats]) -> None:
        signals[name] = np.roll(signals[name], samples)

    return change


def loose(name: str) -> Callable[[dict[str, Floats]], None]:
    def change(signals: dict[str, Floats]) -> None:
        signals[name] += 0.8 * np.roll(signals["sprung_rear"], 700)

    return change


def test_sound_sensors_are_not_accused(two_sided: TwoSided) -> None:
    assert [two_sided.reasons(run=run) for run in range(8)] == [{}] * 8


@pytest.mark.parametrize(
    ("change", "reason", "named"),
    [
        (stuck("unsprung_rear_right"), Reason.CHANNEL_STUCK, "unsprung_rear_right"),
        (
            doubled("unsprung_front_left", "unsprung_front_right"),
            Reason.CHANNELS_ALIKE,
            "unsprung_front_left and unsprung_front_right",
        ),
        (scaled("sprung_front_right", -1.0), Reason.CHANNEL_INVERTED, "sprung_front_right"),
        (scaled("unsprung_front_left", -1.0), Reason.CHANNEL_INVERTED, "unsprung_front_left"),
        (scaled("unsprung_rear_right", -1.0), Reason.CHANNEL_INVERTED, "unsprung_rear_right"),
        (
            swapped("unsprung_front_left", "unsprung_rear_right"),
            Reason.CHANNEL_SWAPPED,
            "unsprung_front_left and unsprung_rear_right",
        ),
        (
            swapped("sprung_front", "sprung_rear_left"),
            Reason.CHANNEL_SWAPPED,
            "sprung_front and sprung_rear_left",
        ),
        (
            swapped("sprung_front", "unsprung_front_left"),
            None,
            "sprung_front and unsprung_front_left",
        ),
        (scaled("sprung_rear", 1.15), Reason.SENSORS_DISAGREE, "sprung_rear (gain +13"),
        (late("sprung_front", 3), Reason.SENSORS_DISAGREE, "sprung_front (gain"),
        (loose("sprung_rear_left"), Reason.SENSORS_DISAGREE, "one of sprung_front, "),
        (
            scaled("unsprung_rear_left", 0.2),
            Reason.SENSORS_DISAGREE,
            "unsprung_rear_left or unsprung_rear_right",
        ),
    ],
)
def test_what_is_wrong_is_named_before_the_fit(
    two_sided: TwoSided,
    change: Callable[[dict[str, Floats]], None],
    reason: Reason | None,
    named: str,
) -> None:
    for run in (0, 5):
        ((found, names),) = two_sided.reasons(change, run).items()
        if reason is not None:
            assert found is reason
            assert names.startswith(named)


def test_no_delay_has_no_sign(two_sided: TwoSided) -> None:
    """A gain alone delays nothing: -0.0 ms would read as a fault of its own."""
    texts = [
        name
        for factor in (1.1, 1.15, 1.2, 0.9)
        for run in (0, 5)
        for name in two_sided.reasons(scaled("sprung_rear", factor), run).values()
    ]
    assert any(" 0.0 ms late" in one for one in texts)
    assert not any("-0.0 " in one or "+0.0 " in one for one in texts)


def averaged(run: Run, vehicle: Vehicle) -> Run:
    """The run with the averages of left and right as four channels."""
    pairs = {
        "sprung_front": ("sprung_front", "sprung_front_right"),
        "sprung_rear": ("sprung_rear_left", "sprung_rear"),
        "unsprung_front": ("unsprung_front_left", "unsprung_front_right"),
        "unsprung_rear": ("unsprung_rear_left", "unsprung_rear_right"),
    }
    return run._replace(
        channels={
            name: 0.5 * (run.channels[left] + run.channels[right])
            for name, (left, right) in pairs.items()
        }
    )


def answer(run: Run, site: Site) -> CrossingResult:
    (found,) = identify_simulated([run], site, IdentificationSettings(threads=1))
    return found.result


def in_stds(result: CrossingResult, truth: list[float]) -> Floats:
    """How far the elements are from the truth, in logarithms over a quarter of the interval."""
    assert result.parameters is not None
    found = [result.parameters[f"EI_{n + 1}"] for n in range(len(truth))]
    return np.array(
        [
            np.log(one.q50 / true) / (np.log(one.q975 / one.q025) / 3.92)
            for one, true in zip(found, truth, strict=True)
        ]
    )


def with_errors(run: Run, gain: float, delay_s: float, seed: int) -> Run:
    """The run as sensors measure it that differ in gain and delay."""
    rng = np.random.default_rng(seed)
    channels = {}
    for name, values in run.channels.items():
        frequency = np.fft.rfftfreq(values.size, 1.0 / run.rate_hz)
        shift = np.exp(-2j * np.pi * frequency * delay_s * rng.standard_normal())
        late = np.fft.irfft(np.fft.rfft(values) * shift, values.size)
        channels[name] = (1.0 + gain * rng.standard_normal()) * late
    return run._replace(channels=channels)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(6))
def test_errors_of_single_sensors_make_no_good_answer_wrong(two_sided: TwoSided, seed: int) -> None:
    """Gains 1 % and delays 0.5 ms: an axle's roll leaks into its middle, and the fit shows it."""
    result = answer(with_errors(two_sided.runs[4], 0.01, 0.0005, seed), two_sided.site)
    if result.parameters is None:
        assert result.verdict == "rejected"
        return
    stds = [result.parameters[f"EI_{n}"] for n in range(2, 7)]
    print(result.verdict, np.median([one.std / one.mean for one in stds]), result.chi2_per_dof)
    if result.verdict == "good":
        assert np.abs(in_stds(result, two_sided.truth)).max() < 4.0


def test_left_half_of_the_sensors_is_refused(shared: Path, tmp_path: Path) -> None:
    folder = shared / "crossings" / "d10_left_and_right_8_runs"
    head, *tables = (folder / "site.toml").read_text().split("[[vehicle.sensors]]")
    last, bridge = tables[-1].split("\n[bridge]")
    left = [one for one in (*tables[:-1], last) if "lateral_m = -" not in one]
    site = tmp_path / "left.toml"
    site.write_text(
        "[[vehicle.sensors]]".join([head, *left]) + "\n[bridge]" + bridge, encoding="utf-8"
    )
    with pytest.raises(InputError) as caught:
        load_site(site)
    assert str(caught.value) == (
        f'{site}: vehicle.sensors[2] ("unsprung_front_left") shows axle 1 on the left only, which '
        "hides its roll (roll_not_seen): put a second sensor on the other side, or this one in the "
        "middle"
    )


@pytest.mark.slow
def test_eight_two_sided_crossings_are_good_and_fused(shared: Path, tmp_path: Path) -> None:
    folder = shared / "crossings" / "d10_left_and_right_8_runs"
    recording, found = tmp_path / "d10.mcap", tmp_path / "d10.json"
    site = str(folder / "site.toml")
    assert cli.main(["import", str(folder), "--site", site, "-o", str(recording)]) == 0
    assert cli.main(["identify", str(recording), "--json", str(found)]) == 0
    results = load_results(found)
    truth: list[float] = json.loads((folder / "truth.json").read_text())["EI"]
    assert [one.verdict for one in results.crossings] == ["good"] * 8
    for one in results.crossings:
        assert np.abs(in_stds(one, truth)).max() < 4.0
    state = json.loads(found.read_text())["bridges"]["bridge-10"]
    elements = [state[f"EI_{n}"] for n in range(1, 8)]
    stds = np.array([one["std"] / one["mean"] for one in elements])
    assert np.median(stds) <= 0.15
    assert np.median(stds[1:-1]) <= 0.14
    assert state["level"]["std"] / state["level"]["mean"] <= 0.06
    assert state["verdict"] == "good"


@pytest.mark.slow
def test_averages_written_as_four_channels_have_the_same_answer(two_sided: TwoSided) -> None:
    declared = answer(two_sided.runs[4], two_sided.site)
    middle = answer(averaged(two_sided.runs[4], two_sided.vehicle), middle_site(two_sided.site))
    assert declared.verdict == middle.verdict == "good"
    assert declared.parameters is not None
    assert middle.parameters is not None
    for name, one in declared.parameters.items():
        assert abs(one.mean - middle.parameters[name].mean) < 0.2 * one.std, name
