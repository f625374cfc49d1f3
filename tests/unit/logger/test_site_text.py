"""The site file in new recordings of a running logger."""

import logging
from functools import partial
from pathlib import Path

import pytest

from schemas.signals import GnssFix, encode_gnss
from schemas.site_file import site_toml
from schemas.topics import Key, Message
from services.common.errors import InputError
from services.logger import run as logger
from services.logger.settings import LoggerSettings
from services.logger.site_text import RecordedSite
from services.logger.writer import FileWriter
from services.recordings.recording import read_info
from services.simulation.drive import paper_site
from tests.waiting import until

NOW_NS = 1_700_000_000_000_000_000
VALID = site_toml(paper_site())
EDITED = VALID + "# edited\n"


@pytest.fixture
def path(tmp_path: Path) -> Path:
    path = tmp_path / "site.toml"
    path.write_text(VALID)
    return path


def fix(vehicle: str) -> Message:
    payload = encode_gnss(GnssFix(1, 0, 0, NOW_NS, 50.0, 8.0, 100.0, 10.0))
    return Message(Key("live", "vehicle", vehicle, "gnss"), payload, 1, 0, NOW_NS, NOW_NS)


def opened(folder: Path, vehicle: str) -> bool:
    return any(folder.glob(f"live/*/{vehicle}-*.mcap"))


def test_next_recording_contains_the_edited_site_file(path: Path, tmp_path: Path) -> None:
    folder = tmp_path / "recordings"
    asked = LoggerSettings(folder=folder, site=path, min_free=0.0)
    writer = FileWriter(logger._check(asked, asked.limits)[0])
    for vehicle, text in (("truck-1", VALID), ("truck-2", EDITED), ("truck-3", "[vehicle")):
        path.write_text(text)
        assert writer.put(fix(vehicle))
        until(partial(opened, folder, vehicle))
    writer.finish("done", {})
    found = {
        path.name.rsplit("-", 1)[0]: read_info(path).site_toml
        for path in folder.glob("live/*/*.mcap")
    }
    assert found == {"truck-1": VALID, "truck-2": EDITED, "truck-3": EDITED}


@pytest.mark.parametrize("bad", ["[vehicle", "[vehicle]\nid = 5\n", None])
def test_invalid_site_file_is_one_warning_and_changes_nothing(
    path: Path, bad: str | None, caplog: pytest.LogCaptureFixture
) -> None:
    site = RecordedSite(path)

    def spoil() -> None:
        path.unlink() if bad is None else path.write_text(bad)

    with caplog.at_level(logging.INFO):
        spoil()
        assert [site.current(), site.current()] == [VALID, VALID]
        [first] = caplog.messages
        assert first.startswith(f"{path}: ")
        assert first.endswith("; new recordings keep the previous site file")
        path.write_text(EDITED)
        assert [site.current(), site.current()] == [EDITED, EDITED]
        spoil()
        assert site.current() == EDITED
    assert caplog.messages == [
        first,
        f"{path}: edited; new recordings contain the new text",
        first,
    ]


def test_site_file_restored_without_a_change_is_no_line(
    path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    site = RecordedSite(path)
    path.unlink()
    site.current()
    path.write_text(VALID)
    with caplog.at_level(logging.INFO):
        caplog.clear()
        assert site.current() == VALID
    assert caplog.messages == []


def test_invalid_site_file_at_the_start_is_refused(path: Path) -> None:
    path.write_text("[vehicle")
    with pytest.raises(InputError):
        RecordedSite(path)
