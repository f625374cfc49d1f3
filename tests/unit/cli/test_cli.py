"""The command line: exit codes, one line for every mistake, nothing half-written, a quick start."""

import gzip
import json
import logging
import os
import re
import resource
import subprocess
import sys
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path

import pytest

from schemas.signals import GnssFix, encode_gnss
from schemas.topics import Key, Message
from services.cli import main as cli
from services.common.errors import FailureError, InputError
from services.drives import importing
from services.logger.settings import LoggerSettings
from services.recordings.recording import read_info, read_messages, read_site
from services.recordings.writer import RecordingWriter, write_recording
from tests.builders.commands import run

EXAMPLE = Path(__file__).parents[2] / "data" / "csv_example"
COMMANDS = (
    "survey", "check", "simulate", "import", "identify", "info", "export", "report", "validate",
    "recover", "view", "demo", "logger", "worker", "truck", "gateway", "replay", "health",
)  # fmt: skip


INTERNAL = (
    "driveby: internal error, please report: RuntimeError: a b; "
    "run with --debug for the traceback\n"
)


@pytest.fixture(autouse=True)
def _logging_as_before() -> Iterator[None]:
    root = logging.getLogger()
    handlers, level = root.handlers[:], root.level
    yield
    root.handlers[:], root.level = handlers, level


