"""A year of a fleet, whole: the right alarms, and no others."""

from pathlib import Path

import pytest

from tests.faults.year import REPAIRED_S, WEAKENS_S, year

pytestmark = [pytest.mark.faults]


def test_the_right_alarms_and_no_others(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert year(tmp_path, seed=1) == 0
    assert "the right alarms, and no others" in capsys.readouterr().out
    assert (tmp_path / "figures/bridge-07-history.png").exists()


def test_a_year_without_its_end_lacks_an_alarm(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The judge is one: before August there is no alarm of bridge-07, and that is said."""
    assert REPAIRED_S < WEAKENS_S
    assert year(tmp_path, seed=1, weeks=24) == 1
    assert "found [('bridge-03', 5, 'stiffer', True)]" in capsys.readouterr().out
