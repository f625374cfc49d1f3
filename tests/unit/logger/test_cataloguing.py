"""Rows of closed files: written by a process of their own, the last ones by the logger itself."""

import shutil
import subprocess
import sys
import threading
from collections.abc import Sequence
from pathlib import Path

import pytest

from services.catalogue.index import read_catalog
from services.common.child_process import ChildOutput
from services.common.stores import folder_at
from services.logger import cataloguing
from services.logger.cataloguing import Cataloguing
from tests.waiting import LONGEST_S, until

SAMPLE = Path(__file__).parents[3] / "recordings" / "sample" / "crossing.mcap"
PROGRAM = """
import sys
from pathlib import Path
from services.logger import cataloguing

cataloguing._COLLECT_S = 0.01
folder = Path(sys.argv[1])
rows = cataloguing.Cataloguing(folder)
rows.add(folder / "live" / "2026-01-01" / "truck-1.mcap")
sys.stdin.read()
print("pyarrow" in sys.modules)
rows.close()
"""


def closed_file(folder: Path, name: str = "truck-1.mcap") -> Path:
    path = folder / "live" / "2026-01-01" / name
    path.parent.mkdir(parents=True, exist_ok=True)
    shutil.copy(SAMPLE, path)
    return path


def row_names(folder: Path) -> list[str]:
    return sorted(Path(path).name for path in read_catalog(folder_at(str(folder))).rows)


def test_the_packages_of_the_catalogue_stay_out_of_the_logger(tmp_path: Path) -> None:
    closed_file(tmp_path)
    arguments = [sys.executable, "-c", PROGRAM, str(tmp_path)]
    with subprocess.Popen(
        arguments, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        until(lambda: row_names(tmp_path) == ["truck-1.mcap"], "the row of the closed file")
        out, _ = process.communicate("", timeout=LONGEST_S)
    assert (process.returncode, out) == (0, "False\n")


def test_files_left_at_the_end_have_rows_when_it_is_closed(tmp_path: Path) -> None:
    rows = Cataloguing(tmp_path)
    rows.add(closed_file(tmp_path))
    rows.close()
    assert row_names(tmp_path) == ["truck-1.mcap"]


def test_large_files_do_not_hold_up_the_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO")
    first, *others = (closed_file(tmp_path, f"truck-{n}.mcap") for n in range(3))
    monkeypatch.setattr(cataloguing, "_AT_END_BYTES", 2 * first.stat().st_size - 1)
    rows = Cataloguing(tmp_path)
    for recording in (first, *others):
        rows.add(recording)
    rows.close()
    assert row_names(tmp_path) == [first.name]
    assert "2 closed files are not in the catalogue yet; `driveby catalog" in caplog.text


def test_a_slow_disk_does_not_hold_up_the_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO")
    monkeypatch.setattr(cataloguing, "_AT_END_S", 0.0)
    rows = Cataloguing(tmp_path)
    for n in range(3):
        rows.add(closed_file(tmp_path, f"truck-{n}.mcap"))
    rows.close()
    assert row_names(tmp_path) == ["truck-0.mcap"]
    assert "2 closed files are not in the catalogue yet; `driveby catalog" in caplog.text


def test_rows_of_an_interrupted_process_are_left_to_the_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO")
    has_begun = threading.Event()

    def interrupted(arguments: Sequence[str], closing: threading.Event) -> ChildOutput | None:
        has_begun.set()
        assert closing.wait(LONGEST_S)
        return None

    monkeypatch.setattr(cataloguing, "_COLLECT_S", 0.01)
    monkeypatch.setattr(cataloguing, "run_gently", interrupted)
    rows = Cataloguing(tmp_path)
    rows.add(closed_file(tmp_path))
    assert has_begun.wait(LONGEST_S)
    rows.add(closed_file(tmp_path, "truck-2.mcap"))
    rows.close()
    assert row_names(tmp_path) == ["truck-2.mcap"]
    assert "1 closed files are not in the catalogue yet" in caplog.text


def test_a_row_that_cannot_be_written_is_logged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(cataloguing, "_COLLECT_S", 0.01)
    broken = closed_file(tmp_path)
    broken.write_bytes(b"not MCAP")
    rows = Cataloguing(tmp_path)
    rows.add(broken)
    until(lambda: caplog.records, "the warning")
    rows.close()
    assert "truck-1.mcap is not in the catalogue yet: " in caplog.text