def refused(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    """Run a command that must end with exit code 2 and one line; return the line."""
    code, out, err = run(capsys, *arguments)
    assert (code, out) == (2, "")
    assert err.startswith("driveby: ")
    assert err.endswith("\n")
    assert err.count("\n") == 1
    return err.removeprefix("driveby: ").rstrip("\n")


def listing(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


@pytest.fixture
def drive(tmp_path: Path) -> Path:
    """A copy of the example that a test may spoil."""
    folder = tmp_path / "drive"
    folder.mkdir()
    for path in EXAMPLE.iterdir():
        (folder / path.name).write_bytes(path.read_bytes())
    return folder


def spoil(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))


def test_import_writes_a_recording_with_its_site(
    capsys: pytest.CaptureFixture[str], drive: Path
) -> None:
    output = drive.parent / "drive.mcap"
    code, out, err = run(capsys, "import", drive, "--site", drive / "site.toml", "-o", output)
    assert (code, err) == (0, "")
    assert out == (f"{output}: 1 run of truck-x, 6.0 s, 241 messages, realm import-drives\n")
    assert read_site(output) == (drive / "site.toml").read_text()
    assert sum(read_info(output).messages.values()) == 241
    before = output.read_bytes()
    pair = (drive / "accel_00.csv", drive / "gps_00.csv")
    again = ("import", *pair, "--site", drive / "site.toml", "-o", output)
    assert "only with --force" in refused(capsys, *again)
    assert run(capsys, *again, "--force")[0] == 0
    assert output.read_bytes() == before  # replaced by the same


def test_import_of_a_real_drive(
    capsys: pytest.CaptureFixture[str], shared: Path, tmp_path: Path
) -> None:
    drive, output = shared / "real" / "comma2k19", tmp_path / "drive.mcap"
    code, out, err = run(capsys, "import", drive, "--site", EXAMPLE / "site.toml", "-o", output)
    assert (code, err) == (0, "")
    assert "1 run of truck-x, 60.0 s, " in out
    prefix = "driveby/v1/import-drives/vehicle/truck-x"
    counts = read_info(output).messages
    assert counts[f"{prefix}/gnss"] == counts[f"{prefix}/location"] == 579
    assert counts[f"{prefix}/accel"] == 1251


@pytest.mark.parametrize(
    ("name", "old", "new", "words"),
    [
        (
            "site.toml",
            "9000.0",
            "-9000.0",
            "site.toml: vehicle.total_mass_kg is -9000.0, it must be",
        ),
        ("site.toml", "span_m = 20.0", "span_m = 0", "site.toml: bridge.span_m is 0, it must be"),
        (
            "site.toml",
            "8.00026296",
            "8.0",
            "site.toml: bridge.end_latitude_deg and end_longitude_d",
        ),
        (
            "site.toml",
            "wheelbase_m",
            "wheel_base_m",
            "site.toml: vehicle.wheel_base_m is not a kno",
        ),
        ("site.toml", "[sensor]", "[sensor", "site.toml: line 26, column 8: is not TOML"),
        (
            "site.toml",
            "rate_hz = 100",
            "rate_hz = 1000",
            "accel_00.csv: time_s gives a rate of 100 ",
        ),
        (
            "accel_00.csv",
            "sprung_rear",
            "sprung_middle",
            'accel_00.csv: no column is sprung_rear, and "sprung_middle" is not known',
        ),
        (
            "accel_00.csv",
            "0.564480",
            "inf",
            "accel_00.csv: line 2: unsprung_rear is inf, it must be",
        ),
        ("accel_00.csv", "1790000000.030000", "12.5", "accel_00.csv: line 5: time_s is 12.5, it"),
        ("gps_00.csv", "time_s", "clock", "gps_00.csv: no column of times is known by its name"),
        (
            "gps_00.csv",
            "47.0",
            "147.0",
            "gps_00.csv: line 2: latitude_deg is 147.00000000, it must ",
        ),
    ],
)
def test_bad_files_give_one_line_and_leave_nothing(
    capsys: pytest.CaptureFixture[str], drive: Path, name: str, old: str, new: str, words: str
) -> None:
    spoil(drive / name, old, new)
    before = listing(drive.parent)
    arguments = ("import", drive, "--site", drive / "site.toml", "-o", drive.parent / "out.mcap")
    line = refused(capsys, *arguments)
    assert line.startswith(f"{drive}/{words}")
    assert listing(drive.parent) == before


def test_positions_of_another_day_give_one_line_and_leave_nothing(
    capsys: pytest.CaptureFixture[str], drive: Path
) -> None:
    path = drive / "gps_00.csv"
    path.write_text(path.read_text().replace("\n1790", "\n1791"))
    before = listing(drive.parent)
    output = drive.parent / "out.mcap"
    output.write_bytes(b"\x89MCAP0\r\nkept")
    arguments = ("import", drive, "--site", drive / "site.toml", "-o", output)
    line = refused(capsys, *arguments, "--force")
    assert line.startswith(f"{path}: time_s goes from 1791000000.000 to ")
    assert listing(drive.parent) == {**before, "out.mcap": b"\x89MCAP0\r\nkept"}


def test_missing_files_and_places_are_named(
    capsys: pytest.CaptureFixture[str], drive: Path
) -> None:
    before = listing(drive.parent)
    none, site, output = drive / "none", drive / "site.toml", drive.parent / "out.mcap"
    assert f"{none}: no such file" in refused(capsys, "import", drive, "--site", none, "-o", output)
    assert f"{none}: no such" in refused(capsys, "import", none, "--site", site, "-o", output)
    assert f"{none}: no such" in refused(
        capsys, "import", drive / "accel_00.csv", none, "--site", site, "-o", output
    )
    assert "is a folder" in refused(capsys, "import", drive, "--site", site, "-o", drive)
    assert "does not exist" in refused(
        capsys, "import", drive, "--site", site, "-o", none / "out.mcap"
    )
    three = [drive / "accel_00.csv"] * 3
    assert "3 files or folders given" in refused(
        capsys, "import", *three, "--site", site, "-o", output
    )
    assert listing(drive.parent) == before


def test_unusual_site_file_is_warned_of_and_used(
    capsys: pytest.CaptureFixture[str], drive: Path
) -> None:
    site, output = drive / "site.toml", drive.parent / "out.mcap"
    text = site.read_text()
    site.write_text(text.replace("rthz = 25.0", "rthz = 0.025"))
    arguments = ("import", drive, "--site", site, "-o", output)
    code, _, err = run(capsys, *arguments)
    assert code == 0
    assert f"{site}: truck-x: noise 0.025 µg/√Hz; typical is" in err
    assert "in mg/√Hz? then it is 25" in err
    code, out, _ = run(capsys, "check", site)
    assert code == 1
    assert "in mg/√Hz? then it is 25" in out
    site.write_text(text)
    _, _, err = run(capsys, *arguments, "--force")
    assert "usual" not in err
    code, out, _ = run(capsys, "check", site)
    assert "bridge-x: first natural frequency 6.8 Hz" in out


def test_import_previews_writes_a_map_and_reads_by_it(
    capsys: pytest.CaptureFixture[str], drive: Path
) -> None:
    site, output, named = drive / "site.toml", drive.parent / "out.mcap", drive.parent / "map.toml"
    accel = drive / "accel_00.csv"
    own = "Time,Body front [m/s2],Body rear [m/s2],Axle front [m/s2],Axle rear [m/s2]"
    accel.write_text("\n".join([own, *accel.read_text().splitlines()[1:]]))
    before = listing(drive.parent)
    arguments = ("import", drive, "--site", site)
    assert "required: -o/--output, or --preview" in refused(capsys, *arguments)
    line = refused(capsys, *arguments, "-o", output)
    assert line.startswith(f"{drive}: is read by guesses that change numbers (accel_00.csv: by th")
    assert "--preview" in line
    code, shown, _ = run(capsys, *arguments, "--preview")
    assert (code, listing(drive.parent)) == (0, before)
    assert (
        'guess: accel_00.csv: by their names: sprung_front is column "Body front [m/s2]"' in shown
    )
    drawn = drive.parent / "as-read.png"
    assert run(capsys, *arguments, "--preview", "--picture", drawn)[0] == 0
    assert drawn.read_bytes().startswith(b"\x89PNG")
    drawn.unlink()
    assert listing(drive.parent) == before
    assert run(capsys, *arguments, "--write-map", named)[0] == 0
    assert run(capsys, *arguments, "--map", named, "-o", output)[0] == 0
    by_map = list(read_messages(output))
    assert run(capsys, *arguments, "--yes", "-o", output, "--force")[0] == 0
    assert [one.payload for one in read_messages(output)] == [one.payload for one in by_map]
    other = drive.parent / "other.toml"
    other.write_text(site.read_text())
    assert "only a map of an import" in refused(capsys, *arguments, "--write-map", other)
    line = refused(capsys, "check", drive)
    assert "is read by guesses" in line
    assert f"driveby check has none of these options: driveby import {drive} --site " in line


def test_map_of_an_import_without_a_zone_leaves_the_zone_open(
    capsys: pytest.CaptureFixture[str], drive: Path
) -> None:
    for path in drive.glob("*.csv"):
        head, *rows = path.read_text().splitlines()
        cells = [row.split(",", 1) for row in rows]
        dated = [
            f"{datetime.fromtimestamp(float(s), UTC):%d.%m.%Y %H:%M:%S.%f},{rest}"
            for s, rest in cells
        ]
        path.write_text("\n".join([head, *dated]) + "\n")
    site, output, named = drive / "site.toml", drive.parent / "out.mcap", drive.parent / "map.toml"
    arguments = ("import", drive, "--site", site)
    line = refused(capsys, "check", drive)
    assert "times have no zone: give --zone UTC" in line
    assert "driveby check has none of these options" in line
    code, out, _ = run(capsys, *arguments, "--preview", "--write-map", named)
    assert code == 0
    assert "open: accel_00.csv and 1 more: times have no zone: shown as UTC, give --zone" in out
    assert "form: accel_00.csv and 1 more: dates are day, month, year\n" in out
    assert (
        f"{named}: fill in what is missing and check it, then driveby import --map {named}" in out
    )
    hole = '# zone = "Europe/Berlin"  # missing: fill in, or UTC, or +01:00'
    assert named.read_text().count(hole) == 2
    assert "times have no zone" in refused(capsys, *arguments, "--map", named, "-o", output)
    named.write_text(named.read_text().replace(hole, 'zone = "UTC"'))
    assert run(capsys, *arguments, "--map", named, "-o", output)[0] == 0
    _, out, _ = run(capsys, *arguments, "--preview", "--zone", "UTC")
    words = "dates are day, month, year, in UTC where they name no zone"
    assert f"form: accel_00.csv and 1 more: {words}" in out


def test_map_of_an_import_without_a_unit_leaves_the_unit_open(
    capsys: pytest.CaptureFixture[str], drive: Path
) -> None:
    site, output, named = drive / "site.toml", drive.parent / "out.mcap", drive.parent / "map.toml"
    accel = drive / "accel_00.csv"
    rows = [row.split(",") for row in accel.read_text().splitlines()[1:]]
    wild = [
        ",".join([row[0], *(f"{1000.0 * float(cell):.4f}" for cell in row[1:])]) for row in rows
    ]
    head = "time_s,Body front,Body rear,Axle front,Axle rear"
    accel.write_text("\n".join([head, *wild]) + "\n")
    arguments = ("import", drive, "--site", site)
    line = refused(capsys, *arguments, "--yes", "-o", output)
    assert "the unit of the accelerations is undetermined" in line
    code, out, _ = run(capsys, *arguments, "--preview", "--write-map", named)
    assert code == 0
    assert "open: accel_00.csv: the unit of the accelerations is undetermined" in out
    assert f"{named}: fill in what is missing and check it, then driveby import" in out
    hole = '  # missing: add unit = "m/s2" (or g, mg, ug, cm/s2, mm/s2, ft/s2)'
    assert named.read_text().count(hole) == 4
    assert "is undetermined" in refused(capsys, *arguments, "--map", named, "-o", output)
    named.write_text(named.read_text().replace(f" }}{hole}", f', unit = "mm/s2" }}{hole}'))
    assert run(capsys, *arguments, "--map", named, "-o", output)[0] == 0


def test_map_that_cannot_be_written_is_named_in_the_error(
    capsys: pytest.CaptureFixture[str], drive: Path
) -> None:
    named, accel = drive.parent / "map.toml", drive / "accel_00.csv"
    accel.write_text(accel.read_text().replace("time_s,", "tick,", 1))
    line = refused(
        capsys, "import", drive, "--site", drive / "site.toml", "--preview", "--write-map", named
    )
    assert line.endswith(f"(--map); {named} was not written")
    assert not named.exists()


def test_the_vehicle_must_be_chosen_where_there_are_several(
    capsys: pytest.CaptureFixture[str], drive: Path
) -> None:
    site, output = drive / "site.toml", drive.parent / "out.mcap"
    text = site.read_text()
    table = text[text.index("[vehicle]") : text.index("[bridge]")].replace(
        "[vehicle]", "[[vehicle]]"
    )
    site.write_text(table + table.replace("truck-x", "truck-y") + text[text.index("[bridge]") :])
    arguments = ("import", drive, "--site", site, "--force", "-o", output)
    assert refused(capsys, *arguments).endswith("choose with --vehicle one of truck-x, truck-y")
    assert "holds no vehicle z" in refused(capsys, *arguments, "--vehicle", "z")
    code, _, _ = run(capsys, *arguments, "--vehicle", "truck-y", "--name", "second")
    assert code == 0
    assert "driveby/v1/import-second/vehicle/truck-y/accel" in read_info(output).messages
    assert "--realm" in refused(capsys, *arguments, "--vehicle", "truck-y", "--name", "A B")


def test_imports_of_one_campaign_share_a_realm(
    capsys: pytest.CaptureFixture[str], drive: Path
) -> None:
    site, output = drive / "site.toml", drive.parent / "out.mcap"
    arguments = ("import", drive, "--site", site, "--force", "-o", output)

    def realm(*more: object) -> str:
        assert run(capsys, *arguments, *more)[0] == 0
        (found,) = {topic.split("/")[2] for topic in read_info(output).messages}
        return found

    assert realm() == "import-drives"
    drive = drive.rename(drive.parent / "later")
    site = drive / "site.toml"
    arguments = ("import", drive, "--site", site, "--force", "-o", output)
    assert realm() == "import-drives"
    site.write_text(site.read_text() + '\n[import]\nname = "isar"\n')
    assert realm() == "import-isar"
    assert realm("--realm", "elbe") == "import-elbe"
    assert realm("--realm", "import-elbe") == "import-elbe"
    site.write_text(site.read_text().replace('"isar"', '"Isar 1"'))
    assert 'import.name is "Isar 1", it must be an identifier' in refused(capsys, *arguments)


def gnss_only(path: Path) -> None:
    """A recording of a truck whose accelerometers never came."""
    messages = [
        Message(
            Key("import-test", "vehicle", "truck-x", "gnss"),
            encode_gnss(GnssFix(1, i, i, 1_790_000_000_000_000_000 + i, 47.0, 8.0, 400.0, 10.0)),
            1,
            i,
            1_790_000_000_000_000_000 + i,
            1_790_000_000_000_000_000 + i,
        )
        for i in range(20)
    ]
    site = (EXAMPLE / "site.toml").read_text()
    write_recording(path, messages, site_toml=site, reason="test")


def test_recordings_that_cannot_be_identified(
    capsys: pytest.CaptureFixture[str], drive: Path
) -> None:
    pytest.importorskip("services.cli.identify")
    output = drive.parent / "out.json"
    recording = drive.parent / "gnss.mcap"
    gnss_only(recording)
    before = listing(drive.parent)
    for path, words in (
        (drive / "none.mcap", "none.mcap: no such file"),
        (drive / "site.toml", "site.toml: "),
        (recording, "gnss.mcap: "),
    ):
        assert words in refused(capsys, "identify", path, "--json", output)
    assert "accel" in refused(capsys, "identify", recording)
    assert listing(drive.parent) == before


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], "the following arguments are required: COMMAND"),
        (["fly"], "invalid choice: 'fly'"),
        (["simulate", "-o", "x"], "--scenario or --ei is required"),
        (["simulate", "--scenario", "13", "-o", "x"], '--scenario: is "13", it must be 1 to 12'),
        (["simulate", "--scenario", "6"], "required: -o/--output"),
        (["simulate", "--scenario", "6", "--ei", "1,1", "-o", "x"], "not allowed with argument"),
        (["simulate", "--ei", "1,,1", "-o", "x"], '--ei: is "", it must be ratios from 0.001'),
        (["simulate", "--ei", "1,-1", "-o", "x"], '--ei: is "-1", it must be ratios'),
        (["simulate", "--scenario", "6", "--road", "AB", "-o", "x"], "--road: invalid choice"),
        (["simulate", "--scenario", "6", "--noise", "-1", "-o", "x"], "must be a noise density"),
        (["simulate", "--scenario", "6", "--noise", "nan", "-o", "x"], "must be a noise density"),
        (["simulate", "--scenario", "6", "--speed", "8:", "-o", "x"], "must be a speed in m/s"),
        (["simulate", "--scenario", "6", "--seed", "1.5", "-o", "x"], "a seed, a whole number"),
        (
            ["simulate", "--scenario", "6", "--departed-vehicle", "3e5:17", "-o", "x"],
            "(N:M_PER_S:S)",
        ),
        (["simulate", "--scenario", "6", "--tyres", "wide", "-o", "x"], "--tyres: invalid choice"),
        (["simulate", "--scenario", "6", "--runs", "0", "-o", "x"], "a number of runs, a whole"),
        (["simulate", "--scenario", "6", "--wander", "-1", "-o", "x"], "a standard deviation in m"),
        (
            ["simulate", "--scenario", "6", "--rear-offset", "5", "-o", "x"],
            "must be an offset in m",
        ),
        (
            ["simulate", "--scenario", "6", "--drive-seed", "a", "-o", "x"],
            "must be a seed, a whole",
        ),
        (
            ["simulate", "--scenario", "6", "--bearing-stiffness", "3:3e9", "-o", "x"],
            '--bearing-stiffness: is "3", it must be vertical stiffnesses in N/m (START:END) from',
        ),
        (["validate", "--effects", "swing,wind"], "must be all or some of free, sprung"),
        (["simulate", "--scen", "6", "-o", "x"], "--scenario or --ei is required"),
        (["validate", "--scenarios", "1,0"], '--scenarios: is "0", it must be 1 to 12'),
        (["replay"], "required: REC.mcap"),
        (["replay", "x", "--speed", "-2"], '--speed: is "-2", it must be a factor from 0'),
        (["truck", "x", "--speed", "0"], '--speed: is "0", it must be a factor from 0.001'),
    ],
)
def test_wrong_options_give_one_line(
    capsys: pytest.CaptureFixture[str], arguments: list[str], words: str
) -> None:
    line = refused(capsys, *arguments)
    assert words in line
    assert re.search(r"\(see driveby ?\w* --help\)$", line)


