"""A truck that names its sensors, from CSV files and a recording to check, tables and pages.

Left and right are made of a sound simulated drive: both read it, with opposite parts of a roll and
noise of their own.
"""

import csv
import json
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from schemas.signals import decode_accel
from schemas.site import Site
from schemas.site_file import site_toml
from schemas.site_sensors import PlacedSensor
from services.catalogue.contents import summarise_recording
from services.drives.runs import Run, run_to_messages
from services.drives.signals import signals_of_recording
from services.recordings.recording import read_messages
from services.recordings.writer import write_recording
from services.report.bridge import bridge_reports
from services.report.page import page
from services.viewer.panels.signals import acceleration_plots
from services.viewer.recording_page import recording_page
from tests.builders import commands
from tests.unit.inspection.test_inspection import findings, sound
from tests.unit.viewer.found import results_of, some_crossing


def placed(channel: str, lateral_m: float, **where: float) -> PlacedSensor:
    # The average of two has the noise of the drive that both are made of, and theirs.
    return PlacedSensor.model_validate(
        {
            "channel": channel,
            "on": "axle" if "axle" in where else "body",
            "lateral_m": lateral_m,
            "noise_density_ug_per_rthz": 35.4,
            **where,
        }
    )


@cache
def two_sided() -> tuple[Run, Site]:
    case = sound()
    vehicle, rng = case.site.vehicles[0], np.random.default_rng(7)
    rate = case.run.rate_hz
    channels, sensors = {}, []
    places = (
        ("sprung_front", {"position_m": 0.0}),
        ("sprung_rear", {"position_m": vehicle.wheelbase_m}),
        ("unsprung_front", {"axle": 1}),
        ("unsprung_rear", {"axle": 2}),
    )
    body_roll = 0.02 * np.sin(2 * np.pi * 1.3 * case.run.accel_time_s)
    for name, where in places:
        roll = body_roll if "position_m" in where else 0.5 * rng.standard_normal(body_roll.size)
        for side, sign in (("left", 1.0), ("right", -1.0)):
            noise = 25e-6 * 9.80665 * np.sqrt(0.5 * rate) * rng.standard_normal(roll.size)
            channels[f"{name}_{side}"] = case.run.channels[name] + sign * roll + noise
            sensors.append(placed(f"{name}_{side}", 0.4 * sign, **where))
    changed = vehicle.model_copy(update={"sensors": tuple(sensors)})
    site = case.site.model_copy(update={"vehicles": (changed,)})
    return case.run._replace(channels=channels), site


def recorded(folder: Path) -> Path:
    run, site = two_sided()
    path = folder / "two.mcap"
    messages = run_to_messages([run], site, "sim-two", site.vehicles[0].id)
    write_recording(path, messages, site_toml=site_toml(site), reason="test", force=True)
    return path


def test_sound_sensors_are_in_order(tmp_path: Path) -> None:
    run, site = two_sided()
    found = findings(tmp_path, run, site)
    # The noise of the sensors is not in the drive alone: whatever is said, it is of noise.
    assert set(found) <= {"noise", "wheelbase", "spring_over_mass"}


def test_missing_unknown_and_disagreeing_channels_are_named(tmp_path: Path) -> None:
    run, site = two_sided()
    channels = dict(run.channels)
    channels["cabin"] = channels.pop("unsprung_rear_left")
    found = findings(tmp_path, run._replace(channels=channels), site)
    (missing,) = found["channels_present"]
    assert missing.text == "7 of 8 accelerometers recorded, unsprung_rear_left missing"
    (unknown,) = found["channels_unknown"]
    assert unknown.text == "cabin recorded, but not in the site file"
    loud = run.channels | {"sprung_front_left": 1.3 * run.channels["sprung_front_left"]}
    (gain,) = findings(tmp_path, run._replace(channels=loud), site)["sensors_disagree"]
    assert "sprung_front_left (gain +2" in gain.text
    turned = run.channels | {"unsprung_front_left": -run.channels["unsprung_front_left"]}
    (sign,) = findings(tmp_path, run._replace(channels=turned), site)["channel_inverted"]
    assert sign.text == "A channel seems to have the wrong sign: unsprung_front_left"


