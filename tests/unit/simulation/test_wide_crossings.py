"""Crossings with width: what sensors and receivers record, and what is drawn."""

import numpy as np
import pytest

from schemas.signals import CHANNELS
from services.common.geodesy import bridge_frame, to_chainage
from services.simulation.two_sided import static_axle_loads_n
from services.simulation.two_sided_deck import bending_frequencies_hz
from services.simulation.wide_crossings import (
    SatelliteErrors,
    WideCase,
    WideDrivenRun,
    WideSensor,
    drive_case,
    site_of,
)
from studies.simulation import wide_cases
from studies.simulation.drive_wide import middle_channels
from studies.simulation.wide_cases import (
    draw_wide,
    middle_sensors,
    more_axles,
    tandem_truck,
)

GRAVITY = 9.80665
RTK = SatelliteErrors(0.02, 0.02, 0.02)
QUIET = SatelliteErrors(0.0, 0.0, 0.0)


def short(case: WideCase, sensors: tuple[WideSensor, ...] | None = None) -> WideCase:
    """The same case with perfect sensors and receiver, and a fast truck."""
    perfect = middle_sensors(case.truck.axles[1].position_m, 0.0) if sensors is None else sensors
    runs = tuple(run._replace(speed_m_per_s=20.0, change_m_per_s=0.0) for run in case.runs)
    return case._replace(sensors=perfect, runs=runs, receiver=QUIET)


@pytest.fixture(scope="module")
def driven() -> WideDrivenRun:
    return drive_case(short(draw_wide(1)), 0)


def test_same_case_gives_the_same_run(driven: WideDrivenRun) -> None:
    again = drive_case(short(draw_wide(1)), 0)
    for name in CHANNELS:
        np.testing.assert_array_equal(again.run.channels[name], driven.run.channels[name])
    other = drive_case(short(draw_wide(1))._replace(road_seed=7), 0)
    assert np.abs(other.run.channels[CHANNELS[2]] - driven.run.channels[CHANNELS[2]]).max() > 0.5


def test_recording_has_road_before_and_behind_the_bridge(driven: WideDrivenRun) -> None:
    case = short(draw_wide(1))
    speed = case.runs[0].speed_m_per_s
    time_s = driven.run.accel_time_s
    assert speed * (driven.entry_s - time_s[0]) == pytest.approx(30.0, abs=0.3)
    assert speed * (time_s[-1] - driven.exit_s) == pytest.approx(25.0, abs=0.3)
    driven_m = case.deck.span_m + case.truck.axles[1].position_m
    assert speed * (driven.exit_s - driven.entry_s) == pytest.approx(driven_m, abs=0.3)
    np.testing.assert_allclose(np.diff(time_s), 1.0 / 500.0, rtol=1e-3)
    # The road's rise is over: the truck moves as much as anywhere.
    axle = driven.run.channels["unsprung_front"]
    assert axle[:250].std() > 0.3 * axle.std()


@pytest.mark.parametrize("forward", [True, False])
def test_perfect_receiver_shows_lane_and_chainage(forward: bool) -> None:
    drawn = short(draw_wide(2))
    run = drawn.runs[0]._replace(forward=forward, lateral_m=0.2, change_m_per_s=0.0)
    case = drawn._replace(runs=(run,))
    found = drive_case(case, 0)
    gnss = found.run.gnss
    chainage, lateral = to_chainage(
        bridge_frame(site_of(case).bridges[0]), gnss.latitude_deg, gnss.longitude_deg
    )
    travel = 20.0 * (gnss.time_s - found.entry_s)
    expected = travel if forward else case.deck.span_m - travel
    np.testing.assert_allclose(chainage, expected, atol=0.01)
    np.testing.assert_allclose(lateral, case.lane_offset_m + 0.2, atol=1e-6)
    np.testing.assert_allclose(gnss.speed_m_per_s, 20.0, atol=1e-6)


def test_receiver_errors_are_those_that_are_stated() -> None:
    drawn = draw_wide(2)
    for errors in (SatelliteErrors(), RTK):
        case = short(drawn)._replace(receiver=errors)
        noisy, true = drive_case(case, 0).run.gnss, drive_case(short(drawn), 0).run.gnss
        frame = bridge_frame(site_of(case).bridges[0])
        apart = (
            to_chainage(frame, noisy.latitude_deg, noisy.longitude_deg)[0]
            - to_chainage(frame, true.latitude_deg, true.longitude_deg)[0]
        )
        assert apart.std() == pytest.approx(errors.noise_m, rel=0.35)
        assert abs(apart.mean()) < 4.0 * errors.slow_m
        speed = noisy.speed_m_per_s - true.speed_m_per_s
        assert speed.std() == pytest.approx(errors.speed_m_per_s, rel=0.35)


