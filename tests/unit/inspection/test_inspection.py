"""What is wrong with a truck's recording is named, and a sound one is left alone."""

import re
from collections.abc import Callable
from functools import cache
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from pre_core.constants import MICRO_G_M_PER_S2
from pre_core.diagnostics.noise_floor import NoiseSegment, density
from schemas.signals import CHANNELS, decode_accel, decode_gnss, encode_accel, encode_gnss
from schemas.site import Site
from schemas.site_file import site_toml
from schemas.topics import Message
from services.cli.commands.check import lines_of
from services.common.errors import InputError
from services.drives.importing import normalised_runs
from services.drives.runs import GnssTrack, Run, run_to_messages
from services.inspection.finding import CheckFinding, CheckStatus
from services.inspection.inspect import CheckReport, findings_of_run
from services.inspection.noise import noise_of
from services.inspection.recorded import recorded_runs
from services.inspection.site import findings_of_site
from services.recordings.writer import write_recording
from tests.verdicts import faults
from tests.verdicts.faults import Case, Truth
from tests.verdicts.test_signals import BROKEN

S1, S2, U1, U2 = CHANNELS


@cache
def sound() -> Case:
    return faults.crossing(Truth())


def findings(
    folder: Path, run: Run, site: Site, change: Callable[[Message], Message] = lambda m: m
) -> dict[str, list[CheckFinding]]:
    """What is said of a run as it was recorded, by name, but for what is in order."""
    path = folder / "run.mcap"
    messages = [change(m) for m in run_to_messages([run], site, "sim-check", site.vehicles[0].id)]
    write_recording(path, messages, site_toml=site_toml(site), reason="test", force=True)
    (recorded,) = recorded_runs(path, site, "site.toml")
    found: dict[str, list[CheckFinding]] = {}
    for finding in findings_of_run(recorded, site):
        if finding.state is not CheckStatus.OK:
            found.setdefault(finding.name, []).append(finding)
    return found


def test_sound_drive_has_no_complaint(tmp_path: Path) -> None:
    case = sound()
    assert findings(tmp_path, case.run, case.site) == {}


NAMES = {name: str(reason) for name, (_, reason) in BROKEN.items()}


@pytest.mark.parametrize("name", BROKEN)
def test_what_is_recognised_before_a_fit_is_recognised_here(name: str, tmp_path: Path) -> None:
    case = sound()
    fault, reason = BROKEN[name]
    channels = fault.channels(case.run.channels, case.run.accel_time_s - case.entry_s)
    found = findings(tmp_path, case.run._replace(channels=channels), case.site)
    assert str(reason) in found, found
    assert found[str(reason)][0].state is CheckStatus.WRONG
    # One cause, one line: what follows from it is not said beside it.
    wrong = [key for key, those in found.items() if those[0].state is CheckStatus.WRONG]
    assert wrong == [str(reason)]


def test_masses_of_another_unit_explain_no_more_than_nothing(tmp_path: Path) -> None:
    """Masses in t leave a thousand times the body's motion unexplained; shares end at 100 %."""
    case = sound()
    (vehicle,) = case.site.vehicles
    unsprung = tuple(mass / 1e3 for mass in vehicle.unsprung_mass_kg)
    wrong = vehicle.model_copy(
        update={"unsprung_mass_kg": unsprung, "total_mass_kg": vehicle.total_mass_kg / 1e3}
    )
    found = findings(tmp_path, case.run, case.site.model_copy(update={"vehicles": (wrong,)}))
    (finding,) = [one for name in found if name.startswith("channel") for one in found[name]]
    assert finding.state is CheckStatus.WRONG
    assert re.search(r"\b(0|100) % of the body's motion", finding.text)
    assert "masses" in finding.advice


def test_swapped_channels_are_named(tmp_path: Path) -> None:
    case = sound()
    channels = case.run.channels
    swapped = channels | {S1: channels[U1], U1: channels[S1]}
    (found,) = findings(tmp_path, case.run._replace(channels=swapped), case.site)["channel_swapped"]
    assert f"{S1} looks like {U1}" in found.text
    assert S2 not in found.text.replace(U2, "")