def test_named_channels_are_recorded_and_exported(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    run, _ = two_sided()
    path = recorded(tmp_path)
    (signals,) = signals_of_recording(path)
    assert list(signals.channels) == sorted(run.channels)
    for name, values in run.channels.items():
        np.testing.assert_array_equal(signals.channels[name].acceleration_m_per_s2, values)
    batch = next(m for m in read_messages(path) if m.key.stream == "accel")
    assert len(decode_accel(batch.payload).channels) == 8
    code, out, err = commands.run(capsys, "info", path, "--json")
    assert (code, err) == (0, "")
    (truck,) = json.loads(out)["recordings"][0]["trucks"]
    assert set(truck["channel_rates_hz"]) == set(run.channels)
    folder = tmp_path / "tables"
    assert commands.run(capsys, "export", path, "--to", folder)[0] == 0
    with (folder / "accel_00.csv").open(newline="") as file:
        assert next(csv.reader(file)) == ["time_s", *sorted(run.channels)]
    again = tmp_path / "again.mcap"
    code, _, err = commands.run(
        capsys, "import", folder, "--site", folder / "site.toml", "-o", again
    )
    assert (code, err) == (0, "")
    (back,) = signals_of_recording(again)
    for name, series in signals.channels.items():
        np.testing.assert_array_equal(
            back.channels[name].acceleration_m_per_s2, series.acceleration_m_per_s2
        )


def test_check_lists_sensors_and_finds_a_column_that_is_missing(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    folder = tmp_path / "tables"
    assert commands.run(capsys, "export", recorded(tmp_path), "--to", folder)[0] == 0
    code, out, _ = commands.run(capsys, "check", folder / "site.toml")
    assert "unsprung_front_right: axle 1, 0.4 m to the right, 35.4 µg/√Hz" in out
    table = (folder / "accel_00.csv").read_text().splitlines()
    (folder / "accel_00.csv").write_text(
        "\n".join(line.rpartition(",")[0] for line in table) + "\n"
    )
    code, out, _ = commands.run(capsys, "check", folder, "--json")
    assert code == 1
    texts = [one["text"] for report in json.loads(out)["reports"] for one in report["findings"]]
    assert "7 of 8 accelerometers recorded, unsprung_rear_right missing" in texts


def test_sensors_of_one_side_are_one_line(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    folder = tmp_path / "tables"
    assert commands.run(capsys, "export", recorded(tmp_path), "--to", folder)[0] == 0
    _, site = two_sided()
    vehicle = site.vehicles[0]
    left = tuple(one for one in vehicle.sensors if one.lateral_m > 0.0)
    text = site_toml(
        site.model_copy(update={"vehicles": (vehicle.model_copy(update={"sensors": left}),)})
    )
    one_sided = tmp_path / "left.toml"
    one_sided.write_text(text)
    line = (
        'vehicle.sensors[2] ("unsprung_front_left") shows axle 1 on the left only, which hides '
        "its roll (roll_not_seen): put a second sensor on the other side, or this one in the middle"
    )
    code, _, err = commands.run(
        capsys, "import", folder, "--site", one_sided, "-o", tmp_path / "x.mcap"
    )
    assert code == 2
    assert err.endswith(f"{one_sided}: {line}\n")
    assert err.count("\n") == 1
    assert not (tmp_path / "x.mcap").exists()
    code, out, err = commands.run(capsys, "check", one_sided)
    assert code == 2
    assert line in out + err


def test_report_lists_the_sensors() -> None:
    _, site = two_sided()
    truck = site.vehicles[0].id
    results = results_of(site, some_crossing("a"), used="a")
    text = page(bridge_reports([(Path("a.json"), results, site)], None))
    assert "Sensors" in text
    assert f"{truck} unsprung_front_right: axle 1, 0.4 m to the right, 35.4 µg/√Hz" in text
    plain = site.model_copy(
        update={"vehicles": (site.vehicles[0].model_copy(update={"sensors": ()}),)}
    )
    text = page(bridge_reports([(Path("a.json"), results, plain)], None))
    assert f"{truck}: front and rear on body and axles" in text


def test_page_of_a_recording_lists_the_sensors(tmp_path: Path) -> None:
    text = recording_page(summarise_recording(recorded(tmp_path)))
    assert "8 accelerometers at" in text
    assert "  - unsprung_front_right: axle 1, 0.4 m to the right, 35.4 µg/√Hz" in text


def test_viewer_draws_all_named_channels() -> None:
    names = {"sprung_front_left", "sprung_rear", "unsprung_2_left", "axle_3", "cabin"}
    plots = acceleration_plots("root", names)
    contents = [str(plot.contents) for plot in plots]
    assert [str(plot.name) for plot in plots] == [
        "Body accelerations (m/s²)",
        "Axle accelerations (m/s²)",
        "Other accelerations (m/s²)",
    ]
    assert "$origin/sprung_front_left" in contents[0]
    assert "$origin/sprung_rear" in contents[0]
    assert "$origin/unsprung_2_left" in contents[1]
    assert "$origin/axle_3" in contents[2]
    assert "$origin/cabin" in contents[2]
