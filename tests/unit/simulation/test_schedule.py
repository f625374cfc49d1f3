"""Times of simulated drives: `driveby simulate --runs --days --start`."""

from datetime import UTC, datetime
from pathlib import Path

import pytest

from schemas.site_file import site_toml
from services.catalogue.contents import summarise_recording
from services.cli.main import main
from services.simulation.drive import paper_site
from services.simulation.schedule import Schedule
from services.simulation.wide_crossings import site_text
from studies.simulation.tandem_cases import draw_tandem


@pytest.mark.parametrize("has_tandem", [False, True])
def test_days_of_runs_are_one_recording(tmp_path: Path, has_tandem: bool) -> None:
    site, out = tmp_path / "site.toml", tmp_path / "days.mcap"
    site.write_text(site_text(draw_tandem(12)) if has_tandem else site_toml(paper_site()))
    ratios = "1,1,1,1,1" if has_tandem else "1,1,1,1,1,1,1"
    given = ["simulate", "--site", str(site), "--ei", ratios, "--rate", "200", "--speed", "20"]
    when = ["--runs", "2", "--days", "2", "--start", "2026-05-01T10:00:00+02:00"]
    assert main([*given, *when, "-o", str(out)]) == 0
    passings = summarise_recording(out).passings
    begin = datetime(2026, 5, 1, 8, tzinfo=UTC).timestamp()
    after = [1e-9 * one.entry_ns - begin for one in passings]
    expected = [0.0, 600.0, 86_400.0, 87_000.0]
    assert after == pytest.approx([after[0] + one for one in expected], abs=0.3)
    assert 0.0 < after[0] < 10.0


def test_schedule_in_words() -> None:
    start_s = datetime(2026, 5, 4, 9, 10, tzinfo=UTC).timestamp()
    whens = ((1, 1), (3, 1), (1, 5), (3, 5, start_s))
    assert [Schedule(*one).in_words(7.25) for one in whens] == [
        "7.2 s, from 2026-01-01 00:00:00 UTC",
        "3 runs of 7.2 s, from 2026-01-01 00:00:00 UTC",
        "5 days, 7.2 s, from 2026-01-01 00:00:00 UTC",
        "5 days, 3 runs of 7.2 s, from 2026-05-04 09:10:00 UTC",
    ]


@pytest.mark.parametrize(
    ("given", "line"),
    [
        (["--start", "soon"], '--start: is "soon", it must be a time as 2026-05-01T09:30:00'),
        (["--start", "2026-05-01T09:30:00"], "has no zone"),
        (["--start", "9999999999"], "it must be a time from 1970 to 2100"),
        (["--runs", "100", "--days", "11"], "--days: makes 1100 runs, it must be at most 1000"),
    ],
)
def test_impossible_schedule_is_one_line(
    given: list[str], line: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "a.mcap"
    assert main(["simulate", "--scenario", "6", *given, "-o", str(out)]) == 2
    error = capsys.readouterr().err
    assert line in error
    assert error.count("\n") == 1
    assert not out.exists()