@pytest.mark.parametrize(
    "option", [("--tyres", "twin"), ("--rear-offset", "0"), ("--wander", "0")], ids=lambda o: o[0]
)
def test_only_a_surface_has_axles_beside_one_another(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, option: tuple[str, str]
) -> None:
    output = tmp_path / "x.mcap"
    line = refused(capsys, "simulate", "--scenario", "6", *option, "-o", output)
    assert line == f"{option[0]}: has no effect without --road-surface"
    assert not output.exists()


def test_lists_and_ranges_are_read() -> None:
    parser = cli._parser()
    options = parser.parse_args(
        ["simulate", "--ei", "1,.4,1", "--speed", "8:12", "--gps-noise", "-o", "x.mcap"]
    )
    assert (options.ei, options.speed, options.gps_noise) == ((1, 0.4, 1), (8, 12), True)
    options = parser.parse_args(["simulate", "--scenario", "6", "--speed", "9", "-o", "x.mcap"])
    assert (options.scenario, options.speed, options.gps_noise) == (6, (9, 9), False)
    assert parser.parse_args(["validate"]).scenarios == tuple(range(1, 13))
    assert parser.parse_args(["validate", "--scenarios", "1, 6,1"]).scenarios == (1, 6)


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_help_with_an_example(
    capsys: pytest.CaptureFixture[str], command: str
) -> None:
    with pytest.raises(SystemExit) as left:
        cli.main([command, "--help"])
    assert left.value.code == 0
    text = " ".join(capsys.readouterr().out.split())
    example = text.split(f"example: driveby {command}")
    assert len(example) == 2
    # The example itself must be understood.
    arguments = [command, *example[1].split("&&")[0].split()]
    assert callable(cli._parser().parse_args(arguments).handler)


