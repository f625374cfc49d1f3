"""An archive of recordings: the results of one drive, gone on with, whatever cannot be read."""

import hashlib
import io
import os
import pickle
import resource
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from mcap.writer import Writer

from schemas.reasons import Reason
from schemas.results import CrossingResult
from schemas.settings import IdentificationSettings
from schemas.topics import Message
from services.common.errors import FailureError
from services.common.stores import folder_at, put
from services.execution import archive
from services.execution.archive import (
    ArchiveJob,
    ArchiveResult,
    group_into_drives,
    identify_archive,
    is_failed,
)
from services.execution.dispatch import failed_result
from services.execution.inline import InlineExecutor
from services.execution.offline import site_of
from services.execution.result_store import ResultStore
from services.finding import order as overview
from services.finding.crossing_data import CrossingData
from services.identification.bridge_state import NOTHING_STORED, with_common_shares
from services.identification.identify import identify
from services.identification.outputs import IdentificationTask
from services.recordings.recording import read_messages
from services.recordings.remote import Recording, RemoteRecording, recording_at
from services.recordings.writer import RecordingOrigin, RecordingWriter, write_recording
from tests.drives import EXACT, drives
from tests.identifications import identify_recordings

LEAST_SQUARES = IdentificationSettings(method="least_squares")


class Counting:
    """Identifies, and counts how often."""

    def __init__(self) -> None:
        self.ids: list[str] = []

    def __call__(
        self, data: CrossingData, settings: IdentificationSettings, **others: Any
    ) -> CrossingResult:
        self.ids.append(data.crossing_id)
        return identify(data, settings, **others)


_KNOWN: dict[bytes, CrossingResult] = {}


def identified_once(
    data: CrossingData, settings: IdentificationSettings, **others: Any
) -> CrossingResult:
    """Identify what has the same samples once: what becomes of a result is looked at here."""
    content = hashlib.sha256(pickle.dumps((data, settings))).digest()
    if content not in _KNOWN:
        _KNOWN[content] = identify(data, settings, **others)
    return _KNOWN[content]


def asked(*recordings: Recording) -> ArchiveJob:
    return ArchiveJob(recordings, site_of([EXACT], None), LEAST_SQUARES, NOTHING_STORED, {})


def done(
    into: Path, *recordings: Recording, identify: Callable[..., CrossingResult] = identified_once
) -> tuple[ArchiveResult, list[CrossingResult]]:
    crossings: list[CrossingResult] = []
    found = identify_archive(
        asked(*recordings), InlineExecutor(identify=identify), ResultStore(into), crossings.append
    )
    return found, sorted(crossings, key=lambda one: one.entry_time)


def timeless(crossing: CrossingResult) -> CrossingResult:
    diagnostics = {k: v for k, v in crossing.diagnostics.items() if k != "seconds"}
    return crossing.model_copy(update={"diagnostics": diagnostics})


