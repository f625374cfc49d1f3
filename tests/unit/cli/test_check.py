"""`driveby check` from its arguments to its exit codes."""

import json
from pathlib import Path

import pytest

from schemas.site_file import site_toml
from services.cli import main as cli
from services.recordings.writer import write_recording
from services.simulation.drive import paper_site
from tests.unit.drives.recorded import drive


def test_the_sample_is_in_order(project: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["check", str(project / "recordings/sample/crossing.mcap")]) == 0
    out = capsys.readouterr().out
    lines = out.splitlines()
    assert lines[0].endswith("crossing.mcap: site.toml")
    assert [line for line in lines if line.startswith("  wrong")] == []
    assert "unsprung_rear: noise 25" in out
    assert "bridge-1, start to end: 27 m of road recorded before the bridge" in out
    assert lines[-1] == "0 wrong, 2 open"


def test_shared_site_of_recordings_is_checked_once(
    project: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    sample = str(project / "recordings/sample/crossing.mcap")
    assert cli.main(["check", sample, sample]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line for line in lines if not line.startswith(" ")] == [
        f"{sample}: site.toml",
        f"{sample}, run 1 of truck-1",
        f"{sample}, run 1 of truck-1",
        "0 wrong, 2 open",
    ]


def test_recording_with_another_site_reports_what_differs(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    site, names = paper_site(), ("a.mcap", "b.mcap")
    other = site.vehicles[0].model_copy(update={"cg_height_m": 1.1})
    for name, truck in zip(names, (site.vehicles[0], other), strict=True):
        text = site_toml(site.model_copy(update={"vehicles": (truck,)}))
        write_recording(tmp_path / name, drive(), site_toml=text, reason="test")
    cli.main(["check", *(str(tmp_path / name) for name in names)])
    second = capsys.readouterr().out.partition("b.mcap: site.toml\n")[2]
    of_site = second.partition("b.mcap, run")[0].splitlines()
    (line,) = (one for one in of_site if one.startswith("  "))
    assert line == "  ok     truck-1: height of the centre of gravity 1.1 m above the road"


def test_another_site_file_and_json(
    project: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = (project / "docs/site.example.toml").read_text(encoding="utf-8")
    site = tmp_path / "site.toml"
    site.write_text(text.replace("wheelbase_m = 4.4", "wheelbase_m = 5.2"), encoding="utf-8")
    sample = str(project / "recordings/sample/crossing.mcap")
    assert cli.main(["check", str(site), sample, "--json"]) == 1
    found = json.loads(capsys.readouterr().out)
    assert found["is_wrong"]
    assert [report["source"] for report in found["reports"]] == [
        str(site),
        f"{sample}, run 1 of truck-1",
    ]
    wrong = [
        finding["name"]
        for report in found["reports"]
        for finding in report["findings"]
        if finding["state"] == "wrong"
    ]
    assert wrong == ["wheelbase"]


def test_a_folder_of_csv_files(csv_example: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code = cli.main(["check", str(csv_example)])
    out = capsys.readouterr().out
    assert code == int("  wrong" in out)
    assert f"{csv_example}/site.toml" in out
    assert f"{csv_example}, run 1 of" in out


def test_many_runs_are_printed_briefly(shared: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = shared / "crossings" / "d3_edge_damage_4_runs"
    assert cli.main(["check", str(folder)]) == 0
    out = capsys.readouterr().out
    assert out.count("other findings (--json has all)") == 4


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["nowhere.mcap"], "nowhere.mcap"),
        (["{site}", "{site}"], "a second site file"),
        (["{empty}"], "holds no site.toml"),
        (["{site}", "{empty}"], "holds no accel_NN.csv"),
        ([], "a site file or recordings are expected, or --template NEW.toml"),
    ],
)
def test_bad_input(
    arguments: list[str],
    message: str,
    project: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    names = {"site": str(project / "docs/site.example.toml"), "empty": str(tmp_path)}
    assert cli.main(["check", *(a.format(**names) for a in arguments)]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


def test_site_is_an_option_or_an_argument(
    project: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    site = str(project / "docs/site.example.toml")
    sample = str(project / "recordings/sample/crossing.mcap")
    outputs = []
    for arguments in ([site, sample], [sample, "--site", site], ["--site", site, sample]):
        cli.main(["check", *arguments])
        outputs.append(capsys.readouterr().out)
    assert outputs[0].startswith(site)
    assert outputs[1] == outputs[0]
    assert outputs[2] == outputs[0]
    assert cli.main(["check", "--site", sample]) == 2
    assert f"--site: {sample} is not a .toml file" in capsys.readouterr().err
    assert cli.main(["check", site, "--site", site]) == 2
    assert "a second site file" in capsys.readouterr().err


def test_the_last_line_says_that_nothing_is_wrong(
    project: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = (project / "docs/site.example.toml").read_text(encoding="utf-8")
    known = "cg_height_m = 1.3\ntwin_tyre_distance_m = [0.0, 0.0]\ntyre_width_m = [0.3, 0.3]\n"
    site = tmp_path / "site.toml"
    site.write_text(text.replace("[vehicle]\n", f"[vehicle]\n{known}", 1))
    assert cli.main(["check", str(site)]) == 0
    assert capsys.readouterr().out.endswith(
        "\nnothing is wrong or open; driveby survey forecasts what a survey would detect\n"
    )