def test_the_commands_offered_are_those_that_exist(capsys: pytest.CaptureFixture[str]) -> None:
    assert all(command in refused(capsys, "none") for command in COMMANDS)
    assert "'listen'" in refused(capsys, "listen").split("(choose from")[0]
    assert "listen" not in refused(capsys, "none")


@pytest.mark.parametrize(
    ("error", "code", "line"),
    [
        (InputError("x.csv: line 3:\n is bad"), 2, "driveby: x.csv: line 3: is bad\n"),
        (FailureError("nobody answers"), 1, "driveby: nobody answers\n"),
        (KeyboardInterrupt(), 130, "driveby: interrupted\n"),
        (
            RuntimeError("a\nb"),
            1,
            INTERNAL,
        ),
    ],
)
def test_errors_become_a_line_and_an_exit_code(
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    error: BaseException,
    code: int,
    line: str,
) -> None:
    def fail(*_: object, **__: object) -> str:
        raise error

    monkeypatch.setattr(importing, "import_command", fail)
    arguments = ("import", "x", "--site", "s", "-o", "o")
    assert run(capsys, *arguments) == (code, "", line)
    _, _, err = run(capsys, "--debug", *arguments)
    assert ("Traceback" in err) == isinstance(error, RuntimeError)


@pytest.mark.parametrize("place", ["before", "after"])
def test_log_format_may_stand_before_or_after_the_command(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, place: str
) -> None:
    def talk(*_: object, **__: object) -> str:
        logging.getLogger("services.x").info("hello")
        return "done"

    monkeypatch.setattr(importing, "import_command", talk)
    options = ["--log-format", "json", "--verbose"]
    arguments = ["import", "x", "--site", "s", "-o", "o"]
    code, out, err = run(
        capsys, *(options + arguments if place == "before" else arguments + options)
    )
    assert (code, out) == (0, "done\n")
    record = json.loads(err)
    assert (record["level"], record["logger"], record["message"]) == ("info", "services.x", "hello")
    _, _, err = run(capsys, *arguments)
    assert err == ""