@pytest.fixture(scope="module")
def five(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Five crossings in three recordings, all minutes apart."""
    return drives(tmp_path_factory.mktemp("drives"), 5, each=2)


@pytest.fixture
def same(five: list[Path], tmp_path: Path) -> list[Path]:
    """The same to be damaged."""
    copies = [tmp_path / "recordings" / path.name for path in five]
    copies[0].parent.mkdir()
    for path, copy in zip(five, copies, strict=True):
        copy.write_bytes(path.read_bytes())
    return copies


def test_results_are_those_of_all_recordings_together(five: list[Path], tmp_path: Path) -> None:
    whole = identify_recordings(five, site_of(five, None), LEAST_SQUARES)
    found, crossings = done(tmp_path / "into", *five)
    outcome = with_common_shares(crossings, found.bridges)
    assert [timeless(one) for one in outcome] == [timeless(one) for one in whole.crossings]
    assert found.bridges == whole.bridges
    assert (found.verdicts.total(), found.there, found.failed, found.problems) == (5, 0, (), ())


def test_what_is_there_is_not_identified_again(five: list[Path], tmp_path: Path) -> None:
    counting = Counting()
    _, first = done(tmp_path / "into", *five[:2], identify=counting)
    assert len(counting.ids) == 4
    found, all_five = done(tmp_path / "into", *five, identify=counting)
    assert found.there == 4
    assert len(counting.ids) == len(set(counting.ids)) == 5
    assert all_five[:4] == first  # to the last bit, and with the seconds that they took then


def test_process_killed_midway_resumes(five: list[Path], tmp_path: Path) -> None:
    class KilledError(Exception):
        pass

    class Dying(Counting):
        def __call__(self, *arguments: Any, **others: Any) -> CrossingResult:
            if len(self.ids) == 3:
                raise KilledError
            return super().__call__(*arguments, **others)

    dying, counting = Dying(), Counting()
    with pytest.raises(KilledError):
        done(tmp_path / "into", *five, identify=dying)
    found, crossings = done(tmp_path / "into", *five, identify=counting)
    assert (found.there, len(crossings)) == (3, 5)
    assert sorted(dying.ids + counting.ids) == sorted(c.crossing_id for c in crossings)


def test_a_recording_by_two_names_gives_each_crossing_once(
    five: list[Path], tmp_path: Path
) -> None:
    again = tmp_path / "again.mcap"
    again.write_bytes(five[0].read_bytes())
    counting = Counting()
    found, _ = done(tmp_path / "into", *five, again, five[1], identify=counting)
    assert found.verdicts.total() == len(counting.ids) == 5


def test_what_cannot_be_read_is_a_line_and_costs_itself_only(
    same: list[Path], tmp_path: Path
) -> None:
    gone, empty, other = (tmp_path / name for name in ("gone.mcap", "empty.mcap", "other.mcap"))
    empty.touch()
    other.write_bytes(b"no recording at all")
    found, crossings = done(tmp_path / "into", gone, same[0], empty, *same[1:], other)
    assert len(crossings) == 5
    assert sorted(line.split(": ")[0] for line in found.problems) == sorted(
        str(path) for path in (gone, empty, other)
    )
    assert any(line == f"{gone}: no such file" for line in found.problems)


def test_a_message_that_is_none_is_left_out_with_a_line(same: list[Path], tmp_path: Path) -> None:
    """Before the truck comes to the bridge: the crossing has all that it needs."""
    messages = list(read_messages(same[2]))
    number = next(n for n, m in enumerate(messages) if m.key.stream == "accel")
    messages[number] = messages[number]._replace(payload=b"\xff" * 30)
    wrong = tmp_path / "wrong.mcap"
    write_recording(wrong, messages, reason="test", site_toml=None)
    found, crossings = done(tmp_path / "into", *same[:2], wrong)
    assert len(crossings) == 5
    (line,) = found.problems
    assert line.startswith(f"{wrong}: 1 message is left out, first accel 0: ")


def test_a_recording_without_a_stream_is_a_line(same: list[Path], tmp_path: Path) -> None:
    def without(stream: str) -> list[Message]:
        return [m for m in read_messages(same[0]) if m.key.stream != stream]

    mute = tmp_path / "mute.mcap"
    write_recording(mute, without("accel"), reason="test", site_toml=None)
    found, crossings = done(tmp_path / "into", mute, *same[1:])
    assert len(crossings) == 3
    (line,) = found.problems
    assert line.startswith(f"{mute}: no accelerations")


def test_failure_is_logged_and_tried_again(five: list[Path], tmp_path: Path) -> None:
    def failing(
        data: CrossingData, settings: IdentificationSettings, **others: Any
    ) -> CrossingResult:
        if "T001003" in data.crossing_id:
            return failed_result(IdentificationTask(0, data, settings))
        return identified_once(data, settings, **others)

    found, crossings = done(tmp_path / "into", *five, identify=failing)
    (name,) = found.failed
    assert "T001003" in name
    assert [c.crossing_id for c in crossings if is_failed(c)] == [name]
    assert found.verdicts["rejected"] == 1
    found, crossings = done(tmp_path / "into", *five)
    assert (found.there, found.failed) == (4, ())
    assert all(Reason.FAILED not in one.reasons for one in crossings)


def test_recordings_that_follow_each_other_are_one_drive(tmp_path: Path) -> None:
    """Ten minutes from one to the next: each is a drive, but where one lasts into another."""
    paths = drives(tmp_path, 6)
    longer = tmp_path / "longer.mcap"
    write_recording(
        longer,
        [*read_messages(paths[1]), *read_messages(paths[2]), *read_messages(paths[3])],
        reason="test",
        site_toml=None,
    )
    problems: list[str] = []
    found: list[set[Recording]] = [
        set(drive) for drive in group_into_drives([longer, *reversed(paths)], problems)
    ]
    assert found == [{paths[0]}, {longer, *paths[1:4]}, {paths[4]}, {paths[5]}]
    assert problems == []


def test_a_pipe_is_a_line(five: list[Path], tmp_path: Path) -> None:
    """Whoever opened it would wait for somebody who writes into it."""
    pipe = tmp_path / "pipe.mcap"
    os.mkfifo(pipe)
    found, crossings = done(tmp_path / "into", pipe, five[0])
    assert len(crossings) == 2
    assert found.problems == (
        f"{pipe}: is not an ordinary file but a pipe or a device; give an ordinary one",
    )


def test_a_recording_that_is_being_written_waits_until_it_is_closed(
    five: list[Path], tmp_path: Path
) -> None:
    """Else a crossing that is not over would get a result, and later another one."""
    path = tmp_path / "new.mcap"
    messages = list(read_messages(five[1]))
    writer = RecordingWriter(path, reason="test", origin=RecordingOrigin(messages[0].key.realm))
    for message in messages[: len(messages) // 4]:
        writer.write(message)
    writer.sync()
    found, crossings = done(tmp_path / "into", five[0], path)
    assert len(crossings) == 2
    assert found.problems == (f"{path}: is being written; it is identified when it is closed",)
    for message in messages[len(messages) // 4 :]:
        writer.write(message)
    writer.finish("done")
    found, crossings = done(tmp_path / "into", five[0], path)
    assert (len(crossings), found.there, found.problems) == (4, 2, ())


def test_a_recording_that_changes_while_it_is_read_is_a_line(
    same: list[Path], tmp_path: Path
) -> None:
    def changing(
        data: CrossingData, settings: IdentificationSettings, **others: Any
    ) -> CrossingResult:
        with same[1].open("ab") as file:
            file.write(b"more")
        return identified_once(data, settings, **others)

    found, crossings = done(tmp_path / "into", *same[:2], identify=changing)
    assert len(crossings) == 4
    (line,) = found.problems
    assert line.startswith(f"{same[1]}: changed while it was read; ")


def test_a_message_that_is_none_at_the_second_reading_is_a_line(
    five: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    readings = 0

    def changing(path: Path, **others: Any) -> Iterator[Message]:
        nonlocal readings
        readings += 1
        for number, message in enumerate(read_messages(path, **others)):
            is_other = readings == 2 and number == 100
            yield message._replace(payload=b"\xff" * 30) if is_other else message

    monkeypatch.setattr(overview, "_SMALL_BYTES", 0)
    monkeypatch.setattr(archive, "read_messages", changing)
    found, _ = done(tmp_path / "into", five[2])
    assert readings == 2
    assert found.problems == (f"{five[2]}: 1 message has changed while it was read",)


def test_a_full_disk_is_a_line_and_costs_what_was_not_on_it(
    five: list[Path], tmp_path: Path
) -> None:
    into = tmp_path / "into"
    done(into, five[0])
    limit = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, limit[1]))
    try:
        with pytest.raises(FailureError, match=rf"^{into}/.*: could not be written: "):
            done(into, *five)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limit)
    assert [path.suffix for path in into.iterdir()] == [".parquet"]
    found, crossings = done(into, *five)
    assert (len(crossings), found.there, found.problems) == (5, 2, ())


# Recordings that are elsewhere


@pytest.fixture
def away(five: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[Recording]:
    """The same in a store; and a temporary folder of the test's own."""
    folder = folder_at(f"memory://{tmp_path.name}/fleet")
    for path in five:
        put(folder, path.name, path.read_bytes())
    (tmp_path / "temporary").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    return [RemoteRecording(folder, path.name) for path in five]


def test_recordings_elsewhere_give_what_they_give_here(
    five: list[Path], away: list[Recording], tmp_path: Path
) -> None:
    """They are copied drive by drive, and the copies removed."""
    at_once = []

    def looking(
        data: CrossingData, settings: IdentificationSettings, **others: Any
    ) -> CrossingResult:
        at_once.append(len(list((tmp_path / "temporary").rglob("*.mcap"))))
        return identified_once(data, settings, **others)

    found, crossings = done(tmp_path / "into", *away, identify=looking)
    assert found.problems == ()
    assert at_once == [1] * 5
    assert list((tmp_path / "temporary").iterdir()) == []
    again, there = done(tmp_path / "into", *five)
    assert again.there == 5
    assert there == crossings


def test_error_in_another_process_names_its_address(away: list[Recording], tmp_path: Path) -> None:
    folder = folder_at(f"memory://{tmp_path.name}/fleet")
    put(folder, "bad.mcap", b"no recording at all")
    whole = folder.files.cat_file(folder.path("drive-00004.mcap"))
    put(folder, "cut.mcap", whole[: len(whole) // 2])
    other = io.BytesIO()
    writer = Writer(other)
    writer.start()
    channel = writer.register_channel("/imu", "json", writer.register_schema("imu", "", b""))
    writer.add_message(channel, 0, b"{}", 0)
    writer.finish()
    put(folder, "other.mcap", other.getvalue())
    names = ("gone.mcap", "bad.mcap", "cut.mcap", "other.mcap")
    wrong = [RemoteRecording(folder, name) for name in names]
    found, crossings = done(tmp_path / "into", *away[:2], *wrong)
    assert len(crossings) >= 4
    assert list((tmp_path / "temporary").iterdir()) == []
    of_each = {name: [p for p in found.problems if f"/{name}: " in p] for name in names}
    assert of_each["gone.mcap"] == [f"{wrong[0]}: no such file"]
    assert len(of_each["bad.mcap"]) == 1
    assert any("holds no driveby message" in line for line in of_each["other.mcap"])
    assert all(str(tmp_path / "temporary") not in line for line in found.problems)


def test_a_recording_by_its_address(tmp_path: Path) -> None:
    one = recording_at("memory://bucket/fleet/day/one.mcap")
    assert isinstance(one, RemoteRecording)
    assert str(one) == "memory://bucket/fleet/day/one.mcap"
    assert one.folder.path(one.name) == "/bucket/fleet/day/one.mcap"
    assert recording_at(tmp_path) == tmp_path


def test_without_room_for_a_copy_nothing_is_begun(
    away: list[Recording], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    usage = type("Usage", (), {"free": 1000})
    monkeypatch.setattr("services.common.stores.shutil.disk_usage", lambda _: usage)
    with pytest.raises(FailureError, match=r"drive-00000.mcap: .* MB do not fit in .*TMPDIR"):
        done(tmp_path / "into", *away)
    assert list((tmp_path / "temporary").iterdir()) == []


def test_disk_filled_during_a_copy_is_reported_as_full(
    away: list[Recording], tmp_path: Path
) -> None:
    limit = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, limit[1]))
    try:
        with pytest.raises(FailureError, match=r"drive-00000.mcap: .* MB do not fit in .*TMPDIR"):
            done(tmp_path / "into", *away)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limit)
    assert list((tmp_path / "temporary").iterdir()) == []
