"""What `driveby fuse` says beside its table."""

import json
import time
from pathlib import Path
from typing import Any

import pytest

import driveby
from schemas.results import load_results
from schemas.site_file import site_toml
from services.cli.main import main
from services.execution import fuse_results
from services.history.validation_files import save
from services.simulation.drive import paper_site
from tests.builders.certificates import certificate
from tests.unit.identification.test_fusing import crossing, write


def test_duplicate_results_count_once_and_are_reported(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    one = write(tmp_path / "one.json", [crossing(n) for n in range(3)])
    other = write(tmp_path / "other.json", [crossing(n) for n in range(1, 4)])
    assert main(["fuse", str(one), str(other)]) == 0
    out = " ".join(capsys.readouterr().out.split())
    assert "2 results of crossings that are also in another file; the newest" in out
    assert "bridge-1, 4 crossings fused" in out
    assert main(["fuse", str(one)]) == 0
    assert "another file" not in capsys.readouterr().out


def test_entries_less_than_5_s_apart_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first, later = crossing(0), crossing(1)
    for apart_s, vehicle, code in ((4.9, first.vehicle, 2), (-0.4, first.vehicle, 2),
                                   (5.1, first.vehicle, 0), (0.4, "other", 0)):  # fmt: skip
        moved = {"entry_time": first.entry_time + apart_s, "vehicle": vehicle}
        path = write(tmp_path / "r.json", [first, later.model_copy(update=moved)])
        assert main(["fuse", str(path)]) == code, apart_s
        error = capsys.readouterr().err
        assert ("begin less than 5 s apart, which is one crossing" in error) == (code == 2)
        assert error.count("\n") <= 1
        assert (later.crossing_id in error) == (code == 2)


def test_wider_intervals_are_explained_for_one_crossing_only(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for number, output in ((1, True), (2, False)):
        path = write(tmp_path / "r.json", [crossing(n) for n in range(number)])
        assert main(["fuse", str(path)]) == 0
        out = " ".join(capsys.readouterr().out.split())
        assert ("single crossing: intervals include" in out) is output


def test_element_weak_in_the_baseline_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """An unchanged element at 0.6 must not read as a bridge in order."""
    before, now = tmp_path / "before.json", tmp_path / "now.json"
    first = write(tmp_path / "first.json", [crossing(n) for n in range(2)])
    assert main(["fuse", str(first), "--json", str(before)]) == 0
    second = write(tmp_path / "second.json", [crossing(n) for n in range(2, 4)])
    capsys.readouterr()
    assert main(["fuse", str(second), "--baseline", str(before), "--json", str(now)]) == 0
    words = "was already clearly less stiff than the others in the baseline."
    assert words in " ".join(capsys.readouterr().out.split())
    finding = load_results(now).bridges["bridge-1"].finding
    assert finding is not None
    assert "No element has clearly changed" in finding
    assert words in finding


@pytest.mark.parametrize("by", ["--baseline", "--site"])
def test_simulated_baseline_of_measured_crossings_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], by: str
) -> None:
    first = write(tmp_path / "first.json", [crossing(n) for n in range(2)])
    before = tmp_path / "before.json"
    assert main(["fuse", str(first), "--json", str(before)]) == 0
    bridge = paper_site().bridges[0].model_copy(update={"baseline": "before.json", "elements": 5})
    site = tmp_path / "site.toml"
    site.write_text(site_toml(paper_site().model_copy(update={"bridges": (bridge,)})))
    given = [by, str(before if by == "--baseline" else site)]
    caution = (
        "bridge-1: The baseline was simulated and these crossings were measured, so a difference "
    )
    for realm, is_named in (("import-drives", True), ("sim-y", False)):
        capsys.readouterr()
        later = [crossing(n).model_copy(update={"realm": realm}) for n in range(2, 4)]
        assert main(["fuse", str(write(tmp_path / "now.json", later)), *given]) == 0
        assert (caution in capsys.readouterr().err) == is_named


def test_baseline_of_the_site_file_is_compared_with(tmp_path: Path) -> None:
    first = write(tmp_path / "first.json", [crossing(n) for n in range(2)])
    assert main(["fuse", str(first), "--json", str(tmp_path / "before.json")]) == 0
    bridge = paper_site().bridges[0].model_copy(update={"baseline": "before.json", "elements": 5})
    site = tmp_path / "site.toml"
    site.write_text(site_toml(paper_site().model_copy(update={"bridges": (bridge,)})))
    second = write(tmp_path / "second.json", [crossing(n) for n in range(2, 4)])
    states = []
    for options in (["--site", str(site)], ["--baseline", str(tmp_path / "before.json")], []):
        now = tmp_path / "now.json"
        assert main(["fuse", str(second), *options, "--json", str(now)]) == 0
        states.append(load_results(now).bridges["bridge-1"])
    of_site, given, without = states
    assert of_site == given
    assert without.probability_of_loss is None is not given.probability_of_loss