@pytest.mark.parametrize("factor", [3.0, 0.5])
def test_noise_that_is_not_the_declared(factor: float, tmp_path: Path) -> None:
    case = sound()
    sensor = case.site.sensor
    density = tuple(d / factor for d in sensor.noise_density_ug_per_rthz)
    other = sensor.model_copy(update={"noise_density_ug_per_rthz": density})
    found = findings(tmp_path, case.run, case.site.model_copy(update={"sensor": other}))
    assert list(found) == ["noise"]
    assert len(found["noise"]) == 4


def with_vehicle(site: Site, **changes: float) -> Site:
    vehicle = site.vehicles[0].model_copy(update=changes)
    return site.model_copy(update={"vehicles": (vehicle,)})


def test_another_truck_than_declared(tmp_path: Path) -> None:
    case = sound()
    for wheelbase_m in (3.9, 4.9, 5.2):  # with the last one the axles seem to move oppositely
        other = with_vehicle(case.site, wheelbase_m=wheelbase_m)
        assert list(findings(tmp_path, case.run, other)) == ["wheelbase"]
    light = findings(tmp_path, case.run, with_vehicle(case.site, total_mass_kg=3300.0))
    assert [finding.state for finding in light["spring_over_mass"]] == [CheckStatus.WRONG] * 2


def test_missing_channels_samples_and_rates(tmp_path: Path) -> None:
    case = sound()
    run = case.run
    three = {name: values for name, values in run.channels.items() if name != U2}
    assert "channels_present" in findings(tmp_path, run._replace(channels=three), case.site)
    kept = np.abs(run.accel_time_s - case.entry_s - 1.0) > 0.2
    part = {name: values[kept] for name, values in run.channels.items()}
    gap = run._replace(accel_time_s=run.accel_time_s[kept], channels=part)
    assert "longest gap 0.4" in findings(tmp_path, gap, case.site)["gaps"][0].text
    sensor = case.site.sensor.model_copy(update={"rate_hz": (1000.0, 1000.0, 1000.0, 2000.0)})
    other = case.site.model_copy(update={"sensor": sensor})
    (found,) = findings(tmp_path, run, other)["sampling_rate"]
    assert found.text.startswith(f"{U2}: 1000.0 samples a second, 2000 declared")


def test_folder_of_another_rate_is_checked_but_not_imported() -> None:
    folder = Path(__file__).parents[2] / "data" / "csv_example"
    site = sound().site
    assert site.sensor.rate_hz != (100.0,) * 4
    with pytest.raises(InputError, match="gives a rate of 100 Hz"):
        normalised_runs([folder], site, "site.toml", site.vehicles[0].id)
    (run,) = recorded_runs(folder, site, "site.toml")
    assert run.rates_hz == pytest.approx(dict.fromkeys(CHANNELS, 100.0))


def test_receiver_that_is_not_as_declared(tmp_path: Path) -> None:
    case = sound()
    track = case.run.gnss

    def seen(changed: GnssTrack) -> dict[str, list[CheckFinding]]:
        return findings(tmp_path, case.run._replace(gnss=changed), case.site)

    rng = np.random.default_rng(3)
    count = track.time_s.size
    hole = (track.time_s < track.time_s[20]) | (track.time_s > track.time_s[45])
    columns = [None if column is None else column[hole] for column in track]
    assert "position_gaps" in seen(GnssTrack(*columns))  # type: ignore[arg-type]
    jump = np.where(np.arange(count) >= 50, 2e-4, 0.0)
    found = seen(track._replace(latitude_deg=track.latitude_deg + jump))
    assert "1 jump" in found["position_jumps"][0].text
    loud = track.speed_m_per_s + 0.5 * rng.standard_normal(count)
    assert "speed_noise" in seen(track._replace(speed_m_per_s=loud))
    scattered = track.longitude_deg + 1.5 / 90e3 * rng.standard_normal(count)
    assert "position_noise" in seen(track._replace(longitude_deg=scattered))


