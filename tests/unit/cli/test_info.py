"""`driveby info`, on recordings of which everything is known."""

import json
from pathlib import Path

import pytest

from services.recordings.recording import read_info, read_messages
from services.recordings.writer import write_recording
from tests.builders.commands import run
from tests.unit.drives.recorded import START_NS, drive


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Two trucks with a gap, a file that was cut off, and one that is none."""
    folder = tmp_path / "drives"
    folder.mkdir()
    gap = drive(leave_out=range(100, 130))
    write_recording(folder / "one.mcap", gap, site_toml=None, reason="test")
    second = drive("truck-2", begin_s=100.0)
    write_recording(folder / "two.mcap", second, site_toml=None, reason="test")
    whole = (folder / "two.mcap").read_bytes()
    (folder / "two.mcap").write_bytes(whole[: len(whole) // 4])
    (folder / "none.mcap").write_text("not at all")
    return folder


def test_sample_is_printed_in_full(capsys: pytest.CaptureFixture[str], project: Path) -> None:
    code, out, err = run(capsys, "info", project / "recordings/sample/crossing.mcap")
    assert (code, err) == (0, "")
    assert "319 kB, complete" in out
    assert "2026-01-01 00:00:00.0 to 00:00:08.9 UTC, 8.9 s" in out
    assert "site: truck-1 over bridge-1 (30 m, 7 elements)" in out
    assert "accel: 179 messages, 20 a second" in out
    assert "sprung_front, sprung_rear, unsprung_front, unsprung_rear: 1000 Hz" in out
    assert "no gaps in the samples" in out
    assert "no silences of more than a second" in out
    assert "1 crossing\n  2026-01-01 00:00:02.6  truck-1 over bridge-1, start to end" in out


def test_a_folder_is_a_line_a_file_and_a_sum(
    capsys: pytest.CaptureFixture[str], folder: Path
) -> None:
    code, out, err = run(capsys, "info", folder)
    assert (code, err) == (0, "")
    heading, first, second, none, total = out.splitlines()
    assert heading.split() == [
        "from", "(UTC)", "length", "trucks", "crossings", "gaps", "size", "state", "recording",
    ]  # fmt: skip
    assert first.startswith("2023-11-14 22:13:20  9.9 s")
    assert first.split()[-1] == str(folder / "one.mcap")
    assert "not known" in first  # there is no site file
    assert "being written or cut off" in second  # from outside both look alike
    assert none.startswith(f"{folder / 'none.mcap'}: is not an MCAP file")
    assert total.startswith("3 recordings, ")
    assert total.endswith(", 2 trucks, 0 crossings")


def test_crossing_continued_in_the_next_file_counts_once(
    capsys: pytest.CaptureFixture[str], project: Path, tmp_path: Path
) -> None:
    """A logger that was restarted during a crossing leaves two files with a part each."""
    sample = project / "recordings/sample/crossing.mcap"
    messages = list(read_messages(sample))
    middle_ns = messages[0].log_time_ns + 4_400_000_000
    site = read_info(sample).site_toml
    for name, is_first in (("one", True), ("two", False)):
        part = [m for m in messages if (m.log_time_ns < middle_ns) == is_first]
        write_recording(tmp_path / f"{name}.mcap", part, site_toml=site, reason="test")
    code, out, _ = run(capsys, "info", tmp_path)
    _, first, second, total = out.splitlines()
    assert (code, " 1 " in first, " 1 " in second) == (0, True, True)
    assert total.endswith(", 1 truck, 1 crossing")
    _, out, _ = run(capsys, "info", sample, tmp_path)
    assert out.splitlines()[-1].endswith(", 1 truck, 1 crossing")


def test_drives_of_one_start_are_named(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    """As of simulations without --start: identify counts the first only."""
    for name, left_out in (("one", range(0)), ("two", range(100, 130)), ("three", range(90, 130))):
        sent = drive(leave_out=left_out)
        write_recording(tmp_path / f"{name}.mcap", sent, site_toml=None, reason="test")
    later = drive("truck-2", begin_s=100.0)
    write_recording(tmp_path / "later.mcap", later, site_toml=None, reason="test")
    _, out, _ = run(capsys, "info", tmp_path)
    assert out.splitlines()[-2] == (
        "truck-1: 3 recordings start at 2023-11-14 22:13:20.0; if they are different drives, "
        "identify counts only the first one"
    )
    assert "truck-2: " not in out


def test_json_holds_all_fields(capsys: pytest.CaptureFixture[str], folder: Path) -> None:
    code, out, _ = run(capsys, "info", folder, "--json")
    assert code == 0
    by_name = {Path(one["path"]).name: one for one in json.loads(out)["recordings"]}
    assert by_name["none.mcap"]["error"].startswith("is not an MCAP file")
    one = by_name["one.mcap"]
    assert (one["begin"], one["is_closed"], one["is_cut_off"]) == (START_NS / 1e9, True, False)
    (gap,) = one["gaps"]
    assert (gap["vehicle"], gap["stream"]) == ("truck-1", "accel")
    assert gap["end"] - gap["begin"] == pytest.approx(1.55)
    assert one["trucks"][0]["streams"]["accel"]["missing"] == 30
    assert by_name["two.mcap"]["is_cut_off"]
    assert by_name["two.mcap"]["is_closed"] is False
    assert one["site"] is None


def test_crossings_by_another_site_file(
    capsys: pytest.CaptureFixture[str], project: Path, csv_example: Path
) -> None:
    sample = project / "recordings/sample/crossing.mcap"
    code, out, _ = run(capsys, "info", sample, "--json")
    (found,) = json.loads(out)["recordings"]
    assert code == 0
    assert found["crossings"][0]["direction"] == "start_to_end"
    assert found["crossings"][0]["passage"] == "through"
    assert found["site"]["bridges"][0]["span_m"] == 30.0
    code, out, _ = run(capsys, "info", sample, "--json", "--site", csv_example / "site.toml")
    assert (code, json.loads(out)["recordings"][0]["crossings"]) == (0, [])


def test_what_is_named_and_cannot_be_read_is_bad_input(
    capsys: pytest.CaptureFixture[str], folder: Path, tmp_path: Path
) -> None:
    (tmp_path / "empty").mkdir()
    for path, words in (
        (folder / "none.mcap", "is not an MCAP file"),
        (folder / "missing.mcap", "no such file"),
        (tmp_path / "empty", "holds no recording (.mcap)"),
    ):
        code, out, err = run(capsys, "info", path)
        assert (code, out) == (2, "")
        assert words in err
        assert err.count("\n") == 1
