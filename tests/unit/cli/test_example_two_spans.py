"""The commands of docs/examples/two_spans find the weak element, in the order of the page."""

import re
import shlex
import shutil
from pathlib import Path

import pytest

from schemas.results import load_results
from services.cli import main as cli


def test_survey_of_two_spans_finds_and_reports_the_weak_element(
    project: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    name = Path("docs/examples/two_spans")
    page = (project / name / "README.md").read_text()
    plan, drives, results = re.findall(r"```sh\n(.*?)```", page, re.DOTALL)
    shutil.copytree(project / name, tmp_path / name)
    monkeypatch.chdir(tmp_path)
    cli._parser().parse_args(shlex.split(plan)[1:])
    for line in (drives + results).splitlines():
        program, *arguments = shlex.split(line)
        assert program == ".venv/bin/driveby"
        assert cli.main(arguments) == 0, line
    fused = capsys.readouterr().out
    assert "Element 3 (13.3 to 20.0 m)" in fused
    found = load_results(tmp_path / "survey.json")
    assert [crossing.verdict for crossing in found.crossings] == ["good", "good"]
    state = found.bridges["mill-brook"]
    assert len(state.crossings_used) == 2
    ratios = {n: state.elements[f"EI_{n}"] for n in range(1, 7)}
    assert ratios[3].q025 < 0.6 * 6.0e9 < ratios[3].q975
    assert ratios[3].q975 < min(one.q025 for n, one in ratios.items() if n != 3)
    report = (tmp_path / "survey.html").read_text()
    assert "Element 3 (13.3 to 20.0 m)" in report