def driveby(*arguments: str) -> list[str]:
    return [sys.executable, "-m", "services.cli.main", *arguments]


def test_a_reader_that_leaves_early_is_no_error(project: Path) -> None:
    read, write = os.pipe()
    os.close(read)
    done = subprocess.run(
        driveby("import", str(EXAMPLE), "--site", f"{EXAMPLE}/site.toml", "-o", "/dev/null/x"),
        cwd=project, stdout=write, stderr=subprocess.PIPE, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 2  # nothing was printed, so nothing broke
    code = """
from services.cli import main as cli
from services.drives import importing
importing.import_command = lambda *_, **__: "x" * 100_000
raise SystemExit(cli.main(["import", "x", "--site", "s", "-o", "o"]))
"""
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=project, stdout=write, stderr=subprocess.PIPE, text=True, check=False,
    )  # fmt: skip
    os.close(write)
    assert (done.returncode, done.stderr) == (141, "")


def test_closed_pipe_costs_no_file_and_is_no_failure(project: Path, tmp_path: Path) -> None:
    """Neither that of `identify`, which prints before it writes, nor that of `fuse`."""
    before = project / "tests" / "data" / "before" / "0.1.0" / "pre-result.json.gz"
    stored, once, twice = (tmp_path / f"{name}.json" for name in ("stored", "once", "twice"))
    stored.write_bytes(gzip.decompress(before.read_bytes()))
    exact = "tests/data/noise_free.mcap"
    read, write = os.pipe()
    os.close(read)
    for arguments in (
        ("identify", exact, "--method", "least-squares", "--json", once),
        ("fuse", stored, "--json", twice),
    ):
        done = subprocess.run(
            driveby(*map(str, arguments)),
            cwd=project, stdout=write, stderr=subprocess.PIPE, text=True, check=False,
        )  # fmt: skip
        assert (done.returncode, done.stderr) == (141, "")
    os.close(write)
    for path in (once, twice):
        assert json.loads(path.read_text())["crossings"]