def test_unresolved_element_of_the_baseline_has_no_printed_loss(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first = write(tmp_path / "first.json", [crossing(n) for n in range(2)])
    before = tmp_path / "before.json"
    assert main(["fuse", str(first), "--json", str(before)]) == 0
    results = json.loads(before.read_text())
    results["bridges"]["bridge-1"]["EI_2"] |= {"mean": 5e10, "std": 2.5e10, "q975": 1e11}
    before.write_text(json.dumps(results))
    second = write(tmp_path / "second.json", [crossing(n) for n in range(2, 4)])
    capsys.readouterr()
    assert main(["fuse", str(second), "--baseline", str(before)]) == 0
    out = capsys.readouterr().out
    (line,) = (line for line in out.splitlines() if "EI_2" in line)
    assert line.rstrip().endswith("not resolved")
    assert "Element 2 is not resolved in the baseline" in " ".join(out.split())


@pytest.mark.parametrize("command", ["fuse", "report"])
def test_a_recording_or_folder_is_refused_with_what_is_wanted(
    command: str, project: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recording = project / "recordings/sample/crossing.mcap"
    for path, words in (
        (recording, f"driveby identify {recording} --json RESULTS.json computes them"),
        (tmp_path, f"is a folder, results files are expected: those of a worker are {tmp_path}/"),
    ):
        assert main([command, str(path)]) == 2
        error = capsys.readouterr().err
        assert words in error
        assert error.count("\n") == 1


def test_results_without_a_crossing_name_where_crossings_come_from(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["fuse", str(write(tmp_path / "bridges.json", []))]) == 2
    assert "holds no crossing; driveby identify --into" in capsys.readouterr().err


def test_combined_days_name_the_commands_that_show_a_change(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for second, is_printed in (("20260101T120000.000Z", False), ("20260102T110000.000Z", True)):
        names = [f"truck-1.bridge-1.{entry}" for entry in ("20260101T110000.000Z", second)]
        some = [
            crossing(n).model_copy(update={"crossing_id": name}) for n, name in enumerate(names)
        ]
        path = write(tmp_path / "r.json", some)
        assert main(["fuse", str(path)]) == 0
        out = " ".join(capsys.readouterr().out.split())
        assert ("driveby history and driveby alarm check show whether" in out) is is_printed


@pytest.mark.parametrize(
    ("numbers", "line"),
    [
        (
            (0, 1),
            "bridge-1: The baseline consists of the same crossings: the measurement is",
        ),
        ((1, 2), "bridge-1: One of these crossings is in the baseline, too: a change is under"),
        ((2, 3), None),
    ],
)
def test_baseline_of_the_same_crossings_is_a_warning(
    numbers: tuple[int, ...],
    line: str | None,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    recwarn: pytest.WarningsRecorder,
) -> None:
    before = tmp_path / "before.json"
    first = write(tmp_path / "first.json", [crossing(0), crossing(1)])
    assert main(["fuse", str(first), "--json", str(before)]) == 0
    now = write(tmp_path / "now.json", [crossing(number) for number in numbers])
    capsys.readouterr()
    assert main(["fuse", str(now), "--baseline", str(before)]) == 0
    error = capsys.readouterr().err
    assert (line is None and not error) or (line is not None and line in " ".join(error.split()))
    driveby.fuse(now, baseline=before)
    warned = [str(one.message) for one in recwarn if one.category is UserWarning]
    assert [one[: len(line or "")] for one in warned] == ([] if line is None else [line])


def test_fused_intervals_without_a_passed_site_validation_have_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    site, toml = paper_site(), tmp_path / "site.toml"
    toml.write_text(site_toml(site))
    path = write(tmp_path / "r.json", [crossing(n) for n in range(2)])
    asked = ["fuse", str(path)]
    assert main(asked) == 0
    line = "truck-1 on bridge-1: the results name no passed site validation; give --site SITE.toml"
    assert capsys.readouterr().out.count(line) == 1
    asked += ["--site", str(toml), "--validations", str(tmp_path)]
    for words in (f"The folder {tmp_path} has no site validation of", "Site validation of"):
        assert main(asked) == 0
        assert capsys.readouterr().out.count(f"bridge-1: {words} truck-1 on this bridge") == 1
        save(tmp_path, certificate(site, passed=False))
    save(tmp_path, certificate(site))
    assert main(asked) == 0
    out = capsys.readouterr().out
    assert out.count("bridge-1: Site validation of truck-1: passed; ") == 1
    assert "No site validation" not in out


def test_folder_of_validation_records_and_site_file_must_exist(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = write(tmp_path / "r.json", [crossing(0)])
    for option in ("--validations", "--site"):
        assert main(["fuse", str(path), option, str(tmp_path / "none")]) == 2
        assert str(tmp_path / "none") in capsys.readouterr().err


def test_fused_results_are_dated_by_the_start_of_fusing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As identified ones are: reports call it the start."""
    began_s: list[float] = []
    fuse_bridge = fuse_results._state

    def watched(*given: Any) -> Any:
        began_s.append(time.time())
        return fuse_bridge(*given)

    monkeypatch.setattr(fuse_results, "_state", watched)
    path = write(tmp_path / "r.json", [crossing(n) for n in range(2)])
    before_s = time.time()
    fused = driveby.fuse(path)
    assert before_s <= fused.results.created <= began_s[0]
