"""`driveby import` names the gaps of a drive: where, how long, and whether on a bridge."""

from collections.abc import Callable
from pathlib import Path

import pytest

from services.cli.main import main

BEGIN_S = 1_790_000_000.0


def without(text: str, begin_s: float, end_s: float) -> str:
    """Remove the rows of a time since the begin, both ends included."""
    head, *rows = text.splitlines()
    kept = [
        row
        for row in rows
        if not begin_s - 1e-6 <= float(row.split(",")[0]) - BEGIN_S <= end_s + 1e-6
    ]
    return "\n".join([head, *kept]) + "\n"


@pytest.fixture
def warnings_of(
    csv_example: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> Callable[..., str]:
    def imported(
        *gaps: tuple[float, float], fixes: tuple[float, float] = (9.0, 9.0), site: str = ""
    ) -> str:
        folder = tmp_path / "drive"
        folder.mkdir(exist_ok=True)
        accel = (csv_example / "accel_00.csv").read_text()
        for begin_s, end_s in gaps:
            accel = without(accel, begin_s, end_s)
        (folder / "accel_00.csv").write_text(accel)
        (folder / "gps_00.csv").write_text(
            without((csv_example / "gps_00.csv").read_text(), *fixes)
        )
        of_site = (csv_example / "site.toml").read_text()
        (folder / "site.toml").write_text(site or of_site)
        command = ["import", folder, "--site", folder / "site.toml", "--force", "-o"]
        assert main([*map(str, command), str(tmp_path / "a.mcap")]) == 0
        return capsys.readouterr().err

    return imported


def test_gap_on_the_bridge_has_place_and_length(warnings_of: Callable[..., str]) -> None:
    """The truck drives 10 m/s, its front axle enters 2 s after the first sample."""
    assert "no samples" not in warnings_of()
    assert (
        "accel_00.csv: no samples for 2.01 s, from 2.49 s after its first sample (2026-09-21 "
        "14:13:22 UTC): on bridge-x, front axle from 5.9 to 26.0 m, so its crossing will not be "
        "good"
    ) in warnings_of((2.5, 4.49))


def test_gap_before_the_bridge_is_no_harm_to_a_crossing(warnings_of: Callable[..., str]) -> None:
    words = warnings_of((0.1, 0.29))
    assert "no samples for 0.21 s" in words
    assert "on no bridge of the site file" in words
    assert "will not be good" not in words


def test_outage_of_the_receiver_is_named(warnings_of: Callable[..., str]) -> None:
    assert "no fix for 2.00 s, from 2.00 s after" in warnings_of(fixes=(2.1, 3.9))
    assert "no fix" not in warnings_of(fixes=(2.1, 3.2))


def test_many_gaps_are_counted_after_those_on_bridges(warnings_of: Callable[..., str]) -> None:
    gaps = [(0.1 + 0.2 * n, 0.1 + 0.2 * n) for n in range(5)]
    lines = [one for one in warnings_of(*gaps, (3.0, 3.0)).splitlines() if "accel_00" in one]
    assert "no samples for 0.02 s, from 2.99 s" in lines[0]
    assert "on bridge-x, front axle from 10.9 to 11.1 m" in lines[0]
    assert [("on no bridge" in one) for one in lines[1:3]] == [True, True]
    assert lines[3].endswith("accel_00.csv: 3 more gaps, 0.06 s in all")