def test_sensor_has_gain_delay_bias_and_noise(driven: WideDrivenRun) -> None:
    case = short(draw_wide(1))
    true = driven.run.channels["unsprung_rear"]
    flawed = [
        sensor._replace(gain_error=0.02, delay_s=0.004, bias_m_per_s2=0.3)
        for sensor in case.sensors
    ]
    late = drive_case(case._replace(sensors=tuple(flawed)), 0).run.channels["unsprung_rear"]
    np.testing.assert_allclose(late[2:], 1.02 * true[:-2] + 0.3, atol=1e-4)
    noisy = [sensor._replace(noise_ug_per_rthz=100.0) for sensor in case.sensors]
    noise = drive_case(case._replace(sensors=tuple(noisy)), 0).run.channels["unsprung_rear"] - true
    assert noise.std() == pytest.approx(100e-6 * GRAVITY * np.sqrt(250.0), rel=0.05)


def test_mean_of_left_and_right_is_the_middle(driven: WideDrivenRun) -> None:
    case = short(draw_wide(1))
    rear_m = case.truck.axles[1].position_m
    pairs = tuple(
        WideSensor(f"{on}-{position}-{axle}-{side}", on, position, axle, side * 0.8, 0, 0.0)
        for on, position, axle in (
            ("axle", 0.0, 2),
            ("axle", 0.0, 1),
            ("body", rear_m, 0),
            ("body", 0.0, 0),
        )
        for side in (1.0, -1.0)
    )
    read = drive_case(case._replace(sensors=pairs), 0).run.channels
    middle = middle_channels(read, pairs)
    assert tuple(middle) == CHANNELS
    for name in CHANNELS:
        np.testing.assert_allclose(middle[name], driven.run.channels[name], atol=1e-9)
    # There is roll to be averaged away.
    assert np.abs(read["axle-0.0-1-1.0"] - middle["unsprung_front"]).max() > 0.5
    with pytest.raises(ValueError, match=r"axle-0\.0-2-1\.0 and .* not symmetric"):
        middle_channels(read, (pairs[0], *pairs[2:]))


def test_runs_of_a_case_are_ten_minutes_apart() -> None:
    case = short(draw_wide(4, runs=2))
    first, second = (drive_case(case, number).run.accel_time_s for number in range(2))
    assert second[0] - first[0] == pytest.approx(600.0)


def test_drawn_cases_have_the_stated_ranges() -> None:
    cases = [draw_wide(seed) for seed in range(80)]
    for case in cases:
        deck, truck = case.deck, case.truck
        plain = deck._replace(
            flexural_rigidity_nm2=(case.undamaged_nm2,) * len(deck.flexural_rigidity_nm2)
        )
        assert deck.torsion is not None
        ratio = deck.torsion.frequency_hz / bending_frequencies_hz(plain, 1)[0]
        assert 1.3 <= ratio <= 3.0
        assert 1.8 <= deck.torsion.gyration_m <= 3.0
        assert abs(case.lane_offset_m) <= 2.0
        assert 18.0 <= deck.span_m <= 40.0
        assert 8.0 <= case.runs[0].speed_m_per_s <= 15.0
        assert case.road_class in "AB"
        weak = np.array(deck.flexural_rigidity_nm2) < 0.99 * case.undamaged_nm2
        assert weak.sum() <= 1
        vehicle, bridge = site_of(case).vehicles[0], site_of(case).bridges[0]
        assert vehicle.total_mass_kg == pytest.approx(truck.total_mass_kg, abs=0.1)
        assert vehicle.wheelbase_m == pytest.approx(truck.axles[1].position_m, abs=1e-4)
        error = bridge.nominal_flexural_rigidity_nm2[0] / case.undamaged_nm2 - 1.0
        assert abs(error) <= wide_cases.SITE_ERROR + 1e-4
    for drawn in (
        [case.runs[0].forward for case in cases],
        [case.truck.axles[1].twin_distance_m > 0.0 for case in cases],
        ["lane_offset_m" in case.declared["bridge"] for case in cases],
        [case.lane_offset_m > 0.0 for case in cases],
        [min(case.deck.flexural_rigidity_nm2) < 0.99 * case.undamaged_nm2 for case in cases],
    ):
        assert 0.3 < np.mean(drawn) < 0.7


def test_cases_of_more_axles_are_declared_as_two() -> None:
    cases = [more_axles(number) for number in range(16)]
    for case in cases:
        assert len(case.truck.axles) > 2
        site = site_of(case)
        assert {sensor.channel for sensor in case.sensors} == set(CHANNELS)
        assert site.vehicles[0].wheelbase_m < max(axle.position_m for axle in case.truck.axles)
    assert {len(case.truck.axles) for case in cases} == {3, 5}
    assert {case.is_one_road for case in cases} == {True, False}
    assert {bool(case.truck.bogies) for case in cases[1::2]} == {True, False}
    tractors = [site_of(case).vehicles[0].total_mass_kg for case in cases[::2]]
    assert min(tractors) < 20e3 < 35e3 < max(tractors)
    assert [case.runs[0].speed_m_per_s for case in (cases[0], cases[-1])] == [8.0, 14.0]
    with pytest.raises(ValueError, match="16 is no case, it must be from 0 to 15"):
        more_axles(16)


def test_unequal_twins_carry_their_share() -> None:
    truck = tandem_truck(wide_cases.TWIN, outer_share=0.55)
    assert static_axle_loads_n(truck).sum() == pytest.approx(GRAVITY * truck.total_mass_kg)
    assert truck.axles[1].outer_share == 0.55
