"""What a command prints that goes well stands on standard output; nothing else is in the way."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

from schemas.reasons import Reason
from schemas.results import load_results, results_json
from services.cli import main as cli
from services.recordings.recording import read_site
from tests.unit.history.test_history_store import crossings

SAMPLE = Path(__file__).parents[3] / "recordings" / "sample" / "crossing.mcap"


def run(project: Path, *arguments: object) -> subprocess.CompletedProcess[str]:
    """Run a command as the user does, to the end of its process."""
    command = [sys.executable, "-m", "driveby", *map(str, arguments)]
    return subprocess.run(command, cwd=project, capture_output=True, text=True, check=False)


@pytest.mark.process
def test_history_prints_nothing_else(project: Path, tmp_path: Path) -> None:
    """Libraries made with nanobind print a line for each object that outlives Python."""
    found, history = tmp_path / "found.json", tmp_path / "history"
    found.write_text(results_json(crossings(4)))
    for arguments in (
        ["add", found],
        [],
        ["bridge-1"],
        ["--sql", "SELECT count(*) FROM crossings"],
    ):
        done = run(project, "history", *arguments, "--history", history)
        assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.process
def test_identify_prints_nothing_else(project: Path, tmp_path: Path) -> None:
    """A search in which numbers overflow, for the sensors are said to be noisier than any."""
    site, out = tmp_path / "site.toml", tmp_path / "a.json"
    site.write_text(sample_site(noise_density_ug_per_rthz="1e6"))
    arguments = ["identify", SAMPLE, "--site", site, "--rrd", tmp_path / "a.rrd", "--json", out]
    done = run(project, *arguments)
    assert done.returncode == 0
    (line,) = done.stderr.splitlines()  # of the site file, and nothing of the overflow
    assert f"{site}: truck-1: noise 1e+06 µg/√Hz; typical is" in line
    [crossing] = load_results(out).crossings
    assert crossing.verdict == "rejected"
    assert Reason.FAILED not in crossing.reasons


@pytest.mark.parametrize(
    "values",
    [
        {"rate_hz": "10.0"},
        {"gain_spread": "0.0", "common_gain_spread": "0.0", "delay_spread_s": "0.0"},
    ],
)
def test_values_at_the_edge_fail_no_identification(
    values: dict[str, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    site, out = tmp_path / "site.toml", tmp_path / "a.json"
    site.write_text(sample_site(**values))
    assert cli.main(["identify", str(SAMPLE), "--site", str(site), "--json", str(out)]) == 0
    [crossing] = load_results(out).crossings
    assert Reason.FAILED not in crossing.reasons
    assert capsys.readouterr().err == ""


def sample_site(**values: str) -> str:
    """The site file of the sample with other values."""
    text = read_site(SAMPLE)
    assert text is not None
    for key, value in values.items():
        text, count = re.subn(rf"(?m)^{key} = .*$", f"{key} = {value}", text)
        assert count == 1, key
    return text