def test_help_and_version_are_quick(project: Path) -> None:
    """At most 0.3 s of a processor, the best of three: waiting for one is not what is measured."""
    for arguments, words in ((["--help"], "identify"), (["--version"], "driveby 0.")):
        seconds = []
        for _ in range(3):
            before = resource.getrusage(resource.RUSAGE_CHILDREN)
            done = subprocess.run(
                driveby(*arguments), cwd=project, capture_output=True, text=True, check=True
            )
            after = resource.getrusage(resource.RUSAGE_CHILDREN)
            seconds.append(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)
            assert words in done.stdout
        assert min(seconds) <= 0.3


def test_nothing_heavy_is_imported_at_the_start(project: Path) -> None:
    heavy = ("numpy", "numba", "zenoh", "rerun", "matplotlib", "pydantic", "scipy", "rich")
    code = f"import services.cli.main, sys; print([m for m in {heavy} if m in sys.modules])"
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=project, capture_output=True, text=True, check=True
    )
    assert done.stdout == "[]\n"


@pytest.mark.parametrize("command", ["simulate", "import", "recover", "identify"])
def test_no_command_replaces_a_recording_by_accident_or_while_it_is_written(
    command: str, csv_example: Path, project: Path, tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    """The logger wrote on into the unlinked file, said `durable`, and trucks freed their spools."""
    sample = project / "recordings" / "sample" / "crossing.mcap"
    target = tmp_path / "live.mcap"
    arguments = {
        "simulate": ["--scenario", "6", "-o"],
        "import": [str(csv_example), "--site", str(csv_example / "site.toml"), "-o"],
        "recover": [str(sample), "-o"],
        "identify": [str(sample), "--method", "least-squares", "--json"],
    }[command]
    living = RecordingWriter(target, reason="test")
    content = target.read_bytes()
    forces = [[], ["--force"]] if command != "identify" else [[]]
    for force in forces:
        assert cli.main([command, *arguments, str(target), *force]) == 2
        assert "is being written at this moment" in (printed := capsys.readouterr().err)
        assert printed.count("\n") == 1
    living.finish("done")
    content = target.read_bytes()
    assert cli.main([command, *arguments, str(target)]) == 2
    assert "is a recording, which is replaced only with --force" in capsys.readouterr().err
    assert target.read_bytes() == content
    assert list(tmp_path.iterdir()) == [target]
    if command != "identify":
        assert cli.main([command, *arguments, str(target), "--force"]) == 0
        assert target.read_bytes() != content


@pytest.mark.parametrize(
    ("given", "realms"),
    [([], ("live",)), (["--realm", "sim-a", "--realm", "replay-*"], ("sim-a", "replay-*"))],
)
def test_logger_records_the_chosen_realms(
    monkeypatch: pytest.MonkeyPatch, given: list[str], realms: object
) -> None:
    """And only live without: what appears in other realms is nobody's drive."""
    asked: list[LoggerSettings] = []

    def run(settings: LoggerSettings, ready: object) -> int:
        asked.append(settings)
        return 0

    monkeypatch.setattr("services.logger.run.run", run)
    assert cli.main(["logger", *given]) == 0
    assert [one.realms for one in asked] == [realms]


@pytest.mark.parametrize(
    ("given", "missing"),
    [(["--torsion", "2:2.3"], "--lane-offset"), (["--lane-offset", "1.5"], "--torsion")],
)
def test_half_a_twisting_deck_is_refused(
    given: list[str], missing: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "a.mcap"
    assert cli.main(["simulate", "--scenario", "6", *given, "-o", str(out)]) == 2
    assert f"is of use with {missing} only, which is missing" in capsys.readouterr().err
    assert not out.exists()