def test_clocks(tmp_path: Path) -> None:
    case = sound()
    start_ns = round(case.run.accel_time_s[0] * 1e9)

    def later(stream: str, offset_ns: Callable[[int], int]) -> Callable[[Message], Message]:
        def change(message: Message) -> Message:
            if message.key.stream != stream:
                return message
            decode, encode = (
                (decode_accel, encode_accel) if stream == "accel" else (decode_gnss, encode_gnss)
            )
            stamped = decode(message.payload)
            wall_ns = stamped.wall_time_ns + offset_ns(stamped.wall_time_ns - start_ns)
            return message._replace(payload=encode(stamped._replace(wall_time_ns=wall_ns)))

        return change

    apart = findings(tmp_path, case.run, case.site, later("gnss", lambda since: 200_000_000))
    assert list(apart) == ["clock_offset"]
    assert "200.0 ms apart" in apart["clock_offset"][0].text
    stepped = findings(
        tmp_path,
        case.run,
        case.site,
        later("accel", lambda since: 80_000_000 if since > 7_000_000_000 else 0),
    )
    assert "80.0 ms" in stepped["clock_steps"][0].text


def moved(site: Site, **changes: float) -> Site:
    bridge = site.bridges[0]
    shifted = {key: getattr(bridge, key) + value for key, value in changes.items()}
    return site.model_copy(update={"bridges": (bridge.model_copy(update=shifted),)})


def test_bridges_that_lie_beside_the_road(tmp_path: Path) -> None:
    case = sound()
    run, site = case.run, case.site
    # About 30 m of the bridge go 27 m to the east and 14 m to the north.
    aside = moved(site, start_latitude_deg=9e-4, end_latitude_deg=9e-4)
    assert (
        "from the line between the bearings"
        in findings(tmp_path, run, aside)["bridge_place"][0].text
    )
    near = moved(site, start_latitude_deg=1.2e-4, end_latitude_deg=1.2e-4)
    assert "bridge_lateral" in findings(tmp_path, run, near)
    turned = moved(site, start_latitude_deg=3e-5)
    assert "bridge_angle" in findings(tmp_path, run, turned)
    far = moved(site, start_latitude_deg=1.0, end_latitude_deg=1.0)
    assert findings(tmp_path, run, far)["bridge_crossed"][0].state is CheckStatus.OPEN


def test_lane_that_contradicts_the_wheel_path_is_open(tmp_path: Path) -> None:
    case = sound()
    for lane_m, is_named in ((1.75, False), (-1.75, False), (7.5, True), (-7.5, True)):
        bridge = case.site.bridges[0].model_copy(update={"lane_offset_m": lane_m})
        site = case.site.model_copy(update={"bridges": (bridge,)})
        found = findings(tmp_path, case.run, site)
        assert ("lane_driven" in found) is is_named, (lane_m, found)
    (finding,) = found["lane_driven"]
    assert finding.state is CheckStatus.OPEN
    assert "lane_offset_m is -7.5" in finding.text
    assert "lane_offset_m" in finding.advice


def test_a_recording_that_begins_too_late(tmp_path: Path) -> None:
    case = sound()
    run = case.run
    late = run.accel_time_s > case.entry_s - 0.6
    cut = run._replace(
        accel_time_s=run.accel_time_s[late],
        channels={name: values[late] for name, values in run.channels.items()},
    )
    found = findings(tmp_path, cut, case.site)
    assert (
        "7 m of road recorded before the bridge, up to 39 m can be used"
        in found["approach_before"][0].text
    )


def standstill(noise_ug: float, rate_hz: float = 500.0) -> Run:
    """A minute with a running engine of 13 Hz, and a receiver that does not move."""
    rng = np.random.default_rng(8)
    time_s = 1.7e9 + np.arange(round(60 * rate_hz)) / rate_hz
    white = noise_ug * MICRO_G_M_PER_S2 * np.sqrt(0.5 * rate_hz)
    shaken = 0.05 * np.sin(2.0 * np.pi * 26.0 * (time_s - 1.7e9))
    channels = {
        name: white * rng.standard_normal(time_s.size) + (shaken if name in (S1, S2) else 0.0)
        for name in CHANNELS
    }
    fixes_s = 1.7e9 + 0.1 * np.arange(600)
    still = np.zeros(600)
    track = GnssTrack(
        fixes_s, still + 36.1106, still + 140.101, still, 0.02 * rng.random(600), None
    )
    return Run("standstill", time_s, rate_hz, channels, track)


@pytest.mark.parametrize(("noise_ug", "is_wrong"), [(25.0, False), (40.0, True), (10.0, True)])
def test_minute_of_standstill_measures_the_noise(
    noise_ug: float, is_wrong: bool, tmp_path: Path
) -> None:
    sensor = sound().site.sensor.model_copy(update={"rate_hz": (500.0,) * 4})
    site = sound().site.model_copy(update={"sensor": sensor})
    found = findings(tmp_path, standstill(noise_ug), site)
    assert ("noise" in found) == is_wrong
    assert found["channels_in_place"][0].state is CheckStatus.OPEN


