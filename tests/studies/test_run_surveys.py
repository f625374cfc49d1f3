"""`driveby validate --method pre --surveys` from records to its two tables."""

from pathlib import Path

import pytest

from services.cli import main as cli
from services.identification import fusing
from studies.validation import run_surveys
from studies.validation.surveys import Forecast
from tests.studies.test_detection import WEAK, record

NOMINAL = 1.6e10


def test_both_tables_stand_within_80_characters(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    truth = {"truth": [NOMINAL * ratio for ratio in WEAK]}
    records = [
        record(kind, 0, number) | truth
        for kind in ("loaded-and-empty", "scenario-5")
        for number in range(16)
    ]
    monkeypatch.setattr(run_surveys, "run_surveys", lambda *of: records)
    monkeypatch.setattr(fusing, "_DRAWS_PER_CHAIN", 40)
    forecast = Forecast(0.234, 0.123)
    monkeypatch.setattr(run_surveys, "forecasts_of", lambda *of: {"scenario-5": forecast})
    arguments = ["validate", "--method", "pre", "--surveys", "1"]
    cli.main([*arguments, "--records", str(tmp_path / "surveys.jsonl")])
    lines = capsys.readouterr().out.splitlines()
    first, one, other, nothing, second, *groups = lines[:10]
    assert not nothing
    assert first.split()[-5:] == ["element", "plan", "level", "plan", "spread"]
    assert [line.split()[0] for line in (one, other)] == ["loaded-and-empty", "scenario-5"]
    assert " 23.4 % " in other
    assert " 12.3 % " in other
    assert second.split()[:2] == ["survey", "fused"]
    assert [line.split()[:2] for line in groups] == [
        ["scenario-5", str(size)] for size in (1, 2, 4, 8, 16)
    ]
    assert max(len(line) for line in lines[:10]) <= 80
    assert not any("…" in line.replace(" … ", " ") for line in lines[:10])