def test_few_fixes_are_named_with_the_number_needed(tmp_path: Path) -> None:
    """A receiver of 1 Hz has some ten in a trial drive of ten seconds."""
    run = standstill(25.0)
    few = GnssTrack(*(None if values is None else values[:9] for values in run.gnss))
    sensor = sound().site.sensor.model_copy(update={"rate_hz": (500.0,) * 4})
    site = sound().site.model_copy(update={"sensor": sensor})
    (found,) = findings(tmp_path, run._replace(gnss=few), site)["positions"]
    assert found.text == "9 fixes, at least 20 are needed"
    assert found.advice.startswith("record longer, or check")


def test_density_is_that_of_the_noise_whatever_lines_are_on_it() -> None:
    run = standstill(25.0)
    for values in run.channels.values():
        found = density(NoiseSegment(values, 500.0, True))
        assert found is not None
        assert found.ug_per_rthz == pytest.approx(25.0, rel=0.03)
        assert found.quietest_ug_per_rthz == pytest.approx(27.0, rel=0.1)
        assert found.unevenness < 1.5
    # At 200 Hz a driving truck's wheels hide it.
    assert density(NoiseSegment(run.channels[U1], 200.0, False)) is None
    assert density(NoiseSegment(run.channels[U1][:1000], 500.0, True)) is None


def test_motion_is_not_taken_for_noise(tmp_path: Path) -> None:
    """What falls with the frequency is no sensor's noise: it hides it."""
    case = sound()
    values = case.run.channels[U1]
    frequency = np.fft.rfftfreq(values.size, 1e-3)
    white = np.fft.rfft(0.05 * np.random.default_rng(4).standard_normal(values.size))
    shaken = np.fft.irfft(white * (frequency > 100.0) * (200.0 / (1.0 + frequency)) ** 2)
    channels = case.run.channels | {U1: values + np.resize(shaken, values.size)}
    found = findings(tmp_path, case.run._replace(channels=channels), case.site)
    (noise,) = found["noise"]
    assert noise.state is CheckStatus.OPEN
    assert "the truck's own motion hides it" in noise.text


def over_lobes(noise_ug: float, seed: int) -> NoiseSegment:
    """An axle at 11 m/s: the road between the zeros of a contact length of 0.2 m, and noise."""
    rng = np.random.default_rng(seed)
    rate_hz, count = 500.0, 5000
    white = MICRO_G_M_PER_S2 * np.sqrt(0.5 * rate_hz)
    frequency = np.fft.rfftfreq(count, 1.0 / rate_hz)
    contact = np.sinc(frequency * 0.2 / 11.0) * (190.0 / np.maximum(frequency, 20.0))
    road = np.fft.irfft(450.0 * contact * np.fft.rfft(white * rng.standard_normal(count)), count)
    return NoiseSegment(road + noise_ug * white * rng.standard_normal(count), rate_hz, False)


@pytest.mark.parametrize(("noise_ug", "state"), [(25.0, CheckStatus.WRONG), (75.0, CheckStatus.OK)])
def test_road_between_the_zeros_of_the_tyres_is_not_taken_for_noise(
    noise_ug: float, state: CheckStatus
) -> None:
    """At 500 Hz a whole lobe lies in the band; a sensor three times as noisy is seen beside it."""
    segments = [over_lobes(noise_ug, seed) for seed in range(20)]
    whole = [found.ug_per_rthz for found in map(density, segments) if found is not None]
    assert min(whole) > 1.3 * 25.0
    states = [noise_of(U1, segment, 25.0).state for segment in segments]
    assert state not in states


def test_noisier_sensor_is_found_while_driving() -> None:
    rng = np.random.default_rng(5)
    white = 40.0 * MICRO_G_M_PER_S2 * np.sqrt(250.0)
    states = [
        noise_of(U1, NoiseSegment(white * rng.standard_normal(5000), 500.0, False), 25.0).state
        for _ in range(20)
    ]
    assert states.count(CheckStatus.WRONG) >= 16
    assert CheckStatus.OK not in states


def test_the_site_file_alone() -> None:
    site = sound().site

    def states(changed: Site) -> dict[str, CheckStatus]:
        return {f.name: f.state for f in findings_of_site(changed, changed.vehicles[0])}

    usual = states(site)
    assert usual.pop("tyres") is CheckStatus.OPEN
    assert usual.pop("cg_height") is CheckStatus.OPEN
    assert set(usual.values()) == {CheckStatus.OK}
    assert states(with_vehicle(site, front_axle_to_cg_m=2.1))["axle_loads"] is CheckStatus.WRONG
    assert states(with_vehicle(site, total_mass_kg_spread=0.1))["total_mass"] is CheckStatus.WRONG
    assert states(with_vehicle(site, total_mass_kg=95_300.0))["total_mass"] is CheckStatus.WRONG
    assert states(with_vehicle(site, wheelbase_m=15.0))["wheelbase_declared"] is CheckStatus.WRONG
    known = with_vehicle(site, twin_tyre_distance_m=(0.0, 0.33))  # type: ignore[arg-type]
    assert states(known)["tyres"] is CheckStatus.OK
    assert states(with_vehicle(site, cg_height_m=1.1))["cg_height"] is CheckStatus.OK
    crawling = site.bridges[0].model_copy(update={"survey_speed_m_per_s": 2.0})
    assert (
        states(site.model_copy(update={"bridges": (crawling,)}))["survey_speed"]
        is CheckStatus.WRONG
    )
    slow = site.sensor.model_copy(
        update={"rate_hz": (50.0,) * 4, "noise_density_ug_per_rthz": (0.0,) * 4}
    )
    quiet = states(site.model_copy(update={"sensor": slow}))
    assert quiet["sampling_rate"] is quiet["noise_declared"] is CheckStatus.WRONG
    long = site.bridges[0].model_copy(update={"span_m": 33.0})
    assert (
        states(site.model_copy(update={"bridges": (long,)}))["bearings_distance"]
        is CheckStatus.WRONG
    )


def test_lane_and_torsion_are_a_line_each_where_declared() -> None:
    site = sound().site

    def lines(**more: float) -> list[str]:
        bridge = site.bridges[0].model_copy(update=more)
        changed = site.model_copy(update={"bridges": (bridge,)})
        found = findings_of_site(changed, changed.vehicles[0])
        return [f.text.split(": ", 1)[1] for f in found if f.name in ("lane", "torsion")]

    assert lines() == []
    assert lines(lane_offset_m=-1.5, torsional_frequency_ratio=2.0, deck_gyration_m=2.3) == [
        "lane 1.5 ± 0.3 m right of the axis, so the deck twists",
        "torsion with frequency ratio 2, radius of gyration 2.3 m",
    ]
    assert lines(lane_offset_m=0.2) == ["lane 0.2 ± 0.3 m left of the axis, which may be zero"]


def test_every_name_is_snake_case_and_says_one_thing() -> None:
    names = [f.name for f in findings_of_site(sound().site, sound().site.vehicles[0])]
    assert all(name == name.lower() and " " not in name for name in names)
    assert all(before != after for before, after in pairwise(names))


def test_sentence_on_several_channels_is_printed_once() -> None:
    advice = "record a minute at standstill"
    findings = [
        CheckFinding("rate", CheckStatus.OK, "a: 100 samples a second"),
        CheckFinding("rate", CheckStatus.OK, "b: 100 samples a second"),
        CheckFinding("rate", CheckStatus.OK, "c: 50 samples a second"),
        CheckFinding("noise", CheckStatus.OPEN, "a: noise unknown", advice),
        CheckFinding("noise", CheckStatus.OPEN, "b: noise unknown", advice),
        CheckFinding("noise", CheckStatus.OPEN, "c: noise at most 12", advice),
        CheckFinding("gaps", CheckStatus.OK, "no gap"),
    ]
    report = CheckReport("drive.mcap", tuple(findings), is_run=True)
    assert list(lines_of(report, is_brief=False)) == [
        "drive.mcap",
        "  ok     a, b: 100 samples a second",
        "  ok     c: 50 samples a second",
        f"  open   a, b: noise unknown; c: noise at most 12; {advice}",
        "  ok     no gap",
    ]
    assert list(lines_of(report, is_brief=True))[2] == "  ok     4 other findings (--json has all)"
